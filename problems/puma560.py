"""The six joints of a PUMA 560 with its published parameters: computed torque, adaptive inverse dynamics, Slotine and Li.

Kinematics, masses, inertias, gears, rotors and friction are those of P. I. Corke, B. Armstrong-Helouvry, A search for
consensus among model parameters reported for the PUMA 560 robot, IEEE ICRA 1994, in standard Denavit-Hartenberg frames, as
distributed with P. Corke's Robotics Toolbox (MIT licence). Coulomb friction is the mean of both directions, smoothed over
0.05 rad/s. Torque limits are those of B. Armstrong, O. Khatib, J. Burdick, IEEE ICRA 1986 (from memory). The inverse
dynamics is a recursive Newton-Euler one, and its mass matrix is its derivative by the accelerations; both agree with the
toolbox's printed inertia and gravity load at the 'nominal' posture (those from memory). A load of 1.5 kg, 0.1 m beyond the
wrist, is added here. The model has links 2 and 3 a fifth too light, half the viscous and none of the Coulomb friction, and
no load; 15 parameters are learned.

Errors count from 2 s on:

    rms error, seed 0    q1 [rad]    q2 [rad]    q3 [rad]    q4 [rad]    q5 [rad]    q6 [rad]
    CT                      0.015      0.0052       0.025      0.0084       0.015      0.0084
    CT+FPI                0.00022       8e-05     0.00027     0.00012     0.00018     0.00012
    AID                   0.00059      0.0021      0.0035     0.00044      0.0014      0.0029
    AID+FPI               4.3e-05       2e-05     4.3e-05       3e-05     3.9e-05       5e-05
    Slotine-Li            7.1e-05     0.00056      0.0006     0.00053      0.0029     6.4e-05

The arm starts at rest while the motion does not, so the first second shows that transient in all of them.
"""

import casadi as ca

import fpirhc as fp

# Standard Denavit-Hartenberg: twist rad, length m, offset m.
FRAMES = (
    (ca.pi / 2, 0.0, 0.0),
    (0.0, 0.4318, 0.0),
    (-ca.pi / 2, 0.0203, 0.15005),
    (ca.pi / 2, 0.0, 0.4318),
    (-ca.pi / 2, 0.0, 0.0),
    (0.0, 0.0, 0.0),
)
CENTRES = (
    (0.0, 0.0, 0.0),
    (-0.3638, 0.006, 0.2275),
    (-0.0203, -0.0141, 0.070),
    (0.0, 0.019, 0.0),
    (0.0, 0.0, 0.0),
    (0.0, 0.0, 0.032),
)  # m
INERTIAS = (
    (0.0, 0.35, 0.0),
    (0.13, 0.524, 0.539),
    (0.066, 0.086, 0.0125),
    (1.8e-3, 1.3e-3, 1.8e-3),
    (0.3e-3, 0.4e-3, 0.3e-3),
    (0.15e-3, 0.15e-3, 0.04e-3),
)  # kg m^2, about the centre of mass, diagonal
GEARS = (-62.6111, 107.815, -53.7063, 76.0364, 71.923, 76.686)
ROTORS = (200e-6, 200e-6, 200e-6, 33e-6, 33e-6, 33e-6)  # kg m^2
VISCOUS = (1.48e-3, 0.817e-3, 1.38e-3, 71.2e-6, 82.6e-6, 36.7e-6)  # N m s, at the motor
COULOMB = (0.415, 0.0985, 0.1185, 0.01405, 0.01188, 0.00723)  # N m, at the motor, mean of both directions
GRIP = (0.0, 0.0, 0.1)  # m, of the load beyond the wrist
GRAVITY = 9.81  # m/s^2


def rotation(angle, twist):
    c, s, ct, st = ca.cos(angle), ca.sin(angle), ca.cos(twist), ca.sin(twist)
    rows = ((c, -s * ct, s * st), (s, c * ct, -c * st), (0, st, ct))
    return ca.vertcat(*(ca.horzcat(*row) for row in rows))


def torques(q, v, a, p):
    """Recursive Newton-Euler: accelerations outwards, forces inwards."""
    masses, axis = (0.0, p.m2, p.m3, 0.82, 0.34, 0.09), ca.DM([0, 0, 1])
    turns = [rotation(q[k], FRAMES[k][0]) for k in range(6)]
    arms = [
        ca.DM([length, offset * float(ca.sin(twist)), offset * float(ca.cos(twist))])
        for twist, length, offset in FRAMES
    ]
    spin, twirl, lift = ca.SX.zeros(3), ca.SX.zeros(3), ca.SX([0, 0, GRAVITY])
    pushes, couples = [], []
    for k in range(6):
        twirl = turns[k].T @ (twirl + axis * a[k] + ca.cross(spin, axis * v[k]))
        spin = turns[k].T @ (spin + axis * v[k])
        lift = turns[k].T @ lift + swept(spin, twirl, arms[k])
        centre, tensor = ca.DM(CENTRES[k]), ca.diag(ca.DM(INERTIAS[k]))
        push = masses[k] * (lift + swept(spin, twirl, centre))
        couple = ca.cross(arms[k] + centre, push) + tensor @ twirl + ca.cross(spin, tensor @ spin)
        if k == 5:
            held = p.load * (lift + swept(spin, twirl, ca.DM(GRIP)))
            push, couple = push + held, couple + ca.cross(arms[k] + ca.DM(GRIP), held)
        pushes.append(push)
        couples.append(couple)
    force, moment, joint_torques = ca.SX.zeros(3), ca.SX.zeros(3), [None] * 6
    for k in reversed(range(6)):
        moment = moment + couples[k] + ca.cross(arms[k], force)
        force = force + pushes[k]
        joint_torques[k] = ca.dot(moment, turns[k].T @ axis) + GEARS[k] ** 2 * ROTORS[k] * a[k]
        moment, force = turns[k] @ moment, turns[k] @ force
    return ca.vertcat(*joint_torques)


def swept(spin, twirl, arm):
    return ca.cross(twirl, arm) + ca.cross(spin, ca.cross(spin, arm))


def friction(v, p):
    viscous, level = ca.vertcat(*(p[f"b{k}"] for k in range(1, 7))), ca.vertcat(*(p[f"c{k}"] for k in range(1, 7)))
    return viscous * v + level * ca.tanh(v / 0.05)


def response(q, v, u, p):
    a = ca.SX.sym("a", 6)
    torque = torques(q.vector, v.vector, a, p)
    mass = ca.jacobian(torque, a)
    free = ca.substitute(torque, a, ca.SX.zeros(6)) + friction(v.vector, p)
    accelerations = ca.solve(ca.substitute(mass, a, ca.SX.zeros(6)), u.vector - free)
    return {f"q{k + 1}": accelerations[k] for k in range(6)}


def inverse(q, v, r, p):
    torque = torques(q.vector, v.vector, r.vector, p) + friction(v.vector, p)
    return {f"tau{k + 1}": torque[k] for k in range(6)}


def joint_parameters():
    parameters = {}
    for k in range(6):
        viscous, level = VISCOUS[k] * GEARS[k] ** 2, COULOMB[k] * abs(GEARS[k])
        parameters[f"b{k + 1}"] = fp.Parameter(approximate=0.5 * viscous, exact=viscous, unit="N m s")
        parameters[f"c{k + 1}"] = fp.Parameter(approximate=0.0, exact=level, unit="N m")
    return parameters


plant = fp.Plant(
    coordinates={f"q{k}": "rad" for k in range(1, 7)},
    inputs={f"tau{k}": "N m" for k in range(1, 7)},
    order=2,
    response=response,
    inverse=inverse,
    parameters={
        "m2": fp.Parameter(approximate=14.0, exact=17.4, unit="kg"),
        "m3": fp.Parameter(approximate=3.8, exact=4.8, unit="kg"),
        "load": fp.Parameter(approximate=0.0, exact=1.5, unit="kg"),
        **joint_parameters(),
    },
)


def motion(t):
    return {
        "q1": 0.8 * ca.sin(1.1 * t),
        "q2": 0.8 + 0.4 * ca.sin(1.7 * t),
        "q3": -1.2 + 0.5 * ca.sin(2.1 * t),
        "q4": 0.6 * ca.sin(1.3 * t),
        "q5": 0.5 + 0.5 * ca.sin(1.9 * t),
        "q6": 0.7 * ca.sin(2.4 * t),
    }


LIMITS = (97.6, 186.4, 89.4, 24.2, 20.1, 21.3)  # N m

problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(motion),
    start={"q1": 0.0, "q2": 0.8, "q3": -1.2, "q4": 0.0, "q5": 0.5, "q6": 0.0},
    period=1e-3,  # s
    duration=8.0,  # s
    limits=fp.Limits(inputs={f"tau{k + 1}": (-most, most) for k, most in enumerate(LIMITS)}),
    measure_from=2.0,  # s
)
bounds = {"m2": (5.0, 30.0), "m3": (1.0, 10.0), "load": (0.0, 4.0)}
for _k in range(6):
    _viscous, _level = VISCOUS[_k] * GEARS[_k] ** 2, COULOMB[_k] * abs(GEARS[_k])
    bounds |= {f"b{_k + 1}": (0.0, 3 * _viscous), f"c{_k + 1}": (0.0, 3 * _level)}

tracking = fp.Exponential(rate=10.0)
sigmoid = fp.Sigmoid(gain=-0.8, shift=0.3, scale=50.0)
adaptation = fp.LyapunovRule(
    {name: (upper - lower) ** 2 for name, (lower, upper) in bounds.items()}
)  # 1/s, in squared widths
projection = fp.Projection(gain=1e-2, dead_zone=0.3)  # dead zone in rad/s^2
damping = {"q1": 40.0, "q2": 40.0, "q3": 15.0, "q4": 2.0, "q5": 2.0, "q6": 2.0}  # N m s

controllers = {
    "CT": fp.ComputedTorque(tracking),
    "CT+FPI": fp.ComputedTorque(tracking, sigmoid),
    "AID": fp.rivals.AdaptiveInverseDynamics(tracking, adaptation, bounds),
    "AID+FPI": fp.rivals.AdaptiveInverseDynamics(tracking, projection, bounds, deformation=sigmoid),
    "Slotine-Li": fp.rivals.SlotineLi(10.0, damping, adaptation, bounds),
}
headline = ("CT", "CT+FPI")
why = "Load and friction are torques at driven joints, measured without noise: PID with poles at 300 1/s needs no model of them."
