"""A nerve cell's voltage on a slow wave: the model has the membrane's leak and no ion channel.

Offset-free control wins, by a fifth: its filter measures the response, as the deformation does, with a gain of one.

The membrane of the squid's giant axon (Hodgkin and Huxley, J. Physiol. 117, 1952), a current I clamps its voltage V,

    C V' = I - gNa m^3 h (V - ENa) - gK n^4 (V - EK) - gL (V - EL),     p' = alpha_p(V) (1 - p) - beta_p(V) p,  p = m, h, n.

The unit of time is the millisecond, throughout: voltages in mV, currents in uA/cm^2. The model's conductances of sodium and
potassium are zero, its leak and capacity are wrong. Current and voltage at rest are those of the original: -64.996 mV
without a current, 68.3 spikes per second at 10 uA/cm^2.

Task: V follows a wave of 20 mV and 25 ms, which alone would make the cell fire. The error of V counts from 10 ms on. The
start is 10 mV too low, so that a plan needs more current than the limits allow, and from 2 to 5 ms a synapse adds 10 uA/cm^2
that no controller measures.

    rms error, seed 0          V [mV]
    CTC                            16
    CTC+FPI                    0.0072
    RHC                            12
    RHC+FPI, model-referenced  0.0028
    RHC+FPI                    0.0089
    RHC offset-free            0.0023
    RHC exact model              0.01

Without adaptation the cell fires. "RHC+FPI" is the plain form, as published; the model-referenced row is the affine
map with a gain of 0.9. The exact model needs more than one iteration per plan. The controllers measure every state;
the gates, which cannot be measured in a cell, are used by the exact model alone.
"""

import casadi as ca

import fpirhc as fp

REST = {"V": -64.9964, "m": 0.05296, "h": 0.59599, "n": 0.31773}  # mV, and gates that are in balance there


def opening(x):
    """Return x / (1 - exp(-x)), which is one at zero."""
    near = ca.fabs(x) < 1e-4
    away = ca.if_else(near, 1.0, x)
    return ca.if_else(near, 1 + x / 2, away / (1 - ca.exp(-away)))


def response(q, u, p):
    v = q.V
    sodium = p.gNa * q.m**3 * q.h * (v - p.ENa)
    potassium = p.gK * q.n**4 * (v - p.EK)
    return {
        "V": (u.I - sodium - potassium - p.gL * (v - p.EL)) / p.C,
        "m": opening((v + 40) / 10) * (1 - q.m) - 4 * ca.exp(-(v + 65) / 18) * q.m,
        "h": 0.07 * ca.exp(-(v + 65) / 20) * (1 - q.h) - q.h / (1 + ca.exp(-(v + 35) / 10)),
        "n": 0.1 * opening((v + 55) / 10) * (1 - q.n) - 0.125 * ca.exp(-(v + 65) / 80) * q.n,
    }


def wave(t):
    """The gates have no task; their nominal values are those of rest."""
    return {"V": -65 + 10 * (1 - ca.cos(2 * ca.pi * t / 25)), **{gate: REST[gate] + 0 * t for gate in "mhn"}}


plant = fp.Plant(
    coordinates={"V": "mV", "m": "1", "h": "1", "n": "1"},
    inputs={"I": "uA/cm^2"},
    order=1,
    controlled=("V",),
    response=response,
    time_unit="ms",
    parameters={
        "C": fp.Parameter(approximate=1.2, exact=1.0, unit="uF/cm^2", spread=fp.Uniform(absolute=0.1)),
        "gNa": fp.Parameter(approximate=0.0, exact=120.0, unit="mS/cm^2", spread=fp.LogNormal(factor=1.2)),
        "gK": fp.Parameter(approximate=0.0, exact=36.0, unit="mS/cm^2", spread=fp.LogNormal(factor=1.2)),
        "gL": fp.Parameter(approximate=0.5, exact=0.3, unit="mS/cm^2", spread=fp.LogNormal(factor=1.2)),
        "ENa": fp.Parameter(approximate=50.0, exact=50.0, unit="mV", spread=fp.Normal(absolute=2.0)),
        "EK": fp.Parameter(approximate=-77.0, exact=-77.0, unit="mV", spread=fp.Normal(absolute=2.0)),
        "EL": fp.Parameter(approximate=-60.0, exact=-54.387, unit="mV", spread=fp.Normal(absolute=2.0)),
    },
)

problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(wave),
    start={**REST, "V": -75.0},
    period=5e-3,  # ms
    duration=100.0,  # ms
    limits=fp.Limits(inputs={"I": (-80.0, 80.0)}),  # uA/cm^2; the wave needs -44 to 74
    disturbances={"I": fp.Step(at=2.0, duration=3.0, size=10.0)},  # ms, uA/cm^2
    horizon=fp.Horizon(stages=50, step=0.1),  # ms
    cost=fp.Quadratic(states={"V": 1.0}, deviation={"I": 1e-5}),
    measure_from=10.0,  # ms
)

tracking = fp.Exponential(rate=1.0)  # 1/ms
optimiser = fp.FixedPointSolver()
plain = fp.RecedingHorizon(optimiser)
sigmoid = fp.Sigmoid(gain=-1.0, shift=0.3, scale=100.0)  # scale in mV/ms
filter = fp.DisturbanceKalman(
    drift={"V": 1e3}, measured={"V": 1e-2, "V'": 7.0}, noise={"m": 1e-3, "h": 1e-3, "n": 1e-3}
)

controllers = {
    "CTC": fp.ComputedTorque(tracking),
    "CTC+FPI": fp.ComputedTorque(tracking, fp.RFPT(offset=1e4, sign=-1.0, gain=1e-4)),
    "RHC": plain,
    "RHC+FPI, model-referenced": fp.RecedingHorizon(optimiser, fp.ModelReferenced(fp.Affine(gain=-1.8))),
    "RHC+FPI": fp.RecedingHorizon(optimiser, sigmoid),  # the plain form, as published
    "RHC offset-free": fp.Estimating(plain, filter, at_once=True),
    "RHC exact model": fp.ExactModel(plain),
}
headline = ("RHC", "RHC+FPI, model-referenced")
why = (
    "The missing channels are currents beside the one that is commanded, and all is "
    "measured exactly: ADRC at 60 1/ms has the largest gain."
)
tuning = {
    "CTC+FPI": {"deformation.gain": fp.LogSpan(1e-5, 2e-4)},  # ms/mV
    "RHC+FPI, model-referenced": {"deformation.map.gain": fp.LogSpan(-4.0, -0.2)},
    "RHC+FPI": {"deformation.gain": fp.LogSpan(-4.0, -0.2)},
    "RHC offset-free": {"estimator.drift.V": fp.LogSpan(1.0, 1e5)},  # mV/ms^1.5
}
pictures = (
    fp.OverTime(
        "Voltage and current",
        panels=("state.V", "command.I"),
        caption="Dashed: -20 mV, above which a spike is counted, and the largest currents.",
        levels={"state.V": (-20.0,), "command.I": problem.limits.inputs["I"]},
        controllers=("CTC", "RHC", "RHC+FPI, model-referenced"),
    ),
    fp.Portrait(
        "Phase portrait of the neuron",
        x="state.V",
        y="state.n",
        caption="The share of open potassium channels over the voltage; a spike is a large loop.",
        since=10.0,
        controllers=("CTC", "RHC", "RHC+FPI, model-referenced"),
    ),
)
