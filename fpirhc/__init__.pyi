"""The public names; `__init__.py` imports each when it is first used."""

from .baselines.baseline import check
from .certificate.limits import certify_limits
from .controllers import rivals
from .controllers.computed_torque import ComputedTorque, FeedforwardOnly
from .controllers.receding_horizon import RecedingHorizon
from .controllers.replanning import FromMeasurement, FromPlan
from .controllers.rivals.pid import PID
from .controllers.slots.schedules import Periodic
from .controllers.slots.slot import Slot
from .controllers.slots.slotted import Slotted
from .controllers.wrappers.cascade import Cascade, ThroughModel
from .controllers.wrappers.estimating import Estimating
from .controllers.wrappers.exact_model import ExactModel
from .controllers.wrappers.predicted import ByDesired, ByModel, Predicted
from .deformation.affine import Affine
from .deformation.base import Identity
from .deformation.model_referenced import ModelReferenced
from .deformation.rfpt import RFPT, RFPTVector
from .deformation.rotation import Rotation
from .deformation.sigmoid import Sigmoid
from .deformation.wrappers.delayed import Increment, Paired
from .deformation.wrappers.filtered import Filtered
from .deformation.wrappers.haar import Haar
from .deformation.wrappers.tuned import Tuned
from .errors import FpirhcError, HarmfulAdaptation
from .horizon.cost import CustomCost, LQRTerminal, Quadratic
from .horizon.hessian_models import ExactHessian, GaussNewton
from .horizon.horizon import Horizon
from .learning.estimators.base import Uncertain
from .learning.estimators.disturbance_kalman import DisturbanceKalman
from .learning.estimators.recursive_least_squares import RecursiveLeastSquares
from .learning.rules.lyapunov_rule import LyapunovRule
from .learning.rules.projection import Projection
from .optimisers.fixed_point import FixedPoint
from .optimisers.full_space import FullSpaceFixedPoint
from .optimisers.gradient_fixed_point import GradientFixedPoint
from .optimisers.nlp import Fatrop, Ipopt, SequentialQuadratic
from .optimisers.plan import Plan, solve
from .optimisers.reduced_gradient import ReducedGradient
from .plant.integrators import Collocation, Cvodes, Euler, RungeKutta4
from .plant.motion import Output
from .plant.parameter import LogNormal, Normal, Spread, Uniform, outside
from .plant.plant import Parameter, Plant
from .probing.probe import probe
from .problem_files.problem_file import load_problem
from .problem_files.settings import LogSpan, Span, with_settings
from .report.html import write_report
from .review.review import Answer, review
from .sensing import (
    LowPassDifference,
    Measured,
    PositionDifference,
    SavitzkyGolay,
    Sensing,
    Sensor,
    StepDifference,
    VelocityDifference,
)
from .sensing.observers.kalman_filter import KalmanFilter
from .simulation.machine import RunMonitor
from .simulation.metrics import Metric, figures, measure
from .simulation.pictures.base import Quantity
from .simulation.pictures.heat_map import HeatMap
from .simulation.pictures.lines import OverTime, Portrait, Raster
from .simulation.pictures.planar import Planar, Shape
from .simulation.run import Run, load_run
from .simulation.simulate import simulate, simulator
from .simulation.stepper import Stepper
from .status import Status
from .studies.comparison.compare import compare
from .studies.limits import limits
from .studies.open_loop import certify
from .studies.study import study
from .studies.tune import tune
from .symbolic.layout import Layout
from .symbolic.live import signed_power
from .task.cases import Cases
from .task.dead_time import DeadTime
from .task.disturbance import ColouredNoise, Formula, Noise, Pulse, Sine, Step
from .task.exogenous import Believed, Known, Samples, Unknown
from .task.external_plant import ExternalPlant
from .task.limits import Limits, PathConstraint
from .task.problem import Problem
from .task.reality import Reality
from .task.reference import Table, Trajectory
from .task.set_point import Setpoint
from .tracking.fractional import Fractional
from .tracking.linear_law import Exponential, ShiftPolynomial

__all__ = [
    "PID",
    "RFPT",
    "Affine",
    "Answer",
    "Believed",
    "ByDesired",
    "ByModel",
    "Cascade",
    "Cases",
    "Collocation",
    "ColouredNoise",
    "ComputedTorque",
    "CustomCost",
    "Cvodes",
    "DeadTime",
    "DisturbanceKalman",
    "Estimating",
    "Euler",
    "ExactHessian",
    "ExactModel",
    "Exponential",
    "ExternalPlant",
    "Fatrop",
    "FeedforwardOnly",
    "Filtered",
    "FixedPoint",
    "Formula",
    "FpirhcError",
    "Fractional",
    "FromMeasurement",
    "FromPlan",
    "FullSpaceFixedPoint",
    "GaussNewton",
    "GradientFixedPoint",
    "Haar",
    "HarmfulAdaptation",
    "HeatMap",
    "Horizon",
    "Identity",
    "Increment",
    "Ipopt",
    "KalmanFilter",
    "Known",
    "LQRTerminal",
    "Limits",
    "LogNormal",
    "LogSpan",
    "LowPassDifference",
    "LyapunovRule",
    "Measured",
    "Metric",
    "ModelReferenced",
    "Noise",
    "Normal",
    "Output",
    "OverTime",
    "Paired",
    "Parameter",
    "PathConstraint",
    "Periodic",
    "Plan",
    "Planar",
    "Plant",
    "Portrait",
    "PositionDifference",
    "Predicted",
    "Problem",
    "Projection",
    "Pulse",
    "Quadratic",
    "Quantity",
    "RFPTVector",
    "Raster",
    "Reality",
    "RecedingHorizon",
    "RecursiveLeastSquares",
    "ReducedGradient",
    "Rotation",
    "Run",
    "RunMonitor",
    "RungeKutta4",
    "Samples",
    "SavitzkyGolay",
    "Sensing",
    "Sensor",
    "SequentialQuadratic",
    "Setpoint",
    "Shape",
    "ShiftPolynomial",
    "Sigmoid",
    "Sine",
    "Slot",
    "Slotted",
    "Span",
    "Spread",
    "Status",
    "Step",
    "StepDifference",
    "Stepper",
    "Table",
    "ThroughModel",
    "Trajectory",
    "Tuned",
    "Uncertain",
    "Uniform",
    "Unknown",
    "VelocityDifference",
    "certify",
    "certify_limits",
    "check",
    "compare",
    "figures",
    "limits",
    "load_problem",
    "load_run",
    "measure",
    "outside",
    "probe",
    "review",
    "rivals",
    "signed_power",
    "simulate",
    "simulator",
    "solve",
    "study",
    "tune",
    "with_settings",
    "write_report",
]

__version__: str
