"""Figures (matplotlib) of plans and of the contraction; what goes over time is drawn by the page itself."""

from __future__ import annotations

from collections.abc import Sequence
from colorsys import hsv_to_rgb
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from fpirhc.errors import OutputError
from fpirhc.simulation.drawing import PALETTE, caption_axes, draw_legend, literal, new_figure, responses_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from fpirhc.simulation.picture import Drawing
    from fpirhc.studies.compare import Comparison, Contraction
    from fpirhc.studies.open_loop import Solved
    from fpirhc.task.problem import Problem

_CYCLES = 150  # of the decay of a response error
_BEYOND = 1.2  # of the linear limit, up to which the factor is drawn
_GOLDEN = 0.618034  # of a turn, from hue to hue


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure to a file.

    Raises:
        OutputError: the file cannot be written.
    """
    try:
        figure.savefig(path, dpi=120)
    except OSError as error:
        raise OutputError(f"cannot write the figure to '{path}': {error.strerror}") from None


def plan_figure(problem: Problem, solved: Sequence[Solved]) -> Figure:
    """Return the figure of states with their reference and inputs of open-loop plans, one line per optimiser."""
    assert problem.horizon is not None
    plant, plan = problem.plant, solved[0].plan
    names = [*plant.state.elements, *plant.input.elements]
    figure = new_figure(9, 2.0 * len(names) + 1, f"plans of {plan.problem.stages} stages")
    axes = np.atleast_1d(figure.subplots(len(names), 1, sharex=True))
    times = np.arange(plan.problem.stages + 1) * plan.problem.step
    reference = plan.data[plan.problem.data.slice("reference")]
    unknown = np.full((plant.state.size, times.size), np.nan)
    known = plant.equations.state_of(ca.DM(reference), ca.DM(unknown)).full()
    for k, (axis, name) in enumerate(zip(axes, names, strict=True)):
        is_state = k < plant.state.size
        if is_state and np.isfinite(known[k]).any():
            axis.plot(times, known[k], "--", color="#777777", label="reference")
        for row, (one, colour) in enumerate(zip(solved, PALETTE, strict=False)):
            width = max(1.0, 3.0 - 0.7 * row)  # plans that agree lie on each other
            if is_state:
                axis.plot(times, one.plan.states[k], color=colour, label=literal(one.name), linewidth=width)
            else:
                axis.stairs(one.plan.inputs[k - plant.state.size], times, baseline=None, color=colour, linewidth=width)
        unit = plant.state.units[k] if is_state else plant.input.units[k - plant.state.size]
        axis.set_ylabel(literal(f"{name} [{unit}]"))
    draw_legend(axes[0])
    axes[-1].set_xlabel(literal(f"time [{problem.time_unit}]"))
    return figure


def colours_of(comparison: Comparison) -> dict[str, str]:
    """Return the colour of every controller that ran, by name: the same one in all pictures of a report, the pair's first."""
    names = sorted(
        (e.name for e in comparison.entries if e.run.cycles > 1),
        key=lambda name: name not in (comparison.findings[0].pair or ()),
    )
    more = (hsv_to_rgb((k * _GOLDEN) % 1, 0.75, 0.6) for k in range(len(names)))
    extra = (f"#{''.join(f'{round(255 * one):02x}' for one in colour)}" for colour in more)
    return dict(zip(names, (*PALETTE, *extra), strict=False))


def contraction_figures(comparison: Comparison) -> list[Drawing]:
    """Return a picture for every gain by its own name and scale, and one of the response errors; none where nothing contracts."""
    from fpirhc.simulation.picture import Drawing

    entries = [e for e in comparison.entries if e.contraction is not None and e.run.cycles > 2]
    colours, groups = colours_of(comparison), dict[tuple[str, float], list[Any]]()
    for entry in entries:
        if entry.contraction is not None:
            name, scale = entry.contraction.report.own  # where no gain converges: of the effective gain
            own = (name, float(f"{scale:.9g}")) if scale else ("effective gain", 1.0)
            groups.setdefault(own, []).append((entry.name, entry.contraction))
    figures = [Drawing(figsize=(5.5, 3.8)) for _ in range(len(groups) + 1) if entries]
    for figure in figures:  # places that are fixed: to fit them takes two thirds of a picture's time
        figure.subplots_adjust(left=0.13, right=0.98, bottom=0.14, top=0.92)
    axes = [figure.subplots() for figure in figures]
    for axis, ((name, scale), same) in zip(axes, groups.items(), strict=False):
        _draw_factor(axis, name, scale, same, colours)
    units, cycles = {e.run.unit(f"desired.{n}") for e in entries for n in e.run.layout["desired"].elements}, 0
    for entry in entries:
        apart = (entry.run[responses_of(entry.run.layout)["realised"]][1:] - entry.run["desired"][:-1])[:_CYCLES]
        cycles = max(cycles, len(apart))
        if len(units) > 1:  # of different units: shares of their own ranges
            apart = apart / np.maximum(np.ptp(entry.run["desired"], axis=0), 1e-300)
        size = np.hypot.reduce(apart, axis=1)  # a square of what diverges may be too large for a number
        shown = np.where((size > 0) & np.isfinite(size), size, np.nan)
        axes[-1].semilogy(range(1, size.size + 1), shown, color=colours[entry.name], label=literal(entry.name), lw=1)
    for axis in axes[-1:]:
        unit = f"[{units.pop()}]" if len(units) == 1 else "of the ranges of desired"
        caption_axes(axis, "control cycle", literal(f"|realised - desired| {unit}"))
        span = f"{cycles} cycles, {cycles * entries[0].run.period:.3g} {comparison.time_unit}"
        axis.set_title(literal(f"The response error in the first {span}"), fontsize=10, y=1.0)
        draw_legend(axis)
    return figures


def _draw_factor(
    axis: Axes, gain: str, scale: float, entries: Sequence[tuple[str, Contraction]], colours: dict[str, str]
) -> None:
    first = entries[0][1]
    limit = max(first.report.linear_limit, key=abs) or 1.0
    gains = np.linspace(0, _BEYOND * limit, 300)
    factors = np.abs(1 - gains[:, None] * first.spectrum.eigenvalues.ravel()).max(axis=1)
    axis.plot(scale * gains, factors, color="#444444", lw=1.2)
    axis.axhline(1.0, color="#aa0000", lw=0.8)
    axis.axvline(scale * limit, color="#aa0000", lw=0.8, ls="--", label="linear limit: small errors")
    sectors: dict[float, str] = {}
    for name, one in entries:
        own, colour = scale * one.report.effective_gain, colours[name]
        axis.plot(own, one.report.predicted, "o", ms=9, mfc="none", mew=1.5, color=colour, label=literal(name))
        axis.plot(own, one.measured, "x", ms=7, mew=1.5, color=colour, zorder=5)
        sectors.setdefault(round(float(max(one.report.sector_limit, key=abs)), 3), colour)
    for sector, colour in sectors.items():
        if sector and abs(sector) < 0.999 * abs(limit):
            axis.axvline(scale * sector, color=colour, lw=1.6, ls=":", label="sector limit: errors of any size")
    axis.set_ylim(0, 1.6)
    axis.locator_params(axis="x", nbins=7)
    axis.ticklabel_format(axis="x", scilimits=(-3, 4))
    caption_axes(axis, literal(gain), "contraction factor")
    axis.set_title("Contraction of the iteration alone: o predicted, x measured", fontsize=10, y=1.0)
    draw_legend(axis)
