"""Two correct problem files of the kinds that people write first: equations of motion, and states with an output."""

PENDULUM = '''"""A pendulum."""
import casadi as ca
import numpy as np
import fpirhc as fp


def response(q, v, u, p):
    inertia = p.mass * p.length**2
    return {"angle": (u.torque - p.friction * v.angle) / inertia - 9.81 / p.length * ca.sin(q.angle)}


plant = fp.Plant(
    coordinates={"angle": "rad"},
    inputs={"torque": "N m"},
    order=2,
    response=response,
    parameters={
        "mass": fp.Parameter(approximate=1.4, exact=1.0, unit="kg"),
        "length": fp.Parameter(approximate=0.5, exact=0.6, unit="m"),
        "friction": fp.Parameter(approximate=0.0, exact=0.2, unit="N m s"),
    },
)
problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"angle": 0.8 * ca.sin(2 * t)}),
    start={"angle": 0.0},
    period=1e-2,
    duration=0.2,
    limits=fp.Limits(inputs={"torque": (-15.0, 15.0)}),
    horizon=fp.Horizon(stages=6, step=2e-2),
    cost=fp.Quadratic(states={"angle": 1e3, "angle'": 1.0}, deviation={"torque": 1e-2}),
    measure_from=0.05,
)
optimiser = fp.FixedPointSolver(iterations=1, tolerance=1e-2)
adaptive = fp.ModelReferenced(fp.Sigmoid(gain=-2.6))
controllers = {"RHC": fp.RecedingHorizon(optimiser), "RHC+FPI": fp.RecedingHorizon(optimiser, adaptive)}
'''
REACTOR = '''"""A stirred tank reactor."""
import casadi as ca
import numpy as np
import fpirhc as fp


def rates(x, u, p):
    k = p.k0 * ca.exp(-8750 / x.T) * x.C
    return {"C": 1 - x.C - k, "T": 350 - x.T + 209.2 * k + p.wall * (u.Tc - x.T)}


plant = fp.Plant.of_states(
    states={"C": "mol/l", "T": "K"},
    inputs={"Tc": "K"},
    parameters={
        "k0": fp.Parameter(approximate=7e10, exact=7.2e10, unit="1/min"),
        "wall": fp.Parameter(approximate=2.2, exact=2.09, unit="1/min"),
    },
    rates=rates,
    outputs={"temperature": fp.Output("K", lambda x, p: x.T)},
    time_unit="min",
)
problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"temperature": 350 + 2 * ca.sin(t)}),
    start={"C": 0.5, "T": 350.0},
    period=0.05,
    duration=2.0,
    limits=fp.Limits(inputs={"Tc": (280.0, 320.0)}),
    horizon=fp.Horizon(stages=6, step=0.1),
    cost=fp.Quadratic(outputs={"temperature": 1.0}, rate={"Tc": 0.1}),
    input_before={"Tc": 300.0},
)
controllers = {
    "RHC": fp.RecedingHorizon(fp.FixedPointSolver(iterations=5, tolerance=0.1)),
    "RHC+FPI": fp.RecedingHorizon(fp.FixedPointSolver(iterations=5, tolerance=0.1), fp.ModelReferenced(fp.Affine(gain=-0.7))),
}
'''


def changes_of(table: str) -> dict[str, tuple[list[tuple[str, str]], tuple[str, ...]]]:
    """(changes, what must be said) by name: a name stands at the margin, its changes after two spaces, its message after four."""
    rows: dict[str, tuple[list[tuple[str, str]], list[str]]] = {}
    for line in table.replace(" ->\n      ", " -> ").strip().splitlines():
        if line[0] != " ":
            changes, said = rows[line] = [], []
        elif line[2] != " ":
            old, _, new = line[2:].partition(" ->")
            changes.append((old, new.removeprefix(" ")))
        else:
            said.append(line.strip())
    return {name: (changes, tuple(" ".join(said).split(" ... "))) for name, (changes, said) in rows.items()}


def messages_of(table: str) -> dict[str, str]:
    """What must be said by the words of a command line: 'words => message', which goes on in indented lines."""
    rows = [row.partition(" =>") for row in table.replace("\n    ", " ").strip().splitlines()]
    return {words: said.strip() for words, _, said in rows}
