"""The public names; `__init__.py` imports each when it is first used."""

from .adaptation.lyapunov_rule import LyapunovRule
from .adaptation.projection import Projection
from .contraction import assess_gain, check_gain, delayed_limit, response_jacobian, spectrum_over_box, spectrum_over_run
from .controllers.acceleration_feedback import AccelerationFeedback
from .controllers.adaptive_inverse_dynamics import AdaptiveInverseDynamics
from .controllers.backstepping_mrac import BacksteppingMrac
from .controllers.chosen_schedules import ByError, ByLookAhead
from .controllers.computed_torque import ComputedTorque
from .controllers.estimating import Estimating
from .controllers.floquet import Floquet, floquet_radius
from .controllers.force_mrac import ForceMrac
from .controllers.informed import Informed
from .controllers.lyapunov_mrac import LyapunovMrac
from .controllers.nominal import OpenPlan, Restart, RestartAndTrack
from .controllers.on_failure import Feedforward, HoldPlan, StopRun
from .controllers.pid import Pid
from .controllers.predicted import ByDesired, ByModel, Predicted
from .controllers.receding_horizon import RecedingHorizon
from .controllers.resolved_rate import ResolvedAccelerationRate
from .controllers.schedules import FixedSchedule, Periodic
from .controllers.sliding_mode import SlidingMode
from .controllers.slot import Slot
from .controllers.slotine_li import SlotineLi
from .controllers.slotted import Slotted
from .dead_time import DeadTime
from .deformation.affine import Affine
from .deformation.blended import Blended
from .deformation.damped import Damped
from .deformation.delayed import Increment, Paired
from .deformation.filtered import Filtered
from .deformation.guarded import Guarded
from .deformation.identity import Identity
from .deformation.rfpt import Rfpt
from .deformation.rfpt_vector import RfptVector
from .deformation.rotation import Rotation
from .deformation.self_paired import DelayWatched, SelfPaired
from .deformation.sigmoid import Sigmoid
from .deformation.tuned import Tuned
from .disturbance import ColouredNoise, Formula, Noise, Pulse, Sine, Step
from .errors import FpirhcError
from .estimation.disturbance_kalman import DisturbanceKalman
from .estimation.disturbed import disturbed
from .estimation.moving_horizon import MovingHorizon
from .estimation.recursive_least_squares import RecursiveLeastSquares
from .estimation.uncertain import Uncertain
from .horizon.cost import General, LqrTerminal, Quadratic
from .horizon.expansion import ExactHessian, GaussNewton
from .horizon.problem import Horizon
from .integrate import Cvodes, Euler, RungeKutta4
from .limits import Limits, Path
from .lyapunov import LyapunovView, lyapunov_view
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
from .regression.check import bless, check_baseline
from .regressor import Combination, Regressor, linear_parameters
from .relative_order import OutputChain, output_chain
from .report.html import write_report
from .run import Run, load_run
from .sensing import (
    LowPassDifference,
    Measured,
    PositionDifference,
    SavitzkyGolay,
    Sensing,
    Sensor,
    StateVariableFilter,
    VelocityDifference,
)
from .simulation import simulate
from .status import Status
from .stepper import Stepper
from .studies.compare import Comparison, compare
from .studies.problem_file import load_problem
from .studies.review.answer import Answer, Review
from .studies.review.review import review
from .studies.scenario_study import ScenarioComparison, compare_scenarios
from .studies.settings import with_settings
from .studies.spans import LogSpan, Span
from .studies.tune import Tuning, tune
from .symbolic.functions import signed_power
from .testing import check_controller, check_deformation, check_optimiser, check_plant, check_tracking
from .tracking.exponential import Exponential
from .tracking.fractional import Fractional

__all__ = [
    "AccelerationFeedback",
    "AdaptiveInverseDynamics",
    "Affine",
    "Anderson",
    "Answer",
    "BacksteppingMrac",
    "Blended",
    "ByDesired",
    "ByError",
    "ByLookAhead",
    "ByModel",
    "Certificate",
    "ColouredNoise",
    "Combination",
    "Comparison",
    "ComputedTorque",
    "Cvodes",
    "Damped",
    "DeadTime",
    "DelayWatched",
    "DisturbanceKalman",
    "Estimating",
    "Euler",
    "ExactHessian",
    "Exponential",
    "Fatrop",
    "Feedforward",
    "Filtered",
    "FixedPoint",
    "FixedSchedule",
    "Floquet",
    "ForceMrac",
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
    "LowPassDifference",
    "LqrTerminal",
    "LyapunovMrac",
    "LyapunovRule",
    "LyapunovView",
    "Measured",
    "Metrics",
    "MovingHorizon",
    "Noise",
    "OpenPlan",
    "Osqp",
    "OutputChain",
    "Paired",
    "Parameter",
    "Path",
    "Periodic",
    "Pid",
    "Plan",
    "Plant",
    "PositionDifference",
    "Predicted",
    "Problem",
    "Projection",
    "Pulse",
    "Qrqp",
    "Quadratic",
    "RecedingHorizon",
    "RecursiveLeastSquares",
    "ReducedGradient",
    "Regressor",
    "ResolvedAccelerationRate",
    "Restart",
    "RestartAndTrack",
    "Review",
    "Rfpt",
    "RfptVector",
    "Rotation",
    "Run",
    "RungeKutta4",
    "SavitzkyGolay",
    "ScenarioComparison",
    "SelfPaired",
    "Sensing",
    "Sensor",
    "SequentialQuadratic",
    "Sigmoid",
    "Sine",
    "SlidingMode",
    "Slot",
    "SlotineLi",
    "Slotted",
    "Span",
    "StateVariableFilter",
    "Status",
    "Step",
    "Stepper",
    "StopRun",
    "Table",
    "Trajectory",
    "Tuned",
    "Tuning",
    "Uncertain",
    "VelocityDifference",
    "assess_gain",
    "bless",
    "certify",
    "check_baseline",
    "check_controller",
    "check_deformation",
    "check_gain",
    "check_optimiser",
    "check_plant",
    "check_tracking",
    "compare",
    "compare_scenarios",
    "delayed_limit",
    "disturbed",
    "floquet_radius",
    "linear_parameters",
    "load_problem",
    "load_run",
    "lyapunov_view",
    "measure",
    "output_chain",
    "response_jacobian",
    "review",
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
