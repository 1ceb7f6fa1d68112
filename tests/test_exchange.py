"""Explicit cameras in other programs' files, judged by the other program's own reader where it can be installed."""

import random
import re
import tomllib
from dataclasses import astuple, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from implicam.errors import DatasetError, ImplicamError, UsageError
from implicam.exchange import UNKNOWN_UNIT, ExplicitCamera, Rig, dlt, export_cameras, import_cameras
from implicam.exchange.colmap import MODELS
from implicam.exchange.colmap_files import MODEL_NUMBERS
from implicam.geometry import Pose, look_at, resect, rotation_from_vector
from implicam.lenses import BrownConrady, KannalaBrandt

DATA = Path(__file__).parent / "data" / "exchange"
FILES = {
    "opencv": "rig.yml",
    "kalibr": "camchain.yaml",
    "colmap": "model",
    "aniposelib": "calibration.toml",
    "pose2sim": "Calib.toml",
    "dlt": "lab.csv",
}
HOLDS_FISHEYE = ("opencv", "kalibr", "colmap", "aniposelib")
UNITS = {"opencv": "m", "kalibr": "m", "pose2sim": "m"}  # the others keep the rig's own


def random_rig(seed, *, n=3, unit="m", coefficients=5, fisheye=True):
    """Cameras around the origin that see it, with lenses from strong barrel to mild pincushion."""
    rng = np.random.default_rng(seed)
    cameras = []
    for i in range(n):
        centre = rng.normal(size=3)
        pose = look_at(3 * centre / np.linalg.norm(centre), 0.2 * rng.normal(size=3), rng.normal(size=3))
        focal, middle = rng.uniform(900, 1500, 2), [640, 400] + 10 * rng.normal(size=2)
        distortion = [rng.uniform(-0.2, 0.05), rng.uniform(0, 0.05), *rng.normal(0, 1e-3, 2), rng.uniform(-0.02, 0.02)]
        lens = BrownConrady(*focal, *middle, *distortion[:coefficients])
        if fisheye and rng.random() < 0.5:
            lens = KannalaBrandt(*focal / 2, *middle, *rng.normal(size=4) * [0.03, 0.01, 0.003, 0.001])
        cameras.append(ExplicitCamera(f"cam{i + 1}", 1280, 800, lens, pose))
    return Rig(tuple(cameras), unit)


def rig_for(kind, seed, **options):
    """A random rig that the format holds without loss."""
    coefficients = {"kalibr": 4, "pose2sim": 4, "dlt": 0}.get(kind, 5)
    return random_rig(seed, coefficients=coefficients, fisheye=kind in HOLDS_FISHEYE, **options)


def points(seed=0, n=40):
    return np.random.default_rng(seed).uniform(-0.5, 0.5, (n, 3))


def exported(tmp_path, kind, rig):
    path = tmp_path / FILES[kind]
    notes = export_cameras(rig, kind, path)
    return path, notes


# ---- every format


@pytest.mark.parametrize("kind", FILES)
@settings(max_examples=12, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), n=st.integers(1, 12), unit=st.sampled_from(["m", "mm", "in"]))
def test_what_a_format_holds_comes_back(tmp_path_factory, kind, seed, n, unit):
    rig = rig_for(kind, seed, n=n, unit=unit)
    back = import_cameras(exported(tmp_path_factory.mktemp("x"), kind, rig)[0])
    assert back.length_unit == UNITS.get(kind, unit)
    assert [c.name for c in back.cameras] == [c.name for c in rig.cameras]
    for one, other in zip(rig.cameras, back.in_unit(unit).cameras, strict=True):
        assert (one.width, one.height) == (other.width, other.height)
        if kind == "dlt":  # the numbers are taken apart and put together again
            np.testing.assert_allclose(astuple(other.lens), astuple(one.lens), rtol=1e-8)
        else:
            np.testing.assert_allclose(astuple(other.lens), astuple(one.lens), rtol=1e-15, atol=2e-13)
        a, b = one.camera_from_world, other.camera_from_world
        np.testing.assert_allclose(b.rotation, a.rotation, atol=1e-9 if kind == "dlt" else 1e-14)
        np.testing.assert_allclose(b.translation, a.translation, rtol=0, atol=1e-8 if kind == "dlt" else 1e-14)


@pytest.mark.parametrize("kind", ["opencv", "kalibr", "aniposelib", "colmap"])
def test_numbers_come_back_to_the_last_bit(tmp_path, kind):
    """Numbers with no short form, tiny and huge ones: 1e-05 without a dot is text to a YAML reader."""
    odd = BrownConrady(1000 / 3, 1e5 / 7, 1e-05, -1e22 if kind != "colmap" else 0.0, 1e-300, 5e-324, 0.1, 1e16)
    fish = KannalaBrandt(1000 / 3, 1e3, 640.5, 0.0, 1e-05, -1e-17, 1 / 3, 2e-7)
    pose = Pose(np.eye(3), [1 / 3, 1e-05, -1e22])
    rig = Rig(tuple(ExplicitCamera(f"c{i}", 640, 480, lens, pose) for i, lens in enumerate((odd, fish))), "m")
    back = import_cameras(exported(tmp_path, kind, rig)[0])
    for one, other in zip(rig.cameras, back.cameras, strict=True):
        if kind == "colmap":  # adds half a pixel and takes it away
            np.testing.assert_allclose(astuple(other.lens)[:4], astuple(one.lens)[:4], atol=1e-13)
            assert astuple(other.lens)[4:] == astuple(one.lens)[4:]
        else:
            assert other.lens == one.lens
        assert (other.camera_from_world.translation == pose.translation).all()


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize(
    "name", ["left", "cam 1", 'say "hi"', "a: b # c", "Kamera ü", "back`tick'", "[x]", "1", "null"]
)
def test_names_come_back(tmp_path, kind, name):
    rig = rig_for(kind, 1, n=2)
    rig = replace(rig, cameras=(replace(rig.cameras[0], name=name), rig.cameras[1]))
    path, notes = exported(tmp_path, kind, rig)
    kept = name.replace(" ", "_") if kind == "colmap" else name
    assert [c.name for c in import_cameras(path, kind).cameras] == [kept, "cam2"]
    assert ("Spaces in camera names became _." in notes) == (kept != name)


@pytest.mark.parametrize("kind", FILES)
def test_the_format_is_recognised(tmp_path, kind):
    path, _ = exported(tmp_path, kind, rig_for(kind, 2))
    assert import_cameras(path).length_unit == import_cameras(path, kind).length_unit
    text = path / "cameras.txt" if path.is_dir() else path
    assert len(import_cameras(text).cameras) == 3


def test_an_unknown_format_is_named(tmp_path):
    with pytest.raises(UsageError, match=r"no format 'colamp' .did you mean 'colmap'"):
        export_cameras(random_rig(0), "colamp", tmp_path / "x")
    (tmp_path / "x.txt").write_text("hello")
    with pytest.raises(DatasetError, match="not recognised"):
        import_cameras(tmp_path / "x.txt")


def test_the_unit_is_asked_for_and_checked(tmp_path):
    rig = replace(rig_for("aniposelib", 1), length_unit="mm")
    path, _ = exported(tmp_path, "aniposelib", rig)
    assert import_cameras(path).notes == ()
    foreign = tmp_path / "foreign.toml"
    foreign.write_text(path.read_text().replace('length_unit = "mm"\n', ""))
    unknown = import_cameras(foreign)
    assert unknown.length_unit == UNKNOWN_UNIT
    assert "length unit" in unknown.notes[-1]
    assert import_cameras(foreign, unit="mm").length_unit == "mm"
    with pytest.raises(DatasetError, match="is in 'mm', not in 'm'"):
        import_cameras(path, unit="m")
    with pytest.raises(DatasetError, match="'unknown', which has no known size"):
        export_cameras(unknown, "opencv", tmp_path / "x.yml")


@pytest.mark.parametrize("kind", ["opencv", "kalibr", "pose2sim"])
@pytest.mark.parametrize(("unit", "metres"), [("mm", 0.25), ("in", 6.35), ("m", 250.0)])
def test_lengths_become_metres(tmp_path, kind, unit, metres):
    lens = BrownConrady(900.0, 900.0, 640.0, 400.0)
    rig = Rig((ExplicitCamera("c", 1280, 800, lens, Pose(np.eye(3), [0.0, 0.0, 250.0])),), unit)
    back = import_cameras(exported(tmp_path, kind, rig)[0])
    assert back.length_unit == "m"
    np.testing.assert_allclose(back.cameras[0].camera_from_world.translation, [0, 0, metres], rtol=1e-15)


@pytest.mark.parametrize("kind", FILES)
def test_a_format_that_needs_the_image_size_says_so(tmp_path, kind):
    rig = rig_for(kind, 1)
    with pytest.raises(DatasetError, match="image size of camera 'cam1' is not known"):
        exported(tmp_path, kind, replace(rig, cameras=(replace(rig.cameras[0], width=None, height=None),)))
    assert list(tmp_path.iterdir()) == []  # nothing half-written


@pytest.mark.parametrize("kind", FILES)
def test_damaged_files_are_clear_errors_or_whole_rigs(tmp_path, kind):
    """300 files cut off, with bytes changed or with lines repeated: never another exception."""
    path, _ = exported(tmp_path, kind, rig_for(kind, 5))
    rng = random.Random(0)
    inner = [f for f in sorted(path.iterdir()) if f.name != "points3D.txt"] if path.is_dir() else [path]
    inner += [path.with_name("lab.csv.toml")] if kind == "dlt" else []
    errors = []
    for round_ in range(300):
        file = inner[round_ % len(inner)]
        good = file.read_bytes()
        file.write_bytes(damaged(good, round_ % 3, rng))
        try:
            rig = import_cameras(path, kind)
            assert all(np.isfinite(astuple(c.lens)).all() for c in rig.cameras)
        except ImplicamError as error:
            errors.append(error)
        file.write_bytes(good)
    assert len(errors) > 100
    assert [error for error in errors if str(path.parent) not in error.what] == []
    assert [error for error in errors if not error.fix] == []


def damaged(good, how, rng):
    """A file cut off, or with a few bytes changed, or with a line of it once more."""
    if how == 0:
        return good[: rng.randrange(len(good))]
    if how == 1:
        bad = bytearray(good)
        for _ in range(rng.randrange(1, 8)):
            bad[rng.randrange(len(bad))] = rng.choice(b'\0\n\t {}[]"&*!:-,.#enul9\xff')
        return bytes(bad)
    lines = good.splitlines(keepends=True)
    lines.insert(rng.randrange(len(lines)), rng.choice(lines))
    return b"".join(lines)


# ---- opencv


def by_opencv(lens, rotation, translation, xyz):
    k = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    project = cv2.fisheye.projectPoints if isinstance(lens, KannalaBrandt) else cv2.projectPoints
    rvec = cv2.Rodrigues(rotation)[0]
    return project(xyz[:, None], rvec, np.asarray(translation), k, np.array(astuple(lens)[4:]))[0].reshape(-1, 2)


def test_opencv_reads_the_file_and_sees_the_same_pixels(tmp_path):
    rig = random_rig(3, n=4)
    path, notes = exported(tmp_path, "opencv", rig)
    assert notes == []
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    nodes = storage.getNode("cameras")
    assert nodes.size() == 4
    kinds = set()
    for i, camera in enumerate(rig.cameras):
        node = nodes.at(i)
        assert node.getNode("name").string() == camera.name
        assert node.getNode("image_width").real() == 1280
        assert node.getNode("image_height").real() == 800
        fisheye = node.getNode("fisheye_model").real() == 1
        kinds.add(fisheye)
        k, d, r, t = (node.getNode(key).mat() for key in ("camera_matrix", "distortion_coefficients", "R", "T"))
        project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
        uv = project(points()[:, None], cv2.Rodrigues(r)[0], t, k, d)[0].reshape(-1, 2)
        np.testing.assert_allclose(uv, camera.pixel_from_world(points())[0], atol=1e-9)
    assert kinds == {True, False}


@pytest.mark.parametrize("ending", ["yml", "json", "xml"])
def test_files_that_opencv_writes_are_read(tmp_path, ending):
    """One camera with rvec and tvec, as OpenCV's own programs write it, and its format of floats."""
    camera = random_rig(4, fisheye=False).cameras[0]
    lens, pose = camera.lens, camera.camera_from_world
    path = tmp_path / f"front.{ending}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 1280)
    storage.write("image_height", 800)
    storage.write("camera_matrix", np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]]))
    storage.write("distortion_coefficients", np.array([astuple(lens)[4:]]))
    storage.write("rvec", cv2.Rodrigues(pose.rotation)[0])
    storage.write("tvec", pose.translation)
    storage.release()
    (read,) = import_cameras(path).cameras
    assert (read.name, read.width, read.height, read.lens) == ("front", 1280, 800, lens)
    np.testing.assert_allclose(read.camera_from_world.rotation, pose.rotation, atol=1e-12)
    np.testing.assert_array_equal(read.camera_from_world.translation, pose.translation)


# ---- kalibr


def test_kalibr_finds_the_types_and_the_chain_it_wants(tmp_path):
    """What Kalibr's reader checks: floats that are floats, whole sizes, four coefficients, T from the camera before."""
    rig = rig_for("kalibr", 6, n=4)
    lens = replace(rig.cameras[0].lens, cx=1e-05, cy=1e22)
    rig = replace(rig, cameras=(replace(rig.cameras[0], lens=lens), *rig.cameras[1:]))
    path, notes = exported(tmp_path, "kalibr", rig)
    assert len(notes) == 1
    assert "no world frame" in notes[0]
    chain = yaml.safe_load(path.read_text())
    assert list(chain) == ["cam0", "cam1", "cam2", "cam3"]
    in_first = points()
    in_camera = rig.cameras[0].camera_from_world.apply(in_first)
    for camera, table in zip(rig.cameras, chain.values(), strict=True):
        assert all(type(x) is float for key in ("intrinsics", "distortion_coeffs") for x in table[key])
        assert len(table["intrinsics"]) == len(table["distortion_coeffs"]) == 4
        assert [type(x) for x in table["resolution"]] == [int, int]
        assert isinstance(table["rostopic"], str)
        if camera is not rig.cameras[0]:
            t = np.array(table["T_cn_cnm1"])
            in_camera = in_camera @ t[:3, :3].T + t[:3, 3]
        assert table["camera_model"] == "pinhole"
        model = {"radtan": BrownConrady, "equidistant": KannalaBrandt}[table["distortion_model"]]
        seen = model(*table["intrinsics"], *table["distortion_coeffs"]).pixel_from_camera_point(in_camera)[0]
        np.testing.assert_allclose(seen, camera.pixel_from_world(in_first)[0], rtol=1e-12, atol=1e-8)


def test_a_chain_without_a_world_has_the_first_cameras(tmp_path):
    """The example of Kalibr's own documentation has eight digits, no world and keys of an IMU."""
    path = tmp_path / "camchain.yaml"
    path.write_text(KALIBR)
    rig = import_cameras(path)
    assert "first camera" in rig.notes[0]
    assert [c.name for c in rig.cameras] == ["cam0", "cam1"]
    assert rig.length_unit == "m"
    assert rig.cameras[0].lens == BrownConrady(461.5, 460.25, 362.75, 246.0, -0.277, 0.067, 0.0009, 0.0001)
    assert rig.cameras[1].lens == BrownConrady(460.0, 459.0, 360.0, 245.0)
    np.testing.assert_array_equal(rig.cameras[0].camera_from_world.rotation, np.eye(3))
    pose = rig.cameras[1].camera_from_world
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(pose.rotation[0], [0.99998854, 0.00216014, 0.00427195], atol=2e-8)
    np.testing.assert_array_equal(pose.translation, [-0.11003785, 0.00045792, 0.0])


KALIBR = """
cam0:
  camera_model: pinhole
  intrinsics: [461.5, 460.25, 362.75, 246]
  distortion_model: radtan
  distortion_coeffs: [-0.277, 0.067, 0.0009, 0.0001]
  T_cam_imu: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  timeshift_cam_imu: -8.1e-05
  resolution: [752, 480]
cam1:
  camera_model: pinhole
  intrinsics: [460.0, 459.0, 360.0, 245.0]
  distortion_model: none
  distortion_coeffs: []
  T_cn_cnm1:
  - [0.99998854, 0.00216014, 0.00427195, -0.11003785]
  - [-0.00221074, 0.99992702, 0.01187697, 0.00045792]
  - [-0.00424598, -0.01188628, 0.99992034, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  resolution: [752, 480]
"""


@pytest.mark.parametrize("kind", ["kalibr", "pose2sim"])
def test_a_lens_with_k3_is_refitted_and_the_cost_stated(tmp_path, kind):
    """The stated cost is what another program's pixels are off by; a mere drop of k3 would cost much more."""
    camera = random_rig(1, n=1, fisheye=False).cameras[0]
    camera = replace(camera, lens=BrownConrady(1000.0, 1010.0, 650.0, 390.0, -0.2, 0.05, 1e-3, -1e-3, 0.02))
    path, notes = exported(tmp_path, kind, Rig((camera,), "m"))
    (read,) = import_cameras(path).cameras
    assert read.lens.k3 == 0
    u, v = np.meshgrid(np.linspace(-0.5, 1279.5, 201), np.linspace(-0.5, 799.5, 151))
    uv = np.column_stack([u.ravel(), v.ravel()])
    rays, valid = camera.lens.ray_from_pixel(uv)
    assert valid.all()

    def cost(lens):
        off = np.linalg.norm(lens.pixel_from_camera_point(rays)[0] - uv, axis=1)
        return np.sqrt(np.mean(off**2)), off.max()

    rms, largest = map(float, re.search(r"rms ([\d.]+) px, at most ([\d.]+) px", notes[-1]).groups())
    assert cost(read.lens)[0] == pytest.approx(rms, rel=0.15)  # the lattice of the fit is coarser
    assert cost(read.lens)[1] == pytest.approx(largest, rel=0.05)
    assert cost(replace(camera.lens, k3=0.0))[0] > 5 * rms
    for nudge in np.eye(8) * [0.3, 0.3, 0.3, 0.3, 1e-3, 1e-3, 1e-4, 1e-4]:  # no neighbour is better
        for sign in (-1, 1):
            assert cost(BrownConrady(*np.array(astuple(read.lens)[:8]) + sign * nudge))[0] > cost(read.lens)[0]


def test_a_narrow_fisheye_fits_pose2sim_and_a_wide_one_is_refused(tmp_path):
    pose = look_at([0, 0, -3], [0, 0, 0])
    narrow = ExplicitCamera("tele", 1280, 800, KannalaBrandt(2000.0, 2000.0, 640.0, 400.0, 0.01), pose)
    path, notes = exported(tmp_path, "pose2sim", Rig((narrow,), "m"))
    assert "'tele'" in notes[0]
    seen = import_cameras(path).cameras[0].pixel_from_world(points())[0]
    np.testing.assert_allclose(seen, narrow.pixel_from_world(points())[0], atol=0.05)
    for focal, why in ((570.0, "off by"), (250.0, "sideways or backwards")):
        wide = replace(narrow, lens=KannalaBrandt(focal, focal, 640.0, 400.0))
        with pytest.raises(DatasetError, match="'tele' cannot be written as a lens with four") as caught:
            exported(tmp_path, "pose2sim", Rig((wide,), "m"))
        assert why in caught.value.why
        assert "opencv" in caught.value.fix


# ---- colmap


def test_colmap_reads_the_model_and_sees_the_same_pixels(tmp_path):
    """COLMAP's pixels begin at the corner of the first one: its numbers are ours + 0.5."""
    pycolmap = pytest.importorskip("pycolmap")
    rig = random_rig(3, n=4, unit="mm")
    lens = replace(random_rig(3, n=1, fisheye=False).cameras[0].lens, k3=0.0)
    rig = replace(rig, cameras=(*rig.cameras, replace(rig.cameras[0], name="plain", lens=lens)))
    path, _ = exported(tmp_path, "colmap", rig)
    model = pycolmap.Reconstruction(path)
    images = {image.name: image for image in model.images.values()}
    assert set(images) == {camera.name for camera in rig.cameras}
    models = set()
    for camera in rig.cameras:
        image = images[camera.name]
        models.add(image.camera.model.name)
        assert (image.camera.width, image.camera.height) == (1280, 800)
        seen = image.camera.img_from_cam(image.cam_from_world() * points())
        np.testing.assert_allclose(seen - 0.5, camera.pixel_from_world(points())[0], atol=1e-6, rtol=0)
    assert models == {"OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"}


EXACT_MODELS = {
    model: MODEL_NUMBERS[model][1]
    for model in MODELS
    if model not in ("FOV", "EUCM", "THIN_PRISM_FISHEYE", "SIMPLE_DIVISION", "DIVISION")
}


@pytest.mark.parametrize("model", EXACT_MODELS)
def test_every_model_that_colmap_writes_is_read(tmp_path, model):
    pycolmap = pytest.importorskip("pycolmap")
    count = EXACT_MODELS[model]
    camera = pycolmap.Camera.create_from_model_name(1, model, 500.0, 1280, 800)
    params = np.array(camera.params)
    assert len(params) == count
    extra = [0.03, -0.01, 0.001, -0.002, 0.004, 0.0, 0.0, 0.0]
    if model.endswith("FISHEYE"):
        extra = [0.03, -0.01, 0.002, -0.001]
    first = 3 if len(set(params[:2])) == 2 else 4
    params[first:] = extra[: count - first]
    params[first - 2 : first] += [0.25, -0.5]
    camera.params = params
    made = pycolmap.Reconstruction()
    made.add_camera_with_trivial_rig(camera)
    pose = look_at([0.3, -0.2, -3], [0, 0, 0])
    rigid = pycolmap.Rigid3d(np.column_stack([pose.rotation, pose.translation]))
    made.add_image_with_trivial_frame(pycolmap.Image(name="left/0001.png", camera_id=1, image_id=1), rigid)
    made.write_text(tmp_path)
    rig = import_cameras(tmp_path)
    assert [c.name for c in rig.cameras] == ["left"]
    assert rig.length_unit == UNKNOWN_UNIT
    image = made.images[1]
    seen = image.camera.img_from_cam(image.cam_from_world() * points())
    np.testing.assert_allclose(rig.cameras[0].pixel_from_world(points())[0], seen - 0.5, atol=1e-6, rtol=0)


def test_images_of_a_camera_that_moved_become_cameras_of_their_own(tmp_path):
    (tmp_path / "cameras.txt").write_text("7 PINHOLE 640 480 500 500 320 240\n")
    (tmp_path / "images.txt").write_text(
        "# comment\n1 1 0 0 0 0 0 1 7 a/1.png\n10 10 -1 20 20 5\n2 1 0 0 0 0 0 2 7 a/2.png\n\n"
    )
    rig = import_cameras(tmp_path)
    assert [c.name for c in rig.cameras] == ["a_1", "a_2"]
    assert [c.lens.cx for c in rig.cameras] == [319.5, 319.5]


def test_a_folder_with_other_things_is_not_touched(tmp_path):
    (tmp_path / "photo.png").write_text("mine")
    with pytest.raises(DatasetError, match=r"'photo.png', which is no part of a COLMAP"):
        export_cameras(random_rig(0), "colmap", tmp_path)
    assert [f.name for f in tmp_path.iterdir()] == ["photo.png"]
    for seed in (0, 1):  # an earlier model is replaced
        export_cameras(random_rig(seed), "colmap", tmp_path / "model")
    assert import_cameras(tmp_path / "model").cameras[0].lens != random_rig(0).cameras[0].lens


# ---- aniposelib, pose2sim


def test_a_file_of_aniposelib_is_read():
    """Written by aniposelib 0.8.0, with the pixels that its `project` gave for these points."""
    rig = import_cameras(DATA / "aniposelib-0.8.0.toml", unit="mm")
    assert [c.name for c in rig.cameras] == ["left", "wide"]
    assert [type(c.lens) for c in rig.cameras] == [BrownConrady, KannalaBrandt]
    xyz = np.array([[0, 0, 0], [100, 50, -30], [-250, 120, 80], [300, -200, 150.0]])
    for camera, seen in zip(rig.cameras, ANIPOSELIB_SAW, strict=True):
        np.testing.assert_allclose(camera.pixel_from_world(xyz)[0], seen, atol=1e-9)


ANIPOSELIB_SAW = [
    [
        [686.7151237227306, 375.5681906853052],
        [799.8316640753126, 439.20739919564807],
        [401.07650134297535, 483.8681011520928],
        [930.0971284953916, 197.0132635871071],
    ],
    [
        [579.9736880634651, 408.2324253259404],
        [565.4258970894738, 464.7640620214805],
        [494.6671786484906, 340.05418099287897],
        [746.537147370767, 550.8811992180699],
    ],
]


def test_aniposelib_reads_the_file_and_sees_the_same_pixels(tmp_path):
    cameras = pytest.importorskip("aniposelib.cameras")
    rig = random_rig(3, n=12)
    group = cameras.CameraGroup.load(str(exported(tmp_path, "aniposelib", rig)[0]))
    assert group.get_names() == [c.name for c in rig.cameras]
    for camera, seen in zip(rig.cameras, group.project(points()), strict=True):
        np.testing.assert_allclose(camera.pixel_from_world(points())[0], seen, atol=1e-9)


def test_the_order_survives_a_reader_that_sorts_tables_as_text(tmp_path):
    path, _ = exported(tmp_path, "aniposelib", random_rig(0, n=12))
    tables = tomllib.loads(path.read_text())
    assert [tables[key]["name"] for key in sorted(tables) if key != "metadata"] == [f"cam{i}" for i in range(1, 13)]


def test_pose2sim_computes_the_same_pixels_in_metres(tmp_path):
    """Its own way: matrix, four distortions, Rodrigues, in the order of the tables."""
    rig = rig_for("pose2sim", 3, unit="m")
    path, notes = exported(tmp_path, "pose2sim", rig)
    millimetres = rig.in_unit("mm")
    again, said = exported(tmp_path / "mm", "pose2sim", millimetres)
    assert notes == []
    assert "metres" in said[0]
    tables = tomllib.loads(path.read_text())
    assert tables.pop("metadata") == {"adjusted": False, "error": 0.0}
    assert list(tables) == [c.name for c in rig.cameras]
    for camera, table in zip(rig.cameras, tables.values(), strict=True):
        assert table["size"] == [1280.0, 800.0]
        assert table["fisheye"] is False
        assert len(table["distortions"]) == 4
        pose = [np.array(table[key]) for key in ("rotation", "translation", "matrix", "distortions")]
        seen = cv2.projectPoints(points()[:, None], *pose)[0].reshape(-1, 2)
        np.testing.assert_allclose(seen, camera.pixel_from_world(points())[0], atol=1e-9)
        other = tomllib.loads(again.read_text())[camera.name]
        np.testing.assert_allclose(other["translation"], table["translation"], rtol=1e-14)


# ---- dlt


def from_coefficients(column, xyz):
    """The definition: Abdel-Aziz & Karara 1971."""
    l, (x, y, z) = column, xyz.T  # noqa: E741
    w = l[8] * x + l[9] * y + l[10] * z + 1
    return np.column_stack([l[0] * x + l[1] * y + l[2] * z + l[3], l[4] * x + l[5] * y + l[6] * z + l[7]]) / w[:, None]


def test_dlt_of_a_pinhole_is_exact_and_counts_pixels_from_one(tmp_path):
    rig = rig_for("dlt", 4, unit="mm")
    path, notes = exported(tmp_path, "dlt", rig)
    table = np.loadtxt(path, delimiter=",")
    assert table.shape == (11, 3)
    assert notes == []
    for camera, column in zip(rig.cameras, table.T, strict=True):
        np.testing.assert_allclose(
            from_coefficients(column, points()) - 1, camera.pixel_from_world(points())[0], rtol=1e-9
        )


@pytest.mark.parametrize("origin", ["upper-left", "lower-left"])
@pytest.mark.parametrize("behind", [False, True])
def test_dlt_of_others_is_read_with_their_origin(tmp_path, origin, behind):
    """Coefficients fitted to pixels of their own kind; the origin of the world is before the camera, or behind it."""
    camera = rig_for("dlt", 5, n=1).cameras[0]
    if behind:
        pose = camera.camera_from_world
        camera = replace(camera, camera_from_world=Pose(pose.rotation, pose.translation * [1, 1, -1]))
    xyz = camera.camera_from_world.inverse().apply(points() + np.array([0, 0, 3]))
    uv = camera.pixel_from_world(xyz)[0]
    theirs = uv + 1 if origin == "upper-left" else np.column_stack([uv[:, 0] + 1, 800 - uv[:, 1]])
    p = resect(xyz, theirs)
    path = tmp_path / "lab.csv"
    np.savetxt(path, (p / p[2, 3]).ravel()[:11])
    head = f'length_unit = "mm"\nimage_origin = "{origin}"\n[[cameras]]\nname = "cam1"\nwidth = 1280\nheight = 800\n'
    (tmp_path / "lab.csv.toml").write_text(head)
    rig = import_cameras(path)
    seen, valid = rig.cameras[0].pixel_from_world(xyz)
    assert valid.all()
    assert rig.length_unit == "mm"
    assert [("looks away" in note) for note in rig.notes] == [True] * behind
    np.testing.assert_allclose(seen, uv, atol=1e-6)
    np.testing.assert_allclose(rig.cameras[0].camera_from_world.centre, camera.camera_from_world.centre, atol=1e-6)


def test_dlt_states_what_a_lens_costs(tmp_path):
    """The cost is that of the best fit: of the whole image at any distance, or at given points, where it is smaller."""
    camera = random_rig(2, n=1, fisheye=False).cameras[0]
    camera = replace(camera, lens=BrownConrady(1000.0, 1010.0, 650.0, 390.0, -0.2, 0.05, 1e-3, -1e-3))
    column, cost = dlt.find_coefficients(camera)
    uv = np.stack(np.meshgrid(np.linspace(-0.5, 1279.5, 25), np.linspace(-0.5, 799.5, 25)), -1).reshape(-1, 2)
    rays = camera.lens.ray_from_pixel(uv)[0]
    for distance in (0.5, 50.0):
        xyz = camera.camera_from_world.inverse().apply(distance * rays)
        off = np.linalg.norm(from_coefficients(column, xyz) - 1 - uv, axis=1)
        assert np.sqrt(np.mean(off**2)) == pytest.approx(cost.rms, rel=1e-6)
        assert off.max() == pytest.approx(cost.largest, rel=1e-6)
    xyz = points(1, 60)
    uv = camera.pixel_from_world(xyz)[0]
    column, at_points = dlt.find_coefficients(camera, xyz)

    def rms(column):
        return np.sqrt(np.mean(np.sum((from_coefficients(column, xyz) - 1 - uv) ** 2, axis=1)))

    p = resect(xyz, uv + 1)  # the linear fit minimises something else
    assert rms(column) == pytest.approx(at_points.rms, rel=1e-6)
    assert at_points.rms < cost.rms
    assert rms(column) < rms((p / p[2, 3]).ravel()[:11])
    for i in range(11):
        for change in (1 - 1e-4, 1 + 1e-4):
            nudged = column.copy()
            nudged[i] *= change
            assert rms(nudged) > rms(column)
    notes = exported(tmp_path, "dlt", Rig((camera,), "m"))[1]
    assert f"{cost.rms:.2g} px" in notes[0]
    assert f"at most {cost.largest:.2g} px" in notes[0]


def test_dlt_with_a_skew_is_read_as_the_nearest_camera_and_says_so(tmp_path):
    camera = rig_for("dlt", 6, n=1).cameras[0]
    path, _ = exported(tmp_path, "dlt", Rig((camera,), "m"))
    pose, lens = camera.camera_from_world, camera.lens
    k = np.array([[lens.fx, 4.0, lens.cx + 1], [0, lens.fy, lens.cy + 1], [0, 0, 1]])
    p = k @ np.column_stack([pose.rotation, pose.translation])
    np.savetxt(path, (p / p[2, 3]).ravel()[:11])
    rig = import_cameras(path)
    largest = float(re.search(r"at most ([\d.]+) px", rig.notes[0])[1])
    corner = 4.0 * 400 / lens.fy  # what the skew moves, when nothing makes up for it
    assert 0.2 * corner < largest < 0.6 * corner
    np.testing.assert_allclose(rig.cameras[0].camera_from_world.centre, pose.centre, atol=1e-9)
    xyz = pose.inverse().apply(points() + np.array([0, 0, 2]))
    w = xyz @ p[:, :3].T + p[:, 3]
    off = rig.cameras[0].pixel_from_world(xyz)[0] - (w[:, :2] / w[:, 2:] - 1)
    assert np.linalg.norm(off, axis=1).max() < 1.01 * largest


def test_dlt_of_an_origin_beside_the_camera_has_no_coefficients(tmp_path):
    camera = ExplicitCamera("c", 640, 480, BrownConrady(500.0, 500.0, 320.0, 240.0), Pose(np.eye(3), [1.0, 0, 0]))
    with pytest.raises(DatasetError, match="eleven coefficients"):
        exported(tmp_path, "dlt", Rig((camera,), "m"))
    assert list(tmp_path.iterdir()) == []


# ---- errors

WRONG = [  # format, what to replace (a pattern), by what, what the error must say
    ("opencv", r"(R: .*\n.*\n.*\n.*\n +data: \[ )[^,]*", r"\g<1>7.0", "R is not a rotation matrix"),
    ("opencv", "rows: 3", "rows: 2", "camera_matrix has the size (2, 3); it must be 3 x 3"),
    ("opencv", "camera_matrix", "camera_matrx", "'camera_matrix' is missing (did you mean 'camera_matrx'?)"),
    (
        "opencv",
        r"(camera_matrix.*\n.*\n.*\n.*\n +data: \[ )[^,]*",
        r"\g<1>.Nan",
        "data[0] = '.Nan' is not a finite number",
    ),
    ("opencv", r"(camera_matrix.*\n.*\n.*\n.*\n +data: \[ )[^,]*", r"\g<1>-500.", "focal lengths -500"),
    (
        "opencv",
        r"(camera_matrix.*\n.*\n.*\n.*\n +data: \[ [^,]*, [^,]*, [^,]*, )0.0",
        r"\g<1>0.5",
        "beside fx, fy, cx, cy",
    ),
    ("opencv", r"(distortion_coefficients.*\n.*\n.*\n.*\n +data: \[ )", r"\g<1>0, 0, ", "7 distortion coefficients"),
    ("opencv", r"(distortion_coefficients.*\n.*\n.*\n.*\n +data: \[ )", r"\g<1>" + "0, " * 10, "a list of at most 14"),
    ("opencv", 'name: "cam1"', 'name: "../../etc"', "cannot name a folder"),
    ("opencv", "image_width: 1280", "image_width: 1280.5", "must be a whole number"),
    ("opencv", "cameras:", "cameras: [", "not valid YAML"),
    ("opencv", "image_width: 1280", "image_width: !!python/object/apply:os.system ['true']", "is not a finite number"),
    ("opencv", "image_width: 1280", "image_width: " + "[" * 5000, "not valid YAML"),
    ("opencv", "cameras:", "cameras: 3\nx:", "is no list of cameras"),
    ("kalibr", "camera_model: pinhole", "camera_model: cata", "lens model 'cata' with"),
    ("kalibr", "camera_model: pinhole", "camera_model: cata", "supported are pinhole with radtan, pinhole with equi"),
    (
        "kalibr",
        "camera_model: pinhole\n( +intr.*\n +distortion_model: )[a-z]*",
        "camera_model: omni\n\\1radtan",
        "list of 5",
    ),
    ("kalibr", "radtan|equidistant", "fov", "distortion_coeffs = "),
    ("kalibr", "cam1:", "cam2:", "must be cam0, cam1, ..."),
    ("kalibr", r"resolution: \[1280, ", "resolution: [", "must be [width, height]"),
    ("kalibr", "(T_cn_cnm1:\n  - \\[)[^,]*", r"\g<1>0.9", "is not a rotation matrix"),
    ("kalibr", r"(T_cn_cnm1:\n.*), [^,]*\]", r"\g<1>, 0.123]", "T_cn_cnm1 and T_cam_world do not agree"),
    ("kalibr", r"distortion_coeffs: \[[^,]*,", "distortion_coeffs: [", "must be a list of 4"),
    ("kalibr", r"\[0.0, 0.0, 0.0, 1.0\]", "[0.0, 0.0, 0.0, 2.0]", "the last row must be 0, 0, 0, 1"),
    ("colmap", "OPENCV_FISHEYE|FULL_OPENCV|OPENCV", "EQUIRECTANGULAR", "'EQUIRECTANGULAR' is not supported"),
    ("colmap", "1280 800 [^ ]*", "1280 800", "PARAMS of"),
    ("colmap", "1280 800 [^ ]*", "1280 800 inf", "is not a finite number"),
    ("colmap", " 1280 ", " -1280 ", "is not CAMERA_ID MODEL WIDTH HEIGHT PARAMS"),
    ("colmap", "\n1 ", "\n9 ", "wants camera '1'"),
    ("aniposelib", "matrix = ", "matrx = ", "'matrix' is missing (did you mean 'matrx'?)"),
    ("aniposelib", "rotation = \\[", "rotation = [ 1.0,", "must be a list of 3"),
    ("aniposelib", "translation = \\[\n *[^,]*", "translation = [ nan", "is not a finite number"),
    ("aniposelib", "translation = \\[\n *[^,]*", "translation = [ true", "is not a finite number"),
    ("aniposelib", "distortions = \\[", "distortions = [ 0.1,", "6 distortion coefficients"),
    ("aniposelib", "^.*$", 'cam = "x', "not valid TOML"),
    ("aniposelib", "cam2", "cam1", "is there 2 times"),
    ("pose2sim", "fisheye = false", "fisheye = 3", "must be true or false"),
    ("pose2sim", "distortions = \\[", "distortions = [ 1.0, 2.0, 3.0, 4.0,", "rational"),
    ("dlt", "^.*\n", "", "10 rows; DLT coefficients are 11 rows"),
    ("dlt", "^[^,]*", "x", "row 1[0] = 'x' is not a finite number"),
    ("dlt", "^[^,]*,", "", "must be a list of 2"),
]


@pytest.mark.parametrize(("kind", "old", "new", "message"), WRONG)
def test_errors_name_the_file_the_value_and_the_cure(tmp_path, kind, old, new, message):
    seed = 8 if kind == "kalibr" else 3
    path, _ = exported(tmp_path, kind, rig_for(kind, seed))
    file = path / "cameras.txt" if kind == "colmap" else path
    good = file.read_text()
    bad = re.sub(old, new, good, count=1, flags=re.DOTALL if old == "^.*$" else 0)
    assert bad != good
    file.write_text(bad)
    with pytest.raises(DatasetError) as caught:
        import_cameras(path, kind)
    assert message in str(caught.value), str(caught.value)
    assert str(tmp_path) in caught.value.what
    assert caught.value.fix


def test_dlt_without_its_description_says_what_to_write(tmp_path):
    path, _ = exported(tmp_path, "dlt", rig_for("dlt", 3))
    beside = tmp_path / "lab.csv.toml"
    good = beside.read_text()
    for text, message in (
        (good.replace("upper-left", "middle"), "image_origin = 'middle'"),
        (re.sub("{ name = .cam3.*},?", "", good), "has 3 columns, and lab.csv.toml names 2 cameras"),
    ):
        beside.write_text(text)
        with pytest.raises(DatasetError, match=re.escape(message)):
            import_cameras(path)
    beside.unlink()
    with pytest.raises(DatasetError, match="says nothing of names") as caught:
        import_cameras(path)
    assert "lower-left" in caught.value.fix
    assert "[[cameras]]" in caught.value.fix


def test_a_list_that_repeats_itself_without_end_is_refused_at_once(tmp_path):
    """Ten levels of ten times the level below: a thousand million numbers from a few hundred bytes."""
    levels = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    levels += [f"a{i}: &a{i} [" + ", ".join([f"*a{i - 1}"] * 10) + "]" for i in range(1, 10)]
    path = tmp_path / "bomb.yml"
    path.write_text("%YAML:1.0\n---\n" + "\n".join(levels) + "\ncameras:\n  - name: c\n    camera_matrix: *a9\n")
    with pytest.raises(DatasetError, match="camera_matrix"):
        import_cameras(path)
    path.write_text(path.read_text().replace("camera_matrix: *a9", "camera_matrix: {rows: 3, cols: 3, data: *a9}"))
    with pytest.raises(DatasetError, match="must be a list of 9"):
        import_cameras(path)
    merges = [f"b{i}: &b{i} {{<<: [*b{i - 1}, *b{i - 1}]}}" for i in range(1, 60)]
    path.write_text("%YAML:1.0\n---\nb0: &b0 {x: 1}\n" + "\n".join(merges))
    with pytest.raises(DatasetError, match=r"not recognised: it has the keys b0, b1, .* and 48 more"):
        import_cameras(path)
    with pytest.raises(DatasetError, match="'camera_matrix' is missing"):
        import_cameras(path, "opencv")


@pytest.mark.parametrize("name", ['say "hi"', "a: b # c", "Kamera ü", "1", "it's"])
def test_opencv_reads_awkward_names(tmp_path, name):
    rig = rig_for("opencv", 1, n=1)
    path, _ = exported(tmp_path, "opencv", replace(rig, cameras=(replace(rig.cameras[0], name=name),)))
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert storage.getNode("cameras").at(0).getNode("name").string() == name


def test_files_that_are_none(tmp_path):
    with pytest.raises(DatasetError, match="does not exist"):
        import_cameras(tmp_path / "missing.yml")
    with pytest.raises(DatasetError, match="the folder holds nothing"):
        import_cameras(tmp_path)
    with pytest.raises(DatasetError, match="no COLMAP model") as caught:
        import_cameras(tmp_path, "colmap")
    assert "sparse/0" in caught.value.fix
    (tmp_path / "x.yml").write_bytes(b"a: \xff")
    with pytest.raises(DatasetError, match="line 1: byte 0xff is not UTF-8"):
        import_cameras(tmp_path / "x.yml")
    (tmp_path / "big.yml").write_bytes(b" " * (1 << 21))
    with pytest.raises(DatasetError, match="2,097,152 bytes"):
        import_cameras(tmp_path / "big.yml")


def test_a_rounded_rotation_is_made_one_and_a_mirror_is_not(tmp_path):
    path, _ = exported(tmp_path, "kalibr", rig_for("kalibr", 1, n=1))
    rotation = rotation_from_vector([0.3, -0.2, 0.9])
    for matrix in (np.round(rotation, 5), rotation * [[1], [1], [-1]]):
        text = yaml.safe_load(path.read_text())
        text["cam0"]["T_cam_world"] = [[*row, 0.0] for row in matrix.tolist()] + [[0.0, 0.0, 0.0, 1.0]]
        path.write_text(yaml.safe_dump(text))
        if np.linalg.det(matrix) > 0:
            made = import_cameras(path).cameras[0].camera_from_world.rotation
            np.testing.assert_allclose(made @ made.T, np.eye(3), atol=1e-15)
            np.testing.assert_allclose(made, rotation, atol=1e-5)
        else:
            with pytest.raises(DatasetError, match="mirrors"):
                import_cameras(path)
