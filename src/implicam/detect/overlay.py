"""What was found, drawn on its photograph, to check by eye; every state is written in words as well as in colour."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from implicam import drawing
from implicam.dataset import Floats
from implicam.detect.model import Detected, Inferred, View
from implicam.drawing import Canvas, Pixels
from implicam.formatting import short_names
from implicam.images import brighten

INK_COLOUR = (40, 50, 60)
STATES = {"found": drawing.GREEN, "partly found": drawing.ORANGE, "nothing found": drawing.VERMILLION}

MAX_SIDE_PX, MIN_SIDE_PX = 1600, 800
"""Pixels of an overlay's longer side: larger pictures are reduced, smaller ones enlarged by a whole number."""

TILE_PX, TEXT_PX = (320, 240), 62
"""The width and height of a thumbnail, and the height of the text below it."""

MAX_SIDE_OF_DOTS_PX, NAME_PX, MAX_NAME_PX = 6000, 13, 22
"""Pixels: the longer side that a picture of labelled dots may have so that their names can be read, and the least and
the largest size of these."""

MAX_NAMED_POINTS = 12
"""So many points have their names beside them."""

RIMMED_RADIUS_PX = 4.0
"""Pixels: marks of this radius and larger are rings with a dark rim, smaller ones are dots."""

ELLIPSE_SDS = 2.45
"""Standard deviations to the ellipse that holds 95 % in two dimensions."""

_WAYS = np.array([(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)])
_CORNER = re.compile(r".*-c(\d{3,})")


@dataclass(frozen=True, eq=False)
class Result:
    """The result of a picture. expected: how many known points belong to its shot, None where that is not known."""

    view: View
    path: Path
    found: Detected
    expected: int | None = None

    @property
    def state(self) -> str:
        """A key of STATES."""
        if not len(self.found):
            return "nothing found"
        partly = self.found.reason or len(self.found) < (self.expected or 0)
        return "partly found" if partly else "found"

    @property
    def summary(self) -> str:
        """Its state in a few words."""
        of = f" of {self.expected}" if self.expected and self.expected != len(self.found) else ""
        points = "point" if len(self.found) == 1 and not of else "points"
        return f"{len(self.found)}{of} {points}" if len(self.found) else self.state


def draw_overlay(grey: Pixels | None, result: Result) -> Pixels:
    """Draw the whole picture with what was found, and a caption.

    Args:
        grey: (height, width) as `eight_bit` gives it; None where the picture cannot be read.
        result: The result of the picture.

    Returns:
        (rows, columns, 3) red, green, blue, from 0 to 255.
    """
    if grey is None:
        return _add_caption(_draw_unreadable(640, 400), result).pixels
    height, width = grey.shape
    longest = max(width, height)
    scale = min(1.0, MAX_SIDE_PX / longest)
    if longest < MIN_SIDE_PX:
        scale = float(min(16, MAX_SIDE_PX // longest))
    if _is_labelled(result.found):
        grey = brighten(grey)
        scale = max(scale, min(_scale_to_read(result.found), MAX_SIDE_OF_DOTS_PX / longest))
    whole = _Window(0, 0, width, height, scale)
    canvas = whole.draw(grey, result.found)
    _draw_magnified(canvas, grey, result.found, whole)
    return _add_caption(canvas, result).pixels


def _is_labelled(found: Detected) -> bool:
    """Whether these are dots of a target of which some were labelled: each has a name to read, found or not."""
    return "labelled" in found.notes


def _scale_to_read(found: Detected) -> float:
    """How many times larger than it is a picture must be for the names of its dots to have room."""
    names, uv, _ = _all_dots(found)
    if len(uv) < 2:
        return 0.0
    widest = max(drawing.text_width(name, NAME_PX) for name in names)
    return float(max(widest + 4, 2 * RIMMED_RADIUS_PX + NAME_PX + 6) / np.median(_distances_to_nearest(uv)))


def _all_dots(found: Detected) -> tuple[list[str], Floats, Floats]:
    """Short names and pixels (n, 2) of the dots found and then of the missing ones, and the pixels (m, 2) of the
    missing ones alone."""
    missing = found.notes.get("missing", {})
    gone = np.array(list(missing.values()), dtype=np.float64).reshape(-1, 2)
    return short_names([*found.points, *missing]), np.concatenate([found.uv, gone]), gone


def draw_thumbnail(grey: Pixels | None, result: Result) -> Pixels:
    """Draw a tile of a sheet: the neighbourhood of what was found, the whole picture small, and a caption below.

    Args:
        grey: (height, width) as `eight_bit` gives it; None where the picture cannot be read.
        result: The result of the picture.

    Returns:
        (rows, columns, 3) red, green, blue, from 0 to 255; all tiles have the same size.
    """
    width, height = TILE_PX
    if grey is None:
        inner = _draw_unreadable(width, height)
    else:
        grey = brighten(grey) if _is_labelled(result.found) else grey
        whole = _Window.fitting(0, 0, grey.shape[1], grey.shape[0])
        window = _find_neighbourhood(result.found, grey.shape) or whole
        inner = window.draw(grey, result.found, names=False)
        if window is not whole:
            _draw_inset(inner, grey, window, window.place(result.found.uv))
    tile = drawing.blank(width + 8, height + 4 + TEXT_PX, drawing.WHITE)
    tile.paste(_centre(inner, width, height), 4, 4)
    tile.border(4, STATES[result.state])
    right, top = tile.width - 10, tile.height - TEXT_PX
    tile.write(result.summary, (right, top + 17), 14, INK_COLOUR, "rs")
    name = drawing.cut_text(result.view.shot, right - 20 - drawing.text_width(result.summary, 14), 15)
    tile.write(name, (10, top + 17), 15, INK_COLOUR)
    for i, line in enumerate(drawing.wrap_text(result.found.reason, tile.width - 20, 11.5, 2)):
        tile.write(line, (10, top + 35 + 16 * i), 11.5, INK_COLOUR)
    return tile.pixels


@dataclass(frozen=True)
class _Window:
    """A part of a picture, in its pixels, and how much larger it is shown."""

    left: int
    top: int
    width: int
    height: int
    scale: float

    @classmethod
    def fitting(cls, left: int, top: int, width: int, height: int) -> _Window:
        """As large as a tile allows."""
        return cls(left, top, width, height, min(TILE_PX[0] / width, TILE_PX[1] / height))

    @property
    def corners(self) -> Floats:
        """(2, 2) the picture's coordinates of its top left and bottom right edges."""
        low = np.array([self.left, self.top]) - 0.5
        return np.array([low, low + np.array([self.width, self.height])])

    def place(self, uv: Floats) -> Floats:
        """Where pixels (n, 2) of the picture come to lie: a pixel's centre stays the centre of what it becomes."""
        return np.asarray((uv + 0.5 - (self.left, self.top)) * self.scale - 0.5, dtype=np.float64)

    def cut(self, grey: Pixels) -> Canvas:
        """That part of the picture."""
        return drawing.enlarge(grey[self.top : self.top + self.height, self.left : self.left + self.width], self.scale)

    def draw(self, grey: Pixels, found: Detected, *, names: bool = True) -> Canvas:
        """That part of the picture with outlines, lines, marks and names."""
        canvas = self.cut(grey)
        if _is_labelled(found):
            self._draw_dots(canvas, found, names=names)
            return canvas
        canvas.stroke([self.place(drawing.finite_points(curve)) for curve in found.outlines], drawing.SKY)
        if not len(found):
            for other in found.others[:1]:
                _draw_marks(canvas, self.place(drawing.finite_points(other.uv)), drawing.ORANGE)
            return canvas
        uv = self.place(found.uv)
        chains = _join_rows(found.points, uv)
        lines = [uv[chain] for chain in chains if len(chain) > 1]
        canvas.stroke(lines, drawing.SKY, rim=int(_ring_radius(uv) >= RIMMED_RADIUS_PX))
        _draw_marks(canvas, uv, drawing.VERMILLION)
        self._draw_inferred(canvas, found.inferred, _ring_radius(uv))
        if chains:
            _write_numbers(canvas, found.points, uv, chains, few=not names)
        elif names:
            _write_names(canvas, found.points, uv)
        return canvas

    def _draw_dots(self, canvas: Canvas, found: Detected, *, names: bool) -> None:
        """Rings around the dots found, thick ones around those that a person labelled, crosses where others must be."""
        texts, every, gone = _all_dots(found)
        uv, gone = self.place(every), self.place(gone)
        apart = float(np.median(_distances_to_nearest(uv))) if len(uv) > 1 else np.inf
        radius, size = float(np.clip(0.2 * apart, 2.0, 9.0)), float(np.clip(0.3 * apart, NAME_PX, MAX_NAME_PX))
        rim = int(radius >= RIMMED_RADIUS_PX)
        by_hand = [name in found.notes["labelled"] for name in found.points]
        for labelled, colour in ((False, drawing.SKY), (True, drawing.ORANGE)):
            at = [place for place, hand in zip(uv, by_hand, strict=False) if hand == labelled]
            canvas.stroke([drawing.circle(place, radius + 2 * labelled) for place in at], colour, 1 + 2 * labelled, rim)
        arms = 0.8 * radius * np.array([[(-1, -1), (1, 1)], [(-1, 1), (1, -1)]])
        canvas.stroke([place + arm for place in gone for arm in arms], drawing.VERMILLION, 2, rim)
        if names and self.scale >= 0.99 * _scale_to_read(found):
            colours = [drawing.ORANGE if hand else drawing.SKY for hand in by_hand]
            for text, (u, v), colour in zip(texts, uv, [*colours, *[drawing.VERMILLION] * len(gone)], strict=True):
                canvas.write(text, (u, v + radius + 3 + size / 2), size, colour, "mm", rim=1)

    def _draw_inferred(self, canvas: Canvas, inferred: Inferred, radius: float) -> None:
        """Hollow rings where hidden points must be, and the ellipses that hold 95 % where those are larger."""
        circle = drawing.circle(np.zeros(2), 1.0)
        curves = []
        for place, covariance in zip(self.place(inferred.uv), inferred.covariance, strict=True):
            curves.append(place + radius * circle)
            root = np.linalg.cholesky(covariance) * self.scale * ELLIPSE_SDS
            if np.linalg.norm(root, 2) > radius:
                curves.append(place + circle @ root.T)
        canvas.stroke(curves, drawing.ORANGE, rim=int(radius >= RIMMED_RADIUS_PX))


def _find_neighbourhood(found: Detected, shape: tuple[int, ...]) -> _Window | None:
    """The window of a tile's proportions around what was found; None where that is most of the picture."""
    if not len(found):
        return None
    points = drawing.finite_points(np.concatenate([found.uv, *found.outlines]))
    low, high = points.min(axis=0), points.max(axis=0)
    margin = max(12.0, 0.35 * float((high - low).max()))
    width = max(high[0] - low[0] + 2 * margin, (high[1] - low[1] + 2 * margin) * TILE_PX[0] / TILE_PX[1], 40.0)
    height = width * TILE_PX[1] / TILE_PX[0]
    if width > 0.7 * shape[1] or height > 0.7 * shape[0]:
        return None
    corner = (low + high) / 2 - (width / 2, height / 2)
    left, top = np.clip(np.rint(corner), 0, (shape[1] - np.ceil(width), shape[0] - np.ceil(height)))
    return _Window.fitting(int(left), int(top), int(np.ceil(width)), int(np.ceil(height)))


def _join_rows(points: Sequence[str], uv: Floats) -> list[list[int]]:
    """Runs of board corners that are next to each other, by their numbers; none for other points."""
    numbers = {int(match[1]): i for i, name in enumerate(points) if (match := _CORNER.fullmatch(name))}
    if len(numbers) < 4:
        return []
    step = np.median(_distances_to_nearest(uv)) if len(uv) > 1 else 0.0
    chains: list[list[int]] = []
    for number in sorted(numbers):
        before, i = numbers.get(number - 1), numbers[number]
        if before is not None and np.linalg.norm(uv[i] - uv[before]) < 2.2 * step and chains:
            chains[-1].append(i)
        else:
            chains.append([i])
    return chains


def _distances_to_nearest(uv: Floats) -> Floats:
    """(n,) how far each of the first 500 points is from the one nearest to it."""
    some = uv[:500]
    squares = ((some[:, None] - some[None]) ** 2).sum(axis=2)
    np.fill_diagonal(squares, np.inf)
    return np.asarray(np.sqrt(squares.min(axis=1)), dtype=np.float64)


def _ring_radius(uv: Floats) -> float:
    """Of the ring around a point: rings of neighbours do not touch."""
    apart = float(np.median(_distances_to_nearest(uv))) if len(uv) > 1 else np.inf
    return float(np.clip(0.25 * apart, 2.0, 8.0 if len(uv) <= MAX_NAMED_POINTS else 6.0))


def _draw_marks(canvas: Canvas, uv: Floats, colour: drawing.Colour) -> None:
    """A ring around each point, with arms where there are few; a dot where points are too close for rings."""
    radius = _ring_radius(uv)
    rimmed = radius >= RIMMED_RADIUS_PX
    if rimmed:
        few = len(uv) <= MAX_NAMED_POINTS
        arms = [place + radius * np.outer((1.0, 1.9), way) for place in uv for way in _WAYS if few]
        canvas.stroke([*(drawing.circle(place, radius) for place in uv), *arms], colour)
    for place in uv:
        canvas.dot(place, 1.0 if rimmed else 0.75 * radius, colour)


def _write_numbers(canvas: Canvas, points: Sequence[str], uv: Floats, chains: list[list[int]], *, few: bool) -> None:
    """The numbers of board corners before their rows, as far as they have space, and a ring around number 1."""
    last, radius = np.full(2, np.inf), _ring_radius(uv)
    for chain in chains:
        number, start = int(points[chain[0]].rpartition("-c")[2]), uv[chain[0]]
        if number == 1:
            canvas.stroke([drawing.circle(start, 1.7 * radius)], drawing.ORANGE, 2, 0)
        elif few or np.linalg.norm(start - last) < 13:
            continue
        back = start - uv[chain[1]] if len(chain) > 1 else np.array([-1.0, 0.0])
        at = start + back / max(float(np.linalg.norm(back)), 1e-9) * (2 * radius + 9)
        size, colour = (18, drawing.ORANGE) if number == 1 else (12, drawing.WHITE)
        canvas.write(str(number), (at[0], at[1]), size, colour, "mm", rim=1)
        last = start


def _write_names(canvas: Canvas, points: Sequence[str], uv: Floats) -> None:
    """Names beside the points where they have space."""
    size = 11 if len(uv) > MAX_NAMED_POINTS else 14
    if len(uv) > MAX_NAMED_POINTS and np.median(_distances_to_nearest(uv)) < 14 + max(
        drawing.text_width(name, size) for name in points
    ):
        return
    for name, (u, v) in zip(points, uv, strict=True):
        canvas.write(name, (u + size, v - 0.7 * size), size, drawing.WHITE, rim=1)


def _draw_magnified(canvas: Canvas, grey: Pixels, found: Detected, whole: _Window) -> None:
    """Where what was found is small in the picture: enlarged in the corner that is farthest from it."""
    near = _find_neighbourhood(found, grey.shape)
    if near is None or near.width > 0.3 * grey.shape[1] or near.height > 0.3 * grey.shape[0]:
        return
    scale = min(0.4 * canvas.width / near.width, 0.45 * canvas.height / near.height, 16.0)
    if scale < 1.5 * whole.scale:
        return
    large = replace(near, scale=scale).draw(grey, found)
    large.border(2, drawing.ORANGE)
    low, high = whole.place(near.corners)
    at_top, at_left = (low + high)[1] > canvas.height, (low + high)[0] > canvas.width
    left = 8 if at_left else canvas.width - large.width - 8
    top = 8 if at_top else canvas.height - large.height - 8
    outer = np.array([(left, top), (left + large.width, top + large.height)], dtype=np.float64)
    # The lines from frame to frame go where they cross neither of the two.
    small_box, large_box = drawing.box(low, high), drawing.box(*outer)
    lines = [np.array([small_box[k], large_box[k]]) for k in ((1, 3) if at_top == at_left else (0, 2))]
    canvas.stroke([*lines, small_box], drawing.ORANGE, 1, 0)
    canvas.paste(large, left, top)


def _draw_inset(tile: Canvas, grey: Pixels, window: _Window, uv: Floats) -> None:
    """The whole picture in the corner of the tile that hides the fewest points, with a frame where the window is."""
    scale = min(0.28 * TILE_PX[0] / grey.shape[1], 0.34 * TILE_PX[1] / grey.shape[0])
    whole = _Window(0, 0, grey.shape[1], grey.shape[0], scale)
    small = whole.cut(grey)
    small.stroke([drawing.box(*whole.place(window.corners))], drawing.ORANGE, 1, 0)
    small.border(1, drawing.WHITE)
    size = np.array([small.width, small.height])
    corners = [np.array(part) * ((tile.width, tile.height) - size) for part in ((1, 1), (0, 1), (1, 0), (0, 0))]
    weights = np.ones(len(uv))
    weights[0] = len(uv)  # the first point has a mark of its own, which tells how a board stands
    hidden = [weights @ ((uv > at - 20) & (uv < at + size + 20)).all(axis=1) for at in corners]
    left, top = corners[int(np.argmin(hidden))]
    tile.paste(small, int(left), int(top))


def _add_caption(canvas: Canvas, result: Result) -> Canvas:
    """The canvas above a strip that says which picture this is, what was found, and what was not, why."""
    width, colour = max(canvas.width, 560), STATES[result.state]
    lines = drawing.wrap_text(result.found.reason, width - 24, 15, 5)
    if _is_labelled(result.found):
        lines.insert(0, "ring: found; thick ring: labelled; cross: missing")
    strip = drawing.blank(width, 34 + 22 * len(lines) + (6 if lines else 0), drawing.DARK)
    strip.fill(0, 0, width, 4, colour)
    strip.fill(width - 30, 12, width - 13, 29, colour)
    strip.write(result.summary, (width - 40, 25), 16, drawing.WHITE, "rs")
    name = drawing.cut_text(
        f"{result.view.camera}   {result.view.shot}", width - drawing.text_width(result.summary, 16) - 68, 16
    )
    strip.write(name, (12, 25), 16, drawing.WHITE)
    for i, line in enumerate(lines):
        strip.write(line, (12, 48 + 22 * i), 15, drawing.ORANGE)
    return Canvas(np.concatenate([_centre(canvas, width, canvas.height).pixels, strip.pixels]))


def _centre(canvas: Canvas, width: int, height: int) -> Canvas:
    page = drawing.blank(max(width, canvas.width), max(height, canvas.height), drawing.DARK)
    page.paste(canvas, (page.width - canvas.width) // 2, (page.height - canvas.height) // 2)
    return page


def _draw_unreadable(width: int, height: int) -> Canvas:
    """In place of a picture that cannot be read."""
    canvas = drawing.blank(width, height, (70, 70, 70))
    diagonals = np.array([[(0, 0), (width, height)], [(0, height), (width, 0)]], dtype=np.float64)
    canvas.stroke(list(diagonals), (128, 128, 128), 1, 0)
    return canvas
