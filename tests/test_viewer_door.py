"""The page of viser itself, through the door of test_viewer_front.py, in a real browser too."""

import asyncio
import socket

import pytest

from implicam.viewer.front import Front
from test_viewer_front import cookie_of, get

# viser itself


@pytest.fixture(scope="module")
def viser_page():
    viser = pytest.importorskip("viser")
    import rich

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rich, "print", lambda *_, **__: None)
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        server.gui.add_markdown("## Put the ball here")
        yield server
        server.stop()


def test_viser_talks_through_the_door(viser_page):
    viser = pytest.importorskip("viser")
    from websockets.asyncio.client import connect as dial
    from websockets.exceptions import InvalidStatus

    async def first_message(front: Front, origin: str, cookie: str = "") -> bytes:
        headers = {"Cookie": cookie} if cookie else {}
        protocol = f"viser-v{viser.__version__}"
        async with dial(
            f"ws://localhost:{front.port}/", origin=origin, subprotocols=[protocol], additional_headers=headers,
            compression=None, proxy=None, max_size=None,
        ) as line:  # fmt: skip
            return await asyncio.wait_for(line.recv(), 10)

    behind = ("127.0.0.1", viser_page.get_port())
    with Front(host="127.0.0.1", port=0, behind=behind, token="secret", files={}) as front:
        status, answer = get(front, "/?token=secret")
        cookie, ours = cookie_of(front, answer), f"http://localhost:{front.port}"
        status, answer = get(front, "/", f"Cookie: {cookie}\r\n")
        assert status == 200
        assert "<html" in answer
        assert len(asyncio.run(first_message(front, ours, cookie))) > 100
        for origin, sent, expected in [("http://evil.example", cookie, 403), (ours, "", 401)]:
            with pytest.raises(InvalidStatus) as refused:
                asyncio.run(first_message(front, origin, sent))
            assert refused.value.response.status_code == expected


@pytest.mark.slow
@pytest.mark.browser
def test_a_browser_shows_the_page_but_not_in_a_foreign_frame_nor_for_a_foreign_server(viser_page, chromium, tmp_path):
    sync_api = pytest.importorskip("playwright.sync_api")
    behind = ("127.0.0.1", viser_page.get_port())
    with (
        Front(host="127.0.0.1", port=0, behind=behind, token="a b;c", files={}) as front,
        socket.create_server(("127.0.0.1", 0)) as foreign,
        sync_api.sync_playwright() as play,
    ):
        browser = play.chromium.launch(**chromium)
        page = browser.new_page(viewport={"width": 320, "height": 240})  # drawn by the CPU: small is fast
        page.goto(f"http://localhost:{front.port}/")
        page.get_by_label("token").fill("a b;c")
        page.get_by_role("button", name="Open").click()
        page.get_by_text("Put the ball here").wait_for(timeout=120_000)
        assert page.url == f"http://localhost:{front.port}/"
        assert page.evaluate("document.cookie") == ""

        # viser's client connects to whatever its ?websocket= names; the policy on the page does not let it
        opening = """(address) => new Promise((done) => {
            document.addEventListener("securitypolicyviolation", (event) => done(event.effectiveDirective));
            new WebSocket(address);
            setTimeout(() => done("nobody stopped it"), 3000);
        })"""
        assert page.evaluate(opening, f"ws://localhost:{foreign.getsockname()[1]}") == "connect-src"
        foreign.settimeout(0.2)
        with pytest.raises(TimeoutError):
            foreign.accept()

        elsewhere = tmp_path / "elsewhere.html"
        elsewhere.write_text(f'<iframe src="http://localhost:{front.port}/"></iframe>')
        with (
            Front(host="127.0.0.1", port=0, behind=behind, token=None, files={"/": elsewhere}) as other,
            page.expect_console_message(lambda message: "frame-ancestors" in message.text, timeout=120_000),
        ):
            page.goto(other.url)
        browser.close()
