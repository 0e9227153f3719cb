"""The parts of every HTML report: one self-contained file with its styles, scripts and pictures inside."""

from __future__ import annotations

import base64
import html
import io
import tempfile
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from fpirhc.errors import OutputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def page(title: str, styles: Sequence[str], body: str, scripts: str = "") -> str:
    """Return a page's text.

    Args:
        title: title of the page.
        styles: names of assets with styles.
        body: body of the page, HTML.
        scripts: scripts of the page, HTML.
    """
    head = "\n".join(f"<style>{asset(name)}</style>" for name in styles)
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{text(title)}</title>\n{head}</head>\n<body><main>{body}</main>\n{scripts}</body></html>\n"
    )


def write_page(content: str, path: Path) -> None:
    """Write a page, atomically: the file is complete or not there.

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
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=88)
    code = base64.b64encode(buffer.getvalue()).decode("ascii")
    note = f"<figcaption>{text(caption)}</figcaption>" if caption else ""
    return f"<figure><img alt='{text(alt)}' src='data:image/png;base64,{code}'>{note}</figure>"
