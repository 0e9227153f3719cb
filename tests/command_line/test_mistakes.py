"""Typical mistakes in problem files: each is refused with its file and line, its cause and how to mend it."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from mutated_problems import SOURCE, raw_error

import fpirhc as fp
from fpirhc.contracts import Deformation
from fpirhc.errors import InvalidField


def test_all_mistakes_of_a_value_are_said_together():
    wrong: dict[str, Any] = {"gain": "a", "shift": None, "scal": 1.0}
    with pytest.raises(InvalidField, match=r"(?s)3 mistakes.*no field 'scal'.*Sigmoid.gain.*Sigmoid.shift") as caught:
        fp.Sigmoid(**wrong)
    assert "test_mistakes.py, line" in str(caught.value)


@dataclass(frozen=True)
class Mine(fp.Affine):
    """A map of another distribution, which has no line for checks."""

    inner: Deformation | None = None
    spans: dict[str, tuple[float, float]] = field(default_factory=dict)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"inner": fp.Sigmoid}, "Mine.inner: expected a Deformation or None, got the class Sigmoid; write Sig"),
        ({"spans": {"a": (1.0, "b")}}, r"Mine.spans\['a'\]\[1\]: expected a number, got the text 'b'"),
        ({"spans": {1: (1.0, 2.0)}}, "Mine.spans: name 1: expected a text, got 1"),
    ],
)
def test_a_class_of_another_distribution_is_checked_without_a_line_of_its_own(settings, message):
    with pytest.raises(InvalidField, match=message):
        Mine(gain=-0.5, **settings)
    whole: Any = np.int64(2)
    assert Mine(gain=np.float64(-0.5), inner=fp.Affine(-0.2), spans={"a": (1, whole)}).gain == -0.5


# --- Random mistakes --------------------------------------------------------------------------------------------------


def test_the_file_without_mistakes_is_accepted(tmp_path):
    (tmp_path / "mine.py").write_text(SOURCE, encoding="utf-8")
    task = fp.load_problem(str(tmp_path / "mine.py"))
    short = replace(task.problem, duration=2 * task.problem.period, measure_from=0.0)
    for one in task.controllers.values():
        assert fp.simulate(short, one, seed=0, compiled=False).stop is None


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("seeds", [range(120), pytest.param(range(1000, 11_000), marks=pytest.mark.slow)], ids=len)
def test_random_mistakes_never_end_in_a_raw_error(seeds, tmp_path, monkeypatch):
    monkeypatch.setattr(fp, "Exponential", fp.Exponential)  # a mistake may assign to it
    assert [one for one in (raw_error(tmp_path / "mine.py", seed) for seed in seeds) if one] == []
