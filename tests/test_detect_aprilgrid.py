"""AprilGrids in rendered pictures: numbered as their generator numbered them, or refused, with right error bars."""

from pathlib import Path

import numpy as np
import pytest

from board_pictures import VIEW, errors, noisy, numbers, photograph, rotated
from implicam.dataset.boards import corner_positions
from implicam.detect import AprilGrid, View, detector_from_options
from implicam.errors import UsageError

cv2 = pytest.importorskip("cv2")

SHAPE = (480, 640)


def kalibr(rows, columns, *, border=2, turns=0, spacing=0.3, pixels=100, first=0):
    """Kalibr's board, drawn with OpenCV's tags: tag 0 at the lower left; a tag is `pixels` wide."""
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    gap = round(spacing * pixels)
    pitch = pixels + gap
    sheet = np.full((rows * pitch + gap, columns * pitch + gap), 255, np.uint8)
    for i in range(rows):
        for j in range(columns):
            tag = np.rot90(
                cv2.aruco.generateImageMarker(tags, first + i * columns + j, pixels, borderBits=border), turns
            )
            top = (rows - 1 - i) * pitch + gap
            sheet[top : top + pixels, j * pitch + gap : j * pitch + gap + pixels] = tag
    for i in range(rows + 1):
        for j in range(columns + 1):
            sheet[i * pitch : i * pitch + gap, j * pitch : j * pitch + gap] = 0
    return sheet, pixels


def paint(sheet, unit, margin=0.3):
    """A drawn board as a function of tags from its middle."""
    value = 0.1 + 0.7 * (sheet > 127)
    height, width = sheet.shape

    def at(x, y):
        i, j = np.floor(y * unit + height / 2).astype(int), np.floor(x * unit + width / 2).astype(int)
        printed = (i >= 0) & (i < height) & (j >= 0) & (j < width)
        grey = np.where(printed, value[np.clip(i, 0, height - 1), np.clip(j, 0, width - 1)], 0.8)
        there = (np.abs(x) < width / 2 / unit + margin) & (np.abs(y) < height / 2 / unit + margin)
        return np.where(there, grey, np.nan)

    return at


def truth(board, h, *, upwards=True):
    """(n, 2) pixels of all corners by their numbers."""
    flat = corner_positions({**board.describe(), "tag": 1.0, "spacing": board.spacing / board.tag})
    flat = flat - flat.mean(axis=0)
    w = h @ np.stack([flat[:, 0], flat[:, 1] if upwards else -flat[:, 1], np.ones(len(flat))])
    return (w[:2] / w[2]).T


BOARD = AprilGrid(4, 5, 88.0, 26.4)


@pytest.mark.parametrize(("angle", "border", "turns"), [(0.15, 2, 0), (2.5, 2, 2), (-1.2, 1, 0), (3.1, 1, 1)])
def test_all_corners_have_kalibrs_numbers_and_right_error_bars(angle, border, turns):
    h = rotated(angle, 55 if border == 2 else 64, tilt=(0.03, 0.02))
    found = BOARD.detect(photograph(paint(*kalibr(4, 5, border=border, turns=turns)), h, fine=4), VIEW)
    assert len(found) >= 75
    e = errors(found, truth(BOARD, h))
    assert np.linalg.norm(e, axis=1).max() < 0.2
    # The mean of 80 squared errors of two coordinates has sd 0.22; three of it, and the ratio's own.
    assert 1.3 < np.mean(np.sum((e / found.sd) ** 2, axis=1)) < 2.8


@pytest.mark.slow
def test_error_bars_hold_in_jpeg_pictures():
    values = []
    for k, quality in enumerate((75, 85, 95)):
        h = rotated(0.2 + 0.5 * k, 56, tilt=(0.02, -0.03))
        picture = photograph(paint(*kalibr(4, 5)), h, noise=0.006, seed=k, fine=4)
        image = cv2.imencode(".jpg", np.rint(255 * picture).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        found = BOARD.detect(cv2.imdecode(image, cv2.IMREAD_GRAYSCALE).astype(np.float32) / np.float32(255), VIEW)
        values.append(np.sum((errors(found, truth(BOARD, h)) / found.sd) ** 2, axis=1))
    assert 1.5 < np.concatenate(values).mean() < 2.6


def test_a_board_of_another_generator_counts_from_its_own_tag_0():
    """Drawn by the package moms-apriltag (MIT): tag 0 at the top left, borders of 1 bit, gaps of a quarter."""
    sheet = cv2.imread(str(Path(__file__).parent / "data" / "aprilgrid-2x3.png"), cv2.IMREAD_GRAYSCALE)
    board = AprilGrid(2, 3, 20.0, 5.0)
    h = rotated(0.3, 90, tilt=(0.02, 0.02))
    found = board.detect(photograph(paint(sheet, 8), h, fine=4), VIEW)
    assert numbers(found).tolist() == list(range(24))
    assert np.linalg.norm(errors(found, truth(board, h, upwards=False)), axis=1).max() < 0.1


def test_the_second_of_several_boards_begins_at_another_tag():
    """Multical #2, swatbotics/apriltag #21: boards whose tags begin at 48, or 30."""
    h = rotated(0.3, 56, tilt=(0.02, 0.02))
    picture = photograph(paint(*kalibr(4, 5, first=48)), h, fine=4)
    found = BOARD.detect(picture, VIEW)
    assert len(found) == 0
    assert "--first" in found.reason
    assert "48 to 67" in found.reason
    board = AprilGrid(4, 5, 88.0, 26.4, first=48)
    found = board.detect(picture, VIEW)
    assert len(found) >= 75
    assert np.linalg.norm(errors(found, truth(board, h)), axis=1).max() < 0.2
    assert board.describe()["first"] == 48


def test_part_of_a_board_is_numbered_by_its_tags():
    h = rotated(0.2, 110, at=(420, 300))
    found = BOARD.detect(photograph(paint(*kalibr(4, 5)), h, fine=4), VIEW)
    assert 20 < len(found) < 80
    assert np.linalg.norm(errors(found, truth(BOARD, h)), axis=1).max() < 0.1
    assert "hidden" in found.reason


@pytest.mark.parametrize(
    ("told", "word"),
    [
        (AprilGrid(5, 4, 88.0, 26.4), "do not lie as on an AprilGrid of 5 x 4"),
        (AprilGrid(4, 5, 88.0, 80.0), "gaps of 0.91 tags"),
        (AprilGrid(4, 5, 88.0, 26.4, "DICT_APRILTAG_16h5"), "tag"),
    ],
)
def test_another_board_than_stated_is_refused(told, word):
    picture = photograph(paint(*kalibr(4, 5)), rotated(0.2, 50), fine=4)
    found = told.detect(picture, VIEW)
    assert len(found) == 0
    assert word in found.reason


@pytest.mark.slow
def test_what_cannot_be_numbered_is_refused_with_its_reason():
    sheet, unit = kalibr(4, 5)
    one_tag = photograph(paint(sheet, unit), rotated(0.1, 300, at=(-150, -400)), fine=2)
    found = BOARD.detect(one_tag, VIEW)
    assert len(found) == 0
    assert found.reason
    mirrored = np.ascontiguousarray(photograph(paint(sheet, unit), rotated(0.1, 50), fine=4)[:, ::-1])
    assert len(BOARD.detect(mirrored, VIEW)) == 0
    shape = (480, 1100)
    small = AprilGrid(2, 3, 88.0, 26.4)
    board = paint(*kalibr(2, 3))
    left = photograph(board, rotated(0.1, 80, at=(270, 240)), shape=shape, noise=0, fine=3)
    both = photograph(board, rotated(-0.1, 80, at=(820, 240)), shape=shape, under=left, fine=3)
    assert "seen twice" in small.detect(both, VIEW).reason
    assert "no tag" in BOARD.detect(noisy(np.full(SHAPE, 0.5, np.float32), 0.1), VIEW).reason
    assert "black" in BOARD.detect(np.zeros(SHAPE, np.float32), View("cam1", "s1")).reason


@pytest.mark.parametrize(
    ("wrong", "word"),
    [
        ({"spacing": 0.3}, "ratio"),
        ({"tag": 0.0}, "do not go together"),
        ({"rows": 0}, "cannot be used"),
        ({"rows": 40, "columns": 40}, "too few tags"),
        ({"dictionary": "DICT_APRILTAG_36h12"}, "no dictionary"),
        ({"border": 3}, "border"),
    ],
)
def test_boards_that_cannot_be(wrong, word):
    with pytest.raises(UsageError, match=word):
        AprilGrid(**{"rows": 6, "columns": 6, "tag": 88.0, "spacing": 26.4} | wrong)


def test_it_is_made_from_the_options_and_described_for_a_calibration(tmp_path):
    board = detector_from_options("aprilgrid", tmp_path, board="6x6", tag=88.0)
    assert (board.tag, board.spacing) == (88.0, pytest.approx(26.4))
    flat = corner_positions(board.describe())
    assert flat.shape == (144, 2)
    assert np.allclose(flat[[0, 1, 2]], [[0, 660], [88, 660], [114.4, 660]])
    assert np.allclose(flat[12], [0, 572])  # the second row of corners, a tag higher
    with pytest.raises(UsageError, match="needs --tag"):
        detector_from_options("aprilgrid", tmp_path, board="6x6")
