"""Pictures to check by eye: what was found, drawn on the photograph; and all photographs of a camera on a sheet.

Marks are drawn at their sub-pixel place, on a dark rim so that they read on black and on white. Colours are those that
colour-blind people tell apart (Okabe & Ito), and every state is written in words as well.
"""

from __future__ import annotations

import hashlib
import json
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Floats
from implicam.detect.model import Detected, View
from implicam.errors import ImageError
from implicam.files import write_text
from implicam.images import eight_bit, opencv, read_picture, write_picture
from implicam.progress import Progress
from implicam.threads import side_by_side

Canvas = NDArray[np.uint8]
Colour = tuple[int, int, int]

# Blue, green, red, as OpenCV wants it.
SKY, GREEN, ORANGE, VERMILLION = (233, 180, 86), (115, 158, 0), (0, 159, 230), (0, 94, 213)
DARK, INK, PAPER, WHITE, GREY = (20, 20, 20), (60, 50, 40), (250, 250, 250), (255, 255, 255), (128, 128, 128)
STATES = {"found": GREEN, "partly found": ORANGE, "nothing found": VERMILLION}

MAX_SIDE_PX, MIN_SIDE_PX = 1600, 800
"""Pixels of an overlay's longer side: larger pictures are reduced, smaller ones enlarged by a whole number."""

COLUMNS, ROWS = 6, 6
TILE_PX, TEXT_PX = (320, 240), 62
"""Thumbnails of a page; the width and height of one, and the height of the text below it."""

DRAWN = "drawn.json"
"""The file that says what is drawn in which state."""

MAX_NAMED_POINTS = 12
"""So many points have their names beside them."""

RIMMED_RADIUS_PX = 4.0
"""Pixels: marks of this radius and larger are rings with a dark rim, smaller ones are dots."""

MAX_DRAWN_PX = 2.0**15
"""Pixels: nothing is drawn farther off than this, where OpenCV's whole numbers end."""

SHIFT = 4  # OpenCV takes coordinates in 1/16 pixels
_CORNER = re.compile(r".*-c(\d{3,})")


@dataclass(frozen=True, eq=False)
class Result:
    """What came of a picture. expected: how many known points belong to its shot, None where that is not known."""

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


def overlay(grey: Canvas | None, result: Result) -> Canvas:
    """The whole picture with what was found, and a caption: (height, width, 3), blue, green, red.

    grey: the picture as `eight_bit` gives it, None where it cannot be read.
    """
    if grey is None:
        canvas = _empty(640, 400)
    else:
        height, width = grey.shape
        whole = _Window(0, 0, width, height, _scale(max(width, height)))
        canvas = _drawn(grey, result.found, whole)
        _loupe(canvas, grey, result.found, whole)
    return _captioned(canvas, result)


def _scale(longest: int) -> float:
    if longest < MIN_SIDE_PX:
        return float(min(16, MAX_SIDE_PX // longest))
    return min(1.0, MAX_SIDE_PX / longest)


def thumbnail(grey: Canvas | None, result: Result) -> Canvas:
    """A tile of a sheet: the neighbourhood of what was found, the whole picture small, and a caption below."""
    width, height = TILE_PX
    if grey is None:
        inner = _empty(width, height)
    else:
        whole = _Window.fitting(0, 0, grey.shape[1], grey.shape[0])
        window = _neighbourhood(result.found, grey.shape) or whole
        inner = _drawn(grey, result.found, window, names=False)
        if window is not whole:
            _inset(inner, grey, window, window.place(result.found.uv))
        inner = _centred(inner, width, height)
    return _framed(inner, result)


def sheet(title: str, tiles: Sequence[Canvas]) -> Canvas:
    """Thumbnails side by side under a title and the meaning of the colours."""
    cv2 = opencv()
    gap, head = 12, 56
    height, width = tiles[0].shape[:2]
    columns = min(COLUMNS, len(tiles))
    rows = -(-len(tiles) // columns)
    across = max(columns * (width + gap) + gap, 3 * (width + gap) + gap)
    page = np.full((head + rows * (height + gap), across, 3), PAPER, np.uint8)
    x = page.shape[1] - gap
    for state, colour in reversed(STATES.items()):
        x -= _width(state, 0.5) + 12
        _write(page, state, (x, 35), INK, 0.5)
        x -= 24
        cv2.rectangle(page, (x, 22), (x + 15, 37), colour, cv2.FILLED)
        x -= 10
    _write(page, _cut(title, x - 2 * gap, 0.62), (gap, 36), INK, 0.62)
    for i, tile in enumerate(tiles):
        top, left = head + i // columns * (height + gap), gap + i % columns * (width + gap)
        page[top : top + height, left : left + width] = tile
    return page


def draw(
    folder: Path, results: Sequence[Result], progress: Progress, *, redraw: bool = False
) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Write folder/overlays/<camera>/<shot>.jpg and folder/<camera>.jpg, -2.jpg, ...; the sheets, and notes of failure.

    What is there and shows the same is left alone, unless `redraw`. What shows pictures that are gone is removed.
    """
    before = {} if redraw else _drawn_before(folder / DRAWN)
    now: dict[str, str] = {}
    notes: list[str] = []
    pages = _pages(results)
    done = iter(range(1, len(results) + 1))
    for page in pages:
        now |= page.draw(folder, before, lambda: progress("drawing overlays", next(done), len(results)), notes)
        write_text(folder / DRAWN, json.dumps({**before, **now}))
    for name in before.keys() - now.keys():
        path = folder / name
        if path.suffix == ".jpg" and path.resolve().is_relative_to(folder.resolve()):
            path.unlink(missing_ok=True)
    write_text(folder / DRAWN, json.dumps(now))
    return tuple(folder / page.name for page in pages if (folder / page.name).exists()), tuple(notes)


@dataclass(frozen=True, eq=False)
class _Page:
    """Some pictures of a camera. name: of the sheet."""

    name: str
    title: str
    results: Sequence[Result]

    def draw(
        self, folder: Path, before: Mapping[str, str], step: Callable[[], None], notes: list[str]
    ) -> dict[str, str]:
        """Draw the sheet and its overlays where they are not there; {file: digest} of what is there then."""
        digests = {_overlay_name(result): _digest(result) for result in self.results}
        content = hashlib.sha256(json.dumps([self.title, list(digests.items())]).encode()).hexdigest()

        def wanted(name: str, digest: str) -> bool:
            return before.get(name) != digest or not (folder / name).exists()

        def one(result: Result) -> Canvas:
            name, tile = _overlay_name(result), thumbnail(None, result)
            try:
                new = wanted(name, digests[name])
                grey = _readable(result.path) if new or whole else None
                if new:
                    write_picture(folder / name, overlay(grey, result))
                tile = thumbnail(grey, result) if whole else tile
            except Exception as error:  # what was found is worth more than its drawing
                digests.pop(name)
                notes.append(f"{folder / name} is not drawn: {error}")
            step()
            return tile

        whole = wanted(self.name, content)
        tiles = side_by_side(one, self.results)
        if whole:
            write_picture(folder / self.name, sheet(self.title, tiles))
        return {**digests, self.name: content}


def _pages(results: Sequence[Result]) -> list[_Page]:
    pages = []
    cameras = list(dict.fromkeys(result.view.camera for result in results))
    for camera in cameras:
        own = [result for result in results if result.view.camera == camera]
        states = Counter(result.state for result in own)
        counts = ", ".join(f"{states[state]} {state}" for state in STATES if states[state])
        for number, first in enumerate(range(0, len(own), COLUMNS * ROWS), 1):
            name = camera if number == 1 else f"{camera}-{number}"
            while number > 1 and name in cameras:
                name += "_"
            of = f", page {number} of {-(-len(own) // (COLUMNS * ROWS))}" if len(own) > COLUMNS * ROWS else ""
            title = f"{camera}: {len(own)} picture{'s' if len(own) > 1 else ''}, {counts}{of}"
            pages.append(_Page(f"{name}.jpg", title, own[first : first + COLUMNS * ROWS]))
    return pages


def _overlay_name(result: Result) -> str:
    return f"overlays/{result.view.camera}/{result.view.shot}.jpg"


def _digest(result: Result) -> str:
    try:
        state = result.path.stat()
        file = [state.st_size, state.st_mtime_ns]
    except OSError:
        file = []
    content = json.dumps([file, result.expected, result.found.as_dict()], default=repr)
    return hashlib.sha256(content.encode()).hexdigest()


def _drawn_before(record: Path) -> dict[str, str]:
    """{file: digest} of what earlier runs drew."""
    try:
        table = json.loads(record.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return {str(name): str(digest) for name, digest in table.items()} if isinstance(table, dict) else {}


def _readable(path: Path) -> Canvas | None:
    try:
        return eight_bit(read_picture(path))
    except ImageError:
        return None


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

    def place(self, uv: Floats) -> Floats:
        """Where pixels (n, 2) of the picture come to lie: a pixel's centre stays the centre of what it becomes."""
        return np.clip((uv + 0.5 - (self.left, self.top)) * self.scale - 0.5, -MAX_DRAWN_PX, MAX_DRAWN_PX)

    def cut(self, grey: Canvas) -> Canvas:
        cv2 = opencv()
        part = grey[self.top : self.top + self.height, self.left : self.left + self.width]
        size = (max(1, round(self.width * self.scale)), max(1, round(self.height * self.scale)))
        how = cv2.INTER_AREA if self.scale < 1 else cv2.INTER_LINEAR if self.scale < 3 else cv2.INTER_NEAREST
        return np.asarray(cv2.cvtColor(cv2.resize(part, size, interpolation=how), cv2.COLOR_GRAY2BGR), np.uint8)


def _neighbourhood(found: Detected, shape: tuple[int, ...]) -> _Window | None:
    """The window of a tile's proportions around what was found; None where that is most of the picture."""
    if not len(found):
        return None
    spread = _finite(np.concatenate([found.uv, *found.outlines]))
    low, high = spread.min(axis=0), spread.max(axis=0)
    margin = max(12.0, 0.35 * float((high - low).max()))
    width = max(high[0] - low[0] + 2 * margin, (high[1] - low[1] + 2 * margin) * TILE_PX[0] / TILE_PX[1], 40.0)
    height = width * TILE_PX[1] / TILE_PX[0]
    if width > 0.7 * shape[1] or height > 0.7 * shape[0]:
        return None
    corner = (low + high) / 2 - (width / 2, height / 2)
    left, top = np.clip(np.rint(corner), 0, (shape[1] - np.ceil(width), shape[0] - np.ceil(height)))
    return _Window.fitting(int(left), int(top), int(np.ceil(width)), int(np.ceil(height)))


def _drawn(grey: Canvas, found: Detected, window: _Window, *, names: bool = True) -> Canvas:
    """The window of the picture with outlines, lines, marks and names."""
    canvas = window.cut(grey)
    for curve in found.outlines:
        _lines(canvas, [window.place(_finite(curve))], SKY)
    uv = window.place(found.uv)
    if not len(found):
        for other in found.others[:1]:
            _marks(canvas, window.place(_finite(other.uv)), ORANGE)
        return canvas
    chains = _rows(found.points, uv)
    _lines(canvas, [uv[chain] for chain in chains if len(chain) > 1], SKY, rim=_radius(uv) >= RIMMED_RADIUS_PX)
    _marks(canvas, uv, VERMILLION)
    if chains:
        _numbers(canvas, found.points, uv, chains, few=not names)
    elif names:
        _names(canvas, found.points, uv)
    return canvas


def _finite(curve: Floats) -> Floats:
    return curve[np.isfinite(curve).all(axis=1)]


def _rows(points: Sequence[str], uv: Floats) -> list[list[int]]:
    """Runs of board corners that are next to each other, by their numbers; none for other points."""
    numbers = {int(match[1]): i for i, name in enumerate(points) if (match := _CORNER.fullmatch(name))}
    if len(numbers) < 4:
        return []
    step = np.median(_to_nearest(uv)) if len(uv) > 1 else 0.0
    chains: list[list[int]] = []
    for number in sorted(numbers):
        before, i = numbers.get(number - 1), numbers[number]
        if before is not None and np.linalg.norm(uv[i] - uv[before]) < 2.2 * step and chains:
            chains[-1].append(i)
        else:
            chains.append([i])
    return chains


def _to_nearest(uv: Floats) -> Floats:
    """(n,) how far each of the first 500 points is from the one nearest to it."""
    some = uv[:500]
    squares = ((some[:, None] - some[None]) ** 2).sum(axis=2)
    np.fill_diagonal(squares, np.inf)
    return np.asarray(np.sqrt(squares.min(axis=1)), dtype=np.float64)


def _radius(uv: Floats) -> float:
    """Of the ring around a point: rings of neighbours do not touch."""
    apart = float(np.median(_to_nearest(uv))) if len(uv) > 1 else np.inf
    return float(np.clip(0.25 * apart, 2.0, 8.0 if len(uv) <= MAX_NAMED_POINTS else 6.0))


def _marks(canvas: Canvas, uv: Floats, colour: Colour) -> None:
    """A ring around each point, with arms where there are few; a dot where points are too close for rings."""
    cv2 = opencv()
    radius = _radius(uv)
    if radius < RIMMED_RADIUS_PX:
        for place in uv:
            cv2.circle(canvas, _fixed(place), round(0.75 * radius * 2**SHIFT), colour, cv2.FILLED, cv2.LINE_AA, SHIFT)
        return
    for width, ink in ((3, DARK), (1, colour)):
        for u, v in uv:
            cv2.circle(canvas, _fixed((u, v)), round(radius * 2**SHIFT), ink, width, cv2.LINE_AA, SHIFT)
            for du, dv in ((1, 0), (-1, 0), (0, 1), (0, -1)) if len(uv) <= MAX_NAMED_POINTS else ():
                ends = [_fixed((u + du * part * radius, v + dv * part * radius)) for part in (1.0, 1.9)]
                cv2.line(canvas, *ends, ink, width, cv2.LINE_AA, SHIFT)
    for place in uv:
        cv2.circle(canvas, _fixed(place), 2**SHIFT, colour, cv2.FILLED, cv2.LINE_AA, SHIFT)


def _numbers(canvas: Canvas, points: Sequence[str], uv: Floats, chains: list[list[int]], *, few: bool) -> None:
    """The numbers of board corners before their rows, as far as there is room, and a ring around number 1."""
    last, radius = np.full(2, np.inf), _radius(uv)
    for chain in chains:
        number, start = int(points[chain[0]].rpartition("-c")[2]), uv[chain[0]]
        if number == 1:
            cv2 = opencv()
            cv2.circle(canvas, _fixed(start), round(1.7 * radius * 2**SHIFT), ORANGE, 2, cv2.LINE_AA, SHIFT)
        elif few or np.linalg.norm(start - last) < 13:
            continue
        back = start - uv[chain[1]] if len(chain) > 1 else np.array([-1.0, 0.0])
        size, text = (0.55, "1") if number == 1 else (0.36, str(number))
        u, v = start + back / max(float(np.linalg.norm(back)), 1e-9) * (2 * radius + 9)
        place = u - _width(text, size) / 2, v + 9 * size
        _write(canvas, text, place, ORANGE if number == 1 else WHITE, size, rim=True)
        last = start


def _names(canvas: Canvas, points: Sequence[str], uv: Floats) -> None:
    """Names beside the points where there is room."""
    size = 0.36 if len(uv) > MAX_NAMED_POINTS else 0.45
    if len(uv) > MAX_NAMED_POINTS and np.median(_to_nearest(uv)) < 14 + max(_width(name, size) for name in points):
        return
    for name, (u, v) in zip(points, uv, strict=True):
        _write(canvas, name, (u + 29 * size, v - 20 * size), WHITE, size, rim=True)


def _loupe(canvas: Canvas, grey: Canvas, found: Detected, whole: _Window) -> None:
    """Where what was found is small in the picture: enlarged in the corner that is farthest from it."""
    cv2 = opencv()
    near = _neighbourhood(found, grey.shape)
    height, width = canvas.shape[:2]
    if near is None or near.width > 0.3 * grey.shape[1] or near.height > 0.3 * grey.shape[0]:
        return
    scale = min(0.4 * width / near.width, 0.45 * height / near.height, 16.0)
    if scale < 1.5 * whole.scale:
        return
    large = cv2.copyMakeBorder(
        _drawn(grey, found, replace(near, scale=scale)), 2, 2, 2, 2, cv2.BORDER_CONSTANT, value=ORANGE
    )
    low = whole.place(np.array([[near.left, near.top]]) - 0.5)[0]
    high = low + np.array([near.width, near.height]) * whole.scale
    rows, columns = large.shape[:2]
    top = 8 if (low + high)[1] > height else height - rows - 8
    left = 8 if (low + high)[0] > width else width - columns - 8
    corners = [((low[0], low[1]), (left, top)), ((high[0], high[1]), (left + columns, top + rows))]
    if (top == 8) == (left == 8):  # the lines go where they cross neither of the two frames
        corners = [((high[0], low[1]), (left + columns, top)), ((low[0], high[1]), (left, top + rows))]
    for start, end in corners:
        cv2.line(canvas, _fixed(start), _fixed(end), ORANGE, 1, cv2.LINE_AA, SHIFT)
    cv2.rectangle(canvas, _fixed(low), _fixed(high), ORANGE, 1, cv2.LINE_AA, SHIFT)
    canvas[top : top + rows, left : left + columns] = large


def _inset(tile: Canvas, grey: Canvas, window: _Window, uv: Floats) -> None:
    """The whole picture in the corner of the tile that hides the fewest points, with a frame where the window is."""
    cv2 = opencv()
    scale = min(0.28 * TILE_PX[0] / grey.shape[1], 0.34 * TILE_PX[1] / grey.shape[0])
    whole = _Window(0, 0, grey.shape[1], grey.shape[0], scale)
    small = whole.cut(grey)
    low = whole.place(np.array([[window.left, window.top]], dtype=np.float64))[0]
    high = low + np.array([window.width, window.height]) * scale
    cv2.rectangle(small, _fixed(low), _fixed(high), ORANGE, 1, cv2.LINE_AA, SHIFT)
    small = cv2.copyMakeBorder(small, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=WHITE)
    room = np.array(tile.shape[1::-1]) - small.shape[1::-1]
    corners = [np.array(part) * room for part in ((1, 1), (0, 1), (1, 0), (0, 0))]
    weights = np.ones(len(uv))
    weights[0] = len(uv)  # the first point has a mark of its own, which tells how a board stands
    hidden = [weights @ ((uv > at - 20) & (uv < at + small.shape[1::-1] + 20)).all(axis=1) for at in corners]
    left, top = corners[int(np.argmin(hidden))]
    tile[top : top + small.shape[0], left : left + small.shape[1]] = small


def _captioned(canvas: Canvas, result: Result) -> Canvas:
    """The canvas above a strip that says which picture this is, what was found, and what was not, why."""
    cv2 = opencv()
    width = max(canvas.shape[1], 560)
    lines = _wrapped(result.found.reason, width - 24, 0.5)
    strip = np.full((34 + 22 * len(lines) + (6 if lines else 0), width, 3), DARK, np.uint8)
    cv2.rectangle(strip, (0, 0), (width, 3), STATES[result.state], cv2.FILLED)
    name = f"{result.view.camera}   {result.view.shot}"
    room = width - _width(result.summary, 0.55) - 48
    _write(strip, _cut(name, room, 0.55), (12, 25), WHITE, 0.55)
    cv2.rectangle(strip, (width - 30, 12), (width - 14, 28), STATES[result.state], cv2.FILLED)
    _write(strip, result.summary, (width - 40 - _width(result.summary, 0.55), 25), WHITE, 0.55)
    for i, line in enumerate(lines):
        _write(strip, line, (12, 48 + 22 * i), ORANGE, 0.5)
    return np.concatenate([_centred(canvas, width, canvas.shape[0]), strip])


def _framed(inner: Canvas, result: Result) -> Canvas:
    """A tile: a frame in the colour of its state, and the text below."""
    cv2 = opencv()
    tile = cv2.copyMakeBorder(inner, 4, TEXT_PX, 4, 4, cv2.BORDER_CONSTANT, value=WHITE)
    height, width = tile.shape[:2]
    colour = STATES[result.state]
    cv2.rectangle(tile, (2, 2), (width - 3, height - 3), colour, 4)
    top = height - TEXT_PX
    room = width - 30 - _width(result.summary, 0.45)
    _write(tile, _cut(result.view.shot, room, 0.5), (10, top + 17), INK, 0.5)
    _write(tile, result.summary, (width - 10 - _width(result.summary, 0.45), top + 17), INK, 0.45)
    lines = _wrapped(result.found.reason, width - 20, 0.38)
    if len(lines) > 2:
        lines = [lines[0], _cut(lines[1] + " " + lines[2], width - 20, 0.38)]
    for i, line in enumerate(lines):
        _write(tile, line, (10, top + 35 + 16 * i), INK, 0.38)
    return np.asarray(tile, np.uint8)


def _centred(canvas: Canvas, width: int, height: int) -> Canvas:
    rows, columns = canvas.shape[:2]
    if (rows, columns) == (height, width):
        return canvas
    out = np.full((max(height, rows), max(width, columns), 3), DARK, np.uint8)
    top, left = (out.shape[0] - rows) // 2, (out.shape[1] - columns) // 2
    out[top : top + rows, left : left + columns] = canvas
    return out


def _empty(width: int, height: int) -> Canvas:
    """In place of a picture that cannot be read."""
    cv2 = opencv()
    canvas = np.full((height, width, 3), (70, 70, 70), np.uint8)
    cv2.line(canvas, (0, 0), (width, height), GREY, 1, cv2.LINE_AA)
    cv2.line(canvas, (0, height), (width, 0), GREY, 1, cv2.LINE_AA)
    return canvas


def _lines(canvas: Canvas, curves: Sequence[Floats], colour: Colour, *, rim: bool = True) -> None:
    cv2 = opencv()
    fixed = [np.rint(curve * 2**SHIFT).astype(np.int32)[:, None] for curve in curves if len(curve)]
    for width, ink in ((3, DARK), (1, colour)) if rim else ((1, colour),):
        cv2.polylines(canvas, fixed, False, ink, width, cv2.LINE_AA, SHIFT)


def _fixed(place: Any) -> tuple[int, int]:
    return round(float(place[0]) * 2**SHIFT), round(float(place[1]) * 2**SHIFT)


def _write(
    canvas: Canvas, text: str, start: tuple[float, float], colour: Colour, size: float, *, rim: bool = False
) -> None:
    cv2 = opencv()
    origin = round(start[0]), round(start[1])
    steps = [(du, dv) for du in (-1, 0, 1) for dv in (-1, 0, 1)] if rim else []  # bold letters have other widths
    for (du, dv), ink in [*((step, DARK) for step in steps), ((0, 0), colour)]:
        place = origin[0] + du, origin[1] + dv
        cv2.putText(canvas, _plain(text), place, cv2.FONT_HERSHEY_SIMPLEX, size, ink, 1, cv2.LINE_AA)


def _width(text: str, size: float) -> int:
    cv2 = opencv()
    return int(cv2.getTextSize(_plain(text), cv2.FONT_HERSHEY_SIMPLEX, size, 1)[0][0])


def _plain(text: str) -> str:
    """Letters that OpenCV's font has: umlauts lose their dots, what is no letter at all becomes a question mark."""
    letters = [letter for letter in unicodedata.normalize("NFKD", text) if not unicodedata.combining(letter)]
    return "".join(letter if " " <= letter <= "~" else "?" for letter in letters)


def _cut(text: str, room: int, size: float) -> str:
    """The text, or its beginning and three dots, so that it fits."""
    if _width(text, size) <= room:
        return text
    while text and _width(text + "...", size) > room:
        text = text[:-1]
    return text + "..."


def _wrapped(text: str, room: int, size: float) -> list[str]:
    """The text in lines that fit, five at most."""
    lines: list[str] = []
    for word in text.split():
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and _width(longer, size) <= room:
            lines[-1] = longer
        else:
            lines.append(_cut(word, room, size))
    return lines[:5]
