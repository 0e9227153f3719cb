"""What needs a pair of finished loops: prices, the null test, and what speaks against the adaptation of one controller.

A command that runs one controller says what a comparison of the pair would say, and a comparison judges a row whose pair is no row.
A plant outside is not run for that: then the null test stands alone. Ctrl-C leaves out what is missing here. Theory:
docs/theory-questions.md.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import without_deformation
from fpirhc.controllers.live_settings import Numbers
from fpirhc.errors import FpirhcError, NotSupported
from fpirhc.fields.checked import FoundByName
from fpirhc.plant.motion import followed_units, with_space
from fpirhc.review.questions.gain import reviewed_gain
from fpirhc.review.questions.reached_parameters import not_reached
from fpirhc.simulation.metrics import Metric, measure
from fpirhc.simulation.metrics.entries.commands import at_limit
from fpirhc.simulation.model_as_plant import ModelAsPlant
from fpirhc.simulation.simulate import Simulator, judged_run, simulator
from fpirhc.simulation.stepper import Stepper
from fpirhc.simulation.trials import SLIGHT, errors_of, weighed
from fpirhc.studies.comparison.causes import grows, yardstick_of
from fpirhc.studies.comparison.changes import ROUNDING, Change, Finding, Outcome, major, outcome_of, scales
from fpirhc.studies.comparison.entry import Entry, no_bound_because
from fpirhc.studies.comparison.timing import measure_price
from fpirhc.studies.comparison.verdict import beaten_by, judge
from fpirhc.studies.view import Progress
from fpirhc.summary import in_percent, numbers_written_out
from fpirhc.symbolic.evaluate import attempted
from fpirhc.task.problem import Problem

_LARGER = (Outcome.WORSE, Outcome.MIXED)
_NULL_TEST = "null test"


@dataclass(frozen=True)
class NullTest(FoundByName):
    """The result of a null test."""

    pair: tuple[str, str]  # names of the controllers without and with adaptation
    before: Mapping[str, float]  # rms error without adaptation, by judged coordinate; NaN for a run that ended early
    after: Mapping[str, float]  # rms error with adaptation
    outcome: Outcome  # what adaptation does where there is nothing to adapt
    harmful: bool  # whether it then makes an error that is larger than that of the wrong model without adaptation
    text: str  # the result in a sentence
    cycles: int  # of one run
    elapsed: float = field(default=0.0, compare=False)  # wall time of both runs, s

    def __post_init__(self) -> None:
        object.__setattr__(self, "text", numbers_written_out(self.text))
        super().__post_init__()

    @property
    def passed(self) -> bool:
        """Whether adaptation is not worse where there is nothing to adapt."""
        return self.outcome in (Outcome.BETTER, Outcome.NO_DIFFERENCE)


def null_test(
    model: ModelAsPlant,
    loops: tuple[Simulator, Simulator],
    names: tuple[str, str],
    scales: Mapping[str, float],
    weighed: frozenset[str] | None = None,
    *,
    cured: Mapping[str, float],
) -> NullTest:
    """Return what adaptation does on the approximate model as plant.

    Args:
        weighed: coordinates that are judged; None: all.
        cured: rms error on the plant itself without adaptation, by judged coordinate.
    """
    begin = time.perf_counter()
    null, runs = model.pair(loops)
    pair = errors_of(null, runs)
    before, after = (_or_nan(errors) for errors in (pair.without, pair.adapted))
    slight = {name: SLIGHT * size for name, size in pair.ranges.items()}
    if pair.stuck:
        text = _not_informative({n: at_limit.values(null, run)[""] for n, run in zip(names, runs, strict=True)})
        return NullTest(
            names, before, after, Outcome.NOT_COMPARABLE, False, text, null.cycles, time.perf_counter() - begin
        )
    changes = {n: Change(n, before[n], after[n], scales.get(n, 1.0)) for n in before if weighed is None or n in weighed}
    outcome = _outcome(changes)
    harmful = _harmful(outcome, changes, cured, slight)
    small = (
        ""
        if harmful or outcome not in _LARGER
        else _smallness(names[0], null, {n: cured[n] for n in changes}, _harmful(outcome, changes, cured, {}))
    )
    text = _sentence(names, outcome, changes, null, small)
    return NullTest(names, before, after, outcome, harmful, text, null.cycles, time.perf_counter() - begin)


def _not_informative(stuck: Mapping[str, float]) -> str:
    names = ", ".join(f"that of {name} in {in_percent(share)}" for name, share in stuck.items())
    return f"Null test: not informative, the command stands at a limit in most cycles ({names}), where no adaptation can act."


def _or_nan(errors: Mapping[str, float]) -> dict[str, float]:
    """Errors by coordinate, NaN where a run ended early or has diverged."""
    return {name: size if math.isfinite(size) else math.nan for name, size in errors.items()}


def _outcome(changes: Mapping[str, Change]) -> Outcome:
    lost = [c for c in changes.values() if math.isnan(c.after)]
    if any(math.isnan(c.before) for c in changes.values()) or not changes:
        return Outcome.NOT_COMPARABLE
    return Outcome.WORSE if lost else outcome_of(major(changes))


def _harmful(
    outcome: Outcome, changes: Mapping[str, Change], cured: Mapping[str, float], slight: Mapping[str, float]
) -> bool:
    """Whether an error is larger than the wrong model makes without adaptation, by more than is slight for the coordinate."""
    if outcome not in _LARGER:
        return False
    worse = [c for c in major(changes).values() if c.outcome is Outcome.WORSE] or changes.values()
    return any(not (c.after <= cured[c.name] or c.after - c.before <= slight.get(c.name, 0.0)) for c in worse)


def _smallness(plain: str, null: Problem, cured: Mapping[str, float], larger: bool) -> str:
    """What an error that does no harm is small against."""
    if larger:
        return f"it adds less than {in_percent(SLIGHT)} of the range of the run"
    units = followed_units(null.plant)
    costs = ", ".join(f"{n} {size:.3g}{with_space(units[n])}" for n, size in cured.items())
    return f"it is smaller than that of {plain} with the wrong model ({costs})"


def _sentence(
    names: tuple[str, str], outcome: Outcome, changes: Mapping[str, Change], null: Problem, small: str
) -> str:
    plain, adaptive = names
    head = "Null test (the approximate model as plant"
    head += ", no disturbance): " if null.disturbances else "): "
    if outcome is Outcome.NOT_COMPARABLE:
        return f"{head}{plain} does not finish there, so nothing is shown."
    if any(math.isnan(c.after) for c in changes.values()):
        return f"{head}failed, {adaptive} does not finish where {plain} does, with nothing to adapt."
    shown = sorted(changes.values(), key=lambda c: -c.ratio if c.ratio == c.ratio else 0.0)
    units = {name: with_space(unit) for name, unit in followed_units(null.plant).items()}
    numbers = ", ".join(f"{c.name} {c.before:.3g} -> {c.after:.3g}{units[c.name]}" for c in shown)
    if outcome in (Outcome.BETTER, Outcome.NO_DIFFERENCE):
        tiny = all(c.size < ROUNDING for c in changes.values())
        return f"{head}passed, {adaptive} is not worse than {plain} ({'rounding only' if tiny else numbers})."
    if small:
        return f"{head}{adaptive} makes a small error of its own ({numbers}); {small}."
    return (
        f"{head}failed, {adaptive} is worse than {plain} although there is nothing to adapt ({numbers}). Its gain, or the "
        "largest step of its map, is too small for its law or its plan, or it takes something else for an error of the model: the "
        "drift of the response within a long cycle, an unpaired delay, or noise. fpirhc review says more."
    )


class Built(NamedTuple):
    """What a controller of a comparison was built to: its loop, and its step by hand, None where that is broken or not needed."""

    loop: Simulator
    stepper: Stepper | None


def beside_each_other(
    problem: Problem, entries: Sequence[Entry], built: Mapping[str, Built], scales: Mapping[str, float]
) -> list[Entry]:
    """Return the entries with what only shows beside the others."""
    shown: list[Entry] = []
    try:
        for entry in entries:
            shown.append(_beside(problem, entry, entries, built, scales))
    except KeyboardInterrupt:
        return [*shown, *entries[len(shown) :]]
    return shown


def with_reviewed_causes(
    problem: Problem, entries: Sequence[Entry], built: Mapping[str, Built], judged: Sequence[Finding]
) -> list[Entry]:
    """Return the entries with what a review says of gain and wrong parameters, where a pair's verdict is not plainly positive."""
    asked = {finding.pair[1] for finding in judged if finding.pair and finding.outcome is not Outcome.BETTER}
    return [with_causes(problem, e, built[e.name].loop.controller) if e.name in asked else e for e in entries]


def with_causes(problem: Problem, entry: Entry, controller: Controller) -> Entry:
    """Return an entry with what a review says of the gain and of wrong parameters."""
    believed = controller.plant_model(problem).parameters(problem.plant)
    missed = not_reached(problem, np.asarray(believed))
    return replace(entry, reviewed_gain=reviewed_gain(problem, controller, grows=grows(entry)), not_reached=missed)


def null_tests(
    problem: Problem,
    pairs: Sequence[tuple[str, str]],
    entries: Sequence[Entry],
    built: Mapping[str, Built],
    scales: Mapping[str, float],
    *,
    seed: int,
    broken: list[str],
) -> tuple[NullTest, ...]:
    """Return the null tests of all pairs (without adaptation, with it), in their order."""
    by_name, tests = {e.name: e for e in entries}, []
    model = ModelAsPlant(problem, seed=seed)
    try:
        for pair in pairs:
            plain, adaptive = (by_name[name] for name in pair)
            facts = model, (built[plain.name].loop, built[adaptive.name].loop), pair, scales, adaptive.weighed
            test = attempted("the null test", null_test, *facts, cured=plain.metrics.rms_error, broken=broken)
            tests += [] if test is None else [test]
    except KeyboardInterrupt:
        pass
    return tuple(tests)


def _beside(
    problem: Problem, entry: Entry, entries: Sequence[Entry], built: Mapping[str, Built], scales: Mapping[str, float]
) -> Entry:
    """The entry with its price, or with why its exact model is no bound."""
    own, by_name = built[entry.name], {e.name: e for e in entries}
    if entry.exact and beaten_by(entry, entries, scales):
        facts = problem, own.loop.controller, entry.metrics, entry.optimality
        why = attempted("why it is no bound", no_bound_because, *facts, broken=[])
        return replace(entry, no_bound=why or ())
    plain = by_name.get(entry.pair or "")
    beside = None if plain is None else built[plain.name].stepper
    if plain is None or beside is None or own.stepper is None:
        return entry
    broken: list[str] = []
    both = (beside, plain.run), (own.stepper, entry.run)
    price = attempted("the price of adaptation", measure_price, problem, *both, broken=broken)
    return replace(entry, price=price, notes=(*entry.notes, *broken))


def harm_of_adaptation(
    problem: Problem,
    name: str,
    controller: Controller,
    *,
    seed: int,
    compiled: bool,
    metrics: Sequence[Metric] | None = None,
    settings: Numbers | None = None,
    progress: Progress | None = None,
) -> tuple[str, ...]:
    """Return a sentence for a run in which adaptation raises the error, and one for a null test that it fails.

    Empty without harm, for a controller that does not adapt, and for one that has no pair or cannot run.

    Args:
        settings: numbers of live settings in place of those of the controller and the problem; loops are compiled once for all.
        progress: called with (name of a run, cycles done, cycles in all).
    """
    if not controller.deformation.adapts:
        return ()
    try:
        loops = _both(problem, controller, compiled, settings or {})
        return _harm(loops[1].problem, (f"{name} without adaptation", name), loops, seed, metrics, progress)
    except FpirhcError:
        return ()


def _both(problem: Problem, controller: Controller, compiled: bool, settings: Numbers) -> tuple[Simulator, Simulator]:
    """The loops without and with adaptation; the one without it is built for these numbers where they cannot be live there."""
    adapting = simulator(problem, controller, compiled=compiled, live=list(settings)).holding(settings)
    own = {path: value for path, value in settings.items() if not path.startswith("deformation.")}
    try:
        bare = simulator(problem, without_deformation(controller), compiled=compiled, live=list(own)).holding(own)
    except NotSupported:
        bare = simulator(adapting.problem, without_deformation(adapting.controller), compiled=compiled)
    return bare, adapting


def _harm(
    problem: Problem,
    pair: tuple[str, str],
    loops: tuple[Simulator, Simulator],
    seed: int,
    metrics: Sequence[Metric] | None,
    progress: Progress | None,
) -> tuple[str, ...]:
    sizes, counted = scales(problem), weighed(problem, loops[1].controller)
    model = ModelAsPlant(problem, seed=seed, progress=progress and partial(progress, _NULL_TEST))
    losses: list[str] = []
    cured: Mapping[str, float] = dict.fromkeys(problem.judged_names, 0.0)
    if problem.equations_known:
        plain, adaptive = (_entry(problem, n, one, seed, metrics, progress) for n, one in zip(pair, loops, strict=True))
        yardstick = yardstick_of(problem, seed=seed)
        finding = judge(plain, adaptive, yardstick)
        if finding.outcome is Outcome.WORSE:
            finding = judge(plain, with_causes(problem, adaptive, loops[1].controller), yardstick)
        losses, cured = [finding.text] * (finding.outcome is Outcome.WORSE), plain.metrics.rms_error
    if progress:
        progress(_NULL_TEST, 0, 2 * problem.cycles)
    test = null_test(model, loops, pair, sizes, counted, cured=cured)
    return (*losses, *([test.text] if test.harmful else []))


def partners(
    problem: Problem,
    entries: Sequence[Entry],
    controllers: Mapping[str, Controller],
    *,
    seed: int,
    compiled: bool | None,
    metrics: Sequence[Metric] | None = None,
) -> tuple[dict[str, tuple[Entry, Simulator]], dict[str, str]]:
    """Return runs without adaptation of the adaptive rows that have no pair, by row, and why others have none."""
    unadapted: dict[str, tuple[Entry, Simulator]] = {}
    missing: dict[str, str] = {}
    for name in (e.name for e in entries if e.adaptive and e.pair is None):
        try:
            problem.require_equations("its pair is not among the controllers, and the plant is outside")
            loop = simulator(problem, without_deformation(controllers[name]), compiled=compiled)
            unadapted[name] = _entry(problem, f"{name} without adaptation", loop, seed, metrics), loop
        except FpirhcError as error:
            missing[name] = f"it cannot run without adaptation ({error})"
        except KeyboardInterrupt:
            missing[name] = "interrupted before it ran without adaptation"
            break
    return unadapted, missing


def _entry(
    problem: Problem,
    name: str,
    loop: Simulator,
    seed: int,
    metrics: Sequence[Metric] | None,
    progress: Progress | None = None,
) -> Entry:
    """A row of a comparison with what a verdict reads."""
    run = judged_run(loop, seed=seed, name=name, progress=progress and partial(progress, name))
    counted = weighed(problem, loop.controller)
    adapts = loop.controller.deformation.adapts
    return Entry(name, run, measure(problem, run, metrics), None, adapts, None, None, weighed=counted)
