"""A wand before cameras that are not ordinary: a mirror, a tilted sensor, pixels that are not square, a long lens."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from implicam.calibrators import ForwardGP, ForwardGPCalibration, load_calibration
from implicam.calibrators.forward_gp.wand.gauge import cameras_grow_with_the_world, cameras_move_with_the_world
from implicam.dataset import Dataset
from implicam.geometry import register, rotation_from_vector
from implicam.simulate import Rig, Target, Unusual, as_wand, build_rig, random_positions, simulate, waved_wand


def waved(rig: Rig, frames: int) -> tuple[Target, Dataset, ForwardGPCalibration]:
    target = waved_wand(rig, frames, np.random.default_rng(4))
    recorded = simulate(rig, target, seed=4, outliers=0.04, missing=0.1)
    return target, recorded, ForwardGP(wand=target.wand or 0.0).fit(as_wand(recorded, target))


def judged(
    rig: Rig, target: Target, recorded: Dataset, calibration: ForwardGPCalibration, flip: tuple[float, ...] = (1, 1, 1)
) -> tuple[float, float]:
    """Rms error of new positions over the limit, and the share of them in their 95 % ellipsoids."""
    row = {str(name): i for i, name in enumerate(recorded.points)}
    rows = [row[str(name)] for name in calibration.data.points]
    to_truth, _ = register(calibration.data.xyz * flip, target.xyz[rows])
    held = simulate(rig, random_positions(rig, 200, np.random.default_rng(9)), seed=900)
    measured = calibration.measure(held.observations)
    good, turn = measured.measured, to_truth.rotation * flip
    assert held.truth is not None
    assert good.mean() > 0.9
    error = to_truth.apply(measured.xyz[good] * flip) - held.truth.xyz[good]
    cov = turn @ measured.cov[good] @ turn.T
    inside = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error) < chi2.ppf(0.95, 3)
    limit = np.trace(held.truth.limit[good], axis1=1, axis2=2).mean()
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1)) / limit)), float(inside.mean())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spec", "unusual"),
    [
        ("bar4", Unusual(mirror="cam2")),
        ("bar4", Unusual(tilt=10.0)),
        ("dome4", Unusual(aspect=0.7)),
    ],
)
def test_cameras_of_other_kinds_are_found_and_their_error_bars_hold(spec: str, unusual: Unusual) -> None:
    rig = build_rig(spec, seed=2, unusual=unusual)
    target, recorded, calibration = waved(rig, 120)
    assert not calibration.fitted.uncalibrated
    ratio, inside = judged(rig, target, recorded, calibration)
    assert ratio < 1.5
    assert inside > 0.88


@pytest.mark.slow
def test_a_camera_before_a_mirror_is_said_to_be_one_and_comes_back_from_a_file(tmp_path: Path) -> None:
    rig = build_rig("bar3", seed=2, unusual=Unusual(mirror="cam3"))
    _, recorded, calibration = waved(rig, 80)
    assert any("cam3" in note and "mirror" in note for note in calibration.notes)
    path = tmp_path / "wand.implicam"
    calibration.save(path)
    few = recorded.observations.select(np.arange(10))
    np.testing.assert_array_equal(load_calibration(path).measure(few).xyz, calibration.measure(few).xyz)
    models = calibration.posterior.models
    rng, middle, h = np.random.default_rng(0), np.array([0.1, -0.2, 0.3]), 1e-4
    x = 0.5 * rng.normal(size=(5, 3))
    shift, start = rng.normal(size=6), 0
    there = middle + (x - middle) @ rotation_from_vector(h * shift[:3]).T + h * shift[3:]
    grown = middle + (1 + h) * (x - middle)
    moves, grows = cameras_move_with_the_world(models, middle), cameras_grow_with_the_world(models, middle)
    for model in models:
        own = slice(start, start + model.camera.size)
        before = model.camera.pixel(x)
        np.testing.assert_allclose(model.camera.moved(h * moves[own] @ shift).pixel(there), before, atol=1e-3)
        np.testing.assert_allclose(model.camera.moved(h * grows[own]).pixel(grown), before, atol=1e-3)
        start += model.size


@pytest.mark.slow
def test_a_rig_whose_pictures_are_all_mirrored_has_a_mirrored_world() -> None:
    """Nothing in the pictures says so: lengths are those of the true world, left and right are not."""
    rig = build_rig("bar3", seed=2, unusual=Unusual(mirror="all"))
    target, recorded, calibration = waved(rig, 140)
    ratio, inside = judged(rig, target, recorded, calibration, (1.0, 1.0, -1.0))
    assert ratio < 1.5
    assert inside > 0.88
