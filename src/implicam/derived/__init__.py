"""What follows from measured points: distances, angles, planes, spheres, cylinders, motions, each with its uncertainty.

Points measured with one calibration share its errors, so their covariances do not simply add up: two near points are
off together, and their distance is better known than either. Everything here takes a `Measurement`, as the calibration
gave it, because it knows what its errors share.
"""

from implicam.derived.features import (
    Cylinder,
    Motion,
    Plane,
    Sphere,
    fit_cylinder,
    fit_motion,
    fit_plane,
    fit_sphere,
)
from implicam.derived.joint_positions import JointPositions, joint
from implicam.derived.quantities import JointDistances, Quantity, angle, distance, distances, joint_distances

__all__ = [
    "Cylinder",
    "JointDistances",
    "JointPositions",
    "Motion",
    "Plane",
    "Quantity",
    "Sphere",
    "angle",
    "distance",
    "distances",
    "fit_cylinder",
    "fit_motion",
    "fit_plane",
    "fit_sphere",
    "joint",
    "joint_distances",
]
