"""The public names; `__init__.py` imports each when it is first used."""

from .contraction import assess_gain, check_gain, response_jacobian, spectrum_over_box, spectrum_over_run
from .controllers.computed_torque import ComputedTorque
from .controllers.floquet import Floquet, floquet_radius
from .controllers.informed import Informed
from .controllers.nominal import OpenPlan, Restart, RestartAndTrack
from .controllers.on_failure import Feedforward, HoldPlan, StopRun
from .controllers.predicted import ByDesired, ByModel, Predicted
from .controllers.receding_horizon import RecedingHorizon
from .controllers.schedules import ByError, ByLookAhead, FixedSchedule, Periodic
from .controllers.slot import Slot
from .controllers.slotted import Slotted
from .dead_time import DeadTime
from .deformation.affine import Affine
from .deformation.blended import Blended
from .deformation.damped import Damped
from .deformation.delayed import Increment, Paired
from .deformation.guarded import Guarded
from .deformation.identity import Identity
from .deformation.rfpt import Rfpt
from .deformation.rfpt_vector import RfptVector
from .deformation.rotation import Rotation
from .deformation.self_paired import DelayWatched, SelfPaired
from .deformation.sigmoid import Sigmoid
from .deformation.tuned import Tuned
from .disturbance import Formula, Noise, Pulse, Sine, Step
from .errors import FpirhcError
from .horizon.cost import General, LqrTerminal, Quadratic
from .horizon.expansion import ExactHessian, GaussNewton
from .horizon.problem import Horizon
from .integrate import Cvodes, Euler, RungeKutta4
from .limits import Limits, Path
from .metrics import Metrics, measure
from .optimisers.anderson import Anderson
from .optimisers.certificate import Certificate, certify
from .optimisers.fixed_point import FixedPoint
from .optimisers.full_space import FullSpaceFixedPoint
from .optimisers.gradient_fixed_point import GradientFixedPoint
from .optimisers.nlp import Fatrop, InteriorPoint, Osqp, Qrqp, SequentialQuadratic
from .optimisers.plan import Plan, solve
from .optimisers.reduced_gradient import ReducedGradient
from .plant import Parameter, Plant, structural_order
from .problem import Problem
from .reference import Table, Trajectory
from .relative_order import OutputChain, output_chain
from .report.html import write_report
from .run import Run, load_run
from .simulation import simulate
from .status import Status
from .stepper import Stepper
from .studies.compare import Comparison, compare
from .studies.problem_file import load_problem
from .studies.scenario_study import ScenarioComparison, compare_scenarios
from .studies.settings import with_settings
from .studies.spans import LogSpan, Span
from .studies.tune import Tuning, tune
from .symbolic.functions import signed_power
from .testing import check_deformation
from .tracking.exponential import Exponential
from .tracking.fractional import Fractional

__all__ = [
    "Affine",
    "Anderson",
    "Blended",
    "ByDesired",
    "ByError",
    "ByLookAhead",
    "ByModel",
    "Certificate",
    "Comparison",
    "ComputedTorque",
    "Cvodes",
    "Damped",
    "DeadTime",
    "DelayWatched",
    "Euler",
    "ExactHessian",
    "Exponential",
    "Fatrop",
    "Feedforward",
    "FixedPoint",
    "FixedSchedule",
    "Floquet",
    "Formula",
    "FpirhcError",
    "Fractional",
    "FullSpaceFixedPoint",
    "GaussNewton",
    "General",
    "GradientFixedPoint",
    "Guarded",
    "HoldPlan",
    "Horizon",
    "Identity",
    "Increment",
    "Informed",
    "InteriorPoint",
    "Limits",
    "LogSpan",
    "LqrTerminal",
    "Metrics",
    "Noise",
    "OpenPlan",
    "Osqp",
    "OutputChain",
    "Paired",
    "Parameter",
    "Path",
    "Periodic",
    "Plan",
    "Plant",
    "Predicted",
    "Problem",
    "Pulse",
    "Qrqp",
    "Quadratic",
    "RecedingHorizon",
    "ReducedGradient",
    "Restart",
    "RestartAndTrack",
    "Rfpt",
    "RfptVector",
    "Rotation",
    "Run",
    "RungeKutta4",
    "ScenarioComparison",
    "SelfPaired",
    "SequentialQuadratic",
    "Sigmoid",
    "Sine",
    "Slot",
    "Slotted",
    "Span",
    "Status",
    "Step",
    "Stepper",
    "StopRun",
    "Table",
    "Trajectory",
    "Tuned",
    "Tuning",
    "assess_gain",
    "certify",
    "check_deformation",
    "check_gain",
    "compare",
    "compare_scenarios",
    "floquet_radius",
    "load_problem",
    "load_run",
    "measure",
    "output_chain",
    "response_jacobian",
    "signed_power",
    "simulate",
    "solve",
    "spectrum_over_box",
    "spectrum_over_run",
    "structural_order",
    "tune",
    "with_settings",
    "write_report",
]

__version__: str
