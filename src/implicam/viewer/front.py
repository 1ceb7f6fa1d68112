"""The front door of the pages of `acquire` and `label`: who may talk to them, and so to a robot.

The page itself (Starlette) listens on 127.0.0.1 on a port that nobody is told. This small server listens where
people look for it, checks each request and passes it on. What it keeps out, and by what:

- a web page elsewhere that opens a WebSocket to this machine: the Origin must be the Host it came to;
- a name that an attacker's DNS points to this machine (rebinding): only known Hosts are answered;
- a web page elsewhere that shows ours in a frame, or talks it into connecting to another server: the
  Content-Security-Policy put on every answer;
- people on the network: a token where the server is not bound to this machine alone, kept in a cookie that scripts
  and other sites cannot use;
- heads that are too long, too slow, or not HTTP; a second request behind a checked one: each plain request gets a
  connection of its own and exactly its own body, a WebSocket passes raw bytes only once it is one.

The rules are those of RFC 9112 (HTTP/1.1), RFC 6455 (WebSocket), RFC 6265 (cookies), and W3C's CSP 3.
"""

from __future__ import annotations

import asyncio
import errno
import hashlib
import ipaddress
import mimetypes
import re
import secrets
import socket
import threading
import time
from asyncio import StreamReader, StreamWriter
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from types import TracebackType
from urllib.parse import parse_qsl, quote, unquote, urlsplit

from implicam.errors import ImplicamError, UsageError

HEAD_BYTES = 16 * 1024
CHUNK_BYTES = 1 << 18  # a picture of a camera in one or two reads
PATIENCE_SECONDS = 10.0  # seconds: for a head, for the next piece of a body, for the last bytes to leave
ANSWER_SECONDS = 30.0  # seconds that the page behind has until its first line
STALL_SECONDS = 60.0  # seconds without reading, after which the other side counts as gone
WRONG_TOKEN_SECONDS = 0.5  # seconds that a wrong token costs
MAX_CLIENTS = 128  # more would take file descriptors from the cameras and the journal
MAX_STRANGERS = (
    64  # connections that have not shown the token yet; of more, the oldest of the busiest address is hung up on
)
WILDCARDS = ("", "0.0.0.0", "::")

REQUEST_LINE = re.compile(
    r'([A-Z]{1,16}) (/[!"$-\[\]-~]*) HTTP/1\.[01]'
)  # no "#" and no "\", which browsers read as "/"
HEADER_LINE = re.compile(r"([!#$%&'*+.^_`|~0-9A-Za-z-]+):[ \t]*([\t\x20-\x7e\x80-\xff]*)")
HOST = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(?::[0-9]{1,5})?")
HOP_BY_HOP = {"connection", "keep-alive", "proxy-connection", "upgrade", "te", "trailer", "expect"}

TOKEN_PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>implicam: token</title>
<meta name="viewport" content="width=device-width">
<style>body{font:20px/1.5 system-ui,sans-serif;max-width:34em;margin:15vh auto;padding:0 1em}
input,button{font:inherit;padding:.4em .7em}</style>
<h1>This page asks for a token</h1>
<p>Only people with the token may open it, because {stake}. The token stands in the terminal where
<code>{command}</code> runs, at the end of the address it prints. Came here by that very address? Reload.</p>
<form method="get"><input name="token" type="password" autocomplete="off" autofocus aria-label="token">
<button>Open</button></form></html>
"""


def needs_token(host: str) -> bool:
    """Whether others than this machine can reach a server bound to `host`: all but 127.0.0.0/8, ::1, localhost."""
    return not _is_this_machine(host.strip("[]").lower())


def _address(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """The address that `name` writes out, None for a name."""
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None


def _is_this_machine(name: str) -> bool:
    address = _address(name)
    return name == "localhost" if address is None else address.is_loopback


@dataclass(frozen=True)
class _Reply:
    """An answer of ours: status, body, and header lines beyond those that every answer has."""

    status: int
    body: bytes
    headers: tuple[str, ...] = ("Content-Type: text/plain; charset=utf-8",)

    def head(self, host: str) -> bytes:
        """Status line and headers."""
        first = f"HTTP/1.1 {self.status} {HTTPStatus(self.status).phrase}"
        length = f"Content-Length: {len(self.body)}"
        return _lines(first, *_safe_headers(host), *self.headers, length, "Cache-Control: no-store", "")


def _lines(*lines: str) -> bytes:
    return "".join(f"{line}\r\n" for line in lines).encode("latin-1")


def _safe_headers(host: str) -> tuple[str, ...]:
    """What every answer carries; `host` is a checked Host header, or empty.

    WebSockets are named beside 'self', because browsers do not agree whether 'self' covers them.
    """
    sockets = f" ws://{host} wss://{host}" if host else ""
    return (
        f"Content-Security-Policy: frame-ancestors 'self'; connect-src 'self'{sockets} data: blob:",
        "Cross-Origin-Resource-Policy: same-origin",
        "Referrer-Policy: no-referrer",
        "X-Content-Type-Options: nosniff",
        "Connection: close",
    )


def _words(status: int, words: str) -> _Reply:
    return _Reply(status, f"{words}\n".encode())


class _RefusedError(Exception):
    """A request that is not passed on; carries the answer."""

    def __init__(self, status: int, words: str) -> None:
        super().__init__(words)
        self.reply = _words(status, words)


@dataclass(frozen=True)
class _Head:
    """The head of a request; names of headers in lower case, targets begin with one "/"."""

    method: str
    target: str
    headers: tuple[tuple[str, str], ...]

    @classmethod
    def parse(cls, raw: bytes) -> _Head:
        """The head in `raw`, which ends with an empty line. _RefusedError (400) where it is not HTTP/1."""
        first, *rest = raw[:-4].decode("latin-1").split("\r\n")
        request = REQUEST_LINE.fullmatch(first)
        headers = [HEADER_LINE.fullmatch(line) for line in rest]
        if request is None:
            raise _RefusedError(400, "The first line is not an HTTP/1.1 request for a path on this server.")
        if not all(headers):
            raise _RefusedError(400, "A header line is not 'Name: value' in printable characters.")
        target = "/" + request[2].lstrip("/")  # "//elsewhere/" in a redirect would lead there
        return cls(request[1], target, tuple((line[1].lower(), line[2].strip()) for line in headers if line))

    def all(self, name: str) -> list[str]:
        """Values of the header `name`, in order."""
        return [value for key, value in self.headers if key == name]

    @property
    def is_websocket(self) -> bool:
        """Whether it asks for a WebSocket, as lenient as any server behind might be."""
        return any(
            part.strip().lower().startswith("websocket") for value in self.all("upgrade") for part in value.split(",")
        )

    @property
    def path(self) -> str:
        """The path alone, percent signs decoded."""
        return unquote(urlsplit(self.target).path)

    def body_bytes(self) -> int:
        """Length of the body. _RefusedError where it is not one plain number, or where a WebSocket has one."""
        if self.all("transfer-encoding"):
            raise _RefusedError(411, "A body needs a Content-Length here; Transfer-Encoding is not understood.")
        lengths = self.all("content-length") or ["0"]
        if len(lengths) > 1 or not re.fullmatch("[0-9]{1,15}", lengths[0]):
            raise _RefusedError(400, "Content-Length is not one number.")
        length = int(lengths[0])
        if self.is_websocket and (length or self.method != "GET"):
            raise _RefusedError(400, "A WebSocket starts with GET and has no body.")
        return length

    def tokens(self) -> list[str]:
        """Values of `token` in the query."""
        return [
            value for key, value in parse_qsl(urlsplit(self.target).query, keep_blank_values=True) if key == "token"
        ]

    def without_token(self) -> str:
        """The target without `token` in its query."""
        path, _, query = self.target.partition("?")
        kept = [part for part in query.split("&") if part and unquote(part.partition("=")[0]) != "token"]
        return f"{path}?{'&'.join(kept)}" if kept else path

    def cookies(self) -> list[tuple[str, str]]:
        """(name, value) of each cookie, as sent."""
        parts = [part.strip().partition("=") for value in self.all("cookie") for part in value.split(";")]
        return [(name, value) for name, _, value in parts if name]

    def passed_on(self, *, cookie: str, origin: str | None) -> bytes:
        """The head for the page behind: without our cookie, with `origin`, and for one answer unless a WebSocket."""
        dropped = {"cookie"} | (set() if self.is_websocket else HOP_BY_HOP) | ({"origin"} if origin else set())
        lines = [f"{name}: {value}" for name, value in self.headers if name not in dropped]
        cookies = "; ".join(f"{name}={value}" for name, value in self.cookies() if name != cookie)
        lines += [f"cookie: {cookies}"] if cookies else []
        lines += [f"origin: {origin}"] if origin else []
        lines += [] if self.is_websocket else ["connection: close"]
        return _lines(f"{self.method} {self.target} HTTP/1.1", *lines, "")


class Front:
    """The server in front of the page; a context manager that starts and closes.

    `host` and `port` are where it listens (port 0: any free one); `behind` is (host, port) of the page; `files` maps a
    path such as "/report.html" to a file, which may come later. `token` is what opens the page; where `needs_token`
    says so and None is given, one is made. `origin`, where given, is what the page behind gets as Origin of every
    request: it may refuse all others, since a web page elsewhere can try all ports of this machine and find its own.
    `command` and `stake` are for the words: what serves the page, and why not everyone may open it.
    Runs in one thread of its own and prints nothing.
    """

    def __init__(
        self,
        *,
        host: str,
        port: int,
        behind: tuple[str, int],
        token: str | None,
        files: Mapping[str, Path],
        origin: str | None = None,
        command: str = "implicam acquire",
        stake: str = "it can move a robot",
    ) -> None:
        if token == "":
            raise UsageError(
                "The token of the page is empty.",
                why=f"Anyone could open the page, and {stake}.",
                fix="Leave the token out (one is made where it is needed), or give a long one.",
            )
        self.host, self.port = host.strip("[]").lower(), port
        self._behind, self._files = behind, dict(files)
        self._origin, self._command, self._stake = origin, command, stake
        self._token = secrets.token_urlsafe(16) if token is None and needs_token(host) else token
        self._clients: set[asyncio.Task[None]] = set()
        self._strangers: dict[
            asyncio.Task[None], str
        ] = {}  # those that may not pass yet: task -> address, oldest first
        self._thread: threading.Thread | None = None
        self._hang_up: Callable[[], None] | None = None

    @property
    def url(self) -> str:
        """The address for the browser, with the token where one is asked."""
        query = f"?token={quote(self._token, safe='')}" if self._token is not None else ""
        return f"http://{_shown(self.host)}:{self.port}/{query}"

    @property
    def cookie(self) -> str:
        """Name of the cookie: with the port, because browsers share cookies between the ports of a host."""
        return f"implicam-{self.port}"

    def start(self) -> None:
        """Listen. ImplicamError where the port is taken or the host is not this machine."""
        listening = _listen(self.host, self.port)
        self.port = listening.getsockname()[1]
        ready = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(listening, ready), name="implicam-front", daemon=True)
        self._thread.start()
        ready.wait()

    def close(self) -> None:
        """Hang up on everyone, free the port, end the thread; may be called twice."""
        thread, self._thread = self._thread, None
        if thread is not None and self._hang_up is not None:
            self._hang_up()
            thread.join()

    def __enter__(self) -> Front:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _run(self, listening: socket.socket, ready: threading.Event) -> None:
        with asyncio.Runner(loop_factory=asyncio.SelectorEventLoop) as runner:  # Windows' own loop has no add_reader
            runner.run(self._serve(listening, ready))

    async def _serve(self, listening: socket.socket, ready: threading.Event) -> None:
        """Accept until told to hang up.

        Not by asyncio's Server: up to Python 3.11 one that is closed forgets the sockets it has just accepted.
        """
        loop, closing = asyncio.get_running_loop(), asyncio.Event()
        listening.setblocking(False)
        loop.add_reader(listening, self._accept, loop, listening)
        self._hang_up = lambda: _call_soon(loop, closing.set)
        ready.set()
        await closing.wait()
        loop.remove_reader(listening)
        listening.close()
        clients = list(self._clients)
        for client in clients:
            client.cancel()
        await asyncio.gather(*clients, return_exceptions=True)

    def _accept(self, loop: asyncio.AbstractEventLoop, listening: socket.socket) -> None:
        try:
            line, (address, *_) = listening.accept()
        except BlockingIOError:
            return  # who knocked is gone
        except OSError:
            time.sleep(0.05)  # no file descriptor is left: nothing can be done, but not at full speed
            return
        line.setblocking(False)
        client = loop.create_task(self._client(line))
        self._clients.add(client)
        self._strangers[client] = address
        client.add_done_callback(self._clients.discard)
        client.add_done_callback(lambda done: self._strangers.pop(done, None))
        self._make_room()
        client.add_done_callback(lambda _: line.close())  # nobody else does where it is cancelled before it begins

    def _make_room(self) -> None:
        """Connections that say nothing must not keep out who has the token."""
        addresses = list(self._strangers.values())
        if len(addresses) > MAX_STRANGERS:
            busiest = max(addresses, key=addresses.count)
            oldest = next(task for task, address in self._strangers.items() if address == busiest)
            del self._strangers[oldest]
            oldest.cancel()

    async def _client(self, line: socket.socket) -> None:
        """One connection from its first byte to its last."""
        with suppress(OSError, TimeoutError):  # they hung up, or stopped reading
            reader, writer = await asyncio.open_connection(sock=line, limit=HEAD_BYTES)
            try:
                await self._answer(reader, writer)
                await _finish(reader, writer)
            finally:
                writer.transport.abort()

    async def _answer(self, reader: StreamReader, writer: StreamWriter) -> None:
        head = None
        try:
            head = await self._read_head(reader)
            if head is None:
                return
            self._check_source(head)
            reply = await self._check_token(head)
            if reply is None:
                self._let_pass()
                reply = await self._file(head) or await self._relay(head, reader, writer)
        except _RefusedError as refused:
            reply = refused.reply
        if reply is not None:
            host = head.all("host")[0] if head is not None and reply.status < 400 else ""
            writer.write(reply.head(host) + (b"" if head is not None and head.method == "HEAD" else reply.body))
            await writer.drain()

    async def _read_head(self, reader: StreamReader) -> _Head | None:
        """The next head; None where the client hung up before it was complete."""
        try:
            async with asyncio.timeout(PATIENCE_SECONDS):
                return _Head.parse(await reader.readuntil(b"\r\n\r\n"))
        except asyncio.IncompleteReadError:
            return None
        except asyncio.LimitOverrunError:
            raise _RefusedError(431, f"The head of the request is longer than {HEAD_BYTES} bytes.") from None
        except TimeoutError:
            raise _RefusedError(408, f"No complete request within {PATIENCE_SECONDS:.0f} seconds.") from None

    def _let_pass(self) -> None:
        """Of the connection that is answered now: it has the token, where one is asked. Not any number may."""
        task = asyncio.current_task()
        if task is not None:
            self._strangers.pop(task, None)
        if len(self._clients) - len(self._strangers) > MAX_CLIENTS:
            raise _RefusedError(503, f"More than {MAX_CLIENTS} connections are open. Close other pages and reload.")

    def _check_source(self, head: _Head) -> None:
        """Refuse a Host that is not ours, and what a page from elsewhere asks for."""
        hosts, origins = head.all("host"), head.all("origin")
        match = HOST.fullmatch(hosts[0]) if len(hosts) == 1 else None
        if match is None:
            raise _RefusedError(400, "The request needs one Host header with a host and perhaps a port.")
        if not self._is_ours(match[1].strip("[]").lower()):
            raise _RefusedError(
                403,
                "This address does not belong to the page: it answers on localhost and where it was told to listen.\n"
                f"Open the address that {self._command} printed.",
            )
        ours = {f"{scheme}://{hosts[0].lower()}" for scheme in ("http", "https")}
        if (head.is_websocket and not origins) or any(origin.lower() not in ours for origin in origins):
            raise _RefusedError(403, f"Another web page asked for this. Only the page itself may, since {self._stake}.")

    def _is_ours(self, name: str) -> bool:
        """Whether `name` (lower case, no brackets) is this machine, or where we listen; no DNS is asked."""
        address = _address(name)
        if _is_this_machine(name):
            return True
        if self.host in WILDCARDS:  # an address cannot be rebound, only a name can
            return address is not None or name in _machine_names()
        return name == self.host or (address is not None and address == _address(self.host))

    async def _check_token(self, head: _Head) -> _Reply | None:
        """None where the client may pass; a redirect that sets the cookie; or, after a while, the page that asks."""
        if self._token is None:
            return None
        given, ticket = head.tokens(), _ticket(self._token)
        if any(_same(value, self._token) for value in given):
            cookie = f"Set-Cookie: {self.cookie}={ticket}; HttpOnly; SameSite=Strict; Path=/"
            return _Reply(303, b"", (f"Location: {head.without_token()}", cookie))
        if not given and any(name == self.cookie and _same(value, ticket) for name, value in head.cookies()):
            return None
        if given:
            await asyncio.sleep(WRONG_TOKEN_SECONDS)
        words = TOKEN_PAGE.replace("{stake}", self._stake).replace("{command}", self._command)
        return _Reply(401, words.encode(), ("Content-Type: text/html; charset=utf-8",))

    async def _file(self, head: _Head) -> _Reply | None:
        """One of `files`; None where the path is not among them."""
        file = None if head.is_websocket else self._files.get(head.path)
        if file is None:
            return None
        if head.method not in ("GET", "HEAD"):
            return _words(405, "Files are for GET.")
        try:
            body = await asyncio.to_thread(file.read_bytes)
        except OSError:
            return _words(404, f"{head.path} is not there yet. It is written when the session finishes.")
        kind, packed = mimetypes.guess_type(file.name)
        kind = "application/octet-stream" if kind is None or packed else kind
        return _Reply(200, body, (f"Content-Type: {kind}" + "; charset=utf-8" * kind.startswith("text/"),))

    async def _relay(self, head: _Head, reader: StreamReader, writer: StreamWriter) -> _Reply | None:
        """Pass one request on and its answer back; None once a byte of the answer is out."""
        length = head.body_bytes()
        try:
            async with asyncio.timeout(PATIENCE_SECONDS):
                behind = await asyncio.open_connection(*self._behind, limit=CHUNK_BYTES)
        except (OSError, TimeoutError):
            return _words(502, f"The page behind this door does not answer. Is {self._command} still running?")
        try:
            return await self._exchange(head, length, (reader, writer), behind)
        finally:
            behind[1].transport.abort()

    async def _exchange(self, head: _Head, length: int, client: _Pipe, behind: _Pipe) -> _Reply | None:
        (reader, writer), (answers, questions) = client, behind
        status = b""
        with suppress(OSError, TimeoutError):  # an answer may come, and the connection end, before the whole question
            questions.write(head.passed_on(cookie=self.cookie, origin=self._origin))
            await _copy(reader, questions, length)
        with suppress(OSError, TimeoutError, ValueError):
            async with asyncio.timeout(ANSWER_SECONDS):
                status = await answers.readline()
        if not re.fullmatch(rb"HTTP/1\.[01] [0-9]{3}.*\r\n", status):
            return _words(502, "The page behind this door hung up without an answer.")
        if head.is_websocket and status.split()[1:2] == [b"101"]:
            writer.write(status)
            await _both_ways(client, behind)
        else:
            writer.write(status + _lines(*_safe_headers(head.all("host")[0])))
            await _copy(answers, writer)
        return None


_Pipe = tuple[StreamReader, StreamWriter]


async def _copy(source: StreamReader, sink: StreamWriter, length: int | None = None) -> None:
    """Copy `length` bytes, or all until the end. TimeoutError where a piece of known length or the sink stalls."""
    left = CHUNK_BYTES if length is None else length
    while left > 0:
        async with asyncio.timeout(None if length is None else PATIENCE_SECONDS):
            data = await source.read(min(CHUNK_BYTES, left))
        if not data:
            return
        sink.write(data)
        async with asyncio.timeout(STALL_SECONDS):
            await sink.drain()
        left -= 0 if length is None else len(data)


async def _both_ways(one: _Pipe, other: _Pipe) -> None:
    """Copy in both directions until both have ended, or one has and the other does not follow."""

    async def through(source: StreamReader, sink: StreamWriter) -> None:
        try:
            await _copy(source, sink)
        finally:
            with suppress(OSError, RuntimeError):
                sink.write_eof()  # so that the other side ends too

    ways = [asyncio.create_task(through(a, b)) for a, b in ((one[0], other[1]), (other[0], one[1]))]
    try:
        await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        await asyncio.wait(ways, timeout=PATIENCE_SECONDS)
    finally:
        for way in ways:
            way.cancel()
        await asyncio.gather(*ways, return_exceptions=True)


async def _finish(reader: StreamReader, writer: StreamWriter) -> None:
    """Send what is left and wait for the client to hang up: closing on unread bytes would destroy the answer."""
    async with asyncio.timeout(PATIENCE_SECONDS):
        writer.write_eof()
        while await reader.read(CHUNK_BYTES):
            pass


def _same(given: str, expected: str) -> bool:
    """Equal; the time it takes tells nothing."""
    return secrets.compare_digest(given.encode(errors="replace"), expected.encode())


def _ticket(token: str) -> str:
    """What the cookie holds: the token would do, but may have characters that a cookie cannot hold."""
    return hashlib.sha256(b"implicam page\0" + token.encode()).hexdigest()


def _call_soon(loop: asyncio.AbstractEventLoop, work: Callable[[], None]) -> None:
    with suppress(RuntimeError):  # the loop is closed: it has ended by itself
        loop.call_soon_threadsafe(work)


def _machine_names() -> set[str]:
    """Names that this machine goes by on its network, without asking anyone."""
    name = socket.gethostname().lower()
    short = name.partition(".")[0]
    return {name, short, f"{short}.local"}


def _shown(host: str) -> str:
    """The host of the address a person opens: localhost, or what others reach this machine by."""
    if host in WILDCARDS:
        return _own_address()
    return "localhost" if host == "127.0.0.1" else f"[{host}]" if ":" in host else host


def _own_address() -> str:
    """The address this machine sends from, else its name."""
    with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))  # RFC 5737: belongs to nobody; UDP sends nothing to connect
        return str(probe.getsockname()[0])
    return socket.gethostname()


def check_address(host: str, port: int) -> None:
    """Refuse an address on which no page can be opened, before anything is made for it.

    Args:
        host: What to listen on.
        port: 0 for any free one.

    Raises:
        ImplicamError: The port is taken, or the host is not this machine.

    >>> check_address("127.0.0.1", 0)
    """
    _listen(host, port).close()


def _listen(host: str, port: int) -> socket.socket:
    """A listening socket. ImplicamError where there cannot be one."""
    where = "127.0.0.1" if host == "localhost" else host
    try:
        if not 0 <= port <= 65535:
            raise OSError("Ports go from 0 to 65535.")
        if where == "::" and socket.has_dualstack_ipv6():
            return socket.create_server((where, port), family=socket.AF_INET6, dualstack_ipv6=True)
        family = socket.getaddrinfo(where or "0.0.0.0", port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((where, port), family=family, backlog=MAX_CLIENTS)
    except OSError as error:
        why, fix = _why_not(error, host)
        raise ImplicamError(
            f"The page cannot be opened on {host or 'all addresses'}, port {port}.",
            why=why,
            fix=fix,
        ) from error


def _why_not(error: OSError, host: str) -> tuple[str, str]:
    """Why an address cannot be listened on, and how to help."""
    if error.errno == errno.EADDRINUSE:
        return "the port is in use", "Close what uses it (perhaps another session), or choose another with --port."
    if isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
        return f"{host} is no address or name of this computer", (
            "Give one that it has, 0.0.0.0 for all of them, or leave --host out: then it opens on this computer only."
        )
    if error.errno == errno.EACCES:
        return "the system does not let you use this port", "Choose one from 1024 on with --port."
    return error.strerror or str(error), "Choose another port with --port, or another address with --host."
