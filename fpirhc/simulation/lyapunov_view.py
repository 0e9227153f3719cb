"""Lyapunov's view of a run with an exponential tracking law: V = S^2 / 2, and the bound that the response error sets.

Theory: docs/theory-questions.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import tracking_law
from fpirhc.fields.checked import checked_call
from fpirhc.plant.motion import derivative_unit, followed_units, with_space
from fpirhc.simulation.run import Run
from fpirhc.summary import behind_equals, written_out
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import Feedback


@dataclass(frozen=True, eq=False)
class LyapunovView:
    """S and h along a run.

    Args:
        surface: S, shape (cycles, controlled coordinates).
        response_error: h, shape (cycles - 1, controlled coordinates).
        rate: of the law, 1/s.
        since: first cycle of the measured part.
        unit: of S; empty where coordinates have several.
    """

    surface: np.ndarray
    response_error: np.ndarray
    rate: float
    since: int
    unit: str = ""

    @property
    def function(self) -> np.ndarray:
        """V = |S|^2 / 2, shape (cycles,)."""
        with np.errstate(over="ignore"):  # of a run that diverged
            return np.asarray(0.5 * np.sum(self.surface**2, axis=1))

    @property
    def largest(self) -> float:
        """Largest |S| of the measured part."""
        return float(np.sqrt(2 * self.function[self.since :].max()))

    @property
    def ultimate(self) -> float:
        """Ultimate bound of |S|, when its value at the start of the measured part is forgotten: sup|h| over the rate."""
        with np.errstate(over="ignore"):  # of a run that diverged
            return float(np.linalg.norm(self.response_error[self.since :], axis=1).max()) / self.rate

    @property
    def bound(self) -> float:
        """Bound of |S| over the measured part: its value at the start of the part, or the ultimate bound where that is larger."""
        return max(float(np.sqrt(2 * self.function[self.since])), self.ultimate)

    @property
    def text(self) -> str:
        """One sentence for a reader of results."""
        first = float(np.sqrt(2 * self.function[self.since]))
        unit = with_space(self.unit) if self.unit else " (coordinates of several units)"
        text = (
            f"Lyapunov: |S| at most {written_out(self.largest)}{unit}; "
            f"ultimate bound sup|h| / rate = {behind_equals(self.ultimate, 3)}{unit}"
        )
        return (
            text
            if first <= self.ultimate
            else f"{text}, to which |S| has not come down at the start of the measured part"
        )


@checked_call
def lyapunov_view(problem: Problem, controller: Controller, run: Run) -> LyapunovView | None:
    """Return V and its bound along a run, or None.

    It is None where the controller does not track the reference with a law of one rate, and where the state of the law is not the
    plant's: behind sensors, behind a late measurement, or with a predicted state.
    """
    laws, since = _feedbacks(problem, controller), round(problem.measure_from / problem.period)
    elsewhere = not problem.sees_plant or controller.feeds.get("state") in run.layout.names
    if not laws or "reference" not in run.layout or elsewhere or run.cycles < since + 2:
        return None
    rate = laws[0].rate
    if rate is None or any(law.rate != rate for law in laws):
        return None
    surface, response_error = _signals(problem, laws, rate, run)
    return LyapunovView(surface, response_error, rate, since, _unit(problem))


def _unit(problem: Problem) -> str:
    """Unit of S = (d/dt + rate)^n e_int, that of a derivative of order n - 1; empty where coordinates have several."""
    plant, time, own = problem.plant, problem.time_unit, followed_units(problem.plant)
    units = {derivative_unit(own[n], plant.chains[n] - 1, time) for n in plant.controlled_names}
    return units.pop() if len(units) == 1 else ""


def _feedbacks(problem: Problem, controller: Controller) -> list[Feedback]:
    """The law's feedback for every controlled coordinate; empty without a law, and for a law without constant gains."""
    law, plant = tracking_law(controller), problem.plant
    feedbacks = [law.feedback(plant.chains[n]) for n in plant.controlled_names] if law is not None else []
    return [one for one in feedbacks if one is not None] if None not in feedbacks else []


def _signals(problem: Problem, laws: Sequence[Feedback], rate: float, run: Run) -> tuple[np.ndarray, np.ndarray]:
    """S and h. The logged feedback is rate S plus the terms of S' below the highest derivative."""
    plant, seen = problem.plant, problem.plant.output.name
    errors, feedback = run["reference"] - run[seen], run["desired"] - run["nominal"]
    surface = []
    for k, (name, law) in enumerate(zip(plant.controlled_names, laws, strict=True)):
        order, degree = plant.chains[name], len(law.gains) - 1
        chain = [errors[:, plant.output.elements.index(name + "'" * s)] for s in range(order)]
        rising = chain if law.integral else chain[1:]
        drift = sum(math.comb(degree, s) * rate ** (degree - s) * e for s, e in enumerate(rising))
        surface.append((feedback[:, k] - drift) / rate)
    columns = np.column_stack(surface)
    decay = math.exp(-rate * problem.period)
    return columns, (decay * columns[:-1] - columns[1:]) * rate / (1 - decay)
