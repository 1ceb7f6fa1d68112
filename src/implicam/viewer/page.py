"""The page of a guided session: pictures on the left, the workspace in the middle, numbers and buttons on the right."""

from __future__ import annotations

import functools
import secrets
import socket
import threading
import time
from collections.abc import Callable
from contextlib import redirect_stdout, suppress
from io import StringIO
from typing import TYPE_CHECKING, Any

import numpy as np

from implicam.errors import ImplicamError, UsageError, import_extra
from implicam.session.controller import CALIBRATION_FILE, REPORT_FILE, SessionController, State
from implicam.viewer import words
from implicam.viewer.front import Front
from implicam.viewer.legend import EXCESS, EXCESS_SCALE, U95, across, chart, curve, legend
from implicam.viewer.look import GO, LEFT, PLAIN, RIGHT, SHARE, STOP, STYLE
from implicam.viewer.pictures import current, montage
from implicam.viewer.scene import Scene
from implicam.viewer.worker import Worker

if TYPE_CHECKING:
    import viser

REASONS = ("the place cannot be reached", "something is in the way", "the cameras cannot see it", "another reason")
SHARPNESS = 1.5
"""Pixels of the montage per pixel of the page: type stays crisp on dense screens."""

HEAD, LOW_HEAD = 265, 218
"""Pixels of the page above the pictures: tabs and banner; in windows so narrow that its type is smaller."""

NARROW = 1450
"""Pixels: width of these windows, as in the style sheet."""

SETTLED = 1.5
"""Seconds until a browser has laid the panels out."""

SMALL = 900
"""Pixels: no window for this page is narrower."""

QUIET = 0.1
"""Seconds between two rounds of live pictures, at least."""


class Page:
    """The viser server of one guide. `closed` is set when the person closes the session."""

    def __init__(self, controller: SessionController) -> None:
        self._controller, self.closed = controller, threading.Event()
        self._unit, self._moves = controller.session.length_unit, controller.equipment.robot.moves
        self.server, self.origin = _inner_server()
        self._window = (900, 620)  # pixels of the page: width and height of the pictures
        self._left = LEFT
        self._worker = Worker(controller, self._complain)
        self._running = self._stale = True
        self._names = [source.name for source in controller.equipment.cameras]
        self._build()
        self._scene = Scene(self.server, controller.loop)
        self.server.on_client_connect(self._welcome)
        self._threads = [
            threading.Thread(target=work, name=f"implicam-{work.__name__}", daemon=True)
            for work in (self._live, self._render)
        ]

    @property
    def port(self) -> int:
        """The port of viser, on this machine only."""
        return self.server.get_port()

    def start(self) -> None:
        """Begin the session."""
        self._worker.start()
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Stop a robot that is on its way, and the page after what is being done now; the guide stays open."""
        self._controller.leave()
        self._running = False
        self._worker.close()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(timeout=30)
        with redirect_stdout(StringIO()):
            self.server.stop()

    # building

    def _build(self) -> None:
        gui, equipment = self.server.gui, self._controller.equipment
        by_itself = equipment.robot.alone and not equipment.dry_run
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="large")
        gui.set_panel_label("implicam")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(RIGHT)
        self._panel = gui.add_panel()
        with self._panel.add_tab("Cameras"):
            self._banner = gui.add_html("")
            self._picture = gui.add_image(np.zeros((9, 16, 3), np.uint8), jpeg_quality=85)
        self._panel.dock_left()
        self._panel.set_width(self._left)
        gui.add_html(STYLE, order=-1)
        self._numbers = gui.add_html("", order=0)
        self._place = gui.add_vector3(
            f"ball is at, {self._unit}", (0.0, 0.0, 0.0), step=0.001, visible=not self._moves, order=1
        )
        self._buttons = self._add_buttons()
        self._auto = gui.add_checkbox("automatic", False, visible=by_itself, order=20)
        self._auto.on_update(lambda event: self._set_auto(event))
        self._chart = gui.add_uplot(
            curve((), self._controller.loop.rule),
            **chart(self._unit, self._controller.loop.rule),
            aspect=1.75,
            order=30,
        )
        self._shown = gui.add_dropdown("colour", (U95, EXCESS), order=40)
        self._shown.on_update(lambda _: self._recolour())
        self._legend = gui.add_html("", order=41)
        for word, key in (("go", "space"), ("redo", "R"), ("skip", "S"), ("undo", "U")):
            self._hotkey(word, key)

    def _add_buttons(self) -> dict[str, viser.GuiButtonHandle]:
        gui = self.server.gui
        captions = {
            "go": "Go" if self._moves else "The ball is here", "accept": "Accept", "redo": "Redo", "skip": "Skip",
            "undo": "Undo", "finish": "Stop now", "stop": "STOP ROBOT",
        }  # fmt: skip
        buttons = {}
        for i, (word, caption) in enumerate(captions.items()):
            color = STOP if word == "stop" else PLAIN
            visible = self._moves or word != "stop"
            buttons[word] = gui.add_button(caption, color=color, disabled=word != "stop", visible=visible, order=2 + i)
            buttons[word].on_click(functools.partial(self._clicked, word))
        return buttons

    def _hotkey(self, word: str, key: Any) -> None:
        command = self.server.gui.add_command(f"{word} ({key})", hotkey=key)

        @command.on_trigger
        def _(event: Any) -> None:
            wish = word
            if word == "go" and self._controller.state.phase == "shown":
                wish = "accept"
            if words.allowed(self._controller.state, self._moves)[wish]:
                self._press(wish, event.client)

    # what people do

    def _clicked(self, word: str, event: Any) -> None:
        self._press(word, event.client)

    def _press(self, word: str, client: viser.ClientHandle | None) -> None:
        if word == "stop":
            try:
                self._controller.stop_robot()
            except ImplicamError as error:
                self._complain(error)
        elif word == "skip":
            self._ask_why(client)
        elif word == "finish" and self._controller.state.phase == "done":
            self.closed.set()
        else:
            self._worker.ask(self._action(word))

    def _action(self, word: str) -> Callable[[], Any]:
        controller = self._controller
        if word == "go" and controller.state.phase in ("trouble", "done"):
            return controller.retry
        if word == "go" and not self._moves:
            return functools.partial(controller.report_position, np.array(self._place.value, dtype=np.float64))
        return {
            "go": controller.go, "accept": controller.accept, "redo": controller.redo, "undo": controller.undo,
            "finish": controller.finish,
        }[word]  # fmt: skip

    def _ask_why(self, client: viser.ClientHandle | None) -> None:
        gui = self.server.gui if client is None else client.gui
        modal = gui.add_modal("Skip this target: why?")
        with modal:
            for reason in REASONS:
                button = gui.add_button(reason, color=PLAIN)
                button.on_click(functools.partial(self._skip, modal, reason))
            gui.add_button("do not skip", color=GO).on_click(lambda _: modal.close())

    def _skip(self, modal: Any, reason: str, _event: Any) -> None:
        modal.close()
        self._worker.ask(functools.partial(self._controller.skip, reason))

    def _set_auto(self, event: Any) -> None:
        if event.client is not None:  # else it was this page itself
            try:
                self._controller.set_auto(bool(self._auto.value))
            except UsageError as error:
                self._complain(error)

    def _recolour(self) -> None:
        self._scene.shown = self._shown.value
        self._stale = True

    def _welcome(self, client: viser.ClientHandle) -> None:
        """Fit the panels to the window, and the view to the scene."""
        window = client.camera.image_width  # the scene fills the window until the panels are docked
        self._fit(window, client.camera.image_height)
        time.sleep(SETTLED)
        if window < SMALL:  # a page that was open already, and has come back: its panels are docked
            self._fit(client.camera.image_width + self._left + RIGHT, client.camera.image_height)
            time.sleep(SETTLED)
        self._scene.aim(client)
        self._stale = True

    def _fit(self, width: int, height: int) -> None:
        self._left = int(np.clip(SHARE * (width - RIGHT), LEFT, 2000))
        self._panel.set_width(self._left)
        self._window = max(200, self._left - 18), max(200, height - (HEAD if width > NARROW else LOW_HEAD))
        self._scene.aspect = max(120, width - self._left - RIGHT) / height

    def _complain(self, error: ImplicamError) -> None:
        for client in self.server.get_clients().values():
            client.add_notification(
                error.what, "\n".join(text for text in (error.why, error.fix) if text), color=(200, 16, 46),
                auto_close_seconds=12.0,
            )  # fmt: skip

    # what is shown

    def _live(self) -> None:
        while self._running:
            begun = time.monotonic()
            if self.server.get_clients():
                self._controller.live()
            time.sleep(max(QUIET, 0.3 * (time.monotonic() - begun)))

    def _render(self) -> None:
        version = -1
        while self._running:
            state = self._controller.wait(version, 0.25)
            if state.version != version or self._stale:
                version, self._stale = state.version, False
                self._draw(state)

    def _draw(self, state: State) -> None:
        state = current(state)
        measured = self._controller.measured_live if state.phase == "aim" else np.full(3, np.nan)
        skipped = self._controller.session.skipped
        self._banner.content = words.banner(state, measured, self._unit, self._moves)
        self._numbers.content = words.numbers(state.history, self._unit, len(skipped))
        self._draw_buttons(state)
        self._draw_target(state)
        self._draw_pictures(state)
        self._draw_curve(state)
        self._scene.draw(state, measured, np.array([one.xyz for one in skipped]).reshape(-1, 3))
        self._draw_legend()

    def _draw_buttons(self, state: State) -> None:
        may, next_one = words.allowed(state, self._moves), words.proposed(state)
        captions = words.labels(state, self._moves, self._unit)
        for word, button in self._buttons.items():
            _set(button, "disabled", not may[word])
            if word != "stop":
                _set(button, "color", GO if word == next_one else PLAIN)
            if word in captions:
                _set(button, "label", captions[word])
        _set(self._auto, "disabled", not may["auto"])
        _set(self._auto, "value", state.auto)

    def _draw_target(self, state: State) -> None:
        """Where the next target is, to be corrected to where the ball really is."""
        name = None if state.target is None else state.target.name
        if self._moves or state.target is None or name == getattr(self, "_typed", None):
            return
        self._typed = name
        x, y, z = (float(f"{value:.6g}") for value in state.target.xyz)
        self._place.value = (x, y, z)  # type: ignore[misc]  # viser gives it a setter that mypy does not see

    def _draw_pictures(self, state: State) -> None:
        wide, high = (int(SHARPNESS * size) for size in self._window)
        self._picture.image = montage(state, self._names, self._aspects(state), wide, high)

    def _aspects(self, state: State) -> list[float]:
        shapes = {look.camera: look.frame.picture.shape for look in state.looks if look.frame is not None}
        sizes = [(camera.width, camera.height) for camera in self._controller.session.cameras]
        return [
            shapes[name][1] / shapes[name][0] if name in shapes else width / height if width and height else 4 / 3
            for name, (width, height) in zip(self._names, sizes, strict=True)
        ]

    def _draw_curve(self, state: State) -> None:
        if state.history is not getattr(self, "_curved", None):
            self._curved = state.history
            self._chart.data = curve(state.history, self._controller.loop.rule)
            scales = across(state.history[-1].points if state.history else 0)
            _set(self._chart, "scales", scales)

    def _draw_legend(self) -> None:
        excess = self._scene.shown == EXCESS
        scale = EXCESS_SCALE if excess else self._scene.scale
        content = legend(scale, self._scene.shown, self._unit) if scale is not None else ""
        _set(self._legend, "content", content)


def _set(handle: Any, name: str, value: Any) -> None:
    """Only what differs goes to the browser."""
    if getattr(handle, name) != value:
        setattr(handle, name, value)


def _inner_server() -> tuple[viser.ViserServer, str]:
    """A viser on a free port of this machine, and the one Origin whose WebSockets it takes: a secret.

    The front door checks who comes in, and names that Origin; a web page that tries viser's own port cannot. viser has
    no option for Origins, so the `serve` of its library is given one while viser starts; a refused handshake proves it.
    """
    library = import_extra("viser", "viewer", "the page of implicam acquire")
    sockets: Any = import_extra("websockets.asyncio.server", "viewer", "the page of implicam acquire")
    origin, plain = f"http://{secrets.token_hex(16)}.invalid", sockets.serve
    sockets.serve = functools.partial(plain, origins=[origin])
    try:
        with redirect_stdout(StringIO()):  # it prints the address that nobody is to use
            server: viser.ViserServer = library.ViserServer(host="127.0.0.1", port=0, verbose=False)
    finally:
        sockets.serve = plain
    server.request_share_url = lambda *_, **__: None  # type: ignore[method-assign]  # never by way of somebody else
    if _handshake(server.get_port(), origin="http://localhost") != 403:
        server.stop()
        raise UsageError(
            "this version of viser cannot be protected.",
            why="it lets any web page connect",
            fix='install the one that implicam was tested with: pip install "viser>=1.1,<2"',
        )
    return server, origin


def _handshake(port: int, origin: str) -> int:
    """The status that a WebSocket with this Origin is answered."""
    key = "AAAAAAAAAAAAAAAAAAAAAA=="
    with socket.create_connection(("127.0.0.1", port), timeout=10) as line:
        line.sendall(
            f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Origin: {origin}\r\nSec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
        )
        return int(line.recv(64).split(b" ")[1])


def serve(
    controller: SessionController,
    *,
    host: str = "127.0.0.1",
    port: int = 8090,
    token: str | None = None,
    open_browser: bool = True,
    say: Callable[[str], None] = print,
) -> None:
    """Show the page until the person closes the session, or Ctrl-C, which stops a robot first; the guide is still open
    then.

    host: what to listen on; another than this machine asks for a token, made up where none is given. port: 0 for any.
    ImplicamError where it cannot listen.
    """
    page = Page(controller)
    folder = controller.session.folder
    files = {"/report.html": folder / REPORT_FILE, "/calibration.implicam": folder / CALIBRATION_FILE}
    front = Front(host=host, port=port, behind=("127.0.0.1", page.port), token=token, files=files, origin=page.origin)
    try:
        front.start()
        page.start()
        with suppress(KeyboardInterrupt):
            say(f"The session is at {front.url}   (Ctrl-C ends it; nothing is lost)")
            if open_browser:
                import webbrowser

                webbrowser.open(front.url)
            while not page.closed.wait(0.5):
                pass
    finally:
        controller.leave()  # before anything is waited for: the robot may be on its way
        front.close()
        page.close()


__all__ = ["Page", "serve"]
