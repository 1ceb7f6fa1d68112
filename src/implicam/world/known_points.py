"""A world by known points, such as the markers of an L-frame: the motion that lays measured points over them."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.special import chdtrc

from implicam.calibrators.protocol import PlacesItsWorld
from implicam.dataset import Dataset
from implicam.derived.joint_positions import JointPositions, joint_of_rows
from implicam.errors import FitError, UsageError
from implicam.formatting import decimal_number, list_some
from implicam.geometry import Floats, Pose, register, rotation_from_vector
from implicam.measurement import Measurement
from implicam.rig_model.placement import (
    MAX_EXTENT_ERROR,
    MAX_SCALE_ERROR,
    MAX_SCALE_SDS,
    Placement,
    motions_about,
    other_scale,
)
from implicam.world.points import MAX_CHANCE_PROBABILITY, MIN_POINTS, MIN_SPREAD, Laid, refuse_line, require_measured

MAX_POINTS = 200
"""More known points are thinned out at random: the world is as well known."""

SUSPECTS = 5
"""Known points that fit worst, of which the wrong one is looked for."""

MIRRORED_RATIO = 0.2
"""Part of the misfit that a mirror image leaves where the known points are one."""

STEPS = 4


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


def align(
    measured: JointPositions, xyz: Floats, sd: Floats, middle: Floats, *, declared: bool, as_stated: bool = False
) -> Aligned:
    """The rigid motion that lays measured points over known ones, weighted by what is known of both.

    Where the points fit worse than they could be measured, and be stated, known points are taken to be off by what
    explains it, their distances too: error bars that leave a contradiction out would be too small in this world.

    Args:
        measured: n points.
        xyz: (n, 3) known.
        sd: (n, 3) of these, each by itself; zero where nothing is stated.
        middle: (3,) in the old world, about which the step of the motion turns.
        declared: Whether these are stated: then chance is to explain what it can.
        as_stated: Nothing is taken to be off by more than is stated.

    Raises:
        FitError: The points lie on one line.
    """
    pose, _ = register(measured.xyz, xyz)
    n, untold, untold_of_shape = len(xyz), 0.0, 0.0
    G = motions_about(measured.xyz, middle).reshape(3 * n, 6)
    # what moves all of them alike is what is looked for: weights do not depend on the world they are measured in
    shared = measured.shared.reshape(3 * n, -1)
    shared = shared - G @ (np.linalg.pinv(G) @ shared)
    cov = replace(measured, shared=shared.reshape(n, 3, -1)).cov
    grown = np.concatenate([G, (measured.xyz - middle).reshape(-1, 1)], axis=1)

    def covariance(turn: Floats, off: float) -> Floats:
        stated = np.zeros((n, 3, n, 3))
        stated[range(n), :, range(n), :] = turn.T @ ((sd**2 + off**2)[:, :, None] * np.eye(3)) @ turn
        return np.asarray(cov + stated.reshape(3 * n, 3 * n), dtype=np.float64)

    for number in range(STEPS):
        residual = (pose.inverse().apply(xyz) - measured.xyz).ravel()
        if number == 0 and not as_stated:
            known = covariance(pose.rotation, 0.0)
            if (n > MIN_POINTS and not declared) or _is_beyond_chance(known, G, residual):
                untold, untold_of_shape = _untold(known, G, residual), _untold(known, grown, residual)
        W = np.linalg.inv(covariance(pose.rotation, untold))
        K = np.linalg.inv(G.T @ W @ G) @ G.T @ W
        pose = _moved(pose, K @ residual, middle)
    residual = (pose.inverse().apply(xyz) - measured.xyz).ravel()
    own = covariance(pose.rotation, untold)
    shape = np.linalg.inv(covariance(pose.rotation, untold_of_shape))
    larger = np.linalg.inv(grown.T @ shape @ grown)
    scale = float((larger @ (grown.T @ shape @ residual))[6])
    return Aligned(
        pose, K, residual.reshape(-1, 3), own, float(residual @ np.linalg.solve(own, residual)),
        1 + scale, float(np.sqrt(larger[6, 6])), untold,
    )  # fmt: skip


def _left(cov: Floats, design: Floats, residual: Floats) -> float:
    """Squares of what is left after a fit, over the covariance."""
    W = np.linalg.inv(cov)
    left = residual - design @ np.linalg.solve(design.T @ W @ design, design.T @ W @ residual)
    return float(left @ W @ left)


def _is_beyond_chance(cov: Floats, design: Floats, residual: Floats) -> bool:
    return bool(chdtrc(len(residual) - design.shape[1], _left(cov, design, residual)) < MAX_CHANCE_PROBABILITY)


def _untold(cov: Floats, design: Floats, residual: Floats) -> float:
    """The sd of every coordinate that brings the squares of what is left to their mean; zero where they are smaller."""
    freedom = len(residual) - design.shape[1]

    def excess(sd: float) -> float:
        return float(_left(cov + sd**2 * np.eye(len(cov)), design, residual) - freedom)

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


def by_known_points(calibration: PlacesItsWorld, data: Dataset, middle: Floats) -> Laid:
    """Where the world is, by known points.

    Args:
        calibration: That measures them.
        data: Known positions, and what the cameras saw of them.
        middle: (3,) of the places of the wand.

    Raises:
        UsageError: There are no known positions.
        DatasetError: Too few of them can be measured.
        FitError: They lie on one line, are as in a mirror, or of another scale.
    """
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
    require_measured(measured, int(there.sum()), MIN_POINTS, "known points")
    rows = np.flatnonzero(there)
    if len(rows) > MAX_POINTS:
        rows = np.sort(np.random.default_rng(0).choice(rows, MAX_POINTS, replace=False))
    known = data.positions
    positions = joint_of_rows(measured, rows, short=False)
    xyz, sd = known.xyz[rows], np.nan_to_num(known.sd[rows])
    names = [str(data.points[i]) for i in rows]
    refuse_line(xyz, "known points", list(data.points[rows]))
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
    told += [
        *_notes(found, wrong, measured, unit, declared=declared),
        *_upside_down(xyz, placement.new_from_old, calibration),
    ]
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


def _notes(found: Aligned, wrong: list[str], measured: Measurement, unit: str, *, declared: bool) -> list[str]:
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
    if found.untold > 0 and declared:
        notes.append(
            f"The known points contradict their stated uncertainties: they seem to be off by about "
            f"{decimal_number(found.untold)} {unit} more in x, y and z each, and the error bars contain it."
        )
    elif found.untold > 0:
        notes.append(
            f"The known points seem to be off by about {decimal_number(found.untold)} {unit} in x, y and z each, and "
            "the error bars contain it. State sd_x, sd_y, sd_z if you know better."
        )
    return notes


def _wrong_point(positions: JointPositions, xyz: Floats, sd: Floats, middle: Floats, found: Aligned) -> int | None:
    """The number of a known point that the others contradict, where there are enough of them to tell."""
    n = len(xyz)
    raw = found if found.untold == 0 else align(positions, xyz, sd, middle, declared=True, as_stated=True)
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
            left.append(align(rest, xyz[keep], sd[keep], middle, declared=True, as_stated=True))
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
