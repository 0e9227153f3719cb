"""A three-link arm whose drives send coarse velocities: where Slotine and Li do better than fixed-point iteration.

The arm hangs in a vertical plane and has the size of a human one. Lengths (0.186, 0.146, 0.108 of the height), masses
(0.028, 0.016, 0.006 of the body's), centres of mass and radii of gyration are those of D. A. Winter, Biomechanics and Motor
Control of Human Movement (2009), table 4.1 (from memory), for 1.75 m and 75 kg; it holds 1 kg in the hand. Friction is
chosen here. The model's masses are a quarter too small, and its load is a fifth of the true one.

Every controller is given positions in counts of 2 pi / 4096 rad and velocities in steps of 0.05 rad/s, as a drive sends them;
accelerations are differences of these velocities behind a low-pass of 1/600 s. One step of a velocity changes the acceleration
by 30 rad/s^2. Fixed-point iteration feeds that acceleration back; the law of Slotine and Li needs only the velocity. Errors
count from 10 s on:

    rms error, seed 0    q1 [rad]    q2 [rad]    q3 [rad]
    CT                      0.044        0.15        0.38
    CT+FPI                0.00095      0.0029      0.0071
    CT+FPI, half gain      0.0015      0.0055       0.015
    AID                    0.0025      0.0039      0.0037
    AID+FPI               0.00084      0.0011      0.0013
    Slotine-Li            0.00092       0.001      0.0016

Slotine-Li is more precise than FPI here, and its torque moves a tenth as much, because the velocity is coarse and the motion
excites every parameter that matters; a learned model is then better than a corrected one. FPI is better at first, because it
need not learn. The sensors were chosen to show this.
"""

import casadi as ca

import fpirhc as fp

LENGTH = (0.3255, 0.2555, 0.189)  # m: 0.186, 0.146, 0.108 of the height
CENTRE = (0.436, 0.430, 0.506)  # of the length
GRAVITY = 9.81  # m/s^2


def mass(q, p):
    """M = sum of m J^T J + I w w^T over the links and the load, J the Jacobian of the centre of mass."""
    masses, inertias = (p.m1, p.m2, p.m3), (p.I1, p.I2, p.I3)
    total, turning = ca.SX.zeros(3, 3), ca.SX.zeros(3)
    for k in range(3):
        turning[k] = 1
        slope = ca.jacobian(point(q, k, CENTRE[k]), q)
        total += masses[k] * slope.T @ slope + inertias[k] * turning @ turning.T
    slope = ca.jacobian(point(q, 2, 1.0), q)
    return total + p.load * slope.T @ slope


def point(q, link, share):
    """A point at this share of the link's length; angles from the horizontal, q relative to the link before."""
    angles = [q[0], q[0] + q[1], q[0] + q[1] + q[2]]
    reach = [*LENGTH[:link], share * LENGTH[link]]
    ends = list(zip(reach, angles, strict=False))
    return ca.vertcat(sum(r * ca.cos(a) for r, a in ends), sum(r * ca.sin(a) for r, a in ends))


def forces(q, v, p):
    """Centrifugal and Coriolis forces, M' v - d(v^T M v / 2)/dq; gravity; viscous friction."""
    momentum = mass(q, p) @ v
    moving = ca.jtimes(momentum, q, v) - ca.gradient(ca.dot(v, momentum) / 2, q)
    height = [point(q, k, CENTRE[k])[1] for k in range(3)] + [point(q, 2, 1.0)[1]]
    weight = sum(m * h for m, h in zip((p.m1, p.m2, p.m3, p.load), height, strict=True))
    return moving + GRAVITY * ca.gradient(weight, q) + ca.vertcat(p.b1, p.b2, p.b3) * v


def response(q, v, u, p):
    accelerations = ca.solve(mass(q.vector, p), u.vector - forces(q.vector, v.vector, p))
    return {"q1": accelerations[0], "q2": accelerations[1], "q3": accelerations[2]}


def inverse(q, v, r, p):
    torque = mass(q.vector, p) @ r.vector + forces(q.vector, v.vector, p)
    return {"tau1": torque[0], "tau2": torque[1], "tau3": torque[2]}


plant = fp.Plant(
    coordinates={"q1": "rad", "q2": "rad", "q3": "rad"},
    inputs={"tau1": "N m", "tau2": "N m", "tau3": "N m"},
    order=2,
    response=response,
    inverse=inverse,
    parameters={
        "m1": fp.Parameter(approximate=1.6, exact=2.1, unit="kg"),
        "m2": fp.Parameter(approximate=0.9, exact=1.2, unit="kg"),
        "m3": fp.Parameter(approximate=0.35, exact=0.45, unit="kg"),
        "I1": fp.Parameter(approximate=0.018, exact=0.0231, unit="kg m^2"),
        "I2": fp.Parameter(approximate=0.006, exact=0.0072, unit="kg m^2"),
        "I3": fp.Parameter(approximate=0.001, exact=0.0014, unit="kg m^2"),
        "load": fp.Parameter(approximate=0.2, exact=1.0, unit="kg"),
        "b1": fp.Parameter(approximate=0.1, exact=0.5, unit="N m s"),
        "b2": fp.Parameter(approximate=0.1, exact=0.4, unit="N m s"),
        "b3": fp.Parameter(approximate=0.05, exact=0.2, unit="N m s"),
    },
)


def motion(t):
    return {"q1": -1.0 + 0.6 * ca.sin(2.0 * t), "q2": 0.9 + 0.5 * ca.sin(3.1 * t), "q3": 0.2 + 0.4 * ca.sin(4.3 * t)}


problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(motion),
    start={"q1": -1.0, "q2": 0.9, "q3": 0.2, "q1'": 1.2, "q2'": 1.55, "q3'": 1.72},
    period=1e-3,  # s
    duration=20.0,  # s
    limits=fp.Limits(inputs={"tau1": (-80.0, 80.0), "tau2": (-40.0, 40.0), "tau3": (-15.0, 15.0)}),  # N m
    sensing=fp.Sensing(
        {
            **dict.fromkeys(plant.coordinates, fp.Sensor(quantum=6.283185 / 4096)),  # rad
            **{f"{name}'": fp.Sensor(quantum=0.05) for name in plant.coordinates},  # rad/s
        },
        fp.LowPassDifference(time_constant=1 / 600),  # s
    ),
    measure_from=10.0,  # s
)

bounds = {
    "m1": (0.2, 5.0),
    "m2": (0.2, 3.0),
    "m3": (0.1, 1.5),
    "I1": (0.001, 0.1),
    "I2": (0.001, 0.03),
    "I3": (0.0005, 0.01),
    "load": (0.0, 3.0),
    "b1": (0.0, 2.0),
    "b2": (0.0, 2.0),
    "b3": (0.0, 1.0),
}
tracking = fp.Exponential(rate=8.0)
sigmoid = fp.Sigmoid(gain=-0.8, shift=0.3, scale=50.0)
adaptation = fp.LyapunovRule(
    {name: (upper - lower) ** 2 for name, (lower, upper) in bounds.items()}
)  # 1/s, in squared widths
slow = fp.LyapunovRule({name: 0.1 * gain for name, gain in adaptation.gains.items()})
damping = {"q1": 8.0, "q2": 3.0, "q3": 0.5}  # N m s


controllers = {
    "CT": fp.ComputedTorque(tracking),
    "CT+FPI": fp.ComputedTorque(tracking, sigmoid),
    "CT+FPI, half gain": fp.ComputedTorque(tracking, sigmoid.with_effective_gain(sigmoid.effective_gain() / 2)),
    "AID": fp.rivals.AdaptiveInverseDynamics(tracking, slow, bounds),
    "AID+FPI": fp.rivals.AdaptiveInverseDynamics(tracking, slow, bounds, deformation=sigmoid),
    "Slotine-Li": fp.rivals.SlotineLi(8.0, damping, adaptation, bounds),
}
headline = ("CT", "CT+FPI")
why = (
    "A step of the measured velocity moves the acceleration by more than the motion does; ADRC needs "
    "the angles alone, the iteration the acceleration."
)
