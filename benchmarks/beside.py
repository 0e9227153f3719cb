"""One loop for the controllers of several tools on one simulator."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable

import numpy as np

import fpirhc as fp
from fpirhc.contracts import Controller

Step = Callable[[float, np.ndarray], np.ndarray]  # time and measured state -> command


def flown(
    step: Step, start: np.ndarray, move: Callable[[np.ndarray, np.ndarray], np.ndarray], period: float, cycles: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return states (cycles + 1, nx), commands (cycles, nu), and the median CPU time of a command, ms.

    Args:
        step: the controller; its command is timed.
        start: the first state.
        move: the plant: state and held command -> state a period later.
        period: of the controller, in the plant's time unit.
        cycles: of the run.
    """
    states, commands, seconds = [np.asarray(start, float)], [], []
    for k in range(cycles):
        begun = time.process_time()
        command = np.ravel(step(k * period, states[-1]))
        seconds.append(time.process_time() - begun)
        commands.append(command)
        states.append(np.ravel(move(states[-1], command)))
    return np.array(states), np.array(commands), 1e3 * float(np.median(seconds))


def ours(problem: fp.Problem, controller: Controller) -> Step:
    """The controller's own step from its first memory on."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fp.HarmfulAdaptation)  # the table shows it
        stepper = fp.Stepper(problem, controller)
    memory = stepper.start()

    def step(now: float, state: np.ndarray) -> np.ndarray:
        nonlocal memory
        command, memory = stepper.step_measured(now, state, memory)
        return command

    return step
