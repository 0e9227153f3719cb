"""Which gains converge, how fast, and whether a deformation's own gain does: |1 - a lambda| < 1 for every eigenvalue lambda."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fpirhc.contraction.spectrum import Array, Spectrum
from fpirhc.deformation.base import Deformation
from fpirhc.errors import NotContractive
from fpirhc.summary import line, number, table


def predicted_factor(eigenvalues: Array, effective_gain: float) -> float:
    """Return max|1 - a lambda|, the factor by which an error of the request shrinks per cycle (grows, above 1)."""
    return float(np.abs(1 - effective_gain * np.asarray(eigenvalues)).max())


def linear_limit(eigenvalues: Array) -> tuple[float, float]:
    """Return the open interval of effective gains with |1 - a lambda| < 1 for every eigenvalue.

    One end is 0, the other is min 2 Re(lambda) / |lambda|^2, with a minus sign where all real parts are negative.

    Raises:
        NotContractive: eigenvalues with real parts of both signs, or zero.
    """
    spectrum = Spectrum(eigenvalues)
    _require_one_sign(spectrum)
    flat = spectrum.eigenvalues.ravel()
    outer = float((2 * np.abs(flat.real) / np.abs(flat) ** 2).min())
    return (0.0, outer) if spectrum.smallest_real > 0 else (-outer, 0.0)


def sector_limit(deformation: Deformation, eigenvalues: Array) -> tuple[float, float]:
    """Return the interval of effective gains whose steepest secant is also within the linear limit.

    Within it the iteration on a linear plant converges from errors of any size, because every step is the step of some linear map
    that contracts. Outside it large errors may end in a bounded two-cycle.

    Raises:
        NotContractive: eigenvalues with real parts of both signs, or zero.
    """
    lower, upper = linear_limit(eigenvalues)
    if deformation.effective_gain() == 0:
        return lower, upper
    right = deformation.with_effective_gain(0.5 * (lower + upper))  # the secant depends on the gain's sign
    steeper = right.secant_gain() / right.effective_gain()
    return lower / steeper, upper / steeper


def _require_one_sign(spectrum: Spectrum) -> None:
    """Check that some gain converges.

    Raises:
        NotContractive: eigenvalues with real parts of both signs, or zero.
    """
    if not spectrum.one_sign:
        raise NotContractive(
            "the response Jacobian has eigenvalues with real parts of both signs or zero (from "
            f"{spectrum.smallest_real:.4g} to {spectrum.largest_real:.4g}), so no gain makes the iteration converge: "
            "it enlarges the error in some direction. Check that each input acts on its own coordinate and that the "
            "approximate parameters give the effect of every input its true sign"
        )


@dataclass(frozen=True)
class ContractionReport:
    """Whether a deformation converges on plants with a given spectrum, and which gains do.

    Within the sector limit errors of any size converge. Between the two limits only small errors converge, and a large one may end
    in a bounded oscillation. Where no gain converges the limits are empty. These are limits of the map on a plant; those of the
    whole loop, and a recommended gain, are answers of a review.

    Args:
        predicted: max|1 - a lambda|, the factor of an error of the request per cycle.
        effective_gain: a of the deformation.
        gain_name: name of the gain that the user sets, the deformation's own gain.
        linear_limit: interval of the effective gain in which small errors converge.
        sector_limit: interval of the effective gain in which errors of any size converge.
        own_linear_limit: the linear limit in the deformation's own gain.
        own_sector_limit: the sector limit in the deformation's own gain.
        contractive: whether the effective gain is within the linear limit.
        within_sector: whether the effective gain is within the sector limit.
        text: the verdict and the admissible gains, for a reader.
    """

    predicted: float
    effective_gain: float
    gain_name: str
    linear_limit: tuple[float, float]
    sector_limit: tuple[float, float]
    own_linear_limit: tuple[float, float]
    own_sector_limit: tuple[float, float]
    contractive: bool
    within_sector: bool
    text: str

    def __repr__(self) -> str:
        return line(self, *(f"{name} {value}" for name, value in self._facts()))

    def _repr_html_(self) -> str:
        """Factor and limits as a table, for notebooks."""
        return table("Contraction", ("", "value"), self._facts(), [self.text])

    def _facts(self) -> list[tuple[str, str]]:
        """Verdict, factor and limits, by name; the limits in the deformation's own gain."""
        linear, sector = (f"({a:.4g}, {b:.4g})" for a, b in (self.own_linear_limit, self.own_sector_limit))
        return [
            ("contractive", "yes" if self.contractive else "no"),
            ("within the sector limit", "yes" if self.within_sector else "no"),
            ("predicted factor", number(self.predicted)),
            (f"linear limit of {self.gain_name}", linear),
            (f"sector limit of {self.gain_name}", sector),
        ]


def check_gain(deformation: Deformation, spectrum: Spectrum) -> ContractionReport:
    """Return the report of a deformation that converges on plants with these eigenvalues.

    A gain between the sector and the linear limit is not refused: `within_sector` is False in its report.

    Raises:
        NotContractive: eigenvalues with real parts of both signs, or a gain that is zero, of the wrong sign, or beyond the linear
            limit; the message names the admissible gains.
    """
    report = assess_gain(deformation, spectrum)
    if not report.contractive:
        raise NotContractive(report.text)
    return report


def assess_gain(deformation: Deformation, spectrum: Spectrum) -> ContractionReport:
    """Return the report of `check_gain`; where `check_gain` raises, a report with `contractive` False and the same text."""
    gain = deformation.effective_gain()
    name, own = _own_gain(deformation)
    predicted = predicted_factor(spectrum.eigenvalues, gain)
    try:
        linear = linear_limit(spectrum.eigenvalues)
    except NotContractive as error:
        return _hopeless(predicted, gain, name, str(error))
    if gain == 0:
        text = f"{deformation} does not iterate, so nothing contracts; use Sigmoid(gain=...)"
        return _hopeless(predicted, gain, name, text)
    sector = sector_limit(deformation, spectrum.eigenvalues)
    own_linear, own_sector = (_scaled(limit, own / gain) for limit in (linear, sector))
    contractive, within = linear[0] < gain < linear[1], sector[0] < gain < sector[1]
    admissible = _admissible(name, own_linear, own_sector)
    what = f"{type(deformation).__name__}({name}={own:.4g})"
    verdict = _verdict(what, predicted, within, admissible) if contractive else ""
    return ContractionReport(
        predicted=predicted,
        effective_gain=gain,
        gain_name=name,
        linear_limit=linear,
        sector_limit=sector,
        own_linear_limit=own_linear,
        own_sector_limit=own_sector,
        contractive=contractive,
        within_sector=within,
        text=verdict or f"{what} {_fault(gain, linear, predicted)}; use {admissible}",
    )


def _hopeless(predicted: float, gain: float, name: str, text: str) -> ContractionReport:
    none = (0.0, 0.0)
    return ContractionReport(predicted, gain, name, none, none, none, none, False, False, text)


def _fault(gain: float, linear: tuple[float, float], predicted: float) -> str:
    if gain * sum(linear) < 0:
        return "has the wrong sign, so every cycle enlarges the error"
    return f"is too large: errors grow by the factor {predicted:.3g} per cycle"


def _own_gain(deformation: Deformation) -> tuple[str, float]:
    """The gain that the user sets, by name; the effective gain for a map that has none."""
    own = getattr(deformation, deformation.gain_name, None)
    return ("effective gain", deformation.effective_gain()) if own is None else (deformation.gain_name, float(own))


def _scaled(limit: tuple[float, float], factor: float) -> tuple[float, float]:
    ends = sorted(end * factor + 0.0 for end in limit)
    return ends[0], ends[1]


def _size(limit: tuple[float, float]) -> float:
    return max(abs(limit[0]), abs(limit[1]))


def _admissible(name: str, linear: tuple[float, float], sector: tuple[float, float]) -> str:
    sign = "positive" if sum(linear) > 0 else "negative"
    bounds = f"{_size(linear):.3g} (linear limit: small errors converge)"
    if not np.isclose(_size(linear), _size(sector)):
        bounds += f" and < {_size(sector):.3g} (sector limit: by itself it converges from errors of any size)"
    return f"a {sign} {name}, 0 < |{name}| < {bounds}"


def _verdict(what: str, predicted: float, within: bool, admissible: str) -> str:
    text = f"{what} shrinks an error of the request at least to {predicted:.3g} of it per cycle"
    if not within:
        text += (
            ", but only a small one: it is beyond the sector limit, where large errors may end in a bounded oscillation"
        )
    return f"{text}. Admissible: {admissible}."
