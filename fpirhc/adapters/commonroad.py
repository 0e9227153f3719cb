"""A car of CommonRoad's vehicle models as the reality of a problem: single track ("st") or single track with drift ("std").

    problem = fp.Problem(plant=model, reality=commonroad_body("std", model, period=1e-2, speed=20.0, names={"side": "y"}), ...)

Measured are x, y and heading with their derivatives, the second ones as differences over a cycle. The input `steer` (rad) is the
angle that the wheels turn to at the car's own rate; `acceleration` (m/s^2) is the other, or the car holds its speed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from fpirhc.adapters import adapter, counterparts, derivatives, steps_per_cycle
from fpirhc.errors import Mistakes, package
from fpirhc.fields.kinds import NotNegative
from fpirhc.plant.chain import quantities
from fpirhc.plant.plant import Plant
from fpirhc.task.external_plant import ExternalPlant

_STEP, _PULL, _COORDINATES = 1e-3, 2.0, ("x", "y", "heading")  # s; 1/s of the speed's error; in the order of `_moved`

_Names = Mapping[str, str] | None
_Read = list[tuple[int, int]]  # order and coordinate of every number that is measured


@adapter
def commonroad_body(
    kind: str, model: Plant, *, period: float, speed: NotNegative, vehicle: int = 2, names: _Names = None
) -> ExternalPlant:
    """Return a car as a reality; it starts at the origin, along x.

    Args:
        kind: of the package's model, "st" or "std".
        model: the controller's model, of order 2 at most, with time in s.
        period: of the problem, s; a whole number of ms.
        speed: at the start, m/s, which the car holds where the model has no input `acceleration`.
        vehicle: number of the package's set of parameters, 1 to 4; 2 is a BMW 320i.
        names: coordinate -> "x", "y" or "heading", input -> "steer" or "acceleration", where the names differ.

    Raises:
        NotSupported: commonroad-vehicle-models is not installed.
        InvalidField: a speed below zero.
        InvalidProblem: a name that the car or the model does not have, no such vehicle, or a period that is no whole ms.
    """
    units, mistakes, counterpart = quantities(model), Mistakes("commonroad_body"), names or {}
    parts = derivatives(mistakes, units)
    mistakes.unknown("kind", [kind], ("st", "std"))
    mistakes.unknown("vehicle", [str(vehicle)], "1234")
    own = dict.fromkeys(name for name, _ in parts.values())
    mistakes.unknown("names: name of the model", counterpart, [*own, *model.inputs])
    shown = counterparts(mistakes, "coordinate", own, {n: v for n, v in counterpart.items() if n in own}, _COORDINATES)
    sent = {n: v for n, v in counterpart.items() if n in model.inputs}
    inputs = counterparts(mistakes, "input", model.inputs, sent, ("steer", "acceleration"))
    mistakes.raise_if_any()
    read = [(order, _COORDINATES.index(shown[name])) for name, order in parts.values()]
    count = steps_per_cycle("commonroad_body", model, period, _STEP)
    return ExternalPlant(_Car(kind, speed, vehicle, count, [*inputs.values()], read), measures=units, period=period)


class _Car:
    """The package's derivative, integrated by Runge-Kutta steps of 1 ms. `kind`: "st" or "std"."""

    def __init__(self, kind: str, speed: float, vehicle: int, steps: int, inputs: list[str], read: _Read) -> None:
        names = f"vehicle_dynamics_{kind}", f"init_{kind}", f"parameters_vehicle{vehicle}"
        of: list[Any] = [getattr(package(f"vehiclemodels.{name}", "outside"), name) for name in names]
        self._rate, self._start, self._car = of[0], of[1], of[2]()
        self._kind, self._speed, self._steps, self._inputs, self._read = kind, speed, steps, inputs, read

    def reset(self, _seed: int) -> np.ndarray:
        """Straight on at the speed; there is nothing random."""
        first = [0.0, 0.0, 0.0, self._speed, 0.0, 0.0, 0.0]
        self._x = np.array(self._start(first, self._car) if self._kind == "std" else self._start(first))
        return self._measured(self._moved(), np.zeros(3))

    def step(self, _time: float, command: np.ndarray) -> np.ndarray:
        """Turn the wheels to their angle, at the car's rate, for a cycle."""
        sent, span, before = dict(zip(self._inputs, command, strict=True)), self._steps * _STEP, self._moved()
        limits = self._car.steering
        turn = np.clip((sent.get("steer", self._x[2]) - self._x[2]) / span, limits.v_min, limits.v_max)
        for _ in range(self._steps):
            pull = sent.get("acceleration", np.clip(_PULL * (self._speed - self._x[3]), -5.0, 5.0))
            x, u = self._x, [turn, pull]
            k1 = np.array(self._rate(list(x), u, self._car))
            k2 = np.array(self._rate(list(x + _STEP / 2 * k1), u, self._car))
            k3 = np.array(self._rate(list(x + _STEP / 2 * k2), u, self._car))
            k4 = np.array(self._rate(list(x + _STEP * k3), u, self._car))
            self._x = x + _STEP * ((k1 + 2 * k2 + 2 * k3 + k4) / 6)
        now = self._moved()
        return self._measured(now, (now - before) / span)

    def _moved(self) -> np.ndarray:
        """Rates of x, y and heading."""
        _, _, _, v, heading, turn, slip, *_ = self._x
        return np.array([v * np.cos(heading + slip), v * np.sin(heading + slip), turn])

    def _measured(self, rates: np.ndarray, accelerations: np.ndarray) -> np.ndarray:
        return np.array([(self._x[[0, 1, 4]], rates, accelerations)[order][place] for order, place in self._read])
