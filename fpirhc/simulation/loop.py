"""Closes the loop: controller blocks and the exact plant as ONE step.

Per cycle k the loop holds the plant's state x_k and the response that was realised just before t_k under the command
held since t_{k-1}; the controller turns them into a command; the plant moves on by one period with that command held.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller, closing_blocks, reference_block
from fpirhc.controllers.built import Built, build
from fpirhc.controllers.contract import Undeformed
from fpirhc.controllers.gate import INNER, Gate
from fpirhc.controllers.live_settings import LiveSettings
from fpirhc.controllers.seeing import seeing_blocks, sensor_ranges
from fpirhc.simulation.moved import acting_blocks, moving, outside_blocks
from fpirhc.simulation.replay import known_samples
from fpirhc.simulation.sensed import lost_blocks, sensing_blocks
from fpirhc.simulation.tables import disturbance_signals
from fpirhc.symbolic.block import Block, Composite, Delay, compose, open_settings
from fpirhc.symbolic.expression import Signals, expression
from fpirhc.symbolic.layout import Expression, Layout, Signal, like, scalar
from fpirhc.symbolic.open import SETTINGS
from fpirhc.task.problem import Problem


def close_loop(problem: Problem, controller: Controller, live: LiveSettings | None = None) -> Composite:
    """Return the closed loop as one step: (memory, [disturbance], [sensing], [setpoints]) -> (memory, trace).

    With an `ExternalPlant` the step also reads its measurements, and returns the inputs that it is sent.

    Both parameter sets are part of the memory (constant), so that other values need no new Function; live settings likewise. The
    disturbance input exists only when the problem has disturbances, `sensing` only where sensors are noisy or lose samples,
    `setpoints` only where the reference is given some.
    """
    return _closed(build(problem, controller)) if live is None else live.composed(_closed)


def _closed(built: Built) -> Composite:
    problem = built.problem
    mover, inner = moving(problem), built.step
    lost, ranges = lost_blocks(mover), sensor_ranges(problem)
    samples = known_samples(problem) if lost or ranges else 0
    acting = Gate(problem, inner, simulated=True, ranges=ranges, loses=bool(lost), samples=samples)
    disturbed = disturbance_signals(problem)
    seeing = sensing_blocks(mover, predicts="state_ahead" in acting.inner.trace)
    judging = [block for block in seeing if "reference" in block.reads]  # along the reference that the controller had
    seeing = [block for block in seeing if block not in judging]
    clock, actuating = _clock_block(problem.plant.time, problem.period), acting_blocks(mover, disturbed)
    around = [clock, *outside_blocks(mover, built.model), *seeing, *lost, acting.block(), *judging, *actuating]
    constants = [Delay(signal, signal.name) for signal in open_settings(around).signals] if built.opened else []
    reads = Layout((*disturbed, *problem.sensing.drawn, *built.given, *mover.reads))
    delays = [*mover.delays, Delay(built.model.parameter, "parameters"), *constants]
    return compose("loop", reads, around, delays, outputs=mover.sent)


def start_memory(
    loop: Composite, problem: Problem, controller: Controller, numbers: Mapping[str, float] | None = None
) -> np.ndarray:
    """Return the first memory of a loop, shape (loop.memory.size,).

    Args:
        problem: the problem of the loop, or one that differs from it in the exact parameters only.
        numbers: of all live settings, by path; None: those of the build.
    """
    mover, whole = moving(problem), loop.memory.start()
    blocks = (*sensing_blocks(mover, predicts=False), *seeing_blocks(problem)[0])
    signals = [signal for block in blocks for signal in block.memory.signals]
    signals += [*(delay.now for delay in mover.delays), controller.plant_model(problem).parameter]
    if INNER in loop.memory and plans_exactly(loop, problem, controller):
        whole[loop.memory.slice(INNER)] = build(problem, controller).step.memory.start()
    # A graph has the estimator's memory inside the controller's one signal.
    places = {column.removeprefix(f"{INNER}."): k for k, column in enumerate(loop.memory.columns)}
    for signal in signals:
        whole[[places[column] for column in signal.columns]] = signal.start_vector()
    if numbers and SETTINGS in loop.memory:
        whole[loop.memory.slice(SETTINGS)] = list(numbers.values())
    return whole


def plans_exactly(loop: Composite, problem: Problem, controller: Controller) -> bool:
    """Return whether plans know the exact parameters, and those of this problem are not those of the build."""
    model, of_build = controller.plant_model(problem), loop.memory["parameters"].start_vector()
    exact = controller.planner is not None and model.exact
    return exact and not np.array_equal(of_build, model.parameters(model.plant))


def _clock_block(time: Signal, period: float) -> Block:
    """Block -> time, computed from a counter so that no rounding error grows in a long run."""

    def step(s: Signals) -> dict[str, Expression]:
        return {"time": s.cycle * period, "cycle_next": s.cycle + 1}

    return Block("clock", Layout(), Layout((time,)), step, Layout((scalar("cycle"),)))


@dataclass(frozen=True)
class HeldInput(Undeformed):
    """Sends the input before the run, within the limits."""

    def blocks(self, built: Built) -> tuple[list[Block], list[Delay]]:
        plant, (closing, delays), held = built.plant, closing_blocks(built), ca.DM(built.before.start_vector())
        responses = [plant.response_signal(name) for name in ("nominal", "desired", "_deformed_unclipped")]

        def step(s: Signals) -> dict[str, Expression]:
            response = plant.equations.controlled_response(s.state, held, s.parameters)
            return {"command_unclipped": expression(held), **{r.name: response for r in responses}}

        writes = Layout((*responses, like(plant.input, "command_unclipped")))
        return [
            reference_block(built),
            Block("hold", Layout((plant.state, plant.parameter)), writes, step),
            *closing,
        ], delays
