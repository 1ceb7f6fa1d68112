"""Who computes the cells: processes on this machine (joblib's loky), or the workers of a Dask cluster.

Both compute the same way: one cell at a time in a process, on one thread, and the result comes back as the bytes of
its file; only the caller writes. So the numbers depend neither on how many there are nor on where they are.

A process that dies (a crash in a library, no memory left) takes with it cells that had no part in it. So what was under
way is computed again afterwards, each alone: a cell whose process dies again and again then is itself the cause.
"""

from __future__ import annotations

import json
import pkgutil
import re
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, suppress
from itertools import islice
from typing import Any, NamedTuple, Protocol

from implicam.errors import ImplicamError, UsageError, import_extra
from implicam.experiments.stored import encode
from implicam.threads import limit_cores

CONNECT_SECONDS = 10
POLL_SECONDS = 5  # waiting for results, ask so often whether any can come
NO_WORKER_SECONDS = 120  # before a cluster is given up

_ADDRESS = re.compile(r"([a-z]+://)?[^\s/]+:[0-9]{1,5}")
_ONE_CELL_AT_A_TIME = threading.Lock()
_ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"
)


class Task(NamedTuple):
    """What is sent to a worker.

    Attributes:
        work: The dotted name of the function.
        name: Of the cell.
        options: As JSON text.
    """

    work: str
    name: str
    options: str


class Attempt(NamedTuple):
    """What comes back from a worker.

    Attributes:
        name: Of the cell.
        content: The bytes of the result file; empty where there is no result.
        failure: Why there is none, in three lines.
        trace: The traceback.
    """

    name: str
    content: bytes = b""
    failure: str = ""
    trace: str = ""


def attempt(task: Task) -> Attempt:
    """Compute one cell in this process; an error of the cell is returned, not raised.

    Args:
        task: The cell.
    """
    with _ONE_CELL_AT_A_TIME, _one_thread():
        start = time.perf_counter()
        try:
            values = pkgutil.resolve_name(task.work)(**json.loads(task.options))
            return Attempt(task.name, encode(task.work, task.options, time.perf_counter() - start, values))
        except (Exception, SystemExit) as error:
            return Attempt(task.name, failure=str(_explain(task, error)), trace=traceback.format_exc())


def _explain(task: Task, error: BaseException) -> ImplicamError:
    fix = f"read the traceback in {task.name}.failed.txt; the next run tries this cell again"
    if isinstance(error, ImplicamError):
        return ImplicamError(f"{task.name}: {error.what}", why=error.why, fix=error.fix or fix)
    place = traceback.extract_tb(error.__traceback__)[-1]
    message = " ".join(str(error).split())[:500]
    return ImplicamError(
        f"{task.name}: {type(error).__name__}{': ' * bool(message)}{message}",
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
        with threadpool_limits(limits=1), limit_cores(1):
            yield
    finally:
        if torch:
            torch.set_num_threads(torch_threads)


class Workers(Protocol):
    """Processes that compute.

    Attributes:
        at_once: How many tasks they are given at a time.
        death: What a future raises where its process died.
        retries: How often a task that may have been the cause is tried alone.
    """

    at_once: int
    death: type[Exception]
    retries: int

    def submit(self, task: Task) -> Future[Attempt]:
        """Start `attempt` somewhere.

        Args:
            task: The cell.
        """

    def check(self) -> None:
        """Called while no result comes.

        Raises:
            ImplicamError: None can come any more.
        """

    def close(self) -> None:
        """Stop what still runs."""


def compute_all(workers: Workers, tasks: Sequence[Task]) -> Generator[Attempt, None, None]:
    """Compute all tasks. Close the generator to stop the workers early.

    Args:
        workers: What computes.
        tasks: The cells.

    Yields:
        The attempts, in the order in which they end.

    Raises:
        ImplicamError: No result can come any more.
    """
    suspects: list[Task] = []
    try:
        for task, done in _compute(workers, tasks):
            if done is None:
                suspects.append(task)
            else:
                yield done
        for task in suspects:
            yield _compute_alone(workers, task)
    finally:
        workers.close()


def _compute(workers: Workers, tasks: Sequence[Task]) -> Iterator[tuple[Task, Attempt | None]]:
    """Each task and what came of it; None where its process died."""
    waiting, running = iter(tasks), dict[Future[Attempt], Task]()
    while True:
        running |= {workers.submit(task): task for task in islice(waiting, workers.at_once - len(running))}
        if not running:
            return
        ended, _ = wait(running, timeout=POLL_SECONDS, return_when=FIRST_COMPLETED)
        if not ended:
            workers.check()
        while ended:  # a cluster keeps a result, and computes it again after a death, while somebody holds its future
            future = ended.pop()
            yield running.pop(future), _result(future, workers.death)
            del future


def _result(future: Future[Attempt], death: type[Exception]) -> Attempt | None:
    try:
        return future.result()
    except death:
        return None
    except CancelledError as error:
        raise ImplicamError(
            "what was being computed was cancelled.",
            why="the scheduler is gone, or somebody has cancelled it there",
            fix="start the scheduler again and run again; what is done is kept",
        ) from error


def _compute_alone(workers: Workers, task: Task) -> Attempt:
    """Compute one task while nothing else runs; where its process dies whatever we do, it has failed."""
    for _ in range(workers.retries):
        for _, done in _compute(workers, [task]):
            if done is not None:
                return done
    error = ImplicamError(
        f"{task.name}: the process that computed it died, again and again.",
        why="a crash in a library, or no memory left; in the end it ran alone, so no other cell is the cause",
        fix="look for the process in the system's log; the next run tries this cell again",
    )
    return Attempt(task.name, failure=str(error), trace="The process died and left no traceback.\n")


class LocalProcesses:
    """Processes on this machine, by joblib.

    A cell whose process dies three times, twice of them alone, has failed.
    """

    death: type[Exception] = BrokenProcessPool
    retries = 2

    def __init__(self, jobs: int) -> None:
        self._loky = import_extra("joblib.externals.loky", "paper", "computing cells side by side")
        self.at_once = jobs
        # loky replaces a process whose memory has grown, loses nothing by it, and says so as if something were wrong.
        # It does so in a thread of its own, so that the filter has to stand as long as the processes do.
        self._warnings = ExitStack()
        self._warnings.enter_context(warnings.catch_warnings())
        warnings.filterwarnings("ignore", "A worker stopped while some jobs were given to the executor", UserWarning)

    def submit(self, task: Task) -> Future[Attempt]:
        """Start `attempt`; where a process has died, in new ones.

        Args:
            task: The cell.
        """
        future: Future[Attempt] = self._pool().submit(attempt, task)
        return future

    def check(self) -> None:
        """Do nothing: loky itself notices when a process dies."""

    def close(self) -> None:
        """End the processes, whatever they do."""
        self._pool().shutdown(wait=True, kill_workers=True)
        self._warnings.close()

    def _pool(self) -> Any:
        return self._loky.get_reusable_executor(self.at_once, timeout=None, env=_ONE_THREAD)


class DaskCluster:
    """The workers of a Dask scheduler at an address such as tcp://10.0.0.5:8786; they need implicam installed.

    Dask itself tries a cell again where its worker died (`distributed.scheduler.allowed-failures`, 3 times); what it
    gives up, perhaps because of another cell on the same worker, is tried once more alone. All cells are handed over at
    once, so that a cluster that adapts its size sees how many there are.
    """

    at_once, retries = sys.maxsize, 1

    def __init__(self, address: str) -> None:
        distributed = import_extra("distributed", "cluster", "computing cells on a Dask cluster")
        if not _ADDRESS.fullmatch(address):  # Client would refuse it, too, and leave a thread behind
            raise UsageError(
                f"{address!r} is not the address of a Dask scheduler.",
                why="it has a host and a port, such as tcp://10.0.0.5:8786",
                fix="give the address that `dask scheduler` prints",
            )
        self.death: type[Exception] = distributed.scheduler.KilledWorker
        self._address, self._polls_without_worker = address, 0
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
        """Start `attempt` on any worker.

        Args:
            task: The cell.
        """
        future: Future[Attempt] = self._executor.submit(attempt, task)
        return future

    def check(self) -> None:
        """Give up where the cluster has had no workers for a while; at first they may be starting.

        Raises:
            ImplicamError: It has had none for `NO_WORKER_SECONDS`.
        """
        has_workers = False
        with suppress(OSError, ValueError):  # the scheduler does not answer
            has_workers = bool(self._client.nthreads())
        self._polls_without_worker = 0 if has_workers else self._polls_without_worker + 1
        if self._polls_without_worker * POLL_SECONDS > NO_WORKER_SECONDS:
            raise ImplicamError(
                f"the Dask scheduler at {self._address} has had no worker for {NO_WORKER_SECONDS} s.",
                why="none was started, or all have died",
                fix=f"start some with `dask worker {self._address}` and run again; what is done is kept",
            )

    def close(self) -> None:
        """Disconnect from the cluster; what still runs there is cancelled."""
        self._client.close()
