"""Deformations that break the contract, each in one thing, and the right one that they are made from."""

# ruff: noqa: ARG002 - arguments are those of the contract

from dataclasses import dataclass, replace

import casadi as ca

from fpirhc.contracts import Deformation, Form


@dataclass(frozen=True)
class Softsign(Deformation):
    """r+ = r - gain e / sqrt(1 + |e|^2 / size^2) with e = f - d; a map that keeps every law."""

    gain: float
    size: float

    def step(self, request, response, desired, memory):
        error = response - desired
        return request - self.gain * error / ca.sqrt(1 + ca.sumsqr(error) / self.size**2), {}

    def effective_gain(self):
        return self.gain

    def with_effective_gain(self, gain):
        return replace(self, gain=gain)


class HalfTheSecant(Softsign):
    """Steps per unit are twice as long as it says."""

    def secant_gain(self):
        return 0.5 * self.gain


class MovesItsFixedPoint(Softsign):
    """Changes the request where the response is the desired one."""

    def step(self, request, response, desired, memory):
        return super().step(request, response, desired, memory)[0] + 1e-3, {}


class DividesByZero(Softsign):
    """Is 0 / 0 where the response is the desired one."""

    def step(self, request, response, desired, memory):
        error = response - desired
        return request - self.gain * error / ca.norm_2(error) * ca.norm_2(error), {}


class OtherSign(Softsign):
    """Tells the gain with the other sign."""

    def effective_gain(self):
        return -self.gain


class Kinked(Softsign):
    """Has twice the gain for errors below zero."""

    def step(self, request, response, desired, memory):
        error = response - desired
        bent = ca.if_else(error > 0, error, 2 * error)
        return request - self.gain * bent / ca.sqrt(1 + ca.sumsqr(error) / self.size**2), {}


class Wavelet(Softsign):
    """Turns back for large errors: r+ = r - gain e (1 - s^2) exp(-s^2 / 2), s = |e| / size, which rests where |e| = size."""

    def step(self, request, response, desired, memory):
        error = response - desired
        share = ca.sumsqr(error) / self.size**2
        return request - self.gain * error * (1 - share) * ca.exp(-share / 2), {}


class Rests(Softsign):
    """Has a second fixed point a little beyond the first: r+ = r - gain e (1 - 1.5 bump), which turns back from 2 to 4 sizes."""

    def step(self, request, response, desired, memory):
        step = super().step(request, response, desired, memory)[0] - request
        distance = ca.sqrt(ca.sumsqr(response - desired) / self.size**2 + 1e-12)
        return request + step * (1 - 1.5 * ca.exp(-((distance - 3) ** 2) * 4)), {}


class GivesAnotherGain(Softsign):
    """Is asked for a gain and gives twice of it."""

    def with_effective_gain(self, gain):
        return replace(self, gain=2 * gain)


class HidesNaN(Softsign):
    """Limits the response that it sees, which makes a number of NaN."""

    def step(self, request, response, desired, memory):
        return super().step(request, ca.fmax(-1e3, ca.fmin(1e3, response)), desired, memory)


class TellsTwiceItsGain(Softsign):
    """Has half of the gain that it tells, and takes one as it tells it."""

    def effective_gain(self):
        return 2 * self.gain

    def with_effective_gain(self, gain):
        return replace(self, gain=0.5 * gain)


class SaysItIsLate(Softsign):
    """Names an earlier request than the one that it compares the response with."""

    form = Form(cycles=3)


class SaysItIncrements(Softsign):
    """Says that it passes a change of the desired response on."""

    form = Form("increment")
