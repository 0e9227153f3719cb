"""An excitation of the loop: a known sequence that adds to the desired response, with the model's and the measured response logged.

Inside `ModelReferenced` the `request` of a map is the model's response to the command that acted, behind limits, dead times and the
estimator, so both responses have come the same way.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import casadi as ca
import numpy as np

from fpirhc.controllers.base import Controller
from fpirhc.controllers.check import any_gain
from fpirhc.controllers.contract import without_deformation
from fpirhc.deformation.base import Deformation, Iteration
from fpirhc.deformation.model_referenced import ModelReferenced
from fpirhc.simulation.run import Run
from fpirhc.simulation.simulate import simulate
from fpirhc.symbolic.layout import Expression, Layout, scalar
from fpirhc.task.problem import Problem

_HOLDS = (1, 2, 4, 8, 16)  # cycles
_NOISES, _SHARE = 2.0, 0.1  # amplitude: of the noise, and of the deviation of the desired response
_BEGUN = 3  # cycles after which a response is one of the run


@dataclass(frozen=True)
class Excitation(Deformation):
    """r_k = d_k + A s_k with a random binary sequence s, independent in every channel.

    Args:
        amplitude: A of every channel, in the unit of the response; 0 only listens.
        cycles: length of the sequence; after it the request is the desired response.
        seed: of the sequence.
    """

    amplitude: tuple[float, ...]
    cycles: int
    seed: int = 0

    @property
    def iteration(self) -> Iteration:
        return Iteration(limited=False)

    def memory(self, elements: tuple[str, ...]) -> Layout:
        del elements
        return Layout(
            (*(scalar(f"{name}_before") for pair in self._names for name in pair), scalar("excitation_cycle"))
        )

    def shown(self) -> Mapping[str, str]:
        return {name: f"{name}_before" for pair in self._names for name in pair}

    def step(
        self, request: Expression, response: Expression, desired: Expression, memory: Mapping[str, Expression]
    ) -> tuple[Expression, dict[str, Expression]]:
        table = sequence(self.cycles, len(self.amplitude), self.seed) * np.array(self.amplitude)
        cycle = memory["excitation_cycle"]
        grid = [np.arange(self.cycles, dtype=float).tolist()]
        added = [
            ca.interpolant(f"excitation{k}", "linear", grid, column.tolist())(ca.fmin(cycle, self.cycles - 1))
            for k, column in enumerate(table.T)
        ]
        remembered = {"excitation_cycle": cycle + 1}
        for k, (model, measured) in enumerate(self._names):
            remembered |= {f"{model}_before": request[k], f"{measured}_before": response[k]}
        return desired + ca.vertcat(*added), remembered

    def effective_gain(self) -> float:
        """Next to nothing; zero would be no adaptation, with which no loop passes its response on."""
        return 1e-9

    def secant_gain(self) -> float:
        return self.effective_gain()

    def largest_step(self) -> float:
        return float("inf")

    def with_effective_gain(self, gain: float) -> Self:
        del gain
        return replace(self)

    @property
    def _names(self) -> list[tuple[str, str]]:
        return [(f"excitation_model_{k}", f"excitation_response_{k}") for k in range(len(self.amplitude))]


@dataclass(frozen=True, eq=False)
class Record:
    """What was recorded.

    Args:
        measured: responses, shape (cycles, n).
        modelled: the model's responses to the commands that acted.
        usable: which cycles count: those with an answer.
        amplitude: of the excitation.
        stop: why the run ended early; empty where it did not.
        clipped: share of the cycles with a command at a limit.
    """

    measured: np.ndarray
    modelled: np.ndarray
    usable: np.ndarray
    amplitude: tuple[float, ...] = ()
    stop: str = ""
    clipped: float = 0.0


def sequence(cycles: int, channels: int, seed: int) -> np.ndarray:
    """Return +-1, shape (cycles, channels), held for 1 to 16 cycles: power at all frequencies of interest; 0 in the end."""
    random, signs = np.random.default_rng(seed), np.zeros((cycles, channels))
    for j in range(channels):
        k, sign = 0, 1.0
        while k < cycles:
            hold = int(random.choice(_HOLDS))
            sign = float(random.choice([-1.0, 1.0])) if random.random() < 0.5 else -sign
            signs[k : k + hold, j] = sign
            k += hold
    signs[-1] = 0
    return signs


def excited(
    problem: Problem, controller: Controller, *, cycles: int, amplitude: float | Mapping[str, float] | None, seed: int
) -> Record:
    """Return the record of a run under the controller without its deformation, excited.

    Args:
        problem: whose plant is run.
        controller: that keeps it safe.
        cycles: length of the run.
        amplitude: in the unit of the response, by controlled coordinate or one for all; None: twice the noise of a silent run of
            the same length and a tenth of the deviation of its desired response.
        seed: of the sequence and of the run.
    """
    names = problem.plant.controlled_names
    short, bare = replace(problem, duration=cycles * problem.period, measure_from=0.0), without_deformation(controller)
    if amplitude is None:
        run, silent = _run(short, bare, (0.0,) * len(names), cycles, seed)
        noise = np.median(np.abs(np.diff((silent.measured - silent.modelled)[_BEGUN:], axis=0)), axis=0) / 0.6745
        sizes = _NOISES * noise / np.sqrt(2) + _SHARE * np.std(np.asarray(run["desired"])[_BEGUN:], axis=0)
        chosen = tuple(map(float, sizes))
    elif isinstance(amplitude, Mapping):
        chosen = tuple(float(amplitude.get(name, 0.0)) for name in names)
    else:
        chosen = (float(amplitude),) * len(names)
    return _run(short, bare, chosen, cycles, seed)[1]


def _run(
    problem: Problem, bare: Controller, amplitude: tuple[float, ...], cycles: int, seed: int
) -> tuple[Run, Record]:
    excitation = Excitation(amplitude, cycles, seed)
    with any_gain():  # nothing is iterated, so the sign of the plant's gain does not matter
        run = simulate(problem, bare.with_deformation(ModelReferenced(excitation)), seed=seed, compiled=False)
    modelled, measured = (np.column_stack([run[pair[k]] for pair in excitation._names]) for k in (0, 1))
    held = np.asarray(run["foreign_held"]).ravel() if "foreign_held" in run.layout.names else np.zeros(len(measured))
    clipped = float(np.mean(np.asarray(run["clipped"]) > 0)) if len(measured) else 0.0
    return run, Record(measured, modelled, held == 0, amplitude, run.stop or "", clipped)
