"""Films: the offset between cameras found from a ball that moves, times, and what is wrong with a film named."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from command_line import Cli, cli  # noqa: F401  the fixture
from implicam.dataset import read_dataset
from implicam.detect import detect_films, films_of
from implicam.detect.ball import Ball
from implicam.detect.clocks import clocks_from_target, given_clocks, read_times
from implicam.detect.film import choose_different
from implicam.detect.model import Detected, DetectorBase, View
from implicam.detect.offsets import Offset, OffsetError, find_offset
from implicam.detect.tracks import Track
from implicam.errors import DatasetError, ImageError, UsageError
from implicam.films import Film, even, find_films
from implicam.images import read_picture
from implicam.progress import silent
from implicam.simulate import build_rig

cv2 = pytest.importorskip("cv2")

SIZE = (320, 240)
Path3D = Callable[[np.ndarray], np.ndarray]


def wander(seed: int = 0, cutoff: float = 1.2, terms: int = 14) -> Path3D:
    """A smooth random path in a cube of side 1."""
    rng = np.random.default_rng(seed)
    f, phase = rng.uniform(0.1, cutoff, (terms, 3)), rng.uniform(0, 2 * np.pi, (terms, 3))
    size = rng.normal(size=(terms, 3)) / np.sqrt(1 + (2 * f) ** 2)
    size *= 0.23 / np.sqrt(np.square(size).sum(axis=0))
    return lambda t: (size * np.sin(2 * np.pi * f * t[:, None, None] + phase)).sum(axis=1)


def pixel(xyz: np.ndarray, camera: int) -> np.ndarray:
    """What one of two pinhole cameras, some 30 degrees apart, sees of the cube."""
    angle = (-0.25, 0.3)[camera]
    x = xyz[:, 0] * np.cos(angle) + xyz[:, 2] * np.sin(angle)
    z = 3 - xyz[:, 0] * np.sin(angle) + xyz[:, 2] * np.cos(angle)
    return 500 * np.stack([x, xyz[:, 1] + 0.05 * camera], axis=1) / z[:, None] + [160, 120]


def draw(uv: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A dark disc with a soft edge before a white ground."""
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    away = np.hypot(u - uv[0], v - uv[1]) - 7
    picture = 40 + 180 / (1 + np.exp(-away / 0.5)) + rng.normal(0, 1.5, away.shape)
    return np.repeat(np.clip(np.rint(picture), 0, 255).astype(np.uint8)[:, :, None], 3, axis=2)


def write_film(path: Path, pictures: list[np.ndarray], rate: float, codec: str = "mp4v") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = pictures[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*codec), rate, (width, height))
    assert writer.isOpened()
    for picture in pictures:
        writer.write(picture)
    writer.release()


def film(path: Path, camera: int, times: np.ndarray, rate: float, where: Path3D, codec: str = "mp4v") -> None:
    rng = np.random.default_rng(camera)
    write_film(path, [draw(uv, rng) for uv in pixel(where(times), camera)], rate, codec)


SECONDS = 5.0
OFFSET = 0.0374
WHERE = wander(3, cutoff=1.5)


@pytest.fixture(scope="module")
def two_films(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """cam1 at 30 pictures a second; cam2 at 25, begun 37.4 ms later."""
    folder = tmp_path_factory.mktemp("films")
    film(folder / "cam1.mp4", 0, np.arange(int(SECONDS * 30)) / 30, 30.0, WHERE)
    film(folder / "cam2.mp4", 1, OFFSET + np.arange(int(SECONDS * 25)) / 25, 25.0, WHERE)
    return folder


def copied(folder: Path, to: Path) -> Path:
    to.mkdir(parents=True, exist_ok=True)
    for file in folder.glob("cam*.mp4"):
        (to / file.name).write_bytes(file.read_bytes())
    return to


@pytest.mark.slow
def test_a_moving_ball_tells_the_offset_to_a_millisecond(two_films: Path, cli: Cli) -> None:
    run = cli("detect", two_films, "--target", "ball", "--unit", "mm")
    assert run.code == 0, run.err
    rows = (two_films / "detections" / "clocks.csv").read_text().splitlines()
    assert rows[1].startswith("cam2,0.0,0.0")  # the slower camera's clock is the common one
    name, add, sd = rows[2].split(",")[:3]
    assert name == "cam1"
    assert abs(float(add) + OFFSET) < 1e-3
    assert abs(float(add) + OFFSET) < 4 * float(sd) < 2e-3
    data = read_dataset(two_films)
    assert data.camera_names == ("cam1", "cam2")
    t = np.array(data.columns["time_s"], float) + OFFSET
    truth = np.stack([pixel(WHERE(t), 0), pixel(WHERE(t), 1)], axis=1)
    seen = data.observations.seen
    away = (data.observations.uv - truth)[seen]
    assert seen.mean() > 0.9
    assert np.sqrt(np.square(away).mean()) < 0.1
    assert 0.5 < np.sqrt(np.square(away / data.observations.sd[seen]).mean()) < 1.6
    assert "offsets found from the movement of the target" in run.err
    again = detect_films(two_films, Ball(), films_of(two_films))
    assert again.resumed == 150 + 125
    assert len(again.sheets) == 2


@pytest.mark.parametrize("thing", [True, False], ids=["a thing", "a ball"])
def test_what_a_film_shows_once_and_has_in_its_other_pictures_too_is_no_ball(tmp_path: Path, thing: bool) -> None:
    """A look-alike that something covers in all pictures of one film but one; or a ball that comes once."""
    times = np.arange(12) / 6
    film(tmp_path / "cam1.mkv", 0, times, 6.0, WHERE, "FFV1")
    rng, pictures = np.random.default_rng(5), []
    for k in range(len(times)):
        picture = draw(np.array([150.3, 120.2]) if thing or k == 7 else np.array([-50.0, -50.0]), rng)
        if thing and k != 7:
            picture[120:128, 150:] = 130  # a cable that leaves the rest of the disc to be seen
        pictures.append(picture)
    write_film(tmp_path / "cam2.mkv", pictures, 6.0, "FFV1")
    run = detect_films(tmp_path, Ball(), films_of(tmp_path), unit="mm", offsets="0", overlays=False)
    found = {result.view: result.found for result in run.results}
    assert [view.shot for view, one in found.items() if view.camera == "cam2" and len(one)] == (
        [] if thing else ["000007"]
    )
    assert not thing or "is in other pictures, too" in found[View("cam2", "000007")].reason
    assert sum(len(one) for view, one in found.items() if view.camera == "cam1") == len(times)


@pytest.mark.slow
def test_a_table_of_times_says_it_all(tmp_path: Path) -> None:
    folder = tmp_path / "rig"
    own = np.arange(90) / 30, np.delete(OFFSET + np.arange(75) / 25, [20, 21, 50])  # cam2 has lost three pictures
    for k in (0, 1):
        film(folder / f"cam{k + 1}.mkv", k, own[k], 30.0, WHERE, "FFV1")  # every bit of the pictures
    rows = [f"cam{k + 1},{i + 1},{t:.6f}" for k in (0, 1) for i, t in enumerate(own[k])]
    table = tmp_path / "times.csv"
    table.write_text("\n".join(["camera,frame,time_s", *rows]) + "\n")
    run = detect_films(folder, Ball(), films_of(folder), unit="mm", times=table, overlays=False)
    t = np.array(run.data.columns["time_s"], float)
    assert set(np.round(np.diff(t), 6)) == {0.04, 0.08, 0.12}
    seen = run.data.observations.seen
    truth = np.stack([pixel(WHERE(t), 0), pixel(WHERE(t), 1)], axis=1)
    away = ((run.data.observations.uv - truth) / run.data.observations.sd)[seen]
    assert 0.6 < np.sqrt(np.square(away).mean()) < 1.6
    with pytest.raises(UsageError, match="exclude each other"):
        detect_films(folder, Ball(), films_of(folder), times=table, offsets="0")


@pytest.mark.slow
def test_known_positions_have_times(two_films: Path, tmp_path: Path) -> None:
    folder = copied(two_films, tmp_path / "rig")
    at = np.linspace(0.5, 4.0, 12)
    (folder / "dataset.toml").write_text(
        'name = "r"\nlength_unit = "m"\n[[cameras]]\nname = "cam1"\n[[cameras]]\nname = "cam2"\n'
    )
    rows = [f"p{i},p{i},{x},{y},{z},{t}" for i, (t, (x, y, z)) in enumerate(zip(at, WHERE(at), strict=True))]
    without = "\n".join(["point,shot,x,y,z", *(row.rpartition(",")[0] for row in rows)]) + "\n"
    (folder / "points.csv").write_text(without)
    films, options = films_of(folder), {"every": 2, "overlays": False}
    with pytest.raises(DatasetError, match="no column time_s"):
        detect_films(folder, Ball(), films, offsets=f"cam2={OFFSET}", **options)
    (folder / "points.csv").write_text("\n".join(["point,shot,x,y,z,time_s", *rows]) + "\n")
    run = detect_films(folder, Ball(), films, offsets=f"cam2={OFFSET}", **options)
    assert run.data.points.tolist() == [f"p{i}" for i in range(12)]
    truth = np.stack([pixel(WHERE(at), 0), pixel(WHERE(at), 1)], axis=1)
    assert run.data.observations.seen.mean() > 0.9
    assert np.nanmax(np.abs(run.data.observations.uv - truth)) < 0.5


def frames(n: int, rng: np.random.Generator) -> list[np.ndarray]:
    return [draw(np.array([60 + 5.0 * i, 100 + 3.0 * i]), rng) for i in range(n)]


def test_a_damaged_film_is_named(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    write_film(tmp_path / "whole.mp4", frames(20, rng), 25)
    write_film(tmp_path / "whole.avi", frames(20, rng), 25, "MJPG")
    whole = (tmp_path / "whole.mp4").read_bytes()
    cases = {"empty.mp4": b"", "text.mp4": b"no film at all", "cut.mp4": whole[: len(whole) // 2]}
    for name, content in cases.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ImageError, match=name) as told:
            Film.of(tmp_path / name)
        assert told.value.fix
    with pytest.raises(ImageError, match="there is no film"):
        Film.of(tmp_path / "nobody.mp4")
    avi = (tmp_path / "whole.avi").read_bytes()
    folder = tmp_path / "rig"
    folder.mkdir()
    (folder / "cam1.avi").write_bytes(avi[: len(avi) * 6 // 10])
    run = detect_films(folder, Ball(), films_of(folder), unit="mm", overlays=False)
    (note,) = [note for note in run.notes if "cut off, or damaged" in note]
    assert "of the 20 pictures that it promises" in note
    assert 5 < len(run.data) < 20
    described = (folder / "dataset.toml").read_text()
    (folder / "dataset.toml").write_text(described.replace("width = 320", "width = 640"))
    with pytest.raises(ImageError, match="320 x 240, but camera 'cam1' has 640 x 240"):
        detect_films(folder, Ball(), films_of(folder), overlays=False)


def test_where_films_are(tmp_path: Path, cli: Cli) -> None:
    rng = np.random.default_rng(0)
    write_film(tmp_path / "films" / "b.mp4", frames(3, rng), 25)
    write_film(tmp_path / "films" / "a" / "GX01.MP4", frames(3, rng), 25)
    assert {name: file.name for name, file in films_of(tmp_path).items()} == {"a": "GX01.MP4", "b": "b.mp4"}
    cv2.imwrite(str(tmp_path / "picture.png"), frames(1, rng)[0])
    (tmp_path / "images" / "a").mkdir(parents=True)
    (tmp_path / "picture.png").rename(tmp_path / "images" / "a" / "1.png")
    assert films_of(tmp_path) == {}  # pictures come first, unless films are asked for
    assert set(films_of(tmp_path, "films")) == {"a", "b"}
    with pytest.raises(UsageError, match="no film"):
        films_of(tmp_path, "images")
    write_film(tmp_path / "films" / "b.avi", frames(3, rng), 25, "MJPG")
    with pytest.raises(ImageError, match=r"'b' has several films: b\.avi, b\.mp4"):
        find_films(tmp_path / "films")
    run = cli("detect", tmp_path, "--target", "ball", "--unit", "mm", "--every", "2")
    assert run.code == 2
    assert "are for films" in run.err


def with_uneven_times(path: Path, durations: list[int]) -> None:
    """Rewrite the table of an MP4 that says how long each picture is shown (stts), as a recorder with gaps does."""
    data = path.read_bytes()
    at = data.index(b"stts") - 4
    old = struct.unpack(">I", data[at : at + 4])[0]
    body = struct.pack(">II", 0, len(durations)) + b"".join(struct.pack(">II", 1, d) for d in durations)
    new = struct.pack(">I", 8 + len(body)) + b"stts" + body
    grown = len(new) - old
    out = bytearray(data[:at] + new + data[at + old :])
    for box in (b"moov", b"trak", b"mdia", b"minf", b"stbl"):
        place = out.index(box) - 4
        out[place : place + 4] = struct.pack(">I", struct.unpack(">I", out[place : place + 4])[0] + grown)
    path.write_bytes(bytes(out))


def test_the_times_of_a_film_with_a_variable_rate_are_those_of_its_pictures(tmp_path: Path) -> None:
    path = tmp_path / "phone.mp4"
    write_film(path, frames(12, np.random.default_rng(0)), 25)
    assert np.diff(Film.of(path).times()) == pytest.approx(np.full(11, 0.04))
    assert path.read_bytes().index(b"mdat") < path.read_bytes().index(b"moov")  # so that no offset of a picture moves
    data = path.read_bytes()
    at = data.index(b"stts")
    unit = struct.unpack(">II", data[at + 12 : at + 20])[1] // 4  # the film must not become longer: it would be cut
    steps = [1, 1, 3, 1, 2, 1, 1, 1, 4, 1, 1, 1]
    with_uneven_times(path, [unit * s for s in steps])
    assert np.diff(Film.of(path).times()) == pytest.approx(0.01 * np.array(steps[:-1]))


def test_rounded_times_are_even() -> None:
    times = np.arange(100) / 29.97
    assert np.abs(even(np.round(times, 3), 29.97) - times).max() < 2e-4
    gap = np.where(np.arange(100) > 50, times + 0.033, times)
    assert (even(gap, 29.97) == gap).all()
    assert even(np.zeros(5), 25.0) == pytest.approx(np.arange(5) / 25)


TIMES = {"cam1": (4, 4)}


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("cam1,0,0\ncam1,1,0.1\ncam1,2,0.05\n", "frame 2 of camera 'cam1' is not later"),
        ("cam1,0,0\ncam1,7,0.1\n", "frame 7 of camera 'cam1', whose film has 4 pictures"),
        ("cam1,0,0\ncam1,0,0.1\n", "is there twice"),
        ("cam1,0.5,0\n", "is no number of a picture"),
        ("cma1,0,0\n", "no time of camera 'cam1'"),
        ("cam1,0,x\n", "line 2: time_s = 'x' is not a number"),
        ("", "no rows"),
    ],
)
def test_a_table_of_times_with_a_mistake_is_refused(rows: str, words: str, tmp_path: Path) -> None:
    table = tmp_path / "times.csv"
    table.write_text("camera,frame,time_s\n" + rows)
    with pytest.raises(DatasetError, match=words):
        read_times(table, TIMES)


def test_a_table_of_times_with_gaps_leaves_pictures_out(tmp_path: Path) -> None:
    table = tmp_path / "times.csv"
    table.write_text("camera,frame,time_s\ncam1,1,0\ncam1,2,0.1\ncam1,4,0.3\ncam9,1,0\n")
    times, notes = read_times(table, TIMES)
    np.testing.assert_array_equal(times["cam1"], [0, 0.1, np.nan, 0.3])
    assert len(notes) == 2


def test_offsets_that_are_given() -> None:
    clocks = given_clocks("b=0.5, c=-1", ["a", "b", "c"])
    assert [clocks[name].offset for name in "abc"] == [0, 0.5, -1]
    assert all(clock.offset == 0 for clock in given_clocks("0", ["a", "b"]).values())
    for text in ("", "b", "b=x", "b=nan", "d=1", "1"):
        with pytest.raises(UsageError):
            given_clocks(text, ["a", "b"])


# ---- the offset itself, from tracks


def track(
    camera: int, where: Path3D, rig: str = "stereo", *, seed: int = 0, rate: float = 50.0, offset: float = 0.0,
    seconds: float = 10.0, noise: float = 0.06, lost: float = 0.05, drift: float = 0.0, number: int | None = None,
) -> Track:  # fmt: skip
    """What a camera of a simulated rig, lens errors and all, sees of a ball; its clock is late by `offset`."""
    rng = np.random.default_rng([seed, camera])
    made = build_rig(rig, seed=seed)
    t = np.arange(int(seconds * rate)) / rate + rng.uniform(0, 1 / rate)
    xyz = where(t) * 1.4 * made.volume.size
    box = made.volume.world_from_box
    view = made.cameras[camera if number is None else number]
    uv = view.pixel_from_world(xyz @ box.rotation.T + box.translation)[0] + rng.normal(0, noise, (len(t), 2))
    uv[rng.random(len(t)) < lost] = np.nan
    sd = np.full((len(t), 1, 2), noise)
    return Track(f"cam{camera + 1}", t + offset + drift * t, uv[:, None], sd, ("",), (view.width, view.height))


def error_of(found: Offset, offset: float, drift: float = 0.0) -> float:
    """Of an offset to a camera that is late by `offset`."""
    true_time = (found.around - offset) / (1 + drift)
    return found.seconds - (true_time - found.around)


@pytest.mark.slow
def test_the_offset_and_the_drift_of_a_clock() -> None:
    first = track(0, wander(1), seed=1, rate=60)
    second = track(1, wander(1), seed=1, offset=-0.81, drift=3e-4)
    found = find_offset(first, second)
    assert abs(error_of(found, -0.81, 3e-4)) < min(4 * found.sd, 1e-4)
    assert abs(found.drift + 3e-4) < 4 * found.drift_sd < 2e-4
    back = find_offset(second, first)
    assert back.seconds == pytest.approx(-found.seconds, abs=2e-4)


SIMPLE: dict[str, Path3D] = {
    "rest": lambda t: np.tile([0.1, 0.1, 0.0], (len(t), 1)),
    "line": lambda t: np.stack([-0.3 + 0.06 * t, 0.1 + 0.01 * t, 0 * t], axis=1),
    "throw": lambda t: np.stack([0.05 * (t - 5), 0.015 * (t - 5) ** 2 - 0.1, 0.02 * (t - 5)], axis=1),
    "circle": lambda t: 0.25 * np.stack([np.cos(4.4 * t), np.sin(4.4 * t), 0.1 + 0 * t], axis=1),
    "screw": lambda t: 0.25 * np.stack([np.cos(4.4 * t), np.sin(4.4 * t), 0.2 * t - 1], axis=1),
    "pendulum": lambda t: np.stack([0.25 * np.sin(3 * t), 0 * t, 0.03 * np.cos(6 * t)], axis=1),
    "repeats": lambda t: 0.2 * np.stack([np.sin(2.5 * t), np.sin(5 * t + 0.5), np.cos(7.5 * t)], axis=1),
}


@pytest.mark.slow
@pytest.mark.parametrize("rig", ["stereo", "bar6"])
@pytest.mark.parametrize("name", SIMPLE)
def test_a_movement_that_tells_no_offset_is_refused(name: str, rig: str) -> None:
    first, second = (track(k, SIMPLE[name], rig, seed=3, offset=0.2345 * k) for k in (0, 1))
    words = {"rest": "rests", "repeats": "repeats itself"}.get(name, "too simple")
    with pytest.raises(OffsetError) as told:
        find_offset(first, second)
    assert words in told.value.why


def test_a_target_at_rest_and_one_that_repeats_itself_are_refused() -> None:
    for name, words in (("rest", "rests"), ("repeats", "repeats itself")):
        first, second = (track(k, SIMPLE[name], seed=3, offset=0.2345 * k) for k in (0, 1))
        with pytest.raises(OffsetError) as told:
            find_offset(first, second)
        assert words in told.value.why
        assert "--offsets" in told.value.fix


@pytest.mark.slow
@pytest.mark.parametrize("lost", [1, 3])
def test_pictures_that_were_lost_without_a_trace_are_noticed(lost: int) -> None:
    first, whole = track(0, wander(4), seed=4, rate=60), track(1, wander(4), seed=4, offset=0.1, lost=0.0)
    keep = np.r_[0:250, 250 + lost : len(whole)]
    cut = replace(whole, times=whole.times[: len(keep)], uv=whole.uv[keep], sd=whole.sd[keep])
    with pytest.raises(OffsetError, match="cannot be told") as told:
        find_offset(first, cut)
    assert f"changes by {20 * lost} ms" in told.value.why
    kept = find_offset(first, replace(whole, times=whole.times[keep], uv=whole.uv[keep], sd=whole.sd[keep]))
    assert abs(error_of(kept, 0.1)) < 4 * kept.sd


@pytest.mark.slow
@pytest.mark.parametrize("cameras", [("stereo", 0, 1), ("bar6", 0, 3)])
def test_the_stated_uncertainty_of_offsets_holds(cameras: tuple[str, int, int]) -> None:
    rig, one, other = cameras
    z = []
    for seed in range(16):
        offset = float(np.random.default_rng(seed + 500).uniform(-1, 1))
        first = track(0, wander(seed + 10), rig, seed=seed, rate=60, number=one)
        second = track(1, wander(seed + 10), rig, seed=seed, offset=offset, number=other)
        found = find_offset(first, second)
        z.append(error_of(found, offset) / found.sd)
    inside = int(np.sum(np.abs(z) < 1.96))
    assert inside >= 13, z  # binomial(16, 0.95): fewer in 0.7 % of such tests
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.5


@pytest.mark.slow
def test_movements_of_two_targets_are_not_taken_for_one() -> None:
    for seed in range(3):
        for rig in ("stereo", "bar6"):
            first, second = track(0, wander(seed + 10), rig, seed=seed), track(1, wander(seed + 300), rig, seed=seed)
            with pytest.raises(OffsetError):
                find_offset(first, second)


@pytest.mark.slow
def test_three_cameras_are_adjusted_together() -> None:
    offsets = (0.0, 0.2, -0.3)
    tracks = [track(k, wander(6), "bar6", seed=6, offset=offsets[k], rate=(50, 60, 70)[k]) for k in range(3)]
    clocks, notes = clocks_from_target(tracks, silent)
    assert not notes
    for k in (1, 2):
        clock = clocks[f"cam{k + 1}"]
        assert abs(clock.offset + offsets[k]) < 4 * clock.sd < 1e-3
    elsewhere = track(2, wander(99), "bar6", seed=6)
    with pytest.raises(OffsetError, match="'cam3' to that of 'cam1'"):
        clocks_from_target([*tracks[:2], elsewhere], silent)


def test_places_between_pictures_are_as_sure_as_stated() -> None:
    exact = track(0, wander(2), seed=2, noise=0.0, lost=0.0, rate=400)
    seen = track(0, wander(2), seed=2, rate=40)
    times = exact.times[(exact.times > 0.3) & (exact.times < 9.5)]
    found = seen.at(times)
    away = (found.uv - exact.uv[(exact.times > 0.3) & (exact.times < 9.5)])[:, 0]
    known = np.isfinite(away[:, 0])
    assert known.mean() > 0.95
    assert 0.7 < np.sqrt(np.mean(np.square(away[known] / found.sd[known, 0]))) < 1.3
    assert np.isnan(seen.at(np.array([-5.0, 50.0])).uv).all()


def test_wrong_detections_are_left_out_of_a_track() -> None:
    good = track(0, wander(2), seed=2, lost=0.0)
    uv = good.uv.copy()
    for row, by in ((50, 300), (51, 280), (120, 15), (300, -200)):
        uv[row] += by
    cleaned, wrong = replace(good, uv=uv).without_wrong()
    assert np.isnan(cleaned.uv[[50, 51, 120, 300], 0, 0]).all()
    assert wrong <= 8
    assert good.without_wrong()[1] == 0


def test_instants_that_differ_are_chosen() -> None:
    rng = np.random.default_rng(0)
    at = np.repeat(rng.uniform(0, 1000, (6, 1, 2, 2)), 50, axis=0)  # a board at six places, 50 pictures each
    uv = at + rng.uniform(0, 50, (1, 20, 1, 2)) + rng.normal(0, 0.05, (300, 20, 2, 2))
    sd = np.full_like(uv, 0.05)
    sd[::50] = 1.0  # blurred
    chosen = choose_different(uv, sd, 60)
    assert sorted(chosen // 50) == [0, 1, 2, 3, 4, 5]
    assert (chosen % 50 > 0).all()
    assert len(choose_different(uv, sd, 4)) == 4


@dataclass(frozen=True)
class Fixed(DetectorBase):
    """The darkest place, of a target that does not move."""

    moves: ClassVar[bool] = False

    def options(self) -> dict[str, Any]:
        return {}

    def detect(self, picture: np.ndarray, view: View) -> Detected:
        v, u = np.unravel_index(np.argmin(cv2.GaussianBlur(picture, (0, 0), 3)), picture.shape)
        return Detected(("dot",), np.array([[u, v]], float), np.full((1, 2), 0.5))


def test_of_a_target_that_does_not_move_the_sharpest_picture_is_taken(tmp_path: Path) -> None:
    sharp = draw(np.array([100.0, 80.0]), np.random.default_rng(0))
    blurred = cv2.GaussianBlur(sharp, (0, 0), 4)
    write_film(tmp_path / "films" / "cam1.mkv", [blurred, blurred, sharp, blurred], 25, "FFV1")
    run = detect_films(tmp_path, Fixed(), films_of(tmp_path), unit="mm")
    assert run.data.points.tolist() == ["dot"]
    still = read_picture(tmp_path / "detections" / "stills" / "cam1" / "stills.png")
    assert np.abs(still * 255 - sharp[:, :, 0]).max() < 2


def test_pictures_that_a_recorder_repeats_are_left_out(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    moving = frames(20, rng)
    moving[7] = moving[6]
    write_film(tmp_path / "cam1.mkv", moving, 25, "FFV1")
    run = detect_films(tmp_path, Ball(), films_of(tmp_path), unit="mm", overlays=False)
    assert len(run.data) == 19
    assert any(note.startswith("1 pictures of 'cam1' repeat the one before") for note in run.notes)
