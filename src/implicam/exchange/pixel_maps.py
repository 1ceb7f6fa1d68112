"""`undistortion-maps`: for each camera the pixel maps that make its pictures those of a perfect pinhole, with their sd.

A folder: `pinholes.toml`, all pinholes as aniposelib keeps cameras, which `implicam import` reads; README.txt, how to
use it; and for each camera NAME.npz and NAME.yml.gz, the same for NumPy and for cv2.FileStorage:

    map_x, map_y    float32, height x width of the new picture: the pixel of the camera's own picture, as cv2.remap
                    takes it; NO_PIXEL where there is none
    sd_x, sd_y      float32, standard uncertainty of the two in pixels; NaN where it is not known
    extrapolated    0 or 1: the camera saw no known point around this pixel
    K, R, t, size   the pinhole: x_camera = R x_world + t, in the rig's length unit; width and height
    source_size     width and height of the camera's own pictures
    depths          the distances along the axis for which the maps are made, in the rig's length unit
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial import KDTree

from implicam.errors import DatasetError
from implicam.exchange.anipose import write_aniposelib
from implicam.exchange.model import ExplicitCamera, Rig
from implicam.files import npz_bytes, read_npz, refuse_other_files, replacing_folder
from implicam.geometry import Pose
from implicam.images import opencv
from implicam.lenses import Bools, BrownConrady, Floats

MAPS_FORMAT = "undistortion-maps"
"""The name of the format on the command line."""

NO_PIXEL = -1e4
"""What a map holds where the camera sees nothing: cv2.remap takes a NaN for pixel (0, 0), and this for the border."""

PINHOLES_FILE, README_FILE = "pinholes.toml", "README.txt"

START_SPACING_PX = 8
"""Of the pixels of a new picture among which the inverse of a map begins."""

INVERSE_STEPS, INVERSE_TOLERANCE_PX = 10, 1e-3
"""Newton steps to the inverse of a map, and how near it must come; the maps are float32."""

README = """\
Pixel maps that turn the pictures of each camera into those of a perfect pinhole; written by implicam.

    import cv2, numpy as np
    maps = np.load("CAMERA.npz")
    straight = cv2.remap(picture, maps["map_x"], maps["map_y"], cv2.INTER_CUBIC)
    # a point of the world x (3,) is at pixel uv of `straight`, give or take sd_x, sd_y there:
    u, v, w = maps["K"] @ (maps["R"] @ x + maps["t"]); uv = u / w, v / w

CAMERA.yml.gz holds the same for cv::FileStorage; pinholes.toml all pinholes, without distortion (aniposelib's format).
Lengths are in UNIT.
map_x, map_y: the pixel of the camera's own picture, -10000 where it has none. sd_x, sd_y: their standard uncertainty in
pixels, NaN where nothing is known of it. extrapolated: 1 where the camera saw no known point around.
"""


@dataclass(frozen=True, eq=False)
class PinholeMaps:
    """The pinhole that a camera becomes, and the maps that make it one; see the head of this file.

    Attributes:
        pinhole: Without distortion, with the size of the new picture.
        source_size: Width and height of the camera's own pictures.
        map_x: (height, width) float32.
        map_y: (height, width) float32.
        sd_x: (height, width) float32.
        sd_y: (height, width) float32.
        extrapolated: (height, width).
        depths: (k,) in the rig's length unit.
    """

    pinhole: ExplicitCamera
    source_size: tuple[int, int]
    map_x: NDArray[np.float32]
    map_y: NDArray[np.float32]
    sd_x: NDArray[np.float32]
    sd_y: NDArray[np.float32]
    extrapolated: Bools
    depths: Floats

    @property
    def K(self) -> Floats:
        """(3, 3) the pinhole's matrix."""
        lens = self.pinhole.lens
        return np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]])

    @cached_property
    def filled(self) -> Bools:
        """(height, width) where the new picture shows something: the map points into the camera's own picture."""
        width, height = self.source_size
        x, y = self.map_x, self.map_y
        return (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)

    @property
    def sd(self) -> NDArray[np.float32]:
        """(height, width) the larger of the two sds."""
        return np.maximum(self.sd_x, self.sd_y)

    @cached_property
    def _values(self) -> Floats:
        """(2, height, width) the maps, NaN where there is no pixel."""
        both = np.stack([self.map_x, self.map_y]).astype(np.float64)
        return np.where(both == NO_PIXEL, np.nan, both)

    def _at(self, uv: Floats) -> Floats:
        """(n, 2) the maps between their pixels; NaN outside."""
        return np.stack([map_coordinates(m, uv.T[::-1], order=1, cval=np.nan) for m in self._values], axis=1)

    @cached_property
    def _starts(self) -> tuple[KDTree, Floats]:
        """Some pixels of the new picture, and a search tree of where their maps point."""
        every = slice(None, None, START_SPACING_PX)
        u, v = np.meshgrid(*(np.arange(side, dtype=np.float64)[every] for side in self.pinhole.size))
        at = self._values[:, every, every].reshape(2, -1).T
        there = np.isfinite(at).all(axis=1)
        return KDTree(at[there]), np.column_stack([u.ravel(), v.ravel()])[there]

    def undistort(self, uv: Floats) -> Floats:
        """The inverse of the maps: where pixels of the camera's own picture are in the new one.

        Args:
            uv: (n, 2) pixels of the camera's own picture.

        Returns:
            (n, 2) pixels of the pinhole; NaN where the new picture does not show them.
        """
        tree, places = self._starts
        out = np.full((len(uv), 2), np.nan)
        known = np.flatnonzero(np.isfinite(uv).all(axis=1))
        if not len(known) or not len(places):
            return out
        target = uv[known]
        at = places[tree.query(target)[1]]
        last = np.array(self.pinhole.size) - 1.0
        for _ in range(INVERSE_STEPS):
            low = np.clip(np.floor(at), 0, last - 1)
            value, right, below = (self._at(low + np.array(step)) for step in ((0, 0), (1, 0), (0, 1)))
            slope = np.stack([right - value, below - value], axis=2)  # (n, 2, 2)
            (a, b), (c, d) = slope.transpose(1, 2, 0)
            x, y = (target - self._at(at)).T
            with np.errstate(invalid="ignore", divide="ignore"):
                step = np.column_stack([d * x - b * y, a * y - c * x]) / (a * d - b * c)[:, None]
            at = np.clip(at + np.nan_to_num(step, posinf=0.0, neginf=0.0), 0, last)
        off = np.abs(self._at(at) - target).max(axis=1)
        out[known] = np.where((off <= INVERSE_TOLERANCE_PX)[:, None], at, np.nan)
        return out

    def summary(self) -> dict[str, Any]:
        """The pinhole and how well its maps are known, as plain values: the median sd in pixels of what the new picture
        shows, where the camera saw known points and beyond, and the shares of the new picture; None for none."""
        shown, lens = self.filled, self.pinhole.lens
        near, beyond = shown & ~self.extrapolated, shown & self.extrapolated
        width, height = self.pinhole.size
        return {
            "name": self.pinhole.name,
            "width": width,
            "height": height,
            "focal_length_px": float(lens.fx),
            "principal_point_px": [float(lens.cx), float(lens.cy)],
            "share_filled": float(shown.mean()),
            "share_among_known_points": float(near.mean()),
            "median_sd_px": _median(self.sd[near]),
            "median_sd_beyond_px": _median(self.sd[beyond]),
            "largest_sd_px": float(self.sd[shown].max()) if _median(self.sd[shown]) is not None else None,
        }

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """What the file holds, by name."""
        pose = self.pinhole.camera_from_world
        return {
            "map_x": self.map_x,
            "map_y": self.map_y,
            "sd_x": self.sd_x,
            "sd_y": self.sd_y,
            "extrapolated": self.extrapolated.astype(np.uint8),
            "K": self.K,
            "R": pose.rotation,
            "t": pose.translation,
            "size": np.array(self.pinhole.size),
            "source_size": np.array(self.source_size),
            "depths": self.depths,
        }


def _median(sd: NDArray[np.float32]) -> float | None:
    return float(np.median(sd)) if sd.size and np.isfinite(sd).all() else None


def check_maps_folder(path: Path, names: Sequence[str]) -> None:
    """Say that the maps cannot be written before they are made, not after.

    Args:
        path: The folder that they are to be written to.
        names: Of the cameras.

    Raises:
        DatasetError: It is a file, or holds something else.
    """
    ours = {PINHOLES_FILE, README_FILE} | {name + ending for name in names for ending in (".npz", ".yml.gz")}
    refuse_other_files(path, ours.__contains__, "these maps")


def write_maps(maps: list[PinholeMaps], length_unit: str, path: Path) -> None:
    """Write the folder, whole or not at all; earlier maps in it are replaced.

    Args:
        maps: Of each camera.
        length_unit: Of the rig.
        path: The folder.

    Raises:
        DatasetError: The folder holds something else.
        MissingExtraError: OpenCV is not installed.
        ImplicamError: The folder cannot be written.
    """
    cv2 = opencv()
    names = [each.pinhole.name for each in maps]
    check_maps_folder(path, names)
    with replacing_folder(path, overwrite=True) as folder:
        write_aniposelib(Rig(tuple(each.pinhole for each in maps), length_unit), folder / PINHOLES_FILE)
        (folder / README_FILE).write_text(README.replace("UNIT", length_unit), encoding="utf-8", newline="")
        for name, each in zip(names, maps, strict=True):
            arrays = each.arrays()
            (folder / f"{name}.npz").write_bytes(npz_bytes(arrays))
            mode = cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_WRITE_BASE64
            storage = cv2.FileStorage(str(folder / f"{name}.yml.gz"), mode)
            for key, array in arrays.items():
                storage.write(key, array.astype(np.int32) if array.dtype == np.int64 else array)
            storage.release()


def read_maps(path: str | Path) -> PinholeMaps:
    """Read the maps of one camera.

    Args:
        path: Its NAME.npz; NAME is the camera's.

    Raises:
        DatasetError: The file cannot be read, or is not one of these.
    """
    path = Path(path)

    def refuse(why: str) -> DatasetError:
        return DatasetError(f"{path} cannot be read as undistortion maps.", why=why, fix="export them again")

    try:
        found = read_npz(path, refuse)
    except OSError as error:
        raise refuse(str(error)) from error
    try:
        fx, fy, cx, cy = (float(found["K"][i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        width, height = found["size"].tolist()
        pose = Pose(found["R"], found["t"])
        pinhole = ExplicitCamera(path.stem, width, height, BrownConrady(fx, fy, cx, cy), pose)
        names = ("map_x", "map_y", "sd_x", "sd_y", "extrapolated")
        map_x, map_y, sd_x, sd_y, extrapolated = (found[name].reshape(height, width) for name in names)
        source = (int(found["source_size"][0]), int(found["source_size"][1]))
        return PinholeMaps(pinhole, source, map_x, map_y, sd_x, sd_y, extrapolated != 0, found["depths"])
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise refuse(f"{type(error).__name__}: {error}") from error
