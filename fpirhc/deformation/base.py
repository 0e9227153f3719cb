"""The contract of deformations: how the next request follows from the last request and its response error.

A controller computes a desired response d and requests r, the deformed response, from its model; the realised response of the plant
is f(r). A deformation is the fixed-point iteration r+ = G(r, f, d) with G(r, d, d) = r: where the response is the
desired one the request stays, so at the fixed point the plant does what was desired although the model is wrong. To
first order every map here is r+ = r - a (f - d) with one number a, its effective gain, or r+ = r - a W (f - d).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, Self, TypeVar, cast, final

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidName, NotSupported, require
from fpirhc.fields.checked import Checked, Inner, fact, replaced
from fpirhc.symbolic.dotted import copied
from fpirhc.symbolic.layout import Expression, Layout
from fpirhc.task.dead_time import Cycles, every

Wrapping = TypeVar("Wrapping")


@dataclass(frozen=True)
class Form:
    """With what a map compares a response, and how late it believes the response to be.

    Args:
        compares: "request": with the request that caused it; "increment": the same, and the request is the desired response and a
            deformation, which is what iterates; "model": with the model's response, which `step` is given as its request.
        cycles: dead time between a request and its response beyond the cycle that every loop has, control cycles; a tuple gives
            every channel its own.
        measurement: dead time of the measurement, cycles.
        lag: time constant of the actuators, s; a tuple gives one per input.
        weights: W by rows where the gain is a matrix, r+ = r - a W (f - d); None: the one matrix.
        steady: whether it is the same map in every cycle, and for small errors too; False for gains that change on line.
    """

    compares: Literal["request", "increment", "model"] = "request"
    cycles: Cycles = 0.0
    measurement: float = 0.0
    lag: float | tuple[float, ...] = 0.0
    weights: tuple[tuple[float, ...], ...] | None = None
    steady: bool = True

    @property
    def modelled(self) -> bool:
        """Whether it needs the model's response."""
        return self.compares == "model"

    @property
    def request(self) -> str:
        """The signal that `step` is given as its request."""
        return "_modelled" if self.modelled else "_deformed_last"

    @property
    def late(self) -> float:
        """Cycles that the response is believed to be late, the most of several."""
        return max(every(self.cycles)) + self.measurement

    @property
    def pairs(self) -> bool:
        """Whether it says itself to which request a response belongs."""
        return self.compares != "request" or bool(self.late)

    @property
    def channels(self) -> int | None:
        """Number of controlled coordinates that it is made for; None: any number."""
        rows = self.cycles if self.weights is None else self.weights
        return len(rows) if isinstance(rows, tuple) else None

    def weighted(self, jacobian: np.ndarray) -> np.ndarray:
        """Return J W for a response Jacobian J, shape (..., n, n): response errors are multiplied by I - a J W per cycle."""
        return jacobian if self.weights is None else jacobian @ np.array(self.weights)


@dataclass(frozen=True)
class RequestChange:
    """How much the desired response of a controller changes, for maps whose automatic settings depend on it."""

    change: float  # largest change in one cycle, in units of the response
    # whether the change is an occasional jump, which one step has to cover. Otherwise it goes on from cycle to cycle, and
    # the map needs room beyond it.
    sudden: bool
    # step per cycle with which the plain form comes back from the largest response error that is expected, in units of the
    # response (`fpirhc.contraction.delayed`)
    recovery: float = 0.0


class Deformation(Checked, ABC):
    """Contract: a map from (request, response, desired) to the next request, and facts about it.

    Concrete maps are frozen dataclasses. A map around another one has the facts of the inner map unless it overrides them.
    `fpirhc.conformance.check_deformation` tests that a map keeps this contract.
    """

    if TYPE_CHECKING:

        @property
        def inner(self) -> Deformation | None:
            """The map that this one is around, in whatever field it holds it; None for a map that stands alone."""

    else:
        inner = Inner()

    @final
    @fact
    def adapts(self) -> bool:
        """Whether the response changes the request at all, as its gain says."""
        return self.effective_gain() != 0

    @property
    def form(self) -> Form:
        """With what it compares a response; by default with the last request, around a map as that does."""
        return Form() if self.inner is None else self.inner.form

    def memory(self, elements: tuple[str, ...]) -> Layout:
        """What the map remembers besides the pair (request, desired); by default nothing."""
        del elements
        return Layout()

    @abstractmethod
    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        """Return the next request and what to remember, by name of the memory's signals.

        Values and derivatives of any order are finite at response = desired.

        Args:
            request: the request that caused the response, a CasADi column; the model's response where the `form` compares with it.
            response: the realised response, a column of the same size.
            desired: the response that is desired now, a column of the same size.
            memory: the signals of `memory`, by name.
        """

    @abstractmethod
    def effective_gain(self) -> float:
        """First-order step per unit of response error: r+ = r - a (response - desired) + ..., dimensionless."""

    def secant_gain(self) -> float:
        """Largest step per unit of response error at any size, with the sign of the effective gain, which it is by default."""
        return self.effective_gain() if self.inner is None else self.inner.secant_gain()

    @abstractmethod
    def with_effective_gain(self, gain: float) -> Self:
        """Return the same map with another effective gain."""


def with_inner(wrapper: Wrapping, inner: object) -> Wrapping:
    """Return a frozen dataclass with another value in the field that holds its `inner`."""
    current = getattr(wrapper, "inner", None)
    names = [name for name, value in vars(wrapper).items() if value is current]
    changed = replaced(wrapper, names[0], inner) if names and current is not None else None
    require(
        changed is not None,
        f"{type(wrapper).__name__} has no field that holds its `inner`, so the inner one cannot be replaced; hold it in a field",
    )
    return cast("Wrapping", changed)


def automatic(deformation: Deformation) -> tuple[str, ...]:
    """Names of scales that are still to be chosen, by `scaled_for`: None, with the metadata {"automatic": True}."""
    own = innermost(deformation)
    if not is_dataclass(own):
        return ()
    return tuple(f.name for f in fields(own) if f.metadata.get("automatic") and getattr(own, f.name) is None)


def scaled_for(deformation: Deformation, request: RequestChange) -> Deformation:
    """Return the map whose open scale is at least 1 and fits how much the desired response changes; a given one stays.

    The map's `largest_step` covers a sudden change. For a change that goes on from cycle to cycle the scale is twice the change. In
    both cases the largest step covers the recovery.
    """
    if deformation.inner is not None:
        return with_inner(deformation, scaled_for(deformation.inner, request))
    for name in automatic(deformation):
        step = copied(cast("Any", deformation), {name: 1.0}).largest_step()
        scale = request.change / step if request.sudden else 2 * request.change
        chosen = float(f"{max(1.0, scale, request.recovery / step):.3g}")
        deformation = replace(cast("Any", deformation), **{name: chosen})
    return deformation


def innermost(deformation: Deformation) -> Deformation:
    """The map inside all others."""
    *_, own = _chain(deformation)
    return own


def own_gain(deformation: Deformation) -> tuple[str, float]:
    """Return the gain that the user sets, by name: the number that another effective gain changes; without one the latter."""
    own, gain = innermost(deformation), deformation.effective_gain()
    other = own.with_effective_gain(-own.effective_gain()) if gain else own
    numbers = [(n, v) for n, v in vars(own).items() if isinstance(v, int | float) and v != getattr(other, n, v)]
    return (numbers[0][0], float(numbers[0][1])) if numbers else ("effective gain", gain)


def with_its_gain(deformation: Deformation) -> str:
    """Return a deformation as text, with what it is around and the gain alone: 'ModelReferenced(Affine(gain=-0.5))'."""
    *around, own = [type(one).__name__ for one in _chain(deformation)]
    name, value = own_gain(deformation)
    return f"{''.join(f'{one}(' for one in around)}{own}({name}={value:.4g}){')' * len(around)}"


def _chain(deformation: Deformation | None) -> Iterator[Deformation]:
    """Yield a deformation and those inside it, the outermost first."""
    while deformation is not None:
        yield deformation
        deformation = deformation.inner


def smooth_norm(column: Expression, floor: float) -> Expression:
    """Return sqrt(|column|^2 + floor^2): the Euclidean norm, differentiable at zero and never zero."""
    return ca.sqrt(ca.sumsqr(column) + floor * floor)


@dataclass(frozen=True)
class Wrapper(Deformation, ABC):
    """Contract: a deformation around another one.

    Args:
        map: the wrapped deformation, the first field of every wrapper.
    """

    map: Deformation

    def effective_gain(self) -> float:
        return self.map.effective_gain()

    def with_effective_gain(self, gain: float) -> Self:
        return replace(self, map=self.map.with_effective_gain(gain))


def against_wrappers(deformation: Deformation) -> Iterator[str]:
    """Yield a sentence for every wrapper that does not fit what it is around, the outermost first."""
    while deformation.inner is not None:
        name, inside = type(deformation).__name__, list(_chain(deformation.inner))
        pairing = [one for one in inside if one.form.pairs]
        if any(type(one) is type(deformation) for one in inside) and _shares_memory(deformation):
            yield f"{name} stands around another {name}; one is enough, so leave one of them out"
        elif pairing and replace(deformation.form, steady=True) != replace(deformation.inner.form, steady=True):
            yield (
                f"{name} around {type(pairing[-1]).__name__}: each of them says which request a response belongs to; use one of "
                "them around the map, and state the dead time there"
            )
        elif deformation.inner.form.modelled:
            yield (
                f"{name} around a model-referenced form changes what the form compares, the model's response with the measured "
                f"one; put it inside: ModelReferenced({name}(map, ...))"
            )
        deformation = deformation.inner


def _shares_memory(wrapper: Deformation) -> bool:
    """Whether two signals of its memory have one name, as those of wrappers of a kind have."""
    try:
        wrapper.memory(("q0",))
    except InvalidName:
        return True
    return False


def memory_of_map(wrapper: Wrapper, memory: Mapping[str, Expression], size: int) -> dict[str, Expression]:
    """Return the part of a wrapper's memory that belongs to the map; `size` is the number of coordinates."""
    own = wrapper.map.memory(tuple(f"q{k}" for k in range(size)))
    return {name: memory[name] for name in own.names}


_BEYOND = 1.01, 1e-3  # factor and amount by which the default pole exceeds the bound: at the bound nothing is damped


def chosen_pole(gain: float, cycles: Cycles, uncertainty: int | None, pole: float | None) -> float:
    """Return the pole of a leaky pairing: `pole` itself, or for None the one that follows from the gain and the uncertainty."""
    if pole is not None:
        return pole
    longest = max(every(cycles))  # a tenth of it may be wrong, at least one cycle
    usual = max(math.ceil(0.1 * longest - 1e-9), 1) if longest > 0 else 0
    return default_pole(ca.fmax(abs(gain), 1.0), usual if uncertainty is None else uncertainty)


def leaked(pole: float, before: Expression, deformation: Expression) -> Expression:
    """Return p delta_{k-1} + (1 - p) delta; delta itself without a leak."""
    return pole * before + (1 - pole) * deformation


def default_pole(product: float, uncertainty: float) -> float:
    """The least pole of the theorem for a product g of gain and plant in (0, 2), and a little more; 0 for a certain dead time.

    p = (2 c + 1 - sqrt(4 c + 1)) / (2 c) with c = g (2 + g) m^2 / 4, here without cancellation; the product may be open.
    """
    bound = product * (2 + product) * uncertainty**2 / 4
    least = 2 * bound / (2 * bound + 1 + ca.sqrt(4 * bound + 1))
    factor, amount = _BEYOND
    return ca.fmin(factor * least + amount, 0.5 * (1 + least)) if uncertainty > 0 else 0.0


@dataclass(frozen=True)
class Identity(Deformation):
    """r+ = d: the request is the desired response, whatever the response of the plant.

    It is the only map that does not iterate: its gains are zero, and it corrects no response error.
    """

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        del request, response, memory
        return desired, {}

    def effective_gain(self) -> float:
        return 0.0

    def with_effective_gain(self, gain: float) -> Self:
        """Raise, because there is no gain to change.

        Raises:
            NotSupported: always.
        """
        raise NotSupported(f"Identity() has no gain and cannot take {gain!r}; use Sigmoid(gain=...), the usual choice")


EXAMPLES = (Identity(),)
