"""The contract of observers: states of the model that no sensor shows, from the own commands and from what is measured.

Theory: docs/theory-estimation.md.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidValue, Mistakes
from fpirhc.fields.checked import Checked
from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import quantities
from fpirhc.symbolic.layout import Expression, Layout

Remembered: TypeAlias = Mapping[str, Expression]


@dataclass(frozen=True, eq=False)
class Model:
    """What an observer is built from.

    Args:
        plant: the model.
        move: Function (state, input, parameters, forcing, share) -> state after that share of a cycle.
        start: first state, shape (nx,).
        measured: names of the measured quantities.
    """

    plant: Plant
    move: ca.Function
    start: np.ndarray
    measured: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Evidence:
    """Data of an observer in one cycle.

    Args:
        measured: what the sensors show, by name of the quantity.
        known: state elements that follow from these alone: measured, or derivatives of measured coordinates.
        command: it acted until the sample was taken.
        parameters: of the model.
        moves: share of a cycle by which the sample is later than the last one: 1, or 0 for a sample that still shows the start.
            Where samples are late by a fraction of a cycle, the first one that moves shows a mean with the start, and so a share.
        counts: 1 where the sample was taken in this run, and is not the start again that fills a dead time.
    """

    measured: Mapping[str, Expression]
    known: Mapping[str, Expression]
    command: Expression
    parameters: Expression
    moves: Expression
    counts: Expression


Predict: TypeAlias = Callable[[Evidence, Remembered], Expression]
Correct: TypeAlias = Callable[[Evidence, Remembered, Expression], tuple[Expression, dict[str, Expression]]]


class StateObserver(Checked, ABC):
    """Contract: a frozen value that becomes a prediction and a correction of the model's state."""

    @abstractmethod
    def check(self, plant: Plant, measured: tuple[str, ...]) -> None:
        """Raise if it cannot serve the plant with these measured quantities.

        Raises:
            InvalidProblem: all mistakes together.
        """

    @abstractmethod
    def believes(self, plant: Plant, known: tuple[str, ...]) -> tuple[str, ...]:
        """State elements that the controller is given from the observer.

        Args:
            plant: the model.
            known: state elements that follow from what is measured.
        """

    @property
    def opaque(self) -> bool:
        """Whether its step is built as a graph of calls; False: as scalar code."""
        return False

    def uses(self, measured: tuple[str, ...]) -> tuple[str, ...]:
        """Names of the measured quantities that correct the state; by default all."""
        return measured

    @abstractmethod
    def memory(self, model: Model) -> Layout:
        """Signals that are remembered from cycle to cycle."""

    @abstractmethod
    def predict(self, model: Model) -> Predict:
        """Function (evidence, memory) -> predicted state x-; of `evidence.known` nothing may be used yet."""

    @abstractmethod
    def correct(self, model: Model) -> Correct:
        """Function (evidence, memory, predicted state) -> (state x^, memory one cycle later)."""

    @abstractmethod
    def free(self, slopes: Sequence[np.ndarray], shown: Sequence[np.ndarray], known: Sequence[int]) -> np.ndarray:
        """Basis of the errors of the state that no measurement corrects, shape (nx, number).

        Args:
            slopes: Jacobians of the rates along the reference, each (nx, nx).
            shown: Jacobians of the measured quantities there, each (number, nx).
            known: places of the known state elements.
        """

    @property
    def needs_detectability(self) -> bool:
        """Whether errors that no measurement corrects must decay by themselves, or the observer is refused."""
        return False


def require_named(owner: str, **named: Mapping[str, float]) -> None:
    """Raise InvalidValue for a mapping without entries."""
    for name, values in named.items():
        if not values:
            raise InvalidValue(f"{owner}({name}={{}}): name at least one")


def name_mistakes(
    owner: str,
    plant: Plant,
    shown: tuple[str, ...],
    measured: Mapping[str, float],
    noise: Mapping[str, float],
    start: Mapping[str, float],
) -> Mistakes:
    """Return the mistakes in the names of an observer's noises.

    Args:
        owner: the observer's class.
        plant: the model.
        shown: names of what sensors show.
        measured: quantities with the noise of their sensors.
        noise: coordinates with their noise.
        start: states with the deviation of their first value.
    """
    mistakes, every = Mistakes(owner), quantities(plant)
    mistakes.unknown("measured: quantity", measured, every)
    for name in measured:
        if name in every and name not in shown:
            mistakes.add(f"measured: no sensor shows '{name}'; those of Sensing(measured=...) are {', '.join(shown)}")
    mistakes.unknown("noise: coordinate", noise, plant.coordinates)
    mistakes.unknown("start: state", start, plant.state.elements)
    return mistakes


def first_covariance(plant: Plant, start: Mapping[str, float]) -> np.ndarray:
    """Return the covariance of the first state, shape (nx, nx)."""
    return np.diag([start.get(e, 0.0) ** 2 for e in plant.state.elements])


def covariance_entries(plant: Plant) -> tuple[str, ...]:
    """Names of the entries of a covariance, column by column."""
    return tuple(f"{i},{j}" for j in plant.state.elements for i in plant.state.elements)
