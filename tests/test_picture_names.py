"""Names of pictures as people give them: read in the one way in which they can be, or refused."""

from pathlib import Path

import pytest

from implicam.errors import ImageError
from implicam.picture_names import find_pictures, sort_pictures


def touch(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")
    return folder


def read(folder: Path, *names: str, cameras=()) -> dict[str, list[str]]:
    found = sort_pictures(touch(folder, *names), cameras)
    return {camera: list(shots) for camera, shots in found.pictures.items()}


PAIRS = [(side, k) for side in ("left", "right") for k in (1, 2, 10)]


@pytest.mark.parametrize(
    ("names", "cameras"),
    [
        ([f"{side}{k}.jpg" for side, k in PAIRS], ["left", "right"]),  # OpenCV's, and of most stereo repositories
        ([f"{side}{k:02d}.jpg" for side, k in PAIRS], ["left", "right"]),
        ([f"{side}-{k:04d}.png" for side, k in PAIRS], ["left", "right"]),  # ROS's camera_calibration
        ([f"{k:03d}_{side[0].upper()}.png" for side, k in PAIRS], ["L", "R"]),
        ([f"img_{side}_{k}_rect.png" for side, k in PAIRS], ["left", "right"]),
        ([f"{side}Image{k}.png" for side, k in PAIRS], ["leftImage", "rightImage"]),
        ([f"img{side[0].upper()}{k}.png" for side, k in PAIRS], ["imgL", "imgR"]),
        ([f"cam{c}_{k:04d}.png" for c in (0, 1) for k in range(3)], ["cam0", "cam1"]),
        ([f"frame{k}_cam_{c}.png" for c in (1, 2) for k in range(3)], ["cam_1", "cam_2"]),
        ([f"c{c}s{k:03d}.tif" for c in (1, 2, 10) for k in range(3)], ["c1", "c2", "c10"]),
        ([f"0{c}_{k:04d}.png" for c in (0, 1) for k in range(9)], ["cam00", "cam01"]),  # 2 numbers and 9
        ([f"{k}_2024-05-01-12-00-0{k}_{side}.png" for side, k in PAIRS], ["left", "right"]),
        ([f"left{c}_{k}.png" for c in (1, 2) for k in (1, 2)], ["left1", "left2"]),
        ([f"{side}{c}_{k}.png" for side in ("l", "r") for c in (1, 2) for k in (1, 2)], ["l1", "l2", "r1", "r2"]),
        (["webcam1.png", "webcam2.png", "phone_1.png", "phone_2.png"], ["phone", "webcam"]),
    ],
)
def test_usual_names_tell_camera_and_shot(tmp_path, names, cameras):
    found = sort_pictures(touch(tmp_path, *names))
    assert list(found.pictures) == cameras
    shots = {tuple(shots) for shots in found.pictures.values()}
    assert len(shots) == 1
    assert len(shots.pop()) * len(cameras) == len(names)
    assert found.notes[0].startswith("the pictures are in one folder")


def test_pictures_of_one_camera_alone_may_be_the_most(tmp_path):
    """Mrcal #38: some frames for each lens, a few in the middle that both cameras saw."""
    names = [f"frame{k:05d}-cam0.jpg" for k in range(7)] + [f"frame{k:05d}-cam1.jpg" for k in range(5, 12)]
    assert [len(shots) for shots in read(tmp_path, *names).values()] == [7, 7]


def test_camera_and_shot_twice_in_a_name(tmp_path):
    """Depthai #761: right/right_p3_3.png, left/left_p3_3.png."""
    names = [f"{side}/{side}_p{k}_{k}.png" for side in ("left", "right") for k in range(3)]
    assert read(tmp_path, *names) == {"left": ["p0_0", "p1_1", "p2_2"], "right": ["p0_0", "p1_1", "p2_2"]}


@pytest.mark.parametrize(
    "names",
    [
        ["1_01.png", "1_02.png", "2_01.png", "2_02.png"],  # either number may be the camera
        ["a.png", "b.png"],
        ["IMG_0001.JPG", "IMG_0002.JPG"],  # one camera, or two pictures of two
        ["left1.png", "right2.png"],  # nothing is shared
        ["left1.png", "right1.png", "x.png", "notes on it.png", "y.png"],
    ],
)
def test_names_that_can_be_read_in_two_ways_or_none_are_refused(tmp_path, names):
    with pytest.raises(ImageError, match="not clear which camera") as caught:
        read(tmp_path, *names)
    assert "--pattern" in caught.value.fix


def test_one_picture_with_another_name_is_left_out_and_told(tmp_path):
    found = sort_pictures(touch(tmp_path, "left1.png", "left2.png", "right1.png", "right2.png", "setup.jpg"))
    assert {camera: list(shots) for camera, shots in found.pictures.items()} == {
        "left": ["1", "2"],
        "right": ["1", "2"],
    }
    assert "setup.jpg" in found.notes[1]


def test_cameras_that_are_known_are_found_in_the_names(tmp_path):
    names = ["cam1-a.png", "cam10-a.png", "b_CAM1.png", "b_cam10.png"]
    assert read(tmp_path, *names, cameras=["cam1", "cam10"]) == {"cam1": ["a", "b"], "cam10": ["a", "b"]}


def test_folders_whose_files_carry_the_camera_are_joined(tmp_path):
    names = ["left/left_001.png", "left/left_002.png", "right/right_001.png", "right/right_002.png"]
    assert read(tmp_path / "a", *names) == {"left": ["001", "002"], "right": ["001", "002"]}
    names = ["left/000.png", "left/001.png", "right/0.png", "right/1.png"]
    assert read(tmp_path / "zeros", *names) == {"left": ["0", "1"], "right": ["0", "1"]}
    names = ["1/imgL01.png", "1/imgL02.png", "2/imgR01.png", "2/imgR02.png"]
    assert read(tmp_path / "b", *names) == {"1": ["01", "02"], "2": ["01", "02"]}
    names = ["1/a.png", "1/b.png", "2/c.png", "2/d.png"]  # boards shown to one camera at a time
    found = sort_pictures(touch(tmp_path / "c", *names))
    assert [list(shots) for shots in found.pictures.values()] == [["a", "b"], ["c", "d"]]
    assert "no two cameras share a shot" in found.notes[0]


def test_a_pattern_without_anything_between_splits_at_the_number(tmp_path):
    touch(tmp_path, "left1.jpg", "right1.jpg", "left12.jpg", "right12.jpg")
    found = find_pictures(tmp_path, "{camera}{shot}")
    assert {camera: list(shots) for camera, shots in found.items()} == {"left": ["1", "12"], "right": ["1", "12"]}
    touch(tmp_path / "b", "1L.png", "1R.png")
    assert list(find_pictures(tmp_path / "b", "{shot}{camera}")) == ["L", "R"]


def test_files_that_differ_in_their_ending_only_are_refused(tmp_path):
    with pytest.raises(ImageError, match="both the picture of shot '1'"):
        read(tmp_path, "left1.png", "left1.jpg", "right1.png", "right1.jpg")
