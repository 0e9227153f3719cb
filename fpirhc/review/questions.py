"""The questions of a review: a row for each, with a function that measures something and one sentence for what to do.

The run decides: an answer about a loop is a difference of two runs of its own step. Numbers have fixed names, units and spans.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache
from itertools import takewhile
from typing import NamedTuple

import numpy as np

from fpirhc.controllers.contract import tracking_law
from fpirhc.controllers.reference_states import needed_commands, whole_turns
from fpirhc.deformation.base import own_gain
from fpirhc.deformation.wrappers.filtered import with_filter
from fpirhc.errors import FpirhcError
from fpirhc.plant.chain import zero_dynamics
from fpirhc.review.experiments import FAILS, LATENCY, PLACES, PROBE, WORSE, Bench, Case, NotAsked, predictor
from fpirhc.simulation.hard_limits import TOLERANCE, hard_limits
from fpirhc.status import Status
from fpirhc.symbolic.driver import compiled_plans

SLIGHT, MINOR, LITTLE = 1e-3, 1e-3, 0.9  # added error, as a share of the task and of the largest; ratio worth a change
ROUNDING, GOOD, BAD = 1e-6, 0.5, 1.0  # error as a share of the task; the last two also for what is left of a push
MOSTLY, BUSY = 0.5, 2.0  # share of the cycles at a limit that shows no loop; times the movement without adaptation
GAINS = (1.4, 2.0), (0.7, 0.5)  # of the inputs, which are tried until one is not borne
CALM, CHATTER = 0.1, 0.01  # step of a command a cycle, as a share of what it covers: mean, and rms from noise
SATURATED, UNUSED, OFFSET = 0.2, 0.01, 0.8  # share of cycles at a limit; command as one of it; mean as one of rms

Numbers = Mapping[str, float]


class Verdict(StrEnum):
    """Yes is good in every question."""

    YES, CAUTION, NO, UNKNOWN = "yes", "caution", "no", "unknown"


class Fact(NamedTuple):
    """What was measured: numbers by fixed names, of one quantity; `change` in place of the row's sentence."""

    verdict: Verdict
    numbers: Numbers
    of: str = ""
    change: str = ""
    unit: str = ""  # where it is no unit of a followed quantity or an input


@dataclass(frozen=True)
class Question:
    """A row of the table."""

    key: str
    text: str
    ask: Callable[[Case], Fact | None]  # None: the question has no meaning here
    says: str  # the numbers in words, in parts behind "| " that are there where their numbers are
    change: str  # what to do where the answer is not good, with what the loop has for it
    of: str = "controller"  # or 'problem', which asks the loop of the first controller, or 'adaptive'

    def asked(self, case: Case) -> Fact | None:
        """Return the answer; a run of the model in place of a plant outside can tell what fails, and not what works there."""
        fact, fails = self.ask(case), self.of == "controller" and Verdict.NO
        if fact and case.outside and self.key not in OF_MODEL and fact.verdict != fails:
            raise NotAsked("Run on the model, not on your machine: fpirhc probe.")
        return fact


def graded(value: float, good: float, bad: float) -> Verdict:
    """Return yes up to `good`, no from `bad` on, caution between."""
    return Verdict.YES if value <= good else Verdict.CAUTION if value < bad else Verdict.NO


def _turns(case: Case) -> Fact | None:
    found = whole_turns(case.problem)
    return found and Fact(Verdict.NO if found[1] else Verdict.YES, {"jumps": found[1]}, found[0])


def _posed(case: Case) -> Fact | None:
    finite = np.isfinite(needed_commands(case.problem, case.bench.nominal["plant_state"])).all(axis=1)
    by_run = case.problem.plant.equations.hidden  # states that are taken from the run
    verdict = Verdict.YES if finite.all() else Verdict.CAUTION if by_run else Verdict.NO
    return Fact(verdict, {"share_finite": finite.mean()}) if len(finite) else None


def _inverse(case: Case) -> Fact:
    columns = [s.d / np.maximum(np.abs(s.d).max(axis=0), 1e-300) for s in case.slopes(41)]
    rows = [d / np.maximum(np.abs(d).max(axis=1, keepdims=True), 1e-300) for d in columns]
    worst = max(float(np.linalg.cond(d)) if np.isfinite(d).all() else math.inf for d in rows)
    return Fact(graded(worst, 1e6, 1e12), {"condition": worst} if math.isfinite(worst) else {})


def _ranges(case: Case) -> Fact | None:
    if not case.outside:
        return None
    shown, sensors = case.problem.sensing.measures(case.problem.plant), case.problem.sensing.sensors
    free = [n for n in shown if n not in sensors or sensors[n].range is None]
    return Fact(Verdict("caution" if free else "yes"), {"without": len(free), "measured": len(shown)}, ", ".join(free))


def _follows(case: Case) -> Fact:
    bench, (name, share) = case.bench, case.bench.worst(case.bench.nominal)
    rms, errors, verdict = bench.errors(bench.nominal)[name], bench.nominal["true_error"], graded(share, GOOD, BAD)
    numbers = {"rms_error": rms, "error": share, "size": bench.sizes[name]}
    if verdict != Verdict.YES and bench.controller.deformation.adapts and case.plain.share(case.plain.nominal) <= GOOD:
        return Fact(verdict, numbers, name, "Adaptation spoils it: {by_gain}.")
    column, by = errors[bench.first(len(errors)) :, case.problem.judged_names.index(name)], predictor(bench.controller)
    if by is None or by.residual_time or abs(column.mean()) <= OFFSET * rms or not 0.01 < share < math.inf:
        return Fact(verdict, numbers, name)
    change = "A wrong model in the prediction leaves an offset: Predicted(controller, residual_time=...)."
    numbers["mean_error"] = abs(column.mean())
    return Fact(Verdict.CAUTION if verdict == Verdict.YES else verdict, numbers, name, change)


def _saturates(case: Case) -> Fact | None:
    bench, run, plant = case.bench, case.bench.nominal, case.problem.plant
    limits, names = np.array(bench.problem.limits.input_bounds(plant)), list(plant.inputs)
    if not run.cycles or not np.isfinite(limits).any():
        return None

    def of_limit(commands: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.where(commands == 0, 0.0, commands / np.where(commands < 0, *limits)).max(axis=0))

    stuck = max(bench.draws, key=bench.held) if bench.problem.sensing.drawn else run
    largest, held = of_limit(run["command"]), bench.held(stuck)
    used = np.where(largest > ROUNDING, largest, np.inf)
    at = int(bench.at_limits(stuck).mean(axis=0).argmax() if held > SATURATED else used.argmin())
    exact = (False,) if case.outside or case.problem.reality is not None else (False, True)
    needed = max(of_limit(needed_commands(case.problem, run["plant_state"], exact=one))[at] for one in exact)
    sizes = {"largest": np.abs(run["command"][:, at]).max(), "share_of_the_limit": largest[at]}
    numbers = {"at_a_limit": held} | (sizes if largest[at] > ROUNDING else {})  # it may stand at a limit of zero
    numbers |= {"needed": needed} if np.isfinite(needed) and not plant.equations.hidden else {}
    if held <= SATURATED and used[at] < UNUSED:
        change = "State the limits that the actuator has: tolerances of plans are shares of them."
        return Fact(Verdict.CAUTION, numbers, names[at], change)
    change = "It needs less: {slower}, or {dead}." if numbers.get("needed", math.inf) <= 1 else ""
    lost = held > MOSTLY and bench.share(run) > GOOD / 2  # a plant at rest below a sine has .35
    return Fact(Verdict.NO if lost else graded(held, SATURATED, math.inf), numbers, names[at], change)


def _returns(case: Case) -> Fact:
    bench = case.bench
    if bench.held(bench.nominal) > MOSTLY:
        raise NotAsked("A command at its limits is no loop: see whether it follows.")
    back, far, step = bench.back, bench.along[0], bench.steps(bench.start)
    worst = max(one.factor for one in bench.along)
    calm = back.left <= GOOD and worst < 1 and step <= CALM
    verdict = Verdict.YES if calm else Verdict.NO if bench.lost else Verdict.CAUTION
    numbers = {"left": back.left, "left_of_ten_times": far.left, "factor": back.factor, "largest_factor": worst}
    numbers |= _times(math.log(back.factor) / case.problem.period) if back.factor > 0 else {}
    return Fact(verdict, {**numbers, "mean_step": step})


def _times(rate: float) -> dict[str, float]:
    """The time constant of what shrinks, or the time in which what grows is twice as large."""
    if rate < 0:
        return {"time_constant": -1 / rate}
    return {"doubles_in": math.log(2) / rate} if 0 < rate < math.inf else {}


def _plans(case: Case) -> Fact | None:
    bench, more = case.bench, case.converged
    if bench.controller.planner is None or not bench.nominal.cycles:
        return None
    share = float(np.mean(bench.nominal["status"] == Status.NOT_CONVERGED))
    if more is None or (share == 0 and bench.sound):  # nothing that more of them could mend
        return Fact(graded(share, FAILS, math.inf), {"not_converged": share})
    own, long = bench.share(bench.start), bench.share(more.start)
    better = long < own / WORSE and own - long > SLIGHT
    verdict = Verdict.NO if case.lacks_iterations else Verdict.CAUTION if better else Verdict.YES
    return Fact(verdict, {"not_converged": share, "error": own, "error_with_more_iterations": long})


def _horizon(case: Case) -> Fact | None:
    bench, horizon = case.bench, case.problem.horizon
    if horizon is None or bench.controller.planner is None:
        return None
    case.asks_more()
    short = bench.start.first(bench.cycles // 2)
    own = bench.share(short)
    if own <= SLIGHT:  # nothing that a longer one could mend
        return Fact(Verdict.YES, {"error": own})
    lengths = (*horizon.lengths, *horizon.lengths[-1:] * horizon.stages)
    longer = replace(horizon, stages=2 * horizon.stages, blocks=2 * horizon.blocks, lengths=lengths)
    with compiled_plans(yes=False):  # a loop for one run
        longer_one = Bench(replace(bench.problem, horizon=longer), bench.controller, seed=bench.seed)
        long = bench.share(longer_one.run(cycles=short.cycles))
    better = long < own / WORSE and own - long > SLIGHT
    verdict = Verdict.NO if own > BAD >= long else Verdict.CAUTION if better else Verdict.YES
    return Fact(verdict, {"error": own, "error_with_twice_the_horizon": long})


def _box(case: Case) -> Fact | None:
    bench, found = case.bench, list[tuple[float, float]]()
    if case.problem.reality is not None or not len(case.draws) or not case.asks_more():
        return None
    for exact in case.draws:
        if bench.built.controller.plant_model(case.problem).exact:  # it is told, and plans with it from the start
            told = Bench(case.problem.with_exact(exact), bench.controller, short=True, seed=bench.seed)
            found.append((told.back.left, bench.share(told.start)))
            continue
        base = bench.run(exact=exact)
        found.append((bench.pushed(PLACES[0], base=base, exact=exact)[0].left, bench.share(base)))
    good, most = float(np.mean([left <= 1 and share <= 1 for left, share in found])), np.max(found, axis=0)
    verdict = Verdict.YES if good == 1 else Verdict.CAUTION if good else Verdict.NO
    return Fact(verdict, {"share_that_come_back": good, "plants": len(found), "left": most[0], "error": most[1]})


def _gains(case: Case) -> Fact | None:
    if not case.asks_more():
        return None

    def bears(gain: float) -> bool:
        run = case.bench.pushed(PLACES[0], gain=gain)[0]
        return run.left <= 1 and run.steps <= BUSY * max(CALM, case.bench.back.steps)

    most, least = (([1.0, *takewhile(bears, side)])[-1] for side in GAINS)
    change = "With less gain of the inputs it is lost: only a faster loop bears that." if most > 1 else ""
    return Fact(Verdict.YES if least < 1 < most else Verdict.CAUTION, {"most": most, "least": least}, "", change)


def _latency(case: Case) -> Fact | None:
    if not case.asks_more():
        return None
    bench, borne, harms, numbers = case.bench, 0, 0.0, dict[str, float]()
    most, calm = max(2 * bench.share(bench.start), 0.1), bench.steps(bench.start)
    for cycles in range(1, LATENCY + 1):
        base = bench.run(latency=cycles)
        share, step, left, without = bench.share(base), bench.steps(base), math.inf, math.inf
        if share <= most and step <= BUSY * max(CALM, calm):
            left = bench.pushed(PLACES[0], base=base, latency=cycles)[0].left
        if left <= 1 and bench.built.controller.deformation.adapts:
            plain = case.plain.run(latency=cycles)
            without = case.plain.share(plain)
            harms = _added(case, case.plain.errors(plain), bench.errors(base), SLIGHT)[2]
        bears = left <= 1 and harms <= WORSE
        if bears or cycles == 1:
            borne, numbers = cycles * bears, {"error": share, "mean_step": step, "mean_step_without": calm}
            numbers |= {n: v for n, v in (("left", left), ("error_without", without)) if v < math.inf}
        if not bears:
            break
    numbers |= {"cycles_borne": borne, "time_borne": borne * case.problem.period, "cycles_tried": max(borne, 1)}
    return Fact(Verdict.YES if borne else Verdict.CAUTION, numbers)


def _left(case: Case) -> Fact | None:
    followed = hard_limits(case.problem, case.bench.nominal)
    if not followed:
        return None
    worst = max(followed, key=lambda one: float(one.beyond.max()))
    share, most = float((worst.beyond > TOLERANCE).mean()), float(worst.beyond.max())
    verdict, at = Verdict.YES if most <= TOLERANCE else Verdict.NO, int(worst.beyond.argmax())
    excess = max(worst.values[at] - worst.upper, worst.lower - worst.values[at], 0.0)
    numbers = {"share_of_cycles": share}
    numbers |= {"excess": excess, "beyond": most, "time_of_it": at * case.problem.period} if most > 0 else {}
    return Fact(verdict, numbers, worst.name, unit=worst.unit)


def _inner(case: Case) -> Fact | None:
    problem, bench = case.problem, case.bench
    if sum(problem.plant.response_orders.values()) >= problem.plant.state.size or problem.integrator.steps_maps:
        return None
    rate, left = max(map(zero_dynamics, case.slopes(9))), bench.back.left
    rate = 0.0 if abs(rate) * problem.duration < ROUNDING else rate
    held = Verdict.CAUTION if left <= 1 and bench.share(bench.nominal) <= 1 else Verdict.NO  # by the loop
    numbers = {"rate_with_outputs_held": rate, **(_times(rate) if rate else {})}
    still = rate * problem.duration <= math.log(2)
    return Fact(Verdict.YES, numbers) if still else Fact(held, {**numbers, "left": left})


def _noise(case: Case) -> Fact | None:
    if not case.problem.sensing.drawn:
        return None
    bench, quiet = case.bench, case.bench.quiet
    noisy = max((run.first(bench.cycles) for run in bench.draws), key=bench.steps)
    count = min(noisy.cycles, quiet.cycles)
    steps = np.diff((noisy["command"][:count] - quiet["command"][:count])[bench.first(count) :], axis=0)
    size = np.sqrt((steps**2).mean(axis=0))
    worst = int((size / bench.span).argmax())
    step, (moves, quietly) = size[worst] / bench.span[worst], (bench.moves(run)[worst] for run in (noisy, quiet))
    numbers = {"rms_change": size[worst], "rms_step": step, "movement": moves, "movement_without_noise": quietly}
    numbers |= {"error": bench.share(noisy), "error_without_noise": bench.share(quiet)}
    adapts, name = bench.built.controller.deformation.adapts, list(case.problem.plant.inputs)[worst]
    change = gain_by_run(case).change if adapts and _busy(case) else ""
    return Fact(Verdict.CAUTION if step > CHATTER and moves > BUSY * quietly else Verdict.YES, numbers, name, change)


def _bias(case: Case) -> Fact | None:
    bench, plain, base = case.bench, case.plain, case.bench.start
    shown = bench.built.loop.reads[PROBE].size > 2 * len(case.problem.plant.inputs) + 1
    if not shown or not case.asks_more():
        return None
    size = float(max(np.ptp(base["plant_realised"], axis=0).max(), 1e-2 * np.abs(base["plant_realised"]).max())) or 1.0
    biased = bench.run(bias=0.01 * size)
    count = min(biased.cycles, base.cycles)
    added = np.abs((biased["true_error"][:count] - base["true_error"][:count])[count // 2 :]).mean(axis=0)
    slopes = dict(zip(case.problem.judged_names, added / (0.01 * size), strict=True))
    alone = plain.errors(plain.nominal)
    name = max(alone, key=lambda n: slopes[n] / max(bench.sizes[n], 1e-300))
    even = alone[name] / slopes[name] if slopes[name] > 1e-12 else math.inf
    numbers = {"added_by_a_bias": 0.01 * size * slopes[name]}
    numbers |= {"share_of_the_response": even / size} if even <= 10 * size else {}
    right, own, most = bench.share(bench.quiet), bench.share(base), plain.share(plain.start)
    numbers |= {"error_with_right_sensors": right, "error": own} if case.problem.sensing.drawn else {}
    return Fact(Verdict.NO if right < most and own > WORSE * most else Verdict.YES, numbers, name)


def _allowed(case: Case) -> np.ndarray:
    """Total variation that commands may have per unit of time: twice that without adaptation, or their range, at rest .01 of it."""
    quiet = case.bench.quiet["command"][case.bench.first(case.bench.quiet.cycles) :]
    once = np.maximum(np.ptp(quiet, axis=0), 0.01 * case.bench.span) / (len(quiet) * case.problem.period)
    return np.maximum(BUSY * case.plain.moves(case.plain.start), once)


def _busy(case: Case) -> bool:
    """Whether sensors move a command by more than is allowed."""
    return bool(case.problem.sensing.drawn) and bool((case.bench.moved > _allowed(case)).any())


class Try(NamedTuple):
    """A run with another gain or with a filter, see `_tries`."""

    error: float
    moves: np.ndarray
    good: bool
    calm: bool


TODAY, TURNED = (1.0, 0.0), (-1.0, 0.0)  # times the gain, and pole of a filter
SMALLER, LARGER, FILTERS = [(0.5**k, 0.0) for k in (1, 2, 3, 4)], [(2.0, 0.0), (4.0, 0.0)], [(1.0, 0.8), (1.0, 0.95)]
NO_CALM = "No gain and no filter that was tried helps and moves commands less than twice as much as without adaptation:"
SAID = {TODAY: "error", TURNED: "error_turned", SMALLER[0]: "error_at_half", LARGER[0]: "error_at_twice",
        LARGER[1]: "error_at_four_times"}  # fmt: skip


@lru_cache(maxsize=1)
def _tries(case: Case) -> dict[tuple[float, float], Try]:
    """Runs with other gains and filters: calm is what moves no command by more than is allowed or than today; good what helps."""
    own, tries, busy = case.bench, dict[tuple[float, float], Try](), _busy(case)
    slow = lambda pole: own.controller.with_deformation(with_filter(own.controller.deformation, pole))  # noqa: E731
    alone = case.plain.share(case.plain.counted)
    useful, most, now = min(1.0, WORSE * alone + SLIGHT), _allowed(case), own.moved
    most = most if busy else np.maximum(most, now)

    def tried(way: tuple[float, float]) -> bool:
        tries[way] = Try(math.inf, np.full(most.shape, math.inf), False, False)
        with suppress(FpirhcError):  # refused by a schedule of slots
            bench = own if way == TODAY else case.other(slow(way[1]), short=True) if way[1] else own.at_gain(way[0])
            error, moves = bench.share(bench.counted), bench.moves(bench.start)
            if way == TODAY:
                error, moves = max(map(own.share, own.draws)), now
            calm = bool((moves <= most).all())
            good = error <= useful and (calm or bool((moves <= 2 * now).all())) and not bench.lost
            tries[way] = Try(error, moves, good, calm)
        return tries[way].good and (tries[way].calm or not busy)

    any(map(tried, SMALLER[:1] if tried(TODAY) else SMALLER if busy else SMALLER[:2]))
    any(map(tried, FILTERS)) if busy else all(map(tried, LARGER))
    if not any(one.good and WORSE * one.error < alone for one in tries.values()):  # is its sign wrong?
        tried(TURNED)
    return tries


@lru_cache(maxsize=1)  # noise asks it, too
def gain_by_run(case: Case) -> Fact:
    """Return errors at other gains and a calm one with reserve, or the best; in much noise a smaller one or a filter."""
    case.asks_more()
    busy, tries, plain = _busy(case), _tries(case), case.plain
    before, alone, now, error = plain.moves(plain.start), plain.share(plain.counted), *tries[TODAY][1::-1]
    good, fine = tries[TODAY].good, [way for way, one in tries.items() if one.good]
    if good and np.ptp([alone, *(one.error for one in tries.values())]) <= ROUNDING * error:
        raise NotAsked("Every gain has the error of none: the run has nothing that adaptation corrects.")
    most = error * (LITTLE if good or plain.lost else 1.0)
    spare = lambda way: good and way[0] < 1  # noqa: E731  its reserve is worth it, unless it costs too much
    pays = lambda way: tries[way].error < alone and (spare(way) or busy or tries[way].error <= most)  # noqa: E731
    largest, tame = max(fine, default=TODAY)[0], [way for way in fine if tries[way].calm]
    calm = [way for way in tame if way == TODAY or pays(way) or (spare(way) and tries[way].error > WORSE * error)]
    best = min(calm, key=lambda way: tries[way].error, default=TODAY)
    if not good and TURNED in calm and tries[TURNED].error <= WORSE * tries[best].error:
        best = TURNED
    elif not busy:
        best = max((way for way in calm if 0 < 2 * way[0] <= largest), default=best)
    worst = int((now / np.maximum(before, 1e-300)).argmax())
    of, numbers = list(case.problem.plant.inputs)[worst], {"movement": now[worst], "movement_without": before[worst]}
    numbers |= {"error_without": alone} | {SAID[way]: one.error for way, one in tries.items() if way in SAID}
    if not good and not calm:
        change = f"No gain that was tried helps: {{other}}{', or leave the deformation out' if alone <= error else ''}."
        return Fact(Verdict.NO if tame else Verdict.UNKNOWN, numbers, of, change)
    (times, pole), (name, value) = best, own_gain(case.bench.controller.deformation)
    if best != TODAY or (largest >= 2 and not busy):  # else it is not calm, or has no reserve
        numbers |= {"recommended_times": times, "recommended_gain": times * value}
    change = f"{NO_CALM} {{sensor}}." if busy else ""
    if best != TODAY:
        numbers |= {"error_recommended": tries[best].error, "movement_recommended": tries[best].moves[worst]}
        told = f"Set the {name} to {times * value:.4g}."
        change = f"Filter the error of the map: Filtered(map, pole={pole:g})." if pole else told
    reserve = largest >= 2 and (best == TODAY or tries[SMALLER[0]].good)
    enough = reserve or tries[best].error > WORSE * error  # or it costs too much
    verdict = Verdict.NO if not good else Verdict.YES if enough and not busy else Verdict.CAUTION
    return Fact(verdict, numbers, of, change)


def cures(case: Case) -> dict[str, str]:
    """What this loop has, for sentences: its gain is changed as the gain's row says, and lowered where a run bears that."""
    own, problem = case.bench.controller, case.problem
    law, window = tracking_law(own) is not None, hasattr(problem.sensing.estimator, "window")
    plain = "lower the rate of the tracking law" if law else "choose slower settings of this controller"
    plain = "weigh the changes of the inputs more in the cost" if own.planner else plain
    sensor = "widen the window of the estimator" if window else "measure the response with less noise"
    settings = "horizon, weights" if own.planner else "rate of the tracking law" if law else "its settings"
    late = "predict the dead time: Predicted(controller, inputs=...)"
    late = late if problem.dead_time.queued else "measure the latency and state it: Problem(dead_time=...)"
    late = "have the stated dead time right to one cycle" if predictor(own) else late
    other = [late] * bool(problem.dead_time.queued) + ["shorten the window of the estimator"] * window
    starts = own.planner and own.planner.restarts and own.planner.starts_consistent(problem.plant)
    ways = "RecedingHorizon(consistent=False), " * bool(starts) + "a shorter window, " * window
    ways = f"the start of the plan or the estimator's window is the cause: {ways}or leave" if ways else "leave"
    known = f"Its map is model-referenced already: {ways}", "Use ModelReferenced(map), or leave"
    told = {"referenced": known[own.deformation.form.compares != "model"], "sensor": sensor, "settings": settings, "dead": late,
            "quieter": f"{plain}, or {sensor}", "other": ", or ".join(other) or "use another form", "slower": plain,
            "by_gain": "leave it out"}  # fmt: skip
    with suppress(FpirhcError, ValueError, ArithmeticError):
        if own.deformation.adapts:
            said = gain_by_run(case).change.removesuffix(".").format(**told) or told["by_gain"]
            told["by_gain"] = said = said[:1].lower() + said[1:]
            lowers = any(one.good and 0 < times < 1 for (times, _), one in _tries(case).items())
            told["slower"] = said if said.startswith(("set", "filter")) else "lower the gain" if lowers else plain
    return told


def _added(case: Case, without: Numbers, adapted: Numbers, slight: float = 0.0) -> tuple[str, dict[str, float], float]:
    """The quantity that is made worse with most added, its errors, and how many times; `slight` is a share of the task."""
    sizes = {n: s for n, s in case.plain.sizes.items() if s and n in adapted}
    added = {n: math.inf if adapted[n] == math.inf else (adapted[n] - without[n]) / s for n, s in sizes.items()}
    most = (max((e[n] / s for n, s in sizes.items()), default=0.0) for e in (without, adapted))
    slight = slight or MINOR * min(most)
    counted = [n for n, share in added.items() if share > slight and adapted[n] > ROUNDING * sizes[n]]
    times = {n: adapted[n] / max(without[n], 1e-300) for n in counted}
    name = max(added, key=lambda n: (times.get(n, 0.0) > WORSE, added[n]), default=next(iter(adapted)))
    numbers = {"error_without": without[name], "error_with": adapted[name], "added": added.get(name, 0.0)}
    return name, numbers, times.get(name, 0.0)


def _model(case: Case) -> Fact:
    task = case.models.of(case.bench.built.controller)
    benches = [case.other(one.controller, model=task) for one in (case.plain, case.bench)]
    runs = [one.undisturbed for one in benches]
    if min(one.held(run) for one, run in zip(benches, runs, strict=True)) > MOSTLY:
        raise NotAsked("The command stands at a limit: run it where commands are free.")
    without, adapted = (one.errors(run) for one, run in zip(benches, runs, strict=True))
    name, numbers, harms = _added(case, without, adapted, SLIGHT)
    spoils = case.outside or numbers["error_with"] > case.plain.errors(case.plain.nominal)[name]
    no = spoils and ((harms > 2 and numbers["added"] > 0.01) or (harms > 10 and numbers["added"] > SLIGHT))
    verdict = Verdict.NO if no else Verdict.CAUTION if spoils and harms > WORSE else Verdict.YES
    return Fact(verdict, numbers, name)


def _pays(case: Case) -> Fact:
    plain, own = case.plain.share(case.plain.nominal), case.bench.share(case.bench.nominal)
    if min(plain, own) > BAD:
        shares = {"share_without": plain, "share_with": own}
        return Fact(Verdict.UNKNOWN, shares, change="Neither follows: mend that first.")
    name, numbers, harms = _added(case, case.plain.errors(case.plain.nominal), case.bench.errors(case.bench.nominal))
    numbers["divided_by"] = plain / max(own, 1e-300)
    verdict = Verdict.YES if own < max(plain, SLIGHT) else Verdict.CAUTION  # a small one is nothing to mend
    verdict = Verdict.NO if harms > WORSE or own > BAD else verdict
    return Fact(verdict, numbers, name)


QUESTIONS = (
    Question("turns", "Does an angle of the reference go on without jumps of a whole turn?", _turns, "jumps of {of} in {whole}: "
             "{jumps}", "The angle jumps by a whole turn: unwrap it (an angle that goes on), or weigh 1 - cos of its error.",
             "problem"),
    Question("posed", "Has the reference finite commands?", _posed, "finite in {share_finite:%} of the cycles of {whole}",
             "Give it the derivatives that the plant's order needs, away from singular states.", "problem"),
    Question("inverse", "Can the response be inverted where it goes?", _inverse, "largest condition number of the scaled input "
             "matrix in {whole}: {condition}", "Keep the plant away from states where inputs lose their effect.", "problem"),
    Question("ranges", "Is it stated what working sensors show?", _ranges, "{without} of {measured} quantities are without| {of}",
             "State it, so that a failed sensor is not believed: Sensor(range=(lower, upper)).", "problem"),
    Question("plans", "Are its plans good enough?", _plans, "{not_converged:%} of the plans of {whole} did not converge| relative "
             "rms error {error:%} ({start})| {error_with_more_iterations:%} with 8 times the iterations", "Give the optimiser more "
             "iterations, or a smaller tolerance, before anything else."),
    Question("gain", "Is the gain admissible?", gain_by_run, "relative rms error {error:%} ({tried})| {error_without:%} without "
             "adaptation| {error_recommended:%} as recommended| {error_at_half:%} at half of the gain| {error_at_twice:%} at "
             "twice| {error_at_four_times:%} at four times| {error_turned:%} with the other sign| recommended gain "
             "{recommended_gain:4}| total variation of {of} {movement:r} ({start})| {movement_recommended:r} as recommended| "
             "{movement_without:r} without adaptation", "There is no reserve: with twice this gain it is lost or chatters, or with "
             "half of it adaptation harms.", "adaptive"),
    Question("follows", "Does it follow the reference?", _follows, "rms error of {of} {rms_error:u} ({counted}), {error:%} of its "
             "motion of {size:u}| mean {mean_error:u}", "Mend the loop without adaptation first: {settings}, limits, period."),
    Question("input_limits", "Do the input limits fit the task?", _saturates, "a command or its change at a limit in "
             "{at_a_limit:%} of the cycles ({counted})| largest {of} {largest:u}, {share_of_the_limit:%} of its limit| by the "
             "model or the plant the reference needs {needed:%}", "Slow the reference, widen the limits, or mend the model."),
    Question("returns", "Does it come back from a push?", _returns, "{pushed} after a push by 1 % of the states' ranges {left:%} "
             "is left| {halfway} after one by 10 % {left_of_ten_times:%}| a cycle leaves {factor:5} of it| time constant "
             "{time_constant} {time}| doubles in {doubles_in} {time}| at worst {largest_factor:5}| commands change by "
             "{mean_step:%} of what they cover a cycle", "{slower}, shorten the period, or {dead}."),
    Question("horizon", "Is the horizon long enough?", _horizon, "relative rms error {error:%} ({half})| "
             "{error_with_twice_the_horizon:%} with twice the stages", "Lengthen it, or weigh its end (LQRTerminal)."),
    Question("box", "Does it come back for every plant in the range of the parameters?", _box, "{share_that_come_back:%} of "
             "{plants} plants| in the worst case {left:%} of a push left after {pushed}| relative rms error {error:%} ({start})",
             "Narrow the range of the parameters, or {slower}."),
    Question("input_gain", "Does it bear 0.7 and 1.4 times the gain of the inputs?", _gains, "it comes back at {least} to {most} "
             "times their gain", "{slower}: with more gain of the inputs it is lost."),
    Question("latency", "Does it bear a cycle of latency?", _latency, "{cycles_borne} of 3 cycles ({time_borne} {time})| with "
             "{cycles_tried} of them: relative rms error {error:%} ({start})| {error_without:%} without adaptation| commands "
             "change by {mean_step:%} of what they cover a cycle| {mean_step_without:%} without latency| {left:%} of a push left "
             "after {pushed}", "Slow the loop, or {dead}."),
    Question("limits", "Do states, rates and paths keep their limits?", _left, "beyond a limit in {share_of_cycles:%} of the "
             "cycles of {whole}| {of} by at most {excess:u}, {beyond:%} of its range, at t = {time_of_it} {time}", "Commands keep "
             "intervals of inputs and rates: slow the reference, or leave room."),
    Question("inner", "Are the zero dynamics stable?", _inner, "largest real part {rate_with_outputs_held} 1/{time}| time constant "
             "{time_constant} {time}| doubles in {doubles_in} {time}| {left:%} of a push left after {pushed}", "States without a "
             "task go off: weigh them in the cost, or control another output."),
    Question("noise", "Is the chatter from noise small?", _noise, "noise changes {of} by {rms_change:u} rms per cycle, "
             "{rms_step:%} of what it covers ({start})| total variation {movement:r}| {movement_without_noise:r} without noise"
             "| relative rms error {error:%}| {error_without_noise:%} without noise", "{quieter}."),
    Question("bias", "Does it bear a bias of the measured response?", _bias, "a bias of 1 % of the response's range adds "
             "{added_by_a_bias:u} to the error of {of} ({late})| one of {share_of_the_response:%} costs what adaptation gains| "
             "relative rms error {error:%} ({start})| {error_with_right_sensors:%} with right sensors", "Calibrate the sensor: a "
             "bias moves the plant.", "adaptive"),
    Question("model", "Does it spoil a right model less than it cures yours?", _model, "model as the plant, without noise and "
             "disturbances: rms error of {of} {error_without:u} without adaptation| {error_with:u} with it ({counted})",
             "{referenced} the deformation out.", "adaptive"),
    Question("pays", "Does adaptation lower the error, or leave it small?", _pays, "rms error of {of} {error_without:u} without "
             "adaptation| {error_with:u} with it ({counted})| relative rms error {share_without:%} without| {share_with:%} with it "
             "({counted})| {ratio}", "Leave it out, or compare gains: fpirhc study --over deformation.gain=...", "adaptive"),
)  # fmt: skip
OF_MODEL = "turns", "posed", "ranges", "model"  # which ask the file or the model, and no plant outside
ROOTS = ("turns", "posed", "plans", "gain")  # whose no is the cause of the others: their sentence stands there too
