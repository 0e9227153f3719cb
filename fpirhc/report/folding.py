"""Tables that fold: columns that do not fit beside each other go on below, and no column is cut or lost.

Every part of a folded table begins with the columns that name the rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.console import Console, JustifyMethod
from rich.table import Table
from rich.text import Text

from fpirhc.summary import printable

_NAMED = 24  # characters of a name that stand on one line where there is little room
_BETWEEN = 2  # between two columns: a space of each and the box between them
_EDGES = 2  # columns left and right of a table


@dataclass(frozen=True)
class Column:
    """One column.

    Args:
        head: its heading, which may wrap at spaces.
        left: whether its texts stand on the left.
    """

    head: str
    left: bool = False


@dataclass
class Folding:
    """A table for a terminal.

    Args:
        title: above the table.
        columns: its columns; the first `names` of them name the rows.
        caption: below the table.
        names: number of columns that every part repeats.
        rows: texts and styles of the rows.
    """

    title: str
    columns: Sequence[Column]
    caption: str = ""
    names: int = 1
    rows: list[tuple[Sequence[str], str]] = field(default_factory=list)

    def add(self, cells: Sequence[str], style: str = "") -> None:
        """Add a row with a text for every column."""
        self.rows.append((cells, style))

    def show(self, console: Console) -> None:
        """Print the table in as many parts as the width of the console needs."""
        parts = self._parts(console.width)
        for k, part in enumerate(parts):
            title = printable(self.title) + (" (continued)" if k else "")
            last = k == len(parts) - 1
            console.print(self._table(part, title, printable(self.caption) if last else "", console.width))

    def _parts(self, width: int) -> list[list[int]]:
        """Places of the columns of every part, without those that name the rows."""
        room = width - _EDGES - sum(self._least(k) + _BETWEEN for k in range(self.names))
        parts: list[list[int]] = [[]]
        used = 0
        for k in range(self.names, len(self.columns)):
            need = self._least(k) + _BETWEEN
            if parts[-1] and used + need > room:
                parts.append([])
                used = 0
            parts[-1].append(k)
            used += need
        return parts

    def _least(self, place: int) -> int:
        """The least width of a column: of the longest word of its heading and its longest text; names may wrap."""
        texts = [cell_len(printable(cells[place])) for cells, _ in self.rows]
        if place < self.names:
            texts = [min(length, _NAMED) for length in texts]
        return max([*texts, *(cell_len(word) for word in printable(self.columns[place].head).split())], default=1)

    def _table(self, part: Sequence[int], title: str, caption: str, width: int) -> Table:
        table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), title=Text(title), caption=Text(caption) or None)
        places = [*range(self.names), *part]
        for k, own in zip(places, self._widths(places, width), strict=True):
            justify: JustifyMethod = "left" if k < self.names or self.columns[k].left else "right"
            table.add_column(Text(printable(self.columns[k].head)), justify=justify, width=own, overflow="fold")
        for cells, style in self.rows:
            table.add_row(*(Text(printable(cells[k])) for k in places), style=style)
        return table

    def _widths(self, places: Sequence[int], width: int) -> list[int]:
        """Widths of columns: the least, and then as much as names and headings need on one line, from left to right."""
        widths = [self._least(k) for k in places]
        rest = width - _EDGES - sum(widths) - _BETWEEN * len(widths)
        for k, place in enumerate(places):
            names = [cell_len(printable(cells[place])) for cells, _ in self.rows] if place < self.names else []
            wanted = max([cell_len(printable(self.columns[place].head)), *names])
            more = min(max(wanted - widths[k], 0), max(rest, 0))
            widths[k] += more
            rest -= more
        return widths
