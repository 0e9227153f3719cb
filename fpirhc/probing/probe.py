"""The probe: a plant that nobody knows is excited or listened to, and answers what its response is made of and what suits it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
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
from fpirhc.probing.choice import MARGIN, Choice, Trial, best
from fpirhc.probing.identification import Estimates, Interval, identify, require_cycles
from fpirhc.probing.recording import excited, read_recording
from fpirhc.summary import line, number
from fpirhc.task.problem import Problem


@dataclass(frozen=True, eq=False)
class Probe(FoundByName):
    """What a probe has found, by controlled quantity or by input."""

    gain: Mapping[str, Mapping[str, Interval]]  # lambda by response and model response: 1 where the model is right
    dead_time: Mapping[
        str, Interval
    ]  # by input, in cycles beyond the one that every loop has; all of it, stated or not
    lag: Mapping[str, Interval]  # by input, the dominant one, in the problem's unit of time; all of it too
    noise: Mapping[str, float]  # rms of the measured response
    drift: Mapping[str, float]  # rms change of what the model does not have, per square root of the unit of time
    deformation: Deformation | None  # the adaptation to use; None: no adaptation
    why: str  # it is this one, or none
    trials: Mapping[str, Trial] = field(default_factory=dict)  # by name of the candidate; empty where none were made
    candidates: Mapping[str, Deformation] = field(default_factory=dict)  # by the same names
    problem: Problem | None = (
        None  # with the estimated plant as its reality, to be reviewed or swept; None: it has no equations
    )
    notes: tuple[str, ...] = ()  # what to know beside
    units: Mapping[str, str] = field(default_factory=dict)  # of responses
    time_unit: str = "s"  # of the problem

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
            (f"gain of {row}{f' by {column}' if len(entries) > 1 else ''}", _interval(one))
            for row, entries in self.gain.items() for column, one in entries.items()
        ]  # fmt: skip
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
    Candidates have half of the largest gain that a review of the plant as estimated admits, at all ends of what the record allows.
    They are then run on the plant itself, beside the controller alone, with other gains too: the best one is kept, or none.

    Args:
        problem: with the plant that is to be probed, mostly an `ExternalPlant`.
        controller: that keeps it safe.
        cycles: of the excitation, 50 to 500; None: 300.
        amplitude: of the sequence, in the unit of the response, by controlled quantity or one for all; 0 only listens. None: twice
            the noise and a tenth of the deviation of the desired response, both in a first run without it.
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
    cycles = 300 if cycles is None else cycles
    require_cycles(cycles)
    bare = without_deformation(resolved(problem, controller))
    listened = recording is None
    record = (
        excited(problem, bare, cycles, amplitudes, seed) if listened else read_recording(Path(str(recording)), problem)
    )
    estimates = Estimates(identify(record.measured, record.modelled, problem.period, record.usable), seed)
    trying, notes = trials and listened, [f"the run ended early: {record.stop}"] if record.stop else []
    estimated, shortlist, results, name = None, dict[str, Deformation](), dict[str, Trial](), None
    why = estimates.refused or ("" if trying else estimates.unbounded)
    if not why:
        notes += filter(None, [estimates.unbounded])
        try:
            choice = Choice(problem, bare, estimates, budget or {})
            estimated, shortlist = choice.problem, choice.shortlist()
        except FpirhcError as error:
            why = f"the plant as estimated cannot be run ({error})"
        else:
            why = "no setting that comes back at the ends of the record makes the error clearly less"
    if shortlist and trying:
        results = choice.tried(shortlist, notes, seed + 1)
        name = best(results)
        why = f"{name}: {results[name].error:.3g} of the error of the controller alone" if name else (
            "in trials on the plant none made the error clearly less, that of no coordinate larger, kept its budget of chatter "
            f"and bore {MARGIN:g} times its gain")  # fmt: skip
    elif shortlist:
        name = next(iter(shortlist))
        why = f"{name}, not tried on the plant"
    channels = estimates.channels
    return Probe(
        gain={n: dict(zip(names, one.gains, strict=True)) for n, one in zip(names, channels, strict=True)},
        dead_time={n: one.dead_time for n, one in zip(inputs, channels, strict=True)},
        lag={n: one.lag for n, one in zip(inputs, channels, strict=True)},
        noise={n: one.noise for n, one in zip(names, channels, strict=True)},
        drift={n: one.drifting for n, one in zip(names, channels, strict=True)},
        deformation=shortlist[name] if name else None,
        why=why,
        trials=results,
        candidates=shortlist,
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


def _interval(one: Interval) -> str:
    certain = one.low == one.high
    return number(one.value) if certain else f"{number(one.value)} ({number(one.low)} to {number(one.high)})"
