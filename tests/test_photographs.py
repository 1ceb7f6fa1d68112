"""Rendered photographs against the true cameras: where things are, what is hidden, how much noise there is."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("cv2")

from implicam.errors import UsageError
from implicam.images import opencv, read_picture
from implicam.picture_names import find_pictures
from implicam.simulate import Optics, Studio, build_rig, moving_board, random_positions, record, views
from implicam.simulate.photographs import PADDING_PX, LinesOfSight, Occluder

cv2 = opencv()
STILL = Optics(noise=0, blur=0.7, vignetting=0, uneven=0, clutter=False, bits=16)


def balls(seed=1, n=2, optics=STILL, spec="bar6", cameras="cam1", **more):
    rig = build_rig(spec, seed=seed, cameras=cameras)
    return Studio(rig, random_positions(rig, n, np.random.default_rng(seed)), optics, seed, **more)


@pytest.mark.parametrize(("spec", "camera"), [("bar6", 0), ("bar6", 1), ("bar6", 5), ("stereo", 0)])
def test_lines_of_sight_are_those_of_the_camera(spec, camera):
    view = build_rig(spec, seed=2).cameras[camera]
    sight = LinesOfSight(view)
    directions = sight.at(0, view.height + 2 * PADDING_PX, 0, view.width + 2 * PADDING_PX)
    assert directions.shape == (view.height + 2 * PADDING_PX, view.width + 2 * PADDING_PX, 3)
    assert np.array_equal(sight.at(100, 190, 300, 420), directions[100:190, 300:420])
    rng = np.random.default_rng(0)
    u, v = rng.integers(0, view.width, 3000), rng.integers(0, view.height, 3000)
    along = directions[v + PADDING_PX, u + PADDING_PX].astype(float)
    assert np.linalg.norm(along, axis=1) == pytest.approx(np.ones(3000), abs=1e-5)
    world = view.camera_from_world.centre + rng.uniform(200, 800, (3000, 1)) * along
    pixels, seen = view.pixel_from_world(world)
    assert seen.mean() > 0.95  # corners may be beyond the image circle
    assert np.abs(pixels - np.column_stack([u, v]))[seen].max() < 0.002


def test_same_seed_same_bits():
    optics = Optics()
    first, same = balls(optics=optics), balls(optics=optics)
    assert np.array_equal(first.picture(0, 1), same.picture(0, 1))
    assert np.array_equal(first.picture(0, 1), first.picture(0, 1))  # whatever was taken before
    other = replace(first, seed=2).picture(0, 1)
    difference = other - first.picture(0, 1)
    assert np.abs(difference).max() > 0
    assert abs(difference.mean()) < 1e-3  # other noise before the same background


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "bits"), [(0.01, 16), (0.05, 16), (0.02, 8)])
def test_noise_has_the_stated_size(noise, bits):
    clean = balls(optics=STILL)
    loud = replace(clean, optics=replace(STILL, noise=noise, bits=bits))
    truth = clean.picture(0, 0)
    z = (loud.picture(0, 0) - truth) / (noise * np.sqrt(0.5 + 0.5 * truth))
    wide = (truth > 5 * noise) & (truth < 1 - 5 * noise)  # the rest is clipped
    assert wide.mean() > 0.5
    z = z[wide].astype(float)
    quantised = np.mean(1 / 12 / (2**bits - 1) ** 2 / (noise**2 * (0.5 + 0.5 * truth[wide])))
    assert np.mean(z) == pytest.approx(0, abs=5 / np.sqrt(z.size))
    assert np.mean(z**2) == pytest.approx(1 + quantised, abs=5 * np.sqrt(2 / z.size))
    grid = (loud.picture(0, 0).astype(float) - truth)[:, :-1], (loud.picture(0, 0).astype(float) - truth)[:, 1:]
    both = wide[:, :-1] & wide[:, 1:]
    assert abs(np.corrcoef(grid[0][both], grid[1][both])[0, 1]) < 5 / np.sqrt(both.sum())  # from pixel to pixel


@pytest.mark.parametrize("bits", [8, 16])
def test_pictures_have_so_many_bits(bits, tmp_path):
    studio = balls(n=2, optics=replace(STILL, noise=0.02, bits=bits))
    picture = studio.picture(0, 0)
    assert picture.dtype == np.float32
    assert 0 <= picture.min() < picture.max() <= 1
    steps = picture.astype(float) * (2**bits - 1)
    assert np.abs(steps - np.rint(steps)).max() < 0.01
    assert len(np.unique(picture)) > 256 or bits == 8
    assert studio.write(tmp_path) == 2
    path = tmp_path / "cam1" / f"{studio.shots[0]}.png"
    assert cv2.imread(str(path), cv2.IMREAD_UNCHANGED).dtype == {8: np.uint8, 16: np.uint16}[bits]
    assert np.abs(read_picture(path) - picture).max() < 1e-6


def test_a_target_out_of_view_leaves_the_background():
    studio = balls(n=1, optics=STILL)
    behind = replace(studio.target, xyz=studio.target.xyz + 3000 * studio._towards_cameras)
    empty = replace(studio, target=behind).picture(0, 0)
    assert empty.shape == studio.picture(0, 0).shape
    assert np.mean(empty == studio.picture(0, 0)) > 0.8


def test_corners_are_darker():
    plain = balls(optics=STILL).picture(0, 0)
    dark = balls(optics=replace(STILL, vignetting=0.3)).picture(0, 0)
    assert dark[0, 0] == pytest.approx(0.7 * plain[0, 0], abs=1e-4)
    assert dark[-1, -1] == pytest.approx(0.7 * plain[-1, -1], abs=1e-4)
    middle = tuple(n // 2 for n in plain.shape)
    assert dark[middle] == pytest.approx(plain[middle], abs=1e-4)


@pytest.mark.slow
def test_what_is_covered_is_what_the_truth_calls_hidden():
    """Where a ball is seen, the picture is dark at its middle; where it is hidden, the bar's grey is there."""
    studio = balls(seed=3, n=6, cameras="cam2", covered=0.4)
    bare = replace(studio, covered=0.0)
    uv, visible = studio.true_pixels
    _, at_all = bare.true_pixels
    hidden = at_all & ~visible
    assert 0 < hidden.sum() < at_all.sum()
    for s in range(6):
        with_cover, without = studio.picture(0, s), bare.picture(0, s)
        assert np.any(with_cover != without) == hidden[s, 0]
        if at_all[s, 0]:
            u, v = np.rint(uv[s, 0]).astype(int)
            assert with_cover[v, u] == pytest.approx(0.3 if hidden[s, 0] else without[v, u], abs=0.01)


def test_nothing_hidden_is_what_views_says():
    studio = balls(seed=3, n=8, spec="stereo", cameras=None)
    uv, visible = views(studio.rig, studio.target)
    assert np.array_equal(studio.true_pixels[0], uv)
    assert not (studio.true_pixels[1] & ~visible).any()
    board = Studio(studio.rig, moving_board(studio.rig, corners=(4, 5), positions=2), STILL)
    assert np.array_equal(board.true_pixels[1], views(board.rig, board.target)[1])


def test_corners_of_a_covered_board_are_hidden_where_the_bar_is():
    rig = build_rig("stereo", seed=0, cameras="cam1")
    board = Studio(rig, moving_board(rig, corners=(5, 6), positions=3), STILL, 1, covered=1.0)
    bare = replace(board, covered=0.0)
    uv, visible = board.true_pixels
    assert 0.02 < 1 - visible.mean() < 0.9
    for s, shot in enumerate(board.shots):
        rows = np.flatnonzero(board.target.shots == shot)
        grey, clean = board.picture(0, s), bare.picture(0, s)
        cover = board._place_occluder(0, s)
        for row in rows:
            u, v = np.rint(uv[row, 0]).astype(int)
            clear = cover.distance(uv[row, 0])
            assert (clear > 0) == visible[row, 0]
            window = slice(v - 2, v + 3), slice(u - 2, u + 3)
            if clear > 8:
                assert np.array_equal(grey[window], clean[window])
            elif clear < -8:
                assert grey[window] == pytest.approx(np.full((5, 5), 0.3), abs=1e-3)


def test_a_cover_is_a_bar_with_round_ends():
    bar = Occluder(np.array([0.0, 0]), np.array([10.0, 0]), 2.0)
    at = np.array([[5, 0], [5, 3], [-4, 0], [13, 4], [0, -2]])
    assert bar.distance(at) == pytest.approx([-2, 1, 2, 3, 0])


@pytest.mark.parametrize(("spec", "camera"), [("stereo", 1), ("bar6", 1), ("bar6", 3)])
def test_corners_of_a_board_are_where_they_should_be(spec, camera):
    rig = build_rig(spec, seed=1, cameras=f"cam{camera + 1}")
    camera = 0
    studio = Studio(rig, moving_board(rig, corners=(5, 6), square=16, positions=2, step=40), STILL)
    uv, visible = studio.true_pixels
    for s, shot in enumerate(studio.shots):
        rows = (studio.target.shots == shot) & visible[:, camera]
        assert rows.sum() > 20
        true = uv[rows, camera]
        grey = np.rint(255 * studio.picture(camera, s)).astype(np.uint8)
        begin = (true + np.random.default_rng(s).uniform(-1, 1, true.shape)).astype(np.float32).reshape(-1, 1, 2)
        until = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
        found = cv2.cornerSubPix(grey, begin, (5, 5), (-1, -1), until).reshape(-1, 2)
        assert np.abs(found - true).max() < 0.05


def test_a_ball_is_a_dark_disc_where_it_should_be():
    """Its dark pixels have their middle near the ball's, nearer than what outline and middle differ by, and no more."""
    studio = balls(seed=5, n=3, cameras="cam1,cam2,cam3")
    uv, visible = studio.true_pixels
    for c, s in ((0, 0), (1, 1), (2, 2)):
        assert visible[s, c]
        picture = studio.picture(c, s)
        u, v = np.rint(uv[s, c]).astype(int)
        patch = picture[v - 40 : v + 41, u - 40 : u + 41]
        _, labels = cv2.connectedComponents((patch < 0.45 * patch.max()).astype(np.uint8))
        r, q = np.nonzero(labels == labels[40, 40])
        assert np.hypot(q.mean() - 40 + u - uv[s, c, 0], r.mean() - 40 + v - uv[s, c, 1]) < 1.5


@pytest.mark.parametrize(
    "wrong",
    [{"noise": -0.1}, {"noise": 1}, {"noise": np.nan}, {"blur": -1}, {"blur": 20}, {"vignetting": 1}, {"uneven": -0.5}],
)
def test_impossible_optics_are_refused(wrong):
    with pytest.raises(UsageError, match="out of range"):
        Optics(**wrong)


def test_wrong_detections_cannot_be_photographed():
    rig = build_rig("stereo", seed=0)
    target = random_positions(rig, 3, np.random.default_rng(0))
    with pytest.raises(UsageError, match="cannot be photographed"):
        record(rig, target, seed=0, outliers=0.1, optics=Optics())
    plain = record(rig, target, seed=0, outliers=0.1)
    assert plain.studio is None
    assert plain.photographs == 0


@pytest.mark.slow
def test_a_record_has_one_file_per_camera_and_shot(tmp_path):
    rig = build_rig("stereo", seed=0)
    made = record(rig, random_positions(rig, 3, np.random.default_rng(0)), seed=4, missing=0.4, optics=Optics())
    said = []
    made.write_photographs(tmp_path, lambda what, done, total: said.append((done, total)))
    found = find_pictures(tmp_path / "images")
    assert {camera: list(shots) for camera, shots in found.items()} == {
        camera.name: made.studio.shots for camera in rig.cameras
    }
    assert made.photographs == 6
    assert said[0] == (0, 6)
    assert (6, 6) in said
    assert np.array_equal(made.data.observations.seen, made.studio.true_pixels[1])
    assert made.data.extra["target"] == {"kind": "ball", "radius": 8.0}


def test_a_board_is_described():
    rig = build_rig("stereo", seed=0, unit="m")
    made = record(rig, moving_board(rig, corners=(4, 5), square=12.5, positions=1), seed=0, optics=STILL)
    described = made.data.extra["target"]
    assert (described["kind"], described["rows"], described["columns"]) == ("board", 4, 5)
    assert described["square"] == pytest.approx(0.0125)
