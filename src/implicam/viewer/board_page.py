"""The pages of sessions by hand: that of every guided session, with corners, outlines, and no robot; and of a board."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from implicam.formatting import json_safe
from implicam.session.board_session import BoardController, BoardState
from implicam.session.by_hand import ByHandController, ByHandState
from implicam.session.controller import State
from implicam.session.database import shots_of
from implicam.viewer.bench_page import BenchPage
from implicam.viewer.board_words import board_snapshot
from implicam.viewer.calibration_scene import COLUMNS, ROWS, list_cameras, up_of
from implicam.viewer.hand_words import allowed
from implicam.viewer.space import Placing, edges


class HandPage(BenchPage):
    """The application, for something that is held by hand."""

    _controller: ByHandController

    def _buttons_of(self, state: State) -> dict[str, bool]:
        assert isinstance(state, ByHandState)
        return allowed(state, self._moves)

    def _action(self, word: str, given: Mapping[str, Any]) -> Callable[[], Any] | dict[str, Any]:
        controller = self._controller
        if word == "go" and not self._moves and controller.state.phase not in ("trouble", "done"):
            return controller.go
        return super()._action(word, given)

    def _set_auto(self, given: Mapping[str, Any]) -> dict[str, Any]:
        if self._moves:
            return super()._set_auto(given)
        self._controller.set_auto(given.get("on") is True)
        return {}

    def about(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """As of every session; `boards` says which buttons and words are of no use."""
        simulated = any(getattr(source, "simulated", False) for source in self._controller.equipment.cameras)
        found = super().about(given)
        return {**found, "boards": True, "auto": found["auto"] or not self._moves, "simulated": simulated}

    def scene(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """The volume in three dimensions, in the frame of the first camera, and the corners where they were."""
        controller, state = self._controller, self._controller.state
        space, predicted = controller.loop.workspace, state.predicted
        cameras = list_cameras(state.calibration)
        known = np.zeros((0, 3))
        if state.calibration is not None:
            known = state.calibration.data.xyz
            known = known[np.isfinite(known).all(axis=1)][:: max(1, len(known) // 1500)]
        around = np.concatenate([space.vertices, known])
        low, high = around.min(axis=0), around.max(axis=0)
        return {
            "placing": Placing.of(low, high, up_of(cameras)).table,
            "box": [space.vertices.min(axis=0).tolist(), space.vertices.max(axis=0).tolist()],
            "edges": edges(space).tolist(),
            "levels": [],
            "cameras": cameras,
            "grid": [ROWS, COLUMNS],
            "known": known.tolist(),
            "skipped": [one.xyz.tolist() for one in controller.session.skipped],
            "judged": controller.loop.judged_at.tolist() if predicted is not None else [],
            "u95": [] if predicted is None else json_safe(predicted.u95.tolist()),
            "excess": [] if predicted is None else json_safe(predicted.excess.tolist()),
        }

    def _has(self, point: str) -> bool:
        data = self._controller.session.data
        return data is not None and point in shots_of(data).tolist()


class BoardPage(HandPage):
    """The application, for a board."""

    _controller: BoardController

    def _snapshot(self, state: State, measured: Any, skipped: int) -> dict[str, Any]:
        assert isinstance(state, BoardState)
        rule = self._controller.loop.rule
        return board_snapshot(state, self._names, rule, unit=self._unit, skipped=skipped, moves=self._moves)

    def points(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """The boards so far, and what was seen of each."""
        data = self._controller.session.data
        if data is None:
            return {"points": []}
        shots, seen = shots_of(data), data.observations.seen
        names = list(dict.fromkeys(shots.tolist()))
        rows = [(name, seen[shots == name]) for name in names]
        return {
            "points": [
                {"name": name, "corners": int(part.sum()), "cameras": int(part.any(axis=0).sum())}
                for name, part in rows
            ]
        }
