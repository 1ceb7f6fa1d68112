"""Live pictures: how many sets a second are searched, and whether looking near the last place finds false balls.

    python benchmarks/live.py speed [--sets 60]
    python benchmarks/live.py false [--rigs 4] [--shots 60] [--real /work/shared/real]

speed: six rendered cameras of 1280 x 800 (`bar6`), a ball that moves about 20 mm from set to set, each picture decoded
from JPEG as a USB camera sends it, and `SessionController.live` as the page calls it. First every picture is searched
as a whole, then near the last place. CPU is of the whole process, all threads: ten sets a second on two cores are
200 ms a set at most.

false, rendered: the ball walks, jumps to another place every 15th set, and is covered in a fifth of the pictures; the
background of each camera has 14 look-alikes. A false ball is one more than 3 px off, or where none can be seen. Every
picture is searched both ways. false, real: photographs of targets in tanks by others, which show no ball and hundreds
of dots; a film of ten pictures of each with noise is followed, of a camera that stands still and of one that shakes by
3 px, so that all dots move; and a ball is said to have been at each of a lattice of places, in five sizes: how often
something there is taken for it, before it is asked whether it has come.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from ball import FALSE, true_middle
from implicam.detect import Ball, follow
from implicam.detect.follow import Follower
from implicam.detect.model import Detected, View
from implicam.hardware.protocol import Frame
from implicam.images import one_thread_each, read_picture
from implicam.session.controller import Equipment, SessionController
from implicam.session.setup import Setup, open_session
from implicam.simulate import Optics, Studio, build_rig, random_positions
from implicam.simulate.targets import Target

STEP, JUMP_EVERY, COVERED = 0.1, 15, 0.2
"""The ball's step, as a part of the volume's size; sets from jump to jump; share of pictures in which it is covered."""


def walk(rig, shots, rng, jump_every=JUMP_EVERY):
    """A ball that walks through the volume, and jumps now and then."""
    target = random_positions(rig, shots, rng)
    xyz = target.xyz.copy()
    size = np.linalg.norm(rig.volume.size) / np.sqrt(3)
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    for s in range(1, shots):
        if s % jump_every:
            way = rng.normal(size=3)
            xyz[s] = np.clip(xyz[s - 1] + STEP * size * way / np.linalg.norm(way), low, high)
    return Target(target.name, target.points, target.shots, xyz)


class Film:
    """A camera that shows JPEGs one after another, as often as it is asked."""

    live = True

    def __init__(self, name, pictures):
        self.name, self._pictures, self._next = name, pictures, 0

    def open(self):
        """Nothing to do."""

    def close(self):
        """Nothing to do."""

    def frame(self, timeout=5.0):
        """The next picture, decoded."""
        data = self._pictures[self._next % len(self._pictures)]
        self._next += 1
        grey = cv2.cvtColor(cv2.imdecode(data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2GRAY)
        return Frame(np.asarray(grey, np.float32) * np.float32(1 / 255), self._next, time.time())


def speed(sets):
    rig = build_rig("bar6", seed=1)
    studio = Studio(rig, walk(rig, 24, np.random.default_rng(1), 1000), Optics(), 1)
    films = []
    for c, camera in enumerate(rig.cameras):
        shown = [(studio.picture(c, s) * 255).astype(np.uint8) for s in range(24)]
        order = [*shown, *shown[-2:0:-1]]  # there and back
        films.append((camera.name, [cv2.imencode(".jpg", one, [cv2.IMWRITE_JPEG_QUALITY, 90])[1] for one in order]))
    print("| search | sets a second | CPU a set, ms | ball found |\n|---|---|---|---|")
    for words, every in (("the whole picture", 1), ("near its last place first", follow.WHOLE_EVERY)):
        follow.WHOLE_EVERY = every
        with tempfile.TemporaryDirectory() as folder, open_session(Path(folder) / "s", Setup(seed=1)) as made:
            cameras = [Film(*film) for film in films]
            equipment = Equipment(cameras, made.equipment.robot, Ball())
            controller = SessionController(made.session, equipment, made.loop)
            controller.start()
            found = 0
            with one_thread_each():
                controller.live()
                begun, spent = time.perf_counter(), time.process_time()
                for _ in range(sets):
                    controller.live()
                    found += len(controller.state.cameras_with_ball)
                wall, cpu = time.perf_counter() - begun, time.process_time() - spent
        print(f"| {words} | {sets / wall:.1f} | {1000 * cpu / sets:.0f} | {found / sets / len(films):.1%} |")


def wrong(one, studio, c, s):
    """Whether a ball is more than `FALSE` pixels off, or where none can be seen."""
    if not len(one):
        return False
    off = np.linalg.norm(one.uv[0] - true_middle(studio.rig.cameras[c], studio.shown_object(s)))
    return bool(not studio.true_pixels[1][s, c] or off > FALSE)


def false_rendered(rigs, shots):
    counts = dict.fromkeys(
        ("pictures", "near", "both", "false whole", "false near", "false near, whole right", "another ball"), 0
    )
    worst = 0.0
    for seed in range(rigs):
        rig = build_rig("bar6", seed=seed)
        target = walk(rig, shots, np.random.default_rng([seed, 7]))
        studio = Studio(rig, target, Optics(noise=0.02, blur=1.0), seed, COVERED)
        for c, camera in enumerate(rig.cameras):
            follower, detector = Follower(Ball(), c), Ball()
            for s in range(shots):
                picture, view = studio.picture(c, s), View(camera.name, "live")
                whole, near = detector.detect(picture, view), follower.near(picture, view)
                if near is None:
                    follower.found(picture, whole)
                counts["pictures"] += 1
                counts["false whole"] += wrong(whole, studio, c, s)
                if near is None:
                    continue
                counts["near"] += 1
                counts["false near"] += wrong(near, studio, c, s)
                counts["false near, whole right"] += wrong(near, studio, c, s) and not wrong(whole, studio, c, s)
                if len(whole):
                    counts["both"] += 1
                    apart = float(np.linalg.norm(near.uv[0] - whole.uv[0]))
                    counts["another ball"] += apart > FALSE
                    worst = max(worst, apart if apart < FALSE else 0.0)
    print(f"rendered: {counts}; the same ball differs by {worst:.2g} px at most")


def false_real(folder):
    for shake in (0, 3):
        counts = dict.fromkeys(("pictures", "found whole", "found followed", "of these not in the whole"), 0)
        for path in sorted(folder.glob("*/images/*/*")):
            for bright in (False, True):
                follow_film(read_picture(path), Ball(bright=bright), shake, counts)
        print(f"real, the camera shakes by {shake} px: {counts}")
    places = taken = 0
    for path in sorted(folder.glob("*/images/*/*")):
        picture, view = read_picture(path), View(path.parent.name, "live")
        for u, v, radius, bright in lattice(picture.shape):
            last = Detected(
                ("live",), np.array([[u, v]], float), np.ones((1, 2)),
                notes={"radius_px": float(radius), "step": 0.6, "blur_px": 1.0},
            )  # fmt: skip
            places += 1
            taken += Ball(bright=bright).detect_near(picture, view, last) is not None
    print(f"real, said to have been there: {taken} taken for it at {places} places")


def follow_film(picture, detector, shake, counts):
    rng, follower, view = np.random.default_rng(3), Follower(detector), View("cam1", "live")
    for _ in range(10):
        moved = np.roll(picture, rng.integers(-shake, shake + 1, 2), axis=(0, 1))
        moved = np.clip(moved + rng.normal(0, 0.01, moved.shape), 0, 1).astype(np.float32)
        whole, near = detector.detect(moved, view), follower.near(moved, view)
        one = follower.found(moved, whole) if near is None else near
        counts["pictures"] += 1
        counts["found whole"] += len(whole)
        counts["found followed"] += len(one)
        counts["of these not in the whole"] += len(one) > 0 and not len(whole)


def lattice(shape):
    """Places, radii, and whether the ball is bright."""
    across, down = range(60, shape[1] - 60, 120), range(60, shape[0] - 60, 120)
    return itertools.product(across, down, (5, 8, 12, 18, 27), (False, True))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("speed", "false"))
    parser.add_argument("--sets", type=int, default=60)
    parser.add_argument("--rigs", type=int, default=4)
    parser.add_argument("--shots", type=int, default=60)
    parser.add_argument("--real", type=Path, default=Path("/work/shared/real"))
    given = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).parent))
    if given.what == "speed":
        speed(given.sets)
    else:
        with one_thread_each():
            false_rendered(given.rigs, given.shots)
            false_real(given.real)
