"""Whole reports as they are read: six texts are kept in tests/data/reports, and a changed one is renewed by

    FPIRHC_RENEW=1 python -m pytest tests/report/test_texts.py

What belongs to a machine (times, versions, paths) is left out. What no kept text can say: every word is there on a terminal of any
width.
"""

import os
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
from helpers.line import line_text

from fpirhc.__main__ import main

KEPT = Path(__file__).parents[1] / "data" / "reports"
PLANNED = """period=5e-3, duration=1.0, measure_from=0.5,
    horizon=fp.Horizon(stages=10, step=1e-2),
    cost=fp.Quadratic(states={"y": 100.0, "y'": 1.0}, deviation={"u": 1e-2}),
    limits=fp.Limits(inputs={"u": (-30.0, 30.0)})"""
NOISY = f"""{PLANNED[:-1]}, states={{"y'": (-0.9, 1.0)}}, rates={{"u": (-60.0, 60.0)}}),
    sensing=fp.Sensing({{"y''": fp.Sensor(noise=fp.Noise(0.2))}})"""
MORE = """optimiser = fp.FixedPointSolver(iterations=3, tolerance=1e-3)
controllers["RHC"] = fp.RecedingHorizon(optimiser)
controllers["RHC+FPI"] = fp.RecedingHorizon(optimiser, fp.ModelReferenced(fp.Affine(gain=-0.7)))
"""
COMMANDS = {
    "compare": "compare line.py --verbose --no-compile",
    "page": "compare line.py --no-compile",
    "review": "review line.py --verbose",
    "noisy": "review noisy.py --verbose -c CTC+FPI",
    "study": "study line.py --draws 6 --mismatch 20% --no-compile -c CTC CTC+FPI",
    "margins": "study line.py --margins lost --no-compile -c CTC",
}
OF_A_MACHINE = (
    (r"took [\d.e+-]+ s", "took S s"),
    (r"\b(fpirhc|casadi|numpy|Python|CasADi|NumPy)( |=)v?\d[\w.+-]*", r"\1\2V"),
    (r"\d{4}-\d\d-\d\d[ T][\d:.+Z]*", "DATE"),
    (r"[^\s'\"]*/(?=line\.py|results)", ""),
)
TIME = r"\d[\d.]*(?: \d{3})*"
INLINE = {"span", "b", "i", "a", "code", "strong", "em"}


class Words(HTMLParser):
    """The text of a page, a line for every element that has some; scripts and styles are none."""

    def __init__(self) -> None:
        super().__init__()
        self.hidden, self.tags, self.lines = False, set[str](), [""]

    def handle_starttag(self, tag: str, attrs: object) -> None:  # noqa: ARG002
        self.tags.add(tag)
        self.hidden |= tag in ("script", "style")
        self.lines += [""] * (tag not in INLINE)

    def handle_endtag(self, tag: str) -> None:
        self.hidden &= tag not in ("script", "style")
        self.lines += [""] * (tag not in INLINE)

    def handle_data(self, data: str) -> None:
        if not self.hidden:
            self.lines[-1] += data


def words_of(page: str) -> Words:
    words = Words()
    words.feed(page)
    return words


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "400")
    Path("line.py").write_text(line_text(PLANNED, more=MORE), encoding="utf-8")
    Path("noisy.py").write_text(line_text(NOISY, more=MORE), encoding="utf-8")
    return tmp_path


def number(found: re.Match[str]) -> str:
    """Two digits; what is rounding has none."""
    value = float(found[0])
    return f"{float(f'{value:.2g}'):g}" if abs(value) > 1e-6 or value == 0 else "ROUNDING"


def same_on_every_machine(text: str) -> str:
    """Without what belongs to this one: the last digit of a number, and the column of times."""
    for pattern, instead in OF_A_MACHINE:
        text = re.sub(pattern, instead, text)
    text = re.sub(rf"{TIME} / {TIME} / {TIME}", "US", re.sub(r"\blate [\d.]+ %", "ok", text))
    text = re.sub(r"(?<![\w.])-?\d+(\.\d+)?(e[+-]?\d+)?", number, text)
    return "\n".join(re.sub(r"[ \u2500-\u257f]+", " ", line).strip() for line in text.splitlines()).strip() + "\n"


@pytest.mark.parametrize("name", COMMANDS)
def test_a_whole_report_is_the_kept_one(name, folder, capsys):
    assert main(COMMANDS[name].split()) in (0, 1)
    said = capsys.readouterr().out
    if name == "page":
        page = (folder / "results/line/report.html").read_text(encoding="utf-8")
        # Numbers of tables are those of the terminal; settings, versions and the command that follow them are data.
        lines = [" ".join(one.split()) for one in words_of(page).lines if re.search(r"[a-z]{2}", one)]
        said = "\n".join(lines[: lines.index("Settings")])
    found, kept = same_on_every_machine(said), KEPT / f"{name}.txt"
    if os.environ.get("FPIRHC_RENEW"):
        kept.parent.mkdir(exist_ok=True)
        kept.write_text(found, encoding="utf-8")
    assert found == kept.read_text(encoding="utf-8")


def test_a_terminal_of_any_width_has_every_word(folder, capsys, monkeypatch):
    """No line beyond the edge, no ellipsis, no number in two: the words of a narrow terminal are those of a wide one."""
    said = {}
    for width in (60, 80, 400):
        monkeypatch.setenv("COLUMNS", str(width))
        assert (
            main(["study", "line.py", "--draws", "2", "--mismatch", "20%", "--no-compile", "-c", "CTC", "CTC+FPI"]) == 0
        )
        lines = capsys.readouterr().out.splitlines()
        said[width] = {
            re.sub(r"\d+(\.\d+)?(e[+-]?\d+)?", "#", word) for line in lines for word in line.split() if "/" not in word
        }
        assert max(len(line) for line in lines if "/" not in line) <= width
        assert "\u2026" not in "".join(lines)
        assert not re.search(r"\d *\n *(%|m|s)\W", "\n".join(lines))  # a unit stays with its number
    for width in (60, 80):
        assert {w for w in said[400] - said[width] if "#" in w and "us" not in w} == set()
