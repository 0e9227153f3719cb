import casadi as ca

import fpirhc as fp

RPM = 2 * ca.pi / 60  # rad/s
STALL = 0.2354  # N m
FULL = 159 * RPM  # rad/s, at full voltage and no load
DRAG = STALL / FULL  # N m s/rad, of back electromotive force and friction together


def response(w, a, u, p):
    stick = p.coulomb * ca.tanh(w.speed / p.soft)
    slope = p.coulomb * (1 - ca.tanh(w.speed / p.soft) ** 2) / p.soft
    inertia = p.drag * p.mechanical
    torque = inertia * a.speed + p.drag * w.speed + stick
    return {"speed": ((p.stall * u.voltage - torque) / p.electrical - (p.drag + slope) * a.speed) / inertia}


plant = fp.Plant(
    coordinates={"speed": "rad/s"},
    inputs={"voltage": "1"},
    order=2,
    response=response,
    parameters={
        "stall": fp.Parameter(approximate=0.75 * STALL, exact=STALL, unit="N m"),
        "drag": fp.Parameter(approximate=DRAG, exact=DRAG, unit="N m s/rad"),
        "coulomb": fp.Parameter(approximate=0.0, exact=0.004, unit="N m"),
        "soft": fp.Parameter(approximate=0.5, exact=0.5, unit="rad/s"),
        "mechanical": fp.Parameter(approximate=0.2, exact=0.12, unit="s"),
        "electrical": fp.Parameter(approximate=0.035, exact=0.02, unit="s"),
    },
)
BRAKE = 0.08
def brake(t):
    """A finger's torque over time lagged by the torque's own dynamics: what it adds to the speed's second derivative."""
    phase = ca.fmod(t, 4.0)
    rise, fall = (phase - 1.0) / 0.15, (2.5 - phase) / 0.15
    shape = ca.fmax(0, ca.fmin(1, ca.fmin(rise, fall)))
    slope = ca.if_else(ca.logic_and(shape > 0, shape < 1), ca.if_else(rise < fall, 1, -1) / 0.15, 0)
    return -BRAKE * (shape / 0.02 + slope) / (DRAG * 0.12)

def motor(sensing, period=1e-2):
    return fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"speed": 60 * RPM + 0 * t}),
    start={"speed": 60 * RPM},
    period=period,
    duration=60.0,
    limits=fp.Limits(inputs={"voltage": (0.0, 1.0)}),
    disturbances={"speed": fp.Formula(brake)},
    sensing=sensing,
    horizon=fp.Horizon(stages=20, step=2e-2),
    cost=fp.Quadratic(states={"speed": 1.0, "speed'": 1e-3}, correction={"voltage": 1e-1}),
    measure_from=4.0)
