"""Pictures of a report: their contract, lines over time, one signal against another, and a mechanism that moves as its run did.

A problem file names its pictures: `pictures = (fp.Portrait(...), fp.OverTime(...))`. A picture draws into an existing figure, so
this module imports no plotting library.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from importlib.resources import files
from typing import TYPE_CHECKING, TypeAlias, TypedDict

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidValue
from fpirhc.fields.checked import Checked
from fpirhc.fields.user_code import called
from fpirhc.plant.motion import by_name
from fpirhc.plant.plant import Plant
from fpirhc.simulation import drawing
from fpirhc.simulation.run import Run
from fpirhc.symbolic.layout import Layout

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Quantity:
    """A quantity that a run does not log but that follows from its signals.

    Args:
        name: on the axis.
        unit: on the axis.
        values: function of a Run that returns one number per cycle, shape (cycles,).
    """

    name: str
    unit: str
    values: Callable[[Run], np.ndarray]


class Picture(Checked, ABC):
    """Contract of a picture.

    Every picture has the attributes `title`, `caption` and `controllers`, the names of the controllers that it shows (empty: all).
    """

    title: str
    caption: str
    controllers: tuple[str, ...]

    @abstractmethod
    def size(self, count: int) -> tuple[float, float]:
        """Return width and height in inches for `count` controllers."""

    @abstractmethod
    def draw(self, figure: Figure, runs: Mapping[str, Run]) -> None:
        """Draw the runs, by name of their controller, into an empty figure.

        Raises:
            InvalidName: a run does not have a signal; the message names the nearest one.
        """

    def motion(self, runs: Mapping[str, Run]) -> Mapping[str, object]:  # noqa: ARG002
        """Return what a page needs to play the runs, by name of their controller; nothing where the picture stands still."""
        return {}


def numbers(run: Run, what: str | Quantity) -> np.ndarray:
    """Return the values of a signal or a quantity, shape (cycles,)."""
    return run[what] if isinstance(what, str) else np.asarray(what.values(run), dtype=float)


def label(run: Run, what: str | Quantity) -> str:
    """Return the axis label 'name [unit]' of a signal or a quantity."""
    name, unit = (what.partition(".")[2] or what, run.unit(what)) if isinstance(what, str) else (what.name, what.unit)
    return drawing.literal(f"{name} [{unit}]")


@dataclass(frozen=True, eq=False)
class OverTime(Picture):
    """Panels below each other that share the time axis.

    Args:
        title: of the picture.
        panels: one entry for each panel: the name of a signal ("command.u"), or a Quantity.
        caption: of the picture.
        levels: values at which a panel has a dashed line (thresholds, limits), by the panel's signal or quantity name.
        since: time from which the lines are drawn.
        controllers: names of those shown; empty: all.
    """

    title: str
    panels: tuple[str | Quantity, ...]
    caption: str = ""
    levels: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    since: float = 0.0
    controllers: tuple[str, ...] = ()

    def size(self, count: int) -> tuple[float, float]:
        del count
        return 11.0, 2.3 * len(self.panels) + 0.6

    def draw(self, figure: Figure, runs: Mapping[str, Run]) -> None:
        """Draw the panels.

        Raises:
            InvalidName: a run does not have a signal.
        """
        axes = np.atleast_1d(figure.subplots(len(self.panels), 1, sharex=True))
        for axis, what in zip(axes, self.panels, strict=True):
            up = ""
            for name, run in runs.items():
                late = run.time >= self.since
                axis.plot(*drawing.extremes(run.time[late], numbers(run, what)[late]), lw=1, label=name)
                up = label(run, what)
            for level in self.levels.get(what if isinstance(what, str) else what.name, ()):
                axis.axhline(level, color="#777777", lw=0.8, ls="--")
            drawing.caption_axes(axis, "", up)
        axes[-1].set_xlabel(drawing.time_label(next(iter(runs.values()))))
        axes[0].legend(fontsize=7, ncols=3, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0))  # above lines


@dataclass(frozen=True, eq=False)
class Portrait(Picture):
    """A panel for each controller with the same axes: `y` over `x`.

    Args:
        title: of the picture.
        x: the name of a signal ("state.q"), or a Quantity.
        y: the name of a signal, or a Quantity.
        caption: of the picture.
        since: time from which the lines are drawn, in the problem's unit; a later time leaves a transient out.
        controllers: names of those shown; empty: all.
    """

    title: str
    x: str | Quantity
    y: str | Quantity
    caption: str = ""
    since: float = 0.0
    controllers: tuple[str, ...] = ()

    def size(self, count: int) -> tuple[float, float]:
        return max(5.5, 3.7 * count), 3.6

    def draw(self, figure: Figure, runs: Mapping[str, Run]) -> None:
        """Draw the panels.

        Raises:
            InvalidName: a run does not have a signal.
        """
        panels = figure.subplots(1, len(runs), sharex=True, sharey=True, squeeze=False)[0]
        for k, (axis, (name, run)) in enumerate(zip(np.atleast_1d(panels), runs.items(), strict=True)):
            late = run.time >= self.since
            axis.plot(numbers(run, self.x)[late], numbers(run, self.y)[late], lw=0.8, color=f"C{k}")
            axis.set_title(name, fontsize=10)
            drawing.caption_axes(axis, label(run, self.x), label(run, self.y))


Scalar: TypeAlias = float | ca.SX
Point: TypeAlias = Sequence[Scalar]  # two of them

_FRAMES = 250  # of a run
_MOMENTS = 9  # of a picture that stands still
_TURNS = 12  # corners of a spring
_WATCHED = (2.0, 60.0)  # s; a run of another duration is played in less or more time
_USUAL = 10.0  # s


class Outline(TypedDict):
    """What is drawn of the numbers of a shape."""

    points: int
    disc: bool
    closed: bool


@dataclass(frozen=True, eq=False)
class Shape:
    """A line, an outline or a disc; coordinates are numbers or expressions, x to the right and y upwards.

    Args:
        points: (x, y) of the corners, or of the centre of a disc.
        radius: of a disc; None: a line through the points.
        closed: whether the line is the outline of a filled body.
    """

    points: tuple[Point, ...]
    radius: Scalar | None = None
    closed: bool = False

    @staticmethod
    def line(*points: Point) -> Shape:
        """Return a line through points."""
        return Shape(points)

    @staticmethod
    def disc(centre: Point, radius: Scalar) -> Shape:
        """Return a filled disc."""
        return Shape((centre,), radius)

    @staticmethod
    def box(centre: Point, width: Scalar, height: Scalar, angle: Scalar = 0.0) -> Shape:
        """Return a filled rectangle that is turned by an angle in rad."""
        cos, sin, (x, y) = ca.cos(angle), ca.sin(angle), centre
        corners = [(a * width / 2, b * height / 2) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        return Shape(tuple((x + cos * a - sin * b, y + sin * a + cos * b) for a, b in corners), closed=True)

    @staticmethod
    def spring(begin: Point, end: Point, width: float = 0.1) -> Shape:
        """Return a zigzag from a point to another one."""
        (x, y), (to_x, to_y) = begin, end
        along, up = to_x - x, to_y - y
        length = (along**2 + up**2 + 1e-12) ** 0.5
        shares = np.concatenate([[0.0], np.linspace(0.1, 0.9, _TURNS), [1.0]])
        sides = np.concatenate([[0.0, 0.0], (-1.0) ** np.arange(_TURNS - 2), [0.0, 0.0]]) * width / 2
        corners = (
            (x + s * along - e * up / length, y + s * up + e * along / length)
            for s, e in zip(shares.tolist(), sides.tolist(), strict=True)
        )
        return Shape(tuple(corners))


@dataclass(frozen=True, eq=False)
class Planar(Picture):
    """A panel for each controller in which the mechanism moves; pale lines are where the reference wants it.

    In an HTML report it plays, pauses and follows the cursor of the charts. A picture that stands still
    has moments of the run, the later the darker. The reference is drawn where it has all coordinates of the plant.

    Args:
        title: of the picture.
        plant: whose state is drawn, with its exact parameters.
        shapes: function (q, q', ..., p) -> the Shapes, of the derivatives that the state has, and of the parameters.
        caption: of the picture.
        controllers: names of those shown; empty: all.

    Raises:
        InvalidValue: the function does not return Shapes, or a coordinate is no scalar.
        InvalidProblem: the function fails.
    """

    title: str
    plant: Plant
    shapes: Callable[..., Sequence[Shape]]
    caption: str = ""
    controllers: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        x, p = self._symbols()
        self._numbers(x, p)

    def size(self, count: int) -> tuple[float, float]:
        return max(5.5, 3.7 * count), 3.6

    def draw(self, figure: Figure, runs: Mapping[str, Run]) -> None:
        panels = figure.subplots(1, len(runs), sharex=True, sharey=True, squeeze=False)[0]
        for axis, (name, run) in zip(panels, runs.items(), strict=True):
            moments = np.unique(np.linspace(0, run.cycles - 1, _MOMENTS).astype(int))
            numbers = self.frames(run, moments)[:, : self._width]
            for k, one in enumerate(numbers):
                self._draw_still(axis, one, 0.15 + 0.85 * (k + 1) / len(numbers))
            axis.set_title(drawing.literal(name), fontsize=10)
            axis.set_aspect("equal", adjustable="box")
            axis.autoscale_view()

    def _draw_still(self, axis: Axes, numbers: np.ndarray, strength: float) -> None:
        from matplotlib.patches import Circle

        place = 0
        for one in self.outlines:
            points = numbers[place : place + 2 * one["points"]].reshape(-1, 2)
            place += 2 * one["points"] + one["disc"]
            if one["disc"]:
                axis.add_patch(Circle(tuple(points[0]), numbers[place - 1], color="#222222", alpha=strength))
            elif one["closed"]:
                axis.fill(*points.T, color="#0072b2", alpha=strength)
            else:
                axis.plot(*points.T, color="#222222", alpha=strength, lw=1.2)

    @cached_property
    def outlines(self) -> list[Outline]:
        """Kinds of the shapes: numbers of their points, whether they are discs, and whether their lines are closed."""
        x, p = self._symbols()
        return [
            {"points": len(one.points), "disc": one.radius is not None, "closed": one.closed}
            for one in self._shapes(x, p)
        ]

    def columns(self, layout: Layout) -> list[str]:
        """Return the signals that a drawing follows: the state of the plant, and the reference where it has all coordinates."""
        motion = "plant_state" if "plant_state" in layout else "state"
        aims = layout["reference"].elements if "reference" in layout else ()
        also = [f"reference.{name}" for name in self.plant.names] if set(self.plant.names) <= set(aims) else []
        return [f"{motion}.{name}" for name in self.plant.state.elements] + also

    def function(self, count: int) -> ca.Function:
        """Return the Function (the `count` numbers of `columns`, exact parameters) -> numbers of the shapes.

        The numbers are x and y of every point, then the radius of a disc, of one shape after the other; after them those of the
        reference.
        """
        x, p = self._symbols()
        size, elements = x.numel(), self.plant.state.elements
        values = ca.SX.sym("v", count)
        numbers = [self._numbers(values[:size], p)]
        if count > size:
            aims = dict(zip(self.plant.names, range(size, count), strict=True))
            numbers.append(self._numbers(values[[aims.get(name, k) for k, name in enumerate(elements)]], p))
        return ca.Function("fpirhc_planar", [values, p], [ca.densify(ca.vertcat(*numbers))])

    def frames(self, run: Run, cycles: np.ndarray) -> np.ndarray:
        """Return the numbers of the shapes in some cycles, shape (cycles, numbers), those of the reference behind.

        Raises:
            InvalidName: the run does not have the plant's state.
        """
        columns = self.columns(run.layout)
        values = np.array([run[name][cycles] for name in columns])
        return np.array(self.function(len(columns))(values, self.plant.exact)).reshape(-1, len(cycles)).T

    def motion(self, runs: Mapping[str, Run]) -> dict[str, object]:
        if not runs:
            return {}
        moving = [self._moving(name, run) for name, run in runs.items()]
        longest = max(runs.values(), key=lambda run: run.cycles)
        return self.played(longest.cycles * longest.period, longest.time_unit) | {"runs": moving}

    def _moving(self, name: str, run: Run) -> dict[str, object]:
        every = max(1, -(-run.cycles // _FRAMES))
        numbers = self.frames(run, np.arange(0, run.cycles, every))
        moves = np.flatnonzero((numbers != numbers[0]).any(axis=0))
        rounded = [float(f"{v:.5g}") for v in numbers[:, moves].ravel().tolist()]
        still = [float(f"{v:.5g}") for v in numbers[0].tolist()]
        return {"name": name, "step": every * run.period, "still": still, "moves": moves.tolist(), "numbers": rounded}

    def played(self, duration: float, unit: str) -> dict[str, object]:
        """Return what a page says of the picture, and for how many seconds it is played."""
        low, high = _WATCHED
        return {
            "title": self.title,
            "caption": self.caption,
            "shapes": self.outlines,
            "width": self._width,
            "duration": duration,
            "unit": unit,
            "seconds": duration if unit == "s" and low <= duration <= high else _USUAL,
        }

    @property
    def _width(self) -> int:
        return sum(2 * one["points"] + one["disc"] for one in self.outlines)

    def _symbols(self) -> tuple[ca.SX, ca.SX]:
        x, _, p = self.plant.symbols()
        return x, p

    def _shapes(self, x: ca.SX, p: ca.SX) -> list[Shape]:
        made = called(f"Planar({self.title!r}, shapes=...)", self.shapes, *by_name(self.plant, x, p))
        if not isinstance(made, Sequence) or not made or not all(isinstance(one, Shape) for one in made):
            raise InvalidValue(f"Planar({self.title!r}, shapes=...): expected a list of fp.Shape, got {made!r}")
        return list(made)

    def _numbers(self, x: ca.SX, p: ca.SX) -> ca.SX:
        column = []
        for one in self._shapes(x, p):
            numbers = [v for point in one.points for v in point] + ([] if one.radius is None else [one.radius])
            if any(len(point) != 2 for point in one.points) or any(ca.SX(v).numel() != 1 for v in numbers):
                what = f"Planar({self.title!r}, shapes=...)"
                raise InvalidValue(f"{what}: expected points (x, y) of scalars, got {one!r}")
            column += numbers
        return ca.vertcat(*column)


def player() -> str:
    """Return the script that plays mechanisms on a page: `play(box, data)`."""
    return files(__package__).joinpath("planar.js").read_text(encoding="utf-8")
