"""A guided session with a wand: nobody knows where it is, and nobody presses a key.

    aim -> (kept, kept, ... while it is waved) -> aim elsewhere ...   -> done

The cameras are live. Every set of pictures in which two cameras see both ends is kept by itself, as numbers: it is on
disk before the page says so. Sets that would be wrong are left out, and counted by why. The cameras are fitted again in
the background; what is still uncertain then says where to wave next, and lengths that a fit did not know whether its
error bars are true.
"""

from __future__ import annotations

import logging
import time
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from implicam import calibration_file
from implicam.active.wand_coverage import Cells
from implicam.active.wand_loop import MIN_WHOLE_FRAMES, WandLoop, describe_lengths
from implicam.calibrators import Calibration, FromWand
from implicam.dataset import Camera, Dataset, Floats, Observations
from implicam.dataset.wand import FRAME, MARKER
from implicam.detect import Detected, View
from implicam.errors import HardwareError, ImplicamError, UsageError
from implicam.hardware import Frame
from implicam.progress import Progress, silent
from implicam.report import ReportData, write_report
from implicam.report.data import report_of_lengths
from implicam.session.by_hand import ByHandController, ByHandState, Judgement
from implicam.session.controller import Equipment
from implicam.session.detections import Look
from implicam.session.journal import Session

_LOG = logging.getLogger(__name__)

MIN_CAMERAS = 2
"""That must see both ends."""

MIN_MOVED_PX = 12.0
"""So far an end must have gone in a camera since the set before: else it tells nothing new."""

MAX_SLIP_PX = 0.5
"""So far an end may go, in the median, between the exposures of two cameras."""

FREE_RUNNING_SECONDS = 1 / 30
"""By which exposures of cameras differ that nothing triggers, beyond what their clocks say."""

STILL_WINDOW = 16
"""Live pictures of each camera in which a detector sees what does not move."""

MAX_EMPTY_SETS = 40
"""In a row, after which a session without anybody goes to another place; and after so many places it gives up."""

MAX_EMPTY_PLACES = 5

TOO_FAST, UNTOLD, CLUTTERED, FEW = (
    "moved too fast", "ends not told apart", "other things look like markers", "seen by fewer than two cameras",
)  # fmt: skip
"""Why sets of pictures are left out."""


class Waver(Protocol):
    """What waves the wand, where that is not a person: see `SimulatedWave`."""

    seconds: float
    """That it takes from one place to the next."""

    def wave_at(self, uv: Floats) -> None:
        """Go to a place, and wave there.

        Args:
            uv: (cameras, 2) where it is in the pictures; NaN where it is not.
        """


class Seen(NamedTuple):
    """The markers in the picture of a camera: their names, pixels (n, 2) and standard uncertainties (n, 2)."""

    markers: tuple[str, ...]
    uv: Floats
    sd: Floats


@dataclass(frozen=True, eq=False)
class WandState(ByHandState):
    """As `ByHandState`. cells: the picture of each camera. left_out: why sets of pictures were left out, and how many.
    lengths: what the held-out lengths say, in words. out_of_reach: why no waving reaches what is wanted; empty where it
    may."""

    cells: tuple[Cells, ...] = ()
    left_out: tuple[tuple[str, int], ...] = ()
    lengths: str = ""
    out_of_reach: str = ""


class WandController(ByHandController):
    """One session with a wand, its equipment, and the loop that says where to wave next."""

    loop: WandLoop
    state: WandState

    thing, things, where = "wand", "frames", "wave it where two cameras see both ends"

    def __init__(
        self,
        session: Session,
        equipment: Equipment,
        loop: WandLoop,
        *,
        auto: bool = True,
        hand: Waver | None = None,
        background: bool = True,
    ) -> None:
        super().__init__(session, equipment, loop, WandState(auto=auto), background=background)
        self._hand = hand
        self._window: deque[tuple[str, tuple[Detected, ...]]] = deque(maxlen=STILL_WINDOW)
        self._number = 0
        self._before: tuple[float, Mapping[str, Floats]] = (0.0, {})  # the look before: when, and both ends by camera
        self._kept: Mapping[str, Floats] = {}  # the last set that was kept
        self._judged: tuple[Look, ...] = ()
        self._left_out: Counter[str] = Counter()
        self._simulated = all(getattr(source, "simulated", False) for source in equipment.cameras)

    # called by a page

    def go(self) -> None:
        """Keep what is seen now; UsageError with the reason where it is of no use."""
        self._require_target()
        with self._camera_lock:
            frames = self._take_frames(self.equipment.trigger)
        looks = self._detect_all(frames)
        why = self._judge(looks).reason
        self._show(looks=looks, judgement=Judgement(not why, why))
        if why:
            raise UsageError(f"nothing was kept: {why}.", fix=f"{self.where}, slowly")
        self._keep(looks)

    def skip(self, reason: str = "skipped by hand") -> None:
        """Show another place instead of this one.

        Args:
            reason: Kept in the session.

        Raises:
            UsageError: There is no target now.
        """
        target = self._require_target()
        with self._working("aim", "choosing another place"):
            if np.isfinite(target.xyz).all():
                self.session.skip(target.xyz, reason)
                self.loop.refuse(target.xyz, reason)
            self._aim()

    def live(self) -> None:
        """As of every session; and judge what is seen."""
        before = self.state.looks
        super().live()
        looks = self.state.looks
        if self.state.phase == "aim" and looks is not before:
            judged = self._judge(looks)
            if self.state.phase == "aim":
                self._judged = looks if judged.ready else ()
                self._show(judgement=judged, left_out=tuple(self._left_out.most_common()))

    def step(self) -> None:
        """Keep the live pictures, where they are of use."""
        looks = self._judged
        if self.state.phase == "aim" and looks:
            self._judged = ()
            self._keep(looks)

    def run(self, progress: Progress = silent) -> Path | None:
        """Wave until a rule says stop or something fails, then finish; a simulated hand waves.

        Args:
            progress: Told after each frame how many there are.

        Returns:
            The path of the calibration's file; None where something failed, or there is no calibration.
        """
        self.set_auto(True)
        self._background = False
        if self._hand is not None:
            self._hand.seconds = 0.0  # nobody watches
        if self.state.phase == "starting":
            self.start()
        empty = places = 0
        while self.state.auto and self.state.phase == "aim" and not self.state.stop:
            before = self.loop.points
            self.live()
            self.step()
            progress("frames", self.loop.points, max(self.loop.points, self.loop.start))
            empty = 0 if self.loop.points > before else empty + 1
            places = 0 if not empty else places
            if empty >= MAX_EMPTY_SETS:
                empty, places = 0, places + 1
                if places >= MAX_EMPTY_PLACES:
                    reasons = "; ".join(f"{why} ({n})" for why, n in self._left_out.most_common())
                    self._report_trouble(
                        HardwareError("the wand is not seen.", why=reasons, fix="look at the pictures, and try again")
                    )
                    break
                self.skip("nothing of it came about")
        return self.finish() if self.state.phase == "aim" and self.loop.calibration is not None else None

    @property
    def measured_live(self) -> Floats:
        """(3,) the middle of the wand by the live pictures; NaN where nobody knows."""
        state = self.state
        nowhere = np.full(3, np.nan)
        if state.calibration is None or not state.judgement.ready:
            return nowhere
        measured = state.calibration.measure(self._make_frame("live", _markers_in(state.looks)).observations)
        ends = [i for i, point in enumerate(measured.points) if str(point).rpartition("-")[2] in self.loop.wand.ends]
        middle = measured.xyz[ends].mean(axis=0)
        return np.asarray(middle, dtype=np.float64) if np.isfinite(middle).all() else nowhere

    # private

    def _too_few(self) -> UsageError:
        return UsageError(
            f"{self.loop.points} frames are too few to calibrate.",
            why=str(self.loop.problem.what) if self.loop.problem else "",
            fix=f"wave the wand where two cameras see both ends: {MIN_WHOLE_FRAMES} frames, and each camera in some",
        )

    def _report(self, path: Path, calibration: Calibration, data: Dataset) -> ReportData:
        assert isinstance(calibration, FromWand)
        held_out = calibration.hold_lengths_out()
        assert held_out is not None
        title, checksum = f"{self.session.name}: calibrated with a wand", calibration_file.checksum(calibration)
        said = report_of_lengths(calibration, held_out, title, checksum)
        write_report(path, said)
        return said

    def _aim(self, before: str = "") -> None:
        with self._loop_lock:
            (target,) = self.loop.ask()
        self._show(phase="aim", target=target, message=f"{before}{target.words}", problem=None)
        if self._hand is not None:
            self._hand.wave_at(target.uv)

    def _aims_anew(self, first: bool) -> bool:
        return True

    def _show_loop(self) -> None:
        super()._show_loop()
        self._show(
            cells=tuple(self.loop.cells()),
            lengths=describe_lengths(self.loop.lengths, self.loop.wand, self.equipment.unit),
            out_of_reach=self.loop.out_of_reach,
        )

    def _keep(self, looks: Sequence[Look]) -> None:
        """On disk first, then said."""
        seen = _markers_in(looks)
        name = self.session.next_name()
        try:
            self.session.accept(self._make_frame(name, seen))
            data = self.session.data
            assert data is not None
            with self._loop_lock:
                self.loop.tell(data)
                cells, cameras = tuple(self.loop.cells()), tuple(self.loop.camera_progress())
            self._kept = self._ends_of(seen)
            self._show(
                taken=self.state.taken + 1, data=data, cells=cells, cameras=cameras, stop=self.loop.stop,
                judgement=Judgement(False, ""),
            )  # fmt: skip
            self._fit_behind()
            if self.loop.waved_here:
                self._aim()
        except UsageError:
            raise
        except ImplicamError as error:
            self._report_trouble(error)
        except Exception as error:  # of a library: the session waits, and shows it
            self._report_unexpected(error)

    def _judge(self, looks: Sequence[Look]) -> Judgement:
        """Whether to keep these pictures; and count why not, where there is something to be kept."""
        now, seen = time.monotonic(), _markers_in(looks)
        ends = self._ends_of(seen)
        (then, before), self._before = self._before, (now, ends)
        why = self._refusal(looks, ends)
        if not why and self._each_when_it_likes and not self._simulated:
            times = [look.frame.taken for look in looks if look.camera in ends and look.frame is not None]
            apart = float(np.ptp(times)) + FREE_RUNNING_SECONDS
            if not _moved(before, ends) * apart / max(now - then, 1e-3) <= MAX_SLIP_PX:
                why = TOO_FAST
        if why:
            if any(look.found.notes.get("spots") or len(look.found) for look in looks):
                self._left_out[why] += 1
            return Judgement(False, why)
        if self._kept and not _moved(self._kept, ends, most=True) > MIN_MOVED_PX:
            return Judgement(False, "")
        return Judgement(True, "")

    def _refusal(self, looks: Sequence[Look], ends: Mapping[str, Floats]) -> str:
        if len(ends) >= MIN_CAMERAS:
            return ""
        notes = [look.found.notes for look in looks if not len(look.found)]
        if any("log_ratio" in one for one in notes):
            return UNTOLD
        if any(len(one.get("spots", ())) > 2 for one in notes):
            return CLUTTERED
        return FEW

    def _ends_of(self, seen: Mapping[str, Seen]) -> dict[str, Floats]:
        """Camera -> (2, 2) pixels of both ends."""
        a, b = self.loop.wand.ends
        return {
            camera: one.uv[[one.markers.index(a), one.markers.index(b)]]
            for camera, one in seen.items()
            if {a, b} <= set(one.markers)
        }

    def _detect_all(self, frames: Sequence[Frame], *, live: bool = False) -> tuple[Look, ...]:
        """As of every session, without what has not moved in the last pictures."""
        looks = super()._detect_all(frames, live=live)
        self._number += 1
        self._window.append((f"{self._number}", tuple(look.found for look in looks)))
        found = {
            View(look.camera, name): one
            for name, row in self._window
            for look, one in zip(looks, row, strict=True)
        }  # fmt: skip
        settled = self.equipment.detector.settle(found)
        ratios = [one.notes["log_ratio"] for _, row in self._window for one in row if "log_ratio" in one.notes]
        least = 0.5 * float(np.median(ratios)) if ratios else 0.0
        return tuple(
            replace(look, found=_surer(look.found, settled[View(look.camera, f"{self._number}")], least))
            for look in looks
        )

    def _make_frame(self, name: str, seen: Mapping[str, Seen]) -> Dataset:
        """What the cameras see, as the markers of one frame."""
        markers = sorted({marker for one in seen.values() for marker in one.markers})
        cameras: Sequence[Camera] = self.session.cameras
        uv, sd = (np.full((len(markers), len(cameras), 2), np.nan) for _ in range(2))
        for c, camera in enumerate(cameras):
            if camera.name in seen:
                rows = [markers.index(marker) for marker in seen[camera.name].markers]
                uv[rows, c], sd[rows, c] = seen[camera.name].uv, seen[camera.name].sd
        points = np.array([f"{name}-{marker}" for marker in markers])
        columns = {FRAME: np.full(len(markers), name), MARKER: np.array(markers)}
        observations = Observations(points, tuple(cameras), uv, sd)
        return Dataset(self.session.name, self.session.length_unit, observations, columns=columns)


def _surer(alone: Detected, settled: Detected, least: float) -> Detected:
    """What is sure of a picture: what does not move left out, or where all of a few pictures together leave it open
    which end is which (a wand that is waved near a camera), the picture alone, if its ends differ as much as usual."""
    if len(settled) or not len(alone) or alone.notes.get("log_ratio", least) < least:
        return settled
    return alone


def _markers_in(looks: Sequence[Look]) -> dict[str, Seen]:
    """Camera -> the markers in its picture, where it sees them by name."""
    found = {}
    for look in looks:
        if len(look.found):
            names = tuple(point.rpartition("-")[2] for point in look.found.points)
            found[look.camera] = Seen(names, look.found.uv, look.found.sd)
    return found


def _moved(before: Mapping[str, Floats], now: Mapping[str, Floats], *, most: bool = False) -> float:
    """Pixels that the ends have gone: in the median of the cameras, or in the one that shows it most; infinite where no
    camera shows it in both."""
    moved = [float(np.linalg.norm(now[c] - before[c], axis=1).max()) for c in now if c in before]
    return float(np.max(moved) if most else np.median(moved)) if moved else np.inf
