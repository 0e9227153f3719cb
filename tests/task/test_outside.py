"""Signals from outside: known and previewed, unknown; a room that is heated against the weather."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import fpirhc as fp

PERIOD, DURATION = 0.25, 30.0  # h


def response(q, u, p):
    """Temperatures of the air and of the walls, K/h."""
    return {
        "air": (p.loss * (p.ambient - q.air) + p.wall * (q.walls - q.air) + u.heat) / p.heat_capacity,
        "walls": p.wall * (q.air - q.walls) / 6.0,
    }


def room(ambient: fp.Parameter, *, wrong: float = 1.0) -> fp.Plant:
    """A room; the model's loss is `wrong` times too large."""
    return fp.Plant(
        coordinates={"air": "K", "walls": "K"},
        inputs={"heat": "kW"},
        controlled=("air",),
        order=1,
        response=response,
        parameters={
            "loss": fp.Parameter(approximate=0.3 * wrong, exact=0.3, unit="kW/K"),
            "ambient": ambient,
            "wall": fp.Parameter(approximate=0.5, exact=0.5, unit="kW/K"),
            "heat_capacity": fp.Parameter(approximate=1.2, exact=1.2, unit="kWh/K"),
        },
        time_unit="h",
    )


def task(plant: fp.Plant, signals: Any = None, **changes: Any) -> fp.Problem:
    """Keep the room at 293 K, with a daily swing of one degree."""
    values = {
        "plant": plant,
        "reference": fp.Trajectory(lambda t: {"air": 293.0 + ca.sin(0.26 * t), "walls": 293.0 + 0 * t}),
        "start": {"air": 292.0, "walls": 292.5},
        "period": PERIOD,
        "duration": DURATION,
        "horizon": fp.Horizon(stages=12, step=2 * PERIOD),
        "cost": fp.Quadratic(states={"air": 1.0}, effort={"heat": 1e-3}),
        "signals": signals or {},
    }
    return fp.Problem(**{**values, **changes})


OUTSIDE = fp.outside(nominal=283.0, unit="K")
POINTS = [0.0, 6.0, 12.0, 18.0, 24.0, 30.0], [283.0, 276.0, 274.0, 281.0, 285.0, 279.0]
NIGHT = lambda t: ca.pw_lin(t, *POINTS)  # noqa: E731
RHC = fp.RecedingHorizon(fp.FixedPointSolver(iterations=4, tolerance=1e-6))
CTC = fp.ComputedTorque(fp.Exponential(rate=0.6))
CONTROLLERS = {
    "CTC": CTC,
    "CTC+FPI": CTC.with_deformation(fp.Affine(gain=-0.5)),
    "CTC+model-referenced": CTC.with_deformation(fp.ModelReferenced(fp.Affine(gain=-0.5))),
    "RHC": RHC,
    "RHC+FPI": RHC.with_deformation(fp.Affine(gain=-0.5)),
}


def run(problem: fp.Problem, controller: Any, **more: Any) -> fp.Run:
    """One run in CasADi's virtual machine."""
    return fp.simulate(problem, controller, seed=1, **{"compiled": False, **more})


@pytest.mark.parametrize("name", CONTROLLERS)
@pytest.mark.parametrize(
    "course", [276.5, lambda t: 276.5 + 0 * t, fp.Samples([0.0], [276.5])], ids=("number", "formula", "samples")
)
def test_a_constant_signal_is_the_parameter_of_that_value(name, course):
    """The values enter at the parameter's place, so every signal of a run is the same number."""
    fixed = run(task(room(fp.Parameter(276.5, 276.5, "K"), wrong=1.3)), CONTROLLERS[name])
    signal = run(task(room(OUTSIDE, wrong=1.3), {"ambient": fp.Known(course)}), CONTROLLERS[name])
    for column in fixed.layout.columns:
        scale = 1 + np.abs(fixed[column]).max()
        assert np.abs(signal[column] - fixed[column]).max() <= 1e-13 * scale, column


@pytest.mark.parametrize("name", ["CTC+FPI", "CTC+model-referenced", "RHC+FPI"])
def test_the_compiled_loop_looks_values_up_as_the_virtual_machine_does(name):
    """Look-up of samples is generated C."""
    problem = task(room(OUTSIDE, wrong=1.3), {"ambient": fp.Known(fp.Samples(*POINTS))})
    slow, fast = run(problem, CONTROLLERS[name]), run(problem, CONTROLLERS[name], compiled=True)
    assert fast.compiled
    assert np.array_equal(fast["signals.ambient"], slow["signals.ambient"])
    assert fast["state.air"] == pytest.approx(slow["state.air"], abs=1e-9)


def test_the_plant_moves_as_an_independent_solver_says():
    """With the weather held over each cycle to the solver's accuracy; with the true weather up to the square of the period."""
    problem = task(room(OUTSIDE, wrong=1.3), {"ambient": fp.Known(NIGHT)}, integrator=fp.RungeKutta4(4))
    errors = {}
    for period in (PERIOD, PERIOD / 2):
        one = replace(problem, period=period)
        logged = run(one, CONTROLLERS["CTC+FPI"])
        assert logged["signals.ambient"] == pytest.approx(_weather(logged.time + period / 2), abs=1e-12)
        held = np.abs(
            _moved(logged, period, lambda t, start, half=period / 2: _weather(start + half)) - logged["state"]
        ).max()
        errors[period] = np.abs(_moved(logged, period, lambda t, start: _weather(t)) - logged["state"]).max()
        assert held < 1e-7
    assert errors[PERIOD] / errors[PERIOD / 2] == pytest.approx(4.0, rel=0.25)


def _weather(t):
    return np.interp(t, *POINTS)


def _moved(logged, period, ambient):
    """States by scipy under the logged commands."""
    states = [logged["state"][0]]
    for k, heat in enumerate(logged["command.heat"][:-1]):
        start = k * period

        def rate(t, x, heat=heat, start=start):
            outside = ambient(t, start)
            return [(0.3 * (outside - x[0]) + 0.5 * (x[1] - x[0]) + heat) / 1.2, 0.5 * (x[0] - x[1]) / 6.0]

        states.append(solve_ivp(rate, (start, start + period), states[-1], rtol=1e-11, atol=1e-11).y[:, -1])
    return np.array(states)


LATE: dict[str, tuple[dict[str, Any], fp.ModelReferenced]] = {
    "ideal": ({}, fp.ModelReferenced(fp.Affine(gain=-0.5))),
    "dead time": (
        {"dead_time": fp.DeadTime(inputs={"heat": 2 * PERIOD}, measurement=PERIOD)},
        fp.ModelReferenced(fp.Affine(gain=-0.3), cycles=2, measurement=1.0),
    ),
    "estimated": (
        {"sensing": fp.Sensing(estimator=fp.SavitzkyGolay(window=3, degree=2))},
        fp.ModelReferenced(fp.Affine(gain=-0.3)),
    ),
}


@pytest.mark.parametrize("name", LATE)
def test_a_right_model_with_known_weather_leaves_a_model_referenced_deformation_at_zero(name):
    """The model's response is that of the signals that acted, behind dead time and estimator too: adaptation changes nothing."""
    changes, deformation = LATE[name]
    problem = task(room(OUTSIDE), {"ambient": fp.Known(NIGHT)}, **changes)
    base = fp.Predicted(CTC, inputs=2 * PERIOD, measurement=PERIOD) if name == "dead time" else CTC
    without, adapted = run(problem, base), run(problem, base.with_deformation(deformation))
    assert np.abs(adapted["state"] - without["state"]).max() < 1e-9
    told_wrong = replace(problem, signals={"ambient": fp.Unknown(NIGHT)})
    assert np.abs(run(told_wrong, base.with_deformation(deformation))["state"] - without["state"]).max() > 1e-2


def test_who_is_told_what():
    """The log shows both; an exact model is told the truth."""
    plant = room(OUTSIDE, wrong=1.3)
    told = {"known": (fp.Known(NIGHT), _weather), "unknown": (fp.Unknown(NIGHT), lambda t: np.full(t.shape, 283.0))}
    for one, expected in told.values():
        logged = run(task(plant, {"ambient": one}), CTC)
        at = logged.time + PERIOD / 2
        assert logged["signals.ambient"] == pytest.approx(_weather(at), abs=1e-12)
        assert logged["signals_told.ambient"] == pytest.approx(expected(at), abs=1e-12)
    exact = run(task(plant, {"ambient": fp.Unknown(NIGHT)}), fp.ExactModel(CTC))
    right = run(task(room(OUTSIDE), {"ambient": fp.Known(NIGHT)}), CTC)
    assert np.array_equal(exact["signals_told"], exact["signals"])
    assert np.array_equal(exact["state"], right["state"])


def priced(cost: Any) -> fp.Problem:
    """The room with a price of heat, which is known ahead: ten times as high from 10 h to 14 h."""
    plant = room(fp.outside(276.5, "K"))
    plant = replace(plant, parameters={**plant.parameters, "price": fp.outside(0.2, "EUR/kWh")})
    steps = fp.Samples([0.0, 10.0, 14.0], [0.2, 2.0, 0.2])
    return task(plant, {"ambient": fp.Known(fp.Samples([0.0], [280.0])), "price": fp.Known(steps)}, cost=cost)


def test_a_cost_sees_signals_from_outside():
    """`view.outside.price` is that of the stage: heat is bought before it rises, and little while it is high."""
    prices: dict[str, Callable[[Any], Any]] = {"seen": lambda view: view.outside.price, "flat": lambda view: 0.2}
    controller, bought = fp.RecedingHorizon(fp.FixedPointSolver(iterations=20, tolerance=1e-3)), {}
    for name, price in prices.items():

        def terms(view, price=price):
            return {"comfort": (view.state.air - 293.0) ** 2, "heat": 0.05 * price(view) * view.input.heat**2}

        logged = run(priced(fp.CustomCost(terms)), controller)
        time, heat = logged["time"].ravel(), logged["command.heat"].ravel()
        bought[name] = [heat[(time >= a) & (time < b)].mean() for a, b in ((7.0, 10.0), (10.0, 14.0))]
    assert bought["seen"][0] > 1.05 * bought["flat"][0]
    assert bought["seen"][1] < 0.9 * bought["flat"][1]


BAD = {
    "no values": (lambda: task(room(OUTSIDE)), r"'ambient' \[K\] has no values"),
    "too late": (lambda: known(fp.Samples([2.0], [1.0])), "stated from 2 on, and the run begins at 0"),
    "unknown name": (lambda: known(1.0, ambiant=fp.Known(1.0)), "'ambiant' is unknown.*'ambient'"),
    "a parameter": (lambda: known(1.0, loss=fp.Known(1.0)), "'loss' is a parameter; declare it as outside"),
    "not finite": (lambda: known(lambda t: ca.sqrt(t - 15)), "not finite at t = 0"),
    "raises": (lambda: known(lambda t: t / (1 // 0)), "ZeroDivisionError"),
    "a vector": (lambda: known(lambda t: ca.vertcat(t, t)), "one scalar"),
    "sizes": (lambda: fp.Samples([0.0, 1.0], [1.0]), "one value per time"),
    "no sample": (lambda: fp.Samples([], []), "at least 1"),
    "order": (lambda: fp.Samples([0.0, 0.0], [1.0, 2.0]), "must increase"),
    "no number": (lambda: fp.Samples([0.0], [np.nan]), "expected a number"),
    "in a cost": (
        lambda: priced(fp.CustomCost(lambda view: {"heat": view.outside.prize * view.input.heat**2})),
        r"signal from outside 'prize' is unknown\. Did you mean 'price'\?",
    ),
    "a parameter in a cost": (
        lambda: priced(fp.CustomCost(lambda view: {"heat": view.outside.loss * view.input.heat**2})),
        "signal from outside 'loss' is unknown",
    ),
}


def known(course: Any, **more: Any) -> fp.Problem:
    return task(room(OUTSIDE), {"ambient": fp.Known(course), **more})


@pytest.mark.parametrize("name", BAD)
def test_a_problem_says_what_is_wrong_with_its_signals(name):
    make, text = BAD[name]
    with pytest.raises(fp.FpirhcError, match=text):
        make()


# Beside outputs: allowed where no output needs a derivative of a signal that nobody states


@pytest.mark.parametrize("course", [lambda t: 280 + ca.sin(t), lambda t: ca.pw_lin(t, [0.0, 300.0], [280.0, 285.0])])
def test_an_output_whose_derivative_has_that_of_a_smooth_signal_is_refused(course: Any) -> None:
    difference = replace(room(OUTSIDE), outputs={"d": fp.Output("K", lambda q, p: q.air - p.ambient)}, controlled=None)
    problem, track = known(280.0), fp.Trajectory(lambda t: {"d": 13 - 3 * ca.exp(-t / 50)})
    changes: dict[str, Any] = {"plant": difference, "reference": track, "horizon": None, "cost": None}
    for signal in (fp.Known(course), fp.Unknown(course)):
        with pytest.raises(fp.FpirhcError, match=r"signals: .* depend on ambient, .* state it in steps, Samples\("):
            replace(problem, **changes, signals={"ambient": signal})


RATES = {"valve": 0.1, "drain": 0.05}  # 1/s
TIMES = np.arange(0.0, 120.0, 0.5)
INFLOW = 0.3 * np.sin(TIMES / 9) + (TIMES > 40)


def lower_level(signal: Any) -> fp.Problem:
    """h1' = u - valve h1, h2' = valve h1 - drain h2 + w; the level h2 is the output, and w is in its first derivative."""
    plant = fp.Plant.of_states(
        states={"h1": "cm", "h2": "cm"},
        inputs={"u": "cm/s"},
        rates=lambda x, u, p: {"h1": u.u - p.valve * x.h1, "h2": p.valve * x.h1 - p.drain * x.h2 + p.w},
        outputs={"level": fp.Output("cm", lambda x, p: x.h2)},
        parameters={
            **{name: fp.Parameter(value, value, "1/s") for name, value in RATES.items()},
            "w": fp.outside(nominal=0.0, unit="cm/s"),
        },
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"level": 10 + 2 * ca.tanh((t - 60) / 15)}),
        start={"h1": 4.0, "h2": 8.0},
        period=0.5,
        duration=100.0,
        integrator=fp.RungeKutta4(substeps=8),
        signals={"w": signal},
        measure_from=10.0,
    )


@pytest.mark.parametrize("told", [True, False])
def test_a_signal_held_between_its_samples_may_be_in_the_derivative_of_an_output(told: bool) -> None:
    """The motion is that of the matrix exponential, and the command the inverse by hand: y'' = valve h1' - drain y'."""
    samples = fp.Samples(TIMES, INFLOW)
    problem = lower_level(fp.Known(samples) if told else fp.Unknown(samples))
    logged = run(problem, fp.ComputedTorque(fp.Exponential(rate=0.3)))
    valve, drain, cycles = RATES["valve"], RATES["drain"], logged.cycles
    rates = np.array([[-valve, 0, 1, 0], [valve, -drain, 0, 1], [0, 0, 0, 0], [0, 0, 0, 0]])
    step = expm(0.5 * rates)
    command, inflow = logged["command"][:, 0], INFLOW[:cycles]
    state = np.column_stack([logged["state.h1"], logged["state.h2"]])
    expected = np.column_stack([state, command, inflow]) @ step.T
    assert state[1:] == pytest.approx(expected[:-1, :2], abs=1e-9)
    model = inflow if told else 0.0 * inflow
    slope = valve * state[:, 0] - drain * state[:, 1] + model
    wanted = (logged["desired.level"] + drain * slope) / valve + valve * state[:, 0]
    assert command == pytest.approx(wanted, abs=1e-9)
