"""The search for the dots of one picture: match, fit a camera, predict, until nothing changes.

The labels give a first camera; it predicts where the other dots must be, those nearest to the labels best. Where the
prediction is sure enough to tell a dot from the next one, the spot that is there gets the name; the camera is fitted
again. Dots that the others contradict are dropped.

The camera is a projective one with a smooth departure from it (water, glass, a lens), as one Gaussian process
(`projective.py`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from implicam.dataset import Floats
from implicam.detect.blobs import MIN_STRENGTH_RATIO, find_scale, find_spots, measure_spots
from implicam.detect.labels import MIN_LABELS
from implicam.detect.model import Detected
from implicam.detect.projective import Departure, ProjectiveProcess, fit_affine
from implicam.formatting import list_some
from implicam.images import Grey

Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]

MAX_CLICK_PX = 3.5
"""Pixels from a label to the spot that is meant."""

MIN_SEPARATION_SDS = 2.0
"""Standard deviations of a prediction that must stay within the way to the next dot."""

MAX_OFFSET_SPACINGS = 0.4
"""Of the distance to the next dot: a spot farther from its prediction may be that dot."""

MAX_ASTRAY_RATIO = 6.0
"""A dot so many times farther from what the others predict than they are from theirs is none."""

TOLERATED_OFFSET_PX, TOLERATED_OFFSET_SCALES = 1.0, 1.0
"""The larger of the two is an offset from what the others predict for which no dot is dropped: targets are
drilled by hand, and a glint at its rim draws a dot's centroid there. Its uncertainty says so."""

MAX_SCATTER_SPACINGS = 0.05
"""Median distance of dots from what the others predict, as a part of the way to the next dot, that is no fit."""

MAX_ROUNDS = 25


class _Prediction(NamedTuple):
    """Pixels (n, 2) and their standard uncertainties (n,)."""

    uv: Floats
    sd: Floats


class _Camera:
    """The process of one camera (`projective.py`), with the most probable of a few departures."""

    def __init__(self, xyz: Floats, uv: Floats, sd: Floats) -> None:
        """From dots seen; with few of them, the departure is one per cent of the target's size."""
        theta = fit_affine(xyz, uv)
        best = ProjectiveProcess.condition(xyz, uv, sd**2, theta, Departure(0.01, 1.0, 0.001))
        if len(xyz) >= MIN_DOTS_FOR_DEPARTURE:
            some = np.random.default_rng(0).permutation(len(xyz))[:MAX_DOTS_FOR_DEPARTURE]
            trials = [
                ProjectiveProcess.condition(
                    xyz[some], uv[some], sd[some] ** 2, best.theta, Departure(bend, reach, slack), turns=1
                )
                for bend in (0.001, 0.004, 0.016)
                for reach in (0.7, 1.5)
                for slack in (0.0002, 0.001, 0.004)
            ]
            departure = max(trials, key=lambda trial: trial.evidence).departure
            best = ProjectiveProcess.condition(xyz, uv, sd**2, best.theta, departure)
        self.process = best

    def predict(self, xyz: Floats) -> _Prediction:
        uv, covariance = self.process.predict(xyz)
        return _Prediction(uv, np.sqrt(np.einsum("nii->n", covariance) / 2))

    def leave_one_out(self) -> _Prediction:
        uv, covariance = self.process.leave_one_out()
        return _Prediction(uv, np.sqrt(np.einsum("nii->n", covariance) / 2))


MIN_DOTS_FOR_DEPARTURE, MAX_DOTS_FOR_DEPARTURE = 12, 120
"""Dots from which the departure can be told, and so many of them as suffice for it."""


class DotSearch:
    """The search for the dots of one picture; `to` (n,) is the spot of each dot, -1 for none.

    Begin it with `begin`, let it `grow`, and ask for `explain_doubt` and `result`. After `grow`, `uv` (n, 2) and `sd`
    (n,) are where each dot must be by what the others say, in pixels.
    """

    def __init__(self, picture: Grey, sigma: float, names: Sequence[str], xyz: Floats) -> None:
        self.picture, self.sigma, self.names = picture, sigma, names
        middle = xyz.mean(axis=0)
        self.xyz = (xyz - middle) / (np.sqrt(np.mean(np.sum((xyz - middle) ** 2, axis=1))) or 1.0)
        self.rough, self.answer = find_spots(picture, sigma)
        self.tree = cKDTree(self.rough.reshape(-1, 2)) if len(self.rough) else None
        self.measured: dict[int, tuple[Floats, Floats, float]] = {}
        self.tolerated = max(TOLERATED_OFFSET_PX, TOLERATED_OFFSET_SCALES * sigma)
        self.to = np.full(len(xyz), -1)
        self.labelled: list[int] = []
        self.meant: dict[int, int] = {}
        self.lost: list[int] = []
        self.off: set[int] = set()

    @classmethod
    def begin(
        cls,
        picture: Grey,
        names: Sequence[str],
        xyz: Floats,
        marks: Mapping[int, tuple[float, float]],
        polarity: str = "auto",
        *,
        least: int = MIN_LABELS,
    ) -> DotSearch | str:
        """Begin with the spots that labels name, or say why there is no beginning.

        Args:
            picture: (height, width) grey from 0 to 1.
            names: Of n dots.
            xyz: (n, 3) where they are on the target.
            marks: Row -> the pixel (u, v) of its label.
            polarity: "bright" dots, "dark" ones, or "auto", what most labels show.
            least: So many labels it takes.
        """
        rows, uv = np.array(list(marks)), np.array(list(marks.values()))
        inside = ((uv > -0.5) & (uv < np.array(picture.shape)[::-1] - 0.5)).all(axis=1)
        outside = [names[row] for row in rows[~inside]]
        rows, uv = rows[inside], uv[inside]
        if len(rows) < least:
            return (
                f"the labels {list_some(outside)} lie outside the picture, which is {picture.shape[1]} x "
                f"{picture.shape[0]} pixels: correct them, or check that this is the picture they belong to"
            )
        picture = 1 - picture if polarity == "dark" else picture
        sigma, answers = find_scale(picture, uv, _largest_scale(xyz, rows, uv))
        if polarity == "auto" and np.nansum(answers) < 0:
            picture = 1 - picture
        search = cls(picture, sigma, names, xyz)
        search._match_labels(rows, uv)
        if len(search.labelled) < least:
            return (
                f"no dot where the labels {list_some([names[row] for row in search.lost])} are, and it takes "
                f"{least} labels that lie on dots: click within two pixels of dots that this picture shows, "
                "and check that it is sharp and not turned"
            )
        return search

    def _find_near(self, uv: Floats, within: float) -> list[int]:
        """The spots near a pixel that are not much fainter than the brightest of them, as measured."""
        found = [] if self.tree is None else self.tree.query_ball_point(uv, within + self.sigma)
        self._measure(found)
        found = [k for k in found if np.linalg.norm(self.measured[k][0] - uv) <= within]
        least = MIN_STRENGTH_RATIO * max((self.answer[k] for k in found), default=0.0)
        return [k for k in found if self.answer[k] >= least]

    def _measure(self, spots: Sequence[int]) -> None:
        new = [k for k in spots if k not in self.measured]
        if not new:
            return
        found = measure_spots(self.picture, self.rough[new], self.sigma)
        for i, k in enumerate(new):
            self.measured[k] = (found.uv[i], found.sd[i], float(found.area[i]))

    def _match_labels(self, rows: Ints, uv: Floats) -> None:
        for row, pixel in zip(rows, uv, strict=True):
            near = self._find_near(pixel, max(MAX_CLICK_PX, self.sigma * np.sqrt(2)))
            near = [k for k in near if k not in self.to]
            if near:
                self.meant[int(row)] = self.to[row] = max(near, key=lambda k: self.answer[k])
                self.labelled.append(int(row))
            else:
                self.lost.append(int(row))

    def grow(self) -> None:
        """Match, fit, predict, until nothing changes."""
        before: set[bytes] = set()
        while len(before) < MAX_ROUNDS and self.to.tobytes() not in before:
            before.add(self.to.tobytes())
            self._fit()
            self._drop()
            self._add()
        self._fit()

    def _fit(self) -> None:
        """Fit the camera to the matched dots, and predict all: those it is fitted to by the others."""
        rows = np.flatnonzero(self.to >= 0)
        uv = np.array([self.measured[k][0] for k in self.to[rows]])
        sd = np.array([np.sqrt(np.mean(self.measured[k][1] ** 2)) for k in self.to[rows]])
        middle, scale = _find_frame(self.xyz[rows], uv)
        if len(rows) > MAX_DOTS_FOR_DEPARTURE:
            some = np.sort(np.random.default_rng(0).permutation(len(rows))[:MAX_DOTS_FOR_DEPARTURE])
            rows, uv, sd = rows[some], uv[some], sd[some]
        camera = _Camera(self.xyz[rows], (uv - middle) / scale, sd / scale)
        predicted, by_others = camera.predict(self.xyz), camera.leave_one_out()
        predicted.uv[rows], predicted.sd[rows] = by_others
        self.uv, self.sd = middle + scale * predicted.uv, scale * predicted.sd
        self.apart = cKDTree(self.uv).query(self.uv, k=2)[0][:, 1]
        self.sure = MIN_SEPARATION_SDS * self.sd < MAX_OFFSET_SPACINGS * self.apart

    def _distances(self) -> Floats:
        """(n,) pixels from what the others say of a dot to where it is; NaN where it is not matched."""
        out = np.full(len(self.to), np.nan)
        for row in np.flatnonzero(self.to >= 0):
            out[row] = np.linalg.norm(self.measured[int(self.to[row])][0] - self.uv[row])
        return out

    def _drop(self) -> None:
        """Forget the matches that the others contradict."""
        distance = self._distances()
        matched = self.to >= 0
        if matched.sum() < MIN_DOTS_FOR_DEPARTURE:
            return
        usual = float(np.median(distance[matched]))
        with np.errstate(invalid="ignore"):
            far = distance > np.maximum(
                np.maximum(MAX_ASTRAY_RATIO * usual, self.tolerated), 2 * MIN_SEPARATION_SDS * self.sd
            )
            far |= self.sure & (distance > MAX_OFFSET_SPACINGS * self.apart)
        far &= distance >= 0.5 * np.nanmax(distance[far], initial=0.0)  # the worst first: they push others off
        self.off |= set(np.flatnonzero(far).tolist())
        self.to[far] = -1

    def _add(self) -> None:
        """Match the dots whose places are known well enough, each with the spot that is nearest to it and no other."""
        pairs: list[tuple[float, int, int]] = []
        taken = set(self.to[self.to >= 0].tolist())
        for row in np.flatnonzero((self.to < 0) & self.sure & self.inside()):
            within = min(MAX_OFFSET_SPACINGS * self.apart[row], 2 * MIN_SEPARATION_SDS * self.sd[row] + self.tolerated)
            free = [k for k in self._find_near(self.uv[row], within) if k not in taken]
            pairs += [(float(np.linalg.norm(self.measured[k][0] - self.uv[row])), int(row), k) for k in free]
        for _, at, k in sorted(pairs):
            if self.to[at] < 0 and k not in taken:
                self.to[at] = k
                taken.add(k)

    def _displacements(self) -> Floats:
        """(n,) pixels that matched dots are off by, where that is far more than usual."""
        distance = self._distances()
        usual = float(np.nanmedian(distance))
        with np.errstate(invalid="ignore"):
            far = distance > np.maximum(MAX_ASTRAY_RATIO * usual, 2 * MIN_SEPARATION_SDS * self.sd)
        return np.where(far, distance, 0.0)

    def inside(self) -> Bools:
        """(n,) whether the picture has the place where a dot must be."""
        height, width = self.picture.shape
        return np.asarray(((self.uv > -0.5) & (self.uv < (width - 0.5, height - 0.5))).all(axis=1), dtype=np.bool_)

    def explain_doubt(self) -> str:
        """Why the labels cannot be right, or nothing: they agree with each other, and the other dots with them."""
        inside = self.inside()
        sought = inside & self.sure
        share = float(np.mean(self.to[sought] >= 0)) if sought.any() else 0.0
        scatter = float(np.nanmedian(self._distances() / self.apart))
        against = self.contradicted()
        outvoted = share >= 0.95 and bool(self.sure[inside].all()) and 3 * len(against) <= len(self.meant)
        if share >= 0.6 and scatter <= MAX_SCATTER_SPACINGS and (not against or outvoted):
            return ""
        which = f", least of all {list_some(against)}" if against and len(against) < len(self.meant) else ""
        return (
            f"the labels do not fit the layout and the dots seen{which}: {(self.to[sought] >= 0).sum()} of "
            f"{sought.sum()} dots were where they should be. Check that each label has the name of its dot and the "
            "layout the right axes, and label a few more dots"
        )

    def contradicted(self) -> list[str]:
        """The labels whose spots the other dots give another name, or none."""
        return [self.names[row] for row, spot in self.meant.items() if self.to[row] != spot]

    def result(self) -> Detected:
        """What was found; notes as those of `Dots.detect`."""
        rows = np.flatnonzero(self.to >= 0).tolist()
        kept = self.to[rows]
        uv, sd = (np.array([self.measured[k][part] for k in kept]).reshape(-1, 2) for part in (0, 1))
        odd = _offsets_by_size(uv, np.array([self.measured[k][2] for k in kept]))
        missing = {
            self.names[row]: self.uv[row].tolist() for row in np.flatnonzero((self.to < 0) & self.inside()).tolist()
        }
        return Detected(
            tuple(self.names[row] for row in rows),
            uv,
            np.hypot(sd, np.hypot(odd, self._displacements()[rows])[:, None]),
            self._explain(),
            notes={"labelled": [self.names[row] for row in self.labelled], "missing": missing, "scale": self.sigma},
        )

    def _explain(self) -> str:
        gone = self.to < 0
        inside = self.inside()
        off = gone & inside & np.isin(np.arange(len(gone)), list(self.off))
        unsure = gone & inside & ~self.sure & ~off
        counts = {
            "outside the picture": gone & ~inside,
            "a spot is near, but not where the other dots say (is the layout right there?)": off,
            "too far from the labels to be told from the next one (label a dot near them)": unsure,
            "no spot where they must be (hidden, or too faint)": gone & inside & ~off & ~unsure,
        }
        parts = [f"{which.sum()} {text}" for text, which in counts.items() if which.any()]
        said = [f"{gone.sum()} of {len(gone)} dots not found: {'; '.join(parts)}"] if parts else []
        if self.lost:
            said.append(
                f"no dot where the labels {list_some([self.names[row] for row in self.lost])} are: correct them"
            )
        return ". ".join(said)


def _find_frame(xyz: Floats, uv: Floats) -> tuple[Floats, float]:
    """Where the middle of the target is in pixels, and pixels per unit, both roughly."""
    spread = xyz - xyz.mean(axis=0)
    scale = np.sqrt(np.sum((uv - uv.mean(axis=0)) ** 2) / max(float(np.sum(spread**2)), 1e-12))
    return uv.mean(axis=0), float(scale)


def _largest_scale(xyz: Floats, rows: Ints, uv: Floats) -> float:
    """The largest scale in pixels that dots can have: a quarter of the way from one to the next."""
    pixels = (
        (np.column_stack([xyz, np.ones(len(xyz))]))
        @ np.linalg.pinv(np.column_stack([xyz[rows], np.ones(len(rows))]))
        @ uv
    )
    return float(np.clip(np.median(cKDTree(pixels).query(pixels, k=2)[0][:, 1]) / 4, 1.5, 16.0))


def _offsets_by_size(uv: Floats, area: Floats) -> Floats:
    """(n,) pixels that dots of other size than their neighbours' may be off: where a part f of a disc of radius R is
    hidden or added at its rim, its centroid moves by up to f R, by half of that as a standard deviation."""
    neighbours = cKDTree(uv).query(uv, k=min(9, len(uv)))[1]
    ratio = np.log(area) - np.log(np.median(area[neighbours], axis=1))
    usual = 1.4826 * float(np.median(np.abs(ratio)))
    part = np.minimum(np.maximum(np.abs(ratio) - 2 * usual, 0), 1)
    return np.asarray(0.5 * part * np.sqrt(area / np.pi), dtype=np.float64)
