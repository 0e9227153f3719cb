"""The output on the terminal: progress bars, sentences, and tables that fold.

Columns that do not fit go on below, none is cut or lost, and every part begins with the columns that name the rows.
"""

from __future__ import annotations

import math
import re
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.console import Console, JustifyMethod
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table as Grid
from rich.text import Text

from fpirhc.errors import listed
from fpirhc.simulation.metrics import columns
from fpirhc.simulation.simulate import SWITCHED_OFF
from fpirhc.status import Status
from fpirhc.studies.verdict import IN_FULL, Outcome
from fpirhc.summary import HELD, Column, Table, number, printable, written_out

if TYPE_CHECKING:
    from fpirhc.probing.probe import Probe
    from fpirhc.review.review import Review
    from fpirhc.simulation.metrics import Metrics
    from fpirhc.simulation.run import Run
    from fpirhc.studies import Progress as Report
    from fpirhc.studies import View
    from fpirhc.studies.open_loop import Solved

STYLES: dict[Outcome | None, str] = {  # by the outcome that a sentence states
    Outcome.BETTER: "green",
    Outcome.WORSE: "bold red",
    Outcome.MIXED: "yellow",
    Outcome.DOUBTFUL: "yellow",
    Outcome.NOT_COMPARABLE: "dim",
    Outcome.LIMIT_LEFT: "bold red",
    Outcome.LEAVES: "bold red",
    Outcome.NOT_GOOD: "yellow",
}
_GLUE = "\ue000"  # in place of a space that is held
_NAMED = 24  # characters of a name that stand on one line where there is little room
_BETWEEN = 2  # between two columns: a space of each and the box between them
_DRAWN = 0.1  # s from one picture of a bar to the next
_QUIET = 2.0  # s between two lines of a command without a terminal
_EDGES = 2  # columns left and right of a table


def say(text: str, style: str = "", more: str = "", *, wrap: bool = True) -> None:
    """Print text in which nothing is markup, and more without the style; `wrap`: lines go on below the text of a list."""
    first = re.sub(r"^(- |  \w* *(-> )?)?.*", r"\1", text, flags=re.DOTALL)
    console, whole = Console(), Text.assemble((printable(text[len(first) :]), style), printable(more))
    whole.plain = HELD.sub(_GLUE, whole.plain)
    for k, line in enumerate(whole.wrap(console, console.width - len(first)) if wrap else [whole]):
        line.plain = line.plain.replace(_GLUE, " ").rstrip()
        before = " " * len(first) if k else first
        console.print(Text(before, style) + line, highlight=False, soft_wrap=True)


def show(view: View, report: Path, *, verbose: bool = False) -> None:
    """Print the verdict, the first table in one part, and the path of the report.

    `verbose`: print every sentence, every column and everything else that is said of a study.
    """
    say(view.study.title, "bold", f" {view.conditions}")
    for k, (text, outcome) in enumerate(view.sentences):
        say(f"- {text}", STYLES.get(outcome, "")) if verbose or not k or outcome in IN_FULL else None
    say(f"other pairs: {view.others}") if view.others and not verbose else None
    for table in view.tables:
        if table.rows:
            narrow = replace(table.narrow, title="" if table.title == view.study.title else table.title)
            show_table(narrow) if verbose else show_brief(narrow)
    for heading, texts in view.lists.items() if verbose else ():
        say(heading, "bold") if texts else None
        for text in texts:
            say(f"- {text}")
    more = "" if verbose else " (more there, or by --verbose)"
    say(f"report: {report}", more=more, wrap=False)


def show_brief(table: Table, console: Console | None = None) -> None:
    """Print a table in one part; a column of texts, or of what is alike in all rows, or without room stands below in a line."""
    width, below, kept, more = (console or Console()).width, list[str](), list[int](), list[str]()
    for k in range(table.names, len(table.columns)):
        by_text: dict[str, list[str]] = {}
        for row in table.rows:
            by_text.setdefault(row.cells[k], []).append(row.cells[0])
        alike, in_words = len(by_text) == 1 < len(table.rows), table.columns[k].left and table.names == 1
        if alike or in_words:  # one name tells a row from others
            most = max(by_text, key=lambda text: len(by_text[text]))
            apart = [f"{table.columns[k].head} of {listed(n)}: {t}" for t, n in by_text.items() if t != most]
            below += [*apart, f"{table.columns[k].head}{' of the others' * bool(apart)}: {most or '-'}"]
        elif len(_parts(table.of([*range(table.names), *kept, k]), width)) == 1:
            kept.append(k)
        else:
            more.append(table.columns[k].head)
    show_table(replace(table.of([*range(table.names), *kept]), caption=""), console) if kept else None
    for text in [*below, *[f"more columns by --verbose: {', '.join(more)}"] * bool(more)]:
        say(text)


def show_table(table: Table, console: Console | None = None) -> None:
    """Print a table in as many parts as the width of the console needs."""
    console = console or Console()
    parts = _parts(table, console.width)
    for k, part in enumerate(parts):  # what stands above and below may be wider than a part
        if table.title:
            console.print(Text(printable(table.title) + (" (continued)" if k else ""), "italic"))
        console.print(_grid(table, part))
    if table.caption:
        console.print(Text(printable(table.caption), "dim italic"))


def _parts(table: Table, width: int) -> list[list[int]]:
    """Places of the columns of every part, without those that name the rows."""
    room = width - _EDGES - sum(_least(table, k) + _BETWEEN for k in range(table.names))
    parts, used = list[list[int]]([[]]), 0
    for k in range(table.names, len(table.columns)):
        need = _least(table, k) + _BETWEEN
        if parts[-1] and used + need > room:
            parts.append([])
            used = 0
        parts[-1].append(k)
        used += need
    return parts


def _least(table: Table, place: int) -> int:
    """The least width of a column: of the longest word of its heading and its longest text; names may wrap."""
    texts = [cell_len(printable(row.cells[place])) for row in table.rows]
    if place < table.names:
        texts = [min(length, _NAMED) for length in texts]
    return max([*texts, *(cell_len(word) for word in _whole_units(table.columns[place].head).split(" "))], default=1)


def _whole_units(head: str) -> str:
    """A heading whose lines do not end inside a unit, nor beside a stroke or before a percent sign."""
    return re.sub(r"\[[^]]*\]| / | (?=%)", lambda held: held[0].replace(" ", "\N{NO-BREAK SPACE}"), printable(head))


def _grid(table: Table, part: Sequence[int]) -> Grid:
    grid = Grid(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    places = [*range(table.names), *part]
    for k in places:
        justify: JustifyMethod = "left" if k < table.names or table.columns[k].left else "right"
        width = None if k < table.names else _least(table, k)  # names have what the numbers leave
        grid.add_column(Text(_whole_units(table.columns[k].head)), justify=justify, width=width, overflow="fold")
    for row in table.rows:
        cells = (Text(printable(row.cells[k]), "bold" if k in row.best else "") for k in places)
        grid.add_row(*cells, style=row.style)
    return grid


@contextmanager
def progress_bars() -> Iterator[Report]:
    """Yield a function (name, done, total) that shows bars on standard error; or, without a terminal, lines."""
    words = "{task.description}", "{task.completed:.0f} of {task.total:.0f}", "to go"
    named, counts, to_go = (TextColumn(text, markup=False) for text in words)
    columns = named, BarColumn(), counts, TimeElapsedColumn(), to_go, TimeRemainingColumn()
    out, told, known, begin = Console(stderr=True), dict[str, float](), dict[str, TaskID](), time.monotonic()
    bars = Progress(*columns, console=out, transient=True)

    def report(name: str, done: int, total: int) -> None:
        now = time.monotonic()
        if not out.is_terminal:
            if done >= total and now - told.get("", begin) > _QUIET:
                told[""] = now
                said = f"fpirhc: {printable(name)}: {total} of {total} after {now - begin:.0f} s"
                print(said, file=sys.stderr, flush=True)
            return
        if done < total and now - told.get(name, -math.inf) < _DRAWN:
            return  # the time left is computed anew from all that was told, which takes longer than a short run
        told[name] = now
        bars.start()
        if name not in known:
            known[name] = bars.add_task(printable(name), total=total)
        bars.update(known[name], completed=done, total=total)

    try:
        yield report
    finally:
        if known:
            bars.stop()


def announce_backend(reasons: Iterable[object]) -> None:
    """Print on standard error why loops of a command run without compiled C; an empty reason is that of one that does not."""
    for reason in sorted({str(one) for one in reasons if one}):
        why = "--no-compile was given" if reason == SWITCHED_OFF else reason
        print(f"fpirhc: loops run in CasADi's virtual machine, more slowly, because {why}", file=sys.stderr)


def show_run(run: Run, metrics: Metrics, saved: Sequence[Path]) -> None:
    """Print one run's metrics and the paths of its files."""
    for column in columns([metrics]):
        say(f"{column.heading}: {column.text(column.number(metrics), missing='-', none='none')}")
    if run.stop:
        say(f"ended early: {run.stop}")
    for text in (*metrics.broken.values(), *run.remarks):
        say(text)
    say(f"saved: {', '.join(map(str, saved))}", wrap=False)


def show_plans(task: str, solved: Sequence[Solved]) -> None:
    """Print the plans of open-loop solves."""
    caption = "K: contraction factor; du <: bound of the error of every input; dV <: of the cost above the optimum"
    heads = ("optimiser", "cost", "residual", "iter", "K", "du <", "dV <", "status")
    table = Table(f"{task}, first horizon", [Column(head) for head in heads], caption)
    for one in solved:
        table.add(_plan_row(one))
    show_table(table)
    for one in solved:
        for text in one.plan.violations():
            say(f"{one.name}: {text}")
        for name, price in one.plan.slacks().items():
            say(f"{one.name}: the limit of '{name}' costs {number(price)}")
        if one.plan.overflow():
            say(f"{one.name}: {one.plan.overflow()}")
        if one.plan.status != Status.OK:
            say(f"{one.name}: {one.plan.status.remedy}")


def _plan_row(solved: Solved) -> list[str]:
    plan, known = solved.plan, solved.certificate
    bounds = (known.factor, known.input_error, known.suboptimality) if known else (None, None, None)
    numbers = zip((plan.cost, plan.stationarity, *bounds), (7, 1, 3, 2, 2), strict=True)
    cost, residual, *known_bounds = ("-" if v is None else written_out(v, digits) for v, digits in numbers)
    rounds = f"{plan.iterations:.0f}" if plan.iterations >= 0 else "-"
    return [solved.name, cost, residual, rounds, *known_bounds, plan.status.name.lower().replace("_", " ")]


def show_review(found: Review, *, verbose: bool = False) -> None:
    """Print the answers about the problem and every controller, those that are yes as a count."""
    for name, answers in found.answers.items():
        shown = [one for one in answers if verbose or one.verdict != "yes"]
        told = [f"{len(answers) - len(shown)} of {len(answers)} yes"] * (len(shown) < len(answers))
        ready = all(one.verdict == "yes" for one in found.answers["problem"])  # a gain is for what comes first
        uppermost = next((one.change for one in answers if one.verdict != "yes"), "")
        fit = [a for a in answers if ready and (a.verdict == "yes" or a.change == uppermost)]
        told += [f"recommended gain: {number(g)}" for a in fit if (g := a.numbers.get("recommended_gain"))]
        say(name, "bold", f": {', '.join(told)}" * bool(told)) if answers else None
        for change in dict.fromkeys(one.change for one in shown):  # once, below its rows
            rows = sorted((one for one in shown if one.change == change), key=lambda one: one.verdict != "no")
            above = name != "problem" and change in {one.change for one in found.answers["problem"] if change}
            brief = (above or (len(rows) > 1 and rows[0].verdict == "unknown")) and not verbose
            alike = {one.verdict: sum(one.verdict == other.verdict for other in rows) for one in rows}
            for one in {one.verdict: one for one in rows}.values() if brief else rows:
                every = ", ".join(f"{name} {number(value)}" for name, value in one.numbers.items()) * verbose
                whole = f"{one.question} {one.evidence}".strip() + f" ({every})" * bool(every)
                count = alike[one.verdict]
                what = whole if not brief else one.question if count == 1 else f"{count} questions"
                what += " (for the reason above)" * (above and brief)
                say(f"  {one.verdict:7s} {what}", STYLES[Outcome.WORSE] if one.verdict == "no" else "")
            do = f"For these {len(rows)}: " * (len(rows) > 1 and not brief) + change
            do = do if verbose else re.sub(r"( helps, [^()]*) \(.*?\)\.", r"\1.", do)  # what was run
            say(f"          -> {do}", "bold") if change and not (above and brief) else None
    advised = {one.change for some in found.answers.values() for one in some if one.verdict in ("no", "caution")}
    first = "Take one advice at a time, the uppermost first, and ask again after each.\n" * (len(advised) > 1)
    say(first + ", ".join(found.counts()) + ("" if verbose else "; --verbose has every answer"))


def show_probe(title: str, answer: Probe) -> None:
    """Print estimates, trials, and the line to paste."""
    two = Column("estimate", left=True), Column("value (interval)")
    estimates = Table(title, two, "Friction biases intervals: they are of a plant that differs by these alone.")
    for estimate, value in answer.facts:
        estimates.add([estimate, value])
    show_table(estimates)
    tried = map(Column, ("error, of that without", "worst", "passes"))
    trials = Table("trials", [Column("candidate", left=True), *tried])
    for candidate, one in answer.trials.items():
        trials.add([candidate, written_out(one.error), written_out(one.worst), "yes" if one.passes else "no"])
    if trials.rows:
        show_table(trials)
    for note in answer.notes:
        say(f"note: {note}")
    say(f"{'chosen' if answer.deformation is not None else 'no adaptation'}: {answer.why}", "bold")
    if answer.deformation is not None:
        print(f"\nfor the controller:\n\n{answer.lines}")
