"""From a wand to a fitted rig: start, adjustment, sizes of the fields, posterior, and what contradicts the rest.

The order of docs/method.md, section "Wand".
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.forward_gp.settings import ForwardGPSettings
from implicam.calibrators.forward_gp.wand.bundle import Bundle, FrameEquations, Lengths
from implicam.calibrators.forward_gp.wand.gauge import posterior_in_gauge, posterior_of
from implicam.calibrators.forward_gp.wand.known import (
    MIN_KNOWN,
    NOTHING_KNOWN,
    Facts,
    KnownPlaces,
    known_that_agree,
    lay_known_over,
    refuse_contradicting_known,
)
from implicam.calibrators.forward_gp.wand.own_noise import left_of_views, own_noise
from implicam.calibrators.forward_gp.wand.sizes import add_priors, estimate_sizes, size_fields, white_models
from implicam.calibrators.forward_gp.wand.start import (
    MIN_LENGTH_SHARE,
    Started,
    WandCamera,
    bundle_of,
    consensus,
    describe_stranger,
    explain_no_rig,
    prior_of,
    start,
)
from implicam.calibrators.forward_gp.wand.timing import Offset, clear_offsets, time_offsets, velocities
from implicam.calibrators.forward_gp.wand.waves import Waves
from implicam.errors import FitError
from implicam.geometry import Bools, Floats, Pose
from implicam.progress import Progress
from implicam.rig_model import (
    CameraModel,
    CameraViews,
    CentralCamera,
    GeneralCamera,
    Hyperparameters,
    InitialCamera,
    Posterior,
    lens_only_model,
    solve_normal,
)
from implicam.rig_model.posterior import move_to_mean

Item = TypeVar("Item")

_LOG = logging.getLogger(__name__)

MAX_ROUNDS = 5
MAX_GAUSS_NEWTON_STEPS = 6
MIN_VIEWS_PER_CAMERA = 12
MAX_FIRST_PAIRS = 4
"""Pairs of cameras from which the whole fit is tried, where it comes to nothing."""

MIN_CHECKED_PLACES = 12

LARGEST_STEP_WF = (-0.5, 0.5)
"""Of a place along each axis in one step."""

MAX_DISTANCE_RATIO = 4.0
"""Of a place from the middle of all, over the third quartile of these: what is farther away is a wrong match."""

MIN_CHECKED_VARIANCE = 0.01
"""Part of a view's variance that its place leaves in a direction; below it nothing but the view itself tells of it."""

LENIENT_RATIO = 1.5
"""Lens models leave errors that are alike in neighbouring views: how much larger noise is taken to be before fields."""


@dataclass(frozen=True, eq=False)
class WandFit:
    """A rig fitted to a wand, in units of the wand's length, about the middle of the places, axes of the first camera.

    Attributes:
        posterior: What is known of the cameras, in the working frame.
        cameras: Their numbers.
        uncalibrated: Number and why of the others.
        used: (2 F, C) which views are used.
        lengths: (F,) of which frames the length is used.
        places: (2 F, 3) in the working frame, NaN where unknown.
        checked: (2 F,) which places say where the world is: those that something checks.
        known: (k,) which known positions are used: then the working frame has the axes of their world.
        offset: (3,) of the working frame in that world, in units of the wand's length.
        known_scale: Ratio of known distances over those by the wand alone, and its sd.
        hyper: Lengthscales, signal, noise.
        scale: Of the working frame.
        exchanged: (F, C) pictures in which the names of both ends were exchanged.
        offsets: Cameras whose pictures are earlier or later than those of the others.
        length_errors: (k,) of the frames whose length is used: wand as measured from its views alone, less its length;
            length_sds: (k,) of these.
    """

    posterior: Posterior
    cameras: tuple[int, ...]
    uncalibrated: tuple[tuple[int, str], ...]
    used: Bools
    lengths: Bools
    places: Floats
    checked: Bools
    hyper: Hyperparameters
    scale: float
    exchanged: Bools
    offsets: tuple[Offset, ...]
    length_errors: Floats
    length_sds: Floats
    known: Bools
    offset: Floats
    known_scale: tuple[float, float]


def fit_wand(waves: Waves, settings: ForwardGPSettings, length_sd: float, progress: Progress) -> WandFit:
    """Fit every camera that can be fitted.

    Args:
        waves: What was seen, lengths in units of the wand's.
        settings: Priors and thresholds.
        length_sd: Sd of the length of the wand itself, over that length: one error for all frames.
        progress: Is told how far the fit is.

    Raises:
        FitError: Fewer than two cameras can be fitted.
    """
    tried: list[tuple[int, ...]] = []
    failure: FitError | np.linalg.LinAlgError | None = None
    while len(waves.seen) > 2 or not tried:  # a mirrored camera, or one out of step, makes a first pair of its own
        progress("starting", 0, 3)
        try:
            started = start(waves, settings, tried)
        except FitError as error:
            raise _explained(failure or error, waves) from error
        tried.append(started.first)
        try:
            return _from_start(started, settings, length_sd, progress)
        except _Decided:
            raise
        except (FitError, np.linalg.LinAlgError) as error:
            failure = failure or error
            _LOG.info("from %s: %s", started.first, error)
        if len(tried) == MAX_FIRST_PAIRS:
            break
    assert failure is not None
    raise _explained(failure, waves)


class _Decided(FitError):
    """No other start would change it."""


def _explained(failure: FitError | np.linalg.LinAlgError, waves: Waves) -> FitError:
    """With the cause, where it can be told."""
    why = "" if waves.still else explain_no_rig(waves)
    if not why and isinstance(failure, FitError):
        return failure
    if not why:
        return FitError(
            f"no camera can be calibrated from {'these points' if waves.still else 'this wand'}: the equations have no "
            "solution.",
            why="the views contradict each other, or they are in too little of what the cameras see",
            fix="show more points where the cameras look together, near and far"
            if waves.still
            else "look for cameras that are out of step and for wrong views; wave it in all directions, near and far",
        )
    what = failure.what if isinstance(failure, FitError) else "no camera can be calibrated from this wand."
    return FitError(what, why=why, fix="trigger all cameras by one signal; of films, detect --offsets says by how much")


def _from_start(started: Started, settings: ForwardGPSettings, length_sd: float, progress: Progress) -> WandFit:
    progress("adjusting", 1, 3)
    state = _adjusted(started.waves, started, settings, length_sd)
    progress("fitting", 2, 3)
    state = _with_fields(state, settings)
    progress("fitting", 3, 3)
    return _finished(state, settings, length_sd)


@dataclass(frozen=True, eq=False)
class _State:
    """cameras: numbers; models; places (F, 2, 3) in the working frame, whose unit is `scale`; known (2 F,) places with
    two views or more in use; used (2 F, C of all); lengths (F,) in use; anchors: known positions in the working frame,
    anchored (k,) those in use; growth: of all lengths, with its sd; offset: of the working frame."""

    waves: Waves
    cameras: tuple[int, ...]
    models: tuple[CameraModel, ...]
    places: Floats
    used: Bools
    lengths: Bools
    scale: float
    anchors: KnownPlaces = NOTHING_KNOWN
    anchored: Bools = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    growth: float = 0.0
    growth_sd: float = 0.0
    offset: Floats = field(default_factory=lambda: np.zeros(3))
    known_scale: tuple[float, float] = (1.0, 0.0)
    hyper: Hyperparameters | None = None
    equations: FrameEquations | None = None
    root: Floats | None = None

    @property
    def known(self) -> Bools:
        """(2 F,) places with two views in use."""
        return np.asarray(self.used.sum(axis=1) >= 2)

    @property
    def seen(self) -> list[CameraViews]:
        """Per camera the views in use."""
        known = self.known
        return [
            views.select(self.used[views.rows, c] & known[views.rows])
            for c, views in ((c, self.waves.seen[c]) for c in self.cameras)
        ]

    @property
    def length_rows(self) -> Lengths:
        """The lengths in use."""
        return self.lengths_of(np.flatnonzero(self.lengths & self.known.reshape(-1, 2).all(axis=1)))

    @property
    def facts(self) -> Facts:
        """Lengths and known places in use."""
        known = self.anchors.select(self.anchored & self.known[self.anchors.rows])
        return Facts(self.length_rows, known, self.growth, self.growth_sd)

    def lengths_of(self, frames: NDArray[np.int64]) -> Lengths:
        """The wand in some frames.

        Args:
            frames: Their numbers.
        """
        found = self.waves.lengths_of(frames)
        return Lengths(frames, found.length / self.scale, found.sd / self.scale)

    def grown_lengths_of(self, frames: NDArray[np.int64]) -> Lengths:
        """The same, as long as the known places say.

        Args:
            frames: Their numbers.
        """
        lengths = self.lengths_of(frames)
        return lengths._replace(length=lengths.length * (1 + self.growth))


def _adjusted(waves: Waves, started: Started, settings: ForwardGPSettings, length_sd: float) -> _State:
    """Lenses alone, robustly; then again with what agrees."""
    cameras, near = started.cameras, 6.0
    numbers = tuple(sorted(cameras))
    half = np.array([waves.images[c].half for c in numbers]) / 640
    sigma = 1.0
    for relative in (0.002, 0.001, 0.001):
        places, agree = consensus(waves, cameras, near)
        known = np.isfinite(places[:, 0])
        bundle = bundle_of(waves, cameras, places, settings)
        seen = [waves.seen[c].select(agree[waves.seen[c].rows, c]) for c in numbers]
        frames = np.flatnonzero(known.reshape(-1, 2).all(axis=1) & waves.ends)
        stated = waves.lengths_of(frames, relative)
        bundle = bundle.adjusted(seen, sigma * half, stated, robust=True, max_steps=25, tolerance=1e-4)
        cameras = dict(zip(numbers, bundle.cameras, strict=True))
        off = np.concatenate([e / h for e, h in zip(bundle.errors(seen), half, strict=True)])
        # a place takes up a part of its views' errors: of two views three numbers of four
        free = max(1 - 3 * known.sum() / (2 * len(off)), 0.1)
        sigma = max(float(np.median(off)) / 1.1774 / np.sqrt(free), 0.02)
        near = max(5 * sigma, 1.0)
        _LOG.info("adjusted: sigma %.3f px of 1280", sigma)
    cameras, bundle, sigma = _freed(waves, cameras, bundle, sigma, near, settings)
    near = max(5 * sigma, 1.0)
    places, agree = consensus(waves, cameras, near)
    at = np.where(np.isfinite(bundle.places.reshape(-1, 3)) & known[:, None], bundle.places.reshape(-1, 3), places)
    known = np.isfinite(at[:, 0]) & (agree.sum(axis=1) >= 2)
    away = np.linalg.norm(at - np.median(at[known], axis=0), axis=1)
    known &= ~(away > MAX_DISTANCE_RATIO * np.quantile(away[known], 0.75))
    agree &= known[:, None]
    middle = at[known].mean(axis=0)
    scale = float(np.sqrt(np.mean((at[known] - middle) ** 2)))
    turn, offset, anchors, laid = cameras[numbers[0]].pose.rotation, np.zeros(3), waves.known, None
    if len(waves.known.rows):
        laid = lay_known_over(waves.known, np.where(known[:, None], at, np.nan), length_sd)
        here = laid.here_from_world
        turn, offset = here.rotation.T, here.inverse().apply(middle)
        anchors = waves.known.moved(Pose(np.eye(3), -offset), scale)
    working = np.where(known[:, None], (at - middle) @ turn.T / scale, 0.0).reshape(-1, 2, 3)
    models = []
    for c in numbers:
        moved = cameras[c].in_frame(Pose(turn.T, middle))
        camera = replace(moved, pose=Pose(moved.pose.rotation, moved.pose.translation / scale))
        prior = prior_of(camera, waves.images[c], waves.seen[c].uv[agree[waves.seen[c].rows, c]], settings)
        noise = LENIENT_RATIO * sigma * waves.images[c].half / 640
        family = "free" if isinstance(camera, GeneralCamera) else "ordinary"
        models.append(lens_only_model(InitialCamera(camera, prior, agree[:, c], family), waves.images[c], noise))
    # seen by cameras of any kind alone, the world may be stretched: there lengths are needed from the start
    odd = any(isinstance(camera, GeneralCamera) for camera in cameras.values())
    lengths = _likely_lengths(waves, at, known) if odd or waves.still else np.zeros(waves.frames, dtype=np.bool_)
    unused = np.zeros(len(anchors.rows), dtype=np.bool_)
    state = _State(
        waves, numbers, tuple(models), working, agree, lengths, scale, anchors, unused, offset=offset
    )  # fmt: skip
    # a wrong marker and a stiff length would pull everything: lengths are first judged by the views alone
    state = _judged(_relocated(state), settings)
    state = _judged(_solved(state, fields=False), settings)
    # so do known places, before the cameras have come to rest
    if laid is None:
        return state
    return replace(state, anchored=laid.fits, growth_sd=length_sd, known_scale=(laid.ratio, laid.ratio_sd))


def _freed(
    waves: Waves, cameras: Mapping[int, WandCamera], bundle: Bundle, sigma: float, near: float,
    settings: ForwardGPSettings,
) -> tuple[dict[int, WandCamera], Bundle, float]:  # fmt: skip
    """Cameras of any kind, where ordinary ones leave much more: a tilted or cropped sensor, pixels that are not square.

    Args:
        waves: What was seen.
        cameras: By number, adjusted.
        bundle: They, and the places.
        sigma: Noise in pixels of 1280.
        near: How far views that agree are off, in pixels of 1280.
        settings: Priors.

    Returns:
        The same, with cameras of any kind where that helps much.
    """
    numbers = tuple(sorted(cameras))
    half = np.array([waves.images[c].half for c in numbers]) / 640
    ordinary = [c for c in numbers if isinstance(cameras[c], CentralCamera)]
    places, agree = consensus(waves, dict(cameras), near)
    if not ordinary or not _enough_for_any_kind(agree[:, ordinary]):
        return dict(cameras), bundle, sigma

    def adjusted(own: dict[int, WandCamera], steps: int) -> tuple[dict[int, WandCamera], Bundle, Floats]:
        seen = [waves.seen[c].select(agree[waves.seen[c].rows, c]) for c in numbers]
        frames = np.flatnonzero(np.isfinite(places[:, 0]).reshape(-1, 2).all(axis=1) & waves.ends)
        found = bundle_of(waves, own, places, settings).adjusted(
            seen, sigma * half, waves.lengths_of(frames, 0.001), robust=True, max_steps=steps, tolerance=1e-3
        )
        off = [float(np.median(e / h)) for e, h in zip(found.errors(seen), half, strict=True)]
        return dict(zip(numbers, found.cameras, strict=True)), found, np.array(off)

    again, _, before = adjusted(dict(cameras), 4)
    any_kind: dict[int, WandCamera] = {
        c: GeneralCamera.from_central(one) if isinstance(one, CentralCamera) else one for c, one in again.items()
    }
    free, _, after = adjusted(any_kind, 25)
    better = {c for k, c in enumerate(numbers) if c in ordinary and after[k] < MAX_FREER_ERROR_RATIO * before[k]}
    _LOG.info("as cameras of any kind: %s px instead of %s", np.round(after, 3), np.round(before, 3))
    if not better:
        return dict(cameras), bundle, sigma
    if len(better) > len(numbers) / 2:  # places have bent to the cameras that were ordinary, and hide what these are
        better = set(ordinary)
    for _ in range(2):
        mixed = {c: free[c] if c in better or c not in ordinary else again[c] for c in numbers}
        mixed, found, off = adjusted(mixed, 25)
        known = np.isfinite(places[:, 0])
        left = max(1 - 3 * known.sum() / (2 * sum(agree[known, c].sum() for c in numbers)), 0.1)
        sigma = max(float(np.median(off)) / 1.1774 / np.sqrt(left), 0.02)
        places, agree = consensus(waves, mixed, max(5 * sigma, 1.0))
        free = again = mixed
    return mixed, found, sigma


def _likely_lengths(waves: Waves, at: Floats, known: Bools) -> Bools:
    """(F,) frames in which places (2 F, 3) are as far apart as in most."""
    both = known.reshape(-1, 2).all(axis=1) & waves.ends
    ends = at.reshape(-1, 2, 3)
    off = np.abs(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / waves.lengths - 1)
    usual = 1.4826 * float(np.median(off[both])) if both.any() else 0.0
    return np.asarray(both & (off < np.maximum(4 * usual, 4 * waves.jitter / waves.lengths)), dtype=np.bool_)


MAX_FREER_ERROR_RATIO = 0.7
"""A camera of any kind that leaves less than this part of what an ordinary one does is of that kind."""


def _enough_for_any_kind(agree: Bools) -> bool:
    return bool((agree.sum(axis=0) >= 3 * MIN_VIEWS_PER_CAMERA).all())


def _with_fields(state: _State, settings: ForwardGPSettings) -> _State:
    """Sizes, posterior and what contradicts it, until nothing changes."""
    search, own = True, np.zeros(len(state.waves.seen))
    for number in range(MAX_ROUNDS):
        cameras = list(state.cameras)
        hyper = estimate_sizes(
            state.models,
            state.places,
            state.seen,
            state.facts,
            state.waves.stated[cameras],
            own[cameras],
            settings,
            state.hyper,
            search=search,
        )
        sized = size_fields(
            state.models, state.places.reshape(-1, 3), state.seen, hyper, settings.typical_log_distance_sd
        )
        state = _solved(replace(state, models=sized, hyper=hyper), fields=True)
        state, told = _with_own_noise(state, own[cameras], settings)
        louder, own[cameras] = float(np.max(np.abs(told - own[cameras]))), told
        judged = _judged(state, settings)
        changed = float(np.mean(judged.used != state.used)) + float(np.mean(judged.lengths != state.lengths))
        _LOG.info(
            "round %d: lengthscale %s signal %.3g noise %s px, %.2g %% changed", number, hyper.lengthscale[0],
            hyper.signal[0], np.round(hyper.noise, 3), 100 * changed,
        )  # fmt: skip
        if (not changed and louder < MAX_OWN_NOISE_STEP) or number == MAX_ROUNDS - 1:
            break
        search = number == 0 or changed > 0.01
        state = judged
    return state


def _with_own_noise(state: _State, own: Floats, settings: ForwardGPSettings) -> tuple[_State, Floats]:
    """Weighted by the noise of each camera, and (C,) the log of that over the rig's."""
    for number in range(MAX_OWN_NOISE_STEPS):
        white = white_models(state.models, state.places.reshape(-1, 3), state.seen, with_fields=True)
        equations = _known(state.equations)
        left = left_of_views(white, equations, _frame_covariance(equations), _known(state.root))
        told = own_noise(left, own, settings.wand_camera_noise_log_sd)
        step, own = told - own, told
        if np.abs(step).max() < MAX_OWN_NOISE_STEP or number == MAX_OWN_NOISE_STEPS - 1:
            break
        louder = tuple(replace(m, noise=m.noise * float(np.exp(d))) for m, d in zip(state.models, step, strict=True))
        state = _solved(replace(state, models=louder), fields=True)
    return state, own


MAX_OWN_NOISE_STEPS = 6
"""Of a camera whose views are trusted less, a place draws more of what is left to the others: it takes steps."""

MAX_OWN_NOISE_STEP = 0.12
"""Change of the log noise of a camera after which the rig is fitted again."""


def _solved(state: _State, *, fields: bool) -> _State:
    """Gauss-Newton for cameras and places, exact for the fields."""
    models, places, growth = state.models, state.places, state.growth
    for number in range(MAX_GAUSS_NEWTON_STEPS):
        equations = _equations(replace(state, models=models, places=places, growth=growth))
        L, G, g = equations.halved()
        S = equations.A - G.T @ G
        if not (np.diag(S) > 0).all():
            raise np.linalg.LinAlgError("the views do not fix the cameras")
        root, mean, _ = solve_normal(S, equations.b - G.T @ g)
        back = (g - G @ mean).reshape(-1, 6, 1)
        step = np.linalg.solve(L.swapaxes(1, 2), back)[..., 0].reshape(-1, 2, 3)
        growth += float(mean[-1]) if state.facts.grows else 0.0
        ends = np.cumsum([model.size for model in models])
        means = np.split(mean[: ends[-1]], ends[:-1])
        sd = np.split(np.sqrt(np.sum(root**2, axis=0))[: ends[-1]], ends[:-1])
        models = move_to_mean(models, means)
        places = places + np.where(state.known.reshape(-1, 2)[..., None], np.clip(step, *LARGEST_STEP_WF), 0.0)
        small = all(np.all(np.abs(mean[:14]) <= 0.05 * sd[:14]) for mean, sd in zip(means, sd, strict=True))
        if small or (number > 2 and not fields):
            break
    # a stiff length bends the way of a place: how far it fits is known when the places have come to rest
    return _relocated(replace(state, models=models, places=places, growth=growth, root=root))


def _equations(state: _State, *, with_fields: bool = False) -> FrameEquations:
    """Those of all views and lengths in use, with the priors; with_fields as of `white_models`."""
    white = white_models(state.models, state.places.reshape(-1, 3), state.seen, with_fields=with_fields)
    found = state.facts.equations(white, state.places)
    add_priors(found, state.models, fields=True, held=not len(state.facts.known.rows))
    return found


def _relocated(state: _State) -> _State:
    """Places where views and lengths in use have them, with the cameras as they are."""
    for _ in range(3):
        L, _, g = _equations(state, with_fields=True).halved()
        step = np.linalg.solve(L.swapaxes(1, 2), g.reshape(-1, 6, 1))[..., 0].reshape(-1, 2, 3)
        step = np.where(state.known.reshape(-1, 2)[..., None], np.clip(step, *LARGEST_STEP_WF), 0.0)
        state = replace(state, places=state.places + step)
    return replace(state, equations=_equations(state))


def _frame_covariance(equations: FrameEquations) -> Floats:
    """(F, 6, 6) of the places, if the cameras are as they are."""
    scale = 1 / np.sqrt(np.einsum("fii->fi", equations.H))
    both = scale[:, :, None] * scale[:, None, :]
    return np.asarray(np.linalg.inv(equations.H * both) * both, dtype=np.float64)


def _judged(state: _State, settings: ForwardGPSettings) -> _State:
    """Which views and lengths agree with all others, eq. (V5): each is judged as if it had not been used."""
    spread, limit = _frame_covariance(_known(state.equations)), settings.max_squared_mahalanobis
    lengths = _lengths_that_agree(state, spread, limit)
    used = _views_that_agree(state, spread, limit)
    # of two views that contradict each other, or the length, nobody knows which is wrong
    few = state.used.sum(axis=1) <= 2
    used[few & (used.sum(axis=1) < 2)] = False
    wrong = np.repeat(state.waves.ends & ~lengths, 2)
    used[wrong & (used.sum(axis=1) <= 2)] = False
    used[used.sum(axis=1) < 2] = False
    anchored = state.anchored
    if len(anchored) and state.hyper is not None:  # before fields, cameras are off by more than known places
        there = state.known[state.anchors.rows]
        whole = _whole_covariance(state, spread, state.anchors.rows // 2)
        agree = known_that_agree(state.anchors, state.places, whole, anchored & there, limit)
        # of three nothing tells which is wrong
        anchored = there & agree if (there & agree).sum() >= MIN_KNOWN else anchored
    return _without_poor_cameras(replace(state, used=used, lengths=lengths, anchored=anchored))


def _whole_covariance(state: _State, spread: Floats, frames: NDArray[np.int64]) -> Floats:
    """(k, 6, 6) of the places of some frames, with what is unknown of the cameras."""
    follow = spread[frames] @ _known(state.equations).G[frames] @ _known(state.root).T
    return np.asarray(spread[frames] + follow @ follow.swapaxes(1, 2), dtype=np.float64)


def _lengths_that_agree(state: _State, spread: Floats, limit: float) -> Bools:
    """(F,) frames of the wand whose length agrees with what the cameras saw, or that have none."""
    whole = np.flatnonzero(state.known.reshape(-1, 2).all(axis=1) & state.waves.ends)
    used = state.length_rows
    off, slope = state.grown_lengths_of(whole).linear(state.places)
    leverage = np.einsum("ki,kij,kj->k", slope, spread[whole], slope)
    left = np.where(np.isin(whole, used.frames), np.maximum(1 - leverage, 1e-9), 1 + leverage)
    agree = state.waves.ends.copy()
    agree[whole] = off**2 / left <= limit
    return agree


def _views_that_agree(state: _State, spread: Floats, limit: float) -> Bools:
    """(2 F, C) views that agree with all others of their place; of places that are not known, as they were."""
    flat, known, used = state.places.reshape(-1, 3), state.known, state.used.copy()
    block = spread.reshape(-1, 2, 3, 2, 3)
    for c, model in zip(state.cameras, state.models, strict=True):
        views = state.waves.seen[c].select(known[state.waves.seen[c].rows])
        mean, slope = model.predict(flat[views.rows])
        unit = (model.noise * views.relative)[:, None]
        off, D = (views.uv - mean) / unit, slope / unit[..., None]
        h = D @ block[views.rows // 2, views.rows % 2, :, views.rows % 2] @ D.swapaxes(1, 2)
        own = np.where(state.used[views.rows, c], -1.0, 1.0)  # a view in use has drawn its place to itself
        values, vectors = np.linalg.eigh(np.nan_to_num(np.eye(2) + own[:, None, None] * h))
        turned = np.einsum("nij,ni->nj", vectors, np.nan_to_num(off, nan=1e3))
        each = np.where(values > MIN_CHECKED_VARIANCE, turned**2 / np.maximum(values, 1e-12), 0)
        used[views.rows, c] = each.sum(axis=1) <= limit
    return used


def _without_poor_cameras(state: _State) -> _State:
    """Without cameras of which too few views agree with the others."""
    counts = state.used.sum(axis=0)
    good = [number for number, c in enumerate(state.cameras) if counts[c] >= MIN_VIEWS_PER_CAMERA]
    if len(good) == len(state.cameras):
        return state
    if len(good) < 2:
        shown = "these points" if state.waves.still else "this wand"
        raise FitError(
            f"{len(good)} of {len(state.waves.seen)} cameras can be calibrated from {shown}; a position takes two.",
            why="the views of the others contradict each other",
            fix="look whether names mean the same point in all cameras, and show more points in all of their pictures"
            if state.waves.still
            else "look whether frames and markers belong together in all cameras, and wave the wand where they see it "
            "together",
        )
    used = state.used.copy()
    used[:, [c for number, c in enumerate(state.cameras) if number not in good]] = False
    used[used.sum(axis=1) < 2] = False
    hyper = None if state.hyper is None else Hyperparameters(*(values[good] for values in state.hyper))
    kept = tuple(state.cameras[number] for number in good), tuple(state.models[number] for number in good)
    return _without_poor_cameras(replace(state, cameras=kept[0], models=kept[1], used=used, hyper=hyper))


def _finished(state: _State, settings: ForwardGPSettings, length_sd: float) -> WandFit:
    """The covariance of all cameras in the gauge of the places that something checks."""
    known, waves = state.known, state.waves
    equations, root, hyper = _known(state.equations), _known(state.root), _known(state.hyper)
    whole = state.lengths & known.reshape(-1, 2).all(axis=1) & waves.ends
    bars_check = not waves.still or whole.sum() >= MIN_CHECKING_BARS
    checked = known & ((state.used.sum(axis=1) >= 3) | np.repeat(whole & bars_check, 2))
    if checked.sum() < MIN_CHECKED_PLACES and waves.still:
        raise FitError(
            f"{checked.sum()} points are where something checks them; it takes {MIN_CHECKED_PLACES}.",
            why="two views meet nearly anywhere, and of two cameras alone points do not tell what lenses they have",
            fix="take three cameras or more that see the same points; or wave a wand before these (--wand)",
        )
    if waves.still:
        _refuse_unsized(state, whole)
    if checked.sum() < MIN_CHECKED_PLACES:
        raise FitError(
            f"{checked.sum()} markers of the wand are where something checks them; it takes {MIN_CHECKED_PLACES}.",
            why="two views meet nearly anywhere; a third one, or the length of the wand, must agree",
            fix="wave the wand longer where two cameras or more see both its markers",
        )
    if not waves.still:
        _refuse_contradicted(state, whole)
    refuse_contradicting_known(state.anchors, state.places, state.anchored & state.known[state.anchors.rows])
    anchors = state.facts.known
    checked[anchors.rows] = True
    if len(anchors.rows):
        posterior = posterior_of(state.models, equations, root)
    else:
        posterior = posterior_in_gauge(state.models, state.places, checked, equations, root, length_sd)
    lengths = state.length_rows
    off, slope = state.grown_lengths_of(lengths.frames).linear(state.places)
    leverage = np.einsum("ki,kij,kj->k", slope, _frame_covariance(equations)[lengths.frames], slope)
    left, unit = np.maximum(1 - leverage, 1e-6), state.scale * lengths.sd
    places = np.where(known[:, None], state.places.reshape(-1, 3), np.nan)
    strangers = [c for c in range(len(waves.seen)) if c not in state.cameras]
    return WandFit(
        posterior,
        state.cameras,
        tuple((c, describe_stranger(waves, c, places, settings)) for c in strangers),
        state.used,
        whole,
        places,
        checked,
        hyper,
        state.scale,
        waves.exchanged,
        _offsets(state),
        -off / left * unit,
        unit * np.sqrt(leverage / left),
        state.anchored & state.known[state.anchors.rows],
        state.offset,
        state.known_scale,
    )


def _offsets(state: _State) -> tuple[Offset, ...]:
    """Cameras out of step, by all views of places that are known."""
    waves, known = state.waves, state.known
    moving = velocities(waves.frame_names, state.places, (known & np.repeat(waves.ends, 2)).reshape(-1, 2))
    if moving is None:
        return ()
    white = white_models(state.models, state.places.reshape(-1, 3), state.seen)
    lengths = state.length_rows
    equations = (lengths.frames, *lengths.linear(state.places))
    found = time_offsets(white, equations, _known(state.equations), moving.reshape(-1, 3))
    return clear_offsets(state.cameras, found)


MIN_CHECKING_BARS = 3
"""Scale bars that check each other: one gives the size, and of two that differ none is known to be right."""


def _refuse_unsized(state: _State, whole: Bools) -> None:
    """Stop where no scale bar gives the size, or most contradict each other."""
    seen = np.isfinite(state.waves.uv[:, list(state.cameras), 0]).sum(axis=1) >= 2
    bars = np.flatnonzero(seen.reshape(-1, 2).all(axis=1) & state.waves.ends)
    if not len(bars):
        names = ", ".join(name for name, bar in zip(state.waves.frame_names, state.waves.ends, strict=True) if bar)
        raise _Decided(
            f"no scale bar has both ends where two cameras see them ({names}): the rig has no size.",
            fix="take two points that several cameras see",
        )
    if whole.sum() >= (2 if len(bars) == 2 else 0.5 * len(bars)):
        return
    size = np.linalg.norm(state.places[bars, 1] - state.places[bars, 0], axis=1) * state.scale
    there = np.asarray(state.known.reshape(-1, 2)[bars].all(axis=1))
    told = [
        f"{state.waves.frame_names[f]} {100 * r:.4g} %" if placed else f"{state.waves.frame_names[f]} cannot be placed"
        for f, r, placed in zip(bars.tolist(), size / state.waves.lengths[bars], there.tolist(), strict=True)
    ]
    raise _Decided(
        f"{whole.sum()} of {len(bars)} scale bars agree with the others and with what the cameras saw.",
        why=f"measured together they are, of what is stated: {', '.join(told[:5])}",
        fix="measure them again, or state how exact they are (the column sd); a single one cannot contradict others",
    )


def _refuse_contradicted(state: _State, whole: Bools) -> None:
    """Stop where most frames contradict the wand: what they fit is no rig."""
    seen = np.isfinite(state.waves.uv[:, list(state.cameras), 0]).sum(axis=1) >= 2
    shown = seen.reshape(-1, 2).all(axis=1) & state.waves.ends
    if whole.sum() < MIN_LENGTH_SHARE * shown.sum():
        raise FitError(
            f"the length of the wand agrees with what the cameras saw in {whole.sum()} of {shown.sum()} frames only.",
            why="its markers are exchanged in some pictures, cameras were not in step, one looks into "
            "a mirror or through a window, or most views are wrong",
            fix="leave out one camera after the other (--without NAME) to see which it is",
        )


def _known(value: Item | None) -> Item:
    assert value is not None
    return value
