"""Distances, angles, planes, spheres, cylinders and motions: held against errors that are drawn from the stated joint
covariance, against recalibrations of simulated rigs, and against closed forms."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

import implicam as ic
from command_line import Cli, cli  # noqa: F401  a fixture
from implicam.dataset import Floats
from implicam.derived import angle, distance, distances, fit_cylinder, fit_motion, fit_plane, fit_sphere, joint
from implicam.derived.table import read_pairs
from implicam.errors import DatasetError, NumericalError, UsageError
from implicam.files import write_text
from implicam.measurement import Measurement, SharedErrors
from implicam.simulate import build_rig, random_positions, simulate

TRIALS = 400


class Drawn:
    """Measurements of points whose errors have a joint covariance that is known."""

    def __init__(self, true: Floats, seed: int, *, own: float = 0.05, shared: float = 0.1) -> None:
        self.true, self.rng = true, np.random.default_rng(seed)
        n = len(true)
        roots = own * self.rng.normal(size=(n, 3, 3))
        self.own_root, self.slopes = roots, shared * self.rng.normal(size=(n, 3, 2)) / np.sqrt(2)

    def measure(self) -> Measurement:
        n = len(self.true)
        off = np.einsum("nij,nj->ni", self.own_root, self.rng.normal(size=(n, 3))) + self.slopes @ self.rng.normal(
            size=2
        )
        cov = self.own_root @ self.own_root.swapaxes(1, 2) + self.slopes @ self.slopes.swapaxes(1, 2)
        shared = SharedErrors(lambda rows: self.slopes[rows], np.arange(n), np.eye(3))
        names, none = np.array([f"p{i}" for i in range(n)]), np.full(n, np.nan)
        return Measurement(
            names, self.true + off, cov, np.full(n, 4), none, np.full(n, ""), "mm", shared=shared
        )  # fmt: skip


def nees(error: Floats, cov: Floats) -> float:
    """Of as many degrees of freedom as the covariance has."""
    values, vectors = np.linalg.eigh(cov)
    good = values > 1e-9 * values[-1]
    return float(np.sum((vectors.T @ error)[good] ** 2 / values[good]))


def check_nees(found: list[float], freedom: int) -> None:
    """Within four standard errors of what it is on average."""
    assert abs(np.mean(found) - freedom) < 4 * np.sqrt(2 * freedom / len(found))


def test_the_joint_covariance_is_that_of_what_was_drawn() -> None:
    drawn = Drawn(np.random.default_rng(0).uniform(-50, 50, (4, 3)), 1)
    off = np.array([(drawn.measure().xyz - drawn.true).ravel() for _ in range(20_000)])
    stated = joint(drawn.measure(), ["p0", "p1", 2, -1])
    np.testing.assert_allclose(stated.cov, np.cov(off.T), atol=5 * np.abs(stated.cov).max() / np.sqrt(20_000) * 1.5)
    np.testing.assert_allclose(np.diagonal(stated.cov)[:3], np.diagonal(drawn.measure().cov[0]), rtol=1e-9)


@pytest.mark.slow
def test_distances_and_angles_have_the_spread_that_they_state() -> None:
    true = np.array([[0.0, 0, 0], [80, 10, 5], [20, 70, -10]])
    drawn = Drawn(true, 2, shared=1.0)
    lengths, angles = [], []
    for _ in range(2000):
        measured = drawn.measure()
        lengths.append((distance(measured, "p0", "p1").value, distance(measured, "p0", "p1").sd))
        angles.append((angle(measured, 1, 0, 2).value, angle(measured, 1, 0, 2).sd))
    u, v = true[1] - true[0], true[2] - true[0]
    right = np.linalg.norm(u), np.degrees(np.arccos(u @ v / np.linalg.norm(u) / np.linalg.norm(v)))
    for found, truth in zip((lengths, angles), right, strict=True):
        values, sds = np.array(found).T
        check_nees(list(((values - truth) / sds) ** 2), 1)
    separately = np.sqrt(sum(drawn.measure().cov[i] for i in (0, 1))[0, 0])
    assert distance(drawn.measure(), 0, 1).sd < 0.99 * separately or separately > 0


def test_points_that_are_off_together_have_an_exact_distance() -> None:
    """What adding the covariances would get wrong."""
    drawn = Drawn(np.array([[0.0, 0, 0], [100, 0, 0]]), 3, own=1e-4, shared=1.0)
    drawn.slopes[1] = drawn.slopes[0]
    found = distance(drawn.measure(), 0, 1)
    assert found.sd < 1e-3 < 0.1 < drawn.measure().sd.max()
    assert found.value == pytest.approx(100, abs=1e-3)


def on_plane(rng: np.random.Generator, n: int) -> Floats:
    x = np.column_stack([rng.uniform(-60, 60, (n, 2)), np.zeros(n)])
    return np.asarray(x @ Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix().T + [30, -20, 400])


def on_sphere(rng: np.random.Generator, n: int) -> Floats:
    d = rng.normal(size=(n, 3)) + np.array([0, 0, 1.5])
    return np.asarray(25 * d / np.linalg.norm(d, axis=1)[:, None] + [5, 6, 7])


def on_cylinder(rng: np.random.Generator, n: int) -> Floats:
    round_, along = rng.uniform(0, 4, n), rng.uniform(-60, 60, n)
    x = np.column_stack([18 * np.cos(round_), 18 * np.sin(round_), along])
    return np.asarray(x @ Rotation.from_rotvec([0.9, 0.4, 0.0]).as_matrix().T + [100, 0, -30])


def test_planes() -> None:
    drawn = Drawn(on_plane(np.random.default_rng(4), 12), 5)
    turn = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix()
    normal = turn[:, 2] * np.sign(turn[:, 2] @ [30, -20, 400])
    offsets, tilts, p = [], [], []
    for _ in range(TRIALS):
        plane = fit_plane(drawn.measure(), range(12))
        offsets.append(((plane.offset.value - abs(turn[:, 2] @ [30, -20, 400])) / plane.offset.sd) ** 2)
        tilts.append(nees(plane.normal - normal, plane.normal_cov))
        p.append(plane.form.consistency)
    check_nees(offsets, 1)
    check_nees(tilts, 2)
    assert kstest(p, "uniform").pvalue > 1e-4


def test_spheres() -> None:
    drawn = Drawn(on_sphere(np.random.default_rng(6), 12), 7)
    found, p = [], []
    for _ in range(TRIALS):
        sphere = fit_sphere(drawn.measure(), range(12))
        found.append(nees(np.array([*sphere.centre, sphere.radius.value]) - [5, 6, 7, 25], sphere.cov))
        p.append(sphere.form.consistency)
    check_nees(found, 4)
    assert kstest(p, "uniform").pvalue > 1e-4


@pytest.mark.slow
def test_cylinders() -> None:
    drawn = Drawn(on_cylinder(np.random.default_rng(8), 16), 9)
    axis = Rotation.from_rotvec([0.9, 0.4, 0.0]).as_matrix()[:, 2]
    radii, tilts, places = [], [], []
    for _ in range(60):
        cylinder = fit_cylinder(drawn.measure(), range(16))
        along = axis * np.sign(axis @ cylinder.direction)
        radii.append(((cylinder.radius.value - 18) / cylinder.radius.sd) ** 2)
        tilts.append(nees(cylinder.direction - along, cylinder.direction_cov))
        off = np.array([100, 0, -30]) - cylinder.centre  # its axis, where the plane across the found one meets it
        off = off - (off @ cylinder.direction) / (along @ cylinder.direction) * along
        places.append(nees(off, cylinder.centre_cov))
    check_nees(radii, 1)
    check_nees(tilts, 2)
    check_nees(places, 2)


def test_motions() -> None:
    rng = np.random.default_rng(10)
    body, turn = rng.uniform(-40, 40, (6, 3)), Rotation.from_rotvec([0.2, 0.7, -0.4]).as_matrix()
    drawn = Drawn(np.concatenate([body, body @ turn.T + [12, -5, 30]]), 11)
    turns, p = [], []
    for _ in range(TRIALS):
        motion = fit_motion(drawn.measure(), range(6), range(6, 12))
        turns.append(nees(Rotation.from_matrix(turn @ motion.rotation.T).as_rotvec(), motion.cov[:3, :3]))
        p.append(motion.form.consistency)
    check_nees(turns, 3)
    assert kstest(p, "uniform").pvalue > 1e-4
    exact = Drawn(drawn.true, 12, own=1e-9, shared=1e-9)
    motion = fit_motion(exact.measure(), range(6), range(6, 12))
    np.testing.assert_allclose(motion.rotation, turn, atol=1e-9)
    np.testing.assert_allclose(motion.translation, [12, -5, 30], atol=1e-7)
    assert motion.angle.value == pytest.approx(np.degrees(np.linalg.norm([0.2, 0.7, -0.4])), abs=1e-7)


def test_many_points_give_what_few_do() -> None:
    """Beyond some number the covariance of the equations is kept as blocks and what they share."""
    from implicam.derived import features

    measured = Drawn(on_plane(np.random.default_rng(13), 40), 14).measure()
    whole = fit_plane(measured, range(40))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(features, "MAX_WHOLE", 10)
        parts = fit_plane(measured, range(40))
    np.testing.assert_allclose(parts.normal, whole.normal, atol=1e-9)
    np.testing.assert_allclose(parts.normal_cov, whole.normal_cov, rtol=1e-6, atol=1e-15)
    assert parts.form.consistency == pytest.approx(whole.form.consistency, abs=1e-6)


REFUSED: dict[str, tuple[Callable[[Measurement], object], str]] = {
    "no such point": (lambda m: distance(m, "p0", "q1"), "no point 'q1'"),
    "not measured": (lambda m: distance(m, "p0", "p11"), "'p11' was not measured"),
    "a number too many": (lambda m: distance(m, 0, 12), "no point 12"),
    "one point": (lambda m: distance(m, "p0", 0), "between two points"),
    "two of a plane": (lambda m: fit_plane(m, [0, 1]), "a plane takes 3 points, and 2 are given"),
    "twice": (lambda m: fit_plane(m, [0, 1, 1]), "a point is given twice"),
    "unlike": (lambda m: fit_motion(m, [0, 1, 2], [3, 4]), "3 points before the motion and 2 after"),
    "a level": (lambda m: distance(m, 0, 1).interval(95), "no probability"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_wrong_is_named(case: str) -> None:
    measured = Drawn(on_sphere(np.random.default_rng(15), 12), 16).measure()
    xyz = measured.xyz.copy()
    xyz[11] = np.nan
    with pytest.raises(UsageError, match=REFUSED[case][1]):
        REFUSED[case][0](replace(measured, xyz=xyz))


def test_points_that_fix_nothing_are_refused() -> None:
    line = Drawn(np.column_stack([np.arange(8.0), np.zeros((8, 2))]), 17, own=1e-9, shared=1e-9).measure()
    flat = Drawn(np.column_stack([on_sphere(np.random.default_rng(18), 8)[:, :2], np.zeros(8)]), 19, own=0, shared=0)
    with pytest.raises(UsageError, match="a plane lie on a line"):
        fit_plane(line, range(8))
    with pytest.raises(UsageError, match="a sphere lie in a plane"):
        fit_sphere(flat.measure(), range(8))
    with pytest.raises(NumericalError):
        fit_cylinder(line, range(8))
    with pytest.raises(UsageError, match="have in common is not known"):
        distance(replace(line, shared=None), 0, 1)


def test_points_nearer_than_their_error_bars_say_so() -> None:
    near = Drawn(np.array([[0.0, 0, 0], [0.02, 0, 0]]), 20)
    assert "not to be trusted" in distance(near.measure(), 0, 1).note
    assert distance(Drawn(np.array([[0.0, 0, 0], [50, 0, 0]]), 20).measure(), 0, 1).note == ""


@pytest.mark.parametrize("method", [ic.ForwardGP(), ic.Explicit(), ic.InverseGP(), ic.InverseGP(preset="plain")])
def test_methods_say_what_errors_share(method: ic.ForwardGP) -> None:
    """Selected, turned and in another unit, a distance stays what it is; and no own variance is negative."""
    rig = build_rig("stereo", seed=3)
    calibration = method.fit(simulate(rig, random_positions(rig, 40, np.random.default_rng(3)), seed=3))
    new = simulate(rig, random_positions(rig, 12, np.random.default_rng(4)), seed=4)
    measured = calibration.measure(new.observations)
    found = distance(measured, 2, 5)
    apart = np.linalg.norm(measured.xyz[2] - measured.xyz[5])
    assert found.value == pytest.approx(apart)
    own = joint(measured, range(12))
    np.testing.assert_allclose(np.diagonal(own.cov), measured.sd.ravel() ** 2, rtol=1e-6)
    pose = Rotation.from_rotvec([0.3, 0.2, 1.0])
    for again in (measured.transformed(pose), measured.select([2, 5, 7]), measured.in_unit("m")):
        same = distance(again, str(measured.points[2]), str(measured.points[5]))
        scale = 1000.0 if again.length_unit == "m" else 1.0
        assert scale * same.value == pytest.approx(found.value, rel=1e-9)
        assert scale * same.sd == pytest.approx(found.sd, rel=1e-6)
    assert len(distances(measured, [(i, j) for i in range(12) for j in range(i)])) == 66


def test_distances_on_the_command_line(cli: Cli) -> None:
    rig = build_rig("stereo", seed=3)
    known = simulate(rig, random_positions(rig, 20, np.random.default_rng(3)), seed=3)
    ic.ForwardGP().fit(known).save("rig.implicam")
    new = simulate(rig, random_positions(rig, 6, np.random.default_rng(4)), seed=4)
    uv = new.observations.uv.copy()
    uv[5, 0] = np.nan
    ic.write_dataset(replace(new, known=None, observations=replace(new.observations, uv=uv)), "new.csv")
    names = [str(name) for name in new.points]
    write_text(Path("pairs.csv"), f"a,b,what\n{names[2]},{names[3]},edge\n{names[5]},{names[0]},\n")
    ran = cli("measure", "rig.implicam", "new.csv", "--distance", names[0], names[1], "--distances", "pairs.csv")
    assert ran.code == 0, ran.err
    assert "distances.csv: 3 distances" in ran.out
    with open("distances.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["a"], row["b"]) for row in rows] == [(names[0], names[1]), (names[2], names[3]), (names[5], names[0])]
    right = distance(ic.load_calibration("rig.implicam").measure(new.observations), names[0], names[1])
    assert float(rows[0]["distance"]) == pytest.approx(right.value, rel=1e-12)
    assert float(rows[0]["sd"]) == pytest.approx(right.sd, rel=1e-9)
    assert float(rows[0]["low_95"]) == pytest.approx(right.interval()[0], rel=1e-9)
    assert rows[2]["distance"] == ""
    assert "was not measured" in rows[2]["note"]
    ran = cli("measure", "rig.implicam", "new.csv", "--distance", names[0], "nobody")
    assert ran.code != 0
    assert "no point 'nobody'" in ran.err
    write_text(Path("pairs.csv"), "p,q\n1,2\n")
    assert (
        "the first line must name at least the columns a,b"
        in cli("measure", "rig.implicam", "new.csv", "--distances", "pairs.csv").err
    )


@pytest.mark.parametrize("text", ["a,b\np1,p2\n", "a;b\np1;p2\n", "a\tb\np1\tp2\n", "note,b,a\nx,p2,p1\n"])
def test_pairs_are_read_however_they_are_separated(text: str, tmp_path: Path) -> None:
    (tmp_path / "pairs.csv").write_text(text)
    assert read_pairs(tmp_path / "pairs.csv") == [("p1", "p2")]


@pytest.mark.parametrize("text", ["", "from,to\np1,p2\n", "a;b\np1;p2;p3\n"])
def test_what_is_no_table_of_pairs_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "pairs.csv").write_text(text)
    with pytest.raises(DatasetError, match=r"pairs\.csv"):
        read_pairs(tmp_path / "pairs.csv")
