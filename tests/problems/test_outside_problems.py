"""Plants of other packages: what their baselines promise, and that the packages themselves still give it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fpirhc.baselines.baseline import problems_here
from fpirhc.problem_files import shipped
from fpirhc.problem_files.shipped import needed

FOLDER = Path(__file__).parents[2] / "problems" / "outside"
FILES = sorted(FOLDER.glob("*.py"))
# Errors of RHC with the model-referenced form in the first study of these plants, and what a tenth of a more may be.
REACHED = {
    "car": {"side": 0.5e-3},
    "lab": {"T1": 0.145, "T2": 0.154},
    "mujoco_arm": {"shoulder": 59e-6, "elbow": 62e-6},
}


def errors(name: str, controller: str) -> dict[str, float]:
    """The rms errors of the baseline."""
    metrics = json.loads((FOLDER / "baselines" / f"{name}.json").read_text())["controllers"][controller]["metrics"]
    return {key.partition(".")[2]: one[0] for key, one in metrics.items() if key.startswith("rms_error.")}


@pytest.mark.parametrize("name", REACHED)
def test_adaptation_is_as_good_as_it_was(name):
    """At most 1.2 times the error of the first study, and far below RHC."""
    found, plain = errors(name, "RHC+FPI"), errors(name, "RHC")
    for coordinate, reached in REACHED[name].items():
        assert found[coordinate] <= 1.2 * reached
        assert found[coordinate] < plain[coordinate]


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_a_file_is_short_and_says_what_it_needs(path):
    """Seventy lines hold model, task and five controllers."""
    assert len(path.read_text().splitlines()) <= 70
    assert needed(path)


def test_a_problem_whose_package_is_missing_is_left_out_with_the_reason(tmp_path, monkeypatch):
    """The check goes on with the others, and the list says what is missing."""
    folder = tmp_path / "problems"
    folder.mkdir()
    text = "needs = ('no_such_package',)\nproblem, controllers = None, None\n"
    (folder / "far.py").write_text(text)
    (folder / "near.py").write_text(text.partition("\n")[2])
    assert [path.stem for path in problems_here(tmp_path)] == ["near"]
    assert shipped.missing(folder / "far.py") == "it needs no_such_package: pip install 'fpirhc[outside]'"
    monkeypatch.setattr(shipped, "shipped_folders", lambda: [folder])
    assert list(shipped.shipped_problems()) == ["near"]
    assert list(shipped.shipped_groups()["first examples"]) == ["far", "near"]
