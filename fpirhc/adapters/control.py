"""A linear system of python-control as a plant, and a controller as a system of that package.

plant = plant_of(control.tf([2], [1, 3, 2, 0]), exact=control.tf([3], [1, 2, 2, 0]), inputs={"u": "V"}, outputs={"y": "rad"})
system = controller_system(problem, controller)            to be connected with other systems of one sampling time
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import casadi as ca
import control
import numpy as np

from fpirhc.adapters.names import adapter, base_and_order
from fpirhc.controllers.base import Controller
from fpirhc.errors import Mistakes
from fpirhc.plant.motion import Output
from fpirhc.plant.parameter import Parameter
from fpirhc.plant.plant import Plant
from fpirhc.simulation.stepper import Stepper
from fpirhc.symbolic.expression import Expression
from fpirhc.task.problem import Problem


@adapter
def plant_of(
    system: Any,
    exact: Any = None,
    *,
    states: Mapping[str, str] | None = None,
    inputs: Mapping[str, str] | None = None,
    outputs: Mapping[str, str] | None = None,
    time_unit: str = "s",
) -> Plant:
    """Return the plant x' = A x + B u (or x+ = A x + B u), y = C x of a `StateSpace` or `TransferFunction`.

    Entries that differ between the two systems are parameters, `A_1_2`, with the value of the system as the approximate one. The
    others are constants, and a zero is no operation, so relative orders are those of the matrices.

    Args:
        system: the model, continuous or sampled.
        exact: the true plant, of the same size and realisation; None: the model.
        states: name -> unit of every state, in order; None: the labels of the system, without unit.
        inputs: likewise.
        outputs: likewise.
        time_unit: of the system.

    Raises:
        InvalidProblem: a direct feed-through, systems of other sizes or sampling times, or a wrong number of names.
    """
    model, true = control.ss(system), control.ss(system if exact is None else exact)
    sizes = [f"{s.nstates} states, {s.ninputs} inputs, {s.noutputs} outputs, dt = {s.dt}" for s in (model, true)]
    mistakes = Mistakes("plant_of")
    if sizes[0] != sizes[1]:
        mistakes.add(f"the two systems differ in size or sampling time: {', and '.join(sizes)}")
    if np.any(model.D) or np.any(true.D):
        mistakes.add("the output depends on the input at once (D is not zero); put the actuator's lag before it")
    if model.dt is True:
        mistakes.add("the sampling time is not given; write control.ss(..., dt=0.1)")
    states = _named(mistakes, "states", states, model.state_labels)
    inputs = _named(mistakes, "inputs", inputs, model.input_labels)
    outputs = _named(mistakes, "outputs", outputs, model.output_labels)
    mistakes.raise_if_any()
    pairs = {name: (getattr(model, name), getattr(true, name)) for name in "ABC"}
    wrong = {f"{n}_{i + 1}_{j + 1}": (n, i, j) for n, (a, b) in pairs.items() for i, j in np.argwhere(a != b)}
    parameters = {k: Parameter(pairs[n][0].item(i, j), pairs[n][1].item(i, j), "1") for k, (n, i, j) in wrong.items()}

    def product(name: str, p: Any, view: Any, names: Iterable[str]) -> ca.SX:
        """A matrix with its parameters, times a column."""
        matrix = ca.SX(ca.sparsify(ca.DM(pairs[name][0])))
        for key, (_, i, j) in ((key, at) for key, at in wrong.items() if at[0] == name):
            matrix[i, j] = p[key]
        return matrix @ ca.vertcat(*(view[n] for n in names))

    def moved(x: Any, u: Any, p: Any) -> dict[str, Expression]:
        return dict(zip(states, ca.vertsplit(product("A", p, x, states) + product("B", p, u, inputs)), strict=True))

    def shown(k: int) -> Callable[..., Expression]:
        return lambda x, p: product("C", p, x, states)[k]

    seen = {name: Output(unit, shown(k)) for k, (name, unit) in enumerate(outputs.items())}
    make: Any = Plant.discrete if model.dt else Plant.of_states
    how = {"next": moved, "step": float(model.dt)} if model.dt else {"rates": moved}
    return make(states=states, inputs=inputs, parameters=parameters, outputs=seen, time_unit=time_unit, **how)


def _named(mistakes: Mistakes, what: str, given: Mapping[str, str] | None, labels: Sequence[str]) -> Mapping[str, str]:
    """Name -> unit: the given ones, or the system's labels as names."""
    if given is None:
        return {re.sub(r"\W+", "_", label).strip("_"): "1" for label in labels}
    if len(given) != len(labels):
        mistakes.add(f"{what}: {len(given)} names for {len(labels)} {what} ({', '.join(labels)})")
    return given


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
