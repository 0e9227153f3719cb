"""Every command: found by a scan, explained by its help, and honest about its exit codes."""

from __future__ import annotations

import subprocess
import sys

import pytest

# --- Discovery --------------------------------------------------------------------------------------------------------


# --- Help -------------------------------------------------------------------------------------------------------------


HEAVY = ("casadi", "numpy", "scipy", "rich", "jinja2", "matplotlib", "control", "pandas", "osqp")


@pytest.mark.parametrize(
    ("first", "absent"),
    [
        ("from fpirhc.cli.main import main; main([])", HEAVY),
        ("from fpirhc.cli.main import main; main(['list'])", HEAVY),
        ("import fpirhc as fp; fp.Problem", HEAVY[2:]),
        ("import fpirhc as fp; fp.load_problem('two_mass')", ("matplotlib", "rich", "jinja2")),
        ("import fpirhc.report.html", ("matplotlib",)),
        ("import fpirhc.studies.comparison.compare", ("scipy",)),
        ("from fpirhc.review import question as q; q.known_questions(q.ControllerQuestion)", ("scipy",)),
    ],
)
def test_what_comes_first_is_light(first, absent):
    """The lists of commands and of problems need no heavy library, and a problem none but CasADi and numpy."""
    code = f"import sys; {first}; print([m for m in {absent} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize("verb", ["compare", "review", "run", "solve", "tune"])
def test_the_message_of_a_wrong_file_is_light(verb, tmp_path):
    """What a file lacks is said before anything that draws, computes or tells a result is imported."""
    wrong = tmp_path / "wrong.py"
    wrong.write_text("nothing = 3\n")
    words = [verb, str(wrong), *(["RHC"] if verb == "run" else [])]
    code = f"import sys; from fpirhc.cli.main import main; main({words}); print([m for m in {HEAVY[2:]} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert "wrong.py" in done.stderr
    assert done.stdout.splitlines()[-1] == "[]"


# --- Exit codes -------------------------------------------------------------------------------------------------------


# name of the command: (what to do before, its words, the exit code), one after the other


# --- probe ------------------------------------------------------------------------------------------------------------
