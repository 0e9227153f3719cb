"""A disturbance model with a Kalman filter: the estimator of offset-free predictive control.

The model's responses are believed to have unknown disturbances that drift as random walks, seen through measured states,

    q_i^(r_i) = f^_i(q, ..., u) + w_i + n_i,      w_i' = white noise,      y = C x + white noise.

The state and the disturbances are estimated together: the nonlinear model predicts over one period, the stationary gain of
the Kalman filter of the model linearised on the reference at t = 0 corrects,

    x- = F(x^, u, w^),      x^ = x- + K_x (y - C x-),      w^ <- w^ + K_w (y - C x-).

A constant disturbance is found without error, whatever the tuning, if [A - I, B; C, 0] has full column rank (B: what the
disturbances do to the state), which needs at least as many measured states as disturbances; otherwise the filter is
refused.

References: G. Pannocchia and J. B. Rawlings, Disturbance models for offset-free model-predictive control, AIChE Journal
49(2), 2003. M. Morari and U. Maeder, Nonlinear offset-free model predictive control, Automatica 48(9), 2012.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidValue, Mistakes, NotSupported
from fpirhc.learning.estimators.base import Correct, Estimator, Seen
from fpirhc.learning.estimators.disturbed import disturbance_name, disturbed
from fpirhc.learning.estimators.uncertain import require_positive
from fpirhc.plant.integrators import RungeKutta4
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.task.problem import Problem

_SLOWEST = 1e-9  # a mode of the filter that decays by less per cycle does not decay


@dataclass(frozen=True, eq=False)
class DisturbanceKalman(Estimator):
    """Estimate constant or slowly drifting disturbances of responses.

    Only ratios of the deviations matter. Those of the measurement are a tuning where the controller is given exact states:
    the larger the drift, the faster and the noisier the estimate.

    Parameters:
        drift: coordinate -> by how much the disturbance of its response wanders in one second, response unit / s^0.5.
        measured: state (q1, q1', ...) -> deviation of its measurement noise, in its unit.
        noise: coordinate -> deviation of the white noise of its response, drawn in every cycle; none where not named.

    Raises:
        InvalidValue: no disturbance, nothing measured, or a deviation that is not positive.
    """

    drift: Mapping[str, float]
    measured: Mapping[str, float]
    noise: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, values in (("drift", self.drift), ("measured", self.measured)):
            if not values:
                raise InvalidValue(f"DisturbanceKalman({name}={{}}): name at least one")
        for name in ("drift", "measured", "noise"):
            require_positive(f"DisturbanceKalman.{name}", getattr(self, name))

    def model(self, plant: Plant) -> Plant:
        """The plant with the disturbances as parameters."""
        return disturbed(plant, tuple(self.drift))

    def learned(self) -> tuple[str, ...]:
        """The disturbances."""
        return tuple(disturbance_name(c) for c in self.drift)

    def check(self, problem: Problem) -> None:
        """Raise if names do not fit the plant, or the disturbances cannot be told from what is measured.

        Raises:
            InvalidProblem: unknown names. NotSupported: the rank condition is not met, or no stationary gain exists.
        """
        mistakes = Mistakes("DisturbanceKalman")
        mistakes.unknown("measured: state", self.measured, problem.plant.state.elements)
        mistakes.unknown("noise: coordinate", self.noise, problem.plant.coordinates)
        mistakes.raise_if_any()
        self._check_rank(problem)
        self.gain(problem)

    def gain(self, problem: Problem) -> np.ndarray:
        """Return the stationary gain [K_x; K_w], shape (nx + nw, ny); `problem.plant` is the model with disturbances.

        Raises:
            NotSupported: the Riccati equation has no stabilising solution.
        """
        import scipy.linalg

        a, agitation, c = self._matrices(problem)
        model, size = problem.plant, len(self.drift)
        unrest = np.array([self.noise.get(n, 0.0) for n in model.names])
        walk = problem.period * np.array(list(self.drift.values())) ** 2
        q = scipy.linalg.block_diag((agitation * unrest**2) @ agitation.T, np.diag(walk))
        r = np.diag(np.array(list(self.measured.values())) ** 2)
        try:
            p = scipy.linalg.solve_discrete_are(a.T, c.T, q, r)
            found = np.linalg.solve(c @ p @ c.T + r, c @ p).T
        except np.linalg.LinAlgError:
            found = np.full((model.state.size + size, len(self.measured)), np.nan)
        if not (
            np.isfinite(found).all()
            and np.abs(np.linalg.eigvals((np.eye(len(a)) - found @ c) @ a)).max() < 1 - _SLOWEST
        ):
            still = [n for n in model.names if n not in self.drift and n not in self.noise]
            hint = f"give noise={{{still[0]!r}: ...}}, or measure more states" if still else "measure more states"
            raise NotSupported(f"DisturbanceKalman: no stationary gain makes the filter stable; {hint}")
        return np.asarray(found)

    def memory(self, problem: Problem) -> Layout:
        """The estimated state and disturbances."""
        model = problem.plant
        units = [model.parameters[n].unit for n in self.learned()]
        return Layout(
            (
                Signal("observed_state", model.state.elements, model.state.units),
                Signal("observed_disturbance", self.learned(), tuple(units)),
            )
        )

    def step(self, problem: Problem) -> Correct:
        """Predict and correct."""
        model = problem.plant
        advance, calm = RungeKutta4().step(model, problem.period), ca.DM.zeros(len(model.names))
        gain = self.gain(problem)
        on_state, on_disturbance = ca.DM(gain[: model.state.size]), ca.DM(gain[model.state.size :])
        seen_places = [model.state.elements.index(e) for e in self.measured]
        places = [model.parameter.elements.index(n) for n in self.learned()]

        def correct(seen: Seen, memory: Mapping[str, Expression]) -> tuple[Expression, dict[str, Expression]]:
            believed = seen.parameters + 0
            believed[places] += memory["observed_disturbance"]
            ahead = advance(memory["observed_state"], seen.command, believed, calm)
            surprise = (seen.state - ahead)[seen_places]
            begun = seen.valid > 0.5
            state = ca.if_else(begun, ahead + on_state @ surprise, seen.state)
            disturbance = ca.if_else(begun, memory["observed_disturbance"] + on_disturbance @ surprise, 0)
            return disturbance, {"observed_state": state, "observed_disturbance": disturbance}

        return correct

    def _matrices(self, problem: Problem) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A of state and disturbances over one period, what response noise does to the state, and C."""
        model = problem.plant
        x, u, p = model._symbols()
        w = ca.SX.sym("w", len(model.names))
        following = RungeKutta4().step(model, problem.period)(x, u, p, w)
        function = ca.Function("fpirhc_linear", [x, u, p, w], [ca.jacobian(following, x), ca.jacobian(following, w)])
        a, b = (np.asarray(m.full()) for m in function(*_operating_point(problem), np.zeros(len(model.names))))
        disturbs = b[:, [model.names.index(c) for c in self.drift]]
        size = len(self.drift)
        augmented = np.block([[a, disturbs], [np.zeros((size, a.shape[1])), np.eye(size)]])
        c = np.zeros((len(self.measured), augmented.shape[1]))
        c[np.arange(len(c)), [model.state.elements.index(e) for e in self.measured]] = 1
        return augmented, b, c

    def _check_rank(self, problem: Problem) -> None:
        measured, disturbances = ", ".join(self.measured), ", ".join(self.learned())
        if len(self.drift) > len(self.measured):
            raise NotSupported(
                f"DisturbanceKalman: {len(self.drift)} disturbances ({disturbances}) cannot be found from "
                f"{len(self.measured)} measured state(s) ({measured}): measure as many, or estimate fewer"
            )
        a, _, c = self._matrices(problem)
        stacked = np.vstack([a - np.eye(len(a)), c])
        rows = np.abs(stacked).max(axis=1) > 0
        rank = int(np.linalg.matrix_rank(stacked[rows] / np.abs(stacked[rows]).max(axis=1, keepdims=True), tol=1e-9))
        if rank < len(a):
            raise NotSupported(
                f"DisturbanceKalman: a constant {disturbances} cannot be told from {measured}: [A - I, B; C, 0] has rank "
                f"{rank} and needs {len(a)} (Pannocchia and Rawlings 2003); measure another state, or disturb the response "
                "of a coordinate that acts on what is measured"
            )


def _operating_point(problem: Problem) -> tuple[ca.DM, ca.DM, np.ndarray]:
    """State, input and parameters of the model on the reference at t = 0."""
    plant = problem.plant
    state, response = problem.reference.function(plant)(0.0)
    if plant.controlled is None and len(plant.inputs) != len(plant.names):
        return state, ca.DM.zeros(len(plant.inputs)), plant.approximate
    needed = plant.inverse_function(state, response[list(plant.controlled_indices)], plant.approximate)
    return state, needed, plant.approximate


EXAMPLES = (DisturbanceKalman({"a": 1.0, "b": 1.0}, dict.fromkeys(("a", "b", "a'", "b'"), 1e-3)),)
