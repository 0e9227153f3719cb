"""Checks that a built site loads nothing from elsewhere: python docs/check_offline.py docs/_build/html"""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import urlsplit

LOADS = {
    "script": "src",
    "img": "src",
    "link": "href",
    "iframe": "src",
    "source": "src",
    "video": "src",
    "object": "data",
}
LINKS = {
    "canonical",
    "index",
    "search",
    "next",
    "prev",
    "author",
    "copyright",
    "help",
    "license",
}  # relations that load nothing
FETCHES = re.compile(r"""(?:url\(|@import\s+)["']?((?:https?:)?//[^"')\s]+)""")  # of a style sheet


class Loads(HTMLParser):
    """Addresses from which a page loads a part of itself, in `addresses`."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note what the tag loads."""
        values = dict(attrs)
        relation = set((values.get("rel") or "").split())
        address = values.get(LOADS.get(tag, ""))
        if address and not (relation & LINKS):
            self.addresses.append(address)


def elsewhere(page: str) -> list[str]:
    """Return the addresses outside of the site from which a page loads something."""
    loads = Loads()
    loads.feed(page)
    parts = [(address, urlsplit(address)) for address in loads.addresses]
    return [address for address, one in parts if one.netloc or one.scheme not in ("", "data")]


def main(folder: Path) -> int:
    """Print every such address with its page, and return the exit code."""
    pages = sorted(folder.rglob("*.html"))
    styles = sorted(folder.rglob("*.css"))
    fetched = [(page, address) for page in pages for address in elsewhere(page.read_text(encoding="utf-8"))]
    fetched += [(style, address) for style in styles for address in FETCHES.findall(style.read_text(encoding="utf-8"))]
    for page, address in fetched:
        print(f"{page.relative_to(folder)} loads {address}", file=sys.stderr)
    print(f"{len(pages)} pages, {len(fetched)} parts from elsewhere")
    return 1 if fetched or not pages else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
