"""What a detector finds in one picture, and what every detector offers.

CONTRIBUTING.md has the recipe for one more.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import numpy as np

from implicam.dataset import Dataset, Floats
from implicam.images import Grey


class View(NamedTuple):
    """One picture: which camera took it in which shot."""

    camera: str
    shot: str


@dataclass(frozen=True, eq=False)
class Inferred:
    """Points that the picture does not show, placed by those that it shows: no observations, for they say nothing new.

    points: n names. uv: (n, 2) pixels. covariance: (n, 2, 2) of each; the errors of neighbours are alike.
    """

    points: tuple[str, ...] = ()
    uv: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    covariance: Floats = field(default_factory=lambda: np.zeros((0, 2, 2)))


@dataclass(frozen=True, eq=False)
class Detected:
    """What was found in one picture.

    points: n names, those of points.csv. uv: (n, 2) pixels, (0, 0) the centre of the top-left pixel; sd: (n, 2) their
    standard uncertainties. reason: why nothing, or not everything, was found; empty where all is well. outlines:
    curves (k, 2) in pixels for the overlay, such as the edge of a ball. others: what else might have been meant, the
    likelier first; only `Detector.settle` looks at it. notes: anything a detector wants to remember, as plain values.
    inferred: what is hidden, where a detector was asked for it.
    """

    points: tuple[str, ...] = ()
    uv: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    sd: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    reason: str = ""
    outlines: tuple[Floats, ...] = ()
    others: tuple[Detected, ...] = ()
    notes: Mapping[str, Any] = field(default_factory=dict)
    inferred: Inferred = field(default_factory=Inferred)

    def __len__(self) -> int:
        return len(self.points)

    def as_dict(self) -> dict[str, Any]:
        """As plain values, which `from_dict` turns back to the same bits."""
        return {
            "points": list(self.points),
            "uv": self.uv.tolist(),
            "sd": self.sd.tolist(),
            "reason": self.reason,
            "outlines": [curve.tolist() for curve in self.outlines],
            "others": [other.as_dict() for other in self.others],
            "notes": dict(self.notes),
            "inferred": [
                [name, *uv.tolist(), *covariance.ravel().tolist()]
                for name, uv, covariance in zip(*vars(self.inferred).values(), strict=True)
            ],
        }

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> Detected:
        """The inverse of `as_dict`.

        Args:
            table: Plain values, as `as_dict` gives them.
        """
        return cls(
            tuple(table["points"]),
            np.array(table["uv"], dtype=np.float64).reshape(-1, 2),
            np.array(table["sd"], dtype=np.float64).reshape(-1, 2),
            str(table["reason"]),
            tuple(np.array(curve, dtype=np.float64).reshape(-1, 2) for curve in table["outlines"]),
            tuple(cls.from_dict(other) for other in table["others"]),
            dict(table["notes"]),
            _read_inferred(table["inferred"]),
        )


def _read_inferred(rows: Sequence[Sequence[Any]]) -> Inferred:
    numbers = np.array([row[1:] for row in rows], dtype=np.float64).reshape(-1, 6)
    return Inferred(tuple(str(row[0]) for row in rows), numbers[:, :2], numbers[:, 2:].reshape(-1, 2, 2))


def nothing(reason: str, **more: Any) -> Detected:
    """Nothing found, and why.

    Args:
        reason: In a sentence for the user: what to do about it.
        more: Other fields of `Detected`, such as outlines.
    """
    return Detected(reason=reason, **more)


class Detector(Protocol):
    """Finds one kind of target; a frozen value, so that its options can be written beside its results.

    On the command line it is made by the classmethod `from_options(dataset, described, *, ...)`. Its keyword arguments
    are the options, `name: Annotated[type, Option(...)] = None`; `dataset` is the folder, and `described` the table
    `[target]` of dataset.toml, empty where that is of another target. A key of that table with the name of an option
    is its value where the option is not given.

    moves: whether the target is shown at many places, with other points in each shot; a fixed one has the same points.
    """

    moves: ClassVar[bool]

    def options(self) -> dict[str, Any]:
        """All that its results depend on, as plain values: other options, other results."""

    def describe(self) -> dict[str, Any]:
        """The table [target] that dataset.toml needs of the target, with its kind; empty where it needs none."""

    def detect(self, picture: Grey, view: View) -> Detected:
        """Look at one picture. Never raises for what is in the picture: nothing found is a reason.

        Args:
            picture: (height, width) float32 grey from 0 to 1.
            view: Which picture it is.
        """

    def settle(self, found: Mapping[View, Detected]) -> dict[View, Detected]:
        """A second look when all pictures are known: what recurs in every shot is no target, and so on.

        Args:
            found: What `detect` gave of each picture.

        Returns:
            What is to be kept of each, with the same keys.
        """

    def correct(self, data: Dataset) -> tuple[Dataset, list[str]]:
        """Make observations better: the middle of a ball for that of its outline, say.

        Args:
            data: All that was found.

        Returns:
            The dataset, and notes for the user.
        """


@runtime_checkable
class LooksAgain(Protocol):
    """A detector that looks into some pictures a second time, when it knows what was found in all of them."""

    def look_again(
        self, found: Mapping[View, Detected], read: Callable[[Collection[View]], Iterable[tuple[View, Grey]]]
    ) -> dict[View, Detected]:
        """What is left of what was found.

        Args:
            found: What `settle` gave of each picture.
            read: Gives pictures, (height, width) grey from 0 to 1, each once and in any order: a film is read once.
        """


class DetectorBase:
    """What most detectors say of themselves: each picture speaks for itself, and nothing is to be corrected.

    moves: whether the target is shown at many places, with other points in each shot; a fixed one has the same points.
    """

    moves: ClassVar[bool] = True

    def describe(self) -> dict[str, Any]:
        """Nothing: dataset.toml needs no table [target] for it."""
        return {}

    def settle(self, found: Mapping[View, Detected]) -> dict[View, Detected]:
        """Change nothing: each picture speaks for itself.

        Args:
            found: What `detect` gave of each picture.
        """
        return dict(found)

    def correct(self, data: Dataset) -> tuple[Dataset, list[str]]:
        """Change nothing, and note nothing.

        Args:
            data: All that was found.
        """
        return data, []
