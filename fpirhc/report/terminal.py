"""The output on the terminal: progress bars, the table, the verdict."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, cast

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.text import Text

from fpirhc.report.folding import Column, Folding
from fpirhc.report.outcomes import terminal_style
from fpirhc.simulation.metrics.columns import Column as Metric
from fpirhc.simulation.metrics.columns import columns
from fpirhc.simulation.simulate import SWITCHED_OFF
from fpirhc.status import Status
from fpirhc.studies.comparison.optimality import gap
from fpirhc.studies.comparison.outcome import Outcome
from fpirhc.summary import in_percent, printable

if TYPE_CHECKING:
    from fpirhc.simulation.metrics import Metrics
    from fpirhc.simulation.run import Run
    from fpirhc.studies.comparison.compare import Comparison
    from fpirhc.studies.comparison.compare import Progress as Report
    from fpirhc.studies.comparison.entry import Entry
    from fpirhc.studies.open_loop import Solved

_MOST_STEPS = 6  # of the set-points of one coordinate in a text


@contextmanager
def progress_bars() -> Iterator[Report]:
    """Yield a function (name, done, total) that shows one bar per controller on standard error."""
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bars:
        known: dict[str, TaskID] = {}

        def report(name: str, done: int, total: int) -> None:
            if name not in known:
                known[name] = bars.add_task(printable(name), total=total)
            bars.update(known[name], completed=done)

        yield report


def announce_backend(runs: Iterable[Run]) -> None:
    """Print on standard error why loops of a command ran without compiled C, where they did."""
    reasons = {str(run.settings["why not compiled"]) for run in runs if not run.compiled}
    for reason in sorted(reasons):
        why = "--no-compile was given" if reason == SWITCHED_OFF else reason
        print(f"fpirhc: loops ran in CasADi's virtual machine, more slowly, because {why}", file=sys.stderr)


def show(comparison: Comparison, report: Path) -> None:
    """Print the verdict, the table and the path of the report."""
    console = Console()
    say(console, comparison.title, style="bold")
    for sentence, outcome in comparison.sentences:
        say(console, f"- {sentence}", style=terminal_style(outcome))
    _table(comparison).show(console)
    if sum(e.optimality is not None for e in comparison.entries) > 1:
        _plans(comparison).show(console)
    for entry in comparison.entries:
        if entry.run.stop:
            say(console, f"{entry.name} ended early: {entry.run.stop}")
    for line in comparison.information:
        say(console, line)
    for entry in comparison.entries:
        for note in entry.notes:
            say(console, f"{entry.name}: {note}")
    for name, why in comparison.skipped.items():
        say(console, f"skipped {name}: {why}")
    say(console, f"report: {report}", wrap=False)


def show_run(run: Run, metrics: Metrics, harm: Sequence[str], saved: Path) -> None:
    """Print what speaks against its adaptation, one run's metrics and the path of its file."""
    console = Console()
    show_harm(console, harm)
    for text in (*settings_in_force(run), *set_points_in_force(run)):
        say(console, text)
    for column in columns([metrics]):
        say(console, f"{column.heading}: {column.text(column.number(metrics), missing='-', none='none')}")
    if run.stop:
        say(console, f"ended early: {run.stop}")
    if run.depends_on_rounding:
        say(console, run.depends_on_rounding)
    say(console, f"saved: {saved}", wrap=False)


def show_harm(console: Console, harm: Iterable[str]) -> None:
    """Print what speaks against a controller's adaptation, in red."""
    for sentence in harm:
        say(console, f"- {sentence}", style=terminal_style(Outcome.WORSE))


def settings_in_force(run: Run) -> list[str]:
    """Return one line per time from which other live settings were in force."""
    lines = [
        (time, ", ".join(f"{path} = {value:g}" for path, value in numbers.items())) for time, numbers in run.in_force
    ]
    return [f"settings from {time:g} {run.time_unit}: {text}" for time, text in lines]


def set_points_in_force(run: Run) -> list[str]:
    """Return one line per coordinate with the set-points of the run and the times from which they were in force."""
    record = cast(dict[str, list[list[float]] | str], run.settings.get("setpoints", {}))
    return [f"set-points of {name}: {_steps_text(run, steps)}" for name, steps in record.items()]


def _steps_text(run: Run, steps: list[list[float]] | str) -> str:
    if isinstance(steps, str):
        return steps
    shown = [f"{value:g} from {time:g} {run.time_unit}" for time, value in steps[:_MOST_STEPS]]
    return ", ".join(shown) + (f", and {len(steps) - _MOST_STEPS} more" if len(steps) > _MOST_STEPS else "")


def show_plans(task: str, solved: Sequence[Solved], picture: Path) -> None:
    """Print the plans of open-loop solves."""
    console = Console()
    caption = (
        "K: contraction factor; du <: bound of the error of every input; dV <: bound of the cost above the optimum"
    )
    heads = ("optimiser", "cost", "residual", "iter", "K", "du <", "dV <", "status")
    table = Folding(f"{task}, first horizon", [Column(head) for head in heads], caption)
    for one in solved:
        table.add(_plan_row(one))
    table.show(console)
    for one in solved:
        for text in one.plan.violations():
            say(console, f"{one.name}: {text}")
        for text in one.plan.reasons():
            say(console, f"{one.name}: {text}")
        for name, price in one.plan.slacks().items():
            say(console, f"{one.name}: soft limit '{name}' costs {price:.4g}")
        if one.plan.overflow():
            say(console, f"{one.name}: {one.plan.overflow()}")
        if one.plan.status != Status.OK:
            say(console, f"{one.name}: {one.plan.status.remedy}")
    say(console, f"picture: {picture}", wrap=False)


def _plan_row(solved: Solved) -> list[str]:
    plan, known = solved.plan, solved.certificate
    bounds = [f"{known.factor:.3f}", f"{known.input_error:.1e}", f"{known.suboptimality:.1e}"] if known else ["-"] * 3
    return [
        solved.name,
        "-" if plan.cost is None else f"{plan.cost:.7g}",
        "-" if plan.stationarity is None else f"{plan.stationarity:.0e}",
        f"{plan.iterations:.0f}" if plan.iterations >= 0 else "-",
        *bounds,
        plan.status.name.lower().replace("_", " "),
    ]


def _table(comparison: Comparison) -> Folding:
    """Table of the controllers: their headline metrics, time of a cycle, and how they ended."""
    shown = columns([e.metrics for e in comparison.entries], headline=True)
    table = Folding(
        f"{comparison.problem}, from t = {comparison.measure_from:g} {comparison.time_unit}, seed {comparison.seed}",
        [Column("controller"), *(Column(c.short) for c in shown), Column("cycle us"), Column("status", left=True)],
    )
    for entry in comparison.entries:
        table.add(_row(entry, shown))
    return table


def _row(entry: Entry, shown: Sequence[Metric]) -> list[str]:
    metrics, cycle = entry.metrics, entry.cycle
    numbers = [c.text(c.number(metrics), missing="", none="-") for c in shown]
    status = "ended early" if entry.run.stop else status_shares(metrics.statuses)
    return [entry.name, *numbers, f"{cycle.median:.2g}" if cycle else "", status]


def status_shares(statuses: Mapping[str, int]) -> str:
    """The shares of cycles whose status is not ok, such as 'not converged 1.67 %'; 'ok' where there are none."""
    cycles = sum(statuses.values())
    other = {name: count for name, count in statuses.items() if count and name != "OK"}
    return ", ".join(f"{k.lower().replace('_', ' ')} {in_percent(v / cycles)}" for k, v in other.items()) or "ok"


def _plans(comparison: Comparison) -> Folding:
    """Table of the optimisers: cost above the converged optimum, iterations, time of the cycles that plan."""
    heads = ("controller", "iter", "residual", "gap", "plan us", "p99 us", "max us", "first us")
    caption = "gap: cost above the converged optimum, relative; plan us: the cycles that plan"
    table = Folding("plans", [Column(head) for head in heads], caption)
    for entry in comparison.entries:
        metrics, cycle, excess = entry.metrics, entry.cycle, entry.optimality
        if not metrics.solve:
            continue
        times = [_micro(v) for v in (cycle.planning, cycle.p99, cycle.maximum, cycle.first)] if cycle else [""] * 4
        solves = [metrics.text(f"solve.{name}") for name in ("median_iterations", "median_stationarity")]
        table.add([entry.name, *solves, gap(excess.median, 1) if excess else "-", *times])
    return table


def literal(text: str) -> Text:
    """Return text in which nothing is markup, an emoji code or an escape code."""
    return Text(printable(text))


def say(console: Console, text: str, *, style: str = "", wrap: bool = True) -> None:
    """Print text in which nothing is markup; without `wrap` it stays on one line."""
    console.print(literal(text), style=style, highlight=False, soft_wrap=not wrap)


def _micro(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"
