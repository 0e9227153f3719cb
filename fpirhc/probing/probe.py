"""The probe: a plant that nobody knows is excited or listened to, and answers what its response is made of and what suits it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import resolved, without_deformation
from fpirhc.deformation.base import Deformation, Identity
from fpirhc.describe import as_written
from fpirhc.errors import FpirhcError, InvalidName, InvalidValue, nearest
from fpirhc.fields.checked import FoundByName, checked_call
from fpirhc.fields.kinds import Count, Seed
from fpirhc.plant.motion import derivative_unit
from fpirhc.probing.choice import LONGEST, MARGIN, Choice, Progress, Trial
from fpirhc.probing.identification import Channel, Estimates, Interval, identify
from fpirhc.probing.recording import Record, excited, read_recording
from fpirhc.summary import line, number
from fpirhc.task.problem import Problem

CYCLES, _WIDE, _LIMITED = 300, 0.2, 0.2  # of the excitation; shares that are told: half an interval, cycles at a limit


@dataclass(frozen=True, eq=False)
class Probe(FoundByName):
    """What a probe has found, by controlled quantity or by input."""

    gain: Mapping[str, Mapping[str, Interval]]  # lambda by response and model response: 1 where the model is right
    # by input, in cycles beyond the one that every loop has: all of it, stated or not, but none of an estimator
    dead_time: Mapping[str, Interval]
    lag: Mapping[str, Interval]  # by input, the dominant one, in the problem's unit of time; all of it too
    noise: Mapping[str, float]  # rms of what is measured
    drift: Mapping[str, float]  # rms change of what the model does not have, per square root of the unit of time
    deformation: Deformation | None  # the adaptation to use; None: no adaptation
    why: str  # it is this one, or none
    trials: Mapping[str, Trial] = field(default_factory=dict)  # by name of the candidate; empty where none were made
    candidates: Mapping[str, Deformation] = field(default_factory=dict)  # by the same names
    # with the estimated plant as its reality, to be reviewed or swept; None: it has no equations
    problem: Problem | None = None
    notes: tuple[str, ...] = ()  # what to know beside
    facts: tuple[tuple[str, str], ...] = ()  # every estimate as two texts

    @property
    def lines(self) -> str:
        """The line to paste into a problem file, as the deformation of the controller."""
        return f"deformation={as_written(self.deformation or Identity(), 'fp.')},"

    def __repr__(self) -> str:
        return line(self, *(f"{name} {value}" for name, value in self.facts), self.lines, self.why)

    @property
    def plain(self) -> dict[str, object]:
        """Everything but the problem, as plain data."""
        found = asdict(replace(self, problem=None, candidates={}, deformation=None))
        names = ("gain", "dead_time", "lag", "noise", "drift", "why", "trials", "notes")
        return {name: found[name] for name in names} | {"lines": self.lines}


@checked_call
def probe(
    problem: Problem, controller: Controller, *, cycles: Count | None = None,
    amplitude: float | Mapping[str, float] | None = None, recording: str | Path | None = None,
    chatter: float | Mapping[str, float] | None = None, trials: bool = True, seed: Seed = 0,
    progress: Progress = lambda _what, _done, _total: None,
) -> Probe:  # fmt: skip
    """Return what the response of a plant is made of, and the adaptation that suits it.

        f_i = sum_j lambda_ij (f^_j, late by d cycles and a lag) + drift + noise,      f^: the model's response to the same commands

    The controller keeps the plant safe, without its deformation, while a small random binary sequence adds to its desired response.
    Candidates have half of a gain that makes the error no larger at all ends of what the record allows, a cycle later.
    They are then run on the plant itself, beside the controller alone, with other gains too: the best one is kept, or none.

    Args:
        problem: with the plant that is to be probed, mostly an `ExternalPlant`.
        controller: that keeps it safe.
        cycles: of the excitation, 50 to 500; None: 300.
        amplitude: of the sequence, in the unit of the response, by controlled quantity or one for all; 0 only listens. None: twice
            the noise and a tenth of the deviation of the desired response in a first run.
        recording: CSV file in place of runs, without `cycles` and `amplitude`: "time", what is measured then, every input after it.
        chatter: largest rms step of the command per cycle, in the input's unit, by input or one for all; None: 1.5 times that of
            the controller alone, or 2 % of the input's range.
        trials: whether candidates are tried on the plant; False on a plant that must not be risked.
        seed: of sequence and runs.
        progress: called with (what is done, how much of it, in all).

    Raises:
        FpirhcError: too few cycles, a record in which nothing moves, wrong settings, and what the controller raises.
    """
    names, inputs = problem.plant.controlled_names, tuple(problem.plant.inputs)
    amplitudes = _by_name("amplitude", amplitude, names, 0.0, "of at least 0")
    budget = _by_name("chatter", chatter, inputs, np.nextafter(0.0, 1.0), "above 0")
    for setting, given in (("cycles", cycles), ("amplitude", amplitude)):
        if recording is not None and given is not None:
            wrong = f"{setting} is of an excitation, and a recording has been excited"
            raise InvalidValue(f"{wrong}: leave one of them out")
    bare, listened = without_deformation(own := resolved(problem, controller)), recording is None
    asked = CYCLES if cycles is None else cycles, amplitudes, seed
    record = excited(problem, bare, *asked) if listened else read_recording(Path(str(recording)), problem)
    channels = identify(record.measured, record.modelled, problem.period, record.usable, record.differences)
    estimates = Estimates(channels, seed)
    trying, notes = trials and listened, [f"the run ended early: {record.stop}"] if record.stop else []
    choice, name, why = None, None, estimates.refused or ("" if trying else estimates.unbounded)
    if not why:
        notes += filter(None, [estimates.unbounded])
        noise = dict(zip(record.shown, (one.noise for one in estimates.channels), strict=True))
        try:
            choice = Choice(problem, bare, estimates, noise, budget or {}, progress, own)
        except FpirhcError as error:
            why = f"the plant as estimated cannot be run ({error})"
        else:
            why = "no setting whose double bears the ends of what the record allows makes the error clearly less"
    if choice and choice.candidates and trying:
        choice.on_plant(seed + 1)
        notes += choice.notes
        name = choice.best
        why = f"{name}: {choice.results[name].error:.3g} of the error of the controller alone" if name else (
            "in trials on the plant none made the error clearly less, that of no coordinate larger, kept its budget of chatter "
            f"and bore {MARGIN:g} times its gain")  # fmt: skip
    elif choice and choice.candidates:
        name = next(iter(choice.candidates))
        why = f"{name}, not tried on the plant"
    chosen = choice.candidates[name] if choice and name else None
    by = lambda names, what: {n: getattr(one, what) for n, one in zip(names, estimates.channels, strict=True)}  # noqa: E731
    return Probe(
        gain={name: dict(zip(names, gains, strict=True)) for name, gains in by(names, "gains").items()},
        dead_time=by(inputs, "dead_time"), lag=by(inputs, "lag"), noise=by(names, "noise"), drift=by(names, "drifting"),
        deformation=chosen, why=why, trials=choice.results if choice else {},
        candidates=choice.candidates if choice else {}, problem=choice.problem if choice else None,
        notes=(*notes, *_cautions(problem, record, estimates, chosen)), facts=tuple(_facts(problem, record, estimates.channels)),
    )  # fmt: skip


def runs_made(problem: Problem, *, trials: bool, **settings: Any) -> str:
    """Return how often a probe with these settings runs the plant, and for how long."""
    after = f"; then some 15 to 50 of {min(problem.cycles, LONGEST)} try candidates on it" if trials else ""
    count = f"{'two runs' if settings['amplitude'] is None else 'one run'} of {settings['cycles'] or CYCLES} cycles"
    return "no run is made" if settings["recording"] else f"{count} to excite the plant{after}"


def _facts(problem: Problem, record: Record, channels: Sequence[Channel]) -> Iterator[tuple[str, str]]:
    plant, time, units = problem.plant, problem.time_unit, problem.plant.followed
    names = plant.controlled_names
    for row, one in zip(names, channels, strict=True):
        for column, gain in zip(names, one.gains, strict=True):
            yield f"gain ratio of {row}{f' by {column}' if len(names) > 1 else ''}, plant over model", _interval(gain)
    by_input = list(zip(plant.inputs, channels, strict=True))
    yield from ((f"dead time of {name}, cycles", _interval(one.dead_time)) for name, one in by_input)
    yield from ((f"lag of {name}, {time}", _interval(one.lag)) for name, one in by_input)
    for name, seen, one in zip(names, record.shown, channels, strict=True):
        size = number(one.noise) if one.noise else "not resolved"
        yield f"noise of {seen}, {derivative_unit(units[name], seen.count(chr(39)), time)}", size
    for k, (name, unit) in enumerate(zip(names, plant.response_signal("realised").entry_units, strict=True)):
        yield from ((f"amplitude of {name}, {unit}", number(size)) for size in record.amplitude[k : k + 1])
        yield f"drift of {name}, {unit}/{time}^0.5", number(channels[k].drifting)


def _cautions(problem: Problem, record: Record, estimates: Estimates, chosen: Deformation | None) -> Iterator[str]:
    """Sentences on how far the estimates are to be trusted."""
    own = problem.sensing.delay(problem.plant, problem.period)
    hidden = [name for name in record.shown if name not in problem.sensing.measures(problem.plant)]
    if hidden and problem.sensing.spreads(problem.plant):
        inside = f"no sensor shows {', '.join(hidden)}: dead time and lag contain those of the estimator, which colours the noise"
        yield f"{inside}, so the right values may be outside the intervals; measure it, or record it without a filter"
    elif own:
        yield f"the dead time is the plant's; {type(problem.sensing.estimator).__name__} delays the response by {own:g} cycles more"
    each = zip(problem.plant.controlled_names, problem.plant.inputs, record.limited, estimates.channels, strict=True)
    for row, (name, u, limited, one) in enumerate(each):
        wide = max(gain.high - gain.low for gain in one.gains) / 2 / max(abs(one.gains[row].value), 1e-300)
        if (more := wide / _WIDE) > 1 and estimates.least_at_most > 0:
            usual = float(record.amplitude[row]) if record.amplitude else 0.0
            size = min(more * usual, max(usual, float(record.room[row])))  # within the limits
            longer = (more * usual / size if size else more) ** 2
            needs = [f"an amplitude of {number(size)}"] * (size > usual)
            needs += [f"{longer:.2g} times the cycles"] * (longer > 1.05)
            yield f"the gain ratio of {name} is only known to {100 * wide:.0f} %; {100 * _WIDE:.0f} % needs {' and '.join(needs)}"
        if limited > _LIMITED:
            yield f"{u} is at a limit in {100 * limited:.0f} % of the cycles, which tells little: excite less, or widen its limits"
        around, known = problem.dead_time.measurement, problem.dead_time.inputs.get(u, 0.0)
        if not (problem.moves.simulated or hidden) and one.dead_time.low - (around + known) / problem.period > 1 - 1e-9:
            time = f"dead_time=fp.DeadTime(inputs={{'{u}': {estimates.counted[row] * problem.period - around:.6g}}})"
            counts = chosen is None or np.any(chosen.form.cycles)
            yield f"state {time} in the problem too: predictions need it, and a review may fail without it" if counts else (
                f"do not state {time} in the problem: this form counts none, and would harm a model that is as late. Where plans "
                "predict, state it, take ModelReferenced without cycles=0, and compare")  # fmt: skip


def _by_name(what: str, setting: Any, names: Sequence[str], least: float, words: str) -> dict[str, float] | None:
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


def _interval(one: Interval) -> str:
    return number(one.value) + (f" ({number(one.low)} to {number(one.high)})" if one.low < one.high else "")
