"""What the other rows of a table say about the headline pair: far better rows, an exact model that is no bound, unequal rates.

Rows are compared by their relative error, the rms over the coordinates that the adaptive controller's cost weighs of rms error over
scale (see `changes`), or by the figure that the problem is judged by. Two rows with the same rate and the same information are at
parity within a factor of two.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from fpirhc.plant.motion import with_space
from fpirhc.review.questions.margins import SLOWER
from fpirhc.studies.comparison.changes import HELPS, HURTS, ROUNDING, Change, times
from fpirhc.studies.comparison.outcome import Finding, Outcome
from fpirhc.summary import written_out

if TYPE_CHECKING:
    from fpirhc.studies.comparison.entry import Entry
    from fpirhc.studies.tuning.objective import Objective

FAR = 2.0  # times a smaller error, from which another row is far better


def remarks(
    entries: Sequence[Entry],
    pair: tuple[Entry, Entry] | None,
    scales: Mapping[str, float],
    figure: Objective | None = None,
) -> list[Finding]:
    """Return the remarks about the first pair; none without a pair that finished."""
    if figure is not None and figure.metric is not None:
        told = _best_by(entries, pair, figure)
    else:
        told = [*_worse_learners(entries, scales), *_far_better(entries, pair, scales), *_no_bound(entries, scales)]
    return [Finding(text) for text in (*told, *_rates(entries))]


def _best_by(entries: Sequence[Entry], pair: tuple[Entry, Entry] | None, figure: Objective) -> list[str]:
    """The row beside the pair that is clearly better by the figure: an error is then no measure, and an exact model no bound."""
    values = {e.name: figure.of(e.metrics) if e.run.stop is None else math.inf for e in (*entries, *(pair or ()))}
    others = [e.name for e in entries if pair is not None and e not in pair and not e.exact]
    name = min(others, key=values.__getitem__, default=None)
    if pair is None or name is None:
        return []
    ahead, best = min(values[e.name] for e in pair), values[name]
    outcome = Change(figure.name, abs(ahead), abs(best)).outcome
    if not best < ahead or (math.isfinite(ahead) and ahead * best > 0 and outcome is Outcome.NO_DIFFERENCE):
        return []
    both = ", ".join(f"{e.name} {figure.text(values[e.name])}" for e in pair)
    return [f"By {figure.noun} {name} is better than this pair: {figure.text(best)} ({both})."]


def relative_error(entry: Entry, scales: Mapping[str, float], weighed: frozenset[str] | None) -> float:
    """The relative error of an entry; infinite for a run that ended early."""
    errors = entry.metrics.rms_error
    shares = [errors[n] / scales.get(n, 1.0) for n in _counted(entry, weighed)]
    if entry.run.stop is not None or not shares or not all(map(math.isfinite, shares)):
        return math.inf
    return math.sqrt(math.fsum(s * s for s in shares) / len(shares))


def _said(entry: Entry, scales: Mapping[str, float], weighed: frozenset[str] | None) -> str:
    """The error by which rows are compared, with its name: that of one coordinate in its unit, of several over their ranges."""
    names = _counted(entry, weighed)
    noun = f"an rms error of {names[0]} of" if len(names) == 1 else "a relative error, rms over range, of"
    return f"{noun} {_size(entry, scales, weighed)}"


def _size(entry: Entry, scales: Mapping[str, float], weighed: frozenset[str] | None) -> str:
    names = _counted(entry, weighed)
    if len(names) > 1:
        return written_out(relative_error(entry, scales, weighed))
    return f"{written_out(entry.metrics.rms_error[names[0]])}{with_space(entry.run.unit(f'error.{names[0]}'))}"


def _counted(entry: Entry, weighed: frozenset[str] | None) -> list[str]:
    errors = entry.metrics.rms_error
    return [n for n in errors if weighed is None or n in weighed] or list(errors)


def _far_better(entries: Sequence[Entry], pair: tuple[Entry, Entry] | None, scales: Mapping[str, float]) -> list[str]:
    if pair is None:
        return []
    weighed = pair[1].weighed
    error = {e.name: relative_error(e, scales, weighed) for e in (*entries, *pair)}
    ahead = min(pair, key=lambda e: error[e.name])
    others = [e for e in entries if e not in pair and not e.exact]
    best = min(others, key=lambda e: error[e.name], default=None)
    if best is None or not math.isfinite(error[best.name]) or error[ahead.name] < ROUNDING:
        return []
    if math.isinf(error[ahead.name]):
        return [f"{best.name} finishes its run, with {_said(best, scales, weighed)}."]
    ratio = error[ahead.name] / max(error[best.name], ROUNDING)
    if ratio < FAR:
        return []
    both = " and ".join(f"{e.name} {_size(e, scales, weighed)}" for e in pair)
    return [
        f"{best.name} is far better than this pair: it has {_said(best, scales, weighed)} ({both}), {times(ratio)} "
        f"smaller than that of {ahead.name}."
    ]


def _worse_learners(entries: Sequence[Entry], scales: Mapping[str, float]) -> list[str]:
    """A sentence for every learner that does worse than the same controller with its fixed model."""
    by_name, sentences = {e.name: e for e in entries}, []
    for one in entries:
        fixed = by_name.get(one.fixed or "")
        if fixed is None:
            continue
        error, before = (relative_error(e, scales, one.weighed) for e in (one, fixed))
        if error <= HURTS * before or error < ROUNDING:
            continue
        more = f" ({times(error / before)} more)" if before > 0 and math.isfinite(error) else ""
        end = "it does not finish" if one.run.stop is not None else f"it has {_said(one, scales, one.weighed)}{more}"
        much = _size(fixed, scales, one.weighed)
        sentences.append(
            f"{one.name} does worse than {fixed.name}, whose model does not change ({much}): {end}. {SLOWER}"
        )
    return sentences


def beaten_by(exact: Entry, entries: Sequence[Entry], scales: Mapping[str, float]) -> str | None:
    """The adapted row that is clearly better than this row with the exact model; None where there is none."""
    errors = {e.name: relative_error(e, scales, exact.weighed) for e in entries if e.adaptive or e.learns}
    bound = relative_error(exact, scales, exact.weighed)
    name = min(errors, key=lambda n: errors[n], default=None)
    return name if name is not None and bound > ROUNDING and errors[name] < HELPS * bound else None


def _no_bound(entries: Sequence[Entry], scales: Mapping[str, float]) -> list[str]:
    """A sentence for every exact model that is worse than an adapted row."""
    by_name, sentences = {e.name: e for e in entries}, []
    for exact in (e for e in entries if e.exact):
        name = beaten_by(exact, entries, scales)
        if name is None:
            continue
        why = "; ".join(exact.no_bound) or "not known"
        sentences.append(
            f"{exact.name} is no bound here: it has {_said(exact, scales, exact.weighed)}, {name} "
            f"{_size(by_name[name], scales, exact.weighed)}. Why: {why}."
        )
    return sentences


def _rates(entries: Sequence[Entry]) -> list[str]:
    """Adaptation acts in every cycle; what is learned for a plan acts when a plan is made."""
    planners = [e for e in entries if e.plan_every > 1]
    every_cycle = [e.name for e in planners if e.adaptive and not e.learns]
    every_plan = [
        e.name for e in planners if e.learns and not e.adaptive and (e.information is None or e.information.waits)
    ]
    if not every_cycle or not every_plan:
        return []
    stride = planners[0].plan_every
    return [
        f"Rates: {_both(every_cycle)} in every cycle, {' and '.join(every_plan)} only at every plan, that is every "
        f"{stride} cycles. A part of their difference is an effect of the rate; a period as long as a stage gives both the same "
        "rate."
    ]


def _both(names: Sequence[str]) -> str:
    return f"{' and '.join(names)} correct{'s' if len(names) == 1 else ''}"
