"""forward-gp, our own method: learn what each camera sees of a position, and invert it with Bayes' rule.

Per camera: a central lens model for all lenses, a Gaussian process for what no lens model contains, and noise; lens
parameters integrated out. The mathematics, with the numbered equations the code cites: docs/method.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from implicam import calibration_file
from implicam.calibrators.forward_gp import saved
from implicam.calibrators.forward_gp.fit import FittedRig, Problem, fit_rig, left_out
from implicam.calibrators.forward_gp.lens import LENSES, Image
from implicam.calibrators.forward_gp.locate import Labels, Located, locate
from implicam.calibrators.forward_gp.posterior import Posterior, ShotErrors, Sightings
from implicam.calibrators.forward_gp.shots import Shots
from implicam.calibrators.forward_gp.start import FEWEST
from implicam.calibrators.protocol import (
    Arrays,
    Rejected,
    Unused,
    finite_column,
    require_points,
    require_volume,
    same_cameras,
)
from implicam.dataset import Dataset, Floats, Names, Observations
from implicam.errors import FitError, UsageError, did_you_mean
from implicam.measurement import Measurement
from implicam.progress import Progress, silent
from implicam.threads import blas_threads

NAMED = 5
"""Things that a note names one by one; of more it gives the number."""


@dataclass(frozen=True)
class ForwardGP:
    """Our method. lens: `central`, one model for all lenses, or `none`, a linear projection and the GP for the rest.

    seed is there because every method has one; nothing in this method is left to chance.
    """

    lens: str = "central"
    seed: int = 0

    method: ClassVar[str] = "forward-gp"

    def __post_init__(self) -> None:
        if self.lens not in LENSES:
            raise UsageError(
                f"forward-gp has no lens {self.lens!r}{did_you_mean(self.lens, LENSES)}.",
                fix=f"choose one of {', '.join(LENSES)}",
            )

    def fit(self, data: Dataset, progress: Progress = silent) -> ForwardGPCalibration:
        """Fit to all known points that any camera saw."""
        frame = Frame.of(data)
        try:
            with blas_threads(1):  # many small matrices, one after the other: two threads would wait for each other
                fitted = fit_rig(_problem(self.lens, data, frame), progress)
        except np.linalg.LinAlgError as error:
            raise FitError(
                "the known points do not fix the rig: the equations have no solution.",
                why=str(error),
                fix="add known points elsewhere in the volume, and look for wrong ones (implicam info DATASET)",
            ) from error
        return ForwardGPCalibration(self, data, frame, fitted)


@dataclass(frozen=True, eq=False)
class Frame:
    """The working frame: world positions about their mean, in their overall standard deviation."""

    offset: Floats
    scale: float

    @classmethod
    def of(cls, data: Dataset) -> Frame:
        """FitError where the points do not fill a volume."""
        seen = data.observations.seen.any(axis=1)
        _ = data.positions  # a clear error where there are none
        counts = data.observations.seen.sum(axis=0)
        why = ", ".join(f"{n} sees {k}" for n, k in zip(data.observations.camera_names, counts, strict=True))
        require_points(int(seen.sum()), FEWEST, ForwardGP.method, why)
        xyz = data.xyz[seen]
        require_volume(xyz, ForwardGP.method)
        offset = xyz.mean(axis=0)
        return cls(offset, float(np.sqrt(np.mean((xyz - offset) ** 2))))

    def inward(self, xyz: Floats) -> Floats:
        """World to working frame."""
        return (xyz - self.offset) / self.scale

    def outward(self, points: Floats) -> Floats:
        """Working frame to world."""
        return points * self.scale + self.offset


def _problem(lens: str, data: Dataset, frame: Frame) -> Problem:
    observations, points = data.observations, frame.inward(data.xyz)
    stated = stated_noise(observations)
    images = tuple(_image(observations, c) for c in range(len(observations.cameras)))
    shots = _shots(data, points)
    errors = shots.errors(points) if shots is not None else _declared(data, frame)
    sightings = _sightings(observations, stated)
    return Problem(points, observations.camera_names, sightings, images, stated, errors, lens)


def _sightings(observations: Observations, stated: Floats) -> tuple[Sightings, ...]:
    """What each camera saw, all of it."""
    relative = relative_noise(observations, stated)
    seen = (np.flatnonzero(there) for there in observations.seen.T)
    return tuple(Sightings(rows, observations.uv[rows, c], relative[rows, c]) for c, rows in enumerate(seen))


def _image(observations: Observations, c: int) -> Image:
    camera = observations.cameras[c]
    if camera.width is not None and camera.height is not None:
        return Image(np.array([camera.width - 1, camera.height - 1]) / 2, max(camera.width, camera.height) / 2)
    uv = observations.uv[observations.seen[:, c], c]  # not told: what is seen must do
    if not len(uv):
        return Image(np.zeros(2), 1.0)
    low, high = uv.min(axis=0), uv.max(axis=0)
    return Image((low + high) / 2, float(max((high - low).max() / 2, 1.0)))


def stated_noise(observations: Observations) -> Floats:
    """(C,) the usual stated noise of each camera in pixels, NaN where none is stated."""
    size = _view_noise(observations)
    known = np.isfinite(size) & observations.seen
    return np.array([np.median(size[known[:, c], c]) if known[:, c].any() else np.nan for c in range(size.shape[1])])


def relative_noise(observations: Observations, stated: Floats) -> Floats:
    """(n, C) the stated noise of each view over the camera's usual one; 1 where it is not stated."""
    relative = _view_noise(observations) / stated
    return np.where(np.isfinite(relative) & (relative > 0), relative, 1.0)


def _view_noise(observations: Observations) -> Floats:
    """(n, C) of u and v together, pixels."""
    return np.asarray(np.sqrt(np.mean(observations.sd**2, axis=2)), dtype=np.float64)


def _declares(data: Dataset) -> bool:
    return bool((data.positions.sd > 0).any())


def _shots(data: Dataset, points: Floats) -> Shots | None:
    """Shots whose errors are to be estimated: many points each, and nothing declared."""
    return None if _declares(data) else Shots.of(points, data.shots)


def _declared(data: Dataset, frame: Frame) -> ShotErrors | None:
    """A shot is off as a whole by its declared sd: a robot or a slide puts all its points there together."""
    if not _declares(data):
        return None
    _, shot = np.unique(data.shots, return_inverse=True)
    sd = np.nan_to_num(data.positions.sd) / frame.scale
    count = np.bincount(shot)
    of_shot = np.stack([np.sqrt(np.bincount(shot, weights=sd[:, k] ** 2) / count) for k in range(3)], axis=1)
    basis = np.broadcast_to(np.eye(3), (len(data), 3, 3))
    return ShotErrors(shot.astype(np.int64), basis, of_shot, np.full(3, -1))


@dataclass(frozen=True, eq=False)
class ForwardGPCalibration:
    """A fitted rig."""

    calibrator: ForwardGP
    data: Dataset
    frame: Frame
    fitted: FittedRig

    method: ClassVar[str] = "forward-gp"

    @property
    def posterior(self) -> Posterior:
        """What is known of each camera, in the working frame."""
        return self.fitted.posterior

    @property
    def camera_names(self) -> tuple[str, ...]:
        """The cameras that are calibrated."""
        return tuple(self.data.observations.camera_names[c] for c in self.fitted.cameras)

    def measure(self, observations: Observations) -> Measurement:
        """Measure each point with the views it has, two or more."""
        known = [name for name in self.data.observations.camera_names if name in observations.camera_names]
        trained = self.data.observations.with_cameras(known) if known else self.data.observations
        observations = same_cameras(trained, observations)
        n, C = len(observations), len(self.camera_names)
        uv, noise = np.full((n, C, 2), np.nan), np.ones((n, C))
        for c, name in enumerate(self.camera_names):
            if name in observations.camera_names:
                k = observations.camera_names.index(name)
                uv[:, c] = observations.uv[:, k]
                noise[:, c] = self._noise(observations, c, k)
        found = locate(self.posterior, uv, noise, self._labels)
        seen = np.isfinite(uv).all(axis=2)
        used = seen.sum(axis=1) - found.left_out.sum(axis=1)
        reasons = self._reasons(observations, seen, found)
        scale = self.frame.scale
        return Measurement(
            observations.points,
            self.frame.outward(found.xyz),
            found.cov * scale**2,
            used,
            found.p,
            reasons,
            self.data.length_unit,
        )

    def predict(self, xyz: Floats) -> Floats:
        """(n, cameras, 2) where the cameras see positions (n, 3), in pixels without noise; NaN where they do not."""
        points = self.frame.inward(np.asarray(xyz, dtype=np.float64))
        uv = np.full((len(points), len(self.data.observations.cameras), 2), np.nan)
        there = np.isfinite(points).all(axis=1)
        where = points[there]
        if self._labels is not None:
            known, _ = self._labels.shots.labels(where, self._labels.sd)
            where = where + known @ self._labels.unknowns.mean
        for number, c in enumerate(self.fitted.cameras):
            uv[there, c] = self.posterior.models[number].predict(where)[0]
        return uv

    def centres(self) -> dict[str, Floats]:
        """Where the calibrated cameras are: name -> (3,) in the world."""
        nowhere = np.zeros((1, 2))
        cameras = (model.camera for model in self.posterior.models)
        return {
            name: self.frame.outward(camera.lines(nowhere)[0])
            for name, camera in zip(self.camera_names, cameras, strict=True)
        }

    def _noise(self, observations: Observations, c: int, k: int) -> Floats:
        """(n,) of camera c's views, in pixels: as they state it, corrected as the calibration's own views were."""
        usual, stated = self.posterior.models[c].noise, self._stated[self.fitted.cameras[c]]
        given = _view_noise(observations)[:, k]
        corrected = given * (usual / stated) if np.isfinite(stated) else given
        return np.where(np.isfinite(given) & (given > 0), corrected, usual)

    @cached_property
    def _stated(self) -> Floats:
        return stated_noise(self.data.observations)

    @cached_property
    def _labels(self) -> Labels | None:
        errors, unknowns = self.fitted.errors, self.posterior.unknowns
        if errors is None or unknowns is None or self.fitted.label_sd is None:
            return None
        shots = Shots.of(self._points, self.data.shots)
        return None if shots is None else Labels(shots, errors.sd[0], self.fitted.label_sd[0], unknowns)

    def _reasons(self, observations: Observations, seen: NDArray[np.bool_], found: Located) -> Names:
        every = observations.seen.sum(axis=1)
        usable = seen.sum(axis=1)
        reasons = []
        for i in range(len(seen)):
            if np.isfinite(found.xyz[i, 0]):
                away = " and ".join(self.camera_names[c] for c in np.flatnonzero(found.left_out[i]))
                reasons.append(f"measured without {away}, whose view contradicts the others" if away else "")
            elif every[i] == 0:
                reasons.append("no camera saw it")
            elif usable[i] == 0:
                reasons.append("no calibrated camera saw it")
            elif usable[i] == 1:
                only = self.camera_names[int(np.argmax(seen[i]))]
                reasons.append(f"only {only} saw it; a position takes two cameras")
            elif np.isfinite(found.p[i]):
                reasons.append("its views contradict each other: a wrong match in one of them")
            else:
                reasons.append("no position explains its views: a wrong match, or a place that a camera cannot see")
        return np.array(reasons, dtype=np.str_)

    @cached_property
    def rejected(self) -> tuple[Rejected, ...]:
        """The views not used because they contradict the others, the farthest first."""
        names, found = self.data.observations.camera_names, []
        for number, c in enumerate(self.fitted.cameras):
            kept = self.fitted.kept[number]
            if kept.all():
                continue
            seen = self._sightings[c]
            residual, _ = left_out(self.posterior, number, self._points, seen, kept)
            for row in np.flatnonzero(~kept):
                point = str(self.data.points[seen.rows[row]])
                found.append(Rejected(point, names[c], float(np.linalg.norm(residual[row]))))
        return tuple(sorted(found, key=lambda view: -np.nan_to_num(view.residual, nan=np.inf)))

    @property
    def unused(self) -> tuple[Unused, ...]:
        """The known points of which no view is used."""
        used = self._used.any(axis=1)
        seen = self.data.observations.seen
        calibrated = seen[:, list(self.fitted.cameras)].any(axis=1)
        reasons = np.where(
            calibrated,
            "all its views contradict the others",
            np.where(seen.any(axis=1), "no calibrated camera saw it", "no camera saw it"),
        )
        return tuple(Unused(str(self.data.points[i]), str(reasons[i])) for i in np.flatnonzero(~used))

    @cached_property
    def _points(self) -> Floats:
        return self.frame.inward(self.data.xyz)

    @cached_property
    def _sightings(self) -> tuple[Sightings, ...]:
        return _sightings(self.data.observations, self._stated)

    @cached_property
    def _used(self) -> NDArray[np.bool_]:
        """(n, calibrated cameras) the views used."""
        used = np.zeros((len(self.data), len(self.fitted.cameras)), dtype=np.bool_)
        for number, c in enumerate(self.fitted.cameras):
            used[self._sightings[c].rows, number] = self.fitted.kept[number]
        return used

    def refit(self, data: Dataset, progress: Progress = silent) -> ForwardGPCalibration:
        """The same method with the same options on other data."""
        return self.calibrator.fit(data, progress)

    def notes(self) -> list[str]:
        """What the user should know before trusting this calibration; empty where all is well."""
        return [*self._blind_notes(), *self._rejected_notes(), *self._label_notes(), *self._noise_notes()]

    def _blind_notes(self) -> list[str]:
        names = self.data.observations.camera_names
        return [f"{names[c]} is not calibrated, and its views are not used: {why}" for c, why in self.fitted.blind]

    def _rejected_notes(self) -> list[str]:
        if not self.rejected:
            return []
        n, total = len(self.rejected), int(sum(len(kept) for kept in self.fitted.kept))
        named = ", ".join(
            f"{view.point} in {view.camera} ({view.residual:.3g} px off)" for view in self.rejected[:NAMED]
        )
        more = f" and {n - NAMED} more" if n > NAMED else ""
        notes = [f"{n} of {total} views contradict the others and are not used: {named}{more}."]
        seen = np.stack([self.data.observations.seen[:, c] for c in self.fitted.cameras], axis=1)
        wrong = (seen.sum(axis=1) >= 2) & ((seen & ~self._used).sum(axis=1) > 0.5 * seen.sum(axis=1))
        if wrong.any():
            points = ", ".join(map(str, self.data.points[wrong][:NAMED]))
            notes.append(f"Most views of {points} are among them: look at the known position rather than the images.")
        return notes

    def _label_notes(self) -> list[str]:
        if self._labels is None:
            return []
        sd = self._labels.sd.reshape(6, -1)[:, 0] * self.frame.scale
        along = self._labels.shots.along[0]
        usual = float(np.median(self._leave_one_out[1]))
        if sd[0] < usual and sd[1] < usual:
            return []
        unit = self.data.length_unit
        return [
            f"The shots contradict each other: as a whole they are off by about {sd[0]:.2g} {unit} along "
            f"({along[0]:.2f}, {along[1]:.2f}, {along[2]:.2f}) and {sd[1]:.2g} {unit} across. Positions are measured "
            "in the world as labelled; between shots the error bars include this."
        ]

    def _noise_notes(self) -> list[str]:
        notes = []
        for number, c in enumerate(self.fitted.cameras):
            stated, found = self._stated[c], self.posterior.models[number].noise
            if np.isfinite(stated) and not 0.5 < found / stated < 2:
                name = self.camera_names[number]
                notes.append(f"{name}: the noise is {found:.2g} px, and the observations state {stated:.2g} px.")
        return notes

    @cached_property
    def _leave_one_out(self) -> tuple[Floats, Floats]:
        """Errors and sds (n, 3) of the known points, each measured without its own views, to first order."""
        n = len(self.data)
        H, g = np.zeros((n, 3, 3)), np.zeros((n, 3))
        views = np.zeros(n)
        for number, c in enumerate(self.fitted.cameras):
            seen, kept = self._sightings[c], self.fitted.kept[number]
            residual, spread = left_out(self.posterior, number, self._points, seen, kept)
            rows = seen.rows[kept]
            where = self._points[rows]
            if self.posterior.displacement is not None:
                where = where + self.posterior.displacement[rows]
            _, D = self.posterior.models[number].predict(where)
            WD = np.linalg.inv(spread[kept]) @ D
            H[rows] += D.swapaxes(1, 2) @ WD
            g[rows] += np.einsum("nij,ni->nj", WD, residual[kept])
            views[rows] += 1
        good = (views >= 2) & (np.linalg.cond(H) < 1e12)
        cov = np.linalg.inv(H[good])
        error = np.einsum("nij,nj->ni", cov, g[good])
        return error * self.frame.scale, np.sqrt(np.diagonal(cov, axis1=1, axis2=2)) * self.frame.scale

    def residuals(self) -> dict[str, Any]:
        """Leave-one-out errors per axis in the dataset's unit, and per camera the noise and the field in pixels."""
        errors, sds = self._leave_one_out
        axes, models = "xyz", self.posterior.models
        return {
            "points_used": len(self.data) - len(self.unused),
            "points_unused": len(self.unused),
            "views_rejected": len(self.rejected),
            "leave_one_out_rms": dict(zip(axes, map(float, np.sqrt(np.mean(errors**2, axis=0))), strict=True)),
            "leave_one_out_mean_sd": dict(zip(axes, map(float, np.mean(sds, axis=0)), strict=True)),
            "noise_px": dict(zip(self.camera_names, (float(model.noise) for model in models), strict=True)),
        }

    def save(self, path: str | Path) -> None:
        """Write a `.implicam` file that carries everything, the known points included."""
        calibration_file.save(self, path)

    def state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """The options; and per camera lens, field, weights and covariance, in the working frame."""
        table, arrays = saved.state(self.fitted, self.data.observations.camera_names)
        arrays["frame"] = np.append(self.frame.offset, self.frame.scale)
        return {**asdict(self.calibrator), **table}, arrays

    @classmethod
    def from_state(cls, data: Dataset, table: Mapping[str, Any], arrays: Arrays) -> ForwardGPCalibration:
        """Restore a calibration; nothing is computed again."""
        calibrator = ForwardGP(str(table["lens"]), int(table["seed"]))
        frame = finite_column(arrays, "frame", (4,))
        if frame[3] <= 0:
            raise ValueError("the scale of the frame must be positive")
        working = Frame(frame[:3], float(frame[3]))
        fitted = saved.restored(calibrator.lens, data, working.inward(data.xyz), table, arrays)
        return cls(calibrator, data, working, fitted)
