"""A figure that shows itself in a notebook, whatever back end is in use there; none is chosen and no window is opened."""

from __future__ import annotations

import io

from matplotlib.figure import Figure


class Drawing(Figure):
    """A matplotlib Figure that knows its picture."""

    def _repr_png_(self) -> bytes:
        """The picture, as notebooks ask for it."""
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", dpi=88)
        return buffer.getvalue()
