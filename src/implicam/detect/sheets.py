"""All photographs of a camera on sheets, and each with what was found: files that are drawn where they are missing.

detections/<camera>.jpg, -2.jpg, ...         thumbnails
detections/overlays/<camera>/<shot>.jpg      a picture with what was found
detections/drawn.json                        what is drawn in which state
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from implicam.detect.overlay import INK_COLOUR, STATES, Result, draw_overlay, draw_thumbnail
from implicam.drawing import Canvas, Pixels, blank, cut_text, text_width
from implicam.errors import ImageError
from implicam.files import write_text
from implicam.images import eight_bit, read_picture, write_picture
from implicam.progress import Progress
from implicam.threads import side_by_side

PAGE_COLUMNS, PAGE_ROWS = 6, 6
"""Thumbnails of a page."""

PAPER_COLOUR = (250, 250, 250)

RECORD_FILE = "drawn.json"


def draw_sheet(title: str, tiles: Sequence[Pixels]) -> Pixels:
    """Put thumbnails side by side under a title and the meaning of the colours.

    Args:
        title: Cut where it is too long.
        tiles: One or more, (rows, columns, 3) red, green, blue from 0 to 255, all of one size.

    Returns:
        The page, (rows, columns, 3).
    """
    gap, head = 12, 56
    height, width = tiles[0].shape[:2]
    columns = min(PAGE_COLUMNS, len(tiles))
    rows = -(-len(tiles) // columns)
    page = blank(max(columns, 3) * (width + gap) + gap, head + rows * (height + gap), PAPER_COLOUR)
    x = float(page.width - gap)
    for state, colour in reversed(STATES.items()):
        x -= text_width(state, 15) + 12
        page.write(state, (x, 35), 15, INK_COLOUR)
        page.fill(x - 24, 22, x - 8, 38, colour)
        x -= 34
    page.write(cut_text(title, x - 2 * gap, 18.5), (gap, 36), 18.5, INK_COLOUR)
    for i, tile in enumerate(tiles):
        page.paste(Canvas(tile), gap + i % columns * (width + gap), head + i // columns * (height + gap))
    return page.pixels


def draw_sheets(
    folder: Path, results: Sequence[Result], progress: Progress, *, redraw: bool = False
) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Draw overlays and sheets: folder/overlays/<camera>/<shot>.jpg and folder/<camera>.jpg, -2.jpg, ...

    Files that already show the same are kept. Files of pictures that no longer exist are removed.

    Args:
        folder: Where to.
        results: The result of each picture.
        progress: Told how many pictures are drawn.
        redraw: Whether to draw all again.

    Returns:
        The files of the sheets, and notes on what could not be drawn.

    Raises:
        ImplicamError: The record of what is drawn cannot be written.
    """
    before = {} if redraw else _read_drawn(folder / RECORD_FILE)
    now: dict[str, str] = {}
    notes: list[str] = []
    pages = _lay_out_pages(results)
    done = iter(range(1, len(results) + 1))
    for page in pages:
        now |= page.draw(folder, before, lambda: progress("drawing overlays", next(done), len(results)), notes)
        write_text(folder / RECORD_FILE, json.dumps({**before, **now}))
    for name in before.keys() - now.keys():
        path = folder / name
        if path.suffix == ".jpg" and path.resolve().is_relative_to(folder.resolve()):
            path.unlink(missing_ok=True)
    write_text(folder / RECORD_FILE, json.dumps(now))
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

        def one(result: Result) -> Pixels:
            name, tile = _overlay_name(result), draw_thumbnail(None, result)
            try:
                new = wanted(name, digests[name])
                grey = _read_or_none(result.path) if new or whole else None
                if new:
                    write_picture(folder / name, draw_overlay(grey, result)[..., ::-1])
                tile = draw_thumbnail(grey, result) if whole else tile
            except Exception as error:  # a failed drawing must not lose what was found
                digests.pop(name)
                notes.append(f"{folder / name} is not drawn: {error}")
            step()
            return tile

        whole = wanted(self.name, content)
        tiles = side_by_side(one, self.results)
        if whole:
            write_picture(folder / self.name, draw_sheet(self.title, tiles)[..., ::-1])
        return {**digests, self.name: content}


def _lay_out_pages(results: Sequence[Result]) -> list[_Page]:
    pages = []
    per_page = PAGE_COLUMNS * PAGE_ROWS
    cameras = list(dict.fromkeys(result.view.camera for result in results))
    for camera in cameras:
        own = [result for result in results if result.view.camera == camera]
        states = Counter(result.state for result in own)
        counts = ", ".join(f"{states[state]} {state}" for state in STATES if states[state])
        for number, first in enumerate(range(0, len(own), per_page), 1):
            name = camera if number == 1 else f"{camera}-{number}"
            while number > 1 and name in cameras:
                name += "_"
            of = f", page {number} of {-(-len(own) // per_page)}" if len(own) > per_page else ""
            title = f"{camera}: {len(own)} picture{'s' if len(own) > 1 else ''}, {counts}{of}"
            pages.append(_Page(f"{name}.jpg", title, own[first : first + per_page]))
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


def _read_drawn(record: Path) -> dict[str, str]:
    """{file: digest} of what earlier runs drew."""
    try:
        table = json.loads(record.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return {str(name): str(digest) for name, digest in table.items()} if isinstance(table, dict) else {}


def _read_or_none(path: Path) -> Pixels | None:
    try:
        return eight_bit(read_picture(path))
    except ImageError:
        return None
