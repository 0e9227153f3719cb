"""python-control beside fpirhc: its linear systems as plants, and a controller of fpirhc as one of its systems.

plant = plant_of(control.tf([2], [1, 3, 2, 0]), exact=control.tf([3], [1, 2, 2, 0]), inputs={"u": "V"}, outputs={"y": "rad"})
system = controller_system(problem, controller)            to be connected with other systems of one sampling time
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import control
import numpy as np

from fpirhc.adapters.names import adapter
from fpirhc.controllers.base import Controller
from fpirhc.errors import Mistakes
from fpirhc.plant.motion import Output
from fpirhc.plant.parameter import Parameter
from fpirhc.plant.plant import Plant
from fpirhc.simulation.stepper import Stepper
from fpirhc.symbolic.expression import Expression
from fpirhc.task.problem import Problem

Names = Mapping[str, str]


@adapter
def plant_of(
    system: Any,
    exact: Any = None,
    *,
    states: Names | None = None,
    inputs: Names | None = None,
    outputs: Names | None = None,
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
    model = control.ss(system)
    true = model if exact is None else control.ss(exact)
    mistakes = Mistakes("plant_of")
    if (model.nstates, model.ninputs, model.noutputs, model.dt) != (true.nstates, true.ninputs, true.noutputs, true.dt):
        mistakes.add(f"the two systems differ in size or sampling time: {_size(model)}, and {_size(true)}")
    if np.any(model.D) or np.any(true.D):
        mistakes.add("the output depends on the input at once (D is not zero); put the actuator's lag before it")
    if model.dt is True:
        mistakes.add("the sampling time is not given; write control.ss(..., dt=0.1)")
    states = _named(mistakes, "states", states, model.state_labels)
    inputs = _named(mistakes, "inputs", inputs, model.input_labels)
    outputs = _named(mistakes, "outputs", outputs, model.output_labels)
    mistakes.raise_if_any()
    parameters: dict[str, Parameter] = {}
    rows = {name: _rows(name, getattr(model, name), getattr(true, name), parameters) for name in "ABC"}

    def moved(x: Any, u: Any, p: Any) -> dict[str, Expression]:
        own, forced = rows["A"](x, states, p), rows["B"](u, inputs, p)
        return {name: a + b for name, a, b in zip(states, own, forced, strict=True)}

    def shown(k: int) -> Callable[..., Expression]:
        return lambda x, p: rows["C"](x, states, p)[k]

    seen = {name: Output(unit, shown(k)) for k, (name, unit) in enumerate(outputs.items())}
    make: Callable[..., Plant] = partial(Plant.of_states, rates=moved)
    if model.dt:
        make = partial(Plant.discrete, next=moved, step=float(model.dt))
    return make(states=states, inputs=inputs, parameters=parameters, outputs=seen, time_unit=time_unit)


def _size(system: Any) -> str:
    return f"{system.nstates} states, {system.ninputs} inputs, {system.noutputs} outputs, dt = {system.dt}"


def _named(mistakes: Mistakes, what: str, given: Names | None, labels: Sequence[str]) -> Names:
    """Name -> unit: the given ones, or the system's labels as names."""
    if given is None:
        return {re.sub(r"\W+", "_", label).strip("_"): "1" for label in labels}
    if len(given) != len(labels):
        mistakes.add(f"{what}: {len(given)} names for {len(labels)} {what} ({', '.join(labels)})")
    return given


def _rows(
    name: str, model: np.ndarray, true: np.ndarray, parameters: dict[str, Parameter]
) -> Callable[..., list[Expression]]:
    """Function (view, names, parameters) -> the matrix times the column; its uncertain entries are added to the parameters."""
    for (row, column), value in np.ndenumerate(model if model.shape == true.shape else np.zeros((0, 0))):
        if value != true[row, column]:
            parameters[f"{name}_{row + 1}_{column + 1}"] = Parameter(float(value), float(true[row, column]), "1")

    def product(view: Any, names: Iterable[str], p: Any) -> list[Expression]:
        column = [getattr(view, n) for n in names]
        rows: list[Expression] = []
        for i, row in enumerate(model):
            entries = [(f"{name}_{i + 1}_{j + 1}", v, c) for j, (v, c) in enumerate(zip(row, column, strict=True))]
            terms = [(getattr(p, k) if k in parameters else v) * c for k, v, c in entries if k in parameters or v]
            rows.append(sum(terms[1:], terms[0]) if terms else 0 * column[0])
        return rows

    return product


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
    name = quantity.rstrip("'")
    return name if name == quantity else f"{name}_{len(quantity) - len(name)}"
