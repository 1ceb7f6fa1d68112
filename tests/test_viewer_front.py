"""The front door: raw sockets on one side, a stand-in on the other.

The stand-in behind the door answers every head with 200 and a body that quotes what it was sent, keeps reading further
requests on the same connection (so that one smuggled past the door would show), and echoes bytes after a WebSocket
handshake. A page of ours is behind the door in test_viewer_door.py, with a browser as judge.
"""

import contextlib
import gc
import re
import socket
import struct
import threading
import time
from collections.abc import Iterator
from itertools import takewhile
from urllib.parse import parse_qs, quote, urlsplit

import pytest

from implicam.errors import ImplicamError, UsageError
from implicam.viewer import front as door
from implicam.viewer.front import Front, needs_token

TOKEN = "a token; with, strange&signs=1"
UPGRADE = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: x\r\n"


class StandIn:
    """What stands behind the door; `heads`, `bodies` are what it was sent, `ended` counts connections that closed."""

    def __init__(self) -> None:
        self.heads: list[str] = []
        self.bodies: list[bytes] = []
        self.ended = threading.Semaphore(0)
        self.first_line = "HTTP/1.1 200 OK"
        self.switches = True  # says yes to WebSockets
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.address = self._listening.getsockname()
        self._threads = [threading.Thread(target=self._accept)]
        self._threads[0].start()

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()
        for thread in self._threads:
            thread.join(5)
            assert not thread.is_alive(), "the door keeps a connection to the page open"

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                line, _ = self._listening.accept()
                self._threads.append(threading.Thread(target=self._talk, args=(line,)))
                self._threads[-1].start()

    def _talk(self, line: socket.socket) -> None:
        with line, line.makefile("rb") as lines, contextlib.suppress(OSError):
            while head := b"".join(takewhile(lambda text: text.strip(), iter(lines.readline, b""))):
                self._one(line, lines, head.decode("latin-1"))
        self.ended.release()

    def _one(self, line: socket.socket, lines, head: str) -> None:
        self.heads.append(head)
        upgrade = re.search(r"(?im)^upgrade: *websocket", head) is not None
        length = re.search(r"(?im)^content-length: *(\d+)", head)
        self.bodies.append(lines.read(int(length[1])) if length else b"")
        if upgrade and self.switches:
            line.sendall(b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\n\r\n")
            while data := lines.read1(65536):
                line.sendall(data)
            line.shutdown(socket.SHUT_WR)
            return
        text = f"{self.first_line}\r\nContent-Type: text/plain\r\n\r\nquoted {head}"
        line.sendall(text.encode("latin-1"))
        if "connection: close" in head.lower():
            line.shutdown(socket.SHUT_WR)


@pytest.fixture
def behind() -> Iterator[StandIn]:
    page = StandIn()
    yield page
    page.close()


@contextlib.contextmanager
def opened(behind: StandIn, **options) -> Iterator[Front]:
    choices = {"host": "127.0.0.1", "port": 0, "token": None, "files": {}} | options
    with Front(behind=behind.address, **choices) as front:
        yield front


@pytest.fixture
def front(behind: StandIn) -> Iterator[Front]:
    with opened(behind) as it:
        yield it


@pytest.fixture
def locked(behind: StandIn) -> Iterator[Front]:
    with opened(behind, token=TOKEN) as it:
        yield it


def connect(front: Front) -> socket.socket:
    return socket.create_connection(("127.0.0.1", front.port), timeout=5)


def hear(line: socket.socket) -> bytes:
    """All until the other side hangs up."""
    return b"".join(iter(lambda: line.recv(65536), b""))


def send(front: Front, raw: bytes) -> tuple[int, str]:
    """Status and whole answer to raw bytes; -1 where there is none."""
    with connect(front) as line:
        line.sendall(raw)
        answer = hear(line).decode("latin-1")
    return int(answer.split()[1]) if answer else -1, answer


def get(front: Front, target: str = "/", headers: str = "", *, host: str | None = None, method: str = "GET"):
    host = f"localhost:{front.port}" if host is None else host
    return send(front, f"{method} {target} HTTP/1.1\r\nHost: {host}\r\n{headers}\r\n".encode("latin-1"))


def header(answer: str, name: str) -> list[str]:
    head = answer.partition("\r\n\r\n")[0]
    return re.findall(rf"(?im)^{name}: *(.*?)\r?$", head)


def cookie_of(front: Front, answer: str) -> str:
    (line,) = header(answer, "set-cookie")
    return line.partition(";")[0]


# what passes


def test_a_plain_request_reaches_the_page_and_its_answer_comes_back(front, behind):
    status, answer = get(front, "/a/b?c=d%20e", "Accept: x\r\nCookie: other=1\r\n")
    assert status == 200
    assert "quoted GET /a/b?c=d%20e HTTP/1.1" in answer
    assert "accept: x" in behind.heads[0].lower()
    assert "cookie: other=1" in behind.heads[0].lower()
    assert "connection: close" in behind.heads[0].lower()
    assert header(answer, "x-content-type-options") == ["nosniff"]


@pytest.mark.parametrize("host", ["localhost", "LOCALHOST:1", "127.0.0.1", "127.1.2.3:80", "[::1]:8090"])
def test_names_of_this_machine_pass_with_any_port(front, host):
    assert get(front, host=host)[0] == 200  # a tunnel or a container may have another port


def test_a_body_is_passed_on_and_no_more_than_the_body(front, behind):
    request = b"POST /up HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5\r\n\r\nhello"
    assert send(front, request + b"GET /smuggled HTTP/1.1\r\n\r\n")[0] == 200
    assert behind.bodies == [b"hello"]
    assert len(behind.heads) == 1


def test_a_large_body_in_pieces(front, behind):
    body = bytes(range(256)) * 4000
    with connect(front) as line:
        line.sendall(f"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: {len(body)}\r\n\r\n".encode())
        for start in range(0, len(body), 100_001):
            line.sendall(body[start : start + 100_001])
        assert hear(line).startswith(b"HTTP/1.1 200")
    assert behind.bodies == [body]


def test_a_second_request_behind_the_first_is_not_answered(front, behind):
    one = f"GET /first HTTP/1.1\r\nHost: localhost:{front.port}\r\n\r\n"
    two = "GET /second HTTP/1.1\r\nHost: evil.example\r\n\r\n"
    status, answer = send(front, (one + two).encode())
    assert status == 200
    assert answer.count("HTTP/1.1 200") == 1
    assert ["first" in head for head in behind.heads] == [True]
    assert "close" in header(answer, "connection")


def test_a_head_that_comes_byte_by_byte(front):
    with connect(front) as line:
        for byte in f"GET /slow HTTP/1.1\r\nHost: localhost:{front.port}\r\n\r\n".encode():
            line.sendall(bytes([byte]))
        assert b"quoted GET /slow" in hear(line)


# WebSockets


def websocket(front: Front, headers: str, *, host: str | None = None) -> tuple[int, str]:
    host = f"localhost:{front.port}" if host is None else host
    return send(front, f"GET / HTTP/1.1\r\nHost: {host}\r\n{UPGRADE}{headers}\r\n".encode())


def test_a_websocket_carries_raw_bytes_both_ways_and_ends_on_both_sides(front, behind):
    payload = bytes(range(256)) * 8000  # 2 MB, more than all buffers between
    with connect(front) as line:
        origin = f"http://localhost:{front.port}"
        head = f"GET / HTTP/1.1\r\nHost: localhost:{front.port}\r\nOrigin: {origin}\r\n{UPGRADE}\r\n"
        line.sendall(head.encode() + b"early")  # bytes that follow the head at once belong to the WebSocket

        def talk() -> None:
            line.sendall(payload)
            line.shutdown(socket.SHUT_WR)

        speaker = threading.Thread(target=talk)
        speaker.start()
        heard = hear(line)
        speaker.join()
    first, _, echo = heard.partition(b"\r\n\r\n")
    assert first.startswith(b"HTTP/1.1 101")
    assert echo == b"early" + payload
    assert behind.ended.acquire(timeout=60)


def test_a_websocket_that_the_page_refuses_passes_nothing_more(front, behind):
    behind.switches, behind.first_line = False, "HTTP/1.1 400 Bad Request"
    head = f"GET / HTTP/1.1\r\nHost: localhost:{front.port}\r\nOrigin: http://localhost:{front.port}\r\n{UPGRADE}\r\n"
    smuggled = "GET /smuggled HTTP/1.1\r\nHost: evil.example\r\nConnection: close\r\n\r\n"
    with connect(front) as line:
        line.sendall((head + smuggled).encode())
        time.sleep(0.2)  # as long as it would take the second one to arrive
    assert len(behind.heads) == 1


def test_a_websocket_ends_for_the_page_when_the_browser_is_gone(front, behind):
    line = connect(front)
    line.sendall(f"GET / HTTP/1.1\r\nHost: localhost\r\nOrigin: http://localhost\r\n{UPGRADE}\r\n".encode())
    assert line.recv(100).startswith(b"HTTP/1.1 101")
    line.close()
    assert behind.ended.acquire(timeout=60)


@pytest.mark.parametrize(
    "origin",
    [
        "",  # no browser leaves it out
        "Origin: http://evil.example\r\n",
        "Origin: null\r\n",
        "Origin: http://localhost:1\r\n",
        "Origin: http://localhost:{port}.evil.example\r\n",
        "Origin: http://evil.example/http://localhost:{port}\r\n",
        "Origin: file://localhost:{port}\r\n",
        "Origin: http://localhost:{port}/\r\n",
        "Origin: http://127.0.0.1:{port}\r\n",  # this machine, but not the Host: another server's page on it
        "Origin: http://localhost:{port}\r\nOrigin: http://evil.example\r\n",
        "Origin:\r\n",
    ],
)
def test_a_websocket_from_elsewhere_is_refused(front, behind, origin):
    status, answer = websocket(front, origin.format(port=front.port))
    assert status == 403
    assert "Another web page asked for this" in answer
    assert behind.heads == []


@pytest.mark.parametrize("upgrade", ["WebSocket", "h2c, websocket", "websocket/13", " websocket "])
def test_every_spelling_of_a_websocket_is_checked(front, behind, upgrade):
    assert get(front, "/", f"Upgrade: {upgrade}\r\nConnection: upgrade\r\n")[0] == 403
    assert behind.heads == []


def test_other_upgrades_are_not_passed_on(front, behind):
    assert get(front, "/", "Upgrade: h2c\r\nConnection: Upgrade, HTTP2-Settings\r\n")[0] == 200
    assert "upgrade" not in behind.heads[0].lower()


def test_a_plain_request_of_another_page_is_refused(front, behind):
    assert get(front, "/", "Origin: http://evil.example\r\n")[0] == 403
    assert get(front, "/", f"Origin: http://localhost:{front.port}\r\n")[0] == 200
    assert len(behind.heads) == 1


def test_the_page_behind_can_ask_for_an_origin_that_only_the_door_knows(behind):
    with opened(behind, origin="http://secret.invalid") as front:
        websocket_head = f"Origin: http://localhost:{front.port}\r\n"
        with connect(front) as line:
            line.sendall(f"GET / HTTP/1.1\r\nHost: localhost:{front.port}\r\n{UPGRADE}{websocket_head}\r\n".encode())
            assert line.recv(100).startswith(b"HTTP/1.1 101")
    assert re.findall(r"(?im)^origin: *(.*?)\r?$", behind.heads[0]) == ["http://secret.invalid"]


# Hosts


@pytest.mark.parametrize(
    "host",
    ["evil.example", "localhost.evil.example", "127.0.0.1.evil.example", "127.0.0.1.", "10.0.0.1", "0.0.0.0",
     "2130706433", "[::2]", "localhost.", "0x7f.1"],
)  # fmt: skip
def test_names_that_are_not_ours_are_refused(front, behind, host):
    status, answer = get(front, host=f"{host}:{front.port}")
    assert status == 403
    assert "does not belong to the page" in answer
    assert behind.heads == []


@pytest.mark.parametrize(
    "host",
    [
        "",
        "user@localhost",
        "localhost:80:80",
        "localhost:x",
        "localhost/evil",
        "localhost, evil",
        "[::1",
        "[localhost]",
    ],
)
def test_a_host_that_is_none_is_malformed(front, behind, host):
    assert get(front, host=host)[0] == 400
    assert behind.heads == []


def test_one_host_not_two_and_not_none(front, behind):
    assert get(front, "/", "Host: localhost\r\n")[0] == 400
    assert get(front, "/", "host: evil.example\r\n")[0] == 400
    assert send(front, b"GET / HTTP/1.1\r\n\r\n")[0] == 400
    assert behind.heads == []


def test_on_all_addresses_any_address_and_the_machine_name_pass_but_no_other_name(behind):
    with opened(behind, host="0.0.0.0", token=TOKEN) as front:
        name = socket.gethostname()
        for host in ("192.0.2.7", "[2001:db8::1]:80", name, f"{name.partition('.')[0]}.local", "localhost"):
            assert get(front, host=host)[0] == 401, host
        for host in ("evil.example", f"{name}.evil.example", "192.0.2.7.evil.example"):
            assert get(front, host=host)[0] == 403, host
    assert behind.heads == []


def test_on_one_address_only_that_address_passes(behind):
    front = Front(host="192.0.2.7", port=0, behind=behind.address, token=None, files={})
    assert [front._is_ours(name) for name in ("192.0.2.7", "127.0.0.1", "192.0.2.8", "rig")] == [
        True,
        True,
        False,
        False,
    ]
    front = Front(host="Rig.Lab", port=0, behind=behind.address, token=None, files={})
    assert [front._is_ours(name) for name in ("rig.lab", "rig", "192.0.2.8")] == [True, False, False]


@pytest.mark.parametrize(
    ("host", "needed"),
    [("localhost", False), ("LOCALHOST", False), ("127.0.0.1", False), ("127.9.9.9", False), ("::1", False),
     ("[::1]", False),
     ("0.0.0.0", True), ("::", True), ("", True), ("192.168.1.2", True), ("rig", True), ("localhost.evil", True),
     ("128.0.0.1", True), ("::ffff:10.0.0.1", True)],
)  # fmt: skip
def test_who_needs_a_token(host, needed):
    assert needs_token(host) is needed


# the token


def test_the_address_opens_the_page_and_leaves_the_token_behind(locked, behind):
    query = urlsplit(locked.url).query
    assert parse_qs(query) == {"token": [TOKEN]}
    status, answer = get(locked, f"/some/where?a=1&{query}&b=%26")
    assert status == 303
    assert header(answer, "location") == ["/some/where?a=1&b=%26"]
    (setting,) = header(answer, "set-cookie")
    name, _, attributes = setting.partition(";")
    assert {part.strip() for part in attributes.split(";")} == {"HttpOnly", "SameSite=Strict", "Path=/"}
    assert str(locked.port) in name.partition("=")[0]
    assert behind.heads == []
    assert get(locked, "/", f"Cookie: other=1; {name}; more=2\r\n")[0] == 200
    assert "cookie: other=1; more=2" in behind.heads[0].lower()
    assert name.partition("=")[2] not in behind.heads[0]


def test_the_cookie_alone_is_not_passed_on_at_all(locked, behind):
    cookie = cookie_of(locked, get(locked, f"/?{urlsplit(locked.url).query}")[1])
    assert get(locked, "/", f"Cookie: {cookie}\r\n")[0] == 200
    assert "cookie" not in behind.heads[0].lower()


def test_a_websocket_needs_the_cookie_too(locked, behind):
    origin = f"Origin: http://localhost:{locked.port}\r\n"
    assert websocket(locked, origin)[0] == 401
    cookie = cookie_of(locked, get(locked, f"/?{urlsplit(locked.url).query}")[1])
    with connect(locked) as line:
        line.sendall(
            f"GET / HTTP/1.1\r\nHost: localhost:{locked.port}\r\n{UPGRADE}{origin}Cookie: {cookie}\r\n\r\n".encode()
        )
        assert line.recv(100).startswith(b"HTTP/1.1 101")
    assert len(behind.heads) == 1


def test_the_token_may_be_percent_encoded_as_a_form_does(behind):
    with opened(behind, token="abc def") as front:
        for written in ("abc+def", "abc%20def", "%61bc%20def"):
            assert get(front, f"/?token={written}")[0] == 303
        assert get(front, "/?%74oken=abc+def") == get(front, "/?token=abc+def")


@pytest.mark.parametrize("method", ["GET", "HEAD", "POST"])
def test_no_token_gets_the_page_that_asks(locked, behind, method):
    status, answer = get(locked, "/report.html?x=1", method=method)
    assert status == 401
    assert ("<form" in answer) == (method != "HEAD")
    assert "<script" not in answer
    assert header(answer, "content-type") == ["text/html; charset=utf-8"]
    assert behind.heads == []


@pytest.mark.parametrize("wrong", ["", "x", "a+token", "%00", "%ff%fe", "%ED%A0%80", "[x]", "x" * 9000])
def test_a_wrong_token_gets_the_page_that_asks_after_a_while(locked, behind, monkeypatch, wrong):
    waited = []

    async def sleep(seconds: float) -> None:
        waited.append(seconds)

    monkeypatch.setattr(door.asyncio, "sleep", sleep)
    assert get(locked, f"/?token={wrong}")[0] == 401
    assert waited == [0.5]
    assert behind.heads == []


def test_a_wrong_cookie_does_not_open(locked, behind):
    name = cookie_of(locked, get(locked, f"/?{urlsplit(locked.url).query}")[1]).partition("=")[0]
    for value in ("", "x", "\xff", TOKEN.replace(";", "")):
        assert get(locked, "/", f"Cookie: {name}={value}\r\n")[0] == 401
    assert behind.heads == []


def test_the_cookie_of_another_port_or_another_token_does_not_open(locked, behind):
    cookie = cookie_of(locked, get(locked, f"/?{urlsplit(locked.url).query}")[1])
    with opened(behind, token="another") as other:
        assert get(other, "/", f"Cookie: {cookie}\r\n")[0] == 401
        value = cookie.partition("=")[2]
        assert get(other, "/", f"Cookie: {other.cookie}={value}\r\n")[0] == 401


@pytest.mark.parametrize("path", ["//evil.example/", "///evil.example", "/%5cevil.example", "/%0d%0aSet-Cookie:x"])
def test_the_redirect_stays_here(locked, path):
    status, answer = get(locked, f"{path}?{urlsplit(locked.url).query}")
    (location,) = header(answer, "location")
    assert status == 303
    assert urlsplit(location).netloc == ""
    assert not location.startswith("//")
    assert len(header(answer, "set-cookie")) == 1


def test_a_token_is_made_where_others_can_reach_us_and_none_here(behind):
    tokens = set()
    for _ in range(3):
        front = Front(host="0.0.0.0", port=8090, behind=behind.address, token=None, files={})
        tokens |= set(parse_qs(urlsplit(front.url).query)["token"])
    assert len(tokens) == 3
    assert min(len(token) for token in tokens) >= 22  # 128 bits
    here = Front(host="127.0.0.1", port=8090, behind=behind.address, token=None, files={})
    assert here.url == "http://localhost:8090/"
    with pytest.raises(UsageError, match="empty"):
        Front(host="0.0.0.0", port=8090, behind=behind.address, token="", files={})


def test_addresses_that_are_shown(behind):
    def url(host: str) -> str:
        return Front(host=host, port=8090, behind=behind.address, token="t", files={}).url

    assert url("localhost") == url("127.0.0.1") == "http://localhost:8090/?token=t"
    assert url("::1") == "http://[::1]:8090/?token=t"
    assert url("192.0.2.7") == "http://192.0.2.7:8090/?token=t"
    assert "0.0.0.0" not in url("0.0.0.0")


# hostile input


@pytest.mark.parametrize(
    "raw",
    [
        b"\r\n\r\n",
        b"GET\r\n\r\n",
        b"GET /\r\n\r\n",
        b"GET / HTTP/2.0\r\nHost: localhost\r\n\r\n",
        b"G@T / HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET  / HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET http://localhost/ HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"CONNECT localhost:22 HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"OPTIONS * HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET /\\evil.example HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET /\x00 HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET /\xff HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: local\x00host\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\nX: y\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\rX: y\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost : localhost\r\n\r\n",
        b"GET / HTTP/1.1\r\n Host: localhost\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nX: a\r\n folded\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nno colon\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: -1\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: +1\r\n\r\na",
        b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1\r\nContent-Length: 2\r\n\r\nab",
        b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1, 1\r\n\r\na",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n",  # somebody tries https
        b"\x00" * 64 + b"\r\n\r\n",
    ],
)
def test_what_is_not_http_is_malformed(front, behind, raw):
    status, answer = send(front, raw)
    assert status == 400
    assert answer.rstrip().endswith(".")  # a sentence
    assert behind.heads == []


def test_a_chunked_body_is_refused(front, behind):
    raw = b"POST / HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\nContent-Length: 3\r\n\r\n0\r\n\r\n"
    assert send(front, raw)[0] == 411
    assert behind.heads == []


def test_a_websocket_with_a_body_or_another_method_is_refused(front, behind):
    origin = f"Origin: http://localhost:{front.port}\r\n"
    assert websocket(front, origin + "Content-Length: 3\r\n")[0] == 400
    assert get(front, "/", UPGRADE + origin, method="POST")[0] == 400
    assert behind.heads == []


def test_a_head_may_be_large_but_not_huge(front, behind):
    assert get(front, "/", f"X: {'a' * 15_000}\r\n")[0] == 200
    for size in (17_000, 60_000, 3_000_000):
        assert get(front, "/", f"X: {'a' * size}\r\n")[0] == 431
    assert len(behind.heads) == 1


def test_a_slow_head_is_hung_up_on_and_does_not_hold_up_others(front, behind, monkeypatch):
    monkeypatch.setattr(door, "PATIENCE_SECONDS", 0.5)
    with contextlib.ExitStack() as stack:
        stalled = [stack.enter_context(connect(front)) for _ in range(60)]
        for line in stalled[:30]:
            line.sendall(b"GET / HTTP/1.1\r\nHost: loc")
        assert get(front)[0] == 200
        assert {hear(line).split()[1] for line in stalled} == {b"408"}
    assert len(behind.heads) == 1


def test_a_client_that_hangs_up_in_the_head_is_forgotten(front, behind):
    with connect(front) as line:
        line.sendall(b"GET / HTT")
    assert get(front)[0] == 200
    assert len(behind.heads) == 1


def test_clients_that_reset_the_connection_leave_no_trace(front, caplog):
    for start in (b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n", b"x\r\n\r\n") * 10:
        with connect(front) as line:
            line.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # close() sends RST
            line.sendall(start)
    assert get(front)[0] == 200
    front.close()
    gc.collect()  # where asyncio would log an exception that nobody took
    assert caplog.records == []


def test_a_body_that_does_not_come_ends_in_time(front, monkeypatch):
    monkeypatch.setattr(door, "PATIENCE_SECONDS", 0.3)
    monkeypatch.setattr(door, "ANSWER_SECONDS", 0.3)
    assert send(front, b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 10\r\n\r\nabc")[0] == 502


@pytest.mark.parametrize("begun", [b"", b"GET / HTTP/1.1\r\nHost: loc"])
def test_a_flood_of_connections_that_say_nothing_keeps_nobody_out(locked, begun):
    """130 of them locked everybody out."""
    _, answer = get(locked, f"/?token={quote(TOKEN)}")
    cookie = f"Cookie: {cookie_of(locked, answer)}\r\n"
    with contextlib.ExitStack() as stack:
        for _ in range(300):
            line = stack.enter_context(connect(locked))
            with contextlib.suppress(OSError):
                line.sendall(begun)
        for _ in range(5):
            before = time.monotonic()
            assert get(locked, "/", cookie)[0] == 200
            assert time.monotonic() - before < 5


def test_too_many_at_once_are_told_so(front, behind, monkeypatch):
    monkeypatch.setattr(door, "MAX_CLIENTS", 3)
    monkeypatch.setattr(door, "ANSWER_SECONDS", 0.3)  # those that hang up leave at once
    begun = b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n\r\n"
    with contextlib.ExitStack() as stack:
        for _ in range(3):
            stack.enter_context(connect(front)).sendall(begun)
        deadline = time.monotonic() + 60
        while get(front)[0] != 503:
            assert time.monotonic() < deadline
    deadline = time.monotonic() + 60
    while get(front)[0] == 503:
        assert time.monotonic() < deadline


def test_many_at_once(front):
    answers = []
    threads = [threading.Thread(target=lambda: answers.append(get(front)[0])) for _ in range(40)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert answers == [200] * 40


def test_every_answer_keeps_frames_and_foreign_connections_out(front, behind, tmp_path):
    answers = [get(front)[1], get(front, host="evil.example")[1], send(front, b"x\r\n\r\n")[1]]
    for answer in answers:
        (policy,) = header(answer, "content-security-policy")
        assert "frame-ancestors 'self'" in policy
        assert "evil" not in policy
        assert "*" not in policy
    assert f"ws://localhost:{front.port} " in header(answers[0], "content-security-policy")[0]


def test_nothing_is_printed_or_logged(locked, capfd, caplog):
    with caplog.at_level("WARNING"):  # asyncio says at DEBUG which selector it uses
        get(locked, f"/?{urlsplit(locked.url).query}")
        get(locked, "/?token=wrong-one")
        send(locked, b"\x00\r\n\r\n")
    assert capfd.readouterr() == ("", "")
    assert caplog.records == []


# files


def test_files_of_the_session_are_served_behind_the_same_checks(behind, tmp_path):
    report, calibration = tmp_path / "report.html", tmp_path / "cal.implicam"
    with opened(behind, token=TOKEN, files={"/report.html": report, "/calibration.implicam": calibration}) as front:
        cookie = cookie_of(front, get(front, f"/?{urlsplit(front.url).query}")[1])
        allowed = f"Cookie: {cookie}\r\n"
        status, answer = get(front, "/report.html", allowed)
        assert status == 404
        assert "not there yet" in answer
        report.write_text("<p>0.21 mm</p>" * 100_000)
        calibration.write_bytes(bytes(range(256)))
        for target in ("/report.html", "/report.html?x=1", "/%72eport.html", "//report.html"):
            status, answer = get(front, target, allowed)
            assert status == 200
            assert answer.partition("\r\n\r\n")[2] == report.read_text()
            assert header(answer, "content-type") == ["text/html; charset=utf-8"]
            assert header(answer, "cache-control") == ["no-store"]
        status, answer = get(front, "/calibration.implicam", allowed)
        assert (status, header(answer, "content-type")) == (200, ["application/octet-stream"])
        assert answer.partition("\r\n\r\n")[2].encode("latin-1") == calibration.read_bytes()
        status, answer = get(front, "/report.html", allowed, method="HEAD")
        assert (status, answer.partition("\r\n\r\n")[2]) == (200, "")
        assert header(answer, "content-length") == [str(report.stat().st_size)]
        assert get(front, "/report.html", allowed, method="POST")[0] == 405
        assert get(front, "/report.html")[0] == 401
        assert get(front, "/report.html", allowed, host="evil.example")[0] == 403
        assert get(front, "/report.html", allowed + "Origin: http://evil.example\r\n")[0] == 403
    assert behind.heads == []


def test_a_file_that_cannot_be_read_is_not_there(behind, tmp_path):
    with opened(behind, files={"/report.html": tmp_path}) as front:
        assert get(front, "/report.html")[0] == 404
        assert get(front, "/report.html/..%2f..%2fetc/passwd")[0] == 200  # no file of ours: the page's own business
    assert "etc/passwd" in behind.heads[0]


# life


def test_a_page_that_is_not_there_or_says_nothing(behind):
    with socket.create_server(("127.0.0.1", 0)) as unused:
        address = unused.getsockname()
    with Front(host="127.0.0.1", port=0, behind=address, token=None, files={}) as front:
        status, answer = get(front)
        assert status == 502
        assert "does not answer" in answer
    behind.first_line = "220 mail.example"  # a line, but none of HTTP
    with opened(behind) as front:
        assert get(front)[0] == 502


def test_a_port_in_use_is_said_and_how_to_help(front, behind):
    other = Front(host="127.0.0.1", port=front.port, behind=behind.address, token=None, files={})
    with pytest.raises(ImplicamError, match=f"port {front.port}") as caught:
        other.start()
    assert "in use" in caught.value.why
    assert "Errno" not in caught.value.why
    assert "--port" in caught.value.fix
    other.close()


@pytest.mark.parametrize(("host", "port"), [("192.0.2.7", 0), ("no-such-name.invalid", 0), ("127.0.0.1", 99_999)])
def test_an_address_that_is_not_this_machine_is_said(behind, host, port):
    with pytest.raises(ImplicamError, match="cannot be opened") as caught:
        Front(host=host, port=port, behind=behind.address, token=None, files={}).start()
    if not port:
        assert caught.value.why == f"{host} is no address or name of this computer"
        assert "Close what" not in caught.value.fix


def test_close_hangs_up_frees_the_port_and_ends_the_thread(behind, caplog):
    before = set(threading.enumerate())
    front = Front(host="127.0.0.1", port=0, behind=behind.address, token=None, files={})
    front.close()  # before it has started: nothing to do
    front.start()
    port = front.port
    idle, half, socketed = connect(front), connect(front), connect(front)
    half.sendall(b"GET / HT")
    socketed.sendall(f"GET / HTTP/1.1\r\nHost: localhost\r\nOrigin: http://localhost\r\n{UPGRADE}\r\n".encode())
    assert socketed.recv(100).startswith(b"HTTP/1.1 101")
    front.close()
    front.close()
    for line in (idle, half, socketed):
        with line, contextlib.suppress(ConnectionResetError):
            assert hear(line) in (b"", b"Upgrade: websocket\r\n\r\n")
    assert behind.ended.acquire(timeout=60)
    assert caplog.records == []
    assert {thread.name for thread in set(threading.enumerate()) - before if "implicam" in thread.name} == set()
    with opened(behind, port=port) as again:
        assert again.port == port
        assert get(again)[0] == 200


def test_whoever_connects_while_it_closes_is_hung_up_on(behind):
    for count in range(30):
        front = Front(host="127.0.0.1", port=0, behind=behind.address, token=None, files={})
        front.start()
        with contextlib.ExitStack() as stack:
            lines = [stack.enter_context(connect(front)) for _ in range(count % 5)]
            front.close()
            for line in lines:
                with contextlib.suppress(ConnectionResetError):
                    assert line.recv(1) == b""
    gc.collect()  # a socket that was forgotten warns, and a warning is an error


def test_both_families_where_the_machine_has_them(behind):
    if not socket.has_dualstack_ipv6():
        pytest.skip("no IPv6 here")
    with opened(behind, host="::", token=TOKEN) as front:
        assert get(front)[0] == 401  # by 127.0.0.1
        with socket.create_connection(("::1", front.port), timeout=5) as line:
            line.sendall(b"GET / HTTP/1.1\r\nHost: [::1]\r\n\r\n")
            assert hear(line).startswith(b"HTTP/1.1 401")
