"""Does the prediction over the dead time know what the model lacks?

A model that lacks a constant response predicts a wrong state, and adaptation does not mend that: see `Predicted`. A residual in the
prediction, or the desired responses in place of the model, may; whether one of them does, runs on the plant say.
"""

from __future__ import annotations

import math

from fpirhc.controllers.wrappers.predicted import other_predictions
from fpirhc.errors import FpirhcError
from fpirhc.review.answer import Answer, Verdict
from fpirhc.review.nominal_runs import CYCLES
from fpirhc.review.question import Case, ControllerQuestion
from fpirhc.simulation.error_pair import errors_of
from fpirhc.simulation.model_as_plant import shortened
from fpirhc.simulation.simulate import simulate

KNOWS = "Does the prediction know what the model lacks?"
_LESS = 0.5  # of the error, below which another prediction is named


def prediction_knows(case: Case) -> Answer | None:
    """Return the errors with the model's prediction and with others; None where another one is in use."""
    problem = case.grid.real or case.problem
    others = other_predictions(case.controller)
    if not others:
        return None
    short, names = shortened(problem, CYCLES), {}
    try:
        own = simulate(short, case.controller, seed=0, compiled=False)
    except FpirhcError as error:
        return Answer(KNOWS, Verdict.UNKNOWN, f"no run: {error}")
    for name, other in others.items():
        try:
            names[name] = errors_of(short, (own, simulate(short, other, seed=0, compiled=False)))
        except FpirhcError:  # a plant that this prediction does not serve
            continue
    if not names:
        return Answer(KNOWS, Verdict.UNKNOWN, "no other prediction serves this plant")
    sizes = {name: max(pair.adapted[n] / pair.ranges[n] for n in pair.adapted) for name, pair in names.items()}
    pair = next(iter(names.values()))
    size = max(pair.without[n] / pair.ranges[n] for n in pair.without)
    best = min(sizes, key=lambda name: sizes[name])
    text = f"rms error {size:.3g} of the range with the model's prediction, {sizes[best]:.3g} with {best}"
    numbers = {"error": size, **{f"error with {name}": value for name, value in sizes.items() if math.isfinite(value)}}
    if sizes[best] > _LESS * size:
        return Answer(KNOWS, Verdict.YES, text, "", numbers)
    return Answer(KNOWS, Verdict.UNKNOWN, text, f"Predict with what acts: Predicted(..., by={best}).", numbers)


QUESTIONS = (ControllerQuestion(prediction_knows, KNOWS, order=53, adaptive=False),)
