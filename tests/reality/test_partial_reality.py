"""A reality with other states than the model: it needs only what is measured, controlled or judged; the rest is believed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm

import fpirhc as fp
from fpirhc.errors import InvalidProblem, NotSupported

PERIOD, PARAMETERS = 0.05, {"b": fp.Parameter(approximate=1.0, exact=1.3, unit="1/l")}
FILTER = fp.KalmanFilter(measured={"c1": 1e-4}, noise={"c1": 1.0, "c2": 0.01})
BELIEVED = fp.Sensing(measured=["c1", "c1'"], observer=FILTER)
TRACK = fp.ComputedTorque(fp.Exponential(rate=1.0))
FPI = fp.Sigmoid(gain=-0.8, scale=20.0)


def compartments(deep: str = "c2") -> fp.Plant:
    """A drug in blood and in a tissue, whose name is free."""

    def response(q: Any, u: Any, p: Any) -> dict[str, Any]:
        return {"c1": p.b * u.u - 0.5 * q.c1 + 0.2 * q[deep], deep: 0.3 * q.c1 - 0.2 * q[deep]}

    return fp.Plant(
        coordinates={"c1": "mg/l", deep: "mg/l"},
        inputs={"u": "mg/min"},
        order=1,
        controlled=("c1",),
        parameters=PARAMETERS,
        response=response,
        time_unit="min",
    )


def three() -> fp.Plant:
    """The same drug with two tissues, neither of them the model's."""
    return fp.Plant(
        coordinates={"c1": "mg/l", "fast": "mg/l", "slow": "mg/l"},
        inputs={"u": "mg/min"},
        order=1,
        controlled=("c1",),
        parameters=PARAMETERS,
        response=lambda q, u, p: {
            "c1": p.b * u.u - 0.7 * q.c1 + 0.4 * q.fast + 0.05 * q.slow,
            "fast": 0.3 * q.c1 - 0.4 * q.fast,
            "slow": 0.1 * q.c1 - 0.05 * q.slow,
        },
        time_unit="min",
    )


def task(**changes: Any) -> fp.Problem:
    """Blood along a sine; the tissue is nobody's to measure."""
    settings: dict[str, Any] = {
        "plant": compartments(),
        "reference": fp.Trajectory(lambda t: {"c1": 2 + 0.3 * ca.sin(t / 2), "c2": 3 + 0 * t}),
        "start": {"c1": 2.0, "c2": 3.0},
        "period": PERIOD,
        "duration": 20.0,
        "sensing": BELIEVED,
        "limits": fp.Limits(inputs={"u": (0.0, 20.0)}),
        "horizon": fp.Horizon(stages=8, step=5 * PERIOD),
        "cost": fp.Quadratic(states={"c1": 10.0}, rate={"u": 1e-3}),
    }
    return fp.Problem(**(settings | changes))


def other(**changes: Any) -> fp.Problem:
    """The task with the three compartments as reality, settled."""
    return task(reality=fp.Reality(three(), start={"fast": 1.5, "slow": 4.0}), **changes)


def run(problem: fp.Problem, controller: Any = TRACK) -> fp.Run:
    return fp.simulate(problem, controller, seed=0, compiled=False)


@pytest.mark.parametrize(
    "controller",
    [replace(TRACK, deformation=FPI), fp.RecedingHorizon(fp.FixedPoint(iterations=2, tolerance=1e-4), FPI)],
    ids=["computed torque", "receding horizon"],
)
def test_what_nobody_measures_may_have_any_name(controller):
    """The same equations with the tissue under another name: the controller is given the same, so every signal is the same."""
    whole = run(task(duration=3.0, reality=fp.Reality(compartments())), controller)
    renamed = run(task(duration=3.0, reality=fp.Reality(compartments("deep"), start={"deep": 3.0})), controller)
    for name in set(renamed.layout.names) - {"plant_state", "reality_state", "cost"}:
        np.testing.assert_array_equal(renamed[name], whole[name], err_msg=name)
    assert renamed.layout["plant_state"].elements == ("c1",)
    np.testing.assert_array_equal(renamed["plant_state.c1"], whole["plant_state.c1"])


def test_it_moves_by_its_own_equations():
    """The commands of the run, held over each cycle, move its exact discretisation alike."""
    result = run(other(), replace(TRACK, deformation=FPI))
    a = np.array([[-0.7, 0.4, 0.05], [0.3, -0.4, 0.0], [0.1, 0.0, -0.05]])
    whole = expm(np.block([[a, np.array([[1.3], [0], [0]])], [np.zeros((1, 4))]]) * PERIOD)
    x, states = np.array([2.0, 1.5, 4.0]), []
    for u in np.asarray(result["command"]).ravel():
        states.append(x)
        x = whole[:3, :3] @ x + whole[:3, 3] * u
    np.testing.assert_allclose(result["reality_state"], states, rtol=1e-8)
    assert result.layout["reality_state"].elements == ("c1", "fast", "slow")
    np.testing.assert_array_equal(result["true_error.c1"], result["reference.c1"] - result["reality_state.c1"])


def test_the_belief_is_nobodys_state():
    """Blood is given nearly as it is measured; the tissue follows from the model, and no tissue of the reality is like it."""
    result = run(other())
    np.testing.assert_allclose(result["state.c1"], result["plant_state.c1"], atol=1e-3)
    assert np.ptp(result["state.c2"]) > 0.1
    for own in ("fast", "slow"):
        assert np.abs(result["state.c2"] - result[f"reality_state.{own}"]).max() > 0.5


def test_adaptation_helps_where_the_model_has_too_few_states():
    """The response is measured, so the deformation sees what the model lacks: the error is four times smaller."""
    problem = other(measure_from=2.0)
    errors = [
        fp.measure(problem, run(problem, replace(TRACK, deformation=d))).rms_error["c1"] for d in (fp.Identity(), FPI)
    ]
    assert errors[1] < 0.25 * errors[0]


def test_no_cost_of_states_that_do_not_exist():
    """A plan has the believed tissue; a run is judged by its error, and its cost is left out."""
    assert "cost" not in run(other(duration=0.5)).layout
    assert "cost" in run(task(duration=0.5)).layout


def test_comparison_and_report(tmp_path):
    """Both take a reality with other states; its own states are on the page."""
    problem, fpi = other(duration=1.0), replace(TRACK, deformation=FPI)
    file = replace(
        fp.load_problem("two_mass"), problem=problem, controllers={"CTC": TRACK, "FPI": fpi}, headline=("CTC", "FPI")
    )
    comparison = fp.compare(file, seed=0, compiled=False)
    fp.write_report(comparison, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "reality: fast" in page
    assert "reality: slow" in page


MISTAKES = {
    "measured": (
        lambda: task(
            reality=fp.Reality(
                replace(
                    three(), coordinates={"C": "mg/l"}, controlled=("C",), response=lambda q, u, p: {"C": p.b * u.u}
                )
            )
        ),
        r"no coordinate 'c1'",
    ),
    "not believed": (
        lambda: other(sensing=fp.Sensing()),
        r"no coordinate 'c2'.* or have it believed: Sensing\(measured",
    ),
    "judged": (lambda: other(judged=["c1", "c2"]), r"no coordinate 'c2'"),
    "unit": (
        lambda: task(reality=fp.Reality(replace(compartments(), coordinates={"c1": "mg/l", "c2": "g/l"}))),
        r"its coordinate 'c2' is in g/l, the model's 'c2' in mg/l",
    ),
    "no start": (
        lambda: task(reality=fp.Reality(three(), start={"fast": 1.5})),
        r"does not have: slow; give their first values: Reality\(start=\{'slow': ...\}\)",
    ),
    "start": (lambda: task(reality=fp.Reality(three(), start={"c2": 1.0})), r"start: state 'c2' is unknown"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_are_named(mistake):
    make, message = MISTAKES[mistake]
    with pytest.raises(InvalidProblem, match=f"(?s){message}"):
        make()


def test_it_is_no_exact_model():
    """A controller that is given c1 and a believed c2 cannot have a model with other tissues."""
    with pytest.raises(
        NotSupported, match=r"fast, which the controller is not given.*no coordinate c2, which the model has"
    ):
        run(other(), fp.ExactModel(TRACK))
