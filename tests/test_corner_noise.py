"""The error bars of corners in pictures as cameras and programs leave them: JPEG, a colour sensor's mosaic, plain."""

import functools

import numpy as np
import pytest

from board_pictures import VIEW, checkered, corners_of, errors, noisy, photograph, rotated
from implicam.detect.board import Board
from implicam.detect.corner_noise import _log_densities, error_ratio
from implicam.images import opencv

cv2 = pytest.importorskip("cv2")

ROWS, COLUMNS = 6, 9


@functools.cache
def scenes():
    """Clean pictures, boards tilted and turned, and where the corners are."""
    out = []
    for k in range(4):
        rng = np.random.default_rng([k, 11])
        h = rotated(0.1 + 0.3 * k, rng.uniform(24, 34), tilt=tuple(rng.uniform(-0.03, 0.03, 2)))
        h = h @ np.diag([1, rng.uniform(0.7, 1), 1])
        clean = photograph(checkered(ROWS, COLUMNS), h, blur=[0.4, 0.6, 0.9, 1.2][k], noise=0, fine=5)
        out.append((clean, corners_of(ROWS, COLUMNS, h)))
    return out


def bits(picture):
    return np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8)


def jpeg(image, quality):
    return cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_UNCHANGED)


def mosaic(picture, gains=(0.6, 1.0, 0.7)):
    """What a colour sensor without white balance records of a grey scene."""
    raw = picture.copy()
    raw[0::2, 0::2] *= gains[0]
    raw[0::2, 1::2] *= gains[1]
    raw[1::2, 0::2] *= gains[1]
    raw[1::2, 1::2] *= gains[2]
    return raw


def interpolated(method):
    code = getattr(cv2, f"COLOR_BayerRG2BGR{method}")
    return lambda picture: cv2.cvtColor(cv2.cvtColor(bits(picture), code), cv2.COLOR_BGR2GRAY)


KINDS = {
    "plain": bits,
    "jpeg 95": lambda picture: jpeg(bits(picture), 95),
    "jpeg 85": lambda picture: jpeg(bits(picture), 85),
    "jpeg 75": lambda picture: jpeg(bits(picture), 75),
    "mosaic as it is": bits,
    "bilinear": interpolated(""),
    "edge-aware": interpolated("_EA"),
    "gradients": interpolated("_VNG"),
    "bilinear, jpeg 85": lambda picture: jpeg(interpolated("")(picture), 85),
}


def taken(kind, clean, noise, seed):
    scene = mosaic(clean) if kind in ("mosaic as it is", "edge-aware", "gradients") or "bilinear" in kind else clean
    picture = scene + noise * np.random.default_rng(seed).normal(size=scene.shape)
    return KINDS[kind](picture).astype(np.float32) / np.float32(255)


def nees(found, truth):
    return np.sum((errors(found, truth) / found.sd) ** 2, axis=1)


@pytest.mark.parametrize("kind", KINDS)
def test_error_bars_hold_whatever_became_of_the_pixels(kind):
    board, values = Board(ROWS, COLUMNS), []
    for k, (clean, truth) in enumerate(scenes()):
        found = board.detect(taken(kind, clean, (0.004, 0.01)[k % 2], k), VIEW)
        assert len(found) >= (0.7 if kind == "mosaic as it is" else 0.9) * ROWS * COLUMNS
        values.append(nees(found, truth))
        assert values[-1].max() < 30  # of 54 corners; chance leaves 8 to 12
    # The mean of n squared errors of two coordinates has sd 2 / sqrt(n) = 0.14; that of the ratio itself adds a fifth.
    assert 1.5 < np.concatenate(values).mean() < 2.6


def test_where_a_board_cannot_tell_its_error_bars_are_not_too_small():
    """Corners at one phase of the pixels' grid are all off together: a whole number of pixels a square, not turned."""
    for offset in (0.1, 0.6):
        h = np.array([[28.0, 0, 190.5 + offset], [0, 28.0, 140.5 - offset], [0, 0, 1]])
        clean = photograph(checkered(ROWS, COLUMNS), h, blur=0.5, noise=0, fine=10, shape=(280, 380))
        found = Board(ROWS, COLUMNS).detect(taken("edge-aware", clean, 0.004, 3), VIEW)
        assert nees(found, corners_of(ROWS, COLUMNS, h)).mean() < 4


def test_the_ratio_is_one_where_errors_are_as_stated_and_follows_them():
    rng = np.random.default_rng(4)
    nodes = np.argwhere(np.ones((ROWS, COLUMNS))).astype(float)
    truth = corners_of(ROWS, COLUMNS, rotated(0.3, 30, tilt=(0.03, 0.02)))
    sd = np.full(truth.shape, 0.02)
    for times in (0.3, 1.0, 6.0):
        ratios = [error_ratio(nodes, truth + times * sd * rng.normal(size=sd.shape), sd, 4.5) for _ in range(10)]
        # of 2 x 54 - 8 degrees of freedom: 7 % each
        assert np.mean(ratios) == pytest.approx(times, rel=0.12)
    few = [error_ratio(nodes[:7], truth[:7] + 0.02 * rng.normal(size=(7, 2)), sd[:7], 4.5) for _ in range(20)]
    assert 0.5 < np.mean(few) < 2


def test_a_picture_of_little_noise_is_not_overrated():
    clean, truth = scenes()[2]
    found = Board(ROWS, COLUMNS).detect(noisy(clean, 0.0), VIEW)
    assert found.sd.max() < 0.01
    assert np.abs(errors(found, truth)).max() < 6 * found.sd.max()
    assert opencv() is cv2


def test_one_reduction_gives_the_density_of_every_ratio():
    rng = np.random.default_rng(4)
    root = rng.normal(size=(2, 30, 30)) * np.exp(rng.uniform(-4, 6, size=30))
    covariances, rest, added = list(root @ root.swapaxes(1, 2)), rng.normal(size=30), np.exp(np.linspace(-5, 10, 7))
    found = _log_densities(covariances, rest, added)
    for k, covariance in enumerate(covariances):
        for j, more in enumerate(added):
            whole = covariance + more * np.eye(30)
            log_density = -0.5 * (rest @ np.linalg.solve(whole, rest) + np.linalg.slogdet(whole)[1])
            assert found[k, j] == pytest.approx(log_density, rel=1e-6)
