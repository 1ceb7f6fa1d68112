"""Folders of tables: whoever reads, measures and writes the parts, they are those of one machine, and none is lost."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from command_line import Cli, cli  # noqa: F401  a fixture
from dask_cluster import cluster  # noqa: F401  a fixture
from implicam import bulk_folder
from implicam.bulk import BulkResult
from implicam.bulk_folder import measure_folder
from implicam.errors import DatasetError, ImplicamError, UsageError
from killed import processes, started
from test_bulk import NAMES, ROWS, made, pixels, read, table


def tables(folder: Path) -> Path:
    """Three tables of the same pixels, one of them without names."""
    folder.mkdir()
    table(folder / "run1.csv")
    table(folder / "run2.parquet")
    np.savez(folder / "run10.npz", uv=pixels())
    (folder / "_SUCCESS").touch()
    return folder


def contents(folder: Path) -> dict[str, Any]:
    """The members of .npz have the time at which they were written."""
    files = sorted(folder.iterdir())
    return {
        path.name: repr({k: v.tolist() for k, v in read(path).items()}) if path.suffix == ".npz" else path.read_bytes()
        for path in files
    }


def test_a_folder_is_measured_as_each_of_its_tables(tmp_path: Path) -> None:
    source, told = tables(tmp_path / "runs"), list[tuple[int, int]]()
    done = measure_folder(
        made(), source, tmp_path / "out", points_at_once=20, progress=lambda _, n, total: told.append((n, total))
    )
    whole = made().measure_pixels(pixels())
    assert done == BulkResult(3 * ROWS, 3 * int(whole.measured.sum()), 0, ())
    assert told[0] == (0, 3 * ROWS)
    assert told[-1] == (3 * ROWS, 3 * ROWS)
    assert sorted(told) == told
    for stem, ending in (("run1", ".csv"), ("run2", ".parquet"), ("run10", ".npz")):
        parts = [read(tmp_path / "out" / f"{stem}-{i:06d}{ending}") for i in range(5)]
        found = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        np.testing.assert_allclose(found["xyz"], whole.xyz, rtol=1e-9)
        np.testing.assert_allclose(found["sd_x"], whole.sd[:, 0], rtol=1e-6)
        names = NAMES if stem != "run10" else [f"run10/p{i + 1:07d}" for i in range(ROWS)]
        assert found["point"].tolist()[:-1] == names[:-1]
    assert len(list((tmp_path / "out").iterdir())) == 15
    assert not (tmp_path / "out.parts").exists()


@pytest.mark.parametrize("after", [0, 1, 7, 14, 15])
def test_ended_anywhere_a_folder_goes_on(after: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, write, written = tables(tmp_path / "runs"), bulk_folder._measure, list[str]()

    def dies(*arguments: Any) -> Any:
        if len(written) == after:
            raise KeyboardInterrupt
        written.append(arguments[-1])
        return write(*arguments)

    monkeypatch.setattr(bulk_folder, "_measure", dies)
    if after == 15:  # between the name of the folder and the end
        monkeypatch.setattr(bulk_folder, "_tidy", lambda _: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        measure_folder(made(), source, tmp_path / "out", points_at_once=20)
    assert (tmp_path / "out").exists() == (after == 15)
    monkeypatch.undo()
    again = list[str]()
    monkeypatch.setattr(bulk_folder, "_measure", lambda *a: (again.append(a[-1]), write(*a))[1])
    done = measure_folder(made(), source, tmp_path / "out", points_at_once=20)
    assert not set(again) & set(written)
    assert sorted(again + written) == sorted(path.name for path in (tmp_path / "out").iterdir())
    assert done.rows == 3 * ROWS
    monkeypatch.undo()
    measure_folder(made(), source, tmp_path / "at once", points_at_once=20)
    assert contents(tmp_path / "out") == contents(tmp_path / "at once")


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    source = tables(tmp_path / "runs")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").touch()
    with pytest.raises(UsageError, match="already exists"):
        measure_folder(made(), source, tmp_path / "mine")
    with pytest.raises(UsageError, match="no name for a folder"):
        measure_folder(made(), source, tmp_path / "measured.csv")
    (source / "run1.npz").write_bytes((source / "run10.npz").read_bytes())
    with pytest.raises(DatasetError, match="two tables called run1"):
        measure_folder(made(), source, tmp_path / "out")
    (source / "run1.npz").unlink()
    (source / "run3.csv.gz").touch()
    with pytest.raises(DatasetError, match=r"'run3\.csv\.gz', which is no table"):
        measure_folder(made(), source, tmp_path / "out")
    (source / "run3.csv.gz").unlink()
    (source / "run3.csv").write_text("point,u_cam1,v_cam1,u_cam2,v_cam2\na,1,2,x,4\n")
    with pytest.raises(DatasetError, match=r"run3\.csv, row 1: u_cam2 is 'x'"):
        measure_folder(made(), source, tmp_path / "out", points_at_once=20)
    (source / "run3.csv").unlink()
    with pytest.raises(UsageError, match="another measurement"):
        measure_folder(made(), source, tmp_path / "out", points_at_once=20)


def test_a_worker_that_sees_other_files_says_so(tmp_path: Path) -> None:
    source = tables(tmp_path / "runs")
    with pytest.raises(ImplicamError, match="a worker does not find"):
        bulk_folder.rows_of(str(source / "run1.csv"), str(tmp_path / "elsewhere"), "{}")
    assert not (tmp_path / "elsewhere").exists()
    (tmp_path / "out.parts" / "done").mkdir(parents=True)
    plan = json.dumps({"tables": [["run1.csv", 1, 1]]})
    (tmp_path / "out.parts" / "done" / "plan.json").write_text(plan)
    with pytest.raises(DatasetError, match="has changed"):
        bulk_folder.rows_of(str(source / "run1.csv"), str(tmp_path / "out.parts"), plan)


def test_the_command_takes_a_folder(cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    made().save("rig.implicam")
    tables(tmp_path / "runs")
    ran = cli("measure", "rig.implicam", "runs", "-o", "out", "--chunk", "50")
    assert ran.code == 0, ran.err
    assert "out: 285 rows, " in ran.out


@pytest.mark.slow
def test_workers_read_and_write_the_same_whoever_dies(
    cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, victims = tables(tmp_path / "runs"), {worker.pid for worker in cluster.workers.values()}
    here = measure_folder(made(), source, tmp_path / "here", points_at_once=5)
    told = []

    def kill(what: str, done: int, total: int) -> None:
        told.append(done)
        if len(told) == 3:
            os.kill(min(victims), signal.SIGKILL)

    there = measure_folder(
        made(), source, tmp_path / "there", points_at_once=5, scheduler=cluster.scheduler_address, progress=kill
    )
    assert there == here
    assert told == sorted(told)
    assert contents(tmp_path / "there") == contents(tmp_path / "here")
    assert min(victims) not in {worker.pid for worker in cluster.workers.values()}


@pytest.mark.slow
def test_a_caller_that_was_killed_goes_on(cluster: Any, tmp_path: Path) -> None:
    """Its workers may write on for a while; the same files."""
    source = tmp_path / "runs"
    source.mkdir()
    for i in range(2):
        np.savez(source / f"run{i}.npz", uv=np.tile(pixels(), (10, 1, 1)))
    made().save(tmp_path / "rig.implicam")
    words = ["measure", "rig.implicam", "runs", "-o", "out", "--chunk", "10", "--scheduler", cluster.scheduler_address]
    process = started(processes(), words, tmp_path)
    done = tmp_path / "out.parts" / "done"
    while process.is_alive() and not (done.exists() and len(list(done.glob("run*.json"))) > 5):
        process.join(0.005)
    assert process.pid
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert not (tmp_path / "out").exists()
    found = measure_folder(made(), source, tmp_path / "out", points_at_once=10, scheduler=cluster.scheduler_address)
    assert found.rows == 2 * 10 * ROWS
    assert found.resumed >= 50
    measure_folder(made(), source, tmp_path / "here", points_at_once=10)
    assert contents(tmp_path / "out") == contents(tmp_path / "here")
