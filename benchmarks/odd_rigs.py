"""Rigs of all kinds, each drawn from (kind, seed): how many are fitted right, refused, or silently wrong.

    python benchmarks/odd_rigs.py [--rigs 22] [--kinds tilt,window] [--seed0 0] [--method forward-gp] [--jobs 2]
                                  [--limit 120] [-v] [-o benchmarks/results/odd_rigs.md] [--lines odd_rigs.jsonl]
    python benchmarks/odd_rigs.py --rigs 5 --kinds tilt -v --fit-only       a line per rig, while developing

`draw(kind, seed)` gives a rig, its known points and 200 new ones, all with truth. Wrong: a calibrated camera whose
median error on its own known points, against the true pixels, is above 5 times the noise, or a NEES of the new points
above 8. Silently wrong: wrong, and the calibration has no verdict or calls itself usable. Refused: an error, no result
within the time limit, or "not usable". Right values: coverage of the 95 % ellipsoids 0.95, NEES 3.
"""

from __future__ import annotations

import argparse
import importlib
import json
import signal
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from implicam.calibrators import Explicit, ForwardGP, InverseGP
from implicam.coverage import assess
from implicam.dataset import Camera, Observations
from implicam.errors import ImplicamError
from implicam.files import write_text
from implicam.geometry import Pose, look_at, rotation_from_vector
from implicam.lenses import BrownConrady, KannalaBrandt
from implicam.simulate import Box, Rig, SimulatedCamera, Target, Window, simulate, views
from implicam.simulate.camera import random_error
from implicam.threads import blas_threads

RANGES = {
    "ordinary": "fields of 8-45 degrees half angle, lens errors as our own rigs",
    "aspect": "fy/fx 0.5-2, all cameras alike or each its own",
    "crop": "principal point 0.1-0.6 of the longer side off the middle",
    "tilt": "sensor tilted 2-15 degrees (Scheimpflug), fields of 5-60 degrees half angle",
    "window": "a pane 0-45 degrees oblique before each camera, glass 2-30 mm per 200 mm of volume, water behind",
    "mirror": "one or some cameras through a mirror, or all of them (v from below, a left-handed world)",
    "telephoto": "fields of 0.5-3 degrees half angle",
    "wide": "fisheyes of 60-95 degrees half angle",
    "thin-slab": "depth of the volume 2-10 % of its width",
    "tank": "all cameras through 1-4 walls of one water tank",
    "integer": "pixels rounded to whole numbers, no sd stated",
    "scale": "offsets of 1e6 units with a volume of 0.002-0.2 units, or units of 1e-6 or 1e6",
    "wild": "one view to 2 % of them anywhere in the image, or far outside where image sizes are not stated",
    "mixed": "each camera of another kind",
}
"""Kind -> what is drawn."""

COMMON = "2-12 cameras, 10-1000 points, noise 0.05-0.5 px, lens errors 0-0.5 px, 0-30 % missing"
NEW_POINTS = 200
FEWEST_VIEWS = 8
"""Known points that every camera sees at least: fewer cannot fix a camera."""
WRONG_CAMERA, WRONG_NEES = 5.0, 8.0
ONE_CAMERA_KINDS = ("ordinary", "aspect", "crop", "tilt", "window", "mirror", "telephoto", "wide")
IMAGES = ((640, 480), (1280, 800), (1280, 1024), (1920, 1080), (2048, 2048), (1024, 1536), (4096, 3000))
METHODS = {
    "forward-gp": lambda: ForwardGP(),
    "forward-gp:none": lambda: ForwardGP(lens="none"),
    "forward-gp:central": lambda: ForwardGP(lens="central"),
    "explicit": lambda: Explicit(),
    "inverse-gp": lambda: InverseGP(),
}


# Drawing a rig. It is built round the origin in millimetres, and then moved into a world nobody chose for us.


@dataclass(frozen=True)
class OddRig:
    """A rig, the known points it learns from, and new points to measure; what was drawn, in words."""

    kind: str
    seed: int
    rig: Rig
    known: object
    new: object
    noise: float
    about: str


@dataclass(frozen=True)
class Wish:
    """What one camera shall be like: half of the field in degrees, and what is odd about it."""

    kind: str
    half_field: float
    aspect: float = 1.0
    crop: tuple = (0.0, 0.0)
    tilt: tuple = (0.0, 0.0)
    mirrored: bool = False
    window: tuple | None = None
    wide: bool = False


def draw(kind, seed):
    """The rig number `seed` of a kind, with its known and its new points."""
    for attempt in range(200):
        rng = np.random.default_rng([*kind.encode(), seed, attempt])
        drawn = attempted(kind, seed, rng)
        if drawn is not None:
            return drawn
    raise RuntimeError(f"no measurable rig of kind {kind} was found for seed {seed}")


def attempted(kind, seed, rng):
    """A rig if all cameras see enough points of it, and the new points are seen twice; else None."""
    cameras = int(rng.integers(2, 13))
    points = int(np.exp(rng.uniform(np.log(10), np.log(1000.999))))
    noise = float(np.exp(rng.uniform(np.log(0.05), np.log(0.5))))
    lens_error = float(rng.uniform(0, 0.5) if rng.random() < 0.7 else 0.0)
    size = drawn_size(kind, rng)
    directions, cone = drawn_directions(kind, cameras, size, rng)
    wishes = drawn_wishes(kind, cameras, rng)
    walls = drawn_walls(directions, size, rng) if kind == "tank" else [None] * cameras
    built = [
        built_camera(f"cam{i + 1}", wishes[i], directions[i], size, walls[i], lens_error, noise, rng)
        for i in range(cameras)
    ]
    if any(camera is None for camera in built):
        return None
    rig = moved(Rig(f"odd-{kind}", tuple(built), Box(Pose(np.eye(3), np.zeros(3)), size), "mm", "random", seed), rng)
    rig, unit, scale = scaled(rig, kind, rng)
    known = positions(rig, points, grid=rng.random() < 0.3, rng=rng)
    new = positions(rig, NEW_POINTS, grid=False, rng=rng)
    missing = float(rng.uniform(0, 0.3) if rng.random() < 0.6 else 0.0)
    shares = np.array([views(rig, target)[1].mean(axis=0) for target in (known, new)])
    if (shares < 0.5).any() or (shares[0] * len(known.xyz) * (1 - missing) < FEWEST_VIEWS + 2).any():
        return None
    data = [simulate(rig, target, seed=int(rng.integers(2**31)), missing=missing) for target in (known, new)]
    if (data[0].observations.seen.sum(axis=0) < FEWEST_VIEWS).any():
        return None
    if (data[1].observations.seen.sum(axis=1) >= 2).mean() < 0.5:
        return None
    stated = kind != "integer" and rng.random() < 0.7
    sized = rng.random() < 0.75
    data = [as_reported(one, kind == "integer", stated, sized, unit) for one in data]
    if kind == "wild":
        data[0] = with_wild_views(data[0], rig, rng)
    if kind == "integer":
        noise = float(np.hypot(noise, 1 / np.sqrt(12)))
    fields = [wish.half_field for wish in wishes]
    about = ", ".join(
        [
            f"cone {cone:.0f} deg, fields {min(fields):.3g}-{max(fields):.3g} deg",
            f"noise {noise:.2g} px" + ("" if stated else " (not stated)"),
            f"lens errors {lens_error:.2g} px, missing {missing:.2f}" + ("" if sized else ", sizes not stated"),
            *([f"length scale {scale:g}"] if scale != 1 else []),
            *in_runs([described(wish) for wish in wishes]),
        ]
    )
    return OddRig(kind, seed, rig, *data, noise, about)


def described(wish):
    """What is odd about a camera, in a few words."""
    words = [wish.kind]
    if wish.aspect != 1:
        words.append(f"{wish.aspect:.2f}")
    if any(wish.crop):
        words.append(f"{np.hypot(*wish.crop):.2f}")
    if any(wish.tilt):
        words.append(f"{np.degrees(np.hypot(*wish.tilt)):.1f} deg")
    if wish.window is not None:
        words.append(f"{np.degrees(wish.window[0]):.0f} deg")
    if wish.kind == "mirror" and not wish.mirrored:
        words = ["straight"]
    return " ".join(words)


def in_runs(words):
    """Words in their order, neighbours that are the same as one with their number."""
    runs = []
    for word in words:
        if runs and runs[-1][0] == word:
            runs[-1][1] += 1
        else:
            runs.append([word, 1])
    return [word if n == 1 else f"{n} {word}" for word, n in runs]


def drawn_size(kind, rng):
    """(3,) edges of the working volume in mm; z is the way the cameras look."""
    size = 200 * np.exp(rng.uniform(-0.4, 0.4, size=3))
    if kind == "thin-slab":
        size[2] = rng.uniform(0.02, 0.1) * size[:2].max()
    return size


def drawn_directions(kind, n, size, rng):
    """(n, 3) unit vectors from the volume to the cameras, well apart, within a cone about -z; its half angle."""
    widest = {"tank": 40, "thin-slab": 50}.get(kind, 90)
    cone = float(rng.uniform(25, widest))
    chosen = []
    for _ in range(n):
        others = rng.normal(size=(40, 3))
        angle = np.arccos(rng.uniform(np.cos(np.radians(cone)), 1, size=40))
        around = np.arctan2(others[:, 1], others[:, 0])
        candidates = np.column_stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), -np.cos(angle)])
        if not chosen:
            chosen.append(candidates[0])
            continue
        near = np.max(np.abs(candidates @ np.array(chosen).T), axis=1)  # opposite cameras see the same lines
        chosen.append(candidates[np.argmin(near)])
    directions = np.array(chosen)
    if kind == "tank" and rng.random() < 0.4 and n > 2:  # a tank that is looked into from more sides than one
        turns = rng.choice([0, 1, 2, 3], size=n) * np.pi / 2
        directions = np.einsum("nij,nj->ni", rotation_from_vector(np.outer(turns, [0.0, 1.0, 0.0])), directions)
    return directions, cone


def drawn_walls(directions, size, rng):
    """For each camera the wall of one tank: outward normal (3,), distance from the middle in mm, thickness in mm."""
    half = 0.5 * size * rng.uniform(1.05, 1.6, size=3)
    thickness = float(rng.uniform(2, 30))
    walls = np.array([[0, 0, -1], [0, 0, 1], [1, 0, 0], [-1, 0, 0]], dtype=float)
    nearest = np.argmax(directions @ walls.T, axis=1)
    return [(walls[w], float(np.abs(walls[w]) @ half), thickness) for w in nearest]


def drawn_wishes(kind, n, rng):
    """What each camera shall be like."""
    if kind == "mixed":
        kinds = [ONE_CAMERA_KINDS[i % len(ONE_CAMERA_KINDS)] for i in rng.permutation(len(ONE_CAMERA_KINDS))]
        return [drawn_wish(kinds[i % len(kinds)], rng) for i in range(n)]
    wishes = [drawn_wish(kind, rng) for _ in range(n)]
    if kind == "aspect" and rng.random() < 0.5:
        wishes = [replace(w, aspect=wishes[0].aspect) for w in wishes]
    if kind == "mirror":
        many = rng.choice([1, int(rng.integers(1, n + 1)), n])
        some = rng.permutation(n) < many
        wishes = [replace(w, mirrored=bool(m)) for w, m in zip(wishes, some, strict=True)]
    return wishes


def drawn_wish(kind, rng):
    """What a camera of a kind shall be like."""
    if kind == "aspect":
        return Wish(kind, field(rng, 5, 40), aspect=float(np.exp(rng.uniform(np.log(0.5), np.log(2)))))
    if kind == "crop":
        off, way = rng.uniform(0.1, 0.6), rng.uniform(0, 2 * np.pi)
        return Wish(kind, field(rng, 4, 25), crop=(float(off * np.cos(way)), float(off * np.sin(way))))
    if kind == "tilt":
        tilt, way = np.radians(rng.uniform(2, 15)), rng.uniform(0, 2 * np.pi)
        return Wish(kind, field(rng, 5, 60), tilt=(float(tilt * np.cos(way)), float(tilt * np.sin(way))))
    if kind == "window":
        oblique, way = np.radians(rng.uniform(0, 45)), rng.uniform(0, 2 * np.pi)
        return Wish(kind, field(rng, 4, 25), window=(float(oblique), float(way)))
    if kind == "wide":
        return Wish(kind, field(rng, 60, 95), wide=True)
    low, high = {"telephoto": (0.5, 3), "tank": (4, 25), "thin-slab": (4, 40)}.get(kind, (8, 45))
    return Wish(kind, field(rng, low, high), mirrored=kind == "mirror")


def field(rng, low, high):
    """Half of a field in degrees, even in its logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def built_camera(name, wish, direction, size, wall, lens_error, noise, rng):
    """A camera that looks at the volume as wished; None where that cannot be built."""
    width, height = IMAGES[rng.integers(len(IMAGES))]
    height = round(height * wish.aspect)
    shape = rng.uniform(-1, 1, size=6)
    roll = float(rng.uniform(-np.pi, np.pi) if rng.random() < 0.4 else rng.normal(scale=0.05))
    aim = rng.normal(scale=0.07, size=2)
    fill = float(rng.uniform(0.75, 0.97))
    ball = 0.5 * float(np.linalg.norm(size))
    wall = wall or drawn_pane(wish, direction, ball, rng)
    distance = distance_to(wish, direction, size, ball, wall, rng)
    if distance is None:
        return None
    centre = distance * direction
    error = random_error(np.random.default_rng(rng.integers(2**32)), width, height, lens_error)
    up = np.linalg.qr(np.column_stack([direction, [0.1, -1.0, 0.2]]))[0][:, 1]
    inside = rng.uniform(-0.5, 0.5, size=(300, 3)) * size
    towards = seen_direction(centre, wall)
    aimed = look_at(centre, centre + towards, up if up[1] < 0 else -up)
    aimed = Pose(rotation_from_vector([0.0, 0.0, roll]), np.zeros(3)) @ aimed
    widest = np.radians(min(wish.half_field, 100))
    focal = 0.5 * min(width, height / wish.aspect) / (widest if wish.wide else np.tan(min(widest, 1.1)))
    camera = None
    for _ in range(4):
        lens = drawn_lens(wish, focal, width, height, widest, shape)
        if lens is None:
            return None
        camera = SimulatedCamera(name, width, height, lens, aimed, error, noise, wish.tilt, wish.mirrored)
        camera = turned_towards(camera, aimed, centre, towards, aim * widest, wall)
        if camera is None:
            return None
        if wish.wide:  # the lens is as wide as wished, whatever it sees of the volume
            break
        uv, _ = replace(
            camera, error=replace(error, amplitudes=0 * error.amplitudes, affine=0 * error.affine)
        ).pixel_from_world(inside)
        if np.isnan(uv).mean() > 0.1:
            return None
        half = np.array([width, height]) / 2
        reach = np.nanpercentile(np.abs(uv + 0.5 - half) / half, 98)
        focal *= fill / reach
    return camera


def drawn_pane(wish, direction, ball, rng):
    """The pane before one camera: outward normal, distance of its water side from the middle, thickness; or None."""
    if wish.window is None:
        return None
    oblique, way = wish.window
    across = np.linalg.svd(direction[None])[2][1:]
    axis = np.cos(way) * across[0] + np.sin(way) * across[1]
    normal = rotation_from_vector(oblique * axis) @ direction
    return normal, ball * float(rng.uniform(1.02, 1.4)), float(rng.uniform(2, 30))


def distance_to(wish, direction, size, ball, wall, rng):
    """How far from the volume's middle the camera stands."""
    if wish.wide:
        out = 0.5 / np.max(np.abs(direction) / size)  # where the direction leaves the box
        return max(1.1 * out, ball * float(rng.uniform(0.85, 1.1)))
    distance = ball / np.sin(np.radians(min(wish.half_field, 80.0)))
    if wall is not None:
        normal, front, thickness = wall
        cos = float(direction @ normal)
        if cos < 0.5:
            return None
        distance = max(distance, (front + thickness + 0.25 * ball) / cos)
    return distance


def seen_direction(centre, wall):
    """(3,) where the middle of the volume seems to be, seen from `centre`."""
    if wall is None:
        return -centre
    apparent, _ = window_of(Pose(np.eye(3), -centre), wall).apparent(-centre[None])
    return apparent[0]


def window_of(camera_from_world, wall):
    """The window in a camera's frame."""
    normal, water_side, thickness = wall
    inward = -camera_from_world.rotation @ normal
    depth = float(camera_from_world.centre @ normal)
    return Window(inward, depth - water_side - thickness, thickness)


def drawn_lens(wish, focal, width, height, widest, shape):
    """A lens with bounded distortion at the edge of what it shows: it must not fold."""
    cx, cy = (np.array([width, height]) - 1) / 2 + np.array([1, wish.aspect]) * max(
        width, height / wish.aspect
    ) * wish.crop
    cx, cy = cx + shape[0] * 0.015 * width, cy + shape[1] * 0.015 * height
    square = np.array([width, height / wish.aspect]) / 2
    corner = float(np.linalg.norm(square + max(2 * square) * np.abs(wish.crop))) / focal
    fx, fy = focal, focal * wish.aspect * (1 + 0.001 * shape[5])
    if wish.wide or widest > np.radians(38) or (widest > np.radians(12) and shape[4] > 0):
        angle = min(corner, np.pi / 2 + 0.3)
        k1, k2 = 0.06 * shape[2] / angle**2, 0.02 * shape[3] / angle**4
        return KannalaBrandt(fx, fy, float(cx), float(cy), float(k1), float(k2))
    if corner > 3:
        return None
    # long lenses distort less: 2 % in the corner of a telephoto picture, 9 % of a wide one
    part = np.clip(widest / np.radians(15), 0.25, 1)
    k1, k2 = part * (0.06 * shape[2] - 0.03) / corner**2, part * 0.02 * shape[3] / corner**4
    p1, p2 = 0.002 * shape[4] / corner, 0.002 * shape[3] / corner
    return BrownConrady(fx, fy, float(cx), float(cy), float(k1), float(k2), float(p1), float(p2))


def turned_towards(camera, aimed, centre, towards, off, wall):
    """The camera turned so that the middle of its image looks where the volume seems to be, but for `off` radians."""
    middle = np.array([[(camera.width - 1) / 2, (camera.height - 1) / 2]])
    rays, valid = camera.ray_from_pixel(middle)
    if not valid[0]:
        return None
    wanted = aimed.rotation @ towards
    wanted = rotation_from_vector([off[0], off[1], 0.0]) @ (wanted / np.linalg.norm(wanted))
    turn, _ = Rotation.align_vectors(rays, wanted[None])  # rays = turn wanted
    rotation = turn.as_matrix() @ aimed.rotation
    pose = Pose(rotation, -rotation @ centre)
    return replace(camera, camera_from_world=pose, window=None if wall is None else window_of(pose, wall))


def moved(rig, rng):
    """The rig in another frame: any rotation, and an offset of up to a metre."""
    turn = Rotation.random(random_state=rng).as_matrix()
    world_from_bench = Pose(turn, rng.uniform(-1000, 1000, size=3))
    return in_world(rig, world_from_bench, 1.0)


def in_world(rig, world_from_bench, scale):
    """The rig in another frame, and then all lengths times `scale`."""
    bench_from_world = world_from_bench.inverse()
    cameras = []
    for camera in rig.cameras:
        pose = camera.camera_from_world @ bench_from_world
        window = None if camera.window is None else camera.window.scaled(scale)
        cameras.append(replace(camera, camera_from_world=Pose(pose.rotation, pose.translation * scale), window=window))
    box = world_from_bench @ rig.volume.world_from_box
    box = Box(Pose(box.rotation, box.translation * scale), rig.volume.size * scale)
    return replace(rig, cameras=tuple(cameras), volume=box)


def scaled(rig, kind, rng):
    """The rig in its unit: millimetres, or metres in a country's coordinates, or absurdly small or large numbers."""
    which = rng.integers(4) if kind == "scale" else -1
    still = Pose(np.eye(3), np.zeros(3))
    if which in (0, 1):  # coordinates of a country, in metres; the volume is 0.2 m, or 2 mm
        scale = (1e-3, 1e-5)[which]
        offset = Pose(np.eye(3), rng.uniform(0.5e6, 5e6, size=3) * [1, 1, 1e-4])
        return in_world(in_world(rig, still, scale), offset, 1.0), "m", scale
    scale = {2: 1e-6, 3: 1e6}.get(int(which), 1.0)
    return in_world(rig, still, scale), "mm", scale


def positions(rig, n, *, grid, rng):
    """A target of n positions in the volume, at random or on a lattice with as many."""
    parts = rng.uniform(-0.5, 0.5, size=(n, 3))
    if grid and n >= 27:
        sides = np.maximum(2, np.round((n / np.prod(rig.volume.size)) ** (1 / 3) * rig.volume.size)).astype(int)
        steps = [np.linspace(-0.5, 0.5, k) for k in sides]
        parts = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)[: max(n, 1000)]
    names = np.array([f"p{i + 1:04d}" for i in range(len(parts))])
    xyz = rig.volume.world_from_box.apply(parts * rig.volume.size)
    return Target("points", names, names, xyz)


def as_reported(data, rounded, stated, sized, unit):
    """What somebody hands over: whole pixels, no sd, no image sizes."""
    o = data.observations
    uv = np.rint(o.uv) if rounded else o.uv
    sd = o.sd if stated else np.full_like(o.sd, np.nan)
    cameras = o.cameras if sized else tuple(Camera(camera.name) for camera in o.cameras)
    return replace(data, length_unit=unit, observations=Observations(o.points, cameras, uv, sd, o.extra))


def with_wild_views(data, rig, rng):
    """The data with one view to 2 % of them wrong, at most one of a point: anywhere in the image, or on no image."""
    o = data.observations
    uv = np.array(o.uv)
    most = max(1, min(int(0.02 * o.seen.sum()), len(uv) // 4))
    for i in rng.choice(len(uv), int(rng.integers(1, most + 1)), replace=False):
        c = rng.choice(np.flatnonzero(o.seen[i])) if o.seen[i].any() else 0
        if not o.seen[i, c]:
            continue
        size = np.array([rig.cameras[c].width, rig.cameras[c].height])
        far = 1.0 if o.cameras[c].width else float(rng.choice([1.0, 100.0]))
        uv[i, c] = rng.uniform(0, far * (size - 1))
    return replace(data, observations=Observations(o.points, o.cameras, uv, o.sd, o.extra))


# Judging a calibration of it.


def judged(job):
    """One rig drawn, fitted and judged: a row of plain values, for a line of JSON."""
    kind, seed, method, seconds, fit_only = job
    odd = draw(kind, seed)
    row = {
        "kind": kind,
        "seed": seed,
        "cameras": len(odd.rig.cameras),
        "points": len(odd.known),
        "noise": odd.noise,
        "about": odd.about,
        "refused": "",
        "verdict": "",
    }
    signal.signal(signal.SIGALRM, _too_long)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    start = time.perf_counter()
    try:
        with warnings.catch_warnings(record=True) as told, blas_threads(1):
            warnings.simplefilter("always")
            calibration = METHODS[method]().fit(odd.known)
            row["fit_seconds"] = time.perf_counter() - start
            row |= of_known_points(odd, calibration)
            begin = time.perf_counter()
            row["verdict"] = verdict_of(calibration)
            row["verdict_seconds"] = time.perf_counter() - begin
            if not fit_only:
                row |= of_new_points(odd, calibration)
    except ImplicamError as error:
        row["refused"] = " ".join(str(error).split())
    except TimeoutError:
        row["refused"] = f"time limit: more than {seconds:g} s"
    except Exception as error:
        row["refused"] = f"CRASH {type(error).__name__}: {error}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    row.setdefault("fit_seconds", time.perf_counter() - start)
    row["warnings"] = sorted({f"{w.category.__name__}: {w.message}" for w in told if w.category is not UserWarning})
    if row["verdict"] == "not usable":
        row["refused"] = "not usable"
    row["wrong"] = is_wrong(row)
    return row


def _too_long(_signal, _frame):
    raise TimeoutError


def of_known_points(odd, calibration):
    """Which cameras are not calibrated, and how far the others are off their own known points, over the noise."""
    names = odd.known.observations.camera_names
    there = getattr(calibration, "camera_names", names)
    row = {"blind": [name for name in names if name not in there], "off": {}}
    if hasattr(calibration, "predict"):
        uv = calibration.predict(odd.known.truth.xyz)
        true_uv = np.stack([odd.known.observations.extra[k] for k in ("true_u", "true_v")], axis=-1)
        seen = odd.known.observations.seen
        for c, name in enumerate(names):
            if name in there:
                error = np.linalg.norm(uv[seen[:, c], c] - true_uv[seen[:, c], c].astype(float), axis=1)
                error = np.nan_to_num(error, nan=1e6)  # no pixel where the camera has one: as far off as can be
                row["off"][name] = float(np.median(error)) / odd.noise
    return row


def of_new_points(odd, calibration):
    """How well 200 new points are measured, against their true positions."""
    start = time.perf_counter()
    m = calibration.measure(odd.new.observations)
    row = {
        "measure_seconds": time.perf_counter() - start,
        "new": int((odd.new.observations.seen.sum(axis=1) >= 2).sum()),
    }
    truth = odd.new.truth
    row["measured"] = int(m.measured.sum())
    if not m.measured.any():
        return row
    overall = assess(m.xyz - truth.xyz, m.cov, limit=truth.limit).overall
    return row | {
        "nees": overall.nees.value,
        "in_ellipsoid": overall.level(0.95).ellipsoid.value,
        # the limit knows of the noise, and not that it was rounded
        "rmse_over_limit": overall.rmse_over_limit * odd.rig.cameras[0].noise_sd / odd.noise,
        "sharpness": overall.stated_rms / overall.rmse,
        "contradict": float(np.mean(m.consistency[m.measured] < 1e-4)),
    }


def verdict_of(calibration):
    """ "usable", "doubtful" or "not usable", where calibrations have a verdict; else nothing."""
    verdict = getattr(calibration, "verdict", None)
    if verdict is None:
        try:
            module = importlib.import_module("implicam.verdict")
        except ImportError:
            return ""
        judge = next(
            (getattr(module, name) for name in ("judge", "verdict_of", "verdict") if hasattr(module, name)), None
        )
        verdict = judge(calibration) if judge else None
    if callable(verdict):
        verdict = verdict()
    for name in ("word", "level", "verdict", "value"):
        verdict = getattr(verdict, name, verdict)
    text = str(verdict or "").lower().replace("_", " ")
    return next((word for word in ("not usable", "doubtful", "usable") if word in text), "")


def is_wrong(row):
    """Whether a camera is off its own known points, or the error bars of new points lie by far."""
    return max(row.get("off", {}).values(), default=0) > WRONG_CAMERA or row.get("nees", 0) > WRONG_NEES


def is_silent(row):
    """Whether it is wrong and nothing was said."""
    return bool(row["wrong"]) and not row["refused"] and row["verdict"] in ("", "usable")


def line(row):
    """One rig in one line."""
    head = f"{row['kind']:10s} {row['seed']:4d}: {row['cameras']:2d} cam {row['points']:4d} pts"
    head += f" {row['fit_seconds']:5.1f} s"
    if row["refused"]:
        return f"{head}  REFUSED {row['refused'][:150]}  [{row['about']}]"
    off = row["off"]
    bad = {name: round(x, 1) for name, x in off.items() if x > WRONG_CAMERA}
    parts = [f"off {max(off.values(), default=np.nan):.2g}"]
    if "nees" in row:
        parts.append(
            f"NEES {row['nees']:.3g} in 95 % {100 * row['in_ellipsoid']:.0f} % rmse/limit {row['rmse_over_limit']:.3g}"
        )
    if row.get("measured", 0) < row.get("new", 0):
        parts.append(f"{row['measured']} of {row['new']} measured")
    if row["blind"]:
        parts.append(f"blind {','.join(row['blind'])}")
    parts += [row["verdict"]] if row["verdict"] else []
    parts += [f"WRONG {bad or ''}"] if row["wrong"] else []
    parts += row["warnings"]
    return f"{head}  {'; '.join(parts)}  [{row['about']}]"


COLUMNS = (
    "kind", "rigs", "refused", "silently wrong", "wrong with a word", "cameras calibrated", "in the 95 % ellipsoids",
    "median NEES", "median rmse / limit", "doubtful among right", "warnings", "median and slowest fit (s)",
)  # fmt: skip


def table(rows):
    """The table per kind, with a last row of all."""
    yield f"| {' | '.join(COLUMNS)} |"
    yield "|---" * len(COLUMNS) + "|"
    kinds = list(dict.fromkeys(row["kind"] for row in rows))
    for kind in kinds:
        yield table_row(kind, [row for row in rows if row["kind"] == kind])
    yield table_row("**all**", rows)


def table_row(label, rows):
    kept = [row for row in rows if not row["refused"]]
    right = [row for row in kept if not row["wrong"]]
    judged_points = [row for row in kept if "nees" in row]
    points = sum(row["measured"] for row in judged_points)
    inside = sum(row["measured"] * row["in_ellipsoid"] for row in judged_points)
    calibrated = sum(row["cameras"] - len(row["blind"]) for row in kept)
    seconds = [row["fit_seconds"] for row in rows]
    silent = [row for row in kept if is_silent(row)]
    cells = [
        label,
        len(rows),
        len(rows) - len(kept),
        len(silent),
        sum(bool(row["wrong"]) for row in kept) - len(silent),
        f"{100 * calibrated / sum(row['cameras'] for row in rows):.1f} %",
        f"{100 * inside / points:.1f} %" if points else "",
        median(judged_points, "nees"),
        median(judged_points, "rmse_over_limit"),
        f"{sum(row['verdict'] == 'doubtful' for row in right)} of {len(right)}",
        sum(bool(row["warnings"]) for row in rows),
        f"{np.median(seconds):.2g}, {max(seconds):.2g}",
    ]
    return f"| {' | '.join(map(str, cells))} |"


def median(rows, key):
    return f"{np.median([row[key] for row in rows]):.3g}" if rows else ""


def options_of():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", type=int, default=22, help="of each kind")
    parser.add_argument("--kinds", default=",".join(RANGES), help="separated by commas")
    parser.add_argument("--seed0", type=int, default=0, help="the first seed")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--method", choices=METHODS, default="forward-gp")
    parser.add_argument("--limit", type=float, default=120, help="seconds for a rig")
    parser.add_argument("--fit-only", action="store_true", help="no new points are measured")
    parser.add_argument("-v", "--verbose", action="store_true", help="a line for every rig")
    parser.add_argument("--lines", type=Path, help="write the rows as lines of JSON")
    parser.add_argument("-o", "--output", type=Path, help="write the table")
    options = parser.parse_args()
    unknown = set(options.kinds.split(",")) - set(RANGES)
    if unknown:
        parser.error(f"no kind {', '.join(sorted(unknown))}; there are {', '.join(RANGES)}")
    return options


def main():
    options = options_of()
    kinds = options.kinds.split(",")
    last = options.seed0 + options.rigs
    jobs = [
        (kind, seed, options.method, options.limit, options.fit_only)
        for seed in range(options.seed0, last)
        for kind in kinds
    ]
    rows = []
    start = time.perf_counter()
    with ProcessPoolExecutor(options.jobs) as pool:
        for row in pool.map(judged, jobs):
            rows.append(row)
            if options.verbose:
                print(line(row), flush=True)
            if options.lines:
                with options.lines.open("w" if len(rows) == 1 else "a") as out:
                    out.write(json.dumps(row) + "\n")
    rows.sort(key=lambda row: kinds.index(row["kind"]))
    text = [
        f"{options.method}, seeds {options.seed0} to {last - 1} of each kind; {COMMON}.",
        "",
        *(f"- {kind}: {RANGES[kind]}" for kind in kinds),
        "",
        *table(rows),
        "",
        "Refused or wrong:",
        "",
        *(f"- {line(row)}" for row in rows if row["refused"] or row["wrong"]),
    ]
    print("\n".join(text), flush=True)
    print(f"\n{time.perf_counter() - start:.0f} s with {options.jobs} processes")
    if options.output:
        write_text(options.output, "\n".join(text) + "\n")


if __name__ == "__main__":
    main()
