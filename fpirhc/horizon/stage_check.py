"""Whether a cost and path limits can be written for a plant, tried on symbols before any horizon is built."""

from __future__ import annotations

import casadi as ca

from fpirhc.errors import FpirhcError, Mistakes
from fpirhc.fields.user_code import named_results, scalar_expression
from fpirhc.horizon.cost import Cost, View
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.layout import Named
from fpirhc.symbolic.live import nominal
from fpirhc.task.limits import Limits


def check_stage(plant: Plant, cost: Cost | None, limits: Limits, mistakes: Mistakes) -> None:
    """Add every mistake in the cost's names and weights, and in the user's functions of a stage."""
    cost, limits = nominal(cost), nominal(limits)
    view = _view_of_symbols(plant)
    parts = (view.state, view.output, view.reference, view.input, view.input_before, view.feedforward, view.parameters)
    symbols = (*(part.vector for part in parts), view.time)
    if cost is not None:
        try:
            cost.check(plant)
            for name, term in named_results("cost", cost.stage(view)).items():
                scalar_expression(f"cost: term '{name}'", term, symbols=symbols, finite=False)
        except FpirhcError as error:
            mistakes.add(str(error))
    for name, path in limits.paths.items():
        try:
            path.named_value(name, view, symbols)
        except FpirhcError as error:
            mistakes.add(str(error))


def _view_of_symbols(plant: Plant) -> View:
    state, command, parameter = plant.state, plant.input, plant.parameter
    x = Named(state.elements, ca.SX.sym("x", state.size), "state")
    elements, what = plant.output.elements, plant.output.name

    def inputs(name: str) -> Named:
        return Named(command.elements, ca.SX.sym(name, command.size), "input")

    return View(
        x,
        Named(elements, ca.SX.sym("reference", len(elements)), what),
        inputs("u"),
        inputs("before"),
        inputs("feedforward"),
        Named(parameter.elements, ca.SX.sym("p", parameter.size), "parameter"),
        ca.SX.sym("t"),
        Named(elements, ca.SX.sym("y", len(elements)), what),
    )
