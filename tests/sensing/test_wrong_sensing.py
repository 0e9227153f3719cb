"""What is wrong with sensing is said where it is stated: what, where, what was expected, and how to mend it."""

import math
from typing import Any

import numpy as np
import pytest
from helpers.plants import linear

import fpirhc as fp
from fpirhc.conformance import two_masses

MAP, KALMAN = fp.Affine(gain=-1.0), fp.KalmanFilter(measured={"y": 0.1}, noise={"y": 1.0})
FIT = fp.SavitzkyGolay


def task(plant: fp.Plant = linear(1.0, 0.7), start: Any = None, **sensing: Any) -> fp.Problem:  # noqa: B008
    sine = fp.Trajectory(lambda t: dict.fromkeys(plant.outputs or plant.names, 0 * t))
    return fp.Problem(plant, sine, start or {"y": 0.0}, period=1e-3, duration=0.1, sensing=fp.Sensing(**sensing))


def of_output(**sensing: Any) -> fp.Problem:
    plant = fp.Plant.of_states(
        states={"C": "mg/l", "E": "mg/l"},
        inputs={"u": "mg/l/min"},
        parameters={},
        rates=lambda x, u, p: {"C": u.u - x.C, "E": 0.5 * (x.C - x.E)},
        outputs={"depth": fp.Output("1", lambda x, p: 93 / (1 + x.E))},
    )
    return task(plant, {"C": 1.5, "E": 1.5}, **{"estimator": fp.PositionDifference(), "measured": ["depth"]} | sensing)


def stepped(call: str, *arguments: Any) -> None:
    one = fp.Stepper(task(estimator=fp.PositionDifference()), fp.ComputedTorque(fp.Exponential(6.0)), compiled=False)
    getattr(one, call)(0.0, *arguments, one.start())


WRONG: dict[str, tuple[Any, str]] = {
    "deviation": (lambda: fp.Noise(-1.0), "Noise.deviation: expected a finite number of at least 0"),
    "no deviation": (lambda: fp.Noise(math.nan), "got nan"),
    "a number for noise": (lambda: fp.Sensor(noise=0.1), "Sensor.noise: expected a Disturbance or None, got 0.1"),  # type: ignore[arg-type]
    "quantum": (lambda: fp.Sensor(quantum=0.0), "Sensor.quantum: expected a finite number above 0"),
    "two mistakes": (lambda: fp.Sensor(quantum=-1.0, dropout=1.0), "dropout: expected a number from 0 to below 1"),
    "range": (lambda: fp.Sensor(range=(1.0, 0.0)), "lower < upper"),
    "range of what is followed": (
        lambda: task(sensors={"y": fp.Sensor(range=(0.5, 0.9))}),
        "the reference of 'y' goes from 0 to 0, but its sensor shows 0.5 to 0.9",
    ),
    "even window": (lambda: FIT(window=10, degree=2), "use 9 or 11"),
    "smallest window": (lambda: FIT(window=2, degree=1), "at least 3 samples for degree 1; use 3"),
    "short window": (lambda: FIT(window=3, degree=3), "at least 5"),
    "window of a float": (lambda: FIT(window=5.0, degree=2), "expected a whole number from 1 to 1001, got 5.0"),  # type: ignore[arg-type]
    "low degree": (lambda: task(estimator=FIT(5, 1)), "use a degree of at least 2"),
    "time constant": (lambda: fp.LowPassDifference(time_constant=0.0), "VelocityDifference()"),
    "pole": (lambda: fp.Filtered(MAP, pole=1.0), "pole: expected a number from 0 to below 1, got 1.0"),
    "sensor of nobody": (lambda: task(sensors={"yy": fp.Sensor()}), "quantity 'yy' is unknown. Did you mean 'y"),
    "sensor of an estimate": (
        lambda: task(sensors={"y'": fp.Sensor()}, estimator=FIT(5, 2)),
        "'y'' is estimated by SavitzkyGolay, not measured; sensors are those of y",
    ),
    "measured name": (lambda: task(measured=["Y"], observer=KALMAN), "measured: quantity 'Y'"),
    "no observer": (
        lambda: task(measured=["y"], estimator=fp.Measured()),
        "also needs y', y''; measure it, or estimate it by an observer",
    ),
    "filter of what no sensor shows": (
        lambda: task(measured=["y"], observer=fp.KalmanFilter(measured={"y'": 0.1}, noise={"y": 1.0})),
        "no sensor shows 'y''; Sensing(measured=...) has y",
    ),
    "noise of nobody": (
        lambda: task(measured=["y"], observer=fp.KalmanFilter(measured={"y": 0.1}, noise={"yy": 1.0})),
        "noise: coordinate 'yy' is unknown. Did you mean 'y'",
    ),
    "no noise": (lambda: fp.KalmanFilter(measured={"y": 0.1}, noise={}), "name at least one"),
    "a state of outputs": (
        lambda: of_output(measured=["depth", "C"]),
        "C is given as it is to controllers of a plant with outputs, unless an observer is stated",
    ),
    "filter of a state behind outputs": (
        lambda: of_output(observer=fp.KalmanFilter(measured={"C": 0.1}, noise={"C": 1.0})), "no sensor shows 'C'"
    ),
    "estimates for samples": (lambda: stepped("step", np.zeros(2), np.zeros(1)), "use step_measured(time, measured, memory)"),
    "samples": (lambda: stepped("step_measured", np.zeros(3)), "'measured' has 1 entries"),
    "samples of two": (
        lambda: fp.Stepper(two_masses(), fp.ComputedTorque(fp.Exponential(6.0)), compiled=False).step_measured(
            0.0, np.zeros(4), np.zeros(9)
        ),
        "'measured' has 6 entries",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_wrong_sensing_says_what_was_expected(name):
    make, words = WRONG[name]
    with pytest.raises(fp.FpirhcError) as caught:
        make()
    assert words in " ".join(str(caught.value).split())
