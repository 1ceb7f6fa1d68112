"""What a calibration knows of positions in a volume: what the designs of experiments at unknown places have in common.

Near what a calibration knows, its cameras are linear in what it does not: pixels are off by `half z`, z standard normal
(`Sensitivity`), so positions measured in the volume are off by `moved z`, beside what their own noise does.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np

from implicam.active.design_model import Bools, Places, PredictedCovariance
from implicam.calibrators import PredictsPixels
from implicam.dataset import Floats
from implicam.errors import UsageError

MAX_EXCESS_PART = 0.66
"""Of a camera's noise: what may be unknown of its pixels where calibration leaves positions within 1.2 of the noise."""


class LinearViews(NamedTuple):
    """Of n positions: slope (n, R, 3), half (n, R, q), sd (n, R) and seen (n, R), R = 2 cameras."""

    slope: Floats
    half: Floats
    sd: Floats
    seen: Bools


def linear_views(rig: PredictsPixels, xyz: Floats, seen: Bools) -> LinearViews:
    """All calibrated cameras at once, in the order of the dataset's; nothing seen by those that are not.

    Args:
        rig: A calibration that predicts pixels.
        xyz: (n, 3) positions in its frame.
        seen: (n, cameras) which cameras look at them.
    """
    parts = rig.sensitivities(xyz)
    R, unknowns = 2 * len(rig.trained.cameras), [part.half.shape[2] for part in parts]
    slope, half = np.zeros((len(xyz), R, 3)), np.zeros((len(xyz), R, sum(unknowns)))
    variance, there = np.ones((len(xyz), R)), np.zeros((len(xyz), R), dtype=np.bool_)
    start = 0
    for part, q in zip(parts, unknowns, strict=True):
        rows = np.array([[2 * c, 2 * c + 1] for c in part.cameras]).ravel()
        good: Bools = np.asarray(np.isfinite(part.slope).all(axis=2) & np.isfinite(part.half).all(axis=2))
        slope[:, rows] = np.where(good[..., None], part.slope, 0)
        half[:, rows, start : start + q] = np.where(good[..., None], part.half, 0)
        variance[:, rows] = np.where(good, part.noise + part.rest, 1.0)  # NaN where a lens has no answer
        there[:, rows] = good & seen[:, list(part.cameras)].repeat(2, axis=1)
        start += q
    return LinearViews(slope, half, np.sqrt(variance), there)


@dataclass(frozen=True, eq=False)
class VolumeDesign:
    """What a calibration knows of a volume.

    Attributes:
        rig: A calibration that predicts pixels; in its frame is all that follows.
        judged: Where positions have to be good, g places.
        spread: (q, k) of what is unknown now: z = spread z', z' standard normal.
        frame_is_free: Whether the calibration is in no world, only in the frame of a camera: then the rigid motion that
            fits errors best over the volume is taken out of them (an S-transformation: Baarda 1973).
        weighs_cameras: Whether measuring weighs views by what is unknown of their cameras, too, and not by noise alone.

    Raises:
        UsageError: Fewer than four of the judged places are seen by two cameras or more.
    """

    rig: PredictsPixels
    judged: Places
    spread: Floats | None = None

    frame_is_free: ClassVar[bool] = False
    weighs_cameras: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if self._counted.sum() < 4:
            raise UsageError(
                "the volume is hardly seen by two cameras.",
                why=f"{int(self._counted.sum())} of {len(self.judged)} places of it are",
                fix="give another --workspace, in the frame of the first camera; or aim the cameras at one volume",
            )

    @cached_property
    def _at_judged(self) -> LinearViews:
        return linear_views(self.rig, self.judged.xyz, self.judged.seen)

    @cached_property
    def _counted(self) -> Bools:
        """(g,) which places two cameras or more see."""
        return np.asarray(self._at_judged.seen.sum(axis=1) >= 4)

    @cached_property
    def _noise_alone(self) -> Floats:
        """(g, 3, 3) the covariance that pixel noise leaves."""
        there = self._at_judged
        whitened = there.slope / there.sd[..., None] * there.seen[..., None]
        found = np.full((len(self.judged), 3, 3), np.nan)
        good = self._counted
        found[good] = np.linalg.inv(whitened[good].swapaxes(1, 2) @ whitened[good])
        return found

    @cached_property
    def _pull(self) -> Floats:
        """(k, 3, R) by what a counted place is off, by what each pixel is off."""
        there, good = self._at_judged, self._counted
        slope = there.slope[good] * there.seen[good][..., None]
        if not self.weighs_cameras:
            weighted = slope / there.sd[good][..., None] ** 2
            return np.asarray(self._noise_alone[good] @ weighted.swapaxes(1, 2), dtype=np.float64)
        half = np.where(there.seen[good][..., None], there.half[good] @ self._spread, 0.0)
        S = half @ half.swapaxes(1, 2) + there.sd[good][..., None] ** 2 * np.eye(there.sd.shape[1])
        pull = np.linalg.solve(S, slope)
        return np.asarray(np.linalg.solve(slope.swapaxes(1, 2) @ pull, pull.swapaxes(1, 2)), dtype=np.float64)

    @cached_property
    def _moved(self) -> tuple[Floats, Floats]:
        """(k, 3, q) by what the counted places are off, rigid motion taken out where the frame is free; and (k, 3, q)
        that motion."""
        there, good = self._at_judged, self._counted
        half = np.where(there.seen[good][..., None], there.half[good], 0.0)
        moved = self._pull @ half
        if not self.frame_is_free:
            return moved, np.zeros_like(moved)
        motion = np.linalg.qr(_rigid_motions(self.judged.xyz[good]))[0]
        flat = moved.reshape(-1, moved.shape[2])
        rigid = motion @ (motion.T @ flat)
        return (flat - rigid).reshape(moved.shape), rigid.reshape(moved.shape)

    @property
    def _spread(self) -> Floats:
        if self.spread is not None:
            return self.spread
        return np.eye(self._at_judged.half.shape[2])

    @cached_property
    def at_judged(self) -> PredictedCovariance:
        """The covariance of measuring at the judged places, in the frame that fits them best where it is free."""
        total = np.full((len(self.judged), 3, 3), np.nan)
        off = self._moved[0] if self.spread is None else self._moved[0] @ self.spread
        own = self._pull * self._at_judged.sd[self._counted][:, None]
        total[self._counted] = own @ own.swapaxes(1, 2) + off @ off.swapaxes(1, 2)
        return PredictedCovariance(total, lambda: self._noise_alone)

    @cached_property
    def _unknown_pixels(self) -> Floats:
        """(g, cameras) what is unknown of each camera at each place, in its pixels, over its noise, squared; NaN where
        it does not see it."""
        there, good = self._at_judged, self._counted
        off = there.half[good] - there.slope[good] @ self._moved[1]  # in the frame that fits the volume best
        if self.spread is not None:
            off = off @ self.spread
        variance = np.full(there.sd.shape, np.nan)
        variance[good] = np.where(there.seen[good], np.sum(off**2, axis=2) / there.sd[good] ** 2, np.nan)
        return np.asarray(variance.reshape(len(variance), -1, 2).mean(axis=2), dtype=np.float64)

    def pixel_sd(self) -> Floats:
        """What is unknown of each camera, in its pixels, over its noise: what calibration adds to what it sees.

        Returns:
            (cameras,) rms over the judged places that it sees; NaN for a camera that is not calibrated.
        """
        found = np.full(self._unknown_pixels.shape[1], np.nan)
        used = np.isfinite(self._unknown_pixels).any(axis=0)
        found[used] = np.sqrt(np.nanmean(self._unknown_pixels[:, used], axis=0))
        return found


def _rigid_motions(xyz: Floats) -> Floats:
    """(3 n, 6) by what points move with a small turn and shift of all of them."""
    centred = xyz - xyz.mean(axis=0)
    turns = np.stack([np.cross(axis, centred) for axis in np.eye(3)], axis=2)
    shifts = np.broadcast_to(np.eye(3), (len(xyz), 3, 3))
    return np.concatenate([turns, shifts], axis=2).reshape(-1, 6)
