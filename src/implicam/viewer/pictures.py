"""What the cameras see, as one picture: where the ball is, where it has to go, and how far that is.

Nothing here knows of a browser: a State and a size give an array. Circle and cross in orange: the next target. Outline
in sky blue: the ball. Every state is written in words as well.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from implicam import drawing
from implicam.dataset import Floats
from implicam.drawing import Canvas, Pixels
from implicam.images import eight_bit, opencv
from implicam.session.controller import State
from implicam.session.detections import Look

TARGET, BALL, GOOD, BAD = drawing.ORANGE, drawing.SKY, drawing.GREEN, drawing.VERMILLION
PAPER, GREY = (36, 38, 43), (74, 77, 84)

ON_TARGET_PX = 12.0
"""Pixels: a ball so near to its reticle is where it has to be."""

LOUPE_RADII = 4.0
"""The loupe shows so many radii of the ball around it."""

GAP_PX = 8

_WAYS = np.array([(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)])


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
        room = (width - GAP_PX * (columns - 1)) / columns, (height - GAP_PX * (rows - 1)) / rows
        across = min(room[0], room[1] * aspect)
        if across > best.width:
            best = Layout(columns, rows, max(1, int(across)), max(1, int(across / aspect)))
    return best


def montage(state: State, cameras: Sequence[str], aspects: Sequence[float], width: int, height: int) -> Pixels:
    """(height, width, 3) red, green, blue: a tile for each camera, as large as they fit; a grey one with words for a
    camera that has no picture. aspects: width over height of each camera's pictures."""
    plan = layout(aspects, width, height)
    looks = {look.camera: look for look in state.looks}
    across = plan.columns * plan.width + (plan.columns - 1) * GAP_PX
    page = drawing.blank(max(across, width), plan.rows * plan.height + (plan.rows - 1) * GAP_PX, drawing.DARK)
    for i, name in enumerate(cameras):
        tile = drawing.blank(plan.width, plan.height, PAPER)
        _draw_tile(tile, state, name, looks.get(name))
        left = (page.width - across) // 2 + i % plan.columns * (plan.width + GAP_PX)
        page.paste(tile, left, i // plan.columns * (plan.height + GAP_PX))
    return page.pixels


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


def verdict(state: State, look: Look) -> tuple[str, drawing.Colour]:
    """What there is to say of one camera, in a few words, and in which colour."""
    found, planned = len(look.found) > 0, state.target is not None and bool(np.isfinite(look.expected).all())
    if found and planned:
        distance = away(look)
        if state.phase == "shown":
            return f"found, {distance:.0f} px from the circle", GOOD
        return ("on target", GOOD) if distance <= ON_TARGET_PX else (f"{distance:.0f} px to go", TARGET)
    if state.calibration is not None and not planned and state.target is not None:
        return "target not in view", GREY
    if found:
        return "ball found", GOOD
    return ("ball not found", BAD) if state.phase == "shown" else ("no ball seen", GREY)


def _text_px(tile: Canvas) -> float:
    """Height of the type: what can be read from two metres where the tile is large."""
    return float(np.clip(tile.height / 13, 15, 40))


def _draw_tile(tile: Canvas, state: State, camera: str, look: Look | None) -> None:
    problem = trouble_of(state, camera)
    if problem or look is None or look.frame is None:
        reason = problem or (look.found.reason if look is not None else "") or "waiting for its first picture"
        _write_paragraph(tile, reason, BAD if problem else drawing.WHITE)
        _draw_strip(tile, camera, "camera trouble" if problem else "no picture", BAD if problem else GREY)
        return
    grey = eight_bit(look.frame.picture)
    scale = min(tile.width / grey.shape[1], tile.height / grey.shape[0])
    tile.paste(drawing.enlarge(grey, scale), 0, 0)
    _draw_marks(tile, state, look, scale)
    if state.phase == "shown" and len(look.found):
        _draw_loupe(tile, look, grey, scale)
    if state.phase == "shown" and look.found.reason:
        _write_footnote(tile, look.found.reason)
    text, colour = verdict(state, look)
    _draw_strip(tile, camera, text, colour)
    if state.phase == "shown":
        tile.border(4, GOOD if len(look.found) else BAD)


def _draw_marks(tile: Canvas, state: State, look: Look, scale: float) -> None:
    """The ball, the reticle, and the way from one to the other."""
    radius = max(16.0, tile.height / 16)
    planned = bool(np.isfinite(look.expected).all()) and state.phase in ("aim", "moving", "shown")
    if len(look.found):
        _draw_ball(tile, look, scale, radius / 2)
    if not planned:
        return
    reticle = _place(look.expected, scale)
    arms = [reticle + radius * np.outer((0.35, 1.6), way) for way in _WAYS]
    _stroke(tile, [drawing.circle(reticle, radius), *arms], TARGET)
    below = bool(look.uv[1] < look.expected[1])  # away from the ball, or else above
    at = float(reticle[0] + 0.8 * radius), float(reticle[1] + (1.2 if below else -1.2) * radius)
    tile.write("target", at, 0.75 * _text_px(tile), TARGET, "lm", 3)
    if len(look.found) and state.phase == "aim" and away(look) > ON_TARGET_PX:
        _draw_way(tile, _place(look.uv, scale), reticle, radius, f"{away(look):.0f} px")


def _place(uv: Floats, scale: float) -> Floats:
    """Where pixels (..., 2) of the picture come to lie in the tile."""
    return np.asarray((uv + 0.5) * scale - 0.5, dtype=np.float64)


def _stroke(canvas: Canvas, curves: Sequence[Floats], colour: drawing.Colour) -> None:
    canvas.stroke(curves, colour, 3, 2)


def _draw_ball(tile: Canvas, look: Look, scale: float, least: float) -> None:
    centre = _place(look.uv, scale)
    curves = [_place(drawing.finite_points(curve), scale) for curve in look.found.outlines]
    _stroke(tile, curves, BALL)
    if max((float(np.linalg.norm(curve - centre, axis=1).max(initial=0)) for curve in curves), default=0.0) < least:
        _stroke(tile, [drawing.circle(centre, least)], BALL)  # an outline that could not be seen from two metres


def _draw_way(tile: Canvas, ball: Floats, reticle: Floats, radius: float, words: str) -> None:
    """An arrow from the ball to the reticle's rim."""
    along = reticle - ball
    length = float(np.linalg.norm(along))
    if length <= 1.6 * radius:
        return
    along = along / length
    start, tip = ball + along * 0.7 * radius, reticle - along * 1.1 * radius
    side = np.array([-along[1], along[0]])
    head = [tip + radius * (sign * 0.4 * side - 0.8 * along) for sign in (1, -1)]
    _stroke(tile, [np.array([start, tip]), np.array([head[0], tip, head[1]])], drawing.WHITE)
    if length < 6 * radius:
        return
    size = _text_px(tile)
    u, v = (start + tip) / 2 + side * size * (0.9 if side[1] < 0 else -0.9)
    tile.write(words, (u, v), size, drawing.WHITE, "mm", 4)


def _draw_loupe(tile: Canvas, look: Look, grey: Pixels, scale: float) -> None:
    """The ball, enlarged, in the corner that is farthest from it: whether its outline is right is seen here."""
    cv2 = opencv()
    curves = [drawing.finite_points(curve) for curve in look.found.outlines]
    radius = max([6.0, *(float(np.linalg.norm(c - look.uv, axis=1).max(initial=0)) for c in curves)])
    side = round(0.36 * tile.height)
    zoom = side / (LOUPE_RADII * radius)
    if zoom < 1.3 * scale:
        return
    shift = np.array([[zoom, 0, side / 2 - zoom * look.uv[0]], [0, zoom, side / 2 - zoom * look.uv[1]]])
    inset = drawing.enlarge(cv2.warpAffine(grey, shift, (side, side), flags=cv2.INTER_LINEAR), 1)
    _stroke(inset, [c * zoom + shift[:, 2] for c in curves], BALL)
    _stroke(inset, [drawing.circle(np.full(2, side / 2), 2.0)], BALL)
    inset.border(2, drawing.WHITE)
    ball = _place(look.uv, scale)
    left = tile.width - side - 12 if ball[0] < tile.width / 2 else 12
    top = tile.height - side - 12 if ball[1] < 0.55 * tile.height else round(1.7 * _text_px(tile)) + 12
    tile.paste(inset, left, top)


def _draw_strip(tile: Canvas, camera: str, text: str, colour: drawing.Colour) -> None:
    """The camera's name, and what there is to say of it."""
    letters = _text_px(tile)
    height = round(1.7 * letters)
    strip = tile.pixels[:height]
    strip[:] = (0.35 * strip + 0.65 * np.array(drawing.DARK)).astype(np.uint8)
    tile.write(camera, (0.5 * letters, height / 2), 1.05 * letters, drawing.WHITE, "lm")
    size = 0.9 * letters
    width = drawing.text_width(text, size) + size
    right = tile.width - 0.3 * letters
    if right - width < drawing.text_width(camera, size) + 2 * letters:
        tile.write(text, (tile.width - 0.5 * letters, height / 2), 0.6 * letters, drawing.WHITE, "rm")
        return
    tile.fill(right - width, 4, right + 1, height - 4, colour)
    tile.write(text, (right - width / 2, height / 2), size, drawing.WHITE if sum(colour) < 400 else drawing.DARK, "mm")


def _write_paragraph(tile: Canvas, text: str, colour: drawing.Colour) -> None:
    """In the middle of a tile that has no picture."""
    size = _text_px(tile)
    lines = drawing.wrap_text(text, tile.width - 2 * size, size, 6)
    for i, line in enumerate(lines):
        y = tile.height / 2 + 0.7 * size + (i - (len(lines) - 1) / 2) * 1.35 * size
        tile.write(line, (tile.width / 2, y), size, drawing.WHITE if colour == BAD else colour, "mm")


def _write_footnote(tile: Canvas, text: str) -> None:
    size = 0.75 * _text_px(tile)
    for i, line in enumerate(reversed(drawing.wrap_text(text, tile.width - size, size, 3))):
        tile.write(line, (0.5 * size, tile.height - (0.8 + 1.3 * i) * size), size, drawing.WHITE, "lm", 4)
