"""The worst case of an exported controller, from its code: operations of a cycle, and bytes of flash, RAM and stack.

Iterations, stages and branches are fixed, so the largest number of operations is that of the composed graph, which the loops in C
follow: of a switch the longest case counts.
"""

from __future__ import annotations

import re
import subprocess
import tempfile
from collections.abc import Iterable
from pathlib import Path

import casadi as ca

from fpirhc.controllers.sensing_chain import compose_with_sensing
from fpirhc.export.device import Device
from fpirhc.export.targets.c import sources
from fpirhc.plant.motion import NEWTON_ITERATIONS
from fpirhc.symbolic.native import find_compiler
from fpirhc.symbolic.paths import changed_at, paths_to

_FEW = 2  # iterations that a step with few of them has
_STILL = frozenset((ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST, ca.OP_PARAMETER))


def worst_case(device: Device) -> str:
    """Return the worst case in operations, as a line."""
    most = operations(device.stepper.function)
    missed = 0 if device.bare else device.most_missed
    text = f"{most} operations of a step"
    return (
        text + (f", {missed + 1} times as many after {missed} missed cycles" if missed else "") + _fewer(device, most)
    )


def bytes_here(device: Device) -> str:
    """Return the bytes of the controller on this machine as a line, empty without a compiler that counts them."""
    sizes = _bytes(device)
    if sizes is None:
        return ""
    flash, ram, stack = sizes
    return f"here with -Os: {flash} bytes of code without exp and the like, {ram} of RAM, at most {stack} of stack\n"


def _fewer(device: Device, most: int) -> str:
    """What bounds the iterations of a call, and what a lower bound would bring; empty where that is little."""
    controller, text = device.controller, ""
    bounds = {} if controller.planner is None else controller.planner.optimiser.most_work
    for name, count in bounds.items():
        for path in paths_to(name, controller) if count > _FEW else ():
            fewer = operations(compose_with_sensing(device.problem, changed_at(controller, path, _FEW)).function)
            if fewer < most / 2:
                text += (
                    f"; with {path}={count}. With {_FEW} there are {fewer}: a plan that is not solved then has the status "
                    "NOT_CONVERGED, and the next call goes on with it"
                )
    return text


def operations(function: ca.Function) -> int:
    """Return the largest number of operations of one evaluation: arithmetic, comparisons and elementary functions of numbers."""
    return _operations(function, {})


def _operations(function: ca.Function, known: dict[int, int]) -> int:
    key = function.__hash__()
    if key not in known:
        known[key] = _counted(function, known)
    return known[key]


def _counted(function: ca.Function, known: dict[int, int]) -> int:
    if function.class_name() == "SXFunction":
        return sum(function.instruction_id(k) not in _STILL for k in range(function.n_instructions()))
    if function.class_name() == "Switch":
        own = function.info()
        return max(_operations(one, known) for one in (*own["f"], own["f_def"]) if not one.is_null())
    if function.class_name() == "Map":
        own = function.info()
        return int(own["n"]) * _operations(own["f"], known)
    if function.class_name() == "FastNewton":
        return NEWTON_ITERATIONS * _of_newton_step(function, known)
    return sum(_of_instruction(function, k, known) for k in range(function.n_instructions()))


def _of_newton_step(finder: ca.Function, known: dict[int, int]) -> int:
    """Equations and slopes at a point, a dense QR solution of n equations (4/3 n^3 + 3 n^2), and the n numbers moved."""
    n = finder.numel_out(0)
    return _operations(finder.get_function("jac_g_x"), known) + (4 * n**3 + 2) // 3 + 3 * n**2 + n


def _of_instruction(function: ca.Function, k: int, known: dict[int, int]) -> int:
    if function.instruction_id(k) in _STILL:
        return 0
    made = function.instruction_MX(k)
    if made.is_call():
        return _operations(made.which_function(), known)
    if function.instruction_id(k) == ca.OP_MTIMES:
        return 2 * int(made.dep(1).size1()) * int(made.nnz())
    moves = made.is_unary() or made.is_binary()
    return int(made.nnz()) if moves else 0


def _bytes(device: Device) -> tuple[int, int, int] | None:
    """Code, struct and the deepest frames of the files added up; None without a compiler that counts them."""
    compiler = find_compiler()
    if compiler is None:
        return None
    files = sources(device)
    probe = f'#include "{device.name}.h"\nchar size[sizeof({device.name}_controller)];\n'
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, text in {**files, "size_of_it.c": probe}.items():
            (folder / file).write_text(text, encoding="utf-8")
        texts = [file for file in (*files, "size_of_it.c") if file.endswith(".c")]
        commands = [
            [compiler, "-std=c99", "-Os", "-ffp-contract=off", "-fstack-usage", "-c", *texts],
            ["size", *[f"{Path(file).stem}.o" for file in texts]],
        ]
        try:
            done = [subprocess.run(c, capture_output=True, text=True, check=True, cwd=folder) for c in commands][-1]
        except (OSError, subprocess.CalledProcessError):
            return None
        rows = [[int(word) for word in line.split()[:3]] for line in done.stdout.splitlines()[1:]]
        struct = rows[-1][1] + rows[-1][2]
        return sum(row[0] + row[1] for row in rows[:-1]), struct, deepest(said_by_gcc(folder), device.name)


def said_by_gcc(folder: Path) -> list[tuple[str, str]]:
    """Return functions with the bytes of their stack frames, as -fstack-usage has left them in a folder."""
    return [one for path in folder.glob("*.su") for one in re.findall(r":(\w+)\t(\d+)\t", path.read_text())]


def said_by_clang(text: str) -> list[tuple[str, str]]:
    """Return functions with the bytes of their stack frames, as -Wframe-larger-than=0 has told them."""
    return [(name, size) for size, name in re.findall(r"stack frame size \((\d+)\).*? in '(\w+)'", text)]


def deepest(frames: Iterable[tuple[str, str]], name: str) -> int:
    """Return bytes of stack that no step exceeds: no function calls itself, so all their frames together.

    What is called between two steps has less.
    """
    between = {f"{name}_{one}" for one in ("init", "reset", "set")}
    return sum(int(size) for function, size in frames if function not in between)
