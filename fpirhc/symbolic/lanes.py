"""Composed Functions as C in which every value is a row of numbers, one of each of the loops that run side by side.

Theory: docs/theory-plants.md, "Many plants side by side".
"""

from __future__ import annotations

import ctypes
import platform
import re
from collections.abc import Sequence
from functools import cache
from importlib import resources
from pathlib import Path

import casadi as ca

from fpirhc.errors import CompileError, NoCode
from fpirhc.symbolic.dataflow import DEVICE, SIDE_BY_SIDE, Callee, Words
from fpirhc.symbolic.driver import SIGNATURE, driver_of, entry_of, is_driver
from fpirhc.symbolic.flat_code import FlatCode
from fpirhc.symbolic.native import shared_library

_TABLE = re.compile(r"\bflat_table_\d+\b")
_KNOWN = {*SIDE_BY_SIDE.operations, ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST}


def written_in_lanes(*functions: ca.Function) -> tuple[tuple[str, ...], list[Callee]]:
    """Return the C files of Functions, in which LANES is to be defined, and how they are called in the first one.

    The others are the loops of optimisers. Every argument and result needs an address.
    """
    own = _File(SIDE_BY_SIDE)
    inner = [own.flat.callee(function, always=True) for function in functions]
    files = [(name, _File(SIDE_BY_SIDE)) for name in own.drivers]
    drivers = [(file.driver(name), file) for name, file in files]
    return (own.text(), *(file.text() + text for text, file in drivers)), inner


def written_for_devices(*functions: ca.Function) -> tuple[tuple[str, ...], list[Callee]]:
    """Return Functions as pieces of one file of OpenCL C, and how they are called.

    The pieces behind the first one are the loops of optimisers, and come last: their sizes are defined by short names.
    """
    own = _File(DEVICE)
    inner = [own.flat.callee(function, always=True) for function in functions]
    drivers = [own.driver(name) for name in tuple(own.drivers)]
    if sum(bool(driver_of(name).leaves) for name in own.drivers) > 1:
        raise NoCode("the loop has several optimisers, whose loops are not written for devices together")
    return (own.text(), *drivers), inner


def lanes_library(sources: Sequence[str]) -> tuple[ctypes.CDLL, int]:
    """Compile C files for the widest registers of this machine; return the library and how many lanes it has.

    It has the vector library of the system where that can be linked.
    """
    lanes, flags = _registers()
    try:
        path = shared_library(sources, (f"-DLANES={lanes}", *flags, "-DVECTOR_LIBRARY"), ("-lmvec",))
    except CompileError:
        path = shared_library(sources, (f"-DLANES={lanes}", *flags))
    return ctypes.CDLL(str(path)), lanes


@cache
def _registers() -> tuple[int, tuple[str, ...]]:
    """How many numbers a vector register of this machine holds, and the compiler's flags for that."""
    try:
        facts = Path("/proc/cpuinfo").read_text(encoding="utf-8") if platform.machine() == "x86_64" else ""
    except OSError:
        facts = ""
    if " avx512dq " in facts:
        return 8, ("-mavx512f", "-mavx512dq", "-mprefer-vector-width=512")
    return (4, ("-mavx2",)) if " avx2 " in facts else (2, ())


class _File:
    def __init__(self, words: Words) -> None:
        self._words = words
        self.drivers: list[str] = []
        self.flat = FlatCode(self._outside, words)

    def _outside(self, function: ca.Function) -> Callee:
        """How that is called which is no graph."""
        name = function.name()
        if is_driver(name) and driver_of(name).side_by_side:
            if name not in self.drivers:
                self.drivers.append(name)
            entry, room, in_place = entry_of(name)
            return Callee(entry, (function.n_in(), function.n_out()), room, in_place=in_place)
        if function.is_a("SXFunction"):
            known = {function.instruction_id(k) for k in range(function.n_instructions())} <= _KNOWN
            if known:
                return self.flat.written(function)
        where = "lanes" if self._words.side_by_side else "devices"
        raise NoCode(f"the loop has a part that is not written for {where}: {name}")

    def driver(self, name: str) -> str:
        """The loops of an optimiser, around leaves that are among the functions of this file.

        Raises:
            NoCode: they are not written for lanes.
        """
        driver, others = driver_of(name), len(self.drivers)
        leaves = {key: self.flat.callee(leaf, always=True) for key, leaf in driver.leaves.items()}
        if len(self.drivers) > others or any(leaf.room for leaf in leaves.values()):
            raise NoCode(f"the loop has a part that is not written for lanes: a stage of {name}")
        names = {key: leaf.name for key, leaf in leaves.items()}
        before = "".join(f"#undef {one}\n" for one in (*driver.constants, *names, "ENTRY", "ROOM"))
        return f"{before}#define ENTRY {entry_of(name)[0]}\n{driver.around(names)}"

    def text(self) -> str:
        """The functions that are written so far, with what they need."""
        tables = {
            f"flat_table_{k}": f"const casadi_real flat_table_{k}{one}\n" for k, one in enumerate(self.flat.tables)
        }
        declared = [f"int {entry_of(name)[0]}{SIGNATURE};\n" for name in self.drivers]
        if self._words.side_by_side:
            shared = [f"static {table}" for table in tables.values()]
            return "".join([_prelude("lanes.c"), *shared, *declared, *self.flat.texts])
        # In OpenCL constants of a file have addresses of another kind, which no function of numbers takes.
        texts = [
            head + "{\n" + "".join(tables[name] for name in dict.fromkeys(_TABLE.findall(body))) + body
            for head, _, body in (text.partition("{\n") for text in self.flat.texts)
        ]
        return "".join([_prelude("opencl.c"), *declared, *texts])


@cache
def _prelude(name: str) -> str:
    return resources.files("fpirhc.symbolic").joinpath(name).read_text(encoding="utf-8")
