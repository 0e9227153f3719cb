"""What the adapters share: the names of one world in the other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from fpirhc.errors import InvalidProblem, Mistakes


def counterparts(
    mistakes: Mistakes, what: str, own: Iterable[str], given: Mapping[str, str], valid: Iterable[str]
) -> dict[str, str]:
    """Return the name outside of each own name: the given one, or the same; names that either side does not have are mistakes."""
    own, valid = tuple(own), tuple(valid)
    mistakes.unknown(f"{what}s: name of the model", given, own)
    found = {name: given.get(name, name) for name in own}
    mistakes.unknown(what, found.values(), valid)
    return found


def steps_per_cycle(where: str, period: float, step: float) -> int:
    """Return how many steps of a simulator a control cycle has.

    Raises:
        InvalidProblem: the period is no whole number of steps.
    """
    count = max(round(period / step), 1)
    if abs(count * step - period) > 1e-9 * period:
        raise InvalidProblem(
            f"{where}: a cycle of {period:g} s is no whole number of its steps of {step:g} s; choose a period of "
            f"{count * step:g} s, or another step"
        )
    return count


def base_and_order(quantity: str) -> tuple[str, int]:
    """Return what a quantity is a derivative of, and the order: ("q1", 2) of "q1''"."""
    name = quantity.rstrip("'")
    return name, len(quantity) - len(name)
