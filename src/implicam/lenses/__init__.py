"""Lens models, one file a family: which pixel a point in front of a camera falls on, and which ray a pixel looks along.

`LENSES["kannala-brandt"]` is a family by its name; `Lens` is what each family offers.
"""

from implicam.lenses.base import Bools, DistortionSds, Floats, Lens, fit_lens, focal_lengths
from implicam.lenses.brown_conrady import BrownConrady
from implicam.lenses.kannala_brandt import PERSPECTIVE_K, KannalaBrandt
from implicam.lenses.registry import FIRST_FIELDS, LENSES

__all__ = [
    "FIRST_FIELDS",
    "LENSES",
    "PERSPECTIVE_K",
    "Bools",
    "BrownConrady",
    "DistortionSds",
    "Floats",
    "KannalaBrandt",
    "Lens",
    "fit_lens",
    "focal_lengths",
]
