"""The questions of a review: a row for each, with a function that measures something by runs, and which changes to try."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import with_field
from fpirhc.controllers.reference_states import needed_commands, whole_turns
from fpirhc.deformation.base import own_gain
from fpirhc.errors import NotSupported, require
from fpirhc.plant.chain import zero_dynamics
from fpirhc.plant.plant import Plant
from fpirhc.review import experiments
from fpirhc.review.experiments import BUSY, GOOD, LATE, LITTLE, SLIGHT, WORSE, Case, ladder, predictor, slips, with_gain
from fpirhc.simulation.ranges import TOLERANCE, hard_limits, misplaced
from fpirhc.simulation.trials import ModelAsPlant, spoils
from fpirhc.status import Status
from fpirhc.summary import in_percent, written_out
from fpirhc.symbolic.dotted import paths_to
from fpirhc.symbolic.driver import compiled_plans
from fpirhc.symbolic.expression import TINY

MINOR, ROUNDING, TIMID = 1e-3, 1e-6, 10.0  # added error, of the largest, and of the task; times it at a calm gain
NEAR, FAR, BAD = 0.2, 0.5, 1.0  # errors as shares of the task: it follows, it does not, and adaptation shows nothing
LEFT, SATURATED = experiments.LEFT, 0.2  # of a push; of cycles at a limit
MOSTLY, ROOM, OFFSET, FAILS = 0.5, 0.8, 0.8, 0.05  # shares: at a limit, of a limit, mean of rms, plans that fail
CALM, CHATTER = 0.1, 0.01  # step of a command a cycle: mean, rms from noise
TURNED = "Mend the sign of the inputs in the model: with those of the plant turned it follows."
GROWS = "{left:%} of the push is left after {pushed}| of one ten times as large {most_left:%}"
MODEL = "the model itself"  # among the trial plants
MOVES = "commands change by {mean_step:%} of their range in a cycle"
RINGS = "it swings every {period} {time}| a swing is {swing:%} of the last| commands are at limits in {at_a_limit:%} of cycles"
BEST = "| the relative error is {error:%}| {error_without:%} without adaptation| {error_recommended:%} at {recommended_gain:4}"
BUSIER = "it converges, but moves too much| the total variation of {of} is {movement:r}| {movement_without:r} without adaptation"
RESERVE = "it converges without reserve" + BEST + "| {error_at_twice:%} at twice the gain"
SAID = {1.0: "error", -1.0: "error_turned", 0.5: "error_at_half", 2.0: "error_at_twice", 4.0: "error_at_four_times"}
Numbers = Mapping[str, float]


class Verdict(StrEnum):
    """Yes is good in every question."""

    YES, CAUTION, NO, UNKNOWN = "yes", "caution", "no", "unknown"


class Fact(NamedTuple):
    """What was measured: numbers by fixed names, of one quantity; `change` in place of the row's sentence."""

    verdict: Verdict | None  # None: the question has no meaning here
    numbers: Numbers
    of: str = ""
    change: str = ""
    unit: str = ""  # where it is no unit of a followed quantity or an input
    ways: str = ""  # to try before those of the row
    root: bool = False  # whether a no is the cause of the others: its advice stands there too
    says: str = ""  # in place of the row's numbers, where others decide


@dataclass(frozen=True)
class Question:
    """A row of the table."""

    key: str
    text: str
    ask: Callable[[Case], Fact | None]  # None: the question has no meaning here
    says: str  # the numbers that decide in words, in parts behind "| " that are there where their numbers are
    change: str  # what to do where the answer is not good and no way passes
    ways: str = ""  # kinds of changes that are run
    of: str = "controller"  # or 'problem', which asks the loop of the first controller, or 'adaptive'


def _turns(case: Case) -> Fact | None:
    found = whole_turns(case.problem)
    return found and Fact(Verdict.NO if found[1] else Verdict.YES, {"jumps": found[1]}, found[0], root=True)


def _inside(case: Case) -> Fact | None:
    found = misplaced(case.problem)
    return Fact(Verdict.NO, {"outside": len(found)}, "; ".join(found), root=True) if found else None


def _noiseless(case: Case) -> Fact | None:
    sensing = case.problem.sensing
    # A bias is in no derivative.
    noise = {n: one.quantum or getattr(one.noise, "deviation", 0.0) for n, one in sensing.sensors.items()}
    noisy = {n for n, size in noise.items() if size} - {n.rstrip("'") for n in noise if "'" in n}
    found = [n for n in sensing.measures(case.problem.plant) if "'" in n and n.rstrip("'") in noisy]
    return Fact(Verdict.CAUTION, {"without": len(found)}, ", ".join(found)) if found else None


def _sizes(case: Case) -> Fact | None:
    found = [*slips(case.problem)]
    told, changes = "; ".join(one[0] for one in found), " ".join(one[1] for one in found)
    verdict = Verdict.NO if any("sensing" in one[2] for one in found) else Verdict.CAUTION  # noise hides all else
    return Fact(verdict, {"apart": len(found)}, told, changes, root=True) if found else None


def _follows(case: Case) -> Fact:
    bench, (name, share) = case.bench, case.bench.worst(case.bench.nominal)
    planner = bench.controller.planner  # whose cost may weigh no error
    far = share >= (BAD if planner and getattr(planner.cost or case.problem.cost, "tracked", None) is None else FAR)
    rms, errors = bench.errors(bench.nominal)[name], bench.nominal["true_error"]
    numbers = {"rms_error": rms, "error": share, "size": bench.sizes[name]}
    column, by = errors[bench.first(len(errors)) :, case.problem.judged_names.index(name)], predictor(bench.controller)
    offset = by is not None and not by.residual_time and abs(column.mean()) > OFFSET * rms and 0.01 < share < math.inf
    numbers |= {"mean_error": abs(column.mean())} if offset else {}  # of a wrong model in the prediction
    turned = bool(share > BAD and bench.share(bench.run(gain=-np.ones(len(case.problem.plant.inputs)))) <= NEAR)
    verdict = Verdict.NO if far else Verdict.CAUTION if offset or share > NEAR else Verdict.YES
    return Fact(verdict, numbers, name, TURNED * turned, root=turned)


def _saturates(case: Case) -> Fact | None:
    bench, run, plant, drawn = case.bench, case.bench.nominal, case.problem.plant, case.problem.sensing.drawn
    limits, names = np.array(bench.problem.limits.input_bounds(plant)), list(plant.inputs)
    if not run.cycles or not np.isfinite(limits).any():
        return None
    stuck, states = max(bench.draws, key=bench.held), run["plant_state"][bench.first(run.cycles) :]
    held, calm = bench.held(stuck), bench.held(bench.quiet if drawn else run)
    stands = bench.at_limits(stuck)[bench.first(stuck.cycles) :].mean(axis=0)
    known = case.problem.reality is None and not case.outside
    asked = needed_commands(case.problem, states, exact=known)
    beyond = np.maximum(limits[0] - asked, asked - limits[1])  # a share is then of half of the range
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.where(asked == 0, 0.0, asked / np.where(asked < 0, *limits))
        outside = beyond > ROUNDING * np.abs(asked).max(axis=0)
        size = np.where(np.isfinite(limits).all(axis=0), limits[1] - limits[0], 2 * np.abs(limits).min(axis=0))
        needs = np.where(outside, 1 + 2 * beyond / np.where(size > 0, size, np.inf), shares).max(axis=0)
    at = int((stands if held > SATURATED else np.nan_to_num(needs)).argmax())
    numbers = {"at_a_limit": held} | ({"at_a_limit_without_noise": calm} if drawn else {})
    if np.isfinite(needs[at]) and not plant.equations.hidden:
        ends, least, most = limits[:, at], asked[:, at].min(), asked[:, at].max()
        numbers |= {"needed": needs[at], "needed_least": least, "needed_most": most}
        numbers |= {"lower": ends[0], "upper": ends[1]} if np.isfinite(ends).all() else {}
    short = bool(2 * calm >= held and numbers.get("needed", 0.0) > ROOM)
    lost = held > MOSTLY and bench.share(run) > GOOD / 2  # a plant at rest below a sine has .35
    verdict = Verdict.NO if lost else Verdict.CAUTION if held > SATURATED else Verdict.YES
    return Fact(verdict, numbers, names[at], ways="model sign speed limits" * short, root=short)


def _returns(case: Case) -> Fact:
    bench = case.bench
    require(bench.held(bench.nominal) <= MOSTLY, "Commands stand at limits, so a push shows nothing: mend that first.")
    back, far, step = bench.back, bench.along[0], bench.steps(bench.start)
    worst, swings = max(one.factor for one in bench.along), far if all(one.grows for one in bench.along) else back
    stuck = max(back.held, far.held)
    calm = not swings.rings and back.left <= GOOD and worst < 1 and step <= CALM
    verdict = Verdict.YES if calm else Verdict.NO if bench.lost or swings.grows else Verdict.CAUTION
    numbers = {"left": back.left, "left_of_ten_times": far.left, "factor": back.factor, "largest_factor": worst}
    numbers |= {"swing": swings.swing, "period": swings.cycles * case.problem.period} if swings.swing else {}
    numbers |= {"mean_step": step} | ({"at_a_limit": stuck} if stuck else {})
    numbers |= {"most_left": max(one.left for one in bench.along)} if worst >= 1 else {}
    says = (GROWS * (worst >= 1) or MOVES * (step > CALM)) * (back.left <= GOOD) or RINGS * swings.rings
    ways = "estimator " * swings.rings + "limits" * (stuck > max(SATURATED, bench.held(bench.start)))
    return Fact(verdict, numbers, ways=ways, root=swings.grows, says=says)


def _plans(case: Case) -> Fact | None:
    bench = case.bench
    if bench.controller.planner is None or not bench.nominal.cycles:
        return None
    optimiser: Any = getattr(bench.controller.planner, "optimiser", None)
    longer = {n: 8 * k for n in ("iterations", "most_iterations") if (k := getattr(optimiser, n, None)) is not None}
    longer |= {"tolerance": optimiser.tolerance / 10} if longer and getattr(optimiser, "tolerance", None) else {}
    other = with_field(bench.controller, "optimiser", replace(optimiser, **longer)) if longer else None
    more = other and case.other(other, short=True)
    share = float(np.mean(bench.nominal["status"] == Status.NOT_CONVERGED))
    own, long = bench.share(bench.start), more.share(more.start) if more else math.inf
    better = (long < own / WORSE and own - long > SLIGHT) or (share > FAILS and not more)
    verdict = Verdict.NO if own > GOOD >= long else Verdict.CAUTION if better else Verdict.YES
    numbers = {"not_converged": share, "error": own, "error_with_more_iterations": long}
    return Fact(verdict, numbers if more else {"not_converged": share}, root=True)


def _horizon(case: Case) -> Fact | None:
    bench, horizon = case.bench, case.problem.horizon
    if horizon is None or bench.controller.planner is None:
        return None
    short = bench.start.first(bench.cycles // 2)
    numbers = {"error": (own := bench.share(short))}
    if own <= SLIGHT:  # there is nothing that a longer one could mend
        return Fact(Verdict.YES, numbers)
    lengths = (*horizon.lengths, *horizon.lengths[-1:] * horizon.stages)
    longer = replace(horizon, stages=2 * horizon.stages, blocks=2 * horizon.blocks, lengths=lengths)
    with compiled_plans(yes=False):  # a loop for one run
        run = replace(bench, problem=replace(bench.problem, horizon=longer)).run(cycles=short.cycles)
    numbers |= {"error_with_twice_the_horizon": (long := bench.share(run))}
    helps = long < own / WORSE and own - long > SLIGHT
    numbers |= {"recommended_stages": longer.stages} if helps else {}
    verdict = Verdict.YES if not helps else Verdict.NO if own > BAD >= long else Verdict.CAUTION
    return Fact(verdict, numbers, change=f"Give the horizon {longer.stages} stages." * helps)


def _box(case: Case) -> Fact | None:
    bench, found, plant = case.bench, list[tuple[float, float]](), case.problem.plant
    if bench.built.controller.exact_model or case.problem.reality is not None or not len(case.draws):  # a bound alone
        return None
    for exact in case.draws:
        base = bench.run(exact=exact)
        found.append((bench.pushed(base=base, exact=exact)[0].left, bench.share(base)))
    lost = [_called(plant, exact) for exact, one in zip(case.draws, found, strict=True) if max(one) > 1]
    good, most = 1 - len(lost) / len(found), np.max(found, axis=0)
    verdict = Verdict.YES if good == 1 else Verdict.CAUTION if good else Verdict.NO
    numbers = {"share_that_come_back": good, "plants": len(found), "left": most[0], "error": most[1]}
    told, ways = f"{len(lost)} of {len(found)} trial plants{': ' * bool(lost)}{'; '.join(lost)}", "estimator"
    return Fact(verdict, numbers, told, ways=ways * (MODEL in lost))


def _called(plant: Plant, exact: np.ndarray) -> str:
    """Which trial plant it is: the model, that between, or by how much its parameters are larger than the exact ones."""
    known = {MODEL: plant.approximate, "the one half way to it": (plant.exact + plant.approximate) / 2}
    away = {n: v / e - 1 for n, v, e in zip(plant.parameters, exact, plant.exact, strict=True) if e not in (0, v)}
    told = [f"{n} {in_percent(abs(by))} {'larger' if by > 0 else 'smaller'}" for n, by in away.items()]
    some = f"one with {', '.join(told[:4])}{' ...' * (len(told) > 4)}"
    return next((name for name, one in known.items() if np.array_equal(one, exact)), some)


def _gains(case: Case) -> Fact:
    runs = {gain: case.bench.pushed(gain=gain)[0] for gain in (0.7, 1.4)}
    lost = [g for g, run in runs.items() if run.left > 1 or run.steps > BUSY * max(CALM, case.bench.back.steps)]
    least, most = (1.0 if gain in lost else gain for gain in runs)
    says = f"with {' and '.join(map(str, lost))} times their gain a push grows or the movement doubles" * bool(lost)
    return Fact(Verdict.CAUTION if lost else Verdict.YES, {"most": most, "least": least}, says=says)


def _latency(case: Case) -> Fact:
    bench, plain, told, bears, cycles = case.bench, case.plain, dict[str, float](), 0, 0
    calm, most = bench.steps(bench.start), max(2 * bench.share(bench.start), 0.1)
    for cycles in (1, 3, LATE):
        base = bench.run(latency=cycles)
        numbers = {"error": bench.share(base), "mean_step": bench.steps(base), "mean_step_without": calm}
        fine = numbers["error"] <= most and numbers["mean_step"] <= BUSY * max(CALM / 20, calm)
        if fine:
            numbers["left"] = bench.pushed(base=base, latency=cycles)[0].left
            fine = numbers["left"] <= min(max(2 * bench.back.left, LEFT), 1.0)
        if fine and bench.built.controller.deformation.adapts:
            numbers["error_without"] = plain.share(alone := plain.run(latency=cycles))
            fine = _added(case, plain.errors(alone), bench.errors(base), SLIGHT)[2] <= WORSE
        bears, told = (cycles, numbers) if fine else (bears, told or numbers)
        if not fine:
            break
    return Fact(Verdict.YES if bears else Verdict.CAUTION, {"bears": bears, "cycles": cycles} | told)


def _left(case: Case) -> Fact | None:
    followed = hard_limits(case.problem, case.bench.nominal)
    if not followed:
        return None
    worst = max(followed, key=lambda one: float(one.beyond.max()))
    most, at = float(worst.beyond.max()), int(worst.beyond.argmax())
    excess = max(worst.values[at] - worst.upper, worst.lower - worst.values[at], 0.0)
    numbers = {"share_of_cycles": float((worst.beyond > TOLERANCE).mean())}
    numbers |= {"excess": excess, "beyond": most, "time_of_it": at * case.problem.period} if most > 0 else {}
    return Fact(Verdict.YES if most <= TOLERANCE else Verdict.NO, numbers, worst.name, unit=worst.unit)


def _inner(case: Case) -> Fact | None:
    problem, bench, run, plant = case.problem, case.bench, case.bench.nominal, case.problem.plant
    if sum(plant.response_orders.values()) >= plant.state.size or plant.step is not None:
        return None
    require(run.cycles, "It ends in its first cycle.")
    at = np.linspace(0, run.cycles - 1, 9).astype(int)
    rate, left = max(zero_dynamics(plant, run["plant_state"][k], run["command"][k]) for k in at), bench.back.left
    rate = 0.0 if abs(rate) * problem.duration < ROUNDING else rate
    held = Verdict.CAUTION if left <= 1 and bench.share(bench.nominal) <= 1 else Verdict.NO  # by the loop
    numbers = {"rate_with_outputs_held": rate}
    if rate * problem.duration <= math.log(2):
        return Fact(Verdict.YES, numbers)
    own = case.plain.back.left > 1  # and adaptation is not what loses it
    return Fact(held, numbers | {"left": left}, ways="" if own else "gain no_adaptation", root=own)


def _noise(case: Case) -> Fact | None:
    if not case.problem.sensing.drawn:
        return None
    bench, quiet = case.bench, case.bench.quiet
    noisy = max((run.first(bench.cycles) for run in bench.draws), key=bench.steps)
    count = min(noisy.cycles, quiet.cycles)
    steps = np.diff((noisy["command"][:count] - quiet["command"][:count])[bench.first(count) :], axis=0)
    size = np.sqrt((steps**2).mean(axis=0))
    worst = int((size / bench.span).argmax())
    step, (moves, calm) = size[worst] / bench.span[worst], (bench.moves(run)[worst] for run in (noisy, quiet))
    numbers = {"rms_step": step, "times": moves / max(calm, TINY), "movement": moves, "movement_without_noise": calm}
    verdict = Verdict.CAUTION if step > CHATTER and moves > BUSY * calm else Verdict.YES
    return Fact(verdict, numbers, list(case.problem.plant.inputs)[worst])


def set_gain(controller: Controller, times: float) -> str:
    """What to write for so many times the gain: by a path that `--set` takes, where the gain is a number of its own."""
    name, value = own_gain(controller.deformation)
    paths = (path.replace(".map", "") for path in paths_to(name, controller, 9) if "deformation." in path)
    return f"Set {' and '.join(paths) or f'the {name}'} to {times * value:.4g}.{' The present sign is wrong.' * bool(times < 0)}"


def recommended_gain(case: Case) -> Fact:
    """What a run shows of the gain, and another one to take, with which its own review says yes."""
    fact, controller, good = gain_by_run(case)._replace(root=True), case.bench.controller, None
    times, seen = fact.numbers.get("recommended_times", 1.0), [1.0]
    rungs, right = ladder(case).rungs, fact.verdict == Verdict.YES
    if times == 1.0 or (right and not (times > 1 and rungs[1.0].error > max(SLIGHT, TIMID * rungs[times].error))):
        return fact
    while times and times not in seen:
        other, shared = with_gain(controller, times), (case.draws, case.outside, case.known)
        then = gain_by_run(at := Case.of(case.problem, other, *shared, seed=case.bench.seed))
        good = (times, ladder(at).rungs[1.0]) if then.verdict == Verdict.YES else good
        seen, times = [*seen, times], times * then.numbers.get("recommended_times", 0.0)
    numbers = {name: v for name, v in fact.numbers.items() if not name.startswith("recommended")}
    if not good:
        return fact if right else fact._replace(numbers=numbers, ways="model gain")
    (times, rung), worst = good, list(case.problem.plant.inputs).index(fact.of)
    numbers |= {"recommended_times": times, "recommended_gain": times * own_gain(controller.deformation)[1]}
    numbers |= {"error_recommended": rung.error, "movement_recommended": rung.moves[worst]}
    change = set_gain(controller, times) + price(numbers["error"], rung.error) * ladder(case).rungs[1.0].admitted
    told: Any = {"ways": "model gain" * any(slips(case.problem)), "says": fact.says or "a larger gain is better" + BEST}
    return fact._replace(verdict=Verdict.CAUTION if right else fact.verdict, numbers=numbers, change=change, **told)


def price(before: float, after: float) -> str:
    """What an advice costs, in words."""
    times = after / max(before, TINY)
    return f" The error is then {written_out(times)} times as large." if times > 1.05 else ""


@lru_cache(maxsize=64)
def gain_by_run(case: Case) -> Fact:
    """Return errors at other gains, and the best of the gains that were run, as a multiple."""
    found, plain = ladder(case), case.plain
    rungs, own, best, before = found.rungs, found.rungs[1.0], found.best, plain.moved
    value = own_gain(case.bench.controller.deformation)[1]
    right, calm = own.good and own.admitted, 1.0 in found.calm
    spare = 1.0 in found.spare and (best <= 1 or rungs[0.5].error <= 2 * found.alone)
    if right and np.ptp([found.alone, *(one.error for one in rungs.values() if one.good)]) <= ROUNDING * own.error:
        raise NotSupported("Every gain has the error of none: the run has nothing that adaptation corrects.")
    if right and best and best not in found.calm:  # it has to be better and calmer than today's
        best *= rungs[best].error <= LITTLE * own.error and (rungs[best].moves <= own.moves).all()
    worst = int((own.moves / np.maximum(before, TINY)).argmax())
    of = list(case.problem.plant.inputs)[worst]
    numbers = {SAID[times]: one.error for times, one in rungs.items() if times in SAID} | {"error_without": found.alone}
    numbers |= {"movement": own.moves[worst], "movement_without": before[worst]}
    ratio, reserve = (rungs[best].error / max(own.error, TINY), best in found.spare) if best else (math.inf, False)
    poor = not calm or not (spare or (reserve and ratio > WORSE))  # its reserve may cost too much
    verdict = Verdict.CAUTION if poor else Verdict.YES
    if not right:
        verdict = Verdict.NO if best or found.alone <= GOOD else Verdict.UNKNOWN
    elif calm and ratio > (WORSE if reserve and not spare else LITTLE):
        less = best and case.problem.sensing.drawn and (rungs[best].moves <= LITTLE * own.moves).all()
        best = best if less and not poor else 1.0
    why = "it harms" if own.error >= found.alone else "a push grows" if own.admitted else "it is refused"
    says = why + BEST if not right else (RESERVE if calm else BUSIER) * poor
    if own.turned:  # also where a turned gain works
        return Fact(Verdict.NO, numbers, of, f"{own.turned}.", says="it is refused")
    if verdict != Verdict.YES and best in (0.0, 1.0):
        tried = min(rungs, key=lambda times: rungs[times].error)
        numbers |= {"best_gain": tried * value, "error_at_best": rungs[tried].error}
        first = "Mend the loop without adaptation first." * (verdict == Verdict.UNKNOWN)
        return Fact(verdict, numbers, of, first, says=says)
    return Fact(verdict, numbers | {"recommended_times": best, "recommended_gain": best * value}, of, says=says)


def _added(case: Case, without: Numbers, adapted: Numbers, slight: float = 0.0) -> tuple[str, dict[str, float], float]:
    """The quantity that is made worse with most added, its errors, and how many times; `slight` is a share of the task."""
    sizes = {n: s for n, s in case.plain.sizes.items() if s and n in adapted}
    added = {n: math.inf if adapted[n] == math.inf else (adapted[n] - without[n]) / s for n, s in sizes.items()}
    slight = slight or MINOR * min(max((e[n] / s for n, s in sizes.items()), default=0.0) for e in (without, adapted))
    counted = [n for n, share in added.items() if share > slight and adapted[n] > ROUNDING * sizes[n]]
    times = {n: adapted[n] / max(without[n], TINY) for n in counted}
    name = max(added, key=lambda n: (times.get(n, 0.0) > WORSE, added[n]), default=next(iter(adapted)))
    numbers = {"error_without": without[name], "error_with": adapted[name], "added": added.get(name, 0.0)}
    return name, numbers, times.get(name, 0.0)


def _model(case: Case) -> Fact:
    task = ModelAsPlant(case.problem, seed=case.bench.seed).of(case.bench.built.controller)
    benches = [case.other(one.controller, model=task) for one in (case.plain, case.bench)]
    runs = [one.run(cycles=one.whole, disturbed=False) for one in benches]
    stuck = min(one.held(run) for one, run in zip(benches, runs, strict=True))
    require(stuck <= MOSTLY, "With the model as plant the command stands at a limit: run it where commands are free.")
    without, adapted = (one.errors(run) for one, run in zip(benches, runs, strict=True))
    name, numbers, harms = _added(case, without, adapted, SLIGHT)
    cured, error = case.plain.errors(case.plain.nominal)[name], numbers["error_with"]
    no = not case.outside and spoils(harms, numbers["added"], error, cured)
    caution = harms > WORSE and (case.outside or error > cured)
    return Fact(Verdict.NO if no else Verdict.CAUTION if caution else Verdict.YES, numbers, name)


def _pays(case: Case) -> Fact:
    plain, own = case.plain.share(case.plain.nominal), case.bench.share(case.bench.nominal)
    require(min(plain, own) <= BAD, "Neither follows: mend that first.")
    name, numbers, harms = _added(case, case.plain.errors(case.plain.nominal), case.bench.errors(case.bench.nominal))
    numbers["divided_by"] = plain / max(own, TINY)
    verdict = Verdict.YES if own < max(plain, SLIGHT) else Verdict.CAUTION  # a small one is nothing to mend
    return Fact(Verdict.NO if harms > WORSE or own > BAD else verdict, numbers, name)


QUESTIONS = (
    Question("sizes", "Do parameters, reference, limits and noise agree in sign and units?", _sizes, "{of}", "", of="problem"),
    Question("inside", "Do start and reference keep the hard limits of states?", _inside, "{of}", "Move them inside, or widen the "
             "limits.", "model", "problem"),
    Question("turns", "Does an angle of the reference go on without jumps of a whole turn?", _turns, "{jumps} of {of}", "Unwrap "
             "the angle that jumps by a whole turn, or weigh 1 - cos of its error.", of="problem"),
    Question("noiseless", "Has what is derived from a noisy or rounded quantity its noise, too?", _noiseless, "none is stated of "
             "{of}", "State what computes it from the samples: Sensing(sensors, SavitzkyGolay(15, degree=2)).", of="problem"),
    Question("plans", "Are its plans good enough?", _plans, "{not_converged:%} did not converge| the relative error is {error:%}| "
             "{error_with_more_iterations:%} with 8 times the iterations", "Give the optimiser more iterations, or a smaller "
             "tolerance, before anything else."),
    Question("input_limits", "Do the input limits fit the task?", _saturates, "a command or its change is at a limit in "
             "{at_a_limit:%} of the cycles| in {at_a_limit_without_noise:%} without noise| the reference needs {needed_least} to "
             "{needed_most:u} of {of}| and its limits are {lower} to {upper:u}", "", "model gain rate weight estimator "
             "prediction limits speed"),
    Question("gain", "Is the gain admissible?", recommended_gain, "it converges and helps" + BEST, "No gain that was run "
             "helps, is calm, and has reserve.", "model filter form lag prediction estimator sensors no_adaptation", "adaptive"),
    Question("follows", "Does it follow the reference?", _follows, "the rms error of {of} is {rms_error:u}| {error:%} of its "
             "motion, {size:u}| in the mean {mean_error:u}", "", "residual_time deviation model gain lag no_adaptation rate weight "
             "estimator prediction observer limits speed"),
    Question("returns", "Does it come back from a push?", _returns, "{left:%} of the push is left after {pushed}", "", "model gain "
             "lag rate weight estimator prediction form no_adaptation limits"),
    Question("horizon", "Is the horizon long enough?", _horizon, "the relative error is {error:%}| "
             "{error_with_twice_the_horizon:%} with twice the stages", ""),
    Question("box", "Does it come back for every plant in the range of the parameters?", _box, "it is lost on {of}",
             "Identify the parameters better.", "gain rate weight limits no_adaptation", of="loop"),
    Question("input_gain", "Does it bear 0.7 and 1.4 times the gain of the inputs?", _gains, "it bears {least} to {most} times "
             "their gain", "", "gain form rate weight estimator", of="loop"),
    Question("latency", "Does it bear a cycle of delay that nobody stated?", _latency, "it bears {bears} cycles, run with up "
             "to {cycles}| the relative error is then {error:%}| {error_without:%} without adaptation| {left:%} of a push is left| "
             "commands change by {mean_step:%} of their range in a cycle| {mean_step_without:%} without delay", "Run it where no "
             "command is late.", "gain form rate weight estimator", of="loop"),
    Question("limits", "Do states, rates and paths keep their limits?", _left, "a limit of {of} is left in {share_of_cycles:%} of "
             "the cycles| by at most {excess:u}", "Leave room: commands keep limits of inputs and their rates alone.", "gain rate "
             "weight speed"),
    Question("inner", "Are the zero dynamics stable?", _inner, "the largest real part is {rate_with_outputs_held} 1/{time}",
             "States without a task go off: weigh them in the cost, or control another output."),
    Question("noise", "Is the movement from noise small?", _noise, "noise moves {of} by {rms_step:%} of its motion in a "
             "cycle| and makes it move {times} times as much: {movement:r}| {movement_without_noise:r} without noise", "Measure "
             "the response with less noise.", "model gain filter estimator rate weight"),
    Question("model", "Would it do little harm if the model were right?", _model, "then, with the problem's sensors, the rms error "
             "of {of} is {error_without:u} without adaptation| {error_with:u} with it", "A run on the plant decides.", "form "
             "estimator gain filter no_adaptation", "adaptive"),
    Question("pays", "Does adaptation lower the error, or leave it small?", _pays, "the rms error of {of} is {error_without:u} "
             "without adaptation| {error_with:u} with it", "", "gain form lag estimator prediction sensors no_adaptation",
             "adaptive"),
)  # fmt: skip
