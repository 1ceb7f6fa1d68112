"""A world by points that axes, a plane or a plumb line go through, or by the way of a falling thing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc

from implicam.calibrators.protocol import PlacesItsWorld
from implicam.dataset import Dataset
from implicam.dataset.wand import FRAME, MARKER
from implicam.derived.joint_positions import JointPositions, joint_of_rows
from implicam.errors import DatasetError, FitError, UsageError, did_you_mean
from implicam.formatting import decimal_number, list_some
from implicam.geometry import Floats, Pose
from implicam.rig_model.placement import Placement, step_between
from implicam.world.points import (
    MAX_CHANCE_PROBABILITY,
    MIN_POINTS,
    MIN_SPREAD,
    Laid,
    refuse_line,
    require_measured,
    standing_points,
)

MIN_FLIGHT = 5
"""Frames of a falling thing."""

MIN_BEND_SDS = 10.0
"""By how many standard deviations its way must bend."""

MAX_TURN_SD = 0.1
"""Radians, beyond which points say nothing of where axes are."""


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


def by_axes(calibration: PlacesItsWorld, data: Dataset, axes: Axes, middle: Floats) -> Laid:
    """Where the world is, by points that axes, a plane or a plumb line go through.

    Args:
        calibration: That measures them.
        data: What the cameras saw of them.
        axes: Their names.
        middle: (3,) of the places of the wand.

    Raises:
        UsageError: The names say no world.
        DatasetError: A point is not there or cannot be measured.
        FitError: The points lie on one line, or say too little.
    """
    axes.check()
    data = standing_points(data, axes.named)
    measured = calibration.measure(data.observations)
    row = {str(name): i for i, name in enumerate(data.points)}
    wanted = np.array([row[name] for name in axes.named])
    some = measured.select(wanted)
    require_measured(some, int(some.measured.sum()), len(wanted), "points named")
    positions = joint_of_rows(measured, wanted, short=False)
    centres = np.array(list(calibration.centres().values()))
    number = {name: i for i, name in enumerate(axes.named)}

    def pose_of(xyz: Floats) -> Pose:
        return _pose_by_axes(axes, number, xyz, middle, centres)

    if axes.times:
        _refuse_straight(axes, number, positions)
    unit = calibration.data.length_unit
    positions, doubts = _allow_for_misfit(axes, number, positions, unit)
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
        raise _too_uncertain(np.degrees(turn_sd), axes, doubts)
    sd = float(placement.sd_at(middle[None])[0])
    told = (
        f"The world is laid by points of {data.name!r}: {_axes_in_words(axes)}. That these are known to "
        f"{decimal_number(sd)} {unit} in the middle of the wand's places is part of the error bars; distances do not "
        "depend on it."
    )
    return Laid(placement, (told, *doubts))


def _too_uncertain(degrees: float, axes: Axes, doubts: Sequence[str]) -> FitError:
    what = f"these points say where the axes are to {degrees:.0f} degrees only."
    if doubts:
        return FitError(what, why=doubts[0], fix="leave out the point that is off, or measure it again")
    if axes.times:
        why, fix = (
            "its way bends too little: too few frames, or too short a time",
            "film a longer fall, with more frames a second",
        )
    else:
        why, fix = (
            "they are too near each other for how exactly they are measured",
            "take points that are farther apart",
        )
    return FitError(what, why=why, fix=fix)


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
        refuse_line(np.array([at[axes.origin], at[axes.origin] + along, at[axes.y]]), "points", axes.named)
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
    refuse_line(xyz, "points of the plane", names)
    foot = xyz.mean(axis=0)
    return np.linalg.svd(xyz - foot)[2][2], foot


def _line_of(xyz: Floats) -> Floats:
    """The unit direction from the first point to the last."""
    along = np.linalg.svd(xyz - xyz.mean(axis=0), full_matrices=False)[2][0]
    return np.asarray(along * np.sign(along @ (xyz[-1] - xyz[0])), dtype=np.float64)


def flight(data: Dataset, marker: str, down: Sequence[str]) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """The points of a falling marker that two cameras see.

    Args:
        data: Markers in frames.
        marker: Its name.
        down: Points of a plumb line; there must be none.

    Returns:
        Their names, and the numbers of their frames.

    Raises:
        UsageError: A plumb line is given besides.
        DatasetError: There is no such marker, or frames have no numbers.
    """
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


class _Misfit(NamedTuple):
    """Of points that are more than a plane, a line or a fall needs: their names and what they are not, how far each is
    off across it, their squares over the covariance of the points, and how many of these are free."""

    names: tuple[str, ...]
    what: str
    off: Floats
    chi2: float
    free: int

    @property
    def beyond_chance(self) -> bool:
        return self.free > 0 and bool(chdtrc(self.free, self.chi2) < MAX_CHANCE_PROBABILITY)


def _misfit(axes: Axes, number: dict[str, int], positions: JointPositions) -> _Misfit:
    names, what = (axes.plane, "are not on one plane") if axes.plane else (axes.down, "are not on one plumb line")
    what = "do not fall freely" if axes.times else what
    rows = [number[name] for name in names]
    free = len(rows) - 3 if axes.plane else 2 * (len(rows) - 2)
    free = 3 * (len(rows) - 3) if axes.times else free
    if free < 1:
        return _Misfit(names, what, np.zeros((len(rows), 1)), 0.0, 0)
    if axes.times:
        across, off = np.eye(3), _flight_of(positions.xyz[rows], axes.times)[2]
        chi2 = float(np.einsum("ni,nij,nj->", off, np.linalg.inv(positions.own[rows]), off))
    else:
        centred = positions.xyz[rows] - positions.xyz[rows].mean(axis=0)
        directions = np.linalg.svd(centred)[2]
        across = directions[2:] if axes.plane else directions[1:]
        off = centred @ across.T
        chi2 = float(np.sum(off**2 / np.einsum("ad,nde,ae->na", across, positions.own[rows], across)))
    return _Misfit(names, what, off, chi2, free)


def _allow_for_misfit(
    axes: Axes, number: dict[str, int], positions: JointPositions, unit: str
) -> tuple[JointPositions, list[str]]:
    """Points that may be off by what they contradict each other by, and a note; the same where chance explains it."""
    found = _misfit(axes, number, positions)
    if not found.beyond_chance:
        return positions, []
    off = float(np.sqrt(np.sum(found.off**2) / found.free))
    worst = int(np.argmax(np.abs(found.off).max(axis=1)))
    note = (
        f"The points {found.what}: {found.names[worst]} is {decimal_number(float(np.abs(found.off[worst]).max()))} "
        f"{unit} off, {np.sqrt(found.chi2 / found.free):.1f} times what the error bars of the points allow. Each of "
        f"them is taken to be off by about {decimal_number(off)} {unit}, and the error bars of this world contain it."
    )
    own = positions.own + off**2 * np.eye(3)
    return replace(positions, own=own), [note]
