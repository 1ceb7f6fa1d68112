"""What is known of the cameras: against dense regressions, with known positions that are exact, and that are off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.stats import multivariate_normal

from forward_gp_cases import IMAGE, LENGTHSCALE, covariance_of, design, numeric, se
from implicam.geometry import look_at
from implicam.lenses import PERSPECTIVE_K, KannalaBrandt
from implicam.rig_model import linearise
from implicam.rig_model.camera import CentralCamera, Prior
from implicam.rig_model.camera_model import CameraModel, CameraViews
from implicam.rig_model.field import empty_field
from implicam.rig_model.leave_one_out import left_out_residuals, squared_distances
from implicam.rig_model.posterior import Posterior, condition, log_evidence
from implicam.rig_model.shot_errors import ShotErrors
from implicam.rig_model.tied import Scatter, condition_scattered


def two_cameras(
    *, field_points: int = 50, signal: float = 0.5, noise: float = 0.2, proper: bool = True
) -> tuple[tuple[CameraModel, ...], np.ndarray, tuple[CameraViews, ...]]:
    """Two cameras and 50 points, of which each sees most, with a smooth error and noise; models before the fit."""
    rng = np.random.default_rng(3)
    points = rng.uniform(-1.2, 1.2, (50, 3))
    models, camera_views = [], []
    for number, centre in enumerate([(-2.5, 0.3, -3.5), (2.2, -0.4, -3.2)]):
        lens = KannalaBrandt(900.0, 901.0, 642.0, 396.0, *(0.5 * PERSPECTIVE_K).tolist())
        real = CentralCamera(lens, look_at(centre, (0.0, 0.0, 0.0), up=(0.0, -1.0, 0.0)))
        rows = np.sort(rng.choice(50, 44, replace=False))
        uv = real.pixel(points[rows])
        uv = uv + 0.5 * np.sin(uv[:, ::-1] / 150) + noise * rng.normal(size=uv.shape)
        step = rng.normal(size=14) * np.array([2, 2, 3, 3, 0.01, 0.01, 0.01, 0.01, *np.full(6, 1e-3)])
        camera = real.moved(step)
        prior = camera.prior(IMAGE, 0.6)
        if proper:
            precision = prior.precision.copy()
            precision[range(14), range(14)] += np.array([1e-4, 1e-4, *np.zeros(6), *np.full(6, 1e2)])
            prior = Prior(prior.mean, precision)
        none = empty_field(np.ones(2), np.zeros((1, 3)), 1.0)
        model = CameraModel(
            camera=camera,
            field_camera=camera,
            prior=prior,
            image=IMAGE,
            field=none,
            signal=signal,
            noise=noise * (1 + number),
            weights=np.zeros((1, 2)),
        )
        q = model.coordinates(camera.view(points[:field_points]))
        field = empty_field(LENGTHSCALE, q, 1e-7)
        weights = np.zeros((len(field.inducing), 2))
        models.append(replace(model, field=field, weights=weights))
        camera_views.append(CameraViews(rows, uv, rng.uniform(0.7, 1.5, len(rows))))
    return tuple(models), points, tuple(camera_views)


def regression(
    X: np.ndarray, y: np.ndarray, sd: np.ndarray, mean: np.ndarray, precision: np.ndarray, *, density: bool = True
) -> tuple[np.ndarray, np.ndarray, float]:
    """Bayesian linear regression: posterior mean and covariance, and the log density of y."""
    A = precision + X.T @ (X / sd[:, None] ** 2)
    scale = 1 / np.sqrt(np.diag(A))
    covariance = np.linalg.inv(A * np.outer(scale, scale)) * np.outer(scale, scale)
    posterior_mean = mean + covariance @ (X.T @ ((y - X @ mean) / sd**2))
    log_density = np.nan
    if density:
        spread = np.diag(sd**2) + X @ np.linalg.solve(precision, X.T)
        log_density = float(multivariate_normal.logpdf(y, X @ mean, spread, allow_singular=True))
    return posterior_mean, covariance, log_density


def dense_problem(
    models: tuple[CameraModel, ...], points: np.ndarray, camera_views: tuple[CameraViews, ...]
) -> tuple[list[np.ndarray], np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Designs of each camera, y, sd, and the prior of all cameras' unknowns."""
    designs, y, sd, mean, precision = [], [], [], [], []
    for model, seen in zip(models, camera_views, strict=True):
        designs.append(design(model, points[seen.rows]).reshape(2 * len(seen.rows), -1))
        y.append((seen.uv - model.camera.pixel(points[seen.rows])).ravel())
        sd.append(np.repeat(model.noise * seen.relative, 2))
        m = len(model.field.inducing)
        mean.append(np.concatenate([model.prior.mean - model.camera.parameters, np.zeros(2 * m)]))
        precision.append(block_diag(model.prior.precision, np.eye(2 * m)))
    return designs, np.concatenate(y), np.concatenate(sd), np.concatenate(mean), block_diag(*precision)


def assert_close_covariance(found: np.ndarray, expected: np.ndarray, atol: float = 1e-6) -> None:
    sd = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / np.outer(sd, sd), expected / np.outer(sd, sd), atol=atol)


def of_pixels(designs: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(n, 2, 2) covariance of mean pixels."""
    return np.asarray(np.einsum("nip,pq,njq->nij", designs, covariance, designs, optimize=True))


def unknowns_of(posterior: Posterior) -> np.ndarray:
    """Steps and weights of all cameras, in order."""
    each = [np.concatenate([s, m.weights.T.ravel()]) for s, m in zip(posterior.steps, posterior.models, strict=True)]
    return np.concatenate(each)


def test_exact_positions_give_each_camera_its_own_linear_regression() -> None:
    models, points, camera_views = two_cameras()
    posterior = condition(models, points, camera_views, None)
    assert posterior.joint is None
    for c in range(2):
        designs, y, sd, mean, precision = dense_problem(models[c : c + 1], points, camera_views[c : c + 1])
        expected, covariance, _ = regression(designs[0], y, sd, mean, precision)
        found = np.concatenate([posterior.steps[c], posterior.models[c].weights.T.ravel()])
        np.testing.assert_allclose(
            found / np.sqrt(np.diag(covariance)), expected / np.sqrt(np.diag(covariance)), atol=1e-5
        )
        assert_close_covariance(posterior.alone[c].T @ posterior.alone[c], covariance)
        np.testing.assert_array_equal(posterior.root(c), posterior.alone[c])
        moved = models[c].camera.moved(expected[:14])
        np.testing.assert_allclose(posterior.models[c].camera.as_array(), moved.as_array(), rtol=1e-7, atol=1e-9)


def test_the_evidence_of_a_posterior_is_the_density_of_what_was_seen() -> None:
    found, expected = [], []
    for signal, noise in ((0.5, 0.2), (0.1, 0.4), (2.0, 0.3)):
        models, points, camera_views = two_cameras()
        models = tuple(replace(m, signal=signal, noise=noise) for m in models)
        designs, y, sd, mean, precision = dense_problem(models, points, camera_views)
        found.append(condition(models, points, camera_views, None).evidence)
        expected.append(regression(block_diag(*designs), y, sd, mean, precision)[2])
    assert np.ptp(expected) > 10
    np.testing.assert_allclose(np.diff(found), np.diff(expected), rtol=1e-5)


def test_the_prediction_is_universal_kriging() -> None:
    """With the full kernel matrix and no features: eq. 4 of the design."""
    models, points, camera_views = two_cameras()
    model, seen = models[0], camera_views[0]
    posterior = condition(models, points, camera_views, None)
    at = np.random.default_rng(9).uniform(-1, 1, (20, 3))

    def seen_at(where: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        view = model.camera.view(where)
        return view.uv, view.by_parameters, model.coordinates(view)

    (uv, J, q), (there, J_there, q_there) = seen_at(points[seen.rows]), seen_at(at)
    sd2 = (model.noise * seen.relative) ** 2
    W = np.linalg.inv(model.signal**2 * se(q, q, LENGTHSCALE) + np.diag(sd2))
    K = model.signal**2 * se(q_there, q, LENGTHSCALE)
    off = model.prior.mean - model.camera.parameters
    A = model.prior.precision + sum(J[:, i].T @ W @ J[:, i] for i in range(2))
    S = np.linalg.inv(A)
    step = S @ (model.prior.precision @ off + sum(J[:, i].T @ W @ (seen.uv - uv)[:, i] for i in range(2)))
    mean = there + J_there @ step
    mean += np.stack([K @ W @ (seen.uv[:, i] - uv[:, i] - J[:, i] @ step) for i in range(2)], axis=1)
    R = np.stack([J_there[:, i] - K @ W @ J[:, i] for i in range(2)], axis=1)
    own = model.signal**2 - np.sum((K @ W) * K, axis=1)
    covariance = own[:, None, None] * np.eye(2) + R @ S @ R.swapaxes(1, 2)
    bare = model.rows(at)
    found = there + np.einsum("nip,p->ni", bare.J, posterior.steps[0]) + bare.phi @ posterior.models[0].weights
    spread = of_pixels(design(model, at), posterior.alone[0].T @ posterior.alone[0]) + bare.rest[
        :, None, None
    ] * np.eye(2)
    np.testing.assert_allclose(spread, covariance, rtol=0.01, atol=1e-2 * np.median(own))
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    assert np.abs((found - mean) / sd).max() < 0.01
    # the camera moved to the posterior mean differs by the curvature of the lens only
    assert np.abs((posterior.models[0].predict(at)[0] - mean) / sd).max() < 0.5


def declared(points: np.ndarray, shots: int, k: int = 3) -> ShotErrors:
    rng = np.random.default_rng(4)
    shot = np.sort(rng.integers(0, shots, len(points)))
    basis = np.broadcast_to(np.eye(3), (len(points), 3, 3)) if k == 3 else rng.normal(size=(len(points), 3, k))
    return ShotErrors(shot.astype(np.int64), basis, rng.uniform(1e-3, 5e-3, (shots, k)), np.full(k, -1))


def dense_with_shots(
    models: tuple[CameraModel, ...],
    points: np.ndarray,
    camera_views: tuple[CameraViews, ...],
    errors: ShotErrors,
    *,
    density: bool = True,
) -> tuple[np.ndarray, np.ndarray, float]:
    """All cameras and all shots as one linear regression."""
    designs, y, sd, mean, precision = dense_problem(models, points, camera_views)
    shots, k = errors.sd.shape
    by_shot = []
    for model, seen in zip(models, camera_views, strict=True):
        D = model.camera.view(points[seen.rows]).by_point
        wide = np.zeros((len(D), 2, shots, k))
        for i, row in enumerate(seen.rows):
            s = errors.shot[row]
            wide[i, :, s] = D[i] @ (errors.basis[row] * errors.sd[s])
        by_shot.append(wide.reshape(2 * len(D), -1))
    X = np.concatenate([block_diag(*designs), np.concatenate(by_shot)], axis=1)
    extra = shots * k
    return regression(
        X, y, sd, np.concatenate([mean, np.zeros(extra)]), block_diag(precision, np.eye(extra)), density=density
    )


@pytest.mark.parametrize(
    ("shots", "k", "estimated"), [(50, 3, False), (12, 3, False), (5, 6, False), (1, 4, True), (7, 3, True)]
)
def test_positions_that_may_be_off_tie_the_cameras(shots: int, k: int, estimated: bool) -> None:
    models, points, camera_views = two_cameras()
    errors = declared(points, shots, k)
    if estimated:
        errors = replace(errors, group=np.zeros(k, dtype=np.int64))
    mean, covariance, _ = dense_with_shots(models, points, camera_views, errors)
    posterior = condition(models, points, camera_views, errors)
    total = posterior.offsets[-1]
    assert posterior.joint is not None
    sd = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(unknowns_of(posterior) / sd[:total], mean[:total] / sd[:total], atol=1e-4)
    joint, first = covariance_of(posterior), models[0].size
    assert_close_covariance(joint, covariance[:total, :total], 1e-5)
    assert np.abs(joint[:first, first:]).max() > 0
    np.testing.assert_allclose(posterior.root(1).T @ posterior.root(1), joint[first:, first:], rtol=1e-9)
    z = mean[total:].reshape(shots, k)
    displacement = np.stack([errors.basis[i] @ (errors.sd[s] * z[s]) for i, s in enumerate(errors.shot)])
    assert posterior.displacement is not None
    np.testing.assert_allclose(posterior.displacement, displacement, atol=1e-6 * np.abs(displacement).max())
    for c in range(2):
        designs, y, noise, off, precision = dense_problem(models[c : c + 1], points, camera_views[c : c + 1])
        assert_close_covariance(
            posterior.alone[c].T @ posterior.alone[c], regression(designs[0], y, noise, off, precision)[1]
        )
    if not estimated:
        assert posterior.unknowns is None
        return
    assert posterior.unknowns is not None
    np.testing.assert_allclose(posterior.unknowns.mean, mean[total:], atol=1e-5)
    np.testing.assert_allclose(posterior.unknowns.covariance, covariance[total:, total:], atol=1e-6)
    cross = covariance[:total, total:] / sd[:total, None]
    found = posterior.joint.T @ posterior.unknowns.cross
    np.testing.assert_allclose(found / sd[:total, None], cross, atol=1e-5)


@pytest.mark.parametrize("shots", [0, 4])
def test_single_positions_that_are_off_tie_the_cameras(shots: int) -> None:
    """Of themselves, and with shots that are off besides: one dense linear regression."""
    models, points, camera_views = two_cameras()
    rng = np.random.default_rng(5)
    n = len(points)
    scatter = Scatter(rng.normal(size=(3, 3)) * 2e-3, rng.uniform(0.5, 3, n))
    own = ShotErrors(np.arange(n), scatter.root * scatter.size[:, None, None], np.ones((n, 3)), np.full(3, -1))
    errors = replace(declared(points, 1, shots), group=np.zeros(shots, dtype=np.int64)) if shots else None
    designs, y, sd, mean, precision = dense_problem(models, points, camera_views)
    X = [block_diag(*designs)]
    for each in (own, *([errors] * (shots > 0))):
        k = each.basis.shape[2]
        wide = []
        for model, seen in zip(models, camera_views, strict=True):
            D = model.camera.view(points[seen.rows]).by_point @ each.scaled[seen.rows]
            block = np.zeros((len(D), 2, each.count, k))
            block[np.arange(len(D)), :, each.shot[seen.rows]] = D
            wide.append(block.reshape(2 * len(D), -1))
        X.append(np.concatenate(wide))
    design_matrix = np.concatenate(X, axis=1)
    total, extra = len(mean), design_matrix.shape[1] - len(mean)
    found, covariance, density = regression(
        design_matrix, y, sd, np.concatenate([mean, np.zeros(extra)]), block_diag(precision, np.eye(extra))
    )
    posterior = condition_scattered(models, points, camera_views, errors, scatter)
    sds = np.sqrt(np.diag(covariance))[:total]
    assert posterior.joint is None
    assert posterior.ties is not None
    assert len(posterior.ties) < total
    np.testing.assert_allclose(unknowns_of(posterior) / sds, found[:total] / sds, atol=1e-4)
    assert_close_covariance(covariance_of(posterior), covariance[:total, :total], 2e-4)
    z = found[total : total + 3 * n].reshape(n, 3)
    moved_by = np.einsum("nij,nj->ni", own.basis, z)
    if errors is not None:
        moved_by = moved_by + errors.scaled @ found[total + 3 * n :]
        assert posterior.unknowns is not None
        np.testing.assert_allclose(posterior.unknowns.mean, found[total + 3 * n :], atol=1e-4)
        np.testing.assert_allclose(
            posterior.unknowns.covariance, covariance[total + 3 * n :, total + 3 * n :], atol=1e-4
        )
        joint = np.concatenate([posterior.root(c) for c in range(2)], axis=1)
        cross = joint.T @ posterior.unknowns.cross / sds[:, None]
        np.testing.assert_allclose(cross, covariance[:total, total + 3 * n :] / sds[:, None], atol=1e-4)
    assert posterior.displacement is not None
    np.testing.assert_allclose(posterior.displacement, moved_by, atol=1e-5 * np.abs(moved_by).max())
    exact = condition(models, points, camera_views, None)
    expected = density - regression(*_stacked(dense_problem(models, points, camera_views)))[2]
    assert abs(expected) > 5
    assert posterior.evidence - exact.evidence == pytest.approx(expected, abs=1e-2)


def test_more_shots_and_points_than_fit_in_one_piece_of_work() -> None:
    models, few, _ = two_cameras()
    models = tuple(replace(m, field=empty_field(LENGTHSCALE, m.coordinates(m.camera.view(few)), 0.3)) for m in models)
    models = tuple(replace(m, weights=np.zeros((len(m.field.inducing), 2))) for m in models)
    rng = np.random.default_rng(17)
    for n, shots in ((4200, 0), (600, 560)):
        points = rng.uniform(-1, 1, (n, 3))
        seen = []
        for model in models:
            rows = np.flatnonzero(rng.random(n) < 0.98)
            uv = model.camera.pixel(points[rows]) + 0.3 * rng.normal(size=(len(rows), 2))
            seen.append(CameraViews(rows, uv, rng.uniform(0.7, 1.5, len(rows))))
        if shots:
            errors = replace(declared(points, shots), shot=np.arange(n) % shots)
            posterior = condition(models, points, tuple(seen), errors)
            mean, covariance, _ = dense_with_shots(models, points, tuple(seen), errors, density=False)
        else:
            posterior = condition(models, points, tuple(seen), None)
            designs, y, sd, off, precision = dense_problem(models, points, tuple(seen))
            mean, covariance, _ = regression(block_diag(*designs), y, sd, off, precision, density=False)
        total = posterior.offsets[-1]
        assert total < 150
        sds = np.sqrt(np.diag(covariance))[:total]
        np.testing.assert_allclose(unknowns_of(posterior) / sds, mean[:total] / sds, atol=1e-3)
        assert_close_covariance(covariance_of(posterior), covariance[:total, :total], 1e-4)


def test_the_evidence_of_tied_cameras_is_the_density_of_what_was_seen() -> None:
    models, points, camera_views = two_cameras()
    errors = declared(points, 12)
    found, expected = [], []
    for factor in (0.1, 1.0, 10.0):
        scaled = replace(errors, sd=factor * errors.sd)
        found.append(condition(models, points, camera_views, scaled).evidence)
        expected.append(dense_with_shots(models, points, camera_views, scaled)[2])
    found.append(condition(models, points, camera_views, None).evidence)
    expected.append(regression(*_stacked(dense_problem(models, points, camera_views)))[2])
    assert np.ptp(expected) > 5
    np.testing.assert_allclose(np.diff(found), np.diff(expected), rtol=1e-4, atol=1e-3)


def _stacked(
    training: tuple[list[np.ndarray], np.ndarray, np.ndarray, np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    designs, y, sd, mean, precision = training
    return block_diag(*designs), y, sd, mean, precision


def test_rows_and_predictions_agree_with_each_other_and_with_differences() -> None:
    models, points, camera_views = two_cameras()
    model = condition(models, points, camera_views, None).models[0]
    at = points[:20] * 0.9
    mean, slope = model.predict(at)
    np.testing.assert_allclose(model.rows(at).mean, mean, atol=1e-9)
    np.testing.assert_allclose(model.pixel(at), mean, atol=1e-9)
    for one, other in zip(model.rows_and_slope(at), (model.rows(at), slope), strict=True):
        np.testing.assert_array_equal(np.concatenate([*map(np.ravel, one)]), np.concatenate([*map(np.ravel, other)]))
    expected = numeric(lambda d: model.predict(at + d)[0], np.full(3, 1e-5))
    np.testing.assert_allclose(slope, expected, atol=1e-6 * np.abs(expected).max())
    smooth = np.abs(mean - model.camera.pixel(at)).max()
    rows = replace(model, signal=3.0).rows(4 * at)  # beyond what it has seen its features leave much
    np.testing.assert_allclose(np.sum(rows.phi**2, axis=1) + rows.rest, 9.0)
    assert rows.rest.max() > 1
    assert smooth > 0.05  # there is a field to be differentiated


def converged(models: tuple[CameraModel, ...], points: np.ndarray, camera_views: tuple[CameraViews, ...]) -> Posterior:
    for _ in range(6):
        posterior = condition(models, points, camera_views, None)
        models = posterior.models
    return posterior


def test_leaving_a_view_out_in_closed_form_is_leaving_it_out() -> None:
    models, points, camera_views = two_cameras(proper=False)
    posterior = converged(models, points, camera_views)
    seen, inliers = camera_views[0], np.ones(len(camera_views[0].rows), dtype=np.bool_)
    residual, spread = left_out_residuals(posterior, 0, points, seen, inliers)
    distance = squared_distances(posterior, 0, points, seen, inliers)
    for i in (0, 7, 20, 43):
        without = inliers.copy()
        without[i] = False
        again = condition(posterior.models, points, (seen.select(without), camera_views[1]), None)
        step, weights = again.steps[0], again.models[0].weights
        where = points[seen.rows[[i]]]
        before = replace(posterior.models[0], weights=np.zeros_like(weights))
        bare, sd = before.rows(where), before.noise * seen.relative[i]
        covariance = again.alone[0].T @ again.alone[0]
        expected = of_pixels(design(before, where), covariance)[0] + (sd**2 + bare.rest[0]) * np.eye(2)
        difference = seen.uv[i] - (bare.mean[0] + bare.J[0] @ step + bare.phi[0] @ weights)
        np.testing.assert_allclose(spread[i], expected, rtol=1e-3, atol=1e-3 * expected[0, 0])
        np.testing.assert_allclose(residual[i], difference, atol=1e-3 * np.sqrt(expected[0, 0]))
        assert distance[i] == pytest.approx(difference @ np.linalg.solve(expected, difference), rel=5e-3, abs=1e-4)
        # a view that was not used is simply predicted, by the camera that has moved a little
        unused, its_spread = left_out_residuals(again, 0, points, seen, without)
        predicted = seen.uv[i] - again.models[0].predict(where)[0][0]
        np.testing.assert_allclose(unused[i], predicted, atol=1e-9)
        np.testing.assert_allclose(unused[i], residual[i], atol=0.05 * np.sqrt(expected[0, 0]))
        np.testing.assert_allclose(its_spread[i], expected, rtol=0.05, atol=0.05 * expected[0, 0])


@pytest.mark.parametrize("tied", [False, True])
def test_the_steps_to_the_posterior_do_not_wait_for_a_part_of_the_views(
    monkeypatch: pytest.MonkeyPatch, *, tied: bool
) -> None:
    """Some views ask for another camera than all of them: that is no reason to go halves for ever."""
    models, points, camera_views = two_cameras(proper=False)
    errors = None
    if tied:
        basis = np.broadcast_to(np.eye(3), (50, 3, 3))
        errors = ShotErrors(np.zeros(50, dtype=np.int64), basis, np.full((1, 3), 0.01), np.full(3, -1))
    steps = []

    def counted(*given: object) -> Posterior:
        steps.append(given)
        return condition(*given)  # type: ignore[arg-type]

    monkeypatch.setattr(linearise, "condition", counted)
    by_all = linearise.iterate_linearisation(models, points, camera_views, errors)
    needed = len(steps)
    for part in (10, 20, 30):
        steps.clear()
        monkeypatch.setattr(linearise, "MAX_MISFIT_VIEWS", part)
        by_some = linearise.iterate_linearisation(models, points, camera_views, errors)
        assert len(steps) <= needed + 2
        for one, other in zip(by_some.models, by_all.models, strict=True):
            off = one.predict(points)[0] - other.predict(points)[0]
            assert np.abs(off).max() < 0.02 * one.noise


@pytest.mark.parametrize("shots", [50, 9], ids=["each point its own", "several together"])
def test_the_evidence_is_the_same_whichever_is_eliminated_first(shots: int) -> None:
    models, points, camera_views = two_cameras()
    alone = camera_views[1].rows < 30  # some points are seen by one camera, some by none
    camera_views = (camera_views[0].select(camera_views[0].rows < 40), camera_views[1].select(alone))
    sd = np.random.default_rng(5).uniform(0.001, 0.01, (shots, 3))
    shot = np.arange(50) % shots
    errors = ShotErrors(shot, np.tile(np.eye(3), (50, 1, 1)), sd, np.full(3, -1))
    expected = condition(models, points, camera_views, errors).evidence
    assert abs(expected) > 10
    np.testing.assert_allclose(log_evidence(models, points, camera_views, errors), expected, atol=1e-6)
