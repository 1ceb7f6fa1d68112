"""All cameras from no guess: the best pair first, then one camera after the other, eqs. (V3) and (V4)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from implicam.calibrators.forward_gp.choose_camera import as_started, candidates, choose
from implicam.calibrators.forward_gp.families import Scene, family_prior
from implicam.calibrators.forward_gp.settings import ForwardGPSettings
from implicam.calibrators.forward_gp.wand.bundle import Bundle, Lengths, rows_of
from implicam.calibrators.forward_gp.wand.exchanged import find_exchanged
from implicam.calibrators.forward_gp.wand.pairs import (
    MIN_SHARED_POINTS,
    MIN_WHOLE_FRAMES,
    PairStart,
    meet_two,
    pair_starts,
)
from implicam.calibrators.forward_gp.wand.waves import Waves
from implicam.errors import FitError
from implicam.geometry import Bools, Floats, Pose
from implicam.rig_model import MIN_POINTS_PER_CAMERA, CentralCamera, GeneralCamera, Image, Prior
from implicam.rig_model.initialise import start_camera

_LOG = logging.getLogger(__name__)

WandCamera = CentralCamera | GeneralCamera
"""An ordinary camera, or one of any kind."""

MAX_PAIRS = 4
"""Pairs of cameras that are tried as the first."""

SCHEDULE = ((4.0, 0.03), (1.5, 0.01), (1.0, 0.003))
"""Noise in pixels of an image of 1280, and sd of the length over the length, of the steps of an adjustment."""

JUDGED_LENGTH_SD = 0.005
"""Sd of the length over the length, by which pairs are compared, with a noise of one pixel of 1280."""

BEST_STARTS = (8, 3, 2)
"""So many rungs of the ladder go through each step."""

STILL_STARTS = (8, 5, 5)
"""The same where no length tells them apart: other cameras do."""

GOOD_PX, GOOD_SHARE = 2.0, 0.5
"""Median error in pixels of 1280, and share of shared views that agree, of a pair that is good enough to go on with."""

GOOD_LENGTH, MIN_LENGTH_SHARE = 0.02, 0.35
"""By how much a wand's length may be off, over the length, in at least this share of the frames that show it: of two
cameras with a fifth of wrong views 0.41 of the frames have four right ones."""

NEAR_PX = 6.0
"""In pixels of 1280: a view that far off does not belong to a place, until the fit itself judges it better."""


@dataclass(frozen=True, eq=False)
class Started:
    """Cameras by number, in units of the wand's length: places (2 F, 3), NaN where unknown, and agree (2 F, C) which
    views agree; first, the two that all others were joined to; waves, what was seen, with exchanged ends put right."""

    waves: Waves
    first: tuple[int, ...]
    cameras: dict[int, WandCamera]
    places: Floats
    agree: Bools


def prior_of(camera: WandCamera, image: Image, uv: Floats, settings: ForwardGPSettings) -> Prior:
    """The prior of a camera that is used where it saw something.

    Args:
        camera: As it is now.
        image: Where its pixels are measured from.
        uv: (n, 2) what it saw.
        settings: The prior's sds.
    """
    ahead = camera.lines(uv)[1] @ camera.pose.rotation[2]
    angle = np.arccos(np.clip(ahead[np.isfinite(ahead)], -1, 1))
    widest = max(float(np.quantile(angle, 0.98)) if len(angle) else 1.0, 0.02)
    if isinstance(camera, GeneralCamera):
        return family_prior(camera, "free", image, widest, settings)
    return camera.prior(image, widest, settings)


def start(waves: Waves, settings: ForwardGPSettings, tried: Collection[tuple[int, ...]] = ()) -> Started:
    """Every camera that can be started.

    Args:
        waves: What was seen, in units of the wand's length.
        settings: Priors.
        tried: Pairs that are not to be the first: it came to nothing.

    Raises:
        FitError: No two cameras can be.
    """
    pair = _best_pair(waves, settings, tried)
    cameras, waves = pair.cameras, pair.waves
    first = tuple(cameras)
    while True:
        if waves.still:
            cameras = _sized(waves, cameras)
        places, agree = consensus(waves, cameras)
        left = [c for c in range(len(waves.seen)) if c not in cameras]
        odd = sum(isinstance(camera, GeneralCamera) for camera in cameras.values()) > len(cameras) / 2
        each = {c: _resected(waves, c, places, settings, ordinary_first=not odd) for c in left}
        joined = {c: found for c, found in each.items() if found is not None}
        if not joined:
            waves, joined = _resected_exchanged(waves, left, places, settings)
        if not joined:
            break
        cameras = _adjusted_together(waves, cameras | joined, settings)
        _LOG.info("cameras %s", sorted(cameras))
    wrong = find_exchanged(waves, cameras, NEAR_PX)
    if wrong.any():
        _LOG.info("ends exchanged in %s pictures", wrong.sum(axis=0))
        waves = waves.with_exchanged(wrong)
        places, agree = consensus(waves, cameras)
    return Started(waves, first, cameras, places, agree)


def _sized(waves: Waves, cameras: dict[int, WandCamera]) -> dict[int, WandCamera]:
    """As large as the scale bars say that these cameras see: the first two cameras may see none."""
    places = consensus(waves, cameras)[0].reshape(-1, 2, 3)
    ratio = waves.lengths / np.linalg.norm(places[:, 1] - places[:, 0], axis=1)
    ratio = ratio[np.isfinite(ratio) & waves.ends]
    if not len(ratio):
        return cameras
    by = float(np.median(ratio))
    return {
        c: replace(camera, pose=Pose(camera.pose.rotation, by * camera.pose.translation))
        for c, camera in cameras.items()
    }


def _resected_exchanged(
    waves: Waves, left: Sequence[int], places: Floats, settings: ForwardGPSettings
) -> tuple[Waves, dict[int, WandCamera]]:
    """Cameras that belong to the others when their two markers are exchanged in all frames."""
    joined: dict[int, WandCamera] = {}
    for c in left:
        other = waves.all_exchanged(c)
        camera = _resected_ordinary(other, c, places, settings, min_share=GOOD_SHARE)
        if camera is not None:
            waves, joined[c] = other, camera
    return waves, joined


class _Pair(NamedTuple):
    """Two cameras: the cost per view, they, whether they are good enough, and what was seen."""

    score: float
    cameras: dict[int, WandCamera]
    good: bool
    waves: Waves


def _best_pair(waves: Waves, settings: ForwardGPSettings, tried: Collection[tuple[int, ...]]) -> _Pair:
    uv = waves.uv
    seen = np.isfinite(uv).all(axis=2).astype(np.int64)
    shared = np.einsum("ni,nj->ij", seen, seen)
    pairs = sorted(combinations(range(seen.shape[1]), 2), key=lambda pair: -shared[pair])
    best: _Pair | None = None
    for pair in [pair for pair in pairs if pair not in tried][:MAX_PAIRS]:
        found = _pair(waves, pair, settings)
        if found is None:
            continue
        _LOG.info("pair %s: score %.3g, %s", pair, found.score, "good" if found.good else "poor")
        if best is None or found.score < best.score:
            best = found
        if found.good:
            break
    if best is None or not best.good:
        best = _best_of_odd(waves, [pair for pair in pairs if pair not in tried][:1], settings, best)
    if best is None:
        most = max((int(shared[pair]) for pair in pairs), default=0)
        two = " and ".join(waves.names[c] for c in pairs[0]) if pairs else "two cameras"
        if waves.still:
            raise FitError(
                "no two cameras can be started from these points.",
                why=f"{two}, which share most, see {most} points together, and it takes {MIN_SHARED_POINTS} that agree "
                "on two cameras",
                fix="show all cameras more points, in all of their pictures, near and far; do names mean the same "
                "point in every camera?",
            )
        raise FitError(
            "no two cameras can be started from this wand.",
            why=f"{two}, which share most, see {most} markers at the same time; it takes {MIN_SHARED_POINTS}, and both "
            f"markers in {MIN_WHOLE_FRAMES} frames, that agree on two cameras",
            fix="wave the wand longer where the cameras see it together, turned in all directions, near and far",
        )
    return best


class Odd(NamedTuple):
    """What a picture is before a camera is an ordinary one: p, half the log of how much wider than high a pixel is, and
    whether it is mirrored."""

    p: float = 0.0
    mirrored: bool = False

    def straightened(self, uv: Floats, image: Image) -> Floats:
        """The pixels of the ordinary camera.

        Args:
            uv: (n, 2) as seen.
            image: Where they are measured from.
        """
        by = np.exp([-self.p, self.p]) * [-1.0 if self.mirrored else 1.0, 1.0]
        return np.asarray(image.centre + by * (uv - image.centre), dtype=np.float64)

    def camera(self, ordinary: CentralCamera) -> WandCamera:
        """The camera that sees so.

        Args:
            ordinary: The one that sees the straightened pixels, its axis at their middle.
        """
        if self == Odd():
            return ordinary
        found = GeneralCamera.from_central(ordinary)
        return replace(found, shape=np.array([self.p, 0.0]), mirrored=self.mirrored)


ODD_PAIRS = ((Odd(), Odd(mirrored=True)), *((Odd(p), Odd(p)) for p in (0.17, -0.17, 0.35, -0.35)))
"""What two cameras are tried as that are not two ordinary ones: one before a mirror, or both with pixels 0.5, 0.7, 1.4
or 2 times as wide as high; what is between is found by the adjustment."""


def _best_of_odd(
    waves: Waves,
    pairs: Sequence[tuple[int, int]],
    settings: ForwardGPSettings,
    best: _Pair | None,
) -> _Pair | None:
    """Two cameras that are no ordinary ones, or one of which has the ends exchanged, if they are better; else what
    there was."""
    for pair in pairs:
        exchanged = _pair(waves.all_exchanged(pair[1]), pair, settings)
        if exchanged is not None and exchanged.good:
            return exchanged
        for odd in ODD_PAIRS:
            found = _pair(waves, pair, settings, odd)
            if found is not None and (best is None or found.score < best.score):
                _LOG.info("pair %s as %s: score %.3g, %s", pair, odd, found.score, "good" if found.good else "poor")
                best = found
    return best


def _pair(
    waves: Waves, pair: tuple[int, int], settings: ForwardGPSettings, odd: tuple[Odd, Odd] = (Odd(), Odd())
) -> _Pair | None:
    """Two cameras from what both saw; None where that is too little."""
    uv = waves.uv[:, pair]
    both = np.flatnonzero(np.isfinite(uv).all(axis=(1, 2)))
    if len(both) < MIN_SHARED_POINTS:
        return None
    marker = np.where(waves.ends[both // 2], both % 2, -1)
    images = [waves.images[c] for c in pair]
    straight = np.stack([one.straightened(uv[both, k], images[k]) for k, one in enumerate(odd)], axis=1)
    starts = pair_starts(straight, both // 2, marker, images, waves.lengths[both // 2], still=waves.still)
    starts = starts[: BEST_STARTS[0]]
    if not starts:
        return None
    part = _part(waves, pair, both)
    every = _whole(part, np.isin(np.arange(2 * part.frames), both))
    found = [
        _Trial(_bundle_of(one, part, both, straight, images, odd, settings), _part(waves, pair, both[one.inliers]), 0.0)
        for one in starts
    ]
    scale = np.array([image.half for image in images]) / 640
    for (px, relative), most in zip(SCHEDULE, STILL_STARTS if waves.still else BEST_STARTS, strict=True):
        found = sorted(
            (trial.adjusted(px * scale, relative).judged(part, every, scale) for trial in found[:most]), key=_cost
        )
    if waves.still and len(waves.seen) > 2:
        found.sort(key=lambda trial: -_joinable(waves, dict(zip(pair, trial.bundle.cameras, strict=True)), settings))
    score, bundle = found[0].cost, found[0].bundle
    off = np.max([e / (image.half / 640) for e, image in zip(bundle.errors(part.seen), images, strict=True)], axis=0)
    near = off < NEAR_PX
    across = bundle.places[every.frames, 1] - bundle.places[every.frames, 0]
    right = np.abs(np.linalg.norm(across, axis=1) / every.length - 1) < GOOD_LENGTH
    at = np.zeros(2 * part.frames, dtype=np.bool_)
    at[both] = near
    right &= at[2 * every.frames] & at[2 * every.frames + 1]
    good = near.mean() > GOOD_SHARE and np.median(off[near]) < GOOD_PX
    good = good and (waves.still or right.mean() > MIN_LENGTH_SHARE)
    return _Pair(score / len(both), dict(zip(pair, bundle.cameras, strict=True)), bool(good), waves)


def _joinable(waves: Waves, cameras: dict[int, WandCamera], settings: ForwardGPSettings) -> float:
    """How many of the other cameras' views agree with ordinary ones beside these two, as shares: without lengths two
    cameras fit as well in a world that is skew, and it is the others that do not fit in there."""
    places, _ = consensus(waves, cameras)
    shared = {c: np.isfinite(places[seen.rows]).all(axis=1) for c, seen in enumerate(waves.seen) if c not in cameras}
    total = 0.0
    for c in sorted(shared, key=lambda c: -shared[c].sum())[:MAX_JOINED]:
        known, seen = shared[c], waves.seen[c]
        camera = _resected_ordinary(waves, c, places, settings)
        if camera is None:
            continue
        off = np.linalg.norm(camera.pixel(places[seen.rows[known]]) - seen.uv[known], axis=1)
        off = np.nan_to_num(off / (waves.images[c].half / 640), nan=np.inf)
        total += float(np.mean(1 / (1 + off**2)))
    return total


MAX_JOINED = 2
"""Cameras by which two others are compared."""


class _Trial(NamedTuple):
    """Two cameras, the views that agreed when they were found, and the cost of all views."""

    bundle: Bundle
    agreed: Waves
    cost: float

    def adjusted(self, noise: Floats, relative_sd: float) -> _Trial:
        """To the views that agreed: wrong ones among them would draw it elsewhere while the noise is large."""
        places = np.zeros(2 * self.agreed.frames, dtype=np.bool_)
        places[self.agreed.seen[0].rows] = True
        lengths = _whole(self.agreed, places)
        lengths = lengths._replace(sd=relative_sd * lengths.length)
        bundle = self.bundle.adjusted(self.agreed.seen, noise, lengths, robust=True, max_steps=12, tolerance=1e-3)
        return self._replace(bundle=bundle)

    def judged(self, every: Waves, lengths: Lengths, scale: Floats) -> _Trial:
        """By all views, of a pixel, and all lengths."""
        lengths = lengths._replace(sd=JUDGED_LENGTH_SD * lengths.length)
        return self._replace(cost=self.bundle.cost(every.seen, scale, lengths, robust=True))


def _cost(trial: _Trial) -> float:
    return trial.cost


def _part(waves: Waves, cameras: Sequence[int], rows: np.ndarray | None = None) -> Waves:
    """Some cameras, and their views of some places."""
    mask = np.ones(2 * waves.frames, dtype=np.bool_) if rows is None else np.isin(np.arange(2 * waves.frames), rows)
    return replace(
        waves,
        seen=tuple(rows_of(mask, waves.seen[c]) for c in cameras),
        images=tuple(waves.images[c] for c in cameras),
        stated=waves.stated[list(cameras)],
    )


def _whole(waves: Waves, known: Bools) -> Lengths:
    """The frames of which both markers (2 F,) are known."""
    frames = np.flatnonzero(known.reshape(-1, 2).all(axis=1) & waves.ends)
    return waves.lengths_of(frames)


def _bundle_of(
    one: PairStart, part: Waves, both: np.ndarray, straight: Floats, images: Sequence[Image], odd: Sequence[Odd],
    settings: ForwardGPSettings,
) -> Bundle:  # fmt: skip
    uv = part.uv[both]
    rays = np.stack([camera.lens.ray_from_pixel(straight[:, c])[0] for c, camera in enumerate(one.cameras)])
    x, before = meet_two(rays, one.cameras[1].pose)
    middle = np.median(x[before & one.inliers], axis=0)
    places = np.tile(middle, (2 * part.frames, 1))
    places[both] = np.where((before & np.isfinite(x).all(axis=1))[:, None], x, middle)
    # about the middle of what was seen: a turn of a camera about a far origin would move everything
    cameras = tuple(what.camera(c.in_frame(Pose(np.eye(3), middle))) for c, what in zip(one.cameras, odd, strict=True))
    priors = tuple(prior_of(c, i, uv[:, k], settings) for k, (c, i) in enumerate(zip(cameras, images, strict=True)))
    return Bundle(cameras, (places - middle).reshape(-1, 2, 3), priors)


def consensus(waves: Waves, cameras: dict[int, WandCamera], near_px: Floats | float = NEAR_PX) -> tuple[Floats, Bools]:
    """Where each place is, by those two of its views that most others agree with.

    Args:
        waves: What was seen.
        cameras: By number.
        near_px: How far views that agree are off, in pixels of an image of 1280.

    Returns:
        (2 F, 3), NaN where fewer than two views agree; and (2 F, C) which agree.
    """
    n, uv = 2 * waves.frames, waves.uv
    lines = {c: camera.lines(uv[:, c]) for c, camera in cameras.items()}
    best, places, agree = np.zeros(n), np.full((n, 3), np.nan), np.zeros(uv.shape[:2], dtype=np.bool_)
    for i, j in combinations(sorted(cameras), 2):
        rows = np.flatnonzero(np.isfinite(lines[i][1]).all(axis=1) & np.isfinite(lines[j][1]).all(axis=1))
        if not len(rows):
            continue
        # in the frame of camera i without its turn
        x, before = meet_two(
            np.stack([lines[i][1][rows], lines[j][1][rows]]), Pose(np.eye(3), lines[i][0] - lines[j][0])
        )
        x = x + lines[i][0]
        off = np.full((len(rows), uv.shape[1]), np.inf)
        for c, camera in cameras.items():
            away = np.linalg.norm(camera.pixel(x) - uv[rows, c], axis=1) / (waves.images[c].half / 640)
            off[:, c] = np.where(np.isfinite(away), away, np.inf)
        inside = off < near_px
        inside[~before] = False
        both = inside[:, i] & inside[:, j]
        worth = np.where(both, inside.sum(axis=1) + 0.5 - 0.5 * np.mean(np.minimum(off / near_px, 1), axis=1), 0)
        better = worth > best[rows]
        best[rows[better]], places[rows[better]], agree[rows[better]] = worth[better], x[better], inside[better]
    return places, agree


def _resected(
    waves: Waves, c: int, places: Floats, settings: ForwardGPSettings, *, ordinary_first: bool
) -> WandCamera | None:
    """A camera from the places that the others know: an ordinary one, or one of any kind that half of the views agree
    with; None where these are too few, or do not fix it. Beside cameras that are not ordinary one that is is no
    surprise, but the kind is asked for first."""
    ordinary = _resected_ordinary(waves, c, places, settings)
    if ordinary is not None and ordinary_first:
        return ordinary
    seen = waves.seen[c]
    known = np.isfinite(places[seen.rows]).all(axis=1)
    if known.sum() < MIN_VIEWS_OF_ODD_CAMERA:
        return ordinary
    scene = Scene(
        places[seen.rows[known]], seen.uv[known], seen.relative[known], waves.images[c], float(waves.stated[c]),
        settings,
    )  # fmt: skip
    try:
        some = candidates(scene)
        started = as_started(choose([some], settings)[0], scene, some)
    except (FitError, np.linalg.LinAlgError):
        return ordinary
    error = scene.error(started.camera)  # type: ignore[arg-type]
    near = error < NEAR_PX * waves.images[c].half / 640
    if near.mean() < GOOD_SHARE or not isinstance(started.camera, GeneralCamera):
        return ordinary
    _LOG.info("camera %d is of another kind: %s%s", c, started.family, " mirrored" * started.camera.mirrored)
    return started.camera


MIN_VIEWS_OF_ODD_CAMERA = 20
"""Of places that others know: a camera of seventeen numbers goes through fewer by chance."""


def _resected_ordinary(
    waves: Waves, c: int, places: Floats, settings: ForwardGPSettings, min_share: float = 0.0
) -> CentralCamera | None:
    """An ordinary camera; None where the views are too few, or do not fix it, or fewer than a share of them agree."""
    seen = waves.seen[c]
    known = np.isfinite(places[seen.rows]).all(axis=1)
    if known.sum() < MIN_POINTS_PER_CAMERA:
        return None
    try:
        found = start_camera(places[seen.rows[known]], seen.uv[known], waves.images[c], "central", settings)
    except (FitError, np.linalg.LinAlgError):
        return None
    error = np.linalg.norm(found.camera.pixel(places[seen.rows[known]]) - seen.uv[known], axis=1)[found.inliers]
    good = found.inliers.sum() >= MIN_POINTS_PER_CAMERA and np.median(error) < 5 * waves.images[c].half / 640
    good = good and found.inliers.mean() >= max(min_share, MIN_ORDINARY_SHARE)
    return found.camera if good and isinstance(found.camera, CentralCamera) else None


MIN_ORDINARY_SHARE = 0.3
"""Of the views of known places that agree with an ordinary camera: of a mirrored or a squeezed picture a few do."""


def describe_stranger(waves: Waves, c: int, known: Floats, settings: ForwardGPSettings) -> str:
    """Why a camera does not belong to the others, as far as it can be told.

    Args:
        waves: What was seen.
        c: Its number.
        known: (2 F, 3) places, NaN where unknown.
        settings: Priors.

    Returns:
        A part of a sentence.
    """
    there = int(np.isfinite(known[waves.seen[c].rows]).all(axis=1).sum())
    if there < MIN_POINTS_PER_CAMERA:
        few = f"it saw {there} of the markers that the others place, and it takes {MIN_POINTS_PER_CAMERA}."
        return few + _friends(waves, c)
    exchanged = known.reshape(-1, 2, 3)[:, ::-1].reshape(-1, 3)
    if _resected_ordinary(waves, c, exchanged, settings, min_share=0.5) is not None:
        return "its two markers are exchanged: exchange them in all its frames."

    def misfit(tried: Waves) -> float:
        camera = _resected_ordinary(tried, c, known, settings, min_share=0.5)
        if camera is None:
            return np.inf
        views = tried.seen[c]
        off = np.linalg.norm(camera.pixel(known[views.rows]) - views.uv, axis=1)
        return float(np.nanmedian(off))

    late = find_shift(waves, c, misfit, SHIFTS)
    if late is not None:
        return f"its pictures are taken {describe_shift(late)} those of the others: trigger all cameras by one signal."
    return "too few of its views agree with the places that the other cameras know."


SHIFTS = (0.25, 0.5, 0.75, *map(float, range(1, 13)))
"""Frames by which a camera is looked for, early or late, that belongs to the others in no other way."""

MAX_SHIFTED_RATIO = 0.5
"""A shift leaves less than this part of what no shift leaves, or it is none."""


def find_shift(waves: Waves, c: int, misfit: Callable[[Waves], float], shifts: Sequence[float]) -> float | None:
    """By how many frames a camera is late.

    Args:
        waves: What was seen.
        c: Its number.
        misfit: How little it agrees with the others, as it is or shifted; infinite where not at all.
        shifts: To be tried, early and late.

    Returns:
        Frames, negative where it is early; None where no shift makes it agree much better.
    """
    now = misfit(waves)
    tried = {0.0: now}

    def try_one(late: float) -> None:
        moved = waves.shifted(c, late)
        if moved is not None and late not in tried:
            tried[late] = misfit(moved)

    for late in (sign * size for size in shifts for sign in (1.0, -1.0)):
        try_one(late)
    best = min(tried, key=lambda late: tried[late])
    for step in (0.12, 0.06):
        for late in (best - step, best + step):
            try_one(round(late, 3))
        best = min(tried, key=lambda late: tried[late])
    good = best != 0 and np.isfinite(tried[best]) and tried[best] < MAX_SHIFTED_RATIO * now
    return float(best) if good else None


def describe_shift(late: float) -> str:
    """A part of a sentence.

    Args:
        late: By so many frames.
    """
    return f"about {abs(late):.2g} frame{'s' * (abs(late) != 1)} {'after' if late > 0 else 'before'}"


def explain_no_rig(waves: Waves) -> str:
    """What is wrong with the two cameras that share most, if it can be told; empty where not.

    Args:
        waves: What was seen.
    """
    seen = np.isfinite(waves.uv).all(axis=2).astype(np.int64)
    shared = np.einsum("ni,nj->ij", seen, seen)
    pair = max(combinations(range(len(waves.seen)), 2), key=lambda two: int(shared[two]))
    images = [waves.images[c] for c in pair]

    def misfit(tried: Waves) -> float:
        uv = tried.uv[:, pair]
        both = np.flatnonzero(np.isfinite(uv).all(axis=(1, 2)))
        if len(both) < MIN_SHARED_POINTS:
            return np.inf
        frames = np.unique(both // 2)
        both = both[np.isin(both // 2, frames[:: -(-len(frames) // MAX_SHIFTED_FRAMES)])]
        marker = np.where(tried.ends[both // 2], both % 2, -1)
        starts = pair_starts(uv[both], both // 2, marker, images, tried.lengths[both // 2])
        return float(np.exp(starts[0].rank)) if starts else np.inf

    late = find_shift(waves, pair[1], misfit, PAIR_SHIFTS)
    if late is None:
        return ""
    one, two = (waves.names[c] for c in pair)
    return f"the pictures of {two} are taken {describe_shift(late)} those of {one}"


MAX_SHIFTED_FRAMES = 100
"""Frames that are enough to see whether two cameras are in step."""

PAIR_SHIFTS = (0.25, 0.5, 1.0, 2.0, 3.0, 5.0)
"""Frames by which two cameras are tried to be out of step, where they do not make a rig."""


def _friends(waves: Waves, c: int) -> str:
    """Which camera it shares most with, as another sentence."""
    seen = np.isfinite(waves.uv[..., 0])
    shared = (seen & seen[:, c, None]).sum(axis=0)
    shared[c] = 0
    best = int(np.argmax(shared))
    if shared[best] < MIN_SHARED_POINTS:
        return " It hardly sees the wand when any other camera does."
    return f" With {waves.names[best]} it shares {shared[best]}: wave where cameras of both groups see it."


def _adjusted_together(
    waves: Waves, cameras: dict[int, WandCamera], settings: ForwardGPSettings
) -> dict[int, WandCamera]:
    """A short robust adjustment of all cameras so far."""
    places, agree = consensus(waves, cameras)
    bundle = bundle_of(waves, cameras, places, settings)
    used = sorted(cameras)
    seen = [waves.seen[c].select(agree[waves.seen[c].rows, c]) for c in used]
    noise = np.array([waves.images[c].half for c in used]) / 640
    lengths = _whole(waves, np.isfinite(places[:, 0]))
    lengths = lengths._replace(sd=0.002 * lengths.length)
    bundle = bundle.adjusted(seen, noise, lengths, robust=True, max_steps=10, tolerance=1e-3)
    return dict(zip(used, bundle.cameras, strict=True))


def bundle_of(waves: Waves, cameras: dict[int, WandCamera], places: Floats, settings: ForwardGPSettings) -> Bundle:
    """Cameras and places as one.

    Args:
        waves: What was seen.
        cameras: By number.
        places: (2 F, 3), NaN where unknown: these are put where the others are.
        settings: Priors.
    """
    middle = np.nanmedian(places, axis=0)
    whole = np.where(np.isfinite(places), places, middle).reshape(-1, 2, 3)
    used = sorted(cameras)
    priors = tuple(prior_of(cameras[c], waves.images[c], waves.seen[c].uv, settings) for c in used)
    return Bundle(tuple(cameras[c] for c in used), whole, priors)
