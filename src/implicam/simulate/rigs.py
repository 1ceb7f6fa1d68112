"""Simulated rigs: the paper's six cameras on a bar, a stereo pair, a dome.

A rig is designed on a bench, in millimetres: the working volume's centre is the origin, x runs along the bar to the
right, y down, z away from the cameras. Then it is moved into a world frame with another origin and orientation.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np

from implicam.dataset import Floats
from implicam.errors import UsageError, did_you_mean
from implicam.geometry import Pose, look_at, rotation_from_vector
from implicam.lenses import BrownConrady, KannalaBrandt, Lens
from implicam.simulate.camera import SimulatedCamera, random_error
from implicam.simulate.window import Window

BAR_FOCAL_MM = (1.55, 2.8, 2.8, 1.85, 2.2, 1.3)
"""The paper's effective focal lengths of cam1 ... cam6."""
BAR_X_MM = (-300.0, -75.0, 75.0, -180.0, 180.0, 300.0)
"""Where cam1 ... cam6 sit on the bar: the two regular lenses in the middle. Our assumption; the paper does not say."""
PIXEL_MM = 0.003
"""Pixel pitch of the bar's cameras. Our assumption; the paper does not say."""
PERSPECTIVE_FROM_PX = 850.0
"""Shorter lenses are wide: Kannala-Brandt, not Brown-Conrady."""

CAMERA_SETS = {
    "2R": ("cam2", "cam3"),
    "2R2W": ("cam2", "cam3", "cam4", "cam5"),
    "2R4W": ("cam1", "cam2", "cam3", "cam4", "cam5", "cam6"),
}
"""The paper's sets of cameras of bar6: two regular, and two or four wide lenses."""

SPECS = ("bar6", "stereo", "dome8")

WATER_BEFORE_VOLUME_MM = 20.0
"""Water between the window and what is nearest to it of the working volume (of a dome: of the ball around it)."""
STEEPEST_TILT_DEG, THICKEST_WINDOW_MM, EXTREME_ASPECT = 30.0, 100.0, 5.0
"""Beyond, the sensor would not see the volume, the glass would reach the cameras, the picture would be a stripe."""
UNITS_PER_MM = {"mm": 1.0, "m": 1e-3}

# Rows: what forward, left and up of a robot's base are on the bench (x right, y down, z away).
_ROBOT_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Box:
    """A box with its centre at the origin of its own frame.

    Attributes:
        world_from_box: Its pose.
        size: (3,) its edges along its axes, in the length unit; z is depth.
    """

    world_from_box: Pose
    size: Floats


@dataclass(frozen=True)
class Unusual:
    """What is unusual about all cameras of a rig, or some of them.

    Attributes:
        tilt: Degrees by which each sensor is turned away from square to the lens's axis, each about a line of its own.
        mirror: Names of the cameras that look into a mirror, or see v counted from below, joined by commas; "all" for a
            left-handed world.
        aspect: fy / fx, the pictures resized in height.
        window: Thickness in mm of a flat pane of acrylic glass with water behind it; 0 for none. Of a bar or a stereo
            pair it is one pane across the bench, of a dome one in front of each camera, square to the line from there
            to the middle.

    Raises:
        UsageError: A number is out of range.
    """

    tilt: float = 0.0
    mirror: str = ""
    aspect: float = 1.0
    window: float = 0.0

    def __post_init__(self) -> None:
        for what, value, low, high, unit in (
            ("tilt", self.tilt, 0.0, STEEPEST_TILT_DEG, " degrees"),
            ("aspect", self.aspect, 1 / EXTREME_ASPECT, EXTREME_ASPECT, ""),
            ("window", self.window, 0.0, THICKEST_WINDOW_MM, " mm"),
        ):
            if not low <= value <= high:
                raise UsageError(
                    f"{what} = {value:g}{unit}; it must be from {low:g} to {high:g}{unit}.",
                    fix={"tilt": "for example 10", "aspect": "for example 1.333", "window": "for example 15"}[what],
                )


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras and the volume they watch, in a world frame.

    Attributes:
        name: As given to `build_rig`.
        cameras: The cameras.
        volume: The working volume.
        length_unit: Of the world.
        frame: "robot" or "random", as given to `build_rig`.
        seed: As given to `build_rig`.
        unusual: What is unusual about the cameras.
    """

    name: str
    cameras: tuple[SimulatedCamera, ...]
    volume: Box
    length_unit: str
    frame: str
    seed: int
    unusual: Unusual = Unusual()

    @property
    def units_per_mm(self) -> float:
        """How many length units of the rig a millimetre is."""
        return UNITS_PER_MM[self.length_unit]


@dataclass(frozen=True)
class _Mount:
    """One camera as designed: image size, focal length in pixels, and its place on the bench in mm."""

    width: int
    height: int
    focal: float
    place: tuple[float, float, float]


def build_rig(
    spec: str,
    *,
    seed: int,
    lens_error: float = 0.5,
    noise: float = 0.2,
    frame: Literal["robot", "random"] = "robot",
    unit: Literal["mm", "m"] = "mm",
    cameras: str | None = None,
    unusual: Unusual = Unusual(),
) -> Rig:
    """A simulated rig; each seed gives slightly different cameras.

    Args:
        spec: "bar6", "stereo", "dome8", or any "bar<N>" or "dome<N>".
        seed: Of everything that differs from the design.
        lens_error: Root mean square in pixels of the smooth error that no lens model contains.
        noise: Standard deviation in pixels of a view.
        frame: "robot" for a world like a robot's base (z up, axes parallel to the bench, origin elsewhere), "random"
            for any rotation and offset.
        unit: Length unit of the world.
        cameras: Names joined by commas, or a set of the paper ("2R", "2R2W", "2R4W"); None for all. The rig itself
            stays the same.
        unusual: Tilted sensors, mirrors, pixels that are not square, a window.

    Raises:
        UsageError: There is no such rig or camera, or an option is out of range.
    """
    _check_options(seed=seed, lens_error=lens_error, noise=noise, frame=frame, unit=unit)
    mounts, size = _design(spec)
    world_from_bench = _world_from_bench(np.random.default_rng([seed, 0]), frame)
    built = tuple(
        _camera(
            f"cam{i + 1}",
            mount,
            np.random.default_rng([seed, 1, i]),
            world_from_bench,
            lens_error,
            noise,
            aspect=unusual.aspect,
        )
        for i, mount in enumerate(mounts)
    )
    rig = Rig(spec, built, Box(world_from_bench, np.array(size)), "mm", frame, seed)
    if unusual != Unusual():
        rig = _unusual(rig, unusual)
    return _in_unit(_with_cameras(rig, cameras), unit)


def write_rig(rig: Rig) -> dict[str, Any]:
    """The truth about a rig as plain tables, for `truth.toml`: lenses, poses, noise, seed.

    Of the smooth error only its size is written: `build_rig` makes the same one again from name, seed, frame and the
    numbers here.

    Args:
        rig: The rig.
    """
    volume = rig.volume
    return {
        "name": rig.name,
        "seed": rig.seed,
        "frame": rig.frame,
        "length_unit": rig.length_unit,
        **{key: value for key, value in asdict(rig.unusual).items() if value != getattr(Unusual, key)},
        "volume": {"size": volume.size.tolist(), "world_from_box": _pose_table(volume.world_from_box)},
        "cameras": [_camera_table(camera) for camera in rig.cameras],
    }


def _camera_table(camera: SimulatedCamera) -> dict[str, Any]:
    return {
        "name": camera.name,
        "width": camera.width,
        "height": camera.height,
        "noise_sd_px": camera.noise_sd,
        "lens": {"model": type(camera.lens).__name__, **asdict(camera.lens)},
        "camera_from_world": _pose_table(camera.camera_from_world),
        "lens_error_rms_px": camera.error.rms,
        **_unusual_table(camera),
    }


def _unusual_table(camera: SimulatedCamera) -> dict[str, Any]:
    """What a camera has beyond lens and pose; nothing where it has nothing."""
    table: dict[str, Any] = {}
    if any(camera.tilt):
        table["tilt_rotation_vector"] = list(camera.tilt)
    if camera.mirrored:
        table["mirrored"] = True
    if camera.window is not None:
        table["window"] = {**asdict(camera.window), "normal": camera.window.normal.tolist()}
    return table


def _pose_table(pose: Pose) -> dict[str, Any]:
    return {"rotation": pose.rotation.tolist(), "translation": pose.translation.tolist()}


def _design(spec: str) -> tuple[list[_Mount], tuple[float, float, float]]:
    """The mounts of a rig, and its working volume (x, y, z) in mm."""
    if spec == "stereo":
        return [_Mount(1280, 1024, 1200.0, (x, 0.0, -700.0)) for x in (-120.0, 120.0)], (300.0, 240.0, 240.0)
    found = re.fullmatch(r"(bar|dome)([1-9][0-9]{0,2})", spec)
    if not found or int(found[2]) < 2:
        raise UsageError(
            f"there is no rig {spec!r}{did_you_mean(spec, SPECS)}.",
            why="a rig is stereo, bar<N> or dome<N>, with N from 2 to 999 cameras",
            fix=f"use one of {', '.join(SPECS)}, or for example dome12",
        )
    n = int(found[2])
    if found[1] == "dome":
        return list(_dome(n)), (400.0, 400.0, 400.0)
    return list(_bar(n)), (240.0, 160.0, 240.0)


def _bar(n: int) -> Iterator[_Mount]:
    places = BAR_X_MM if n == len(BAR_X_MM) else np.linspace(-300, 300, n)
    for i in range(n):
        yield _Mount(1280, 800, BAR_FOCAL_MM[i % len(BAR_FOCAL_MM)] / PIXEL_MM, (float(places[i]), 0.0, -380.0))


def _dome(n: int) -> Iterator[_Mount]:
    """Cameras all round at one metre, in turn low and high above the bench."""
    for i in range(n):
        around, up = 2 * np.pi * i / n, np.radians((25.0, 55.0)[i % 2])
        place = 1000 * np.array([np.sin(around) * np.cos(up), -np.sin(up), -np.cos(around) * np.cos(up)])
        yield _Mount(1280, 1024, 1200.0, (float(place[0]), float(place[1]), float(place[2])))


def _camera(
    name: str,
    mount: _Mount,
    rng: np.random.Generator,
    world_from_bench: Pose,
    lens_error: float,
    noise: float,
    *,
    aspect: float,
) -> SimulatedCamera:
    """A camera as built: nothing is quite where the drawing says."""
    aimed = look_at(mount.place, (0.0, 0.0, 0.0), up=(0.0, -1.0, 0.0))
    turned = Pose(rotation_from_vector(rng.normal(scale=np.radians(1.2), size=3)), np.zeros(3))  # about 2° in all
    moved = Pose(np.eye(3), rng.normal(scale=3.0, size=3))
    camera_from_world = turned @ aimed @ moved @ world_from_bench.inverse()
    lens, height = _random_lens(mount, rng), mount.height
    if aspect != 1:  # the same picture, resized
        lens, height = replace(lens, fy=lens.fy * aspect, cy=(lens.cy + 0.5) * aspect - 0.5), round(height * aspect)
    error = random_error(rng, mount.width, height, lens_error)
    return SimulatedCamera(name, mount.width, height, lens, camera_from_world, error, noise)


def _random_lens(mount: _Mount, rng: np.random.Generator) -> Lens:
    """A lens near its design: focal length 2 %, centre 10 px, distortion within bounds, for it must not fold."""
    fx = mount.focal * (1 + rng.normal(scale=0.02))
    fy = fx * (1 + rng.normal(scale=0.001))
    cx, cy = np.array([mount.width - 1, mount.height - 1]) / 2 + rng.normal(scale=10.0, size=2)
    k = rng.uniform(-1, 1, size=4)
    if mount.focal < PERSPECTIVE_FROM_PX:
        return KannalaBrandt(
            fx, fy, float(cx), float(cy), *(k * [0.02, 0.005, 0.001, 0.0002] - [0.01, 0, 0, 0]).tolist()
        )
    k1, k2, p1, p2 = (k * [0.04, 0.01, 5e-4, 5e-4] + [-0.08, 0.02, 0, 0]).tolist()
    return BrownConrady(fx, fy, float(cx), float(cy), k1, k2, p1, p2)


def _world_from_bench(rng: np.random.Generator, frame: str) -> Pose:
    offset = rng.uniform(200, 600, size=3) * rng.choice([-1, 1], size=3)
    turn = rotation_from_vector(_random_rotation_vector(rng))
    return Pose(_ROBOT_AXES if frame == "robot" else turn, offset)


def _random_rotation_vector(rng: np.random.Generator) -> Floats:
    axis = rng.normal(size=3)
    return axis / np.linalg.norm(axis) * rng.uniform(0.5, np.pi)


def _unusual(rig: Rig, unusual: Unusual) -> Rig:
    """The rig with tilted sensors, mirrors and a window; its cameras stay where they are."""
    mirrored = _camera_names(rig, unusual.mirror) if unusual.mirror not in ("", "all") else []
    cameras = []
    for i, camera in enumerate(rig.cameras):
        around = np.random.default_rng([rig.seed, 2, i]).uniform(0, 2 * np.pi)
        tilt = np.radians(unusual.tilt) * np.array([np.cos(around), np.sin(around)])
        cameras.append(
            replace(
                camera,
                tilt=(float(tilt[0]), float(tilt[1])),
                mirrored=unusual.mirror == "all" or camera.name in mirrored,
                window=_window(rig, camera, unusual.window) if unusual.window > 0 else None,
            )
        )
    return replace(rig, cameras=tuple(cameras), unusual=unusual)


def _window(rig: Rig, camera: SimulatedCamera, thickness: float) -> Window:
    """The pane before a camera, in its frame, in mm."""
    box = rig.volume
    place = box.world_from_box.inverse().apply(camera.camera_from_world.centre)
    if rig.name.startswith("dome"):
        normal, water_side = -place / np.linalg.norm(place), 0.5 * float(np.linalg.norm(box.size))
    else:
        normal, water_side = np.array([0.0, 0.0, 1.0]), 0.5 * float(box.size[2])
    distance = -float(place @ normal) - water_side - WATER_BEFORE_VOLUME_MM - thickness
    camera_from_box = camera.camera_from_world @ box.world_from_box
    return Window(camera_from_box.rotation @ normal, distance, thickness)


def _with_cameras(rig: Rig, wanted: str | None) -> Rig:
    if wanted is None:
        return rig
    known = {camera.name: camera for camera in rig.cameras}
    return replace(rig, cameras=tuple(known[name] for name in _camera_names(rig, wanted)))


def _camera_names(rig: Rig, wanted: str) -> Sequence[str]:
    """The names of a set of cameras, or of a list separated by commas."""
    if wanted in CAMERA_SETS and rig.name != "bar6":
        raise UsageError(f"the set {wanted!r} belongs to bar6, not to {rig.name}.", fix="name the cameras: cam1,cam2")
    known = [camera.name for camera in rig.cameras]
    names: Sequence[str] = CAMERA_SETS.get(wanted) or [name.strip() for name in wanted.split(",")]
    for name in names:
        if name not in known:
            raise UsageError(
                f"rig {rig.name} has no camera {name!r}{did_you_mean(name, [*known, *CAMERA_SETS])}.",
                fix=f"its cameras are {', '.join(known)}",
            )
    return names


def _in_unit(rig: Rig, unit: str) -> Rig:
    """The same rig with another length unit."""
    scale = UNITS_PER_MM[unit]

    def scaled(pose: Pose) -> Pose:
        return Pose(pose.rotation, pose.translation * scale)

    cameras = tuple(
        replace(
            camera,
            camera_from_world=scaled(camera.camera_from_world),
            window=None if camera.window is None else camera.window.scaled(scale),
        )
        for camera in rig.cameras
    )
    volume = Box(scaled(rig.volume.world_from_box), rig.volume.size * scale)
    return replace(rig, cameras=cameras, volume=volume, length_unit=unit)


def _check_options(*, seed: int, lens_error: float, noise: float, frame: str, unit: str) -> None:
    if seed < 0:
        raise UsageError(f"seed = {seed}; it must not be negative.", fix="use 0, 1, 2, ...")
    for what, value in (("lens_error", lens_error), ("noise", noise)):
        if not (np.isfinite(value) and value >= 0):
            raise UsageError(f"{what} = {value} px; it must be zero or more.", fix=f"for example {what} = 0.2")
    for what, word, known in (("frame", frame, ("robot", "random")), ("unit", unit, tuple(UNITS_PER_MM))):
        if word not in known:
            raise UsageError(
                f"there is no {what} {word!r}{did_you_mean(word, known)}.", fix=f"use {' or '.join(known)}"
            )
