"""A quadrotor of RotorPy on a circle in wind, with a payload that the model does not know, behind a point mass.

The vehicle (RotorPy's Hummingbird, MIT) has motors that lag, drag, and an attitude loop; it flies 2 m around at 0.2 Hz in a
wind of 3 m/s and carries 0.15 kg. The model is the point mass r'' = thrust - g. Scenarios draw wind and payload.

    rms error, seed 0      x [m]      y [m]      z [m]
    RHC                     0.24       0.12       0.34
    RHC+FPI               0.0098     0.0091     0.0023
    RHC+FPI, plain form    0.097      0.092      0.015
    RHC offset-free       0.0077     0.0072     0.0004
    SE3 of RotorPy          0.32       0.14       0.19
"""

import casadi as ca

import fpirhc as fp
from fpirhc.adapters.rotorpy import rotorpy_body, se3_law

needs = ("rotorpy",)
PERIOD, TURN, AXES = 1e-2, 2 * ca.pi * 0.2, ("x", "y", "z")  # s, rad/s

plant = fp.Plant(
    coordinates=dict.fromkeys(AXES, "m"),
    inputs={f"thrust_{n}": "m/s^2" for n in AXES},
    parameters={"g": fp.Parameter(approximate=9.81, exact=9.81, unit="m/s^2")},
    response=lambda _q, _v, u, p: {"x": u.thrust_x, "y": u.thrust_y, "z": u.thrust_z - p.g},
)
start = {"x": 2.0, "y'": 2 * TURN}


def above(q, _v, _p):
    return [fp.Shape.disc((q.x + a, q.y + b), 0.1) for a in (-0.2, 0.2) for b in (-0.2, 0.2)]


reality = fp.ExternalPlant(
    make=lambda told, _: (
        rotorpy_body(plant, period=PERIOD, start=start, wind=(told["wind"], 0.0, 0.0), payload=told["payload"]).body
    ),
    measures={n + dash: unit for dash, unit in {"": "m", "'": "m/s", "''": "m/s^2"}.items() for n in AXES},
    parameters={
        "wind": fp.Parameter(0.0, 3.0, "m/s", spread=fp.Uniform(absolute=3.0)),
        "payload": fp.Parameter(0.0, 0.15, "kg", bounds=(-1e-9, 1.0), spread=fp.Uniform(absolute=0.15)),
    },
)
weights = dict.fromkeys(AXES, 100.0) | {f"{n}'": 5.0 for n in AXES}
problem = fp.Problem(
    plant=plant,
    reality=reality,
    reference=fp.Trajectory(lambda t: {"x": 2 * ca.cos(TURN * t), "y": 2 * ca.sin(TURN * t), "z": 0 * t}),
    start={"y": 0.0, "z": 0.0, **start},
    period=PERIOD,
    duration=8.0,  # s, one turn is counted
    measure_from=3.0,  # s
    limits=fp.Limits(inputs={"thrust_x": (-8.0, 8.0), "thrust_y": (-8.0, 8.0), "thrust_z": (2.0, 20.0)}),
    horizon=fp.Horizon(stages=20, step=5e-2),
    cost=fp.Quadratic(states=weights, deviation=dict.fromkeys(plant.inputs, 1.0)),
)
plain = fp.RecedingHorizon(optimiser := fp.FixedPointSolver())
deviations = {**{f"{n}{dash}": 0.01 for n in AXES for dash in ("", "'")}, "x''": 1.0, "y''": 1.0, "z''": 0.1}
filter = fp.DisturbanceKalman(drift={"x": 1.0, "y": 1.0, "z": 10.0}, measured=deviations)  # slower where attitude lags
controllers = {
    "RHC": plain,
    "RHC+FPI": fp.RecedingHorizon(optimiser, fp.ModelReferenced(fp.Affine(gain=-0.4))),
    "RHC+FPI, plain form": fp.RecedingHorizon(optimiser, fp.Affine(gain=-0.1)),
    "RHC offset-free": fp.Estimating(plain, filter, at_once=True),
    "SE3 of RotorPy": fp.ComputedTorque(se3_law()),
}
headline = ("RHC", "RHC+FPI")
why = "Wind and payload change slowly and the attitude lags: a filter may be slower sideways, and one gain for all axes may not."
pictures = (fp.Planar("The quadrotor from above", plant, above, controllers=headline),)
