"""`implicam shoot`: sets of pictures into a dataset folder, whole or not at all."""

from __future__ import annotations

import io
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from command_line import Cli, cli  # noqa: F401
from drivers import nothing_left, number_in, picture  # noqa: F401
from implicam.dataset.folder import read_description
from implicam.errors import HardwareError, ImageError, ImplicamError, UsageError
from implicam.hardware import CAMERAS, TRIGGERS
from implicam.images import read_picture, write_picture
from implicam.session import shots as module
from implicam.session.shots import TAKEN, TAKING, ShotFolder, Shutter, every, take_sets
from still_camera import Still, shoot_on, taken
from toy_robot import ToyTrigger

TWO = ["--camera", "left=still:", "--camera", "right=still:"]


@pytest.fixture(autouse=True)
def known_drivers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CAMERAS, "_parts", {**CAMERAS._parts, "still": Still})
    monkeypatch.setattr(TRIGGERS, "_parts", {**TRIGGERS._parts, "toy": ToyTrigger})


def whole_sets(folder: Path, cameras: Sequence[str]) -> list[str]:
    """The shots, each of which all cameras have, and every picture can be read."""
    shots = [sorted(path.stem for path in (folder / "images" / name).glob("*")) for name in cameras]
    assert all(own == shots[0] for own in shots)
    for path in folder.glob("images/*/*"):
        read_picture(path)
    return shots[0]


@pytest.mark.slow
def test_detect_reads_what_was_shot_and_the_numbers_go_on(cli: Cli, tmp_path: Path) -> None:
    assert cli("shoot", "shots", "--cameras", "2R", "--unit", "m", "--rig", "bar6", "--count", "2").code == 0
    ran = cli("shoot", "-o", "shots", "--cameras", "2R", "--json", "--seed", "7")
    assert ran.json == {"dataset": "shots", "shots": ["0003"], "cameras": ["cam2", "cam3"]}
    assert whole_sets(tmp_path / "shots", ["cam2", "cam3"]) == ["0001", "0002", "0003"]
    name, unit, cameras, _ = read_description(tmp_path / "shots")
    assert (name, unit) == ("shots", "m")
    assert [(camera.width, camera.height) for camera in cameras] == [(1280, 800)] * 2
    ran = cli("detect", "shots", "--target", "ball", "--no-overlays", "--json")
    assert (ran.code, sum(camera["found"] for camera in ran.json["cameras"])) == (0, 6)


def test_a_key_takes_a_set(cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for typed, sets in (("\n\nq\n\n", 2), ("\n", 1), ("q\n", 0)):
        monkeypatch.setattr(sys, "stdin", io.StringIO(typed))
        ran = cli("shoot", "shots", *TWO, "--on-key")
        assert ran.code == 0
        assert f"shots: {sets} set" in ran.out
    assert whole_sets(tmp_path / "shots", ["left", "right"]) == ["0001", "0002", "0003"]


def test_a_set_every_so_often() -> None:
    said: list[str] = []
    begun = time.monotonic()
    when = [time.monotonic() - begun for _ in every(0.05, said.append, 4)]
    assert when[3] >= 0.15
    assert not said
    for number in every(0.05, said.append, 3):
        time.sleep(0.08 if number == 0 else 0.0)
    assert len(said) == 1


def test_a_trigger_box_of_ours_is_fired_for_each_set(
    cli: Cli,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fired: Counter[int] = Counter()
    fire = ToyTrigger.fire
    monkeypatch.setattr(ToyTrigger, "fire", lambda box: (fired.update([box.line]), fire(box)))
    ran = cli("shoot", "shots", *TWO, "--trigger", "toy:1", "--every", "0.01", "--count", "3")
    assert ran.code == 0, ran.err
    assert fired == {1: 3}
    assert whole_sets(tmp_path / "shots", ["left", "right"]) == ["0001", "0002", "0003"]
    assert cli("shoot", "shots", *TWO, "--trigger", "toy:1=left", "--trigger", "toy:2=right").code == 0
    assert fired == {1: 4, 2: 1}


def test_pictures_that_another_program_saves_at_each_pulse(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """basler/pypylon#839, tiscamera#391: one camera misses a pulse, and from then on all sets are mixed."""
    monkeypatch.setattr(module, "SLICE_SECONDS", 0.2)
    monkeypatch.setattr(module, "MAX_SET_SECONDS", 0.4)
    from implicam.hardware import FolderCamera

    folders = [tmp_path / name for name in ("left", "right")]
    for folder in folders:
        folder.mkdir()
    cameras = [FolderCamera(folder.name, folder) for folder in folders]
    ending = threading.Event()

    def fill() -> None:
        number = 0
        while not ending.wait(0.6 if number else 0.3):
            number += 1
            for folder in folders:
                if (number, folder.name) != (2, "right"):  # which missed a pulse
                    write_picture(folder / f"shot{number}.png", picture(number))

    said: list[str] = []
    shutter = Shutter(cameras, waits=True)
    with ShotFolder(tmp_path / "shots", cameras, "mm", said.append) as kept, shutter.opened():
        thread = threading.Thread(target=fill)
        thread.start()
        try:
            missed = lambda error: said.append(error.what)  # noqa: E731
            assert take_sets(shutter, kept, range(4), missed=missed, most_missed=2) == 3
        finally:
            ending.set()
            thread.join()
    assert len(said) == 1
    assert "camera right: no new picture" in said[0]
    for shot in whole_sets(tmp_path / "shots", ["left", "right"]):
        pair = [read_picture(tmp_path / "shots" / "images" / name / f"{shot}.png") for name in ("left", "right")]
        np.testing.assert_array_equal(*pair)  # of one pulse


def test_a_set_that_is_not_whole_is_not_kept(tmp_path: Path) -> None:
    cameras = [Still("left"), Still("right", 2, 3, 5)]
    sets, said = taken(tmp_path / "s", cameras, 6, most_missed=3)
    assert sets == 3
    assert said.count("camera right is gone.") == 3
    assert whole_sets(tmp_path / "s", ["left", "right"]) == ["0001", "0002", "0003"]
    with pytest.raises(HardwareError, match="right is gone"):
        taken(tmp_path / "s", [Still("left"), Still("right", 2, 3)], 6, most_missed=2)
    assert whole_sets(tmp_path / "s", ["left", "right"]) == ["0001", "0002", "0003", "0004"]
    values = read_picture(tmp_path / "s" / "images" / "left" / "0001.png") * 65535
    np.testing.assert_allclose(values, 1, atol=1e-3)  # every bit of a camera of 16


def test_what_cameras_were_set_to_is_kept_and_compared(tmp_path: Path) -> None:
    cameras = [Still("left"), Still("right")]
    _, said = taken(tmp_path / "s", cameras)
    assert said == [f"camera {name}: 64x48,MJPG,exposure=200" for name in ("left", "right")]
    extra = {camera.name: dict(camera.extra) for camera in read_description(tmp_path / "s")[2]}
    assert extra["left"] == {"device": "/dev/v4l/by-id/left", "settings": "64x48,MJPG,exposure=200"}
    cameras[1].settings = "64x48,MJPG,exposure=156"
    _, said = taken(tmp_path / "s", cameras)
    assert said[2:] == ["camera right: exposure was 200, and is 156"]
    cameras[0].size = (24, 32)
    with pytest.raises(ImageError, match="'left' has 32 x 24 pixels"):
        taken(tmp_path / "s", cameras)
    assert whole_sets(tmp_path / "s", ["left", "right"])[-1] == "0006"


def test_a_full_disk_leaves_whole_sets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cameras = [Still("left"), Still("right")]
    taken(tmp_path / "s", cameras, 1)
    write = module.write_pictures

    def full(folder: Path, shot: str, pictures: dict[str, np.ndarray]) -> None:
        write(folder, shot, dict(list(pictures.items())[:1]))
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module, "write_pictures", full)
    with pytest.raises(ImplicamError, match="No space left"):
        taken(tmp_path / "s", cameras, 1)
    assert not (tmp_path / "s" / TAKING).exists()
    assert whole_sets(tmp_path / "s", ["left", "right"]) == ["0001"]


def test_what_a_kill_leaves_is_put_in_place_or_thrown_away(tmp_path: Path) -> None:
    cameras = [Still("left"), Still("right")]
    taken(tmp_path / "s", cameras, 1)
    for staged, pictures in ((TAKEN, ("right",)), (TAKING, ("left",))):  # one was in place already
        for name in pictures:
            write_picture(tmp_path / "s" / staged / "images" / name / "0002.png", picture(2))
    write_picture(tmp_path / "s" / "images" / "left" / "0002.png", picture(2))
    taken(tmp_path / "s", cameras, 1)
    assert whole_sets(tmp_path / "s", ["left", "right"]) == ["0001", "0002", "0003"]
    assert not (tmp_path / "s" / TAKEN).exists()
    assert not (tmp_path / "s" / TAKING).exists()


def test_after_kills_at_any_moment_every_set_is_whole(tmp_path: Path) -> None:
    context, folder = multiprocessing.get_context("forkserver"), tmp_path / "s"
    context.set_forkserver_preload(["implicam.session.shots", "cv2"])
    for k in range(12):
        before = len(list(folder.glob("images/*/*")))
        process = context.Process(target=shoot_on, args=(str(folder),))
        process.start()
        end = time.monotonic() + 60
        while len(list(folder.glob("images/*/*"))) < before + 3 + k % 2 and time.monotonic() < end:
            time.sleep(0.0003 * k)
        process.kill()
        process.join()
    taken(folder, [Still("left"), Still("right")], 1)
    sets = whole_sets(folder, ["left", "right"])
    assert sets == [f"{k:04d}" for k in range(1, len(sets) + 1)]
    assert len(sets) > 12
    assert sorted(path.name for path in folder.iterdir()) == ["dataset.toml", "images"]


def test_ctrl_c_ends_it_cleanly_wherever_it_is(tmp_path: Path) -> None:
    for name in ("left", "right"):
        (tmp_path / name).mkdir()
    waiting = ["--on-trigger", "--camera", "left=left/", "--camera", "right=right/"]
    for words, folder in ((["--every", "1ms", "--cameras", "2R"], "shots"), (waiting, "others")):
        command = [sys.executable, "-m", "implicam", "shoot", folder, *words]
        process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert process.stderr is not None
        assert process.stdout is not None
        assert "Ctrl-C ends" in process.stderr.readline()
        if folder == "shots":
            assert "0001: 2 pictures" in process.stdout.readline()
        begun = time.monotonic()
        process.send_signal(signal.SIGINT)
        _, told = process.communicate(timeout=60)
        assert process.returncode == 0, told
        assert time.monotonic() - begun < 10
        assert "Traceback" not in told
        assert f"in {folder}" in told
    assert whole_sets(tmp_path / "shots", ["cam2", "cam3"])
    assert sorted(path.name for path in (tmp_path / "shots").iterdir()) == ["dataset.toml", "images"]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["shots", "-o", "shots"], "name one folder"),
        ([], "name one folder"),
        (["shots", "--every", "soon"], "is no time"),
        (["shots", "--every", "0s"], "is no time"),
        (["shots", "--every", "2s", "--on-key"], "exclude each other"),
        (["shots", "--on-trigger", "--trigger", "udp://a:1", "--camera", "left=0"], "exclude each other"),
        (["shots", "--trigger", "udp://a:1"], "simulated cameras wait for no trigger"),
        (["shots", "--camera", "left=0", "--camera", "left=1"], "two cameras 'left'"),
        (["shots", "--camera", "left=0,gian=3"], "did you mean 'gain'"),
        (["shots.zip"], "is the name of a file"),
        (["full"], "is not empty, and no dataset"),
        (["taken", "--unit", "m"], "is in 'mm', not in 'm'"),
        (["taken", "--cameras", "1"], "cam"),
        (["taken"], "has the cameras cam2, cam3"),
    ],
)
def test_what_cannot_be_is_refused(words: list[str], says: str, cli: Cli, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("three years")
    if words and words[0] == "taken":
        taken(tmp_path / "taken", [Still("cam2"), Still("cam3")], 1)
    ran = cli("shoot", *words)
    assert ran.code == 2
    assert says in ran.err
    assert not (tmp_path / "shots").exists()


def test_two_processes_do_not_mix(tmp_path: Path) -> None:
    cameras = [Still("left")]
    with (
        ShotFolder(tmp_path / "s", cameras, None, print),
        pytest.raises(UsageError, match="another process is shooting"),
    ):
        ShotFolder(tmp_path / "s", cameras, None, print)
    taken(tmp_path / "s", cameras, 1)
    assert os.listdir(tmp_path / "s" / "images" / "left") == ["0001.png"]
