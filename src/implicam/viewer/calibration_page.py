"""The page of `implicam view`: a calibration in three dimensions, and what is measured with it, as it is measured.

A Starlette application behind the door (`web.py`); the page is three files in `templates/`, drawn by three.js.
"""

from __future__ import annotations

import asyncio
import json
import threading
import webbrowser
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from implicam.calibrators import Calibration, RigCalibration
from implicam.detect.folder import pictures_of
from implicam.errors import ImageError, ImplicamError, UsageError
from implicam.formatting import list_some
from implicam.images import read_picture
from implicam.measurement import Measurement, notes_outside
from implicam.report.instrument import Instrument
from implicam.viewer.calibration_scene import measured_points, scene, uncertainty_map
from implicam.viewer.web import SCENE_FILES, answer, behind_door, jpeg

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.responses import Response

FILES = {
    "/": "view.html",
    "/page.css": "page.css",
    "/view.css": "view.css",
    "/view.js": "view.js",
    **SCENE_FILES,
}

MAX_POINTS = 200_000
"""Measured points that a page keeps; of more, the first ones stay, and it says so."""
CHUNK_POINTS = 2_000
"""Points that are sent at once."""
LOOK_SECONDS = 0.1
"""Between two looks for new points."""
PICTURE_PX = 1600
"""Width of a picture that is sent, at most."""

Pictures = Mapping[str, Mapping[str, Path]]
"""{camera: {shot: file}}."""


class CalibrationPage:
    """The application, and the measured points that it shows. `closed` is set when it is to end."""

    def __init__(self, calibration: Calibration, pictures: Pictures | None = None) -> None:
        """pictures: Of the cameras, by camera and shot."""
        self._calibration = calibration
        self._pictures = {} if pictures is None else pictures
        self._chunks: list[dict[str, Any]] = []
        self._count = 0
        self._told: list[str] = []
        self._mapping = threading.Lock()
        self._map: dict[str, Any] | None = None
        self.closed = threading.Event()

    def add(self, measurement: Measurement) -> None:
        """Show points; pages that are open draw them at once.

        Args:
            measurement: Of any points, in any length unit that is known.
        """
        for start in range(0, len(measurement), CHUNK_POINTS):
            left = MAX_POINTS - self._count
            rows = np.arange(start, min(start + CHUNK_POINTS, len(measurement)))
            chunk = measured_points(measurement.select(rows[: max(left, 0)]), self._calibration.data.length_unit)
            chunk["not_shown"] = max(len(rows) - max(left, 0), 0)
            self._count += len(chunk["names"])
            self._chunks.append(chunk)
        notes = notes_outside(measurement, self._calibration.data)
        if notes and notes != self._told:
            self._told = notes
            self.tell(notes[0])

    def tell(self, note: str) -> None:
        """Show a sentence on the pages; an empty one takes the last one away."""
        self._chunks.append({"note": note})

    @property
    def counts(self) -> tuple[int, int]:
        """How many points are shown, and how many could not be measured."""
        chunks = [chunk for chunk in self._chunks if "names" in chunk]
        measured = {name for chunk in chunks for name in chunk["names"]}
        missing = {name for chunk in chunks for name, _ in chunk["missing"]}
        return len(measured), len(missing - measured)

    def scene(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """What stands still, and of which cameras and shots there are pictures."""
        shots = list(dict.fromkeys(shot for row in self._pictures.values() for shot in row))
        pictures = {camera: list(row) for camera, row in self._pictures.items()}
        return {**scene(self._calibration), "shots": shots, "pictures": pictures}

    def map(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """The uncertainty over the box of the known points; it takes a moment, the first time."""
        if not isinstance(self._calibration, RigCalibration):
            raise UsageError(f"{self._calibration.method} has no map of uncertainty.")
        with self._mapping:
            if self._map is None:
                self._map = uncertainty_map(Instrument(self._calibration))
            return self._map

    def picture(self, given: Mapping[str, Any]) -> Response:
        """A camera's picture of a shot."""
        from starlette.responses import Response

        file = self._pictures.get(str(given.get("camera")), {}).get(str(given.get("shot")))
        if file is None:
            raise ImplicamError("there is no such picture.", fix="reload the page")
        picture = read_picture(file)
        ours = next(one for one in self._calibration.data.cameras if one.name == given.get("camera"))
        if None not in (ours.width, ours.height) and picture.shape[::-1] != (ours.width, ours.height):
            raise ImageError(
                f"{file} has {picture.shape[1]} x {picture.shape[0]} pixels.",
                why=f"{ours.name} was calibrated with {ours.width} x {ours.height}: it is of another camera, or scaled",
                fix="give the pictures that its camera took",
            )
        return Response(jpeg(picture, width=PICTURE_PX), media_type="image/jpeg")

    def stop(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """The end: the server stops when this is answered."""
        threading.Timer(0.3, self.closed.set).start()
        return {}

    async def _stream(self, begin: int) -> AsyncIterator[str]:
        """The chunks from one on, each as an event of server-sent events, numbered."""
        sent = begin
        yield "retry: 1000\n\n"
        while not self.closed.is_set():
            while sent < len(self._chunks):  # asked each time: one may be added while another is on its way
                yield f"id: {sent + 1}\ndata: {json.dumps(self._chunks[sent])}\n\n"
                sent += 1
            await asyncio.sleep(LOOK_SECONDS)

    def application(self, origin: str) -> Starlette:
        """The web application, for those who come by the door that says it is `origin`."""
        from starlette.applications import Starlette
        from starlette.responses import Response, StreamingResponse
        from starlette.routing import Route

        async def stream(request: Any) -> Response:
            if request.headers.get("origin") != origin:
                return Response("Come by the front door.", 403)
            last = request.headers.get("last-event-id", "0")
            begin = int(last) if last.isdecimal() and len(last) < 10 else 0
            return StreamingResponse(self._stream(begin), media_type="text/event-stream")

        return Starlette(
            routes=[
                Route("/api/scene", answer(origin, self.scene)),
                Route("/api/map", answer(origin, self.map)),
                Route("/api/points", stream),
                Route("/api/stop", answer(origin, self.stop), methods=["POST"]),
                Route("/picture.jpg", answer(origin, self.picture)),
            ]
        )


@contextmanager
def open_page(
    calibration: Calibration, pictures: Pictures | None = None, *, port: int, token: str | None = None
) -> Iterator[tuple[str, CalibrationPage]]:
    """Serve the page on this machine while the block runs.

    Args:
        calibration: What is shown.
        pictures: Of its cameras, {camera: {shot: file}}.
        port: Where people find it; 0 for any free one.
        token: What opens it; None for a new one.

    Yields:
        The address with the token, and the page.

    Raises:
        MissingExtraError: The web server is not installed.
        ImplicamError: The port is taken.
    """
    page = CalibrationPage(calibration, pictures)
    stake = "it shows your rig and can end the program"
    with behind_door(
        page.application, FILES, port=port, token=token, command="implicam view", extra="view", stake=stake
    ) as url:
        try:
            yield url, page
        finally:
            page.closed.set()


def find_camera_pictures(folder: Path, pattern: str | None, cameras: Sequence[str]) -> Pictures:
    """The pictures in a folder, by camera and shot.

    Args:
        folder: Where they are.
        pattern: How their names tell camera and shot; None for what they seem to.
        cameras: Names of cameras that are known.

    Raises:
        ImageError: There are none, or none of these cameras.
    """
    found, _ = pictures_of(folder.parent, folder.name, pattern, cameras)
    if not set(found) & set(cameras):
        raise ImageError(
            f"{folder}: no picture is of a camera of this calibration.",
            why=f"they are of {list_some(list(found))}, the calibration is of {list_some(list(cameras))}",
            fix="name the folders or files after the cameras, or say how they are named with --pattern",
        )
    return {camera: shots for camera, shots in found.items() if camera in cameras}


class LiveView:
    """A calibration on a page of the browser, to which points are added as they are measured.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> calibration = ic.ForwardGP().fit(rig)
    >>> with ic.LiveView(calibration, browser=False) as view:
    ...     view.add(calibration.measure(rig))
    ...     view.url.startswith("http://localhost:")
    True

    Attributes:
        url: The address, with the token that opens it; on this machine only.
    """

    url: str

    def __init__(
        self, calibration: Calibration, *, pictures: str | Path | None = None, port: int = 0, browser: bool = True
    ) -> None:
        """Args:
        calibration: What is shown.
        pictures: A folder with pictures of its cameras; None for none.
        port: Of the address; 0 for any free one.
        browser: Whether to open it in a browser here.

        Raises:
            MissingExtraError: The web server is not installed.
            ImageError: There are no pictures of these cameras in the folder.
            ImplicamError: The port is taken.
        """
        found = None
        if pictures is not None:
            found = find_camera_pictures(Path(pictures), None, calibration.data.camera_names)
        self._stack = ExitStack()
        self.url, self._page = self._stack.enter_context(open_page(calibration, found, port=port))
        if browser:
            webbrowser.open(self.url)

    def add(self, measurement: Measurement) -> None:
        """Show points; pages that are open draw them at once.

        Args:
            measurement: As a calibration gives it.

        Raises:
            UsageError: The view is closed.
        """
        if self._page.closed.is_set():
            raise UsageError("the view is closed.", fix="open a new one: ic.LiveView(calibration)")
        self._page.add(measurement)

    def wait(self) -> None:
        """Until a person ends the view on its page; Ctrl-C ends it too."""
        with suppress(KeyboardInterrupt):
            self._page.closed.wait()
        self.close()

    def close(self) -> None:
        """End it; may be called twice."""
        self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"LiveView({self.url!r})"
