"""`.plot()` of datasets, measurements and calibrations: a figure for a notebook."""

from __future__ import annotations

from importlib import import_module
from typing import Any


class Plotted:
    """What has a figure."""

    def plot(self) -> Any:
        """An interactive 3D figure, of Plotly: it shows itself in a notebook; `plot().write_html(...)` keeps it.

        Raises:
            MissingExtraError: Plotly is not installed.
        """
        # figures are drawn from the things, so they are above them, and are asked for when a person wants one
        return import_module("implicam.figures.notebook").plot(self)
