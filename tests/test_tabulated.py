"""Measuring by tables, compiled and by NumPy, against the exact path: everywhere in the box, and never a silent lie."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import implicam as ic
from command_line import Cli, cli  # noqa: F401
from deployed_rigs import RIGS, of_fisheyes
from deployed_rigs import boards as fitted_boards
from forward_gp_cases import fitted
from implicam.calibrators.protocol import RigCalibration
from implicam.errors import UsageError
from implicam.rig_model.triangulate import Located
from implicam.simulate import build_rig, random_positions, simulate
from implicam.tabulated import Live, RigTable, library, rig_table, why_not_tabulated
from implicam.tabulated.array_solver import Found
from implicam.tabulated.library import CONTRADICTION, LEFT_TO_EXACT, MEASURED, TOO_FEW_VIEWS, Kernel

SOURCE = Path(library.__file__).with_name("kernel.c")
COMPILER = next((name for name in ("cc", "gcc", "clang") if shutil.which(name)), None)

POSITION_SDS, COVARIANCE_PART = 0.01, 0.01
"""What tables may be off the exact path: a position in its standard deviations, and its covariance."""


@pytest.fixture(scope="module")
def kernel(tmp_path_factory: pytest.TempPathFactory) -> Kernel:
    """The kernel as its source is now, whatever is installed."""
    if COMPILER is None:
        pytest.skip("there is no C compiler")
    path = tmp_path_factory.mktemp("kernel") / "_kernel.so"
    flags = ["-O3", "-Wall", "-Wextra", "-Werror", "-fno-math-errno", "-fno-trapping-math", "-fvisibility=hidden"]
    built = [COMPILER, *flags, "-shared", "-fPIC", str(SOURCE), "-o", str(path), "-lm"]
    ran = subprocess.run(built, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    return Kernel(path)


def for_any_processor(kernel: Kernel) -> Kernel:
    plain = Kernel(kernel.path)
    plain.avx2 = False
    return plain


@cache
def tables_of(made: RigCalibration) -> RigTable:
    return RigTable.of(made.map, made.data.xyz)


def views_all_over(made: RigCalibration, places: int, seed: int = 1) -> np.ndarray:
    """(n, C, 2) what the calibrated cameras see, with their noise, of places all over the box and at its corners."""
    table, rig, rng = tables_of(made).table, made.map, np.random.default_rng(seed)
    low, high = rig.frame.to_world(table.low), rig.frame.to_world(table.low + table.step * table.cells)
    inset = 1e-3 * (high - low)
    corners = np.stack(np.meshgrid(*zip(low + inset, high - inset, strict=True)), axis=-1).reshape(-1, 3)
    xyz = np.concatenate([rng.uniform(low, high, (places, 3)), np.repeat(corners, 5, axis=0)])
    uv = made.predict(xyz)[:, list(rig.cameras)] + usual_noise(made) * rng.normal(size=(len(xyz), len(rig.cameras), 2))
    for c, number in enumerate(rig.cameras):
        camera = rig.trained.cameras[number]
        last = np.array([camera.width or np.inf, camera.height or np.inf]) - 0.5
        uv[((uv[:, c] < -0.5) | (uv[:, c] > last)).any(axis=1), c] = np.nan
    return uv


def usual_noise(made: RigCalibration) -> np.ndarray:
    return np.array([[[model.noise]] for model in made.map.posterior.models])[:, 0]


def noise_of(made: RigCalibration, uv: np.ndarray) -> np.ndarray:
    return np.broadcast_to(usual_noise(made)[:, 0], uv.shape[:2])


def off_in_sds(a: np.ndarray, b: np.ndarray, cov: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", a - b, np.linalg.inv(cov), a - b), 0))


def agree(found: Found | Located, exact: Located, rows: np.ndarray) -> None:
    """Positions, covariances, p-values, shares and views of some points are those of the exact path."""
    assert off_in_sds(found.xyz[rows], exact.xyz[rows], exact.cov[rows]).max() < POSITION_SDS
    root = np.linalg.inv(np.linalg.cholesky(exact.cov[rows]))
    sizes = np.linalg.eigvalsh(root @ found.cov[rows] @ root.swapaxes(1, 2))
    assert np.abs(sizes - 1).max() < COVARIANCE_PART
    np.testing.assert_allclose(found.p[rows], exact.p[rows], atol=0.005)
    np.testing.assert_allclose(found.share[rows], exact.share[rows], atol=0.005)
    np.testing.assert_array_equal(found.left_out[rows], exact.left_out[rows])


def compare(made: RigCalibration, kernel: Kernel, places: int, least: float = 0.95) -> None:
    """The kernel for this processor and for any, and NumPy, and all of them with the exact path."""
    tables, uv = tables_of(made), views_all_over(made, places)
    uv[np.random.default_rng(2).random(uv.shape[:2]) < 0.1] = np.nan
    noise = noise_of(made, uv) * np.exp(0.3 * np.random.default_rng(3).normal(size=uv.shape[:2]))
    exact = made.map.locate(uv, noise)
    compiled = tables._by_kernel(kernel, uv, noise)
    sure = compiled.code == MEASURED
    assert sure.mean() > least * (compiled.code != TOO_FEW_VIEWS).mean()
    agree(compiled, exact, sure)
    np.testing.assert_array_equal(compiled.code == TOO_FEW_VIEWS, np.isfinite(uv).all(axis=2).sum(axis=1) < 2)
    others = [tables._by_kernel(for_any_processor(kernel), uv, noise)]
    if not made.map.posterior.tied:
        others.append(tables._by_arrays(uv, noise))
    for other in others:
        both = sure & (other.code == MEASURED) & ~compiled.left_out.any(axis=1)
        assert both.sum() > 0.99 * sure.sum()
        off = off_in_sds(other.xyz[both], compiled.xyz[both], compiled.cov[both])
        assert np.quantile(off, 0.99) < 1e-4
        assert off.max() < 1e-3  # where one has just taken a step more than the other
        np.testing.assert_allclose(other.p[both], compiled.p[both], atol=1e-3)


def test_it_measures_as_the_exact_path_does(kernel: Kernel) -> None:
    compare(fitted(), kernel, 300)


def test_so_it_does_where_fisheyes_look_backwards(kernel: Kernel) -> None:
    compare(fisheyes(), kernel, 200, least=0.8)


@cache
def fisheyes() -> RigCalibration:
    return of_fisheyes(ic.Explicit(lens="kannala-brandt"))


@cache
def boards() -> RigCalibration:
    return fitted_boards()


@pytest.mark.slow
@pytest.mark.parametrize("kind", sorted(RIGS))
def test_so_it_does_for_rigs_of_all_kinds(kind: str, kernel: Kernel, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rig_table, "kernel", lambda: kernel)
    made = RIGS[kind]()
    assert not why_not_tabulated(made.map, len(made.data))
    compare(made, kernel, 1000, least=0.9)


@cache
def six() -> RigCalibration:
    rig = build_rig("bar6", seed=4)
    known = simulate(rig, random_positions(rig, 40, np.random.default_rng(5)), seed=5)
    made: RigCalibration = ic.Explicit(lens="kannala-brandt").fit(known)
    return made


@pytest.mark.parametrize(("wrong", "size"), [(1, 4), (1, 100), (2, 20)])
def test_wrong_views_are_those_of_the_exact_path(wrong: int, size: float, kernel: Kernel) -> None:
    made, rng = six(), np.random.default_rng(wrong)
    uv = views_all_over(made, 60)[:60]
    uv = uv[np.isfinite(uv).all(axis=(1, 2))]  # not at the corners, beside which wrong views lead outside
    for row in uv:
        angle = rng.uniform(0, 2 * np.pi, wrong)
        row[rng.choice(6, wrong, replace=False)] += size * np.column_stack([np.cos(angle), np.sin(angle)])
    exact, found = made.map.locate(uv, noise_of(made, uv)), tables_of(made)._by_kernel(kernel, uv, noise_of(made, uv))
    sure = found.code == MEASURED
    assert sure.mean() > 0.9
    agree(found, exact, sure)
    assert (found.left_out[sure].sum(axis=1) == wrong).mean() > 0.9


def test_points_that_cannot_be_mended_are_left_as_the_exact_path_leaves_them(kernel: Kernel) -> None:
    """Four wrong views of six: nothing is clear, and beyond a p-value there is no position."""
    made, rng = six(), np.random.default_rng(3)
    uv = views_all_over(made, 60)[:60]
    for row, size in zip(uv, np.geomspace(0.5, 10, 60), strict=True):
        row[rng.choice(6, 4, replace=False)] += size * rng.normal(size=(4, 2))
    exact, found = made.map.locate(uv, noise_of(made, uv)), tables_of(made)._by_kernel(kernel, uv, noise_of(made, uv))
    lost = found.code == CONTRADICTION
    assert np.isnan(exact.xyz[lost]).all()
    assert np.isfinite(exact.p[lost]).all()
    agree(found, exact, (found.code == MEASURED) & (exact.p > made.map.settings.min_p_value))
    assert np.isfinite(exact.xyz[found.code == MEASURED]).all()
    assert min(lost.sum(), (found.code == MEASURED).sum()) > 5
    assert (found.code == LEFT_TO_EXACT).mean() < 0.2


@pytest.mark.parametrize("compiled", [True, False])
def test_where_tables_cannot_say_the_exact_path_does(compiled: bool, kernel: Kernel) -> None:
    """Beyond the box, views that contradict each other beyond mending, pixels that no camera has."""
    made = six()
    tables = replace(tables_of(made), compiled=kernel if compiled else None)
    uv = views_all_over(made, 20)[:12]
    middle, side = made.data.xyz.mean(axis=0), np.ptp(made.data.xyz, axis=0)
    uv[:3] = made.predict(middle + 1.2 * side * np.array([[0, 0, 1], [0.2, 0, 1], [0, 0.2, -1]]))
    uv[3] += np.random.default_rng(1).normal(size=(6, 2)) * 100
    uv[4, 0] = -5000.0
    uv[5:], uv[5, 0], uv[6, :2] = np.nan, 300.0, 300.0
    found, exact = tables.locate(uv, noise_of(made, uv)), made.map.locate(uv, noise_of(made, uv))
    np.testing.assert_array_equal(np.isfinite(found.xyz), np.isfinite(exact.xyz))
    np.testing.assert_array_equal(found.xyz[:5], exact.xyz[:5])
    np.testing.assert_array_equal(found.p[:6], exact.p[:6])
    assert np.isnan(found.xyz[7:]).all()


def test_cells_that_are_marked_are_exact(kernel: Kernel) -> None:
    made = six()
    uv = views_all_over(made, 30)[:30]
    table = tables_of(made).table
    marked = np.zeros_like(table.marked)
    marked[: table.cells[0] // 2, :, :, 2] = True
    tables = replace(tables_of(made), table=replace(table, marked=marked))
    exact = made.map.locate(uv, noise_of(made, uv))
    there = (exact.xyz[:, 0] - table.low[0]) / table.step[0]
    for found in (tables._by_kernel(kernel, uv, noise_of(made, uv)), tables._by_arrays(uv, noise_of(made, uv))):
        seen = np.isfinite(uv[:, 2]).all(axis=1)
        assert (found.code[seen & (there < table.cells[0] // 2 - 0.01)] == LEFT_TO_EXACT).all()
        assert (found.code[there > table.cells[0] // 2 + 0.01] != LEFT_TO_EXACT).mean() > 0.9


def test_many_points_are_measured_by_tables_and_few_exactly(monkeypatch: pytest.MonkeyPatch, kernel: Kernel) -> None:
    made = six()
    monkeypatch.setattr(rig_table, "kernel", lambda: kernel)
    monkeypatch.setattr("implicam.calibrators.protocol.POINTS_WORTH_TABLES", 30)
    seen = made.trained
    exact, few, many = made.measure(seen, exact=True), made.measure(seen.select(np.arange(29))), made.measure(seen)
    np.testing.assert_array_equal(few.xyz, exact.xyz[:29])
    assert 0 < off_in_sds(many.xyz, exact.xyz, exact.cov).max() < POSITION_SDS
    assert many.reason.tolist() == exact.reason.tolist()
    assert made.measure_pixels(seen.uv, exact=True).xyz.tolist() == exact.xyz.tolist()
    shared = many.shared.of(np.arange(2))  # type: ignore[union-attr]
    np.testing.assert_allclose(shared, exact.shared.of(np.arange(2)), atol=0.02 * np.abs(shared).max())  # type: ignore[union-attr]


@pytest.mark.parametrize("compiled", [True, False])
def test_live_is_the_same_shot_by_shot(compiled: bool, kernel: Kernel) -> None:
    made = six()
    tables = replace(tables_of(made), compiled=kernel if compiled else None)
    uv = views_all_over(made, 20)
    uv[0], uv[1, 1:], uv[2, 3] = np.nan, np.nan, uv[2, 3] + 50
    uv[3, ::2] += 300
    live, every = Live(made.map, tables, 3), made.map.measure_pixels(uv, None, tables.locate)
    for k in range(6):
        one = live.measure(uv[k])
        np.testing.assert_allclose(one.xyz[0], every.xyz[k], rtol=1e-9)
        np.testing.assert_allclose(one.cov[0], every.cov[k], rtol=1e-6)
        np.testing.assert_allclose(one.consistency[0], every.consistency[k], rtol=1e-6)
        assert one.reason[0] == every.reason[k]
        assert (one.code[0], one.views[0]) == (every.code[k], every.views[k])
    three = live.measure(uv[4:7], 0.5)
    np.testing.assert_allclose(three.sd, made.map.measure_pixels(uv[4:7], 0.5, tables.locate).sd, rtol=1e-6)
    assert np.shares_memory(three.xyz, live.measure(uv[5]).xyz) == compiled
    for wrong in (uv[:4], uv[0, 0], uv[0, :3]):
        with pytest.raises(UsageError):
            live.measure(wrong)


def test_cameras_that_are_tied_with_labels_that_are_off(kernel: Kernel) -> None:
    """Boards that are off as a whole: eq. (22), with what cameras and labels have in common."""
    made = boards()
    assert made.map.labels is not None
    assert made.map.labels.unknowns is not None
    compare(made, kernel, 150, least=0.7)
    uv = views_all_over(made, 5)
    by_tables = made.map.measure_pixels(uv[0:1], None, replace(tables_of(made), compiled=kernel).locate)
    live = Live(made.map, replace(tables_of(made), compiled=kernel)).measure(uv[0])
    np.testing.assert_allclose(live.xyz, by_tables.xyz, rtol=1e-9)
    assert len(made.map.measure_pixels(uv[:0], None, replace(tables_of(made), compiled=kernel).locate)) == 0


def test_without_a_kernel_tied_cameras_are_measured_exactly_and_it_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rig_table, "kernel", lambda: None)
    made = boards()
    assert "not compiled" in made.why_exact
    assert made.tables is None
    uv = made.trained.uv[:4, list(made.map.cameras)]
    np.testing.assert_array_equal(made.measure_pixels(uv).xyz, made.measure_pixels(uv, exact=True).xyz)
    np.testing.assert_allclose(made.live().measure(uv[0]).xyz, made.measure_pixels(uv[:1]).xyz)
    np.testing.assert_array_equal(
        replace(tables_of(made), compiled=None).locate(uv, noise_of(made, uv)).xyz,
        made.map.locate(uv, noise_of(made, uv)).xyz,
    )


@pytest.mark.parametrize("content", [b"", b"not a library"])
def test_a_file_that_is_no_kernel_leaves_it_to_numpy(
    content: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / library.NAME).write_bytes(content)
    monkeypatch.setattr(library, "__file__", str(tmp_path / "library.py"))
    assert library.kernel.__wrapped__() is None
    library.kernel.cache_clear()
    assert "NumPy" in library.how_it_measures()
    library.kernel.cache_clear()


def test_the_version_says_how_it_measures(cli: Cli) -> None:
    told = cli("--version", "-v").out
    assert "by tables: compiled" in told or "by tables: NumPy" in told


@pytest.mark.slow
def test_a_hundred_cameras(kernel: Kernel) -> None:
    rig = build_rig("dome100", seed=1)
    made: RigCalibration = ic.ForwardGP().fit(
        simulate(rig, random_positions(rig, 60, np.random.default_rng(1)), seed=1)
    )
    tables, uv = tables_of(made), views_all_over(made, 200)
    uv[np.random.default_rng(2).random(uv.shape[:2]) < 0.88] = np.nan
    uv[3, np.flatnonzero(np.isfinite(uv[3, :, 0]))[:2]] += 25.0
    exact, found = made.map.locate(uv, noise_of(made, uv)), tables._by_kernel(kernel, uv, noise_of(made, uv))
    sure = found.code == MEASURED
    assert sure.mean() > 0.95
    agree(found, exact, sure)
    assert exact.left_out[3].sum() == 2
