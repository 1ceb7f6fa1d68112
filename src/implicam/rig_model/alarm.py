"""Look at a measured table as a whole: does the rig still stand as it was calibrated?

Each point is tested alone: do its views agree? Of honest views one point in ten thousand fails
(`disagree_p_value`). Wrong
detections make single points fail, and the rest stays as good as ever. A camera that was moved, or two that were
exchanged, make most of them fail, and what is left does not look honest either: that is the alarm.

Three signs, each a binomial tail beyond what chance shows (`false_alarm_probability`) in a table with one wrong view in
five (`usual_wrong_share`) and error bars that are somewhat too small (`tolerated_error_bar_ratio`):

1. more than `max_contradicting_share` contradict, and they are points that no wrong view or two explain;
2. of the points that are not plainly wrong, too many have a small p-value. A wrong detection is off by far; a camera
   that was moved a little makes many points disagree a little. It needs no single point to fail;
3. more than `max_contradicting_share` contradict, and they are views of one camera.

The first and third hold whatever the points have in common, as the errors of a calibration: where each fails with
probability `disagree_p_value` at most, more than that share of them do with the ratio of the two at most (Markov), 3 in
10 000. The second counts points as independent, but at most `max_independent_points`: 285 points of a rig with 16 known
ones shared its errors.
What moves every view along the lines on which two cameras would see it cannot be found in their pixels alone.

Then the likeliest causes are tried on some of the points, and the one that makes them agree is named.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc, chdtrc, chdtri

from implicam.dataset import Camera
from implicam.formatting import percent
from implicam.geometry import Bools, Floats
from implicam.rig_model.settings import DEFAULT_SETTINGS, RigModelSettings
from implicam.row_order import describe_shift, shift_rows

MAX_POINTS_TRIED = 24
"""Points on which the causes are tried."""

MIN_SHARE_EXPLAINED, MIN_SHARE_GAINED = 0.6, 0.3
"""A cause makes so many of the points agree, and so many more than agree without it."""

MAX_PAIRS = 2000
"""Pairs of cameras that are tried; of more, the neighbours."""

RESIZE_FACTORS = (
    (2.0, "half"), (0.5, "twice"), (1.5, "two thirds"), (2 / 3, "one and a half times"), (3.0, "a third"),
    (1 / 3, "three times"), (4 / 3, "three quarters"), (0.75, "four thirds"), (2.25, "four ninths"), (4 / 9, "9/4"),
)  # fmt: skip
"""Factors from one usual height of a video (480, 720, 1080, 1440, 2160 rows) to another, and the words for it."""

MAX_CAUSES_CONFIRMED = 3
"""The likeliest causes, which are put to the full test."""

MAX_MISFIT_NOISES = 50.0
"""Misfit beyond which a cause is not put to it."""


@dataclass(frozen=True, eq=False)
class Table:
    """A measured table: uv (n, C, 2) and noise (n, C) in pixels; p (n,) NaN where not tested; left_out (n, C) views.

    What the calibration says of others: agree, (m,) of pixels (m, C, 2) whether the views of each row agree, all of
    them; lines, per camera the centre (3,) and directions (m, 3) of its lines of sight; pixels, (m, C, 2) of places."""

    cameras: tuple[Camera, ...]
    uv: Floats
    noise: Floats
    p: Floats
    left_out: Bools
    agree: Callable[[Floats], Bools]
    lines: Callable[[Floats], Iterator[tuple[Floats, Floats]]]
    pixels: Callable[[Floats], Floats]
    checked: bool = True
    """Whether the calibration was held against known points. How good cameras from elsewhere are is not known, and that
    their views agree badly is no news."""
    settings: RigModelSettings = DEFAULT_SETTINGS

    @property
    def seen(self) -> Bools:
        """(n, C) the views."""
        return np.asarray(~np.isnan(self.uv[..., 0]))

    @property
    def names(self) -> list[str]:
        """Of the cameras."""
        return [camera.name for camera in self.cameras]


def alarm_of(table: Table) -> str:
    """Say what is wrong with a measured table as a whole, in one sentence; nothing where all is well.

    Args:
        table: The measured table, what was left out of it, and what the calibration says of other pixels.

    Returns:
        The sentence; "" where all is well, or where fewer than `min_alarm_points` points have two views.
    """
    settings, views = table.settings, table.seen.sum(axis=1)
    many, tested = settings.max_contradicting_share, views >= 2
    n = int(tested.sum())
    if n < settings.min_alarm_points:
        return ""
    explained = tested & table.left_out.any(axis=1)
    contradict = tested & (explained | ~(table.p >= settings.disagree_p_value))
    share = contradict.sum() / n
    if share > many:
        alone = int((contradict & ~explained).sum())
        wrong = settings.usual_wrong_share
        usual = max(wrong, float(np.mean([_inexplicable_probability(int(k), wrong) for k in views[tested]])))
        moved = _contradicted_cameras(table, views)
        if moved or (alone > many * n and _tail(alone, n, usual) < settings.false_alarm_probability):
            what = f"{percent(share)} of {n} points contradict the calibration"
            return _sentence(what, settings.disagree_p_value, table, tested, moved)
    near = tested & ~explained & (table.p >= settings.min_p_value)
    uneven = _surprising_level(table.p[near], views[near], settings) if table.checked else None
    if uneven is None:
        return ""
    level, count = uneven
    words = f"the views of {count} of {near.sum()} points agree badly"
    if share > many:
        return _sentence(words, level, table, tested, [])
    return (
        f"{words}; {100 * level:g} % would be chance: has a camera been moved or refocused a little, or are the pixels "
        "noisier than they were when the rig was calibrated?"
    )


def _sentence(what: str, chance: float, table: Table, tested: Bools, moved: Sequence[str]) -> str:
    return f"{what}; {100 * chance:g} % would be chance: {_find_cause(table, tested, moved)}"


def _surprising_level(p: Floats, views: NDArray[np.int64], settings: RigModelSettings) -> tuple[float, int] | None:
    """The level below which the most surprising number of p-values (n,) lies, and it; None where none does."""
    if not len(p):
        return None
    several, points = np.unique(views, return_counts=True)
    degrees = 2 * several - 3
    found = []
    for level in settings.alarm_p_values:
        beyond = chdtrc(degrees, chdtri(degrees, level) / settings.tolerated_error_bar_ratio**2)
        usual = float(beyond @ points / len(p))
        count = int((p < level).sum())
        some = min(len(p), settings.max_independent_points)
        found.append((_tail(count * some // len(p), some, usual), level, count))
    tail, level, count = min(found)
    return (level, count) if tail < settings.false_alarm_probability else None


def _inexplicable_probability(views: int, wrong_share: float) -> float:
    """Probability that more of a point's views are wrong than leaving one or two out can mend."""
    mended = 2 if views >= 5 else 1 if views >= 3 else 0
    return float(bdtrc(mended, views, wrong_share))


def _tail(count: int, n: int, share: float) -> float:
    """Probability of so many of n or more, where each has the probability `share`."""
    return float(bdtrc(count - 1, n, share)) if count > 0 else 1.0


def _contradicted_cameras(table: Table, views: NDArray[np.int64]) -> list[str]:
    """Cameras whose views are left out far more often than wrong detections would be."""
    can_tell, settings = views >= 3, table.settings
    seen, away = table.seen[can_tell].sum(axis=0), table.left_out[can_tell].sum(axis=0)
    return [
        name
        for name, n, k in zip(table.names, seen.tolist(), away.tolist(), strict=True)
        if n >= settings.min_alarm_points
        and k > settings.max_contradicting_share * n
        and _tail(k, n, settings.usual_wrong_share) < settings.false_alarm_probability
    ]


def _find_cause(table: Table, tested: Bools, moved: Sequence[str]) -> str:
    """The likeliest cause as a question: what makes most of some points agree."""
    rows = np.flatnonzero(tested)
    if len(rows) > MAX_POINTS_TRIED:
        rows = np.sort(np.random.default_rng(0).choice(rows, MAX_POINTS_TRIED, replace=False))
    now = (table.p[rows] >= table.settings.disagree_p_value) & ~table.left_out[rows].any(axis=1)
    least = max(MIN_SHARE_EXPLAINED, MIN_SHARE_GAINED + float(now.mean()))
    guesses = [(_misfit(table, rows, uv, noise), words, uv) for words, uv, noise in _guesses(table)]
    without = [(_misfit(table, rows, uv, table.noise), words, uv) for words, uv in _without_one(table)]
    for likely in (guesses, without):  # without the one at fault the others agree whatever its fault is
        plausible = sorted((guess for guess in likely if guess[0] < MAX_MISFIT_NOISES), key=lambda guess: guess[0])
        for _, words, uv in plausible[:MAX_CAUSES_CONFIRMED]:
            testable = rows[_views(uv[rows]) >= 2]
            agree = table.agree(uv[testable])
            if len(testable) and agree.mean() >= least:
                return words.format(share=f"{percent(agree.mean())} of those tried agree")
    if moved and len(moved) < len(table.cameras) - 1:
        return f"most views of {' and '.join(moved)} contradict the other cameras. Has it been moved or refocused?"
    return (
        "has a camera been moved, or are cameras exchanged? No single one explains it: several may have been moved, or "
        "the pictures are not of the same instants, or their points are matched wrongly"
    )


def _views(uv: Floats) -> NDArray[np.int64]:
    return np.asarray((~np.isnan(uv[..., 0])).sum(axis=1), dtype=np.int64)


def _misfit(table: Table, rows: NDArray[np.int64], uv: Floats, noise: Floats) -> float:
    """How far, in their noise, the views of most rows are off where their lines of sight meet best; a quick look."""
    rows = rows[_views(uv[rows]) >= 2]
    if not len(rows):
        return float("inf")
    A, b = np.zeros((len(rows), 3, 3)), np.zeros((len(rows), 3))
    for centre, direction in table.lines(uv[rows]):
        across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
        across[~np.isfinite(across).all(axis=(1, 2))] = 0.0
        A += across
        b += across @ centre
    x = np.asarray(np.linalg.solve(A + 1e-9 * np.eye(3), b[..., None])[..., 0], dtype=np.float64)
    off = np.asarray(np.linalg.norm(table.pixels(x) - uv[rows], axis=2) / noise[rows], dtype=np.float64)
    worst = np.where(np.isnan(uv[rows, :, 0]), 0.0, np.nan_to_num(off, nan=np.inf)).max(axis=1)
    return float(np.sort(worst)[int(MIN_SHARE_EXPLAINED * len(worst))])  # some are infinite, so nothing is interpolated


def _without_one(table: Table) -> Iterator[tuple[str, Floats]]:
    """Words with a place for the share that agrees, and the pixels without one camera."""
    for c, name in enumerate(table.names if len(table.names) > 2 else ()):
        words = f"has {name} been moved or refocused, or are its pictures cropped? Without it {{share}}"
        yield words, _changed(table, c, np.array(np.nan))[0]


def _guesses(table: Table) -> Iterator[tuple[str, Floats, Floats]]:
    """What would make all views agree: words with a place for the share that does, pixels and noise as they would be.

    None of it can make views agree that were right before."""
    names = table.names
    for c, name in enumerate(names):
        for rows in (1, -1):
            words = f"are the pictures of {name} {describe_shift(rows)}? Put right {{share}}"
            yield words, *_changed(table, c, shift_rows(table.uv[:, c], rows))
    pairs = list(combinations(range(len(names)), 2))
    if len(pairs) > MAX_PAIRS:  # those that follow each other are exchanged most easily
        pairs = [*pairs[: len(names) - 1], *((c, c + 1) for c in range(1, len(names) - 1))]
    for a, b in pairs:
        order = np.arange(len(names))
        order[[a, b]] = b, a
        words = f"are {names[a]} and {names[b]} exchanged? With the two the other way round {{share}}"
        yield words, table.uv[:, order], table.noise[:, order]
    yield from _other_pixels(table)


def _changed(table: Table, cameras: slice | int, uv: Floats, factor: float = 1.0) -> tuple[Floats, Floats]:
    """Pixels and noise of the table, those of some cameras changed."""
    every, noise = table.uv.copy(), table.noise.copy()
    every[:, cameras] = uv
    noise[:, cameras] *= factor
    return every, noise


def _other_pixels(table: Table) -> Iterator[tuple[str, Floats, Floats]]:
    """The ways in which other programs count pixels: of all cameras, or of one."""
    one_by_one = ((slice(c, c + 1), f" of {name}") for c, name in enumerate(table.names))
    for cameras, whose in [(slice(None), ""), *one_by_one]:
        uv = table.uv[:, cameras]
        ends = np.array([[camera.width, camera.height] for camera in table.cameras[cameras]], dtype=np.float64) - 1
        if np.isfinite(ends).all():  # all sizes are known
            from_below = np.stack([uv[..., 0], ends[:, 1] - uv[..., 1]], axis=-1)
            words = f"is v{whose} counted from below here, and was not when the rig was calibrated? So {{share}}"
            yield words, *_changed(table, cameras, from_below)
            words = f"are the pictures{whose} upside down here, and were not when the rig was calibrated? "
            yield words + "Turned by 180° {share}", *_changed(table, cameras, ends - uv)
        yield f"are u and v{whose} exchanged? The other way round {{share}}", *_changed(table, cameras, uv[..., ::-1])
        for factor, size in RESIZE_FACTORS:
            words = f"are the pictures{whose} {size} the size they were? Resized {{share}}"
            yield words, *_changed(table, cameras, factor * (uv + 0.5) - 0.5, factor)
