"""A freeway with a metered on-ramp: the density at the merge, by METANET, with a model whose traffic is denser and slower.

Six segments of 1 km with two lanes; a ramp joins the fifth. Segment i has the density rho_i (veh/km/lane) and the speed v_i
(km/h), each origin a queue w (veh). With T = 10 s, METANET is a map from one T to the next (Messmer and Papageorgiou:
METANET, a macroscopic simulation program for motorway networks, Traffic Engineering and Control 31, 1990),

    rho_i+ = rho_i + T/(lanes L) (q_(i-1) - q_i + q_ramp),        q_i = lanes rho_i v_i,
    v_i+ = v_i + T/tau (V(rho_i) - v_i) + T/L v_i (v_(i-1) - v_i) - eta T/(tau L) (rho_(i+1) - rho_i)/(rho_i + kappa)
           - delta T/(L lanes) q_ramp v_i/(rho_i + kappa),        V(rho) = v_free exp(-(rho/rho_crit)^a / a),
    w+ = w + T (d - q),        q = r min(d + w/T, C min(1, (rho_max - rho)/(rho_max - rho_crit))).

Layout, numbers, start and demands are those of the example in A. Hegyi, Model predictive control for integrating traffic
control measures, thesis, Delft 2004, as in FilippoAiraldi/sym-metanet (MIT licence).

Model: free traffic is slower and takes longer to settle, vehicles that merge slow nobody down, and more cars per hour fit
through the light. Its demands stay at their nominal values.

Task: a metering rate once a minute, six steps, holds the density at the merge at 30 veh/km +- 2, below the critical one,
while 1500 veh/h come to the ramp. Errors count from 6 min on.

    rms error, seed 0    density [veh/km]
    CTC                              0.79
    CTC+FPI                          0.16

The model of a minute is the map applied six times, so the exact one has no error at all. With the ramp open, the density
rises beyond the critical one, and all cars together spend more time than with a metered ramp.
"""

import casadi as ca

import fpirhc as fp

T = 10 / 3600  # h, METANET's step
LENGTH, LANES, SEGMENTS, MERGE = 1.0, 2, 6, 4  # km; the ramp joins the fifth segment
CAPACITY = 4000.0  # veh/h, of the mainstream's origin
DENSEST = 180.0  # veh/km/lane


def inflow(wanted, capacity, density, p):
    """Flow of an origin, veh/h, before its metering: what waits and comes, or what fits into the segment."""
    room = ca.fmin(1, (DENSEST - density) / (DENSEST - p.rho_crit))
    return ca.fmin(wanted, capacity * room)


def stationary_speed(density, p):
    """Speed at which traffic of this density settles, km/h."""
    return p.v_free * ca.exp(-((density / p.rho_crit) ** p.a) / p.a)


def later(x, u, p):
    """Densities, speeds and queues one step later."""
    rho, v = ([x[f"{name}{i}"] for i in range(1, SEGMENTS + 1)] for name in ("rho", "v"))
    main = inflow(p.demand + x.w1 / T, CAPACITY, rho[0], p)
    ramp = u.r * inflow(p.ramp_demand + x.w2 / T, p.ramp_capacity, rho[MERGE], p)
    flows = [main, *(density * speed * LANES for density, speed in zip(rho, v, strict=True))]
    ahead = [*rho[1:], ca.fmin(rho[-1], p.rho_crit)]
    changes = {"w1": p.demand - main, "w2": p.ramp_demand - ramp}
    for i in range(SEGMENTS):
        joins = ramp if i == MERGE else 0
        changes[f"rho{i + 1}"] = (flows[i] - flows[i + 1] + joins) / (LANES * LENGTH)
        anticipated = p.eta / (p.tau * LENGTH) * (ahead[i] - rho[i]) / (rho[i] + p.kappa)
        merging = p.delta / (LENGTH * LANES) * joins * v[i] / (rho[i] + p.kappa)
        convected = v[i] * (v[max(i - 1, 0)] - v[i]) / LENGTH
        changes[f"v{i + 1}"] = (stationary_speed(rho[i], p) - v[i]) / p.tau + convected - anticipated - merging
    return {name: x[name] + T * change for name, change in changes.items()}


def density_at_merge(x, p):
    return x.rho5


def joined(t, times, values):
    """Straight lines between values, veh/h."""
    value = values[0]
    for begin, end, low, high in zip(times[:-1], times[1:], values[:-1], values[1:], strict=True):
        value = value + (high - low) * ca.fmin(1, ca.fmax(0, (t - begin) / (end - begin)))
    return value


def demand(t):
    """Of the mainstream, veh/h; t in h."""
    return joined(t, (2.0, 2.25), (3500.0, 1000.0))


def ramp_demand(t):
    """At the ramp, veh/h; t in h."""
    return joined(t, (0.0, 0.15, 0.35, 0.5), (500.0, 1500.0, 1500.0, 500.0))


plant = fp.Plant.discrete(
    states={
        **{f"rho{i}": "veh/km" for i in range(1, SEGMENTS + 1)},  # per lane
        **{f"v{i}": "km/h" for i in range(1, SEGMENTS + 1)},
        "w1": "veh",
        "w2": "veh",
    },
    inputs={"r": "1"},
    next=later,
    step=T,
    outputs={"density": fp.Output("veh/km", density_at_merge)},
    time_unit="h",
    parameters={
        "v_free": fp.Parameter(approximate=0.93 * 102.0, exact=102.0, unit="km/h"),
        "rho_crit": fp.Parameter(approximate=1.1 * 33.5, exact=33.5, unit="veh/km"),
        "a": fp.Parameter(approximate=0.9 * 1.867, exact=1.867, unit="1"),
        "tau": fp.Parameter(approximate=1.3 * 18 / 3600, exact=18 / 3600, unit="h"),
        "eta": fp.Parameter(approximate=0.75 * 60.0, exact=60.0, unit="km^2/h"),
        "kappa": fp.Parameter(approximate=1.25 * 40.0, exact=40.0, unit="veh/km"),
        "delta": fp.Parameter(approximate=0.0, exact=0.0122, unit="1"),
        "ramp_capacity": fp.Parameter(approximate=1.3 * 2000.0, exact=2000.0, unit="veh/h"),
        "demand": fp.outside(nominal=3500.0, unit="veh/h"),
        "ramp_demand": fp.outside(nominal=1000.0, unit="veh/h"),
    },
)
START = {
    **{f"rho{i}": value for i, value in enumerate((22.0, 22.0, 22.5, 24.0, 30.0, 32.0), 1)},
    **{f"v{i}": value for i, value in enumerate((80.0, 80.0, 78.0, 72.5, 66.0, 62.0), 1)},
    "w1": 0.0,
    "w2": 0.0,
}

problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"density": 30.0 + 2.0 * ca.sin(4 * ca.pi * t)}),
    start=START,
    period=6 * T,
    duration=1.0,  # h
    limits=fp.Limits(inputs={"r": (0.0, 1.0)}),
    signals={"demand": fp.Unknown(demand), "ramp_demand": fp.Unknown(ramp_demand)},
    measure_from=0.1,  # h
)

law = fp.Exponential(rate=10.0)  # 1/h
controllers = {
    "CTC": fp.ComputedTorque(law),
    "CTC+FPI": fp.ComputedTorque(law, fp.ModelReferenced(fp.Affine(gain=-2.0))),
    "CTC exact model": fp.ExactModel(fp.ComputedTorque(law)),
}
headline = ("CTC", "CTC+FPI")
why = (
    "The density shows after a minute what slow merging does, and the iteration takes it "
    "back; ADRC takes the traffic for an integrator."
)
pictures = (
    fp.OverTime(
        "Density and speed at the ramp",
        panels=("plant_state.rho5", "plant_state.v5"),
        caption="The ramp joins the fifth segment.",
    ),
)
