"""A quadrotor with 17 states that takes motor speeds, and the attitude loop that flies it with parameters which it believes.

State: position, velocity (world), quaternion (i, j, k, w), body rates, rotor speeds. Equations: RotorPy's multirotor (Folk, Paulos,
Kumar, arXiv 2306.04485), with the rotor efficiencies, forces, torques and payloads of AdaptiveQuadBench.
"""

import math

import casadi as ca
import numpy as np

import fpirhc as fp

GRAVITY, PERIOD = 9.81, 1e-2  # m/s^2, s
FASTEST, TURN = 1000.0, (1.0, -1.0, 1.0, -1.0)  # rad/s; sense of each rotor
BENCHMARK = {  # quad_param/quadrotor.py of the benchmark; its drag of the frame is never active there
    "mass": 0.826,
    "Ixx": 0.0047,
    "Iyy": 0.005,
    "Izz": 0.0074,
    "arm_length": 0.166,
    "k_eta": 7.64e-6,
    "k_m": 7.64e-6 * 0.014,
    "k_d": 1.19e-4,
    "k_z": 2.32e-4,
    "tau_m": 0.005,
}
MOTOR_NOISE = 50.0  # rad/s, drawn after every cycle
NOISE = {"position": 5e-3, "velocity": 0.05, "attitude": 0.01, "rate": 0.05}  # of the regime 'noise', SI
PROPORTIONAL, DERIVATIVE = 544.0, 46.64  # of the attitude loop, 1/s^2 and 1/s
_SIDES = ((1, 1), (1, -1), (-1, -1), (-1, 1))  # of the rotors, x and y
_NONE = np.zeros(3)


def rotors(told):
    """Places of the four rotors, m, shape (4, 3)."""
    return told["arm_length"] * math.sqrt(0.5) * np.array([(x, y, 0.0) for x, y in _SIDES])


def turned(q):
    """Rotation matrix of a quaternion that need not have the length one."""
    i, j, k, r = q[0], q[1], q[2], q[3]
    rows = (
        (1 - 2 * (j * j + k * k), 2 * (i * j - k * r), 2 * (i * k + j * r)),
        (2 * (i * j + k * r), 1 - 2 * (i * i + k * k), 2 * (j * k - i * r)),
        (2 * (i * k - j * r), 2 * (j * k + i * r), 1 - 2 * (i * i + j * j)),
    )
    matrix = ca.vertcat(*(ca.horzcat(*row) for row in rows))
    return (matrix - ca.SX.eye(3)) / ca.sumsqr(q) + ca.SX.eye(3)


def derivative(told):
    """Function (state 17, commanded speeds 4, efficiency 4, wind, force, torque, mass, centre, inertia 3x3) -> rate."""
    s, speeds, efficiency = (ca.SX.sym(name, size) for name, size in (("s", 17), ("speeds", 4), ("efficiency", 4)))
    wind, force, torque, centre = (ca.SX.sym(name, 3) for name in ("wind", "force", "torque", "centre"))
    mass, inertia = ca.SX.sym("mass"), ca.SX.sym("inertia", 3, 3)
    v, q, w, rotor = s[3:6], s[6:10], s[10:13], s[13:17]
    into_world, pull, moment = turned(q), ca.SX.zeros(3), ca.SX.zeros(3)
    air = into_world.T @ (v - wind)
    for n, place in enumerate(rotors(told)):
        at = ca.DM(place) - centre
        local, square = air + ca.cross(w, at), efficiency[n] * rotor[n] ** 2
        drag = -rotor[n] * ca.vertcat(told["k_d"] * local[0], told["k_d"] * local[1], told["k_z"] * local[2])
        pull_n = drag + ca.vertcat(0, 0, told["k_eta"] * square)
        pull, moment = pull + pull_n, moment + ca.cross(at, pull_n) + ca.vertcat(0, 0, TURN[n] * told["k_m"] * square)
    i, j, k, r = q[0], q[1], q[2], q[3]
    spin = 0.5 * ca.vertcat(
        r * w[0] - k * w[1] + j * w[2],
        k * w[0] + r * w[1] - i * w[2],
        -j * w[0] + i * w[1] + r * w[2],
        -i * w[0] - j * w[1] - k * w[2],
    )
    rate = ca.vertcat(
        v,
        (into_world @ pull + force) / mass - ca.vertcat(0, 0, GRAVITY),
        spin - (ca.sumsqr(q) - 1) * 2 * q,
        ca.solve(inertia, moment + torque - ca.cross(w, inertia @ w)),
        (speeds - rotor) / told["tau_m"],
    )
    return ca.Function("rate", [s, speeds, efficiency, wind, force, torque, mass, centre, inertia], [rate])


def cycle(told, steps=10):
    """Function as `derivative` -> the state one period later: Runge-Kutta of order 4."""
    rate = derivative(told)
    symbols = [ca.SX.sym(rate.name_in(k), rate.sparsity_in(k)) for k in range(rate.n_in())]
    state, rest, h = symbols[0], symbols[1:], PERIOD / steps
    for _ in range(steps):
        a = rate(state, *rest)
        b = rate(state + h / 2 * a, *rest)
        c = rate(state + h / 2 * b, *rest)
        state = state + h / 6 * (a + 2 * b + 2 * c + rate(state + h * c, *rest))
    return ca.Function("cycle", symbols, [state])


def attitude_error():
    """Function (thrust per mass in the world, quaternion) -> (error of the attitude (3), thrust along the body's axis), yaw 0."""
    thrust, q = ca.SX.sym("thrust", 3), ca.SX.sym("q", 4)
    body = turned(q)
    up = thrust / ca.norm_2(thrust)
    left = ca.cross(up, ca.vertcat(1, 0, 0))
    left = left / ca.norm_2(left)
    wanted = ca.horzcat(ca.cross(left, up), left, up)
    skew = 0.5 * (wanted.T @ body - body.T @ wanted)
    return ca.Function(
        "attitude", [thrust, q], [ca.vertcat(-skew[1, 2], skew[0, 2], -skew[0, 1]), ca.dot(thrust, body[:, 2])]
    )


def allocation(told):
    """Matrix from the squares of the rotor speeds to thrust, N, and moments, N m."""
    places = rotors(told)
    ones, turn = np.ones(4), told["k_m"] / told["k_eta"] * np.array(TURN)
    return told["k_eta"] * np.vstack([ones, places[:, 1], -places[:, 0], turn])


RATE = derivative(BENCHMARK)
ATTITUDE = attitude_error()
_CYCLE = cycle(BENCHMARK)


def rate_controller(gain):
    """Return a stepper for the body's rates, w' = request, with an iteration of its own; the state is w + (544 / 46.64) error.

    Computed torque asks for w' = -46.64 (w + 544 / 46.64 error), which is the attitude loop; the model-referenced form adds
    what torques, offsets of a payload and weak rotors take away.
    """
    axes = ("roll", "pitch", "yaw")
    plant = fp.Plant(
        coordinates=dict.fromkeys(axes, "rad/s"),
        inputs={f"to_{n}": "rad/s^2" for n in axes},
        parameters={"one": fp.Parameter(approximate=1.0, exact=1.0, unit="1")},
        response=lambda _q, u, p: {n: p.one * u[f"to_{n}"] for n in axes},
        order=1,
    )
    problem = fp.Problem(
        plant=plant,
        reference=fp.Trajectory(lambda t: dict.fromkeys(axes, 0 * t)),
        start=dict.fromkeys(axes, 0.0),
        period=PERIOD,
        duration=5.0,
        limits=fp.Limits(inputs={f"to_{n}": (-400.0, 400.0) for n in axes}),
    )
    form = fp.ModelReferenced(fp.Affine(gain=-gain)) if gain else fp.Identity()
    law = fp.ComputedTorque(fp.Exponential(rate=DERIVATIVE, integral=False), form)
    return fp.Stepper(problem, law, compiled=False, saturated_after=1e6)


class Vehicle:
    """The vehicle under its own attitude loop: `reset(seed)`, `step(time, thrust per mass in the world)`.

    Args:
        told: numbers of the trial by name, as in `draws.NUMBERS`.
        first: position and velocity at the start.
        speed: of the rotors at the start, rad/s.
        fault: (time, efficiencies) from a time on.
    """

    def __init__(self, told, first=(0.0,) * 6, speed=0.0, fault=None):
        self.told, self.first, self.speed, self.fault = told, np.array(first), speed, fault
        self.believed = {name: value * told.get(f"believed_{name}", 1.0) for name, value in BENCHMARK.items()}
        self.to_squares = np.linalg.inv(allocation(self.believed))
        self.inertia_believed = np.array([self.believed[name] for name in ("Ixx", "Iyy", "Izz")])
        self.efficiency = np.array([told[f"efficiency_{n}"] for n in range(1, 5)])
        self.switches = sorted(told[f"switch_{n}"] for n in range(1, 5) if told[f"switch_{n}"] > 0)
        self.rates = _steppers(told["moment_gain"])
        self.alone, self.with_load = self.bare(), self.loaded()

    def vector(self, name):
        """Three numbers of the trial."""
        return np.array([self.told[f"{name}_{axis}"] for axis in "xyz"])

    def reset(self, seed):
        """Go to the start."""
        self.random, self.sensed = np.random.default_rng([seed, 1]), np.random.default_rng([seed, 2])
        self.state = np.concatenate([self.first, [0, 0, 0, 1], _NONE, np.full(4, float(self.speed))])
        self.memory, self.rates_before = self.rates.start(), None
        self.gust, self.waiting, self.asked = _Gust(self.vector("gust")), [], []
        self.measured = self.measure()
        return self.measured[:6]

    def step(self, time, command):
        """Turn the thrust, fly for a cycle, and measure position and velocity."""
        self.asked.append(np.array(command))
        late = round(self.told["late_thrust"] / PERIOD)
        thrust = self.asked[max(0, len(self.asked) - 1 - late)]
        return self.fly(time, self.motor_speeds(time, thrust, self.measured[6:10], self.measured[10:13]))

    def motor_speeds(self, time, thrust, q, w):
        """Return what the attitude loop commands."""
        error, along = (np.asarray(one).ravel() for one in ATTITUDE(thrust, q))
        sliding = w + PROPORTIONAL / DERIVATIVE * error
        realised = _NONE if self.rates_before is None else (w - self.rates_before) / PERIOD
        self.rates_before = w
        asked, self.memory = self.rates.step(time, sliding, realised, self.memory)
        return self.allocated(self.believed["mass"] * along[0], asked, w)

    def allocated(self, pull, asked, w):
        """Return the speeds for a thrust, N, and angular accelerations, by the believed inertia."""
        moments = self.inertia_believed * asked + _cross(w, self.inertia_believed * w)
        squares = self.to_squares @ np.concatenate([[pull], moments])
        return np.sign(squares) * np.sqrt(np.abs(squares))

    def fly(self, time, speeds):
        """Hold motor speeds for a cycle and return the measured position and velocity."""
        self.waiting.append(np.clip(speeds, 0.0, FASTEST))
        late = round(self.told["late_motors"] / PERIOD)
        speeds = self.waiting[max(0, len(self.waiting) - 1 - late)]
        on = sum(time + PERIOD >= at for at in self.switches) % 2 == 1 or not self.switches
        force, torque = (float(on) * self.vector(name) for name in ("force", "torque"))
        mass, centre, inertia, extra = self.with_load if on else self.alone
        wind = self.vector("wind") + self.gust.next(self.random)
        faulty = self.fault is not None and time >= self.fault[0]
        efficiency = self.efficiency * (self.fault[1] if faulty else 1.0)
        self.acted = self.state, speeds, efficiency, wind, force, torque + extra, mass, centre, inertia
        self.state = np.asarray(_CYCLE(*self.acted)).ravel()
        self.state[6:10] /= np.linalg.norm(self.state[6:10])
        self.state[13:] = np.clip(self.state[13:] + self.random.normal(0, MOTOR_NOISE, 4), 0.0, FASTEST)
        self.measured = self.measure()
        return self.measured[:6]

    def bare(self):
        """Mass, centre, inertia of the vehicle alone, and no torque."""
        return BENCHMARK["mass"], _NONE, np.diag([BENCHMARK[name] for name in ("Ixx", "Iyy", "Izz")]), _NONE

    def loaded(self):
        """The same with the payload, as the benchmark attaches it: its torque stands beside the centre that it moves."""
        own, _, inertia, _ = self.bare()
        load, place = self.told["payload"] * own, BENCHMARK["arm_length"] * self.vector("offset")
        centre = load * place / (own + load)
        arm = place - centre
        # The sign of the first term is the benchmark's; the parallel-axis theorem has the other one.
        inertia = inertia - own * _spread(centre) + load * _spread(arm)
        return own + load, centre, inertia, _cross(arm, [0.0, 0.0, -load * GRAVITY])

    def measure(self):
        """Return the state with the regime's noise."""
        scale, random, shown = self.told["noise"], self.sensed, self.state.copy()
        if scale:
            for at, name in ((0, "position"), (3, "velocity"), (10, "rate")):
                shown[at : at + 3] += random.normal(0, scale * NOISE[name], 3)
            shown[6:10] = _product(shown[6:10], np.append(random.normal(0, scale * NOISE["attitude"], 3) / 2, 1.0))
            shown[6:10] /= np.linalg.norm(shown[6:10])
        return shown


class _Gust:
    """Dryden's filters as RotorPy has them (airspeed 1 m/s, altitude 2 m), driven by uniform noise; a sum per axis."""

    def __init__(self, intensity):
        feet = 3.281 * 2.0
        across = feet / (0.177 + 0.000823 * feet) ** 1.2 / 3.281
        lengths = np.array([across, across, 2.0])
        rise, lag = intensity * np.sqrt(2 * lengths / math.pi), 2 * lengths
        slope, double, square = (
            rise * 2 * math.sqrt(3) * lengths * 2 / PERIOD,
            4 * lag / PERIOD,
            (2 * lag / PERIOD) ** 2,
        )
        self.fed, self.back = (rise + slope, 2 * rise, rise - slope), (1 + double, 2 - 2 * square, 1 - double)
        self.back = tuple(one + add for one, add in zip(self.back, (square, 0, square), strict=True))
        self.inputs, self.outputs = [_NONE, _NONE], [_NONE, _NONE]
        self.still = not intensity.any()

    def next(self, random):
        """Return the velocity of the gust, m/s, one cycle later."""
        if self.still:
            return _NONE
        new = random.uniform(-1, 1, 3)
        fed = self.fed[0] * new + self.fed[1] * self.inputs[0] + self.fed[2] * self.inputs[1]
        out = (fed - self.back[1] * self.outputs[0] - self.back[2] * self.outputs[1]) / self.back[0]
        self.inputs, self.outputs = [new, self.inputs[0]], [out, self.outputs[0]]
        return out


def _cross(a, b):
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _spread(place):
    return place @ place * np.eye(3) - np.outer(place, place)


def _product(a, b):
    """Product of two quaternions (i, j, k, w)."""
    return np.append(a[3] * b[:3] + b[3] * a[:3] + _cross(a, b), a[3] * b[3] - a[:3] @ b[:3])


_BUILT = {}


def _steppers(gain):
    if gain not in _BUILT:
        _BUILT[gain] = rate_controller(gain)
    return _BUILT[gain]
