"""Cameras from points at places nobody knows, and known lengths between some of them: no wand."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from command_line import Cli, cli  # noqa: F401  a fixture
from implicam.calibrators import ForwardGP, ForwardGPCalibration, load_calibration
from implicam.dataset import Dataset, write_dataset
from implicam.dataset.scale_bars import ScaleBar, bar_rows, read_bars
from implicam.derived import distances
from implicam.errors import DatasetError, FitError, UsageError
from implicam.geometry import register
from implicam.simulate import Rig, Target, build_rig, random_positions, simulate


@cache
def recorded() -> tuple[Rig, Target, Dataset]:
    """A rig of three cameras, 120 points, and what was seen of them: a tenth wrong or missing."""
    rig = build_rig("bar3", seed=6)
    target = random_positions(rig, 120, np.random.default_rng(6))
    return rig, target, replace(simulate(rig, target, seed=6, outliers=0.05, missing=0.05), known=None, extra={})


def bars(count: int) -> list[ScaleBar]:
    """Long ones, between points that all cameras see rightly."""
    _, target, data = recorded()
    good = np.flatnonzero(data.observations.seen.all(axis=1))
    wrong = (np.asarray(data.observations.extra["outlier"]) == "1").any(axis=1)
    free, found = [int(i) for i in good if not wrong[i]], []
    while len(found) < count:
        i = free.pop(0)
        j = max(free, key=lambda k: float(np.linalg.norm(target.xyz[k] - target.xyz[i])))
        free.remove(j)
        length = float(np.linalg.norm(target.xyz[i] - target.xyz[j]))
        found.append(ScaleBar(str(data.points[i]), str(data.points[j]), length))
    return found


def stated(some: list[ScaleBar]) -> str:
    return ";".join(f"{bar.a},{bar.b},{bar.length}" for bar in some)


@cache
def from_one_length() -> ForwardGPCalibration:
    return ForwardGP(scale_bars=stated(bars(1))).fit(recorded()[2])


@pytest.mark.slow
def test_one_known_length_and_points_are_a_calibration_with_error_bars_that_hold() -> None:
    rig, target, data = recorded()
    calibration = from_one_length()
    assert calibration.camera_names == ("cam1", "cam2", "cam3")
    row = {str(name): i for i, name in enumerate(data.points)}
    to_truth, _ = register(calibration.data.xyz, target.xyz[[row[str(name)] for name in calibration.data.points]])
    held = simulate(rig, random_positions(rig, 200, np.random.default_rng(9)), seed=900)
    measured = calibration.measure(held.observations)
    assert held.truth is not None
    error = to_truth.apply(measured.xyz) - held.truth.xyz
    cov = to_truth.rotation @ measured.cov @ to_truth.rotation.T
    assert np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error).mean() < 6
    pairs = [(i, i + 100) for i in range(100)]
    lengths = distances(measured, pairs)
    true = np.array([np.linalg.norm(held.truth.xyz[i] - held.truth.xyz[j]) for i, j in pairs])
    off = (np.array([one.value for one in lengths]) - true) / np.array([one.sd for one in lengths])
    assert np.mean(np.abs(off) < 1.96) > 0.8
    assert "The world is that of the points" in calibration.notes[0]
    assert any("The size rests on one length" in note for note in calibration.notes)


@pytest.mark.slow
def test_how_exact_the_one_length_is_is_how_exact_all_are(tmp_path: Path) -> None:
    bar = bars(1)[0]._replace(sd=bars(1)[0].length * 0.02)
    uncertain = ForwardGP(scale_bars=f"{bar.a},{bar.b},{bar.length},{bar.sd}").fit(recorded()[2])
    for calibration, least, most in ((uncertain, 0.019, 0.022), (from_one_length(), 0.0, 0.01)):
        length = distances(calibration.measure(recorded()[2].observations), [(bar.a, bar.b)])[0]
        assert least < length.sd / length.value < most
    uncertain.save(tmp_path / "points.implicam")
    again = load_calibration(tmp_path / "points.implicam")
    assert again.notes == uncertain.notes
    assert again.summary() == uncertain.summary()


@pytest.mark.slow
def test_a_wrong_scale_bar_is_named_and_two_that_contradict_each_other_are_refused() -> None:
    some = bars(5)
    some[1] = some[1]._replace(length=1.05 * some[1].length)
    assert ForwardGP(scale_bars=stated(some)).fit(recorded()[2]).waved.rejected_lengths == (str(some[1]),)  # type: ignore[union-attr]
    with pytest.raises(FitError, match="of 2 scale bars agree with the others") as told:
        ForwardGP(scale_bars=stated(some[:2])).fit(recorded()[2])
    assert str(some[0]) in str(told.value)


@pytest.mark.slow
def test_the_command_reads_a_table(tmp_path: Path, cli: Cli) -> None:
    write_dataset(recorded()[2], tmp_path / "points")
    table = "a,b,distance,sd\n" + "".join(f"{bar.a},{bar.b},{bar.length},0.01\n" for bar in bars(4))
    (tmp_path / "bars.csv").write_text(table)
    ran = cli("calibrate", tmp_path / "points", "--scale-bars", tmp_path / "bars.csv", "-o", tmp_path / "a.implicam")
    assert ran.code == 0
    assert "The world is that of the points" in ran.err + ran.out
    assert "verdict: usable" in ran.err + ran.out


def test_what_makes_no_sense_is_refused() -> None:
    _, _, data = recorded()
    for wrong in ("a,b", "a,a,5", "a,b,-1", "a,b,x", ";", "a,b,5,9"):
        with pytest.raises(UsageError, match="is no scale bar"):
            read_bars(wrong)
    with pytest.raises(UsageError, match="without a wand"):
        ForwardGP(scale_bars="a,b,5", wand=3.0)
    with pytest.raises(DatasetError, match="has no point 'nowhere'"):
        ForwardGP(scale_bars=f"nowhere,{data.points[0]},5").fit(data)
    a, b, c = map(str, data.points[:3])
    with pytest.raises(DatasetError, match="is in two scale bars"):
        bar_rows(data, [ScaleBar(a, b, 5.0), ScaleBar(b, c, 5.0)])
    with pytest.raises(UsageError, match="are known"):
        ForwardGP(scale_bars=f"{a},{b},5").fit(simulate(*recorded()[:2], seed=6))
