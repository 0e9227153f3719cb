"""Prints the figures by which the house is kept small; `./scripts/size` installs what it needs."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import grimp
import numpy as np
from code_lines import code_lines
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

import fpirhc as fp
from fpirhc.controllers.contract import Controller
from fpirhc.deformation.base import Deformation
from fpirhc.fields.checked import Checked
from fpirhc.plant.plant import Plant
from fpirhc.simulation.loop import close_loop

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "fpirhc"
FORM = re.compile(
    r"(?<!self)\.outputs\b|\.step is|instant_names|symbolic_reality|\.foreign\b|is_live\(|mirror\.referenced"
)
OWNERS = ("plant", "symbolic")  # folders that may ask for the form of a plant or a number


def main() -> None:
    """Print one row for each figure."""
    sources = {path: path.read_text(encoding="utf-8") for path in sorted(PACKAGE.rglob("*.py"))}
    code = {path: code_lines(text) for path, text in sources.items()}
    graph = grimp.build_graph("fpirhc", exclude_type_checking_imports=False, cache_dir=None)
    consumers = [p for p in sources if p.relative_to(PACKAGE).parts[0] not in OWNERS]
    rows = {
        "lines in fpirhc (Python and C)": lines(PACKAGE, "*.py") + lines(PACKAGE, "*.c"),
        "lines of code by tokens (Python)": sum(map(len, code.values())),
        "files (Python)": len(sources),
        "files imported by one other": sum(len(importers(graph, m)) == 1 for m in graph.modules),
        "circles of files": circles(graph),
        "lines with a condition on form": sum(bool(FORM.search(line)) for p in consumers for line in code[p]),
        "NotSupported(": sum("NotSupported(" in line for every in code.values() for line in every),
        "members of Controller": members(Controller),
        "members of Deformation": members(Deformation),
        "members of Plant": members(Plant),
        **closing(),
        "imports behind ComputedTorque": imports_behind(),
        "public names": len(fp.__all__),
        "lines of tests": lines(ROOT / "tests", "*.py"),
    }
    for name, number in rows.items():
        print(f"{name:<40} {number:>7,}".replace(",", " "))


def lines(folder: Path, pattern: str) -> int:
    """Lines of all files of a folder."""
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in folder.rglob(pattern))


def importers(graph: grimp.ImportGraph, module: str) -> set[str]:
    """Modules that import this one."""
    return set(graph.find_modules_that_directly_import(module))


def circles(graph: grimp.ImportGraph) -> int:
    """Groups of files that import each other, imports for types counted too."""
    names = sorted(graph.modules)
    number = {name: k for k, name in enumerate(names)}
    pairs = [(number[a], number[b]) for b in names for a in importers(graph, b)]
    rows, columns = np.array(pairs).T
    matrix = csr_matrix((np.ones(len(pairs)), (rows, columns)), shape=(len(names), len(names)))
    _, labels = connected_components(matrix, connection="strong")
    return int((np.bincount(labels) > 1).sum())


def members(contract: type) -> int:
    """Public names that a class and its bases define, fields included; those of checked settings are not counted."""
    own = [one for one in contract.__mro__ if one.__module__.startswith("fpirhc.") and one is not Checked]
    names = {n for one in own for n in (*vars(one), *vars(one).get("__annotations__", {}))}
    return len({n for n in names if not n.startswith("_")})


def closing() -> dict[str, int]:
    """Calls inside fpirhc, and files they touch, while a computed-torque loop is closed."""
    problem = fp.load_problem("two_mass").problem
    law = fp.ComputedTorque(fp.Exponential(rate=6.0), fp.Sigmoid(gain=-0.5))
    calls = _calls(lambda: close_loop(problem, law))
    return {"calls to close a computed-torque loop": len(calls), "files touched by them": len(set(calls))}


def _calls(build: Callable[[], object]) -> list[str]:
    """The file of every call inside fpirhc."""
    seen: list[str] = []

    def profile(frame: object, event: str, _: object) -> None:
        file = frame.f_code.co_filename  # type: ignore[attr-defined]
        if event == "call" and file.startswith(str(Path(fp.__file__).parent)):
            seen.append(file)

    sys.setprofile(profile)
    try:
        build()
    finally:
        sys.setprofile(None)
    return seen


def imports_behind() -> int:
    """Modules of fpirhc that the first use of ComputedTorque imports."""
    count = "import sys, fpirhc; fpirhc.ComputedTorque; print(sum(n.split('.')[0] == 'fpirhc' for n in sys.modules))"
    return int(subprocess.run([sys.executable, "-c", count], capture_output=True, text=True, check=True).stdout)


if __name__ == "__main__":
    main()
