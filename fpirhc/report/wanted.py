"""The pictures that a problem file lists for its report, drawn from the runs of a comparison."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fpirhc.errors import InvalidName
from fpirhc.report.page import picture, text
from fpirhc.simulation.picture import Drawing

if TYPE_CHECKING:
    from fpirhc.simulation.pictures.base import Picture
    from fpirhc.simulation.run import Run
    from fpirhc.studies.comparison.compare import Comparison


def wanted_pictures(comparison: Comparison) -> str:
    """Return the section with the problem's own pictures; empty where there are none."""
    runs = {e.name: e.run for e in comparison.entries if e.run.cycles > 1}
    blocks = [_block(wanted, runs) for wanted in comparison.pictures]
    return f"<section><h2>Pictures of this problem</h2>{''.join(blocks)}</section>" if any(blocks) else ""


def _block(wanted: Picture, runs: dict[str, Run]) -> str:
    """One picture; the reason where it cannot be drawn, nothing where none of its controllers ran."""
    shown = {name: run for name, run in runs.items() if not wanted.controllers or name in wanted.controllers}
    if not shown:
        return ""
    figure = Drawing(figsize=wanted.size(len(shown)), layout="constrained")
    try:
        wanted.draw(figure, shown)
    except InvalidName as error:
        return f"<p>{text(wanted.title)} is not drawn: {text(error)}</p>"
    return picture(figure, f"{wanted.title}: {', '.join(shown)}", f"{wanted.title}. {wanted.caption}".strip())
