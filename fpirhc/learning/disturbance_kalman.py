"""A disturbance model with a Kalman filter: the estimator of offset-free predictive control.

Theory: docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from fpirhc.errors import InvalidProblem, Mistakes, NotSupported
from fpirhc.fields.kinds import Deviation
from fpirhc.learning.estimators import Correct, ParameterEstimator, Seen
from fpirhc.plant.chain import disturbance_name, disturbed, quantities, response_names
from fpirhc.plant.integrators import USUAL
from fpirhc.plant.motion import controlled_places
from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import require_named, values_of
from fpirhc.symbolic.evaluate import Latest
from fpirhc.symbolic.expression import expression
from fpirhc.symbolic.layout import Expression, Layout, Signal
from fpirhc.task.problem import Problem

_GAINS: Latest[np.ndarray] = Latest(8)
_SLOWEST = 1e-9  # decay per cycle below which a mode of the filter counts as undamped


@dataclass(frozen=True, eq=False)
class DisturbanceKalman(ParameterEstimator):
    """Estimate constant or slowly drifting disturbances of responses.

    Only ratios of the deviations matter. With the noise s of one measured quantity, n - 1 integrators below its response, the
    period T of its samples and the drift D the bandwidth is (D^2 / (s^2 T))^(1 / 2n); behind a dead time of tau it must stay below
    1 / tau. A deviation of exact states is a tuning: the larger the drift, the faster and the noisier the estimate.

    Args:
        drift: coordinate -> deviation of the change of its disturbance in one second, response unit / s^0.5. Of a plant with
            outputs also output (y), for a disturbance that adds to it, or response of an output (y'' for order 2), for one that
            adds to the response alone, which is what a deformation sees.
        measured: state (q1, q1', ...), output (y, y', ...) or response (q1'' for order 2) -> deviation of its measurement noise, in
            its unit. A response shows its disturbance at once, and a deformation reads it too. Behind dead time or an estimator,
            and on maps, the whole filter is as late as the response. Of responses alone the filter has no state of its own: it
            evaluates the model at the measured one, and moves the disturbance by the gain L times the innovation, as a
            model-referenced deformation of gain L does.
        noise: coordinate -> deviation of the white noise of its response in every cycle; zero where not named.

    Raises:
        InvalidValue: no disturbance or no measured state.
    """

    drift: Mapping[str, Deviation]
    measured: Mapping[str, Deviation]
    noise: Mapping[str, Deviation] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_named("DisturbanceKalman", drift=self.drift, measured=self.measured)

    def model(self, plant: Plant) -> Plant:
        return disturbed(plant, tuple(self.drift))

    def learned(self) -> tuple[str, ...]:
        return tuple(disturbance_name(c) for c in self.drift)

    def reads_outputs(self, plant: Plant) -> bool:
        return any(n in plant.output.elements and n not in plant.state.elements for n in self.measured)

    def reads_response(self, plant: Plant) -> bool:
        return bool(self._responses(plant))

    def check(self, problem: Problem) -> None:
        """Raise if names do not fit the plant, or what is measured does not determine the disturbances.

        Raises:
            InvalidProblem: unknown names; more disturbances than measured quantities.
            NotSupported: the rank condition is not met, or no stationary gain exists.
        """
        mistakes = Mistakes("DisturbanceKalman")
        mistakes.unknown("measured: state, output or response", self.measured, quantities(problem.plant))
        mistakes.unknown("noise: coordinate", self.noise, problem.plant.coordinates)
        mistakes.raise_if_any()
        self._check_rank(problem)
        self.gain(problem)

    def gain(self, problem: Problem) -> np.ndarray:
        """Return the stationary gain [K_x; K_w], shape (nx + nw, ny); `problem.plant` is the model with disturbances.

        Raises:
            NotSupported: the Riccati equation has no stabilising solution.
        """
        return _GAINS.of((self, problem), (), lambda: self._gain(problem)).copy()

    def _gain(self, problem: Problem) -> np.ndarray:
        import scipy.linalg

        a, noise_input, c = self._matrices(problem)
        model, used = problem.plant, self._corrected(problem, a, c)
        noise = np.array([self.noise.get(n, 0.0) for n in model.names])
        walk = problem.period * np.array(list(self.drift.values())) ** 2
        q = scipy.linalg.block_diag((noise_input * noise**2) @ noise_input.T, np.diag(walk))
        deviation = np.array(list(self.measured.values()))
        gain = np.zeros((model.state.size + len(self.drift), len(self.measured)))
        a, c, q = a[np.ix_(used, used)], c[:, used], q[np.ix_(used, used)]
        # In units of their deviations: variances 1e17 apart leave the Riccati solver without a digit.
        scaled, one = c / deviation[:, None], np.eye(len(deviation))
        try:
            with np.errstate(all="ignore"):  # what overflows is no stable filter, below
                p = scipy.linalg.solve_discrete_are(a.T, scaled.T, q, one)
                own = np.linalg.solve(scaled @ p @ scaled.T + one, scaled @ p).T / deviation
        except ValueError:  # LinAlgError is one, and deviations 1e100 apart make numbers that are not finite
            own = np.full((len(a), len(self.measured)), np.nan)
        gain[used] = own
        if not (
            np.isfinite(own).all() and np.abs(np.linalg.eigvals((np.eye(len(a)) - own @ c) @ a)).max() < 1 - _SLOWEST
        ):
            noiseless = [n for n in model.names if n not in self.drift and n not in self.noise]
            hint = (
                f"give noise={{{noiseless[0]!r}: ...}}, or measure more states"
                if noiseless
                else "choose a larger drift beside the deviations of what is measured, or measure more states"
            )
            raise NotSupported(f"DisturbanceKalman: no stationary gain makes the filter stable; {hint}")
        return np.asarray(gain)

    def memory(self, problem: Problem) -> Layout:
        model = problem.plant
        units = tuple(model.parameters[n].unit for n in self.learned())
        return Layout(
            (
                Signal("observed_state", model.state.elements, model.state.units),
                Signal("observed_disturbance", self.learned(), units),
            )
        )

    def step(self, problem: Problem) -> Correct:
        model = problem.plant
        advance, no_forcing = USUAL.step(model, problem.period), ca.DM.zeros(len(model.names))
        gain = expression(ca.DM(self.gain(problem)))
        shown, follows = self._shown_function(model), self._has_state(model)
        # A map's response is to the command that acts after the state, so the next state is remembered.
        foresees = bool(self._responses(model)) and model.response_age > 0
        places = [model.parameter.elements.index(n) for n in self.learned()]

        def disturbed_by(disturbance: Expression, seen: Seen) -> Expression:
            parameters = seen.parameters + 0
            parameters[places] += disturbance
            return parameters

        def correct(seen: Seen, memory: Mapping[str, Expression]) -> tuple[Expression, dict[str, Expression]]:
            before, observed = memory["observed_disturbance"], memory["observed_state"]
            predicted = seen.state if not follows else observed
            if follows and not foresees:
                predicted = advance(observed, seen.command, disturbed_by(before, seen), no_forcing)
            innovation = self._measured(model, seen) - shown(predicted, seen.command, disturbed_by(before, seen))
            on_state, on_disturbance = gain[: model.state.size, :], gain[model.state.size :, :]
            running = seen.valid > 0.5
            state = ca.if_else(running, predicted + on_state @ innovation, seen.state)
            disturbance = ca.if_else(running, before + on_disturbance @ innovation, 0)
            if foresees:
                later = advance(state, seen.command, disturbed_by(disturbance, seen), no_forcing)
                state = ca.if_else(running, later, seen.state)
            return disturbance, {"observed_state": state, "observed_disturbance": disturbance}

        return correct

    def _responses(self, plant: Plant) -> tuple[str, ...]:
        return tuple(n for n in self.measured if n in response_names(plant))

    def _measured(self, model: Plant, seen: Seen) -> Expression:
        states = {e: seen.state[k] for k, e in enumerate(model.state.elements)}
        responses = {e: seen.response[k] for k, e in enumerate(response_names(model))}
        outputs = {} if seen.output is None else {e: seen.output[k] for k, e in enumerate(model.output.elements)}
        return ca.vertcat(*({**outputs, **states, **responses}[name] for name in self.measured))

    def _shown_function(self, model: Plant) -> ca.Function:
        """Function (state, command that acted, parameters) -> the measured quantities."""
        at = model.symbols()
        values = values_of(model, *at)
        shown = ca.vertcat(*(values[n] for n in self.measured))
        return ca.Function("fpirhc_shown", list(at), [ca.densify(shown)])

    def _matrices(self, problem: Problem) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A of state and disturbances over one period, the effect of response noise on the state, and C."""
        model = problem.plant
        x, u, p = model.symbols()
        w = ca.SX.sym("w", len(model.names))
        x_next = USUAL.step(model, problem.period)(x, u, p, w)
        function = ca.Function("fpirhc_linear", [x, u, p, w], [ca.jacobian(x_next, x), ca.jacobian(x_next, w)])
        a, b = (np.asarray(m.full()) for m in function(*_operating_point(problem), np.zeros(len(model.names))))
        effects = dict(zip(model.names, b.T, strict=True))  # that of an output is on what is measured alone
        disturbance_input = np.column_stack([effects.get(n, np.zeros(len(a))) for n in self.drift])
        augmented = np.eye(len(a) + len(self.drift))  # a disturbance stays
        augmented[: len(a)] = np.hstack([a, disturbance_input])
        shown = self._shown_function(model)(x, u, p)
        places = [model.parameter.elements.index(n) for n in self.learned()]
        slopes = ca.Function(
            "fpirhc_seen", [x, u, p], [ca.horzcat(ca.jacobian(shown, x), ca.jacobian(shown, p)[:, places])]
        )
        return augmented, b, np.asarray(slopes(*_operating_point(problem)).full())

    def _check_rank(self, problem: Problem) -> None:
        measured, disturbances = ", ".join(self.measured), ", ".join(self.learned())
        if len(self.drift) > len(self.measured):
            raise InvalidProblem(
                f"DisturbanceKalman: {len(self.drift)} disturbances ({disturbances}) need as many measured quantities, and there "
                f"{'is' if len(self.measured) == 1 else 'are'} {len(self.measured)} ({measured}): measure more, or estimate fewer"
            )
        rank, needed = self._rank(problem)
        if rank < needed:
            others = [n for n in quantities(problem.plant) if n not in self.measured]
            helping = [n for n in others if np.equal(*replace(self, measured={**self.measured, n: 1.0})._rank(problem))]
            raise NotSupported(
                f"DisturbanceKalman: a constant {disturbances} cannot be determined from {measured}: [A - I, B; C, D] has rank "
                f"{rank} and needs {needed} (Pannocchia and Rawlings 2003); "
                + (f"measure {' or '.join(helping)} too" if helping else "estimate fewer disturbances")
            )

    def _rank(self, problem: Problem) -> tuple[int, int]:
        """The rank of [A - I; C] of what the filter corrects, and the one that it needs."""
        a, _, c = self._matrices(problem)
        used = self._corrected(problem, a, c)
        return _rank(a[np.ix_(used, used)], c[:, used]), int(used.sum())

    def _corrected(self, problem: Problem, a: np.ndarray, c: np.ndarray) -> np.ndarray:
        """Which states and disturbances the filter corrects, shape (nx + nw,); no state where it has the measured one."""
        if self._has_state(problem.plant):
            return self._used(problem, a, c)
        return np.arange(len(a)) >= problem.plant.state.size

    def _has_state(self, plant: Plant) -> bool:
        """Whether the filter follows the state: unless it measures responses alone."""
        return len(self._responses(plant)) < len(self.measured)

    def _used(self, problem: Problem, a: np.ndarray, c: np.ndarray) -> np.ndarray:
        """Which states and disturbances the filter corrects, shape (nx + nw,): all, where the measured states determine all.

        Else those on which a measured state depends, if all disturbances are among them. The other states must be neutral or decay,
        and nobody may judge them: the amount of a drug that has left the body follows from the model.
        """
        everything = np.ones(len(a), dtype=bool)
        if _rank(a, c) == len(a):
            return everything
        used, pattern = (c != 0).any(axis=0), a != 0
        while (grown := used | pattern[used].any(axis=0)).sum() > used.sum():
            used = grown
        plant, (x, u, p) = problem.plant, problem.plant.symbols()
        values = plant.equations.output(x, u, p, ca.DM.zeros(len(plant.names)))
        shown = values[[plant.output.elements.index(n) for n in problem.judged_names]]
        judged = [*set(ca.jacobian_sparsity(shown, x).get_triplet()[1]), *range(plant.state.size, len(a))]
        rest = a[np.ix_(~used, ~used)]
        harmless = used[judged].all() and np.abs(np.linalg.eigvals(rest)).max(initial=0.0) < 1 + _SLOWEST
        return used if harmless else everything


def _rank(a: np.ndarray, c: np.ndarray) -> int:
    """Rank of [A - I; C], the same in all units."""
    stacked = _balanced(np.vstack([a - np.eye(len(a)), c]))
    rows = np.abs(stacked).max(axis=1) > 0
    return int(np.linalg.matrix_rank(stacked[rows] / np.abs(stacked[rows]).max(axis=1, keepdims=True), tol=1e-9))


def _balanced(matrix: np.ndarray) -> np.ndarray:
    """The matrix with rows and columns scaled so that its entries are as near to one as they can be (Curtis and Reid 1972).

    Largest entries of size one in every row and column do not suffice: an entry beside a larger one may still be any unit's.
    """
    rows, columns = np.nonzero(matrix)
    entries, height = np.arange(len(rows)), len(matrix)
    belongs = np.zeros((len(rows), height + matrix.shape[1]))
    belongs[entries, rows] = belongs[entries, height + columns] = 1.0
    sizes = np.linalg.lstsq(belongs, np.log(np.abs(matrix[rows, columns])), rcond=None)[0]
    return np.asarray(matrix * np.exp(-sizes[:height, None] - sizes[None, height:]))


def _operating_point(problem: Problem) -> tuple[ca.DM, ca.DM, np.ndarray]:
    """State, input and parameters of the model on the reference at t = 0; states without a reference are those of the start."""
    plant = problem.plant
    seen, response = problem.reference.function(plant)(0.0)
    state = plant.equations.state_of(seen, ca.DM(problem.start_state))
    if plant.controlled is None and len(plant.inputs) != len(plant.chains):
        return state, ca.DM.zeros(len(plant.inputs)), plant.approximate
    needed = plant.equations.inverse(state, response[controlled_places(plant)], plant.approximate)
    return state, needed, plant.approximate


_NOISE = dict.fromkeys(("a", "b", "a'", "b'"), 1e-3)
EXAMPLES = (DisturbanceKalman({"a": 1.0, "b": 1.0}, _NOISE),)
