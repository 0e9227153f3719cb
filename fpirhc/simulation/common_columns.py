"""Columns that every run has, whatever the problem: state and response of the plant, and the error by which a run is judged.

A loop computes them where the controller is given another state or response than the plant's own. Everywhere else they follow from
logged signals, so they are added after the run and cost nothing in the loop.
"""

from __future__ import annotations

import numpy as np

from fpirhc.symbolic.layout import Layout, Signal

_SAME = {"plant_state": "state", "plant_output": "output", "plant_realised": "realised"}

_MOTION = (
    "plant_output",
    "output",
    "plant_state",
    "state",
)  # where the judged motion is logged: the first that a run has


def with_common_columns(layout: Layout, log: np.ndarray) -> tuple[Layout, np.ndarray]:
    """Return layout and log, shape (cycles, layout.size), with 'plant_state', 'plant_realised' and 'true_error'.

    'plant_state' has the states of the model that the plant that moves has.

    'true_error' is the reference minus the plant's state of the judged coordinates, at the same time.
    """
    # A loop that logs what is true logs all of it: a reality may lack states that the controller believes in.
    true = any(name in layout for name in _SAME)
    added = [
        (_renamed(layout[logged], name), log[:, layout.slice(logged)])
        for name, logged in _SAME.items()
        if logged in layout and not true
    ]
    if "true_error" not in layout and "error" in layout:
        added.append((_renamed(layout["error"], "true_error"), _true_error(layout, log)))
    if not added:
        return layout, log
    return layout + Layout(tuple(signal for signal, _ in added)), np.hstack([log, *(values for _, values in added)])


def judged_motion(layout: Layout) -> str:
    """Return the name of the signal of the plant's own motion that is judged: its outputs, or its state."""
    return next(name for name in _MOTION if name in layout)


def shown_motion(layout: Layout) -> str:
    """Return the name of the signal that the controller is given of what is judged: 'output' or 'state'."""
    return "output" if "output" in layout else "state"


def _true_error(layout: Layout, log: np.ndarray) -> np.ndarray:
    state = layout[judged_motion(layout)]
    if "reference" not in layout:
        return log[:, layout.slice("error")]  # a controller of a user's own that logs its error alone
    places = [state.elements.index(name) for name in layout["error"].elements]
    reference, states = log[:, layout.slice("reference")], log[:, layout.slice(state.name)]
    return np.asarray(reference[:, places] - states[:, places])


def _renamed(signal: Signal, name: str) -> Signal:
    return Signal(name, signal.elements, signal.units)
