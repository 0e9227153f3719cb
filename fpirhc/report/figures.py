"""Figures (matplotlib) of plans and comparisons, and the pairs without | with adaptivity of the method's papers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from fpirhc.errors import OutputError
from fpirhc.simulation.drawing import (
    PALETTE,
    by_unit,
    caption_axes,
    draw_bands,
    draw_changes,
    draw_legend,
    draw_line,
    draw_responses,
    draw_signal,
    draw_title,
    literal,
    new_figure,
    quantity_label,
    row_of_axes,
    show_usual,
    shown_motion,
    thinned,
    time_label,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from fpirhc.contraction.spectrum import ContractionReport
    from fpirhc.simulation.picture import Drawing
    from fpirhc.simulation.run import Run
    from fpirhc.studies.comparison.compare import Comparison, Contraction, Entry
    from fpirhc.studies.open_loop import Solved
    from fpirhc.task.problem import Problem

    Draw: TypeAlias = Callable[[Axes, Run, Sequence[str]], None]

_WIDE = 16.5  # inches, of a picture as wide as the page
_CYCLES = 150  # of the decay of a response error
_BEYOND = 1.2  # of the linear limit, up to which the factor is drawn
_REFERENCES = ("#111111", "#777777", "#aaaaaa")  # colours of references, which lie on what follows them


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
    known = plant.equations.known_by_outputs
    for k, (axis, name) in enumerate(zip(axes, names, strict=True)):
        is_state = k < plant.state.size
        if is_state and known[k] >= 0:
            axis.plot(times, reference[known[k]], "--", color="#777777", label="reference")
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


def pair_figures(plain: Entry, adaptive: Entry) -> dict[str, Drawing]:
    """Return the pictures of the method's papers as pairs, without adaptivity on the left and with it on the right.

    Both sides have the same axes, and a picture has one unit: quantities of several units are several pictures.
    """
    figures = {}
    for title, draw, signal, what, names in _pictures(plain.run):
        groups = by_unit(plain.run, signal, names)
        for unit, same in groups.items():
            name = title if len(groups) == 1 else f"{title} [{unit}]"
            same = same[:1] if draw is _draw_responses else same  # four lines each
            figures[name] = _pair(draw, quantity_label(plain.run, signal, same, what), same, (plain, adaptive))
    return figures


def _pictures(run: Run) -> list[tuple[str, Draw, str, str, list[str]]]:
    """Title, drawing, signal with the units, what its entries are of the names, and names of every picture of a pair."""
    judged, inputs = list(run.layout["error"].elements), list(run.layout["command"].elements)
    phases = [("Phase trajectories", _draw_phase, "error", "", _phase_names(run))] if _phase_names(run) else []
    return [
        ("Trajectory tracking", _draw_trajectory, "error", "", judged),
        *phases,
        ("Tracking error", partial(draw_signal, signal="error"), "error", "error of ", judged),
        ("Command", partial(draw_signal, signal="command"), "command", "", inputs),
        ("Highest derivatives", _draw_responses, "desired", "responses of ", list(run.layout["desired"].elements)),
    ]


def _pair(draw: Draw, label: str, names: Sequence[str], entries: tuple[Entry, Entry]) -> Drawing:
    figure, axes = row_of_axes(11, 3.6, 2)
    for axis, entry in zip(axes, entries, strict=True):
        draw(axis, entry.run, names)
        if draw is not _draw_phase:
            draw_bands(axis, entry.run)
            draw_changes(axis, entry.run)
            axis.set_xlabel(time_label(entry.run))
            axis.set_ylabel(label)
        draw_title(axis, entry.name)
        draw_legend(axis)
    _share_axes(axes)
    return figure


def _share_axes(axes: Sequence[Axes]) -> None:
    """Give both sides the range that shows all of both."""
    x, y = np.array([axis.get_xlim() for axis in axes]), np.array([axis.get_ylim() for axis in axes])
    for axis in axes:
        axis.set_xlim(x.min(), x.max())
        axis.set_ylim(y.min(), y.max())


def lyapunov_figure(comparison: Comparison) -> Drawing | None:
    """V = |S|^2 / 2 over time and its ultimate bound, for controllers with an exponential tracking law."""
    views = [(e, e.lyapunov) for e in comparison.entries if e.lyapunov is not None]
    if not views:
        return None
    figure, [axis] = row_of_axes(_WIDE, 4.0, 1)
    colours = colours_of(comparison)
    for entry, view in views:
        color, values = colours[entry.name], _positive(view.function)
        times = entry.run.period * np.arange(values.size)
        axis.semilogy(thinned(times), thinned(values), color=color, lw=1, label=literal(entry.name))
        axis.axhline(_positive(0.5 * view.ultimate**2), color=color, lw=0.8, ls="--")
    caption_axes(axis, time_label(views[0][0].run), "V")
    draw_legend(axis)
    return figure


def _positive(values: np.ndarray | float) -> Any:
    """Values that have a place on a logarithmic axis; the others are left out."""
    return np.where((np.asarray(values) > 0) & np.isfinite(values), values, np.nan)


def colours_of(comparison: Comparison) -> dict[str, str]:
    """Return the colour of every controller that ran, by name: the same one in all pictures of a report."""
    names = [e.name for e in comparison.entries if e.run.cycles > 1]
    return dict(zip(names, PALETTE * len(names), strict=False))


def _draw_trajectory(axis: Axes, run: Run, names: Sequence[str]) -> None:
    for k, name in enumerate(names):
        draw_line(axis, run, f"{shown_motion(run.layout)}.{name}", f"{name} realised", PALETTE[k % len(PALETTE)])
        draw_line(axis, run, f"reference.{name}", f"{name} nominal", _REFERENCES[k % len(_REFERENCES)], "--")
    show_usual(
        axis.set_ylim, run, [f"{one}.{name}" for one in (shown_motion(run.layout), "reference") for name in names]
    )


def _phase_names(run: Run) -> list[str]:
    """The judged coordinates whose first derivative is a state: a coordinate of order one has no phase plane."""
    return [
        name for name in run.layout["error"].elements if f"{name}'" in run.layout[shown_motion(run.layout)].elements
    ]


def _draw_phase(axis: Axes, run: Run, names: Sequence[str]) -> None:
    motion = shown_motion(run.layout)
    for k, name in enumerate(names):
        nominal = _REFERENCES[k % len(_REFERENCES)]
        for signal, style, color in ((motion, "-", PALETTE[k % len(PALETTE)]), ("reference", "--", nominal)):
            x, y = run[f"{signal}.{name}"], run[f"{signal}.{name}'"]
            axis.plot(thinned(x), thinned(y), style, color=color, lw=1, label=literal(f"{name} {signal}"))
    for limit, prime in ((axis.set_xlim, ""), (axis.set_ylim, "'")):
        show_usual(limit, run, [f"{one}.{name}{prime}" for one in (motion, "reference") for name in names])
    across, up = (quantity_label(run, motion, [name + prime for name in names]) for prime in ("", "'"))
    caption_axes(axis, across, up)


def _draw_responses(axis: Axes, run: Run, names: Sequence[str]) -> None:
    draw_responses(axis, run, names[0])


def contraction_figure(comparison: Comparison) -> Drawing | None:
    """Return a panel for every gain by its own name and scale, and one with the response errors; None where nothing contracts."""
    entries = [e for e in comparison.entries if e.contraction is not None and e.run.cycles > 2]
    if not entries:
        return None
    colours, groups = colours_of(comparison), _by_gain(entries)
    figure, [*panels, last] = row_of_axes(_WIDE, 4.0, len(groups) + 1)
    for axis, ((name, scale), same) in zip(panels, groups.items(), strict=True):
        _draw_factor(axis, name, scale, same, colours)
    for entry in entries:
        apart = (entry.run["realised"][1:] - entry.run["desired"][:-1])[:_CYCLES]
        size = np.hypot.reduce(apart, axis=1)  # a square of what diverges may be too large for a number
        cycles = np.arange(1, size.size + 1)
        last.semilogy(cycles, _positive(size), color=colours[entry.name], label=literal(entry.name), lw=1)
    last.set_xlabel("control cycle")
    last.set_ylabel("|realised - desired|, response units")
    last.set_title("The response error in the first cycles", fontsize=10, y=1.0)
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
        axis.plot(
            own,
            one.report.predicted,
            "o",
            color=colour,
            ms=9,
            mfc="none",
            mew=1.5,
            label=literal(f"{entry.name}, predicted"),
        )
        if np.isfinite(one.measured):
            axis.plot(own, one.measured, "x", color=colour, ms=7, mew=1.5, zorder=5)
        sector: float = max(one.report.sector_limit, key=abs)
        sectors.setdefault(round(sector, 3), colour)
    for sector, colour in sectors.items():
        if sector and abs(sector) < 0.999 * abs(limit):
            axis.axvline(scale * sector, color=colour, lw=1.6, ls=":", label="sector limit")
    axis.set_ylim(0, 1.6)
    axis.locator_params(axis="x", nbins=7)
    axis.ticklabel_format(axis="x", scilimits=(-3, 4))
    caption_axes(axis, literal(name), "contraction factor max|1 - a lambda|")
    axis.set_title("Predicted factor; o predicted, x measured", fontsize=10, y=1.0)
    draw_legend(axis)
