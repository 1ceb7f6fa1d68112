"""Is a calibration to be used? A verdict in words, with the reasons and their cures.

The leave-one-out formula uses the fit that it belongs to, and shares its mistakes: it once gave 0.0007 mm where the
errors were 13 mm. So the method is fitted again from no guess without a part of the known points, a few times, and
measures those. The data are checked as well: wrong views, noise, copies, marks.

"usable": nothing speaks against it. "doubtful": measure, but look at the reasons first. "not usable": its numbers are
worse than none.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc, chdtri, fdtrc

from implicam.calibrators import Calibration, PredictsPixels
from implicam.calibrators.protocol import CheckPlan, FindsFaults
from implicam.dataset import Dataset, Floats, describe_copies, find_copies
from implicam.dataset.marks import remove_marks
from implicam.errors import ImplicamError, UsageError
from implicam.evaluation import known_position_covariance
from implicam.formatting import percent
from implicam.mistakes import Finding, find_mistakes, row_finding
from implicam.progress import Progress, silent
from implicam.rig_model.training_data import stated_noise
from implicam.row_order import describe_change, describe_moved_camera

USABLE, DOUBTFUL, NOT_USABLE = "usable", "doubtful", "not usable"

MIN_QUADRIC_RMS = 0.05
"""Rms of the best quadratic equation at known points, in coordinates of unit variance: with 14 or more points all over
less was never seen in 2000 draws, two planes good to a hundredth of their distance have 0.03."""

MIN_RECOMMENDED_POINTS = 12
"""Fewer known points fix a rig, but leave too little to check it by."""

MIN_ROBUST_POINTS = 17
"""From so many on, a fit that fails without a fifth of them says nothing, unless most such fits fail."""

FLAT_RATIO = 0.01
"""Thickness over width of known points that are nearly on a plane, or a line: beyond it nothing is known."""

MAX_REJECTED_SHARE, USUAL_WRONG_SHARE = 0.3, 0.15
"""Share of a camera's views that contradict the others beyond which it is not the views; share that is usual."""

MAX_CHANCE_PROBABILITY = 1e-4
"""A share is beyond the usual where chance would show it so rarely."""

MAX_RESIDUAL_SDS = 4.0
"""Median error of a camera at its own known points, in its stated noise; 1.2 is right."""

MAX_RESIDUAL_RATIO, MIN_UNLIKE_RESIDUAL_PX = 10.0, 2.0
"""The same where no noise is stated: in the median error of the other cameras, and at least so many pixels."""

MIN_MOVE_SHARE, MIN_VIEWS_IN_PART = 0.5, 4
"""Share of a camera's residuals that a move explains at least: a lens that is not quite understood leaves some that
depend on the place, and so on the order of a lattice. Views before and after a move."""

MAX_NEES, UNUSABLE_NEES = 7.0, 60.0
"""Mean NEES of held-out points, 3 is right, above which error bars are doubtful, and above which they are nothing."""

USUAL_OUTSIDE_SHARE = 0.15
"""Share of the held-out points outside of their 95 % ellipsoids that is usual: 5 %, and wrong views."""

TRIMMED_SHARE = 0.05
"""Share of the held-out points, the worst and at least one, that do not count: of two views one may be wrong."""

MAX_POINTS_FOR_FIVE_FOLDS = 25
"""Up to so many, a fit without a third of the points would be another calibration: a fifth is left out."""

MIN_JUDGED_POINTS = 6
"""Held-out points that are enough to judge by."""

MAX_RELATIVE_RMS = 0.3
"""rms error of held-out points, in the rms distance of the known points from their middle, that is no measurement."""


NOTHING_LEARNED_RELATIVE_RMS = 0.8
"""The same, above which nothing was learned, whatever the error bars say: the middle of the known points, guessed for
all, is off by 1."""


@dataclass(frozen=True)
class HeldOut:
    """Known points measured by fits that had not seen them; lengths in the dataset's unit.

    Attributes:
        points: How many were measured with all their views.
        rms: Their root mean square error in 3D.
        stated: What the error bars say it should be.
        nees: Mean of e' C^-1 e without the worst `TRIMMED_SHARE`; near 2.6 is right.
        inside: The share in their 95 % ellipsoids.
        contradicting: The share of all held-out points whose views contradict each other.
        how: How they were held out, in words.
    """

    points: int
    rms: float
    stated: float
    nees: float
    inside: float
    contradicting: float
    how: str


@dataclass(frozen=True)
class Verdict:
    """Whether a calibration is to be used.

    Attributes:
        word: "usable", "doubtful" or "not usable".
        reasons: Sentences with their cures, the gravest first.
        held_out: Known points that were held out; None where none could be.

    >>> import implicam as ic
    >>> ic.Verdict("usable", ()).word
    'usable'
    """

    word: str
    reasons: tuple[str, ...]
    held_out: HeldOut | None = None

    def as_table(self) -> dict[str, Any]:
        """Plain values, for a calibration file or JSON."""
        table: dict[str, Any] = {"word": self.word, "reasons": list(self.reasons)}
        if self.held_out is not None:
            table["held_out"] = asdict(self.held_out)
        return table


def judge(calibration: Calibration, progress: Progress = silent) -> Verdict:
    """Judge a calibration by its known points: a few fits without some of them, and what the data show.

    Args:
        calibration: The calibration.
        progress: Called before each fit.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> calibration = ic.ForwardGP().fit(rig)
    >>> isinstance(ic.judge(calibration), ic.Verdict)
    True
    """
    held_out, failed = _held_out(calibration, progress)
    sds = list(_of_stated_sds(calibration))
    cure = _SDS if _declared(calibration.data) and not sds else _LOOK
    findings = [*failed, *_of_held_out(held_out, calibration, cure), *sds, *_of_data(calibration.data)]
    findings += _of_surface(calibration)
    if isinstance(calibration, FindsFaults):
        findings += calibration.find_faults(progress)
    findings += _of_cameras(calibration, {name for finding in findings for name in finding.cameras})
    reasons = tuple(finding.reason for finding in sorted(findings, key=lambda finding: not finding.grave))
    word = NOT_USABLE if any(finding.grave for finding in findings) else DOUBTFUL if findings else USABLE
    return Verdict(word, reasons, held_out)


# --- held out ------------------------------------------------------------------------------------------------------


def _held_out(calibration: Calibration, progress: Progress) -> tuple[HeldOut | None, list[Finding]]:
    if calibration.summary().held_out_points is not None:
        return None, list(_of_kept_back(calibration))
    data = _clean(calibration)
    n = len(data)
    if n < MIN_JUDGED_POINTS:
        return None, []
    plan = calibration.check_plan or (CheckPlan(5, 5, 300) if n <= MAX_POINTS_FOR_FIVE_FOLDS else CheckPlan(3, 3, 300))
    places = calibration.data.places
    fold = np.random.default_rng(0).permutation(np.arange(n) % plan.folds)[data.places]
    found: list[_Measured] = []
    failures: list[ImplicamError] = []
    for i in range(plan.fits):
        progress("checking", i, plan.fits)
        if not (fold == i).any():  # all at a few places
            continue
        held = np.isin(calibration.data.points, data.points[fold == i])
        others = calibration.data.select(~np.isin(places, places[held]))
        try:
            again = calibration.refit(_at_most(others, plan.max_points))
        except UsageError:  # made without known points: nothing can be held out
            return None, []
        except ImplicamError as error:
            failures.append(error)
            continue
        found.append(_measured(again, data.select(fold == i)))
    progress("checking", plan.fits, plan.fits)
    if not found or len(failures) > plan.fits / 2 or (failures and n < MIN_ROBUST_POINTS):
        return None, _not_repeatable(n, failures[0]) if failures else []
    how = f"{len(found)} fits from nothing without {'a fifth' if plan.folds == 5 else 'a third'} of the known points"
    return _summary(found, how + (f", at most {plan.max_points} points each" if n > plan.max_points else "")), []


def _not_repeatable(n: int, error: ImplicamError) -> list[Finding]:
    if n < MIN_RECOMMENDED_POINTS:  # said of their number already
        return []
    return [
        Finding(False, f"Without a few of the known points there is no calibration ({error.what}): add known points.")
    ]


def _clean(calibration: Calibration) -> Dataset:
    """The known points once each, without the views that the fit rejected: those are judged by their number."""
    data = calibration.data
    row = {str(name): i for i, name in enumerate(data.points)}
    column = {name: k for k, name in enumerate(data.observations.camera_names)}
    uv = data.observations.uv.copy()
    for view in calibration.rejected:
        if view.point in row and view.camera in column:  # corners of boards are elsewhere
            uv[row[view.point], column[view.camera]] = np.nan
    views = (~np.isnan(uv[..., 0])).sum(axis=1)
    unused = np.isin(data.points, [one.point for one in calibration.unused])
    clean = replace(data, observations=replace(data.observations, uv=uv))
    return clean.select((views >= 2) & ~unused & ~find_copies(data).points)


def _at_most(data: Dataset, most: int) -> Dataset:
    return data if len(data) <= most else data.split(most, seed=0)[0]


class _Measured(NamedTuple):
    errors: Floats
    cov: Floats
    contradicting: NDArray[np.bool_]


def _measured(calibration: Calibration, data: Dataset) -> _Measured:
    data = _at_most(data, 300)
    measured = calibration.measure(data.observations)
    own = measured.own_reason
    fine = measured.measured & (own == "")
    cov = measured.cov + known_position_covariance(calibration, data)
    contradicting = ~fine & (~np.isnan(measured.consistency) | measured.measured)
    return _Measured((measured.xyz - data.xyz)[fine], cov[fine], contradicting)


def _summary(found: list[_Measured], how: str) -> HeldOut | None:
    errors, cov, contradicting = (np.concatenate(parts) for parts in zip(*found, strict=True))
    if len(errors) < MIN_JUDGED_POINTS:
        return None
    with np.errstate(all="ignore"):
        nees = np.einsum("ni,nij,nj->n", errors, np.linalg.pinv(cov, hermitian=True), errors)
    nees = np.sort(np.nan_to_num(nees, nan=np.inf))
    kept = nees[: len(nees) - max(1, int(np.ceil(TRIMMED_SHARE * len(nees))))]
    return HeldOut(
        points=len(errors),
        rms=float(np.sqrt(np.mean(np.sum(errors**2, axis=1)))),
        stated=float(np.sqrt(np.mean(np.trace(cov, axis1=1, axis2=2)))),
        nees=float(kept.mean()),
        inside=float(np.mean(nees <= chdtri(3, 0.05))),
        contradicting=float(contradicting.mean()),
        how=how,
    )


def _of_held_out(found: HeldOut | None, calibration: Calibration, cure: str) -> Iterator[Finding]:
    if found is None:
        return
    unit = calibration.data.length_unit
    said = f"{found.points} known points that a fit had not seen are off by {found.rms:.2g} {unit} rms"
    extent = float(np.sqrt(np.mean(np.sum((calibration.data.xyz - calibration.data.xyz.mean(axis=0)) ** 2, axis=1))))
    within = f"{said}, and all of them lie within {extent:.2g} {unit}"
    if found.rms > NOTHING_LEARNED_RELATIVE_RMS * extent or (
        found.rms > MAX_RELATIVE_RMS * extent and found.nees > MAX_NEES
    ):
        yield Finding(True, f"{within}: this is no measurement. {_LOOK}")
    elif found.rms > MAX_RELATIVE_RMS * extent:
        yield Finding(False, f"{within}: this is hardly a measurement, as the error bars say. {_LOOK}")
    elif found.nees > UNUSABLE_NEES and found.inside < 0.5:
        yield Finding(True, f"{said}, where the error bars say {found.stated:.2g}: they mean nothing. {_LOOK}")
    elif found.nees > MAX_NEES or _beyond(round((1 - found.inside) * found.points), found.points, USUAL_OUTSIDE_SHARE):
        yield Finding(
            False,
            f"{said}, where the error bars say {found.stated:.2g}, and {percent(found.inside)} lie in their 95 % "
            f"ellipsoids. {cure}",
        )
    tested = found.points + round(found.contradicting * found.points / max(1 - found.contradicting, 1e-3))
    if found.contradicting > MAX_REJECTED_SHARE and _beyond(
        round(found.contradicting * tested), tested, USUAL_WRONG_SHARE
    ):
        yield Finding(
            False,
            f"The views of {percent(found.contradicting)} of the known points contradict each other in a fit that "
            "has not seen them. Look whether all cameras took them at the same instants, and for wrong matches.",
        )


_LOOK = (
    "Look for wrong known positions (a unit, an axis, names in another order), a camera that moved in between, or "
    "known points that fill too little of the volume; try other methods (implicam compare)."
)

_SDS = "The stated sds of the known positions seem too small."


def _of_kept_back(calibration: Calibration) -> Iterator[Finding]:
    """Of a method that keeps points back from training, because to train it again takes too long."""
    summary = calibration.summary()
    n, inside = 3 * (summary.held_out_points or 0), summary.held_out_in_95 or 0.0
    if n >= 3 * MIN_JUDGED_POINTS and inside < 0.5:
        yield Finding(
            False,
            f"{percent(inside)} of the {n} coordinates of points kept for early stopping lie in their 95 % bars: "
            "the spread of dropout says little of the errors. Take forward-gp, or judge with implicam evaluate --cv 5.",
        )


# --- what the data show --------------------------------------------------------------------------------------------


def _of_data(data: Dataset) -> Iterator[Finding]:
    yield from find_mistakes(data)
    copies = find_copies(data)
    seen = ~copies.points & data.observations.seen.any(axis=1)
    n, places = int(seen.sum()), len(np.unique(data.places[seen]))
    if 0 < places < MIN_RECOMMENDED_POINTS:
        what = f"{n} known points are" if places == n else f"{n} known points at {places} different positions are"
        yield Finding(False, f"{what} few: show the cameras {MIN_RECOMMENDED_POINTS} or more, better 17, all over.")
    for note in describe_copies(data):
        yield Finding(False, note)
    for note in remove_marks(data).notes[len(data.notes) :]:
        yield Finding(False, note.replace("missing, and taken as such", "missing, but here it was taken for a pixel"))
    if n < 3:
        return
    xyz = data.xyz[data.observations.seen.any(axis=1)]
    extents = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    if extents[-1] <= FLAT_RATIO * extents[0]:
        shape = "line" if extents[1] <= FLAT_RATIO * extents[0] else "plane"
        yield Finding(
            False,
            f"The known points lie nearly on a {shape}: away from it positions are guessed. Add known points in front "
            "of it and behind.",
        )


def _of_surface(calibration: Calibration) -> Iterator[Finding]:
    """Known points on two planes, or on another surface of the second degree. What vanishes there may be added to a map
    that no lens restrains, and no known point tells, held out or not. Three cameras would disagree there, and the
    alarm of `measure` would say so; two cannot."""
    if isinstance(calibration, PredictsPixels) and (
        len(calibration.camera_names) > 2 or calibration.follows_lenses_only
    ):
        return
    data = calibration.data
    xyz = data.xyz[data.observations.seen.any(axis=1)]
    n = len(xyz)
    if n < MIN_RECOMMENDED_POINTS:
        return
    left, extents, _ = np.linalg.svd(xyz - xyz.mean(axis=0), full_matrices=False)
    if extents[-1] <= FLAT_RATIO * extents[0]:
        return
    q = left * np.sqrt(n)
    first, second = np.triu_indices(3)
    monomials = np.column_stack([np.ones(n), q, q[:, first] * q[:, second]])
    if np.linalg.svd(monomials / np.sqrt(n), compute_uv=False)[-1] < MIN_QUADRIC_RMS:
        yield Finding(
            False,
            "The known points lie on two planes, or on another surface that a quadratic equation describes: between "
            "its parts positions are guessed, and held-out points cannot show it. Add known points between them.",
        )


def _of_cameras(calibration: Calibration, explained: set[str]) -> Iterator[Finding]:
    """Cameras that do not fit the rest, each with what its rows say of it where they say something; explained: cameras
    of which it is known why."""
    rejected, missed = list(_of_rejected(calibration)), list(_of_residuals(calibration))
    yield from rejected
    data = calibration.data
    for c, name in enumerate(data.observations.camera_names):
        own = [finding for finding in missed if name in finding.cameras]
        if name in explained or not (own or any(name in finding.cameras for finding in rejected)):
            continue
        why = describe_change(data.xyz, data.observations.uv[:, c]) if data.known is not None else ""
        yield from [row_finding(name, why)] if why else own


def _of_rejected(calibration: Calibration) -> Iterator[Finding]:
    """Cameras of which too many views contradict the rest."""
    data = calibration.data
    points = set(map(str, data.points))
    names = data.observations.camera_names
    rejected = [view.camera for view in calibration.rejected if view.point in points]
    seen = data.observations.seen.sum(axis=0)
    bad = {}
    for name, n in zip(names, seen.tolist(), strict=True):
        k = rejected.count(name)
        if k > MAX_REJECTED_SHARE * n and _beyond(k, n, USUAL_WRONG_SHARE):
            bad[name] = f"{name} ({k} of {n})"
    if not bad:
        return
    most = len(rejected) > 0.5 * seen.sum()
    yield Finding(
        most,
        f"Too many views contradict the known positions: {', '.join(bad.values())}. Was the camera moved in between, "
        "are its views matched to other points, does no lens model hold it, or is the detection wrong? Leave it out "
        "with --without NAME to see.",
        tuple(bad),
    )


def _of_residuals(calibration: Calibration) -> Iterator[Finding]:
    """Cameras that miss their own known points, all of them or from one on."""
    data = calibration.data
    uv, predicted = _seen_and_predicted(calibration)
    if not len(uv):
        return
    moved = set()
    for c, name in enumerate(data.observations.camera_names):
        rows = np.flatnonzero(np.isfinite(uv[:, c, 0] - predicted[:, c, 0]))
        first = _moved_at(uv[rows, c] - predicted[rows, c])
        if first is not None:
            moved.add(name)
            yield row_finding(name, describe_moved_camera(int(rows[first])))
    medians, stated = _missed_by(calibration)
    declared = _declared(data)
    for c, (name, median, sd) in enumerate(zip(data.observations.camera_names, medians, stated, strict=True)):
        if name in moved:
            continue
        others = np.delete(medians, c)
        usual = np.nanmedian(others) if np.isfinite(others).any() else np.nan
        if np.isfinite(sd) and median > MAX_RESIDUAL_SDS * sd and not declared:
            yield Finding(
                False,
                f"{name} misses its own known points by {median:.2g} px in the median, and its views state {sd:.2g} "
                "px: the stated sd is wrong, known positions are off, or the camera is not understood.",
                (name,),
            )
        elif not np.isfinite(sd) and median > max(MAX_RESIDUAL_RATIO * usual, MIN_UNLIKE_RESIDUAL_PX):
            yield Finding(
                False,
                f"{name} misses its own known points by {median:.2g} px in the median, the other cameras by "
                f"{usual:.2g}: look at its pictures, or leave it out with --without {name}.",
                (name,),
            )


def _of_stated_sds(calibration: Calibration) -> Iterator[Finding]:
    """Known positions with stated sds that most cameras miss by more than those allow."""
    if not _declared(calibration.data):
        return
    medians, stated = _missed_by(calibration)
    ratio = medians / stated
    judged = np.isfinite(ratio)
    if (ratio > MAX_RESIDUAL_SDS).sum() > 0.5 * judged.sum():
        yield Finding(
            False,
            f"In the median the cameras miss the known points by {np.median(ratio[judged]):.2g} times what the stated "
            f"sds of views and positions allow, where 1.2 is right. {_SDS}",
        )


def _seen_and_predicted(calibration: Calibration) -> tuple[Floats, Floats]:
    """(n, cameras, 2) each: pixels of the known points, and where the calibration has them; n = 0 if it cannot say."""
    data = calibration.data
    uv = np.where(find_copies(data).cameras[:, None], np.nan, data.observations.uv)
    if not isinstance(calibration, PredictsPixels) or data.known is None:
        return uv[:0], uv[:0]
    predicted = calibration.predict(data.xyz)
    return (uv, predicted) if predicted.shape == uv.shape else (uv[:0], predicted[:0])


def _missed_by(calibration: Calibration) -> tuple[Floats, Floats]:
    """(cameras,) each, in pixels: median error at the known points, as of positions that are right; stated noise."""
    uv, predicted = _seen_and_predicted(calibration)
    stated = stated_noise(calibration.data.observations)
    if not len(uv):
        return np.full(len(stated), np.nan), stated
    off = np.linalg.norm(predicted - uv, axis=2)
    off = off / np.sqrt(1 + _seen_of_labels(calibration) / np.where(np.isfinite(stated), stated, np.inf) ** 2)
    columns = [column[~np.isnan(column)] for column in off.T]
    return np.array([np.median(column) if len(column) else np.nan for column in columns]), stated


def _declared(data: Dataset) -> bool:
    """Whether somebody says how far the known positions may be off."""
    return data.known is not None and bool((data.positions.sd > 0).any())


def _moved_at(residual: Floats) -> int | None:
    """The row from which residuals (n, 2) are about another mean than before, in the order in which they were taken:
    where two means explain more than half of them, and chance (F, for any of the rows) would not. None where not."""
    n = len(residual)
    if n < MIN_RECOMMENDED_POINTS:
        return None
    centred = residual - residual.mean(axis=0)
    total = float(np.sum(centred**2))
    k = np.arange(MIN_VIEWS_IN_PART, n - MIN_VIEWS_IN_PART + 1)
    between = np.sum(np.cumsum(centred, axis=0)[k - 1] ** 2, axis=1) * n / (k * (n - k))
    best = int(np.argmax(between))
    explained = float(between[best]) / max(total, 1e-300)
    F = 0.5 * explained / max((1 - explained) / (2 * n - 4), 1e-300)
    by_chance = len(k) * float(fdtrc(2, 2 * n - 4, F))
    return int(k[best]) if explained > MIN_MOVE_SHARE and by_chance < MAX_CHANCE_PROBABILITY else None


def _seen_of_labels(calibration: Calibration) -> Floats:
    """(n, cameras) variance in pixels that errors of the known positions, as far as they are estimated, give a view."""
    xyz, covariance = calibration.data.xyz, known_position_covariance(calibration, calibration.data)
    if not isinstance(calibration, PredictsPixels) or not covariance.any():
        return np.zeros((len(xyz), 1))
    predict = calibration.predict
    step = np.sqrt(np.trace(covariance, axis1=1, axis2=2).max() / 3)
    slope = np.stack([(predict(xyz + d) - predict(xyz - d)) / (2 * step) for d in step * np.eye(3)], axis=-1)
    return np.asarray(np.nan_to_num(np.einsum("ncij,njk,ncik->nc", slope, covariance, slope) / 2), dtype=np.float64)


def _beyond(count: int, n: int, share: float) -> bool:
    return count > 0 and float(bdtrc(count - 1, n, share)) < MAX_CHANCE_PROBABILITY
