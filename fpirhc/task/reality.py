"""A reality that is not the model: another plant, with states of its own, moves in a run, and the controller keeps its model.

    command -> reality x' = f(x, u, p) -> its coordinates of the model's names, with their derivatives -> sensing -> controller

Theory: docs/theory-plants.md.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import ClassVar

import casadi as ca
import numpy as np
import numpy.typing as npt

from fpirhc.errors import InvalidProblem, Mistakes, NotSupported
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import Finite
from fpirhc.plant.chain import derivatives_function, input_reaches_at, relative_order
from fpirhc.plant.integrators import Integrator, stiffness
from fpirhc.plant.maps import check_time, over, unlike
from fpirhc.plant.motion import followed_units, with_exact_parameters, with_outputs_of
from fpirhc.plant.plant import Plant, plant_facts
from fpirhc.plant.plant_check import unsolved


@dataclass(frozen=True, eq=False)
class Reality(Checked):
    """The plant that a run moves, where it is not the model's.

    Args:
        plant: with the model's inputs, and a coordinate or an output of the same name and unit for what is measured, controlled or
            judged of the model; without an observer that is all of it. Its exact parameters act; the approximate ones are not used,
            unless it is the model of an `ExactModel`.
        start: first values of states that the model does not have. Of those that are not named, the one on which a derivative of
            the model's state depends starts where this derivative is the model's, as a speed does. The others settle: their rates
            are zero while the model's states and the inputs before the first cycle are held.
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

    states_dead_time: ClassVar[str] = "Problem(dead_time=...)"
    """Where a user states the dead time of its inputs."""

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

    def start_state(self, model: Plant, start: np.ndarray, command: np.ndarray) -> np.ndarray:
        """Return the first state of the reality, shape (its nx,).

        Args:
            model: of the problem.
            start: first state of the model, shape (nx,).
            command: inputs before the first cycle, shape (nu,).

        Raises:
            InvalidProblem: states that are not named in `start` and have no equilibrium, or a derivative of the model's state that
                depends on several of them.
        """
        elements = self.plant.state.elements
        shared = {elements[there]: start[own] for own, there in self.shared(model).items()}
        known = {**shared, **self.start}
        first = np.array([float(known.get(e, 0.0)) for e in elements])
        free = [k for k, e in enumerate(elements) if e not in known]
        tied = self._tied(model, start, free)
        at_rest = settled(self.plant, first, command, self.plant.exact, free, tied) if free else first
        if at_rest is None:
            missing = ", ".join(elements[k] for k in free)
            raise InvalidProblem(
                f"reality: its states {missing} have no equilibrium at the start of the model; give their first values: "
                f"Reality(start={{'{elements[free[0]]}': ...}})"
            )
        self._check_shown_start(model, start, at_rest, command)
        return at_rest

    def _tied(self, model: Plant, start: np.ndarray, free: Sequence[int]) -> dict[int, Tied]:
        """Return what the derivatives of the model's start say of states that are no derivatives here, by place of the state.

        `start`: first state of the model, shape (nx,).
        """
        shared, elements = self.shared(model), self.plant.state.elements
        tied: dict[int, Tied] = {}
        for k, e in enumerate(model.state.elements):
            if k in shared or not e.endswith("'") or self.true_name(e.rstrip("'")) not in self.plant.coordinates:
                continue
            value = self.function([e])
            x, u, p = self.plant.symbols()
            on = set(ca.jacobian_sparsity(value(x, u, p, 0), x).get_triplet()[1]) & set(free)
            if len(on) > 1:
                names = ", ".join(elements[i] for i in sorted(on))
                raise InvalidProblem(
                    f"reality: {e} is {start[k]:.4g} at the start of the model and depends on its states {names}; give the first "
                    f"values of all but one: Reality(start={{'{elements[min(on)]}': ...}})"
                )
            for i in on & set(tied):
                raise InvalidProblem(
                    f"reality: {e} and another derivative at the start of the model say what its state {elements[i]} is; give its "
                    f"first value: Reality(start={{'{elements[i]}': ...}})"
                )
            tied |= {i: (value, float(start[k])) for i in on}
        return tied

    def _check_shown_start(self, model: Plant, start: np.ndarray, first: np.ndarray, command: np.ndarray) -> None:
        """Raise if outputs stand for the model's coordinates, no start is stated, and they start elsewhere than the model."""
        hidden = [
            e for e in self.shown(model.state.elements) if self.true_name(e.rstrip("'")) not in self.plant.coordinates
        ]
        if model.outputs or self.start or not hidden:
            return
        values = self.function(hidden)(first, command, self.plant.exact, np.zeros(len(self.plant.names)))
        own = dict(zip(hidden, np.asarray(values.full()).ravel(), strict=True))
        for name in hidden:
            wanted = start[model.state.elements.index(name)]
            if not abs(own[name] - wanted) <= 1e-6 * (1 + abs(wanted)):
                raise InvalidProblem(
                    f"reality: its output '{name}' starts at {own[name]:.4g}, that of the model at {wanted:.4g}; give first values "
                    f"of its states: Reality(start={{'{self.plant.state.elements[0]}': ...}})"
                )

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
        why = unsolved(plant, start, command, plant.exact)
        if why:
            raise InvalidProblem(f"reality: algebraic states at the start: {why}")
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
        if differences:
            raise NotSupported(
                f"the reality has {'; '.join(differences)}: it cannot be the exact model of this controller; leave ExactModel out"
            )
        return with_outputs_of(plant, model)

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
            believed = "" if followed else ", or have it believed: Sensing(measured=..., observer=KalmanFilter(...))"
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
    elif name in (model.controlled or model.chains) and relative_order(plant, own) is None:
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


Tied = tuple[ca.Function, float]  # (state, input, parameters, forcing) -> a quantity, and its value at the start
_REST = 1e-8  # largest rate of a state at rest, as a share of its rate at the first guess


def settled(
    plant: Plant,
    state: np.ndarray,
    command: np.ndarray,
    parameters: np.ndarray,
    free: Sequence[int],
    tied: Mapping[int, Tied] = MappingProxyType({}),
) -> np.ndarray | None:
    """Return the state in which the rates of its free entries are zero; None where there is no such state.

    Where many values are at rest, a near one is taken, see `fpirhc.task.reality`.

    Args:
        state: shape (nx,); its free entries are the first guess.
        command: held input, shape (nu,).
        parameters: shape (np,).
        tied: by place of a free entry, a quantity that has a value there, in place of its rate.
    """
    places = list(free)
    held, u, p = plant.symbols()
    x = ca.SX(held)
    moving = ca.SX.sym("moving", len(places))
    x[places] = moving
    left = plant.equations.rate(x, u, p)
    for place, (quantity, value) in tied.items():
        left[place] = quantity(x, u, p, 0) - value
    root = Equations(moving, [held, u, p], left[places]).root(state[places], state, command, parameters)
    if root is None or root.left > _REST * max(1.0, root.first):
        return None
    at = np.array(state, dtype=float)
    at[places] = root.at
    return at


_STEPS = 60
_SMALL = 1e-10  # last step, relative


@dataclass(frozen=True, eq=False)
class Root:
    """Where Newton's method has come to rest.

    Args:
        at: the unknowns, shape (n,).
        left: largest equation before the last step, each in units of its largest slope. It is large where the method rests at a
            point that solves nothing.
        first: the same at the guess.
    """

    at: npt.NDArray[np.float64]
    left: float
    first: float


class Equations:
    """Equations r(z, data) = 0.

    Args:
        unknown: z, a column of symbols.
        known: the data, symbols.
        residual: r, expressions of both.
    """

    def __init__(self, unknown: ca.SX, known: Sequence[ca.SX], residual: ca.SX) -> None:
        slope = ca.jacobian(residual, unknown)
        both = [ca.densify(residual), ca.densify(slope)]
        self._values = ca.Function("fpirhc_equations", [unknown, *known], both)

    def root(self, guess: npt.NDArray[np.float64], *known: npt.NDArray[np.float64]) -> Root | None:
        """Return the root that the method finds from a guess; None where it does not come to rest, or meets what is no number.

        A step is the shortest of those that solve the linear equations best, z - r'(z)^+ r(z): where many points are roots it
        goes to a near one.
        """
        at, first = np.array(guess, dtype=float), None
        for _ in range(_STEPS):
            residual, slope = (np.asarray(m.full()) for m in self._values(at, *known))
            if not (np.isfinite(residual).all() and np.isfinite(slope).all()):
                return None
            sizes = np.abs(slope).max(axis=1, initial=0.0)  # rows differ by powers of the fastest rate
            sizes[sizes == 0] = 1.0
            scaled = residual.ravel() / sizes
            left = float(np.abs(scaled).max(initial=0.0))
            first = left if first is None else first
            step = np.linalg.lstsq(slope / sizes[:, None], -scaled, rcond=None)[0]
            at += step
            if np.abs(step).max(initial=0.0) <= _SMALL * (1 + np.abs(at).max(initial=0.0)):
                return Root(at, left, first)
        return None
