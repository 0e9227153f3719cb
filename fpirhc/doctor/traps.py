"""Checks of known traps: what the libraries below do wrong without saying so, and that it is caught here.

Each says what the library was seen to do on this machine; it fails where the guard in fpirhc does not hold.
"""

from __future__ import annotations

import gc
import io
import pickle
import statistics
import subprocess
import sys
import time
import warnings
from contextlib import redirect_stdout
from importlib.util import find_spec
from typing import Any

import casadi as ca
import numpy as np

from fpirhc.conformance.laws import within
from fpirhc.controllers.computed_torque import ComputedTorque
from fpirhc.deformation.identity import Identity
from fpirhc.doctor.finding import Check, Outcome, fine, judged
from fpirhc.errors import NotSupported
from fpirhc.horizon.cost import Quadratic
from fpirhc.horizon.problem import Horizon, OptimalControl, transcribe
from fpirhc.horizon.rollout import rollout
from fpirhc.optimisers.base import is_finite, status_of
from fpirhc.optimisers.nlp import Ipopt, Osqp, SequentialQuadratic, quadratic_solver
from fpirhc.plant.plant import Parameter, Plant
from fpirhc.simulation.stepper import Stepper
from fpirhc.status import Status
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.symbolic.functions import signed_power
from fpirhc.task.limits import Limits
from fpirhc.task.problem import Problem
from fpirhc.task.reference import Trajectory
from fpirhc.tracking.exponential import Exponential

_REPORT = "this version does not guard against it: report it with the output of 'fpirhc doctor --json'"


def clamp_hides_nan() -> tuple[Outcome, str, str]:
    """A clamp turns NaN into a full command, so controllers ask for finiteness first."""
    clamped = float(ca.fmin(1, ca.fmax(-1, ca.DM(np.nan))))
    stepper = Stepper(_problem(), ComputedTorque(Exponential(rate=6.0)), compiled=False)
    rest = np.zeros(2), np.zeros(1)
    command, memory = stepper.step(0.0, *rest, stepper.start())
    held, _ = stepper.step(0.01, np.array([np.nan, 0.0]), rest[1], memory)
    found = f"fmin(1, fmax(-1, nan)) is {clamped:g}; for a state of NaN the controller holds {held[0]:g}"
    return judged(bool(held[0] == command[0]), found, _REPORT)


def maximum_hides_nan() -> tuple[Outcome, str, str]:
    """A residual folded with fmax reports convergence for NaN, so the status asks for finiteness."""
    folded = float(ca.fmax(ca.DM(np.nan), 0.0))
    nan = ca.DM(np.nan)
    status = Status(int(ca.DM(status_of(is_finite(nan), nan, 0.0, 1e-6))))
    return judged(
        status == Status.NON_FINITE, f"fmax(nan, 0) is {folded:g}; the status of NaN is {status.name}", _REPORT
    )


def nan_equals_nan() -> tuple[Outcome, str, str]:
    """Numpy's assert_allclose passes for NaN, so the laws compare in their own way."""
    found = (
        f"NaN within a bound: {within(np.nan, 1.0)}; in tests of your own write assert_allclose(..., equal_nan=False)"
    )
    return judged(not within(np.nan, 1.0), found, _REPORT)


def infeasible_osqp() -> tuple[Outcome, str, str]:
    """OSQP fills infeasible answers with a finite number, so plans are judged by themselves."""
    ocp = _horizon(Limits(inputs={"u": (-0.1, 0.1)}, states={"y": (-0.2, 0.2)}))
    step = SequentialQuadratic(tolerance=1e-3, quadratic=Osqp())
    memory = step.memory(ocp).start()
    _, said, _ = step.step(ocp)(np.array([2.0, 1.0]), ocp.nodes[2], ocp.input_lower, ocp.input_upper, memory)
    status = Status(int(said[4]))
    return judged(status != Status.OK, f"a plan without solution gets status {status.name}", _REPORT)


def conic_fatrop() -> tuple[Outcome, str, str]:
    """CasADi's conic interface to fatrop returned infeasible points as solved, so it is refused."""
    try:
        quadratic_solver("fatrop")
    except NotSupported:
        return fine("refused as a quadratic solver; fatrop as a nonlinear one is offered")
    return Outcome.FAIL, "offered as a quadratic solver", _REPORT


def solver_banner() -> tuple[Outcome, str, str]:
    """IPOPT prints a banner on standard output unless it is told not to, which would spoil --json."""
    ocp, printed = _horizon(Limits()), io.StringIO()
    optimiser = Ipopt(tolerance=1e-3)
    with redirect_stdout(printed):
        memory = optimiser.memory(ocp).start()
        optimiser.step(ocp)(np.array([0.1, 0.0]), ocp.nodes[2], ocp.input_lower, ocp.input_upper, memory)
    said = printed.getvalue()
    return judged(not said, f"a solve with IPOPT prints {len(said)} characters", _REPORT, Outcome.WARN)


def solver_pickle() -> tuple[Outcome, str, str]:
    """A solver takes megabytes to send to a worker, so workers are sent values and build their own."""
    size = len(pickle.dumps(Ipopt(tolerance=1e-3)))
    return judged(size < 10_000, f"an optimiser is sent as a value of {size} bytes, never as a solver", _REPORT)


def buffered_calls() -> tuple[Outcome, str, str]:
    """An ordinary call costs tens of microseconds; through buffers a fraction, if their owner is kept alive."""
    x = ca.SX.sym("x", 4)
    function = ca.Function("f", [x], [ca.sin(x)])
    evaluator = Evaluator(function)
    evaluate, results = evaluator.evaluate, evaluator.results
    evaluator.arguments[0][:] = 1.0
    if not getattr(evaluate, "owners", None):
        return Outcome.FAIL, "the handle of a buffer does not keep its owner alive", _REPORT
    del evaluator
    gc.collect()
    evaluate()
    plain, buffered = (_microseconds(call) for call in (lambda: function(np.ones(4)), evaluate))
    alive = bool(np.allclose(results[0], np.sin(1.0)))
    found = f"an ordinary call takes {plain:.2g} us, a buffered one {buffered:.2g} us"
    return judged(alive, found, _REPORT)


def first_call() -> tuple[Outcome, str, str]:
    """The first call is many times slower than the median, so times are told apart."""
    stepper = Stepper(_problem(), ComputedTorque(Exponential(rate=6.0)), compiled=False)
    arguments = 0.0, np.zeros(2), np.zeros(1), stepper.start()
    first = _microseconds(lambda: stepper.step(*arguments), 1)
    later = _microseconds(lambda: stepper.step(*arguments))
    return fine(f"first cycle {first:.2g} us, later {later:.2g} us; 'first' has a column of its own in reports")


def frozen_is_not_identity() -> tuple[Outcome, str, str]:
    """A gain of zero would freeze the request; no adaptation means to pass on what is desired."""
    request, response, desired = (ca.SX([v]) for v in (1.0, 2.0, 3.0))
    deformed = float(ca.DM(Identity().step(request, response, desired, {})[0]))
    return judged(deformed == 3.0, f"Identity asks for {deformed:g} where 3 is desired and 1 was requested", _REPORT)


def numpy_on_symbols() -> tuple[Outcome, str, str]:
    """Numpy functions on symbols may give something that only looks like an expression."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            result: Any = np.sin(ca.SX.sym("x"))
        except (TypeError, AttributeError):
            return fine("numpy.sin refuses a symbol; write ca.sin in models")
    warned = f"warns ({caught[0].category.__name__})" if caught else "does not warn"
    found = f"numpy.sin of a symbol gives a {type(result).__name__} and {warned}; write ca.sin in models"
    return judged(
        isinstance(result, ca.SX), found, "write ca.sin and the like in every response and cost", Outcome.WARN
    )


def kinks_of_powers() -> tuple[Outcome, str, str]:
    """The Hessian of a signed power is not finite at zero; gradients must be, and Gauss-Newton needs no more."""
    e = ca.SX.sym("e")
    value = signed_power(e, 1.5)
    slope = float(ca.Function("slope", [e], [ca.gradient(value, e)])(0.0))
    bend = float(ca.Function("bend", [e], [ca.hessian(value, e)[0]])(0.0))
    found = f"of signed_power(e, 1.5) at e = 0: slope {slope:g}, curvature {bend:g}; GaussNewton() is the default"
    return judged(bool(np.isfinite(slope)), found, _REPORT)


def long_horizons() -> tuple[Outcome, str, str]:
    """A horizon written out stage by stage compiles for seconds, so stages are accumulated calls of one Function."""
    short, long = (rollout(_horizon(Limits(), stages)).n_nodes() for stages in (10, 40))
    return judged(long < 2 * short, f"a rollout has {short} nodes for 10 stages, {long} for 40", _REPORT, Outcome.WARN)


def slow_imports() -> tuple[Outcome, str, str]:
    """`control` takes a second to import, so it must not come with the command line."""
    code = "import fpirhc, fpirhc.cli.main, sys; print([m for m in ('control', 'casadi', 'matplotlib') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    found = done.stdout.strip()
    return judged(found == "[]", f"imported with the command line: {found}", _REPORT, Outcome.WARN)


def open_ports() -> tuple[Outcome, str, str]:
    """A dask cluster's dashboard listens on every network interface unless it is told not to."""
    if find_spec("distributed") is None:
        return fine("fpirhc opens no port, and dask.distributed is not installed")
    return fine("fpirhc opens no port; a LocalCluster of your own needs dashboard_address='127.0.0.1:8787'")


def _microseconds(call: Any, repeats: int = 200) -> float:
    """Median time of a call."""
    taken = []
    for _ in range(repeats):
        begin = time.perf_counter_ns()
        call()
        taken.append(time.perf_counter_ns() - begin)
    return statistics.median(taken) / 1e3


def _plant() -> Plant:
    return Plant(
        coordinates={"y": "m"},
        inputs={"u": "N"},
        parameters={"m": Parameter(approximate=1.0, exact=1.0, unit="kg")},
        response=lambda q, v, u, p: {"y": (u.u - 0.1 * v.y - 0.1 * q.y) / p.m},
    )


def _problem() -> Problem:
    return Problem(
        plant=_plant(),
        reference=Trajectory(lambda t: {"y": 0 * t}),
        start={"y": 0.0},
        period=0.01,
        duration=0.1,
        limits=Limits(inputs={"u": (-1.0, 1.0)}),
    )


def _horizon(limits: Limits, stages: int = 5) -> OptimalControl:
    cost = Quadratic(states={"y": 1.0, "y'": 0.1}, effort={"u": 0.1})
    return transcribe(_plant(), Trajectory(lambda t: {"y": 0 * t}), Horizon(stages, 0.2), cost, limits)


CHECKS: tuple[Check, ...] = (
    clamp_hides_nan,
    maximum_hides_nan,
    nan_equals_nan,
    infeasible_osqp,
    conic_fatrop,
    solver_banner,
    solver_pickle,
    buffered_calls,
    first_call,
    frozen_is_not_identity,
    numpy_on_symbols,
    kinks_of_powers,
    long_horizons,
    slow_imports,
    open_ports,
)
