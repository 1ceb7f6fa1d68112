"""A world of its own, laid over known points to judge by."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from implicam.derived.joint_positions import joint_of_rows
from implicam.errors import DatasetError, FitError
from implicam.formatting import decimal_number
from implicam.geometry import Floats, Pose, register, vector_from_rotation
from implicam.measurement import Measurement
from implicam.rig_model.placement import motions_about
from implicam.world.known_points import MAX_POINTS, align

MIN_JUDGED_POINTS, LAYING_ROUNDS, MAX_SQUARED_MAHALANOBIS = 6, 4, 25.0
"""Known points that a world of its own is laid over; rounds in which those that do not fit are left out of that; the
squared distance, in standard deviations, beyond which they do not."""

OTHER_FRAME_RATIO = 0.05
"""Part of the distance from known points that is left when these are moved, where they are in another frame."""


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
