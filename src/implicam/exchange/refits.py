"""A camera as it is read: a lens that is not among the families here is replaced by the nearest that is, at a cost.

The cost is over the whole image: where the two lenses put the rays that its pixels look along.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import KDTree

from implicam.dataset.tables import naming
from implicam.errors import DatasetError, FitError
from implicam.exchange.fits import MAX_LENS_DIFFERENCE_PX, ROUNDING_PX, Cost, lattice_of
from implicam.exchange.model import ExplicitCamera
from implicam.exchange.other_lenses import OtherLens, focal_lengths
from implicam.geometry import Pose, rotation_from_vector
from implicam.lenses import BrownConrady, Floats, KannalaBrandt, Lens
from implicam.lenses.base import fit_lens
from implicam.lenses.polynomials import solve_2x2

ANGLES, DIRECTIONS = 160, 96
"""Rays that are tried, along each direction from the axis and around it."""

MAX_ANGLE_RAD = np.radians(125.0)
"""Off the axis; no lens is looked at beyond."""

TURNED_ABOVE_PX = 0.1
"""A fit that is off by less is not tried with a turned axis."""

MAX_READ_RMS_PX = 1.0
"""A lens that the nearest one here misses by more over the image is refused. In a corner, where nobody calibrated it,
the formula of a lens may go anywhere."""

MIN_RAYS = 50
"""Fewer do not cover an image."""

AIM_STEPS, DIFFERENCE_RAD, MAX_AIM_RAD = 8, 1e-6, 0.05
"""Newton's method onto the pixels of the lattice: its steps, its differences, and how far a ray may turn in all."""

FAR_PX = 1e9
"""A pixel that is farther off is none."""

MAX_ASSUMED_SIDE_PX = 20_000
"""A larger image is no image, where its size is guessed from the principal point."""


def make_camera(
    name: str, size: tuple[int, int] | None, lens: Lens | OtherLens, pose: Pose, place: str
) -> tuple[ExplicitCamera, list[str]]:
    """A camera of a file.

    Args:
        name: Of the camera.
        size: Width and height in pixels; None where the file does not say.
        lens: As the file has it.
        pose: Camera_from_world.
        place: Where it stands, for errors.

    Returns:
        The camera, turned where that brings the lens nearer; and a note on what replacing the lens cost, none where it
        is kept.

    Raises:
        DatasetError: The values are no camera, or no lens here comes within `MAX_READ_RMS_PX`.
    """
    notes: list[str] = []
    with naming(place):
        if isinstance(lens, OtherLens):
            nearest, notes = _nearest_lens(name, size, lens)
            lens = nearest.lens
            pose = Pose(nearest.turn @ pose.rotation, nearest.turn @ pose.translation)
        width, height = size or (None, None)
        return ExplicitCamera(name, width, height, lens, pose), notes


@dataclass(frozen=True)
class _Nearest:
    """A lens, the turn (3, 3) of the camera that goes with it, and what it costs."""

    lens: Lens
    turn: Floats
    cost: Cost


def _nearest_lens(name: str, size: tuple[int, int] | None, lens: OtherLens) -> tuple[_Nearest, list[str]]:
    width, height = size or _assumed_size(name, lens)
    rays, uv = _sample(lens, width, height)
    if len(rays) < MIN_RAYS:
        raise DatasetError(
            f"camera {name!r}: {lens.model} sees nothing of its image of {width} x {height} px.",
            why="no ray falls on enough of its pixels",
            fix="correct the coefficients, or the size of the image",
        )
    fits = [found for found in (_fit(family, lens, rays, uv) for family in (BrownConrady, KannalaBrandt)) if found]
    best = min(fits, key=lambda fit: fit.cost.largest, default=None)
    if best is None or best.cost.rms > MAX_READ_RMS_PX:
        off = f"is off by {best.cost}" if best else "folds"
        raise DatasetError(
            f"camera {name!r}: {lens.model} has no lens here that comes within {MAX_READ_RMS_PX:g} px (rms).",
            why=f"the nearest brown-conrady or kannala-brandt {off}",
            fix="calibrate again with OpenCV's five coefficients, or with its fisheye model",
        )
    note = f"Camera {name!r}: {lens.model} was fitted again as {best.lens.family}: {best.cost}"
    note += "" if size else f", over an image of {width} x {height} px: the file does not say its size"
    if best.cost.largest > MAX_LENS_DIFFERENCE_PX:
        note += ", which error bars do not hold: calibrate again with a lens that is known here"
    return best, [f"{note}."]


def _assumed_size(name: str, lens: OtherLens) -> tuple[int, int]:
    """An image with the principal point in its middle."""
    width, height = round(2 * lens.cx + 1), round(2 * lens.cy + 1)
    if not (0 < width <= MAX_ASSUMED_SIDE_PX and 0 < height <= MAX_ASSUMED_SIDE_PX):
        raise DatasetError(
            f"the image size of camera {name!r} is not known, and fitting its lens again needs it.",
            why=f"its principal point {lens.cx:g}, {lens.cy:g} is not near the middle of an image",
            fix="give width and height",
        )
    return width, height


def _sample(lens: OtherLens, width: int, height: int) -> tuple[Floats, Floats]:
    """Rays (n, 3) of unit length that fall on the image, one for each pixel of a lattice over it, and their pixels."""
    edge = np.array([width, height]) - 0.5
    around = np.linspace(0, 2 * np.pi, DIRECTIONS, endpoint=False)
    outwards = np.stack([np.cos(around), np.sin(around)])
    widest = MAX_ANGLE_RAD
    for _ in range(2):  # coarsely, then up to the angle that the image ends at
        angles = np.linspace(0, widest, ANGLES)
        flat = (np.sin(angles)[:, None, None] * outwards.T).reshape(-1, 2)
        rays = np.column_stack([flat, np.repeat(np.cos(angles), DIRECTIONS)])
        with np.errstate(all="ignore"):
            uv, valid = lens.project(rays)
            uv = np.where(np.abs(uv) < FAR_PX, uv, np.nan)
        uv, seen = uv.reshape(ANGLES, DIRECTIONS, 2), valid.reshape(ANGLES, DIRECTIONS)
        # beyond the first pixel that comes back towards the middle, the lens has folded
        radius = np.linalg.norm(uv - uv[0], axis=2)
        rising = np.vstack([np.ones((1, DIRECTIONS), dtype=np.bool_), np.diff(radius, axis=0) > 0])
        seen = np.logical_and.accumulate(seen & rising & np.isfinite(radius), axis=0)
        inside = seen & (uv >= -0.5).all(axis=2) & (uv <= edge).all(axis=2)
        reached = inside.any(axis=1)
        widest = (
            min(MAX_ANGLE_RAD, angles[min(int(np.flatnonzero(reached)[-1]) + 1, ANGLES - 1)]) if reached.any() else 0.0
        )
    rays, uv = rays[inside.ravel()], uv.reshape(-1, 2)[inside.ravel()]
    if not len(rays):
        return rays, uv
    pixels = lattice_of(width, height)
    _, nearest = KDTree(uv).query(pixels)
    chosen, first = np.unique(nearest, return_index=True)
    return _aim(lens, rays[chosen], uv[chosen], pixels[first])


def _aim(lens: OtherLens, rays: Floats, uv: Floats, pixels: Floats) -> tuple[Floats, Floats]:
    """The rays (n, 3) turned to look along given pixels, by Newton's method, and their pixels; those where it does not
    end within `MAX_AIM_RAD` stay as they are."""
    aimed, at = rays, uv
    for _ in range(AIM_STEPS):
        sideways = np.cross(aimed, np.eye(3)[np.argmin(np.abs(aimed), axis=1)])
        sideways /= np.linalg.norm(sideways, axis=1, keepdims=True)
        tangents = np.stack([sideways, np.cross(aimed, sideways)], axis=2)
        with np.errstate(all="ignore"):
            moved = [lens.project(aimed + DIFFERENCE_RAD * tangents[:, :, i])[0] - at for i in range(2)]
            step = solve_2x2(np.stack(moved, axis=2) / DIFFERENCE_RAD, pixels - at)
            step *= np.minimum(1, MAX_AIM_RAD / np.linalg.norm(step, axis=1, keepdims=True))
            aimed = aimed + np.einsum("nij,nj->ni", tangents, step)
            aimed = aimed / np.linalg.norm(aimed, axis=1, keepdims=True)
            at, valid = lens.project(aimed)
    with np.errstate(all="ignore"):
        kept = valid & (np.linalg.norm(at - pixels, axis=1) < ROUNDING_PX)
        kept &= np.linalg.norm(aimed - rays, axis=1) < MAX_AIM_RAD
    return np.where(kept[:, None], aimed, rays), np.where(kept[:, None], at, uv)


def _fit(
    family: type[BrownConrady] | type[KannalaBrandt], lens: OtherLens, rays: Floats, uv: Floats
) -> _Nearest | None:
    """The nearest lens of a family, and its cost; None where none sees all the rays."""
    try:
        found = fit_lens(family(*focal_lengths(lens), lens.cx, lens.cy), rays, uv)
    except FitError:
        return None
    at, valid = found.pixel_from_camera_point(rays)
    straight = _Nearest(found, np.eye(3), Cost.between(at, uv)) if valid.all() else None
    if straight is None or straight.cost.largest < TURNED_ABOVE_PX:
        return straight
    turned = _fit_turned(straight, rays, uv)
    return turned if turned.cost.largest < straight.cost.largest else straight


def _fit_turned(start: _Nearest, rays: Floats, uv: Floats) -> _Nearest:
    """A lens whose axis may turn: a tilted sensor is a turn and a shift, nearly."""
    family, first = type(start.lens), np.array(astuple(start.lens))
    scale = np.concatenate([np.full(4, first[0]), np.ones(len(first) - 1)])

    def project(x: Floats) -> Floats:
        found, turn = family(*(first + (scale * x)[: len(first)]).tolist()), rotation_from_vector(x[len(first) :])
        return found.pixel_from_camera_point(rays @ turn.T)[0]

    x = least_squares(lambda x: np.nan_to_num(project(x) - uv, nan=1e6).ravel(), np.zeros(len(scale)), x_scale="jac").x
    found, turn = family(*(first + (scale * x)[: len(first)]).tolist()), rotation_from_vector(x[len(first) :])
    return _Nearest(found, turn, Cost.between(np.nan_to_num(project(x), nan=1e6), uv))
