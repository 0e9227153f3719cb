"""Nonlinear predictive control of outputs in a few lines of its own: CasADi's Opti and IPOPT, and a plant that is moved here.

What it takes from a problem is what its author wrote: equations, parameters, limits, weights and times. Nothing that the library
computes is used: no Lie derivatives, integrators, horizons, loops or measures. So it judges them.

    min  sum_{i<N} h [w (y_i + d - r_i)^2 + w_u (u_i - u_{i-1})^2] + h w (y_N + d - r_N)^2,    x_{i+1} = F(x_i, u_i)

y, w may stand for several outputs and their derivatives. d is the distance of the measured outputs from the model's, held over the
horizon; that of their derivatives is left out. The first input is held for one stage.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from types import SimpleNamespace

import casadi as ca
import numpy as np

import fpirhc as fp

FINE = 10  # Runge-Kutta steps of the plant in a control cycle


@dataclass(frozen=True)
class Record:
    """A run: times (K), controlled outputs less their references (K, ny), commands (K, nu), whether each plan converged."""

    times: np.ndarray
    errors: np.ndarray
    commands: np.ndarray
    converged: np.ndarray


def equations(problem: fp.Problem, *, exact: bool) -> tuple[ca.Function, ca.Function]:
    """Functions (x, u) -> x' and x -> y, y', ... in the order of the cost's weights, with one set of parameters."""
    plant = problem.plant
    p = SimpleNamespace(**{n: q.exact if exact else q.approximate for n, q in plant.parameters.items()})
    x, u = ca.SX.sym("x", len(plant.coordinates)), ca.SX.sym("u", len(plant.inputs))
    states, inputs = (
        SimpleNamespace(**dict(zip(names, ca.vertsplit(s), strict=True)))
        for names, s in ((plant.coordinates, x), (plant.inputs, u))
    )
    by_name = plant.response(states, inputs, p)
    rate = ca.vertcat(*(by_name[n] for n in plant.coordinates))
    rows = []
    for weighed in problem.cost.outputs:
        y = plant.outputs[weighed.rstrip("'")].expression(states, p)
        for _ in range(weighed.count("'")):
            y = ca.jtimes(y, x, rate)
        rows.append(ca.substitute(ca.SX(y), u, 0))
    return ca.Function("rate", [x, u], [rate]), ca.Function("outputs", [x], [ca.vertcat(*rows)])


def runge_kutta(rate: ca.Function, time: float, steps: int) -> ca.Function:
    """Function (x, u) -> x after some time, by classical steps."""
    x, u = ca.SX.sym("x", rate.size1_in(0)), ca.SX.sym("u", rate.size1_in(1))
    h, z = time / steps, x
    for _ in range(steps):
        k1 = rate(z, u)
        k2 = rate(z + h / 2 * k1, u)
        k3 = rate(z + h / 2 * k2, u)
        z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(z + h * k3, u))
    return ca.Function("moved", [x, u], [z])


def wanted(problem: fp.Problem) -> ca.Function:
    """Function t -> the references of what the cost weighs."""
    t = ca.SX.sym("t")
    motion, rows = problem.reference.coordinates(t), []
    for weighed in problem.cost.outputs:
        r = ca.SX(motion[weighed.rstrip("'")])
        for _ in range(weighed.count("'")):
            r = ca.jacobian(r, t)
        rows.append(r)
    return ca.Function("wanted", [t], [ca.vertcat(*rows)])


class Plan:
    """The optimal control problem of one model, solved again and again from the last plan."""

    def __init__(self, problem: fp.Problem, *, exact: bool) -> None:
        horizon, cost = problem.horizon, problem.cost
        rate, self.outputs = equations(problem, exact=exact)
        self.states, inputs, stages, h = rate.size1_in(0), rate.size1_in(1), horizon.stages, horizon.step
        advance = runge_kutta(rate, h, horizon.discretisation.substeps)
        self.lower, self.upper = np.array([problem.limits.inputs[n] for n in problem.plant.inputs]).T
        unit, weights = 0.5 * (self.upper - self.lower), ca.DM(list(cost.outputs.values()))
        changes = ca.DM([cost.rate[n] for n in problem.plant.inputs])
        opti = self.opti = ca.Opti()
        self.x, self.v = opti.variable(self.states, stages + 1), opti.variable(inputs, stages)
        u = ca.diag(unit) @ self.v
        self.start, self.before = opti.parameter(self.states), opti.parameter(inputs)
        self.reference = opti.parameter(weights.numel(), stages + 1)
        total = 0
        opti.subject_to(self.x[:, 0] == self.start)
        for i in range(stages + 1):
            total += h * ca.dot(weights, (self.outputs(self.x[:, i]) - self.reference[:, i]) ** 2)
            if i < stages:
                opti.subject_to(self.x[:, i + 1] == advance(self.x[:, i], u[:, i]))
                opti.subject_to(opti.bounded(self.lower / unit, self.v[:, i], self.upper / unit))
                total += h * ca.dot(changes, (u[:, i] - (u[:, i - 1] if i else self.before)) ** 2)
        opti.minimize(total / (h * float(np.max(np.array(changes).ravel() * unit**2))))  # IPOPT's accuracy is absolute
        quiet = {"print_level": 0, "sb": "yes", "tol": 1e-9, "max_iter": 300}
        opti.solver("ipopt", {"expand": True, "print_time": False, "error_on_fail": False}, quiet)
        self.unit, self.guess = unit, None

    def __call__(self, x: np.ndarray, before: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, bool]:
        """Return the first input of the plan, and whether IPOPT called the plan optimal."""
        opti = self.opti
        if self.guess is None:
            self.guess = np.tile(x[:, None], self.x.shape[1]), np.tile((before / self.unit)[:, None], self.v.shape[1])
        for symbol, value in ((self.start, x), (self.before, before), (self.reference, reference)):
            opti.set_value(symbol, value)
        opti.set_initial(self.x, self.guess[0])
        opti.set_initial(self.v, self.guess[1])
        with suppress(RuntimeError):  # the status says it
            opti.solve_limited()
        xs, vs = (np.asarray(opti.debug.value(s)).reshape(s.shape) for s in (self.x, self.v))
        self.guess = np.c_[xs[:, 1:], xs[:, -1:]], np.c_[vs[:, 1:], vs[:, -1:]]
        return np.clip(self.unit * vs[:, 0], self.lower, self.upper), bool(opti.stats()["success"])


def own_run(problem: fp.Problem, *, exact: bool = False, duration: float | None = None) -> Record:
    """Control the plant by plans of the approximate model, or of the exact one, for `duration`."""
    plant, horizon = problem.plant, problem.horizon
    plan, reference = Plan(problem, exact=exact), wanted(problem)
    rate, real = equations(problem, exact=True)
    move = runge_kutta(rate, problem.period, FINE)
    cycles, held = round((duration or problem.duration) / problem.period), round(horizon.step / problem.period)
    below = [k for k, weighed in enumerate(problem.cost.outputs) if not weighed.endswith("'")]
    x = np.array([problem.start[n] for n in plant.coordinates], dtype=float)
    u = np.array([problem.input_before.get(n, 0.0) for n in plant.inputs], dtype=float)
    errors, commands, converged = [], [], []
    for k in range(cycles):
        t = k * problem.period
        y = real(x).full().ravel()
        if k % held == 0:
            nodes = np.hstack([reference(t + i * horizon.step).full() for i in range(horizon.stages + 1)])
            offset = y - plan.outputs(x).full().ravel()
            nodes[below] -= offset[below, None]
            u, ok = plan(x, u, nodes)
            converged.append(ok)
        errors.append((y - reference(t).full().ravel())[below])
        commands.append(u)
        x = move(x, u).full().ravel()
    return Record(problem.period * np.arange(cycles), np.array(errors), np.array(commands), np.array(converged))
