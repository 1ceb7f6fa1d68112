"""How long a person waits at the page of `acquire`: from Go to found, from Accept to the next target; and its memory.

    python benchmarks/bench_page.py [--points 20] [--rig bar6] [--browsers 1]

Simulated cameras (bar6: six of 1280 x 800) that draw their pictures, a robot that takes no time. A client that reads
the stream of states stands for each browser, and fetches every picture that is shown, as a browser does. CPU is that of
the whole process meanwhile, live pictures and clients with it; drawn: the part of it that real cameras would not take.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import resource
import statistics
import tempfile
import threading
import time
import urllib.request
from http.cookiejar import CookieJar
from pathlib import Path
from typing import Any

from implicam.hardware.simulated import PhotographingCamera
from implicam.session.setup import Setup, open_session
from implicam.threads import return_large_memory
from implicam.viewer.bench_page import open_page

DRAWN = [0.0]
"""Seconds of CPU that the simulated cameras took."""


def count_drawing() -> None:
    """Let the simulated cameras say how long they take."""
    take, lock = PhotographingCamera.frame, threading.Lock()

    def frame(camera: PhotographingCamera, timeout: float = 5.0) -> Any:
        begin = time.thread_time()
        try:
            return take(camera, timeout)
        finally:
            with lock:
                DRAWN[0] += time.thread_time() - begin

    PhotographingCamera.frame = frame  # type: ignore[method-assign]


class Browser:
    """Reads states and pictures."""

    def __init__(self, url: str) -> None:
        self.base = url.partition("?")[0]
        self.opener = urllib.request.build_opener(
            urllib.request.ProxyHandler({}), urllib.request.HTTPCookieProcessor(CookieJar())
        )
        self.opener.open(url).read()
        self.state: dict[str, Any] = {"phase": ""}
        self._shown: dict[str, int] = {}
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        with self.opener.open(self.base + "api/state") as stream:
            while line := stream.readline().decode():
                if line.startswith("data: ") and len(line) > 20:
                    state = json.loads(line[6:])
                    for one in state["cameras"]:
                        if one.get("picture") not in (None, self._shown.get(one["name"])):
                            self._shown[one["name"]] = one["picture"]
                            self.opener.open(f"{self.base}picture.jpg?camera={one['name']}&width=480").read()
                    self.state = state

    def presses(self, word: str, phase: str) -> tuple[float, float, float]:
        """Until the page is in a phase, with all its pictures: seconds, those of CPU, of these to draw pictures."""
        begin, spent, drew = time.monotonic(), time.process_time(), DRAWN[0]
        request = urllib.request.Request(self.base + "api/do", json.dumps({"word": word}).encode())
        self.opener.open(request).read()
        version = self.state.get("version", -1)
        while self.state["phase"] != phase or self.state["version"] == version:
            time.sleep(0.005)
        return time.monotonic() - begin, time.process_time() - spent, DRAWN[0] - drew

    def waits(self, phase: str) -> None:
        """Until the page is in a phase."""
        while self.state["phase"] != phase:
            time.sleep(0.01)


def memory_mb() -> float:
    """Resident now; the most there was, where the system does not say."""
    with contextlib.suppress(OSError):
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * resource.getpagesize() / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=20)
    parser.add_argument("--rig", default="bar6")
    parser.add_argument("--browsers", type=int, default=1)
    options = parser.parse_args()
    return_large_memory()
    count_drawing()
    with tempfile.TemporaryDirectory() as folder:
        setup = Setup(rig=options.rig, budget=options.points + 5, speed=1e9)
        with open_session(Path(folder) / "session", setup) as controller, open_page(controller) as (url, _):
            first, *_others = [Browser(url) for _ in range(options.browsers)]
            first.waits("aim")
            go, accept = [], []
            for _ in range(options.points):
                go.append(first.presses("go", "shown"))
                accept.append(first.presses("accept", "aim"))
            memory = memory_mb()
    print(
        f"{options.rig}, {options.points} points, {options.browsers} browsers; memory {memory:.0f} MB with the clients"
    )
    print(f"{'':18} {'median':>8} {'last 5':>8} {'longest':>8}  s {'CPU, last 5':>14} {'of it drawn':>12}  s")
    for name, times in (("Go to found", go), ("Accept to target", accept)):
        passed, spent, drawn = (list(column) for column in zip(*times, strict=True))
        last, cpu, draw = (statistics.median(column[-5:]) for column in (passed, spent, drawn))
        print(f"{name:18} {statistics.median(passed):8.2f} {last:8.2f} {max(passed):8.2f} {cpu:16.2f} {draw:12.2f}")


if __name__ == "__main__":
    main()
