"""Was a wand waved enough, and where not: cells of the picture of each camera, places of the volume, where to go next.

Before there is a calibration only counts are known: which cells of its picture a camera has seen an end of the wand in.
With one, `VolumeDesign` says what positions in the volume are off by. A wand at a place that nobody knows is seen as
`half z + K x`, x the six coordinates of its ends; its length is one row more, K = direction / jitter, half = 0. With x
eliminated its information about z is

    S = L^T L,   L = (I - Q Q^T) H,   H = half / noise,   Q an orthonormal basis of K / noise        (Schur complement)

and after it the covariance of z is (I + S)^-1. The gain of waving somewhere is by how much the weighted mean variance
of positions falls, trace(L W L^T (I + L L^T)^-1), W of `moved` (I-optimality: Atkinson, Donev & Tobias 2007, 10.6).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from implicam.active.board_coverage import third_of
from implicam.active.design_model import Bools, Places
from implicam.active.volume_design import MAX_EXCESS_PART, VolumeDesign, linear_views
from implicam.active.workspace import Workspace
from implicam.calibrators import PredictsPixels
from implicam.dataset import Camera, Dataset, Floats
from implicam.dataset.image_bounds import are_on_image
from implicam.dataset.wand import Wand, marker_rows
from implicam.formatting import decimal_number

CELLS = 6, 4
"""Of a picture, along its longer side and its shorter."""

VIEWS_PER_CELL = 3
"""Of an end of the wand, which show a cell of a camera that is not calibrated yet."""

MIN_FRAMES = 12
"""In which a camera must have seen an end of the wand before it is worth a fit."""

JUDGED_PLACES = 300
"""Of the volume."""

CANDIDATE_PLACES, WANDS_AT_PLACE = 100, 3
"""Places for the next wave, and directions of the wand at each."""

WAVED_FRAMES = 15.0
"""What a person waves at one place before looking for the next."""

POWER = 2.0
"""Of the variance that a place has now: the larger, the more the worst places count."""

MAX_UNKNOWNS_OF_CANDIDATES = 6e7
"""Numbers that the candidates take at once: of rigs with very many cameras there are fewer."""

WAVED_QUANTILES, WAVED_RIM = (0.02, 0.98), 0.05
"""Of where the wand was along each axis: between these positions have to be good, and so much of the width beyond."""


class Cells(NamedTuple):
    """A picture in cells.

    Attributes:
        known: (rows, columns) from 0, nothing, to 1, enough; NaN where the volume is not seen.
        views: (rows, columns) how often an end of the wand was there.
    """

    known: Floats
    views: Floats

    @property
    def emptiest(self) -> Floats:
        """(2,) the middle of the cell that is known least, as parts of width and height; of several that are alike the
        one farthest from what was seen."""
        lacking = np.nan_to_num(self.known, nan=np.inf)
        worst = np.argwhere(lacking <= lacking.min() + 1e-9)
        rows, columns = self.known.shape
        seen = np.argwhere(self.views > 0)
        far = np.linalg.norm(worst[:, None] - seen[None], axis=2).min(axis=1) if len(seen) else np.zeros(len(worst))
        if not len(seen):  # begin in the middle
            far = -np.linalg.norm(worst - [(rows - 1) / 2, (columns - 1) / 2], axis=1)
        row, column = worst[int(np.argmax(far))]
        return np.array([(column + 0.5) / columns, (row + 0.5) / rows])


class WavePlace(NamedTuple):
    """Where to wave next.

    Attributes:
        xyz: (3,) in the frame of the calibration; NaN where there is none.
        uv: (cameras, 2) where each sees it; NaN where it does not, or nobody knows.
        words: "lower left of cam3, 1200 mm from it".
        why: What is missing there.
        gain: By how much the weighted mean variance would fall, as a part of it; NaN where that is not known.
    """

    xyz: Floats
    uv: Floats
    words: str
    why: str
    gain: float = float("nan")


def shape_of_cells(size: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns of the cells of a picture.

    Args:
        size: Its width and height.
    """
    return (CELLS[1], CELLS[0]) if size[0] >= size[1] else CELLS


def cell_numbers(uv: Floats, size: tuple[int, int]) -> tuple[Floats, Bools]:
    """In which cell pixels are.

    Args:
        uv: (n, 2); NaN for none.
        size: Width and height of the picture.

    Returns:
        (n, 2) row and column, and (n,) which are in the picture.
    """
    rows, columns = shape_of_cells(size)
    part = (uv + 0.5) / np.array(size)
    inside = np.asarray(np.isfinite(uv).all(axis=1) & (part >= 0).all(axis=1) & (part < 1).all(axis=1))
    found = np.where(inside[:, None], np.floor(part[:, ::-1] * [rows, columns]), 0)
    return found.astype(np.intp), inside


def count_views(uv: Floats, size: tuple[int, int]) -> Floats:
    """(rows, columns) how often an end of the wand was in each cell.

    Args:
        uv: (n, 2) pixels of a camera; NaN where it did not see it.
        size: Width and height of its picture.
    """
    at, inside = cell_numbers(uv, size)
    found = np.zeros(shape_of_cells(size))
    np.add.at(found, tuple(at[inside].T), 1)
    return found


def unknown_cells(uv: Floats, size: tuple[int, int]) -> Cells:
    """The cells of a camera that is not calibrated: what it has seen.

    Args:
        uv: (n, 2) pixels of the ends of the wand in it; NaN where it did not see them.
        size: Width and height of its picture.
    """
    views = count_views(uv, size)
    return Cells(np.minimum(views / VIEWS_PER_CELL, 1.0), views)


@dataclass(frozen=True, eq=False)
class WaveDesign(VolumeDesign):
    """What a calibration from a wand knows of a volume, and what more waving would add.

    Errors are those that the calibration states: relative to the places of the wand.

    Attributes:
        wand: Its length, and how much that varies.
        target: The 95 % uncertainty that is enough, in the length unit; NaN where only the noise says what is.
    """

    wand: Wand = field(kw_only=True)
    target: float = field(kw_only=True, default=float("nan"))

    @classmethod
    def of(
        cls, rig: PredictsPixels, wand: Wand, volume: Workspace | None, *, target: float = float("nan"), seed: int = 0
    ) -> WaveDesign:
        """What a calibration knows.

        Args:
            rig: From a wand.
            wand: As the calibration used it.
            volume: Where positions have to be good, in the frame of the calibration; None for the box about
                where the wand was, as far as two cameras see it.
            target: The 95 % uncertainty that is enough there; NaN where only the noise says what is.
            seed: Of the judged places.

        Raises:
            UsageError: Hardly any place is seen by two cameras.
        """
        xyz = waved_places(rig, JUDGED_PLACES, seed) if volume is None else volume.judged(JUDGED_PLACES, seed)
        return cls(rig, Places.predicted(rig, xyz), wand=wand, target=target)

    @cached_property
    def good(self) -> Floats:
        """(g,) how good positions are at each judged place, from 0 to 1, enough: by the target where there is one, or
        by what noise alone leaves; NaN where two cameras do not see it."""
        now = self.at_judged
        by_noise = np.sqrt(1.2**2 - 1) / np.sqrt(np.maximum(now.excess**2 - 1, 1e-12))
        with np.errstate(invalid="ignore"):
            return np.asarray(np.minimum(np.fmax(by_noise, self.target / now.u95), 1.0), dtype=np.float64)

    def cells(self, c: int, uv: Floats, size: tuple[int, int]) -> Cells:
        """The cells of a calibrated camera: what is unknown of its pixels where it sees the volume.

        Args:
            c: Its number in the dataset.
            uv: (n, 2) pixels of the ends of the wand in it; NaN where it did not see them.
            size: Width and height of its picture.
        """
        unknown = self._unknown_pixels[:, c]
        at, inside = cell_numbers(self.judged.uv[:, c], size)
        total, count = np.zeros(shape_of_cells(size)), np.zeros(shape_of_cells(size))
        rows = inside & np.isfinite(unknown)
        np.add.at(total, tuple(at[rows].T), unknown[rows])
        np.add.at(count, tuple(at[rows].T), 1)
        enough = np.zeros(total.shape)
        np.add.at(enough, tuple(at[rows].T), np.nan_to_num(self.good[rows]) >= 1)
        with np.errstate(invalid="ignore", divide="ignore"):
            known = np.fmax(MAX_EXCESS_PART / np.sqrt(total / count), enough / count >= 1)
        known = np.where(count > 0, np.minimum(known, 1.0), np.nan)
        return Cells(known, count_views(uv, size))

    def next_places(self, count: int = 3, seed: int = 0, avoided: Sequence[Floats] = ()) -> list[WavePlace]:
        """Where to wave next, the best first, each as if the ones before it were waved at.

        Args:
            count: How many, at most.
            seed: Of the places that are tried.
            avoided: (3,) places, near which nobody can or wants to go.
        """
        rng = np.random.default_rng([seed, 23])
        xyz, ends = self._candidates(rng)
        if not len(xyz):
            return []
        now = self.at_judged
        variance = np.trace(now.total, axis1=1, axis2=2)[self._counted]
        if not np.isfinite(self.target):
            variance = variance / np.trace(now.floor, axis1=1, axis2=2)[self._counted]
        weights = (variance / variance.max()) ** (POWER - 1)
        if not np.isfinite(self.target):
            weights = weights / np.trace(now.floor, axis1=1, axis2=2)[self._counted]
        moved = self._moved[0] * np.sqrt(weights / len(weights))[:, None, None]
        M = moved.reshape(-1, moved.shape[2])
        whole = float(np.sum(M**2))
        L = self._told(ends) * np.sqrt(WAVED_FRAMES / WANDS_AT_PLACE)  # (m, rows, q)
        far = [np.linalg.norm(xyz - one, axis=1) < 0.15 * np.linalg.norm(np.ptp(xyz, axis=0)) for one in avoided]
        blocked = np.any(far, axis=0) if far else np.zeros(len(xyz), dtype=np.bool_)
        found = []
        for _ in range(count):
            gains = np.where(blocked, 0.0, _gains(L, M))
            i = int(np.argmax(gains))
            if not gains[i] > 0:
                break
            found.append(self._place(xyz[i], float(gains[i]) / whole))
            _, s, Vt = np.linalg.svd(L[i], full_matrices=False)
            shrink = Vt.T * (1 - 1 / np.sqrt(1 + s**2))
            M, L = M - (M @ shrink) @ Vt, L - (L @ shrink) @ Vt
            blocked[i] = True
        return found

    def _candidates(self, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Places (m, 3) of the volume, and the ends (m, k, 2, 3) of wands there, in different directions."""
        q, R = self._at_judged.half.shape[2], self._at_judged.half.shape[1]
        most = max(20, int(MAX_UNKNOWNS_OF_CANDIDATES / (q * (2 * R + 1) * WANDS_AT_PLACE)))
        places = self.judged.xyz[self._counted]
        places = places[rng.permutation(len(places))[: min(CANDIDATE_PLACES, most)]]
        frames = np.linalg.qr(rng.normal(size=(len(places), 3, 3)))[0]  # directions at right angles
        half = 0.5 * self.wand.length * frames[:, :WANDS_AT_PLACE]
        middle = places[:, None]
        ends = np.stack([middle - half, middle + half], axis=2)
        return places, ends

    def _told(self, ends: Floats) -> Floats:
        """(m, k rows, q) L of the wands at each place; zero where two cameras do not see both ends."""
        m, k = ends.shape[:2]
        flat = ends.reshape(-1, 3)
        there = are_on_image(self.rig.trained, self.rig.predict(flat))
        both = there.reshape(m * k, 2, -1)
        usable = (both.sum(axis=2) >= 2).all(axis=1)
        part = linear_views(self.rig, flat, there)
        weight = np.where(part.seen, 1 / part.sd, 0.0)
        R, q = weight.shape[1], part.half.shape[2]
        H = np.zeros((m * k, 2 * R + 1, q))
        H[:, : 2 * R] = (part.half * weight[..., None]).reshape(m * k, 2 * R, q)
        K = np.zeros((m * k, 2 * R + 1, 6))
        slope = (part.slope * weight[..., None]).reshape(m * k, 2, R, 3)
        K[:, :R, :3], K[:, R : 2 * R, 3:] = slope[:, 0], slope[:, 1]
        along = np.diff(ends.reshape(m * k, 2, 3), axis=1)[:, 0]
        along = along / np.linalg.norm(along, axis=1, keepdims=True) / max(self.wand.jitter, 1e-6 * self.wand.length)
        K[:, -1, :3], K[:, -1, 3:] = -along, along
        Q = np.linalg.qr(K)[0]
        L = H - Q @ (Q.swapaxes(1, 2) @ H)
        L[~usable] = 0.0
        return np.asarray(L.reshape(m, -1, q), dtype=np.float64)

    def _place(self, xyz: Floats, gain: float) -> WavePlace:
        """In words, as the two cameras that are known least there see it."""
        uv = self.rig.predict(xyz[None])
        seen = are_on_image(self.rig.trained, uv)[0]
        uv = np.where(seen[:, None], uv[0], np.nan)
        names, unit = self.rig.trained.camera_names, _unit_of(self.rig)
        near = int(np.argmin(np.linalg.norm(self.judged.xyz - xyz, axis=1)))
        unknown = np.where(seen, np.nan_to_num(self._unknown_pixels[near]), -1.0)
        worst = int(np.argmax(unknown))
        camera = self.rig.trained.cameras[worst]
        size = np.array([camera.width or 1, camera.height or 1])
        centre, _ = self.rig.lines_of_sight(names[worst], uv[worst][None])
        away = float(np.linalg.norm(xyz - centre))
        words = f"{third_of(uv[worst] / size, names[worst])}, {decimal_number(away, 2)} {unit} from it"
        u95 = float(self.at_judged.u95[near])
        why = f"a position there is known to {decimal_number(u95, 2)} {unit}"
        if np.isfinite(self.target):
            why += f", and {decimal_number(self.target, 2)} {unit} is wanted" * (u95 > self.target)
        else:
            times = float(self.at_judged.excess[near])
            why += f", {decimal_number(times, 3)} times what pixel noise alone leaves"
        return WavePlace(xyz, uv, words, why, gain)


def _gains(L: Floats, M: Floats) -> Floats:
    """(m,) trace(L W L^T (I + L L^T)^-1) of each, W = M^T M."""
    through = L @ M.T  # (m, rows, 3 g)
    rows = L.shape[1]
    inverse = np.linalg.inv(np.eye(rows) + L @ L.swapaxes(1, 2))
    return np.asarray(np.einsum("mij,mij->m", inverse, through @ through.swapaxes(1, 2)), dtype=np.float64)


def waved_places(rig: PredictsPixels, count: int, seed: int = 0) -> Floats:
    """Places that two cameras see, in the box about where the wand was.

    Args:
        rig: A calibration from a wand.
        count: How many, at most.
        seed: Of the places.

    Returns:
        (g, 3) in the frame of the calibration.
    """
    known = rig.data.xyz
    low, high = np.quantile(known[np.isfinite(known).all(axis=1)], WAVED_QUANTILES, axis=0)
    rim = WAVED_RIM * (high - low)
    xyz = np.random.default_rng([seed, 22]).uniform(low - rim, high + rim, size=(8 * count, 3))
    inside = are_on_image(rig.trained, rig.predict(xyz)).sum(axis=1) >= 2
    return np.asarray(xyz[inside][:count], dtype=np.float64)


def unseen_place(cameras: Sequence[Camera], cells: Sequence[Cells], c: int) -> WavePlace:
    """Where to wave for a camera of which nothing but its picture is known.

    Args:
        cameras: With the sizes of their pictures.
        cells: Of all cameras.
        c: Number of the camera.
    """
    camera = cameras[c]
    part = cells[c].emptiest
    uv = np.full((len(cameras), 2), np.nan)
    if camera.width and camera.height:
        uv[c] = part * [camera.width, camera.height] - 0.5
    seen = int((cells[c].views > 0).sum())
    why = f"{camera.name} has not seen the wand there yet" if seen else f"{camera.name} has not seen the wand yet"
    words = f"{third_of(part, camera.name)}, where another camera sees it too"
    return WavePlace(np.full(3, np.nan), uv, words, why)


def ends_of(data: Dataset, wand: Wand) -> Floats:
    """(F, 2, cameras, 2) pixels of both ends in the frames of the wand; NaN where not seen.

    Args:
        data: Markers in frames.
        wand: Names of its ends, where there are other markers.

    Raises:
        DatasetError: The points are no markers in frames.
    """
    _, rows = marker_rows(data, wand.ends)
    uv = np.where((rows >= 0)[..., None, None], data.observations.uv[rows], np.nan)
    return uv[(rows >= 0).all(axis=1)]


def _unit_of(rig: PredictsPixels) -> str:
    return rig.data.length_unit
