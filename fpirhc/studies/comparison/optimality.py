"""The cost of the plans of a run against the converged optimum of the same horizon."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.check import checked
from fpirhc.controllers.reference_states import own_signals
from fpirhc.errors import FpirhcError
from fpirhc.horizon.nominal import consistent_state
from fpirhc.horizon.problem import OptimalControl
from fpirhc.horizon.stage_data import offset_limits, shifted_reference, stage_data
from fpirhc.horizon.transcription import transcribe
from fpirhc.optimisers.fixed_point import FixedPoint
from fpirhc.plant.chain import measured_signals
from fpirhc.simulation.run import Run
from fpirhc.status import Status
from fpirhc.summary import written_out
from fpirhc.symbolic.evaluate import Evaluator, Latest
from fpirhc.symbolic.native import native
from fpirhc.task.exogenous import model_values, previewed_values, rows_of, signals_of
from fpirhc.task.problem import Problem, cycles_per_plan

SAMPLES = 25  # plans of a run that are solved again
_LESS = 0.9  # of the cost of a plan at its limits, from which another plan is clearly cheaper
_AT_LIMIT = 1e-9  # of the range
_OTHER = 1e-6  # relative; closer to the optimum a negative excess is the accuracy of the solves
_ACCURATE = 1e-8  # of the input's range
_BREAK_EVEN = 5000  # iterations that take the virtual machine as long as a compiler takes

_SOLVERS: Latest[_Solver] = Latest(8)


@dataclass(frozen=True)
class Optimality:
    """Relative excess (V - V*) / |V*| of sampled plans over the converged optimum.

    Args:
        stuck: times of those that count as solved with every input at a limit, while one from the middle of the limits is
            clearly cheaper: they are in a local optimum, and the next plan begins there again.
    """

    median: float
    worst: float
    plans: int
    stuck: tuple[float, ...] = ()

    @property
    def reached(self) -> bool:
        """Whether all of these plans are the optimum, to the accuracy with which costs are compared."""
        return self.worst < _OTHER


def measure_optimality(
    problem: Problem, controller: Controller, run: Run, *, compiled: bool = True
) -> Optimality | None:
    """Return the excess cost of sampled plans.

    The result is None where plans do not start from a state in the run, where no plan was solved, for a controller that learns,
    because the models of its plans are not in the run, and towards set-points, because what its plans knew of them is not either.
    The optimum is the one found from no input; where the plan stands at limits alone, the cheaper one of this and the one from the
    middle of the limits. A negative excess is that of another local optimum, which the controller reached and these solves did not.
    """
    ready = checked(problem, controller)
    planner, feeds = ready.planner, ready.feeds
    if planner is None or not planner.restarts or problem.horizon is None or run.cycles < 2:
        return None
    if ready.learns or "parameters" in feeds or own_signals(problem):
        return None
    read = ("time", "state", problem.plant.output.name)
    times, states, seen = (run[feeds[n] if feeds.get(n) in run.layout.names else n] for n in read)
    plant_model = ready.plant_model(problem)
    model, known = plant_model.plant, plant_model.signals
    other = (
        replace(problem, plant=model, reality=None, signals=signals_of(model, known))
        if model is not problem.plant
        else problem
    )
    planned = planner.planned(other)
    assert planned.horizon is not None
    assert planned.cost is not None
    ahead = previewed_values(model, known)
    limits, start = planned.limits, planned.start_state
    ocp = transcribe(planned.plant, planned.reference, planned.horizon, planned.cost, limits, ahead, start)
    try:
        solve = _SOLVERS.of((ocp,), (compiled,), lambda: _Solver(ocp, compiled))
    except FpirhcError:
        return None
    data_of = stage_data(planned.plant, planned.reference, planned.horizon, planned.cost, signals=ahead)
    beside = measured_signals(planned.plant)[1:]  # outputs that are given beside the state
    corrected = planner.feeds_back(planned.plant)
    shifts = [shifted_reference(planned.plant, ocp.data, ocp.stages + 1, corrected=corrected) for _ in beside]
    offset = offset_limits(planned.plant, planned.horizon, ocp.data) if planned.horizon.measured else None
    begin = consistent_state(planned.plant) if planner.starts_consistent(planned.plant) else None
    stride = cycles_per_plan(problem.horizon, problem.period)
    plans = np.arange(stride, run.cycles, stride)
    rows = plans[np.unique(np.linspace(0, plans.size - 1, SAMPLES).astype(int))] if plans.size else plans
    times = np.ravel(times)
    parameters = rows_of(model_values(model, known), times + problem.period / 2, plant_model.parameters(model))
    excess, stuck = [], []
    for row in rows:
        shift = run["command_shift"][row - 1]
        lower, upper = ocp.input_lower - shift, ocp.input_upper - shift
        state = states[row] if begin is None else begin(states[row], seen[row], parameters[row])
        first = ocp.start(state, run["command"][row - 1] - shift).full().ravel()
        data = np.asarray(data_of(times[row], parameters[row]).full())
        for shift_of in shifts:
            data = np.asarray(shift_of(data, state, seen[row], parameters[row], run["command"][row - 1]).full())
        if offset is not None:
            data = np.asarray(offset(data, state, states[row]).full())
        best, cost_of_plan = solve(first, data, lower, upper), run["solve.cost"][row]
        if best is None or run["status"][row] > Status.NOT_CONVERGED:
            continue
        if _at_limits(run["planned"][row], lower, upper):
            best = min(best, solve(first, data, lower, upper, middle=True) or best)
            if run["status"][row] == Status.OK and best < _LESS * cost_of_plan:
                stuck.append(float(times[row]))
        excess.append((cost_of_plan - best) / max(abs(best), 1e-12))
    return Optimality(float(np.median(excess)), float(np.max(excess)), len(excess), tuple(stuck)) if excess else None


def _at_limits(inputs: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> bool:
    """Whether every input stands at one of its two limits."""
    reach = upper - lower
    return bool(np.isfinite(reach).all() and (np.minimum(inputs - lower, upper - inputs) <= _AT_LIMIT * reach).all())


def gap(excess: float, digits: int) -> str:
    """Return an excess as text; a plan that is clearly cheaper than the solve from rest has found another optimum."""
    return "other optimum" if excess < -_OTHER else written_out(max(excess, 0.0), digits)


class _Solver:
    """Solves horizons from no input, or from the middle of the limits, to high accuracy.

    It does so in C from where its iterations have cost as much as a compiler.
    """

    def __init__(self, ocp: OptimalControl, compiled: bool) -> None:
        reach = ocp.input_upper - ocp.input_lower
        scale = float(np.where(np.isfinite(reach), reach, 1.0).max())
        optimiser = FixedPoint(iterations=1, tolerance=_ACCURATE * scale)
        optimiser.check(ocp)
        self._function, self._waiting = optimiser.converging(ocp), compiled
        self._evaluator = Evaluator(self._function)
        self._layout = optimiser.memory(ocp)
        self._iterations = 0.0

    def __call__(
        self, first: np.ndarray, data: np.ndarray, lower: np.ndarray, upper: np.ndarray, *, middle: bool = False
    ) -> float | None:
        memory = self._layout.start()
        if middle:
            inputs = self._layout.slice("plan_inputs")
            memory[inputs] = np.resize((lower + upper) / 2, inputs.stop - inputs.start)
        for _ in range(20):
            if self._waiting and self._iterations > _BREAK_EVEN:
                self._evaluator, self._waiting = Evaluator(native(self._function).function), False
            _, facts, memory = self._evaluator(first, data.T, lower, upper, memory)
            self._iterations += max(float(facts[3]), 0.0)
            if facts[4] == Status.OK:
                return float(facts[0])
        return None
