"""A newcomer's first commands: `fpirhc new` and `fpirhc doctor`."""

from __future__ import annotations

import pytest

from fpirhc.scaffold import create_problem

pytest_plugins = ["pytester"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


# new


def test_new_does_not_follow_a_link(folder):
    """A link that leads elsewhere counts as a file, also where nothing is at its end."""
    (folder / "arm.py").symlink_to(folder / "elsewhere.py")
    with pytest.raises(OSError, match="exists already"):
        create_problem("arm", folder)
    assert not (folder / "elsewhere.py").exists()


# doctor
