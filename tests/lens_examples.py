"""Examples of each family of lenses, for the contract that runs over all of them; a new family needs two or three."""

from __future__ import annotations

import numpy as np

from implicam.lenses import BrownConrady, KannalaBrandt, Lens
from toy_lens import Equisolid

EXAMPLES: dict[str, dict[str, Lens]] = {
    BrownConrady.family: {
        "pinhole": BrownConrady(900.0, 910.0, 640.0, 400.0),
        "barrel": BrownConrady(930.0, 935.0, 651.0, 392.0, -0.1, 0.02, 4e-4, -3e-4, 0.001),
        "folding": BrownConrady(930.0, 935.0, 651.0, 392.0, -0.3, 0.02, 2e-3, -1e-3, 0.0),
        "pincushion": BrownConrady(1200.0, 1200.0, 640.0, 512.0, 0.2, 0.05, 0.0, 1e-4, 0.01),
    },
    KannalaBrandt.family: {
        "equidistant": KannalaBrandt(430.0, 432.0, 640.0, 400.0),
        "fisheye": KannalaBrandt(433.0, 431.0, 630.0, 405.0, -0.02, 0.004, -1e-3, 2e-4),
        "folding fisheye": KannalaBrandt(433.0, 431.0, 630.0, 405.0, -0.15, 0.01, 0.0, 0.0),
    },
    Equisolid.family: {
        "equisolid": Equisolid(433.0, 431.0, 630.0, 405.0, -0.02, 0.004, -1e-3, 2e-4),
        "folding equisolid": Equisolid(433.0, 431.0, 630.0, 405.0, -0.15),
    },
}
"""Family -> what kind -> the lens."""

WIDEST_RAD = {BrownConrady.family: np.radians(55)}
"""Up to there `nearest` of a family must find a lens, where it is not for all that the lens sees: a perspective lens
has its k3 and its decentring from the fit that comes after."""
