"""One output of a plant: a quantity that is controlled or judged, as an expression of the state, or of the inputs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from fpirhc.fields.checked import Checked
from fpirhc.symbolic.layout import Expression


@dataclass(frozen=True, eq=False)
class Output(Checked):
    """One output of a plant: y = h(q, q', ..., p), or h(x, p) of a plant that is given by its states.

    Args:
        unit: of the output.
        expression: function of the arguments of the response, with or without the inputs; it returns one scalar.
        response_disturbance: name of a parameter that a model believes to add to the response y^(r) and to nothing else, as
            estimators of disturbances do; empty: none. The inverse has it in every cycle. A plan is made without it, as if the
            response were the model's, which is how a plan is made behind a deformation.
    """

    unit: str
    expression: Callable[..., Expression]
    response_disturbance: str = field(default="", kw_only=True, metadata={"setting": False})
