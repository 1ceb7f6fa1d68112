"""Where a target can be put: a box, the hull of some points, or a list of places; convex, in the world frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError

from implicam.calibrators import PredictsPixels
from implicam.dataset import Floats
from implicam.dataset.image_bounds import are_on_image
from implicam.errors import HardwareError, UsageError
from implicam.hardware.csv_player import read_positions
from implicam.simulate import Box

SURFACE_STEP = 5
"""One candidate of so many lies on the surface: the outermost places tell most about a lens."""

MIN_INSIDE_SHARE = 0.05
"""Where less than this part of a box around it is inside, the box is turned."""

START_DISTANCE_RATIO = 0.9
"""The places to begin with are so much nearer to the centre than candidates: what the cameras see is not known yet."""

VIEW_GROWTH, PLACES_IN_VIEW = 2.0, 8192
"""What the cameras see is looked for in the box of the known points made so many times as large, at so many places."""

MAX_PLACES = 100_000
"""Of a block."""

ROUND_PLACE_RATIO = 1 / 100
"""Part of the size that a place may be rounded to for a person."""

RELATIVE_TOLERANCE = 1e-9
"""Part of the size by which a point may be outside and still counts as inside."""


@dataclass(frozen=True, eq=False)
class Workspace:
    """A convex region of the world: `normals @ xyz <= offsets`.

    Attributes:
        normals: (k, 3) unit vectors out of its faces.
        offsets: (k,) of the faces, in the length unit.
        vertices: (v, 3) its corners.
        places: (n, 3) the only places where a target can be; None for anywhere inside.
        name: What it is, in words.
    """

    normals: Floats
    offsets: Floats
    vertices: Floats
    places: Floats | None
    name: str

    @classmethod
    def box(cls, low: ArrayLike, high: ArrayLike) -> Workspace:
        """A box along the axes of the world.

        Args:
            low: (3,) its lower end of x, y and z.
            high: (3,) its upper end.

        Raises:
            UsageError: The box is empty, or an end is not finite.
        """
        a, b = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
        if a.shape != (3,) or b.shape != (3,) or not np.isfinite([a, b]).all() or not (a < b).all():
            raise UsageError(
                f"a workspace from {a.tolist()} to {b.tolist()} is empty.", fix="give x, y and z, the lower end first"
            )
        corners = np.array(list(product(*zip(a, b, strict=True))))
        size = " x ".join(f"{n:.4g}" for n in b - a)
        return cls._of(corners, None, f"a box of {size}")

    @classmethod
    def from_box(cls, box: Box) -> Workspace:
        """The working volume of a simulated rig, in any orientation.

        Args:
            box: The working volume.
        """
        corners = np.array(list(product((-0.5, 0.5), repeat=3))) * box.size
        size = " x ".join(f"{n:.4g}" for n in box.size)
        return cls._of(box.world_from_box.apply(corners), None, f"a box of {size}")

    @classmethod
    def hull(cls, xyz: ArrayLike) -> Workspace:
        """The convex hull of points.

        Args:
            xyz: (n, 3) points in the world.

        Raises:
            UsageError: They do not fill a volume, or one is not finite.
        """
        points = np.asarray(xyz, dtype=np.float64)
        return cls._of(points, None, f"the hull of {len(points)} points")

    @classmethod
    def only(cls, xyz: ArrayLike) -> Workspace:
        """Some reachable places and no others; the calibration is judged between them too.

        Args:
            xyz: (n, 3) places in the world.

        Raises:
            UsageError: They do not fill a volume, or one is not finite.
        """
        points = np.asarray(xyz, dtype=np.float64)
        return cls._of(points, points, f"{len(points)} places")

    @classmethod
    def in_view(cls, rig: PredictsPixels, xyz: ArrayLike) -> Workspace:
        """What every calibrated camera sees, not farther beyond the known points than they reach themselves.

        With it an acquisition is evaluated on the dense set of pixel combinations that a position can have, whatever
        the axes of the world are: for targets that are given as pixels.

        Args:
            rig: A calibration that predicts pixels.
            xyz: (n, 3) known points in the world.

        Raises:
            UsageError: No volume near them is seen by every camera.
        """
        points = np.asarray(xyz, dtype=np.float64)
        centre, half = 0.5 * (points.min(axis=0) + points.max(axis=0)), 0.5 * np.ptp(points, axis=0)
        around = cls.box(centre - VIEW_GROWTH * half, centre + VIEW_GROWTH * half)
        places = around.judged(PLACES_IN_VIEW)
        used = np.array([name in rig.camera_names for name in rig.trained.camera_names])
        seen = places[are_on_image(rig.trained, rig.predict(places))[:, used].all(axis=1)]
        if len(seen) < 4:
            raise UsageError(
                "no volume near the known points is seen by every camera.",
                fix="give a box, --workspace x0:x1,y0:y1,z0:z1",
            )
        return replace(cls._of(seen, None, ""), name="what every camera sees")

    @classmethod
    def _of(cls, points: Floats, places: Floats | None, name: str) -> Workspace:
        if points.ndim != 2 or points.shape[1:] != (3,) or not np.isfinite(points).all():
            raise UsageError("the places of a workspace are finite x, y, z.")
        try:
            found = ConvexHull(points)
        except (QhullError, ValueError) as error:
            raise UsageError(
                f"{name} fill no volume.",
                why=str(error).splitlines()[0],
                fix="give a box: --workspace x0:x1,y0:y1,z0:z1, in the dataset's unit",
            ) from error
        equations = np.unique(np.round(found.equations, 12), axis=0)
        return cls(equations[:, :3], -equations[:, 3], points[found.vertices], places, name)

    @property
    def size(self) -> float:
        """The diagonal of the box around it, along the axes of the world."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))

    @property
    def centre(self) -> Floats:
        """(3,) the mean of its corners."""
        return np.asarray(self.vertices.mean(axis=0), dtype=np.float64)

    def inside(self, xyz: Floats) -> NDArray[np.bool_]:
        """Which points are inside.

        Args:
            xyz: (n, 3) points in the world.

        Returns:
            (n,), true within rounding of the surface.
        """
        return np.asarray(
            (xyz @ self.normals.T <= self.offsets + RELATIVE_TOLERANCE * self.size).all(axis=1), dtype=np.bool_
        )

    def candidates(self, n: int, seed: int) -> Floats:
        """Where the next target may be.

        They are evenly spread, some of them on the surface and in the corners, where a calibration knows least. Of a
        list of places at most n come, in random order.

        Args:
            n: How many.
            seed: Of the Sobol sequence, or of the order.

        Returns:
            (n, 3) places in the world.
        """
        if self.places is not None:
            return self.places[np.random.default_rng(seed).permutation(len(self.places))[:n]]
        corners = self._corners(n)
        found = self._sample_inside(n - len(corners), seed)
        found[::SURFACE_STEP] = self._on_surface(found[::SURFACE_STEP])
        return self._pull_in(np.concatenate([found, corners]), 1 - RELATIVE_TOLERANCE)

    def judged(self, n: int, seed: int = 0) -> Floats:
        """Places at which a calibration is judged: evenly spread, and the corners.

        Args:
            n: How many.
            seed: Of the Sobol sequence.

        Returns:
            (n, 3) places in the world.
        """
        corners = self._corners(n)
        return np.concatenate([corners, self._sample_inside(n - len(corners), [seed, 1])])

    def design(self, n: int, seed: int) -> Floats:
        """Places to begin with, while nothing is known of the cameras: each as far from the others as can be.

        Args:
            n: How many.
            seed: Of the candidates that they are chosen from.

        Returns:
            (n, 3) places in the world.

        Raises:
            UsageError: The workspace is a list of fewer places.
        """
        pool = self.candidates(64 * n, seed)
        if self.places is None:
            pool = self._pull_in(pool, START_DISTANCE_RATIO)
        if len(pool) < n:
            raise UsageError(f"{self.name} are fewer than the {n} that are needed to begin.", fix="add places")
        chosen = [int(np.argmax(np.linalg.norm(pool - self.centre, axis=1)))]
        distance = np.linalg.norm(pool - pool[chosen[0]], axis=1)
        while len(chosen) < n:
            chosen.append(int(np.argmax(distance)))
            distance = np.minimum(distance, np.linalg.norm(pool - pool[chosen[-1]], axis=1))
        return pool[chosen]

    def rounded(self, xyz: Floats) -> Floats:
        """A place as somebody with a ruler wants it: with no more digits than a hundredth of the workspace needs.

        Args:
            xyz: (3,) a place in the world.

        Returns:
            (3,) the round place; the place itself where that is outside, or where only some places can be reached.

        >>> Workspace.box([0, 0, 0], [300, 200, 100]).rounded(np.array([12.345, 67.89, 50.5])).tolist()
        [12.0, 68.0, 50.0]
        """
        step = 10.0 ** np.floor(np.log10(ROUND_PLACE_RATIO * self.size))
        found = np.round(np.round(xyz / step) * step, 12)
        return found if self.places is None and self.inside(found[None])[0] else xyz

    def _pull_in(self, xyz: Floats, part: float) -> Floats:
        """Points moved towards the centre, to `part` of the distance: a billionth less keeps rounding inside."""
        return np.asarray(self.centre + part * (xyz - self.centre), dtype=np.float64)

    def _corners(self, n: int) -> Floats:
        """The corners; of many a regular selection, about a quarter of n."""
        return self.vertices[:: max(1, -(-len(self.vertices) * 4 // n))]

    def _sample_inside(self, n: int, seed: int | list[int]) -> Floats:
        """(n, 3) points of a scrambled Sobol sequence inside."""
        from scipy.stats import qmc  # late: it takes a second of every command's start

        sequence = qmc.Sobol(3, rng=np.random.default_rng(seed))
        found, axes = np.zeros((0, 3)), np.eye(3)
        while len(found) < n:
            along = self.vertices @ axes.T
            low, high = along.min(axis=0), along.max(axis=0)
            points = (low + sequence.random(1 << max(6, int(np.ceil(np.log2(max(1, n)))))) * (high - low)) @ axes
            inside = self.inside(points)
            found = np.concatenate([found, points[inside]])
            if (
                inside.mean() < MIN_INSIDE_SHARE
            ):  # a thin slab that lies askew: a box along it holds less that is outside
                axes = np.linalg.svd(self.vertices - self.centre, full_matrices=False)[2]
        return found[:n]

    def _on_surface(self, xyz: Floats) -> Floats:
        """Points (n, 3) moved away from the centre as far as possible."""
        along = xyz - self.centre
        speed, room = along @ self.normals.T, self.offsets - self.normals @ self.centre
        with np.errstate(divide="ignore"):
            reach = np.where(speed > 0, room / np.where(speed > 0, speed, 1.0), np.inf).min(axis=1)
        return np.asarray(self.centre + along * reach[:, None], dtype=np.float64)


def workspace_from(text: str, xyz: Floats | None) -> Workspace:
    """The workspace that an argument of the command line stands for.

    Args:
        text: `x0:x1,y0:y1,z0:z1`, a CSV file of places (x,y,z), the holes or slots of a block
            (`x=0,50,100 y=0:80:20 z=0,40`), or `box` or `hull` of the known points.
        xyz: (n, 3) the known points; None where there are none.

    Raises:
        UsageError: The text or the file cannot be read, or there are too few known points.
    """
    if text in ("box", "hull"):
        if xyz is None or len(xyz) < 4:
            raise UsageError(
                f"there are no known points to take the {text} of.", fix="give a box: --workspace x0:x1,y0:y1,z0:z1"
            )
        return Workspace.hull(xyz) if text == "hull" else Workspace.box(xyz.min(axis=0), xyz.max(axis=0))
    if text.lower().endswith(".csv"):
        return Workspace.only(read_places(Path(text)))
    if "=" in text:
        return Workspace.only(lattice_places(text))
    try:
        ends = [[float(end) for end in axis.split(":")] for axis in text.split(",")]
        low, high = np.array(ends, dtype=np.float64).reshape(3, 2).T
    except ValueError as error:
        raise UsageError(
            f"the workspace {text!r} cannot be read.",
            why="it is x0:x1,y0:y1,z0:z1 in the dataset's unit, a CSV file with x,y,z, the holes of a block "
            "(x=0,50,100 y=0:80:20 z=0,40), or box or hull",
            fix="for example --workspace=-120:120,-80:80,0:240",
        ) from error
    return Workspace.box(low, high)


def lattice_places(text: str, option: str = "--workspace") -> Floats:
    """All places of a lattice, as the holes of a block or the stops of a slide.

    Args:
        text: "x=0,50,100 y=0:80:20 z=0,40": x, y and z each in a list, or from:to:step.
        option: Of the command line, which the error names.

    Returns:
        (n, 3), z changing fastest.

    Raises:
        UsageError: The text cannot be read, or there are too many places.
    """
    axes: dict[str, list[float]] = {}
    try:
        for word in text.split():
            axis, _, values = word.partition("=")
            if axis not in ("x", "y", "z") or axis in axes:
                raise ValueError(f"{word!r} is no x=..., y=... or z=..., once each")
            axes[axis] = [value for part in values.split(",") for value in _steps(part)]
        if len(axes) != 3:
            raise ValueError(f"{' and '.join(axis for axis in 'xyz' if axis not in axes)} is not there")
    except ValueError as error:
        raise UsageError(
            f"the places {text!r} cannot be read.",
            why=str(error),
            fix=f'for example {option} "x=0,50,100 y=0:80:20 z=0,40": lists, or from:to:step',
        ) from error
    count = np.prod([len(values) for values in axes.values()])
    if count > MAX_PLACES:
        raise UsageError(f"{text!r} are {count} places.", fix=f"give at most {MAX_PLACES}, or a box: x0:x1,y0:y1,z0:z1")
    return np.array(list(product(axes["x"], axes["y"], axes["z"])))


def _steps(part: str) -> list[float]:
    """The numbers of "50", or of "0:80:20", both ends among them."""
    numbers = [float(number) for number in part.split(":")]
    if not np.isfinite(numbers).all() or len(numbers) not in (1, 3):
        raise ValueError(f"{part!r} is neither a number nor from:to:step")
    if len(numbers) == 1:
        return numbers
    start, end, step = numbers
    steps = (end - start) / step if step else np.inf
    if not -RELATIVE_TOLERANCE <= steps <= MAX_PLACES:
        raise ValueError(f"{part!r} has no end")
    return [start + k * step for k in range(int(steps + 1e-6) + 1)]


def read_places(path: Path) -> Floats:
    """The positions in a CSV file with columns x, y and z.

    Args:
        path: The file.

    Returns:
        (n, 3) positions.

    Raises:
        UsageError: The file cannot be read; names the line.
    """
    try:
        return read_positions(path)[:, :3]
    except HardwareError as error:
        raise UsageError(error.what, why=error.why, fix=error.fix) from error
