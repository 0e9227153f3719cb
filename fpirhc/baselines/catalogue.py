"""The numbers of a baseline, and how each is compared. There are three classes:

    exact   counts, statuses, sizes: equal or changed
    tight   optimal costs of open-loop plans: equal to 1e-6
    banded  results of a closed loop: inside a band that `bands` computes

`bands` widens a class where the variants disagree. Metrics of a run have their class in their own definition; the classes of the
first horizon's open-loop plan stand here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from fpirhc.errors import InvalidName, nearest
from fpirhc.simulation.metrics import Metric, known_metrics
from fpirhc.simulation.metrics.base import Better

EXACT, TIGHT, BANDED, NOT_COMPARED = "exact", "tight", "banded", "not"
KINDS = (EXACT, TIGHT, BANDED)


@dataclass(frozen=True)
class Family:
    """The comparison of all numbers 'family.element'.

    Args:
        kind: the class, unless the spread makes it wider.
        better: direction in which leaving the band is an improvement.
        finite: whether a finished run must have the number.
        floor: difference that counts as none, in the unit of the number.
        step: see `Metric`.
    """

    kind: str
    better: Better = "neither"
    finite: bool = False
    floor: float = 1e-12
    step: Callable[[float, int], float] | None = None


PLANS = {
    "plan.cost": Family(TIGHT, finite=True),
    "plan.stages": Family(EXACT, finite=True),
    "plan.iterations": Family(EXACT),
    "plan.status": Family(EXACT, finite=True),
    # A difference of eigenvalues from one.
    "plan.factor": Family(BANDED, better="smaller", floor=1e-4),
}


def family_of(key: str, metrics: Sequence[Metric] | None = None) -> Family:
    """Return how a number is compared.

    Args:
        key: name of the number, 'family.element'.
        metrics: metrics of the problem's runs; None: the shipped and the installed ones.

    Raises:
        InvalidName: neither fpirhc nor the problem has such a metric.
    """
    if key in PLANS:
        return PLANS[key]
    entries = {m.name: m for m in (known_metrics() if metrics is None else metrics)}
    name = key
    while name not in entries and "." in name:  # an element may have dots of its own
        name = name.rpartition(".")[0]
    if name not in entries:
        raise InvalidName(f"metric '{key}' is unknown.{nearest(name, [*entries, *PLANS])}")
    metric = entries[name]
    return Family(metric.compared, metric.better, metric.finite, metric.floor, metric.step)
