"""The same nerve cell kept silent under a current that would make it fire: all but the exact model manage.

Task: V stays at rest, -65 mV, while 10 uA/cm^2 flow from 10 ms on, which no controller measures; without control the cell
fires 68 times a second. The error of V counts from 20 ms on. The largest current is 11 uA/cm^2, little more than is needed.

    rms error, seed 0           V [mV]
    CTC                          0.011
    CTC+FPI                    1.6e-06
    RHC                           0.58
    RHC+FPI, model-referenced  1.2e-09
    RHC+FPI                    1.1e-08
    RHC offset-free            1.8e-08
    RHC exact model               0.97

Adaptation is not needed to silence the cell: an integral is enough (CTC). The exact model is the worst: it has everything
but the current. The unit of time is the millisecond.
"""

from dataclasses import replace
from pathlib import Path

import fpirhc as fp

wave = fp.load_problem(str(Path(__file__).with_name("hodgkin_huxley.py")))
REST = {"V": -64.9964, "m": 0.05296, "h": 0.59599, "n": 0.31773}  # mV, and gates that are in balance there

problem = replace(
    wave.problem,
    reference=fp.Trajectory(lambda t: {name: value + 0 * t for name, value in REST.items()}),
    start=REST,
    limits=fp.Limits(inputs={"I": (-11.0, 11.0)}),  # uA/cm^2
    disturbances={"I": fp.Step(at=10.0, size=10.0)},  # ms, uA/cm^2
    measure_from=20.0,  # ms
)
controllers = wave.controllers
headline = wave.headline
why = (
    "A constant current beside the commanded one is all that happens: whatever adds up "
    "the error removes it, ADRC at 60 1/ms first."
)
tuning = wave.tuning
pictures = wave.pictures[:1]
