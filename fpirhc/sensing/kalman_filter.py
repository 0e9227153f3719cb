"""States that no sensor shows, by an extended Kalman filter with its covariance in memory.

Theory: docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from fpirhc.errors import Mistakes
from fpirhc.fields.kinds import Deviation
from fpirhc.plant.chain import quantities
from fpirhc.plant.plant import Plant
from fpirhc.sensing.base import Correct, Evidence, Model, Predict, Remembered, StateObserver, require_named, values_of
from fpirhc.symbolic.layout import Expression, Layout, Signal

_STATE, _COVARIANCE = "observer_state", "observer_covariance"


@dataclass(frozen=True, eq=False)
class KalmanFilter(StateObserver):
    """The whole state from noisy measurements of a part of it.

    Args:
        measured: quantity (q1, q1', q1'' ...) -> deviation of the noise of its sensor, in its unit. They are among
            `Sensing(measured=...)`.
        noise: coordinate -> deviation of what its response has beyond the model in every cycle, white, in the response's unit. It
            stands for disturbances and for what is wrong in the model: the larger, the more the filter trusts the sensors.
        start: state -> deviation of its first value; zero, that is known, where not named.

    Raises:
        InvalidValue: no measured quantity, no noise.
    """

    measured: Mapping[str, Deviation]
    noise: Mapping[str, Deviation]
    start: Mapping[str, Deviation] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_named("KalmanFilter", measured=self.measured, noise=self.noise)

    def check(self, plant: Plant, measured: tuple[str, ...]) -> None:
        """Raise where a name fits nothing, or no sensor shows a quantity."""
        mistakes, every = Mistakes("KalmanFilter"), quantities(plant)
        mistakes.unknown("measured: quantity", self.measured, every)
        for name in self.measured:
            if name in every and name not in measured:
                mistakes.add(f"measured: no sensor shows '{name}'; Sensing(measured=...) has {', '.join(measured)}")
        mistakes.unknown("noise: coordinate", self.noise, plant.coordinates)
        mistakes.unknown("start: state", self.start, plant.state.elements)
        mistakes.raise_if_any()

    def uses(self, measured: tuple[str, ...]) -> tuple[str, ...]:  # noqa: ARG002
        return tuple(self.measured)

    def memory(self, model: Model) -> Layout:
        """The believed state, and its covariance column by column."""
        state = model.plant.state
        first = np.diag([self.start.get(e, 0.0) ** 2 for e in state.elements])
        entries = tuple(f"{i},{j}" for j in state.elements for i in state.elements)
        return Layout(
            (
                Signal(_STATE, state.elements, state.units, tuple(map(float, model.start))),
                Signal(_COVARIANCE, entries, start=tuple(map(float, first.ravel()))),
            )
        )

    def predict(self, model: Model) -> Predict:
        calm = np.zeros(len(model.plant.names))

        def predicted(evidence: Evidence, memory: Remembered) -> Expression:
            return model.move(memory[_STATE], evidence.command, evidence.parameters, calm, evidence.moves)

        return predicted

    def correct(self, model: Model) -> Correct:
        spread, gain = self._spread_function(model), self._gain_function(model)
        white, noise = (np.square(list(one.values())) for one in (self.noise, self.measured))

        def corrected(
            evidence: Evidence, memory: Remembered, predicted: Expression
        ) -> tuple[Expression, dict[str, Expression]]:
            u, p, before = evidence.command, evidence.parameters, memory[_COVARIANCE]
            covariance_predicted = spread(memory[_STATE], before, u, p, evidence.moves, white)
            shown = ca.vertcat(*(evidence.measured[n] for n in self.measured))
            state, covariance = gain(predicted, covariance_predicted, u, p, shown, noise)
            state = ca.if_else(evidence.counts, state, predicted)
            covariance = ca.if_else(evidence.counts, covariance, covariance_predicted)
            return state, {_STATE: state, _COVARIANCE: covariance}

        return corrected

    def _spread_function(self, model: Model) -> ca.Function:
        """Function (state, covariance, input, parameters, share, variances of w) -> covariance of the prediction."""
        plant, size = model.plant, model.plant.state.size
        x, u, p = plant.symbols()
        w, before = ca.SX.sym("w", len(plant.names)), ca.SX.sym("P", size * size)
        share = ca.SX.sym("share")
        after, at = model.move(x, u, p, w, share), [x, u, p, w, share]
        jacobians = ca.Function("fpirhc_slopes", at, [ca.jacobian(after, x), ca.jacobian(after, w)])
        slope, effect = (ca.densify(m) for m in jacobians(x, u, p, ca.SX.zeros(w.numel()), share))
        white, effect = ca.SX.sym("white", len(self.noise)), effect[:, [plant.names.index(n) for n in self.noise]]
        spread = slope @ ca.reshape(before, size, size) @ slope.T + effect @ ca.diag(white) @ effect.T
        return ca.Function("fpirhc_spread", [x, before, u, p, share, white], [ca.densify(ca.vec(spread))])

    def _gain_function(self, model: Model) -> ca.Function:
        """Function (prediction, its covariance, input, parameters, measured, variances of these) -> (state, covariance)."""
        plant, size = model.plant, model.plant.state.size
        x, u, p = plant.symbols()
        y, column = ca.SX.sym("y", len(self.measured)), ca.SX.sym("P", size * size)
        covariance = ca.reshape(column, size, size)
        values = values_of(plant, x, u, p)
        expected = ca.vertcat(*(values[n] for n in self.measured))
        slope = ca.densify(ca.jacobian(expected, x))
        variances = ca.SX.sym("R", len(self.measured))
        noise = ca.diag(variances)
        innovation = slope @ covariance @ slope.T + noise
        gain = ca.solve(ca.densify(innovation), slope @ covariance).T
        rest = ca.SX.eye(size) - gain @ slope
        joseph = rest @ covariance @ rest.T + gain @ noise @ gain.T
        results = [x + gain @ (y - expected), ca.vec(joseph)]
        return ca.Function("fpirhc_kalman", [x, column, u, p, y, variances], [ca.densify(r) for r in results])


EXAMPLES = (KalmanFilter(measured={"a": 1e-3, "b": 1e-3}, noise={"a": 1.0, "b": 1.0}),)
