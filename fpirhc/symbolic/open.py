"""Numbers that stay open while a loop is built, so that a compiled loop takes other values: plain CasADi symbols.

    opened = Opened({"deformation.gain": -0.5})  # symbols with the numbers of the build
    opened.symbols["deformation.gain"], opened.signal

A value with open numbers is made by way of the `closed` one, with the numbers of the build, which is checked, and whose facts it
has (`fpirhc.fields.checked`). A block whose step meets a symbol reads the vector `settings` of its loop. Python cannot compute with
a symbol: where a build does, it is refused by its path and the place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import casadi as ca

from fpirhc.errors import InvalidName, NotSupported
from fpirhc.symbolic.dotted import copied
from fpirhc.symbolic.layout import Expression, Layout, Signal

ANEW = "state it in the problem or the controller, and build a loop for each number"  # what to do instead
SETTINGS = "settings"  # the signal of all open numbers of a loop
_CLOSED = "_closed"  # of a value with open numbers: that with those of the build
_OPEN: dict[int, Opened] = {}  # of every symbol of both kinds


class Opened:
    """The open numbers of one loop, by path: one vector."""

    def __init__(self, numbers: Mapping[str, float], units: Sequence[str] = ()) -> None:
        """Make their symbols; `numbers` are those of the build."""
        self.numbers = dict(numbers)
        self.symbols = {path: ca.SX.sym(path) for path in numbers}
        self.graph = {path: ca.MX.sym(path) for path in numbers}  # the same in graphs of calls
        self.read: set[str] = set()  # paths of those that some block needs
        self.signal = Signal(SETTINGS, tuple(numbers), tuple(units), start=tuple(self.numbers.values()))
        _OPEN.update({_key(one): self for kind in (self.symbols, self.graph) for one in kind.values()})


def _key(symbol: ca.SX | ca.MX) -> int:
    return symbol.element_hash() if isinstance(symbol, ca.SX) else hash(symbol)


def open_in(*expressions: Expression) -> list[ca.SX]:
    """Return the open symbols in some expressions, in the order in which they appear."""
    return [s for s in ca.symvar(ca.veccat(*expressions)) if _key(s) in _OPEN]


def with_settings(
    function: ca.Function, reads: Layout, symbols: Mapping[str, Any], results: list[Any]
) -> tuple[ca.Function, Layout]:
    """Return the function of a block and what it reads, with the vector of the settings where results have open symbols."""
    if not function.has_free():
        return function, reads
    found = open_in(*results)
    if not found:
        raise InvalidName(f"block '{function.name().partition('_')[2]}' uses symbols that it does not read")
    opened = _OPEN[_key(found[0])]
    opened.read |= {s.name() for s in found}
    column: Any = ca.vertcat(*opened.symbols.values())
    if isinstance(found[0], ca.MX):
        column = ca.MX.sym(SETTINGS, len(opened.numbers))
        results = ca.graph_substitute(results, list(opened.graph.values()), ca.vertsplit(column))
    inputs = reads if SETTINGS in reads else reads + Layout((opened.signal,))
    columns = {**dict.fromkeys(inputs.names), **symbols, SETTINGS: column}
    return ca.Function(function.name(), [*columns.values()], results, [*columns], function.name_out()), inputs


def settings_among(inputs: Iterable[Layout]) -> tuple[Signal, ...]:
    """Return the signal of the settings, where some of these have it."""
    return tuple({s.name: s for layout in inputs for s in layout.signals if s.name == SETTINGS}.values())


def is_open(value: object) -> bool:
    """Return whether something is an open number, or an expression of such numbers."""
    if not isinstance(value, ca.SX) or not value.is_scalar():
        return False
    symbols = ca.symvar(value)
    return bool(symbols) and len(open_in(value)) == len(symbols)


def not_live(paths: Iterable[str], why: str, where: str = "") -> NotSupported:
    """Return the error of settings that cannot be open, with the reason; `where` says in which case they cannot, after a space."""
    names = [f"'{path}'" for path in paths]
    return NotSupported(f"setting{'s' if len(names) > 1 else ''} {', '.join(names)} cannot be live{where}: {why}")


def number_of(value: ca.SX) -> float:
    """Return the number of the build of an open number."""
    symbols = ca.symvar(value)
    numbers = [_OPEN[_key(s)].numbers[s.name()] for s in symbols]
    return float(ca.Function("fpirhc_number", symbols, [value])(*numbers))


def closed(value: Any) -> Any:
    """Return a value with the numbers of the build in place of open ones; the value itself where it has none."""
    if not _OPEN:
        return value
    if isinstance(value, ca.SX):
        return number_of(value) if is_open(value) else value
    if not isinstance(value, Mapping | tuple | list):
        return getattr(value, "__dict__", {}).get(_CLOSED, value)
    parts = dict(value) if isinstance(value, Mapping) else dict(enumerate(value))
    changed = {key: closed(part) for key, part in parts.items()}
    if all(changed[key] is part for key, part in parts.items()):
        return value
    return changed if isinstance(value, Mapping) else type(value)([*changed.values()])


def made(make: Callable[..., Any], names: Sequence[str], /, *arguments: object, **named: object) -> Any:
    """Return the frozen value that `make` gives; one with open numbers by way of the closed one. `names` are of arguments."""
    given = {**dict(zip(names, arguments, strict=False)), **named}
    numbers = closed(given)
    if numbers is given:
        return make(*arguments, **named)
    value = make(**numbers)
    other = copied(value, {name: one for name, one in given.items() if numbers[name] is not one})
    object.__setattr__(other, _CLOSED, value)
    return other


def _expressed(value: float | ca.SX, beside: Expression) -> Any:
    """A number as an expression of the kind of another one, beside numbers that of the build; one that is not open as it is."""
    if not isinstance(value, ca.SX) or isinstance(beside, ca.SX):
        return value
    if isinstance(beside, ca.DM):
        return number_of(value)
    symbols = ca.symvar(value)
    graph = [_OPEN[_key(s)].graph[s.name()] for s in symbols]
    return graph[0] if value.is_symbolic() else ca.Function("fpirhc_open", symbols, [value])(*graph)


def numbers(values: Sequence[float | ca.SX], beside: Expression) -> Expression:
    """Return a column of numbers, of the kind of another one where some are open: beside numbers those of the build."""
    return ca.vertcat(*(_expressed(value, beside) for value in values))
