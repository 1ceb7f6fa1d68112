"""A wand as a calibration keeps it: where its markers are, how its lengths fit, what is not used."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.forward_gp.settings import ForwardGPSettings
from implicam.calibrators.forward_gp.wand.fit import WandFit, fit_wand
from implicam.calibrators.forward_gp.wand.known import LEAST_SD, KnownPlaces
from implicam.calibrators.forward_gp.wand.waves import Waves
from implicam.calibrators.protocol import Arrays, finite_column
from implicam.dataset import Dataset, KnownPositions, Observations
from implicam.dataset.requirements import match_cameras
from implicam.dataset.scale_bars import ScaleBar, bar_rows
from implicam.dataset.units import METRES_PER_UNIT
from implicam.dataset.unused import Rejected, Unused
from implicam.dataset.wand import FRAME, MARKER, Wand, each_place_once, lying_still, marker_rows
from implicam.errors import DatasetError, UsageError
from implicam.geometry import Bools, Floats
from implicam.progress import Progress
from implicam.rig_model import (
    MAX_NAMED_IN_NOTE,
    CentralCamera,
    Diagnosis,
    FitResult,
    Frame,
    GeneralCamera,
    image_of,
    stated_noise,
)
from implicam.rig_model.placement import MAX_SCALE_SDS
from implicam.rig_model.training_data import camera_views_of

UNCHECKED = "two views meet there, and no third one and no length checks it"
CONTRADICTED = "its views contradict each other, or the length of the wand"
STILL = "the same as in a frame before: a wand that lies still, or a frame that is repeated, counts once"
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
        known: Names of the known positions that were used together with the wand.
        known_rejected: Of those that contradict the wand, or the others.
        known_scale: Ratio of the distances of the known positions over those that the wand alone gives, and its sd.
        exchanged: Names of cameras, and in how many of their pictures the two ends bore each other's names.
        offsets: Names of cameras whose pictures are not of the instants of the others', by how many frames they are
            later, and its standard uncertainty.
        bars: Known lengths between points, where these were given and no wand: its length is their median then.
    """

    wand: Wand
    errors: Floats
    sds: Floats
    rejected_lengths: tuple[str, ...]
    unused: tuple[Unused, ...]
    known: tuple[str, ...] = ()
    known_rejected: tuple[str, ...] = ()
    known_scale: tuple[float, float] = (1.0, 0.0)
    exchanged: tuple[tuple[str, int], ...] = ()
    offsets: tuple[tuple[str, float, float], ...] = ()
    bars: tuple[ScaleBar, ...] = ()

    def state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """A readable table, and arrays, of a calibration file."""
        table = {
            **self.wand.as_table(),
            "rejected_lengths": list(self.rejected_lengths),
            "unused": [[one.point, one.reason] for one in self.unused],
            "exchanged": [list(one) for one in self.exchanged],
            "offsets": [list(one) for one in self.offsets],
        }
        if self.bars:
            table["bars"] = [list(bar) for bar in self.bars]
        if self.known:
            table |= {"known": list(self.known), "known_rejected": list(self.known_rejected)}
            table["known_scale"] = list(self.known_scale)
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
        k, scale = len(arrays["waved/errors"]), own.get("known_scale", (1.0, 0.0))
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
            tuple(map(str, own.get("known", ()))),
            tuple(map(str, own.get("known_rejected", ()))),
            (float(scale[0]), float(scale[1])),
            tuple((str(camera), int(number)) for camera, number in own.get("exchanged", ())),
            tuple((str(camera), float(late), float(sd)) for camera, late, sd in own.get("offsets", ())),
            tuple(ScaleBar(str(a), str(b), float(length), float(sd)) for a, b, length, sd in own.get("bars", ())),
        )


def fit_to_wand(
    data: Dataset, wand: Wand, settings: ForwardGPSettings, progress: Progress, stated: Dataset | None = None
) -> tuple[Dataset, Frame, FitResult, Waved]:
    """Cameras from a wand.

    Args:
        data: Markers in frames, and what the cameras saw of them.
        wand: What is known of it.
        settings: Priors and thresholds.
        progress: Is told how far the fit is.
        stated: Known positions, which say where the world is and more.

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
            "the positions of a wand's markers are not known.",
            why=f"dataset {data.name!r} has known positions for all its points",
            fix="leave out --wand to calibrate from the known positions; or give the wand as DATASET and the known "
            "points apart: --known OTHER",
        )
    names, rows = marker_rows(data, wand.ends)
    first = lying_still(data, rows)
    own = first == np.arange(len(rows))
    data, again = each_place_once(data, rows, first), rows[~own]
    names, rows = [name for name, one in zip(names, own.tolist(), strict=True) if one], rows[own]
    if stated is not None:
        data, names, rows = with_stated_positions(data, names, rows, stated)
    jitter = wand.jitter or settings.usual_wand_jitter_ratio * wand.length
    waves = _waves(data, names, rows, jitter / wand.length)
    if stated is not None:
        waves = replace(waves, known=_known_places(data, rows, wand.length))
    found = fit_wand(waves, settings, wand.length_sd / wand.length, progress)
    return _told(data, names, rows, waves, found, wand._replace(jitter=jitter), again)


def fit_to_bars(
    data: Dataset, bars: Sequence[ScaleBar], settings: ForwardGPSettings, progress: Progress
) -> tuple[Dataset, Frame, FitResult, Waved]:
    """Cameras from points at places nobody knows, and one known length between two of them or several.

    Args:
        data: The points, and what the cameras saw of them.
        bars: The known lengths.
        settings: Priors and thresholds.
        progress: Is told how far the fit is.

    Returns:
        As `fit_to_wand`.

    Raises:
        FitError: Fewer than two cameras can be fitted, or the lengths contradict each other.
        DatasetError: A bar ends where no point is.
        UsageError: The positions of the points are known.
    """
    if data.known is not None:
        raise UsageError(
            "the positions of these points are known, and a scale bar is for points that nobody knows.",
            fix="leave out --scale-bars; or implicam verify with the lengths, which are a proof then",
        )
    names, rows = bar_rows(data, bars)
    usual = float(np.median([bar.length for bar in bars]))
    waves = _waves(data, names, rows, settings.usual_wand_jitter_ratio)
    lengths, jitter = waves.lengths.copy(), waves.jitter.copy()
    lengths[: len(bars)] = [bar.length / usual for bar in bars]
    sds = (bar.sd or settings.usual_wand_jitter_ratio * bar.length for bar in bars)
    jitter[: len(bars)] = [sd / usual for sd in sds]
    waves = replace(waves, lengths=lengths, jitter=jitter, still=True)
    found = fit_wand(waves, settings, 0.0, progress)
    return _told(data, names, rows, waves, found, Wand((), usual), np.zeros(0, dtype=np.int64), tuple(bars))


def _told(
    data: Dataset, names: list[str], rows: NDArray[np.int64], waves: Waves, found: WandFit, wand: Wand,
    again: NDArray[np.int64], bars: tuple[ScaleBar, ...] = (),
) -> tuple[Dataset, Frame, FitResult, Waved]:  # fmt: skip
    """A fit in the units and names of the data; again: rows of markers that lay still."""
    scale = found.scale * wand.length
    frame = Frame(found.offset * wand.length, scale)
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
    right = _put_right(data.observations, rows, found.exchanged)
    kept = replace(data, observations=right.select(flat[placed]), known=known, columns={})
    inliers = tuple(found.used[placed, c][kept.observations.seen[:, c]] for c in found.cameras)
    posterior = replace(found.posterior, displacement=np.zeros((len(placed), 3)))
    fitted = FitResult(posterior, found.cameras, found.uncalibrated, inliers, found.hyper, None, None)
    unused = tuple(
        Unused(str(data.points[flat[i]]), _why(found, i, waves))
        for i in np.flatnonzero(~found.checked & (flat >= 0)).tolist()
    ) + tuple(Unused(str(data.points[i]), STILL) for i in again[again >= 0].tolist())
    wrong = waves.ends & ~found.lengths & np.isfinite(found.places[:, 0]).reshape(-1, 2).all(axis=1)
    stated_names = [
        tuple(str(data.points[flat[i]]) for i in waves.known.rows[one]) for one in (found.known, ~found.known)
    ]
    waved = Waved(
        wand, found.length_errors * wand.length, found.length_sds * wand.length,
        tuple(names[i] for i in np.flatnonzero(wrong)), unused,
        stated_names[0], stated_names[1],
        found.known_scale,
        tuple((name, int(n)) for name, n in zip(waves.names, found.exchanged.sum(axis=0), strict=True) if n),
        tuple((waves.names[one.camera], one.frames, one.sd) for one in found.offsets),
        bars,
    )  # fmt: skip
    return kept, frame, fitted, waved


STATED = ("stated_x", "stated_y", "stated_z", "stated_sd_x", "stated_sd_y", "stated_sd_z")
"""Columns of points: the positions that were known beside a wand, and their standard uncertainties."""


def with_stated_positions(
    data: Dataset, names: list[str], rows: NDArray[np.int64], stated: Dataset
) -> tuple[Dataset, list[str], NDArray[np.int64]]:
    """The markers of a wand, and after them known points as single ones.

    Args:
        data: Markers in frames.
        names: (F,) of the frames.
        rows: (F, 2) as of `marker_rows`.
        stated: Known positions.

    Returns:
        Data, names and rows of both.

    Raises:
        DatasetError: A name is in both, no camera is, or there are no positions.
    """
    known = stated.in_unit(data.length_unit) if stated.length_unit != data.length_unit else stated
    positions, cameras = known.positions, data.observations.camera_names
    shared = [name for name in cameras if name in known.observations.camera_names]
    match_cameras(data.observations.with_cameras(shared) if shared else data.observations, known.observations)
    twice = sorted(set(map(str, data.points)) & set(map(str, known.points)))
    if twice:
        raise DatasetError(
            f"point {twice[0]!r} is in both datasets, {data.name!r} and {known.name!r}.", fix="rename it in one of them"
        )
    mine, theirs = data.observations, known.observations
    uv, sd = np.full((2, len(known), len(cameras), 2), np.nan)
    for c, name in enumerate(cameras):
        if name in shared:
            at = theirs.camera_names.index(name)
            uv[:, c], sd[:, c] = theirs.uv[:, at], theirs.sd[:, at]
    points = np.concatenate([data.points, known.points])
    observations = Observations(
        points, mine.cameras, np.concatenate([mine.uv, uv]), np.concatenate([mine.sd, sd]), {}
    )  # fmt: skip
    columns = {name: np.concatenate([column, np.full(len(known), "")]) for name, column in data.columns.items()}
    columns[FRAME] = np.concatenate([data.further_columns()[FRAME], known.points])
    columns[MARKER] = np.concatenate([data.further_columns()[MARKER], known.points])
    numbers = np.concatenate([positions.xyz, np.nan_to_num(positions.sd)], axis=1)
    for name, column in zip(STATED, numbers.T, strict=True):
        columns[name] = np.concatenate([np.full(len(data), ""), np.array([repr(float(v)) for v in column])])
    more = np.column_stack([len(data) + np.arange(len(known)), np.full(len(known), -1)])
    both = replace(data, observations=observations, columns=columns)
    return both, [*names, *map(str, known.points)], np.concatenate([rows, more])


def _known_places(data: Dataset, rows: NDArray[np.int64], length: float) -> KnownPlaces:
    """Those of the points with stated positions, in units of the wand's length."""
    flat = rows.ravel()
    places = np.flatnonzero((flat >= 0) & (data.columns[STATED[0]][flat] != ""))
    numbers = np.column_stack([data.columns[name][flat[places]].astype(np.float64) for name in STATED]) / length
    return KnownPlaces(places, numbers[:, :3], np.maximum(numbers[:, 3:], LEAST_SD))


def stated_again(data: Dataset) -> Dataset | None:
    """The known positions that a calibration from a wand was made with, out of its own data.

    Args:
        data: Of the calibration.

    Returns:
        None where there were none.
    """
    extra = {} if data.known is None else data.known.extra
    if STATED[0] not in extra:
        return None
    rows = np.flatnonzero(extra[STATED[0]] != "")
    numbers = np.column_stack([extra[name][rows].astype(np.float64) for name in STATED])
    known = KnownPositions(data.points[rows], numbers[:, :3], numbers[:, 3:])
    return replace(data, observations=data.observations.select(rows), known=known, columns={})


def _waves(data: Dataset, names: Sequence[str], rows: NDArray[np.int64], jitter: float) -> Waves:
    """What was seen, in units of the wand's length."""
    observations = data.observations
    stated = stated_noise(observations)
    place = np.full(len(data), -1, dtype=np.int64)
    flat = rows.ravel()
    place[flat[flat >= 0]] = np.flatnonzero(flat >= 0)
    every = camera_views_of(observations, stated)
    used = (views.select(place[views.rows] >= 0) for views in every)  # not frames in which the wand lay still
    seen = tuple(views._replace(rows=place[views.rows]) for views in used)
    images = tuple(image_of(observations, c) for c in range(len(observations.cameras)))
    none = np.zeros((len(rows), len(observations.cameras)), dtype=np.bool_)
    ends = np.asarray((rows >= 0).all(axis=1))
    lengths, sds = np.ones(len(rows)), np.full(len(rows), jitter)
    return Waves(rows, seen, images, stated, lengths, sds, ends, none, observations.camera_names, tuple(names))


def _put_right(observations: Observations, rows: NDArray[np.int64], exchanged: Bools) -> Observations:
    """With the views of both ends exchanged where their names were."""
    uv, sd = observations.uv.copy(), None if observations.sd is None else observations.sd.copy()
    for frame, c in np.argwhere(exchanged).tolist():
        both = rows[frame]
        uv[both, c] = uv[both[::-1], c]
        if sd is not None:
            sd[both, c] = sd[both[::-1], c]
    return replace(observations, uv=uv, sd=sd)


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
        if self.waved.known:
            return [self._known_note(), *super().notes(), *self._length_notes()]
        first = self.data.observations.camera_names[self.fitted.cameras[0]]
        if self.waved.bars:
            own = _points_world(first)
            return [*(self.world or (own,)), *super().notes(), *self._bar_notes(), *self._size_notes()]
        own = (
            "The world is the wand's: its origin is the middle of all places where the wand was, its axes are those "
            f"of {first} (x right, y down, z forward). Error bars are of positions relative to these places. "
            "implicam world says where it is instead, from an L-frame, known points, a floor or a plumb line."
        )
        more = [*self._picture_notes(), *self._length_notes(), *self._size_notes()]
        return [*(self.world or (own,)), *super().notes(), *more]

    def _size_notes(self) -> list[str]:
        """A rig as no rig is large or small: nothing but the stated length says how large it is."""
        unit = self.data.length_unit
        if unit not in METRES_PER_UNIT:
            return []
        cameras = (self.fitted.posterior.models[number].camera for number in range(len(self.fitted.cameras)))
        centres = np.array([one.pose.centre for one in cameras if isinstance(one, CentralCamera | GeneralCamera)])
        away = float(np.median(np.linalg.norm(centres, axis=1))) * self.frame.scale
        if LEAST_DISTANCE_M <= away * METRES_PER_UNIT[unit] <= LARGEST_DISTANCE_M:
            return []
        what = "scale bars" if self.waved.bars else f"wand of {self.waved.wand.length:.4g} {unit}"
        return [
            f"Cameras are {away:.3g} {unit} from the middle of what they see, by the {what}: is that length in {unit}? "
            "Nothing else says how large the rig is."
        ]

    def _bar_notes(self) -> list[str]:
        used, given = len(self.waved.errors), len(self.waved.bars)
        notes = []
        if self.waved.rejected_lengths:
            named = ", ".join(self.waved.rejected_lengths[:MAX_NAMED_IN_NOTE])
            notes.append(f"Not used, because they contradict the other scale bars or what the cameras saw: {named}.")
        if used == 1:
            of = "" if given == 1 else f", of {given} that were given"
            notes.append(
                f"The size rests on one length{of}: nothing here checks it. Verify another one (implicam verify), or "
                "give several."
            )
        return notes

    def _picture_notes(self) -> list[str]:
        notes = [
            f"In {number} pictures of {camera} the two ends of the wand bore each other's names: they are put right."
            for camera, number in self.waved.exchanged
        ]
        notes += [f"{text}." for text in describe_offsets(self.waved)]
        return notes + list(self._narrow_notes())

    def _narrow_notes(self) -> Iterator[str]:
        """Cameras that saw the wand in a small part of their pictures only."""
        seen = self.data.observations
        for number, c in enumerate(self.fitted.cameras):
            camera, uv = seen.cameras[c], seen.uv[seen.seen[:, c], c][self.fitted.inliers[number]]
            if camera.width is None or camera.height is None or len(uv) < MIN_FOR_OUTLINE:
                continue
            low, high = np.quantile(uv, [0.01, 0.99], axis=0)
            share = float(np.prod(high - low)) / (camera.width * camera.height)
            if share < NARROW_SHARE:
                yield (
                    f"{camera.name} saw the wand in {100 * share:.0f} % of its picture (u from {low[0]:.0f} to "
                    f"{high[0]:.0f}, v from {low[1]:.0f} to {high[1]:.0f}): elsewhere error bars are larger; wave it "
                    "there too."
                )

    def _known_note(self) -> str:
        wrong = self.waved.known_rejected
        count = len(self.waved.known)
        text = f"The world is that of {count} known points, which were adjusted together with the wand."
        text += f" Not used, because they contradict the others: {', '.join(wrong)}." if wrong else ""
        ratio, sd = self.waved.known_scale
        if abs(ratio - 1) > MAX_SCALE_SDS * sd:
            text += (
                f" They are {100 * ratio:.4g} % as far apart as the wand alone says, {abs(ratio - 1) / sd:.1f} "
                "standard deviations: is its length right? State how exact it is (--wand-sd)."
            )
        return text

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


def describe_offsets(waved: Waved) -> list[str]:
    """Cameras that are out of step, without full stops.

    Args:
        waved: How the wand was used.
    """
    return [
        f"The pictures of {camera} are taken {abs(late):.2g} ± {sd:.1g} frames {'after' if late > 0 else 'before'} "
        "those of the other cameras: trigger all of them by one signal, or give detect --offsets for films"
        for camera, late, sd in waved.offsets
    ]


def _points_world(first: str) -> str:
    return (
        "The world is that of the points: its origin is the middle of all that something checks, its axes are those of "
        f"{first} (x right, y down, z forward). Error bars are of positions relative to these points. implicam world "
        "says where it is instead."
    )


LEAST_DISTANCE_M, LARGEST_DISTANCE_M = 0.02, 500.0
"""Median distance of cameras from what they see, in metres, beyond which a length is likely in another unit."""

NARROW_SHARE, MIN_FOR_OUTLINE = 0.15, 12
"""Of a picture that the views of a wand enclose, below which a note says so; and views that tell what they enclose."""

MIN_RECOMMENDED_FRAMES = 50
"""Frames with both markers, below which a rig is known by half as well as it could be."""
