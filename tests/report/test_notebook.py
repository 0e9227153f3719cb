"""Results show themselves, and names that a user chose are shown as they are, wherever they are shown."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from types import SimpleNamespace

from fpirhc.report import terminal
from fpirhc.report.terminal import progress_bars
from fpirhc.summary import table


class Tags(HTMLParser):
    """Tags of a page, and the text between them."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.attributes: set[str] = set()
        self.text = ""

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.attributes |= {name for name, _ in attrs}

    def handle_data(self, data):
        self.text += data


def read(page: str) -> Tags:
    parser = Tags()
    parser.feed(page)
    return parser


def test_tables_escape_every_part():
    page = table("<a>", ("<b>",), [("<c>", "<d>")], ["<e>"])
    assert read(page).tags == {"div", "table", "caption", "tr", "th", "td", "p"}
    assert read(page).text == "<a><b><c><d><e>"


def test_progress_for_programs_is_a_line_of_json(monkeypatch, capsys):
    """What was finished before, and the time until the first answer, count for no rate; the last line has everything."""
    clock = iter([0.0, 10.0, 10.5, 12.5, 13.0])
    monkeypatch.setattr(terminal, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    with progress_bars(as_json=True) as report:
        for done in (10, 20, 40, 100):
            report("RHC", done, 100)
    first, second, last = map(json.loads, capsys.readouterr().err.splitlines())
    assert first == {"controller": "RHC", "done": 10, "of": 100, "per second": None, "seconds left": None}
    assert second == {"controller": "RHC", "done": 40, "of": 100, "per second": 10.0, "seconds left": 6.0}
    assert last == {"controller": "RHC", "done": 100, "of": 100, "per second": 32.0, "seconds left": 0.0}
