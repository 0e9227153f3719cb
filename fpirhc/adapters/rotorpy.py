"""A quadrotor of RotorPy - motors, aerodynamics, attitude loop - as the reality of a problem, and RotorPy's own law of position.

    problem = fp.Problem(plant=model, reality=rotorpy_body(model, period=1e-2, wind=(3.0, 0.0, 0.0)), ...)

Measured are the position x, y, z, its velocity, and the acceleration that an accelerometer shows. The inputs thrust_x, thrust_y,
thrust_z are the thrust per nominal mass in the world's axes, m/s^2; the vehicle's own attitude loop turns it there.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import numpy as np

from fpirhc.adapters import adapter, require_seconds
from fpirhc.errors import Mistakes, package
from fpirhc.fields.kinds import Finite, NotNegative
from fpirhc.plant.chain import quantities
from fpirhc.plant.plant import Plant
from fpirhc.task.external_plant import ExternalPlant
from fpirhc.tracking.base import Tracking
from fpirhc.tracking.linear_law import LinearLaw

_SEEN = [name + dash for dash in ("", "'", "''") for name in ("x", "y", "z")]
_State = dict[str, np.ndarray]
_SENT = ("thrust_x", "thrust_y", "thrust_z")


@adapter
def rotorpy_body(
    model: Plant,
    *,
    period: float,
    start: Mapping[str, float] | None = None,
    wind: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0),
    payload: NotNegative = 0.0,
    vehicle: Mapping[str, Any] | None = None,
) -> ExternalPlant:
    """Return a quadrotor as a reality.

    Args:
        model: the controller's model, with all of x, y, z in m and of thrust_x, thrust_y, thrust_z in m/s^2.
        period: of the problem, s.
        start: position and velocity at the start by name, zero where not named; it hovers upright.
        wind: constant velocity of the air, m/s.
        payload: mass that is carried at the centre, kg; the thrust stays that per nominal mass.
        vehicle: parameters as of the package; None: its Hummingbird.

    Raises:
        NotSupported: RotorPy is not installed.
        InvalidField: a payload below zero, or a wind that is not of three finite numbers.
        InvalidProblem: the model has other names, or the vehicle lacks parameters.
    """
    require_seconds("rotorpy_body", model)
    mistakes = Mistakes("rotorpy_body")
    mistakes.unknown("measured", quantities(model), _SEEN)
    mistakes.unknown("input", model.inputs, _SENT)
    mistakes.unknown("start: quantity", start or {}, _SEEN[:6])
    for name in (name for name in (*_SEEN[:3], *_SENT) if name not in (*model.coordinates, *model.inputs)):
        mistakes.add(f"the model has no {name}; it needs x, y, z and thrust_x, thrust_y, thrust_z")
    if lacking := {"mass", "k_eta"} - {*(vehicle or {"mass": 0, "k_eta": 0})}:
        mistakes.add(f"vehicle lacks {min(lacking)}; change a set of the package: {{**quad_params, 'mass': 1.0}}")
    mistakes.raise_if_any()
    parameters = vehicle or package("rotorpy.vehicles.hummingbird_params", "outside").quad_params
    at = [(start or {}).get(name, 0.0) for name in _SEEN[:6]]
    hover = np.sqrt(parameters["mass"] * 9.81 / 4 / parameters["k_eta"])  # of rotors that carry the vehicle alone
    upright = {"q": np.array([0.0, 0.0, 0.0, 1.0]), "w": np.zeros(3), "rotor_speeds": np.full(4, hover)}
    first = {"x": np.array(at[:3]), "v": np.array(at[3:]), "wind": np.array(wind), **upright}
    loaded = {**deepcopy(parameters), "mass": parameters["mass"] + payload}
    multirotor = package("rotorpy.vehicles.multirotor", "outside").Multirotor
    flown = multirotor(loaded, initial_state=first, control_abstraction="cmd_acc", aero=True)
    body = _Quadrotor(
        flown, first, period, [*map(list(model.inputs).index, _SENT)], parameters["mass"] / loaded["mass"]
    )
    return ExternalPlant(body, measures={name: quantities(model)[name] for name in _SEEN}, period=period)


@adapter
def se3_law(vehicle: Mapping[str, Any] | None = None) -> Tracking:
    """Return the outer loop of the package's SE3Control: q'' desired = q'' nominal + kp_pos e + kd_pos e', for each of x, y, z.

    With `ComputedTorque` it is that controller at the level of the thrust; the inner loop is the vehicle's own.

    Args:
        vehicle: parameters as of the package; None: its Hummingbird.

    Raises:
        NotSupported: RotorPy is not installed.
    """
    parameters = vehicle or package("rotorpy.vehicles.hummingbird_params", "outside").quad_params
    se3 = package("rotorpy.controllers.quadrotor_control", "outside").SE3Control(parameters)
    return _OuterLoop({name: (float(p), float(d)) for name, p, d in zip(_SEEN, se3.kp_pos, se3.kd_pos, strict=False)})


@dataclass(frozen=True)
class _OuterLoop(LinearLaw):
    """A law with gains of its own for every coordinate: (of e, of e')."""

    own: Mapping[str, tuple[float, float]]
    integral, bumpless, largest = False, False, ()

    def gains(self, order: int) -> tuple[float, ...]:
        """Those of the fastest coordinate."""
        return max(self.own.values())[:order]

    def gains_of(self, plant: Plant) -> list[tuple[float, ...]]:
        return [self.own[name] for name in plant.controlled_names]


class _Quadrotor:
    """The vehicle under the thrust that is asked for."""

    def __init__(self, vehicle: Any, first: _State, period: float, order: list[int], share: float) -> None:
        self._vehicle, self._first, self._period, self._order, self._share = vehicle, first, period, order, share

    def reset(self, _seed: int) -> np.ndarray:
        """Go to the start; there is nothing random."""
        self._state = deepcopy(self._first)
        return np.concatenate([self._state["x"], self._state["v"], np.zeros(3)])

    def step(self, _time: float, command: np.ndarray) -> np.ndarray:
        """Fly for a cycle."""
        thrust = {"cmd_acc": np.asarray(command)[self._order] * self._share}
        self._state["wind"] = self._first["wind"]
        self._state = self._vehicle.step(self._state, thrust, self._period)
        self._state["wind"] = self._first["wind"]
        shown = self._vehicle.statedot(self._state, thrust, self._period)["vdot"]
        return np.concatenate([self._state["x"], self._state["v"], shown])
