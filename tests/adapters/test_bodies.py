"""Bodies of other packages behind models: they move as the package says, and wrong uses are told by the adapter's name."""

import inspect
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import fpirhc as fp
from fpirhc.adapters import steps_per_cycle
from fpirhc.adapters.commonroad import commonroad_body
from fpirhc.adapters.fmu import fmu_body
from fpirhc.adapters.mujoco import mujoco_body
from fpirhc.adapters.rotorpy import rotorpy_body
from fpirhc.adapters.tclab import RealTime, tclab_body
from fpirhc.errors import InvalidField, InvalidProblem


def needed(package: str) -> Any:
    """A package of the extra, or no test."""
    return pytest.importorskip(package, reason="it needs the extra fpirhc[outside]")


# A car of CommonRoad behind a model of its heading
CAR = fp.Plant(
    {"y": "m", "heading": "rad"},
    {"steer": "rad", "acceleration": "m/s^2"},
    {},
    lambda q, v, u, p: {"y": u.steer, "heading": u.acceleration},
)


def car(kind: str = "st", **settings: Any) -> fp.ExternalPlant:
    needed("vehiclemodels")
    return commonroad_body(kind, CAR, **{"period": 1e-2, "speed": 20.0, **settings})


def of(name: str) -> Any:
    """What a module of the package has under its own name."""
    return getattr(import_module(f"vehiclemodels.{name}"), name)


@pytest.mark.parametrize("kind", ["st", "std"])
def test_a_cycle_is_that_of_the_packages_derivative(kind):
    """Against a solver of SciPy that does not know the body's steps; the wheels turn at a rate below the car's own."""
    plant, steer = car(kind), 2e-3
    own, first = of("parameters_vehicle2")(), [0.0, 0.0, 0.0, 20.0, 0.0, 0.0, 0.0]
    rate = of(f"vehicle_dynamics_{kind}")
    start = of("init_st")(first) if kind == "st" else of("init_std")(first, own)
    solved = solve_ivp(lambda _, x: rate(list(x), [steer / 1e-2, 1.0], own), (0, 1e-2), start, rtol=1e-10, atol=1e-12)
    end = solved.y[:, -1]
    plant.first(0)
    shown = plant.read(0.0, np.array([steer, 1.0]))
    measured = dict(zip(plant.measures, shown, strict=True))
    np.testing.assert_allclose(
        [measured["y"], measured["heading"], measured["heading'"]], end[[1, 4, 5]], rtol=1e-5, atol=1e-9
    )
    assert measured["heading''"] == pytest.approx(end[5] / 1e-2, rel=1e-5)  # from straight on


# A functional mock-up unit, built here from a Python class, behind a model of the same tank
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


def in_unit(path: Path, **settings: Any) -> fp.ExternalPlant:
    usual: dict[str, Any] = {"period": 0.05, "measures": {"h": "level"}, "inputs": {"q": "inflow"}}
    return fmu_body(path, TANK, **usual | settings)


@pytest.fixture(scope="module")
def unit(tmp_path_factory):
    needed("fmpy")
    # The builder imports the file by its name, and a module called tank may be there already.
    folder = tmp_path_factory.mktemp("fmu")
    (folder / "tank_unit.py").write_text(CODE)
    return needed("pythonfmu.builder").FmuBuilder.build_FMU(folder / "tank_unit.py", dest=folder)


def tank(reality: fp.ExternalPlant | None) -> fp.Problem:
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
    one, other = (fp.simulate(tank(reality), law, seed=0, compiled=False) for reality in (in_unit(unit), None))
    assert one.stop is None
    assert one["foreign"][:, 0] == pytest.approx(other["plant_state"][:, 0], abs=2e-4)  # Euler's steps, 100 a cycle


def test_a_parameter_is_set_and_a_run_begins_anew(unit):
    body: Any = in_unit(unit, parameters={"outlet": 0.8}).body
    answers = []
    for _ in range(2):
        body.reset(0)
        answers.append(body.step(0.0, np.array([0.8])))
    assert answers == [pytest.approx([1.0]), pytest.approx([1.0])]
    body.reset(0)
    assert float(np.ravel(body.step(0.0, np.array([0.5])))[0]) < 0.99


def test_a_parameter_that_is_no_real_number_is_set(unit):
    """Two pipes of .4 let out what one of .8 does."""
    body: Any = in_unit(unit, parameters={"outlet": 0.4, "pipes": 2}).body
    body.reset(0)
    assert np.ravel(body.step(0.0, np.array([0.8]))) == pytest.approx([1.0])


# A body of MuJoCo behind a model of the textbook
ARM = """<mujoco>
<option timestep="0.0005" integrator="{integrator}" gravity="0 0 -9.81"/>
<default><joint armature="{armature}" damping="{damping}" frictionloss="{friction}"/></default>
<worldbody><body>
  <joint name="shoulder" axis="0 -1 0"/><inertial pos="0.25 0 0" mass="2" diaginertia="1e-9 0.0416666667 0.0416666667"/>
  <body pos="0.5 0 0">
    <joint name="elbow" axis="0 -1 0"/><inertial pos="0.2 0 0" mass="1.2" diaginertia="1e-9 0.016 0.016"/>
    <body pos="0.4 0 0"><inertial pos="0 0 0" mass="{tool}" diaginertia="1e-9 1e-9 1e-9"/></body>
  </body>
</body></worldbody>
<actuator>
  <motor name="M1" joint="shoulder" ctrlrange="-80 80"/><motor name="M2" joint="elbow" ctrlrange="-40 40"/>
</actuator></mujoco>"""
RIGID = ARM.format(integrator="RK4", armature=0, damping=0, friction=0, tool=1e-9)
REAL = ARM.format(integrator="implicitfast", armature=0.03, damping=0.2, friction=0.4, tool=1.0)
CYCLE = 2e-3


def arm(mjcf: str | Path = REAL, **settings: Any) -> fp.ExternalPlant:
    needed("mujoco")
    return mujoco_body(mjcf, MODEL, **{"period": CYCLE} | settings)


def rods(q, v, u, p):
    """Two uniform rods in a vertical plane, without friction and tool."""
    a = p.m1 * 0.25 / 3 + p.m2 * 0.25 + p.m2 * 0.16 / 3
    b, c = p.m2 * 0.1, p.m2 * 0.16 / 3
    cosine, sine = ca.cos(q.elbow), ca.sin(q.elbow)
    mass = ca.blockcat([[a + 2 * b * cosine, c + b * cosine], [c + b * cosine, c]])
    turned = ca.vertcat(-b * sine * (2 * v.shoulder * v.elbow + v.elbow**2), b * sine * v.shoulder**2)
    outer = p.m2 * 9.81 * 0.2 * ca.cos(q.shoulder + q.elbow)
    weight = ca.vertcat((p.m1 / 2 + p.m2) * 9.81 * 0.5 * ca.cos(q.shoulder) + outer, outer)
    acceleration = ca.solve(mass, ca.vertcat(u.M1, u.M2) - turned - weight)
    return {"shoulder": acceleration[0], "elbow": acceleration[1]}


MODEL = fp.Plant(
    {"shoulder": "rad", "elbow": "rad"},
    {"M1": "N m", "M2": "N m"},
    {name: fp.Parameter(approximate=m, exact=m, unit="kg") for name, m in (("m1", 2.0), ("m2", 1.2))},
    rods,
)


def along(mjcf: str, duration: float) -> fp.Problem:
    return fp.Problem(
        plant=MODEL,
        reality=arm(mjcf),
        reference=fp.Trajectory(lambda t: {"shoulder": 0.8 * (1 - ca.cos(2 * t)), "elbow": -0.5 * (1 - ca.cos(3 * t))}),
        start={"shoulder": 0.0, "elbow": 0.0},
        period=CYCLE,
        duration=duration,
        measure_from=1.0,
        limits=fp.Limits(inputs={"M1": (-80.0, 80.0), "M2": (-40.0, 40.0)}),
    )


def test_a_frictionless_body_moves_as_the_textbook_says():
    body: Any = arm(RIGID, start={"shoulder": 0.3, "elbow'": 1.5}).body
    seen = body.reset(0)
    assert seen[:4] == pytest.approx([0.3, 0.0, 0.0, 1.5])
    for k, command in enumerate(np.random.default_rng(1).uniform(-20, 20, (20, 2))):
        seen = body.step(k * CYCLE, command)
        own = MODEL.equations.response(seen[:4], command, MODEL.exact).full().ravel()
        assert seen[4:] == pytest.approx(own, rel=1e-6)


def test_adaptation_pays_behind_dry_friction_and_a_tool_that_nobody_weighed():
    task = along(REAL, 3.0)
    error = {}
    for name, deformation in {"alone": fp.Identity(), "adapted": fp.ModelReferenced(fp.Affine(gain=-0.3))}.items():
        run = fp.simulate(task, fp.ComputedTorque(fp.Exponential(rate=8.0), deformation), seed=0, compiled=False)
        assert run.stop is None
        error[name] = fp.measure(task, run).rms_error
    for joint in MODEL.coordinates:
        assert error["adapted"][joint] < 0.1 * error["alone"][joint]


def test_an_unstable_body_ends_the_run(tmp_path, monkeypatch):
    """MuJoCo puts it back to its start, from where the run went on and was complete."""
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a file of its warnings
    stiff = REAL.replace("<joint armature", '<joint stiffness="1e9" armature')
    reality = arm(stiff.replace("implicitfast", "Euler"), start={"elbow": 1.0})
    for _run in range(2):
        reality.first(0)
        with pytest.raises(InvalidProblem, match=r"MuJoCo says that the simulation is unstable in the cycle from 0 s"):
            [reality.read(k * CYCLE, np.zeros(2)) for k in range(30)]


def test_a_file_is_read_too(tmp_path):
    (tmp_path / "arm.xml").write_text(REAL)
    measured: Any = arm(tmp_path / "arm.xml").measures
    assert measured["elbow''"] == "rad/s^2"


# A quadrotor of RotorPy behind a point mass
AXES = ("x", "y", "z")
POINT = fp.Plant(
    dict.fromkeys(AXES, "m"),
    {f"thrust_{name}": "m/s^2" for name in AXES},
    {},
    lambda q, v, u, p: {name: getattr(u, f"thrust_{name}") - 9.81 * (name == "z") for name in AXES},
)


def quadrotor(**settings: Any) -> fp.ExternalPlant:
    needed("rotorpy")
    return rotorpy_body(POINT, **{"period": 1e-2, **settings})


def shown(plant: fp.ExternalPlant, seconds: float = 0.1) -> dict[str, float]:
    """What it measures after it was told to hover."""
    plant.first(0)
    for k in range(round(seconds / 1e-2)):
        values = plant.read(k * 1e-2, np.array([0.0, 0.0, 9.81]))
    return dict(zip(plant.measures, values, strict=True))


def test_it_hovers_sinks_with_a_payload_and_goes_with_the_wind():
    """The thrust is that per nominal mass, so that a fifth more of it leaves the weight of the payload."""
    at = shown(quadrotor(start={"x": 1.0}))
    assert at["x"] == pytest.approx(1.0, abs=1e-6)
    assert at["z''"] == pytest.approx(0.0, abs=1e-3)
    assert shown(quadrotor(payload=0.1))["z''"] == pytest.approx(
        -9.81 * 0.1 / 0.6, rel=0.15
    )  # the Hummingbird has .5 kg
    assert shown(quadrotor(wind=(3.0, 0.0, 0.0)))["x'"] > 0.001


def test_the_law_of_the_position_is_that_of_the_package():
    """The thrust is what SE3Control asks for in the same state, on the same circle."""
    control = needed("rotorpy.controllers.quadrotor_control")
    circle = needed("rotorpy.trajectories.circular_traj").ThreeDCircularTraj
    vehicle = needed("rotorpy.vehicles.hummingbird_params").quad_params
    task = fp.load_problem("quadrotor")
    run = fp.simulate(
        replace(task.problem, duration=0.5, measure_from=0.0), task.controllers["SE3 of RotorPy"], seed=0, compiled=None
    )
    x, v = np.split(run["state"][40], 2)
    state = {"x": x, "v": v, "q": np.array([0.0, 0.0, 0.0, 1.0]), "w": np.zeros(3)}
    flat = circle(radius=np.array([2, 2, 0]), freq=np.full(3, 0.2)).update(0.4)
    expected = control.SE3Control(vehicle).update(0.4, state, flat)["cmd_acc"]
    assert run["command"][40] == pytest.approx(expected, rel=1e-9)


# The Temperature Control Lab behind two energy balances: its twin, and the board with a clock of the test's own
def constant(value: float, unit: str) -> fp.Parameter:
    return fp.Parameter(approximate=value, exact=value, unit=unit)


# The step test of the course: .9 K/% and 175 s; the second heater has half the power.
LAB = fp.Plant(
    {"T1": "degC", "T2": "degC"},
    {"Q1": "%", "Q2": "%"},
    {"K1": constant(0.9, "K/%"), "K2": constant(0.45, "K/%"), "tau": constant(175.0, "s")},
    lambda q, u, p: {"T1": (p.K1 * u.Q1 - (q.T1 - 21)) / p.tau, "T2": (p.K2 * u.Q2 - (q.T2 - 21)) / p.tau},
    order=1,
)


def lab(model: fp.Plant = LAB, **settings: Any) -> fp.ExternalPlant:
    needed("tclab")
    return tclab_body(model, **{"period": 2.0} | settings)


def test_the_twin_is_the_packages_own_model():
    tclab = needed("tclab")
    body: Any = lab().body
    same = tclab.tclab.TCLabModel(synced=False)
    same.tstart = same.tlast = 0.0
    body.reset(0)
    for k in range(50):
        seen = body.step(k * 2.0, np.array([60.0, 30.0]))
        same.Q1(60.0), same.Q2(30.0)
        same.update((k + 1) * 2.0)
    assert seen == pytest.approx([same._T1, same._T2], abs=0.6)  # noise and the converter's steps


def test_the_board_is_asked_when_its_cycle_is_over(monkeypatch):
    tclab, now = needed("tclab"), [100.0]

    class Board(tclab.tclab.TCLabModel):  # type: ignore[misc]
        def __init__(self):
            super().__init__(synced=False)
            self.tstart = self.tlast = 0.0
            self.closed = False

        def update(self, t=None):
            del t
            super().update(now[0] - 100.0)

        def close(self):
            self.closed = True

    def sleep(seconds: float) -> None:
        now[0] += seconds

    monkeypatch.setattr(tclab, "TCLab", Board)
    body: Any = lab(board=RealTime(lambda: now[0], sleep), rest={"Q1": 0.0, "Q2": 0.0}).body
    body.reset(0)
    body.step(0.0, np.array([50.0, 0.0]))
    now[0] += 0.5  # the controller's own time
    body.step(2.0, np.array([50.0, 0.0]))
    assert now[0] == pytest.approx(104.0)
    now[0] += 5.0
    with pytest.raises(InvalidProblem, match=r"the cycle of 2 s ended 3 s late"):
        body.step(4.0, np.array([50.0, 0.0]))
    first = body._lab
    now[0] = 100.0
    body.reset(0)
    assert first.closed


def test_a_wrong_argument_of_an_adapter_is_named():
    """A loaded task in place of an argument that is checked; no package is asked for before."""
    task = fp.load_problem("two_mass")
    for adapter in (commonroad_body, fmu_body, mujoco_body, rotorpy_body, tclab_body):
        parameters = list(inspect.signature(adapter).parameters.values())
        needed = [one for one in parameters if one.default is one.empty]
        checked = [one for one in parameters if one.annotation not in ("Any", "object")]
        named = dict.fromkeys([*(one.name for one in needed), checked[0].name], task)
        with pytest.raises(InvalidField, match=rf"{adapter.__name__}\.{checked[0].name}: expected "):
            adapter(**named)


MINUTES = fp.Plant({"x": "m"}, {"u": "m/min^2"}, {}, lambda q, v, u, p: {"x": u.u}, time_unit="min")
OTHER = fp.Plant({"T3": "degC"}, {"Q": "%"}, {}, lambda q, u, p: {"T3": u.Q}, order=1)
IN_SECONDS = "_body: its time is in s, and that of the model is in min"  # a period of a minute lasted a second
WRONG: dict[Callable[..., Any], list[tuple[dict[str, Any], str]]] = {
    car: [
        ({"kind": "sdt"}, "kind 'sdt' is unknown. Did you mean 'st'"),
        ({"vehicle": 9}, "vehicle '9' is unknown. Valid: 1, 2, 3, 4"),
        ({"speed": -5.0}, "commonroad_body.speed: expected a finite number of at least 0, got -5.0"),
        ({"period": 1.5e-3}, "no whole number of its steps of 0.001 s"),
        ({"names": {"side": "y"}}, "name of the model 'side' is unknown"),
    ],
    in_unit: [
        ({"measures": {"h": "leve"}}, "variable 'leve' is unknown. Did you mean 'level'?"),
        ({"measures": {"hh": "level"}}, "measures: quantity 'hh' is unknown. Did you mean 'h'?"),
        ({"measures": {"h": "pipes"}}, "variable 'pipes' is of the type Integer; expected Real or Float64"),
        ({"inputs": {"q": "pipes"}}, "variable 'pipes' is of the type Integer; expected Real or Float64"),
        ({"inputs": {}}, "input 'q' is unknown."),
        ({"parameters": {"inlet": 1.0}}, "parameters: variable 'inlet' is unknown. Did you mean 'outlet'?"),
    ],
    arm: [
        ({"joints": {"elbow": "elbo"}}, "joint 'elbo' is unknown. Did you mean 'elbow'? Valid: shoulder, elbow."),
        ({"joints": {"elbo": "elbow"}}, "joints: name of the model 'elbo' is unknown. Did you mean 'elbow'?"),
        ({"actuators": {"M1": "M3"}}, "actuator 'M3' is unknown. Did you mean 'M2'?"),
        ({"start": {"elbow''": 1.0}}, "start: quantity 'elbow''' is unknown. Did you mean \"elbow'\"?"),
        ({"period": 1.7e-3}, "0.0017 s is no whole number of its steps of 0.0005 s; choose a period of 0.0015 s"),
    ],
    quadrotor: [
        ({"payload": -1.0}, "rotorpy_body.payload: expected a finite number of at least 0, got -1.0"),
        ({"wind": (3.0, 0.0)}, "wind: expected (a finite number, a finite number, a finite number), got (3.0, 0.0)"),
        ({"vehicle": {"mass": 1}}, "vehicle lacks k_eta; change a set of the package"),
        ({"start": {"q": 1.0}}, "start: quantity 'q' is unknown"),
    ],
    lab: [
        ({"board": RealTime()}, "keeps its heaters on after a run; "),
        ({"board": RealTime()}, 'rest={"Q1": 0.0, "Q2": 0.0}'),
        ({"model": OTHER}, "measured 'T3' is unknown. Did you mean 'T2'?"),
        ({"model": OTHER}, "input 'Q' is unknown. Did you mean 'Q2'?"),
    ],
    tclab_body: [({"model": MINUTES, "period": 1.0}, IN_SECONDS)],
    rotorpy_body: [({"model": MINUTES, "period": 1.0}, IN_SECONDS)],
    # Of MuJoCo and CommonRoad.
    steps_per_cycle: [({"where": "mine_body", "model": MINUTES, "period": 1.0, "step": 0.5}, IN_SECONDS)],
}


@pytest.mark.parametrize(("of", "settings", "words"), [(of, *row) for of, rows in WRONG.items() for row in rows])
def test_a_wrong_use_is_told(of, settings, words, request):
    first = (request.getfixturevalue("unit"),) if of is in_unit else ()
    with pytest.raises(fp.FpirhcError) as caught:
        of(*first, **settings)
    assert words in str(caught.value)


def test_what_a_package_raises_has_the_adapters_name(tmp_path):
    """What is no archive is told by the package in its own words, and a file that is not there by its name."""
    needed("fmpy")
    (tmp_path / "no.fmu").write_text("nothing")
    for name, words in (("no.fmu", "fmu_body: BadZipFile: File is not a zip file"), ("absent.fmu", "cannot be read")):
        with pytest.raises(InvalidProblem, match=words):
            fmu_body(str(tmp_path / name), TANK, period=0.1, measures={"h": "h"})
