"""The whole rig from boards: every camera alone, pairs of cameras that saw the same board, then all of them at once.

The rig's frame is that of the first camera that is calibrated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from implicam.calibrators.explicit.adjust import Adjusted, Bundle, Placed, Views, adjust, adjust_in_steps, spreads
from implicam.calibrators.explicit.agreement import (
    Agreement,
    agreements,
    lengths_alone,
    loosened,
    mirrored,
    with_slack,
)
from implicam.calibrators.explicit.boards import Boards, BoardView, renumbered, usable_cameras
from implicam.calibrators.explicit.lenses import Choice, angles
from implicam.calibrators.explicit.pixels import prior_of
from implicam.calibrators.explicit.reversed import find_reversed
from implicam.calibrators.explicit.zhang import (
    OneCamera,
    calibrate_camera,
    median_error,
    pose_and_mirror,
)
from implicam.dataset import Names
from implicam.errors import FitError
from implicam.formatting import list_some
from implicam.geometry import Bools, Floats, Pose
from implicam.progress import Progress, silent
from implicam.rig_model import CentralCamera, Image
from implicam.threads import side_by_side


@dataclass(frozen=True, eq=False)
class CameraGroup:
    """Cameras adjusted together.

    cameras: numbers of those calibrated, as in bundle; uncalibrated: number and reason of the others; root: of the
    covariance of the cameras' unknowns; wrong: corners not used (row, camera number, pixels off); images: of those
    calibrated; shots: (n,) of each row of the dataset; doubts: pairs of cameras that fit alone and not together."""

    cameras: tuple[int, ...]
    uncalibrated: tuple[tuple[int, str], ...]
    choices: Mapping[int, Choice]
    bundle: Bundle
    root: Floats
    wrong: tuple[tuple[int, int, float], ...]
    images: tuple[Image, ...]
    shots: Names
    converged: bool
    doubts: tuple[Agreement, ...] = ()


@dataclass(frozen=True, eq=False)
class CameraGroups:
    """The groups of cameras that boards join, the largest first; uncalibrated: number and reason of the cameras without
    a lens."""

    groups: tuple[CameraGroup, ...]
    uncalibrated: tuple[tuple[int, str], ...]


def calibrate_groups(boards: Boards, family: str, progress: Progress = silent) -> CameraGroups:
    """Every camera that saw enough boards, in the groups that shared boards join; a group may be one camera.

    Args:
        boards: All views.
        family: Name of the lens of all cameras, or `auto`.
        progress: Is told how far it is.

    Returns:
        The groups, each in the frame of its first camera.

    Raises:
        FitError: Cameras of a group contradict each other, and by too much.
    """
    singles, choices, uncalibrated = _singles(boards, family, progress)
    groups = [_adjust_group(boards, singles, choices, poses, progress) for poses in _joined(boards, singles)]
    return CameraGroups(tuple(groups), tuple(sorted(uncalibrated)))


def calibrate_largest_group(boards: Boards, family: str, progress: Progress = silent) -> CameraGroup:
    """The largest group of cameras that shared boards join.

    Args:
        boards: All views.
        family: Name of the lens of all cameras, or `auto`.
        progress: Is told how far it is.

    Returns:
        The group, in the frame of its first camera.

    Raises:
        FitError: It is fewer than two cameras, or they contradict each other, and by too much.
    """
    singles, choices, uncalibrated = _singles(boards, family, progress)
    groups = _joined(boards, singles)
    poses = groups[0] if groups and len(groups[0]) > 1 else {}
    why = "it saw no board at the same time as the others" if len(singles) > 1 else "there is no other camera to join"
    uncalibrated += [(c, why) for c in singles if c not in poses]
    if len(poses) < 2:
        raise FitError(
            f"{len(poses)} of {len(boards.cameras)} cameras can be calibrated together; a position takes two.",
            why="; ".join(f"{boards.names[c]}: {why}" for c, why in uncalibrated),
            fix="show every camera the board in ten places or more, and in half of them to two cameras at once; or "
            "give known points that join them: implicam calibrate POINTS --boards BOARDS",
        )
    return _adjust_group(boards, singles, choices, poses, progress, uncalibrated)


def _adjust_group(
    boards: Boards,
    singles: Mapping[int, OneCamera],
    choices: Mapping[int, Choice],
    poses: Mapping[int, Pose],
    progress: Progress,
    uncalibrated: Sequence[tuple[int, str]] = (),
) -> CameraGroup:
    """Cameras, joined at first_from_camera, adjusted together.

    The noise is one for all until the adjustment has settled: a noise for each would let the boards follow one of two
    cameras that contradict each other, whichever came first, and call the other bad.
    """
    cameras = tuple(sorted(poses))
    _check_numbering(boards, singles, cameras)
    half = np.array([boards.images[c].half for c in cameras])
    bundle = _bundle(boards, singles, poses, cameras)
    found = adjust_in_steps(bundle, half, one_noise=True, progress=progress)
    better = _placed_again(found.bundle)
    if better is not None:
        found = adjust_in_steps(better, half, one_noise=True, progress=progress)
    agreed = agreements(found.bundle, half, _alone(boards, singles, found.bundle, cameras))
    doubts = [one for one in agreed if one.contradict]
    _check_pairs(boards, singles, cameras, doubts)
    if doubts:
        found, wrong, doubts = _with_slack(boards, singles, cameras, found.bundle, doubts, progress)
    else:
        found = adjust_in_steps(found.bundle, half, progress=progress)
        _check(boards, cameras, found, half)
        found, wrong = _refined(boards, cameras, found, progress)
        found = loosened(found, progress)
    return CameraGroup(
        cameras,
        tuple(sorted(uncalibrated)),
        {c: choices[c] for c in cameras},
        found.bundle,
        found.root,
        tuple(wrong),
        tuple(boards.images[c] for c in cameras),
        boards.shots,
        found.converged,
        tuple(one._replace(pair=(cameras[one.pair[0]], cameras[one.pair[1]])) for one in doubts),
    )


def _singles(
    boards: Boards, family: str, progress: Progress
) -> tuple[dict[int, OneCamera], dict[int, Choice], list[tuple[int, str]]]:
    usable, uncalibrated = usable_cameras(boards)
    done = 0

    def one(c: int) -> tuple[OneCamera, Choice] | FitError:
        nonlocal done
        try:
            return calibrate_camera(boards.of_camera(c), boards.images[c], family, boards.settings)
        except FitError as error:
            return error
        except np.linalg.LinAlgError as error:
            return FitError(f"its boards do not fix a lens: {error}.")
        finally:
            done += 1
            progress("calibrating each camera", done, len(usable))

    singles, choices = {}, {}
    for c, found in zip(usable, side_by_side(one, usable), strict=True):
        if isinstance(found, FitError):
            uncalibrated.append((c, found.what))
        else:
            singles[c], choices[c] = found
    return singles, choices, uncalibrated


def _joined(boards: Boards, singles: Mapping[int, OneCamera]) -> list[dict[int, Pose]]:
    """For each group of cameras that boards join, first_from_camera of its cameras, over the pairs that share the most;
    the largest group first."""
    seen = {c: dict(zip((v.board for v in boards.of_camera(c)), boards.of_camera(c), strict=True)) for c in singles}
    placed = {c: _placed(boards, c, singles[c]) for c in singles}
    shared = {
        (a, b): sum(len(seen[a][k].rows) + len(seen[b][k].rows) for k in seen[a].keys() & seen[b].keys())
        for a, b in combinations(singles, 2)
    }
    groups = _trees(list(singles), shared)
    joined = []
    for group, tree in sorted(groups, key=lambda group: (-len(group[0]), min(group[0]))):
        poses = {tree[0][0] if tree else group[0]: Pose(np.eye(3), np.zeros(3))}
        for a, b in tree:  # in an order in which one of the two is placed already
            known, new = (a, b) if a in poses else (b, a)
            poses[new] = poses[known] @ _relative(seen, placed, singles, known, new)
        first = poses[min(poses)].inverse()
        joined.append({c: first @ pose for c, pose in poses.items()})
    return joined


def _alone(
    boards: Boards, singles: Mapping[int, OneCamera], bundle: Bundle, cameras: tuple[int, ...]
) -> dict[tuple[int, int], Floats]:
    """Lengths of the residuals of each view (camera, board), as numbered in the bundle, by its camera alone."""
    placed = [list(_placed(boards, c, singles[c]).values()) for c in cameras]
    found, count = {}, [0] * len(cameras)
    for view in bundle.views.each:  # of each camera in the order in which its boards are placed
        c = view.camera
        found[c, view.board] = lengths_alone(singles[cameras[c]].camera, view, placed[c][count[c]])
        count[c] += 1
    return found


def _placed(boards: Boards, c: int, single: OneCamera) -> dict[int, Pose]:
    """camera_from_board of each board that a camera saw."""
    _, numbers = renumbered(boards.of_camera(c))
    return {k: single.boards.pose(i) for i, k in enumerate(numbers)}


def _trees(cameras: list[int], shared: Mapping[tuple[int, int], int]) -> list[tuple[list[int], list[tuple[int, int]]]]:
    """Groups of cameras that shared boards join, each with its tree of the strongest pairs (Prim 1957), in order."""
    groups, left = [], list(cameras)
    while left:
        group, tree = [left.pop(0)], list[tuple[int, int]]()
        while True:
            pairs = [p for p, n in shared.items() if n > 0 and ((p[0] in group) != (p[1] in group))]
            if not pairs:
                break
            pair = max(pairs, key=lambda p: shared[p])
            new = pair[1] if pair[0] in group else pair[0]
            group.append(new)
            left.remove(new)
            tree.append(pair)
        groups.append((group, tree))
    return groups


def _relative(
    seen: Mapping[int, Mapping[int, BoardView]],
    placed: Mapping[int, Mapping[int, Pose]],
    singles: Mapping[int, OneCamera],
    a: int,
    b: int,
) -> Pose:
    """a_from_b: of what each shared board says, that which explains the others best."""
    common = sorted(seen[a].keys() & seen[b].keys())
    candidates = [placed[a][k] @ placed[b][k].inverse() for k in common]

    def error(pose: Pose) -> float:
        off = [median_error(singles[a].camera, seen[a][k], pose @ placed[b][k]) for k in common]
        off += [median_error(singles[b].camera, seen[b][k], pose.inverse() @ placed[a][k]) for k in common]
        return float(np.median(off))

    return min(candidates, key=error)


def _bundle(
    boards: Boards, singles: Mapping[int, OneCamera], poses: Mapping[int, Pose], cameras: tuple[int, ...]
) -> Bundle:
    number = {c: i for i, c in enumerate(cameras)}
    views, kept = renumbered([replace(v, camera=number[v.camera]) for v in boards.views if v.camera in number])
    placed = {c: _placed(boards, c, singles[c]) for c in cameras}
    rig_from_board = []
    for k in kept:
        by = [c for c in cameras if k in placed[c]]
        best = max(by, key=lambda c: next(len(v.rows) for v in boards.of_camera(c) if v.board == k))
        rig_from_board.append(poses[best] @ placed[best][k])
    there = tuple(CentralCamera(singles[c].camera.lens, poses[c].inverse()) for c in cameras)
    priors = []
    for c, camera in zip(cameras, there, strict=True):
        own = np.concatenate([rig_from_board[v.board].apply(v.xyz) for v in views if v.camera == number[c]])
        widest = min(float(np.quantile(angles(camera, own), 0.98)), 3.0)
        priors.append(prior_of(camera, boards.images[c], widest, singles[c].pixels, boards.settings))
    noise = np.array([singles[c].noise for c in cameras])
    placed_there = Placed.of(rig_from_board)
    return Bundle(there, tuple(priors), placed_there, Views(views, len(cameras)), noise, settings=boards.settings)


def _placed_again(bundle: Bundle) -> Bundle | None:
    """The bundle with boards placed anew that contradict a camera: a small board has a mirrored pose as well, and one
    camera alone cannot tell which is right. None where there is none."""
    usual, lengths = spreads(bundle), [bundle.lengths(c) for c in range(len(bundle.cameras))]
    views: dict[int, list[BoardView]] = {}
    stuck = set()
    for c, view, rows in bundle.views.in_stacks():
        views.setdefault(view.board, []).append(view)
        if np.median(lengths[c][rows]) > bundle.settings.max_board_error_ratio * usual[c]:
            stuck.add(view.board)
    rotation, translation, changed = bundle.boards.rotation.copy(), bundle.boards.translation.copy(), False
    for k in sorted(stuck):
        if len(views[k]) < 2:
            continue
        now = bundle.boards.pose(k)
        candidates = [pose for view in views[k] for pose in _seen_by(bundle, view, now)]
        off = [_off(bundle, usual, views[k], pose) for pose in (now, *candidates)]
        best = int(np.argmin(off))
        if off[best] < 0.5 * off[0]:
            pose = candidates[best - 1]
            rotation[k], translation[k], changed = pose.rotation, pose.translation, True
    return replace(bundle, boards=Placed(rotation, translation)) if changed else None


def _seen_by(bundle: Bundle, view: BoardView, now: Pose) -> list[Pose]:
    """rig_from_board as one camera sees it: its best pose, and the mirrored one."""
    camera = bundle.cameras[view.camera]
    alone = CentralCamera(camera.lens, Pose(np.eye(3), np.zeros(3)))
    both = pose_and_mirror(alone, view, camera.pose @ now, float(bundle.noise[view.camera]), bundle.settings)
    return [camera.pose.inverse() @ pose for pose in both]


def _off(bundle: Bundle, usual: Floats, views: list[BoardView], pose: Pose) -> float:
    """How far off the corners of a board are in the worst of its views, over the cameras' usual (C,)."""
    return max(median_error(bundle.cameras[v.camera], v, pose) / float(usual[v.camera]) for v in views)


def _check(boards: Boards, cameras: tuple[int, ...], found: Adjusted, half: Floats) -> None:
    usual = spreads(found.bundle)
    worst = int(np.argmax(usual / half))
    if usual[worst] < boards.settings.max_camera_error_half_sides * half[worst]:
        return
    raise _contradiction(boards, [cameras[worst]], f"its corners are left {usual[worst]:.3g} px off")


def _check_pairs(
    boards: Boards, singles: Mapping[int, OneCamera], cameras: tuple[int, ...], doubts: Sequence[Agreement]
) -> None:
    """FitError where cameras that fit alone are far off together, or fit together in a mirror."""
    _check_mirrors(boards, singles, cameras, doubts)
    bad = [one for one in doubts if one.hopeless]
    if not bad:
        return
    culprits = _culprits(bad)
    worst = max(bad, key=lambda one: one.together / one.alone)
    raise _contradiction(
        boards,
        [cameras[c] for c in culprits],
        f"alone {worst.alone:.2g} px, together {worst.together:.2g} px",
    )


def _with_slack(
    boards: Boards,
    singles: Mapping[int, OneCamera],
    cameras: tuple[int, ...],
    bundle: Bundle,
    doubts: Sequence[Agreement],
    progress: Progress,
) -> tuple[Adjusted, list[tuple[int, int, float]], list[Agreement]]:
    """Cameras that contradict each other adjusted as if the boards had moved; the corners wrong even so; and the doubts
    with what is left together now. That is the noise of each camera then: whoever measures with this rig is likely to
    show it pictures of other instants, too."""
    half = np.array([boards.images[c].half for c in cameras])
    own = np.maximum([singles[c].noise for c in cameras], 1e-5 * half)
    found, wrong = with_slack(replace(bundle, noise=own), progress)
    extent = float(np.median([np.ptp(view.xyz, axis=0).max() for view in bundle.views.each]))
    settings, most = boards.settings, boards.settings.max_moved_extents * extent
    wrong_share = len(wrong) / sum(len(stack.uv) for stack in bundle.views.stacks)
    if wrong_share > settings.max_wrong_corner_share or found.bundle.slack > most:
        worst = max(doubts, key=lambda one: one.together / one.alone)
        told = f"alone {worst.alone:.2g} px, together {worst.together:.2g} px"
        if found.bundle.slack > most:
            told += f", as if boards had moved by {np.sqrt(6) * found.bundle.slack:.1g} between their pictures"
        raise _contradiction(boards, [cameras[c] for c in _culprits(doubts)], told)
    pairs = {one.pair for one in doubts}
    now = agreements(found.bundle, half, _alone(boards, singles, bundle, cameras))
    doubts = [one for one in now if one.pair in pairs]
    noise = own.copy()
    for one in doubts:
        for c in one.pair:
            noise[c] = max(noise[c], one.together)
    listed = [(row, cameras[c], off) for row, c, off in wrong]
    return found._replace(bundle=replace(found.bundle, noise=noise)), listed, doubts


def _culprits(bad: Sequence[Agreement]) -> list[int]:
    """The camera that is in all of two pairs or more, else all of them."""
    in_all = set(bad[0].pair).intersection(*(one.pair for one in bad))
    return sorted(in_all if len(bad) > 1 and in_all else {c for one in bad for c in one.pair})


def _check_numbering(boards: Boards, singles: Mapping[int, OneCamera], cameras: tuple[int, ...]) -> None:
    """FitError where two cameras count the corners of the same board from different ends."""
    corners = np.concatenate([view.xyz for view in boards.views])
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    seen = {c: {view.board: view for view in boards.of_camera(c)} for c in cameras}
    placed = {c: _placed(boards, c, singles[c]) for c in cameras}
    for a, b in combinations(cameras, 2):
        found = find_reversed(singles[a].camera, seen[a], placed[a], placed[b], middle)
        if found is None or mirrored(singles[a].camera, seen[a], placed[a], placed[b]) < found.error:
            continue
        shots = [str(boards.shots[seen[a][k].rows[0]]) for k in found.boards]
        raise FitError(
            f"{boards.names[a]} and {boards.names[b]} count the corners of {len(shots)} of the {found.of} boards that "
            f"both saw from different ends: {list_some(shots)}.",
            why=f"counted {found.way} in one of the two, they fit; OpenCV's findChessboardCorners, among others, "
            "begins at either end of a board that looks the same upside down",
            fix="reverse these corners in one of the two; or find them with implicam detect, which counts from one end",
        )


def _check_mirrors(
    boards: Boards, singles: Mapping[int, OneCamera], cameras: tuple[int, ...], doubts: Sequence[Agreement]
) -> None:
    """FitError where one of two cameras that contradict each other has mirrored pictures."""
    seen = {c: {view.board: view for view in boards.of_camera(c)} for c in cameras}
    placed = {c: _placed(boards, c, singles[c]) for c in cameras}
    found = []
    for one in doubts:
        a, b = (cameras[c] for c in one.pair)
        left = mirrored(singles[a].camera, seen[a], placed[a], placed[b])
        if left < boards.settings.max_mirrored_ratio * one.together:
            found.append(one._replace(alone=left))
    if not found:
        return
    names, worst = [boards.names[cameras[c]] for c in _culprits(found)], found[0]
    how = f"{worst.together:.2g} px are left; with one turned left to right, {worst.alone:.2g} px"
    raise FitError(
        f"the pictures of {names[0]} are mirrored: together with the others {how}."
        if len(names) == 1
        else f"the pictures of one of {' and '.join(names)} are mirrored: together {how}.",
        why="a webcam flips its pictures, a camera looks into a mirror, or v is counted from below",
        fix="switch the flip off, or flip the pictures back before the corners are detected",
    )


def _refined(
    boards: Boards, cameras: tuple[int, ...], found: Adjusted, progress: Progress
) -> tuple[Adjusted, list[tuple[int, int, float]]]:
    """Without the corners that are wrong, by plain least squares, with the noise that the residuals show."""
    everything, stated = found.bundle.views, boards.stated[list(cameras)]
    most = boards.settings.max_corner_error_sds
    bundle = replace(found.bundle, noise=np.maximum(spreads(found.bundle), 1e-6))
    for _ in range(3):
        bundle = replace(bundle, views=everything)
        inliers = [bundle.lengths(c) <= most * bundle.noise[c] for c in range(len(cameras))]
        found = adjust(replace(bundle, views=everything.select(inliers)), robust=False, progress=progress)
        noise = _noise(found.bundle, stated)
        settled = np.allclose(noise, bundle.noise, rtol=0.02)
        bundle = replace(found.bundle, noise=noise)
        if settled:
            break
    _check_shared(boards, cameras, everything, inliers)
    wrong = []
    off = [np.linalg.norm(replace(bundle, views=everything).residuals(c), axis=1) for c in range(len(cameras))]
    for c, view, rows in everything.in_stacks():
        bad = np.flatnonzero(~inliers[c][rows])
        wrong += [(int(view.rows[i]), cameras[c], float(off[c][rows][i])) for i in bad]
    return adjust(bundle, robust=False), wrong


def _check_shared(boards: Boards, cameras: tuple[int, ...], views: Views, inliers: list[Bools]) -> None:
    """FitError where a camera's corners do not fit on boards that another camera saw too, though alone they do."""
    rows_of: dict[int, dict[int, Bools]] = {}
    for c, view, rows in views.in_stacks():
        rows_of.setdefault(view.board, {})[c] = inliers[c][rows]
    lost: dict[tuple[int, int], list[float]] = {}
    for seen in rows_of.values():
        for a, b in combinations(sorted(seen), 2):
            lost.setdefault((a, b), []).append(1 - float(np.mean(np.concatenate([seen[a], seen[b]]))))
    bad = [pair for pair, shares in lost.items() if np.mean(shares) > boards.settings.max_wrong_corner_share]
    if not bad:
        return
    in_all = set(bad[0]).intersection(*bad)
    culprits = sorted(in_all or set().union(*bad))
    share = 100 * max(np.mean(lost[pair]) for pair in bad)
    raise _contradiction(
        boards,
        [cameras[c] for c in culprits],
        f"on boards that they saw together up to {share:.0f} % of the corners do not fit",
    )


def _contradiction(boards: Boards, which: list[int], how: str) -> FitError:
    names = [boards.names[c] for c in which]
    one = len(names) == 1
    without = " or ".join(f"--without {name}" for name in names)
    leave_out = f"; or use {without}" if len(boards.cameras) > 2 else ""
    return FitError(
        f"the cameras contradict each other: {' and '.join(names)}: {how}.",
        why="alone it fits its boards; with the others it does not"
        if one
        else "each fits its boards, but not the other",
        fix=f"see that all pictures are of the same instants and that no camera moved{leave_out}",
    )


def _noise(bundle: Bundle, stated: Floats) -> Floats:
    """(C,) the residuals' sum of squares over the degrees of freedom left: a board's pose is shared by who saw it."""
    squares, freedom = np.zeros(len(bundle.cameras)), np.array([-float(camera.size) for camera in bundle.cameras])
    stacks = bundle.views.stacks
    corners = np.sum([np.bincount(s.board, minlength=len(bundle.boards.translation)) for s in stacks], axis=0)
    for c, stack in enumerate(stacks):
        squares[c] = np.nansum((bundle.residuals(c) / stack.relative[:, None]) ** 2)
        freedom[c] += float(np.sum(2 - 6 / corners[stack.board]))
    own = np.sqrt(squares / np.maximum(freedom, 1.0))
    told = np.isfinite(stated)
    prior = bundle.settings.noise_prior_residuals
    mixed = np.sqrt((squares + prior * np.nan_to_num(stated) ** 2) / (np.maximum(freedom, 1.0) + prior))
    return np.asarray(np.maximum(np.where(told, mixed, own), 1e-6), dtype=np.float64)
