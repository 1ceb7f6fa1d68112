"""A real Dask cluster on this machine, for tests."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Two workers of a thread each."""
    dask = pytest.importorskip("dask")
    distributed = pytest.importorskip("distributed")
    # Fewer deaths, as each restart takes seconds; and no giving up of workers that are being restarted, which a
    # LocalCluster does with those that were away when it looked.
    few = {"distributed.scheduler.allowed-failures": 1, "distributed.deploy.lost-worker-timeout": "1 hour"}
    with (
        dask.config.set(few),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0", silence_logs=60
        ) as local,
    ):
        yield local
