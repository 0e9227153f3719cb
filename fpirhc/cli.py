"""The command line: one function per command; its signature is its options, its docstring its help."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib.util import find_spec
from os.path import isdir
from pathlib import Path
from typing import Annotated, Any

import typer

import fpirhc.options as opt
from fpirhc import __version__
from fpirhc.options import command, given


def _task(problem: str, settings: Sequence[str] | None = None, controllers: Sequence[str] | None = None) -> Any:
    from fpirhc.problem_files.problem_file import load_problem, with_numbers_of_all

    task = load_problem(problem)
    return with_numbers_of_all(task, opt.numbers(settings), controllers) if settings else task


def _publish(view: Any, page: str, folder: Path, as_json: bool, verbose: bool) -> None:
    from fpirhc.report.terminal import show
    from fpirhc.studies import to_json
    from fpirhc.whole_file import write_whole

    facts = to_json(view.facts)
    write_whole(page, folder / "report.html", "report")
    write_whole(f"{facts}\n", folder / "results.json", "report")
    print(facts) if as_json else show(view, folder / "report.html", verbose=verbose)


@command(
    "compare two_mass",
    "compare my_arm.py -c RHC RHC+FPI --set deformation.gain=-1.2",
    "compare cart_pole --plans    their first plans, with certificates, and no run",
)
def compare(
    problem: opt.Problem, controllers: opt.Controllers = None, set_: opt.Set = None,
    plans: Annotated[bool, typer.Option("--plans", help="certify the first plan of every controller, and run none")] = False,
    seed: opt.Seed = 0, out: opt.Out = None, no_compile: opt.NoCompile = False, json: opt.Json = False,
    verbose: opt.Verbose = False,
) -> None:  # fmt: skip
    """Run controllers side by side and write a report. It names the winner, by how much, and at what price.

    Exit code 1: no controller follows its reference, or none finishes; the verdict alone changes no code. With -c or --set the
    report goes to results/PROBLEM/part.
    """
    task = _task(problem, set_, controllers)
    from fpirhc.report.html import render
    from fpirhc.report.terminal import announce_backend, progress_bars, show_plans
    from fpirhc.status import Status
    from fpirhc.studies.compare import compare as run
    from fpirhc.studies.compare import select
    from fpirhc.studies.open_loop import first_plans

    named = list(select(task, controllers)) if controllers else None
    if plans:
        with progress_bars() as progress:
            progress("first plans", 0, 1)
            solved = first_plans(task, named)
        show_plans(task.name, solved)
        raise typer.Exit(0 if all(one.plan.status == Status.OK for one in solved) else 4)
    folder = opt.folder_of(out, task.name, *["part"] * bool(controllers or set_))
    with progress_bars() as progress:
        result = run(task, seed=seed, controllers=named, compiled=not no_compile, command=_line(), progress=progress)
    announce_backend(entry.run.settings["why not compiled"] for entry in result.entries)
    _publish(result.view, render(result), folder, json, verbose)
    interrupted = any(why.startswith("interrupted") for why in result.skipped.values())
    entries = len(result.entries)
    raise typer.Exit(130 if interrupted else 0 if len(result.lost) < entries else 1 if entries else 2)


def _line() -> str:
    return shlex.join(["fpirhc", *sys.argv[1:]])


@command("review two_mass", "review my_arm.py -c RHC+FPI --mismatch 20%    for plants around the problem's, too")
def review(
    problem: opt.Problem, controllers: opt.Controllers = None, mismatch: opt.Mismatch = 0.0, seed: opt.Seed = 0,
    json: opt.Json = False, verbose: opt.Verbose = False,
) -> None:  # fmt: skip
    """Ask every loop, by short runs, whether it can work. Each no comes with what to do, and ends the command with exit code 1."""
    task = _task(problem)
    from dataclasses import asdict

    from fpirhc.report.terminal import progress_bars, show_review
    from fpirhc.review.review import review as ask
    from fpirhc.studies import to_json
    from fpirhc.studies.compare import select

    with progress_bars() as progress:
        found = ask(task.problem, select(task, controllers), mismatch=mismatch, seed=seed, progress=progress)
    if json:
        answers = {n: [asdict(a) for a in some] for n, some in found.answers.items()}
        print(to_json({"ready": found.ready, "answers": answers}))
    else:
        show_review(found, verbose=verbose)
    raise typer.Exit(0 if found.ready else 1)


@command(
    "run two_mass RHC+FPI",
    "run two_mass RHC+FPI --set deformation.gain=-1.2 limits.inputs.Q1=-50,20",
    "run two_mass RHC+FPI --draw 7 --mismatch 20%    plant number 7 of study --draws N --mismatch 20%",
    "run anaesthesia CTC+FPI --case 'patient 03'",
)
def run(
    problem: opt.Problem, controller: opt.Controller, set_: opt.Set = None,
    case: Annotated[str | None, given("NAME", "in this case of the file")] = None,
    draw: Annotated[int | None, given("K", "with plant number K of study --draws", min=0)] = None,
    mismatch: opt.Mismatch = 0.0, seed: opt.Seed = 0, out: opt.Out = None, no_compile: opt.NoCompile = False,
) -> None:  # fmt: skip
    """Run one controller and save every signal. NAME.npz holds them (fpirhc.load_run reads it), NAME.png draws them."""
    if mismatch and draw is None:
        raise typer.BadParameter("--mismatch is of a drawn plant: give --draw K too")
    task = _task(problem, set_, [controller])
    from dataclasses import replace

    from fpirhc.problem_files.problem_file import in_case
    from fpirhc.studies.compare import select

    task = in_case(task, case) if case else task
    chosen, folder = select(task, [controller])[controller], opt.folder_of(out, task.name)
    from fpirhc.controllers.contract import resolved
    from fpirhc.errors import InvalidProblem, writing
    from fpirhc.report.terminal import announce_backend, progress_bars, say, show_run
    from fpirhc.simulation.metrics import measure
    from fpirhc.simulation.simulate import simulate
    from fpirhc.studies.variants import Draws

    if draw is not None:
        one = Draws(draw + 1, mismatch, seed).of(task)[draw]
        chosen = resolved(task.problem, chosen)  # it does not know what is drawn
        task, seed = replace(task, problem=one.problem), one.seed
    with progress_bars() as progress:
        report = lambda done, total: progress(controller, done, total)  # noqa: E731
        how: dict[str, Any] = {"seed": seed, "name": controller, "compiled": not no_compile, "progress": report}
        try:
            found = simulate(task.problem, chosen, **how)
        except InvalidProblem as error:
            raise InvalidProblem(f"{task.place}{error}") from None
    plain = "".join(c if c.isalnum() or c == "-" else "_" for c in controller)
    files = [folder / f"{plain}.npz", folder / f"{plain}.png"]
    found.save(files[0])
    with writing(folder, "--out"):
        found.plot().savefig(files[1], dpi=120)
    announce_backend([found.settings["why not compiled"]])
    since = f"{task.problem.measure_from:g} {task.problem.time_unit}"
    say(task.title, "bold", f" {controller}: errors from t = {since} on, seed {seed}.")
    show_run(found, measure(task.problem, found, task.metrics), files)
    raise typer.Exit(0 if found.stop is None else 4)


@command(
    "study two_mass --draws 100 --mismatch 20%        exact parameters within 20 % of the problem's",
    "study anaesthesia --cases all --metric in_band",
    "study two_mass --over deformation.gain=-2:-0.1:40 exact.m1=0.5:2:9:log -c RHC+FPI",
    "study two_mass --margins latency noise            up to where each controller fails",
)
def study(
    problem: opt.Problem, cases: opt.Cases = None, draws: Annotated[int | None, opt.Count] = None,
    over: Annotated[list[str] | None, given("PATH=LOW:HIGH:COUNT[:log] ...", "sweep one or two settings")] = None,
    margins: Annotated[list[str] | None, given("WORD ...", "what grows: mismatch, plants, latency, noise, lost")] = None,
    mismatch: opt.Mismatch = 0.0, controllers: opt.Controllers = None,
    metric: Annotated[str | None, given("NAME", "number by which runs are compared [default: the error]")] = None,
    processes: Annotated[int | None, given("N", "number of processes [default: one per core]", min=1)] = None,
    seed: opt.Seed = 0, out: opt.Out = None, no_compile: opt.NoCompile = False, json: opt.Json = False,
    verbose: opt.Verbose = False,
) -> None:  # fmt: skip
    """Run controllers in many variants of a problem. Variants are named cases, drawn plants, or swept settings; or one quantity
    grows until each controller fails (--margins).

    Every controller is compared with the first one, or with the first of the file's headline. study.csv has every run and its
    parameters; the same command goes on after an interruption.
    """
    if mismatch and not draws:
        raise typer.BadParameter("--mismatch is of drawn plants: give --draws N too")
    if sum(map(bool, (cases, draws, over, margins))) != 1:
        raise typer.BadParameter("give one of --cases, --draws, --over, --margins")
    if margins and (metric or (processes or 1) > 1):
        raise typer.BadParameter("--margins takes the error, run by run: leave out --metric and --processes")
    task = _task(problem)
    from fpirhc.simulation.simulate import SWITCHED_OFF
    from fpirhc.studies.compare import select
    from fpirhc.studies.margins import margins as find_margins
    from fpirhc.studies.study import figure_of
    from fpirhc.studies.study import study as run_study
    from fpirhc.studies.variants import CasesOf, Draws, Grid, Variants
    from fpirhc.summary import write_csv

    select(task, controllers)
    folder = opt.folder_of(out, task.name, "draws" if draws else "cases" if cases else "over" if over else "margins")
    from fpirhc.report.html import render_charted
    from fpirhc.report.terminal import announce_backend, progress_bars
    from fpirhc.symbolic.native import find_compiler, why_no_compiler

    announce_backend([SWITCHED_OFF if no_compile else "" if find_compiler() else why_no_compiler()])
    with progress_bars() as progress:
        facts: dict[str, Any] = {"controllers": controllers, "compiled": not no_compile, "command": _line()}
        facts["progress"] = progress
        if margins:
            result: Any = find_margins(task, over=margins, seed=seed, folder=folder, **facts)
            page = render_charted(result.view)
        else:
            named: Variants = Draws(draws, mismatch, seed) if draws else CasesOf(tuple(cases or ()), seed)
            variants = Grid.parsed(over, seed) if over else named
            facts["processes"] = processes or -1
            result = run_study(task, variants, metric=metric, folder=folder, **facts)
            page = render_charted(result.view, figure_of(result))
    write_csv(result.table, folder / "study.csv")
    _publish(result.view, page, folder, json, verbose)


@command(
    "probe my_arm.py                             excitation, candidates, trials, and a line to paste",
    "probe my_arm.py --cycles 500 --no-trials    for a plant at risk: nothing but the excitation is run",
    "probe my_arm.py --recording run.csv         from a record of a run",
)
def probe(
    problem: opt.Problem, controller: Annotated[
        str | None, typer.Option("--controller", "-c", metavar="NAME", help="runs the plant [default: first that can]")
    ] = None,
    cycles: Annotated[int | None, given("N", "length of the excitation [default: 300]")] = None,
    amplitude: Annotated[float | None, given("NUMBER", "its size, in the response's unit [default: by a first run]")] = None,
    recording: Annotated[Path | None, given("CSV", "estimate from a run: time, what is measured, inputs after it")] = None,
    chatter: Annotated[float | None, given("NUMBER", "largest rms step of a command [default: 1.5 times the controller's]")] = None,
    trials: Annotated[bool, typer.Option(help="try candidates on the plant itself")] = True, seed: opt.Seed = 0,
    json: opt.Json = False,
) -> None:  # fmt: skip
    """Measure an unknown plant and propose an adaptation. Exit code 1 where none is proposed."""
    task = _task(problem)
    from fpirhc.errors import NotSupported, require
    from fpirhc.probing import probe as probing
    from fpirhc.report.terminal import progress_bars, show_probe
    from fpirhc.studies import to_json
    from fpirhc.studies.compare import select

    able = list[str]()
    for name, one in select(task, [controller] if controller else None).items():
        with suppress(NotSupported):
            one.with_deformation(one.deformation)
            able += [name] * (one.deforms == "response")
    asked = controller or task.name
    require(able, f"probe needs a controller that deforms the response, such as ComputedTorque; '{asked}' has none")
    name, one = able[0], task.controllers[able[0]]
    settings: dict[str, Any] = {"cycles": cycles, "amplitude": amplitude, "recording": recording, "chatter": chatter}
    print(f"fpirhc: {probing.runs_made(task.problem, trials=trials, **settings)}", file=sys.stderr)
    with progress_bars() as progress:
        answer = probing.probe(task.problem, one, trials=trials, seed=seed, progress=progress, **settings)
    print(to_json(answer.plain)) if json else show_probe(f"{task.name}: probe with {name}", answer)
    raise typer.Exit(0 if answer.deformation is not None else 1)


@command(
    "tune two_mass                                   50 trials of every controller that may be tuned",
    "tune two_mass --trials 200 --draws 5 --mismatch 20%    each trial on 5 plants; goes on after finished trials",
)
def tune(
    problem: opt.Problem, controllers: opt.Controllers = None,
    trials: Annotated[int, given("N", "number of trials of every controller", min=1, max=1_000_000)] = 50,
    draws: Annotated[int | None, opt.Count] = None, mismatch: opt.Mismatch = 0.0, cases: opt.Cases = None,
    metric: Annotated[str | None, given("NAME", "number that is to become better [default: the error]")] = None,
    seed: opt.Seed = 0, out: opt.Out = None, json: opt.Json = False,
) -> None:  # fmt: skip
    """Search better settings, at equal cost for every controller. The problem file says what is searched: tuning = {...}."""
    task = _task(problem)
    from fpirhc.report.terminal import progress_bars
    from fpirhc.studies.tune import tune as ask
    from fpirhc.studies.variants import CasesOf, Draws

    if mismatch and not draws:
        raise typer.BadParameter("--mismatch is of drawn plants: give --draws N too")
    drawn = Draws(draws, mismatch, seed + 10**6) if draws else None  # never the plants of a comparison
    variants = CasesOf(tuple(cases), seed) if cases else drawn
    facts: dict[str, Any] = {"trials": trials, "seed": seed, "controllers": controllers, "metric": metric}
    with progress_bars() as progress:
        found = ask(task, variants=variants, folder=opt.folder_of(out, task.name, "tuning"), progress=progress, **facts)
    table = found.table
    print(table.to_json(orient="records") if json else f"{table.to_string(index=False)}\n\n{found.python()}")


@command(
    "check                        every problem of ./problems, or of this folder",
    "check my_arm.py work/arms    these problems, and those of a folder",
    "check --ignore-below 0.1%    another machine or library, whose last digits differ",
)
def check(
    problems: Annotated[list[str] | None, typer.Argument(metavar="PROBLEM", help="[default: all of this folder]")] = None,
    ignore_below: Annotated[float, given("PERCENT", "smaller changes than this count as none", parser=opt.percent)] = 0.0,
    baselines: opt.Baselines = None, processes: opt.Processes = 1, no_compile: opt.NoCompile = False,
) -> None:  # fmt: skip
    """Compare fresh results with their baselines. Exit code 5: a metric changed; 6: a baseline is missing or unusable; the highest
    one of all problems counts, and one that cannot be run (2) stops no other.
    """
    from fpirhc.baselines.baseline import Judgement, problems_here
    from fpirhc.baselines.baseline import check as judge
    from fpirhc.errors import FpirhcError
    from fpirhc.report.terminal import progress_bars, say
    from fpirhc.summary import printable

    facts: dict[str, Any] = {"baselines": baselines, "processes": processes, "compiled": not no_compile}
    found, broken = list[Judgement](), list[str]()
    every = [one for name in problems or ["."] for one in (problems_here(Path(name)) if isdir(name) else [name])]
    with progress_bars() as progress:
        for name in every:
            try:
                found.append(judge(_task(str(name)), ignore=ignore_below / 100, progress=progress, **facts))
            except FpirhcError as error:
                broken.append(str(error))
    for one in found:
        say(one.text, "" if one.holds else "bold red", wrap=False)
    for text in broken:
        print(f"fpirhc: {printable(text)}", file=sys.stderr)
    raise typer.Exit(max([2 * bool(broken), *(6 if one.unusable else 5 * (not one.holds) for one in found)]))


@command(
    'accept my_arm.py --reason "20 -> 30 stages"     the new numbers are right, and why',
    'accept my_arm.py --reason "new" --seeds 20      bands from more seeds, where there is noise',
)
def accept(
    problem: opt.Problem, reason: Annotated[str, given("TEXT", "why the new numbers are right")],
    seed: opt.Seed = 0, seeds: Annotated[int, given("N", "number of noise seeds from which the bands follow", min=2)] = 8,
    baselines: opt.Baselines = None, processes: opt.Processes = 1, no_compile: opt.NoCompile = False,
) -> None:  # fmt: skip
    """Measure a problem anew and write its baseline. fpirhc check compares later results with it."""
    task = _task(problem)
    from fpirhc.baselines.baseline import accept as write
    from fpirhc.report.terminal import progress_bars

    facts: dict[str, Any] = {"baselines": baselines, "processes": processes, "compiled": not no_compile}
    with progress_bars() as progress:
        path = write(task, reason, seed=seed, seeds=seeds, progress=progress, **facts)
    print(f"baseline: {path}")


@command("new my_arm", "new my_arm --dir problems")
def new(
    name: Annotated[str, typer.Argument(metavar="NAME", help="name of the problem; letters, digits and _, as in Python")],
    folder: Annotated[Path, typer.Option("--dir", metavar="FOLDER", help="folder of the files")] = Path(),
) -> None:  # fmt: skip
    """Write a problem file and its test to start from."""
    from fpirhc.scaffold import create_problem

    problem, test = create_problem(name, folder)
    print(f"wrote {problem}, which runs as it is: put your equations into it\nwrote {test}")
    install = "" if find_spec("pytest") else "pip install pytest; "
    print(f"next: fpirhc review {problem}; fpirhc compare {problem}; {install}python -m pytest {test}")


@command("list", name="list")
def list_() -> None:
    """List the shipped problems."""
    from fpirhc.problem_files.shipped import shipped_groups, title_of

    for title, problems in shipped_groups().items():
        print(title, *(f"  {name:24s} {title_of(path)}" for name, path in problems.items()), sep="\n")


@command("doctor")
def doctor(json: opt.Json = False) -> None:
    """Say what is installed, what is missing, and how to get it. Exit code 7 where something that is needed is broken; a part that
    is missing and has a substitute (warn), or that few need (none), ends with 0.
    """
    from fpirhc.doctor import examine, written

    findings = [*examine()]
    print(written(findings, json))
    raise typer.Exit(7 if any(outcome == "fail" for _, outcome, *_ in findings) else 0)


@command(
    "export two_mass RHC+FPI --out device                    C99 in the folder device",
    "export two_mass RHC+FPI --live deformation.gain limits.inputs.Q1.1",
    "export two_mass RHC+FPI --to fmu2                       a unit for co-simulation",
    "export two_mass RHC+FPI --to lab                        a page with sliders",
)
def export(
    problem: opt.Problem, controller: opt.Controller,
    out: Annotated[Path | None, given("FOLDER", "new or empty folder [default: results/PROBLEM/TARGET]")] = None,
    to: Annotated[str, given("TARGET", "what is written: c, arduino, fmu2, library, wasm, or lab")] = "c",
    live: Annotated[list[str] | None, given("PATH ...", "settings that can be changed on the device")] = None,
    name: Annotated[str | None, given("NAME", "prefix of all names in C [default: problem and controller]")] = None,
) -> None:  # fmt: skip
    """Write a controller for use without Python. C99 for a device, a unit of FMI 2, WebAssembly, or a page with sliders."""
    task = _task(problem)
    from fpirhc.errors import InvalidName
    from fpirhc.export import device_of, targets, write
    from fpirhc.report.terminal import progress_bars
    from fpirhc.studies.compare import select

    chosen, folder = select(task, [controller])[controller], out or Path("results", task.name, to)
    if to == "lab":
        from fpirhc.export.web import write_lab

        if live:
            raise typer.BadParameter("--live: a lab has sliders of parameters, gains and limits of inputs, no others")
        page = opt.folder_of(folder) / f"{task.name}-lab.html"
        write_lab(task, problem, {controller: chosen}, page)
        print(f"wrote {page}")
        return
    if to not in targets():
        raise InvalidName(f"the target '{to}' is unknown; one of {', '.join([*targets(), 'lab'])}")
    with progress_bars() as progress:
        progress(controller, 0, 1)  # bounds of many live settings take a minute
        device = device_of(task.problem, chosen, controller, name=name, live=live or [])
    for file in write(device, targets()[to], folder):
        print(f"wrote {file}")


@opt.app.callback(invoke_without_command=True)
def about(
    version: Annotated[bool, typer.Option("--version", help="print the version")] = False,
    _debug: Annotated[bool, typer.Option("--debug", help="print the traceback of an error; may stand anywhere")] = False,
) -> None:  # fmt: skip
    """What stands before a command."""
    if version:
        print(f"fpirhc {__version__}")
