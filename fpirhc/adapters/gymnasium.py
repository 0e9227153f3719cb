"""A Gymnasium environment as the reality of a problem.

The period of the problem must be the time that one step of the environment takes. An environment does not state it, so another one
is refused only where it is written: `dataclasses.replace(gymnasium_body(...), period=0.05)`. Rewards are not read; an end that is
not one of time (`terminated`) is a bad answer and ends the run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from fpirhc.adapters.names import adapter, require_methods
from fpirhc.errors import InvalidProblem, Mistakes
from fpirhc.plant.plant import Plant
from fpirhc.task.external_plant import ExternalPlant, quantities

Read = int | Callable[[Any], float]


@adapter
def gymnasium_body(env: Any, model: Plant, *, measures: Mapping[str, Read]) -> ExternalPlant:
    """Return an environment as a reality.

        env = gymnasium.make("Pendulum-v1")
        measures = {"th": lambda seen: np.arctan2(seen[1], seen[0]), "th'": 2}
        problem = fp.Problem(plant=model, reality=gymnasium_body(env, model, measures=measures), ...)

    Args:
        env: environment whose actions are a `Box` of the model's inputs, in their order and units.
        model: the controller's model.
        measures: quantity of the model ("th", "th'") -> its place in the observation, or a function of the observation.

    Raises:
        InvalidProblem: a quantity that the model does not have, a place that the observation does not have, or other actions.
    """
    require_methods("gymnasium_body(env=...)", env, ("reset", "step"), 'gymnasium.make("Pendulum-v1")')
    units, mistakes = quantities(model), Mistakes("gymnasium_body")
    mistakes.unknown("measures: quantity", measures, units)
    actions, size = getattr(env.action_space, "shape", None), int(np.prod(env.observation_space.shape or (0,)))
    if actions != (len(model.inputs),):
        mistakes.add(
            f"the environment takes actions {env.action_space}, the model has the inputs {', '.join(model.inputs)}; "
            "actions must be a Box of as many entries"
        )
    for name, read in measures.items():
        if isinstance(read, int) and not 0 <= read < size:
            mistakes.add(
                f"measures: {name} is entry {read} of the observation, which has {size} entries, 0 to {size - 1}"
            )
    mistakes.raise_if_any()
    return ExternalPlant(_Body(env, measures), measures={name: units[name] for name in measures})


class _Body:
    """The environment with the quantities that are read from its observations.

    `measures`: quantity -> place, or a function of the observation.
    """

    def __init__(self, env: Any, measures: Mapping[str, Read]) -> None:
        self._env, self._measures = env, measures

    def reset(self, seed: int) -> np.ndarray:
        """Begin an episode."""
        return self._read(self._env.reset(seed=seed)[0])

    def step(self, time: float, command: np.ndarray) -> np.ndarray:
        """Take one step."""
        seen, _, terminated, _, _ = self._env.step(np.asarray(command, dtype=self._env.action_space.dtype))
        if terminated:
            raise InvalidProblem(f"the environment ended its episode at {time:g}")
        return self._read(seen)

    def _read(self, seen: Any) -> np.ndarray:
        flat = np.ravel(seen)
        return np.array([flat[read] if isinstance(read, int) else read(seen) for read in self._measures.values()])
