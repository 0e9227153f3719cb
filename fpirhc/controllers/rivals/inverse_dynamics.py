"""Laws on the model's inverse: what they feed back of the measured response, or ask of it. Theory: docs/theory.md."""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca

from fpirhc.controllers.base import closing_blocks, invert_block, nominal_blocks, reference_block, tracked_blocks
from fpirhc.controllers.built import Built
from fpirhc.controllers.contract import OfDerivatives, Undeformed
from fpirhc.errors import Mistakes
from fpirhc.fields.kinds import NotNegative, Positive
from fpirhc.members import Example
from fpirhc.plant.maps import check_modes
from fpirhc.plant.motion import controlled_places
from fpirhc.plant.plant import Plant
from fpirhc.symbolic.block import Block, Delay
from fpirhc.symbolic.expression import Signals, is_finite, left_after, power
from fpirhc.symbolic.layout import Expression, Layout, like, scalar, vector
from fpirhc.task.problem import Problem
from fpirhc.tracking.base import Tracking, decay_gains, error_chains


@dataclass(frozen=True)
class AccelerationFeedback(Undeformed):
    """Inverse dynamics of q^Des + kappa (q^Des - q^(n)), with the measured response q^(n).

    Args:
        tracking: the law that gives the desired response.
        gain: kappa, dimensionless; the loop is stable for kappa lambda_max(J) below (1 + p) / (1 - p), p the pole of the low-pass.
        time_constant: of the low-pass on the response error, s; 0: no low-pass.
    """

    tracking: Tracking
    gain: Positive
    time_constant: NotNegative = 0.0

    def pole(self, period: float) -> float:
        """Return the pole p of the low-pass for control cycles of that period, s."""
        return left_after(period, self.time_constant)

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        return tracked_blocks(built, self.tracking, self._feedback_block(built), invert_block(built.plant))

    def _feedback_block(self, built: Built) -> Block:
        """Block (desired, realised) -> request; before the first response the request is the desired response."""
        plant, pole, warm_up_cycles = built.plant, self.pole(built.period), built.warm_up
        memory = Layout((plant.response_signal("filtered_error"),))

        def step(s: Signals) -> dict[str, Expression]:
            error = pole * s.filtered_error + (1 - pole) * (s.realised - s.desired)
            # A measurement that is not finite must not stay in the filter.
            running = s.warm_up > warm_up_cycles - 0.5
            usable = ca.logic_and(running, is_finite(error))
            request = s.desired - self.gain * ca.if_else(running, error, 0)
            return {"_deformed_unclipped": request, "filtered_error_next": ca.if_else(usable, error, s.filtered_error)}

        reads = (plant.response_signal("desired"), plant.response_signal("realised"), scalar("warm_up"))
        return Block("feedback", Layout(reads), Layout((plant.response_signal("_deformed_unclipped"),)), step, memory)


_DAMPING = 0.55  # zeta of the low-pass


@dataclass(frozen=True)
class INDI(Undeformed):
    """Increments of the command by the model's input gain. Dead time is not compensated.

    Args:
        tracking: the law that gives the desired response.
        frequency: w of the low-pass on command and response, rad/s, with a damping of 0.55; None: no filter.
    """

    tracking: Tracking
    frequency: Positive | None = None

    def notes(self, problem: Problem) -> tuple[str, ...]:
        age = problem.dead_time.longest
        text = f"INDI takes a response for that of the last command, and it is that of a command {age:.3g} {problem.time_unit} "
        return (f"{text}older: dead time is not compensated",) if age else ()

    def filter(self, period: float) -> tuple[float, float]:
        """Return (c_1, c_2) of H for cycles of that period: y_k = (1 - c_1 - c_2) x_k + c_1 y_{k-1} + c_2 y_{k-2}."""
        assert self.frequency is not None
        decay = ca.exp(-_DAMPING * self.frequency * period)
        return 2 * decay * ca.cos(self.frequency * period * ca.sqrt(1 - _DAMPING * _DAMPING)), -decay * decay

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        return tracked_blocks(built, self.tracking, self._increment_block(built))

    def _increment_block(self, built: Built) -> Block:
        """Block (state, last command, realised, desired) -> command; before the first response it is the model's inverse."""
        plant, warm_up_cycles = built.plant, built.warm_up
        gain, response, inverse = (
            plant.equations.input_gain,
            plant.equations.controlled_response,
            plant.equations.inverse,
        )
        both = (("filtered_command", plant.input), ("filtered_response", plant.response_signal("_")))
        pairs = [like(signal, name + late) for name, signal in both for late in ("", "_before")]
        memory = Layout((*pairs, scalar("filter_begun"))) if self.frequency is not None else Layout()

        def filtered(s: Signals, running: Expression) -> tuple[dict[str, Expression], dict[str, Expression]]:
            """Command and response behind the filter, which begins settled, and what it remembers."""
            now = {"filtered_command": s._command_before, "filtered_response": s.realised}
            if self.frequency is None:
                return now, {}
            values, begun, (first, second) = {}, s.filter_begun > 0.5, self.filter(built.period)
            for name, x in now.items():
                last, before = getattr(s, name), getattr(s, f"{name}_before")
                values[name] = ca.if_else(begun, (1 - first - second) * x + first * last + second * before, x)
            usable = ca.logic_and(is_finite(ca.vertcat(*values.values())), running)
            after = {f"{name}_next": ca.if_else(usable, value, getattr(s, name)) for name, value in values.items()}
            for name, value in values.items():
                last, before = getattr(s, name), getattr(s, f"{name}_before")
                after[f"{name}_before_next"] = ca.if_else(usable, ca.if_else(begun, last, value), before)
            return values, {**after, "filter_begun_next": ca.if_else(usable, 1, s.filter_begun)}

        def step(s: Signals) -> dict[str, Expression]:
            running = s.warm_up > warm_up_cycles - 0.5
            values, after = filtered(s, running)
            before, realised = values["filtered_command"], values["filtered_response"]
            moved = before + ca.solve(gain(s.state, before, s.parameters), s.desired - realised)
            command = ca.if_else(running, moved, inverse(s.state, s.desired, s.parameters))
            request = response(s.state, command, s.parameters)
            return {"command_unclipped": command, "_deformed_unclipped": request, **after}

        signals = (built.before, plant.response_signal("realised"), plant.response_signal("desired"))
        reads = Layout((plant.state, *signals, plant.parameter, scalar("warm_up")))
        writes = Layout((like(plant.input, "command_unclipped"), plant.response_signal("_deformed_unclipped")))
        return Block("increment", reads, writes, step, memory, opaque=plant.equations.inverse_opaque)


@dataclass(frozen=True)
class ResolvedAccelerationRate(OfDerivatives):
    """Increments of the command with which all modes of the error and its first n derivatives decay as exp(-rate t).

    The first cycle has no measured response yet and prescribes (d/dt + rate)^n e = 0.

    Args:
        rate: Lambda, 1/s.
    """

    rate: Positive

    of_time = True

    def gains(self, degree: int) -> tuple[float, ...]:
        """Return the coefficients of (d/dt + rate)^degree below the highest, lowest derivative first."""
        return decay_gains(self.rate, degree)

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        plant = built.plant
        closing, delays = closing_blocks(built)
        blocks = [
            reference_block(built),
            _nominal_block(built),
            self._rate_block(built),
            _increment_block(built),
            invert_block(plant),
            *closing,
        ]
        return blocks, delays

    def _rate_block(self, built: Built) -> Block:
        """Block (state, realised, reference now and one cycle later) -> (desired, its change in this cycle)."""
        plant, period, warm_up_cycles = built.plant, built.period, built.warm_up

        def step(s: Signals) -> dict[str, Expression]:
            errors = error_chains(plant, s.reference - getattr(s, plant.output.name))
            change, first = [], []
            for k, chain in enumerate(errors):
                whole = [*chain, s.nominal[k] - s.realised[k]]
                feedback = sum(g * e for g, e in zip(self.gains(len(whole)), whole, strict=True))
                change.append(s._nominal_later[k] - s.nominal[k] + period * feedback)
                first.append(s.nominal[k] + sum(g * e for g, e in zip(self.gains(len(chain)), chain, strict=True)))
            running = s.warm_up > warm_up_cycles - 0.5
            desired = s.realised + ca.vertcat(*change)
            return {"_change": ca.vertcat(*change), "desired": ca.if_else(running, desired, ca.vertcat(*first))}

        names = ("nominal", "_nominal_later", "realised")
        reads = (plant.output, like(plant.output, "reference"), *map(plant.response_signal, names), scalar("warm_up"))
        return Block(
            "rate", Layout(reads), Layout((plant.response_signal("_change"), plant.response_signal("desired"))), step
        )


def _nominal_block(built: Built) -> Block:
    """Block time -> nominal response now and one cycle later."""
    plant, function = built.plant, built.later
    controlled = controlled_places(plant)

    def step(s: Signals) -> dict[str, Expression]:
        later = function(s.time, *built.own_values(s))[1][controlled]
        return {"nominal": s._reference_response, "_nominal_later": later}

    reads = Layout((plant.time, plant.response_signal("_reference_response"), *built.own))
    writes = Layout((plant.response_signal("nominal"), plant.response_signal("_nominal_later")))
    return Block("nominal", reads, writes, step)


def _increment_block(built: Built) -> Block:
    """Block (change, last command, state) -> request: the model's response to the last command plus the change."""
    plant, period, warm_up_cycles = built.plant, built.period, built.warm_up
    x, u, p = plant.symbols()
    measured = ca.SX.sym("f", len(plant.controlled_names))
    response = plant.equations.controlled_response(x, u, p)
    highest = plant.equations.response(x, u, p)
    # The measured responses move the state; the model's response does where nothing is measured.
    orders = dict(zip(plant.names, plant.orders, strict=True))
    for k, (name, order) in enumerate(plant.response_orders.items()):
        if orders.get(name) == order:
            highest[plant.names.index(name)] = measured[k]
    rates = []
    for element in plant.state.elements:
        higher = element + "'"
        inside = higher in plant.state.elements
        rates.append(
            x[plant.state.elements.index(higher)] if inside else highest[plant.names.index(element.rstrip("'"))]
        )
    drift = ca.jtimes(response, x, ca.vertcat(*rates))
    model = ca.Function("fpirhc_drifting", [x, u, p, measured], [response, drift])

    def step(s: Signals) -> dict[str, Expression]:
        now, drifting = model(s.state, s._command_before, s.parameters, s.realised)
        request = now + s._change - period * drifting
        return {"_deformed_unclipped": ca.if_else(s.warm_up > warm_up_cycles - 0.5, request, s.desired)}

    names = ("_change", "desired", "realised")
    reads = (plant.state, like(plant.input, "_command_before"), plant.parameter, *map(plant.response_signal, names))
    writes = Layout((plant.response_signal("_deformed_unclipped"),))
    return Block("increment", Layout((*reads, scalar("warm_up"))), writes, step)


@dataclass(frozen=True)
class SlidingMode(OfDerivatives):
    """Inverse dynamics with the switching term K tanh(S / w).

    Args:
        rate: Lambda, decay of the error on S = 0, 1/s.
        gain: K, above the largest response error of the model, in units of the response (m/s^2 for n = 2).
        width: w, boundary layer, in units of the response times s (m/s for n = 2); K period / w must stay below 2.
    """

    rate: Positive
    gain: Positive
    width: Positive

    def check(self, problem: Problem) -> None:
        """Raise if the loop chatters even with an exact model."""
        super().check(problem)
        mistakes, product = Mistakes("SlidingMode"), self.gain * problem.period / self.width
        if product >= 2:
            mistakes.add(
                f"gain x period / width = {product:.3g} chatters with any model; "
                f"take a width above {0.5 * self.gain * problem.period:.3g} "
                f"or a gain below {2 * self.width / problem.period:.3g}"
            )
        mistakes.raise_if_any()
        for order in problem.plant.response_orders.values():
            check_modes(self, problem.plant, decay_gains(self.rate, order - 1))

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        closing, delays = closing_blocks(built, self.deformation)
        return [*nominal_blocks(built), self._surface_block(built.plant), *closing], delays

    def _surface_block(self, plant: Plant) -> Block:
        """Block (state, reference, nominal) -> (S, desired)."""
        units = [f"{unit} {plant.time_unit}" for unit in plant.response_signal("desired").units]

        def step(s: Signals) -> dict[str, Expression]:
            surfaces, drifts = [], []
            for chain in error_chains(plant, s.reference - getattr(s, plant.output.name)):
                degree = len(chain) - 1
                gains = [math.comb(degree, k) * power(self.rate, degree - k) for k in range(degree + 1)]
                surfaces.append(sum(g * e for g, e in zip(gains, chain, strict=True)))
                drifts.append(sum((g * e for g, e in zip(gains, chain[1:], strict=False)), start=0 * chain[0]))
            surface = ca.vertcat(*surfaces)
            switching = self.gain * ca.tanh(surface / self.width)
            return {"surface": surface, "desired": s.nominal + ca.vertcat(*drifts) + switching}

        reads = Layout((plant.output, like(plant.output, "reference"), plant.response_signal("nominal")))
        writes = Layout((vector("surface", plant.controlled_names, units), plant.response_signal("desired")))
        return Block("surface", reads, writes, step)


EXAMPLES = (
    Example(
        problem="mrac_pendulum", controller="acceleration feedback", changes={"duration": 3.0, "measure_from": 0.0}
    ),
    Example(problem="mrac_pendulum", controller="INDI", changes={"duration": 3.0, "measure_from": 0.0}),
    Example(problem="mrac_pendulum", controller="INDI, filtered", changes={"duration": 3.0, "measure_from": 0.0}),
    Example(problem="mrac_pendulum", controller="acceleration rate", changes={"duration": 3.0, "measure_from": 0.0}),
    Example(problem="mrac_pendulum", controller="sliding mode", changes={"duration": 3.0, "measure_from": 0.0}),
)
