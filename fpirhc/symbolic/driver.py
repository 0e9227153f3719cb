"""Bodies in C for Functions whose composed graph is slow to run as generated code.

A driver is a hand-written loop around generated leaf functions, with the same results as a composed Function. The composed
Function stays the definition: the virtual machine runs it, and it is compiled where a driver does not fit. When C is generated
for a Function that calls it, its body is replaced by a call of the driver.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import casadi as ca

from fpirhc.symbolic.latest import Latest

SIGNATURE = "(const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w, int mem)"
_FUNCTION = re.compile(r"^/\*[^\n]*\*/\nstatic int (casadi_f\d+)\([^\n]*\{\n.*?^\}\n", re.MULTILINE | re.DOTALL)
_CALL = re.compile(r"\bcasadi_f\d+\b")
# Large leaves are compiled without much optimising; the loops around them never are. The loops use wider registers than the
# leaves: with registers allocated across calls GCC forgets to clear their upper halves, and every leaf then runs at half speed.
_FAST = """#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize ("O3", "no-ipa-ra")
#endif"""
_drivers: dict[str, str] = {}
_LATEST: Latest[ca.Function] = Latest(16)


@dataclass(frozen=True, eq=False)
class Driver:
    """The C text of a driver.

    Args:
        text: C code that defines `int ENTRY(arg, res, iw, w, mem)`, CasADi's C signature, and calls the leaves by their keys.
            WORK and INTEGERS are defined there as the sizes of the leaves' scratch space.
        leaves: generated Functions by key.
        constants: preprocessor definitions by name.
    """

    text: str
    leaves: Mapping[str, ca.Function]
    constants: Mapping[str, object]

    def source(self) -> str:
        """Return the whole C file, in which the entry is called ENTRY."""
        generator = ca.CodeGenerator("fpirhc_leaves", {"with_header": False, "with_mem": False})
        renamed = [_renamed(leaf, f"fpirhc_leaf_{name}") for name, leaf in self.leaves.items()]
        for leaf in renamed:
            generator.add(leaf)
        lines = [f"#define {name} {value}" for name, value in self.constants.items()]
        lines += [f"#define {name} fpirhc_leaf_{name}" for name in self.leaves]
        lines += [
            f"#define WORK {max((f.sz_w() for f in renamed), default=0)}",
            f"#define INTEGERS {max((f.sz_iw() for f in renamed), default=0)}",
        ]
        # The leaves belong to this file alone: the same names in other drivers must not meet in one library.
        generated = re.sub(r"^CASADI_SYMBOL_EXPORT ", "static ", generator.dump(), flags=re.MULTILINE)
        return "\n".join([generated, *lines, _FAST, self.text])


def with_driver(name: str, driver: Driver, build: Callable[[str], ca.Function]) -> ca.Function:
    """Return `build(unique name)` with this driver as its body in C; the same body has the same Function."""
    source = driver.source()
    unique = f"{name}_{hashlib.sha256(source.encode()).hexdigest()[:16]}"
    _drivers[unique] = source
    return _LATEST.of((), (unique,), lambda: build(unique))


def substitute(source: str) -> tuple[str, list[str]]:
    """Return generated C with the bodies of Functions that have a driver replaced, and the drivers' own C files."""
    files = []
    for name in dict.fromkeys(re.findall(r"^/\* (fpirhc_\w+):\(", source, re.MULTILINE)):
        if name not in _drivers:
            continue
        body = re.compile(
            rf"(^/\* {name}:\([^\n]*\*/\nstatic int \w+\([^\n]*\) \{{\n).*?^\}}$", re.MULTILINE | re.DOTALL
        )
        entry = f"{name}_driver"
        source, count = body.subn(rf"\1  return {entry}(arg, res, iw, w, mem);\n}}", source)
        if count:
            declaration = f"int {entry}{SIGNATURE};\n"
            source = source.replace(f"/* {name}:(", f"{declaration}/* {name}:(", 1)
            files.append(f"#define ENTRY {entry}\n{_drivers[name]}")
    return (_without_unused(source) if files else source), files


def _without_unused(source: str) -> str:
    """Drop the static functions that nothing calls any more: a compiler would read and then discard them."""
    definitions = {m[1]: m[0] for m in _FUNCTION.finditer(source)}
    rest = re.sub(r"^#define .*$", "", _FUNCTION.sub("", source), flags=re.MULTILINE)
    called, waiting = set[str](), [rest]
    while waiting:
        for name in set(_CALL.findall(waiting.pop())) & definitions.keys() - called:
            called.add(name)
            waiting.append(definitions[name].partition("{")[2])
    for name in definitions.keys() - called:
        source = source.replace(definitions[name], "")
    return source


def _renamed(leaf: ca.Function, name: str) -> ca.Function:
    inputs = [ca.SX.sym(f"i{k}", leaf.sparsity_in(k)) for k in range(leaf.n_in())]
    results = leaf.call(inputs)
    return ca.Function(name, inputs, results)
