"""Two masses on springs, force on the second only: slots of relative order 2 and 4.

    m1 q1'' = k2 (q2 - q1) - k1 q1 - b1 q1',        m2 q2'' = F - k2 (q2 - q1) - b2 q2'

The force reaches q2 in its second derivative and q1 in its fourth. A slot for q2 is quick and leaves q1 to swing on its
springs, almost undamped (-0.1 1/s); a slot for q1 has no zero dynamics. Its derivatives q1'' and q1''' are computed by the
model from the measured state, and both springs of the model are too stiff by the same factor, so that q1'' of the model is
zero at the right place; with another ratio the slot of q1 ends at a constant error, with or without deformation.

Errors count from 8 s on:

    rms error, seed 0     q1 [m]     q2 [m]
    slots                 0.0053     0.0079
    slots+FPI            1.1e-07    1.8e-07
    slots exact model    1.2e-09    2.8e-09
    RHC                   0.0016     0.0024
    RHC+FPI              4.6e-07    6.8e-07

The Floquet radius is smaller than the factor with the deformation, because the law of q1 uses derivatives of the wrong model.
"""

import fpirhc as fp


def response(q, v, u, p):
    between = p.k2 * (q.q2 - q.q1)
    return {"q1": (between - p.k1 * q.q1 - p.b1 * v.q1) / p.m1, "q2": (u.F - between - p.b2 * v.q2) / p.m2}


plant = fp.Plant(
    coordinates={"q1": "m", "q2": "m"},
    inputs={"F": "N"},
    order=2,
    response=response,
    controlled=("q2",),
    parameters={
        "m1": fp.Parameter(approximate=1.3, exact=1.0, unit="kg"),
        "m2": fp.Parameter(approximate=1.5, exact=1.0, unit="kg"),
        "k1": fp.Parameter(approximate=6.0, exact=5.0, unit="N/m"),
        "k2": fp.Parameter(approximate=12.0, exact=10.0, unit="N/m"),
        "b1": fp.Parameter(approximate=0.0, exact=0.2, unit="N s/m"),
        "b2": fp.Parameter(approximate=0.0, exact=0.5, unit="N s/m"),
    },
)

problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"q1": 0.2 + 0 * t, "q2": 0.3 + 0 * t}),  # at rest for k1 / k2 = 1 / 2
    start={"q1": 0.0, "q2": 0.0},
    period=2e-3,  # s
    duration=20.0,  # s, five periods of the schedule
    limits=fp.Limits(inputs={"F": (-20.0, 20.0)}),  # N
    horizon=fp.Horizon(stages=30, step=5e-2),
    cost=fp.Quadratic(states={"q1": 1e2, "q2": 1e2, "q1'": 1.0, "q2'": 1.0}, deviation={"F": 1e-2}),
    measure_from=8.0,  # s, after two periods
    judged=("q1", "q2"),
)

turns = {"q2": 1.0, "q1": 3.0}  # s
optimiser = fp.FixedPointSolver()
sigmoid = fp.Sigmoid(gain=-0.5, shift=0.3, scale=100.0)  # scale in m/s^2 or m/s^4


def slotted(deformation):
    second = fp.ComputedTorque(fp.Exponential(rate=4.0, integral=False), deformation)  # 1/s
    first = fp.ComputedTorque(fp.Exponential(rate=4.0, integral=False), deformation)
    return fp.Slotted({"q2": second, "q1": first}, turns, blend=0.1)


controllers = {
    "slots": slotted(fp.Identity()),
    "slots+FPI": slotted(sigmoid),
    "slots exact model": fp.ExactModel(slotted(fp.Identity())),
    "RHC": fp.RecedingHorizon(optimiser),
    "RHC+FPI": fp.RecedingHorizon(optimiser, sigmoid),
}
headline = ("slots", "slots+FPI")
why = (
    "Both springs are wrong by one factor, so the slots end at the right place, and the force "
    "corrects what acts on its own derivative at once."
)
