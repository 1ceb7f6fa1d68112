"""The loop with a wand: where to wave next, and when it is enough.

loop = WandLoop(ForwardGP(wand=500), Wand(length=500), cameras, rule=Below(0.3, "usual") | Pictures(1000, "frames"))
while not loop.stop:
    (target,) = loop.ask()
    loop.tell(...)                    # all frames so far; now and then loop.reset(...), which fits
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from implicam.active.board_loop import CameraProgress
from implicam.active.design_model import PredictedCovariance
from implicam.active.loop import Target, summarise_step
from implicam.active.stopping import Below, Never, Rule, Step, parts_of
from implicam.active.wand_coverage import (
    WAVED_FRAMES,
    Cells,
    WaveDesign,
    WavePlace,
    ends_of,
    unknown_cells,
    unseen_place,
)
from implicam.active.workspace import Workspace
from implicam.calibrators import (
    Calibration,
    Calibrator,
    FromWand,
    LengthsHeldOut,
    PredictsPixels,
    RigCalibration,
)
from implicam.dataset import Camera, Dataset, Floats
from implicam.dataset.wand import Wand
from implicam.errors import FitError, ImplicamError, UsageError
from implicam.formatting import decimal_number, percent
from implicam.progress import Progress, silent
from implicam.threads import blas_threads

MIN_WHOLE_FRAMES = 30
"""In which two cameras have seen both ends, before a fit is worth its time."""

MIN_ENOUGH_FRAMES = 50
"""Fewer are never enough: a third of them, held out, says little."""

MIN_GROWTH, MIN_MORE_FRAMES = 1.1, 5
"""From one fit to the next there are so many times as many frames, and so many more."""

COLD_FRAMES = 8
"""After so many, a camera that is not calibrated is shown another part of its picture."""


@dataclass(frozen=True, eq=False)
class WaveTarget(Target):
    """Where to wave next. xyz: NaN where no calibration says where that is.

    Attributes:
        words: "lower left of cam3, 1200 mm from it".
        why: What is missing there.
    """

    words: str = ""
    why: str = ""


class WaveFit(NamedTuple):
    """What a fit to all frames so far has found.

    Attributes:
        calibration: The rig.
        design: What it knows of the volume; None where hardly anything is seen by two cameras.
        places: Where to wave next, the best first.
        held_out: Lengths of the wand in frames that a fit did not know; None where it was too early.
        faults: What speaks against the calibration, in sentences.
    """

    calibration: Calibration
    design: WaveDesign | None
    places: tuple[WavePlace, ...]
    held_out: LengthsHeldOut | None
    faults: tuple[str, ...]


def judge_waving(
    calibration: Calibration,
    wand: Wand,
    volume: Workspace | None = None,
    *,
    target: float = float("nan"),
    seed: int = 0,
    count: int = 4,
    avoided: Sequence[Floats] = (),
    progress: Progress = silent,
) -> WaveFit:
    """Was it waved enough, and where not?

    Args:
        calibration: From a wand.
        wand: As it was waved.
        volume: Where positions have to be good, in the frame of the calibration; None for the box about where the
            wand was, as far as two cameras see it.
        target: The 95 % uncertainty that is enough there; NaN where only the noise says what is.
        seed: Of the places that are tried and judged.
        count: How many places are named.
        avoided: (3,) places, near which nobody can or wants to go.
        progress: Called as it goes on.
    """
    held_out: LengthsHeldOut | None = None
    faults: tuple[str, ...] = ()
    if isinstance(calibration, FromWand):
        wand = calibration.wand or wand
        with suppress(FitError):  # then that is among the faults
            held_out = calibration.hold_lengths_out()
        faults = tuple(finding.reason for finding in calibration.find_faults(progress))
    design: WaveDesign | None = None
    places: tuple[WavePlace, ...] = ()
    if isinstance(calibration, PredictsPixels):
        with suppress(UsageError, np.linalg.LinAlgError), blas_threads(1):
            design = WaveDesign.of(calibration, wand, volume, target=target, seed=seed)
            places = tuple(design.next_places(count, seed=len(calibration.data), avoided=avoided))
    return WaveFit(calibration, design, places, held_out, faults)


def describe_lengths(held_out: LengthsHeldOut | None, wand: Wand, unit: str) -> str:
    """What the lengths that were held out say: "held-out lengths 499.98 ± 0.12 mm".

    Args:
        held_out: They; None for none.
        wand: Its length.
        unit: Of lengths.
    """
    if held_out is None or not len(held_out.errors):
        return ""
    spread = float(np.sqrt(np.mean(held_out.errors**2)))
    digits = int(np.clip(1 - np.floor(np.log10(max(spread, 1e-9))), 0, 6))
    mean = wand.length + float(np.mean(held_out.errors))
    stated = float(np.sqrt(np.mean(held_out.sds**2)))
    return (
        f"held-out lengths {mean:.{digits}f} ± {spread:.{digits}f} {unit} ({len(held_out.errors)} frames that a fit "
        f"did not know; its error bars say ± {stated:.{digits}f})"
    )


def describe_reach(design: WaveDesign, unit: str) -> str:
    """That no waving reaches what is wanted, because pixel noise alone leaves more; empty where it may.

    Args:
        design: With its target.
        unit: Of lengths.
    """
    if not np.isfinite(design.target):
        return ""
    floor = design.at_judged.floor
    left = float(np.nanquantile(PredictedCovariance(floor, lambda: floor).u95, 0.95))
    if left <= design.target:
        return ""
    return (
        f"Pixel noise alone leaves {decimal_number(left, 2)} {unit} in 95 % of the volume: no waving reaches "
        f"{decimal_number(design.target, 2)} {unit}. Sharper pictures, larger balls, or cameras that are nearer do."
    )


@dataclass(eq=False)
class WandLoop:
    """Guided waving; it changes with what it is told.

    Attributes:
        calibrator: The method, which knows the wand: `forward-gp`.
        wand: Its ends and its length.
        cameras: Those that look at it, with the size of their pictures.
        volume: Where positions have to be good, in the frame of the first camera; None for the box about where the
            wand was, as far as two cameras see it.
        rule: When to stop, once all cameras are calibrated.
        seed: Of the places that are tried and judged.
        data: All frames so far; None for none.
        history: One step for each fit: the uncertainty over the volume.
        fitted: What the last fit has found; None before there is one.
        problem: Why the last fit failed; None where it did not.
    """

    calibrator: Calibrator
    wand: Wand
    cameras: tuple[Camera, ...]
    volume: Workspace | None = None
    rule: Rule = field(default_factory=Never)
    seed: int = 0
    data: Dataset | None = None

    def __post_init__(self) -> None:
        self.history: list[Step] = []
        self.fitted: WaveFit | None = None
        self.problem: ImplicamError | None = None
        self.start = MIN_WHOLE_FRAMES
        self._started = time.monotonic()
        self._refused: list[Floats] = []
        self._fitted = 0  # frames of the last fit
        self._ends: tuple[Dataset, Floats] | None = None  # they are asked for often
        self._asked, self._waved = 0, 0  # how often; frames there were when the present place was asked for
        if self.data is not None:
            self.reset(self.data)

    # what a session and its page ask of any loop

    @property
    def calibration(self) -> Calibration | None:
        """The last fit; None before there is one."""
        return None if self.fitted is None else self.fitted.calibration

    @property
    def design(self) -> WaveDesign | None:
        """What it knows of the volume."""
        return None if self.fitted is None else self.fitted.design

    @property
    def stop(self) -> str:
        """Why to stop, in words; empty where not yet, where a camera is not calibrated, or where lengths that were held
        out say that the error bars are wrong."""
        if self.data is None:
            return ""
        unit = self.data.length_unit
        early = self._fitted < MIN_ENOUGH_FRAMES
        found = "" if early or self._cold() or self._faults else self.rule.met(self.history, unit)
        passed = Step(self.points, seconds=time.monotonic() - self._started)
        return found or self.rule.met([*self.history, passed], unit)

    @property
    def _faults(self) -> tuple[str, ...]:
        return () if self.fitted is None else self.fitted.faults

    @property
    def contradictions(self) -> tuple[str, ...]:
        """What lengths that were held out say against the last fit, in sentences."""
        return self._faults

    @property
    def forecast(self) -> bool:
        """Never: numbers are those of a fit."""
        return False

    @property
    def points(self) -> int:
        """In how many frames two cameras have seen both ends."""
        return int(_whole(self.ends).sum())

    @property
    def predicted(self) -> PredictedCovariance | None:
        """The covariance at the judged places; None before there is a calibration."""
        return None if self.design is None else self.design.at_judged

    @property
    def judged_at(self) -> Floats:
        """(g, 3) the judged places, in the frame of the calibration."""
        return np.zeros((0, 3)) if self.design is None else self.design.judged.xyz

    @property
    def workspace(self) -> Workspace:
        """The volume in which positions have to be good; about a wand before there is any."""
        if self.design is not None and self.volume is None:
            xyz = self.design.judged.xyz
            return Workspace.box(xyz.min(axis=0), xyz.max(axis=0))
        if self.volume is not None:
            placed = None if self.calibration is None else self._volume_of(self.calibration)
            return placed or self.volume
        size = self.wand.length
        return Workspace.box([-size, -size, size], [size, size, 3 * size])

    @property
    def ends(self) -> Floats:
        """(F, 2, cameras, 2) pixels of both ends in all frames; NaN where not seen."""
        return np.zeros((0, 2, len(self.cameras), 2)) if self.data is None else self._ends_in(self.data)

    def _ends_in(self, data: Dataset) -> Floats:
        kept = self._ends
        if kept is None or kept[0] is not data:
            kept = self._ends = data, ends_of(data, self.wand)
        return kept[1]

    @property
    def lengths(self) -> LengthsHeldOut | None:
        """Lengths of the wand in frames that a fit did not know; None where there are none."""
        return None if self.fitted is None else self.fitted.held_out

    @property
    def out_of_reach(self) -> str:
        """That no waving reaches what is wanted, because pixel noise alone leaves more; empty where it may."""
        if self.fitted is None or self.fitted.design is None or self.data is None:
            return ""
        return describe_reach(self.fitted.design, self.data.length_unit)

    def refuse(self, xyz: Floats, reason: str) -> None:
        """Another place is asked for instead of this one.

        Args:
            xyz: (3,) where it was to be.
            reason: Why, in words.
        """
        self._refused.append(xyz)

    def reset(self, data: Dataset | None, progress: Progress = silent) -> None:
        """Go on with these frames, and fit.

        Args:
            data: All frames from now on; None for none.
            progress: Called as the fit goes on.
        """
        self.data = data
        self.adopt(data, self.fit(data, progress))

    def wants_fit(self, data: Dataset) -> bool:
        """Whether a fit to these frames is worth its time: there are enough, and a good part more than at the last.

        Args:
            data: All frames.
        """
        points = int(_whole(self._ends_in(data)).sum())
        return points >= MIN_WHOLE_FRAMES and points >= MIN_GROWTH * self._fitted + MIN_MORE_FRAMES

    def tell(self, data: Dataset) -> None:
        """More frames, without a fit.

        Args:
            data: All frames.
        """
        self.data = data

    def fit(self, data: Dataset | None, progress: Progress = silent) -> WaveFit | ImplicamError | None:
        """What these frames say of the rig, of the volume, and against themselves; nothing of the loop changes.

        Args:
            data: All frames; None for none.
            progress: Called as the fit goes on.

        Returns:
            What was found, why nothing was, or None where it is too early.
        """
        if data is None or _whole(ends_of(data, self.wand)).sum() < MIN_WHOLE_FRAMES:
            return None
        try:
            calibration = self.calibrator.fit(data, progress)
        except FitError as error:
            return error
        volume = self._volume_of(calibration)
        return judge_waving(
            calibration, self.wand, volume, target=self._target, seed=self.seed, avoided=self._refused,
            progress=progress,
        )  # fmt: skip

    def adopt(self, data: Dataset | None, found: WaveFit | ImplicamError | None) -> None:
        """Take what `fit` gave.

        Args:
            data: The frames that it was fitted to; others may have come meanwhile.
            found: What it gave.
        """
        self.problem = found if isinstance(found, ImplicamError) else None
        self.fitted = None if isinstance(found, ImplicamError) else found
        self._asked = 0
        points = self._fitted = 0 if data is None else int(_whole(self._ends_in(data)).sum())
        self.history = [step for step in self.history if step.points < points]
        if self.predicted is not None:
            self.history.append(summarise_step(self.predicted, points, time.monotonic() - self._started))

    # where to wave next

    @property
    def waved_here(self) -> bool:
        """Whether the present place has had its share of frames."""
        enough = COLD_FRAMES if self.fitted is None or not self.fitted.places else WAVED_FRAMES
        return self.points - self._waved >= enough

    def ask(self, number: int = 1, here: Floats | None = None) -> list[WaveTarget]:
        """Where to wave next.

        Args:
            number: One is all there is.
            here: Not used.
        """
        self._waved, name = self.points, f"p{self.points + 1:03d}"
        cold = self._cold()
        places = () if self.fitted is None else self.fitted.places
        if places and not (cold and self._asked % 2):  # cameras that are not calibrated yet have every other turn
            found = places[min(self._asked, len(places) - 1)]
        else:
            cells, among = self.cells(), cold or list(range(len(self.cameras)))
            c = min(among, key=lambda c: float(np.nanmean(cells[c].known)))
            found = unseen_place(self.cameras, cells, c)
        self._asked += 1
        return [WaveTarget(name, found.xyz, found.uv, found.gain, found.words, found.why)]

    def cells(self) -> list[Cells]:
        """The picture of each camera in cells, in the order of the cameras."""
        ends, cold = self.ends, self._cold()
        return [self._cells_of(c, ends[:, :, c].reshape(-1, 2), c in cold) for c in range(len(self.cameras))]

    def camera_progress(self) -> list[CameraProgress]:
        """How far each camera is, in the order of the dataset."""
        ends, cold = self.ends, self._cold()
        found = []
        for c, cells in enumerate(self.cells()):
            seen = int(np.isfinite(ends[:, :, c, 0]).all(axis=1).sum())
            part = float(np.nanmean(cells.known)) if np.isfinite(cells.known).any() else 0.0
            if c in cold or self.design is None:
                filled = int((cells.known >= 1).sum())
                words = f"{filled} of {cells.known.size} parts of its picture seen"
                if filled == cells.known.size and self.calibration is not None:
                    words = "sees the wand together with too few others"
                part *= 0.5
            else:
                enough = cells.known[np.isfinite(cells.known)] >= 1 - 1e-9
                words = f"known in {percent(float(enough.mean()))} of what it sees" if len(enough) else "sees nothing"
                part = 0.5 + 0.5 * part
            found.append(CameraProgress(part, seen, words))
        return found

    # private

    def _cells_of(self, c: int, uv: Floats, cold: bool) -> Cells:
        camera = self.cameras[c]
        assert camera.width is not None  # as a session has all
        assert camera.height is not None
        size = camera.width, camera.height
        if cold or self.fitted is None or self.fitted.design is None:
            return unknown_cells(uv, size)
        return self.fitted.design.cells(c, uv, size)

    def _cold(self) -> list[int]:
        """The cameras that are not calibrated."""
        known = self.calibration.camera_names if isinstance(self.calibration, PredictsPixels) else ()
        return [c for c, camera in enumerate(self.cameras) if camera.name not in known]

    @property
    def _target(self) -> float:
        return next((one.value for one in parts_of(self.rule) if isinstance(one, Below)), float("nan"))

    def _volume_of(self, calibration: Calibration) -> Workspace | None:
        """The volume in the frame of a calibration; None where nobody has said which, or its camera is not known."""
        first = self.cameras[0].name
        if self.volume is None or not isinstance(calibration, RigCalibration) or first not in calibration.camera_names:
            return None
        pose = calibration.cameras[first].camera_from_world
        return None if pose is None else Workspace.hull(pose.inverse().apply(self.volume.vertices))


def _whole(ends: Floats) -> Floats:
    """(F,) frames in which two cameras have seen both ends."""
    return np.asarray(np.isfinite(ends).all(axis=(1, 3)).sum(axis=1) >= 2)
