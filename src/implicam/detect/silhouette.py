"""From the middle of a ball's picture to the picture of its middle.

A camera sees the outline of a ball, and the middle of the outline is not where the ball's middle falls: off the axis
they are a few tenths of a pixel apart for a large ball that is near. Once a calibration exists the outline of a ball at
a known place can be predicted through it, and so can the difference.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from implicam.calibrators import ForwardGP, PredictsPixels
from implicam.dataset import Dataset, Floats, Observations
from implicam.detect.edge import Ellipse, fit_ellipse
from implicam.errors import FitError, UsageError

MAX_OFF_PX = 0.5
"""Pixels that the middle of an outline may be off when a ball is placed for the first time."""

OUTLINE_POINTS = 16
"""Points of an outline: 48 change its middle by 1e-12 px."""

MIN_POINTS = 10
"""Known points from which a calibration is good enough: the difference follows from where cameras are, roughly."""


def correct_outlines(
    data: Dataset, radius: float, calibration: PredictsPixels | None = None
) -> tuple[Dataset, list[str]]:
    """The observations moved from the middle of each outline to the ball's middle.

    Args:
        data: Observations of the middles of outlines.
        radius: Of the ball, in the dataset's unit.
        calibration: Of the rig; without one, one is fitted to the known positions of the dataset.

    Returns:
        The dataset, in which the outline's own middle stays as the columns outline_u, outline_v, and notes for the
        person. Data that cannot be corrected come back as they are, with a note that says why.

    Raises:
        UsageError: The radius is not positive.
    """
    if not (np.isfinite(radius) and radius > 0):
        raise UsageError(f"a ball has no radius {radius:g}.", fix=f"give it in {data.length_unit}, for example 8")
    if calibration is not None:
        xyz = calibration.measure(_widen_error_bars(data.observations)).xyz
    else:
        try:
            calibration, xyz = _fit_own(data), data.xyz
        except FitError as error:
            return data, [f"the pixels are those of the ball's outline, not of its middle: {error.what}"]
    shift = predict_outline_shift(calibration, xyz, radius, data.observations.camera_names)
    usable = np.asarray(np.isfinite(shift).all(axis=2))
    seen = data.observations.seen
    moved = data.observations.uv - np.where(usable[..., None], shift, 0)
    size = np.linalg.norm(shift[seen & usable], axis=1)
    notes = []
    if size.size:
        notes.append(f"the ball's middle is up to {size.max():.2g} px from the middle of its outline: corrected.")
    if (seen & ~usable).any():
        notes.append(f"{int((seen & ~usable).sum())} views could not be corrected: no position is known for them.")
    return replace(data, observations=_move_pixels(data.observations, moved, seen)), notes


def _widen_error_bars(observations: Observations) -> Observations:
    """The same, with error bars that allow for what is to be corrected: views must not contradict each other for it."""
    own = np.where(observations.seen[..., None], np.nan_to_num(observations.sd), np.nan)
    return replace(observations, sd=np.hypot(own, MAX_OFF_PX))


def _fit_own(data: Dataset) -> PredictsPixels:
    if data.known is None:
        raise FitError("there is no calibration yet; give one with --calibration once there is.")
    if len(data) < MIN_POINTS:
        raise FitError(f"{len(data)} known positions are too few for a calibration.")
    return ForwardGP().fit(data)


def predict_outline_shift(calibration: PredictsPixels, xyz: Floats, radius: float, cameras: tuple[str, ...]) -> Floats:
    """How far the middle of a ball's outline is from the picture of the ball's middle.

    Args:
        calibration: Of the rig.
        xyz: (n, 3) the ball's middle, in the world frame and the calibration's unit; NaN where it is not known.
        radius: Of the ball, in the same unit.
        cameras: Names.

    Returns:
        (n, cameras, 2) pixels; NaN where the camera is not calibrated, or the outline cannot be predicted.
    """
    trained = calibration.trained.camera_names
    shift = np.full((len(xyz), len(cameras), 2), np.nan)
    there = np.isfinite(xyz).all(axis=1)
    middle = calibration.predict(xyz[there])
    for k, name in enumerate(cameras):
        if name not in calibration.camera_names:
            continue
        c = trained.index(name)
        centre, _ = calibration.lines_of_sight(name, np.zeros((1, 2)))
        outline = calibration.predict(_predict_outlines(xyz[there], centre, radius).reshape(-1, 3))[:, c]
        for i, curve, pixel in zip(
            np.flatnonzero(there), outline.reshape(-1, OUTLINE_POINTS, 2), middle[:, c], strict=True
        ):
            if np.isfinite(curve).all() and np.isfinite(pixel).all():
                shift[i, k] = _fit_centre(curve) - pixel
    return shift


def _fit_centre(curve: Floats) -> Floats:
    """Of the ellipse that fits an outline best: what the detector finds of it."""
    centre = curve.mean(axis=0)
    size = float(np.sqrt(np.mean(np.sum((curve - centre) ** 2, axis=1))))
    return fit_ellipse(curve, Ellipse(centre, np.eye(2) / size)).centre


def _predict_outlines(xyz: Floats, centre: Floats, radius: float) -> Floats:
    """(n, OUTLINE_POINTS, 3) where the lines of sight from `centre` (3,) touch balls at xyz (n, 3): circles."""
    towards = xyz - centre
    distance = np.linalg.norm(towards, axis=1, keepdims=True)
    axis = towards / distance
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis), axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(axis, first)
    part = np.minimum(radius / distance, 0.99)
    angle = np.arange(OUTLINE_POINTS) * (2 * np.pi / OUTLINE_POINTS)
    around = np.cos(angle)[:, None] * first[:, None] + np.sin(angle)[:, None] * second[:, None]
    middle = xyz - radius * part * axis
    return np.asarray(middle[:, None] + (radius * np.sqrt(1 - part**2))[:, None] * around, dtype=np.float64)


def _move_pixels(observations: Observations, moved: Floats, seen: np.ndarray) -> Observations:
    extra = dict(observations.extra)
    for k, name in enumerate(("outline_u", "outline_v")):
        flat = [repr(float(x)) if s else "" for x, s in zip(observations.uv[..., k].ravel(), seen.ravel(), strict=True)]
        extra[name] = np.array(flat, dtype=np.str_).reshape(seen.shape)
    return replace(observations, uv=moved, extra=extra)
