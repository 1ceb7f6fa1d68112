"""Where a checkerboard may be: grids of rough corners, from which `grid.grow_grid` finds the board, or nothing.

Three detectors: OpenCV's sector-based one (Duda & Frese 2018), the paper's, libCBDetect (after Geiger et al. 2012), and
the saddle points of the picture with their eight neighbours, which needs no more than a ninth of a board to begin.
A seed may be wrong: every corner is checked in the picture afterwards.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Floats
from implicam.detect.corners import Bools
from implicam.images import Grey, eight_bit, opencv

MIN_ROWS = 4
"""Rows and columns of the smallest board that OpenCV is asked for; with three it sees boards in anything."""

MAX_SADDLES = 800
"""Saddle points that are used, the strongest first."""

FAINT_RANK, MIN_STRENGTH_RATIO = 25, 0.2
"""A saddle point is weak if it has less than this part of the strength of the one with this rank."""

MIN_ANGLE_SINE = 0.2
"""Sine of the angle between rows and columns below which a board is too oblique."""

MAX_SEEDS = 40
"""Seeds from saddle points that are handed on, at most."""

TOGETHER = 32
"""Saddle points whose neighbours are looked for at once."""

PATIENCE_SECONDS = 60.0
"""Seconds that the paper's detector may take."""


def from_opencv(picture: Grey, scale: float) -> list[Floats]:
    """The board that `cv2.findChessboardCornersSB` sees in the picture.

    Args:
        picture: (height, width) grey from 0 to 1.
        scale: Factor by which the picture is shrunk or enlarged before.

    Returns:
        One seed (rows, columns, 2) in pixels of the picture; none where it sees no board.
    """
    cv2 = opencv()
    image = resize(eight_bit(picture), scale)
    if min(image.shape) < 16:
        return []
    try:
        found, corners, meta = cv2.findChessboardCornersSBWithMeta(image, (MIN_ROWS, MIN_ROWS), cv2.CALIB_CB_LARGER)
    except cv2.error:  # its sub-pixel step fails near the picture's rim
        return []
    if not found or meta is None or corners.size != 2 * meta.size:
        return []
    return [to_original_pixels(corners.reshape(*meta.shape, 2).astype(np.float64), image, picture)]


def resize(picture: NDArray[Any], scale: float) -> NDArray[Any]:
    """Shrink or enlarge a picture.

    Args:
        picture: (height, width).
        scale: The factor; 1 gives the picture itself.
    """
    cv2 = opencv()
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    out: NDArray[Any] = picture if scale == 1 else cv2.resize(picture, None, fx=scale, fy=scale, interpolation=way)
    return out


def to_original_pixels(uv: Floats, small: NDArray[Any], picture: NDArray[Any]) -> Floats:
    """Convert pixels of a picture that was resized to pixels of the original.

    Args:
        uv: (..., 2) pixels of the resized picture.
        small: The resized picture, for its size.
        picture: The original, for its size.

    Returns:
        (..., 2) pixels of the original.
    """
    factor = np.array(picture.shape[::-1]) / np.array(small.shape[::-1])
    return np.asarray((uv + 0.5) * factor - 0.5, dtype=np.float64)


def from_libcbdetect(picture: Grey, scale: float) -> list[Floats]:
    """The board that libCBDetect sees in the picture.

    It runs in a process of its own: version 1.0.5 divides by zero where it finds no corner at all, in a black picture
    for one, which takes the process down.

    Args:
        picture: (height, width) grey from 0 to 1.
        scale: Factor by which the picture is shrunk or enlarged before.

    Returns:
        One seed (rows, columns, 2) in pixels of the picture, NaN for holes; none where the library is not installed, or
        fails.
    """
    if importlib.util.find_spec("libCBDetect") is None:
        return []
    small = resize(picture, scale)
    with tempfile.TemporaryDirectory(prefix="implicam-") as folder:
        np.save(Path(folder) / "picture.npy", np.clip(small, 0, 1).astype(np.float64))
        command = [sys.executable, "-c", _LIBCBDETECT, folder]
        try:
            subprocess.run(command, check=True, timeout=PATIENCE_SECONDS, capture_output=True, stdin=subprocess.DEVNULL)
            grid: Floats = np.load(Path(folder) / "corners.npy")
        except (subprocess.SubprocessError, OSError, ValueError):
            return []
    size = np.array(small.shape)[::-1]
    grid[~((grid > 0) & (grid < size)).all(axis=2)] = np.nan  # holes in its board
    return [to_original_pixels(grid, small, picture)]


_LIBCBDETECT = """
import sys
import numpy as np
from libCBDetect.Checkerboard import Checkerboard
folder = sys.argv[1]
picture = np.load(folder + "/picture.npy")
board = Checkerboard()
board.show_processing = board.show_debug_image = board.show_grow_processing = False
board.array_norm_to_image(picture, *picture.shape)
board.find_corners()
board.find_board_from_corners()
u, v = np.full(board.rows * board.cols, np.nan), np.full(board.rows * board.cols, np.nan)
board.get_board_corners(u, v)
np.save(folder + "/corners.npy", np.stack([u, v], axis=1).reshape(board.rows, board.cols, 2))
"""


class Saddles(NamedTuple):
    """Saddle points of the grey values: uv (n, 2) pixels; edges (n, 2, 2) the unit directions in which it is flat, as
    rows; bright (n, 2) the unit direction in which it rises. The strongest first."""

    uv: Floats
    edges: Floats
    bright: Floats


def find_saddles(picture: Grey, blur: float = 1.5) -> Saddles:
    """Find the saddle points of the picture blurred a little, where its Hessian has a determinant much below zero.

    Args:
        picture: (height, width) grey from 0 to 1.
        blur: Sigma of the Gaussian in pixels.

    Returns:
        At most `MAX_SADDLES`, the strongest first.
    """
    cv2 = opencv()
    smooth = cv2.GaussianBlur(picture, (0, 0), blur)
    uu, vv, uv = (cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3) for order in ((2, 0), (0, 2), (1, 1)))
    strength = uv * uv  # its square
    strength -= np.multiply(uu, vv, out=smooth)
    peak = (strength >= cv2.dilate(strength, np.ones((5, 5), np.uint8), dst=smooth)) & (strength > 0)
    peak[:3], peak[-3:], peak[:, :3], peak[:, -3:] = False, False, False, False
    at = np.flatnonzero(peak)
    height = strength.ravel()[at]
    if len(at) > MAX_SADDLES:  # noise makes tens of thousands
        enough = height >= np.partition(height, -MAX_SADDLES)[-MAX_SADDLES]
        at, height = at[enough], height[enough]
    v, u = np.unravel_index(at[np.argsort(-height, kind="stable")[:MAX_SADDLES]], strength.shape)
    if len(v):
        clear = strength[v, u] > MIN_STRENGTH_RATIO**2 * strength[v, u][min(FAINT_RANK, len(v) - 1)]
        v, u = v[clear], u[clear]
    hessian = np.stack([uu[v, u], uv[v, u], uv[v, u], vv[v, u]], axis=1).reshape(-1, 2, 2).astype(np.float64)
    values, vectors = np.linalg.eigh(hessian)
    low, high = np.sqrt(np.maximum(-values[:, :1], 0)), np.sqrt(np.maximum(values[:, 1:], 0))
    # Flat where x0² low + x1² high = 0, along the two diagonals of the eigenvectors weighted by the other's root.
    first, second = vectors[:, :, 0] * high, vectors[:, :, 1] * low
    edges = np.stack([first + second, first - second], axis=1)
    edges /= np.maximum(np.linalg.norm(edges, axis=2, keepdims=True), 1e-12)
    return Saddles(np.column_stack([u, v]).astype(np.float64), edges, vectors[:, :, 1])


def from_saddles(
    points: Saddles, taken: Callable[[Floats], Bools], promising: Callable[[Floats], Bools]
) -> Iterator[Floats]:
    """Three by three saddle points that lie as corners of a board do; each is the middle of one seed at most.

    Args:
        points: Saddle points.
        taken: Which of pixels (n, 2) belong to a board already; no seeds are made there. Asked again after each seed.
        promising: Which of seeds (n, 3, 3, 2) are worth a closer look; the others count, but are not handed on.

    Yields:
        Seeds (3, 3, 2) in pixels, the strongest first, from at most `MAX_SEEDS`.
    """
    if len(points.uv) < 9:
        return
    given = 0
    for some in np.split(np.arange(len(points.uv)), range(TOGETHER, len(points.uv), TOGETHER)):
        some = some[~taken(points.uv[some])]
        middles, seeds = _make_squares(points, some, *_find_arms(points, some))
        there = np.zeros(len(middles), dtype=np.bool_)
        for k, (seed, good) in enumerate(zip(seeds, promising(seeds), strict=True)):
            if there[k]:
                continue
            if good:
                yield seed
                there = taken(points.uv[middles])
            given += 1
            if given == MAX_SEEDS:
                return


def _find_arms(points: Saddles, some: NDArray[np.intp]) -> tuple[NDArray[np.intp], Bools]:
    """Of each of some points, the nearest points (n, 4) along its two edges, there and back, within 20 degrees; and
    (n,) where there are all of them."""
    du, dv = (points.uv[:, k] - points.uv[some, k, None] for k in range(2))
    distance = np.hypot(du, dv)
    # from corner to corner bright and dark change over
    distance[np.abs(points.bright[some] @ points.bright.T) >= 0.75] = np.inf
    distance[distance == 0] = np.inf
    least = 0.94 * distance
    found, there = [], np.ones(len(some), dtype=np.bool_)
    for edge in range(2):
        u, v = points.edges[some, edge].T[..., None]
        along = u * du + v * dv
        for ahead in (along > least, along < -least):
            near = np.where(ahead, distance, np.inf)
            found.append(np.argmin(near, axis=1))
            there &= np.isfinite(near[np.arange(len(some)), found[-1]])
    return np.stack(found, axis=1), there


def _make_squares(
    points: Saddles, some: NDArray[np.intp], arms: NDArray[np.intp], there: Bools
) -> tuple[NDArray[np.intp], Floats]:
    """The seeds (m, 3, 3, 2) about those of some points (m,) whose four neighbours and corners of the square exist."""
    some, arms = some[there], arms[there]
    middle = points.uv[some]
    seeds = np.repeat(middle, 9, axis=0).reshape(-1, 3, 3, 2)
    seeds[:, 1, 2], seeds[:, 1, 0], seeds[:, 2, 1], seeds[:, 0, 1] = points.uv[arms].swapaxes(0, 1)
    steps = np.stack([seeds[:, 1, 2] - seeds[:, 1, 0], seeds[:, 2, 1] - seeds[:, 0, 1]], axis=1) / 2
    lengths = np.linalg.norm(steps, axis=2)
    good = np.abs(np.linalg.det(steps)) >= MIN_ANGLE_SINE * lengths.prod(axis=1)
    for i in (0, 2):
        for j in (0, 2):
            corner = seeds[:, i, 1] + seeds[:, 1, j] - middle
            square = (points.uv[:, 0] - corner[:, :1]) ** 2 + (points.uv[:, 1] - corner[:, 1:]) ** 2
            nearest = np.argmin(square, axis=1)
            good &= square[np.arange(len(some)), nearest] <= (0.4 * lengths.min(axis=1)) ** 2
            seeds[:, i, j] = points.uv[nearest]
    return some[good], seeds[good]
