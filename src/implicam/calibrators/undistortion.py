"""What makes each camera of a calibration a perfect pinhole: pixel maps, and how well they are known.

The pinhole stands where the calibration has the camera; its numbers K, R, t are exact by definition, and all that is
not known of the camera is in the map. A pixel of the pinhole is a ray; the map is where the camera sees the places on
that ray, and its variance is that of this prediction: lens, pose, residual field.

forward-gp's field depends on the distance as well (a window, the shift of the entrance pupil), so there is no exact
map for all distances. Places are taken at the depths of the known points, `DEPTH_QUANTILES` of them: the map is the
mean over these, and what it changes between them is in its variance. Where that is much (behind water, the light does
not come from where the lens is) the pinhole stands where the map changes least.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import ConvexHull, QhullError

from implicam.calibrators.cameras import world_pose
from implicam.calibrators.protocol import Calibration, RigCalibration
from implicam.errors import DatasetError, UsageError
from implicam.exchange import ExplicitCamera
from implicam.exchange.pixel_maps import NO_PIXEL, PinholeMaps
from implicam.formatting import decimal_number, percent
from implicam.geometry import Bools, Floats, Pose
from implicam.lenses import BrownConrady
from implicam.progress import Progress, silent
from implicam.registry import Option
from implicam.rig_model import CameraModel, FittedRig, apply_covariance_root
from implicam.rig_model.camera import ProjectiveCamera
from implicam.rig_model.normal_equations import POINTS_PER_CHUNK
from implicam.threads import blas_threads, side_by_side

DEPTH_QUANTILES = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Of the depths of the known points that a camera sees: five shares of the same weight."""

LATTICE_SPACING_PX = 8.0
"""Of the pixels of a new picture at which field and variance are computed; they are linear between."""

VIEW_LATTICE = 33
"""Pixels along each side of a picture that say what it sees."""

MIN_DEPTH_SHARE = 0.5
"""Change of a map with the depth, over the camera's noise, that is worth a note."""

CENTRE_BOUNDS = np.array([0.5, 0.5, 3.0])
"""How far the centre may go from the camera's own: slopes, and the log of its distance."""

MAX_SIDE_PX = 32766
"""Of a picture for cv2.remap."""

MAX_ANGLE_DEG = 85.0


@dataclass(frozen=True)
class PinholeView:
    """What the pinhole sees. alpha is that of OpenCV's getOptimalNewCameraMatrix."""

    alpha: Annotated[
        float | None,
        Option("Zoom: 0 so that no pixel is empty, 1 so that nothing seen is lost (default: as it is)", "0..1"),
    ] = None
    size: Annotated[
        tuple[int, int] | None, Option("Size of the new pictures (default: as they are)", "WxH", kind=str)
    ] = None
    max_angle: Annotated[float, Option("Leave out what is farther off the axis; a pinhole has less than 90", "DEG")] = (
        70
    )
    depth: Annotated[
        float | None, Option("Distance along the axis that the maps are for (default: the known points')", "LENGTH")
    ] = None

    def __post_init__(self) -> None:
        checks = (
            (self.alpha is None or 0 <= self.alpha <= 1, "alpha", self.alpha, "from 0 to 1"),
            (self.size is None or all(16 <= n <= MAX_SIDE_PX for n in self.size), "size", self.size,
             f"from 16x16 to {MAX_SIDE_PX}x{MAX_SIDE_PX}"),
            (0 < self.max_angle <= MAX_ANGLE_DEG, "max_angle", self.max_angle,
             f"above 0 and up to {MAX_ANGLE_DEG:g} degrees: toward 90 a pinhole's picture has no end"),
            (self.depth is None or 0 < self.depth < np.inf, "depth", self.depth, "above zero, in the rig's unit"),
        )  # fmt: skip
        for right, name, value, allowed in checks:
            if not right:
                raise UsageError(f"{name} = {value!r} cannot be.", fix=f"give a value {allowed}")


def pinhole_maps(
    calibration: Calibration, view: PinholeView | None = None, progress: Progress = silent
) -> tuple[list[PinholeMaps], list[str]]:
    """The maps of all cameras of a calibration.

    Args:
        calibration: Of a method with cameras.
        view: What the pinholes see.
        progress: Is told how many cameras are done.

    Returns:
        One for each calibrated camera; and notes on what a pinhole cannot show, and on what is not known.

    Raises:
        UsageError: The method has no cameras.
        DatasetError: The size of a camera's pictures is not known, or it sees nothing that a pinhole could.
    """
    if not isinstance(calibration, RigCalibration):
        raise UsageError(
            f"{calibration.method} has no cameras that could become pinholes.",
            why="it learns the map from pixels to positions as a whole",
            fix="calibrate the same data with --method forward-gp",
        )
    made, notes = [], []
    rejected = {(view.point, view.camera) for view in calibration.rejected}
    names = calibration.camera_names
    with blas_threads(1):
        for number, name in enumerate(names):
            progress("pixel maps", number, len(names))
            seen = _used_views(calibration.map, number, rejected)
            camera = _Undistortion.of(calibration.map, number, calibration.data.xyz, view or PinholeView())
            maps, told = camera.make(seen)
            made.append(maps)
            notes += [f"{name}: {text}" for text in told]
    progress("pixel maps", len(names), len(names))
    if calibration.map.misfit_adds and any(maps.extrapolated.any() for maps in made):
        notes.append(
            "beyond the known points the sd supposes that the family of each lens is right; forward-gp does not need to"
        )
    return made, notes


def _used_views(rig: FittedRig, number: int, rejected: set[tuple[str, str]]) -> Floats:
    """(n, 2) pixels that a camera was calibrated with."""
    c = rig.cameras[number]
    name, uv = rig.trained.camera_names[c], rig.trained.uv[:, c]
    used = [(str(point), name) not in rejected for point in rig.trained.points]
    return uv[np.isfinite(uv).all(axis=1) & np.array(used, dtype=np.bool_)]


class _Window(NamedTuple):
    """Where the new picture's middle looks, (2,) at depth 1; its focal length, and its size in pixels."""

    middle: Floats
    focal: float
    size: tuple[int, int]

    @property
    def principal_point(self) -> Floats:
        return (np.array(self.size) - 1) / 2 - self.focal * self.middle

    def plane(self, uv: Floats) -> Floats:
        """(n, 2) at depth 1 of pixels (n, 2)."""
        return (uv - self.principal_point) / self.focal


class _Prediction(NamedTuple):
    """Of n places in the plane: field (n, 2), variance (n, 2) and that part of it which the depth makes (n,), px."""

    field: Floats
    variance: Floats
    by_depth: Floats


@dataclass(frozen=True, eq=False)
class _Undistortion:
    """One camera on its way to a pinhole. Places in its view are (n, 2) in the plane at depth 1 of the pinhole.

    pose: camera_from_working of the pinhole; root: of the covariance of the camera's unknowns; misfit: px, what its
    lens model leaves (`FittedRig.misfit`); depths: (k,) in the working frame.
    """

    rig: FittedRig
    model: CameraModel
    name: str
    size: tuple[int, int]
    pose: Pose
    root: Floats
    misfit: float
    depths: Floats
    view: PinholeView

    @classmethod
    def of(cls, rig: FittedRig, number: int, known: Floats, view: PinholeView) -> _Undistortion:
        """Camera `number` of a rig, whose known positions (n, 3) are in the world."""
        described, model = rig.trained.cameras[rig.cameras[number]], rig.posterior.models[number]
        if described.width is None or described.height is None:
            raise DatasetError(
                f"the image size of camera {described.name!r} is not known, and pixel maps need it.",
                fix="give width and height in dataset.toml, and calibrate again",
            )
        root = rig.posterior.root(number)
        if len(root) > root.shape[1]:  # of tied cameras: the same covariance from fewer rows
            root = np.asarray(np.linalg.qr(root, mode="r"), dtype=np.float64)
        size, pose = (described.width, described.height), _pinhole_pose(model)
        seen = _seen(model, pose, rig.frame.to_working(known), size)
        pose, depths = _centred(model, pose, seen)
        if view.depth is not None:
            depths = np.array([view.depth / rig.frame.scale])
        return cls(rig, model, described.name, size, pose, root, rig.misfit(number), depths, view)

    @property
    def _depth(self) -> float:
        return float(np.median(self.depths))

    def points(self, places: Floats, depth: float | None = None) -> Floats:
        """(n, 3) of the working frame at a depth."""
        rays = np.column_stack([places, np.ones(len(places))]) * (depth or self._depth)
        return self.pose.centre + rays @ self.pose.rotation

    def pixels(self, places: Floats) -> Floats:
        """(n, 2) where the camera sees them at the middle depth without its field."""
        return np.concatenate([self.model.camera.pixel(self.points(part)) for part in _chunks(places)])

    def predict(self, places: Floats) -> _Prediction:
        """What the field adds, and what is known."""
        if not len(places):
            return _Prediction(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
        parts = side_by_side(self._predict, _chunks(places))
        return _Prediction(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    def _predict(self, places: Floats) -> _Prediction:
        fields, variances = [], []
        for depth in self.depths:
            points = self.points(places, depth)
            labels = self.rig.labels
            rows = self.model.rows(points if labels is None else points + labels.off(points))
            variance = np.sum(apply_covariance_root(rows, self.root) ** 2, axis=2) + rows.rest[:, None]
            if labels is not None:  # the world is made of the labels: where a place is, is known as well as they are
                variance += np.einsum("nij,njk,nik->ni", rows.by_point, labels.world(points), rows.by_point)
            fields.append(rows.mean - self.model.camera.pixel(self.points(places)))
            variances.append(variance + self.misfit**2)
        apart = np.var(fields, axis=0)
        return _Prediction(np.mean(fields, axis=0), np.mean(variances, axis=0) + apart, apart.mean(axis=1))

    def make(self, used: Floats) -> tuple[PinholeMaps, list[str]]:
        """The maps, and notes. used: (n, 2) pixels that the camera was calibrated with."""
        window, notes = self._window()
        width, height = window.size
        u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
        places = window.plane(np.column_stack([u.ravel(), v.ravel()]))
        lens = self.pixels(places)
        there = np.isfinite(lens).all(axis=1) & (np.hypot(*places.T) <= self._reach)
        field, variance, by_depth = self._over_picture(window, places, there)
        uv = np.where(there[:, None], lens + field, np.nan)
        there &= np.isfinite(uv).all(axis=1)
        sd = np.sqrt(np.where(there[:, None], variance, np.nan))
        if not self.root.any():
            sd[:] = np.nan
            notes.append("nothing is known of how well it is calibrated, so the sd of its maps is NaN")
        map_x, map_y = np.where(there, uv.T, NO_PIXEL).astype(np.float32).reshape(2, height, width)
        sd_x, sd_y = sd.T.astype(np.float32).reshape(2, height, width)
        maps = PinholeMaps(
            self._pinhole(window),
            self.size,
            map_x,
            map_y,
            sd_x,
            sd_y,
            ~_inside_hull(uv, used).reshape(height, width),
            self.depths * self.rig.frame.scale,
        )
        return maps, notes + self._depth_notes(by_depth, maps)

    def _depth_notes(self, by_depth: Floats, maps: PinholeMaps) -> list[str]:
        among = (maps.filled & ~maps.extrapolated).ravel()
        moves = float(np.sqrt(np.mean(by_depth[among]))) if among.any() else 0.0
        if moves <= MIN_DEPTH_SHARE * self.model.noise:
            return []
        low, high = (decimal_number(depth) for depth in (maps.depths.min(), maps.depths.max()))
        return [
            f"it is no exact pinhole (a window, water?): its map changes by {decimal_number(moves, 2)} px rms between "
            f"the depths {low} and {high} {self.rig.length_unit}, which is in its sd; --depth makes that of one depth"
        ]

    def _over_picture(self, window: _Window, places: Floats, there: Bools) -> _Prediction:
        """Field, variance and its part by depth at all pixels: on a lattice, linear between; at its rim one by one."""
        zoom = window.focal / self._magnification(window.middle)
        spacing = max(LATTICE_SPACING_PX * min(zoom, 1.0), 1.0)  # as fine in the camera's own picture
        axes = [np.linspace(0, side - 1, int(np.ceil(side / spacing)) + 1) for side in window.size]
        u, v = np.meshgrid(*axes)
        found = self.predict(window.plane(np.column_stack([u.ravel(), v.ravel()])))
        layers = np.column_stack([found.field, found.variance, found.by_depth]).reshape(*u.shape, 5)
        full = _stretch(_stretch(layers, window.size[1]).swapaxes(0, 1), window.size[0]).swapaxes(0, 1).reshape(-1, 5)
        rim = np.flatnonzero(there & np.isnan(full).any(axis=1))
        full[rim] = np.column_stack(self.predict(places[rim]))
        return _Prediction(full[:, :2], full[:, 2:4], full[:, 4])

    @property
    def _reach(self) -> float:
        """How far a place may be off the axis."""
        return float(np.tan(np.radians(self.view.max_angle)))

    def _window(self) -> tuple[_Window, list[str]]:
        """Which part of the world the new picture shows."""
        corner = np.array(self.size) - 1.0
        u, v = np.meshgrid(*(np.linspace(0, side, VIEW_LATTICE) for side in corner))
        uv = np.column_stack([u.ravel(), v.ravel()])
        centre, lines = self.model.camera.lines(uv)
        start, rays = self.pose.apply(centre), lines @ self.pose.rotation.T
        valid = np.isfinite(rays).all(axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            places = (start[:2] + rays[:, :2] / rays[:, 2:] * (self._depth - start[2])) / self._depth
            held = valid & (rays[:, 2] > 0) & (np.hypot(*places.T) <= self._reach)
        if not held.any():
            raise DatasetError(
                f"camera {self.name!r} sees nothing within {self.view.max_angle:g} degrees of its axis.",
                why="its calibration has the axis far outside of its picture",
                fix=f"allow more, up to {MAX_ANGLE_DEG:g} degrees, or calibrate with known points all over the picture",
            )
        cut = float(np.mean(valid & ~held) / np.mean(valid))
        notes = []
        if cut:
            notes.append(
                f"{percent(cut)} of its picture looks more than {self.view.max_angle:g} degrees off its axis, which "
                "the pinhole leaves out"
            )
        places = places[held]
        middle = places[np.argmin(np.hypot(*(uv[held] - corner / 2).T))]
        new = self.view.size or self.size
        window = _Window(middle, self._magnification(middle), new)
        if self.view.alpha is None:
            return window, notes
        off = np.maximum(np.abs(places - middle).max(axis=0), 1e-12)
        whole = float(np.min((np.array(new) - 1) / 2 / off))
        full = self._least_full(window)
        return window._replace(focal=full ** (1 - self.view.alpha) * whole**self.view.alpha), notes

    def _magnification(self, middle: Floats) -> float:
        """Pixels per unit of the plane at depth 1, in the middle of the picture."""
        by_point = self.model.camera.view(self.points(middle[None])).by_point[0]
        slope = by_point @ self.pose.rotation[:2].T * self._depth
        return float(np.sqrt(np.abs(np.linalg.det(slope))))

    def _least_full(self, window: _Window) -> float:
        """The least focal length with which no pixel of the new picture is empty, by bisection."""
        width, height = window.size
        rim = [(u, v) for v in (0, height - 1) for u in range(width)]
        rim += [(u, v) for u in (0, width - 1) for v in range(height)]
        u, v = np.meshgrid(*(np.linspace(0, side - 1, VIEW_LATTICE) for side in window.size))
        uv, last = np.concatenate([rim, np.column_stack([u.ravel(), v.ravel()])]), np.array(self.size) - 1

        def empty(focal: float) -> bool:
            places = window._replace(focal=focal).plane(uv)
            at = self.model.predict(self.points(places))[0]
            with np.errstate(invalid="ignore"):
                inside = ((at >= 0) & (at <= last)).all(axis=1)
            return not bool((inside & (np.hypot(*places.T) <= self._reach)).all())

        high = window.focal
        for _ in range(40):
            if not empty(high):
                break
            high *= 1.25
        low = high / 1.25
        while not empty(low) and low > 1e-3 * high:
            low /= 1.25
        for _ in range(20):
            between = float(np.sqrt(low * high))
            low, high = (between, high) if empty(between) else (low, between)
        return high

    def _pinhole(self, window: _Window) -> ExplicitCamera:
        lens = BrownConrady(window.focal, window.focal, *window.principal_point.tolist())
        return ExplicitCamera(self.name, *window.size, lens, world_pose(self.pose, self.rig.frame))


def _pinhole_pose(model: CameraModel) -> Pose:
    """camera_from_working of the pinhole: that of the camera; of a linear projection, the one that its matrix has.

    A mirrored picture is turned over by the map, so the pinhole sees the world as it is.
    """
    camera = model.camera
    if not isinstance(camera, ProjectiveCamera):
        return camera.pose
    centre, forward = camera.lines(np.zeros((1, 2)))[0], camera.P[2, :3]
    z = forward / np.linalg.norm(forward)
    y = camera.P[1, :3] - z * (camera.P[1, :3] @ z)
    y /= np.linalg.norm(y)
    rotation = np.stack([np.cross(y, z), y, z])
    return Pose(rotation, -rotation @ centre)


def _seen(model: CameraModel, pose: Pose, known: Floats, size: tuple[int, int]) -> Floats:
    """Those of the known points (n, 3) of the working frame that fall into the picture."""
    uv, depth = model.camera.pixel(known), pose.apply(known)[:, 2]
    with np.errstate(invalid="ignore"):
        return known[((uv >= 0) & (uv <= np.array(size) - 1)).all(axis=1) & (depth > 0)]


def _centred(model: CameraModel, pose: Pose, seen: Floats) -> tuple[Pose, Floats]:
    """The pinhole's pose, and depths of the points (n, 3) that it sees; 1 where there are none.

    It keeps the camera's centre unless what is seen along its rays changes with the depth, which a centre at another
    place may mend: then it goes where it changes least, by least squares in pixels. The rays through the points at
    their middle depth stay; the unknowns are two slopes and the log distance to their mean.
    """
    if not len(seen):
        return pose, np.ones(1)
    there = pose.apply(seen)
    depths = np.unique(np.quantile(there[:, 2], DEPTH_QUANTILES))
    middle = float(np.median(depths))
    through = there * (middle / there[:, 2:])
    mean, off = through.mean(axis=0), depths - middle

    def centre(w: Floats) -> Floats:
        away = np.exp(w[2])
        return np.array([mean[0] - w[0] * away, mean[1] - w[1] * away, middle - away])

    def changes(w: Floats) -> Floats:
        rays = through - centre(w)
        rays /= rays[:, 2:]
        places = (through + off[:, None, None] * rays).reshape(-1, 3)
        uv = model.predict((places - pose.translation) @ pose.rotation)[0].reshape(len(off), -1, 2)
        return np.asarray(np.nan_to_num(uv - uv.mean(axis=0)).ravel())

    start = np.array([*mean[:2] / middle, np.log(middle)])
    if np.sqrt(np.mean(changes(start) ** 2)) <= MIN_DEPTH_SHARE * model.noise:
        return pose, depths
    found = least_squares(changes, start, bounds=(start - CENTRE_BOUNDS, start + CENTRE_BOUNDS)).x
    moved = centre(found)
    return Pose(pose.rotation, pose.translation - moved), depths - moved[2]


def _chunks(rows: Floats) -> list[Floats]:
    return [rows[i : i + POINTS_PER_CHUNK] for i in range(0, len(rows), POINTS_PER_CHUNK)]


def _stretch(rows: Floats, count: int) -> Floats:
    """(count, ...) from fewer rows, linear between them; the first and the last stay. NaN beside a NaN."""
    at = np.linspace(0, len(rows) - 1, count)
    low = np.minimum(at.astype(int), len(rows) - 2)
    part = (at - low).reshape(-1, *[1] * (rows.ndim - 1))
    return np.asarray((1 - part) * rows[low] + part * rows[low + 1])


def _inside_hull(uv: Floats, among: Floats) -> Bools:
    """(n,) which pixels lie in the convex hull of others; none where these have no area."""
    try:
        hull = ConvexHull(among) if len(among) > 2 else None
    except QhullError:
        hull = None
    inside = np.asarray(np.isfinite(uv).all(axis=1))
    if hull is None:
        return np.zeros_like(inside)
    for a, b, c in hull.equations:
        with np.errstate(invalid="ignore"):
            inside &= a * uv[:, 0] + b * uv[:, 1] + c <= 0
    return inside
