"""Depth of anaesthesia in 101 patients: a pump that aims at a concentration, and who may move its target.

A pump for target-controlled infusion has a model of the drug's way: three compartments after Schnider et al. (Anesthesiology 88,
1998) from age, weight, height and sex, and an effect site. It gives the dose with which this model's effect site follows a target.
What a concentration does is the patient's own,

    Ce' = ke0 (C1 - Ce),        bis = E0 - Emax / (1 + (C50 / Ce)^steepness),

behind a dead time of up to 150 s. A monitor shows the bis with coloured noise of deviation 3. Surgery adds 10 from 20 to 35 min.

The table anaesthesia_people.csv has three sets. A: 44 patients; settings were chosen on every second one. B: the same people with
curves for other kinetics, those of Eleveld et al. (Br. J. Anaesth. 120, 2018; with opioids), by which their drug moves while the
pump believes in Schnider's. C: 13 patients of another source. The model of all controllers has the medians of A: a lag, a dead time
of 39 s, and one curve.

Task: the patient is awake; the bis is to be 50, with a target every 5 s. Errors and shares of the time count from 10 min on. For
the patient of medians:

    rms error, seed 0                  bis [1]
    pump alone                             5.4
    PID                                    3.4
    RHC offset-free                        3.5
    cascade in mg/l, model-referenced      3.5
    cascade                                  4
    cascade in mg/l                        3.5

What counts is who fares worst: the worst patient's share of the time from 40 to 60 in %, the lowest bis of anybody with the
induction, and then the mean share (`fpirhc study anaesthesia_people --cases all`), seed 0:

    worst, lowest, mean                A tuned             A unseen            B                   C
    pump alone                         0    35.4   67.1    0    26.7   59.5    0    28.9   64.9    0    14.7   52.4
    PID                                92   39.8   99.1    95   39.6   98.9    93   38.9   98.9    100  42.3  100.0
    RHC offset-free                    89   39.3   98.4    93   38.9   98.1    82   36.1   98.1    98   40.0   99.7
    cascade in mg/l, model-referenced  87   32.9   97.8    94   39.2   98.3    87   30.3   98.4    98   28.0   99.9
    cascade                            90   39.6   97.9    94   39.4   97.8    88   38.7   98.1    96   41.5   99.3
    cascade in mg/l                    90   40.0   98.4    94   39.9   98.5    92   39.3   98.9    100  41.9  100.0

At least 90, 37 and 97 are wanted on those that nothing was tuned on. `cascade in mg/l` and the PID law have that on "A unseen", B
and C, the PID law with each of five seeds, the cascade but for one seed on B, see below; on "A tuned" its worst share is 88 to 91.
The offset-free plan has it on "A unseen" and C, and not on B.

Of the settings that were tried on "A tuned" those were taken with which nobody there is in the range for less than 90 % of the
time, and of these the one with the highest lowest bis; with the best worst share where there are none. The first rule was the best
worst share. It was given up after all sets had been run, because its cascade in mg/l was less safe in B. So "A unseen" and B chose
no setting, but they are no blind test. Six to eighteen settings of each controller were tried here, and before that some dozens of
the PID law and of the cascades in a loop of numpy.

The window matters too. It begins at 10 min because patients with a long dead time are on their way until then; the worst share of
the time from 5 min on, `Problem(measure_from=5.0)`, is lower, and below 90 % in two or three of the four groups:

    worst from 5 min on    A tuned    A unseen    B     C
    PID                    84         88          87    94
    cascade in mg/l        82         91          90    96

Noise moves all of this. The least and the most of five seeds, worst share and lowest bis, by `fpirhc study
anaesthesia_people --cases all --seed 1` and so on:

    seeds 0 to 4     A tuned                 A unseen                B                       C
    PID              90 to 92  39.2 to 40.0  94 to 95  39.0 to 40.0  93 to 95  38.5 to 39.2  98 to 100  41.6 to 42.3
    RHC offset-free  86 to 91  38.7 to 39.7  92 to 93  37.6 to 39.1  79 to 84  36.1 to 37.6  97 to 99   38.9 to 40.1
    cascade in mg/l  88 to 91  40.0 to 40.6  93 to 96  39.9 to 40.7  89 to 95  39.0 to 39.8  98 to 100  41.9 to 42.9

On these people it is a draw of `cascade in mg/l` with a PID law on the pump's target, which needs no curve; on those of the blind
test, `anaesthesia_drawn`, the PID law is safer. Both add up the error, and both begin
with little drug. Three things make the difference to the other rows.

The form: a plain cascade begins at the target that is in force, and awake that is none. The model-referenced one begins with the
target that its model has for 50, as the pump alone does, and sensitive patients go low in the induction.

The unit: the slope of the curve changes along it and from patient to patient, and with it the gain from a target to the bis. In
mg/l, through the model's curve, the worst patients of B and C are longer in the range.

What is corrected: the offset-free plan adds its estimate to the bis, at a slope that is not the patient's. In set B, where the
kinetics are not the pump's, its worst patient is outside the range for more than a sixth of the time.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import casadi as ca
import pandas as pd

import fpirhc as fp
from fpirhc.deformation.base import Wrapper

CYCLE = 1 / 12  # min
LARGEST = 400.0  # mg/min, of the pump
PARTS = 5  # Runge-Kutta steps of a cycle
SITES = ("C1", "C2", "C3", "Ce")
KINETICS = (("V1", "V2", "V3"), ("cleared", "fast", "slow"))
LEAST, MOST = 0.5, 12.0  # mg/l


def schnider(p):
    """Volumes and clearances of the three compartments, l and l/min."""
    ratio = (p.weight / p.height) ** 2
    lean = ca.if_else(p.sex > 0.5, 1.07 * p.weight - 148.0 * ratio, 1.1 * p.weight - 128.0 * ratio)
    cleared = 1.89 + 0.0456 * (p.weight - 77.0) - 0.0681 * (lean - 59.0) + 0.0264 * (p.height - 177.0)
    return (4.27, 18.9 - 0.391 * (p.age - 53.0), 238.0), (cleared, 1.29 - 0.024 * (p.age - 53.0), 0.836)


def fat_free(age, weight, height, sex):
    """Mass without fat after Al-Sallami et al., kg."""
    index = weight / (height / 100) ** 2
    men = (0.88 + 0.12 / (1 + (age / 13.4) ** -12.7)) * 9270 * weight / (6680 + 216 * index)
    women = (1.11 - 0.11 / (1 + (age / 7.1) ** -1.1)) * 9270 * weight / (8780 + 244 * index)
    return ca.if_else(sex > 0.5, women, men)


def eleveld(p):
    """The same after Eleveld et al., with opioids, arterial samples."""
    weeks, usual = p.age * 365.25 / 7 + 40, 35 * 365.25 / 7 + 40
    central = p.weight / (p.weight + 33.6) * (70 + 33.6) / 70
    second = p.weight / 70 * ca.exp(-0.0156 * (p.age - 35))
    third = fat_free(p.age, p.weight, p.height, p.sex) / fat_free(35.0, 70.0, 170.0, 0.0) * ca.exp(-0.0138 * p.age)

    def mature(w):
        return w**9.06 / (w**9.06 + 42.3**9.06)

    def full(w):
        return w / (w + 68.3)

    cleared = ca.if_else(p.sex > 0.5, 2.10, 1.79) * (p.weight / 70) ** 0.75 * mature(weeks) / mature(usual)
    fast = 1.75 * second**0.75 * (1 + 1.30 * (1 - full(weeks)))
    slow = 1.11 * third**0.75 * full(weeks) / full(usual)
    return (6.28 * central, 25.5 * second, 273 * third), (cleared * ca.exp(-0.00286 * p.age), fast, slow)


def moved(now, infusion, kinetics, ke0):
    """Concentrations one cycle later, by the classic Runge-Kutta formula."""
    (V1, V2, V3), (cleared, fast, slow) = kinetics

    def slopes(c):
        c1, c2, c3, ce = c
        return (
            (infusion - cleared * c1 - fast * (c1 - c2) - slow * (c1 - c3)) / V1,
            fast / V2 * (c1 - c2),
            slow / V3 * (c1 - c3),
            ke0 * (c1 - ce),
        )

    def along(by, rates):
        return tuple(c + by * r for c, r in zip(now, rates, strict=True))

    h = CYCLE / PARTS
    for _ in range(PARTS):
        a = slopes(now)
        b = slopes(along(h / 2, a))
        c = slopes(along(h / 2, b))
        d = slopes(along(h, c))
        now = along(h / 6, [w + 2 * x + 2 * y + z for w, x, y, z in zip(a, b, c, d, strict=True)])
    return now


KE0, APPROACH = 0.309, 1.5  # 1/min


def dose(now, target, kinetics):
    """Infusion of the pump, mg/min: its model's effect site follows the target with two rates of 1.5/min."""
    (V1, _, _), (cleared, fast, slow) = kinetics
    c1, c2, c3, ce = now
    rate = KE0 * (c1 - ce)
    bent = APPROACH**2 * (target - ce) - 2 * APPROACH * rate
    wanted = V1 * (bent / KE0 + rate) + cleared * c1 + fast * (c1 - c2) + slow * (c1 - c3)
    return ca.fmin(ca.fmax(wanted, 0), LARGEST)


def person(x, u, p):
    """A cycle of pump and patient."""
    pump, own = (tuple(x[f"{who}_{n}"] for n in SITES) for who in ("pump", "own"))
    believed, other = schnider(p), eleveld(p)
    real = [
        tuple(p[f"times_{n}"] * ca.if_else(p.eleveld > 0.5, e, s) for n, e, s in zip(names, *both, strict=True))
        for names, *both in zip(KINETICS, other, believed, strict=True)
    ]
    infusion = dose(pump, u.target, believed)
    later = {"pump": moved(pump, infusion, believed, KE0), "own": moved(own, infusion, real, p.ke0)}
    return {f"{who}_{n}": c for who, all_ in later.items() for n, c in zip(SITES, all_, strict=True)} | {
        "infusion": infusion,
        "surgery": p.surgery,
    }


def depth(x, p):
    """The patient's bis."""
    reached = ca.fmax(x.own_Ce, 1e-6)
    steepness = p.steepness * ca.if_else(reached > p.C50, p.times_above, 1)
    return x.surgery + p.E0 - p.Emax / (1 + (p.C50 / reached) ** steepness)


def same(value, unit, low, high):
    return fp.Parameter(approximate=value, exact=value, unit=unit, bounds=(low, high))


patient = fp.Plant.discrete(
    states={f"{who}_{n}": "mg/l" for who in ("pump", "own") for n in SITES} | {"infusion": "mg/min", "surgery": "1"},
    inputs={"target": "mg/l"},
    next=person,
    step=CYCLE,
    outputs={"bis": fp.Output("1", depth)},
    time_unit="min",
    parameters={
        "age": same(61.0, "year", 1, 110),
        "height": same(175.0, "cm", 50, 230),
        "weight": same(77.0, "kg", 3, 300),
        "sex": same(0.0, "1", 0, 1),
        "eleveld": same(0.0, "1", 0, 1),
        "E0": same(92.0, "1", 50, 100),
        "Emax": same(92.0, "1", 50, 100),
        "ke0": same(0.309, "1/min", 0.01, 12),
        "C50": same(4.53, "mg/l", 0.5, 20),
        "steepness": same(1.57, "1", 0.5, 10),
        "times_above": same(1.0, "1", 0.1, 10),  # the steepness beyond C50
        **{f"times_{n}": same(1.0, "1", 0.02, 50) for names in KINETICS for n in names},
        "surgery": fp.outside(nominal=0.0, unit="1"),
    },
)


def concentration(bis, p, from_top=0.5):
    """At which the model's curve has a bis, mg/l; the bis is kept inside the curve, so far from its upper end."""
    inside = ca.fmin(ca.fmax(bis, 2.0), p.E0 - from_top)
    return p.C50 * (p.E0 / inside - 1) ** (1 / p.steepness)


def curve(c, p):
    """The model's bis at a concentration."""
    return p.E0 / (1 + (ca.fmax(c, 1e-3) / p.C50) ** p.steepness)


def settling(x, u, p):
    """A cycle of the model."""
    decay = ca.exp(-CYCLE / p.lag)
    return {"bis": decay * x.bis + (1 - decay) * curve(u.target, p)}


def needed_target(x, r, p):
    """The target for a wanted change of the bis; that of the curve's end where the curve does not reach so far."""
    decay = ca.exp(-CYCLE / p.lag)
    return {"target": concentration(x.bis + CYCLE * r.bis / (1 - decay), p, from_top=1e-4)}


model = fp.Plant.discrete(
    states={"bis": "1"},
    inputs={"target": "mg/l"},
    next=settling,
    step=CYCLE,
    time_unit="min",
    parameters={
        "lag": same(1.5, "min", 0.1, 60),
        "E0": same(92.0, "1", 50, 100),
        "C50": same(4.53, "mg/l", 0.5, 20),
        "steepness": same(1.57, "1", 0.5, 10),
    },
)
model = replace(model, inverse=needed_target)


def surgery(t):
    """What surgery adds to the bis; t in min."""
    return 10 / (1 + ca.exp(4 * (20 - t))) - 10 / (1 + ca.exp(4 * (35 - t)))


problem = fp.Problem(
    plant=model,
    reality=fp.Reality(
        patient, start={f"{who}_{n}": 0.0 for who in ("pump", "own") for n in SITES} | {"infusion": 0.0, "surgery": 0.0}
    ),
    reference=fp.Trajectory(lambda t: {"bis": 50.0 + 0 * t}),
    start={"bis": 92.0},
    period=CYCLE,
    duration=60.0,
    dead_time=fp.DeadTime(inputs={"target": 0.65}),
    limits=fp.Limits(inputs={"target": (LEAST, MOST)}),
    input_before={"target": LEAST},
    signals={"surgery": fp.Unknown(surgery)},
    sensing=fp.Sensing(sensors={"bis": fp.Sensor(noise=fp.Noise(3.0, correlation_time=0.1))}),
    horizon=fp.Horizon(stages=20, step=0.25),
    cost=fp.Quadratic(states={"bis": 1.0}, rate={"target": 6000.0}),
    measure_from=10.0,
)
pump = fp.FeedforwardOnly()
late = 0.65  # min
slow = fp.Filtered(fp.Affine(gain=-0.8), pole=0.85)
MEDIAN = SimpleNamespace(**{name: one.approximate for name, one in model.parameters.items()})


@dataclass(frozen=True)
class InConcentration(Wrapper):
    """A map on concentrations: all that it is given passes the model's curve backwards, and the next request forwards."""

    def memory(self, elements):
        return self.map.memory(elements)

    def step(self, request, response, desired, memory):
        """What the map returns, as a bis."""
        seen = (concentration(bis, MEDIAN) for bis in (request, response, desired))
        target, remembered = self.map.step(*seen, memory)
        return curve(ca.fmin(ca.fmax(target, LEAST), MOST), MEDIAN), remembered


plan = fp.RecedingHorizon(fp.FixedPointSolver())
filter = fp.DisturbanceKalman(drift={"bis": 1.0}, measured={"bis": 3.0})
controllers = {
    "pump alone": pump,
    "PID": fp.PID({"bis": -0.04}, {"bis": -0.0235}, bumpless=False),
    "RHC offset-free": fp.Predicted(
        fp.Estimating(plan, filter, dead_time=fp.DeadTime(inputs={"target": late})), inputs=late
    ),
    "cascade in mg/l, model-referenced": fp.Cascade(
        pump, InConcentration(fp.Affine(gain=-0.08)), lag=2.5, dead_time=late
    ),
    "cascade": fp.Cascade(pump, fp.Filtered(fp.Affine(gain=-0.6), pole=0.85), lag=1.3, dead_time=late, plain=True),
    "cascade in mg/l": fp.Cascade(pump, InConcentration(slow), lag=1.2, dead_time=late, plain=True),
}
headline = ("pump alone", "cascade in mg/l")
why = (
    "Dead times of up to 150 s bound the gain, and both add up the error of the bis "
    "within it; in mg/l the loop's gain varies less."
)
patients = pd.read_csv(Path(__file__).with_name("anaesthesia_people.csv"), comment="#", index_col="case")
patients["exact.sex"] = patients["exact.sex"].map({"m": 0.0, "f": 1.0})
cases = fp.Cases(patients.to_dict("index"))
BIS = "plant_state.bis"


def lowest(problem, run):
    """The lowest bis of the whole run, the induction with it."""
    return float(run[BIS].min())


metrics = (fp.figures.InBand(BIS, 40.0, 60.0), fp.Metric("lowest", lowest, better="larger", main=True))
headline_metric = "in_band"
pictures = (fp.OverTime("Depth and infusion", panels=(BIS, "reality_state.infusion"), levels={BIS: (40.0, 60.0)}),)
