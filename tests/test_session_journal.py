"""A session on disk: what was accepted is there after any kill, bit by bit; nobody else gets in; errors help."""

from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from implicam.dataset import Camera, Dataset, KnownPositions, Observations, join, read_dataset
from implicam.errors import DatasetError, ImageError, ImplicamError, UsageError
from implicam.images import read_picture
from implicam.session import Session, is_session
from implicam.session.folder import Tables

pytest.importorskip("cv2")

CAMERAS = (
    Camera("left, upper", 64, 48, {"serial": "A, 1"}),
    Camera("right", 64, 48),
    Camera("té st"),
)
NAN = float("nan")


def begin(folder: Path, **options: Any) -> Session:
    given = {"name": "my rig, 2", "length_unit": "mm", "cameras": CAMERAS, "settings": {}} | options
    return Session.create(folder, **given)


def shot(name: str, seed: int = 0, n: int = 1, extra: str = "", sd: bool = True) -> Dataset:
    """One ball (n = 1), or a board of n points; some views missing, awkward numbers."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform(0, 47, (n, 3, 2))
    uv[0, 0] = -0.0, 5e-324 * (1 + seed)  # a zero with a sign, and the smallest numbers; one pixel for all is a mark
    uv[rng.random((n, 3)) < 0.3] = NAN
    uv[0, 1] = 1 / 3 + seed % 400 / 7, 46.999999999999  # in the picture, however fast points are accepted
    stated = np.where(np.isnan(uv), NAN, rng.uniform(0.01, 1, uv.shape)) if sd else np.full(uv.shape, NAN)
    stated[0, 1, 0] = NAN
    points = np.array([name] if n == 1 else [f"{name} corner, {i}" for i in range(n)])
    seen = ~np.isnan(uv[..., 0])
    view_columns = {extra: np.where(seen, 'gr"een\n, 1', "")} if extra else {}
    point_columns = {extra: np.full(n, ["21.5", "", "é"][seed % 3])} if extra else {}
    xyz, xyz_sd = rng.normal(0, 1e3, (n, 3)), rng.uniform(0, 1, (n, 3))
    xyz[0, 0], xyz_sd[0, 1] = -0.0, NAN
    return Dataset(
        "anything",
        "mm",
        Observations(points, CAMERAS, uv, stated, view_columns),
        KnownPositions(np.full(n, name), xyz, xyz_sd, point_columns),
    )


def picture(seed: int, most: int = 255) -> np.ndarray:
    whole = np.random.default_rng(seed).integers(0, most + 1, (48, 64))
    return whole.astype(np.float32) * np.float32(1 / most)


def bits(array: np.ndarray) -> bytes:
    """The array's bits; a NaN is a NaN."""
    return np.where(np.isnan(array), NAN, array).tobytes()


def assert_same(a: Dataset | None, b: Dataset | None) -> None:
    assert (a is None) == (b is None)
    if a is None or b is None:
        return
    assert (a.name, a.length_unit, a.cameras) == (b.name, b.length_unit, b.cameras)
    assert [dict(c.extra) for c in a.cameras] == [dict(c.extra) for c in b.cameras]
    assert a.points.tolist() == b.points.tolist()
    assert a.shots.tolist() == b.shots.tolist()
    for x, y in (
        (a.observations.uv, b.observations.uv),
        (a.observations.sd, b.observations.sd),
        (a.positions.xyz, b.positions.xyz),
        (a.positions.sd, b.positions.sd),
    ):
        assert bits(x) == bits(y)
    for c, d in ((a.observations.extra, b.observations.extra), (a.positions.extra, b.positions.extra)):
        assert list(c) == list(d)
        assert all(c[key].tolist() == d[key].tolist() for key in c)


def files_of(folder: Path) -> Dataset | None:
    """What another program finds in the folder."""
    if not (folder / "observations.csv").exists():
        assert not (folder / "points.csv").exists()
        assert (folder / "dataset.toml").exists()
        return None
    return read_dataset(folder)


def expected(shots: list[Dataset]) -> Dataset | None:
    """The model: a plain list."""
    data = None
    for one in shots:
        data = join(data, one) if data else one
    return data and Dataset("my rig, 2", "mm", data.observations, data.known)


def refused(kind: type[ImplicamError], act: Callable[[], Any], *words: str) -> ImplicamError:
    with pytest.raises(kind) as caught:
        act()
    text = str(caught.value)
    assert type(caught.value) is kind
    assert caught.value.fix
    assert all(word in text for word in words), text
    return caught.value


# --- what goes in comes back -------------------------------------------------------------------------------------


def test_a_session_comes_back_as_it_was(tmp_path):
    folder = tmp_path / "a new" / "folder #1?"
    with begin(folder, settings={"target": "ball", "limits": (1, np.float64(2.5)), "threshold": None}) as session:
        assert session.data is None
        assert files_of(folder) is None
        assert session.next_name() == "p001"
        session.accept(shot("p001", 1), notes={"residual": np.float32(0.5), "views": 3})
        session.accept(shot("p002", 2, extra="colour, of lamp"))
        session.accept(shot("board 1, tilted", 3, n=7, sd=False))
        session.skip(np.array([1.5, -0.0, 3]), "behind the pillar, é")
        session.log("camera lost", camera="right", after=np.int64(3))
        session.set("threshold", 0.25)
        assert_same(session.data, expected([shot("p001", 1), shot("p002", 2, extra="colour, of lamp"),
                                            shot("board 1, tilted", 3, n=7, sd=False)]))  # fmt: skip
        before = session.data
    assert Session.read_settings(folder) == {"target": "ball", "limits": [1, 2.5], "threshold": 0.25}
    with Session.open(folder) as session:
        refused(UsageError, lambda: Session.read_settings(folder), "open elsewhere")
        assert (session.name, session.length_unit, session.cameras) == ("my rig, 2", "mm", CAMERAS)
        assert session.settings == {"target": "ball", "limits": [1, 2.5], "threshold": 0.25}
        assert_same(session.data, before)
        assert_same(files_of(folder), before)
        (skipped,), (event,) = session.skipped, session.events
        assert bits(skipped.xyz) == bits(np.array([1.5, -0.0, 3.0]))
        assert skipped.reason == "behind the pillar, é"
        assert (event.what, event.more) == ("camera lost", {"camera": "right", "after": 3})
        assert skipped.time <= event.time
        assert event.time.utcoffset() is not None


def test_tables_grow_by_rows_and_say_what_all_points_say(tmp_path, monkeypatch):
    """Only the rows of a new shot are written, unless it has other columns: the text is the same to the byte."""
    counted: list[int] = []
    plain = Tables.of

    def count(data, empty):
        counted.append(len(data))
        return plain(data, empty)

    shots = [shot("p001", 1, extra="a, b"), shot("p002", 2, extra="a, b"), shot("p003", 3, n=3, extra="a, b")]
    shots += [shot("p004", 4), shot("p005", 5, sd=False), shot("p006", 6, extra="lamp, é"), shot("p007", 7)]
    with begin(tmp_path / "s") as session:
        monkeypatch.setattr(Tables, "of", count)
        for one in shots:
            session.accept(one)
            assert session._tables.content == plain(session.data, session.data).content
            assert_same(files_of(tmp_path / "s"), session.data)
    # of each its own rows; and of the first, and of those with other columns (sd_y from p003 on), all rows
    assert counted == [1, 1, 1, 3, 5, 1, 6, 1, 7, 1, 8, 1, 9]


def test_people_can_read_the_database(tmp_path):
    with begin(tmp_path / "s", settings={"target": "ball"}) as session:
        session.accept(shot("p001", 1, extra="lamp"), notes={"by": "Ann"})
    with sqlite3.connect(tmp_path / "s" / "session.db") as db:
        assert db.execute("SELECT name, state, notes FROM shots").fetchall() == [("p001", "accepted", '{"by": "Ann"}')]
        x, sd_y = db.execute("SELECT y, sd_y FROM points WHERE point = 'p001'").fetchone()
        assert (x, sd_y) == (shot("p001", 1).xyz[0, 1], None)
        views = db.execute("SELECT camera, u, v, sd_u FROM views WHERE camera = 'right'").fetchall()
        assert views == [("right", 1 / 3 + 1 / 7, 46.999999999999, None)]
        assert db.execute("PRAGMA user_version").fetchone() == (1,)
    db.close()


@pytest.mark.parametrize("most", [255, 65535])
def test_pictures_come_back_bit_by_bit(tmp_path, most):
    taken = {"left, upper": picture(1, most), "right": picture(2, most)}
    with begin(tmp_path / "s") as session:
        session.accept(shot("p 1, a", 1), pictures=taken)
    for camera, grey in taken.items():
        assert read_picture(tmp_path / "s" / "images" / camera / "p 1, a.png").tobytes() == grey.tobytes()


def test_an_undone_point_is_kept_and_its_name_is_not_used_again(tmp_path):
    folder = tmp_path / "s"
    with begin(folder) as session:
        assert session.undo() is None
        session.accept(shot("p001", 1), pictures={"right": picture(1)})
        session.accept(shot("p002", 2, extra="lamp"), pictures={"right": picture(2)})
        assert session.undo() == "p002"
        assert_same(session.data, expected([shot("p001", 1)]))
        assert_same(files_of(folder), session.data)
        assert session.next_name() == "p003"
        refused(DatasetError, lambda: session.accept(shot("p002", 5)), "undone", "p003")
        assert session.undo() == "p001"
        assert session.data is None
        assert files_of(folder) is None
        assert session.undo() is None
    assert not list((folder / "images").rglob("*.png"))
    for name, seed in (("p001", 1), ("p002", 2)):
        assert read_picture(folder / "undone" / "right" / f"{name}.png").tobytes() == picture(seed).tobytes()
    with sqlite3.connect(folder / "session.db") as db:
        assert db.execute("SELECT name, state FROM shots").fetchall() == [("p001", "undone"), ("p002", "undone")]
        assert db.execute("SELECT count(*) FROM points").fetchone() == (2,)
    db.close()


def test_any_point_can_be_taken_back_and_its_pictures_are_found(tmp_path):
    folder = tmp_path / "s"
    with begin(folder) as session:
        for i in (1, 2, 3):
            session.accept(shot(f"p00{i}", i, n=i), pictures={"right": picture(i)})
        assert session.pictures_of("p002") == {"right": folder / "images" / "right" / "p002.png"}
        session.remove("p002")
        assert session.pictures_of("p002") == {}
        assert_same(session.data, expected([shot("p001", 1), shot("p003", 3, n=3)]))
        assert_same(files_of(folder), session.data)
        assert session.next_name() == "p004"
        for name in ("p002", "p009"):
            refused(UsageError, lambda name=name: session.remove(name), name)
        assert (folder / "undone" / "right" / "p002.png").exists()
    with Session.open(folder) as session:
        assert_same(session.data, expected([shot("p001", 1), shot("p003", 3, n=3)]))


STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("accept"), st.integers(1, 4), st.sampled_from(["", "lamp", "a, b"]), st.booleans()),
        st.tuples(st.just("undo")),
        st.tuples(st.just("remove"), st.integers(0, 20)),
        st.tuples(st.just("skip"), st.text(st.characters(exclude_categories=["Cs"]), max_size=20)),
        st.tuples(st.just("log"), st.dictionaries(st.sampled_from("abc"), st.floats(allow_nan=False) | st.text("é, ")))
        | st.tuples(st.just("set"), st.sampled_from("kl"), st.none() | st.integers() | st.lists(st.booleans())),
        st.tuples(st.just("reopen")),
    ),
    max_size=12,
)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(STEPS)
def test_any_sequence_does_as_a_list_does(steps):
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "s"
        session = begin(folder)
        shots: list[Dataset] = []
        used: list[str] = []
        skipped: list[str] = []
        events: list[dict[str, Any]] = []
        kept: dict[str, Any] = {}
        for step in steps:
            if step[0] == "accept":
                name = session.next_name()
                assert name not in used
                used.append(name)
                shots.append(shot(name, len(used), n=step[1], extra=step[2], sd=step[3]))
                session.accept(shots[-1])
            elif step[0] == "undo":
                assert session.undo() == (str(shots.pop().shots[0]) if shots else None)
            elif step[0] == "remove" and shots:
                session.remove(str(shots.pop(step[1] % len(shots)).shots[0]))
            elif step[0] == "remove":
                continue
            elif step[0] == "skip":
                skipped.append(step[1])
                session.skip(np.array([len(skipped), 0.1, -1e300]), step[1])
            elif step[0] == "log":
                events.append(step[1])
                session.log("something", **step[1])
            elif step[0] == "set":
                kept[step[1]] = step[2]
                session.set(step[1], step[2])
            else:
                session.close()
                session = Session.open(folder)
            assert_same(session.data, expected(shots))
            assert_same(files_of(folder), session.data)
        assert [s.reason for s in session.skipped] == skipped
        assert [s.xyz.tolist() for s in session.skipped] == [[i + 1, 0.1, -1e300] for i in range(len(skipped))]
        assert [e.more for e in session.events] == events
        assert session.settings == kept
        session.close()


def test_many_threads_lose_nothing(tmp_path):
    with begin(tmp_path / "s") as session:

        def work(k: int) -> None:
            for i in range(5):
                session.accept(shot(f"t{k}-{i}", 10 * k + i))
                session.log("done", k=k, i=i)
                session.skip(np.zeros(3), f"{k} {i}")

        threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert session.data is not None
        assert sorted(session.data.points.tolist()) == sorted(f"t{k}-{i}" for k in range(4) for i in range(5))
        assert len(session.events) == len(session.skipped) == 20
        order = session.data.points.tolist()
        assert all(order.index(f"t{k}-{i}") < order.index(f"t{k}-{i + 1}") for k in range(4) for i in range(4))
        for i, name in enumerate(order):
            k, j = map(int, name[1:].split("-"))
            assert_same(session.data.select([i]), expected([shot(name, 10 * k + j)]))
        assert_same(files_of(tmp_path / "s"), session.data)


# --- kill -9 -----------------------------------------------------------------------------------------------------

HERE = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\nfrom test_session_journal import *\n"
HERE += "import os, shutil, signal\nfrom implicam.session import is_session\n"


def child(code: str, *arguments: object) -> subprocess.Popen[str]:
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-c", HERE + code, *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)


ACCEPTING = """
with Session.open(Path(sys.argv[1])) as session:
    print("open", flush=True)
    while True:
        name = session.next_name()
        seed = int(name[1:])
        session.accept(shot(name, seed, n=1 + seed % 3), pictures={"right": picture(seed), "té st": picture(seed)})
        print(name, flush=True)
        if seed % 5 == 0:
            print("-" + session.undo(), flush=True)
"""


def assert_whole(session: Session) -> None:
    """Files and pictures say what the session says, each point is as it was given, and no rubbish is left."""
    folder = session.folder
    assert_same(files_of(folder), session.data)
    names = list(dict.fromkeys(session.data.shots.tolist())) if session.data else []
    assert_same(session.data, expected([shot(n, int(n[1:]), n=1 + int(n[1:]) % 3) for n in names]))
    for camera in ("right", "té st"):
        assert sorted(p.name for p in (folder / "images" / camera).iterdir()) == sorted(f"{n}.png" for n in names)
        for name in names[-3:]:
            grey = read_picture(folder / "images" / camera / f"{name}.png")
            assert grey.tobytes() == picture(int(name[1:])).tobytes()
    tops = {"session.db", "session.db-journal", "dataset.toml", "points.csv", "observations.csv", "images", "undone"}
    assert {p.name for p in folder.iterdir()} <= tops


KILLS = 60


@pytest.mark.slow
def test_every_point_that_was_accepted_survives_kill_9(tmp_path):
    folder, rng = tmp_path / "s", np.random.default_rng(7)
    begin(folder).close()
    (folder / "images" / "right").mkdir(parents=True)
    (folder / "images" / "té st").mkdir()
    accepted: list[str] = []
    for _ in range(KILLS):
        with child(ACCEPTING, folder) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "open\n"
            refused(UsageError, lambda: Session.open(folder), "open elsewhere")
            refused(UsageError, lambda: begin(folder), "already")
            timer = threading.Timer(rng.uniform(0.0, 0.4), process.send_signal, [signal.SIGKILL])
            timer.start()
            lines = process.stdout.read().splitlines()
            timer.join()
        assert process.returncode == -signal.SIGKILL
        for line in lines:
            if line.startswith("-"):
                assert accepted.pop() == line[1:]
            else:
                accepted.append(line)
        with Session.open(folder) as session:
            names = list(dict.fromkeys(session.data.shots.tolist())) if session.data else []
            # the kill may fall after a step is on disk, and before its line is out: one more, or one undone
            more = names == [*accepted, *names[-1:]] and len(names) == len(accepted) + 1
            undone = bool(accepted) and int(accepted[-1][1:]) % 5 == 0 and names == accepted[:-1]
            assert names == accepted or more or undone
            accepted = names
            assert_whole(session)
    assert len(accepted) > 5


STEPPED = """
import implicam.files, implicam.session.database as database

def dying(function):
    def wrapped(*args, **kwargs):
        step()
        return function(*args, **kwargs)
    return wrapped

def step():
    global left
    left -= 1
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)

for where, name in ((Path, "replace"), (Path, "rename"), (Path, "unlink"), (Path, "write_text"), (Path, "write_bytes"),
                    (Path, "mkdir"), (implicam.files, "_flush"), (database.Database, "rows")):
    setattr(where, name, dying(getattr(where, name)))

def forked(act, at):
    global left
    if not (pid := os.fork()):
        left = at
        act()
        os._exit(0)
    return os.WIFSIGNALED(os.waitpid(pid, 0)[1])

left, at, died, seen = 0, 0, True, set()
master, start = Path(sys.argv[1]), sys.argv[2]
while died:
    at += 1
    folder = master.with_name(f"{start}{at}")
    if start == "create":
        died = forked(lambda: begin(folder).close(), at)
        session = Session.open(folder) if is_session(folder) else begin(folder)
        session.accept(shot("p001", 1, n=2), pictures={"right": picture(1), "té st": picture(1)})
        assert session.name == "my rig, 2"
    else:
        shutil.copytree(master, folder)
        def act():
            session = Session.open(folder)
            if start == "undo":
                session.undo()
            elif start == "remove":
                session.remove("p001")
            else:
                session.accept(shot("p003", 3), pictures={"right": picture(3), "té st": picture(3)})
        died = forked(act, at)
        session = Session.open(folder)
        seen.add(len(set(session.data.shots.tolist())))
        events = [e.what for e in session.events]
        assert set(events) <= {"interrupted"}, events
        assert_whole(session)
        session.accept(shot("p009", 9), pictures={"right": picture(9), "té st": picture(9)})
    assert_whole(session)
    session.close()
    shutil.rmtree(folder)
print(at, sorted(seen))
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("start", "sizes", "fewest"),
    [("accept", [2, 3], 40), ("undo", [1, 2], 25), ("remove", [1, 2], 25), ("create", [], 20)],
)
def test_a_kill_between_any_two_steps_is_healed(tmp_path, start, sizes, fewest):
    """Every statement to SQLite, and every file written, flushed or renamed is a step."""
    with begin(tmp_path / "s") as session:
        for name in ("p001", "p002"):
            seed = int(name[1:])
            session.accept(shot(name, seed, n=1 + seed), pictures={c: picture(seed) for c in ("right", "té st")})
    with child(STEPPED, tmp_path / "s", start) as process:
        out, _ = process.communicate()
    assert process.returncode == 0
    steps, seen = out.split(maxsplit=1)
    assert int(steps) > fewest
    assert seen.strip() == str(sizes)


def test_a_table_edited_by_hand_is_kept_beside(tmp_path):
    folder = tmp_path / "s"
    with begin(folder) as session:
        session.accept(shot("p001", 1))
        right = session.data
    edited = (folder / "points.csv").read_text().replace("p001", "mine")
    (folder / "points.csv").write_text(edited)
    (folder / "observations.csv").unlink()
    with Session.open(folder) as session:
        assert_same(session.data, right)
        assert_same(files_of(folder), right)
    assert [p.name for p in (folder / "undone").iterdir()] == ["points.csv"]
    assert (folder / "undone" / "points.csv").read_text() == edited
    Session.open(folder).close()
    assert [p.name for p in (folder / "undone").iterdir()] == ["points.csv"]


# --- who may open it ---------------------------------------------------------------------------------------------


def test_reading_the_folder_does_not_lose_the_lock(tmp_path):
    """On Unix, closing any file handle to session.db would free a lock of the whole process."""
    folder = tmp_path / "s"
    with begin(folder) as session:
        session.accept(shot("p001", 1))
        assert is_session(folder)
        read_dataset(folder)
        refused(UsageError, lambda: Session.open(folder), "open elsewhere")
        with child("refused(UsageError, lambda: Session.open(Path(sys.argv[1])))", folder) as process:
            pass
        assert process.returncode == 0
        session.accept(shot("p002", 2))
    for act in (session.undo, lambda: session.log("x"), lambda: session.accept(shot("p003")), session.next_name):
        refused(UsageError, act, "closed")
    session.close()
    with Session.open(folder) as again:
        assert again.data is not None
        assert again.data.points.tolist() == ["p001", "p002"]


def test_a_session_begins_in_an_empty_folder_only(tmp_path):
    folder = tmp_path / "s"
    folder.mkdir()
    assert not is_session(folder)
    (folder / "session.db").touch()  # a kill while it began
    assert not is_session(folder)
    refused(DatasetError, lambda: Session.open(folder), "is empty", "begin again")
    begin(folder).close()
    assert is_session(folder)
    refused(UsageError, lambda: begin(folder), "already")
    other = tmp_path / "mine"
    other.mkdir()
    (other / "thesis.txt").write_text("years")
    refused(UsageError, lambda: begin(other), "thesis.txt")
    assert [p.name for p in other.iterdir()] == ["thesis.txt"]
    refused(ImplicamError, lambda: begin(other / "thesis.txt" / "s"), "thesis.txt")
    refused(DatasetError, lambda: Session.open(tmp_path / "nowhere"), "no session")
    refused(DatasetError, lambda: begin(tmp_path / "n", cameras=()))
    refused(DatasetError, lambda: begin(tmp_path / "n", length_unit=""))
    refused(UsageError, lambda: begin(tmp_path / "n", settings={"a": object()}), "'a'")
    assert not (tmp_path / "n").exists()


# --- what is damaged, and what fails -------------------------------------------------------------------------------


def _cut(db: Path) -> None:
    os.truncate(db, db.stat().st_size // 2 // 4096 * 4096)


def _cut_in_a_page(db: Path) -> None:
    os.truncate(db, db.stat().st_size - 1000)


def _as_text(db: Path) -> None:
    db.write_text("my notes of the session\n" * 400)


def _scrambled(db: Path) -> None:
    content = bytearray(db.read_bytes())
    content[4096:] = np.random.default_rng(0).bytes(len(content) - 4096)
    db.write_bytes(content)


def _page_that_is_not_read(db: Path) -> None:
    connection = sqlite3.connect(db)
    ((page,),) = connection.execute("SELECT rootpage FROM sqlite_master WHERE name = 'events'")
    connection.close()
    content = bytearray(db.read_bytes())
    content[4096 * (page - 1) : 4096 * page] = b"?" * 4096
    db.write_bytes(content)


def _sql(*statements: str) -> Callable[[Path], None]:
    def change(db: Path) -> None:
        connection = sqlite3.connect(db)
        for statement in statements:
            connection.execute(statement)
        connection.commit()
        connection.close()

    return change


def test_an_event_that_cannot_be_read_is_named(tmp_path):
    folder = tmp_path / "s"
    with begin(folder) as session:
        session.log("x")
        session.skip([1, 2, 3], "y")
    _sql("UPDATE events SET more = '{'", "UPDATE skipped SET x = 'one'")(folder / "session.db")
    with Session.open(folder) as session:
        refused(DatasetError, lambda: session.events, "damaged")
        refused(DatasetError, lambda: session.skipped, "damaged")


def _foreign(db: Path) -> None:
    db.unlink()
    _sql("CREATE TABLE shots (name TEXT)", "PRAGMA user_version = 1")(db)


DAMAGE = [
    (_cut, "damaged"),
    (_cut_in_a_page, "damaged"),
    (_as_text, "damaged"),
    (_scrambled, "damaged"),
    (_page_that_is_not_read, "damaged"),
    (_foreign, "another program"),
    (_sql("PRAGMA user_version = 2"), "newer implicam"),
    (_sql("DROP TABLE views"), "damaged"),
    (_sql("DELETE FROM session"), "damaged"),
    (_sql("DELETE FROM cameras"), "damaged"),
    (_sql("UPDATE points SET x = 'three'"), "damaged"),
    (_sql("UPDATE points SET x = NULL"), "damaged"),
    (_sql("UPDATE points SET more = '{'"), "damaged"),
    (_sql("UPDATE points SET more = '[1]'"), "damaged"),
    (_sql("UPDATE views SET camera = 'nobody' WHERE camera = 'right'"), "damaged"),
    (_sql("UPDATE views SET u = 1e9"), "damaged"),
    (_sql("UPDATE views SET more = NULL"), "damaged"),
    (_sql("UPDATE cameras SET more = 'a = '"), "damaged"),
    (_sql("UPDATE cameras SET more = NULL"), "damaged"),
    (_sql("DELETE FROM points WHERE shot = 'p1'"), "damaged"),
    (_sql("DELETE FROM views WHERE shot = 'p1'"), "damaged"),
    (_sql("INSERT INTO settings VALUES ('k', '" + "[" * 100_000 + "', '')"), "damaged"),
    (_sql("UPDATE shots SET name = x'00ff' WHERE number = 2"), "damaged"),
]


@pytest.mark.parametrize(("damage", "word"), DAMAGE)
def test_a_damaged_database_is_named_and_nothing_is_lost(tmp_path, damage, word):
    folder = tmp_path / "s"
    with begin(folder) as session:
        for i in range(3):
            session.accept(shot(f"p{i}", i, n=9), pictures={"right": picture(i)})
        right = session.data
    damage(folder / "session.db")
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file() and p.name != "session.db"}
    damaged = (folder / "session.db").read_bytes()
    error = refused(DatasetError, lambda: Session.open(folder), word, "session.db")
    assert error.why
    after = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file() and p.name != "session.db"}
    assert after == before
    assert_same(files_of(folder), right)
    if word != "damaged" or damage in (_cut, _cut_in_a_page, _as_text, _scrambled):
        assert (folder / "session.db").read_bytes() == damaged


FULL = """
limit, folder = int(sys.argv[2]), Path(sys.argv[1])
with Session.open(folder) as session:
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
    try:
        for i in range(2, 400):
            session.accept(shot(f"p{i:03d}", i, n=1 + i % 3), pictures={"right": picture(i), "té st": picture(i)})
    except ImplicamError as error:
        assert type(error) is ImplicamError and error.why and "free space" in error.fix, error
        failed = i
    before = session.data
    assert len(set(before.shots.tolist())) == failed - 1
    assert_same(files_of(folder), before)
    for act in (lambda: session.log("x", text="y" * 100_000), lambda: session.skip([0, 0, 0], "y" * 100_000)):
        refused(ImplicamError, act, "free space")
    assert not session.events and not session.skipped
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    session.accept(shot(f"p{failed:03d}", failed, n=1 + failed % 3),
                   pictures={"right": picture(failed), "té st": picture(failed)})
    assert_whole(session)
    print(failed)
"""


@pytest.mark.parametrize("limit", [1_000, 90_000])
def test_a_full_disk_refuses_the_point_and_keeps_the_others(tmp_path, limit):
    """A limit on the size of files stands for the disk: the tables meet it first, or the database does."""
    folder = tmp_path / "s"
    with begin(folder) as session:
        session.accept(shot("p001", 1, n=2), pictures={"right": picture(1), "té st": picture(1)})
        assert limit < 50_000 or (folder / "session.db").stat().st_size < limit
    with child("import resource\n" + FULL, folder, limit) as process:
        out, _ = process.communicate()
    assert process.returncode == 0, out
    with Session.open(folder) as session:
        assert_whole(session)


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    folder = tmp_path / "s"
    with begin(folder) as session:
        session.accept(shot("p001", 1))
    code = 'refused(ImplicamError, lambda: Session.open(Path(sys.argv[1])), "permissions")'
    if os.geteuid() == 0:  # whom no permission stops
        code = "os.setgroups([]); os.setegid(65534); os.seteuid(65534)\n" + code
        for place in [tmp_path, *tmp_path.parents[:3]]:
            if place.stat().st_uid == 0 and str(place).startswith(tempfile.gettempdir() + "/"):
                place.chmod(0o755)
    folder.chmod(0o555)
    (folder / "session.db").chmod(0o666)  # the file could be written, but no journal beside it
    with child(code, folder) as process:
        pass
    folder.chmod(0o755)
    assert process.returncode == 0
    with Session.open(folder) as session:
        assert_same(session.data, expected([shot("p001", 1)]))


@pytest.mark.parametrize("cleans_up", [True, False])
def test_pictures_that_fail_leave_no_point(tmp_path, monkeypatch, cleans_up):
    folder = tmp_path / "s"
    from implicam.session import folder as files

    write = files.write_picture

    def failing(path: Path, grey: np.ndarray, *, bits: int) -> None:
        if path.parent.name == "right":
            raise ImplicamError("cannot write", fix="make room")
        write(path, grey, bits=bits)

    with begin(folder) as session:
        session.accept(shot("p001", 1))
        monkeypatch.setattr(files, "write_picture", failing)
        if not cleans_up:
            monkeypatch.setattr(files, "set_pictures_aside", lambda *_: failing(Path("right/x"), picture(0), bits=8))
        both = {"left, upper": picture(1), "right": picture(2)}
        refused(ImplicamError, lambda: session.accept(shot("p002", 2), pictures=both), "cannot write")
        monkeypatch.undo()
        assert session.next_name() == "p002"
        session.accept(shot("p002", 2), pictures={"right": picture(3)})
        assert_same(session.data, expected([shot("p001", 1), shot("p002", 2)]))
        # the picture of the first try belongs to no point
        assert [p.relative_to(folder).as_posix() for p in (folder / "images").rglob("*.png")] == [
            "images/right/p002.png"
        ]
        assert (folder / "undone" / "left, upper" / "p002.png").exists()


def test_files_that_fail_after_the_commit_do_not_refuse_the_point(tmp_path, monkeypatch):
    folder = tmp_path / "s"
    with begin(folder) as session:
        session.accept(shot("p001", 1))
        with monkeypatch.context() as patch:

            def refuse(*_: object) -> None:
                raise OSError("no such luck")

            patch.setattr(Path, "replace", refuse)
            session.accept(shot("p002", 2))
        assert session.data is not None
        assert len(session.data) == 2
        assert [e.what for e in session.events] == ["files"]
        assert "no such luck" in session.events[0].more["problem"]
    with Session.open(folder) as session:
        assert_same(session.data, expected([shot("p001", 1), shot("p002", 2)]))
        assert_same(files_of(folder), session.data)


def _with(data: Dataset, **changes: Any) -> Dataset:
    seen, known = data.observations, data.positions
    given = {"cameras": CAMERAS, "uv": seen.uv, "shots": known.shots, "extra": {}} | changes
    observations = Observations(
        seen.points, given["cameras"], given["uv"], seen.sd[:, : len(given["cameras"])], given["extra"]
    )
    return Dataset("x", "mm", observations, KnownPositions(given["shots"], known.xyz, known.sd))


def test_what_does_not_fit_is_refused_and_nothing_is_written(tmp_path):
    folder = tmp_path / "s"
    good = shot("p002", 2)
    other = (Camera("left, upper", 640, 480), *CAMERAS[1:])
    with begin(folder) as session:
        session.accept(shot("p001", 1))
        before = {p: p.read_bytes() for p in folder.rglob("*.*") if p.name != "session.db-journal"}
        bad: list[tuple[type[ImplicamError], Callable[[], Any], str]] = [
            (DatasetError, lambda: session.accept(shot("p001", 3)), "accepted"),
            (DatasetError, lambda: session.accept(Dataset("x", "mm", good.observations)), "no known positions"),
            (DatasetError, lambda: session.accept(replace(good, length_unit="m")), "'m'"),
            (DatasetError, lambda: session.accept(join(shot("a"), shot("b"))), "2 shots"),
            (DatasetError, lambda: session.accept(_with(good, shots=np.array(["../p"]))), "name a file"),
            (DatasetError, lambda: session.accept(_with(good, shots=np.array(["é" * 150]))), "200 bytes"),
            (DatasetError, lambda: session.accept(_with(good, uv=np.full((1, 3, 2), NAN))), "no camera"),
            (DatasetError, lambda: session.accept(good.with_cameras(["right"])), "left, upper"),
            (DatasetError, lambda: session.accept(_with(good, cameras=other)), "640 x 480"),
            (DatasetError, lambda: session.accept(_with(shot("p001", 1), shots=np.array(["new"]))), "twice"),
            (DatasetError, lambda: session.accept(good, pictures={"rigth": picture(1)}), "rigth"),
            (ImageError, lambda: session.accept(good, pictures={"right": picture(1)[:40]}), "64 x 40"),
            (ImageError, lambda: session.accept(good, pictures={"right": np.zeros((48, 64, 3), np.float32)}), "grey"),
            (ImageError, lambda: session.accept(good, pictures={"right": picture(1) * np.float32(NAN)}), "grey"),
            (UsageError, lambda: session.accept(good, notes={"by": object()}), "note"),
            (UsageError, lambda: session.accept(good, notes={"by": "\ud800"}), "note"),
            (UsageError, lambda: session.skip(np.array([0.0, NAN, 0.0]), "x"), "position"),
            (UsageError, lambda: session.skip(np.zeros(2), "x"), "position"),
            (UsageError, lambda: session.skip(np.zeros(3), "half \ud800"), "text"),
            (UsageError, lambda: session.log("x", by={1, 2}), "'x'"),
            (UsageError, lambda: session.set("k", object()), "'k'"),
        ]
        unseen = np.isnan(good.observations.uv[..., 0])
        if unseen.any():  # a column's text of a view that is missing has no place in observations.csv
            column = {"lamp": np.where(unseen, "on", "")}
            bad.append((DatasetError, lambda: session.accept(_with(good, extra=column)), "missing"))
        for kind, act, word in bad:
            refused(kind, act, word)
        assert_same(session.data, expected([shot("p001", 1)]))
        assert not session.events
        assert not session.skipped
        after = {p: p.read_bytes() for p in folder.rglob("*.*") if p.name not in ("session.db-journal", "session.db")}
        assert after == {p: content for p, content in before.items() if p.name != "session.db"}
        session.accept(good)
