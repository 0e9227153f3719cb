"""What every adapter does with wrong input: one error that names the adapter, also where its package raises."""

from __future__ import annotations

import inspect
import re
from importlib import import_module

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.adapters.control import plant_of
from fpirhc.adapters.names import finite_numbers
from fpirhc.errors import InvalidField, InvalidProblem, InvalidValue
from fpirhc.members import within

ADAPTERS = [
    one
    for module in within("fpirhc.adapters")
    for name, one in inspect.getmembers(module, inspect.isfunction)
    if one.__module__ == module.__name__ and (name.endswith("_body") or name in ("arm", "plant_of", "as_env"))
]


def test_every_adapter_is_found():
    assert len(ADAPTERS) == 12
    assert import_module("fpirhc.adapters.fmu").fmu_body in ADAPTERS


@pytest.mark.parametrize("adapter", ADAPTERS, ids=lambda one: one.__name__)
def test_a_wrong_argument_is_named(adapter):
    """A loaded task in place of each argument that is checked; no package is asked for before."""
    task = fp.load_problem("two_mass")
    parameters = list(inspect.signature(adapter).parameters.values())
    needed = [one for one in parameters if one.default is one.empty]
    checked = [one for one in parameters if one.annotation not in ("Any", "object")]
    named = dict.fromkeys([*(one.name for one in needed), checked[0].name], task)
    with pytest.raises(InvalidField, match=rf"{adapter.__name__}\.{checked[0].name}: expected "):
        adapter(**named)


def test_what_a_package_raises_has_the_adapters_name():
    message = "plant_of: TypeError: ss(sys): sys must be a StateSpace or TransferFunction"
    with pytest.raises(InvalidProblem, match=re.escape(message)):
        plant_of("1/(s+1)")


@pytest.mark.parametrize("given", [np.zeros(3), "up", [1.0, np.nan], None, [[1.0, 2.0]]])
def test_numbers_have_names(given):
    assert finite_numbers("step", [1, 2.0], ("Q1", "Q2")) == pytest.approx([1.0, 2.0])
    with pytest.raises(InvalidValue, match=r"step\(.*\): expected a finite number for each of Q1, Q2"):
        finite_numbers("step", given, ("Q1", "Q2"))
