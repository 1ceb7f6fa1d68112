"""The canvas of overlays and live tiles: every mark is where it was asked for, and nothing is outside."""

from __future__ import annotations

import numpy as np
import pytest

from implicam import drawing
from implicam.drawing import DARK, ORANGE, SKY, WHITE

pytest.importorskip("cv2")
pytest.importorskip("PIL")


def middle_of(canvas: drawing.Canvas) -> np.ndarray:
    weight = (canvas.pixels != 128).any(axis=2)
    return np.argwhere(weight)[:, ::-1].mean(axis=0)


@pytest.mark.parametrize("at", [(30.0, 20.0), (30.5, 20.25), (31.75, 19.5)])
def test_marks_are_at_their_sub_pixel_place(at: tuple[float, float]) -> None:
    for draw in (
        lambda canvas: canvas.stroke([drawing.circle(np.array(at), 8)], SKY),
        lambda canvas: canvas.dot(np.array(at), 5, SKY),
        lambda canvas: canvas.stroke([drawing.box(np.array(at) - 6, np.array(at) + 6)], SKY, 3, 2),
    ):
        canvas = drawing.blank(64, 48, (128, 128, 128))
        draw(canvas)
        assert middle_of(canvas) == pytest.approx(at, abs=0.4)


@pytest.mark.parametrize("anchor", ["lm", "mm", "rm", "ls", "rs"])
@pytest.mark.parametrize("at", [(60, 30), (-5, -5), (0, 59), (119, 3), (400, 400)])
def test_text_stays_on_the_canvas(anchor: str, at: tuple[int, int]) -> None:
    canvas = drawing.blank(120, 60, (128, 128, 128))
    canvas.write("p1 ball", at, 16, WHITE, anchor, 2)
    drawn = (canvas.pixels != 128).any(axis=2)
    if at == (400, 400):
        assert not drawn.any()
    if at == (60, 30):
        u = np.argwhere(drawn)[:, 1]
        width = drawing.text_width("p1 ball", 16)
        expected = {"l": (60, 60 + width), "m": (60 - width / 2, 60 + width / 2), "r": (60 - width, 60)}[anchor[0]]
        assert (u.min(), u.max()) == pytest.approx(expected, abs=4)
        assert (canvas.pixels == WHITE).all(axis=2).any()
        assert (canvas.pixels == DARK).all(axis=2).any()


def test_a_number_that_is_none_is_no_part_of_a_curve() -> None:
    curve = np.array([[1, 2], [np.nan, 3], [4, np.inf], [5, 6]])
    assert drawing.finite_points(curve).tolist() == [[1, 2], [5, 6]]


def test_what_is_far_off_is_no_problem() -> None:
    canvas = drawing.blank(20, 10, WHITE)
    canvas.stroke([np.array([[-1e12, 5], [1e12, 5]]), np.zeros((0, 2))], ORANGE)
    assert (canvas.pixels[5] != WHITE).any(axis=1).all()
    canvas.dot(np.array([1e12, -1e12]), 3, ORANGE)
    canvas.fill(-5, -5, 0, 0, ORANGE)
    assert (canvas.pixels[0] == WHITE).all()


def test_text_is_wrapped_and_cut_to_its_width() -> None:
    text = "twelve dots of the layout are not found because they are hidden " * 3
    lines = drawing.wrap_text(text, 200, 14, 3)
    assert len(lines) == 3
    assert lines[-1].endswith("...")
    assert all(drawing.text_width(line, 14) <= 200 for line in lines)
    assert " ".join(drawing.wrap_text(text, 200, 14, 99)) == text.strip()
    assert drawing.wrap_text("", 200, 14, 3) == []
    assert drawing.wrap_text("x" * 99, 50, 14, 3)[0].endswith("...")


def test_letters_that_the_font_has_not() -> None:
    canvas = drawing.blank(200, 30, WHITE)
    canvas.write("Süd 漢字 \x00 \ud800", (5, 20), 16, DARK)
    assert drawing.text_width("Süd", 16) == drawing.text_width("Sud", 16)
    assert drawing.text_width("漢", 16) == drawing.text_width("?", 16)


def test_a_border_and_a_paste() -> None:
    canvas, inner = drawing.blank(20, 12, WHITE), drawing.blank(6, 4, SKY)
    canvas.paste(inner, 5, 3)
    canvas.border(2, ORANGE)
    assert (canvas.pixels[3:7, 5:11] == SKY).all()
    assert (canvas.pixels[2:-2, 2:-2] == ORANGE).all(axis=2).sum() == 0
    assert (canvas.pixels == ORANGE).all(axis=2).sum() == 20 * 12 - 16 * 8
