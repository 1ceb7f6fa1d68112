"""What forward-gp would know of cameras that nobody has built yet, from known points that nobody has measured yet.

Near the truth the method is linear: how uncertain it is depends on where the cameras and the known points are, and not
on what noise they will have. So the same equations, (8), (13) and (14) of docs/method.md, give the covariance of the
cameras without any view; sizes of field and noise, which a fit estimates, are told. Where known positions have errors,
these tie the cameras as eq. (27) says.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from implicam.calibrators.forward_gp.families import family_prior, widest_angle
from implicam.calibrators.forward_gp.hyperparameters import FIELD_VARIANCE_TOLERANCE
from implicam.calibrators.forward_gp.settings import DEFAULT_SETTINGS, ForwardGPSettings
from implicam.dataset.requirements import require_volume
from implicam.errors import FitError
from implicam.geometry import Bools, Floats, Pose
from implicam.lenses import KannalaBrandt, Lens
from implicam.rig_model.camera import CentralCamera, Image
from implicam.rig_model.camera_model import CameraModel, CameraViews, apply_covariance_root
from implicam.rig_model.field import DepthScale, empty_field, field_coordinates
from implicam.rig_model.general_camera import GeneralCamera
from implicam.rig_model.normal_equations import camera_normals, invert_stack, solve_normal
from implicam.rig_model.posterior import Posterior
from implicam.rig_model.tied import MAX_INFORMATION_LOST, MIN_VARIANCE_GROWTH
from implicam.rig_model.training_data import MIN_POINTS_PER_CAMERA, Frame
from implicam.rig_model.triangulate import predict_covariance

PLACES_PER_CHUNK = 256
"""Places at a time: where cameras are tied, each has a matrix of all its views."""


@dataclass(frozen=True, eq=False)
class PlannedCamera:
    """A camera that is planned.

    Attributes:
        name: Of the camera.
        width, height: Of its pictures, in pixels.
        lens: Its lens, of any family.
        camera_from_world: Its pose.
        noise: Standard deviation of a view, in pixels.
        field_sd: Standard deviation in pixels of what no lens model contains, affine parts included.
        field_range: The length over which that changes, in half the longer side of the image.
    """

    name: str
    width: int
    height: int
    lens: Lens
    camera_from_world: Pose
    noise: float
    field_sd: float
    field_range: float


@dataclass(frozen=True, eq=False)
class PlannedRig:
    """Cameras as forward-gp would know them.

    Attributes:
        frame: The working frame.
        numbers: Of the cameras that can be calibrated, among those planned.
        models: These cameras, in the working frame.
        alone: Per camera the root (P, P) of the covariance of its unknowns, were the known positions exact.
        slopes: Per camera (N, 2, 3) how its views depend on the errors of the known positions, both in their sds.
        couplings: Per camera (N, 3, P) `slopes^T` times how the views depend on what is unknown of the camera, in sds.
            Both are empty where known positions are exact.
    """

    frame: Frame
    numbers: tuple[int, ...]
    models: tuple[CameraModel, ...]
    alone: tuple[Floats, ...]
    slopes: tuple[Floats, ...] = ()
    couplings: tuple[Floats, ...] = ()

    def without(self, number: int) -> PlannedRig:
        """The rig without one of its cameras.

        Args:
            number: Of the camera, among those planned.

        Raises:
            FitError: Fewer than two cameras are left.
        """
        kept = [i for i, own in enumerate(self.numbers) if own != number]
        if len(kept) < 2:
            raise FitError("one camera alone measures no positions.")

        def some(values: tuple[Floats, ...]) -> tuple[Floats, ...]:
            return tuple(values[i] for i in kept) if values else ()

        return PlannedRig(
            self.frame,
            tuple(self.numbers[i] for i in kept),
            tuple(self.models[i] for i in kept),
            some(self.alone),
            some(self.slopes),
            some(self.couplings),
        )

    @cached_property
    def posterior(self) -> Posterior:
        """What is known of the cameras, in the working frame."""
        return Posterior(self.models, self.alone, ties=self._ties() if self.slopes else None)

    def covariance(self, xyz: Floats, seen: Bools) -> Floats:
        """The covariance that a position measured at each of some places would have.

        Args:
            xyz: (n, 3) in the world.
            seen: (n, C) which of the cameras planned see it.

        Returns:
            (n, 3, 3) in the squared length unit; NaN where fewer than two calibrated cameras see a place.
        """
        points, used = self.frame.to_working(xyz), self._used(xyz, seen)
        noise = np.array([model.noise for model in self.models])
        found = np.full((len(xyz), 3, 3), np.nan)
        for start in range(0, len(xyz), PLACES_PER_CHUNK):
            part = slice(start, start + PLACES_PER_CHUNK)
            views = np.broadcast_to(noise, used[part].shape)
            found[part] = predict_covariance(self.posterior, points[part], views, used[part])
        return found * self.frame.scale**2

    def covariance_without_each(self, xyz: Floats, seen: Bools) -> Iterator[tuple[int, Floats]]:
        """The same without each of the calibrated cameras in turn.

        Args:
            xyz: (n, 3) in the world.
            seen: (n, C) which of the cameras planned see it.

        Returns:
            The number of the camera, and (n, 3, 3) as of `covariance`; NaN everywhere where one camera is left.
        """
        if len(self.numbers) == 2:
            yield from ((number, np.full((len(xyz), 3, 3), np.nan)) for number in self.numbers)
        elif self.slopes:  # a camera also tells the others how the known positions are off
            yield from ((number, self.without(number).covariance(xyz, seen)) for number in self.numbers)
        else:
            used = self._used(xyz, seen)
            each = [self._information_of(i, xyz, used[:, i]) for i in range(len(self.numbers))]
            whole = np.sum(each, axis=0)
            for i, number in enumerate(self.numbers):
                left = whole - each[i]
                left[used.sum(axis=1) - used[:, i] < 2] = np.nan
                yield number, invert_stack(left) * self.frame.scale**2

    def _information_of(self, i: int, xyz: Floats, used: Bools) -> Floats:
        """(n, 3, 3) what the view of one camera alone says of each place, in the working frame."""
        points, model = self.frame.to_working(xyz[used]), self.models[i]
        rows, slope = model.rows_and_slope(points)
        half = apply_covariance_root(rows, self.alone[i])
        S = half @ half.swapaxes(1, 2) + (model.noise**2 + rows.rest)[:, None, None] * np.eye(2)
        found = np.zeros((len(xyz), 3, 3))
        found[used] = slope.swapaxes(1, 2) @ np.linalg.solve(S, slope)
        return found

    def floor(self, xyz: Floats, seen: Bools) -> Floats:
        """The covariance that pixel noise alone would leave, were the cameras known exactly.

        Args:
            xyz: (n, 3) in the world.
            seen: (n, C) which of the cameras planned see it.

        Returns:
            (n, 3, 3) in the squared length unit; NaN where fewer than two calibrated cameras see a place.
        """
        points, used = self.frame.to_working(xyz), self._used(xyz, seen)
        information = np.zeros((len(xyz), 3, 3))
        for i, model in enumerate(self.models):
            rows = used[:, i]
            slope = model.predict(points[rows])[1] / model.noise
            information[rows] += slope.swapaxes(1, 2) @ slope
        information[used.sum(axis=1) < 2] = np.nan
        return invert_stack(information) * self.frame.scale**2

    def _used(self, xyz: Floats, seen: Bools) -> Bools:
        """(n, calibrated cameras) where a camera sees a place and its lens has an answer."""
        points = self.frame.to_working(xyz)
        answers = [np.isfinite(model.predict(points)[1]).all(axis=(1, 2)) for model in self.models]
        return np.asarray(seen[:, list(self.numbers)] & np.stack(answers, axis=1), dtype=np.bool_)

    def _ties(self) -> Floats:
        """(q, sum P) as of `Posterior`.

        In units of what each camera alone knows, errors of the N points take Z^T Z off the information, Z (3 N, sum P);
        its eigenvectors follow from those of Z Z^T, which is the smaller one.
        """
        H = np.eye(3) + sum(slope.swapaxes(1, 2) @ slope for slope in self.slopes)
        L = np.linalg.cholesky(H)
        Z = [np.linalg.solve(L, coupling).reshape(-1, coupling.shape[2]) for coupling in self.couplings]
        lost, U = np.linalg.eigh(sum(part @ part.T for part in Z))
        lost = np.clip(lost, 0, MAX_INFORMATION_LOST)
        kept = lost / (1 - lost) > MIN_VARIANCE_GROWTH
        turned = (U[:, kept] / np.sqrt(1 - lost[kept])).T
        return np.hstack([turned @ part @ root for part, root in zip(Z, self.alone, strict=True)])


def plan_rig(
    cameras: Sequence[PlannedCamera],
    known_xyz: Floats,
    seen: Bools,
    position_sd: float = 0.0,
    settings: ForwardGPSettings = DEFAULT_SETTINGS,
) -> PlannedRig:
    """What forward-gp would know of cameras after seeing known points.

    Args:
        cameras: The C cameras as planned.
        known_xyz: (N, 3) known positions in the world.
        seen: (N, C) which camera sees which of them.
        position_sd: Standard deviation of each coordinate of a known position, in the length unit; 0 for exact ones.
        settings: Priors of the method.

    Returns:
        The rig, with those of the cameras that see enough of the points.

    Raises:
        FitError: Fewer than two cameras see enough known points, or these do not fill a volume.
    """
    used = known_xyz[seen.any(axis=1)]
    if len(used) < MIN_POINTS_PER_CAMERA:
        raise FitError(
            f"{len(used)} of {len(known_xyz)} known points would be seen by any camera; forward-gp needs at least "
            f"{MIN_POINTS_PER_CAMERA}.",
            fix="plan more known points, where the cameras look; positions and poses are in one frame and unit",
        )
    require_volume(used, "forward-gp")
    offset = used.mean(axis=0)
    frame = Frame(offset, float(np.sqrt(np.mean((used - offset) ** 2))))
    numbers = tuple(int(c) for c in np.flatnonzero(seen.sum(axis=0) >= MIN_POINTS_PER_CAMERA))
    if len(numbers) < 2:
        counts = ", ".join(f"{each.name} {n}" for each, n in zip(cameras, seen.sum(axis=0), strict=True))
        raise FitError(
            f"{len(numbers)} of {len(cameras)} cameras would see {MIN_POINTS_PER_CAMERA} known points or more.",
            why=f"known points seen: {counts}",
            fix="plan more known points, or cameras that see more of the workspace",
        )
    points = frame.to_working(known_xyz)
    rows = [np.flatnonzero(seen[:, c]) for c in numbers]
    models = tuple(_model(cameras[c], frame, points[mine], settings) for c, mine in zip(numbers, rows, strict=True))
    views = tuple(
        CameraViews(mine, model.pixel(points[mine]), np.ones(len(mine)))
        for model, mine in zip(models, rows, strict=True)
    )
    alone = tuple(solve_normal(each.A, each.b)[0] for each in camera_normals(models, points, views))
    if not position_sd > 0:
        return PlannedRig(frame, numbers, models, alone)
    slopes, couplings = [], []
    for model, root, mine in zip(models, alone, rows, strict=True):
        there = model.rows(points[mine])
        slope = np.zeros((len(points), 2, 3))
        slope[mine] = there.by_point * (position_sd / frame.scale / model.noise)
        coupling = np.zeros((len(points), 3, root.shape[0]))
        coupling[mine] = slope[mine].swapaxes(1, 2) @ apply_covariance_root(there, root) / model.noise
        slopes.append(slope)
        couplings.append(coupling)
    return PlannedRig(frame, numbers, models, alone, tuple(slopes), tuple(couplings))


def _model(planned: PlannedCamera, frame: Frame, points: Floats, settings: ForwardGPSettings) -> CameraModel:
    """The camera in the working frame, with its priors and an empty field; points (n, 3): those it sees, there."""
    pose = planned.camera_from_world
    there = pose.apply(frame.to_world(points))
    lens = KannalaBrandt.nearest(planned.lens, there)
    moved = Pose(pose.rotation, (pose.translation + pose.rotation @ frame.offset) / frame.scale)
    camera = GeneralCamera.from_central(CentralCamera(lens, moved))
    image = Image(np.array([planned.width - 1, planned.height - 1]) / 2, max(planned.width, planned.height) / 2)
    view = camera.view(points)
    depth = DepthScale.of(view, settings.typical_log_distance_sd)
    lengthscale = np.array([planned.field_range, settings.lengthscale_prior_median[1]])
    field = empty_field(lengthscale, field_coordinates(view, image, depth), FIELD_VARIANCE_TOLERANCE[camera.kind])
    return CameraModel(
        camera,
        camera,
        family_prior(camera, "ordinary", image, widest_angle(camera, points), settings),
        image,
        field,
        planned.field_sd,
        planned.noise,
        np.zeros((len(field.inducing), 2)),
        depth,
    )
