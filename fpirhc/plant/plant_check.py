"""Checks of a plant's settings: names, units, orders and the response."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping

from fpirhc.errors import FpirhcError, Mistakes
from fpirhc.fields.kinds import takes
from fpirhc.fields.user_code import called, named_results, place_of, scalar_expression
from fpirhc.plant.lie_derivatives import structural_order
from fpirhc.plant.motion import Motion, arguments_of, controlled_places, inverse_by_user, words
from fpirhc.symbolic.layout import Expression

HIGHEST_ORDER = 20  # every derivative is a state with a name of its own: a mistyped 10**9 would fill the memory


def check_names(plant: Motion, mistakes: Mistakes) -> None:
    """Add every mistake in names, units, orders and the choice of controlled coordinates to `mistakes`."""
    outputs = {name: one.unit for name, one in plant.outputs.items()}
    quantities = "states" if plant.next is not None or (plant.outputs and plant.order == 1) else "coordinates"
    for what, group in ((quantities, plant.coordinates), ("inputs", plant.inputs), ("outputs", outputs)):
        if not group and what != "outputs":
            still = (
                " (a static map y = h(u) may have one that stands still)"
                if plant.outputs and what == quantities
                else ""
            )
            mistakes.add(f"{what} are empty; name at least one, with its unit{still}")
        for name, unit in group.items():
            if not isinstance(unit, str) or not unit:
                mistakes.add(f"{what}: '{name}' has no unit; write {{'{name}': 'm'}} (or '1' for none)")
            if not str(name).isidentifier():
                mistakes.add(f"{what}: '{name}' is not an identifier; use letters, digits and underscores")
    if not isinstance(plant.time_unit, str) or not plant.time_unit:
        mistakes.add(
            f"time_unit is {plant.time_unit!r}; write the unit of time of the equations, such as 's', 'ms' or 'day'"
        )
    for name in sorted(plant.outputs.keys() & plant.inputs.keys()):
        mistakes.add(f"'{name}' names both an output and an input; rename one")
    _check_order_numbers(plant, mistakes)
    _check_controlled(plant, mistakes)


def _check_controlled(plant: Motion, mistakes: Mistakes) -> None:
    if plant.controlled is not None:
        what = "output" if plant.outputs else "coordinate"
        mistakes.unknown(f"controlled: {what}", plant.controlled, plant.outputs or plant.coordinates)
        if len(plant.controlled) != len(plant.inputs):
            mistakes.add(
                f"controlled names {len(plant.controlled)} {what}(s), but {len(plant.inputs)} input(s) "
                "can prescribe exactly as many"
            )


def check_ranges(plant: Motion, mistakes: Mistakes) -> None:
    """Add every mistake of the physical ranges to `mistakes`."""
    mistakes.unknown("ranges: state", plant.ranges, plant.state.elements)
    for name, (low, high) in plant.ranges.items():
        if not low < high:
            mistakes.add(f"ranges: '{name}' must be (lowest, highest), got {(low, high)!r}")


def check_response(plant: Motion, mistakes: Mistakes) -> None:
    """Add every mistake of the response and of the orders to `mistakes`."""
    x, u, p = plant.symbols()
    arguments_of_step, symbols = arguments_of(plant, x, u, p), [x, u, p]
    quantity, function = words(plant)
    expected = len(arguments_of_step)
    if not takes(plant.response, expected):
        mistakes.add(_wrong_arguments(plant, expected))
        return
    try:
        response = named_results(function, called(function, plant.response, *arguments_of_step))
    except FpirhcError as error:
        mistakes.add(str(error))
        return
    mistakes.unknown(f"{function}: {quantity}", response, plant.coordinates)
    for c, r in zip(plant.names, plant.orders, strict=True):
        if c not in response and plant.next is not None:
            mistakes.add(f"next does not give the value of state '{c}' one step later; return it too")
            continue
        if c not in response:
            mistakes.add(f"{function} does not give the derivative {c}{chr(39) * r} of {quantity} '{c}'; return it too")
            continue
        with mistakes.caught():
            scalar_expression(f"{function} of '{c}'", response[c], of=plant.response, symbols=symbols)
    if mistakes.none:
        _check_orders(plant, mistakes)
    if mistakes.none and plant.inverse is not None:
        _check_inverse(plant, plant.inverse, mistakes)


def _wrong_arguments(plant: Motion, expected: int) -> str:
    """What a response of another number of arguments is, and what it should be."""
    quantity, function = words(plant)
    kinds = [one.kind for one in inspect.signature(plant.response).parameters.values()]
    arguments, order = len(kinds), max(plant.orders, default=0)
    lower = ["x"] if quantity == "state" else ["q", "v", "a"] + [f"d{k}" for k in range(3, 12)]
    names = [*lower[:order], "u", "p"]
    state, fitting, place = quantity == "state", order + arguments - expected, place_of(plant.response)
    mend = f"; {arguments} arguments are those of order {fitting}" if fitting > 0 else _OF_STATES
    mend = "" if state or inspect.Parameter.KEYWORD_ONLY in kinds else mend
    return (
        f"{function} takes {arguments} argument{'s' * (arguments != 1)}{f' ({place})' if place else ''}; "
        f"{'' if state else f'with order {order} '}it is called as {function}({', '.join(names)}){mend}"
    )


_OF_STATES = "; equations in states go to Plant.of_states(rates=...)"


def _check_order_numbers(plant: Motion, mistakes: Mistakes) -> None:
    if isinstance(plant.order, Mapping):
        mistakes.unknown("order: coordinate", plant.order, plant.coordinates)
        for c in plant.coordinates:
            if c not in plant.order:
                mistakes.add(f"order: coordinate '{c}' has none; add '{c}': 2 (the derivative that the response gives)")
    orders = plant.order.values() if isinstance(plant.order, Mapping) else [plant.order]
    for order in orders:
        if not isinstance(order, int) or isinstance(order, bool) or order < 1:
            mistakes.add(f"order must be a whole number of at least 1, got {order!r}")
        elif order > HIGHEST_ORDER:
            mistakes.add(
                f"order is {order}, and the highest possible is {HIGHEST_ORDER}: the response has one argument per lower "
                "derivative; give the order of the derivative that the response returns"
            )


def _check_inverse(plant: Motion, inverse: Callable[..., Mapping[str, Expression]], mistakes: Mistakes) -> None:
    arguments = max(plant.orders, default=0) + 2
    if not takes(inverse, arguments):
        mistakes.add(
            f"inverse is called with {arguments} arguments: the derivatives below the order, responses, parameters"
        )
        return
    with mistakes.caught():
        inverse_by_user(plant, inverse)


def _check_orders(plant: Motion, mistakes: Mistakes) -> None:
    if plant.outputs or (plant.controlled is None and len(plant.inputs) != len(plant.coordinates)):
        return  # orders of outputs are found, not stated
    for k in controlled_places(plant):
        name, stated = plant.names[k], plant.orders[k]
        order = structural_order(plant, name)
        if order is None:
            mistakes.add(
                f"no input reaches coordinate '{name}', however often it is differentiated; use {' or '.join(plant.inputs)} in the "
                f"{words(plant)[1]}, or control another {words(plant)[0]}"
            )
        elif order != stated and plant.next is not None:
            mistakes.add(
                f"an input reaches state '{name}' only after {order} steps; write it as an output, whose order is found: "
                f"outputs={{'{name}': Output(unit, lambda x, p: x.{name})}}"
            )
        elif order != stated:
            mistakes.add(
                f"order of '{name}' is given as {stated}, but its response has no input: the first derivative that an "
                f"input reaches is number {order}. Write the response of order {order}, or control another coordinate"
            )
