"""Planes, spheres, cylinders and rigid motions through measured points, by generalised least squares.

The Gauss-Helmert model: points are moved as little as their joint covariance asks for until they lie on the feature;
what they had to be moved, in their own standard deviations, is a chi-squared test of the form.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import least_squares
from scipy.special import chdtrc

from implicam.dataset import Floats
from implicam.derived.joint_positions import joint
from implicam.derived.quantities import Quantity
from implicam.errors import NumericalError, UsageError
from implicam.geometry import cross_matrices, rotation_from_vector, vector_from_rotation
from implicam.measurement import Measurement

MAX_STEPS = 100
CONVERGED_STEP_SDS = 1e-6
MAX_WHOLE = 1500
"""Equations up to which their covariance is factored whole; beyond, as blocks and what they share."""
MIN_RELATIVE_SPREAD = 1e-6
"""Of points across the line or plane that they must not lie in, over their extent."""
STARTS_OF_CYLINDER, SEARCHES_OF_CYLINDER = 300, 4
"""Directions that are tried for the axis of a cylinder, and the best of them, from which a search starts."""
MAX_RADIUS_EXTENTS = 10.0
"""Beyond it a cylinder is a plane, which points that are nearly flat fit in any direction."""


Axis = tuple[Floats, Floats, float]
"""Of a cylinder: a point, the direction, and the radius about it."""


@dataclass(frozen=True)
class Form:
    """How well points agree with a feature.

    Attributes:
        rms: Rms distance of the points from it, in their length unit.
        consistency: p-value of the test that only the stated errors keep the points from lying on it; NaN where there
            are no more points than it takes.
        points: How many there are.
    """

    rms: float
    consistency: float
    points: int


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane through points: `normal @ x = offset`.

    Attributes:
        normal: (3,) of unit length; its sign is such that the offset is positive.
        offset: Its distance from the origin of the world.
        normal_cov: (3, 3) covariance of the normal; its sds are angles in radians.
        centre: (3,) the middle of the points, on the plane.
        form: Rms distance of the points from the plane, and its consistency.
    """

    normal: Floats
    offset: Quantity
    normal_cov: Floats
    centre: Floats
    form: Form


@dataclass(frozen=True, eq=False)
class Sphere:
    """A sphere through points.

    Attributes:
        centre: (3,).
        radius: Its radius.
        cov: (4, 4) covariance of centre and radius.
        form: Rms distance of the points from the sphere, and its consistency.
    """

    centre: Floats
    radius: Quantity
    cov: Floats
    form: Form


@dataclass(frozen=True, eq=False)
class Cylinder:
    """A cylinder through points.

    Attributes:
        centre: (3,) on its axis, beside the middle of the points.
        direction: (3,) of its axis, of unit length.
        radius: Its radius.
        centre_cov: (3, 3) covariance of the centre, across the axis.
        direction_cov: (3, 3) covariance of the direction.
        form: Rms distance of the points from the cylinder, and its consistency.
    """

    centre: Floats
    direction: Floats
    radius: Quantity
    centre_cov: Floats
    direction_cov: Floats
    form: Form


@dataclass(frozen=True, eq=False)
class Motion:
    """The rigid motion that takes one set of points to another: `rotation @ x + translation`.

    Attributes:
        rotation: (3, 3).
        translation: (3,).
        angle: How far it turns.
        shift: How far it moves the middle of the first set.
        cov: (6, 6) covariance of a rotation vector after the rotation, in radians, and of where the middle of the first
            set comes to lie.
        form: Rms distance of the pairs after the motion, and its consistency.
    """

    rotation: Floats
    translation: Floats
    angle: Quantity
    shift: Quantity
    cov: Floats
    form: Form


def fit_plane(measurement: Measurement, points: Sequence[str | int]) -> Plane:
    """The plane through three measured points or more.

    Args:
        measurement: As a calibration gave it.
        points: Their names or numbers.

    Returns:
        The plane.

    Raises:
        UsageError: There are too few points, or they lie on a line; or as for `distance`.
        NumericalError: The search did not converge.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> calibration = ic.ForwardGP().fit(rig)
    >>> measured = calibration.measure(rig)
    >>> type(ic.fit_plane(measured, list(range(12)))).__name__
    'Plane'
    """
    found = _enough(measurement, points, 3, "a plane")
    centre = found.x.mean(axis=0)
    sizes, directions = _spread(found.x)
    _refuse_degenerate(sizes, 1, "a plane lie on a line")
    start = np.cross(directions[0], directions[1])

    def equations(x: Floats, state: tuple[Floats, float]) -> Equations:
        normal, level = state
        off = x - centre
        by_step = np.column_stack([off @ _across(normal), -np.ones(len(x))])
        slope = np.broadcast_to(normal, (len(x), 1, 3))
        return Equations((off @ normal - level)[:, None], by_step[:, None], slope)

    def move(state: tuple[Floats, float], step: Floats) -> tuple[Floats, float]:
        return _tilted(state[0], step[:2]), state[1] + step[2]

    (normal, level), cov, form = _fit(found, (start, 0.0), equations, move)
    tangents = _across(normal)
    offset = float(normal @ centre + level)
    slope = np.array([*(centre @ tangents), 1.0])
    return Plane(
        normal if offset >= 0 else -normal,
        Quantity(abs(offset), float(np.sqrt(slope @ cov @ slope)), measurement.length_unit),
        tangents @ cov[:2, :2] @ tangents.T,
        centre + level * normal,
        form,
    )


def fit_sphere(measurement: Measurement, points: Sequence[str | int]) -> Sphere:
    """The sphere through four measured points or more.

    Args:
        measurement: As a calibration gave it.
        points: Their names or numbers.

    Returns:
        The sphere.

    Raises:
        UsageError: There are too few points, or they lie in a plane; or as for `distance`.
        NumericalError: The search did not converge.

    >>> import implicam as ic
    >>> from dataclasses import replace
    >>> import numpy as np
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> calibration = ic.ForwardGP().fit(rig)
    >>> measured = calibration.measure(rig)
    >>> ways = np.random.default_rng(1).normal(size=(12, 3))
    >>> ball = replace(measured.select(range(12)), xyz=50 * ways / np.linalg.norm(ways, axis=1)[:, None])
    >>> round(ic.fit_sphere(ball, range(12)).radius.value)
    50
    """
    found = _enough(measurement, points, 4, "a sphere")
    _refuse_degenerate(_spread(found.x)[0], 2, "a sphere lie in a plane")
    middle = found.x.mean(axis=0)
    centre, radius = _nearest_round(found.x - middle)

    def equations(x: Floats, state: Floats) -> Equations:
        away = x - middle - state[:3]
        length = np.linalg.norm(away, axis=1)
        outward = away / length[:, None]
        by_step = np.column_stack([-outward, -np.ones(len(x))])
        return Equations((length - state[3])[:, None], by_step[:, None], outward[:, None])

    state, cov, form = _fit(found, np.array([*centre, radius]), equations, np.add)
    quantity = Quantity(float(state[3]), float(np.sqrt(cov[3, 3])), measurement.length_unit)
    return Sphere(middle + state[:3], quantity, cov, form)


def fit_cylinder(measurement: Measurement, points: Sequence[str | int]) -> Cylinder:
    """The cylinder through five measured points or more, spread around it and along it.

    Args:
        measurement: As a calibration gave it.
        points: Their names or numbers.

    Returns:
        The cylinder that fits best, of those that searches from many directions find.

    Raises:
        UsageError: There are too few points; or as for `distance`.
        NumericalError: The points do not fix a cylinder, or the search did not converge.

    >>> import implicam as ic
    >>> from dataclasses import replace
    >>> import numpy as np
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> calibration = ic.ForwardGP().fit(rig)
    >>> measured = calibration.measure(rig)
    >>> turn = np.linspace(0, 6, 16)
    >>> rod = np.stack([30 * np.cos(turn), 30 * np.sin(turn), 20 * turn], axis=1)
    >>> measured = replace(measured.select(range(16)), xyz=rod)
    >>> round(ic.fit_cylinder(measured, range(16)).radius.value)
    49
    """
    found = _enough(measurement, points, 5, "a cylinder")
    middle = found.x.mean(axis=0)

    def equations(x: Floats, state: Axis) -> Equations:
        centre, direction, radius = state
        tangents, off = _across(direction), x - middle - centre
        along = off @ direction
        away = off - along[:, None] * direction
        length = np.linalg.norm(away, axis=1)
        outward = away / length[:, None]
        sideways = outward @ tangents
        by_step = np.column_stack([-sideways, -along[:, None] * sideways, -np.ones(len(x))])
        return Equations((length - radius)[:, None], by_step[:, None], outward[:, None])

    def move(state: Axis, step: Floats) -> Axis:
        centre, direction, radius = state
        moved = centre + _across(direction) @ step[:2]
        direction = _tilted(direction, step[2:4])
        return moved - (moved @ direction) * direction, direction, radius + float(step[4])

    (centre, direction, radius), cov, form = _fit(found, _start_of_cylinder(found.x - middle), equations, move)
    tangents = _across(direction)
    return Cylinder(
        middle + centre,
        direction,
        Quantity(radius, float(np.sqrt(cov[4, 4])), measurement.length_unit),
        tangents @ cov[:2, :2] @ tangents.T,
        tangents @ cov[2:4, 2:4] @ tangents.T,
        form,
    )


def fit_motion(measurement: Measurement, before: Sequence[str | int], after: Sequence[str | int]) -> Motion:
    """The rigid motion from some measured points to others: how a body moved, from three of its points or more.

    Args:
        measurement: As a calibration gave it; it has the points before and after.
        before: Names or numbers of a body's points.
        after: Of the same points, after it moved.

    Returns:
        The motion.

    Raises:
        UsageError: There are too few pairs, or they lie on a line; or as for `distance`.
        NumericalError: The search did not converge.

    >>> import implicam as ic
    >>> from dataclasses import replace
    >>> import numpy as np
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> calibration = ic.ForwardGP().fit(rig)
    >>> measured = calibration.measure(rig)
    >>> xyz = measured.xyz[:12].copy()
    >>> xyz[6:] = xyz[:6] + [5.0, 0.0, 0.0]
    >>> moved = replace(measured.select(range(12)), xyz=xyz)
    >>> type(ic.fit_motion(moved, range(6), range(6, 12))).__name__
    'Motion'
    """
    if len(before) != len(after):
        raise UsageError(
            f"there are {len(before)} points before the motion and {len(after)} after it.",
            fix="give the same points in the same order",
        )
    found = _enough(measurement, [*before, *after], 6, "a motion, three before it and three after,").in_pairs()
    middle, there = found.x[:, :3].mean(axis=0), found.x[:, 3:].mean(axis=0)
    U, sizes, Vt = np.linalg.svd((found.x[:, 3:] - there).T @ (found.x[:, :3] - middle))
    _refuse_degenerate(np.sqrt(sizes), 1, "a body lie on a line")
    start = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt

    def equations(x: Floats, state: tuple[Floats, Floats]) -> Equations:
        rotation, place = state
        turned = (x[:, :3] - middle) @ rotation.T
        minus = np.broadcast_to(-np.eye(3), (len(x), 3, 3))
        by_x = np.concatenate([np.broadcast_to(-rotation, (len(x), 3, 3)), -minus], axis=2)
        return Equations(x[:, 3:] - place - turned, np.concatenate([cross_matrices(turned), minus], axis=2), by_x)

    def move(state: tuple[Floats, Floats], step: Floats) -> tuple[Floats, Floats]:
        return rotation_from_vector(step[:3]) @ state[0], state[1] + step[3:]

    (rotation, place), cov, form = _fit(found, (start, there), equations, move)
    turn, shift = vector_from_rotation(rotation), place - middle
    angle, angle_sd = _length_with_sd(turn, cov[:3, :3])
    return Motion(
        rotation,
        place - rotation @ middle,
        Quantity(float(np.degrees(angle)), float(np.degrees(angle_sd)), "degrees"),
        Quantity(*_length_with_sd(shift, cov[3:, 3:]), measurement.length_unit),
        cov,
        form,
    )


# ---- starts


def _spread(x: Floats) -> tuple[Floats, Floats]:
    """Of points their extents (3,) along principal axes, and these, in rows."""
    centred = np.concatenate([x - x.mean(axis=0), np.zeros((3, 3))])
    _, sizes, directions = np.linalg.svd(centred, full_matrices=False)
    return sizes, directions


def _refuse_degenerate(sizes: Floats, number: int, what: str) -> None:
    if sizes[number] <= MIN_RELATIVE_SPREAD * sizes[0]:
        raise UsageError(f"the points of {what}.", fix="add a point beside it")


def _nearest_round(d: Floats) -> tuple[Floats, float]:
    """Centre and radius of the circle or sphere near points, which |d|^2 = 2 c d + r^2 - |c|^2 is linear in."""
    found = np.linalg.lstsq(np.column_stack([2 * d, np.ones(len(d))]), np.sum(d**2, axis=1))[0]
    return found[:-1], float(np.sqrt(max(found[-1] + found[:-1] @ found[:-1], np.finfo(float).tiny)))


def _start_of_cylinder(d: Floats) -> Axis:
    """Centre, direction and radius of a cylinder near points about their middle, by searches from the best of many
    directions."""

    def direction(angles: Floats) -> Floats:
        polar, azimuth = angles
        return np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])

    def circle(angles: Floats) -> tuple[Floats, Floats, float]:
        tangents = _across(direction(angles))
        centre, radius = _nearest_round(d @ tangents)
        return np.linalg.norm(d @ tangents - centre, axis=1) - radius, tangents @ centre, radius

    def cost(angles: Floats) -> float:
        left, _, radius = circle(angles)
        return float(left @ left) if radius < MAX_RADIUS_EXTENTS * np.ptp(d, axis=0).max() else np.inf

    polar = np.arccos((np.arange(STARTS_OF_CYLINDER) + 0.5) / STARTS_OF_CYLINDER)  # a spiral over half a sphere
    starts = np.column_stack([polar, np.pi * (1 + 5**0.5) * np.arange(STARTS_OF_CYLINDER)])
    starts = starts[np.argsort([cost(start) for start in starts])[:SEARCHES_OF_CYLINDER]]
    best = min((least_squares(lambda angles: circle(angles)[0], start).x for start in starts), key=cost)
    if not np.isfinite(cost(best)):
        raise NumericalError("these points fix no cylinder.", fix="measure points all around it, and along it")
    _, centre, radius = circle(best)
    return centre, direction(best), radius


# ---- geometry of steps


def _across(direction: Floats) -> Floats:
    """(3, 2) two directions across a unit vector, and each other."""
    one = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    one = one / np.linalg.norm(one)
    return np.stack([one, np.cross(direction, one)], axis=1)


def _tilted(direction: Floats, step: Floats) -> Floats:
    tilted = direction + _across(direction) @ step
    return np.asarray(tilted / np.linalg.norm(tilted), dtype=np.float64)


def _length_with_sd(vector: Floats, cov: Floats) -> tuple[float, float]:
    length = float(np.linalg.norm(vector))
    if length == 0:
        return 0.0, float(np.sqrt(np.trace(cov)))
    along = vector / length
    return length, float(np.sqrt(along @ cov @ along))


# ---- generalised least squares


class Equations(NamedTuple):
    """What must be zero: values (m, r), their slopes by a step of the unknowns (m, r, p), and by what was measured
    (m, r, d)."""

    values: Floats
    by_step: Floats
    by_measured: Floats


class _Measured(NamedTuple):
    """What was measured, in m groups of d numbers: x (m, d); own (m, d, d) and shared (m, d, q) as of
    `JointPositions`."""

    x: Floats
    own: Floats
    shared: Floats

    def in_pairs(self) -> _Measured:
        """The first half of the points beside the second."""
        k = len(self.x) // 2
        own = np.zeros((k, 6, 6))
        own[:, :3, :3], own[:, 3:, 3:] = self.own[:k], self.own[k:]
        x, shared = (np.concatenate([part[:k], part[k:]], axis=1) for part in (self.x, self.shared))
        return _Measured(x, own, shared)

    def covariance_times(self, v: Floats) -> Floats:
        """(m, d) the covariance of all, applied to v (m, d)."""
        common = np.einsum("mdq,md->q", self.shared, v)
        return np.asarray(np.einsum("mde,me->md", self.own, v) + self.shared @ common, dtype=np.float64)


def _enough(measurement: Measurement, points: Sequence[str | int], least: int, what: str) -> _Measured:
    if len(points) < least:
        raise UsageError(f"{what} takes {least} points, and {len(points)} are given.", fix="give more points")
    found = joint(measurement, points)
    if len(set(found.points)) < len(points):
        raise UsageError("a point is given twice.", fix="give each point once")
    return _Measured(found.xyz, found.own, found.shared)


State = TypeVar("State")


def _fit(
    measured: _Measured,
    state: State,
    equations: Callable[[Floats, State], Equations],
    move: Callable[[State, Floats], State],
) -> tuple[State, Floats, Form]:
    """The state whose equations hold after the least change of what was measured; the covariance (p, p) of its step."""
    x = measured.x
    for _ in range(MAX_STEPS):
        values, A, B = equations(x, state)
        left = values + np.einsum("mrd,md->mr", B, measured.x - x)
        solve = _inverse(B @ measured.own @ B.swapaxes(1, 2), B @ measured.shared)
        m, r, p = A.shape
        flat = A.reshape(m * r, p)
        pulled = solve(flat)
        information = flat.T @ pulled
        try:
            cov = np.linalg.inv(information)
        except np.linalg.LinAlgError:
            break
        step = -cov @ (pulled.T @ left.ravel())
        rest = left.ravel() + flat @ step
        forces = solve(rest[:, None])[:, 0]
        x = measured.x - measured.covariance_times(np.einsum("mrd,mr->md", B, forces.reshape(m, r)))
        state = move(state, step)
        if not np.isfinite(step).all():
            break
        if step @ information @ step < CONVERGED_STEP_SDS**2:
            freedom = m * r - p
            p_value = float(chdtrc(freedom, rest @ forces)) if freedom else float("nan")
            off = np.linalg.norm(equations(measured.x, state).values, axis=1)
            return state, np.asarray(0.5 * (cov + cov.T)), Form(float(np.sqrt(np.mean(off**2))), p_value, m)
    raise NumericalError(
        "no feature was found that these points lie on.",
        why="the search did not converge: they are too few, or too near each other for their error bars",
        fix="measure points that are spread over more of the feature",
    )


def _inverse(blocks: Floats, shared: Floats) -> Callable[[Floats], Floats]:
    """Multiplies (m r, c) by the inverse of `blocks (m, r, r) on the diagonal + shared (m r, q) shared^T`."""
    m, r, q = shared.shape
    flat = shared.reshape(m * r, q)
    if m * r <= MAX_WHOLE:
        whole = flat @ flat.T
        for i, block in enumerate(blocks):
            whole[i * r : (i + 1) * r, i * r : (i + 1) * r] += block
        factor = cho_factor(whole)
        return lambda v: cho_solve(factor, v)
    inverses = np.linalg.inv(blocks)

    def by_blocks(v: Floats) -> Floats:
        return np.asarray((inverses @ v.reshape(m, r, -1)).reshape(m * r, -1))

    pulled = by_blocks(flat)
    inner = cho_factor(np.eye(q) + flat.T @ pulled)  # Woodbury
    return lambda v: by_blocks(v) - pulled @ cho_solve(inner, pulled.T @ v)
