"""Where the world of a calibration without known positions is: from what its cameras measure, and without a new fit.

A wand says how the cameras stand to each other, and not where the floor is. Known points (the markers of an L-frame,
dots of a plate), points that an axis or a plane goes through, a plumb line, or a camera say it. What their measuring
leaves uncertain goes into the error bars of all positions; distances and their error bars stay what they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.special import chdtrc

from implicam.calibrators import Calibration
from implicam.calibrators.protocol import PlacesItsWorld
from implicam.dataset import Dataset, KnownPositions
from implicam.dataset.wand import FRAME, MARKER
from implicam.derived.joint_positions import JointPositions, joint_of_rows
from implicam.errors import DatasetError, FitError, UsageError, did_you_mean
from implicam.formatting import decimal_number, list_some
from implicam.geometry import Floats, Pose, register, rotation_from_vector, vector_from_rotation
from implicam.measurement import Measurement
from implicam.rig_model.placement import (
    MAX_EXTENT_ERROR,
    MAX_SCALE_ERROR,
    MAX_SCALE_SDS,
    Placement,
    motions_about,
    other_scale,
    step_between,
)

MIN_POINTS, MAX_POINTS = 3, 200
"""Known points that a world takes; more than the second are thinned out at random: the world is as well known."""

SUSPECTS = 5
"""Known points that fit worst, of which the wrong one is looked for."""

MAX_CHANCE_PROBABILITY = 1e-4
"""Known points contradict each other, or a plane is none, where chance would leave so much so rarely."""

MIRRORED_RATIO = 0.2
"""Part of the misfit that a mirror image leaves where the known points are one."""

MIN_SPREAD = 0.02
"""Extent of points across their longest direction, over that along it, below which they lie on one line."""

MAX_STILL_PX = 3.0
"""Median distance of a marker's pixels from their middle over several frames: it moves."""

STEPS = 4

MIN_FLIGHT = 5
"""Frames of a falling thing."""

MIN_BEND_SDS = 10.0
"""By how many standard deviations its way must bend."""

MAX_TURN_SD = 0.1
"""Radians, beyond which points say nothing of where axes are."""

MIN_JUDGED_POINTS, LAYING_ROUNDS, MAX_SQUARED_MAHALANOBIS = 6, 4, 25.0
"""Known points that a world of its own is laid over; rounds in which those that do not fit are left out of that; the
squared distance, in standard deviations, beyond which they do not."""

OTHER_FRAME_RATIO = 0.05
"""Part of the distance from known points that is left when these are moved, where they are in another frame."""


def set_world(
    calibration: Calibration,
    data: Dataset | None = None,
    *,
    origin: str = "",
    x: str | Sequence[str] = (),
    y: str = "",
    plane: Sequence[str] = (),
    down: Sequence[str] = (),
    falling: str = "",
    camera: str = "",
) -> PlacesItsWorld:
    """The calibration with its world where something says; for one made without known positions, as from a wand.

    `data` with known positions: these are in the world, three or more that are not on one line, as the markers of an
    L-frame. Without: names of its points say where axes and planes are. What nothing is said of stays as it was, as far
    as that goes. A marker seen in several frames has stood still.

    Args:
        calibration: Made without known positions.
        data: What the cameras saw of these points.
        origin: The point at the origin.
        x: A point on the x axis, seen from the origin; or two, from the one to the other.
        y: A point on the side of the xy plane where y is positive.
        plane: Three points or more of the plane z = 0; z points to the cameras' side.
        down: Two points or more of a plumb line, from top to bottom: z points up.
        falling: A marker of a thing that was dropped or thrown, in frames at equal times: z points up, against what
            bends its way.
        camera: Its centre is the origin, its axes are x (right), y (down) and z (forward).

    Returns:
        The same calibration, which measures in this world; its first note says where that is.

    Raises:
        UsageError: The calibration has a world from its known positions, or what is given says no world.
        DatasetError: A point is not there or cannot be measured.
        FitError: The points lie on one line, are as in a mirror, or their distances contradict the calibration.

    >>> import implicam as ic
    >>> waved = ic.ForwardGP(wand=96).fit(ic.read_dataset("my-wand"))  # doctest: +SKIP
    >>> in_world = ic.set_world(waved, ic.read_dataset("l-frame"))  # doctest: +SKIP
    >>> on_floor = ic.set_world(waved, ic.read_dataset("floor"), plane=["a", "b", "c"], x=["a", "b"])  # doctest: +SKIP
    """
    if not (isinstance(calibration, PlacesItsWorld) and calibration.free_world):
        raise UsageError(
            f"the world of this calibration by {calibration.method} is that of its known positions.",
            why="another one can be set where no known position was used, as from a wand",
            fix="calibrate with known positions of that world; or move what it measures: measurement.transformed(pose)",
        )
    axes = Axes(origin, (x,) if isinstance(x, str) and x else tuple(x), y, tuple(plane), tuple(down))
    if camera:
        if data is not None or axes.named or falling:
            raise UsageError("the world of a camera takes no points.", fix="leave them out, or the camera")
        return calibration.in_world_of_camera(camera)
    if data is None:
        raise UsageError(
            "nothing says where the world is.",
            fix="give what the cameras saw of an L-frame, of known points, or of points on axes, a plane or a plumb "
            "line; or name a camera",
        )
    if falling:
        points, times = _flight(data, falling, down)
        axes = replace(axes, down=points, times=times)
    middle = calibration.data.xyz.mean(axis=0)
    laid = _by_axes(calibration, data, axes, middle) if axes.named else _by_known_points(calibration, data, middle)
    return calibration.in_world(laid.placement, laid.told)


@dataclass(frozen=True)
class Axes:
    """Names of points that say where origin, axes and planes are, as of `set_world`."""

    origin: str
    x: tuple[str, ...]
    y: str
    plane: tuple[str, ...]
    down: tuple[str, ...]
    times: tuple[float, ...] = ()  # of the points of `down`, where these are of a falling thing

    @property
    def named(self) -> list[str]:
        """All of them, once each."""
        names = (self.origin, *self.x, self.y, *self.plane, *self.down)
        return [name for name in dict.fromkeys(names) if name]

    def check(self) -> None:
        """Stop where they say no world."""
        if len(self.x) > 2:
            raise UsageError(f"{len(self.x)} points are given for the x axis.", fix="give one, or two: from, to")
        if self.plane and len(self.plane) < MIN_POINTS:
            raise UsageError(f"{len(self.plane)} points are no plane.", fix="name three or more of them")
        if self.times and len(self.times) < MIN_FLIGHT:
            raise UsageError(
                f"two cameras see the falling thing in {len(self.times)} frames.",
                fix=f"it takes {MIN_FLIGHT} frames, better 20: three say how a way bends, more whether it is a fall",
            )
        if self.down and len(self.down) < 2:
            raise UsageError("one point is no plumb line.", fix="name two or more, from top to bottom")
        if self.plane and self.down:
            raise UsageError(
                "a plane and a plumb line both say where z points.", fix="give one of them, and the other's data apart"
            )
        if len(self.x) == 1 and not self.origin:
            raise UsageError("x is seen from the origin, and no point is that.", fix="name it, or two points for x")
        upright = bool(self.plane or self.down)
        if not upright and not (self.x and self.y):
            raise UsageError(
                "this says too little of where the axes point.",
                fix="give origin, x and y; or a plane; or a plumb line",
            )
        if upright and self.y:
            raise UsageError("plane or plumb line and x say where y points.", fix="leave y out")
        if not upright and not self.origin:
            raise UsageError("y is on one side of x, seen from the origin, and no point is that.", fix="name it")


class Laid(NamedTuple):
    """A placement, and what to tell of it."""

    placement: Placement
    told: tuple[str, ...]


# ---- points that are known


class Aligned(NamedTuple):
    """new_from_old; K (6, 3 n) how its step follows known less measured places (in the axes of the old world), residual
    (n, 3) of these, shared and own errors of both, chi2 of the residuals, and scale with its sd."""

    new_from_old: Pose
    K: Floats
    residual: Floats
    cov: Floats
    chi2: float
    scale: float
    scale_sd: float
    untold: float

    @property
    def freedom(self) -> int:
        """Of what is left."""
        return self.residual.size - 6


def align(measured: JointPositions, xyz: Floats, sd: Floats, middle: Floats, *, declared: bool) -> Aligned:
    """The rigid motion that lays measured points over known ones, weighted by what is known of both.

    Args:
        measured: n points.
        xyz: (n, 3) known.
        sd: (n, 3) of these, each by itself; zero where nothing is stated.
        middle: (3,) in the old world, about which the step of the motion turns.
        declared: Whether these are stated; if not, and the points fit worse than they could be measured, known points
            are taken to be off by what explains it.

    Raises:
        FitError: The points lie on one line.
    """
    pose, _ = register(measured.xyz, xyz)
    n, untold = len(xyz), 0.0
    cov = measured.cov
    G = motions_about(measured.xyz, middle).reshape(3 * n, 6)
    grown = np.concatenate([G, (measured.xyz - middle).reshape(-1, 1)], axis=1)

    def weights(turn: Floats) -> Floats:
        stated = np.zeros((n, 3, n, 3))
        stated[range(n), :, range(n), :] = turn.T @ ((sd**2 + untold**2)[:, :, None] * np.eye(3)) @ turn
        return np.asarray(np.linalg.inv(cov + stated.reshape(3 * n, 3 * n)), dtype=np.float64)

    for number in range(STEPS):
        W = weights(pose.rotation)
        residual = (pose.inverse().apply(xyz) - measured.xyz).ravel()
        larger = np.linalg.inv(grown.T @ W @ grown)
        scale = larger @ (grown.T @ W @ residual)
        if number == 0 and not declared and n > MIN_POINTS:
            untold = _untold(cov, grown, residual)
            continue
        K = np.linalg.inv(G.T @ W @ G) @ G.T @ W
        pose = _moved(pose, K @ residual, middle)
    residual = (pose.inverse().apply(xyz) - measured.xyz).ravel()
    W = weights(pose.rotation)
    return Aligned(
        pose, K, residual.reshape(-1, 3), np.asarray(np.linalg.inv(W)), float(residual @ W @ residual),
        1 + float(scale[6]), float(np.sqrt(larger[6, 6])), untold,
    )  # fmt: skip


def _untold(cov: Floats, design: Floats, residual: Floats) -> float:
    """The sd of every coordinate that brings the squares of what is left to their mean; zero where they are smaller."""
    freedom = len(residual) - design.shape[1]

    def excess(sd: float) -> float:
        W = np.linalg.inv(cov + sd**2 * np.eye(len(cov)))
        left = residual - design @ np.linalg.solve(design.T @ W @ design, design.T @ W @ residual)
        return float(left @ W @ left - freedom)

    if excess(0.0) <= 0:
        return 0.0
    high = float(np.sqrt(np.mean(residual**2)))
    while excess(high) > 0:
        high *= 2
    return float(brentq(excess, 0.0, high, rtol=1e-6))


def _moved(pose: Pose, step: Floats, middle: Floats) -> Pose:
    """A pose after a small motion of places: they turn about the middle, and shift."""
    turn = rotation_from_vector(step[:3])
    return pose @ Pose(turn, middle - turn @ middle + step[3:])


def _by_known_points(calibration: PlacesItsWorld, data: Dataset, middle: Floats) -> Laid:
    if data.known is None:
        raise UsageError(
            f"dataset {data.name!r} has no known positions, and no point is named.",
            fix="add points.csv with the positions in the world (--points TABLE), or say which points are the origin, "
            "on axes, on a plane or on a plumb line",
        )
    unit = calibration.data.length_unit
    if data.length_unit != unit:
        data = data.in_unit(unit)
    measured = calibration.measure(data.observations)
    there = measured.measured
    _require(measured, int(there.sum()), MIN_POINTS, "known points")
    rows = np.flatnonzero(there)
    if len(rows) > MAX_POINTS:
        rows = np.sort(np.random.default_rng(0).choice(rows, MAX_POINTS, replace=False))
    known = data.positions
    positions = joint_of_rows(measured, rows, short=False)
    xyz, sd = known.xyz[rows], np.nan_to_num(known.sd[rows])
    names = [str(data.points[i]) for i in rows]
    _refuse_line(xyz, "known points", list(data.points[rows]))
    extent, there_extent = (float(np.linalg.norm(at - at.mean(axis=0))) for at in (positions.xyz, xyz))
    if abs(there_extent / extent - 1) > MAX_EXTENT_ERROR:
        raise other_scale(there_extent / extent)
    declared = bool((sd > 0).any())
    wrong: list[str] = []
    while True:
        found = align(positions, xyz, sd, middle, declared=declared)
        _refuse_mirror(positions.xyz, xyz)
        left_out = _wrong_point(positions, xyz, sd, middle, found)
        if left_out is None:
            break
        wrong.append(names.pop(left_out))
        keep = np.arange(len(xyz)) != left_out
        xyz, sd, rows = xyz[keep], sd[keep], rows[keep]
        positions = joint_of_rows(measured, rows, short=False)
    if abs(found.scale - 1) > max(MAX_SCALE_ERROR, MAX_SCALE_SDS * found.scale_sd):
        raise other_scale(found.scale)
    n = len(xyz)
    stated = sd**2 + found.untold**2
    turn = found.new_from_old.rotation
    noise = positions.own + turn.T @ (stated[:, :, None] * np.eye(3)) @ turn
    K = found.K.reshape(6, n, 3)
    own = np.einsum("knd,nde,lne->kl", K, noise, K)
    placement = Placement(found.new_from_old, middle, -np.einsum("knd,ndq->kq", K, positions.shared), own)
    told = _known_told(found, names, data, placement, middle, unit)
    told += [*_notes(found, wrong, measured, unit), *_upside_down(xyz, placement.new_from_old, calibration)]
    return Laid(placement, tuple(told))


def _known_told(
    found: Aligned, names: list[str], data: Dataset, placement: Placement, middle: Floats, unit: str
) -> list[str]:
    rms = float(np.sqrt(np.mean(np.sum(found.residual**2, axis=1))))
    sd = float(placement.sd_at(middle[None])[0])
    return [
        f"The world is that of {len(names)} known points of {data.name!r} ({list_some(names)}); measured, they are "
        f"{decimal_number(rms)} {unit} from where they are known to be (rms). That the frame itself is known to "
        f"{decimal_number(sd)} {unit} in the middle of the wand's places is part of the error bars; distances do not "
        "depend on it."
    ]


def _notes(found: Aligned, wrong: list[str], measured: Measurement, unit: str) -> list[str]:
    notes = []
    if wrong:
        notes.append(f"Known points that the others contradict are not used: {', '.join(wrong)}.")
    lost = [f"{measured.points[i]} ({measured.reason[i]})" for i in np.flatnonzero(~measured.measured)]
    if lost:
        notes.append(f"Known points that could not be measured are not used: {list_some(lost)}.")
    off = (found.scale - 1) / found.scale_sd
    if abs(off) > MAX_SCALE_SDS:
        notes.append(
            f"The known points are {100 * found.scale:.4g} % as far apart as the wand says, "
            f"{abs(off):.1f} standard deviations: is the wand's length right? Distances are those of the wand."
        )
    if found.untold == 0 and chdtrc(found.freedom, found.chi2) < MAX_CHANCE_PROBABILITY:
        ratio = np.sqrt(found.chi2 / found.freedom)
        notes.append(
            f"The known points contradict their stated uncertainties: what is left is {ratio:.1f} times as large as "
            "it should be."
        )
    if found.untold > 0:
        notes.append(
            f"The known points seem to be off by about {decimal_number(found.untold)} {unit} in x, y and z each, and "
            "the error bars contain it. State sd_x, sd_y, sd_z if you know better."
        )
    return notes


def _wrong_point(positions: JointPositions, xyz: Floats, sd: Floats, middle: Floats, found: Aligned) -> int | None:
    """The number of a known point that the others contradict, where there are enough of them to tell."""
    n = len(xyz)
    raw = found if found.untold == 0 else align(positions, xyz, sd, middle, declared=True)
    if n <= MIN_POINTS + 1 or chdtrc(raw.freedom, raw.chi2) >= MAX_CHANCE_PROBABILITY:
        return None
    worst = np.argsort(-np.sum(raw.residual**2, axis=1) / np.trace(positions.own, axis1=1, axis2=2))[:SUSPECTS]
    left = []
    for i in worst:
        keep = np.arange(n) != i
        rest = replace(
            positions, points=tuple(np.array(positions.points)[keep]), xyz=positions.xyz[keep],
            own=positions.own[keep], shared=positions.shared[keep],
        )  # fmt: skip
        try:
            left.append(align(rest, xyz[keep], sd[keep], middle, declared=True))
        except FitError:
            left.append(raw)
    best = int(np.argmin([one.chi2 for one in left]))
    good = chdtrc(left[best].freedom, left[best].chi2) > MAX_CHANCE_PROBABILITY
    return int(worst[best]) if good or left[best].chi2 < raw.chi2 / 10 else None


def _refuse_mirror(measured: Floats, xyz: Floats) -> None:
    _, straight = register(measured, xyz)
    turned = np.linalg.svd(xyz - xyz.mean(axis=0))[2][2]  # along the thinnest direction of the points
    _, mirrored = register(measured, xyz - 2 * np.outer((xyz - xyz.mean(axis=0)) @ turned, turned))
    if mirrored < MIRRORED_RATIO * straight and straight > 0.02 * float(np.std(xyz)):
        raise FitError(
            f"the known points are as in a mirror: {straight:.3g} are left, and {mirrored:.2g} with one axis turned.",
            why="two names are exchanged, the known positions are left-handed, or v is counted from below",
            fix="turn the sign of one axis in points.csv, or exchange the names",
        )


def _refuse_line(xyz: Floats, what: str, names: Sequence[str]) -> None:
    sizes = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    if sizes[1] < MIN_SPREAD * sizes[0] or not sizes[0] > 0:
        raise FitError(
            f"the {what} {list_some(list(map(str, names)))} lie on one line.",
            why="the world could turn about it",
            fix="add one that is well beside this line",
        )


def _require(measured: Measurement, count: int, least: int, what: str) -> None:
    if count < least:
        lost = [f"{measured.points[i]}: {measured.reason[i]}" for i in np.flatnonzero(~measured.measured)]
        raise DatasetError(
            f"{count} of the {what} can be measured; a world takes {least}.",
            why="; ".join(lost[:5]),
            fix="show them to two calibrated cameras or more",
        )


# ---- a world of its own, laid over known points to judge by


class LaidOver(NamedTuple):
    """measurement: laid over the known points, with the covariances of what is left there, which has lost six numbers;
    told: what was done, in words; new_from_old: the motion."""

    measurement: Measurement
    told: str
    new_from_old: Pose


def lay_over(measurement: Measurement, xyz: Floats, sd: Floats) -> LaidOver:
    """Measured points in the world of known ones, by the rigid motion that lays them over these: to judge a calibration
    that has a world of its own.

    Args:
        measurement: n points, as a calibration gave it.
        xyz: (n, 3) where they are known to be.
        sd: (n, 3) of these; zero where nothing is stated.

    Returns:
        The measurement there. What the motion takes up of each error is taken out of its covariance.

    Raises:
        DatasetError: Fewer than `MIN_JUDGED_POINTS` are measured.
        FitError: The points lie on one line.
    """
    rows = np.flatnonzero(measurement.measured)
    if len(rows) < MIN_JUDGED_POINTS:
        raise DatasetError(
            f"{len(rows)} of the known points can be measured, and {MIN_JUDGED_POINTS} or more are wanted.",
            why="this calibration has a world of its own: it must be laid over them, which takes six numbers",
            fix="give more known points; or set the world first (implicam world)",
        )
    used = rows[measurement.own_reason[rows] == ""]
    used = rows if len(used) < MIN_JUDGED_POINTS else used
    if len(used) > MAX_POINTS:
        used = np.sort(np.random.default_rng(0).choice(used, MAX_POINTS, replace=False))
    middle = measurement.xyz[used].mean(axis=0)
    for _ in range(LAYING_ROUNDS):
        found = align(joint_of_rows(measurement, used, short=False), xyz[used], sd[used], middle, declared=True)
        every = joint_of_rows(measurement, rows, short=False)
        left = found.new_from_old.inverse().apply(xyz[rows]) - every.xyz
        off = np.einsum("ni,nij,nj->n", left, np.linalg.inv(measurement.cov[rows]), left)
        good = np.isin(rows, used) & (off <= max(MAX_SQUARED_MAHALANOBIS, float(np.median(off)) * 9))
        if good.sum() < MIN_JUDGED_POINTS or good.sum() == len(used):
            break
        used = rows[good]
    turn = found.new_from_old.rotation
    stated = turn.T @ (sd[rows][:, :, None] ** 2 * np.eye(3)) @ turn
    own, place = every.own + stated, np.full(len(measurement), -1)
    place[rows] = np.arange(len(rows))
    K = np.zeros((6, len(rows), 3))
    K[:, place[used]] = found.K.reshape(6, len(used), 3)
    G = motions_about(every.xyz, middle)
    shared = every.shared - np.einsum("nik,kmd,mdq->niq", G, K, every.shared, optimize=True)
    taken = np.einsum("nik,knd,nde->nie", G, K, own)
    motion = np.einsum("knd,nde,lne->kl", K, own, K)
    cov = measurement.cov.copy()
    cov[rows] = every.own - taken - taken.swapaxes(1, 2) + G @ motion @ G.swapaxes(1, 2)
    cov[rows] += shared @ shared.swapaxes(1, 2)
    at = measurement.xyz.copy()
    at[rows] = found.new_from_old.apply(at[rows])
    told = (
        f"laid over the known ones by a rigid motion, which takes up 6 of {3 * len(used)} numbers, because this "
        "calibration has a world of its own"
    )
    return LaidOver(replace(measurement, xyz=at, cov=turn @ cov @ turn.T, shared=None), told, found.new_from_old)


def in_another_frame(measurement: Measurement, xyz: Floats) -> list[str]:
    """A sentence, where known points are far from where they are measured, and a rigid motion brings them there.

    Args:
        measurement: n points.
        xyz: (n, 3) where they are known to be.
    """
    there = measurement.measured
    if there.sum() < MIN_JUDGED_POINTS:
        return []
    off = np.linalg.norm(measurement.xyz[there] - xyz[there], axis=1)
    try:
        pose, _ = register(measurement.xyz[there], xyz[there])
    except FitError:
        return []
    left = np.linalg.norm(pose.apply(measurement.xyz[there]) - xyz[there], axis=1)
    if np.median(left) > OTHER_FRAME_RATIO * np.median(off):
        return []
    turn = float(np.degrees(np.linalg.norm(vector_from_rotation(pose.rotation))))
    far, near = (f"{decimal_number(float(np.median(one)))} {measurement.length_unit}" for one in (off, left))
    return [
        f"These known points are in another frame than the calibration: they are {far} away (median), and {near} once "
        f"turned by {decimal_number(turn)} degrees and shifted. Give both in one frame (transformed(pose); of a "
        "calibration from a wand implicam world), or judge by others."
    ]


# ---- points that axes and planes go through


def _by_axes(calibration: PlacesItsWorld, data: Dataset, axes: Axes, middle: Floats) -> Laid:
    axes.check()
    data = _standing(data, axes.named)
    measured = calibration.measure(data.observations)
    row = {str(name): i for i, name in enumerate(data.points)}
    wanted = np.array([row[name] for name in axes.named])
    some = measured.select(wanted)
    _require(some, int(some.measured.sum()), len(wanted), "points named")
    positions = joint_of_rows(measured, wanted, short=False)
    centres = np.array(list(calibration.centres().values()))
    number = {name: i for i, name in enumerate(axes.named)}

    def pose_of(xyz: Floats) -> Pose:
        return _pose_by_axes(axes, number, xyz, middle, centres)

    if axes.times:
        _refuse_straight(axes, number, positions)
    here, n = pose_of(positions.xyz), len(wanted)
    h = 1e-5 * max(float(np.ptp(positions.xyz, axis=0).max()), 1e-300)
    J = np.zeros((6, n, 3))
    for i in range(n):
        for axis in range(3):
            step = np.zeros((n, 3))
            step[i, axis] = h
            both = [step_between(here, pose_of(positions.xyz + sign * step), middle) for sign in (1.0, -1.0)]
            J[:, i, axis] = (both[0] - both[1]) / (2 * h)
    own, follows = np.einsum("knd,nde,lne->kl", J, positions.own, J), np.einsum("knd,ndq->kq", J, positions.shared)
    placement = Placement(here, middle, follows, own)
    turn_sd = float(np.sqrt(np.linalg.eigvalsh((own + follows @ follows.T)[:3, :3])[-1]))
    if turn_sd > MAX_TURN_SD:
        raise FitError(
            f"these points say where the axes are to {np.degrees(turn_sd):.0f} degrees only.",
            why="they are too near each other for how exactly they are measured"
            if not axes.times
            else "its way bends too little: too few frames, or too short a time",
            fix="take points that are farther apart"
            if not axes.times
            else "film a longer fall, with more frames a second",
        )
    unit = calibration.data.length_unit
    sd = float(placement.sd_at(middle[None])[0])
    told = (
        f"The world is laid by points of {data.name!r}: {_axes_in_words(axes)}. That these are known to "
        f"{decimal_number(sd)} {unit} in the middle of the wand's places is part of the error bars; distances do not "
        "depend on it."
    )
    return Laid(placement, (told, *_not_straight(axes, number, positions, unit)))


def _axes_in_words(axes: Axes) -> str:
    words = []
    if axes.plane:
        words.append(f"{list_some(list(axes.plane))} are in the plane z = 0, z points to the cameras' side")
    if axes.times:
        words.append(f"z points up, against what bends the way of the falling thing in {len(axes.times)} frames")
    elif axes.down:
        words.append(f"z points up, against the line from {axes.down[0]} to {axes.down[-1]}")
    if axes.x:
        words.append(f"x points from {axes.origin if len(axes.x) == 1 else axes.x[0]} to {axes.x[-1]}")
    if axes.y:
        words.append(f"{axes.y} is where y is positive")
    words.append(f"{axes.origin} is the origin" if axes.origin else "the origin is where it was as far as that goes")
    return "; ".join(words)


def _pose_by_axes(axes: Axes, number: dict[str, int], xyz: Floats, middle: Floats, centres: Floats) -> Pose:
    """new_from_old by where the points are."""
    at = {name: xyz[i] for name, i in number.items()}
    origin = at[axes.origin] if axes.origin else np.zeros(3)  # where the origin was
    along = None
    if axes.x:
        start = at[axes.x[0]] if len(axes.x) == 2 else at[axes.origin]
        along = at[axes.x[-1]] - start
    if axes.plane:
        z, foot = _plane_of(np.array([at[name] for name in axes.plane]), list(axes.plane))
        z = z if np.median((centres - foot) @ z) >= 0 else -z
        origin = origin - z * ((origin - foot) @ z)
    elif axes.down:
        line = np.array([at[name] for name in axes.down])
        bend = _flight_of(line, axes.times)[0] if axes.times else _line_of(line)
        z = -bend / np.linalg.norm(bend)
    else:
        assert along is not None
        side = at[axes.y] - at[axes.origin]
        z = np.cross(along, side)
        _refuse_line(np.array([at[axes.origin], at[axes.origin] + along, at[axes.y]]), "points", axes.named)
        z = z / np.linalg.norm(z)
    if along is None:
        along = np.eye(3)[0]  # of the old world
        if abs(z[0]) > 0.9:
            along = np.eye(3)[1]
    flat = along - z * (along @ z)
    if np.linalg.norm(flat) < MIN_SPREAD * np.linalg.norm(along):
        raise FitError(
            "the x axis points along z.", why="points for x lie across the plane, or on the plumb line",
            fix="name other points for x",
        )  # fmt: skip
    x = flat / np.linalg.norm(flat)
    rotation = np.stack([x, np.cross(z, x), z])
    return Pose(rotation, -rotation @ origin)


def _plane_of(xyz: Floats, names: Sequence[str]) -> tuple[Floats, Floats]:
    """Unit normal and middle."""
    _refuse_line(xyz, "points of the plane", names)
    foot = xyz.mean(axis=0)
    return np.linalg.svd(xyz - foot)[2][2], foot


def _line_of(xyz: Floats) -> Floats:
    """The unit direction from the first point to the last."""
    along = np.linalg.svd(xyz - xyz.mean(axis=0), full_matrices=False)[2][0]
    return np.asarray(along * np.sign(along @ (xyz[-1] - xyz[0])), dtype=np.float64)


def _flight(data: Dataset, marker: str, down: Sequence[str]) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """The points of a falling marker that two cameras see, and the numbers of their frames."""
    columns = data.further_columns()
    if not {FRAME, MARKER} <= columns.keys():
        raise DatasetError(
            f"dataset {data.name!r} does not say which point is in which frame.",
            fix=f"a falling thing needs the columns {FRAME!r} and {MARKER!r}",
        )
    if down:
        raise UsageError("a plumb line and a falling thing both say what is down.", fix="give one of them")
    mine = (columns[MARKER] == marker) & (data.observations.seen.sum(axis=1) >= 2)
    if not (columns[MARKER] == marker).any():
        names = sorted(set(columns[MARKER].tolist()))
        raise DatasetError(
            f"dataset {data.name!r} has no marker {marker!r}{did_you_mean(marker, names)}.",
            fix=f"its markers are {list_some(names)}",
        )
    try:
        times = columns[FRAME][mine].astype(np.float64)
    except ValueError:
        raise DatasetError(
            f"the frames of marker {marker!r} have no numbers.", fix="number them by equal times, as a film does"
        ) from None
    order = np.argsort(times)
    points = data.points[mine][order]
    return tuple(map(str, points)), tuple(times[order].tolist())


def _flight_of(xyz: Floats, times: Sequence[float]) -> tuple[Floats, Floats, Floats]:
    """By how much a way (n, 3) bends (3,), how that follows the places (n,), what is left (n, 3) of an even bend."""
    t = np.array(times)
    t = (t - t.mean()) / np.std(t)
    design = np.stack([np.ones(len(t)), t, t**2], axis=1)
    follow = np.linalg.pinv(design)
    found = follow @ xyz
    return found[2], follow[2], xyz - design @ found


def _refuse_straight(axes: Axes, number: dict[str, int], positions: JointPositions) -> None:
    """Stop where a way does not bend by more than it could seem to."""
    rows = [number[name] for name in axes.down]
    bend, follow, _ = _flight_of(positions.xyz[rows], axes.times)
    shared = np.einsum("n,ndq->dq", follow, positions.shared[rows])
    cov = np.einsum("n,nde->de", follow**2, positions.own[rows]) + shared @ shared.T
    if bend @ np.linalg.solve(cov, bend) < MIN_BEND_SDS**2:
        raise FitError(
            "the way of the falling thing bends too little to say what is down.",
            why="the time is too short for how exactly it is measured, or nothing pulled at it",
            fix="film a longer fall, with more frames a second",
        )


def _not_straight(axes: Axes, number: dict[str, int], positions: JointPositions, unit: str) -> list[str]:
    """What is left where more points are given than a plane or a line needs."""
    names, what = (axes.plane, "are not on one plane") if axes.plane else (axes.down, "are not on one plumb line")
    what = "do not fall freely" if axes.times else what
    rows = [number[name] for name in names]
    free = len(rows) - 3 if axes.plane else 2 * (len(rows) - 2)
    free = 3 * (len(rows) - 3) if axes.times else free
    if free < 1:
        return []
    if axes.times:
        across, off = np.eye(3), _flight_of(positions.xyz[rows], axes.times)[2]
        chi2 = float(np.einsum("ni,nij,nj->", off, np.linalg.inv(positions.own[rows]), off))
    else:
        centred = positions.xyz[rows] - positions.xyz[rows].mean(axis=0)
        directions = np.linalg.svd(centred)[2]
        across = directions[2:] if axes.plane else directions[1:]
        off = centred @ across.T
        chi2 = float(np.sum(off**2 / np.einsum("ad,nde,ae->na", across, positions.own[rows], across)))
    if chdtrc(free, chi2) >= MAX_CHANCE_PROBABILITY:
        return []
    worst = int(np.argmax(np.abs(off).max(axis=1)))
    return [
        f"The points {what}: {names[worst]} is {decimal_number(float(np.abs(off[worst]).max()))} {unit} "
        f"off, {np.sqrt(chi2 / free):.1f} times what the error bars of the points allow. These do not contain it."
    ]


def _upside_down(xyz: Floats, new_from_old: Pose, calibration: PlacesItsWorld) -> list[str]:
    """Known points in the plane z = 0 that has all cameras below it."""
    if np.abs(xyz[:, 2]).max() > MIN_SPREAD * float(np.ptp(xyz, axis=0).max()):
        return []
    heights = new_from_old.apply(np.array(list(calibration.centres().values())))[:, 2]
    if (heights > 0).any():
        return []
    return [
        "All cameras are below the plane z = 0 of the known points. If these lie on the floor, two of them are "
        "exchanged, or x and y."
    ]


def _standing(data: Dataset, names: Sequence[str]) -> Dataset:
    """The points named, each once: a marker that stands still in several frames is one point, as exact as in one frame,
    since what a camera or a detector is off by there is the same in all."""
    known = set(map(str, data.points))
    columns = data.further_columns()
    markers = columns[MARKER] if {FRAME, MARKER} <= columns.keys() else None
    rows: list[int] = []
    uv = data.observations.uv.copy()
    labels = []
    for name in names:
        if name in known:
            rows.append(int(np.flatnonzero(data.points == name)[0]))
        elif markers is not None and (markers == name).any():
            mine = np.flatnonzero(markers == name)
            rows.append(int(mine[0]))
            uv[mine[0]] = _still(uv[mine], name)
        else:
            every = [*known, *(() if markers is None else set(markers.tolist()))]
            raise DatasetError(
                f"dataset {data.name!r} has no point {name!r}{did_you_mean(name, every)}.",
                fix=f"its points are {list_some(sorted(every))}",
            )
        labels.append(name)
    observations = replace(data.observations, uv=uv).select(np.array(rows))
    return replace(data, observations=replace(observations, points=np.array(labels)), known=None, columns={})


def _still(uv: Floats, name: str) -> Floats:
    """(C, 2) the middle of pixels (k, C, 2) of a marker in k frames."""
    with np.errstate(all="ignore"):
        seen = np.isfinite(uv).all(axis=2).sum(axis=0) > 0
        middle = np.full(uv.shape[1:], np.nan)
        middle[seen] = np.nanmedian(uv[:, seen], axis=0)
        off = np.linalg.norm(uv - middle, axis=2)
        if np.isfinite(off).any() and np.nanmedian(off) > MAX_STILL_PX:
            raise DatasetError(
                f"marker {name!r} moves: its pixels are {np.nanmedian(off):.0f} from their middle (median).",
                fix="a point that says where the world is stands still; name one frame's point, as in '12 a'",
            )
    return middle


def with_known_positions(data: Dataset, names: Sequence[str], known: KnownPositions) -> Dataset:
    """What cameras saw of points whose positions are stated elsewhere.

    Args:
        data: Views of points, or of markers that stand still.
        names: Of the known positions.
        known: These, in the same order.

    Raises:
        DatasetError: None of the names is there.
    """
    columns = data.further_columns()
    there = set(map(str, data.points)) | set(columns[MARKER].tolist() if MARKER in columns else ())
    rows = [i for i, name in enumerate(names) if name in there]
    if not rows:
        raise DatasetError(
            f"none of the {len(names)} known points is in dataset {data.name!r}.",
            why=f"it has {list_some(sorted(there))}",
            fix="names of points, or of markers, must be the same in both",
        )
    found = _standing(data, [names[i] for i in rows])
    return replace(found, known=known.select(np.array(rows)))
