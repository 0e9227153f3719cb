"""What needs several finished loops of a comparison: prices, why an exact model is no bound, and the null tests.

Ctrl-C leaves out what is missing here; the finished runs are kept.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fpirhc.broken import attempted
from fpirhc.controllers.base import Controller
from fpirhc.review.questions.gain import reviewed_gain
from fpirhc.review.questions.reached_parameters import not_reached
from fpirhc.simulation.model_as_plant import ModelAsPlant
from fpirhc.simulation.simulate import Simulator
from fpirhc.simulation.stepper import Stepper
from fpirhc.studies.comparison.beyond_headline import beaten_by
from fpirhc.studies.comparison.causes import grows
from fpirhc.studies.comparison.entry import no_bound_because
from fpirhc.studies.comparison.null_test import NullTest, null_test
from fpirhc.studies.comparison.outcome import Finding, Outcome
from fpirhc.studies.comparison.timing import measure_price
from fpirhc.task.problem import Problem

if TYPE_CHECKING:
    from fpirhc.studies.comparison.entry import Entry


class Built(NamedTuple):
    """What a controller of a comparison was built to: its loop, and its step by hand, None where that is broken or not needed."""

    loop: Simulator
    stepper: Stepper | None


def beside_each_other(
    problem: Problem, entries: Sequence[Entry], built: Mapping[str, Built], scales: Mapping[str, float]
) -> list[Entry]:
    """Return the entries with what only shows beside the others.

    Args:
        problem: of the comparison.
        entries: the controllers that ran.
        built: what they were built to, by name.
        scales: by which errors are judged, by coordinate.
    """
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
    """Return the entries with what a review says of gain and wrong parameters, where a pair's verdict is not plainly positive.

    Args:
        problem: of the comparison.
        entries: the controllers that ran.
        built: what they were built to, by name.
        judged: the verdict so far.
    """
    asked = {finding.pair[1] for finding in judged if finding.pair and finding.outcome is not Outcome.BETTER}
    return [with_causes(problem, e, built[e.name].loop.controller) if e.name in asked else e for e in entries]


def with_causes(problem: Problem, entry: Entry, controller: Controller) -> Entry:
    """Return an entry with what a review says of the gain and of wrong parameters.

    Args:
        problem: of the comparison.
        entry: of an adaptive controller.
        controller: resolved.
    """
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
    """Return the null tests of all pairs (without adaptation, with it), in their order.

    Args:
        problem: of the comparison.
        pairs: names of the controllers.
        entries: the controllers that ran.
        built: what they were built to, by name.
        scales: by which errors are judged, by coordinate.
        seed: of the sensors' noise.
        broken: takes a sentence for every test that could not be made.
    """
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
