"""A session in which somebody holds the target, and nobody knows where it is: what a board and a wand have in common.

Pictures are kept by themselves, on disk before anything is said; the cameras are fitted again in the background.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np

from implicam.active import PredictedCovariance, Rule, Step, Workspace
from implicam.active.board_loop import CameraProgress
from implicam.calibrators import Calibration, Calibrator
from implicam.dataset import Dataset, Floats
from implicam.detect import Detected, View
from implicam.errors import FitError, ImplicamError, UsageError
from implicam.formatting import json_safe
from implicam.hardware import Frame
from implicam.images import blank
from implicam.report import ReportData
from implicam.report.words import headline
from implicam.report.words import verdict as judgement
from implicam.session.controller import (
    CALIBRATION_FILE,
    HISTORY_KEY,
    REPORT_FILE,
    Equipment,
    SessionController,
    State,
)
from implicam.session.detections import Look
from implicam.session.journal import Session

_LOG = logging.getLogger(__name__)


class Judgement(NamedTuple):
    """What is to be said of the target as it is held now: whether it is kept, and if not, why."""

    ready: bool
    reason: str


class LoopByHand(Protocol):
    """Says where to hold the target next, and when to stop: `BoardLoop`, `WandLoop`."""

    calibrator: Calibrator
    data: Dataset | None
    history: list[Step]
    problem: ImplicamError | None
    rule: Rule
    start: int

    @property
    def calibration(self) -> Calibration | None:
        """The last fit; None before there is one."""

    @property
    def points(self) -> int:
        """How many boards or frames there are."""

    @property
    def stop(self) -> str:
        """Why to stop, in words; empty where not yet."""

    @property
    def contradictions(self) -> tuple[str, ...]:
        """What speaks against the last fit, in words."""

    @property
    def forecast(self) -> bool:
        """Whether the last step of the history is expected, and no fit has seen it yet."""

    @property
    def predicted(self) -> PredictedCovariance | None:
        """The covariance at the judged places; None before there is a calibration."""

    @property
    def judged_at(self) -> Floats:
        """(g, 3) these places."""

    @property
    def workspace(self) -> Workspace:
        """The volume in which positions have to be good."""

    def wants_fit(self, data: Dataset) -> bool:
        """Whether a fit to these data is worth its time.

        Args:
            data: All that is there.
        """

    def fit(self, data: Dataset | None) -> Any:
        """What these data say of the rig; nothing of the loop changes.

        Args:
            data: All that is there; None for nothing.
        """

    def adopt(self, data: Dataset | None, found: Any) -> None:
        """Take what `fit` gave.

        Args:
            data: That it was fitted to.
            found: What it gave.
        """

    def reset(self, data: Dataset | None) -> None:
        """Go on with these data, and fit.

        Args:
            data: All from now on; None for nothing.
        """

    def camera_progress(self) -> list[CameraProgress]:
        """How far each camera is."""


@dataclass(frozen=True, eq=False)
class ByHandState(State):
    """As `State`. judgement: of the target in the live pictures. cameras: how far each is. busy: whether the cameras
    are being fitted meanwhile. taken: in this sitting. contradictions: what speaks against the last fit. unfitted: why
    the last fit failed. forecast: whether the last numbers are expected of what no fit has seen yet."""

    judgement: Judgement = field(default_factory=lambda: Judgement(False, ""))
    cameras: tuple[CameraProgress, ...] = ()
    busy: bool = False
    taken: int = 0
    contradictions: tuple[str, ...] = ()
    unfitted: str = ""
    forecast: bool = False


class ByHandController(SessionController):
    """One session, its equipment, and the loop that says where to hold the target next.

    thing, things: what is held, and what is counted. where: how a person gets it there.
    """

    loop: Any  # a LoopByHand
    state: ByHandState

    thing: ClassVar[str]
    things: ClassVar[str]
    where: ClassVar[str]

    def __init__(
        self, session: Session, equipment: Equipment, loop: LoopByHand, state: ByHandState, *, background: bool = True
    ) -> None:
        super().__init__(session, equipment, loop, auto=state.auto)  # type: ignore[arg-type]
        self.state, self._background = state, background
        self._fitter = ThreadPoolExecutor(1, thread_name_prefix="implicam-fit")
        self._fitting: Future[None] | None = None
        self._loop_lock = threading.RLock()

    # called by a page

    def redo(self) -> None:
        """Nothing is shown to be judged here: what is seen is kept or refused at once."""
        raise UsageError("there is nothing to look at again.", fix="take a picture")

    def report_position(self, position: Any, *, confirmed: bool = False) -> None:
        """Refuse: nobody has to know where the target is.

        Args:
            position: Not used.
            confirmed: Not used.

        Raises:
            UsageError: Always.
        """
        raise UsageError(f"a {self.thing} held by hand needs no position.", fix=self.where)

    def remove(self, name: str, *, again: bool = False) -> None:
        """Take any set of pictures back.

        Args:
            name: Of the shot.
            again: Not used: the same place is hard to find again.

        Raises:
            UsageError: There is no such shot.
        """
        with self._working("fitting", f"taking {name} back"):
            self.session.remove(name)
            self._fit()
            self._aim(f"{name} is taken back. ")

    def set_auto(self, auto: bool) -> None:
        """Turn on or off that pictures are kept by themselves.

        Args:
            auto: Whether they are.
        """
        self._show(auto=auto)

    def finish(self) -> Path:
        """Calibrate with everything, save and report; the calibration's file, which is not there after trouble."""
        path = self.session.folder / CALIBRATION_FILE
        with self._working("fitting", "calibrating, and writing the report"):
            self._wait_for_fit()
            data = self.session.data
            if self.loop.calibration is None or data is None:
                raise self._too_few()
            calibration = self.loop.calibrator.fit(self._used(data))
            calibration.save(path)
            report = self.session.folder / REPORT_FILE
            report.unlink(missing_ok=True)  # it may be of an earlier calibration
            words, verdict = f"{self.loop.points} {self.things}{self._also(data)}. Saved: {path}", ("", "unknown")
            try:
                said = self._report(report, calibration, data)
                about_bars, _, tone = judgement(said)
                verdict = f"{headline(said)} {about_bars}", tone
                words += f" and {report}"
            except ImplicamError as error:
                words += f". No report: {error.what}"
            self.session.log("finished", points=self.loop.points)
            self._show(
                phase="done", message=words, report=report if report.exists() else None, target=None, auto=False,
                verdict=verdict,
            )  # fmt: skip
        return path

    def close(self) -> None:
        """Close the equipment and the session, after a fit in the background; closing twice is harmless."""
        self._fitter.shutdown(wait=True, cancel_futures=True)
        super().close()

    @property
    def measured_live(self) -> Floats:
        """Nothing: the target is no point."""
        return np.full(3, np.nan)

    # private

    def _too_few(self) -> UsageError:
        """There is no calibration yet: why, and what to do."""
        raise NotImplementedError

    def _report(self, path: Path, calibration: Calibration, data: Dataset) -> ReportData:
        """Write the page; ImplicamError where there is nothing to report."""
        raise NotImplementedError

    def _used(self, data: Dataset) -> Dataset:
        """What calibrates."""
        return data

    def _also(self, data: Dataset) -> str:
        """What there is besides, in words."""
        return ""

    def _fit(self) -> None:
        """With everything, now."""
        self._wait_for_fit()
        with self._loop_lock:
            self.loop.reset(self.session.data)
        self._show_loop()

    def _fit_behind(self) -> None:
        """In the background, unless that is being done: then what comes meanwhile waits for the next fit."""
        data = self.session.data
        if data is None or not self.loop.wants_fit(data):
            return
        if not self._background:
            self._fit()
            return
        if self._fitting is None or self._fitting.done():
            self._show(busy=True)
            self._fitting = self._fitter.submit(self._fitted_behind)

    def _fitted_behind(self) -> None:
        data, now = None, self.session.data
        while data is not now and (data is None or now is None or self.loop.wants_fit(now)):
            data = now
            begun = time.monotonic()
            try:
                found = self.loop.fit(data)
            except Exception as error:  # of a library: what was accepted is on disk, and the next fit may do
                _LOG.exception("the fit in the background failed")
                found = FitError(f"the fit failed: {type(error).__name__}: {error}.", fix=f"take more {self.things}")
            first = self.loop.calibration is None
            with self._loop_lock:
                self.loop.adopt(data, found)
            _LOG.info("fitted %d %s in %.1f s", self.loop.points, self.things, time.monotonic() - begun)
            self._show_loop()
            if self.state.phase == "aim" and self._aims_anew(first and self.loop.calibration is not None):
                self._aim()
            now = self.session.data  # others may have come meanwhile
        self._show(busy=False)

    def _aims_anew(self, first: bool) -> bool:
        """Whether the fit that is done just now has changed where to go; first: there is a calibration now."""
        return first

    def _wait_for_fit(self) -> None:
        if self._fitting is not None:
            self._fitting.result()
            self._fitting = None

    def _show_loop(self) -> None:
        loop = self.loop
        for step in loop.history[-1:]:
            self.session.set(f"{HISTORY_KEY} {step.points}", json_safe(asdict(step)))
        self._show(
            data=loop.data, calibration=loop.calibration, predicted=loop.predicted, history=tuple(loop.history),
            stop=loop.stop, cameras=tuple(loop.camera_progress()), contradictions=loop.contradictions,
            unfitted="" if loop.problem is None else f"{loop.problem.what} To do: {loop.problem.fix}.",
            forecast=loop.forecast,
        )  # fmt: skip

    @property
    def _each_when_it_likes(self) -> bool:
        """Whether cameras take pictures by themselves, triggered by nothing: only of a target held still do these
        show one place."""
        return self.equipment.shows_live and self.equipment.trigger is None

    def _detect_all(self, frames: Sequence[Frame], *, live: bool = False) -> tuple[Look, ...]:
        names = [source.name for source in self.equipment.cameras]
        found = list(self._pool.map(self._detect, names, frames))
        nowhere = np.full(2, np.nan)
        return tuple(Look(n, f, d, nowhere) for n, f, d in zip(names, frames, found, strict=True))

    def _detect(self, camera: str, frame: Frame) -> Detected:
        why = blank(frame.picture)
        if why:
            return Detected(reason=f"the picture is {why}")
        return self.equipment.detector.detect(frame.picture, View(camera, "live"))
