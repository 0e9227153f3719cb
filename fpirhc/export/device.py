"""What every target knows of a controller that leaves Python: its C, the C names of its numbers, and how large all of it is.

The C is that of `Stepper.function`; no target computes anything of the controller anew.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from fpirhc.controllers.contract import Controller
from fpirhc.controllers.gate import BRIDGED
from fpirhc.controllers.reference_states import given_signals
from fpirhc.controllers.sensing_chain import compose_with_sensing
from fpirhc.errors import InvalidName, NotSupported
from fpirhc.export.c_text import portable
from fpirhc.export.straight import condensed
from fpirhc.simulation.clock import most_missed
from fpirhc.simulation.stepper import Stepper
from fpirhc.symbolic.layout import Layout
from fpirhc.symbolic.live import PREFIX
from fpirhc.symbolic.native import native
from fpirhc.symbolic.program import generate
from fpirhc.task.problem import Problem

_RAW = "fpirhc_native"  # name of the generated function, before it has its own
_INSIDE = re.compile(r"if \((casadi_f\d+)\(arg1, res1, iw, w, 0\)\) return 1;")  # the call of scalar code
_DRIVER = re.compile(r"\bfpirhc_(\w+_driver)\b")
_C_WORDS = frozenset(
    re.findall(
        r"\w+",
        """auto break case char const continue default do double else enum extern float for goto if inline int long register
        restrict return short signed sizeof static struct switch typedef union unsigned void volatile while _Bool _Complex
        _Imaginary main asm typeof class new delete this template namespace private public protected virtual operator bool
        true false""",
    )
)
_FILES = frozenset(("processor", "board", "example"))  # C files that are not the controller's own
_LONGEST = 40  # characters of a name


@dataclass(frozen=True, eq=False)
class Device:
    """A controller for a device."""

    name: str  # prefix of everything in C
    title: str  # of problem and controller
    problem: Problem  # of the controller
    controller: Controller  # as the problem file has it
    # of the controller; compiled where there is a compiler, so that its numbers are those of C to the last bit
    stepper: Stepper | BareStep
    cycles: int  # number of cycles that are recorded for a replay
    # "system" or "own": exp, log, pow, sin, cos, tanh and atanh of the machine, or those with the same bits everywhere
    libm: str = "system"
    bare: bool = False  # whether the step is the controller's alone, without gate, watch and missed cycles

    @cached_property
    def inputs(self) -> Layout:
        """What a step is given: the time and the sample."""
        stays = {*self.data.names, *self.settings.names}
        return self._read(lambda name: name not in stays)

    @cached_property
    def settings(self) -> Layout:
        """Live settings and what follows from them."""
        return self._read(lambda name: name.startswith(PREFIX))

    @cached_property
    def data(self) -> Layout:
        """What stays until somebody changes it: parameters and set-points."""
        stays = {"parameters", *(signal.name for signal in given_signals(self.problem))}
        return self._read(lambda name: name in stays)

    @cached_property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """Intervals of the live settings, by path."""
        outdated = [name for name, effect in self.stepper.outdated().items() if not effect]
        if outdated:
            raise NotSupported(
                f"these live settings cannot leave Python: '{outdated[0].removeprefix(PREFIX)}' follows from them and must not "
                "stay as it was; export without live settings, or with gains, limits and rates alone"
            )
        return dict(self.stepper.bounds())

    @cached_property
    def most_missed(self) -> int:
        """Number of missed cycles that a step makes up for."""
        return most_missed(self.problem, BRIDGED)

    @cached_property
    def sources(self) -> tuple[str, ...]:
        """The C files of the Function, for every compiler: its own, and the loops that it calls."""
        return self._generated[0]

    @cached_property
    def sizes(self) -> dict[str, int]:
        """Numbers of pointers, whole numbers and numbers that the Function needs to work: arg, res, iw, w."""
        return self._generated[1]

    @cached_property
    def _generated(self) -> tuple[tuple[str, ...], dict[str, int]]:
        return c_of(self.stepper.function, self.name)

    def _read(self, wanted: Callable[[str], bool]) -> Layout:
        return Layout(tuple(s for s in self.stepper.reads.signals if wanted(s.name)))


class BareStep:
    """A controller's own step, with what targets ask a `Stepper`.

    A sample that is no number, or beyond all reason, reaches its memory, and stays there until the next reset. Missed cycles are
    not made up for.

    Args:
        behind: the step of the same controller behind its gate; its data are taken.
    """

    def __init__(self, problem: Problem, controller: Controller, behind: Stepper) -> None:
        composite = compose_with_sensing(problem, controller)
        self.function, self.memory, self.signals = composite.function, composite.memory, composite.trace
        self.reads = Layout(tuple(behind.reads[name] for name in composite.reads.names))
        self.numbers = behind.numbers
        ready = native(self.function)
        self.compiled, self._step, self._trace = ready.compiled, ready.function, self.signals.start()

    def start(self) -> np.ndarray:
        """Return the first memory."""
        return self.memory.start()

    def bounds(self) -> Mapping[str, tuple[float, float]]:
        """Nothing is live."""
        return {}

    def outdated(self) -> dict[str, str]:
        """Nothing is live."""
        return {}

    def trace(self) -> dict[str, np.ndarray]:
        """Return the signals of the last step."""
        return self.signals.unpack(self._trace)

    def step_measured(self, time: float, measured: np.ndarray, memory: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (command, memory for the next cycle), as `Stepper.step_measured`."""
        values = np.concatenate([[time], measured, self.reads.start()[1 + len(measured) :]])
        after, trace, command = self._step(memory, *self.reads.unpack(values).values())
        self._trace = trace.full().ravel()
        return command.full().ravel(), after.full().ravel()


def c_of(function: ca.Function, name: str) -> tuple[tuple[str, ...], dict[str, int]]:
    """Return the C files of a Function, whose name in C is NAME_raw, and the sizes of its work: arg, res, iw, w.

    Who calls it passes rows for all that it reads and writes.
    """
    texts, files = generate(function), []
    sizes = {key: max(1, int(size)) for key, size in re.findall(r"\*sz_(\w+) = (\d+);", texts[0])}
    text, sizes["w"] = _without_wrapper(texts[0], sizes["w"])
    if function.is_a("SXFunction") and text != texts[0]:  # scalar code has variables of its own
        text, sizes = condensed(text), {"arg": function.n_in(), "res": function.n_out(), "iw": 1, "w": 1}
    texts = (text, *texts[1:])
    for text in texts:
        entry = re.match(r"#define ENTRY (\w+)\n", text)
        visible = entry[1] if entry else _RAW
        own = portable(re.sub(r"\bENTRY\b", visible, text[entry.end() :]) if entry else text, visible)
        files.append(_DRIVER.sub(rf"{name}_\1", re.sub(rf"\b{_RAW}\b", f"{name}_raw", own)))
    return tuple(files), sizes


def _without_wrapper(text: str, work: int) -> tuple[str, int]:
    """The C without the copies around the call that its outermost function is, and the work of what is called.

    Results are written where the caller wants them, which is not where the arguments are.
    """
    outer = text[text.index("static int casadi_f0(") :]
    called = _INSIDE.findall(outer)
    if len(called) != 1:
        return text, work
    own = [int(place) for place in re.findall(r"=w\+(\d+)", outer)]
    return text.replace("return casadi_f0(", f"return {called[0]}("), max(1, min([work, *own]))


def identifiers(names: Sequence[str]) -> list[str]:
    """Return C names for names of signals, each once: q1'' is q1_dd."""
    found: dict[str, int] = {}
    chosen = []
    for name in names:
        one = _identifier(name)
        found[one] = found.get(one, 0) + 1
        chosen.append(one if found[one] == 1 else f"{one}_{found[one]}")
    return chosen


def check_name(name: str) -> None:
    """Raise for a name that C does not take as a prefix."""
    if re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII) and name not in _C_WORDS | _FILES and len(name) <= _LONGEST:
        return
    offer = default_name(name)
    raise InvalidName(
        f"'{name}' cannot be the name of a controller in C: expected at most {_LONGEST} letters, digits and underscores, a letter "
        f"first, and no word of C or of the files beside it. Did you mean '{offer}'?"
    )


def default_name(text: str) -> str:
    """Return a C name made of a text."""
    name = re.sub(r"\W+", "_", text, flags=re.ASCII).strip("_").lower()[:_LONGEST].rstrip("_")
    return name if re.match(r"[a-z]", name) and name not in _C_WORDS | _FILES else f"c_{name}"[:_LONGEST].rstrip("_")


def literal(value: float) -> str:
    """Return a number with all its digits, in the form that `driver.of_type` recognises."""
    return f"{float(np.clip(value, -1.7e308, 1.7e308)):.16e}"


def _identifier(name: str) -> str:
    base = name.rstrip("'")
    primes = len(name) - len(base)
    text = re.sub(r"\W", "_", base, flags=re.ASCII) + ("_" + "d" * primes if primes else "")
    return f"_{text}" if not re.match(r"[A-Za-z_]", text) or text in _C_WORDS else text
