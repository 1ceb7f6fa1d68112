"""Do the cameras agree? What is left on boards that two of them saw: of each camera alone, and of both together.

Alone, every camera has a pose of its own for each board; together they must share it. Pictures of other instants, a
camera that was moved, or one whose pictures are mirrored, all fit alone and not together, and no residual says which
camera is to blame: it depends on which of them is believed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from implicam.calibrators.explicit.adjust import (
    RAYLEIGH_MEDIAN,
    Adjusted,
    Bundle,
    adjust,
    log_marginal_with_slack,
    root_with_slack,
    slack_in_pixels,
    unexplained,
)
from implicam.calibrators.explicit.boards import BoardView
from implicam.calibrators.explicit.settings import ExplicitSettings
from implicam.geometry import Floats, Pose
from implicam.progress import Progress, silent
from implicam.rig_model import CentralCamera


class Agreement(NamedTuple):
    """Of two cameras (numbers in the bundle) on the boards that both saw: the usual residual, pixels per coordinate, of
    each alone and of both together; half: of half the longer side of the image, the larger of both; settings: when that
    is a contradiction."""

    pair: tuple[int, int]
    boards: int
    alone: float
    together: float
    half: float
    settings: ExplicitSettings

    @property
    def contradict(self) -> bool:
        """They fit alone and not together."""
        enough = self.boards >= self.settings.min_shared_boards
        return enough and self.together > self.settings.max_together_ratio * self.alone

    @property
    def hopeless(self) -> bool:
        """They contradict each other, and by so much that it is not for a board held by hand that moved a little."""
        return self.contradict and self.together > self.settings.max_together_error_half_sides * self.half


def agreements(bundle: Bundle, half: Floats, alone: Mapping[tuple[int, int], Floats]) -> list[Agreement]:
    """What is left of each camera alone and of both together, for all pairs that share boards.

    Args:
        bundle: All cameras, adjusted together.
        half: (C,) half the longer side of each image, pixels.
        alone: (camera, board) -> lengths (k,) of the residuals of its corners when the camera is fitted alone, in its
            usual pixels.

    Returns:
        One for each pair.
    """
    together: dict[tuple[int, int], Floats] = {}
    lengths = [bundle.lengths(c) for c in range(len(bundle.cameras))]
    for c, view, rows in bundle.views.in_stacks():
        if (c, view.board) in alone:
            together[c, view.board] = lengths[c][rows]
    found = []
    for a, b in combinations(range(len(bundle.cameras)), 2):
        shared = [k for k in range(len(bundle.boards.translation)) if (a, k) in together and (b, k) in together]
        if shared:
            of_each, of_both = (
                _usual([by[a, k] for k in shared], [by[b, k] for k in shared]) for by in (alone, together)
            )
            widest = float(max(half[a], half[b]))
            found.append(Agreement((a, b), len(shared), of_each, of_both, widest, bundle.settings))
    return found


def _usual(a: Sequence[Floats], b: Sequence[Floats]) -> float:
    """Root mean square of both cameras' usual residual on a usual board: a few bad pictures do not matter."""
    sizes = [np.median([np.median(lengths) for lengths in of]) / RAYLEIGH_MEDIAN for of in (a, b)]
    return float(np.hypot(*sizes) / np.sqrt(2))


def with_slack(bundle: Bundle, progress: Progress = silent) -> tuple[Adjusted, list[tuple[int, int, float]]]:
    """The bundle of cameras that contradict each other, adjusted as if every board had moved a little between the
    pictures of it.

    How far boards moved is found by marginal likelihood. So no camera is believed more than another, the lenses stay as
    good as each camera alone finds them, and what the rig does not know for it is in its covariance.

    Args:
        bundle: With the noise of each camera alone.
        progress: Is told how far it is.

    Returns:
        Where it ends, and the corners that are wrong even so: (row, camera in the bundle, pixels off).
    """
    everything, wrong = bundle.views, [np.zeros(len(stack.uv), dtype=np.bool_) for stack in bundle.views.stacks]
    alone, settings = bundle.noise, bundle.settings
    for _ in range(2):
        bundle = _most_probable(replace(bundle, views=everything.select([~bad for bad in wrong])), progress)
        whole = replace(bundle, views=everything)
        off = [unexplained(whole, c) for c in range(len(bundle.cameras))]
        now = [length > settings.max_corner_error_sds * noise for length, noise in zip(off, alone, strict=True)]
        same = all((a == b).all() for a, b in zip(now, wrong, strict=True))
        wrong = now
        if same or np.mean(np.concatenate(wrong)) > settings.max_wrong_corner_share:
            break
    found = adjust(bundle, robust=False)
    listed = [
        (int(view.rows[i]), c, float(off[c][rows][i]))
        for c, view, rows in everything.in_stacks()
        for i in np.flatnonzero(wrong[c][rows])
    ]
    return found, listed


def loosened(found: Adjusted, progress: Progress = silent) -> Adjusted:
    """The same cameras with the covariance that they have if boards moved a little between the pictures of them.

    Errors that all corners of a view share, those of a lens that its model does not hold, too, are not errors of single
    corners, which would cancel; the cameras stay as they are, since it is not known which it was. The noise is raised
    by as much: a point that is measured has such errors, and what is left at the corners does not show them.

    Args:
        found: An adjustment by plain least squares.
        progress: Is told how far it is.

    Returns:
        The adjustment; as it was where the views do not clearly say so.
    """
    bundle, settings = found.bundle, found.bundle.settings
    seen = np.zeros(len(bundle.boards.translation), dtype=np.int64)
    for view in bundle.views.each:
        seen[view.board] += 1
    if np.sum(seen >= 2) < settings.min_shared_boards:
        return found
    extent = float(np.median([np.ptp(view.xyz, axis=0).max() for view in bundle.views.each]))
    before = log_marginal_with_slack(bundle)
    for part in settings.unnoticed_moves_extents:
        trial = adjust(replace(bundle, slack=part * extent), robust=False, iterations=4).bundle
        if log_marginal_with_slack(trial) > before + settings.min_moved_gain_nats:
            moved = replace(bundle, slack=_most_probable(trial, progress).slack)
            noise = np.hypot(bundle.noise, slack_in_pixels(moved))
            return found._replace(bundle=replace(bundle, noise=noise), root=root_with_slack(moved, found.root))
    return found


def _most_probable(bundle: Bundle, progress: Progress) -> Bundle:
    """With the slack of the most marginal likelihood."""
    extent = float(np.median([np.ptp(view.xyz, axis=0).max() for view in bundle.views.each]))
    best = bundle

    def loss(log_slack: float) -> float:
        nonlocal best
        best = adjust(replace(best, slack=float(np.exp(log_slack))), robust=False, iterations=8).bundle
        return -log_marginal_with_slack(best)

    progress("looking how far the boards moved", 0, 1)
    bounds = (np.log(1e-4 * extent), np.log(extent))
    found = minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 0.1, "maxiter": 12})
    progress("looking how far the boards moved", 1, 1)
    return adjust(replace(best, slack=float(np.exp(found.x))), robust=False).bundle


def mirrored(
    camera: CentralCamera, seen: Mapping[int, BoardView], placed: Mapping[int, Pose], other: Mapping[int, Pose]
) -> float:
    """The usual error of a camera on the boards that another saw as well, if the pictures of one of the two are
    mirrored.

    A mirrored picture of a board fits as well as a right one, from behind; or from the front, where a detector has
    counted the corners anew, along the mirrored rows or columns.

    Args:
        camera: At the origin of its own frame.
        seen: Number of the board -> what it saw of it.
        placed: Number of the board -> camera_from_board of this camera alone.
        other: The same of the other camera; it shares a board or more.

    Returns:
        Pixels.
    """
    common = sorted(placed.keys() & other.keys())
    flip, best = np.diag([-1.0, 1.0, 1.0]), np.inf
    extent = np.max([seen[k].xyz.max(axis=0) for k in common], axis=0)
    for signs in ((1.0, 1.0, -1.0), (-1.0, 1.0, 1.0), (1.0, -1.0, 1.0)):
        counted = np.array(signs)
        start = np.where(counted < 0, extent, 0) * np.array([1.0, 1.0, 0.0])
        truly = {}
        for k in common:
            rotation = flip @ other[k].rotation * counted
            truly[k] = Pose(rotation, flip @ other[k].translation - rotation @ start)
        for k in common:
            pose = placed[k] @ truly[k].inverse()
            off = [float(np.median(lengths_alone(camera, seen[j], pose @ truly[j]))) for j in common]
            best = min(best, float(np.median(off)))
    return best


def lengths_alone(camera: CentralCamera, view: BoardView, pose: Pose) -> Floats:
    """How far off the corners of a view are for a camera at the origin.

    Args:
        camera: The camera.
        view: What it saw of a board.
        pose: camera_from_board.

    Returns:
        (k,) pixels over the relative noise; infinite where the lens has no pixel.
    """
    off = np.linalg.norm(camera.pixel(pose.apply(view.xyz)) - view.uv, axis=1) / view.relative
    return np.where(np.isfinite(off), off, np.inf)
