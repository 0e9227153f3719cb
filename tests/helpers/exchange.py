"""Shipped problems with another deformation or an exact model, for several tests."""

from dataclasses import replace

import fpirhc as fp


def with_exact_model(problem: fp.Problem) -> fp.Problem:
    """The problem whose model is its plant, with nothing that is random or disturbs."""
    known = {n: replace(p, approximate=p.exact) for n, p in problem.plant.parameters.items()}
    sensors = {n: replace(s, noise=None, dropout=0.0) for n, s in problem.sensing.sensors.items()}
    plant, sensing = replace(problem.plant, parameters=known), replace(problem.sensing, sensors=sensors)
    signals = {name: fp.Known(one.values) for name, one in problem.signals.items()}
    return replace(problem.of_model, plant=plant, disturbances={}, sensing=sensing, signals=signals)
