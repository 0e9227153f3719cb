"""Refuses a deformation whose gain has the wrong sign, before anything runs.

Where the response Jacobian's eigenvalues at the start have real parts of both signs, no gain converges; where they have one sign,
gains of the other one enlarge every error. Too large a gain is not refused: it ends in a bounded oscillation that a run
shows and the verdict explains.
"""

from __future__ import annotations

from fpirhc.contraction import assess_gain, spectrum_over_run
from fpirhc.deformation.base import Deformation
from fpirhc.errors import InvalidValue, NotContractive
from fpirhc.problem import Problem


def check_gain_sign(problem: Problem, deformation: Deformation) -> None:
    """Raise if the deformation cannot converge from the start of the problem.

    Raises:
        NotContractive: with the eigenvalues' verdict and the admissible gains.
    """
    gain = deformation.effective_gain()
    if gain == 0:
        return
    plant = problem.plant
    state = problem.start_state[None, :]
    response = plant.controlled_response_function(problem.start_state, [0] * plant.input.size, plant.approximate)
    try:
        spectrum = spectrum_over_run(plant, state, response.full().T)
    except InvalidValue:
        return  # singular at the start: nothing can be said before the run
    report = assess_gain(deformation, spectrum)
    if sum(report.linear_limit) * gain <= 0:
        raise NotContractive(report.text)
