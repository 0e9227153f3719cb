"""The questions of a review: a row for each, with a function that measures something and one sentence for what to do.

The run decides: every answer about a loop is a difference of two runs of its own step, see `experiments`. Numbers have fixed names,
which `fpirhc review --json` writes; a yes never stands beside a factor that grows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from itertools import takewhile
from typing import Any, NamedTuple

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import with_optimiser, without_deformation
from fpirhc.describe import identity
from fpirhc.errors import FpirhcError
from fpirhc.plant.chain import relative_order
from fpirhc.review.experiments import LATENCY, PLACES, Bench
from fpirhc.review.points import StateSlopes, needed_commands, state_slopes, whole_turns, zero_dynamics
from fpirhc.simulation.hard_limits import TOLERANCE, hard_limits
from fpirhc.simulation.model_as_plant import ModelAsPlant
from fpirhc.status import Status
from fpirhc.symbolic.driver import compiled_plans
from fpirhc.task.problem import Problem

MORE = 8  # times the optimiser's iterations, with a tenth of its tolerance
WORSE, SLIGHT = 1.2, 1e-3  # ratio of errors; added error as a share of the size of the task
ROUNDING, MINOR = 1e-6, 1e-3  # error that shows nothing, as such a share; added one, as a share of the largest error
GOOD, BAD = 0.5, 1.0  # error as a share of the task; what is left of a push
MOSTLY = 0.5  # share of the cycles at a limit, from which a run shows nothing of a loop
GAINS = (1.4, 2.0), (0.7, 0.5)  # of the inputs, which are tried until one is not borne


class Verdict(StrEnum):
    """Yes is good in every question."""

    YES, CAUTION, NO, UNKNOWN = "yes", "caution", "no", "unknown"


class Fact(NamedTuple):
    """What was measured: numbers by fixed names, of one quantity where it is about one; `change` in place of the row's sentence."""

    verdict: Verdict
    numbers: Mapping[str, float]
    of: str = ""
    change: str = ""


class NotAsked(FpirhcError):
    """Why a question has no answer for this loop."""


@dataclass(frozen=True, eq=False)
class Case:
    """A loop and its experiments; what takes time is run when it is first read."""

    bench: Bench
    draws: np.ndarray  # exact parameters of the box, shape (draws, np)
    outside: bool  # whether the plant is somebody else's, so that the model moves in its place
    known: dict[object, Bench]  # experiments with other loops, which controllers share
    models: ModelAsPlant

    @property
    def problem(self) -> Problem:
        """The problem that is run."""
        return self.bench.problem

    def other(self, controller: Controller, *, short: bool = False, model: Problem | None = None) -> Bench:
        """Return the experiments with another controller, or on its model as the plant."""
        key = (identity(controller), short, id(model)) if short or model else identity(controller)
        return self.known.setdefault(key, Bench(model or self.problem, controller, short=short))

    @cached_property
    def plain(self) -> Bench:
        """The loop without adaptation."""
        return self.other(without_deformation(self.bench.controller))

    @cached_property
    def converged(self) -> Bench | None:
        """The loop whose optimiser takes its time; None where there is nothing to take."""
        planner = self.bench.controller.planner
        if planner is None:
            return None
        longer: Any = planner.optimiser.longer(MORE)
        if longer is None:
            return None
        if getattr(longer, "tolerance", None):
            longer = replace(longer, tolerance=longer.tolerance / 10)
        return self.other(with_optimiser(self.bench.controller, longer), short=True)

    @cached_property
    def lacks_iterations(self) -> bool:
        """Whether only the loop with more iterations follows and comes back."""
        return not self.bench.sound and self.converged is not None and self.converged.sound

    def asks_more(self) -> bool:
        """Return whether there is a loop to ask more of; raises where its plans have to converge first."""
        if self.lacks_iterations:
            raise NotAsked("Not asked before the plans converge.")
        return self.bench.back.left <= 1 and self.bench.share(self.bench.nominal) <= 1

    def slopes(self, count: int) -> list[StateSlopes]:
        """Return slopes of the model's plant at states and commands of the run."""
        run, plant = self.bench.nominal, self.problem.plant
        if run["plant_state"].shape[1] != plant.state.size or not run.cycles:
            raise NotAsked("What moves has other states than the model.")
        at = np.linspace(0, run.cycles - 1, count).astype(int)
        return [state_slopes(plant, run["plant_state"][k], run["command"][k], plant.exact) for k in at]


@dataclass(frozen=True)
class Question:
    """A row of the table."""

    key: str
    text: str
    ask: Callable[[Case], Fact | None]  # None: the question has no meaning here
    change: str  # what to do where the answer is not good
    of: str = "controller"  # or 'problem', which asks the loop of the first controller, or 'adaptive'


def graded(value: float, good: float, bad: float) -> Verdict:
    """Return yes up to `good`, no from `bad` on, caution between; the other way round where good is the larger one."""
    sign = 1 if good <= bad else -1
    return Verdict.YES if sign * value <= sign * good else Verdict.CAUTION if sign * value < sign * bad else Verdict.NO


# Of the problem


def _turns(case: Case) -> Fact | None:
    found = whole_turns(case.problem)
    return found and Fact(Verdict.NO if found[1] else Verdict.YES, {"jumps": found[1]}, found[0])


def _posed(case: Case) -> Fact | None:
    commands = needed_commands(case.problem, case.bench.nominal)
    finite = np.isfinite(commands).all(axis=1)
    return Fact(Verdict.YES if finite.all() else Verdict.NO, {"share_finite": finite.mean()}) if len(finite) else None


def _orders(case: Case) -> Fact:
    plant = case.problem.plant
    found = {name: (float(relative_order(plant, name) or 0), order) for name, order in plant.response_orders.items()}
    name = next((n for n, (own, stated) in found.items() if own != stated), next(iter(found)))
    own, stated = found[name]
    return Fact(Verdict.YES if own == stated else Verdict.NO, {"order": own, "stated": stated}, name)


def _inverse(case: Case) -> Fact:
    columns = [s.d / np.maximum(np.abs(s.d).max(axis=0), 1e-300) for s in case.slopes(41)]
    rows = [d / np.maximum(np.abs(d).max(axis=1, keepdims=True), 1e-300) for d in columns]
    worst = max(float(np.linalg.cond(d)) if np.isfinite(d).all() else math.inf for d in rows)
    return Fact(graded(worst, 1e6, 1e12), {"condition": worst})


def _ranges(case: Case) -> Fact | None:
    if not case.outside:
        return None
    sensing = case.problem.sensing
    shown = sensing.measures(case.problem.plant)
    free = [n for n in shown if n not in sensing.sensors or sensing.sensors[n].range is None]
    return Fact(Verdict.CAUTION if free else Verdict.YES, {"without": len(free), "of": len(shown)}, ", ".join(free))


# Of a loop


def _mended(case: Case, fact: Fact) -> Fact:
    """The answer that more iterations would turn into a yes, told as such."""
    if fact.verdict == Verdict.YES or not case.lacks_iterations or case.converged is None:
        return fact
    return fact._replace(numbers={**fact.numbers, "left_with_more_iterations": case.converged.back.left})


def _follows(case: Case) -> Fact:
    run = case.bench.nominal
    (name, share), held = case.bench.worst(run), case.bench.held(run)
    verdict = Verdict.CAUTION if share <= GOOD and held > 0.2 else graded(share, GOOD, BAD)
    return _mended(case, Fact(verdict, {"error": share, "at_a_limit": held}, name))


def _returns(case: Case) -> Fact:
    bench = case.bench
    if bench.held(bench.nominal) > MOSTLY:
        raise NotAsked("A command at its limits is no loop: see whether it follows.")
    back, far, step = bench.back, bench.along[0], bench.steps(bench.start)
    worst = max(one.factor for one in bench.along)
    calm = back.left <= GOOD and far.left <= GOOD and worst < 1 and step <= 0.1
    lost = back.left >= 1.05 and (far.left >= 1.05 or back.left >= 2)  # else a small cycle about the run
    verdict = Verdict.YES if calm else Verdict.NO if lost else Verdict.CAUTION
    numbers = {"left": back.left, "left_of_ten_times": far.left, "factor": back.factor, "largest_factor": worst}
    return _mended(case, Fact(verdict, {**numbers, "mean_step": step}))


def _plans(case: Case) -> Fact | None:
    bench, more = case.bench, case.converged
    if bench.controller.planner is None or not bench.nominal.cycles:
        return None
    share = float(np.mean(bench.nominal["status"] == Status.NOT_CONVERGED))
    numbers = {"not_converged": share}
    if more is None or (share == 0 and bench.sound):  # nothing that more of them could mend
        return Fact(graded(share, 0.05, math.inf), numbers)
    own, long = bench.share(bench.start), bench.share(more.start)
    better = long < own / WORSE and own - long > SLIGHT
    verdict = Verdict.NO if case.lacks_iterations else Verdict.CAUTION if better else Verdict.YES
    return Fact(verdict, {**numbers, "error": own, "error_with_more_iterations": long})


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
        longer_one = Bench(replace(bench.problem, horizon=longer), bench.controller)
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
            told = Bench(case.problem.with_exact(exact), bench.controller, short=True)
            found.append((told.back.left, bench.share(told.start)))
            continue
        base = bench.run(exact=exact)
        found.append((bench.pushed(PLACES[0], base=base, exact=exact)[0].left, bench.share(base)))
    good, most = float(np.mean([left <= 1 and share <= 1 for left, share in found])), np.max(found, axis=0)
    verdict = (
        Verdict.NO if good == 0 else graded(most[0], max(GOOD, bench.back.left), BAD) if good == 1 else Verdict.CAUTION
    )
    return Fact(verdict, {"share_that_come_back": good, "left": most[0], "error": most[1]})


def _gains(case: Case) -> Fact | None:
    if not case.asks_more():
        return None

    def bears(gain: float) -> bool:
        run = case.bench.pushed(PLACES[0], gain=gain)[0]
        return run.left <= 1 and run.steps <= 2 * case.bench.back.steps + 0.01

    most, least = (([1.0, *takewhile(bears, side)])[-1] for side in GAINS)
    return Fact(Verdict.YES if (most, least) == (2.0, 0.5) else Verdict.CAUTION, {"most": most, "least": least})


def _latency(case: Case) -> Fact | None:
    if not case.asks_more():
        return None
    bench, borne, harms = case.bench, LATENCY, 0.0
    adapts = bench.built.controller.deformation.adapts
    most, calm = max(2 * bench.share(bench.start), 0.1), bench.steps(bench.start)
    for cycles in range(1, LATENCY + 1):
        base = bench.run(latency=cycles)
        share, step = bench.share(base), bench.steps(base)
        left = without = math.inf
        if share <= most and step <= 2 * calm + 0.01:
            left = bench.pushed(PLACES[0], base=base, latency=cycles)[0].left
        if left <= 1 and adapts:
            plain = case.plain.run(latency=cycles)
            without = case.plain.share(plain)
            harms = _added(case, case.plain.errors(plain), bench.errors(base))[2]
        if left > 1 or harms > WORSE:
            borne = cycles - 1
            break
    numbers = {"cycles_borne": borne, "error": share, "mean_step": step, "mean_step_without": calm}
    numbers |= {n: v for n, v in (("left", left), ("error_without", without)) if v < math.inf}
    return Fact(graded(borne, LATENCY, -1), numbers)


def _left(case: Case) -> Fact | None:
    followed = hard_limits(case.problem, case.bench.nominal)
    if not followed:
        return None
    worst = max(followed, key=lambda one: float(one.beyond.max()))
    share, most = float((worst.beyond > TOLERANCE).mean()), float(worst.beyond.max())
    verdict = Verdict.YES if most <= TOLERANCE else Verdict.NO
    return Fact(verdict, {"beyond": most, "share_of_cycles": share}, worst.name)


def _inner(case: Case) -> Fact | None:
    problem, bench = case.problem, case.bench
    if sum(problem.plant.response_orders.values()) >= problem.plant.state.size or problem.integrator.steps_maps:
        return None
    rate, left = max(map(zero_dynamics, case.slopes(9))), bench.back.left
    held = Verdict.CAUTION if left <= 1 and bench.share(bench.nominal) <= 1 else Verdict.NO  # by the loop
    if rate * problem.duration <= math.log(2):
        return Fact(Verdict.YES, {"rate_with_outputs_held": rate})
    return Fact(held, {"rate_with_outputs_held": rate, "left": left})


def _noise(case: Case) -> Fact | None:
    if not case.problem.sensing.drawn:
        return None
    noisy, quiet = case.bench.start, case.bench.run(quiet=True)
    count, (lower, upper) = min(noisy.cycles, quiet.cycles), case.problem.limits.input_bounds(case.problem.plant)
    steps = np.diff(noisy["command"][:count] - quiet["command"][:count], axis=0)
    span = np.where(np.isfinite(upper - lower), upper - lower, np.maximum(np.ptp(quiet["command"], axis=0), 1e-300))
    chatter = np.sqrt((steps**2).mean(axis=0)) / span
    worst = int(chatter.argmax())
    shares = {"error_without_noise": case.bench.share(quiet), "error": case.bench.share(noisy)}
    numbers, verdict = {"rms_step": chatter[worst], **shares}, graded(chatter[worst], 0.01, math.inf)
    return Fact(verdict, numbers, list(case.problem.plant.inputs)[worst])


# Of adaptation


def _bias(case: Case) -> Fact | None:
    bench, plain, base = case.bench, case.plain, case.bench.start
    if not bench.sees_bias or not case.asks_more():
        return None
    size = float(max(np.ptp(base["plant_realised"], axis=0).max(), 1e-2 * np.abs(base["plant_realised"]).max())) or 1.0
    biased = bench.run(bias=0.01 * size)
    count = min(biased.cycles, base.cycles)
    added = np.abs((biased["true_error"][:count] - base["true_error"][:count])[count // 2 :]).mean(axis=0)
    slopes = dict(zip(case.problem.judged_names, added / (0.01 * size), strict=True))
    alone = plain.errors(plain.nominal)
    name = max(alone, key=lambda n: slopes[n] / max(bench.sizes[n], 1e-300))
    slope = slopes[name]
    even = alone[name] / slope if slope > 1e-12 else math.inf
    numbers = {"error_per_bias": slope, "bias_that_costs_the_gain": even, "share_of_the_response": even / size}
    if case.problem.sensing.drawn:  # what the sensors have may be a bias
        right, own, most = bench.share(bench.run(quiet=True)), bench.share(base), plain.share(plain.start)
        numbers |= {"error_with_right_sensors": right, "error": own}
        if right < most < own:
            return Fact(Verdict.NO, numbers, name)
    return Fact(graded(even / size, 0.02, 0.0), numbers, name)


def gain_by_run(case: Case) -> Fact:
    """Return errors at other gains of the map; recommended is half of the largest that comes back, or else the best."""
    case.asks_more()
    own, good, errors = case.bench, dict[float, bool](), dict[float, float]()
    useful = min(1.0, WORSE * case.plain.share(case.plain.counted) + SLIGHT)
    for times in (1.0, 0.5, 2.0, 4.0):
        if times < 1 and good[1.0]:  # it would only be slower
            continue
        try:
            bench = own if times == 1 else own.at_gain(times)
            errors[times] = own.share(bench.counted)
        except FpirhcError:  # refused by a schedule of slots
            errors[times] = math.inf
        calm = errors[times] <= useful and (times <= 1 or own.steps(bench.start) <= 2 * own.steps(own.start))
        good[times] = calm and bench.back.left <= 1
        if times > 1 and not good[times]:
            break
    if not any(good.values()):  # is its sign wrong?
        errors[-1.0] = own.share(own.at_gain(-1.0).counted)
        good[-1.0] = errors[-1.0] <= useful
    fine = [t for t in good if good[t]]
    most = max(fine, default=math.nan)
    best = max(most / 2, 1.0) if good[1.0] else min(fine, key=lambda t: errors[t], default=math.nan)
    names = {
        1.0: "error",
        0.5: "error_at_half",
        2.0: "error_at_twice",
        4.0: "error_at_four_times",
        -1.0: "error_turned",
    }
    numbers = {names[times]: e for times, e in errors.items()} | ({"recommended_times": best} if fine else {})
    some = Verdict.NO if fine else Verdict.UNKNOWN
    grade = (Verdict.YES if most >= 2 else Verdict.CAUTION) if good[1.0] else some
    return Fact(grade, numbers, change="Turn the sign of the gain." if -1.0 in fine else "")


def _added(
    case: Case, without: Mapping[str, float], adapted: Mapping[str, float], slight: float | None = None
) -> tuple[str, dict[str, float], float]:
    """The quantity that is made worse with most added, its errors, and how many times; `slight` is a share of the task."""
    sizes = {n: s for n, s in case.plain.sizes.items() if s and n in adapted}
    added = {n: math.inf if adapted[n] == math.inf else (adapted[n] - without[n]) / s for n, s in sizes.items()}
    if slight is None:
        most = (max((e[n] / s for n, s in sizes.items()), default=0.0) for e in (without, adapted))
        slight = MINOR * min(most)
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
    # More than it may cure.
    spoils = case.outside or numbers["error_with"] > case.plain.errors(case.plain.nominal)[name]
    no = spoils and ((harms > 2 and numbers["added"] > 0.01) or (harms > 10 and numbers["added"] > SLIGHT))
    return Fact(Verdict.NO if no else Verdict.CAUTION if harms > WORSE else Verdict.YES, numbers, name)


def _pays(case: Case) -> Fact:
    plain, own = case.plain.share(case.plain.nominal), case.bench.share(case.bench.nominal)
    if case.outside or min(plain, own) > BAD:
        why = "The plant is outside: ask fpirhc compare." if case.outside else "Neither follows: mend that first."
        return Fact(Verdict.UNKNOWN, {"share_without": plain, "share_with": own}, change=why)
    name, numbers, harms = _added(case, case.plain.errors(case.plain.nominal), case.bench.errors(case.bench.nominal))
    numbers["divided_by"] = plain / max(own, 1e-300)
    verdict = Verdict.NO if harms > WORSE or own > BAD else Verdict.YES if own < plain else Verdict.CAUTION
    return Fact(verdict, numbers, name)


QUESTIONS = (
    Question("turns", "Does an angle of the reference go on without jumps of a whole turn?", _turns,
             "The angle jumps by a whole turn: unwrap it (an angle that goes on), or weigh 1 - cos of its error.", "problem"),
    Question("posed", "Has the reference finite commands?", _posed,
             "Give it the derivatives that the plant's order needs, away from singular states.", "problem"),
    Question("orders", "Are the relative orders those of the plant?", _orders,
             "Write the response as the derivative that the input acts on.", "problem"),
    Question("inverse", "Can the response be inverted where it goes?", _inverse,
             "Keep the plant away from states where inputs lose their effect.", "problem"),
    Question("ranges", "Is it stated what working sensors show?", _ranges,
             "State it, so that a failed sensor is not believed: Sensor(range=(lower, upper)).", "problem"),
    Question("plans", "Are its plans good enough?", _plans,
             "Give the optimiser more iterations, or a smaller tolerance, before anything else."),
    Question("gain", "Is the gain admissible?", gain_by_run, "Use the recommended gain; without one, another form.", "adaptive"),
    Question("follows", "Does it follow the reference?", _follows,
             "Mend the loop without adaptation first: horizon, weights, limits, period."),
    Question("returns", "Does it come back from a push?", _returns,
             "Lower the rate of the tracking law, shorten the period, or state the dead time."),
    Question("horizon", "Is the horizon long enough?", _horizon, "Lengthen it, or weigh its end (LQRTerminal)."),
    Question("box", "Does it come back all over the box?", _box, "Narrow the box of the parameters, or lower the gain."),
    Question("input_gain", "Does it bear half and twice the gain of the inputs?", _gains,
             "Change the rate or the gain: the nearer of the two limits is too near."),
    Question("latency", "Does it bear three cycles of latency?", _latency,
             "Measure the latency and state it: Problem(dead_time=...)."),
    Question("limits", "Do states, rates and paths keep their limits?", _left,
             "Commands keep intervals of inputs and rates: slow the reference, or leave room."),
    Question("inner", "Do states without a task stay?", _inner, "Weigh them in the cost, or control another output."),
    Question("noise", "Is the chatter from noise small?", _noise, "Lower the gain, or filter its error: Filtered(map, pole=...)."),
    Question("bias", "Does it bear a bias of the measured response?", _bias,
             "Calibrate the sensor: a bias moves the plant.", "adaptive"),
    Question("model", "Does adaptation leave a right model alone?", _model,
             "Use ModelReferenced(map), or leave the deformation out.", "adaptive"),
    Question("pays", "Does adaptation lower the error?", _pays,
             "Leave it out, or compare gains: fpirhc study --over deformation.gain=...", "adaptive"),
)  # fmt: skip
ROOTS = ("turns", "posed", "plans", "gain")  # whose no is the cause of the others: their sentence stands there too
