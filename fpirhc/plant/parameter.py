"""Parameters of a plant, each with an approximate and an exact value."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from fpirhc.errors import Mistakes
from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import finite_number
from fpirhc.plant.spread import Spread


@dataclass(frozen=True)
class Parameter(Checked):
    """One parameter of a plant.

    Args:
        approximate: value in the controller's model.
        exact: value in the simulated plant.
        unit: of both values.
        bounds: least and largest physically possible value, in the same unit.
        spread: distribution of the exact value in scenarios, and its range in reviews; None: a percentage of the exact value. A run
            does not depend on it.
        outside: whether it is a signal from outside, whose values over time are those of the problem; see `outside`.
    """

    approximate: float
    exact: float
    unit: str
    bounds: tuple[float, float] = (-math.inf, math.inf)
    spread: Spread | None = field(default=None, metadata={"setting": False})
    outside: bool = field(default=False, kw_only=True, metadata={"setting": "where given"})


def outside(nominal: float, unit: str, bounds: tuple[float, float] = (-math.inf, math.inf)) -> Parameter:
    """Return a signal from outside, which is declared among the parameters of a plant.

    The response reads it as any other: `p.ambient` where `parameters={"ambient": outside(nominal=293.0, unit="K")}`.
    `Problem(signals=...)` says how it changes over time.

    Args:
        nominal: value at which the plant is reviewed, and which the model has where it is told nothing.
        unit: of the signal.
        bounds: least and largest physically possible value.
    """
    return Parameter(nominal, nominal, unit, bounds, outside=True)


def check_parameters(parameters: Mapping[str, Parameter], mistakes: Mistakes) -> None:
    """Add every mistake of the parameters to `mistakes`."""
    for name, parameter in parameters.items():
        if not isinstance(parameter, Parameter):
            mistakes.add(f"parameter '{name}' must be Parameter(approximate=..., exact=..., unit=...)")
            continue
        numbers = True
        for which in ("approximate", "exact"):
            value = getattr(parameter, which)
            if not finite_number(value):
                mistakes.add(f"parameter '{name}': {which} must be a finite number, got {value!r}")
                numbers = False
        mistake = (_bounds_mistake(parameter) or _spread_mistake(parameter)) if numbers else ""
        if mistake:
            mistakes.add(f"parameter '{name}': {mistake}")
        if not isinstance(parameter.unit, str) or not parameter.unit:
            mistakes.add(f"parameter '{name}' has no unit; write unit='kg' (or '1' for none)")


def with_exact_values(parameters: Mapping[str, Parameter], exact: Iterable[float]) -> dict[str, Parameter]:
    """Return the parameters with other exact values, in their order.

    Raises:
        InvalidProblem: a value that is not finite or outside its bounds.
    """
    # A spread is around the value of the problem file, and not around another plant's.
    others = {
        name: replace(one, exact=float(value), spread=None)
        for (name, one), value in zip(parameters.items(), exact, strict=True)
    }
    mistakes = Mistakes("plant")
    check_parameters(others, mistakes)
    mistakes.raise_if_any()
    return others


def _bounds_mistake(parameter: Parameter) -> str:
    try:
        low, high = map(float, parameter.bounds)
    except (TypeError, ValueError):
        return f"bounds must be a pair of numbers (lowest, highest), got {parameter.bounds!r}"
    if not low < high:
        return f"bounds must be (lowest, highest), got {parameter.bounds!r}"
    outside = [w for w in ("approximate", "exact") if not low <= getattr(parameter, w) <= high]
    return f"{outside[0]} is outside its bounds {parameter.bounds!r}" if outside else ""


def _spread_mistake(parameter: Parameter) -> str:
    spread = parameter.spread
    if spread is None:
        return ""
    if not isinstance(spread, Spread):
        return f"spread must be Uniform(...), Normal(...) or LogNormal(...), got {spread!r}"
    mistake = spread.mistake(float(parameter.exact))
    return f"spread: it {mistake}" if mistake else ""
