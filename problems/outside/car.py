"""A double lane change at 20 m/s: CommonRoad's drifting car, steered by a kinematic bicycle.

The car has nine states - side slip, yaw, wheels that turn, tyres by Pacejka's formula (CommonRoad vehicle models, BSD-3) -
and its wheels turn at 0.4 rad/s at most. The model knows the wheelbase alone: y'' = v sqrt(v^2 - y'^2) tan(steer) / wheelbase.

    rms error, seed 0      side [m]
    RHC                      0.0084
    RHC+FPI                 0.00058
    RHC+FPI, plain form         5.3
    RHC offset-free         0.00034
    PD                        0.073

A small gain of the plain form delays the steering until the car spins: worse than no adaptation.
"""

import casadi as ca

import fpirhc as fp
from fpirhc.adapters.commonroad import commonroad_body

needs = ("vehiclemodels",)
SPEED, PERIOD = 20.0, 1e-2  # m/s, s
WHEELBASE = 2.5789  # m, BMW 320i


def bicycle(q, v, u, p):
    return {"side": p.speed * ca.sqrt(p.speed**2 - v.side**2) / p.wheelbase * ca.tan(u.steer)}


def lanes(t):
    return {"side": 3.5 / (1 + ca.exp(-2.5 * (t - 2.5))) - 3.5 / (1 + ca.exp(-2.5 * (t - 6.0)))}


def above(q, v, p):
    edges = [fp.Shape.line((-10, side), (10, side)) for side in (-1.75, 1.75, 5.25)]
    return [*edges, fp.Shape.box((0, q.side), 4.5, 1.6, ca.asin(v.side / p.speed))]


plant = fp.Plant(
    coordinates={"side": "m"},
    inputs={"steer": "rad"},
    parameters={"speed": fp.Parameter(SPEED, SPEED, "m/s"), "wheelbase": fp.Parameter(WHEELBASE, WHEELBASE, "m")},
    response=bicycle,
)
problem = fp.Problem(
    plant=plant,
    reality=commonroad_body("std", plant, period=PERIOD, speed=SPEED, names={"side": "y"}),
    reference=fp.Trajectory(lanes),
    start={"side": 0.0},
    period=PERIOD,
    duration=9.0,  # s
    measure_from=0.5,  # s
    limits=fp.Limits(inputs={"steer": (-0.3, 0.3)}),
    horizon=fp.Horizon(stages=20, step=5e-2),
    cost=fp.Quadratic(states={"side": 10.0, "side'": 1.0}, deviation={"steer": 100.0}),
)

optimiser = fp.FixedPointSolver()
plain = fp.RecedingHorizon(optimiser)
filter = fp.DisturbanceKalman(drift={"side": 100.0}, measured={"side": 1e-2, "side'": 1e-2, "side''": 0.1})
controllers = {
    "RHC": plain,
    "RHC+FPI": fp.RecedingHorizon(optimiser, fp.ModelReferenced(fp.Affine(gain=-0.8))),
    "RHC+FPI, plain form": fp.RecedingHorizon(optimiser, fp.Affine(gain=-0.2)),
    "RHC offset-free": fp.Estimating(plain, filter, at_once=True),
    "PD": fp.PID(proportional={"side": 0.1}, derivative={"side": 0.05}),
}
headline = ("RHC", "RHC+FPI")
why = "Tyres answer late, so the iteration's gain stays below one; the filter has a gain of its own for side, rate and response."
pictures = (fp.Planar("The car from above", plant, above, controllers=headline),)
