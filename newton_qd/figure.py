"""A figure that a notebook shows without pyplot.

Functions that draw import this module when they run: it needs matplotlib.
"""

from __future__ import annotations

import io

from matplotlib.figure import Figure  # noqa: TID253 - see above


class NotebookFigure(Figure):
    """A figure without a window; as the value of a cell, a notebook shows it.

    Jupyter shows a plain ``Figure`` only after pyplot was used.
    """

    def _repr_png_(self) -> bytes:
        """Returns the picture, for a notebook."""
        content = io.BytesIO()
        self.savefig(content, format="png")
        return content.getvalue()
