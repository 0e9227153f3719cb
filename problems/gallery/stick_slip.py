"""A sledge that sticks and slips, with a model in which its slide is well oiled.

Of the plans the offset-free one wins, by a third: its filter measures the response, as the deformation does, and smooths it with
the states. Computed torque with the iteration, which acts in every cycle, is as good.

LuGre friction (Canudas de Wit, Olsson, Åström, Lischinsky: A new model for control of systems with friction, IEEE Trans.
Automatic Control 40(3), 1995): bristles with the deflection z carry the force f until they slip,

    m x'' = F - f,   f = sigma0 z + sigma1 z' + sigma2 x',   z' = x' - sigma0 |x'| z / g(x'),
    g(v) = F_C + (F_S - F_C) exp(-(v / v_s)^2).

F_C = 1 N, F_S = 1.5 N, v_s = 1 mm/s and sigma2 are those of the paper; its bristles (1e5 N/m) are ten times softer here, with
sigma1 = sqrt(sigma0 m). The model is 30 % too heavy and has a hundredth of the friction (F_C = F_S = 0.01 N): almost
no friction.

Task: x = 50 mm sin 2 t, which reverses twice in pi s; the error counts from 4 s on. The force has a limit of 2 N, and from
2 to 3 s a push of 1 N uses up the rest; no controller measures it.

    rms error, seed 0            x [m]
    CTC                         0.0018
    CTC+FPI                    4.7e-06
    RHC                         0.0012
    RHC+FPI, model-referenced  6.7e-06
    RHC+FPI                    6.9e-06
    RHC offset-free            4.5e-06
    RHC exact model            1.5e-05

"RHC+FPI" is the plain form, as published; the model-referenced row is the affine map with a gain of 0.9.

The exact model's bristles move at 1 000 per second: a stage of 10 ms in one explicit step is unstable, the exact model's plan
has no digits, and is refused. The stages below have 8 sub-steps each, which cures it. All states are given
to the controllers; the deflection z, which nobody can measure, serves the exact model alone: without it the filter is as good.
"""

import casadi as ca
import numpy as np

import fpirhc as fp

SIGMA0, COULOMB, STATIC, STRIBECK = 1e4, 1.0, 1.5, 1e-3  # N/m, N, N, m/s


def sliding(v, coulomb, static, stribeck):
    """Friction in steady sliding without its viscous part, N."""
    return coulomb + (static - coulomb) * ca.exp(-((v / stribeck) ** 2))


def response(q, v, u, p):
    bristle = v.x - p.sigma0 * ca.fabs(v.x) * q.z / sliding(v.x, p.coulomb, p.static, p.stribeck)
    friction = p.sigma0 * q.z + p.sigma1 * bristle + p.sigma2 * v.x
    return {"x": (u.F - friction) / p.mass, "z": bristle}


def motion(t):
    """The nominal deflection of the bristles is that of steady sliding."""
    speed = 0.1 * ca.cos(2 * t)
    return {
        "x": 0.05 * ca.sin(2 * t),
        "z": sliding(speed, COULOMB, STATIC, STRIBECK) / SIGMA0 * ca.tanh(speed / STRIBECK),
    }


plant = fp.Plant(
    coordinates={"x": "m", "z": "m"},
    inputs={"F": "N"},
    order={"x": 2, "z": 1},
    controlled=("x",),
    response=response,
    parameters={
        "mass": fp.Parameter(approximate=1.3, exact=1.0, unit="kg"),
        "sigma0": fp.Parameter(approximate=10.0, exact=SIGMA0, unit="N/m"),
        "sigma1": fp.Parameter(approximate=0.0, exact=100.0, unit="N s/m"),
        "sigma2": fp.Parameter(approximate=0.0, exact=0.4, unit="N s/m"),
        "coulomb": fp.Parameter(approximate=0.01, exact=COULOMB, unit="N"),
        "static": fp.Parameter(approximate=0.01, exact=STATIC, unit="N"),
        "stribeck": fp.Parameter(approximate=STRIBECK, exact=STRIBECK, unit="m/s"),
    },
)

problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(motion),
    start={"x": 0.0, "x'": 0.1, "z": 0.0},
    period=1e-3,  # s
    duration=8.0,  # s
    limits=fp.Limits(inputs={"F": (-2.0, 2.0)}),  # N
    disturbances={"F": fp.Step(at=2.0, duration=1.0, size=1.0)},  # N
    horizon=fp.Horizon(stages=20, step=1e-2, discretisation=fp.RungeKutta4(substeps=8)),
    cost=fp.Quadratic(states={"x": 1e4, "x'": 1e1}, deviation={"F": 1e-2}),
    integrator=fp.RungeKutta4(substeps=4),
    measure_from=4.0,  # s
)

tracking = fp.Exponential(rate=10.0)  # 1/s
optimiser = fp.FixedPointSolver()
plain = fp.RecedingHorizon(optimiser)
sigmoid = fp.Sigmoid(gain=-2.2, shift=0.3, scale=50.0)  # scale in m/s^2
filter = fp.DisturbanceKalman(
    drift={"x": 1e3}, measured={"x": 1e-5, "x'": 1e-4, "x''": 3.0, "z": 1e-4}, noise={"z": 1e-3}
)

controllers = {
    "CTC": fp.ComputedTorque(tracking),
    "CTC+FPI": fp.ComputedTorque(tracking, fp.RFPT(offset=1e4, sign=-1.0, gain=9e-5)),
    "RHC": plain,
    "RHC+FPI, model-referenced": fp.RecedingHorizon(optimiser, fp.ModelReferenced(fp.Affine(gain=-1.8))),
    "RHC+FPI": fp.RecedingHorizon(optimiser, sigmoid),  # the plain form, as published
    "RHC offset-free": fp.Estimating(plain, filter, at_once=True),
    "RHC exact model": fp.ExactModel(plain),
}
headline = ("RHC", "RHC+FPI, model-referenced")
why = (
    "Friction is a force beside the one that is commanded, and the sledge is measured "
    "exactly: PID with poles at 300 1/s removes it by gain."
)
tuning = {
    "CTC+FPI": {"deformation.gain": fp.LogSpan(5e-6, 1.2e-4)},  # s^2/m
    "RHC+FPI, model-referenced": {"deformation.map.gain": fp.LogSpan(-3.0, -0.1)},
    "RHC+FPI": {"deformation.gain": fp.LogSpan(-3.0, -0.1)},
    "RHC offset-free": {
        "estimator.drift.x": fp.LogSpan(1.0, 1e4),  # m/s^2.5
        "estimator.measured.x'": fp.LogSpan(1e-5, 1e-2),  # m/s
    },
}


def friction(run):
    """Friction of the bristles and the oil: sigma0 z + sigma1 z' + sigma2 x', with the plant's parameters, N."""
    speed, bristle = run["state.x'"], run["state.z"]
    grip = COULOMB + (STATIC - COULOMB) * np.exp(-((speed / STRIBECK) ** 2))
    sigma1, sigma2 = (plant.parameters[name].exact for name in ("sigma1", "sigma2"))
    return SIGMA0 * bristle + sigma1 * (speed - SIGMA0 * np.abs(speed) * bristle / grip) + sigma2 * speed


pictures = (
    fp.Portrait(
        "Friction over velocity",
        x="state.x'",
        y=fp.Quantity("friction", "N", friction),
        caption="From 4 s on. At a reversal the bristles bend the other way before they slip: friction lags behind the velocity.",
        since=4.0,
        controllers=("RHC", "RHC+FPI, model-referenced", "RHC exact model"),
    ),
)
