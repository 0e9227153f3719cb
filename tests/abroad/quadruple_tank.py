"""The quadruple tank: two pumps, four tanks, each pump fills a lower tank and the upper tank of the other side.

    A1 h1' = -a1 sqrt(2 g h1) + a3 sqrt(2 g h3) + g1 k1 v1,     A3 h3' = -a3 sqrt(2 g h3) + (1 - g2) k2 v2,
    A2 h2' = -a2 sqrt(2 g h2) + a4 sqrt(2 g h4) + g2 k2 v2,     A4 h4' = -a4 sqrt(2 g h4) + (1 - g1) k1 v1.

K. H. Johansson, The Quadruple-Tank Process, IEEE Trans. Control Syst. Technol. 8(3), 2000, table I: A = (28, 32, 28, 32) cm^2,
a = (0.071, 0.057, 0.071, 0.057) cm^2, at the minimum-phase point v = (3, 3) V, k = (3.33, 3.35) cm^3/(V s), g = (0.70, 0.60),
levels (12.4, 12.7, 1.8, 1.4) cm. `problem` is at that point; `nonminimum` has g = (0.43, 0.34), k = (3.14, 3.29), v = (3.15,
3.15) V, levels (12.6, 13.0, 4.8, 4.9) cm, and one zero in the right half plane. Chosen here: lower levels that swing by 2 cm,
and a model whose pumps are 20 % too strong and too weak and whose outlets are 15 % too wide.
"""

import casadi as ca

import fpirhc as fp

GRAVITY = 981.0  # cm/s^2


def response(q, u, p):
    def jet(level):
        return ca.sqrt(2 * GRAVITY * ca.fmax(level, 1e-3))  # cm/s

    return {
        "h1": (-p.a1 * jet(q.h1) + p.a1 * jet(q.h3) + p.g1 * p.k1 * u.v1) / 28,
        "h2": (-p.a2 * jet(q.h2) + p.a2 * jet(q.h4) + p.g2 * p.k2 * u.v2) / 32,
        "h3": (-p.a1 * jet(q.h3) + (1 - p.g2) * p.k2 * u.v2) / 28,
        "h4": (-p.a2 * jet(q.h4) + (1 - p.g1) * p.k1 * u.v1) / 32,
    }


def tanks(k=(3.33, 3.35), g=(0.7, 0.6)):
    """Four tanks with these pumps and valves."""
    return fp.Plant(
        coordinates={"h1": "cm", "h2": "cm", "h3": "cm", "h4": "cm"},
        inputs={"v1": "V", "v2": "V"},
        controlled=("h1", "h2"),
        order=1,
        response=response,
        parameters={
            "a1": fp.Parameter(approximate=1.15 * 0.071, exact=0.071, unit="cm^2"),
            "a2": fp.Parameter(approximate=1.15 * 0.057, exact=0.057, unit="cm^2"),
            "k1": fp.Parameter(approximate=1.2 * k[0], exact=k[0], unit="cm^3/V/s"),
            "k2": fp.Parameter(approximate=0.8 * k[1], exact=k[1], unit="cm^3/V/s"),
            "g1": fp.Parameter(approximate=g[0], exact=g[0], unit="1", bounds=(0.0, 1.0)),
            "g2": fp.Parameter(approximate=g[1], exact=g[1], unit="1", bounds=(0.0, 1.0)),
        },
    )


def task(plant, levels):
    """Swing the lower levels by 2 cm around these levels, once in 200 s."""
    names = ("h1", "h2", "h3", "h4")
    rest = dict(zip(names, levels, strict=True))

    def swing(t):
        return {
            **{n: rest[n] + 0 * t for n in names[2:]},
            "h1": rest["h1"] + 2 * ca.sin(0.03 * t),
            "h2": rest["h2"] + 2 * ca.cos(0.03 * t) - 2,
        }

    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(swing),
        start=rest,
        period=1.0,  # s
        duration=600.0,  # s
        limits=fp.Limits(inputs={"v1": (0.0, 12.0), "v2": (0.0, 12.0)}),
        horizon=fp.Horizon(stages=20, step=2.0),
        cost=fp.Quadratic(states={"h1": 1.0, "h2": 1.0}, deviation={"v1": 1e-3, "v2": 1e-3}),
        measure_from=200.0,  # s
    )


problem = task(tanks(), (12.4, 12.7, 1.8, 1.4))
nonminimum = task(tanks((3.14, 3.29), (0.43, 0.34)), (12.6, 13.0, 4.8, 4.9))

optimiser = fp.FixedPointSolver(iterations=1, tolerance=1e-2)  # V
plain = fp.RecedingHorizon(optimiser)
controllers = {
    "CTC": fp.ComputedTorque(fp.Exponential(rate=0.1)),
    "CTC+FPI": fp.ComputedTorque(fp.Exponential(rate=0.1), fp.Sigmoid(gain=-1.0)),
    "RHC": plain,
    "RHC+FPI": fp.RecedingHorizon(optimiser, fp.Sigmoid(gain=-1.0)),
    "RHC offset-free": fp.Estimating(
        plain, fp.DisturbanceKalman(drift={"h1": 0.1, "h2": 0.1}, measured={"h1": 1e-2, "h2": 1e-2})
    ),
    "RHC exact model": fp.ExactModel(plain),
}
headline = ("RHC", "RHC+FPI")
