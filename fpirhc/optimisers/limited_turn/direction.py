"""The direction of the next plan by one Riccati sweep: pure, or interior with the largest step that stays inside."""

from __future__ import annotations

import casadi as ca

from fpirhc.horizon.hessian_models import ExactHessian, GaussNewton
from fpirhc.horizon.sweep import Expansion, sweep
from fpirhc.optimisers.bounds import BOUNDARY, Interior
from fpirhc.optimisers.certified import certify, largest_gap
from fpirhc.optimisers.limited_turn.call import Call
from fpirhc.optimisers.limited_turn.descent import priced
from fpirhc.optimisers.limited_turn.merit import merit, merit_slope
from fpirhc.optimisers.limited_turn.phases import restart
from fpirhc.optimisers.limited_turn.state import COLD, KEPT, PURE, WARM, State, choose, fixed, point


class Direction:
    """Builds the sweeps of one call: with the Hessian of the settings, and with Gauss-Newton where that is not convex.

    Args:
        call: the problem and its arguments.
    """

    def __init__(self, call: Call) -> None:
        ocp, scales = call.ocp, call.scales
        damping = ocp.step * ocp.curvature, 0.01 * scales.cost / scales.states**2
        models = call.settings.hessian or ExactHessian(), GaussNewton()
        self._call = call
        self._exact, self._plain = (sweep(ocp, model, scales.bounded, damping) for model in models)

    def directed(self, s: State, needed: ca.MX) -> State:
        """Return the state with the next step where one is needed; with more damping where the sweep fails."""
        call, limits, p, pure = self._call, self._call.limits, point(s), s["phase"] == PURE
        slope = certify(call.ocp, limits, p, s["z"])
        weights, leans, held = limits.pure(p, s["z"], slope, largest_gap(p, call.scales))
        y = Interior(s["t"], s["e"], s["z"])
        placed = limits.inside(p, s["z"], s["mu"], s["slacks"] == WARM)
        y = Interior(*(ca.if_else(s["slacks"] == KEPT, a, b) for a, b in zip(y, placed, strict=True)))
        t, e = limits.path(p, s["mu"])
        anew = ca.if_else(s["slacks"] == COLD, ca.if_else(limits.present, s["mu"] / t, 0), y.z)
        y = Interior(*(ca.if_else(s["descends"], a, b) for a, b in zip((t, e, anew), y, strict=True)))
        barrier = limits.interior(p, y, s["mu"])
        weight, lean = (ca.if_else(pure, a, b) for a, b in zip((weights, leans), barrier, strict=True))
        v, gains, dx, du, swept, ok = self._swept(s, p, weight, lean, needed)
        use_exact = ca.logic_or(s["use_exact"], ca.logic_not(pure))
        now = {**s, "z": ca.if_else(pure, held, y.z), "use_exact": use_exact, **fixed(again=0)}
        now = choose(now, pure, now, {**now, "t": y.t, "e": y.e, **fixed(slacks=KEPT)})
        delta = ca.fmax(10 * s["delta"], 1e-6)
        failed = {**now, "delta": delta, **fixed(fresh=2, use_exact=1)}
        failed = choose(failed, delta > 1e8, restart(call, failed), failed)
        stepped = {**now, "v": v, "gains": gains, "dx": dx, "du": du, "swept": swept}
        steps = {**stepped, "next_z": limits.pure_multipliers(p, held, du, dx)}
        inside = self._inside(stepped, p, y, s["mu"])
        directed = choose(now, ok, choose(stepped, pure, steps, inside), failed)
        return choose(s, needed, directed, s)

    def _inside(self, s: State, p: Expansion, y: Interior, mu: ca.MX) -> State:
        """The state with the moves of slacks, elastics and multipliers, their shares, and the measures of the filter."""
        call = self._call
        by = call.limits.moves(p, y, mu, s["du"], s["dx"])
        tau = ca.fmax(BOUNDARY, 1 - mu / call.scales.cost)
        alpha, alpha_dual = call.limits.shares(y, by, tau)
        inside = {**s, "dt": by.t, "de": by.e, "dz": by.z, "alpha": alpha, "alpha_dual": alpha_dual}
        inside["theta"], inside["phi"] = merit(call, p, y, mu)
        inside["dphi"] = merit_slope(call, inside, p)
        return choose(inside, inside["descends"] > 0, priced(call, inside, p), inside)

    def _swept(self, s: State, p: Expansion, weight: ca.MX, lean: ca.MX, needed: ca.MX) -> list[ca.MX]:
        arguments = [*p, weight, lean, s["costates"], s["delta"], self._call.data]
        none = _without_result(self._exact)
        exact_if = ca.Function.if_else("fpirhc_sweep_exact", self._exact, none)
        first = exact_if(ca.logic_and(needed, s["use_exact"]), *arguments)
        failed = ca.logic_and(needed, first[-1] == 0)
        second = ca.Function.if_else("fpirhc_sweep_plain", self._plain, none)(failed, *arguments)
        return [ca.if_else(failed, b, a) for a, b in zip(first, second, strict=True)]


def _without_result(function: ca.Function) -> ca.Function:
    """The same signature, with results of zero."""
    inputs = [ca.MX.sym(f"i{k}", *function.size_in(k)) for k in range(function.n_in())]
    return ca.Function("fpirhc_no_sweep", inputs, [ca.MX.zeros(*function.size_out(k)) for k in range(function.n_out())])
