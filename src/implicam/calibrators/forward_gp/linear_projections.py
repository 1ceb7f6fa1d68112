"""Which cameras are predicted better as linear projections with a large field than with a lens model."""

from __future__ import annotations

import numpy as np

from implicam.calibrators.forward_gp.settings import Training
from implicam.errors import FitError
from implicam.geometry import Floats
from implicam.rig_model.fit_result import FitResult
from implicam.rig_model.initialise import InitialCamera, check_start, start_camera
from implicam.rig_model.leave_one_out import LeftOutViews, left_out_positions, left_out_views


def start_without_lens(training: Training, c: int, before: InitialCamera) -> InitialCamera | None:
    """A camera, started with a lens before, as a linear projection.

    Args:
        training: What the fit starts from.
        c: Number of the camera.
        before: Its start with a lens.

    Returns:
        Its start; None where it saw too little for its field, or no linear projection sees the points so.
    """
    seen = training.camera_views[c]
    if len(seen.rows) < training.settings.min_views_without_lens:
        return None
    try:
        found = start_camera(training.points[seen.rows], seen.uv, training.images[c], "none", training.settings)
        check_start(found, training.points[seen.rows], seen.uv, training)
    except FitError:
        return None
    return found._replace(ordinary_px=before.ordinary_px)


class Comparison:
    """Two fits of the same cameras to the same points, by what each predicts of views and points without themselves."""

    def __init__(self, training: Training, one: FitResult, other: FitResult) -> None:
        self.settings = training.settings
        mine, n = training.of_cameras(one.cameras), len(training.points)
        fits = (one, other)
        self.views = [left_out_views(f.posterior, mine.points, mine.camera_views, f.inliers) for f in fits]
        self.errors = [left_out_positions(views, f.inliers, n)[0] for views, f in zip(self.views, fits, strict=True)]

    def predicts_better(self, number: int) -> bool:
        """Whether the left-out views of a camera are clearly more probable in the one fit than in the other.

        Args:
            number: Of the camera, in the order of the fits.

        Returns:
            Whether the first fit is the better one.
        """
        one, other = (self._log_densities(views[number]) for views in self.views)
        return _clearly_positive(one - other, self.settings.min_gain_without_lens_nats)

    def measures_better(self) -> bool:
        """Whether known points, measured without themselves, are clearly nearer to their positions in the one fit than
        in the other. A view of a steep camera says little of depth, so its density is not all that counts."""
        squares = np.sum(np.square(self.errors), axis=2)
        one, other = squares[:, np.isfinite(squares).all(axis=0)]
        if len(one) < self.settings.min_views_without_lens:
            return False
        # a wrong point says nothing of either
        limit = self.settings.max_squared_error_medians * float(np.median(other))
        return _clearly_positive(np.minimum(other, limit) - np.minimum(one, limit))

    def _log_densities(self, view: LeftOutViews) -> Floats:
        """(n,) of each view of a camera, up to a constant; a wrong one costs what a view just rejected does."""
        distance, limit = view.squared_distance, self.settings.max_squared_mahalanobis
        distance = np.minimum(np.where(np.isfinite(distance), distance, limit), limit)
        return np.asarray(0.5 * (np.linalg.slogdet(view.inverse)[1] - distance), dtype=np.float64)


def _clearly_positive(gain: Floats, least: float = 0.0) -> bool:
    """Whether a sum of gains (n,) is above twice its standard error, and above the least."""
    return bool(np.sum(gain) > max(2 * float(np.std(gain)) * np.sqrt(len(gain)), least))
