"""Cameras of OpenPTV, MyPTV and Qualisys, by the formulas of their own code, and by optv where it is installed."""

import random
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from implicam.errors import DatasetError, ImplicamError
from implicam.exchange import UNKNOWN_UNIT, ExplicitCamera, Rig, export_cameras, import_cameras
from implicam.geometry import Pose, look_at
from implicam.lenses import BrownConrady
from test_exchange import damaged, points, random_rig

DATA = Path(__file__).parent / "data" / "exchange"
OPENPTV = DATA / "openptv-0.3.2"
XYZ = np.array([[0.0, 0, 0], [30, 10, -20], [-40, 25, 10], [5, -30, 15]])
OPTV_SAW = [
    [
        [653.1437173598152, 507.82484088586705],
        [925.2184771970518, 316.15635728685567],
        [194.51698609075595, 397.6089710285233],
        [765.1832830275919, 795.1850529896864],
    ],
    [
        [674.29466673342, 547.1799937246954],
        [937.0326452273265, 445.29143428581074],
        [287.27818179421536, 216.4506857413205],
        [737.2130433199329, 921.4370594987759],
    ],
]
"""Pixels that image_coordinates of optv 0.3.2 gave for these points, after it wrote the files in data/exchange."""


# ---- openptv


@pytest.mark.parametrize("given", ["", "cal", "cal/cam1.tif.ori cal/cam2.tif.ori"])
def test_files_of_openptv_are_read(given):
    """cam1 has its distortion about the principal point, and is exact; cam2 has not, and is within what is told."""
    rig = import_cameras([OPENPTV / part for part in given.split()] or OPENPTV)
    assert [c.name for c in rig.cameras] == ["cam1", "cam2"]
    assert rig.length_unit == "mm"
    assert (rig.cameras[0].width, rig.cameras[0].height) == (1280, 1024)
    (note,) = rig.notes
    cost = float(re.search(r"at most ([\d.e-]+) px", note)[1])
    assert note.startswith("Camera 'cam2'")
    assert cost < 0.2
    for camera, seen, within in zip(rig.cameras, OPTV_SAW, (1e-6, cost), strict=True):
        off = camera.pixel_from_world(XYZ)[0] + 0.5 - seen  # OpenPTV's pixels begin at the corner of the first
        assert np.linalg.norm(off, axis=1).max() < 1.1 * within


def openptv_pixels(folder, name, xyz):
    """OpenPTV's own way, from its files: angles, cc, the shift, the distortion about the middle of the sensor."""
    words = [float(x) for x in (folder / "cal" / f"{name}.tif.ori").read_text().split()]
    k1, k2, k3, p1, p2, scx, she = map(float, (folder / "cal" / f"{name}.tif.addpar").read_text().split())
    (om, ph, ka), (xh, yh, cc) = words[3:6], words[15:18]
    co, so, cp, sp, ck, sk = np.cos(om), np.sin(om), np.cos(ph), np.sin(ph), np.cos(ka), np.sin(ka)
    dm = np.array(
        [
            [cp * ck, -cp * sk, sp],
            [co * sk + so * sp * ck, co * ck - so * sp * sk, -so * cp],
            [so * sk - co * sp * ck, so * ck + co * sp * sk, co * cp],
        ]
    )
    np.testing.assert_allclose(np.reshape(words[6:15], (3, 3)), dm, atol=1e-6)
    q = (xyz - words[:3]) @ dm
    x, y = -cc * q[:, 0] / q[:, 2] + xh, -cc * q[:, 1] / q[:, 2] + yh
    r2 = x * x + y * y
    bend = k1 * r2 + k2 * r2**2 + k3 * r2**3
    bx = x + x * bend + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
    by = y + y * bend + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
    par = (folder / "parameters" / "ptv.par").read_text().split()
    imx, imy, pix_x, pix_y = map(float, par[-9:-5])
    return np.column_stack([imx / 2 + scx * (bx - np.sin(she) * by) / pix_x, imy / 2 - scx * np.cos(she) * by / pix_y])


def written_openptv(tmp_path, seed=3):
    rig = random_rig(seed, n=3, unit="mm", fisheye=False)
    cameras = [
        replace(c, lens=replace(c.lens, fy=c.lens.fx, k1=-0.1, k2=0.02, k3=0.0), name=f"cam {i}")
        for i, c in enumerate(rig.cameras, 1)
    ]
    rig = replace(rig, cameras=tuple(cameras))
    return rig, export_cameras(rig, "openptv", tmp_path / "e")


def test_openptv_sees_the_same_pixels_in_what_is_written(tmp_path):
    rig, notes = written_openptv(tmp_path)
    assert notes[-1] == "Spaces in camera names became _."
    costs = {
        re.search("'([^']*)'", note)[1]: float(re.search(r"at most ([\d.e-]+) px", note)[1]) for note in notes[1:-1]
    }
    assert list(costs) == ["cam 1", "cam 2", "cam 3"]
    back = import_cameras(tmp_path / "e")
    for camera, again in zip(rig.cameras, back.cameras, strict=True):
        ours = camera.pixel_from_world(points())[0] + 0.5
        theirs = openptv_pixels(tmp_path / "e", camera.name.replace(" ", "_"), points())
        assert np.linalg.norm(theirs - ours, axis=1).max() < 1.2 * costs[camera.name]
        np.testing.assert_allclose(again.pixel_from_world(points())[0] + 0.5, theirs, atol=0.1)


def test_optv_reads_what_is_written(tmp_path):
    calibration = pytest.importorskip("optv.calibration")
    from optv.imgcoord import image_coordinates
    from optv.parameters import ControlParams
    from optv.transforms import convert_arr_metric_to_pixel

    rig, _ = written_openptv(tmp_path)
    control = ControlParams(len(rig.cameras))
    control.read_control_par(str(tmp_path / "e" / "parameters" / "ptv.par"))
    for camera in rig.cameras:
        stem = str(tmp_path / "e" / "cal" / f"{camera.name.replace(' ', '_')}.tif")
        read = calibration.Calibration()
        read.from_file(f"{stem}.ori", f"{stem}.addpar")
        metric = image_coordinates(points(), read, control.get_multimedia_params())
        seen = convert_arr_metric_to_pixel(metric, control)
        hand = openptv_pixels(tmp_path / "e", camera.name.replace(" ", "_"), points())
        np.testing.assert_allclose(seen, hand, atol=1e-6)


def test_cameras_behind_glass_and_water_are_refused(tmp_path):
    """The example of OpenPTV itself (test_cavity) looks through glass into water."""
    shutil.copytree(OPENPTV, tmp_path / "e")
    par = tmp_path / "e" / "parameters" / "ptv.par"
    par.write_text(par.read_text().replace("0\n1\n1\n1\n1\n", "0\n1\n1.33\n1.46\n6\n"))
    with pytest.raises(DatasetError, match=r"look through 1 / 1.33 / 1.46") as caught:
        import_cameras(tmp_path / "e")
    assert "forward-gp" in caught.value.fix


def test_openptv_without_its_parameters_says_what_is_missing(tmp_path):
    shutil.copytree(OPENPTV / "cal", tmp_path / "cal")
    with pytest.raises(DatasetError, match=r"ptv.par is missing"):
        import_cameras(tmp_path / "cal")
    new = tmp_path / "parameters_Run1.yaml"
    new.write_text(
        "num_cams: 2\nptv:\n  imx: 1280\n  imy: 1024\n  pix_x: 0.012\n  pix_y: 0.012\n  chfield: 0\n  mmp_n1: 1.0\n"
        "  mmp_n2: 1.0\n  mmp_n3: 1.0\n  mmp_d: 0.0\n  img_cal: [cal/cam2.tif, cal/cam1.tif]\n"
    )
    assert [c.name for c in import_cameras(tmp_path).cameras] == ["cam2", "cam1"]
    (tmp_path / "cal" / "cam1.tif.addpar").unlink()
    assert any("has no distortion" in note for note in import_cameras(tmp_path).notes)
    (tmp_path / "cal" / "cam1.tif.addpar").write_text("0 0 0 0 0 1.01 0")
    assert any("scx = 1.01" in note for note in import_cameras(tmp_path).notes)
    (tmp_path / "cal" / "cam2.tif.ori").write_text("1 2 3")
    with pytest.raises(DatasetError, match="has 3 numbers; a camera of OpenPTV has 21"):
        import_cameras(tmp_path)
    new.write_text(new.read_text().replace("chfield: 0", "chfield: 1"))
    with pytest.raises(DatasetError, match="chfield = 1"):
        import_cameras(tmp_path)


# ---- myptv


def rotation(angles):
    (cx, sx), (cy, sy), (cz, sz) = ((np.cos(t), np.sin(t)) for t in angles)
    rx, ry = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]]), np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    return rx @ ry @ np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])


def myptv_rays(path, uv):
    """MyPTV's get_r, from its file: where its pixels look, and its centre; the direction has no sign."""
    lines = path.read_text().splitlines()
    w, h = map(float, lines[2].split())
    centre, angles, (f,), (xh, yh) = (np.array([float(x) for x in line.split()]) for line in lines[3:7])
    e = np.array([[float(x) for x in line.split()] for line in lines[7:10]])
    eta, zeta = uv.T
    z5 = np.stack([eta, zeta, eta**2, zeta**2, eta * zeta])
    r = (-np.stack([eta - w / 2 - xh, zeta - h / 2 - yh, np.full(len(uv), f)]) - e @ z5).T @ rotation(angles)
    return centre, r / np.linalg.norm(r, axis=1, keepdims=True)


MYPTV = """Tsai model camera
cam1
1280 1024 
120.5 -40.0 -600.0 
0.05 -0.2 0.7 
{f} 
3.5 -2.25 
{e} 
0.0002 -0.002 1e-07 0.0 2e-07 
0.0 0.0 0.0 0.0 0.0 
"""  # noqa: W291  MyPTV ends its lines with a space


@pytest.mark.parametrize("f", ["4000.0", "-4000.0"])
@pytest.mark.parametrize("e", ["0.0 0.0 0.0 0.0 0.0", "0.002 0.0002 -3e-07 1e-07 0.0"])
def test_cameras_of_myptv_look_where_myptv_looks(tmp_path, f, e):
    path = tmp_path / "cam1"
    text = MYPTV.format(f=f, e=e)
    path.write_text(text if "e-07" in e else re.sub("0.0002 -0.*2e-07", "0.0 0.0 0.0 0.0 0.0", text))
    rig = import_cameras(path)
    assert rig.length_unit == UNKNOWN_UNIT
    (camera,) = rig.cameras
    assert (camera.name, camera.width, camera.height) == ("cam1", 1280, 1024)
    uv = np.random.default_rng(0).uniform([0, 0], [1279, 1023], (50, 2))
    centre, rays = myptv_rays(path, uv)
    np.testing.assert_allclose(camera.camera_from_world.centre, centre, atol=1e-9)
    turn = camera.camera_from_world.rotation
    rays *= np.sign((rays @ turn.T)[:, 2:])
    told = [float(m[1]) for note in rig.notes if (m := re.search(r"at most ([\d.e-]+) px", note))]
    assert bool(told) == ("e-07" in e)
    off = np.linalg.norm(camera.pixel_from_world(centre + 1000 * rays)[0] - uv, axis=1)
    assert off.max() < (1.1 * told[0] if told else 1e-8)
    if told:
        assert told[0] < 0.5


def test_myptv_looks_where_we_look_in_what_is_written(tmp_path):
    lens = BrownConrady(4000.0, 4010.0, 630.0, 505.0, -0.05)
    cameras = [
        ExplicitCamera("a", 1280, 1024, BrownConrady(4000.0, 4000.0, 630.0, 505.0), look_at([0, 0, -3], [0, 0, 0])),
        ExplicitCamera("b", 1280, 1024, lens, look_at([1, 0.5, -3], [0, 0, 0])),
    ]
    notes = export_cameras(Rig(tuple(cameras), "m"), "myptv", tmp_path / "c")
    cost = float(re.search(r"at most ([\d.e-]+) px", notes[1])[1])
    assert len(notes) == 2
    uv = np.random.default_rng(0).uniform([0, 0], [1279, 1023], (50, 2))
    for camera, within in zip(cameras, (1e-8, cost), strict=True):
        centre, rays = myptv_rays(tmp_path / "c" / camera.name, uv)
        rays *= np.sign((rays @ camera.camera_from_world.rotation.T)[:, 2:])
        off = np.linalg.norm(camera.pixel_from_world(centre + 3 * rays)[0] - uv, axis=1)
        assert off.max() < 1.1 * within
    back = import_cameras(tmp_path / "c", unit="m")
    assert [c.name for c in back.cameras] == ["a", "b"]
    wide = replace(cameras[0], lens=BrownConrady(900.0, 900.0, 630.0, 505.0, -0.2))
    with pytest.raises(DatasetError, match="'a' cannot be written for MyPTV"):
        export_cameras(Rig((wide,), "m"), "myptv", tmp_path / "d")


def test_the_other_model_of_myptv_and_its_older_files_are_refused_by_name(tmp_path):
    path = tmp_path / "cam1"
    path.write_text("extendedZolof model camera\ncam1\nvariable_origin False \nO 0 \t 1.0 \n")
    with pytest.raises(DatasetError, match="extended Zolof") as caught:
        import_cameras(tmp_path)
    assert "known points" in caught.value.fix
    path.write_text("\n".join(MYPTV.format(f="4000", e="0 0 0 0 0").splitlines()[:9]))
    with pytest.raises(DatasetError, match="has 9 lines, the first 'Tsai model camera'"):
        import_cameras(path)


# ---- qualisys

QCA = """<?xml version="1.0" encoding="UTF-8"?>
<calibration source="Live" created="2026-01-01" qtm-version="2024.1" type="regular">
 <results std-dev="0.5" min-max-diff="2"/>
 <cameras>
  <camera active="1" point-count="2000" avg-residual="0.5" serial="26001" model="Miqus Video" viewrotation="0">
   <fov_video left="0" top="0" right="1919" bottom="1087"/>
   <transform x="4100.5" y="-2200.0" z="1800.0" {r}/>
   <intrinsic focallength="9.2" sensorMinU="0" sensorMaxU="122879" sensorMinV="0" sensorMaxV="69631"
    focalLengthU="107840" focalLengthV="107904" centerPointU="60800" centerPointV="32640" skew="0"
    radialDistortion1="-0.045" radialDistortion2="0.14" radialDistortion3="0.01"
    tangentalDistortion1="0.0006" tangentalDistortion2="-0.0004"/>
  </camera>
  <camera active="0" serial="26002" model="Miqus Video" viewrotation="90"/>
 </cameras>
</calibration>
"""


def test_the_calibration_of_qualisys_is_read(tmp_path):
    """Its frame: y up, z back, rows r11 ... from the world; the centre stated; 64 units a pixel; k1 as it is."""
    turn = rotation([0.3, -0.2, 1.1]).T
    text = QCA.format(r=" ".join(f'r{i + 1}{j + 1}="{turn[i, j]!r}"' for i in range(3) for j in range(3)))
    path = tmp_path / "lab.qca.txt"
    path.write_text(re.sub(r"np\.float64\(([^)]*)\)", r"\1", text))
    rig = import_cameras(path)
    (camera,) = rig.cameras
    assert (camera.name, camera.width, camera.height, rig.length_unit) == ("26001", 1920, 1088, "mm")
    assert camera.lens == BrownConrady(1685.0, 1686.0, 950.0, 510.0, -0.045, 0.14, 0.0006, -0.0004, 0.01)
    np.testing.assert_allclose(camera.camera_from_world.centre, [4100.5, -2200, 1800], atol=1e-9)
    before = np.array([4100.5, -2200, 1800]) + np.array([[0, 0, -1000.0], [100, 50, -1000]]) @ turn
    seen = camera.pixel_from_world(before)[0]
    np.testing.assert_allclose(seen[0], [950, 510], atol=1e-9)
    assert seen[1, 0] > 950  # x is right
    assert seen[1, 1] < 510  # y is up
    assert any("not active: 26002" in note for note in rig.notes)
    assert any("half a pixel" in note for note in rig.notes)
    export_cameras(rig, "qualisys", tmp_path / "again.qca.txt")
    (again,) = import_cameras(tmp_path / "again.qca.txt").cameras
    assert (again.name, again.size, again.lens) == (camera.name, camera.size, camera.lens)
    np.testing.assert_allclose(again.pixel_from_world(before)[0], seen, atol=1e-9)
    path.write_text(path.read_text().replace(' centerPointU="60800"', ""))
    with pytest.raises(DatasetError, match=r"camera 26001: intrinsic: 'centerPointU' is missing"):
        import_cameras(path)


@pytest.mark.parametrize(
    ("attributes", "said"),
    [
        ('active="1" calibrated="true" video_resolution="1080p"', []),
        ('active="1" video_resolution="N/A"', []),
        ('active="1" calibrated="false"', ["Left out, because they are not calibrated: 26002."]),
        ('active="0" calibrated="true"', ["Left out, because they are not active: 26002."]),
        (
            'active="1" calibrated="1" video_resolution="540p"',
            ["QTM states video_resolution '540p' for 26002, and a view of 1920 x 1088 pixels"],
        ),
    ],
)
def test_a_camera_of_qualisys_that_its_own_file_does_not_vouch_for_is_named(tmp_path, attributes, said):
    text = QCA.format(r=" ".join(f'r{i}{j}="{int(i == j)}"' for i in "123" for j in "123"))
    first, rest = text.split('  <camera active="0"')
    camera = first[first.index("<fov_video") :]
    path = tmp_path / "lab.qca.txt"
    path.write_text(f'{first}  <camera {attributes} serial="26002">{camera}{rest[rest.index("/>") + 2 :]}')
    rig = import_cameras(path)
    assert len(rig.cameras) == 1 + (not said or "Left out" not in said[0])
    told = [note for note in rig.notes if "26002" in note]
    assert len(told) == len(said)
    assert all(note.startswith(wanted) for note, wanted in zip(told, said, strict=True))


# ---- hostile input


@pytest.mark.parametrize("kind", ["openptv", "myptv", "qualisys"])
def test_damaged_files_are_clear_errors_or_whole_rigs(tmp_path, kind):
    folder = tmp_path / kind
    if kind == "openptv":
        shutil.copytree(OPENPTV, folder)
    else:
        folder.mkdir()
        eye = " ".join(f'r{i}{j}="{int(i == j)}"' for i in "123" for j in "123")
        text = MYPTV.format(f="4000", e="0 0 0 0 0") if kind == "myptv" else QCA.format(r=eye)
        (folder / "cam1").write_text(text)
    given = folder if kind == "openptv" else folder / "cam1"
    inner = [file for file in sorted(folder.rglob("*")) if file.is_file()]
    rng, errors = random.Random(0), []
    for round_ in range(100):
        file = inner[round_ % len(inner)]
        good = file.read_bytes()
        file.write_bytes(damaged(good, round_ % 3, rng))
        try:
            assert import_cameras(given, kind if round_ % 2 else None).cameras
        except ImplicamError as error:
            errors.append(error)
        file.write_bytes(good)
    assert len(errors) > 30
    assert [error for error in errors if not error.fix] == []


def test_a_pose_is_kept_by_openptv_whatever_way_the_camera_looks(tmp_path):
    """Angles at their poles included: straight down the axes."""
    for i, at in enumerate(([0, 0, 5], [0, 0, -5], [5, 0, 0], [-5, 0, 0], [0, 5, 0], [0, -5, 0])):
        up = [0, 0, 1] if i > 3 else [0, 1, 0]
        camera = ExplicitCamera("c", 1280, 1024, BrownConrady(2000.0, 2000.0, 639.5, 511.5), look_at(at, [0, 0, 0], up))
        export_cameras(Rig((camera,), "m"), "openptv", tmp_path / f"{i}")
        back = import_cameras(tmp_path / f"{i}").in_unit("m").cameras[0].camera_from_world
        assert isinstance(back, Pose)
        np.testing.assert_allclose(back.rotation, camera.camera_from_world.rotation, atol=1e-12)
        np.testing.assert_allclose(back.centre, at, atol=1e-9)
