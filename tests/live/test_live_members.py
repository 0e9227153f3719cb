"""Every number of every member is open and runs as in the loop built with it, or is refused by its path and the place."""

from dataclasses import replace
from typing import Any

import casadi as ca
import pytest
from helpers.on_problem import named, on_problem

import fpirhc as fp
from fpirhc.conformance import Example, check_live, examples, two_masses
from fpirhc.contracts import Controller
from fpirhc.errors import FpirhcError, NotSupported

SIGMOID = fp.Sigmoid(gain=-0.5, scale=50.0)
TRACKING = fp.Exponential(rate=8.0)
MEASURED = dict.fromkeys(("a", "b", "a'", "b'"), 1e-3)
KALMAN = fp.Estimating(
    fp.ComputedTorque(TRACKING, SIGMOID), fp.DisturbanceKalman({"a": 1.0, "b": 1.0}, MEASURED, noise={"a": 0.1})
)
STRUCTURE = "decides what the loop is made of", "does not use it"
# By Python.
COMPUTED = (
    "needs its number while the loop is built",
    "code of the optimiser is computed",
    "turns one of them into a number",
)
WEIGHTS: dict[str, Any] = {"states": {"a": 1e2, "b": 1e2, "a'": 1.0, "b'": 1.0}, "deviation": {"Fa": 1e-3, "Fb": 1e-3}}


def check(controller: Controller, problem: fp.Problem, least: int = 1) -> None:
    """All numbers: what is refused decides what the loop is made of or is computed from, and at least so many can be live."""
    became = check_live(problem, controller, cycles=12)
    refused = [one for one in became.values() if isinstance(one, str)]
    assert [one for one in refused if not any(words in one for words in (*STRUCTURE, *COMPUTED))] == []
    assert sum(isinstance(one, float) for one in became.values()) >= least, became


def thinned(values: Any) -> list[Any]:
    """Every third in the quick lane, all in the slow one."""
    ids, slow = named([v.value or v if isinstance(v, Example) else v for v in values]), pytest.mark.slow
    return [pytest.param(v, id=ids[k], marks=() if k % 3 == 0 else slow) for k, v in enumerate(values)]


MAPS = [d for d in examples("deformations", SIGMOID) if d.effective_gain() >= 0]


@pytest.mark.parametrize("deformation", thinned(MAPS))
def test_every_number_of_a_deformation(deformation):
    check(fp.ComputedTorque(TRACKING, deformation), two_masses())


LAWS = examples("tracking laws")


@pytest.mark.parametrize("tracking", thinned(LAWS))
def test_every_number_of_a_tracking_law(tracking):
    check(fp.ComputedTorque(tracking, SIGMOID), two_masses())


CONTROLLERS = examples("controllers", fp.ComputedTorque(TRACKING, SIGMOID))


@pytest.mark.parametrize("member", thinned(CONTROLLERS))
def test_every_number_of_a_controller(member):
    """No controller, and no wrapper, loses a number on its way into the loop."""
    check(*on_problem(member))


SOLVERS = {
    "reduced gradient": fp.ReducedGradient(iterations=30, tolerance=1e-3),
    "gradient FPI": fp.GradientFixedPoint(iterations=5, tolerance=1e-3),
    "damped": fp.FixedPoint(iterations=1, tolerance=1e-3, damping=0.1),
    "solved": fp.FixedPoint(),  # to a tolerance that follows from the limits
}


@pytest.mark.parametrize("name", SOLVERS)
def test_weights_and_limits_of_an_optimiser_are_live(name):
    """They are data of the call; scale, step length and a tolerance that follows from limits are those of the build."""
    controller = fp.RecedingHorizon(SOLVERS[name], cost=fp.Quadratic(**WEIGHTS))
    tried = check_live(two_masses(), controller, paths=["cost.states.a", "limits.inputs.Fa.1"], cycles=30)
    assert all(isinstance(one, float) for one in tried.values()), tried


def test_what_python_computes_from_a_number_is_refused_by_path_and_place():
    """Beside it other numbers stay live."""
    one = fp.FixedPoint(iterations=1, tolerance=1e-3)
    computed = fp.RecedingHorizon(one, cost=fp.Quadratic(**WEIGHTS, terminal=fp.LQRTerminal()))
    with pytest.raises(
        NotSupported, match=r"'cost\.states\.a' cannot be live here: cost.weight needs its number while"
    ):
        fp.simulator(two_masses(), computed, live=["cost.states.a", "limits.inputs.Fa.1"], compiled=False)
    fp.simulator(two_masses(), computed, live=["limits.inputs.Fa.1"], compiled=False)
    with pytest.raises(NotSupported, match=r"'optimiser\.map\.gain' cannot be live here: .* needs its number while"):
        fp.simulator(two_masses(), computed, live=["optimiser.map.gain"], compiled=False)
    with pytest.raises(
        NotSupported, match=r"'estimator\.drift\.a' cannot be live here: .* needs its number while the loop"
    ):
        fp.simulator(two_masses(), KALMAN, live=["deformation.gain", "estimator.drift.a"], compiled=False)

    class Branching(fp.Affine):
        """Affine whose gain counts only where it is large."""

        def step(self, request, response, desired, memory):
            """Return r + (A_c / 2) (f - d), or r."""
            del memory
            return request + (0.5 * self.gain if self.gain < -0.1 else 0.0) * (response - desired), {}

    controller = fp.ComputedTorque(TRACKING, Branching(gain=-0.5))
    with pytest.raises(
        NotSupported, match=r"'deformation\.gain' cannot be live here: .*step needs its number while the loop"
    ):
        fp.simulator(two_masses(), controller, live=["tracking.rate", "deformation.gain"], compiled=False)


def test_the_switch_of_slots_may_be_live():
    """How fast the offset of a switch decays, and how fast a slot follows."""
    task = fp.load_problem("mass_spring_slots")
    problem = replace(task.problem, measure_from=0.0)
    tried = check_live(problem, task.controllers["slots"], paths=["blend", "slots.q2.tracking.rate"], cycles=60)
    assert all(isinstance(one, float) for one in tried.values()), tried


def test_a_symbol_turned_into_a_number_is_refused():
    """CasADi makes NaN of it without an error; the loop is never built."""

    class Lossy(fp.Affine):
        """Affine with its gain in a matrix of numbers."""

        def step(self, request, response, desired, memory):
            """Return r + (A_c / 2) (f - d)."""
            del memory
            return request + ca.DM([0.5 * self.gain]) * (response - desired) + 0 * self.gain * response, {}

    with pytest.raises(FpirhcError, match=r"deformation\.gain"):
        fp.simulator(two_masses(), fp.ComputedTorque(TRACKING, Lossy(gain=-0.5)), live=["deformation.gain"])
