"""A dataset in a few lines, as an interactive Python shows it."""

from __future__ import annotations

from implicam.dataset.model import Dataset
from implicam.dataset.units import UNKNOWN_UNIT
from implicam.formatting import decimal_number

MAX_CAMERA_LINES = 6


def describe_dataset(data: Dataset) -> str:
    """At most ten lines: how many points, the cameras, where the known positions are.

    Args:
        data: The dataset.
    """
    seen = data.observations.seen.sum(axis=0).tolist()
    known = "with" if data.known else "without"
    unit = "" if data.length_unit == UNKNOWN_UNIT else f" in {data.length_unit}"
    lines = [
        f"dataset {data.name!r}{unit}: {_count(len(data), 'point')} {known} known positions, "
        f"{_count(len(data.cameras), 'camera')}"
    ]
    shown = data.cameras if len(data.cameras) <= MAX_CAMERA_LINES + 1 else data.cameras[:MAX_CAMERA_LINES]
    widest = max([len(camera.name) for camera in shown] + [5 if data.known else 0])
    for camera, views in zip(shown, seen, strict=False):
        size = f"{camera.width} x {camera.height} px" if camera.width and camera.height else "size not stated"
        lines.append(f"  {camera.name:<{widest}}  {size}, {_count(views, 'view')}")
    if len(data.cameras) > len(shown):
        lines.append(f"  ... and {len(data.cameras) - len(shown)} cameras more")
    if data.known and len(data):
        ends = zip("xyz", data.xyz.min(axis=0), data.xyz.max(axis=0), strict=True)
        reach = ", ".join(f"{axis} {decimal_number(low)} to {decimal_number(high)}" for axis, low, high in ends)
        lines.append(f"  {'known':<{widest}}  {reach}")
    return "\n".join(lines)


def _count(n: int, what: str) -> str:
    return f"{n:,} {what}{'s' * (n != 1)}"
