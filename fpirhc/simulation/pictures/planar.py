"""A mechanism that moves as its run did: masses, cranes, poles and arms as lines and discs in the plane."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from typing import TYPE_CHECKING, TypeAlias, TypedDict

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidValue
from fpirhc.fields.user_code import called
from fpirhc.plant.motion import by_name
from fpirhc.plant.plant import Plant
from fpirhc.simulation import drawing
from fpirhc.simulation.pictures.lines import Picture
from fpirhc.simulation.run import Run
from fpirhc.symbolic.layout import Layout

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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

    In an HTML report it plays, pauses and follows the cursor of the charts; `player` is for notebooks. A picture that stands still
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
                raise InvalidValue(
                    f"Planar({self.title!r}, shapes=...): expected points (x, y) of scalars, got {one!r}"
                )
            column += numbers
        return ca.vertcat(*column)


def script() -> str:
    """Return the script that plays pictures: `play(box, data)`."""
    return files(__package__).joinpath("planar.js").read_text(encoding="utf-8")
