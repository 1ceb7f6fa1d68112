"""The families of lenses, by the names that stand in calibration files and on the command line."""

from __future__ import annotations

from implicam.lenses.base import Lens
from implicam.lenses.brown_conrady import BrownConrady
from implicam.lenses.kannala_brandt import KannalaBrandt
from implicam.registry import Registry

LENSES: Registry[type[Lens]] = Registry(
    "lens",
    {
        BrownConrady.family: BrownConrady,
        KannalaBrandt.family: KannalaBrandt,
    },
    "implicam.lenses",
)
"""Family -> its class."""
