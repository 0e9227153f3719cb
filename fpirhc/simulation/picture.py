"""A figure that notebooks show with any back end; it chooses no back end and opens no window."""

from __future__ import annotations

import io

from matplotlib.figure import Figure


class Drawing(Figure):
    """A matplotlib Figure with a picture for notebooks."""

    def _repr_png_(self) -> bytes:
        """The picture as PNG; notebooks call this method."""
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", dpi=88)
        return buffer.getvalue()
