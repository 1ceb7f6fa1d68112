r"""A trigger box on the network, and one that is only simulated. The paper used Arduinos.

Lines of ASCII text, each ended by \n, over TCP, or one a packet over UDP:

    HELLO          ->  IMPLICAM-TRIGGER 1 <lines>      version of the protocol, number of output lines
    TRIG <n>       ->  OK <n> <microseconds>           all lines were pulsed; the box's clock at the pulse
    anything else  ->  ERR <words>

n is a number from 0 to 2147483647. A box that receives the n it pulsed last again answers again, with the same
microseconds, and does not pulse: over UDP a lost answer cannot be told from a lost question, and the driver asks again.
"""

from __future__ import annotations

import secrets
import socket
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import ClassVar, Self
from urllib.parse import urlsplit

from implicam.errors import HardwareError, UsageError, did_you_mean
from implicam.hardware.protocol import Trigger

GREETING_PREFIX = "IMPLICAM-TRIGGER 1 "
PULSE_NUMBERS = 2**31
MAX_ATTEMPTS = 5
MAX_LINE_BYTES = 200


class NetworkTrigger:
    """The `Trigger` at "udp://host:port" or "tcp://host:port"; it has `timeout` seconds to acknowledge."""

    spec: ClassVar[str] = "udp://HOST:PORT"

    @classmethod
    def from_spec(cls, rest: str) -> Self:
        """A trigger box by its address, not connected yet.

        Args:
            rest: "//HOST:PORT".

        Raises:
            UsageError: The address is not complete.
        """
        return cls(f"{cls.spec.partition(':')[0]}:{rest}")

    def __init__(self, address: str, timeout: float = 1.0) -> None:
        self.address, self._timeout = address, timeout
        self._host, self._port, self._udp = _split_address(address)
        self._socket: socket.socket | None = None
        self._buffer = b""
        self._number = secrets.randbelow(PULSE_NUMBERS)  # not that of the last session, which the box may remember
        self.lines = 0

    def open(self) -> None:
        """Connect, and ask for the version of the protocol."""
        if self._socket is not None:
            return
        try:
            kind = socket.SOCK_DGRAM if self._udp else socket.SOCK_STREAM
            family, *_, place = socket.getaddrinfo(self._host, self._port, type=kind)[0]
            self._buffer, self._socket = b"", socket.socket(family, kind)
            self._socket.settimeout(self._timeout)
            self._socket.connect(place)
        except OSError as error:
            self.close()
            raise self._no_answer_error(str(error)) from error
        answer = self._ask("HELLO", GREETING_PREFIX)
        self.lines = int(answer) if answer.isdecimal() else 0

    def fire(self) -> None:
        """Pulse all lines once; asking again after a lost packet does not pulse again."""
        self.open()
        self._number = (self._number + 1) % PULSE_NUMBERS
        self._ask(f"TRIG {self._number}", f"OK {self._number} ")

    def close(self) -> None:
        """Disconnect."""
        if self._socket is not None:
            self._socket.close()
        self._socket = None

    def _ask(self, question: str, begins: str) -> str:
        """What follows `begins` in the answer; over UDP the question is repeated, over TCP the network does that."""
        assert self._socket is not None
        attempts = MAX_ATTEMPTS if self._udp else 1
        why = f"{question!r} was sent {attempts} times, and not answered within {self._timeout:g} s"
        try:
            for _ in range(attempts):
                self._socket.sendall(f"{question}\n".encode())
                answer = self._read_answer(begins, time.monotonic() + self._timeout / attempts)
                if answer is not None:
                    return answer
        except OSError as error:
            why = str(error)
        except HardwareError:
            self.close()
            raise
        self.close()
        raise self._no_answer_error(why)

    def _read_answer(self, begins: str, end: float) -> str | None:
        while (line := self._read_line(end)) is not None:
            if line.startswith(begins):
                return line.removeprefix(begins)
            if line.startswith("ERR"):
                raise HardwareError(
                    f"the trigger box at {self.address} refuses.",
                    why=line.removeprefix("ERR").strip() or "it does not say why",
                    fix="load the sketch of docs/hardware.md on it",
                )
            # else a late answer to an earlier question
        return None

    def _read_line(self, end: float) -> str | None:
        assert self._socket is not None
        while b"\n" not in self._buffer:
            left = end - time.monotonic()
            if left <= 0:
                return None
            self._socket.settimeout(left)
            try:
                data = self._socket.recv(4096)
            except TimeoutError:
                return None
            if not data and not self._udp:
                raise ConnectionError("it closed the connection")
            self._buffer = (self._buffer + data)[-MAX_LINE_BYTES * 20 :]
        line, _, self._buffer = self._buffer.partition(b"\n")
        return line.decode("ascii", "replace").strip()

    def _no_answer_error(self, why: str) -> HardwareError:
        return HardwareError(
            f"the trigger box at {self.address} does not answer.",
            why=why,
            fix="check its power, its cable and its address; it must speak the protocol of docs/hardware.md",
        )


class TCPTrigger(NetworkTrigger):
    """The same, named by "tcp"."""

    spec: ClassVar[str] = "tcp://HOST:PORT"


def _split_address(address: str) -> tuple[str, int, bool]:
    try:
        parts = urlsplit(address)
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if not host or not port or parts.scheme not in ("udp", "tcp"):
        raise UsageError(
            f"{address!r} is no address of a trigger box{did_you_mean(address.partition(':')[0], ('udp', 'tcp'))}.",
            fix="write udp://host:port or tcp://host:port, for example udp://192.168.0.50:4000",
        )
    return host, port, parts.scheme == "udp"


class TriggerBoxes:
    """Several boxes as one `Trigger`, each for its own cameras: all are told at the same time, in a thread each.

    boxes: The box, and the cameras that hang on it, for messages.
    """

    def __init__(self, boxes: Sequence[tuple[Trigger, Sequence[str]]]) -> None:
        self.boxes = tuple((box, tuple(cameras)) for box, cameras in boxes)

    def open(self) -> None:
        """Connect to all; after an error to none."""
        try:
            self._all("open")
        except HardwareError:
            self.close()
            raise

    def fire(self) -> None:
        """Pulse all boxes once; HardwareError where one of them does not answer, after all have been told."""
        self._all("fire")

    def close(self) -> None:
        """Disconnect from all."""
        for box, _ in self.boxes:
            box.close()

    def _all(self, what: str) -> None:
        together = threading.Barrier(len(self.boxes))

        def tell(box: Trigger, cameras: Sequence[str]) -> None:
            together.wait()
            try:
                getattr(box, what)()
            except HardwareError as error:
                why = f"{error.why}; the cameras on it are {', '.join(cameras)}" if cameras else error.why
                raise HardwareError(error.what, why=why, fix=error.fix) from error

        with ThreadPoolExecutor(len(self.boxes)) as pool:
            told = [pool.submit(tell, box, cameras) for box, cameras in self.boxes]
        for one in told:
            one.result()


class TriggerSimulator:
    """A trigger box without a box, at `address` on this machine: stands in for hardware, and counts its pulses.

    Use it as a context manager. drop_questions, drop_answers: how many of the next packets get lost (UDP). delay:
    seconds before each answer.
    """

    def __init__(self, kind: str = "udp", *, lines: int = 4, delay: float = 0.0) -> None:
        self.lines, self.delay = lines, delay
        self.fired: list[int] = []
        self.drop_questions = self.drop_answers = 0
        self._last = (-1, 0)
        self._udp = kind == "udp"
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM if self._udp else socket.SOCK_STREAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.05)
        self.address = f"{kind}://127.0.0.1:{self._socket.getsockname()[1]}"
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._serve_udp if self._udp else self._serve_tcp, daemon=True)

    def __enter__(self) -> Self:
        if not self._udp:
            self._socket.listen()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending.set()
        self._thread.join()
        self._socket.close()

    def answer(self, question: str) -> str:
        """Answer one line as the box does, and count the pulse where it asks for one.

        Args:
            question: The line, for example "TRIG 7".

        Returns:
            The answer, with its line end.
        """
        word, _, number = question.strip().partition(" ")
        if word == "HELLO" and not number:
            return f"{GREETING_PREFIX}{self.lines}\n"
        if word != "TRIG" or not number.isdecimal() or int(number) >= PULSE_NUMBERS:
            return f"ERR {question.strip()[:40]!r} is not understood\n"
        if int(number) != self._last[0]:
            self._last = int(number), time.monotonic_ns() // 1000
            self.fired.append(int(number))
        return f"OK {number} {self._last[1]}\n"

    def _serve_udp(self) -> None:
        while not self._ending.is_set():
            try:
                data, place = self._socket.recvfrom(MAX_LINE_BYTES)
            except TimeoutError:
                continue
            if self.drop_questions > 0:
                self.drop_questions -= 1
                continue
            answer = self.answer(data.decode("ascii", "replace"))
            if self.drop_answers > 0:
                self.drop_answers -= 1
                continue
            self._ending.wait(self.delay)
            self._socket.sendto(answer.encode(), place)

    def _serve_tcp(self) -> None:
        while not self._ending.is_set():
            try:
                connection, _ = self._socket.accept()
            except TimeoutError:
                continue
            with connection:
                connection.settimeout(0.05)
                self._talk(connection)

    def _talk(self, connection: socket.socket) -> None:
        buffer = b""
        while not self._ending.is_set():
            try:
                data = connection.recv(MAX_LINE_BYTES)
            except TimeoutError:
                continue
            except OSError:
                return
            if not data:
                return
            *lines, buffer = (buffer + data).split(b"\n")
            for line in lines:
                self._ending.wait(self.delay)
                connection.sendall(self.answer(line.decode("ascii", "replace")).encode())
