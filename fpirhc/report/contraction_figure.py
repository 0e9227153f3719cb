"""The picture of contraction: the factor against the gain that the user sets, and the decay of the response error."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from fpirhc.simulation.drawing import PALETTE, draw_legend, literal, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from fpirhc.contraction.gains import ContractionReport
    from fpirhc.studies.comparison.compare import Comparison
    from fpirhc.studies.comparison.entry import Contraction, Entry

_PANEL = 5.5, 3.8  # inches
_CYCLES = 150  # of the decay
_BEYOND = 1.2  # of the linear limit, up to which the factor is drawn


def contraction_figure(comparison: Comparison) -> Figure | None:
    """Return a panel for every gain by its own name and scale, and one with the response errors; None where nothing contracts."""
    entries = [e for e in comparison.entries if e.contraction is not None and e.run.cycles > 2]
    if not entries:
        return None
    colours = {e.name: PALETTE[k % len(PALETTE)] for k, e in enumerate(entries)}
    groups = _by_gain(entries)
    figure = new_figure(_PANEL[0] * (len(groups) + 1), _PANEL[1], "")
    *panels, last = figure.subplots(1, len(groups) + 1)
    for axis, ((name, scale), same) in zip(panels, groups.items(), strict=True):
        _draw_factor(axis, name, scale, same, colours)
    for entry in entries:
        size = np.linalg.norm(entry.run["realised"][1:] - entry.run["desired"][:-1], axis=1)[:_CYCLES]
        cycles = np.arange(1, size.size + 1)
        last.semilogy(cycles, np.maximum(size, 1e-12), color=colours[entry.name], label=literal(entry.name), lw=1)
    last.set_xlabel("control cycle")
    last.set_ylabel("|realised - desired|, response units")
    last.set_title("The response error in the first cycles", fontsize=10)
    draw_legend(last)
    return figure


def _by_gain(entries: Sequence[Entry]) -> dict[tuple[str, float], list[Entry]]:
    """Entries by the name of their gain and its size per unit of the effective gain, in their order."""
    groups: dict[tuple[str, float], list[Entry]] = {}
    for entry in entries:
        groups.setdefault(_own_gain(_of(entry).report), []).append(entry)
    return groups


def _of(entry: Entry) -> Contraction:
    assert entry.contraction is not None
    return entry.contraction


def _own_gain(report: ContractionReport) -> tuple[str, float]:
    """Name of the user's gain and its size per unit of the effective gain; the effective gain where no gain converges."""
    own, effective = (max(limit, key=abs) for limit in (report.own_linear_limit, report.linear_limit))
    # An interval in the user's gain is mirrored where the sign differs, so its far end belongs to the far end.
    return (report.gain_name, float(f"{own / effective:.9g}")) if effective else ("effective gain", 1.0)


def _draw_factor(axis: Axes, name: str, scale: float, entries: Sequence[Entry], colours: dict[str, str]) -> None:
    first = _of(entries[0])
    limit = max(first.report.linear_limit, key=abs) or 1.0
    gains = np.linspace(0, _BEYOND * limit, 300)
    eigenvalues = first.spectrum.eigenvalues.ravel()
    factors = np.abs(1 - gains[:, None] * eigenvalues[None, :]).max(axis=1)
    axis.plot(scale * gains, factors, color="#444444", lw=1.2)
    axis.axhline(1.0, color="#aa0000", lw=0.8)
    axis.axvline(scale * limit, color="#aa0000", lw=0.8, ls="--", label="linear limit")
    sectors: dict[float, str] = {}
    for entry in entries:
        one, colour = _of(entry), colours[entry.name]
        own = scale * one.report.effective_gain
        axis.plot(own, one.report.predicted, "o", color=colour, ms=6, label=literal(f"{entry.name}, predicted"))
        if np.isfinite(one.measured):
            axis.plot(own, one.measured, "x", color=colour, ms=8)
        sector: float = max(one.report.sector_limit, key=abs)
        sectors.setdefault(round(sector, 3), colour)
    for sector, colour in sectors.items():
        if sector and abs(sector) < 0.999 * abs(limit):
            axis.axvline(scale * sector, color=colour, lw=0.8, ls=":", label="sector limit")
    axis.set_ylim(0, 1.6)
    axis.set_xlabel(literal(name))
    axis.set_ylabel("contraction factor max|1 - a lambda|")
    axis.set_title("Predicted factor; o predicted, x measured", fontsize=10)
    axis.grid(visible=True, alpha=0.25)
    draw_legend(axis)
