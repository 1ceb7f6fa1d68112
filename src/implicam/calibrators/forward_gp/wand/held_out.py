"""Lengths of a wand in frames that the cameras were not fitted to: the only proof that a wave itself can give."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from implicam.calibrators.forward_gp.wand.fitted import STATED, describe_offsets
from implicam.calibrators.protocol import LengthsHeldOut
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


def find_faults(calibration: ForwardGPCalibration, progress: Progress) -> Iterator[Finding]:
    """What speaks against a calibration from a wand.

    Args:
        calibration: From a wand.
        progress: Is told that it is checked.
    """
    assert calibration.waved is not None
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
