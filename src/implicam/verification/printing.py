"""A page as PDF, by a browser without a window: what it prints follows the page's own print style sheet."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from implicam.errors import ImplicamError
from implicam.files import replacing

BROWSERS = (
    "chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "msedge", "microsoft-edge",
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "/Applications/Chromium.app/Contents/MacOS/Chromium",
)  # fmt: skip
TIMEOUT_SECONDS = 120


def find_browser() -> str | None:
    """The browser that prints; None where there is none that can."""
    return next((found for name in BROWSERS if (found := shutil.which(name))), None)


def print_page(page: Path, pdf: Path, browser: str) -> None:
    """Print a page to PDF.

    Args:
        page: The HTML file.
        pdf: The file to write, whole or not at all.
        browser: Of `find_browser`.

    Raises:
        ImplicamError: The browser does not print it.
    """
    with replacing(pdf) as temporary, tempfile.TemporaryDirectory() as profile:
        words = [
            browser, "--headless", "--disable-gpu", "--no-pdf-header-footer", f"--user-data-dir={profile}",
            f"--print-to-pdf={temporary.absolute()}",
        ]  # fmt: skip
        if hasattr(os, "geteuid") and os.geteuid() == 0:  # Chromium refuses its sandbox to root
            words.append("--no-sandbox")
        try:
            ran = subprocess.run(
                [*words, page.absolute().as_uri()], capture_output=True, timeout=TIMEOUT_SECONDS, check=False
            )
            why = ran.stderr.decode(errors="replace").strip().splitlines()[-1:] if ran.returncode else []
        except (OSError, subprocess.TimeoutExpired) as error:
            why = [str(error)]
        if why or not temporary.is_file() or not temporary.read_bytes().startswith(b"%PDF"):
            raise ImplicamError(
                f"{browser} did not print {page}.",
                why=" ".join(why),
                fix=f"open {page} in a browser and print it there",
            )
