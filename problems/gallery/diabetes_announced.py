"""What fails on the people of `diabetes`: a naive announcement of meals, and adaptation of the sensor's derivative.

Everything but the rows, the announcement and the target, 115 mg/dl, is that of `diabetes`. Here the plan knows every meal ahead.
For the same adult:

    rms error, seed 0            glucose [mg/dl]
    RHC                                       20
    RHC+FPI, model-referenced                 60
    RHC offset-free                           64

The adult's error is less than half of what it is without the announcement, and yet it is no controller for people. Over child#001,
child#004 and child#008 (`fpirhc study diabetes_announced --cases child` runs all ten), seed 0:

    shares of the time [%]       from 70 to 180    worst person    below 70    worst person
    RHC                                      59              57          25              39
    RHC+FPI, model-referenced                26              21          53              79
    RHC offset-free                          39              19          42              81

The clinic's model has a stomach that empties evenly and another person's gut. The plan gives the dose for the glucose that this
model expects, most of it before the meal, and nothing takes it back when the glucose comes later or not at all.

An iteration on the sensor's derivative asks for more of a dose that acts hours later: between the dose and the sensor lie six
lags, and what it takes for a response is noise and meals. The dose cannot be negative, so that its errors are of one sign.
"""

from dataclasses import replace
from pathlib import Path

import fpirhc as fp

silent = fp.load_problem(str(Path(__file__).with_name("diabetes.py")))

problem = replace(
    silent.problem,
    reference=fp.Trajectory(lambda t: {"glucose": 115.0 + 0 * t, "sensor": 115.0 + 0 * t}),
    signals={name: fp.Known(one.values) for name, one in silent.problem.signals.items()},
)
plan = silent.controllers["RHC"]
controllers = {
    "RHC": plan,
    "RHC+FPI, model-referenced": plan.with_deformation(fp.ModelReferenced(fp.Affine(gain=-0.3))),
    "RHC offset-free": fp.Estimating(
        plan, fp.DisturbanceKalman(drift={"Gp": 0.05}, measured={"sensor": 2.0}, noise={"gut": 1000.0, "Gp": 0.3})
    ),
}
headline = ("RHC", "RHC+FPI, model-referenced")
why = (
    "Between dose and sensor are six lags: what the iteration takes for a response is "
    "noise and meals, and its doses are never negative."
)
keeps_rule = ()
cases, metrics, headline_metric, pictures = silent.cases, silent.metrics, silent.headline_metric, silent.pictures
