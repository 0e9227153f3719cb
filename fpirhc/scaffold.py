"""Writes a problem file and its test under a new name."""

from __future__ import annotations

import keyword
import re
import sys
from importlib.machinery import PathFinder
from pathlib import Path

from fpirhc.errors import InvalidName, OutputError, writing
from fpirhc.problem_files.shipped import shipped_problems

_LONGEST = 60  # characters of a name


def create_problem(name: str, folder: Path) -> tuple[Path, Path]:
    """Write NAME.py and test_NAME.py into the folder, which is created where it is missing, and return their paths."""
    check_name(name)
    problem, test = folder / f"{name}.py", folder / f"test_{name}.py"
    texts = {path: text.replace("NAME", name) for path, text in ((problem, _PROBLEM), (test, _TEST))}
    for path in texts:
        if path.exists() or path.is_symlink():
            raise OutputError(f"'{path}' exists already and is kept; choose another name or --dir")
    with writing(folder, "--dir"):
        folder.mkdir(parents=True, exist_ok=True)
        for path, text in texts.items():
            path.write_text(text, encoding="utf-8")
    return problem, test


def check_name(name: str) -> None:
    """Raise unless a problem can have this name."""
    usable = _usable(name)
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise InvalidName(
            f"{name[:_LONGEST]!a} is no name for a problem: it must begin with a letter and go on with letters, digits and "
            f"underscores. Try '{usable}'; a folder is given by --dir"
        )
    if len(name) > _LONGEST:
        raise InvalidName(f"a name of {len(name)} characters is too long: at most {_LONGEST}. Try '{usable}'")
    if reason := _taken(name):
        raise InvalidName(f"'{name}' cannot be the name of a problem: {reason}. Try '{usable}'")


def _taken(name: str) -> str:
    """Reason why a well-formed name cannot be used; empty for a usable name."""
    if keyword.iskeyword(name) or keyword.issoftkeyword(name):
        return "it is a word of Python"
    if re.fullmatch(r"test_.*|.*_test|test|conftest", name.lower()):
        return "pytest would take the problem file for a test"
    # Without the current folder: a problem file in it is not an installed module.
    installed = [p for p in sys.path if p and Path(p).resolve() != Path.cwd()]
    if name in sys.stdlib_module_names or PathFinder.find_spec(name, installed):
        return "a module of that name is installed, which the file would hide from everything beside it"
    return "a shipped problem has it (see 'fpirhc list')" if name in shipped_problems() else ""


def _usable(name: str) -> str:
    """A name like the given one that can be used."""
    plain = re.sub(r"[^A-Za-z0-9]+", "_", name.removesuffix(".py")).strip("_")[: _LONGEST - 8].lower()
    if not plain:
        return "my_plant"
    candidate = re.sub(r"(^|_)test$", r"\1plant", plain if plain[0].isalpha() else f"plant_{plain}")
    return f"my_{candidate}" if _taken(candidate) else candidate


_PROBLEM = '''"""NAME: a mass on a spring, with a model that is wrong in mass and stiffness.

    m y'' = F - k y - b y'

Replace it by your plant. The first line of this text is the title of the report. Run it with: fpirhc compare NAME.py
"""

import casadi as ca

import fpirhc as fp


def response(q, v, u, p):
    """Highest derivative of every coordinate, from the lower ones (q, v), the inputs (u) and the parameters (p), all by name.

    Write functions of CasADi (ca.sin, ca.exp, ...): those of math cannot act on a symbol, and some of numpy cannot.
    Take every parameter from p: the controller computes with its approximate value, the simulated plant with the exact one. A plant
    of order 1, such as a tank or a heater, has no velocities: response(q, u, p).
    """
    return {"y": (u.F - p.k * q.y - p.b * v.y) / p.m}


plant = fp.Plant(
    coordinates={"y": "m"},  # what moves, with its unit
    inputs={"F": "N"},  # what the controller commands
    order=2,  # `response` gives the second derivative
    response=response,
    parameters={
        "m": fp.Parameter(approximate=1.5, exact=1.0, unit="kg"),
        "k": fp.Parameter(approximate=2.0, exact=4.0, unit="N/m"),
        "b": fp.Parameter(approximate=0.1, exact=0.4, unit="N s/m"),
    },
)

problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"y": 0.5 * ca.sin(2 * t)}),  # the nominal motion, m
    start={"y": 0.3},  # m; velocities, "y'", that are not named start at zero
    period=2e-3,  # s, of the control cycle
    duration=4.0,  # s
    limits=fp.Limits(inputs={"F": (-30.0, 30.0)}),  # N
    horizon=fp.Horizon(stages=15, step=2e-2),  # looks 0.3 s ahead
    # A derivative has a prime. The deviation is counted from the force that the model needs along the reference.
    cost=fp.Quadratic(states={"y": 1e2, "y'": 1.0}, deviation={"F": 1e-2}),
    measure_from=1.0,  # s: errors count from here on
    # A real plant has more, each off until it is stated (the window is 1 / (2 x period x bandwidth of the plan), docs/sensing.md):
    # dead_time=fp.DeadTime(inputs={"F": 0.01}),  # s, by which commands act late
    # sensing=fp.Sensing({"y": fp.Sensor(noise=fp.Noise(1e-4))}, fp.SavitzkyGolay(window=31, degree=2)),  # positions alone
)

optimiser = fp.FixedPointSolver()
# `fpirhc review NAME.py` says where another gain is better: ask again when the plant is yours.
sigmoid = fp.Sigmoid(gain=-1.0)
# Compares the plant with its model: an exact model is left alone. docs/choosing.md says when another form is better.
adaptive = fp.ModelReferenced(sigmoid)

controllers = {
    "RHC": fp.RecedingHorizon(optimiser),
    "RHC+FPI": fp.RecedingHorizon(optimiser, adaptive),
    "RHC exact model": fp.ExactModel(fp.RecedingHorizon(optimiser)),
}
headline = ("RHC", "RHC+FPI")  # the pair that the verdict is about
'''
_TEST = '''"""NAME: the plant and the controllers keep their laws, and adaptation lowers the error."""

from pathlib import Path

import pytest

import fpirhc as fp
from fpirhc.conformance import check_controller, check_plant

PROBLEM = Path(__file__).with_name("NAME.py")
TASK = fp.load_problem(str(PROBLEM))


def test_plant():
    """The response is finite, uses its parameters, and can be inverted, in the intervals `box`: state those of your plant."""
    check_plant(TASK.problem.plant, seed=1, box=dict.fromkeys(TASK.problem.plant.coordinates, (-1.0, 1.0)))


@pytest.mark.parametrize("name", TASK.controllers)
def test_controller(name):
    """It tracks with the exact model, keeps the limits, and never acts on a measurement that is not a number."""
    check_controller(TASK.controllers[name], problem=TASK.problem, seed=1, compiled=False)


def test_adaptation_helps():
    """The rms error with adaptation is less than half of that without."""
    plain, adaptive = (
        fp.measure(TASK.problem, fp.simulate(TASK.problem, TASK.controllers[name], seed=0, compiled=False))
        for name in TASK.headline
    )
    for coordinate, error in plain.rms_error.items():
        assert adaptive.rms_error[coordinate] < 0.5 * error


@pytest.mark.skipif(not (PROBLEM.parent / "baselines/NAME.json").exists(), reason='fpirhc accept NAME.py --reason "first numbers"')
def test_numbers_are_those_of_the_baseline(fpirhc_check):
    """When they change and should: fpirhc accept NAME.py --reason "..." """
    fpirhc_check(PROBLEM)
'''
