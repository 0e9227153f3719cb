"""A body of MuJoCo behind a model of the textbook: the equations are MuJoCo's own, and adaptation pays where the model is wrong."""

from typing import Any

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.adapters.mujoco import mujoco_body
from fpirhc.errors import InvalidProblem

pytest.importorskip("mujoco", reason="it needs the extra fpirhc[outside]")

ARM = """<mujoco>
<option timestep="0.0005" integrator="{integrator}" gravity="0 0 -9.81"/>
<default><joint armature="{armature}" damping="{damping}" frictionloss="{friction}"/></default>
<worldbody><body>
  <joint name="shoulder" axis="0 -1 0"/><inertial pos="0.25 0 0" mass="2" diaginertia="1e-9 0.0416666667 0.0416666667"/>
  <body pos="0.5 0 0">
    <joint name="elbow" axis="0 -1 0"/><inertial pos="0.2 0 0" mass="1.2" diaginertia="1e-9 0.016 0.016"/>
    <body pos="0.4 0 0"><inertial pos="0 0 0" mass="{tool}" diaginertia="1e-9 1e-9 1e-9"/></body>
  </body>
</body></worldbody>
<actuator>
  <motor name="M1" joint="shoulder" ctrlrange="-80 80"/><motor name="M2" joint="elbow" ctrlrange="-40 40"/>
</actuator></mujoco>"""
RIGID = ARM.format(integrator="RK4", armature=0, damping=0, friction=0, tool=1e-9)
REAL = ARM.format(integrator="implicitfast", armature=0.03, damping=0.2, friction=0.4, tool=1.0)
PERIOD = 2e-3


def rods(q, v, u, p):
    """Two uniform rods in a vertical plane, without friction and tool."""
    a = p.m1 * 0.25 / 3 + p.m2 * 0.25 + p.m2 * 0.16 / 3
    b, c = p.m2 * 0.1, p.m2 * 0.16 / 3
    cosine, sine = ca.cos(q.elbow), ca.sin(q.elbow)
    mass = ca.blockcat([[a + 2 * b * cosine, c + b * cosine], [c + b * cosine, c]])
    turned = ca.vertcat(-b * sine * (2 * v.shoulder * v.elbow + v.elbow**2), b * sine * v.shoulder**2)
    outer = p.m2 * 9.81 * 0.2 * ca.cos(q.shoulder + q.elbow)
    weight = ca.vertcat((p.m1 / 2 + p.m2) * 9.81 * 0.5 * ca.cos(q.shoulder) + outer, outer)
    acceleration = ca.solve(mass, ca.vertcat(u.M1, u.M2) - turned - weight)
    return {"shoulder": acceleration[0], "elbow": acceleration[1]}


MODEL = fp.Plant(
    {"shoulder": "rad", "elbow": "rad"},
    {"M1": "N m", "M2": "N m"},
    {name: fp.Parameter(approximate=m, exact=m, unit="kg") for name, m in (("m1", 2.0), ("m2", 1.2))},
    rods,
)


def problem(mjcf: str, duration: float) -> fp.Problem:
    return fp.Problem(
        plant=MODEL,
        reality=mujoco_body(mjcf, MODEL, period=PERIOD),
        reference=fp.Trajectory(lambda t: {"shoulder": 0.8 * (1 - ca.cos(2 * t)), "elbow": -0.5 * (1 - ca.cos(3 * t))}),
        start={"shoulder": 0.0, "elbow": 0.0},
        period=PERIOD,
        duration=duration,
        measure_from=1.0,
        limits=fp.Limits(inputs={"M1": (-80.0, 80.0), "M2": (-40.0, 40.0)}),
    )


def test_a_frictionless_body_moves_as_the_textbook_says():
    body: Any = mujoco_body(RIGID, MODEL, period=PERIOD, start={"shoulder": 0.3, "elbow'": 1.5}).body
    seen = body.reset(0)
    assert seen[:4] == pytest.approx([0.3, 0.0, 0.0, 1.5])
    for k, command in enumerate(np.random.default_rng(1).uniform(-20, 20, (20, 2))):
        seen = body.step(k * PERIOD, command)
        assert seen[4:] == pytest.approx(accelerations(seen[:4], command), rel=1e-6)


def accelerations(state: np.ndarray, command: np.ndarray) -> np.ndarray:
    """The model's own response."""
    return np.asarray(MODEL.equations.response(state, command, MODEL.exact)).ravel()


def test_adaptation_pays_behind_dry_friction_and_a_tool_that_nobody_weighed():
    task = problem(REAL, 3.0)
    error = {}
    for name, deformation in {"alone": fp.Identity(), "adapted": fp.ModelReferenced(fp.Affine(gain=-0.3))}.items():
        run = fp.simulate(task, fp.ComputedTorque(fp.Exponential(rate=8.0), deformation), seed=0, compiled=False)
        assert run.stop is None
        error[name] = fp.measure(task, run).rms_error
    for joint in MODEL.coordinates:
        assert error["adapted"][joint] < 0.1 * error["alone"][joint]


def test_an_unstable_body_ends_the_run(tmp_path, monkeypatch):
    """MuJoCo puts it back to its start, from where the run went on and was complete."""
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a file of its warnings
    stiff = REAL.replace("<joint armature", '<joint stiffness="1e9" armature')
    reality = mujoco_body(stiff.replace("implicitfast", "Euler"), MODEL, period=PERIOD, start={"elbow": 1.0})
    for _run in range(2):
        reality.first(0)
        with pytest.raises(InvalidProblem, match=r"MuJoCo says that the simulation is unstable in the cycle from 0 s"):
            [reality.read(k * PERIOD, np.zeros(2)) for k in range(30)]


def test_a_file_is_read_too(tmp_path):
    (tmp_path / "arm.xml").write_text(REAL)
    measured: Any = mujoco_body(tmp_path / "arm.xml", MODEL, period=PERIOD).measures
    assert measured["elbow''"] == "rad/s^2"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"joints": {"elbow": "elbo"}}, "joint 'elbo' is unknown. Did you mean 'elbow'? Valid: shoulder, elbow."),
        ({"joints": {"elbo": "elbow"}}, "joints: name of the model 'elbo' is unknown. Did you mean 'elbow'?"),
        ({"actuators": {"M1": "M3"}}, "actuator 'M3' is unknown. Did you mean 'M2'?"),
        ({"start": {"elbow''": 1.0}}, "start: quantity 'elbow''' is unknown. Did you mean \"elbow'\"?"),
        (
            {"period": 1.7e-3},
            "a cycle of 0.0017 s is no whole number of its steps of 0.0005 s; choose a period of 0.0015 s",
        ),
    ],
)
def test_mistakes_are_named(arguments, message):
    with pytest.raises(InvalidProblem) as caught:
        mujoco_body(REAL, MODEL, **{"period": PERIOD, **arguments})
    assert message in str(caught.value)
