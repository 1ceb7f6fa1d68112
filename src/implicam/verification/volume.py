"""Where the test lengths are in the measuring volume, which part of it they tell of, and where the next ones help most.

What VDI/VDE 2634 part 1 and ISO 10360-2 ask of the arrangement is a list of yes and no. Beside it an unknown error of
the instrument is taken for a smooth random field: a place counts as covered where the lengths would show most of it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.spatial.distance import cdist

from implicam.active import Workspace
from implicam.dataset import Floats
from implicam.formatting import number

MIN_LINES, MIN_LENGTHS_PER_LINE = 7, 5
LONGEST_OVER_DIAGONAL = 2 / 3
CORNER_SHARE = 0.5
"""A place is in a corner of the box where it is farther from the middle than this, of each half edge."""
DIAGONAL_ANGLE_DEG = 15.0
"""A line runs along a space diagonal if the angle is no more."""
SAME_LINE_ANGLE_DEG, SAME_LINE_OFFSET_RATIO = 5.0, 0.05
"""Lengths without the name of a line are on one if their directions and their distance from it, over the volume's
diagonal, differ by no more."""

FIELD_LENGTHSCALE_RATIO = 1 / 3
"""Over which part of the volume's diagonal errors of the instrument are alike, for what counts as covered."""
NOISE_VARIANCE_RATIO = 0.01
"""Of a length, over the variance of the error of long ones."""
STRAIN_STEP_RATIO = 0.1
"""Length of the short pieces by which local errors of scale are judged, in lengthscales."""
COVERED_SHARE = 0.5
"""A place is covered if the lengths would show so much of the variance of local errors."""
JUDGED_PLACES, CANDIDATE_PLACES, CANDIDATE_SEED = 128, 48, 0
MAX_SIZES = 3
"""Of the calibrated lengths so many, from the longest to the shortest, are tried as next ones."""
BOX_GAIN = 0.9
"""A turned box is taken if its volume is so much smaller than that of the one along the axes."""


class ArrangementCheck(NamedTuple):
    """One thing that the standards ask of the arrangement, and what was found."""

    asked: str
    found: str
    fulfilled: bool
    source: str


@dataclass(frozen=True, eq=False)
class PlacedLength:
    """A length to measure next.

    Attributes:
        ends: (2, 3) in the world.
        covered: Part of the volume that is covered with it, and those before it.
    """

    ends: Floats
    covered: float

    @property
    def middle(self) -> Floats:
        """(3,) its middle."""
        return np.asarray(self.ends.mean(axis=0))

    @property
    def direction(self) -> Floats:
        """(3,) unit vector along it."""
        step = self.ends[1] - self.ends[0]
        return np.asarray(step / np.linalg.norm(step))


@dataclass(frozen=True, eq=False)
class VolumeCoverage:
    """Where in the measuring volume the lengths are.

    Attributes:
        corners: (8, 3) of the box around the volume; neighbours differ in one bit of their number.
        volume: What it is, in words.
        ends: (n, 2, 3) of the lengths, as measured.
        lines: n names of measuring lines.
        checks: What the standards ask.
        covered: Part of the volume where the lengths would show most of an error of the instrument.
        next: Where to put the next lengths, the most helpful first.
    """

    corners: Floats
    volume: str
    ends: Floats
    lines: tuple[str, ...]
    checks: tuple[ArrangementCheck, ...]
    covered: float
    next: tuple[PlacedLength, ...]


def cover(
    workspace: Workspace, ends: Floats, lines: Sequence[str], unit: str, *, sizes: Sequence[float], count: int
) -> VolumeCoverage:
    """Judge an arrangement of lengths, and place the next ones.

    Args:
        workspace: The measuring volume.
        ends: (n, 2, 3) ends of the lengths in the world.
        lines: n names of measuring lines; empty where it is to be found.
        unit: Of length.
        sizes: Lengths that can be placed.
        count: How many to place.
    """
    corners = bounding_box(workspace)
    frame = corners[[1, 2, 4]] - corners[0]
    named = name_lines(ends, lines, float(np.linalg.norm(frame.sum(axis=0))))
    field = ErrorField(workspace, frame)
    explained = field.observe(ends)
    covered = field.covered(explained)
    return VolumeCoverage(
        corners, workspace.name, ends, named, tuple(check_arrangement(corners, ends, named, unit)), covered,
        tuple(field.place(explained, workspace, sizes, count)),
    )  # fmt: skip


def bounding_box(workspace: Workspace) -> Floats:
    """(8, 3) corners of a small box around the volume: along the axes of the world, or along one of its faces.

    Args:
        workspace: The volume.
    """
    frames = [np.eye(3)]
    points = workspace.vertices - workspace.centre
    for normal in workspace.normals:
        on_face = points[points @ normal > (points @ normal).max() - 1e-6 * workspace.size]
        for edge in np.diff(on_face[:4], axis=0):
            along = edge - normal * (normal @ edge)
            if (size := float(np.linalg.norm(along))) > 0:
                frames.append(np.stack([along / size, np.cross(normal, along / size), normal]))
    volumes = [float(np.prod(np.ptp(points @ frame.T, axis=0))) for frame in frames]
    best = int(np.argmin(volumes))
    frame = frames[best] if volumes[best] < BOX_GAIN * volumes[0] else frames[0]
    low, high = (points @ frame.T).min(axis=0), (points @ frame.T).max(axis=0)
    bits = np.array(list(product((0, 1), repeat=3)))[:, ::-1]
    return np.asarray((low + bits * (high - low)) @ frame + workspace.centre)


def name_lines(ends: Floats, names: Sequence[str], diagonal: float) -> tuple[str, ...]:
    """The names of measuring lines; lengths without one are put together where they are on one straight line.

    Args:
        ends: (n, 2, 3) ends of the lengths.
        names: n names, empty where unknown.
        diagonal: Of the volume.
    """
    lines: list[tuple[Floats, Floats, str]] = []
    found = []
    for (a, b), name in zip(ends, names, strict=True):
        along = (b - a) / np.linalg.norm(b - a)
        if not name:
            for start, direction, line in lines:
                off = np.cross(np.stack([a, b]) - start, direction)
                parallel = abs(along @ direction) > np.cos(np.radians(SAME_LINE_ANGLE_DEG))
                if parallel and np.linalg.norm(off, axis=1).max() < SAME_LINE_OFFSET_RATIO * diagonal:
                    name = line
                    break
            else:
                name = f"line {len(lines) + 1}"
                lines.append((a, along, name))
        found.append(name)
    return tuple(found)


def check_arrangement(corners: Floats, ends: Floats, lines: Sequence[str], unit: str) -> list[ArrangementCheck]:
    """What VDI/VDE 2634 part 1 and ISO 10360-2 ask of the arrangement; sources of what is asked: docs/verify.md.

    Args:
        corners: (8, 3) of the box around the volume.
        ends: (n, 2, 3) of the lengths.
        lines: n names of lines.
        unit: Of length.
    """
    vdi, iso = "VDI/VDE 2634-1", "ISO 10360-2"
    edges = corners[[1, 2, 4]] - corners[0]
    sides, diagonal = np.linalg.norm(edges, axis=1), float(np.linalg.norm(edges.sum(axis=0)))
    steps = ends[:, 1] - ends[:, 0]
    sizes = np.linalg.norm(steps, axis=1)
    count = Counter(lines)
    longest = {line: max(size for size, name in zip(sizes, lines, strict=True) if name == line) for line in count}
    enough = sum(n >= MIN_LENGTHS_PER_LINE for n in count.values())
    long = sum(size >= sides.min() for size in longest.values())
    middle = corners.mean(axis=0)
    inside = (ends.reshape(-1, 3) - middle) @ (edges / sides[:, None] ** 2).T * 2
    in_corner = (np.abs(inside) > CORNER_SHARE).all(axis=1)
    reached = {tuple(signs) for signs in np.sign(inside[in_corner]).tolist()}
    diagonals = edges.sum(axis=0) - 2 * np.vstack([np.zeros(3), edges])
    cosines = np.abs(steps @ (diagonals / np.linalg.norm(diagonals, axis=1)[:, None]).T) / sizes[:, None]
    along = int((cosines > np.cos(np.radians(DIAGONAL_ANGLE_DEG))).any(axis=0).sum())
    part = float(sizes.max()) / diagonal
    found = [
        ArrangementCheck(
            f"{MIN_LINES} measuring lines or more", f"{len(count)}", len(count) >= MIN_LINES, f"{vdi}, {iso}"
        ),
        ArrangementCheck(
            f"{MIN_LENGTHS_PER_LINE} test lengths or more on each line", f"on {enough} of {len(count)}",
            enough == len(count), f"{vdi}, {iso}",
        ),
        ArrangementCheck(
            f"on each line one as long as the volume's shortest side ({number(float(sides.min()))} {unit})",
            f"on {long} of {len(count)}", long == len(count), vdi,
        ),
        ArrangementCheck(
            f"the longest 2/3 of the volume's diagonal or more ({number(diagonal * LONGEST_OVER_DIAGONAL)} {unit})",
            f"{number(float(sizes.max()))} {unit}, {100 * part:.0f} %", part >= LONGEST_OVER_DIAGONAL, vdi,
        ),
        ArrangementCheck("an end in each corner of the volume", f"in {len(reached)} of 8", len(reached) == 8, vdi),
        ArrangementCheck("lengths along the four space diagonals", f"along {along} of 4", along == 4, iso),
    ]  # fmt: skip
    return [check._replace(fulfilled=bool(check.fulfilled)) for check in found]


class _Explained(NamedTuple):
    """What lengths tell of the field.

    ends: (m, 2, 3) of what was observed; root: (m, m) lower Cholesky factor of its covariance.
    """

    ends: Floats
    root: Floats


class ErrorField:
    """An unknown, smooth error of positions, and what lengths would tell of it.

    Each of three components is a Gaussian process with a squared exponential kernel, of variance 1. A length sees the
    difference of the errors of its ends along it. Local errors are those of short pieces, in three directions.

    Args:
        workspace: Where it is judged.
        frame: (3, 3) edges of the box around it.
    """

    def __init__(self, workspace: Workspace, frame: Floats) -> None:
        self._edges = frame
        self._scale = FIELD_LENGTHSCALE_RATIO * float(np.linalg.norm(frame.sum(axis=0)))
        self._places = workspace.judged(JUDGED_PLACES)
        step = 0.5 * STRAIN_STEP_RATIO * self._scale * frame / np.linalg.norm(frame, axis=1)[:, None]
        pieces = self._places[:, None, None] + np.stack([-step, step], axis=1)
        self._judged = pieces.reshape(-1, 2, 3)
        self._prior = self._variance(self._judged)

    def observe(self, ends: Floats) -> _Explained:
        """What lengths tell.

        Args:
            ends: (m, 2, 3) their ends.
        """
        cov = self._cov(ends, ends) + 2 * NOISE_VARIANCE_RATIO * np.eye(len(ends))
        return _Explained(ends, np.asarray(np.linalg.cholesky(cov), dtype=np.float64))

    def covered(self, explained: _Explained) -> float:
        """Part of the volume in which lengths show most of a local error.

        Args:
            explained: Of `observe`.
        """
        return float(np.mean(self._shares(self._left(self._judged, explained)) >= COVERED_SHARE))

    def place(
        self, explained: _Explained, workspace: Workspace, sizes: Sequence[float], count: int
    ) -> list[PlacedLength]:
        """Place lengths one after the other, each where it leaves least of the local errors unknown.

        Args:
            explained: What is known from those that were measured.
            workspace: Both ends are inside.
            sizes: Lengths that there are.
            count: How many; fewer where they do not fit.
        """
        if not count:
            return []
        most = sorted(set(sizes))[:: -max(1, -(-len(set(sizes)) // MAX_SIZES))]
        candidates = np.concatenate([self._candidates(workspace, size) for size in most])
        found: list[PlacedLength] = []
        for _ in range(count if len(candidates) else 0):
            white = self._whitened(candidates, explained)
            judged = self._whitened(self._judged, explained)
            cross = self._cov(self._judged, candidates) - judged.T @ white
            left = self._variance(candidates) - np.sum(white**2, axis=0) + 2 * NOISE_VARIANCE_RATIO
            gain = np.sum(cross**2 / self._prior[:, None], axis=0) / left
            best = candidates[int(np.argmax(gain))]
            explained = self.observe(np.concatenate([explained.ends, best[None]]))
            found.append(PlacedLength(best, self.covered(explained)))
        return found

    def _candidates(self, workspace: Workspace, size: float) -> Floats:
        """(c, 2, 3) lengths in the box's edges' directions and the diagonals', with both ends inside."""
        signs = np.array([s for s in product((-1, 0, 1), repeat=3) if s > (0, 0, 0)])
        along = signs @ self._edges
        along *= 0.5 * size / np.linalg.norm(along, axis=1)[:, None]
        middles = np.concatenate([workspace.candidates(CANDIDATE_PLACES, CANDIDATE_SEED), workspace.centre[None]])
        middles = np.concatenate([middles, workspace.centre + 0.5 * (middles - workspace.centre)])
        a, b = middles[:, None] - along, middles[:, None] + along
        pieces = np.stack([a, b], axis=2).reshape(-1, 2, 3)
        return pieces[workspace.inside(pieces.reshape(-1, 3)).reshape(-1, 2).all(axis=1)]

    def _shares(self, left: Floats) -> Floats:
        """(places,) part of the variance of local errors that is known."""
        return np.asarray(1 - (left / self._prior).reshape(-1, 3).mean(axis=1))

    def _left(self, pieces: Floats, explained: _Explained) -> Floats:
        return np.asarray(self._variance(pieces) - np.sum(self._whitened(pieces, explained) ** 2, axis=0))

    def _whitened(self, pieces: Floats, explained: _Explained) -> Floats:
        return np.asarray(solve_triangular(explained.root, self._cov(explained.ends, pieces), lower=True))

    def _variance(self, pieces: Floats) -> Floats:
        apart = np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=1)
        return np.asarray(2 * -np.expm1(-0.5 * (apart / self._scale) ** 2))

    def _cov(self, p: Floats, q: Floats) -> Floats:
        """Covariance of the errors of lengths: u . (d(b) - d(a))."""
        u = (p[:, 1] - p[:, 0]) / np.linalg.norm(p[:, 1] - p[:, 0], axis=1)[:, None]
        v = (q[:, 1] - q[:, 0]) / np.linalg.norm(q[:, 1] - q[:, 0], axis=1)[:, None]
        total = np.zeros((len(p), len(q)))
        for i, j in product((0, 1), repeat=2):
            square = cdist(p[:, i], q[:, j], "sqeuclidean")
            total += (1 if i == j else -1) * np.exp(-0.5 * square / self._scale**2)
        return np.asarray(total * (u @ v.T))
