"""Small plants of which a review is asked, and the answers about a mass whose model is too heavy, by their keys."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi as ca

import fpirhc as fp
from fpirhc.contracts import Controller
from helpers.plants import heavy

PERIOD = 1e-3  # s


def mass(**settings) -> fp.Problem:
    """M q'' = u - k q, the model's mass 1.5 times too large."""
    sine = fp.Trajectory(lambda t: {"q": 0.5 * ca.sin(3 * t)})
    usual: dict[str, Any] = {"reference": sine, "start": {"q": 0.0}, "period": PERIOD, "duration": 4.0}
    return fp.Problem(**({"plant": heavy(1.5, 1.0, (6.0, 10.0))} | usual | settings))


def torque(gain: float = -0.5, rate: float = 6.0, scale: float = 20.0) -> fp.ComputedTorque:
    return fp.ComputedTorque(fp.Exponential(rate=rate), fp.Sigmoid(gain=gain, scale=scale))


def answers(problem: fp.Problem, controller: Controller | None = None, mismatch: float = 0.0) -> dict[str, Any]:
    """All answers about the problem and one controller."""
    found = fp.review(problem, {"it": controller or torque()}, mismatch=mismatch, seed=0).answers
    return {a.key: a for some in found.values() for a in some}


# Plants on which answers of a theory were false


def cart(limits: fp.Limits, reference: Any, exact: float, **settings: Any) -> fp.Problem:
    """M x'' = F, the model's mass 1 kg."""
    mass = {"mass": fp.Parameter(1.0, exact, "kg")}
    plant = fp.Plant({"x": "m"}, {"F": "N"}, mass, lambda q, v, u, p: {"x": u.F / p.mass})
    return fp.Problem(plant, fp.Trajectory(reference), period=1e-2, limits=limits, **settings)


def plans(*, iterations: int | None = 5, tolerance: float | None = 1e-3, gain: float = -0.8) -> dict[str, Any]:
    optimiser = fp.FixedPointSolver(iterations=iterations, tolerance=tolerance)
    adapted = fp.RecedingHorizon(optimiser, fp.ModelReferenced(fp.Affine(gain=gain)))
    return {"RHC": fp.RecedingHorizon(optimiser), "RHC+FPI": adapted}


def slow_room() -> fp.Problem:
    """Heating costs so much that a room comes back with its own 200 s, of which 1000 cycles of .1 s show half."""
    loss = fp.Parameter(5e-3, 5e-3, "1/s")
    room = fp.Plant({"T": "K"}, {"u": "K/s"}, {"loss": loss}, lambda q, u, p: {"T": u.u - p.loss * q["T"]}, order=1)
    path = fp.Trajectory(lambda t: {"T": 1.0 + 0.1 * ca.sin(t / 50)})
    plan = {"horizon": fp.Horizon(5, 0.1), "cost": fp.Quadratic({"T": 1e-6}, deviation={"u": 1.0})}
    return fp.Problem(room, path, {"T": 0.9}, period=0.1, duration=400.0, measure_from=100.0, **plan)


def heater() -> fp.Problem:
    """It heats a room with 0 to 20 K/s, and its reference asks for a +- sqrt(a^2 + 4), of the model and of the plant."""
    lost = {"a": fp.Parameter(1.0, 1.2, "1/s")}
    room = fp.Plant({"T": "K"}, {"u": "K/s"}, lost, lambda x, u, p: {"T": u.u - p.a * x.T}, order=1)
    wave, ends = fp.Trajectory(lambda t: {"T": 1 + ca.sin(2 * t)}), fp.Limits({"u": (0.0, 20.0)})
    return fp.Problem(room, wave, {"T": 1.0}, period=0.01, duration=10.0, limits=ends)


def limited_rate() -> fp.Problem:
    """A force that may change by 20 N/s: an own loop with such an actuator has .637 m without adaptation, and metres with it."""
    return cart(
        fp.Limits(inputs={"F": (-20.0, 20.0)}, rates={"F": (-20.0, 20.0)}),
        lambda t: {"x": 1 - ca.cos(2 * t)},
        2.0,
        **{"start": {"x": 0.5}, "duration": 6.0, "measure_from": 2.0},
        horizon=fp.Horizon(stages=20, step=0.05),
        cost=fp.Quadratic(states={"x": 100.0, "x'": 1.0}, rate={"F": 1e-3}),
    )


def turntable(reference: Callable[[Any], Any]) -> fp.Problem:
    """It follows a bearing that turns on with 1 rad/s."""
    known = {"inertia": fp.Parameter(0.3, 0.4, "kg m^2"), "friction": fp.Parameter(0.05, 0.1, "N m s")}
    turns = lambda q, v, u, p: {"yaw": (u.torque - p.friction * v.yaw) / p.inertia}  # noqa: E731
    return fp.Problem(
        fp.Plant({"yaw": "rad"}, {"torque": "N m"}, known, turns),
        fp.Trajectory(lambda t: {"yaw": reference(t)}),
        {"yaw": 0.0, "yaw'": 1.0},
        **{"period": 5e-3, "duration": 8.0, "measure_from": 1.0, "limits": fp.Limits({"torque": (-3.0, 3.0)})},
        horizon=fp.Horizon(stages=20, step=2e-2),
        cost=fp.Quadratic(states={"yaw": 100.0, "yaw'": 1.0}, deviation={"torque": 1e-2}),
    )


def ball(start: float) -> fp.Problem:
    """A ball under a magnet of which the current is commanded."""
    falls = lambda q, v, u, p: {"gap": 9.81 - p.inductance / (2 * 0.06) * (u.current / q.gap) ** 2}  # noqa: E731
    return fp.Problem(
        fp.Plant({"gap": "m"}, {"current": "A"}, {"inductance": fp.Parameter(2.0e-4, 1.4e-4, "H m")}, falls),
        fp.Trajectory(lambda t: {"gap": 0.009 + 0 * t}),
        {"gap": start},
        **{"period": 1e-3, "duration": 1.0, "measure_from": 0.5, "limits": fp.Limits({"current": (0.0, 3.0)})},
        horizon=fp.Horizon(stages=40, step=1e-2),
        cost=fp.Quadratic(states={"gap": 1e6, "gap'": 1e2}, deviation={"current": 1.0}),
    )


def biased(size: float) -> fp.Problem:
    """A mass along a slow sine, whose measured acceleration has a bias of the sensor."""
    sensing = fp.Sensing({"x''": fp.Sensor(noise=fp.Step(at=0.0, size=size))}) if size else fp.Sensing()
    return cart(
        fp.Limits(inputs={"F": (-20.0, 20.0)}),
        lambda t: {"x": 0.5 * ca.sin(2 * t)},
        1.2,
        **{"start": {"x": 0.0, "x'": 1.0}, "duration": 6.0, "measure_from": 2.0, "sensing": sensing},
        horizon=fp.Horizon(stages=20, step=0.05),
        cost=fp.Quadratic(states={"x": 100.0, "x'": 1.0}, deviation={"F": 1e-3}),
    )


def servo() -> fp.Problem:
    """A load on a flexible shaft is controlled (Bemporad and Mosca, Automatica 34(4), 1998): the model's is half as heavy."""

    def rates(x: Any, u: Any, p: Any) -> dict[str, Any]:
        twist = x.load - x.motor / 20.0
        turned = (1280.2 / 20.0 * twist - 5.1 * x.turn + 0.5 * u.V) / 0.5
        return {
            "load": x.swing,
            "swing": (-1280.2 * twist - p.friction * x.swing) / p.inertia,
            "motor": x.turn,
            "turn": turned,
        }

    plant = fp.Plant.of_states(
        states={"load": "rad", "swing": "rad/s", "motor": "rad", "turn": "rad/s"},
        inputs={"V": "V"},
        rates=rates,
        outputs={"angle": fp.Output("rad", lambda x, p: x.load)},
        parameters={"inertia": fp.Parameter(12.5, 25.0, "kg m^2"), "friction": fp.Parameter(12.5, 25.0, "N m s/rad")},
    )
    return fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: {"angle": 0.5 * ca.sin(0.8 * t)}),
        start={"load": 0.0, "swing": 0.4, "motor": 0.0, "turn": 8.0},
        **{"period": 0.01, "duration": 10.0, "measure_from": 5.0},
        limits=fp.Limits(inputs={"V": (-220.0, 220.0)}),
        horizon=fp.Horizon(stages=20, step=0.1),
        cost=fp.Quadratic(outputs={"angle": 1e3, "angle'": 1.0}, rate={"V": 1e-4}),
    )


def lift() -> fp.Problem:
    """A hydraulic lift of 400 kg, whose map swings at gain -1 with plans every ten cycles: movement 827 where 20 are needed."""
    rates = lambda x, u, p: {  # noqa: E731
        "y": x.v,
        "v": (200 * x.bar - p.friction * x.v) / p.mass - 9.81,
        "bar": p.stiff * (u.flow - p.leak * x.bar - 120 * x.v),
    }
    off = {"mass": (400, 650), "friction": (500, 1500), "stiff": (20, 14), "leak": (0, 0.08)}
    parameters = {name: fp.Parameter(*both, "1") for name, both in off.items()}
    given = {"states": {"y": "m", "v": "m/s", "bar": "bar"}, "inputs": {"flow": "l/min"}, "parameters": parameters}
    return fp.Problem(
        fp.Plant.of_states(**given, rates=rates, outputs={"y": fp.Output("m", lambda x, p: x.y)}),
        fp.Trajectory(lambda t: {"y": 0.5 - 0.4 * ca.cos(0.8 * t)}),
        {"y": 0.1, "v": 0.0, "bar": 19.62},
        **{"period": 2e-3, "duration": 8.0, "measure_from": 2.0, "limits": fp.Limits(inputs={"flow": (-60.0, 60.0)})},
        horizon=fp.Horizon(stages=20, step=0.02),
        cost=fp.Quadratic(outputs={"y": 1e4}, rate={"flow": 1e-4}),
    )


def tank() -> fp.Problem:
    """A level behind a pump of 1.5 s of dead time, with a window of 7 s: no gain is better than none without a prediction."""
    both = {"c": fp.Parameter(2e-3, 4e-3, "m^2.5/s"), "area": fp.Parameter(0.5, 0.35, "m^2")}
    level = lambda q, u, p: {"h": (1e-3 * u.pump - p.c * ca.sqrt(q.h)) / p.area}  # noqa: E731
    return fp.Problem(
        fp.Plant({"h": "m"}, {"pump": "l/s"}, both, level, order=1),
        fp.Trajectory(lambda t: {"h": 1 + 0.3 * ca.sin(0.05 * t)}),
        {"h": 0.8},
        **{"period": 0.5, "duration": 300.0, "measure_from": 60.0, "limits": fp.Limits(inputs={"pump": (0.0, 25.0)})},
        sensing=fp.Sensing({"h": fp.Sensor(noise=fp.Noise(1e-3))}, fp.SavitzkyGolay(window=15, degree=1)),
        **{"dead_time": fp.DeadTime(inputs={"pump": 1.5}), "horizon": fp.Horizon(stages=20, step=1.0)},
        cost=fp.Quadratic(states={"h": 1e4}, deviation={"pump": 1e-2}),
    )


def motor(stronger: float = 2.86, **settings: Any) -> fp.Problem:
    """A motor whose plant answers so many times as strongly as its model."""
    gain = fp.Parameter(3.5, 3.5 * stronger, "rad/s^2/V")
    plant = fp.Plant({"q": "rad"}, {"V": "V"}, {"gain": gain}, lambda q, v, u, p: {"q": p.gain * u.V - 2 * v.q})
    usual: dict[str, Any] = {"period": 2e-3, "duration": 4.0, "measure_from": 1.0}
    usual |= {"limits": fp.Limits(inputs={"V": (-12.0, 12.0)}), "start": {"q": 0.0, "q'": 2.0}}
    return fp.Problem(plant, fp.Trajectory(lambda t: {"q": ca.sin(2 * t)}), **(usual | settings))


def law(gain: float, rate: float = 8.0) -> fp.ComputedTorque:
    return fp.ComputedTorque(fp.Exponential(rate), fp.ModelReferenced(fp.Sigmoid(gain)))


def behind_an_actuator(lag: float) -> fp.Problem:
    """A motor on whose actuator the model's torque acts at once."""
    response = lambda q, v, u, p: {"q": 5.6 * q.act - 4 * v.q, "act": (u.V - q.act) / lag}  # noqa: E731
    real = fp.Plant({"q": "rad", "act": "V"}, {"V": "V"}, {}, response, order={"q": 2, "act": 1})
    return motor(1.0, period=5e-3, duration=6.0, reality=fp.Reality(real, start={"act": 0.0}))


NOISY = fp.Sensing({"q": fp.Sensor(noise=fp.Noise(3e-5))}, fp.SavitzkyGolay(window=21, degree=2))


def heated(limits: fp.Limits, swing: float = 1.0) -> fp.Problem:
    """A room that needs 0.9 to 3.7 K/s, or with another swing more."""
    wave = fp.Trajectory(lambda t: {"T": 2 + swing * ca.sin(0.5 * t)})
    return replace(heater(), reference=wave, start={"T": 2.0}, duration=20.0, measure_from=3.0, limits=limits)


def pushed_away(force: float, **settings: Any) -> fp.Problem:
    """A mass that a spring pushes away, which at most this force holds."""
    known = {name: fp.Parameter(value, value, "1") for name, value in (("k", 4.0), ("b", 1.0))}
    plant = fp.Plant({"q": "m"}, {"u": "N"}, known, lambda q, v, u, p: {"q": p.k * q.q + p.b * u.u})
    wave, ends = fp.Trajectory(lambda t: {"q": 0.05 * ca.sin(t)}), fp.Limits(inputs={"u": (-force, force)})
    return fp.Problem(plant, wave, {"q": 0.0, "q'": 0.05}, period=1e-2, duration=10.0, limits=ends, **settings)
