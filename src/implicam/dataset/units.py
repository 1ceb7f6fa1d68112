"""Length units."""

from __future__ import annotations

from implicam.errors import DatasetError, UsageError, did_you_mean

METRES_PER_UNIT = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "km": 1e3, "in": 0.0254, "ft": 0.3048}

UNKNOWN_UNIT = "unknown"
"""Of what has no positions, and does not state the unit."""


def refuse_length_unit(given: object) -> None:
    """Refuse the other name of the argument `unit`.

    Args:
        given: The value of `length_unit=`; None where it was not given.

    Raises:
        UsageError: It was given.
    """
    if given is not None:
        raise UsageError(f"length_unit={given!r} is no argument here.", fix=f"write unit={given!r}")


def refuse_unknown_unit(unit: object) -> None:
    """Refuse what is no length unit.

    Args:
        unit: As somebody wrote it.

    Raises:
        UsageError: It is none of `METRES_PER_UNIT`.
    """
    if unit not in METRES_PER_UNIT:
        raise UsageError(
            f"there is no length unit {unit!r}{did_you_mean(str(unit), METRES_PER_UNIT)}.",
            fix=f"use {', '.join(METRES_PER_UNIT)}",
        )


def metres_per(unit: str) -> float:
    """The length of a unit in metres.

    Args:
        unit: For example "mm", see `METRES_PER_UNIT`.

    Raises:
        DatasetError: The unit has no known length.
    """
    if unit not in METRES_PER_UNIT:
        raise DatasetError(
            f"the length unit is {unit!r}, which has no known size{did_you_mean(unit, METRES_PER_UNIT)}.",
            why="lengths are wanted in another unit",
            fix=f"use one of {', '.join(METRES_PER_UNIT)}",
        )
    return METRES_PER_UNIT[unit]
