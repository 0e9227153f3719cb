"""A body that MuJoCo moves, from its MJCF file, as the reality of a problem.

    problem = fp.Problem(plant=model, reality=mujoco_body("arm.xml", model, period=2e-3), ...)

Positions, velocities and accelerations are those of the joints at the end of the cycle, under the command of the cycle.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fpirhc.adapters import adapter, counterparts, derivatives, require, steps_per_cycle
from fpirhc.errors import Mistakes, package
from fpirhc.plant.chain import quantities
from fpirhc.plant.plant import Plant
from fpirhc.task.external_plant import ExternalPlant

_UNSTABLE = ("mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC", "mjWARN_BADCTRL")
_Values = Mapping[str, float]
_Places = Mapping[str, tuple[int, int]]


@adapter
def mujoco_body(
    mjcf: str | Path,
    model: Plant,
    *,
    period: float,
    joints: Mapping[str, str] | None = None,
    actuators: Mapping[str, str] | None = None,
    start: _Values | None = None,
) -> ExternalPlant:
    """Return a body of MuJoCo as a reality.

    Args:
        mjcf: path of an MJCF or URDF file, or its text, which begins with "<".
        model: the controller's model, of order 2 at most, with hinges in rad and slides in m, and time in s.
        period: of the problem, s; a whole number of the body's time steps.
        joints: coordinate -> joint of one degree of freedom, where the names differ.
        actuators: input -> actuator, where the names differ.
        start: position or velocity at the start, "q1" or "q1'", where it is not that of the file.

    Raises:
        NotSupported: MuJoCo is not installed.
        InvalidProblem: a name that the body or the model does not have, or a period that is no whole number of time steps.
    """
    mujoco = package("mujoco", "outside")
    text = str(mjcf)
    if not (inside := text.lstrip().startswith("<")):
        Path(text).open("rb").close()  # the package says something else of a file that is not there
    body = mujoco.MjModel.from_xml_string(text) if inside else mujoco.MjModel.from_xml_path(text)
    units, mistakes = quantities(model), Mistakes("mujoco_body")
    parts = derivatives(mistakes, units)
    free = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)
    scalar = [joint for joint in map(body.joint, range(body.njnt)) if int(joint.type[0]) in free]
    of_joint = {j.name: (j.qposadr[0], j.dofadr[0], j.dofadr[0]) for j in scalar}
    joint = counterparts(mistakes, "joint", (name for name, _ in parts.values()), joints or {}, of_joint)
    motors = {body.actuator(k).name: k for k in range(body.nu)}
    actuator = counterparts(mistakes, "actuator", model.inputs, actuators or {}, motors)
    mistakes.unknown("start: quantity", start or {}, [q for q, (_, order) in parts.items() if order < 2])
    mistakes.raise_if_any()
    count = steps_per_cycle("mujoco_body", model, period, body.opt.timestep)
    places = {q: (order, of_joint[joint[name]][order]) for q, (name, order) in parts.items()}
    driven = [motors[name] for name in actuator.values()]
    return ExternalPlant(_Body(mujoco, body, count, driven, places, start or {}), measures=units, period=period)


class _Body:
    """Joints and motors at their places in MuJoCo's vectors; `places`: quantity -> (order of the derivative, place)."""

    def __init__(self, mujoco: Any, model: Any, steps: int, motors: list[int], places: _Places, start: _Values) -> None:
        self._mujoco, self._model, self._data = mujoco, model, mujoco.MjData(model)
        self._steps, self._motors, self._places, self._start = steps, motors, places, start

    def reset(self, _seed: int) -> np.ndarray:
        """Go to the start; there is nothing random."""
        self._mujoco.mj_resetData(self._model, self._data)
        for quantity, value in self._start.items():
            order, place = self._places[quantity]
            (self._data.qpos, self._data.qvel)[order][place] = value
        return self._measured()

    def step(self, time: float, command: np.ndarray) -> np.ndarray:
        """Hold the command for a cycle; MuJoCo puts an unstable body back to its start, and only counts a warning."""
        self._data.ctrl[self._motors] = command
        self._mujoco.mj_step(self._model, self._data, self._steps)
        warned = [self._data.warning[getattr(self._mujoco.mjtWarning, name)].number for name in _UNSTABLE]
        told = "take a smaller timestep or an implicit integrator in its file"
        require(not any(warned), f"MuJoCo says that the simulation is unstable in the cycle from {time:g} s; {told}")
        return self._measured()

    def _measured(self) -> np.ndarray:
        self._mujoco.mj_forward(self._model, self._data)
        d = self._data
        return np.array([(d.qpos, d.qvel, d.qacc)[order][place] for order, place in self._places.values()])
