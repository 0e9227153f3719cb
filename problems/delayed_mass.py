"""A mass on a Duffing-like spring whose force acts 60 ms late, controlled with a wrong model.

    m q'' = Q(t - tau) - b q' - k q - l q^3,        nominal motion  q^N = 0.5 sin 2t,   tau = 60 ms = 60 cycles.

The product of tracking rate and dead time is 0.36: near the 0.407 at which the tracking law alone becomes unstable. A
deformation that pairs each response with the request of the last cycle uses the response to a request of 60 cycles before;
it cycles between its limits. Pairing alone makes the outer loop worse. The increment form passes a change of the desired
response at once, and with a prediction of the state over the dead time it tracks. It leaks, so that it bears a believed dead
time that is wrong by some cycles, also with the whole gain 1 / lambda_max. Errors count from 4 s on:

    rms error, seed 0      q [m]
    RHC                    0.016
    RHC+FPI                0.011
    RHC not predicting      0.48
    CTC                     0.15
    CTC+FPI unpaired        0.15
    CTC+FPI paired           3.1
    CTC+FPI increment     0.0055

With a dead time of 54 to 66 ms, still believed to be 60, RHC and RHC+FPI err by the same to 1 %. With a third of the weight of the
input RHC+FPI errs by 9.5 mm at 60 ms, and by 60 mm at 66: the plan's loop then has no margin left. All parameters are chosen here.
"""

import casadi as ca

import fpirhc as fp

DEAD_TIME = 0.06  # s
PERIOD = 1e-3  # s


def response(q, v, u, p):
    return {"q": (u.Q - p.b * v.q - p.k * q.q - p.l * q.q**3) / p.m}


plant = fp.Plant(
    coordinates={"q": "m"},
    inputs={"Q": "N"},
    order=2,
    response=response,
    parameters={
        "m": fp.Parameter(approximate=1.5, exact=1.0, unit="kg"),
        "k": fp.Parameter(approximate=6.0, exact=10.0, unit="N/m"),
        "l": fp.Parameter(approximate=3.0, exact=5.0, unit="N/m^3"),
        "b": fp.Parameter(approximate=1.0, exact=2.0, unit="N s/m"),
    },
)

problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"q": 0.5 * ca.sin(2 * t)}),
    start={"q": 0.0},
    period=PERIOD,
    duration=12.0,  # s
    limits=fp.Limits(inputs={"Q": (-100.0, 100.0)}),  # N
    dead_time=fp.DeadTime(inputs={"Q": DEAD_TIME}),
    horizon=fp.Horizon(stages=20, step=2e-2),
    cost=fp.Quadratic(states={"q": 1e3, "q'": 1.0}, deviation={"Q": 3e-3}),
    measure_from=4.0,  # s
)

law = fp.Exponential(rate=6.0)  # 1/s
sigmoid = fp.Sigmoid(gain=-0.5, scale=20.0)  # scale in m/s^2
fastest = sigmoid.with_effective_gain(1 / 1.5)  # 1 over the largest eigenvalue of M^-1 M^, the ratio of the masses
increment = fp.Increment(fastest, cycles=DEAD_TIME / PERIOD)
optimiser = fp.FixedPointSolver()

controllers = {
    "RHC": fp.Predicted(fp.RecedingHorizon(optimiser), inputs=DEAD_TIME),
    "RHC+FPI": fp.Predicted(fp.RecedingHorizon(optimiser, increment), inputs=DEAD_TIME),
    "RHC not predicting": fp.RecedingHorizon(optimiser),
    "CTC": fp.ComputedTorque(law),
    "CTC+FPI unpaired": fp.ComputedTorque(law, sigmoid),
    "CTC+FPI paired": fp.ComputedTorque(law, fp.Paired(sigmoid, cycles=DEAD_TIME / PERIOD)),
    "CTC+FPI increment": fp.Predicted(fp.ComputedTorque(law, increment), inputs=DEAD_TIME, by="desired"),
}
headline = ("RHC", "RHC+FPI")
why = (
    "The increment form compares a response with the command of 60 cycles before, which "
    "caused it; behind such a delay a filter has to be slow."
)
