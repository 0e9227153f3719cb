"""What every adapter does with wrong input: one error that names the adapter, also where its package raises."""

import inspect

import pytest
from helpers.tank import TANK

import fpirhc as fp
from fpirhc.adapters import steps_per_cycle
from fpirhc.adapters.commonroad import commonroad_body
from fpirhc.adapters.fmu import fmu_body
from fpirhc.adapters.mujoco import mujoco_body
from fpirhc.adapters.rotorpy import rotorpy_body
from fpirhc.adapters.tclab import tclab_body
from fpirhc.errors import InvalidField, InvalidProblem


def test_a_wrong_argument_of_an_adapter_is_named():
    """A loaded task in place of an argument that is checked; no package is asked for before."""
    task = fp.load_problem("two_mass")
    for adapter in (commonroad_body, fmu_body, mujoco_body, rotorpy_body, tclab_body):
        parameters = list(inspect.signature(adapter).parameters.values())
        needed = [one for one in parameters if one.default is one.empty]
        checked = [one for one in parameters if one.annotation not in ("Any", "object")]
        named = dict.fromkeys([*(one.name for one in needed), checked[0].name], task)
        with pytest.raises(InvalidField, match=rf"{adapter.__name__}\.{checked[0].name}: expected "):
            adapter(**named)


MINUTES = fp.Plant({"x": "m"}, {"u": "m/min^2"}, {}, lambda q, v, u, p: {"x": u.u}, time_unit="min")


@pytest.mark.parametrize(
    "use",
    [
        lambda where: steps_per_cycle(where, MINUTES, 1.0, 0.5),  # of MuJoCo and CommonRoad
        lambda _where: tclab_body(MINUTES, period=1.0),
        lambda _where: rotorpy_body(MINUTES, period=1.0),
    ],
)
def test_a_clock_and_a_physics_engine_refuse_a_model_whose_time_is_not_in_seconds(use):
    """A period of a minute lasted a second, with commands for a minute."""
    with pytest.raises(InvalidProblem, match="_body: its time is in s, and that of the model is in min"):
        use("mine_body")


def test_what_a_package_raises_has_the_adapters_name(tmp_path):
    """What is no archive is told by the package in its own words, and a file that is not there by its name."""
    pytest.importorskip("fmpy", reason="it needs the extra fpirhc[outside]")
    (tmp_path / "no.fmu").write_text("nothing")
    for name, words in (("no.fmu", "fmu_body: BadZipFile: File is not a zip file"), ("absent.fmu", "cannot be read")):
        with pytest.raises(InvalidProblem, match=words):
            fmu_body(str(tmp_path / name), TANK, period=0.1, measures={"h": "h"})
