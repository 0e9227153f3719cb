"""A reality outside: hardware, another simulator, a physics engine. The loop is the same, its plant is an object outside.

Theory: docs/theory.md.
"""

from __future__ import annotations

import reprlib
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import ClassVar, NoReturn, Protocol

import numpy as np
import numpy.typing as npt

from fpirhc.errors import FpirhcError, InvalidProblem, Mistakes, NotSupported, require
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import Finite, NotNegative, Positive
from fpirhc.plant.chain import quantities
from fpirhc.plant.integrators import Integrator
from fpirhc.plant.maps import against_lags
from fpirhc.plant.parameter import check_parameters, with_exact_values
from fpirhc.plant.plant import Parameter, Plant

_SAME = 1e-9  # share of a period that is no difference


class Body(Protocol):
    """What a body outside must be able to do."""

    def reset(self, seed: int) -> npt.ArrayLike:
        """Go to the start of the problem and return the first measurements."""

    def step(self, time: float, command: np.ndarray) -> npt.ArrayLike:
        """Hold the command from `time` on for one period, and return the measurements at its end."""


Make = Callable[[Mapping[str, float], int], Body]
"""Function (values of the parameters by name, seed) -> body."""


@dataclass(frozen=True, eq=False)
class ExternalPlant(Checked):
    """A reality outside: `Problem(reality=ExternalPlant(body, measures=...))`.

    Args:
        body: object with `reset(seed)` and `step(time, command)`, see `Body`; None: `make` makes it.
        measures: names of what it measures -> unit, in the order of its answers: elements of the state ("q1",
            "q1'"), outputs and their derivatives, and, where the response is measured, highest derivatives of what is controlled
            ("q1''"). Units are those of the model. A body that has measured nothing in a cycle, or waited for it too long, returns
            NaN: the cycle is skipped. An exception, or an answer of another shape, ends the run.
        rest: by input, what is sent when a run ends, however it ends: complete, stopped, by an exception or Ctrl-C. Every input of
            the model; {}: nothing is sent. A body with a method `close` is a real plant, which would keep its last command: it
            must say, and is closed.
        lag: by input, in the model's unit of time: the time constant with which the body follows a command. `ModelReferenced` and
            reviews know it, and no other controller; it is not simulated.
        make: function (parameters, seed) -> body, called before every reset with the exact values of `parameters` by name.
        period: time that a step of the body takes, in the model's unit of time; problems of another one are refused. None: any.
        parameters: of the body. Scenarios draw their exact values as those of a plant; a controller knows none of them.

    Raises:
        InvalidField: all wrong arguments together. `Problem` checks the quantities against the model and its sensing.
    """

    body: Body | None = None
    measures: Mapping[str, str] = field(default_factory=dict)
    rest: Mapping[str, Finite] | None = None
    lag: Mapping[str, NotNegative] = field(default_factory=dict)
    make: Make | None = None
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    period: Positive | None = None
    simulated: ClassVar[bool] = False  # no equations, no run again to answer a question, and a dead time of its own

    def __post_init__(self) -> None:
        mistakes = Mistakes("ExternalPlant")
        if (self.body is None) == (self.make is None):
            mistakes.add("expected either a body or make=lambda parameters, seed: body")
        elif self.make is None and (mistake := self._wrong(self.body)):
            mistakes.add(f"its body is {mistake}")
        elif self.make is None and self.parameters:
            mistakes.add("a body that stands cannot take parameters; write make=lambda parameters, seed: body")
        check_parameters(self.parameters, mistakes)
        mistakes.raise_if_any()

    @property
    def name(self) -> str:
        """What messages and tables call the body."""
        return type(self._present[0]).__name__.lstrip("_") if self._present else "the body that make returns"

    def with_exact(self, exact: np.ndarray) -> ExternalPlant:
        """Return it with other exact parameters, shape (number of parameters,)."""
        require(
            self.parameters,
            "the external plant has no exact parameters that a study could draw; state them, "
            "ExternalPlant(make=lambda parameters, seed: body, parameters={...}), or compare it without a study",
        )
        return replace(self, parameters=with_exact_values(self.parameters, exact))

    def as_model(self, model: Plant) -> NoReturn:  # noqa: ARG002
        raise NotSupported("an ExternalPlant has no equations that could be the exact model; leave ExactModel out")

    def shows(self, name: str) -> bool:
        return name in self.measures

    def check_motion(self, start: np.ndarray, command: np.ndarray, integrator: Integrator, period: float) -> None:  # noqa: ARG002
        if self.period is not None and abs(self.period - period) > _SAME * period:
            raise InvalidProblem(
                f"reality: one step of it takes {self.period:g}, and the problem's period is {period:g}; write both alike"
            )

    def check(self, model: Plant, needed: Collection[str], measured: Collection[str]) -> None:  # noqa: ARG002
        """Raise if it does not measure what the model's sensing needs, the names in `measured`."""
        mistakes, units = Mistakes("reality"), quantities(model)
        mistakes.unknown("measures: quantity", self.measures, units)
        mistakes.unknown("lag: input", self.lag, model.inputs)
        mistakes.join(f"lag: {reason}" for reason in against_lags(model, self.lag.values()))
        rest = self.rest or {}
        mistakes.unknown("rest: input", rest, model.inputs)
        for name in (n for n in model.inputs if rest and n not in rest):
            mistakes.add(f"rest: input '{name}' has no value; state what every input is sent when a run ends")
        for name in (n for n in measured if n not in self.measures):
            mistakes.add(
                f"it does not measure {name} ({units[name]}), which the sensing of the problem needs; add it to measures, or "
                "choose an estimator that does without: Sensing(estimator=...)"
            )
        for name, unit in self.measures.items():
            if units.get(name, unit) != unit:
                mistakes.add(f"it measures {name} in {unit}, the model has it in {units[name]}; write both in one unit")
        mistakes.raise_if_any()

    def first(self, seed: int) -> np.ndarray:
        """Return the first measurements."""
        if self.make is not None:
            try:
                body = self.make({name: one.exact for name, one in self.parameters.items()}, seed)
            except Exception as error:  # noqa: BLE001  # a stranger's function may raise anything
                raise InvalidProblem(f"reality: make raised {_words(error)}") from None
            if mistake := self._wrong(body):
                raise InvalidProblem(f"reality: make returned {mistake}")
            self._present[:] = [body]
        answer = self._answer(lambda: self._present[0].reset(seed), "reset")
        for name, value in zip(self.measures, answer, strict=True):
            if not np.isfinite(value):
                raise InvalidProblem(
                    f"reality: reset of {self.name} returned {name} = {value}, expected a finite number"
                )
        return answer

    def read(self, time: float, command: np.ndarray) -> np.ndarray:
        """Return the answer to a command.

        Raises:
            InvalidProblem: the body raised, or its answer is no row of so many numbers.
        """
        return self._answer(lambda: self._present[0].step(time, command), "step")

    def end(self, time: float, inputs: Iterable[str]) -> None:
        """Send what rests at the end of a run, and close the body where it has `close`; what fails is warned of."""
        resting = np.array([self.rest[name] for name in inputs]) if self.rest else None
        for body in self._present:
            try:
                if resting is not None:
                    self._answer(partial(body.step, time, resting), "step")
            except InvalidProblem as error:
                warnings.warn(f"the inputs at rest may not have arrived: {error}", stacklevel=2)
            finally:
                close = getattr(body, "close", None)
                if callable(close):
                    close()

    def _wrong(self, body: object) -> str:
        """What stands in place of a body, and what to write; empty where nothing is wrong."""
        if isinstance(body, type):
            return f"the class {body.__name__}; write {body.__name__}() for an object of it"
        if self.rest is None and callable(getattr(body, "close", None)):
            return (
                f"a real plant, as {type(body).__name__} has close(), and would keep its last command when a run ends; state what "
                "it is sent then, rest={'u': 0.0} with every input, or rest={} where nothing is to be sent"
            )
        lacking = [name for name in ("reset", "step") if not callable(getattr(body, name, None))]
        what = "None" if body is None else f"a value of the class {type(body).__name__} without {' and '.join(lacking)}"
        return f"{what}; expected an object with reset(seed) and step(time, command)" if lacking else ""

    @cached_property
    def _present(self) -> list[Body]:
        return [] if self.body is None else [self.body]

    def _answer(self, ask: Callable[[], npt.ArrayLike], method: str) -> np.ndarray:
        who, expected = f"reality: {method} of {self.name}", f"{len(self.measures)} numbers: {', '.join(self.measures)}"
        try:
            returned = ask()
            values = np.ma.filled(returned, np.nan)  # what lies under a mask is no measurement
        except FpirhcError as error:  # those of an adapter say it all
            raise InvalidProblem(f"{who}: {error}") from None
        except Exception as error:  # noqa: BLE001  # a stranger's object may raise anything
            raise InvalidProblem(f"{who} raised {_words(error)}") from None
        if values.dtype.kind not in "iuf" or values.shape != (len(self.measures),):
            raise InvalidProblem(f"{who} returned {reprlib.repr(returned)}, expected {expected}")
        return values.astype(float)


def _words(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split()).rstrip(":")
