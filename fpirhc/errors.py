"""Misuse raises one of these; a bad outcome of a run is data, not an exception.

Every message states what is wrong, where, what was expected, and how to mend it. `Mistakes` collects all mistakes of a value,
so that a user sees them together.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from typing import Any, Never


class FpirhcError(Exception):
    """Base of all errors that fpirhc raises on purpose."""


class HarmfulAdaptation(UserWarning):
    """A controller runs better without its adaptation; no error, because what is built runs as it was asked for."""


class InvalidName(FpirhcError, AttributeError, KeyError):
    """A name that does not exist; the nearest valid one is offered."""

    def __str__(self) -> str:
        return str(self.args[0]) if self.args else ""


class InvalidValue(FpirhcError, ValueError):
    """A number or value outside its allowed range, or a vector or matrix of the wrong size."""


class InvalidProblem(FpirhcError, ValueError):
    """One or more mistakes in a plant, a problem or a controller, listed together."""


class InvalidField(InvalidValue, InvalidProblem, TypeError):
    """One or more arguments of a value that are unknown, missing, of a wrong type or out of range.

    Args:
        mistakes: each as one sentence.
        place: file and line of the user's call; empty where it is not known.
    """

    def __init__(self, mistakes: Sequence[str], place: str = "") -> None:
        super().__init__(tuple(mistakes), place)
        self.mistakes, self.place = tuple(mistakes), place

    def __str__(self) -> str:
        return _told(self.mistakes, self.place)


class ProblemFileError(FpirhcError):
    """A problem file that cannot be found, imported, or understood."""


class NotContractive(FpirhcError, ValueError):
    """The fixed-point iteration does not converge with this gain, or with any gain.

    Args:
        fault: what is wrong.
        remedy: what the iteration by itself would bear, such as "use 0 < |gain| < 0.4"; empty where nothing is known.
        turned: parameters whose values in the plant and in the model differ in sign, where the sign is wrong by them.
    """

    def __init__(self, fault: str, remedy: str = "", turned: Sequence[str] = ()) -> None:
        super().__init__(fault, remedy, turned)
        self.fault, self.remedy, self.turned = fault, remedy, turned

    def __str__(self) -> str:
        return f"{self.fault}; {self.remedy}" if self.remedy else self.fault


class NotSupported(FpirhcError, ValueError):
    """A valid setting that this member of a family cannot serve; the message names a member that can."""


def require(condition: object, refusal: str) -> None:
    """Raise NotSupported with the sentence, which says what to do instead, unless the condition holds."""
    if not condition:
        raise NotSupported(refusal)


def refuse(reasons: Iterable[str]) -> None:
    """Raise NotSupported with the first reason, where there is one."""
    for reason in reasons:
        require(False, reason)


class NoCode(NotSupported):
    """A Function that cannot be written as C; it runs in CasADi's virtual machine."""


class NotInstalled(NotSupported):
    """A package or a compiler that is not installed, or too old."""


def package(name: str, extra: str, what: str = "this") -> Any:
    """Import a package of an extra."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as missing:
        raise NotInstalled(f"{what} needs {missing.name}, not installed here: pip install 'fpirhc[{extra}]'") from None


class ConcurrentUse(FpirhcError, RuntimeError):
    """A value that serves one thread, used by two at the same time."""


class WorkerDied(FpirhcError, RuntimeError):
    """A process of a study was killed; what is finished is kept."""


class OutputError(FpirhcError, OSError):
    """A file or folder that cannot be written or read."""


@contextmanager
def writing(place: object, option: str) -> Iterator[None]:
    """Raise OutputError where a folder or file for results cannot be written, with the option that chooses another one."""
    try:
        yield
    except OSError as error:
        why = "it is a file" if isinstance(error, FileExistsError | NotADirectoryError) else error.strerror
        raise OutputError(f"cannot write to the folder '{place}': {why}; choose another with {option}") from None


class CompileError(FpirhcError, RuntimeError):
    """The C compiler failed on generated code."""


def nearest(name: object, valid: Iterable[str]) -> str:
    """Return ' Did you mean ...? Valid: ...', the end of a message about an unknown `name`, which may be no text.

    The nearest name is also found by what other tools call it: angle' by angle_dot, angle_rate, angle_velocity, dangle, velocity.
    Of a long list the nearest names are shown.
    """
    names = [str(one) or "''" for one in valid]
    if not names:
        return " No names are valid here."
    near = _near(name, names) if isinstance(name, str) else []
    quote = '"' if near and "'" in near[0] else "'"
    hint = f" Did you mean {quote}{near[0]}{quote}?" if near else ""
    if len(names) <= _MANY:
        return f"{hint} Valid: {listed(names)}."
    shown = get_close_matches(str(name), names, n=_SHOWN, cutoff=0)
    return f"{hint} Valid: {listed(shown)} and {len(names) - len(shown)} more."


def without(module: str, valid: Sequence[str]) -> Callable[[str], Never]:
    """Return the `__getattr__` of a module of public names: it raises InvalidName with the nearest one."""

    def missing(name: str) -> Never:
        if name.startswith("_"):  # tools ask whatever they meet for such names
            raise AttributeError(f"module '{module}' has no attribute '{name}'")
        raise InvalidName(f"{module} has no name '{name}'.{nearest(name, valid)}")

    return missing


def listed(names: Sequence[str]) -> str:
    """The names of a list, in quotes where a comma inside one would part it."""
    return ", ".join(f"'{one}'" for one in names) if any("," in one for one in names) else ", ".join(names)


def _near(name: str, names: Sequence[str]) -> list[str]:
    """Valid names that may be meant, the likeliest first."""
    ours = (line.split() for line in _OF_OTHER_TOOLS.strip().splitlines())
    elsewhere = [own[:-1] for own, *theirs in ours if name in theirs and own[:-1] in names]
    for primes in _DERIVATIVES:
        if (of := derivative_of(name, primes)) is not None:
            meant = [(of or one.rstrip("'")) + primes for one in names]
            elsewhere += [one for one, own in zip(names, meant, strict=True) if one == own or one.endswith(f".{own}")]
    same = [one for one in names if one.casefold() == name.casefold()]
    inside = [one for one in names if name[1:] and name.casefold() in one.casefold()]  # a letter is a part of too many
    return [*elsewhere, *same, *get_close_matches(name, names, n=1, cutoff=0.5), *inside]


def derivative_of(name: str, primes: str = "'") -> str | None:
    """Return what a name is a derivative of, by the spellings of others, '' where it does not say; None where it is none."""
    found = re.fullmatch(_DERIVATIVES[primes], name, re.IGNORECASE)
    return found and "".join(filter(None, found.groups()))


_MANY, _SHOWN = 40, 8  # names beyond which a list is cut, and to how many
_DERIVATIVES = {  # how others write them
    "''": r"(.+?)_?ddot|(.+)_acc\w*|(?:dd_?|d2_?|acc\w*_)(.+)|acc\w*",
    "'": r"(.+?)_?dot|(.+)_(?:rate|vel\w*|speed)|(?:d_?|vel\w*_|speed_|rate_|v_)(.+)|vel\w*|speed|rate",
}

_OF_OTHER_TOOLS = """
RecedingHorizon: MPC NMPC OptimalControlProblem AcadosOcp
Plant: Model System nlsys
period: dt Ts ts sample_time
step: dt Ts ts sample_time t_step
duration: T tf t_end t_final sim_time
stages: N n_horizon N_horizon prediction_horizon
iterations: max_iter maxiter max_iterations nlp_solver_max_iter
inputs: lbu ubu u_min u_max umin umax bounds
states: lbx ubx x_min x_max Q
reference: ref x_ref y_ref yref setpoint trajectory
cost: objective lterm stage_cost
response: rhs f_expl_expr updfcn dynamics
rates: rhs f_expl_expr updfcn dynamics
parameters: p params parameter_values
proportional: Kp kp
integral: Ki ki
derivative: Kd kd
terminal: P Qf mterm
dead_time: delay input_delay
start: x0
effort: R
rate: rterm
approximate: nominal
"""  # our name, and what do-mpc, acados, python-control and Simulink call the same


class Mistakes(list[str]):
    """Collects the mistakes of one value and raises them together."""

    def __init__(self, where: str) -> None:
        super().__init__()
        self._where = where

    add, join = list.append, list.extend

    @contextmanager
    def caught(self, where: str = "") -> Iterator[None]:
        """Add the error with which the body ends, if it does, behind the words `where`."""
        try:
            yield
        except FpirhcError as error:
            self.add(f"{where}{error}")

    def unknown(self, what: str, names: Iterable[str], valid: Iterable[str]) -> None:
        """Add a mistake, with the nearest valid name, for each of `names` that is not in `valid`."""
        allowed = list(valid)
        for name in names:
            if name not in allowed:
                self.add(f"{what} '{name}' is unknown.{nearest(str(name), allowed)}")

    def raise_if_any(self) -> None:
        """Raise InvalidProblem with all mistakes, if there is one."""
        if self:
            raise InvalidProblem(_told(self, self._where))


def _told(mistakes: Sequence[str], where: str) -> str:
    """One mistake as it is, several as a list, behind the words where they are."""
    lines = mistakes[0] if len(mistakes) == 1 else "\n".join(f"  {k}. {m}" for k, m in enumerate(mistakes, 1))
    lead = f"{len(mistakes)} mistakes\n" if len(mistakes) > 1 else ""
    return f"{where}: {lead}{lines}" if where else lines
