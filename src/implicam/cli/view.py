"""`implicam view`: a calibration in three dimensions, in the browser."""

from __future__ import annotations

import math
import time
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from implicam.calibrators import Calibration, load_calibration
from implicam.cli import show
from implicam.cli.app import Browser, Json, Pattern, Port, Token, command, read_to_measure
from implicam.cli.options import with_table_options
from implicam.dataset import Dataset, TableOptions
from implicam.dataset.table_options import DOCUMENTED
from implicam.errors import DatasetError, UsageError

if TYPE_CHECKING:
    from implicam.viewer.calibration_page import CalibrationPage

LOOK_SECONDS = 0.25
"""Between two looks at a file that grows."""
SETTLED_SECONDS = 1.0
"""A file that has not grown for so long is complete: until then its last point may still get views."""


@command("view")
@with_table_options
def view_command(
    calibration: Annotated[Path, typer.Argument(help="A calibration file.")],
    dataset: Annotated[
        Path | None, typer.Argument(help="What the cameras saw: its points are measured and shown.")
    ] = None,
    follow: Annotated[bool, typer.Option("--follow", help="Go on reading DATASET as it grows.")] = False,
    pictures: Annotated[
        Path | None, typer.Option("--pictures", metavar="FOLDER", help="Of the cameras (default DATASET/images).")
    ] = None,
    pattern: Pattern = None,
    port: Port = 8092,
    token: Token = None,
    browser: Browser = True,
    table: TableOptions = DOCUMENTED,
    json: Json = False,
) -> None:
    """Look at a calibration in three dimensions: cameras, pictures, uncertainty, and what is measured with it.

    The page is for this machine only. It ends with its button or Ctrl-C.
    """
    from implicam.viewer.calibration_page import Pictures, find_camera_pictures, open_page

    if follow and dataset is None:
        raise UsageError("--follow needs a dataset that grows.", fix="name it after the calibration")
    fitted = load_calibration(calibration)
    folder = pictures if pictures is not None else dataset / "images" if dataset is not None else None
    found: Pictures = {}
    url, page = "", None
    if folder is not None and (pictures is not None or folder.is_dir()):
        found = find_camera_pictures(folder, pattern, fitted.data.camera_names)
    first = None if dataset is None or follow else read_to_measure(dataset, table, fitted)
    try:
        with open_page(fitted, found, port=port, token=token) as (url, page):
            show.say(f"Look at it at {url}")
            show.say("Ctrl-C ends it.")
            if browser:
                webbrowser.open(url)
            if first is not None:
                page.add(fitted.measure(first.observations))
            if follow and dataset is not None:
                _follow(page, fitted, dataset, table)
            else:
                page.closed.wait()
    except KeyboardInterrupt:
        pass
    shown, missing = (0, 0) if page is None else page.counts
    if json:
        cameras = list(fitted.data.camera_names)
        show.emit_json({"url": url, "cameras": cameras, "points": shown, "not_measured": missing})
    else:
        show.line(f"ended; {shown} measured points were shown" + (f", {missing} were not measured" if missing else ""))


def _follow(page: CalibrationPage, fitted: Calibration, dataset: Path, table: TableOptions) -> None:
    """Measure what is written to a file, until the page is closed."""
    follower, told = _Follower(dataset, table, fitted), ""
    while not page.closed.wait(LOOK_SECONDS):
        new = follower.look()
        if new is not None:
            page.add(fitted.measure(new.observations))
        if follower.trouble != told:
            told = follower.trouble
            page.tell(told)
            if told:
                show.note(told)


class _Follower:
    """Points that are new in a dataset since the last look, or whose views are others.

    Attributes:
        trouble: What is wrong with the file now, in a sentence; empty where nothing is.
    """

    def __init__(self, path: Path, table: TableOptions, fitted: Calibration) -> None:
        self._path, self._table, self._fitted = path, table, fitted
        self._seen: dict[str, bytes] = {}  # name -> its pixels
        self._stamp: tuple[tuple[str, int, int], ...] = ()
        self._changed = -math.inf
        self._read: object = None
        self.trouble = ""

    def look(self) -> Dataset | None:
        """Those that have all their views: the last one only where nothing has been written for a while."""
        stamp = self._now()
        if stamp != self._stamp:
            self._stamp, self._changed = stamp, time.monotonic()
        settled = time.monotonic() - self._changed > SETTLED_SECONDS
        if self._read == (stamp, settled):
            return None
        try:
            data = read_to_measure(self._path, self._table, self._fitted)
        except DatasetError as error:  # perhaps half a line is written, or none yet
            if settled:
                waits = not self._seen and not any(size for _, size, _ in stamp)
                what = f"waiting for {self._path}" if waits else f"{error.what} {error.why}".strip()
                self.trouble = what if waits else f"{what} Nothing new is shown until that is mended."
                self._read = (stamp, settled)
            return None
        self._read, self.trouble = (stamp, settled), ""
        pixels = data.observations.uv
        names = [str(name) for name in data.observations.points]
        new = [row for row, name in enumerate(names) if self._seen.get(name) != pixels[row].tobytes()]
        if not settled and new and new[-1] == len(names) - 1:
            new = new[:-1]
        again = sum(names[row] in self._seen for row in new)
        if again:
            show.note(f"{again} point{'s' * (again > 1)} measured again: other views than before are in {self._path}")
        self._seen.update((names[row], pixels[row].tobytes()) for row in new)
        return data.select(np.array(new)) if new else None

    def _now(self) -> tuple[tuple[str, int, int], ...]:
        files = sorted(self._path.iterdir()) if self._path.is_dir() else [self._path]
        found = []
        for file in files:
            try:
                about = file.stat()
            except OSError:  # it is being replaced
                continue
            found.append((file.name, about.st_size, about.st_mtime_ns))
        return tuple(found)
