"""Examples in docstrings and Markdown write their files into a folder of their own; the browser of the page tests; how
much work tests take."""

import atexit
import os
import pickle
import shutil
import tempfile
from collections import Counter
from typing import Any

import hypothesis
import pytest

hypothesis.settings.register_profile("any machine", deadline=None)  # on a busy one an example may take a second
hypothesis.settings.load_profile("any machine")

os.environ["XDG_STATE_HOME"] = tempfile.mkdtemp(prefix="implicam-state-")  # what was trusted; not the user's
atexit.register(shutil.rmtree, os.environ["XDG_STATE_HOME"], ignore_errors=True)

CPU_SECONDS_OF_A_TEST = 20.0
CPU_SECONDS_OF_A_FILE = 40.0
"""Work of one test and of one file that are not slow, child processes with it. What takes more is named at the end of
a run; it fails nothing, because another processor takes twice as long for the same work."""

_CPU_SECONDS = "cpu_seconds"


def cpu_seconds() -> float:
    """User and system time of this process and of the children that have ended."""
    return sum(os.times()[:4])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    item.stash[_started] = cpu_seconds()
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    if call.when == "teardown":  # the fixtures that a file's first test makes are work of that file, too
        item.user_properties.append((_CPU_SECONDS, cpu_seconds() - item.stash[_started]))
    return (yield)


_started = pytest.StashKey[float]()


def pytest_terminal_summary(terminalreporter):
    """Name the tests and files that take more work than they should."""
    tests, files = Counter[str](), Counter[str]()
    for reports in terminalreporter.stats.values():
        for report in reports:
            if getattr(report, "when", "") == "teardown" and "slow" not in report.keywords:
                taken = dict(report.user_properties)[_CPU_SECONDS]
                tests[report.nodeid] += taken
                files[report.nodeid.partition("::")[0]] += taken
    heavy = [(name, taken) for name, taken in files.most_common() if taken > CPU_SECONDS_OF_A_FILE]
    heavy += [(name, taken) for name, taken in tests.most_common() if taken > CPU_SECONDS_OF_A_TEST]
    if heavy:
        terminalreporter.section(
            f"more than {CPU_SECONDS_OF_A_FILE:.0f} CPU s a file or {CPU_SECONDS_OF_A_TEST:.0f} a test"
        )
        for name, taken in heavy:
            terminalreporter.write_line(f"{taken:6.0f} s  {name}")
        terminalreporter.write_line(f"{files.total():6.0f} s  all")


@pytest.fixture(autouse=True)
def _examples_write_elsewhere(request, tmp_path, monkeypatch):
    if isinstance(request.node, pytest.DoctestItem):
        monkeypatch.chdir(tmp_path)


@pytest.fixture
def looks_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """A simulated camera that takes photographs is made once in a process: its lines of sight and its background take
    a third of a second, and every session begins with them."""
    from implicam.simulate import photographs

    make = photographs._Look

    def look(camera: Any, optics: Any, rng: Any) -> Any:
        key = pickle.dumps((camera, optics, rng.bit_generator.state))
        if key not in _looks:
            while len(_looks) >= MOST_LOOKS:
                del _looks[next(iter(_looks))]
            _looks[key] = make(camera, optics, rng)
        return _looks[key]

    monkeypatch.setattr(photographs, "_Look", look)


MOST_LOOKS = 8  # 25 MB each
_looks: dict[bytes, Any] = {}


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
