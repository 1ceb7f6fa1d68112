"""Which kind of camera each one is, and where it starts: from no guess, in several ways that share no assumption.

Ordinary cameras take the quick path: the ladder of lenses, one refinement, and the proof that nothing freer is clearly
better. All others are started by the ladder, by a direct linear transformation and by an affine projection, each
mirrored too; the best go on, and the kind is chosen by marginal likelihood, with the rig's other cameras as a hint.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from implicam.calibrators.forward_gp.evidence import LOG_NOISE_PRIOR
from implicam.calibrators.forward_gp.families import (
    FAMILIES,
    MAX_CHOICE_VIEWS,
    MIRRORED_PRIOR_ODDS,
    Views,
    family_prior,
    log_evidences,
    near_prior,
    widest_angle,
)
from implicam.cameras import KannalaBrandt
from implicam.errors import FitError
from implicam.geometry import (
    Bools,
    Floats,
    Pose,
    camera_from_linear,
    pixel_shape_of,
    resect_affine,
    resect_any_lens,
    resect_robustly,
)
from implicam.rig_model.camera import PERSPECTIVE_K, CentralCamera, Image
from implicam.rig_model.general_camera import MIN_RHO, RHO, AnyCamera, GeneralCamera
from implicam.rig_model.initialise import MAX_ERROR_MEDIANS, InitialCamera, levenberg_marquardt
from implicam.rig_model.training_data import MIN_POINTS_PER_CAMERA

QUICK_MEDIAN = 2e-3
"""Median error of an ordinary camera, in half the longer side; more needs a look at everything else."""

QUICK_GAIN = 0.6
"""A freer camera that brings the median error below this part asks for the whole choice."""

QUICK_NATS = 3.0
"""So does one whose evidence, odds aside, is better by this less."""

QUICK_NOISES, QUICK_LEFT = 2.0, 0.4
"""Where a camera's evidence is better than a freer one's by as much from where it stands, its median error is below so
many noises, and one step towards the freer camera leaves so much of the squares, no look from farther on is needed."""

MAX_START_VIEWS = 80
"""Views that starts are refined with."""

SHORT_STEPS, PROBE_STEPS, LONG_STEPS, FINAL_STEPS = 8, 10, 25, 60
"""Steps of refinement: of every start, of the freer camera beside an ordinary one, of the best starts, of each kind."""

ROUGH_GAIN, FINE_GAIN = 1e-3, 1e-7
"""The part of its misfit that a step must gain for another to follow, while starts are compared and in the end."""

MAX_MEDIAN = 0.05
"""Median error, in half the longer side, beyond which a camera explains nothing."""

MAX_ERROR_RATIO = 10.0
"""A start whose errors are so many times the best camera's is no start for the kinds."""

BEST_STARTS = 3
"""Starts of each sign that go on."""

CLEARLY_WRONG_RATIO = 0.3
"""The sign whose best camera leaves the other's median times this is the right one without further question."""

MIN_TOLERATED_NOISES = 10.0
"""Stated or usual noises that a view may be off and still start the fit, which judges it better."""

FEW_VIEWS = 18
"""Views fewer than which a camera of 17 numbers may go through most of them, whatever the others say."""

WANDERING_NOISES = 5.0
"""Median error of a free camera, in stated or usual noises, from which its field is so large that it would wander.
Where it is small, a prior about the camera found would make error bars too small."""

AFFINE_RHOS = (0.02, 0.2)
"""Inverse distances that an affine start tries."""

ROUNDS_OF_CHOICE = 5


class Candidate(NamedTuple):
    """One kind and sign of one camera, refined; evidence in nats, odds aside."""

    camera: GeneralCamera
    family: str
    inliers: Bools
    evidence: float

    @property
    def kind(self) -> tuple[str, bool]:
        """Family, and whether it is mirrored."""
        return self.family, self.camera.mirrored


class Start(NamedTuple):
    """A rough camera and the views (n,) that it explains; doubtful: too many others are far off."""

    camera: GeneralCamera
    inliers: Bools
    doubtful: bool = False


class Scene(NamedTuple):
    """What one camera saw: points (n, 3), pixels (n, 2), relative noise (n,), image, stated noise or NaN."""

    points: Floats
    uv: Floats
    relative: Floats
    image: Image
    stated: float

    def error(self, camera: GeneralCamera) -> Floats:
        """(n,) px, infinite where the camera sees nothing."""
        away = np.linalg.norm(camera.pixel(self.points) - self.uv, axis=1)
        return np.asarray(np.where(np.isnan(away), np.inf, away), dtype=np.float64)

    def near(self, error: Floats, inliers: Bools) -> Bools:
        """The views that a camera explains, judged by the median of those kept; of few views, which a camera of
        seventeen numbers may nearly go through, by the noise."""
        limit = max(MAX_ERROR_MEDIANS * float(np.median(error[inliers])), MIN_TOLERATED_NOISES * self.noise)
        return np.asarray(error <= limit, dtype=np.bool_)

    @property
    def noise(self) -> float:
        """Px, as stated or usual."""
        return float(self.stated) if np.isfinite(self.stated) else float(np.exp(LOG_NOISE_PRIOR[0])) * self.image.half


def candidates(whole: Scene) -> list[Candidate]:
    """The kinds of camera that explain the views; one where it is ordinary. FitError where there is none."""
    if len(whole.points) < MIN_POINTS_PER_CAMERA:
        raise FitError(f"{len(whole.points)} known points are seen; a camera needs at least {MIN_POINTS_PER_CAMERA}.")
    ladder = _ladder(whole, mirrored=False, subsets=False)
    if ladder is not None and not ladder.doubtful:
        quick = _quick(whole, ladder)
        if quick is not None:
            return [quick]
    linear = _from_dlt(whole)
    if ladder is None or ladder.doubtful:
        # subsets are for wrong views; where a linear projection does well without them, it is the camera that is odd
        if ladder is None or linear is None or _score(whole, linear.camera) > QUICK_GAIN * _score(whole, ladder.camera):
            ladder = _from_ladder(whole, mirrored=False)
        quick = _quick(whole, ladder) if ladder is not None else None
        if quick is not None:
            return [quick]
    return _thorough(whole, ladder, linear)


def choose(rig: Sequence[list[Candidate]]) -> list[Candidate]:
    """One candidate of each camera: evidence, prior odds, and what the rig's other cameras are."""
    chosen = [max(some, key=lambda one: one.evidence + np.log(_weight(one, []))) for some in rig]
    for _ in range(ROUNDS_OF_CHOICE):
        before = [one.kind for one in chosen]
        for c, some in enumerate(rig):
            others = [one.kind for k, one in enumerate(chosen) if k != c]
            chosen[c] = max(some, key=lambda one: one.evidence + np.log(_weight(one, others)))
        if [one.kind for one in chosen] == before:
            break
    return chosen


def candidate_again(whole: Scene, camera: AnyCamera, family: str) -> Candidate | None:
    """A camera that fitted most of these points a moment ago, refined; None where it no longer does."""
    if not isinstance(camera, GeneralCamera) or family not in FAMILIES:
        return None
    error = whole.error(camera)
    inliers = whole.near(error, np.isfinite(error))
    if inliers.sum() < max(MIN_POINTS_PER_CAMERA, len(error) / 2):
        return None
    found, inliers = _refined(camera, family, whole, inliers, FINAL_STEPS, rounds=4)
    return Candidate(found, family, inliers, 0.0)


def as_started(one: Candidate, whole: Scene, some: Sequence[Candidate]) -> InitialCamera:
    """What the fit starts from; some: all candidates of the camera."""
    prior = family_prior(one.camera, one.family, whole.image, _widest(one.camera, whole.points[one.inliers]))
    left = float(np.median(whole.error(one.camera)[one.inliers]))
    if one.family == "free" and left > WANDERING_NOISES * whole.noise:
        prior = near_prior(one.camera, prior, whole.image)
    inliers = one.inliers & np.isfinite(whole.error(one.camera))
    ordinary = [float(np.median(whole.error(other.camera))) for other in some if other.kind == ("ordinary", False)]
    left = ordinary[0] if ordinary and one.kind != ("ordinary", False) else float("nan")
    return InitialCamera(one.camera, prior, inliers, one.family, left)


def _weight(one: Candidate, others: list[tuple[str, bool]]) -> float:
    families = sum(family == one.family for family, _ in others)
    signs = sum(mirrored == one.camera.mirrored for _, mirrored in others)
    total = sum(kind.weight for kind in FAMILIES.values())
    of_sign = MIRRORED_PRIOR_ODDS if one.camera.mirrored else 1.0
    return (
        (FAMILIES[one.family].weight + families)
        / (total + len(others))
        * ((of_sign + signs) / (1 + MIRRORED_PRIOR_ODDS + len(others)))
    )


def _widest(camera: GeneralCamera, points: Floats) -> float:
    return max(widest_angle(camera, points), 1e-4)


def _refined(
    camera: GeneralCamera,
    family: str,
    scene: Scene,
    inliers: Bools,
    steps: int,
    rounds: int = 1,
    gain: float = FINE_GAIN,
) -> tuple[GeneralCamera, Bools]:
    """The camera of that kind that explains the views kept, and those that it then explains."""
    for _ in range(rounds):
        rows = np.flatnonzero(inliers)
        if len(rows) > MAX_START_VIEWS:
            rows = rows[np.random.default_rng(0).choice(len(rows), MAX_START_VIEWS, replace=False)]
        points, uv = scene.points[rows], scene.uv[rows]
        prior = family_prior(camera, family, scene.image, _widest(camera, points))
        error = scene.error(camera)
        usual = float(np.median(error[rows]))
        sd = max(usual if np.isfinite(usual) else scene.image.half, 1e-5 * scene.image.half)
        found = levenberg_marquardt(camera, prior, points, uv, sd, steps, gain)
        assert isinstance(found, GeneralCamera)
        camera = found
        inside = scene.near(scene.error(camera), inliers)
        if inside.sum() < MIN_POINTS_PER_CAMERA or (inside == inliers).all():
            break
        inliers = inside
    return camera, inliers


def _from_ladder(scene: Scene, *, mirrored: bool, subsets: bool = True) -> Start | None:
    """The ladder's camera; None where it has none."""
    try:
        return _ladder(scene, mirrored=mirrored, subsets=subsets)
    except FitError:
        return None


def _ladder(scene: Scene, *, mirrored: bool, subsets: bool) -> Start | None:
    """The same; FitError where the points fix no camera, whatever its lens."""
    uv, middle = scene.uv, scene.image.centre
    if mirrored:
        uv = uv * [-1.0, 1.0] + [2 * middle[0], 0.0]
    found = resect_any_lens(scene.points, uv, middle=middle, subsets=subsets)
    k = PERSPECTIVE_K if found.pinhole else np.zeros(4)
    lens = KannalaBrandt(found.focal, found.focal, *middle.tolist(), *k.tolist())
    central = CentralCamera(lens, found.camera_from_world)
    about = float(middle[0]) if mirrored else None
    camera = GeneralCamera.from_central(central, mirrored_about=about)
    if camera.rho < MIN_RHO:
        return None
    inliers = found.inliers
    if len(inliers) > inliers.sum() and len(scene.points) > 120:  # the ladder looked at some of many
        error = scene.error(camera)
        inliers = scene.near(error, found.inliers)
    return Start(camera, inliers if inliers.sum() >= MIN_POINTS_PER_CAMERA else found.inliers, found.doubtful)


def _quick(scene: Scene, ladder: Start) -> Candidate | None:
    """The ordinary camera, if nothing freer is clearly better."""
    camera, inliers = _refined(ladder.camera, "ordinary", scene, ladder.inliers, FINAL_STEPS * 5, rounds=4)
    error = scene.error(camera)
    median = float(np.median(error[inliers]))
    if (
        inliers.sum() < MIN_POINTS_PER_CAMERA
        or not median < QUICK_MEDIAN * scene.image.half
        or camera.rho < 4 * MIN_RHO
    ):
        return None
    views = _common_views(scene, inliers)
    tight, free_from_here = _evidences(camera, ("ordinary", "free"), views)
    if tight > free_from_here + QUICK_NATS and median < QUICK_NOISES * scene.noise:
        free, free_kept = _refined(camera, "free", scene, inliers, 1, gain=ROUGH_GAIN)
        left = np.sum(scene.error(free)[inliers] ** 2) / np.sum(error[inliers] ** 2)
        if left > QUICK_LEFT and free_kept.sum() <= inliers.sum():
            return Candidate(camera, "ordinary", inliers, tight)
    free, free_kept = _refined(camera, "free", scene, inliers, PROBE_STEPS, gain=ROUGH_GAIN)
    free_error = scene.error(free)
    # what seventeen free numbers gain over eleven by chance is no reason; of few views the evidence must do
    by_chance = np.sqrt(max(2 * inliers.sum() - 17, 0) / (2 * inliers.sum() - 11))
    better = inliers.sum() >= FEW_VIEWS and np.median(free_error[inliers]) < QUICK_GAIN * by_chance * median
    if better or free_kept.sum() > inliers.sum() or tight < _evidences(free, ("free",), views)[0] - QUICK_NATS:
        return None
    return Candidate(camera, "ordinary", inliers, tight)


def _thorough(scene: Scene, ladder: Start | None, linear: Start | None) -> list[Candidate]:
    """Every start, the best few of each sign, and each kind from them."""
    starts = list(_starts(scene, ladder, linear))
    if not starts:
        raise FitError("no camera sees the known points at these pixels.", fix="look for wrong detections")
    best: dict[bool, list[tuple[float, GeneralCamera, Bools]]] = {False: [], True: []}
    for camera, inliers, _ in starts:
        found, explained = _refined(camera, "free", scene, inliers, SHORT_STEPS, gain=ROUGH_GAIN)
        best[camera.mirrored].append((_score(scene, found), found, explained))
    for sign, some in best.items():
        some.sort(key=lambda one: one[0])
        again = [
            _refined(camera, "free", scene, inliers, LONG_STEPS, rounds=2) for _, camera, inliers in some[:BEST_STARTS]
        ]
        best[sign] = sorted(((_score(scene, c), c, k) for c, k in again), key=lambda one: one[0])
    leading = {sign: some[0][0] if some else np.inf for sign, some in best.items()}
    signs = [sign for sign in best if best[sign] and not leading[sign] * CLEARLY_WRONG_RATIO > leading[not sign]]
    common = min((best[sign][0] for sign in signs), key=lambda one: one[0])[2]
    views = _common_views(scene, common)
    found_all = [one for sign in signs for one in _kinds(scene, views, best[sign][0], sign)]
    usable = [one for one in found_all if np.isfinite(one.evidence)]
    if not usable:
        raise FitError("no camera sees the known points at these pixels.", fix="look for wrong detections")
    return usable


def _kinds(
    scene: Scene,
    views: Views,
    best: tuple[float, GeneralCamera, Bools],
    sign: bool,
) -> Iterator[Candidate]:
    """Each kind, from the best free camera and from the ladder of what that one explains."""
    _, free, inliers = best
    right = Scene(scene.points[inliers], scene.uv[inliers], scene.relative[inliers], scene.image, scene.stated)
    ladder = _from_ladder(right, mirrored=sign, subsets=False)
    others = [] if ladder is None else [ladder.camera]
    for family, kind in FAMILIES.items():
        shape = free.shape if kind.p > 0.01 else np.zeros(2)
        tilt = free.tilt if kind.tilt > 0.01 else np.zeros(2)
        some = []
        near = [one for one in others if family == "ordinary" or _score(scene, one) < MAX_ERROR_RATIO * best[0]]
        for camera in (free.with_shape(shape, tilt), *near):
            found, explained = _refined(camera, family, scene, inliers, FINAL_STEPS, rounds=2)
            plausible = np.median(scene.error(found)[explained]) < MAX_MEDIAN * scene.image.half
            evidence = _evidences(found, (family,), views)[0] if plausible else -np.inf
            some.append(Candidate(found, family, explained, evidence))
        yield max(some, key=lambda one: one.evidence)


def _score(scene: Scene, camera: GeneralCamera) -> float:
    """A robust size of the errors at all views, px, in the middle of their logarithms: wrong views count little, and a
    camera gains nothing by going through some views better than the noise allows."""
    error = np.minimum(scene.error(camera), 1e3 * scene.image.half)
    return scene.noise * float(np.exp(0.5 * np.mean(np.log1p((error / scene.noise) ** 2))))


def _common_views(scene: Scene, inliers: Bools) -> Views:
    rows = np.flatnonzero(inliers)
    if len(rows) > MAX_CHOICE_VIEWS:
        rows = np.sort(np.random.default_rng(0).choice(rows, MAX_CHOICE_VIEWS, replace=False))
    return Views(scene.points[rows], scene.uv[rows], scene.relative[rows], scene.image, scene.stated)


def _evidences(camera: GeneralCamera, families: Sequence[str], views: Views) -> list[float]:
    widest = _widest(camera, views.points)
    priors = [family_prior(camera, family, views.image, widest) for family in families]
    return log_evidences(camera, priors, views)


def _from_dlt(scene: Scene) -> Start | None:
    try:
        P, inliers = resect_robustly(scene.points, scene.uv)
    except FitError:
        return None
    camera = _from_linear(P)
    return None if camera is None else Start(camera, inliers)


def _starts(scene: Scene, ladder: Start | None, linear: Start | None) -> Iterator[Start]:
    if ladder is not None:
        yield ladder
        if not ladder.inliers.all() and len(scene.points) < FEW_VIEWS:  # too few to say by themselves which are wrong
            yield Start(ladder.camera, np.ones(len(scene.points), dtype=np.bool_))
    mirrored = _from_ladder(scene, mirrored=True, subsets=linear is None or not linear.camera.mirrored)
    if mirrored is not None:
        yield mirrored
    if linear is not None:
        yield linear
        farther = np.zeros(linear.camera.size)
        farther[RHO] = -0.7 * linear.camera.rho
        yield Start(linear.camera.moved(farther), linear.inliers)  # its perspective is what noise disturbs first
    yield from _from_affine(scene)


def _from_linear(P: Floats) -> GeneralCamera | None:
    """The camera of a linear projection, whatever its pixels and its sign; None where it is at infinity."""
    parts = camera_from_linear(P)
    if parts is None:
        return None
    focal, shape, centre, mirrored, pose = parts
    if not MIN_RHO < 1 / max(float(np.linalg.norm(pose.translation)), 1e-12) < 100:
        return None
    return GeneralCamera(focal, shape, np.zeros(2), centre, PERSPECTIVE_K.copy(), mirrored, pose)


def _from_affine(scene: Scene) -> Iterator[Start]:
    """Far cameras: a parallel projection and a guess of the distance, both signs."""
    try:
        A, b, inliers = resect_affine(scene.points, scene.uv)
    except FitError:
        return
    parts = pixel_shape_of(A)
    if parts is None:
        return
    scale, shape, root = parts
    across_rows = np.linalg.solve(root, A)
    for mirrored in (False, True):
        sign = np.array([-1.0 if mirrored else 1.0, 1.0])
        x, y = across_rows * sign[:, None]
        rotation = np.stack([x, y, np.cross(x, y)])
        offset = sign * np.linalg.solve(root, b - scene.image.centre)
        for rho in AFFINE_RHOS:
            angle = rho * float(np.hypot(*offset))
            if angle > 1.2:
                continue
            translation = np.append(offset * np.sinc(angle / np.pi), np.cos(angle) / rho)
            pose = Pose(rotation, translation)
            centre = scene.image.centre
            camera = GeneralCamera(scale / rho, shape, np.zeros(2), centre, PERSPECTIVE_K.copy(), mirrored, pose)
            yield Start(camera, inliers)
