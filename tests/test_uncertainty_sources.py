"""How much of a variance more known points could remove: held against the limit of perfect cameras, and against fits
that have those points."""

from __future__ import annotations

import csv
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from implicam.calibrators import MLP, Explicit, ForwardGP, InverseGP
from implicam.calibrators.protocol import Calibration, Calibrator
from implicam.dataset import Dataset, Observations
from implicam.figures import scene
from implicam.measurement import MEASURED_COLUMNS, Measurement
from implicam.report import ReportData, words
from implicam.simulate import build_rig, random_positions, simulate


@cache
def known(n: int, seed: int = 0) -> Dataset:
    rig = build_rig("bar4", seed=seed)
    return simulate(rig, random_positions(rig, n, np.random.default_rng([seed, n])), seed=seed)


@cache
def to_measure() -> Dataset:
    rig = build_rig("bar4", seed=0)
    return simulate(rig, random_positions(rig, 150, np.random.default_rng([0, 2])), seed=1)


@cache
def fitted(method: Calibrator, n: int) -> Calibration:
    return method.fit(known(n))


def variance(measured: Measurement) -> np.ndarray:
    return np.trace(measured.cov, axis1=1, axis2=2)


@pytest.mark.parametrize("method", [ForwardGP(), Explicit()], ids=["forward-gp", "explicit"])
def test_what_is_left_is_the_limit_of_perfect_cameras(method: Calibrator) -> None:
    """The Cramer-Rao limit comes from the simulator's true lenses and noise: it shares nothing with the fit."""
    data = to_measure()
    measured = fitted(method, 60).measure(data.observations)
    whole = np.flatnonzero(measured.measured & (measured.views == data.observations.seen.sum(axis=1)))
    assert data.truth is not None
    limit = np.trace(data.truth.limit[whole], axis1=1, axis2=2)
    noise = (variance(measured) * (1 - measured.share_calibration))[whole]
    # the level of the noise is estimated from 60 points of four cameras, to some 5 % of an sd; explicit takes what the
    # lens cannot follow for noise
    assert np.median(noise / limit) == pytest.approx(1.0, abs=0.2)
    shape = noise / limit / np.median(noise / limit)
    assert np.quantile(np.abs(shape - 1), 0.9) < 0.15


@pytest.mark.parametrize("method", [ForwardGP(), Explicit()], ids=["forward-gp", "explicit"])
def test_more_known_points_remove_what_it_says(method: Calibrator) -> None:
    few, many = (fitted(method, n).measure(to_measure().observations) for n in (35, 700))
    removable = variance(few) * few.share_calibration
    removed = variance(few) - variance(many) * (1 - many.share_calibration)
    both = np.isfinite(removable) & np.isfinite(removed)
    assert np.median(few.share_calibration[both]) > 0.1
    assert np.median(many.share_calibration[both]) < 0.03
    assert np.sum(removed[both]) == pytest.approx(np.sum(removable[both]), rel=0.35)


def test_heavy_tails_do_not_count_as_lack_of_points() -> None:
    """A view that the others outweigh makes the noise of that point larger, not the share of the calibration."""

    def with_t_noise(data: Dataset, seed: int) -> Dataset:
        o = data.observations
        true = np.stack(
            [np.where(o.extra[c] == "", "nan", o.extra[c]).astype(float) for c in ("true_u", "true_v")], axis=2
        )
        noise = 0.2 * np.random.default_rng([seed, 99]).standard_t(3.0, size=true.shape)
        return replace(data, observations=Observations(o.points, o.cameras, true + noise, o.sd))

    calibration = ForwardGP().fit(with_t_noise(known(157), 0))
    assert calibration.map.degrees is not None
    measured = calibration.measure(with_t_noise(to_measure(), 1).observations)
    normal = fitted(ForwardGP(), 157).measure(to_measure().observations)
    share = measured.share_calibration[measured.measured]
    assert np.all((share >= 0) & (share <= 1))
    assert 0.3 < np.median(share) / np.median(normal.share_calibration[normal.measured]) < 3.0


@pytest.mark.parametrize("preset", ["plain", "smooth"])
def test_inverse_gp_takes_its_noise_for_what_stays(preset: str) -> None:
    method = InverseGP(preset=preset)
    few, many = (fitted(method, n).measure(to_measure().observations) for n in (60, 700))
    shares = [m.share_calibration[m.measured] for m in (few, many)]
    assert all(np.all((share > 0) & (share <= 1)) for share in shares)
    assert np.median(shares[1]) < 0.3 * np.median(shares[0])
    calibration = fitted(method, 60)
    if preset == "plain":
        noise = np.array([gp.noise_variance for gp in calibration.processes]) * calibration.positions.scale**2
        np.testing.assert_allclose(variance(few)[few.measured] * (1 - shares[0]), noise.sum(), rtol=1e-9)


def test_a_method_that_cannot_tell_says_nothing(tmp_path: Path) -> None:
    measured = MLP().fit(known(35)).measure(to_measure().observations)
    assert np.isnan(measured.share_calibration).all()
    measured.write_csv(tmp_path / "measured.csv")
    with (tmp_path / "measured.csv").open(newline="", encoding="utf-8") as file:
        assert {row["share_calibration"] for row in csv.DictReader(file)} == {""}
    assert not any("known points" in label for label, *_ in words.tiles(ReportData("r", measured)))


def test_it_stands_at_the_end_of_the_table_in_the_report_and_as_a_colour(tmp_path: Path) -> None:
    measured = fitted(ForwardGP(), 60).measure(to_measure().observations)
    measured.write_csv(tmp_path / "measured.csv")
    with (tmp_path / "measured.csv").open(newline="", encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    assert MEASURED_COLUMNS[-1] == "share_calibration"
    read = np.array([float(row["share_calibration"] or "nan") for row in table])
    np.testing.assert_array_equal(read, measured.share_calibration)
    tile = next(tile for tile in words.tiles(ReportData("r", measured)) if "known points" in tile[0])
    assert tile[0] == "from pixel noise / lack of known points"
    figure = scene(
        measured.xyz, measured.sd, names=measured.points, views=measured.views, unit="mm",
        share_calibration=measured.share_calibration,
    )  # fmt: skip
    labels = [button.label for button in figure.layout.updatemenus[-1].buttons]
    assert labels == ["colour: stated uncertainty", "colour: lack of known points"]
