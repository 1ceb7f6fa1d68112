"""Who computes the cells: processes on this machine (joblib's loky), or the workers of a Dask cluster.

Both compute the same way: one cell at a time in a process, on one thread, and the result comes back as the bytes of
its file; only the caller writes. So the numbers depend neither on how many there are nor on where they are.

A process that dies (a crash in a library, no memory left) takes with it cells that had no part in it. So what was under
way is computed again afterwards, each alone: a cell whose process dies again and again then is itself the cause.
"""

from __future__ import annotations

import json
import pkgutil
import queue
import re
import sys
import threading
import time
import traceback
import warnings
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, suppress
from typing import NamedTuple, Protocol

from implicam.errors import ImplicamError, UsageError, import_extra
from implicam.experiments.stored import encode
from implicam.threads import at_most

CONNECT_SECONDS = 10
LOOK_SECONDS = 5  # waiting for results, look so often whether any can come
LONELY_SECONDS = 120  # without any worker, before a cluster is given up

_ADDRESS = re.compile(r"([a-z]+://)?[^\s/]+:[0-9]{1,5}")
_ONE_AT_A_TIME = threading.Lock()
_ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"
)


class Task(NamedTuple):
    """What a worker is sent: the dotted name of the function, the cell's name, its options as JSON text."""

    work: str
    name: str
    options: str


class Attempt(NamedTuple):
    """What comes back: the bytes of the result file, or why there are none (three lines) and the traceback."""

    name: str
    content: bytes = b""
    failure: str = ""
    trace: str = ""


def attempt(task: Task) -> Attempt:
    """Compute one cell in this process; never raises an error of the cell's own."""
    with _ONE_AT_A_TIME, _one_thread():
        start = time.perf_counter()
        try:
            values = pkgutil.resolve_name(task.work)(**json.loads(task.options))
            return Attempt(task.name, encode(task.work, task.options, time.perf_counter() - start, values))
        except (Exception, SystemExit) as error:
            return Attempt(task.name, failure=str(_explained(task, error)), trace=traceback.format_exc())


def _explained(task: Task, error: BaseException) -> ImplicamError:
    fix = f"read the traceback in {task.name}.failed.txt; the next run tries this cell again"
    if isinstance(error, ImplicamError):
        return ImplicamError(f"{task.name}: {error.what}", why=error.why, fix=error.fix or fix)
    place = traceback.extract_tb(error.__traceback__)[-1]
    said = " ".join(str(error).split())[:500]
    return ImplicamError(
        f"{task.name}: {type(error).__name__}{': ' * bool(said)}{said}",
        why=f"raised in {place.name}, {place.filename}:{place.lineno}",
        fix=fix,
    )


@contextmanager
def _one_thread() -> Iterator[None]:
    """BLAS and OpenMP on one thread, whatever is loaded now, and no thread pools of our own."""
    from threadpoolctl import threadpool_limits

    torch = sys.modules.get("torch")
    torch_threads = torch.get_num_threads() if torch else 0
    if torch:
        torch.set_num_threads(1)
    try:
        with threadpool_limits(limits=1), at_most(1):
            yield
    finally:
        if torch:
            torch.set_num_threads(torch_threads)


class Workers(Protocol):
    """Processes that compute.

    at_once: tasks that they are given at a time. death: what a future raises where its process died. alone: how often
    a task that may have been the cause is tried alone.
    """

    at_once: int
    death: type[Exception]
    alone: int

    def submit(self, task: Task) -> Future[Attempt]:
        """Start `attempt(task)` somewhere."""

    def check(self) -> None:
        """Called while no result comes; ImplicamError where none can come any more."""

    def close(self) -> None:
        """Stop what still runs."""


def attempts(workers: Workers, tasks: Sequence[Task]) -> Generator[Attempt, None, None]:
    """Compute all tasks; the attempts in the order in which they end. Close it to stop the workers early."""
    suspects: list[Task] = []
    try:
        for task, done in _finished(workers, tasks):
            if done is None:
                suspects.append(task)
            else:
                yield done
        for task in suspects:
            yield _alone(workers, task)
    finally:
        workers.close()


def _finished(workers: Workers, tasks: Sequence[Task]) -> Iterator[tuple[Task, Attempt | None]]:
    """Each task and what came of it; None where its process died."""
    waiting, running = deque(tasks), dict[Future[Attempt], Task]()
    ended: queue.SimpleQueue[Future[Attempt]] = queue.SimpleQueue()
    while waiting or running:
        while waiting and len(running) < workers.at_once:
            task = waiting.popleft()
            future = workers.submit(task)
            running[future] = task
            future.add_done_callback(ended.put)
        future = _next(ended, workers)
        task = running.pop(future)
        try:
            done = future.result()
        except workers.death:
            done = None
        except CancelledError as error:
            raise ImplicamError(
                "what was being computed was cancelled.",
                why="the scheduler is gone, or somebody has cancelled it there",
                fix="start the scheduler again and run again; what is done is kept",
            ) from error
        del future  # a cluster keeps a result, and computes it again after a death, while somebody holds its future
        yield task, done


def _next(ended: queue.SimpleQueue[Future[Attempt]], workers: Workers) -> Future[Attempt]:
    while True:
        with suppress(queue.Empty):
            return ended.get(timeout=LOOK_SECONDS)
        workers.check()


def _alone(workers: Workers, task: Task) -> Attempt:
    """Compute one task while nothing else runs; where its process dies whatever we do, it has failed."""
    for _ in range(workers.alone):
        for _, done in _finished(workers, [task]):
            if done is not None:
                return done
    error = ImplicamError(
        f"{task.name}: the process that computed it died, again and again.",
        why="a crash in a library, or no memory left; in the end it ran alone, so no other cell is the cause",
        fix="look for the process in the system's log; the next run tries this cell again",
    )
    return Attempt(task.name, failure=str(error), trace="The process died and left no traceback.\n")


class LocalProcesses:
    """So many processes on this machine. A cell whose process dies three times, twice of them alone, has failed."""

    death: type[Exception] = BrokenProcessPool
    alone = 2

    def __init__(self, jobs: int) -> None:
        self._loky = import_extra("joblib.externals.loky", "paper", "computing cells side by side")
        self.at_once = jobs
        self._pool = self._new_pool()
        # loky replaces a process whose memory has grown, loses nothing by it, and says so as if something were wrong.
        # It does so in a thread of its own, so that the filter has to stand as long as the processes do.
        self._warnings = ExitStack()
        self._warnings.enter_context(warnings.catch_warnings())
        warnings.filterwarnings("ignore", "A worker stopped while some jobs were given to the executor", UserWarning)

    def _new_pool(self) -> Executor:
        pool: Executor = self._loky.ProcessPoolExecutor(self.at_once, env=_ONE_THREAD)
        return pool

    def submit(self, task: Task) -> Future[Attempt]:
        """Start `attempt(task)`, in a new pool where the old one is broken."""
        with suppress(self.death):
            return self._pool.submit(attempt, task)
        self._end_pool()
        self._pool = self._new_pool()
        return self._pool.submit(attempt, task)

    def check(self) -> None:
        """Nothing to see: the pool itself notices when a process dies."""

    def close(self) -> None:
        """End the processes, whatever they do."""
        self._end_pool()
        self._warnings.close()

    def _end_pool(self) -> None:
        self._pool.shutdown(wait=True, kill_workers=True)  # type: ignore[call-arg]


class DaskCluster:
    """The workers of the Dask scheduler at an address such as tcp://10.0.0.5:8786; they need implicam installed.

    Dask itself tries a cell again where its worker died (`distributed.scheduler.allowed-failures`, 3 times); what it
    gives up, perhaps for the sake of another cell on the same worker, is tried once more alone. All cells are handed
    over at once, so that a cluster that adapts sees how much there is.
    """

    at_once, alone = sys.maxsize, 1

    def __init__(self, address: str) -> None:
        distributed = import_extra("distributed", "cluster", "computing cells on a Dask cluster")
        if not _ADDRESS.fullmatch(address):  # Client would refuse it, too, and leave a thread behind
            raise UsageError(
                f"{address!r} is not the address of a Dask scheduler.",
                why="it has a host and a port, such as tcp://10.0.0.5:8786",
                fix="give the address that `dask scheduler` prints",
            )
        self.death: type[Exception] = distributed.scheduler.KilledWorker
        self._address, self._lonely = address, 0
        try:
            self._client = distributed.Client(address, set_as_default=False, timeout=CONNECT_SECONDS)
        except OSError as error:
            raise ImplicamError(
                f"there is no Dask scheduler at {address!r}.",
                why=" ".join(str(error).split()) or type(error).__name__,
                fix="start one with `dask scheduler`, and give the address that it prints",
            ) from error
        self._executor = self._client.get_executor(pure=False)

    def submit(self, task: Task) -> Future[Attempt]:
        """Start `attempt(task)` on any worker."""
        future: Future[Attempt] = self._executor.submit(attempt, task)
        return future

    def check(self) -> None:
        """A cluster without workers would keep us waiting for ever; for a while, they may be starting."""
        there = False
        with suppress(OSError, ValueError):  # the scheduler does not answer
            there = bool(self._client.nthreads())
        self._lonely = 0 if there else self._lonely + 1
        if self._lonely * LOOK_SECONDS > LONELY_SECONDS:
            raise ImplicamError(
                f"the Dask scheduler at {self._address} has had no worker for {LONELY_SECONDS} s.",
                why="none was started, or all have died",
                fix=f"start some with `dask worker {self._address}` and run again; what is done is kept",
            )

    def close(self) -> None:
        """Let go of the cluster; what still runs there is cancelled."""
        self._client.close()
