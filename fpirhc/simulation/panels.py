"""Pictures of panels side by side as SVG: what matplotlib draws of the same calls, in a tenth of its time and sharp at every size.

A panel has the methods of matplotlib's Axes that `fpirhc.simulation.drawing` calls: what draws on the one draws on the other.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape

import numpy as np

_INCH = 88.0  # pixels
_POINT = _INCH / 72
_TEXT, _SMALL = 10 * _POINT, 7 * _POINT  # sizes of labels and of the legend
_LETTER = 0.6  # width of a letter, of its size; a wide one, because every browser has its own
_MARGIN = 0.05  # of the range, around all that is drawn
_LARGEST = 1e200  # number that is drawn
_FINE = 10  # steps of a pixel in which lines are written
_EXACT = 0.1  # pixels by which a line may be written wrong
_DASHES = {"-": "", "--": "3.7 1.6", ":": "1 1.65"}  # in widths of the line
_STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
_SHORT = (-3, 4)  # exponents of numbers that are written out
_FRAME = "#000000"


@dataclass(frozen=True, eq=False)
class Mark:
    """Something drawn: a line, one that crosses the panel (no x or no y), a band between two x, or points.

    Args:
        shape: "line", "band", "o" or "x".
        x: places in units of the axis; None: the whole width.
        y: the same; None: the whole height.
        colour: with a number sign.
        width: of the line, points.
        style: "-", "--" or ":".
        size: of a point, points.
        opacity: of a band.
        label: in the legend; None: not there.
        above: marks with a larger number are drawn later.
    """

    shape: str
    x: np.ndarray | None
    y: np.ndarray | None
    colour: str
    width: float
    style: str = "-"
    size: float = 0.0
    opacity: float = 1.0
    label: str | None = None
    above: int = 0


@dataclass
class Panel:
    """One chart with its frame, ticks, labels and legend; calls are those of matplotlib's Axes."""

    marks: list[Mark] = field(default_factory=list)
    logarithmic: bool = False
    _limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    _labels: dict[str, str] = field(default_factory=dict)
    _grid: bool = False
    _legend: bool = False

    def plot(
        self,
        x: np.ndarray | float,
        y: np.ndarray | float,
        style: str = "-",
        *,
        color: str,
        lw: float = 1.5,
        label: str | None = None,
        ms: float = 0.0,
        mfc: str | None = None,  # noqa: ARG002 (rings are never filled)
        mew: float = 1.0,
        zorder: int = 0,
    ) -> None:
        """Draw a line in a style of `_DASHES`, or rings "o" or crosses "x"."""
        points = style not in _DASHES
        shape, dash, width = (style, "-", mew) if points else ("line", style, lw)
        self.marks.append(Mark(shape, _row(x), _row(y), color, width, dash, ms, label=label, above=zorder))

    def semilogy(self, x: np.ndarray, y: np.ndarray, *, color: str, lw: float = 1.5, label: str | None = None) -> None:
        """Draw a line over a logarithmic axis."""
        self.logarithmic = True
        self.plot(x, y, color=color, lw=lw, label=label)

    def axhline(
        self, y: float = 0.0, *, color: str = _FRAME, lw: float = 1.5, ls: str = "-", label: str | None = None
    ) -> None:
        """Draw a line across the panel."""
        self.marks.append(Mark("line", None, _row(y), color, lw, ls, label=label))

    def axvline(
        self, x: float = 0.0, *, color: str = _FRAME, lw: float = 1.5, ls: str = "-", label: str | None = None
    ) -> None:
        """Draw an upright line through the panel."""
        self.marks.append(Mark("line", _row(x), None, color, lw, ls, label=label))

    def axvspan(
        self, xmin: float, xmax: float, *, color: str, alpha: float, lw: float = 0.0, label: str | None = None
    ) -> None:
        """Draw a pale band."""
        self.marks.append(Mark("band", np.array([xmin, xmax]), None, color, lw, opacity=alpha, label=label))

    def grid(self, *, visible: bool = True, alpha: float = 0.25) -> None:  # noqa: ARG002 (one grid for all)
        """Draw a grid."""
        self._grid = visible

    def legend(self, *, fontsize: int = 7, loc: str = "best", framealpha: float = 0.8) -> None:  # noqa: ARG002 (one look)
        """Draw a legend where it hides least."""
        self._legend = True

    def get_legend_handles_labels(self) -> tuple[list[Mark], list[str]]:
        """Marks with a label, and their labels."""
        named = [mark for mark in self.marks if mark.label is not None]
        return named, [_plain(mark.label or "") for mark in named]

    def set_title(self, label: str, *, fontsize: int = 10) -> None:  # noqa: ARG002 (one size)
        """Set the words above the panel."""
        self._labels["title"] = _plain(label)

    def set_xlabel(self, xlabel: str) -> None:
        """Set the words below the panel."""
        self._labels["x"] = _plain(xlabel)

    def set_ylabel(self, ylabel: str) -> None:
        """Set the words left of the panel."""
        self._labels["y"] = _plain(ylabel)

    def get_xlabel(self) -> str:
        """The words below the panel."""
        return self._labels.get("x", "")

    def get_ylabel(self) -> str:
        """The words left of the panel."""
        return self._labels.get("y", "")

    def get_title(self) -> str:
        """The words above the panel."""
        return self._labels.get("title", "")

    def set_xlim(self, left: float, right: float) -> None:
        """Set the range of x."""
        self._limits["x"] = left, right

    def set_ylim(self, bottom: float, top: float) -> None:
        """Set the range of y."""
        self._limits["y"] = bottom, top

    def get_xlim(self) -> tuple[float, float]:
        """The range of x: the one that was set, or that of all that is drawn, with a margin."""
        return self._limits.get("x") or _around([m.x for m in self.marks if m.x is not None])

    def get_ylim(self) -> tuple[float, float]:
        """The range of y, as that of x."""
        if "y" in self._limits:
            return self._limits["y"]
        places = [m.y for m in self.marks if m.y is not None]
        if not self.logarithmic:
            return _around(places)
        low, high = _around([_decades(y) for y in places])
        return 10.0**low, 10.0**high


class Panels:
    """A picture of panels in a row."""

    def __init__(self, width: float, height: float, count: int = 1) -> None:
        """Make empty panels.

        Args:
            width: of the picture, inches.
            height: of it.
            count: number of panels.
        """
        self._width, self._height = width * _INCH, height * _INCH
        self.axes = [Panel() for _ in range(count)]

    @property
    def address(self) -> str:
        """The picture as the address of an image inside a page."""
        return f"data:image/svg+xml;base64,{b64encode(self.svg().encode()).decode('ascii')}"

    def svg(self) -> str:
        """Return the picture."""
        views = [_View(panel) for panel in self.axes]
        left = max(view.room for view in views)
        top, bottom = 2.2 * _TEXT if any(p.get_title() for p in self.axes) else 1.2 * _TEXT, 3.4 * _TEXT
        each = self._width / len(views)
        inner = each - left - _TEXT, self._height - top - bottom
        drawn = "".join(
            f'<g transform="translate({k * each + left:.1f} {top:.1f})">{view.svg(*inner, k)}</g>'
            for k, view in enumerate(views)
        )
        size = f'width="{self._width:.0f}" height="{self._height:.0f}"'
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" {size} viewBox="0 0 {self._width:.0f} {self._height:.0f}" '
            f'font-family="DejaVu Sans,Verdana,sans-serif" font-size="{_TEXT:.1f}"><rect {size} fill="#ffffff"/>{drawn}</svg>'
        )


class _View:
    """A panel with the ticks of its ranges."""

    def __init__(self, panel: Panel) -> None:
        self._panel = panel
        self._x, self._y = panel.get_xlim(), panel.get_ylim()
        if panel.logarithmic:
            self._y = np.log10(self._y[0]), np.log10(self._y[1])
        self._level = _ticks(*self._y, 9, whole=panel.logarithmic)
        self._heights = ([f"{10.0**k:.3g}" for k in self._level], "") if panel.logarithmic else _numbers(self._level)

    @property
    def room(self) -> float:
        """Pixels that the numbers and words on the left need."""
        longest = max((len(text) for text in self._heights[0]), default=0)
        return (_LETTER * longest + 2.4) * _TEXT

    def svg(self, width: float, height: float, number: int) -> str:
        """Return all that belongs to the panel, from the upper left corner of its frame."""
        self._width, self._height = width, height
        self._upright = next(
            places for most in (9, 7, 5, 3) if self._fits(places := _ticks(*self._x, most)) or most == 3
        )
        inside = "".join(map(self._drawn, sorted(self._panel.marks, key=lambda m: m.above)))
        frame = f'width="{width:.1f}" height="{height:.1f}"'
        return (
            f'<clipPath id="c{number}"><rect {frame}/></clipPath>{self._axes()}'
            f'<g clip-path="url(#c{number})" fill="none">{inside}</g>'
            f'<rect {frame} fill="none" stroke="{_FRAME}"/>{self._words()}{self._legend()}'
        )

    def _fits(self, places: np.ndarray) -> bool:
        """Whether the numbers of these ticks stand apart."""
        return sum(len(text) + 1 for text in _numbers(places)[0]) * _LETTER * _TEXT < self._width

    def _across(self, x: np.ndarray) -> np.ndarray:
        return (x - self._x[0]) / (self._x[1] - self._x[0]) * self._width

    def _down(self, y: np.ndarray) -> np.ndarray:
        y = _decades(y) if self._panel.logarithmic else y
        return self._height - (y - self._y[0]) / (self._y[1] - self._y[0]) * self._height

    def _points(self, mark: Mark) -> np.ndarray:
        """Pixels of a mark, (n, 2), NaN where there is none; far ones are brought near, or their digits would end."""
        x, y = mark.x, mark.y
        across = np.array([0.0, self._width]) if x is None else self._across(_drawable(x))
        down = np.array([0.0, self._height]) if y is None else self._down(_drawable(y))
        return np.clip(np.stack(np.broadcast_arrays(across, down), axis=1), -1e4, 1e4)

    def _drawn(self, mark: Mark) -> str:
        points, pen = self._points(mark), _pen(mark)
        if mark.shape == "band":
            (begin, _), (end, _) = points
            area = f'x="{begin:.1f}" width="{end - begin:.1f}" height="{self._height:.1f}"'
            return f'<rect {area} fill="{mark.colour}" fill-opacity="{mark.opacity:g}"/>'
        if mark.shape != "line":
            return "".join(_symbol(mark, x, y) for x, y in points if np.isfinite(x + y))
        return f'<g transform="scale({1 / _FINE:g})"><path d="{_path(points)}" {pen}/></g>'

    def _axes(self) -> str:
        """Ticks with their numbers, and the grid."""
        ticks, texts, grid = [], [], []
        level = self._height - (self._level - self._y[0]) / (self._y[1] - self._y[0]) * self._height
        for at, text in zip(self._across(self._upright), _numbers(self._upright)[0], strict=True):
            ticks.append(f"M{at:.1f} {self._height:.1f}v4")
            grid.append(f"M{at:.1f} 0V{self._height:.1f}")
            texts.append(_word(at, self._height + 4 + 1.1 * _TEXT, text, "middle"))
        for at, text in zip(level, self._heights[0], strict=True):
            ticks.append(f"M0 {at:.1f}h-4")
            grid.append(f"M0 {at:.1f}H{self._width:.1f}")
            texts.append(_word(-6, at + 0.36 * _TEXT, text, "end"))
        lines = f'<path d="{"".join(ticks)}" stroke="{_FRAME}"/>'
        if self._panel._grid:
            lines += f'<path d="{"".join(grid)}" stroke="#b0b0b0" stroke-opacity=".25"/>'
        return lines + "".join(texts)

    def _words(self) -> str:
        """Title, labels and common factors of the ticks."""
        middle, panel = self._width / 2, self._panel
        below = self._height + 2.6 * _TEXT
        turned = f'transform="translate({1.2 * _TEXT - self.room:.1f} {self._height / 2:.1f}) rotate(-90)"'
        return (
            _word(middle, -0.6 * _TEXT, panel.get_title(), "middle")
            + _word(middle, below, panel.get_xlabel(), "middle")
            + _word(self._width, below, _numbers(self._upright)[1], "end")
            + _word(0, -0.3 * _TEXT, self._heights[1], "start")
            + f"<g {turned}>{_word(0, 0, panel.get_ylabel(), 'middle')}</g>"
        )

    def _legend(self) -> str:
        marks, labels = self._panel.get_legend_handles_labels()
        if not (self._panel._legend and marks):
            return ""
        row, sample = 1.4 * _SMALL, 2 * _SMALL
        size = sample + (1.6 + _LETTER * max(map(len, labels))) * _SMALL, row * len(marks) + 0.6 * _SMALL
        x, y = self._free(*size)
        parts = []
        for k, (mark, label) in enumerate(zip(marks, labels, strict=True)):
            level = y + 0.3 * _SMALL + (k + 0.5) * row
            parts.append(_sample(mark, x + 0.4 * _SMALL, level, sample))
            parts.append(_word(x + sample + 0.9 * _SMALL, level + 0.36 * _SMALL, label, "start"))
        box = f'x="{x:.1f}" y="{y:.1f}" width="{size[0]:.1f}" height="{size[1]:.1f}" rx="2"'
        paper = f'<rect {box} fill="#ffffff" fill-opacity=".8" stroke="#cccccc"/>'
        return f'<g font-size="{_SMALL:.1f}">{paper}{"".join(parts)}</g>'

    def _free(self, width: float, height: float) -> tuple[float, float]:
        """The corner, edge or middle where a box hides the fewest points of lines."""
        marks = [mark for mark in self._panel.marks if mark.x is not None and mark.y is not None]
        points = np.concatenate([self._points(mark) for mark in marks]) if marks else np.zeros((0, 2))
        right, low, gap = self._width - width, self._height - height, 0.5 * _TEXT
        columns, rows = {"r": right - gap, "l": gap, "c": right / 2}, {"t": gap, "b": low - gap, "c": low / 2}
        corners = [(columns[c], rows[r]) for c, r in ("rt", "lt", "lb", "rb", "rc", "lc", "cb", "ct", "cc")]
        hidden = [np.all((points >= at) & (points <= np.add(at, (width, height))), axis=1).sum() for at in corners]
        return corners[int(np.argmin(hidden))]


def _row(values: np.ndarray | float) -> np.ndarray:
    return np.atleast_1d(np.asarray(values, dtype=float))


def _drawable(values: np.ndarray) -> np.ndarray:
    """The numbers, and NaN in place of those that no line reaches."""
    return np.where(np.abs(values) <= _LARGEST, values, np.nan)


def _decades(values: np.ndarray) -> np.ndarray:
    """The decimal logarithm, NaN where there is none."""
    return np.log10(np.where(values > 0, values, np.nan))


def _plain(text: str) -> str:
    """A text as it was before matplotlib's dollar signs were marked."""
    return text.replace(r"\$", "$")


def _around(places: Sequence[np.ndarray]) -> tuple[float, float]:
    """The range of all numbers with a margin; a range around a single number, and from 0 to 1 without any."""
    every = _drawable(np.concatenate([_row(one) for one in places])) if places else np.zeros(0)
    every = every[np.isfinite(every)]
    if not every.size:
        return 0.0, 1.0
    low, high = float(every.min()), float(every.max())
    if high - low <= 1e-13 * max(abs(low), abs(high)):
        wide = _MARGIN * (max(abs(low), abs(high)) or 1.0)
        return low - wide, high + wide
    margin = _MARGIN * (high - low)
    return low - margin, high + margin


def _ticks(low: float, high: float, most: int, *, whole: bool = False) -> np.ndarray:
    """Even places for at most so many ticks; whole numbers where at least two lie in the range."""
    rough = (high - low) / most
    power = 10.0 ** np.floor(np.log10(rough))
    step = next(s * power for s in _STEPS if s * power >= rough * (1 - 1e-9))
    step = max(np.ceil(step), 1.0) if whole and np.floor(high) > np.ceil(low) else step
    return step * np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1)


def _numbers(ticks: np.ndarray) -> tuple[list[str], str]:
    """Texts of ticks, and their common factor; empty where they are written out."""
    largest = np.abs(ticks).max(initial=0.0)
    exponent = int(np.floor(np.log10(largest))) if largest else 0
    exponent = 0 if _SHORT[0] <= exponent <= _SHORT[1] else exponent
    values = ticks / 10.0**exponent
    step = float(np.diff(values).min()) if len(values) > 1 else abs(float(values[0])) if values.size else 1.0
    digits = next((d for d in range(12) if np.abs(values - values.round(d)).max(initial=0.0) <= 1e-3 * step), 12)
    texts = [f"{abs(v) if v == 0 else v:.{digits}f}".replace("-", "−") for v in values.round(digits)]
    return texts, f"1e{exponent}" if exponent else ""


def _pen(mark: Mark, fine: float = _FINE) -> str:
    """Colour, width and dashes of a line, in steps of a pixel."""
    width = mark.width * _POINT * fine
    dashes = " ".join(f"{float(part) * width:.3g}" for part in _DASHES[mark.style].split())
    return f'stroke="{mark.colour}" stroke-width="{width:.3g}"' + (f' stroke-dasharray="{dashes}"' if dashes else "")


def _symbol(mark: Mark, x: float, y: float) -> str:
    """A ring or a cross."""
    half, pen = mark.size * _POINT / 2, _pen(mark, 1.0)
    if mark.shape == "o":
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{half:.1f}" fill="none" {pen}/>'
    arm = 2 * half
    return f'<path d="M{x - half:.1f} {y - half:.1f}l{arm:.1f} {arm:.1f}m0 {-arm:.1f}l{-arm:.1f} {arm:.1f}" {pen}/>'


def _sample(mark: Mark, x: float, y: float, width: float) -> str:
    """What stands before a name in the legend."""
    if mark.shape == "band":
        area = f'x="{x:.1f}" y="{y - 4:.1f}" width="{width:.1f}" height="8"'
        return f'<rect {area} fill="{mark.colour}" fill-opacity="{mark.opacity:g}"/>'
    if mark.shape == "line":
        return f'<path d="M{x:.1f} {y:.1f}h{width:.1f}" {_pen(mark, 1.0)}/>'
    return _symbol(mark, x + width / 2, y)


def _word(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>' if text else ""


def _path(points: np.ndarray) -> str:
    """A line through pixels in fine steps, with gaps where a number is missing."""
    there = np.isfinite(points).all(axis=1)
    edges = np.flatnonzero(np.diff(there.astype(int), prepend=0, append=0))
    parts = []
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        steps = np.rint(_FINE * _fewer(points[begin:end])).astype(int)
        moves = np.diff(steps, axis=0, prepend=0)
        parts.append("M" + " ".join(map(str, moves[0])) + "l" + " ".join(map(str, moves[1:].ravel())))
    return "".join(part.removesuffix("l") for part in parts)


def _fewer(points: np.ndarray) -> np.ndarray:
    """The points without those that lie on the line between their neighbours."""
    for _ in range(6):
        if len(points) < 3:
            break
        before, middle, after = points[:-2:2], points[1:-1:2], points[2::2]
        along = after - before
        length = np.einsum("ij,ij->i", along, along)
        share = np.einsum("ij,ij->i", middle - before, along) / np.where(length > 0, length, 1.0)
        beside = middle - before - np.clip(share, 0.0, 1.0)[:, None] * along
        kept = np.ones(len(points), dtype=bool)
        kept[1:-1:2] = np.einsum("ij,ij->i", beside, beside) > _EXACT**2
        points = points[kept]
    return points
