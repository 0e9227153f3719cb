"""Paired scenarios as a figure and as one HTML file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fpirhc.report.page import picture, render_page, write_page
from fpirhc.simulation.drawing import PALETTE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fpirhc.studies.scenarios.scenario_comparison import ScenarioComparison

_GROUPS = 6  # of scenarios with similar mismatch, whose medians are joined by a line
_CAPTION = (
    "One point per scenario and controller; lines join medians of scenarios with similar mismatch, crosses at the upper edge "
    "are runs that ended early. Mismatch: rms over the parameters of the relative distance between the model and the drawn "
    "plant. Error: rms error divided by the reference's range, root mean square over the coordinates."
)


def mismatch_figure(comparison: ScenarioComparison) -> Figure:
    """Return the figure of the error of every scenario against its mismatch, one colour per controller."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4.8), layout="constrained")
    figure.suptitle(f"{comparison.problem}: error against mismatch, {comparison.count} scenarios", fontsize=11)
    axis = figure.subplots()
    finite = np.concatenate([s.errors[np.isfinite(s.errors)] for s in comparison.summaries])
    edge = 200 * float(finite.max(initial=1e-3))
    for k, one in enumerate(comparison.summaries):
        colour, ended = PALETTE[k % len(PALETTE)], ~np.isfinite(one.errors)
        x, y = 100 * one.mismatch, 100 * one.errors
        axis.semilogy(x[~ended], y[~ended], "o", color=colour, ms=3, alpha=0.5)
        axis.semilogy(x[ended], np.full(ended.sum(), edge), "x", color=colour, ms=6)
        axis.semilogy(*_medians(x[~ended], y[~ended]), "-", color=colour, lw=1.5, label=one.name)
    axis.set_xlabel("mismatch between model and plant [%]")
    axis.set_ylabel("rms error [% of the reference's range]")
    axis.grid(visible=True, alpha=0.25)
    axis.legend(fontsize=8, framealpha=0.8)
    return figure


def _medians(x: np.ndarray, y: np.ndarray) -> tuple[list[float], list[float]]:
    order = np.argsort(x)
    groups = [g for g in np.array_split(order, min(_GROUPS, max(1, x.size // 3))) if g.size]
    return [float(np.median(x[g])) for g in groups], [float(np.median(y[g])) for g in groups]


def write_scenarios(comparison: ScenarioComparison, path: Path) -> None:
    """Write the report, atomically.

    Raises:
        OutputError: the file cannot be written.
    """
    write_page(render_scenarios(comparison), path)


def render_scenarios(comparison: ScenarioComparison) -> str:
    """Return the page's text."""
    figure = mismatch_figure(comparison) if comparison.summaries else None
    chart = picture(figure, "Error against mismatch", _CAPTION) if figure else None
    return render_page("scenarios.html", comparison.view, chart=chart)
