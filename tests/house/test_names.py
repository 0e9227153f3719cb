"""Names of the package: those of its modules beside the functions that hide them, and those of earlier versions."""

import subprocess
import sys

import pytest

import fpirhc as fp
from fpirhc.errors import InvalidName
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
    assert FORMER[name] in fp.__all__
    with pytest.raises(InvalidName, match=f"^fpirhc.{name} is called fpirhc.{FORMER[name]} now.$"):
        getattr(fp, name)
