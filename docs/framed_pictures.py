"""A Sphinx extension that frames the pictures of the gallery, so that a narrow screen can move each of them sideways.

A picture of 800 pixels that is squeezed into 350 has letters of six. `_static/gallery.css` keeps its width on a phone; without a
frame the whole page would move with it.
"""

from __future__ import annotations

from typing import Any

from docutils import nodes
from sphinx_gallery.directives import imgsgnode


def framed(app: Any, doctree: nodes.document) -> None:  # noqa: ARG001
    """Put a frame of the class `picture` around every picture that stands between paragraphs."""
    for picture in list(doctree.findall(imgsgnode)):
        if isinstance(picture.parent, nodes.section):
            picture.replace_self(nodes.container("", picture.deepcopy(), classes=["picture"]))


def setup(app: Any) -> dict[str, Any]:
    """Connect where a page has been read."""
    app.connect("doctree-read", framed)
    return {"parallel_read_safe": True}
