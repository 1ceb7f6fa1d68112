"""Boards to print: in their true size, and the detector that they name finds their corners where they were drawn."""

import re

import numpy as np
import pytest

from implicam.cli import main
from implicam.dataset.boards import corner_positions
from implicam.detect import AprilGrid, Board, Charuco, View
from implicam.errors import UsageError
from implicam.images import read_picture

cv2 = pytest.importorskip("cv2")
pytest.importorskip("matplotlib")

from implicam.figures.board_sheet import draw_board  # noqa: E402

PIXELS_PER_MM = 300 / 25.4 / 4
"""The pictures are looked at in a quarter of their size."""


@pytest.mark.parametrize(
    ("board", "paper"),
    [
        (Board(6, 9, 20.0), "a4"),
        (Charuco(6, 8, 24.0, 18.0), "a4"),
        (Charuco(6, 5, 30.0, 22.0, "DICT_APRILTAG_36h11", legacy=True), "A4"),
        (AprilGrid(4, 5, 28.0, 8.4), "a4"),
        (AprilGrid(3, 4, 40.0, 10.0, border=1), "letter"),
    ],
)
def test_what_is_printed_is_detected_in_its_true_size(board, paper, tmp_path):
    draw_board(board, paper, tmp_path / "board.png")
    picture = read_picture(tmp_path / "board.png")
    height, width = (size // 4 * 4 for size in picture.shape)
    small = cv2.resize(picture[:height, :width], None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    found = board.detect(0.1 + 0.8 * cv2.GaussianBlur(small, (0, 0), 0.7), View("cam1", "s1"))
    flat = corner_positions(board.describe())
    assert len(found) == len(flat), found.reason
    mm = (found.uv - found.uv.mean(axis=0)) / PIXELS_PER_MM  # not turned: right and down, as on the board
    assert np.abs(mm - (flat - flat.mean(axis=0))).max() < 0.05


def test_edges_of_squares_in_a_png_are_where_they_belong_not_on_whole_pixels(tmp_path):
    draw_board(Board(6, 9, 20.0), "a4", tmp_path / "board.png")
    dark = 1.0 - read_picture(tmp_path / "board.png")
    square = 20.0 * 300 / 25.4
    for lines in (dark, dark.T):
        half = len(lines) // 2
        row = next(row for row in lines[half - 140 :] if (row[500:-500] > 0.5).mean() > 0.3)[150:]
        starts = np.flatnonzero((row[1:] >= 0.5) & (row[:-1] < 0.5)) + 1
        ends = np.flatnonzero((row[1:] < 0.5) & (row[:-1] >= 0.5)) + 1
        ends = ends[: len(starts)]
        lefts = [a + 1 - row[a - 1] - row[a] for a in starts[: len(ends)]]
        rights = [b - 1 + row[b] + row[b - 1] for b in ends]
        edges = np.array([lefts, rights]).T[:3].ravel()
        np.testing.assert_allclose(np.diff(edges), square, atol=0.01)  # px


def test_a_page_has_the_size_of_its_paper_and_is_the_same_file_twice(tmp_path):
    for ending in ("pdf", "svg"):
        for name in ("a", "b"):
            assert draw_board(Board(6, 9, 20.0), "a4", tmp_path / f"{name}.{ending}") == (200.0, 150.0)
        assert (tmp_path / f"a.{ending}").read_bytes() == (tmp_path / f"b.{ending}").read_bytes()
    box = re.search(rb"MediaBox \[ 0 0 ([0-9.]+) ([0-9.]+) \]", (tmp_path / "a.pdf").read_bytes())
    assert [float(x) * 25.4 / 72 for x in box.groups()] == pytest.approx([297, 210])
    width = re.search(r'width="([0-9.]+)pt"', (tmp_path / "a.svg").read_text())[1]
    assert float(width) * 25.4 / 72 == pytest.approx(297, abs=1e-4)


def test_the_bars_are_as_long_as_they_say(tmp_path):
    across, along = draw_board(Board(6, 9, 20.0), "a4", tmp_path / "board.png")
    dark = read_picture(tmp_path / "board.png") < 0.7

    def longest(lines):
        """Of all runs of dark pixels along the rows of an array."""
        edges = np.diff(np.pad(lines, ((0, 0), (1, 1))).astype(np.int8), axis=1)
        return max(
            np.flatnonzero(row < 0)[k] - start for row in edges for k, start in enumerate(np.flatnonzero(row > 0))
        )

    assert longest(dark) * 25.4 / 300 == pytest.approx(across, abs=0.4)  # a line is 0.2 mm wide
    assert longest(dark.T) * 25.4 / 300 == pytest.approx(along, abs=0.4)


def test_a_board_that_does_not_fit_says_what_would(tmp_path):
    with pytest.raises(UsageError, match="does not fit on a4") as caught:
        draw_board(AprilGrid(6, 6, 88.0, 26.4), "a4", tmp_path / "x.pdf")
    share = int(re.search(r"([0-9]+) % as large", caught.value.fix)[1]) / 100
    draw_board(AprilGrid(6, 6, 88.0 * share, 26.4 * share), "a4", tmp_path / "x.pdf")
    with pytest.raises(UsageError, match="no paper 'a5'"):
        draw_board(Board(6, 9, 10.0), "a5", tmp_path / "x.pdf")
    with pytest.raises(UsageError, match="not known"):
        draw_board(Board(6, 9, None), "a4", tmp_path / "x.pdf")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("board show", "implicam board print"),
        ("board print --target dots", "no board"),
        ("board print --board 8x11 --square 16 --marker 3", "has no --marker"),
        ("board print --board 8x11 --square 16 -o board.doc", "no picture"),
        ("board print --board 8x10 --square 16", "upside down"),
    ],
)
def test_mistakes_are_told(words, told, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(words.split())
    assert ended.value.code == 2
    assert told in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
