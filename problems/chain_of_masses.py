"""A chain of masses hanging between a wall and a driven end: a common benchmark of optimisers, with a drive that yields.

The chain of L. Wirsching, H. G. Bock and M. Diehl in the form of acados (BSD licence): equal masses joined by springs, the
first one held in the wall at the origin, the last one moved with the velocity u, |u| <= 1 m/s along each axis,

    m x_k'' = F(x_{k+1} - x_k) - F(x_k - x_{k-1}) - m g e_z,    F(d) = D (1 - L / |d|) d,
    x_end'  = u - droop F(x_end - x_before).

m, D, L, the limits, 40 stages of 0.2 s, and the push at the start are those of acados: from rest the end is moved with u =
(-1, 1, 1) for one second. Here the end is to return to (1, 0, 0) (in acados to 6 L per spring), and the second wall and the
random disturbances are left out. `chain(masses)` counts the wall and the end as acados does: 3, 5 and 7 masses have 9, 21
and 33 states. The free masses have order 2, the end has order 1, and the response of the end is prescribed and deformed.

`droop` is ours: the chain's pull slows the drive, and the model has no droop. chain(3, droop=0) is the plant of acados, whose
drive follows its command exactly; adaptation has nothing to correct there and only adds its own lag. Two weights differ from
acados too: positions of free masses are not weighed, and velocities a tenth as much, because the model is wrong about the
position in which the chain rests.

Errors of the end count from 4 s on:

    rms error, seed 0             xe [m]     ye [m]     ze [m]
    RHC                            0.029      1e-05      0.028
    RHC+FPI, model-referenced    2.4e-05    1.5e-05       0.04
    RHC+FPI                      0.00012    7.1e-05       0.04
    RHC exact model              1.2e-05    6.2e-06    7.6e-06

"RHC+FPI" is the plain form. Adaptation removes the error of the drive, which is all of the error in x. It makes z
worse: the model hangs lower than the chain does, so the plan holds the end higher, and a yielding drive happens to
prevent this. With adaptation the drive follows the plan. No deformation of the end's velocity can correct a wrong
weight of the masses in between. A velocity is at its limit at the start.
"""

import itertools

import casadi as ca
import numpy as np
from scipy.optimize import root

import fpirhc as fp

END = (1.0, 0.0, 0.0)  # m, where the end is to rest
PUSH = (-1.0, 1.0, 1.0)  # m/s, how the end is moved away from there for one second before the run
GRAVITY = 9.81  # m/s^2


def accelerations(free, end, p):
    """Accelerations of the free masses, and the pull of the chain on its end."""
    nodes = [ca.SX.zeros(3), *free, end]
    spans = [b - a for a, b in itertools.pairwise(nodes)]
    pulls = [p.D * (1 - p.L / ca.norm_2(s)) * s for s in spans]
    weight = ca.DM([0, 0, -GRAVITY])
    return [(right - left) / p.m + weight for left, right in itertools.pairwise(pulls)], -pulls[-1]


def response_of(masses):
    def response(q, v, u, p):
        free = [ca.vertcat(*(q[f"{axis}{k}"] for axis in "xyz")) for k in range(1, masses - 1)]
        free_accelerations, pull = accelerations(free, ca.vertcat(q.xe, q.ye, q.ze), p)
        named = {
            f"{axis}{k}": free_accelerations[k - 1][i] for k in range(1, masses - 1) for i, axis in enumerate("xyz")
        }
        drift = p.droop * pull
        return {**named, "xe": u.ux + drift[0], "ye": u.uy + drift[1], "ze": u.uz + drift[2]}

    return response


def plant_of(masses, droop):
    free = [f"{axis}{k}" for k in range(1, masses - 1) for axis in "xyz"]
    end = ("xe", "ye", "ze")
    return fp.Plant(
        coordinates=dict.fromkeys([*free, *end], "m"),
        inputs={"ux": "m/s", "uy": "m/s", "uz": "m/s"},
        order={**dict.fromkeys(free, 2), **dict.fromkeys(end, 1)},
        controlled=end,
        response=response_of(masses),
        parameters={
            "m": fp.Parameter(approximate=0.036, exact=0.033, unit="kg"),
            "D": fp.Parameter(approximate=0.95, exact=1.0, unit="N/m"),
            "L": fp.Parameter(approximate=0.033, exact=0.033, unit="m"),
            "droop": fp.Parameter(approximate=0.0, exact=droop, unit="m/(N s)"),
        },
    )


def rest(plant):
    """The exact plant's state at rest with its end held at END, by a root finder."""
    size = len(plant.coordinates)
    free = ca.SX.sym("free", size - 3)
    still = ca.vertcat(free, ca.DM(END), ca.SX.zeros(size - 3))
    force = plant.equations.response(still, [0, 0, 0], plant.exact)[: size - 3]
    value = ca.Function("force", [free], [force])
    slope = ca.Function("slope", [free], [ca.jacobian(force, free)])
    fraction = np.arange(1, size // 3)[:, None] / (size // 3)
    guess = fraction * np.array(END) + 4 * fraction * (1 - fraction) * [0, 0, -0.3]
    equilibrium = root(lambda w: value(w).full().ravel(), guess.ravel(), jac=lambda w: slope(w).full())
    if not equilibrium.success:
        raise RuntimeError(f"no rest position found: {equilibrium.message}")
    return np.concatenate([equilibrium.x, END, np.zeros(size - 3)])


def chain(masses, droop=0.2):
    """The problem with this many masses, the one in the wall and the driven end included."""
    plant = plant_of(masses, droop)
    target = rest(plant)
    start = fp.RungeKutta4(200).step(plant, 1.0)(target, PUSH, plant.exact, 0).full().ravel()
    elements = plant.state.elements
    speeds = elements[len(plant.names) :]
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {c: float(v) + 0 * t for c, v in zip(plant.names, target, strict=False)}),
        start={e: float(v) for e, v in zip(elements, start, strict=True)},
        period=1e-2,  # s
        duration=10.0,  # s
        limits=fp.Limits(inputs=dict.fromkeys(plant.inputs, (-1.0, 1.0))),  # m/s
        horizon=fp.Horizon(stages=40, step=0.2, discretisation=fp.RungeKutta4(2)),
        cost=fp.Quadratic(
            states={**dict.fromkeys(speeds, 0.2), **dict.fromkeys(("xe", "ye", "ze"), 2.0 * (masses - 1))},
            # Free positions are not weighed: where they rest is what the model has wrong.
            deviation=dict.fromkeys(plant.inputs, 2e-2),
        ),
        measure_from=4.0,  # s
    )


problem = chain(3)
optimiser = fp.FixedPointSolver()
sigmoid = fp.Sigmoid(gain=-1.0, shift=0.3, scale=5.0)  # scale in m/s

controllers = {
    "RHC": fp.RecedingHorizon(optimiser),
    "RHC+FPI, model-referenced": fp.RecedingHorizon(optimiser, fp.ModelReferenced(sigmoid)),
    "RHC+FPI": fp.RecedingHorizon(optimiser, sigmoid),  # the plain form, as published
    "RHC exact model": fp.ExactModel(fp.RecedingHorizon(optimiser)),
}
headline = ("RHC", "RHC+FPI, model-referenced")
why = (
    "The drive yields where the command acts, which one cycle of the iteration corrects; ADRC "
    "takes the pull of swinging masses for a disturbance."
)
