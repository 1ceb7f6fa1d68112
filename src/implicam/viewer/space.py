"""The numbers of the 3D scene: where things go, which way is up, what colour an uncertainty has. No browser."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from implicam.active import Workspace
from implicam.calibrators import Calibration, PredictsPixels
from implicam.dataset import Floats

Colours = NDArray[np.uint8]

WIDEST = np.radians(100.0)
"""A frustum is drawn no wider: a fisheye's would hide the workspace."""

FILLED = 0.86
"""Part of the window that the scene fills: names stand beside the cameras."""

UNMEASURED = (120, 124, 132)

_VIRIDIS = np.array([
    (68, 1, 84), (71, 45, 123), (59, 82, 139), (44, 114, 142), (33, 145, 140), (40, 174, 128), (94, 201, 98),
    (173, 220, 48), (253, 231, 37),
])  # fmt: skip
"""Nine colours along matplotlib's viridis: readable for the colour-blind, and in grey."""


@dataclass(frozen=True, eq=False)
class Placing:
    """From the world to the scene, where the workspace is two units across and z is up: scale * rotation @ (x - c)."""

    centre: Floats
    scale: float
    rotation: Floats

    @classmethod
    def of(cls, workspace: Workspace, up: Floats) -> Placing:
        """up: (3,) a unit vector of the world."""
        return cls(workspace.centre, 2.0 / workspace.size, turned_up(up))

    def place(self, xyz: Floats) -> Floats:
        """Positions (..., 3) in the scene."""
        return np.asarray((xyz - self.centre) @ self.rotation.T * self.scale, dtype=np.float64)


def turned_up(up: Floats) -> Floats:
    """(3, 3) the smallest rotation that turns `up` (3,) to z; of two halves of a turn, that about x."""
    z = np.array([0.0, 0.0, 1.0])
    axis, cosine = np.cross(up, z), float(up @ z)
    if cosine < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 + cosine))


@dataclass(frozen=True, eq=False)
class Eye:
    """A calibrated camera as a frustum: centre (3,), rotation (3, 3) world from camera (columns right, down, forward),
    vertical field of view in radians, aspect width over height."""

    name: str
    centre: Floats
    rotation: Floats
    fov: float
    aspect: float


def eyes(calibration: Calibration | None) -> list[Eye]:
    """The calibrated cameras; none for a method that has none, and before the first calibration."""
    if not isinstance(calibration, PredictsPixels):
        return []
    trained, found = calibration.trained, []
    for name in calibration.camera_names:
        c = trained.camera_names.index(name)
        camera, seen = trained.cameras[c], trained.uv[:, c]
        seen = seen[np.isfinite(seen).all(axis=1)]
        width = camera.width or float(np.ceil(seen[:, 0].max())) + 1
        height = camera.height or float(np.ceil(seen[:, 1].max())) + 1
        pixels = np.array([[0.5, 0.5], [0.4, 0.5], [0.6, 0.5], [0.5, 0.4], [0.5, 0.6], [0.5, 0.0], [0.5, 1.0]])
        centre, rays = calibration.lines_of_sight(name, pixels * (width, height) - 0.5)
        eye = _eye(name, centre, rays, calibration.data.xyz.mean(axis=0) - centre, width / height)
        if eye is not None:
            found.append(eye)
    return found


def _eye(name: str, centre: Floats, rays: Floats, ahead: Floats, aspect: float) -> Eye | None:
    """Of seven lines of sight: middle, left and right of it, above and below, top, bottom. None where it has none."""
    rays = rays * np.sign(rays[:1] @ ahead)[:, None]  # a projective camera does not know which end is the front
    if not np.isfinite(rays[:5]).all():
        return None
    forward = rays[0] / np.linalg.norm(rays[0])
    right = rays[2] - rays[1]
    right = right - forward * (right @ forward)
    right = right / np.linalg.norm(right)
    down = np.cross(forward, right)
    if down @ (rays[4] - rays[3]) < 0:  # a mirrored image; a frustum cannot be
        down, right = -down, -right
    narrow = float(np.arccos(np.clip(rays[3] @ rays[4], -1, 1)))
    fov = float(np.arccos(np.clip(rays[5] @ rays[6], -1, 1))) if np.isfinite(rays[5:]).all() else 5 * narrow
    return Eye(name, centre, np.column_stack([right, down, forward]), min(fov, WIDEST), aspect)


def upwards(seen: list[Eye]) -> Floats:
    """(3,) which way is up in the world: z, unless the pictures say that it cannot be.

    It is z where most pictures show z upwards, or where the cameras look down or up along it. Else the axis that is
    nearest to the pictures' own up.
    """
    z = np.array([0.0, 0.0, 1.0])
    if not seen:
        return z
    up = -np.mean([eye.rotation[:, 1] for eye in seen], axis=0)
    along = np.mean([eye.rotation[:, 2] for eye in seen], axis=0)
    if up @ z >= 0.4 or along @ z <= -0.7 or np.linalg.norm(up) < 0.3:
        return z
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    return np.asarray(axes[int(np.argmax(axes @ up))])


def vantage(seen: list[Eye], corners: Floats, placing: Placing, aspect: float, fov: float) -> tuple[Floats, Floats]:
    """Where to look from, (3,), and at what, (3,), in the scene, so that everything is in view and as large as can be.

    From behind the cameras and a little above, more or less from the side. corners: (n, 3) of the workspace, world;
    aspect: of the window, width over height; fov: its vertical angle, radians.
    """
    places = placing.place(np.array([*corners, *(eye.centre for eye in seen)]))
    middle = (places.min(axis=0) + places.max(axis=0)) / 2
    behind = np.mean([placing.place(eye.centre) for eye in seen], axis=0) if seen else np.zeros(3)
    behind[2] = 0
    length = float(np.linalg.norm(behind))
    back = behind / length if length > 0.3 else np.array([-0.55, -0.83, 0.0])
    side = np.array([-back[1], back[0], 0.0])
    ways = [back + across * side + np.array([0, 0, 0.55]) for across in (-1.5, -1.0, -0.6, 0.6, 1.0, 1.5)]
    reach = np.tan(fov / 2) * FILLED * np.array([aspect, 1.0])
    views = [(_distance(places - middle, way / np.linalg.norm(way), reach), way / np.linalg.norm(way)) for way in ways]
    distance, way = min(views, key=lambda view: view[0])
    return middle + distance * way, middle


def _distance(places: Floats, way: Floats, reach: Floats) -> float:
    """From how far along `way` (3,) all places (n, 3) are in view. reach: (2,) tangents of half the window's angles."""
    right = np.cross([0.0, 0.0, 1.0], way)
    right = right / np.linalg.norm(right)
    across = np.abs(places @ np.column_stack([right, np.cross(way, right)]))
    return float((across / reach + (places @ way)[:, None]).max())


def edges(workspace: Workspace) -> Floats:
    """(n, 2, 3) the edges of the workspace's hull: pairs of corners on two planes that are not the same."""
    size, corners = workspace.size, workspace.vertices
    planes = np.unique(np.round(np.column_stack([workspace.normals, workspace.offsets / size]), 6), axis=0)
    on = np.abs(corners @ planes[:, :3].T - planes[:, 3] * size) < 1e-5 * size
    shared = on.astype(int) @ on.T.astype(int)
    pairs = [
        (i, j)
        for i, j in zip(*np.nonzero(np.triu(shared, 1) >= 2), strict=True)
        if np.linalg.matrix_rank(planes[on[i] & on[j], :3], tol=1e-4) >= 2
    ]
    return np.asarray(corners[np.array(pairs, dtype=int).reshape(-1, 2)], dtype=np.float64)


@dataclass(frozen=True)
class Scale:
    """What the colours mean: from `low` (yellow: good) to `high` (violet), in ratios."""

    low: float
    high: float

    @classmethod
    def around(cls, value: float) -> Scale:
        """About a value: from 1, 2 or 5 below it to twenty times as much."""
        exponent = np.floor(np.log10(value))
        step = max(s for s in (1.0, 2.0, 5.0) if s <= value / 10**exponent * (1 + 1e-9))
        low = float(step * 10**exponent)
        return cls(low, float(f"{20 * low:.6g}"))

    def colours(self, values: Floats) -> Colours:
        """(n, 3) red, green, blue of values (n,); grey for NaN."""
        with np.errstate(invalid="ignore", divide="ignore"):
            part = np.log(values / self.low) / np.log(self.high / self.low)
        good = np.isfinite(part)
        where = np.clip(1 - part[good], 0, 1) * (len(_VIRIDIS) - 1)
        out = np.full((len(values), 3), UNMEASURED, dtype=np.float64)
        out[good] = np.column_stack([np.interp(where, np.arange(len(_VIRIDIS)), channel) for channel in _VIRIDIS.T])
        return np.rint(out).astype(np.uint8)

    def ticks(self) -> list[float]:
        """Round numbers in it, its ends too."""
        decade = 10 ** np.floor(np.log10(self.low))
        steps = [float(f"{s * decade * d:.3g}") for d in (1, 10, 100) for s in (1, 2, 5)]
        return [t for t in steps if self.low * (1 - 1e-9) <= t <= self.high * (1 + 1e-9)]
