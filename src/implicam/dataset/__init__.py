"""Correspondences: read, check, split, join, write."""

from implicam.dataset.model import (
    TRUTH_COLUMNS,
    Camera,
    Dataset,
    Floats,
    KnownPositions,
    Names,
    Observations,
    Truth,
    covariance_from_columns,
    join,
)

__all__ = [
    "TRUTH_COLUMNS",
    "Camera",
    "Dataset",
    "Floats",
    "KnownPositions",
    "Names",
    "Observations",
    "Truth",
    "covariance_from_columns",
    "join",
]
