"""`implicam simulate --images` and `implicam detect`, as a person uses them: real pictures, real files."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from implicam.cli import main
from implicam.dataset import read_dataset

pytestmark = pytest.mark.usefixtures("looks_kept")

cv2 = pytest.importorskip("cv2")

Cli = Callable[..., tuple[int, str, str]]


@pytest.fixture
def cli(capsys: pytest.CaptureFixture[str]) -> Cli:
    def run(*words: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as ended:
            main([str(word) for word in words])
        told = capsys.readouterr()
        return int(ended.value.code or 0), told.out, told.err

    return run


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stereo rig with twelve positions of the ball; a tenth of the pictures covered."""
    folder = tmp_path_factory.mktemp("made") / "photos"
    with pytest.raises(SystemExit):
        main(f"simulate {folder} --images --rig stereo --grid 3x2x2 --missing 0.1 --seed 4".split())
    return folder


@pytest.fixture
def photos(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "photos"))


@pytest.mark.slow
def test_photographs_are_there_and_dataset_toml_says_what_they_show(photos: Path) -> None:
    data = read_dataset(photos)
    assert data.extra["target"] == {"kind": "ball", "radius": 8.0}
    for camera in data.cameras:
        names = {path.name for path in (photos / "images" / camera.name).iterdir()}
        assert names == {f"ball{i:03d}.png" for i in range(1, 13)}
        assert cv2.imread(str(photos / "images" / camera.name / "ball001.png")).shape == (1024, 1280, 3)


@pytest.mark.slow
def test_detect_finds_the_ball_where_the_truth_is_and_nowhere_else(photos: Path, cli: Cli) -> None:
    truth = read_dataset(photos)
    code, out, _ = cli("detect", photos)  # target and radius from dataset.toml
    assert code == 0
    assert "cam2" in out
    found = read_dataset(photos)
    assert (found.observations.seen == truth.observations.seen).mean() > 0.95
    assert not (found.observations.seen & ~truth.observations.seen).any()
    both = found.observations.seen
    true_uv = np.stack([truth.observations.extra[f"true_{axis}"][both].astype(float) for axis in "uv"], axis=1)
    error = found.observations.uv[both] - true_uv
    assert np.sqrt(np.mean(error**2)) < 0.06
    assert np.abs(error.mean(axis=0)).max() < 0.03
    assert (photos / "observations.before-detect.csv").exists()
    assert len(list((photos / "detections" / "overlays").rglob("*.jpg"))) == 24


@pytest.mark.slow
def test_the_middle_of_the_outline_is_corrected(photos: Path, cli: Cli) -> None:
    code, _, err = cli("detect", photos, "--no-overlays")
    assert code == 0
    assert "corrected" in err
    moved = read_dataset(photos).observations
    outline = np.stack([moved.extra["outline_u"][moved.seen], moved.extra["outline_v"][moved.seen]], axis=1)
    assert 0 < np.abs(moved.uv[moved.seen] - outline.astype(float)).max() < 1


@pytest.mark.slow
def test_without_a_radius_the_outline_is_what_is_given_and_it_says_so(photos: Path, cli: Cli) -> None:
    toml = photos / "dataset.toml"
    toml.write_text(toml.read_text().replace("radius = 8.0", ""))
    code, _, err = cli("detect", photos, "--target", "ball", "--no-overlays")
    assert code == 0
    assert "--radius" in err
    assert "outline_u" not in read_dataset(photos).observations.extra


@pytest.mark.slow
def test_json_and_going_on_where_it_stopped(photos: Path, cli: Cli) -> None:
    first = json.loads(cli("detect", photos, "--json", "--no-overlays")[1])
    again = json.loads(cli("detect", photos, "--json", "--no-overlays")[1])
    assert (first["resumed"], again["resumed"]) == (0, 24)
    assert first["cameras"] == again["cameras"]
    once_more = json.loads(cli("detect", photos, "--json", "--no-overlays", "--restart")[1])
    assert once_more["resumed"] == 0


@pytest.mark.slow
def test_one_click_teaches_what_the_ball_looks_like(photos: Path, cli: Cli) -> None:
    data = read_dataset(photos)
    u, v = (float(x) for x in np.rint(data.observations.uv[3, 0]))
    picture = photos / "images" / "cam1" / f"{data.points[3]}.png"
    code, _, _ = cli("detect", photos, "--click", f"{picture}:{u:.0f},{v:.0f}", "--no-overlays")
    assert code == 0
    found = read_dataset(photos).observations
    assert (found.seen & data.observations.seen).sum() >= 0.9 * data.observations.seen.sum()
    assert np.nanmax(np.abs(found.uv - data.observations.uv)) < 2


@pytest.mark.slow
def test_a_pattern_finds_pictures_in_one_folder(photos: Path, cli: Cli) -> None:
    flat = photos / "flat"
    flat.mkdir()
    for path in (photos / "images").rglob("*.png"):
        shutil.copy(path, flat / f"{path.stem}_{path.parent.name}.png")
    code, _, _ = cli("detect", photos, "--pictures", "flat", "--pattern", "{shot}_{camera}", "--no-overlays")
    assert code == 0
    assert len(read_dataset(photos)) == 12


@pytest.mark.slow
def test_a_folder_of_pictures_alone_becomes_a_dataset(photos: Path, cli: Cli) -> None:
    for name in ("dataset.toml", "points.csv", "observations.csv", "truth.toml"):
        (photos / name).unlink()
    code, _, err = cli("detect", photos, "--target", "ball", "--no-overlays")
    assert code == 2
    assert "--unit mm" in err
    code, _, err = cli("detect", photos, "--target", "ball", "--unit", "mm", "--radius", "8", "--no-overlays")
    assert code == 0
    assert "--calibration" in err  # the outline cannot be corrected yet, and it says with what it could be
    data = read_dataset(photos)
    assert (data.length_unit, data.known, len(data.cameras)) == ("mm", None, 2)


@pytest.mark.slow
def test_bad_pictures_are_named_and_the_rest_goes_on(photos: Path, cli: Cli) -> None:
    images = photos / "images"
    cut = images / "cam1" / "ball001.png"
    cut.write_bytes(cut.read_bytes()[:50_000])
    (images / "cam1" / "ball002.png").write_text("no picture")
    cv2.imwrite(str(images / "cam1" / "ball003.png"), np.zeros((1024, 1280), np.uint8))
    turned = images / "cam2" / "ball004.png"
    cv2.imwrite(str(turned), cv2.rotate(cv2.imread(str(turned)), cv2.ROTATE_90_CLOCKWISE))
    (images / "cam2" / "ball005.png").unlink()
    code, _, err = cli("detect", photos, "--no-overlays")
    assert code == 0
    for name in ("ball001.png", "ball002.png", "ball003.png", "ball004.png", "ball005"):
        assert name in err
    assert "rotated" in err
    assert read_dataset(photos).observations.seen.sum() >= 14


@pytest.mark.parametrize(("words", "code", "says"), [
    ("detect PHOTOS --target bal", 2, "did you mean 'ball'"),
    ("detect PHOTOS/points.csv", 2, "is not a folder"),
    ("detect PHOTOS --click here", 2, "--click 'here' is not a place"),
    ("detect PHOTOS --target board", 2, "--board 8x11"),
    ("detect PHOTOS --target board --board 8by11", 2, "is not a size"),
    ("detect PHOTOS --target board --board 7x9", 2, "upside down"),
    ("detect PHOTOS --target charuco --board 9x12", 2, "--square and --marker"),
    ("detect PHOTOS --target dots", 2, "labels.csv does not exist"),
    ("detect PHOTOS --pattern {shot}", 2, "must contain {camera}"),
    ("detect PHOTOS --radius 8 --calibration PHOTOS/none.implicam", 1, "none.implicam"),
    ("simulate OUT --images --outliers 0.1", 2, "cannot be photographed"),
])  # fmt: skip
def test_what_is_wrong_is_said_with_its_cure(words: str, code: int, says: str, photos: Path, cli: Cli) -> None:
    before = (photos / "observations.csv").read_bytes()
    given = [w.replace("PHOTOS", str(photos)).replace("OUT", str(photos.parent / "out")) for w in words.split()]
    got, _, err = cli(*given)
    assert got == code, err
    assert says in err
    assert "fix:" in err
    assert (photos / "observations.csv").read_bytes() == before
    assert not (photos.parent / "out").exists()


@pytest.mark.slow
def test_photographs_without_a_board_say_so(photos: Path, cli: Cli) -> None:
    before = (photos / "observations.csv").read_bytes()
    for picture in (photos / "images").rglob("*.png"):
        if picture.name > "ball002.png":
            picture.unlink()
    code, _, err = cli("detect", photos, "--target", "board", "--board", "8x11")
    assert code == 1
    assert "nothing was found in any of the 4 pictures" in err
    assert "fix:" in err
    assert (photos / "observations.csv").read_bytes() == before


@pytest.mark.slow
def test_a_board_from_photograph_to_numbered_corners(tmp_path: Path, cli: Cli) -> None:
    folder = tmp_path / "board"
    code, _, err = cli(*f"simulate {folder} --images --target board --boards 2 --cameras 2R --seed 2".split())
    assert code == 0, err
    truth = read_dataset(folder)
    code, _, err = cli("detect", folder)
    assert code == 0, err
    found = read_dataset(folder).observations
    seen = found.seen & truth.observations.seen
    assert seen.sum() > 0.95 * truth.observations.seen.sum()
    true_uv = np.stack([truth.observations.extra[f"true_{axis}"][seen].astype(float) for axis in "uv"], axis=1)
    error = found.uv[seen] - true_uv
    assert np.abs(error).max() < 0.5  # a wrong number would be off by a square, 40 pixels
    assert np.sqrt(np.mean(error**2)) < 0.1


@pytest.mark.slow
def test_pictures_called_left1_and_right1_become_a_calibration(tmp_path: Path, cli: Cli) -> None:
    """Nothing but a folder of pictures: names, [target] and the square are all that `explicit` asks for."""
    made, folder = tmp_path / "made", tmp_path / "pictures"
    words = ["--rig", "stereo", "--target", "boards", "--each", "2", "--pairs", "4", "--seed", "3"]
    assert cli("simulate", made, "--images", *words)[0] == 0
    folder.mkdir()
    for camera, side in (("cam1", "left"), ("cam2", "right")):
        for path in (made / "images" / camera).iterdir():
            shutil.copy(path, folder / f"{side}{int(path.stem.removeprefix('held'))}.png")
    code, _, err = cli(
        "detect", folder, "--target", "board", "--board", "8x11", "--square", "13.29", "--unit", "mm", "--no-overlays"
    )
    assert code == 0
    assert "left1.png is shot '1' of camera 'left'" in err
    data = read_dataset(folder)
    assert data.observations.camera_names == ("left", "right")
    assert data.extra["target"] == {"kind": "board", "rows": 8, "columns": 11, "square": 13.29}
    assert cli("calibrate", folder, "-o", tmp_path / "rig.implicam", "--force")[0] in (0, 1)
    assert (tmp_path / "rig.implicam").exists()


def test_corners_without_a_board_say_what_is_missing(tmp_path: Path, cli: Cli) -> None:
    """dataset.toml without [target], as detect wrote it before: the error names it, and not points.csv."""
    (tmp_path / "dataset.toml").write_text(
        'name = "a"\nlength_unit = "mm"\n[[cameras]]\nname = "left"\n[[cameras]]\nname = "right"\n'
    )
    rows = [f"1-c{k:03d},{c},{100 + 9 * k},{50 + 7 * (k % 3)}" for k in range(1, 10) for c in ("left", "right")]
    (tmp_path / "observations.csv").write_text("\n".join(["point,camera,u,v", *rows]) + "\n")
    code, _, err = cli("calibrate", tmp_path, "--method", "explicit", "-o", tmp_path / "x.implicam")
    assert code == 1
    assert "[target]" in err
    assert "implicam detect writes it" in err
