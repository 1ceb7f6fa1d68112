"""A detector over a folder of pictures: nothing is lost, nothing stops the rest, everything can be looked at."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from implicam.dataset import read_dataset
from implicam.detect.folder import _note_missing, detect_folder
from implicam.detect.journal import Entry, Journal, Key
from implicam.detect.model import Detected, DetectorBase, View, nothing
from implicam.detect.overlay import STATES, Result, draw_overlay, draw_thumbnail
from implicam.detect.sheets import PAGE_COLUMNS, PAGE_ROWS
from implicam.errors import DatasetError, ImageError, MissingExtraError, UsageError
from implicam.images import eight_bit, read_picture

cv2 = pytest.importorskip("cv2")

SIZE = (160, 120)


@dataclass(frozen=True)
class Spot(DetectorBase):
    """The centroid of the brightest spot: a real detector, if a simple one."""

    above: float = 0.5
    looked: list[View] = field(default_factory=list)

    def options(self):
        return {"above": self.above}

    def detect(self, picture, view):
        self.looked.append(view)
        bright = np.where(picture > self.above, picture, 0)
        if not bright.any():
            return nothing(f"nothing is brighter than {self.above}; light the spot")
        v, u = np.mgrid[: picture.shape[0], : picture.shape[1]]
        uv = np.array([[np.sum(u * bright), np.sum(v * bright)]]) / bright.sum()
        return Detected((view.shot,), uv, np.full((1, 2), 0.05), notes={"pixels": int((bright > 0).sum())})

    def settle(self, found):
        return dict(found)


@dataclass(frozen=True)
class Settling(Spot):
    """It takes back what it found in one camera."""

    def settle(self, found):
        return {view: nothing("it moves") if view.camera == "cam2" else d for view, d in found.items()}


@dataclass(frozen=True)
class Broken(Spot):
    """It fails on one shot."""

    error: Exception = field(default_factory=lambda: IndexError("list index out of range"))

    def detect(self, picture, view):
        if view.shot == "p2":
            raise self.error
        return super().detect(picture, view)


def place(camera: int, shot: int) -> tuple[float, float]:
    return 30.0 + 11 * shot + 3 * camera, 40.0 + 5 * shot + 7 * camera


def photograph(uv: tuple[float, float] | None, size=SIZE) -> np.ndarray:
    v, u = np.mgrid[: size[1], : size[0]]
    image = np.random.default_rng(0).normal(60, 3, (size[1], size[0]))
    if uv is not None:
        image += 180 * ((u - uv[0]) ** 2 + (v - uv[1]) ** 2 < 6.5**2)
    return np.clip(image, 0, 255).astype(np.uint8)


def put(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(path.suffix, image)[1].tobytes())


def make(folder: Path, cameras: int = 2, shots: int = 3, points: bool = True) -> Path:
    names = [f"p{s + 1}" for s in range(shots)]
    for c in range(cameras):
        for s, name in enumerate(names):
            put(folder / "images" / f"cam{c + 1}" / f"{name}.png", photograph(place(c, s)))
    tables = "".join(f'[[cameras]]\nname = "cam{c + 1}"\nwidth = 160\nheight = 120\n' for c in range(cameras))
    (folder / "dataset.toml").write_text(f'name = "spots"\nlength_unit = "mm"\n{tables}')
    if points:
        rows = "".join(f"{name},{name},{s}.0,0.0,0.0\n" for s, name in reversed(list(enumerate(names))))
        (folder / "points.csv").write_text("point,shot,x,y,z\n" + rows)
    return folder


def summary(folder: Path) -> dict[tuple[str, str], dict[str, str]]:
    with (folder / "detections" / "summary.csv").open(encoding="utf-8", newline="") as file:
        return {(row["camera"], row["shot"]): row for row in csv.DictReader(file)}


def test_what_is_found_is_written_as_a_dataset(tmp_path):
    make(tmp_path)
    steps = []
    run = detect_folder(tmp_path, Spot(), progress=lambda *step: steps.append(step))
    data = read_dataset(tmp_path)
    assert data.points.tolist() == ["p3", "p2", "p1"]  # the order of points.csv
    truth = np.array([[place(c, s) for c in range(2)] for s in (2, 1, 0)])
    np.testing.assert_allclose(data.observations.uv, truth, atol=0.1)
    np.testing.assert_array_equal(data.observations.uv, run.data.observations.uv)
    assert (data.observations.sd == 0.05).all()
    assert [tuple(count) for count in run.cameras] == [("cam1", 3, 3, 3), ("cam2", 3, 3, 3)]
    assert run.notes == ()
    assert run.reasons == ()
    assert run.resumed == 0
    assert run.seconds_per_picture > 0
    assert [path.name for path in run.sheets] == ["cam1.jpg", "cam2.jpg"]
    assert summary(tmp_path)["cam1", "p2"] == {
        "camera": "cam1", "shot": "p2", "file": "images/cam1/p2.png", "found": "1", "expected": "1", "reason": "",
    }  # fmt: skip
    for what in ("looking at pictures", "drawing overlays"):
        assert sorted(done for said, done, total in steps if said == what and total == 6)[-1] == 6


def test_without_dataset_toml_the_folders_and_pictures_say_it(tmp_path):
    folder = make(tmp_path / "a rig")
    (folder / "dataset.toml").unlink()
    (folder / "points.csv").unlink()
    with pytest.raises(UsageError, match="length unit") as told:
        detect_folder(folder, Spot())
    assert "--unit mm" in told.value.fix
    assert not (folder / "detections").exists()
    detect_folder(folder, Spot(), unit="cm")
    data = read_dataset(folder)
    assert (data.name, data.length_unit, data.known) == ("a rig", "cm", None)
    assert [(c.name, c.width, c.height) for c in data.cameras] == [("cam1", 160, 120), ("cam2", 160, 120)]
    assert data.points.tolist() == ["p1", "p2", "p3"]
    with pytest.raises(UsageError, match="is in 'cm', not in 'mm'"):
        detect_folder(folder, Spot(), unit="mm")


def test_shots_are_in_the_order_in_which_people_count(tmp_path):
    for shot in ("img10", "img2", "Übung 1", "a.b"):
        put(tmp_path / "images" / "c 1" / f"{shot}.png", photograph((50, 50)))
    detect_folder(tmp_path, Spot(), unit="mm")
    assert read_dataset(tmp_path).points.tolist() == ["a.b", "img2", "img10", "Übung 1"]
    assert (tmp_path / "detections" / "overlays" / "c 1" / "Übung 1.jpg").exists()
    assert (tmp_path / "detections" / "overlays" / "c 1" / "a.b.jpg").exists()


def test_pictures_outside_of_the_dataset(tmp_path):
    rig = make(tmp_path / "rig", cameras=1)
    (rig / "images").rename(tmp_path / "disk")
    run = detect_folder(rig, Spot(), pictures=str(tmp_path / "disk"))
    assert len(run.data) == 3
    assert summary(rig)["cam1", "p1"]["file"] == "../disk/cam1/p1.png"


def test_a_size_that_is_stated_in_half(tmp_path):
    make(tmp_path, cameras=1)
    toml = tmp_path / "dataset.toml"
    toml.write_text(toml.read_text().replace("height = 120\n", ""))
    run = detect_folder(tmp_path, Spot(), overlays=False)
    assert (run.data.cameras[0].width, run.data.cameras[0].height) == (160, 120)
    toml.write_text(toml.read_text().replace("width = 160", "width = 150"))
    with pytest.raises(ImageError, match="nothing was found") as told:
        detect_folder(tmp_path, Spot(), overlays=False)
    assert "3 x its size is 160 x 120, but camera 'cam1' has 150 x 120" in told.value.why


def test_pictures_elsewhere_by_a_pattern(tmp_path):
    make(tmp_path, points=False)
    for path in (tmp_path / "images").rglob("*.png"):
        target = tmp_path / "raw" / f"{path.stem}_{path.parent.name}.png"
        target.parent.mkdir(exist_ok=True)
        path.rename(target)
    run = detect_folder(tmp_path, Spot(), pictures="raw", pattern="{shot}_{camera}")
    assert len(run.data) == 3
    assert summary(tmp_path)["cam2", "p1"]["file"] == "raw/p1_cam2.png"


def test_every_bad_picture_is_named_and_the_rest_goes_on(tmp_path):
    make(tmp_path, cameras=1, shots=9)
    images = tmp_path / "images" / "cam1"
    whole = (images / "p1.png").read_bytes()
    (images / "p1.png").write_bytes(whole[: len(whole) // 2])
    (images / "p2.png").write_bytes(b"")
    (images / "p3.png").write_bytes(b"no picture")
    put(images / "p4.png", np.zeros(SIZE[::-1], np.uint8))
    put(images / "p5.png", photograph((50, 50), SIZE[::-1]))
    put(images / "p6.png", photograph((50, 50), (80, 60)))
    put(images / "p7.png", np.full((1, 1), 200, np.uint8))
    put(images / "p8.png", photograph(None))
    run = detect_folder(tmp_path, Spot())
    words = {
        1: "cut off", 2: "is empty", 3: "not a picture", 4: "is black", 5: "160 x 120; it may be rotated by a quarter",
        6: "its size is 80 x 60, but camera 'cam1' has 160 x 120", 7: "is uniformly grey", 8: "is uniformly grey",
    }  # fmt: skip
    assert len(run.notes) == 7  # p7 and p8 share one
    for number, word in words.items():
        (note,) = [note for note in run.notes if f"images/cam1/p{number}.png" in note]
        assert word in note
        assert word in summary(tmp_path)["cam1", f"p{number}"]["reason"]
    assert sorted(count for _, count in run.reasons) == [1, 1, 1, 1, 1, 1, 2]
    assert read_dataset(tmp_path).observations.seen.sum() == 1
    assert run.cameras[0] == ("cam1", 9, 1, 1)
    for number in range(1, 10):
        assert read_picture(tmp_path / "detections" / "overlays" / "cam1" / f"p{number}.jpg").size > 1


@pytest.mark.parametrize("ending", [".png", ".jpg", ".tif"])
def test_pictures_cut_off_anywhere(tmp_path, ending):
    image = photograph((50, 50))
    for tenth in range(1, 11):
        path = tmp_path / "images" / "c" / f"{tenth}{ending}"
        put(path, image)
        content = path.read_bytes()
        path.write_bytes(content[: len(content) * tenth // 10])
    run = detect_folder(tmp_path, Spot(), unit="mm", overlays=False)
    assert run.data.points.tolist() == ["10"]
    assert len(run.notes) == 9
    assert all("cut off" in note for note in run.notes)


def test_sizes_come_from_most_pictures_where_nobody_states_them(tmp_path):
    make(tmp_path)
    (tmp_path / "dataset.toml").write_text(
        'name = "spots"\nlength_unit = "mm"\n[[cameras]]\nname = "cam1"\n[[cameras]]\nname = "cam2"\n'
    )
    put(tmp_path / "images" / "cam2" / "p2.png", photograph((50, 50), SIZE[::-1]))
    run = detect_folder(tmp_path, Spot())
    (note,) = run.notes
    assert "images/cam2/p2.png" in note
    assert "quarter turn" in note
    assert run.data.cameras[1].width == 160
    assert "width" not in (tmp_path / "dataset.toml").read_text()


def test_cameras_and_shots_without_pictures_are_named(tmp_path):
    make(tmp_path, cameras=3, shots=9)
    for shot in range(2, 10):
        (tmp_path / "images" / "cam2" / f"p{shot}.png").unlink()
    (tmp_path / "images" / "cam3").rename(tmp_path / "images" / "came3")
    run = detect_folder(tmp_path, Spot())
    assert run.notes == (
        "the 9 pictures of 'came3' are left out: dataset.toml has no such camera (did you mean 'cam3'?).",
        "camera 'cam2' has no picture of the shots p2, p3, p4, p5, p6 and 3 more, which others have.",
        "camera 'cam3' has no picture.",
    )
    notes = _note_missing(["a", "b"], [View("a", "000"), View("a", "10"), View("b", "0"), View("b", "10")])
    assert notes[0].endswith("It has '000': rename that to '0' where the two are one instant.")
    assert [camera.name for camera in read_dataset(tmp_path).cameras] == ["cam1", "cam2", "cam3"]
    for name in ("cam1", "cam2"):
        (tmp_path / "images" / name).rename(tmp_path / "images" / f"x{name}")
    with pytest.raises(ImageError, match="none of the pictures"):
        detect_folder(tmp_path, Spot())


def test_hostile_shot_names_are_left_out_and_named(tmp_path):
    make(tmp_path, cameras=1, points=False)
    for name in ("a\nb", "x" * 220, " lead", "bell\a"):
        put(tmp_path / "images" / "cam1" / f"{name}.png", photograph((50, 50)))
    (tmp_path / "images" / "cam1" / "p1.png").rename(tmp_path / "images" / "cam1" / 'a"b,c;.png')
    run = detect_folder(tmp_path, Spot())
    assert len([note for note in run.notes if "is left out" in note]) == 4
    assert all("\n" not in note for note in run.notes)
    assert sorted(read_dataset(tmp_path).points) == ['a"b,c;', "p2", "p3"]


def test_names_cannot_leave_the_folder(tmp_path):
    """By a pattern, a file may claim to belong to the camera `..`."""
    put(tmp_path / "rig" / "images" / "1_...png", photograph((50, 50)))
    put(tmp_path / "rig" / "images" / "1_c.png", photograph((50, 50)))
    with pytest.raises(DatasetError, match="cannot name a folder"):
        detect_folder(tmp_path / "rig", Spot(), unit="mm", pattern="{shot}_{camera}")
    (tmp_path / "rig" / "dataset.toml").write_text('name = "r"\nlength_unit = "mm"\n[[cameras]]\nname = "c"\n')
    run = detect_folder(tmp_path / "rig", Spot(), pattern="{shot}_{camera}")
    assert "'..' are left out" in run.notes[0]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rig"]


def test_a_detector_that_fails_on_a_picture_is_told_and_asked_again(tmp_path):
    make(tmp_path, cameras=1)
    run = detect_folder(tmp_path, Broken())
    assert "the detector failed: IndexError: list index out of range" in summary(tmp_path)["cam1", "p2"]["reason"]
    assert run.data.observations.seen.sum() == 2
    again = Broken(error=KeyError("x"))
    assert detect_folder(tmp_path, again).resumed == 2
    with pytest.raises(MissingExtraError):
        detect_folder(tmp_path, Broken(error=MissingExtraError("no library")))


@pytest.mark.parametrize(
    "wrong",
    [
        {"uv": np.array([[1e6, 2.0]])}, {"uv": np.array([[np.nan, 2.0]])}, {"sd": np.zeros((1, 2))},
        {"sd": np.full((1, 2), np.inf)}, {"points": ("a", "b")}, {"points": ("a\n",)},
        {"points": ("a", "a"), "uv": np.full((2, 2), 50.0), "sd": np.ones((2, 2))}, {"notes": {"x": object()}},
    ],
)  # fmt: skip
def test_an_impossible_answer_is_a_failure_of_the_detector(tmp_path, wrong):
    make(tmp_path, cameras=1)

    @dataclass(frozen=True)
    class Wrong(Spot):
        def detect(self, picture, view):
            good = super().detect(picture, view)
            return replace(good, **wrong) if view.shot == "p1" else good

    run = detect_folder(tmp_path, Wrong(), overlays=False)
    assert "the detector failed" in summary(tmp_path)["cam1", "p1"]["reason"]
    assert run.data.observations.seen.sum() == 2


def test_the_second_look_decides(tmp_path):
    make(tmp_path)
    run = detect_folder(tmp_path, Settling())
    assert run.data.observations.seen.tolist() == [[True, False]] * 3
    assert run.reasons == (("it moves", 3),)
    assert run.cameras[1] == ("cam2", 3, 0, 0)


def test_points_without_a_known_position_are_left_out_and_named(tmp_path):
    make(tmp_path, cameras=1)
    (tmp_path / "points.csv").write_text("point,shot,x,y,z\np1,p1,0,0,0\np22,p22,0,0,0\n")
    run = detect_folder(tmp_path, Spot())
    assert run.notes[0].startswith(
        "points without a known position in points.csv are left out: 'p2' (did you mean 'p22'?)"
    )
    assert run.data.points.tolist() == ["p1", "p22"]
    (tmp_path / "points.csv").write_text("point,shot,x,y,z\nq,q,0,0,0\n")
    before = (tmp_path / "observations.csv").read_bytes()
    with pytest.raises(ImageError, match="none of the 3 points found") as told:
        detect_folder(tmp_path, Spot())
    assert "points.csv names q, and found were p1, p2, p3" in told.value.why
    assert (tmp_path / "observations.csv").read_bytes() == before


def test_a_point_found_twice_by_a_camera_counts_once(tmp_path):
    make(tmp_path, cameras=1, points=False)

    @dataclass(frozen=True)
    class Same(Spot):
        def detect(self, picture, view):
            return replace(super().detect(picture, view), points=("dot",))

    run = detect_folder(tmp_path, Same(), overlays=False)
    np.testing.assert_allclose(run.data.observations.uv[0, 0], place(0, 0), atol=0.1)
    assert "'dot' (cam1, p2), 'dot' (cam1, p3)" in run.notes[0]


def test_nothing_found_at_all_is_an_error_and_pictures_to_look_at(tmp_path):
    make(tmp_path)
    (tmp_path / "observations.csv").write_text("mine")
    with pytest.raises(ImageError, match="nothing was found in any of the 6 pictures") as told:
        detect_folder(tmp_path, Spot(above=0.999))
    assert "6 x nothing is brighter than 0.999; light the spot" in told.value.why
    assert str(tmp_path / "detections" / "cam1.jpg") in told.value.fix
    assert (tmp_path / "detections" / "cam1.jpg").exists()
    assert (tmp_path / "observations.csv").read_text() == "mine"
    assert summary(tmp_path)["cam1", "p1"]["found"] == "0"


def test_damaged_descriptions_are_told_before_any_picture_is_looked_at(tmp_path):
    make(tmp_path)
    spot = Spot()
    (tmp_path / "points.csv").write_text("point,shot,x,y,z\np1,p1,one,0,0\n")
    with pytest.raises(DatasetError, match="x = 'one' is not a number"):
        detect_folder(tmp_path, spot)
    (tmp_path / "dataset.toml").write_text("name = spots")
    with pytest.raises(DatasetError, match="not valid TOML"):
        detect_folder(tmp_path, spot)
    with pytest.raises(ImageError, match="no folder"):
        detect_folder(tmp_path / "nowhere", spot, unit="mm")
    assert spot.looked == []


# --- observations.csv ------------------------------------------------------------------------------------------------


def kept(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in sorted(folder.glob("observations.before-detect*"))}


def test_what_a_person_wrote_is_kept_always(tmp_path):
    make(tmp_path)
    target = tmp_path / "observations.csv"
    target.write_text("one")
    run = detect_folder(tmp_path, Spot())
    assert "kept as observations.before-detect.csv" in run.notes[0]
    assert kept(tmp_path) == {"observations.before-detect.csv": "one"}

    assert detect_folder(tmp_path, Spot()).notes == ()  # its own, unchanged: nothing to keep
    assert detect_folder(tmp_path, Spot(above=0.6)).notes == ()  # its own, replaced
    assert len(kept(tmp_path)) == 1

    edited = target.read_text().replace("0.05", "0.07")
    target.write_text(edited)
    assert "kept as observations.before-detect-2.csv" in detect_folder(tmp_path, Spot()).notes[0]
    assert kept(tmp_path) == {"observations.before-detect.csv": "one", "observations.before-detect-2.csv": edited}


def test_a_damaged_record_of_what_was_written_loses_nothing(tmp_path):
    make(tmp_path)
    detect_folder(tmp_path, Spot(), overlays=False)
    record = tmp_path / "detections" / "written.toml"
    for number, content in enumerate((b"\xff\xfe", b"observations_sha256 = 3", b"[[", b"")):
        record.write_bytes(content)
        detect_folder(tmp_path, Spot(above=0.5 + 0.01 * number), overlays=False)
        read_dataset(tmp_path)
    record.unlink()
    (tmp_path / "observations.csv").write_text("mine")
    detect_folder(tmp_path, Spot(), overlays=False)
    assert "mine" in kept(tmp_path).values()


# --- resuming --------------------------------------------------------------------------------------------------------


def test_only_what_changed_is_looked_at_again(tmp_path):
    make(tmp_path)
    first = detect_folder(tmp_path, Spot())
    text = first.observations.read_text()

    spot = Spot()
    run = detect_folder(tmp_path, spot)
    assert (spot.looked, run.resumed) == ([], 6)
    assert np.isnan(run.seconds_per_picture)
    assert run.observations.read_text() == text

    put(tmp_path / "images" / "cam1" / "p2.png", photograph((100, 30)))
    assert detect_folder(tmp_path, spot).resumed == 5
    assert spot.looked == [View("cam1", "p2")]
    np.testing.assert_allclose(read_dataset(tmp_path).observations.uv[1, 0], (100, 30), atol=0.1)

    other = Spot(above=0.6)
    assert detect_folder(tmp_path, other).resumed == 0
    assert len(other.looked) == 6
    assert detect_folder(tmp_path, Spot()).resumed == 6  # the results of both are kept
    again = Spot()
    assert detect_folder(tmp_path, again, restart=True).resumed == 0
    assert len(again.looked) == 6
    assert detect_folder(tmp_path, other).resumed == 0


def test_a_touched_or_renamed_picture_is_looked_at_again(tmp_path):
    make(tmp_path, cameras=1)
    detect_folder(tmp_path, Spot(), overlays=False)
    os.utime(tmp_path / "images" / "cam1" / "p1.png", ns=(1, 1))
    assert detect_folder(tmp_path, Spot(), overlays=False).resumed == 2


KILLED = """
import sys, time
from pathlib import Path
sys.path.insert(0, {tests!r})
from test_detect_folder import Spot, detect_folder

class Spot(Spot):
    def detect(self, picture, view):
        time.sleep(0.02)
        return super().detect(picture, view)

detect_folder(Path({folder!r}), Spot(), overlays=False)
"""


@pytest.mark.slow
def test_a_killed_run_goes_on_where_it_stopped(tmp_path):
    shots = 60
    make(tmp_path, cameras=2, shots=shots, points=False)
    for path in (tmp_path / "images").rglob("*.png"):
        put(path, photograph((50, 50)))
    journal = tmp_path / "detections" / "journal.jsonl"
    script = KILLED.format(tests=str(Path(__file__).parent), folder=str(tmp_path))
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    deadline = time.monotonic() + 60
    while not (journal.exists() and journal.read_bytes().count(b"\n") >= 20):
        assert process.poll() is None, process.stderr.read().decode()
        assert time.monotonic() < deadline
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stderr.close()
    lines = journal.read_bytes().split(b"\n")
    complete = len(lines) - 1
    assert 20 <= complete < 2 * shots
    assert not (tmp_path / "observations.csv").exists()
    journal.write_bytes(b"\n".join(lines[:-1]) + b"\n" + lines[0][:50])  # and killed in the middle of a line

    spot = Spot()
    run = detect_folder(tmp_path, spot, overlays=False)
    assert run.resumed == complete
    assert len(spot.looked) == 2 * shots - complete
    assert run.data.observations.seen.all()
    assert detect_folder(tmp_path, spot, overlays=False).resumed == 2 * shots
    reference = make(tmp_path / "reference", points=False)
    for path in (tmp_path / "images").rglob("*.png"):
        put(reference / path.relative_to(tmp_path), photograph((50, 50)))
    detect_folder(reference, Spot(), overlays=False)
    assert (reference / "observations.csv").read_bytes() == (tmp_path / "observations.csv").read_bytes()


def test_a_run_that_is_interrupted_stops_soon_and_loses_nothing(tmp_path):
    make(tmp_path, cameras=1, shots=150, points=False)
    for path in (tmp_path / "images").rglob("*.png"):
        put(path, photograph((50, 50)))
    looked = []

    @dataclass(frozen=True)
    class Interrupted(Spot):
        def detect(self, picture, view):
            looked.append(view)
            if len(looked) == 10:
                raise KeyboardInterrupt
            return super().detect(picture, view)

    Interrupted.__name__ = "Spot"  # the same detector as far as the journal can tell
    with pytest.raises(KeyboardInterrupt):
        detect_folder(tmp_path, Interrupted(), overlays=False)
    assert len(looked) < 150
    assert detect_folder(tmp_path, Spot(), overlays=False).resumed == len(looked) - 1


KEY = Key("cam1", "p1", "p1.png", 12, 34, "abc")
plain_numbers = st.floats(allow_nan=False, allow_infinity=False, width=64)
detections = st.builds(
    lambda n, numbers, reason, notes: Detected(
        tuple(f"p{i}" for i in range(n)),
        np.resize(numbers, (n, 2)),
        np.abs(np.resize(numbers, (n, 2))) + 1e-9,
        reason,
        outlines=(np.resize(numbers, (3, 2)),),
        others=(Detected(("q",), np.resize(numbers, (1, 2)), np.ones((1, 2))),),
        notes=notes,
    ),
    st.integers(0, 4), st.lists(plain_numbers, min_size=1, max_size=9), st.text(max_size=20),
    st.dictionaries(st.text(max_size=5), st.none() | st.integers() | plain_numbers | st.text(max_size=5), max_size=3),
)  # fmt: skip


@settings(max_examples=60, deadline=None)
@given(detections)
def test_the_journal_gives_back_the_same_bits(tmp_path_factory, found):
    path = tmp_path_factory.mktemp("journal") / "j.jsonl"
    with Journal(path) as journal:
        added = journal.add(KEY, Entry(5, 6, found))
    with Journal(path) as journal:
        (entry,) = journal.entries.values()
    assert list(journal.entries) == [KEY]
    assert entry.as_dict() == added.as_dict() == Entry(5, 6, found).as_dict()
    assert json.loads(path.read_bytes())["camera"] == "cam1"  # a line is JSON, for whoever wants to read it


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_damage_to_the_journal_costs_lines_and_never_changes_one(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("journal") / "j.jsonl"
    keys = [KEY._replace(shot=f"p{i}") for i in range(4)]
    entries = {
        key: Entry(5, 6, Detected((key.shot,), np.full((1, 2), i + 0.25), np.ones((1, 2))))
        for i, key in enumerate(keys)
    }
    with Journal(path) as journal:
        for key, entry in entries.items():
            journal.add(key, entry)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        at, damage = data.draw(st.integers(0, len(content))), data.draw(st.binary(max_size=40))
        kind = data.draw(st.sampled_from(["insert", "replace", "cut"]))
        if kind == "insert":
            content[at:at] = damage
        elif kind == "replace":
            content[at : at + len(damage)] = damage
        else:
            del content[at:]
    path.write_bytes(content)
    with Journal(path) as journal:
        for key, entry in journal.entries.items():
            assert entry.as_dict() == entries[key].as_dict()
        journal.add(KEY, Entry(7, 8, nothing("dark")))
    with Journal(path) as journal:
        assert journal.entries[KEY].found.reason == "dark"


@pytest.mark.parametrize(
    "line", [b"[" * 100_000, b"{}", b'{"camera": 1e999}', b"\xff" * 9, b'{"size": ' + b"9" * 5000 + b"}"]
)
def test_hostile_lines_are_not_there(tmp_path, line):
    import zlib

    path = tmp_path / "j.jsonl"
    path.write_bytes(line + b"\n" + line[:-1] + b', "crc": ' + str(zlib.crc32(line)).encode() + b"}\n")
    with Journal(path) as journal:
        assert journal.entries == {}


def test_threads_do_not_mix_their_lines(tmp_path):
    with Journal(tmp_path / "j.jsonl") as journal:

        def work(t: int) -> None:
            for i in range(50):
                journal.add(KEY._replace(shot=f"{t}-{i}"), Entry(1, 1, nothing("x" * 3000)))

        threads = [threading.Thread(target=work, args=(t,)) for t in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    with Journal(tmp_path / "j.jsonl") as journal:
        assert len(journal.entries) == 200


def test_a_journal_of_impossible_points_is_not_believed(tmp_path):
    make(tmp_path, cameras=1)
    detect_folder(tmp_path, Spot(), overlays=False)
    path = tmp_path / "detections" / "journal.jsonl"
    with Journal(path) as journal:
        key, entry = next(iter(journal.entries.items()))
        journal.add(key, replace(entry, found=replace(entry.found, uv=np.full((1, 2), 1e9))))
    assert detect_folder(tmp_path, Spot(), overlays=False).resumed == 2


# --- pictures to look at ---------------------------------------------------------------------------------------------


def stamps(folder: Path) -> dict[str, int]:
    return {p.relative_to(folder).as_posix(): p.stat().st_mtime_ns for p in (folder / "detections").rglob("*.jpg")}


def test_what_cannot_be_drawn_costs_a_mark_and_not_the_picture(tmp_path):
    make(tmp_path, cameras=1)

    @dataclass(frozen=True)
    class Odd(Spot):
        def detect(self, picture, view):
            far = np.array([[np.nan, 1.0], [3e12, -1e30], [5.0, 5.0]])
            if view.shot == "p1":
                return nothing("unsure", others=(Detected(("a", "b", "c"), far, np.ones((3, 2))),))
            return replace(super().detect(picture, view), outlines=(far, far[:0], far[:1]))

    run = detect_folder(tmp_path, Odd())
    assert run.notes == ()
    assert run.data.observations.seen.sum() == 2


def test_only_what_shows_something_else_is_drawn_again(tmp_path):
    make(tmp_path)
    detect_folder(tmp_path, Spot())
    first = stamps(tmp_path)
    assert len(first) == 8
    detect_folder(tmp_path, Spot())
    assert stamps(tmp_path) == first

    (tmp_path / "detections" / "overlays" / "cam1" / "p1.jpg").unlink()
    (tmp_path / "detections" / "cam2.jpg").unlink()
    detect_folder(tmp_path, Spot())
    assert {name for name, at in stamps(tmp_path).items() if first[name] != at} == {
        "detections/overlays/cam1/p1.jpg", "detections/cam2.jpg",
    }  # fmt: skip

    first = stamps(tmp_path)
    detect_folder(tmp_path, Settling())  # other results from the same pictures
    changed = {name for name, at in stamps(tmp_path).items() if first[name] != at}
    assert changed == {"detections/cam2.jpg", *(f"detections/overlays/cam2/p{i}.jpg" for i in (1, 2, 3))}

    (tmp_path / "images" / "cam1" / "p3.png").unlink()
    detect_folder(tmp_path, Spot())
    assert not (tmp_path / "detections" / "overlays" / "cam1" / "p3.jpg").exists()
    detect_folder(tmp_path, Spot(), overlays=False)


@pytest.mark.parametrize("content", [b"{", b"[1]", b'{"../../outside.jpg": "x"}', b"\xff"])
def test_a_damaged_record_of_drawings_hurts_nobody(tmp_path, content):
    rig = make(tmp_path / "rig", cameras=1)
    (tmp_path / "outside.jpg").write_bytes(b"mine")
    detect_folder(rig, Spot())
    (rig / "detections" / "drawn.json").write_bytes(content)
    detect_folder(rig, Spot())
    assert (tmp_path / "outside.jpg").read_bytes() == b"mine"


def test_long_cameras_take_several_sheets_of_names_of_their_own(tmp_path):
    for shot in range(PAGE_COLUMNS * PAGE_ROWS + 1):
        put(tmp_path / "images" / "cam" / f"{shot}.png", photograph((20, 20), (40, 40)))
    put(tmp_path / "images" / "cam-2" / "0.png", photograph((20, 20), (40, 40)))
    run = detect_folder(tmp_path, Spot(), unit="mm")
    assert [path.name for path in run.sheets] == ["cam.jpg", "cam-2_.jpg", "cam-2.jpg"]
    assert len({path.read_bytes() for path in run.sheets}) == 3


def test_a_drawing_that_cannot_be_written_is_a_note(tmp_path):
    make(tmp_path, cameras=1)
    (tmp_path / "detections" / "overlays" / "cam1" / "p2.jpg").mkdir(parents=True)
    run = detect_folder(tmp_path, Spot())
    assert any("p2.jpg is not drawn" in note for note in run.notes)
    assert len(read_dataset(tmp_path)) == 3


def near(canvas: np.ndarray, u: float, v: float, colour) -> bool:
    part = canvas[max(0, round(v) - 2) : round(v) + 3, max(0, round(u) - 2) : round(u) + 3].astype(int)
    return bool((np.abs(part - colour).sum(axis=2) < 60).any())


@pytest.mark.parametrize("shape", [(1, 1), (2, 900), (90, 120), (480, 640), (800, 1280), (2400, 3200), (3000, 20)])
def test_marks_are_where_the_points_are(shape):
    """The centre of a mark, weighed by its colour, is the point, at every scale."""
    uv = np.array([[0.31 * shape[1], 0.63 * shape[0]]])
    for found in (
        Detected(("p1",), uv, np.ones((1, 2))),
        Detected(("p1",), uv, np.ones((1, 2)), "why", (uv + np.array([[-5, 0], [0, 5], [5, 0]]),)),
        nothing("a reason " * 60),
    ):
        result = Result(View("cam", "shot"), Path("x"), found, 2)
        grey = np.full(shape, 128, np.uint8)
        canvas = draw_overlay(grey, result)
        assert canvas.dtype == np.uint8
        assert max(canvas.shape) < 2600
        assert draw_thumbnail(grey, result).shape == draw_thumbnail(None, result).shape
    if 90 <= shape[0] <= 800 and shape[1] <= 1280:
        uv = np.concatenate([uv, [[0.8 * shape[1], 0.1 * shape[0]]]])  # far apart: nothing is shown enlarged
        plain = Result(View("cam", "shot"), Path("x"), Detected(("", ""), uv, np.ones((2, 2))))
        scale = {90: 13, 480: 2, 800: 1}[shape[0]]
        canvas = draw_overlay(np.full(shape, 128, np.uint8), plain).astype(float)
        canvas = canvas[: shape[0] * scale, : shape[1] * scale]
        at = (uv[0] + 0.5) * scale - 0.5
        window = canvas[round(at[1]) - 20 : round(at[1]) + 21, round(at[0]) - 20 : round(at[0]) + 21]
        weight = np.abs(window - 128).sum(axis=2)
        v, u = np.mgrid[-20:21, -20:21]
        centre = np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()
        np.testing.assert_allclose(np.round(at) + centre, at, atol=0.12)


def board(rows=8, columns=11, step=40.0) -> Detected:
    j = np.arange(rows * columns)
    uv = np.stack([60 + step * (j % columns), 50 + step * (j // columns)], axis=1).astype(float)
    return Detected(tuple(f"s-c{i + 1:03d}" for i in j), uv, np.ones((len(j), 2)))


def test_rows_of_a_board_are_joined_and_no_row_to_the_next():
    from implicam.detect.overlay import _join_rows
    from implicam.drawing import SKY

    found = board()
    chains = _join_rows(found.points, found.uv)
    assert [len(chain) for chain in chains] == [11] * 8
    whole = replace(found, uv=found.uv + 0.25)  # drawn twice as large, its lines lie on rows of pixels
    canvas = draw_overlay(np.full((480, 640), 128, np.uint8), Result(View("c", "s"), Path("x"), whole))
    assert near(canvas, 161, 101, SKY)  # between numbers 1 and 2
    assert not near(canvas, 121, 141, SKY)  # between numbers 1 and 12
    holes = np.ones(88, bool)
    holes[[3, 14]] = False
    part = Detected(tuple(np.array(found.points)[holes]), found.uv[holes], found.sd[holes])
    assert [len(chain) for chain in _join_rows(part.points, part.uv)] == [3, 7, 3, 7] + [11] * 6
    assert _join_rows(("a", "b"), found.uv[:2]) == []


def test_states_are_told_apart():
    def state(found, expected=None):
        return Result(View("c", "s"), Path("x"), found, expected)

    whole = board()
    assert state(whole).state == state(whole, 88).state == "found"
    assert state(whole, 89).state == state(replace(whole, reason="one is covered")).state == "partly found"
    assert state(nothing("dark"), 88).state == "nothing found"
    assert (state(whole, 89).summary, state(nothing("")).summary) == ("88 of 89 points", "nothing found")
    grey = eight_bit(np.random.default_rng(0).random((480, 640), dtype=np.float32))
    for result in (state(whole), state(whole, 89), state(nothing("dark"))):
        tile = draw_thumbnail(grey, result)
        assert near(tile, 1, 100, STATES[result.state])


def test_text_that_no_font_has_is_no_problem():
    found = nothing("Grüße 漢字 \x00 \ud800 ∞ " * 3)
    canvas = draw_overlay(np.full((90, 120), 128, np.uint8), Result(View("Kamera Süd", "漢字"), Path("x"), found))
    assert canvas.shape[1] >= 560


@dataclass(frozen=True)
class SpotOnBoard(Spot):
    """It says that what it looks for is a board."""

    square: float | None = 20.0

    def describe(self):
        return {"kind": "board", "rows": 3, "columns": 4} | ({"square": self.square} if self.square else {})


def target_after(folder, text=None, detector=None):
    """[target] of dataset.toml after a run; text: what a person wrote into it."""
    for camera in (1, 2):
        put(folder / "images" / f"cam{camera}" / "p1.png", photograph(place(camera, 1)))
    if text is not None:
        (folder / "dataset.toml").write_text(text)
    unit = None if text else "mm"
    run = detect_folder(folder, detector or SpotOnBoard(), unit=unit, overlays=False)
    return read_dataset(folder).extra.get("target"), run.notes


BY_HAND = 'name = "mine"  # my rig\nlength_unit = "mm"\n[[cameras]]\nname = "cam1"\n[[cameras]]\nname = "cam2"\n'
WHOLE = {"kind": "board", "rows": 3, "columns": 4, "square": 20.0}


def test_the_board_is_written_where_a_calibration_looks_for_it(tmp_path):
    assert target_after(tmp_path / "new")[0] == WHOLE
    target, notes = target_after(tmp_path / "told", BY_HAND)
    assert target == WHOLE
    assert any("now says what was looked for" in note for note in notes)
    assert (tmp_path / "told" / "dataset.toml").read_text().startswith(BY_HAND.rstrip())
    part = (
        'name = "a"\nlength_unit = "mm"\n[target]  # the old board\nkind = "board"\nrows = 3\n'
        + BY_HAND[BY_HAND.index("[[") :]
    )
    assert target_after(tmp_path / "part", part)[0] == WHOLE
    assert "# the old board" in (tmp_path / "part" / "dataset.toml").read_text()
    before = (tmp_path / "part" / "dataset.toml").read_bytes()
    assert target_after(tmp_path / "part", before.decode(), SpotOnBoard(square=20.0000001))[0] == WHOLE
    assert (tmp_path / "part" / "dataset.toml").read_bytes() == before


def test_a_square_of_unknown_size_is_told_and_can_be_given_later(tmp_path):
    target, notes = target_after(tmp_path, detector=SpotOnBoard(square=None))
    assert target == {"kind": "board", "rows": 3, "columns": 4}
    assert any("--square" in note for note in notes)
    assert target_after(tmp_path, (tmp_path / "dataset.toml").read_text())[0] == WHOLE


def test_a_board_that_contradicts_dataset_toml_is_refused_before_the_work(tmp_path):
    said = BY_HAND + '[target]\nkind = "board"\nrows = 3\ncolumns = 4\nsquare = 25.0\n'
    with pytest.raises(UsageError, match=r"square = 25\.0, and detect was told 20\.0"):
        target_after(tmp_path / "a", said)
    assert not (tmp_path / "a" / "observations.csv").exists()
    in_metres = BY_HAND.replace('"mm"', '"m"')
    with pytest.raises(UsageError, match=r"20 m is no size for a board"):
        target_after(tmp_path / "b", in_metres)
    other = BY_HAND + '[target]\nkind = "ball"\nradius = 8.0\n'
    target, notes = target_after(tmp_path / "c", other)
    assert target == {"kind": "ball", "radius": 8.0}
    assert any("another one" in note for note in notes)
