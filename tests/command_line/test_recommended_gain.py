"""One recommended gain: review, refusal and report name the same number, from the smallest limit of the whole loop, or none."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import abroad
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.cli.main import main
from fpirhc.plant.motion import with_exact_parameters

STEERING = (Path(abroad.__file__).parent / "vehicle_steering.py").read_text()
steering = cache(lambda: abroad.load("vehicle_steering"))
REFERENCED, PLAIN, TORQUE = "RHC+model-referenced", "RHC+FPI", "CTC+FPI"


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "4000")
    Path("car.py").write_text(STEERING)
    return tmp_path


def answer(capsys, *words: str) -> dict[str, Any]:
    """The answer about the gain of the only controller that is asked about."""
    main(["review", "car.py", "--json", "--controllers", *words])
    [answers] = json.loads(capsys.readouterr().out)["controllers"].values()
    [one] = [a for a in answers if "gain admissible" in a["question"]]
    return dict(one)


def answer_of_plain(capsys, effective: float) -> dict[str, Any]:
    old = "fp.Exponential(rate=3.0), fp.Affine(gain=-0.8)"
    Path("car.py").write_text(STEERING.replace(old, old.replace("-0.8", str(-2 * effective))))
    return answer(capsys, TORQUE)


def with_gain(name: str, effective: float):
    controller = steering().controllers[name]
    return controller.with_deformation(controller.deformation.with_effective_gain(effective))


def rms_and_movement(controller) -> tuple[float, float]:
    metrics = fp.measure(steering().problem, fp.simulate(steering().problem, controller, seed=0, compiled=False))
    return metrics.rms_error["y"], metrics["total_variation"]["delta"]


@pytest.mark.slow
def test_review_refusal_and_report_name_the_same_gain(folder, capsys):
    """-2 for a wrong sign, for a gain beyond its limit, and for the gain in use."""
    own = answer(capsys, REFERENCED)
    assert own["verdict"] == "yes"
    assert own["numbers"]["recommended"] == pytest.approx(-2.0, rel=1e-3)
    sentence = "the smallest limit is -4, set by the map's steepest secant; recommended -2, half of it"
    assert own["evidence"] == f"gain = -0.8; {sentence}"
    old = "fp.ModelReferenced(fp.Affine(gain=-0.8))"
    assert old in STEERING
    Path("car.py").write_text(STEERING.replace(old, old.replace("-0.8", "0.8")))
    assert main(["compare", "car.py"]) == 2
    refused = capsys.readouterr().err
    assert f"controller '{REFERENCED}': ModelReferenced(Affine(gain=0.8)) has" in refused
    assert refused.replace("\n", " ").count(sentence) == 1
    assert main(["run", "car.py", REFERENCED]) == 2
    assert sentence in capsys.readouterr().err.replace("\n", " ")
    with pytest.raises(fp.FpirhcError, match=re.escape(f"; {sentence}")):
        fp.Stepper(
            steering().problem,
            steering().controllers[REFERENCED].with_deformation(fp.ModelReferenced(fp.Affine(gain=0.8))),
        )
    Path("car.py").write_text(STEERING)
    assert main(["run", "car.py", REFERENCED, "--no-compile", "--set", "deformation.map.gain=0.8"]) == 2
    assert sentence in capsys.readouterr().err.replace("\n", " ")
    Path("car.py").write_text(STEERING.replace(old, "fp.BeyondLimit(fp.ModelReferenced(fp.Affine(gain=-5.4)))"))
    assert main(["compare", "car.py", "--no-compile", "--controllers", "RHC", REFERENCED]) == 0
    assert f" Its gain is too large: {sentence}." in capsys.readouterr().out


def test_with_the_recommended_gain_the_wheel_moves_as_without_adaptation():
    """The error is a fiftieth; towards the limit of the iteration by itself the wheel of the plain form chatters."""
    before, still = rms_and_movement(steering().controllers["RHC"])
    after, moved = rms_and_movement(with_gain(REFERENCED, 1.0))
    assert after < before / 40
    assert moved < 1.05 * still
    lost, chatter = rms_and_movement(with_gain(PLAIN, 2.4))  # effective gains below 2.5 pass the map's own limit
    assert lost > 4 * before
    assert chatter > 250 * still


@pytest.mark.parametrize(
    ("effective", "verdict", "recommended"),
    [
        (0.4, "unknown", None),
        pytest.param(1.6, "yes", -1.66, marks=pytest.mark.slow),
        (1.8, "caution", -1.66),
        pytest.param(2.4, "no", -1.66, marks=pytest.mark.slow),
    ],
)
def test_the_gain_of_a_plain_form(folder, capsys, effective, verdict, recommended):
    """Its whole loop has the limit 1.66 in the box, where its map alone has 2.

    With 0.4 the null test fails: no gain, no yes. With 2.4 the loop diverges with the exact plant too.
    """
    one = answer_of_plain(capsys, effective)
    assert one["verdict"] == verdict
    found = re.search(r"the smallest limit is (\S+), set by the poles of the whole loop; (.*)", one["evidence"])
    assert found
    assert float(found[1]) == pytest.approx(-3.32, rel=0.01)
    number = one["numbers"]["recommended"]
    if recommended is None:
        assert number is None
        assert found[2] == "no gain is recommended, because adaptation does not leave a right model alone"
        assert "recommended -" not in one["evidence"]
        assert one["change"] == (
            "It is inside its limits, which does not say that it helps: see whether a comparison does. Use another form, or leave "
            "the deformation out."
        )
    else:
        assert number == pytest.approx(recommended, rel=0.01)
        assert found[2] == f"recommended {recommended}, half of it"
        assert one["change"] == ("" if verdict == "yes" else f"Use gain = {recommended}.")


def test_the_limit_of_the_poles_is_where_a_loop_of_the_box_loses_them():
    """The plant is the model, an end of the box: below its limit the wheel comes to rest after the lane change, above it never."""
    exact = with_exact_parameters(steering().problem.plant, steering().problem.plant.approximate)
    problem = replace(steering().problem, plant=exact, duration=16.0)
    sizes = []
    for effective in (1.6, 1.75):
        run = fp.simulate(problem, with_gain(TORQUE, effective), seed=0, compiled=False)
        sizes.append(float(np.abs(np.diff(run["command"][-50:, 0])).max()))
    assert sizes[0] < 1e-9
    assert sizes[1] > 1e-4
