"""Examples in docstrings and Markdown write their files into a folder of their own; the browser of the page tests."""

import os
import shutil
from typing import Any

import pytest


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
