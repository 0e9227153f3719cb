"""Whether everything that an estimator needs is measured or believed, and no belief stands without need.

The outputs of a plant that controllers follow are measured or estimated, never believed: an output that the wrong model computes
would be followed in place of the true one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import DerivativeEstimator
from fpirhc.sensing.belief import Belief


def uncovered(
    plant: Plant,
    estimator: DerivativeEstimator,
    named: Sequence[str] | None,
    measured: tuple[str, ...],
    belief: Belief | None,
) -> Iterator[str]:
    """Yield a sentence for every mistake.

    Args:
        plant: that is measured.
        estimator: of state, or outputs, and response.
        named: names of the measured quantities where a user names them.
        measured: names of all measured quantities.
        belief: how other states are believed.
    """
    missing = [n for n in estimator.measures(plant.face) if n not in measured]
    if named is not None and not measured:
        yield "measured: name at least one quantity; Sensing() without it measures all that the estimator needs"
    elif belief is not None and named is None and not plant.outputs:
        yield (
            f"belief: everything that {type(estimator).__name__} needs is measured; name what sensors show: "
            f"Sensing(measured={list(measured)!r}, ...)"
        )
    elif belief is None and missing:
        yield (
            f"measured: {type(estimator).__name__} also needs {', '.join(missing)}; measure it, or state how it is "
            "believed: Sensing(measured=..., belief=ModelStates())"
        )
    if plant.outputs:
        yield from _of_outputs(plant, estimator, missing, measured, believes=belief is not None)


def _of_outputs(
    plant: Plant, estimator: DerivativeEstimator, missing: list[str], measured: tuple[str, ...], *, believes: bool
) -> Iterator[str]:
    followed = [n for n in missing if n.rstrip("'") in plant.controlled_names]
    if believes and followed:
        yield (
            f"measured: {type(estimator).__name__} needs {', '.join(followed)}, and outputs that are controlled are measured or "
            "estimated, never believed; measure it, or choose an estimator of what is measured, such as PositionDifference()"
        )
    states = [n for n in measured if n not in plant.output.elements and n in plant.state.elements]
    if not believes and states:
        yield (
            f"measured: {', '.join(states)} is given as it is to controllers of a plant with outputs, unless a belief is stated: "
            "leave it out, or add Sensing(..., belief=KalmanFilter(...))"
        )
