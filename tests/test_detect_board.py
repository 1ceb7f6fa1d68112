"""Checkerboards and ChArUco boards, in pictures whose corners are known."""

import importlib.util

import numpy as np
import pytest

pytest.importorskip("cv2")

from board_pictures import SHAPE, VIEW, checkered, corners_of, errors, noisy, numbers, photograph, rotated
from implicam.detect.board import Board
from implicam.detect.charuco import Charuco
from implicam.detect.corners import fit_corners
from implicam.detect.grid import grow_grid
from implicam.detect.model import Detected, View
from implicam.detect.numbering import find_numberings
from implicam.detect.seeds import from_libcbdetect
from implicam.errors import UsageError
from implicam.images import opencv, read_picture
from implicam.simulate import build_rig, moving_board
from implicam.simulate.photographs import Optics, Studio


@pytest.fixture(scope="module")
def studio():
    rig = build_rig("bar6", seed=5)
    return Studio(rig, moving_board(rig), Optics(noise=0.015), seed=2)


def through_the_lenses(studio, shots, covered=0.0):
    """Squared normalised errors, errors, visible, found, refused: over all cameras and the shots given."""
    board, target = Board(), studio.target
    uv, visible = studio.true_pixels
    off, nees, seen, found, refused = [], [], 0, 0, 0
    for c, camera in enumerate(studio.rig.cameras):
        for s in shots:
            rows = target.shots == studio.shots[s]
            seen += int(visible[rows, c].sum())
            got = board.detect(studio.picture(c, s), View(camera.name, studio.shots[s]))
            refused += len(got) == 0
            if len(got):
                index = {name: k for k, name in enumerate(target.points)}
                e = got.uv - uv[[index[point] for point in got.points], c]
                off.append(e)
                nees.append(np.sum((e / got.sd) ** 2, axis=1))
                found += len(got)
    return np.concatenate(off), np.concatenate(nees), seen, found, refused


@pytest.mark.slow
def test_all_corners_through_all_lenses_near_and_far_with_right_error_bars(studio):
    off, nees, seen, found, refused = through_the_lenses(studio, (0, 19))
    assert refused == 0
    assert found >= 0.95 * seen
    assert np.linalg.norm(off, axis=1).max() < 0.1  # a wrong number is a square off, at least four pixels
    assert np.sqrt(np.mean(off**2)) < 0.02
    # The mean of n squared normalised errors of two coordinates has standard deviation 2 / sqrt(n) = 0.05.
    assert 1.7 < nees.mean() < 2.3


@pytest.mark.slow
def test_what_covers_a_board_never_makes_a_number_wrong():
    rig = build_rig("bar6", seed=7)
    studio = Studio(rig, moving_board(rig), Optics(noise=0.02), seed=9, covered=1.0)
    off, nees, _, _, refused = through_the_lenses(studio, (4,))
    assert np.linalg.norm(off, axis=1).max() < 0.2
    assert refused < 6  # some of them can be numbered for certain
    assert abs(nees.mean() - 2) < 0.3 + 8 / np.sqrt(len(nees))  # four standard deviations


@pytest.mark.parametrize("bits", [8, 10])
def test_pictures_of_few_bits_that_are_stored_with_sixteen_are_dark_and_good(tmp_path, bits):
    """Ten bits of a camera that nobody shifted: their white is 1.6 % of what the file can hold."""
    H = rotated(0.3, 24, tilt=(0.01, 0.005))
    picture = np.rint(photograph(checkered(8, 11), H, fine=4) * (2**bits - 1)).astype(np.uint16)
    assert opencv().imwrite(str(tmp_path / "dark.png"), picture)
    got = Board().detect(read_picture(tmp_path / "dark.png"), VIEW)
    assert len(got) == 88
    assert np.abs(errors(got, corners_of(8, 11, H))).max() < 0.06


@pytest.mark.parametrize("angle", [0.0, 0.7, 1.6, 2.5, np.pi, -2.2, -1.5, -0.6])
def test_a_board_that_is_turned_has_the_same_numbers(angle):
    h = rotated(angle, 24, tilt=(0.02, -0.015))
    found = Board(5, 8).detect(photograph(checkered(5, 8), h, fine=4), VIEW)
    assert numbers(found).tolist() == list(range(40))
    assert np.linalg.norm(errors(found, corners_of(5, 8, h)), axis=1).max() < 0.2
    assert found.reason == ""


def test_the_fit_has_no_bias_and_the_right_spread_on_skewed_edges():
    """Many noisy pictures of one plane: an independent renderer, a corner model that is not exact for skewed edges."""
    h = rotated(0.3, 16, tilt=(0.06, 0.04)) @ np.diag([1.0, 0.6, 1.0])
    truth = corners_of(6, 9, h)
    right = corners_of(6, 9, h @ np.array([[1, 0, 0.5], [0, 1, 0], [0, 0, 1]])) * 2 - 2 * truth
    down = corners_of(6, 9, h @ np.array([[1, 0, 0], [0, 1, 0.5], [0, 0, 1]])) * 2 - 2 * truth
    clean = photograph(checkered(6, 9), h, noise=0.0)
    fits = [fit_corners(noisy(clean, 0.02, seed), truth + 0.4, right, down) for seed in range(20)]
    e = np.array([fit.uv - truth for fit in fits])
    sd = np.array([fit.sd for fit in fits])
    assert np.abs(e.mean(axis=(0, 1))).max() < 4 * e.std() / np.sqrt(e.size / 2) + 0.003
    assert np.sqrt(np.mean(e**2)) < 0.03
    assert np.mean(np.sum((e / sd) ** 2, axis=2)) == pytest.approx(2, abs=0.3)


def test_a_corner_is_fitted_the_same_beside_what_is_none():
    """What never settles takes all rounds; the corners beside it end when they have settled, to what they state."""
    h = rotated(0.3, 22)
    picture, truth = photograph(checkered(5, 8), h, noise=0.02), corners_of(5, 8, h)
    right, down = (np.tile(step, (40, 1)) for step in (truth[1] - truth[0], truth[8] - truth[0]))
    whole = fit_corners(picture, truth + 0.5, right, down)
    beside = np.where(np.arange(40)[:, None] % 3 == 1, right / 2, 0.5)  # an edge's middle, which is no corner
    mixed = fit_corners(picture, truth + beside, right, down)
    for k in (0, 2, 3, 39):
        alone = fit_corners(picture, truth[k : k + 1] + 0.5, right[:1], down[:1])
        for others in (whole, mixed):
            np.testing.assert_allclose(alone.uv[0], others.uv[k], atol=1e-5)
            np.testing.assert_allclose(alone.sd[0], others.sd[k], rtol=1e-3)


def test_a_grid_that_grows_by_two_squares_does_not_jump_over_a_gap_of_one():
    """Corners beyond a hidden line are taken only where two neighbours of them are found, too."""
    h = rotated(0.1, 24)
    board, truth = checkered(8, 11), corners_of(8, 11, h).reshape(8, 11, 2)

    def paint(x, y):  # of the last two columns only what is about two corners is seen
        return np.where((x > 3.4) & ((np.abs(x - 5) > 0.6) | (np.abs(y) > 1.2)), 0.8, board(x, y))

    grid = grow_grid(photograph(paint, h, fine=4), truth[2:5, 2:5], 14)
    assert (grid.rows, grid.columns) == (8, 9)
    assert np.linalg.norm(grid.uv[grid.occupied][:, None] - truth.reshape(1, -1, 2), axis=2).min(axis=1).max() < 0.2


def test_the_error_bar_grows_with_the_noise():
    h = rotated(0.2, 22)
    clean = photograph(checkered(5, 8), h, noise=0.0)
    sds = [Board(5, 8).detect(noisy(clean, noise), VIEW).sd.mean() for noise in (0.01, 0.05)]
    assert sds[1] > 3 * sds[0]
    assert sds[1] < 6 * sds[0]


def test_half_a_board_is_numbered_only_where_its_ends_are_seen():
    """Of 8 x 11 corners some columns are left of the picture: what is seen of the rows shows that none is missing."""
    for first in (2, 3, 6):
        h = rotated(0.0, 30, at=(30 * (5.4 - first), 240))
        truth = corners_of(8, 11, h)
        found = Board().detect(photograph(checkered(8, 11), h, fine=4), VIEW)
        inside = truth[:, 0] > 12
        if len(found):
            assert np.linalg.norm(errors(found, truth), axis=1).max() < 0.2
            assert set(numbers(found)) >= set(np.flatnonzero(inside))
        else:
            assert "not certain" in found.reason
            readings = [np.linalg.norm(errors(other, truth), axis=1).max() for other in found.others]
            assert len(readings) >= 2
            assert min(readings) < 0.2  # the true one is among them
    h = rotated(0.0, 40, at=(320, 240))  # both ends of the rows outside, all rows and columns inside
    found = Board(5, 14).detect(photograph(checkered(5, 14), h, fine=4), VIEW)
    assert len(found) == 70


def test_the_middle_of_a_board_is_refused_with_all_its_readings():
    h = rotated(0.1, 80, at=(330, 250))
    found = Board().detect(photograph(checkered(8, 11), h, fine=2), VIEW)
    assert len(found) == 0
    assert "not certain which" in found.reason
    assert len(found.others) == 12
    assert Board().settle({VIEW: found}) == {VIEW: found}


def test_every_reading_of_a_part_keeps_the_colours():
    """Cut any part from a known board: the true reading is among the possible ones, half a turn of it never is."""
    h = rotated(0.4, 24)
    picture = photograph(checkered(8, 11), h, fine=4)
    truth = corners_of(8, 11, h).reshape(8, 11, 2)
    for rows, columns in ((slice(0, 4), slice(0, 5)), (slice(3, 7), slice(2, 9)), (slice(2, 8), slice(5, 8))):
        part = grow_grid(picture, truth[rows, columns], 0)  # it must not grow
        ways = find_numberings(part, (("unknown",),) * 4, 8, 11)
        shape = (part.rows, part.columns)
        readings = [(*(int(x[0, 0]) for x in way.of(shape)), way.turns) for way in ways]
        assert (rows.start, columns.start, 0) in readings
        for row, column, turns in readings:  # a half turn about the part's middle would exchange black and white
            assert turns != 0 or (row + column - rows.start - columns.start) % 2 == 0


@pytest.mark.parametrize(("rows", "columns"), [(5, 8), (6, 9), (9, 12)])
def test_another_size_than_stated_is_named(rows, columns):
    picture = photograph(checkered(rows, columns), rotated(0.2, 24), fine=4)
    found = Board().detect(picture, VIEW)
    assert len(found) == 0
    assert f"{rows} x {columns}" in found.reason or f"{columns} x {rows}" in found.reason
    assert "8 x 11" in found.reason


def test_two_boards_in_view_are_refused():
    shape = (480, 900)
    left = checkered(5, 8)
    one = photograph(left, rotated(0.1, 30, at=(230, 240)), shape=shape, noise=0, fine=4)
    both = photograph(left, rotated(-0.2, 26, at=(670, 240)), shape=shape, under=one, fine=4)
    found = Board(5, 8).detect(both, VIEW)
    assert len(found) == 0
    assert "two checkerboards" in found.reason
    assert len(found.outlines) == 2


def test_a_smaller_checkerboard_beside_the_board_does_not_matter():
    shape = (480, 900)
    one = photograph(checkered(4, 5), rotated(0.1, 30, at=(170, 240)), shape=shape, noise=0, fine=4)
    h = rotated(-0.2, 28, at=(620, 240))
    found = Board(8, 11).detect(photograph(checkered(8, 11), h, shape=shape, under=one, fine=4), VIEW)
    assert len(found) == 88
    assert np.linalg.norm(errors(found, corners_of(8, 11, h)), axis=1).max() < 0.2


def test_a_covered_corner_is_left_out_and_its_neighbours_stay():
    h = rotated(0.15, 28)
    truth = corners_of(6, 9, h)
    picture = photograph(checkered(6, 9), h, noise=0.0, fine=4)
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    picture[np.hypot(u - truth[22, 0] - 3, v - truth[22, 1]) < 9] = 0.5
    found = Board(6, 9).detect(noisy(picture), VIEW)
    assert set(numbers(found)) == set(range(54)) - {22}
    assert np.linalg.norm(errors(found, truth), axis=1).max() < 0.2
    assert found.reason.startswith("1 of the board's 54 corners")


def text(seed):
    """A page of random black strokes: nothing but false corners."""
    cv2 = opencv()
    rng = np.random.default_rng(seed)
    page = np.full(SHAPE, 0.8, np.float32)
    for _ in range(400):
        at = rng.integers(0, (SHAPE[1], SHAPE[0]))
        cv2.rectangle(page, at.tolist(), (at + rng.integers(3, 25, 2)).tolist(), float(rng.uniform(0, 1)), -1)
    return page


@pytest.mark.parametrize(
    ("picture", "word"),
    [
        (np.zeros(SHAPE, np.float32), "black"),
        (np.ones(SHAPE, np.float32), "white"),
        (np.full(SHAPE, 0.4, np.float32), "plain grey"),
        (np.full(SHAPE, np.nan, np.float32), "no numbers"),
        (np.zeros((3, 7), np.float32), "too small"),
        (np.zeros((0, 0), np.float32), "too small"),
        (np.random.default_rng(1).random(SHAPE, np.float32), "no checkerboard"),
        (np.tile(np.linspace(0, 1, SHAPE[1], dtype=np.float32), (SHAPE[0], 1)), "no checkerboard"),
        (noisy(text(1)), "no checkerboard"),
        (noisy(text(2)), "no checkerboard"),
    ],
)
def test_a_picture_without_a_board_gives_a_reason(picture, word):
    found = Board().detect(picture, VIEW)
    assert len(found) == 0
    assert word in found.reason


@pytest.mark.slow
def test_a_checkerboard_over_the_whole_picture_gives_a_reason():
    v, u = np.mgrid[:480, :640]
    picture = noisy(np.where((v // 20 + u // 20) % 2, 0.8, 0.1))
    found = Board().detect(picture, VIEW)
    assert len(found) == 0
    assert "inner corners" in found.reason


def test_the_picture_stays_as_it_was_and_the_answer_is_the_same_twice():
    picture = photograph(checkered(5, 8), rotated(0.1, 24), fine=4)
    before = picture.copy()
    first, second = (Board(5, 8).detect(picture, VIEW) for _ in range(2))
    assert np.array_equal(picture, before)
    assert np.array_equal(first.uv, second.uv)
    assert Detected.from_dict(first.as_dict()).as_dict() == first.as_dict()


@pytest.mark.parametrize(("rows", "columns"), [(8, 10), (7, 7), (2, 7), (8, 0), (8, 1001)])
def test_boards_that_cannot_be_numbered_are_refused_when_they_are_named(rows, columns):
    with pytest.raises(UsageError) as error:
        Board(rows, columns)
    assert error.value.fix
    if (rows + columns) % 2 == 0 and columns > 0:
        assert "ChArUco" in error.value.fix


def test_a_square_must_have_a_size():
    with pytest.raises(UsageError):
        Board(square=0.0)
    assert Board().options() == {
        "target": "board", "rows": 8, "columns": 11, "square": 13.29, "infer": False, "refine": False
    }  # fmt: skip


@pytest.mark.skipif(importlib.util.find_spec("libCBDetect") is None, reason="libCBDetect is not installed")
def test_the_papers_detector_cannot_take_this_process_down():
    """Version 1.0.5 divides by zero in a black picture: a signal, not an exception."""
    assert from_libcbdetect(np.zeros((200, 300), np.float32), 1.0) == []
    h = rotated(0.2, 24)
    (seed,) = from_libcbdetect(photograph(checkered(5, 8), h, fine=4), 1.0)
    assert grow_grid(photograph(checkered(5, 8), h, fine=4), seed, 11).count == 40


# ChArUco


def charuco(rows=6, columns=9, **more):
    return Charuco(rows, columns, 20.0, 15.0, **more)


def drawn(board, margin=1.0, pixels=60):
    """The board as OpenCV prints it, as a function of squares from its middle."""
    aruco = opencv().aruco
    dictionary = aruco.getPredefinedDictionary(getattr(aruco, board.dictionary))
    plan = aruco.CharucoBoard((board.columns, board.rows), board.square, board.marker, dictionary)
    plan.setLegacyPattern(board.legacy)
    image = plan.generateImage((board.columns * pixels, board.rows * pixels), marginSize=0, borderBits=1)
    image = 0.1 + 0.7 * (image > 127)

    def paint(x, y):
        i = np.floor((y + board.rows / 2) * pixels).astype(int)
        j = np.floor((x + board.columns / 2) * pixels).astype(int)
        printed = (i >= 0) & (i < image.shape[0]) & (j >= 0) & (j < image.shape[1])
        value = np.where(printed, image[np.clip(i, 0, image.shape[0] - 1), np.clip(j, 0, image.shape[1] - 1)], 0.8)
        sheet = (np.abs(x) < board.columns / 2 + margin) & (np.abs(y) < board.rows / 2 + margin)
        return np.where(sheet, value, np.nan)

    return paint


@pytest.mark.parametrize("angle", [0.1, np.pi])
def test_a_charuco_board_has_all_its_corners_however_it_is_turned(angle):
    h = rotated(angle, 34, tilt=(0.01, -0.012))
    found = charuco().detect(photograph(drawn(charuco()), h), VIEW)
    truth = corners_of(5, 8, h)
    assert numbers(found).tolist() == list(range(40))
    e = errors(found, truth)
    assert np.linalg.norm(e, axis=1).max() < 0.1
    assert 1.2 < np.mean(np.sum((e / found.sd) ** 2, axis=1)) < 3.2  # 40 corners: 2 +- 0.32, four of it


def test_part_of_a_charuco_board_is_numbered_by_its_markers():
    h = rotated(0.2, 60, at=(520, 330))
    found = charuco().detect(photograph(drawn(charuco()), h), VIEW)
    truth = corners_of(5, 8, h)
    inside = ((truth > 12) & (truth < np.array(SHAPE[::-1]) - 13)).all(axis=1)
    assert 0.8 * inside.sum() <= len(found) < 40
    assert np.linalg.norm(errors(found, truth), axis=1).max() < 0.1
    assert "hidden" in found.reason


def test_an_old_charuco_board_is_read_when_it_is_said_to_be_old():
    old = charuco(legacy=True)
    h = rotated(0.1, 34)
    picture = photograph(drawn(old), h)
    found = old.detect(picture, VIEW)
    assert len(found) == 40
    assert np.linalg.norm(errors(found, corners_of(5, 8, h)), axis=1).max() < 0.1
    taken_for_new = charuco().detect(picture, VIEW)
    assert len(taken_for_new) == 0
    assert taken_for_new.reason


@pytest.mark.parametrize("stated", [(6, 8), (7, 9), (9, 6)])
def test_a_charuco_board_of_another_size_gives_no_corner(stated):
    picture = photograph(drawn(charuco()), rotated(0.1, 34))
    found = charuco(*stated).detect(picture, VIEW)
    assert len(found) == 0 or stated[1] == 9  # with rows added or missing the numbers are the same
    assert found.reason


def test_charuco_pictures_without_a_board_give_a_reason():
    board = charuco()
    for picture in (np.zeros(SHAPE, np.float32), noisy(text(3)[:200, :300], 0.01)):
        found = board.detect(picture, VIEW)
        assert len(found) == 0
        assert found.reason
    mirrored = np.ascontiguousarray(photograph(drawn(board), rotated(0.1, 34))[:, ::-1])
    assert len(board.detect(mirrored, VIEW)) == 0
    other = charuco(dictionary="DICT_4X4_50")
    assert "DICT_4X4_50" in other.detect(photograph(drawn(board), rotated(0.1, 34)), VIEW).reason


def test_two_charuco_boards_in_view_are_refused():
    shape = (480, 900)
    board = charuco(5, 7)
    one = photograph(drawn(board), rotated(0.1, 45, at=(230, 240)), shape=shape, noise=0, fine=4)
    both = photograph(drawn(board), rotated(-0.1, 45, at=(670, 240)), shape=shape, under=one, fine=4)
    found = board.detect(both, VIEW)
    assert len(found) == 0
    assert "two" in found.reason


@pytest.mark.parametrize(
    "wrong",
    [{"rows": 2}, {"marker": 30.0}, {"marker": 0.0}, {"dictionary": "DICT_5X5_101"}, {"rows": 30, "columns": 30}],
)
def test_charuco_boards_that_cannot_be(wrong):
    with pytest.raises(UsageError):
        Charuco(**{"rows": 6, "columns": 9, "square": 20.0, "marker": 15.0} | wrong)
