"""What belongs to the whole process (umask, warnings, threads of the libraries) is as it was, or never touched.

Other threads read it at the same time, and a program that uses implicam has set it as it wants.
"""

from __future__ import annotations

import os
import stat
import threading
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from implicam import threads
from implicam.files import replacing, replacing_folder
from implicam.images import opencv
from implicam.simulate import Studio, build_rig, random_positions
from implicam.workers import LocalProcesses, Task, attempt, compute_all


@pytest.fixture
def umask_027() -> Any:
    before = os.umask(0o027)
    yield
    os.umask(before)


@pytest.mark.skipif(os.name != "posix", reason="rights of files as POSIX has them")
def test_files_get_the_rights_of_any_new_file(tmp_path: Path, umask_027: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """And the umask is never touched: another thread may make its secret file just then."""
    monkeypatch.setattr(os, "umask", lambda mask: pytest.fail("the umask belongs to the process"))
    with replacing(tmp_path / "file") as temporary:
        temporary.write_text("x")
    with replacing_folder(tmp_path / "folder") as temporary:
        (temporary / "inside").write_text("x")
    rights = {path.name: stat.S_IMODE(path.stat().st_mode) for path in tmp_path.rglob("*")}
    monkeypatch.undo()  # before the fixture sets the umask back
    assert rights == {"file": 0o640, "folder": 0o750, "inside": 0o640}


def test_a_limit_of_cores_is_of_the_work_inside_alone() -> None:
    free = threads.cores()
    elsewhere: list[int] = []
    with threads.limit_cores(1):
        other = threading.Thread(target=lambda: elsewhere.append(threads.cores()))
        other.start()
        other.join()
        assert threads.cores() == 1
        with threads.limit_cores(free + 1):
            assert threads.cores() == free
        assert threads.cores() == 1
    assert (elsewhere, threads.cores()) == ([free], free)


def test_work_side_by_side_keeps_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """The threads of `side_by_side` are others than the one that set it."""
    monkeypatch.setattr(threads.os, "sched_getaffinity", lambda _: range(4), raising=False)
    with threads.limit_cores(2):
        assert threads.side_by_side(lambda _: threads.cores(), range(4)) == [2, 2, 2, 2]
    assert threads.side_by_side(lambda _: threads.cores(), range(4)) == [4, 4, 4, 4]


def many_threads() -> dict[str, Any]:
    np.linalg.inv(np.eye(3))
    return {"cores": threads.cores()}


def broken() -> dict[str, Any]:
    raise ValueError("broken")


@pytest.mark.parametrize("work", [many_threads, broken])
def test_a_cell_leaves_the_process_as_it_was(work: Any) -> None:
    before = [pool["num_threads"] for pool in threadpool_info()], threads.cores
    attempt(Task(f"{__name__}:{work.__name__}", "cell", {}))
    assert ([pool["num_threads"] for pool in threadpool_info()], threads.cores) == before


def test_the_filter_of_warnings_goes_with_the_processes() -> None:
    """What loky says of processes it has replaced is not heard while ours run; before and after, it is."""
    said = "A worker stopped while some jobs were given to the executor. This can be caused by ..."

    before = list(warnings.filters)
    workers = LocalProcesses(1)
    speak = threading.Thread(target=warnings.warn, args=(said, UserWarning))  # an error in a thread fails the test
    speak.start()
    speak.join()
    assert list(compute_all(workers, [])) == []
    assert warnings.filters == before
    with pytest.raises(UserWarning, match="A worker stopped"):
        warnings.warn(said, UserWarning, stacklevel=1)


@pytest.mark.slow
def test_photographs_leave_the_threads_of_opencv_alone(tmp_path: Path) -> None:
    cv2 = opencv()
    rig = build_rig("stereo", seed=0)
    studio = Studio(rig, random_positions(rig, 1, np.random.default_rng(0)), seed=0)
    before = cv2.getNumThreads()
    try:
        cv2.setNumThreads(2)
        studio.picture(0, 0)
        assert studio.write(tmp_path) == 2
        assert cv2.getNumThreads() == 2
    finally:
        cv2.setNumThreads(before)
