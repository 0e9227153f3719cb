"""Two masses hanging on nonlinear springs: a receding horizon with a wrong model, with and without adaptation.

The example of J. K. Tar's group (Khan, Tar, Rudas: On the Alternatives of Lyapunov's Direct Method in Adaptive Control
Design, Robot. Autom. Eng. J. 3(5), 2018, eq. 7 and table 1), corrected: both masses feel the second spring with opposite
signs, the control force appears, and k has the unit N/m^sigma. q is measured downwards from the ceiling,

    m1 q1'' = m1 g - k1 S(q1 - L1, sigma1) + k2 S(q2 - q1 - L2, sigma2) - b1 q1' + Q1
    m2 q2'' = m2 g                         - k2 S(q2 - q1 - L2, sigma2) - b2 q2' + Q2,     S(d, s) = sign(d) |d|^s.

Table 1 prints g = 10.0 once; it is used for the plant and for the model. The nominal motion is in figures only; the one
below stays in the range that the figures show. Errors count from 3 s on:

    rms error, seed 0            q1 [m]    q2 [m]
    CTC                            0.34      0.14
    CTC+FPI (eq 3)               0.0035    0.0019
    CTC+FPI (eq 6)               0.0032    0.0017
    RHC                           0.059     0.042
    RHC+FPI, model-referenced    0.0004   0.00037
    RHC+FPI                     0.00052   0.00053
    RHC exact model             8.7e-05   5.8e-05

Costs with which adaptation makes the error larger are in `two_mass_costs`.
"""

import casadi as ca

import fpirhc as fp


def response(q, v, u, p):
    spring1 = p.k1 * fp.signed_power(q.q1 - p.L1, p.sigma1)
    spring2 = p.k2 * fp.signed_power(q.q2 - q.q1 - p.L2, p.sigma2)
    return {
        "q1": p.g + (-spring1 + spring2 - p.b1 * v.q1 + u.Q1) / p.m1,
        "q2": p.g + (-spring2 - p.b2 * v.q2 + u.Q2) / p.m2,
    }


plant = fp.Plant(
    coordinates={"q1": "m", "q2": "m"},
    inputs={"Q1": "N", "Q2": "N"},
    order=2,
    response=response,
    parameters={
        "m1": fp.Parameter(approximate=1.5, exact=1.0, unit="kg"),
        "m2": fp.Parameter(approximate=2.6, exact=2.0, unit="kg"),
        "sigma1": fp.Parameter(approximate=1.5, exact=2.0, unit="1"),
        "sigma2": fp.Parameter(approximate=1.0, exact=2.5, unit="1"),
        "k1": fp.Parameter(approximate=120.0, exact=100.0, unit="N/m^sigma1"),
        "k2": fp.Parameter(approximate=165.0, exact=150.0, unit="N/m^sigma2"),
        "L1": fp.Parameter(approximate=1.9, exact=2.0, unit="m"),
        "L2": fp.Parameter(approximate=3.1, exact=3.0, unit="m"),
        "b1": fp.Parameter(approximate=0.2, exact=0.1, unit="N s/m"),
        "b2": fp.Parameter(approximate=2.5, exact=2.0, unit="N s/m"),
        "g": fp.Parameter(approximate=10.0, exact=10.0, unit="m/s^2"),
    },
)

problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"q1": 2.2 + 0.3 * ca.sin(2 * t), "q2": 5.4 + 0.3 * ca.sin(3 * t)}),
    start={"q1": 2.2, "q2": 5.4},
    period=1e-3,  # s
    duration=10.0,  # s
    limits=fp.Limits(inputs={"Q1": (-300.0, 300.0), "Q2": (-300.0, 300.0)}),  # N
    horizon=fp.Horizon(stages=20, step=1e-2),
    # Effort is counted relative to the model's feedforward along the reference: absolute effort would make the optimum
    # of the wrong model trade tracking against the wrong effort, which an adaptive layer then realises faithfully.
    cost=fp.Quadratic(states={"q1": 1e3, "q2": 1e3, "q1'": 1.0, "q2'": 1.0}, deviation={"Q1": 1e-3, "Q2": 1e-3}),
    measure_from=3.0,  # s
)

tracking = fp.Exponential(rate=6.0)  # 1/s
# N; the real-time form: an exported loop has the same work in every cycle, and its errors are those of FixedPointSolver().
optimiser = fp.FixedPointSolver(iterations=1, tolerance=5e-2)
# As published, in the plain form: it serves where the model is far away and the gain is large. Begin with fp.ModelReferenced.
sigmoid = fp.Sigmoid(gain=-0.5, shift=0.3, scale=20.0)  # scale in m/s^2

controllers = {
    "CTC": fp.ComputedTorque(tracking),
    "CTC+FPI (eq 3)": fp.ComputedTorque(tracking, fp.RFPTVector(offset=1e4, sign=-1.0, gain=2e-5)),
    "CTC+FPI (eq 6)": fp.ComputedTorque(tracking, fp.Sigmoid(gain=-0.5, shift=0.3, scale=1.0)),
    "RHC": fp.RecedingHorizon(optimiser),
    "RHC+FPI, model-referenced": fp.RecedingHorizon(optimiser, fp.ModelReferenced(sigmoid)),
    "RHC+FPI": fp.RecedingHorizon(optimiser, sigmoid),
    "RHC exact model": fp.ExactModel(fp.RecedingHorizon(optimiser)),
}
headline = ("RHC", "RHC+FPI")  # the published form
why = (
    "Each mass has a force of its own, so every spring that is wrong stands beside "
    "one; exact rates let PID have poles at 300 1/s."
)


def mechanism(q, v, p):
    """Ceiling, springs and masses; a mass is as large as it is heavy."""
    size1, size2 = 0.4 * p.m1 ** (1 / 3), 0.4 * p.m2 ** (1 / 3)
    return [
        fp.Shape.line((-0.7, 0.0), (0.7, 0.0)),
        fp.Shape.spring((0.0, 0.0), (0.0, size1 / 2 - q.q1), width=0.3),
        fp.Shape.box((0.0, -q.q1), size1, size1),
        fp.Shape.spring((0.0, -q.q1 - size1 / 2), (0.0, size2 / 2 - q.q2), width=0.3),
        fp.Shape.box((0.0, -q.q2), size2, size2),
    ]


pictures = (fp.Planar("The two masses", plant, mechanism, "The distance downwards is q.", controllers=headline),)
tuning = {
    "CTC": {"tracking.rate": fp.LogSpan(2.0, 20.0)},  # 1/s
    "CTC+FPI (eq 6)": {"tracking.rate": fp.LogSpan(2.0, 20.0), "deformation.gain": fp.LogSpan(-1.5, -0.05)},
    "RHC+FPI": {"deformation.gain": fp.LogSpan(-1.5, -0.05), "deformation.scale": fp.LogSpan(5.0, 500.0)},
}
