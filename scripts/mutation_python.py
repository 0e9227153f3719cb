"""Small faults of Python modules, made by Cosmic Ray, for scripts/mutation.py."""

from __future__ import annotations

import ast
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from cosmic_ray.commands.init import init
from cosmic_ray.mutating import use_mutation
from cosmic_ray.plugins import get_operator
from cosmic_ray.work_db import use_db
from cosmic_ray.work_item import WorkItem


@dataclass(frozen=True)
class ModuleFault:
    """A fault that Cosmic Ray knows.

    Args:
        item: how it names the fault.
    """

    item: WorkItem

    @property
    def place(self) -> tuple[object, object]:
        """Where it is; faults of one place are alternatives."""
        [fault] = self.item.mutations
        return fault.start_pos, fault.end_pos

    @contextmanager
    def made(self) -> Iterator[tuple[str, str]]:
        """The module with the fault, while the context lasts: its text before and after."""
        [fault] = self.item.mutations
        operator = get_operator(fault.operator_name)(**fault.operator_args)
        with use_mutation(fault.module_path, operator, fault.occurrence) as (before, after):
            if after is None:
                raise SystemExit(f"{fault.module_path}: {fault.operator_name} {fault.occurrence} cannot be made")
            yield before, after


def faults(path: Path) -> list[ModuleFault]:
    """Every fault that the tool knows for a module, but for those of parts that change no result, see `_without_effect`."""
    with tempfile.TemporaryDirectory() as folder, use_db(str(Path(folder, "faults.sqlite"))) as database:
        init([path], database, {})
        items = database.work_items
    unread = list(_without_effect(ast.parse(path.read_text(encoding="utf-8"))))
    read = [
        i for i in items if not any(a <= i.mutations[0].start_pos and i.mutations[0].end_pos <= b for a, b in unread)
    ]
    return [
        ModuleFault(i) for i in sorted(read, key=lambda i: (i.mutations[0].operator_name, i.mutations[0].occurrence))
    ]


def _without_effect(tree: ast.Module) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Begin and end of annotations, of what stands under `if TYPE_CHECKING`, and of values that no result depends on.

    These are EXAMPLES and `examples`, whose numbers the laws do not need, `order=`, which sorts columns, and `strict=` of equal
    lengths.
    """
    for node in ast.walk(tree):
        parts = [getattr(node, "annotation", None), getattr(node, "returns", None)]
        if isinstance(node, ast.keyword) and node.arg in ("order", "strict"):
            parts.append(node.value)
        if isinstance(node, ast.Assign) and [getattr(t, "id", "") for t in node.targets] == ["EXAMPLES"]:
            parts.append(node.value)
        if isinstance(node, ast.FunctionDef) and node.name == "examples":
            parts.extend(node.body)
        for part in parts:
            if part is not None:
                yield (part.lineno, part.col_offset), (part.end_lineno, part.end_col_offset)
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            last = node.body[-1]
            yield (node.lineno, node.col_offset), (last.end_lineno or last.lineno, last.end_col_offset or 0)
