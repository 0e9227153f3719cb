"""Propofol by an infusion pump: the model has the kinetics of Marsh, the patient those of Schnider.

    C1' = -(k10 + k12 + k13) C1 + k12 C2 + k13 C3 + u / V1,     C2' = k21 (C1 - C2),     C3' = k31 (C1 - C3),
    Ce' = ke0 (C1 - Ce),        concentrations in mg/l, infusion u in mg/min, time in minutes.

T. W. Schnider et al., Anesthesiology 88, 1998, for a woman of 38 years, 169 cm, 65 kg (patient 13, the nominal one, of C. M.
Ionescu et al., IEEE Trans. Biomed. Eng. 55(9), 2008): V1 = 4.27, V2 = 24.77, V3 = 238 l, clearances 1.76, 1.65, 0.836 l/min, ke0
= 0.456 1/min. B. Marsh et al., Br. J. Anaesth. 67, 1991: V1 = 0.228 l/kg, k10 = 0.119, k12 = 0.112, k13 = 0.042, k21 = 0.055,
k31 = 0.0033 1/min, ke0 = 0.26. Task: the plasma at 3 mg/l and 4 mg/l in turn, a pump command every 10 s; the compartments C2, C3
and Ce are not controlled, and nobody has a reference for them. Pharmacokinetic parameters differ between patients by log-normal
factors; 1.3 stands for the usual 20 to 40 % (chosen here).
"""

import casadi as ca

import fpirhc as fp

WEIGHT, LENGTH, AGE = 65.0, 169.0, 38.0  # kg, cm, years
LEAN = 1.07 * WEIGHT - 148 * (WEIGHT / LENGTH) ** 2  # kg, James' formula for a woman
CLEARANCES = (
    1.89 + 0.0456 * (WEIGHT - 77) - 0.0681 * (LEAN - 59) + 0.0264 * (LENGTH - 177),
    1.29 - 0.024 * (AGE - 53),
    0.836,
)  # l/min
VOLUMES = (4.27, 18.9 - 0.391 * (AGE - 53), 238.0)  # l
SCHNIDER = {
    "V1": VOLUMES[0],
    "k10": CLEARANCES[0] / VOLUMES[0],
    "k12": CLEARANCES[1] / VOLUMES[0],
    "k13": CLEARANCES[2] / VOLUMES[0],
    "k21": CLEARANCES[1] / VOLUMES[1],
    "k31": CLEARANCES[2] / VOLUMES[2],
    "ke0": 0.456,
}
MARSH = {"V1": 0.228 * WEIGHT, "k10": 0.119, "k12": 0.112, "k13": 0.042, "k21": 0.055, "k31": 0.0033, "ke0": 0.26}


def response(q, u, p):
    return {
        "C1": -(p.k10 + p.k12 + p.k13) * q.C1 + p.k12 * q.C2 + p.k13 * q.C3 + u.u / p.V1,
        "C2": p.k21 * (q.C1 - q.C2),
        "C3": p.k31 * (q.C1 - q.C3),
        "Ce": p.ke0 * (q.C1 - q.Ce),
    }


plant = fp.Plant(
    coordinates=dict.fromkeys(("C1", "C2", "C3", "Ce"), "mg/l"),
    inputs={"u": "mg/min"},
    controlled=("C1",),
    order=1,
    time_unit="min",
    response=response,
    parameters={
        name: fp.Parameter(
            approximate=MARSH[name],
            exact=SCHNIDER[name],
            unit="l" if name == "V1" else "1/min",
            spread=fp.LogNormal(factor=1.3),
        )
        for name in SCHNIDER
    },
)


def level(t):
    """Plasma, mg/l: from 3 to 4 and back, each within about 10 minutes."""
    return 3.0 + 0.5 * (ca.tanh((t - 40) / 5) - ca.tanh((t - 80) / 5))


problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"C1": level(t), "C2": level(t), "C3": level(t), "Ce": level(t)}),
    start={"C1": 0.0, "C2": 0.0, "C3": 0.0, "Ce": 0.0},
    period=1 / 6,  # min
    duration=120.0,  # min
    limits=fp.Limits(inputs={"u": (0.0, 200.0)}),
    horizon=fp.Horizon(stages=30, step=1 / 3),  # min
    cost=fp.Quadratic(states={"C1": 10.0}, rate={"u": 1e-4}),
    measure_from=20.0,  # min
)

optimiser = fp.FixedPointSolver(iterations=2, tolerance=1e-1)  # mg/min
plain = fp.RecedingHorizon(optimiser)
controllers = {
    "CTC": fp.ComputedTorque(fp.Exponential(rate=0.5)),
    "CTC+FPI": fp.ComputedTorque(fp.Exponential(rate=0.5), fp.Sigmoid(gain=-1.0)),
    "RHC": plain,
    "RHC+FPI": fp.RecedingHorizon(optimiser, fp.Sigmoid(gain=-1.0)),
    "RHC+FPI, gentle": fp.RecedingHorizon(optimiser, fp.Sigmoid(gain=-0.1)),
    "RHC offset-free": fp.Estimating(plain, fp.DisturbanceKalman(drift={"C1": 0.1}, measured={"C1": 1e-2})),
    "RHC exact model": fp.ExactModel(plain),
}
headline = ("RHC", "RHC+FPI")
