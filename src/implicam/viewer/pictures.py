"""What the cameras see, as one picture: where the ball is, where it has to go, and how far that is.

Nothing here knows of a browser: a State and a size give an array. Circle and cross in orange: the next target. Outline
in sky blue: the ball. Every state is written in words as well.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Floats
from implicam.errors import import_extra
from implicam.figures.style import GREEN, ORANGE, SKY, VERMILLION
from implicam.images import Grey, eight_bit, opencv
from implicam.session.controller import State
from implicam.session.detections import Look

Canvas = NDArray[np.uint8]
Colour = tuple[int, int, int]


def rgb(code: str) -> Colour:
    """#RRGGBB as red, green, blue."""
    return int(code[1:3], 16), int(code[3:5], 16), int(code[5:7], 16)


TARGET, BALL, GOOD, BAD = rgb(ORANGE), rgb(SKY), rgb(GREEN), rgb(VERMILLION)
DARK, PAPER, GREY, WHITE = (16, 18, 22), (36, 38, 43), (74, 77, 84), (255, 255, 255)

NEAR = 12.0
"""Pixels: a ball so near to its reticle is where it has to be."""

LOUPE = 4.0
"""The loupe shows so many radii of the ball around it."""

FAR = 1e4
"""Pixels of the montage beyond which nothing is drawn: OpenCV's whole numbers end."""

SHIFT = 4  # OpenCV takes coordinates in 1/16 pixels
GAP = 8


@dataclass(frozen=True)
class Layout:
    """Tiles of one size in columns; pixels."""

    columns: int
    rows: int
    width: int
    height: int


def layout(aspects: Sequence[float], width: int, height: int) -> Layout:
    """The columns that make tiles of these aspects (width over height) largest in width x height pixels."""
    aspect, best = max(aspects), Layout(1, len(aspects), 1, 1)
    for columns in range(1, len(aspects) + 1):
        rows = -(-len(aspects) // columns)
        room = (width - GAP * (columns - 1)) / columns, (height - GAP * (rows - 1)) / rows
        across = min(room[0], room[1] * aspect)
        if across > best.width:
            best = Layout(columns, rows, max(1, int(across)), max(1, int(across / aspect)))
    return best


def montage(state: State, cameras: Sequence[str], aspects: Sequence[float], width: int, height: int) -> Canvas:
    """(height, width, 3) red, green, blue: a tile for each camera, as large as they fit; a grey one with words for a
    camera that has no picture. aspects: width over height of each camera's pictures."""
    plan = layout(aspects, width, height)
    looks = {look.camera: look for look in state.looks}
    wide = plan.columns * plan.width + (plan.columns - 1) * GAP
    tall = plan.rows * plan.height + (plan.rows - 1) * GAP
    page = np.full((tall, max(wide, width), 3), DARK, np.uint8)
    words: list[_Words] = []
    for i, name in enumerate(cameras):
        top = i // plan.columns * (plan.height + GAP)
        left = (page.shape[1] - wide) // 2 + i % plan.columns * (plan.width + GAP)
        tile = _Tile(np.full((plan.height, plan.width, 3), PAPER, np.uint8))
        _draw(tile, state, name, looks.get(name))
        page[top : top + plan.height, left : left + plan.width] = tile.canvas
        words += [one.moved(left, top) for one in tile.words]
    return _written(page, words)


def trouble_of(state: State, camera: str) -> str:
    """What is wrong with this camera, in words; empty where nothing is known to be."""
    problem = state.problem
    if state.phase != "trouble" or problem is None or not re.search(rf"\b{re.escape(camera)}\b", problem.what):
        return ""
    return problem.what


def current(state: State) -> State:
    """The state with the reticles of its target: pictures of the point before show where that one was."""
    target = state.target
    if state.phase != "aim" or target is None or len(target.uv) != len(state.looks):
        return state
    return replace(state, looks=tuple(replace(a, expected=uv) for a, uv in zip(state.looks, target.uv, strict=True)))


def away(look: Look) -> float:
    """Pixels from the ball to where the target is expected; NaN where either is not known."""
    return float(np.linalg.norm(look.uv - look.expected))


def verdict(state: State, look: Look) -> tuple[str, Colour]:
    """What there is to say of one camera, in a few words, and in which colour."""
    found, planned = len(look.found) > 0, state.target is not None and bool(np.isfinite(look.expected).all())
    if found and planned:
        distance = away(look)
        if state.phase == "shown":
            return f"found, {distance:.0f} px from the circle", GOOD
        return ("on target", GOOD) if distance <= NEAR else (f"{distance:.0f} px to go", TARGET)
    if state.calibration is not None and not planned and state.target is not None:
        return "target not in view", GREY
    if found:
        return "ball found", GOOD
    return ("ball not found", BAD) if state.phase == "shown" else ("no ball seen", GREY)


@dataclass(frozen=True)
class _Words:
    text: str
    x: float
    y: float
    size: float
    colour: Colour = WHITE
    anchor: str = "lm"
    rim: int = 0

    def moved(self, dx: float, dy: float) -> _Words:
        return replace(self, x=self.x + dx, y=self.y + dy)


@dataclass
class _Tile:
    canvas: Canvas
    words: list[_Words] = field(default_factory=list)

    @property
    def letters(self) -> float:
        """Height of the type: what can be read from two metres where the tile is large."""
        return float(np.clip(self.canvas.shape[0] / 13, 15, 40))


def _draw(tile: _Tile, state: State, camera: str, look: Look | None) -> None:
    problem = trouble_of(state, camera)
    if problem or look is None or look.frame is None:
        reason = problem or (look.found.reason if look is not None else "") or "waiting for its first picture"
        _paragraph(tile, reason, BAD if problem else WHITE)
        _strip(tile, camera, "camera trouble" if problem else "no picture", BAD if problem else GREY)
        return
    picture = look.frame.picture
    scale = _paint(tile, picture)
    _marks(tile, state, look, scale)
    if state.phase == "shown" and len(look.found):
        _loupe(tile, look, picture, scale)
    if state.phase == "shown" and look.found.reason:
        _footnote(tile, look.found.reason)
    text, colour = verdict(state, look)
    _strip(tile, camera, text, colour)
    if state.phase == "shown":
        opencv().rectangle(tile.canvas, (0, 0), tile.canvas.shape[1::-1], GOOD if len(look.found) else BAD, 6)


def _paint(tile: _Tile, picture: Grey) -> float:
    """Put the picture into the tile; pixels of the tile per pixel of the picture."""
    cv2 = opencv()
    height, width = tile.canvas.shape[:2]
    scale = min(width / picture.shape[1], height / picture.shape[0])
    size = max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale))
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    tile.canvas[: size[1], : size[0]] = cv2.resize(eight_bit(picture), size, interpolation=how)[..., None]
    return float(scale)


def _marks(tile: _Tile, state: State, look: Look, scale: float) -> None:
    """The ball, the reticle, and the way from one to the other."""
    radius = max(16.0, tile.canvas.shape[0] / 16)
    planned = bool(np.isfinite(look.expected).all()) and state.phase in ("aim", "moving", "shown")
    if len(look.found):
        _ball(tile, look, scale, radius / 2)
    if not planned:
        return
    there = _placed(look.expected, scale)
    _reticle(tile, there, radius)
    below = bool(look.uv[1] < look.expected[1])  # away from the ball, or else above
    x, y = float(there[0] + 0.8 * radius), float(there[1] + (1.2 if below else -1.2) * radius)
    tile.words.append(_Words("target", x, y, 0.75 * tile.letters, TARGET, "lm", 3))
    if len(look.found) and state.phase == "aim" and away(look) > NEAR:
        _way(tile, _placed(look.uv, scale), there, radius, f"{away(look):.0f} px")


def _placed(uv: Floats, scale: float) -> Floats:
    """Where pixels (..., 2) of the picture come to lie in the tile."""
    return np.clip((uv + 0.5) * scale - 0.5, -FAR, FAR)


def _ball(tile: _Tile, look: Look, scale: float, least: float) -> None:
    there = _placed(look.uv, scale)
    curves = [_placed(curve[np.isfinite(curve).all(axis=1)], scale) for curve in look.found.outlines]
    _stroke(tile.canvas, [curve for curve in curves if len(curve) > 1], BALL)
    if not curves or max(float(np.linalg.norm(curve - there, axis=1).max(initial=0)) for curve in curves) < least:
        _ring(tile.canvas, there, least, BALL)  # an outline that nobody could see from two metres


def _reticle(tile: _Tile, there: Floats, radius: float) -> None:
    _ring(tile.canvas, there, radius, TARGET)
    arms = [np.array([there + way * radius * a, there + way * radius * b]) for way in _WAYS for a, b in ((0.35, 1.6),)]
    _stroke(tile.canvas, arms, TARGET)


_WAYS = np.array([(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)])


def _way(tile: _Tile, ball: Floats, there: Floats, radius: float, words: str) -> None:
    """An arrow from the ball to the reticle's rim."""
    along = there - ball
    length = float(np.linalg.norm(along))
    if length <= 1.6 * radius:
        return
    along = along / length
    start, tip = ball + along * 0.7 * radius, there - along * 1.1 * radius
    side = np.array([-along[1], along[0]])
    head = [tip, tip - along * 0.8 * radius + side * 0.4 * radius, tip - along * 0.8 * radius - side * 0.4 * radius]
    _stroke(tile.canvas, [np.array([start, tip]), np.array([head[1], head[0], head[2]])], WHITE)
    if length < 6 * radius:
        return
    middle = (start + tip) / 2 + side * tile.letters * (0.9 if side[1] < 0 else -0.9)
    tile.words.append(_Words(words, float(middle[0]), float(middle[1]), tile.letters, WHITE, "mm", 4))


def _loupe(tile: _Tile, look: Look, picture: Grey, scale: float) -> None:
    """The ball, enlarged, in the corner that is farthest from it: whether its outline is right is seen here."""
    cv2 = opencv()
    curves = [curve[np.isfinite(curve).all(axis=1)] for curve in look.found.outlines]
    radius = max([6.0, *(float(np.linalg.norm(c - look.uv, axis=1).max(initial=0)) for c in curves)])
    side = round(0.36 * tile.canvas.shape[0])
    zoom = side / (LOUPE * radius)
    if zoom < 1.3 * scale:
        return
    shift = np.array([[zoom, 0, side / 2 - zoom * look.uv[0]], [0, zoom, side / 2 - zoom * look.uv[1]]])
    enlarged = cv2.warpAffine(eight_bit(picture), shift, (side, side), flags=cv2.INTER_LINEAR)
    inset = np.ascontiguousarray(np.repeat(enlarged[..., None], 3, axis=2))
    _stroke(inset, [c * zoom + shift[:, 2] for c in curves if len(c) > 1], BALL)
    _ring(inset, np.array([side / 2, side / 2]), 2.0, BALL)
    cv2.rectangle(inset, (0, 0), (side - 1, side - 1), WHITE, 2)
    height, width = tile.canvas.shape[:2]
    ball = _placed(look.uv, scale)
    left = width - side - 12 if ball[0] < width / 2 else 12
    top = height - side - 12 if ball[1] < 0.55 * height else round(1.7 * tile.letters) + 12
    tile.canvas[top : top + side, left : left + side] = inset


def _strip(tile: _Tile, camera: str, text: str, colour: Colour) -> None:
    """The camera's name, and what there is to say of it."""
    high = round(1.7 * tile.letters)
    strip = tile.canvas[:high]
    strip[:] = (0.35 * strip + 0.65 * np.array(DARK)).astype(np.uint8)
    width = tile.canvas.shape[1]
    tile.words.append(_Words(camera, 0.5 * tile.letters, high / 2, 1.05 * tile.letters))
    size = 0.9 * tile.letters
    font = _font(round(size))
    box = font.getlength(text) + size
    right = width - 0.3 * tile.letters
    if right - box < font.getlength(camera) + 2 * tile.letters:
        return tile.words.append(_Words(text, width - 0.5 * tile.letters, high / 2, 0.6 * tile.letters, WHITE, "rm"))
    opencv().rectangle(tile.canvas, (int(right - box), 4), (int(right), high - 5), colour, -1)
    tile.words.append(_Words(text, right - box / 2, high / 2, size, WHITE if sum(colour) < 400 else DARK, "mm"))
    return None


def _paragraph(tile: _Tile, text: str, colour: Colour) -> None:
    height, width = tile.canvas.shape[:2]
    lines = textwrap.wrap(text, max(10, int(width / (0.52 * tile.letters)) - 3))[:6]
    for i, line in enumerate(lines):
        y = height / 2 + 0.7 * tile.letters + (i - (len(lines) - 1) / 2) * 1.35 * tile.letters
        tile.words.append(_Words(line, width / 2, y, tile.letters, WHITE if colour == BAD else colour, "mm"))


def _footnote(tile: _Tile, text: str) -> None:
    height, width = tile.canvas.shape[:2]
    size = 0.75 * tile.letters
    lines = textwrap.wrap(text, max(10, int(width / (0.52 * size)) - 2))[:3]
    for i, line in enumerate(reversed(lines)):
        tile.words.append(_Words(line, 0.5 * size, height - (0.8 + 1.3 * i) * size, size, WHITE, "lm", 4))


def _stroke(canvas: Canvas, curves: Sequence[Floats], colour: Colour) -> None:
    cv2 = opencv()
    fixed = [np.rint(curve * 2**SHIFT).astype(np.int32)[:, None] for curve in curves]
    for width, ink in ((7, DARK), (3, colour)):
        cv2.polylines(canvas, fixed, False, ink, width, cv2.LINE_AA, SHIFT)


def _ring(canvas: Canvas, there: Floats, radius: float, colour: Colour) -> None:
    turn = np.linspace(0, 2 * np.pi, 49)
    _stroke(canvas, [there + radius * np.column_stack([np.cos(turn), np.sin(turn)])], colour)


@lru_cache(maxsize=32)
def _font(size: int) -> Any:
    return import_extra("PIL.ImageFont", "viewer", "text in the pictures of implicam acquire").load_default(size)


def _written(page: Canvas, words: Sequence[_Words]) -> Canvas:
    """The text, in type that reads better than OpenCV's."""
    image = import_extra("PIL.Image", "viewer", "text in pictures").fromarray(page)
    pen = import_extra("PIL.ImageDraw", "viewer", "text in pictures").Draw(image)
    for one in words:
        pen.text(
            (one.x, one.y), one.text, fill=one.colour, font=_font(max(8, round(one.size))), anchor=one.anchor,
            stroke_width=one.rim, stroke_fill=DARK,
        )  # fmt: skip
    return np.asarray(image, dtype=np.uint8)
