"""One thread that does what the buttons ask, one after the other; what it is doing now is the guide's state."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Any

from implicam.errors import ImplicamError
from implicam.session.controller import SessionController

Action = Callable[[], Any]

PAUSE = 0.15
"""Seconds between two looks at whether the session goes on by itself."""


class Worker:
    """complain: what tells a person that something could not be done."""

    def __init__(self, controller: SessionController, complain: Callable[[ImplicamError], None]) -> None:
        self._controller, self._complain = controller, complain
        self._jobs: queue.Queue[Action | None] = queue.Queue()
        self._lock, self._taken, self._closed = threading.Lock(), True, False
        self._thread = threading.Thread(target=self._run, name="implicam-worker", daemon=True)

    def start(self) -> None:
        """Begin, with connecting."""
        self._jobs.put(self._controller.start)
        self._thread.start()

    def ask(self, action: Action) -> bool:
        """Have it done, unless something is being done or waiting already: a button pressed twice counts once."""
        if not self._take():
            return False
        self._jobs.put(action)
        return True

    def close(self) -> None:
        """After what it is doing now; what waits is not begun."""
        self._closed = True
        self._jobs.put(None)
        if self._thread.is_alive():
            self._thread.join(timeout=60)

    def _run(self) -> None:
        while True:
            try:
                job = self._jobs.get(timeout=PAUSE)
            except queue.Empty:
                if not self._controller.state.auto or not self._take():
                    continue
                job = self._by_itself
            if job is None or self._closed:
                return
            self._do(job)

    def _take(self) -> bool:
        """Whether nothing is being done; then something is from now on."""
        with self._lock:
            free, self._taken = not self._taken, True
        return free

    def _do(self, job: Action) -> None:
        try:
            job()
        except ImplicamError as error:
            self._complain(error)
        finally:
            with self._lock:
                self._taken = False

    def _by_itself(self) -> None:
        """The next step of an automatic session; it ends when a rule says so, or where no place is left."""
        state = self._controller.state
        if not state.auto:  # somebody has just switched it off
            return
        if state.phase == "shown" or (state.phase == "aim" and state.target is not None and not state.stop):
            self._controller.step()
        elif state.phase == "aim":
            self._controller.set_auto(False)
