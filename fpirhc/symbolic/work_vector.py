"""The work vector of generated C, without the space of Functions whose bodies a driver replaces.

CasADi gives every Function of a program one work vector w: its callees get w from its begin, and its own values stand behind what
the largest callee needs. A driver keeps its numbers on the stack and leaves w alone. So its callers' own values can move down, and
the program needs less. A Function is changed only where its text shows that nothing but calls uses the begin of w.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

_FUNCTION = re.compile(
    r"(?:^/\* (\w+):\([^\n]*\*/\n)?^static int (casadi_f\d+)\([^\n]*\) \{\n(.*?)^\}$", re.MULTILINE | re.DOTALL
)
_OWN = re.compile(r"(?<=[ *])(w\d+)=w\+(\d+)(?=[,;])")
_CALL = re.compile(r"\b(casadi_f\d+|\w+_driver)\([^;\n]*, w, (?:0|mem)\)")
_USE = re.compile(r"\bw\b")
_EXPORTED = re.compile(r"^CASADI_SYMBOL_EXPORT int (\w+)_work\(.*?\*sz_w = (\d+)", re.MULTILINE | re.DOTALL)
_SIZE = re.compile(r"(\*sz_w = )(\d+)")


@dataclass(frozen=True)
class _Body:
    """One generated function: its text, the name of the Function, its callees, and where its own values begin, None if nowhere."""

    name: str
    text: str
    callees: tuple[str, ...]
    begin: int | None
    plain: bool  # only calls use the begin of w


def with_less_work(source: str, sizes: Mapping[str, int]) -> str:
    """Return a program with the same results and a shorter work vector.

    Args:
        source: generated C, in which calls of drivers stand in place of bodies.
        sizes: of the work vectors of all Functions, by name, as CasADi made them.
    """
    exported = _EXPORTED.search(source)
    if exported is None:
        return source
    sizes = {**sizes, exported[1]: int(exported[2])}
    bodies = {m[2]: _body(m[1] or "", m[3]) for m in _FUNCTION.finditer(source)}
    needs = dict[str, int | None]()
    for key in bodies:
        _need(key, bodies, sizes, needs)
    top = [key for key, body in bodies.items() if body.name == exported[1]]
    if len(top) != 1 or any(need is None for need in needs.values()):
        return source
    source = _FUNCTION.sub(lambda m: m[0].replace(m[3], _moved(bodies[m[2]], needs)), source)
    return _SIZE.sub(lambda m: f"{m[1]}{needs[top[0]]}", source)


def _body(name: str, text: str) -> _Body:
    own = [int(m[2]) for m in _OWN.finditer(text)]
    callees = tuple(m[1] for m in _CALL.finditer(text))
    plain = not _USE.search(_CALL.sub("", _OWN.sub("", text)))
    return _Body(name, text, callees, min(own) if own else None, plain)


def _need(key: str, bodies: Mapping[str, _Body], sizes: Mapping[str, int], needs: dict[str, int | None]) -> int | None:
    """What a function needs after the move; None where that is not known."""
    if key not in bodies:
        return 0 if key.endswith("_driver") else None
    if key not in needs:
        body = bodies[key]
        inner = [_need(callee, bodies, sizes, needs) for callee in body.callees]
        below = None if None in inner else max((n for n in inner if n is not None), default=0)
        if below is None or not body.plain:
            needs[key] = sizes.get(body.name)
        elif body.begin is None:
            needs[key] = below
        else:
            size = sizes.get(body.name)
            needs[key] = None if size is None else size - max(body.begin - below, 0)
    return needs[key]


def _moved(body: _Body, needs: Mapping[str, int | None]) -> str:
    """The text with the function's own values directly behind what its callees need."""
    if body.begin is None or not body.plain:
        return body.text
    below = max((needs.get(callee) or 0 for callee in body.callees), default=0)
    shift = max(body.begin - below, 0)
    return _OWN.sub(lambda m: f"{m[1]}=w+{int(m[2]) - shift}", body.text)
