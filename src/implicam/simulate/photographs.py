"""Photographs of a simulated rig: what each camera sees of a ball, a board or a wand through its true lens.

Each camera has its lines of sight, pixel by pixel, and its background, both made once; a picture renders only the patch
that the target covers, two by two rays a pixel, and then the optics and the sensor: blur, vignetting, noise, 8 bits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from implicam.dataset import Dataset, Floats
from implicam.errors import UsageError
from implicam.images import Grey, one_thread_each, opencv, write_picture
from implicam.progress import Progress, silent
from implicam.simulate.camera import SimulatedCamera
from implicam.simulate.clutter import background
from implicam.simulate.noise import Bools, simulate, views
from implicam.simulate.rigs import Rig
from implicam.simulate.scene import Ball, Checkerboard, Light, Rays, Sheet, ShownObject, Wand
from implicam.simulate.targets import Target
from implicam.threads import side_by_side

RAYS_PER_PIXEL_SIDE = 2
"""Rays per pixel in each direction."""

BALL_RADIUS_MM = 8.0

FARTHEST_PX = 1e6
"""From the picture's corner: where a target is that no picture shows."""

WAND_RADII_MM, WAND_BRIGHTNESS, WAND_ROD_MM = (9.0, 6.0), (0.9, 0.9), 2.0
"""Of a wand's two balls, the larger of which is `a`, and of its rod."""


@dataclass(frozen=True)
class Optics:
    """How the cameras see.

    Attributes:
        noise: Standard deviation, as a part of full scale, at white.
        blur: Standard deviation, pixels.
        vignetting: How much darker the corners are, from 0 to 1.
        uneven: How much the light changes across the volume, from 0 to 1.
        clutter: Whether there is anything behind the target, look-alikes among it.
        bits: Of the sensor, 8 or 16.

    Raises:
        UsageError: A number is out of range.
    """

    noise: float = 0.01
    blur: float = 0.7
    vignetting: float = 0.3
    uneven: float = 0.3
    clutter: bool = True
    bits: int = 8

    def __post_init__(self) -> None:
        for what in ("noise", "blur", "vignetting", "uneven"):
            value = getattr(self, what)
            if not 0 <= value < (20 if what == "blur" else 1):
                raise UsageError(f"{what} = {value} is out of range.", fix=f"for example {what} = {0.3:g}")


class Occluder(NamedTuple):
    """A bar in front of the target, with round ends.

    Attributes:
        start: (2,) one end of its middle line, pixels.
        end: (2,) the other end.
        width: To either side of the middle line, pixels.
    """

    start: Floats
    end: Floats
    width: float

    def distance(self, uv: Floats) -> Floats:
        """How far pixels are outside of it.

        Args:
            uv: (..., 2) pixels.

        Returns:
            (...,) pixels; negative inside.
        """
        along = self.end - self.start
        part = np.clip((uv - self.start) @ along / (along @ along), 0, 1)
        return np.asarray(np.linalg.norm(uv - self.start - part[..., None] * along, axis=-1) - self.width, np.float64)


@dataclass(frozen=True, eq=False)
class Studio:
    """A rig with a target in front of it, ready to take pictures.

    Light and background are the rig's own and do not depend on the seed.

    Attributes:
        rig: The cameras; without a window.
        target: What they look at.
        optics: How they see.
        seed: Of the noise and of what is covered.
        covered: The share of the pictures in which something stands in front of the target.
        ball_radius_mm: Of the ball, where the target is one.

    Raises:
        UsageError: The rig has a window, or the target is a board and a camera is mirrored.
    """

    rig: Rig
    target: Target
    optics: Optics = Optics()
    seed: int = 0
    covered: float = 0.0
    ball_radius_mm: float = BALL_RADIUS_MM

    def __post_init__(self) -> None:
        if any(camera.window is not None for camera in self.rig.cameras):
            raise UsageError(
                "a rig that looks through a window cannot be photographed.",
                why="its lines of sight do not meet in one point, and the pictures are made of those that do",
                fix="leave out --window, or --images",
            )
        if self.target.board is not None and any(camera.mirrored for camera in self.rig.cameras):
            raise UsageError(
                "a board in a mirror cannot be photographed.",
                why="a checkerboard does not show that it is mirrored, and its corners would be numbered wrongly",
                fix="leave out --images or --mirror, or show the ball",
            )

    @cached_property
    def shots(self) -> list[str]:
        """The names of the shots, in the order of the target."""
        return list(dict.fromkeys(self.target.shots.tolist()))

    @cached_property
    def true_pixels(self) -> tuple[Floats, Bools]:
        """Pixels (n, cameras, 2) of the target's points, and (n, cameras) where they can be seen in the pictures."""
        uv, visible = views(self.rig, self.target)
        visible = visible.copy()
        for c in range(len(self.rig.cameras)):
            for s, shot in enumerate(self.shots):
                cover = self._place_occluder(c, s)
                if cover is not None:
                    rows = self.target.shots == shot
                    visible[rows, c] &= cover.distance(uv[rows, c]) > 0
        visible &= self._from_the_front()
        return uv, visible

    def picture(self, camera: int, shot: int) -> Grey:
        """One photograph.

        Args:
            camera: The number of the camera.
            shot: The number of the shot.

        Returns:
            (height, width) brightness from 0 to 1, in the steps of the sensor.
        """
        return self._expose(self._compose(camera, shot), camera, np.random.default_rng([self.seed, 7, camera, shot]))

    def showing(self, target: Target, *, seed: int) -> Studio:
        """The same cameras with another target; their lines of sight and backgrounds, the costly part, are shared.

        Args:
            target: What they look at.
            seed: Of the noise and of what is covered.
        """
        other = replace(self, target=target, seed=seed)
        other.__dict__["_looks"] = self._looks  # where the cached property keeps it
        return other

    @cached_property
    def jobs(self) -> list[tuple[int, int]]:
        """The pictures that are taken: the numbers of camera and shot of each."""
        takes = np.ones((len(self.target.shots), len(self.rig.cameras)), dtype=np.bool_)
        if self.target.takes is not None:
            takes = self.target.takes
        return [
            (c, s)
            for s, shot in enumerate(self.shots)
            for c in range(len(self.rig.cameras))
            if takes[self.target.shots == shot, c].any()
        ]

    def write(self, folder: Path, progress: Progress = silent, *, ending: str = ".png") -> int:
        """Write all pictures to folder/<camera>/<shot>.png.

        Args:
            folder: Where to; it is made where it is missing.
            progress: Called after each picture.
            ending: Of the file names.

        Returns:
            How many pictures.
        """
        jobs = self.jobs
        done = 0
        for camera in self.rig.cameras:
            (folder / camera.name).mkdir(parents=True, exist_ok=True)

        def work(job: tuple[int, int]) -> None:
            nonlocal done
            c, s = job
            path = folder / self.rig.cameras[c].name / f"{self.shots[s]}{ending}"
            write_picture(path, self.picture(c, s), bits=self.optics.bits)
            done += 1
            progress("taking photographs", done, len(jobs))

        progress("taking photographs", 0, len(jobs))
        with one_thread_each():
            _ = self._looks  # once, before many ask for them at the same time
            side_by_side(work, jobs)
        return len(jobs)

    def description(self) -> dict[str, Any]:
        """The target as dataset.toml describes it; lengths in the rig's unit."""
        if self.target.wand is not None:
            return {}  # `as_wand` says it
        if self.target.board is None:
            return {"kind": "ball", "radius": self.ball_radius_mm * self.rig.units_per_mm}
        rows, columns = self.target.board
        thing = self.shown_object(0)
        assert isinstance(thing, Checkerboard)
        return {"kind": "board", "rows": rows, "columns": columns, "square": float(np.linalg.norm(thing.right))}

    def shown_object(self, shot: int) -> ShownObject:
        """The object that the cameras see in a shot.

        Args:
            shot: The number of the shot.
        """
        xyz = self.target.xyz[self.target.shots == self.shots[shot]]
        if self.target.wand is not None:
            mm = self.rig.units_per_mm
            return Wand(xyz, mm * np.array(WAND_RADII_MM), np.array(WAND_BRIGHTNESS), mm * WAND_ROD_MM)
        if self.target.sheet is not None:
            pose, shown = self.target.sheet
            return Sheet(pose.translation, pose.rotation[:, 0], pose.rotation[:, 1], shown, self._light)
        if self.target.board is None:
            return Ball(xyz[0], self._towards_cameras, self.ball_radius_mm * self.rig.units_per_mm, self._light)
        rows, columns = self.target.board
        grid = xyz.reshape(rows, columns, 3)
        right = (grid[0, -1] - grid[0, 0]) / (columns - 1)
        down = (grid[-1, 0] - grid[0, 0]) / (rows - 1)
        return Checkerboard(grid[0, 0], right, down, rows, columns, self._light, self.target.marks)

    @cached_property
    def _looks(self) -> list[_Look]:
        return side_by_side(
            lambda c: _Look(self.rig.cameras[c], self.optics, np.random.default_rng([self.rig.seed, 5, c])),
            range(len(self.rig.cameras)),
        )

    @cached_property
    def _towards_cameras(self) -> Floats:
        if self.target.facing is not None:
            mean = np.atleast_2d(self.target.facing).mean(axis=0)
            return np.asarray(mean / np.linalg.norm(mean), dtype=np.float64)
        middle = self.rig.volume.world_from_box.translation
        mean = np.mean([camera.camera_from_world.centre for camera in self.rig.cameras], axis=0) - middle
        return np.asarray(mean / np.linalg.norm(mean), dtype=np.float64)

    @cached_property
    def _light(self) -> Light:
        rng = np.random.default_rng([self.rig.seed, 6])
        middle, size = self.rig.volume.world_from_box.translation, float(np.linalg.norm(self.rig.volume.size))
        lamp = self._towards_cameras + 0.35 * rng.normal(size=3)
        slope = rng.normal(size=3)
        slope *= self.optics.uneven / (np.linalg.norm(slope) * size)
        return Light(lamp / np.linalg.norm(lamp), slope, middle)

    def _from_the_front(self) -> Bools:
        """(n, cameras) where a ball is not behind its plate."""
        if self.target.facing is not None or self.target.wand is not None:
            return np.ones((len(self.target.xyz), len(self.rig.cameras)), dtype=np.bool_)
        columns = []
        for camera in self.rig.cameras:
            towards = camera.camera_from_world.centre - self.target.xyz
            columns.append(towards @ self._towards_cameras > 0.17 * np.linalg.norm(towards, axis=1))
        return np.stack(columns, axis=1)

    def _place_occluder(self, camera: int, shot: int) -> Occluder | None:
        rng = np.random.default_rng([self.seed, 8, camera, shot])
        if rng.random() >= self.covered:
            return None
        thing = self.shown_object(shot)
        uv, _ = self.rig.cameras[camera].pixel_from_world(thing.reach())
        middle = np.nanmean(uv, axis=0)
        size = float(np.nanmax(np.linalg.norm(uv - middle, axis=1)))
        angle = rng.uniform(0, np.pi)
        along = size * np.array([np.cos(angle), np.sin(angle)])
        if isinstance(thing, Ball):
            (middle,), _ = self.rig.cameras[camera].pixel_from_world(thing.centre[None])
            return Occluder(middle - along, middle + along, 0.35 * size)
        middle = middle + rng.normal(scale=0.25 * size, size=2)
        return Occluder(middle - along, middle + along, float(rng.uniform(0.1, 0.35)) * size)

    def _compose(self, camera: int, shot: int) -> Grey:
        look, thing = self._looks[camera], self.shown_object(shot)
        picture = look.blurred.copy()
        cover = self._place_occluder(camera, shot)
        box = self._find_patch(camera, thing, cover)
        if box is None:
            return _cut_padding(picture)
        top, bottom, left, right = box
        window = slice(top, bottom), slice(left, right)
        cv2 = opencv()
        fine = ((right - left) * RAYS_PER_PIXEL_SIDE, (bottom - top) * RAYS_PER_PIXEL_SIDE)
        ground = cv2.resize(look.sharp[window], fine, interpolation=cv2.INTER_LINEAR)
        directions = cv2.resize(look.sight.at(*box), fine, interpolation=cv2.INTER_LINEAR)
        patch = thing.paint(Rays(look.camera.camera_from_world.centre, directions), ground)
        if cover is not None:
            patch = _paint_occluder(patch, cover, (left, top))
        if self.optics.blur > 0:
            patch = cv2.GaussianBlur(patch, (0, 0), self.optics.blur * RAYS_PER_PIXEL_SIDE)
        small = cv2.resize(patch, (right - left, bottom - top), interpolation=cv2.INTER_AREA)
        inner = slice(
            _PATCH_MARGIN_PX, -_PATCH_MARGIN_PX
        )  # what the blur took from beyond the patch's edge is not wanted
        picture[
            top + _PATCH_MARGIN_PX : bottom - _PATCH_MARGIN_PX, left + _PATCH_MARGIN_PX : right - _PATCH_MARGIN_PX
        ] = small[inner, inner]
        return _cut_padding(picture)

    def _find_patch(self, camera: int, thing: ShownObject, cover: Occluder | None) -> tuple[int, int, int, int] | None:
        """The patch of the padded picture that shows the target: top, bottom, left, right."""
        view = self.rig.cameras[camera]
        uv, _ = view.pixel_from_world(_densify(thing.reach()))
        if cover is not None:
            ends = np.stack([cover.start, cover.end])
            uv = np.concatenate([uv, ends - cover.width, ends + cover.width])
        uv = uv[np.isfinite(uv).all(axis=1)]
        if len(uv) == 0:
            return None
        uv = np.clip(uv, -FARTHEST_PX, FARTHEST_PX)  # of what is beside the lens, or nearly
        rim = 2 * _PATCH_MARGIN_PX
        low = np.maximum(np.floor(uv.min(axis=0)).astype(int) - rim, -PADDING_PX) + PADDING_PX
        high = (
            np.minimum(np.ceil(uv.max(axis=0)).astype(int) + rim, [view.width + PADDING_PX, view.height + PADDING_PX])
            + PADDING_PX
        )
        if (high - low < 3 * _PATCH_MARGIN_PX).any():
            return None
        return int(low[1]), int(high[1]), int(low[0]), int(high[0])

    def _expose(self, picture: Grey, camera: int, rng: np.random.Generator) -> Grey:
        """Vignetting, noise (half of it from the light itself), and the steps of the sensor's numbers."""
        picture = picture * self._looks[camera].vignette
        noise = rng.standard_normal(picture.shape, dtype=np.float32)
        noise *= self.optics.noise * np.sqrt(0.5 + 0.5 * np.maximum(picture, 0))
        picture += noise
        steps = np.float32(2**self.optics.bits - 1)
        return np.asarray(np.rint(np.clip(picture, 0, 1) * steps) / steps, np.float32)


@dataclass(frozen=True, eq=False)
class Recorded:
    """What a rig records of a target.

    Attributes:
        data: The dataset.
        studio: What takes its photographs; None for none.
    """

    data: Dataset
    studio: Studio | None = None

    @property
    def photographs(self) -> int:
        """How many photographs there are."""
        return len(self.studio.jobs) if self.studio else 0

    def write_photographs(self, folder: Path, progress: Progress = silent) -> None:
        """Write the photographs, if there are any, to folder/images/<camera>/<shot>.png.

        Args:
            folder: The folder of the dataset.
            progress: Called after each picture.
        """
        if self.studio is not None:
            self.studio.write(folder / "images", progress)


def record(
    rig: Rig,
    target: Target,
    *,
    seed: int,
    robot_noise: float = 0.0,
    missing: float = 0.0,
    outliers: float = 0.0,
    optics: Optics | None = None,
) -> Recorded:
    """As `simulate`, with photographs too where `optics` are given.

    With photographs, a view is missing where something covers the target in the picture, and dataset.toml says what the
    target is.

    Args:
        rig: The cameras.
        target: n points.
        seed: Of the noise and of what is missing.
        robot_noise: Standard deviation of the known positions per axis, in the rig's unit.
        missing: Probability that a view is lost; with photographs, the share of the pictures in which something covers
            the target.
        outliers: Probability that a view left is a wrong detection.
        optics: How the cameras see; None for no photographs.

    Raises:
        UsageError: An option is out of range, or outliers are asked for with photographs: there, wrong detections come
            from the detector.
    """
    if optics is None:
        return Recorded(simulate(rig, target, seed=seed, robot_noise=robot_noise, missing=missing, outliers=outliers))
    if outliers > 0:
        raise UsageError(
            "wrong detections cannot be photographed.", why="they come from the detector", fix="leave out --outliers"
        )
    studio = Studio(rig, target, optics, seed, missing)
    _, visible = studio.true_pixels
    described = {"target": told} if (told := studio.description()) else {}
    return Recorded(simulate(rig, target, seed=seed, robot_noise=robot_noise, visible=visible, extra=described), studio)


PADDING_PX = 16
"""Pixels around the picture that are rendered too, so that a target may be cut by its edge."""

_PATCH_MARGIN_PX = 4


class _Look:
    """What is the same in all pictures of a camera: lines of sight, background (sharp and blurred), vignetting."""

    def __init__(self, camera: SimulatedCamera, optics: Optics, rng: np.random.Generator) -> None:
        cv2 = opencv()
        self.camera = camera
        self.sight = LinesOfSight(camera)
        self.sharp = np.pad(
            background(camera.width, camera.height, rng, clutter=optics.clutter), PADDING_PX, mode="edge"
        )
        self.blurred = cv2.GaussianBlur(self.sharp, (0, 0), optics.blur) if optics.blur > 0 else self.sharp
        self.vignette = _vignette(camera.width, camera.height, optics.vignetting)


class LinesOfSight:
    """The directions that the pixels of a camera look along.

    Computed at every eighth pixel and interpolated by a bicubic spline, exact to much less than a thousandth of a
    pixel; where they are wanted only, because those of all pixels take 12 MB a camera. Pixels beyond the image circle
    of the lens look where its rim looks; nothing that the lens sees falls there.

    Args:
        camera: The camera; without a window.
    """

    def __init__(self, camera: SimulatedCamera) -> None:
        size = np.array([camera.width, camera.height])
        us, vs = (np.linspace(-PADDING_PX, n - 1 + PADDING_PX, (n + 2 * PADDING_PX) // 8 + 2) for n in size)
        grid = np.stack(np.meshgrid(us, vs), axis=2).reshape(-1, 2)
        straight = grid.copy()
        for _ in range(6):  # the smooth error changes by less than a per cent from pixel to pixel
            straight = grid - camera.error.at(straight)
        rays, seen = camera.ray_from_pixel(straight)
        middle = np.array([camera.lens.cx, camera.lens.cy])
        while not seen.all():
            straight[~seen] = middle + 0.98 * (straight[~seen] - middle)
            rays[~seen], seen[~seen] = camera.ray_from_pixel(straight[~seen])
        directions = (rays @ camera.camera_from_world.rotation).reshape(len(vs), len(us), 3)
        self._splines = [RectBivariateSpline(vs, us, directions[:, :, k]) for k in range(3)]

    def at(self, top: int, bottom: int, left: int, right: int) -> NDArray[np.float32]:
        """The directions in a part of the padded picture.

        Args:
            top: Its first row; row `PADDING_PX` is the picture's first.
            bottom: The row after its last.
            left: Its first column.
            right: The column after its last.

        Returns:
            (bottom - top, right - left, 3) unit vectors in the world.
        """
        v, u = np.arange(top, bottom) - PADDING_PX, np.arange(left, right) - PADDING_PX
        return np.stack([spline(v, u) for spline in self._splines], axis=2).astype(np.float32)


@lru_cache(maxsize=8)
def _vignette(width: int, height: int, strength: float) -> NDArray[np.float32]:
    """(height, width) the part of the light that a lens lets through; one array for all cameras of a size."""
    v, u = np.mgrid[:height, :width].astype(np.float32)
    middle = np.array([width - 1, height - 1]) / 2
    radius = ((u - middle[0]) ** 2 + (v - middle[1]) ** 2) / np.sum(middle**2)
    return np.asarray(1 - strength * radius, np.float32)


def _paint_occluder(patch: Grey, cover: Occluder, corner: tuple[int, int]) -> Grey:
    rows, columns = patch.shape
    u = (np.arange(columns) + 0.5) / RAYS_PER_PIXEL_SIDE - 0.5 + corner[0] - PADDING_PX
    v = (np.arange(rows) + 0.5) / RAYS_PER_PIXEL_SIDE - 0.5 + corner[1] - PADDING_PX
    outside = cover.distance(np.stack(np.meshgrid(u, v), axis=2))
    part = np.clip(0.5 - outside * RAYS_PER_PIXEL_SIDE, 0, 1)
    return np.asarray(patch + part * (0.3 - patch), np.float32)


def _densify(points: Floats) -> Floats:
    """Points between all pairs of points too: the picture of a straight edge is not straight."""
    steps = np.linspace(0, 1, 5)[:, None, None, None]
    between = points[None, :, None] * steps + points[None, None, :] * (1 - steps)
    return np.asarray(between.reshape(-1, 3), dtype=np.float64)


def _cut_padding(padded: Grey) -> Grey:
    return padded[PADDING_PX:-PADDING_PX, PADDING_PX:-PADDING_PX]
