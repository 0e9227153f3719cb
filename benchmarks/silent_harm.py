"""Random loops that adaptation harms, and what a review says of them: none may be harmed and called ready.

    python benchmarks/silent_harm.py [--count 300] [--jobs 2]      ten minutes; --only 137: this one, with its review

Exact parameters of a shipped or of a small random problem move by half, with some of: dead time, lags of actuators,
friction and a load on a spring, noise or bias of sensors, limits of inputs; the problem states it, the model does not.
Untold is at times a lag or a gain, which a caution must name, or else advise no adaptation. Harmed: an error above 1.2 times
that without, or lost alone, in runs of another seed. Healthy: none above 1.1 times, all below .25 of the task, seldom at limits.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import warnings
from collections import Counter
from contextlib import suppress
from dataclasses import replace
from functools import wraps
from typing import Any

import casadi as ca
import joblib
import numpy as np

import fpirhc as fp

HARMED, NEUTRAL, GOOD, HELD, ROUNDING, MINOR, GROWING = 1.2, 1.1, 0.25, 0.2, 1e-6, 0.01, ("factor", "largest_", "left")
SMALL = 20  # times as often as one of these, whose durations are in their own unit of time
SHIPPED = {"leaking_tanks": 300.0, "two_tanks_slots": 300.0, "crane_slots": 13.0, "mass_spring_slots": 2.0, "planar_arm": 2.0,
           "mrac_pendulum": 4.0, "van_der_pol_duffing": 4.0, "van_der_pol": 2.0, "problems/gallery/anaesthesia.py": 60.0,
           "problems/gallery/fishery.py": 60.0}  # fmt: skip


def small(random: np.random.Generator) -> tuple[fp.Problem, Any]:
    """One or two coordinates of order one or two with springs, drag and a link; RHC or CTC, with a map in some form."""
    n, order = (int(k) for k in random.integers(1, 3, 2))
    each, ends = range(n), {"m": (0.5, 2), "k": (-2, 8), "c": (0, 3), "bend": (0, 4), "link": (-2, 2)}
    given = {f"{n}{k}": fp.Parameter(*[float(random.uniform(*e))] * 2, "1") for n, e in ends.items() for k in each}
    size, speed, rests = random.uniform(0.2, 1, n).tolist(), random.uniform(1, 4, n).tolist(), random.uniform() < 0.25

    def force(q, v, u, p, k):
        own, m, k_, c, bend, link = q[f"q{k}"], *(p[f"{n}{k}"] for n in ends)
        return (u[f"u{k}"] - k_ * own - c * v[f"q{k}"] - bend * own**3 + link * (q[f"q{n - 1 - k}"] - own)) / m

    inputs, all_of = {f"u{k}": "N" for k in each}, lambda *given: {f"q{k}": force(*given, k) for k in each}
    response = (lambda q, u, p: all_of(q, q, u, p)) if order == 1 else (lambda q, v, u, p: all_of(q, v, u, p))
    plant = fp.Plant({f"q{k}": "m" for k in each}, inputs, given, response, order=order)
    path = (lambda w, t: 1 - ca.exp(-((w * t) ** 2))) if rests else (lambda w, t: ca.sin(w * t))
    motion, start = lambda t: {f"q{k}": size[k] * path(speed[k], t) for k in each}, dict.fromkeys(plant.names, 0.0)
    weights = {s: 1.0 if "'" in s else 100.0 for s in plant.state.elements}
    plans = {"horizon": fp.Horizon(10, 0.04), "cost": fp.Quadratic(weights, deviation=dict.fromkeys(inputs, 1e-2))}
    gain, law = -float(random.uniform(0.1, 1.2)), fp.Exponential(float(random.uniform(4, 10)))
    form = (fp.Affine(gain), fp.Sigmoid(gain, scale=20.0), fp.RFPT(1e4, -1, -1e-4 * gain))[random.integers(3)]
    forms = form, fp.Filtered(form, pole=0.7), fp.ModelReferenced(form), fp.ModelReferenced(form, cycles=0)
    plain = fp.ComputedTorque(law) if random.uniform() < 0.6 else fp.RecedingHorizon(fp.FixedPointSolver(iterations=2))
    pair = plain, plain.with_deformation(forms[random.integers(4)])
    return fp.Problem(plant, fp.Trajectory(motion), start, period=0.01, duration=5.0, measure_from=2.0, **plans), pair


def loaded(plant: fp.Plant, random: np.random.Generator) -> fp.Plant:
    """A small plant of order two with friction, and a load on a spring beside its first coordinate."""
    friction, stiff, mass = (10 ** random.uniform((-2, 1.5, -1.5), (-0.3, 2.5, -0.5))).tolist()

    def response(q, v, u, p):
        own, pull = plant.response(q, v, u, p), stiff * (q.load - q.q0) + np.sqrt(stiff * mass) / 10 * (v.load - v.q0)
        return {**own, "q0": own["q0"] + (pull - friction * ca.tanh(v.q0 / 0.02)) / p.m0, "load": -pull / mass}

    return replace(plant, coordinates={**plant.coordinates, "load": "m"}, response=response, order=2, controlled=None)


def lagging(problem: fp.Problem, cycles: np.ndarray) -> fp.Problem:
    """What moves, behind actuators with lags of so many cycles, each at rest at first."""
    real = problem.reality or fp.Reality(problem.plant)
    plant, inputs, lags = real.plant, [*real.plant.inputs], problem.period * cycles
    acting = {f"{n}_{len(plant.names)}": unit for n, unit in plant.inputs.items()}  # not as a lag before it

    @wraps(plant.response)
    def response(*of):
        *motion, u, p = of
        arrived = type(u)(inputs, ca.vertcat(*(motion[0][a] for a in acting)))
        rates = {a: (u[n] - arrived[n]) / lag for a, n, lag in zip(acting, inputs, lags, strict=True)}
        return {**plant.response(*motion, arrived, p), **rates}

    order = dict(zip(plant.names, plant.orders, strict=True)) | dict.fromkeys(acting, 1)
    known = {"coordinates": {**plant.coordinates, **acting}, "response": response, "order": order}
    slower = replace(plant, **known, controlled=None, inverse=None)
    rest = dict(zip(acting, map(float, problem.inputs_before), strict=True))
    return replace(problem, reality=fp.Reality(slower, {**real.start, **rest}))


def sensed(problem: fp.Problem, run: fp.Run, random: np.random.Generator) -> fp.Problem:
    """With a bias or noise of some sensors, by shares of the range of what they show."""
    spans = np.append(np.ptp(run["plant_state"], axis=0), np.ptp(run["realised"], axis=0))
    sizes = 10 ** random.uniform(-4.5, -1.3, len(spans)) * spans * (random.uniform(size=len(spans)) < 0.6)
    noises = [fp.Step(at=0.0, size=v) if random.uniform() < 0.5 else fp.Noise(0.3 * v) for v in sizes.tolist()]
    shown = zip(problem.sensing.measures(problem.plant), noises, sizes, strict=False)
    return replace(problem, sensing=fp.Sensing({s: fp.Sensor(noise) for s, noise, size in shown if size > 0}))


def limited(problem: fp.Problem, run: fp.Run, room: float) -> fp.Problem:
    """With limits of the inputs at so many times the range that a run without them uses."""
    ends = np.array([run["command"].min(axis=0), run["command"].max(axis=0)])
    ends = np.clip(ends.mean(axis=0) + room * (ends - ends.mean(axis=0)), *problem.limits.input_bounds(problem.plant))
    inputs = dict(zip(problem.plant.inputs, map(tuple, ends.T.tolist()), strict=True))
    return replace(problem, limits=replace(problem.limits, inputs=inputs))


def variant(seed: int, attempt: int) -> tuple[str, fp.Problem, fp.Problem, Any, set[str]]:
    """What the review is told, what moves, the controllers without and with adaptation, and who must name the rest."""
    random = np.random.default_rng([seed, attempt])
    some, name = (lambda share: random.uniform() < share), str(random.choice([*SHIPPED, *["small"] * SMALL]))
    if name == "small":
        problem, pair = small(random)
    else:
        task, lasts = fp.load_problem(name), SHIPPED[name]
        problem = replace(task.problem, duration=lasts, measure_from=min(task.problem.measure_from, lasts / 2))
        pair = [task.controllers[n] for n in task.headline]
    plant, inputs, own, said = problem.plant, problem.plant.inputs, name == "small", list[str]()
    exact = np.array([np.clip(p.exact * random.uniform(0.5, 1.5), *p.bounds) for p in plant.parameters.values()])
    problem = problem.with_exact(exact)
    run = fp.simulate(problem, pair[0], seed=0, compiled=False)
    late = float(random.choice([0.5, 1, 2, 3])) * problem.period
    dead_times = fp.DeadTime(dict.fromkeys(inputs, late)), fp.DeadTime(measurement=late)
    if own and plant.orders[0] == 2 and some(0.25):
        real = fp.Reality(loaded(problem.plant, random), {"load": 0.0, "load'": 0.0})
        problem, said = replace(problem, reality=real), [*said, "load"]
    if some(0.3):
        problem, said = lagging(problem, random.uniform(0.4, 5.0, len(inputs))), [*said, "lag"]
    if some(0.3):
        problem, said = replace(problem, dead_time=dead_times[some(0.4)]), [*said, "dead time"]
    if some(0.35) and problem.sensing.ideal:
        problem, said = sensed(problem, run, random), [*said, "sensors"]
    if some(0.25):
        problem, said = limited(problem, run, random.uniform(0.7, 1.5)), [*said, "limits"]
    moves, untold = problem, set[str]()
    if own and some(0.1):
        factors = [random.choice([0.5, 0.7, 2.0]) if n.startswith("m") else 1.0 for n in plant.parameters]
        moves, untold, said = problem.with_exact(exact * factors), {"input_gain", "gain"}, [*said, "untold gain"]
    elif some(0.1):
        moves = lagging(problem, np.full(len(inputs), random.uniform(0.5, 3)))
        untold, said = {"latency"}, [*said, "untold lag"]
    return f"{name}: {', '.join(said) or 'parameters'}", problem, moves, pair, untold


def judged(problem: fp.Problem, pair: Any) -> tuple[float, bool, str]:
    """The largest ratio of an error with adaptation to that without, whether the run with it is good, and errors."""
    runs = [fp.simulate(problem, c, seed=1, compiled=False) for c in pair]
    names, plain, measured = problem.judged_names, runs[0], [fp.measure(problem, run) for run in runs]
    motion = plain["plant_output" if "plant_output" in plain.layout else "plant_state"]
    wanted = plain["true_error"] + motion[:, [problem.plant.output.elements.index(n) for n in names]]
    sizes = np.fmax(np.ptp(wanted, axis=0), np.abs(plain["true_error"][0])).tolist()
    rms = [m.rms_error if r.stop is None else dict.fromkeys(names, np.inf) for m, r in zip(measured, runs, strict=True)]
    planner = pair[1].planner
    cost = (planner.cost or problem.cost) if planner else None
    weighed = {n.rstrip("'") for n in (cost.tracked if cost else None) or ()} & {*names} or names
    counted = [(n, s) for n, s in zip(names, sizes, strict=True) if n in weighed and s]
    shares = np.array([[errors[n] / size for n, size in counted] for errors in rms])
    before, after = shares[:, shares.max(axis=0) > max(ROUNDING, MINOR * shares.max(axis=1).min())]
    ratios = [b / max(a, 1e-300) if np.isfinite(a) else 0.0 for a, b in zip(before, after, strict=True)]
    good = shares[1].max(initial=0.0) <= GOOD and measured[1].get("at_limit", {}).get("", 0.0) < HELD
    return max(ratios, default=0.0), bool(good), f"shares of the task {before} -> {after}"


def asked(seed: int, loud: bool = False) -> tuple[str, str, list[str], str]:
    """What became of a variant, what the review of its controller with adaptation says, what is wrong, and a line."""
    warnings.simplefilter("ignore")
    for attempt in itertools.count():
        with suppress(fp.FpirhcError):  # refused: another one is drawn
            name, told, moves, pair, untold = variant(seed, attempt)
            ratio, good, errors = judged(moves, pair)
            break
    found = fp.review(told, {"adaptive": pair[1]}, mismatch=0.0, seed=0).answers
    answers = {a.key: a for some in found.values() for a in some}
    if loud:
        print(pair[1], *(f"{a.verdict}: {k}: {a.evidence}" for k, a in answers.items()), sep="\n")
    yes, no, caution = ([k for k, a in answers.items() if a.verdict == said] for said in ("yes", "no", "caution"))
    fate = "harmed" if ratio > HARMED else "healthy" if ratio <= NEUTRAL and good and not untold else "other"
    wrong = {
        "silent": fate == "harmed" and not no and not (untold and {*untold, "pays"} & {*caution}),
        "a no": fate == "healthy" and bool(no),
        "growing": any(v > 1 for k in yes for n, v in answers[k].numbers.items() if n.startswith(GROWING)),
    }
    line = f"{seed}, {fate}: {name}: {errors}; no: {no}; caution: {caution}"
    return fate, "no" if no else "caution" if caution else "yes", [w for w, there in wrong.items() if there], line


def main() -> None:
    """Print what is wrong with its seed, then the table; exit code 1 where it is too much."""
    words = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    for name, usual in {"count": 300, "jobs": 2, "only": None}.items():
        words.add_argument(f"--{name}", type=int, default=usual)
    options = words.parse_args()
    if options.only is not None:
        print(*asked(options.only, loud=True), sep="\n")
        return
    work, counts = joblib.Parallel(options.jobs, return_as="generator_unordered"), Counter[Any]()
    for fate, said, wrong, line in work(map(joblib.delayed(asked), range(options.count))):
        counts.update([fate, (fate, said), *wrong])
        if wrong:
            print(f"{', '.join(wrong)}: {line}", flush=True)
    for fate in ("harmed", "healthy", "other"):
        print(f"{fate}:", ", ".join(f"{counts[fate, said]} {said}" for said in ("yes", "caution", "no")))
    print(f"Silent harm: {counts['silent']}; a yes that grows: {counts['growing']}.")
    sys.exit(bool(counts["silent"] or counts["growing"] or counts["healthy", "no"] > 0.05 * counts["healthy"]))


if __name__ == "__main__":
    main()
