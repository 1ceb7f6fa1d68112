"""Who computes tasks that need nothing of each other: processes on this machine (joblib's loky), or the workers of a
Dask cluster.

Both compute the same way: one task at a time in a process, on one thread, and the result comes back; only the caller
writes. So the numbers depend neither on how many there are nor on where they are.

A process that dies (a crash in a library, no memory left) takes with it tasks that had no part in it. So what was under
way is computed again afterwards, each alone: a task whose process dies again and again then is itself the cause.
"""

from __future__ import annotations

import pkgutil
import re
import sys
import threading
import traceback
import warnings
from collections.abc import Generator, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, closing, contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from itertools import islice
from typing import Any, NamedTuple, Protocol

from implicam.errors import ImplicamError, UsageError, import_extra
from implicam.threads import limit_cores

CONNECT_SECONDS = 10
POLL_SECONDS = 5  # waiting for results, ask so often whether any can come
NO_WORKER_SECONDS = 120  # before a cluster is given up

_ADDRESS = re.compile(r"([a-z]+://)?[^\s/]+:[0-9]{1,5}")
_SAME_EVERYWHERE = ("implicam", "numpy", "scipy", "distributed")
"""What a worker must have in the caller's version: else numbers differ, or nothing works."""
_ONE_TASK_AT_A_TIME = threading.Lock()
_ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"
)


class Task(NamedTuple):
    """What is sent to a worker.

    Attributes:
        work: The dotted name of the function, "package.module:function".
        name: Of the task.
        arguments: By name, as the function takes them; they are pickled.
    """

    work: str
    name: str
    arguments: Mapping[str, Any]


class Attempt(NamedTuple):
    """What comes back from a worker.

    Attributes:
        name: Of the task.
        value: What the function returned; None where it did not.
        error: Why it did not; None where it did.
        trace: The traceback.
    """

    name: str
    value: Any = None
    error: ImplicamError | None = None
    trace: str = ""


def attempt(task: Task) -> Attempt:
    """Compute one task in this process; its error is returned, not raised.

    Args:
        task: What to compute.
    """
    with _ONE_TASK_AT_A_TIME, _one_thread():
        try:
            return Attempt(task.name, pkgutil.resolve_name(task.work)(**task.arguments))
        except (Exception, SystemExit) as error:
            return Attempt(task.name, error=_explain(error), trace=traceback.format_exc())


def _explain(error: BaseException) -> ImplicamError:
    if isinstance(error, ImplicamError):
        return error
    place = traceback.extract_tb(error.__traceback__)[-1]
    message = " ".join(str(error).split())[:500]
    return ImplicamError(
        f"{type(error).__name__}{': ' * bool(message)}{message}",
        why=f"raised in {place.name}, {place.filename}:{place.lineno}",
    )


def compute_on_cluster(
    scheduler: str, tasks: Iterable[Task], *, a_worker: int | None = None
) -> Iterator[tuple[str, Any]]:
    """Compute tasks by the workers of a Dask cluster.

    Args:
        scheduler: The address of its scheduler.
        tasks: What to compute; they are taken as they are handed over.
        a_worker: How many are handed over before results come, for each thread of a worker; None for all.

    Yields:
        The name of each task and what it returned, in the order in which they end.

    Raises:
        ImplicamError: There is no such cluster, it cannot compute, or a task failed; the others are then given up.
    """
    with closing(compute_all(DaskCluster(scheduler, a_worker), tasks)) as all_done:
        for done in all_done:
            if done.error is not None:
                raise done.error
            yield done.name, done.value


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
            task: What to compute.
        """

    def check(self) -> None:
        """Called while no result comes.

        Raises:
            ImplicamError: None can come any more.
        """

    def close(self) -> None:
        """Stop what still runs."""


def compute_all(workers: Workers, tasks: Iterable[Task]) -> Generator[Attempt, None, None]:
    """Compute all tasks. Close the generator to stop the workers early.

    Args:
        workers: What computes.
        tasks: What to compute.

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


def _compute(workers: Workers, tasks: Iterable[Task]) -> Iterator[tuple[Task, Attempt | None]]:
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
        "the process that computed it died, again and again.",
        why="a crash in a library, or no memory left; in the end it ran alone, so nothing else is the cause",
        fix="look for the process in the system's log; the next run tries it again",
    )
    return Attempt(task.name, error=error, trace="The process died and left no traceback.\n")


class LocalProcesses:
    """Processes on this machine, by joblib.

    A task whose process dies three times, twice of them alone, has failed.
    """

    death: type[Exception] = BrokenProcessPool
    retries = 2

    def __init__(self, jobs: int) -> None:
        self._loky = import_extra("joblib.externals.loky", "paper", "computing side by side")
        self.at_once = jobs
        # loky replaces a process whose memory has grown, loses nothing by it, and says so as if something were wrong.
        # It does so in a thread of its own, so that the filter has to stand as long as the processes do.
        self._warnings = ExitStack()
        self._warnings.enter_context(warnings.catch_warnings())
        warnings.filterwarnings("ignore", "A worker stopped while some jobs were given to the executor", UserWarning)

    def submit(self, task: Task) -> Future[Attempt]:
        """Start `attempt`; where a process has died, in new ones.

        Args:
            task: What to compute.
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

    Dask itself tries a task again where its worker died (`distributed.scheduler.allowed-failures`, 3 times); what it
    gives up, perhaps because of another task on the same worker, is tried once more alone. All tasks are handed over at
    once, unless they are large, so that a cluster that adapts its size sees how many there are.
    """

    retries = 1

    def __init__(self, address: str, a_worker: int | None = None) -> None:
        distributed = import_extra("distributed", "cluster", "computing on a Dask cluster")
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
        try:
            self._check_versions()
        except ImplicamError:
            self._client.close()
            raise
        self.at_once = sys.maxsize
        if a_worker is not None:
            self.at_once = a_worker * max(1, sum(self._client.nthreads().values()))
        self._executor = self._client.get_executor(pure=False)

    def _check_versions(self) -> None:
        """All workers that are there have what is needed, in our versions.

        Raises:
            ImplicamError: One has not; names it and the package.
        """
        for package in _SAME_EVERYWHERE:
            ours = version(package)
            for worker, theirs in self._client.run(version, package, on_error="return").items():
                fix = (
                    f"install {package} {ours} where the worker runs (pip install {package}=={ours}), and start it anew"
                )
                if isinstance(theirs, PackageNotFoundError):
                    raise ImplicamError(
                        f"the worker {worker} has no {package}.",
                        why="what is computed there is computed by it",
                        fix='pip install "implicam[cluster]" where the worker runs' if package == "implicam" else fix,
                    )
                if theirs != ours:
                    raise ImplicamError(
                        f"the worker {worker} has {package} {theirs}; here is {ours}.",
                        why="the same numbers everywhere take the same versions everywhere",
                        fix=fix,
                    )

    def submit(self, task: Task) -> Future[Attempt]:
        """Start `attempt` on any worker.

        Args:
            task: What to compute.
        """
        dask = import_extra("dask", "cluster", "computing on a Dask cluster")
        with dask.config.set(
            {"distributed.admin.large-graph-warning-threshold": "4 GiB"}
        ):  # a part of a table is large
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
