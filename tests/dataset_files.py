"""The files of a small dataset, to be spoilt; a dataset of numbered points; when two datasets are the same."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from implicam.dataset import Camera, Dataset, KnownPositions, Observations

FORMS = {"folder": "rig", "csv": "rig.csv", "parquet": "rig.parquet", "npz": "rig.npz"}


TOML = """name = "rig"
length_unit = "mm"

[[cameras]]
name = "cam1"
width = 640
height = 480

[[cameras]]
name = "cam2"
width = 640
height = 480
"""
POINTS = "point,shot,x,y,z,sd_x,sd_y,sd_z\np1,s1,1,2,3,.1,.1,0\np2,s1,4,5,6,,,\n"
VIEWS = "point,camera,u,v,sd_u,sd_v\np1,cam1,10,20,.1,.1\np1,cam2,30,40,,\np2,cam1,50,60,,\n"
WIDE = "point,x,y,z,sd_x,u_cam1,v_cam1,sd_u_cam1\np1,1,2,3,.1,10,20,.1\np2,4,5,6,,,,\n"
FILES = {"dataset.toml": TOML, "points.csv": POINTS, "observations.csv": VIEWS}


def folder(tmp_path: Path, files: dict[str, str | bytes | None] | None = None) -> Path:
    path = tmp_path / "rig"
    path.mkdir(parents=True, exist_ok=True)
    for name, content in {**FILES, **(files or {})}.items():
        if content is not None:
            (path / name).write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def wide(tmp_path: Path, content: str) -> Path:
    path = tmp_path / "w.csv"
    path.write_text(content)
    return path


def put(name: str, old: str, new: str) -> dict[str, str | bytes | None]:
    assert FILES[name].count(old) == 1, (name, old)
    return {name: FILES[name].replace(old, new)}


def numbered(n: int) -> Dataset:
    points = np.array([f"p{i:03d}" for i in range(n)])
    uv = np.arange(4.0 * n).reshape(n, 2, 2)
    xyz = np.arange(3.0 * n).reshape(n, 3)
    known = KnownPositions(np.array([f"s{i % 3}" for i in range(n)]), xyz, np.full((n, 3), np.nan))
    return Dataset("n", "mm", Observations(points, (Camera("a"), Camera("b")), uv, np.full(uv.shape, np.nan)), known)


def same_value(a: Any, b: Any) -> bool:
    if isinstance(a, dict):
        return isinstance(b, dict) and list(a) == list(b) and all(same_value(a[k], b[k]) for k in a)
    if isinstance(a, list):
        return isinstance(b, list) and len(a) == len(b) and all(map(same_value, a, b))
    if isinstance(a, float) and isinstance(b, float):
        return (math.isnan(a) and math.isnan(b)) or (a == b and math.copysign(1, a) == math.copysign(1, b))
    return type(a) is type(b) and bool(a == b)


def same_numbers(a: np.ndarray, b: np.ndarray) -> bool:
    return np.array_equal(a, b, equal_nan=True) and bool((np.signbit(a) == np.signbit(b))[~np.isnan(a)].all())


def same_columns(a: Any, b: Any) -> bool:
    return set(a) == set(b) and all(np.array_equal(a[key], b[key]) for key in a)


def sort_tables_last(value: Any) -> Any:
    """The order of keys in a TOML table has no meaning."""
    if isinstance(value, list):
        return [sort_tables_last(item) for item in value]
    return {k: sort_tables_last(value[k]) for k in sorted(value)} if isinstance(value, dict) else value


def assert_same(a: Dataset, b: Dataset) -> None:
    assert (a.name, a.length_unit) == (b.name, b.length_unit)
    assert same_value(sort_tables_last(a.extra), sort_tables_last(b.extra))
    assert a.points.tolist() == b.points.tolist()
    assert [(c.name, c.width, c.height) for c in a.cameras] == [(c.name, c.width, c.height) for c in b.cameras]
    assert all(
        same_value(sort_tables_last(c.extra), sort_tables_last(d.extra))
        for c, d in zip(a.cameras, b.cameras, strict=True)
    )
    assert same_numbers(a.observations.uv, b.observations.uv)
    assert same_numbers(a.observations.sd, b.observations.sd)
    assert same_columns(a.observations.extra, b.observations.extra)
    assert same_columns(a.columns, b.columns)
    assert (a.known is None) == (b.known is None)
    if a.known and b.known:
        assert a.known.shots.tolist() == b.known.shots.tolist()
        assert same_numbers(a.known.xyz, b.known.xyz)
        assert same_numbers(a.known.sd, b.known.sd)
        assert same_columns(a.known.extra, b.known.extra)
