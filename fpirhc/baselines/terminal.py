"""The output of a check on the terminal."""

from __future__ import annotations

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from fpirhc.baselines.bands import FACTOR, Metric
from fpirhc.baselines.baseline import Baseline
from fpirhc.baselines.outline import Outline
from fpirhc.baselines.words import HEADS, clean, number

_MOSTLY = 0.9  # share of a band; its digits are rounded
_STYLES = {"holds": "", "better": "bold green", "worse": "bold red"}


def show_check(outline: Outline, every: bool) -> None:
    """Print a table and a sentence for every problem.

    Args:
        outline: the check.
        every: whether to print every metric, and not only those that changed and the rms errors.
    """
    console = Console()
    for section in outline.sections:
        lines = [line for line in section.lines if every or line.in_summary]
        if lines:
            table = _table(section.problem)
            for line in lines:
                table.add_row(*map(Text, line.cells), style=_STYLES.get(line.verdict, "bold yellow"))
            console.print(table)
        _say(console, section.headline)
        for text in section.remarks:
            _say(console, f"  {text}")
    for name, reason in outline.unchecked:
        _say(console, f"{name}: not checked ({reason})")


def show_baseline(baseline: Baseline, path: str) -> None:
    """Print the metrics of an accepted baseline with their bands; only rms errors and metrics with loose bands."""
    console = Console()
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), title=Text(f"{clean(baseline.problem)}, baseline"))
    for head in ("controller", "metric", "value", "band", "made of"):
        table.add_column(head)
    loose = []
    for name, one in baseline.controllers.items():
        if not one.metrics:
            table.add_row(Text(clean(name)), "outcome", Text(clean(" or ".join(one.outcomes))), "", "")
        for metric, value in one.metrics.items():
            if value.loose:
                loose.append(f"{name}: {metric}")
            if value.loose or metric.startswith("rms_error."):
                band = f"\u00b1 {value.band:.2g}"
                table.add_row(Text(clean(name)), Text(clean(metric)), number(value.value), band, _source(value))
        for metric, why in one.not_compared.items():
            _say(console, f"not compared: {clean(name)}, {clean(metric)} ({clean(why)})")
    console.print(table)
    if loose:
        _say(console, f"{len(loose)} bands are wider than half their value, so that most changes stay inside")
    _say(console, f"wrote {clean(path)}")


def _source(metric: Metric) -> str:
    """The source of variants with the largest spread, or that the band has its least width."""
    if FACTOR * metric.widest < _MOSTLY * metric.band:
        return "least width"
    return max(metric.spread, key=lambda s: metric.spread[s])


def _table(problem: str) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), title=Text(problem))
    for k, head in enumerate(HEADS):
        table.add_column(head, justify="left" if k in (0, 1, 5) else "right")
    return table


def _say(console: Console, text: str) -> None:
    console.print(text, markup=False, highlight=False, soft_wrap=True)
