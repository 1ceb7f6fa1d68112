"""Cells of text that no spreadsheet takes for a formula.

A cell that begins with = + @ or - is a formula to Excel and others, and a formula can read files and send them. So an
apostrophe is written before it, and taken off on reading: names are the same in all files, and join. A cell that begins
with apostrophes and then such a sign gets one more, so that every text comes back as it was. A number stays a number.
"""

from __future__ import annotations

import re

_FORMULA = re.compile(r"'*[=+@\-\t\r]")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_STARTS = frozenset("=+@-\t\r'")


def guard_cell(text: str) -> str:
    """The text as it is written into a table.

    Args:
        text: Of a cell.
    """
    return "'" + text if text[:1] in _STARTS and _is_formula(text) else text


def unguard_cell(text: str) -> str:
    """The text that `guard_cell` was given.

    Args:
        text: As it stands in a table.
    """
    return text[1:] if text[:1] == "'" and _is_formula(text) else text


def _is_formula(text: str) -> bool:
    return _FORMULA.match(text) is not None and not _NUMBER.fullmatch(text.lstrip("'"))
