"""Simulated rigs: a placement as it would be built, each camera and lens a little different from the drawing.

A rig is built on the bench of its drawing (`placements`, `rig_file`), in millimetres. Then it is moved into a world
frame with another origin and orientation; a rig drawn in a file stays in the frame of the file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from implicam.dataset import Floats
from implicam.errors import UsageError, did_you_mean
from implicam.geometry import Pose, rotation_from_vector
from implicam.lenses import BrownConrady, KannalaBrandt, Lens
from implicam.simulate.camera import SimulatedCamera, random_error
from implicam.simulate.placements import Mount, Placement, named_placement
from implicam.simulate.rig_file import is_rig_file, read_placement
from implicam.simulate.window import Window

CAMERA_SETS = {
    "2R": ("cam2", "cam3"),
    "2R2W": ("cam2", "cam3", "cam4", "cam5"),
    "2R4W": ("cam1", "cam2", "cam3", "cam4", "cam5", "cam6"),
}
"""The paper's sets of cameras of bar6: two regular, and two or four wide lenses."""

WATER_BEFORE_VOLUME_MM = 20.0
"""Water between the window and what is nearest to it of the working volume (of a dome: of the ball around it)."""
STEEPEST_TILT_DEG, THICKEST_WINDOW_MM, EXTREME_ASPECT = 30.0, 100.0, 5.0
"""Beyond, the sensor would not see the volume, the glass would reach the cameras, the picture would be a stripe."""
UNITS_PER_MM = {"mm": 1.0, "m": 1e-3}

FOCAL_SPREAD_RATIO, ASPECT_SPREAD_RATIO, CENTRE_SPREAD_PX = 0.02, 0.001, 10.0
"""Sds of a lens as built about the one that was drawn."""
AIM_SPREAD_DEG, PLACE_SPREAD_MM = 1.2, 3.0
"""Sds about and along each axis of a camera as mounted: about 2 degrees in all."""
DISTORTION_SPREAD = {
    KannalaBrandt.family: (0.02, 0.005, 0.001, 0.0002),
    BrownConrady.family: (0.04, 0.01, 5e-4, 5e-4),
}
"""Farthest from those drawn that the first four numbers of a distortion are; bounds, for a lens must not fold."""

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
        window: Thickness in mm of a flat pane of acrylic glass with water behind it; 0 for none. Of a bar, a grid or
            a stereo pair it is one pane across the bench, of a dome or a drawing in a file one in front of each camera,
            square to the line from there to the middle.

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


def placement_of(spec: str) -> Placement:
    """The placement of a rig, by its name or from a file.

    Args:
        spec: A name ("bar6", "grid9", "dome8", "stereo"), or the path of a file that ends in .toml.

    Raises:
        UsageError: There is no such rig, or its file is wrong.
    """
    return read_placement(Path(spec)) if is_rig_file(spec) else named_placement(spec)


def build_rig(
    spec: str | Placement,
    *,
    seed: int,
    lens_error: float = 0.5,
    noise: float = 0.2,
    frame: Literal["robot", "random", "bench"] | None = None,
    unit: Literal["mm", "m"] | None = None,
    cameras: str | None = None,
    unusual: Unusual = Unusual(),
    as_drawn: bool = False,
) -> Rig:
    """A simulated rig; each seed gives slightly different cameras.

    Args:
        spec: "bar6", "grid9", "stereo", "dome8", any other "bar<N>", "grid<N>", "grid<COLUMNS>x<ROWS>" or "dome<N>"; a
            set of the paper ("2R", "2R2W", "2R4W"); a file RIG.toml; or a placement.
        seed: Of everything that differs from the drawing.
        lens_error: Root mean square in pixels of the smooth error that no lens model contains.
        noise: Standard deviation in pixels of a view, where the drawing has none.
        frame: "robot": a world like a robot's base (z up, axes parallel to the bench, origin elsewhere); "random": any
            rotation and offset; "bench": that of the drawing. None for the last where the drawing is a file, else the
            first.
        unit: Of the world; None for the drawing's own, which is mm for rigs with names.
        cameras: Names joined by commas, or a set of the paper; the rig itself stays the same.
        unusual: Tilted sensors, mirrors, pixels that are not square, a window.
        as_drawn: Poses and lenses exactly as drawn; only the smooth error is left to the seed.

    Raises:
        UsageError: There is no such rig or camera, or an option is out of range.
    """
    if isinstance(spec, str) and spec in CAMERA_SETS and cameras is None:
        spec, cameras = "bar6", spec
    placement = placement_of(spec) if isinstance(spec, str) else spec
    world, length_unit = _world_of(placement, frame, unit)
    _check_options(seed=seed, lens_error=lens_error, noise=noise, frame=world, unit=length_unit)
    if placement.size is None:
        raise UsageError(
            f"{placement.name} does not say what its cameras watch.",
            fix="add to its file, for example, workspace = [[-120, 120], [-80, 80], [0, 240]]",
        )
    world_from_bench = _world_from_bench(np.random.default_rng([seed, 0]), world)
    spread = 0.0 if as_drawn else placement.spread
    built = tuple(
        _camera(
            mount,
            np.random.default_rng([seed, 1, i]),
            world_from_bench,
            lens_error,
            noise if mount.noise is None else mount.noise,
            aspect=unusual.aspect,
            spread=spread,
        )
        for i, mount in enumerate(placement.mounts)
    )
    volume = Box(world_from_bench @ Pose(np.eye(3), placement.centre), placement.size)
    rig = Rig(placement.name, built, volume, "mm", world, seed)
    if unusual != Unusual():
        rig = _unusual(rig, unusual, own_panes=placement.own_panes)
    return _in_unit(_with_cameras(rig, cameras), length_unit)


def _world_of(placement: Placement, frame: str | None, unit: str | None) -> tuple[str, str]:
    """Frame and unit of the world, where nothing was asked for those of the drawing."""
    usual = "bench" if placement.drawn else "robot"
    return usual if frame is None else frame, placement.length_unit if unit is None else unit


def _camera(
    mount: Mount,
    rng: np.random.Generator,
    world_from_bench: Pose,
    lens_error: float,
    noise: float,
    *,
    aspect: float,
    spread: float,
) -> SimulatedCamera:
    """A camera as built: nothing is quite where the drawing says."""
    aim = rng.normal(scale=np.radians(AIM_SPREAD_DEG) * spread, size=3)
    turned = Pose(rotation_from_vector(aim), np.zeros(3))
    moved = Pose(np.eye(3), rng.normal(scale=PLACE_SPREAD_MM * spread, size=3))
    camera_from_world = turned @ mount.camera_from_bench @ moved @ world_from_bench.inverse()
    lens, height = _random_lens(mount.lens, rng, spread), mount.height
    if aspect != 1:  # the same picture, resized
        lens, height = _resized(lens, aspect), round(height * aspect)
    error = random_error(rng, mount.width, height, lens_error)
    return SimulatedCamera(mount.name, mount.width, height, lens, camera_from_world, error, noise)


def _random_lens(drawn: Lens, rng: np.random.Generator, spread: float) -> Lens:
    """A lens near its design: focal length, centre, and distortion within bounds, for it must not fold."""
    fx = drawn.fx * (1 + rng.normal(scale=FOCAL_SPREAD_RATIO * spread))
    fy = fx * (drawn.fy / drawn.fx) * (1 + rng.normal(scale=ASPECT_SPREAD_RATIO * spread))
    cx, cy = np.array([drawn.cx, drawn.cy]) + rng.normal(scale=CENTRE_SPREAD_PX * spread, size=2)
    distortion = np.array(astuple(drawn)[4:])
    k = rng.uniform(-1, 1, size=4)
    bounds = DISTORTION_SPREAD.get(drawn.family)
    if bounds is not None:
        distortion[:4] = k * bounds * spread + distortion[:4]
    return type(drawn)(fx, fy, float(cx), float(cy), *distortion.tolist())


def _resized(lens: Lens, aspect: float) -> Lens:
    """The lens of pictures that are resized in height."""
    fx, fy, cx, cy, *distortion = astuple(lens)
    return type(lens)(fx, fy * aspect, cx, (cy + 0.5) * aspect - 0.5, *distortion)


def _world_from_bench(rng: np.random.Generator, frame: str) -> Pose:
    offset = rng.uniform(200, 600, size=3) * rng.choice([-1, 1], size=3)
    turn = rotation_from_vector(_random_rotation_vector(rng))
    if frame == "bench":
        return Pose(np.eye(3), np.zeros(3))
    return Pose(_ROBOT_AXES if frame == "robot" else turn, offset)


def _random_rotation_vector(rng: np.random.Generator) -> Floats:
    axis = rng.normal(size=3)
    return axis / np.linalg.norm(axis) * rng.uniform(0.5, np.pi)


def _unusual(rig: Rig, unusual: Unusual, *, own_panes: bool) -> Rig:
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
                window=_window(rig, camera, unusual.window, own_panes) if unusual.window > 0 else None,
            )
        )
    return replace(rig, cameras=tuple(cameras), unusual=unusual)


def _window(rig: Rig, camera: SimulatedCamera, thickness: float, own: bool) -> Window:
    """The pane before a camera, in its frame, in mm."""
    box = rig.volume
    place = box.world_from_box.inverse().apply(camera.camera_from_world.centre)
    if own:
        normal, water_side = -place / np.linalg.norm(place), 0.5 * float(np.linalg.norm(box.size))
    else:
        normal, water_side = np.array([0.0, 0.0, 1.0]), 0.5 * float(box.size[2])
    distance = -float(place @ normal) - water_side - WATER_BEFORE_VOLUME_MM - thickness
    if distance <= 0:
        raise UsageError(
            f"{camera.name} would be behind the window or in the water.",
            why=f"the glass ends {WATER_BEFORE_VOLUME_MM:g} mm before the working volume",
            fix="move the camera back, or make the working volume smaller",
        )
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
    for what, word, known in (("frame", frame, ("robot", "random", "bench")), ("unit", unit, tuple(UNITS_PER_MM))):
        if word not in known:
            raise UsageError(
                f"there is no {what} {word!r}{did_you_mean(word, known)}.", fix=f"use {' or '.join(known)}"
            )
