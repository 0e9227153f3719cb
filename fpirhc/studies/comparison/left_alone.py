"""The plant left alone: its error where the input before the run is held. A controller that does worse is not a success.

The same plant, start, disturbances and noise as in the comparison; nothing is fed back. It is run in the virtual machine, because
one run is shorter than a compilation.
"""

from __future__ import annotations

from collections.abc import Mapping

from fpirhc.errors import FpirhcError
from fpirhc.simulation.held_input import HeldInput
from fpirhc.simulation.metrics.entries.errors import rms_error
from fpirhc.simulation.simulate import judged_run, simulator
from fpirhc.task.problem import Problem


def error_left_alone(problem: Problem, *, seed: int) -> Mapping[str, float]:
    """Return the rms error of every judged coordinate under the input before the run; empty where that is not known.

    It is not known for a plant outside, which is not run for the sake of a comparison, and where the run ends early.

    Args:
        problem: of the comparison.
        seed: of disturbances and noise.
    """
    if problem.foreign is not None:
        return {}
    try:
        run = judged_run(simulator(problem, HeldInput(), compiled=False), seed=seed)
    except FpirhcError:
        return {}
    return {} if run.stop is not None else rms_error(problem, run)
