"""A calibration for C++: a table that implicam.hpp reads, and that header beside it.

The file: "IMPLITBL"; version and number of sections (uint32 each); size of the file, and CRC-32 of everything from byte
32 on (uint64 each); the SHA-256 of the calibration file (32 bytes); then a directory and the sections. An entry of the
directory has the name (16 bytes, zero-padded), type (uint32: 1 float64, 2 float32, 3 bytes), rank (uint32), up to 6
sides, the start in the file, and the length in bytes (uint64 each). All little-endian, sections at multiples of 64.
`grid` is [x][y][z][camera][8 channels], so that one load brings all of a camera at a node; a reader leaves out sections
that it does not know.
"""

from __future__ import annotations

import struct
import zlib
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam import calibration_file
from implicam.calibrators import Calibration
from implicam.calibrators.protocol import RigCalibration
from implicam.errors import FitError, UsageError
from implicam.files import refuse_other_files, replacing_folder
from implicam.formatting import percent
from implicam.progress import Progress, silent
from implicam.rig_model import FittedRig
from implicam.rig_model.shot_errors import WORLD_POLYNOMIAL_TERMS
from implicam.tabulated.spline_table import MAX_PIXEL_ERROR_SDS, MAX_VARIANCE_ERROR, SplineTable, box_of, tabulate

TABLE_FILE, HEADER_FILE, EXAMPLE_FILE = "rig.table", "implicam.hpp", "example.cpp"
_OURS = {TABLE_FILE, HEADER_FILE, EXAMPLE_FILE, "example", "example.exe"}
"""With what the first lines of the example say to compile it to."""
TABLE_VERSION = 1
MAX_NOT_TABULATED = 0.5
"""Of a camera: part of the cells in which the table may be not accurate enough."""

_HEADER, _ENTRY, _ALIGN, _MAX_RANK = 64, 88, 64, 6
_TYPES = {np.dtype("<f8"): 1, np.dtype("<f4"): 2, np.dtype("u1"): 3}


def write_cpp(
    calibration: Calibration,
    folder: str | Path,
    checksum: str = "",
    progress: Progress = silent,
) -> list[str]:
    """Write a folder for C++17 without libraries: the header implicam.hpp, the table rig.table, and an example.

    Args:
        calibration: By `forward-gp` or `explicit`.
        folder: The folder to write; an earlier one is replaced.
        checksum: The SHA-256 of the calibration file; of a calibration that is not a file it is found out.
        progress: Is told how far it is.

    Returns:
        Notes: how accurate the table is, and where it is not.

    Raises:
        UsageError: The method has no cameras, or the noise has heavy tails.
        FitError: A camera sees too little of the box, or cannot be tabulated.
        DatasetError: The folder holds something else.
        ImplicamError: The folder cannot be written.

    >>> import implicam as ic
    >>> from implicam.deploy import write_cpp
    >>> made = ic.Explicit(lens="brown-conrady").fit(ic.simulated("stereo", points=30, seed=1))
    >>> for note in write_cpp(made, "for-cpp"):
    ...     print(note.partition(":")[0])
    The table is exact to 0.3 % of a view's sd and 0.5 % of its variance
    """
    folder = Path(folder)
    refuse_other_files(folder, _OURS.__contains__, "a calibration for C++")
    rig = _rig(calibration)
    low, high = box_of(rig, calibration.data.xyz)
    table = tabulate(rig, low, high, progress)
    notes = _notes(rig, table)
    content = table_bytes(rig, table, checksum or calibration_file.checksum(calibration))
    with replacing_folder(folder, overwrite=True) as temporary:
        (temporary / TABLE_FILE).write_bytes(content)
        for name in (HEADER_FILE, EXAMPLE_FILE):
            text = files(__package__).joinpath("templates", name).read_text(encoding="utf-8")
            (temporary / name).write_text(text, encoding="utf-8", newline="")
    return notes


def _rig(calibration: Calibration) -> FittedRig:
    if not isinstance(calibration, RigCalibration):
        raise UsageError(
            f"{calibration.method} has no cameras that could be tabulated.",
            why="it learns the map from pixels to positions as a whole",
            fix="calibrate the same data with forward-gp or explicit; inverse-gp can be exported --to onnx",
        )
    return checked_rig(calibration.map, len(calibration.data.xyz))


def checked_rig(rig: FittedRig, known_points: int) -> FittedRig:
    """A rig that can be tabulated.

    Args:
        rig: It.
        known_points: From which it was calibrated.

    Raises:
        UsageError: It cannot, and why.
    """
    if rig.degrees is not None:
        raise UsageError(
            f"the noise of this calibration has heavy tails (Student's t, {rig.degrees:g} degrees of freedom), which "
            "the C++ header does not know.",
            why="positions are then found by sampling, eq. (T4)",
            fix="measure in Python, or find and leave out the bad detections and calibrate again",
        )
    if not known_points:
        raise UsageError(
            "this calibration has no known points, so nothing says which box to tabulate.",
            fix="calibrate from known points",
        )
    return rig


def _notes(rig: FittedRig, table: SplineTable) -> list[str]:
    notes = [
        f"The table is exact to {percent(MAX_PIXEL_ERROR_SDS, 1)} of a view's sd and {percent(MAX_VARIANCE_ERROR, 1)} "
        f"of its variance: at {table.places:,} random places it is off by {percent(table.pixel_error, 2)} and "
        f"{percent(table.variance_error, 2)} at most."
    ]
    for c, name in enumerate(rig.camera_names):
        share = float(table.marked[..., c].mean())
        if share > MAX_NOT_TABULATED:
            raise FitError(
                f"camera {name!r} cannot be tabulated: the table is not exact enough in {percent(share)} of the box.",
                why="its plane cuts the box of the known points, or it sees too little of it",
                fix=f"calibrate with --without {name}, or with known points in a smaller box",
            )
        if share:
            notes.append(
                f"Camera {name!r}: in {percent(share, 1)} of the box the table is not accurate enough; positions there "
                "are refused (not_tabulated)."
            )
    return notes


def table_bytes(rig: FittedRig, table: SplineTable, checksum: str) -> bytes:
    """The table as a file.

    Args:
        rig: The cameras.
        table: Of them.
        checksum: The SHA-256 of the calibration file.

    Returns:
        The same bytes for the same calibration.
    """
    sections = _sections(rig, table)
    start = _HEADER + _ENTRY * len(sections)
    directory, body = b"", b""
    for name, array in sections.items():
        gap = -(start + len(body)) % _ALIGN
        content = np.ascontiguousarray(array).tobytes()
        sides = (*array.shape, *[0] * (_MAX_RANK - array.ndim))
        directory += struct.pack("<16sII", name.encode(), _TYPES[array.dtype], array.ndim)
        directory += struct.pack("<8Q", *sides, start + len(body) + gap, len(content))
        body += bytes(gap) + content
    rest = bytes.fromhex(checksum) + directory + body
    head = struct.pack("<8sIIQQ", b"IMPLITBL", TABLE_VERSION, len(sections), 32 + len(rest), zlib.crc32(rest))
    return head + rest


def _sections(rig: FittedRig, table: SplineTable) -> dict[str, NDArray[Any]]:
    models, C = rig.posterior.models, len(rig.cameras)
    cameras = [rig.trained.cameras[c] for c in rig.cameras]
    marks = np.packbits(table.marked, axis=3, bitorder="little")
    accuracy = [table.pixel_error, table.variance_error, float(table.marked.mean()), table.places]
    s = rig.settings
    p_values = [s.min_p_value, s.disagree_p_value, s.agree_p_value, s.clearly_better_ratio]
    rules = [*p_values, float(rig.misfit_adds), *accuracy]
    sensors = [
        [camera.width or 0, camera.height or 0, model.noise, *model.image.centre, model.image.half, stated]
        for camera, model, stated in zip(cameras, models, rig.usual_stated_noise, strict=True)
    ]
    found: dict[str, NDArray[Any]] = {
        "about": _text(f"{rig.length_unit}\n{calibration_file.package_version()}"),
        "names": _text("".join(f"{camera.name}\n" for camera in cameras)),
        "frame": np.array([*rig.frame.offset, rig.frame.scale, *table.low, *table.step]),
        "rules": np.array(rules),
        "sensors": np.array(sensors, dtype=np.float64),
        "projections": table.projections.reshape(C, 12),
        "marks": marks,
        "grid": table.grid(),
    }
    if table.ties.shape[3]:
        found["ties"] = table.ties
    return found | _label_sections(rig, table)


def _label_sections(rig: FittedRig, table: SplineTable) -> dict[str, NDArray[Any]]:
    if rig.labels is None:
        return {}
    shots, unknowns, S = rig.labels.shots, rig.labels.unknowns, len(rig.labels.shots.centre)
    settings, middle = shots.settings, shots.centre.mean(axis=0)
    t = (shots.centre - middle) @ shots.along[0]
    half = float(np.abs(t).max())
    terms = min(WORLD_POLYNOMIAL_TERMS, S)
    rows = [shots.centre, shots.axes.reshape(S, 9), shots.extent, shots.radius, t / half]
    world = [shots.reach, half, settings.max_world_half_lengths, settings.max_world_variance_ratio]
    found = {
        "shots": np.column_stack(rows),
        "world": np.array([*shots.along.ravel(), *middle, *world, settings.max_tilt_radii, *rig.labels.bars]),
        "polynomial": np.asarray(np.linalg.pinv(np.vander(t / half, terms)), dtype=np.float64),
    }
    if unknowns is not None:
        found |= {
            "label_sd": np.asarray(rig.labels.sd, dtype=np.float64).ravel(),
            "label_mean": unknowns.mean,
            "label_covariance": unknowns.covariance,
            "pattern": shots.pattern,
            "through": table.through,
        }
    return found


def _text(words: str) -> NDArray[np.uint8]:
    return np.frombuffer(words.encode(), dtype=np.uint8)
