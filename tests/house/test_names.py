"""Names of the package: those of its modules beside the functions that hide them, and those of earlier versions."""

import importlib
import subprocess
import sys
from typing import Any

import pytest

import fpirhc as fp
from fpirhc.errors import InvalidField, InvalidName
from fpirhc.members import FORMER


@pytest.mark.parametrize("first", ["", "import fpirhc; fpirhc.review; "])
def test_modules_of_the_review_are_found_beside_its_function(first):
    """The function has the name of the package; a module below it is found whichever of the two is met first."""
    code = (
        f"{first}import fpirhc.review.question as question; import fpirhc.review.answer; import fpirhc as fp; "
        "assert fp.review.question is question is sys.modules['fpirhc.review.question']; "
        "assert fp.review.answer is sys.modules['fpirhc.review.answer']; "
        "assert callable(fp.review); assert fp.review.__name__ == 'review'"
    )
    subprocess.run([sys.executable, "-c", f"import sys; {code}"], check=True, timeout=60)


@pytest.mark.parametrize("name", FORMER)
def test_a_former_name_leads_to_the_present_one(name):
    """The message has the name that took its place, which exists."""
    *module, member = FORMER[name].split(".")
    assert hasattr(importlib.import_module(".".join(["fpirhc", *module])), member)
    with pytest.raises(InvalidName, match=f"^fpirhc.{name} is called fpirhc.{FORMER[name]} now.$"):
        getattr(fp, name)


PLANT: Any = fp.Plant
SENSING: Any = fp.Sensing


def _stepper() -> Any:
    task = fp.load_problem("two_link_arm")
    return fp.Stepper(task.problem, fp.ComputedTorque(fp.Exponential(rate=10.0)), compiled=False)


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda: PLANT.of_map, "Plant has no attribute 'of_map'; it is called 'discrete' now"),
        (lambda: PLANT.of_maps, "Plant has no attribute 'of_maps'"),
        (lambda: SENSING(belief=None), "Sensing has no field 'belief'. It is called 'observer' now."),
        (lambda: _stepper().aim({}), "Stepper has no attribute 'aim'; it is called 'set_reference' now"),
        (lambda: _stepper().stale(), "Stepper has no attribute 'stale'; it is called 'outdated' now"),
    ],
)
def test_a_former_member_leads_to_the_present_one(ask, message):
    with pytest.raises((AttributeError, InvalidField)) as caught:
        ask()
    assert message in str(caught.value)
