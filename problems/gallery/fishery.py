"""A fishery that is managed year by year: a map with delayed recruitment, whose catchability nobody knows.

Adults A and recruits R in kt, fishing effort E in thousands of days at sea; one step is one year (Ricker 1954, Schaefer 1954;
Clark, Mathematical Bioeconomics, 2nd ed. 1990, section 7.2),

    A+ = (s - q E) A + R,        R+ = a A exp(-A / B).

The response is the change of the adults from one survey to the next. The model believes in a fleet that catches a third
more per day, in a higher survival and in a poorer recruitment than the plant has. Only the surveys are known, one per year.

Task: rebuild the stock from 60 kt to 110 kt, keep it, and let it go down to 90 kt when the fishery is opened again. Errors
count from year 5 on:

    rms error, seed 0    adults [kt]
    CTC                          4.2
    CTC+FPI                     0.75
    RHC                          2.4
    RHC+FPI                      0.4
    RHC exact model          0.00047

The iteration compares the change that the model expects of the effort with the change that the next survey shows. It is the
model-referenced form: in steps as coarse as a year the stock moves so much that the last request says little about the next
one.
"""

import casadi as ca

import fpirhc as fp


def grown(x, u, p):
    return {
        "adults": (p.survival - p.catchability * u.effort) * x.adults + x.recruits,
        "recruits": p.fecundity * x.adults * ca.exp(-x.adults / p.crowding),
    }


plant = fp.Plant.discrete(
    states={"adults": "kt", "recruits": "kt"},
    inputs={"effort": "kd"},
    next=grown,
    step=1.0,
    outputs={"adults": fp.Output("kt", lambda x, _: x.adults)},  # recruits need no reference
    ranges={"adults": (0.0, 1000.0), "recruits": (0.0, 1000.0)},
    time_unit="year",
    parameters={
        "survival": fp.Parameter(approximate=0.70, exact=0.60, unit="1"),
        "catchability": fp.Parameter(approximate=0.40, exact=0.30, unit="1/kd"),
        "fecundity": fp.Parameter(approximate=1.6, exact=2.0, unit="1"),
        "crowding": fp.Parameter(approximate=100.0, exact=100.0, unit="kt"),
    },
)


def wanted(t):
    rebuilt, opened = 50 / (1 + ca.exp(-(t - 10) / 2)), 20 / (1 + ca.exp(-(t - 40) / 2))
    return {"adults": 60 + rebuilt - opened}


problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(wanted),
    start={"adults": 60.0, "recruits": 60.0},
    period=1.0,  # year
    duration=60.0,  # years
    limits=fp.Limits(inputs={"effort": (0.0, 3.0)}),  # kd
    horizon=fp.Horizon(stages=8, step=1.0),  # years
    cost=fp.Quadratic(outputs={"adults": 1.0}, rate={"effort": 1.0}),
    measure_from=5.0,  # years
)

tracking = fp.ShiftPolynomial(poles=0.5, step=1.0, integral=False)
optimiser = fp.FixedPointSolver()
iteration = fp.ModelReferenced(fp.Affine(gain=-2.0))
controllers = {
    "CTC": fp.ComputedTorque(tracking),
    "CTC+FPI": fp.ComputedTorque(tracking, iteration),
    "RHC": fp.RecedingHorizon(optimiser),
    "RHC+FPI": fp.RecedingHorizon(optimiser, iteration),
    "RHC exact model": fp.ExactModel(fp.RecedingHorizon(optimiser)),
}
headline = ("RHC", "RHC+FPI")
why = (
    "One survey a year is compared with what the model expects of the effort; PID has "
    "neither growth nor recruitment in it, and lags by years."
)
