"""A page of ours through the door of test_viewer_front.py, in a real browser."""

import socket
import threading

import pytest

from implicam.viewer.front import Front


@pytest.fixture
def behind():
    """The address of a web application that shows a sentence."""
    uvicorn, applications = pytest.importorskip("uvicorn"), pytest.importorskip("starlette.applications")
    from starlette.responses import HTMLResponse
    from starlette.routing import Route

    async def page(request):
        return HTMLResponse("<h2>Put the ball here</h2>")

    inner = socket.create_server(("127.0.0.1", 0))
    application = applications.Starlette(routes=[Route("/", page)])
    server = uvicorn.Server(uvicorn.Config(application, log_config=None, lifespan="off"))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [inner]}, daemon=True)
    thread.start()
    yield inner.getsockname()
    server.should_exit = True
    thread.join(10)
    inner.close()


@pytest.mark.slow
@pytest.mark.browser
def test_a_browser_shows_the_page_but_not_in_a_foreign_frame_nor_for_a_foreign_server(behind, chromium, tmp_path):
    sync_api = pytest.importorskip("playwright.sync_api")
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

        # whatever a page is talked into connecting to, the policy on it does not let it
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
