"""forward-gp as a whole, against the simulated truth: wrong views, what is refused, error bars that are honest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2, kstest

from forward_gp_cases import (
    declared_fit,
    dots_fit,
    fitted,
    joint_covariance,
    known,
    numeric,
    rig,
    rotation,
    with_positions,
)
from implicam.calibrators import ForwardGP
from implicam.dataset import Camera, Dataset, KnownPositions, Observations, join
from implicam.errors import FitError
from implicam.gp.low_rank import LowRank
from implicam.measurement import Measurement
from implicam.rig_model.posterior import Posterior
from implicam.rig_model.triangulate import locate
from implicam.simulate import Target, random_positions, simulate


@cache
def others(n: int = 60) -> Dataset:
    data = simulate(rig(), random_positions(rig(), n, np.random.default_rng(13)), seed=14)
    return data.select(data.observations.seen.all(axis=1))


def with_views(data: Dataset, change: Callable[[np.ndarray, np.ndarray], None], extra: bool = False) -> Dataset:
    """The same data with other pixels and sds: `change` writes into both."""
    o = data.observations
    uv, sd = o.uv.copy(), o.sd.copy()
    change(uv, sd)
    return replace(data, observations=Observations(o.points, o.cameras, uv, sd, o.extra if extra else {}))


def truth(data: Dataset) -> np.ndarray:
    assert data.truth is not None
    return data.truth.xyz


def in_sds(measured: Measurement, xyz: np.ndarray) -> np.ndarray:
    return np.asarray(np.abs(measured.xyz - xyz) / measured.sd)


def coarse(posterior: Posterior) -> Posterior:
    """With three features per field, so that these leave much of it."""
    models, roots = [], []
    for model, root in zip(posterior.models, posterior.alone, strict=True):
        p, m = model.camera.size, len(model.field.inducing)
        field = LowRank(model.field.kernel, model.field.inducing[:3])
        models.append(replace(model, field=field, weights=model.weights[:3], signal=3 * model.noise))
        roots.append(root[:, [*range(p + 3), *range(p + m, p + m + 3)]])
    return replace(posterior, models=tuple(models), alone=tuple(roots))


@pytest.mark.parametrize("kind", ["independent cameras", "tied cameras", "dots off", "coarse fields"])
def test_the_position_is_the_most_probable_one(kind: str) -> None:
    """Another optimiser, and finite differences for the covariance."""
    calibration = {"tied cameras": declared_fit, "dots off": dots_fit}.get(kind, fitted)()
    posterior, frame = calibration.posterior, calibration.frame
    assert (posterior.joint is not None) == (kind == "tied cameras")
    posterior = coarse(posterior) if kind == "coarse fields" else posterior
    inside, volume, names = others().select(np.arange(4)), rig().volume, np.array(["behind", "far behind"])
    deeper = volume.world_from_box.apply(np.array([[0.2, 0.1, 1.3], [-0.3, 0.0, 1.8]]) * volume.size)
    data = join(inside, simulate(rig(), Target("deeper", names, names, deeper), seed=1))
    assert data.observations.seen.all()
    noise = np.array([[model.noise * (1 + 0.5 * i) for i, model in enumerate(posterior.models)]] * 6)
    found = locate(posterior, data.observations.uv, noise)
    for i in range(6):
        root = np.linalg.inv(np.linalg.cholesky(joint_covariance(posterior, found.xyz[i], noise[i])))

        def residuals(x: np.ndarray, i: int = i, root: np.ndarray = root) -> np.ndarray:
            pixels = np.concatenate([model.predict(x[None])[0][0] for model in posterior.models])
            return np.asarray(root @ (data.observations.uv[i].ravel() - pixels))

        best = least_squares(residuals, frame.to_working(truth(data)[i]), xtol=1e-14, ftol=1e-14, gtol=1e-14)
        sd = np.sqrt(np.diag(found.cov[i]))
        assert np.abs((best.x - found.xyz[i]) / sd).max() < 2e-3
        J = numeric(lambda d: residuals(best.x + d), np.full(3, 1e-5))  # noqa: B023
        np.testing.assert_allclose(found.cov[i], np.linalg.inv(J.T @ J), rtol=2e-3, atol=1e-4 * sd.min() ** 2)
        assert found.p[i] == pytest.approx(float(chi2.sf(2 * best.cost, 5)), rel=0.01)


def test_a_point_takes_two_views() -> None:
    data = others().select(np.arange(6))

    def hide(uv: np.ndarray, sd: np.ndarray) -> None:
        uv[0, 1:] = uv[1, 2:] = uv[2, 3:] = uv[3] = np.nan

    measured = fitted().measure(with_views(data, hide).observations)
    names = data.observations.camera_names
    assert measured.reason[0] == f"only {names[0]} saw it; a position takes two cameras"
    assert measured.reason[3] == "no camera saw it"
    np.testing.assert_array_equal(measured.measured, [False, True, True, False, True, True])
    np.testing.assert_array_equal(measured.views, [1, 2, 3, 0, 4, 4])
    assert in_sds(measured, truth(data))[measured.measured].max() < 4.5
    np.testing.assert_array_equal(np.isnan(measured.consistency), [True, False, False, True, False, False])
    whole = fitted().measure(data.observations)
    assert (measured.sd[1] > whole.sd[1]).all()  # fewer views tell less
    assert (measured.sd[2] > whole.sd[2]).all()
    np.testing.assert_allclose(measured.xyz[4:], whole.xyz[4:], rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("bad", range(4))
def test_one_grossly_wrong_view_is_left_out_and_named(bad: int) -> None:
    data, name = others().select(np.arange(15)), rig().cameras[bad].name
    direction = np.random.default_rng(bad).choice([-25.0, 25.0], (15, 2))

    def spoil(uv: np.ndarray, sd: np.ndarray) -> None:
        uv[:, bad] += direction

    def hide(uv: np.ndarray, sd: np.ndarray) -> None:
        uv[:, bad] = np.nan

    spoilt = fitted().measure(with_views(data, spoil).observations)
    without = fitted().measure(with_views(data, hide).observations)
    told = without.consistency > 0.01  # else the others are not of one mind either
    assert told.sum() >= 12
    assert set(spoilt.own_reason[told].tolist()) == {f"measured without {name}, whose view contradicts the others"}
    assert (spoilt.views[told] == 3).all()
    np.testing.assert_allclose(spoilt.xyz[told], without.xyz[told], rtol=1e-9)
    np.testing.assert_allclose(spoilt.cov[told], without.cov[told], rtol=1e-6)
    np.testing.assert_allclose(spoilt.consistency[told], without.consistency[told], rtol=1e-5)


@pytest.mark.slow
def test_two_wrong_views_among_six_are_left_out() -> None:
    six = rig("2R4W")
    calibration = ForwardGP().fit(simulate(six, random_positions(six, 50, np.random.default_rng(11)), seed=12))
    data = simulate(six, random_positions(six, 60, np.random.default_rng(13)), seed=14)
    data = data.select(np.flatnonzero(data.observations.seen.all(axis=1))[:12])

    def spoil(uv: np.ndarray, sd: np.ndarray) -> None:
        uv[:, 1] += [20.0, -30.0]
        uv[:, 4] += [-25.0, 35.0]

    def hide(uv: np.ndarray, sd: np.ndarray) -> None:
        uv[:, [1, 4]] = np.nan

    spoilt = calibration.measure(with_views(data, spoil).observations)
    without = calibration.measure(with_views(data, hide).observations)
    told = without.consistency > 0.01
    assert told.sum() >= 9
    why = "measured without cam2 and cam5, whose view contradicts the others"
    assert set(spoilt.own_reason[told].tolist()) == {why}
    assert (spoilt.views[told] == 4).all()
    np.testing.assert_allclose(spoilt.xyz[told], without.xyz[told], rtol=1e-9)


def test_a_point_is_measured_the_same_among_thousands() -> None:
    few = others().observations.select(np.arange(40))
    times = 110  # beyond one piece of work
    names = np.array([f"p{i}" for i in range(40 * times)])
    many = Observations(names, few.cameras, np.tile(few.uv, (times, 1, 1)), np.tile(few.sd, (times, 1, 1)))
    a, b = fitted().measure(few), fitted().measure(many)
    np.testing.assert_allclose(b.xyz, np.tile(a.xyz, (times, 1)), rtol=1e-9)
    np.testing.assert_allclose(b.cov, np.tile(a.cov, (times, 1, 1)), rtol=1e-6, atol=1e-9)


def test_two_views_that_contradict_each_other_give_no_position() -> None:
    data = others().with_cameras(["cam2", "cam3"]).select(np.arange(10))

    def spoil(uv: np.ndarray, sd: np.ndarray) -> None:
        uv[::2, 0, 1] += 40  # across the epipolar lines, for the cameras sit side by side

    measured = fitted().measure(with_views(data, spoil).observations)
    np.testing.assert_array_equal(measured.measured, np.arange(10) % 2 == 1)
    assert (measured.consistency[::2] < 1e-10).all()
    assert np.isnan(measured.cov[::2]).all()
    assert all("contradict each other" in why for why in measured.reason[::2])
    assert (measured.reason[1::2] == "").all()


def test_views_that_agree_have_uniform_p_values_and_honest_error_bars() -> None:
    calibration = ForwardGP().fit(known(120))
    data = simulate(rig(), random_positions(rig(), 450, np.random.default_rng(21)), seed=22)
    measured = calibration.measure(data.observations)
    for views in (2, 3, 4):
        some = data.observations.seen.sum(axis=1) == views
        if some.sum() > 50:
            assert kstest(measured.consistency[some], "uniform").pvalue > 1e-3
    ok = measured.measured
    assert ok.sum() >= 400
    error = (measured.xyz - truth(data))[ok]
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(measured.cov[ok]), error)
    assert 2.4 < nees.mean() < 3.8
    assert 0.91 < np.mean(nees < chi2.ppf(0.95, 3)) < 0.98


@pytest.mark.slow
def test_a_fifth_of_wrong_detections_is_found_out() -> None:
    data = simulate(rig(), random_positions(rig(), 100, np.random.default_rng(31)), seed=32, outliers=0.2)
    calibration = ForwardGP().fit(data)
    o = data.observations
    true = np.stack([_numbers(o.extra[column]) for column in ("true_u", "true_v")], axis=2)
    off = np.linalg.norm(o.uv - true, axis=2)
    wrong = (o.extra["outlier"] == "1") & (off > 5)  # chance puts few nearer
    row, column = ({str(name): i for i, name in enumerate(names)} for names in (data.points, o.camera_names))
    rejected = np.zeros(wrong.shape, dtype=np.bool_)
    for view in calibration.rejected:
        i, c = row[view.point], column[view.camera]
        rejected[i, c] = True
        assert view.residual == pytest.approx(off[i, c], abs=1.5)
    assert wrong.sum() > 50
    assert rejected[wrong].all()
    good = o.extra["outlier"] == "0"
    assert rejected[good].sum() <= 0.01 * good.sum()
    residuals = [view.residual for view in calibration.rejected]
    assert residuals == sorted(residuals, reverse=True)
    assert calibration.residuals["views_rejected"] == len(residuals)
    (note,) = (note for note in calibration.notes if "contradict" in note)
    assert note.startswith(f"{len(residuals)} of {o.seen.sum()} views contradict the others")
    measured, clean = calibration.measure(others().observations), fitted().measure(others().observations)
    assert in_sds(measured, truth(others())).max() < 5
    assert np.median(measured.sd / clean.sd) < 1.3


@pytest.mark.slow
def test_a_fifth_of_wrong_detections_does_not_break_a_fit_without_a_lens() -> None:
    for seed in range(3):
        target = random_positions(rig(), 60, np.random.default_rng(seed))
        calibration = ForwardGP(lens="none").fit(simulate(rig(), target, seed=seed, outliers=0.2))
        error = calibration.measure(others().observations).xyz - truth(others())
        assert np.nanmedian(np.abs(error)) < 2


@pytest.mark.slow
def test_nothing_but_wrong_detections_is_refused_with_a_reason() -> None:
    for seed in range(2):
        target = random_positions(rig(), 60, np.random.default_rng(seed))
        with pytest.raises(FitError):
            ForwardGP().fit(simulate(rig(), target, seed=seed, outliers=1.0))


def _numbers(text: np.ndarray) -> np.ndarray:
    return np.where(text == "", "nan", text).astype(np.float64)


def test_a_known_position_that_is_wrong_is_told_from_wrong_images() -> None:
    data, xyz = known(), known().xyz.copy()
    full = int(np.flatnonzero(data.observations.seen.all(axis=1))[5])
    xyz[full] += [15.0, -10.0, 12.0]
    calibration = ForwardGP().fit(with_positions(data, xyz))
    assert {view.point for view in calibration.rejected} == {str(data.points[full])}
    assert any(f"Most views of {data.points[full]} " in note for note in calibration.notes)
    assert [unused.point for unused in calibration.unused] == [str(data.points[full])]
    measured = calibration.measure(data.observations.select([full]))
    assert in_sds(measured, truth(data)[[full]]).max() < 4.5


def in_one_plane(data: Dataset, chosen: np.ndarray) -> Dataset:
    """The chosen points moved into the plane that fits them best, as the rig would see them there."""
    xyz = data.xyz.copy()
    off = xyz[chosen] - xyz[chosen].mean(axis=0)
    normal = np.linalg.svd(off)[2][2]
    xyz[chosen] -= (off @ normal)[:, None] * normal
    uv = np.stack([camera.pixel_from_world(xyz)[0] for camera in rig().cameras], axis=1)
    uv += 0.2 * np.random.default_rng(51).normal(size=uv.shape)
    o = data.observations
    uv = np.where(o.seen[..., None], uv, np.nan)
    return replace(with_positions(data, xyz), observations=Observations(o.points, o.cameras, uv, o.sd))


@pytest.mark.parametrize("saw", ["five points", "one plane"])
def test_a_camera_that_saw_too_little_is_named_and_the_rest_calibrates(saw: str) -> None:
    data, names = known(), known().observations.camera_names
    few = np.zeros(len(data), dtype=np.bool_)
    if saw == "five points":
        few[np.flatnonzero(data.observations.seen[:, 1])[:5]] = True
    else:
        few[np.argsort(np.abs((data.xyz - data.xyz.mean(axis=0)) @ [0.3, 0.2, 0.9]))[:15]] = True
        data = in_one_plane(data, few)

    def hide(uv: np.ndarray, sd: np.ndarray) -> None:
        uv[~few, 1] = np.nan

    calibration = ForwardGP().fit(with_views(data, hide))
    assert calibration.camera_names == tuple(name for name in names if name != names[1])
    assert any(note.startswith(f"{names[1]} is not calibrated") for note in calibration.notes)
    measured = calibration.measure(others().observations)
    assert (measured.views == 3).all()
    assert in_sds(measured, truth(others())).max() < 5

    def only_that_one(uv: np.ndarray, sd: np.ndarray) -> None:
        uv[3:, [0, 2, 3]] = np.nan

    measured = calibration.measure(with_views(others(), only_that_one).observations)
    assert set(measured.reason[3:].tolist()) == {"no calibrated camera saw it"}
    assert measured.measured[:3].all()


def test_nothing_measurable_among_several_points_is_an_answer_too() -> None:
    data = others().select(np.arange(3))

    def hide(uv: np.ndarray, sd: np.ndarray) -> None:
        uv[:, 1:] = np.nan

    measured = fitted().measure(with_views(data, hide).observations)
    assert set(measured.reason.tolist()) == {"only cam2 saw it; a position takes two cameras"}


@pytest.mark.parametrize("shape", ["plane", "line"])
def test_points_without_depth_are_refused(shape: str) -> None:
    volume = rig().volume
    parts = np.random.default_rng(5).uniform(-0.5, 0.5, (40, 3))
    parts[:, 2] = 0.4 * parts[:, 0] - 0.3 * parts[:, 1]
    if shape == "line":
        parts = parts[:, :1] * [0.9, 0.5, 0.7]
    names = np.array([f"p{i}" for i in range(40)])
    target = Target(shape, names, names, volume.world_from_box.apply(parts * volume.size))
    with pytest.raises(FitError, match=f"the 40 known points lie on one {shape}"):
        ForwardGP().fit(simulate(rig(), target, seed=1))


def test_one_camera_is_not_enough() -> None:
    with pytest.raises(FitError, match="1 of 1 cameras can be calibrated; a position takes two"):
        ForwardGP().fit(known().with_cameras(["cam2"]))


def test_image_sizes_need_not_be_known() -> None:
    def unsized(data: Dataset) -> Dataset:
        cameras = tuple(Camera(camera.name, None, None) for camera in data.cameras)
        return replace(data, observations=replace(data.observations, cameras=cameras))

    measured = ForwardGP().fit(unsized(known())).measure(unsized(others()).observations)
    assert measured.measured.all()
    error = measured.xyz - truth(others())
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(measured.cov), error)
    assert nees.mean() < 5
    assert np.median(measured.sd / fitted().measure(others().observations).sd) < 1.3


def test_a_view_stated_as_worse_weighs_less() -> None:
    data = others().select(np.arange(20))
    shift = np.zeros_like(data.observations.uv)
    shift[:, 1] = 0.3

    def worse(uv: np.ndarray, sd: np.ndarray) -> None:
        sd[:, 1] *= 10

    def measured(data: Dataset, by: float) -> Measurement:
        def moved(uv: np.ndarray, sd: np.ndarray) -> None:
            uv += by * shift

        return fitted().measure(with_views(data, moved).observations)

    weak = with_views(data, worse)
    a, b = measured(data, 0.0), measured(weak, 0.0)
    increase = np.linalg.eigvalsh(b.cov - a.cov)
    assert (increase.min(axis=1) > -2e-3 * increase.max(axis=1)).all()  # nothing is known better
    assert (np.linalg.det(b.cov) > 1.3 * np.linalg.det(a.cov)).all()
    pull = np.linalg.norm(measured(data, 1.0).xyz - a.xyz, axis=1)
    assert (np.linalg.norm(measured(weak, 1.0).xyz - b.xyz, axis=1) < 0.1 * pull).all()


def test_a_known_view_stated_as_worse_weighs_less_in_the_fit() -> None:
    rng = np.random.default_rng(41)
    bad = rng.random(known().observations.seen.shape) < 0.3
    noise = 2.0 * rng.normal(size=known().observations.uv.shape)

    def spoil(uv: np.ndarray, sd: np.ndarray) -> None:
        uv[bad] += noise[bad]

    def say(uv: np.ndarray, sd: np.ndarray) -> None:
        sd[bad] = 2.0

    spoilt = with_views(known(), spoil)
    told = ForwardGP().fit(with_views(spoilt, say))
    assert len(told.rejected) <= 2
    measured = told.measure(others().observations)
    assert in_sds(measured, truth(others())).max() < 5
    noise_px = told.residuals["noise_px"]
    assert all(0.14 < value < 0.28 for value in noise_px.values())  # 0.2 px, of a usual view


@pytest.mark.slow
def test_declared_noise_of_the_known_positions_widens_the_error_bars() -> None:
    exact = fitted().measure(others().observations)
    unsure = ForwardGP().fit(with_positions(known(), sd=0.5))
    measured = unsure.measure(others().observations)
    assert unsure.posterior.joint is not None
    assert np.median(measured.sd / exact.sd) > 1.1
    widening = np.linalg.det(measured.cov) / np.linalg.det(exact.cov)
    assert np.mean(widening > 1) > 0.95


@pytest.mark.slow
def test_an_error_that_all_known_positions_share_is_in_every_measurement() -> None:
    """One shot: no camera can tell where it really was, so its declared variance is added to every position's."""
    declared_sd = np.array([0.8, 0.1, 0.4])
    positions = known().positions
    one = KnownPositions(np.full(len(known()), "all"), positions.xyz, np.tile(declared_sd, (len(known()), 1)))
    measured = ForwardGP().fit(replace(known(), known=one)).measure(others().observations)
    exact = fitted().measure(others().observations)
    added = measured.cov - exact.cov
    np.testing.assert_allclose(added, np.broadcast_to(np.diag(declared_sd**2), added.shape), atol=0.02 * 0.8**2)
    assert in_sds(measured, exact.xyz).max() < 0.1


@pytest.mark.slow
def test_error_bars_stay_honest_with_a_noisy_robot() -> None:
    nees = []
    for seed in range(3):
        data = simulate(
            rig(), random_positions(rig(), 40, np.random.default_rng([seed, 1])), seed=seed + 50, robot_noise=0.4
        )
        measured = ForwardGP().fit(data).measure(others().observations)
        error = measured.xyz - truth(others())
        nees.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(measured.cov), error).mean())
    assert 1 < np.mean(nees) < 5.5


def test_an_answer_turns_with_the_world() -> None:
    turn = rotation(8)
    calibration = ForwardGP().fit(with_positions(known(), known().xyz @ turn.T))
    a, b = fitted().measure(others().observations), calibration.measure(others().observations)
    assert (np.abs(b.xyz @ turn - a.xyz) / a.sd).max() < 0.02
    back = turn.T @ b.cov @ turn
    scale = a.sd[:, :, None] * a.sd[:, None, :]
    assert (np.abs(back - a.cov) / scale).max() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("cameras", [["cam2", "cam3"], ["cam2", "cam3", "cam4", "cam5"]])
def test_any_match_gives_a_sound_number_or_a_reason(cameras: list[str]) -> None:
    """Random pixels, parallel and diverging lines of sight, and the corners of the images."""
    rng = np.random.default_rng(61)
    n, C = 300, len(cameras)
    uv = rng.uniform(0, [1279, 799], (n, C, 2))
    uv[:100] = uv[:100, :1] + rng.normal(scale=0.5, size=(100, C, 2))  # the same pixel: far away, or behind
    uv[100:150, :, 1] = 400 + rng.normal(scale=2, size=(50, C))  # along the bar: meet anywhere on a line, or behind
    uv[150:160] = rng.choice([0, 1], (10, C, 2)) * [1279.0, 799.0]
    uv = np.clip(uv, 0, [1279, 799])
    names = np.array([f"p{i}" for i in range(n)])
    sized = tuple(Camera(name, 1280, 800) for name in cameras)
    measured = fitted().measure(Observations(names, sized, uv, np.full(uv.shape, np.nan)))
    ok = measured.measured
    np.testing.assert_array_equal(ok, np.isfinite(measured.xyz).all(axis=1))
    np.testing.assert_array_equal(ok, np.isfinite(measured.cov).all(axis=(1, 2)))
    assert not np.isinf(measured.cov).any()
    assert (measured.reason[~ok] != "").all()
    assert (~ok).sum() > 50
    assert (np.linalg.eigvalsh(measured.cov[ok])[:, 0] > 0).all()
