"""Roughly where a camera sees a place, from four to seven known points: too few to calibrate it, enough to point.

Nothing is known of the camera. So all cameras that could have taken these pictures are kept, each with a weight: from
many focal lengths, two lenses and 24 rotations, orthogonal iteration and then Levenberg-Marquardt lead to the cameras
that fit, of each of which the covariance is known (Laplace's approximation). A place is where they see it on average;
the circle around it is as large as they differ, and as each is unsure.

The lens is r = f tan(sqrt(s) t) / sqrt(s) for the angle t to its axis: s = 1 is a pinhole, 1/4 a stereographic fisheye,
0 an equidistant one, below 0 those that bend more.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from implicam.geometry import Floats, cross_matrices, orthogonal_iteration, rotation_from_vector, rotations_to_start

MIN_ROUGH_POINTS = 4
"""Known points that a camera has to see: with three, any focal length fits."""

PIXEL_ERROR_RATIO = 0.003
"""Standard deviation of a view against the best camera, as a part of the picture's longer side: mostly the lens."""

FOCAL_RATIOS, FISHEYE_FOCAL_RATIOS = (0.4, 0.7, 1.2, 2.2, 4.0, 12.0), (0.25, 0.4, 0.7)
"""Focal lengths to start from, as parts of the picture's longer side: of lenses with s = 0.9, and with s = 0."""

PRIOR_MEAN = np.array([0.0, 0.75, 0.0, 0.0, 0.0])
PRIOR_SD = np.array([1.2, 0.5, 0.04, 0.04, 0.005])
"""Of log focal ratio, s, where the axis meets the picture (from its middle, in parts of the longer side), and log
aspect ratio."""

TAIL = np.array([np.inf, np.inf, 2.0, 2.0, 1.0])
"""Degrees of freedom of Student's t: some pictures are cut, some sensors tilted, some pixels not square."""

MIRRORED_COST = 6.0
"""What it costs, as a square, that a camera looks into a mirror, or the world is left-handed: 5 %."""

KEPT_PER_LENS, TURNS, STEPS = 3, 15, 20
"""Starts that go on from each lens, steps of orthogonal iteration before, and of Levenberg-Marquardt after that."""

MAX_MISFIT = 2.0
"""Times `PIXEL_ERROR_RATIO` that the best camera may leave: more is a wrong view, or no camera that is meant here."""

MAX_RADIUS_RATIO = 0.2
"""Of the longer side: a circle that is larger says nothing."""

MIN_WEIGHT = 1e-3
"""Of a camera, beside the best."""

RADIUS_SDS = 3.6
"""Standard deviations along the worst direction that the circle's radius is, were the pixels' error known; more for few
points, which tell little of it."""


class RoughViews(NamedTuple):
    """Where a camera sees some places, about.

    Attributes:
        uv: (m, 2) pixels; NaN where that cannot be said, or the place is not in the picture.
        radius: (m,) pixels: the place is inside of this circle with 95 %, at least.
    """

    uv: Floats
    radius: Floats


def rough_views(known: Floats, uv: Floats, size: tuple[int, int], places: Floats, sd: float = 0.0) -> RoughViews:
    """Roughly where one camera sees places, from a few known points.

    Args:
        known: (n, 3) known points in the world.
        uv: (n, 2) the pixels at which the camera sees them; NaN where it does not.
        size: Width and height of its pictures.
        places: (m, 3) in the world.
        sd: Standard uncertainty of the known points and of where the target will be put, in the length unit.

    Returns:
        Where it sees them; NaN where it has seen fewer than four known points, no camera fits these, or the circle
        would be larger than a fifth of the picture.

    >>> import implicam as ic
    >>> data = ic.simulated("stereo", points=6, seed=1)
    >>> seen = data.observations.uv[:, 0]
    >>> found = rough_views(data.xyz[:5], seen[:5], (1280, 1024), data.xyz[5:])
    >>> bool(np.linalg.norm(found.uv[0] - seen[5]) < found.radius[0] < 256)
    True
    """
    nothing = RoughViews(np.full((len(places), 2), np.nan), np.full(len(places), np.nan))
    seen = np.isfinite(uv).all(axis=1)
    if len(np.unique(known[seen], axis=0)) < MIN_ROUGH_POINTS:  # one that was measured again tells nothing new
        return nothing
    centre, longer = known[seen].mean(axis=0), float(max(size))
    spread = float(np.sqrt(np.mean((known[seen] - centre) ** 2)))
    middle = (np.array(size) - 1) / 2
    if not spread > 0:
        return nothing
    xyz, pixels = (known[seen] - centre) / spread, (uv[seen] - middle) / longer
    per_length = float(np.sqrt(np.mean((pixels - pixels.mean(axis=0)) ** 2)))  # the picture's size of a unit of `xyz`
    noise = float(np.hypot(PIXEL_ERROR_RATIO, per_length * sd / spread))
    cameras = _starts(xyz, pixels)
    cameras, cost = _levenberg_marquardt(cameras, xyz, pixels, noise)
    best = float(cost.min(initial=np.inf))
    freedom = 2 * len(xyz) - 6  # of eleven numbers five have a prior
    if not best < freedom * MAX_MISFIT**2:
        return nothing
    scale = max(1.0, best / freedom)
    where, covariance = _mixture(cameras, cost / scale, xyz, (places - centre) / spread, noise * np.sqrt(scale))
    a, b, d = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    larger = (a + d) / 2 + np.hypot((a - d) / 2, b)  # eigenvalue
    radius = RADIUS_SDS * np.sqrt((1 + 2 / freedom) * larger)
    at = where * longer + middle
    good = (radius < MAX_RADIUS_RATIO) & (at > -0.5).all(axis=1) & (at < np.array(size) - 0.5).all(axis=1)
    return RoughViews(np.where(good[:, None], at, np.nan), np.where(good, radius * longer, np.nan))


class _Cameras(NamedTuple):
    """k cameras: rotations (k, 3, 3), translations (k, 3), and (k, 5) log focal, s, the axis, log aspect."""

    rotation: Floats
    translation: Floats
    lens: Floats


def _starts(xyz: Floats, pixels: Floats) -> _Cameras:
    """Cameras to start from: the best rotations for each of the lenses."""
    lenses = np.array(
        [[np.log(f), 0.9, 0, 0, 0] for f in FOCAL_RATIOS] + [[np.log(f), 0.0, 0, 0, 0] for f in FISHEYE_FOCAL_RATIOS]
    )
    turns = rotations_to_start()
    g = np.linalg.norm(pixels, axis=1) / np.exp(lenses[:, :1])
    root = np.sqrt(lenses[:, 1:2])
    theta = np.where(root > 0, np.arctan(root * g) / np.where(root > 0, root, 1), g)
    sideways = pixels / np.maximum(np.linalg.norm(pixels, axis=1, keepdims=True), 1e-12)
    rays = np.concatenate([np.sin(theta)[..., None] * sideways, np.cos(theta)[..., None]], axis=2)  # (lenses, n, 3)
    mirror = np.diag([-1.0, 1.0, 1.0])
    lenses, rays = np.concatenate([lenses, lenses]), np.concatenate([rays, rays @ mirror])
    k, r = len(lenses), len(turns)
    R, t, off = orthogonal_iteration(xyz, np.repeat(rays, r, axis=0), np.tile(turns, (k, 1, 1)), TURNS)
    R[len(R) // 2 :], t[len(t) // 2 :] = mirror @ R[len(R) // 2 :], t[len(t) // 2 :] @ mirror
    kept = np.argsort(off.reshape(k, r), axis=1)[:, :KEPT_PER_LENS]
    rows = (np.arange(k)[:, None] * r + kept).ravel()
    return _Cameras(R[rows], t[rows], np.repeat(lenses, KEPT_PER_LENS, axis=0))


def _view(cameras: _Cameras, xyz: Floats) -> tuple[Floats, Floats]:
    """Pixels (k, n, 2) in parts of the longer side from the middle, and their slope (k, n, 2, 11) by rotation,
    translation and lens; NaN where a camera does not see a point."""
    turned = xyz @ cameras.rotation.swapaxes(1, 2)
    p = turned + cameras.translation[:, None]
    f, s, axis, aspect = (part[:, None] for part in np.split(cameras.lens, [1, 2, 4], axis=1))
    f, s, aspect = np.exp(f[..., 0]), s[..., 0], np.exp(aspect[..., 0])
    rho = np.maximum(np.hypot(p[..., 0], p[..., 1]), 1e-9)
    z, square = p[..., 2], np.sum(p**2, axis=2)
    theta, e = np.arctan2(rho, z), p[..., :2] / rho[..., None]
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        root = np.sqrt(np.abs(s))
        g = np.where(s > 0, np.tan(root * theta), np.tanh(root * theta)) / np.where(root > 1e-4, root, 1)
        g = np.where(root > 1e-4, g, theta)
        g = np.where((s > 0) & (root * theta > 1.5), np.nan, g)
        slope = 1 + s * g**2  # of g by theta
        by_s = np.where(np.abs(s) > 1e-3, (theta * slope - g) / np.where(np.abs(s) > 1e-3, 2 * s, 1), theta**3 / 3)
    r = f * g
    stretch = np.stack([np.ones_like(aspect), aspect], axis=2)
    uv = axis + r[..., None] * e * stretch
    by_theta = np.stack([z / square * e[..., 0], z / square * e[..., 1], -rho / square], axis=2)
    by_p = (f * slope)[..., None, None] * e[..., :, None] * by_theta[..., None, :]
    by_p[..., :2] += (r / rho)[..., None, None] * (np.eye(2) - e[..., :, None] * e[..., None, :])
    by_p *= stretch[..., None]
    J = np.zeros((*uv.shape, 11))
    J[..., :3] = -by_p @ cross_matrices(turned.reshape(-1, 3)).reshape(*turned.shape, 3)
    J[..., 3:6] = by_p
    J[..., 6] = r[..., None] * e * stretch
    J[..., 7] = (f * by_s)[..., None] * e * stretch
    J[..., 0, 8] = J[..., 1, 9] = 1.0
    J[..., 1, 10] = (r * e[..., 1]) * aspect
    return uv, J


def _prior(cameras: _Cameras) -> tuple[Floats, Floats, Floats]:
    """(k,) what a camera costs by itself, (k, 11) how far its numbers are from their prior, and (k, 11) the precision
    there."""
    off, precision = np.zeros((len(cameras.lens), 11)), np.zeros((len(cameras.lens), 11))
    off[:, 6:] = PRIOR_MEAN - cameras.lens
    square, heavy = (off[:, 6:] / PRIOR_SD) ** 2, np.isfinite(TAIL)
    tail = np.where(heavy, TAIL, 1.0)
    precision[:, 6:] = np.where(heavy, (tail + 1) / (tail + square), 1.0) / PRIOR_SD**2
    cost = np.where(heavy, (tail + 1) * np.log1p(square / tail), square).sum(axis=1)
    return cost + np.where(np.linalg.det(cameras.rotation) < 0, MIRRORED_COST, 0.0), off, precision


def _cost(cameras: _Cameras, xyz: Floats, pixels: Floats, noise: float) -> Floats:
    uv, _ = _view(cameras, xyz)
    cost = _prior(cameras)[0] + np.sum((uv - pixels) ** 2, axis=(1, 2)) / noise**2
    return np.asarray(np.where(np.isfinite(cost), cost, np.inf), dtype=np.float64)


def _levenberg_marquardt(cameras: _Cameras, xyz: Floats, pixels: Floats, noise: float) -> tuple[_Cameras, Floats]:
    """All cameras, moved to where each fits best, and the cost (k,) of each; those that fit nowhere are left out."""
    cost, damping = _cost(cameras, xyz, pixels, noise), np.full(len(cameras.lens), 1e-3)
    for _ in range(STEPS):
        normal, pull = _normal(cameras, xyz, pixels, noise)
        diagonal = np.maximum(np.diagonal(normal, axis1=1, axis2=2), 1e-12)
        damped = normal + (damping[:, None] * diagonal)[:, :, None] * np.eye(11)
        step = np.linalg.solve(damped, pull[..., None])[..., 0]
        turn, lens = rotation_from_vector(np.clip(step[:, :3], -1, 1)), cameras.lens + np.clip(step[:, 6:], -1, 1)
        moved = _Cameras(turn @ cameras.rotation, cameras.translation + step[:, 3:6], lens)
        now = _cost(moved, xyz, pixels, noise)
        better = now < cost
        cameras = _Cameras(
            *(np.where(better.reshape(-1, *[1] * (a.ndim - 1)), b, a) for a, b in zip(cameras, moved, strict=True))
        )
        cost, damping = np.where(better, now, cost), np.clip(np.where(better, damping / 8, damping * 6), 1e-9, 1e9)
    good = np.asarray(np.isfinite(cost), dtype=np.bool_)
    return _Cameras(*(part[good] for part in cameras)), cost[good]


def _normal(cameras: _Cameras, xyz: Floats, pixels: Floats, noise: float) -> tuple[Floats, Floats]:
    """The normal matrices (k, 11, 11), and the gradients (k, 11)."""
    uv, J = _view(cameras, xyz)
    _, off, precision = _prior(cameras)
    seen = np.asarray(np.isfinite(uv).all(axis=2), dtype=np.bool_)
    J = np.where(seen[..., None, None], J, 0.0).reshape(len(uv), -1, 11) / noise
    residual = np.where(seen[..., None], pixels - uv, 0.0).reshape(len(uv), -1) / noise
    normal = J.swapaxes(1, 2) @ J + (precision + 1e-9)[:, :, None] * np.eye(11)
    return normal, (J.swapaxes(1, 2) @ residual[..., None])[..., 0] + off * precision


def _mixture(cameras: _Cameras, cost: Floats, xyz: Floats, places: Floats, noise: float) -> tuple[Floats, Floats]:
    """Where all cameras together see places (m, 2), and the covariance (m, 2, 2); NaN where they do not agree that it
    is in front of them."""
    normal, _ = _normal(cameras, xyz, np.zeros((len(xyz), 2)), noise)
    weight = np.exp(-0.5 * (cost - cost.min() + np.linalg.slogdet(normal)[1]))
    kept = np.asarray(weight > MIN_WEIGHT * weight.max(), dtype=np.bool_)
    normal, weight, cameras = normal[kept], weight[kept], _Cameras(*(part[kept] for part in cameras))
    uv, J = _view(cameras, places)
    weight /= _copies(_view(cameras, np.concatenate([xyz, places]))[0], noise)
    weight /= weight.sum()
    within = J @ np.linalg.inv(normal)[:, None] @ J.swapaxes(2, 3) + noise**2 * np.eye(2)
    mean = np.einsum("k,kmi->mi", weight, uv)
    off = uv - mean
    return mean, np.einsum("k,kmij->mij", weight, within + off[..., :, None] * off[..., None, :])


def _copies(uv: Floats, noise: float) -> Floats:
    """(k,) how many of the cameras are the same one, reached from several starts: by where they see some points."""
    differ = np.abs(uv[:, None] - uv) > 0.1 * noise  # not for a point that neither sees
    return np.asarray((~differ.any(axis=(2, 3))).sum(axis=1), dtype=np.float64)
