"""Plants whose outputs follow references under a wrong model, written by their states: relative order 3.

See `output_plants` for orders 1 and 2, and for what is chosen here.
"""

from __future__ import annotations

import math

import casadi as ca
from foreign import known
from output_plants import SMOOTH

import fpirhc as fp


def link() -> fp.Problem:
    """Order 3 of 3. A link on a direct-current motor (D. M. Dawson, J. J. Carroll, M. Schneider, IEEE TCST 2(3), 1994).

    M q'' + B q' + N sin q = I,  L I' = u - R I - K q', by the voltage u; masses and resistance are wrong.
    """
    torque, link, load, reach, radius = 0.90, 0.506, 0.434, 0.305, 0.023

    def rates(x, u, p):
        inertia = (1.625e-3 + p.link * reach**2 / 3 + p.load * reach**2 + 0.4 * p.load * radius**2) / torque
        weight = (p.link / 2 + p.load) * reach * 9.81 / torque
        friction = 16.25e-3 / torque
        return {
            "q": x.v,
            "v": (x.current - friction * x.v - weight * ca.sin(x.q)) / inertia,
            "current": (u.voltage - p.R * x.current - torque * x.v) / 25e-3,
        }

    plant = fp.Plant.of_states(
        states={"q": "rad", "v": "rad/s", "current": "A"},
        inputs={"voltage": "V"},
        rates=rates,
        outputs={"q": fp.Output("rad", lambda x, p: x.q)},
        parameters=known(link=(0.4, link, "kg"), load=(0.6, load, "kg"), R=(6.0, 5.0, "ohm")),
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"q": ca.sin(2 * t)}),
        start={"q": 0.0, "v": 2.0, "current": 0.0},
        period=2e-3,
        duration=4.0,
        measure_from=1.5,
        limits=fp.Limits(inputs={"voltage": (-40.0, 40.0)}),
        horizon=fp.Horizon(stages=20, step=0.02, discretisation=SMOOTH),
        cost=fp.Quadratic(outputs={"q": 100.0, "q'": 0.1}, rate={"voltage": 1e-6}),
    )


def hahnfeldt(*, effect_only: bool) -> fp.Problem:
    """Order 3 of 3. A tumour by an inhibitor of its vessels (P. Hahnfeldt et al., Cancer Research 59, 1999; endostatin).

    In logarithms, s' = growth (k - s),  k' = birth e^(s-k) - death e^(2s/3) - effect g,  g' = dose - clearance g.
    """
    exact = {"growth": 0.192, "birth": 5.85, "death": 0.00873, "effect": 0.66, "clearance": 1.7}
    units = {"growth": "1/day", "birth": "1/day", "death": "1/(day mm^2)", "effect": "kg/mg/day", "clearance": "1/day"}
    wrong = {"effect": 0.75}
    if not effect_only:
        wrong |= {"growth": 1.3, "birth": 0.85, "death": 1.15, "clearance": 1.3}

    def rates(x, u, p):
        return {
            "size": p.growth * (x.bed - x.size),
            "bed": p.birth * ca.exp(x.size - x.bed) - p.death * ca.exp(2 * x.size / 3) - p.effect * x.level,
            "level": u.dose - p.clearance * x.level,
        }

    plant = fp.Plant.of_states(
        states={"size": "ln(mm^3)", "bed": "ln(mm^3)", "level": "mg/kg"},
        inputs={"dose": "mg/kg/day"},
        rates=rates,
        outputs={"size": fp.Output("ln(mm^3)", lambda x, p: x.size)},
        parameters=known(**{n: (wrong.get(n, 1.0) * exact[n], exact[n], units[n]) for n in exact}),
        time_unit="day",
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"size": ca.log(1000 + 1000 * (1 + t / 10) * ca.exp(-t / 10))}),
        start={"size": math.log(2000), "bed": math.log(2000), "level": 5.0},
        period=0.05,
        duration=40.0,
        measure_from=16.0,
        limits=fp.Limits(inputs={"dose": (0.0, 75.0)}),
        horizon=fp.Horizon(stages=15, step=0.5, discretisation=SMOOTH),
        cost=fp.Quadratic(outputs={"size": 1.0, "size'": 0.1}, rate={"dose": 1e-7}),
        input_before={"dose": 10.0},
    )


def tumour_drug() -> fp.Problem:
    """Order 3 of 3. Hahnfeldt's tumour with the effect of the drug a quarter too weak in the model."""
    return hahnfeldt(effect_only=True)


def tumour_all() -> fp.Problem:
    """Order 3 of 3. Hahnfeldt's tumour with all five parameters wrong by 15 to 30 %."""
    return hahnfeldt(effect_only=False)


def glucose() -> fp.Problem:
    """Order 3 of 3. Glucose by insulin (R. N. Bergman's minimal model; numbers of S. M. Lynch, B. W. Bequette, ACC 2002)."""

    def rates(x, u, p):
        return {
            "G": -p.p1 * (x.G - 81.0) - x.X * x.G + 2.0,
            "X": -p.p2 * x.X + p.p3 * (x.I - 15.0),
            "I": u.insulin / 12.0 - p.n * x.I,
        }

    plant = fp.Plant.of_states(
        states={"G": "mg/dl", "X": "1/min", "I": "mU/l"},
        inputs={"insulin": "mU/min"},
        rates=rates,
        outputs={"G": fp.Output("mg/dl", lambda x, p: x.G)},
        parameters=known(
            p1=(0.033, 0.028735, "1/min"),
            p2=(0.035, 0.028344, "1/min"),
            p3=(4.0e-5, 5.035e-5, "l/(mU min^2)"),
            n=(0.11, 5 / 54, "1/min"),
        ),
        time_unit="min",
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"G": 100 + 40 * (1 + t / 25) * ca.exp(-t / 25) + 8 * ca.sin(t / 40) ** 2}),
        start={"G": 140.0, "X": 0.0, "I": 15.0},
        period=0.5,
        duration=400.0,
        measure_from=160.0,
        limits=fp.Limits(inputs={"insulin": (0.0, 150.0)}),
        horizon=fp.Horizon(stages=15, step=5.0, discretisation=SMOOTH),
        cost=fp.Quadratic(outputs={"G": 1.0, "G'": 1.0}, rate={"insulin": 1e-6}),
        input_before={"insulin": 17.0},
    )


def vehicle() -> fp.Problem:
    """Orders 2, 3 of 5. Speed and lateral position of a car by its rear axle (B. Paden et al., IEEE T-IV 1(1), 2016).

    Engine and steering lag behind the pedal and the wheel.
    """

    def rates(x, u, p):
        return {
            "speed": x.push - p.drag * x.speed,
            "side": x.speed * ca.sin(x.heading),
            "heading": x.speed / p.wheelbase * ca.tan(x.steer),
            "steer": (u.wheel - x.steer) / p.lag,
            "push": (u.pedal - x.push) / 0.3,
        }

    plant = fp.Plant.of_states(
        states={"speed": "m/s", "side": "m", "heading": "rad", "steer": "rad", "push": "m/s^2"},
        inputs={"pedal": "m/s^2", "wheel": "rad"},
        rates=rates,
        outputs={"speed": fp.Output("m/s", lambda x, p: x.speed), "side": fp.Output("m", lambda x, p: x.side)},
        parameters=known(drag=(0.02, 0.05, "1/s"), wheelbase=(2.4, 2.7, "m"), lag=(0.14, 0.2, "s")),
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"speed": 10 + ca.sin(0.5 * t), "side": 1.5 * ca.sin(0.8 * t)}),
        start={"speed": 10.0, "side": 0.0, "heading": 0.12, "steer": 0.0, "push": 1.0},
        period=0.01,
        duration=15.0,
        measure_from=6.0,
        limits=fp.Limits(inputs={"pedal": (-4.0, 3.0), "wheel": (-0.5, 0.5)}),
        horizon=fp.Horizon(stages=20, step=0.1, discretisation=SMOOTH),
        cost=fp.Quadratic(outputs={"speed": 1.0, "side": 1.0, "side'": 0.1}, rate={"pedal": 1e-4, "wheel": 1e-2}),
    )
