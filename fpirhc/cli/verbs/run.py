"""`fpirhc run PROBLEM CONTROLLER`: one run, saved with every signal."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from fpirhc.cli.options import (
    add_controller,
    add_mismatch,
    add_no_compile,
    add_out,
    add_problem,
    add_seed,
    add_set,
    numbers,
    whole,
)
from fpirhc.cli.output import results_folder
from fpirhc.cli.verb import ExitCode, Verb

if TYPE_CHECKING:
    from fpirhc.controllers.base import Controller
    from fpirhc.simulation.run import Run
    from fpirhc.task.problem import Problem


_SETPOINT = "setpoints."  # before a coordinate, in place of the path of a setting


def _add(parser: argparse.ArgumentParser) -> None:
    add_problem(parser)
    add_controller(parser)
    add_out(parser)
    add_seed(parser, "the noise")
    add_no_compile(parser)
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--case", metavar="NAME", help="run the problem in this case of the problem file")
    text = "run scenario K of 'fpirhc compare --scenarios' with this seed and mismatch"
    which.add_argument("--scenario", type=whole(0), metavar="K", help=text)
    add_mismatch(parser, None)
    add_set(parser, "; or a set-point, setpoints.q1=2")


def _run(options: argparse.Namespace) -> ExitCode:
    from fpirhc.problem_files.problem_file import in_case, load_problem

    task = load_problem(options.problem)  # what is wrong with it is said before the rest is imported
    from fpirhc.errors import InvalidValue
    from fpirhc.report.figures import save_figure
    from fpirhc.report.terminal import announce_backend, progress_bars, show_run
    from fpirhc.simulation.metrics import measure
    from fpirhc.studies.comparison.compare import check_gains, select
    from fpirhc.studies.comparison.pairwise import harm_of_adaptation
    from fpirhc.studies.scenarios.draws import COMPARING, RandomScenarios

    task = in_case(task, options.case) if options.case else task
    name, seed = options.controller, options.seed
    controller = select(task, [name])[name]
    if not options.settings:
        check_gains(task, {name: controller})
    if options.scenario is not None:
        scenarios = RandomScenarios(task.problem, seed, COMPARING, options.mismatch or 0.0)
        one = scenarios[options.scenario]
        task, controller, seed = replace(task, problem=one.problem), scenarios.automatic(controller), one.seed
    elif options.mismatch is not None:
        raise InvalidValue("--mismatch belongs to --scenario K, the number of a scenario")
    folder = results_folder(options.out, task.name)
    settings, points = by_kind(numbers(options.settings))
    with progress_bars() as progress:
        progress(name, 0, task.problem.cycles)  # while its loop is built
        run, problem, built = _simulated(
            task.problem,
            controller,
            settings,
            points,
            seed=seed,
            name=name,
            compiled=not options.no_compile,
            progress=partial(progress, name),
        )
    which = options.case or ("" if options.scenario is None else f"scenario {options.scenario}")
    stem = "".join(c if c.isalnum() or c == "-" else "_" for c in f"{name} {which}".strip())
    run.save(folder / f"{stem}.npz")
    save_figure(run.plot(), folder / f"{stem}.png")
    announce_backend([run])
    facts = {"seed": seed, "compiled": not options.no_compile, "metrics": task.metrics}
    with progress_bars() as progress:  # of a run with the file's set-points
        harm = () if points else harm_of_adaptation(name=name, **built, **facts, progress=progress)
    show_run(
        run, measure(problem, run, task.metrics), harm, [folder / f"{stem}{ending}" for ending in (".npz", ".png")]
    )
    return ExitCode.FINISHED if run.stop is None else ExitCode.ENDED_EARLY


def by_kind(
    values: Mapping[str, float | tuple[float, ...]],
) -> tuple[dict[str, float | tuple[float, ...]], dict[str, float] | None]:
    """Return the numbers of settings by path, and the set-points by coordinate; None without set-points."""
    from fpirhc.errors import InvalidValue

    points: dict[str, float] = {}
    for path, value in values.items():
        if path.startswith(_SETPOINT):
            if isinstance(value, tuple):
                raise InvalidValue(f"--set {path}: a set-point is one number; steps stand in the problem file")
            points[path.removeprefix(_SETPOINT)] = value
    return {path: value for path, value in values.items() if not path.startswith(_SETPOINT)}, points or None


def _simulated(
    problem: Problem,
    controller: Controller,
    settings: Mapping[str, float | tuple[float, ...]],
    setpoints: Mapping[str, float] | None,
    **run: Any,
) -> tuple[Run, Problem, dict[str, Any]]:
    """The run, its problem, and what its loop was built of; settings are live, which need no compiler, where they can be."""
    from fpirhc.controllers.live_settings import OF_PROBLEM, live_settings
    from fpirhc.errors import NotSupported
    from fpirhc.problem_files.settings import as_declared, is_own, of_problem, with_numbers, with_settings
    from fpirhc.simulation.simulate import simulate
    from fpirhc.simulation.trials import with_recommended_gain

    run["setpoints"] = setpoints
    own = {p: word for p in settings if (word := of_problem(problem, p)) and not is_own(controller, p)}
    data = [p for p, word in own.items() if word.partition(".")[0] not in OF_PROBLEM]
    problem = with_numbers(problem, {p: settings[p] for p in data})
    settings = {p: v for p, v in settings.items() if p not in data}
    if not settings:
        return simulate(problem, controller, **run), problem, {"problem": problem, "controller": controller}
    with with_recommended_gain(problem, _with_gains(controller, settings)):
        try:
            live = simulate(problem, controller, settings=settings, **run)
            changed, _, _ = live_settings(problem, controller, list(settings)).changed(settings)
            return live, changed, {"problem": problem, "controller": controller, "settings": settings}
        except NotSupported:
            changed = with_numbers(problem, {p: v for p, v in settings.items() if p in own})
            rebuilt = with_settings(
                controller, as_declared(controller, {p: v for p, v in settings.items() if p not in own})
            )
            return simulate(changed, rebuilt, **run), changed, {"problem": changed, "controller": rebuilt}


def _with_gains(controller: Controller, settings: Mapping[str, Any]) -> Controller:
    """The controller with those settings that are numbers of its deformation; itself where they are wrong, which a run says."""
    from fpirhc.errors import FpirhcError
    from fpirhc.problem_files.settings import with_settings

    try:
        return with_settings(controller, {p: v for p, v in settings.items() if p.startswith("deformation.")})
    except FpirhcError:
        return controller


VERB = Verb(
    name="run",
    summary="run one controller and save every signal",
    group="run",
    add=_add,
    run=_run,
    codes={
        ExitCode.NOT_WRITABLE: ExitCode.NOT_WRITABLE.meaning,
        ExitCode.ENDED_EARLY: "the run ended early; its reason is named, and the cycles before it are saved",
    },
    examples=(
        ('fpirhc run two_mass "RHC+FPI"', "one run, saved as .npz and .png"),
        (
            'fpirhc run two_mass "RHC+FPI" --set deformation.gain=-1.2',
            "another gain; other numbers of it share one compiled loop",
        ),
        ('fpirhc run two_mass "RHC+FPI" --set exact.m1=1.4 --set start.q1=2', "another plant and another start"),
        ('fpirhc run anaesthesia "CTC+FPI" --case "patient 02"', "the problem in a case of its file"),
        (
            'fpirhc run two_mass "RHC+FPI" --scenario 14 --mismatch 20',
            "a scenario of compare --scenarios, with every signal",
        ),
        ('fpirhc run my_arm.py "RHC+FPI" --out results --seed 3', "another folder, other noise"),
    ),
)
