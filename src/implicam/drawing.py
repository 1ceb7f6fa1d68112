"""What all pictures are drawn with: the sheets and overlays of `detect`, the live tiles of `acquire`.

Pixels are (height, width, 3) red, green, blue. Lines and marks are drawn at their sub-pixel place, on a dark rim so
that they read on black and on white. Colours are those that colour-blind people tell apart (Okabe & Ito). Text is drawn
by Pillow, whose type reads better than that of OpenCV 4.
"""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.errors import import_extra
from implicam.images import opencv

Pixels = NDArray[np.uint8]
Floats = NDArray[np.float64]
Colour = tuple[int, int, int]

SKY, GREEN, ORANGE, VERMILLION = (86, 180, 233), (0, 158, 115), (230, 159, 0), (213, 94, 0)
DARK, WHITE = (18, 19, 21), (255, 255, 255)

FRACTION_BITS = 4
"""OpenCV takes coordinates in 1/16 pixels."""

MAX_DRAWN_PX = 2.0**14
"""Pixels: what is farther off is drawn there, for OpenCV's whole numbers end."""

MIN_TEXT_PX = 8


def blank(width: int, height: int, colour: Colour) -> Canvas:
    """A canvas of one colour.

    Args:
        width: Pixels.
        height: Pixels.
        colour: Red, green, blue, each from 0 to 255.
    """
    return Canvas(np.full((height, width, 3), colour, np.uint8))


def enlarge(grey: Pixels, scale: float) -> Canvas:
    """A grey picture in another size, as a canvas.

    Args:
        grey: (height, width).
        scale: New over old size; at least one pixel is left, and from three times on each pixel stays a square.
    """
    cv2 = opencv()
    size = max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale))
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR if scale < 3 else cv2.INTER_NEAREST
    return Canvas(np.asarray(cv2.cvtColor(cv2.resize(grey, size, interpolation=how), cv2.COLOR_GRAY2RGB), np.uint8))


def circle(centre: Floats, radius: float) -> Floats:
    """A circle as a closed curve.

    Args:
        centre: (2,) pixels.
        radius: Pixels.

    Returns:
        (49, 2) pixels.
    """
    turn = np.linspace(0, 2 * np.pi, 49)
    return np.asarray(centre + radius * np.column_stack([np.cos(turn), np.sin(turn)]))


def box(low: Floats, high: Floats) -> Floats:
    """A box as a closed curve.

    Args:
        low: (2,) its left upper corner, pixels.
        high: (2,) its right lower corner, pixels.

    Returns:
        (5, 2) pixels.
    """
    (left, top), (right, bottom) = low, high
    return np.array([(left, top), (right, top), (right, bottom), (left, bottom), (left, top)])


def finite_points(curve: Floats) -> Floats:
    """The points of a curve that are numbers.

    Args:
        curve: (n, 2) pixels.

    Returns:
        (m, 2) pixels.
    """
    return curve[np.isfinite(curve).all(axis=1)]


@dataclass(frozen=True, eq=False)
class Canvas:
    """Pixels, and what can be drawn on them, in place.

    Attributes:
        pixels: (height, width, 3) red, green, blue.
    """

    pixels: Pixels

    @property
    def width(self) -> int:
        """In pixels."""
        return int(self.pixels.shape[1])

    @property
    def height(self) -> int:
        """In pixels."""
        return int(self.pixels.shape[0])

    def stroke(self, curves: Sequence[Floats], colour: Colour, width: int = 1, rim: int = 1) -> None:
        """Draw lines through points; the dark rims of all lie below all lines.

        Args:
            curves: (n, 2) pixels each.
            colour: Of the lines.
            width: Of the lines, pixels.
            rim: Of the dark rim on either side, pixels; 0 for none.
        """
        cv2 = opencv()
        fixed = [np.rint(_within(curve) * 2**FRACTION_BITS).astype(np.int32)[:, None] for curve in curves if len(curve)]
        for thickness, ink in ((width + 2 * rim, DARK), (width, colour)) if rim else ((width, colour),):
            cv2.polylines(self.pixels, fixed, False, ink, thickness, cv2.LINE_AA, FRACTION_BITS)

    def dot(self, centre: Floats, radius: float, colour: Colour) -> None:
        """Draw a filled disc.

        Args:
            centre: (2,) pixels.
            radius: Pixels.
            colour: Of the disc.
        """
        cv2 = opencv()
        at = [round(float(x) * 2**FRACTION_BITS) for x in _within(centre)]
        size = round(radius * 2**FRACTION_BITS)
        cv2.circle(self.pixels, at, size, colour, cv2.FILLED, cv2.LINE_AA, FRACTION_BITS)

    def fill(self, left: float, top: float, right: float, bottom: float, colour: Colour) -> None:
        """Draw a filled box, right and bottom excluded.

        Args:
            left: Pixels.
            top: Pixels.
            right: Pixels.
            bottom: Pixels.
            colour: Of the box.
        """
        self.pixels[max(0, int(top)) : max(0, int(bottom)), max(0, int(left)) : max(0, int(right))] = colour

    def border(self, width: int, colour: Colour) -> None:
        """Draw a frame on the outermost pixels.

        Args:
            width: Of the frame, pixels.
            colour: Of the frame.
        """
        inner = self.pixels[width:-width, width:-width].copy()
        self.pixels[:] = colour
        self.pixels[width:-width, width:-width] = inner

    def paste(self, other: Canvas, left: int, top: int) -> None:
        """Copy another canvas onto a part of this one; it must fit in.

        Args:
            other: The other canvas.
            left: Of the part, pixels.
            top: Of the part, pixels.
        """
        self.pixels[top : top + other.height, left : left + other.width] = other.pixels

    def write(
        self, text: str, at: tuple[float, float], size: float, colour: Colour, anchor: str = "ls", rim: int = 0
    ) -> None:
        """Write one line of text.

        Args:
            text: Accents are left out; what the font does not have becomes a question mark.
            at: Pixel of the anchor.
            size: Of the type, pixels.
            colour: Of the letters.
            anchor: Pillow's two letters: left, middle or right; middle or baseline ("s").
            rim: Of the dark rim around the letters, pixels.

        Raises:
            MissingExtraError: Pillow is not installed.
        """
        image, draw = (import_extra(f"PIL.{name}", "images", "text in pictures") for name in ("Image", "ImageDraw"))
        font, text = _font(size), _printable(text)
        left, top, right, bottom = font.getbbox(text, anchor=anchor, stroke_width=rim)
        x, y = round(at[0]), round(at[1])
        first, above = max(0, math.floor(x + left)), max(0, math.floor(y + top))
        part = self.pixels[above : max(0, math.ceil(y + bottom)), first : max(0, math.ceil(x + right))]
        if part.size:  # the rest of the canvas need not be copied
            drawn = image.fromarray(np.ascontiguousarray(part))
            draw.Draw(drawn).text(
                (x - first, y - above), text, colour, font, anchor, stroke_width=rim, stroke_fill=DARK
            )
            part[:] = np.asarray(drawn)


def _within(points: Floats) -> Floats:
    return np.clip(points, -MAX_DRAWN_PX, MAX_DRAWN_PX)


@lru_cache(maxsize=64)
def _font(size: float) -> Any:
    module = import_extra("PIL.ImageFont", "images", "text in pictures")
    return module.load_default(max(MIN_TEXT_PX, round(size)))


def _printable(text: str) -> str:
    """Letters that Pillow's own font has: umlauts lose their dots, what is no letter at all becomes a question mark."""
    letters = [letter for letter in unicodedata.normalize("NFKD", text) if not unicodedata.combining(letter)]
    return "".join(letter if " " <= letter <= "~" else "?" for letter in letters)


def text_width(text: str, size: float) -> float:
    """The width of a line of text, pixels.

    Args:
        text: The line.
        size: Of the type, pixels.
    """
    return float(_font(size).getlength(_printable(text)))


def cut_text(text: str, width: float, size: float) -> str:
    """The text, or its beginning and three dots, so that it fits.

    Args:
        text: The line.
        width: That it may have, pixels.
        size: Of the type, pixels.
    """
    if text_width(text, size) <= width:
        return text
    while text and text_width(text + "...", size) > width:
        text = text[:-1]
    return text + "..."


def wrap_text(text: str, width: float, size: float, lines: int) -> list[str]:
    """The text in lines that fit; the last of them is cut where there is more.

    Args:
        text: Words.
        width: That a line may have, pixels.
        size: Of the type, pixels.
        lines: How many there may be.
    """
    wrapped: list[str] = []
    words = text.split()
    while words and len(wrapped) < lines - 1:
        count = 1
        while count < len(words) and text_width(" ".join(words[: count + 1]), size) <= width:
            count += 1
        wrapped.append(cut_text(" ".join(words[:count]), width, size))
        words = words[count:]
    return [*wrapped, cut_text(" ".join(words), width, size)] if words else wrapped
