"""An answer where nothing else gives one: two runs on the plant decide, without adaptation and with it."""

from __future__ import annotations

import math
from collections.abc import Iterable

from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.prediction import TRIED
from fpirhc.review.question import SEE_CONVERGENCE, Case
from fpirhc.simulation.trials import ErrorPair

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
