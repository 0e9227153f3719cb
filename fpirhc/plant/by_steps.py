"""A plant that is given by its steps: x+ = f(x, u, p), y = h(x, p)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from fpirhc.plant.algebraic import Algebraic
from fpirhc.plant.maps import Differences
from fpirhc.plant.outputs import Output
from fpirhc.plant.parameter import Parameter
from fpirhc.symbolic.layout import Expression

if TYPE_CHECKING:
    from fpirhc.plant.plant import Plant


def of_map(
    cls: type[Plant],
    *,
    states: Mapping[str, str],
    inputs: Mapping[str, str],
    parameters: Mapping[str, Parameter],
    next: Callable[..., Mapping[str, Expression]],
    step: float,
    outputs: Mapping[str, Output] | None = None,
    controlled: Sequence[str] | None = None,
    ranges: Mapping[str, tuple[float, float]] | None = None,
    algebraic: Algebraic | None = None,
    time_unit: str = "s",
) -> Plant:
    """Return the map x+ = f(x, u, p), y = h(x, p), which steps and has no differential equation.

        plant = Plant.of_map(states={"stock": "t"}, inputs={"catch": "t/year"}, parameters={...}, next=grown, step=1.0, ...)

    A response is a divided difference, (y_{k+1} - y_k) / T for an output that an input reaches in one control cycle of T; see
    `fpirhc.plant.maps`. `Problem` takes no integrator for a map, and its period is a whole number of steps.

    Args:
        states: name -> unit of every state.
        inputs: name -> unit of every input.
        parameters: name -> Parameter(approximate, exact, unit), or outside(nominal, unit).
        next: function of (x, u, p) that returns {state: its value one step later}.
        step: time from one state to the next.
        outputs: name -> Output(unit, function of (x, p)); None: the states follow a reference.
        controlled: outputs, or states, on which a tracking law and a deformation act, as many as there are inputs; None: all.
        ranges: physical range (lowest, highest) of states by name.
        algebraic: quantities that equations tie to the state in every step; see `Plant`.
        time_unit: unit of time of the step.

    Raises:
        InvalidProblem: all mistakes together.
    """
    return cls(
        coordinates=states,
        inputs=inputs,
        parameters=parameters,
        response=Differences(next, tuple(states), step),
        order=1,
        controlled=controlled,
        ranges=ranges or {},
        outputs=outputs or {},
        algebraic=algebraic,
        time_unit=time_unit,
        step=step,
        next=next,
    )
