"""`implicam bugreport`: what helps is in it; pictures, passwords and names are not, however they are written."""

from __future__ import annotations

import json
import re
import sqlite3
import zipfile
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest

from command_line import Cli, cli  # noqa: F401  a fixture
from implicam.addresses import HIDDEN, only_hosts, secrets_of
from implicam.dataset import Camera, Dataset, KnownPositions, Observations
from implicam.errors import UsageError
from implicam.session import Session, bugreport
from implicam.session.bugreport import Packed, write_bugreport

CAMERAS = (Camera("left", 64, 48), Camera("right", 64, 48))


def begun(folder: Path, **settings: Any) -> Session:
    return Session.create(folder, name="s", length_unit="mm", cameras=CAMERAS, settings=settings)


def point(name: str = "p001") -> Dataset:
    known = KnownPositions(np.array([name]), np.array([[1.5, -2.25, 1234.5]]), np.full((1, 3), np.nan))
    uv = np.array([[[10.25, 20.5], [30.125, 1234.0 / 64]]])
    return Dataset("s", "mm", Observations(np.array([name]), CAMERAS, uv, np.full(uv.shape, 0.05)), known)


def contents(file: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(file) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def test_what_helps_is_in_it(cli: Cli, tmp_path: Path) -> None:
    with begun(tmp_path / "s", rig="stereo") as session:
        session.accept(point(), pictures={"left": np.full((48, 64), 0.5, np.float32)})
        session.log("trouble", what="the lamp went out")
        data = session.data
    (tmp_path / "s" / "implicam.log").write_text("found in 2 of 2 cameras\n")
    ran = cli("bugreport", "s")
    assert ran.code == 0
    found = contents(tmp_path / "s-bugreport.zip")
    assert set(found) == {
        "about.json", "dataset.toml", "files.txt", "implicam.log", "observations.csv", "points.csv", "session.db",
        "settings.json",
    }  # fmt: skip
    assert all(name in ran.out for name in found)
    assert "without pictures" in ran.err
    about = json.loads(found["about.json"])
    assert about["packages"]["numpy"] == np.__version__
    assert about["memory_mb"] > 100
    assert json.loads(found["settings.json"]) == {"rig": "stereo"}
    assert b"images/left/p001.png  (a picture, not packed)" in found["files.txt"]
    assert found["points.csv"] == (tmp_path / "s" / "points.csv").read_bytes()
    again = tmp_path / "again"
    again.mkdir()
    (again / "session.db").write_bytes(found["session.db"])
    with Session.open(again) as session:  # whoever helps opens it as it was
        assert session.data is not None
        assert data is not None
        assert session.data.xyz.tobytes() == data.xyz.tobytes()
        assert session.events[0].more == {"what": "the lamp went out"}


SECRETS = (
    "tr0ub4dor", "p@ss/w:rd?#x", 'quo"te\'s and blanks', "back\\slash-n\\n", "ümläut-€uro", "1234", "1234567890",
    "a%40b%2Fcde", "p001x", "[{(.*+?)}]$^", "-start", "&amp;x=y&z1234", "cam", "zip.PK-magic", "😀😀smile",
)  # fmt: skip


@pytest.mark.parametrize("secret", SECRETS)
def test_a_password_is_nowhere_in_it(tmp_path: Path, secret: str) -> None:
    """An older session stored them; a log, an event and a traceback quote them in all ways there are."""
    folder, user = tmp_path / "s", "joe.bloggs"
    spec, trigger = f"rtsp://{user}:{secret}@192.0.2.1:554/main", f"udp://{user}:{secret}@192.0.2.3:4000"
    key = "http://192.0.2.2/cgi?channel=1&pwd=" + quote(secret, safe="")
    cameras = [["left", spec], ["right", key]]
    with begun(folder, cameras=cameras, trigger=[trigger], robot=f"vendor:{user}:{secret}@h") as session:
        session.log(
            "unexpected", traceback=f"File x, line 3\n  open({spec!r})\nOSError: {json.dumps(spec)}: {secret} refused"
        )
        session.skip([0, 0, 0], f"the camera wants {secret}")
        session.accept(point(), notes={"reasons": {"left": f"cannot open {spec}"}})
    (folder / "implicam.log").write_text(
        f"acquire s --camera left={spec} --token {secret}\n{json.dumps(cameras)}\n{spec!r} {quote(spec)}\n"
        f"password={secret}\n--camera=right={key} cannot be opened: {quote(secret)}\n",
        encoding="utf-8",
    )
    packed = write_bugreport(folder, tmp_path / "b.zip")
    assert packed.left_out == []
    found = contents(tmp_path / "b.zip")
    assert found == packed.members
    everything = b"".join(found.values()) + (tmp_path / "b.zip").read_bytes()
    ways = {secret, quote(secret), quote(secret, safe=""), json.dumps(secret)[1:-1], repr(secret)[1:-1]}
    for way in ways:
        if way in ("1234", "cam"):  # as part of a number or a word it says nothing, and stands alone nowhere
            alone = rb"(?<![\w.])" + way.encode() + rb"(?![\w.])"
            assert not re.search(alone, everything)
        else:
            assert way.encode() not in everything, way
    assert user.encode() not in everything
    assert b"1234.5" in found["points.csv"]  # a number is no password
    assert b"192.0.2.1:554" in found["implicam.log"]
    assert b"192.0.2.3:4000" in found["settings.json"]


def test_names_of_the_user_are_not_in_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/jane")
    monkeypatch.setattr("getpass.getuser", lambda: "jane")
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "implicam.log").write_text("File /home/jane/lab/x.py\nFile /media/jane/disk/y.py\n")
    write_bugreport(tmp_path / "s", tmp_path / "b.zip")
    assert contents(tmp_path / "b.zip")["implicam.log"] == b"File ~/lab/x.py\nFile /media/~/disk/y.py\n"


def test_a_store_that_cannot_be_read_is_left_out_and_that_is_said(cli: Cli, tmp_path: Path) -> None:
    with begun(tmp_path / "s"):
        ran = cli("bugreport", "s", "-o", "open.zip")
    assert ran.code == 0
    assert "left out: session.db: the session in" in ran.err
    assert "open elsewhere" in ran.err
    assert "session.db" not in contents(tmp_path / "open.zip")
    assert "dataset.toml" in contents(tmp_path / "open.zip")
    with sqlite3.connect(tmp_path / "s" / "session.db") as db:
        db.execute("CREATE VIEW v AS SELECT 1")
    db.close()
    told = cli("bugreport", "s", "--json").json
    assert "not as implicam makes them" in told["left_out"][0]
    assert json.loads(contents(tmp_path / "s-bugreport.zip")["about.json"])["left_out"] == told["left_out"]


def test_what_is_no_folder_or_no_zip_is_said(cli: Cli, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="there is no folder"):
        write_bugreport(tmp_path / "nowhere", tmp_path / "b.zip")
    (tmp_path / "s").mkdir()
    ran = cli("bugreport", "s", "-o", "b.txt")
    assert (ran.code, "no name for a zip" in ran.err) == (2, True)
    assert write_bugreport(tmp_path / "s", tmp_path / "b.zip").members.keys() == {"about.json", "files.txt"}


def test_links_and_huge_files_are_not_packed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bugreport, "MAX_LOG_BYTES", 5_000)
    folder = tmp_path / "s"
    folder.mkdir()
    (tmp_path / "key").write_text("BEGIN PRIVATE KEY")
    (folder / "implicam.log.1").symlink_to(tmp_path / "key")
    with (folder / "points.csv").open("wb") as file:
        file.truncate(10**10)
    (folder / "implicam.log").write_bytes(b"x" * 6_000 + b"\nthe end\n")
    packed = write_bugreport(folder, tmp_path / "b.zip")
    assert isinstance(packed, Packed)
    assert set(packed.members) == {"about.json", "files.txt", "implicam.log"}
    assert packed.members["implicam.log"].endswith(b"the end\n")
    assert len(packed.members["implicam.log"]) == 5_000
    assert "points.csv: 10,000,000,000 bytes are too many" in packed.left_out


def test_addresses_in_a_text() -> None:
    assert (
        only_hosts("see rtsp://a:b@h:554/x?y, and http://[::1]:80/q.")
        == f"see rtsp://h:554/{HIDDEN} and http://[::1]:80/{HIDDEN}"
    )
    assert only_hosts("at http://127.0.0.1:8090?token=abc now") == f"at http://127.0.0.1:8090/{HIDDEN} now"
    assert only_hosts("rtsp://user:pa/ss@h/x") == f"rtsp://{HIDDEN}"
    assert only_hosts("udp://10.0.0.1:4000. Then") == "udp://10.0.0.1:4000. Then"
    assert secrets_of("x rtsp://TOKEN12@h/x y") == {"TOKEN12"}
    assert secrets_of("rtsp://u:with blank@h/x", whole=True) == {"u", "with blank"}
    assert secrets_of("no address, a@b.c") == set()
    only_hosts("a" * 20_000 + "_" * 20_000)  # and it ends
