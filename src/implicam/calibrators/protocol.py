"""What every method offers, so that everything above works with each of them.

A *calibrator* is a method with its options, a frozen value; `fit` returns a *calibration*, the fitted map of the rig.
`Calibrator` and `Calibration` are what all of them offer, `CalibratorBase` and `CalibrationBase` what most do alike.
The other protocols are what some can do besides; a command that needs one refuses the others by name. To add a method,
follow "A calibrator" in CONTRIBUTING.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import Field, asdict, dataclass, field, fields, replace
from functools import cached_property
from inspect import getattr_static
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from implicam import calibration_file
from implicam.calibrators.cameras import FittedCamera, fitted_cameras
from implicam.calibrators.position_processes import PositionProcesses
from implicam.dataset import Dataset, Floats, Observations
from implicam.dataset.requirements import observations_of
from implicam.dataset.unused import Rejected, Unused
from implicam.dataset.wand import Wand
from implicam.errors import FitError, UsageError
from implicam.formatting import decimal_number
from implicam.measurement import Measurement
from implicam.mistakes import Finding
from implicam.plotted import Plotted
from implicam.progress import Progress, silent
from implicam.rig_model import (
    NUMBERS,
    FittedRig,
    Locator,
    MeasuredPixels,
    Motion,
    Posterior,
    Repair,
    Sensitivity,
    all_repaired,
    white_unknowns,
)
from implicam.rig_model.placement import Placement
from implicam.settings import Settings
from implicam.tabulated import Live, RigTable, why_not_tabulated

Arrays = Mapping[str, NDArray[Any]]

POINTS_WORTH_TABLES = 5000
"""Points whose exact measuring takes as long as making the tables of a rig."""


@dataclass(frozen=True, kw_only=True)
class FitSummary:
    """How well a calibration fits its own data, in a few readable numbers; lengths are in the dataset's unit.

    Attributes:
        points_used: known points that the fit uses.
        points_unused: known points that it could not use.
        views_rejected: views that it does not use because they contradict the others; None for a method that
            rejects none.
        held_out: what the errors below are of, in words; empty where each known point is left out in turn.
        leave_one_out_rms: axis -> rms error of a known point that is predicted from the others.
        leave_one_out_mean_sd: axis -> mean standard deviation that was stated for those errors.
        noise_px: camera -> noise of a view, in pixels.
        lens: camera -> name of its lens model.
        held_out_points: number of known points kept back, for a method that is too slow to be fitted without each;
            the errors above are of these.
        held_out_in_95: share of their coordinates inside the stated 95 % intervals.
    """

    points_used: int
    points_unused: int
    views_rejected: int | None = None
    held_out: str = ""
    leave_one_out_rms: Mapping[str, float]
    leave_one_out_mean_sd: Mapping[str, float]
    noise_px: Mapping[str, float] = field(default_factory=dict)
    lens: Mapping[str, str] = field(default_factory=dict)
    held_out_points: int | None = None
    held_out_in_95: float | None = None

    @property
    def how(self) -> str:
        """What the errors are of, in words."""
        if self.held_out_points is not None:
            return f"the {self.held_out_points} of them that it was not trained on are predicted"
        return self.held_out or "each left out in turn is predicted from the rest"

    def as_table(self) -> dict[str, Any]:
        """Plain values for a calibration file or JSON; what the method does not say is left out."""
        return {key: value for key, value in asdict(self).items() if value not in (None, "", {})}


def per_axis(values: ArrayLike) -> dict[str, float]:
    """Numbers (3,) by the names of their axes.

    Args:
        values: (3,).

    Returns:
        "x", "y", "z" -> number.
    """
    return dict(zip("xyz", np.asarray(values, dtype=np.float64).tolist(), strict=True))


class CheckPlan(NamedTuple):
    """How `judge` fits a method again without a part of the known points: what is affordable.

    Attributes:
        folds: parts of the known points, each of which can be held out.
        fits: how many of them are.
        max_points: a fit gets no more.
    """

    folds: int
    fits: int
    max_points: int


class _AskedByName(type(Protocol)):  # type: ignore[misc]
    """Whether an object offers a protocol is seen from the names of what it has. Python does so from 3.12 on; before,
    it reads every property to know, and such as `notes` are work."""

    def __instancecheck__(cls, instance: Any) -> bool:
        if cls in type(instance).__mro__ or not getattr(cls, "_is_protocol", False):
            return bool(super().__instancecheck__(instance))
        bases = [base for base in cls.__mro__ if getattr(base, "_is_protocol", False)]
        names = {name for base in bases for name in (*vars(base), *vars(base).get("__annotations__", {}))}
        return all(getattr_static(instance, name, None) is not None for name in names if name[0] != "_")


class Calibration(Protocol, metaclass=_AskedByName):
    """A fitted map of a rig, and the data it was fitted from.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> calibration = ic.ForwardGP().fit(rig)
    >>> calibration.method, len(calibration.rejected), calibration.notes
    ('forward-gp', 0, [])
    """

    method: ClassVar[str]

    @property
    def data(self) -> Dataset:
        """The data it was fitted from."""

    @property
    def unused(self) -> tuple[Unused, ...]:
        """The known points that the fit could not use."""

    @property
    def rejected(self) -> tuple[Rejected, ...]:
        """The views that the fit does not use because they contradict the others, the farthest first."""

    def measure(self, observations: Observations | Dataset) -> Measurement:
        """Measure each point; one that cannot be measured keeps its row, with a reason.

        Args:
            observations: What the cameras saw, by their names; or a dataset that has it.

        Returns:
            Positions in the world, with covariances where they are stated.
        """

    def state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """What a calibration file must carry beside the data: a readable table, and arrays."""

    @classmethod
    def from_state(cls, data: Dataset, table: Mapping[str, Any], arrays: Arrays) -> Self:
        """The inverse of `state`.

        Args:
            data: That it was fitted from.
            table: Of `state`.
            arrays: Of `state`.

        Returns:
            The calibration.

        Raises:
            KeyError, ValueError, TypeError: Something does not fit.
        """

    def refit(self, data: Dataset, progress: Progress = silent) -> Self:
        """The same method with the same options on other data: cross-validation, or one point more.

        Args:
            data: Known points of the same cameras.
            progress: Is told how far the fit is.

        Returns:
            The new calibration.

        Raises:
            FitError: It cannot be done, and why.
        """

    def save(self, path: str | Path) -> None:
        """Write a `.implicam` file.

        Args:
            path: Of the file.
        """

    @property
    def notes(self) -> list[str]:
        """What the user should know before trusting this calibration; empty where all is well."""

    def summary(self) -> FitSummary:
        """How well the calibration fits its own data."""

    @property
    def check_plan(self) -> CheckPlan | None:
        """How `judge` fits it again; None for the usual way, of a method that is fast."""


@runtime_checkable
class FindsFaults(Calibration, Protocol):
    """A calibration that can hold out more than known points, and then knows what speaks against it."""

    def find_faults(self, progress: Progress = silent) -> list[Finding]:
        """What speaks against this calibration beside what its known points say.

        Args:
            progress: Is told how far it is.
        """


class LengthsHeldOut(NamedTuple):
    """Lengths as measured by a fit that did not know them.

    Attributes:
        what: They are, in words: "both ends of the wand in 66 frames held out".
        errors: (k,) measured less true, in the length unit.
        sds: (k,) stated for these.
    """

    what: str
    errors: Floats
    sds: Floats


@runtime_checkable
class HoldsLengthsOut(Calibration, Protocol):
    """A calibration that can be judged by lengths, where no position is known."""

    def hold_lengths_out(self, progress: Progress = silent) -> LengthsHeldOut | None:
        """Fit again without a part of the frames, and measure the lengths there.

        Args:
            progress: Is told how far it is.

        Returns:
            What came out; None where it was made from known points.

        Raises:
            FitError: Without these there is no calibration.
        """


@runtime_checkable
class FromWand(HoldsLengthsOut, FindsFaults, Protocol):
    """A calibration that may be from a wand."""

    @property
    def wand(self) -> Wand | None:
        """The wand as it was used; None for a calibration from known points."""


@runtime_checkable
class PredictsPixels(Calibration, Protocol):
    """A calibration that knows each camera: where it sees a position, and how uncertain that is.

    `suggest`, `acquire` with a robot, `export`, the 3D view and the correction of a ball's outline need it.
    """

    @property
    def camera_names(self) -> tuple[str, ...]:
        """The cameras that are calibrated."""

    @property
    def trained(self) -> Observations:
        """What all cameras saw when they were calibrated."""

    @property
    def follows_lenses_only(self) -> bool:
        """Whether every camera is restrained to what lenses do, so that it cannot follow wrong known points."""

    def predict(self, xyz: Floats) -> Floats:
        """Where the cameras see positions.

        Args:
            xyz: (n, 3) in the world.

        Returns:
            (n, cameras, 2) pixels without noise, of all cameras of the dataset; NaN where a camera does not see one.
        """

    def sensitivities(self, xyz: Floats) -> list[Sensitivity]:
        """How pixels depend on the position and on what is unknown of the cameras.

        Args:
            xyz: (n, 3) in the world.

        Returns:
            One for each calibrated camera, or a single one of all where they are not independent.
        """

    def lines_of_sight(self, camera: str, uv: Floats) -> tuple[Floats, Floats]:
        """The lines that a calibrated camera sees as points.

        Args:
            camera: its name.
            uv: (n, 2) pixels.

        Returns:
            centre (3,) of the camera and directions (n, 3) in the world; NaN for a pixel without a line. A camera
            that sees a scene and its mirror image alike may give either sign.
        """


@runtime_checkable
class HasPositionProcesses(Calibration, Protocol):
    """A calibration that is Gaussian processes from pixels to a position, so that it says what one more would add."""

    def position_processes(self, uv: Floats) -> PositionProcesses:
        """What the processes say of places together.

        Args:
            uv: (n, cameras, 2) pixels of the places.

        Returns:
            The processes at these places.
        """


@runtime_checkable
class Updatable(Calibration, Protocol):
    """A calibration that can be fitted again from where it is, when there are a few known points more."""

    def refit_from(self, data: Dataset, progress: Progress = silent, *, anew: bool = False) -> Calibration:
        """As `refit`, starting from what is known; with `anew` from no guess as well.

        Args:
            data: All known points from now on.
            progress: Is told how far the fit is.
            anew: Start from no guess as well.

        Returns:
            The new calibration.

        Raises:
            FitError: It cannot be done, and why.
        """


@runtime_checkable
class TakesPoints(Calibration, Protocol):
    """A calibration that takes known points at once, with all that was learned of the optics kept."""

    def condition_on(self, data: Dataset) -> Calibration:
        """The same hyperparameters, with these known points.

        Args:
            data: All known points from now on, of the same cameras.

        Returns:
            The new calibration.
        """


@runtime_checkable
class PlacesItsWorld(Calibration, Protocol):
    """A calibration that can be made without known positions; then something else may say where the world is."""

    @property
    def free_world(self) -> bool:
        """Whether its data do not say where the world is."""

    @property
    def world(self) -> tuple[str, ...]:
        """What has said since where the world is, in sentences; empty where nothing has."""

    def centres(self) -> dict[str, Floats]:
        """Where the calibrated cameras are: name -> (3,) in the world."""

    def in_world(self, placement: Placement, told: tuple[str, ...]) -> PlacesItsWorld:
        """The same calibration, which measures in another world.

        Args:
            placement: Where it is.
            told: What says so, in sentences.
        """

    def in_world_of_camera(self, name: str) -> PlacesItsWorld:
        """The same calibration, in the world of one of its cameras: its centre, x right, y down, z forward.

        Args:
            name: Of the camera.

        Raises:
            UsageError: It is not calibrated.
        """


@runtime_checkable
class TellsContradictions(Calibration, Protocol):
    """A calibration that knows of cameras that fit alone and not together: their pictures are not of the same instants,
    or something moved."""

    @property
    def contradictions(self) -> list[str]:
        """Which cameras, and by how much, in words; empty where all agree."""


def option(help: str, metavar: str = "NAME", *, is_dataset: bool = False) -> dict[str, Any]:  # noqa: A002
    """The metadata of a calibrator's field that is an option of the command line.

    Args:
        help: what it may be, for `--help`.
        metavar: what stands for its value there.
        is_dataset: the command line takes a path, and the value is the dataset that is read from it.
    """
    return {"help": help, "metavar": metavar, "is_dataset": is_dataset}


class Calibrator(Protocol):
    """A method and its options, not fitted yet: a frozen dataclass, whose fields are the options."""

    method: ClassVar[str]
    compared_variants: ClassVar[tuple[str, ...]]
    """Those that `compare` shows beside the method itself unless it is told which."""

    @classmethod
    def variants(cls) -> Mapping[str, Mapping[str, Any]]:
        """Name after the colon, as in `inverse-gp:plain` -> the options that it stands for."""

    @property
    def library(self) -> tuple[str, str] | None:
        """The optional library that a fit needs, and the extra that brings it."""

    def fit(self, data: Dataset, progress: Progress = silent) -> Calibration:
        """Fit to known points.

        Args:
            data: Known points and what the cameras saw of them.
            progress: Is told how far the fit is.

        Returns:
            The calibration.

        Raises:
            FitError: It cannot be done, and why.
        """


class CalibratorBase:
    """What most calibrators do alike; to be inherited, or written anew.

    A method with priors and thresholds has them in a field `settings: MySettings = MySettings()`, a
    `implicam.settings.Settings`: then a calibration file carries them, `implicam calibrate --settings` sets them and
    `implicam info --settings` shows them.
    """

    compared_variants: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        usual = settings_type(type(self))
        given = getattr(self, SETTINGS, None)
        if usual is not None and not isinstance(given, usual):
            raise UsageError(
                f"the settings of {self.method} are of the type {usual.__name__}, and not {type(given).__name__}.",  # type: ignore[attr-defined]
                fix=f"{type(self).__name__}(settings={usual.__name__}({fields(usual)[0].name}=...))",
            )

    @classmethod
    def variants(cls) -> Mapping[str, Mapping[str, Any]]:
        """None."""
        return {}

    @property
    def library(self) -> tuple[str, str] | None:
        """None: what is always installed is enough."""
        return None

    @property
    def idle_settings(self) -> frozenset[str]:
        """Names of the settings that do nothing with these options: none."""
        return frozenset()

    def idle_settings_note(self) -> list[str]:
        """A note on the settings that somebody set and that do nothing with this preset; empty where there is none."""
        set_in_vain = sorted(getattr(self, SETTINGS).changed().keys() & self.idle_settings)
        if not set_in_vain:
            return []
        return [f"The preset {self.preset} has no use for the settings {', '.join(set_in_vain)}."]  # type: ignore[attr-defined]

    def as_table(self) -> dict[str, Any]:
        """The options and all settings, as a calibration file keeps them; without options that are datasets."""
        given = ((field, getattr(self, field.name)) for field in fields(self) if not _is_dataset(field))  # type: ignore[arg-type]
        return {field.name: v.as_table() if isinstance(v, Settings) else v for field, v in given}

    @classmethod
    def from_table(cls, table: Mapping[str, Any], **datasets: Dataset | None) -> Self:
        """The inverse of `as_table`, with the options that are datasets.

        A file from before a method had settings, or one of them, has the defaults: what it was made with.

        Args:
            table: Of `as_table`.
            **datasets: The options that are datasets, by name.

        Returns:
            The calibrator.

        Raises:
            KeyError, ValueError, TypeError, UsageError: An option is missing, or makes no sense.
        """
        options: dict[str, Any] = {}
        for one in fields(cls):  # type: ignore[arg-type]
            if isinstance(one.default, Settings):
                options[one.name] = type(one.default).from_table(table.get(one.name, {}))
            elif not _is_dataset(one):
                options[one.name] = _as(one.default, table[one.name])
        return cls(**options, **datasets)


SETTINGS = "settings"
"""The field of a calibrator that holds its settings."""


def settings_type(calibrator: type[Any]) -> type[Settings] | None:
    """What the settings of a method are; None for a method that has none.

    Args:
        calibrator: The class of the method.

    Returns:
        The type of its field `settings`, or None.
    """
    usual = {field.name: field.default for field in fields(calibrator)}.get(SETTINGS)
    return type(usual) if isinstance(usual, Settings) else None


def _as(usual: Any, value: Any) -> Any:
    return type(usual)(value) if isinstance(usual, str | int | float) else value


def _is_dataset(field: Field[Any]) -> bool:
    return bool(field.metadata.get("is_dataset", False))


class CalibrationBase(Plotted):
    """What most calibrations do alike; to be inherited, or written anew."""

    calibrator: Calibrator
    data: Dataset

    @property
    def length_unit(self) -> str:
        """Of the positions that it measures."""
        return self.data.length_unit

    def __repr__(self) -> str:
        """Two lines; `summary()` and `implicam info` of its file say more."""
        cameras = int(self.data.observations.seen.any(axis=0).sum())
        summary = self.summary()  # type: ignore[attr-defined]
        off = ", ".join(f"{axis} {decimal_number(rms)}" for axis, rms in summary.leave_one_out_rms.items())
        return (
            f"{self.calibrator.method} calibration of {cameras} cameras from {len(self.data)} known points of "
            f"{self.data.name!r}\n  {summary.how} within {off} {self.data.length_unit} rms"
        )

    @property
    def rejected(self) -> tuple[Rejected, ...]:
        """None: the method uses every view of the points it uses."""
        return ()

    @property
    def check_plan(self) -> CheckPlan | None:
        """The usual one."""
        return None

    def refit(self, data: Dataset, progress: Progress = silent) -> Any:
        """The same method with the same options on other data.

        Args:
            data: Known points of the same cameras.
            progress: Is told how far the fit is.

        Returns:
            The new calibration.

        Raises:
            FitError: It cannot be done, and why.
        """
        return self.calibrator.fit(data, progress)

    @property
    def notes(self) -> list[str]:
        """What the user should know before trusting this calibration; empty where all is well."""
        return []

    def in_unit(self, unit: str) -> Any:
        """The calibration that measures in another length unit: fitted again to the known points in that unit.

        Args:
            unit: For example "m".

        Raises:
            DatasetError: The unit has no known length.
            UsageError: It was not fitted to known points alone.
        """
        return self._refitted(self.data.in_unit(unit))

    def transformed(self, pose: Any) -> Any:
        """The calibration that measures in another frame of the world: fitted again to the known points in that frame.

        Args:
            pose: What takes a position to the other frame: SciPy's Rotation, or a rigid 4 x 4 matrix (a translation in
                the length unit).

        Raises:
            UsageError: It is no rotation and no rigid matrix, or it was not fitted to known points alone.
        """
        return self._refitted(self.data.transformed(pose))

    def _refitted(self, data: Dataset) -> Any:
        others = [f.name for f in fields(self.calibrator) if _is_dataset(f) and getattr(self.calibrator, f.name)]  # type: ignore[arg-type]
        if data.known is None or others:
            raise UsageError(
                f"this calibration by {self.calibrator.method} cannot be moved.",
                why="it was fitted from boards or imported, not from known points alone",
                fix="move what it measures: measurement.in_unit(...), measurement.transformed(...)",
            )
        return self.refit(data)

    @property
    def residuals(self) -> dict[str, Any]:
        """The summary as plain values, as it stands in the calibration file."""
        return self.summary().as_table()  # type: ignore[attr-defined,no-any-return]

    def save(self, path: str | Path) -> None:
        """Write a `.implicam` file that carries everything, the known points included.

        Args:
            path: Of the file.
        """
        calibration_file.save(self, path)  # type: ignore[arg-type]


class RigCalibration(CalibrationBase):
    """A calibration whose cameras are a `FittedRig`: it measures and predicts as that does.

    Attributes:
        repairs: Movements of cameras since it was fitted, in the order of time.
    """

    repairs: tuple[Repair, ...]

    @property
    def fitted_map(self) -> FittedRig:
        """The cameras as they were fitted, and how they measure."""
        raise NotImplementedError

    @cached_property
    def map(self) -> FittedRig:
        """The cameras as they stand now, and how they measure."""
        fitted = self.fitted_map
        return fitted.after(self.repairs) if self.repairs else fitted

    def with_repair(self, repair: Repair) -> Self:
        """The calibration after one of its cameras has moved.

        Args:
            repair: The movement, as `find_repair` has it from a check of this calibration.

        Raises:
            UsageError: It does not measure by the covariance of its cameras.
        """
        return replace(self, repairs=(*self.repairs, repair))  # type: ignore[type-var]

    def _repair_notes(self) -> list[str]:
        return [
            f"After the calibration {one.told}. It measures from there; what is said of its own known points is of "
            "the rig as it was."
            for one in self.repairs
        ]

    def _refitted(self, data: Dataset) -> Any:
        if self.repairs:
            raise UsageError(
                "this calibration cannot be moved: a camera moved after its known points had been seen.",
                why="it would be fitted again to the rig as it was",
                fix="move what it measures: measurement.in_unit(...), measurement.transformed(...)",
            )
        return super()._refitted(data)

    @property
    def camera_names(self) -> tuple[str, ...]:
        """The cameras that are calibrated."""
        return self.map.camera_names

    @cached_property
    def cameras(self) -> dict[str, FittedCamera]:
        """The cameras that are calibrated, each with its lens and its pose in the world, by name."""
        return {camera.name: camera for camera in fitted_cameras(self.map, self.data.xyz)}

    @property
    def trained(self) -> Observations:
        """What all cameras saw when they were calibrated."""
        return self.map.trained

    @property
    def follows_lenses_only(self) -> bool:
        """Whether every camera is restrained to what lenses do."""
        return self.map.follows_lenses_only

    @cached_property
    def tables(self) -> RigTable | None:
        """The rig as tables, made and checked when they are first asked for; None where `why_exact` says why not."""
        return None if self.why_exact else RigTable.of(self.map, self.data.xyz)

    @property
    def why_exact(self) -> str:
        """Why every point is measured exactly, whatever their number; empty where tables can be made."""
        return why_not_tabulated(self.map, 0 if self.data.known is None else len(self.data))

    def measure(self, observations: Observations | Dataset, *, exact: bool | None = None) -> Measurement:
        """Measure each point with the views it has, two or more.

        Args:
            observations: What the cameras saw, by their names; or a dataset that has it.
            exact: Whether by the method itself, which takes a tenth of a millisecond a point and more; or by tables
                of it, which stay within 1 % of a standard deviation; None: by tables where the points are so many
                that making them pays (`POINTS_WORTH_TABLES`).

        Returns:
            Positions in the world with error bars, and of each point without one the reason.

        Raises:
            DatasetError: None of the cameras is one of the calibration, or one has images of another size.
        """
        few = exact is None and len(observations_of(observations)) < POINTS_WORTH_TABLES
        return self.map.measure(observations, self._locator(exact or few))

    def measure_pixels(self, uv: ArrayLike, noise: ArrayLike | None = None, *, exact: bool = False) -> MeasuredPixels:
        """Measure points given as an array, each with the views it has, two or more: arrays in, arrays out.

        Args:
            uv: (n, C, 2) pixels of the calibrated cameras, in the order of `camera_names`; NaN where not seen.
            noise: Standard uncertainty of the views in pixels: a number, (C,) or (n, C); None for the usual one.
            exact: Whether by the method itself, and not by tables of it; as of `measure`.

        Returns:
            Positions in the world with covariances, as arrays; reasons in words when they are asked for.

        Raises:
            UsageError: An array has another shape.
        """
        return self.map.measure_pixels(uv, noise, self._locator(exact))

    def live(self, points: int = 1) -> Live:
        """For shots that are measured as they come: what takes the least time from pixels to a position.

        Args:
            points: The most that one shot has.

        Returns:
            What measures them; the tables are made now, where there are none yet.
        """
        return Live(self.map, self.tables, points)

    def _locator(self, exact: bool) -> Locator | None:
        return None if exact or self.tables is None else self.tables.locate

    def predict(self, xyz: Floats) -> Floats:
        """Where the cameras see positions, in pixels without noise.

        Args:
            xyz: (n, 3) in the world.

        Returns:
            (n, cameras, 2), of all cameras of the dataset; NaN where a camera does not see one.
        """
        return self.map.predict(xyz)

    def sensitivities(self, xyz: Floats) -> list[Sensitivity]:
        """How pixels depend on the position and on what is unknown of the cameras.

        Args:
            xyz: (n, 3) in the world.

        Returns:
            One for each calibrated camera; a single one of all where errors of the known positions tie them together.
        """
        return self.map.sensitivities(xyz)

    def lines_of_sight(self, camera: str, uv: Floats) -> tuple[Floats, Floats]:
        """The lines that a calibrated camera sees as points.

        Args:
            camera: Its name.
            uv: (n, 2) pixels.

        Returns:
            Centre (3,) of the camera and unit directions (n, 3), in the world; NaN for a pixel without a line.

        Raises:
            ValueError: The camera is not calibrated.
        """
        return self.map.lines_of_sight(camera, uv)

    def centres(self) -> dict[str, Floats]:
        """Where the calibrated cameras are: name -> (3,) in the world."""
        return {name: self.lines_of_sight(name, np.zeros((1, 2)))[0] for name in self.camera_names}


@contextmanager
def solvable() -> Iterator[None]:
    """Turn equations of a fit without a solution into a FitError; numbers that run away on the way warn nobody."""
    try:
        with np.errstate(all="ignore"):
            yield
    except np.linalg.LinAlgError as error:
        raise FitError(
            "the known points do not fix the rig: the equations have no solution.",
            why=str(error),
            fix="add known points elsewhere in the volume, and look for wrong ones",
        ) from error


def repairs_state(repairs: Sequence[Repair]) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """What a calibration file carries of movements since the fit; nothing where there are none.

    Args:
        repairs: The movements.

    Returns:
        A readable table, and arrays.
    """
    table = {"repairs": [{"camera": one.camera, "told": one.told} for one in repairs]} if repairs else {}
    arrays: dict[str, NDArray[Any]] = {}
    for number, one in enumerate(repairs):
        arrays |= {
            f"repair/{number}/rotation": one.motion.rotation,
            f"repair/{number}/shift_zoom": np.append(one.motion.shift, one.motion.zoom),
            f"repair/{number}/shared": one.shared,
            f"repair/{number}/own": one.own,
            f"repair/{number}/distances": one.distances,
        }
    return table, arrays


def repairs_from_state(table: Mapping[str, Any], arrays: Arrays, posterior: Posterior) -> tuple[Repair, ...]:
    """The inverse of `repairs_state`.

    Args:
        table: Of a calibration file.
        arrays: Of it.
        posterior: Of the cameras as they were fitted.

    Returns:
        The movements.

    Raises:
        KeyError, ValueError, TypeError: Something is missing or does not fit.
    """
    found: list[Repair] = []
    for number, one in enumerate(table.get("repairs", [])):
        camera, told = one["camera"], one["told"]
        if not isinstance(camera, int) or not 0 <= camera < len(posterior.models) or not isinstance(told, str):
            raise ValueError("a repair names a camera that is not there, or says nothing")
        rotation = finite_column(arrays, f"repair/{number}/rotation", (3, 3))
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) or np.linalg.det(rotation) < 0:
            raise ValueError("the turn of a repair is no rotation")
        *shift, zoom = finite_column(arrays, f"repair/{number}/shift_zoom", (4,)).tolist()
        if zoom <= -1:
            raise ValueError("the zoom of a repair leaves no picture")
        distances = finite_column(arrays, f"repair/{number}/distances", (2,), positive=True)
        made = Repair(
            camera,
            Motion(rotation, np.array(shift), zoom),
            finite_column(arrays, f"repair/{number}/shared", (white_unknowns(posterior), NUMBERS)),
            finite_column(arrays, f"repair/{number}/own", (NUMBERS, NUMBERS)),
            distances,
            told,
        )
        posterior = all_repaired(posterior, [made])
        found.append(made)
    return tuple(found)


def finite_column(arrays: Arrays, name: str, shape: tuple[int, ...], *, positive: bool = False) -> NDArray[np.float64]:
    """An array of a calibration file, checked.

    Args:
        arrays: Of the file.
        name: Of the array.
        shape: That it must have.
        positive: Every number must be greater than zero.

    Returns:
        The array.

    Raises:
        KeyError: There is none.
        ValueError: It is not finite float64 of this shape, or not positive.
    """
    array = arrays[name]
    if array.dtype != np.float64 or array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite float64 of shape {shape}, and is {array.dtype} {array.shape}")
    if positive and not (array > 0).all():
        raise ValueError(f"{name} must be positive")
    return array
