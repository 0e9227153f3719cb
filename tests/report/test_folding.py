"""A table on a narrow terminal folds: every text of every column is there, whole, whatever the width."""

from __future__ import annotations

import io
import re

import pytest
from rich.console import Console

from fpirhc.report.terminal import say, show_table
from fpirhc.summary import Column, Table

HEADS = ("controller", "rms concentration [mg/l]", "max error [mg/l]", "clipped", "factor", "cycle us", "status")
ROWS = (
    ["RHC", "0.123456", "1.5e-05", "0 %", "0.7421", "12.5", "ok"],
    ["RHC+FPI, stiff, small scale and long name", "5.78e+10", "10.1", "83.2 %", "2.84", "6.6", "ok 66.5 %"],
    ["adaptive_controller_with_one_long_word", "-", "-", "100 %", "", "", "ended early"],
)


def shown(width: int, names: int = 1, caption: str = "") -> list[str]:
    """The lines of the table on a terminal of this width."""
    console = Console(file=io.StringIO(), width=width, color_system=None)
    table = Table("a title", [Column(h) for h in HEADS], caption, names)
    for row in ROWS:
        table.add(row)
    show_table(table, console)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue().splitlines()


@pytest.mark.parametrize("width", [50, 60, 80, 100, 200])
def test_nothing_is_cut_and_nothing_is_lost(width):
    """No ellipsis, no line beyond the edge, every number and every word of every heading whole."""
    lines = shown(width)
    text = "\n".join(lines)
    assert max(map(len, lines)) <= width
    assert "\u2026" not in text
    for row in ROWS:
        for cell in row[1:]:
            assert cell in text
    for word in " ".join(HEADS).split():
        assert re.search(rf"(?<!\S){re.escape(word)}(?!\S)", text), word


def test_a_wide_terminal_has_one_table_and_a_narrow_one_repeats_the_names():
    """Each part begins with the controllers; only later parts are continuations; the caption is said once."""
    assert sum(line.strip().startswith("controller") for line in shown(200)) == 1
    narrow = shown(60, caption="what it means")
    parts = [line for line in narrow if line.strip().startswith("controller")]
    assert len(parts) == sum("(continued)" in line for line in narrow) + 1 > 1
    assert sum(line.strip().startswith("RHC ") for line in narrow) == len(parts)
    assert sum("what it means" in line for line in narrow) == 1


def test_the_names_of_rows_may_be_two_columns():
    lines = shown(70, names=2)
    assert sum("0.123456" in line for line in lines) == sum(line.strip().startswith("controller") for line in lines) > 1


def test_texts_are_literal():
    console = Console(file=io.StringIO(), width=80, color_system=None)
    table = Table("[bold]t[/bold]", [Column("[red]head"), Column("x")])
    table.add(["[i]name\x1b[31m", ":bomb:"])
    show_table(table, console)
    assert isinstance(console.file, io.StringIO)
    text = console.file.getvalue()
    for literal in ("[bold]t[/bold]", "[red]head", "[i]name\\x1b[31m", ":bomb:"):
        assert literal in text


@pytest.mark.parametrize("width", range(20, 70, 5))
def test_no_line_breaks_inside_a_number(width, capsys, monkeypatch):
    """Thousands stay together at every width, with an ordinary space between them; everything else breaks as before."""
    monkeypatch.setenv("COLUMNS", str(width))
    say("- lowers the rms error of T from 12 345 678 to 0.00232 N (1 880 times less)", "green")
    lines = capsys.readouterr().out.splitlines()
    assert all(len(line.rstrip()) <= width for line in lines)
    assert sum("12 345 678" in line for line in lines) == sum("1 880" in line for line in lines) == 1
    assert " ".join("".join(f"{line} " for line in lines).split()).endswith("0.00232 N (1 880 times less)")
