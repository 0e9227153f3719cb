"""Short forms of results: one line for a terminal, a small table for a notebook.

Names and reasons come from a user's files, so all of them are escaped for the place where they appear.
"""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence

_LEAST_SHARE = 1e-5


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


def printable(text: str) -> str:
    """Return the text with unprintable characters, such as escape codes of a terminal, written out; new lines stay."""
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode("ascii") for c in text)


def number(value: float) -> str:
    """Return a number in four digits."""
    return f"{value:.4g}"


def in_percent(share: float) -> str:
    """Return a share in percent, in three digits; what is below a thousandth of a percent is said to be so."""
    return "below 0.001 %" if 0 < abs(share) < _LEAST_SHARE else f"{100 * share:.3g} %"


def written_out(value: float, digits: int) -> str:
    """Return a number in so many digits and without a power of ten, its thousands apart: 245 000."""
    return f"{float(f'{value:.{digits}g}'):,.15g}".replace(",", " ") if abs(value) >= 1 else f"{value:.{digits}g}"


def _escaped(text: str) -> str:
    return html.escape(printable(text), quote=True)
