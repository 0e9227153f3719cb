"""HTML reports: one self-contained file with its styles, scripts and pictures inside, from a template and a view."""

from __future__ import annotations

import base64
import hashlib
import json
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from fpirhc.simulation.picture import png
from fpirhc.studies.comparison.outcome import Outcome

if TYPE_CHECKING:
    from jinja2 import Environment
    from matplotlib.figure import Figure

    from fpirhc.studies.view import View


@dataclass(frozen=True)
class Image:
    """A picture inside a page; one that cannot be drawn has no source, and its caption says why."""

    source: str
    alt: str
    caption: str


def render_page(name: str, view: View, scripts: Sequence[str] = (), **context: Any) -> str:
    """Return a page's text.

    The page loads nothing from anywhere, and a browser that reads its content security policy also refuses to: it runs the
    page's own scripts alone, which are named by their hashes, and shows pictures that are inside the page.

    Args:
        name: of the template.
        view: what the page says.
        scripts: texts of the page's scripts, which run in this order after those of every page.
        context: further values for the template.
    """
    from markupsafe import Markup

    every = [Markup(script) for script in (asset("table.js"), *scripts)]
    styles = [Markup(asset(style)) for style in ("uPlot.min.css", "report.css")]
    template = _environment().get_template(name)
    return template.render(view=view, policy=Markup(_policy(every)), styles=styles, scripts=every, **context)


@cache
def blocks(text: str) -> list[tuple[bool, str]]:
    """Return the paragraphs of a description, each with whether it is set as written, as indented equations and tables are."""
    found = (block for block in textwrap.dedent(text).strip().split("\n\n") if block.strip())
    return [(True, textwrap.dedent(b)) if b.startswith("  ") else (False, " ".join(b.split())) for b in found]


def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader(__package__)
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    environment.filters |= {
        "css_class": css_class,
        "blocks": blocks,
        "indented": lambda value: json.dumps(value, indent=1),
    }
    return environment


def css_class(outcome: Outcome | None) -> str:
    """Return the class of a sentence: green is better, red worse, amber mixed or doubtful."""
    return "remark" if outcome is None else f"outcome-{outcome.value.replace(' ', '-')}"


def _policy(scripts: Sequence[str]) -> str:
    """Content security policy that allows these scripts, the styles inside the page, and pictures inside the page."""
    hashes = (base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii") for script in scripts)
    code = " ".join(f"'sha256-{one}'" for one in hashes)
    return (
        f"default-src 'none'; script-src {code}; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; "
        "form-action 'none'"
    )


def picture(figure: Figure, alt: str, caption: str = "") -> Image:
    """Return a figure as a picture inside the page."""
    return Image(f"data:image/png;base64,{base64.b64encode(png(figure)).decode('ascii')}", alt, caption)


def asset(name: str) -> str:
    """Return the text of a style or script."""
    return files("fpirhc.report").joinpath("assets", name).read_text(encoding="utf-8")
