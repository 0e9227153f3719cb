"""The command line: one function per command; its signature is its options, its docstring its help.

Exit codes: 0 finished; 1 review answered no; 2 bad input; 3 a file cannot be written; 4 a run ended early; 5 a metric changed;
6 no usable baseline; 7 a faulty installation; 70 an error inside fpirhc; 130 interrupted.
"""

from __future__ import annotations

import sys
import traceback
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

app = typer.Typer(
    no_args_is_help=True, add_completion=True, pretty_exceptions_enable=False, help=__doc__, rich_markup_mode=None
)

Problem = Annotated[str, typer.Argument(help="name of a shipped problem, or path of a problem file")]
Controller = Annotated[str, typer.Argument(help="name of a controller of the problem")]
Controllers = Annotated[
    list[str] | None, typer.Option("--controllers", "-c", help="only these controllers; again for each")
]
Out = Annotated[Path | None, typer.Option(help="folder for the results [default: results/PROBLEM]")]
Seed = Annotated[int, typer.Option(min=0, help="seed of noise and draws")]
Mismatch = Annotated[
    float, typer.Option(min=0, help="exact parameters and dead times within so many percent of the problem's")
]
Set = Annotated[
    list[str] | None, typer.Option("--set", help="PATH=NUMBER: another number of a setting, exact.m1=1.4 or start.q1=2")
]
Json = Annotated[bool, typer.Option("--json", help="print one JSON object")]
NoCompile = Annotated[bool, typer.Option("--no-compile", help="run loops in CasADi's virtual machine")]
Processes = Annotated[int, typer.Option(min=1, help="number of processes")]
Cases = Annotated[
    list[str] | None, typer.Option(help="cases of the problem file, by name or group, or all; again for each")
]
Baselines = Annotated[Path | None, typer.Option(help="folder of the baselines [default: baselines beside the problem]")]


def _task(problem: str, settings: list[str] | None = None) -> Any:
    from fpirhc.problem_files.problem_file import load_problem, with_numbers_of_all

    task = load_problem(problem)
    return with_numbers_of_all(task, _numbers(settings), None) if settings else task


def _numbers(settings: list[str]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for text in settings:
        path, _, value = text.partition("=")
        try:
            parts = tuple(map(float, value.split(",")))
        except ValueError:
            raise typer.BadParameter(
                f"--set {text}: expected PATH=NUMBER, or PATH=LOWER,UPPER for an interval"
            ) from None
        values[path] = parts if len(parts) > 1 else parts[0]
    return values


def _folder(out: Path | None, *default: str) -> Path:
    folder = out or Path("results", *default)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _publish(view: Any, page: str, folder: Path, as_json: bool) -> None:
    from fpirhc.report.terminal import show
    from fpirhc.studies.view import to_json
    from fpirhc.whole_file import write_whole

    facts = to_json(view.facts)
    write_whole(page, folder / "report.html", "report")
    write_whole(f"{facts}\n", folder / "results.json", "report")
    print(facts) if as_json else show(view, folder / "report.html")


def _command() -> str:
    import shlex

    return shlex.join(["fpirhc", *sys.argv[1:]])


@app.command()
def compare(
    problem: Problem, controllers: Controllers = None, set_: Set = None, optimisers: list[str] | None = None, seed: Seed = 0,
    out: Out = None, no_compile: NoCompile = False, json: Json = False,
) -> None:  # fmt: skip
    """Run several controllers on one problem and write a report."""
    task = _task(problem, set_)
    from fpirhc.report.html import render
    from fpirhc.report.terminal import announce_backend, progress_bars
    from fpirhc.studies.comparison.compare import compare as run
    from fpirhc.studies.open_loop import with_optimisers

    if optimisers:
        task, controllers = with_optimisers(task, optimisers, controllers), None
    with progress_bars(as_json=json) as progress:
        result = run(
            task, seed=seed, controllers=controllers, compiled=not no_compile, command=_command(), progress=progress
        )
    announce_backend(entry.run for entry in result.entries)
    _publish(result.view, render(result), _folder(out, task.name), json)
    raise typer.Exit(0 if result.entries else 2)


@app.command()
def review(
    problem: Problem, controllers: Controllers = None, mismatch: Mismatch = 0.0, seed: Seed = 0, json: Json = False
) -> None:
    """Answer before a run: well posed, gains, limits, margins, convergence. Exit code 1 where an answer is no."""
    task = _task(problem)
    from dataclasses import asdict

    from fpirhc.report.terminal import say
    from fpirhc.review.review import review as ask
    from fpirhc.studies.comparison.compare import select
    from fpirhc.studies.view import to_json

    found = ask(task.problem, select(task, controllers), mismatch=mismatch, seed=seed)
    if json:
        print(
            to_json(
                {"ready": found.ready, "answers": {n: [asdict(a) for a in some] for n, some in found.answers.items()}}
            )
        )
    else:
        for name, answers in found.answers.items():
            say(f"\n{name}", "bold")
            for one in answers:
                say(f"  {one.verdict:7s} {one.question} ({one.evidence}) {one.change}", wrap=False)
        say(", ".join(found.counts()))
    raise typer.Exit(0 if found.ready else 1)


@app.command()
def run(
    problem: Problem, controller: Controller, set_: Set = None, case: str | None = None, draw: int | None = None,
    mismatch: Mismatch = 0.0, seed: Seed = 0, out: Out = None, no_compile: NoCompile = False,
) -> None:  # fmt: skip
    """Run one controller and save every signal, as it stands, in a case of the file, or for a drawn plant."""
    task = _task(problem, set_)
    from dataclasses import replace

    from fpirhc.problem_files.problem_file import in_case
    from fpirhc.report.figures import save_figure
    from fpirhc.report.terminal import announce_backend, progress_bars, show_run
    from fpirhc.simulation.metrics import measure
    from fpirhc.simulation.simulate import simulate
    from fpirhc.studies.comparison.compare import harm_of_adaptation, select
    from fpirhc.studies.variants import Draws

    task = in_case(task, case) if case else task
    chosen = select(task, [controller])[controller]
    if draw is not None:
        one = Draws(draw + 1, mismatch, seed).of(task)[draw]
        task, seed = replace(task, problem=one.problem), one.seed
    with progress_bars() as progress:
        report = lambda done, total: progress(controller, done, total)  # noqa: E731
        found = simulate(task.problem, chosen, seed=seed, name=controller, compiled=not no_compile, progress=report)
    stem = _folder(out, task.name) / "".join(c if c.isalnum() or c == "-" else "_" for c in controller)
    found.save(stem.with_suffix(".npz"))
    save_figure(found.plot(), stem.with_suffix(".png"))
    announce_backend([found])
    harm = harm_of_adaptation(task.problem, controller, chosen, seed=seed)
    show_run(found, measure(task.problem, found, task.metrics), harm, [stem.with_suffix(s) for s in (".npz", ".png")])
    raise typer.Exit(0 if found.stop is None else 4)


@app.command()
def study(
    problem: Problem, cases: Cases = None, draws: Annotated[int | None, typer.Option(help="plants drawn at random")] = None,
    over: Annotated[list[str] | None, typer.Option(help="PATH=LOW:HIGH:COUNT[:log], once or twice")] = None,
    limits: Annotated[list[str] | None, typer.Option(help="mismatch, plants, latency, noise, lost: up to where a run fails")] = None,
    mismatch: Mismatch = 0.0, controllers: Controllers = None, headline: str | None = None, processes: Processes = 1,
    cluster: str | None = None, seed: Seed = 0, out: Out = None, no_compile: NoCompile = False, json: Json = False,
) -> None:  # fmt: skip
    """Run every controller in many variants: cases, drawn plants, settings, or up to where it fails. study.csv has every run."""
    task = _task(problem)
    from contextlib import ExitStack

    import joblib

    from fpirhc.errors import package
    from fpirhc.report.html import render_charted
    from fpirhc.report.terminal import progress_bars
    from fpirhc.studies.limits import limits as find_limits
    from fpirhc.studies.study import figure_of
    from fpirhc.studies.study import study as run_study
    from fpirhc.studies.variants import CasesOf, Draws, Grid

    if sum(map(bool, (cases, draws, over, limits))) != 1:
        raise typer.BadParameter("give one of --cases, --draws, --over, --limits")
    folder, facts = (
        _folder(out, task.name, "study"),
        {"controllers": controllers, "compiled": not no_compile, "command": _command()},
    )
    with ExitStack() as stack:
        facts["progress"] = stack.enter_context(progress_bars(as_json=json))
        if cluster:
            stack.enter_context(package("distributed", "cluster", "--cluster").Client(cluster))
            stack.enter_context(joblib.parallel_config(backend="dask"))
        if limits:
            result = find_limits(task, over=limits, **facts)
            page = render_charted(result.view)
        else:
            variants = (
                CasesOf(tuple(cases), seed)
                if cases
                else Draws(draws, mismatch, seed)
                if draws
                else Grid.parsed(over, seed)
            )
            result = run_study(task, variants, headline=headline, processes=processes, folder=folder, **facts)
            page = render_charted(result.view, figure_of(result), "Every run", "")
    result.table.to_csv(folder / "study.csv", index=False)
    _publish(result.view, page, folder, json)


@app.command()
def probe(
    problem: Problem, controller: Annotated[str | None, typer.Option(help="the one that keeps the plant safe")] = None,
    cycles: int | None = None, amplitude: float | None = None, recording: Path | None = None, chatter: float | None = None,
    trials: bool = True, seed: Seed = 0, json: Json = False,
) -> None:  # fmt: skip
    """Excite a plant that nobody knows, and find the adaptation that suits it. Exit code 1 where none is proposed."""
    task = _task(problem)
    from fpirhc.errors import NotSupported
    from fpirhc.probing.probe import probe as ask
    from fpirhc.report.terminal import say, show_table
    from fpirhc.studies.comparison.compare import select
    from fpirhc.studies.view import to_json
    from fpirhc.summary import Column, Table, written_out

    for name, one in select(task, [controller] if controller else None).items():
        try:
            one.with_deformation(one.deformation)
        except NotSupported:
            continue
        break
    else:
        raise NotSupported("probe needs a controller with a deformation: choose another one by --controller")
    settings = {"cycles": cycles, "amplitude": amplitude, "recording": recording, "chatter": chatter}
    answer = ask(task.problem, one, trials=trials, seed=seed, **settings)
    if json:
        print(to_json(answer.plain))
    else:
        tables = [Table(f"{task.name}: probe with {name}", [Column("estimate", left=True), Column("value (interval)")])]
        for estimate, value in answer.facts:
            tables[0].add([estimate, value])
        if answer.trials:
            tables.append(
                Table("trials", [Column("candidate", left=True), Column("error, of that without"), Column("worst")])
            )
            for candidate, tried in answer.trials.items():
                tables[1].add([candidate, written_out(tried.error), written_out(tried.worst)])
        for table in tables:
            show_table(table)
        for note in answer.notes:
            say(f"note: {note}")
        say(f"{'chosen' if answer.deformation is not None else 'no adaptation'}: {answer.why}", "bold")
        if answer.deformation is not None:
            print(f"\nfor the controller:\n\n{answer.lines}")
    raise typer.Exit(0 if answer.deformation is not None else 1)


@app.command()
def tune(
    problem: Problem, controllers: Controllers = None, trials: int = 50, draws: int = 1, mismatch: Mismatch = 0.0,
    cases: Cases = None, metric: str | None = None, seed: Seed = 0, out: Out = None, json: Json = False,
) -> None:  # fmt: skip
    """Find better settings, with the same budget and cost for every controller. The problem file lists them: tuning = {...}."""
    task = _task(problem)
    from fpirhc.report.terminal import progress_bars, show_harm
    from fpirhc.studies.tune import tune as search
    from fpirhc.studies.variants import CasesOf, Draws

    variants = (
        CasesOf(tuple(cases), seed) if cases else Draws(draws, mismatch, seed + 10**6)
    )  # never those of a comparison
    with progress_bars(as_json=json) as progress:
        found = search(
            task, trials=trials, variants=variants, seed=seed, controllers=controllers, metric=metric,
            folder=_folder(out, task.name, "tuning"), progress=progress,
        )  # fmt: skip
    for sentences in found.harm.values():
        show_harm(sentences)
    print(
        found.table.to_json(orient="records") if json else f"{found.table.to_string(index=False)}\n\n{found.python()}"
    )


@app.command()
def check(
    problems: Annotated[list[str] | None, typer.Argument(help="names or files [default: all of this folder]")] = None,
    ignore_below: Annotated[float, typer.Option(help="percent of a value, below which a change holds")] = 0.0,
    baselines: Baselines = None, processes: Processes = 1, no_compile: NoCompile = False,
) -> None:  # fmt: skip
    """Compare fresh results with the committed baselines. Exit code 5: a metric changed; 6: no usable baseline."""
    from fpirhc.baselines.baseline import check as judge
    from fpirhc.baselines.baseline import problems_here
    from fpirhc.report.terminal import progress_bars, say

    with progress_bars() as progress:
        facts = {"baselines": baselines, "processes": processes, "compiled": not no_compile, "progress": progress}
        found = [judge(str(one), ignore=ignore_below / 100, **facts) for one in problems or problems_here(Path())]
    for one in found:
        say(one.text, "" if one.holds else "bold red", wrap=False)
    raise typer.Exit(6 if any(one.unusable for one in found) else 0 if all(one.holds for one in found) else 5)


@app.command()
def accept(
    problem: Problem, reason: Annotated[str, typer.Option(help="why the new numbers are right")], seed: Seed = 0, seeds: int = 8,
    baselines: Baselines = None, processes: Processes = 1, no_compile: NoCompile = False,
) -> None:  # fmt: skip
    """Measure a problem anew and write its baseline."""
    from fpirhc.baselines.baseline import accept as write
    from fpirhc.report.terminal import progress_bars

    with progress_bars() as progress:
        facts = {"baselines": baselines, "processes": processes, "compiled": not no_compile, "progress": progress}
        print(f"baseline: {write(_task(problem), reason, seed=seed, seeds=seeds, **facts)}")


@app.command()
def solve(problem: Problem, optimisers: list[str] | None = None, tolerance: float = 1e-6, out: Out = None) -> None:
    """Solve a problem's first horizon open loop, to a tolerance."""
    task = _task(problem)
    from fpirhc.report.figures import plan_figure, save_figure
    from fpirhc.report.terminal import show_plans
    from fpirhc.status import Status
    from fpirhc.studies.open_loop import solve_first

    solved, picture = solve_first(task, optimisers or ["fixed-point"], tolerance), _folder(out, task.name) / "plan.png"
    save_figure(plan_figure(task.problem, solved), picture)
    show_plans(task.name, solved, picture)
    raise typer.Exit(0 if all(one.plan.status == Status.OK for one in solved) else 4)


@app.command()
def new(name: str, folder: Annotated[Path, typer.Option("--dir")] = Path()) -> None:
    """Write a problem file, its test and its baseline to start from."""
    from fpirhc.scaffold import create_problem, first_baseline

    problem, test = create_problem(name, folder)
    print(
        f"wrote {problem}\nwrote {test}\nwrote {first_baseline(problem)}\nnext: fpirhc compare {problem}; python -m pytest {test}"
    )


@app.command("list")
def list_() -> None:
    """List the shipped problems."""
    from fpirhc.problem_files.shipped import shipped_groups, title_of

    for title, problems in shipped_groups().items():
        print(title, *(f"  {name:24s} {title_of(path)}" for name, path in problems.items()), sep="\n")


@app.command()
def doctor(json: Json = False) -> None:
    """Examine the installation: versions, solvers, compiler, cache."""
    from fpirhc.doctor import examine, written

    findings = [*examine()]
    print(written(findings, json))
    raise typer.Exit(7 if any(outcome == "fail" for _, outcome, *_ in findings) else 0)


@app.command()
def export(
    problem: Problem, controller: Controller,
    out: Annotated[Path | None, typer.Option(help="folder, new or empty [default: results/PROBLEM/TARGET]")] = None,
    to: Literal["c", "arduino", "fmu2", "library", "wasm", "lab"] = "c", live: list[str] | None = None, name: str | None = None,
) -> None:  # fmt: skip
    """Write a controller for a device, another simulator, or a page with sliders: without Python, bit by bit the same."""
    task = _task(problem)
    from fpirhc.export.target import device_of, target_called, write
    from fpirhc.studies.comparison.compare import select

    out = out or _folder(None, task.name) / to
    if to == "lab":
        from fpirhc.export.lab.lab import lab_of, write_lab

        write_lab(lab_of(task, problem, [controller], live or ()), out / f"{task.name}-lab.html")
        return
    target, chosen = target_called(to), select(task, [controller])[controller]
    device = device_of(task.problem, chosen, controller, name=name, live=live or [], cycles=2000, libm=target.libm)
    for file in write(device, target, out):
        print(f"wrote {file}")


def main() -> int:
    """Run the command line and return its exit code."""
    from fpirhc.errors import FpirhcError, OutputError

    debug = "--debug" in sys.argv
    try:
        return int(app([word for word in sys.argv[1:] if word != "--debug"], standalone_mode=False) or 0)
    except (typer.Exit, SystemExit) as end:
        return int(getattr(end, "exit_code", getattr(end, "code", 0)) or 0)
    except KeyboardInterrupt:
        text, code = "interrupted; finished results are kept", 130
    except BrokenPipeError:
        return 141
    except OutputError as error:
        text, code = str(error), 3
    except FpirhcError as error:
        text, code = str(error), 2
    except Exception as error:  # noqa: BLE001 -- the last resort of a program
        if hasattr(error, "format_message"):  # of typer: a wrong option, with the nearest one
            text, code = error.format_message(), 2
        else:
            text, code = f"an error inside fpirhc: {type(error).__name__}: {error}", 70
    if debug:
        traceback.print_exc()
    print(f"fpirhc: {text}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
