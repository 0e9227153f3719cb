"""Every number of every member is open and runs as in the loop built with it, or is refused by its path and the place."""

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.forms import FORMS
from helpers.on_problem import named, on_problem

import fpirhc as fp
from fpirhc.conformance import Example, check_live, examples, two_masses
from fpirhc.contracts import Controller
from fpirhc.errors import FpirhcError, InvalidValue, NotSupported

SIGMOID = fp.Sigmoid(gain=-0.5, scale=50.0)
TRACKING = fp.Exponential(rate=8.0)
MEASURED = dict.fromkeys(("a", "b", "a'", "b'"), 1e-3)
KALMAN = fp.Estimating(
    fp.ComputedTorque(TRACKING, SIGMOID), fp.DisturbanceKalman({"a": 1.0, "b": 1.0}, MEASURED, noise={"a": 0.1})
)
STRUCTURE = "decides what the loop is made of", "does not use it"
COMPUTED = (  # by Python, and nothing else is
    "the weight of its past is computed",
    "the gain of the filter is computed",
    "the row of the Lyapunov equation is computed",
    "the step of the reference model is computed",
    "the terminal weight of LQRTerminal is computed",
    "the code of the optimiser is computed",
)
WEIGHTS: dict[str, Any] = {"states": {"a": 1e2, "b": 1e2, "a'": 1.0, "b'": 1.0}, "deviation": {"Fa": 1e-3, "Fb": 1e-3}}


def check(controller: Controller, problem: fp.Problem, least: int = 1) -> None:
    """All numbers: what is refused decides what the loop is made of or is computed from, and at least so many can be live."""
    tried = check_live(problem, controller, cycles=12)
    reasons = (*STRUCTURE, *COMPUTED)
    assert [t for t in tried if t.refused and not any(words in t.refused for words in reasons)] == []
    assert sum(t.factor is not None for t in tried) >= least, tried


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
    assert all(t.factor for t in tried), tried


def test_what_python_computes_from_a_number_is_refused_by_path_and_place():
    """Beside it other numbers stay live."""
    one = fp.FixedPoint(iterations=1, tolerance=1e-3)
    computed = fp.RecedingHorizon(one, cost=fp.Quadratic(**WEIGHTS, terminal=fp.LQRTerminal()))
    with pytest.raises(
        NotSupported, match=r"'cost\.states\.a' cannot be live here: the terminal weight of LQRTerminal is comp"
    ):
        fp.simulator(two_masses(), computed, live=["cost.states.a", "limits.inputs.Fa.1"], compiled=False)
    fp.simulator(two_masses(), computed, live=["limits.inputs.Fa.1"], compiled=False)
    with pytest.raises(
        NotSupported, match=r"'optimiser\.map\.gain' cannot be live here: the code of the optimiser is computed"
    ):
        fp.simulator(two_masses(), computed, live=["optimiser.map.gain"], compiled=False)
    with pytest.raises(
        NotSupported, match=r"'estimator\.drift\.a' cannot be live here: the gain of the filter is computed"
    ):
        fp.simulator(two_masses(), KALMAN, live=["controller.deformation.gain", "estimator.drift.a"], compiled=False)

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
    """How fast the offset of a switch decays, and which gain is too small to command with."""
    task = fp.load_problem("mass_spring_slots")
    problem = replace(task.problem, measure_from=0.0)
    tried = check_live(problem, task.controllers["slots"], paths=["blend", "smallest_gain"], cycles=60)
    assert all(t.factor for t in tried), tried


def noisy() -> fp.Problem:
    """Two masses with a noisy, coarse sensor that loses samples, and a noisy force."""
    problem = two_masses()
    sensor = fp.Sensor(noise=fp.Noise(1e-4), quantum=1e-3, dropout=0.2)
    sensing = fp.Sensing({problem.plant.output.elements[0]: sensor}, estimator=fp.PositionDifference())
    return replace(problem, sensing=sensing, disturbances={"Fa": fp.Noise(0.5)})


NOISES = [f"sensing.sensors.a.{name}" for name in ("noise.deviation", "dropout")] + ["disturbances.Fa.deviation"]
QUANTUM = "sensing.sensors.a.quantum"


@pytest.mark.parametrize("compiled", [False, True], ids=["VM", "C"])
def test_noises_and_sensors_are_live(compiled):
    paths = [*NOISES, QUANTUM]
    tried = check_live(noisy(), fp.ComputedTorque(TRACKING, SIGMOID), paths=paths, cycles=60, compiled=compiled)
    assert all(t.factor for t in tried), tried


@pytest.mark.parametrize("estimator", examples("derivative estimators"), ids=lambda one: type(one).__name__)
def test_a_quantum_is_live_behind_every_estimator(estimator):
    """A constant must not be multiplied by the estimator's weights where a symbol is not: a sample would jump by a quantum."""
    problem = two_masses()
    quanta = {name: fp.Sensor(quantum=3e-5) for name in estimator.measures(problem.plant)}
    problem = replace(problem, sensing=fp.Sensing(quanta, estimator))
    paths = [f"sensing.sensors.{name}.quantum" for name in quanta]
    tried = check_live(problem, fp.ComputedTorque(TRACKING, fp.Identity()), paths=paths, cycles=200)
    assert all(t.factor for t in tried), tried


OBSERVED = [("believed", "noise.w", "measured.y"), ("believed map", "noise.z", "measured.y")]


@pytest.mark.parametrize(("form", "noise", "sensor"), OBSERVED)
def test_every_number_of_an_observer(form, noise, sensor):
    controller = fp.ComputedTorque(fp.Exponential(rate=6.0), fp.Affine(gain=-0.2))
    tried = check_live(FORMS[form][0], controller, paths=[f"sensing.observer.{n}" for n in (noise, sensor)], cycles=30)
    assert all(t.factor for t in tried), tried


def test_the_poles_of_a_law_on_a_map_are_live():
    task = fp.load_problem("fishery")
    assert check_live(task.problem, task.controllers["CTC"], paths=["tracking.poles"], cycles=12)[0].factor


def test_a_noise_changes_during_a_run():
    """The drawn numbers are those of the seed, times the deviation in force; a sensor that loses none is another loop."""
    ready = fp.simulator(noisy(), fp.ComputedTorque(TRACKING, SIGMOID), live=NOISES, compiled=False)
    at = 20 * ready.problem.period
    plain, run = ready.run(seed=3), ready.run(seed=3, changes={at: {NOISES[2]: 5.0}})
    acting = [one["arriving" if "arriving" in one.layout.names else "command"] for one in (plain, run)]
    assert np.array_equal(plain["state"][:20], run["state"][:20])
    assert np.array_equal(acting[0][:20], acting[1][:20])
    assert not np.array_equal(plain["plant_state"][21], run["plant_state"][21])
    loud = ready.run(seed=3, settings={NOISES[2]: 5.0})
    assert not np.array_equal(loud["plant_state"][1], run["plant_state"][1])
    with pytest.raises(InvalidValue, match="loses samples"):
        ready.run(seed=3, settings={NOISES[1]: 0.0})


def test_a_symbol_turned_into_a_number_is_refused():
    """CasADi makes NaN of it without an error; the loop is never built."""

    class Lossy(fp.Affine):
        """Affine with its gain in a matrix of numbers."""

        def step(self, request, response, desired, memory):
            """Return r + (A_c / 2) (f - d)."""
            del memory
            return request + ca.DM([0.5 * self.gain]) * (response - desired) + 0 * self.gain * response, {}

    with pytest.raises(FpirhcError, match=r"deformation\.gain"):
        fp.simulate(
            two_masses(), fp.ComputedTorque(TRACKING, Lossy(gain=-0.5)), seed=0, settings={"deformation.gain": -0.4}
        )


# Plants whose inverse is Newton's


@pytest.mark.parametrize("plan", [False, True])
def test_every_setting_of_a_plant_with_newtons_inverse_is_live(plan):
    """A force that grows with the third power of the input: changed equals rebuilt, bit by bit in the virtual machine."""
    cubic = fp.Plant(
        coordinates={"y": "m"},
        inputs={"u": "N"},
        parameters={"b": fp.Parameter(1.0, 1.4, "1/kg")},
        response=lambda q, v, u, p: {"y": p.b * (u.u + 0.1 * u.u * u.u * u.u) - q.y},
    )
    problem = fp.Problem(
        plant=cubic,
        reference=fp.Trajectory(lambda t: {"y": ca.sin(3 * t)}),
        start={"y": 0.1},
        period=1e-3,
        duration=0.1,
        limits=fp.Limits(inputs={"u": (-50.0, 50.0)}),
        horizon=fp.Horizon(stages=2, step=1e-2),
        cost=fp.Quadratic(states={"y": 1e3, "y'": 1.0}, effort={"u": 1e-3}),
    )
    law, optimiser = fp.ComputedTorque(fp.Exponential(rate=6.0), SIGMOID), fp.FixedPoint(iterations=1, tolerance=1e-3)
    paths = ["deformation.gain", "cost.states.y" if plan else "tracking.rate", "limits.inputs.u.1"]
    tried = check_live(problem, fp.RecedingHorizon(optimiser, SIGMOID) if plan else law, paths=paths, cycles=20)
    assert all(one.factor for one in tried), tried
