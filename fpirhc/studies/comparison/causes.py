"""Known reasons why adaptation does not help in a run, in sentences.

They stand in the order in which they act: a cost that weighs absolute effort, plans that did not converge or stay in a local
optimum, wrong parameters that are in no controlled response, a gain that is too large by the response Jacobian's eigenvalues or
too small by the review, a step limit below the slew of the desired response, commands
that stand at their limits, and commands that move far more than those of the pair. What is a fact of the runs alone is stated where
the share of the cycles is no start or single event. Where the gain is the cause, limits that are reached are its effect.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from fpirhc.plant.motion import with_space
from fpirhc.review.questions.horizon import EFFORT_CHANGE, EFFORT_FACT, MANY
from fpirhc.review.questions.slew import SPARE
from fpirhc.status import Status
from fpirhc.studies.comparison.changes import times
from fpirhc.summary import in_percent

if TYPE_CHECKING:
    from fpirhc.studies.comparison.entry import Entry

MANY_CYCLES = 3  # of a run from which the slew of its desired response is judged
_MORE = 2.0  # times the pair's movement of the command, from which it is stated
_CHATTER = 10.0  # times, from which it is a reason
_STILL = 1e-9  # of the rms command per unit of time: what moves less stands still
_SWINGS = 4.0  # times the turns of the reference, from which a command oscillates by itself
_OFTEN = 0.2  # share of the cycles from which commands at their limits are a reason


def causes(plain: Entry, adaptive: Entry) -> str:
    """Return the known reasons, each a sentence after a space; empty where none is known."""
    gain = _gain_cause(adaptive)
    sentences = (
        effort_cause(adaptive),
        plan_cause(plain, adaptive),
        stuck_cause(adaptive),
        adaptive.not_reached,
        gain,
        _slew_cause(plain, adaptive),
        "" if gain else limit_cause(plain, adaptive),
        chatter_cause(plain, adaptive),
    )
    return "".join(f" {sentence}" for sentence in sentences if sentence)


def _gain_cause(entry: Entry) -> str:
    one = entry.contraction
    if one is None or not grows(entry):
        return entry.reviewed_gain
    share = "" if one.growing == 1 else f" in {in_percent(one.growing)} of the cycles"
    advice = entry.reviewed_gain or f"{one.report.text.rstrip('.')}."
    return f"Its iteration is no contraction{share} (predicted factor {one.predicted:.3g}). {advice}"


def grows(entry: Entry) -> bool:
    """Whether the iteration is no contraction in so many cycles that the gain is the cause."""
    return entry.contraction is not None and entry.contraction.growing >= MANY


def _slew_cause(plain: Entry, adaptive: Entry) -> str:
    """The step limit is compared with the desired response of the same controller without adaptation, which does not diverge.

    A plan moves it in a step, which the map follows until the next plan.
    """
    limit, every = adaptive.run.settings["step_limit"], plain.plan_every
    if not isinstance(limit, float) or plain.run.cycles < MANY_CYCLES * every:
        return ""
    desired = plain.run["desired"]
    largest = float(np.linalg.norm(desired[every:] - desired[:-every], axis=1).max()) / every
    if largest < limit:
        return ""
    more = f"at least {SPARE * largest / limit:.2g} times"
    change = f"raise its scale S {more}, or leave S out to have it chosen"
    if "scale" in adaptive.automatic:
        change = f"the scale S that was chosen automatically did not foresee this, so state one that is {more} as large"
    span = "in one cycle" if every == 1 else "per cycle from plan to plan"
    fact = (
        f"The desired response changes by up to {largest:.3g} {span}, more than the map's largest step of {limit:.3g}"
    )
    return f"{fact}: {change}."


def effort_cause(entry: Entry) -> str:
    """Return the sentence of a review where the cost weighs the absolute effort; else nothing."""
    return f"I{EFFORT_FACT[1:]}. {EFFORT_CHANGE}" if entry.run.settings.get("weighs_effort") else ""


def plan_cause(plain: Entry, adaptive: Entry) -> str:
    """Return a sentence where plans that did not converge are a reason; else nothing."""
    before, after = (_share(e, "status", Status.NOT_CONVERGED.name) / max(1, e.run.cycles) for e in (plain, adaptive))
    swings = before < 0.5 * after and _share(adaptive, "at_limit", "") >= _OFTEN  # plans of a run that swings are hard
    if after < MANY or swings:
        return ""
    return (
        f"Its plans did not converge in {in_percent(after)} of the cycles (those of {plain.name} in {in_percent(before)}), so this "
        "is not the optimum of its cost: give the optimiser more iterations, then compare."
    )


def stuck_cause(entry: Entry) -> str:
    """Return a sentence where plans that count as solved stay in a local optimum at their limits; else nothing."""
    known = entry.optimality
    if known is None or not known.stuck:
        return ""
    first = f"{known.stuck[0]:.4g}{with_space(entry.run.unit('time'))}"
    return (
        f"Its plans stay in a local optimum: {len(known.stuck)} of the {known.plans} that were solved again, the first at "
        f"t = {first}, count as solved with every input at a limit, while a plan from the middle of the limits is cheaper; the "
        "next plan begins where they end. Keep the plant where its inputs act, by Limits(states=...), or slow the reference "
        "down."
    )


def limit_cause(plain: Entry, adaptive: Entry) -> str:
    """Return a sentence where commands at their limits are a reason; else nothing."""
    before, after = (_share(e, "at_limit", "") for e in (plain, adaptive))
    if after < _OFTEN:
        return ""
    fact = f"Its command stands at a limit in {in_percent(after)} of the cycles (that of {plain.name} in {in_percent(before)})"
    if before >= _OFTEN and not np.ptp(adaptive.run["reference"], axis=0).any():
        return (
            f"{fact}, where no adaptation can act: disturbances and noise ask for more than the limits allow, or the loop swings "
            "by itself; its review says whether it is stable."
        )
    if before >= _OFTEN and _swings(plain) and _swings(adaptive):
        advice = "Mend the loop without adaptation first; see its review."
        return f"{fact}: both swing to and fro where the reference does not. {advice}"
    if before >= _OFTEN:
        return f"{fact}, where no adaptation can act: slow the reference down or ask for less, or widen limits that are a choice."
    return f"{fact}, where no adaptation can act: it asks for too much, or oscillates; the command in the report shows which."


def _swings(entry: Entry) -> bool:
    """Whether a command turns far more often than the reference: both by how many times their own span they move."""
    turns = [
        float(
            np.max(
                np.abs(np.diff(entry.run[signal], axis=0)).sum(0)
                / np.maximum(np.ptp(entry.run[signal], axis=0), 1e-300)
            )
        )
        for signal in ("command", "reference")
    ]
    return turns[0] >= _SWINGS * max(1.0, turns[1])


def chatter_cause(plain: Entry, adaptive: Entry) -> str:
    """Return a sentence where the command moves far more than that of the pair, to and fro; else nothing."""
    more = _movement(plain, adaptive)
    return f"{more}: it chatters, or carries the noise." if more and _chatters(plain, adaptive) else ""


def movement(plain: Entry, adaptive: Entry) -> str:
    """Return a sentence on how much more the command moves, where it is more and no chatter; else nothing."""
    more = _movement(plain, adaptive)
    return f"{more}." if more and not _chatters(plain, adaptive) else ""


def _chatters(plain: Entry, adaptive: Entry) -> bool:
    """Whether it moves ten times as much, and ten times its own span: a command that settles once moves by its span."""
    ratio, name = _times_moved(plain, adaptive)
    command = adaptive.run[f"command.{name}"] if ratio >= _CHATTER else np.zeros(1)
    return float(np.abs(np.diff(command)).sum()) >= _CHATTER * float(np.ptp(command)) > 0


def _movement(plain: Entry, adaptive: Entry) -> str:
    ratio, name = _times_moved(plain, adaptive)
    if ratio < _MORE:
        return ""
    before, after = (entry.metrics.values["total_variation"][name] for entry in (plain, adaptive))
    unit = with_space(adaptive.metrics.units.get("total_variation", {}).get(name, "1"))
    much = f"{times(ratio)} as much as" if math.isfinite(ratio) else "and not"
    return f"Its command moves {much} that of {plain.name} ({name} {after:.3g} against {before:.3g}{unit})"


def _times_moved(plain: Entry, adaptive: Entry) -> tuple[float, str]:
    """How many times as much the command of an input moves, and the name of the input where this is the most."""
    before, after = (entry.metrics.values.get("total_variation", {}) for entry in (plain, adaptive))
    still = {n: _STILL * adaptive.metrics.values.get("effort", {}).get(n, 0.0) for n in after}
    ratios = {
        n: after[n] / before[n] if before[n] > still[n] else math.inf
        for n in after
        if n in before and after[n] > still[n]
    }
    name = max(ratios, key=lambda n: ratios[n], default="")
    return ratios.get(name, 0.0), name


def _share(entry: Entry, metric: str, by: str) -> float:
    return float(entry.metrics.values.get(metric, {}).get(by, 0.0))
