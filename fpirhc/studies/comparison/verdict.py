"""The verdict: the effect of adaptation in sentences, with the reasons where there is none.

Every claim is computed from the entries. Known reasons are the response Jacobian's eigenvalues, a step
limit below the slew of the desired response, and a cost that weighs absolute effort.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from fpirhc.studies.comparison.compare import Entry

HELPS = 0.9  # an rms error below this share of the pair's counts as lower
HURTS = 1.1
MANY_CYCLES = 3  # of a run from which the slew of its desired response is judged


def verdict(entries: Sequence[Entry], skipped: Mapping[str, str], headline: tuple[str, str] | None) -> tuple[str, ...]:
    """Return the verdict's sentences, the headline pair first."""
    by_name = {e.name: e for e in entries}
    pairs = [(by_name[e.pair], e) for e in entries if e.pair in by_name]
    first = [p for p in pairs if headline and (p[0].name, p[1].name) == headline]
    receding = [p for p in pairs if "solve" in p[1].run.layout]
    ordered = list(dict.fromkeys([*first, *receding, *pairs]))
    sentences = [_sentence(plain, adaptive) for plain, adaptive in ordered]
    if not sentences:
        sentences = _no_pair(entries)
    if skipped:
        sentences.append("Not run: " + "; ".join(f"{name} ({why})" for name, why in skipped.items()) + ".")
    return tuple(sentences)


def _no_pair(entries: Sequence[Entry]) -> list[str]:
    if not entries:
        return ["No controller finished, so nothing can be compared."]
    finished = [e for e in entries if e.run.stop is None]
    if not finished:
        return ["No controller finished its run: " + "; ".join(f"{e.name}: {e.run.stop}" for e in entries) + "."]
    best = min(finished, key=_worst_rms)
    return [
        f"{best.name} has the smallest rms error ({_worst_rms(best):.3g}); no controller is here both with and without "
        "adaptation, so adaptation itself is not judged."
    ]


def _worst_rms(entry: Entry) -> float:
    return max(entry.metrics.rms_error.values())


def _sentence(plain: Entry, adaptive: Entry) -> str:
    if adaptive.run.stop is not None:
        return f"{adaptive.name} does not finish: {adaptive.run.stop}.{_causes(plain, adaptive)}"
    if plain.run.stop is not None:
        return f"{adaptive.name} finishes where {plain.name} does not ({plain.run.stop})."
    before, after = plain.metrics.rms_error, adaptive.metrics.rms_error
    ratios = {c: after[c] / before[c] if before[c] > 0 else float("nan") for c in before}
    worst = max(ratios.values())
    main = max(before, key=lambda c: before[c])
    numbers = ", ".join(f"{c} from {before[c]:.3g} to {after[c]:.3g} {_unit(adaptive, c)}" for c in before)
    if worst < HELPS:
        factor = f"{1 / ratios[main]:.3g} times less for {main}"
        return f"{adaptive.name} lowers the rms error of {numbers} ({factor}){_price(plain, adaptive)}."
    if min(ratios.values()) > HURTS:
        return f"{adaptive.name} does not help: it raises the rms error of {numbers}.{_causes(plain, adaptive)}"
    return f"{adaptive.name} makes no clear difference: the rms error of {numbers}.{_causes(plain, adaptive)}"


def _unit(entry: Entry, coordinate: str) -> str:
    return entry.run.unit(f"error.{coordinate}")


def _price(plain: Entry, adaptive: Entry) -> str:
    if plain.cycle is None or adaptive.cycle is None:
        return ""
    more = adaptive.cycle.median - plain.cycle.median
    if more <= 0:
        return " at no more time per cycle"
    return f" at {more:.2g} more microseconds per cycle"


def _causes(plain: Entry, adaptive: Entry) -> str:
    causes = [c for c in (_gain_cause(adaptive), _slew_cause(plain, adaptive), _effort_cause(adaptive)) if c]
    return " " + " ".join(causes) if causes else ""


def _gain_cause(entry: Entry) -> str:
    if entry.contraction is None or entry.contraction.predicted < 1:
        return ""
    return f"Its iteration is no contraction (predicted factor {entry.contraction.predicted:.3g}): {entry.contraction.report.text}"


def _slew_cause(plain: Entry, adaptive: Entry) -> str:
    """The step limit is compared with the desired response of the same controller without adaptation, which does not diverge."""
    limit = adaptive.run.settings["step_limit"]
    if not isinstance(limit, float) or plain.run.cycles < MANY_CYCLES:
        return ""
    largest = float(np.linalg.norm(np.diff(plain.run["desired"], axis=0), axis=1).max())
    if largest < limit:
        return ""
    return (
        f"The desired response changes by up to {largest:.3g} in one cycle, more than the map's largest step of {limit:.3g}: "
        f"raise its scale S at least {1.25 * largest / limit:.2g} times, or leave S out to have it chosen."
    )


def _effort_cause(entry: Entry) -> str:
    if not entry.run.settings.get("weighs_effort"):
        return ""
    return (
        "Its cost weighs the absolute effort, so the optimum of the wrong model trades tracking against a wrong effort and "
        "adaptation realises that plan faithfully: weigh the deviation from the model's feedforward, or the input's rate."
    )
