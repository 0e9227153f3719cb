"""The same tumour with one reading and one dose a day: the plain form with a small gain is worse than no adaptation.

Everything but the cycle is that of `tumour`: a day, as long as a stage of the plan. Errors count from 60 days on:

    rms error, seed 0                  size [ln(mm^3)]
    CTC                                          0.012
    CTC+FPI                                      0.004
    RHC                                           0.14
    RHC+FPI, model-referenced                  2.4e-05
    RHC+FPI                                     0.0001
    RHC offset-free                            2.4e-05
    RHC exact model                              0.025
    RHC+FPI, gentle, model-referenced          0.00095
    RHC+FPI, gentle                               0.67

The offset-free plan's model of a constant disturbance fits: it is as good as the model-referenced form. With the
plain form a small gain is no safe choice: with -0.3 every change of the desired response takes days to act, the plan
reacts to the errors of these days with doses from zero to the largest, and the error is larger than without
adaptation. The same gain in the model-referenced form passes what the model expects at once.
"""

from dataclasses import replace
from pathlib import Path

import fpirhc as fp

quick = fp.load_problem(str(Path(__file__).with_name("tumour.py")))

problem = replace(quick.problem, period=1.0)  # day
small = fp.Sigmoid(gain=-0.3, shift=0.3, scale=1.0)
controllers = {
    **quick.controllers,
    "RHC+FPI, gentle, model-referenced": quick.controllers["RHC"].with_deformation(fp.ModelReferenced(small)),
    "RHC+FPI, gentle": quick.controllers["RHC"].with_deformation(small),
}
headline = quick.headline
why = (
    "The step of the dose is a constant disturbance: the filter's model of one is right, "
    "and so is what the iteration adds from day to day."
)
tuning = quick.tuning
pictures = quick.pictures
