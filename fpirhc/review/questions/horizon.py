"""Is the horizon long enough? It is, where a horizon of twice the length hardly changes the first command of a plan."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import with_optimiser, without_deformation
from fpirhc.describe import as_written
from fpirhc.errors import FpirhcError
from fpirhc.horizon.hessian_models import GaussNewton, hessian_end, hessian_stage, linear_stage
from fpirhc.horizon.horizon import Horizon
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.stage_data import shifted_reference, stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.optimisers.base import Optimiser
from fpirhc.plant.chain import nominal_responses
from fpirhc.plant.maps import growth_of, quick_step_of
from fpirhc.plant.plant import Plant
from fpirhc.review.grid import ReviewGrid, state_slopes
from fpirhc.review.question import Answer, Case, ControllerQuestion, ProblemQuestion, Verdict
from fpirhc.review.questions.integration import stiff_advice
from fpirhc.simulation.model_as_plant import shortened
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import simulate
from fpirhc.status import Status
from fpirhc.summary import in_percent
from fpirhc.task.limits import Limits
from fpirhc.task.problem import Problem, cycles_per_plan, cycles_per_stage

LONG_ENOUGH = "Is the horizon long enough?"
_SAME = 0.1  # relative change of the plan's feedback
_LITTLE = 0.1  # growth over the run, as a share, that the run does not show
_REST = 1e-10  # change of a state in a stage, as a share of the largest, below which it rests
_STILL = 1e-6  # of a growth per stage: a mode that neither decays nor grows


def horizon_long_enough(grid: ReviewGrid) -> Answer | None:
    """Return how the plan's feedback at the start of the reference changes with the horizon; None without one."""
    problem, plant = grid.problem, grid.problem.plant
    if problem.horizon is None or problem.cost is None:
        return None
    reach, unit = float(problem.horizon.nodes[-1]), problem.time_unit
    grid = grid.with_exact(plant.approximate)
    try:
        first, second = (plan_gain(problem, one, grid.states_at) for one in (problem.horizon, _longer(problem.horizon)))
    except (FpirhcError, np.linalg.LinAlgError) as error:
        return Answer(LONG_ENOUGH, Verdict.UNKNOWN, f"{reach:g} {unit}; the plan's feedback is not known: {error}")
    if not any(gain[:, : -len(plant.inputs)].any() for gain in (first, second)):
        text = f"{reach:g} {unit}; near the reference the plan feeds no state back, whatever its length"
        return Answer(LONG_ENOUGH, Verdict.UNKNOWN, text, "Run it with a longer horizon and compare.", {"reach": reach})
    change = float(np.linalg.norm(first - second)) / max(float(np.linalg.norm(second)), 1e-300)
    grows = _growth(grid, first)
    slowest = _slowest(grid)
    text = (
        f"{reach:g} {unit}; twice as long changes the plan's feedback by {in_percent(change)}; slowest time constant "
    )
    text += f"{slowest:.3g} {unit}" if math.isfinite(slowest) else "infinite"
    numbers = {"reach": reach, "change": change, "slowest_time_constant": slowest, "growth": grows}
    if grows > 0:
        text += f"; the model under the plan's feedback diverges at {grows:.3g} {problem.rate_unit}"
        stiff = stiff_advice(grid, plant.approximate, planned=True)
        verdict = Verdict.CAUTION if grows * problem.duration <= _LITTLE else Verdict.NO
        return Answer(LONG_ENOUGH, verdict, text, stiff or _advice(plant, change), numbers)
    verdict = Verdict.CAUTION if change > _SAME else Verdict.YES
    return Answer(LONG_ENOUGH, verdict, text, "A longer horizon, or a weight of its end, plans differently.", numbers)


def plan_gain(
    problem: Problem, horizon: Horizon, states_at: Callable[[np.ndarray], np.ndarray] | None = None
) -> np.ndarray:
    """Return [K, L], shape (nu, nx + nu), of a plan at the start of the reference, u = u* + K (x - x^N) + L (u_before - u*).

    They are the first gains of the Riccati recursion over the horizon, with the model linearised along the reference and the
    second derivatives of the cost. L is zero unless the cost weighs the change of the inputs from stage to stage. Bounds are left
    out: near the reference they bind nowhere. An end that must be met, C x_N = 0, enters exactly, by its multiplier,

        V_k(x) = x' P_k x / 2 + x' E_k mu + mu' G_k mu / 2,      E_N = C',  G_N = 0,      mu = -G_0^-1 E_0' x.

    Args:
        states_at: times (m,) -> states (m, nx) at which the model is linearised; None: those of the reference. Of a plant with
            outputs only the first counts: the model's own motion begins there.
    """
    plant, believed, n = problem.plant, problem.plant.approximate, horizon.stages
    assert problem.cost is not None
    ends = [plant.state.elements.index(name) for name in horizon.terminal]
    cycles, stage = (count(horizon, problem.period) for count in (cycles_per_plan, cycles_per_stage))
    horizon = replace(horizon, margins={}, terminal=(), share=cycles / stage)
    ocp = transcribe(plant, problem.reference, horizon, problem.cost, Limits(), start=problem.start_state)
    data = np.asarray(stage_data(plant, problem.reference, horizon, problem.cost)(0.0, believed).full())
    clock = horizon.nodes
    t = ca.MX.sym("t")
    outputs, responses = problem.reference.function(plant)(t)
    motion = ca.Function("fpirhc_nominal_motion", [t], [outputs, nominal_responses(plant, outputs, responses)])
    followed, wanted = (np.asarray(v.full()) for v in motion.map(n)(clock[None, :-1]))
    if plant.outputs and states_at is not None:
        begin = states_at(clock[:1])[0]
        command = plant.equations.inverse(begin, wanted[:, 0], believed)
        shifted = shifted_reference(plant, ocp.data, n + 1, corrected=False)
        data = np.asarray(shifted(data, begin, followed[:, 0], believed, command).full())
        states, inputs = _motion(ocp, plant.equations.inverse, begin, wanted, data, believed)
    else:
        states = data[ocp.data.slice("reference")] if states_at is None else states_at(clock).T
        repeated = np.repeat(believed[:, None], n, axis=1)
        inputs = np.asarray(plant.equations.inverse.map(n)(states[:, :-1], wanted, repeated).full())
        if ocp.state.size > plant.state.size:
            states = np.vstack([states, np.hstack([inputs[:, :1], inputs])])
    first = _first_gain(ocp, states, inputs, data, np.eye(ocp.state.size)[:, ends])
    size = plant.state.size + plant.input.size
    return np.hstack([first, np.zeros((len(first), size - first.shape[1]))])


def _longer(horizon: Horizon) -> Horizon:
    """The horizon with twice as many stages, and its blocks repeated."""
    lengths = (*horizon.lengths, *horizon.lengths[-1:] * horizon.stages)
    return replace(horizon, stages=2 * horizon.stages, blocks=2 * horizon.blocks, lengths=lengths)


def _motion(
    ocp: OptimalControl, inverse: ca.Function, state: np.ndarray, responses: np.ndarray, data: np.ndarray, p: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """States (ns, N + 1) and inputs (nu, N) of the model with the responses of the reference.

    A model at rest stays there: what rounding makes of it grows where the inverse does not converge.
    """
    held = np.ptp(responses, axis=1).max() <= _REST * max(1.0, np.abs(responses).max())
    inputs = [np.asarray(inverse(state, responses[:, 0], p).full()).ravel()]
    columns = [np.asarray(ocp.start(state, inputs[0]).full()).ravel()]
    for k in range(ocp.stages):
        if k:
            inputs.append(np.asarray(inverse(columns[k][: len(state)], responses[:, k], p).full()).ravel())
        columns.append(np.asarray(ocp.dynamics(columns[k], inputs[k], data[:, k]).full()).ravel())
        if not k and held and np.abs(columns[1] - columns[0]).max() <= _REST * max(1.0, np.abs(columns[0]).max()):
            return np.tile(columns[0][:, None], ocp.stages + 1), np.tile(inputs[0][:, None], ocp.stages)
    return np.column_stack(columns), np.column_stack(inputs)


def _first_gain(
    ocp: OptimalControl, states: np.ndarray, inputs: np.ndarray, data: np.ndarray, met: np.ndarray
) -> np.ndarray:
    """First gain of the recursion, shape (nu, ns); `met` (ns, rows) selects the states that must be zero at the end."""
    linear, curved, end = linear_stage(ocp), hessian_stage(ocp, GaussNewton()), hessian_end(ocp)
    value = np.asarray(end(states[:, -1], data[:, -1])[2].full())
    tied, pulled = met, np.zeros((met.shape[1], met.shape[1]))  # E and G
    gain, pull = np.zeros((len(inputs), len(states))), np.zeros((len(inputs), met.shape[1]))
    for k in reversed(range(inputs.shape[1])):
        at = (states[:, k], inputs[:, k], data[:, k])
        a, b = (np.asarray(m.full()) for m in linear(*at)[2:4])
        q, s, r = (np.asarray(m.full()) for m in curved(*at, np.zeros(len(states))))
        coupled = s + b.T @ value @ a
        curvature = r + b.T @ value @ b
        gain, pull = -np.linalg.solve(curvature, coupled), -np.linalg.solve(curvature, b.T @ tied)
        value = q + a.T @ value @ a + coupled.T @ gain
        pulled = pulled + (b.T @ tied).T @ pull
        tied = a.T @ tied + coupled.T @ pull
    if not met.shape[1]:
        return gain
    return gain - pull @ np.linalg.lstsq(pulled, tied.T, rcond=None)[0]


def _advice(plant: Plant, change: float) -> str:
    """What to change where the model diverges under the plan's feedback."""
    if change <= _SAME:
        return "A longer horizon plans the same: weigh what diverges, see the zero dynamics."
    whole = " (LQRTerminal)" if plant.output.elements == plant.state.elements else ""
    return f"Lengthen the horizon, or weigh its end{whole}."


def _slowest(grid: ReviewGrid) -> float:
    """Longest time constant of the model alone; infinite where a mode neither decays nor grows."""
    rates = np.abs(growth_of(grid.problem.plant)(np.linalg.eigvals(_model(grid)[0])))
    return float(1 / rates.min()) if rates.min() > 1e-9 else float("inf")


def _growth(grid: ReviewGrid, feedback: np.ndarray) -> float:
    """Growth rate of the model's fastest mode, per unit of time, under the plans' feedback.

    It is ln(rho) / T with the spectral radius rho of the state and the held input over the time T from plan to plan, and 0 where
    rho is 1.
    """
    assert grid.problem.horizon is not None
    step = cycles_per_plan(grid.problem.horizon, grid.problem.period) * grid.problem.period
    a, b = _model(grid)
    nx, nu = b.shape
    rates = np.block([[a, b], [np.zeros((nu, nx + nu))]])
    held = quick_step_of(grid.problem.plant, rates, step)[:nx]
    stage = np.vstack([held[:, :nx] @ np.eye(nx, nx + nu) + held[:, nx:] @ feedback, feedback])
    radius = float(np.abs(np.linalg.eigvals(stage)).max())
    return 0.0 if abs(radius - 1) < _STILL else math.log(radius) / step


def _model(grid: ReviewGrid) -> tuple[np.ndarray, np.ndarray]:
    """A and B of the model's state at the start of the reference."""
    plant = grid.problem.plant
    needed = grid.needed(plant.approximate)[0]
    slopes = state_slopes(plant, grid.states[0], needed, plant.approximate)
    return slopes.a, slopes.b


ITERATIONS = "Do the optimiser's iterations suffice for this horizon?"
MANY = 0.05  # share of the cycles from which plans that did not converge are a cause
_PLANS = 100  # of a run
_MORE = (2, 4, 8, 16)


def iterations_suffice(case: Case) -> Answer | None:
    """Return the share of the cycles whose plan did not converge on the right model; None for a controller that does not plan."""
    planner, horizon = case.controller.planner, case.problem.horizon
    if planner is None or horizon is None:
        return None
    try:
        bare = without_deformation(case.controller)
        model = shortened(case.runs.model.of(bare), _PLANS * cycles_per_plan(horizon, case.problem.period))
        share, later = unsolved(case.runs.bare(bare), model.cycles)
    except FpirhcError as error:
        return Answer(ITERATIONS, Verdict.UNKNOWN, f"no run of the model: {error}")
    text = f"on its own model {in_percent(share)} of the first {model.cycles} cycles have a plan that did not converge"
    numbers = {"unsolved": share, "unsolved_later": later}
    if share < MANY:
        return Answer(ITERATIONS, Verdict.YES, text, "", numbers)
    text += f", of the second half of them {in_percent(later)}"
    if later < MANY:
        return Answer(
            ITERATIONS, Verdict.CAUTION, text, "Give the optimiser more iterations where the start matters.", numbers
        )
    return Answer(ITERATIONS, Verdict.NO, text, _remedy(model, bare, planner.optimiser), numbers)


def unsolved(run: Run, cycles: int) -> tuple[float, float]:
    """Return the share of the first cycles with a plan that did not converge, and of their second half; 1 where the run ends."""
    if run.cycles < cycles:
        return 1.0, 1.0
    failed = run["status"][:cycles] == Status.NOT_CONVERGED
    return float(np.mean(failed)), float(np.mean(failed[cycles // 2 :]))


def _remedy(model: Problem, bare: Controller, optimiser: Optimiser) -> str:
    for times in _MORE:
        longer = optimiser.longer(times)
        if longer is None:
            return "Take an optimiser that iterates until its plans are solved, or shorten the horizon."
        try:
            run = simulate(model, with_optimiser(bare, longer), seed=0, compiled=False)
            if unsolved(run, model.cycles)[1] < MANY:
                return f"Give the optimiser {times} times the iterations: {as_written(longer)}."
        except FpirhcError:
            break
    return f"Not even {_MORE[-1]} times the iterations suffice: shorten the horizon, or make the cost or its reference gentler."


EFFORT = "Does the cost leave the effort free that the plant needs?"
EFFORT_FACT = (
    "its cost weighs the absolute effort, so the optimum of the wrong model trades tracking against a wrong effort and adaptation "
    "realises that plan faithfully"
)
EFFORT_CHANGE = "Weigh the deviation from the model's feedforward, or the input's rate."


def leaves_effort_free(case: Case) -> Answer | None:
    """Return whether a plan weighs the absolute effort; None without a plan, and where the model is right."""
    planner = case.controller.planner
    cost = None if planner is None else planner.cost or case.problem.cost
    right = case.grid.real is None and np.array_equal(case.believed, case.problem.plant.exact)
    if cost is None or right:
        return None
    if cost.weighs_effort:
        return Answer(EFFORT, Verdict.CAUTION, EFFORT_FACT, EFFORT_CHANGE)
    return Answer(EFFORT, Verdict.YES, "its cost weighs no absolute effort")


QUESTIONS = (
    ProblemQuestion(horizon_long_enough, LONG_ENOUGH, order=6),
    ControllerQuestion(iterations_suffice, ITERATIONS, order=31, adaptive=False),
    ControllerQuestion(leaves_effort_free, EFFORT, order=32),
)
