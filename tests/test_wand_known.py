"""Known points and a wand in one adjustment."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

import implicam as ic
from command_line import Cli, cli  # noqa: F401  a fixture
from implicam.calibrators import ForwardGP, ForwardGPCalibration, load_calibration
from implicam.calibrators.forward_gp.wand.bundle import Lengths
from implicam.calibrators.forward_gp.wand.known import Facts, KnownPlaces
from implicam.dataset import Dataset, write_dataset
from implicam.dataset.wand import each_place_once, lying_still, marker_rows
from implicam.derived import distances, joint
from implicam.errors import DatasetError, FitError, UsageError
from implicam.geometry import Floats
from implicam.simulate import Rig, as_wand, build_rig, random_positions, simulate, waved_wand


class Both(NamedTuple):
    """A rig, its waved wand of a length, known points, and the calibration from both."""

    rig: Rig
    wand: Dataset
    length: float
    known: Dataset
    calibration: ForwardGPCalibration


SD = 0.05
"""mm, of the known positions."""


@pytest.fixture(scope="module")
def both() -> Both:
    rig = build_rig("stereo", seed=2)
    target = waved_wand(rig, 60, np.random.default_rng(2))
    wand = as_wand(simulate(rig, target, seed=2), target)
    seen = simulate(rig, random_positions(rig, 8, np.random.default_rng(5)), seed=55)
    assert seen.truth is not None
    xyz = seen.truth.xyz + SD * np.random.default_rng(1).normal(size=(8, 3))
    known = stated(seen, xyz)
    length = target.wand or 0.0
    return Both(rig, wand, length, known, ForwardGP(wand=length, known=known).fit(wand))


def stated(seen: Dataset, xyz: Floats, sd: float = SD) -> Dataset:
    return replace(seen, known=ic.KnownPositions(seen.points, xyz, np.full(xyz.shape, sd)))


@pytest.mark.slow
def test_known_points_say_where_the_world_is_and_more(both: Both) -> None:
    held = simulate(both.rig, random_positions(both.rig, 30, np.random.default_rng(8)), seed=800)
    assert held.truth is not None
    measured = both.calibration.measure(held)
    rows = np.flatnonzero(measured.measured)
    off = (measured.xyz[rows] - held.truth.xyz[rows]).ravel()
    assert 0.4 < off @ np.linalg.solve(joint(measured, rows.tolist()).cov, off) / len(off) < 2.0
    apart = ic.set_world(ForwardGP(wand=both.length).fit(both.wand), both.known).measure(held)
    assert np.median(np.trace(measured.cov, axis1=1, axis2=2)) < np.median(np.trace(apart.cov, axis1=1, axis2=2))
    assert both.calibration.notes[0].startswith("The world is that of 8 known points, which were adjusted together")
    with pytest.raises(UsageError, match="that of its known positions"):
        ic.set_world(both.calibration, both.known)


@pytest.mark.slow
def test_a_wand_of_uncertain_length_is_corrected_by_known_points(both: Both) -> None:
    wrong = ForwardGP(wand=1.01 * both.length, wand_sd=0.01 * both.length, known=both.known).fit(both.wand)
    held = simulate(both.rig, random_positions(both.rig, 12, np.random.default_rng(8)), seed=801)
    assert held.truth is not None
    measured = wrong.measure(held)
    true = np.linalg.norm(held.truth.xyz[0] - held.truth.xyz[1:], axis=1)
    found = distances(measured, [(0, i) for i in range(1, 12)])
    assert np.mean([one.value / d for one, d in zip(found, true, strict=True)]) == pytest.approx(1, abs=0.003)
    assert wrong.waved is not None
    assert wrong.waved.known_rejected == ()
    with pytest.raises(FitError, match="times as far apart as the wand says"):
        ForwardGP(wand=1.03 * both.length, known=both.known).fit(both.wand)


@pytest.mark.slow
def test_a_wrong_known_point_is_named(both: Both) -> None:
    xyz = both.known.xyz.copy()
    xyz[3] += 10
    noted = ForwardGP(wand=both.length, known=stated(both.known, xyz)).fit(both.wand)
    assert noted.waved is not None
    assert noted.waved.known_rejected == ("random004",)
    assert "contradict the others: random004" in noted.notes[0]


@pytest.mark.slow
def test_known_points_of_another_scale_or_place_are_refused(both: Both) -> None:
    for xyz, what in (
        (both.known.xyz / 1000, "0.00.* times as far apart"),
        (both.known.xyz * [1, 1, -1], "contradict each other"),
        (both.known.xyz * 0, "do not fix a rigid motion"),
    ):
        with pytest.raises(FitError, match=what):
            ForwardGP(wand=both.length, known=stated(both.known, xyz)).fit(both.wand)
    with pytest.raises(FitError, match="2 of 2 known points can be placed"):
        ForwardGP(wand=both.length, known=both.known.select([0, 1])).fit(both.wand)
    with pytest.raises(UsageError, match="there is none"):
        ForwardGP(known=both.known).fit(both.known)
    with pytest.raises(UsageError, match="markers are not known"):
        ForwardGP(wand=both.length).fit(both.known)
    renamed = replace(both.known.observations, points=np.array([both.wand.points[0], *both.known.points[1:]]))
    with pytest.raises(DatasetError, match="is in both datasets"):
        ForwardGP(wand=both.length, known=replace(both.known, observations=renamed)).fit(both.wand)


def test_a_file_keeps_the_known_points(both: Both, tmp_path: Path) -> None:
    both.calibration.save(tmp_path / "both.implicam")
    again = load_calibration(tmp_path / "both.implicam")
    assert isinstance(again, ForwardGPCalibration)
    np.testing.assert_array_equal(again.measure(both.known).cov, both.calibration.measure(both.known).cov)
    assert again.notes == both.calibration.notes
    assert again.calibrator.known is not None
    assert again.calibrator.known.xyz == pytest.approx(both.known.xyz, abs=1e-12)
    assert again.calibrator.known.positions.sd == pytest.approx(SD)
    assert not again.free_world


def test_the_equations_are_slopes_of_what_is_minimised() -> None:
    rng = np.random.default_rng(3)
    places, h = rng.normal(size=(3, 2, 3)), 1e-6
    lengths = Lengths(np.array([0, 2]), 1.5, np.array([0.3, 0.2]))
    known = KnownPlaces(np.array([1, 2]), rng.normal(size=(2, 3)), rng.uniform(0.1, 0.5, size=(2, 3)))
    facts = Facts(lengths, known, 0.02, 0.05)

    def cost(at: Floats, growth: float) -> float:
        size = np.linalg.norm(at[lengths.frames, 1] - at[lengths.frames, 0], axis=1)
        off = (1.5 * (1 + growth) - size) / lengths.sd
        away = (known.xyz - at.reshape(-1, 3)[known.rows]) / known.sd
        return float(off @ off + np.sum(away**2) + (growth / 0.05) ** 2)

    found = facts.equations([], places)
    assert found.squares == pytest.approx(cost(places, 0.02))
    for f in range(3):
        for k in range(6):
            step = np.zeros((3, 2, 3))
            step[f, k // 3, k % 3] = h
            slope = (cost(places + step, 0.02) - cost(places - step, 0.02)) / (2 * h)
            assert found.g[f, k] == pytest.approx(-0.5 * slope, abs=1e-6)
    slope = (cost(places, 0.02 + h) - cost(places, 0.02 - h)) / (2 * h)
    assert found.b[0] == pytest.approx(-0.5 * slope, abs=1e-6)
    # a step along places and growth together, to second order, as least squares have it
    off, by_place = lengths._replace(length=1.5 * 1.02).linear(places)
    assert found.A[0, 0] == pytest.approx(np.sum((1.5 / lengths.sd) ** 2) + 0.05**-2)
    assert found.G[lengths.frames, :, 0] == pytest.approx(-by_place * (1.5 / lengths.sd)[:, None])
    assert len(off) == 2


def test_the_command(both: Both, tmp_path: Path, cli: Cli) -> None:
    write_dataset(both.wand, tmp_path / "wand")
    write_dataset(both.known, tmp_path / "l-frame")
    ran = cli("calibrate", "wand", "--known", "l-frame", "-o", "both.implicam")
    assert ran.code == 0
    assert "The world is that of 8 known points" in ran.err + ran.out
    assert "verdict: usable" in ran.out + ran.err


@pytest.mark.slow
def test_a_wand_that_lies_still_counts_once(both: Both) -> None:
    rng, uv = np.random.default_rng(4), both.wand.observations.uv
    still = np.repeat(uv[:2][None], 30, axis=0) + 0.2 * rng.normal(size=(30, 2, *uv.shape[1:]))
    still[7, 0, 0] += 50.0  # a wrong view makes no other place of it
    frames = [f"s{i}" for i in range(30)]
    columns = {"frame": np.repeat(frames, 2), "marker": np.tile(["a", "b"], 30)}
    points = np.array([f"{f} {m}" for f in frames for m in "ab"])
    lying = Dataset.from_arrays(still.reshape(60, *uv.shape[1:]), points=points, cameras=both.wand.cameras, unit="mm")
    lying = replace(lying, columns=columns, extra=both.wand.extra)
    _, rows = marker_rows(lying, ())
    first = lying_still(lying, rows)
    assert first.tolist() == [0] * 30
    once = each_place_once(lying, rows, first)
    assert np.abs(once.observations.uv[:2] - uv[:2]).max() < 0.2
    plain = replace(both.wand, columns=both.wand.further_columns())
    more = ForwardGP(wand=both.length).fit(ic.join(replace(plain, extra=lying.extra), lying))
    assert more.waved is not None
    assert len(more.waved.errors) == 61
    assert sum("counts once" in one.reason for one in more.unused) == 58
    _, rows = marker_rows(both.wand, ())
    assert (lying_still(both.wand, rows) == np.arange(60)).all()


def test_frames_that_are_repeated_count_once(both: Both) -> None:
    """An export that holds the same frames eight times over: no more is known, and bars are no smaller."""
    plain, columns = both.wand, both.wand.further_columns()
    parts = []
    for k in range(2):
        named = {**columns, "frame": np.array([f"{k} {name}" for name in columns["frame"]])}
        points = np.array([f"{k} {name}" for name in plain.points])
        parts.append(Dataset.from_arrays(plain.observations.uv, points=points, cameras=plain.cameras, unit="mm"))
        parts[-1] = replace(parts[-1], columns=named, extra=plain.extra)
    twice = ic.join(*parts)
    _, rows = marker_rows(twice, ())
    n = len(rows) // 2
    assert lying_still(twice, rows).tolist() == [*range(n), *range(n)]
