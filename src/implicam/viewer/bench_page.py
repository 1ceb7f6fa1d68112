"""The page of a guided session: what the cameras see, where the ball goes next, and when to stop.

A Starlette application behind the door (`web.py`); the page is three files in `templates/`, drawn for each browser as
its window is. Nothing is kept here: the controller has the session, and one worker does what the buttons ask.
"""

from __future__ import annotations

import asyncio
import functools
import json
import secrets
import threading
import time
import webbrowser
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from implicam.active import PredictedCovariance
from implicam.dataset import Floats
from implicam.errors import ImplicamError, UsageError
from implicam.formatting import json_safe
from implicam.hardware import GuardedRobot
from implicam.hardware.protocol import format_position
from implicam.images import Grey, read_picture
from implicam.session.board_session import BoardController
from implicam.session.controller import CALIBRATION_FILE, REPORT_FILE, SessionController, State
from implicam.session.typed import PositionQuestion, TypedPosition, parse_position
from implicam.session.wand_session import WandController
from implicam.viewer import words
from implicam.viewer.calibration_scene import COLUMNS, ROWS, list_cameras, up_of
from implicam.viewer.snapshot import curve, finite_or_none, snapshot
from implicam.viewer.space import Placing, edges, levels
from implicam.viewer.volume import volume
from implicam.viewer.web import SCENE_FILES, answer, behind_door, jpeg
from implicam.viewer.worker import Worker

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response

FILES = {
    "/": "acquire.html",
    "/page.css": "page.css",
    "/acquire.css": "acquire.css",
    "/acquire.js": "acquire.js",
    "/reach.css": "reach.css",
    "/reach.js": "reach.js",
    **SCENE_FILES,
}

REASONS = ("the place cannot be reached", "something is in the way", "the cameras cannot see it", "another reason")

QUIET_SECONDS = 0.1
"""Between two rounds of live pictures, at least."""
LOOK_SECONDS = 0.03
"""Between two looks for something new to send."""
YES_SECONDS = 60.0
"""For so long a yes to a move counts."""
UNWATCHED_SECONDS = 10.0
"""After so long without any browser a real robot no longer goes on by itself."""
WIDTHS_PX = (480, 960, 1920)
"""Of pictures that are sent."""


class BenchPage:
    """The application. `closed` is set when the person closes the session."""

    def __init__(self, controller: SessionController) -> None:
        self._controller, self.closed = controller, threading.Event()
        robot = controller.equipment.robot
        assert isinstance(robot, GuardedRobot)  # as Equipment makes every robot
        self._robot = robot
        self._unit, self._moves = controller.session.length_unit, robot.moves
        self._asks = robot.alone and not controller.equipment.dry_run and not getattr(robot, "simulated", False)
        if self._asks:
            robot.ask_before_moving(self._may_move)
        self._names = [source.name for source in controller.equipment.cameras]
        self._worker = Worker(controller, self._complain)
        self._running = True
        self._lock = threading.Lock()
        self._sent: dict[str, Any] = {"number": 0}
        self._pictures: dict[str, tuple[int, Grey]] = {}  # camera -> the number of its picture, and the picture
        self._jpegs: dict[tuple[str, int], tuple[int, bytes]] = {}  # camera and width -> number and JPEG
        self._complaints: list[dict[str, Any]] = []
        self._drawn: tuple[Any, ...] = ()  # what the scene was made of
        self._scene, self._curve = 0, 0  # numbers of the versions that a page compares
        self._curved: Any = None
        self._volume: tuple[PredictedCovariance | None, dict[str, Any] | None] = (None, None)
        self._watching, self._last_watched = 0, time.monotonic()
        self._yes: dict[str, tuple[Any, float]] = {}  # number -> what a yes with it allows, and until when
        self._position: TypedPosition | None = None  # that was typed last
        self._questioned: dict[str, Any] | None = None  # what is asked about it
        self._allowed: Floats | None = None  # the one target to which a person has let the robot go
        self._threads = [
            threading.Thread(target=work, name=f"implicam-{work.__name__}", daemon=True)
            for work in (self._live, self._publish)
        ]

    def start(self) -> None:
        """Begin the session."""
        self._worker.start()
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Stop a robot that is on its way, and the page after what is being done now; the session stays open."""
        self.closed.set()
        self._controller.leave()
        self._running = False
        self._worker.close()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(timeout=30)

    # ------------------------------------------------------------------------------------------- what people do

    def do(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """What a button asks: `word`, and what belongs to it. The answer may be a question: `ask`, with a number."""
        word = given.get("word")
        if word == "close":
            self.closed.set()
            return {}
        if not isinstance(word, str) or word not in self._buttons_of(self._controller.state):
            raise UsageError(f"{word!r} is none of the buttons.", fix="reload the page")
        if not self._buttons_of(self._controller.state)[word]:
            raise UsageError("that cannot be done now.", why=words.headline(self._controller.state, self._moves).title)
        if word == "auto":
            return self._set_auto(given)
        action = self._action(word, given)
        if isinstance(action, dict):
            return action
        return {"begun": self._worker.ask(action)}

    def stop(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """STOP: at once, past the worker."""
        self._yes.clear()
        self._allowed = None
        self._controller.stop_robot()
        return {}

    def _buttons_of(self, state: State) -> dict[str, bool]:
        """Which buttons make sense now."""
        return words.allowed(state, self._moves)

    def _action(self, word: str, given: Mapping[str, Any]) -> Callable[[], Any] | dict[str, Any]:
        """What the worker is to do, or what has to be asked before."""
        controller = self._controller
        if word == "go" and controller.state.phase in ("trouble", "done"):
            self._yes.clear()
            self._allowed = None
            return controller.retry
        if not self._moves and (word == "go" or (word == "redo" and given.get("xyz", given.get("yes")) is not None)):
            return self._report_position(given)  # a typing mistake that is seen in the pictures is corrected by `redo`
        if word == "go" and self._asks:
            return self._ask_for_move(given)
        if word in ("delete", "again"):
            return functools.partial(controller.remove, str(given.get("point")), again=word == "again")
        if word == "skip":
            reason = given.get("reason")
            return functools.partial(
                controller.skip, reason if isinstance(reason, str) and reason else "skipped by hand"
            )
        actions: dict[str, Callable[[], Any]] = {
            "go": controller.go, "accept": controller.accept, "redo": controller.redo, "undo": controller.undo,
            "finish": controller.finish,
        }  # fmt: skip
        return actions[word]

    def _report_position(self, given: Mapping[str, Any]) -> Callable[[], Any] | dict[str, Any]:
        """Where a person says that the ball is."""
        answered = self._questioned
        self._questioned = None
        if answered is not None and given.get("yes") == answered["number"]:
            return functools.partial(self._controller.report_position, answered["position"], confirmed=True)
        texts = given.get("xyz")
        if not (isinstance(texts, list) and len(texts) == 3 and all(isinstance(text, str) for text in texts)):
            raise UsageError("a position needs x, y and z.", fix="fill in the three fields")
        self._position = parse_position(texts, self._unit)
        return functools.partial(self._controller.report_position, self._position)

    def _ask_for_move(self, given: Mapping[str, Any]) -> Callable[[], Any] | dict[str, Any]:
        """A real robot: each move is asked for, with what it will do."""
        target = self._controller.state.target
        if target is None:
            raise UsageError("there is no target now.", fix="wait for one")
        place = tuple(target.xyz.tolist())  # not its name, which the next one has after a skip
        if self._said_yes(given, place):
            self._allowed = target.xyz
            return self._controller.go
        here = self._controller.equipment.robot.position()
        far = float(np.linalg.norm(target.xyz - here))
        return self._question(
            place,
            "The robot moves",
            f"from {format_position(here)} to {format_position(target.xyz)} {self._unit}: {far:.4g} {self._unit}"
            f"{self._speed()}. Is the way free?",
            "Move",
        )

    def _set_auto(self, given: Mapping[str, Any]) -> dict[str, Any]:
        on = given.get("on") is True
        if on and self._asks and not self._said_yes(given, "auto"):
            return self._question(
                "auto",
                "The robot goes on by itself",
                f"from target to target without asking{self._speed()}, {self._robot.limits}. Somebody must stay beside "
                "it, with a hand on its red button. Is nobody within its reach?",
                "Go on by itself",
            )
        self._controller.set_auto(on)
        return {}

    def _question(self, what: object, title: str, text: str, label: str) -> dict[str, Any]:
        number = secrets.token_urlsafe(8)
        self._yes[number] = what, time.monotonic() + YES_SECONDS
        return {"ask": {"number": number, "title": title, "text": text, "yes": label}}

    def _said_yes(self, given: Mapping[str, Any], what: object) -> bool:
        """Whether the answer to just this question is there; it counts once."""
        asked, until = self._yes.pop(str(given.get("yes")), (None, 0.0))
        return asked == what and time.monotonic() < until

    def _speed(self) -> str:
        speed = self._robot.speed
        return "" if speed is None else f" at {speed:g} m/s"

    def _may_move(self, here: Floats, there: Floats) -> bool:
        """Whether a person has let the robot go there: asked by the guard, just before it moves."""
        allowed, self._allowed = self._allowed, None
        if self._controller.state.auto:
            return True  # a second yes turned that on; trouble, STOP and nobody watching turn it off
        return allowed is not None and bool(np.array_equal(allowed, there))

    def _complain(self, error: ImplicamError) -> None:
        if isinstance(error, PositionQuestion):
            text = ".\n\n".join(error.questions) + "."
            asked = {
                "number": secrets.token_urlsafe(8),
                "title": f"{error.what[:1].upper()}{error.what[1:]}",
                "text": text,
                "yes": "It is there",
                "no": "Correct the numbers",
            }
            self._questioned = {**asked, "position": self._position}
            with self._lock:
                self._sent = {**self._sent, "number": self._sent["number"] + 1, "question": asked}
            return
        with self._lock:
            self._complaints = [
                *self._complaints[-4:],
                {"number": secrets.token_hex(4), "error": error.what, "why": error.why, "fix": error.fix},
            ]
            self._sent = {**self._sent, "number": self._sent["number"] + 1, "complaints": self._complaints}

    # ---------------------------------------------------------------------------------------------- what is shown

    def _live(self) -> None:
        while self._running:
            begun = time.monotonic()
            if self._watching:
                self._last_watched = begun
                self._controller.live()
            elif self._asks and self._controller.state.auto and begun - self._last_watched > UNWATCHED_SECONDS:
                self._controller.set_auto(False)
            time.sleep(max(QUIET_SECONDS, 0.3 * (time.monotonic() - begun)))

    def _publish(self) -> None:
        version = -1
        while self._running:
            state = self._controller.wait(version, 0.25)
            if state.version != version:
                version = state.version
                self._send(state)

    def _send(self, state: State) -> None:
        """Make what the pages are to show, once for all of them."""
        controller = self._controller
        measured = controller.measured_live if state.phase == "aim" else np.full(3, np.nan)
        skipped = controller.session.skipped
        found = self._snapshot(state, measured, len(skipped))
        looks = {look.camera: look for look in state.looks}
        for row in found["cameras"]:
            look = looks.get(row["name"])
            if look is None or look.frame is None:
                if not self._controller.equipment.shows_live and state.phase == "aim" and row["kind"] != "bad":
                    row["reason"] = f"a picture comes with “{found['buttons']['go']['label']}”"
                continue
            number, picture = self._pictures.get(row["name"], (0, None))
            if look.frame.picture is not picture:
                number += 1
                self._pictures[row["name"]] = number, look.frame.picture
            row["picture"] = number
        drawn = (state.calibration, state.predicted, state.data, len(skipped))
        if len(drawn) != len(self._drawn) or any(
            a is not b and a != b for a, b in zip(drawn, self._drawn, strict=True)
        ):
            self._drawn = drawn
            self._scene += 1
        if state.history is not self._curved:
            self._curved = state.history
            self._curve += 1
        found |= {
            "scene": self._scene, "curve": self._curve, "measured": finite_or_none(measured),
            "complaints": self._complaints, "question": _without_position(self._questioned),
        }  # fmt: skip
        with self._lock:
            self._sent = {**found, "number": self._sent["number"] + 1}

    def _snapshot(self, state: State, measured: Floats, skipped: int) -> dict[str, Any]:
        """What the pages are to show of a state."""
        rule = self._controller.loop.rule
        return snapshot(state, self._names, measured, rule, unit=self._unit, moves=self._moves, skipped=skipped)

    def about(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """What does not change while the page is open."""
        controller = self._controller
        return {
            "name": controller.session.name,
            "folder": str(controller.session.folder),
            "unit": self._unit,
            "moves": self._moves,
            "auto": controller.equipment.robot.alone and not controller.equipment.dry_run,
            "asks": self._asks,
            "reasons": REASONS,
            "cameras": [
                {"name": camera.name, "width": camera.width, "height": camera.height}
                for camera in controller.session.cameras
            ],
        }

    def scene(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """The workspace in three dimensions."""
        controller, state = self._controller, self._controller.state
        space, predicted = controller.loop.workspace, state.predicted
        low, high = space.vertices.min(axis=0), space.vertices.max(axis=0)
        cameras = list_cameras(state.calibration)
        known = state.data
        return {
            "placing": Placing.of(low, high, up_of(cameras)).table,
            "box": [low.tolist(), high.tolist()],
            "edges": edges(space).tolist(),
            "levels": levels(space.places),
            "cameras": cameras,
            "grid": [ROWS, COLUMNS],
            "known": [] if known is None else known.xyz.tolist(),
            "skipped": [one.xyz.tolist() for one in controller.session.skipped],
            "judged": controller.loop.judged_at.tolist() if predicted is not None else [],
            "u95": [] if predicted is None else json_safe(predicted.u95.tolist()),
            "excess": [] if predicted is None else json_safe(predicted.excess.tolist()),
            "volume": self._volume_of(predicted),
        }

    def _volume_of(self, predicted: PredictedCovariance | None) -> dict[str, Any] | None:
        """The uncertainty on a grid, computed once for all pages."""
        if predicted is None:
            return None
        if self._volume[0] is not predicted:
            loop, fields = self._controller.loop, {"u95": predicted.u95, "excess": predicted.excess}
            self._volume = predicted, volume(loop.workspace, loop.judged_at, fields)
        return self._volume[1]

    def curve(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """The uncertainty against the number of points."""
        return curve(self._controller.state.history, self._controller.loop.rule)

    def points(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """The known points so far, and how far each is from where the calibration measures it."""
        controller, state = self._controller, self._controller.state
        data, calibration = controller.session.data, state.calibration
        if data is None:
            return {"points": []}
        off, sd = np.full(len(data), np.nan), np.full(len(data), np.nan)
        if calibration is not None and state.data is not None and len(state.data) == len(data):
            measured = calibration.measure(state.data.observations)
            off = np.linalg.norm(measured.xyz - data.xyz, axis=1)
            sd = np.sqrt(np.trace(measured.cov, axis1=1, axis2=2))
        return {
            "points": [
                {
                    "name": str(name),
                    "xyz": data.xyz[i].tolist(),
                    "cameras": int(data.observations.seen[i].sum()),
                    "off": float(off[i]) if np.isfinite(off[i]) else None,
                    "sd": float(sd[i]) if np.isfinite(sd[i]) else None,
                }
                for i, name in enumerate(data.points)
            ]
        }

    def kept(self, given: Mapping[str, Any]) -> Response:
        """The picture that was kept of a known point by a camera."""
        from starlette.responses import Response

        point = str(given.get("point"))
        kept = self._controller.session.pictures_of(point) if self._has(point) else {}
        file = kept.get(str(given.get("camera")))
        if file is None:
            raise ImplicamError("there is no such picture.", fix="reload the page")
        return Response(jpeg(read_picture(file), bright=False, width=WIDTHS_PX[1]), media_type="image/jpeg")

    def _has(self, point: str) -> bool:
        data = self._controller.session.data
        return data is not None and point in data.points.tolist()

    def picture(self, given: Mapping[str, Any]) -> Response:
        """The last picture of a camera, as wide as it is shown."""
        from starlette.responses import Response

        camera = str(given.get("camera"))
        number, picture = self._pictures.get(camera, (0, None))
        if picture is None:
            raise ImplicamError("there is no picture of it yet.")
        wanted = str(given.get("width", ""))
        width = next((w for w in WIDTHS_PX if wanted.isdecimal() and int(wanted) <= w), WIDTHS_PX[-1])
        kept, data = self._jpegs.get((camera, width), (0, b""))
        if kept != number:
            data = jpeg(picture, bright=False, width=width)
            self._jpegs[camera, width] = number, data
        return Response(data, media_type="image/jpeg", headers={"X-Picture": str(number)})

    async def _stream(self) -> AsyncIterator[str]:
        """Each state, as an event of server-sent events; the last one only, where several came at once."""
        sent = -1
        self._watching += 1
        try:
            yield "retry: 500\n\n"
            beat = time.monotonic()
            while not self.closed.is_set():
                now = self._sent
                if now["number"] != sent and "phase" in now:
                    sent, beat = now["number"], time.monotonic()
                    yield f"data: {json.dumps(now)}\n\n"
                elif time.monotonic() - beat > 2:
                    beat = time.monotonic()
                    yield "event: beat\ndata:1\n\n"  # so that a page notices when it comes no more
                await asyncio.sleep(LOOK_SECONDS)
            yield "event: closed\ndata: {}\n\n"
        finally:
            self._watching -= 1

    def application(self, origin: str) -> Starlette:
        """The web application, for those who come by the door that says it is `origin`."""
        from starlette.applications import Starlette
        from starlette.responses import Response, StreamingResponse
        from starlette.routing import Route

        async def stream(request: Request) -> Response:
            if request.headers.get("origin") != origin:
                return Response("Come by the front door.", 403)
            return StreamingResponse(self._stream(), media_type="text/event-stream")

        reads = (self.about, self.scene, self.curve, self.points)
        return Starlette(
            routes=[
                *(Route(f"/api/{work.__name__}", answer(origin, work)) for work in reads),
                Route("/api/do", answer(origin, self.do), methods=["POST"]),
                Route("/api/stop", answer(origin, self.stop), methods=["POST"]),
                Route("/api/state", stream),
                Route("/picture.jpg", answer(origin, self.picture)),
                Route("/kept.jpg", answer(origin, self.kept)),
            ]
        )


def _without_position(question: dict[str, Any] | None) -> dict[str, Any] | None:
    return None if question is None else {key: value for key, value in question.items() if key != "position"}


def _page_of(controller: SessionController) -> BenchPage:
    from implicam.viewer.board_page import BoardPage  # late: they are built on this page
    from implicam.viewer.wand_page import WandPage

    if isinstance(controller, WandController):
        return WandPage(controller)
    return BoardPage(controller) if isinstance(controller, BoardController) else BenchPage(controller)


@contextmanager
def open_page(
    controller: SessionController, *, host: str = "127.0.0.1", port: int = 0, token: str | None = None
) -> Iterator[tuple[str, BenchPage]]:
    """Serve the page while the block runs; the session begins.

    Args:
        controller: Of the session.
        host: What to listen on.
        port: Where people find it; 0 for any free one.
        token: What opens it; None for a new one.

    Yields:
        The address with the token, and the page.

    Raises:
        MissingExtraError: The web server is not installed.
        ImplicamError: It cannot listen there.
    """
    page, folder = _page_of(controller), controller.session.folder
    own = {"/report.html": folder / REPORT_FILE, "/calibration.implicam": folder / CALIBRATION_FILE}
    with behind_door(
        page.application, FILES, own, host=host, port=port, token=token,
        command="implicam acquire", extra="viewer", stake="it can move the robot",
    ) as url:  # fmt: skip
        try:
            page.start()
            yield url, page
        finally:
            page.close()


def serve(
    controller: SessionController,
    *,
    host: str = "127.0.0.1",
    port: int = 8090,
    token: str | None = None,
    open_browser: bool = True,
    say: Callable[[str], None] = print,
) -> None:
    """Show the page until the person closes the session, or Ctrl-C, which stops a robot first; the session is still
    open then.

    Args:
        controller: Of the session.
        host: What to listen on.
        port: Where people find it; 0 for any free one.
        token: What opens it; None for a new one.
        open_browser: Whether to open it in a browser here.
        say: Told the address.

    Raises:
        MissingExtraError: The web server is not installed.
        ImplicamError: It cannot listen there.
    """
    try:
        with open_page(controller, host=host, port=port, token=token) as (url, page), suppress(KeyboardInterrupt):
            say(f"The session is at {url}   (Ctrl-C ends it; nothing is lost)")
            if open_browser:
                webbrowser.open(url)
            while not page.closed.wait(0.5):
                pass
            time.sleep(2 * LOOK_SECONDS)  # the pages are told
    finally:
        controller.leave()  # before anything is waited for: the robot may be on its way
