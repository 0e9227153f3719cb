"""Small problems with baselines that several tests share: a mass with a wrong model, with a horizon and with noise."""

LINE = '''"""A mass on a line with a wrong gain."""
import casadi as ca
import fpirhc as fp

plant = fp.Plant(
    coordinates={"y": "m"},
    inputs={"u": "N"},
    parameters={
        "b": fp.Parameter(approximate=1.0, exact=1.6, unit="1/kg"),
        "k": fp.Parameter(approximate=2.0, exact=5.0, unit="1/s^2"),
    },
    response=lambda q, v, u, p: {"y": p.b * u.u - p.k * q.y},
)
problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"y": ca.sin(2 * t)}),
    start={"y": 0.5},
    period=1e-3,
    duration=0.3,
    measure_from=0.1,
    limits=fp.Limits(inputs={"u": (-25.0, 25.0)}),
    horizon=fp.Horizon(stages=8, step=1e-2),
    cost=fp.Quadratic(states={"y": 100.0, "y'": 1.0}, deviation={"u": 1e-2}),
)
tracking = fp.Exponential(rate=6.0)
optimiser = fp.FixedPoint(iterations=1, tolerance=1e-3)
sigmoid = fp.Sigmoid(gain=-0.5, shift=0.3, scale=50.0)
controllers = {
    "CTC": fp.ComputedTorque(tracking),
    "CTC+FPI": fp.ComputedTorque(tracking, sigmoid),
    "RHC+FPI": fp.RecedingHorizon(optimiser, sigmoid),
}
'''

NOISY = '''"""A mass on a line that is pushed at random."""
import fpirhc as fp

plant = fp.Plant(
    coordinates={"y": "m"},
    inputs={"u": "N"},
    parameters={"b": fp.Parameter(1.0, 1.6, "1/kg")},
    response=lambda q, v, u, p: {"y": p.b * u.u},
)
problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"y": 0 * t}),
    start={"y": 0.0},
    period=1e-3,
    duration=0.3,
    disturbances={"u": fp.Noise(0.5), "y": fp.Noise(2.0)},
)
controllers = {"CTC": fp.ComputedTorque(fp.Exponential(rate=6.0))}
'''
