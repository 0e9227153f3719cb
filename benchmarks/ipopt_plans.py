"""IPOPT on the horizons of a loop, as well as it can: warm, from nothing, and with the least violation where there is no plan."""

from __future__ import annotations

import time

import casadi as ca
import numpy as np
from limited_loop import Plan

import fpirhc as fp
from fpirhc.horizon.problem import OptimalControl, rollout
from fpirhc.optimisers.bounds import scales
from fpirhc.optimisers.nlp import interleave, program, separate, shift_dynamics, shift_variables, sizes

ACCURACY = 1e-9
GONE = 1e-6  # of half the range: a smaller least violation is rounding, and the horizon has a plan

Found = tuple[dict[str, ca.DM], fp.Status, float]


class IpoptPlans:
    """IPOPT by multiple shooting, through CasADi's `nlpsol`.

    Its last plan is shifted and improved; where that fails it begins with the reference's inputs. Where that fails too, violations
    of limits of states are weighed, in half ranges, at the price that FixedPoint has for them: INFEASIBLE is a horizon whose best
    plan then has one, and the loop goes on with that plan.
    """

    def __init__(self, ocp: OptimalControl) -> None:
        self._ocp, (self._size, self._rows) = ocp, sizes(ocp)
        quiet = {k: v for k, v in fp.Ipopt(accuracy=ACCURACY).options(ocp).items() if "warm" not in k and "mu" not in k}
        quiet["ipopt.max_iter"] = 1000
        self._cold = ca.nlpsol("fpirhc_cold", "ipopt", program(ocp), quiet)
        self._warm = ca.nlpsol("fpirhc_warm", "ipopt", program(ocp), fp.Ipopt(accuracy=ACCURACY).options(ocp))
        self._least = ca.nlpsol("fpirhc_least", "ipopt", self._elastic(), quiet)
        w, g = ca.MX.sym("w", self._size), ca.MX.sym("g", self._rows)
        self._later = ca.Function("fpirhc_later", [w, g], [shift_variables(ocp, w), shift_dynamics(ocp, g)])
        self._inputs = ca.Function("fpirhc_inputs", [w], [separate(ocp, w)[1]])
        self._roll = rollout(ocp)
        self.remembered: dict[str, ca.DM] | None = None

    def __call__(self, s0: np.ndarray, data: np.ndarray) -> Plan:
        """Return the plan of this cycle."""
        begin = time.thread_time_ns()
        found, status, count = self._solved(s0, data)
        taken = (time.thread_time_ns() - begin) / 1e3
        w, _ = self._later(found["x"], found["lam_g"])
        lam_x, lam_g = self._later(found["lam_x"], found["lam_g"])
        self.remembered = {"x0": w, "lam_x0": lam_x, "lam_g0": lam_g}
        inputs = np.asarray(self._inputs(found["x"]).full())
        inputs = np.clip(inputs, self._ocp.input_lower[:, None], self._ocp.input_upper[:, None])
        return Plan(inputs, status, count, taken)

    def _solved(self, s0: np.ndarray, data: np.ndarray) -> Found:
        arguments = {
            **self._bounds(s0, self._ocp.state_lower, self._ocp.state_upper),
            "p": ca.vec(ca.DM(data)),
            "lbg": 0,
            "ubg": 0,
        }
        guess = self._guess(s0, data)
        if self.remembered is not None:
            found = self._warm(**self.remembered, **arguments)
            if self._warm.stats()["success"]:
                return found, fp.Status.OK, self._warm.stats()["iter_count"]
        found = self._cold(x0=guess, **arguments)
        if self._cold.stats()["success"]:
            return found, fp.Status.OK, self._cold.stats()["iter_count"]
        return self._least_violation(s0, data, guess)

    def _least_violation(self, s0: np.ndarray, data: np.ndarray, guess: ca.DM) -> Found:
        free, extra = np.full(self._ocp.state.size, np.inf), self._elastics
        bounds = self._bounds(s0, -free, free)
        low = ca.vertcat(*[0] * self._rows, *[0] * (2 * extra))
        high = ca.vertcat(*[0] * self._rows, *[np.inf] * (2 * extra))
        found = self._least(
            x0=ca.vertcat(guess, ca.DM.zeros(extra)),
            p=ca.vec(ca.DM(data)),
            lbx=ca.vertcat(bounds["lbx"], ca.DM.zeros(extra)),
            ubx=ca.vertcat(bounds["ubx"], ca.DM.inf(extra)),
            lbg=low,
            ubg=high,
        )
        if not self._least.stats()["success"]:
            status = fp.Status.NOT_CONVERGED
        else:
            status = fp.Status.INFEASIBLE if float(ca.mmax(found["x"][self._size :])) > GONE else fp.Status.OK
        kept = {
            "x": found["x"][: self._size],
            "lam_x": found["lam_x"][: self._size],
            "lam_g": found["lam_g"][: self._rows],
        }
        return kept, status, self._least.stats()["iter_count"]

    def _elastic(self) -> dict[str, ca.MX]:
        """The program with limits of states that may be passed, in half ranges, at FixedPoint's price."""
        ocp, base, measures = self._ocp, program(self._ocp), scales(self._ocp)
        states, places, unit = (
            separate(ocp, base["x"])[0],
            list(measures.bounded),
            ca.DM(measures.states[list(measures.bounded)]),
        )
        self._elastics = len(places) * ocp.stages
        passed = ca.MX.sym("passed", len(places), ocp.stages)
        lower = np.maximum(ocp.state_lower[places], -1e9)
        upper = np.minimum(ocp.state_upper[places], 1e9)
        here = states[places, 1:]
        room = [ca.vec((here - ca.DM(lower)) / unit + passed), ca.vec((ca.DM(upper) - here) / unit + passed)]
        price = ca.DM(measures.capacity) * unit
        return {
            **base,
            "x": ca.vertcat(base["x"], ca.vec(passed)),
            "f": base["f"] + ca.sum1(ca.sum2(passed * ca.repmat(price, 1, ocp.stages))),
            "g": ca.vertcat(base["g"], *room),
        }

    def _bounds(self, s0: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> dict[str, ca.DM]:
        n, ocp = self._ocp.stages, self._ocp
        column = lambda states, inputs: interleave(  # noqa: E731
            ca.horzcat(ca.DM(s0), ca.repmat(ca.DM(states), 1, n)), ca.repmat(ca.DM(inputs), 1, n)
        )
        return {"lbx": column(lower, ocp.input_lower), "ubx": column(upper, ocp.input_upper)}

    def _guess(self, s0: np.ndarray, data: np.ndarray) -> ca.DM:
        ocp = self._ocp
        inputs = np.clip(ocp.nodes[1][:, : ocp.stages], ocp.input_lower[:, None], ocp.input_upper[:, None])
        states = self._roll(s0, inputs, data)[0]
        usable = bool(np.isfinite(states.full()).all())
        return interleave(states if usable else ca.repmat(ca.DM(s0), 1, ocp.stages + 1), ca.DM(inputs))
