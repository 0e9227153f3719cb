"""The probe: a plant that nobody knows is excited or listened to, and answers what its response is made of and what suits it."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
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
from fpirhc.probing.identification import Estimates, Interval, identify, require_cycles
from fpirhc.probing.recording import excited, read_recording
from fpirhc.simulation.model_as_plant import shortened
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import simulator
from fpirhc.simulation.trials import errors_of, weighed
from fpirhc.summary import line, number
from fpirhc.task.problem import Problem

_USUAL = 300  # cycles
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

    @property
    def plain(self) -> dict[str, object]:
        """Everything but the problem, as plain data."""
        found = asdict(replace(self, problem=None, candidates={}, deformation=None))
        names = ("gain", "dead_time", "lag", "noise", "drift", "why", "trials", "notes")
        return {name: found[name] for name in names} | {"lines": self.lines}

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
        noise = [(f"noise of {name}, {self.units[name]}", number(one)) for name, one in self.noise.items()]
        drift = [(f"drift of {n}, {self.units[n]}/{self.time_unit}^0.5", number(one)) for n, one in self.drift.items()]
        return (*gains, *dead, *lags, *noise, *drift)


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
    names, inputs = problem.plant.controlled_names, tuple(problem.plant.inputs)
    amplitudes = _by_name("amplitude", amplitude, names, 0.0, "of at least 0")
    budget = _by_name("chatter", chatter, inputs, np.nextafter(0.0, 1.0), "above 0")
    for setting, given in (("cycles", cycles), ("amplitude", amplitude)):
        if recording is not None and given is not None:
            raise InvalidValue(
                f"{setting} is of an excitation, and a recording has been excited: leave one of them out"
            )
    cycles = _USUAL if cycles is None else cycles
    require_cycles(cycles)
    bare = without_deformation(resolved(problem, controller))
    estimates, notes = _recorded(problem, bare, cycles, amplitudes, recording, seed)
    trying = trials and recording is None
    estimated, shortlist, results, name = None, {}, {}, None
    why = estimates.refused or ("" if trying else estimates.unbounded)
    if not why:
        notes += [estimates.unbounded] if estimates.unbounded else []
        try:
            choice = Choice(problem, bare, estimates, budget)
            estimated, shortlist = choice.problem, choice.shortlist()
            why = "no setting that comes back at the ends of the record makes the error clearly less"
        except FpirhcError as error:
            why = f"the plant as estimated cannot be run ({error})"
    if shortlist and trying:
        results = OnPlant(problem, bare, choice.allowed).walk(choice, shortlist, notes, seed + 1)
        name = best(results)
        why = (
            f"{name}: {results[name].error:.3g} of the error of the controller alone"
            if name
            else _none(results, problem)
        )
    elif shortlist:
        name = "cautious" if "cautious" in shortlist else None
        why = (
            f"{name}, not tried on the plant"
            if name
            else "no candidate bears twice the gain, as one that is not tried has to"
        )
    channels = estimates.channels
    return Probe(
        gain={n: dict(zip(names, one.gains, strict=True)) for n, one in zip(names, channels, strict=True)},
        dead_time={n: one.dead_time for n, one in zip(inputs, channels, strict=True)},
        lag={n: one.lag for n, one in zip(inputs, channels, strict=True)},
        noise={n: one.noise for n, one in zip(names, channels, strict=True)},
        drift={n: one.drifting for n, one in zip(names, channels, strict=True)},
        deformation=shortlist[name].deformation if name else None,
        why=why,
        trials=results,
        candidates={title: one.deformation for title, one in shortlist.items()},
        problem=estimated,
        notes=tuple(notes),
        units=dict(zip(names, problem.plant.response_signal("realised").entry_units, strict=True)),
        time_unit=problem.time_unit,
    )


def _by_name(
    what: str, setting: float | Mapping[str, float] | None, names: Sequence[str], least: float, words: str
) -> dict[str, float] | None:
    """The entries of a setting, checked; one number is that of all."""
    if setting is None:
        return None
    entries = dict(setting) if isinstance(setting, Mapping) else dict.fromkeys(names, setting)
    for name, value in entries.items():
        if name not in names:
            raise InvalidName(f"probe({what}=...): '{name}' is unknown.{nearest(name, names)}")
        if not least <= value < np.inf:
            raise InvalidValue(f"probe({what}={value!r}): expected a number {words}, in the unit of the signal")
    return entries


def _recorded(
    problem: Problem,
    bare: Controller,
    cycles: int,
    amplitude: Mapping[str, float] | None,
    recording: str | Path | None,
    seed: int,
) -> tuple[Estimates, list[str]]:
    """What the record says, and what to know beside; excited again where a sign is not certain and the amplitude is free."""
    again, notes = _AGAIN if amplitude is None and recording is None else 0, []
    while True:
        if recording is None:
            record = excited(problem, bare, cycles=cycles, amplitude=amplitude, seed=seed)
        else:
            record = read_recording(Path(recording), problem)
        found = Estimates(identify(record.measured, record.modelled, problem.period, record.usable), seed)
        if not (found.uncertain and again):
            break
        again -= 1
        louder = (_MORE * size for size in record.amplitude)
        amplitude = dict(zip(problem.plant.controlled_names, louder, strict=True))
        notes = [
            "the sign of a gain was not certain at first; "
            f"excited again, with {_MORE ** (_AGAIN - again):g} times the amplitude"
        ]
    notes += [f"the run ended early: {record.stop}"] if record.stop else []
    if record.clipped > _CLIPPED:
        notes.append(f"commands stood at a limit in {record.clipped:.0%} of the cycles, which tell less")
    return found, notes


def _none(results: Mapping[str, Trial], problem: Problem) -> str:
    """Why none of the trials is kept; the budget of chatter where nothing else is against one."""
    loud = {name: one for name, one in results.items() if not one.calm and replace(one, calm=True).passes}
    if not loud:
        return (
            f"in trials on the plant no candidate made the error from {problem.measure_from:g} {problem.time_unit} on clearly "
            f"less, and that of no coordinate larger, and bore {MARGIN:g} times its gain"
        )
    name = min(loud, key=lambda n: loud[n].error)
    steps = loud[name].steps
    return (
        f"in trials on the plant {name} had {loud[name].error:.3g} of the error of the controller alone, but the steps of its "
        f"commands, {', '.join(f'{n} {step:.2g}' for n, step in steps.items())}, are beyond the budget of chatter; where the plant "
        f"bears them, give chatter={_SPARE * max(steps.values()):.2g}"
    )


def _interval(one: Interval) -> str:
    certain = one.low == one.high
    return number(one.value) if certain else f"{number(one.value)} ({number(one.low)} to {number(one.high)})"


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
            adapted = self._bare.with_deformation(deformation)
            run = simulator(self._problem, adapted, compiled=False).run(seed=seed)
        except FpirhcError as error:
            return str(error)
        pair = errors_of(self._problem, (alone, run), self._names)
        steps = steps_of(run)
        calm = loud or self._allowed is None or bool((steps <= self._allowed(alone)).all())
        by_input = dict(zip(self._problem.plant.inputs, steps.tolist(), strict=True))
        return Trial(mean_ratio(pair), max(pair.ratio(n) for n in pair.without), calm=calm, steps=by_input)

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
                    same = {n for n in results if _walked(n) and shortlist[n].form == chosen.form}
                    lost = {n for n in same if shortlist[n].share >= chosen.share}
                    results |= {n: replace(results[n], bears=False) for n in lost}
                continue
            known, form = [one.deformation for one in shortlist.values()], name.partition(",")[0]
            beside = choice.beside(chosen, shortlist.values()).items()
            new = {f"{form}{_SHARE}{share:g}": one for share, one in beside if one.deformation not in known}
            # An error falls with the share until the loop is lost, so a smaller one is tried where no larger one is better.
            larger = {title: one for title, one in new.items() if one.share > chosen.share}
            new, needed = (larger, _CLEARLY * results[name].error) if larger else (new, np.inf)
            shortlist |= new
            if not new and name in again:
                return results
            if not new:  # the largest errors of trials with other seeds too
                again.add(name)
                others = (self.trial(chosen.deformation, other) for other in self._seeds(seed)[1:])
                trials = [results[name], *(one for one in others if isinstance(one, Trial))]
                results[name] = Trial(
                    max(one.error for one in trials),
                    max(one.worst for one in trials),
                    calm=all(one.calm for one in trials),
                    steps={n: max(one.steps[n] for one in trials) for n in trials[0].steps},
                )

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
            self._alone[seed] = simulator(self._problem, self._bare, compiled=False).run(seed=seed)
        return self._alone[seed]


def _walked(name: str) -> bool:
    """Whether a candidate is there because of trials: prediction has not shown that it bears a larger gain."""
    return name.startswith(DARING) or _SHARE in name
