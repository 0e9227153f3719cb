"""A reality that is not the model: another plant, with states of its own, moves in a run, and the controller keeps its model.

    command -> reality x' = f(x, u, p) -> its coordinates of the model's names, with their derivatives -> sensing -> controller

Theory: docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidProblem, Mistakes, refuse
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import Finite
from fpirhc.plant.chain import derivatives_function, output_order
from fpirhc.plant.integrators import Integrator, spurious_growth
from fpirhc.plant.maps import unlike
from fpirhc.plant.motion import with_exact_parameters
from fpirhc.plant.parameter import Parameter
from fpirhc.plant.plant import Plant


@dataclass(frozen=True, eq=False)
class Reality(Checked):
    """The plant that a run moves, where it is not the model's.

    Args:
        plant: with the model's inputs, and a coordinate or an output of the same name and unit for what is measured, controlled or
            judged of the model; without an observer that is all of it. Its exact parameters act; the approximate ones are not used,
            unless it is the model of an `ExactModel`.
        start: first values of all states that the model does not have.
        integrator: of its motion; None: the problem's.
        seen: coordinate or output of the model -> coordinate of the reality that is measured in its place, such as the output of
            a slow sensor. Errors are judged at the coordinate of the same name where there is one.

    Raises:
        InvalidField: all wrong arguments together. `Problem` checks the reality against the model.
    """

    plant: Plant
    start: Mapping[str, Finite] = field(default_factory=dict)
    integrator: Integrator | None = None
    seen: Mapping[str, str] = field(default_factory=dict)

    simulated: ClassVar[bool] = True  # its equations are known: it can run again to answer a question
    rest: ClassVar[None] = None  # nothing is left to itself when a run ends
    lag: ClassVar[Mapping[str, float]] = {}  # of its inputs: none beside what its equations have

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """Whose exact values studies draw."""
        return self.plant.parameters

    def with_exact(self, exact: np.ndarray) -> Reality:
        """Return the reality with other exact parameters, shape (np,)."""
        return replace(self, plant=with_exact_parameters(self.plant, exact))

    def check(self, model: Plant, needed: Collection[str], measured: Collection[str]) -> None:  # noqa: ARG002
        """Raise if the reality cannot stand for what the model describes."""
        plant, mistakes = self.plant, Mistakes("reality")
        own, expected = (", ".join(f"{n} in {unit}" for n, unit in one.inputs.items()) for one in (plant, model))
        if own != expected:
            mistakes.add(
                f"its inputs are {own}, the model's are {expected}; both take the same commands, so name them alike, in order"
            )
        quantities = {**model.coordinates, **model.followed}
        mistakes.unknown("seen: coordinate of the model", self.seen, quantities)
        mistakes.unknown("seen: coordinate of the reality", self.seen.values(), plant.coordinates)
        mistakes.unknown("start: state", self.start, plant.state.elements)
        if plant.time_unit != model.time_unit:
            mistakes.add(f"its time is in {plant.time_unit}, the model's in {model.time_unit}; write both in one unit")
        for name, unit in quantities.items():
            self._check_quantity(model, name, unit, mistakes, needed=name in needed)
        mistakes.raise_if_any()

    def _check_quantity(self, model: Plant, name: str, unit: str, mistakes: Mistakes, *, needed: bool) -> None:
        """Add what is wrong with what is measured or judged in the place of a coordinate or an output of the model."""
        plant, units, seen = self.plant, self._units, self.seen.get(name, name)
        there = [one for one in dict.fromkeys((seen, name)) if one in units]
        if needed and not there:
            mistakes.add(
                f"it has no '{name}', which the model has; add it, or name what is measured in its place, "
                f"Reality(seen={{'{name}': ...}}), or estimate it, Sensing(measured=..., observer=KalmanFilter(...)). "
                f"It has {', '.join(units)}"
            )
        for one in there:
            if units[one] != unit:
                mistakes.add(f"its '{one}' is in {units[one]}, the model's '{name}' in {unit}; write both in one unit")
        if not needed or seen not in units:
            return
        order = {**dict(zip(model.names, model.orders, strict=True)), **model.equations.output_orders}[name]
        own = output_order(plant, seen)
        if own is not None and own < order:
            mistakes.add(
                f"its derivative {seen}{chr(39) * own} jumps with the command, but '{name}' has order {order} in the model; "
                "give the model this order, or the reality an actuator or a coordinate of its own"
            )
        elif own is None and name in (model.controlled or model.chains):
            mistakes.add(f"no input reaches its '{seen}', however often it is differentiated")

    def shown(self, quantities: Sequence[str]) -> tuple[str, ...]:
        """Return those of the model's states, outputs and their derivatives that it has."""
        return tuple(e for e in quantities if self._own(e.rstrip("'"), seen=True) in self._units)

    def shows(self, name: str) -> bool:
        """Whether it has a coordinate or an output at which one of the model is judged."""
        return self._own(name, seen=False) in self._units

    def function(self, quantities: Sequence[str], *, seen: bool = False) -> ca.Function:
        """Function (state, input, parameters, forcing) of what moves -> quantities of the model by name: "q1", "q1'", "y"."""
        wanted = ((self._own(e.rstrip("'"), seen=seen), e.count("'")) for e in quantities)
        return derivatives_function(self.plant, tuple(wanted))

    def start_state(self, model: Plant, start: np.ndarray) -> np.ndarray:
        """Return the first state of the reality, shape (its nx,), from that of the model, shape (nx,)."""
        elements = self.plant.state.elements
        known: dict[str, float] = {
            self._own(e.rstrip("'"), seen=False) + "'" * e.count("'"): value
            for e, value in zip(model.state.elements, start, strict=True)
        }
        known |= self.start
        free = [e for e in elements if e not in known]
        if free:
            raise InvalidProblem(
                f"reality: it has states that the model does not have: {', '.join(free)}; give their first values: "
                f"Reality(start={{{', '.join(f'{e!r}: ...' for e in free)}}})"
            )
        return np.array([float(known[e]) for e in elements])

    def _own(self, name: str, *, seen: bool) -> str:
        """Its coordinate or output at which one of the model is measured, or judged."""
        return name if not seen and name in self._units else self.seen.get(name, name)

    @cached_property
    def _units(self) -> dict[str, str]:
        """Of what it can show: its coordinates and its outputs."""
        return {**self.plant.coordinates, **self.plant.followed}

    def check_motion(self, start: np.ndarray, command: np.ndarray, integrator: Integrator, period: float) -> None:
        """Raise if the reality cannot move from its start, or the integrator cannot follow it there."""
        plant = self.plant
        rates = np.asarray(plant.equations.rate(start, command, plant.exact).full()).ravel()
        if not np.isfinite(rates).all():
            wrong = plant.state.elements[int(np.argmin(np.isfinite(rates)))]
            raise InvalidProblem(f"reality: the rate of its state '{wrong}' is not finite at the start")
        [grown] = spurious_growth(plant, integrator, period, start[:, None], command[:, None], plant.exact)
        if grown > 1 + 1e-9:
            raise InvalidProblem(
                f"reality: a mode decays much faster than the period of {period:g} {plant.time_unit}, and {integrator!r} makes it "
                f"grow by {grown:.3g} per cycle; use Reality(..., integrator=Collocation()), or RungeKutta4 with more sub-steps"
            )

    def as_model(self, model: Plant) -> Plant:
        """Return its plant as the model of a controller, with outputs where the model has the same quantities as outputs."""
        plant = self.plant
        if plant is model:
            return plant
        facts = {
            "coordinates": (plant.names, model.names),
            "orders": (plant.orders, model.orders),
            "outputs": (plant.output.elements, model.output.elements),
            "controlled": (tuple(plant.controlled or plant.chains), model.controlled_names),
            "measured": (tuple(self.seen.values()), tuple(self.seen)),
        }
        differences = [f"{what} {one}, the controller's are {its}" for what, (one, its) in facts.items() if one != its]
        refuse(
            f"the reality has {one}: it cannot be the exact model of this controller; leave ExactModel out"
            for one in filter(None, [*differences, unlike(plant, model)])
        )
        return plant if tuple(plant.outputs) == tuple(model.outputs) else replace(plant, outputs=model.outputs)
