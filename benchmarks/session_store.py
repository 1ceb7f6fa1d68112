"""How long a guided session takes to open, and to accept, undo and note a point, when it has many: six cameras.

python benchmarks/session_store.py [10000]
"""

from __future__ import annotations

import json
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np

from implicam.dataset import Camera, Dataset, KnownPositions, Observations
from implicam.session import Session
from implicam.session.database import insert_shot

CAMERAS = tuple(Camera(f"cam{k}", 1280, 1024) for k in range(1, 7))


def shot(i: int) -> Dataset:
    """A ball that all cameras see."""
    rng, name = np.random.default_rng(i), f"p{i:03d}"
    uv = rng.uniform(0, 1000, (1, len(CAMERAS), 2))
    sd = rng.uniform(0.03, 0.1, uv.shape)
    known = KnownPositions(np.array([name]), rng.uniform(-200, 200, (1, 3)), np.full((1, 3), 0.05))
    return Dataset("s", "mm", Observations(np.array([name]), CAMERAS, uv, sd), known)


def filled(folder: Path, points: int) -> None:
    """A session with so many points, in one transaction."""
    session = Session.create(folder, name="s", length_unit="mm", cameras=CAMERAS, settings={})
    with session, session._database.transaction():
        for i in range(1, points + 1):
            insert_shot(session._database, shot(i), "{}")
    Session.open(folder).close()  # writes the tables


def journal_instead(folder: Path, points: int) -> tuple[float, float, float]:
    """The same points as lines of JSON in one file that only grows: seconds to read all and build the dataset, and to
    append a point and flush it; and those of a commit of SQLite as in a session."""
    path = folder / "journal.jsonl"

    def line(data: Dataset) -> str:
        known, seen = data.positions, data.observations
        return json.dumps(
            [str(data.points[0]), known.xyz.tolist(), known.sd.tolist(), seen.uv.tolist(), seen.sd.tolist()]
        )

    path.write_text("".join(line(shot(i)) + "\n" for i in range(points)))

    def read() -> None:
        rows = [json.loads(text) for text in path.read_text().splitlines()]
        names = np.array([row[0] for row in rows])
        uv, sd = (np.concatenate([np.array(row[i], float) for row in rows]) for i in (3, 4))
        xyz, xyz_sd = (np.concatenate([np.array(row[i], float) for row in rows]) for i in (1, 2))
        Dataset("s", "mm", Observations(names, CAMERAS, uv, sd), KnownPositions(names, xyz, xyz_sd))

    def append() -> None:
        with path.open("a") as file:
            file.write(line(shot(points)) + "\n")
            file.flush()
            os.fsync(file.fileno())

    with Session.open(folder) as session:

        def commit() -> None:
            with session._database.transaction():
                insert_shot(session._database, shot(points + 100 + len(commits)), "{}")

        commits: list[float] = []
        while len(commits) < 20:
            commits.append(took(commit))
    return took(read), median(took(append) for _ in range(20)), median(commits)


def took(act: Callable[[], object]) -> float:
    """Seconds."""
    begin = time.perf_counter()
    act()
    return time.perf_counter() - begin


def main(points: int) -> None:
    with tempfile.TemporaryDirectory(dir=Path(__file__).parent) as place:  # on a disk, and not in memory
        folder = Path(place) / "s"
        filled(folder, points)
        opened, accepted, undone, logged = [], [], [], []
        for turn in range(5):
            begin = time.perf_counter()
            with Session.open(folder) as session:
                opened.append(time.perf_counter() - begin)
                one, two = shot(points + 2 * turn + 1), shot(points + 2 * turn + 2)
                accepted += [took(lambda p=p: session.accept(p)) for p in (one, two)]  # type: ignore[misc]
                logged += [took(lambda: session.log("x", seconds=1.0))]
                undone.append(took(session.undo))
        sizes = {p.name: p.stat().st_size / 1e6 for p in folder.iterdir() if p.is_file()}
        read, appended, committed = journal_instead(folder, points)
    print(f"{points} points, {len(CAMERAS)} cameras: " + ", ".join(f"{n} {s:.1f} MB" for n, s in sizes.items()))
    for what, seconds in (("open", opened), ("accept", accepted), ("undo", undone), ("log", logged)):
        print(f"{what:<8} median {median(seconds):.3f} s, longest {max(seconds):.3f} s")
    print(
        f"on disk  {committed * 1e3:.1f} ms a point, of the accepting; a journal of JSON lines {appended * 1e3:.1f} ms"
    )
    print(f"reading  a journal of JSON lines, and no tables: {read:.3f} s")
    print(f"memory   {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB at most")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10_000)
