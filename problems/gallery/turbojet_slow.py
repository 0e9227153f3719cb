"""The same jet engine with a cycle as long as a stage of the plan, 100 ms: a small gain ruins the plain form alone.

Everything but the cycle is that of `turbojet`.

    rms error, seed 0                    T [N]
    CTC                                    4.7
    CTC+FPI                               0.21
    RHC                                    4.4
    RHC+FPI, model-referenced           0.0083
    RHC+FPI                               0.14
    RHC offset-free                     0.0075
    RHC exact model                    0.00041
    RHC+FPI, gentle, model-referenced     0.34
    RHC+FPI, gentle                         24

Offset-free control and the model-referenced form are nearly equal here, and 17 times better than the plain form. With
the plain form a small gain is no safe choice: with -0.3 every change of the desired response takes a second to act,
the plan reacts to the errors of this second with all or no throttle, and the thrust swings. The same gain in the
model-referenced form passes what the model expects at once.
"""

from dataclasses import replace
from pathlib import Path

import fpirhc as fp

quick = fp.load_problem(str(Path(__file__).with_name("turbojet.py")))

problem = replace(quick.problem, period=0.1)  # s
small = fp.Sigmoid(gain=-0.3, shift=0.3, scale=6000.0)
controllers = {
    **quick.controllers,
    "RHC+FPI, gentle, model-referenced": quick.controllers["RHC"].with_deformation(fp.ModelReferenced(small)),
    "RHC+FPI, gentle": quick.controllers["RHC"].with_deformation(small),
}
headline = quick.headline
why = (
    "The model's error follows the thrust slowly beside a cycle of 100 ms: a filter, and the iteration with the newest "
    "response, correct it nearly equally well."
)
tuning = quick.tuning
pictures = quick.pictures
