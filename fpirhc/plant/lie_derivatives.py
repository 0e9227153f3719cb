"""Outputs y = h(x, p) or h(x, u, p): quantities that are controlled or judged and are expressions of the state, or of the inputs.

Theory: docs/theory.md.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import casadi as ca
import numpy as np

from fpirhc.errors import Mistakes
from fpirhc.fields.kinds import described, takes
from fpirhc.fields.user_code import called, scalar_expression
from fpirhc.plant.maps import shifted
from fpirhc.plant.motion import Motion, arguments_of, by_name, words
from fpirhc.symbolic.layout import Expression

_Motion = TypeVar("_Motion", bound=Motion)
Symbols = tuple[ca.SX, ca.SX, ca.SX, ca.SX]


def output_expression(plant: Motion, name: str, x: Expression, u: Expression, p: Expression) -> Expression:
    """Return h(x, u, p) of one output."""
    what, expression = f"outputs: '{name}'", plant.outputs[name].expression
    arguments = by_name(plant, x, p)
    arguments = arguments if takes(expression, len(arguments)) else arguments_of(plant, x, u, p)
    return scalar_expression(what, called(what, expression, *arguments), of=expression, symbols=(x, u, p))


def lie_derivatives(plant: Motion, value: Expression, count: int, symbols: Symbols) -> list[Expression]:
    """Return an expression of the state and its first `count` derivatives along the motion.

    Args:
        value: expression of x, u and p.
        symbols: x, u, p, and the forcing w.
    """
    chain = [value]
    for _ in range(count):
        chain.append(_along(plant, chain[-1], symbols))
    return chain


def believed_disturbance(plant: Motion, name: str, p: Expression) -> Expression:
    """Return what a model believes to add to the response of an output: zero, or a parameter of an estimator."""
    parameter = plant.outputs[name].response_disturbance
    return p[plant.parameter.elements.index(parameter)] if parameter else ca.SX(0)


def without_disturbances(plant: _Motion) -> _Motion:
    """Return the plant without believed disturbances of its outputs' responses; itself where there are none."""
    if not any(one.response_disturbance for one in plant.outputs.values()):
        return plant
    return replace(plant, outputs={n: replace(one, response_disturbance="") for n, one in plant.outputs.items()})


def _along(plant: Motion, value: Expression, symbols: Symbols) -> Expression:
    """The derivative of an expression along the motion, or of a map its divided difference, with the input held."""
    if plant.step is not None:
        return shifted(plant, value, symbols)
    x, u, p, w = symbols
    return ca.jtimes(value, x, plant.equations.forced_rate(x, u, p, w))


def output_order(plant: Motion, name: str) -> int | None:
    """Return the relative order of an output: the first derivative that depends on an input, or 0; None where none does."""
    x, u, p = plant.symbols()
    symbols = x, u, p, ca.SX.zeros(len(plant.names))
    value = output_expression(plant, name, x, u, p)
    if ca.jacobian_sparsity(value, u).nnz():
        return 0
    for order in range(1, plant.state.size + 1):
        value = _along(plant, value, symbols)
        if ca.jacobian_sparsity(value, u).nnz():
            return order
    return None


def check_outputs(plant: Motion, mistakes: Mistakes) -> None:
    """Add every mistake of the outputs to `mistakes`."""
    for name, one in plant.outputs.items():
        lower = max(plant.orders, default=0)
        if not (takes(one.expression, lower + 1) or takes(one.expression, lower + 2)):
            first = ["x"] if words(plant)[0] == "state" else ["q", "v", "a", *(f"d{k}" for k in range(3, 12))]
            names = ", ".join(first[:lower])
            mistakes.add(
                f"outputs: the expression of '{name}' is called as function({names}, p), or as function({names}, u, p) where the "
                f"command moves it at once; got {described(one.expression)}; write lambda {names}, p: ..."
            )
            continue
        with mistakes.caught():
            _check_one(plant, name, mistakes)


def _check_one(plant: Motion, name: str, mistakes: Mistakes) -> None:
    x, u, p = plant.symbols()
    value = ca.SX(output_expression(plant, name, x, u, p))
    if name in plant.coordinates and not ca.is_equal(value, x[plant.state.elements.index(name)], 1):
        mistakes.add(f"outputs: '{name}' has the name of a coordinate, but is another expression; rename the output")
        return
    parameter = plant.outputs[name].response_disturbance
    if parameter and parameter not in plant.parameters:
        mistakes.add(
            f"outputs: '{name}': response_disturbance={parameter!r} is no parameter of the plant; add it there"
        )
    controlled = plant.controlled is None or name in plant.controlled
    if controlled and output_order(plant, name) is None:
        mistakes.add(f"outputs: no input reaches '{name}', however often it is differentiated; control another output")


def structural_order(plant: Motion, coordinate: str) -> int | None:
    """Return the number of the first derivative of `coordinate` that depends on an input; None if there is none.

    Only the pattern of dependence counts, so an accidental cancellation has no effect. The search is a breadth-first walk from the
    coordinate through the states on which its derivatives depend.
    """
    x, u, p = plant.symbols()
    rate = plant.equations.rate(x, u, p)
    on_state = np.array(ca.DM(ca.jacobian_sparsity(rate, x), 1).full(), dtype=bool)
    on_input = np.array(ca.DM(ca.jacobian_sparsity(rate, u), 1).full(), dtype=bool).any(axis=1)
    reached: np.ndarray = np.zeros(plant.state.size, dtype=bool)
    reached[plant.state.elements.index(coordinate)] = True
    for order in range(1, plant.state.size + 1):
        if bool((reached & on_input).any()):
            return order
        reached = np.asarray(on_state[reached].any(axis=0))
    return None
