"""The truth about a simulated rig as plain tables, for `truth.toml`, and the rig that such a file tells of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from implicam.dataset import Dataset
from implicam.dataset.folder import TRUTH
from implicam.dataset.tables import parse_toml
from implicam.errors import ImplicamError
from implicam.geometry import Pose
from implicam.simulate.camera import SimulatedCamera
from implicam.simulate.noise import with_limit
from implicam.simulate.rigs import Rig, Unusual, build_rig


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


def read_rig(path: Path) -> Rig | None:
    """Build the rig again that `truth.toml` tells of.

    Args:
        path: The file.

    Returns:
        The rig; None where there is no such file, or where the rig cannot be built from it: one that was drawn in a
        file of its own, or by another version of implicam.
    """
    try:
        table = parse_toml(path.read_text(encoding="utf-8"))
        first = table["cameras"][0]
        rig = build_rig(
            str(table["name"]),
            seed=int(table["seed"]),
            lens_error=float(first["lens_error_rms_px"]),
            noise=float(first["noise_sd_px"]),
            frame=table["frame"],
            unit=table["length_unit"],
            cameras=",".join(str(camera["name"]) for camera in table["cameras"]),
            unusual=Unusual(**{one.name: table[one.name] for one in fields(Unusual) if one.name in table}),
        )
    except (OSError, ImplicamError, LookupError, TypeError, ValueError, AttributeError):
        return None
    told = zip(write_rig(rig)["cameras"], table["cameras"], strict=False)
    return rig if all(_same_camera(one, other) for one, other in told) else None


def _same_camera(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether name, lens and pose are those of the other, to the last digits."""

    def numbers(camera: Mapping[str, Any]) -> list[float]:
        lens = [value for value in camera["lens"].values() if not isinstance(value, str)]
        pose = camera["camera_from_world"]
        return [float(x) for x in (*lens, *np.ravel(pose["rotation"]), *pose["translation"])]

    try:
        here, there = numbers(one), numbers(other)
    except (LookupError, TypeError, ValueError, AttributeError):
        return False
    return one["name"] == other.get("name") and len(here) == len(there) and np.allclose(here, there, rtol=1e-9)


def limit_of_detection(folder: Path, data: Dataset) -> tuple[Dataset, str]:
    """Give a simulated dataset whose views were detected the Cramer-Rao limit of these views.

    What the simulation wrote is the limit of the pixel noise that it was told, which detection does not have.

    Args:
        folder: The dataset's, beside or below `truth.toml`.
        data: With the views that were detected.

    Returns:
        The dataset, its limit unknown where the rig cannot be built again; and what there is to say, empty where
        nothing is: it is no simulation.
    """
    if data.truth is None:
        return data, ""
    beside = folder.resolve() / TRUTH
    rig = read_rig(beside if beside.exists() else folder.resolve().parent / TRUTH)
    if rig is None or {camera.name for camera in rig.cameras} != {camera.name for camera in data.cameras}:
        why = f"the simulated rig cannot be built again from {TRUTH}"
        return data.without_limit(), f"the Cramer-Rao limit of the simulation is taken out of points.csv: {why}."
    data = with_limit(rig, data)
    return data, "points.csv now has the Cramer-Rao limit of the views as detected, instead of those as simulated."


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
