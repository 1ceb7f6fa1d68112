"""Pictures that show no target, as people have reported that other detectors search them for minutes, or find one.

A nearly black picture and a board of many corners kept `findChessboardCorners` busy for a quarter of an hour (opencv
issue 23558); a scene without the board took minutes (gyroflow issue 116); a scene full of squares, so that among many
some look like a board (opencv pull request 24558); twelve megapixels; a tiled floor, which is a checkerboard.
"""

import time

import numpy as np
import pytest

pytest.importorskip("cv2")

from implicam.detect import Ball, Board
from implicam.detect.model import View
from implicam.images import one_thread_each, opencv

MAX_CPU_SECONDS = 20.0
"""They take up to a second."""


def nearly_black(rng):
    return np.round(255 * np.clip(0.02 + rng.normal(0, 0.012, (1080, 1920)), 0, 1)) / 255


def foliage(rng):
    edges = np.sign(opencv().GaussianBlur(rng.normal(0, 1, (540, 960)), (0, 0), 2))
    return np.clip(0.5 + 0.4 * edges + rng.normal(0, 0.05, edges.shape), 0, 1)


def squares(rng):
    picture = np.kron(rng.random((14, 24)) > 0.5, np.ones((40, 40))) * 0.6 + 0.2
    return opencv().GaussianBlur(picture, (0, 0), 1) + rng.normal(0, 0.02, picture.shape)


def twelve_megapixels(rng):
    picture = opencv().GaussianBlur(rng.normal(0, 1, (3000, 4000)), (0, 0), 3)
    return np.clip(0.5 + 0.25 * picture / picture.std(), 0, 1)


def tiled_floor(rng):
    v, u = np.mgrid[:540, :960]
    picture = 0.3 + 0.4 * ((u // 30 + v // 30) % 2)
    return opencv().GaussianBlur(picture, (0, 0), 1) + rng.normal(0, 0.02, picture.shape)


@pytest.mark.slow
@pytest.mark.parametrize("draw", [nearly_black, foliage, squares, twelve_megapixels, tiled_floor])
@pytest.mark.parametrize("detector", [Board(8, 11), Board(16, 25), Ball()], ids=["board", "large board", "ball"])
def test_a_picture_without_the_target_gives_nothing_soon(draw, detector):
    if draw is tiled_floor and isinstance(detector, Board) and detector.rows == 16:
        pytest.skip("the floor has about as many corners")
    picture = draw(np.random.default_rng(0)).astype(np.float32)
    with one_thread_each():
        begun = time.process_time()
        found = detector.detect(picture, View("cam1", "shot1"))
        assert time.process_time() - begun < MAX_CPU_SECONDS
    if draw is twelve_megapixels and isinstance(detector, Ball):
        return  # of a hundred thousand dark blobs one is a ball for all that a single picture can tell
    assert len(found) == 0
    assert found.reason
