"""Which pose of a board, held anywhere, tells most about a rig: the design of an experiment with boards.

Near what a calibration knows, its cameras are linear in what it does not: pixels are off by `half z`, z standard normal
(`Sensitivity`). A board held at a pose that nobody knows is seen as `half z + K b`, b the six numbers of its pose; with
these eliminated its information about z is

    S = H^T (I - Q Q^T) H,   H = half / noise,   Q an orthonormal basis of K / noise        (Schur complement)

and after it the covariance of z is (I + S)^-1. Positions measured in the volume are off by `moved z`. A rig from boards
alone is in no world, only in the frame of its first camera, so the rigid motion that fits these errors best over the
volume is taken out of them (an S-transformation: Baarda 1973; the free network of photogrammetry). The gain of a pose
is by how much the mean variance of positions falls (I-optimality: Atkinson, Donev & Tobias 2007, 10.6).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np

from implicam.active.design_model import Bools, Places
from implicam.active.volume_design import VolumeDesign, linear_views
from implicam.calibrators import PredictsPixels
from implicam.dataset import Floats
from implicam.dataset.image_bounds import are_on_image, image_bounds
from implicam.errors import FitError
from implicam.geometry import Pose, look_at, poses_from_rays, rotation_from_vector

MIN_CORNERS = 12
"""Corners that a view must have to count; as `explicit` takes it."""

DESIGN_CORNERS = 16
"""Of a board with more, so many stand for all."""

SPAN = (0.25, 0.8)
"""How much of a picture's width the diagonal of a board takes that is seen well."""

MAX_TILT_DEG = 50.0
"""By which a board is held away from the cameras that look at it."""

MIN_FACING_COSINE = 0.3
"""Of the angle between a board and the line to a camera that sees it well."""

POSE_ROUNDS = 8
"""Gauss-Newton steps for the pose of a board that cameras see."""


class BoardShape(NamedTuple):
    """A board: where its corners are, and how much of it a picture must show.

    Attributes:
        corners: (n, 3) on the board, x right and y down on its printed side, z = 0, in the dataset's length unit.
        square: About from one corner to the next.
        whole: Whether a picture counts only where it shows all of them: a board without markers.
        edges: Whether lines between neighbours are edges, by which blur is seen; not of dots, whose middles stay.
        facing: Cosine of the angle between its normal and the line to a camera that sees it well, at least.
    """

    corners: Floats
    square: float
    whole: bool
    edges: bool = True
    facing: float = MIN_FACING_COSINE

    @property
    def outline(self) -> Floats:
        """(4, 3) the rim of what is printed about the corners, from the top left on, clockwise."""
        low, high = self.corners[:, :2].min(axis=0) - self.square, self.corners[:, :2].max(axis=0) + self.square
        return np.array([[*low, 0], [high[0], low[1], 0], [*high, 0], [low[0], high[1], 0]], dtype=np.float64)

    @property
    def middle(self) -> Floats:
        """(3,) the middle of the corners."""
        return np.asarray((self.corners.min(axis=0) + self.corners.max(axis=0)) / 2, dtype=np.float64)

    @property
    def diagonal(self) -> float:
        """From the first to the farthest corner."""
        return float(np.linalg.norm(np.ptp(self.corners, axis=0)))

    def some(self, count: int = DESIGN_CORNERS) -> Floats:
        """Corners that stand for all: those farthest from each other, in turn.

        Args:
            count: How many, at most.

        Returns:
            (k, 3) on the board.
        """
        corners = self.corners
        if len(corners) <= count:
            return corners
        chosen = [0]
        far = np.linalg.norm(corners - corners[0], axis=1)
        while len(chosen) < count:
            chosen.append(int(np.argmax(far)))
            far = np.minimum(far, np.linalg.norm(corners - corners[chosen[-1]], axis=1))
        return np.asarray(corners[chosen], dtype=np.float64)


@dataclass(frozen=True, eq=False)
class BoardDesign(VolumeDesign):
    """What a calibration knows, and what boards would add; a rig from boards is only in the frame of its first camera.

    Attributes:
        shape: The board.
    """

    shape: BoardShape = field(kw_only=True)

    frame_is_free: ClassVar[bool] = True
    weighs_cameras: ClassVar[bool] = False

    def pixel_noise(self) -> Floats:
        """The noise of each camera's pixels.

        Returns:
            (cameras,) rms over the judged places that it sees; NaN for a camera that is not calibrated.
        """
        there = self._at_judged
        seen = there.seen.reshape(len(there.sd), -1, 2).any(axis=2)
        variance = (there.sd**2).reshape(len(there.sd), -1, 2).mean(axis=2)
        found = np.full(variance.shape[1], np.nan)
        used = seen.any(axis=0)
        found[used] = np.sqrt(np.nanmean(np.where(seen, variance, np.nan)[:, used], axis=0))
        return found

    def gains(self, poses: Sequence[Pose], seen: Sequence[Bools] | None = None) -> Floats:
        """By how much a board at each pose would reduce the mean variance of a position in the volume.

        Args:
            poses: world_from_board of each.
            seen: (cameras,) of each, which cameras take its picture; None for those that see it well.

        Returns:
            (m,) in the squared length unit; zero where no camera sees it well.
        """
        off = self._moved[0] @ self._spread
        flat = off.reshape(-1, off.shape[2])
        W = flat.T @ flat / len(off)
        whole = float(np.trace(W))
        found = np.zeros(len(poses))
        for i, left in enumerate(self._looks(poses, seen)):
            if left is None:
                continue
            if len(left) < len(W):  # (I + L'L)^-1 = I - L' (I + L L')^-1 L: of few rows
                found[i] = np.trace(np.linalg.solve(np.eye(len(left)) + left @ left.T, left @ W @ left.T))
            else:
                found[i] = whole - np.trace(np.linalg.solve(np.eye(len(W)) + left.T @ left, W))
        return found

    def after(self, pose: Pose, seen: Bools | None = None) -> BoardDesign:
        """The design when a board was seen at a pose too.

        Args:
            pose: world_from_board.
            seen: (cameras,) which cameras took its picture; None for those that see it well.
        """
        (S,) = self._informations([pose], None if seen is None else [seen])
        if S is None:
            return self
        values, vectors = np.linalg.eigh(np.eye(len(S)) + S)
        return replace(self, spread=self._spread @ (vectors / np.sqrt(values)))

    def _informations(self, poses: Sequence[Pose], seen: Sequence[Bools] | None) -> list[Floats | None]:
        """S (k, k) of the board at each pose about z'; None where no camera sees it well."""
        return [None if left is None else left.T @ left for left in self._looks(poses, seen)]

    def _looks(self, poses: Sequence[Pose], seen: Sequence[Bools] | None) -> list[Floats | None]:
        """L (rows, k) of the board at each pose, L^T L its information about z'; None where no camera sees it well."""
        corners = self.shape.some()
        showing = self.visible(poses) if seen is None else np.array(seen, dtype=np.bool_).reshape(len(poses), -1)
        found: list[Floats | None] = []
        for pose, by in zip(poses, showing, strict=True):
            if not by.any():
                found.append(None)
                continue
            xyz = pose.apply(corners)
            uv = self.rig.predict(xyz)
            there = are_on_image(self.rig.trained, uv) & by
            part = linear_views(self.rig, xyz, there)
            weight = np.where(part.seen, 1 / part.sd, 0.0) * np.sqrt(len(self.shape.corners) / len(corners))
            turned = xyz - pose.translation
            K = np.concatenate([_cross(turned[:, None], part.slope), part.slope], axis=2) * weight[..., None]
            H = (part.half @ self._spread) * weight[..., None]
            used = part.seen.ravel()
            K, H = K.reshape(-1, 6)[used], H.reshape(-1, H.shape[2])[used]
            found.append(self._without_pose(K, H))
        return found

    def _without_pose(self, K: Floats, H: Floats) -> Floats | None:
        """L of a board, by its whitened views of the pose (rows, 6) and of the unknowns (rows, k): nobody knows the
        pose."""
        Q, R = np.linalg.qr(K)
        if len(K) < 6 or np.abs(np.diag(R)).min() < 1e-9 * np.abs(np.diag(R)).max():
            return None
        return np.asarray(H - Q @ (Q.T @ H), dtype=np.float64)

    def visible(self, poses: Sequence[Pose]) -> Bools:
        """Which cameras see a board well: its printed side, and enough of it.

        Args:
            poses: world_from_board of each.

        Returns:
            (m, cameras) of the dataset; false for a camera that is not calibrated.
        """
        if not len(poses):
            return np.zeros((0, len(self.rig.trained.cameras)), dtype=np.bool_)
        corners = np.concatenate([self.shape.corners, self.shape.outline])
        xyz = np.concatenate([pose.apply(corners) for pose in poses])
        there = are_on_image(self.rig.trained, self.rig.predict(xyz)).reshape(len(poses), len(corners), -1)
        inner = there[:, : len(self.shape.corners)]
        enough = there.all(axis=1) if self.shape.whole else inner.sum(axis=1) >= MIN_CORNERS
        facing = np.zeros_like(enough)
        middle = np.array([pose.apply(self.shape.middle) for pose in poses])
        normal = np.array([-pose.rotation[:, 2] for pose in poses])
        for c, name in enumerate(self.rig.trained.camera_names):
            if name in self.rig.camera_names:
                towards = self._eye(name).centre - middle
                cosine = np.sum(towards * normal, axis=1) / np.linalg.norm(towards, axis=1)
                facing[:, c] = cosine > self.shape.facing
        return np.asarray(enough & facing)

    def candidates(self, count: int, rng: np.random.Generator) -> list[Pose]:
        """Poses at which somebody can hold the board so that a camera or more sees it well.

        The board is anywhere in the picture of a camera, as far away as lets it span a quarter to four fifths of the
        width, tilted up to 50 degrees.

        Args:
            count: How many are tried.
            rng: Random numbers.

        Returns:
            world_from_board of each, fewer than `count`.
        """
        names, poses = self.rig.camera_names, list[Pose]()
        chosen = rng.integers(len(names), size=count)
        for number, name in enumerate(names):
            eye, mine = self._eye(name), int((chosen == number).sum())
            pixels = rng.uniform(*SPAN, size=mine) * eye.width
            places = eye.places(rng.uniform(0.08, 0.92, size=(mine, 2)), pixels, self.shape.diagonal)
            poses += [self._held(eye, place, rng) for place in places]
        seen = self.visible(poses)
        return [pose for pose, by in zip(poses, seen, strict=True) if by.any()]

    def _held(self, eye: _Eye, place: Floats, rng: np.random.Generator) -> Pose:
        others = [self._eye(name).centre for name in self.rig.camera_names]
        shares = rng.dirichlet(np.full(len(others), 0.3))  # mostly towards one or two of the cameras
        towards = np.asarray(shares @ np.array(others)) if rng.random() < 0.7 else eye.centre
        turn = rng.normal(size=3) * [1.0, 1.0, 0.4]  # tilted more than turned in its own plane
        turn *= np.radians(rng.uniform(0, MAX_TILT_DEG)) / np.linalg.norm(turn)
        frame = look_at(towards, place, eye.up).rotation.T @ rotation_from_vector(turn)
        if rng.random() < 0.25:  # upright
            frame = frame @ rotation_from_vector([0.0, 0.0, np.pi / 2])
        return Pose(frame, place - frame @ self.shape.middle)

    def _eye(self, name: str) -> _Eye:
        if name not in self._eyes:
            self._eyes[name] = _Eye.of(self.rig, name)
        return self._eyes[name]

    @cached_property
    def _eyes(self) -> dict[str, _Eye]:
        return {}

    @classmethod
    def of(cls, rig: PredictsPixels, shape: BoardShape, xyz: Floats | None = None, seed: int = 0) -> BoardDesign:
        """What a calibration knows.

        Args:
            rig: A calibration that predicts pixels.
            shape: The board.
            xyz: (g, 3) where positions have to be good; None for where a board of this size is seen well by two cameras
                or more.
            seed: Of these places.

        Raises:
            UsageError: Hardly any place is seen by two cameras.
        """
        if xyz is None:
            xyz = seen_by_two(rig, shape, seed)
        return cls(rig, Places.predicted(rig, xyz), shape=shape)


@dataclass(frozen=True, eq=False)
class PlacedBoardDesign(BoardDesign):
    """The same of a board that is put somewhere, turned as it is said to be: the rig is in the world.

    Attributes:
        placed_sd: Standard uncertainty of where it is put, along each axis.
    """

    placed_sd: float = field(kw_only=True, default=0.0)

    frame_is_free: ClassVar[bool] = False

    def _without_pose(self, K: Floats, H: Floats) -> Floats | None:
        """The same; its place alone is not known, and that to `placed_sd`."""
        shift = np.eye(len(K)) + self.placed_sd**2 * K[:, 3:] @ K[:, 3:].T
        return np.asarray(np.linalg.solve(np.linalg.cholesky(shift), H), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class _Eye:
    """A calibrated camera: centre (3,), what is up in its picture (3,), the size of that, and its lines of sight."""

    rig: PredictsPixels
    name: str
    centre: Floats
    up: Floats
    low: Floats
    size: Floats

    @property
    def width(self) -> float:
        return float(self.size[0])

    @classmethod
    def of(cls, rig: PredictsPixels, name: str) -> _Eye:
        bounds = image_bounds(rig.trained, rig.trained.camera_names.index(name))
        assert bounds is not None  # it is calibrated, so it saw something
        low, high = bounds
        middle, size = (low + high) / 2, high - low
        centre, rays = rig.lines_of_sight(name, np.stack([middle, middle - [0, 0.1 * size[1]]]))
        return cls(rig, name, centre, rays[1] - rays[0], low, size)

    def places(self, parts: Floats, pixels: Floats, length: float) -> Floats:
        """(k, 3) where a thing of some length spans so many pixels (n,); parts: (n, 2) of the picture's size. Those
        with no line of sight are left out."""
        uv, step = self.low + parts * self.size, 0.02 * self.size[0]
        _, rays = self.rig.lines_of_sight(self.name, np.concatenate([uv, uv + np.array([step, 0.0])]))
        ray, beside = np.split(rays, 2)
        angle = np.arccos(np.clip(np.sum(ray * beside, axis=1), -1, 1))
        with np.errstate(invalid="ignore", divide="ignore"):
            places = self.centre + (length * step / (pixels * angle))[:, None] * ray
        return np.asarray(places[np.isfinite(places).all(axis=1)], dtype=np.float64)


def seen_by_two(rig: PredictsPixels, shape: BoardShape, seed: int = 0, count: int = 150) -> Floats:
    """Places where a board of this size is seen well by two cameras or more.

    Args:
        rig: A calibration that predicts pixels.
        shape: The board.
        seed: Of the places.
        count: How many, about.

    Returns:
        (g, 3) in the frame of the calibration.
    """
    rng = np.random.default_rng([seed, 21])
    places = []
    for name in rig.camera_names:
        eye = _Eye.of(rig, name)
        # as many in each part of the volume, not of the depth: most of a cone is far from its tip
        depths = np.cbrt(rng.uniform(SPAN[1] ** -3, SPAN[0] ** -3, size=4 * count))
        parts = rng.uniform(0.05, 0.95, size=(len(depths), 2))
        places.append(eye.places(parts, eye.width / depths, shape.diagonal))
    xyz = rng.permutation(np.concatenate(places))
    seen = are_on_image(rig.trained, rig.predict(xyz)).sum(axis=1) >= 2
    return np.asarray(xyz[seen][:count], dtype=np.float64)


def board_pose(rig: PredictsPixels, corners: Floats, uv: Floats) -> Pose:
    """Where a board is that calibrated cameras see.

    Args:
        rig: A calibration that predicts pixels.
        corners: (n, 3) on the board.
        uv: (n, cameras, 2) pixels of all cameras of the dataset; NaN where not seen.

    Returns:
        world_from_board: the least squares of the pixels.

    Raises:
        FitError: No calibrated camera sees four corners of it.
    """
    names = rig.trained.camera_names
    counts = [np.isfinite(uv[:, c, 0]).sum() if name in rig.camera_names else 0 for c, name in enumerate(names)]
    best = int(np.argmax(counts))
    if counts[best] < 4:
        raise FitError("no calibrated camera sees the board.", fix="show it to one")
    rows = np.flatnonzero(np.isfinite(uv[:, best, 0]))
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), DESIGN_CORNERS)).astype(int)]
    centre, rays = rig.lines_of_sight(names[best], uv[rows, best])
    found = poses_from_rays(corners[rows], rays)
    if not found:
        raise FitError("the corners are nowhere on this board.", fix="look at the picture")
    starts = [Pose(pose.rotation, pose.translation + centre) for pose in found[:2]]  # a small board has two
    ends = [_refined(rig, corners, uv, pose) for pose in starts]
    return min(ends, key=lambda end: end[1])[0]


def _refined(rig: PredictsPixels, corners: Floats, uv: Floats, pose: Pose) -> tuple[Pose, float]:
    seen: Bools = np.asarray(np.isfinite(uv).all(axis=2))
    left = np.inf
    for _ in range(POSE_ROUNDS):
        xyz = pose.apply(corners)
        r = uv - rig.predict(xyz)
        part = linear_views(rig, xyz, np.asarray(seen & np.isfinite(r).all(axis=2)))
        if part.seen.sum() < 6:
            break
        weight = np.where(part.seen, 1 / part.sd, 0.0)
        K = np.concatenate([_cross((xyz - pose.translation)[:, None], part.slope), part.slope], axis=2)
        flat = (K * weight[..., None]).reshape(-1, 6)
        off = (np.nan_to_num(r.reshape(len(xyz), -1)) * weight).ravel()
        left = float(off @ off)
        step = np.linalg.lstsq(flat, off, rcond=None)[0]
        pose = Pose(rotation_from_vector(step[:3]) @ pose.rotation, pose.translation + step[3:])
        if np.abs(flat @ step).max() < 1e-3:
            break
    return pose, left


def _cross(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.cross(a, b), dtype=np.float64)
