"""The C files of a Function: CasADi's own, with the loops in C of drivers in place of their bodies."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Mapping

import casadi as ca

from fpirhc.errors import NoCode
from fpirhc.symbolic.driver import SIGNATURE, is_driver, of_type, parts_of

NAME = "fpirhc_native"  # stands for the exported name, which is made of the key
_PART = re.compile(r"^(?=/\* \w+:\(.*\*/\nstatic int casadi_f\d+\(|CASADI_SYMBOL_EXPORT )", re.MULTILINE)
# What CasADi writes about libraries, which the virtual machine calls in place of drivers: C has the drivers themselves.
_LIBRARIES = "/* External functions */\n"
_LIBRARY = re.compile(
    r"^(?:int|void) fpirhc_\w+\([^)]*\);\n|^(?:CASADI_SYMBOL_EXPORT )?void \w+_(?:in|de)cref\(void\) \{[^}]*\}\n+",
    re.MULTILINE,
)
_OWN = re.compile(r"/\* (?P<name>\w+):\(.*\*/\nstatic int (?P<place>casadi_f\d+)\([^{]*\{\n")


def generate(function: ca.Function, calls: int = 0) -> tuple[str, ...]:
    """Return the C files of a Function: its own under a fixed name, and the files of the drivers that it calls."""
    called = _called(function)
    if any(f.is_a("External") for f in called):
        raise NoCode("it calls a Function that is already compiled; compile the whole instead")
    if calls:
        named = _signature_of_loop(function, calls)
    else:
        arguments = [ca.MX.sym(function.name_in(k), function.sparsity_in(k)) for k in range(function.n_in())]
        named = ca.Function(NAME, arguments, function.call(arguments), function.name_in(), function.name_out())
    generator = ca.CodeGenerator(NAME, {"with_header": False})
    try:
        # CasADi warns on stderr of parts that it cannot write. The text has it too, and the caller announces it once.
        with contextlib.redirect_stderr(io.StringIO()):
            generator.add(named)
            source = str(generator.dump())
    except RuntimeError as error:
        raise NoCode(f"CasADi cannot write it as C: {str(error).strip().splitlines()[-1]}") from None
    _check_self_contained(source)
    drivers = {f.name(): parts_of(f.name()) for f in [function, *called] if is_driver(f.name())}
    # The graph in place of which the loops of a driver stand may need less work than they do.
    bodies = {
        name: f"  casadi_real work[{max(room, 1)}];\n  return {entry}(arg, res, iw, work, mem);\n"
        for name, (entry, room, _) in drivers.items()
    }
    declared = "".join(f"int {entry}{SIGNATURE};\n" for entry, *_ in drivers.values())
    if calls:
        bodies[NAME] = _loop(source, function)
    return of_type(_with_bodies(source, bodies, declared)), *(file for *_, file in drivers.values())


def _called(function: ca.Function) -> list[ca.Function]:
    """The Functions that a Function calls, and those that these call; what a driver calls is replaced by it."""
    found = {f.name(): f for f in ([] if is_driver(function.name()) else function.find_functions(0))}
    return list({f.name(): f for one in found.values() for f in (one, *_called(one))}.values())


def _with_bodies(source: str, bodies: Mapping[str, str], declared: str) -> str:
    """The C in which some Functions have other bodies, and without what the old ones alone called."""
    head, *parts = _PART.split(_LIBRARY.sub("", source) if _LIBRARIES in source else source)
    written, waiting = dict[str, str](), list[str]()
    for k, part in enumerate(parts):
        own = _OWN.match(part)
        if own and own["name"] in bodies:
            parts[k] = f"{own[0]}{bodies[own['name']]}}}\n\n"
        if own:
            written[own["place"]] = parts[k]
        else:
            waiting.append(part)
    needed = set[str]()  # what is dead is most of the text of a plan, and would have it compiled with less optimising
    while waiting:
        fresh = set(re.findall(r"\bcasadi_f\d+\b", waiting.pop())) & written.keys() - needed
        needed |= fresh
        waiting += [written[place] for place in fresh]
    kept = (part for part in parts if not (own := _OWN.match(part)) or own["place"] in needed)
    return "".join([head, declared, *kept])


def _signature_of_loop(function: ca.Function, calls: int) -> ca.Function:
    """A graph with arguments, results and work of the loop over calls of a Function, which its body in C replaces."""
    memory, *reads = (ca.MX.sym(function.name_in(k), *function.size_in(k)) for k in range(function.n_in()))
    tables = [ca.MX.sym(one.name(), one.size1(), one.size2() * calls) for one in reads]
    after, *results = function.call([memory, *(t[:, : one.size2()] for t, one in zip(tables, reads, strict=True))])
    outputs = [after, *(ca.repmat(one, 1, calls) for one in results)]
    names = [*function.name_in(), "count"], function.name_out()
    return ca.Function(NAME, [memory, *tables, ca.MX.sym("count")], outputs, *names)


def _loop(source: str, function: ca.Function) -> str:
    """The body of the loop: two memories change places, and every call writes into its columns of the tables."""
    found = re.search(rf"^/\* {function.name()}:\([^\n]*\*/\nstatic int (\w+)\(", source, re.MULTILINE)
    assert found
    size, reads, results = function.numel_out(0), range(1, function.n_in()), range(1, function.n_out())
    first = len(reads) + 2  # arguments of the loop: the memory, the tables, the count
    lines = [  # CasADi's own chain keeps the memories of all calls, and copies that table three times
        f"casadi_real memory[2][{size}];",
        f"const casadi_real** arg1 = arg + {first};",
        f"casadi_real** res1 = res + {len(results) + 1};",
        f"casadi_int k, count = (casadi_int)arg[{first - 1}][0];",
        f"casadi_copy(arg[0], {size}, memory[0]);",
        "for (k = 0; k < count; ++k) {",
        "  arg1[0] = memory[k % 2];",
        *(f"  arg1[{i}] = arg[{i}] ? arg[{i}] + k * {function.numel_in(i)} : 0;" for i in reads),
        "  res1[0] = memory[(k + 1) % 2];",
        *(f"  res1[{i}] = res[{i}] ? res[{i}] + k * {function.numel_out(i)} : 0;" for i in results),
        f"  if ({found[1]}(arg1, res1, iw, w, 0)) return 1;",
        "}",
        f"casadi_copy(memory[count % 2], {size}, res[0]);",
        "return 0;",
    ]
    return "".join(f"  {line}\n" for line in lines)


def chained(function: ca.Function, calls: int, base: int) -> ca.Function:
    """Return a Function (memory, reads of all calls, count) -> (memory after so many calls, results of all calls)."""
    whole = function.mapaccum(f"{function.name()}_run", calls, {"base": base})
    arguments = [ca.MX.sym(whole.name_in(k), *whole.size_in(k)) for k in range(whole.n_in())]
    memories, *results = whole.call(arguments)
    count = ca.MX.sym("count")
    after = memories[:, count - 1] if calls > 1 else memories
    names = [*whole.name_in(), "count"], whole.name_out()
    return ca.Function(whole.name(), [*arguments, count], [after, *results], *names)


def _check_self_contained(source: str) -> None:
    unsupported = re.search(r"^\s*#error (?:Code generation not supported for )?(\w+)", source, re.MULTILINE)
    if unsupported:
        raise NoCode(f"it calls '{unsupported[1]}', which CasADi cannot write as C")
    # It is not tried even where the header is installed: its library would have to be found and linked too.
    header = re.search(r"^#include <(.+/.+)>", source, re.MULTILINE)
    if header:
        raise NoCode(f"it calls a solver that is not written as C, but linked as a library ({header[1]} is its header)")
