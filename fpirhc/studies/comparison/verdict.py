"""The verdict: the effect of adaptation in sentences, with the reasons where there is none, and what other rows say of the pair.

Every claim is computed from the entries, and every sentence about a pair carries its outcome. Rows are compared by the rms over
coordinates of error over scale (see `changes`), or by the figure that the problem is judged by; two with the same rate and
information are at parity within a factor of two.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from fpirhc.plant.motion import with_space
from fpirhc.review.questions.margins import SLOWER
from fpirhc.studies.comparison.causes import (
    Yardstick,
    causes,
    caveats,
    effort_cause,
    grows_alone,
    leaves_reference,
    left_alone_is_better,
    movement,
    not_followed,
    start_counts,
    stuck_cause,
)
from fpirhc.studies.comparison.changes import HELPS, HURTS, ROUNDING, Change, Finding, Outcome, major, outcome_of, times
from fpirhc.studies.objective import Objective
from fpirhc.summary import written_out

if TYPE_CHECKING:
    from fpirhc.studies.comparison.entry import Entry


def findings(
    entries: Sequence[Entry],
    skipped: Mapping[str, str],
    headline: tuple[str, str] | None,
    yardstick: Yardstick | None = None,
    *,
    partners: Sequence[Entry] = (),
    unjudged: Mapping[str, str] | None = None,
    figure: Objective | None = None,
) -> tuple[Finding, ...]:
    """Return the verdict's sentences: the headline pair first, the other pairs, what other rows show, what was not run.

    Args:
        headline: names without and with adaptation of the pair that comes first.
        yardstick: what errors are measured against; None: each in its own unit.
        partners: runs without adaptation that are no rows, of rows whose pair they are.
        unjudged: why adaptive rows without a pair are not judged, by name.
        figure: the number of which the first sentences speak; None: errors alone.
    """
    measure = yardstick or Yardstick()
    by_name = {e.name: e for e in (*entries, *partners)}
    pairs = [(by_name[e.pair], e) for e in entries if e.pair in by_name]
    first = [p for p in pairs if headline and (p[0].name, p[1].name) == headline]
    receding = [p for p in pairs if "solve" in p[1].run.layout]
    ordered = list(dict.fromkeys([*first, *receding, *pairs]))
    by_figure = (
        [_by_figure(*pair, figure) for pair in ordered] if figure is not None and figure.metric is not None else []
    )
    judged = [_told_of_partner(judge(*pair, measure), pair[0] in partners) for pair in ordered] or [
        Finding(_without_a_pair(entries, measure.scales, figure), Outcome.NOT_COMPARABLE)
    ]
    not_followed_pairs = {
        n for f in judged if f.outcome is Outcome.NOT_COMPARABLE and f.ratios for n in f.pair or ()
    }  # by `not_followed`
    left = (leaves_reference(entry, measure) for entry in entries if entry.name not in not_followed_pairs)
    judged += [Finding(text) for text in left if text]
    judged += [Finding(_of(e, text)) for e in entries if not e.adaptive and (text := stuck_cause(e))]
    judged += [Finding(f"{name} is not judged: {why}.") for name, why in (unjudged or {}).items()]
    judged += remarks(entries, ordered[0] if ordered else None, measure.scales, figure)
    if skipped:
        judged.append(Finding("Not run: " + "; ".join(f"{name} ({why})" for name, why in skipped.items()) + "."))
    return (*by_figure, *judged)


def _by_figure(plain: Entry, adaptive: Entry, figure: Objective) -> Finding:
    """What adaptation does to the number that the problem is judged by."""
    pair, metric = (plain.name, adaptive.name), figure.metric
    assert metric is not None
    before, after = (
        math.nan if e.run.stop is not None else figure.told(figure.of(e.metrics)) for e in (plain, adaptive)
    )
    name = figure.noun
    if not math.isfinite(before + after):
        lost = [e.name for e, v in ((plain, before), (adaptive, after)) if not math.isfinite(v)]
        none = f"{lost[0]} has none" if len(lost) == 1 else "both have none"
        outcome = {(True, False): Outcome.BETTER, (False, True): Outcome.WORSE}.get(
            (not math.isfinite(before), not math.isfinite(after)), Outcome.NOT_COMPARABLE
        )
        return Finding(f"By {name} {adaptive.name} and {plain.name} cannot be set side by side: {none}.", outcome, pair)
    sign = -1 if metric.better == "larger" else 1
    outcome = Outcome.NO_DIFFERENCE
    if _differ(figure, before, after):
        outcome = Outcome.BETTER if sign * (before - after) > 0 else Outcome.WORSE
    ratio = Change(name, abs(before), abs(after)).ratio if before * after >= 0 else math.nan
    text = (
        f"{figure.text(sign * after)} after {figure.text(sign * before)} without adaptation; {figure.better} is better"
    )
    verb = {Outcome.BETTER: "improves", Outcome.WORSE: "worsens", Outcome.NO_DIFFERENCE: "does not clearly change"}[
        outcome
    ]
    return Finding(f"{adaptive.name} {verb} {name} ({text}).", outcome, pair, {name: ratio})


def _differ(figure: Objective, before: float, after: float) -> bool:
    """Whether two numbers of a figure clearly differ: by more than its floor, and by more than a tenth or in their sign."""
    floor = figure.metric.floor if figure.metric is not None else 0.0
    return abs(after - before) > floor and not (before * after > 0 and HELPS <= after / before <= HURTS)


def _told_of_partner(finding: Finding, apart: bool) -> Finding:
    """The finding; with a sentence where the run without adaptation is no row."""
    return (
        replace(finding, text=f"{finding.text} {finding.pair[0]} is no row: it ran for this.")
        if apart and finding.pair
        else finding
    )


def judge(plain: Entry, adaptive: Entry, yardstick: Yardstick) -> Finding:
    """Return what adaptation does to one pair."""
    pair = (plain.name, adaptive.name)
    if plain.run.stop is not None or adaptive.run.stop is not None:
        return _of_ends(plain, adaptive)
    changes = _changes(plain, adaptive, yardstick.scales)
    lost = [c.name for c in changes.values() if not math.isfinite(c.before + c.after)]
    if lost or not changes:
        text = f"{adaptive.name} and {plain.name} cannot be compared: the error of {', '.join(lost) or 'nothing'} is no number."
        return Finding(text, Outcome.NOT_COMPARABLE, pair)
    weighed = {n: c for n, c in changes.items() if adaptive.weighed is None or n in adaptive.weighed} or changes
    counted = major(weighed)
    outcome = outcome_of(counted)
    beside = ""
    for said, every, some in ((_MINOR, weighed, counted), (_NOT_WEIGHED, changes, weighed)):
        rest = [c for n, c in every.items() if n not in some]
        beside += f" {said}: {_listed(adaptive, rest, factors=False)}." if rest else ""
    ratios = {n: c.ratio for n, c in counted.items()}
    lost_both = not_followed(plain, adaptive, list(counted), yardstick)
    if lost_both:
        why = _of(adaptive, causes(plain, adaptive))
        return Finding(f"{lost_both}{why}", Outcome.NOT_COMPARABLE, pair, ratios)
    text = _effect(plain, adaptive, list(counted.values()), outcome) + beside
    if outcome is not Outcome.BETTER:
        worse = left_alone_is_better(plain, adaptive, list(counted), yardstick)
        start = start_counts(plain, adaptive, list(counted)) if outcome is Outcome.NO_DIFFERENCE else ""
        why = f" {start}" if start else causes(plain, adaptive)
        return Finding(text + (f" {worse}{_of(adaptive, why)}" if worse else why), outcome, pair, ratios)
    against = caveats(plain, adaptive, list(counted), yardstick)
    more = movement(plain, adaptive), effort_cause(adaptive), grows_alone(plain, adaptive)
    text += "".join(f" {sentence}" for sentence in more if sentence)
    against = _of(adaptive, against)
    return Finding(f"{against} {text}" if against else text, Outcome.DOUBTFUL if against else outcome, pair, ratios)


def _of_ends(plain: Entry, adaptive: Entry) -> Finding:
    """The finding where one of a pair, or both, do not finish."""
    pair, why = (plain.name, adaptive.name), causes(plain, adaptive)
    if adaptive.run.stop is None:
        text = f"{adaptive.name} finishes where {plain.name} does not ({plain.run.stop})."
        return Finding(text, Outcome.BETTER, pair)
    if plain.run.stop is None:
        return Finding(f"{adaptive.name} does not finish: {adaptive.run.stop}.{why}", Outcome.WORSE, pair)
    ends = " ".join(f"{e.name}: {e.run.stop}." for e in (adaptive, plain))
    text = f"Neither {adaptive.name} nor {plain.name} finishes. {ends}{_of(adaptive, why)}"
    return Finding(text, Outcome.NOT_COMPARABLE, pair)


_MINOR, _NOT_WEIGHED = "Too small beside them to count", "The cost does not weigh, so the verdict leaves out"


def _of(entry: Entry, sentences: str) -> str:
    """Sentences with the controller that the first is about, where those before are about another, about two, or about none."""
    return re.sub("^( ?)Its ", lambda found: f"{found[1]}{entry.name}: its ", sentences)


def _changes(plain: Entry, adaptive: Entry, scales: Mapping[str, float]) -> dict[str, Change]:
    before, after = plain.metrics.rms_error, adaptive.metrics.rms_error
    return {c: Change(c, before[c], after[c], scales.get(c, 1.0)) for c in before}


def _effect(plain: Entry, adaptive: Entry, changes: list[Change], outcome: Outcome) -> str:
    """What adaptation does to the errors that count, in a sentence."""
    name = adaptive.name
    higher, lower, stays = (
        _listed(adaptive, [c for c in changes if c.outcome is one], factors=one is not Outcome.NO_DIFFERENCE)
        for one in (Outcome.WORSE, Outcome.BETTER, Outcome.NO_DIFFERENCE)
    )
    rest = f"; no clear change: {stays}" if stays else ""
    if outcome is Outcome.BETTER:
        return f"{name} lowers the rms error of {lower}{rest}{_price(plain, adaptive)}."
    if outcome is Outcome.WORSE:
        return f"{name} does not help: it raises the rms error of {higher}{rest}."
    if outcome is Outcome.MIXED:
        return f"{name} has mixed results: it raises the rms error of {higher} and lowers that of {lower}{rest}."
    return f"{name} makes no clear difference: it changes the rms error of {stays}."


def _listed(entry: Entry, changes: Sequence[Change], *, factors: bool = True) -> str:
    return ", ".join(
        f"{c.name} from {c.before:.3g} to {c.after:.3g}{with_space(entry.run.unit(f'error.{c.name}'))}"
        + (_factor(c) if factors else "")
        for c in changes
    )


def _factor(change: Change) -> str:
    if change.vanishes:
        return " (to rounding)"
    if not 0 < change.ratio < math.inf:
        return ""
    more = change.ratio > 1
    return f" ({times(change.ratio if more else 1 / change.ratio)} {'more' if more else 'less'})"


def _without_a_pair(entries: Sequence[Entry], scales: Mapping[str, float], figure: Objective | None) -> str:
    """The best row: by the figure, else by the errors that some of the rows weigh."""
    if not entries:
        return "No controller finished, so nothing can be compared."
    finished = [e for e in entries if e.run.stop is None]
    if not finished:
        return "No controller finished its run: " + "; ".join(f"{e.name}: {e.run.stop}" for e in entries) + "."
    weighed = (
        None if any(e.weighed is None for e in finished) else frozenset().union(*(e.weighed or () for e in finished))
    )
    if figure is not None and figure.metric is not None:
        best = min(finished, key=lambda e: figure.of(e.metrics))
        number, word = figure.of(best.metrics), {"smaller": "smallest", "larger": "largest"}[figure.better]
        found = (
            f"{best.name} has {figure.noun} {figure.text(number)}"
            if math.isfinite(number)
            else f"No row has {figure.noun}"
        )
    else:
        best = min(finished, key=lambda e: relative_error(e, scales, weighed))
        number, word, found = 0.0, "smallest", f"{best.name} has {_said(best, scales, weighed)}"
    found += f", the {word}" if len(finished) > 1 and math.isfinite(number) else ""
    return f"{found}; no controller is here both with and without adaptation, so adaptation itself is not judged."


def _price(plain: Entry, adaptive: Entry) -> str:
    """The difference of both times, from cycles that were timed in turn; nothing where they were not."""
    price = adaptive.price
    if price is None or plain.cycle is None or adaptive.cycle is None or price.beside != plain.name:
        return ""
    # Something else kept the machine busy: neither a difference nor a smallest one can be larger than both times.
    if max(abs(price.difference), price.noise) > plain.cycle.median + adaptive.cycle.median:
        return ""
    if abs(price.difference) <= price.noise:
        return f"; the time per cycle differs by less than can be measured here ({written_out(price.noise, 2)} microseconds)"
    more = "more" if price.difference > 0 else "fewer"
    return f" at {written_out(abs(price.difference), 2)} {more} microseconds per cycle"


FAR = 2.0  # times a smaller error, from which another row is far better


def remarks(
    entries: Sequence[Entry],
    pair: tuple[Entry, Entry] | None,
    scales: Mapping[str, float],
    figure: Objective | None = None,
) -> list[Finding]:
    """Return the remarks about the first pair; none without a pair that finished."""
    if figure is not None and figure.metric is not None:
        sentences = _best_by(entries, pair, figure)
    else:
        sentences = [
            *_worse_learners(entries, scales),
            *_far_better(entries, pair, scales),
            *_no_bound(entries, scales),
        ]
    return [Finding(text) for text in (*sentences, *_rates(entries))]


def _best_by(entries: Sequence[Entry], pair: tuple[Entry, Entry] | None, figure: Objective) -> list[str]:
    """The row beside the pair that is clearly better by the figure: an error is then no measure, and an exact model no bound."""
    values = {e.name: figure.of(e.metrics) if e.run.stop is None else math.inf for e in (*entries, *(pair or ()))}
    others = [e.name for e in entries if pair is not None and e not in pair and not e.exact]
    name = min(others, key=values.__getitem__, default=None)
    if pair is None or name is None:
        return []
    ahead, best = min(values[e.name] for e in pair), values[name]
    if not best < ahead or (math.isfinite(ahead) and not _differ(figure, ahead, best)):
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
