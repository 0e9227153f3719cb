"""The contract of estimators: a change of the model's parameters from what was commanded and measured.

At t_k an estimator sees the state, and the response that the plant gave just before t_k to the command held since t_{k-1}.
It returns what is to be added to the parameters that it learns; everything else about the model stays as it was given. A
disturbance is a parameter too: see `disturbed`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from fpirhc.plant.plant import Plant
from fpirhc.symbolic.layout import Expression, Layout
from fpirhc.task.problem import Problem


@dataclass(frozen=True, eq=False)
class Seen:
    """What an estimator is shown in a cycle.

    `command` acted until now and caused `response` at `state`; `parameters` are those that the model was given, before any
    change of the estimator; `valid` is 0 in the first cycle, when nothing has been commanded yet, and 1 from then on.
    """

    state: Expression
    command: Expression
    response: Expression
    parameters: Expression
    valid: Expression


Correct = Callable[[Seen, Mapping[str, Expression]], tuple[Expression, dict[str, Expression]]]


class Estimator(ABC):
    """Contract: a frozen value that becomes a step for a given problem."""

    def model(self, plant: Plant) -> Plant:
        """The model whose parameters are learned: the plant's own unless some are added after them."""
        return plant

    @abstractmethod
    def learned(self) -> tuple[str, ...]:
        """Names of the parameters of the model that are corrected."""

    @abstractmethod
    def check(self, problem: Problem) -> None:
        """Raise if the estimator cannot serve the problem, whose plant is the model."""

    @abstractmethod
    def memory(self, problem: Problem) -> Layout:
        """What is remembered from cycle to cycle."""

    @abstractmethod
    def step(self, problem: Problem) -> Correct:
        """Function (seen, memory) -> (change of the learned parameters, memory one cycle later)."""
