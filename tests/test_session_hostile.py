"""Session folders of others: what they name is not opened unasked, nothing inside is run, and reading them ends."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from command_line import Cli, cli  # noqa: F401  a fixture
from implicam.addresses import HIDDEN, without_secrets
from implicam.dataset import Camera, Dataset, KnownPositions, Observations, read_dataset
from implicam.errors import DatasetError, ImplicamError, UsageError
from implicam.hardware import CAMERAS, TRIGGERS, genicam
from implicam.session import Session, database
from implicam.session.setup import Setup, open_session
from implicam.session.trust import check_nothing_native

pytestmark = pytest.mark.usefixtures("looks_kept")

WORKSPACE = "0:100,0:100,0:100"
UR = Setup(cameras=(("left", "0"),), robot="ur:192.0.2.7", workspace=WORKSPACE, speed=0.2)


@pytest.fixture(autouse=True)
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine on which nothing was confirmed yet."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "state"


def from_elsewhere(folder: Path, setup: Setup, **settings: Any) -> Path:
    """A session as somebody else's machine made it: nothing of it is remembered here."""
    names = [name for name, _ in setup.cameras] or ["cam1", "cam2"]
    cameras = [Camera(name, 64, 48) for name in names]
    Session.create(
        folder, name="s", length_unit=setup.unit, cameras=cameras, settings=setup.as_settings() | settings
    ).close()
    return folder


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is opened, which is only a list here."""
    found: list[str] = []
    for kind, name in ((genicam.GenICamCamera, "genicam"), (CAMERAS["opencv"], "opencv"), (TRIGGERS["udp"], "trigger")):
        monkeypatch.setattr(kind, "open", lambda self, name=name: found.append(name))
    from implicam.hardware.ur import URRobot

    monkeypatch.setattr(URRobot, "open", lambda self: found.append("ur"))
    monkeypatch.setattr(URRobot, "close", lambda self: None)
    return found


# equipment


def test_equipment_from_elsewhere_is_shown_and_not_opened(tmp_path: Path, opened: list[str]) -> None:
    """cases/session-runs-native-code."""
    folder = from_elsewhere(tmp_path / "s", UR)
    with pytest.raises(UsageError, match="nobody has confirmed on this machine") as told:
        open_session(folder, None)
    for part in ("--camera left=0", "--robot ur:192.0.2.7", "--speed=0.2", f"--workspace={WORKSPACE}"):
        assert part in told.value.why
    assert "--trust" in told.value.fix
    assert opened == []
    open_session(folder, None, trust=True).close()
    assert opened.count("ur") == 1
    open_session(folder, None).close()  # it is remembered
    moved = folder.rename(tmp_path / "moved")
    with pytest.raises(UsageError, match="nobody has confirmed"):  # another folder
        open_session(moved, None)
    moved.rename(folder)
    with Session.open(folder) as session:  # the same one, exchanged for another while nobody looked
        session.set("speed", 0.25)
    with pytest.raises(UsageError, match=r"nobody has confirmed[\s\S]*--speed=0.25"):
        open_session(folder, None)
    assert opened.count("ur") == 2


def test_what_is_named_again_needs_no_other_word_and_the_rest_does(tmp_path: Path, opened: list[str]) -> None:
    folder = from_elsewhere(tmp_path / "s", UR)
    for named in (["cameras"], ["robot"], ["cameras", "robot"], ["cameras", "robot", "workspace"]):
        with pytest.raises(UsageError, match="nobody has confirmed"):
            open_session(folder, UR, named=named)
    open_session(folder, UR, named=["cameras", "robot", "workspace", "speed"]).close()
    open_session(folder, None).close()
    another = replace(UR, robot="ur:192.0.2.8")
    open_session(folder, another, named=["robot"]).close()  # what was confirmed before stays so
    with Session.open(folder) as session:
        session.set("tool", [0, 0, 900])
    with pytest.raises(UsageError, match=r"nobody has confirmed[\s\S]*--tool=0.0,0.0,900.0"):
        open_session(folder, None)
    other = from_elsewhere(tmp_path / "t", UR)
    open_session(other, UR).close()  # in Python a whole setup is named
    assert opened.count("ur") == 4


def test_what_was_not_shown_is_not_confirmed(tmp_path: Path, opened: list[str]) -> None:
    """A box lies in wait until there is a robot."""
    hand = Setup(cameras=(("left", "0"),), workspace="0:9000,0:9000,0:9000")
    folder = from_elsewhere(tmp_path / "s", hand)
    open_session(folder, None, trust=True).close()
    with pytest.raises(UsageError, match=r"nobody has confirmed[\s\S]*--workspace=0:9000,0:9000,0:9000"):
        open_session(folder, replace(hand, robot="ur:192.0.2.7"), named=["robot"])
    open_session(from_elsewhere(tmp_path / "t", replace(UR, dry_run=True)), None, trust=True).close()
    with Session.open(tmp_path / "t") as session:
        session.set("dry_run", False)  # the value of one that was never said
    with pytest.raises(UsageError, match="nobody has confirmed"):
        open_session(tmp_path / "t", None)
    assert opened.count("ur") == 1  # in the dry run


def test_what_is_shown_cannot_hide_itself(tmp_path: Path) -> None:
    sly = Setup(cameras=(("left", "rtsp://h/x\x1b[2K\r\u202e0=left"),), workspace=WORKSPACE)
    with pytest.raises(UsageError) as told:
        open_session(from_elsewhere(tmp_path / "s", sly), None)
    assert "--camera left=rtsp://h/x\\x1b[2K\\r\\u202e0=left" in told.value.why


def test_a_session_that_was_begun_here_goes_on_without_a_word(tmp_path: Path, machine: Path) -> None:
    places = tmp_path / "places.csv"
    places.write_text("x,y,z\n0,0,0\n100,0,0\n0,100,0\n0,0,100\n")
    setup = Setup(rig="stereo", workspace=str(places))
    open_session(tmp_path / "s", setup).close()
    open_session(tmp_path / "s", None).close()
    (kept,) = (machine / "implicam" / "trusted").iterdir()
    assert json.loads(kept.read_text())["equipment"]["workspace"] == str(places)
    assert (kept.parent.stat().st_mode & 0o777) == 0o700


def test_a_simulated_rig_needs_no_trust_and_files_do(tmp_path: Path) -> None:
    open_session(from_elsewhere(tmp_path / "s", Setup(rig="stereo")), None).close()
    for i, setup in enumerate((Setup(rig="../RIG.toml"), Setup(rig="stereo", workspace="/home/u/secret.csv"))):
        with pytest.raises(UsageError, match="nobody has confirmed"):
            open_session(from_elsewhere(tmp_path / f"f{i}", setup), None)


def test_where_nothing_can_be_remembered_it_is_asked_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, opened: Any
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    folder = from_elsewhere(tmp_path / "s", UR)
    open_session(folder, None, trust=True).close()
    with pytest.raises(UsageError, match="nobody has confirmed"):
        open_session(folder, None)


def test_on_the_command_line(cli: Cli, tmp_path: Path, opened: list[str]) -> None:
    pytest.importorskip("starlette")
    from_elsewhere(tmp_path / "s", UR)
    for words in ([], ["--budget", "30"], ["--robot", "ur:192.0.2.7"]):
        ran = cli("acquire", "s", "--no-browser", *words)
        assert ran.code == 2
        assert "nobody has confirmed" in ran.err
        assert "--trust" in ran.err
    assert opened == []


# native code


@pytest.mark.parametrize("name", ["driver.cti", "driver.bin", "driver.cti ", "driver"])
@pytest.mark.parametrize("link", [False, True])
def test_nothing_native_inside_the_folder_is_loaded_whoever_trusts_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, opened: list[str], link: bool, name: str
) -> None:
    """cases/session-runs-native-code: genicam:1@shared-session/images/left/driver.cti."""
    monkeypatch.chdir(tmp_path)
    spec = f"genicam:1@shared-session/images/left/{name}"
    setup = Setup(cameras=(("left", spec),), workspace=WORKSPACE)
    folder = from_elsewhere(tmp_path / "shared-session", setup)
    library = folder / "images" / "left" / name
    library.parent.mkdir(parents=True)
    library.write_bytes(b"\x7fELF")
    if link:  # a name that is elsewhere, and leads into the folder
        (tmp_path / "link.cti").symlink_to(library)
        setup = Setup(cameras=(("left", "genicam:1@link.cti"),), workspace=WORKSPACE)
    for words in ({}, {"trust": True}):
        with pytest.raises(UsageError, match="is inside of the session's folder, and may be code"):
            open_session(folder, setup, **words)
    if not link:
        with pytest.raises(UsageError, match="is inside of the session's folder, and may be code"):
            open_session(folder, None, trust=True)
    assert opened == []


def test_pictures_films_and_cameras_by_number_are_no_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "s"
    (folder / "images" / "left").mkdir(parents=True)
    monkeypatch.chdir(folder)
    for name in ("left.avi", "places.csv"):
        (folder / name).write_bytes(b"x")
    for spec in (
        "0",
        "left.avi",
        "images/left",
        "opencv:left.avi",
        "/dev/video0,1280x800",
        "rtsp://h/x",
        "~nobody/x",
        "x" * 999,
    ):
        check_nothing_native(
            Path("."), {"cameras": [["left", spec]], "robot": "csv:places.csv", "trigger": ["udp://h:1"]}
        )


# passwords

SECRET = "tr0ub4dor"


def test_passwords_are_not_stored(tmp_path: Path, opened: list[str], machine: Path) -> None:
    specs = (
        ("left", f"rtsp://admin:{SECRET}@192.0.2.1/main"),
        ("right", f"http://192.0.2.2/cgi?user=joe&pwd={SECRET}"),
    )
    setup = Setup(cameras=specs, trigger=(f"udp://x:{SECRET}@192.0.2.3:4000",), workspace=WORKSPACE)
    folder = from_elsewhere(tmp_path / "s", setup)
    open_session(folder, setup).close()
    for path in [*folder.rglob("*"), *machine.rglob("*")]:
        assert path.is_dir() or SECRET.encode() not in path.read_bytes(), path
    with pytest.raises(UsageError, match="does not know the password of camera 'left'") as told:
        open_session(folder, None)
    assert f"--camera left=rtsp://{HIDDEN}@192.0.2.1/main --camera right=" in told.value.fix


def test_a_password_that_an_older_version_stored_is_wiped(tmp_path: Path, opened: list[str]) -> None:
    cameras = [["left", f"rtsp://admin:{SECRET}@192.0.2.1/main"]]
    folder = from_elsewhere(tmp_path / "s", Setup(cameras=(("left", "0"),), workspace=WORKSPACE), cameras=cameras)
    assert SECRET.encode() in (folder / "session.db").read_bytes()
    open_session(folder, None, trust=True).close()
    assert SECRET.encode() not in (folder / "session.db").read_bytes()


def test_the_log_has_no_password_and_no_token(cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["acquire", "s", "--no-browser", "--camera", f"left=rtsp://a:{SECRET}@127.0.0.1:9/x", "--token", SECRET]
    monkeypatch.setattr(sys, "argv", ["implicam", *words])
    pytest.importorskip("starlette")
    ran = cli(*words)
    assert ran.code in (1, 2)
    log = (tmp_path / "s" / "implicam.log").read_text()
    assert f"left=rtsp://{HIDDEN}@127.0.0.1:9/x" in log
    assert SECRET not in log + ran.err
    blank = f"two words {SECRET}"
    words = ["acquire", "s", "--no-browser", "--camera", f"left=rstp://a:{blank}@127.0.0.1:9/x"]  # an error quotes it
    monkeypatch.setattr(sys, "argv", ["implicam", *words])
    assert cli(*words).code == 2
    log = (tmp_path / "s" / "implicam.log").read_text()
    assert "names no camera" in log
    assert "ended by UsageError" in log
    assert SECRET not in log
    assert "two words" not in log


@pytest.mark.parametrize(
    ("spec", "kept"),
    [
        ("rtsp://u:p@ss@h:554/x", "rtsp://***@h:554/x"),
        ("rtsp://u:p/a@ss?w@h/x", "rtsp://***@h/x"),
        ("rtsp://u:p a\"s'\\s@h/x", "rtsp://***@h/x"),
        ("rtsp://h/user=admin_password=tl_channel=1.sdp", "rtsp://h/user=***"),
        ("opencv:rtsp://u:p@h/x", "opencv:rtsp://***@h/x"),
        ("vendor:u:p@h", "vendor:***@h"),
        *((same, same) for same in ("0", "/dev/video2", "http://h:80/a@b", "rtsp://[::1]:554/a", "person")),
        *((same, same) for same in ("genicam:00:11:1C@/opt/x.cti", "csv:places.csv", "udp://10.0.0.1:4000", "ur:h")),
        *((same, same) for same in ("/dev/video0,1280x800,MJPG,exposure=200,keyframe=1", "side=left/*.png")),
        ("http://h/x?api_key=a1&design=2&sid=9", "http://h/x?api_key=***&design=2&sid=***"),
    ],
)  # fmt: skip
def test_what_is_left_of_an_address(spec: str, kept: str) -> None:
    assert without_secrets(spec) == kept
    assert without_secrets(kept) == kept


# a database that is not ours


def _ours(folder: Path) -> Path:
    return from_elsewhere(folder, Setup(rig="stereo")) / "session.db"


ENDLESS = (
    "ALTER TABLE settings RENAME TO s0; CREATE VIEW settings AS WITH RECURSIVE r(key, value) AS "
    "(SELECT 'a', '1' UNION ALL SELECT key || 'x', '1' FROM r) SELECT key, value, '' AS time FROM r"
)


@pytest.mark.parametrize(
    "sql",
    [
        ENDLESS,  # cases/session-db-endless-view
        "CREATE VIEW v AS SELECT 1",
        "CREATE TRIGGER t AFTER UPDATE ON session BEGIN DELETE FROM points; END",
        "CREATE VIRTUAL TABLE f USING fts5(x)",
        "CREATE INDEX i ON points (x)",
        "CREATE TABLE more (x)",
        "ALTER TABLE points ADD COLUMN w GENERATED ALWAYS AS (x)",
        "ALTER TABLE session ADD COLUMN w DEFAULT 1",
        "DROP TABLE skipped",
        "PRAGMA journal_mode = WAL",
    ],
)
def test_a_database_with_anything_else_in_it_is_refused(tmp_path: Path, sql: str) -> None:
    db = _ours(tmp_path / "s")
    with sqlite3.connect(db) as connection:
        connection.executescript(sql)
    connection.close()
    before = db.read_bytes()
    with pytest.raises(DatasetError, match="is damaged, or is no session; nothing in its folder was changed") as told:
        Session.open(db.parent)
    assert "not as implicam makes them" in told.value.why or "journal" in told.value.why
    assert db.read_bytes() == before


def test_reading_has_an_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    db = _ours(tmp_path / "s")
    with sqlite3.connect(db) as connection:
        connection.executemany("INSERT INTO events (what) VALUES (?)", [("x" * 50,)] * 30_000)
    connection.close()
    Session.open(db.parent).close()
    monkeypatch.setattr(database, "MAX_OPENING_SECONDS", -1.0)
    with pytest.raises(DatasetError, match="reading it takes longer"):
        Session.open(db.parent)
    monkeypatch.undo()
    monkeypatch.setattr(database, "MAX_DATABASE_BYTES", db.stat().st_size - 1)
    with pytest.raises(DatasetError, match=r"it has [0-9,]+ bytes, and a session at most"):
        Session.open(db.parent)
    monkeypatch.undo()
    monkeypatch.setattr(database, "MAX_VALUE_BYTES", 1000)
    with sqlite3.connect(db) as connection:
        connection.execute("INSERT INTO settings VALUES ('k', ?, '')", [json.dumps("x" * 2000)])
    connection.close()
    with pytest.raises(DatasetError, match="too big"):
        Session.open(db.parent)


HOT = """
import os, signal, sqlite3, sys
c = sqlite3.connect(sys.argv[1], isolation_level=None)
c.execute("PRAGMA cache_size = 1")
c.execute("BEGIN")
for i in range(3000):
    c.execute("INSERT INTO events VALUES (NULL, 't', 'w', ?)", ("x" * 500,))
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no kill -9")
@pytest.mark.parametrize("hostile", [False, True])
def test_a_journal_that_names_another_file_is_refused(tmp_path: Path, hostile: bool) -> None:
    """SQLite deletes the file that a journal names as the one of several databases, once all is played back."""
    db = _ours(tmp_path / "s")
    thesis = tmp_path / "thesis.txt"
    thesis.write_text("three years")
    ended = subprocess.run([sys.executable, "-c", HOT, str(db)])
    assert ended.returncode == -signal.SIGKILL
    journal = db.with_name("session.db-journal")
    assert journal.stat().st_size > 0
    if not hostile:  # what a kill leaves is played back
        with Session.open(db.parent) as session:
            assert session.events == []
        return
    name = str(thesis).encode()
    page = 0x40000000 // 4096 + 1
    end = struct.pack(">I", page) + name + struct.pack(">II", len(name), sum(name)) + database._JOURNAL_MAGIC
    journal.write_bytes(journal.read_bytes() + end)
    with pytest.raises(DatasetError, match="names another file, which would be deleted"):
        Session.open(db.parent)
    assert thesis.read_text() == "three years"


@pytest.mark.parametrize(
    "sql",
    [
        "UPDATE cameras SET name = '../../../.ssh' WHERE number = 0",
        "INSERT INTO shots (name, state, time) VALUES ('../../x', 'undone', '')",
        "INSERT INTO shots (name, state, time) VALUES ('/etc/x', 'begun', '')",
    ],
)
def test_names_that_lead_out_of_the_folder_are_refused(tmp_path: Path, sql: str) -> None:
    db = _ours(tmp_path / "s")
    with sqlite3.connect(db) as connection:
        connection.execute(sql)
    connection.close()
    with pytest.raises(DatasetError, match=r"cannot name a (file|folder)"):
        Session.open(db.parent)


@pytest.mark.parametrize("place", ["images", "images/cam1", "undone", "undone/cam2"])
def test_pictures_elsewhere_are_not_moved(tmp_path: Path, place: str) -> None:
    """A shot that was only begun has its pictures moved to undone/: those of yours, where images/cam1 is a link."""
    db = _ours(tmp_path / "s")
    mine = tmp_path / "mine"
    (mine / "cam1").mkdir(parents=True)
    for name in ("IMG_1.png", "cam1/IMG_1.png", ".x.partial-1"):
        (mine / name).write_text("mine")
    with sqlite3.connect(db) as connection:
        connection.execute("INSERT INTO shots (name, state, time) VALUES ('IMG_1', 'begun', '')")
    connection.close()
    (db.parent / place).parent.mkdir(exist_ok=True)
    (db.parent / place).symlink_to(mine, target_is_directory=True)
    with pytest.raises(DatasetError, match="is a link to another folder"):
        Session.open(db.parent)
    assert sorted(path.name for path in mine.rglob("*")) == [".x.partial-1", "IMG_1.png", "IMG_1.png", "cam1"]
    (tmp_path / "link").symlink_to(_ours(tmp_path / "whole").parent, target_is_directory=True)
    Session.open(tmp_path / "link").close()


@pytest.mark.parametrize(
    ("sql", "why"),
    [
        ("UPDATE points SET point = ?", "more than 1000 characters"),  # an array of texts is as wide as its longest
        ("UPDATE views SET more = json_object('k', ?) WHERE rowid = 1", "more than 1000 characters"),
        ("UPDATE points SET more = NULL, x = length(?)", "damaged"),
    ],
)
def test_texts_that_would_fill_the_memory_are_refused(tmp_path: Path, sql: str, why: str) -> None:
    db = _ours(tmp_path / "s")
    with Session.open(db.parent) as session:
        uv = np.full((1, 2, 2), 7.0) + np.arange(2)[:, None]
        seen = Observations(np.array(["p001"]), session.cameras, uv, np.full((1, 2, 2), np.nan))
        known = KnownPositions(np.array(["p001"]), np.zeros((1, 3)), np.full((1, 3), np.nan))
        session.accept(Dataset("s", "mm", seen, known))
    with sqlite3.connect(db) as connection:
        connection.execute(sql, ["x" * 10**6])
        if "point =" in sql:
            connection.execute("UPDATE views SET point = ?", ["x" * 10**6])
    connection.close()
    with pytest.raises(DatasetError, match=why):
        Session.open(db.parent)


@pytest.mark.parametrize(
    "settings", [{"rig": 5}, {"workspace": ["x"]}, {"cameras": 3}, {"budget": "many"}, {"tool": 1}]
)
def test_settings_of_another_kind_are_told(tmp_path: Path, settings: dict[str, Any]) -> None:
    folder = from_elsewhere(tmp_path / "s", Setup(rig="stereo"), **settings)
    with pytest.raises(ImplicamError) as told:
        open_session(folder, None)
    assert told.value.fix


def test_files_beside_it_that_are_huge_or_links_are_not_read(cli: Cli, tmp_path: Path) -> None:
    folder = _ours(tmp_path / "s").parent
    (tmp_path / "bashrc").write_text("# mine\n")
    with (folder / "points.csv").open("wb") as file:
        file.truncate(10**12)  # takes no room on the disk
    Session.open(folder).close()
    (folder / "implicam.log").symlink_to(tmp_path / "bashrc")
    ran = cli("acquire", "s", "--unattended")
    assert (ran.code, "is a link to another file" in ran.err) == (2, True)
    assert (tmp_path / "bashrc").read_text() == "# mine\n"
    with pytest.raises(ImplicamError):
        read_dataset(folder)
    assert os.listdir(folder / "undone") == ["points.csv"]  # moved, not copied
