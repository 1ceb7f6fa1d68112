"""What a report says of the cameras themselves: where the uncertainty comes from, what each camera saw, what to do.

Only of calibrations with cameras (`forward-gp`, `explicit`): a map from pixels to positions has none to speak of.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.protocol import RigCalibration
from implicam.coverage import tercile_labels
from implicam.dataset import Floats, Names
from implicam.dataset.image_bounds import are_on_image, image_bounds
from implicam.formatting import number, percent
from implicam.geometry import Bools
from implicam.rig_model import SOURCES, Sensitivity

PLACES_PER_AXIS = 11
"""Of the grid over the box of the known points."""
CELLS = 3
"""Along a side of a picture."""
CELL_NAMES = (
    ("upper left", "top", "upper right"),
    ("left", "middle", "right"),
    ("lower left", "bottom", "lower right"),
)
MIN_VIEWS_IN_CELL, SUSPECT_NOISE, SUSPECT_SHARE = 4, 4.0, 0.3
"""A part of a picture is named where so many views are, and are off by so many times the camera's noise in the median,
or so large a part of them was not used."""
MIN_PLACES_MISSED = 0.04
"""Part of the workspace that falls into a part of a picture without known points, before it is said."""
NOISY = 2.5
"""Times the noise of the other cameras."""
TOO_MUCH_CALIBRATION, LITTLE_CALIBRATION, MUCH_KNOWN = 0.5, 0.2, 0.3
"""Parts of the variance from which advice follows."""
NEW_POINTS = 2
KIND_WORDS = {
    "aspect": ", pixels that are not square",
    "crop": ", a picture that is not about its axis",
    "free": ", tilted sensor or oblique window",
}
"""Kind of a camera -> what it is besides an ordinary one."""


@dataclass(frozen=True, eq=False)
class CameraPage:
    """What one camera saw when it was calibrated.

    Attributes:
        name: Its name.
        lens: What was chosen for it, in words.
        size: (2, 2) the first and the last (u, v) of its picture.
        uv: (n, 2) pixels of the known points that it saw.
        residual: (n, 2) pixels less what the calibration predicts of the known positions.
        contradiction: (n,) px, how far each view is from where all cameras together measure the point; where only one
            other sees it, from what is predicted. Errors of the known positions do not count here.
        used: (n,) which of them the fit uses.
        points: (n,) their names.
        noise: Sd of a view, px.
        workspace: (m, 2) where it sees the grid over the workspace.
    """

    name: str
    lens: str
    size: tuple[Floats, Floats]
    uv: Floats
    residual: Floats
    contradiction: Floats
    used: Bools
    points: Names
    noise: float
    workspace: Floats

    @property
    def covered(self) -> float:
        """The part of its picture, in ninths, where it saw known points."""
        return len({(int(a), int(b)) for a, b in self.cells(self.uv)}) / CELLS**2

    @property
    def rms(self) -> float:
        """Of the residuals of the views used, px per axis."""
        return float(np.sqrt(np.mean(self.residual[self.used] ** 2))) if self.used.any() else float("nan")

    def cells(self, uv: Floats) -> NDArray[np.int64]:
        """(n, 2) row and column of the ninth of the picture that pixels are in.

        Args:
            uv: (n, 2).
        """
        low, high = self.size
        share = np.clip((uv - low) / (high - low), 0, 1 - 1e-9)
        return np.asarray((CELLS * share[:, ::-1]).astype(np.int64))


@dataclass(frozen=True, eq=False)
class Region:
    """The budget of one part of the workspace.

    Attributes:
        name: Of the part.
        places: How many places of the grid.
        sd: Standard uncertainty of a position, per axis, length unit.
        parts: (sources,) the same of each of `SOURCES` alone.
    """

    name: str
    places: int
    sd: float
    parts: Floats

    @property
    def shares(self) -> Floats:
        """(sources,) parts of the variance."""
        return np.asarray(self.parts**2 / self.sd**2)


@dataclass(frozen=True, eq=False)
class Instrument:
    """A calibration as a measuring instrument.

    Attributes:
        calibration: It.
    """

    calibration: RigCalibration

    @property
    def unit(self) -> str:
        """The length unit."""
        return self.calibration.data.length_unit

    @cached_property
    def axes(self) -> tuple[Floats, Floats, Floats]:
        """x, y and z of the grid over the box of the known points."""
        known = self.calibration.data.xyz
        low, high = np.nanmin(known, axis=0), np.nanmax(known, axis=0)
        ends = zip(low, high, strict=True)
        x, y, z = (np.linspace(a, b, PLACES_PER_AXIS if b > a else 1) for a, b in ends)
        return x, y, z

    @cached_property
    def places(self) -> Floats:
        """(n, 3) the grid."""
        return np.stack(np.meshgrid(*self.axes, indexing="ij"), axis=-1).reshape(-1, 3)

    @cached_property
    def seen(self) -> Bools:
        """(n, calibrated cameras) which see the places."""
        rig = self.calibration.map
        return are_on_image(rig.trained, rig.predict(self.places))[:, list(rig.cameras)]

    @cached_property
    def variance(self) -> Floats:
        """(n, sources) of the places, mean over the axes; NaN where fewer than two cameras see one."""
        return self.calibration.map.budget(self.places, self.seen).variance

    @cached_property
    def sd(self) -> Floats:
        """(n,) standard uncertainty of a position, root of the mean over the axes."""
        return np.asarray(np.sqrt(self.variance.sum(axis=1)))

    @cached_property
    def regions(self) -> list[Region]:
        """The budget of all places, of the inner half, of what is outside it, and by distance from the cameras."""
        off = np.abs(self.places - self.places.mean(axis=0)) / np.maximum(np.ptp(self.places, axis=0) / 2, 1e-300)
        inner = (off < 0.5 + 1e-9).all(axis=1)
        centres = np.array(list(self.calibration.centres().values()))
        depth = np.linalg.norm(self.places[:, None] - centres[None], axis=2).mean(axis=1)
        labels = tercile_labels(np.round(depth, 9))
        found = [("all", np.ones(len(inner), dtype=np.bool_)), ("inner half", inner), ("outside it", ~inner)]
        found += [(f"depth: {name}", labels == name) for name in ("near", "middle", "far")]
        return [region for name, part in found if (region := self._region(name, part)) is not None]

    def _region(self, name: str, part: Bools) -> Region | None:
        rows = self.variance[part & np.isfinite(self.sd)]
        if not len(rows):
            return None
        parts = np.sqrt(np.maximum(rows.mean(axis=0), 0))
        return Region(name, len(rows), float(np.sqrt(rows.sum(axis=1).mean())), parts)

    @cached_property
    def cameras(self) -> list[CameraPage]:
        """What each calibrated camera saw."""
        return list(self._camera_pages())

    def _camera_pages(self) -> Iterator[CameraPage]:
        calibration, rig = self.calibration, self.calibration.fitted_map  # no camera had moved then
        observations = calibration.data.observations
        predicted, workspace = rig.predict(calibration.data.xyz), calibration.map.predict(self.places)
        rejected = {(one.point, one.camera) for one in calibration.rejected}
        fitted = calibration.cameras
        measured = rig.predict(rig.measure(observations).xyz)
        enough = observations.seen.sum(axis=1) >= 3
        for row, c in enumerate(rig.cameras):
            name = rig.trained.camera_names[c]
            k = observations.camera_names.index(name) if name in observations.camera_names else None
            bounds = image_bounds(rig.trained, c)
            if k is None or bounds is None or not len(calibration.data):
                continue
            at = rig.trained.camera_names.index(name)
            rows = np.flatnonzero(observations.seen[:, k] & np.isfinite(predicted[:, at]).all(axis=1))
            model = rig.posterior.models[row]
            described = fitted[name].lens
            lens = "no lens model" if described is None or model.family == "none" else described.family
            yield CameraPage(
                name,
                f"{lens}{KIND_WORDS.get(model.family, '')}",
                bounds,
                observations.uv[rows, k],
                observations.uv[rows, k] - predicted[rows, at],
                np.linalg.norm(
                    observations.uv[rows, k] - np.where(enough[rows, None], measured[rows, at], predicted[rows, at]),
                    axis=1,
                ),
                np.array([(str(observations.points[i]), name) not in rejected for i in rows], dtype=np.bool_),
                observations.points[rows],
                model.noise,
                workspace[self.seen[:, row], at],
            )

    @cached_property
    def frusta(self) -> dict[str, Floats]:
        """Camera -> (5, 3): its centre, and where it sees the corners of its picture, as far away as the known points;
        of cameras that see all corners."""
        rig, found = self.calibration.map, {}
        middle = np.nanmean(self.calibration.data.xyz, axis=0)
        for c, name in zip(rig.cameras, rig.camera_names, strict=True):
            bounds = image_bounds(rig.trained, c)
            if bounds is None:
                continue
            (u0, v0), (u1, v1) = bounds
            centre, rays = rig.lines_of_sight(name, np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]]))
            corners = centre + np.linalg.norm(middle - centre) * rays
            if np.isfinite(corners).all():
                found[name] = np.concatenate([centre[None], corners])
        return found

    @cached_property
    def worst(self) -> int:
        """The place that is measured least exactly."""
        return int(np.nanargmax(self.sd))

    @cached_property
    def sd_with_new_points(self) -> float:
        """The standard uncertainty at the worst place, if `NEW_POINTS` known points were there."""
        rig = self.calibration.map
        mine = self.seen[self.worst]
        before, after = [], []
        for part in rig.sensitivities(self.places[self.worst : self.worst + 1]):
            rows = np.repeat([mine[rig.cameras.index(c)] for c in part.cameras], 2)
            before.append(_place(part, rows, 0))
            after.append(_place(part, rows, NEW_POINTS))
        sizes = [float(np.trace(np.linalg.inv(sum(parts))) / 3) for parts in (before, after)]
        labels = max(float(np.nansum(self.variance[self.worst])) - sizes[0], 0.0)
        return float(np.sqrt(sizes[1] + labels))

    def advice(self) -> list[str]:
        """What would make it better, in sentences."""
        return [*self._about_pictures(), *self._about_noise(), *self._about_sources()]

    def _about_pictures(self) -> Iterator[str]:
        for page in self.cameras:
            cells, places = page.cells(page.uv), page.cells(page.workspace)
            for row in range(CELLS):
                for column in range(CELLS):
                    where = CELL_NAMES[row][column]
                    here = (cells == (row, column)).all(axis=1)
                    wanted = float((places == (row, column)).all(axis=1).mean()) if len(places) else 0.0
                    if not here.any() and wanted > MIN_PLACES_MISSED:
                        yield (
                            f"{page.name} saw no known point in the {where} of its picture, where {percent(wanted)} "
                            "of the workspace falls: put some there."
                        )
                    if here.sum() < MIN_VIEWS_IN_CELL:
                        continue
                    median, lost = float(np.nanmedian(page.contradiction[here])), float(1 - page.used[here].mean())
                    if median > SUSPECT_NOISE * page.noise or lost > SUSPECT_SHARE:
                        yield (
                            f"{page.name} is off by {number(median, 2)} px (median) in the {where} of its picture, and "
                            f"{percent(lost)} of its views there are not used: look for a smudge, a reflection, or "
                            "something in the way."
                        )

    def _about_noise(self) -> Iterator[str]:
        noise = np.array([page.noise for page in self.cameras])
        for c, page in enumerate(self.cameras):
            others = np.delete(noise, c)
            if len(others) > 1 and page.noise > NOISY * np.median(others):
                yield (
                    f"The views of {page.name} scatter by {number(page.noise, 2)} px, those of the others by "
                    f"{number(float(np.median(others)), 2)} px: look at its focus, light and mounting."
                )

    def _about_sources(self) -> Iterator[str]:
        if not self.regions:
            return
        share = dict(zip(SOURCES, self.regions[0].shares, strict=True))
        unknown = share["lens and pose"] + share["lens misfit"]
        if share["known positions"] > MUCH_KNOWN:
            yield (
                f"{percent(share['known positions'])} of the variance comes from errors of the known positions "
                "themselves: a better target or positioner would help most."
            )
        if unknown < LITTLE_CALIBRATION and share["known positions"] < MUCH_KNOWN:
            yield (
                f"More known points would hardly help: {percent(share['pixel noise'])} of the variance is pixel noise "
                "of the views that measure. Larger targets, better light, more cameras or longer lenses would."
            )
        usual, worst = self.regions[0].sd, float(self.sd[self.worst])
        x, y, z = (number(float(value)) for value in self.places[self.worst])
        if self.sd_with_new_points < 0.8 * worst:
            yield (
                f"{NEW_POINTS} more known points near ({x}, {y}, {z}) would lower the worst standard uncertainty from "
                f"{number(worst, 2)} to {number(self.sd_with_new_points, 2)} {self.unit} (usual: {number(usual, 2)})."
            )
        elif worst > 2 * usual:
            cameras = int(self.seen[self.worst].sum())
            yield (
                f"The worst place is ({x}, {y}, {z}), with {number(worst, 2)} {self.unit} from {cameras} cameras "
                f"(usual: {number(usual, 2)}); more known points would not mend it, another camera would."
            )
        blind = float(np.mean(~np.isfinite(self.sd)))
        if blind > 0:
            yield f"{percent(blind)} of the box of the known points is seen by fewer than two cameras."


def _place(part: Sensitivity, rows: Bools, count: int) -> Floats:
    """(3, 3) information about a place from some cameras, after so many known points there."""
    own = (part.rest + part.noise)[0][rows]
    half, slope = part.half[0][rows], part.slope[0][rows]
    unknown = half @ half.T
    if count and len(own):
        unknown = unknown - unknown @ np.linalg.solve(unknown + np.diag(own / count), unknown)
    return np.asarray(slope.T @ np.linalg.solve(unknown + np.diag(own), slope), dtype=np.float64)
