"""A brushless gear motor held at 60 rpm while a finger brakes it: noise, two derivatives by differences, a wrong model.

The motor is the FIT0441 (12 V, 159 rpm, stall torque 0.235 N m, 270 encoder pulses per turn), on which J. K. Tar's group ran
eq. (3) on an Arduino, without a filter: the mean of their data at a nominal 60 rpm is 59.94 rpm. The torque lags, so the
second derivative of the speed answers the voltage,

    T_e tau' = tau_stall u - tau,     J speed' = tau - B speed - tau_c tanh(speed / soft) - tau_finger.

The values that the data sheet lacks (time constants, Coulomb friction, the finger's 0.08 N m for 1.5 s every 4 s, jitter)
are chosen here.

The coordinate is the speed. The encoder times the edges of every cycle (2.7 at 60 rpm) with a clock of 4 us: the mean
speed of the last cycle, 5 ms late, with a jitter of 2 % of an edge's period, 0.74 % of the speed, and a quantum of 0.04 %.
With the angle as the coordinate a third derivative would be left to differences of whole pulses.

Speed and its derivatives are fitted to five samples; the response is late by two cycles, dead time included. A gain that is
not given the delay oscillates, or is refused before the run. Errors of the true speed count from 4 s on:

    rms error, seed 0          speed [rad/s]
    RHC                                 0.59
    RHC+FPI                             0.11
    RHC+FPI (eq 3)                      0.12
    RHC+FPI, filtered error             0.12
    RHC+FPI, tuned                      0.12
    RHC+FPI, delay not told              2.2
    RHC exact model                     0.93

RHC with the exact parameters is no bound here: it has no finger in its model, and the weak motor of the wrong model happens
to need the additional voltage that the finger needs.
"""

import casadi as ca

import fpirhc as fp

RPM = 2 * ca.pi / 60  # rad/s
STALL, FULL = 0.2354, 159 * RPM  # N m, rad/s
DRAG = STALL / FULL  # N m s/rad, back electromotive force and bearings together
MECHANICAL, ELECTRICAL = 0.12, 0.02  # s
PERIOD = 1e-2  # s


def response(w, a, u, p):
    direction = ca.tanh(w.speed / p.soft)
    inertia = p.drag * p.mechanical
    torque = inertia * a.speed + p.drag * w.speed + p.coulomb * direction
    lagged = (p.stall * u.voltage - torque) / p.electrical
    return {"speed": (lagged - (p.drag + p.coulomb * (1 - direction**2) / p.soft) * a.speed) / inertia}


def finger(t):
    """The effect of a braking torque with ramps of 0.15 s on the second derivative of the speed: -(tau / T_e + tau') / J."""
    since = ca.fmod(t, 4.0) - 1.0
    share = ca.fmax(0, ca.fmin(1, ca.fmin(since, 1.5 - since) / 0.15))
    slope = ca.if_else(ca.logic_and(share > 0, share < 1), ca.if_else(since < 0.75, 1, -1) / 0.15, 0)
    return -0.08 * (share / ELECTRICAL + slope) / (DRAG * MECHANICAL)


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
        "mechanical": fp.Parameter(approximate=0.2, exact=MECHANICAL, unit="s"),
        "electrical": fp.Parameter(approximate=0.035, exact=ELECTRICAL, unit="s"),
    },
)
encoder = fp.Sensor(noise=fp.Noise(0.0074 * 60 * RPM), quantum=4e-6 / PERIOD * 60 * RPM)

problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"speed": 60 * RPM + 0 * t}),
    start={"speed": 60 * RPM},
    period=PERIOD,
    duration=24.0,  # s
    limits=fp.Limits(inputs={"voltage": (0.0, 1.0)}),
    disturbances={"speed": fp.Formula(finger)},
    dead_time=fp.DeadTime(measurement=PERIOD / 2),
    sensing=fp.Sensing({"speed": encoder}, fp.SavitzkyGolay(window=5, degree=2)),
    horizon=fp.Horizon(stages=20, step=2e-2),
    cost=fp.Quadratic(states={"speed": 1.0, "speed'": 1e-3}, deviation={"voltage": 10.0}),
    measure_from=4.0,  # s
)

late = problem.response_delay  # cycles; the estimator's own delay is certain, so nothing leaks
optimiser = fp.FixedPointSolver()
sigmoid = fp.Sigmoid(gain=-1.0, shift=0.3, scale=5e3)  # scale in rad/s^3
gentle = fp.Sigmoid(gain=-0.25, shift=0.3, scale=5e3)
adaptive = fp.Increment(sigmoid, cycles=late, uncertainty=0)

controllers = {
    "RHC": fp.RecedingHorizon(optimiser),
    "RHC+FPI": fp.RecedingHorizon(optimiser, adaptive),
    "RHC+FPI (eq 3)": fp.RecedingHorizon(
        optimiser, fp.Increment(fp.RFPT(offset=1e6, sign=-1.0, gain=4e-7), cycles=late, uncertainty=0)
    ),
    "RHC+FPI, filtered error": fp.RecedingHorizon(
        optimiser, fp.Increment(fp.Filtered(sigmoid, pole=0.5), cycles=late, uncertainty=0)
    ),
    "RHC+FPI, tuned": fp.RecedingHorizon(
        optimiser, fp.Increment(fp.Tuned(gentle, largest_gain=0.4), cycles=late, uncertainty=0)
    ),
    "RHC+FPI, delay not told": fp.RecedingHorizon(optimiser, gentle),
    "RHC exact model": fp.ExactModel(fp.RecedingHorizon(optimiser)),
}
headline = ("RHC", "RHC+FPI")
why = (
    "The finger acts where the voltage does; told of its delay the iteration answers within "
    "cycles, and a filter has to average the encoder's jitter."
)
