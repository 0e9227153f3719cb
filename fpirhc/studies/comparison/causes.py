"""Known reasons why adaptation does not help in a run, and why a smaller error is no success, in sentences.

Causes stand in the order in which they act. What is a fact of the runs alone is stated where the share of the cycles is no start or
single event. Where the gain is the cause, limits that are reached are its effect. A caveat stands before a positive verdict, which
is then doubtful: the plant left alone does better, the reference is not followed, or plans and limits decide.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from fpirhc.errors import FpirhcError
from fpirhc.plant.motion import with_space
from fpirhc.review.questions.horizon import EFFORT_CHANGE, EFFORT_FACT, MANY
from fpirhc.review.questions.slew import SPARE
from fpirhc.simulation.loop import HeldInput
from fpirhc.simulation.metrics.entries.errors import rms_error
from fpirhc.simulation.simulate import judged_run, simulator
from fpirhc.status import Status
from fpirhc.studies.comparison.changes import quarter_turns, ranges, scales, times
from fpirhc.summary import in_percent
from fpirhc.task.problem import Problem

if TYPE_CHECKING:
    from fpirhc.studies.comparison.entry import Entry


@dataclass(frozen=True)
class Yardstick:
    """What errors are measured against, by judged coordinate."""

    # by which errors are judged, see `fpirhc.studies.comparison.changes`; 1 where not named
    scales: Mapping[str, float] = field(default_factory=dict)
    # of the references that move, the start included; of one that moves from the start alone at least what the plant left
    # alone has for an error, because disturbances and not the reference move it
    ranges: Mapping[str, float] = field(default_factory=dict)
    turns: Mapping[str, float] = field(default_factory=dict)  # a quarter turn for angles whose references do not move
    # rms error of the plant left alone; empty where it is not known
    alone: Mapping[str, float] = field(default_factory=dict)

    def beyond(self, entry: Entry, name: str) -> str:
        """What the rms error of a coordinate exceeds, in words: the range of its reference, or a quarter turn; else nothing."""
        error = entry.metrics.rms_error[name]
        if error > self.ranges.get(name, math.inf):
            return f"more than {self._range(name)}, {self.ranges[name]:.3g}{_unit(entry, name)}"
        if error > self.turns.get(name, math.inf):
            return f"more than a quarter turn, {self.turns[name]:.3g}{_unit(entry, name)}"
        return ""

    def _range(self, name: str) -> str:
        alone = self.alone.get(name) == self.ranges[name]
        return "the plant left alone" if alone else "the range of its reference"


def yardstick_of(problem: Problem, *, seed: int) -> Yardstick:
    """Return what errors of a problem are measured against; the seed is that of disturbances and noise of the plant left alone."""
    moving, alone = ranges(problem), error_left_alone(problem, seed=seed)
    held = {
        name: max(size, alone.get(name, 0.0))
        for name, size in moving.items()
        if name not in ranges(problem, start=False)
    }
    return Yardstick(scales(problem), {**moving, **held}, quarter_turns(problem), alone)


def error_left_alone(problem: Problem, *, seed: int) -> Mapping[str, float]:
    """Return the rms error of every judged coordinate under the input before the run; empty where that is not known.

    It is not known for a plant outside, which is not run for the sake of a comparison, and where the run ends early. The run has
    the start, disturbances and noise of the comparison. It is made in the virtual machine: it is shorter than a compilation.
    """
    try:
        problem.require_equations("a plant outside is not run for the sake of a comparison")
        run = judged_run(simulator(problem, HeldInput(), compiled=False), seed=seed)
    except FpirhcError:
        return {}
    return {} if run.stop is not None else rms_error.values(problem, run)


def not_followed(plain: Entry, adaptive: Entry, names: list[str], yardstick: Yardstick) -> str:
    """Return a sentence where neither controller stays near a reference; else nothing."""
    lost = [n for n in names if yardstick.beyond(plain, n) and yardstick.beyond(adaptive, n)]
    if not lost:
        return ""
    texts = "; ".join(
        f"the rms error of {n} is {plain.metrics.rms_error[n]:.3g} and {adaptive.metrics.rms_error[n]:.3g}{_unit(adaptive, n)}, "
        f"{yardstick.beyond(adaptive, n)}"
        for n in lost
    )
    return f"Neither {plain.name} nor {adaptive.name} follows the reference: {texts}."


def leaves_reference(entry: Entry, yardstick: Yardstick) -> str:
    """Return a sentence where a run that finished leaves the neighbourhood of its reference; else nothing."""
    errors = entry.metrics.rms_error if entry.run.stop is None else {}
    lost = [n for n in errors if yardstick.beyond(entry, n)]
    texts = "; ".join(f"rms error of {n} {errors[n]:.3g}{_unit(entry, n)}, {yardstick.beyond(entry, n)}" for n in lost)
    return (
        f"{entry.name} leaves the neighbourhood of its reference, for which its gains and its review are made: {texts}."
        if lost
        else ""
    )


def caveats(plain: Entry, adaptive: Entry, names: list[str], yardstick: Yardstick) -> str:
    """Return the reasons not to trust a smaller error, each a sentence; empty where there is none."""
    sentences = (
        left_alone_is_better(plain, adaptive, names, yardstick),
        growth(plain, adaptive) if _growth(adaptive) else "",
        plan_cause(plain, adaptive),
        stuck_cause(adaptive),
        limit_cause(plain, adaptive),
        chatter_cause(plain, adaptive),
    )
    return " ".join(sentence for sentence in sentences if sentence)


def left_alone_is_better(plain: Entry, adaptive: Entry, names: list[str], yardstick: Yardstick) -> str:
    """Return a sentence where the adaptive controller does worse than the plant left alone, in every judged coordinate."""
    alone = {n: yardstick.alone[n] for n in names if n in yardstick.alone}
    if not alone or not all(adaptive.metrics.rms_error[n] > value for n, value in alone.items()):
        return ""
    both = all(plain.metrics.rms_error[n] > value for n, value in alone.items())
    who = f"{plain.name} and {adaptive.name} do" if both else f"{adaptive.name} does"
    errors = ", ".join(f"{value:.3g}{_unit(adaptive, n)} in {n}" for n, value in alone.items())
    return f"{who} worse than the plant left alone, whose input stays as it was before the run: rms error {errors}."


def growth(plain: Entry, adaptive: Entry) -> str:
    """Return a sentence where an error grows all through a run, as that of an unstable loop does; else nothing.

    An error that follows a faster and faster reference grows less and less in proportion.
    """
    growing = {entry.name: factor for entry in (plain, adaptive) if (factor := _growth(entry))}
    if not growing:
        return ""
    names, factors = " and ".join(growing), " and ".join(map(times, growing.values()))
    return (
        f"The error of {names} grows from quarter to quarter of the run, {factors} from the first to the last, as in an unstable "
        "loop: ratios are those of this duration, and the review says whether the loop is stable."
    )


_QUARTERS = 4
_FEW = 40  # cycles of a run that says nothing about growth
_GROWN = 8.0  # times, from the first quarter to the last
_STEADY = 1.5  # times, in each of the last two
_SLOWING = 0.6  # of the growth in the first step, below which the growth is that of a power of time


def grows_alone(plain: Entry, adaptive: Entry) -> str:
    """Return the sentence of `growth` where only the run without adaptation grows, which is no reason against the other."""
    return "" if _growth(adaptive) else growth(plain, adaptive)


def _growth(entry: Entry) -> float:
    """By how much the error grows from the first quarter to the last, where it does so as an exponential; else 0."""
    errors = np.abs(entry.run["true_error"])
    if entry.run.stop is not None or len(errors) < _FEW:
        return 0.0
    largest = np.array([part.max(axis=0) for part in np.array_split(errors, _QUARTERS)])
    steps = largest[1:] / np.maximum(largest[:-1], 1e-300)
    exponential = (steps[0] > 1) & (steps[1:] >= _STEADY).all(axis=0) & (steps[-1] >= _SLOWING * steps[0])
    grown = np.where(exponential, largest[-1] / np.maximum(largest[0], 1e-300), 0.0)
    most = float(grown.max(initial=0.0))
    return most if most >= _GROWN else 0.0


def _unit(entry: Entry, name: str) -> str:
    return with_space(entry.run.unit(f"error.{name}"))


MANY_CYCLES = 3  # of a run from which the slew of its desired response is judged
_MORE = 2.0  # times the pair's movement of the command, from which it is stated
_CHATTER = 10.0  # times, from which it is a reason
_STILL = 1e-6  # of the rms command per unit of time: what moves less stands still
_AT_FIRST = 0.9  # of the cycles at a limit, and of the largest error, from which a run comes from its start
_APART = 2.0  # times, from which errors of two runs at their ends clearly differ, and the start counts for most
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
    if not np.any(one.spectrum.eigenvalues):
        fact = "The predicted factor of 1 is not its iteration's: no small change of a command moves the response"
        fact += ", as where it is rounded."
        return f"{fact} {entry.reviewed_gain}".strip()
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
    if not isinstance(limit, float) or plain.run.cycles < MANY_CYCLES * every or plain.run.stop is not None:
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
    """Return a sentence where plans that did not converge are a reason; else nothing.

    The status compares a step with the tolerance. A single iteration on a linear plan ends at the optimum with a large
    step. Where the sampled plans cost what the optimum costs, nothing is said.
    """
    if adaptive.optimality is not None and adaptive.optimality.reached:
        return ""
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
    if not after >= _OFTEN:  # nor where the run ends before the first cycle that counts
        return ""
    beside = f" (that of {plain.name} in {in_percent(before)})" if math.isfinite(before) else ""
    fact = f"Its command stands at a limit in {in_percent(after)} of the cycles{beside}"
    if _comes_from_its_start(adaptive, after):
        return f"{fact}, while it comes from its start: state measure_from, from which errors count."
    if before >= _OFTEN and not np.ptp(adaptive.run["reference"], axis=0).any():
        return (
            f"{fact}, where no adaptation can act: disturbances and noise ask for more than the limits allow, or the loop swings "
            "by itself; its review says whether it is stable."
        )
    if before >= _OFTEN and _swings(plain):
        advice = "Mend the loop without adaptation first; see its review."
        who = "both swing" if _swings(adaptive) else f"{plain.name} swings"
        return f"{fact}: {who} to and fro where the reference does not. {advice}"
    if before >= _OFTEN:
        return f"{fact}, where no adaptation can act: slow the reference down or ask for less, or widen limits that are a choice."
    return f"{fact}, where no adaptation can act: it asks for too much, or oscillates; the command in the report shows which."


def _comes_from_its_start(entry: Entry, share: float) -> bool:
    """Whether the error never grows, or is the largest at first and a command stands at a limit from there on, but not later."""
    command, errors = entry.run["command"], np.abs(entry.run["true_error"])
    if len(errors) > 1 and (errors[-1] < errors[0]).any() and (np.diff(errors, axis=0) <= 0).all():
        return True
    first = command[: max(2, int(_AT_FIRST * share * len(command)))]
    stands = (np.ptp(first, axis=0) == 0) & ((first[0] == command.max(axis=0)) | (first[0] == command.min(axis=0)))
    return bool(stands.any() and (errors[0] >= _AT_FIRST * errors.max(axis=0)).any() and np.ptp(command, axis=0).any())


def start_counts(plain: Entry, adaptive: Entry, names: Sequence[str]) -> str:
    """Return a sentence where errors are those of the start, and differ clearly at the end of the run; else nothing."""
    if not names or plain.run.stop is not None or adaptive.run.stop is not None:
        return ""
    last = max(1, adaptive.run.cycles // _QUARTERS)
    ends = [[_rms(entry.run[f"true_error.{n}"][-last:]) for n in names] for entry in (plain, adaptive)]
    whole = [[_rms(entry.run[f"true_error.{n}"]) for n in names] for entry in (plain, adaptive)]
    differ = [k for k in range(len(names)) if max(e[k] for e in ends) > _APART * min(e[k] for e in ends)]
    if not differ or any(w[k] <= _APART * e[k] for w, e in zip(whole, ends, strict=True) for k in differ):
        return ""
    told = ", ".join(f"{ends[0][k]:.3g} and {ends[1][k]:.3g}{_unit(adaptive, names[k])}" for k in differ)
    return f"Most of this error is that of the start; in the last quarter of the run it is {told}: state measure_from."


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


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
    much = (
        f" {times(ratio)} as much as that of {plain.name}"
        if math.isfinite(ratio)
        else f", that of {plain.name} does not"
    )
    return f"Its command moves{much} ({name} {after:.3g} against {before:.3g}{unit})"


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
