"""What a problem file with random mistakes raises inside the library."""

from __future__ import annotations

from pathlib import Path

import pytest
from mutated_problems import mutated

import fpirhc as fp
from fpirhc.controllers.check import checked
from fpirhc.errors import FpirhcError, ProblemFileError
from fpirhc.problem_files import problem_file

_CAUSE = problem_file._cause_of


def raw_error(path: Path, seed: int, monkeypatch: pytest.MonkeyPatch) -> str:
    """The Python error that a random mistake raises inside the library; empty where it is refused by name, or accepted."""
    inside: list[BaseException] = []
    cause = _CAUSE

    def seen(error: Exception) -> str:
        inside.append(error)
        return cause(error)

    monkeypatch.setattr(problem_file, "_cause_of", seen)
    path.write_text(mutated(seed), encoding="utf-8")
    try:
        task = fp.load_problem(str(path))
        for controller in task.controllers.values():
            try:
                checked(task.problem, controller)
            except FpirhcError:
                continue
    except ProblemFileError:
        # An error of the file itself, such as a misspelt name, is shown as Python has it; one from our own lines is not.
        wrapped = [e for e in inside if not isinstance(e, FpirhcError) and not _from_file(e, path)]
        return f"seed {seed}: {wrapped[0]!r}" if wrapped else ""
    except Exception as error:  # noqa: BLE001 -- what is looked for
        return f"seed {seed}: {error!r}"
    return ""


def _from_file(error: BaseException, path: Path) -> bool:
    """Whether the innermost line of the file or of the package is the file's."""
    place, own = error.__traceback__, False
    while place is not None:
        name = place.tb_frame.f_code.co_filename
        own = name == str(path) if name == str(path) or "/fpirhc/" in name else own
        place = place.tb_next
    return own or isinstance(error, SyntaxError)
