"""What speaks against the adaptation of one controller, judged beside itself without adaptation.

Both run on the plant and on the model as plant, so a command that runs one controller says what a comparison of the pair would say;
and so a comparison judges a row whose pair is no row. A plant outside is not run for that: then the null test stands alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import without_deformation
from fpirhc.errors import FpirhcError
from fpirhc.simulation.metrics import Metric, measure
from fpirhc.simulation.model_as_plant import ModelAsPlant
from fpirhc.simulation.simulate import Simulator, judged_run, simulator
from fpirhc.simulation.trials import weighed
from fpirhc.studies.comparison.caveats import yardstick_of
from fpirhc.studies.comparison.changes import scales
from fpirhc.studies.comparison.entry import Entry
from fpirhc.studies.comparison.null_test import null_test
from fpirhc.studies.comparison.outcome import Outcome
from fpirhc.studies.comparison.pairwise import with_causes
from fpirhc.studies.comparison.verdict import judge
from fpirhc.task.problem import Problem


def harm_of_adaptation(
    problem: Problem,
    name: str,
    controller: Controller,
    *,
    seed: int,
    compiled: bool,
    metrics: Sequence[Metric] | None = None,
) -> tuple[str, ...]:
    """Return a sentence for a run in which adaptation raises the error, and one for a null test that it fails.

    Empty without harm, for a controller that does not adapt, and for one that has no pair or cannot run.

    Args:
        problem: with its two sets of parameters.
        name: of the controller.
        controller: with its deformation.
        seed: of the disturbances and the noise.
        compiled: whether the loops are compiled to C.
        metrics: of the task.
    """
    if not controller.deformation.adapts:
        return ()
    try:
        both = without_deformation(controller), controller
        return _harm(problem, (f"{name} without adaptation", name), both, seed, compiled, metrics)
    except FpirhcError:
        return ()


def _harm(
    problem: Problem,
    pair: tuple[str, str],
    controllers: tuple[Controller, Controller],
    seed: int,
    compiled: bool,
    metrics: Sequence[Metric] | None,
) -> tuple[str, ...]:
    bare, adapting = controllers
    loops = simulator(problem, bare, compiled=compiled), simulator(problem, adapting, compiled=compiled)
    sizes, model, counted = scales(problem), ModelAsPlant(problem, seed=seed), weighed(problem, loops[1].controller)
    losses: list[str] = []
    cured: Mapping[str, float] = dict.fromkeys(problem.judged_names, 0.0)
    if problem.foreign is None:
        plain, adaptive = (_entry(problem, n, one, seed, metrics) for n, one in zip(pair, loops, strict=True))
        yardstick = yardstick_of(problem, seed=seed)
        finding = judge(plain, adaptive, yardstick)
        if finding.outcome is Outcome.WORSE:
            finding = judge(plain, with_causes(problem, adaptive, loops[1].controller), yardstick)
        losses, cured = [finding.text] * (finding.outcome is Outcome.WORSE), plain.metrics.rms_error
    test = null_test(model, loops, pair, sizes, counted, cured=cured)
    return (*losses, *([test.text] if test.harmful else []))


def partners(
    problem: Problem,
    entries: Sequence[Entry],
    controllers: Mapping[str, Controller],
    *,
    seed: int,
    compiled: bool,
    metrics: Sequence[Metric] | None = None,
) -> tuple[dict[str, tuple[Entry, Simulator]], dict[str, str]]:
    """Return runs without adaptation of the adaptive rows that have no pair, by row, and why others have none.

    Args:
        problem: of the comparison.
        entries: its rows.
        controllers: their controllers, by name.
        seed: of the disturbances and the noise.
        compiled: whether the loops are compiled to C.
        metrics: of the task.
    """
    found: dict[str, tuple[Entry, Simulator]] = {}
    missing: dict[str, str] = {}
    for name in (e.name for e in entries if e.adaptive and e.pair is None):
        try:
            problem.require_equations("its pair is not among the controllers, and the plant is outside")
            loop = simulator(problem, without_deformation(controllers[name]), compiled=compiled)
            found[name] = _entry(problem, f"{name} without adaptation", loop, seed, metrics), loop
        except FpirhcError as error:
            missing[name] = f"it cannot run without adaptation ({error})"
        except KeyboardInterrupt:
            missing[name] = "interrupted before it ran without adaptation"
            break
    return found, missing


def _entry(problem: Problem, name: str, loop: Simulator, seed: int, metrics: Sequence[Metric] | None) -> Entry:
    """A row of a comparison with what a verdict reads."""
    run = judged_run(loop, seed=seed, name=name)
    counted = weighed(problem, loop.controller)
    adapts = loop.controller.deformation.adapts
    return Entry(name, run, measure(problem, run, metrics), None, adapts, None, None, weighed=counted)
