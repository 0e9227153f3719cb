"""The metrics that a baseline may hold, and how each is compared. There are three classes:

    exact   counts, statuses, sizes: equal or changed
    tight   optimal costs of open-loop plans: equal to 1e-6
    banded  what a closed loop achieved: inside a band that `bands` computes

A class is the least that is asked for: `bands` widens it where the variants disagree.
"""

from __future__ import annotations

from dataclasses import dataclass

from fpirhc.errors import InvalidName, nearest

EXACT, TIGHT, BANDED = "exact", "tight", "banded"
KINDS = (EXACT, TIGHT, BANDED)


@dataclass(frozen=True)
class Family:
    """How all metrics 'family.element' are compared.

    kind: the class, where the spread does not say otherwise. smaller_is_better: whether leaving the band downwards is an
    improvement. finite: whether a finished run must have it. floor: differences of this size mean nothing, in its unit.
    """

    kind: str
    smaller_is_better: bool = False
    finite: bool = False
    floor: float = 1e-12


FAMILIES = {
    "rms_error": Family(BANDED, smaller_is_better=True, finite=True),
    "max_error": Family(BANDED, smaller_is_better=True, finite=True),
    "iae": Family(BANDED, smaller_is_better=True, finite=True),
    "settling": Family(BANDED, smaller_is_better=True),
    "effort": Family(BANDED, finite=True),
    "clipped_share": Family(BANDED, finite=True),
    "cost": Family(BANDED, smaller_is_better=True, finite=True),
    "solve": Family(BANDED, smaller_is_better=True, finite=True),
    "plans": Family(EXACT, finite=True),
    "cycles": Family(EXACT, finite=True),
    "status": Family(EXACT, finite=True),
    # A difference of 1e-4 in a contraction factor means nothing: it is a fit, or a difference of eigenvalues from one.
    "contraction": Family(BANDED, smaller_is_better=True, floor=1e-4),
    "plan.cost": Family(TIGHT, finite=True),
    "plan.stages": Family(EXACT, finite=True),
    "plan.iterations": Family(EXACT),
    "plan.status": Family(EXACT, finite=True),
    "plan.factor": Family(BANDED, smaller_is_better=True, floor=1e-4),
}


def family_of(metric: str) -> Family:
    """Return the family of a metric.

    Raises:
        InvalidName: a metric that fpirhc does not know, with the nearest that it does.
    """
    first = metric.partition(".")[0]
    name = metric if first == "plan" else first
    if name not in FAMILIES:
        raise InvalidName(f"metric '{metric}' is unknown.{nearest(name, FAMILIES)}")
    return FAMILIES[name]
