"""A wand of two or three bright markers on a darker ground: balls, discs, lamps; and which of them is which end.

A marker is a bright spot (detect/blobs.py) or, where it is larger, a disc with a whole edge (detect/edge.py). Which end
a marker is must be seen in each picture alone, by something that both cameras see alike: the larger ball is `a`, or the
brighter one; of three markers on a line the end nearer to the middle one. A wand that points towards a camera changes
the ratio of sizes and of spacings, so a ratio near one says nothing, and that picture is left out. So is one with a
marker too many: a wand named the wrong way round is worse than none.

A second look at all pictures drops what stays at its place in picture after picture, and learns the usual ratio: what
is less than half of it, as the logarithm, is not sure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from implicam.dataset import Dataset, Floats
from implicam.dataset.wand import FRAME, MARKER, Wand
from implicam.detect.blobs import find_spots, measure_spots
from implicam.detect.edge import Edge, find_rough_edge, fit_edge
from implicam.detect.model import Detected, DetectorBase, View, nothing
from implicam.errors import UsageError, did_you_mean
from implicam.images import Grey, opencv
from implicam.registry import Option

ENDS, MIDDLE = ("a", "b"), "m"
"""Names of the markers: the ends as `simulate` names them, and the third between them."""

TOLD_BY = ("size", "brightness", "spacing")
"""What tells the ends apart: the larger or brighter marker is `a`; of three, the end nearer to the middle one."""

SCALES_PX = (1.5, 2.1)
"""Scales of the spots that are looked for, in pixels of a picture that is halved again and again."""

MIN_CONTRAST, MIN_CONTRAST_RATIO = 0.06, 0.2
"""A marker is so much brighter than its surroundings, as a part of full scale, and of the brightest spot's contrast."""

MIN_EDGE_RADIUS_PX = 4.0
"""Radius from which a marker is measured by its edge; smaller ones by their centroid."""

MAX_PLACES, MAX_MARKERS = 12, 6
"""Places that are measured in a picture, and markers among them that are judged."""

MIN_AXIS_RATIO, MIN_EDGE_SHARE, MAX_BROKEN_SHARE, MAX_RESIDUAL_STEPS = 0.6, 0.7, 0.25, 0.15
"""Of a marker's outline (a ball at the rim of a wide lens, or a moving one, is an ellipse): shorter over longer axis,
part of the edge that must be seen, part that may be broken, and what the fit may leave over, of the step."""

RIVAL_RATIO = 0.5
"""One marker too many has so much of the step at the edge of the faintest that is needed."""

MIN_RATIO = 1.15
"""Of the sizes, brightnesses or spacings that tell the ends apart, before the usual one is known."""

MAX_SPREAD = 0.5
"""Sd of the logarithm of that ratio over its usual size: with more, single pictures would be named the wrong way."""

MAX_BEND = 0.04
"""How far the middle marker may be from the straight line between the ends, over the distance of these."""

SAME_PLACE_PX, MIN_STILL_PICTURES, MIN_STILL_SHARE = 1.5, 3, 0.15
"""What is within so many pixels in so many pictures of a camera, and in such a part of them, does not move."""


class Spot(NamedTuple):
    """A marker, or what looks like one: its middle and the standard uncertainties in pixels, its radius in pixels, and
    the step at its edge, as a part of full scale."""

    u: float
    v: float
    sd_u: float
    sd_v: float
    radius: float
    step: float

    @property
    def at(self) -> str:
        """For a sentence."""
        return f"({self.u:.0f}, {self.v:.0f})"


@dataclass(frozen=True, eq=False)
class WandMarkers(DetectorBase):
    """Detector of the markers of a wand.

    markers: 2 or 3, on a line. told_by: one of `TOLD_BY`. dark: markers darker than what is behind them. smallest,
    largest: their radii in pixels. length: between the ends, in the dataset's unit; 0 where it is told later.
    """

    markers: int = 2
    told_by: str = "size"
    dark: bool = False
    smallest: float = 1.5
    largest: float = 60.0
    length: float = 0.0

    def __post_init__(self) -> None:
        if self.markers not in (2, 3):
            raise UsageError(f"a wand of {self.markers} markers is not known.", fix="--markers 2 or 3")
        if self.told_by not in TOLD_BY:
            raise UsageError(
                f"the ends are not told apart by {self.told_by!r}{did_you_mean(self.told_by, TOLD_BY)}.",
                fix=f"--told-by {'|'.join(TOLD_BY)}",
            )
        if (self.told_by == "spacing") != (self.markers == 3):
            raise UsageError(
                f"{self.markers} markers are not told apart by {self.told_by}.",
                why="it takes a third marker, nearer to one end, and then its place tells more than sizes do",
                fix="--markers 3 --told-by spacing, or --markers 2 --told-by size",
            )
        if not 1 <= self.smallest < self.largest:
            raise UsageError(
                f"markers from {self.smallest:g} to {self.largest:g} pixels in radius are not possible.",
                fix="give radii of 1 pixel or more, the smallest first",
            )

    @classmethod
    def from_options(
        cls,
        dataset: Path,
        described: Mapping[str, Any],
        *,
        markers: Annotated[int | None, Option("2 (default), or 3 on a line", "N")] = None,
        told_by: Annotated[str | None, Option("which end is which: size, brightness, spacing", "NAME")] = None,
        dark: Annotated[bool, Option("they are darker than what is behind them")] = False,
        smallest: Annotated[float | None, Option("least radius in pixels", "PX")] = None,
        largest: Annotated[float | None, Option("largest radius in pixels", "PX")] = None,
        length: Annotated[float | None, Option("between the ends, in the dataset's unit", "LENGTH", 0)] = None,
    ) -> WandMarkers:
        """Make the detector from the options of the command line.

        Args:
            dataset: The dataset's folder; nothing of it is used here.
            described: The table [target] of dataset.toml.
            markers: 2, or 3 on a line; None for 2, or for 3 where they are told apart by spacing.
            told_by: One of `TOLD_BY`; None for size, or for spacing of three markers.
            dark: Markers darker than what is behind them.
            smallest: Least radius in pixels; None for 1.5.
            largest: Largest radius in pixels; None for 60.
            length: Between the ends; for dataset.toml, nothing is done with it here.

        Raises:
            UsageError: An option is wrong, or options exclude each other.
        """
        number = markers if markers is not None else 3 if told_by == "spacing" else 2
        how = told_by if told_by is not None else "spacing" if number == 3 else "size"
        usual = cls()
        return cls(
            int(number), str(how), bool(dark), float(smallest or usual.smallest), float(largest or usual.largest),
            float(length or 0.0),
        )  # fmt: skip

    def options(self) -> dict[str, Any]:
        """All that the results depend on."""
        return {
            "target": "wand", "markers": self.markers, "told_by": self.told_by, "dark": self.dark,
            "smallest": self.smallest, "largest": self.largest,
        }  # fmt: skip

    def describe(self) -> dict[str, Any]:
        """The wand as `calibrate` reads it, and how it was found."""
        return {**Wand(ENDS, self.length).as_table(), "markers": self.markers, "told_by": self.told_by}

    def detect(self, picture: Grey, view: View) -> Detected:
        """Find the markers in one picture.

        Args:
            picture: (height, width) grey from 0 to 1.
            view: Which picture it is; the points are SHOT-a, SHOT-b and, of three, SHOT-m.

        Returns:
            All markers, or none and why. Notes: "spots", all that looks like one.
        """
        return self._name(find_markers(1 - picture if self.dark else picture, self.smallest, self.largest), view)

    def settle(self, found: Mapping[View, Detected]) -> dict[View, Detected]:
        """Drop what does not move; leave out pictures in which the ends are told apart less clearly than usual.

        Args:
            found: What `detect` gave of each picture.
        """
        spots = {view: _spots_of(one) for view, one in found.items()}
        cameras = dict.fromkeys(view.camera for view in found)
        still = {
            camera: _find_still(np.array([s[:2] for v, own in spots.items() if v.camera == camera for s in own]),
                                sum(v.camera == camera for v in found))
            for camera in cameras
        }  # fmt: skip
        moving = {view: _without(own, still[view.camera]) for view, own in spots.items()}
        named = {
            view: self._name(moving[view], view, dropped=len(spots[view]) - len(moving[view])) if spots[view] else one
            for view, one in found.items()
        }
        ratios = np.array([one.notes["log_ratio"] for one in named.values() if "log_ratio" in one.notes])
        if not len(ratios):
            return named
        usual = float(np.median(ratios))
        spread = 1.4826 * float(np.median(np.abs(ratios - usual)))
        if spread > MAX_SPREAD * usual:
            why = (
                f"which end is which is not sure: the ratio of {_NOUN[self.told_by]} is {np.exp(usual):.2f} in the "
                "middle of all pictures and differs from picture to picture by as much: take markers that differ more, "
                "or three with --told-by spacing"
            )
            return {view: nothing(why, notes=one.notes) if len(one) else one for view, one in named.items()}
        least = float(np.exp(usual / 2))
        return {view: _drop_if_unsure(one, least, self.told_by) for view, one in named.items()}

    def correct(self, data: Dataset) -> tuple[Dataset, list[str]]:
        """Say of each point in which frame it is and which marker, as a calibration from a wand reads it.

        Args:
            data: Points named SHOT-MARKER.
        """
        parts = [str(name).rpartition("-") for name in data.points]
        columns = {
            FRAME: np.array([shot for shot, _, _ in parts], dtype=np.str_),
            MARKER: np.array([marker for _, _, marker in parts], dtype=np.str_),
        }
        return replace(data, columns={**data.columns, **columns}), []

    def _name(self, spots: Sequence[Spot], view: View, *, dropped: int = 0) -> Detected:
        """The markers by name, or why not. dropped: things that do not move and are no longer among the spots."""
        notes: dict[str, Any] = {"spots": [list(spot) for spot in spots]}
        chosen = _choose_line(spots) if self.markers == 3 else _choose_two(spots)
        if isinstance(chosen, str):
            still = f" (beside {dropped} that do not move)" if dropped else ""
            return nothing(f"{chosen}{still}", notes=notes)
        a, b = chosen[0], chosen[-1]
        ratio = _log_ratio(chosen, self.told_by)
        notes["log_ratio"] = abs(ratio)
        if abs(ratio) < np.log(MIN_RATIO):
            return nothing(_unsure(a, b, ratio, self.told_by), notes=notes)
        if ratio < 0:
            chosen = chosen[::-1]
        names = (ENDS[0], MIDDLE, ENDS[1]) if len(chosen) == 3 else ENDS
        table = np.array(chosen)
        return Detected(
            tuple(f"{view.shot}-{name}" for name in names), table[:, :2], table[:, 2:4],
            outlines=tuple(_circle(spot) for spot in chosen),
            notes=notes,
        )  # fmt: skip


_NOUN = {"size": "sizes", "brightness": "brightnesses", "spacing": "spacings"}


def find_markers(picture: Grey, smallest: float, largest: float) -> list[Spot]:
    """Find all that looks like a bright marker, the clearest first.

    Args:
        picture: (height, width) grey from 0 to 1.
        smallest: Radius in pixels.
        largest: Radius in pixels.
    """
    found: list[Spot] = []
    dark = None
    for centre, radius, contrast in _find_places(picture, smallest, largest):
        if any(np.hypot(centre[0] - s.u, centre[1] - s.v) < max(s.radius, radius) for s in found):
            continue
        if radius >= MIN_EDGE_RADIUS_PX / 1.4:
            dark = 1 - picture if dark is None else dark
            spot = _measure_disc(dark, centre, radius, contrast)
        else:
            spot = None
        if spot is None and radius < 1.4 * MIN_EDGE_RADIUS_PX:
            spot = _measure_small(picture, centre, radius)
        if spot is None or not smallest <= spot.radius <= largest:
            continue
        if not any(np.hypot(spot.u - s.u, spot.v - s.v) < max(s.radius, spot.radius) for s in found):
            found.append(spot)
    return sorted(found, key=lambda spot: -spot.step)[:MAX_MARKERS]


def _find_places(picture: Grey, smallest: float, largest: float) -> list[tuple[Floats, float, float]]:
    """Rough middles (2,), radii and contrasts of round bright spots, those of most contrast first."""
    cv2 = opencv()
    places: list[tuple[Floats, float, float]] = []
    small, scale = picture, 1.0
    while np.sqrt(2) * SCALES_PX[0] * scale < 1.2 * largest and min(small.shape) > 24:
        for sigma in SCALES_PX:
            radius = float(np.sqrt(2) * sigma * scale)
            if smallest <= 1.3 * radius:
                uv, answer = find_spots(small, sigma, least=MIN_CONTRAST * DISC_ANSWER)
                places += [
                    ((at + 0.5) * scale - 0.5, radius, float(one) / DISC_ANSWER)
                    for at, one in zip(uv, answer, strict=True)
                ]
        small, scale = cv2.resize(small, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), 2 * scale
    places.sort(key=lambda place: -place[2])
    kept: list[tuple[Floats, float, float]] = []
    for place in places:
        if len(kept) >= MAX_PLACES or place[2] < MIN_CONTRAST_RATIO * places[0][2]:
            break
        if all(np.linalg.norm(place[0] - other[0]) > 0.7 * max(place[1], other[1]) for other in kept):
            kept.append(place)
    return kept


DISC_ANSWER = 2 / np.e
"""What a disc of contrast 1 answers to the Laplacian of its own scale."""


def _measure_disc(dark: Grey, centre: Floats, radius: float, contrast: float) -> Spot | None:
    """A marker by its edge, in the negative of the picture; None where it is no whole disc."""
    rough = find_rough_edge(dark, centre, radius, step=0.4 * contrast)
    edge = None if rough is None else fit_edge(dark, rough.ellipse)
    if edge is None or not _is_marker(edge):
        return None
    sd = np.sqrt(np.diagonal(edge.covariance))
    (u, v), (sd_u, sd_v) = edge.ellipse.centre.tolist(), sd.tolist()
    return Spot(u, v, sd_u, sd_v, edge.ellipse.radius, edge.outer - edge.inner)


def _is_marker(edge: Edge) -> bool:
    long, short = edge.ellipse.axes
    step = edge.outer - edge.inner
    return (
        short >= MIN_AXIS_RATIO * long
        and step > MIN_CONTRAST
        and edge.support >= MIN_EDGE_SHARE
        and edge.broken <= MAX_BROKEN_SHARE
        and edge.residual < MAX_RESIDUAL_STEPS * step
        and edge.blur < 0.6 * short
    )


def _measure_small(picture: Grey, centre: Floats, radius: float) -> Spot | None:
    """A marker of a few pixels by its centroid; None where there is none."""
    measured = measure_spots(picture, centre[None], radius / np.sqrt(2))
    if not np.isfinite(measured.uv).all():
        return None
    u, v = measured.uv[0]
    rows, columns = picture.shape
    top, left = int(np.clip(round(v) - 1, 0, rows - 3)), int(np.clip(round(u) - 1, 0, columns - 3))
    reach = int(np.ceil(3 * radius + 2))
    around = picture[max(round(v) - reach, 0) : round(v) + reach + 1, max(round(u) - reach, 0) : round(u) + reach + 1]
    step = float(picture[top : top + 3, left : left + 3].mean() - np.median(around))
    if step < MIN_CONTRAST:
        return None
    sd_u, sd_v = measured.sd[0].tolist()
    return Spot(float(u), float(v), sd_u, sd_v, float(np.sqrt(measured.area[0] / np.pi)), step)


def _choose_two(spots: Sequence[Spot]) -> list[Spot] | str:
    """The two markers, or why they are not sure; the spots are those of the highest step first."""
    if not spots:
        return "no marker: nothing round is brighter than what is around it"
    if len(spots) == 1:
        return f"one marker only, at {spots[0].at}: which end it is cannot be told"
    rivals = [spot for spot in spots[2:] if spot.step > RIVAL_RATIO * spots[1].step]
    if rivals:
        several = ", ".join(spot.at for spot in [*spots[:2], *rivals])
        return f"{2 + len(rivals)} things look like markers, at {several}: cover or remove what is none"
    return list(spots[:2])


def _choose_line(spots: Sequence[Spot]) -> list[Spot] | str:
    """The three markers on a line, from end to end, or why they are not sure."""
    if len(spots) < 3:
        return f"{len(spots)} of 3 markers: which they are cannot be told" if spots else _choose_two(spots)
    strong = [spot for spot in spots if spot.step > RIVAL_RATIO * spots[2].step]
    lines = [line for three in combinations(strong, 3) if (line := _in_line(three))]
    if len(lines) == 1:
        return lines[0]
    several = ", ".join(spot.at for spot in strong)
    if lines:
        return f"{len(lines)} threes of markers are in line, of those at {several}: cover or remove what is none"
    return f"no three markers are in line, of those at {several}"


def _in_line(three: Sequence[Spot]) -> list[Spot] | None:
    """Three markers from end to end; None where they are not in line, or nearly at one place."""
    at = np.array([spot[:2] for spot in three])
    apart = np.linalg.norm(at[:, None] - at, axis=2)
    i, j = np.unravel_index(int(np.argmax(apart)), apart.shape)
    k = 3 - int(i) - int(j)
    along = (at[j] - at[i]) / apart[i, j]
    off = at[k] - at[i]
    bend = abs(float(along[0] * off[1] - along[1] * off[0]))
    slack = max(MAX_BEND * float(apart[i, j]), 1.0)
    if bend > slack or min(apart[i, k], apart[k, j]) < 2 * slack:
        return None
    return [three[int(i)], three[k], three[int(j)]]


def _log_ratio(chosen: Sequence[Spot], told_by: str) -> float:
    """Positive where the first is `a`."""
    a, b = chosen[0], chosen[-1]
    if told_by == "spacing":
        m = chosen[1]
        return float(np.log(np.hypot(m.u - b.u, m.v - b.v) / np.hypot(m.u - a.u, m.v - a.v)))
    return float(np.log(a.radius / b.radius) if told_by == "size" else np.log(a.step / b.step))


def _differ_by(a: Spot, b: Spot, ratio: float, told_by: str) -> str:
    return (
        f"which end is which is not sure: the {_NOUN[told_by]} at {a.at} and {b.at} differ by a factor of "
        f"{np.exp(abs(ratio)):.2f} only"
    )


def _unsure(a: Spot, b: Spot, ratio: float, told_by: str) -> str:
    if told_by == "spacing":
        return _differ_by(a, b, ratio, told_by)
    return (
        f"{_differ_by(a, b, ratio, told_by)} (two equal markers: make one smaller or darker, with tape, or put a third "
        "between them, nearer to one end: --markers 3)"
    )


def _drop_if_unsure(found: Detected, least: float, told_by: str) -> Detected:
    """Without markers whose ratio is far less than usual."""
    if not len(found) or found.notes["log_ratio"] >= np.log(least):
        return found
    by_place = {(spot.u, spot.v): spot for spot in _spots_of(found)}
    a, b = (by_place[float(u), float(v)] for u, v in found.uv[[0, -1]])
    told = _differ_by(a, b, found.notes["log_ratio"], told_by)
    why = f"{told}, and in most pictures by more than {least**2:.2f}"
    return nothing(why, notes=found.notes)


def _spots_of(found: Detected) -> list[Spot]:
    return [Spot(*row) for row in found.notes.get("spots", ())]


def _find_still(uv: Floats, pictures: int) -> Floats:
    """(k, 2) where a camera sees something in picture after picture."""
    least = max(MIN_STILL_PICTURES, MIN_STILL_SHARE * pictures)
    if len(uv) < least:
        return np.zeros((0, 2))
    near: NDArray[np.int64] = cKDTree(uv).query_ball_point(uv, SAME_PLACE_PX, return_length=True)
    return uv[near >= least]


def _without(spots: Sequence[Spot], still: Floats) -> list[Spot]:
    if not len(still):
        return list(spots)
    return [spot for spot in spots if np.hypot(*(still - spot[:2]).T).min() > 2 * SAME_PLACE_PX]


def _circle(spot: Spot) -> Floats:
    turn = np.linspace(0, 2 * np.pi, 49)
    return np.column_stack([spot.u + spot.radius * np.cos(turn), spot.v + spot.radius * np.sin(turn)])
