"""What a comparison knows of one controller: its run, what was measured of it, and what was predicted."""

from __future__ import annotations

from dataclasses import dataclass

from fpirhc.contraction.gains import ContractionReport
from fpirhc.contraction.spectrum import Spectrum
from fpirhc.review.response_prediction import Prediction
from fpirhc.simulation.lyapunov_view import LyapunovView
from fpirhc.simulation.metrics import Metrics
from fpirhc.simulation.run import Run
from fpirhc.studies.comparison.information import Information
from fpirhc.studies.comparison.optimality import Optimality
from fpirhc.studies.comparison.timing import CycleTime, Price


@dataclass(frozen=True, eq=False)
class Contraction:
    """Contraction of one adaptive controller.

    Args:
        predicted: largest factor predicted from the symbols along the measured cycles.
        growing: share of these cycles in which it is 1 or more.
        measured: factor measured from the run.
        report: admissible and recommended gains.
        spectrum: eigenvalues of the response Jacobian along the run.
    """

    predicted: float
    growing: float
    measured: float
    report: ContractionReport
    spectrum: Spectrum


@dataclass(frozen=True, eq=False)
class Entry:
    """One controller of a comparison.

    Args:
        name: name of the controller.
        run: its run.
        metrics: metrics of the run.
        cycle: time of a control cycle; None for a run that is too short.
        adaptive: whether the controller adapts.
        pair: name of the same controller without adaptation, if there is one.
        contraction: contraction of the iteration, if the controller adapts.
        optimality: excess cost of its plans, if it plans.
        notes: sentences for the report.
        lyapunov: Lyapunov function along the run, if one is known.
        prediction: prediction of the response, for the adaptive controller of the headline.
        weighed: judged coordinates that its cost weighs; None: all.
        exact: whether its model is exact where the others' is not, so that it should be a bound.
        learns: whether its model or its gains change during a run.
        fixed: name of the same controller with a model that does not change, for one that learns, if there is one.
        plan_every: cycles from plan to plan; 1 for a controller that does not plan.
        price: its time per cycle beside that of its pair.
        no_bound: why it is no bound, for an exact model that an adapted controller beats.
        information: what it measures and when it acts; None: not asked.
        automatic: settings of its deformation that were chosen automatically.
        reviewed_gain: what a review says of a gain that is too large or too small; empty where it is neither, or was not asked.
        not_reached: what a review says of wrong parameters that adaptation does not correct; empty likewise.
    """

    name: str
    run: Run
    metrics: Metrics
    cycle: CycleTime | None
    adaptive: bool
    pair: str | None
    contraction: Contraction | None
    optimality: Optimality | None = None
    notes: tuple[str, ...] = ()
    lyapunov: LyapunovView | None = None
    prediction: Prediction | None = None
    weighed: frozenset[str] | None = None
    exact: bool = False
    learns: bool = False
    fixed: str | None = None
    plan_every: int = 1
    price: Price | None = None
    no_bound: tuple[str, ...] = ()
    information: Information | None = None
    automatic: tuple[str, ...] = ()
    reviewed_gain: str = ""
    not_reached: str = ""
