"""A reality that is not the model: another plant, with states of its own, moves in a run, and the controller keeps its model.

    command -> reality x' = f(x, u, p) -> its coordinates of the model's names, with their derivatives -> sensing -> controller

Theory: docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidProblem, Mistakes, require
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import Finite
from fpirhc.plant.chain import derivatives_function, input_reaches_at, output_order
from fpirhc.plant.integrators import Integrator, stiffness
from fpirhc.plant.maps import check_time, over, unlike
from fpirhc.plant.motion import followed_units, with_exact_parameters
from fpirhc.plant.plant import Plant, plant_facts


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

    @property
    def symbolic(self) -> Reality:
        """Itself: a plant whose equations are known."""
        return self

    @property
    def foreign(self) -> None:
        """No object outside."""

    def with_exact(self, exact: np.ndarray) -> Reality:
        """Return the reality with other exact parameters, shape (np,).

        Raises:
            InvalidProblem: see `with_exact_parameters`.
        """
        return replace(self, plant=with_exact_parameters(self.plant, exact))

    @property
    def dead_time(self) -> Mapping[str, float]:
        """That of its inputs: none, because it is the problem's."""
        return {}

    @property
    def lag(self) -> Mapping[str, float]:
        """That of its inputs: none beside what its equations have."""
        return {}

    @property
    def drawn(self) -> Plant:
        """Whose exact parameters studies draw."""
        return self.plant

    @property
    def fact(self) -> str:
        """What tables call it."""
        return "; ".join(plant_facts(self.plant))

    def require_equations(self, refusal: str) -> None:
        """Nothing: its equations are known."""

    def finer(self, integrator: Integrator, factor: int) -> Reality | None:
        """Return it with so many times the steps of the integrator with which it moves; None where that has no finer one."""
        finer = integrator.finer(factor)
        return replace(self, integrator=finer) if finer else None

    def disturbable(self, model: Plant) -> tuple[str, ...]:
        """Return the names beside the inputs that disturbances may have: its coordinates, and outputs of the model."""
        return (*self.plant.coordinates, *model.outputs)

    def over(self, cycle: float) -> Reality:
        """Return it as a controller with this cycle sees it; see `fpirhc.plant.maps.over`.

        Raises:
            InvalidValue: the cycle is no whole number of a map's steps.
        """
        plant = over(self.plant, cycle)
        return self if plant is self.plant else replace(self, plant=plant)

    def check_steps(self, model: Plant, mistakes: Mistakes, *, at_once: bool) -> None:
        """Add to `mistakes` where one of model and reality steps and the other does not, and a response needs both alike.

        Args:
            model: of the problem.
            mistakes: of the problem.
            at_once: whether the command moves everything controlled at once, so that no derivative is looked for.
        """
        check_time(self.plant, model, model.chains, mistakes, at_once=at_once)

    def check(self, model: Plant, needed: Collection[str] | None = None, measured: Collection[str] = ()) -> None:  # noqa: ARG002
        """Raise if the reality cannot stand for what the model describes.

        Args:
            model: of the problem.
            needed: names of the model's coordinates that it must have; None: all. What else it has under the same name has the same
                unit.
            measured: names of what the sensing uses, which follows from the coordinates.

        Raises:
            InvalidProblem: all mistakes together.
        """
        mistakes = Mistakes("reality")
        _check_inputs(self.plant, model, mistakes)
        mistakes.unknown("seen: coordinate of the model", self.seen, {**model.coordinates, **followed_units(model)})
        mistakes.unknown("seen: coordinate of the reality", self.seen.values(), self.plant.coordinates)
        mistakes.unknown("start: state", self.start, self.plant.state.elements)
        if self.plant.time_unit != model.time_unit:
            mistakes.add(
                f"its time is in {self.plant.time_unit}, the model's in {model.time_unit}; write both in one unit"
            )
        for name, unit in model.coordinates.items():
            if needed is None or name in needed:
                _check_coordinate(self.plant, self.seen, model, name, mistakes)
            elif self.plant.coordinates.get(name, unit) != unit:
                mistakes.add(_other_unit(self.plant, name, name, unit))
        for name in model.outputs:
            _check_expression(self.plant, self.seen, model, name, mistakes)
        mistakes.raise_if_any()

    def shown(self, quantities: Sequence[str]) -> tuple[str, ...]:
        """Return those of the model's states, outputs and their derivatives that it has."""
        own = _quantities_of(self.plant)
        return tuple(e for e in quantities if self._own(e.rstrip("'"), seen=True) in own)

    def function(self, quantities: Sequence[str], *, seen: bool = False) -> ca.Function:
        """Function (state, input, parameters, forcing) of what moves -> quantities of the model by name: "q1", "q1'", "y".

        Args:
            quantities: coordinates and outputs of the model, and their derivatives.
            seen: whether they are the measured ones; else the judged ones.
        """
        wanted = [(self._own(e.rstrip("'"), seen=seen), e.count("'")) for e in quantities]
        return derivatives_function(self.plant, wanted)

    def start_state(self, model: Plant, start: np.ndarray) -> np.ndarray:
        """Return the first state of the reality, shape (its nx,).

        Args:
            model: of the problem.
            start: first state of the model, shape (nx,).

        Raises:
            InvalidProblem: a state that neither the model nor `start` says.
        """
        elements = self.plant.state.elements
        shared = {elements[there]: start[own] for own, there in self.shared(model).items()}
        known = {**shared, **self.start}
        free = [e for e in elements if e not in known]
        if free:
            raise InvalidProblem(
                f"reality: it has states that the model does not have: {', '.join(free)}; give their first values: "
                f"Reality(start={{{', '.join(f'{e!r}: ...' for e in free)}}})"
            )
        return np.array([float(known[e]) for e in elements])

    def shared(self, model: Plant) -> dict[int, int]:
        """Return the places of the states that both have: place in the model's state -> place in its own."""
        elements, places = self.plant.state.elements, {}
        for k, e in enumerate(model.state.elements):
            own = self.true_name(e.rstrip("'")) + "'" * e.count("'")
            if own in elements:
                places[k] = elements.index(own)
        return places

    def shows(self, coordinate: str) -> bool:
        """Whether it has a coordinate or an output at which one of the model is judged."""
        return self.true_name(coordinate) in self._shown_quantities

    def true_name(self, coordinate: str) -> str:
        """Return its coordinate at which a coordinate of the model is judged."""
        return coordinate if coordinate in self._shown_quantities else self.seen.get(coordinate, coordinate)

    @cached_property
    def _shown_quantities(self) -> dict[str, str]:
        return _quantities_of(self.plant)

    def check_motion(self, start: np.ndarray, command: np.ndarray, integrator: Integrator, period: float) -> None:
        """Raise if the reality cannot move from its start, or the integrator cannot follow it there.

        Args:
            start: first state, shape (nx,).
            command: inputs before the first cycle, shape (nu,).
            integrator: of the motion.
            period: of the control cycle.

        Raises:
            InvalidProblem: with the fastest pole, and the sub-steps that would do.
        """
        plant = self.plant
        rates = np.asarray(plant.equations.rate(start, command, plant.exact).full()).ravel()
        if not np.isfinite(rates).all():
            wrong = plant.state.elements[int(np.argmin(np.isfinite(rates)))]
            raise InvalidProblem(f"reality: the rate of its state '{wrong}' is not finite at the start")
        stiff = stiffness(plant, integrator, period, start, command, plant.exact)
        if stiff:
            what, _, remedy = stiff.partition("; use ")
            raise InvalidProblem(f"reality: {what}; use Reality(..., {remedy})")

    def as_model(self, model: Plant) -> Plant:
        """Return its plant as the model of a controller, with outputs where the model has the same quantities as outputs.

        Raises:
            NotSupported: with what differs.
        """
        plant = self.plant
        if plant is model:
            return plant
        differences = [
            f"the coordinate {c}, which the controller is not given" for c in plant.names if c not in model.names
        ]
        differences += [f"no coordinate {c}, which the model has" for c in model.names if c not in plant.names]
        differences += [
            f"the order {plant.orders[plant.names.index(c)]} of {c} in place of {order}"
            for c, order in zip(model.names, model.orders, strict=True)
            if c in plant.names and plant.orders[plant.names.index(c)] != order
        ]
        differences += [f"{own} measured in place of {c}" for c, own in self.seen.items()]
        if not differences and plant.names != model.names:
            differences = ["its coordinates in another order"]
        if plant.output.elements != model.output.elements:
            differences.append("other outputs")
        if unlike(plant, model):
            differences.append(unlike(plant, model))
        if not differences and tuple(plant.controlled or plant.chains) != model.controlled_names:
            differences = [
                f"other controlled coordinates (write controlled={model.controlled_names!r} in its plant too)"
            ]
        require(
            not differences,
            f"the reality has {'; '.join(differences)}: it cannot be the exact model of this controller; leave ExactModel out",
        )
        same = tuple(plant.outputs) == tuple(model.outputs)
        return plant if same else replace(plant, outputs=model.outputs)

    def _own(self, name: str, *, seen: bool) -> str:
        """Its coordinate or output for one of the model."""
        return self.seen.get(name, name) if seen else self.true_name(name)


def _quantities_of(plant: Plant) -> dict[str, str]:
    """Return the units of what a reality can show: its coordinates and its outputs."""
    return {**plant.coordinates, **followed_units(plant)}


def _check_inputs(plant: Plant, model: Plant, mistakes: Mistakes) -> None:
    """Add what is wrong with the reality's inputs, which are the model's."""
    own, expected = ", ".join(plant.inputs), ", ".join(model.inputs)
    if own != expected:
        mistakes.add(
            f"its inputs are {own}, the model's are {expected}; both take the same commands, so name them alike, in order"
        )
    for name, unit in plant.inputs.items():
        other = model.inputs.get(name, unit)
        if unit != other:
            mistakes.add(f"its input '{name}' is in {unit}, the model's in {other}; write both in one unit")


def _check_coordinate(plant: Plant, seen: Mapping[str, str], model: Plant, name: str, mistakes: Mistakes) -> None:
    """Add what is wrong with the coordinate of a reality that stands for a coordinate of the model.

    `seen`: name of the model's coordinate -> name of what is measured in its place. `name`: of the model's coordinate.
    """
    own, units, unit = seen.get(name, name), _quantities_of(plant), model.coordinates[name]
    if own not in units:
        if name not in seen:
            followed = name in (model.controlled or model.chains)
            believed = "" if followed else ", or estimate it: Sensing(measured=..., observer=KalmanFilter(...))"
            mistakes.add(
                f"it has no coordinate '{name}', which the model has and the controller is given; add it, or name the one that is "
                f"measured in its place: Reality(seen={{'{name}': ...}}){believed}. Its coordinates: {', '.join(plant.coordinates)}"
            )
        return
    for one in sorted({own, name} & set(units)):
        if units[one] != unit:
            mistakes.add(_other_unit(plant, one, name, unit))
    order = model.orders[model.names.index(name)]
    at_once = input_reaches_at(plant, own, order - 1)
    if at_once is not None:
        mistakes.add(
            f"its derivative {own}{chr(39) * at_once} jumps with the command, but it is a state of the model, where '{name}' has "
            f"the order {order}; give the model this order, or the reality a coordinate of its own"
        )
    elif name in (model.controlled or model.chains) and output_order(plant, own) is None:
        mistakes.add(f"no input reaches its coordinate '{own}', however often it is differentiated")


def _other_unit(plant: Plant, own: str, name: str, unit: str) -> str:
    """Return the sentence about a coordinate in another unit."""
    units = f"in {_quantities_of(plant)[own]}, the model's '{name}' in {unit}"
    return f"its coordinate '{own}' is {units}; write both in one unit"


def _check_expression(plant: Plant, seen: Mapping[str, str], model: Plant, name: str, mistakes: Mistakes) -> None:
    """Add what is wrong with the output, or coordinate, of a reality that is judged or measured for an output of the model."""
    unit, own = followed_units(model)[name], seen.get(name, name)
    units = _quantities_of(plant)
    if not {own, name} & set(units):
        mistakes.add(
            f"it has no output '{name}', which the model has and which is judged; give its plant this output too. Its coordinates "
            f"and outputs: {', '.join(units)}"
        )
        return
    for one in sorted({own, name} & set(units)):
        if units[one] != unit:
            mistakes.add(f"its '{one}' is in {units[one]}, the model's in {unit}; write both in one unit")
    order = model.equations.output_orders[name]
    at_once = input_reaches_at(plant, own, order - 1) if order and own in units else None
    if at_once is not None:
        mistakes.add(
            f"its derivative {own}{chr(39) * at_once} jumps with the command, but '{name}' has the relative order {order} in the "
            "model; give the model this order, or the reality an actuator"
        )
