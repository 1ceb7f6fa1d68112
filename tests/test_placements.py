"""Where cameras are drawn: names of rigs, and drawings in files, in which every mistake is an error with a cure."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from implicam.errors import UsageError
from implicam.simulate import build_rig, named_placement, placement_of, read_placement
from implicam.simulate.placements import grid_rows

DRAWING = """
name = "two"
workspace = [[-120, 120], [-80, 80], [0, 240]]

[every_camera]
size = [1280, 1024]
look_at = [0, 0, 120]
fov_deg = 40

[[cameras]]
name = "left"
position = [-400, 0, -500]

[[cameras]]
position = [400, 0, -500]
fov_deg = 100
noise = 0.1
"""


def drawn(folder: Path, text: str) -> Path:
    path = folder / "rig.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("n", "rows"), [(2, [2]), (4, [2, 2]), (7, [3, 2, 2]), (9, [3] * 3), (12, [4] * 3), (24, [6] * 4), (48, [8] * 6)]
)
def test_a_grid_of_n_cameras_is_no_stripe(n: int, rows: list[int]) -> None:
    assert grid_rows(n) == rows


def test_every_grid_has_the_cameras_it_was_asked_for() -> None:
    for n in range(2, 120):
        assert sum(grid_rows(n)) == n
        assert len(named_placement(f"grid{n}").mounts) == n


def test_a_grid_of_columns_and_rows_stands_in_a_plane_and_looks_at_the_middle() -> None:
    rig = build_rig("grid4x3", seed=0, frame="bench", as_drawn=True, lens_error=0)
    centres = np.array([camera.camera_from_world.centre for camera in rig.cameras])
    assert len({tuple(np.round(row[:2], 6)) for row in centres}) == 12
    assert len(set(np.round(centres[:, 0], 6))) == 4
    assert len(set(np.round(centres[:, 1], 6))) == 3
    np.testing.assert_allclose(centres[:, 2], -380)
    for camera in rig.cameras:
        uv, seen = camera.pixel_from_world(np.zeros((1, 3)))
        assert seen.all()
        np.testing.assert_allclose(uv[0], [(camera.width - 1) / 2, (camera.height - 1) / 2], atol=1e-6)


@pytest.mark.parametrize("spec", ["bar1", "grid1x1", "grid0", "dome0", "grid99x99", "grid3x", "bar1000", "circle4"])
def test_a_name_that_means_no_rig(spec: str) -> None:
    with pytest.raises(UsageError, match="there is no rig"):
        placement_of(spec)


def test_a_set_of_the_paper_is_a_rig() -> None:
    rig, same = build_rig("2R2W", seed=3), build_rig("bar6", seed=3, cameras="2R2W")
    assert [camera.name for camera in rig.cameras] == ["cam2", "cam3", "cam4", "cam5"]
    np.testing.assert_array_equal(
        rig.cameras[0].camera_from_world.translation, same.cameras[0].camera_from_world.translation
    )


def test_a_drawing_is_built_where_it_was_drawn(tmp_path: Path) -> None:
    path = drawn(tmp_path, DRAWING)
    rig = build_rig(str(path), seed=0, as_drawn=True, lens_error=0)
    left, second = rig.cameras
    assert (rig.name, rig.length_unit, rig.frame) == ("two", "mm", "bench")
    assert (left.name, second.name, left.noise_sd, second.noise_sd) == ("left", "cam2", 0.2, 0.1)
    np.testing.assert_allclose(left.camera_from_world.centre, [-400, 0, -500], atol=1e-9)
    np.testing.assert_allclose(left.lens.fx, 640 / np.tan(np.radians(20)))
    np.testing.assert_allclose(second.lens.fx, 640 / np.radians(50))  # a wide one is equidistant
    uv, _ = left.pixel_from_world(np.array([[0.0, 0.0, 120.0]]))
    np.testing.assert_allclose(uv, [[639.5, 511.5]], atol=1e-6)
    np.testing.assert_allclose(rig.volume.world_from_box.translation, [0, 0, 120])
    np.testing.assert_allclose(rig.volume.size, [240, 160, 240])


def test_built_rigs_differ_from_the_drawing_by_as_much_as_it_says(tmp_path: Path) -> None:
    def away(text: str) -> float:
        rig = build_rig(str(drawn(tmp_path, text)), seed=5)
        return float(np.linalg.norm(rig.cameras[0].camera_from_world.centre - [-400, 0, -500]))

    assert 0.5 < away(DRAWING) < 20
    assert away(f"spread = 0\n{DRAWING}") < 1e-9


def test_metres_and_other_ways_to_say_the_same(tmp_path: Path) -> None:
    path = drawn(tmp_path, DRAWING)
    a = build_rig(str(path), seed=0, as_drawn=True)
    focal = 640 / np.tan(np.radians(20))
    other = f"""
        length_unit = "m"
        workspace = [[-0.12, 0.12], [-0.08, 0.08], [0, 0.24]]
        [[cameras]]
        position = [-0.4, 0, -0.5]
        rotation = {a.cameras[0].camera_from_world.rotation.tolist()}
        size = [1280, 1024]
        lens = "brown-conrady"
        focal_mm = {focal * 3e-3}
        pixel_um = 3.0
        [[cameras]]
        position = [0.4, 0, -0.5]
        rotation_vector = [0, 0, 0]
        size = [1280, 1024]
        focal_px = 800
        distortion = [-0.05]
    """
    b = build_rig(str(drawn(tmp_path, other)), seed=0, as_drawn=True)
    assert b.length_unit == "m"
    np.testing.assert_allclose(b.cameras[0].lens.fx, focal)
    np.testing.assert_allclose(
        1e3 * b.cameras[0].camera_from_world.translation, a.cameras[0].camera_from_world.translation, atol=1e-9
    )
    assert b.cameras[1].lens.family == "kannala-brandt"
    assert vars(b.cameras[1].lens)["k1"] == -0.05
    np.testing.assert_allclose(b.volume.size, 1e-3 * a.volume.size)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("name", "nmae", "'nmae' is not known (did you mean 'name'?)"),
        ('name = "two"', "name = 3", "name = 3 must be a short text"),
        ('name = "two"', 'length_unit = "inch"', "length_unit = 'inch' is not known"),
        ('name = "two"', "spread = -1", "spread = -1 must be a number"),
        ('name = "two"', "spread = true", "spread = True must be a number"),
        ("workspace = [[-120, 120]", "workspace = [[120, -120]", "is empty"),
        ("workspace = [[-120, 120]", "workspace = [[nan, 120]", "is no box"),
        ("workspace = [[-120, 120], ", "workspace = [", "is no box"),
        ("[every_camera]", "every_camera = 3\n[x]", "'x' is not known"),
        ("size = [1280, 1024]", "size = [1280.5, 1024]", "size = [1280.5, 1024] must be width and height"),
        ("size = [1280, 1024]", "size = [1280, -1]", "must be width and height"),
        ("size = [1280, 1024]", "size = [1e9, 1e9]", "must be width and height"),
        ("size = [1280, 1024]", "", "size = None must be width and height"),
        ("fov_deg = 40", "", "camera 1 ('left') does not say its lens"),
        ("fov_deg = 40", 'fov_deg = 200\nlens = "brown-conrady"', "is more than a brown-conrady lens sees"),
        ("fov_deg = 40", "fov_deg = 400", "fov_deg = 400 must be a number from"),
        ("fov_deg = 40", 'fov_deg = "40"', "fov_deg = '40' must be a number"),
        ("fov_deg = 40", "fov_deg = inf", "fov_deg = inf must be a number"),
        ("fov_deg = 40", "focal_mm = 8", "has focal_mm and no pixel_um"),
        ("fov_deg = 40", "fov_deg = 40\nfocal_px = 800", "says its lens 2 times"),
        ("fov_deg = 40", 'fov_deg = 40\nlens = "kanala"', "lens = 'kanala' is not known (did you mean"),
        ("fov_deg = 40", "fov_deg = 40\ndistortion = [1,2,3,4,5,6,7]", "must be up to 5 numbers"),
        ("fov_deg = 40", "fov_deg = 40\npixel_um = 3", "pixel_um goes with focal_mm"),
        ("look_at = [0, 0, 120]", "", "does not say where it looks"),
        ("look_at = [0, 0, 120]", "look_at = [-400, 0, -500]", "is where the camera stands"),
        ("look_at = [0, 0, 120]", "look_at = [0, 0]", "must be three numbers"),
        ("look_at = [0, 0, 120]", "look_at = [0, 0, 120]\nup = [0, 0, 0]", "has no direction"),
        ("look_at = [0, 0, 120]", "rotation = [[1,0,0],[0,1,0],[0,0,2]]", "is no rotation"),
        ("look_at = [0, 0, 120]", "rotation = [[-1,0,0],[0,1,0],[0,0,1]]", "is no rotation"),
        ("position = [-400, 0, -500]", "", "camera 1 ('left') has no position"),
        ("position = [-400, 0, -500]", "position = [1e99, 0, 0]", "position = [1e+99, 0, 0] must be three numbers"),
        ("noise = 0.1", "noise = -0.1", "camera 2: noise = -0.1 must be a number"),
        ("noise = 0.1", 'name = "left"', "two cameras are called 'left'"),
        ("noise = 0.1", 'name = "../x"', "cannot name a folder"),
        ("noise = 0.1", "colour = 3", "'colour' is not known"),
        ("[[cameras]]", "[[camera]]", "'camera' is not known (did you mean 'cameras'?)"),
        ("[[cameras]]", "[[cameras", "not valid TOML"),
    ],
)
def test_every_mistake_of_a_drawing_is_named(tmp_path: Path, old: str, new: str, said: str) -> None:
    count = -1 if "cameras]]" in old else 1
    with pytest.raises(UsageError) as error:
        read_placement(drawn(tmp_path, DRAWING.replace(old, new, count)))
    assert said in str(error.value)
    assert error.value.fix


def test_files_that_are_no_drawing(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="there is no file"):
        build_rig(str(tmp_path / "none.toml"), seed=0)
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(UsageError, match="is no file"):
        build_rig(str(tmp_path / "folder.toml"), seed=0)
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UsageError, match="not UTF-8"):
        build_rig(str(tmp_path / "binary.toml"), seed=0)
    (tmp_path / "large.toml").write_bytes(b"#" * (1 << 21))
    with pytest.raises(UsageError, match="no drawing"):
        build_rig(str(tmp_path / "large.toml"), seed=0)
    one = drawn(tmp_path, DRAWING.split("[[cameras]]")[0] + "[[cameras]]\nposition = [1, 2, 3]\n")
    with pytest.raises(UsageError, match="2 to 999 cameras, and this one has 1"):
        build_rig(str(one), seed=0)
    nowhere = drawn(tmp_path, DRAWING.replace("workspace", "#"))
    with pytest.raises(UsageError, match="does not say what its cameras watch"):
        build_rig(str(nowhere), seed=0)
