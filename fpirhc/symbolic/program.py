"""The C files of a Function: CasADi's own, with the loops in C of drivers in place of their bodies."""

from __future__ import annotations

import contextlib
import io
import re

import casadi as ca

from fpirhc.errors import NoCode
from fpirhc.symbolic.driver import SIGNATURE, entry_of, file_of, is_driver, of_type

NAME = "fpirhc_native"  # stands for the exported name, which is made of the key
_BASE = 64  # calls of a chain that are compiled as one loop


def generate(function: ca.Function, calls: int = 0) -> tuple[str, ...]:
    """Return the C files of a Function: its own under a fixed name, and the files of the drivers that it calls.

    `function`: the Function. `calls`: number of calls in a row, see `chained`; 0: it is called once.
    """
    called = function.find_functions()
    if any(f.is_a("External") for f in called):
        raise NoCode("it calls a Function that is already compiled; compile the whole instead")
    whole = chained(function, calls, _BASE) if calls else function
    arguments = [ca.MX.sym(whole.name_in(k), whole.sparsity_in(k)) for k in range(whole.n_in())]
    named = ca.Function(NAME, arguments, whole.call(arguments), whole.name_in(), whole.name_out())
    generator = ca.CodeGenerator(NAME, {"with_header": False})
    try:
        # CasADi warns on stderr of parts that it cannot write. The text has it too, and the caller announces it once.
        with contextlib.redirect_stderr(io.StringIO()):
            generator.add(named)
            source = str(generator.dump())
    except RuntimeError as error:
        raise NoCode(f"CasADi cannot write it as C: {str(error).strip().splitlines()[-1]}") from None
    _check_self_contained(source)
    drivers = list(dict.fromkeys(f.name() for f in [function, *called] if is_driver(f.name())))
    for name in drivers:
        entry, room = entry_of(name)[:2]
        body = rf"(^/\* {name}:\([^\n]*\*/\nstatic int \w+\([^\n]*\) \{{\n).*?^\}}$"
        # The graph in place of which the loops stand may need less work than they do.
        work = f"casadi_real work[{max(room, 1)}];"
        call = f"int {entry}{SIGNATURE};\n\\1  {work}\n  return {entry}(arg, res, iw, work, mem);\n}}"
        source = re.sub(body, call, source, flags=re.MULTILINE | re.DOTALL)
    return of_type(source), *map(file_of, drivers)


def chained(function: ca.Function, calls: int, base: int) -> ca.Function:
    """Return a Function (memory, reads of all calls, count) -> (memory after so many calls, results of all calls).

    Its arguments and results are tables with a column per call, but for the memory. Compiled, what is behind the count stays.

    Args:
        function: (memory, reads...) -> (memory one call later, results...).
    """
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
        raise NoCode(f"it calls a solver that cannot be written as C: its own library is needed ({header[1]})")
