"""The contract of a question about a problem or a controller, and of its answer: a file of the folder `questions` adds one.

A file defines `QUESTIONS`, values of `ProblemQuestion` and `ControllerQuestion`. Another package names one of them in an entry
point of the group `fpirhc.questions`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cache, cached_property
from importlib.metadata import entry_points
from typing import TypeVar, cast

import numpy as np

from fpirhc.contraction.spectrum import Spectrum
from fpirhc.controllers.base import Controller
from fpirhc.controllers.check import any_gain
from fpirhc.controllers.contract import given_response
from fpirhc.controllers.sensing_chain import compose_controller, dependencies_of_command
from fpirhc.deformation.base import Deformation
from fpirhc.errors import FpirhcError, InvalidValue
from fpirhc.fields.checked import FoundByName
from fpirhc.members import within
from fpirhc.plant.chain import measured_signals
from fpirhc.review.grid import ReviewGrid
from fpirhc.review.loops import Loops, LoopsByGain, is_planned, loops_along, loops_by_gain, spectrum_near
from fpirhc.review.prediction import TRIED, NominalRun, NominalRuns
from fpirhc.simulation.trials import ErrorPair, harm_in
from fpirhc.summary import line, numbers_written_out, table
from fpirhc.symbolic.evaluate import attempted
from fpirhc.task.problem import Problem


class Verdict(StrEnum):
    """The verdict of an answer; yes is good in every question.

    Caution is known as well as yes and no: less than is wished for, and no reason to stop.
    """

    YES = "yes"
    CAUTION = "caution"
    NO = "no"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class Answer(FoundByName):
    """The answer to one question.

    Args:
        question: in the words of a reader.
        verdict: yes, caution, no, unknown.
        evidence: the facts in a sentence, with the deciding number and its unit.
        change: what to change; after a yes nothing.
        numbers: the same facts by name.
    """

    question: str
    verdict: Verdict
    evidence: str
    change: str = ""
    numbers: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        change = "" if self.verdict == Verdict.YES else self.change
        object.__setattr__(self, "evidence", numbers_written_out(self.evidence))
        object.__setattr__(self, "change", numbers_written_out(change))
        super().__post_init__()

    @property
    def advice(self) -> str:
        """What to do, in one line; the facts before it where it points at them or at other answers."""
        points = not self.change or self.change.startswith("See ")
        return " ".join(f"{f'{self.evidence}. ' if points else ''}{self.change}".split())


@dataclass(frozen=True)
class Review(FoundByName):
    """All answers about a problem and its controllers.

    Args:
        problem: answers about the problem.
        controllers: answers about each controller, by name.
        mismatch: range of the exact parameters, percent, see `fpirhc.plant.plant`.
    """

    problem: tuple[Answer, ...]
    controllers: Mapping[str, tuple[Answer, ...]]
    mismatch: float

    def __repr__(self) -> str:
        return line(self, "ready" if self.ready else "not ready", self._counts(), f"mismatch {self.mismatch:g} %")

    def _repr_html_(self) -> str:
        """All answers as a table, for notebooks; those that are no come first."""
        groups = [("problem", self.problem), *self.controllers.items()]
        rows = [(name, a.question, str(a.verdict), a.evidence, a.change) for name, group in groups for a in group]
        rows.sort(key=lambda row: row[2] != Verdict.NO)
        title = f"Review: {'ready' if self.ready else 'not ready'}"
        return table(title, ("about", "question", "answer", "facts", "what to change"), rows, [self._counts()])

    def _counts(self) -> str:
        return ", ".join(f"{sum(a.verdict == v for a in self.answers)} {v}" for v in Verdict)

    @property
    def answers(self) -> tuple[Answer, ...]:
        """All answers, the problem's first."""
        return (*self.problem, *(a for group in self.controllers.values() for a in group))

    @property
    def to_do(self) -> tuple[tuple[str, Answer], ...]:
        """The answers that are no, each with what it is about: 'problem', or the name of a controller."""
        groups = [("problem", self.problem), *self.controllers.items()]
        return tuple((about, a) for about, group in groups for a in group if a.verdict == Verdict.NO)

    @property
    def ready(self) -> bool:
        """Whether no answer is no."""
        return not self.to_do


def decided(good: bool) -> Verdict:
    """Return yes where the condition holds, else no."""
    return Verdict.YES if good else Verdict.NO


def graded(share: float, wanted: float) -> Verdict:
    """Return yes for a share of at least what is wanted, no below 1, and caution between."""
    return Verdict.YES if share >= wanted else Verdict.NO if share < 1 else Verdict.CAUTION


def per_cycle(pole: float, problem: Problem) -> str:
    """Return 'is multiplied by 0.976 per cycle (time constant 41 ms)'; without the time where the mode does not decay."""
    text = f"is multiplied by {pole:.6g} per cycle"
    return f"{text} (time constant {duration(-problem.period / math.log(pole), problem)})" if 0 < pole < 1 else text


def duration(time: float, problem: Problem) -> str:
    """Return a time in the problem's unit; a time of less than a second in ms or us."""
    unit = problem.time_unit
    if unit != "s" or not 0 < time < 1:
        return f"{time:.3g} {unit}"
    return f"{1e3 * time:.3g} ms" if time >= 1e-3 else f"{1e6 * time:.3g} us"


GROUP = "fpirhc.questions"  # of entry points

Kind = TypeVar("Kind", "ProblemQuestion", "ControllerQuestion")


SEE_CONVERGENCE = "See the convergence of the deformation."


@dataclass(frozen=True, eq=False)
class Case:
    """What is known when a question about a controller is asked; what takes time is computed once, when it is first read.

    Args:
        grid: points of the reference and draws of the parameters.
        controller: the controller, with its automatic settings chosen.
        runs: the models' own runs of this review.
        general: answers about the problem.
    """

    grid: ReviewGrid
    controller: Controller
    runs: NominalRuns
    general: tuple[Answer, ...] = ()

    @property
    def problem(self) -> Problem:
        """The problem."""
        return self.grid.problem

    @cached_property
    def believed(self) -> np.ndarray:
        """Parameters of the model, shape (np,)."""
        return self.controller.plant_model(self.problem).parameters(self.problem.plant)

    @cached_property
    def feeds_back(self) -> bool:
        """Whether what is measured changes the command; a plan restarts from it, and is not composed for this question."""
        if is_planned(self.controller):
            return True
        response = given_response(self.problem, self.controller)
        measured = {one.name for one in measured_signals(self.problem.plant)}
        measured.add(response.signal.name if response else "realised")
        with any_gain():
            step = compose_controller(self.problem, self.controller)
        return bool(measured & dependencies_of_command(step))

    def spectrum(self, draws: np.ndarray) -> Spectrum:
        """Return the eigenvalues of the weighted response Jacobian along the reference, for draws of the grid.

        Raises:
            InvalidValue: none is finite.
        """
        return spectrum_near(self.grid, self.believed, draws, self.controller.deformation.iteration, near=False)

    @cached_property
    def spectra(self) -> tuple[Spectrum, Spectrum] | None:
        """Eigenvalues of the response Jacobian along the reference and over the box; None where none is finite."""
        try:
            own, boxed = (self.spectrum(draws) for draws in (self.grid.draws[:1], self.grid.draws))
        except InvalidValue:
            return None
        return own, boxed

    @cached_property
    def loops(self) -> Loops:
        """Its linear loops along the reference."""
        return loops_along(self.grid, self.controller)

    @property
    def diverges(self) -> bool:
        """Whether no linear loop along the reference converges with the deformation as it is, for as long as nothing is learned."""
        return bool(self.loops.loops) and float(self.loops.radii.min()) >= 1 and not self.loops.learns

    @cached_property
    def by_gain(self) -> LoopsByGain | None:
        """The linear loops for every gain of the map; None where they are not known."""
        return loops_by_gain(self.grid, self.controller, self.loops)

    @cached_property
    def _tried(self) -> dict[str, tuple[ErrorPair | None, ErrorPair] | str]:
        return {}

    def trial(self, deformation: Deformation) -> tuple[ErrorPair | None, ErrorPair] | str:
        """Return the errors with a deformation on the plant (None: it is outside) and on the model, or why there are none."""
        name = repr(deformation)
        if name not in self._tried:
            try:
                controller = self.controller.with_deformation(deformation)
                trials = self.runs.trials(self.grid.real or self.problem, self.controller)
                real, null = trials.errors(controller)
                self._tried[name] = (None if self.grid.outside else real), null
            except FpirhcError as error:
                self._tried[name] = f"it cannot be tried ({error})"
        return self._tried[name]

    def counted(self, deformation: Deformation) -> ErrorPair | None:
        """Return the errors with a deformation on the plant where errors count; None where the run of `trial` shows them."""
        trials = self.runs.trials(self.grid.real or self.problem, self.controller)
        return None if self.grid.outside else trials.counted(self.controller.with_deformation(deformation))

    def harm(self, deformation: Deformation) -> str:
        """Return what runs on the plant and on the model show against a deformation, in a sentence; empty where it does no harm.

        The exact parameters are those of the problem, so a form or a gain is proposed only after a run with the wrong model.
        """
        trial = self.trial(deformation)
        return trial if isinstance(trial, str) else harm_in(*trial)

    def lowers(self, deformation: Deformation) -> bool:
        """Whether runs on plant and model show no harm of a deformation, and that on the plant no larger error, however small."""
        trial = self.trial(deformation)
        return not self.harm(deformation) and (isinstance(trial, str) or trial[0] is None or trial[0].lowers)

    @cached_property
    def _answers(self) -> dict[ControllerQuestion, Answer | None]:
        return {}

    def answer(self, question: ControllerQuestion) -> Answer | None:
        """Return the answer to a question, asked once; None where it has no meaning for the controller."""
        if question not in self._answers:
            self._answers[question] = asked(question, self) if question.concerns(self.controller) else None
        return self._answers[question]

    @property
    def doubts(self) -> list[str]:
        """Reasons against convergence: answers that are no, about the problem and to questions that may doubt it."""
        own = [self.answer(question) for question in known_questions(ControllerQuestion) if question.doubts]
        every = [*self.general, *(a for a in own if a is not None)]
        return [f"'{a.question}' is answered no" for a in every if a.verdict == Verdict.NO]

    @cached_property
    def nominal(self) -> NominalRun | str:
        """The model's own run over at most `prediction.CYCLES` cycles, or the reason why there is none."""
        return self.runs.of(self.controller)


@dataclass(frozen=True, eq=False)
class ProblemQuestion:
    """A question about a problem.

    Args:
        ask: the answer from the points of the reference; None where the question has no meaning for the problem.
        text: the question in the words of a reader, for an answer that cannot be found.
        order: place among the questions; the built-in ones come first.
        doubts: whether the verdict alone needs its answer.
    """

    ask: Callable[[ReviewGrid], Answer | None]
    text: str = ""
    order: int = 100
    doubts: bool = False


@dataclass(frozen=True, eq=False)
class ControllerQuestion:
    """A question about a controller on a problem.

    Args:
        ask: the answer; None where the question has no meaning for the controller.
        text: the question in the words of a reader, for an answer that cannot be found.
        order: place among the questions; the built-in ones come first.
        adaptive: whether it is asked about controllers with a deformation alone.
        doubts: whether a no makes it unknown that the deformation converges.
        of_targets: whether it is also asked where the deformation acts on the target of an inner controller.
    """

    ask: Callable[[Case], Answer | None]
    text: str = ""
    order: int = 100
    adaptive: bool = True
    doubts: bool = False
    of_targets: bool = False

    def concerns(self, controller: Controller) -> bool:
        """Return whether the question is asked about a controller."""
        adapts = controller.deformation.adapts
        return not self.adaptive or (adapts and (self.of_targets or controller.deforms != "target"))


def asked(question: ProblemQuestion | ControllerQuestion, about: ReviewGrid | Case) -> Answer | None:
    """Return the answer to a question; unknown where asking it breaks."""
    broken: list[str] = []
    answer = attempted("the answer", cast("Callable[..., Answer | None]", question.ask), about, broken=broken)
    if not broken:
        return answer
    name = getattr(question.ask, "__name__", type(question.ask).__name__).strip("_").replace("_", " ")
    return Answer(question.text or f"{name.capitalize()}?", Verdict.UNKNOWN, broken[0])


@cache
def known_questions(kind: type[Kind]) -> tuple[Kind, ...]:
    """Return the questions of one kind in their order, those of installed packages included."""
    known = [question for module in within("fpirhc.review.questions") for question in module.QUESTIONS]
    known += [point.load() for point in entry_points(group=GROUP)]
    return tuple(sorted((q for q in known if type(q) is kind), key=lambda q: q.order))


_LEAVE = "Lower the gain, use another form, or leave the deformation out."
_FREE = "Run it where the commands are free."
_ENDS = "Find out why the run ends early."


def judged(good: bool, pairs: Iterable[ErrorPair], *, spared: bool) -> Verdict:
    """Return the verdict that runs give: no where adaptation makes one clearly worse, unless that is no reason.

    Args:
        good: whether the answer is yes.
        pairs: errors without adaptation and with it.
        spared: whether a larger error is no reason for a no: the controller may still learn, or the error cures a larger one.
    """
    if good:
        return Verdict.YES
    return Verdict.NO if not spared and any(pair.fails for pair in pairs) else Verdict.CAUTION


def by_run(case: Case, question: str, reason: str) -> Answer:
    """Return the answer to a question whose yes is a smaller tracking error with adaptation.

    A no is a clearly larger error. A controller that learns may still learn, so its short run is no reason for a no; that it does
    not pay is one only where the run is the whole one.
    """
    trial = case.trial(case.controller.deformation)
    pair = None if isinstance(trial, str) else trial[0]
    if pair is None:
        why = trial if isinstance(trial, str) else "the plant is outside"
        return Answer(question, Verdict.UNKNOWN, f"{reason}; and no run, because {why}")
    whole, learns = case.problem.cycles <= TRIED, case.controller.learns
    numbers = {"without": pair.without[pair.worst], "with": pair.adapted[pair.worst]}
    text = f"in {'the whole run' if whole else f'a run of at most {TRIED} cycles'} {pair.sentence} ({reason})"
    if pair.stuck:
        return Answer(question, Verdict.UNKNOWN, f"{text}; {pair.stuck}", _FREE, numbers)
    verdict = judged(pair.lower, (pair,), spared=learns and not whole)
    if verdict == Verdict.YES:
        return Answer(question, verdict, text, "", numbers)
    if verdict == Verdict.NO:
        return Answer(question, verdict, text, SEE_CONVERGENCE if case.diverges else _LEAVE, numbers)
    if not all(map(math.isfinite, pair.adapted.values())):
        return Answer(question, Verdict.UNKNOWN, text, _ENDS, numbers)
    change = "Compare it over several scenarios." if whole else "Run it for longer and compare."
    return Answer(question, verdict if whole else Verdict.UNKNOWN, text, change, numbers)
