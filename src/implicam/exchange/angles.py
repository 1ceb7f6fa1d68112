"""The three angles of photogrammetry: R = Rx(omega) Ry(phi) Rz(kappa), as OpenPTV and MyPTV keep rotations."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from implicam.lenses import Floats

POLE_SINE = 1.0 - 1e-14
"""A sine of phi beyond is a pole: omega and kappa are not told apart there, and kappa is zero."""


def rotation_from_angles(angles: Floats) -> Floats:
    """The matrix of three angles.

    Args:
        angles: (3,) omega, phi, kappa in radians.

    Returns:
        (3, 3).
    """
    return np.asarray(Rotation.from_euler("XYZ", angles).as_matrix(), dtype=np.float64)


def angles_from_rotation(rotation: Floats) -> Floats:
    """The angles of a matrix; the inverse of `rotation_from_angles`.

    Args:
        rotation: (3, 3).

    Returns:
        (3,) omega, phi, kappa in radians.
    """
    r = rotation
    phi = np.arctan2(r[0, 2], np.hypot(r[0, 0], r[0, 1]))
    if abs(r[0, 2]) > POLE_SINE:
        return np.array([np.arctan2(r[2, 1], r[1, 1]), phi, 0.0])
    return np.array([np.arctan2(-r[1, 2], r[2, 2]), phi, np.arctan2(-r[0, 1], r[0, 0])])
