"""A figure that notebooks show with any back end; it opens no window. Nothing else imports matplotlib when it is imported."""

from __future__ import annotations

import io
from base64 import b64encode

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imsave

_DOTS = 88  # per inch
_LEVEL = 4  # of compression: as small as the usual one within 2 %, in two thirds of its time


class Drawing(Figure):
    """A matplotlib Figure with a picture for notebooks and pages."""

    def _repr_png_(self) -> bytes:
        """The picture as PNG; notebooks call this method. `savefig` would draw it twice, once for nothing but its layout."""
        self.set_dpi(_DOTS)
        canvas, buffer = FigureCanvasAgg(self), io.BytesIO()
        canvas.draw()
        imsave(buffer, canvas.buffer_rgba(), format="png", dpi=_DOTS, pil_kwargs={"compress_level": _LEVEL})
        return buffer.getvalue()

    @property
    def address(self) -> str:
        """The picture as the address of an image inside a page."""
        return f"data:image/png;base64,{b64encode(self._repr_png_()).decode('ascii')}"
