"""What commands say of themselves: nothing unless asked, on stderr with --verbose, in a file where they take long."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from command_line import Cli, cli  # noqa: F401  a fixture
from implicam.cli import show
from implicam.logs import log_to_file

pytestmark = pytest.mark.usefixtures("looks_kept")

SIMULATE = ["simulate", "rig", "--cameras", "2R", "--positions", "random", "--points", "20", "--seed", "1"]


@pytest.mark.slow
def test_verbose_tells_what_a_fit_does_and_without_it_nothing_is_told(cli: Cli) -> None:
    cli(*SIMULATE)
    quiet = cli("calibrate", "rig", "-o", "a.implicam", "--json")
    told = cli("calibrate", "rig", "-o", "b.implicam", "--json", "--verbose")
    assert quiet.code == told.code == 0
    assert "implicam.calibrators.forward_gp.fit: round 0" in told.err
    assert "cam3 starts from 20 of 20 views" in told.err
    assert "round" not in quiet.err
    assert {k: v for k, v in told.json.items() if k != "calibration"} == {
        k: v for k, v in quiet.json.items() if k != "calibration"
    }
    assert not logging.getLogger("implicam").handlers


@pytest.mark.slow
def test_detect_and_a_session_keep_a_log(cli: Cli, tmp_path: Path) -> None:
    cli("simulate", "photos", "--images", "--cameras", "2R", "--positions", "random", "--points", "1")
    assert cli("detect", "photos", "--target", "ball", "--radius", "8").code == 0
    text = (tmp_path / "photos" / "detections" / "implicam.log").read_text()
    assert "INFO" in text
    assert text.rstrip().endswith("done")
    assert cli("acquire", "s", "--unattended", "--cameras", "2R", "--budget", "8").code == 0
    assert "session.journal: finished" in (tmp_path / "s" / "implicam.log").read_text()


def test_an_error_is_in_the_log_with_its_traceback(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), log_to_file(tmp_path / "new" / "x.log", "begun"):
        _ = 1 / 0
    with log_to_file(tmp_path / "new" / "x.log", "again"):
        pass
    text = (tmp_path / "new" / "x.log").read_text()
    assert "ended by ZeroDivisionError" in text
    assert "_ = 1 / 0" in text
    assert text.index("begun") < text.index("again")
    assert not logging.getLogger("implicam").handlers


def test_without_a_terminal_long_work_says_a_line_now_and_then(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Not a line a step, and not silence for minutes."""
    clock = [100.0]
    monkeypatch.setattr(show.time, "monotonic", lambda: clock[0])
    with show.progress() as progress:
        for done in range(101):
            progress("fitting", done, 100)
            clock[0] += 1
    lines = capfd.readouterr().err.splitlines()
    assert lines == [
        "fitting: 10 of 100, about 2 min left",
        "fitting: 40 of 100, about 1 min left",
        "fitting: 70 of 100, about 1 min left",
        "fitting: 100 of 100",
    ]
    with show.progress(quiet=True) as progress:
        clock[0] += 1000
        progress("fitting", 1, 2)
    assert capfd.readouterr().err == ""
