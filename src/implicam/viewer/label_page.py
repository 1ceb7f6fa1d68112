"""The page of `implicam label`: pictures, the drawing of the target, and the labels, which are saved at every click.

A Starlette application on a port of this machine that nobody is told, behind the door of `front.py`, which asks for a
token. All that is kept is a `Labelling`; the page itself is three files in `templates/`.
"""

from __future__ import annotations

import json
import secrets
import socket
import threading
import webbrowser
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np

from implicam.detect.labelling import MIN_LABELS_TO_GUESS, Guess, Labelling
from implicam.detect.labels import MIN_LABELS
from implicam.detect.model import View
from implicam.errors import ImplicamError, UsageError, import_extra
from implicam.formatting import short_names
from implicam.images import brighten, eight_bit, opencv
from implicam.viewer.front import Front

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response

FILES = {"/": "label.html", "/label.css": "label.css", "/label.js": "label.js"}

JPEG_QUALITY = 92


class LabelPage:
    """The application, and what it does for the page. `closed` is set when the person has finished."""

    def __init__(self, labelling: Labelling, then: str) -> None:
        """then: the command that comes next, for the page."""
        self._labelling, self._then = labelling, then
        self.closed = threading.Event()
        self._guessing = threading.Lock()
        self._jpegs: dict[tuple[View, bool], bytes] = {}

    def labels(self, view: View, given: Mapping[str, Any]) -> dict[str, Any]:
        """The dataset, its pictures, and how many labels each has."""
        own = self._labelling
        own.refresh()
        pictures = [{"camera": v.camera, "shot": v.shot, "labels": len(own.marks(v))} for v in own.pictures]
        return {
            "name": own.name, "unit": own.unit, "file": str(own.path), "then": self._then, "pictures": pictures,
            "needed": MIN_LABELS, "guesses_from": MIN_LABELS_TO_GUESS,
        }  # fmt: skip

    def picture(self, view: View, given: Mapping[str, Any], said: str = "") -> dict[str, Any]:
        """A picture's dots and labels, and which dot comes next."""
        own = self._labelling
        own.picture(view)
        own.refresh()
        names = [own.points[row] for row in own.rows(view)]
        xyz = own.known.xyz[own.rows(view)].tolist()
        return {
            "camera": view.camera, "shot": view.shot,
            "points": [{"name": name, "xyz": at} for name, at in zip(names, xyz, strict=True)],
            "short": dict(zip(names, short_names(names), strict=True)),
            "axes": own.axes(view), "turn": own.turn(view), "marks": own.marks(view), "proposed": own.propose(view),
            "undo": own.can_undo, "said": said, "kept": given.get("point"),
        }  # fmt: skip

    def guess(self, view: View, given: Mapping[str, Any]) -> dict[str, Any]:
        """Where the other dots are."""
        with self._guessing:
            guess: Guess = self._labelling.guess(view)
        return {**guess._asdict(), "proposed": self._labelling.propose(view, guess)}

    def place(self, view: View, given: Mapping[str, Any]) -> dict[str, Any]:
        """A click."""
        uv = np.array([_number(given, "u"), _number(given, "v")])
        point = _text(given, "point")
        on_dot = self._labelling.place(view, point, uv, max(_number(given, "within"), 1.0))
        said = "" if on_dot else f"No dot was found there: {point} is labelled where you clicked. Undo it, or go on."
        return self.picture(view, {}, said)

    def remove(self, view: View, given: Mapping[str, Any]) -> dict[str, Any]:
        """A label taken away."""
        self._labelling.remove(view, _text(given, "point"))
        return self.picture(view, given)

    def skip(self, view: View, given: Mapping[str, Any]) -> dict[str, Any]:
        """A dot that cannot be seen."""
        self._labelling.skip(view, _text(given, "point"))
        return self.picture(view, {})

    def undo(self, view: View, given: Mapping[str, Any]) -> dict[str, Any]:
        """The last change taken back; the picture where it was."""
        where = self._labelling.undo()
        return self.picture(where or view, {}, "" if where else "There is nothing to undo.")

    def finish(self, view: View, given: Mapping[str, Any]) -> dict[str, Any]:
        """The end: the server stops when this is answered."""
        threading.Timer(0.3, self.closed.set).start()
        return {}

    def jpeg(self, view: View, bright: bool) -> bytes:
        """A picture to be shown; it is kept, since it does not change."""
        if (view, bright) not in self._jpegs:
            grey = eight_bit(self._labelling.picture(view))
            grey = brighten(grey) if bright else grey
            cv2 = opencv()
            done, encoded = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
            if not done:
                raise ImplicamError("the picture cannot be shown.", fix="export it again as PNG")
            self._jpegs[view, bright] = encoded.tobytes()
        return self._jpegs[view, bright]

    def application(self, origin: str) -> Starlette:
        """The web application, for those who come by the door that says it is `origin`."""
        from starlette.applications import Starlette
        from starlette.concurrency import run_in_threadpool
        from starlette.responses import JSONResponse, Response
        from starlette.routing import Route

        def answer(
            work: Callable[[View, Mapping[str, Any]], dict[str, Any]],
        ) -> Callable[[Request], Awaitable[Response]]:
            async def endpoint(request: Request) -> Response:
                if request.headers.get("origin") != origin:
                    return Response("Come by the front door.", 403)
                try:
                    given = dict(request.query_params)
                    if request.method == "POST":
                        given = _table(await request.body())
                    view = View(str(given.get("camera", "")), str(given.get("shot", "")))
                    return JSONResponse(await run_in_threadpool(work, view, given))
                except ImplicamError as error:
                    return JSONResponse({"error": error.what, "why": error.why, "fix": error.fix}, 400)

            return endpoint

        async def photograph(request: Request) -> Response:
            if request.headers.get("origin") != origin:
                return Response("Come by the front door.", 403)
            view = View(request.query_params.get("camera", ""), request.query_params.get("shot", ""))
            try:
                bright = request.query_params.get("bright") != "0"
                return Response(await run_in_threadpool(self.jpeg, view, bright), media_type="image/jpeg")
            except ImplicamError as error:
                return Response(str(error), 400)

        reads = (self.labels, self.picture, self.guess)
        writes = (self.place, self.remove, self.skip, self.undo, self.finish)
        return Starlette(
            routes=[
                *(Route(f"/api/{work.__name__}", answer(work), methods=["GET"]) for work in reads),
                *(Route(f"/api/{work.__name__}", answer(work), methods=["POST"]) for work in writes),
                Route("/picture.jpg", photograph),
            ]
        )


def _table(body: bytes) -> dict[str, Any]:
    try:
        table = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise UsageError("the page sent something that is no JSON.", why=str(error), fix="reload it") from error
    if not isinstance(table, dict):
        raise UsageError("the page sent something else than a table.", fix="reload it")
    return table


def _number(given: Mapping[str, Any], name: str) -> float:
    value = given.get(name)
    if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) < 1e9:
        raise UsageError(f"{name} is {value!r}, and a number is needed.", fix="reload the page")
    return float(value)


def _text(given: Mapping[str, Any], name: str) -> str:
    value = given.get(name)
    if not isinstance(value, str):
        raise UsageError(f"{name} is {value!r}, and a name is needed.", fix="reload the page")
    return value


@contextmanager
def open_page(
    labelling: Labelling, then: str, *, port: int, token: str | None = None
) -> Iterator[tuple[str, LabelPage]]:
    """Serve the page on this machine while the block runs.

    Args:
        labelling: What is labelled.
        then: The command that comes next, for the page.
        port: Where people find it; 0 for any free one.
        token: What opens it; None for a new one.

    Yields:
        The address with the token, and the page.

    Raises:
        MissingExtraError: The web server is not installed.
        ImplicamError: The port is taken.
    """
    uvicorn = import_extra("uvicorn", "label", "the page of implicam label")
    import_extra("starlette", "label", "the page of implicam label")
    page, origin = LabelPage(labelling, then), f"http://{secrets.token_hex(16)}.invalid"
    inner = socket.create_server(("127.0.0.1", 0))
    options = {"log_config": None, "access_log": False, "lifespan": "off", "timeout_graceful_shutdown": 2}
    server = uvicorn.Server(uvicorn.Config(page.application(origin), **options))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [inner]}, name="implicam-label", daemon=True)
    with resources.as_file(resources.files("implicam.viewer") / "templates") as folder:
        front = Front(
            host="127.0.0.1",
            port=port,
            behind=inner.getsockname(),
            token=secrets.token_urlsafe(16) if token is None else token,
            files={path: folder / name for path, name in FILES.items()},
            origin=origin,
            command="implicam label",
            stake="it can change your labels",
        )
        with inner, front:
            thread.start()
            try:
                yield front.url, page
            finally:
                server.should_exit = True
                thread.join(timeout=5)


def serve(
    labelling: Labelling,
    then: str,
    *,
    port: int,
    token: str | None,
    open_browser: bool,
    say: Callable[[str], None],
) -> None:
    """Serve the page until the person finishes; Ctrl-C ends it too.

    Args:
        labelling: What is labelled.
        then: The command that comes next, for the page.
        port: Where people find it; 0 for any free one.
        token: What opens it; None for a new one.
        open_browser: Whether to open it in a browser here.
        say: Told the address.
    """
    with open_page(labelling, then, port=port, token=token) as (url, page):
        say(f"Label the dots at {url}")
        say("Every label is saved at once. Ctrl-C ends it; the same command goes on from there.")
        if open_browser:
            webbrowser.open(url)
        page.closed.wait()
