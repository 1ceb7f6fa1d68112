"""Threads: one place that says how many, because the BLAS libraries' own choice can cost a factor of a thousand.

NumPy and SciPy each carry a BLAS with its own pool of spinning threads. On small matrices, and whenever another
process wants a core, the two pools wait for each other: a Cholesky factor of 157 rows was measured at 700 ms instead
of 0.1 ms. So we give each task few BLAS threads and run independent tasks side by side.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import copy_context
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def blas_threads(count: int) -> Iterator[None]:
    """Limit every BLAS to `count` threads for a while."""
    from threadpoolctl import threadpool_limits  # late: `import implicam` needs NumPy and SciPy only

    with threadpool_limits(limits=count, user_api="blas"):
        yield


def side_by_side(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """`work` on each item, results in order, on all cores.

    It helps where NumPy works, or LAPACK through implicam.gp.linalg: they release the interpreter. SciPy's own wrappers
    of LAPACK do not.
    """
    tasks = list(items)
    workers = max(1, min(len(tasks), cores()))
    with blas_threads(max(1, cores() // workers)), ThreadPoolExecutor(workers) as pool:
        contexts = [copy_context() for _ in tasks]  # NumPy's error state, among others, is the caller's
        return list(pool.map(lambda pair: pair[0].run(work, pair[1]), zip(contexts, tasks, strict=True)))
