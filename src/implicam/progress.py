"""Progress of long work: numbers report it, screens show it, and neither knows the other."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Called as work goes on; `done` of `total` steps of `what` are finished."""

    def __call__(self, what: str, done: int, total: int) -> None:
        """Take note."""


def silent(what: str, done: int, total: int) -> None:
    """Report to nobody."""
