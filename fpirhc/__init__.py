"""Adaptive receding-horizon control by fixed-point iteration, on CasADi.

Public names are imported when first used, so that `fpirhc --help` need not load CasADi.
"""

from importlib import import_module
from importlib.metadata import version as _version
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fpirhc.controllers.computed_torque import ComputedTorque
    from fpirhc.controllers.informed import Informed
    from fpirhc.controllers.nominal import OpenPlan, Restart, RestartAndTrack
    from fpirhc.controllers.on_failure import Feedforward, HoldPlan, StopRun
    from fpirhc.controllers.receding_horizon import RecedingHorizon
    from fpirhc.plant import Parameter, Plant

__version__ = _version("fpirhc")

_HOMES = {
    "fpirhc.plant": ("Plant", "Parameter", "structural_order"),
    "fpirhc.reference": ("Trajectory", "Table"),
    "fpirhc.limits": ("Limits",),
    "fpirhc.disturbance": ("Step", "Pulse", "Sine", "Noise", "Formula"),
    "fpirhc.integrate": ("RungeKutta4", "Euler", "Cvodes"),
    "fpirhc.problem": ("Problem",),
    "fpirhc.symbolic.functions": ("signed_power",),
    "fpirhc.deformation.identity": ("Identity",),
    "fpirhc.deformation.rfpt": ("Rfpt",),
    "fpirhc.deformation.rfpt_vector": ("RfptVector",),
    "fpirhc.deformation.sigmoid": ("Sigmoid",),
    "fpirhc.deformation.rotation": ("Rotation",),
    "fpirhc.deformation.affine": ("Affine",),
    "fpirhc.tracking.exponential": ("Exponential",),
    "fpirhc.horizon.problem": ("Horizon",),
    "fpirhc.horizon.cost": ("Quadratic", "General", "LqrTerminal"),
    "fpirhc.optimisers.reduced_gradient": ("ReducedGradient",),
    "fpirhc.optimisers.nlp": ("InteriorPoint", "Fatrop", "SequentialQuadratic", "Osqp", "Qrqp"),
    "fpirhc.optimisers.plan": ("Plan", "solve"),
    "fpirhc.controllers.computed_torque": ("ComputedTorque",),
    "fpirhc.controllers.receding_horizon": ("RecedingHorizon",),
    "fpirhc.controllers.nominal": ("Restart", "RestartAndTrack", "OpenPlan"),
    "fpirhc.controllers.on_failure": ("HoldPlan", "Feedforward", "StopRun"),
    "fpirhc.controllers.informed": ("Informed",),
    "fpirhc.contraction": ("assess_gain", "check_gain", "response_jacobian", "spectrum_over_box", "spectrum_over_run"),
    "fpirhc.testing": ("check_deformation",),
    "fpirhc.simulation": ("simulate",),
    "fpirhc.stepper": ("Stepper",),
    "fpirhc.run": ("Run", "load_run"),
    "fpirhc.metrics": ("Metrics", "measure"),
    "fpirhc.status": ("Status",),
    "fpirhc.errors": ("FpirhcError",),
    "fpirhc.studies.problem_file": ("load_problem",),
    "fpirhc.studies.compare": ("compare", "Comparison"),
    "fpirhc.report.html": ("write_report",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}
__all__ = [*_HOME_OF, "__version__"]


def __getattr__(name: str) -> object:
    if name not in _HOME_OF:
        from fpirhc.errors import InvalidName, nearest

        raise InvalidName(f"fpirhc has no name '{name}'.{nearest(name, _HOME_OF)}")
    return getattr(import_module(_HOME_OF[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
