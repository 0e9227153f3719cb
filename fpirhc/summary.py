"""Short forms of results: one line for a terminal, a small table for a notebook, numbers as people write them.

Names and reasons come from a user's files, so all of them are escaped for the place where they appear.
"""

from __future__ import annotations

import html
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    import pandas as pd

HELD = re.compile(r"(?<=\d) (?=\S{1,12}(?:\s|$))")  # a space in a number, or before its unit: no line ends there
_LEAST_SHARE, _MOST = 1e-5, 1e3  # shares below and above which no number is said
_ROUNDING = 1e-9  # share of its scale, below which an error has no meaning
_SHORT = 1e-3, 1e6  # from where to where a number is written without a power of ten


@dataclass(frozen=True)
class Column:
    """One column of a table."""

    head: str  # its heading
    short: str | None = ""  # its heading where there is little room; '': the same one; None: the column is not there
    left: bool = False  # whether its texts stand on the left
    note: str = ""  # what its numbers are


@dataclass(frozen=True)
class Row:
    """One row of a table."""

    cells: Sequence[str]  # a text for every column; '' where there is none
    style: str = ""  # of a terminal, and a class of a page
    best: frozenset[int] = frozenset()  # places of the columns in which it is the best


@dataclass(frozen=True)
class Table:
    """A table of texts, which pages, terminals and notebooks lay out, each in its way.

    Args:
        title: above the table.
        columns: its columns; the first `names` of them name the rows.
        caption: below the table.
        names: number of columns that name a row.
        rows: its rows.
    """

    title: str
    columns: Sequence[Column]
    caption: str = ""
    names: int = 1
    rows: list[Row] = field(default_factory=list)

    def add(self, cells: Sequence[str], style: str = "", best: Iterable[int] = ()) -> None:
        """Add a row with a text for every column."""
        self.rows.append(Row(cells, style, frozenset(best)))

    @property
    def filled(self) -> Table:
        """The table without columns in which no row has a text."""
        return self.of([k for k, _ in enumerate(self.columns) if k < self.names or any(r.cells[k] for r in self.rows)])

    @property
    def narrow(self) -> Table:
        """The table where there is little room: fewer columns, with their short headings."""
        fewer = self.of([k for k, one in enumerate(self.columns) if one.short is not None])
        return replace(fewer, columns=[replace(c, head=c.short or c.head) for c in fewer.columns])

    def html(self, notes: Iterable[str] = ()) -> str:
        """Return the table for a notebook."""
        return table(self.title, [c.head for c in self.columns], [row.cells for row in self.rows], notes)

    def of(self, places: Sequence[int]) -> Table:
        """Return the table with the columns of these places alone."""
        rows = [
            Row([r.cells[k] for k in places], r.style, frozenset(at for at, k in enumerate(places) if k in r.best))
            for r in self.rows
        ]
        return replace(self, columns=[self.columns[k] for k in places], rows=rows)


def line(value: object, *facts: str) -> str:
    """Return 'Class(fact, fact)' on one line."""
    return f"{type(value).__name__}({', '.join(printable(f).replace(chr(10), ' ') for f in facts)})"


def table(title: str, head: Sequence[str], rows: Iterable[Sequence[str]], notes: Iterable[str] = ()) -> str:
    """Return HTML: a caption, a table whose first column names the rows, and notes under it."""
    top = "".join(f"<th>{_escaped(h)}</th>" for h in head)
    body = "".join(
        f"<tr><th>{_escaped(first)}</th>{''.join(f'<td>{_escaped(cell)}</td>' for cell in others)}</tr>"
        for first, *others in rows
    )
    below = "".join(f"<p>{_escaped(n)}</p>" for n in notes if n)
    return f"<div><table><caption>{_escaped(title)}</caption><tr>{top}</tr>{body}</table>{below}</div>"


def in_units(frame: pd.DataFrame, units: Mapping[str, str]) -> pd.DataFrame:
    """Return the frame; its `attrs["units"]` have the units of columns, by name, of those that have one."""
    frame.attrs["units"] = {name: unit for name, unit in units.items() if unit not in ("", "1")}
    return frame


def write_csv(table: pd.DataFrame, path: Path) -> None:
    """Write a table with the units of its columns in their headings."""
    units = table.attrs.get("units", {})
    table.rename(columns={name: f"{name} [{unit}]" for name, unit in units.items()}).to_csv(path, index=False)


def printable(text: str) -> str:
    """Return the text with unprintable characters, such as escape codes of a terminal, written out; new lines stay."""
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode("ascii") for c in text)


def number(value: float) -> str:
    """Return a number in four digits as people write it, see `written_out`."""
    return written_out(value, 4)


def in_percent(share: float) -> str:
    """Return a share in percent, in three digits; what is below a thousandth or beyond a hundred thousand is said to be so."""
    if _MOST < share < math.inf:
        return "more than 100 000 %"
    return "less than 0.001 %" if 0 < abs(share) < _LEAST_SHARE else f"{written_out(100 * share)} %"


def beside(value: float, scale: float) -> str:
    """Return an error in three digits; what is rounding beside its scale is said to be so."""
    return "0 to rounding" if 0 < value <= _ROUNDING * scale else written_out(value)


def written_out(value: float, digits: int = 3) -> str:
    """Return a number in so many digits as people write it: 4 050 and 245 000, from a million on 4.6e9, below a thousandth 2e-7."""
    rounded = float(f"{value:.{digits}g}") + 0.0  # which has no -0
    if not rounded or not math.isfinite(rounded) or _SHORT[0] <= abs(rounded) < _SHORT[1]:
        return f"{rounded:,.15g}".replace(",", " ")
    mantissa, power = f"{rounded:.15e}".split("e")
    return f"{float(mantissa):.{digits}g}e{int(power)}"


def in_words(says: str, numbers: Mapping[str, float], units: Mapping[str, str], **texts: str) -> str:
    """Return a text of parts behind '|' that are there where their numbers are finite: {a:%} in percent, {a:u} with a unit."""

    class Shown(float):
        def __format__(self, spec: str) -> str:
            digits = int(spec) if spec.isdigit() else 3
            return in_percent(self) if spec == "%" else written_out(float(self), digits) + units.get(spec, "")

    known, parts = texts | {name: Shown(v) for name, v in numbers.items() if math.isfinite(v)}, list[str]()
    for part in says.split("|"):
        with suppress(KeyError):
            parts.append(part.strip().format_map(known))
    lost = ["a run ends early"] if any(map(math.isinf, numbers.values())) else []
    return ", ".join([*parts, *lost]).replace(", (", " (")


def _escaped(text: str) -> str:
    return html.escape(printable(text), quote=True)
