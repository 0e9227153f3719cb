"""The README's problem runs as printed."""

from __future__ import annotations

import re
from pathlib import Path

from fpirhc.cli.main import main

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_readme_says_at_once_what_the_method_asks_for():
    """Before anything can be tried: the response is measured or estimated in every cycle, and its noise reaches the command."""
    begin = " ".join(README.partition("## ")[0].split())
    assert "must be measured or estimated in every cycle, and its noise reaches the command" in begin


def test_problem_of_the_readme_runs(tmp_path, monkeypatch, capsys):
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    Path("pendulum.py").write_text(code)
    assert main(["compare", "pendulum.py"]) == 0
    assert "RHC+FPI lowers the rms error of angle" in capsys.readouterr().out.replace("\n", " ")
