"""A check on the terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from fpirhc.baselines.bands import FACTOR, Metric
from fpirhc.baselines.baseline import Baseline
from fpirhc.baselines.judging import Judgement
from fpirhc.baselines.words import HEADS, cells, clean, headline, number, remarks, shown

_MOSTLY = 0.9  # share of a band; its digits are rounded
_STYLES = {"holds": "", "better": "bold green", "worse": "bold red"}


def show_judgements(judgements: Sequence[Judgement], unchecked: Sequence[tuple[str, str]], every: bool) -> None:
    """Print a table and a sentence for every problem."""
    console = Console()
    for judgement in judgements:
        rows = shown(judgement, every)
        if rows:
            table = _table(judgement.problem)
            for row in rows:
                table.add_row(*(Text(text) for text in cells(row)), style=_STYLES.get(row.verdict, "bold yellow"))
            console.print(table)
        _say(console, headline(judgement))
        for text in remarks(judgement):
            _say(console, f"  {text}")
    for name, reason in unchecked:
        _say(console, f"{clean(name)}: not checked ({clean(reason)})")


def show_baseline(baseline: Baseline, path: str) -> None:
    """Print what was accepted and how wide its bands are."""
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
        _say(console, f"{len(loose)} bands are wider than half their value and hardly notice a change")
    _say(console, f"wrote {clean(path)}")


def _source(metric: Metric) -> str:
    """What the band is made of, where that is more than the least width."""
    if FACTOR * metric.widest < _MOSTLY * metric.band:
        return "least width"
    return max(metric.spread, key=lambda s: metric.spread[s])


def _table(problem: str) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), title=Text(clean(problem)))
    for k, head in enumerate(HEADS):
        table.add_column(head, justify="left" if k in (0, 1, 5) else "right")
    return table


def _say(console: Console, text: str) -> None:
    console.print(text, markup=False, highlight=False, soft_wrap=True)
