"""Charts of a reality beside the model's belief: states that the model does not have, and the response that it expected."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from fpirhc.simulation.run import Run
    from fpirhc.studies.comparison.entry import Entry

_REALITY = "reality_state"
Chart = dict[str, Any]
Shorten = Callable[[np.ndarray], list[float | None]]


def reality_charts(entries: Sequence[Entry], shorten: Shorten) -> list[Chart]:
    """Return the charts of the runs with a reality that is a plant; none without.

    Args:
        entries: controllers with their runs.
        shorten: function of a signal's values that returns those of a chart.
    """
    real = [e for e in entries if _REALITY in e.run.layout]
    if not real:
        return []
    first = real[0].run
    own = [name for name in first.layout[_REALITY].elements if name not in first.layout["state"].elements]
    charts = [
        _chart(
            f"reality: {name}",
            first.unit(f"{_REALITY}.{name}"),
            [(e.name, e.run[f"{_REALITY}.{name}"]) for e in real],
            shorten,
        )
        for name in own
    ]
    return charts + [chart for e in real for chart in _responses(e.name, e.run, shorten)]


def _responses(name: str, run: Run, shorten: Shorten) -> list[Chart]:
    """The response that the model expected of the last command, and the real one, by coordinate."""
    if not {"deformed", "plant_realised"} <= set(run.layout.names):
        return []
    charts = []
    for c in run.layout["deformed"].elements:
        requested, real = run[f"deformed.{c}"], run[f"plant_realised.{c}"]
        expected = np.concatenate([real[:1], requested[:-1]])
        lines = [("the model expected", expected), ("the reality did", real)]
        title = f"{name}: response of {c}, belief and reality"
        charts.append({**_chart(title, run.unit(f"deformed.{c}"), lines, shorten), "only": name})
    return charts


def _chart(title: str, unit: str, lines: Sequence[tuple[str, np.ndarray]], shorten: Shorten) -> Chart:
    return {"title": title, "unit": unit, "series": [{"name": n, "values": shorten(v)} for n, v in lines]}
