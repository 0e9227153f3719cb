"""Figures (matplotlib): one run, and the pairs without | with adaptivity that the method's papers show."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fpirhc.errors import OutputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from fpirhc.simulation.run import Run
    from fpirhc.studies.comparison.compare import Comparison, Entry
    from fpirhc.studies.open_loop import Solved
    from fpirhc.task.problem import Problem

PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#5b4a9c", "#8c6d1f", "#7f7f7f", "#111111")
BANDS = ("#7f7f7f", "#e69f00", "#56b4e9", "#cc79a7")  # of time slots, drawn pale
_RESPONSES = {"nominal": "#009e73", "desired": "#0072b2", "deformed": "#e69f00", "realised": "#d55e00"}
_POINTS = 2000  # drawn per line
_TALL = 20  # times the median range from which a panel's range is cut, so that one spike does not hide the rest


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure to a file.

    Raises:
        OutputError: the file cannot be written.
    """
    try:
        figure.savefig(path, dpi=120)
    except OSError as error:
        raise OutputError(f"cannot write the figure to '{path}': {error.strerror}") from None


def run_figure(run: Run) -> Figure:
    """Errors, positions, commands and responses of one run over time."""
    figure = _figure(10, 9, f"{run.controller}" + (f" ({run.stop})" if run.stop else ""))
    names = run.layout["error"].elements
    axes = figure.subplots(4, 1, sharex=True)
    for k, name in enumerate(names):
        _line(axes[0], run, f"error.{name}", name, PALETTE[k])
        _line(axes[1], run, f"state.{name}", name, PALETTE[k])
        _line(axes[1], run, f"reference.{name}", f"{name} reference", PALETTE[k], "--")
    for k, name in enumerate(run.layout["command"].elements):
        _line(axes[2], run, f"command.{name}", name, PALETTE[k])
    first = run.layout["desired"].elements[0]
    _responses(axes[3], run, first)
    for axis, what in zip(axes, ("error", "position", "command", f"responses of {first}"), strict=True):
        _bands(axis, run)
        axis.set_ylabel(what)
        _legend(axis)
    axes[3].set_xlabel("time [s]")
    return figure


def plan_figure(problem: Problem, solved: Sequence[Solved]) -> Figure:
    """States with their reference and inputs of open-loop plans over the horizon, one line per optimiser."""
    assert problem.horizon is not None
    plant, plan = problem.plant, solved[0].plan
    names = [*plant.state.elements, *plant.input.elements]
    figure = _figure(9, 2.0 * len(names) + 1, f"plans of {plan.problem.stages} stages")
    axes = np.atleast_1d(figure.subplots(len(names), 1, sharex=True))
    times = np.arange(plan.problem.stages + 1) * plan.problem.step
    reference = plan.data[plan.problem.data.slice("reference")]
    for k, (axis, name) in enumerate(zip(axes, names, strict=True)):
        is_state = k < plant.state.size
        if is_state:
            axis.plot(times, reference[k], "--", color="#777777", label="reference")
        for row, (one, colour) in enumerate(zip(solved, PALETTE, strict=False)):
            width = max(1.0, 3.0 - 0.7 * row)  # plans that agree lie on each other
            if is_state:
                axis.plot(times, one.plan.states[k], color=colour, label=_plain(one.name), linewidth=width)
            else:
                axis.stairs(one.plan.inputs[k - plant.state.size], times, baseline=None, color=colour, linewidth=width)
        unit = plant.state.units[k] if is_state else plant.input.units[k - plant.state.size]
        axis.set_ylabel(_plain(f"{name} [{unit}]"))
    _legend(axes[0])
    axes[-1].set_xlabel("time [s]")
    return figure


def pair_figures(plain: Entry, adaptive: Entry) -> dict[str, Figure]:
    """The seed papers' pictures as pairs, without adaptivity on the left and with it on the right."""
    draws = {
        "Trajectory tracking": _draw_trajectory,
        "Phase trajectories": _draw_phase,
        "Tracking error": _draw_error,
        "Command": _draw_command,
        "Second derivatives" if _is_second_order(plain.run) else "Highest derivatives": _draw_responses,
    }
    found = {}
    for title, draw in draws.items():
        figure = _figure(11, 3.6, "")
        axes = figure.subplots(1, 2)
        for axis, entry in zip(axes, (plain, adaptive), strict=True):
            draw(axis, entry.run)
            if draw is not _draw_phase:
                _bands(axis, entry.run)
            axis.set_title(_plain(entry.name), fontsize=10)
            _legend(axis)
        found[title] = figure
    return found


def contraction_figure(comparison: Comparison) -> Figure | None:
    """Predicted factor against the effective gain with its limits, and the response error's first cycles."""
    entries = [e for e in comparison.entries if e.contraction is not None and e.run.cycles > 2]
    if not entries:
        return None
    figure = _figure(11, 3.8, "")
    left, right = figure.subplots(1, 2)
    _draw_factor(left, entries)
    for k, entry in enumerate(entries):
        run = entry.run
        size = np.linalg.norm(run["realised"][1:] - run["desired"][:-1], axis=1)[:150]
        right.semilogy(
            np.arange(1, size.size + 1), np.maximum(size, 1e-12), color=PALETTE[k], label=_plain(entry.name), lw=1
        )
    right.set_xlabel("control cycle")
    right.set_ylabel("|realised - desired|, response units")
    right.set_title("The response error in the first cycles", fontsize=10)
    _legend(right)
    return figure


def lyapunov_figure(comparison: Comparison) -> Figure | None:
    """V = |S|^2 / 2 over time and its ultimate bound, for controllers with an exponential tracking law."""
    views = [(e, e.lyapunov) for e in comparison.entries if e.lyapunov is not None]
    if not views:
        return None
    figure = _figure(11, 3.4, "")
    axis = figure.subplots()
    for k, (entry, view) in enumerate(views):
        color, values = PALETTE[k % len(PALETTE)], np.maximum(view.function, 1e-20)
        times = entry.run.period * np.arange(values.size)
        axis.semilogy(_thin(times), _thin(values), color=color, lw=1, label=_plain(entry.name))
        axis.axhline(max(0.5 * view.bound**2, 1e-20), color=color, lw=0.8, ls="--")
    axis.set_xlabel("time [s]")
    axis.set_ylabel("V")
    axis.grid(visible=True, alpha=0.25)
    _legend(axis)
    return figure


def headline_figure(comparison: Comparison, plain: Entry, adaptive: Entry) -> Figure:
    """The picture for a title page: position and error of the pair."""
    figure = _figure(11, 4.2, comparison.title)
    axes = figure.subplots(2, 2, sharex=True)
    for column, entry in enumerate((plain, adaptive)):
        _draw_trajectory(axes[0, column], entry.run)
        _draw_error(axes[1, column], entry.run)
        for row in (0, 1):
            _bands(axes[row, column], entry.run)
        axes[0, column].set_title(_plain(entry.name), fontsize=10)
        axes[0, column].set_xlabel("")
        _legend(axes[0, column])
    limit = max(axes[1, 0].get_ylim(), key=abs)
    for column in (0, 1):
        axes[1, column].set_ylim(-abs(limit), abs(limit))
    return figure


def _figure(width: float, height: float, title: str) -> Figure:
    from fpirhc.report.drawing import Drawing

    figure = Drawing(figsize=(width, height), layout="constrained")
    if title:
        figure.suptitle(_plain(title), fontsize=11)
    return figure


def _plain(text: str) -> str:
    from fpirhc.report.drawing import plain

    return plain(text)


def _bands(axis: Axes, run: Run) -> None:
    """Time slots as shaded bands, named in the legend."""
    named: set[int] = set()
    for start, end, slot in run.spans():
        name = run.layout["desired"].elements[slot]
        axis.axvspan(
            start,
            end,
            color=BANDS[slot % len(BANDS)],
            alpha=0.12,
            lw=0,
            label=None if slot in named else f"slot {name}",
        )
        named.add(slot)


def _thin(values: np.ndarray) -> np.ndarray:
    return values[:: max(1, values.shape[0] // _POINTS)]


def _line(axis: Axes, run: Run, column: str, label: str, color: str, style: str = "-") -> None:
    axis.plot(
        _thin(run.time), _thin(run[column]), style, color=color, lw=1, label=_plain(f"{label} [{run.unit(column)}]")
    )
    axis.grid(visible=True, alpha=0.25)


def _legend(axis: Axes) -> None:
    if axis.get_legend_handles_labels()[0]:
        axis.legend(fontsize=7, loc="best", framealpha=0.8)


def _is_second_order(run: Run) -> bool:
    return all(unit.endswith("s^2") for unit in run.layout["desired"].entry_units)


def _draw_trajectory(axis: Axes, run: Run) -> None:
    for k, name in enumerate(run.layout["error"].elements):
        _line(axis, run, f"reference.{name}", f"{name} nominal", PALETTE[k], "--")
        _line(axis, run, f"state.{name}", f"{name} realised", PALETTE[k])
    axis.set_xlabel("time [s]")


def _draw_phase(axis: Axes, run: Run) -> None:
    states = run.layout["state"].elements
    for k, name in enumerate(run.layout["error"].elements):
        if f"{name}'" in states:
            for signal, style in (("reference", "--"), ("state", "-")):
                x, y = run[f"{signal}.{name}"], run[f"{signal}.{name}'"]
                axis.plot(_thin(x), _thin(y), style, color=PALETTE[k], lw=1, label=_plain(f"{name} {signal}"))
    axis.set_xlabel("q")
    axis.set_ylabel("q'")
    axis.grid(visible=True, alpha=0.25)


def _draw_error(axis: Axes, run: Run) -> None:
    for k, name in enumerate(run.layout["error"].elements):
        _line(axis, run, f"error.{name}", name, PALETTE[k])
    axis.set_xlabel("time [s]")


def _draw_command(axis: Axes, run: Run) -> None:
    for k, name in enumerate(run.layout["command"].elements):
        _line(axis, run, f"command.{name}", name, PALETTE[k])
    axis.set_xlabel("time [s]")


def _draw_responses(axis: Axes, run: Run) -> None:
    _responses(axis, run, run.layout["desired"].elements[0])
    axis.set_xlabel("time [s]")


def _responses(axis: Axes, run: Run, name: str) -> None:
    for signal, color in _RESPONSES.items():
        style = ":" if signal == "realised" else "-"
        _line(axis, run, f"{signal}.{name}", f"{name} {signal}", color, style)
    values = np.abs(np.concatenate([run[f"{s}.{name}"] for s in _RESPONSES])) if run.cycles else np.zeros(1)
    usual = float(np.quantile(values, 0.99))
    if usual > 0 and values.max() > _TALL * usual:
        axis.set_ylim(-3 * usual, 3 * usual)


def _draw_factor(axis: Axes, entries: list[Entry]) -> None:
    first = entries[0].contraction
    assert first is not None
    limit = max(abs(e) for e in first.report.linear_limit) or 1.0
    gains = np.linspace(0, 1.2 * limit, 300) * (1 if first.report.linear_limit[1] > 0 else -1)
    eigenvalues = first.spectrum.eigenvalues.ravel()
    axis.plot(gains, np.abs(1 - gains[:, None] * eigenvalues[None, :]).max(axis=1), color="#444444", lw=1.2)
    axis.axhline(1.0, color="#aa0000", lw=0.8)
    axis.axvline(limit * np.sign(gains[-1]), color="#aa0000", lw=0.8, ls="--", label="linear limit")
    sectors: dict[float, str] = {}
    for k, entry in enumerate(entries):
        assert entry.contraction is not None
        report = entry.contraction.report
        axis.plot(
            report.effective_gain,
            report.predicted,
            "o",
            color=PALETTE[k],
            ms=6,
            label=_plain(f"{entry.name}, predicted"),
        )
        if np.isfinite(entry.contraction.measured):
            axis.plot(report.effective_gain, entry.contraction.measured, "x", color=PALETTE[k], ms=8)
        low, high = report.sector_limit
        sectors.setdefault(round(high if high > 0 else low, 3), PALETTE[k])
    for sector, color in sectors.items():
        if sector and abs(sector) < 0.999 * limit:
            axis.axvline(sector, color=color, lw=0.8, ls=":", label="sector limit")
    axis.set_ylim(0, 1.6)
    axis.set_xlabel("effective gain a")
    axis.set_ylabel("contraction factor max|1 - a lambda|")
    axis.set_title("Predicted factor; o predicted, x measured", fontsize=10)
    axis.grid(visible=True, alpha=0.25)
    _legend(axis)
