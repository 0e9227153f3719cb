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
from fpirhc.simulation.play import Play
from fpirhc.simulation.step_arguments import Setpoints
from fpirhc.task.problem import Problem

Reward = Callable[[Mapping[str, np.ndarray]], float]


@adapter
def as_env(problem: Problem, *, reward: Reward | None = None, setpoints: Setpoints | None = None) -> Any:
    """Return a problem as a Gymnasium environment.

    An action is the command of one cycle, in the units and within the limits of the inputs. An observation has the measured state
    and the reference of the judged coordinates. An episode is truncated after the problem's duration, and terminated where a state
    leaves its physical range or the error is a million times the reference. `info` has every signal of the cycle, by name.

    Args:
        problem: the task; limits of its inputs are those of the actions.
        reward: function of the signals at the end of a step; None: minus the sum of the squared errors.
        setpoints: by coordinate, in place of those of the reference: a number, pairs (time, set-point), or a function of time.

    Raises:
        NotSupported: Gymnasium is not installed, or the plant is an object outside.
    """
    gymnasium = package("gymnasium", "outside")
    problem.require_equations("as_env: the plant is an object outside; make the environment from that object itself")
    play, judged = Play(problem, setpoints), reward or _squared_error
    low, high = (np.array(ends, dtype=float) for ends in problem.limits.input_ends(problem.plant))
    base: Any = gymnasium.Env

    class Environment(base):  # type: ignore[misc]  # the package may be missing
        """The problem, one control cycle a step."""

        metadata: Mapping[str, Any] = {"render_modes": []}
        action_space = gymnasium.spaces.Box(low, high, dtype=np.float64)
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, _observation(play).shape, dtype=np.float64)

        @checked_call
        def reset(self, *, seed: Seed | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, np.ndarray]]:
            """Go to the problem's start; the seed is that of its noise."""
            super().reset(seed=seed, options=options)
            play.reset(int(self.np_random.integers(2**31)) if seed is None else seed)
            return _observation(play), play.signals

        def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, np.ndarray]]:
            """Send the action, and measure at the end of the cycle."""
            play.step(finite_numbers("step", action, problem.plant.inputs))
            ended = play.gone, play.cycle >= problem.cycles
            return _observation(play), _rewarded(judged, play.signals), *ended, play.signals

    _rewarded(judged, play.signals)
    return Environment()


def _observation(play: Play) -> np.ndarray:
    return np.concatenate([np.ravel(play.signals[name]) for name in ("state", "reference")])


def _rewarded(reward: Reward, signals: Mapping[str, np.ndarray]) -> float:
    value = np.ravel(called("as_env(reward=...)", reward, signals))
    if value.size != 1 or value.dtype.kind not in "biuf":
        raise InvalidProblem(f"as_env(reward=...): it returned {shortened(value.tolist())}, expected one number")
    return float(value[0])


def _squared_error(signals: Mapping[str, np.ndarray]) -> float:
    return -float(np.sum(signals["error"] ** 2))
