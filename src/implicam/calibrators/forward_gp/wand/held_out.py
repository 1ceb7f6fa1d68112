"""Lengths of a wand in frames that the cameras were not fitted to: the only proof that a wave itself can give."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from implicam.calibrators.forward_gp.wand.fitted import STATED, describe_offsets
from implicam.calibrators.protocol import LengthsHeldOut
from implicam.dataset.scale_bars import in_one_line
from implicam.dataset.wand import FRAME, MARKER, marker_rows
from implicam.derived import distances
from implicam.errors import FitError
from implicam.mistakes import Finding
from implicam.progress import Progress

if TYPE_CHECKING:
    from implicam.calibrators.forward_gp.calibration import ForwardGPCalibration

FOLDS = 3
MIN_FRAMES = 20
"""Frames with both markers, below which error bars have been found too small, and nothing can be held out."""

MIN_LENGTHS = 6
"""Held-out lengths that are enough to judge by."""

MAX_MEAN_SQUARE, UNUSABLE_MEAN_SQUARE = 2.5, 20.0
"""Of the errors of held-out lengths in their sds, without the worst twentieth: 0.8 is right. Above the first error bars
are doubtful, above the second they are nothing."""

TRIMMED_SHARE = 0.05


def hold_lengths_out(calibration: ForwardGPCalibration, progress: Progress) -> LengthsHeldOut:
    """Fit again without a third of the frames, and measure the wand there.

    Args:
        calibration: From a wand.
        progress: Is told that it is checked.

    Raises:
        FitError: Without these frames there is no calibration.
    """
    assert calibration.waved is not None
    wand, data = calibration.waved.wand, calibration.data
    markers = replace(data, known=None, columns={name: data.positions.extra[name] for name in (FRAME, MARKER)})
    if calibration.waved.known:
        markers = markers.select(data.positions.extra[STATED[0]] == "")
    _, rows = marker_rows(markers, wand.ends)
    whole = np.flatnonzero((rows >= 0).all(axis=1))
    held = np.random.default_rng(0).permutation(whole)[: len(whole) // FOLDS]
    out = np.zeros(len(markers), dtype=np.bool_)
    out[rows[held].ravel()] = True
    progress("checking", 0, 1)
    again = calibration.calibrator.fit(markers.select(~out))
    measured = again.measure(markers.observations)
    pairs = [(int(a), int(b)) for a, b in rows[held] if measured.measured[[a, b]].all()]
    found = distances(measured, pairs) if pairs else []
    progress("checking", 1, 1)
    return LengthsHeldOut(
        f"both ends of the wand in {len(pairs)} frame{'s' * (len(pairs) != 1)} held out",
        np.array([one.value - wand.length for one in found]),
        np.array([np.hypot(one.sd, wand.jitter) for one in found]),
    )


MIN_BARS = 3
"""Scale bars of which a third can be left out."""


def hold_bars_out(calibration: ForwardGPCalibration, progress: Progress) -> LengthsHeldOut | None:
    """Fit again without a third of the scale bars, and measure these; None of fewer than three that are used.

    Args:
        calibration: From points and scale bars.
        progress: Is told that it is checked.

    Raises:
        FitError: Without these there is no calibration.
    """
    assert calibration.waved is not None
    data = replace(calibration.data, known=None)
    points = set(map(str, data.points))
    bars = [bar for bar in calibration.waved.bars if {bar.a, bar.b} <= points]
    bars = [bar for bar in bars if str(bar) not in calibration.waved.rejected_lengths]
    if len(bars) < MIN_BARS:
        return None
    order = np.random.default_rng(0).permutation(len(bars))
    held, kept = ([bars[i] for i in part] for part in np.split(order, [len(bars) // FOLDS]))
    progress("checking", 0, 1)
    again = replace(calibration.calibrator, scale_bars=in_one_line(kept)).fit(data)
    measured = again.measure(data.observations)
    row = {str(name): i for i, name in enumerate(measured.points)}
    pairs = [(bar, (row[bar.a], row[bar.b])) for bar in held]
    there = [(bar, pair) for bar, pair in pairs if measured.measured[list(pair)].all()]
    found = distances(measured, [pair for _, pair in there]) if there else []
    progress("checking", 1, 1)
    usual = calibration.calibrator.settings.usual_wand_jitter_ratio
    return LengthsHeldOut(
        f"{len(there)} scale bar{'s' * (len(there) != 1)} held out",
        np.array([one.value - bar.length for one, (bar, _) in zip(found, there, strict=True)]),
        np.array([np.hypot(one.sd, bar.sd or usual * bar.length) for one, (bar, _) in zip(found, there, strict=True)]),
    )


def _faults_of_bars(calibration: ForwardGPCalibration, progress: Progress) -> Iterator[Finding]:
    assert calibration.waved is not None
    if len(calibration.data) < MIN_POINTS:
        yield Finding(
            False,
            f"{len(calibration.data)} points only are where three cameras check each other: show them more, in all of "
            "their pictures, near and far.",
        )
    try:
        held_out = calibration.hold_lengths_out(progress)
    except FitError as error:
        yield Finding(False, f"Without a third of the scale bars there is no calibration ({error.what}).")
        return
    if held_out is None or not len(held_out.errors):
        return
    worst = float(np.max(np.abs(held_out.errors / held_out.sds)))
    if worst > MAX_BAR_SDS:
        rms, stated = (float(np.sqrt(np.mean(v**2))) for v in (held_out.errors, held_out.sds))
        yield Finding(
            False,
            f"Scale bars that a fit did not know come out {rms:.3g} {calibration.data.length_unit} off (rms), where "
            f"the error bars say {stated:.3g}: are they as exact as is stated (sd), and are their ends the points?",
        )


MIN_POINTS = 40
"""Points that three cameras see, below which a rig is known by little."""

MAX_BAR_SDS = 4.0
"""Of a scale bar that was held out."""


def find_faults(calibration: ForwardGPCalibration, progress: Progress) -> Iterator[Finding]:
    """What speaks against a calibration from a wand.

    Args:
        calibration: From a wand.
        progress: Is told that it is checked.
    """
    assert calibration.waved is not None
    if calibration.waved.bars:
        yield from _faults_of_bars(calibration, progress)
        return
    used, unit = len(calibration.waved.errors), calibration.data.length_unit
    for text in describe_offsets(calibration.waved):
        yield Finding(False, f"{text}.")
    if used < MIN_FRAMES:
        yield Finding(
            False,
            f"The length of the wand is used in {used} frames only, and error bars are too small where it is so few: "
            "wave it longer where two cameras see both markers, 50 frames or more.",
        )
        return
    try:
        held_out = calibration.hold_lengths_out(progress)
        assert held_out is not None
    except FitError as error:
        yield Finding(False, f"Without a third of the frames there is no calibration ({error.what}): wave it longer.")
        return
    if len(held_out.errors) < MIN_LENGTHS:
        yield Finding(
            False,
            f"Of the frames that were held out, {len(held_out.errors)} could be measured by a fit without them: the "
            "cameras do not agree on where they are. Do both markers keep their names in all cameras, and do all "
            "cameras expose at the same instant?",
        )
        return
    squares = np.sort((held_out.errors / held_out.sds) ** 2)
    mean = float(squares[: len(squares) - max(1, int(TRIMMED_SHARE * len(squares)))].mean())
    if mean > MAX_MEAN_SQUARE:
        rms, stated = (float(np.sqrt(np.mean(v**2))) for v in (held_out.errors, held_out.sds))
        yield Finding(
            mean > UNUSABLE_MEAN_SQUARE,
            f"In {len(squares)} frames that a fit did not know, the wand comes out {rms:.3g} {unit} off (rms), where "
            f"the error bars say {stated:.3g}: are both markers always the same two, do all cameras expose at the "
            "same instant, is the wand stiff (--wand-jitter)?",
        )
