"""A plant that is given by its states: x' = f(x, u, p), y = h(x, p)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from fpirhc.plant.algebraic import Algebraic
from fpirhc.plant.outputs import Output
from fpirhc.plant.parameter import Parameter
from fpirhc.symbolic.layout import Expression

if TYPE_CHECKING:
    from fpirhc.plant.plant import Plant


def of_states(
    cls: type[Plant],
    *,
    states: Mapping[str, str],
    inputs: Mapping[str, str],
    parameters: Mapping[str, Parameter],
    rates: Callable[..., Mapping[str, Expression]],
    outputs: Mapping[str, Output],
    controlled: Sequence[str] | None = None,
    inverse: Callable[..., Mapping[str, Expression]] | None = None,
    ranges: Mapping[str, tuple[float, float]] | None = None,
    algebraic: Algebraic | None = None,
    time_unit: str = "s",
) -> Plant:
    """Return the plant x' = f(x, u, p), y = h(x, p): every state is a coordinate of order one, and the outputs have references.

    Args:
        states: name -> unit of every state.
        inputs: name -> unit of every input.
        parameters: name -> Parameter(approximate, exact, unit).
        rates: function of (x, u, p) that returns {state: its derivative with respect to time}.
        outputs: name -> Output(unit, function of (x, p)).
        controlled: outputs on which a tracking law and a deformation act, as many as there are inputs; None: all.
        inverse: optional function of (x, r, p) that returns {input: command} for wanted highest derivatives r of the controlled
            outputs; see `Plant`.
        ranges: physical range (lowest, highest) of states by name.
        algebraic: quantities that equations tie to the state at every instant; see `Plant`.
        time_unit: unit of time of the equations.

    Raises:
        InvalidProblem: all mistakes together.
    """
    return cls(
        coordinates=states,
        inputs=inputs,
        parameters=parameters,
        response=rates,
        order=1,
        controlled=controlled,
        inverse=inverse,
        ranges=ranges or {},
        outputs=outputs,
        algebraic=algebraic,
        time_unit=time_unit,
    )
