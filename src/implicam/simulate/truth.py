"""The truth about a simulated rig as plain tables, for `truth.toml`."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from implicam.geometry import Pose
from implicam.simulate.camera import SimulatedCamera
from implicam.simulate.rigs import Rig, Unusual


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
