"""Camera files as people bring them: cases in data/cases, and situations of public reports, rebuilt with our numbers.

Each is judged by the other program's own formula: OpenCV's, or written out here.
"""

import random
import re
from dataclasses import astuple, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from implicam.calibrators import load_calibration
from implicam.calibrators.explicit import calibration_of, rig_of
from implicam.errors import DatasetError, ImplicamError, UsageError
from implicam.exchange import FORMATS, UNKNOWN_UNIT, ExplicitCamera, Rig, export_cameras, import_cameras
from implicam.exchange.other_lenses import rational_lens
from implicam.geometry import look_at, rotation_from_vector
from implicam.lenses import BrownConrady, KannalaBrandt
from test_exchange import damaged, points, random_rig

CASES = Path(__file__).parent / "data" / "cases"
AHEAD = np.array([[0.0, 0, 2], [0.3, 0.2, 1.5], [-0.4, 0.1, 2], [0.2, -0.3, 1.2]])
"""Points before a camera at the origin that looks along z."""


def k_of(lens):
    return np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])


def opencv_pixels(xyz, k, d, r=None, t=None, *, fisheye=False):
    rvec = cv2.Rodrigues(np.eye(3) if r is None else np.asarray(r))[0]
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    return project(xyz[:, None], rvec, np.zeros(3) if t is None else np.asarray(t), k, np.asarray(d))[0].reshape(-1, 2)


def assert_sees(camera, xyz, seen, atol=1e-8):
    np.testing.assert_allclose(camera.pixel_from_world(xyz)[0], seen, atol=atol, rtol=0)


# ---- the cases


def test_a_kalibr_chain_with_a_header_of_opencv_is_recognised():
    """14 of 14 public chains of rpng/open_vins begin with %YAML:1.0."""
    one, two = import_cameras(CASES / "kalibr-yaml-header" / "camchain.yaml").cameras
    np.testing.assert_allclose(two.camera_from_world.centre, [0.11, 0, 0], atol=1e-15)
    assert one.lens == BrownConrady(460.0, 459.0, 367.0, 248.0, -0.28, 0.07, 0.0002, 0.00002)
    seen = opencv_pixels(AHEAD, k_of(two.lens), astuple(two.lens)[4:], np.eye(3), [-0.11, 0, 0])
    assert_sees(two, AHEAD, seen, 1e-11)


def test_a_kalibr_chain_against_an_imu_only_has_the_relative_pose():
    rig = import_cameras(CASES / "kalibr-imu-only" / "camchain.yaml")
    np.testing.assert_allclose(rig.cameras[1].camera_from_world.translation, [-0.11, 0, 0], atol=1e-15)
    np.testing.assert_allclose(rig.cameras[1].camera_from_world.rotation, np.eye(3), atol=1e-15)
    assert any("against the IMU" in note for note in rig.notes)


def test_equidistant_of_ros_is_opencvs_fisheye():
    (camera,) = import_cameras(CASES / "ros-equidistant" / "front.yaml").cameras
    assert camera.name == "front"
    assert camera.lens == KannalaBrandt(600.0, 600.0, 640.0, 400.0, -0.03, 0.02, -0.03, 0.017)
    ray = np.array([[1.0, 0, 1]])
    seen = opencv_pixels(ray, k_of(camera.lens), [-0.03, 0.02, -0.03, 0.017], fisheye=True)
    assert seen[0, 0] == pytest.approx(1104, abs=1)
    assert_sees(camera, ray, seen)


def test_a_stereo_file_of_opencv_is_a_pair():
    rig = import_cameras(CASES / "opencv-stereo-file" / "stereo.yml", unit="mm")
    assert [c.name for c in rig.cameras] == ["cam1", "cam2"]
    np.testing.assert_allclose(rig.cameras[1].camera_from_world.centre, [60, 0, 0], atol=1e-12)
    assert rig.cameras[1].lens == BrownConrady(432.0, 432.0, 318.0, 241.0, -0.07, 0.1, 0.0, 0.0, -0.04)


@pytest.mark.parametrize("name", ["camera_array.toml", "config.toml"])
def test_both_files_of_caliscope_are_read(name):
    rig = import_cameras(CASES / "caliscope-array" / name)
    assert [c.name for c in rig.cameras] == ["cam_0", "cam_1"]
    assert rig.length_unit == "m"
    np.testing.assert_allclose(rig.cameras[1].camera_from_world.centre, [0.34, 0, -0.38], atol=1e-12)
    xyz = np.array([[0.1, 0.05, 2.0], [-0.2, 0.1, 1.5]])
    r, t = [[0.8, 0.0, -0.6], [0.0, 1.0, 0.0], [0.6, 0.0, 0.8]], [-0.5, 0.0, 0.1]
    k = np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]])
    assert_sees(rig.cameras[1], xyz, opencv_pixels(xyz, k, [-0.3, 0.05, 0, 0, 0], r, t))


# ---- kalibr

CHAIN = """%YAML:1.0 # the type of the file

cam0:
  {pose0}
  cam_overlaps: [1]
  camera_model: {model}
  distortion_coeffs: {d}
  distortion_model: {distortion}
  intrinsics: {k}
  resolution: [{w}, {h}]
  rostopic: "/cam0/image_raw"
  timeshift_cam_imu: 0.0019
"""


def kalibr_file(tmp_path, model, k, distortion="none", d="[]", size=(752, 480)):
    path = tmp_path / "camchain.yaml"
    text = CHAIN.format(pose0="", model=model, k=k, distortion=distortion, d=d, w=size[0], h=size[1])
    path.write_text(text)
    return path


def by_mei(xyz, xi, fx, fy, cx, cy, k1=0.0, k2=0.0, p1=0.0, p2=0.0):
    """C. Mei and P. Rives 2007: onto the unit sphere, xi back, and through the plane."""
    sphere = xyz / np.linalg.norm(xyz, axis=1, keepdims=True)
    plane = sphere[:, :2] / (sphere[:, 2:] + xi)
    flat = np.column_stack([plane, np.ones(len(plane))])
    return opencv_pixels(flat, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), [k1, k2, p1, p2])


def by_double_sphere(xyz, xi, alpha, fx, fy, cx, cy):
    x, y, z = xyz.T
    d1 = np.sqrt(x * x + y * y + z * z)
    d2 = np.sqrt(x * x + y * y + (xi * d1 + z) ** 2)
    below = alpha * d2 + (1 - alpha) * (xi * d1 + z)
    return np.column_stack([fx * x / below + cx, fy * y / below + cy])


def by_eucm(xyz, alpha, beta, fx, fy, cx, cy):
    x, y, z = xyz.T
    below = alpha * np.sqrt(beta * (x * x + y * y) + z * z) + (1 - alpha) * z
    return np.column_stack([fx * x / below + cx, fy * y / below + cy])


def by_fov(xyz, omega, fx, fy, cx, cy):
    plane = xyz[:, :2] / xyz[:, 2:]
    r = np.linalg.norm(plane, axis=1)
    plane = plane * (np.arctan(2 * r * np.tan(omega / 2)) / (omega * r))[:, None]
    return plane * [fx, fy] + [cx, cy]


@pytest.mark.parametrize(
    ("model", "numbers", "distortion", "d", "project"),
    [
        ("omni", [1.2, 700, 690, 400, 300], "radtan", [-0.2, 0.05, 1e-4, -2e-4], by_mei),
        ("ds", [-0.29, 0.55, 250, 249, 400, 300], "none", [], by_double_sphere),
        ("eucm", [0.6, 1.1, 300, 301, 400, 300], "none", [], by_eucm),
        ("pinhole", [400, 405, 400, 300], "fov", [0.93], by_fov),
    ],
)
def test_lenses_of_kalibr_that_are_not_here_are_refitted_and_the_cost_is_true(
    tmp_path, model, numbers, distortion, d, project
):
    """The stated cost is the largest distance from the program's own formula, over rays all over the image."""
    rig = import_cameras(kalibr_file(tmp_path, model, numbers, distortion, d, (800, 600)))
    (camera,) = rig.cameras
    cost = float(re.search(r"at most ([\d.e-]+) px", next(n for n in rig.notes if "fitted again" in n))[1])
    assert cost < 0.3
    angle, around = np.meshgrid(np.linspace(0.01, 1.8, 400), np.linspace(0, 2 * np.pi, 90))
    rays = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], -1).reshape(-1, 3)
    theirs = project(rays, *d, *numbers) if model == "pinhole" else project(rays, *numbers, *d)
    inside = (rays[:, 2] > (0.05 if model == "pinhole" else -1)) & (np.abs(theirs - [399.5, 299.5]) < [400, 300]).all(1)
    radius = np.linalg.norm(theirs - [400, 300], axis=1).reshape(angle.shape)
    inside &= np.logical_and.accumulate(np.diff(radius, axis=1, prepend=0) > 0, axis=1).ravel()  # up to the fold
    ours = camera.pixel_from_world(rays[inside])[0]
    off = np.linalg.norm(ours - theirs[inside], axis=1)
    assert inside.sum() > 5000
    assert off.max() < 1.15 * cost + 1e-6
    assert off.max() > 0.5 * cost


def test_what_kalibr_wrote_beside_the_cameras_is_named(tmp_path):
    path = kalibr_file(tmp_path, "pinhole", [400, 400, 376, 240], "equi", [0.01, 0.0, 0.0, 0.0])
    path.write_text(path.read_text() + "imu0:\n  update_rate: 200.0\n")
    rig = import_cameras(path)
    assert rig.cameras[0].lens == KannalaBrandt(400.0, 400.0, 376.0, 240.0, 0.01)
    assert "Left out: imu0, which are no cameras." in rig.notes


def test_a_chain_and_an_imu_that_disagree_are_told(tmp_path):
    """ethz-asl/kalibr issue 596: poses rounded by hand."""
    eye = "[[1, 0, 0, {0}], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
    cam = "  camera_model: pinhole\n  intrinsics: [400, 400, 376, 240]\n  distortion_model: none\n"
    cam += "  resolution: [752, 480]\n"
    text = f"cam0:\n  T_cam_imu: {eye.format(0)}\n{cam}"
    text += f"cam1:\n  T_cam_imu: {eye.format(-0.1)}\n  T_cn_cnm1: {eye.format(-0.12)}\n{cam}"
    path = tmp_path / "c.yaml"
    path.write_text(text)
    rig = import_cameras(path)
    assert rig.cameras[1].camera_from_world.translation[0] == -0.12
    assert any("T_cn_cnm1 is used" in note for note in rig.notes)
    path.write_text(text.replace(f"  T_cn_cnm1: {eye.format(-0.12)}\n", ""))
    assert import_cameras(path).cameras[1].camera_from_world.translation[0] == -0.1
    path.write_text(text.replace("T_cn_cnm1", "T_cn_cnm").replace(f"  T_cam_imu: {eye.format(0)}\n", ""))
    with pytest.raises(DatasetError, match=r"cam1: 'T_cn_cnm1' is missing .did you mean 'T_cn_cnm'") as caught:
        import_cameras(path)
    assert "the keys there are T_cam_imu, T_cn_cnm, camera_model" in caught.value.why
    assert "cut off" not in str(caught.value)


# ---- opencv: up to 14 coefficients


def storage_file(path, values):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in values.items():
        storage.write(key, value)
    storage.release()
    return path


COEFFICIENTS = {
    4: [-0.2, 0.05, 1e-3, -1e-3],
    5: [-0.2, 0.05, 1e-3, -1e-3, 0.01],
    8: [-0.3, 0.1, 1e-3, -1e-3, 0.01, 0.05, 0.01, 0.002],
    12: [-0.1, 0.02, 0, 0, 0, 0, 0, 0, 1e-3, 2e-4, -1e-3, 0],
    14: [-0.1, 0.02, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0.005, 0.01],
}


@pytest.mark.parametrize("count", COEFFICIENTS)
@pytest.mark.parametrize("ending", ["yml", "xml"])
def test_all_counts_of_coefficients_are_read_with_their_cost(tmp_path, count, ending):
    """cv2.projectPoints sees every point where we do, within what is stated: nothing for 4 and 5."""
    k, d = np.array([[900.0, 0, 645], [0, 905, 355], [0, 0, 1]]), COEFFICIENTS[count]
    values = {"image_width": 1280, "image_height": 720, "camera_matrix": k, "distortion_coefficients": np.array([d])}
    rig = import_cameras(storage_file(tmp_path / f"c.{ending}", values))
    (camera,) = rig.cameras
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, 60), np.linspace(-0.35, 0.35, 40))
    xyz = np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)])
    theirs = opencv_pixels(xyz, k, d)
    off = np.linalg.norm(camera.pixel_from_world(xyz)[0] - theirs, axis=1)
    told = [float(m[1]) for note in rig.notes if (m := re.search(r"at most ([\d.e-]+) px", note))]
    if count <= 5:
        assert told == []
        assert off.max() < 1e-9
    else:
        assert 0 < told[0] < 0.2
        assert off.max() < told[0] * 1.1
    assert any("k1, k2, p1, p2" in note for note in rig.notes) == (count == 4)


def test_a_lens_that_no_family_here_comes_near_is_refused_with_the_distance(tmp_path):
    d = [-0.3, 0.1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0.05, 0.08]
    k = np.array([[900.0, 0, 645], [0, 905, 355], [0, 0, 1]])
    values = {"image_width": 1280, "image_height": 720, "camera_matrix": k, "distortion_coefficients": np.array([d])}
    with pytest.raises(DatasetError, match="tilted lens model has no lens here that comes within 1 px") as caught:
        import_cameras(storage_file(tmp_path / "c.yml", values))
    assert re.search(r"is off by rms [\d.]+ px, at most", caught.value.why)


@pytest.mark.parametrize("seed", range(5))
def test_the_rational_formula_is_opencvs(seed):
    rng = np.random.default_rng(seed)
    d = rng.normal(size=14) * [0.1, 0.05, 1e-3, 1e-3, 0.01, 0.1, 0.02, 0.01, 1e-3, 1e-3, 1e-3, 1e-3, 0.02, 0.02]
    xyz = rng.uniform([-0.5, -0.4, 1], [0.5, 0.4, 1.5], (50, 3))
    k = np.array([[900.0, 0, 645], [0, 905, 355], [0, 0, 1]])
    uv, valid = rational_lens([900, 905, 645, 355], d).project(xyz)
    assert valid.all()
    np.testing.assert_allclose(uv, opencv_pixels(xyz, k, d), atol=1e-9)


def test_a_skew_is_refitted(tmp_path):
    """ika-rwth-aachen/ros2_calib issue 6: a fisheye with an entry beside fx."""
    k = np.array([[1133.0, 1.2, 960.0], [0, 1128.0, 600.0], [0, 0, 1]])
    values = {
        "image_width": 1920,
        "image_height": 1200,
        "camera_matrix": k,
        "distortion_coefficients": np.zeros((1, 5)),
    }
    rig = import_cameras(storage_file(tmp_path / "c.yml", values))
    rays = np.column_stack([np.random.default_rng(0).uniform(-0.5, 0.5, (40, 2)), np.ones(40)])
    off = np.abs(rig.cameras[0].pixel_from_world(rays)[0] - (rays @ k.T)[:, :2]).max()
    assert "a lens with a skew was fitted again" in rig.notes[-2]
    assert off < 0.5


def test_omnidir_of_opencv_is_refitted(tmp_path):
    k = np.array([[700.0, 0, 400], [0, 690, 300], [0, 0, 1]])
    values = {"image_width": 800, "image_height": 600, "camera_matrix": k, "xi": np.array([[1.2]])}
    values["distortion_coefficients"] = np.array([[-0.2, 0.05, 1e-4, -2e-4]])
    (camera,) = import_cameras(storage_file(tmp_path / "c.yml", values)).cameras
    rays = np.random.default_rng(0).uniform([-1, -0.8, 0.9], [1, 0.8, 1.1], (30, 3))
    assert_sees(camera, rays, by_mei(rays, 1.2, 700, 690, 400, 300, -0.2, 0.05, 1e-4, -2e-4), 0.3)


# ---- opencv: pairs, and several files


def a_pair(seed=2, unit="mm"):
    rig = random_rig(seed, n=2, unit=unit, fisheye=False)
    return replace(rig, cameras=tuple(replace(c, name=f"cam{i}") for i, c in enumerate(rig.cameras, 1)))


def relative(rig):
    one, two = (camera.camera_from_world for camera in rig.cameras)
    return two @ one.inverse()


PAIRS = [
    ("K1", "D1", "K2", "D2"),
    ("M1", "D1", "M2", "D2"),
    ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2"),
]
PAIRS += [
    ("K_left", "dist_left", "K_right", "dist_right"),
    ("mtxL", "distL", "mtxR", "distR"),
    ("K_l", "D_l", "K_r", "D_r"),
]


@pytest.mark.parametrize("keys", PAIRS)
@pytest.mark.parametrize("ending", ["yml", "xml", "json"])
@pytest.mark.parametrize("files", [1, 2])
def test_stereo_files_as_people_write_them(tmp_path, keys, ending, files):
    """In one file or two, in either order: OpenCV's own formula sees the same pixels."""
    rig = a_pair()
    pose = relative(rig)
    lenses = [rig.cameras[0].lens, rig.cameras[1].lens]
    lens_values = {}
    for lens, matrix, distortion in zip(lenses, keys[::2], keys[1::2], strict=True):
        lens_values |= {matrix: k_of(lens), distortion: np.array([astuple(lens)[4:]])}
    places = {"R": pose.rotation, "T": pose.translation[:, None], "E": np.eye(3), "F": np.eye(3), "P1": np.eye(3, 4)}
    if files == 1:
        paths = [storage_file(tmp_path / f"stereo.{ending}", lens_values | places)]
    else:
        paths = [storage_file(tmp_path / f"extrinsics.{ending}", places)]
        paths += [storage_file(tmp_path / f"intrinsics.{ending}", lens_values)]
    read = import_cameras(paths, unit="mm")
    assert [c.name for c in read.cameras] == (["left", "right"] if keys[0][-1] in "ltL" else ["cam1", "cam2"])
    xyz = rig.cameras[0].camera_from_world.apply(points())
    d = astuple(lenses[1])[4:]
    assert_sees(read.cameras[1], xyz, opencv_pixels(xyz, k_of(lenses[1]), d, pose.rotation, pose.translation))


def test_half_of_a_pair_says_which_half_is_missing(tmp_path):
    values = {"K1": np.eye(3), "D1": np.zeros(5), "K2": np.eye(3), "D2": np.zeros(5)}
    path = storage_file(tmp_path / "intrinsics.yml", values)
    with pytest.raises(DatasetError, match="does not say where the second camera stands") as caught:
        import_cameras(path)
    assert "the keys there are K1, D1, K2, D2; R and T are missing" in caught.value.why
    other = storage_file(tmp_path / "other.yml", {"R": np.eye(3), "T": np.ones(3), "K1": 2 * np.eye(3)})
    with pytest.raises(DatasetError, match="'K1' has another value"):
        import_cameras([path, other])
    with pytest.raises(DatasetError, match="no two lenses") as caught:
        import_cameras(other, "opencv-stereo")
    assert "R, T, K1" in caught.value.why


def test_a_fisheye_pair_says_so_and_four_coefficients_alone_are_told(tmp_path):
    k, d = np.array([[400.0, 0, 320], [0, 400, 240], [0, 0, 1]]), np.array([[0.01], [0.002], [-0.001], [0.0005]])
    values = {"K1": k, "D1": d, "K2": k, "D2": d, "R": np.eye(3), "T": np.array([-60.0, 0, 0])}
    path = storage_file(tmp_path / "s.yml", values)
    told = import_cameras(path).notes
    assert sum("read as k1, k2, p1, p2" in note for note in told) == 2
    path.write_text(path.read_text() + "fisheye_model: 1\n")
    rig = import_cameras(path)
    assert not any("k1, k2, p1, p2" in note for note in rig.notes)
    xyz = AHEAD - [0.0, 0, 0.5]
    assert_sees(rig.cameras[1], xyz, opencv_pixels(xyz, k, d, np.eye(3), [-60.0, 0, 0], fisheye=True))


def test_a_pair_goes_out_and_comes_back(tmp_path):
    rig = a_pair()
    notes = export_cameras(rig, "opencv-stereo", tmp_path / "s.yml")
    assert "first camera" in notes[0]
    storage = cv2.FileStorage(str(tmp_path / "s.yml"), cv2.FILE_STORAGE_READ)
    k, d, r, t = (storage.getNode(key).mat() for key in ("K2", "D2", "R", "T"))
    xyz = rig.cameras[0].camera_from_world.apply(points())
    np.testing.assert_allclose(opencv_pixels(xyz, k, d, r, t), rig.cameras[1].pixel_from_world(points())[0], atol=1e-8)
    back = import_cameras(tmp_path / "s.yml")
    assert back.length_unit == "mm"
    assert [c.lens for c in back.cameras] == [c.lens for c in rig.cameras]
    with pytest.raises(DatasetError, match="has 3 cameras"):
        export_cameras(random_rig(0), "opencv-stereo", tmp_path / "t.yml")


def test_several_files_of_one_camera_each_are_a_rig(tmp_path):
    rig = random_rig(5, n=3, fisheye=False)
    paths = []
    for camera in rig.cameras:
        pose = camera.camera_from_world
        values = {"mtx": k_of(camera.lens), "dist": np.array([astuple(camera.lens)[4:]])}
        values |= {"rvec": cv2.Rodrigues(pose.rotation)[0], "tvec": pose.translation}
        paths.append(storage_file(tmp_path / f"{camera.name}.yml", values))
    read = import_cameras(paths, unit="m")
    assert [c.name for c in read.cameras] == ["cam1", "cam2", "cam3"]
    for one, other in zip(rig.cameras, read.cameras, strict=True):
        assert_sees(other, points(), one.pixel_from_world(points())[0])
    storage_file(paths[1], {"mtx": np.diag([900.0, 900, 1]), "dist": np.zeros(5)})
    with pytest.raises(DatasetError, match="does not say where the camera stands"):
        import_cameras(paths)
    with pytest.raises(UsageError, match="keeps a whole rig in one"):
        import_cameras([CASES / "kalibr-imu-only" / "camchain.yaml", paths[0]], "kalibr")


# ---- ros


def rectified_pair(tmp_path, *, vertical=False, model="plumb_bob"):
    """A pair as ROS's calibrator writes it: R and P by cv2.stereoRectify."""
    turn = rotation_from_vector([0.02, -0.05, 0.03])
    t = np.array([-0.01, -0.12, 0.005]) if vertical else np.array([-0.12, 0.01, 0.005])
    k, d = np.array([[500.0, 0, 320], [0, 505, 240], [0, 0, 1]]), np.array([-0.2, 0.05, 1e-3, -5e-4, 0.0])
    rectified = cv2.stereoRectify(k, d, k, d, (640, 480), turn, t[:, None], flags=cv2.CALIB_ZERO_DISPARITY, alpha=0)
    files = []
    for name, r, p in zip(("left", "right"), rectified[:2], rectified[2:4], strict=True):
        values = {
            "camera_matrix": k,
            "distortion_coefficients": d[None],
            "rectification_matrix": r,
            "projection_matrix": p,
        }
        rows = [
            f"{key}:\n  rows: {m.shape[0]}\n  cols: {m.shape[1]}\n  data: {m.ravel().tolist()}\n"
            for key, m in values.items()
        ]
        head = f"image_width: 640\nimage_height: 480\ncamera_name: narrow_stereo/{name}\ndistortion_model: {model}\n"
        (tmp_path / f"{name}.yaml").write_text(head + "".join(rows))
        files.append(tmp_path / f"{name}.yaml")
    return files, k, d, turn, t


@pytest.mark.parametrize("vertical", [False, True])
def test_the_places_of_a_rectified_pair_of_ros_follow_from_r_and_p(tmp_path, vertical):
    files, k, d, turn, t = rectified_pair(tmp_path, vertical=vertical)
    for given in (files, [tmp_path]):
        rig = import_cameras(given)
        assert [c.name for c in rig.cameras] == ["narrow_stereo_left", "narrow_stereo_right"]
        np.testing.assert_allclose(rig.cameras[1].camera_from_world.translation, t, atol=1e-12)
        assert_sees(rig.cameras[1], AHEAD, opencv_pixels(AHEAD, k, d, turn, t))
        assert rig.length_unit == "m"


def test_cameras_of_ros_that_were_calibrated_one_by_one_have_no_places(tmp_path):
    files, *_ = rectified_pair(tmp_path)
    (tmp_path / "right.yaml").write_text((tmp_path / "left.yaml").read_text())
    with pytest.raises(DatasetError, match="does not say where the camera stands") as caught:
        import_cameras(files)
    assert "one by one" in caught.value.why
    assert len(import_cameras(files[0]).cameras) == 1


def test_a_message_of_ros_2_is_read(tmp_path):
    """As ros2 topic echo prints it: small letters, plain lists; ika-rwth-aachen/ros2_calib issue 6."""
    text = "header:\n  frame_id: cam\nheight: 1200\nwidth: 1920\ndistortion_model: equidistant\n"
    text += "d:\n- -0.02\n- 0.01\n- 0.0\n- 0.0\n"
    text += "k: [1100.0, 0.0, 960.0, 0.0, 1100.0, 600.0, 0.0, 0.0, 1.0]\nr: [0, 0, 0, 0, 0, 0, 0, 0, 0]\n"
    text += (
        "p: [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]\nbinning_x: 2\nbinning_y: 2\nroi:\n  x_offset: 0\n  y_offset: 0\n---\n"
    )
    path = tmp_path / "front.yaml"
    path.write_text(text)
    rig = import_cameras(path)
    assert (rig.cameras[0].width, rig.cameras[0].lens) == (
        1920,
        KannalaBrandt(1100.0, 1100.0, 960.0, 600.0, -0.02, 0.01),
    )
    assert any("binned" in note for note in rig.notes)
    path.write_text(text.replace("equidistant", "double_sphere"))
    with pytest.raises(DatasetError, match="distortion_model: 'double_sphere' is not supported"):
        import_cameras(path)


def test_a_rational_lens_of_ros_and_opencvs_matrices_are_read(tmp_path):
    """i3drobotics/stereo-vision-toolkit issue 48: OpenCV's matrices under ROS's keys."""
    path = tmp_path / "right.yaml"
    k, d = np.array([[719.0, 0, 386], [0, 719, 217], [0, 0, 1]]), COEFFICIENTS[8]
    values = {
        "image_width": 752,
        "image_height": 480,
        "camera_name": "rightCamera",
        "distortion_model": "rational_polynomial",
    }
    storage_file(path, values | {"camera_matrix": k, "distortion_coefficients": np.array([d])})
    (camera,) = import_cameras(path).cameras
    assert camera.name == "rightCamera"
    assert_sees(camera, AHEAD, opencv_pixels(AHEAD, k, d), 0.1)


@pytest.mark.parametrize("vertical", [False, True])
@pytest.mark.parametrize("fisheye", [False, True])
def test_a_pair_goes_to_ros_and_comes_back(tmp_path, vertical, fisheye):
    """cv2.stereoRectify's promise holds of what is written: both rectified pictures have a point in one row."""
    lens = (
        KannalaBrandt(500.0, 500.0, 640.0, 400.0, 0.01) if fisheye else BrownConrady(900.0, 900.0, 640.0, 400.0, -0.1)
    )
    shift = [0, 0.4, -3] if vertical else [0.4, 0.1, -3]
    cameras = [
        ExplicitCamera(n, 1280, 800, lens, look_at(c, [0, 0, 0], [0, 1, 0]))
        for n, c in (("a", [0, 0, -3]), ("b", shift))
    ]
    rig = Rig(tuple(cameras), "m")
    export_cameras(rig, "ros", tmp_path / "out")
    back = import_cameras([tmp_path / "out" / "a.yaml", tmp_path / "out" / "b.yaml"])
    assert [c.lens for c in back.cameras] == [lens, lens]
    np.testing.assert_allclose(relative(back).rotation, relative(rig).rotation, atol=1e-12)
    np.testing.assert_allclose(relative(back).translation, relative(rig).translation, atol=1e-12)
    rows = []
    for camera in rig.cameras:
        table = yaml.safe_load((tmp_path / "out" / f"{camera.name}.yaml").read_text())
        r, p = (np.array(table[key]["data"]).reshape(3, -1) for key in ("rectification_matrix", "projection_matrix"))
        xyz = camera.camera_from_world.apply(0.2 * points()) @ r.T
        rows.append((xyz[:, :2] / xyz[:, 2:] * [p[0, 0], p[1, 1]] + p[:2, 2])[:, 0 if vertical else 1])
    np.testing.assert_allclose(rows[0], rows[1], atol=1e-8)


def test_more_than_two_cameras_go_to_ros_without_their_places(tmp_path):
    notes = export_cameras(random_rig(0), "ros", tmp_path / "out")
    assert "they are lost" in notes[0]
    assert import_cameras(tmp_path / "out" / "cam2.yaml", "ros").cameras[0].lens == random_rig(0).cameras[1].lens
    (tmp_path / "out" / "mine.txt").write_text("x")
    with pytest.raises(DatasetError, match=r"'mine\.txt', which is no part of camera_info files"):
        export_cameras(random_rig(0), "ros", tmp_path / "out")


# ---- easymocap, caliscope


def test_easymocap_reads_what_is_written(tmp_path):
    """Its own way: names as text, K, dist, Rodrigues of R, T, by cv2.FileStorage."""
    rig = random_rig(3, n=3, fisheye=False)
    notes = export_cameras(
        replace(rig, cameras=(replace(rig.cameras[0], name="01"), *rig.cameras[1:])), "easymocap", tmp_path / "e"
    )
    assert "no unit" in notes[0]
    intri, extri = (cv2.FileStorage(str(tmp_path / "e" / f), cv2.FILE_STORAGE_READ) for f in ("intri.yml", "extri.yml"))
    names = [intri.getNode("names").at(i).string() for i in range(3)]
    assert names == ["01", "cam2", "cam3"]
    for name, camera in zip(names, rig.cameras, strict=True):
        k, d = intri.getNode(f"K_{name}").mat(), intri.getNode(f"dist_{name}").mat()
        r, t = extri.getNode(f"R_{name}").mat(), extri.getNode(f"T_{name}").mat()
        np.testing.assert_allclose(cv2.Rodrigues(r)[0], extri.getNode(f"Rot_{name}").mat(), atol=1e-14)
        seen = opencv_pixels(points(), k, d, cv2.Rodrigues(r)[0], t)
        np.testing.assert_allclose(seen, camera.pixel_from_world(points())[0], atol=1e-8)
    for given in (
        tmp_path / "e",
        tmp_path / "e" / "intri.yml",
        [tmp_path / "e" / "extri.yml", tmp_path / "e" / "intri.yml"],
    ):
        back = import_cameras(given, unit="m")
        assert [c.name for c in back.cameras] == names
        assert [(c.width, c.lens) for c in back.cameras] == [(1280, c.lens) for c in rig.cameras]


def test_easymocap_without_sizes_and_with_half_of_its_files(tmp_path):
    """zju3dv/EasyMocap issues 323, 279: K and dist written by hand, no H and W, only the matrix of the rotation."""
    m = "!!opencv-matrix\n  rows: {}\n  cols: {}\n  dt: d\n  data: [{}]\n"
    head = '%YAML:1.0\r\n---\r\nnames:\n  - "03"\n'
    k, d = m.format(3, 3, "2600.5, 0, 511.5, 0, 2600.5, 567.25, 0, 0, 1"), m.format(1, 5, "0, 0, 0, 0, 0")
    (tmp_path / "intri.yml").write_text(f"{head}K_03: {k}dist_03: {d}", newline="")
    with pytest.raises(DatasetError, match=r"extri.yml is missing") as caught:
        import_cameras(tmp_path / "intri.yml")
    assert "intri.yml" in caught.value.why
    rot, t = m.format(3, 3, "1, 0, 0, 0, 0, -1, 0, 1, 0"), m.format(3, 1, "0, 1.5, 4")
    (tmp_path / "extri.yml").write_text(f"{head}Rot_03: {rot}T_03: {t}", newline="")
    rig = import_cameras(tmp_path)
    (camera,) = rig.cameras
    assert (camera.width, rig.length_unit) == (None, UNKNOWN_UNIT)
    seen = opencv_pixels(points(), k_of(camera.lens), np.zeros(5), [[1, 0, 0], [0, 0, -1], [0, 1, 0.0]], [0, 1.5, 4])
    assert_sees(camera, points(), seen)


def test_caliscope_goes_out_and_leaves_out_what_is_not_calibrated(tmp_path):
    rig = random_rig(4, n=3, unit="mm")
    notes = export_cameras(rig, "caliscope", tmp_path / "camera_array.toml")
    assert "metres" in notes[0]
    assert "0 is 'cam1', 1 is 'cam2', 2 is 'cam3'" in notes[1]
    text = (tmp_path / "camera_array.toml").read_text()
    (tmp_path / "camera_array.toml").write_text(text + "\n[cameras.7]\ncam_id = 7\nsize = [640, 480]\n")
    back = import_cameras(tmp_path / "camera_array.toml")
    assert [c.name for c in back.cameras] == ["cam_0", "cam_1", "cam_2"]
    assert "not calibrated: cam_7" in back.notes[0]
    for one, other in zip(rig.cameras, back.in_unit("mm").cameras, strict=True):
        assert_sees(other, points(), one.pixel_from_world(points())[0], 1e-6)


# ---- what is none


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.yml", "%YAML:1.0\n---\nfoo: 1\nbar: [2, 3]\n", "it has the keys foo, bar"),
        ("a.toml", "[board]\nrows = 3\n[other]\nx = 1\n", "it has the keys board, other"),
        ("a.json", '{"left": {}, "right": {}}', "it has the keys left, right"),
        ("a.xml", "<?xml version='1.0'?><calib><left/><right/></calib>", "it has the keys calib, left, right"),
        ("a.txt", "\n  P0: 7.18e+02 0.0\n", "it begins with 'P0: 7.18e+02 0.0'"),
        ("a.bin", "", "it is empty"),
    ],
)
def test_a_file_that_is_not_known_says_what_it_has_and_what_is_read(tmp_path, name, text, said):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(DatasetError, match="is not recognised") as caught:
        import_cameras(path)
    assert said in caught.value.what
    assert all(f"{kind} (" in caught.value.why for kind in FORMATS)
    assert "cut off" not in str(caught.value)


def test_xml_that_unfolds_without_end_is_refused_at_once(tmp_path):
    entities = "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 10))
    path = tmp_path / "bomb.xml"
    path.write_text(
        f'<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a0 "1">{entities}]><x><camera_matrix>&a9;</camera_matrix></x>'
    )
    with pytest.raises(DatasetError, match="document type"):
        import_cameras(path, "opencv")
    with pytest.raises(DatasetError, match="not recognised"):
        import_cameras(path)


def example_files(tmp_path, kind):
    """Files of a kind that are whole, to be damaged."""
    rig = a_pair() if kind in ("opencv-stereo", "ros") else random_rig(5, fisheye=False)
    path = tmp_path / kind
    ending = (*FORMATS[kind].endings, "")[0]
    export_cameras(rig, kind, path if kind in ("ros", "easymocap") else path.with_suffix(ending))
    return (
        [path] if kind == "easymocap" else sorted(path.glob("*.yaml")) if kind == "ros" else [path.with_suffix(ending)]
    )


@pytest.mark.parametrize("kind", ["ros", "easymocap", "caliscope", "opencv-stereo"])
def test_damaged_files_are_clear_errors_or_whole_rigs(tmp_path, kind):
    """Cut off, with bytes changed or with lines repeated, with the kind named or not: never another exception."""
    given = example_files(tmp_path, kind)
    inner = sorted(given[0].iterdir()) if given[0].is_dir() else given
    rng, errors = random.Random(0), []
    for round_ in range(120):
        file = inner[round_ % len(inner)]
        good = file.read_bytes()
        file.write_bytes(damaged(good, round_ % 3, rng))
        try:
            rig = import_cameras(given, kind if round_ % 2 else None)
            assert all(np.isfinite(astuple(c.lens)).all() for c in rig.cameras)
        except ImplicamError as error:
            errors.append(error)
        file.write_bytes(good)
    assert len(errors) > 30
    assert [error for error in errors if not error.fix] == []


def test_the_table_of_the_docs_has_every_format():
    rows = re.findall(
        r"^\| `([a-z0-9-]+)` \|", (Path(__file__).parents[1] / "docs" / "exchange.md").read_text(), re.MULTILINE
    )
    assert set(FORMATS) <= set(rows)


def test_a_size_that_the_file_does_not_say_is_given():
    rig = import_cameras(CASES / "opencv-stereo-file" / "stereo.yml", unit="mm")
    sized = rig.with_sizes({"cam1": (640, 480)})
    assert [(c.width, c.height) for c in sized.cameras] == [(640, 480), (None, None)]
    with pytest.raises(DatasetError, match="cam1' has images of 640 x 480 px in the file"):
        sized.with_sizes({"cam1": (1280, 960)})
    with pytest.raises(DatasetError, match="there is no camera 'cam3'"):
        rig.with_sizes({"cam3": (640, 480)})


def test_cameras_that_were_imported_go_on_to_another_program(tmp_path):
    """Without known points there is nothing about which a lens could be fitted again: it is the one of the file."""
    rig = import_cameras(CASES / "opencv-stereo-file" / "stereo.yml", unit="mm")
    calibration_of(rig, "pair", 0.3).save(tmp_path / "pair.implicam")
    again, notes = rig_of(load_calibration(tmp_path / "pair.implicam"))
    assert notes == []
    assert [c.lens for c in again.cameras] == [c.lens for c in rig.cameras]
    np.testing.assert_allclose(again.cameras[1].camera_from_world.centre, [60, 0, 0], atol=1e-12)


@pytest.mark.parametrize("kind", ["caliscope", "aniposelib", "opencv", "kalibr"])
def test_a_format_is_recognised_whatever_the_file_is_called(kind: str, tmp_path: Path) -> None:
    rig = random_rig(0)
    ending = ".toml" if kind in ("caliscope", "aniposelib") else ".yaml"
    export_cameras(rig, kind, tmp_path / f"cameras{ending}")
    (tmp_path / f"cameras{ending}").rename(tmp_path / "cameras.bak")
    assert [c.lens for c in import_cameras(tmp_path / "cameras.bak").cameras] == pytest.approx(
        [c.lens for c in import_cameras(tmp_path / "cameras.bak", kind).cameras]
    )
