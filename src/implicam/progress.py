"""Progress of long work: numbers report it, screens show it, and neither knows the other."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Called as work goes on; `done` of `total` steps of `what` are finished."""

    def __call__(self, what: str, done: int, total: int) -> None:
        """Take note of a step.

        Args:
            what: The work, in words.
            done: Steps that are finished.
            total: Steps in all.
        """


def silent(what: str, done: int, total: int) -> None:
    """Report nothing.

    Args:
        what: The work, in words.
        done: Steps that are finished.
        total: Steps in all.
    """
