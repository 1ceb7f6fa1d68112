"""`implicam acquire` itself: its options, its log, and how it ends; the session is tested in test_session_*.py."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from command_line import UNWATCHED, Cli, cli  # noqa: F401  a fixture
from implicam.active.acquisitions import ACQUISITIONS
from implicam.dataset import read_dataset
from implicam.errors import UsageError
from implicam.session import Session
from implicam.session.setup import Setup, open_session

pytestmark = pytest.mark.usefixtures("looks_kept")

# its options are the fields of a setup


@pytest.mark.parametrize("command", ["acquire", "suggest"])
def test_the_help_names_every_acquisition(cli: Cli, command: str) -> None:
    told = " ".join(cli(command, "--help").out.replace("│", " ").split())
    assert f"{', '.join(ACQUISITIONS)} (default integrated)" in told


def test_a_setup_takes_the_words_of_a_command_line() -> None:
    made = Setup(cameras=["left=0", "right=rtsp://a/b?c=d"], tool="0,-1.5,120")  # type: ignore[arg-type]
    assert made.cameras == (("left", "0"), ("right", "rtsp://a/b?c=d"))
    assert made.tool == (0.0, -1.5, 120.0)
    for wrong, says in (
        ({"tool": "1,2"}, "write --tool=120,-40,300"),
        ({"tool": "1,2,x"}, "no position"),
        ({"cameras": ["left"]}, "--camera left names no camera"),
        ({"cameras": ["=0"]}, "--camera =0 names no camera"),
    ):
        with pytest.raises(UsageError, match=says):
            Setup(**wrong)  # type: ignore[arg-type]


def test_a_session_of_an_older_version_is_understood() -> None:
    kept = json.loads("""
        {"rig": "bar6", "rig_cameras": null, "cameras": [["left", "0"], ["right", "rtsp://x"]], "robot": "ur:10.0.0.2",
        "trigger": "udp://10.0.0.3:4000", "unit": "mm", "radius": null, "bright": false, "workspace": "0:1,0:1,0:1",
        "method": "forward-gp", "acquisition": "integrated", "below": null, "within": 1.2, "budget": 60, "reach": null,
        "speed": null, "sd": null, "tool": [0.0, 0.0, 120.0], "dry_run": false, "seed": 0}
    """)
    setup = Setup.from_settings(kept)
    came_later = {key: value for key, value in json.loads(json.dumps(Setup().as_settings())).items() if key not in kept}
    assert (came_later["target"], came_later["pulse_every"]) == ("ball", 1.0)
    assert json.loads(json.dumps(setup.as_settings())) == kept | came_later | {"trigger": ["udp://10.0.0.3:4000"]}
    assert setup.cameras == (("left", "0"), ("right", "rtsp://x"))


# its log


def test_what_goes_wrong_on_opening_is_in_the_log_and_the_folder_is_still_free(cli: Cli, tmp_path: Path) -> None:
    words = ["acquire", "s", "--no-browser", "--camera", f"left={tmp_path}/", "--robot", "csv:missing.csv"]
    for tries in (1, 2):
        ran = cli(*words, "-v")
        assert ran.code == 1
        assert "implicam: implicam 0.1.0: " in ran.err  # what the log begins with
        text = (tmp_path / "s" / "implicam.log").read_text()
        assert text.count("ended by") == text.count("Error: missing.csv") == tries
    open_session(tmp_path / "s", Setup(rig="stereo")).close()


def test_an_address_that_is_none_leaves_no_folder(cli: Cli, tmp_path: Path) -> None:
    told = cli("acquire", "s", "--no-browser", "--host", "192.0.2.7")
    assert told.code == 1
    assert "192.0.2.7 is no address or name of this computer" in told.err
    assert not (tmp_path / "s").exists()


def test_nothing_is_written_into_a_folder_of_something_else(cli: Cli, tmp_path: Path) -> None:
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "thesis.txt").write_text("three years")
    ran = cli("acquire", "s", "--unattended")
    assert ran.code == 2
    assert "is not empty" in ran.err
    assert [path.name for path in (tmp_path / "s").iterdir()] == ["thesis.txt"]
    assert cli("acquire", "new", "--unattended", "--sd", "-1").code == 2
    assert not (tmp_path / "new").exists()


# how it ends


def begun(words: str, until: str, cwd: Path, times: int = 1) -> subprocess.Popen[str]:
    """The command in a process of its own, which has said something on stderr so many times."""
    code = [sys.executable, "-m", "implicam", *words.split()]
    process = subprocess.Popen(code, cwd=cwd, env=UNWATCHED, stdout=-1, stderr=-1, text=True)
    assert process.stderr is not None
    said = ""
    for line in process.stderr:
        said += line
        if said.count(until) == times:
            return process
    raise AssertionError(said)


def ended(process: subprocess.Popen[str]) -> tuple[float, int, str]:
    """Seconds from SIGTERM to the end, the exit code, and what was said."""
    begin = time.monotonic()
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=180)
    return time.monotonic() - begin, process.returncode, out + err


TEARDOWN_SECONDS = 3.0
"""What a busy machine may take to end a process whose session is closed."""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGTERM that a process can answer")
def test_sigterm_closes_the_page_as_ctrl_c_does(tmp_path: Path) -> None:
    pytest.importorskip("starlette")
    process = begun("acquire s --rig stereo --no-browser --port 0", "The session is at", tmp_path)
    seconds, code, said = ended(process)
    assert (code, "point 1" in said or "nothing measured" in said or "connecting" in said) == (0, True), said
    assert seconds < 2 + TEARDOWN_SECONDS
    assert (tmp_path / "s" / "implicam.log").read_text().rstrip().endswith("done")
    assert not (tmp_path / "s" / "session.db-journal").exists()
    Session.open(tmp_path / "s").close()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGTERM that a process can answer")
def test_sigterm_ends_a_session_that_goes_by_itself(tmp_path: Path) -> None:
    words = "acquire s --rig stereo --unattended --speed 1000 -v"
    process = begun(words, "fitting with everything", tmp_path, times=2)
    seconds, code, said = ended(process)
    assert code == 130
    assert "interrupted; what was measured is kept in s" in said
    assert seconds < 2 + TEARDOWN_SECONDS
    log = (tmp_path / "s" / "implicam.log").read_text()
    assert "ended by KeyboardInterrupt" in log
    assert not (tmp_path / "s" / "session.db-journal").exists()
    with Session.open(tmp_path / "s") as session:
        assert session.data is not None
        assert len(session.data) == len(read_dataset(tmp_path / "s")) > 0


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGTERM that a process can answer")
def test_sigterm_cuts_off_what_waits_for_a_camera(tmp_path: Path) -> None:
    pytest.importorskip("starlette")
    (tmp_path / "pictures").mkdir()
    words = "acquire s --camera left=pictures/ --workspace=0:1,0:1,0:1 --no-browser --port 0"
    process = begun(words, "waiting for one picture", tmp_path)
    time.sleep(1)  # now it does
    seconds, code, _ = ended(process)
    assert code == 128 + signal.SIGTERM
    assert seconds < 2 + TEARDOWN_SECONDS  # not the minute that a picture may take
    assert "cut off: not closed 1.5 s after SIGTERM" in (tmp_path / "s" / "implicam.log").read_text()


def test_ctrl_c_stops_a_robot_that_is_on_its_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("starlette")
    from implicam.viewer import bench_page

    class Interrupted(threading.Event):
        """What the main thread waits for: Ctrl-C comes when the robot is on its way."""

        def wait(self, timeout: float | None = None) -> bool:
            while controller.state.phase != "aim":
                time.sleep(0.01)
            pages[0].do({"word": "go"})
            while controller.state.phase != "moving":
                time.sleep(0.01)
            raise KeyboardInterrupt

    pages = []
    plain = bench_page.BenchPage.__init__

    def watched(self: bench_page.BenchPage, *words: object) -> None:
        plain(self, *words)  # type: ignore[arg-type]
        self.closed = Interrupted()
        pages.append(self)

    monkeypatch.setattr(bench_page.BenchPage, "__init__", watched)
    with open_session(tmp_path / "s", Setup(rig="stereo", speed=1e-4)) as controller:  # hours to get there
        begin = time.monotonic()
        bench_page.serve(controller, port=0, open_browser=False, say=lambda text: None)
        assert time.monotonic() - begin < 30
        assert controller.state.phase == "trouble"
        assert "stopped" in controller.state.message
