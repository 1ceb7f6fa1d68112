"""What the pages of our own share: an application behind the door, and what goes between it and a browser.

The application listens on a port of this machine that nobody is told, and answers only requests with an Origin that
nobody can guess, since any web page can try the ports of this machine. `front.py` is the door: it asks for a token.
"""

from __future__ import annotations

import json
import secrets
import socket
import threading
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from implicam.errors import ImplicamError, UsageError, import_extra
from implicam.images import Grey, brighten, eight_bit, opencv
from implicam.viewer.front import Front

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response

JPEG_QUALITY = 92

SCENE_FILES = {
    "/scene3d.js": "scene3d.js",
    "/three.module.min.js": "three/three.module.min.js",
    "/three.core.min.js": "three/three.core.min.js",
    "/OrbitControls.js": "three/OrbitControls.js",
}
"""What pages with a scene in three dimensions need besides their own files."""

Endpoint = Callable[["Request"], Awaitable["Response"]]


def answer(origin: str, work: Callable[[dict[str, Any]], Any]) -> Endpoint:
    """An endpoint that calls `work` in a thread, for those who come by the door.

    Args:
        origin: What the door says it is.
        work: Takes the query, or what was posted as JSON; gives what is sent as JSON, or a response as it is.
            ImplicamError becomes status 400, with `error`, `why` and `fix`.
    """
    from starlette.concurrency import run_in_threadpool
    from starlette.responses import JSONResponse, Response

    async def endpoint(request: Request) -> Response:
        if request.headers.get("origin") != origin:
            return Response("Come by the front door.", 403)
        try:
            given = table(await request.body()) if request.method == "POST" else dict(request.query_params)
            found = await run_in_threadpool(work, given)
        except ImplicamError as error:
            return JSONResponse({"error": error.what, "why": error.why, "fix": error.fix}, 400)
        return found if isinstance(found, Response) else JSONResponse(found)

    return endpoint


def table(body: bytes) -> dict[str, Any]:
    """What a page posted. UsageError where it is no table of JSON."""
    try:
        found = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise UsageError("the page sent something that is no JSON.", why=str(error), fix="reload it") from error
    if not isinstance(found, dict):
        raise UsageError("the page sent something else than a table.", fix="reload it")
    return found


def jpeg(picture: Grey, *, bright: bool = True, width: int | None = None) -> bytes:
    """A picture for a browser.

    Args:
        picture: (height, width).
        bright: Whether it is brightened.
        width: Pixels, at most; None for its own.
    """
    cv2 = opencv()
    grey = eight_bit(picture)
    if width is not None and grey.shape[1] > width:
        size = width, max(1, round(grey.shape[0] * width / grey.shape[1]))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    done, encoded = cv2.imencode(".jpg", brighten(grey) if bright else grey, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise ImplicamError("the picture cannot be shown.", fix="export it again as PNG")
    return bytes(encoded.tobytes())


@contextmanager
def behind_door(
    application: Callable[[str], Starlette],
    files: Mapping[str, str],
    own: Mapping[str, Path] = MappingProxyType({}),
    *,
    host: str = "127.0.0.1",
    port: int,
    token: str | None,
    command: str,
    extra: str,
    stake: str,
) -> Iterator[str]:
    """Serve an application on this machine while the block runs.

    Args:
        application: Makes it, given the Origin of those who come by the door.
        files: Path of the address -> file in `templates/`, served as it is.
        own: Path of the address -> any file, served as it is then.
        host: What to listen on.
        port: Where people find it; 0 for any free one.
        token: What opens it; None for a new one.
        command: What printed the address, as `implicam label`.
        extra: What brings the server where it is not installed.
        stake: What a stranger could do, in words.

    Yields:
        The address with the token.

    Raises:
        MissingExtraError: The web server is not installed.
        ImplicamError: The port is taken, or the host is not this machine.
    """
    uvicorn = import_extra("uvicorn", extra, f"the page of {command}")
    import_extra("starlette", extra, f"the page of {command}")
    origin = f"http://{secrets.token_hex(16)}.invalid"
    inner = socket.create_server(("127.0.0.1", 0))
    options = {"log_config": None, "access_log": False, "lifespan": "off", "timeout_graceful_shutdown": 2}
    server = uvicorn.Server(uvicorn.Config(application(origin), **options))
    name = command.replace(" ", "-")
    thread = threading.Thread(target=server.run, kwargs={"sockets": [inner]}, name=name, daemon=True)
    with resources.as_file(resources.files("implicam.viewer") / "templates") as folder:
        front = Front(
            host=host,
            port=port,
            behind=inner.getsockname(),
            token=secrets.token_urlsafe(16) if token is None else token,
            files={**{path: folder / file for path, file in files.items()}, **own},
            origin=origin,
            command=command,
            stake=stake,
        )
        with inner, front:
            thread.start()
            try:
                yield front.url
            finally:
                server.should_exit = True
                thread.join(timeout=5)
