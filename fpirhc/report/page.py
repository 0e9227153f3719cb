"""The parts of every HTML report: one self-contained file with its styles, scripts and pictures inside."""

from __future__ import annotations

import base64
import hashlib
import html
import tempfile
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from fpirhc.errors import OutputError
from fpirhc.simulation.picture import png

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def page(title: str, styles: Sequence[str], body: str, scripts: Sequence[str] = ()) -> str:
    """Return a page's text.

    The page loads nothing from anywhere, and a browser that reads its content security policy also refuses to: it runs the
    page's own scripts alone, which are named by their hashes, and shows pictures that are inside the page.

    Args:
        title: title of the page.
        styles: names of assets with styles.
        body: body of the page, HTML.
        scripts: texts of the page's scripts, which run in this order after those of every page.
    """
    head = "\n".join(f"<style>{asset(name)}</style>" for name in styles)
    every = [asset("table.js"), *scripts]
    code = "\n".join(f"<script>{script}</script>" for script in every)
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_policy(every)}">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{text(title)}</title>\n{head}</head>\n<body><main>{body}</main>\n{code}</body></html>\n"
    )


def _policy(scripts: Sequence[str]) -> str:
    """Content security policy that allows these scripts, the styles inside the page, and pictures inside the page."""
    hashes = (base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii") for script in scripts)
    code = " ".join(f"'sha256-{one}'" for one in hashes)
    return (
        f"default-src 'none'; script-src {code}; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; "
        "form-action 'none'"
    )


def wide_table(head: Sequence[str], rows: str, label: str) -> str:
    """Return a table that scrolls sideways inside the page, with a hint that is shown where it does not fit.

    Args:
        head: headings, text.
        rows: rows of the body, HTML.
        label: what the table holds, for screen readers.
    """
    top = "".join(f"<th scope='col'>{text(h)}</th>" for h in head)
    return (
        "<p class='more' hidden>The table goes on to the right: scroll it sideways. &rarr;</p>"
        f"<div class='scroll' tabindex='0' role='region' aria-label='{text(label)}'>"
        f"<table><thead><tr>{top}</tr></thead><tbody>{rows}</tbody></table></div>"
    )


def write_page(content: str, path: Path) -> None:
    """Write a page or another text, atomically: the file is complete or not there.

    Raises:
        OutputError: the file cannot be written.
    """
    try:
        with tempfile.NamedTemporaryFile("w", encoding="utf-8", dir=path.parent, suffix=".part", delete=False) as file:
            file.write(content)
        Path(file.name).replace(path)
        path.chmod(0o644)
    except OSError as error:
        raise OutputError(f"cannot write the report to '{path}': {error.strerror}") from None


def asset(name: str) -> str:
    """Return the text of a style or script."""
    return files("fpirhc.report").joinpath("assets", name).read_text(encoding="utf-8")


def text(value: object) -> str:
    """Return a value as text for a page."""
    return html.escape(str(value), quote=True)


def picture(figure: Figure, alt: str, caption: str) -> str:
    """Return a figure as a picture inside the page."""
    code = base64.b64encode(png(figure)).decode("ascii")
    note = f"<figcaption>{text(caption)}</figcaption>" if caption else ""
    return f"<figure><img alt='{text(alt)}' src='data:image/png;base64,{code}'>{note}</figure>"
