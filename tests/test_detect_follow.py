"""A ball in live pictures: near its last place first, by the same tests, and never a thing that was always there."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from implicam.detect.ball import Ball
from implicam.detect.follow import Follower
from implicam.detect.model import Detected, DetectorBase, View
from implicam.simulate import Optics, Rig, Studio, build_rig, random_positions
from implicam.simulate.targets import Target


def followed(studio: Studio, camera: int) -> tuple[list[Detected], list[Detected | None], list[Detected]]:
    """Of each picture of a camera: what the whole shows, what was found near the last place, and what is shown live."""
    detector, follower = Ball(), Follower(Ball())
    whole, near, shown = [], [], []
    for s in range(len(studio.shots)):
        picture, view = studio.picture(camera, s), View("cam1", "live")
        whole.append(detector.detect(picture, view))
        one = follower.near(picture, view)
        near.append(one)
        shown.append(follower.found(picture, whole[-1]) if one is None else one)
    return whole, near, shown


def walk(rig: Rig, places: int, step: float) -> Target:
    start = random_positions(rig, places, np.random.default_rng(3))
    xyz = start.xyz.copy()
    xyz[2:] = xyz[1] + step * np.arange(1, places - 1)[:, None] * np.array([1.0, 0.4, 0.2])
    return replace(start, xyz=xyz)


@pytest.mark.slow
def test_a_ball_that_moves_is_found_near_its_last_place_as_in_the_whole_picture() -> None:
    rig = build_rig("stereo", seed=2, cameras="cam1")
    whole, near, shown = followed(Studio(rig, walk(rig, 9, 2.0), Optics(), 2), 0)
    assert all(len(one) == 1 for one in shown)
    assert near[0] is None  # not before it is known to have come
    assert near[1] is None
    looked = [(a, b) for a, b in zip(whole, near, strict=True) if b is not None]
    assert len(looked) >= 5
    for a, b in looked:
        np.testing.assert_allclose(a.uv, b.uv, atol=0.02 * a.sd.max() + 0.01)
        np.testing.assert_allclose(a.sd, b.sd, rtol=0.1)


@pytest.mark.slow
def test_a_ball_that_jumps_or_goes_is_looked_for_in_the_whole_picture() -> None:
    rig = build_rig("stereo", seed=2, cameras="cam1")
    places = random_positions(rig, 4, np.random.default_rng(5))
    order = np.array([0, 1, 1, 2, 2, 3])
    target = replace(random_positions(rig, 6, np.random.default_rng(5)), xyz=places.xyz[order])
    whole, near, shown = followed(Studio(rig, target, Optics(), 2), 0)
    assert [one is not None for one in near] == [False, False, True, False, True, False]
    for a, b in zip(whole, shown, strict=True):
        np.testing.assert_allclose(a.uv, b.uv, atol=0.05)
    empty = np.full((400, 600), 0.5, np.float32)
    assert Ball().detect_near(empty, View("cam1", "live"), whole[0]) is None


def test_what_looks_like_a_ball_and_was_always_there_is_not_followed() -> None:
    """The ball is hidden, a disc of its size and colour is found instead, and then the ball is back."""

    def scene(ball: tuple[int, int] | None) -> np.ndarray:
        picture = np.full((480, 640), 0.3, np.float32)
        for u, v in ((140, 120), *([ball] if ball else [])):
            cv2.rectangle(picture, (u - 40, v - 40), (u + 40, v + 40), 0.9, -1)
            cv2.circle(picture, (u, v), 14, 0.1 if (u, v) == ball else 0.16, -1, cv2.LINE_AA)  # the thing is fainter
        noise = np.random.default_rng(0).normal(0, 0.01, picture.shape)
        return np.clip(cv2.GaussianBlur(picture, (0, 0), 0.8) + noise, 0, 1).astype(np.float32)

    class Likeliest(Ball):
        """Of two balls the better, so that the thing is found only where the ball is hidden."""

        def detect(self, picture: np.ndarray, view: View) -> Detected:
            found = super().detect(picture, view)
            return found.others[0] if not len(found) and found.others else found

    detector, view = Likeliest(), View("cam1", "live")
    follower = Follower(detector)
    shown = []
    for ball in [(400, 300), (500, 200), None, None, (500, 210), (505, 215), (510, 220)]:
        picture = scene(ball)
        near = follower.near(picture, view)
        one = follower.found(picture, detector.detect(picture, view)) if near is None else near
        shown.append((tuple(np.rint(one.uv[0]).astype(int).tolist()), near is not None))
    assert [place for place, _ in shown] == [
        (400, 300), (500, 200), (140, 120), (140, 120), (500, 210), (505, 215), (510, 220),
    ]  # fmt: skip
    assert [by_near for _, by_near in shown] == [False, False, False, False, False, True, True]


def test_the_whole_picture_is_searched_every_few_pictures() -> None:
    class Everywhere(DetectorBase):
        def detect_near(self, picture: np.ndarray, view: View, last: Detected) -> Detected:
            return last

        def was_there(self, earlier: np.ndarray, picture: np.ndarray, found: Detected) -> bool:
            return False

    def at(u: float) -> Detected:
        return Detected(("live",), np.array([[u, 0.0]]), np.ones((1, 2)), notes={"radius_px": 1.0})

    picture, searched = np.zeros((4, 4), np.float32), []
    follower = Follower(Everywhere(), 3)  # type: ignore[arg-type]
    for k in range(40):
        if follower.near(picture, View("cam1", "live")) is None:
            searched.append(k)
            follower.found(picture, at(0.0 if k == 0 else 50.0))
    assert searched == [0, 1, 6, 16, 26, 36]
    plain = Follower(DetectorBase())  # type: ignore[arg-type]
    assert plain.near(picture, View("cam1", "live")) is None
    assert len(plain.found(picture, at(1.0))) == 1
