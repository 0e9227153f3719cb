"""The closed loop near its fixed point, as one matrix per cycle.

At a point of the reference plant and model are replaced by their linearisations in deviations from it,

    plant   y^(r) = A x + B u   (exact parameters),        model   y^(r) = A^ x + B^ u   (believed ones),

both at the input u* that the reference needs. This is a plant like any other, whose parameters are the entries of the matrices,
so the library's own closed loop is built around it once - tracking law, deformation with what it remembers, prediction, dead
time and integrator as they are - and differentiated at rest:

    z+ = F z + G w,        v = C z,

where z is all that the loop remembers, w is added to the plant's inputs, and v are the commands that arrive there. Entries that
only count, stay constant, or are read by nothing else have been left out of z.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.errors import NotSupported
from fpirhc.plant.integrators import RungeKutta4
from fpirhc.plant.plant import Parameter, Plant
from fpirhc.review.neutral import hidden_modes
from fpirhc.review.plan_feedback import PlanGain, gain_entries
from fpirhc.review.straight import Slopes, straightened
from fpirhc.sensing import Sensing
from fpirhc.simulation.loop import close_loop
from fpirhc.symbolic.layout import Expression, Named
from fpirhc.task.dead_time import DeadTime
from fpirhc.task.disturbance import Step
from fpirhc.task.problem import Problem
from fpirhc.task.reference import Trajectory

LARGEST = 1500  # entries of the loop's memory, beyond which its eigenvalues take too long


@dataclass(frozen=True, eq=False)
class LinearLoop:
    """One cycle of the loop, z+ = F z + G w, v = C z.

    Args:
        dynamics: F.
        entry: G.
        arriving: C.
        state: places of the plant's state in z.
        period: of the control cycle.
        judged: places of the judged coordinates in z; None: every mode counts.
    """

    dynamics: np.ndarray
    entry: np.ndarray
    arriving: np.ndarray
    state: np.ndarray
    period: float
    judged: np.ndarray | None = None

    @cached_property
    def poles(self) -> np.ndarray:
        """Eigenvalues of F."""
        return np.asarray(np.linalg.eigvals(self.dynamics))

    @property
    def radius(self) -> float:
        """The factor by which the slowest or fastest growing mode changes per cycle.

        Neutral modes that no judged coordinate shows are left out.
        """
        return float(np.abs(self.poles[~self.hidden]).max(initial=0.0))

    @cached_property
    def hidden(self) -> np.ndarray:
        """Which poles belong to neutral modes that no judged coordinate shows, such as an integral that nothing reads."""
        return hidden_modes(self.dynamics, self.poles, self.judged)


@dataclass(frozen=True, eq=False)
class LoopMatrices:
    """Turns linearisations of plant and model into the loop's matrices; build it with `loop_matrices`.

    Args:
        function: (memory, disturbance) -> F, G, C over the whole memory.
        rest: the memory at rest.
        exact: places of the plant's linearisation in the memory.
        believed: places of the model's linearisation in the memory.
        state: places of the plant's state in the memory.
        period: of the control cycle.
        judged: numbers of the judged coordinates among the plant's states.
    """

    function: ca.Function
    rest: np.ndarray
    exact: slice
    believed: slice
    state: slice
    period: float
    judged: tuple[int, ...]

    def at(self, exact: np.ndarray, believed: np.ndarray) -> LinearLoop:
        """Return the loop of a plant and a model, both as `linear_parameters` returns them."""
        memory = self.rest.copy()
        memory[self.exact], memory[self.believed] = exact, believed
        f, g, c = (np.asarray(m.full()) for m in self.function(memory, np.zeros(self.function.size1_in(1))))
        moving = np.any(f != np.eye(len(f)), axis=1)
        moving[self.exact] = moving[self.believed] = False
        moving[self.state] = True
        used = _read(f, c, moving)
        used[self.state] = True
        state = np.cumsum(used)[self.state] - 1
        shown = state[list(self.judged)]
        return LinearLoop(f[np.ix_(used, used)], g[used], c[:, used], state, self.period, shown)


def _read(f: np.ndarray, c: np.ndarray, among: np.ndarray) -> np.ndarray:
    """Entries on which another entry or the command depends: an integral that no law reads is no mode of the loop."""
    used = among.copy()
    others = (f != 0) & ~np.eye(len(f), dtype=bool)
    while True:
        still_used = used & (others[used].any(axis=0) | (c != 0).any(axis=0))
        if (still_used == used).all():
            return used
        used = still_used


def response_slopes(plant: Plant) -> ca.Function:
    """Return the Function (state, input, parameters) -> A (n, nx), B (n, nu) of the responses."""
    x, u, p = plant.symbols()
    response = plant.response_function(x, u, p)
    slopes = [ca.densify(ca.jacobian(response, v)) for v in (x, u)]
    return ca.Function("fpirhc_slopes", [x, u, p], slopes)


def controlled_gain(
    plant: Plant, slopes: ca.Function, state: np.ndarray, command: np.ndarray, parameters: np.ndarray
) -> np.ndarray:
    """Return B (n, nu) of the controlled coordinates at a point; `slopes` are those of `response_slopes`."""
    return np.asarray(slopes(state, command, parameters)[1].full())[list(plant.controlled_indices)]


def linear_parameters(
    slopes: Slopes, state: np.ndarray, command: np.ndarray, parameters: np.ndarray, feedback: PlanGain
) -> np.ndarray:
    """Return the parameters of `linear_plant`: A and B of the responses at a point, and a plan's gains."""
    a, b = (np.asarray(m.full()) for m in slopes(state, command, parameters))
    return np.concatenate([a.ravel(), b.ravel(), feedback.entries])


def linear_plant(plant: Plant, sign: float) -> Plant:
    """Return a plant of the same coordinates and inputs whose parameters are the entries of A and B.

    The first n nx entries are A, the next B, the last those of a plan's feedback, which the plant itself does not use.
    Its own values are A = 0, and B = 1 on the controlled coordinates, times `sign` on the exact side.
    """
    n, nx, nu = len(plant.names), plant.state.size, len(plant.inputs)
    gain = np.zeros((n, nu))
    gain[list(plant.controlled_indices), range(nu)] = 1.0
    names = [f"a{k}" for k in range(n * nx)] + [f"b{k}" for k in range(n * nu)]
    names += [f"f{k}" for k in range(gain_entries(nx, nu))]
    values = np.concatenate([np.zeros(n * nx), gain.ravel(), np.zeros(gain_entries(nx, nu))])
    parameters = {name: Parameter(v, sign * v, "1") for name, v in zip(names, values, strict=True)}

    def response(*arguments: Named) -> Mapping[str, Expression]:
        *derivatives, u, p = arguments
        entries = p.vector
        by_name = {c + "'" * k: d[c] for k, d in enumerate(derivatives) for c in d}
        x = ca.vertcat(*(by_name[e] for e in plant.state.elements))
        a = ca.reshape(entries[: n * nx], nx, n).T
        b = ca.reshape(entries[n * nx : n * (nx + nu)], nu, n).T
        responses = a @ x + b @ u.vector
        return {c: responses[k] for k, c in enumerate(plant.names)}

    kind = inspect.Parameter.POSITIONAL_ONLY
    names = [f"d{k}" for k in range(max(plant.orders))] + ["u", "p"]
    vars(response)["__signature__"] = inspect.Signature([inspect.Parameter(name, kind) for name in names])
    order = dict(zip(plant.names, plant.orders, strict=True))
    names_and_units = plant.coordinates, plant.inputs, parameters, response, order, plant.controlled_names
    return Plant(*names_and_units, time_unit=plant.time_unit, step=cycle_of(plant))


def cycle_of(plant: Plant) -> float | None:
    """Return the step of a linear plant in place of a map: the control cycle; None for differential equations.

    Its responses are divided differences, y_{k+1} = y_k + T (A x + B u), so it is the map's own linearisation.
    """
    return None if plant.step is None else plant.sampling


def loop_matrices(problem: Problem, controller: Controller) -> LoopMatrices:
    """Return the loop of the problem's plants and the controller, to be evaluated at linearisations.

    Raises:
        FpirhcError: every error that the controller raises about a linear plant.
        NotSupported: a memory of too many entries; sensors of outputs.
    """
    steps = problem.sensing.estimator.of_steps and not problem.sensing.sensors and problem.sensing.belief is None
    if problem.plant.outputs and not problem.sensing.ideal and not steps:
        raise NotSupported("the linear loop behind sensors or estimators is not covered for outputs")
    if problem.plant.outputs and "output" in controller.feeds:
        raise NotSupported("the linear loop of predicted outputs is not covered: a wrong model predicts other outputs")
    if steps and max(problem.plant.face.orders) > 1:
        raise NotSupported(
            "the linear loop of a map is not covered for orders above 1, whose next outputs are predicted"
        )
    elements = straightened(problem).plant.state.elements
    judged = tuple(elements.index(c) for c in problem.judged_names if c in elements)
    return matrices_of(linear_problem(problem, controller), controller, judged)


def matrices_of(linear: Problem, controller: Controller, judged: tuple[int, ...]) -> LoopMatrices:
    """Return the loop of a problem whose plants are linear, around rest.

    Args:
        linear: from `linear_problem`, with a linear reality or without.
        controller: the controller.
        judged: numbers of the judged coordinates among the moving plant's states.

    Raises:
        FpirhcError: see `loop_matrices`.
    """
    loop = close_loop(linear, controller)
    if loop.memory.size > LARGEST:
        raise NotSupported(f"the loop remembers {loop.memory.size} numbers, more than {LARGEST}")
    names = loop.trace.names
    arriving = loop.trace.slice("arriving" if "arriving" in names else "command")
    z, w = ca.MX.sym("z", loop.memory.size), ca.MX.sym("w", len(linear.plant.inputs))
    next_memory, trace = loop.function(z, w)
    results = [ca.jacobian(next_memory, z), ca.jacobian(next_memory, w), ca.jacobian(trace[arriving], z)]
    function = ca.Function("fpirhc_loop_matrices", [z, w], [ca.densify(r) for r in results])
    exact, believed, state = (loop.memory.slice(name) for name in ("_exact", "parameters", "_state_before"))
    rest = _at_rest(loop.function, loop.memory.start())
    return LoopMatrices(function, rest, exact, believed, state, linear.period, judged)


def linear_problem(problem: Problem, controller: Controller) -> Problem:
    """Return the problem of the linear plants, at rest."""
    plant = linear_plant(straightened(problem).plant, -1.0 if controller.deformation.effective_gain() < 0 else 1.0)
    integrator = RungeKutta4() if problem.integrator.opaque else problem.integrator
    return Problem(
        plant=plant,
        reference=Trajectory(lambda t: dict.fromkeys(plant.names, 0 * t)),
        start=dict.fromkeys(plant.names, 0.0),
        period=problem.period,
        duration=problem.duration,
        disturbances={name: Step(at=0.0, size=0.0) for name in plant.inputs},
        dead_time=DeadTime(inputs=problem.dead_time.inputs, measurement=problem.dead_time.measurement),
        sensing=Sensing(estimator=problem.sensing.estimator),
        integrator=integrator,
        judged=plant.controlled_names,
    )


def _at_rest(function: ca.Function, start: np.ndarray) -> np.ndarray:
    """The memory after so many cycles at rest that every queue is full."""
    cycles = start.size + 2
    memories, _ = function.mapaccum("fpirhc_resting", cycles)(start, np.zeros((function.size1_in(1), cycles)))
    return np.asarray(memories.full())[:, -1]
