"""The probe: a plant that nobody knows is excited or listened to, and answers what its response is made of and what suits it."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import resolved, without_deformation
from fpirhc.deformation.base import Deformation
from fpirhc.describe import as_written
from fpirhc.errors import FpirhcError, InvalidName, InvalidValue, nearest
from fpirhc.fields.checked import FoundByName, checked_call
from fpirhc.fields.kinds import Count, Seed
from fpirhc.probing.choice import DARING, Candidate, Choice, mean_ratio, steps_of
from fpirhc.probing.identification import Estimates, Interval, identify
from fpirhc.probing.recording import Record, excited, read_recording
from fpirhc.simulation.model_as_plant import shortened
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import simulator
from fpirhc.simulation.trials import errors_of, weighed
from fpirhc.summary import line, number, table
from fpirhc.task.problem import Problem

_FEWEST, _USUAL = 40, 300
_MORE, _AGAIN = 2.5, 2  # factor of the amplitude where a sign is not certain, and how often it is applied
_CLIPPED = 0.2  # share of the cycles at a limit, from which it is said


@dataclass(frozen=True, eq=False)
class Probe(FoundByName):
    """What a probe has found.

    Args:
        gain: lambda by response and model response, both by controlled quantity: 1 where the model is right.
        dead_time: by input, in control cycles beyond the one that every loop has: all of it, with that of the measurement, and also
            where the problem states some.
        lag: by input, the dominant one, in the problem's unit of time; all of it too.
        noise: by controlled quantity, rms of the measured response.
        drift: by controlled quantity, rms change of what the model does not have, per square root of the unit of time.
        deformation: the adaptation to use; None: no adaptation.
        why: it is this one, or none.
        trials: by name of the candidate, errors on the plant over those of the controller alone; empty where none were made.
        candidates: by the same names.
        problem: the problem with the estimated plant as its reality, to be reviewed or swept; None: it has no equations.
        notes: what to know beside.
        units: of responses, by controlled quantity.
        time_unit: of the problem.
    """

    gain: Mapping[str, Mapping[str, Interval]]
    dead_time: Mapping[str, Interval]
    lag: Mapping[str, Interval]
    noise: Mapping[str, float]
    drift: Mapping[str, float]
    deformation: Deformation | None
    why: str
    trials: Mapping[str, Trial] = field(default_factory=dict)
    candidates: Mapping[str, Deformation] = field(default_factory=dict)
    problem: Problem | None = None
    notes: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    time_unit: str = "s"

    @property
    def lines(self) -> str:
        """The line to paste into a problem file, as the deformation of the controller."""
        if self.deformation is None:
            return "deformation=fp.Identity(),"
        return "deformation=" + re.sub(r"\b([A-Z]\w*\()", r"fp.\1", as_written(self.deformation)) + ","

    def __repr__(self) -> str:
        return line(self, *(f"{name} {value}" for name, value in self.facts), self.lines, self.why)

    def _repr_html_(self) -> str:
        """The estimates as a table, for notebooks."""
        return table("Probe", ("", "estimate"), list(self.facts), [self.lines, self.why, *self.notes])

    @property
    def plain(self) -> dict[str, object]:
        """Everything but the problem, as plain data."""
        return {
            "gain": {n: {m: asdict(one) for m, one in entries.items()} for n, entries in self.gain.items()},
            "dead_time": {name: asdict(one) for name, one in self.dead_time.items()},
            "lag": {name: asdict(one) for name, one in self.lag.items()},
            "noise": dict(self.noise),
            "drift": dict(self.drift),
            "lines": self.lines,
            "why": self.why,
            "trials": {name: asdict(one) for name, one in self.trials.items()},
            "notes": list(self.notes),
        }

    @property
    def facts(self) -> tuple[tuple[str, str], ...]:
        """Every estimate as two texts."""
        gains = [
            (f"gain of {row}" + (f" by {column}" if len(entries) > 1 else ""), _interval(one))
            for row, entries in self.gain.items()
            for column, one in entries.items()
        ]
        dead = [(f"dead time of {name}, cycles", _interval(one)) for name, one in self.dead_time.items()]
        lags = [(f"lag of {name}, {self.time_unit}", _interval(one)) for name, one in self.lag.items()]
        noise = [(f"noise of {name}{self._unit(name)}", number(one)) for name, one in self.noise.items()]
        drift = [
            (f"drift of {name}{self._unit(name, f'/{self.time_unit}^0.5')}", number(v))
            for name, v in self.drift.items()
        ]
        return (*gains, *dead, *lags, *noise, *drift)

    def _unit(self, name: str, per: str = "") -> str:
        unit = self.units.get(name, "1")
        return f", {unit}{per}" if per or unit != "1" else ""


@checked_call
def probe(
    problem: Problem,
    controller: Controller,
    *,
    cycles: Count | None = None,
    amplitude: float | Mapping[str, float] | None = None,
    recording: str | Path | None = None,
    chatter: float | Mapping[str, float] | None = None,
    trials: bool = True,
    seed: Seed = 0,
) -> Probe:
    """Return what the response of a plant is made of, and the adaptation that suits it.

        f_i = sum_j lambda_ij (f^_j, late by d cycles and a lag) + drift + noise,      f^: the model's response to the same commands

    The controller keeps the plant safe, without its deformation, while a small random binary sequence adds to its desired response.
    Candidates are chosen on the plant as estimated and keep their margins at the ends of what the record allows, two of them at the
    estimate alone. They are then run on the plant itself, beside the controller alone: the best one is kept, or none.

    Args:
        problem: with the plant that is to be probed, mostly an `ExternalPlant`.
        controller: that keeps it safe.
        cycles: of the excitation, 50 to 500; None: 300.
        amplitude: of the sequence, in the unit of the response, by controlled quantity or one for all; 0 only listens. None: twice
            the noise and a tenth of the deviation of the desired response, both in a first run without it; where the sign of a
            gain is not certain with that, 2.5 times as much, and once more.
        recording: CSV file in place of runs, without `cycles` and `amplitude`; its columns are "time", every input, and what is
            measured.
        chatter: largest rms step of the command per cycle, in the input's unit, by input or one for all; None: 1.5 times that of
            the controller alone, or 2 % of the input's range.
        trials: whether candidates are tried on the plant; False on a machine that must not be risked.
        seed: of sequence and runs.

    Raises:
        InvalidValue: too few cycles, a record in which nothing moves, an amplitude that is negative, settings of an excitation
            beside a recording.
        FpirhcError: every error that the controller raises about the problem.
    """
    _check(problem, amplitude, chatter)
    _check_excitation(cycles, amplitude, recording)
    cycles = _USUAL if cycles is None else cycles
    bare = without_deformation(resolved(problem, controller))
    estimates, notes = _recorded(problem, bare, cycles, amplitude, recording, seed)
    trying = trials and recording is None
    estimated, shortlist, results = None, {}, {}
    why = estimates.refused or ("" if trying else estimates.unbounded)
    if not why:
        notes += [estimates.unbounded] if estimates.unbounded else []
        try:
            choice = Choice(problem, bare, estimates, chatter)
            estimated = choice.problem
            shortlist = choice.shortlist()
            why = (
                "" if shortlist else "no setting that comes back at the ends of the record makes the error clearly less"
            )
        except FpirhcError as error:
            why = f"the plant as estimated cannot be run ({error})"
    try_them = trying and bool(shortlist)
    if try_them:
        results = OnPlant(problem, bare, choice.allowed).walk(choice, shortlist, notes, seed + 1)
    candidates = {name: one.deformation for name, one in shortlist.items()}
    name = best(results) if try_them else "cautious" if "cautious" in candidates else None
    if try_them and not results:
        why = "the loop refuses every candidate"
    elif try_them and name is None:
        why = _none_of(results, problem)
    elif candidates and name is None:
        why = "no candidate bears twice the gain, which one that is not tried has to"
    elif name is not None:
        tests = (
            f": {results[name].error:.3g} of the error of the controller alone"
            if results
            else ", not tried on the plant"
        )
        why = f"{name}{tests}"
    chosen = None if name is None else candidates[name]
    return _answer(problem, estimates, chosen, why, results, candidates, estimated, notes)


def _recorded(
    problem: Problem,
    bare: Controller,
    cycles: int,
    amplitude: float | Mapping[str, float] | None,
    recording: str | Path | None,
    seed: int,
) -> tuple[Estimates, list[str]]:
    """What the record says, and what to know beside; excited again where a sign is not certain and the amplitude is free."""

    def estimates(record: Record) -> Estimates:
        return Estimates(identify(record.measured, record.modelled, problem.period, record.usable), seed)

    if recording is not None:
        record = read_recording(Path(recording), problem)
        return estimates(record), _notes(record)
    names, again = problem.plant.controlled_names, 0
    record = excited(problem, bare, cycles=cycles, amplitude=amplitude, seed=seed)
    found = estimates(record)
    while found.uncertain and amplitude is None and again < _AGAIN:
        more = dict(zip(names, (_MORE * size for size in record.amplitude), strict=True))
        record, again = excited(problem, bare, cycles=cycles, amplitude=more, seed=seed), again + 1
        found = estimates(record)
    text = f"the sign of a gain was not certain at first; excited again, with {_MORE**again:g} times the amplitude"
    return found, [*_notes(record), *([text] if again else [])]


def _answer(
    problem: Problem,
    estimates: Estimates,
    chosen: Deformation | None,
    why: str,
    results: Mapping[str, Trial],
    candidates: Mapping[str, Deformation],
    estimated: Problem | None,
    notes: list[str],
) -> Probe:
    names, inputs, channels = problem.plant.controlled_names, tuple(problem.plant.inputs), estimates.channels
    return Probe(
        gain={n: dict(zip(names, one.gains, strict=True)) for n, one in zip(names, channels, strict=True)},
        dead_time={n: one.dead_time for n, one in zip(inputs, channels, strict=True)},
        lag={n: one.lag for n, one in zip(inputs, channels, strict=True)},
        noise={n: one.noise for n, one in zip(names, channels, strict=True)},
        drift={n: one.drifting for n, one in zip(names, channels, strict=True)},
        deformation=chosen,
        why=why,
        trials=dict(results),
        candidates=dict(candidates),
        problem=estimated,
        notes=tuple(notes),
        units=dict(zip(names, problem.plant.response_signal("realised").entry_units, strict=True)),
        time_unit=problem.time_unit,
    )


def _none_of(results: Mapping[str, Trial], problem: Problem) -> str:
    """Why none of the trials is kept; the budget of chatter where nothing else is against one."""
    loud = {name: one for name, one in results.items() if not one.calm and replace(one, calm=True).passes}
    if loud:
        name = min(loud, key=lambda n: loud[n].error)
        budget = {n: float(f"{_SPARE * step:.2g}") for n, step in loud[name].steps.items()}
        one = f"{max(budget.values()):g}"
        given = f"{budget}, or --chatter {one} for every input" if len(budget) > 1 else one
        return (
            f"in trials on the plant {name} had {loud[name].error:.3g} of the error of the controller alone, but the steps of its "
            f"commands are beyond the budget of chatter; where the plant bears them, give chatter={given}"
        )
    bearing = "" if all(one.bears for one in results.values()) else f", and bore {MARGIN:g} times its gain"
    since = "" if problem.measure_from else "; errors count from the start on, where measure_from is not stated"
    return f"in trials on the plant no candidate made the error clearly less, and that of no coordinate larger{bearing}{since}"


def _notes(record: Record) -> list[str]:
    notes = [f"the run ended early: {record.stop}"] if record.stop else []
    if record.clipped > _CLIPPED:
        notes.append(f"commands stood at a limit in {record.clipped:.0%} of the cycles, which tell less")
    return notes


def _check(
    problem: Problem, amplitude: float | Mapping[str, float] | None, chatter: float | Mapping[str, float] | None
) -> None:
    for what, setting, names, least in (
        ("amplitude", amplitude, problem.plant.controlled_names, "of at least 0"),
        ("chatter", chatter, tuple(problem.plant.inputs), "above 0"),
    ):
        entries = setting if isinstance(setting, Mapping) else {"": setting}
        for name, value in entries.items():
            if name and name not in names:
                raise InvalidName(f"probe({what}=...): '{name}' is unknown.{nearest(name, names)}")
            least_value = 0.0 if what == "amplitude" else np.nextafter(0.0, 1.0)
            wrong = value is not None and not least_value <= value < np.inf
            if wrong:
                raise InvalidValue(f"probe({what}={value!r}): expected a number {least}, in the unit of the signal")


def _check_excitation(
    cycles: int | None, amplitude: float | Mapping[str, float] | None, recording: str | Path | None
) -> None:
    for name, given in (("cycles", cycles), ("amplitude", amplitude)):
        if recording is not None and given is not None:
            raise InvalidValue(f"{name} is of an excitation, and a recording has been excited: leave one of them out")
    if cycles is not None and cycles < _FEWEST:
        raise InvalidValue(
            f"probe: {cycles} cycles are too few to tell a gain from noise; expected at least {_FEWEST}, {_USUAL} are usual"
        )


def _interval(one: Interval) -> str:
    return number(one.value) if one.certain else f"{number(one.value)} ({number(one.low)} to {number(one.high)})"


MARGIN = 1.4  # times its gain that a candidate which prediction has not shown to be safe has to bear in a trial
_LONGEST = 2000  # cycles
_WORSE = 1.03  # largest ratio of any coordinate's error to that of the controller alone
_WORTH = 0.95
_LARGER = 1.5  # ratio of its errors with that gain and with its own
_CLEARLY = 0.97  # ratio of errors, from which a larger share counts
_SHARE = ", share "
_SPARE = 1.2  # times the steps of a trial that a budget of chatter has to be; those of other runs differ
_SEEDS = 3  # of the trials of the best candidate
_DARED = 0.9  # ratio of errors, from which a candidate that is stable at the estimate alone is kept


@dataclass(frozen=True)
class Trial:
    """A run on the plant."""

    error: float  # rms error over that of the controller alone, in the mean over the coordinates
    worst: float  # of any coordinate
    bears: bool = True  # False where a run with a larger gain, which a daring candidate has to bear, does not pass
    calm: bool = True  # whether the steps of its commands are within what is allowed
    steps: Mapping[str, float] = field(default_factory=dict)  # their rms by input

    @property
    def passes(self) -> bool:
        """Whether it makes the error clearly less, and that of no coordinate more, is calm, and bears what it has to."""
        return self.error <= _WORTH and self.worst <= _WORSE and self.bears and self.calm


def best(trials: Mapping[str, Trial]) -> str | None:
    """Return the name of the best trial that passes, a daring one where it is clearly better; None where none does."""
    factors = {name: 1 / _DARED if name.startswith(DARING) else 1.0 for name in trials}
    passing = {name: factors[name] * one.error for name, one in trials.items() if one.passes}
    return min(passing, key=lambda name: passing[name]) if passing else None


class OnPlant:
    """The trials of one problem and controller, whose own run is made once for every seed."""

    def __init__(
        self, problem: Problem, controller: Controller, allowed: Callable[[Run], np.ndarray] | None = None
    ) -> None:
        """Run nothing yet.

        `allowed`: function of the run of the controller alone -> largest rms step of every input; None: any.
        """
        self._problem, self._bare = shortened(problem, _LONGEST), without_deformation(controller)
        self._names, self._allowed = weighed(problem, controller), allowed
        self._alone: dict[int, Run] = {}

    def trial(self, deformation: Deformation, seed: int, *, loud: bool = False) -> Trial | str:
        """Return the trial of a candidate; of one that the loop refuses, the reason.

        `loud`: whether steps of any size are calm.
        """
        alone = self._run_alone(seed)
        try:
            run = self._run(self._bare.with_deformation(deformation), seed)
        except FpirhcError as error:
            return str(error)
        pair = errors_of(self._problem, (alone, run), self._names)
        steps = steps_of(run)
        calm = loud or self._allowed is None or bool((steps <= self._allowed(alone)).all())
        ratio = mean_ratio(self._problem, alone, run, self._names)
        by_input = dict(zip(self._problem.plant.inputs, steps.tolist(), strict=True))
        return Trial(ratio, max(pair.ratio(n) for n in pair.without), calm=calm, steps=by_input)

    def walk(self, choice: Choice, shortlist: dict[str, Candidate], notes: list[str], seed: int) -> dict[str, Trial]:
        """Return trials of the shortlist, then of the shares beside the best one, which are added to it, until there are none.

        A larger share counts where it is clearly better: of shares that are alike the smallest is kept. The best one is run with
        other seeds too, and counts with its largest errors: what rings at times may have been lucky.
        """
        results: dict[str, Trial] = {}
        new, proven, again, needed = dict(shortlist), set(), set(), np.inf
        while True:
            outcomes = {name: self.trial(one.deformation, seed) for name, one in new.items()}
            notes += [f"{name} is not tried: {one}" for name, one in outcomes.items() if isinstance(one, str)]
            results |= {n: one for n, one in outcomes.items() if isinstance(one, Trial) and one.error <= needed}
            name, new, needed = best(results), {}, np.inf
            if name is None:
                return results
            chosen = shortlist[name]
            if _walked(name) and name not in proven:  # before a larger share is tried
                proven.add(name)
                if not self._bears_more(chosen.deformation, results[name], seed):
                    notes.append(f"{name} is not kept: on the plant it does not bear {MARGIN:g} times its gain")
                    lost = [n for n in results if _walked(n) and shortlist[n].is_larger(chosen)]
                    results |= {n: replace(results[n], bears=False) for n in (name, *lost)}
                continue
            known = [one.deformation for one in shortlist.values()]
            beside = choice.beside(chosen, shortlist.values())
            titled = {f"{name.partition(',')[0]}{_SHARE}{share:g}": one for share, one in beside.items()}
            new = {title: one for title, one in titled.items() if one.deformation not in known}
            # An error falls with the share until the loop is lost, so a smaller one is tried where no larger one is better.
            larger = {title: one for title, one in new.items() if one.is_larger(chosen)}
            new, needed = (larger, _CLEARLY * results[name].error) if larger else (new, np.inf)
            shortlist |= new
            if not new and name in again:
                return results
            if not new:
                again.add(name)
                results[name] = self._with_other_seeds(chosen.deformation, results[name], seed)

    def _with_other_seeds(self, chosen: Deformation, first: Trial, seed: int) -> Trial:
        """The largest errors of a trial of one candidate, and of two with other seeds."""
        others = [self.trial(chosen, other) for other in self._seeds(seed)[1:]]
        trials = [first, *(one for one in others if isinstance(one, Trial))]
        error, worst = max(one.error for one in trials), max(one.worst for one in trials)
        steps = {name: max(one.steps.get(name, 0.0) for one in trials) for name in first.steps}
        return replace(first, error=error, worst=worst, calm=all(one.calm for one in trials), steps=steps)

    def _bears_more(self, chosen: Deformation, own: Trial, seed: int) -> bool:
        """Whether trials with a larger gain pass, and have no error that is much larger: else the limit is near."""
        louder = chosen.with_effective_gain(MARGIN * chosen.effective_gain())
        outcomes = (self.trial(louder, other, loud=True) for other in self._seeds(seed))
        return all(isinstance(one, Trial) and one.passes and one.error <= _LARGER * own.error for one in outcomes)

    def _seeds(self, seed: int) -> list[int]:
        """Those of the runs that judge a candidate; one alone where the controller's own run is the same with another."""
        first, second = (self._run_alone(one).log for one in (seed, seed + 1))
        alike = first.shape == second.shape and np.array_equal(first, second, equal_nan=True)
        return [seed] if alike else list(range(seed, seed + _SEEDS))

    def _run_alone(self, seed: int) -> Run:
        if seed not in self._alone:
            self._alone[seed] = self._run(self._bare, seed)
        return self._alone[seed]

    def _run(self, controller: Controller, seed: int) -> Run:
        return simulator(self._problem, controller, compiled=False).run(seed=seed)


def _walked(name: str) -> bool:
    """Whether a candidate is there because of trials: prediction has not shown that it bears a larger gain."""
    return name.startswith(DARING) or _SHARE in name
