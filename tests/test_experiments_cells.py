"""Sweeps: nothing is lost or computed twice, one bad cell is one failure, and the bits are the same anywhere."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from dask_cluster import cluster  # noqa: F401  a fixture
from implicam import threads, workers
from implicam.calibration_file import package_version
from implicam.calibrators import InverseGP
from implicam.errors import ImplicamError, MissingExtraError, UsageError
from implicam.experiments import Cell, run
from implicam.experiments.stored import canonical, decode, encode, failure_file, result_file
from implicam.files import npz_bytes, read_npz
from implicam.simulate import simulated

# --- what the cells below compute, each in another process ---


def log(journal: str, name: str) -> None:
    with Path(journal).open("a") as file:
        file.write(f"{name}\n")


def times(journal: Path) -> Counter[str]:
    return Counter(journal.read_text().split()) if journal.exists() else Counter()


def square(x: float, journal: str, seconds: float = 0.0) -> dict[str, Any]:
    log(journal, str(x))
    time.sleep(seconds)
    return {"squared": x * x}


def algebra(seed: int) -> dict[str, Any]:
    """What another number of BLAS threads, or another order of sums, would change in the last bits."""
    a = np.random.default_rng(seed).normal(size=(300, 300))
    rig = simulated("stereo", points=60, seed=seed)
    measured = InverseGP(seed=seed).fit(rig).measure(rig.observations)
    return {
        "solved": np.linalg.solve(a @ a.T + np.eye(300), a),
        "xyz": measured.xyz,
        "cov": measured.cov,
        "rmse": float(np.sqrt(np.mean((measured.xyz - rig.xyz) ** 2))),
    }


def surroundings() -> dict[str, Any]:
    counts = [pool["num_threads"] for pool in threadpool_info()]
    inside = threads.side_by_side(lambda _: threads.cores(), range(3))
    return {"threads": counts, "cores": max(threads.cores(), *inside), "pid": os.getpid()}


def unlucky(kind: str) -> dict[str, Any]:
    if kind == "error":
        raise ValueError("no such\nlens")
    if kind == "ours":
        raise UsageError("no such lens.", why="none of that name", fix="choose another")
    if kind == "exit":
        sys.exit(3)
    if kind == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    return {"odd": object()}


NOT_A_FUNCTION = 3


def squares(count: int, journal: Path, **more: Any) -> list[Cell]:
    return [Cell(square, f"squares/{i}", {"x": float(i), "journal": str(journal), **more}) for i in range(count)]


def keep(folder: Path, cell: Cell, values: dict[str, Any]) -> Path:
    """A result as an earlier run would have left it."""
    path = result_file(folder, cell.name)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode(str(cell.work), canonical(cell.options), 1.5, values))
    return path


# --- cells ---


@pytest.mark.parametrize(
    "name", ["", "/a", "a/", "a//b", "..", "a/../b", ".a", "a/.b", "a b", "a\\b", "ä", "a.npz", "-a", "a.", "x" * 300]
)
def test_a_name_that_is_no_path_everywhere_is_refused(name: str) -> None:
    with pytest.raises(UsageError, match="cannot be the name"):
        Cell(algebra, name, {})


@pytest.mark.parametrize("options", [{"x": np.int64(3)}, {"x": {1, 2}}, {"x": np.zeros(2)}, {("a", 1): 2}])
def test_options_that_are_no_json_are_refused(options: Any) -> None:
    with pytest.raises(UsageError, match="no plain JSON"):
        Cell(algebra, "a", options)


def test_work_that_another_process_could_not_find_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def inner() -> dict[str, Any]:
        return {}

    for work in (lambda: {}, inner, "math", "math:nothing", "nowhere:f", "", f"{__name__}:NOT_A_FUNCTION"):
        with pytest.raises(UsageError, match="cannot be the work"):
            Cell(work, "a", {})
    monkeypatch.setattr(algebra, "__module__", "__main__")
    with pytest.raises(UsageError, match="main script"):
        Cell(algebra, "a", {})


def test_a_cell_is_its_name_its_options_and_where_its_work_is_found() -> None:
    given = {"b": (1, 2), "a": 0.1}
    cell = Cell(algebra, "ball/2R/inverse-gp/157", given)
    given["a"] = 7
    assert cell == Cell(f"{__name__}:algebra", "ball/2R/inverse-gp/157", {"a": 0.1, "b": [1, 2]})
    assert cell.task.arguments["options"] == '{"a": 0.1, "b": [1, 2]}'


def test_names_that_share_a_file_and_odd_numbers_of_processes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="upper and lower case"):
        run([Cell(algebra, "a/2R"), Cell(algebra, "a/2r")], tmp_path)
    with pytest.raises(UsageError, match="0 processes"):
        run([], tmp_path, jobs=0)
    with pytest.raises(UsageError, match="not both"):
        run([], tmp_path, jobs=2, scheduler="tcp://127.0.0.1:1")


# --- result files ---


def test_every_float_comes_back_to_the_bit() -> None:
    bits = np.random.default_rng(0).integers(0, 2**64, size=20_000, dtype=np.uint64)
    floats = np.concatenate([bits.view(np.float64), [0.0, -0.0, 5e-324, np.inf, -np.inf, np.nan, 1 / 3]])
    floats[np.isnan(floats)] = np.nan  # a NaN is a NaN: JSON does not keep its payload
    back = decode(encode("w", "{}", 0.1, {"array": floats, "list": floats.tolist()})).values
    assert back["array"].tobytes() == floats.tobytes()
    assert np.array(back["list"]).tobytes() == floats.tobytes()


def test_what_a_result_may_hold_comes_back_in_order() -> None:
    values = {
        "z": np.arange(6, dtype=np.int32).reshape(2, 3, order="F"),
        "text": "Å \ud800 \0",
        "none": None,
        "a": np.zeros((0, 3)),
        "nested": {"list": [1, 2.5, "three", [True, None]]},
        "one": np.array(7.25),
        "names": np.array(["cam1", "kamera 2"]),
        "flags": np.array([True, False]),
        "numpy": np.float32(0.1),
        "count": [np.int64(3)],
        "json": 1,
        "0": np.ones(2),
    }
    back = decode(encode("m:f", '{"a": 1}', 2.5, values))
    assert (back.work, back.options, back.seconds, back.version) == ("m:f", '{"a": 1}', 2.5, package_version())
    assert list(back.values) == list(values)
    for key, value in values.items():
        if isinstance(value, np.ndarray):
            assert back.values[key].dtype == value.dtype
            np.testing.assert_array_equal(back.values[key], value)
    assert back.values["numpy"] == float(np.float32(0.1))
    assert back.values["nested"] == values["nested"]
    assert back.values["text"] == values["text"]
    assert back.values["count"] == [3]


@pytest.mark.parametrize(
    "values", [[1], None, {1: 2}, {"a": np.ones(2) * 1j}, {"a": np.array([None])}, {"a": [np.ones(2)]}, {"a": {1, 2}}]
)
def test_what_cannot_be_kept_is_an_error(values: Any) -> None:
    with pytest.raises(TypeError):
        encode("m:f", "{}", 0.0, values)


def test_a_damaged_file_is_refused_or_says_what_it_said(tmp_path: Path) -> None:
    content = encode("m:f", "{}", 1.0, {"x": np.arange(3.0), "y": [0.1]})
    rng = np.random.default_rng(1)
    refused = 0
    for k in range(1500):
        damaged = bytearray(content)
        damaged[rng.integers(len(content))] ^= 1 << rng.integers(8)
        try:
            back = decode(bytes(damaged) if k % 3 else bytes(damaged[: rng.integers(len(content))]))
        except ImplicamError:
            refused += 1
            continue
        assert back.values["x"].tolist() == [0, 1, 2]
        assert back.values["y"] == [0.1]
    assert refused > 1000


@pytest.mark.parametrize("text", ["", "[]", "3", "{}", '{"keys": 3}', "[" * 100_000, '{"arrays": ["a"]}', "\xff"])
def test_a_strange_head_is_refused(text: str) -> None:
    content = npz_bytes({"json": np.frombuffer(text.encode("latin-1"), np.uint8)})
    with pytest.raises(ImplicamError, match="damaged"):
        decode(content)


# --- runs without a process: all results are there ---


def test_results_that_are_there_are_not_computed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "joblib.externals.loky", None)  # nothing is to be computed, so nobody needs it
    cells = [Cell(algebra, f"a/{i}", {"seed": i}) for i in range(3)]
    for i, cell in enumerate(cells):
        keep(tmp_path, cell, {"i": i})
    calls: list[tuple[str, int, int]] = []
    results = run(cells, tmp_path, progress=lambda *step: calls.append(step))
    assert [value["i"] for value in results.values.values()] == [0, 1, 2]
    assert results.already == 3
    assert results.seconds == {"a/0": 1.5, "a/1": 1.5, "a/2": 1.5}
    assert not results.notes
    assert not results.failures
    assert calls == [("computing a", 3, 3)]
    assert run([], tmp_path).values == {}


def test_the_library_that_is_missing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module, extra, options in (
        ("joblib.externals.loky", "paper", {}),
        ("distributed", "cluster", {"scheduler": "tcp://127.0.0.1:1"}),
    ):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(MissingExtraError, match=rf"implicam\[{extra}\]"):
            run([Cell(algebra, "a", {"seed": 1})], tmp_path, **options)


def test_a_result_of_another_version_counts_and_is_noted(tmp_path: Path) -> None:
    cell = Cell(algebra, "a", {"seed": 1})
    path = keep(tmp_path, cell, {"x": 1})
    arrays = read_npz(path, ImplicamError)
    head = json.loads(arrays["json"].tobytes()) | {"implicam": "0.0.7"}
    path.write_bytes(npz_bytes({"json": np.frombuffer(json.dumps(head).encode(), np.uint8)}))
    results = run([cell], tmp_path)
    assert results.values == {"a": {"x": 1}}
    assert results.notes == (f"1 results were computed by implicam 0.0.7; this is {package_version()}",)


# --- processes on this machine ---


@pytest.mark.slow
def test_what_does_not_count_is_computed_again_and_noted(tmp_path: Path) -> None:
    journal, folder = tmp_path / "journal", tmp_path / "out"
    cells = squares(4, journal)
    keep(folder, cells[0], {"squared": -1.0})  # of these options: it counts, whatever it says
    keep(folder, Cell(square, cells[1].name, {**cells[1].options, "x": 9.0}), {"squared": 81.0})
    keep(folder, Cell(surroundings, cells[2].name, cells[2].options), {"squared": -2.0})
    damaged = keep(folder, cells[3], {"squared": -3.0})
    damaged.write_bytes(damaged.read_bytes()[:-30])
    calls: list[tuple[int, int]] = []
    results = run(cells, folder, jobs=1, progress=lambda _, *step: calls.append(step))
    assert [value["squared"] for value in results.values.values()] == [-1.0, 1.0, 4.0, 9.0]
    assert times(journal) == {"1.0": 1, "2.0": 1, "3.0": 1}
    assert results.already == 1
    assert calls == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert len(results.notes) == 2
    assert any("squares/3.npz is damaged" in note for note in results.notes)
    assert any("2 results" in note and "other options" in note for note in results.notes)


@pytest.mark.slow
def test_bad_cells_are_reported_and_the_others_go_on(tmp_path: Path) -> None:
    journal, folder = tmp_path / "journal", tmp_path / "out"
    kinds = ("error", "ours", "exit", "kill", "odd")
    bad = [Cell(unlucky, f"bad/{kind}", {"kind": kind}) for kind in kinds]
    good = squares(8, journal, seconds=0.05)
    results = run([*good[:4], *bad, *good[4:]], folder, jobs=2)
    assert [value["squared"] for value in results.values.values()] == [i * i for i in range(8)]
    assert list(results.failures) == [cell.name for cell in bad]
    for cell in bad:
        text = failure_file(folder, cell.name).read_text()
        assert text.startswith(results.failures[cell.name])
        assert results.failures[cell.name].count("\n") == 2
        assert not result_file(folder, cell.name).exists()
    assert "bad/error: ValueError: no such lens" in results.failures["bad/error"]
    assert "in unlucky, " in results.failures["bad/error"]
    assert 'raise ValueError("no such' in failure_file(folder, "bad/error").read_text()
    assert results.failures["bad/ours"] == "bad/ours: no such lens.\n  why: none of that name\n  fix: choose another"
    assert "SystemExit: 3" in results.failures["bad/exit"]
    assert "died" in results.failures["bad/kill"]
    assert "'odd'" in results.failures["bad/odd"] or "object" in results.failures["bad/odd"]
    before = times(journal)
    mended = Cell(square, "bad/error", {"x": 5.0, "journal": str(journal)})
    again = run([*good, mended], folder, jobs=2)
    assert again.values["bad/error"] == {"squared": 25.0}
    assert again.already == 8
    assert not failure_file(folder, "bad/error").exists()
    assert times(journal) - before == {"5.0": 1}


@pytest.mark.slow
def test_an_interrupted_sweep_goes_on_where_it_stopped(tmp_path: Path) -> None:
    journal, folder = tmp_path / "journal", tmp_path / "out"
    cells = squares(9, journal, seconds=0.1)

    def interrupt(what: str, done: int, total: int) -> None:
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(cells, folder, jobs=2, progress=interrupt)
    done = [cell for cell in cells if result_file(folder, cell.name).exists()]
    assert len(done) == 4
    results = run(cells, folder, jobs=2)
    assert results.already == 4
    assert [value["squared"] for value in results.values.values()] == [i * i for i in range(9)]
    assert all(times(journal)[str(cell.options["x"])] == 1 for cell in done)
    assert [path.name for path in folder.rglob("*") if "partial" in path.name] == []


@pytest.mark.slow
def test_two_runs_on_one_folder_do_no_harm(tmp_path: Path) -> None:
    journal, folder = tmp_path / "journal", tmp_path / "out"
    cells = squares(10, journal, seconds=0.1)
    script = (
        f"import sys; sys.path[:0] = [{str(Path(__file__).parent)!r}]; from pathlib import Path\n"
        f"import {__name__} as t; from implicam.experiments import run\n"
        f"r = run(t.squares(10, Path({str(journal)!r}), seconds=0.1), {str(folder)!r}, jobs=1)\n"
        "print(len(r.values), len(r.failures))"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as other:
        results = run(cells, folder, jobs=1)
        told, _ = other.communicate(timeout=180)
    assert told.split() == ["10", "0"]
    assert [value["squared"] for value in results.values.values()] == [i * i for i in range(10)]
    assert max(times(journal).values()) <= 2
    assert run(cells, folder).already == 10


def test_a_folder_that_cannot_be_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("a file")
    with pytest.raises(ImplicamError, match="cannot create the folder"):
        run(squares(2, tmp_path / "journal"), tmp_path / "out", jobs=1)
    assert not times(tmp_path / "journal")  # found out before the work, not after it


# --- a cluster ---


def bits(values: dict[str, Any]) -> dict[str, bytes]:
    return {key: np.asarray(value).tobytes() for key, value in values.items()}


@pytest.mark.slow
def test_the_bits_do_not_depend_on_who_computes(tmp_path: Path, cluster: Any) -> None:
    cells = [Cell(algebra, f"a/{seed}", {"seed": seed}) for seed in range(3)]
    around = [Cell(surroundings, f"around/{i}") for i in range(4)]
    one = run([*cells, *around], tmp_path / "one", jobs=1)
    two = run([*cells, *around], tmp_path / "two", jobs=2)
    far = run([*cells, *around], tmp_path / "far", scheduler=cluster.scheduler_address)
    for results in (one, two, far):
        assert not results.failures
        for cell in cells:
            assert bits(results.values[cell.name]) == bits(one.values[cell.name])
        for cell in around:
            assert set(results.values[cell.name]["threads"]) == {1}
            assert results.values[cell.name]["cores"] == 1
            assert results.values[cell.name]["pid"] != os.getpid()
    assert threads.cores() >= 1


@pytest.mark.slow
def test_a_worker_that_is_killed_midway_changes_nothing(tmp_path: Path, cluster: Any) -> None:
    journal, folder = tmp_path / "journal", tmp_path / "out"
    cells = squares(12, journal, seconds=0.2)
    victims = {worker.pid for worker in cluster.workers.values()}

    def kill(what: str, done: int, total: int) -> None:
        if done == 3:
            os.kill(min(victims), signal.SIGKILL)

    results = run(cells, folder, scheduler=cluster.scheduler_address, progress=kill)
    assert [value["squared"] for value in results.values.values()] == [i * i for i in range(12)]
    assert not results.failures
    assert min(victims) not in {worker.pid for worker in cluster.workers.values()}  # it was one of them that died
    assert run(cells, folder).already == 12


@pytest.mark.slow
def test_a_cell_that_kills_its_workers_fails_alone(
    tmp_path: Path, cluster: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Dask gives up at the first death what waits on the same worker: cells that had no part in it are tried again
    monkeypatch.setattr(cluster.scheduler, "allowed_failures", 0)
    good = squares(6, tmp_path / "journal", seconds=0.05)
    bad = [Cell(unlucky, f"bad/{kind}", {"kind": kind}) for kind in ("kill", "error")]
    results = run([*bad, *good], tmp_path / "out", scheduler=cluster.scheduler_address)
    assert [value["squared"] for value in results.values.values()] == [i * i for i in range(6)]
    assert list(results.failures) == ["bad/kill", "bad/error"]
    assert "died, again and again" in results.failures["bad/kill"]


@pytest.mark.slow
def test_a_cluster_without_workers_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(workers, "POLL_SECONDS", 0.1)
    monkeypatch.setattr(workers, "NO_WORKER_SECONDS", 0.5)
    with (
        distributed.LocalCluster(n_workers=0, protocol="tcp", dashboard_address=":0", silence_logs=60) as empty,
        pytest.raises(ImplicamError, match="has had no worker") as caught,
    ):
        run(squares(2, tmp_path / "journal"), tmp_path / "out", scheduler=empty.scheduler_address)
    assert "dask worker" in caught.value.fix


@pytest.mark.slow
def test_an_address_without_a_scheduler_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(workers, "CONNECT_SECONDS", 1)
    with pytest.raises(ImplicamError, match="no Dask scheduler at"):
        run(squares(1, tmp_path / "journal"), tmp_path / "out", scheduler="tcp://127.0.0.1:1")
    for address in ("nonsense", "", "tcp://", "tcp://host", "tcp://host:port"):
        with pytest.raises(UsageError, match="not the address"):
            run(squares(1, tmp_path / "journal"), tmp_path / "out", scheduler=address)


def test_canonical_options_do_not_depend_on_their_order() -> None:
    assert canonical({"b": 1, "a": [1.0]}) == canonical({"a": [1.0], "b": 1})
    assert canonical({"a": 1.0}) != canonical({"a": 1.0 + 2**-52})
