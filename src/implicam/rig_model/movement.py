"""Does the rig still stand as it was calibrated? From the views of many points, none of whose positions is known.

About every point its residuals are linear in where it is, in what is unknown of the cameras (`shared_errors` has the
same unknowns), and in how one camera has moved since. Where the points are is projected out; the cameras' unknowns are
integrated out with what the calibration knows of them; what is left is a linear model of the movement, whose
likelihood says whether a camera moved, which, and how far; eqs. (M1) to (M3) of docs/method.md.

A movement has seven numbers: a turn about the camera's own axes (right, down, forward), a shift along them, and a zoom.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import orth, solve_triangular
from scipy.optimize import least_squares
from scipy.special import chdtrc, fdtrc

from implicam.geometry import Bools, Floats, cross_matrices, rotation_from_vector, vector_from_rotation
from implicam.gp.linalg import covariance_root
from implicam.rig_model.camera import CentralCamera
from implicam.rig_model.camera_model import CameraModel, apply_covariance_root
from implicam.rig_model.general_camera import GeneralCamera
from implicam.rig_model.posterior import Posterior
from implicam.rig_model.settings import DEFAULT_SETTINGS, RigModelSettings
from implicam.rig_model.triangulate import locate, meet_lines

NUMBERS = 7
TURN, SHIFT, ZOOM = slice(0, 3), slice(3, 6), 6
MAX_STEPS, MAX_TRIMMINGS = 25, 4
MIN_POINTS_TO_START = 5
AXIS_STEP_HALF_SIDES = 0.05
"""How far beside the middle of its image a camera without a lens model is asked where right is."""
CONVERGED_STEP_SDS = 1e-3
MAX_EQUATIONS = 1200
"""Residuals that are used, some three quarters of the views: of more points a part is drawn, at random. The errors of
the calibration, which all points share, limit what more of them could tell."""
PRIOR_SDS = np.array([0.5, 0.5, 0.5, 2.0, 2.0, 2.0, 0.3])
"""Of a movement before anything is seen: radians, standard deviations of the known positions, and a part of the focal
length. So wide that they only keep a search from running away, and say how much a movement must explain."""
MAX_STEP = 0.2 * PRIOR_SDS
"""Of a search: what two cameras do not show of a movement must not carry it away."""
WRONG_VIEW_P_VALUE = 1e-5
"""Of a point after the movement: below it the camera's view of it is a wrong detection."""
MIN_FREEDOM_FOR_NOISE = 30
"""Degrees of freedom from which the noise is learned from what is left."""
SURE, AFTER_LEVEL = 0.95, 0.01
"""Probability from which one camera is named, and that of another movement besides below which none is."""
MAX_LEFT_OUT_SHARE, MIN_LEFT_OUT = 0.3, 5
"""Of the views of a camera, as wrong detections: with more of them the camera itself is in doubt."""
MIN_RELATIVE_COLUMN = 1e-7
"""Of what a number of a movement does besides the others: with less it does nothing of its own."""
MAX_NOTICED_SDS, NOTICE_DRAWS = 30.0, 500
DRAWS = 4000
MIN_DRAWS_ABOVE = 200
"""For a probability from the draws: 7 % off, and where there are fewer, gains of several cameras hardly coincide."""


@dataclass(frozen=True, eq=False)
class Motion:
    """How a camera moved: rotation (3, 3) and shift (3,) in the working frame, zoom as a part of the focal length."""

    rotation: Floats = field(default_factory=lambda: np.eye(3))
    shift: Floats = field(default_factory=lambda: np.zeros(3))
    zoom: float = 0.0


class Stand(NamedTuple):
    """Where a camera stood when it was calibrated: its centre (3,), its axes (3, 3) right, down and forward in columns,
    and the pixel (2,) about which it zooms."""

    centre: Floats
    axes: Floats
    middle: Floats

    @classmethod
    def of(cls, model: CameraModel) -> Stand:
        """From its lens and pose; of a camera that has no lens model, from what it sees in the middle of its image.

        Args:
            model: The camera.
        """
        camera = model.camera
        if isinstance(camera, CentralCamera):
            return cls(camera.pose.centre, camera.pose.rotation.T, np.array([camera.lens.cx, camera.lens.cy]))
        if isinstance(camera, GeneralCamera) and not camera.mirrored:
            return cls(camera.pose.centre, camera.pose.rotation.T, camera.centre)
        middle, side = model.image.centre, np.array([AXIS_STEP_HALF_SIDES * model.image.half, 0.0])
        centre, rays = camera.lines(np.stack([middle, middle + side, middle - side]))
        forward = rays[0] / np.linalg.norm(rays[0])
        right = rays[1] - rays[2]
        right = right - (right @ forward) * forward
        right = right / np.linalg.norm(right)
        return cls(centre, np.stack([right, np.cross(forward, right), forward], axis=1), middle)

    def numbers(self, motion: Motion) -> Floats:
        """(7,) of a movement, about and along the camera's own axes.

        Args:
            motion: In the working frame.
        """
        turn = self.axes.T @ vector_from_rotation(motion.rotation)
        return np.array([*turn, *(self.axes.T @ motion.shift), motion.zoom])

    def moved(self, motion: Motion, step: Floats) -> Motion:
        """A movement after a step.

        Args:
            motion: Before it.
            step: (7,) about and along the camera's axes.
        """
        turn = rotation_from_vector(self.axes @ step[TURN])
        return Motion(turn @ motion.rotation, motion.shift + self.axes @ step[SHIFT], motion.zoom + float(step[ZOOM]))


class MovedViews(NamedTuple):
    """What a camera that moved sees of n points: mean pixels uv (n, 2); by_point (n, 2, 3); by_step (n, 2, 7) of a step
    more; half (n, 2, k) by the white unknowns of the camera; rest (n,) variance of each view's own."""

    uv: Floats
    by_point: Floats
    by_step: Floats
    half: Floats
    rest: Floats


def see_moved(
    model: CameraModel, stand: Stand, motion: Motion, points: Floats, root: Floats | None = None
) -> MovedViews:
    """What a camera sees after a movement: what it saw before of points that moved the other way.

    Args:
        model: The camera as it was calibrated.
        stand: Where it stood.
        motion: How it moved.
        points: (n, 3) in the working frame.
        root: (k, P) of what is unknown of it; None where that does not matter.
    """
    off = points - stand.centre - motion.shift
    before = off @ motion.rotation + stand.centre
    rows, slope = model.rows_and_slope(before)
    grown = 1 + motion.zoom
    by_point = grown * slope @ motion.rotation.T
    by_turn = by_point @ cross_matrices(off) @ stand.axes
    about = rows.mean - stand.middle
    by_step = np.concatenate([by_turn, -by_point @ stand.axes, about[..., None]], axis=2)
    half = np.zeros((len(points), 2, 0)) if root is None else grown * apply_covariance_root(rows, root)
    return MovedViews(stand.middle + grown * about, by_point, by_step, half, grown**2 * rows.rest)


class Equations(NamedTuple):
    """Residuals of points, whitened, without what their positions explain, eq. (M1): left (N,); by_step (N, 7 C) of a
    step of all cameras' movements; half (N, q) of what is unknown of the cameras; owner (N,) the point of each; to_x
    (n, 3) the step of the positions, if all else is as it is; volume: twice the logarithm of what the density of the
    pixels is divided by before, with nothing known of the positions."""

    left: Floats
    by_step: Floats
    half: Floats
    owner: NDArray[np.int64]
    to_x: Floats
    volume: float

    def whitened(self) -> Whitened:
        """With the cameras' unknowns integrated out, eq. (M2)."""
        factor = np.linalg.cholesky(np.eye(len(self.left)) + self.half @ self.half.T)
        found = solve_triangular(factor, np.column_stack([self.left, self.by_step]), lower=True)
        return Whitened(found[:, 0], found[:, 1:], self.volume + 2 * float(np.sum(np.log(np.diag(factor)))))


class Whitened(NamedTuple):
    """Independent standard residuals: left (N,), by_step (N, 7 C), and the volume with that of the cameras' unknowns.

    A movement may carry views to where less is known of the cameras; the volume keeps that from counting for it."""

    left: Floats
    by_step: Floats
    volume: float

    @property
    def deviance(self) -> float:
        """Minus twice the log likelihood, up to a constant."""
        return float(self.left @ self.left) + self.volume

    def gain(self, camera: int) -> float:
        """How much a movement of one camera lowers chi-squared, to first order; whatever else is true, a chi-squared
        variable if nothing moved.

        Args:
            camera: Its number.
        """
        basis = _basis(self.by_step[:, NUMBERS * camera : NUMBERS * (camera + 1)])
        return float(np.sum((basis.T @ self.left) ** 2))


@dataclass(frozen=True, eq=False)
class CheckedRig:
    """What is checked: cameras, and what they saw of n points.

    Attributes:
        posterior: What is known of the C cameras.
        uv: (n, C, 2) pixels, NaN where not seen.
        noise: (n, C) sd of each view, pixels.
        settings: Which views of a point disagree.
    """

    posterior: Posterior
    uv: Floats
    noise: Floats
    settings: RigModelSettings = DEFAULT_SETTINGS

    @cached_property
    def seen(self) -> Bools:
        """(n, C) the views."""
        return np.asarray(np.isfinite(self.uv).all(axis=2))

    @cached_property
    def stands(self) -> list[Stand]:
        """Of all cameras."""
        return [Stand.of(model) for model in self.posterior.models]

    @cached_property
    def roots(self) -> list[tuple[Floats, slice]]:
        """Of each camera a root (k, P) of what is unknown of it, and which of the q white unknowns these k are."""
        found = [self.posterior.root(c) for c in range(len(self.posterior.models))]
        if self.posterior.tied:
            return [(root, slice(0, len(root))) for root in found]
        ends = np.cumsum([0, *(len(root) for root in found)])
        return [(root, slice(int(a), int(b))) for root, a, b in zip(found, ends[:-1], ends[1:], strict=True)]

    def select(self, rows: NDArray[np.int64]) -> CheckedRig:
        """Of some points.

        Args:
            rows: Their numbers.
        """
        return CheckedRig(self.posterior, self.uv[rows], self.noise[rows], self.settings)

    def locate(self, seen: Bools) -> tuple[Floats, Bools]:
        """Where points are, and which of the views `seen` (n, C) agree on it.

        Args:
            seen: The views to use.

        Returns:
            (n, 3), NaN for none, and (n, C).
        """
        found = locate(self.posterior, np.where(seen[..., None], self.uv, np.nan), self.noise, settings=self.settings)
        return found.xyz, seen & ~found.left_out

    def meet(self) -> Floats:
        """(n, 3) where the lines of sight meet best, however badly."""
        found = [model.camera.lines(self.uv[:, c]) for c, model in enumerate(self.posterior.models)]
        centres, directions = np.array([line[0] for line in found]), np.stack([line[1] for line in found], axis=1)
        return meet_lines(centres, directions, self.seen)

    def equations(self, motions: Sequence[Motion], x: Floats, seen: Bools, unknowns: bool = True) -> Equations:
        """The linear model of what is left about positions and movements, eq. (M1).

        Args:
            motions: Of each camera.
            x: (n, 3) positions.
            seen: (n, C) the views to use, two or more of each point.
            unknowns: Whether what is unknown of the cameras is wanted.
        """
        n, C = seen.shape
        q = max(part.stop for _, part in self.roots) if unknowns else 0
        r, D, J, A = (np.zeros((n, C, 2, *shape)) for shape in ((), (3,), (NUMBERS * C,), (q,)))
        volume = 0.0
        for c, model in enumerate(self.posterior.models):
            rows = np.flatnonzero(seen[:, c])
            root, part = self.roots[c]
            views = see_moved(model, self.stands[c], motions[c], x[rows], root if unknowns else None)
            weight = 1 / np.sqrt(self.noise[rows, c] ** 2 + views.rest)
            volume -= 4 * float(np.sum(np.log(weight)))
            r[rows, c] = weight[:, None] * (self.uv[rows, c] - views.uv)
            D[rows, c] = weight[:, None, None] * views.by_point
            J[rows, c, :, NUMBERS * c : NUMBERS * (c + 1)] = weight[:, None, None] * views.by_step
            if unknowns:
                A[rows, c, :, part] = weight[:, None, None] * views.half
        pairs = seen.repeat(2, axis=1)
        order = np.argsort(~pairs, axis=1, kind="stable")[..., None]  # what is seen first
        r, D, J, A = (np.take_along_axis(a.reshape(n, 2 * C, -1), order, axis=1) for a in (r, D, J, A))
        Q, R = np.linalg.qr(D, mode="complete")
        rest = Q[:, :, 3:].swapaxes(1, 2)
        use = np.arange(2 * C - 3) < (pairs.sum(axis=1) - 3)[:, None]
        to_x = np.linalg.solve(R[:, :3], Q[:, :, :3].swapaxes(1, 2) @ r)[..., 0]
        volume += 2 * float(np.sum(np.log(np.abs(np.diagonal(R[:, :3], axis1=1, axis2=2)))))
        return Equations((rest @ r)[use][:, 0], (rest @ J)[use], (rest @ A)[use], np.nonzero(use)[0], to_x, volume)


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the views say of one camera having moved alone.

    Attributes:
        camera: Its number.
        motion: The most probable movement.
        step: (7,) the same about and along its axes.
        cov: (7, 7) its covariance.
        gain: How much a movement lowers chi-squared, to first order about none.
        log_odds: Of the movement against none, but for the odds before.
        x: (n, 3) where the points are after it.
        seen: (n, C) the views that it was found from.
    """

    camera: int
    motion: Motion
    step: Floats
    cov: Floats
    gain: float
    log_odds: float
    x: Floats
    seen: Bools


Unmoved = dict[bytes, "Whitened | None"]
"""Views in use -> the equations if nothing moved, which are those of every camera that may have moved."""


def find_movement(rig: CheckedRig, camera: int, unmoved: Unmoved | None = None) -> Evidence | None:
    """The most probable movement of one camera, if the others stand.

    Args:
        rig: The cameras and what they saw.
        camera: The number of the one that may have moved.
        unmoved: What was found before, of other cameras of the same rig; it is added to.

    Returns:
        The movement; None where nothing can be said.
    """
    stand, prior = rig.stands[camera], 1 / PRIOR_SDS**2
    others = rig.seen.copy()
    others[:, camera] = False
    x, agree = rig.locate(others)
    apart = np.isfinite(x).all(axis=1) & rig.seen[:, camera]
    motion, started = Motion(), bool(apart.sum() >= MIN_POINTS_TO_START)
    if started:
        motion = _start(rig, camera, x[apart], np.flatnonzero(apart))
        agree[:, camera] = rig.seen[:, camera]
    else:  # two cameras, or nearly: all that is known is where their lines of sight meet
        x, agree = rig.meet(), rig.seen.copy()
    motions = [Motion()] * len(rig.stands)
    mine = slice(NUMBERS * camera, NUMBERS * (camera + 1))
    for trimming in range(MAX_TRIMMINGS):
        alive = np.isfinite(x).all(axis=1) & (agree.sum(axis=1) >= 2)
        agree = agree & alive[:, None]
        rows = np.flatnonzero(alive)
        part = rig.select(rows)
        motions[camera] = motion
        if started or trimming:  # a few wrong views would draw the movement to where most of the others look wrong
            kept = agree[rows]
            kept[:, camera] = part.seen[:, camera]
            wrong = _contradicting(part.equations(motions, x[rows], kept))
            kept[wrong[kept[wrong].sum(axis=1) >= 3], camera] = False
            if trimming and np.array_equal(kept, agree[rows]):
                break
            agree[rows] = kept
        if not agree[:, camera].any():
            return None
        for _ in range(MAX_STEPS):
            motions[camera] = motion
            found = part.equations(motions, x[rows], agree[rows], unknowns=False)
            X, number = found.by_step[:, mine], stand.numbers(motion)
            information = X.T @ X + np.diag(prior)
            step = np.linalg.solve(information, X.T @ found.left - prior * number)
            step = step / max(1.0, float(np.max(np.abs(step) / MAX_STEP)))
            motion, x[rows] = stand.moved(motion, np.asarray(step, dtype=np.float64)), x[rows] + found.to_x
            if not np.isfinite(step).all() or not np.isfinite(x[rows]).all():
                return None
            if step @ information @ step < CONVERGED_STEP_SDS**2:
                break
    motions[camera] = motion
    found = part.equations(motions, x[rows], agree[rows])
    there = found.whitened()
    X, number = there.by_step[:, mine], stand.numbers(motion)
    information = X.T @ X
    cov = np.asarray(np.linalg.inv(information + np.diag(prior)), dtype=np.float64)
    last = np.asarray(cov @ (X.T @ there.left - prior * number), dtype=np.float64)
    unmoved, key = {} if unmoved is None else unmoved, agree.tobytes()
    if key not in unmoved:
        unmoved[key] = _unmoved(part, x[rows], agree[rows])
    here = unmoved[key]
    if here is None:
        return None
    at = stand.moved(motion, last)
    lowered = here.deviance - there.deviance + float((X.T @ there.left) @ cov @ (X.T @ there.left))
    log_odds = 0.5 * (lowered - _log_shrink(X) - float(np.sum(prior * stand.numbers(at) ** 2)))
    return Evidence(camera, at, stand.numbers(at), cov, here.gain(camera), log_odds, x, agree)


def _start(rig: CheckedRig, camera: int, x: Floats, rows: NDArray[np.int64]) -> Motion:
    """A movement from where the other cameras see points, whatever part of the camera's views is wrong."""
    model, stand = rig.posterior.models[camera], rig.stands[camera]
    uv, noise = rig.uv[rows, camera], rig.noise[rows, camera, None]

    @lru_cache(maxsize=1)  # the slope is asked for where the residuals were last
    def look(numbers: bytes) -> MovedViews:
        return see_moved(model, stand, stand.moved(Motion(), np.frombuffer(numbers) * PRIOR_SDS), x)

    def off(numbers: Floats) -> Floats:
        seen = look(numbers.tobytes()).uv
        return np.asarray(np.nan_to_num((uv - seen) / noise, nan=1e6).ravel(), dtype=np.float64)

    def slope(numbers: Floats) -> Floats:  # of a step after the turn, which is near enough
        by_step = look(numbers.tobytes()).by_step
        return np.asarray(np.nan_to_num(-by_step * PRIOR_SDS / noise[..., None]).reshape(-1, NUMBERS), dtype=np.float64)

    found = least_squares(off, np.zeros(NUMBERS), slope, loss="cauchy", f_scale=3.0, x_scale=1e-2, max_nfev=100)
    return stand.moved(Motion(), found.x * PRIOR_SDS)


def _contradicting(found: Equations) -> NDArray[np.int64]:
    """Points whose views contradict each other, each for itself."""
    wrong = []
    for point in np.unique(found.owner):
        rows = found.owner == point
        half = found.half[rows]
        chi2 = found.left[rows] @ np.linalg.solve(np.eye(rows.sum()) + half @ half.T, found.left[rows])
        if chdtrc(rows.sum(), chi2) < WRONG_VIEW_P_VALUE:
            wrong.append(int(point))
    return np.array(wrong, dtype=np.int64)


def _unmoved(rig: CheckedRig, x: Floats, seen: Bools) -> Whitened | None:
    """The equations if nothing moved, with the positions that suit the views best; None where there are none."""
    motions = [Motion()] * len(rig.stands)
    for _ in range(MAX_STEPS):
        found = rig.equations(motions, x, seen, unknowns=False)
        x = x + found.to_x
        if not np.isfinite(x).all():
            return None
        if np.abs(found.to_x).max() < 1e-9:
            break
    return rig.equations(motions, x, seen).whitened()


# ---- what to conclude


@dataclass(frozen=True, eq=False)
class Check:
    """Whether the rig stands as it was calibrated.

    Attributes:
        evidence: Of each camera that can be judged, what speaks for its having moved alone; the likeliest first.
        p_value: Probability that chance alone makes one of them gain as much, if nothing moved.
        named: The camera that moved, where that is clear.
        candidates: Cameras of which one moved, where it is not clear which.
        several: The rig is not as it was, and no movement of one camera explains it.
        contradicting: Cameras of which many views contradict those of the others, whichever one moved.
        points: How many points were used.
        noise_ratio: Sd of what is left, whatever moved, over what is stated.
        design: How the views depend on movements; None where they do not agree on any point.
        level: How often a rig that stands raises an alarm.
        rig: The cameras, and the points that were used.
    """

    evidence: tuple[Evidence, ...]
    p_value: float
    named: Evidence | None
    candidates: tuple[int, ...]
    several: bool
    contradicting: tuple[int, ...]
    points: int
    noise_ratio: float
    design: Design | None
    level: float
    rig: CheckedRig

    @cached_property
    def noticed(self) -> Floats:
        """(C, 7) the smallest movement of each camera, by each of its numbers alone, that would be named in half of all
        cases; infinite where none would be."""
        return (
            np.full((len(self.rig.stands), NUMBERS), np.inf) if self.design is None else self.design.noticed(self.level)
        )

    @property
    def alarm(self) -> bool:
        """Whether the rig is not as it was calibrated."""
        return self.named is not None or bool(self.candidates) or self.several


def check_movement(rig: CheckedRig, *, level: float = 0.05, seed: int = 0) -> Check | None:
    """Look whether a camera moved since the rig was calibrated.

    Args:
        rig: The cameras and what they saw.
        level: How often a rig that stands may raise an alarm.
        seed: Of random numbers.

    Returns:
        What was found; None where no two cameras saw enough.
    """
    rng = np.random.default_rng(seed)
    rig = rig.select(_choose(rig.seen, rng))
    unmoved: Unmoved = {}
    evidence = [found for c in range(len(rig.stands)) if (found := find_movement(rig, c, unmoved)) is not None]
    every = tuple(range(len(rig.stands)))
    if not evidence:  # too few views, or hardly two that agree
        if np.sum(rig.seen.sum(axis=1) >= 2) < MIN_POINTS_TO_START:
            return None
        return Check((), 0.0, None, (), True, every, len(rig.seen), np.nan, None, level, rig)
    evidence.sort(key=lambda one: -one.log_odds)
    best = evidence[0]
    motions = [best.motion if c == best.camera else Motion() for c in range(len(rig.stands))]
    rows = np.flatnonzero(best.seen.any(axis=1))
    left, by_step, _ = rig.select(rows).equations(motions, best.x[rows], best.seen[rows]).whitened()
    everything = _basis(by_step)
    freedom = len(left) - everything.shape[1]
    rest = left - everything @ (everything.T @ left)
    noise_ratio = float(np.sqrt(rest @ rest / freedom)) if freedom >= MIN_FREEDOM_FOR_NOISE else 1.0
    design = Design(by_step, freedom if freedom >= MIN_FREEDOM_FOR_NOISE else None, rng)
    gains = np.array([one.gain for one in evidence]) / noise_ratio**2
    p_value = design.tail(gains.max())
    named, candidates = None, tuple[int, ...]()
    counts = rig.seen.sum(axis=0)
    lost = counts - best.seen.sum(axis=0)
    contradicting = tuple(map(int, np.flatnonzero(lost > np.maximum(MAX_LEFT_OUT_SHARE * counts, MIN_LEFT_OUT))))
    several = bool(contradicting)  # a camera that was knocked away looks like one of wrong detections
    if p_value < level and not several:
        odds = np.array([one.log_odds for one in evidence]) / noise_ratio**2
        share = np.exp(odds - odds.max()) / np.sum(np.exp(odds - odds.max()))
        witnessed = np.sum(best.seen.sum(axis=1) >= 3) >= MIN_POINTS_TO_START  # else only a pair's relative pose shows
        candidates = tuple(one.camera for one, s in zip(evidence, share, strict=True) if s > 1 - SURE or not witnessed)
        after = design.without(best.camera)
        several = after.tail(after.largest(left) / noise_ratio**2) < AFTER_LEVEL
        if several:
            candidates = ()
        elif share[0] > SURE and witnessed:
            named, candidates = best, ()
    return Check(
        tuple(evidence), p_value, named, candidates, several, contradicting, len(rows), noise_ratio, design, level, rig
    )


class Design:
    """How the views depend on movements, and what chance does: random draws of what every camera's movement gains."""

    def __init__(self, by_step: Floats, freedom: int | None, rng: np.random.Generator) -> None:
        C = by_step.shape[1] // NUMBERS
        self.parts = [by_step[:, NUMBERS * c : NUMBERS * (c + 1)] for c in range(C)]
        self.bases = [_basis(part) for part in self.parts]
        self.rng, self.freedom = rng, freedom
        together = np.concatenate(self.bases, axis=1)
        self.ends = np.cumsum([0, *(basis.shape[1] for basis in self.bases)])
        root = covariance_root(together.T @ together)
        self.draws = rng.standard_normal((DRAWS, len(root))) @ root.T
        self.scale = rng.chisquare(freedom, DRAWS) / freedom if freedom else np.ones(DRAWS)
        self.maxima = np.sort(self.gains(self.draws).max(axis=1) / self.scale) if together.shape[1] else np.zeros(1)

    def gains(self, seen: Floats) -> Floats:
        """What the movement of each camera gains.

        Args:
            seen: (k, sum of ranks) k draws of what the bases see, one after the other.

        Returns:
            (k, C).
        """
        squares = np.concatenate([np.zeros((len(seen), 1)), np.cumsum(seen**2, axis=1)], axis=1)
        return np.asarray(np.diff(squares[:, self.ends], axis=1), dtype=np.float64)

    def largest(self, left: Floats) -> float:
        """What the movement of one of the cameras gains, at most.

        Args:
            left: (N,) residuals.
        """
        return max(float(np.sum((basis.T @ left) ** 2)) for basis in self.bases)

    def tail(self, gain: float) -> float:
        """The probability that chance gains as much: from the draws, or where few of them do, at most the sum of those
        of all cameras.

        Args:
            gain: In units of the noise.
        """
        ranks = np.diff(self.ends)
        ranks = ranks[ranks > 0]
        each = chdtrc(ranks, gain) if self.freedom is None else fdtrc(ranks, self.freedom, gain / ranks)
        above = int(np.sum(self.maxima >= gain))
        return float(above / len(self.maxima)) if above >= MIN_DRAWS_ABOVE else float(min(1.0, np.sum(each)))

    def without(self, camera: int) -> Design:
        """Of the other cameras, after this one has moved as it suits the views best.

        Args:
            camera: Its number.
        """
        basis = self.bases[camera]
        left = [part - basis @ (basis.T @ part) for c, part in enumerate(self.parts) if c != camera]
        return Design(np.concatenate(left, axis=1), self.freedom, self.rng)

    def noticed(self, level: float) -> Floats:
        """(C, 7) the size of each number of a movement at which it is named half the time.

        Args:
            level: Of the alarm.
        """
        threshold = float(np.quantile(self.maxima, 1 - level))
        draws, scale = self.draws[:NOTICE_DRAWS], self.scale[:NOTICE_DRAWS, None]
        shrink = np.array([_log_shrink(part) for part in self.parts])
        return np.array([[self._size(c, i, draws, scale, threshold, shrink) for i in range(NUMBERS)]
                         for c in range(len(self.parts))])  # fmt: skip

    def _size(self, c: int, i: int, draws: Floats, scale: Floats, threshold: float, shrink: Floats) -> float:
        column = self.parts[c][:, i]
        shift = np.concatenate([basis.T @ column for basis in self.bases])
        norm = float(np.sqrt(np.sum((self.bases[c].T @ column) ** 2)))
        if norm == 0:
            return float("inf")
        low, high = 0.0, MAX_NOTICED_SDS
        for _ in range(20):
            middle = 0.5 * (low + high)
            gains = self.gains(draws + middle / norm * shift) / scale
            odds = 0.5 * (gains - shrink)
            share = 1 / np.sum(np.exp(np.minimum(odds - odds[:, c : c + 1], 50.0)), axis=1)
            named = (gains.max(axis=1) > threshold) & (share > SURE)
            low, high = (low, middle) if named.mean() > 0.5 else (middle, high)
        return high / norm if high < 0.999 * MAX_NOTICED_SDS else float("inf")


def _log_shrink(part: Floats) -> float:
    information = part.T @ part
    return float(np.linalg.slogdet(np.eye(NUMBERS) + np.outer(PRIOR_SDS, PRIOR_SDS) * information)[1])


def _basis(columns: Floats) -> Floats:
    """(N, k) orthonormal, of what columns (N, m) of different units span."""
    sizes = np.linalg.norm(columns, axis=0)
    return np.asarray(orth(columns / np.where(sizes > 0, sizes, 1.0), rcond=MIN_RELATIVE_COLUMN), dtype=np.float64)


def _choose(seen: Bools, rng: np.random.Generator) -> NDArray[np.int64]:
    """Points with two views or more; of many a part, at random."""
    rows = np.flatnonzero(seen.sum(axis=1) >= 2)
    counts = np.cumsum(2 * seen[rows].sum(axis=1) - 3)
    if len(rows) and counts[-1] > MAX_EQUATIONS:
        rows = rng.permutation(rows)
        rows = np.sort(rows[np.cumsum(2 * seen[rows].sum(axis=1) - 3) <= MAX_EQUATIONS])
    return rows
