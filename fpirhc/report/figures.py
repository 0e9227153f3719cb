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
from fpirhc.summary import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from fpirhc.contraction.spectrum import ContractionReport
    from fpirhc.simulation.picture import Drawing
    from fpirhc.simulation.run import Run
    from fpirhc.studies.comparison.comparison import Comparison
    from fpirhc.studies.comparison.entry import Contraction, Entry
    from fpirhc.studies.open_loop import Solved
    from fpirhc.studies.operating_limits import OperatingLimit, OperatingLimits
    from fpirhc.studies.scenarios.scenario_comparison import ScenarioComparison
    from fpirhc.studies.sweep import Sweep
    from fpirhc.task.problem import Problem

    Draw: TypeAlias = Callable[[Axes, Run, Sequence[str]], None]

_PANELS = 3  # of a figure, side by side
_GROUPS = 6  # of scenarios with similar mismatch, whose medians are joined by a line
_WIDE = 16.5  # inches, of a picture as wide as the page
_CYCLES = 150  # of the decay of a response error
_BEYOND = 1.2  # of the linear limit, up to which the factor is drawn
_ERROR = "rms error [% of the reference's range]"
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


def headline_figure(comparison: Comparison, plain: Entry, adaptive: Entry) -> Figure:
    """The picture for a title page: position and error of the pair."""
    figure = new_figure(11, 4.2, comparison.title)
    axes = figure.subplots(2, 2, sharex=True)
    for column, entry in enumerate((plain, adaptive)):
        names = entry.run.layout["error"].elements
        _draw_trajectory(axes[0, column], entry.run, names)
        draw_signal(axes[1, column], entry.run, names, "error")
        for row in (0, 1):
            draw_bands(axes[row, column], entry.run)
            draw_changes(axes[row, column], entry.run)
        draw_title(axes[0, column], entry.name)
        axes[1, column].set_xlabel(time_label(entry.run))
        draw_legend(axes[0, column])
    limit = max(axes[1, 0].get_ylim(), key=abs)
    for column in (0, 1):
        axes[1, column].set_ylim(-abs(limit), abs(limit))
    return figure


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


def mismatch_figure(comparison: ScenarioComparison) -> Drawing:
    """Return the figure of the error of every scenario against its mismatch, one colour per controller."""
    figure = new_figure(
        9,
        4.8,
        f"{comparison.problem}: error against mismatch, {comparison.count} {'cases' if comparison.named else 'scenarios'}",
    )
    axis = figure.subplots()
    for k, one in enumerate(comparison.summaries):
        colour, ended = PALETTE[k % len(PALETTE)], ~np.isfinite(one.errors)
        x, y = 100 * one.mismatch, 100 * one.errors
        axis.semilogy(x[~ended], y[~ended], "o", color=colour, ms=3, alpha=0.5)
        axis.plot(
            x[ended], np.ones(ended.sum()), "x", color=colour, ms=6, transform=axis.get_xaxis_transform(), clip_on=False
        )
        axis.semilogy(*_medians(x[~ended], y[~ended]), "-", color=colour, lw=1.5, label=literal(one.name))
    caption_axes(axis, "mismatch between model and plant [%]", _ERROR)
    draw_legend(axis)
    return figure


def limits_figure(result: OperatingLimits) -> Drawing:
    """Return the figure of the error against what grows, a panel per quantity and a colour per controller."""
    colours = dict(
        zip(dict.fromkeys(one.controller for one in result.limits), PALETTE * len(result.limits), strict=False)
    )
    shown = [q for q in result.quantities if any(one.quantity is q for one in result.limits)]
    columns = min(len(shown), _PANELS)
    rows = -(-len(shown) // columns)
    figure = new_figure(5.5 * columns, 3.8 * rows, f"{result.problem}: error against what grows")
    axes = list(figure.subplots(rows, columns, squeeze=False, sharey=True).flat)
    finite = [p.error for one in result.limits for p in one.points if np.isfinite(p.error)]
    edge = 10 * max(10 * result.fails, min(max(finite, default=1.0), 1e3 * result.fails))
    for axis, quantity in zip(axes, shown, strict=False):
        for one in (one for one in result.limits if one.quantity is quantity):
            _draw_limit(axis, one, colours[one.controller], edge)
        axis.axhline(100 * result.fails, color="#777777", ls="--", lw=1)
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_ylim(top=150 * edge)
        caption_axes(axis, literal(f"{quantity.name} [{quantity.unit}]"), _ERROR)
    draw_legend(axes[0])
    for axis in axes[len(shown) :]:
        axis.remove()
    return figure


def _draw_limit(axis: Axes, one: OperatingLimit, colour: str, edge: float) -> None:
    values = [max(p.value, one.quantity.first / 2) for p in one.points]  # zero has no place on the axis
    errors = [100 * min(p.error, edge) for p in one.points]
    axis.plot(values, errors, "-", color=colour, lw=1.5, label=literal(one.controller))
    for style, failed in (("o", False), ("x", True)):
        places = [k for k, p in enumerate(one.points) if bool(p.why) is failed]
        axis.plot([values[k] for k in places], [errors[k] for k in places], style, color=colour, ms=4)


_FAILED = "#d8d8d8"


def sweep_figure(result: Sweep) -> Drawing:
    """Return the figure of a sweep: lines over one setting; over two a map per controller, and one of who is best."""
    return _sweep_lines(result) if len(result.axes) == 1 else _sweep_maps(result)


def _sweep_lines(result: Sweep) -> Drawing:
    [over] = result.axes
    figure = new_figure(9.0, 4.5, f"{result.problem}: over {over.path}")
    axis = figure.subplots()
    for one, colour in zip(result.maps, PALETTE * len(result.maps), strict=False):
        shown = np.where(one.outcomes == "finished", one.values, np.nan)
        axis.plot(
            over.values, [result.aim.drawn(v) for v in shown], ".-", color=colour, lw=1.5, label=literal(one.controller)
        )
        failed = [v for v, outcome in zip(over.values, one.outcomes, strict=True) if outcome != "finished"]
        axis.plot(
            failed, [1.0] * len(failed), "x", color=colour, ms=5, transform=axis.get_xaxis_transform(), clip_on=False
        )
        if over.path in one.now:
            axis.axvline(one.now[over.path], color=colour, ls=":", lw=1)
    _scale_of(axis, result)
    caption_axes(axis, _path_label(result, over.path), literal(_figure_label(result)))
    draw_legend(axis)
    return figure


def _sweep_maps(result: Sweep) -> Drawing:
    from matplotlib.colors import ListedColormap, LogNorm, Normalize

    several = result.ranks
    count = len(result.maps) + several
    columns = min(count, _PANELS)
    rows = -(-count // columns)
    figure = new_figure(4.6 * columns, 3.9 * rows, f"{result.problem}: {_figure_label(result)}")
    panels = list(figure.subplots(rows, columns, squeeze=False).flat)
    figures = [
        np.vectorize(result.aim.drawn)(np.where(m.outcomes == "finished", m.values, np.inf)) for m in result.maps
    ]
    numbers = np.concatenate([values[np.isfinite(values)] for values in figures])
    low, high = (float(numbers.min()), float(numbers.max())) if numbers.size else (0.1, 1.0)
    high = high if high > low else low + 1
    norm = LogNorm(low, high) if low > 0 else Normalize(low, high)
    drawn = None
    for axis, one, values in zip(panels, result.maps, figures, strict=False):
        drawn = _draw_map(axis, result, values, cmap="viridis", norm=norm)
        axis.set_title(literal(one.controller))
        if all(path.path in one.now for path in result.axes):
            axis.plot(*(one.now[over.path] for over in result.axes), "o", mfc="none", mec="white", mew=1.5)
    if several:
        axis = panels[len(result.maps)]
        colours = [PALETTE[k % len(PALETTE)] for k in range(len(result.maps))]
        best = np.where(result.winners >= 0, result.winners, np.nan)
        _draw_map(axis, result, best, cmap=ListedColormap(colours), norm=Normalize(-0.5, len(colours) - 0.5))
        for one, colour in zip(result.maps, colours, strict=True):
            axis.plot([], [], "s", color=colour, label=literal(one.controller))
        axis.set_title("best")
        draw_legend(axis)
    for axis in panels[count:]:
        axis.remove()
    if drawn is not None:
        figure.colorbar(drawn, ax=panels[: len(result.maps)], label=literal(_figure_label(result)))
    return figure


def sweep_panels(figure: Drawing, result: Sweep) -> list[dict[str, Any]]:
    """Return where the panels of a drawn figure lie, and where the values of the settings in them, as shares of its size."""
    panels = []
    for axis in (one for one in figure.axes if one.get_label() != "<colorbar>"):
        to_figure, (left, bottom) = axis.transData - figure.transFigure, (axis.get_xlim()[0], axis.get_ylim()[0])
        across = to_figure.transform([(v, bottom) for v in result.axes[0].values])[:, 0]
        along = [to_figure.transform([(left, v) for v in over.values])[:, 1] for over in result.axes[1:]]
        ends = axis.get_position()
        centres = [values.tolist() for values in (across, *along)]
        panels.append({"low": [*map(float, ends.min)], "high": [*map(float, ends.max)], "centres": centres})
    return panels


def sweep_cells(result: Sweep) -> dict[str, Any]:
    """Return what is said of every cell of a sweep, and the command of its run."""
    axes = [{"path": a.path, "values": [number(v) for v in a.values], "set": result.set_texts(a)} for a in result.axes]
    maps = [
        {
            "controller": one.controller,
            "without": list(one.without),
            "run": result.run_command(one.controller),
            "cells": [
                f"{result.aim.name} {result.aim.text(float(v))}" if outcome == "finished" else str(outcome)
                for v, outcome in zip(one.values.ravel(), one.outcomes.ravel(), strict=True)
            ],
        }
        for one in result.maps
    ]
    return {"axes": axes, "maps": maps, "seed": f" --seed {result.seed}"}


def _draw_map(axis: Axes, result: Sweep, values: np.ndarray, **colours: Any) -> Any:
    """One map; cells without a number are grey."""
    across, along = result.axes
    axis.set_facecolor(_FAILED)
    masked = np.ma.masked_invalid(values.T)
    mesh = axis.pcolormesh(across.values, along.values, masked, shading="nearest", **colours)
    for over, scale, label in ((across, axis.set_xscale, axis.set_xlabel), (along, axis.set_yscale, axis.set_ylabel)):
        if over.logarithmic:
            scale("log" if over.values[0] > 0 else "symlog")
        label(_path_label(result, over.path))
    return mesh


def _scale_of(axis: Axes, result: Sweep) -> None:
    [over] = result.axes
    if over.logarithmic:
        axis.set_xscale("log" if over.values[0] > 0 else "symlog")
    finished = [v for one in result.maps for v in one.values[one.outcomes == "finished"]]
    if finished and min(finished) > 0 and max(finished) > 10 * min(finished):
        axis.set_yscale("log")


def _path_label(result: Sweep, path: str) -> str:
    unit = result.units.get(path)
    return literal(f"{path} [{unit}]" if unit else path)


def _figure_label(result: Sweep) -> str:
    return f"{result.aim.name} [{result.aim.drawn_unit}]" if result.aim.drawn_unit else result.aim.name


def _medians(x: np.ndarray, y: np.ndarray) -> tuple[list[float], list[float]]:
    order = np.argsort(x)
    groups = [g for g in np.array_split(order, min(_GROUPS, max(1, x.size // 3))) if g.size]
    return [float(np.median(x[g])) for g in groups], [float(np.median(y[g])) for g in groups]
