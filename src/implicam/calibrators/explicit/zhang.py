"""One camera from pictures of a flat board at unknown places: Zhang's method, for any lens.

Zhang 2000, "A flexible new technique for camera calibration", takes pixels of a pinhole. Here a ladder of lenses
(geometry.candidate_rays) turns pixels into rays first: board -> ray is a homography for the right lens, whatever the
lens, and the wrong ones fit worse. The best rung starts a bundle adjustment of lens and board poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from implicam.calibrators.explicit.adjust import (
    Adjusted,
    Bundle,
    Placed,
    Views,
    adjust,
    adjust_in_steps,
    log_marginal,
    spreads,
)
from implicam.calibrators.explicit.boards import BoardView, renumbered
from implicam.calibrators.explicit.lenses import START_FAMILY, Choice, angles, choose_lens, clipped, with_lens
from implicam.calibrators.explicit.pixels import (
    ASPECTS,
    Pixels,
    kinds,
    log_density_at_peak,
    noise_prior,
    prior_of,
    square,
)
from implicam.calibrators.explicit.settings import DEFAULT_SETTINGS, ExplicitSettings
from implicam.errors import FitError
from implicam.geometry import Bools, Floats, Pose, candidate_rays, rotation_from_vector
from implicam.lenses import PERSPECTIVE_K, KannalaBrandt
from implicam.rig_model import CentralCamera, Image, Prior

RANDOM_SUBSETS = 40
"""Random sets of eight corners; with a fifth of the corners wrong, seven of them are clean."""


class OneCamera(NamedTuple):
    """A camera at the origin of its own frame, camera_from_board of its boards, its noise in pixels, and what its
    pixels are like."""

    camera: CentralCamera
    boards: Placed
    noise: float
    pixels: Pixels


class _Candidate(NamedTuple):
    adjusted: Adjusted
    pixels: Pixels

    @property
    def bundle(self) -> Bundle:
        return self.adjusted.bundle


def calibrate_camera(
    views: Sequence[BoardView], image: Image, family: str, settings: ExplicitSettings = DEFAULT_SETTINGS
) -> tuple[OneCamera, Choice]:
    """A camera from its views of boards, and the lens model it got.

    Args:
        views: Of this camera alone.
        image: Where its pixels are measured from.
        family: Name of the lens, or `auto`.
        settings: Priors and thresholds.

    Returns:
        The camera at the origin of its own frame, with boards counted from 0; and which lens it got.

    Raises:
        FitError: The boards do not fix a lens.
    """
    own, _ = renumbered([replace(view, camera=0) for view in views])
    first = _with_pixels(_starts(own, image, settings), Views(own, 1), image, settings)
    left = float(spreads(first.bundle)[0])
    if not left < settings.max_board_start_error_half_sides * image.half:
        raise FitError(
            f"no lens explains the corners of its {len(own)} boards: the best of all fits leaves {left:.3g} px.",
            fix="look at the overlays of its pictures (detections/), and take out those with wrong corners",
        )

    def with_family(name: str) -> _Candidate:
        if name == START_FAMILY:
            return first
        camera = with_lens(first.bundle.cameras[0], name, first.bundle.corners(0))
        return _with_pixels([(camera, first.bundle.boards)], first.bundle.views, image, settings)

    found, choice = choose_lens(
        family, with_family, lambda one: _held_out(one.adjusted), settings.max_start_error_medians
    )
    one = OneCamera(found.bundle.cameras[0], found.bundle.boards, float(spreads(found.bundle)[0]), pixels=found.pixels)
    return one, choice._replace(pixels=found.pixels.name)


def _with_pixels(
    starts: Sequence[tuple[CentralCamera, Placed]], views: Views, image: Image, settings: ExplicitSettings
) -> _Candidate:
    """Adjusted with each prior of the pixels that may be right, and of these the most probable one. starts: with square
    pixels, and with others where they fit better."""
    usual, *between, widest = kinds(square(settings), settings)

    def fitted(pixels: Pixels, camera: CentralCamera, boards: Placed) -> _Candidate:
        found = _adjusted(camera, boards, views, image, pixels, settings)
        better = placed_again(found.bundle)
        if better is not None:
            found = _adjusted(better.cameras[0], better.boards, better.views, image, pixels, settings)
        return _Candidate(found, pixels)

    def evidence(one: _Candidate) -> float:
        return log_evidence(one.bundle, image, one.pixels)

    simple = fitted(usual, *starts[0])
    camera = simple.bundle.cameras[0]
    if len(starts) == 1:  # two steps tell whether there is anything to gain
        prior = prior_of(camera, image, _widest(simple.bundle), widest, settings)
        nearly = adjust(replace(simple.bundle, priors=(prior,)), iterations=2)
        if evidence(_Candidate(nearly, widest)) < evidence(simple) - settings.max_usual_gain_nats:
            return simple
    free = fitted(widest, *[(camera, simple.bundle.boards), *starts[1:]][-1])
    start = (free.bundle.cameras[0], free.bundle.boards)
    return max([simple, *(fitted(pixels, *start) for pixels in between), free], key=evidence)


def log_evidence(bundle: Bundle, image: Image, pixels: Pixels) -> float:
    """The log marginal likelihood of the views of one camera, lens and boards integrated out (Laplace), at their noise.

    Args:
        bundle: Of one camera, adjusted.
        image: Where its pixels are measured from.
        pixels: The prior of its pixels.

    Returns:
        In nats, up to what is the same for all pixels.
    """
    noise = max(float(spreads(bundle)[0]), 1e-5 * image.half)
    corners = len(bundle.views.stacks[0].uv)
    likelihood = -2 * corners * np.log(noise) + log_marginal(replace(bundle, noise=np.array([noise])))
    before = log_density_at_peak(bundle.priors[0], bundle.cameras[0], image, pixels) + noise_prior(
        noise, image, bundle.settings
    )
    return float(likelihood + before)


def _starts(views: Sequence[BoardView], image: Image, settings: ExplicitSettings) -> list[tuple[CentralCamera, Placed]]:
    """A start with square pixels; and one with others, where they fit better."""
    some = sorted(views, key=lambda view: -len(view.rows))[: settings.max_boards_for_pixels]
    best = min(ASPECTS, key=lambda aspect: _start(some, image, aspect, settings)[0])
    return [_start(views, image, aspect, settings)[1] for aspect in dict.fromkeys((1.0, best))]


def _start(
    views: Sequence[BoardView], image: Image, aspect: float, settings: ExplicitSettings
) -> tuple[float, tuple[CentralCamera, Placed]]:
    """The rung of the ladder that fits the boards best for pixels with this fy / fx, and the poses camera_from_board
    that go with it; before it, the squared errors that are left."""
    offsets = [(view.uv - image.centre) / np.array([1.0, aspect]) for view in views]
    outermost = max(float(np.linalg.norm(offset, axis=1).max()) for offset in offsets)

    def ladder(offset: Floats) -> tuple[Floats, Bools, Floats]:
        focal, pinhole, rays = candidate_rays(np.vstack([offset, [outermost, 0.0]]))  # the same rungs for each board
        return focal, pinhole, rays[:, :-1]

    total: Floats | float = 0.0
    for i in sorted(range(len(views)), key=lambda i: -len(views[i].rows))[: settings.max_boards_for_lens]:
        focal, pinhole, rays = ladder(offsets[i])
        _, errors = planar_poses(views[i].xyz[:, :2], rays, focal)
        total = total + np.sum(np.minimum(errors, 3 * np.median(errors, axis=1, keepdims=True)) ** 2, axis=1)
    best = int(np.argmin(total))
    k = PERSPECTIVE_K if pinhole[best] else np.zeros(4)
    lens = KannalaBrandt(float(focal[best]), float(focal[best] * aspect), *image.centre.tolist(), *k.tolist())
    poses = [
        _trimmed_pose(view.xyz[:, :2], ladder(offset)[2][best], float(focal[best]), settings.min_corners)
        for view, offset in zip(views, offsets, strict=True)
    ]
    left = float(np.ravel(total)[best]) * aspect  # no ratio may win by making pixels large
    return left, (CentralCamera(lens, Pose(np.eye(3), np.zeros(3))), Placed.of(poses))


def planar_poses(flat: Floats, rays: Floats, focal: Floats) -> tuple[list[Pose], Floats]:
    """The pose of a board for each of several lenses: the homography board -> ray, made rigid (Zhang 2000, appendix C).

    Args:
        flat: (n, 2) points on the board.
        rays: (k, n, 3) their unit rays by each lens.
        focal: (k,) focal lengths, pixels.

    Returns:
        camera_from_board for each lens, and errors (k, n) in pixels of these focal lengths.
    """
    middle = flat.mean(axis=0)
    scale = float(np.sqrt(np.mean((flat - middle) ** 2)))
    points = np.column_stack([(flat - middle) / scale, np.ones(len(flat))])
    # ray x (H p) = 0: the sum of (I - ray ray^T) (x) p p^T has vec(H) in its null space
    across = np.eye(3) - rays[..., :, None] * rays[..., None, :]
    outer = (points[:, :, None] * points[:, None, :]).reshape(len(flat), 9)
    normal = (across.reshape(len(rays), len(flat), 9).swapaxes(1, 2) @ outer).reshape(-1, 3, 3, 3, 3)
    H = np.linalg.eigh(normal.swapaxes(2, 3).reshape(-1, 9, 9))[1][:, :, 0].reshape(-1, 3, 3)
    front = np.median(np.einsum("kij,nj,kni->kn", H, points, rays, optimize=True), axis=1)
    size = 0.5 * (np.linalg.norm(H[:, :, 0], axis=1) + np.linalg.norm(H[:, :, 1], axis=1))
    H = H * (np.where(front < 0, -1.0, 1.0) / np.maximum(size, 1e-12))[:, None, None]
    u, _, vt = np.linalg.svd(np.stack([H[:, :, 0], H[:, :, 1], np.cross(H[:, :, 0], H[:, :, 1])], axis=2))
    u[:, :, 2] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))[:, None]
    rotations = u @ vt
    translations = H[:, :, 2] * scale - rotations[:, :, :2] @ middle
    there = flat @ rotations[:, :, :2].swapaxes(1, 2) + translations[:, None]
    along = np.sum(there * rays, axis=2)
    aside = np.sqrt(np.maximum(np.sum(there**2, axis=2) - along**2, 0))
    errors = focal[:, None] * np.arctan2(aside, along)
    return [Pose(r, t) for r, t in zip(rotations, translations, strict=True)], np.asarray(errors, dtype=np.float64)


def _trimmed_pose(flat: Floats, rays: Floats, focal: float, least: int) -> Pose:
    """camera_from_board from rays (n, 3) of one lens, some of which may be wrong: those far off are left
    out, while `least` stay."""
    keep, lens = np.ones(len(flat), dtype=np.bool_), np.array([focal])
    for _ in range(3):
        poses, _ = planar_poses(flat[keep], rays[None, keep], lens)
        there = poses[0].apply(np.column_stack([flat, np.zeros(len(flat))]))
        off = np.arccos(np.clip(np.sum(there * rays, axis=1) / np.linalg.norm(there, axis=1), -1, 1))
        inside = off <= 3 * np.median(off)
        if inside.sum() < least or (inside == keep).all():
            break
        keep = inside
    return poses[0]


def placed_again(bundle: Bundle) -> Bundle | None:
    """The bundle with boards placed anew that are stuck in a wrong pose: wrong corners led them there, or it is the
    mirrored pose that a small board has as well.

    Args:
        bundle: Of one camera.

    Returns:
        The new bundle, not adjusted; None where no board is stuck.
    """
    lengths, usual = bundle.lengths(0), float(spreads(bundle)[0])
    rotation, translation, changed = bundle.boards.rotation.copy(), bundle.boards.translation.copy(), False
    for (k, rows), view in zip(bundle.views.stacks[0].sections, bundle.views.each, strict=True):
        now = float(np.median(lengths[rows]))
        if now <= bundle.settings.max_board_error_ratio * usual:
            continue
        pose, error = _best_pose(bundle, view, bundle.boards.pose(k))
        if error < 0.5 * now:
            rotation[k], translation[k], changed = pose.rotation, pose.translation, True
    return replace(bundle, boards=Placed(rotation, translation)) if changed else None


def _best_pose(bundle: Bundle, view: BoardView, now: Pose) -> tuple[Pose, float]:
    """The better of both, and its median error in pixels."""
    camera = bundle.cameras[0]

    def error(pose: Pose) -> float:
        return median_error(camera, view, pose)

    best = min(pose_and_mirror(camera, view, now, float(bundle.noise[0]), bundle.settings), key=error)
    return best, error(best)


def median_error(camera: CentralCamera, view: BoardView, pose: Pose) -> float:
    """How far off the corners of a board at a pose are.

    Args:
        camera: The camera.
        view: What it saw of the board.
        pose: Of the board, in the frame that the camera's pose is from.

    Returns:
        The median in pixels; infinite where the camera does not see most of them.
    """
    off = np.linalg.norm(camera.pixel(pose.apply(view.xyz)) - view.uv, axis=1)
    return float(np.median(np.nan_to_num(off, nan=np.inf)))


def pose_and_mirror(
    camera: CentralCamera, view: BoardView, now: Pose, noise: float, settings: ExplicitSettings
) -> list[Pose]:
    """The best pose from random corners (RANSAC) or the present one, and that with the tilt the other way; refined.

    Args:
        camera: At the origin of its own frame.
        view: What it saw of a board.
        now: The present camera_from_board.
        noise: Pixels.
        settings: The robust cost.

    Returns:
        Both poses camera_from_board.
    """
    rng = np.random.default_rng(0)
    rays, valid = camera.lens.ray_from_pixel(view.uv)
    good = np.flatnonzero(valid)
    found = [now]
    for _ in range(RANDOM_SUBSETS if len(good) >= 8 else 0):
        some = rng.choice(good, 8, replace=False)
        found.append(planar_poses(view.xyz[some, :2], rays[None, some], np.ones(1))[0][0])
    best = min(found, key=lambda pose: median_error(camera, view, pose))
    only = Views((replace(view, camera=0, board=0),), 1)
    prior = Prior(np.zeros(camera.size), np.zeros((camera.size, camera.size)))
    refined = []
    for start in (best, _mirrored(best, view.xyz.mean(axis=0))):
        bundle = Bundle((camera,), (prior,), Placed.of([start]), only, np.array([noise]), True, settings=settings)
        refined.append(adjust(bundle).bundle.boards.pose(0))
    return refined


def _mirrored(pose: Pose, middle: Floats) -> Pose:
    """The pose whose tilt is the other way about the line of sight, about the board's middle."""
    centre = pose.apply(middle)
    sight = centre / np.linalg.norm(centre)
    normal = pose.rotation[:, 2]
    other = 2 * (normal @ sight) * sight - normal  # half a turn about the line of sight
    axis = np.cross(normal, other)
    size = np.linalg.norm(axis)
    if size < 1e-9:
        return pose
    turn = rotation_from_vector(axis / size * np.arctan2(size, normal @ other))
    rotation = turn @ pose.rotation
    return Pose(rotation, centre - rotation @ middle)


def _widest(bundle: Bundle) -> float:
    """How far off the axis of a camera its lens is used, radians."""
    return min(float(np.quantile(angles(bundle.cameras[0], bundle.corners(0)), 0.98)), 3.0)


def _adjusted(
    camera: CentralCamera, boards: Placed, views: Views, image: Image, pixels: Pixels, settings: ExplicitSettings
) -> Adjusted:
    """Lens and poses of the boards, refined."""
    first = camera.prior(image, 1.0, settings)
    bundle = Bundle((camera,), (first,), boards, views, np.ones(1), settings=settings)
    prior = prior_of(camera, image, _widest(bundle), pixels, settings)
    return adjust_in_steps(replace(bundle, priors=(prior,)), np.array([image.half]))


def _held_out(adjusted: Adjusted) -> Floats:
    """(n,) squared errors of corners: a part of the boards held out in turn, the lens from the others, and a pose from
    every second corner."""
    bundle = adjusted.bundle
    views, count, folds = bundle.views.each, len(bundle.boards.translation), bundle.settings.board_folds
    fold = np.random.default_rng(0).permutation(np.arange(count) % min(folds, count))
    errors = []
    for k in range(min(folds, count)):
        train, boards = renumbered([view for view in views if fold[view.board] != k])
        kept = Placed(bundle.boards.rotation[boards], bundle.boards.translation[boards])
        camera = adjust(replace(bundle, views=Views(train, 1), boards=kept), iterations=15).bundle.cameras[0]
        errors.append(_of_placed_boards(replace(bundle, cameras=(camera,)), [v for v in views if fold[v.board] == k]))
    return clipped(np.concatenate(errors), bundle.settings.max_start_error_medians) ** 2


def _of_placed_boards(bundle: Bundle, views: Sequence[BoardView]) -> Floats:
    """(n,) errors in pixels of every second corner of the boards, which are placed by the others for a known lens."""
    odd = [view.select(np.arange(len(view.rows)) % 2 == 1) for view in views]
    even = [view.select(np.arange(len(view.rows)) % 2 == 0) for view in views]
    placed = adjust(replace(bundle, views=Views(tuple(odd), 1), held=True), iterations=15).bundle
    return replace(placed, views=Views(tuple(even), 1)).lengths(0)
