"""What is linear at points of the reference: the closed loop, asked of the loop itself, and the response Jacobian.

At every point the loop starts on the reference with the inputs that it needs there. The plant is led along the reference until
what the controller remembers has found its place, also in a loop that does not converge; then the loop's own step is linearised.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import TypeAlias, TypeVar

import casadi as ca
import numpy as np

from fpirhc.contraction.delayed import leaking_limit
from fpirhc.contraction.spectrum import Spectrum, response_jacobian
from fpirhc.controllers.base import Controller
from fpirhc.controllers.check import product_limit
from fpirhc.controllers.contract import without_deformation
from fpirhc.deformation.base import Deformation, Iteration
from fpirhc.describe import identity
from fpirhc.errors import FpirhcError, NoAnswer, NotSupported
from fpirhc.plant.plant import Plant
from fpirhc.review.grid import ReviewGrid, each, is_late, scaled
from fpirhc.simulation.linearise.asked_loop import AskedLoop
from fpirhc.simulation.linearise.linear_loop import NEUTRAL, LinearLoop
from fpirhc.simulation.linearise.linear_map import near_fixed_point
from fpirhc.simulation.linearise.linearisation import Linearisation
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.expression import kind
from fpirhc.task.problem import Problem

T = TypeVar("T")

_POINTS, _POINTS_OF_PLANS = 7, 3
_DRAWN, _DRAWN_OF_PLANS = 16, 5  # draws of the parameters, of all points together
_CYCLES = 400  # of the run to a point that laws and plans in every cycle take at most
_PERIODS = 30  # of plans that the run to a point takes at least
_GENTLE = 0.1  # share of a map's gain
_SMALL = 1e-3  # feedback of a point at a limit, as a share of the others'


@dataclass(frozen=True, eq=False)
class Loops:
    """Linear loops of a controller along the reference, or the reason why there are none.

    Args:
        places: indices of the loops' points among the reference's points, those at a limit left out: there nothing is fed back.
        loops: loops of the plant with its exact parameters, one for every place.
        ideal: loop of the controller without deformation whose model is the plant, the outer loop by itself; None: not computed.
        reason: why there are no loops; else empty.
        learns: whether the controller changes on line what the loops have as it is at their points: a model, or gains.
    """

    places: tuple[int, ...]
    loops: tuple[LinearLoop, ...]
    ideal: LinearLoop | None
    reason: str = ""
    learns: bool = False

    @property
    def radii(self) -> np.ndarray:
        """Largest |pole| at every point."""
        return np.array([one.radius for one in self.loops])


def loops_along(grid: ReviewGrid, controller: Controller) -> Loops:
    """Return the controller's linear loops along the reference with the ideal one, or the reason why there are none."""
    return _or_reason(controller, lambda: replace(_loops(grid, controller), ideal=ideal_loops(grid, controller, 1)[0]))


def own_loops(grid: ReviewGrid, controller: Controller) -> Loops:
    """Return the controller's linear loops along the reference, without the ideal one, or the reason why there are none."""
    return _or_reason(controller, lambda: _loops(grid, controller))


def _or_reason(controller: Controller, loops: Callable[[], Loops]) -> Loops:
    try:
        return loops()
    except FpirhcError as error:
        return Loops((), (), None, reason=str(error), learns=controller.learns)
    except np.linalg.LinAlgError as error:
        return Loops((), (), None, reason=f"the linear loop has no eigenvalues: {error}")


def _loops(grid: ReviewGrid, controller: Controller) -> Loops:
    points = points_of(grid, controller)
    quick = points.asked.quick
    sought = thinned(usable(grid), _POINTS if quick else _POINTS_OF_PLANS)
    every = {k: points.at(k) for k in points.feasible(sought)}
    strongest = np.max([_fed_back(one) for one in every.values()], axis=0)
    places = tuple(k for k, one in every.items() if (_fed_back(one) >= _SMALL * strongest).all())
    # Commands on their way through a dead time are fed back even where the next one has no slope.
    felt = bool(strongest.all()) and not any(grid.problem.dead_time.inputs.values())
    if not places or not (felt or any(points.asked.inside(points.quiet(k)) for k in places)):
        raise NoAnswer("the command stands at a limit all along the reference")
    learns = controller.learns and points.asked.keeps_learned
    return Loops(places, tuple(every[k] for k in places), None, learns=learns)


def loops_over_box(grid: ReviewGrid, controller: Controller, own: Loops) -> tuple[LinearLoop, ...]:
    """Return loops of plants from the box of parameters, and with its shortest and its longest dead time."""
    drawn, every = points_of(grid, controller).drawn(own), max(1, len(own.places) // 2)
    late = [loop for edge in _late(grid) for loop in loops_at(edge, controller, own.places[::every])]
    return (*drawn.values(), *late)


def _fed_back(loop: LinearLoop) -> np.ndarray:
    """The size of what each command depends on, (nu,)."""
    return np.asarray(np.max([np.abs(one.arriving).max(axis=1, initial=0.0) for one in loop.cycles], axis=0))


class Points:
    """A closed loop at points of the reference, with its map as it is near the fixed point."""

    def __init__(self, grid: ReviewGrid, controller: Controller, problem: Problem | None = None) -> None:
        """Compose the loop of a controller `near_fixed_point`, of the grid's problem or of the same one with its reality."""
        self.grid, self.asked = grid, AskedLoop(problem or grid.problem, controller)
        self._linear = Linearisation(self.asked)
        self._loops: dict[tuple[int, int], LinearLoop] = {}
        self._quiets: dict[tuple[int, int], np.ndarray] = {}
        self._ideals: dict[int, LinearLoop] = {}

    def at(self, place: int, draw: int = 0) -> LinearLoop:
        """Return the linear loop at a point, with the parameters of a draw; draw 0 are the exact ones."""
        if (place, draw) not in self._loops:
            self._loops[place, draw] = self._linear.at(self.quiet(place, draw))
        return self._loops[place, draw]

    def drawn(self, own: Loops) -> dict[tuple[int, int], LinearLoop]:
        """Return the loops of plants from the box by point and draw, those at a limit left out."""
        strongest = np.max([_fed_back(one) for one in own.loops], axis=0)
        pairs = _pairs(self.grid, own.places, _DRAWN if self.asked.quick else _DRAWN_OF_PLANS)
        finite = [pair for pair in pairs if np.isfinite(self.grid.commands[pair[::-1]]).all()]
        drawn = {pair: self.at(*pair) for pair in self._feasible(finite)}
        return {pair: one for pair, one in drawn.items() if (_fed_back(one) >= _SMALL * strongest).all()}

    def feasible(self, places: Sequence[int]) -> list[int]:
        """Return those of some points whose plan keeps its limits of states; where none does, those whose plan is solved.

        Raises:
            NoAnswer: every cycle is skipped, or no plan is solved.
        """
        feasible = [place for place, _ in self._feasible([(place, 0) for place in places])]
        if places and not feasible:
            raise NoAnswer("no plan along the reference keeps its limits of states")
        return feasible

    def _feasible(self, pairs: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
        moved = [pair for pair in pairs if not self.asked.skips(self.quiet(*pair))]
        if pairs and not moved:
            raise NoAnswer("every cycle is skipped along the reference, because a signal is not finite there")
        kept = [pair for pair in moved if self.asked.feasible(self.quiet(*pair))]
        return kept or [pair for pair in moved if self.asked.solves(self.quiet(*pair))]

    def between(self, place: int, draw: int, gains: tuple[float, float], *, held: bool) -> tuple[LinearLoop, ...]:
        """Return the linear loops of two gains of the map at a point, in the same coordinates; held: plans are held for ever."""
        return self._linear.between(self.quiet(place, draw), gains, held=held)

    def ideal(self, place: int) -> LinearLoop:
        """Return the linear loop at a point where the plant is the model."""
        if place not in self._ideals:
            believed = self.asked.controller.plant_model(self.grid.problem).parameters(self.grid.problem.plant)
            own = self.grid.with_exact(believed)
            quiet = self._quiet(place, own.states[place], own.needed(believed)[place], believed)
            self._ideals[place] = self._linear.at(quiet)
        return self._ideals[place]

    def noisy(self, place: int, correlation: np.ndarray) -> LinearLoop:
        """Return the linear loop at a point behind the noise of the sensors, see `Linearisation.noisy`."""
        return self._linear.noisy(self.quiet(place), correlation)

    def shaken(self, place: int, corners: Sequence[tuple[float, float]]) -> tuple[LinearLoop, ...]:
        """Return the linear loops at a point behind noise of the response that the map sees, see `Linearisation.shaken`."""
        return self._linear.shaken(self.quiet(place), corners)

    def quiet(self, place: int, draw: int = 0) -> np.ndarray:
        """Return the memory at a point, with the parameters of a draw."""
        if (place, draw) not in self._quiets:
            grid = self.grid
            states = grid.states if draw == 0 else grid.drawn_states[draw]
            where = place, states[place], grid.commands[draw, place], grid.draws[draw]
            at = self._quiet(*where)
            if self._gentle is not None:
                try:
                    self._loops[place, draw] = self._linear.at(at)
                except NotSupported:
                    at = self.asked.with_gain(self._quiet(*where, self._gentle), self._own)
            self._quiets[place, draw] = at
        return self._quiets[place, draw]

    @property
    def _own(self) -> float:
        return self.asked.controller.deformation.effective_gain()

    @cached_property
    def _gentle(self) -> float | None:
        """The gain with which a map on targets, whose fixed point is not known, is led there if it does not converge itself."""
        linear = self.asked.controller.deforms == "target" and self.asked.gained
        return _GENTLE * self._own if linear else None

    def _quiet(
        self, place: int, state: np.ndarray, command: np.ndarray, exact: np.ndarray, gain: float | None = None
    ) -> np.ndarray:
        grid, asked, plant = self.grid, self.asked, self.grid.problem.plant
        reality, known = asked.problem.reality, asked.problem.truth.shared(plant)
        start = asked.start(
            time=float(grid.times[place]),
            state=dict(zip(plant.state.elements, map(float, state), strict=True)),
            before=dict(zip(plant.inputs, map(float, command), strict=True)),
            exact=exact if reality is None else None,
            gain=gain,
        )
        times = grid.times[place] + grid.problem.period * np.arange(1, self._cycles + 1)
        led = grid.states_at(times) + (state - grid.states[place])
        # What the model lacks moves by itself.
        whole = np.full((self._cycles, asked.problem.real_plant.state.size), np.nan)
        whole[:, list(known.values())] = led[:, list(known)]
        quiet = asked.quietest(asked.run(start, self._cycles, whole, self._fixed_point(state, command)))
        if asked.inside(quiet) or not (asked.has_room(command) and asked.feasible(quiet)):
            return quiet
        # Integrals of a law without a model, and plans of a wrong one, find their place by errors alone.
        free = asked.quietest(asked.run(start, max(_CYCLES, self._cycles) if asked.quick else self._cycles))
        return free if asked.inside(free) else quiet

    @cached_property
    def _cycles(self) -> int:
        """Cycles of the run to a point: as far as to the next one, where that is time enough for what the controller remembers."""
        section = self.grid.problem.cycles // (_POINTS if self.asked.quick else _POINTS_OF_PLANS)
        return max(min(_CYCLES, section), _PERIODS * self.asked.repeats, 4 * self.asked.warm)

    def _fixed_point(self, state: np.ndarray, command: np.ndarray) -> np.ndarray | None:
        """The request for which the model computes a command; None where the deformation acts on something else."""
        controller, plant = self.asked.controller, self.grid.problem.plant
        if controller.deforms != "response" or controller.response(self.grid.problem) is not None:
            return None
        believed = controller.plant_model(self.grid.problem).parameters(plant)
        return np.asarray(plant.equations.controlled_response(state, command, believed).full()).ravel()


def points_of(grid: ReviewGrid, controller: Controller) -> Points:
    """Return the closed loop at the grid's points; the last ones are kept, because several questions ask the same loop."""
    linear = near_fixed_point(controller)
    return _LATEST.of((grid.problem, grid.states), (identity(linear),), lambda: Points(grid, linear))


_LATEST: Latest[Points] = Latest(8)


def loops_at(grid: ReviewGrid, controller: Controller, places: Sequence[int]) -> list[LinearLoop]:
    """Return the controller's linear loops with the exact parameters at some points of the reference."""
    points = points_of(grid, controller)
    return [points.at(k) for k in places]


def ideal_loops(grid: ReviewGrid, controller: Controller, count: int) -> list[LinearLoop]:
    """Return the loops of plant = model without deformation at `count` points of the reference."""
    points = points_of(grid, without_deformation(controller))
    return [
        points.ideal(k)
        for k in ideal_places(grid, controller.plant_model(grid.problem).parameters(grid.problem.plant), count)
    ]


def ideal_places(grid: ReviewGrid, believed: np.ndarray, count: int) -> list[int]:
    """Return points of the reference at which a model with these parameters has a finite inverse."""
    return thinned(_finite(grid.with_exact(believed).needed(believed), "model's inverse"), count)


def usable(grid: ReviewGrid) -> list[int]:
    """Return the points of the reference whose command is finite."""
    return _finite(grid.commands[0], "inverse")


def _finite(commands: np.ndarray, inverse: str) -> list[int]:
    """Points whose command is finite; raises where there is none."""
    finite = [k for k, command in enumerate(commands) if np.isfinite(command).all()]
    if not finite:
        raise NoAnswer(f"the {inverse} does not exist along the reference")
    return finite


def _late(grid: ReviewGrid) -> list[ReviewGrid]:
    """The points with the shortest and the longest dead time of the box."""
    if not grid.mismatch or not is_late(grid.problem):
        return []
    return [replace(grid, problem=scaled(grid.problem, percent)) for percent in (-grid.mismatch, grid.mismatch)]


def _pairs(grid: ReviewGrid, places: Sequence[int], most: int) -> list[tuple[int, int]]:
    """Pairs of a point and a draw; every point has draws of its own, and few points have few draws."""
    count = min(len(grid.draws) - 1, most)
    if count <= 0:
        return []
    draws = np.unique(np.linspace(1, len(grid.draws) - 1, count).astype(int))
    return [(places[i % len(places)], int(d)) for i, d in enumerate(draws)]


def thinned(places: Sequence[T], most: int) -> list[T]:
    """Return at most so many of some points."""
    some = np.unique(np.linspace(0, len(places) - 1, min(len(places), most)).astype(int))
    return [places[int(k)] for k in some]


def is_planned(controller: Controller) -> bool:
    """Whether the controller plans over a horizon that it restarts from the measured state."""
    while controller.inner is not None:
        controller = controller.inner
    return controller.planner is not None and controller.planner.restarts


LITTLE = 0.1  # growth over the run, as a share, that it does not show
_ROUNDING = 1e-5  # of the radius of a neutral mode
_SHARES = (0.1, 0.5, 1.0, 2.0)  # of the map's own gain, at which a mode that no gain changes is looked for
_LOWER = 0.9  # the lower gain, as a share of the map's own

Pair: TypeAlias = tuple[LinearLoop, LinearLoop]


class LoopsByGain:
    """Loops of a map at its own gain and at a lower one, in the same coordinates."""

    def __init__(self, points: Points, own: Loops, gain: float, cycles: int) -> None:
        self._points, self._own, self.gains = points, own, (_LOWER * gain, gain)
        self._most = (1 + LITTLE) ** (1 / cycles)
        self._pair, self._floor = cache(self._between), cache(self._least)

    def along(self, most: int) -> list[Pair]:
        """Return (lower, own) at no more than so many points of the reference, with the exact parameters."""
        return [self._pair(k, 0, False) for k in thinned(self._own.places, most)]

    def held(self, most: int) -> list[Pair]:
        """Return (lower, own) at no more than so many points of the reference, with plans that are held for ever."""
        return [self._pair(k, 0, True) for k in thinned(self._own.places, most)]

    def over_box(self, most: int) -> list[Pair]:
        """Return (lower, own) for no more than so many draws of the parameters."""
        return [self._pair(*one, False) for one in thinned(tuple(self._points.drawn(self._own)), most)]

    def at(self, gain: float, pair: Pair) -> LinearLoop:
        """Return the loop at another effective gain."""
        low, own = pair
        share = (gain - self.gains[1]) / (self.gains[1] - self.gains[0])
        return own.mixed(low, share)

    def stable(self, gain: float, pair: Pair) -> bool:
        """Whether no mode grows with an effective gain but one that grows with all of them, too little to show in the run."""
        radius = self.at(gain, pair).radius
        return radius < 1 + NEUTRAL or radius < min(self._most, self._floor(pair) + _ROUNDING)

    def all_stable(self, gain: float, pairs: Sequence[Pair]) -> bool:
        """Whether they are all stable; the last one that was not is looked at first."""
        for pair in sorted(pairs, key=lambda one: one is not self._unstable):
            if not self.stable(gain, pair):
                self._unstable = pair
                return False
        return True

    _unstable: Pair | None = None

    def _least(self, pair: Pair) -> float:
        return min(self.at(share * self.gains[1], pair).radius for share in _SHARES)

    def _between(self, place: int, draw: int, held: bool) -> Pair:
        low, own = self._points.between(place, draw, self.gains, held=held)
        return low, own


def loops_by_gain(grid: ReviewGrid, controller: Controller, own: Loops) -> LoopsByGain | None:
    """Return the loops for every gain; None without loops, and for a map that changes or has no gain to set."""
    if not controller.deformation.adapts or not controller.deformation.iteration.constant or not own.places:
        return None
    loops = LoopsByGain(points_of(grid, controller), own, controller.deformation.effective_gain(), grid.problem.cycles)
    try:
        loops.along(1)
    except (FpirhcError, np.linalg.LinAlgError):
        return None
    return loops


_WAYS = (-0.25, 0.5, 1.0, 1.25)  # of the way from the nominal response to the request that the plant needs
_SAMPLES = 2000


def eigenvalues_near(
    grid: ReviewGrid, believed: np.ndarray, draws: np.ndarray, iteration: Iteration, *, near: bool
) -> np.ndarray:
    """Return eigenvalues of J W, shape (samples, n); samples that are not finite are left out.

    Args:
        believed: parameters of the model, shape (np,).
        draws: the first draws of the grid, shape (draws, np); as many are used as the number of samples allows.
        near: whether to sample near the reference too, and not only on it at r*.
    """
    states, requests = _near(grid, believed) if near else (grid.states, grid.requests(believed))
    count = max(1, min(len(draws), _SAMPLES // len(states)))
    places = np.unique(np.linspace(0, len(draws) - 1, count).astype(int))
    rows = draws[places]
    m, n = requests.shape
    points = np.tile(states, (len(rows), 1)) if near else grid.drawn_states[places].reshape(len(rows) * m, -1)
    known = (np.repeat(rows, m, axis=0), np.tile(believed, (m * len(rows), 1)))
    jacobians = each(stacked_jacobian(grid.problem.plant), points, np.tile(requests, (len(rows), 1)), *known)
    finite = jacobians[np.isfinite(jacobians).all(axis=1)]
    transposed = finite.reshape(-1, n, n)  # has the same eigenvalues
    matrices = transposed if iteration.weights is None else iteration.weighted(transposed.transpose(0, 2, 1))
    return np.linalg.eigvals(matrices).reshape(-1, n)


def spectrum_near(
    grid: ReviewGrid, believed: np.ndarray, draws: np.ndarray, iteration: Iteration, *, near: bool
) -> Spectrum:
    """Return `eigenvalues_near` as a spectrum."""
    return Spectrum(eigenvalues_near(grid, believed, draws, iteration, near=near))


def _near(grid: ReviewGrid, believed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    first = grid.problem.start_state - grid.states[0]
    wanted, needed = grid.responses, grid.requests(believed)
    states, requests = [], []
    for sign in (-1.0, 0.0, 1.0):
        for share in _WAYS:
            states.append(grid.states + sign * first)
            requests.append(wanted + share * (needed - wanted))
    return np.vstack(states), np.vstack(requests)


def stacked_jacobian(plant: Plant) -> ca.Function:
    """Return the response Jacobian as one column."""
    function = response_jacobian(plant)
    matrix = kind(plant.equations.inverse_opaque)
    symbols = [matrix.sym(f"v{k}", function.size1_in(k)) for k in range(function.n_in())]
    return ca.Function("fpirhc_stacked_jacobian", symbols, [ca.vec(function(*symbols))])


_LIMIT = 2.0  # of gain times eigenvalue without delay


def dead_cycles(problem: Problem) -> float:
    """Longest dead time between a request and its response, in control cycles beyond the one that every loop has."""
    return max(channel_cycles(problem))


def channel_cycles(problem: Problem) -> tuple[float, ...]:
    """Dead time between each input and the measured response, in control cycles beyond the one that every loop has."""
    times = problem.dead_time
    return tuple((times.inputs.get(n, 0.0) + times.measurement) / problem.period for n in problem.plant.inputs)


def largest_product(problem: Problem, deformation: Deformation, eigenvalues: np.ndarray | None = None) -> float:
    """Return the limit of effective gain times eigenvalue: 2, or less under a dead time or behind an estimator or a filter.

    It is that of the iteration by itself (`leaking_limit`), the smallest of all channels. Input k belongs to controlled coordinate
    k where the dead times differ. The model-referenced form has another limit for every eigenvalue.

    Args:
        eigenvalues: of the response Jacobian, for the model-referenced form; their smallest and largest sizes count.
    """
    pairing = deformation.iteration.pairing
    averaged = pairing is not None and pairing.uncertainty > 0
    behind = None if averaged else product_limit(problem, deformation)
    if behind is not None:
        return behind
    late = channel_cycles(problem)
    if not any(late) and not (pairing and pairing.cycles):
        return _LIMIT
    own = (pairing.channels or (pairing.cycles or 0.0,) * len(late)) if pairing else (0.0,) * len(late)
    sizes = np.array([1.0]) if eigenvalues is None else np.abs(eigenvalues)
    extremes = {float(sizes.min()), float(sizes.max())}
    return min(_limit(deformation, *pair, size) for pair in set(zip(late, own, strict=True)) for size in extremes)


def _limit(deformation: Deformation, late: float, own: float, size: float) -> float:
    """Limit of gain times an eigenvalue of this size, of one channel."""
    pairing = deformation.iteration.pairing
    whole = math.floor(late + 1e-9)
    share = max(late - whole, 0.0)
    weights = np.append(np.zeros(whole), [1 - share, share])
    limit = leaking_limit(
        weights,
        cycles=own,
        leak=deformation.iteration.leak,
        pole=deformation.iteration.error_pole,
        eigenvalue=size,
        modelled=deformation.mirror.share,
        width=pairing.uncertainty if pairing else 0,
    )
    return min(limit * size, _LIMIT)
