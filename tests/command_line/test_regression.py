"""Baselines: what bands are made of, what a baseline file may be, what outputs do with hostile names, and the pytest plugin."""

from __future__ import annotations

import pytest

from fpirhc.baselines.baseline import problems_here
from fpirhc.errors import BaselineError

pytest_plugins = ["pytester"]


def test_folders_of_a_problems_folder_are_checked_too(tmp_path):
    """Each with its own baselines and its own reasons for having none; folders without problems are passed over."""
    inner = tmp_path / "problems" / "gallery"
    (inner / "baselines").mkdir(parents=True)
    (tmp_path / "problems" / "notes").mkdir()
    for path in (tmp_path / "problems" / "one.py", inner / "two.py", inner / "three.py"):
        path.write_text("problem, controllers = 1, {}")
    (inner / "baselines" / "gone.json").write_text("{}")
    (inner / "baselines" / "unchecked.toml").write_text('three = "slow"')
    files, unchecked = problems_here(tmp_path)
    assert [str(p.relative_to(tmp_path / "problems")) for p in files] == ["gallery/gone.py", "one.py", "gallery/two.py"]
    assert unchecked == {"three": "slow"}


def test_two_problems_of_one_name_are_refused(tmp_path):
    """One of them would go unchecked."""
    for inner in ("a", "b"):
        (tmp_path / "problems" / inner).mkdir(parents=True)
        (tmp_path / "problems" / inner / "arm.py").write_text("problem, controllers = 1, {}")
    with pytest.raises(BaselineError, match=r"a/arm.py' and '.*b/arm.py' have one name; rename one"):
        problems_here(tmp_path)


TEST = """
import pytest

@pytest.mark.parametrize("controller", ["CTC", "CTC+FPI", "RHC+FPI"])
def test_line(fpirhc_check, controller):
    fpirhc_check("line.py", controller)
"""


def test_pytest_plugin_wants_a_reason(pytester):
    """An empty one is refused before anything runs."""
    pytester.makepyfile(test_line=TEST)
    result = pytester.runpytest_inprocess("--fpirhc-accept", " ")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["*needs a reason*"])
