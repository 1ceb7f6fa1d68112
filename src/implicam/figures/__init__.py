"""Data in, figure out; computes nothing but what a drawing needs.

Plotly draws for pages, matplotlib for paper; both are imported when a figure is asked for. Colours are Okabe & Ito's
(2008), and the sequential scale is cividis (Nuñez et al. 2018): both readable with any colour vision and in grey.
"""

from implicam.figures.calibration_plots import error_against_sd, reliability
from implicam.figures.compared import compare_figure
from implicam.figures.scene_figure import scene

__all__ = ["compare_figure", "error_against_sd", "reliability", "scene"]
