"""A reality outside: hardware, another simulator, a physics engine. The loop is the same, its plant is an object outside.

Theory: docs/theory-plants.md.
"""

from __future__ import annotations

import queue
import threading
import time as wall
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, NoReturn, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from fpirhc.errors import FpirhcError, InvalidProblem, InvalidValue, Mistakes, NotSupported
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import CountOrZero, NotNegative, Positive, finite_number
from fpirhc.plant.integrators import Integrator
from fpirhc.plant.parameter import check_parameters, with_exact_values
from fpirhc.plant.plant import Parameter, Plant

_SAME = 1e-9  # share of a period that is no difference
_LONGEST = 60  # characters of an answer that are shown


class Body(Protocol):
    """What a body outside must be able to do."""

    def reset(self, seed: int) -> npt.ArrayLike:
        """Go to the start of the problem and return the first measurements."""

    def step(self, time: float, command: np.ndarray) -> npt.ArrayLike:
        """Hold the command from `time` on for one period, and return the measurements at its end."""


Make = Callable[[Mapping[str, float], int], Body]
"""Function (values of the parameters by name, seed) -> body."""


@dataclass(frozen=True)
class Reading:
    """One answer of a body."""

    values: np.ndarray | None  # shape (number of quantities,); None where the answer is bad
    mistake: str = ""  # why it is bad; empty where it is not


@dataclass(frozen=True, eq=False)
class ExternalPlant(Checked):
    """A reality outside: `Problem(reality=ExternalPlant(body, measures=...))`.

    Args:
        body: object with `reset(seed)` and `step(time, command)`, see `Body`; None: `make` makes it.
        measures: names of what it measures, or name -> unit, in the order of its answers: elements of the model's state ("q1",
            "q1'"), outputs and their derivatives, and, where the response is measured, highest derivatives of what is controlled
            ("q1''"). Units are those of the model; stated ones are compared with them.
        holds: consecutive bad answers that are bridged with the last good one; the next one ends the run. 0: the first ends it.
        deadline: longest wall time of a step's answer, s; a later one is bad. With a deadline the body is called by a thread of its
            own: where it does not return, it is given up, and called again when it has returned. None: it may take its time, as a
            simulator does.
        reset_deadline: longest wall time of making and resetting the body, s, where there is a deadline.
        clock: function that returns the wall time, s.
        dead_time: by input, in the model's unit of time: how late the body acts. Controllers and reviews know it as that of the
            problem; the body has it already, so it is not simulated.
        lag: by input, in the model's unit of time: the time constant with which the body follows a command. `ModelReferenced` and
            reviews know it, and no other controller; it is not simulated either.
        make: function (parameters, seed) -> body, called before every reset with the exact values of `parameters` by name.
        period: time that a step of the body takes, in the model's unit of time; problems of another one are refused. None: any.
        parameters: of the body. Scenarios draw their exact values as those of a plant; a controller knows none of them.

    Raises:
        InvalidField: all wrong arguments together. `Problem` checks the quantities against the model and its sensing.
    """

    body: Body | None = None
    measures: Mapping[str, str] | Sequence[str] = field(default_factory=dict)
    holds: CountOrZero = 0
    deadline: Positive | None = None
    reset_deadline: Positive = 10.0
    clock: Callable[[], float] = field(default=wall.perf_counter, metadata={"setting": False})
    dead_time: Mapping[str, NotNegative] = field(default_factory=dict, metadata={"setting": "where given"})
    lag: Mapping[str, NotNegative] = field(default_factory=dict, metadata={"setting": "where given"})

    make: Make | None = field(default=None, metadata={"setting": "apart"})
    parameters: Mapping[str, Parameter] = field(default_factory=dict, metadata={"setting": "where given"})
    period: Positive | None = field(default=None, metadata={"setting": False})

    states_dead_time: ClassVar[str] = "ExternalPlant(dead_time=...)"
    """Where a user states the dead time of its inputs: the body has it, and a run does not add it."""

    def __post_init__(self) -> None:
        if (self.body is None) == (self.make is None):
            raise InvalidValue("ExternalPlant: expected either a body or make=lambda parameters, seed: body")
        if self.parameters and self.make is None:
            raise InvalidValue(
                "ExternalPlant: a body that stands cannot take parameters; write make=lambda parameters, seed: body"
            )
        mistakes = Mistakes("ExternalPlant")
        for name, times in Counter([*self.measures]).items():
            if times > 1:
                mistakes.add(f"measures: {name} is named {times} times; an answer has every quantity once")
        check_parameters(self.parameters, mistakes)
        mistakes.raise_if_any()
        mistake = "" if self.body is None else _wrong_body(self.body)
        if mistake:
            raise InvalidValue(f"ExternalPlant: its body is {mistake}")

    @property
    def name(self) -> str:
        """What messages and tables call the body."""
        return type(self._present[0]).__name__.lstrip("_") if self._present else "the body that make returns"

    @property
    def remedy(self) -> str:
        """What bridges bad answers."""
        if not self.holds:
            return "; ExternalPlant(holds=1) bridges a bad answer with the last good one"
        return f", after {self.holds} in a row that were held; ExternalPlant(holds={self.holds + 1}) bridges one more"

    @property
    def symbolic(self) -> None:
        """No plant: nothing is known of it but its answers."""

    @property
    def foreign(self) -> ExternalPlant:
        """Itself."""
        return self

    def with_exact(self, exact: np.ndarray) -> ExternalPlant:
        """Return it with other exact parameters, shape (number of parameters,).

        Raises:
            InvalidProblem: a value that is not finite or outside its bounds.
            NotSupported: it has no parameters.
        """
        if not self.parameters:
            raise NotSupported(
                "the external plant has no exact parameters that a study could draw; state them, "
                "ExternalPlant(make=lambda parameters, seed: body, parameters={...}), or compare without scenarios"
            )
        return replace(self, parameters=with_exact_values(self.parameters, exact))

    def as_model(self, model: Plant) -> NoReturn:  # noqa: ARG002
        """Raise: it has no equations.

        Raises:
            NotSupported: always.
        """
        self.require_equations("an ExternalPlant has no equations that could be the exact model; leave ExactModel out")

    def require_equations(self, refusal: str) -> NoReturn:
        """Raise: it is an object outside.

        Args:
            refusal: who needs equations, and what to do.

        Raises:
            NotSupported: always, with the refusal.
        """
        raise NotSupported(refusal)

    def finer(self, integrator: Integrator, factor: int) -> None:
        """Nothing: it has no steps of an integrator."""

    @property
    def drawn(self) -> ExternalPlant:
        """Whose exact parameters studies draw."""
        return self

    @property
    def fact(self) -> str:
        """What tables call it."""
        return f"{self.name}, outside"

    def disturbable(self, model: Plant) -> tuple[str, ...]:  # noqa: ARG002
        """Return the names beside the inputs that disturbances may have: none, because nothing reaches into it."""
        return ()

    def over(self, cycle: float) -> ExternalPlant:  # noqa: ARG002
        """Return itself: it is called once in every cycle, whatever that is."""
        return self

    def shows(self, name: str) -> bool:
        """Whether it measures a coordinate or an output of the model."""
        return name in self.measures

    def check_steps(self, model: Plant, mistakes: Mistakes, *, at_once: bool) -> None:
        """Nothing: what it has inside is not known."""

    def check_motion(self, start: np.ndarray, command: np.ndarray, integrator: Integrator, period: float) -> None:  # noqa: ARG002
        """Raise if a step of the body takes another time than a cycle; what it has inside is not known."""
        if self.period is not None and abs(self.period - period) > _SAME * period:
            raise InvalidProblem(
                f"reality: one step of it takes {self.period:g}, and the problem's period is {period:g}; write both alike"
            )

    def check(self, model: Plant, needed: Collection[str], measured: Collection[str]) -> None:  # noqa: ARG002
        """Raise if it does not measure what the model's sensing needs.

        Args:
            model: the model.
            needed: names of coordinates and outputs that a plant of equations would need.
            measured: names of the quantities that sensors and estimator use.

        Raises:
            InvalidProblem: all mistakes together.
        """
        mistakes = Mistakes("reality")
        units = quantities(model)
        mistakes.unknown("measures: quantity", self.measures, units)
        mistakes.unknown("lag: input", self.lag, model.inputs)
        for name in measured:
            if name not in self.measures:
                mistakes.add(
                    f"it does not measure {name} ({units[name]}), which the sensing of the problem needs; add it to measures, or "
                    "choose an estimator that does without: Sensing(estimator=...)"
                )
        stated = self.measures if isinstance(self.measures, Mapping) else {}
        for name, unit in stated.items():
            if units.get(name, unit) != unit:
                mistakes.add(f"it measures {name} in {unit}, the model has it in {units[name]}; write both in one unit")
        mistakes.raise_if_any()

    def first(self, seed: int) -> np.ndarray:
        """Return the first measurements.

        Raises:
            InvalidProblem: a bad answer.
        """
        reading = self._answer(lambda: self._begun(seed).reset(seed), "reset", self.reset_deadline)
        if reading.values is None:
            raise InvalidProblem(f"reality: {reading.mistake}")
        return reading.values

    def read(self, time: float, command: np.ndarray) -> Reading:
        """Return the answer to a command; with a deadline it is waited for no longer."""
        return self._answer(lambda: self._present[0].step(time, command), "step", self.deadline)

    def _begun(self, seed: int) -> Body:
        """The body of the run that begins."""
        if self.make is not None:
            try:
                body = self.make({name: one.exact for name, one in self.parameters.items()}, seed)
            except Exception as error:  # noqa: BLE001  # a stranger's function may raise anything
                raise _NoBody(f"make raised {type(error).__name__}{_words(error)}") from None
            if mistake := _wrong_body(body):
                raise _NoBody(f"make returned {mistake}")
            self._present[:] = [body]
        return self._present[0]

    @cached_property
    def _present(self) -> list[Body]:
        return [] if self.body is None else [self.body]

    @cached_property
    def _caller(self) -> _Caller:
        """The thread that calls the body; there is one, because a body that is given up is still inside its call."""
        return _Caller()

    def _answer(self, ask: Callable[[], npt.ArrayLike], method: str, deadline: float | None) -> Reading:
        if self.deadline is None:
            return self._judged(ask, method, None)
        who = f"{method} of {self.name}"
        try:
            return self._caller.call(lambda: self._judged(ask, method, deadline), deadline, free_within=self.deadline)
        except _GaveUp as end:
            what = "did not return" if end.begun else "was not called, because its last call has not returned"
            patience = deadline if end.begun else self.deadline
            return Reading(None, f"{who} {what} within {patience:.3g} s, its deadline; it was given up")

    def _judged(self, ask: Callable[[], npt.ArrayLike], method: str, deadline: float | None) -> Reading:
        """The answer of a stranger's object, of which every part may raise: its numbers, its length, its words, its errors."""
        who, begin = f"{method} of {self.name}", self._now()
        try:
            returned = ask()
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # noqa: BLE001  # whatever else a stranger's object raises is a bad answer
            words = f"{who} raised {type(error).__name__}{_words(error)}"
            words = (
                f"{who}{_words(error)}" if issubclass(type(error), FpirhcError) else words
            )  # those of an adapter say it all
            return Reading(None, str(error) if issubclass(type(error), _NoBody) else words)
        elapsed = self._now() - begin
        answer = _real_numbers(returned)
        expected = f"{len(self.measures)} numbers: {', '.join(self.measures)}"
        if answer is None:
            return Reading(None, f"{who} returned {_short(returned)}, expected {expected}")
        if answer.shape != (len(self.measures),):
            return Reading(None, f"{who} returned the shape {answer.shape}, expected {expected}")
        if not np.isfinite(answer).all():
            place = int(np.argmin(np.isfinite(answer)))
            return Reading(
                None, f"{who} returned {list(self.measures)[place]} = {answer[place]}, expected a finite number"
            )
        if deadline is not None and elapsed > deadline:
            return Reading(None, f"{who} took {elapsed:.3g} s, and its deadline is {deadline:.3g} s")
        return Reading(answer)

    def _now(self) -> float:
        """The wall time; without a deadline nobody asks for it."""
        if self.deadline is None:
            return 0.0
        try:
            time = self.clock()
        except Exception as error:  # noqa: BLE001  # a stranger's function may raise anything
            raise InvalidValue(f"ExternalPlant(clock=...): it raised {type(error).__name__}{_words(error)}") from None
        if not finite_number(time):
            raise InvalidValue(
                f"ExternalPlant(clock=...): it returned {_short(time)}, expected the wall time as a number, in s"
            )
        return float(time)


class _NoBody(Exception):
    """`make` gave no body; the words say why."""


def _wrong_body(body: object) -> str:
    """What stands in place of a body, and what to write; empty where it is one."""
    if isinstance(body, type):
        return f"the class {body.__name__}; write {body.__name__}() for an object of it"
    lacking = [name for name in ("reset", "step") if not callable(getattr(body, name, None))]
    if not lacking:
        return ""
    what = "None" if body is None else f"a value of the class {type(body).__name__} without {' and '.join(lacking)}"
    return f"{what}; expected an object with reset(seed) and step(time, command)"


def _real_numbers(answer: object) -> np.ndarray | None:
    """The answer as real numbers; None where it is none."""
    try:
        if isinstance(answer, np.ma.MaskedArray):  # what lies under a mask is no measurement
            return None
        if isinstance(answer, list | tuple) and any(isinstance(v, bool | np.bool_) for v in answer):
            return None
        column = np.asarray(answer)
        return column.astype(float) if column.dtype.kind in "iuf" else None
    except Exception:  # noqa: BLE001  # rows of different lengths; an object that raises where numpy asks it for its numbers
        return None


def _words(error: BaseException) -> str:
    try:
        text = " ".join(str(error).split())
    except Exception:  # noqa: BLE001  # an exception of a stranger's that has no words
        text = ""
    return f": {text}" if text else ""


def _short(answer: object) -> str:
    try:
        text = " ".join(repr(answer).split())
    except Exception:  # noqa: BLE001  # an answer that cannot write itself down
        text = f"a value of the class {type(answer).__name__}"
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


def quantities(model: Plant) -> dict[str, str]:
    """Return the unit of every quantity of a model that can be measured: state elements, outputs, and controlled responses."""
    signals, orders = (model.state, model.output), model.response_orders
    shown = {name: unit for s in signals for name, unit in zip(s.elements, s.entry_units, strict=True)}
    units = model.response_signal("realised").entry_units
    responses = {name + "'" * order: unit for (name, order), unit in zip(orders.items(), units, strict=True)}
    return {**shown, **responses}


Result = TypeVar("Result")


class _GaveUp(Exception):
    """The time is over; `begun` says whether the call itself was begun."""

    def __init__(self, *, begun: bool) -> None:
        super().__init__(begun)
        self.begun = begun


class _Caller:
    """Calls functions in one thread of its own, one after another; who waits can give up, and nothing is interrupted.

    An object that belongs to a thread is safe so. The thread begins with the first call and does not keep the program from ending.
    """

    def __init__(self) -> None:
        self._calls: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._last = threading.Event()  # set when the last call has returned
        self._last.set()

    def call(self, function: Callable[[], Result], patience: float | None, *, free_within: float) -> Result:
        """Return what a function returns, or raise what it raises.

        Args:
            patience: longest time that is waited for it, s; None: any.
            free_within: longest time in which an earlier call that was given up has to return, s.
        """
        end = None if patience is None else wall.monotonic() + patience
        if not self._last.wait(free_within):
            raise _GaveUp(begun=False)
        returned: list[Result] = []
        raised: list[BaseException] = []
        done = self._last = threading.Event()

        def run() -> None:
            try:
                returned.append(function())
            except BaseException as error:  # noqa: BLE001 -- it is raised where the result is waited for
                raised.append(error)
            finally:
                done.set()

        self._start()
        self._calls.put(run)
        if not done.wait(None if end is None else max(end - wall.monotonic(), 0.0)):
            raise _GaveUp(begun=True)
        if raised:
            raise raised[0]
        return returned[0]

    def _start(self) -> None:
        if self._thread is None:
            self._thread = threading.Thread(target=_work, args=(self._calls,), name="fpirhc body", daemon=True)
            self._thread.start()


def _work(calls: queue.SimpleQueue[Callable[[], None]]) -> None:
    while True:
        calls.get()()
