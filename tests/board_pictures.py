"""Pictures of boards whose corners are known, by many rays a pixel: an independent judge of the package's renderer."""

import numpy as np

from implicam.detect.model import Detected, View
from implicam.images import opencv

VIEW = View("cam1", "s1")
SHAPE = (480, 640)
STRIP = 16


def rotated(angle, scale, at=(320, 240), tilt=(0.0, 0.0)):
    """(3, 3) pixels from squares: a board's plane, its origin in the middle of the picture."""
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    return np.array([[1, 0, at[0]], [0, 1, at[1]], [0, 0, 1]]) @ np.array([[c, -s, 0], [s, c, 0], [*tilt, 1]])


def corners_of(rows, columns, h):
    """(rows * columns, 2) true pixels of the inner corners."""
    y, x = np.mgrid[:rows, :columns]
    x, y = x.ravel() - (columns - 1) / 2, y.ravel() - (rows - 1) / 2
    w = h @ np.stack([x, y, np.ones(x.size)])
    return (w[:2] / w[2]).T


def checkered(rows, columns, margin=1.0):
    """Brightness on the board, in squares from its middle; NaN beside the sheet. Square (0, 0) is black."""

    def paint(x, y):
        i, j = np.floor(y + (rows + 1) / 2), np.floor(x + (columns + 1) / 2)
        printed = (i >= 0) & (i <= rows) & (j >= 0) & (j <= columns)
        value = np.where(printed & ((i + j) % 2 == 0), 0.1, 0.8)
        sheet = (np.abs(x) < (columns + 1) / 2 + margin) & (np.abs(y) < (rows + 1) / 2 + margin)
        return np.where(sheet, value, np.nan)

    return paint


def photograph(paint, h, *, shape=SHAPE, blur=0.7, noise=0.015, seed=0, under=None, fine=6):
    """A picture by many rays a pixel (an independent judge of what the package renders by coverage)."""
    cv2 = opencv()
    v, u = ((np.arange(n * fine) + 0.5) / fine - 0.5 for n in shape)
    inverse = np.linalg.inv(h)
    u, v = u[None, :], v[:, None]
    ground = 0.35 if under is None else np.kron(under, np.ones((fine, fine), np.float32))
    value = np.empty((v.size, u.size), np.float32)
    for start in range(0, v.size, STRIP):  # what fits into a cache
        strip = slice(start, start + STRIP)
        x, y, w = (row[0] * u + row[1] * v[strip] + row[2] for row in inverse)
        painted = paint(x / w, y / w)
        value[strip] = np.where(np.isnan(painted), ground if under is None else ground[strip], painted)
    value = cv2.GaussianBlur(value, (0, 0), blur * fine)
    return noisy(cv2.resize(value, shape[::-1], interpolation=cv2.INTER_AREA), noise, seed)


def noisy(picture, noise=0.015, seed=0):
    rng = np.random.default_rng(seed)
    return np.clip(picture + noise * rng.normal(size=picture.shape), 0, 1).astype(np.float32)


def numbers(found: Detected):
    assert all(point.startswith(f"{VIEW.shot}-c") for point in found.points)
    return np.array([int(point[-3:]) - 1 for point in found.points], dtype=int)


def errors(found, truth):
    return found.uv - truth[numbers(found)]
