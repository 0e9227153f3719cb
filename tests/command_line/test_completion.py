"""Completion by a shell: bash itself completes with the script, and is asked what it would offer."""

from __future__ import annotations

import shutil
import subprocess
import sys

import pytest

from fpirhc.cli.main import main
from fpirhc.cli.verb import shipped
from fpirhc.cli.verbs.completion import SHELLS, script
from fpirhc.errors import NotSupported

ASK = """
source ./fpirhc.bash
COMP_WORDS=({words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1)); COMPREPLY=()
COMP_LINE="${{COMP_WORDS[*]}}"; COMP_POINT=${{#COMP_LINE}}
function_of=$(complete -p fpirhc | sed 's/.*-F \\([^ ]*\\) .*/\\1/')
"$function_of" fpirhc "${{COMP_WORDS[COMP_CWORD]}}" "${{COMP_WORDS[COMP_CWORD-1]}}"
printf '%s\\n' "${{COMPREPLY[@]}}"
"""


@pytest.fixture(scope="module")
def bash(tmp_path_factory):
    """Function (words before the cursor) -> what bash offers, in a folder with a problem file and a folder."""
    pytest.importorskip("shtab")
    if shutil.which("bash") is None:
        pytest.skip("there is no bash")
    folder = tmp_path_factory.mktemp("completion")
    (folder / "fpirhc.bash").write_text(script("bash"))
    (folder / "arm.py").touch()
    (folder / "armchair").mkdir()

    def offered(words: str) -> set[str]:
        done = subprocess.run(
            ["bash", "-c", ASK.format(words=words)], cwd=folder, capture_output=True, text=True, check=True, timeout=60
        )
        return {line.strip() for line in done.stdout.splitlines() if line.strip()}

    return offered


def test_commands_are_completed(bash):
    assert bash("fpirhc ''") >= set(shipped())
    assert bash("fpirhc co") == {"compare", "completion"}


def test_options_are_completed(bash):
    """Those of the command, also of two words."""
    assert "--ignore-below" in bash("fpirhc check --i")
    assert "--no-compile" in bash("fpirhc run --no")


def test_problems_are_completed(bash):
    assert "two_mass" in bash("fpirhc compare two_")
    assert bash("fpirhc compare ar") >= {"arm.py", "armchair"}
    assert "fpirhc.bash" not in bash("fpirhc compare ''")


def test_folders_and_choices_are_completed(bash):
    assert bash("fpirhc compare arm.py --out ar") == {"armchair"}
    assert bash("fpirhc completion ''") >= set(SHELLS)


@pytest.mark.parametrize("shell", SHELLS)
def test_every_shell_gets_a_script(shell, capsys):
    shtab = pytest.importorskip("shtab")
    if shell not in shtab.SUPPORTED_SHELLS:
        pytest.skip(f"this version of shtab does not know {shell}")
    assert main(["completion", shell]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in shipped())


def test_without_shtab_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "shtab", None)
    with pytest.raises(NotSupported, match=r"fpirhc\[completion\]"):
        script("bash")
