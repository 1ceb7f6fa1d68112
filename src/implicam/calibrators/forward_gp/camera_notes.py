"""What kind of camera each one is, in words: one line for every camera that is not ordinary."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from implicam.dataset import Camera
from implicam.geometry import Floats
from implicam.rig_model.camera_model import CameraModel
from implicam.rig_model.fit_result import FitResult
from implicam.rig_model.general_camera import SHAPE, TILT, GeneralCamera


def kind_notes(fitted: FitResult, cameras: Sequence[Camera]) -> list[str]:
    """Notes on the cameras that are not ordinary.

    Args:
        fitted: The fitted cameras.
        cameras: What the data say of these, in the same order.

    Returns:
        One for each such camera, and one before them where all are mirrored.
    """
    models = fitted.posterior.models
    mirrored = [isinstance(model.camera, GeneralCamera) and model.camera.mirrored for model in models]
    notes = []
    if all(mirrored):
        notes.append(
            "All pictures are mirrored: is an axis of the known positions negated, or are two exchanged (left-handed)? "
            "Or is v counted from below?"
        )
    for number, (described, model) in enumerate(zip(cameras, models, strict=True)):
        words = _kind(model, fitted.posterior.root(number), sized=described.width is not None)
        if mirrored[number] and not all(mirrored):
            words = ["its pictures are mirrored: it looks through a mirror, or v is counted from below", *words]
        if not words:
            continue
        left = fitted.left_by_ordinary(number)
        without = f". An ordinary camera would leave {left:.2g} px" if np.isfinite(left) else ""
        notes.append(f"{described.name}: {'; '.join(words)}{without}.")
    return notes


MIN_SQUARED_TILT = 40.0
"""Squared distance of shape and tilt (four numbers) from those of an ordinary camera, from which a note says that they
are others: a kind that was chosen because it leaves less is farther off than chance has it."""


def _is_tilted(camera: GeneralCamera, root: Floats) -> bool:
    """Whether pixels and image plane are others than those of an ordinary camera, beyond what is unknown of them."""
    own = slice(SHAPE.start, TILT.stop)
    found, part = camera.parameters[own], root[:, own]
    size = np.linalg.norm(part, axis=0)
    if not (size > 0).all():  # nothing is known of errors
        return True
    unit, within = found / size, (part / size).T @ (part / size)
    return bool(unit @ np.linalg.solve(within + 1e-9 * np.eye(len(unit)), unit) > MIN_SQUARED_TILT)


def _kind(model: CameraModel, root: Floats, sized: bool) -> list[str]:
    camera = model.camera
    if model.family == "none":
        return ["no lens model predicts its views as well as a linear projection and a smooth field do"]
    if not isinstance(camera, GeneralCamera) or model.family == "ordinary":
        return []
    aspect = float(np.exp(-2 * camera.shape[0]))
    off = float(np.linalg.norm(camera.centre - model.image.centre))
    if model.family == "aspect":
        return [f"its pixels are not square, fy / fx = {aspect:.4g}"]
    if model.family == "crop" and not sized:
        return [
            f"its lens looks past the middle of what it saw, by {off:.0f} px: state the size of its images (--size), "
            "and where their middle is need not be guessed"
        ]
    if model.family == "crop":
        return [f"its lens looks past the middle of the image, by {off:.0f} px"]
    if not _is_tilted(camera, root):
        return []
    return [f"tilted sensor or oblique window (fy / fx = {aspect:.3g}, principal point {off:.0f} px off the middle)"]
