"""do-mpc's stirred tank: do-mpc's own controllers on do-mpc's own simulator, and ours on the same simulator.

    pip install do-mpc
    .venv/bin/python benchmarks/beside_do_mpc.py [--write]          three minutes; --write puts the table into docs/beside.md

The reactor, its first state, set-point, weights, limits, period and horizon are those of do-mpc's example (examples/CSTR; Klatt and
Engell 1998). Every controller has the nominal model, alpha = beta = 1; the simulator moves with each of the example's nine pairs.
The rivals have their best information: do-mpc's robust controller plans over all nine pairs, of which the true one is one; "knows
the values" is told the true pair. All controllers measure the four states without noise. The error is the root mean square of
C_b - 0.6 mol/l in the second half of the run; the time is the median CPU time of a command.
"""

from __future__ import annotations

import itertools
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

import fpirhc as fp

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]
from beside import Step, flown, ours  # noqa: E402
from table import write_table  # noqa: E402

from tests.abroad import cstr  # noqa: E402

CYCLES, SETTLED = 100, 50
START = (0.8, 0.5, 134.14, 130.0)
ALPHAS, BETAS = (1.0, 1.05, 0.95), (1.0, 1.1, 0.9)
WARMEST = 140.0  # C, soft for T_R and hard for T_K in the example


def reactor(do_mpc: Any) -> Any:
    """The example's model, of the same equations as ours."""
    model = do_mpc.model.Model("continuous")
    q = _Names({name: model.set_variable("_x", name) for name in ("C_a", "C_b", "T_R", "T_K")})
    u = _Names({"F": model.set_variable("_u", "F"), "Q": model.set_variable("_u", "Q_dot")})
    p = _Names({name: model.set_variable("_p", name) for name in ("alpha", "beta")})
    for name, rate in cstr.response(q, u, p).items():
        model.set_rhs(name, rate)
    model.setup()
    return model


class _Names:
    """Expressions as attributes."""

    def __init__(self, values: dict[str, Any]) -> None:
        vars(self).update(values)


def mpc(do_mpc: Any, model: Any, pairs: Sequence[tuple[float, float]]) -> Any:
    """The example's controller, which plans over all combinations of the values in these pairs."""
    one = do_mpc.controller.MPC(model)
    one.set_param(n_horizon=20, n_robust=int(len(pairs) > 1), t_step=cstr.PERIOD, state_discretization="collocation")
    one.set_param(collocation_type="radau", collocation_deg=2, collocation_ni=1, store_full_solution=False)
    one.settings.supress_ipopt_output()
    for kind, name, scale in (("_x", "T_R", 100), ("_x", "T_K", 100), ("_u", "Q_dot", 2000), ("_u", "F", 100)):
        one.scaling[kind, name] = scale
    error = (model.x["C_b"] - 0.6) ** 2
    one.set_objective(mterm=error, lterm=error)
    one.set_rterm(F=0.1, Q_dot=1e-3)
    bounds = {
        "C_a": (0.1, 2),
        "C_b": (0.1, 2),
        "T_R": (50, None),
        "T_K": (50, WARMEST),
        "F": (5, 100),
        "Q_dot": (-8500, 0),
    }
    for name, limits in bounds.items():
        for side, value in zip(("lower", "upper"), limits, strict=True):
            if value is not None:
                one.bounds[side, "_u" if name in ("F", "Q_dot") else "_x", name] = value
    one.set_nl_cons("T_R", model.x["T_R"], ub=WARMEST, soft_constraint=True, penalty_term_cons=1e2)
    alphas, betas = (np.array(list(dict.fromkeys(values))) for values in zip(*pairs, strict=True))
    one.set_uncertainty_values(alpha=alphas, beta=betas)
    one.setup()
    return one


class Reactor:
    """do-mpc's simulator with these values, as a body."""

    def __init__(self, do_mpc: Any, model: Any, alpha: float, beta: float) -> None:
        self._simulator = do_mpc.simulator.Simulator(model)
        self._simulator.set_param(integration_tool="cvodes", abstol=1e-10, reltol=1e-10, t_step=cstr.PERIOD)
        values = self._simulator.get_p_template()
        values["alpha"], values["beta"] = alpha, beta
        self._simulator.set_p_fun(lambda _: values)
        self._simulator.setup()

    def reset(self, seed: int) -> np.ndarray:  # noqa: ARG002 -- nothing is drawn
        """Go to the example's first state."""
        self._simulator.reset_history()
        self._simulator.x0 = np.array(START).reshape(-1, 1)
        return np.array(START)

    def step(self, time: float, command: np.ndarray) -> np.ndarray:  # noqa: ARG002 -- it has its own clock
        """Hold the command for a cycle."""
        return np.asarray(self._simulator.make_step(np.asarray(command, float).reshape(-1, 1))).ravel()


@dataclass(frozen=True)
class Score:
    """What a run is judged by: rms of C_b - 0.6 in the second half, mol/l; largest T_R, C; median time of a command, ms."""

    error: float
    warmest: float
    milliseconds: float


def score(step: Step, body: Reactor) -> Score:
    """The loop of do-mpc's example: measure, command, move."""
    states, _, milliseconds = flown(step, body.reset(0), lambda _, u: body.step(0.0, u), cstr.PERIOD, CYCLES)
    error = float(np.sqrt(np.mean((states[SETTLED:-1, 1] - 0.6) ** 2)))
    return Score(error, float(states[:-1, 2].max()), milliseconds)


def theirs(controller: Any) -> Step:
    """do-mpc's controller from the example's first state."""
    controller.reset_history()
    controller.x0 = np.array(START)
    controller.set_initial_guess()
    return lambda _, x: controller.make_step(x.reshape(-1, 1))


def problem(alpha: float, beta: float) -> fp.Problem:
    """The example; do-mpc weighs changes of inputs that it divides by 100 and 2000, so those are in the weights here."""
    plant, values = cstr.reactor(1.0, 1.0), {"alpha": alpha, "beta": beta}
    exact = {name: replace(one, exact=values[name]) for name, one in plant.parameters.items()}
    return replace(
        cstr.task(replace(plant, parameters=exact)),
        sensing=fp.Sensing(estimator=fp.PositionDifference()),
        cost=fp.CustomCost(terms, terminal=lambda v: cstr.PERIOD * terms(v)["errors"]),
        limits=fp.Limits(inputs={"F": (5.0, 100.0), "Q": (-8500.0, 0.0)}),
    )


def terms(v: Any) -> dict[str, Any]:
    beyond = [ca.fmax(t - WARMEST, 0) + ca.fmax(50.0 - t, 0) for t in (v.state.T_R, v.state.T_K)]
    rate = 0.1 * ((v.input.F - v.input_before.F) / 100) ** 2 + 1e-3 * ((v.input.Q - v.input_before.Q) / 2000) ** 2
    return {"errors": (v.state.C_b - v.reference.C_b) ** 2 + 1e4 * ca.sumsqr(ca.vertcat(*beyond)), "rate": rate}


plain = fp.RecedingHorizon(fp.FixedPointSolver(iterations=30, tolerance=1e-4))
filter_ = fp.DisturbanceKalman(
    drift={"C_a": 1.0, "C_b": 1.0, "T_R": 100.0, "T_K": 100.0},
    measured={"C_a": 1e-3, "C_b": 1e-3, "T_R": 0.1, "T_K": 0.1},
)
OURS = {
    "RHC": plain,
    "RHC+FPI, model-referenced": fp.RecedingHorizon(plain.optimiser, fp.ModelReferenced(fp.Affine(gain=-0.5))),
    "RHC offset-free": fp.Estimating(plain, filter_),
    "RHC, knows the values": fp.ExactModel(plain),
}


def main() -> None:
    """Score every controller with every pair and print a row for each."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # what do-mpc misses for other features
        import do_mpc

    model = reactor(do_mpc)
    nominal, robust = ([(1.0, 1.0)], list(itertools.product(ALPHAS, BETAS)))
    makers: dict[str, Callable[[float, float], Step]] = {
        "do-mpc": lambda *_: theirs(mpc(do_mpc, model, nominal)),
        "do-mpc, robust over the nine pairs": lambda *_: theirs(mpc(do_mpc, model, robust)),
        "do-mpc, knows the values": lambda *pair: theirs(mpc(do_mpc, model, [pair])),
        **{f"fpirhc, {n}": lambda *pair, one=one: ours(problem(*pair), one) for n, one in OURS.items()},
    }
    scores = {
        name: [score(make(*pair), Reactor(do_mpc, model, *pair)) for pair in robust] for name, make in makers.items()
    }
    unit = np.median([one.milliseconds for one in scores["fpirhc, RHC"]])
    rows = [
        (
            name,
            *(f"{1e3 * size([one.error for one in own]):.3g}" for size in (np.median, np.max)),
            f"{max(one.warmest for one in own):.1f}",
            f"{np.median([one.milliseconds for one in own]) / unit:.2g}",
        )
        for name, own in scores.items()
    ]
    heads = ("controller", "median error, mmol/l", "largest", "largest T_R, C", "time of a command")
    write_table("beside do-mpc", heads, rows, ROOT / "docs" / "beside.md")
    print(f"do-mpc {do_mpc.__version__}; a command of fpirhc's RHC takes {unit:.3g} ms.")


if __name__ == "__main__":
    main()
