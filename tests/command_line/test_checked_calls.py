"""A wrong argument of a function is one error that names all of them, before anything runs, with what to write instead."""

import inspect
import pickle
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from helpers import tasks
from mutated_problems import SOURCE, raw_error

import fpirhc as fp
from fpirhc.contracts import Deformation
from fpirhc.errors import InvalidField

torque = cache(lambda: tasks.two_mass.controllers["CTC"])

ANY: Any = fp  # a type checker would refuse these calls
CALLS: dict[str, tuple[Callable[[], Any], str]] = {
    "a name of a controller": (lambda: ANY.simulate(tasks.two_mass.problem, "RHC", seed=0),
        "simulate.controller: expected a Controller, got the text 'RHC'; write controllers['RHC'] of a loaded problem file"),
    "a loaded file": (lambda: ANY.simulate(tasks.two_mass, torque(), seed=0),
        "simulate.problem: expected a Problem, got a value of the class Task; give its .problem"),
    "a forgotten argument": (lambda: ANY.simulate(tasks.two_mass.problem, torque()),
        "simulate needs seed; write simulate(problem=..., controller=..., seed=...)"),
    "a seed that is no number": (lambda: ANY.simulate(tasks.two_mass.problem, torque(), seed="a"),
        "simulate.seed: expected a whole number of at least 0, got the text 'a'"),
    "a name of a method": (lambda: ANY.Cases({"a": {}}).matching(all=[]), "no argument 'all'. Valid: wanted."),
    "a number for a signal": (lambda: ANY.Sensor(noise=2e-3), "or None, got 0.002; write fp.Noise(0.002)"),
    "a mapping for a number": (lambda: ANY.Predicted(torque(), {"Q1": 0.06}), "; write one value for all, 0.06"),
    "a number for a mapping": (lambda: ANY.DeadTime(0.02), "; write {'NAME': 0.02} with the name of what it belongs"),
    "a misspelt word": (lambda: ANY.Horizon(10, 0.01, replan="cycles"),
        "Horizon.replan: expected 'stage' or 'cycle' or a whole number from 1 to 1000000, got the text 'cycles'; write 'cycle'"),
}  # fmt: skip


@pytest.mark.parametrize("name", CALLS)
def test_wrong_arguments_are_named(name):
    """The place is that of the caller."""
    call, words = CALLS[name]
    with pytest.raises(InvalidField) as caught:
        call()
    assert words in str(caught.value)
    assert caught.value.place.startswith("test_checked_calls.py, line")


def test_all_mistakes_of_a_call_or_a_value_come_at_once():
    simulate: Any = fp.simulate
    with pytest.raises(InvalidField, match=r"(?s)3 mistakes.*needs seed.*problem.*controller"):
        simulate("two_mass", "CTC")
    wrong: dict[str, Any] = {"gain": "a", "shift": None, "scal": 1.0}
    with pytest.raises(InvalidField, match=r"(?s)3 mistakes.*no field 'scal'.*Sigmoid.gain.*Sigmoid.shift") as caught:
        fp.Sigmoid(**wrong)
    assert "test_checked_calls.py, line" in str(caught.value)


def test_a_checked_function_is_still_that_function():
    """Its name, signature and docstring are its own, and another process can load it."""
    assert pickle.loads(pickle.dumps(fp.simulate)) is fp.simulate
    assert list(inspect.signature(fp.simulate).parameters)[:2] == ["problem", "controller"]
    assert (fp.simulate.__doc__ or "").startswith("Run the closed loop")


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


# --- Random mistakes in problem files ---------------------------------------------------------------------------------


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
