"""A coordinate and an input may have one name, as a joint and its motor do: nothing but the name differs."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.conformance import check_plant, examples
from fpirhc.contracts import Controller
from fpirhc.errors import FpirhcError, InvalidProblem, NotContractive

JOINTS = ("shoulder", "elbow")
CONTROLLER = fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-3), fp.ModelReferenced(fp.Affine(gain=-0.5)))


def joints(motors: tuple[str, str], keys: tuple[str, str, str], **changes) -> fp.Problem:
    """Two joints with these motors; disturbances of the first motor and joint, and the price of the rate of that motor."""

    def response(q, v, u, p):
        first, second = (getattr(u, name) for name in motors)
        return {"shoulder": (first - 0.3 * second) / p.m - ca.sin(q.shoulder), "elbow": second / p.m - 0.1 * v.elbow}

    plant = fp.Plant(
        coordinates=dict.fromkeys(JOINTS, "rad"),
        inputs=dict.fromkeys(motors, "N m"),
        parameters={"m": fp.Parameter(1.0, 1.3, "kg m^2")},
        response=response,
    )
    of_motor, of_joint, rate = keys
    settings = {
        "disturbances": {
            of_motor: fp.Step(at=0.05, size=0.7),
            of_joint: fp.Formula(lambda t: 0.4 * ca.sin(2 * np.pi * 3.0 * t)),
        },
        "limits": fp.Limits(
            inputs=dict.fromkeys(motors, (-5.0, 5.0)),
            states={"shoulder": (-2.0, 2.0)},
            rates={motors[0]: (-60.0, 60.0)},
            prices={"shoulder": 10.0, rate: 1e-3},
        ),
        **changes,
    }
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"shoulder": ca.sin(2 * t), "elbow": ca.cos(2 * t)}),
        start={"shoulder": 0.0, "elbow": 1.0},
        period=0.01,
        duration=0.3,
        horizon=fp.Horizon(stages=5, step=0.01),
        cost=fp.Quadratic(states=dict.fromkeys(JOINTS, 10.0), deviation=dict.fromkeys(motors, 1e-3)),
        **settings,
    )


SHARED = joints(JOINTS, ("input shoulder", "coordinate shoulder", "shoulder rate"))
OTHER = joints(("M1", "M2"), ("M1", "shoulder", "M1"))


FORMS = {
    "late": lambda one: replace(one, dead_time=fp.DeadTime(measurement=0.01)),
    "encoder": lambda one: replace(one, sensing=fp.Sensing(estimator=fp.PositionDifference())),
    "another plant": lambda one: replace(one, reality=fp.Reality(one.plant)),
}
MAPS = examples("deformations", fp.Affine(gain=-0.3))[::4]


@pytest.mark.parametrize(
    "form", [None, *FORMS, *MAPS], ids=lambda one: one if isinstance(one, str) else type(one).__name__
)
def test_a_run_is_that_of_other_names(form):
    """Every signal of the run is bit for bit that of motors with names of their own, in every form; what is refused is, too."""
    controller = (
        CONTROLLER if form is None or isinstance(form, str) else fp.ComputedTorque(fp.Exponential(rate=3.0), form)
    )
    pair = [SHARED, OTHER]
    if isinstance(form, str):
        pair = [FORMS[form](one) for one in pair]
    shared, other = (outcome(one, controller) for one in pair)
    if isinstance(shared, type) or isinstance(other, type):
        assert shared is other is NotContractive  # examples with a gain of the other sign
        return
    assert shared.layout.names == other.layout.names
    for name in other.layout.names:
        if not name.endswith("_time"):  # wall time
            assert np.array_equal(shared[name], other[name], equal_nan=True), name


def outcome(problem: fp.Problem, controller: Controller) -> fp.Run | type[FpirhcError]:
    """The run, or the class of the refusal."""
    try:
        return fp.simulate(problem, controller, seed=0, compiled=False)
    except FpirhcError as error:
        return type(error)


def test_disturbances_act_where_they_are_said_to():
    """With the disturbance of one kind alone the run differs from that with the other one."""
    runs = [
        fp.simulate(replace(SHARED, disturbances={key: fp.Step(at=0.05, size=0.7)}), CONTROLLER, seed=0, compiled=False)
        for key in ("input shoulder", "coordinate shoulder")
    ]
    assert not np.allclose(runs[0]["state"], runs[1]["state"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"disturbances": {"elbow": fp.Step(at=0.1, size=1.0)}},
            "input, coordinate or output 'elbow' is unknown. Did you mean 'input elbow'",
        ),
        ({"disturbances": {"input elbo": fp.Step(at=0.1, size=1.0)}}, "Did you mean 'input elbow'"),
        (
            {"limits": fp.Limits(rates={"elbow": (-1.0, 1.0)}, prices={"elbow": 1.0})},
            "prices: limit of 'elbow' is unknown. Did you mean 'elbow rate'",
        ),
    ],
)
def test_a_bare_name_is_refused_where_it_is_ambiguous(changes, message):
    with pytest.raises(InvalidProblem, match=message):
        replace(SHARED, **changes)


def test_a_box_of_a_plant_has_both():
    """Points are drawn from the interval of the joint and of its motor."""
    check_plant(SHARED.plant, seed=0, box={"elbow": (-0.5, 0.5), "input elbow": (2.0, 3.0)})


def test_a_review_is_that_of_other_names():
    shared, other = (fp.review(one, {"FPI": CONTROLLER}, mismatch=10.0, seed=0) for one in (SHARED, OTHER))
    for ours, theirs in ((shared.answers[n], other.answers[n]) for n in ("problem", "FPI")):
        assert [one.verdict for one in ours] == [one.verdict for one in theirs]
        assert [list(one.numbers.values()) for one in ours] == [list(one.numbers.values()) for one in theirs]
