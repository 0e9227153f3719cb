"""The stages of a prediction: how many, how long, and what holds along them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeVar

import numpy as np

from fpirhc.errors import InvalidValue
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import AtLeastOne, Count, Duration, NotNegative, described
from fpirhc.plant.integrators import USUAL, Integrator

Entry = TypeVar("Entry")


def in_tuple(values: Sequence[Entry]) -> tuple[Entry, ...]:
    """Return the entries of a tuple, a list or an array, which is neither true nor equal to another, as a tuple."""
    return tuple(values.tolist() if isinstance(values, np.ndarray) else values)


@dataclass(frozen=True)
class Horizon(Checked):
    """Length and stages of a controller's prediction.

    Args:
        stages: number of stages N.
        step: length of one stage, s, over which the input is constant.
        discretisation: RungeKutta4() or Collocation() over one stage; a map has none: a stage is a whole number of its steps.
        lengths: of the stages, as multiples of `step`, which is that of the first one: fine stages first. One number of at least
            1 for every stage, a whole one on a map; empty: all stages are equal. Every stage counts with its length in the cost,
            limits and costs of input changes with the time since the change before. Prices of limits count every node alike.
        blocks: lengths of blocks of stages over which the inputs are held (move blocking); they add up to the stages. Empty: every
            stage has inputs of its own.
        margins: by name of a state, the distance by which a plan stays inside the state's limits, in the state's unit: room for
            what the model does not predict. The problem's limits stay as they are for the run and its metrics.
        replan: when the next plan is made: after one "stage", after one control "cycle", or after so many cycles, at most those of
            a stage. Where a plan follows sooner than a stage, the horizon begins at the cycle's own time, the last plan is
            interpolated to the new stages, and the change of the first input counts with the time that it takes: the limit of
            its rate holds from plan to plan, and its cost is stages per plan times that of a later change. More plans on long
            stages do not lower the error of a wrong model; a first stage of one cycle and `lengths` that grow do.
        share: of a stage, the time from plan to plan. Controllers fill it in from `replan`.
        measured: names of states whose limits hold for the measured state: for the plan's plus the distance of the measured one
            from the plan's start. Controllers fill it in where a plan starts elsewhere, see `fpirhc.horizon.nominal`.

    Raises:
        InvalidValue: fewer than one stage, a step that is not positive, blocks that do not add up, a margin that is not
            a finite number of at least 0, or plans that follow in no whole number of cycles.
    """

    stages: Count
    step: Duration
    discretisation: Integrator = USUAL
    blocks: tuple[Count, ...] = ()
    margins: Mapping[str, NotNegative] = field(default_factory=dict, hash=False, metadata={"setting": "where given"})
    lengths: tuple[AtLeastOne, ...] = field(default=(), kw_only=True, metadata={"setting": "where given"})
    measured: tuple[str, ...] = field(default=(), kw_only=True, metadata={"setting": False})
    replan: Literal["stage", "cycle"] | Count = field(
        default="stage", kw_only=True, metadata={"setting": "where given"}
    )
    share: float = field(default=1.0, kw_only=True, metadata={"setting": False})

    def __post_init__(self) -> None:
        for name in ("blocks", "lengths", "measured"):
            object.__setattr__(self, name, in_tuple(getattr(self, name)))
        if self.lengths and (len(self.lengths) != self.stages or self.lengths[0] != 1):
            raise InvalidValue(
                f"horizon: lengths must be {self.stages} finite numbers of at least 1, one for every stage in steps of the first, "
                f"which is 1; got {described(self.lengths)}"
            )
        if self.blocks and sum(self.blocks) != self.stages:
            raise InvalidValue(
                f"horizon: blocks {self.blocks} add up to {sum(self.blocks)}, expected {self.stages} stages"
            )

    @property
    def relative_lengths(self) -> np.ndarray:
        """Lengths of the stages in steps of the first one, shape (N,)."""
        return np.array(self.lengths) if self.lengths else np.ones(self.stages)

    @property
    def nodes(self) -> np.ndarray:
        """Times of s_0 ... s_N from the start, shape (N + 1,), in the plant's unit of time."""
        if not self.lengths:
            return np.arange(self.stages + 1) * self.step
        return np.concatenate([[0.0], np.cumsum(self.lengths)]) * self.step

    @property
    def longest(self) -> float:
        """Length of the longest stage."""
        return self.step * max(self.lengths, default=1.0)

    @property
    def last(self) -> float:
        """Length of the last stage."""
        return self.step * (self.lengths[-1] if self.lengths else 1.0)
