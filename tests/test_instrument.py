"""What a report says of the cameras: budgets that add up to what is stated, advice that is true, a page with it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import implicam as ic
from implicam.dataset import Dataset, Floats, Observations
from implicam.report import page, report_of
from implicam.report.instrument import Instrument
from implicam.rig_model import SOURCES
from implicam.simulate import build_rig, random_positions, simulate

pytest.importorskip("plotly")


def known(points: int = 40, seed: int = 1, rig: str = "bar6") -> Dataset:
    there = build_rig(rig, seed=seed, lens_error=0.5)
    return simulate(there, random_positions(there, points, np.random.default_rng(seed)), seed=seed)


@cache
def calibrated(points: int = 40) -> ic.ForwardGPCalibration:
    return ic.ForwardGP().fit(known(points))


def stated(calibration: ic.ForwardGPCalibration | ic.ExplicitCalibration, xyz: Floats) -> Floats:
    """What a measurement of exact views states."""
    rig = calibration.map
    uv = rig.predict(xyz)
    names = np.array([f"q{i}" for i in range(len(xyz))])
    return calibration.measure(Observations(names, rig.trained.cameras, uv, np.full(uv.shape, np.nan))).cov


def declared() -> Dataset:
    """Known positions whose errors tie the cameras."""
    data = known()
    assert data.known is not None
    rng = np.random.default_rng(3)
    return replace(
        data, known=replace(data.known, sd=np.full((40, 3), 0.2), xyz=data.xyz + rng.normal(0, 0.2, (40, 3)))
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["forward-gp", "explicit", "tied"])
def test_the_budget_adds_up_to_what_a_measurement_states(kind: str) -> None:
    if kind == "tied":
        calibration = ic.ForwardGP().fit(declared())
        assert calibration.posterior.tied
    else:
        calibration = calibrated() if kind == "forward-gp" else ic.Explicit().fit(known())
    xyz = calibration.data.xyz[:6] + 2.0
    budget = calibration.map.budget(xyz, np.ones((6, 6), dtype=np.bool_))
    np.testing.assert_allclose(budget.total, stated(calibration, xyz), rtol=1e-6, atol=1e-12)
    assert np.linalg.eigvalsh(budget.cov).min() > -1e-12
    share = budget.variance.mean(axis=0) / budget.variance.mean(axis=0).sum()
    assert (share[SOURCES.index("known positions")] > 0.01) == (kind == "tied")
    assert share[SOURCES.index("pixel noise")] > 0.2


def test_pixel_noise_alone_is_what_perfect_cameras_would_state() -> None:
    """Against (D^T D / sd^2)^-1, which knows nothing of the budget's gain: the least that views allow."""
    calibration = ic.ForwardGP().fit(known(400))
    xyz = calibration.data.xyz[:20]
    budget = calibration.map.budget(xyz, np.ones((20, 6), dtype=np.bool_))
    information = sum(np.einsum("nij,nik->njk", D, D) / noise**2 for D, noise, _ in calibration.map.slopes(xyz))
    limit = np.trace(np.linalg.inv(information), axis1=1, axis2=2) / 3
    ratio = budget.variance[:, 0] / limit
    assert (ratio > 1 - 1e-9).all()
    assert ratio.max() < 1.05


def test_what_new_points_would_do_is_what_they_do() -> None:
    """Against a fit with two points more at the worst place."""
    instrument = Instrument(calibrated(14))
    place = instrument.places[instrument.worst]
    rig = build_rig("bar6", seed=1, lens_error=0.5)
    target = random_positions(rig, 2, np.random.default_rng(0))
    more = simulate(rig, replace(target, xyz=np.stack([place, place + 0.5])), seed=5)
    more = replace(more, observations=replace(more.observations, points=np.array(["new1", "new2"])))
    again = calibrated(14).calibrator.fit(ic.join(calibrated(14).data, more))
    found = float(np.sqrt(np.trace(stated(again, place[None])[0]) / 3))
    assert instrument.sd_with_new_points == pytest.approx(found, rel=0.35)
    assert instrument.sd_with_new_points < 0.7 * instrument.sd[instrument.worst]


@pytest.mark.slow
def test_a_smudge_is_named_with_camera_and_part_of_the_picture() -> None:
    data = known(120)
    uv = data.observations.uv.copy()
    width = data.observations.cameras[2].width
    assert width is not None
    left = uv[:, 2, 0] < width / 3
    uv[left, 2] += [8.0, 0.0]
    calibration = ic.ForwardGP().fit(replace(data, observations=replace(data.observations, uv=uv)))
    said = [sentence for sentence in Instrument(calibration).advice() if "smudge" in sentence]
    assert said
    assert all(sentence.startswith("cam3 is off by") and "left" in sentence for sentence in said)


@pytest.mark.slow
def test_good_data_get_no_advice_that_is_not_true() -> None:
    said = " ".join(Instrument(ic.ForwardGP().fit(known(300))).advice())
    assert "smudge" not in said
    assert "More known points would hardly help" in said


@pytest.mark.slow
def test_errors_of_known_positions_are_told_and_not_taken_for_a_smudge() -> None:
    said = " ".join(Instrument(ic.ForwardGP().fit(declared())).advice())
    assert "errors of the known positions themselves" in said
    assert "smudge" not in said


@pytest.mark.slow
def test_a_camera_that_was_put_right_is_not_taken_for_a_dirty_one() -> None:
    """What it saw when it was calibrated is held against where it stood then."""
    calibration = calibrated(120)
    views = _others().observations
    uv = views.uv.copy()
    uv[:, 2] += [6.0, -4.0]
    moved = replace(_others(), known=None, observations=replace(views, uv=uv))
    repaired = ic.check_calibration(calibration, moved).repair().calibration
    assert [page.rms for page in Instrument(repaired).cameras] == [page.rms for page in Instrument(calibration).cameras]
    assert "smudge" not in " ".join(Instrument(repaired).advice())


@pytest.mark.slow
def test_cameras_without_known_points_of_their_own_are_reported_on_too() -> None:
    """Of another program, or from boards alone: there is no box of known points to look at."""
    fitted = ic.Explicit().fit(known(40))
    bare = replace(fitted, data=fitted.data.select([]))
    text = page(report_of(ic.evaluate(fitted, _others()), "rig", calibration=bare))
    assert "Where the uncertainty comes from" not in text


@pytest.mark.slow
def test_a_camera_whose_views_scatter_is_named() -> None:
    data = known(60)
    uv = data.observations.uv.copy()
    uv[:, 4] += np.random.default_rng(0).normal(0, 1.5, (60, 2))
    noisy = replace(data, observations=replace(data.observations, uv=uv, sd=np.full_like(data.observations.sd, np.nan)))
    said = Instrument(ic.ForwardGP().fit(noisy)).advice()
    assert any(sentence.startswith("The views of cam5 scatter by") for sentence in said)


@pytest.mark.slow
def test_the_page_shows_the_instrument_and_who_reports(tmp_path: Path) -> None:
    calibration = calibrated()
    evaluation = ic.evaluate(calibration, _others())
    text = page(report_of(evaluation, "rig", calibration=calibration, by="M. Weber <script>"))
    for words in ("Where the uncertainty comes from", "What would make it better", "Camera by camera", "M. Weber &lt;"):
        assert words in text
    assert text.count('class="camera"') == 6
    for figure in ("plot-slices", "plot-volume", "plot-rig", "plot-camera-6"):
        assert f'id="{figure}"' in text
    assert page(report_of(evaluation, "rig", calibration=calibration, by="M. Weber <script>")) == text


def _others() -> Dataset:
    rig = build_rig("bar6", seed=1, lens_error=0.5)
    return simulate(rig, random_positions(rig, 30, np.random.default_rng(50)), seed=50)


def test_a_method_without_cameras_has_no_such_part() -> None:
    data = known(40, rig="stereo")
    calibration = ic.InverseGP().fit(data.select(range(30)))
    text = page(report_of(ic.evaluate(calibration, data.select(range(30, 40))), "rig", calibration=calibration))
    assert "Where the uncertainty comes from" not in text
