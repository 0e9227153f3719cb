"""The null test: with the approximate model as plant there is nothing to adapt, so adaptation must not make the error larger.

Theory: docs/theory-questions.md.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field

from fpirhc.by_name import FoundByName
from fpirhc.plant.motion import followed_units, with_space
from fpirhc.simulation.metrics.entries.commands import at_limit
from fpirhc.simulation.model_as_plant import ModelAsPlant
from fpirhc.simulation.simulate import Simulator
from fpirhc.simulation.trials import MOSTLY, SLIGHT, errors_of
from fpirhc.studies.comparison.changes import ROUNDING, Change, major, outcome_of
from fpirhc.studies.comparison.outcome import Outcome
from fpirhc.summary import in_percent, numbers_written_out
from fpirhc.task.problem import Problem

_LARGER = (Outcome.WORSE, Outcome.MIXED)


@dataclass(frozen=True)
class NullTest(FoundByName):
    """The result of a null test.

    Args:
        pair: names of the controllers without and with adaptation.
        before: rms error without adaptation, by judged coordinate; NaN for a run that ended early.
        after: rms error with adaptation.
        outcome: what adaptation does where there is nothing to adapt.
        harmful: whether it then makes an error that is larger than that of the wrong model without adaptation.
        text: the result in a sentence.
        cycles: of one run.
        elapsed: wall time of both runs, s.
    """

    pair: tuple[str, str]
    before: Mapping[str, float]
    after: Mapping[str, float]
    outcome: Outcome
    harmful: bool
    text: str
    cycles: int
    elapsed: float = field(default=0.0, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "text", numbers_written_out(self.text))
        super().__post_init__()

    @property
    def passed(self) -> bool:
        """Whether adaptation is not worse where there is nothing to adapt."""
        return self.outcome in (Outcome.BETTER, Outcome.NO_DIFFERENCE)


def null_test(
    model: ModelAsPlant,
    loops: tuple[Simulator, Simulator],
    names: tuple[str, str],
    scales: Mapping[str, float],
    weighed: frozenset[str] | None = None,
    *,
    cured: Mapping[str, float],
) -> NullTest:
    """Return what adaptation does on the approximate model as plant.

    Args:
        model: as plant.
        loops: without and with adaptation.
        names: of both controllers.
        scales: by which errors are judged, by coordinate.
        weighed: coordinates that are judged; None: all.
        cured: rms error on the plant itself without adaptation, by judged coordinate.
    """
    begin = time.perf_counter()
    null, runs = model.pair(loops)
    pair = errors_of(null, runs)
    before, after = (_or_nan(errors) for errors in (pair.without, pair.adapted))
    slight = {name: SLIGHT * size for name, size in pair.ranges.items()}
    stuck = {n: at_limit(null, run) for n, run in zip(names, runs, strict=True)}
    if stuck[names[0]] >= MOSTLY:
        text = _not_informative(stuck)
        return NullTest(
            names, before, after, Outcome.NOT_COMPARABLE, False, text, null.cycles, time.perf_counter() - begin
        )
    changes = {n: Change(n, before[n], after[n], scales.get(n, 1.0)) for n in before if weighed is None or n in weighed}
    outcome = _outcome(changes)
    harmful = _harmful(outcome, changes, cured, slight)
    small = (
        ""
        if harmful or outcome not in _LARGER
        else _smallness(names[0], null, {n: cured[n] for n in changes}, _harmful(outcome, changes, cured, {}))
    )
    text = _sentence(names, outcome, changes, null, small)
    return NullTest(names, before, after, outcome, harmful, text, null.cycles, time.perf_counter() - begin)


def _not_informative(stuck: Mapping[str, float]) -> str:
    names = ", ".join(f"that of {name} in {in_percent(share)}" for name, share in stuck.items())
    return f"Null test: not informative, the command stands at a limit in most cycles ({names}), where no adaptation can act."


def _or_nan(errors: Mapping[str, float]) -> dict[str, float]:
    """Errors by coordinate, NaN where a run ended early or has diverged."""
    return {name: size if math.isfinite(size) else math.nan for name, size in errors.items()}


def _outcome(changes: Mapping[str, Change]) -> Outcome:
    lost = [c for c in changes.values() if math.isnan(c.after)]
    if any(math.isnan(c.before) for c in changes.values()) or not changes:
        return Outcome.NOT_COMPARABLE
    return Outcome.WORSE if lost else outcome_of(major(changes))


def _harmful(
    outcome: Outcome, changes: Mapping[str, Change], cured: Mapping[str, float], slight: Mapping[str, float]
) -> bool:
    """Whether an error is larger than the wrong model makes without adaptation, by more than is slight for the coordinate."""
    if outcome not in _LARGER:
        return False
    worse = [c for c in major(changes).values() if c.outcome is Outcome.WORSE] or changes.values()
    return any(not (c.after <= cured[c.name] or c.after - c.before <= slight.get(c.name, 0.0)) for c in worse)


def _smallness(plain: str, null: Problem, cured: Mapping[str, float], larger: bool) -> str:
    """What an error that does no harm is small against."""
    if larger:
        return f"it adds less than {in_percent(SLIGHT)} of the range of the run"
    units = followed_units(null.plant)
    costs = ", ".join(f"{n} {size:.3g}{with_space(units[n])}" for n, size in cured.items())
    return f"it is smaller than that of {plain} with the wrong model ({costs})"


def _sentence(
    names: tuple[str, str], outcome: Outcome, changes: Mapping[str, Change], null: Problem, small: str
) -> str:
    plain, adaptive = names
    head = "Null test (the approximate model as plant"
    head += ", no disturbance): " if null.disturbances else "): "
    if outcome is Outcome.NOT_COMPARABLE:
        return f"{head}{plain} does not finish there, so nothing is shown."
    if any(math.isnan(c.after) for c in changes.values()):
        return f"{head}failed, {adaptive} does not finish where {plain} does, with nothing to adapt."
    shown = sorted(changes.values(), key=lambda c: -c.ratio if c.ratio == c.ratio else 0.0)
    units = {name: with_space(unit) for name, unit in followed_units(null.plant).items()}
    numbers = ", ".join(f"{c.name} {c.before:.3g} -> {c.after:.3g}{units[c.name]}" for c in shown)
    if outcome in (Outcome.BETTER, Outcome.NO_DIFFERENCE):
        tiny = all(c.size < ROUNDING for c in changes.values())
        return f"{head}passed, {adaptive} is not worse than {plain} ({'rounding only' if tiny else numbers})."
    if small:
        return f"{head}{adaptive} makes a small error of its own ({numbers}); {small}."
    return (
        f"{head}failed, {adaptive} is worse than {plain} although there is nothing to adapt ({numbers}). Its gain, or the "
        "largest step of its map, is too small for its law or its plan, or it takes something else for an error of the model: the "
        "drift of the response within a long cycle, an unpaired delay, or noise. fpirhc review says more."
    )
