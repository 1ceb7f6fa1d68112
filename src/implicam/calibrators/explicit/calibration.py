"""explicit: the classical calibration, a lens model and a pose for every camera; triangulation by maximum likelihood.

From known points: resection of every camera, then refinement. From pictures of a board, the paper's way: Zhang's method
for each camera, pairs, bundle adjustment of the whole rig, and rigid alignment to the known points. Covariances come
from the normal equations and go into every position that is measured.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from implicam.calibrators.explicit import saved
from implicam.calibrators.explicit.align import ICP, MATCHING
from implicam.calibrators.explicit.boards import Boards, boards_of, has_boards
from implicam.calibrators.explicit.camera_groups import CameraGroups, calibrate_groups
from implicam.calibrators.explicit.fitted import CONTRADICT, Fitted, by_cameras_of, fit_to_boards_alone, fit_to_points
from implicam.calibrators.explicit.from_boards import fit_to_boards
from implicam.calibrators.explicit.lenses import AUTO, dropped_notes
from implicam.calibrators.explicit.opencv_pipeline import FAMILIES, OpenCVRig, calibrate_with_opencv
from implicam.calibrators.explicit.paper_preset import (
    JOINT,
    PAPER_BUNDLE,
    PRESETS,
    fit_like_the_paper,
    measure_linearly,
)
from implicam.calibrators.explicit.settings import (
    DEFAULT_SETTINGS,
    OF_PAPER_PRESETS,
    OF_PIPELINE,
    ExplicitSettings,
)
from implicam.calibrators.protocol import (
    Arrays,
    CalibratorBase,
    FitSummary,
    RigCalibration,
    option,
    per_axis,
    repairs_from_state,
    repairs_state,
    solvable,
)
from implicam.dataset import Dataset, Observations
from implicam.dataset.requirements import observations_of, require_dataset
from implicam.dataset.unused import Rejected, Unused
from implicam.errors import UsageError, did_you_mean
from implicam.geometry import Floats
from implicam.lenses import LENSES
from implicam.measurement import Measurement
from implicam.mistakes import explain_fit_error
from implicam.progress import Progress, silent
from implicam.rig_model import FittedRig, MeasuredPixels, Repair
from implicam.threads import blas_threads


@dataclass(frozen=True)
class Explicit(CalibratorBase):
    """The classical method. lens: `auto`, the model that predicts held-out views best, or `brown-conrady`, or
    `kannala-brandt`, for all cameras.

    boards: pictures of a board, the corners found in them; without, the known points are what it is fitted to. align:
    how a calibration from boards is brought into the world: `points`, by the names of the known points, or `icp`, by
    the closest ones as in the paper. preset: `joint`, all cameras, lenses and boards adjusted together; `paper`, the
    paper's own pipeline with OpenCV, to compare with (paper_preset.py); `paper-bundle`, the same with a joint
    adjustment at its end. seed changes nothing: no part of this method is left to chance. settings: all priors and
    thresholds; a calibration file carries them, so that a refit years later is the same fit.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> ic.Explicit().fit(rig).measure(rig).xyz.shape
    (30, 3)
    """

    lens: str = field(default=AUTO, metadata=option(f"auto, {', '.join(LENSES)}"))
    align: str = field(default=MATCHING[0], metadata=option("known points match boards by name (points), or icp"))
    preset: str = field(
        default=JOINT,
        metadata=option('joint; "paper", its own pipeline with OpenCV, or "paper-bundle", adjusted at the end'),
    )
    seed: int = 0
    boards: Dataset | None = field(
        default=None, metadata=option("learn the cameras from these pictures of a board", "DATASET", is_dataset=True)
    )
    settings: ExplicitSettings = DEFAULT_SETTINGS

    method: ClassVar[str] = "explicit"

    def __post_init__(self) -> None:
        super().__post_init__()
        for what, value, known in (
            ("lens", self.lens, (AUTO, *LENSES)),
            ("align", self.align, MATCHING),
            ("preset", self.preset, PRESETS),
        ):
            if value not in known:
                raise UsageError(
                    f"explicit has no {what} {value!r}{did_you_mean(value, known)}.",
                    fix=f"choose one of {', '.join(known)}",
                )
        if self.lens != AUTO:
            LENSES.find(self.lens)

        if self.preset != JOINT and self.lens not in (AUTO, *FAMILIES):
            raise UsageError(
                f"OpenCV has no lens {self.lens!r}.",
                why=f"explicit:{self.preset} calibrates with OpenCV, as the paper",
                fix=f"choose one of {', '.join((AUTO, *FAMILIES))}",
            )

    @classmethod
    def variants(cls) -> dict[str, dict[str, Any]]:
        """The lenses; and the paper's pipeline, aligned as in the paper."""
        return {lens: {"lens": lens} for lens in (AUTO, *LENSES)} | {
            preset: {"preset": preset, "align": ICP} for preset in PRESETS if preset != JOINT
        }

    @property
    def library(self) -> tuple[str, str] | None:
        """The paper's pipeline is OpenCV."""
        return None if self.preset == JOINT else ("cv2", "images")

    @property
    def idle_settings(self) -> frozenset[str]:
        """Names of the settings that do nothing with this preset."""
        if self.preset == JOINT:
            return frozenset(OF_PIPELINE)
        return frozenset(field.name for field in fields(ExplicitSettings)) - frozenset(OF_PAPER_PRESETS)

    def fit(self, data: Dataset, progress: Progress = silent) -> ExplicitCalibration:
        """Fit to the known points; or to the boards, and then to the known points.

        A dataset of boards at places nobody knows is calibrated in the frame of its first camera; its boards then have
        the positions that the adjustment gives them.

        Args:
            data: Known points, or corners of boards, and what the cameras saw of them.
            progress: Is told how far the fit is.

        Returns:
            The calibration.

        Raises:
            FitError: Fewer than two cameras can be calibrated, or boards and known points contradict each other.
            UsageError: The options ask for boards or known points that are not there.
            MissingExtraError: The preset is one of the paper's, and OpenCV is not installed.
        """
        require_dataset(data)
        with explain_fit_error(data), solvable(), blas_threads(1):
            if self.preset != JOINT:
                return ExplicitCalibration(self, data, self._fitted_like_the_paper(data, progress))
            if self.boards is None and self.align != MATCHING[0]:
                raise UsageError(
                    f"align {self.align!r} is for boards, and there are none.",
                    fix="give them with --boards, or leave it out",
                )
            if self.boards is None and data.known is None and has_boards(data):
                data, fitted = fit_to_boards_alone(data, self.lens, self.settings, progress)
            elif self.boards is None:
                fitted = fit_to_points(data, self.lens, self.settings, progress)
            else:
                fitted = fit_to_boards(data, self._groups(data, progress), self.boards, self.align, progress)
        if self.lens == AUTO:
            names = [fitted.trained.camera_names[c] for c in fitted.cameras]
            fitted = replace(fitted, notes=(*fitted.notes, *dropped_notes(names, fitted.choices)))
        return ExplicitCalibration(self, data, fitted)

    def _fitted_like_the_paper(self, data: Dataset, progress: Progress) -> Fitted:
        if self.boards is None or data.known is None:
            raise UsageError(
                f"explicit:{self.preset} takes pictures of a board and known positions; there are none"
                f"{' of a board' if self.boards is None else ''}.",
                why="the paper learns cameras from a checkerboard, and brings them into the world by known positions",
                fix="give pictures of a board with --boards, and known positions in points.csv; or use explicit, which "
                "takes either alone",
            )
        key = (data.length_unit, data.observations.camera_names)
        if key not in self._by_opencv:
            joint = self.preset == PAPER_BUNDLE
            self._by_opencv[key] = calibrate_with_opencv(self._boards_for(data), self.lens, joint, progress)
        return fit_like_the_paper(data, self._by_opencv[key], self.boards, self.align, self.settings)

    def _groups(self, data: Dataset, progress: Progress) -> CameraGroups:
        """The cameras from the boards: adjusted once for all known points of the same cameras in the same unit."""
        key = (data.length_unit, data.observations.camera_names)
        if key not in self._adjusted:
            self._adjusted[key] = calibrate_groups(self._boards_for(data), self.lens, progress)
        return self._adjusted[key]

    def _boards_for(self, data: Dataset) -> Boards:
        """The boards in the unit of the known points, as the cameras of both saw them."""
        assert self.boards is not None
        scale = 1.0
        if self.boards.length_unit != data.length_unit:
            scale = self.boards.metres_per_unit / data.metres_per_unit
        return boards_of(replace(self.boards, observations=by_cameras_of(data, self.boards)), scale, self.settings)

    @cached_property
    def _adjusted(self) -> dict[tuple[str, tuple[str, ...]], CameraGroups]:
        return {}

    @cached_property
    def _by_opencv(self) -> dict[tuple[str, tuple[str, ...]], OpenCVRig]:
        return {}


@dataclass(frozen=True, eq=False, repr=False)
class ExplicitCalibration(RigCalibration):
    """Cameras with lens models and poses, and the covariance of all of it.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> calibration = ic.Explicit().fit(rig)
    >>> sorted(calibration.cameras)
    ['cam1', 'cam2']
    """

    calibrator: Explicit
    data: Dataset
    fitted: Fitted
    repairs: tuple[Repair, ...] = ()

    method: ClassVar[str] = "explicit"

    @cached_property
    def fitted_map(self) -> FittedRig:
        """The cameras as they were fitted, and how they measure."""
        fitted = self.fitted
        return FittedRig(
            fitted.trained,
            self.data.length_unit,
            fitted.frame,
            fitted.cameras,
            fitted.posterior,
            misfit_adds=True,
            settings=self.calibrator.settings.rig_model,
        )

    def with_repair(self, repair: Repair) -> ExplicitCalibration:
        """The calibration after one of its cameras has moved.

        Args:
            repair: The movement.

        Raises:
            UsageError: It is one of the paper's presets, which know nothing of how sure their cameras are.
        """
        if self.fitted.inflation is not None:
            raise UsageError(
                f"a calibration of the preset {self.calibrator.preset} cannot be repaired.",
                why="it keeps no covariance of its cameras, by which the movement's error would be known",
                fix="calibrate with forward-gp, or explicit without a preset",
            )
        return super().with_repair(repair)

    def measure(self, observations: Observations | Dataset, *, exact: bool | None = None) -> Measurement:
        """Measure each point with the views it has, two or more: by maximum likelihood; with the paper's presets by
        linear triangulation.

        Args:
            observations: What the cameras saw, by their names; or a dataset that has it.
            exact: As of `RigCalibration`; the paper's presets are always.

        Returns:
            Positions in the world with error bars, and of each point without one the reason.

        Raises:
            DatasetError: None of the cameras is one of the calibration, or one has images of another size.
        """
        if self.fitted.inflation is None:
            return super().measure(observations, exact=exact)
        return measure_linearly(self.fitted, self.map, observations_of(observations))

    def measure_pixels(self, uv: ArrayLike, noise: ArrayLike | None = None, *, exact: bool = False) -> MeasuredPixels:
        """As of `RigCalibration`; the paper's presets, which triangulate in a way of their own, do not offer it.

        Args:
            uv: (n, C, 2) pixels of the calibrated cameras, in the order of `camera_names`; NaN where not seen.
            noise: Standard uncertainty of the views in pixels: a number, (C,) or (n, C); None for the usual one.
            exact: As of `RigCalibration`.

        Returns:
            Positions in the world with covariances, as arrays.

        Raises:
            UsageError: An array has another shape, or the calibration is of a preset of the paper.
        """
        if self.fitted.inflation is not None:
            raise UsageError(
                f"the preset {self.calibrator.preset} measures observations, not arrays.",
                why="it triangulates as the paper did",
                fix="measure(ic.Dataset.from_arrays(uv)), or calibrate with explicit",
            )
        return super().measure_pixels(uv, noise, exact=exact)

    @property
    def unused(self) -> tuple[Unused, ...]:
        """The known points of which no view is used."""
        return self.fitted.unused

    @property
    def rejected(self) -> tuple[Rejected, ...]:
        """The views not used because they contradict the others, the farthest first."""
        return self.fitted.rejected

    def refit(self, data: Dataset, progress: Progress = silent) -> ExplicitCalibration:
        """The same method with the same options, and the same boards, on other known points.

        Args:
            data: Known points of the same cameras.
            progress: Is told how far the fit is.

        Returns:
            The new calibration.

        Raises:
            UsageError: The calibration has no known points of its own: nothing can be held out of it.
            FitError: Fewer than two cameras can be calibrated, or boards and known points contradict each other.
        """
        if self.fitted.alone:
            raise UsageError(
                "this calibration was made without known points, so none can be held out.",
                fix="evaluate it with a dataset of known points: implicam evaluate FILE DATASET",
            )
        return self.calibrator.fit(data, progress)

    @property
    def notes(self) -> list[str]:
        """What the user should know before trusting this calibration; empty where all is well."""
        return [*self._repair_notes(), *self.fitted.notes, *self.calibrator.idle_settings_note()]

    @property
    def contradictions(self) -> list[str]:
        """Which cameras contradict each other on the boards, and by how much, in words; empty where all agree."""
        return [note for note in self.fitted.notes if CONTRADICT in note]

    def summary(self) -> FitSummary:
        """Leave-one-out errors of the known points; of each camera the lens model and the noise."""
        fitted, names = self.fitted, self.camera_names
        return FitSummary(
            points_used=len(self.data) - len(self.unused),
            points_unused=len(self.unused),
            views_rejected=len(self.rejected),
            held_out="the corners of the boards are measured" if fitted.alone else "",
            leave_one_out_rms=per_axis(_columns(fitted.errors, 2)),
            leave_one_out_mean_sd=per_axis(_columns(fitted.sds, 1)),
            noise_px=dict(zip(names, (float(model.noise) for model in fitted.posterior.models), strict=True)),
            lens=dict(zip(names, (choice.lens for choice in fitted.choices), strict=True)),
        )

    def state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """The options with all settings; and per camera lens, pose and covariance, in the working frame."""
        table, arrays = saved.state(self.fitted, self.calibrator.boards)
        moved, moved_arrays = repairs_state(self.repairs)
        return self.calibrator.as_table() | table | moved, arrays | moved_arrays

    @classmethod
    def from_state(cls, data: Dataset, table: Mapping[str, Any], arrays: Arrays) -> ExplicitCalibration:
        """Restore a calibration; nothing is computed again.

        Args:
            data: That it was fitted to.
            table: Of `state`.
            arrays: Of `state`.

        Returns:
            The calibration.

        Raises:
            KeyError, ValueError, TypeError: Something is missing or does not fit.
            PartError: A lens of another package is not installed, or cannot be used.
        """
        fitted, boards = saved.restored(data, table, arrays)
        calibrator = Explicit.from_table({"preset": JOINT, **table}, boards=boards)  # files had none before
        if (calibrator.preset == JOINT) != (fitted.inflation is None):
            raise ValueError(f"a calibration of the preset {calibrator.preset} cannot measure like this one")
        return cls(calibrator, data, fitted, repairs_from_state(table, arrays, fitted.posterior))


def _columns(values: Floats, power: int) -> list[float]:
    """The power mean of each column of (m, 3); NaN where there is no row."""
    if not len(values):
        return [float("nan")] * 3
    return [float(x) for x in np.mean(np.abs(values) ** power, axis=0) ** (1 / power)]
