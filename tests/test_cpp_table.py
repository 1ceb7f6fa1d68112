"""implicam.hpp and its table: compiled, and compared with what Python predicts and measures; damaged tables."""

from __future__ import annotations

import re
import shutil
import struct
import subprocess
import zlib
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

import implicam as ic
from command_line import Cli, cli  # noqa: F401
from deployed_rigs import RIGS, boards, covariances, fisheyes
from implicam import calibration_file
from implicam.calibrators import Calibration
from implicam.calibrators.protocol import RigCalibration
from implicam.deploy import cpp_table, write_cpp
from implicam.deploy.cpp_table import EXAMPLE_FILE, HEADER_FILE, TABLE_FILE
from implicam.errors import UsageError
from implicam.simulate import build_rig, random_positions, simulate
from implicam.tabulated.spline_table import MAX_PIXEL_ERROR_SDS, MAX_VARIANCE_ERROR, tabulate

COMPILERS = [name for name in ("g++", "clang++") if shutil.which(name)]
needs_compiler = pytest.mark.skipif(not COMPILERS, reason="there is no C++ compiler (g++ or clang++)")

WARNINGS = (
    "-std=c++17", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wsign-conversion", "-Wshadow", "-Wold-style-cast",
    "-Wfloat-equal", "-Werror", "-pthread",
)  # fmt: skip
SANITIZERS = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
TEMPLATES = Path(cpp_table.__file__).parent / "templates"
OK, DOUBTFUL, NOT_SEEN, TOO_FEW, CONTRADICT, NO_POSITION, OUTSIDE, NOT_TABULATED, OUTSIDE_IMAGE, WRONG_INPUT = range(10)
CANNOT_READ, NOT_A_TABLE, WRONG_VERSION, DAMAGED = range(11, 15)

POSITION_SDS, COVARIANCE_PART = 0.005, 0.01
"""What a position may be off, in its standard deviations, and its covariance."""


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(tmp_path_factory.mktemp("driver") / "driver", COMPILERS[0])


def built(output: Path, compiler: str, *flags: str) -> Path:
    source = str(Path(__file__).parent / "table_driver.cpp")
    ran = subprocess.run(
        [compiler, *WARNINGS, *flags, f"-I{TEMPLATES}", source, "-o", str(output)], capture_output=True, text=True
    )
    assert ran.returncode == 0, ran.stderr
    return output


def ask(driver: Path, table: Path, questions: list[str], threads: int = 0) -> np.ndarray:
    words = [str(driver), str(table), *([str(threads)] if threads else [])]
    ran = subprocess.run(words, input="\n".join(questions), capture_output=True, text=True)
    assert ran.returncode == 0, (ran.returncode, ran.stdout[:200], ran.stderr[:2000])
    return np.array([[float(word) for word in line.split()] for line in ran.stdout.splitlines()])


def status_of(driver: Path, table: Path) -> int:
    ran = subprocess.run([str(driver), str(table)], input="", capture_output=True, text=True)
    assert ran.returncode in (0, 3), (ran.returncode, ran.stderr[:2000])  # no crash
    return int(ran.stdout.split()[0]) if ran.returncode else OK


def words_of(*numbers: float) -> str:
    return " ".join(repr(float(number)) for number in numbers)


@cache
def plain() -> RigCalibration:
    data = simulate(fisheyes(), random_positions(fisheyes(), 60, np.random.default_rng(5)), seed=5)
    made: RigCalibration = ic.Explicit(lens="kannala-brandt").fit(data)
    return made


def places(made: RigCalibration) -> np.ndarray:
    """All over the box of a table, its corners too."""
    low, high = made.data.xyz.min(axis=0), made.data.xyz.max(axis=0)
    margin = 0.099 * (high - low)
    corners = np.stack(np.meshgrid(*zip(low - margin, high + margin, strict=True)), axis=-1).reshape(-1, 3)
    drawn = np.random.default_rng(3).uniform(low - margin, high + margin, (300, 3))
    return np.concatenate([drawn, corners, made.data.xyz[:20]])


def views_of(made: RigCalibration, xyz: np.ndarray) -> ic.Observations:
    """What the cameras see of positions, with their noise; some views are missing, some state a noise of their own."""
    rng, uv = np.random.default_rng(4), made.predict(xyz)
    sd = np.full(uv.shape, np.nan)
    for model, c in zip(made.map.posterior.models, made.map.cameras, strict=True):
        camera = made.trained.cameras[c]
        last = np.array([camera.width or np.inf, camera.height or np.inf]) - 1
        uv[:, c] += model.noise * rng.normal(size=(len(xyz), 2))
        uv[((uv[:, c] < 0) | (uv[:, c] > last)).any(axis=1), c] = np.nan
    uv[rng.random(uv.shape[:2]) < 0.1] = np.nan
    uv[:, [c for c in range(uv.shape[1]) if c not in made.map.cameras]] = np.nan
    sd[::3] = 0.15
    return ic.Observations([f"p{i}" for i in range(len(xyz))], made.trained.cameras, uv, sd)


def compare(made: RigCalibration, driver: Path, folder: Path, threads: int = 0) -> np.ndarray:
    """The states of triangulation, after all numbers were compared."""
    write_cpp(made, folder)
    xyz, C = places(made), len(made.camera_names)
    found = ask(driver, folder / TABLE_FILE, [f"p {c} {words_of(*x)}" for c in range(C) for x in xyz], threads)
    found, uv = found.reshape(C, len(xyz), -1), made.predict(xyz)
    for number, covariance in enumerate(covariances(made, xyz)):
        ok = found[number, :, 0] == OK
        assert ok.mean() > 0.8
        sd = np.sqrt(np.einsum("nii->ni", covariance))
        off = (found[number, :, 1:3] - uv[:, made.map.cameras[number]]) / sd
        assert np.abs(off[ok]).max() < MAX_PIXEL_ERROR_SDS
        variance = (found[number, :, 3:].reshape(-1, 2, 2) - covariance) / (sd[:, :, None] * sd[:, None, :])
        assert np.abs(variance[ok]).max() < MAX_VARIANCE_ERROR * 1.2  # on other places than it was checked at

    seen = views_of(made, xyz)
    measured = made.measure(seen)
    numbers = np.concatenate([seen.uv, seen.sd[..., :1]], axis=2)[:, list(made.map.cameras)]
    answers = ask(driver, folder / TABLE_FILE, [f"t {words_of(*row.ravel())}" for row in numbers], threads)
    state = answers[:, 0].astype(int)
    measured_there = np.isin(state, (OK, DOUBTFUL))
    good = measured.measured & (measured.reason == "")
    inside = good & np.isfinite(made.predict(measured.xyz)).all(axis=2)[:, list(made.map.cameras)].all(axis=1)
    assert (measured_there[inside]).mean() > 0.95
    both = good & measured_there
    off = answers[both, 1:4] - measured.xyz[both]
    distance = np.sqrt(np.einsum("ni,nij,nj->n", off, np.linalg.inv(measured.cov[both]), off))
    assert distance.max() < POSITION_SDS
    size = measured.sd[both][:, :, None] * measured.sd[both][:, None, :]
    covariance = answers[both, 4:13].reshape(-1, 3, 3)
    np.testing.assert_allclose(covariance / size, measured.cov[both] / size, rtol=0, atol=COVARIANCE_PART)
    np.testing.assert_allclose(answers[both, 14], measured.consistency[both], rtol=0, atol=0.005)
    np.testing.assert_array_equal(answers[both, 15], measured.views[both])
    return state


@pytest.mark.slow
@needs_compiler
def test_it_projects_and_measures_as_python_does(driver: Path, tmp_path: Path) -> None:
    state = compare(plain(), driver, tmp_path / "table", threads=3)
    assert {OK, TOO_FEW} <= set(state.tolist()) <= {OK, DOUBTFUL, NOT_SEEN, TOO_FEW, OUTSIDE}


@needs_compiler
@pytest.mark.slow
def test_it_leaves_out_the_wrong_views_that_python_leaves_out(driver: Path, tmp_path: Path) -> None:
    rig = build_rig("bar6", seed=4)
    made = ic.Explicit(lens="kannala-brandt").fit(
        simulate(rig, random_positions(rig, 40, np.random.default_rng(5)), seed=5)
    )
    write_cpp(made, tmp_path / "table")
    rng, low, high = np.random.default_rng(8), made.data.xyz.min(axis=0), made.data.xyz.max(axis=0)
    seen = views_of(made, rng.uniform(low, high, (100, 3)))
    uv, wrong = seen.uv.copy(), rng.integers(0, 6, 100)
    uv[np.arange(100), wrong] += rng.choice([-1.0, 1.0], (100, 2)) * rng.choice([5.0, 30.0], (100, 1))
    uv[:30, 0] += 20.0  # another one
    size = np.array([[camera.width, camera.height] for camera in made.trained.cameras])
    uv[((uv < 0) | (uv > size - 1)).any(axis=2)] = np.nan
    measured = made.measure(ic.Observations(seen.points, seen.cameras, uv, np.full(uv.shape, np.nan)))
    told = [
        re.findall(r"cam(\d)", reason) if "measured without" in reason else [] for reason in measured.reason.tolist()
    ]
    questions = [f"t {words_of(*[w for view in row for w in (*view, np.nan)])}" for row in uv]
    answers = ask(driver, tmp_path / "table" / TABLE_FILE, questions)
    left_out = [sorted(str(int(c) + 1) for c in row[16:] if c >= 0) for row in answers]
    assert np.mean([a == b for a, b in zip(left_out, told, strict=True)]) >= 0.98
    assert sum(len(cameras) == 1 for cameras in told) > 40
    assert sum(len(cameras) == 2 for cameras in told) > 5
    both = np.array([bool(a) and a == b for a, b in zip(left_out, told, strict=True)])
    off = answers[both, 1:4] - measured.xyz[both]
    distance = np.sqrt(np.einsum("ni,nij,nj->n", off, np.linalg.inv(measured.cov[both]), off))
    assert distance.max() < POSITION_SDS


@pytest.fixture(scope="module")
def sanitized(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(tmp_path_factory.mktemp("sanitized") / "driver", COMPILERS[0], "-O1", *SANITIZERS)


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("kind", [*sorted(RIGS.keys() - {"declared errors"}), "boards"])  # as dots, and slower
def test_so_it_does_for_rigs_of_all_kinds(kind: str, sanitized: Path, tmp_path: Path) -> None:
    compare(RIGS[kind]() if kind in RIGS else boards(), sanitized, tmp_path / "table")


@pytest.mark.slow
@pytest.mark.skipif("clang++" not in COMPILERS, reason="clang++ is not installed")
def test_another_compiler(tmp_path: Path) -> None:
    compare(plain(), built(tmp_path / "driver", "clang++", "-O2"), tmp_path / "table")


@needs_compiler
def test_what_cannot_be_answered_has_a_status(driver: Path, tmp_path: Path) -> None:
    write_cpp(plain(), tmp_path / "table")
    table, x = tmp_path / "table" / TABLE_FILE, plain().data.xyz[:1]
    (a, b), nan = plain().predict(x)[0], [np.nan] * 3
    far = x[0] + 10 * np.ptp(plain().data.xyz, axis=0)
    other = b + np.array([0.0, 6.0])  # across the line on which the other camera would have it
    far_views = plain().predict(far[None])[0]
    questions = {
        f"p 0 {words_of(*x[0])}": OK,
        f"p 0 {words_of(*far)}": OUTSIDE,
        f"p 2 {words_of(*x[0])}": WRONG_INPUT,
        f"p -1 {words_of(*x[0])}": WRONG_INPUT,
        f"p 0 {words_of(np.nan, 0, np.inf)}": WRONG_INPUT,
        f"t {words_of(*a, np.nan, *b, np.nan)}": OK,
        f"t {words_of(*a, 0.5, *b, -1)}": OK,
        f"t {words_of(*nan, *nan)}": NOT_SEEN,
        f"t {words_of(*a, np.nan, *nan)}": TOO_FEW,
        f"t {words_of(np.inf, 3, np.nan, *b, np.nan)}": TOO_FEW,
        f"t {words_of(*far_views[0], np.nan, *far_views[1], np.nan)}": OUTSIDE,
        f"t {words_of(*a, np.nan, *other, np.nan)}": CONTRADICT,
    }
    for question, expected in questions.items():
        status, *numbers = ask(driver, table, [question])[0]
        assert status == expected, question
        there = 6 if question[0] == "p" else 12  # position or pixel, and covariance
        assert np.isfinite(numbers[:there]).all() if expected == OK else np.isnan(numbers[:there]).all(), question


def mutations(good: bytes) -> dict[str, tuple[bytes, int]]:
    """Damaged tables, and the status that each must have."""

    def resealed(changed: bytes) -> bytes:
        """With size and checksum as they should be: for whom the checksum is no obstacle."""
        head = changed[:16] + struct.pack("<QQ", len(changed), zlib.crc32(changed[32:]))
        return head + changed[32:]

    def with_bytes(at: int, new: bytes) -> bytes:
        return good[:at] + new + good[at + len(new) :]

    found = {
        "empty": (b"", NOT_A_TABLE),
        "another file": (b"PK\3\4" + good[4:], NOT_A_TABLE),
        "a few bytes": (good[:9], DAMAGED),
        "newer": (with_bytes(8, struct.pack("<I", 2)), WRONG_VERSION),
        "longer": (good + b"\0", DAMAGED),
        "many sections": (resealed(with_bytes(12, struct.pack("<I", 4_000_000_000))), DAMAGED),
        "no sections": (resealed(with_bytes(12, struct.pack("<I", 0))), DAMAGED),
    }
    for part in (0.1, 0.5, 0.999):
        cut = good[: int(part * len(good))]
        found[f"cut to {part}"] = cut, DAMAGED
        found[f"cut to {part}, checksum mended"] = resealed(cut), DAMAGED
    rng = np.random.default_rng(0)
    for at in rng.integers(32, len(good), 20):
        found[f"bit {at}"] = with_bytes(int(at), bytes([good[at] ^ 1 << int(rng.integers(8))])), DAMAGED
    return found | {
        f"directory {at} {value}": (resealed(with_bytes(at, struct.pack("<Q", value))), -1)
        for at in range(64, 64 + 88 * 4, 8)
        for value in (0, 1, 7, 1 << 32, (1 << 64) - 1)
    }


def check_mutations(driver: Path, good: bytes, folder: Path) -> None:
    for name, (content, status) in mutations(good).items():
        (folder / "x.table").write_bytes(content)
        found = status_of(driver, folder / "x.table")
        assert found == status if status >= 0 else found in (OK, DAMAGED), name
    assert status_of(driver, folder / "none.table") == CANNOT_READ
    assert status_of(driver, folder) in (CANNOT_READ, NOT_A_TABLE)


@needs_compiler
def test_damaged_tables_are_refused(driver: Path, tmp_path: Path) -> None:
    write_cpp(plain(), tmp_path / "table")
    check_mutations(driver, (tmp_path / "table" / TABLE_FILE).read_bytes(), tmp_path)


@needs_compiler
@pytest.mark.slow
def test_nothing_that_a_table_says_makes_it_crash(sanitized: Path, tmp_path: Path) -> None:
    """Numbers of a table changed, its checksum mended: an answer or a status, and nothing for the sanitizers to say."""
    made = boards()
    write_cpp(made, tmp_path / "table")
    good = (tmp_path / "table" / TABLE_FILE).read_bytes()
    check_mutations(sanitized, good, tmp_path)
    questions = [f"p 0 {words_of(*x)}" for x in made.data.xyz[:3]]
    questions += [
        f"t {words_of(*[w for view in row for w in (*view, np.nan)])}" for row in made.predict(made.data.xyz[:3])
    ]
    rng = np.random.default_rng(1)
    grid = good.index(b"grid\0") if b"grid\0" in good else len(good)
    for _ in range(150):
        at = int(rng.integers(64, grid + 88 if rng.random() < 0.3 else 20_000)) // 8 * 8
        value = rng.choice([0.0, -1.0, 1e308, np.nan, np.inf, 1e-308, float(rng.normal())])
        changed = good[:at] + struct.pack("<d", value) + good[at + 8 :]
        changed = changed[:16] + struct.pack("<QQ", len(changed), zlib.crc32(changed[32:])) + changed[32:]
        (tmp_path / "x.table").write_bytes(changed)
        if status_of(sanitized, tmp_path / "x.table") == OK:
            for some in (questions[:3], questions[3:]):
                ask(sanitized, tmp_path / "x.table", some)


@needs_compiler
@pytest.mark.slow
def test_the_example_runs(cli: Cli) -> None:
    plain().save("rig.implicam")
    ran = cli("export", "rig.implicam", "--to", "cpp", "-o", "for-cpp", "--json")
    assert ran.json["format"] == "cpp"
    assert sorted(path.name for path in Path("for-cpp").iterdir()) == sorted([EXAMPLE_FILE, HEADER_FILE, TABLE_FILE])
    first = Path("for-cpp", TABLE_FILE).read_bytes()
    assert cli("export", "rig.implicam", "--to", "cpp", "-o", "for-cpp").out.startswith(
        "for-cpp: implicam.hpp, rig.table"
    )
    assert Path("for-cpp", TABLE_FILE).read_bytes() == first
    command = re.search(r"//   (g\+\+ .*) && (.*)", Path("for-cpp", EXAMPLE_FILE).read_text())
    assert command is not None
    words = [COMPILERS[0], *command[1].split()[1:]]
    subprocess.run(words, cwd="for-cpp", check=True)
    told = subprocess.run(command[2].split(), cwd="for-cpp", check=True, capture_output=True, text=True).stdout
    cpp_table.refuse_other_files(
        Path("for-cpp"), cpp_table._OURS.__contains__, "it"
    )  # compiled, it can be exported anew
    assert f"2 cameras, calibration {calibration_file.checksum('rig.implicam')[:16]}" in told
    middle = 0.5 * (plain().data.xyz.min(axis=0) + plain().data.xyz.max(axis=0))
    for axis, value in zip("xyz", middle, strict=True):
        found = re.search(rf"{axis} = (\S+) \+- (\S+) mm", told)
        assert found is not None
        assert float(found[1]) == pytest.approx(value, abs=0.01 * float(found[2]) + 1e-4)


@pytest.mark.slow
def test_where_the_table_is_not_exact_enough_it_says_so(tmp_path: Path) -> None:
    rig = plain().map
    points = rig.frame.to_working(plain().data.xyz)
    low, high = points.min(axis=0), points.max(axis=0)
    middle = 0.5 * (low + high)
    table = tabulate(rig, middle + 5 * (low - middle), middle + 5 * (high - middle))  # far beyond the images
    assert table.marked.any()
    assert table.pixel_error <= MAX_PIXEL_ERROR_SDS
    assert table.variance_error <= MAX_VARIANCE_ERROR


def test_what_cannot_be_tabulated_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="inverse-gp has no cameras"):
        write_cpp(cast(Calibration, SimpleNamespace(method="inverse-gp")), tmp_path / "table")
    heavy = replace(plain().map, degrees=4.0)
    with pytest.raises(UsageError, match=r"heavy tails \(Student's t, 4 degrees"):
        cpp_table.checked_rig(heavy, 60)
    with pytest.raises(UsageError, match="no known points"):
        cpp_table.checked_rig(plain().map, 0)
    assert not (tmp_path / "table").exists()
