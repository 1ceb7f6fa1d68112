"""A placement from a file, RIG.toml: where cameras stand and look, what lenses they have. docs/design.md has one.

Nothing in it is trusted: each value is checked; a mistake is an error that names the camera, the value and the cure.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from implicam.dataset import Camera, Floats
from implicam.dataset.tables import read_toml
from implicam.errors import DatasetError, UsageError, did_you_mean
from implicam.geometry import Pose, look_at, rotation_from_vector
from implicam.lenses import LENSES, Lens
from implicam.simulate.placements import MAX_CAMERAS, PERSPECTIVE_FROM_PX, Mount, Placement

SUFFIX = ".toml"
MM_PER_UNIT = {"mm": 1.0, "m": 1e3}
MAX_RIG_FILE_BYTES, MAX_RIG_NAME_CHARACTERS = 1 << 20, 100
MAX_LENGTH_MM, MIN_LENGTH_MM = 1e7, 1e-3
"""A rig is smaller than ten kilometres, and a workspace thicker than a micrometre."""
MAX_IMAGE_SIDE_PX, MIN_IMAGE_SIDE_PX = 100_000, 16
MAX_FOCAL_PX = 1e7
MAX_NOISE_PX, MAX_SPREAD = 100.0, 5.0
ROTATION_TOLERANCE = 1e-3
"""Of a rotation matrix times its transpose: what is written with four digits is still one."""

_RIG_KEYS = ("name", "length_unit", "workspace", "spread", "every_camera", "cameras")
_POSE_KEYS = ("position", "look_at", "up", "rotation", "rotation_vector")
_LENS_KEYS = ("size", "lens", "focal_px", "focal_mm", "pixel_um", "fov_deg", "distortion", "noise")
_AIMS, _FOCALS = ("look_at", "rotation", "rotation_vector"), ("focal_px", "focal_mm", "fov_deg")


def is_rig_file(spec: str) -> bool:
    """Whether a rig is named as a file is.

    Args:
        spec: As of `build_rig`.
    """
    return spec.lower().endswith(SUFFIX)


def read_placement(path: Path) -> Placement:
    """Read a placement from a file.

    Args:
        path: Of the TOML file.

    Raises:
        UsageError: Whatever is wrong with it, with the camera, the value and the cure.
    """
    table = _read(path)
    _refuse_others(table, _RIG_KEYS, str(path))
    unit = table.get("length_unit", "mm")
    if unit not in MM_PER_UNIT:
        raise UsageError(f"{path}: length_unit = {_shown(unit)} is not known.", fix='write "mm" or "m"')
    name = table.get("name", path.stem)
    if not isinstance(name, str) or not 0 < len(name.strip()) <= MAX_RIG_NAME_CHARACTERS or not name.isprintable():
        raise UsageError(f"{path}: name = {_shown(name)} must be a short text.", fix='write name = "my-rig"')
    cameras, shared = table.get("cameras"), table.get("every_camera", {})
    if not isinstance(shared, Mapping):
        raise UsageError(f"{path}: every_camera = {_shown(shared)} is no table.", fix="write [every_camera]")
    if not isinstance(cameras, list) or not all(isinstance(camera, Mapping) for camera in cameras):
        raise UsageError(
            f"{path}: there is no [[cameras]] table.", fix="add for each camera [[cameras]], with position and look_at"
        )
    if not 2 <= len(cameras) <= MAX_CAMERAS:
        raise UsageError(
            f"{path}: a rig has 2 to {MAX_CAMERAS} cameras, and this one has {len(cameras)}.",
            fix="write [[cameras]] for each",
        )
    mounts = tuple(
        _Camera(_joined(shared, camera), f"{path}: camera {_name_of(camera, i)}", MM_PER_UNIT[unit]).mount(
            f"cam{i + 1}"
        )
        for i, camera in enumerate(cameras)
    )
    names = [mount.name for mount in mounts]
    for twice in {name for name in names if names.count(name) > 1}:
        raise UsageError(f"{path}: two cameras are called {twice!r}.", fix="give each a name of its own")
    size, centre = _workspace(table.get("workspace"), path, MM_PER_UNIT[unit])
    spread = _Reader(table, str(path)).number("spread", 0.0, MAX_SPREAD, 1.0)
    assert spread is not None
    return Placement(name.strip(), mounts, size, centre, spread, unit, own_panes=True, drawn=True)


def _read(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise UsageError(
            f"there is no file {path}." if not path.exists() else f"{path} is no file.",
            fix="name a rig (bar6, grid9, dome8, stereo), or write its drawing: docs/design.md has one to copy",
        )
    size = path.stat().st_size
    if size > MAX_RIG_FILE_BYTES:
        raise UsageError(f"{path} is {size:,} bytes long; this is no drawing of a rig.", fix="see docs/design.md")
    try:
        return read_toml(path)
    except DatasetError as error:
        raise UsageError(error.what, why=error.why, fix=error.fix) from error


def _workspace(value: Any, path: Path, mm: float) -> tuple[Floats | None, Floats]:
    """Size and centre (3,) in mm of the box that the cameras watch."""
    if value is None:
        return None, np.zeros(3)
    ends = _numbers(value, (3, 2))
    if ends is None or not (np.abs(ends) * mm <= MAX_LENGTH_MM).all():
        raise UsageError(
            f"{path}: workspace = {_shown(value)} is no box.",
            fix="write the ends of x, y and z: workspace = [[-120, 120], [-80, 80], [0, 240]]",
        )
    low, high = mm * ends.T
    if not (high - low >= MIN_LENGTH_MM).all():
        raise UsageError(f"{path}: workspace = {_shown(value)} is empty.", fix="write the lower end of each axis first")
    return high - low, (low + high) / 2


class _Reader:
    """Values of a table, each checked; where: the file and the camera, for errors."""

    def __init__(self, table: Mapping[str, Any], where: str) -> None:
        self.table, self.where = table, where

    def number(self, key: str, low: float, high: float, default: float | None = None) -> float | None:
        """A finite number within bounds."""
        if key not in self.table:
            return default
        value = _numbers(self.table[key], ())
        if value is None or not low <= value <= high:
            raise self.error(key, f"must be a number from {low:g} to {high:g}", "correct it")
        return float(value)

    def vector(self, key: str, limit: float) -> Floats | None:
        """(3,) finite numbers; None where there is no such key."""
        if key not in self.table:
            return None
        value = _numbers(self.table[key], (3,))
        if value is None or not (np.abs(value) <= limit).all():
            raise self.error(key, "must be three numbers", f"for example {key} = [0.0, 0.0, 1.0]")
        return value

    def error(self, key: str, problem: str, fix: str) -> UsageError:
        """The error for a value."""
        return UsageError(f"{self.where}: {key} = {_shown(self.table.get(key))} {problem}.", fix=fix)


class _Camera(_Reader):
    """One [[cameras]] table, with what all cameras share; mm: millimetres of a length unit."""

    def __init__(self, table: Mapping[str, Any], where: str, mm: float) -> None:
        super().__init__(table, where)
        self.mm = mm
        _refuse_others(table, ("name", *_POSE_KEYS, *_LENS_KEYS), where)

    def mount(self, usual_name: str) -> Mount:
        """The camera as drawn."""
        name = self.table.get("name", usual_name)
        if not isinstance(name, str) or not name.strip() or not name.isprintable() or "," in name:
            raise self.error("name", "must be text without commas", f'write name = "{usual_name}"')
        width, height = self._size()
        try:
            Camera(name.strip(), width, height)  # data that the rig records must be able to name it
        except DatasetError as error:
            raise UsageError(f"{self.where}: {error.what}", why=error.why, fix=error.fix) from error
        return Mount(
            name.strip(), width, height, self._lens(width, height), self._pose(), self.number("noise", 0, MAX_NOISE_PX)
        )

    def _size(self) -> tuple[int, int]:
        size = _numbers(self.table.get("size"), (2,))
        if (
            size is None
            or not ((size >= MIN_IMAGE_SIDE_PX) & (size <= MAX_IMAGE_SIDE_PX)).all()
            or (size != np.round(size)).any()
        ):
            problem = f"must be width and height, whole pixels from {MIN_IMAGE_SIDE_PX} to {MAX_IMAGE_SIDE_PX}"
            raise self.error("size", problem, "for example size = [1280, 800]; [every_camera] holds for all")
        return int(size[0]), int(size[1])

    def _pose(self) -> Pose:
        position = self.vector("position", MAX_LENGTH_MM / self.mm)
        if position is None:
            raise UsageError(f"{self.where} has no position.", fix="write position = [x, y, z]")
        position = position * self.mm
        aim = self._one_of(_AIMS, "where it looks")
        if aim == "look_at":
            target = self.vector("look_at", MAX_LENGTH_MM / self.mm)
            assert target is not None
            if np.linalg.norm(target * self.mm - position) < MIN_LENGTH_MM:
                raise self.error("look_at", "is where the camera stands", "name a place before it")
            up = self.vector("up", MAX_LENGTH_MM)
            up = np.array([0.0, 0.0, 1.0]) if up is None else up
            if not np.linalg.norm(up) > 0:
                raise self.error("up", "has no direction", "for example up = [0, 0, 1]")
            return look_at(position, target * self.mm, up / np.linalg.norm(up))
        if "up" in self.table:
            raise UsageError(f"{self.where}: up goes with look_at, not with {aim}.", fix="leave up out")
        rotation = self._rotation(aim)
        return Pose(rotation, -rotation @ position)

    def _rotation(self, key: str) -> Floats:
        """(3, 3) camera_from_world."""
        if key == "rotation_vector":
            vector = self.vector(key, 1e3)
            assert vector is not None
            return rotation_from_vector(vector)
        rotation = _numbers(self.table[key], (3, 3))
        if (
            rotation is None
            or not (np.abs(rotation) <= 1 + ROTATION_TOLERANCE).all()
            or not np.allclose(rotation @ rotation.T, np.eye(3), atol=ROTATION_TOLERANCE)
            or np.linalg.det(rotation) < 0
        ):
            fix = "rows: where the camera's right, down and forward point in the world, unit vectors; or use look_at"
            raise self.error(key, "is no rotation", fix)
        u, _, vt = np.linalg.svd(rotation)  # the nearest one, for it was written with a few digits
        return np.asarray(u @ vt, dtype=np.float64)

    def _lens(self, width: int, height: int) -> Lens:
        which = self._one_of(_FOCALS, "its lens")
        angle, focal = None, None
        if which == "focal_px":
            focal = self.number("focal_px", 1.0, MAX_FOCAL_PX)
        elif which == "focal_mm":
            length, pixel = self.number("focal_mm", 1e-3, 1e5), self.number("pixel_um", 1e-2, 1e4)
            if pixel is None:
                raise UsageError(
                    f"{self.where} has focal_mm and no pixel_um.", fix="add how wide a pixel is: pixel_um = 3.45"
                )
            assert length is not None
            focal = length / (pixel * 1e-3)
        else:
            whole = self.number("fov_deg", 0.01, 359.0)
            assert whole is not None
            angle = float(np.radians(whole)) / 2
        if "pixel_um" in self.table and which != "focal_mm":
            raise UsageError(f"{self.where}: pixel_um goes with focal_mm, not with {which}.", fix="leave it out")
        family = self._family(focal, angle, width)
        centre = (width - 1) / 2, (height - 1) / 2
        distortion = self._distortion(family)
        if angle is not None:
            edge = np.array([[np.sin(angle), 0.0, np.cos(angle)]])
            at_edge, valid = LENSES[family](1.0, 1.0, 0.0, 0.0, *distortion).pixel_from_camera_point(edge)
            if not valid[0] or not at_edge[0, 0] > 0:
                fix = 'use lens = "kannala-brandt", or a smaller angle (fov_deg is the whole angle across the width)'
                raise self.error("fov_deg", f"is more than a {family} lens sees", fix)
            focal = (width / 2) / float(at_edge[0, 0])
        assert focal is not None
        return LENSES[family](focal, focal, *centre, *distortion)

    def _family(self, focal: float | None, angle: float | None, width: int) -> str:
        if "lens" not in self.table:
            if angle is not None:
                focal = width / 2 / float(np.tan(angle)) if angle < np.pi / 2 else 0.0
            assert focal is not None
            wide = focal / width < PERSPECTIVE_FROM_PX / 1280
            return "kannala-brandt" if wide else "brown-conrady"
        family = self.table["lens"]
        if not isinstance(family, str) or family not in LENSES:
            known = ", ".join(LENSES)
            hint = did_you_mean(family, LENSES) if isinstance(family, str) else ""
            raise self.error("lens", f"is not known{hint}", f"use one of {known}")
        return family

    def _distortion(self, family: str) -> list[float]:
        names = [field.name for field in fields(LENSES[family])][4:]
        if "distortion" not in self.table:
            return [0.0] * len(names)
        value = self.table["distortion"]
        count = len(value) if isinstance(value, list) else -1
        numbers = _numbers(value, (count,)) if 0 <= count <= len(names) else None
        if numbers is None or not (np.abs(numbers) <= 100).all():
            raise self.error("distortion", f"must be up to {len(names)} numbers", f"in order {', '.join(names)}")
        return [*numbers.tolist(), *[0.0] * (len(names) - count)]

    def _one_of(self, keys: tuple[str, ...], what: str) -> str:
        there = [key for key in keys if key in self.table]
        if len(there) == 1:
            return there[0]
        said = f"says {what} {len(there)} times: {' and '.join(there)}" if there else f"does not say {what}"
        raise UsageError(f"{self.where} {said}.", fix=f"write one of {', '.join(keys)}")


def _numbers(value: Any, shape: tuple[int, ...]) -> Floats | None:
    """Finite numbers in an array of a shape; None for anything else."""
    if not shape:
        plain = isinstance(value, (int, float)) and not isinstance(value, bool)
        return np.array(float(value)) if plain and abs(value) < 1e300 else None
    if not isinstance(value, list) or len(value) != shape[0]:
        return None
    parts = [_numbers(part, shape[1:]) for part in value]
    if any(part is None for part in parts):
        return None
    return np.array(parts, dtype=np.float64).reshape(shape)


def _joined(shared: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """What all cameras share, and what one says itself, which may say the same thing in another way."""
    others = {key for ways in (_AIMS, _FOCALS) if any(key in own for key in ways) for key in ways}
    if others & set(_FOCALS):
        others.add("pixel_um")
    if others & set(_AIMS) and "look_at" not in own:
        others.add("up")
    return {**{key: value for key, value in shared.items() if key not in others}, **own}


def _name_of(camera: Mapping[str, Any], i: int) -> str:
    name = camera.get("name")
    return f"{i + 1} ({name[:40]!r})" if isinstance(name, str) else str(i + 1)


def _refuse_others(table: Mapping[str, Any], known: Iterable[str], where: str) -> None:
    for key in table:
        if key not in known:
            raise UsageError(
                f"{where}: {key[:60]!r} is not known{did_you_mean(key, known)}.", fix=f"it may say {', '.join(known)}"
            )


def _shown(value: Any) -> str:
    return repr(value)[:60]
