"""A plan on outputs near the reference: feedback of the state, of the measured outputs, and of the input before.

A plan starts at x_s, the measured state or the one at which the model has the measured outputs (see `consistent_state`), and
follows the reference less d, the distance of the measured outputs from those of the model at x_s (see `shifted_reference`). In
deviations,

    u = u* + K x_s + K_d d + L (u_before - u*),        x_s = (X + Y C) x,        d = C x - C^ x_s,

with the slopes C and C^ of y, y', ... by the state, of the plant that moves and of the model, and those of x_s by state and
outputs, X and Y. The response asked for is that of the model at x_s. K_d is the feedforward of the Riccati recursion for a
reference that is shifted by each entry of d,

    v_k = q_k + A' v_{k+1} + (S + B' P A)' g_k,      g_k = -(R + B' P B)^-1 (r_k + B' v_{k+1}),      K_d = g_0,

where q and r are the second derivatives of the cost by state or input and reference, times that shift.

The model is linearised along its own motion from the state of the plant, on which its outputs keep their distance d: the one that a
plan approaches where its cost lets it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from fpirhc.horizon.consistent_state import consistent_state
from fpirhc.horizon.cost import Cost
from fpirhc.horizon.hessian_models import GaussNewton, hessian_end, hessian_stage, linear_stage, stage_symbols
from fpirhc.horizon.horizon import Horizon
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.stage_data import shifted_reference, stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.plant.motion import controlled_places
from fpirhc.plant.plant import Plant
from fpirhc.review.plan_feedback import PlanGain, PlanStart, plan_gains
from fpirhc.task.limits import Limits
from fpirhc.task.problem import Problem

Sweep = tuple[ca.Function, ca.Function, ca.Function, ca.Function, ca.Function]


def gains_at(
    problem: Problem,
    horizon: Horizon,
    cost: Cost,
    times: Sequence[float],
    believed: np.ndarray,
    states_at: Callable[[np.ndarray], np.ndarray],
    *,
    consistent: bool = False,
) -> list[PlanGain]:
    """Return the gains of plans on outputs, or on coordinates; arguments as in `plan_gains` and `output_plan_gains`."""
    if not problem.plant.outputs:
        return plan_gains(problem, horizon, cost, times, believed, states_at)
    states = states_at(np.array(times))
    return output_plan_gains(problem, horizon, cost, times, states, believed, consistent=consistent)


def output_plan_gains(
    problem: Problem,
    horizon: Horizon,
    cost: Cost,
    times: Sequence[float],
    states: np.ndarray,
    believed: np.ndarray,
    *,
    consistent: bool = False,
) -> list[PlanGain]:
    """Return the gains of the plans that start on the reference at these times.

    Args:
        problem: the problem, whose plant has outputs.
        horizon: of the plans.
        cost: of the plans.
        times: at which the plans start.
        states: of the plant that moves at these times, shape (m, nx).
        believed: parameters of the model, shape (np,).
        consistent: whether plans start where the model has the measured outputs.
    """
    plant = problem.plant
    horizon = replace(horizon, margins={})
    ocp = transcribe(plant, problem.reference, horizon, cost, Limits(), start=problem.start_state)
    data_of, shifted = (
        stage_data(plant, problem.reference, horizon, cost),
        shifted_reference(plant, ocp.data, ocp.stages + 1),
    )
    sweep = (linear_stage(ocp), hessian_stage(ocp, GaussNewton()), hessian_end(ocp), *_slopes_by_data(ocp))
    reference, controlled = problem.reference.function(plant), controlled_places(plant)
    start_at = _starts(plant) if consistent else None
    gains = []
    for time, state in zip(times, states, strict=True):
        clock = time + horizon.nodes[:-1]
        seen, responses = (np.asarray(v.full()) for v in reference.map(ocp.stages)(clock[None, :]))
        table, y = data_of(time, believed), seen[:, 0]
        start = None if start_at is None else start_at(state, y, responses[controlled, 0], believed)
        begin = state if start is None else start.state
        data = np.asarray(shifted(table, begin, y, believed).full())
        moves = [np.asarray(shifted(table, begin, y + e, believed).full()) - data for e in np.eye(len(y))]
        motion = _motion(ocp, plant.equations.inverse, begin, responses[controlled], data, believed)
        gain = _gains(sweep, *motion, data, moves, plant.state.size)
        gains.append(replace(gain, start=start))
    return gains


def _starts(plant: Plant) -> Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], PlanStart]:
    """Function (state, outputs, response, parameters) -> where the model has these outputs, and its slopes there."""
    x, y, p = (ca.MX.sym(one.name, one.size) for one in (plant.state, plant.output, plant.parameter))
    found = consistent_state(plant)(x, y, p)
    moved = ca.Function("fpirhc_start", [x, y, p], [found, *(ca.densify(ca.jacobian(found, v)) for v in (x, y))])
    s, u, q = plant.symbols()
    response = plant.equations.controlled_response(s, u, q)
    slopes = ca.Function("fpirhc_response_slopes", [s, u, q], [ca.densify(ca.jacobian(response, v)) for v in (s, u)])

    def start(state: np.ndarray, outputs: np.ndarray, wanted: np.ndarray, believed: np.ndarray) -> PlanStart:
        at, *ways = (np.asarray(m.full()) for m in moved(state, outputs, believed))
        planned = plant.equations.inverse(at, wanted, believed)
        return PlanStart(at.ravel(), *ways, *(np.asarray(m.full()) for m in slopes(at, planned, believed)))

    return start


def _motion(
    ocp: OptimalControl, inverse: ca.Function, state: np.ndarray, responses: np.ndarray, data: np.ndarray, p: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """States (ns, N + 1) and inputs (nu, N) of the model with the responses of the reference."""
    inputs = [np.asarray(inverse(state, responses[:, 0], p).full()).ravel()]
    columns = [np.asarray(ocp.start(state, inputs[0]).full()).ravel()]
    for k in range(ocp.stages):
        if k:
            inputs.append(np.asarray(inverse(columns[k][: len(state)], responses[:, k], p).full()).ravel())
        columns.append(np.asarray(ocp.dynamics(columns[k], inputs[k], data[:, k]).full()).ravel())
    return np.column_stack(columns), np.column_stack(inputs)


def _gains(
    sweep: Sweep, states: np.ndarray, inputs: np.ndarray, data: np.ndarray, moves: Sequence[np.ndarray], nx: int
) -> PlanGain:
    """First gains of the recursion; `moves` are the changes of the data by each entry of d."""
    linear, curved, end, by_data, end_by_data = sweep
    last = states[:, -1], data[:, -1]
    value = np.asarray(end(*last)[2].full())
    slope = np.column_stack([np.asarray(end_by_data(*last, m[:, -1]).full()) for m in moves])
    gain = np.zeros((len(inputs), len(states)))
    feed = np.zeros((len(inputs), len(moves)))
    for k in reversed(range(inputs.shape[1])):
        at = (states[:, k], inputs[:, k], data[:, k])
        a, b = (np.asarray(m.full()) for m in linear(*at)[2:4])
        q, s, r = (np.asarray(m.full()) for m in curved(*at, np.zeros(len(states))))
        on_state, on_input = (
            np.column_stack(columns)
            for columns in zip(*([np.asarray(v.full()) for v in by_data(*at, m[:, k])] for m in moves), strict=True)
        )
        coupled, curvature = s + b.T @ value @ a, r + b.T @ value @ b
        gain = -np.linalg.solve(curvature, coupled)
        feed = -np.linalg.solve(curvature, on_input + b.T @ slope)
        slope = on_state + a.T @ slope + coupled.T @ feed
        value = q + a.T @ value @ a + coupled.T @ gain
    nu = len(inputs)
    return PlanGain(gain[:, :nx], gain[:, nx:] if gain.shape[1] > nx else np.zeros((nu, nu)), feed)


def _slopes_by_data(ocp: OptimalControl) -> tuple[ca.Function, ca.Function]:
    """Functions (s, u, theta, move) -> changes of l_s and l_u; (s, theta, move) -> change of T_s: by a move of theta."""
    s, u, theta = stage_symbols(ocp)
    move = ca.SX.sym("move", theta.numel())
    cost, final = ocp.stage_cost(s, u, theta)[0], ocp.terminal_cost(s, theta)
    changes = [ca.jtimes(ca.gradient(cost, v), theta, move) for v in (s, u)]
    at_end = ca.jtimes(ca.gradient(final, s), theta, move)
    return (
        ca.Function("fpirhc_by_data", [s, u, theta, move], [ca.densify(c) for c in changes]),
        ca.Function("fpirhc_end_by_data", [s, theta, move], [ca.densify(at_end)]),
    )
