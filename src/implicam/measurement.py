"""Measured positions with their covariance, and measured.csv."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from implicam.dataset import Dataset, Floats, Names
from implicam.dataset.folder import csv_text, format_cells
from implicam.dataset.frames import keep_others, rigid_parts
from implicam.dataset.units import metres_per
from implicam.dataset.written_table import write_table
from implicam.errors import UsageError, did_you_mean, import_extra
from implicam.files import write_text
from implicam.formatting import decimal_number, list_some, number_with_sd
from implicam.plotted import Plotted

MEASURED_COLUMNS = (
    "point", "x", "y", "z", "sd_x", "sd_y", "sd_z", "cov_xy", "cov_xz", "cov_yz", "views", "consistency", "reason",
    "share_calibration",
)  # fmt: skip


MAX_LINES_SHOWN = 7
"""Points that an interactive Python shows of a measurement."""
MAX_CHARACTERS_SHOWN = 110

DOUBTFUL = "doubtful: the table as a whole contradicts the calibration"
"""How the reason of every row begins where there is an alarm."""


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """What the errors of n measured points have in common, because one calibration measured them all: the error of each
    is `E @ z` and an error of its own, z standard normal numbers that all points share. Nothing is computed, and
    nothing of that size is kept, before somebody asks for a few points.

    Attributes:
        of_rows: Takes (k,) numbers of points as they were measured, and gives E (k, 3, q).
        rows: (n,) the number that each point had then.
        turn: (3, 3) from the axes and the length unit of then to those of now.
    """

    of_rows: Callable[[NDArray[np.int64]], Floats]
    rows: NDArray[np.int64]
    turn: Floats

    def of(self, index: NDArray[np.int64]) -> Floats:
        """The E (k, 3, q) of some points.

        Args:
            index: (k,) their numbers.
        """
        return np.asarray(self.turn @ self.of_rows(self.rows[index]), dtype=np.float64)

    def select(self, index: ArrayLike) -> SharedErrors:
        """Of some points.

        Args:
            index: A mask, or numbers.
        """
        return replace(self, rows=self.rows[np.asarray(index)])

    def turned(self, turn: Floats) -> SharedErrors:
        """In other axes, or another unit.

        Args:
            turn: (3, 3) that positions are multiplied by.
        """
        return replace(self, turn=turn @ self.turn)


@dataclass(frozen=True, eq=False)
class MeasuredPoint:
    """One point of a `Measurement`, which has the meaning of each field.

    Attributes:
        point: Its name.
        xyz: (3,), NaN where it could not be measured.
        cov: (3, 3) covariance of the position.
        views: Number of views used.
        consistency: p-value of the test that the views agree.
        reason: Why it was not measured, or which views were left out.
        length_unit: Of the position.
        share_calibration: Share of the variance that more known points could remove; NaN where the errors of the
            cameras are not known.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> calibration = ic.ForwardGP().fit(rig)
    >>> point = calibration.measure(rig)[0]
    >>> point.xyz.shape, point.cov.shape, point.views
    ((3,), (3, 3), 2)
    """

    point: str
    xyz: Floats
    cov: Floats
    views: int
    consistency: float
    reason: str
    length_unit: str
    share_calibration: float

    @property
    def sd(self) -> Floats:
        """(3,) standard uncertainties of x, y and z."""
        return np.asarray(np.sqrt(np.diagonal(self.cov)))

    @property
    def measured(self) -> bool:
        """Whether there is a position."""
        return not np.isnan(self.xyz[0])

    def __repr__(self) -> str:
        if not self.measured:
            return f"{self.point}: not measured, {self.reason}"
        position = ", ".join(
            f"{axis} {number_with_sd(*pair)}" for axis, *pair in zip("xyz", self.xyz, self.sd, strict=True)
        )
        return f"{self.point}: {position} {self.length_unit}, {self.views} views{self.reason and '; '}{self.reason}"


@dataclass(frozen=True, eq=False, repr=False)
class Measurement(Plotted):
    """Positions of n points, in the world frame and length unit of the calibration.

    `measurement[0]`, `measurement["p0001"]` and iteration give a `MeasuredPoint` each.

    Attributes:
        points: (n,) names.
        xyz: (n, 3); NaN where the point could not be measured.
        cov: (n, 3, 3) covariance of the *position*, everything included: pixel noise of this measurement, lack of
            calibration data, parameters.
        views: (n,) number of views used.
        consistency: (n,) p-value of the chi-squared test that the views agree; NaN where it cannot be tested.
        reason: (n,) why a point was not measured; of a measured one, which views were left out, or empty.
        length_unit: Of the positions.
        alarm: What is wrong with the table as a whole, in a sentence: the rig is not the one that was calibrated. Then
            no number of it can be trusted, and every reason begins with `DOUBTFUL`. Empty where nothing is wrong.
        share_calibration: (n,) from 0 to 1, the share of the variance (trace of cov) that more known points could
            remove; the rest is the pixel noise of this measurement. NaN where the method cannot tell them apart.
        columns: Further columns of the data that were measured, (n,) text each, which measured.csv repeats.
        shared: What the errors of the points have in common; None where the method, or a table that was read, cannot
            say.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> calibration = ic.ForwardGP().fit(rig)
    >>> measured = calibration.measure(rig)
    >>> len(measured), measured[0].views, len(measured.select([0, 1]))
    (30, 2, 2)
    """

    points: Names
    xyz: Floats
    cov: Floats
    views: NDArray[np.int64]
    consistency: Floats
    reason: Names
    length_unit: str
    alarm: str = ""
    share_calibration: Floats = field(default_factory=lambda: np.zeros(0))
    columns: Mapping[str, Names] = field(default_factory=dict)
    shared: SharedErrors | None = None

    def __post_init__(self) -> None:
        """A covariance is symmetric to the last bit, whatever order a method or a processor summed it in."""
        object.__setattr__(self, "cov", 0.5 * (self.cov + self.cov.swapaxes(1, 2)))
        if not len(self.share_calibration):  # not given: the method cannot tell
            object.__setattr__(self, "share_calibration", np.full(len(self.points), np.nan))

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, which: int | str) -> MeasuredPoint:
        """A point by its number, from the end where that is negative, or by its name.

        Args:
            which: The number or the name.

        Raises:
            IndexError: There is no such number; it ends an iteration.
            UsageError: There is no such name, or it is neither.
        """
        if isinstance(which, str):
            found = np.flatnonzero(self.points == which)
            if not len(found):
                near = did_you_mean(which, map(str, self.points))
                raise UsageError(
                    f"there is no point {which!r}{near}.", fix=f"the points are {list_some(self.points.tolist())}"
                )
            which = int(found[0])
        if not isinstance(which, int | np.integer):
            raise UsageError(
                f"a measurement is asked for one point, by number or name, and not by {type(which).__name__}.",
                fix="for some of the points: measurement.select(index)",
            )
        i = range(len(self))[which]  # IndexError
        return MeasuredPoint(
            str(self.points[i]), self.xyz[i], self.cov[i], int(self.views[i]), float(self.consistency[i]),
            str(self.reason[i]), self.length_unit, float(self.share_calibration[i]),
        )  # fmt: skip

    def __iter__(self) -> Iterator[MeasuredPoint]:
        return (self[i] for i in range(len(self)))

    def __repr__(self) -> str:
        lines = [self._summary]
        shown = min(len(self), MAX_LINES_SHOWN + (len(self) == MAX_LINES_SHOWN + 1))
        lines += [f"  {_shortened(repr(self[i]))}" for i in range(shown)]
        lines += [f"  ... and {len(self) - shown} more"] if shown < len(self) else []
        return "\n".join([*lines, *([f"  ALARM: {_shortened(self.alarm)}"] if self.alarm else [])])

    def _repr_html_(self) -> str:
        heads = "".join(
            f"<th>{head}</th>" for head in ("point", *(f"{a}, {self.length_unit}" for a in "xyz"), "views", "reason")
        )
        rows = []
        for one in (self[i] for i in range(min(len(self), MAX_LINES_SHOWN))):
            axes = [number_with_sd(*pair) for pair in zip(one.xyz, one.sd, strict=True)] if one.measured else ["-"] * 3
            cells = [one.point, *axes, str(one.views), _shortened(one.reason)]
            rows.append("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>")
        more = f"<p>... and {len(self) - len(rows)} more</p>" if len(rows) < len(self) else ""
        alarm = f"<p><b>ALARM:</b> {escape(self.alarm)}</p>" if self.alarm else ""
        table = f"<table><thead><tr>{heads}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
        return f"<p>{escape(self._summary)}</p>{alarm}{table}{more}"

    @property
    def _summary(self) -> str:
        count, sd = int(self.measured.sum()), self.sd[self.measured]
        typical = (
            ", ".join(f"{a} {decimal_number(x)}" for a, x in zip("xyz", np.median(sd, axis=0), strict=True))
            if count
            else ""
        )
        stated = f", typical sd {typical} {self.length_unit}" if count and np.isfinite(sd).all() else ""
        return f"measurement of {len(self):,} point{'s' * (len(self) != 1)}, {count:,} measured{stated}"

    def select(self, index: ArrayLike) -> Measurement:
        """The measurement of some points; the alarm, which is of the whole table, stays.

        Args:
            index: A boolean mask (n,); or numbers of points, in the order wanted.
        """
        i = np.asarray(index)
        i = i if i.size else i.astype(np.intp)
        return replace(
            self, points=self.points[i], xyz=self.xyz[i], cov=self.cov[i], views=self.views[i],
            consistency=self.consistency[i], reason=self.reason[i], share_calibration=self.share_calibration[i],
            columns={key: column[i] for key, column in self.columns.items()},
            shared=self.shared and self.shared.select(i),
        )  # fmt: skip

    def without_points(self, names: Iterable[str]) -> Measurement:
        """The measurement of all other points.

        Args:
            names: Of the points to leave out.

        Raises:
            UsageError: There is no such point.
        """
        return self.select(keep_others(self.points, names))

    def in_unit(self, unit: str) -> Measurement:
        """The same measurement in another length unit.

        Args:
            unit: For example "m".

        Raises:
            DatasetError: The unit has no known length.
        """
        factor = metres_per(self.length_unit) / metres_per(unit)
        shared = self.shared and self.shared.turned(factor * np.eye(3))
        return replace(self, xyz=self.xyz * factor, cov=self.cov * factor**2, length_unit=unit, shared=shared)

    def transformed(self, pose: Any) -> Measurement:
        """The same points in another frame of the world; the covariances turn with it.

        Args:
            pose: What takes a position to the other frame: SciPy's Rotation, or a rigid 4 x 4 matrix (a translation in
                the length unit).

        Raises:
            UsageError: It is no rotation and no rigid matrix.
        """
        rotation, shift = rigid_parts(pose)
        shared = self.shared and self.shared.turned(rotation)
        return replace(self, xyz=self.xyz @ rotation.T + shift, cov=rotation @ self.cov @ rotation.T, shared=shared)

    def to_dataframe(self) -> Any:
        """A pandas table with the columns of measured.csv, NaN where there is no number.

        Raises:
            MissingExtraError: pandas is not installed.
        """
        pandas = import_extra("pandas", "pandas", "a table of pandas")
        columns = self._table()
        return pandas.DataFrame({key: v.astype(object) if v.dtype.kind == "U" else v for key, v in columns.items()})

    def _table(self) -> dict[str, NDArray[Any]]:
        """The columns of measured.csv, numbers or text, (n,) each."""
        off_diagonal = self.cov[:, [0, 0, 1], [1, 2, 2]]
        numbers = np.concatenate([self.xyz, self.sd, off_diagonal], axis=1).T
        tail = (self.views, self.consistency, self.reason, self.share_calibration)
        return {**dict(zip(MEASURED_COLUMNS, (self.points, *numbers, *tail), strict=True)), **self.columns}

    @property
    def measured(self) -> NDArray[np.bool_]:
        """(n,) where there is a position."""
        return ~np.isnan(self.xyz[:, 0])

    @property
    def own_reason(self) -> Names:
        """(n,) the reasons without what an alarm adds in front of them."""
        return np.array(
            [str(reason).removeprefix(DOUBTFUL).removeprefix("; ") for reason in self.reason], dtype=np.str_
        )

    def with_columns(self, columns: Mapping[str, Names]) -> Measurement:
        """The same measurement with further columns for measured.csv.

        Args:
            columns: (n,) text each, such as `Dataset.further_columns` gives; one with a name of `MEASURED_COLUMNS` gets
                an underscore behind it.
        """
        free = {f"{name}_" if name in MEASURED_COLUMNS else name: column for name, column in columns.items()}
        return replace(self, columns=free)

    def with_alarm(self, alarm: str) -> Measurement:
        """The same measurement with every row marked as doubtful.

        Args:
            alarm: What is wrong, in a sentence; empty for none, which returns the measurement itself.
        """
        if not alarm:
            return self
        reasons = [f"{DOUBTFUL}; {reason}" if reason else DOUBTFUL for reason in map(str, self.own_reason)]
        return replace(self, alarm=alarm, reason=np.array(reasons, dtype=np.str_))

    @property
    def sd(self) -> Floats:
        """(n, 3) standard uncertainties of x, y and z."""
        return np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2))

    def write(self, path: str | Path) -> None:
        """Write the table of `write_csv` as the ending says: .csv, .xlsx (`[excel]`) or .parquet (`[parquet]`).

        Args:
            path: The file; it is replaced whole.

        Raises:
            UsageError: It has another ending.
            DatasetError: A workbook cannot hold a text.
            MissingExtraError: What writes it is not installed.
            ImplicamError: It cannot be written.
        """
        write_table(Path(path), self._table())

    def write_csv(self, path: str | Path) -> None:
        """Write measured.csv: every point keeps its row; one that was not measured has empty numbers and a reason.

        Args:
            path: The file; it is replaced whole.

        Raises:
            ImplicamError: It cannot be written.
        """
        table = self._table()
        cells = [format_cells(v) if v.dtype.kind == "f" else v.astype(np.str_).tolist() for v in table.values()]
        write_text(Path(path), csv_text(list(table), zip(*cells, strict=True)))


def _shortened(text: str) -> str:
    return text if len(text) <= MAX_CHARACTERS_SHOWN else f"{text[: MAX_CHARACTERS_SHOWN - 3]}..."


FAR_OUTSIDE = 0.05
"""Of the diagonal of the box of the known points: a position that is farther outside is told."""


def notes_outside(measurement: Measurement, known: Dataset) -> list[str]:
    """What the user should know of positions where nothing was known.

    Args:
        measurement: Of any points.
        known: What was calibrated from, in the same frame and unit.

    Returns:
        A sentence where some are outside of the box of the known points by more than a twentieth of its size.
    """
    places = known.xyz[np.isfinite(known.xyz).all(axis=1)]
    xyz = measurement.xyz[measurement.measured]
    if len(places) < 2 or not len(xyz) or measurement.length_unit != known.length_unit:
        return []
    low, high = places.min(axis=0), places.max(axis=0)
    size = float(np.linalg.norm(high - low))
    beyond = np.linalg.norm(np.maximum(np.maximum(low - xyz, xyz - high), 0), axis=1)
    count = int((beyond > FAR_OUTSIDE * size).sum())
    if not count:
        return []
    return [
        f"{count} of {len(xyz)} points are outside of the box of the known points, the farthest by "
        f"{decimal_number(float(beyond.max()))} {measurement.length_unit} (the box is {decimal_number(size)} across): "
        "no known point says how the cameras see there, and the error bars rest on the lens models alone. Behind glass "
        "or water they can be several times too small; put known points there."
    ]
