"""Plans on outputs under a wrong model, beside a predictive controller that owes the library nothing.

    python benchmarks/output_plans.py [PLANT ...]     prints a table, and the bars that are not kept
        --write            puts it into docs/theory-outputs.md
        --rates=100        multiplies the weights of the inputs' rates; the bars are those of the weights as they are

Fifteen plants of relative orders 1 to 4 (`output_plants.py`, `output_plants_three.py`, `output_plants_four.py`), measured without
noise. For each controller the rms error of the outputs after the transient, and in brackets the motion of the command in that time:
the sum of its moves, in shares of its range. `own` is `own_nmpc.py`: CasADi's Opti and IPOPT with the same model, stages, cost and
limits. Its equations judge all runs.
The deformations are affine with an effective gain of 0.8. Exit code 1: a bar is not kept.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import output_plants
import output_plants_four
import output_plants_three
from own_nmpc import equations, own_run, wanted
from table import write_table

import fpirhc as fp
from fpirhc.controllers.base import Controller
from fpirhc.status import Status

PAGE = Path(__file__).resolve().parents[1] / "docs" / "theory-outputs.md"
NAMES = {
    output_plants: ("growth", "double_tank", "reactor", "leaking_pair", "anaesthesia", "hand"),
    output_plants_three: ("link", "tumour_drug", "tumour_all", "glucose", "vehicle"),
    output_plants_four: ("flexible_joint", "two_masses", "four_tanks", "quadrotor"),
}
PLANTS: dict[str, Callable[[], fp.Problem]] = {n: getattr(module, n) for module, names in NAMES.items() for n in names}
BEYOND: dict[str, Callable[[], fp.Problem]] = {"four_tanks_steep": output_plants_four.four_tanks_steep}
"""Where adaptation fails, see the page; shown without bars."""
MAP = fp.Affine(gain=-1.6)
OWN, OWN_EXACT = "own, wrong model", "own, exact model"


@dataclass(frozen=True)
class Outcome:
    """Errors of every output after the transient (K, ny), motion of the command there, share of converged plans."""

    errors: np.ndarray
    motion: float
    converged: float

    @property
    def rms(self) -> float:
        """Root of the mean of the squared errors, summed over the outputs; infinite where the run ended early."""
        value = float(np.sqrt(np.mean(np.sum(self.errors**2, axis=1)))) if self.errors.size else np.inf
        return value if np.isfinite(value) else np.inf

    @property
    def largest(self) -> np.ndarray:
        """Rms error of every output."""
        return np.sqrt(np.mean(self.errors**2, axis=0))


def spans(problem: fp.Problem) -> np.ndarray:
    """Ranges of the inputs."""
    return np.array([high - low for low, high in problem.limits.inputs.values()])


def ways(problem: fp.Problem, iterations: int = 30) -> dict[str, Controller]:
    """The controllers by name."""
    optimiser = fp.FixedPoint(iterations=iterations, tolerance=1e-5 * float(spans(problem).min()))
    plain = fp.RecedingHorizon(optimiser)
    return {
        "RHC": plain,
        "RHC from x*": replace(plain, replanning=fp.FromMeasurement(consistent=True)),
        "RHC+FPI, plain": plain.with_deformation(MAP),
        "RHC+FPI, model-referenced": plain.with_deformation(fp.ModelReferenced(MAP)),
        "RHC exact": fp.ExactModel(plain),
    }


def with_rates(problem: fp.Problem, times: float) -> fp.Problem:
    """The problem with so many times the weights of the inputs' rates."""
    return replace(problem, cost=replace(problem.cost, rate={n: times * w for n, w in problem.cost.rate.items()}))


def summed_up(problem: fp.Problem, errors: np.ndarray, commands: np.ndarray, converged: np.ndarray) -> Outcome:
    """Leave out the transient of one run."""
    first = int(np.ceil(problem.measure_from / problem.period - 1e-9))
    moves = np.abs(np.diff(commands[first:], axis=0)) / spans(problem)
    return Outcome(errors[first:], float(moves.sum(axis=0).max(initial=0.0)), float(np.mean(converged)))


def own(problem: fp.Problem, *, exact: bool = False) -> Outcome:
    """The outcome of the independent controller."""
    record = own_run(problem, exact=exact)
    return summed_up(problem, record.errors, record.commands, record.converged)


def judged(problem: fp.Problem, controller: Controller) -> Outcome:
    """The outcome of a controller of the library; its states are judged by the independent equations."""
    run = fp.simulate(problem, controller, seed=0, compiled=False)
    if run.stop is not None:
        return Outcome(np.empty((0, 1)), np.inf, 0.0)
    below = [k for k, weighed in enumerate(problem.cost.outputs) if not weighed.endswith("'")]
    outputs, reference = equations(problem, exact=True)[1], wanted(problem)
    times = problem.period * np.arange(problem.cycles)
    errors = np.asarray(outputs(run["state"].T) - reference(times[None]))[below].T
    return summed_up(problem, errors, run["command"], np.ravel(run["solve.status"]) == Status.OK)


def outcomes(problem: fp.Problem) -> dict[str, Outcome]:
    """Every controller's outcome."""
    own_ones = {OWN: own(problem), OWN_EXACT: own(problem, exact=True)}
    return own_ones | {name: judged(problem, controller) for name, controller in ways(problem).items()}


Bar = tuple[str, float, float]
"""What is compared, its value, and what it may be at most."""

NAMED = {"tumour_drug": (0.044, 1e-3), "tumour_all": (np.inf, 1e-3), "quadrotor": (np.inf, 5e-3)}
"""Rms errors that RHC, and RHC+FPI in both forms, may have at most."""


def bars(name: str, by: dict[str, Outcome]) -> Iterator[Bar]:
    """What the outcomes of one plant must keep."""
    rivals, plain = by[OWN], by["RHC"]
    yield f"{name}: RHC, of the independent controller's error", plain.rms / rivals.rms, 1.1
    yield f"{name}: exact model, of the independent one's error", by["RHC exact"].rms / by[OWN_EXACT].rms, 1.1
    largest = NAMED.get(name, (np.inf, np.inf))
    yield f"{name}: RHC", plain.rms, largest[0]
    for form, share in (("plain", 0.1), ("model-referenced", 0.05)):
        one = by[f"RHC+FPI, {form}"]
        yield f"{name}: RHC+FPI, {form}, of the independent controller's error", one.rms / rivals.rms, share
        yield f"{name}: RHC+FPI, {form}", one.rms, largest[1]
        yield f"{name}: RHC+FPI, {form}, motion beyond that of the exact model", one.motion - by[OWN_EXACT].motion, 0.5
    unsolved = max(1 - o.converged for way, o in by.items() if way != "RHC from x*")
    yield f"{name}: share of plans that did not converge", unsolved, 0.01


def of_two_iterations() -> Iterator[Bar]:
    """The quadrotor with two iterations of the optimiser in a plan."""
    problem = PLANTS["quadrotor"]()
    controllers = ways(problem, iterations=2)
    for way in ("RHC+FPI, plain", "RHC+FPI, model-referenced"):
        for output, value in zip(("px", "pz"), judged(problem, controllers[way]).largest, strict=True):
            yield f"quadrotor, two iterations: {way}, {output} in m", float(value), 5e-3


def by_outputs(problem: fp.Problem) -> fp.Problem:
    """The shipped `leaking_tanks` with its levels as outputs in place of coordinates."""
    plant = problem.plant
    outputs = {"h1": fp.Output("m", lambda x, p: x.h1), "h2": fp.Output("m", lambda x, p: x.h2)}
    states = fp.Plant.of_states(
        states=plant.coordinates,
        inputs=plant.inputs,
        rates=plant.response,
        outputs=outputs,
        controlled=plant.controlled,
        parameters=plant.parameters,
    )
    return replace(problem, plant=states, cost=replace(problem.cost, states={}, outputs=problem.cost.states))


def of_spellings() -> Iterator[Bar]:
    """`leaking_tanks`, with its noise, spelled with coordinates and with outputs."""
    task = fp.load_problem("leaking_tanks")
    for name, controller in task.controllers.items():
        one, other = (
            fp.simulate(p, controller, seed=0, compiled=False) for p in (task.problem, by_outputs(task.problem))
        )
        apart = np.abs(one["state"] - other["state"]).max() if one.cycles == other.cycles else np.inf
        yield f"leaking_tanks: {name}, levels by outputs less those by coordinates, m", float(apart), 1e-9


def cells(problem: fp.Problem, by: dict[str, Outcome]) -> list[str]:
    """One line of the table: orders and states, then error, motion and what did not converge of every controller."""
    orders = ", ".join(
        str(tuple(problem.plant.chains.values())[problem.plant.chains.index(n)]) for n in problem.plant.controlled_names
    )
    texts = []
    for outcome in by.values():
        share = "" if outcome.converged > 0.9995 else f", {100 * outcome.converged:.1f} %"
        texts.append(f"{outcome.rms:.2g} ({outcome.motion:.2g}{share})" if np.isfinite(outcome.rms) else "ended early")
    return [f"{orders} of {problem.plant.state.size}", *texts]


def main() -> None:
    """Measure the plants named on the command line, or all, and the other bars."""
    names = [a for a in sys.argv[1:] if not a.startswith("--")]
    times = next((float(a.partition("=")[2]) for a in sys.argv if a.startswith("--rates=")), 1.0)
    kept: list[Bar] = []
    rows, heads = [], []
    for name in names or [*PLANTS, *BEYOND]:
        problem = with_rates((PLANTS | BEYOND)[name](), times)
        by = outcomes(problem)
        heads = ["plant", "order", *by]
        rows.append([name, *cells(problem, by)])
        print(" | ".join(rows[-1]), flush=True)
        kept += bars(name, by) if name in PLANTS else ()
    if not names:
        kept += [*of_two_iterations(), *of_spellings()]
    write_table("output plans", heads, rows, PAGE)
    missed = [bar for bar in kept if not bar[1] <= bar[2]]
    for what, value, most in missed:
        print(f"not kept: {what}: {value:.3g}, at most {most:.3g}")
    print(f"{len(kept) - len(missed)} of {len(kept)} bars are kept")
    sys.exit(1 if missed else 0)


if __name__ == "__main__":
    main()
