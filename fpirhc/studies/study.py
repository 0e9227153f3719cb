"""What a table of runs says: every controller beside the first one, variant by variant, and where each is worst."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import betaincinv  # scipy.stats takes a second to import

from fpirhc.fields.checked import checked_call
from fpirhc.problem_files.problem_file import Task
from fpirhc.studies.comparison.compare import check_gains, select
from fpirhc.studies.comparison.verdict import Outcome
from fpirhc.studies.objective import Objective, figure
from fpirhc.studies.variants import Variants, run_variants
from fpirhc.studies.view import Progress, Study, View, circumstances
from fpirhc.summary import Column, Table, in_percent

FEWEST = 6  # variants of which an interval at 95 % can be told


@dataclass(frozen=True, eq=False, kw_only=True)
class VariantStudy(Study):
    """The result of `study`."""

    table: pd.DataFrame  # a row per controller and variant
    summary: (
        pd.DataFrame
    )  # a row per controller: median, worst, where, failures, difference to the first one and its interval
    figure: Objective  # the number that is judged
    variants: Variants

    @property
    def view(self) -> View:
        heads = [
            Column(h)
            for h in (
                "controller",
                f"median {self.figure.noun}",
                "worst",
                "in",
                "failures",
                "difference",
                "95 %",
                "better in",
            )
        ]
        shown = Table(
            f"{self.problem}: {len(self.table) // max(len(self.summary), 1)} variants", heads, repr(self.variants)
        )
        text, apart = self.figure.text, self.figure.difference
        for name, row in self.summary.iterrows():
            interval = "" if math.isnan(row.low) else f"{apart(row.low)} to {apart(row.high)}"
            difference = "" if math.isnan(row.difference) else apart(row.difference)
            cells = [
                text(row["median"]),
                text(row.worst),
                row.worst_in,
                str(row.failures),
                difference,
                interval,
                str(row.better),
            ]
            shown.add([str(name), *cells])
        groups = self.table.loc[self.table.group != ""].groupby(["group", "controller"], sort=False)
        lists = {
            "Groups": [f"{g}, {c}: median error {in_percent(float(some.error.median()))}" for (g, c), some in groups]
        }
        failed = self.table.loc[self.table.outcome != "finished"].groupby("controller", sort=False).first()
        lists["Why runs failed"] = [f"{n}, {r.variant}: {r.outcome} {r.why}" for n, r in failed.iterrows()]
        facts = {
            "summary": self.summary.reset_index().to_dict("records"),
            "variants": repr(self.variants),
            "versions": self.versions,
        }
        return self.viewed(list(_sentences(self)), repr(self.variants), (shown,), facts, lists=lists)


@checked_call
def study(
    task: Task,
    variants: Variants,
    *,
    controllers: Sequence[str] | None = None,
    headline: str | None = None,
    processes: int = 1,
    compiled: bool = True,
    folder: Path | None = None,
    command: str = "",
    progress: Progress | None = None,
) -> VariantStudy:
    """Run every controller in every variant and compare them with the first one, variant by variant.

    Args:
        task: a problem with its controllers.
        variants: `CasesOf`, `Draws` or `Grid`.
        controllers: names, the first of which the others are compared with; None: all.
        headline: the number that is judged; None: the problem's, or the relative error.
        processes: number of processes.
        compiled: whether loops run as compiled C.
        folder: where rows are kept, so that the same call goes on after an interruption.
        command: that reproduces it.
        progress: called with (controller, done, in all).
    """
    begin, chosen = time.perf_counter(), select(task, controllers)
    check_gains(task, chosen)
    aim = figure(task.headline_metric if headline is None else headline, task.metrics, task.problem)
    table = run_variants(
        task,
        variants,
        controllers=list(chosen),
        processes=processes,
        compiled=compiled,
        keep=folder and folder / "runs.jsonl",
        progress=progress,
    )
    facts = circumstances(task, chosen, command, begin)
    return VariantStudy(table=table, summary=summarised(table, aim), figure=aim, variants=variants, **facts)


def summarised(table: pd.DataFrame, aim: Objective) -> pd.DataFrame:
    """Return a row per controller. Smaller values are better; a run that failed counts as worse than every other one."""
    column = table["error"] if aim.metric is None else table[aim.name] * (-1 if aim.better == "larger" else 1)
    values = column.where(table.outcome != "ended early", math.inf).fillna(math.inf)
    wide = table.assign(value=values).pivot(index="variant", columns="controller", values="value")
    wide = wide[list(dict.fromkeys(table.controller))]
    failures = (table.outcome != "finished").groupby(table.controller).sum()
    apart = wide.sub(wide.iloc[:, 0], axis=0).where(np.isfinite(wide).all(axis=1), math.nan)
    rows = {}
    for name in wide:
        finite = apart[name].dropna().to_numpy()
        first = name == wide.columns[0]
        low, high = (math.nan, math.nan) if first or len(finite) < FEWEST else _interval(finite)
        rows[name] = {
            "median": wide[name].median(),
            "worst": wide[name].max(),
            "worst_in": wide[name].idxmax(),
            "failures": int(failures[name]),
            "difference": math.nan if first or not len(finite) else float(np.median(finite)),
            "low": low,
            "high": high,
            "better": "" if first else f"{int((wide[name] < wide.iloc[:, 0]).sum())} of {len(wide)}",
        }
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("controller")


def _interval(values: np.ndarray) -> tuple[float, float]:
    """The 95 % percentile bootstrap interval of the median."""
    medians = np.median(np.random.default_rng(0).choice(values, (2000, len(values))), axis=1)
    low, high = np.quantile(medians, (0.025, 0.975))
    return float(low), float(high)


def _sentences(result: VariantStudy) -> Iterator[tuple[str, Outcome | None]]:
    aim, count = result.figure, len(result.table) // max(len(result.summary), 1)
    first = result.summary.index[0]
    for name, row in result.summary.iloc[1:].iterrows():
        clear = Outcome.BETTER if row.high < 0 else Outcome.WORSE if row.low > 0 else Outcome.NO_DIFFERENCE
        said = {Outcome.BETTER: "is better than", Outcome.WORSE: "is worse than"}.get(
            clear, "is not clearly different from"
        )
        yield f"{name} {said} {first} by {aim.noun}: {aim.better} in {row.better}.", clear
    for name, row in result.summary.loc[result.summary.failures > 0].iterrows():
        low = betaincinv(row.failures, count - row.failures + 1, 0.025)
        high = betaincinv(row.failures + 1, count - row.failures, 0.975) if row.failures < count else 1.0
        yield (
            f"{name} fails in {row.failures} of {count} ({in_percent(low)} to {in_percent(high)} of what is drawn so).",
            None,
        )


def figure_of(result: VariantStudy) -> Any:
    """Return the picture of a study: lines or maps over the settings of a grid, else the sorted values of every controller."""
    from fpirhc.simulation.drawing import PALETTE, draw_legend, new_figure

    axes, table = getattr(result.variants, "axes", {}), result.table
    column = "error" if result.figure.metric is None else result.figure.name
    shown = table.assign(shown=table[column].where(table.outcome == "finished"))
    names = list(dict.fromkeys(table.controller))
    if len(axes) == 2:
        figure = new_figure(4.6 * len(names), 3.9, f"{result.problem}: {column}")
        (x, y), panels = axes, figure.subplots(1, len(names), squeeze=False)[0]
        for panel, name in zip(panels, names, strict=True):
            cells = shown[shown.controller == name].pivot(index=y, columns=x, values="shown")
            mesh = panel.pcolormesh(
                cells.columns, cells.index, cells, shading="nearest", vmin=shown.shown.min(), vmax=shown.shown.max()
            )
            panel.set(title=name, xlabel=x, ylabel=y)
        figure.colorbar(mesh, ax=list(panels), label=column)
        return figure
    figure = new_figure(9, 4.5, f"{result.problem}: {column}")
    axis = figure.subplots()
    for name, colour in zip(names, PALETTE * len(names), strict=False):
        own = shown[shown.controller == name]
        across = own[next(iter(axes))] if axes else np.linspace(0, 100, len(own))
        axis.semilogy(across, own.shown if axes else np.sort(own.shown), ".-", color=colour, label=name)
    axis.set(xlabel=next(iter(axes), "share of the variants [%]"), ylabel=column)
    draw_legend(axis)
    return figure
