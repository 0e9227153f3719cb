"""A controller stepped by hand: against real hardware, another simulator, or a test."""

from __future__ import annotations

import numpy as np

from fpirhc.controllers.base import Controller, compose_controller
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.symbolic.layout import Layout
from fpirhc.symbolic.native import native
from fpirhc.task.problem import Problem


class Stepper:
    """One controller, ready to be called once per control cycle.

        stepper = Stepper(problem, controller)
        memory = stepper.start()
        command, memory = stepper.step(time, state, realised, memory)

    All memory is in the argument: the same arguments give the same command. `trace()` returns every signal of the last step.
    """

    def __init__(self, problem: Problem, controller: Controller, *, compiled: bool = True) -> None:
        """Compose the controller's Function, and compile it where `compiled` is set and there is a compiler."""
        composite = compose_controller(problem, controller)
        backend = native(composite.function) if compiled else None
        self.compiled = bool(backend and backend.compiled)
        self.memory: Layout = composite.memory
        self.signals: Layout = composite.trace
        self._evaluator = Evaluator(backend.function if backend else composite.function)
        self._memory, self._time, self._state, self._realised, parameters = self._evaluator.arguments
        self._memory_next, self._trace, self._command = self._evaluator.results
        parameters[:] = controller.parameters(controller.model_plant(problem))
        self._evaluate = self._evaluator.evaluate

    def start(self) -> np.ndarray:
        """Return the memory of the controller before its first cycle."""
        return self.memory.start()

    def step(
        self, time: float, state: np.ndarray, realised: np.ndarray, memory: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (command, memory for the next cycle).

        Args:
            time: s.
            state: the measured state, shape (nx,).
            realised: the measured response of the controlled coordinates to the last command; ignored in the first cycle.
            memory: from `start` or from the step before.
        """
        self._time[0] = time
        self._state[:] = state
        self._realised[:] = realised
        self._memory[:] = memory
        self._evaluate()
        return self._command.copy(), self._memory_next.copy()

    def trace(self) -> dict[str, np.ndarray]:
        """Return every signal of the last step by name."""
        return {name: value.copy() for name, value in self.signals.unpack(self._trace).items()}
