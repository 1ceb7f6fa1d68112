"""Boards that something covers: the process on their grid, its error bars, and numbers that are right or refused."""

import numpy as np
import pytest

pytest.importorskip("cv2")

from board_pictures import VIEW, checkered, corners_of, errors, numbers, photograph, rotated
from implicam.detect.board import Board
from implicam.detect.corners import Corners
from implicam.detect.folder import _write_inferred
from implicam.detect.grid import Grid
from implicam.detect.model import Detected, Inferred
from implicam.detect.overlay import Result
from implicam.detect.plane import BoardPlane

NODES = np.argwhere(np.ones((8, 11), dtype=np.bool_)).astype(np.float64)


def bent(rng):
    """(88, 2) true pixels of a tilted board behind a wide lens: radial distortion of up to a tenth."""
    uv = corners_of(8, 11, rotated(rng.uniform(-3, 3), 40, tilt=tuple(rng.normal(size=2) * 0.02)))
    away = (uv - (320 + 60 * rng.normal(), 240 + 60 * rng.normal())) / 400
    r2 = np.sum(away**2, axis=1, keepdims=True)
    return uv - 400 * away * rng.uniform(0, 0.15) * r2


def grid_of(uv, sd, seen):
    corners = Corners.unknown(88)
    corners.uv[seen.ravel()], corners.sd[seen.ravel()] = uv[seen.ravel()], sd
    return Grid(8, 11, corners)


def test_hidden_corners_are_as_far_off_as_their_error_bars_say():
    """A patch of each of 40 boards is seen. Within a board errors are alike, so a board counts as one number."""
    each, sds = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        truth = bent(rng)
        seen = np.zeros((8, 11), dtype=np.bool_)
        i, j = rng.integers(0, 4), rng.integers(0, 6)
        seen[i : i + 4, j : j + 5] = True
        plane = BoardPlane.of(grid_of(truth + 0.02 * rng.normal(size=truth.shape), 0.02, seen), 5.5)
        near = ~seen.ravel() & (np.abs(NODES - (i + 1.5, j + 2)) < (4.6, 5.1)).all(axis=1)
        uv, covariance = plane.predict(NODES[near])
        off = uv - truth[near]
        each.append(np.mean(np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off)))
        sds.append(np.sqrt(np.einsum("nii->n", covariance).mean() / 2))
    # 2 is right. The mean of 40 has a standard deviation of 0.3; error bars twice too small or large give 8 or 0.5.
    assert 1 < np.mean(each) < 3.5
    assert np.mean(np.array(each) > 8) < 0.1
    assert np.median(sds) < 2  # pixels, of squares of 40


def test_what_all_say_of_a_corner_is_nearer_than_the_corner_itself():
    before, after = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        truth = bent(rng)
        uv = truth + 0.05 * rng.normal(size=truth.shape)
        fused, _ = BoardPlane.of(grid_of(uv, 0.05, np.ones((8, 11), dtype=np.bool_)), 5.5).predict(NODES)
        before.append(np.mean((uv - truth) ** 2))
        after.append(np.mean((fused - truth) ** 2))
    assert np.sqrt(np.mean(after)) < 0.6 * np.sqrt(np.mean(before))


def test_what_others_say_of_a_corner_is_a_fit_without_it():
    """Closed form against doing it: the homography stays, so the two differ a little."""
    rng = np.random.default_rng(5)
    uv = bent(rng) + 0.05 * rng.normal(size=(88, 2))
    everyone = np.ones((8, 11), dtype=np.bool_)
    others = BoardPlane.of(grid_of(uv, 0.05, everyone), 5.5).leave_one_out()
    for k in (0, 38):
        seen = everyone.copy()
        seen.flat[k] = False
        alone = BoardPlane.of(grid_of(uv, 0.05, seen), 5.5).predict(NODES[[k]])
        assert others.uv[k] == pytest.approx(alone.uv[0], abs=0.02)
        assert others.covariance[k] == pytest.approx(alone.covariance[0] + 0.05**2 * np.eye(2), rel=0.2, abs=2e-4)


def covered(*bars, rows=8, columns=11):
    """A board behind bars: (direction in radians, middle in squares, half width in squares, grey)."""
    board = checkered(rows, columns)

    def paint(x, y):
        value = board(x, y)
        for angle, middle, half, grey in bars:
            value = np.where(np.abs(x * np.cos(angle) + y * np.sin(angle) - middle) < half, grey, value)
        return value

    return paint


def picture_of(paint, h, seed=0):
    return photograph(paint, h, fine=2, seed=seed)


def test_a_board_on_either_side_of_a_wide_bar_is_one_board():
    """Six squares of eleven are hidden: no homography of a few neighbours reaches across."""
    h = rotated(0.2, 26, tilt=(0.02, 0.01))
    found = Board().detect(picture_of(covered((0.3, 0.2, 2.9, 0.3)), h), VIEW)
    truth = corners_of(8, 11, h)
    assert np.linalg.norm(errors(found, truth), axis=1).max() < 0.2
    columns = numbers(found) % 11
    assert columns.min() == 0
    assert columns.max() == 10
    assert found.inferred.points == ()


def test_inferred_corners_are_where_they_say_and_are_no_observations():
    h = rotated(-0.4, 26, tilt=(0.02, 0.01))
    picture, truth = picture_of(covered((0.3, 0.2, 1.8, 0.3)), h), corners_of(8, 11, h)
    plain = Board().detect(picture, VIEW)
    found = Board(infer=True).detect(picture, VIEW)
    assert found.points == plain.points  # and so they were without
    hidden = numbers(Detected(found.inferred.points))
    assert len(hidden) > 15
    assert sorted([*hidden, *numbers(found)]) == list(range(88))
    off = found.inferred.uv - truth[hidden]
    nees = np.einsum("ni,nij,nj->n", off, np.linalg.inv(found.inferred.covariance), off)
    assert nees.mean() < 6  # of one board, whose errors are alike: 2 is usual
    assert np.linalg.norm(off, axis=1).max() < 0.5
    assert Detected.from_dict(found.as_dict()).as_dict() == found.as_dict()


def test_refined_corners_are_nearer_and_keep_their_error_bars():
    h = rotated(0.3, 24, tilt=(0.02, 0.01))
    picture, truth = photograph(checkered(8, 11), h, fine=3, noise=0.04), corners_of(8, 11, h)
    plain, refined = (Board(refine=refine).detect(picture, VIEW) for refine in (False, True))
    assert np.array_equal(plain.sd, refined.sd)
    rms = [np.sqrt(np.mean(errors(found, truth) ** 2)) for found in (plain, refined)]
    assert rms[1] < 0.7 * rms[0]


@pytest.mark.slow
def test_what_is_in_front_of_a_board_never_makes_a_number_wrong():
    """Bars of any direction and grey, some of them white and along the squares, which look like a margin."""
    numbered = 0
    for seed in range(7):
        rng = np.random.default_rng([seed, 3])
        h = rotated(rng.uniform(-3, 3), 26, tilt=tuple(rng.normal(size=2) * 0.02))
        angle = rng.uniform(0, 3) if seed % 2 else rng.choice([0, np.pi / 2])
        bar = (angle, 2 * rng.normal(), rng.uniform(0.8, 2.4), float(rng.choice([0.1, 0.3, 0.8])))
        found = Board().detect(picture_of(covered(bar), h, seed), VIEW)
        numbered += len(found) > 0
        if len(found):
            assert np.linalg.norm(errors(found, corners_of(8, 11, h)), axis=1).max() < 0.3, (seed, bar)
    assert numbered >= 5


def find_behind_two_bars(seed):
    """Two bars along the squares or nearly, mostly white; whether the board was numbered, and rightly."""
    rng = np.random.default_rng([seed, 7])
    scale = rng.uniform(18, 30)
    turn = rng.choice([0, np.pi / 2, np.pi, -np.pi / 2]) + 0.1 * rng.normal()
    at = (320 + 120 * rng.normal(), 240 + 90 * rng.normal())
    h = rotated(turn, scale, at=at, tilt=tuple(0.015 * rng.normal(size=2)))
    bars = []
    for _ in range(2):
        angle = rng.choice([0, np.pi / 2]) + 0.05 * rng.normal()
        middle = np.round(8 * rng.normal()) / 2 + 0.15 * rng.normal()
        bars.append((angle, middle, rng.choice([0.5, 1, 1.5, 2, 3, 4]), float(rng.choice([0.1, 0.8, 0.8]))))
    found = Board().detect(picture_of(covered(*bars), h, seed), VIEW)
    right = np.linalg.norm(errors(found, corners_of(8, 11, h)), axis=1).max(initial=0) < 0.5
    return len(found) > 0, right


@pytest.mark.parametrize("seed", [6, 29])
def test_white_bars_that_once_passed_for_a_margin(seed):
    """Squares show beyond the one; the other is askew, so that dark squares before it read white."""
    assert find_behind_two_bars(seed)[1]


@pytest.mark.slow
def test_white_bars_along_the_squares_never_make_a_number_wrong():
    results = [find_behind_two_bars(seed) for seed in range(60)]
    assert all(right for _, right in results)
    assert sum(numbered for numbered, _ in results) >= 15


def test_slow_detectors_are_asked_only_where_the_board_cannot_be_read(monkeypatch):
    asked = []
    monkeypatch.setattr("implicam.detect.board.from_opencv", lambda picture, scale: asked.append("OpenCV") or [])
    monkeypatch.setattr("implicam.detect.board.from_libcbdetect", lambda picture, scale: asked.append("paper") or [])
    picture = picture_of(covered((0.3, 0.2, 1.8, 0.3)), rotated(-0.4, 26, tilt=(0.02, 0.01)))
    assert 30 < len(Board().detect(picture, VIEW)) < 88
    assert asked == []
    assert len(Board().detect(np.full((200, 200), 0.5, np.float32) + 0.2 * (np.arange(200) > 99), VIEW)) == 0
    assert asked == ["OpenCV", "paper"]


def test_one_corner_of_a_board_is_refused_with_both_its_readings():
    """The black corner square is at two corners of the board; the hidden rest would say at which."""
    h = rotated(0.1, 26)
    paint = covered((0.0, 3.5, 5.0, 0.4), (np.pi / 2, 4.0, 4.5, 0.4))
    found = Board().detect(picture_of(paint, h), VIEW)
    assert len(found) == 0
    assert "can be numbered in 2 ways" in found.reason
    assert min(np.linalg.norm(errors(one, corners_of(8, 11, h)), axis=1).max() for one in found.others) < 0.3


@pytest.mark.parametrize("inner", [1.2, 0.0])
def test_a_ring_or_a_disc_on_the_board_leaves_one_board(inner):
    """Situation of aprilgrid-rs issue 19: a reflecting ring about the middle made two boards of one."""
    board = checkered(8, 11)

    def paint(x, y):
        r = np.hypot(x, y)
        return np.where((r > inner) & (r < inner + 1.5), 0.95, board(x, y))

    h = rotated(0.2, 26, tilt=(0.01, 0.02))
    found = Board().detect(picture_of(paint, h), VIEW)
    assert len(found) >= 60
    assert np.linalg.norm(errors(found, corners_of(8, 11, h)), axis=1).max() < 0.2


def test_inferred_corners_have_a_file_of_their_own_which_goes_with_them(tmp_path):
    path = tmp_path / "inferred.csv"
    inferred = Inferred(("s1-c001",), np.array([[10.0, 20.0]]), np.array([[[4.0, 1.0], [1.0, 9.0]]]))
    some = Result(VIEW, tmp_path / "s1.png", Detected(inferred=inferred))
    (note,) = _write_inferred(path, [some])
    assert "1 hidden points" in note
    assert path.read_text().splitlines() == [
        "point,camera,u,v,sd_u,sd_v,correlation",
        "s1-c001,cam1,10,20,2,3,0.166667",
    ]
    assert _write_inferred(path, [Result(VIEW, tmp_path / "s1.png", Detected())]) == []
    assert not path.exists()
