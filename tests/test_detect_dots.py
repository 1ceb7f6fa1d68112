"""Dots on a known target: rendered ones, whose places are known, and real photographs."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

pytest.importorskip("cv2")

from implicam.dataset import KnownPositions, read_dataset
from implicam.detect.blobs import find_scale, find_spots, measure_spots
from implicam.detect.dots import Dots
from implicam.detect.model import Detected, View
from implicam.detect.projective import Departure, ProjectiveProcess
from implicam.errors import DatasetError, UsageError
from implicam.images import read_picture

REAL = Path(__file__).resolve().parents[2] / "shared" / "real"
real = pytest.mark.skipif(not REAL.is_dir(), reason="the real photographs are not here")
VIEW = View("cam1", "target")
FINE = 5


def photograph(uv, shape, *, radius=3.0, blur=0.8, height=0.5, level=0.1, read=0.01, gain=0.0, rng, bits=8, most=1.0):
    """Discs at pixels uv by many rays a pixel, blurred, with noise of variance read² + gain * grey."""
    grey = np.zeros(shape)
    reach = int(radius + 5 * blur + 3)
    v, u = ((np.arange(-reach * FINE, (reach + 1) * FINE) + 0.5) / FINE - 0.5 for _ in range(2))
    for at in uv:
        corner = np.floor(at).astype(int)
        disc = np.hypot(u[None] - at[0] + corner[0], v[:, None] - at[1] + corner[1])
        disc = ndimage.gaussian_filter(np.clip((radius - disc) * FINE + 0.5, 0, 1), blur * FINE)
        n = 2 * reach + 1
        disc = disc.reshape(n, FINE, n, FINE).mean(axis=(1, 3))
        rows, columns = corner[1] + np.arange(-reach, reach + 1), corner[0] + np.arange(-reach, reach + 1)
        r, c = (rows >= 0) & (rows < shape[0]), (columns >= 0) & (columns < shape[1])
        grey[np.ix_(rows[r], columns[c])] += disc[np.ix_(r, c)]
    grey = level + height * grey
    grey = np.minimum(grey + rng.normal(size=shape) * np.sqrt(read**2 + gain * np.abs(grey)), most)
    return (np.rint(np.clip(grey, 0, 1) * (2**bits - 1)) / (2**bits - 1)).astype(np.float32)


def lattice(n, pitch, rng):
    return (np.stack(np.meshgrid(np.arange(n), np.arange(n)), axis=-1).reshape(-1, 2) + 0.7) * pitch + rng.uniform(
        -0.5, 0.5, (n * n, 2)
    )


def measured(picture, uv):
    scale, _ = find_scale(picture, np.rint(uv[:6]), 8.0)
    found, _ = find_spots(picture, scale)
    nearest = np.argmin(np.linalg.norm(found[None] - uv[:, None], axis=2), axis=1)
    return measure_spots(picture, found[nearest], scale)


@pytest.mark.parametrize(
    "kind",
    [
        {"radius": 3.0, "read": 0.02},
        {"radius": 3.0, "read": 0.003, "gain": 0.004},
        {"radius": 2.0, "height": 0.3, "read": 0.02},
        {"radius": 1.5, "height": 0.4, "gain": 0.001},
        {"radius": 5.0, "blur": 1.0, "height": 0.4, "gain": 0.002},
        {"radius": 3.0, "blur": 1.5, "height": 0.15, "read": 0.02},
    ],
    ids=lambda kind: ",".join(f"{k}={v}" for k, v in kind.items()),
)
def test_the_uncertainty_of_a_centroid_is_right(kind):
    """NEES 2 +- 0.3: its mean over 324 spots has a standard error of 0.11 by itself."""
    rng = np.random.default_rng(1)
    pitch = int(7 * kind["radius"]) + 10
    uv = lattice(18, pitch, rng)
    spots = measured(photograph(uv, (19 * pitch, 19 * pitch), rng=rng, **kind), uv)
    error = spots.uv - uv
    assert np.isfinite(error).all()
    assert np.mean(np.sum((error / spots.sd) ** 2, axis=1)) == pytest.approx(2, abs=0.3)
    assert np.all(np.abs(error.mean(axis=0)) < 4 * np.sqrt(np.mean(spots.sd**2) / len(uv)))


def test_without_noise_the_pixels_move_a_centroid_by_a_hundredth_at_most():
    rng = np.random.default_rng(2)
    for radius in (1.5, 3.0, 6.0):
        pitch = int(7 * radius) + 12
        uv = lattice(7, pitch, rng)
        spots = measured(photograph(uv, (8 * pitch, 8 * pitch), radius=radius, read=0, rng=rng, bits=16), uv)
        assert np.sqrt(np.mean((spots.uv - uv) ** 2)) < 0.01


def test_saturated_spots_are_not_overconfident():
    rng = np.random.default_rng(3)
    uv = lattice(15, 32, rng)
    spots = measured(photograph(uv, (520, 520), height=0.9, gain=0.002, most=0.7, rng=rng), uv)
    assert 0.7 < np.mean(np.sum(((spots.uv - uv) / spots.sd) ** 2, axis=1)) < 2.3


def test_a_glint_on_a_spot_lowers_trust():
    rng = np.random.default_rng(4)
    uv = lattice(6, 34, rng)
    picture = photograph(uv, (230, 230), read=0.004, rng=rng)
    clean = measured(picture, uv).sd
    u, v = np.rint(uv[20]).astype(int)
    picture[v + 1 : v + 3, u - 1 : u + 1] = 1.0
    sd = measured(picture, uv).sd
    assert sd[20].min() > 3 * clean[20].max()
    assert np.delete(sd, 20, axis=0) == pytest.approx(np.delete(clean, 20, axis=0), rel=0.5)


def test_a_spot_beside_a_bright_edge_is_measured_or_left_out():
    rng = np.random.default_rng(5)
    uv = np.array([[60.3, 50.2]] + [[60.0 + 40 * k, 140.0] for k in range(5)])
    picture = photograph(uv, (200, 300), read=0.004, rng=rng)
    picture[56:80, 30:100] = 0.95
    spots = measured(picture, uv[[1, 2, 3, 4, 5, 0]])
    error = np.linalg.norm(spots.uv[5] - uv[0])
    assert np.isnan(error) or error < 4 * spots.sd[5].max()


def test_scratches_and_edges_are_no_spots():
    rng = np.random.default_rng(6)
    picture = rng.normal(0.2, 0.004, (300, 300)).astype(np.float32)
    picture[:, 100:102] += 0.4
    picture[200:, 180:] += 0.4
    found, _ = find_spots(picture, 2.0)
    spots = measure_spots(picture, found, 2.0)
    on = np.isfinite(spots.uv[:, 0])
    corner = np.linalg.norm(found - (180, 200), axis=1) < 8
    assert not (on & ~corner & (np.abs(found[:, 0] - 100.5) < 4)).any()
    assert not (on & ~corner & (np.abs(found[:, 1] - 200) < 3) & (found[:, 0] > 175)).any()


def pixels(xyz, *, turn=0.3, distance=600.0, focal=1800.0, middle=(400.0, 300.0), bend=0.0):
    """A pinhole that looks along z, turned; with a smooth departure of `bend` pixels that no pinhole has."""
    c, s = np.cos(turn), np.sin(turn)
    x, y, z = (xyz - xyz.mean(axis=0)).T
    a, b = c * x + s * z, distance - s * x + c * z
    uv = focal * np.column_stack([a / b, -y / b]) + middle
    return uv + bend * np.sin(uv[:, ::-1] / 150)


def target(depths=(0.0, -8.0, -16.0), n=11, pitch=12.0):
    """Names and (n, 3) positions: columns of dots, each at a depth of its own."""
    x, y = (axis.ravel() * pitch for axis in np.meshgrid(np.arange(n), np.arange(n)))
    z = np.array(depths)[(np.round(x / pitch).astype(int)) % len(depths)]
    xyz = np.column_stack([x, y, z])
    return tuple(f"d{k:03d}" for k in range(len(xyz))), xyz


def known(xyz, shots="target"):
    return KnownPositions(
        np.full(len(xyz), shots) if isinstance(shots, str) else shots, xyz, np.full(xyz.shape, np.nan)
    )


def clicks(names, uv, rows, rng):
    """As a person clicks: up to two pixels off."""
    return {names[row]: tuple(map(float, np.rint(uv[row]) + rng.integers(-2, 3, 2))) for row in rows}


def scene(*, depths=(0.0, -8.0, -16.0), seed=0, clutter=150, bend=1.5, hidden=(), n=11, read=0.01):
    rng = np.random.default_rng(seed)
    names, xyz = target(depths, n)
    uv = pixels(xyz, bend=bend)
    there = np.delete(np.arange(len(xyz)), hidden)
    junk = rng.uniform((0, 0), (800, 600), (clutter, 2))
    apart = np.min(np.linalg.norm(junk[:, None] - uv[None], axis=2), axis=1)
    junk = junk[apart > 12]
    return names, xyz, uv, photograph(np.vstack([uv[there], junk]), (600, 800), rng=rng, height=0.4, read=read), rng


CORNERS = [0, 9, 60, 55, 110, 120, 64]


def found_right(found, names, uv, within=0.3):
    """All labels right; (n,) distances from the truth."""
    off = np.array(
        [np.linalg.norm(at - uv[names.index(name)]) for name, at in zip(found.points, found.uv, strict=True)]
    )
    assert (off < within).all()
    return off


def test_all_dots_from_seven_labels_among_look_alikes():
    names, xyz, uv, picture, rng = scene()
    found = Dots(names, known(xyz), {View("cam1", ""): clicks(names, uv, CORNERS, rng)}).detect(picture, VIEW)
    found_right(found, names, uv)
    assert len(found) == len(names)
    assert found.reason == ""
    assert set(found.notes["labelled"]) == {names[row] for row in CORNERS}
    again = Detected.from_dict(json.loads(json.dumps(found.as_dict())))
    assert np.array_equal(again.uv, found.uv)


@pytest.mark.slow
def test_the_stated_uncertainty_of_found_dots_is_right():
    nees = []
    for seed in range(3):
        names, xyz, uv, picture, rng = scene(seed=seed, clutter=0, read=0.02)
        found = Dots(names, known(xyz), {View("cam1", ""): clicks(names, uv, CORNERS, rng)}).detect(picture, VIEW)
        rows = [names.index(name) for name in found.points]
        nees.append(np.mean(np.sum(((found.uv - uv[rows]) / found.sd) ** 2, axis=1)))
    assert np.mean(nees) == pytest.approx(2, abs=0.3)  # 363 dots: standard error 0.1


@pytest.mark.slow
def test_a_flat_target_and_dark_dots():
    names, xyz, uv, picture, rng = scene(depths=(0.0,), seed=3)
    marks = {View("cam1", ""): clicks(names, uv, CORNERS[:6], rng)}
    for grey, polarity in ((picture, "auto"), (1 - picture, "auto"), (1 - picture, "dark"), (picture, "bright")):
        found = Dots(names, known(xyz), marks, polarity).detect(grey, VIEW)
        found_right(found, names, uv)
        assert len(found) == len(names)
    wrong = Dots(names, known(xyz), marks, "dark").detect(picture, VIEW)
    assert len(wrong) == 0
    assert wrong.reason


def test_hidden_dots_are_missing_and_counted():
    hidden = [16, 27, 71, 72, 73]
    names, xyz, uv, picture, rng = scene(seed=4, hidden=hidden, clutter=0)
    found = Dots(names, known(xyz), {View("cam1", ""): clicks(names, uv, CORNERS, rng)}).detect(picture, VIEW)
    found_right(found, names, uv)
    assert set(names) - set(found.points) == {names[row] for row in hidden}
    assert found.reason.startswith("5 of 121 dots not found: 5 no spot")
    for row in hidden:  # predicted where it would be
        assert np.linalg.norm(np.array(found.notes["missing"][names[row]]) - uv[row]) < 1


def test_a_dot_that_is_not_where_the_layout_says_is_dropped():
    names, xyz, uv, picture, rng = scene(seed=5, clutter=0)
    moved = xyz.copy()
    moved[70] += (4.0, 0.0, 0.0)  # a third of the way to the next
    found = Dots(names, known(moved), {View("cam1", ""): clicks(names, uv, CORNERS, rng)}).detect(picture, VIEW)
    found_right(found, names, uv)
    assert set(names) - set(found.points) == {names[70]}


def test_labels_at_one_depth_leave_the_others_unsure_but_never_wrong():
    names, xyz, uv, picture, rng = scene(seed=6)
    flat = [row for row in range(len(xyz)) if xyz[row, 2] == 0]
    marks = clicks(names, uv, [flat[k] for k in (0, 3, 17, 20, 35, 43)], rng)
    found = Dots(names, known(xyz), {View("cam1", ""): marks}).detect(picture, VIEW)
    found_right(found, names, uv)
    assert len(found) >= len(flat)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["swapped", "shifted", "mirrored"])
def test_wrong_labels_are_refused_or_overcome_never_believed(kind):
    for seed in range(2):
        names, xyz, uv, picture, rng = scene(seed=seed + 10)
        marks = clicks(names, uv, CORNERS, rng)
        a, b = names[CORNERS[0]], names[CORNERS[3]]
        if kind == "swapped":
            marks[a], marks[b] = marks[b], marks[a]
        elif kind == "shifted":
            marks[a] = tuple(np.rint(uv[CORNERS[0] + 12]))
        layout = xyz * (1, 1, -1) if kind == "mirrored" else xyz
        found = Dots(names, known(layout), {View("cam1", ""): marks}).detect(picture, VIEW)
        if len(found):
            found_right(found, names, uv, within=2)
        else:
            assert "labels" in found.reason


def test_a_picture_that_shows_nothing_is_a_reason():
    names, xyz, uv, _, rng = scene(clutter=0)
    dots = Dots(names, known(xyz), {View("cam1", ""): clicks(names, uv, CORNERS, rng)})
    noise = rng.normal(0.3, 0.01, (600, 800)).astype(np.float32)
    for picture in (
        np.zeros((600, 800), np.float32),
        np.ones((600, 800), np.float32),
        noise,
        noise[:20, :20],
        noise[:1],
    ):
        found = dots.detect(picture, VIEW)
        assert len(found) == 0
        assert found.reason
    burst = rng.random((600, 800)).astype(np.float32)
    assert len(dots.detect(burst, VIEW)) == 0


def test_labels_beside_dots_or_too_few_are_a_reason():
    names, xyz, uv, picture, rng = scene(clutter=0)
    marks = clicks(names, uv, CORNERS, rng)
    few = Dots(names, known(xyz), {View("cam1", ""): dict(list(marks.items())[:5])}).detect(picture, VIEW)
    assert few.reason.startswith("5 labelled dots for camera 'cam1'")
    assert Dots(names, known(xyz), {View("cam2", ""): marks}).detect(picture, VIEW).reason.startswith("0 labelled dots")
    off = {name: (u + 14, v + 14) if name in (names[0], names[9]) else (u, v) for name, (u, v) in marks.items()}
    found = Dots(names, known(xyz), {View("cam1", ""): off}).detect(picture, VIEW)
    assert f"no dot where the labels {names[0]}, {names[9]} are" in found.reason
    off = {**marks, names[0]: (marks[names[0]][0] + 14, marks[names[0]][1] + 14)}
    found = Dots(names, known(xyz), {View("cam1", ""): off}).detect(picture, VIEW)
    found_right(found, names, uv)
    assert len(found) == len(names)
    assert found.reason == f"no dot where the labels {names[0]} are: correct them"
    nowhere = dict.fromkeys(marks, (1e300, -1e300))
    assert "outside the picture" in Dots(names, known(xyz), {View("cam1", ""): nowhere}).detect(picture, VIEW).reason
    outside = {**marks, names[0]: (-50.0, 9e9)}
    found = Dots(names, known(xyz), {View("cam1", ""): outside}).detect(picture, VIEW)
    found_right(found, names, uv)  # six labels are left
    assert len(found) == len(names)


def test_only_the_plate_of_the_shot_is_looked_for():
    names, xyz, uv, picture, rng = scene(clutter=0)
    more = tuple(f"other-{name}" for name in names)
    both = known(np.vstack([xyz, xyz + np.array([0, 0, 50])]), np.array(["target"] * len(names) + ["far"] * len(names)))
    dots = Dots(names + more, both, {View("cam1", ""): clicks(names, uv, CORNERS, rng)})
    assert set(dots.detect(picture, VIEW).points) == set(names)
    assert dots.detect(picture, View("cam1", "far")).reason.startswith("0 labelled dots")
    assert "has no shot 'targe' (did you mean 'target'?)" in dots.detect(picture, View("cam1", "targe")).reason


def test_settle_changes_nothing_and_options_are_plain():
    names, xyz, uv, _, rng = scene(clutter=0)
    dots = Dots(names, known(xyz), {View("cam1", ""): clicks(names, uv, CORNERS, rng)})
    found = {VIEW: Detected(reason="none")}
    assert dots.settle(found) == found
    assert json.loads(json.dumps(dots.options())) == dots.options()


def test_files(tmp_path):
    layout, labels = tmp_path / "points.csv", tmp_path / "labels.csv"
    layout.write_text("point,shot,x,y,z\n" + "".join(f"p{k},target,{k},{k % 3},{k % 2}\n" for k in range(8)))
    labels.write_text("point,camera,u,v\n" + "".join(f"p{k},cam1,{k}.5,7\n" for k in range(6)))
    dots = Dots.from_files(layout, labels)
    assert dots.labels[View("cam1", "")]["p5"] == (5.5, 7.0)
    labels.write_text("point,camera,shot,u,v\np1,cam1,target,1,2\n")
    assert Dots.from_files(layout, labels).labels == {View("cam1", "target"): {"p1": (1.0, 2.0)}}
    for text, says in (
        ("point,camera,u,v\n", "no rows"),
        ("point,camera,u\np1,cam1,3\n", "column 'v' is missing"),
        ("point,camera,u,v\np11,cam1,3,4\n", "line 2: point 'p11' is not in the layout (did you mean 'p1'?)"),
        ("point,camera,u,v\np1,cam1,3,x\n", "line 2: v = 'x' is not a number"),
        ("point,camera,u,v\np1,cam1,3,nan\n", "not a finite number"),
        ("point,camera,u,v\np1,cam1,3,4\np1,cam1,3,5\n", "line 3: point 'p1' of camera 'cam1' is labelled twice"),
        ("", "is empty"),
    ):
        labels.write_text(text)
        with pytest.raises(DatasetError) as error:
            Dots.from_files(layout, labels)
        assert says in str(error.value).replace("\n", " ")
    with pytest.raises(DatasetError):
        Dots.from_files(layout, tmp_path / "none.csv")
    with pytest.raises(DatasetError, match="'q'"):
        Dots(("p",), known(np.zeros((1, 3))), {View("cam1", ""): {"q": (0.0, 0.0)}})
    with pytest.raises(UsageError, match="polarity"):
        Dots(("p",), known(np.zeros((1, 3))), {}, "grey")


def test_predictions_by_the_others_are_those_of_a_fit_without():
    """Closed form against doing it; theta kept, since a linear model is what the closed form is for."""
    _, xyz = target(n=4)
    xyz = (xyz - xyz.mean(axis=0)) / xyz.std()
    uv = 0.8 * xyz[:, :2] + 0.05 * xyz[:, 2:] + np.random.default_rng(0).normal(0, 1e-3, (len(xyz), 2))
    sd = np.full(len(xyz), 1e-3)
    theta = np.array([0.8, 0, 0.05, 0, 0, 0.8, 0.05, 0, 0, 0, 0])
    departure = Departure(0.01, 1.0, 1e-3)
    camera = ProjectiveProcess.condition(xyz, uv, sd**2, theta, departure, turns=1)
    others, spread = camera.leave_one_out()
    for row in (0, 7):
        kept = np.delete(np.arange(len(xyz)), row)
        alone = ProjectiveProcess.condition(xyz[kept], uv[kept], sd[kept] ** 2, theta, departure, turns=1)
        predicted, covariance = alone.predict(xyz[[row]])
        assert others[row] == pytest.approx(predicted[0], abs=1e-9)
        assert spread[row] == pytest.approx(covariance[0] + sd[row] ** 2 * np.eye(2), rel=1e-6, abs=1e-12)


@real
@pytest.mark.parametrize(
    ("name", "camera", "least"),
    [
        *(("water-tank-target", k, 0.95) for k in range(3)),
        *(("two-sided-tank", k, 0.95) for k in range(4)),
        *(("image-splitter", k, 0.8) for k in range(4)),
    ],
)
def test_real_photographs(name, camera, least):
    data = read_dataset(REAL / name)
    names = tuple(map(str, data.points))
    one = data.cameras[camera].name
    picture = read_picture(REAL / name / "images" / one / "target.png")
    uv = data.observations.uv[:, camera]
    seen = np.flatnonzero(np.isfinite(uv[:, 0]))
    for seed in range(1):
        rng = np.random.default_rng(seed + 50)
        sextets = [rng.choice(seen, 6, replace=False) for _ in range(30)]
        spread = [
            np.linalg.svd((data.xyz[s] - data.xyz[s].mean(axis=0)) / data.xyz.std(axis=0))[1][-1] for s in sextets
        ]
        rows = sextets[int(np.argmax(spread))]
        marks = {names[row]: tuple(map(float, np.rint(uv[row]) + rng.integers(-1, 2, 2))) for row in rows}
        found = Dots(names, data.positions, {View(one, ""): marks}).detect(picture, View(one, "target"))
        off = np.linalg.norm(found.uv - uv[[names.index(point) for point in found.points]], axis=1)
        assert np.sum(off < 0.3) >= least * len(seen)
        assert not (off > 2).any()
