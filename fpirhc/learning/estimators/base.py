"""The contract of estimators: a change of the model's parameters from commands and measurements.

At t_k an estimator receives the state, and the response just before t_k to the command held since t_{k-1}; both are older behind
dead time. It returns a change of the parameters that it learns. A disturbance is a parameter too: see `disturbed`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from fpirhc.errors import InvalidValue
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import Deviation
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.layout import Expression, Layout
from fpirhc.task.problem import Problem


@dataclass(frozen=True, eq=False)
class Seen:
    """Data of an estimator in one cycle."""

    state: Expression  # the measured state at which the response was measured
    command: (
        Expression  # it caused `response` at `state`: the last one, or an older one behind dead time and estimators
    )
    response: Expression  # the measured response
    parameters: Expression  # those of the model without the estimator's change
    # 0 before the first pair of this run (in the first cycle, and until the first sample of the run arrives), then 1
    valid: Expression
    # the measured outputs y, y', ... at that instant; None without outputs, or where the estimator does not read them.
    output: Expression | None = None


Correct = Callable[[Seen, Mapping[str, Expression]], tuple[Expression, dict[str, Expression]]]


class ParameterEstimator(Checked, ABC):
    """Contract: a frozen value that becomes a step for a given problem."""

    def model(self, plant: Plant) -> Plant:
        """The model whose parameters are learned: the plant, or the plant with further parameters after its own."""
        return plant

    def reads_response(self, plant: Plant) -> bool:  # noqa: ARG002
        """Whether it learns from the measured response of this plant; True by default."""
        return True

    @property
    def acts_at_once(self) -> bool:
        """Whether what it learns changes the command in every cycle, also between plans; False by default."""
        return False

    def reads_outputs(self, plant: Plant) -> bool:  # noqa: ARG002
        """Whether it learns from the measured outputs of this plant below their responses; False by default."""
        return False

    @abstractmethod
    def learned(self) -> tuple[str, ...]:
        """Names of the parameters of the model that are learned."""

    @abstractmethod
    def check(self, problem: Problem) -> None:
        """Raise if the estimator cannot serve the problem, whose plant is the model."""

    @abstractmethod
    def memory(self, problem: Problem) -> Layout:
        """Signals that are remembered from cycle to cycle."""

    @abstractmethod
    def step(self, problem: Problem) -> Correct:
        """Function (seen, memory) -> (change of the learned parameters, memory one cycle later)."""


@dataclass(frozen=True)
class Uncertain(Checked):
    """Prior of a learned parameter.

    Args:
        lower: least possible value (of a mass: above zero), in its unit.
        upper: largest possible value, in its unit.
        deviation: usual distance from the approximate value, in its unit.

    Raises:
        InvalidValue: bounds that are not finite, or swapped.
    """

    lower: float
    upper: float
    deviation: Deviation

    def __post_init__(self) -> None:
        if not -math.inf < self.lower < self.upper < math.inf:
            raise InvalidValue(f"Uncertain(lower={self.lower!r}, upper={self.upper!r}): expected finite lower < upper")
