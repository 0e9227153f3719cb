"""An arm from its URDF: joints that turn, slide and stand, against the equations of Pinocchio."""

from __future__ import annotations

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.adapters.urdf import arm
from fpirhc.errors import InvalidProblem

pinocchio = pytest.importorskip("pinocchio", reason="it needs the extra fpirhc[outside]")

LINK = """<link name="{name}"><inertial><origin xyz="{at}" rpy="{rpy}"/><mass value="{mass}"/>
<inertia ixx="0.02" ixy="0.001" ixz="-0.002" iyy="0.03" iyz="0.0015" izz="0.025"/></inertial></link>"""
JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
<origin xyz="{at}" rpy="{rpy}"/><axis xyz="{axis}"/><limit effort="50" velocity="3" lower="-2" upper="2"/>{more}</joint>"""


def joint(name, kind, parent, child, at, rpy, axis, more=""):
    return JOINT.format(name=name, kind=kind, parent=parent, child=child, at=at, rpy=rpy, axis=axis, more=more)


LINKS = "".join(
    LINK.format(name=name, at=at, rpy=rpy, mass=mass)
    for name, at, rpy, mass in (
        ("upper", "0 0.02 0.2", "0.1 0 0.3", 3.0),
        ("fore", "0.15 0 0.01", "0 0.4 0", 2.0),
        ("slide", "0 0 0.05", "0 0 0", 0.8),
        ("hand", "0.01 0 0.04", "0.2 0.1 0", 0.5),
        ("finger", "0 0.01 0.02", "0 0 1", 0.1),
    )
)
TEXT = (
    "<robot name='one'><link name='base'/>"
    + joint("wrist", "prismatic", "fore", "slide", "0.3 0 0", "0 1.2 0", "1 0 1")  # not in the order of the tree
    + LINKS
    + joint("shoulder", "revolute", "base", "upper", "0 0 0.4", "0 0 0.5", "0 1 0", "<dynamics damping='0.4'/>")
    + joint("elbow", "continuous", "upper", "fore", "0 0 0.4", "0.3 0 0", "0 0 1")
    + joint("flange", "fixed", "slide", "hand", "0 0 0.1", "0 0.7 0", "1 0 0")
    + joint("grip", "revolute", "hand", "finger", "0 0 0.08", "0 0 0", "1 1 0")
    + "</robot>"
)
NAMES = ("shoulder", "elbow", "wrist", "grip")


def test_the_equations_are_those_of_pinocchio():
    """Accelerations under random torques, and torques for random accelerations, to rounding."""
    plant, random = arm(TEXT), np.random.default_rng(2)
    model = pinocchio.buildModelFromXML(TEXT)
    data = model.createData()
    assert set(plant.coordinates) == set(NAMES)
    inputs = {name: f"{name}_{'force' if name == 'wrist' else 'torque'}" for name in plant.coordinates}
    for _ in range(5):
        q, v, u = (dict(zip(plant.coordinates, random.uniform(-1.5, 1.5, 4), strict=True)) for _ in range(3))
        configuration, velocity, torque = pinocchio.neutral(model), np.zeros(4), np.zeros(4)
        for name in plant.coordinates:
            one = model.joints[model.getJointId(name)]
            place = slice(one.idx_q, one.idx_q + one.nq)
            configuration[place] = (np.cos(q[name]), np.sin(q[name])) if one.nq == 2 else q[name]
            velocity[one.idx_v] = v[name]
            torque[one.idx_v] = 10 * u[name] - 0.4 * v[name] * (name == "shoulder")
        expected = pinocchio.aba(model, data, configuration, velocity, torque)
        expected = [expected[model.joints[model.getJointId(name)].idx_v] for name in plant.coordinates]
        state, sent = [*q.values(), *v.values()], [10 * u[name] for name in inputs]
        found = plant.equations.response(state, sent, plant.exact).full().ravel()
        assert found == pytest.approx(np.array(expected), rel=1e-9)
        back = plant.equations.inverse(state, found, plant.exact).full().ravel()
        assert back == pytest.approx(sent, rel=1e-9)


def test_links_that_stand_on_others_have_masses_of_their_own():
    """Pinocchio sums what hangs together; a heavier hand, with its inertia, is the file with a heavier hand."""
    plant = arm(TEXT, exact={"hand": 1.0})
    assert dict(zip(plant.parameters, plant.approximate, strict=True)) == pytest.approx(
        {"mass_upper": 3.0, "mass_fore": 2.0, "mass_slide": 0.8, "mass_hand": 0.5, "mass_finger": 0.1}
    )
    at, now = TEXT.index('<link name="hand"'), TEXT.index('<link name="finger"')
    hand = TEXT[at:now].replace('"0.5"', '"1.0"')
    for number in ("0.02", "0.001", "-0.002", "0.03", "0.0015", "0.025"):
        hand = hand.replace(f'="{number}"', f'="{2 * float(number)}"')
    heavier = arm(TEXT[:at] + hand + TEXT[now:])
    state, sent = [0.3, -0.4, 0.2, 0.5, 1.0, -0.7, 0.3, 0.2], [5.0, 2.0, -3.0, 0.4]
    one, other = (p.equations.response(state, sent, p.exact).full() for p in (plant, heavier))
    assert one == pytest.approx(other, rel=1e-9)


def test_a_tool_that_nobody_weighed_is_what_adaptation_removes():
    """The exact mass of a link moves, the file's is believed."""
    plant = arm(TEXT, exact={"finger": 0.4})
    assert dict(zip(plant.parameters, plant.exact - plant.approximate, strict=True))["mass_finger"] == pytest.approx(
        0.3
    )
    problem = fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {name: 0.3 * (k + 1) * np.sin(1) * t**2 for k, name in enumerate(NAMES)}),
        start=dict.fromkeys(NAMES, 0.0),
        period=2e-3,
        duration=0.4,
        measure_from=0.1,
    )
    error = {}
    for name, form in {"alone": fp.Identity(), "adapted": fp.ModelReferenced(fp.Affine(gain=-0.5))}.items():
        run = fp.simulate(problem, fp.ComputedTorque(fp.Exponential(rate=6.0), form), seed=0, compiled=False)
        assert run.stop is None
        error[name] = fp.measure(problem, run).rms_error["wrist"]
    assert error["adapted"] < 0.2 * error["alone"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (TEXT.replace('"prismatic"', '"floating"'), "joint 'wrist' has 6 degrees of freedom; expected ones that turn"),
        ("<robot name='r'><link name='a'/></robot>", "no joint moves from the base on"),
        (TEXT.replace('<parent link="base"/>', '<parent link="finger"/>'), "no joint moves from the base on"),
        ("<robot", "arm: ValueError: The XML stream does not contain a valid URDF model"),
        ("nowhere.urdf", "arm: 'nowhere.urdf' cannot be read: No such file or directory"),
    ],
)
def test_what_is_no_arm_is_named(text, words):
    with pytest.raises(InvalidProblem, match=words):
        arm(text)


def test_a_link_that_does_not_exist_is_named():
    with pytest.raises(InvalidProblem, match=r"exact: link 'fingr' is unknown\. Did you mean 'finger'"):
        arm(TEXT, exact={"fingr": 1.0})
