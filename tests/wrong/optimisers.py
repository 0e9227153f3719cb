"""Eight optimisers that break the contract, each in one thing, and the right one that they are made from."""

# ruff: noqa: ARG002 - arguments are those of the contract

from dataclasses import dataclass
from typing import Any

import casadi as ca

import fpirhc as fp
from fpirhc.contracts import (
    Layout,
    Optimiser,
    Signal,
    clip,
    is_finite,
    judge,
    reduced_gradient,
    remembered_plan,
    sane,
    shift,
    status_of,
)
from fpirhc.errors import NotSupported

_SHARE, _MOMENTUM = 0.12, 0.5


@dataclass(frozen=True)
class HeavyBall(Optimiser):
    """Projected gradient descent with momentum; an optimiser that keeps every law."""

    iterations: int
    tolerance: float

    def check(self, ocp):
        if ocp.bounds_states:
            raise NotSupported("HeavyBall keeps limits of inputs only")

    def memory(self, ocp):
        names = tuple(f"{i}@{k}" for k in range(ocp.stages) for i in ocp.input.elements)
        return Layout((Signal("plan_inputs", names),))

    def shifted(self, ocp, memory):
        return ca.vec(shift(ca.reshape(memory, ocp.input.size, ocp.stages), ocp))

    def step(self, ocp):
        nu, ns, n = ocp.input.size, ocp.state.size, ocp.stages
        s0, data = ca.MX.sym("s0", ns), ca.MX.sym("data", ocp.data.size, n + 1)
        lower, upper, memory = ca.MX.sym("lower", nu), ca.MX.sym("upper", nu), ca.MX.sym("memory", nu * n)
        start, none = remembered_plan(memory, nu, lower, upper), ca.DM.zeros(ns, n)
        plan: Any = start
        before: Any = start
        scale = ca.repmat(ca.DM(1 / (ocp.step * ocp.curvature)), 1, n)
        for _ in range(self.iterations):
            downhill = self.slope(ocp, plan, s0, data) * scale
            plan, before = clip(plan - _SHARE * downhill + _MOMENTUM * (plan - before), lower, upper), plan
        numbers: Any = ca.vertcat(*judge(ocp)(plan, s0, data, lower, upper, none))
        finite = ca.logic_and(sane(s0, data, lower, upper), is_finite(ca.vertcat(ca.vec(plan), numbers)))
        plan, numbers = ca.if_else(finite, plan, start), ca.if_else(finite, numbers, ca.DM.zeros(3))
        judged = status_of(finite, numbers[1], numbers[2], self.tolerance)
        status = ca.if_else(ca.mmax(lower - upper) > 0, int(fp.Status.INFEASIBLE), judged)
        results = self.final(plan, ca.vertcat(numbers, self.iterations, status), ca.vec(plan))
        return ca.Function("heavy_ball", [s0, data, lower, upper, memory], list(results))

    def slope(self, ocp, plan, s0, data):
        return reduced_gradient(ocp)(s0, plan, data, ca.DM.zeros(ocp.state.size, ocp.stages))[1]

    def final(self, plan, diagnostics, memory):
        return plan, diagnostics, memory


class AlwaysOk(HeavyBall):
    """Calls every plan OK."""

    def final(self, plan, diagnostics, memory):
        return plan, ca.vertcat(diagnostics[:4], 0), memory


class NoCost(HeavyBall):
    """Reports a cost of zero."""

    def final(self, plan, diagnostics, memory):
        return plan, ca.vertcat(0, diagnostics[1:]), memory


class DoesNotShift(HeavyBall):
    """Goes on with the plan of the stage before."""

    def shifted(self, ocp, memory):
        return memory


class LeavesTheBox(HeavyBall):
    """Plans inputs outside of their bounds."""

    def final(self, plan, diagnostics, memory):
        return plan * 1.5, diagnostics, ca.vec(plan)


class ForgetsItsPlan(HeavyBall):
    """Begins every call with zero inputs."""

    def final(self, plan, diagnostics, memory):
        return plan, diagnostics, memory * 0


class CountsThree(HeavyBall):
    """Reports three iterations, whatever it took."""

    def final(self, plan, diagnostics, memory):
        return plan, ca.vertcat(diagnostics[:3], 3, diagnostics[4]), memory


class TenthOfTheResidual(HeavyBall):
    """Reports a tenth of the stationarity."""

    def final(self, plan, diagnostics, memory):
        return plan, ca.vertcat(diagnostics[0], 0.1 * diagnostics[1], diagnostics[2:]), memory


class SaysItMayTakeAnyTime(HeavyBall):
    """Does the same work in every call and says that it has no bound."""

    @property
    def unbounded(self):
        return "it may take any time"
