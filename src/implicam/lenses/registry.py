"""The families of lenses, by the names that stand in calibration files and on the command line."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

from implicam.lenses.base import Lens
from implicam.lenses.brown_conrady import BrownConrady
from implicam.lenses.kannala_brandt import KannalaBrandt
from implicam.registry import Registry, offers

FIRST_FIELDS = ("fx", "fy", "cx", "cy")
"""Of every family, in this order."""


def _what_is_wrong(name: str, part: Any) -> Iterator[str]:
    wrong = list(offers(Lens, "family")(name, part))
    yield from wrong
    if not wrong and not is_dataclass(part):
        yield "it is no dataclass"
    elif not wrong:
        own = [field.name for field in fields(part)]
        if tuple(own[:4]) != FIRST_FIELDS:
            yield f"its first fields are {', '.join(own[:4])}, and not {', '.join(FIRST_FIELDS)}"


LENSES: Registry[type[Lens]] = Registry(
    "lens",
    {
        BrownConrady.family: BrownConrady,
        KannalaBrandt.family: KannalaBrandt,
    },
    "implicam.lenses",
    _what_is_wrong,
)
"""Family -> its class."""
