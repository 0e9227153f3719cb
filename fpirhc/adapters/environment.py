"""A problem as a Gymnasium environment: its plant, disturbances, dead times and sensors, with the commands of somebody else.

The environment is the closed loop of the problem around a controller that sends the action: a policy meets what a controller does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from fpirhc.adapters.names import adapter, finite_numbers
from fpirhc.errors import InvalidProblem, package
from fpirhc.fields.checked import checked_call
from fpirhc.fields.kinds import Seed, shortened
from fpirhc.fields.user_code import called
from fpirhc.simulation.loop import HELD_INPUT, HeldInput, close_loop, start_memory
from fpirhc.simulation.ranges import ranges_of
from fpirhc.simulation.simulate import run_tables
from fpirhc.simulation.step_arguments import Setpoints
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.task.problem import Problem

Reward = Callable[[Mapping[str, np.ndarray]], float]


@adapter
def as_env(problem: Problem, *, reward: Reward | None = None, setpoints: Setpoints | None = None) -> Any:
    """Return a problem as a Gymnasium environment.

    An action is the command of one cycle, in the units and within the limits of the inputs. An observation has the measured state
    and the reference of the judged coordinates. An episode is truncated after the problem's duration, and terminated where a state
    leaves its physical range or the error is a million times the reference. `info` has every signal of the cycle, by name.

    A step evaluates the loop twice: once to move with the action, and once for what is measured then, before the next action.

    Args:
        problem: the task; limits of its inputs are those of the actions.
        reward: function of the signals at the end of a step; None: minus the sum of the squared errors.
        setpoints: by coordinate, in place of those of the reference: a number, pairs (time, set-point), or a function of time.

    Raises:
        NotSupported: Gymnasium is not installed, or the plant is an object outside.
    """
    gymnasium = package("gymnasium", "outside")
    problem.require_equations("as_env: the plant is an object outside; make the environment from that object itself")
    play = _Play(problem, reward or _squared_error, setpoints)
    low, high = (np.array(ends, dtype=float) for ends in problem.limits.input_ends(problem.plant))

    base: Any = gymnasium.Env

    class Environment(base):  # type: ignore[misc]  # the package may be missing
        """The problem, one control cycle a step."""

        metadata: Mapping[str, Any] = {"render_modes": []}
        action_space = gymnasium.spaces.Box(low, high, dtype=np.float64)
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (play.observation.size,), dtype=np.float64)

        @checked_call
        def reset(self, *, seed: Seed | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, np.ndarray]]:
            """Go to the problem's start; the seed is that of its noise."""
            super().reset(seed=seed, options=options)
            play.reset(int(self.np_random.integers(2**31)) if seed is None else seed)
            return play.observation, play.signals

        def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, np.ndarray]]:
            """Send the action, and measure at the end of the cycle."""
            gone = play.step(finite_numbers("step", action, problem.plant.inputs))
            return play.observation, play.reward, gone, play.cycle >= problem.cycles, play.signals

    return Environment()


class _Play:
    """One run of the loop, cycle by cycle, with the command of somebody else."""

    def __init__(self, problem: Problem, reward: Reward, setpoints: Setpoints | None) -> None:
        self._problem, self._reward, self._setpoints = problem, reward, setpoints
        self._loop = close_loop(problem, HeldInput())
        self._step, self._ranges = Evaluator(self._loop.function), ranges_of(problem, self._loop.trace)
        self._place = self._loop.memory.slice(HELD_INPUT)
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Go to the start."""
        self.cycle = 0
        self._tables = run_tables(self._problem, seed, self._problem.cycles + 1, setpoints=self._setpoints)
        self._memory = start_memory(self._loop, self._problem, HeldInput())
        self._measure()

    def step(self, action: np.ndarray) -> bool:
        """Hold a command for a cycle, and return whether the plant is gone."""
        self._memory[self._place] = action
        self._memory, sent = self._step(self._memory, *(table[self.cycle] for table in self._tables))
        self.cycle += 1
        self._measure()
        finite = np.isfinite(self._memory).all() and np.isfinite(sent).all()
        return not finite or self._ranges.first_outside(self._row[np.newaxis]) is not None

    def _measure(self) -> None:
        """Sense at the beginning of the cycle that comes; sensors do not depend on its command."""
        _, row = self._step(self._memory, *(table[self.cycle] for table in self._tables))
        self._row = row.ravel()
        self.signals = self._loop.trace.unpack(self._row)
        self.observation = np.concatenate([np.ravel(self.signals[name]) for name in ("state", "reference")])
        reward = np.ravel(called("as_env(reward=...)", self._reward, self.signals))
        if reward.size != 1 or reward.dtype.kind not in "biuf":
            raise InvalidProblem(f"as_env(reward=...): it returned {shortened(reward.tolist())}, expected one number")
        self.reward = float(reward[0])


def _squared_error(signals: Mapping[str, np.ndarray]) -> float:
    return -float(np.sum(signals["error"] ** 2))
