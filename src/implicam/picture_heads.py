"""What the head of a photograph's file says, before anything is unpacked: PNG, JPEG, TIFF.

A small file can unpack to a picture of gigabytes, so its size is read here first. What decides is what the decoder
allocates: where a file says two sizes, the larger one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
BEGINNINGS = (PNG, JPEG, *TIFF)
"""How the files begin that are read."""

_TIFF_BYTES = {1: 1, 3: 2, 4: 4, 16: 8}
"""Of a number, by its type: BYTE, SHORT, LONG, LONG8."""

_MAX_TIFF_TAGS = 4096
"""Of one directory; cameras write some dozens."""


@dataclass(frozen=True)
class Head:
    """A picture as its file declares it: pixels, values of a pixel once it is decoded, bits of a value, how EXIF asks
    viewers to turn a JPEG (1 for not at all), and whether its decoder holds all coefficients at once (progressive)."""

    width: int
    height: int
    channels: int
    bits: int
    orientation: int = 1
    progressive: bool = False

    @property
    def unpacking_bytes(self) -> int:
        """What reading it takes at most: decoded, as grey, and as grey of float32."""
        value = max(1, -(-self.bits // 8))
        return self.width * self.height * (self.channels * (value + 2 * self.progressive) + value + 4)


def read_head(data: bytes) -> Head | None:
    """The head of a picture.

    Args:
        data: The file's bytes, or its beginning.

    Returns:
        What it declares; None where it declares no size, or is none of these formats.
    """
    head = None
    if data.startswith(PNG):
        head = _png(data)
    elif data.startswith(JPEG):
        head = _jpeg(data)
    elif data.startswith(TIFF):
        head = _tiff(data)
    return head if head is not None and head.width > 0 and head.height > 0 else None


def jpeg_segments(data: bytes) -> Iterator[tuple[int, int, int]]:
    """The segments of a JPEG up to its pixels, as a decoder goes through them: what lies between two is skipped.

    Args:
        data: The file's bytes, or its beginning.

    Yields:
        Marker, and where its content begins and ends; the last is that of the pixels (0xDA).
    """
    at = 2
    while (at := data.find(b"\xff", at)) >= 0:
        while data[at : at + 1] == b"\xff":
            at += 1
        if at + 3 > len(data):
            return
        marker = data[at]
        at += 1
        if marker in (0x00, 0x01) or 0xD0 <= marker <= 0xD8:  # no marker, or one without content
            continue
        length = int.from_bytes(data[at : at + 2], "big")
        yield marker, at + 2, at + length
        if marker in (0xD9, 0xDA) or length < 2:
            return
        at += length


def _png(data: bytes) -> Head | None:
    if data[12:16] != b"IHDR" or len(data) < 26:
        return None
    width, height = (int.from_bytes(data[i : i + 4], "big") for i in (16, 20))
    # colours of a palette may be transparent, and grey with transparency becomes four channels
    return Head(width, height, 1 if data[25] == 0 else 3 if data[25] == 2 else 4, data[24])


def _jpeg(data: bytes) -> Head | None:
    orientation = 1
    for marker, start, end in jpeg_segments(data):
        if marker == 0xE1 and data[start : start + 6] == b"Exif\0\0":
            orientation = _exif_orientation(data[start + 6 : end])
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC) and start + 6 <= len(data):
            height, width = (int.from_bytes(data[start + i : start + i + 2], "big") for i in (1, 3))
            progressive = marker in (0xC2, 0xC6, 0xCA, 0xCE)
            return Head(width, height, 3 if data[start + 5] > 1 else 1, data[start], orientation, progressive)
    return None


def _exif_orientation(tiff: bytes) -> int:
    """The tag 0x0112 of the first directory; 1 where it is not there."""
    found = max(_tiff_tags(tiff).get(0x0112, [1]))
    return found if 1 <= found <= 8 else 1


def _tiff(data: bytes) -> Head | None:
    tags = {tag: max(values) for tag, values in _tiff_tags(data).items()}
    if 256 not in tags or 257 not in tags:
        return None
    # a tile is decoded whole, even where it is larger than the picture
    width, height = max(tags[256], tags.get(322, 0)), max(tags[257], tags.get(323, 0))
    samples = tags.get(277, 1)
    return Head(width, height, samples if samples > 4 else 1 if samples == 1 else 4, tags.get(258, 1))


def _tiff_tags(data: bytes) -> dict[int, list[int]]:
    """The numbers of the first directory that stand in it; of a tag that is there twice, both."""
    order: Literal["little", "big"] = "little" if data[:2] == b"II" else "big"

    def number(at: int, size: int) -> int:
        return int.from_bytes(data[at : at + size], order)

    big = number(2, 2) == 43
    wide = 8 if big else 4
    start, entry = number(8 if big else 4, wide), 4 + 2 * wide
    first = start + (8 if big else 2)
    tags: dict[int, list[int]] = {}
    for at in range(first, first + entry * min(number(start, first - start), _MAX_TIFF_TAGS), entry):
        if at + entry > len(data):
            break
        count, size = number(at + 4, wide), _TIFF_BYTES.get(number(at + 2, 2), 0)
        if not size or count < 1:
            continue
        place = at + 4 + wide if count * size <= wide else number(at + 4 + wide, wide)
        tags.setdefault(number(at, 2), []).append(max(number(place + i * size, size) for i in range(min(count, 4))))
    return tags
