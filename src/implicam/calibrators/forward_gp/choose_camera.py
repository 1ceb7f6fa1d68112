"""Which kind of camera each one is, and where it starts: from no guess, in several ways that share no assumption.

Ordinary cameras take the quick path: the ladder of lenses, one refinement, and the proof that nothing freer is clearly
better. All others are started by the ladder, by a direct linear transformation and by an affine projection, each
mirrored too; the best go on, and the kind is chosen by marginal likelihood, with the rig's other cameras as a hint.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from implicam.calibrators.forward_gp.families import (
    Scene,
    family_prior,
    log_evidences,
    near_prior,
    widest_angle,
)
from implicam.calibrators.forward_gp.settings import KINDS, ForwardGPSettings
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
from implicam.lenses import PERSPECTIVE_K, KannalaBrandt
from implicam.rig_model.camera import CentralCamera
from implicam.rig_model.general_camera import MIN_RHO, RHO, AnyCamera, GeneralCamera
from implicam.rig_model.initialise import InitialCamera, levenberg_marquardt
from implicam.rig_model.training_data import MIN_POINTS_PER_CAMERA

MAX_START_VIEWS = 80
"""Views that starts are refined with."""

SHORT_STEPS, PROBE_STEPS, LONG_STEPS, FINAL_STEPS = 8, 10, 25, 60
"""Steps of refinement: of every start, of the freer camera beside an ordinary one, of the best starts, of each kind."""

ROUGH_GAIN, FINE_GAIN = 1e-3, 1e-7
"""The part of its misfit that a step must gain for another to follow, while starts are compared and in the end."""

BEST_STARTS = 3
"""Starts of each sign that go on."""

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


def candidates(whole: Scene) -> list[Candidate]:
    """The kinds of camera that explain the views; one where it is ordinary.

    Args:
        whole: What the camera saw.

    Returns:
        The kinds, each refined.

    Raises:
        FitError: There are too few points, or no camera sees them so.
    """
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
        ratio = whole.settings.max_freer_error_ratio
        if ladder is None or linear is None or _score(whole, linear.camera) > ratio * _score(whole, ladder.camera):
            ladder = _from_ladder(whole, mirrored=False)
        quick = _quick(whole, ladder) if ladder is not None else None
        if quick is not None:
            return [quick]
    return _thorough(whole, ladder, linear)


def choose(rig: Sequence[list[Candidate]], settings: ForwardGPSettings) -> list[Candidate]:
    """One candidate of each camera: evidence, prior odds, and what the rig's other cameras are.

    Args:
        rig: Of each camera its candidates, one or more.
        settings: The prior odds.

    Returns:
        One of each camera, in the same order.
    """
    chosen = [max(some, key=lambda one: one.evidence + np.log(_weight(one, [], settings))) for some in rig]
    for _ in range(ROUNDS_OF_CHOICE):
        before = [one.kind for one in chosen]
        for c, some in enumerate(rig):
            others = [one.kind for k, one in enumerate(chosen) if k != c]
            chosen[c] = max(some, key=lambda one: one.evidence + np.log(_weight(one, others, settings)))
        if [one.kind for one in chosen] == before:
            break
    return chosen


def candidate_again(whole: Scene, camera: AnyCamera, family: str) -> Candidate | None:
    """A camera that fitted most of these points a moment ago, refined.

    Args:
        whole: What the camera saw.
        camera: As it was fitted.
        family: Its kind.

    Returns:
        The only candidate; None where the camera no longer fits, or is of no kind that is chosen among.
    """
    if not isinstance(camera, GeneralCamera) or family not in KINDS:
        return None
    error = whole.error(camera)
    inliers = whole.near(error, np.isfinite(error))
    if inliers.sum() < max(MIN_POINTS_PER_CAMERA, len(error) / 2):
        return None
    found, inliers = _refined(camera, family, whole, inliers, FINAL_STEPS, rounds=4)
    return Candidate(found, family, inliers, 0.0)


def as_started(one: Candidate, whole: Scene, some: Sequence[Candidate]) -> InitialCamera:
    """What the fit starts from.

    Args:
        one: The candidate that was chosen.
        whole: What the camera saw.
        some: All candidates of the camera.

    Returns:
        The camera with its prior, the views it explains, and what an ordinary camera would leave, in pixels.
    """
    settings, widest = whole.settings, _widest(one.camera, whole.points[one.inliers])
    prior = family_prior(one.camera, one.family, whole.image, widest, settings)
    left = float(np.median(whole.error(one.camera)[one.inliers]))
    if one.family == "free" and left > settings.wandering_error_noises * whole.noise:
        prior = near_prior(one.camera, prior, whole.image, settings)
    inliers = one.inliers & np.isfinite(whole.error(one.camera))
    ordinary = [float(np.median(whole.error(other.camera))) for other in some if other.kind == ("ordinary", False)]
    left = ordinary[0] if ordinary and one.kind != ("ordinary", False) else float("nan")
    return InitialCamera(one.camera, prior, inliers, one.family, left)


def _weight(one: Candidate, others: list[tuple[str, bool]], settings: ForwardGPSettings) -> float:
    families = sum(family == one.family for family, _ in others)
    signs = sum(mirrored == one.camera.mirrored for _, mirrored in others)
    total = sum(kind.odds for kind in settings.kinds.values())
    of_sign = settings.mirrored_odds if one.camera.mirrored else 1.0
    of_kind = (settings.kinds[one.family].odds + families) / (total + len(others))
    return of_kind * ((of_sign + signs) / (1 + settings.mirrored_odds + len(others)))


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
        prior = family_prior(camera, family, scene.image, _widest(camera, points), scene.settings)
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
    settings, error = scene.settings, scene.error(camera)
    median = float(np.median(error[inliers]))
    if (
        inliers.sum() < MIN_POINTS_PER_CAMERA
        or not median < settings.max_ordinary_error_half_sides * scene.image.half
        or camera.rho < 4 * MIN_RHO
    ):
        return None
    views = _common_views(scene, inliers)
    tight, free_from_here = _evidences(camera, ("ordinary", "free"), views)
    clear = median < settings.max_clear_error_noises * scene.noise
    if clear and tight > free_from_here + settings.min_freer_gain_nats:
        free, free_kept = _refined(camera, "free", scene, inliers, 1, gain=ROUGH_GAIN)
        left = np.sum(scene.error(free)[inliers] ** 2) / np.sum(error[inliers] ** 2)
        if left > settings.min_squares_left_share and free_kept.sum() <= inliers.sum():
            return Candidate(camera, "ordinary", inliers, tight)
    free, free_kept = _refined(camera, "free", scene, inliers, PROBE_STEPS, gain=ROUGH_GAIN)
    free_error = scene.error(free)
    # what seventeen free numbers gain over eleven by chance is no reason; of few views the evidence must do
    by_chance = np.sqrt(max(2 * inliers.sum() - 17, 0) / (2 * inliers.sum() - 11))
    ratio = settings.max_freer_error_ratio * by_chance
    better = inliers.sum() >= settings.few_views and np.median(free_error[inliers]) < ratio * median
    if better or free_kept.sum() > inliers.sum():
        return None
    if _evidences(free, ("free",), views)[0] > tight + settings.min_freer_gain_nats:
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
    ratio = scene.settings.clearly_wrong_sign_ratio
    signs = [sign for sign in best if best[sign] and not leading[sign] * ratio > leading[not sign]]
    common = min((best[sign][0] for sign in signs), key=lambda one: one[0])[2]
    views = _common_views(scene, common)
    found_all = [one for sign in signs for one in _kinds(scene, views, best[sign][0], sign)]
    usable = [one for one in found_all if np.isfinite(one.evidence)]
    if not usable:
        raise FitError("no camera sees the known points at these pixels.", fix="look for wrong detections")
    return usable


def _kinds(
    scene: Scene,
    views: Scene,
    best: tuple[float, GeneralCamera, Bools],
    sign: bool,
) -> Iterator[Candidate]:
    """Each kind, from the best free camera and from the ladder of what that one explains."""
    _, free, inliers = best
    settings = scene.settings
    ladder = _from_ladder(scene.select(inliers), mirrored=sign, subsets=False)
    others = [] if ladder is None else [ladder.camera]
    for family, kind in settings.kinds.items():
        shape = free.shape if kind.p > 0.01 else np.zeros(2)
        tilt = free.tilt if kind.tilt > 0.01 else np.zeros(2)
        some = []
        limit = np.inf if family == "ordinary" else settings.max_kind_error_ratio * best[0]
        near = [one for one in others if _score(scene, one) < limit]
        for camera in (free.with_shape(shape, tilt), *near):
            found, explained = _refined(camera, family, scene, inliers, FINAL_STEPS, rounds=2)
            limit = settings.max_kind_error_half_sides * scene.image.half
            plausible = np.median(scene.error(found)[explained]) < limit
            evidence = _evidences(found, (family,), views)[0] if plausible else -np.inf
            some.append(Candidate(found, family, explained, evidence))
        yield max(some, key=lambda one: one.evidence)


def _score(scene: Scene, camera: GeneralCamera) -> float:
    """A robust size of the errors at all views, px, in the middle of their logarithms: wrong views count little, and a
    camera gains nothing by going through some views better than the noise allows."""
    error = np.minimum(scene.error(camera), 1e3 * scene.image.half)
    return scene.noise * float(np.exp(0.5 * np.mean(np.log1p((error / scene.noise) ** 2))))


def _common_views(scene: Scene, inliers: Bools) -> Scene:
    rows, most = np.flatnonzero(inliers), scene.settings.max_choice_views
    if len(rows) > most:
        rows = np.sort(np.random.default_rng(0).choice(rows, most, replace=False))
    return scene.select(rows)


def _evidences(camera: GeneralCamera, families: Sequence[str], views: Scene) -> list[float]:
    widest = _widest(camera, views.points)
    priors = [family_prior(camera, family, views.image, widest, views.settings) for family in families]
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
        few = len(scene.points) < scene.settings.few_views  # too few to say by themselves which are wrong
        if few and not ladder.inliers.all():
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
