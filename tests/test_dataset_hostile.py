"""Nothing hostile in the place of a dataset hurts: folders, gigabytes, noise."""

from __future__ import annotations

import os
import random
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest

from dataset_files import FILES, FORMS, POINTS, TOML, VIEWS, WIDE, folder, numbered
from implicam.dataset import Dataset, read_dataset, write_dataset
from implicam.errors import DatasetError, ImplicamError
from implicam.simulate import simulated


@pytest.mark.parametrize("name", ["dataset.toml", "points.csv", "observations.csv"])
def test_a_folder_in_the_place_of_a_file(name: str, tmp_path: Path) -> None:
    path = folder(tmp_path, {name: None})
    (path / name).mkdir()
    with pytest.raises(DatasetError) as caught:
        read_dataset(path)
    assert caught.value.what == f"{path / name} is a folder, not a file."


@pytest.mark.parametrize("name", ["w.csv", "w.parquet", "w.npz", "w"])
def test_an_empty_folder_named_like_a_file(name: str, tmp_path: Path) -> None:
    (tmp_path / name).mkdir()
    with pytest.raises(DatasetError, match=r"dataset\.toml does not exist"):
        read_dataset(tmp_path / name)


def test_a_wide_table_that_names_an_unknown_camera(tmp_path: Path) -> None:
    write_dataset(numbered(3), tmp_path / "w.csv")
    text = (tmp_path / "w.csv").read_text().replace("u_b,v_b", "u_b,v_b,u_bb,v_bb").replace("\n", ",1,2\n")
    (tmp_path / "w.csv").write_text(text.replace("v_bb,1,2", "v_bb"))
    with pytest.raises(DatasetError, match="the columns u_bb and v_bb belong to no camera"):
        read_dataset(tmp_path / "w.csv")


GIGABYTE = 1 << 30


def endless(path: Path) -> None:
    """One line of a gigabyte, cheap to make: a hole would be zeros."""
    with path.open("wb") as file:
        file.write(b"1," * (1 << 19))
        file.truncate(GIGABYTE)


def zeros(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(GIGABYTE)


def header_then_zeros(path: Path) -> None:
    header = {"observations.csv": VIEWS, "points.csv": POINTS, "dataset.toml": TOML, "w.csv": WIDE}
    start = header.get(path.name, "").encode() or {"w.npz": b"PK\x03\x04", "w.parquet": b"PAR1"}[path.name]
    with path.open("wb") as file:
        file.write(start)
        file.truncate(GIGABYTE)


@pytest.mark.skipif(os.name != "posix", reason="needs sparse files")
@pytest.mark.parametrize("make", [zeros, header_then_zeros, endless])
@pytest.mark.parametrize("name", ["observations.csv", "points.csv", "dataset.toml", "w.csv", "w.npz", "w.parquet"])
def test_a_gigabyte_of_something_else(name: str, make: Callable[[Path], None], tmp_path: Path) -> None:
    path = folder(tmp_path) if name in FILES else tmp_path
    make(path / name)
    tracemalloc.start()
    try:
        with pytest.raises(DatasetError, match=name):
            read_dataset(path if name in FILES else path / name, unit="mm")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
        (path / name).unlink()
    assert peak < 10 << 20


# --- fuzz ----------------------------------------------------------------------------------------------------------

SPICE = [
    b",",
    b'"',
    b"\n",
    b"\r",
    b"\0",
    b"\xff",
    b"nan",
    b"1e999",
    b"-",
    b"\xef\xbb\xbf",
    b";",
    b"[[",
    b"]]",
    b"=",
    b"9" * 40,
]


def mutated(content: bytes, rng: random.Random) -> bytes:
    """A few random changes: flips, cuts, insertions, repetitions, swaps."""
    data = bytearray(content)
    for _ in range(rng.choice([1, 1, 1, 2, 5])):
        i, j = sorted((rng.randrange(len(data) + 1), rng.randrange(len(data) + 1)))
        match rng.randrange(7):
            case 0 if data:
                data[min(i, len(data) - 1)] ^= 1 << rng.randrange(8)
            case 1:
                del data[i : i + rng.choice([1, 2, 20])]
            case 2:
                data[i:i] = rng.choice(SPICE)
            case 3:
                data[i:i] = rng.randbytes(rng.choice([1, 4, 30]))
            case 4:
                data[i:i] = data[i : min(j, i + 50)]
            case 5:
                del data[i:]
            case 6:
                data[i:j] = bytes(reversed(data[i:j]))
    return bytes(data)


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
def test_fuzz(form: str, tmp_path: Path) -> None:
    """Whatever is done to the bytes: a valid dataset, or an error that names the file. Never anything else."""
    data = simulated("stereo", points=3, seed=0)
    path = tmp_path / FORMS[form]
    write_dataset(data, path)
    files = sorted(path.iterdir()) if path.is_dir() else sorted(tmp_path.iterdir())
    originals = {file: file.read_bytes() for file in files}
    rng = random.Random(f"fuzz {form}")
    refused = 0
    for _ in range(1200):
        file = rng.choice(files)
        content = mutated(originals[file], rng)
        file.write_bytes(content)
        said = ""
        try:
            assert isinstance(read_dataset(path), Dataset)
        except ImplicamError as error:
            refused += 1
            said = error.what
        assert not said or path.name in said, (said, content)
        file.write_bytes(originals[file])
    assert refused > 300
