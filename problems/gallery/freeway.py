"""Emission of a freeway, held by its ramp: an iteration on the stationary map of a model that knows only the main factors.

After J. K. Tar, L. Nadai, I. J. Rudas, T. A. Varkonyi, Adaptive emission control of freeway traffic using quasi-stationary
solutions of an approximate hydrodynamic model, J. Applied Nonlinear Dynamics 1(1), 2012 (known here by its abstract). The
freeway is METANET with its published numbers (see `freeway_metering`). The emission of n cars at the speed v is n v (1374/v
+ 47.5 + 0.00867 v^2) g/h: idling, rolling and air drag of a car of 1400 kg, chosen here.

The model has no waves and no merging: every segment has the speed at which its flow settles, with wrong numbers. Its emission
follows the metering rate r at once (order 0), and it takes the mainstream for 2500 veh/h, which really swings by 80 veh/h.

Task: a metering rate per minute holds the emission of the network at 2140 kg/h +- 25 kg/h. 1100 veh/h come to the ramp, more
than it may let in. Errors count from half an hour on.

    rms error, seed 0    emission [kg/h]
    static map                        72
    static map+FPI                   1.6
    PI                               1.6

The wrong map asks for more than the largest rate all the time. The exact map has no error at rest; what is left of it are
the mainstream and the time that traffic takes to settle. The iteration makes up for all three. It is `Cascade`, which
deforms the target and compares at once; a lag of a minute before it compares allows less gain, and is worse.

It is a draw with a PI law on the measured emission, without any model. Both add up the error once a minute:

    emission [kg/h]    this mainstream    a swing of 120 veh/h in an hour    noise of 5 kg/h
    static map+FPI                 1.6                                4.0                5.1
    PI                             1.6                                1.7                6.7

The proportional part of the PI law follows a faster mainstream, and it passes more of the sensor's noise on. With a gain of -3.5
the iteration passes as much of it on, and leaves 1.1 of this mainstream and 2.9 of the faster one. Without noise the PI law bears
twice its gains and not three times, the iteration 2.8 times its gain and not 3.2 times.
"""

from dataclasses import replace
from pathlib import Path

import casadi as ca

import fpirhc as fp

metanet = fp.load_problem(str(Path(__file__).with_name("freeway_metering.py"))).problem.plant
LENGTH, LANES, BEFORE, BEHIND = 1.0, 2, 4, 2  # km; segments before and behind the ramp
RAMP, LARGEST = 2000.0, 0.6  # veh/h at the rate 1 while cars wait; largest metering rate
NEWTON = 8  # steps


def per_km(speed):
    """Emission of a car at a speed in km/h, g/km: idling, rolling, drag."""
    return 1374 / speed + 47.5 + 0.00867 * speed**2


def emission(x, p):
    """Of all cars on the six segments, kg/h."""
    cars = [LENGTH * LANES * x[f"rho{i}"] for i in range(1, BEFORE + BEHIND + 1)]
    speeds = [x[f"v{i}"] for i in range(1, BEFORE + BEHIND + 1)]
    return sum(n * v * per_km(v) for n, v in zip(cars, speeds, strict=True)) / 1000


def settled_speed(flow, p):
    """Speed v of free traffic, flow = LANES rho V(rho), by Newton's method for the density, km/h."""
    density = flow / (LANES * p.v_free)
    for _ in range(NEWTON):
        share = (density / p.rho_crit) ** p.a
        speed = p.v_free * ca.exp(-share / p.a)
        density = density - (LANES * density * speed - flow) / (LANES * speed * (1 - share))
    return p.v_free * ca.exp(-((density / p.rho_crit) ** p.a) / p.a)


def settled(rate, p):
    """Emission once traffic has settled at a metering rate, kg/h."""
    flows = (BEFORE, p.demand), (BEHIND, p.demand + RAMP * rate)
    return sum(count * LENGTH * flow * per_km(settled_speed(flow, p)) for count, flow in flows) / 1000


def model_emission(x, u, p):
    """The same, with a straight line beyond the largest rate, so that every target has a rate."""
    inside, near = ca.fmin(u.r, LARGEST), LARGEST - 0.05
    slope = (settled(LARGEST, p) - settled(near, p)) / (LARGEST - near)
    return settled(inside, p) + slope * (u.r - inside)


def waiting(x, u, p):
    """Change of the queue at the ramp, veh/h."""
    return {"w2": p.ramp_demand - RAMP * u.r}


DEMANDS = {"ramp_demand": fp.outside(nominal=1100.0, unit="veh/h"), "demand": fp.outside(nominal=2500.0, unit="veh/h")}
model = fp.Plant.of_states(
    states={"w2": "veh"},
    inputs={"r": "1"},
    rates=waiting,
    outputs={"emission": fp.Output("kg/h", model_emission)},
    time_unit="h",
    parameters={name: metanet.parameters[name] for name in ("v_free", "rho_crit", "a")} | DEMANDS,
)
SETTLED = {  # at a rate of 0.3
    **{f"rho{i}": value for i, value in enumerate((13.52, 13.53, 13.59, 14.05, 17.78, 17.89), 1)},
    **{f"v{i}": value for i, value in enumerate((92.43, 92.38, 92.01, 88.98, 87.19, 86.64), 1)},
    "w1": 0.0,
}
reality = replace(
    metanet, outputs={"emission": fp.Output("kg/h", emission)}, parameters={**metanet.parameters, **DEMANDS}
)

problem = fp.Problem(
    plant=model,
    reality=fp.Reality(reality, start=SETTLED),
    reference=fp.Trajectory(lambda t: {"emission": 2140 + 25 * ca.sin(2 * ca.pi * t)}),
    start={"w2": 50.0},
    input_before={"r": 0.3},
    period=1 / 60,  # h, six steps of METANET
    duration=3.0,  # h
    limits=fp.Limits(inputs={"r": (0.0, LARGEST)}),
    signals={"demand": fp.Unknown(lambda t: 2500 + 80 * ca.sin(2 * ca.pi * t / 1.7)), "ramp_demand": fp.Known(1100.0)},
    measure_from=0.5,  # h
)

static = fp.FeedforwardOnly()
controllers = {
    "static map": static,
    "static map+FPI": fp.Cascade(static, fp.Affine(gain=-2.5), lag=0.0),
    "PI": fp.PID({"emission": 0.006}, {"emission": 0.4}),  # h/kg, 1/kg
}
headline = ("static map", "static map+FPI")
why = (
    "The emission answers the ramp within the minute, so iteration and PI both add up the "
    "error; the map gives the iteration only its slope."
)
