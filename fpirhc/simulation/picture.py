"""A figure that notebooks show with any back end; it chooses no back end and opens no window."""

from __future__ import annotations

import io

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imsave

_DOTS = 88  # per inch


def png(figure: Figure) -> bytes:
    """Return the picture of a figure; `savefig` would draw it twice, once for nothing but its layout."""
    figure.set_dpi(_DOTS)
    canvas, buffer = FigureCanvasAgg(figure), io.BytesIO()
    canvas.draw()
    imsave(buffer, canvas.buffer_rgba(), format="png", dpi=_DOTS)
    return buffer.getvalue()


class Drawing(Figure):
    """A matplotlib Figure with a picture for notebooks."""

    def _repr_png_(self) -> bytes:
        """The picture as PNG; notebooks call this method."""
        return png(self)
