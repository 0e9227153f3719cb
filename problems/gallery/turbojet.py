"""The thrust of a small jet engine: a P220 flown by the published model of the smaller P100.

The thrust T in N depends on the throttle u in % by a second-order grey box, identified on a test bench (Momin et al.,
Nonlinear Model Identification and Observer Design for Thrust Estimation of Small-scale Turbojet Engines, 2022),

    T'' = K_T T + K_TT T^2 + K_D T' + K_DD T'^2 + K_TD T T' + c + (B_U + B_T T + B_D T') (u + B_UU u^2).

The plant has the coefficients of the JetCat P220, the model those of the P100, both as published with the flight software of
a jet-driven humanoid robot (ami-iit, paper_nava_2023_icra_fault-control-ironcub, BSD-3). At the same throttle of 60 % the
P100 gives 110 N, the P220 150 N. The throttle's effect is kept above 0.3 N/s^2 in both, so that it never changes its sign.

Task: T = 120 + 40 sin 0.3 t, from 60 N; a cycle of 10 ms and a plan every 100 ms; the error counts from 20 s on. The first
second needs more throttle than the limits allow, and from 5 to 8 s a gust takes 15 N/s^2, which no controller measures.

    rms error, seed 0            T [N]
    CTC                            4.6
    CTC+FPI                       0.02
    RHC                            4.4
    RHC+FPI, model-referenced    0.0009
    RHC+FPI                      0.012
    RHC offset-free             0.0016
    RHC exact model            0.00042

"RHC+FPI" is the plain form, as published; the model-referenced row is the affine map with a gain of 0.9. The offset-
free plan measures the same response, and its newest estimate acts in every cycle. Its plans foresee a constant
disturbance, though, and the model's error follows the thrust. It needs plans that are solved:
with one iteration per plan its error is 60 times as large.

The polynomial is good for slow motions only: at high rates its own term in T' squared outweighs the damping, and a step of
the throttle from idle to 60 % never settles.
"""

import casadi as ca

import fpirhc as fp

NAMES = ("K_T", "K_TT", "K_D", "K_DD", "K_TD", "B_U", "B_T", "B_D", "B_UU", "c")
UNITS = ("1/s^2", "1/(N s^2)", "1/s", "1/N", "1/(N s)", "N/s^2", "1/s^2", "1/s", "1", "N/s^2")
P100 = (0.306530, -0.024867, -0.973422, 0.055786, 0.022618, 0.688710, 0.038025, -0.089879, -0.001393, -0.958953)
P220 = (0.237755, -0.012799, -0.860374, 0.023606, 0.008599, 1.139026, 0.019914, -0.050257, 0.000302, -0.692913)
SMALLEST = 0.3  # N/s^2, of the throttle's effect


def free(q, v, p):
    return p.K_T * q.T + p.K_TT * q.T**2 + p.K_D * v.T + p.K_DD * v.T**2 + p.K_TD * q.T * v.T + p.c


def effect(q, v, p):
    return ca.fmax(p.B_U + p.B_T * q.T + p.B_D * v.T, SMALLEST)


def response(q, v, u, p):
    return {"T": free(q, v, p) + effect(q, v, p) * (u.throttle + p.B_UU * u.throttle**2)}


def inverse(q, v, r, p):
    """The root of B_UU u^2 + u = w that is w for small B_UU; the throttle at the parabola's top where there is none."""
    w = (r.T - free(q, v, p)) / effect(q, v, p)
    return {"throttle": 2 * w / (1 + ca.sqrt(ca.fmax(1 + 4 * p.B_UU * w, 1e-6)))}


plant = fp.Plant(
    coordinates={"T": "N"},
    inputs={"throttle": "%"},
    order=2,
    response=response,
    inverse=inverse,
    parameters={
        name: fp.Parameter(approximate=small, exact=large, unit=unit)
        for name, small, large, unit in zip(NAMES, P100, P220, UNITS, strict=True)
    },
)

problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"T": 120 + 40 * ca.sin(0.3 * t)}),
    start={"T": 60.0},
    period=1e-2,  # s
    duration=60.0,  # s
    limits=fp.Limits(inputs={"throttle": (0.0, 120.0)}),  # %
    disturbances={"T": fp.Step(at=5.0, duration=3.0, size=-15.0)},  # N/s^2
    horizon=fp.Horizon(stages=30, step=0.1),
    cost=fp.Quadratic(states={"T": 1.0, "T'": 0.1}, deviation={"throttle": 1e-3}),
    measure_from=20.0,  # s
)

tracking = fp.Exponential(rate=1.5)  # 1/s
optimiser = fp.FixedPointSolver()
plain = fp.RecedingHorizon(optimiser)
sigmoid = fp.Sigmoid(gain=-1.6, shift=0.3, scale=6000.0)  # scale in N/s^2
filter = fp.DisturbanceKalman(drift={"T": 1.1e3}, measured={"T": 1e-2, "T'": 3e-3, "T''": 10.0})

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
why = "The throttle acts on the second derivative, which is measured exactly and at once: PID with poles at 30 1/s has more gain."
tuning = {
    "CTC+FPI": {"deformation.gain": fp.LogSpan(3e-6, 1.5e-4)},  # s^2/N
    "RHC+FPI, model-referenced": {"deformation.map.gain": fp.LogSpan(-3.0, -0.1)},
    "RHC+FPI": {"deformation.gain": fp.LogSpan(-3.0, -0.1)},
    "RHC offset-free": {
        "estimator.drift.T": fp.LogSpan(1.0, 1e4),  # N/s^2.5
        "estimator.measured.T'": fp.LogSpan(1e-3, 1.0),  # N/s
    },
}
pictures = (
    fp.OverTime(
        "Thrust and throttle", panels=("state.T", "command.throttle"), levels={"command.throttle": (0.0, 120.0)}
    ),
    fp.Portrait(
        "Thrust over throttle",
        x="command.throttle",
        y="state.T",
        caption="From 20 s on. The same throttle gives other thrusts on the way up and on the way down.",
        since=20.0,
        controllers=("RHC", "RHC+FPI, model-referenced", "RHC exact model"),
    ),
)
