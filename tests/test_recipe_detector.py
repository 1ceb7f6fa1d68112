"""The recipe "A detector" of CONTRIBUTING.md, followed to the letter by a toy, from the command line to a session."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest
from scipy import ndimage

from command_line import Cli, cli  # noqa: F401  a fixture
from implicam import registry
from implicam.dataset import read_dataset
from implicam.detect import TARGETS, Detected, DetectorBase, Option, View
from implicam.detect.model import nothing
from implicam.errors import UsageError
from implicam.images import write_picture
from implicam.session.setup import Setup, open_session
from implicam.viewer.snapshot import snapshot

pytestmark = pytest.mark.usefixtures("looks_kept")

# Step 1: the detector, a frozen dataclass


@dataclass(frozen=True)
class Lamp(DetectorBase):
    """The centroid of the largest blob that is brighter than `above`, or, `dark`, darker than that."""

    above: float = 0.5
    dark: bool = False

    def options(self) -> dict[str, Any]:
        """All that the results depend on."""
        return {"target": "lamp", **asdict(self)}

    def detect(self, picture: Any, view: View) -> Detected:
        """One point, of the name of the shot."""
        labels, count = ndimage.label((picture < self.above) if self.dark else (picture > self.above))
        if not count:
            return nothing(f"nothing is brighter than {self.above:g}: switch the lamp on")
        sizes = np.bincount(labels.ravel())[1:]
        v, u = ndimage.center_of_mass(labels == np.argmax(sizes) + 1)
        radius = float(np.sqrt(sizes.max() / np.pi))
        turn = np.linspace(0, 2 * np.pi, 33)
        outline = np.array([u, v]) + radius * np.column_stack([np.cos(turn), np.sin(turn)])
        return Detected((view.shot,), np.array([[u, v]]), np.full((1, 2), 0.3), outlines=(outline,))

    # Step 2: the command line

    @classmethod
    def from_options(
        cls,
        dataset: Path,
        described: Mapping[str, Any],
        *,
        above: Annotated[float | None, Option("the least brightness, of 1", "NUMBER", 0)] = None,
        dark: Annotated[bool, Option("it is darker than that")] = False,
        radius: Annotated[float | None, Option("how large it is", "LENGTH", 0)] = None,
    ) -> Lamp:
        """`radius` is an option that the ball has, too."""
        if above is not None and above >= 1:
            raise UsageError(f"nothing is brighter than {above:g}.", fix="--above 0.5")
        return cls(0.5 if above is None else float(above), dark)


# Step 3: the registry; the two ways


@pytest.fixture(autouse=True, params=["registered", "entry point"])
def known_target(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TARGETS, "_parts", dict(TARGETS._parts))  # so that it is gone after the test
    if request.param == "registered":
        TARGETS.register("lamp", Lamp)
    else:
        added = EntryPoints([EntryPoint("lamp", f"{__name__}:Lamp", "implicam.detectors")])
        monkeypatch.setattr(registry, "entry_points", lambda **by: added.select(**by))


AT = {"cam1": (40.0, 50.0), "cam2": (70.0, 30.0)}


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """Three pictures of two cameras; the last of cam2 is dark. The lamp goes 10 pixels to the right each time."""
    folder = tmp_path / "photos"
    v, u = np.mgrid[:120, :160]
    for camera, (at_u, at_v) in AT.items():
        (folder / "images" / camera).mkdir(parents=True)
        for shot in range(3):
            brightness = 100 if (camera, shot) == ("cam2", 2) else 230
            grey = np.where(np.hypot(u - at_u - 10 * shot, v - at_v) <= 6, brightness, 30).astype(np.uint8)
            write_picture(folder / "images" / camera / f"p{shot}.png", np.repeat(grey[..., None], 3, axis=2))
    return folder


def test_the_command_finds_it_and_draws_what_it_found(photos: Path, cli: Cli) -> None:
    ran = cli("detect", photos, "--target", "lamp", "--unit", "mm")
    assert ran.code == 0, ran.err
    assert "1 picture: nothing is brighter than 0.5: switch the lamp on" in ran.err
    data = read_dataset(photos)
    assert tuple(data.points) == ("p0", "p1", "p2")
    for k, (at_u, at_v) in enumerate(AT.values()):
        expected = np.array([[at_u + 10 * shot, at_v] for shot in range(3 - k)])
        assert data.observations.uv[: 3 - k, k] == pytest.approx(expected, abs=0.01)
    assert np.isnan(data.observations.uv[2, 1]).all()
    overlays = {path.relative_to(photos / "detections").as_posix() for path in photos.rglob("*.jpg")}
    assert overlays == {"cam1.jpg", "cam2.jpg"} | {f"overlays/cam{c}/p{s}.jpg" for c in (1, 2) for s in range(3)}


def test_a_run_goes_on_and_another_option_begins_again(photos: Path, cli: Cli) -> None:
    words = ("detect", photos, "--target", "lamp", "--unit", "mm", "--no-overlays", "--json")
    assert [cli(*words, *more).json["resumed"] for more in ((), (), ("--above", 0.4), ("--above", 0.4))] == [0, 6, 0, 6]


def test_dataset_toml_can_name_it_and_its_options(photos: Path, cli: Cli) -> None:
    assert cli("detect", photos, "--target", "lamp", "--unit", "mm").code == 0
    with (photos / "dataset.toml").open("a") as file:
        file.write('\n[target]\nkind = "lamp"\nabove = 0.95\n')
    ran = cli("detect", photos)
    assert ran.code == 1
    assert "nothing is brighter than 0.95" in ran.err
    assert cli("detect", photos, "--above", "0.5").code == 0


def test_help_has_its_options(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    told = " ".join(cli("detect", "--help").out.split())
    assert "lamp: the least brightness, of 1." in told
    assert "ball: its radius, in the dataset's unit; lamp: how large it is." in told


@pytest.mark.parametrize(("words", "what", "cure"), [
    ("--target lmap", "did you mean 'lamp'", "use one of ball, board, charuco, aprilgrid, dotgrid, dots, wand, lamp"),
    ("--target lamp --above 2", "nothing is brighter than 2.", "--above 0.5"),
    ("--target lamp --above -1", "", ""),
    ("--target lamp --marker 3", "the target 'lamp' has no option --marker", "lamp has --above, --dark, --radius"),
    ("--target ball --above 0.5", "the target 'ball' has no option --above", "leave it out"),
    ("--target lamp:bright", "has no variants", "--target lamp"),
    ("", "which target is it?", "--target ball|board|charuco|aprilgrid|dotgrid|dots|wand|lamp"),
])  # fmt: skip
def test_what_is_wrong_is_said_with_its_cure(words: str, what: str, cure: str, photos: Path, cli: Cli) -> None:
    ran = cli("detect", photos, "--unit", "mm", *words.split())
    told = " ".join(ran.err.split())
    assert ran.code == 2
    assert what in told
    assert cure in told


def test_a_session_finds_it_in_its_live_pictures(tmp_path: Path) -> None:
    with open_session(tmp_path / "session", Setup(rig="stereo", budget=12, speed=1e6)) as controller:
        detector, _ = TARGETS.find("lamp")
        lamp = detector.from_options(tmp_path, {}, above=0.25, dark=True)
        controller.equipment = replace(controller.equipment, detector=lamp)
        controller.start()
        controller.go()
        for look in controller.state.looks:
            assert look.frame is not None
            assert look.found.points == ("live",)
            assert np.array_equal(look.uv, lamp.detect(look.frame.picture, View(look.camera, "live")).uv[0])
        names = [look.camera for look in controller.state.looks]
        shown = snapshot(
            controller.state, names, np.full(3, np.nan), controller.loop.rule, unit="mm", moves=True, skipped=0
        )
        for row, look in zip(shown["cameras"], controller.state.looks, strict=True):
            assert row["ball"] == look.uv.tolist()
        controller.accept()
        assert controller.loop.points == 1


def test_its_options_are_plain_values() -> None:
    assert json.loads(json.dumps(Lamp(0.3).options())) == {"target": "lamp", "above": 0.3, "dark": False}
    assert replace(Lamp(), dark=True).options() != Lamp().options()
