"""Checks of a plant's settings: names, units, orders, the response, and the outputs."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import casadi as ca

from fpirhc.errors import FpirhcError, Mistakes
from fpirhc.fields.kinds import described, finite_number, takes
from fpirhc.fields.user_code import called, named_results, place_of, scalar_expression
from fpirhc.plant.chain import output_order, stated_expression
from fpirhc.plant.equations import inverse_by_user
from fpirhc.plant.motion import arguments_of, words
from fpirhc.plant.parameter import check_parameters

if TYPE_CHECKING:
    from fpirhc.plant.plant import Plant

HIGHEST_ORDER = 20  # every derivative is a state with a name of its own: a mistyped 10**9 would fill the memory
_LOWER = ["q", "v", "a", *(f"d{k}" for k in range(3, 12))]


def check_plant(plant: Plant) -> None:
    """Raise with all mistakes of a plant; what needs other parts to be right is checked after them."""
    mistakes = Mistakes("plant")
    _check_names(plant, mistakes)
    if plant.step is not None and not (finite_number(plant.step) and plant.step > 0):
        mistakes.add(f"step must be a positive number, in {plant.time_unit}, got {plant.step!r}")
    check_parameters(plant.parameters, mistakes)
    mistakes.raise_if_any()
    mistakes.unknown("ranges: state", plant.ranges, plant.state.elements)
    for name, (low, high) in plant.ranges.items():
        if not low < high:
            mistakes.add(f"ranges: '{name}' must be (lowest, highest), got {(low, high)!r}")
    mistakes.join(_wrong_arguments(plant))
    mistakes.raise_if_any()
    _check_response(plant, mistakes)
    mistakes.raise_if_any()
    for name in plant.outputs:
        with mistakes.caught():
            _check_output(plant, name, mistakes)
    mistakes.raise_if_any()


def _check_names(plant: Plant, mistakes: Mistakes) -> None:
    """What is wrong in names, units, orders and the choice of controlled coordinates."""
    outputs = {name: one.unit for name, one in plant.outputs.items()}
    quantities = "states" if plant.step is not None or (plant.outputs and plant.order == 1) else "coordinates"
    for what, group in ((quantities, plant.coordinates), ("inputs", plant.inputs), ("outputs", outputs)):
        if not group and what != "outputs":
            static = plant.outputs and what == quantities
            still = " (a static map y = h(u) may have one that stands still)" if static else ""
            mistakes.add(f"{what} are empty; name at least one, with its unit{still}")
        for name, unit in group.items():
            if not unit:
                mistakes.add(f"{what}: '{name}' has no unit; write {{'{name}': 'm'}} (or '1' for none)")
            if not str(name).isidentifier():
                mistakes.add(f"{what}: '{name}' is not an identifier; use letters, digits and underscores")
    if not plant.time_unit:
        mistakes.add(f"time_unit is {plant.time_unit!r}; write the time unit of the equations, such as 's' or 'day'")
    for name in sorted({*plant.coordinates, *plant.outputs} & plant.inputs.keys()):
        what = "an output" if name in plant.outputs else f"a {quantities[:-1]}"
        mistakes.add(f"'{name}' names both an input and {what}; rename one")
    _check_order_numbers(plant, mistakes)
    if plant.controlled is not None:
        mistakes.unknown("controlled: quantity", plant.controlled, plant.followed)
        if len(plant.controlled) != len(plant.inputs):
            mistakes.add(
                f"controlled names {len(plant.controlled)}, but {len(plant.inputs)} input(s) can prescribe exactly as many"
            )


def _check_response(plant: Plant, mistakes: Mistakes) -> None:
    """What is wrong with the response, the orders, and the user's inverse."""
    x, u, p = plant.symbols()
    quantity, function = words(plant)
    try:
        response = named_results(function, called(function, plant.response, *arguments_of(plant, x, u, p)))
    except FpirhcError as error:
        mistakes.add(str(error))
        return
    mistakes.unknown(f"{function}: {quantity}", response, plant.coordinates)
    for c, r in zip(plant.names, plant.orders, strict=True):
        if c in response:
            with mistakes.caught():
                scalar_expression(f"{function} of '{c}'", response[c], of=plant.response, symbols=[x, u, p])
        elif plant.step is not None:
            mistakes.add(f"next does not give the value of state '{c}' one step later; return it too")
        else:
            mistakes.add(f"{function} does not give the derivative {c}{chr(39) * r} of {quantity} '{c}'; return it too")
    if not mistakes:
        _check_orders(plant, mistakes)
    if not mistakes and plant.inverse is not None:
        with mistakes.caught():
            inverse_by_user(plant, plant.inverse)


def _wrong_arguments(plant: Plant) -> Iterator[str]:
    """Which functions of the user take other arguments than they are called with, and what they should be."""
    (quantity, function), order, place = words(plant), max(plant.orders, default=0), place_of(plant.response)
    state, expected = quantity == "state", order + 2
    lower = ", ".join((["x"] if state else _LOWER)[:order])
    if not takes(plant.response, expected):
        kinds = [one.kind for one in inspect.signature(plant.response).parameters.values()]
        arguments, fitting = len(kinds), order + len(kinds) - expected
        of_states = "; equations in states go to Plant.of_states(rates=...)"
        fits = f"; {function}({', '.join(_LOWER[:fitting])}, u, p) is that of Plant(..., order={fitting})"
        mend = fits if fitting > 0 else of_states
        mend = "" if state or inspect.Parameter.KEYWORD_ONLY in kinds else mend
        yield (
            f"{function} takes {arguments} argument{'s' * (arguments != 1)}{f' ({place})' if place else ''}; "
            f"{'' if state else f'with order {order} '}it is called as {function}({lower}, u, p){mend}"
        )
    if plant.inverse is not None and not takes(plant.inverse, expected):
        yield f"inverse is called as inverse({lower}, r, p), with the wanted responses r; got {described(plant.inverse)}"
    for name, one in plant.outputs.items():
        if not (takes(one.expression, expected - 1) or takes(one.expression, expected)):
            yield (
                f"outputs: the expression of '{name}' is called as function({lower}, p), or as function({lower}, u, p) where the "
                f"command moves it at once; got {described(one.expression)}; write lambda {lower}, p: ..."
            )


def _check_order_numbers(plant: Plant, mistakes: Mistakes) -> None:
    if isinstance(plant.order, Mapping):
        mistakes.unknown("order: coordinate", plant.order, plant.coordinates)
        for c in plant.coordinates:
            if c not in plant.order:
                mistakes.add(f"order: coordinate '{c}' has none; add '{c}': 2 (the derivative that the response gives)")
    for order in plant.order.values() if isinstance(plant.order, Mapping) else [plant.order]:
        if not isinstance(order, int) or isinstance(order, bool) or order < 1:
            mistakes.add(f"order must be a whole number of at least 1, got {order!r}")
        elif order > HIGHEST_ORDER:
            mistakes.add(
                f"order is {order}, and the highest possible is {HIGHEST_ORDER}: the response has one argument per lower "
                "derivative; give the order of the derivative that the response returns"
            )


def _check_orders(plant: Plant, mistakes: Mistakes) -> None:
    """The orders that are stated; those of outputs are found."""
    if plant.outputs or (plant.controlled is None and len(plant.inputs) != len(plant.coordinates)):
        return
    for name, stated in plant.response_orders.items():
        order = output_order(plant, name)
        if order is None:
            mistakes.add(
                f"no input reaches coordinate '{name}', however often it is differentiated; use {' or '.join(plant.inputs)} in the "
                f"{words(plant)[1]}, or control another {words(plant)[0]}"
            )
        elif order != stated and plant.step is not None:
            mistakes.add(
                f"an input reaches state '{name}' only after {order} steps; write it as an output, whose order is found: "
                f"outputs={{'{name}': Output(unit, lambda x, p: x.{name})}}"
            )
        elif order != stated:
            mistakes.add(
                f"order of '{name}' is given as {stated}, but its response has no input: the first derivative that an "
                f"input reaches is number {order}. Write the response of order {order}, or control another coordinate"
            )


def _check_output(plant: Plant, name: str, mistakes: Mistakes) -> None:
    x, u, p = plant.symbols()
    value = ca.SX(stated_expression(plant, name, x, u, p))
    if name in plant.coordinates and not ca.is_equal(value, x[plant.state.elements.index(name)], 1):
        mistakes.add(f"outputs: '{name}' has the name of a coordinate, but is another expression; rename the output")
        return
    if (plant.controlled is None or name in plant.controlled) and output_order(plant, name) is None:
        mistakes.add(f"outputs: no input reaches '{name}', however often it is differentiated; control another output")
