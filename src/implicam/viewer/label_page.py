"""The page of `implicam label`: pictures, the drawing of the target, and the labels, which are saved at every click.

A Starlette application behind the door (`web.py`). All that is kept is a `Labelling`; the page itself is three files in
`templates/`.
"""

from __future__ import annotations

import threading
import webbrowser
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from implicam.detect.labelling import MIN_LABELS_TO_GUESS, Guess, Labelling
from implicam.detect.labels import MIN_LABELS
from implicam.detect.model import View
from implicam.errors import UsageError
from implicam.formatting import short_names
from implicam.viewer.web import Endpoint, answer, behind_door, jpeg

if TYPE_CHECKING:
    from starlette.applications import Starlette

FILES = {"/": "label.html", "/page.css": "page.css", "/label.css": "label.css", "/label.js": "label.js"}


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
            self._jpegs[view, bright] = jpeg(self._labelling.picture(view), bright=bright)
        return self._jpegs[view, bright]

    def application(self, origin: str) -> Starlette:
        """The web application, for those who come by the door that says it is `origin`."""
        from starlette.applications import Starlette
        from starlette.responses import Response
        from starlette.routing import Route

        def call(work: Callable[[View, Mapping[str, Any]], dict[str, Any]]) -> Endpoint:
            return answer(origin, lambda given: work(_view(given), given))

        def photograph(given: Mapping[str, Any]) -> Response:
            return Response(self.jpeg(_view(given), given.get("bright") != "0"), media_type="image/jpeg")

        reads = (self.labels, self.picture, self.guess)
        writes = (self.place, self.remove, self.skip, self.undo, self.finish)
        return Starlette(
            routes=[
                *(Route(f"/api/{work.__name__}", call(work), methods=["GET"]) for work in reads),
                *(Route(f"/api/{work.__name__}", call(work), methods=["POST"]) for work in writes),
                Route("/picture.jpg", answer(origin, photograph)),
            ]
        )


def _view(given: Mapping[str, Any]) -> View:
    return View(str(given.get("camera", "")), str(given.get("shot", "")))


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
    page = LabelPage(labelling, then)
    with behind_door(
        page.application,
        FILES,
        port=port,
        token=token,
        command="implicam label",
        extra="label",
        stake="it can change your labels",
    ) as url:
        yield url, page


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
