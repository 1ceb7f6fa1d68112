"""The page of a session with a wand: that of a board, with the volume and the pictures from red to green."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from implicam.formatting import json_safe
from implicam.session.controller import State
from implicam.session.database import shots_of
from implicam.session.wand_session import WandController, WandState
from implicam.viewer.board_page import HandPage
from implicam.viewer.wand_words import wand_snapshot


class WandPage(HandPage):
    """The application, for a wand."""

    _controller: WandController

    def _snapshot(self, state: State, measured: Any, skipped: int) -> dict[str, Any]:
        assert isinstance(state, WandState)
        return wand_snapshot(state, self._names, self._controller.loop.rule, unit=self._unit, skipped=skipped)

    def about(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """As of every session by hand; `wand` says which words are of a wand."""
        return {**super().about(given), "wand": True}

    def scene(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """As of every session by hand; `good`: how good positions are at each judged place, from 0 to 1, enough."""
        design = self._controller.loop.design
        return {**super().scene(given), "good": [] if design is None else json_safe(np.round(design.good, 3).tolist())}

    def points(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """The frames so far."""
        data = self._controller.session.data
        if data is None:
            return {"points": []}
        shots, seen = shots_of(data), data.observations.seen
        first = {name: i for i, name in reversed(list(enumerate(shots.tolist())))}
        rows = [(name, seen[i : i + 3][shots[i : i + 3] == name]) for name, i in reversed(list(first.items()))]
        return {
            "points": [
                {"name": name, "corners": int(part.any(axis=1).sum()), "cameras": int(part.all(axis=0).sum())}
                for name, part in rows
            ]
        }
