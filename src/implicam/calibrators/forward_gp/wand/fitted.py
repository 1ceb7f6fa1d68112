"""A wand as a calibration keeps it: where its markers are, how its lengths fit, what is not used."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.forward_gp.settings import ForwardGPSettings
from implicam.calibrators.forward_gp.wand.fit import WandFit, fit_wand
from implicam.calibrators.forward_gp.wand.waves import Waves
from implicam.calibrators.protocol import Arrays, finite_column
from implicam.dataset import Dataset, KnownPositions
from implicam.dataset.unused import Rejected, Unused
from implicam.dataset.wand import Wand, marker_rows
from implicam.errors import UsageError
from implicam.geometry import Floats
from implicam.progress import Progress
from implicam.rig_model import MAX_NAMED_IN_NOTE, Diagnosis, FitResult, Frame, image_of, stated_noise
from implicam.rig_model.training_data import camera_views_of

UNCHECKED = "two views meet there, and no third one and no length checks it"
CONTRADICTED = "its views contradict each other, or the length of the wand"
TOO_FEW = "fewer than two calibrated cameras saw it"


@dataclass(frozen=True, eq=False)
class Waved:
    """How a wand was used.

    Attributes:
        wand: What is known of it.
        errors: (k,) of the frames whose length is used: the length from what the cameras saw there, without knowing it,
            less that of the wand; in the length unit.
        sds: (k,) of these.
        rejected_lengths: Names of the frames whose length contradicts what the cameras saw.
        unused: Points that are not among the known ones of the calibration.
    """

    wand: Wand
    errors: Floats
    sds: Floats
    rejected_lengths: tuple[str, ...]
    unused: tuple[Unused, ...]

    def state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """A readable table, and arrays, of a calibration file."""
        table = {
            **self.wand.as_table(),
            "rejected_lengths": list(self.rejected_lengths),
            "unused": [[one.point, one.reason] for one in self.unused],
        }
        return {"waved": table}, {"waved/errors": self.errors, "waved/sds": self.sds}

    @classmethod
    def from_state(cls, table: Mapping[str, Any], arrays: Arrays) -> Waved | None:
        """The inverse of `state`.

        Args:
            table: Of a calibration file.
            arrays: Of it.

        Returns:
            What it says; None of a calibration from known points.

        Raises:
            KeyError, ValueError, TypeError: Something is missing or does not fit.
        """
        if "waved" not in table:
            return None
        own = table["waved"]
        k = len(arrays["waved/errors"])
        wand = Wand(
            tuple(map(str, own.get("ends", ()))), *(float(own.get(n, 0)) for n in ("length", "length_sd", "jitter"))
        )
        if not (0 < wand.length < np.inf and 0 <= wand.length_sd < np.inf and 0 <= wand.jitter < np.inf):
            raise ValueError("a wand has a length")
        return cls(
            wand,
            finite_column(arrays, "waved/errors", (k,)),
            finite_column(arrays, "waved/sds", (k,), positive=True),
            tuple(map(str, own["rejected_lengths"])),
            tuple(Unused(str(point), str(reason)) for point, reason in own["unused"]),
        )


def fit_to_wand(
    data: Dataset, wand: Wand, settings: ForwardGPSettings, progress: Progress
) -> tuple[Dataset, Frame, FitResult, Waved]:
    """Cameras from a wand.

    Args:
        data: Markers in frames, and what the cameras saw of them.
        wand: What is known of it.
        settings: Priors and thresholds.
        progress: Is told how far the fit is.

    Returns:
        The markers with the positions that the fit gives them, as far as something checks these; the working frame; the
        fit; and how the wand was used.

    Raises:
        FitError: Fewer than two cameras can be fitted.
        DatasetError: The points are no markers in frames.
        UsageError: The length is not stated.
    """
    if not wand.length > 0:
        raise UsageError(
            "the length of the wand is not known.",
            why="without it the rig has no size",
            fix="state the distance between its two markers, in the dataset's unit: --wand 500",
        )
    if data.known is not None:
        raise UsageError(
            "a wand and known positions cannot be used together yet.",
            fix="leave out --wand to calibrate from the known positions, or points.csv to calibrate from the wand",
        )
    names, rows = marker_rows(data, wand.ends)
    jitter = wand.jitter or settings.usual_wand_jitter_ratio * wand.length
    waves = _waves(data, rows, jitter / wand.length)
    found = fit_wand(waves, settings, wand.length_sd / wand.length, progress)
    scale = found.scale * wand.length
    frame = Frame(np.zeros(3), scale)
    flat = rows.ravel()
    placed = np.flatnonzero(found.checked & (flat >= 0))
    placed = placed[np.argsort(flat[placed])]
    shots = np.array([names[i // 2] for i in placed], dtype=np.str_)
    known = KnownPositions(
        shots,
        frame.to_world(found.places[placed]),
        np.full((len(placed), 3), np.nan),
        {name: column[flat[placed]] for name, column in data.columns.items()},
    )
    kept = replace(data, observations=data.observations.select(flat[placed]), known=known, columns={})
    inliers = tuple(found.used[placed, c][kept.observations.seen[:, c]] for c in found.cameras)
    posterior = replace(found.posterior, displacement=np.zeros((len(placed), 3)))
    fitted = FitResult(posterior, found.cameras, found.uncalibrated, inliers, found.hyper, None, None)
    unused = tuple(
        Unused(str(data.points[flat[i]]), _why(found, i, waves))
        for i in np.flatnonzero(~found.checked & (flat >= 0)).tolist()
    )
    wrong = waves.ends & ~found.lengths & np.isfinite(found.places[:, 0]).reshape(-1, 2).all(axis=1)
    waved = Waved(
        wand._replace(jitter=jitter), found.length_errors * wand.length, found.length_sds * wand.length,
        tuple(names[i] for i in np.flatnonzero(wrong)), unused,
    )  # fmt: skip
    return kept, frame, fitted, waved


def _waves(data: Dataset, rows: NDArray[np.int64], jitter: float) -> Waves:
    """What was seen, in units of the wand's length."""
    observations = data.observations
    stated = stated_noise(observations)
    place = np.full(len(data), -1, dtype=np.int64)
    flat = rows.ravel()
    place[flat[flat >= 0]] = np.flatnonzero(flat >= 0)
    seen = tuple(views._replace(rows=place[views.rows]) for views in camera_views_of(observations, stated))
    images = tuple(image_of(observations, c) for c in range(len(observations.cameras)))
    return Waves(rows, seen, images, stated, 1.0, jitter, np.asarray((rows >= 0).all(axis=1)))


def _why(found: WandFit, place: int, waves: Waves) -> str:
    if np.isfinite(found.places[place, 0]):
        return UNCHECKED
    seen = np.isfinite(waves.uv[place, list(found.cameras), 0]).sum()
    return CONTRADICTED if seen >= 2 else TOO_FEW


@dataclass(frozen=True, eq=False)
class WandDiagnosis(Diagnosis):
    """How a rig agrees with the wand it was fitted to: of points nothing was known before."""

    waved: Waved
    world: tuple[str, ...] = ()

    @cached_property
    def rejected(self) -> tuple[Rejected, ...]:
        """The views of the markers in use that contradict the others, the farthest first."""
        names, found = self.data.observations.camera_names, []
        for number, c in enumerate(self.fitted.cameras):
            seen, inliers = self._seen[number], self.fitted.inliers[number]
            wrong = np.flatnonzero(~inliers)
            if not len(wrong):
                continue
            mean, _ = self.fitted.posterior.models[number].predict(self._points[seen.rows[wrong]])
            off = np.linalg.norm(seen.uv[wrong] - mean, axis=1)
            points = (str(self.data.points[row]) for row in seen.rows[wrong])
            found += [Rejected(point, names[c], float(away)) for point, away in zip(points, off, strict=True)]
        return tuple(sorted(found, key=lambda view: -np.nan_to_num(view.residual, nan=np.inf)))

    @property
    def unused(self) -> tuple[Unused, ...]:
        """The markers that are not among the known points."""
        return self.waved.unused

    def notes(self) -> list[str]:
        """Where the world is; cameras that could not be calibrated; views and lengths that contradict the others."""
        first = self.data.observations.camera_names[self.fitted.cameras[0]]
        own = (
            "The world is the wand's: its origin is the middle of all places where the wand was, its axes are those "
            f"of {first} (x right, y down, z forward). Error bars are of positions relative to these places. "
            "implicam world says where it is instead, from an L-frame, known points, a floor or a plumb line."
        )
        return [*(self.world or (own,)), *super().notes(), *self._length_notes()]

    def _length_notes(self) -> list[str]:
        notes = []
        if rejected := self.waved.rejected_lengths:
            named = ", ".join(rejected[:MAX_NAMED_IN_NOTE])
            more = f" and {len(rejected) - MAX_NAMED_IN_NOTE} more" if len(rejected) > MAX_NAMED_IN_NOTE else ""
            notes.append(
                f"The length of the wand is not used in {len(rejected)} frames, which contradict it: {named}{more}."
            )
        used = len(self.waved.errors)
        if used < MIN_RECOMMENDED_FRAMES:
            notes.append(
                f"The length of the wand is used in {used} frames only: wave it longer where two cameras see both "
                f"markers; {MIN_RECOMMENDED_FRAMES} frames or more."
            )
        return notes


MIN_RECOMMENDED_FRAMES = 50
"""Frames with both markers, below which a rig is known by half as well as it could be."""
