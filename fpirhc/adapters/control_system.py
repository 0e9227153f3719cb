"""A controller as a system of python-control.

system = controller_system(problem, controller)            to be connected with other systems of one sampling time
"""

from __future__ import annotations

from functools import partial
from typing import Any

import control
import numpy as np

from fpirhc.adapters.names import base_and_order
from fpirhc.controllers.base import Controller
from fpirhc.simulation.stepper import Stepper
from fpirhc.task.problem import Problem


def controller_system(problem: Problem, controller: Controller, *, compiled: bool = False) -> Any:
    """Return a controller as a `control.NonlinearIOSystem` that is sampled with the problem's period.

    Its inputs are the measurements of `Stepper.measures`, in their units, its outputs the commands, its state what the controller
    remembers, which starts at `Stepper(problem, controller).start()`: the system has it as `initial`.

    Args:
        problem: the task of the controller; its plant is the model alone.
        controller: the controller.
        compiled: whether the step is compiled to C.

    Raises:
        FpirhcError: the controller cannot be built for the problem.
    """
    stepper = Stepper(problem, controller, compiled=compiled)

    def stepped(result: int, time: float, memory: np.ndarray, measured: np.ndarray, _: object) -> np.ndarray:
        return stepper.step_measured(float(time), np.asarray(measured, float), np.asarray(memory, float))[result]

    system = control.NonlinearIOSystem(
        partial(stepped, 1),
        partial(stepped, 0),
        inputs=[_label(name) for name in stepper.measures],
        outputs=list(problem.plant.inputs),
        states=stepper.memory.size,
        dt=problem.period,
        name=type(controller).__name__,
    )
    system.initial = stepper.start()
    return system


def _label(quantity: str) -> str:
    """A derivative as a label that python-control takes: "q1''" as "q1_2"."""
    name, order = base_and_order(quantity)
    return f"{name}_{order}" if order else name
