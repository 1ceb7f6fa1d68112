"""The forward map as an ONNX graph: where each camera sees a position, with the covariance of a view, eq. (19)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from implicam.deploy.onnx_graph import Graph, Value, angle, kernel, side_by_side, solve_lower
from implicam.errors import UsageError
from implicam.geometry import Floats, Pose
from implicam.lenses import PERSPECTIVE_K, BrownConrady, KannalaBrandt
from implicam.rig_model import CameraModel, CentralCamera, FittedRig, GeneralCamera, Labels
from implicam.rig_model.camera import ProjectiveCamera
from implicam.rig_model.general_camera import AnyCamera
from implicam.rig_model.heavy_tails import information_loss

MAX_PLANE = 1e12
"""x / z of a point beyond which a perspective lens sees nothing, as `brown_conrady` has it."""


class _View(NamedTuple):
    """What a camera without its field sees: u and v (n, 1), log distance (n, 1), and how u and v depend on its
    parameters, (n, p) each."""

    u: Value
    v: Value
    log_distance: Value
    by_parameters: tuple[Value, Value]


def forward_graph(rig: FittedRig) -> Graph:
    """The graph of all calibrated cameras.

    Input: `xyz` (n, 3) in the world. Outputs for each camera: `uv_NAME` (n, 2), as `predict` gives it, and
    `covariance_NAME` (n, 2, 2) of a view with the camera's usual noise; NaN where the camera has no answer.

    Args:
        rig: The cameras.

    Returns:
        The graph.

    Raises:
        UsageError: A camera has a lens of another package.
        MissingExtraError: The package onnx is not installed.
    """
    g = Graph()
    xyz = g.input("xyz", 3)
    points = (xyz - rig.frame.offset[None]) / rig.frame.scale
    where = points if rig.labels is None else points + _label_error(points, rig.labels)
    for number, (name, model) in enumerate(zip(rig.camera_names, rig.posterior.models, strict=True)):
        g.output(f"uv_{name}", _mean(model, where), 2)
        g.output(f"covariance_{name}", _covariance(rig, number, points), 2, 2)
    return g


def _mean(model: CameraModel, points: Value) -> Value:
    view = _look(model.camera, points)
    uv = side_by_side([view.u, view.v])
    if not len(model.field.inducing):
        return uv
    return uv + _field_kernel(model, points, view) @ model.field.coefficients(model.signal * model.weights)


def _covariance(rig: FittedRig, number: int, points: Value) -> Value:
    """(n, 4)."""
    model, root = rig.posterior.models[number], rig.posterior.root(number)
    view = _look(model.camera, points)
    p, m = model.camera.size, len(model.field.inducing)
    halves = [by @ root[:, :p].T for by in view.by_parameters]
    rest = view.u * 0.0 + model.signal**2
    if m:
        phi = solve_lower(_field_kernel(model, points, view), model.field.factor)
        rest = (1.0 - phi.squared().sum()).at_least(0.0) * model.signal**2
        own = [root[:, p + i * m : p + (i + 1) * m].T * model.signal for i in range(2)]
        halves = [half + phi @ part for half, part in zip(halves, own, strict=True)]
    noise = rest + model.noise**2 * information_loss(rig.degrees)
    uu, vv = (half.squared().sum() + noise for half in halves)
    across = (halves[0] * halves[1]).sum()
    return side_by_side([uu, across, across, vv])


def _field_kernel(model: CameraModel, points: Value, view: _View) -> Value:
    """(n, m) as `CameraModel.rows` has it."""
    if model.field_camera is not model.camera:
        view = _look(model.field_camera, points)
    pixel = (side_by_side([view.u, view.v]) - model.image.centre[None]) / model.image.half
    q = side_by_side([pixel, (view.log_distance - model.depth.mean) / model.depth.unit])
    field = model.field
    return kernel(q, field.inducing, field.kernel.lengthscale, field.kernel.shape)[0] * field.kernel.signal_variance


def _look(camera: AnyCamera, points: Value) -> _View:
    if isinstance(camera, ProjectiveCamera):
        return _linear(camera, points)
    if isinstance(camera, GeneralCamera):
        return _general(camera, points)
    return _central(camera, points)


def _linear(camera: ProjectiveCamera, points: Value) -> _View:
    rows = points @ camera.P[:, :3].T + camera.P[:, 3][None]
    x, y, w = rows.columns[:3]
    w = w.only_where(w > 0.0)
    u, v = x / w, y / w
    one = points.nothing() + 1.0
    by = side_by_side([points, one]) / w
    zero = by * 0.0
    return _View(u, v, w.log(), (side_by_side([by, zero, -u * by]), side_by_side([zero, by, -v * by])))


class _There(NamedTuple):
    """Points in a camera's frame: x, y, z (n, 1) each, `turned` before the translation (three of (n, 1)), and the log
    of their distance."""

    xyz: list[Value]
    turned: list[Value]
    log_distance: Value


def _transform(pose: Pose, points: Value) -> _There:
    turned = points @ pose.rotation.T
    there = turned + pose.translation[None]
    return _There(there.columns[:3], turned.columns[:3], there.squared().sum().log() * 0.5)


class _Bent(NamedTuple):
    """What an odd polynomial of the angle makes of points: x and y in the image of focal length 1 (n, 1) each, their
    derivatives by the point (2 x 3 of (n, 1)), the direction away from the axis, and powers 3, 5, 7, 9 of the angle."""

    x: Value
    y: Value
    by_point: list[list[Value]]
    outward: tuple[Value, Value]
    powers: list[Value]


def _bend(lens: KannalaBrandt, there: _There) -> _Bent:
    X, Y, Z = there.xyz
    r = (X.squared() + Y.squared()).sqrt()
    theta, length = angle(r, Z)
    theta = theta.only_where(theta < lens.critical_angle)
    squared = theta.squared()
    k = [1.0, lens.k1, lens.k2, lens.k3, lens.k4]
    radial, slope = squared * k[4], squared * (9 * k[4])
    for i in (3, 2, 1):
        radial, slope = (radial + k[i]) * squared, (slope + (2 * i + 1) * k[i]) * squared
    bent, slope = (radial + 1.0) * theta, (slope + 1.0) / length.squared()
    off_axis = r > 0.0
    safe = r.only_where(off_axis, 1.0)
    across = (bent / safe).only_where(off_axis, 1.0 / Z)
    cos, sin = (X / safe).only_where(off_axis, 1.0), Y / safe
    along = slope * Z
    mixed = (along - across) * cos * sin
    by_point = [
        [along * cos * cos + across * sin * sin, mixed, -slope * X],
        [mixed, along * sin * sin + across * cos * cos, -slope * Y],
    ]
    powers = [theta * squared]
    for _ in range(3):
        powers.append(powers[-1] * squared)
    return _Bent(X * across, Y * across, by_point, (cos, sin), powers)


def _turn(there: _There, slope: list[Value]) -> list[Value]:
    """How a pixel coordinate with this slope by the point depends on a turn: three of (n, 1)."""
    (x, y, z), (a, b, c) = there.turned, slope
    return [y * c - z * b, z * a - x * c, x * b - y * a]


def _general(camera: GeneralCamera, points: Value) -> _View:
    there = _transform(camera.pose, points)
    lens = KannalaBrandt(1.0, 1.0, 0.0, 0.0, *camera.k.tolist())
    bent = _bend(lens, there)
    sign = np.array([-1.0 if camera.mirrored else 1.0, 1.0])
    m = [bent.x * sign[0], bent.y]
    w = m[0] * camera.tilt[0] + m[1] * camera.tilt[1] + 1.0
    w = w.only_where(w > 0.0)
    y = [m[0] / w, m[1] / w]
    B, by_p, by_q = camera.pixel_shape
    by_y = camera.focal * B
    powers, rho = np.array([2, 4, 6, 8]), camera.rho
    by_across, by_rho = camera.translation_slopes()
    found, columns = [], []
    for i in range(2):
        away = y[0] * by_y[i, 0] + y[1] * by_y[i, 1]
        # by_y (I - y tilt^T) / w, and the mirror
        by_m = [(by_y[i, j] - away * camera.tilt[j]) / w * sign[j] for j in range(2)]
        slope = [by_m[0] * bent.by_point[0][a] + by_m[1] * bent.by_point[1][a] for a in range(3)]
        radial = by_m[0] * bent.outward[0] + by_m[1] * bent.outward[1]
        by_k = [radial * power for power in bent.powers]
        bending = powers * (camera.k - 0.5 * PERSPECTIVE_K) / rho
        one, zero = away * 0.0 + 1.0, away * 0.0
        found.append(away + camera.centre[i])
        columns.append(
            [
                away,
                (y[0] * by_p[i, 0] + y[1] * by_p[i, 1]) * camera.focal,
                (y[0] * by_q[i, 0] + y[1] * by_q[i, 1]) * camera.focal,
                -away * y[0],
                -away * y[1],
                *((one, zero) if i == 0 else (zero, one)),
                *(by / rho**power for by, power in zip(by_k, powers, strict=True)),
                _weighted(slope, by_rho) - away / rho - _weighted(by_k, bending),
                _weighted(slope, by_across[:, 0]),
                _weighted(slope, by_across[:, 1]),
                *_turn(there, slope),
            ]
        )
    return _View(found[0], found[1], there.log_distance, (side_by_side(columns[0]), side_by_side(columns[1])))


def _weighted(values: list[Value], weights: Floats) -> Value:
    """The sum of values (n, 1) with weights."""
    total: Value = values[0] * weights[0]
    for value, weight in zip(values[1:], weights[1:], strict=True):
        total = total + value * weight
    return total


def _central(camera: CentralCamera, points: Value) -> _View:
    there, lens = _transform(camera.pose, points), camera.lens
    if isinstance(lens, KannalaBrandt):
        xy, by_point, by_lens = _kannala_brandt(lens, there)
    elif isinstance(lens, BrownConrady):
        xy, by_point, by_lens = _brown_conrady(lens, there)
    else:
        raise UsageError(
            f"a lens of the family {lens.family} cannot be written as a graph.",
            why="its formula is that of another package",
            fix="calibrate with kannala-brandt or brown-conrady, or take --to cpp, which tabulates any lens",
        )
    focal, centre = (lens.fx, lens.fy), (lens.cx, lens.cy)
    found, columns = [], []
    for i in range(2):
        one, zero = xy[i] * 0.0 + 1.0, xy[i] * 0.0
        slope = [by * focal[i] for by in by_point[i]]
        found.append(xy[i] * focal[i] + centre[i])
        own = (xy[0], zero, one, zero) if i == 0 else (zero, xy[1], zero, one)
        columns.append([*own, *(by * focal[i] for by in by_lens[i]), *_turn(there, slope), *slope])
    return _View(found[0], found[1], there.log_distance, (side_by_side(columns[0]), side_by_side(columns[1])))


_Lens = tuple[list[Value], list[list[Value]], list[list[Value]]]
"""In the image of focal length 1: x and y, their derivatives by the point, and by the distortion."""


def _kannala_brandt(lens: KannalaBrandt, there: _There) -> _Lens:
    bent = _bend(lens, there)
    by_lens = [[outward * power for power in bent.powers] for outward in bent.outward]
    return [bent.x, bent.y], bent.by_point, by_lens


def _brown_conrady(lens: BrownConrady, there: _There) -> _Lens:
    X, Y, Z = there.xyz
    Z = Z.only_where(Z > 0.0)
    x, y = X / Z, Y / Z
    x = x.only_where(((x < MAX_PLANE) & (-x < MAX_PLANE)) & ((y < MAX_PLANE) & (-y < MAX_PLANE)))
    r2 = x.squared() + y.squared()
    radial = ((r2 * lens.k3 + lens.k2) * r2 + lens.k1) * r2 + 1.0
    slope = ((r2 * (3 * lens.k3) + 2 * lens.k2) * r2 + lens.k1) * 2.0
    xx = radial + slope * x * x + y * (2 * lens.p1) + x * (6 * lens.p2)
    yy = radial + slope * y * y + y * (6 * lens.p1) + x * (2 * lens.p2)
    xy = slope * x * y + x * (2 * lens.p1) + y * (2 * lens.p2)
    unfolded = xx * yy > xy.squared()
    if np.isfinite(lens.critical_radius):
        unfolded = unfolded & (r2.sqrt() < lens.critical_radius)
    x = x.only_where(unfolded)
    found = [
        x * radial + x * y * (2 * lens.p1) + (r2 + x * x * 2.0) * lens.p2,
        y * radial + (r2 + y * y * 2.0) * lens.p1 + x * y * (2 * lens.p2),
    ]
    by_point = [
        [xx / Z, xy / Z, -(xx * x + xy * y) / Z],
        [xy / Z, yy / Z, -(xy * x + yy * y) / Z],
    ]
    r4 = r2.squared()
    by_lens = [
        [x * r2, x * r4, x * y * 2.0, r2 + x * x * 2.0, x * r2 * r4],
        [y * r2, y * r4, r2 + y * y * 2.0, x * y * 2.0, y * r2 * r4],
    ]
    nothing = x * 0.0  # NaN where x is
    return (
        [one + nothing for one in found],
        [[one + nothing for one in row] for row in by_point],
        [[one + nothing for one in row] for row in by_lens],
    )


def _label_error(points: Value, labels: Labels) -> Value | float:
    """(n, 3) as `Labels.off`: how far a label near each point is off."""
    shots = labels.shots
    if labels.unknowns is None or shots.reach == 0:
        return 0.0
    outside = []
    for axes, centre, extent in zip(shots.axes, shots.centre, shots.extent, strict=True):
        local = ((points - centre[None]) @ axes.T).node("Abs") - extent[None]
        outside.append(local.at_least(0.0).squared().sum().sqrt())
    away = side_by_side(outside)
    nearest = away.where_least()
    holds = ((away.least() / shots.reach).squared() * -0.5).exp()
    unknowns = (labels.sd * labels.unknowns.mean).reshape(6, -1) @ shots.pattern.T  # (6, S)
    shift, tilt = unknowns[:3].T @ shots.along, unknowns[3:].T
    lever = (points - nearest.rows_of(shots.centre)) / nearest.rows_of(shots.radius[:, None])
    (a, b, c), (x, y, z) = nearest.rows_of(tilt).columns[:3], lever.columns[:3]
    turned = side_by_side([b * z - c * y, c * x - a * z, a * y - b * x])
    return (nearest.rows_of(shift) + turned) * holds
