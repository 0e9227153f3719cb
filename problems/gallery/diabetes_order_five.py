"""What fails on the people of `diabetes`: computed torque and its iteration on the fifth derivative of glucose.

Everything is given that such a controller could ask for: the adult's body without noise, glucose with all its derivatives, a
stomach that empties evenly in the body as in the clinic's model, and differential equations in place of cycles of 5 min. Between
the dose and the glucose lie five integrators, so a tracking law prescribes the fifth derivative. Meals are those of `diabetes`,
each as a bell of a quarter of an hour, and nobody announces them. Over a day:

    rms error, seed 0            glucose [mg/dl]
    CTC                                       89
    CTC+FPI                                   58
    CTC+FPI, model-referenced                 54

    shares of the time [%]       from 70 to 180    below 70    at a limit    lowest [mg/dl]
    CTC                                      27          74           100               -17
    CTC+FPI                                  67          14            98                56
    CTC+FPI, model-referenced                69          14            99                55

No row is safe, and the pump is at one of its limits nearly all the time. A meal is in the fifth derivative at once and wants the
whole of it taken back; a dose acts on it as soon, but on the glucose itself hours later. The law asks for more than the pump can
give, then for less than nothing, and what was given cannot be taken out. The iteration corrects the fifth derivative, and that is
not what is wrong.
"""

import runpy
from pathlib import Path

import casadi as ca
import numpy as np

import fpirhc as fp

shared = runpy.run_path(str(Path(__file__).with_name("diabetes.py")))
own, believed = shared["PEOPLE"][shared["FIRST"]], shared["believed"](shared["FIRST"])
names = [n for n in shared["UNITS"] if n not in shared["OF_STOMACH"]]
BELL = 12.0  # min, its width
FALL = 60.0  # min, in which the reference comes down


def rates(x, u, p):
    """The body with a stomach that empties evenly."""
    return shared["rates"](x, p.kmax, p.basal + u.extra, p)


def glucose(t):
    """From the fasting glucose to 115 mg/dl, with four derivatives that begin at zero."""
    left = sum((t / FALL) ** k / factorial for k, factorial in enumerate((1, 1, 2, 6, 24))) * ca.exp(-t / FALL)
    return {"glucose": 115 + (own["Gb"] - 115) * left}


def meals(t):
    """Carbohydrate that enters the stomach, mg/min."""
    return sum(
        1000 * grams * ca.exp(-(((t - 60 * hour - 15) / BELL) ** 2)) / (BELL * np.sqrt(np.pi))
        for hour, grams in shared["MEALS"]
    )


problem = fp.Problem(
    plant=fp.Plant.of_states(
        states=shared["BODY"],
        inputs={"extra": "U/h"},
        rates=rates,
        outputs={"glucose": fp.Output("mg/dl", lambda x, p: x.Gp / p.Vg)},
        time_unit="min",
        parameters={n: fp.Parameter(believed[n], own[n], shared["UNITS"][n]) for n in names}
        | {"basal": fp.Parameter(own["basal"], own["basal"], "U/h"), "carbs": fp.Parameter(0.0, 0.0, "g/min")},
    ),
    reference=fp.Trajectory(glucose),
    start=shared["at_rest"](own, own["Gb"], own["basal"])[0],
    period=1.0,
    duration=1440.0,  # min
    limits=fp.Limits(inputs={"extra": (-own["basal"], shared["PUMP"] * own["basal"])}),
    disturbances={"solid": fp.Formula(meals)},
)
law, map_ = fp.Exponential(rate=0.03), fp.Affine(gain=-0.3)
controllers = {
    "CTC": fp.ComputedTorque(law),
    "CTC+FPI": fp.ComputedTorque(law, map_),
    "CTC+FPI, model-referenced": fp.ComputedTorque(law, fp.ModelReferenced(map_)),
}
headline = ("CTC", "CTC+FPI")
why = (
    "No row is safe: a meal is in the fifth derivative at once, so the law asks for doses "
    "that act hours later and cannot be taken out."
)
keeps_rule = ()
GLUCOSE = "output.glucose"
metrics = (
    fp.figures.InBand(GLUCOSE, 70.0, 180.0, name="in_range"),
    fp.figures.TimeOver(fp.Quantity("-glucose", "mg/dl", lambda run: -run[GLUCOSE]), -70.0, name="below_70"),
    fp.figures.Nadir(GLUCOSE),
)
headline_metric = "below_70"
