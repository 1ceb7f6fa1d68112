"""Positions of many points as arrays, from pixels as arrays: no names or words are made before they are wanted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Names
from implicam.geometry import Bools, Floats
from implicam.rig_model.reasons import Codes, reasons_in_words


@dataclass(frozen=True, eq=False)
class MeasuredPixels:
    """What `measure_pixels` finds of n points seen by C cameras, in the world and the length unit of the calibration.

    Attributes:
        xyz: (n, 3), NaN where a point could not be measured.
        cov: (n, 3, 3) covariances of the positions, everything included.
        consistency: (n,) p-value of the chi-squared test that the views agree; NaN where it cannot be tested.
        code: (n,) what became of each point, of `rig_model.reasons.Reason`; 0 where it was measured.
        left_out: (n, C) views that contradict the others, and were not used.
        share_calibration: (n,) share of the variance that more known points could remove.
        uv: (n, C, 2) the pixels, as they were given; NaN where infinite.
        camera_names: Of the C cameras.
        length_unit: Of the positions.
        find_alarm: Looks at the whole table.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> found = ic.ForwardGP().fit(rig).measure_pixels(rig.observations.uv)
    >>> found.xyz.shape, found.measured.all().item(), found.alarm
    ((30, 3), True, '')
    """

    xyz: Floats
    cov: Floats
    consistency: Floats
    code: Codes
    left_out: Bools
    share_calibration: Floats
    uv: Floats
    camera_names: tuple[str, ...]
    length_unit: str
    find_alarm: Callable[[], str]

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def measured(self) -> Bools:
        """(n,) where there is a position."""
        return np.asarray(self.code == 0)

    @property
    def sd(self) -> Floats:
        """(n, 3) standard uncertainties of x, y and z."""
        return np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2))

    @property
    def seen(self) -> Bools:
        """(n, C) the views that each point has."""
        return np.asarray(np.isfinite(self.uv).all(axis=2))

    @property
    def views(self) -> NDArray[np.int64]:
        """(n,) number of views used."""
        return np.asarray(self.seen.sum(axis=1) - self.left_out.sum(axis=1), dtype=np.int64)

    @cached_property
    def reason(self) -> Names:
        """(n,) in words why a point was not measured; of a measured one, which views were left out, or empty."""
        return reasons_in_words(self.code, self.seen, self.left_out, self.camera_names)

    @cached_property
    def alarm(self) -> str:
        """What is wrong with the table as a whole, in a sentence, empty where nothing is: then no number of it can be
        trusted. It is looked for when it is asked for."""
        return self.find_alarm()
