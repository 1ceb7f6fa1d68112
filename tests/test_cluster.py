"""Calibrating, comparing and measuring on a Dask cluster: the numbers of one machine, or an error that says why not."""

from __future__ import annotations

import os
import pickle
import signal
from dataclasses import replace
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from command_line import Cli, cli  # noqa: F401  a fixture
from dask_cluster import cluster  # noqa: F401  a fixture
from implicam import workers
from implicam.bulk import measure_file
from implicam.calibrators import ForwardGP, ForwardGPCalibration, InverseGP
from implicam.calibrators.elsewhere import fit_on_cluster
from implicam.compare import compare_on, random_splits
from implicam.dataset import Dataset
from implicam.errors import FitError, ImplicamError, MissingExtraError, UsageError
from implicam.simulate import simulated
from implicam.workers import DaskCluster, compute_on_cluster


@pytest.fixture(scope="module")
def rig() -> Dataset:
    return simulated("stereo", points=640, seed=1)


@pytest.fixture(scope="module")
def fitted(rig: Dataset) -> ForwardGPCalibration:
    return ForwardGP().fit(rig.select(np.arange(40)))


@pytest.mark.slow
def test_a_table_is_measured_to_the_same_bytes_whoever_dies(
    cluster: Any, rig: Dataset, fitted: ForwardGPCalibration, tmp_path: Path
) -> None:
    np.savez(tmp_path / "new.npz", uv=rig.observations.uv[40:])
    here = measure_file(fitted, tmp_path / "new.npz", tmp_path / "here.csv", points_at_once=50)
    victims = {worker.pid for worker in cluster.workers.values()}
    told = []

    def kill(what: str, done: int, total: int) -> None:
        told.append(done)
        if len(told) == 3:
            os.kill(min(victims), signal.SIGKILL)

    scheduler = cluster.scheduler_address
    there = measure_file(
        fitted, tmp_path / "new.npz", tmp_path / "there.csv", points_at_once=50, scheduler=scheduler, progress=kill
    )
    assert there == here
    assert told == sorted(told)
    assert told[-1] == 600
    assert (tmp_path / "there.csv").read_bytes() == (tmp_path / "here.csv").read_bytes()
    assert min(victims) not in {worker.pid for worker in cluster.workers.values()}


@pytest.mark.slow
def test_methods_are_compared_to_the_same_numbers(cluster: Any, rig: Dataset) -> None:
    splits = random_splits(rig.select(np.arange(120)), [20, 40], seeds=2)
    methods = {"forward-gp": ForwardGP(), "inverse-gp": InverseGP()}
    counted: list[int] = []
    here = compare_on(splits, methods)
    there = compare_on(splits, methods, lambda what, done, total: counted.append(done), cluster.scheduler_address)
    assert counted == list(range(1, 9))
    assert [trial.fit_seconds > 0 for trial in there] == [True] * 8
    for one, other in zip(here, there, strict=True):
        assert repr(replace(one, fit_seconds=0)) == repr(replace(other, fit_seconds=0))


@pytest.mark.slow
def test_a_fit_comes_back_as_its_file(cluster: Any, rig: Dataset, fitted: ForwardGPCalibration, tmp_path: Path) -> None:
    there = fit_on_cluster(ForwardGP(), rig.select(np.arange(40)), cluster.scheduler_address)
    there.save(tmp_path / "there.implicam")
    fitted.save(tmp_path / "here.implicam")
    assert (tmp_path / "there.implicam").read_bytes() == (tmp_path / "here.implicam").read_bytes()
    with pytest.raises(FitError, match="forward-gp needs at least 8") as caught:  # the worker's own error
        fit_on_cluster(ForwardGP(), rig.select(np.arange(4)), cluster.scheduler_address)
    assert caught.value.fix


@pytest.mark.slow
def test_an_address_that_is_none_is_refused_by_every_command(cli: Cli) -> None:
    pytest.importorskip("distributed")
    cli("simulate", "rig", "--cameras", "2R", "--points", "30")
    cli("calibrate", "rig", "-o", "rig.implicam")
    np.savez("new.npz", uv=np.zeros((3, 2, 2)))
    nowhere = ("--scheduler", "nonsense")
    for words in (
        ("calibrate", "rig", "-o", "far.implicam"),
        ("compare", "rig", "--methods", "inverse-gp"),
        ("measure", "rig.implicam", "new.npz", "--chunk", "2"),
    ):
        ran = cli(*words, *nowhere)
        assert ran.code == 2
        assert "'nonsense' is not the address of a Dask scheduler" in ran.err
    ran = cli("measure", "rig.implicam", "rig", *nowhere)
    assert ran.code == 2
    assert "--chunk" in ran.err


class StandIn:
    """A cluster whose workers have other packages."""

    def __init__(self, answer: object) -> None:
        self.answer = answer

    def run(self, function: object, package: str, *, on_error: str) -> dict[str, object]:
        return {"tcp://10.0.0.7:9": self.answer}


@pytest.mark.parametrize(
    ("answer", "said"),
    [(PackageNotFoundError("implicam"), "tcp://10.0.0.7:9 has no implicam"), ("0.0.1", "has implicam 0.0.1; here is")],
)
def test_a_worker_with_other_packages_is_named(answer: object, said: str) -> None:
    some = DaskCluster.__new__(DaskCluster)
    some._client = StandIn(answer)
    with pytest.raises(ImplicamError, match=said) as caught:
        some._check_versions()
    assert "pip install" in caught.value.fix


def test_errors_of_another_process_are_the_same() -> None:
    for error in (UsageError("what.", why="why", fix="fix"), MissingExtraError("dask is not here.", fix="pip")):
        back = pickle.loads(pickle.dumps(error))
        assert (type(back), str(back)) == (type(error), str(error))


def test_what_a_task_says_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    failed = workers.Attempt("one", error=UsageError("it is wrong.", fix="mend it"))
    monkeypatch.setattr(workers, "DaskCluster", lambda *given: None)
    monkeypatch.setattr(workers, "compute_all", lambda *given: (done for done in [failed]))
    with pytest.raises(UsageError, match="it is wrong"):
        list(compute_on_cluster("tcp://host:1", []))
