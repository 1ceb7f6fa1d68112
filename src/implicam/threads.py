"""Threads: one place that says how many, because the BLAS libraries' own choice can cost a factor of a thousand.

NumPy and SciPy each carry a BLAS with its own pool of spinning threads. On small matrices, and whenever another
process wants a core, the two pools wait for each other: a Cholesky factor of 157 rows was measured at 700 ms instead
of 0.1 ms. So we give each task few BLAS threads and run independent tasks side by side.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext, suppress
from contextvars import ContextVar, copy_context
from functools import lru_cache
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


M_MMAP_THRESHOLD = -3
"""Of mallopt in glibc's malloc.h."""
LARGE_BYTES = 1 << 19

_MOST_CORES: ContextVar[int] = ContextVar("_MOST_CORES", default=sys.maxsize)


def cores() -> int:
    """Cores that the work at hand may use: those of this process, or fewer inside `limit_cores`."""
    own = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(own, _MOST_CORES.get())


def return_large_memory() -> None:
    """Let large arrays go back to the system when they are done with, in a process that lives for hours.

    Each thread has a heap of its own, and glibc keeps in it what was freed: with six cameras' pictures that came to
    300 MB. Other systems do as they always do.
    """
    with suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).mallopt(M_MMAP_THRESHOLD, LARGE_BYTES)


@contextmanager
def limit_cores(count: int) -> Iterator[None]:
    """Limit the cores of the work inside; work in other threads keeps its own number.

    Args:
        count: The largest number.
    """
    token = _MOST_CORES.set(count)
    try:
        yield
    finally:
        _MOST_CORES.reset(token)


@contextmanager
def blas_threads(count: int) -> Iterator[None]:
    """Limit the threads of every BLAS library for the work inside.

    Args:
        count: The largest number.
    """
    with _controller(len(sys.modules)).limit(limits=count, user_api="blas"):
        yield


@lru_cache(maxsize=1)
def _controller(modules: int) -> Any:
    """Of all libraries with threads that are loaded, as of so many modules: a look at them takes 2 ms, which is a tenth
    of a small fit when many a call asks for it, and new ones come with new modules."""
    from threadpoolctl import ThreadpoolController  # late: `import implicam` needs NumPy and SciPy only

    return ThreadpoolController()


def side_by_side(work: Callable[[Item], Result], items: Iterable[Item], *, calls_blas: bool = True) -> list[Result]:
    """Do some work on each item, on all cores.

    It helps where NumPy works, or LAPACK through implicam.gp.linalg: they release the interpreter. SciPy's own wrappers
    of LAPACK do not.

    Args:
        work: Called with each item, in threads.
        items: What to work on.
        calls_blas: Whether BLAS libraries must be told to use fewer threads, which takes milliseconds.

    Returns:
        The results, in the order of the items.

    Raises:
        Exception: The first error of `work`.
    """
    tasks = list(items)
    workers = max(1, min(len(tasks), cores()))
    if workers == 1:
        return [work(task) for task in tasks]
    limit = blas_threads(max(1, cores() // workers)) if calls_blas else nullcontext()
    with limit, ThreadPoolExecutor(workers) as pool:
        contexts = [copy_context() for _ in tasks]  # NumPy's error state, among others, is the caller's
        return list(pool.map(lambda pair: pair[0].run(work, pair[1]), zip(contexts, tasks, strict=True)))
