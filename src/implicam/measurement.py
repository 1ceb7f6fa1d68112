"""Measured positions with their covariance, and measured.csv."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Floats, Names
from implicam.dataset.folder import csv_text
from implicam.files import write_text

MEASURED_COLUMNS = (
    "point", "x", "y", "z", "sd_x", "sd_y", "sd_z", "cov_xy", "cov_xz", "cov_yz", "views", "consistency", "reason",
    "share_calibration",
)  # fmt: skip


DOUBTFUL = "doubtful: the table as a whole contradicts the calibration"
"""How the reason of every row begins where there is an alarm."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """Positions of n points, in the world frame and length unit of the calibration.

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

    def __post_init__(self) -> None:
        """A covariance is symmetric to the last bit, whatever order a method or a processor summed it in."""
        object.__setattr__(self, "cov", 0.5 * (self.cov + self.cov.swapaxes(1, 2)))
        if not len(self.share_calibration):  # not given: the method cannot tell
            object.__setattr__(self, "share_calibration", np.full(len(self.points), np.nan))

    def __len__(self) -> int:
        return len(self.points)

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

    def write_csv(self, path: str | Path) -> None:
        """Write measured.csv: every point keeps its row; one that was not measured has empty numbers and a reason.

        Args:
            path: The file; it is replaced whole.

        Raises:
            ImplicamError: It cannot be written.
        """
        off_diagonal = self.cov[:, [0, 0, 1], [1, 2, 2]]
        numbers = np.concatenate([self.xyz, self.sd, off_diagonal], axis=1)
        rows = []
        for i, name in enumerate(self.points):
            row = ["" if np.isnan(x) else repr(float(x)) for x in numbers[i]]
            p = self.consistency[i]
            share = self.share_calibration[i]
            tail = [str(int(self.views[i])), "" if np.isnan(p) else repr(float(p)), str(self.reason[i])]
            tail.append("" if np.isnan(share) else repr(float(share)))
            rows.append([str(name), *row, *tail, *(str(column[i]) for column in self.columns.values())])
        write_text(Path(path), csv_text([*MEASURED_COLUMNS, *self.columns], rows))
