"""The library ur-rtde in a process of its own: this file, run as a program, is that process.

When the robot falls silent, ur-rtde 1.6.5 waits with Python's lock held, reconnects by itself, uploads its program
again, or aborts the whole process ("pthread_mutex_lock ... Assertion failed", seen when it is closed then). None of
that may happen to a session, or move a robot unobserved: here the process is ended.
Questions and answers are JSON lines: [7, "receive", "getTimestamp", []] -> {"id": 7, "value": 12.5} or {"id": 7,
"error": "..."}. When the session itself dies, the process stops the robot.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from typing import Any

LIBRARIES = {"receive": ("rtde_receive", "RTDEReceiveInterface"), "control": ("rtde_control", "RTDEControlInterface")}

STOP_TIMEOUT_SECONDS = 5
"""What the process has to stop the robot once the session has died."""

DECELERATION_M_S2 = 2.0
"""Of a robot that is stopped."""


class Worker:
    """The process, as the session sees it; `call` may be used from several threads, and raises TimeoutError once it is
    gone."""

    def __init__(self) -> None:
        command = [sys.executable, "-P", __file__]  # -P: modules of this folder must not hide libraries
        pipe = subprocess.PIPE
        # A process group of its own: Ctrl-C reaches only us, and we tell the robot to stop.
        self._process = subprocess.Popen(
            command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, bufsize=0, start_new_session=True
        )
        self._asked = 0
        self._answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def call(self, thing: str, method: str, *args: object, timeout: float = 2.0) -> Any:
        """Call a method of the library in the other process.

        Args:
            thing: "receive" or "control", see `LIBRARIES`.
            method: The method's name; "connect" makes the thing itself.
            args: Of the method; plain values that JSON can hold.
            timeout: Seconds to wait for the answer.

        Returns:
            What the method returns.

        Raises:
            RuntimeError: The method raised an error; the message is the same.
            TimeoutError: There was no answer in time, or the other process is gone.
        """
        with self._lock:
            self._asked += 1
            try:
                assert self._process.stdin is not None
                self._process.stdin.write((json.dumps([self._asked, thing, method, args]) + "\n").encode())
                answer = self._wait_for_answer(self._asked, time.monotonic() + timeout)
            except (queue.Empty, OSError, ValueError) as error:
                raise TimeoutError(f"no answer within {timeout:g} s") from error
        if "error" in answer:
            raise RuntimeError(answer["error"])
        return answer["value"]

    def _wait_for_answer(self, number: int, end: float) -> dict[str, Any]:
        """The answer to question `number`; one to a question that Ctrl-C interrupted is passed over."""
        while True:
            line = self._answers.get(timeout=max(0.0, end - time.monotonic()))
            if not line:
                raise OSError("ur-rtde ended")
            answer: dict[str, Any] = json.loads(line)
            if answer["id"] == number:
                return answer

    def end(self) -> None:
        """End the process at once; the connections to the robot end with it."""
        self._process.kill()
        self._process.wait()
        self._reader.join()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._answers.put(line)
        self._answers.put(b"")


def _serve() -> None:
    """The other process: answer until the session closes the pipe."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # the library prints to stdout, where the answers go
    things: dict[str, Any] = {}
    with suppress(BrokenPipeError):  # the session died before it read the answer
        for line in sys.stdin:
            number, thing, method, args = json.loads(line)
            answers.write(json.dumps({"id": number, **_answer_call(things, thing, method, args)}) + "\n")
            answers.flush()
    if hasattr(signal, "alarm"):
        signal.alarm(STOP_TIMEOUT_SECONDS)  # ends us even where the library waits with Python's lock held
    if "control" in things:  # the session is gone, so the robot must not go on moving
        with suppress(Exception):
            things["control"].stopL(DECELERATION_M_S2)
            things["control"].stopScript()
    os._exit(0)  # skips the library's destructors, which may hang


def _answer_call(things: dict[str, Any], thing: str, method: str, args: list[Any]) -> dict[str, Any]:
    try:
        if method != "connect":
            return {"value": getattr(things[thing], method)(*args)}
        module, name = LIBRARIES[thing]
        things[thing] = getattr(__import__(module), name)(*args)
        return {"value": None}
    except Exception as error:  # the session raises it again
        return {"error": str(error) or type(error).__name__}


if __name__ == "__main__":
    _serve()
