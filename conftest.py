"""Examples in docstrings and Markdown write their files into a folder of their own; the browser of the page tests; how
long a test may take."""

import os
import shutil
from typing import Any

import pytest

MOST_CPU_SECONDS = 40.0
"""Work of one test that is not slow, its child processes with it: twice what the longest takes. It is there to find
what hangs or has become quadratic; so it counts work, not time, and a machine that is busy does not fail it."""


def cpu_seconds() -> float:
    """User and system time of this process and of the children that have ended."""
    return sum(os.times()[:4])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    before = cpu_seconds()
    result = yield
    taken = cpu_seconds() - before
    if taken > MOST_CPU_SECONDS and not any(item.get_closest_marker(name) for name in ("slow", "browser")):
        pytest.fail(
            f"{taken:.0f} CPU s, and at most {MOST_CPU_SECONDS:.0f} are allowed: make it cheaper, or mark it slow"
        )
    return result


@pytest.fixture(autouse=True)
def _examples_write_elsewhere(request, tmp_path, monkeypatch):
    if isinstance(request.node, pytest.DoctestItem):
        monkeypatch.chdir(tmp_path)


@pytest.fixture
def chromium() -> dict[str, Any]:
    """How Playwright is to launch the browser that is there; skips where there is none, unless one is required."""
    found = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if not found:
        if os.environ.get("IMPLICAM_REQUIRE_BROWSER") == "1":
            pytest.fail("IMPLICAM_REQUIRE_BROWSER=1, but there is no chromium on the path")
        pytest.skip("no chromium on the path")
    flags = [
        "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
        "--disable-component-update", "--disable-sync", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    ]  # fmt: skip
    return {"executable_path": found, "args": flags}
