"""The C files of a Function: composed Functions flat, loops in C by their drivers, and what is left by CasADi."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Sequence

import casadi as ca

from fpirhc.errors import NoCode
from fpirhc.symbolic.dataflow import Callee
from fpirhc.symbolic.driver import SIGNATURE, entry_of, file_of, is_driver, of_type, renamed, works_alone
from fpirhc.symbolic.flat_code import HEAD, FlatCode

NAME = "fpirhc_native"  # stands for the exported name, which is made of the key
_EXPORT = re.compile(
    r"^CASADI_SYMBOL_EXPORT [^\n(]*?\b(\w+)\([^\n]*\{(?:[^\n]*\}\n|.*?^\}\n)\n?", re.MULTILINE | re.DOTALL
)
_CALLED = re.compile(r"^CASADI_SYMBOL_EXPORT int (\w+)\([^\n]*\{\n  return (casadi_f\d+)\(", re.MULTILINE)
_STUB = re.compile(rf"^/\* {NAME}:\(.*?(?=^/\* (?!{NAME}:)\w+:\(|\Z)", re.MULTILINE | re.DOTALL)
_OUTER = re.compile(r"^static int casadi_f0\([^\n]*\{\n.*?^\}\n", re.MULTILINE | re.DOTALL)


def generate(function: ca.Function, calls: int = 0) -> tuple[str, ...]:
    """Return the C files of a Function: its own under a fixed name, and the files of the drivers that it calls.

    `function`: the Function. `calls`: number of calls in a row, see `chained`; 0: it is called once.
    """
    called = function.find_functions()
    if any(f.is_a("External") for f in called):
        raise NoCode("it calls a Function that is already compiled; compile the whole instead")
    leaves = _Leaves()
    flat = FlatCode(leaves.callee)
    inner = flat.callee(function, always=bool(calls))
    text = leaves.text(_stub(function, calls))
    stub = _STUB.search(text)
    assert stub is not None
    outer, sizes = _outer(function, inner, calls)
    own = _OUTER.sub(lambda _: outer, stub[0], count=1)
    for key, size in sizes.items():
        own = re.sub(rf"(\*sz_{key} = )\d+", rf"\g<1>{size}", own)
    tables = [f"static const casadi_real flat_table_{k}{table}\n" for k, table in enumerate(flat.tables)]
    text = "".join([text[: stub.start()], text[stub.end() :], leaves.declared(), *tables, *flat.texts, own])
    return of_type(leaves.named(text)), *map(file_of, leaves.drivers)


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


class _Leaves:
    """What is called and not written here."""

    def __init__(self) -> None:
        self.drivers: list[str] = []
        self._leaves: dict[str, ca.Function] = {}
        self._tokens: dict[str, str] = {}

    def callee(self, function: ca.Function) -> Callee:
        """Return how it is called."""
        name = function.name()
        if is_driver(name):
            self._needs(name)
            entry, room, in_place = entry_of(name)
            return Callee(entry, (function.n_in(), function.n_out()), room, in_place=in_place)
        for inner in function.find_functions() if function.is_a("MXFunction") else ():
            if is_driver(inner.name()):
                self._needs(inner.name())
                if entry_of(inner.name())[1] > inner.sz_w():
                    raise NoCode("the work of its loops cannot be laid out")
        unique = f"{name}_{len(self._leaves)}" if name in (*self._leaves, NAME) else name
        # a renamed one may need more than the Function itself
        leaf = self._leaves[unique] = function if unique == name else renamed(function, unique)
        plain = works_alone(leaf)
        pointers = (leaf.n_in(), leaf.n_out()) if plain else (leaf.sz_arg(), leaf.sz_res())
        return Callee(f"leaf_{unique}", pointers, 0 if plain else leaf.sz_w())

    def _needs(self, name: str) -> None:
        if name not in self.drivers:
            self.drivers.append(name)

    def declared(self) -> str:
        """Return the declarations of the drivers."""
        return "".join(f"int {entry_of(name)[0]}{SIGNATURE};\n" for name in self.drivers)

    def text(self, stub: ca.Function) -> str:
        """Return CasADi's text of the stub and of all leaves, of which only the stub is exported."""
        generator = ca.CodeGenerator(NAME, {"with_header": False})
        try:
            # CasADi warns on stderr of parts that it cannot write. The text has it too, and the caller announces it once.
            with contextlib.redirect_stderr(io.StringIO()):
                generator.add(stub)
                for leaf in self._leaves.values():
                    generator.add(leaf)
                source = str(generator.dump())
        except RuntimeError as error:
            raise NoCode(f"CasADi cannot write it as C: {str(error).strip().splitlines()[-1]}") from None
        _check_self_contained(source)
        self._tokens = dict(_CALLED.findall(source))
        source = _EXPORT.sub(lambda m: m[0] if m[1].startswith(NAME) else "", source)
        for name in self.drivers:  # in a graph that CasADi writes
            entry = entry_of(name)[0]
            body = rf"(^/\* {name}:\([^\n]*\*/\nstatic int \w+\([^\n]*\) \{{\n).*?^\}}$"
            call = f"int {entry}{SIGNATURE};\n\\1  return {entry}(arg, res, iw, w, mem);\n}}"
            source = re.sub(body, call, source, flags=re.MULTILINE | re.DOTALL)
        return source

    def named(self, text: str) -> str:
        """Return the text with all functions under CasADi's kind of names."""
        text = re.sub(r"\bleaf_(\w+)\b", lambda m: self._tokens[m[1]], text)
        return re.sub(r"\bflat_(\d+)\b", r"casadi_f1000\1", text)


def _stub(function: ca.Function, calls: int) -> ca.Function:
    """A Function with the exported name, arguments and results."""
    inputs = [ca.MX.sym(function.name_in(k), function.sparsity_in(k)) for k in range(function.n_in())]
    results = [ca.MX(ca.DM(function.sparsity_out(k))) for k in range(function.n_out())]
    names = function.name_in(), function.name_out()
    if calls:
        inputs[1:] = [ca.MX.sym(one.name(), one.shape[0], calls) for one in inputs[1:]]
        results[1:] = [ca.MX.zeros(one.shape[0], calls) for one in results[1:]]
        inputs, names = [*inputs, ca.MX.sym("count")], ([*names[0], "count"], names[1])
    return ca.Function(NAME, inputs, results, *names)


def _outer(function: ca.Function, inner: Callee, calls: int) -> tuple[str, dict[str, int]]:
    """The text of the exported function, and its sizes."""
    given, made = (
        [function.nnz_in(k) for k in range(function.n_in())],
        list(map(function.nnz_out, range(function.n_out()))),
    )
    rows = len(given) + (1 if calls else 0), len(made)
    head = f"  const casadi_real** arg1=arg+{rows[0]};\n  casadi_real **res1=res+{rows[1]}, *w0=w+{inner.room};\n"
    sizes = {"arg": rows[0] + inner.pointers[0], "res": rows[1] + inner.pointers[1], "iw": int(function.sz_iw())}
    call = f"  if ({inner.name}(arg1, res1, iw, w, 0)) return 1;\n"
    if calls:
        reads = _lines("    arg1[{0}]=arg[{0}]+k*{1};\n", given, 1)
        results = _lines("    res1[{0}]=res[{0}]+k*{1};\n", made, 1)
        text = _CHAIN.format(size=given[0], count=len(given), most=calls, reads=reads, results=results, call=call)
        own = 2 * given[0]
    elif inner.sure:  # it reads and writes all rows
        ends, own = [sum(made[:k]) for k in range(len(made))], sum(made)
        text = f"  static const casadi_real none[{max([1, *given])}] = {{0}};\n" if given else ""
        text += _lines("  arg1[{0}]=arg[{0}] ? arg[{0}] : none;\n", given, 0)
        text += _lines("  res1[{0}]=res[{0}] ? res[{0}] : w0+{1};\n", ends, 0) + call
    else:
        text, own = _lines("  arg1[{0}]=arg[{0}];\n", given, 0) + _lines("  res1[{0}]=res[{0}];\n", made, 0) + call, 0
    return f"{HEAD.format('casadi_f0')}{head}{text}  return 0;\n}}\n", sizes | {"w": inner.room + own}


def _lines(line: str, sizes: Sequence[int], begin: int) -> str:
    return "".join(line.format(k, size) for k, size in enumerate(sizes) if k >= begin)


_CHAIN = """  casadi_real *w1=w0+{size}, *other;
  casadi_int i, k, count = arg[{count}] ? (casadi_int)*arg[{count}] : {most};
  if (count < 1 || count > {most}) count = {most};
  for (i=0; i<{size}; ++i) w0[i] = arg[0] ? arg[0][i] : 0;
  for (k=0; k<count; ++k) {{
    arg1[0]=w0;
    res1[0]=w1;
{reads}{results}  {call}    other=w0, w0=w1, w1=other;
  }}
  for (i=0; res[0] && i<{size}; ++i) res[0][i] = w0[i];
"""


def _check_self_contained(source: str) -> None:
    unsupported = re.search(r"^\s*#error (?:Code generation not supported for )?(\w+)", source, re.MULTILINE)
    if unsupported:
        raise NoCode(f"it calls '{unsupported[1]}', which CasADi cannot write as C")
    # It is not tried even where the header is installed: its library would have to be found and linked too.
    header = re.search(r"^#include <(.+/.+)>", source, re.MULTILINE)
    if header:
        raise NoCode(f"it calls a solver that cannot be written as C: its own library is needed ({header[1]})")
