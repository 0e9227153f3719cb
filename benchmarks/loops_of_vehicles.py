"""Closed loops of vehicles, and of a chain at a wall, with limits of states; see `loops_of_processes.py`."""

from __future__ import annotations

import casadi as ca
from foreign import Foreign, known

import fpirhc as fp


def race_car() -> Foreign:
    """Model race car between the borders of its track (acados, examples/race_cars; D. Kloeser et al., IFAC 53(2), 2020).

    Position along the track, distance from its middle, heading, speed, duty cycle, steering; half width, accelerations, duty and
    steering are limited as there. The track winds like a sine, and the car is heavier and has less grip than the wrong model.
    """

    def force(q, p):
        return (0.28 - 0.05 * q.v) * q.duty - p.drag * q.v**2 - 0.011 * ca.tanh(5 * q.v)

    def across(view):
        q, p = view.state, view.parameters
        return p.grip * q.v**2 * q.steer + force(q, p) * ca.sin(0.5 * q.steer) / p.m

    def response(q, u, p):
        slip, curvature = 0.5 * q.steer, 2.2 * ca.sin(1.4 * q.s)
        along = q.v * ca.cos(q.heading + slip) / (1 - curvature * q.n)
        return {
            "s": along,
            "n": q.v * ca.sin(q.heading + slip),
            "heading": q.v * p.grip * q.steer - curvature * along,
            "v": force(q, p) / p.m * ca.cos(slip),
            "duty": 10 * u.throttling,
            "steer": 2 * u.turning,
        }

    return Foreign(
        fp.Plant(
            coordinates={"s": "m", "n": "m", "heading": "rad", "v": "m/s", "duty": "1", "steer": "rad"},
            inputs={"throttling": "10/s", "turning": "2 rad/s"},
            controlled=("duty", "steer"),
            order=1,
            response=response,
            parameters=known(m=(0.043, 0.047, "kg"), drag=(0.006, 0.008, "kg/m"), grip=(15.5, 14.5, "1/m")),
        ),
        {"s": 0.0, "v": 0.8},
        fp.Trajectory(
            lambda t: {"s": 1.6 * t, "n": 0 * t, "heading": 0 * t, "v": 1.6 + 0 * t, "duty": 0 * t, "steer": 0 * t}
        ),
        fp.Horizon(stages=30, step=0.04),
        fp.Quadratic(
            states={"s": 1.0, "n": 0.1, "heading": 0.01, "v": 0.1, "duty": 1e-3, "steer": 5e-3},
            effort={"throttling": 1e-2, "turning": 1e-2},
        ),
        fp.Limits(
            inputs={"throttling": (-1.0, 1.0), "turning": (-1.0, 1.0)},
            states={"n": (-0.12, 0.12), "duty": (-1.0, 1.0), "steer": (-0.4, 0.4)},
            paths={
                "across": fp.PathConstraint(across, -4.0, 4.0, "m/s^2"),
                "along": fp.PathConstraint(lambda v: force(v.state, v.parameters) / v.parameters.m, -4.0, 4.0, "m/s^2"),
            },
        ),
    )


def bicycle_past_a_gap() -> Foreign:
    """Kinematic bicycle (J. Kong et al., IEEE IV 2015) through a gap between two round obstacles, beside its path."""

    def response(q, u, p):
        return {
            "x": q.v * ca.cos(q.psi),
            "y": q.v * ca.sin(q.psi),
            "psi": q.v / p.l * ca.tan(q.steer),
            "v": u.a - p.c * q.v,
            "steer": u.turn,
        }

    def obstacle(x, y, radius):
        return fp.PathConstraint(
            lambda v: ((v.state.x - x) ** 2 + (v.state.y - y) ** 2) / radius**2, 1.0, float("inf"), "1"
        )

    return Foreign(
        fp.Plant(
            coordinates={"x": "m", "y": "m", "psi": "rad", "v": "m/s", "steer": "rad"},
            inputs={"a": "m/s^2", "turn": "rad/s"},
            controlled=("v", "steer"),
            order=1,
            response=response,
            parameters=known(l=(2.5, 2.8, "m"), c=(0.0, 0.03, "1/s")),
        ),
        {"v": 5.0},
        fp.Trajectory(lambda t: {"x": 5 * t, "y": 0 * t, "psi": 0 * t, "v": 5 + 0 * t, "steer": 0 * t}),
        fp.Horizon(stages=30, step=0.08),
        fp.Quadratic(states={"x": 0.5, "y": 1.0, "psi": 1.0, "v": 0.5}, effort={"a": 0.1, "turn": 0.5}),
        fp.Limits(
            inputs={"a": (-4.0, 2.0), "turn": (-0.8, 0.8)},
            states={"y": (-2.5, 2.5), "v": (0.0, 6.0), "steer": (-0.5, 0.5)},
            paths={
                "low": obstacle(20.0, -0.8, 2.0),
                "high": obstacle(30.0, 3.5, 2.0),
                "second": obstacle(45.0, 0.9, 1.8),
                "third": obstacle(62.0, -1.2, 2.2),
            },
        ),
    )


def chain_at_a_wall() -> Foreign:
    """Chain of three masses behind a wall (acados, examples/chain_mass; L. Wirsching, H. G. Bock, M. Diehl, 2006).

    The shipped problem with a wall in y that the push before the run drives the chain to; limits of the masses' speeds.
    """
    p = fp.load_problem("chain_of_masses").problem
    assert p.horizon is not None
    assert p.cost is not None
    start = dict(zip(p.plant.state.elements, map(float, p.start_state), strict=True))
    limits = fp.Limits(inputs=p.limits.inputs, states={"y1": (-0.02, 5.0), "z1'": (-0.6, 0.6)})
    return Foreign(p.plant, start, p.reference, p.horizon, p.cost, limits)


def drone() -> Foreign:
    """Multirotor above ground with its attitude loops as lags (M. Kamel et al., in: Robot Operating System, vol. 2, 2017).

    Roll and pitch follow their commands with time constants; both angles and all speeds are limited.
    """

    def response(q, u, p):
        lift = 9.81 * (1 + u.thrust)
        return {
            "x": q.vx,
            "y": q.vy,
            "z": q.vz,
            "vx": lift * ca.sin(q.pitch) * ca.cos(q.roll) - p.drag * q.vx,
            "vy": -lift * ca.sin(q.roll) - p.drag * q.vy,
            "vz": lift * ca.cos(q.pitch) * ca.cos(q.roll) - 9.81,
            "roll": (p.gain * u.roll_wanted - q.roll) / 0.25,
            "pitch": (p.gain * u.pitch_wanted - q.pitch) / 0.25,
        }

    names = ("x", "y", "z", "vx", "vy", "vz", "roll", "pitch")
    units = dict(zip(names, ("m",) * 3 + ("m/s",) * 3 + ("rad",) * 2, strict=True))
    path = {
        "x": lambda t: 2 * ca.sin(0.8 * t),
        "y": lambda t: 2 * ca.sin(1.1 * t),
        "z": lambda t: 0.8 * ca.sin(0.6 * t),
    }
    return Foreign(
        fp.Plant(
            coordinates=units,
            inputs={"roll_wanted": "rad", "pitch_wanted": "rad", "thrust": "1"},
            controlled=("roll", "pitch", "vz"),
            order=1,
            response=response,
            parameters=known(drag=(0.0, 0.15, "1/s"), gain=(1.0, 0.9, "1")),
        ),
        {"x": 0.0},
        fp.Trajectory(lambda t: {n: path[n](t) if n in path else 0 * t for n in names}),
        fp.Horizon(stages=25, step=0.08),
        fp.Quadratic(
            states={"x": 10.0, "y": 10.0, "z": 10.0, "vx": 0.1, "vy": 0.1, "vz": 0.1},
            effort={"roll_wanted": 1.0, "pitch_wanted": 1.0, "thrust": 1.0},
        ),
        fp.Limits(
            inputs={"roll_wanted": (-0.5, 0.5), "pitch_wanted": (-0.5, 0.5), "thrust": (-0.5, 0.5)},
            states={"roll": (-0.2, 0.2), "pitch": (-0.2, 0.2), "vx": (-1.3, 1.3), "vy": (-1.4, 1.4), "vz": (-0.4, 0.4)},
        ),
    )


VEHICLES = (race_car, bicycle_past_a_gap, chain_at_a_wall, drone)
