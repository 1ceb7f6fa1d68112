"""forward-gp, our own method: learn what each camera sees of a position, and invert it with Bayes' rule.

Per camera: a central lens model for all lenses, a Gaussian process for what no lens model contains, and noise; lens
parameters integrated out. The mathematics, with the numbered equations the code cites: docs/method.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.forward_gp import saved
from implicam.calibrators.forward_gp.camera_notes import kind_notes
from implicam.calibrators.forward_gp.fit import AUTO, fit_rig
from implicam.calibrators.forward_gp.position_error_fit import separate_position_errors
from implicam.calibrators.forward_gp.settings import DEFAULT_SETTINGS, ForwardGPSettings, Training
from implicam.calibrators.forward_gp.wand import WandDiagnosis, Waved, find_faults, fit_to_bars, fit_to_wand
from implicam.calibrators.forward_gp.wand.fitted import stated_again
from implicam.calibrators.forward_gp.wand.gauge import cameras_move_with_the_world
from implicam.calibrators.forward_gp.wand.held_out import hold_bars_out, hold_lengths_out
from implicam.calibrators.protocol import (
    Arrays,
    CalibratorBase,
    FitSummary,
    LengthsHeldOut,
    RigCalibration,
    finite_column,
    option,
    per_axis,
    repairs_from_state,
    repairs_state,
    solvable,
)
from implicam.dataset import Dataset, remove_copies
from implicam.dataset.frames import rigid_parts
from implicam.dataset.requirements import require_dataset
from implicam.dataset.scale_bars import in_one_line, read_bars
from implicam.dataset.unused import Rejected, Unused, describe_point_copies, explain_copied_cameras, list_copied_points
from implicam.dataset.wand import Wand, wand_of
from implicam.errors import UsageError, did_you_mean
from implicam.geometry import Floats, Pose
from implicam.lenses import LENSES
from implicam.mistakes import Finding, explain_fit_error
from implicam.progress import Progress, silent
from implicam.rig_model import CentralCamera, GeneralCamera
from implicam.rig_model.diagnostics import Diagnosis
from implicam.rig_model.fit_result import FitResult
from implicam.rig_model.level_errors import find_uncertain_planes
from implicam.rig_model.placement import Placement, WorldStep, lay_anew, placement_at_camera
from implicam.rig_model.posterior import Posterior
from implicam.rig_model.repair import Repair
from implicam.rig_model.rig import FittedRig
from implicam.rig_model.shot_errors import Shots
from implicam.rig_model.training_data import Frame
from implicam.rig_model.triangulate import Labels
from implicam.threads import blas_threads

LENS_OPTIONS = (AUTO, "central", "none")
"""What `ForwardGP(lens=...)` may be."""


@dataclass(frozen=True)
class ForwardGP(CalibratorBase):
    """Our method. lens: `auto`, the camera model that the data choose for each camera; `central`, an ordinary camera
    with one model for all lenses; or `none`, a linear projection and the GP for the rest.

    wand: the distance between two markers that were waved at places nobody knows (the columns `frame` and `marker` say
    which they are), in the dataset's unit; wand_sd: its standard uncertainty, one error for all frames; wand_jitter:
    how much it varies from frame to frame; wand_ends: the names of the two, where there are others: single points.
    scale_bars: instead of a wand, known lengths between points at places nobody knows: `a,b,812.4,0.2`, several with
    semicolons, or the name of a table a,b,distance,sd.
    known: known points that the same cameras saw: they say where the world is, and more. What [target] of the dataset
    says of a wand holds where these are not given. Cameras are ordinary ones then (`lens`
    does not count). docs/wand.md.

    seed changes nothing: no part of this method is left to chance. settings: all priors and thresholds; a calibration
    file carries them, so that a refit years later is the same fit.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> calibration = ic.ForwardGP().fit(rig)
    >>> measured = calibration.measure(rig)
    >>> measured.xyz.shape, measured.cov.shape
    ((30, 3), (30, 3, 3))
    """

    lens: str = field(default=AUTO, metadata=option("auto, central or none"))
    wand: float = field(default=0.0, metadata=option("length of a wand waved at places nobody knows", "LENGTH"))
    wand_sd: float = field(default=0.0, metadata=option("standard uncertainty of that length", "LENGTH"))
    wand_jitter: float = field(default=0.0, metadata=option("sd of the length from frame to frame", "LENGTH"))
    wand_ends: str = field(default="", metadata=option("the wand's two markers, if there are others", "A,B"))
    known: Dataset | None = field(
        default=None, metadata=option("known points, adjusted together with a wand", "DATASET", is_dataset=True)
    )
    scale_bars: str = field(
        default="",
        metadata=option("known lengths between points nobody knows, without a wand: a .csv, or", "A,B,LENGTH[,SD]"),
    )
    seed: int = 0
    settings: ForwardGPSettings = DEFAULT_SETTINGS

    method: ClassVar[str] = "forward-gp"
    compared_variants: ClassVar[tuple[str, ...]] = ("none",)

    def __post_init__(self) -> None:
        if self.lens not in LENS_OPTIONS:
            hint = "" if self.lens in LENSES else did_you_mean(self.lens, (*LENS_OPTIONS, *LENSES))
            raise UsageError(
                f"forward-gp has no lens {self.lens!r}{hint}.",
                why=f"it has one model for all lenses; {', '.join(LENSES)} are lenses of explicit",
                fix=f"choose one of {', '.join(LENS_OPTIONS)}, or write --method explicit --lens NAME",
            )
        for name in ("wand", "wand_sd", "wand_jitter"):
            length = getattr(self, name)
            if not (np.isfinite(length) and length >= 0):
                raise UsageError(f"{name} = {length}; it is a length.", fix="for example wand = 500")
        if self.wand_ends and len(self._ends) != 2:
            raise UsageError(f"wand_ends = {self.wand_ends!r}; a wand has two ends.", fix="two names, as in pt1,pt2")
        if self.scale_bars:
            if self.wand or self.known is not None:
                raise UsageError(
                    "scale bars are for points without a wand, and without known positions.",
                    fix="leave out --wand and --known, or --scale-bars",
                )
            # a calibration file says what the table said
            object.__setattr__(self, "scale_bars", in_one_line(read_bars(self.scale_bars)))
        super().__post_init__()

    @property
    def _ends(self) -> tuple[str, ...]:
        return tuple(name.strip() for name in self.wand_ends.split(",") if name.strip())

    def _wand(self, data: Dataset) -> Wand | None:
        """The wand, as the options and the data state it; None where the data are known points."""
        told = wand_of(data)
        if not self.wand and (told is None or data.known is not None):
            return None
        told = told or Wand()
        if self.wand and told.length:
            _refuse_other_unit(self.wand, told.length, data.length_unit)
        return Wand(
            self._ends or told.ends,
            self.wand or told.length,
            self.wand_sd or told.length_sd,
            self.wand_jitter or told.jitter,
        )

    @classmethod
    def variants(cls) -> dict[str, dict[str, Any]]:
        """The lenses."""
        return {lens: {"lens": lens} for lens in LENS_OPTIONS}

    def fit(self, data: Dataset, progress: Progress = silent) -> ForwardGPCalibration:
        """Fit to all known points that any camera saw; or to a wand, whose markers then have the positions that the fit
        gives them.

        Args:
            data: Known points, or the markers of a wand, and what the cameras saw of them.
            progress: Is told how far the fit is.

        Returns:
            The calibration.

        Raises:
            FitError: Fewer than two cameras can be calibrated, or the points do not fill a volume.
        """
        require_dataset(data)
        with explain_fit_error(data):
            if self.scale_bars:
                with solvable(), blas_threads(1):
                    kept, frame, fitted, waved = fit_to_bars(data, read_bars(self.scale_bars), self.settings, progress)
                return ForwardGPCalibration(self, kept, frame, fitted, waved=waved)
            wand = self._wand(data)
            if wand is not None:
                with solvable(), blas_threads(1):
                    kept, frame, fitted, waved = fit_to_wand(data, wand, self.settings, progress, self.known)
                return ForwardGPCalibration(self, kept, frame, fitted, waved=waved)
            if self.known is not None:
                raise UsageError(
                    "known points apart are for a wand, and there is none.",
                    fix="state its length (--wand 500), or give the known points as the dataset",
                )
            return self._fit(data, progress)

    def _fit(
        self, data: Dataset, progress: Progress, before: ForwardGPCalibration | None = None
    ) -> ForwardGPCalibration:
        """From no guess, or from a fit to most of the points, in its working frame."""
        used = remove_copies(data)
        with solvable(), blas_threads(1):  # many small matrices, one after the other: two threads would wait
            frame = Frame.of(used, self.method) if before is None else before.frame
            training = Training.of(self.lens, used, frame, self.settings)
            fitted = fit_rig(training, progress, None if before is None else before.fitted)
            fitted = separate_position_errors(training, fitted, used.shots)
        uncalibrated = explain_copied_cameras(data, fitted.uncalibrated)
        return ForwardGPCalibration(self, data, frame, replace(fitted, uncalibrated=uncalibrated))


_HELD_OUT = "_lengths_held_out"


def _refuse_other_unit(given: float, told: float, unit: str) -> None:
    """UsageError where the length of a wand is that of dataset.toml in another unit: no picture shows it."""
    ratio = given / told
    if any(abs(ratio * power - 1) < MAX_SAME_LENGTH_ERROR for power in (10.0, 0.1, 100.0, 0.01, 1000.0, 0.001)):
        raise UsageError(
            f"the length of the wand is given as {given:g}, and [target] of dataset.toml says {told:g} {unit}.",
            why="it looks like the same length in another unit, and nothing in the pictures shows that",
            fix=f"give --wand in {unit}, the dataset's unit, or leave it out",
        )


MAX_SAME_LENGTH_ERROR = 0.05
"""Relative difference up to which two lengths are one in two units."""


@dataclass(frozen=True, eq=False, repr=False)
class ForwardGPCalibration(RigCalibration):
    """A fitted rig.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> calibration = ic.ForwardGP().fit(rig)
    >>> calibration.camera_names, calibration.predict(rig.xyz).shape
    (('cam1', 'cam2'), (30, 2, 2))
    """

    calibrator: ForwardGP
    data: Dataset
    frame: Frame
    fitted: FitResult
    repairs: tuple[Repair, ...] = ()
    waved: Waved | None = None
    world: tuple[str, ...] = ()
    laid: WorldStep | None = None

    method: ClassVar[str] = "forward-gp"

    @cached_property
    def used(self) -> Dataset:
        """The data without what is there twice; of it are the numbers of points in the fit and its diagnosis."""
        return remove_copies(self.data)

    @cached_property
    def posterior(self) -> Posterior:
        """What is known of each camera, in the working frame."""
        if self.laid is None:
            return self.fitted.posterior
        return replace(self.fitted.posterior, joint=np.asarray(np.linalg.qr(self._root, mode="r")))

    @cached_property
    def _root(self) -> Floats:
        """(q, P) of the covariance of all cameras; of a world laid anew with the numbers of the fit first."""
        joint, models = self.fitted.posterior.joint, self.fitted.posterior.models
        assert joint is not None  # of a wand all are tied
        return joint if self.laid is None else self.laid.root(joint, cameras_move_with_the_world(models, np.zeros(3)))

    @cached_property
    def fitted_map(self) -> FittedRig:
        """The cameras as they were fitted, and how they measure."""
        tails = self.fitted.tails
        return FittedRig(
            self.used.observations,
            self.data.length_unit,
            self.frame,
            self.fitted.cameras,
            self.posterior,
            self._labels,
            degrees=None if tails is None else tails.degrees,
            settings=self.calibrator.settings,
            laid=None if self.laid is None else (self.fitted.posterior, self.laid),
        )

    @cached_property
    def _labels(self) -> Labels | None:
        errors, unknowns = self.fitted.errors, self.posterior.unknowns
        points, settings = self.frame.to_working(self.used.xyz), self.calibrator.settings
        if errors is None or unknowns is None or self.fitted.label_sd is None:
            plane_sd = self.fitted.plane_sd
            planes = None if plane_sd is None else find_uncertain_planes(points, self.used.shots, settings)
            return None if planes is None or plane_sd is None else Labels(planes.shots, np.zeros(0), None, plane_sd)
        shots = Shots.of(points, self.used.shots, settings)
        bars = self.fitted.label_sd.reshape(6, -1)[:, 0]
        return None if shots is None else Labels(shots, errors.sd[0], unknowns, bars)

    @cached_property
    def diagnosis(self) -> Diagnosis:
        """How it agrees with its own data."""
        if self.waved is not None:
            return WandDiagnosis(self.used, self.frame, self.fitted, self.waved, self.world)
        return Diagnosis(self.used, self.frame, self.fitted)

    @property
    def rejected(self) -> tuple[Rejected, ...]:
        """The views not used because they contradict the others, the farthest first."""
        return self.diagnosis.rejected

    @property
    def unused(self) -> tuple[Unused, ...]:
        """The known points of which no view is used."""
        return (*self.diagnosis.unused, *list_copied_points(self.data))

    def refit(self, data: Dataset, progress: Progress = silent) -> ForwardGPCalibration:
        """The same method with the same options on other known points.

        Args:
            data: Known points of the same cameras.
            progress: Is told how far the fit is.

        Returns:
            The new calibration.

        Raises:
            FitError: Fewer than two cameras can be calibrated.
            UsageError: The calibration is from a wand: no known point can be held out.
        """
        self._refuse_wand()
        return self.calibrator.fit(data, progress)

    def find_faults(self, progress: Progress = silent) -> list[Finding]:
        """Of a calibration from a wand: how its length comes out in frames that a fit does not know.

        Args:
            progress: Is told how far it is.
        """
        return [] if self.waved is None else list(find_faults(self, progress))

    def hold_lengths_out(self, progress: Progress = silent) -> LengthsHeldOut | None:
        """Fit again without a third of the frames of a wand, and measure its length there.

        Args:
            progress: Is told how far it is.

        Returns:
            What came out; None where it was made from known points.

        Raises:
            FitError: Without these frames there is no calibration.
        """
        if self.waved is None:
            return None
        kept: LengthsHeldOut | None = self.__dict__.get(_HELD_OUT)
        if kept is None:
            hold_out = hold_bars_out if self.waved.bars else hold_lengths_out
            kept = self.__dict__[_HELD_OUT] = hold_out(self, progress)  # a fit: once is enough
        return kept

    @property
    def wand(self) -> Wand | None:
        """The wand as it was used; None for a calibration from known points, or from scale bars."""
        return None if self.waved is None or self.waved.bars else self.waved.wand

    def _refuse_wand(self) -> None:
        if self.waved is not None:
            of = "scale bars" if self.waved.bars else "a wand"
            raise UsageError(
                f"this calibration was made from {of}, without known points, so none can be held out or added.",
                fix="calibrate the whole dataset again, or evaluate with a dataset of known points: "
                "implicam evaluate FILE DATASET",
            )

    @property
    def free_world(self) -> bool:
        """Whether its data do not say where the world is."""
        return self.waved is not None and not self.waved.known

    def in_world(self, placement: Placement, told: tuple[str, ...] = ()) -> ForwardGPCalibration:
        """The same calibration, which measures in another world. `set_world` finds where it is.

        Args:
            placement: Where it is.
            told: What says so, in sentences.

        Raises:
            UsageError: A camera has moved since the calibration.
        """
        if self.repairs:
            raise UsageError(
                "this calibration cannot be moved: a camera moved after the wand had been seen.",
                why="its places would no longer be where the cameras see them",
                fix="set the world of the calibration as it was before, then check and repair that one",
            )
        posterior, frame, laid = lay_anew(self.fitted.posterior, self.frame, self.laid, placement)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = placement.new_from_old.rotation, placement.new_from_old.translation
        fitted = replace(self.fitted, posterior=posterior)
        return replace(self, data=self.data.transformed(pose), frame=frame, fitted=fitted, world=told, laid=laid)

    def in_world_of_camera(self, name: str) -> ForwardGPCalibration:
        """The same calibration, in the world of one of its cameras: its centre, x right, y down, z forward.

        Args:
            name: Of the camera.

        Raises:
            UsageError: It is not calibrated.
        """
        if name not in self.camera_names:
            raise UsageError(
                f"camera {name!r} is not calibrated{did_you_mean(name, self.camera_names)}.",
                fix=f"the calibrated cameras are {', '.join(self.camera_names)}",
            )
        middle = self.data.xyz.mean(axis=0)
        number = self.camera_names.index(name)
        told = f"The world is that of {name}: its centre is the origin, x points right, y down, z forward."
        here, camera = self.cameras[name].camera_from_world, self.posterior.models[number].camera
        if here is None or not isinstance(camera, CentralCamera | GeneralCamera):
            raise UsageError(
                f"camera {name!r} has no place of its own.",
                why="what it sees is described by a linear projection, or it looks into a mirror",
                fix="name another camera",
            )
        own = self._root[:, self.posterior.offsets[number] :]
        return self.in_world(placement_at_camera(camera, own, self.frame, here, middle), (told,))

    def transformed(self, pose: Any) -> ForwardGPCalibration:
        """The calibration that measures in another frame of the world: fitted again to the known points in that frame;
        of one from a wand, moved as it is.

        Args:
            pose: What takes a position to the other frame: SciPy's Rotation, or a rigid 4 x 4 matrix (a translation in
                the length unit).

        Raises:
            UsageError: It is no rotation and no rigid matrix.
        """
        if not self.free_world:
            return super().transformed(pose)  # type: ignore[no-any-return]
        rotation, shift = rigid_parts(pose)
        still = Placement(Pose(rotation, shift), np.zeros(3), np.zeros((6, len(self._root))), np.zeros((6, 6)))
        return self.in_world(still, ("The world was turned and shifted as stated, exactly.",))

    def refit_from(self, data: Dataset, progress: Progress = silent, *, anew: bool = False) -> ForwardGPCalibration:
        """As `refit`, starting from what is known: for a few points more, in half of the time.

        What is found is the nearest optimum and not the best of many, so begin `anew` where the points have grown much.

        Args:
            data: All known points from now on.
            progress: Is told how far the fit is.
            anew: Start from no guess, as `refit`.

        Returns:
            The new calibration.

        Raises:
            FitError: Fewer than two cameras can be calibrated.
        """
        self._refuse_wand()
        if anew:
            return self.calibrator.fit(data, progress)
        return self.calibrator._fit(data, progress, self)

    @property
    def notes(self) -> list[str]:
        """What the user should know before trusting this calibration; empty where all is well."""
        calibrated = self.data.observations.with_cameras(self.camera_names).cameras
        return [
            *self._repair_notes(),
            *describe_point_copies(self.data),
            *(kind_notes(self.fitted, calibrated) if self.calibrator.lens == AUTO else ()),
            *self.diagnosis.notes(),
            *self._label_notes(),
            *self._plane_notes(),
            *self._single_notes(),
            *self.diagnosis.noise_notes(),
        ]

    def _plane_notes(self) -> list[str]:
        if self._labels is None or self._labels.unknowns is not None:
            return []
        sd, unit, count = self._labels.bars[0] * self.frame.scale, self.data.length_unit, len(self._labels.shots.centre)
        what = "shots" if len(np.unique(self.data.shots)) > 1 else "levels of one target"
        return [
            f"{count} {what} cannot contradict each other. Error bars away from them allow for planes that are off by "
            f"{sd:.2g} {unit}, as is usual. State sd_x, sd_y, sd_z if you know better."
        ]

    def _inseparable_notes(self) -> list[str]:
        unknowns, most = self.posterior.offsets[-1], self.calibrator.settings.max_tied_unknowns
        if self.posterior.tied or unknowns <= most:
            return []
        return [
            f"Whether single known positions are off was not looked for: the {unknowns} unknowns of so many cameras "
            "are too many for that. Such errors count as noise of the pixels, and error bars are rather too large than "
            "too small."
        ]

    def _single_notes(self) -> list[str]:
        errors = self.fitted.position_errors
        if errors is None:
            return self._inseparable_notes()
        sd = ", ".join(f"{x:.2g}" for x in np.sqrt(np.diagonal(errors.covariance)) * self.frame.scale)
        noise = [model.noise for model in self.posterior.models]
        tails = "" if np.isinf(errors.freedom) else ", a few by much more"
        return [
            f"Single known positions (the dots of this target) seem to be off by about {sd} {self.data.length_unit} in "
            f"x, y, z{tails}. Error bars are of true positions, and the pixel noise is {np.median(noise):.2g} px, not "
            f"{np.median(noise) / errors.noise:.2g}. State sd_x, sd_y, sd_z if you know better."
        ]

    def _label_notes(self) -> list[str]:
        if self._labels is None or self._labels.unknowns is None:
            return []
        sd = self._labels.sd.reshape(6, -1)[:, 0] * self.frame.scale
        along = self._labels.shots.along[0]
        usual = float(np.median(self.diagnosis.leave_one_out[1]))
        if sd[0] < usual and sd[1] < usual:
            return []
        unit = self.data.length_unit
        return [
            f"The shots contradict each other: as a whole they are off by about {sd[0]:.2g} {unit} along "
            f"({along[0]:.2f}, {along[1]:.2f}, {along[2]:.2f}) and {sd[1]:.2g} {unit} across. Positions are measured "
            "in the world as labelled; between shots the error bars include this."
        ]

    def known_position_covariance(self, xyz: Floats) -> Floats:
        """The error of a known position near places, as estimated.

        Args:
            xyz: (n, 3) in the world.

        Returns:
            (n, 3, 3) in squared length units; zero if none seems off.
        """
        out = np.zeros((len(xyz), 3, 3))
        if self.fitted.position_errors is not None:
            out += self.fitted.position_errors.covariance
        if self._labels is not None:
            out += self._labels.own(self.frame.to_working(xyz))
        return out * self.frame.scale**2

    def summary(self) -> FitSummary:
        """Leave-one-out errors of the known points, or of the wand's lengths; and the noise of each camera."""
        noise = (model.noise for model in self.posterior.models)
        if self.waved is not None:
            return FitSummary(
                points_used=len(self.used),
                points_unused=len(self.waved.unused),
                views_rejected=len(self.rejected),
                held_out="each scale bar, measured without knowing it, is right"
                if self.waved.bars
                else "the length of the wand, measured in each frame without knowing it, is right",
                leave_one_out_rms={"length": float(np.sqrt(np.mean(self.waved.errors**2)))},
                leave_one_out_mean_sd={"length": float(np.mean(self.waved.sds))},
                noise_px=dict(zip(self.camera_names, map(float, noise), strict=True)),
            )
        errors, sds = self.diagnosis.leave_one_out
        return FitSummary(
            points_used=len(self.used) - len(self.diagnosis.unused),
            points_unused=len(self.diagnosis.unused),
            views_rejected=len(self.rejected),
            leave_one_out_rms=per_axis(np.sqrt(np.mean(errors**2, axis=0))),
            leave_one_out_mean_sd=per_axis(np.mean(sds, axis=0)),
            noise_px=dict(zip(self.camera_names, map(float, noise), strict=True)),
        )

    def state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """The options with all settings; and per camera lens, field, weights and covariance, in the working frame."""
        table, arrays = saved.state(self.fitted, self.data.observations.camera_names)
        moved, moved_arrays = repairs_state(self.repairs)
        waved, waved_arrays = ({}, {}) if self.waved is None else self.waved.state()
        waved |= {"world": list(self.world)} if self.world else {}
        if self.laid is not None:
            waved_arrays |= {"world/follows": self.laid.follows, "world/own": self.laid.own}
        arrays = arrays | moved_arrays | waved_arrays | {"frame": self.frame.as_array()}
        return self.calibrator.as_table() | table | moved | waved, arrays

    @classmethod
    def from_state(cls, data: Dataset, table: Mapping[str, Any], arrays: Arrays) -> ForwardGPCalibration:
        """Restore a calibration; nothing is computed again.

        Args:
            data: That it was fitted to.
            table: Of `state`.
            arrays: Of `state`.

        Returns:
            The calibration.

        Raises:
            KeyError, ValueError, TypeError: Something is missing or does not fit.
        """
        before_wands = {
            name: getattr(ForwardGP, name) for name in ("wand", "wand_sd", "wand_jitter", "wand_ends", "scale_bars")
        }
        calibrator = ForwardGP.from_table({**before_wands, **table}, known=stated_again(data))
        working = Frame.from_array(finite_column(arrays, "frame", (4,)))
        used = remove_copies(data)
        fitted = saved.restored(used, working.to_working(used.xyz), table, arrays, calibrator.settings)
        repairs = repairs_from_state(table, arrays, fitted.posterior)
        world, laid = tuple(str(one) for one in table.get("world", ())), None
        if "world/follows" in arrays and fitted.posterior.joint is not None:
            follows = finite_column(arrays, "world/follows", (6, len(fitted.posterior.joint)))
            laid = WorldStep(follows, finite_column(arrays, "world/own", (6, 6)))
        return cls(calibrator, data, working, fitted, repairs, Waved.from_state(table, arrays), world, laid)
