"""The values: cameras, observations, known positions, dataset. They check themselves and never change.

Axis order is (points, cameras, 2). Pixels are (u, v) = (column, row) with (0, 0) the centre of the top-left pixel;
positions are in the dataset's own world frame and length unit. Missing is NaN.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from implicam.dataset.plain import to_plain
from implicam.dataset.units import metres_per, refuse_length_unit
from implicam.errors import DatasetError, did_you_mean
from implicam.plotted import Plotted

Floats = NDArray[np.float64]
Names = NDArray[np.str_]

POINT_COLUMNS = ("point", "shot", "x", "y", "z")
VIEW_COLUMNS = ("point", "camera", "u", "v")
SD_POINT, SD_VIEW = ("sd_x", "sd_y", "sd_z"), ("sd_u", "sd_v")

WIDE_TABLE = "wide_table"  # what the description of a wide table says of its columns
_CAMERA_KEYS, _DATASET_KEYS = ("name", "width", "height"), ("name", "length_unit", "cameras", WIDE_TABLE)

# A text column is as wide as its longest text in every row, so one long cell would cost gigabytes.
MAX_NAME_CHARACTERS, MAX_CELL_CHARACTERS = 200, 1000
MAX_IMAGE_SIZE_PX = 1_000_000

OUTSIDE_MARGIN_SHARE, OUTSIDE_MARGIN_PX = 0.02, 2.0
"""How far outside its image a centre may lie, for half of the ball is still in it: share of the longer side, and px."""

MIN_VIEWS_OUTSIDE = 3
"""Views outside the image of one camera that have a common cause."""

TRUTH_COLUMNS = (
    "true_x", "true_y", "true_z", "limit_sd_x", "limit_sd_y", "limit_sd_z",
    "limit_cov_xy", "limit_cov_xz", "limit_cov_yz",
)  # fmt: skip
"""Extra columns of points.csv that `implicam simulate` writes: where the point really was, and its Cramer-Rao limit."""

TRUE_VIEW_COLUMNS = ("true_u", "true_v", "outlier")
"""Extra columns of observations.csv that `implicam simulate` writes."""


@dataclass(frozen=True)
class Camera:
    """A camera's name and image size in pixels; None where the size is not known.

    >>> import implicam as ic
    >>> ic.Camera("cam1", 1280, 800).width
    1280
    """

    name: str
    width: int | None = None
    height: int | None = None
    extra: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_name(self.name, "camera name")
        if set("/\\") & set(self.name) or self.name.startswith("."):
            raise DatasetError(
                f"camera name {self.name!r} cannot name a folder.",
                fix="leave out slashes, backslashes and a leading dot",
            )
        for what, size in (("width", self.width), ("height", self.height)):
            if size is None:
                _refuse_misspelt(what, self.extra, f"camera {self.name!r}")
            elif isinstance(size, bool) or not isinstance(size, int) or not 1 <= size <= MAX_IMAGE_SIZE_PX:
                raise DatasetError(
                    f"camera {self.name!r} has {what} = {size!r}; it must be a whole number of pixels.",
                    fix=f"give the {what} of its images, for example {what} = 1280",
                )
        _freeze(self, extra=_check_entries(self.extra, _CAMERA_KEYS, f"camera {self.name!r}"))

    def as_table(self) -> dict[str, Any]:
        """Name and image size, as far as it is known, as plain values."""
        sizes = {"width": self.width, "height": self.height}
        return {"name": self.name, **{key: size for key, size in sizes.items() if size is not None}}


@dataclass(frozen=True, eq=False)
class Observations:
    """Which point was seen by which camera, at which pixel.

    Attributes:
        points: (n,) names, each once.
        cameras: The cameras, in the order of the second axis.
        uv: (n, cameras, 2) pixels, NaN where the camera did not see the point.
        sd: (n, cameras, 2) standard uncertainties in pixels, NaN where not stated or not seen.
        extra: Other columns of observations.csv as text, (n, cameras) each.

    Raises:
        DatasetError: If a name, a pixel or an uncertainty is not possible.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> rig.observations.uv.shape, rig.observations.seen.all().item()
    ((30, 2, 2), True)
    """

    points: Names
    cameras: tuple[Camera, ...]
    uv: Floats
    sd: Floats
    extra: Mapping[str, Names] = field(default_factory=dict)

    def __post_init__(self) -> None:
        points = _text(self.points)
        n, c = len(points), len(self.cameras)
        check_unique(points.tolist(), "point")
        check_unique([camera.name for camera in self.cameras], "camera")
        if not self.cameras:
            raise DatasetError("there is no camera.", fix="keep at least one")
        uv = _array(self.uv, (n, c, 2), "uv")

        sd = _array(self.sd, (n, c, 2), "sd")
        check_views(uv, sd, self.cameras, lambda i, k: f"point {str(points[i])!r}")
        sd[np.isnan(uv)] = np.nan
        extra = _check_columns(self.extra, (n, c), (*VIEW_COLUMNS, *SD_VIEW))
        _freeze(self, points=points, cameras=tuple(self.cameras), uv=uv, sd=sd, extra=extra)

    def __len__(self) -> int:
        return len(self.points)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(n, cameras) where a camera saw the point."""
        return ~np.isnan(self.uv[..., 0])

    @property
    def camera_names(self) -> tuple[str, ...]:
        """The cameras' names, in the order of the second axis."""
        return tuple(camera.name for camera in self.cameras)

    def select(self, index: ArrayLike) -> Observations:
        """The observations of some points.

        Args:
            index: (n,) a boolean mask; or numbers of points, in the order wanted.
        """
        i = _index(index)
        extra = {key: value[i] for key, value in self.extra.items()}
        return Observations(self.points[i], self.cameras, self.uv[i], self.sd[i], extra)

    def with_cameras(self, names: Sequence[str]) -> Observations:
        """The observations of some cameras; every point stays, seen or not.

        Args:
            names: In the order wanted.

        Raises:
            DatasetError: There is no such camera.
        """
        known = self.camera_names
        for name in names:
            if name not in known:
                raise DatasetError(
                    f"there is no camera {name!r}{did_you_mean(name, known)}.",
                    fix=f"the cameras are {', '.join(known)}",
                )
        if tuple(names) == known:
            return self
        i = [known.index(name) for name in names]
        extra = {key: value[:, i] for key, value in self.extra.items()}
        cameras = tuple(self.cameras[j] for j in i)
        if not i or len(set(i)) < len(i):  # says what is wrong
            return Observations(self.points, cameras, self.uv[:, i], self.sd[:, i], extra)
        fewer = copy(self)  # what was checked once is not checked again
        _freeze(fewer, cameras=cameras, uv=self.uv[:, i], sd=self.sd[:, i], extra=extra)
        return fewer


@dataclass(frozen=True, eq=False)
class KnownPositions:
    """Where the points were, and which shot each belongs to.

    Attributes:
        shots: (n,) names; the points of one exposure (a board) share one.
        xyz: (n, 3) positions in the world frame, in the dataset's length unit.
        sd: (n, 3) standard uncertainties in the same unit, NaN where not stated.
        extra: Other columns of points.csv as text, (n,) each.

    Raises:
        DatasetError: If a name, a position or an uncertainty is not possible.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> rig.known.xyz.shape, rig.known.shots.shape
    ((30, 3), (30,))
    """

    shots: Names
    xyz: Floats
    sd: Floats
    extra: Mapping[str, Names] = field(default_factory=dict)

    def __post_init__(self) -> None:
        shots = _text(self.shots)
        n = len(shots)
        for shot in np.unique(shots):
            check_name(str(shot), "shot")
        xyz = _array(self.xyz, (n, 3), "xyz")
        for i in np.flatnonzero(~np.isfinite(xyz).all(axis=1))[:1]:
            raise DatasetError(
                f"known position {i + 1} of {n} is not finite: {', '.join(f'{value:g}' for value in xyz[i])}.",
                fix="fill it in, or leave the point out",
            )
        sd = _array(self.sd, (n, 3), "sd")
        check_position_sd(sd, lambda i: f"known position {i + 1}")
        extra = _check_columns(self.extra, (n,), (*POINT_COLUMNS, *SD_POINT))
        _freeze(self, shots=shots, xyz=xyz, sd=sd, extra=extra)

    def select(self, index: ArrayLike) -> KnownPositions:
        """The positions of some points.

        Args:
            index: (n,) a boolean mask; or numbers of points, in the order wanted.
        """
        i = _index(index)
        extra = {key: value[i] for key, value in self.extra.items()}
        return KnownPositions(self.shots[i], self.xyz[i], self.sd[i], extra)


def fingerprint_rows(values: Floats) -> list[bytes]:
    """The numbers of each row as bytes, with one NaN and one zero, so that equal rows have equal bytes.

    Args:
        values: (n, k).
    """
    return [row.tobytes() for row in np.where(np.isnan(values), np.nan, values + 0.0)]


def find_first_equal(values: Floats) -> NDArray[np.int64]:
    """The first row that is the same to the last bit.

    Args:
        values: (n, k).

    Returns:
        (n,) number of the first row that is the same; its own where none is before.
    """
    first: dict[bytes, int] = {}
    return np.array([first.setdefault(mark, i) for i, mark in enumerate(fingerprint_rows(values))], dtype=np.int64)


@dataclass(frozen=True, eq=False)
class Truth:
    """What only a simulation knows: the true positions (n, 3), and the Cramer-Rao limit of each, (n, 3, 3)."""

    xyz: Floats
    limit: Floats


@dataclass(frozen=True, eq=False, repr=False)
class Dataset(Plotted):
    """Observations, the known positions of the same points, and the length unit.

    Attributes:
        name: The dataset's name.
        length_unit: The unit of all positions, for example "mm".
        observations: Which camera saw which point at which pixel.
        known: The positions, in the order of the observations; None where they are to be measured.
        extra: Other entries of dataset.toml, as plain values.
        notes: What was corrected in reading, such as marks for missing views; not written to files.
        columns: Further columns of points without known positions as text, (n,) each, such as a frame; where positions
            are known, these are columns of `known`.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> data = ic.Dataset.from_arrays(rig.observations.uv, rig.xyz, cameras=["left", "right"], unit="mm")
    >>> len(data), data.camera_names
    (30, ('left', 'right'))
    """

    name: str
    length_unit: str
    observations: Observations
    known: KnownPositions | None = None
    extra: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    columns: Mapping[str, Names] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_name(self.name, "dataset name")
        check_name(self.length_unit, "length unit")
        taken = (*VIEW_COLUMNS, *SD_VIEW, *self.observations.extra)
        columns = _check_columns(self.columns, (len(self.observations),), taken)
        _freeze(self, extra=_check_entries(self.extra, _DATASET_KEYS, f"dataset {self.name!r}"), columns=columns)
        if self.columns and self.known is not None:
            raise DatasetError(
                f"dataset {self.name!r} has columns of its own, and known positions.",
                fix="put the columns into those of the known positions",
            )
        if self.known is not None and len(self.known.shots) != len(self.observations):
            raise DatasetError(
                f"{len(self.observations)} observed points, but {len(self.known.shots)} known positions.",
                fix="give both for the same points, in the same order",
            )

    @classmethod
    def from_arrays(
        cls,
        uv: ArrayLike | Mapping[str, ArrayLike],
        xyz: ArrayLike | None = None,
        *,
        sd: ArrayLike | None = None,
        position_sd: ArrayLike | None = None,
        cameras: Sequence[str | Camera] | None = None,
        size: tuple[int, int] | Sequence[tuple[int, int]] | None = None,
        points: Sequence[object] | None = None,
        shots: Sequence[object] | None = None,
        unit: str | None = None,
        name: str = "arrays",
        length_unit: None = None,
    ) -> Dataset:
        """A dataset from arrays.

        >>> import numpy as np
        >>> uv = np.array([[[640.5, 480.2], [610.1, 475.0]], [[700.0, 480.9], [np.nan, np.nan]]])
        >>> xyz = [[0, 0, 0], [10, 0, 0]]
        >>> Dataset.from_arrays(uv, xyz, unit="mm", cameras=["left", "right"], size=(1280, 960))
        dataset 'arrays' in mm: 2 points with known positions, 2 cameras
          left   1280 x 960 px, 2 views
          right  1280 x 960 px, 1 view
          known  x 0 to 10.0, y 0 to 0, z 0 to 0

        Args:
            uv: (n, cameras, 2) pixels; NaN or masked where a camera did not see the point. Or the pixels (n, 2) of each
                camera by its name, or (n, 1, 2) as OpenCV gives them. (-1, -1) and (0, 0) are taken for views that are
                missing, and `notes` says so.
            xyz: (n, 3) known positions in the world frame, in the length unit; None where they are to be measured.
            sd: Standard uncertainty of the pixels, px: a number, (cameras,), (n, cameras) or (n, cameras, 2); None
                where it is not known.
            position_sd: Standard uncertainty of the known positions in the length unit: a number, (3,) or (n, 3).
            cameras: Their names; cam1, cam2, ... where none are given.
            size: Width and height of the images in pixels, of all or one pair for each camera.
            points: n names; p0001, p0002, ... where none are given.
            shots: n names: the points of one exposure share one. Each point is a shot of its own where none are given.
            unit: The length unit of all positions, "mm" say; wanted where there are known positions.
            name: Of the dataset.
            length_unit: Not used: it is `unit` here.

        Raises:
            UsageError: The unit is not stated, or by another name.
            DatasetError: A shape, a type or a number is not possible; says how to mend it.
        """
        from implicam.dataset.arrays import from_arrays  # it is made of what this module defines

        refuse_length_unit(length_unit)

        return from_arrays(
            uv, xyz, sd=sd, position_sd=position_sd, cameras=cameras, size=size, points=points, shots=shots,
            unit=unit, name=name,
        )  # fmt: skip

    @classmethod
    def from_dataframe(
        cls,
        table: Any,
        *,
        unit: str | None = None,
        first_pixel: int = 0,
        v_up: bool = False,
        size: Any = None,
        length_unit: None = None,
    ) -> Dataset:
        """A dataset from a table of pandas, read as `read_dataset` reads the same table in a file.

        Args:
            table: A pandas.DataFrame with a row for each point (x, y, z, u_cam1, v_cam1, ...) or for each view (point,
                camera, u, v). An index with a name is a column.
            unit: The length unit; None where the headings state it, or there are no known positions.
            first_pixel: How the centre of the first pixel is counted, 0 or 1.
            v_up: Whether v is counted from the bottom row upwards.
            size: Width and height of the images in pixels, of all or for each camera by name.
            length_unit: Not used: it is `unit` here.

        Raises:
            UsageError: It is no table of pandas, or the options contradict it.
            DatasetError: There are two ways to read it, or it has a mistake; names the row, the value and the cure.
        """
        from implicam.dataset.dataframe import dataset_from_dataframe
        from implicam.dataset.table_options import TableOptions, size_text

        refuse_length_unit(length_unit)
        return dataset_from_dataframe(table, TableOptions(unit, first_pixel, v_up, size_text(size)))

    def to_dataframe(self) -> Any:
        """A table of pandas with a row for each point, and the columns of a wide CSV (docs/formats.md).

        Raises:
            MissingExtraError: pandas is not installed.
        """
        from implicam.dataset.dataframe import dataset_to_dataframe

        return dataset_to_dataframe(self)

    def __len__(self) -> int:
        return len(self.observations)

    def __repr__(self) -> str:
        from implicam.dataset.summary import describe_dataset

        return describe_dataset(self)

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The rig's cameras."""
        return self.observations.cameras

    @property
    def camera_names(self) -> tuple[str, ...]:
        """The cameras' names, in the order of the observations."""
        return self.observations.camera_names

    @property
    def points(self) -> Names:
        """(n,) names of the points."""
        return self.observations.points

    @property
    def positions(self) -> KnownPositions:
        """The known positions, or a clear error where there are none."""
        if self.known is None:
            raise DatasetError(
                f"dataset {self.name!r} has no known positions.",
                why="there is no points.csv in its folder, no columns x, y and z in its table, or no xyz in its arrays",
                fix="calibrate from its boards alone: --method explicit; or add points.csv with point,shot,x,y,z"
                if isinstance(self.extra.get("target"), Mapping) and "rows" in self.extra["target"]
                else "add points.csv with point,shot,x,y,z, the columns x, y and z, or xyz=; or calibrate from a wand "
                "whose length you know: --wand 500; without either a dataset can only be measured and checked",
            )
        return self.known

    @property
    def xyz(self) -> Floats:
        """(n, 3) known positions."""
        return self.positions.xyz

    @property
    def shots(self) -> Names:
        """(n,) the shot of each point."""
        return self.positions.shots

    @property
    def places(self) -> NDArray[np.int64]:
        """(n,) the number of the first point at the same known position, to the last bit; its own where none is before.

        A place that was measured again tells something of the pixel noise, and nothing of the rig.
        """
        return np.arange(len(self)) if self.known is None else find_first_equal(self.known.xyz)

    @property
    def truth(self) -> Truth | None:
        """The simulated truth, where the dataset carries it."""
        columns = self.known.extra if self.known else {}
        if not set(TRUTH_COLUMNS) <= set(columns):
            return None
        try:
            table = np.stack([columns[key].astype(np.float64) for key in TRUTH_COLUMNS], axis=1)
        except ValueError as error:
            raise DatasetError(
                "a column of the simulated truth (true_x ... limit_cov_yz) holds text.",
                why=str(error),
                fix="simulate the dataset again, or delete these columns from points.csv",
            ) from error
        return Truth(table[:, :3], covariance_from_columns(table[:, 3:6], table[:, 6:9]))

    @property
    def metres_per_unit(self) -> float:
        """How long one length unit is in metres."""
        return metres_per(self.length_unit)

    def select(self, index: ArrayLike) -> Dataset:
        """The dataset of some points.

        Args:
            index: (n,) a boolean mask; or numbers of points, in the order wanted.
        """
        known = self.known.select(index) if self.known else None
        columns = {key: value[_index(index)] for key, value in self.columns.items()}
        return replace(self, observations=self.observations.select(index), known=known, columns=columns)

    def further_columns(self) -> dict[str, Names]:
        """What files say of each point besides its position, (n,) text each, as measured.csv repeats it.

        A column of views is one column where all views of each point agree, else one for each camera: NAME_CAMERA.
        The truth and the limits of a simulation are left out.
        """
        own = self.known.extra if self.known else self.columns
        found = {name: column for name, column in own.items() if name not in TRUTH_COLUMNS}
        seen = self.observations.seen
        of_views = {name: views for name, views in self.observations.extra.items() if name not in TRUE_VIEW_COLUMNS}
        for name, views in of_views.items():
            first = views[np.arange(len(self)), seen.argmax(axis=1)]
            if ((views == first[:, None]) | ~seen).all():
                found[name] = np.where(seen.any(axis=1), first, "")
            else:
                found |= {f"{name}_{camera.name}": views[:, k] for k, camera in enumerate(self.cameras)}
        return found

    def with_cameras(self, names: Sequence[str]) -> Dataset:
        """The dataset of some cameras; every point stays, seen or not.

        The Cramer-Rao limit of a simulated dataset holds for all its cameras: with fewer it becomes unknown.

        Args:
            names: In the order wanted.

        Raises:
            DatasetError: There is no such camera.
        """
        whole = set(names) == set(self.observations.camera_names)
        known = self.known if whole else self.without_limit().known
        return replace(self, observations=self.observations.with_cameras(names), known=known)

    def without_limit(self) -> Dataset:
        """The dataset with an unknown Cramer-Rao limit, where it is a simulated one: its views are not those that the
        limit was computed for."""
        if not self.known:
            return self
        forgotten = {c: np.full(len(self), "nan") for c in self.known.extra if c in TRUTH_COLUMNS[3:]}
        return replace(self, known=replace(self.known, extra={**self.known.extra, **forgotten}))

    def without(self, names: Sequence[str]) -> Dataset:
        """The dataset without some cameras; every point stays, seen or not.

        Args:
            names: Of the cameras to leave out.

        Raises:
            DatasetError: There is no such camera, or none is left.
        """
        self.observations.with_cameras(names)  # says which name is unknown
        return self.with_cameras([name for name in self.observations.camera_names if name not in names])

    def without_points(self, names: Iterable[str]) -> Dataset:
        """The dataset without some points.

        Args:
            names: Of the points to leave out.

        Raises:
            UsageError: There is no such point.
        """
        from implicam.dataset.frames import keep_others

        return self.select(keep_others(self.points, names))

    def in_unit(self, unit: str) -> Dataset:
        """The dataset in another length unit: known positions and their uncertainties.

        Args:
            unit: For example "m".

        Raises:
            DatasetError: The unit has no known length.
        """
        from implicam.dataset.frames import move_known_positions

        factor = self.metres_per_unit / metres_per(unit)
        return move_known_positions(self, np.eye(3), np.zeros(3), factor, unit)

    def transformed(self, pose: Any) -> Dataset:
        """The dataset in another frame of the world: known positions and their uncertainties; pixels stay.

        Args:
            pose: What takes a position to the other frame: SciPy's Rotation, or a rigid 4 x 4 matrix (a translation in
                the length unit).

        Raises:
            UsageError: It is no rotation and no rigid matrix.
        """
        from implicam.dataset.frames import move_known_positions, rigid_parts

        return move_known_positions(self, *rigid_parts(pose), 1.0, self.length_unit)

    def split(self, n: int, *, seed: int) -> tuple[Dataset, Dataset]:
        """Split the points at random into two datasets.

        Args:
            n: Points of the first.
            seed: The same seed gives the same split.

        Returns:
            The first, with n points, and the rest; the points of each in the order that they had.

        Raises:
            DatasetError: One of the two would be empty.
        """
        if not 0 < n < len(self):
            raise DatasetError(
                f"cannot split {len(self)} points into {n} and the rest.",
                fix=f"choose a number from 1 to {len(self) - 1}",
            )
        order = np.random.default_rng(seed).permutation(len(self))
        return self.select(np.sort(order[:n])), self.select(np.sort(order[n:]))

    def folds(self, k: int, *, seed: int) -> Iterator[tuple[str, Dataset, Dataset]]:
        """Random folds for cross-validation; points at one position are in one fold.

        Args:
            k: Number of folds, at least two.
            seed: The same seed gives the same folds.

        Yields:
            Name of the fold, the dataset of the other points, the dataset of the fold.

        Raises:
            DatasetError: There are fewer positions than folds; raised when the first fold is asked for.
        """
        places = len(np.unique(self.places))
        if not 2 <= k <= places:
            raise DatasetError(
                f"cannot make {k} folds of {len(self)} points"
                + (f" at {places} place{'s' * (places != 1)}." if places < len(self) else "."),
                fix=f"choose a number from 2 to {places}" if places > 1 else "add points elsewhere",
            )
        fold = np.random.default_rng(seed).permutation(np.arange(len(self)) % k)[self.places]
        for i in np.unique(fold).tolist():
            yield f"fold {i + 1}", self.select(fold != i), self.select(fold == i)

    def leave_out_shots(self) -> Iterator[tuple[str, Dataset, Dataset]]:
        """Each shot in turn: its name, the others, the shot."""
        shots = np.unique(self.shots)
        if len(shots) < 2:
            raise DatasetError(
                f"dataset {self.name!r} has one shot only, so no shot can be left out.",
                fix="use --cv 10, or give the points of each exposure their own shot in points.csv",
            )
        for shot in shots:
            yield str(shot), self.select(self.shots != shot), self.select(self.shots == shot)


def covariance_from_columns(sd: Floats, off_diagonal: Floats) -> Floats:
    """Covariances from the columns of a table.

    Args:
        sd: (n, 3) standard uncertainties of x, y, z in the length unit.
        off_diagonal: (n, 3) cov_xy, cov_xz, cov_yz in the length unit squared.

    Returns:
        (n, 3, 3) covariances, world frame.
    """
    cov = np.zeros((len(sd), 3, 3))
    cov[:, [0, 1, 2], [0, 1, 2]] = sd**2
    cov[:, [0, 0, 1], [1, 2, 2]] = cov[:, [1, 2, 2], [0, 0, 1]] = off_diagonal
    return cov


def _array(value: ArrayLike, shape: tuple[int, ...], name: str) -> Floats:
    array = np.array(value, dtype=np.float64)
    if array.shape != shape:
        raise DatasetError(f"{name} has the shape {array.shape}; expected {shape}.")
    return array


def _text(value: ArrayLike, shape: tuple[int, ...] | None = None) -> Names:
    array = np.array(value, dtype=np.str_)
    if shape is not None and array.shape != shape:
        raise DatasetError(f"a text column has the shape {array.shape}; expected {shape}.")
    return array


def _index(index: ArrayLike) -> NDArray[Any]:
    i = np.asarray(index)
    return i if i.size else i.astype(i.dtype if i.dtype.kind == "b" else np.intp)  # [] becomes floats


def check_name(name: object, what: str, place: str = "") -> None:
    """Refuse a name that could not stand in every form of a dataset.

    Args:
        name: Anything.
        what: What it names, for the error.
        place: Where it stands, for the error; empty where it comes from no file.

    Raises:
        DatasetError: It is no printable text, is too long, or has spaces at an end.
    """
    if not (
        isinstance(name, str) and name.isprintable() and name == name.strip() and 0 < len(name) <= MAX_NAME_CHARACTERS
    ):
        raise DatasetError(
            f"{place}{': ' * bool(place)}{what} {str(name)[:60]!r} is not usable.",
            why=f"names are printable text of at most {MAX_NAME_CHARACTERS} characters without spaces at either end",
            fix="rename it",
        )


def check_unique(names: Iterable[str], what: str, place: Callable[[int], str] | None = None) -> None:
    """Refuse names that are not usable or not unique.

    Args:
        names: The names.
        what: What they name, for the error.
        place: Says where the i-th stands, for the error; None where they come from no file.

    Raises:
        DatasetError: For the first such name.
    """
    first: dict[str, int] = {}
    for i, name in enumerate(names):
        check_name(name, what, place(i) if place else "")
        if name in first:
            raise DatasetError(
                f"{place(i)}: {what} {name!r} is there twice (first at {place(first[name])})."
                if place
                else f"{what} {name!r} is there twice.",
                fix=f"remove one, or give each {what} a name of its own",
            )
        first[name] = i


def check_views(uv: Floats, sd: Floats, cameras: Sequence[Camera], place: Callable[[int, int], str]) -> None:
    """Refuse pixels that are infinite, half missing or far outside the image, and impossible uncertainties.

    Args:
        uv: (n, cameras, 2) pixels, NaN where the view is missing.
        sd: (n, cameras, 2) their standard uncertainties in pixels, NaN where not stated; not looked at without a view.
        cameras: The cameras of the second axis.
        place: Says where the view (point, camera) stands, without its camera.

    Raises:
        DatasetError: For the first such view.
    """

    def view(i: int, k: int) -> str:
        return f"{place(i, k)}, camera {cameras[k].name!r}"

    for i, k in np.argwhere(np.isinf(uv).any(axis=2) | (np.isnan(uv[..., 0]) != np.isnan(uv[..., 1])))[:1]:
        raise DatasetError(
            f"{view(i, k)}: u = {uv[i, k, 0]:g}, v = {uv[i, k, 1]:g}.",
            why="a view has both u and v, finite, or neither",
            fix="correct the value, or leave both u and v empty (NaN) where the view is missing",
        )
    for k, camera in enumerate(cameras):
        if camera.width is None or camera.height is None:
            continue
        size = np.array([camera.width, camera.height], dtype=np.float64)
        margin = OUTSIDE_MARGIN_PX + OUTSIDE_MARGIN_SHARE * size.max()
        outside = ((uv[:, k] < -0.5 - margin) | (uv[:, k] > size - 0.5 + margin)).any(axis=1)
        for i in np.flatnonzero(outside)[:1]:
            why = "u is the column and v the row, counted from 0 at the centre of the top-left pixel"
            if outside.sum() >= MIN_VIEWS_OUTSIDE:
                why += (
                    f"; {outside.sum()} of its {(~np.isnan(uv[:, k, 0])).sum()} views are outside: are its u and v "
                    "exchanged, are these the pixels of another camera, or were its pictures resized or cropped?"
                )
            raise DatasetError(
                f"{view(int(i), k)}: pixel u = {uv[i, k, 0]:g}, v = {uv[i, k, 1]:g} is far outside the "
                f"{camera.width} x {camera.height} image.",
                why=why,
                fix="correct the value, remove the row, or correct the width and height of the camera",
            )
    for i, k in np.argwhere((((sd <= 0) | np.isinf(sd)) & ~np.isnan(uv)).any(axis=2))[:1]:
        raise DatasetError(
            f"{view(i, k)}: sd_u = {sd[i, k, 0]:g}, sd_v = {sd[i, k, 1]:g}.",
            why="a standard uncertainty is greater than zero and finite",
            fix="correct the value, or leave it empty (NaN) where no uncertainty is stated",
        )


def check_position_sd(sd: Floats, place: Callable[[int], str]) -> None:
    """Refuse standard uncertainties of positions that are below zero or infinite.

    Args:
        sd: (n, 3) in the dataset's unit, NaN where not stated.
        place: Says where row i stands, for the error.

    Raises:
        DatasetError: For the first such row.
    """
    for i, k in np.argwhere((sd < 0) | np.isinf(sd))[:1]:
        raise DatasetError(
            f"{place(i)}: {SD_POINT[k]} = {sd[i, k]:g}.",
            why="a standard uncertainty is at least zero and finite",
            fix="correct the value, or leave it empty (NaN) where no uncertainty is stated",
        )


def _check_columns(extra: Mapping[str, ArrayLike], shape: tuple[int, ...], taken: Sequence[str]) -> dict[str, Names]:
    """The extra columns, checked: names of their own, text that every form can hold."""
    columns = {}
    for name, value in extra.items():
        check_name(name, "column name")
        if name in taken:
            raise DatasetError(f"an extra column cannot be named {name!r}.", fix="rename it")
        columns[name] = column = _text(value, shape)
        cells = column.ravel().tolist()
        try:
            readable = b"\0" not in "".join(cells).encode()
        except UnicodeEncodeError:
            readable = False
        if not readable or max(map(len, cells), default=0) > MAX_CELL_CHARACTERS:
            raise DatasetError(
                f"the column {name!r} holds something else than text.",
                why=f"a cell has zero bytes, half a character, or more than {MAX_CELL_CHARACTERS} characters",
                fix="shorten or leave out the column",
            )
    return columns


def _refuse_misspelt(key: str, extra: Mapping[str, Any], whose: str) -> None:
    close = difflib.get_close_matches(key, [str(other) for other in extra], n=1, cutoff=0.75)
    if close:
        raise DatasetError(
            f"{whose} has no {key}.",
            why=f"{close[0]!r} may be a misspelling of it",
            fix=f"write {key} = 1280, in pixels",
        )


def _check_entries(extra: Mapping[str, Any], taken: Sequence[str], whose: str) -> dict[str, Any]:
    """Further entries of dataset.toml, as plain values that TOML can hold."""
    for key in taken:
        if key in extra:
            raise DatasetError(f"{whose}: an extra entry cannot be named {key!r}.", fix="rename it")
    try:
        entries: dict[str, Any] = to_plain(extra)
    except ValueError as error:
        raise DatasetError(
            f"{whose} has an extra entry that dataset.toml cannot hold.",
            why=str(error),
            fix="use text, numbers, booleans, dates, and lists and tables of these",
        ) from None
    return entries


def _freeze(value: object, **fields: Any) -> None:
    """Set the checked fields of a frozen value, arrays read-only."""
    for name, content in fields.items():
        for array in content.values() if isinstance(content, dict) else [content]:
            if isinstance(array, np.ndarray):
                array.setflags(write=False)
        object.__setattr__(value, name, content)
