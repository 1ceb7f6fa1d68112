"""How a fit agrees with its own known points: views not used, leave-one-out errors, what is to be noted."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Dataset
from implicam.dataset.unused import Rejected, Unused
from implicam.geometry import Floats
from implicam.rig_model.camera_model import CameraViews
from implicam.rig_model.fit_result import FitResult
from implicam.rig_model.leave_one_out import left_out_points, left_out_positions, left_out_residuals, left_out_views
from implicam.rig_model.training_data import Frame, camera_views_of, stated_noise

MAX_NAMED_IN_NOTE = 5
"""Things that a note names one by one; of more it gives the number."""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Of a fitted rig and the data it was fitted from."""

    data: Dataset
    frame: Frame
    fitted: FitResult

    @cached_property
    def rejected(self) -> tuple[Rejected, ...]:
        """The views not used because they contradict the others, the farthest first."""
        names, found = self.data.observations.camera_names, []
        for number, c in enumerate(self.fitted.cameras):
            inliers = self.fitted.inliers[number]
            if inliers.all():
                continue
            seen = self._seen[number]
            residual, _ = left_out_residuals(self.fitted.posterior, number, self._points, seen, inliers)
            for row in np.flatnonzero(~inliers):
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
    def leave_one_out(self) -> tuple[Floats, Floats]:
        """Errors and sds (m, 3) of the known points that two cameras see, in the world's unit, each measured without
        its own views, to first order; where errors of known positions are estimated, they are part of both."""
        fitted, seen = self.fitted, self._seen
        if fitted.position_errors is not None:
            error, cov = left_out_points(fitted, self._points, seen)
        else:
            views = left_out_views(fitted.posterior, self._points, seen, fitted.inliers)
            error, cov = left_out_positions(views, fitted.inliers, len(self._points))
            measured = np.isfinite(error[:, 0])
            error, cov = error[measured], cov[measured]
        return error * self.frame.scale, np.sqrt(np.diagonal(cov, axis1=1, axis2=2)) * self.frame.scale

    def notes(self) -> list[str]:
        """Cameras that could not be calibrated, and views that contradict the others."""
        names = self.data.observations.camera_names
        uncalibrated = [
            f"{names[c]} is not calibrated, and its views are not used: {why}" for c, why in self.fitted.uncalibrated
        ]
        return [*uncalibrated, *self._rejected_notes(), *self._tail_notes()]

    def _tail_notes(self) -> list[str]:
        if self.fitted.tails is None:
            return []
        noise = float(np.median([model.noise for model in self.fitted.posterior.models]))
        return [
            f"The pixel noise has heavy tails: most views are good to {noise:.2g} px, some are off by many times that "
            f"(Student's t with {self.fitted.tails.degrees:.2g} degrees of freedom). The farther a view is off, the "
            "less it counts, in the fit and in every measurement."
        ]

    def noise_notes(self) -> list[str]:
        """Cameras whose noise is not what the observations state."""
        notes = []
        stated = stated_noise(self.data.observations)
        for number, c in enumerate(self.fitted.cameras):
            found = self.fitted.posterior.models[number].noise
            if np.isfinite(stated[c]) and not 0.5 < found / stated[c] < 2:
                name = self.data.observations.camera_names[c]
                notes.append(f"{name}: the noise is {found:.2g} px, and the observations state {stated[c]:.2g} px.")
        return notes

    def _rejected_notes(self) -> list[str]:
        if not self.rejected:
            return []
        n, total = len(self.rejected), int(sum(len(inliers) for inliers in self.fitted.inliers))
        named = ", ".join(
            f"{view.point} in {view.camera} ({view.residual:.3g} px off)" for view in self.rejected[:MAX_NAMED_IN_NOTE]
        )
        more = f" and {n - MAX_NAMED_IN_NOTE} more" if n > MAX_NAMED_IN_NOTE else ""
        notes = [f"{n} of {total} views contradict the others and are not used: {named}{more}."]
        seen = np.stack([self.data.observations.seen[:, c] for c in self.fitted.cameras], axis=1)
        wrong = (seen.sum(axis=1) >= 2) & ((seen & ~self._used).sum(axis=1) > 0.5 * seen.sum(axis=1))
        if wrong.any():
            points = ", ".join(map(str, self.data.points[wrong][:MAX_NAMED_IN_NOTE]))
            notes.append(f"Most views of {points} are among them: look at the known position rather than the images.")
        return notes

    @cached_property
    def _points(self) -> Floats:
        return self.frame.to_working(self.data.xyz)

    @cached_property
    def _seen(self) -> tuple[CameraViews, ...]:
        """What each fitted camera saw, with the noise that counts."""
        every = camera_views_of(self.data.observations, stated_noise(self.data.observations))
        seen = tuple(every[c] for c in self.fitted.cameras)
        return seen if self.fitted.tails is None else self.fitted.tails.weight_views(seen, with_loss=True)

    @cached_property
    def _used(self) -> NDArray[np.bool_]:
        """(n, calibrated cameras) the views used."""
        used = np.zeros((len(self.data), len(self.fitted.cameras)), dtype=np.bool_)
        for number, (seen, inliers) in enumerate(zip(self._seen, self.fitted.inliers, strict=True)):
            used[seen.rows, number] = inliers
        return used
