"""Stands in for a person who holds a board: follows the outlines in the pictures, moves, trembles, and holds still.

cameras, hand = simulated_hand(build_rig("stereo", seed=1), detector.describe(), seed=2)
hand.follow(corners, pixels); frame = cameras[0].frame()

Such a hand sees what a person would: where the outlines are in the pictures, and not where the cameras really are.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from implicam.dataset.boards import corner_positions
from implicam.detect.dictionaries import dictionary_of
from implicam.detect.prints import Printable, printed
from implicam.detect.registry import detector_of
from implicam.errors import HardwareError
from implicam.geometry import Pose, look_at, rotation_from_vector, vector_from_rotation
from implicam.hardware.protocol import Floats, Frame
from implicam.hardware.simulated import SEED_STEP
from implicam.images import opencv
from implicam.simulate import Optics, Rig, SimulatedCamera, Studio, Target
from implicam.simulate.scene import Print

EXPOSURE_SECONDS = 0.01
"""For which a picture is exposed: a board that moves meanwhile is blurred."""

TREMOR_MM = 0.1
"""Sd of where a board is, along each axis, that a hand holds still."""

MAX_SET_SECONDS = 2.0
"""From the first camera that is asked for a picture to the last: later ones begin another set of pictures."""

FOLLOWING_SHARE, FOLLOWING_DEG = 0.03, 3.0
"""Sds by which a hand misses an outline: of the distance from the camera, and turned."""

SAMPLES_PER_SQUARE = 48
"""Of the picture of markers that is painted onto a board."""

TILTED_STARTS = ((0.0, 0.0), (0.6, 0.0), (-0.6, 0.0), (0.0, 0.6), (0.0, -0.6))
"""About the board's x and y, radians: from where the pose of an outline is looked for."""


class MovingHand:
    """Stands in for a person who holds something in front of cameras, and moves it from place to place.

    Attributes:
        seconds: That it takes from one place to the next; 0 for at once.
        corners: (n, 3) points of what it holds, in that thing's own frame.
        carried: Where that is, if a robot holds it and no hand; None for a hand.
    """

    simulated = True

    def __init__(self, rig: Rig, corners: Floats, first: Pose, *, seed: int, seconds: float = 0.0) -> None:
        self.rig, self.corners, self.seconds = rig, corners, seconds
        self._rng = np.random.default_rng([seed, 31])
        self._from = self._to = first
        self._begun = -np.inf
        self.carried: Callable[[], Pose] | None = None
        self._lock = threading.Lock()
        self._held = (first, first)  # in the set of pictures that is being taken
        self._set_begun = -np.inf
        self._in_set: set[int] = set(range(len(rig.cameras)))  # the cameras that have been asked for theirs

    def shown(self, pose: Pose) -> Target:
        """What cameras look at when it is at a pose.

        Args:
            pose: world_from_board, or world_from_wand.
        """
        raise NotImplementedError

    def _go_to(self, pose: Pose) -> None:
        """Begin to move there."""
        with self._lock:
            self._from, self._begun = self._carried(time.monotonic()), time.monotonic()
            self._to = pose

    @property
    def _middle(self) -> Floats:
        return np.asarray((self.corners.min(axis=0) + self.corners.max(axis=0)) / 2, dtype=np.float64)

    def pose(self, when: float | None = None) -> Pose:
        """world_from_board on its way, without the tremor.

        Args:
            when: As of time.monotonic(); None for now.
        """
        return self._carried(time.monotonic() if when is None else when)

    def _carried(self, when: float) -> Pose:
        """On its way from one place to the next."""
        if self.carried is not None:
            return self.carried()
        passed = when - self._begun
        part = 1.0 if self.seconds <= 0 else float(np.clip(passed / self.seconds, 0, 1))
        part = part * part * (3 - 2 * part)
        turn = vector_from_rotation(self._to.rotation @ self._from.rotation.T)
        rotation = rotation_from_vector(part * turn) @ self._from.rotation
        here, there = self._from.apply(self._middle), self._to.apply(self._middle)
        middle = here + part * (there - here)
        return Pose(rotation, middle - rotation @ self._middle)

    def held(self, camera: int) -> tuple[Pose, Pose]:
        """Where the board is when a picture begins, and when it ends: one instant for one set of pictures, as if all
        cameras were exposed together, however long this computer takes from one to the next.

        Args:
            camera: That takes the picture; one that has its picture of the set begins another.
        """
        with self._lock:
            now = time.monotonic()
            whole = len(self._in_set) == len(self.rig.cameras)
            if whole or camera in self._in_set or now - self._set_begun > MAX_SET_SECONDS:
                self._begin_set()
                shakes = self.seconds > 0 and self.carried is None
                shake = TREMOR_MM * self.rig.units_per_mm if shakes else 0.0
                tremor = shake * self._rng.normal(size=3)
                self._held = tuple(  # type: ignore[assignment]
                    Pose(pose.rotation, pose.translation + tremor)
                    for pose in (self.pose(now), self.pose(now + EXPOSURE_SECONDS))
                )
                self._set_begun, self._in_set = now, set()
            self._in_set.add(camera)
            return self._held

    def _begin_set(self) -> None:
        """Another set of pictures begins: a board is held still for it."""


class SimulatedHand(MovingHand):
    """Stands in for a person with a board: `seconds` from one outline to the next."""

    def __init__(self, rig: Rig, target: Mapping[str, Any], *, seed: int, seconds: float = 0.0) -> None:
        self.target, self.marks = dict(target), print_of(target)
        flat = corner_positions(target)
        self.corners = np.column_stack([flat, np.zeros(len(flat))])
        first = _facing(rig.cameras[0], self._middle, np.array([0.5, 0.5]), 0.5, self._diagonal, (0.3, 0.2))
        super().__init__(rig, self.corners, first, seed=seed, seconds=seconds)

    @property
    def _diagonal(self) -> float:
        return float(np.linalg.norm(np.ptp(self.corners, axis=0)))

    def follow(self, corners: Floats, pixels: Floats) -> None:
        """Begin to move to where the corners are seen at these pixels, as well as a hand can.

        Args:
            corners: (n, 3) on the board.
            pixels: (cameras, n, 2) where they are to be seen; NaN where nothing is asked for.
        """
        goal = match_pose(self.rig, corners, pixels)
        if goal is None:
            return
        eye = self.rig.cameras[int(np.argmax(np.isfinite(pixels[..., 0]).sum(axis=1)))].camera_from_world.centre
        far = float(np.linalg.norm(goal.apply(self._middle) - eye))
        turn = rotation_from_vector(np.radians(FOLLOWING_DEG) * self._rng.normal(size=3)) @ goal.rotation
        shift = FOLLOWING_SHARE * far * self._rng.normal(size=3) / np.sqrt(3)
        middle = goal.apply(self._middle) + shift
        self._go_to(Pose(turn, middle - turn @ self._middle))

    def put(self, pose: Pose) -> None:
        """Begin to move to a known pose, as into a slot: exactly.

        Args:
            pose: world_from_board.
        """
        self._go_to(pose)

    def shown(self, pose: Pose) -> Target:
        """What cameras look at when it is at a pose.

        Args:
            pose: world_from_board.
        """
        return board_target(self.target, pose, self.marks)


class HandCamera:
    """Stands in for a camera: photographs what a hand holds through a simulated lens.

    fail_for: the next n calls of `frame` fail, as if it were unplugged. hand: that holds the board or the wand.
    """

    live = simulated = True

    def __init__(self, studio: Studio, camera: int, hand: MovingHand) -> None:
        self.name = studio.rig.cameras[camera].name
        self._studio, self._camera, self.hand = studio, camera, hand
        self._fails = self._number = 0

    def fail_for(self, n: int) -> None:
        """Let the next calls of `frame` raise HardwareError.

        Args:
            n: The number of calls.
        """
        self._fails = n

    def open(self) -> None:
        """Nothing to connect."""

    def frame(self, timeout: float = 5.0) -> Frame:
        """A photograph of the target as it is held now.

        Args:
            timeout: Not used: the picture is there at once.

        Raises:
            HardwareError: The camera was told to fail.
        """
        first, last = self.hand.held(self._camera)  # one that fails has had its turn, too
        if self._fails > 0:
            self._fails -= 1
            raise HardwareError(
                f"camera {self.name} is gone.", why="it was told to fail (simulated)", fix="take the picture again"
            )
        self._number += 1
        taken = time.time()
        picture = self._photograph(first)
        if np.abs(self._pixels(first) - self._pixels(last)).max(initial=0.0) > 0.3:
            middle = Pose(first.rotation, (first.translation + last.translation) / 2)
            picture = (picture + self._photograph(middle) + self._photograph(last)) / np.float32(3)
        return Frame(np.asarray(picture, dtype=np.float32), self._number, taken)

    def close(self) -> None:
        """Nothing to release."""

    def _photograph(self, pose: Pose) -> Any:
        shown = self.hand.shown(pose)
        return self._studio.showing(shown, seed=self._studio.seed + SEED_STEP * self._number).picture(self._camera, 0)

    def _pixels(self, pose: Pose) -> Floats:
        uv, _ = self._studio.rig.cameras[self._camera].pixel_from_world(pose.apply(self.hand.corners[[0, -1]]))
        return uv[np.isfinite(uv).all(axis=1)] if np.isfinite(uv).all() else np.zeros((0, 2))


def print_of(target: Mapping[str, Any]) -> NDArray[np.float32] | Print | None:
    """What is printed on a board, beside the squares of a checkerboard.

    Args:
        target: The table [target] of dataset.toml.

    Returns:
        In the white squares of a ChArUco board, as `scene.Checkerboard` takes it; of another board all of it; None for
        a plain checkerboard.

    Raises:
        UsageError: Nothing is known of how such a target is printed.
    """
    kind = target.get("kind")
    if kind == "board":
        return None
    if kind == "charuco" and not (target.get("legacy") and int(target["rows"]) % 2 == 0):
        return _markers_of(target)
    detector = detector_of(target)
    assert isinstance(detector, Printable)  # as all boards are
    shown = printed(detector)
    samples = SAMPLES_PER_SQUARE / float(next(target[name] for name in ("square", "tag", "spacing") if name in target))
    black = shown.picture(samples)
    return Print(black, -shown.origin - shown.white, np.array(black.shape[::-1]) / samples)  # whole samples


def _markers_of(target: Mapping[str, Any]) -> NDArray[np.float32]:
    aruco = opencv().aruco
    rows, columns, size = int(target["rows"]), int(target["columns"]), SAMPLES_PER_SQUARE
    dictionary = dictionary_of(str(target["dictionary"]))
    board = aruco.CharucoBoard((columns, rows), float(target["square"]), float(target["marker"]), dictionary)
    board.setLegacyPattern(bool(target.get("legacy", False)))
    drawn = board.generateImage((columns * size, rows * size), marginSize=0)
    squares = np.indices(drawn.shape) // size
    marks = np.where(squares.sum(axis=0) % 2, 1 - drawn.astype(np.float32) / 255, 0)
    return np.asarray(marks, dtype=np.float32)


def board_target(target: Mapping[str, Any], pose: Pose, marks: NDArray[np.float32] | Print | None = None) -> Target:
    """A board at a pose, as simulated cameras look at it.

    Args:
        target: The table [target] of dataset.toml.
        pose: world_from_board.
        marks: Of `print_of`; None where nobody takes a picture of it.
    """
    shot = "held"
    flat = corner_positions(target)
    names = np.array([f"{shot}-c{i + 1:03d}" for i in range(len(flat))])
    shots = np.full(len(flat), shot)
    xyz = pose.apply(np.column_stack([flat, np.zeros(len(flat))]))
    facing = np.asarray(-pose.rotation[:, 2], dtype=np.float64)
    if isinstance(marks, Print):
        return Target("boards", names, shots, xyz, facing, sheet=(pose, marks))
    rows, columns = int(target["rows"]), int(target["columns"])
    if target["kind"] == "charuco":
        rows, columns = rows - 1, columns - 1
    return Target("boards", names, shots, xyz, facing, (rows, columns), marks=marks)


def match_pose(rig: Rig, corners: Floats, pixels: Floats) -> Pose | None:
    """Where a board is whose corners are seen at given pixels.

    Args:
        rig: The cameras as they are.
        corners: (n, 3) on the board.
        pixels: (cameras, n, 2); NaN where nothing is asked for.

    Returns:
        world_from_board; None where fewer than four corners are asked for.
    """
    asked = np.asarray(np.isfinite(pixels).all(axis=2), dtype=np.bool_)
    best = int(np.argmax(asked.sum(axis=1)))
    if asked[best].sum() < 4:
        return None
    camera = rig.cameras[best]
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    diagonal = float(np.linalg.norm(np.ptp(corners, axis=0)))
    size = np.array([camera.width, camera.height])
    uv = pixels[best][asked[best]]
    place = np.clip(uv.mean(axis=0) / size, 0.02, 0.98)
    span = float(np.clip(np.linalg.norm(np.ptp(uv, axis=0)) / camera.width, 0.1, 2.0))

    def pose_of(step: Floats, start: Pose) -> Pose:
        turned = rotation_from_vector(step[:3]) @ start.rotation
        return Pose(turned, start.apply(middle) + diagonal * step[3:] - turned @ middle)

    def off(step: Floats, start: Pose) -> Floats:
        xyz = pose_of(step, start).apply(corners)
        parts = [
            np.nan_to_num(each.pixel_from_world(xyz[seen])[0] - want[seen], nan=1e3).ravel()
            for each, want, seen in zip(rig.cameras, pixels, asked, strict=True)
            if seen.any()
        ]
        return np.concatenate(parts)

    found: list[tuple[float, Pose]] = []
    for roll in (0.0, np.pi / 2):
        for tilt in TILTED_STARTS:
            start = _facing(camera, middle, place, span, diagonal, tilt, roll)
            end = least_squares(off, np.zeros(6), args=(start,), max_nfev=30)
            found.append((float(end.cost), pose_of(end.x, start)))
            if end.cost < 4.0 * len(end.fun):
                break
    return min(found, key=lambda one: one[0])[1]


def _facing(
    camera: SimulatedCamera, middle: Floats, place: Floats, span: float, diagonal: float,
    tilt: tuple[float, float], roll: float = 0.0,
) -> Pose:  # fmt: skip
    """A board in front of a camera."""
    rays, _ = camera.ray_from_pixel((place * [camera.width - 1, camera.height - 1])[None])
    pose = camera.camera_from_world
    at = pose.centre + camera.lens.fx * diagonal / (span * camera.width) * (rays[0] @ pose.rotation)
    frame = look_at(pose.centre, at, -pose.rotation[1]).rotation.T
    frame = frame @ rotation_from_vector([0.0, 0.0, roll]) @ rotation_from_vector([*tilt, 0.0])
    return Pose(frame, at - frame @ middle)


def simulated_hand(
    rig: Rig, target: Mapping[str, Any], *, seed: int, seconds: float = 0.0, optics: Optics | None = None
) -> tuple[list[HandCamera], SimulatedHand]:
    """Cameras, and a hand that holds a board in front of them.

    Args:
        rig: The simulated rig.
        target: The table [target] of dataset.toml, lengths in the rig's unit.
        seed: Of the noise of the pictures, and of the hand.
        seconds: That the hand takes from one outline to the next.
        optics: How the cameras take pictures; None for the usual.

    Returns:
        One camera for each of the rig's, in their order, and the hand.

    Raises:
        UsageError: There is no picture of such a board.
    """
    hand = SimulatedHand(rig, target, seed=seed, seconds=seconds)
    shown = board_target(target, hand.pose(), hand.marks)
    studio = Studio(rig, shown, optics or Optics(), seed).showing(shown, seed=seed)
    return [HandCamera(studio, c, hand) for c in range(len(rig.cameras))], hand
