"""A functional mock-up unit, built here from a Python class, behind a model of the same tank."""

from typing import Any

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.adapters.fmu import fmu_body
from fpirhc.errors import InvalidProblem

pytest.importorskip("fmpy", reason="it needs the extra fpirhc[outside]")
builder = pytest.importorskip("pythonfmu.builder", reason="it needs the extra fpirhc[outside]")

CODE = """
from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Integer, Real


class Tank(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.inflow, self.level, self.outlet, self.pipes = 0.0, 1.0, 0.5, 1
        self.register_variable(Real("inflow", causality=Fmi2Causality.input))
        self.register_variable(Real("level", causality=Fmi2Causality.output))
        self.register_variable(Real("outlet", causality=Fmi2Causality.parameter, variability=Fmi2Variability.fixed))
        self.register_variable(Integer("pipes", causality=Fmi2Causality.parameter, variability=Fmi2Variability.fixed))

    def do_step(self, time, step):
        for _ in range(100):
            self.level += step / 100 * (self.inflow - self.pipes * self.outlet * self.level**0.5)
        return True
"""
TANK = fp.Plant(
    {"h": "m"},
    {"q": "m/s"},
    {"outlet": fp.Parameter(approximate=0.5, exact=0.5, unit="m^0.5/s")},
    lambda q, u, p: {"h": u.q - p.outlet * q.h**0.5},
    order=1,
)


@pytest.fixture(scope="module")
def unit(tmp_path_factory):
    # The builder imports the file by its name, and a module called tank may be there already.
    folder = tmp_path_factory.mktemp("fmu")
    (folder / "tank_unit.py").write_text(CODE)
    return builder.FmuBuilder.build_FMU(folder / "tank_unit.py", dest=folder)


def problem(reality: fp.ExternalPlant | None) -> fp.Problem:
    return fp.Problem(
        plant=TANK,
        reality=reality,
        sensing=fp.Sensing(estimator=fp.PositionDifference()),
        reference=fp.Trajectory(lambda t: {"h": 1.0 + 0.2 * t}),
        start={"h": 1.0},
        period=0.05,
        duration=2.0,
        measure_from=1.0,
    )


def test_the_unit_moves_as_the_same_equation_does(unit):
    law = fp.ComputedTorque(fp.Exponential(rate=2.0))
    outside = fmu_body(unit, TANK, period=0.05, measures={"h": "level"}, inputs={"q": "inflow"})
    one, other = (fp.simulate(problem(reality), law, seed=0, compiled=False) for reality in (outside, None))
    assert one.stop is None
    assert one["foreign"][:, 0] == pytest.approx(other["plant_state"][:, 0], abs=2e-4)  # Euler's steps, 100 a cycle


def test_a_parameter_is_set_and_a_run_begins_anew(unit):
    body: Any = fmu_body(
        unit, TANK, period=0.05, measures={"h": "level"}, inputs={"q": "inflow"}, parameters={"outlet": 0.8}
    ).body
    answers = []
    for _ in range(2):
        body.reset(0)
        answers.append(body.step(0.0, np.array([0.8])))
    assert answers == [pytest.approx([1.0]), pytest.approx([1.0])]
    body.reset(0)
    assert float(np.ravel(body.step(0.0, np.array([0.5])))[0]) < 0.99


def test_a_parameter_that_is_no_real_number_is_set(unit):
    """Two pipes of .4 let out what one of .8 does."""
    many = {"outlet": 0.4, "pipes": 2}
    body: Any = fmu_body(unit, TANK, period=0.05, measures={"h": "level"}, inputs={"q": "inflow"}, parameters=many).body
    body.reset(0)
    assert np.ravel(body.step(0.0, np.array([0.8]))) == pytest.approx([1.0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"measures": {"h": "leve"}}, "variable 'leve' is unknown. Did you mean 'level'?"),
        ({"measures": {"hh": "level"}}, "measures: quantity 'hh' is unknown. Did you mean 'h'?"),
        ({"measures": {"h": "pipes"}}, "variable 'pipes' is of the type Integer; expected Real or Float64"),
        ({"inputs": {"q": "pipes"}}, "variable 'pipes' is of the type Integer; expected Real or Float64"),
        ({"inputs": {}}, "input 'q' is unknown."),
        ({"parameters": {"inlet": 1.0}}, "parameters: variable 'inlet' is unknown. Did you mean 'outlet'?"),
    ],
)
def test_mistakes_are_named(unit, arguments, message):
    with pytest.raises(InvalidProblem) as caught:
        fmu_body(unit, TANK, **{"period": 0.05, "measures": {"h": "level"}, "inputs": {"q": "inflow"}, **arguments})
    assert message in str(caught.value)
