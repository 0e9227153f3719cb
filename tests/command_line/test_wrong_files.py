"""Wrong files and command lines as they are written by people who come from other tools: what each message must say.

Each case changes a correct file (`first_files`) and runs a command on it. The message names what is wrong, where, what was
expected, and a fix; all mistakes of one file stand in it; the exit code is that of bad input, or of a review that answers no.
"""

from __future__ import annotations

import re

import pytest
from first_files import PENDULUM, REACTOR, TANKS

import fpirhc as fp

# Changes of a correct file: the name of the mistake, the old piece and the new one, and what must be said, in this order.


# Command lines beside a correct file: the words, and what must be said, in this order.


@pytest.mark.parametrize("file", [PENDULUM, REACTOR, TANKS])
def test_the_files_without_a_mistake_are_accepted(file, tmp_path):
    (tmp_path / "mine.py").write_text(file, encoding="utf-8")
    assert len(fp.load_problem(str(tmp_path / "mine.py")).controllers) == 2


def test_a_file_imports_its_neighbours_and_forgets_them(tmp_path):
    """Two folders with modules of one name, as `fpirhc check` meets them."""
    for folder, angle in (("first", 0.1), ("second", 0.2)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "numbers_of_mine.py").write_text(f"START = {angle}\n", encoding="utf-8")
        text = PENDULUM.replace("import fpirhc as fp", "import fpirhc as fp\nfrom numbers_of_mine import START", 1)
        (tmp_path / folder / "mine.py").write_text(text.replace('{"angle": 0.0}', '{"angle": START}'), encoding="utf-8")
    starts = [fp.load_problem(str(tmp_path / folder / "mine.py")).problem.start for folder in ("first", "second")]
    assert starts == [{"angle": 0.1}, {"angle": 0.2}]


def test_a_file_is_read_as_it_is_now(tmp_path, monkeypatch):
    """Also where it was changed within a second to one of the same length, and no bytecode is left beside it."""
    monkeypatch.setattr("sys.dont_write_bytecode", False)
    path, starts = tmp_path / "mine.py", []
    for angle in ("0.1", "0.2"):
        path.write_text(PENDULUM.replace('{"angle": 0.0}', f'{{"angle": {angle}}}'), encoding="utf-8")
        starts.append(fp.load_problem(str(path)).problem.start["angle"])
    assert starts == [0.1, 0.2]
    assert [file.name for file in tmp_path.iterdir()] == ["mine.py"]


def test_a_long_list_of_valid_names_is_cut():
    with pytest.raises(AttributeError) as caught:
        getattr(fp, "Sigmiod")  # noqa: B009 -- the name is wrong on purpose
    said = str(caught.value)
    assert said.startswith("fpirhc has no name 'Sigmiod'. Did you mean 'Sigmoid'? Valid: Sigmoid, ")
    assert re.search(r" and \d+ more\.$", said)
