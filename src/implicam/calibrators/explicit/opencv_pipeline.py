"""The paper's classical calibration: OpenCV for every camera, then for pairs of cameras, poses chained.

Each camera from the pictures that it took alone: `cv2.calibrateCamera` for a regular lens (Brown-Conrady with five
coefficients), `cv2.fisheye.calibrate` for a wide one (Kannala-Brandt). Then `stereoCalibrate` with these lenses kept,
for the pairs that chain every camera to the first regular one. The paper does not say whether it adjusted all of it
together; `adjusted_together` does, with every corner of every picture counting the same.

Where OpenCV does not go on by itself, what its users do is done, and told: a fisheye calibration that fails from
OpenCV's own guess of the focal length is started from others, and pictures that it leaves far off are taken out.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.explicit.adjust import Bundle, Placed, Views, adjust
from implicam.calibrators.explicit.boards import MIN_BOARDS, Boards, BoardView, renumbered, usable_cameras
from implicam.calibrators.explicit.lenses import AUTO, Choice
from implicam.calibrators.explicit.settings import ExplicitSettings
from implicam.calibrators.explicit.zhang import planar_poses
from implicam.errors import FitError
from implicam.geometry import Floats, Pose
from implicam.images import one_thread_each, opencv
from implicam.lenses import BrownConrady, KannalaBrandt, Lens
from implicam.progress import Progress
from implicam.rig_model import CentralCamera, Image, Prior

FAMILIES = (BrownConrady.family, KannalaBrandt.family)
"""Of lenses that OpenCV calibrates."""

ITERATIONS, TOLERANCE = 200, 1e-9
"""Of OpenCV's iterations; its defaults of 30 for pairs stop before they have settled."""


@dataclass(frozen=True, eq=False)
class OpenCVRig:
    """What OpenCV makes of the pictures of a board.

    cameras: numbers of those calibrated; uncalibrated: number and reason of the others; bundle: lenses and poses in the
    frame of camera `reference` (a place in `cameras`), the boards placed to fit them best, and the noise of each camera
    as the corners' residuals show it; images: of those calibrated; reprojection: rms distance in pixels of all corners
    from where they are predicted; notes: what was done that somebody should know."""

    cameras: tuple[int, ...]
    uncalibrated: tuple[tuple[int, str], ...]
    bundle: Bundle
    reference: int
    choices: tuple[Choice, ...]
    images: tuple[Image, ...]
    reprojection: float
    notes: tuple[str, ...]


class _Single(NamedTuple):
    """A camera by itself: OpenCV's matrix and coefficients, whether by the fisheye interface, pictures taken out."""

    wide: bool
    K: Floats
    D: Floats
    taken_out: tuple[int, ...]

    @property
    def lens(self) -> Lens:
        K, D = self.K, [float(d) for d in self.D.ravel()]
        numbers = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
        return KannalaBrandt(*numbers, *D[:4]) if self.wide else BrownConrady(*numbers, *D[:5])


def calibrate_with_opencv(boards: Boards, family: str, joint: bool, progress: Progress) -> OpenCVRig:
    """The paper's pipeline.

    Args:
        boards: what each camera saw of each board.
        family: of lenses, for all cameras; `auto`: regular or wide, as their angles of view are.
        joint: whether all cameras and boards are adjusted together in the end.
        progress: told of each camera and each pair.

    Returns:
        The rig, in the length unit of the boards.

    Raises:
        FitError: fewer than two cameras can be calibrated and joined.
    """
    good, uncalibrated = usable_cameras(boards)
    singles: dict[int, _Single] = {}
    with one_thread_each():
        for number, c in enumerate(good):
            progress("calibrating cameras with OpenCV", number, len(good))
            try:
                singles[c] = _calibrated(boards, c, family)
            except FitError as error:
                uncalibrated.append((c, error.what))
        views = _without_taken_out(boards, singles)
        reference = next((c for c, single in singles.items() if not single.wide), next(iter(singles), -1))
        poses = _chained(boards, views, singles, reference, progress)
    lost = [c for c in singles if c not in poses]
    uncalibrated += [
        (c, f"no chain of pairs with {boards.settings.min_pair_pictures} common pictures leads to it") for c in lost
    ]
    if len(poses) < 2:
        raise FitError(
            f"{len(poses)} of {len(boards.cameras)} cameras can be calibrated together; a position takes two.",
            why="; ".join(f"{boards.names[c]}: {why}" for c, why in sorted(uncalibrated)),
            fix=f"show every camera the board in {boards.settings.min_own_pictures} places or more, and in "
            f"{boards.settings.min_pair_pictures} or more "
            "to every two neighbours at once",
        )
    rig = _rig(boards, views, singles, poses, reference, sorted(uncalibrated))
    return _adjusted_together(rig, progress) if joint else rig


def _calibrated(boards: Boards, c: int, family: str) -> _Single:
    """One camera, by itself."""
    every = boards.of_camera(c)
    seen = np.bincount([view.board for view in boards.views])
    own = [view for view in every if seen[view.board] == 1]
    views = own if len(own) >= boards.settings.min_own_pictures else list(every)
    half = boards.images[c].half
    size = _size(boards, c)
    regular = None if family == KannalaBrandt.family else _regular(views, size)
    if family == AUTO:
        wide = regular is None or _angle_of_view(regular.K, size) > boards.settings.wide_from_degrees
    else:
        wide = family == KannalaBrandt.family
    if wide:
        return _fisheye(views, size, half, boards.settings)
    if regular is None:
        raise FitError("cv2.calibrateCamera fails: its pictures do not fix a perspective lens.")
    left = _rms(_picture_errors(views, regular))
    if not left < boards.settings.max_reprojection_half_sides * half:
        raise FitError(f"cv2.calibrateCamera leaves {left:.3g} px: no perspective lens sees its pictures so.")
    return regular


def _size(boards: Boards, c: int) -> tuple[int, int]:
    """Width and height; where they are not said, of the pixels there are."""
    width, height = (round(float(x)) for x in 2 * boards.images[c].centre + 1)
    return boards.cameras[c].width or width, boards.cameras[c].height or height


def _angle_of_view(K: Floats, size: tuple[int, int]) -> float:
    return float(np.degrees(2 * np.arctan(size[0] / 2 / K[0, 0])))


def _regular(views: Sequence[BoardView], size: tuple[int, int]) -> _Single | None:
    cv2 = opencv()
    try:
        _, K, D, *_ = cv2.calibrateCamera(*_points(views, np.float32), size, None, None)
    except cv2.error:
        return None
    return _Single(False, np.asarray(K), np.asarray(D), ()) if K[0, 0] > 0 and np.isfinite(K).all() else None


def _fisheye(views: Sequence[BoardView], size: tuple[int, int], half: float, settings: ExplicitSettings) -> _Single:
    """By the fisheye interface, without the pictures that it leaves far off."""
    found, errors = _fisheye_of_all(views, size, half, settings)
    far = errors > settings.max_picture_error_ratio * np.median(errors)
    if far.any() and (~far).sum() >= MIN_BOARDS:
        taken_out = tuple(view.board for view, out in zip(views, far, strict=True) if out)
        kept = [view for view in views if view.board not in taken_out]
        found, errors = _fisheye_of_all(kept, size, half, settings)
        found = found._replace(taken_out=taken_out)
    left = _rms(errors)
    if not left < settings.max_reprojection_half_sides * half:
        raise FitError(f"cv2.fisheye.calibrate leaves {left:.3g} px: no fisheye lens sees its pictures so.")
    return found


def _opencv_reason(error: Exception) -> str:
    """What OpenCV says of an error. `error.err` may be that of another one: OpenCV keeps it on the class."""
    text = " ".join(str(error).split())
    found = re.search(r"error: \([^)]*\) (.*?)(?: in function|$)", text)
    return found[1] if found else text


def _fisheye_of_all(
    views: Sequence[BoardView], size: tuple[int, int], half: float, settings: ExplicitSettings
) -> tuple[_Single, Floats]:
    """The first start that leaves little, else the best, and the error of each picture; FitError where all fail."""
    cv2 = opencv()
    namespace = cv2 if hasattr(cv2, "CALIB_RECOMPUTE_EXTRINSIC") else cv2.fisheye  # OpenCV 5, OpenCV 4
    flags = namespace.CALIB_RECOMPUTE_EXTRINSIC | namespace.CALIB_FIX_SKEW
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, ITERATIONS, TOLERANCE)
    found, why = list[tuple[_Single, Floats]](), "it finds no lens"
    for factor in (None, *settings.fisheye_start_focal_ratio):
        K, D, start = None, None, flags
        if factor is not None:
            focal = factor * max(size) / np.pi
            K = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]])
            D, start = np.zeros(4), flags | namespace.CALIB_USE_INTRINSIC_GUESS
        try:
            _, K, D, *_ = cv2.fisheye.calibrate(*_points(views, np.float64), size, K, D, flags=start, criteria=criteria)
        except cv2.error as error:
            why = _opencv_reason(error)
            continue
        if not (np.isfinite(K).all() and np.isfinite(D).all() and K[0, 0] > 0 and K[1, 1] > 0):
            continue
        single = _Single(True, np.asarray(K), np.asarray(D), ())
        found.append((single, _picture_errors(views, single)))
        if np.median(found[-1][1]) < settings.max_reprojection_half_sides * half:
            break
    if not found:
        raise FitError(f"cv2.fisheye.calibrate fails: {why}.")
    return min(found, key=lambda one: float(np.median(one[1])))


def _points(views: Sequence[BoardView], kind: Any) -> tuple[list[NDArray[Any]], list[NDArray[Any]]]:
    """The corners on their boards, and their pixels, as OpenCV takes them."""
    return (
        [np.ascontiguousarray(view.xyz, dtype=kind).reshape(1, -1, 3) for view in views],
        [np.ascontiguousarray(view.uv, dtype=kind).reshape(1, -1, 2) for view in views],
    )


def _picture_errors(views: Sequence[BoardView], single: _Single) -> Floats:
    """(n,) rms distance in pixels of the corners of each picture, its board placed to fit best; infinite where the lens
    sees none."""
    camera = CentralCamera(single.lens, Pose(np.eye(3), np.zeros(3)))
    placed = _placed([camera], [replace(view, camera=0) for view in views])
    stack = placed.views.stacks[0]
    squares = placed.lengths(0) ** 2
    return np.array([np.sqrt(np.mean(squares[rows])) for _, rows in stack.sections])


def _rms(errors: Floats) -> float:
    return float(np.sqrt(np.mean(errors**2)))


def _placed(cameras: Sequence[CentralCamera], views: Sequence[BoardView]) -> Bundle:
    """Known cameras with the boards where they fit best, every corner counting the same."""
    own, _ = renumbered(views)
    starts: dict[int, Pose] = {}
    for view in sorted(own, key=lambda view: -len(view.rows)):
        if view.board not in starts:
            camera = cameras[view.camera]
            rays, valid = camera.lens.ray_from_pixel(view.uv)
            pose = Pose(np.eye(3), np.array([0.0, 0.0, 1.0]))
            if valid.sum() >= 4:
                poses, _ = planar_poses(view.xyz[valid, :2], rays[None, valid], np.array([camera.lens.fx]))
                pose = poses[0]
            starts[view.board] = camera.pose.inverse() @ pose
    boards = Placed.of([starts[k] for k in range(len(starts))])
    plain = tuple(replace(view, relative=np.ones(len(view.rows))) for view in own)
    priors = tuple(Prior(camera.parameters, np.zeros((camera.size, camera.size))) for camera in cameras)
    bundle = Bundle(tuple(cameras), priors, boards, Views(plain, len(cameras)), np.ones(len(cameras)), held=True)
    return replace(adjust(bundle, robust=False).bundle, held=False)


def _reprojection(bundle: Bundle) -> float:
    """Rms distance in pixels of all corners from where they are predicted."""
    squares = np.concatenate([bundle.lengths(c) ** 2 for c in range(len(bundle.cameras))])
    return float(np.sqrt(np.mean(squares)))


def _without_taken_out(boards: Boards, singles: Mapping[int, _Single]) -> tuple[BoardView, ...]:
    return tuple(
        view for view in boards.views if view.camera in singles and view.board not in singles[view.camera].taken_out
    )


def _chained(
    boards: Boards,
    views: Sequence[BoardView],
    singles: Mapping[int, _Single],
    reference: int,
    progress: Progress,
) -> dict[int, Pose]:
    """camera_from_reference of all cameras that pairs lead to, by the fewest pairs, of these by the one with the most
    pictures."""
    if reference < 0:
        return {}
    seen: dict[int, dict[int, BoardView]] = {c: {} for c in singles}
    for view in views:
        seen[view.camera][view.board] = view
    poses, frontier = {reference: Pose(np.eye(3), np.zeros(3))}, [reference]
    while frontier:
        reached = list[tuple[int, Pose]]()
        for new in [c for c in singles if c not in poses]:
            common = {old: len(seen[old].keys() & seen[new].keys()) for old in frontier}
            old = max(common, key=lambda c: common[c])
            if common[old] < boards.settings.min_pair_pictures:
                continue
            progress("calibrating pairs with OpenCV", len(poses) + len(reached) - 1, len(singles) - 1)
            pose = _stereo(boards, seen[old], seen[new], singles[old], singles[new])
            if pose is not None:
                reached.append((new, pose @ poses[old]))
        poses |= dict(reached)
        frontier = [c for c, _ in reached]
    return poses


def _stereo(
    boards: Boards, seen_a: Mapping[int, BoardView], seen_b: Mapping[int, BoardView], a: _Single, b: _Single
) -> Pose | None:
    """b_from_a, the lenses kept; None where OpenCV finds none.

    Two wide lenses by the fisheye interface, which takes pictures with equally many corners only. A wide and a regular
    one have no common interface: the corners of the wide one are undistorted first.
    """
    cv2 = opencv()
    pairs = [_common(seen_a[k], seen_b[k]) for k in sorted(seen_a.keys() & seen_b.keys())]
    counts = [len(one.rows) for one, _ in pairs]
    size = _size(boards, next(iter(seen_a.values())).camera)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, ITERATIONS, TOLERANCE)
    most = max(set(counts), key=lambda count: (counts.count(count), count))
    try:
        if a.wide and b.wide and most >= 4 and counts.count(most) >= boards.settings.min_pair_pictures:
            pairs = [pair for pair, count in zip(pairs, counts, strict=True) if count == most]
            xyz, uv_a = _points([one for one, _ in pairs], np.float64)
            _, uv_b = _points([one for _, one in pairs], np.float64)
            namespace = cv2 if hasattr(cv2, "CALIB_FIX_INTRINSIC") else cv2.fisheye
            _, _, _, _, _, R, T, *_ = cv2.fisheye.stereoCalibrate(
                xyz, uv_a, uv_b,
                a.K.copy(), a.D.copy(), b.K.copy(), b.D.copy(), size,
                flags=namespace.CALIB_FIX_INTRINSIC, criteria=criteria,
            )  # fmt: skip
        else:
            pairs = [_common(_flattened(one, a), _flattened(other, b)) for one, other in pairs]
            pairs = [pair for pair in pairs if len(pair[0].rows) >= 4]
            xyz, uv_a = _points([one for one, _ in pairs], np.float32)
            _, uv_b = _points([one for _, one in pairs], np.float32)
            D_a, D_b = (np.zeros(5) if single.wide else single.D.copy() for single in (a, b))
            _, _, _, _, _, R, T, *_ = cv2.stereoCalibrate(
                xyz, uv_a, uv_b, a.K.copy(), D_a, b.K.copy(), D_b, size,
                flags=cv2.CALIB_FIX_INTRINSIC, criteria=criteria,
            )  # fmt: skip
    except cv2.error:
        return None
    R, T = np.asarray(R, dtype=np.float64), np.asarray(T, dtype=np.float64).ravel()
    return Pose(R, T) if np.isfinite(R).all() and np.isfinite(T).all() else None


def _common(a: BoardView, b: BoardView) -> tuple[BoardView, BoardView]:
    """The corners that both saw."""
    _, of_a, of_b = np.intersect1d(a.rows, b.rows, return_indices=True)
    both = []
    for view, of in ((a, of_a), (b, of_b)):
        keep = np.zeros(len(view.rows), dtype=np.bool_)
        keep[of] = True
        both.append(view.select(keep))
    return both[0], both[1]


def _flattened(view: BoardView, single: _Single) -> BoardView:
    """What a pinhole with the same matrix would see; without the corners that no pinhole sees. As it is, of a regular
    lens."""
    if not single.wide:
        return view
    rays, valid = single.lens.ray_from_pixel(view.uv)
    there = np.asarray(valid & (rays[:, 2] > 0))
    view, rays = view.select(there), rays[there]
    plane = rays[:, :2] / rays[:, 2:]
    return replace(view, uv=plane * np.diag(single.K)[:2] + single.K[:2, 2])


def _rig(
    boards: Boards,
    views: Sequence[BoardView],
    singles: Mapping[int, _Single],
    poses: Mapping[int, Pose],
    reference: int,
    uncalibrated: Sequence[tuple[int, str]],
) -> OpenCVRig:
    cameras = tuple(sorted(poses))
    number = {c: i for i, c in enumerate(cameras)}
    there = [CentralCamera(singles[c].lens, poses[c]) for c in cameras]
    bundle = _placed(there, [replace(v, camera=number[v.camera]) for v in views if v.camera in number])
    notes = [
        f"{boards.names[c]}: {len(singles[c].taken_out)} picture{'s' * (len(singles[c].taken_out) != 1)} not used: "
        "OpenCV's fisheye calibration left them far off."
        for c in cameras
        if singles[c].taken_out
    ]
    choices = tuple(Choice(singles[c].lens.family, {}) for c in cameras)
    images = tuple(boards.images[c] for c in cameras)
    return _judged(
        OpenCVRig(cameras, tuple(uncalibrated), bundle, number[reference], choices, images, 0.0, tuple(notes))
    )


def _judged(rig: OpenCVRig) -> OpenCVRig:
    """With the reprojection error, and each camera's noise, of the corners as they are now."""
    bundle = rig.bundle
    noise = [np.sqrt(np.mean(bundle.lengths(c) ** 2) / 2) for c in range(len(bundle.cameras))]
    return replace(rig, bundle=replace(bundle, noise=np.maximum(noise, 1e-6)), reprojection=_reprojection(bundle))


def _adjusted_together(rig: OpenCVRig, progress: Progress) -> OpenCVRig:
    """All lenses, poses and boards by least squares on all corners, every one counting the same."""
    plain = replace(rig.bundle, noise=np.ones(len(rig.cameras)))
    found = adjust(plain, robust=False, progress=progress)
    notes = rig.notes if found.converged else (*rig.notes, "The bundle adjustment had not settled when it was stopped.")
    return _judged(replace(rig, bundle=found.bundle, notes=notes))
