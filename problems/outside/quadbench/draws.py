"""The trials of AdaptiveQuadBench: 20 of each family, drawn as `RandomizationConfig` of the benchmark draws them with its seed 42.

Source: github.com/Dz298/AdaptiveQuadBench (MIT), commit d4c2738, config/randomization_config.py. The order of the draws depends on
the number of trials.
"""

import numpy as np

TRIALS, SEED, LENGTH = 20, 42, 5.0  # s
FAMILIES = ("none", "wind", "force", "torque", "payload", "efficiency", "uncertainty")
_VECTORS = {"wind": "m/s", "gust": "m/s", "force": "N", "torque": "N m", "offset": "1"}
# What a controller believes wrongly in the family 'uncertainty', in the order of the draws; None: drawn and not used here.
_BELIEVED = ("mass", "Ixx", "Iyy", "Izz", "arm_length", None, None, None, None, "k_eta", "k_m", *[None] * 5)
NUMBERS = {  # name -> (value without disturbance, unit): the parameters of the vehicle
    **{f"{name}_{axis}": (0.0, unit) for name, unit in _VECTORS.items() for axis in "xyz"},
    **{f"efficiency_{n}": (1.0, "1") for n in range(1, 5)},
    **{f"switch_{n}": (0.0, "s") for n in range(1, 5)},
    **{f"believed_{name}": (1.0, "1") for name in _BELIEVED if name},
    "payload": (0.0, "1"),
    "noise": (0.0, "1"),
    "late_motors": (0.0, "s"),
    "late_thrust": (0.0, "s"),
    "moment_gain": (0.0, "1"),
}


def trials(family):
    """Return the numbers of the family's trials by name, and the goal of each: position, velocity, acceleration, shape (3, 3)."""
    random = np.random.RandomState(SEED)
    goals = [np.array([random.uniform(-2, 2, 3) for _ in range(3)]) for _ in range(TRIALS)]
    told = [_DRAWN[family](random) for _ in range(TRIALS)] if family in _DRAWN else [{} for _ in range(TRIALS)]
    if family in _SWITCHED:
        told = [one | _switches(random) for one in told]
    return told, goals


def _wind(random):
    speed, direction = random.uniform(0, 3), random.uniform(-1, 1, 3)
    mean = speed * direction / np.linalg.norm(direction)
    return _vector("wind", mean) | _vector("gust", random.uniform(30, 60, 3))


def _payload(random):
    return {"payload": random.uniform(0, 0.5)} | _vector("offset", random.uniform(-0.2, 0.2, 3))


def _efficiency(random):
    return {f"efficiency_{n}": 1 + add for n, add in enumerate(random.uniform(-0.3, 0.3, 4), 1)}


def _uncertainty(random):
    factors = [1 + random.uniform(-0.1, 0.1) for _ in _BELIEVED]
    return {f"believed_{name}": factor for name, factor in zip(_BELIEVED, factors, strict=True) if name}


_DRAWN = {
    "wind": _wind,
    "force": lambda random: _vector("force", random.uniform(0, 1.0, 3)),
    "torque": lambda random: _vector("torque", random.uniform(0, 0.1, 3)),
    "payload": _payload,
    "efficiency": _efficiency,
    "uncertainty": _uncertainty,
}
_SWITCHED = ("force", "torque", "payload")  # on and off


def _vector(name, values):
    return {f"{name}_{axis}": value for axis, value in zip("xyz", values, strict=True)}


def _switches(random):
    """Times at which a disturbance begins and ends, at least half a second apart."""
    times = []
    for _ in range(random.randint(1, 5)):
        for _ in range(100):
            new = random.uniform(0.5, LENGTH - 0.5)
            if all(abs(new - one) >= 0.5 for one in times):
                times.append(new)
                break
        else:
            break
    return {f"switch_{n}": at for n, at in enumerate(sorted(times), 1)}
