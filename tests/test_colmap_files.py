"""COLMAP's models as pycolmap writes them: text and binary, rigs that stand and rigs that move, lenses by a refit."""

import random
import re
import shutil

import numpy as np
import pytest

from implicam.errors import DatasetError, ImplicamError
from implicam.exchange import import_cameras
from implicam.exchange.colmap_files import MODEL_NUMBERS
from implicam.geometry import look_at
from test_exchange import damaged, points

pycolmap = pytest.importorskip("pycolmap")


AHEAD = points() + np.array([0, 0, 1.0])


def rigid(pose):
    return pycolmap.Rigid3d(np.column_stack([pose.rotation, pose.translation]))


SENSORS = [look_at(centre, [0, 0, 1], [0, 1, 0]) for centre in ([0, 0, -3], [0.4, 0, -3], [-0.3, 0.2, -2.9])]


def rig_model(frames):
    """A rig of three cameras, the first its frame, seen at the places given; each picture in its camera's folder."""
    model = pycolmap.Reconstruction()
    first = SENSORS[0].inverse()
    rig = pycolmap.Rig(rig_id=1)
    cameras = []
    for i, pose in enumerate(SENSORS):
        camera = pycolmap.Camera.create_from_model_name(5 + i, "OPENCV", 500.0 + i, 640, 480)
        camera.params = [500.0 + i, 505.0, 320.0, 240.0, -0.1, 0.01, 1e-3, 0.0]
        model.add_camera(camera)
        cameras.append(camera)
        rig.add_sensor(camera.sensor_id, rigid(pose @ first)) if i else rig.add_ref_sensor(camera.sensor_id)
    model.add_rig(rig)
    for f, pose in enumerate(frames, 1):
        frame = pycolmap.Frame(frame_id=f, rig_id=1, rig_from_world=rigid(SENSORS[0] @ pose))
        images = [
            pycolmap.Image(name=f"cam{c.camera_id}/{f:04}.png", camera_id=c.camera_id, image_id=10 * f + i, frame_id=f)
            for i, c in enumerate(cameras)
        ]
        for image in images:
            frame.add_data_id(image.data_id)
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
    return model


def written(model, path, form):
    path.mkdir()
    (model.write_text if form == "text" else model.write_binary)(path)
    return path


STILL = look_at([0, 0, 0], [0, 0, 1], [0, 1, 0])
MOVED = look_at([0.5, 0.1, 0], [0.3, 0, 1], [0, 1, 0])


@pytest.mark.parametrize("form", ["text", "binary"])
@pytest.mark.parametrize("frames", [[MOVED], [MOVED, MOVED]], ids=["one", "two of the same place"])
def test_a_rig_that_stands_is_its_sensors_in_the_world(tmp_path, form, frames):
    model = rig_model(frames)
    rig = import_cameras(written(model, tmp_path / "m", form))
    assert [c.name for c in rig.cameras] == ["cam5", "cam6", "cam7"]
    assert len(rig.notes) == 1  # the unit
    images = {image.name.split("/")[0]: image for image in model.images.values()}
    for camera in rig.cameras:
        image = images[camera.name]
        seen = image.camera.img_from_cam(image.cam_from_world() * AHEAD)
        np.testing.assert_allclose(camera.pixel_from_world(AHEAD)[0], seen - 0.5, atol=1e-6)


@pytest.mark.parametrize("form", ["text", "binary"])
def test_a_rig_that_moved_is_one_camera_a_sensor_in_its_own_frame(tmp_path, form):
    """Four moments of three cameras are three cameras, not twelve; images.txt is not asked for the places, as COLMAP
    4.2.0 writes images that do not agree with its frames (colmap/colmap issue 4752)."""
    model = rig_model([STILL, MOVED, MOVED, STILL])
    path = written(model, tmp_path / "m", form)
    if form == "text":
        stale = re.sub(
            r"^(\d+) \S+ \S+ \S+ \S+ \S+ \S+ \S+", r"\1 1 0 0 0 9 9 9", (path / "images.txt").read_text(), flags=re.M
        )
        (path / "images.txt").write_text(stale)
    rig = import_cameras(path)
    assert [c.name for c in rig.cameras] == ["cam5", "cam6", "cam7"]
    assert "The rig moved" in rig.notes[0]
    for camera, pose in zip(rig.cameras, SENSORS, strict=True):
        np.testing.assert_allclose(camera.camera_from_world.centre, (pose @ SENSORS[0].inverse()).centre, atol=1e-12)


def test_binary_without_rigs_is_what_the_text_is(tmp_path):
    """Models before COLMAP 3.12 have no rigs; files of images with points in them."""
    text, binary = (written(rig_model([MOVED]), tmp_path / form, form) for form in ("text", "binary"))
    for path, ending in ((text, "txt"), (binary, "bin")):
        for name in ("rigs", "frames"):
            (path / f"{name}.{ending}").unlink()
    one, two = (import_cameras(given) for given in (text, binary / "cameras.bin"))
    assert [c.name for c in one.cameras] == [c.name for c in two.cameras] == ["cam5", "cam6", "cam7"]
    for a, b in zip(one.cameras, two.cameras, strict=True):
        assert a.lens == b.lens
        np.testing.assert_allclose(a.camera_from_world.translation, b.camera_from_world.translation, atol=1e-15)


REFITTED = {
    "FOV": [400.0, 402, 320, 240, 0.9],
    "EUCM": [300.0, 301, 320, 240, 0.6, 1.1],
    "THIN_PRISM_FISHEYE": [300.0, 301, 320, 240, -0.03, 0.01, 1e-4, -2e-4, 1e-3, -1e-4, 1e-4, 2e-4],
    "FULL_OPENCV": [500.0, 501, 320, 240, -0.3, 0.1, 1e-3, -1e-3, 0.01, 0.05, 0.01, 0.002],
    "SIMPLE_DIVISION": [500.0, 320, 240, -0.2],
    "DIVISION": [500.0, 505, 320, 240, -0.2],
}


@pytest.mark.parametrize("form", ["text", "binary"])
@pytest.mark.parametrize("model", REFITTED)
def test_lenses_of_colmap_that_are_not_here_are_refitted_within_what_is_told(tmp_path, model, form):
    camera = pycolmap.Camera.create_from_model_name(1, model, 500.0, 640, 480)
    camera.params = REFITTED[model]
    made = pycolmap.Reconstruction()
    made.add_camera_with_trivial_rig(camera)
    made.add_image_with_trivial_frame(pycolmap.Image(name="a.png", camera_id=1, image_id=1), rigid(STILL))
    rig = import_cameras(written(made, tmp_path / "m", form))
    cost = float(re.search(r"at most ([\d.e-]+) px", rig.notes[0])[1])
    uv = np.stack(np.meshgrid(np.linspace(0.5, 639.5, 30), np.linspace(0.5, 479.5, 30)), -1).reshape(-1, 2)
    rays = camera.cam_from_img(uv)
    xyz = np.column_stack([rays[:, :2], np.ones(len(rays))])
    theirs = camera.img_from_cam(xyz)
    pose = rig.cameras[0].camera_from_world
    ours = rig.cameras[0].pixel_from_world(STILL.inverse().apply(xyz))[0]
    assert cost < 0.5
    assert np.isfinite(pose.translation).all()
    assert np.linalg.norm(ours + 0.5 - theirs, axis=1).max() < 1.15 * cost + 1e-6


def test_the_numbers_of_the_models_are_colmaps():
    names = {name: int(number) for name, number in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}
    assert {name: number for name, (number, _) in MODEL_NUMBERS.items()} == names
    for name, (_, count) in MODEL_NUMBERS.items():
        assert len(pycolmap.Camera.create_from_model_name(1, name, 500.0, 640, 480).params) == count


@pytest.mark.parametrize("form", ["text", "binary"])
def test_damaged_models_are_clear_errors_or_whole_rigs(tmp_path, form):
    path = written(rig_model([STILL, MOVED]), tmp_path / "m", form)
    rng, errors = random.Random(1), []
    inner = [file for file in sorted(path.iterdir()) if not file.name.startswith("points")]
    for round_ in range(160):
        file = inner[round_ % len(inner)]
        good = file.read_bytes()
        file.write_bytes(damaged(good, round_ % 2, rng))
        try:
            assert import_cameras(path).cameras
        except ImplicamError as error:
            errors.append(error)
        file.write_bytes(good)
    assert len(errors) > 50
    assert [error for error in errors if not error.fix] == []


def test_hostile_binary_files_are_refused_at_once(tmp_path):
    path = written(rig_model([STILL]), tmp_path / "m", "binary")
    good = (path / "images.bin").read_bytes()
    (path / "images.bin").write_bytes(b"\xff" * 8 + good[8:])
    with pytest.raises(DatasetError, match=r"images.bin, byte 0: 18,446,744,073,709,551,615 entries"):
        import_cameras(path)
    (path / "images.bin").write_bytes(good[:100])
    with pytest.raises(DatasetError, match="ends at byte 100, in the middle of an entry"):
        import_cameras(path)
    (path / "images.bin").write_bytes(good)
    cameras = (path / "cameras.bin").read_bytes()
    (path / "cameras.bin").write_bytes(cameras[:12] + b"\x63\0\0\0" + cameras[16:])
    with pytest.raises(DatasetError, match="the lens model of number 99 is not known"):
        import_cameras(path)
    shutil.rmtree(path)
