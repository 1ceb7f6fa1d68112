"""Cameras whose lens is known from boards that each saw alone, placed by known points.

The lens that the boards found, with its covariance, is the prior; the known points fix the pose, and refine the lens by
what they can. The equations are those of from_points.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from implicam.calibrators.explicit.camera_groups import CameraGroup
from implicam.calibrators.explicit.from_points import refined
from implicam.calibrators.explicit.settings import ExplicitSettings
from implicam.calibrators.explicit.start import median_pixel_error
from implicam.errors import FitError
from implicam.geometry import Bools, Floats, Pose, poses_from_rays
from implicam.progress import Progress
from implicam.rig_model import (
    CentralCamera,
    FitResult,
    Hyperparameters,
    InitialCamera,
    Posterior,
    Prior,
    TrainingData,
    levenberg_marquardt,
)

MIN_POINTS = 4
"""Known points that place a camera whose lens is known: three leave up to four places."""

RANDOM_SUBSETS = 30
"""Random sets of five points; with a third of the views wrong, four of them are clean."""


def place(
    training: TrainingData, groups: Mapping[int, CameraGroup], settings: ExplicitSettings, progress: Progress
) -> FitResult:
    """The cameras of groups of one camera, placed by known points; there may be none.

    Args:
        training: What all cameras saw of the known points.
        groups: The groups of one camera, by its number.
        settings: Priors and thresholds.
        progress: Is told how far it is.

    Returns:
        The fit of those that could be placed, in the working frame; and why the others could not.
    """
    stated = training.stated.copy()
    started: dict[int, InitialCamera] = {}
    uncalibrated: list[tuple[int, str]] = []
    images = list(training.images)
    for c, group in groups.items():
        seen, images[c] = training.camera_views[c], group.images[0]
        if not np.isfinite(stated[c]):
            stated[c] = group.bundle.noise[0]  # until the residuals of the known points say more
        try:
            started[c] = _placed(group, training.points[seen.rows], seen.uv)
        except FitError as error:
            uncalibrated.append((c, error.what))
    training = replace(training, stated=stated, images=tuple(images))
    if not started:
        none = Hyperparameters(np.ones(2), np.zeros(0), np.zeros(0))
        return FitResult(Posterior((), (), None, (), 0.0), (), tuple(uncalibrated), (), none, None, None)
    return refined(training, started, uncalibrated, settings, progress)


def _placed(group: CameraGroup, points: Floats, uv: Floats) -> InitialCamera:
    """The camera of a group of one, in the place from which it sees points (n, 3) at uv (n, 2)."""
    known, sd, half = group.bundle.cameras[0], float(group.bundle.noise[0]), group.images[0].half
    settings = group.bundle.settings
    rays, valid = known.lens.ray_from_pixel(uv)
    _check_spread(points[valid], settings)
    prior = _prior(group)
    found = _best(known, prior, points, uv, rays, valid, sd, settings)
    left = median_pixel_error(found[0][0], points, uv) if found else np.inf
    if left > max(settings.max_start_error_medians * sd, settings.min_mirrored_error_half_sides * half):
        _check_mirror(known, prior, points, uv, rays, valid, sd, left, settings)
    if not found:
        raise FitError("from no place does its lens see the known points at these pixels.")
    (camera, inliers), *others = found
    error = np.linalg.norm(camera.pixel(points) - uv, axis=1)
    if not np.median(error) < settings.max_place_error_half_sides * half or inliers.sum() < MIN_POINTS:
        raise FitError(
            f"with the lens from its boards, the known points are left {np.median(error):.3g} px off: they are not "
            "where they are said to be, or its pictures are of another size or another zoom."
        )
    usual = max(sd, float(np.sqrt(np.mean(error[inliers] ** 2) / 2)))
    for other, _ in others:
        more = np.sum((other.pixel(points[inliers]) - uv[inliers]) ** 2) - np.sum(error[inliers] ** 2)
        apart = np.linalg.norm(other.pose.centre - camera.pose.centre) / np.linalg.norm(camera.pose.translation)
        if more < settings.max_second_place_chi_squared * usual**2 and apart > 0.02:
            raise FitError(
                f"its {int(inliers.sum())} known points place it in two ways: show it more, spread out in depth."
            )
    return InitialCamera(camera, prior, inliers)


def _check_mirror(
    known: CentralCamera,
    prior: Prior,
    points: Floats,
    uv: Floats,
    rays: Floats,
    valid: Bools,
    sd: float,
    left: float,
    settings: ExplicitSettings,
) -> None:
    """FitError where known points seen in a mirror would fit."""
    other = points * np.array([1.0, 1.0, -1.0])
    found = _best(known, prior, other, uv, rays, valid, sd, settings)
    mirrored = median_pixel_error(found[0][0], other, uv) if found else np.inf
    if mirrored < settings.max_mirrored_ratio * left:
        raise FitError(
            f"it sees the known points as in a mirror: as they are {left:.3g} px are left, mirrored {mirrored:.2g} px. "
            "Are its pictures flipped, or is v counted from below, or are the known positions left-handed?"
        )


def _check_spread(points: Floats, settings: ExplicitSettings) -> None:
    if len(points) < MIN_POINTS:
        raise FitError(
            f"{len(points)} known points are seen; with the lens from its boards it takes {MIN_POINTS} to place it."
        )
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if extents[1] < settings.min_width_ratio * extents[0]:
        raise FitError(f"its {len(points)} known points lie on one line, which does not place it.")


def _prior(group: CameraGroup) -> Prior:
    """What the boards say of the lens; nothing of the pose."""
    camera = group.bundle.cameras[0]
    p = camera.size - 6
    precision = np.zeros((camera.size, camera.size))
    root = group.root[:, :p]
    scale = np.sqrt(np.sum(root**2, axis=0))
    precision[:p, :p] = np.linalg.inv((root / scale).T @ (root / scale)) / scale[:, None] / scale
    return Prior(camera.parameters, precision)


def _best(
    known: CentralCamera,
    prior: Prior,
    points: Floats,
    uv: Floats,
    rays: Floats,
    valid: Bools,
    sd: float,
    settings: ExplicitSettings,
) -> list[tuple[CentralCamera, Bools]]:
    """Places, the best first, and the views (n,) that agree with each: from all points, and from a few of them where
    all do not agree."""
    most = settings.max_start_error_medians
    starts = _poses(points, rays, valid)
    found = [_refined(replace(known, pose=pose), prior, points, uv, valid, sd, most) for pose in starts]
    off = min((median_pixel_error(camera, points, uv) for camera, _ in found), default=np.inf)
    good = np.flatnonzero(valid)
    if off > most * sd and len(good) > MIN_POINTS + 1:
        rng = np.random.default_rng(0)
        some = np.zeros(len(points), dtype=np.bool_)
        for _ in range(RANDOM_SUBSETS):
            some[:] = False
            some[rng.choice(good, MIN_POINTS + 1, replace=False)] = True
            for pose in _poses(points, rays, some)[:1]:
                camera = replace(known, pose=pose)
                error = np.linalg.norm(camera.pixel(points) - uv, axis=1)
                near = valid & (error <= np.nanquantile(error, 0.6))
                if near.sum() >= MIN_POINTS:
                    found.append(_refined(camera, prior, points, uv, np.asarray(near), sd, most))
    return sorted(found, key=lambda one: median_pixel_error(one[0], points, uv))


def _poses(points: Floats, rays: Floats, some: Bools) -> list[Pose]:
    return poses_from_rays(points[some], rays[some])[:4]


def _refined(
    camera: CentralCamera, prior: Prior, points: Floats, uv: Floats, inliers: Bools, sd: float, most: float
) -> tuple[CentralCamera, Bools]:
    """Levenberg-Marquardt on the views kept, and again without those that are off more than `most` times the
    others."""
    for _ in range(4):
        usual = max(sd, median_pixel_error(camera, points[inliers], uv[inliers]))
        if not np.isfinite(usual):
            break
        fitted = levenberg_marquardt(camera, prior, points[inliers], uv[inliers], usual)
        assert isinstance(fitted, CentralCamera)
        camera = fitted
        error = np.linalg.norm(camera.pixel(points) - uv, axis=1)
        typical = max(float(np.median(error[inliers])), sd)
        inside = np.asarray(error <= most * typical)
        if inside.sum() < MIN_POINTS or (inside == inliers).all():
            break
        inliers = inside
    return camera, inliers
