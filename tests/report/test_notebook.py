"""Results show themselves, and names that a user chose are shown as they are, wherever they are shown."""

from __future__ import annotations

from html.parser import HTMLParser

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
