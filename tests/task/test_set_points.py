"""References: set-points whose filter is exact, disturbances, the input before the first cycle, and other exact parameters."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers import tasks
from helpers.plants import chain, heavy, simulated

import fpirhc as fp
from fpirhc.contracts import Disturbance
from fpirhc.errors import InvalidName

STEPS = {"q1": [(0.0, 2.2), (0.1, 2.4)], "q2": [(0.0, 5.4), (0.1, 5.6), (0.2, 5.3)]}


def on(problem, reference, duration=0.3):
    """The problem with another reference, judged from its start."""
    return replace(problem, reference=reference, duration=duration, measure_from=0.0)


def two_mass(duration=0.3, **changes):
    """two_mass with set-points that change."""
    return on(tasks.two_mass.problem, fp.Setpoint(**{"values": STEPS, "rate": 10.0, **changes}), duration)


def closed_form(rate, order, starts, steps):
    """The filter's motion as a trajectory: y = w_0 + sum change (1 - e^(-a s) sum_{k<m} (a s)^k / k!), s: time since a change."""

    def rise(t, at):
        s, term, terms = t - at, 1.0, 1.0
        for k in range(1, order):
            term = term * rate * s / k
            terms = terms + term
        return ca.if_else(t >= at * (1 - 1e-12), 1 - ca.exp(-rate * s) * terms, 0)

    def motion(t):
        values = {}
        for name, start in starts.items():
            levels = [start, *(w for _, w in steps[name])]
            changes = [(at, new - old) for (at, new), old in zip(steps[name], levels[:-1], strict=True)]
            values[name] = start + sum(change * rise(t, at) for at, change in changes if change)
        return values

    return fp.Trajectory(motion)


@pytest.mark.parametrize("order", [2, 3])
def test_nominal_motion_is_the_closed_form(order):
    """What is judged before a run is the closed form with its derivatives by differentiation."""
    steps = {"y": [(0.0, 0.3), (0.1, 1.0), (0.5, -0.5), (1.25, 2.0)]}
    ours = fp.Setpoint(steps, rate=4.0, order=order).function(chain(2))
    expected = closed_form(4.0, order, {"y": 0.3}, steps).function(chain(2))
    for t in (0.0, 0.2, 0.7, 1.5, 4.0):
        for result, value in zip(ours(t), expected(t), strict=True):
            np.testing.assert_allclose(result.full(), value.full(), rtol=0, atol=2e-13)


SHIPPED = {
    "two_mass": ({"q1": 2.4, "q2": 5.2}, 2),
    "mrac_pendulum": ({"angle": 0.5}, 2),
    "cart_pole": ({"cart": 0.2, "angle": 0.0}, 2),
    "cart_pole_slots": ({"cart": -0.05, "angle": 0.0}, 4),
}


@pytest.mark.parametrize("name", SHIPPED)
def test_every_controller_follows_a_set_point_as_the_trajectory_of_the_filter(name):
    """The same motion as a trajectory: only rounding differs. A horizon would know the trajectory ahead."""
    task, (aims, order) = getattr(tasks, name), SHIPPED[name]
    problem = task.problem
    starts = {c: float(problem.start.get(c, 0.0)) for c in problem.plant.names}
    rate = 8.0
    steps = {c: [(0.0, starts[c]), (problem.period, w)] for c, w in aims.items()}
    ours = on(problem, fp.Setpoint(steps, rate=rate, order=order), 0.2)
    theirs = on(problem, closed_form(rate, order, starts, steps), 0.2)
    for controller in (one for one in task.controllers.values() if one.planner is None):
        runs = [simulated(p, controller) for p in (ours, theirs)]
        assert runs[0].cycles == runs[1].cycles > 0
        states = [run["plant_state"] for run in runs]
        assert np.ptp(states[1], axis=0).max() > 1e-3, controller  # it does move
        scale = np.maximum(1.0, np.abs(states[1]).max())
        assert np.abs(states[0] - states[1]).max() < 1e-12 * scale, controller
        np.testing.assert_allclose(runs[0]["reference"], runs[1]["reference"], 0, 1e-12, err_msg=repr(controller))
        costs = [fp.measure(p, run)["cost"] for p, run in zip((ours, theirs), runs, strict=True)]
        assert costs[0] == pytest.approx(costs[1], rel=1e-6)


def test_a_horizon_knows_no_set_point_ahead():
    """A step moves nothing before its time, and the command in its first cycle."""
    controller, starts = tasks.two_mass.controllers["RHC+FPI"], {"q1": 2.2, "q2": 5.4}
    steps = {"q1": [(0.0, 2.2), (0.25, 2.4)], "q2": [(0.0, 5.4), (0.25, 5.2)]}
    surprise, still = (simulated(two_mass(values=values), controller) for values in (steps, starts))
    np.testing.assert_array_equal(surprise["command"][:250], still["command"][:250])
    assert np.abs(surprise["command"][250] - still["command"][250]).max() > 0.1


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("controller", ["CTC+FPI (eq 6)", "RHC+FPI"])
def test_changed_equals_rebuilt_without_another_build(controller, compiled):
    """Other set-points in one loop are bit by bit the loop that is built with them."""
    # The first horizon ends at 0.2 s: scale and first plan of both are those of the same nominal motion.
    others = {"q1": [(0.0, 2.2), (0.22, 2.5)], "q2": [(0.0, 5.4), (0.25, 5.1)]}
    quiet = two_mass(values={"q1": 2.2, "q2": 5.4})
    ready = fp.simulator(quiet, tasks.two_mass.controllers[controller], compiled=compiled)
    first, changed = ready.run(seed=0), ready.run(seed=0, setpoints=others)
    rebuilt = fp.simulate(two_mass(values=others), tasks.two_mass.controllers[controller], seed=0, compiled=compiled)
    np.testing.assert_array_equal(changed["command"], rebuilt["command"])
    np.testing.assert_array_equal(changed["reference"], rebuilt["reference"])
    assert np.abs(changed["command"] - first["command"]).max() > 0.1
    np.testing.assert_array_equal(first["setpoint"], np.tile([2.2, 5.4], (300, 1)))


def test_stepper_agrees_with_the_loop():
    """Stepped with what the loop saw, and with the set-points when they change, the stepper gives the loop's commands."""
    problem, controller = two_mass(), tasks.two_mass.controllers["CTC+FPI (eq 6)"]
    run = simulated(problem, controller)
    stepper = fp.Stepper(problem, controller, compiled=False)
    memory = stepper.start()
    for k in range(run.cycles):
        points = {name: [v for at, v in steps if at <= run.time[k] + 1e-9][-1] for name, steps in STEPS.items()}
        sample = run["state"][k].copy(), run["realised"][k].copy()
        command, memory = stepper.step(run.time[k], *sample, memory, setpoints=points)
        np.testing.assert_array_equal(command, run["command"][k])
    assert stepper.refused == 0


def test_a_step_without_set_points_keeps_the_old_ones():
    """Refused set-points leave all old ones in force, are counted, and have a reason."""
    problem = two_mass(values={"q1": 2.2, "q2": 5.4})
    problem = replace(problem, limits=replace(problem.limits, states={"q1": (1.0, 3.0)}))
    stepper = fp.Stepper(problem, tasks.two_mass.controllers["CTC"], compiled=False)
    sample = 0.0, problem.start_state, np.zeros(2), stepper.start()
    stepper.step(*sample, setpoints={"q1": 2.5})
    assert stepper.setpoints == {"q1": 2.5, "q2": 5.4}
    bad: list[tuple[Any, str]] = [(np.nan, "nan, expected a finite"), (3.5, "limits of 1 to 3"), ("x", "number")]
    bad.append(([1.0, 2.0], "number"))
    for k, (value, words) in enumerate(bad):
        stepper.step(*sample, setpoints={"q1": value, "q2": 5.5})
        assert stepper.setpoints == {"q1": 2.5, "q2": 5.4}
        assert stepper.refused == k + 1
        assert words in stepper.why_refused
    assert stepper.trace()["setpoint"].tolist() == [2.5, 5.4]
    with pytest.raises(InvalidName, match=r"'q3' is unknown\. Did you mean"):
        stepper.step(*sample, setpoints={"q3": 1.0})


def test_run_and_file_record_what_was_in_force(tmp_path):
    """Signal 'setpoint' has it cycle by cycle, the facts have it as steps; the terminal shows it."""
    run = fp.simulate(
        two_mass(),
        tasks.two_mass.controllers["CTC"],
        seed=0,
        compiled=False,
        setpoints={"q1": [(0.0, 2.2), (0.0505, 2.3)]},
    )
    run.save(tmp_path / "run.npz")
    again = fp.load_run(tmp_path / "run.npz")
    np.testing.assert_array_equal(again["setpoint.q1"], np.where(np.arange(300) < 51, 2.2, 2.3))
    assert again.settings["setpoints"] == {"q1": [[0.0, 2.2], [0.0505, 2.3]], "q2": [list(p) for p in STEPS["q2"]]}


def test_a_slot_has_the_filter_of_its_chain():
    """Of rate a and order r a filter at rest begins with y^(r) = a^r (w - y): r = 2 for the lower tank, 1 for the upper one."""
    task, rate = fp.load_problem("two_tanks_slots"), 0.05
    reference = fp.Setpoint(
        {n: [(0.0, 5.0), (task.problem.period, w)] for n, w in (("h1", 2.5), ("h2", 3.6))}, rate=rate
    )
    run = simulated(on(task.problem, reference, 1.0), task.controllers["slots"])
    assert [run[f"nominal.{name}"][1] for name in ("h2", "h1")] == pytest.approx([rate**2 * -1.4, rate * -2.5])


def test_predicted_says_that_set_points_are_late():
    """With dead time the plant follows later by it; without adaptation errors it is the same motion, shifted."""
    task = fp.load_problem("delayed_mass")
    name = task.problem.plant.names[0]
    problem = on(task.problem, fp.Setpoint({name: [(0.0, 0.0), (0.2, 0.3)]}, rate=6.0), 1.0)
    controller = task.controllers["CTC+FPI increment"]
    notes = controller.notes(problem)
    assert any("follows set-points 0.06 s late" in note for note in notes)
    assert not any("late" in note for note in controller.notes(task.problem))
    exact = fp.ExactModel(controller)
    run = simulated(problem, exact)
    late = round(0.06 / problem.period)
    lag = run[f"plant_state.{name}"][late:] - run[f"reference.{name}"][:-late]
    assert np.abs(lag).max() < 0.2 * np.abs(run[f"true_error.{name}"]).max()


def test_derivatives_up_to_the_order():
    """For y = sin 2t the k-th derivative is 2^k sin(2t + k pi/2)."""
    state, response = fp.Trajectory(lambda t: {"y": ca.sin(2 * t)}).function(chain(4))(0.3)
    result = np.append(state.full().ravel(), float(response))
    expected = [2**k * np.sin(0.6 + k * np.pi / 2) for k in range(5)]
    np.testing.assert_allclose(result, expected, rtol=1e-12, equal_nan=False)


# Disturbances: what they are at which time
TIMES = np.linspace(0, 2, 21)


def _values(disturbance, seed=0):
    return disturbance.values(TIMES, np.random.default_rng(seed))


def test_disturbances_have_their_values():
    """Edges are where they were asked for, noise is drawn from the seed, and a formula is its own."""
    assert _values(fp.Step(at=1.0, size=3.0)).tolist() == [0.0] * 10 + [3.0] * 11
    assert _values(fp.Step(at=0.5, duration=0.5, size=2.0)).sum() == pytest.approx(10.0)
    assert np.array_equal(_values(fp.Noise(1.0), 4), _values(fp.Noise(1.0), 4))
    assert not np.array_equal(_values(fp.Noise(1.0), 4), _values(fp.Noise(1.0), 5))
    np.testing.assert_allclose(_values(fp.Formula(lambda t: ca.exp(-t))), np.exp(-TIMES), equal_nan=False)


def test_a_disturbance_of_a_users_own_acts_with_its_values():
    """A sawtooth on the response of y'' = 0: the speed is its integral, cycle by cycle."""

    class Sawtooth(Disturbance):
        def values(self, times, random):  # noqa: ARG002
            return 3.0 * np.mod(times + 1e-12, 0.5)

    reference = fp.Trajectory(lambda t: {"y": 0 * t})
    problem = fp.Problem(chain(2), reference, {"y": 0.0}, 0.1, 2.0, disturbances={"y": Sawtooth()})
    still = fp.ComputedTorque(fp.Exponential(rate=1e-9, integral=False))
    speed = simulated(problem, still)["state.y'"]
    acting = 3.0 * np.mod(0.1 * np.arange(20) + 1e-12, 0.5)
    np.testing.assert_allclose(speed, 0.1 * np.concatenate([[0.0], np.cumsum(acting)[:-1]]), atol=1e-7)


# The input before the first cycle
MASS, PERIOD = 2.0, 1e-2
COST = fp.Quadratic(states={"y": 1.0}, effort={"u": 1e-3})
PROBLEM = fp.Problem(
    plant=heavy(MASS, MASS, q="y"),
    reference=fp.Trajectory(lambda t: {"y": 1.0 + 0.0 * ca.sin(t)}),
    start={"y": 1.0},
    period=PERIOD,
    duration=0.2,
    horizon=fp.Horizon(stages=5, step=PERIOD),
    cost=COST,
)


def test_it_is_zero_or_the_nearest_limit_unless_it_is_given():
    for limits, given, expected in (
        ({}, {}, 0.0),
        ({"u": (2.0, 9.0)}, {}, 2.0),
        ({"u": (-9.0, -3.0)}, {}, -3.0),
        ({"u": (2.0, 9.0)}, {"u": 5.0}, 5.0),
    ):
        problem = replace(PROBLEM, limits=fp.Limits(inputs=limits), input_before=given)
        assert problem.inputs_before.tolist() == [expected]


def test_the_first_weight_of_a_rate_is_counted_from_it():
    """With a rate weight that outweighs everything else the first input stays where the input was."""
    short = replace(PROBLEM, cost=replace(COST, rate={"u": 1e9}), duration=PERIOD)
    for before in (0.0, 3.0, -7.0):
        for optimiser in (fp.Ipopt(), fp.FixedPointSolver(iterations=3, tolerance=1e-3)):
            run = simulated(replace(short, input_before={"u": before}), fp.RecedingHorizon(optimiser))
            assert run["command.u"][0] == pytest.approx(before, abs=1e-4)


def test_it_acts_until_the_first_command_arrives():
    """A mass under a constant force: y = 1 + u t^2 / (2 m) for as long as no command has arrived, by hand."""
    waiting = 0.1
    late = replace(PROBLEM, dead_time=fp.DeadTime(inputs={"u": waiting}), input_before={"u": 3.0})
    run = simulated(late, fp.ComputedTorque(fp.Exponential(rate=6.0)))
    times = run.time[run.time <= waiting + PERIOD / 2]
    np.testing.assert_allclose(run["plant_state.y"][: times.size], 1 + 3.0 * times**2 / (2 * MASS), rtol=1e-12)


LOOPS = {"two_mass": "RHC+FPI", "tumour": "RHC+FPI", "crane_slots": "slots+FPI"}


@pytest.mark.parametrize("name", LOOPS)
def test_a_run_of_what_is_shared_is_that_of_the_problem_that_is_built_anew(name):
    """Of the plant that moves and of the model that becomes it, after the first problem has run."""
    task = fp.load_problem(name)
    problem = replace(task.problem.of_model, duration=15 * task.problem.period, measure_from=0.0)
    plain, known = task.controllers[LOOPS[name]], fp.ExactModel(task.controllers[LOOPS[name]])
    first = simulated(problem, plain)
    exact = problem.plant.exact * 1.05
    values = zip(problem.plant.parameters.items(), exact, strict=True)
    anew = replace(
        problem, plant=replace(problem.plant, parameters={n: replace(p, exact=float(v)) for (n, p), v in values})
    )
    for controller in (plain, known):
        one, other = (simulated(p, controller) for p in (problem.with_exact(exact), anew))
        np.testing.assert_array_equal(one.log, other.log)
        assert not np.array_equal(one["plant_state"], first["plant_state"])
    np.testing.assert_array_equal(simulated(problem, plain).log, first.log)


# Refusals
LIMITED = replace(tasks.two_mass.problem.limits, states={"q1": (2.0, 2.3)})


def begun(before: dict[str, float]) -> fp.Problem:
    return replace(PROBLEM, limits=fp.Limits(inputs={"u": (-10.0, 10.0)}), input_before=before)


REFUSED: dict[str, Callable[[], Any]] = {
    r"(?s)'z' is unknown.*'y' has no nominal motion": lambda: fp.Trajectory(lambda t: {"z": t}).function(chain(2)),
    "'q2' has no nominal motion": lambda: two_mass(values={"q1": 1.0}),
    "'q4' is unknown": lambda: two_mass(values={"q1": 1.0, "q2": 2.0, "q4": 1.0}),
    "below the order 2": lambda: two_mass(order=1),
    r"'q1' is 2\.4, outside its limits of 2 to 2\.3": lambda: replace(two_mass(), limits=LIMITED),
    "a Trajectory, has no set-points": lambda: fp.simulate(
        tasks.two_mass.problem, tasks.two_mass.controllers["CTC"], seed=0, compiled=False, setpoints={"q1": 1.0}
    ),
    "not finite at t = 0": lambda: _values(fp.Formula(lambda t: 1 / t)),
    "input_before: input 'w' is unknown": lambda: begun({"w": 1.0}),
    r"'u' must be a finite number within its limits, got 99\.0": lambda: begun({"u": 99.0}),
    "finite number within its limits, got inf": lambda: begun({"u": float("inf")}),
}


@pytest.mark.parametrize("words", REFUSED)
def test_a_mistake_is_named(words):
    replace(two_mass(), limits=replace(LIMITED, prices={"q1": 1.0}))  # a limit with a price may be passed
    with pytest.raises(fp.FpirhcError, match=words):
        REFUSED[words]()
