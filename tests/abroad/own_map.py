"""A cart behind a slow network, with a deformation of the user's own: the inverse tangent, around a dead time.

    m s'' = F(t - 20 ms) - c s'.

The map is r+ = r - a w tan^-1((f - d) / w) per coordinate: slope a at zero, steps of at most a w pi / 2, so it belongs to the
family whose contraction the secant bounds (sector of the inverse tangent, in (0, 1]; H. K. Khalil, Nonlinear Systems, 3rd ed.,
section 7.1). The plant is a cart with friction and a late force; the numbers are chosen here. `unpaired` is what the file would
be if its author had not known of the dead time: the response is taken for that of the last request.
"""

from dataclasses import dataclass, replace

import casadi as ca

import fpirhc as fp
from fpirhc.contracts import Deformation


@dataclass(frozen=True)
class InverseTangent(Deformation):
    """r+ = r - a w tan^-1((f - d) / w), with the slope a and the width w in units of the response."""

    gain: float
    width: float

    def step(self, request, response, desired, memory):
        del memory
        return request - self.gain * self.width * ca.atan((response - desired) / self.width), {}

    def effective_gain(self):
        return self.gain

    def with_effective_gain(self, gain):
        return replace(self, gain=gain)


PERIOD = 0.005  # s
LATE = 0.02  # s

plant = fp.Plant(
    coordinates={"s": "m"},
    inputs={"F": "N"},
    order=2,
    response=lambda q, v, u, p: {"s": (u.F - p.c * v.s) / p.m},
    parameters={
        "m": fp.Parameter(approximate=3.0, exact=2.0, unit="kg"),
        "c": fp.Parameter(approximate=0.0, exact=3.0, unit="N s/m"),
    },
)

problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"s": 0.5 * ca.sin(2 * t)}),
    start={"s": 0.0, "s'": 1.0},
    period=PERIOD,
    duration=12.0,  # s
    limits=fp.Limits(inputs={"F": (-40.0, 40.0)}),
    dead_time=fp.DeadTime(inputs={"F": LATE}),
    horizon=fp.Horizon(stages=20, step=0.02),
    cost=fp.Quadratic(states={"s": 1e3, "s'": 10.0}, deviation={"F": 1e-3}),
    measure_from=3.0,  # s
)

own = InverseTangent(gain=0.1, width=20.0)  # width in m/s^2
optimiser = fp.FixedPointSolver(iterations=1, tolerance=1e-2)  # N
plain = fp.RecedingHorizon(optimiser)
controllers = {
    "CTC": fp.ComputedTorque(fp.Exponential(rate=4.0)),
    "CTC+FPI": fp.ComputedTorque(fp.Exponential(rate=4.0), fp.Paired(own, cycles=LATE / PERIOD)),
    "RHC": plain,
    "RHC+FPI": fp.RecedingHorizon(optimiser, fp.Paired(own, cycles=LATE / PERIOD)),
    "RHC+FPI, increment": fp.RecedingHorizon(optimiser, fp.Increment(own, cycles=LATE / PERIOD)),
    "RHC exact model": fp.ExactModel(plain),
}
headline = ("RHC", "RHC+FPI")
