"""The calibration file: what is saved measures the same for ever, and nothing damaged or hostile gets through."""

from __future__ import annotations

import hashlib
import io
import math
import os
import pickle
import random
import shutil
import struct
import subprocess
import sys
import tomllib
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from implicam import calibration_file
from implicam.calibration_file import ARRAYS, FORMAT_VERSION, FORMAT_WITHOUT_REPAIRS, TOML
from implicam.calibrators import ForwardGP, InverseGP, InverseGPCalibration, load_calibration
from implicam.dataset import Dataset, Observations, arrays_from_dataset, dataset_from_arrays
from implicam.errors import CalibrationFileError, ImplicamError
from implicam.files import npz_bytes, toml_text, write_zip
from implicam.measurement import Measurement
from implicam.simulate import build_rig, random_positions, simulate, simulated

REFERENCE = Path(__file__).parent / "data" / "v1-inverse-gp.implicam"
REFERENCE_PIXELS = [[600.0, 500.0, 620.0, 510.0], [700.0, 450.0, 640.0, 470.0], [np.nan, np.nan, 640.0, 470.0]]


def known_points() -> Dataset:
    """Twelve points, some not seen by one camera, with extra columns."""
    rig = build_rig("stereo", seed=3)
    return simulate(rig, random_positions(rig, 14, np.random.default_rng(3)), seed=3, missing=0.08)


@pytest.fixture(scope="module")
def original() -> InverseGPCalibration:
    return InverseGP().fit(known_points())


@pytest.fixture(scope="module")
def saved(original: InverseGPCalibration, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("saved") / "rig.implicam"
    original.save(path)
    return path


def asked(calibration: InverseGPCalibration) -> Measurement:
    return calibration.measure(calibration.data.observations)


def same(a: Measurement, b: Measurement) -> bool:
    return (
        np.array_equal(a.xyz, b.xyz, equal_nan=True)
        and np.array_equal(a.cov, b.cov, equal_nan=True)
        and a.reason.tolist() == b.reason.tolist()
        and a.points.tolist() == b.points.tolist()
    )


def fails(path: Path) -> CalibrationFileError:
    """The error of a file that must not load: of the right kind, clear, and naming the file."""
    with pytest.raises(CalibrationFileError) as caught:
        load_calibration(path)
    assert str(path) in caught.value.what
    assert caught.value.fix
    assert len(str(caught.value)) < 2000
    return caught.value


# --- what is saved is what was fitted ------------------------------------------------------------------------------


def test_round_trip(original: InverseGPCalibration, saved: Path) -> None:
    restored = load_calibration(saved)
    assert isinstance(restored, InverseGPCalibration)
    assert not original.data.observations.seen.all(), "the data must have missing views"
    assert original.data.observations.extra
    assert same(asked(original), asked(restored))
    assert restored.calibrator == original.calibrator
    assert restored.unused == original.unused
    assert restored.residuals == original.residuals
    a, b = arrays_from_dataset(original.data), arrays_from_dataset(restored.data)
    assert a.keys() == b.keys()
    assert all(x.dtype.kind == b[name].dtype.kind and x.tobytes() == b[name].tobytes() for name, x in a.items())


def test_saving_again_gives_the_same_bytes(original: InverseGPCalibration, saved: Path, tmp_path: Path) -> None:
    InverseGP().fit(known_points()).save(tmp_path / "again.implicam")
    assert (tmp_path / "again.implicam").read_bytes() == saved.read_bytes()
    load_calibration(saved).save(tmp_path / "loaded.implicam")
    assert (tmp_path / "loaded.implicam").read_bytes() == saved.read_bytes()
    original.save(tmp_path / "again.implicam")  # over an existing file
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["again.implicam", "loaded.implicam"]


def test_the_readable_part_says_what_formats_md_promises(original: InverseGPCalibration, saved: Path) -> None:
    with zipfile.ZipFile(saved) as archive:
        assert archive.namelist() == [TOML, ARRAYS]
        table = tomllib.loads(archive.read(TOML).decode())
        arrays = np.load(io.BytesIO(archive.read(ARRAYS)), allow_pickle=False)  # plain NumPy reads it
        assert np.array_equal(arrays["data/xyz"], original.data.xyz)
    assert table["method"] == "inverse-gp"
    assert table["length_unit"] == "mm"
    assert table["pixel_convention"].startswith("(u, v) = (column, row); (0, 0) is the centre")
    assert table["cameras"] == [{"name": c.name, "width": c.width, "height": c.height} for c in original.data.cameras]
    assert table["workspace"]["lowest"] == original.data.xyz.min(axis=0).tolist()
    assert table["workspace"]["highest"] == original.data.xyz.max(axis=0).tolist()
    assert set(table["versions"]) == {"implicam", "python", "numpy", "scipy"}
    assert table["residuals"] == original.residuals
    assert table["options"]["kernel"] == "squared-exponential"
    assert table["known_points"] == len(original.data)
    assert table["format_version"] == FORMAT_WITHOUT_REPAIRS
    assert calibration_file.describe(saved) == table


def test_a_directory_or_nothing(tmp_path: Path) -> None:
    assert "does not exist" in fails(tmp_path / "no.implicam").what
    (tmp_path / "dir.implicam").mkdir()
    assert "is a folder" in fails(tmp_path / "dir.implicam").what


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root reads everything")
def test_no_permission(saved: Path, tmp_path: Path) -> None:
    path = Path(shutil.copy(saved, tmp_path / "x.implicam"))
    path.chmod(0)
    assert "cannot be read" in fails(path).what


def test_a_place_that_cannot_be_written(original: InverseGPCalibration, tmp_path: Path) -> None:
    (tmp_path / "dir.implicam").mkdir()
    with pytest.raises(ImplicamError, match="is a folder, and a file is to be written"):
        original.save(tmp_path / "dir.implicam")
    (tmp_path / "file").write_text("")
    with pytest.raises(ImplicamError, match="cannot create the folder"):
        original.save(tmp_path / "file" / "x.implicam")


def test_a_file_of_format_1_measures_as_on_the_day_it_was_made() -> None:
    """Made once, by `python tests/test_calibration_file.py`; never again for format 1: it stands for users' files."""
    calibration = load_calibration(REFERENCE)
    uv = np.array(REFERENCE_PIXELS).reshape(-1, 2, 2)
    observations = Observations(np.array(["a", "b", "c"]), calibration.data.cameras, uv, np.full(uv.shape, np.nan))
    measured = calibration.measure(observations)
    expected = tomllib.loads(REFERENCE.with_suffix(".toml").read_text())
    np.testing.assert_allclose(measured.xyz[:2], expected["xyz"], rtol=0, atol=1e-6)
    np.testing.assert_allclose(measured.sd[:2], expected["sd"], rtol=1e-6)
    assert np.isnan(measured.xyz[2]).all()
    assert measured.reason[2] == expected["reason"]
    assert len(calibration.data) == 14


FORWARD = REFERENCE.with_name("v1-forward-gp.implicam")


@pytest.mark.parametrize("path", [FORWARD, REFERENCE.with_name("v1-forward-gp-none.implicam")], ids=lambda p: p.stem)
def test_a_forward_gp_file_of_format_1_measures_as_on_the_day_it_was_made(path: Path) -> None:
    calibration = load_calibration(path)
    expected = tomllib.loads(path.with_suffix(".toml").read_text())
    measured = calibration.measure(calibration.data.observations.select(np.arange(3)))
    np.testing.assert_allclose(measured.xyz, expected["xyz"], rtol=0, atol=1e-6)
    np.testing.assert_allclose(measured.sd, expected["sd"], rtol=1e-6)
    assert [str(view) for view in measured.reason] == expected["reasons"]
    assert calibration.rejected == ()


def make_forward_reference() -> None:
    """Write the reference file of forward-gp, with declared position errors, and what it measures."""
    rig = build_rig("stereo", seed=3)
    known = simulate(rig, random_positions(rig, 14, np.random.default_rng(3)), seed=3, robot_noise=0.1)
    calibration = ForwardGP().fit(known)
    calibration.save(FORWARD)
    m = calibration.measure(known.observations.select(np.arange(3)))
    numbers = {"xyz": m.xyz.tolist(), "sd": m.sd.tolist(), "reasons": [str(reason) for reason in m.reason]}
    FORWARD.with_suffix(".toml").write_text(toml_text(numbers))


def make_reference() -> None:
    """Write the reference file and what it measures."""
    REFERENCE.parent.mkdir(exist_ok=True)
    calibration = InverseGP().fit(known_points())
    calibration.save(REFERENCE)
    uv = np.array(REFERENCE_PIXELS).reshape(-1, 2, 2)
    observations = Observations(np.array(["a", "b", "c"]), calibration.data.cameras, uv, np.full(uv.shape, np.nan))
    m = calibration.measure(observations)
    numbers = {"xyz": m.xyz[:2].tolist(), "sd": m.sd[:2].tolist(), "reason": str(m.reason[2])}
    REFERENCE.with_suffix(".toml").write_text(toml_text(numbers))


# --- blind damage --------------------------------------------------------------------------------------------------

Change = Callable[[bytes, random.Random], bytes]


def flip_bits(b: bytes, rng: random.Random) -> bytes:
    data = bytearray(b)
    for _ in range(rng.choice([1, 1, 2, 8])):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(data)


def flip_bits_near_the_ends(b: bytes, rng: random.Random) -> bytes:
    data = bytearray(b)
    for _ in range(rng.choice([1, 2])):
        at = rng.randrange(300)
        data[at if rng.random() < 0.5 else -1 - at] ^= 1 << rng.randrange(8)
    return bytes(data)


def truncate(b: bytes, rng: random.Random) -> bytes:
    return b[: rng.randrange(len(b))]


def insert(b: bytes, rng: random.Random) -> bytes:
    at = rng.choice([0, len(b), rng.randrange(len(b))])
    return b[:at] + rng.randbytes(rng.choice([1, 7, 500])) + b[at:]


def delete(b: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(b))
    return b[:at] + b[at + rng.choice([1, 7, 500]) :]


def swap_blocks(b: bytes, rng: random.Random) -> bytes:
    i, j, k = sorted(rng.sample(range(len(b)), 3))
    return b[:i] + b[j:k] + b[i:j] + b[k:]


def repeat_block(b: bytes, rng: random.Random) -> bytes:
    i, j = sorted(rng.sample(range(len(b)), 2))
    return b[:j] + b[i:j] + b[j:]


def zero_block(b: bytes, rng: random.Random) -> bytes:
    i = rng.randrange(len(b))
    n = rng.choice([16, 512, 4096])
    return b[:i] + b"\0" * len(b[i : i + n]) + b[i + n :]


def edit_headers(b: bytes, rng: random.Random) -> bytes:
    """Random values in the fields of local headers, the central directory, and its end."""
    data = bytearray(b)
    signature = rng.choice([b"PK\3\4", b"PK\1\2", b"PK\5\6"])
    places = [i for i in range(len(b) - 50) if b[i : i + 4] == signature] or [b.rindex(b"PK\5\6")]
    at = rng.choice(places) + 4 + rng.randrange(40)
    value = rng.choice([b"\0\0", b"\xff\xff", b"\xff\xff\xff\xff", b"\1\0", b"\x0e\0", b"\x0c\0", rng.randbytes(2)])
    end = min(len(data), at + len(value))
    data[at:end] = value[: end - at]
    return bytes(data)


BLIND: list[Change] = [
    flip_bits, flip_bits_near_the_ends, truncate, insert, delete, swap_blocks, repeat_block, zero_block, edit_headers,
]  # fmt: skip


@pytest.mark.parametrize("change", BLIND, ids=lambda change: change.__name__)
def test_blind_damage(change: Change, original: InverseGPCalibration, saved: Path, tmp_path: Path) -> None:
    """Refused, or read as if nothing had happened; never anything in between."""
    good, expected = saved.read_bytes(), asked(original)
    rng = random.Random(change.__name__)
    path = tmp_path / "damaged.implicam"
    loaded = 0
    for _ in range(400):
        path.write_bytes(change(good, rng))
        try:
            calibration = load_calibration(path)
        except CalibrationFileError as error:
            message = str(error)
        else:
            message = str(path)
            loaded += 1
            assert isinstance(calibration, InverseGPCalibration)
            assert loaded > 20 or same(asked(calibration), expected)
            assert np.array_equal(calibration.data.xyz, original.data.xyz)
        assert str(path) in message
    assert loaded < 360


# --- damage by someone who knows the format ------------------------------------------------------------------------


def contents(saved: Path) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The table, and the members of arrays.npz."""
    with zipfile.ZipFile(saved) as archive:
        table = tomllib.loads(archive.read(TOML).decode())
        with zipfile.ZipFile(io.BytesIO(archive.read(ARRAYS))) as arrays:
            return table, {name: arrays.read(name) for name in arrays.namelist()}


def zipped(members: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    write_zip(buffer, members)
    return buffer.getvalue()


def forge(path: Path, table: dict[str, Any] | str | bytes, arrays: bytes) -> Path:
    """A file whose checksum is right."""
    if isinstance(table, dict):
        table = toml_text({**table, "arrays_sha256": hashlib.sha256(arrays).hexdigest()})
    content = table.encode() if isinstance(table, str) else table
    path.write_bytes(zipped({TOML: content, ARRAYS: arrays}))
    return path


def npy(array: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


def header(text: str, body: bytes = b"", version: int = 1) -> bytes:
    raw = text.encode("latin-1")
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack("<H" if version == 1 else "<I", len(raw)) + raw + body


class Payload:
    """Unpickling this creates a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return (os.mkdir, (str(self.path),))


def test_a_forged_but_right_file_loads(original: InverseGPCalibration, saved: Path, tmp_path: Path) -> None:
    table, members = contents(saved)
    path = forge(tmp_path / "x.implicam", table, zipped(members))
    assert same(asked(load_calibration(path)), asked(original))
    with zipfile.ZipFile(tmp_path / "deflated.implicam", "w", zipfile.ZIP_DEFLATED) as archive:  # repacked by hand
        for name in (TOML, ARRAYS):
            archive.writestr(name, zipfile.ZipFile(saved).read(name))
    assert same(asked(load_calibration(tmp_path / "deflated.implicam")), asked(original))


F8 = "{'descr': '<f8', 'fortran_order': False, 'shape': %s, }"
ARRAY_EDITS: dict[str, Callable[[np.ndarray], bytes]] = {
    "a number more": lambda a: npy(np.append(a.ravel(), a.ravel()[:1])),
    "one axis more": lambda a: npy(a[None]),
    "flat": lambda a: npy(a.ravel()),
    "scalar": lambda a: npy(a.ravel()[:1].reshape(())),
    "empty": lambda a: npy(a.ravel()[:0]),
    "float32": lambda a: npy(np.ones(a.size + 1, np.float32)),
    "complex": lambda a: npy(a.astype(np.complex128) if a.dtype.kind == "f" else np.array(1j)),
    "dates": lambda a: npy(np.zeros(a.shape, "<M8[s]")),
    "records": lambda a: npy(np.zeros(a.shape, [("a", "<f8")])),
    "bytes": lambda a: npy(np.zeros(a.shape, "S3")),
    "void": lambda a: npy(np.zeros(a.shape, "V8")),
    "objects": lambda a: npy(np.full(a.shape, None, dtype=object)),
    "shape 2**40": lambda a: header(F8 % "(1099511627776,)"),
    "shape overflow": lambda a: header(F8 % "(4294967296, 4294967296, 4294967296)"),
    "shape of 4000 digits": lambda a: header(F8 % f"({'9' * 4000},)"),
    "shape of many numbers": lambda a: header(F8 % f"({'999999999999999, ' * 500})"),
    "shape negative": lambda a: header(F8 % "(-1,)", b"\0" * 8),
    "shape of many ones": lambda a: header(F8 % f"({'1, ' * 200})", b"\0" * 8),
    "zero but huge": lambda a: header(F8 % "(0, 999999999999999)"),
    "wide text": lambda a: header("{'descr': '<U999999', 'fortran_order': False, 'shape': (1000000,), }"),
    "no width": lambda a: header("{'descr': '<U0', 'fortran_order': False, 'shape': (1000000000,), }"),
    "odd width": lambda a: header("{'descr': '<f3', 'fortran_order': False, 'shape': (1,), }", b"\0" * 3),
    "half a character": lambda a: header(
        "{'descr': '<U1', 'fortran_order': False, 'shape': (1,), }", b"\xff\xff\xff\x7f"
    ),
    "code in the header": lambda a: header("__import__('os').getcwd()"),
    "deep header": lambda a: header("(" * 5000),
    "long header": lambda a: header(" " * 60000),
    "header beyond the end": lambda a: header(" " * 100)[:40],
    "version 9": lambda a: header(F8 % "(1,)", b"\0" * 8, 9),
    "version 2 cut": lambda a: header(F8 % "(1,)", b"\0" * 8, 2)[:11],
    "nothing": lambda a: b"",
    "a zip": lambda a: b"PK\3\4",
    "two in one": lambda a: npy(a) + npy(a),
}


@pytest.mark.parametrize("edit", ARRAY_EDITS)
def test_array_edits(edit: str, saved: Path, tmp_path: Path) -> None:
    """Every array in turn is replaced by something wrong, with a right checksum."""
    table, members = contents(saved)
    for name in members:
        array = np.load(io.BytesIO(members[name]))
        changed = ARRAY_EDITS[edit](array)
        if changed != members[name]:
            fails(forge(tmp_path / "x.implicam", table, zipped({**members, name: changed})))


PRESET_NUMBERS = {
    "smooth": (["lengthscale", "noise_ratio"], ["basis", "uncertainty"]),
    "plain": (["lengthscale", "signal_variance", "noise_variance"], ["mean"]),
}
"""Preset -> the arrays of its file that must be positive, and those that must be finite."""


@pytest.mark.parametrize("preset", PRESET_NUMBERS)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, -1.0, 0.0])
def test_bad_numbers(bad: float, preset: str, tmp_path: Path) -> None:
    InverseGP(preset=preset).fit(known_points()).save(tmp_path / "good.implicam")
    table, members = contents(tmp_path / "good.implicam")
    positive = ["pixel_scale", "position_scale", *PRESET_NUMBERS[preset][0]]
    finite = ["pixel_offset", "position_offset", *PRESET_NUMBERS[preset][1]]
    names = [f"method/{n}.npy" for n in positive + ([] if math.isfinite(bad) else finite)]
    names += [] if math.isfinite(bad) else ["data/xyz.npy"]
    names += ["data/uv.npy"] if math.isinf(bad) else []
    names += ["data/xyz_sd.npy"] if bad < 0 or math.isinf(bad) else []
    for name in names:
        array = np.load(io.BytesIO(members[name])).copy()
        array.flat[-1] = bad
        fails(forge(tmp_path / "x.implicam", table, zipped({**members, name: npy(array)})))


def test_a_pickle_is_never_run(saved: Path, tmp_path: Path) -> None:
    table, members = contents(saved)
    trap = tmp_path / "trap"
    payload = np.empty((), dtype=object)
    payload[()] = Payload(trap)
    as_objects = "{'descr': '|O', 'fortran_order': False, 'shape': (), }"
    raw = pickle.dumps(Payload(trap))
    for name in members:
        for content in (npy(payload), raw, header(as_objects, raw)):
            error = fails(forge(tmp_path / "x.implicam", table, zipped({**members, name: content})))
            assert "nothing in it was executed" in error.fix
    assert not trap.exists()
    pickle.loads(pickle.dumps(Payload(trap)))
    assert trap.exists(), "the trap works"


TOML_EDITS: dict[str, Callable[[dict[str, Any]], None]] = {
    "no version": lambda t: t.pop("format_version"),
    "version text": lambda t: t.update(format_version="1"),
    "version true": lambda t: t.update(format_version=True),
    "version 0": lambda t: t.update(format_version=0),
    "version -1": lambda t: t.update(format_version=-1),
    "version 1.0": lambda t: t.update(format_version=1.0),
    "newer": lambda t: t.update(format_version=FORMAT_VERSION + 1),
    "much newer": lambda t: t.update(format_version=2**62),
    "no method": lambda t: t.pop("method"),
    "method number": lambda t: t.update(method=1),
    "unknown method": lambda t: t.update(method="forward-gp-9"),
    "method like code": lambda t: t.update(method="__import__('os')"),
    "no options": lambda t: t.pop("options"),
    "options text": lambda t: t.update(options="x"),
    "options empty": lambda t: t.update(options={}),
    "kernel": lambda t: t["options"].update(kernel="no such"),
    "kernel table": lambda t: t["options"].update(kernel={"a": 1}),
    "preset": lambda t: t["options"].update(preset="no such"),
    "seed text": lambda t: t["options"].update(seed="x"),
    "seed nan": lambda t: t["options"].update(seed=math.nan),
    "seed inf": lambda t: t["options"].update(seed=math.inf),
    "seed list": lambda t: t["options"].update(seed=[1]),
}


@pytest.mark.parametrize("edit", TOML_EDITS)
def test_toml_edits(edit: str, saved: Path, tmp_path: Path) -> None:
    table, members = contents(saved)
    TOML_EDITS[edit](table)
    error = fails(forge(tmp_path / "x.implicam", table, zipped(members)))
    if "newer" in edit:
        assert "newer version" in error.what
        assert error.fix == "pip install --upgrade implicam"
    if edit in ("unknown method", "method like code"):
        assert "which this version does not have" in error.what


RAW_TOML: dict[str, str | bytes] = {
    "empty": "",
    "not toml": "{",
    "latin-1": 'x = "é"'.encode("latin-1"),
    "zero bytes": b"\0" * 100,
    "utf-16": "x = 1".encode("utf-16"),
    "deep arrays": "x = " + "[" * 20000,
    "deep tables": "x = " + "{x = " * 20000,
    "deep key": "x" + ".x" * 100_000 + " = 1",
    "deep header": "[x" + ".x" * 100_000 + "]",
    "quoted deep key": '"=".' * 100_000 + "x = 1",
    "many long keys": "".join("x." * 450 + f"y{i} = 1\n" for i in range(300)),
    "rather deep": "x" + ".x" * 80 + " = 1",
    "enormous": "format_version = " + "9" * 100_000,
    "enormous hex": "format_version = 0x" + "f" * 100_000,
    "beyond 64 bits": "format_version = 99999999999999999999",
    "big": "x = '" + "y" * 3_000_000 + "'",
    "many": "".join(f"x{i} = 1\n" for i in range(40_000)),
    "twice": "format_version = 1\nformat_version = 1",
}


@pytest.mark.parametrize("name", RAW_TOML)
def test_raw_toml(name: str, saved: Path, tmp_path: Path) -> None:
    _, members = contents(saved)
    fails(forge(tmp_path / "x.implicam", RAW_TOML[name], zipped(members)))


DESCRIPTIONS = {
    "no toml": "{",
    "no cameras": 'name = "a"\nlength_unit = "mm"',
    "one camera": 'name = "a"\nlength_unit = "mm"\n[[cameras]]\nname = "cam1"',
    "a camera twice": 'name = "a"\nlength_unit = "mm"\n[[cameras]]\nname = "cam1"\n[[cameras]]\nname = "cam1"',
    "no unit": 'name = "a"\n[[cameras]]\nname = "cam1"\n[[cameras]]\nname = "cam2"',
    "narrow": 'name = "a"\nlength_unit = "mm"\ncameras = [{name = "cam1", width = 3, height = 3}, {name = "cam2"}]',
    "deep": "x" + ".x" * 100_000 + " = 1",
}  # fmt: skip


@pytest.mark.parametrize("name", DESCRIPTIONS)
def test_descriptions_of_the_data(name: str, saved: Path, tmp_path: Path) -> None:
    table, members = contents(saved)
    fails(
        forge(
            tmp_path / "x.implicam", table, zipped({**members, "data/dataset.npy": npy(np.array(DESCRIPTIONS[name]))})
        )
    )


def test_an_array_is_missing_or_too_many(original: InverseGPCalibration, saved: Path, tmp_path: Path) -> None:
    table, members = contents(saved)
    for name in members:
        rest = {other: content for other, content in members.items() if other != name}
        fails(forge(tmp_path / "x.implicam", table, zipped(rest)))
    for extra in ("evil.exe", "../../etc/passwd", "data/uv"):
        fails(forge(tmp_path / "x.implicam", table, zipped({**members, extra: b"x"})))
    more = zipped({**members, "../elsewhere.npy": npy(np.zeros(3)), "method/later.npy": npy(np.zeros(3))})
    assert same(asked(load_calibration(forge(tmp_path / "x.implicam", table, more))), asked(original))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["x.implicam"], "nothing is unpacked"


def test_other_members(saved: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(saved) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    path = tmp_path / "x.implicam"
    wrong: list[dict[str, bytes]] = [
        {},
        {TOML: members[TOML]},
        {ARRAYS: members[ARRAYS]},
        {**members, "../../evil": b"x"},
        {**members, "/etc/passwd": b"x"},
        {"../" + TOML: members[TOML], ARRAYS: members[ARRAYS]},
        {TOML.upper(): members[TOML], ARRAYS: members[ARRAYS]},
        {**members, "x" * 60000: b""},
        {TOML: members[TOML], ARRAYS: b"x"},
        {TOML: members[TOML], ARRAYS: members[ARRAYS] + b"x"},
    ]
    for content in wrong:
        path.write_bytes(zipped(content))
        fails(path)


def test_a_member_twice(saved: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(saved) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    path = tmp_path / "x.implicam"
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
        with pytest.warns(UserWarning, match="Duplicate name"):
            archive.writestr(TOML, b"format_version = 1")
    assert "names a member twice" in fails(path).why


def patched(b: bytes, field: int, value: bytes, *, local: int) -> bytes:
    """A field of every central header, and the same of every local header, changed."""
    data = bytearray(b)
    for i in range(len(b) - 4):
        for signature, offset in ((b"PK\1\2", field), (b"PK\3\4", local)):
            if b[i : i + 4] == signature:
                data[i + offset : i + offset + len(value)] = value
    return bytes(data)


def test_flags_and_methods_of_the_zip(saved: Path, tmp_path: Path) -> None:
    path, good = tmp_path / "x.implicam", saved.read_bytes()
    path.write_bytes(patched(good, 8, b"\1\0", local=6))
    assert "encrypted" in fails(path).why
    for method in (12, 14, 9, 97, 99, 65535):
        path.write_bytes(patched(good, 10, struct.pack("<H", method), local=8))
        assert "unusual method" in fails(path).why
    path.write_bytes(patched(good, 24, b"\xff\xff\xff\x7f", local=22))
    assert "claims to unpack" in fails(path).why


def test_bzip2_and_lzma_are_refused(saved: Path, tmp_path: Path) -> None:
    for kind in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        with zipfile.ZipFile(tmp_path / "x.implicam", "w", kind) as archive:
            for name in (TOML, ARRAYS):
                archive.writestr(name, zipfile.ZipFile(saved).read(name))
        assert "unusual method" in fails(tmp_path / "x.implicam").why


# --- bombs ---------------------------------------------------------------------------------------------------------


def deflated_zeros(n: int) -> bytes:
    squeeze = zlib.compressobj(9, zlib.DEFLATED, -15)
    block = bytes(1 << 20)
    return b"".join([squeeze.compress(block) for _ in range(n >> 20)]) + squeeze.flush()


@pytest.fixture(scope="module")
def bomb() -> bytes:
    """256 MB of zeros, in a quarter of a megabyte."""
    return deflated_zeros(256 << 20)


def lying_zip(name: str, compressed: bytes, declared: int, more: dict[str, bytes]) -> bytes:
    """A zip with a deflated member that says it unpacks to `declared` bytes, and stored ones."""
    body, directory, count = b"", b"", 0
    entries = [(name, compressed, declared, 8, 0)]
    entries += [(n, c, len(c), 0, zlib.crc32(c)) for n, c in more.items()]
    for n, content, size, method, crc in entries:
        common = struct.pack("<HHHHHIIIHH", 20, 0, method, 0, 33, crc, len(content), size, len(n), 0)
        directory += b"PK\1\2\x14\0" + common + struct.pack("<HHHII", 0, 0, 0, 0, len(body)) + n.encode()
        body += b"PK\3\4" + common + n.encode() + content
        count += 1
    end = struct.pack("<HHHHIIH", 0, 0, count, count, len(directory), len(body), 0)
    return body + directory + b"PK\5\6" + end


def peak_of(run: Callable[[], Any]) -> int:
    tracemalloc.start()
    try:
        run()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_bombs(bomb: bytes, saved: Path, tmp_path: Path) -> None:
    """Declared honestly, or as a small member; in the outer zip, or in the arrays of a forged one."""
    path = tmp_path / "x.implicam"
    with zipfile.ZipFile(saved) as archive:
        toml, arrays = archive.read(TOML), archive.read(ARRAYS)
    table, members = contents(saved)
    limit = 100 << 20
    for declared in (256 << 20, 1 << 20, 100, 0, 0xFFFFFFFE):
        path.write_bytes(lying_zip(ARRAYS, bomb, declared, {TOML: toml}))
        assert peak_of(lambda: fails(path)) < limit, declared
        path.write_bytes(lying_zip(TOML, bomb, declared, {ARRAYS: arrays}))
        assert peak_of(lambda: fails(path)) < limit, declared
        others = {name: content for name, content in members.items() if name != "data/uv.npy"}
        forge(path, table, lying_zip("data/uv.npy", bomb, declared, others))
        assert peak_of(lambda: fails(path)) < limit, declared


def test_a_bomb_in_a_bomb(bomb: bytes, saved: Path, tmp_path: Path) -> None:
    """Deflated twice it is a few kilobytes, and each layer alone stays within its bound."""
    table, members = contents(saved)
    others = {name: content for name, content in members.items() if name != "data/uv.npy"}
    inner = lying_zip("data/uv.npy", bomb, 24 << 20, others)
    toml = toml_text({**table, "arrays_sha256": hashlib.sha256(inner).hexdigest()}).encode()
    path = tmp_path / "x.implicam"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(TOML, toml)
        archive.writestr(ARRAYS, inner)
    assert peak_of(lambda: fails(path)) < 100 << 20


@pytest.mark.skipif(os.name != "posix", reason="needs sparse files and limits")
def test_gigabytes_within_a_memory_limit(saved: Path, tmp_path: Path) -> None:
    """Sparse files in a process that may have little more memory than Python itself."""
    paths = []
    for i, start in enumerate([b"", b"PK\3\4", saved.read_bytes()]):
        paths.append(tmp_path / f"{i}.implicam")
        with paths[-1].open("wb") as file:
            file.write(start)
            file.truncate(1 << 30 if i else (1 << 31) + 1)
    with (tmp_path / "3.implicam").open("wb") as file:  # a gigabyte before a whole zip
        file.truncate(1 << 30)
        file.seek(1 << 30)
        file.write(saved.read_bytes())
    code = """
import sys, resource
from implicam.calibrators import load_calibration
from implicam.errors import CalibrationFileError
with open("/proc/self/statm") as f:
    now = int(f.read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (now + (256 << 20), now + (256 << 20)))
for path in sys.argv[1:]:
    try:
        load_calibration(path)
        print("loaded")
    except CalibrationFileError as error:
        assert path in str(error)
        print("refused")
"""
    if not Path("/proc/self/statm").exists():
        pytest.skip("needs /proc")
    run = subprocess.run(
        [sys.executable, "-c", code, *map(str, paths), str(tmp_path / "3.implicam")],
        capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert run.stdout.split() == ["refused", "refused", "refused", "loaded"], run.stdout + run.stderr


# --- forged at random ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_random_forgeries(saved: Path, tmp_path: Path) -> None:
    """Random changes behind a right checksum reach the inner checks: refused, or a calibration; nothing else."""
    table, members = contents(saved)
    toml = toml_text(table)
    rng = random.Random(5)
    path = tmp_path / "x.implicam"
    counts = {"refused": 0, "loaded": 0}
    for i in range(1500):
        if i % 2:
            name = rng.choice(list(members))
            damage = rng.choice([flip_bits, flip_bits, truncate, insert, delete, swap_blocks, zero_block])
            arrays = zipped({**members, name: damage(members[name], rng)})
            forge(path, table, arrays)
        else:
            damaged = rng.choice([flip_bits, delete, insert, swap_blocks, truncate])(toml.encode(), rng)
            path.write_bytes(zipped({TOML: damaged, ARRAYS: zipped(members)}))
        try:
            calibration = load_calibration(path)
        except CalibrationFileError as error:
            counts["refused"] += 1
            message = str(error)
        else:
            counts["loaded"] += 1
            message = str(path)
            assert isinstance(calibration, InverseGPCalibration)
        assert str(path) in message
    assert counts["refused"] > 300


def test_data_arrays_restore_themselves() -> None:
    data = simulated("stereo", points=4, seed=2)
    again = dataset_from_arrays(arrays_from_dataset(data), Path("x"))
    assert npz_bytes(arrays_from_dataset(again)) == npz_bytes(arrays_from_dataset(data))


if __name__ == "__main__":
    make_reference()
