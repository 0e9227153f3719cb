"""A freeway whose ramp is metered for the least time that all cars spend: an economic plan, beside its published run.

The road, the numbers and the demands are those of `freeway_metering`. The controller is that of A. Hegyi, Model predictive control
for integrating traffic control measures, thesis, Delft 2004, figure 6.6, as in FilippoAiraldi/sym-metanet (commit 1b6b96d, MIT
licence): seven minutes ahead, three rates, and with the change of the rate from minute to minute

    time spent + 0.4 sum (r_i - r_(i-1))^2        while at most 100 cars wait at the ramp.

A further state of the map is the time spent, so the cost is that state at the end of the horizon. On a map, limits hold at each
step of a stage: the queue is seen every 10 s, as in the source. The demands are known ahead.

With the exact numbers the rates are those of the published run, within 0.002 in each minute, and so is the time spent after 96
steps, within 0.01 veh h; IPOPT has the same. Such a cost has several minima. A plan that only improves the last one stays in the
minimum of that, where the ramp is closed a minute later, so every call also begins anew, and the cheaper plan is taken. That
doubles its time. A review takes some minutes, because it differentiates hundreds of such plans.

    rms error, seed 0    density [veh/km]
    RHC                                20
    RHC+FPI                            21
    RHC offset-free                    20
    RHC exact model                    19

The error is only a distance from the critical density. What counts is the time that all spend in the half hour, and the queue:

    in half an hour      time spent [veh h]    largest queue [veh]    minutes with an open light
    open ramp                         224.8                      -                            30
    RHC                               216.8                  105.9                            12
    RHC+FPI                           218.7                  102.6                             7
    RHC offset-free                   216.8                  105.9                            12
    RHC exact model                   216.4                  100.0                             6

As long as the merge carries all who come, closing the light only makes a queue, so the rate stands at its limit: for six minutes
with the exact model, for eight with the wrong one, which foresees the jam too late. Such a plan feeds nothing back. Later the light
of the wrong model is open for four minutes more, each time the queue is over its limit.

The iteration loses. What is wrong in the model are the speeds and the light's capacity, and the balance of cars at the merge holds
whatever they are. To let the density follow the plan of the wrong model is to undo what a new plan every minute corrects. The
offset-free plan finds nothing to estimate, for the same reason. Both queues are too long: a wrong model has no plan that keeps a
hard limit, and then the last plan is held. Where the limit has a price, `Limits(prices={"w2": 5.0})`, every minute has a plan. The
exact model keeps the limit all the same, and the wrong one takes a longer queue for less time:

    with a price         time spent [veh h]    largest queue [veh]
    RHC                               216.5                  107.8
    RHC+FPI                           217.9                  102.8
    RHC exact model                   216.4                  100.0

Speed limits, a second kind of input with a minimum in the model, save nothing with these demands; `freeway_coordinated` has some
with which they do.
"""

from dataclasses import replace
from pathlib import Path

import casadi as ca

import fpirhc as fp

metering = fp.load_problem(str(Path(__file__).with_name("freeway_metering.py")))
road = metering.problem.plant
T = road.step  # h


def later(x, u, p):
    """METANET's step, and the time that all cars have spent on the road and in queues since the start, veh h."""
    after = road.response(x, u, p)
    cars = sum(2 * after[f"rho{i}"] for i in range(1, 7)) + after["w1"] + after["w2"]  # two lanes of 1 km
    return {**after, "spent": x.spent + T * cars}


plant = fp.Plant.discrete(
    states={**road.coordinates, "spent": "veh h"},
    inputs=road.inputs,
    next=later,
    step=T,
    outputs=road.outputs,
    time_unit="h",
    parameters=road.parameters,
)


def announced(signal):
    """A demand that is known ahead. METANET takes that of the beginning of a step, and a minute here that of its middle."""
    return fp.Known(lambda t: signal.values(t - T / 2))


problem = replace(
    metering.problem,
    plant=plant,
    reference=fp.Trajectory(lambda t: {"density": 33.5 + 0 * t}),  # the critical one, for orientation
    start={**metering.problem.start, "spent": 0.0},
    input_before={"r": 1.0},
    duration=0.5,  # h
    limits=fp.Limits(inputs={"r": (0.0, 1.0)}, states={"w2": (-ca.inf, 100.0)}),  # veh
    signals={name: announced(signal) for name, signal in metering.problem.signals.items()},
    horizon=fp.Horizon(stages=7, step=6 * T, blocks=(1, 1, 5)),
    cost=fp.CustomCost(
        lambda v: {"change": 0.4 / (6 * T) * (v.input.r - v.input_before.r) ** 2}, terminal=lambda v: v.state.spent
    ),
    measure_from=0.0,
)

optimiser = fp.FixedPointSolver(iterations=30, tolerance=1e-4, hessian=fp.ExactHessian(), second_start=True)
plain = fp.RecedingHorizon(optimiser)
iteration = fp.ModelReferenced(fp.Affine(gain=-2.0))
estimator = fp.DisturbanceKalman(drift={"density": 100.0}, measured={"density": 0.1})
controllers = {
    "RHC": plain,
    "RHC+FPI": plain.with_deformation(iteration),
    "RHC offset-free": fp.Estimating(plain, estimator),
    "RHC exact model": fp.ExactModel(plain),
}
headline = ("RHC", "RHC+FPI")
why = (
    "The balance of cars at the merge holds whatever the model's speeds are; to follow the "
    "density of a wrong plan undoes what the next corrects."
)
metrics = (
    fp.figures.Largest("plant_state.spent", name="time_spent"),
    fp.figures.Largest("plant_state.w2", name="queue"),
)
headline_metric = "time_spent"
pictures = (
    *metering.pictures,
    fp.OverTime("Light and queue", panels=("command.r", "plant_state.w2"), levels={"plant_state.w2": (100.0,)}),
)
