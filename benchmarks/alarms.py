"""False and missed alarms: of the verdict on ordinary rigs, of `measure` on their tables, and where damage was done.

    python benchmarks/alarms.py [--rigs 304] [--seed0 0] [--every 4] [--kinds wand,ball] [-v]
                                [--lines alarms.jsonl] [-o benchmarks/results/alarms.md]
    python benchmarks/alarms.py --from alarms.jsonl -o ...                    the tables again from rows written before

Rigs as users have them, in turn of each kind of KINDS; cameras as `odd_rigs` draws them (those of "odd" of all its
kinds). Each is calibrated and judged, and one new table of each kind of TABLES is measured with it untouched. A false
alarm: "doubtful" or "not usable", or an alarm of `measure`, where the rig is right: NEES of 200 new points at most 8.

Then one rig in --every (of all kinds but "odd") is damaged: some kinds of DAMAGED_TABLE, in turn, are done to tables of
10-80 new points each, measured with the untouched calibration; and of DAMAGED_KNOWN some are done to the known points,
which are calibrated and judged again, and a table of 100 points is measured with the rig as it is then. What it costs:
the median distance of the measured positions from the true ones, in their own error bars, over that of honest ones (1
is right); a table with no number left counts as one that costs, and is found. Damage that costs less than COSTS is not
counted as missed. Found by a refusal, "not usable", "doubtful", an alarm, or by a reason in nine of ten rows that are
off by more than 4 sd (or no number there); silent: by none of these. Named: the words of the true cause are there.
"""

from __future__ import annotations

import argparse
import json
import re
import time
import warnings
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from implicam.calibrators import ForwardGP
from implicam.dataset import KnownPositions, Observations
from implicam.errors import ImplicamError
from implicam.files import write_text
from implicam.geometry import Pose, rotation_from_vector
from implicam.simulate import Rig, Target, simulate
from implicam.threads import blas_threads
from implicam.verdict import USABLE, judge
from odd_rigs import FEWEST_VIEWS, RANGES, WRONG_NEES, as_reported, draw, positions

KINDS = {
    "random": "a ball at random places",
    "lattice": "a ball on a lattice",
    "planes": "a board at 2-5 places",
    "wand": "wands of 2-3 balls, a third of the volume long",
    "ball": "a ball; noise that differs by view, its stated sd by 20 % too, and one view in fifty 5 times as far off",
    "integer": "whole pixels, no sd stated",
    "errors stated": "known positions off by 0.02-0.3 % of the volume's width, stated",
    "errors untold": "known positions off by 0.005-0.1 % of the volume's width, not stated",
    "odd": "cameras of all the kinds of odd_rigs but ordinary, a ball at random places",
}
TABLES = {
    "small": "10-40 points",
    "large": "100-300 points",
    "border": "40 points between 5 % inside and 10 % outside of the calibrated volume",
    "partly missing": "60 points, 30-60 % of the views missing",
    "bad detection": "60 points, 2-15 % of the views anywhere in the image",
}
DAMAGED_TABLE = {
    "knocked 0.3 deg": "moved",
    "knocked 1 deg": "moved",
    "knocked 3 deg": "moved",
    "moved 5 mm": "moved",
    "two exchanged": "exchanged",
    "u and v of one": "u and v",
    "u and v of all": "u and v",
    "one resized": "half the size|resized",
    "one cropped": "moved or refocused|cropped",
    "another rig": "another|No single one|several",
    "one instant late": "1 row late|1 row early|instant",
}
"""Kind -> a pattern of the words that name it."""
DAMAGED_KNOWN = {
    "labels one row on": "row|order",
    "half in metres": "unit|metres",
    "two labels exchanged": "label|known position|exchanged|contradict",
    "rows duplicated": "copies",
    "a camera copied": "one camera|copies",
    "one camera late": "instant|row",
    "knocked 0.3 deg halfway": "moved",
    "knocked 1 deg halfway": "moved",
}
COSTS, FAR_OFF = 2.0, 4.0
HONEST = 1.538
"""Median of the distance of a point in three dimensions from its mean, in standard deviations."""
TABLE_DAMAGES, KNOWN_DAMAGES = 6, 2
"""Of a rig that is damaged; of known points each takes a fit and a verdict of its own."""


@dataclass(frozen=True)
class Ordinary:
    """A rig, its known points, and how its cameras report."""

    kind: str
    seed: int
    rig: Rig
    known: object
    about: str
    stated: bool
    sized: bool

    def reported(self, data, rng):
        """What is handed over of a simulated dataset."""
        if self.kind == "ball":
            data = with_ball_noise(data, rng)
        return as_reported(data, self.kind == "integer", self.stated, self.sized, data.length_unit)

    def table(self, target, rng, rig=None, **how):
        """A table of new points."""
        data = simulate(rig or self.rig, target, seed=int(rng.integers(2**31)), **how)
        return self.reported(data, rng)


# --- ordinary rigs ---------------------------------------------------------------------------------------------------


def ordinary(kind, seed):
    """The rig number `seed` of a kind; of two draws the first that can be calibrated at all."""
    odd = [k for k in RANGES if k not in ("ordinary", "integer", "wild")]
    for attempt in range(300):
        rng = np.random.default_rng([*kind.encode(), seed, attempt, 7])
        number = 100_000 * (attempt + 1) + seed * len(KINDS) + list(KINDS).index(kind)
        rig = fewer_cameras(draw(odd[seed % len(odd)] if kind == "odd" else "ordinary", number).rig, rng)
        points = int(np.exp(rng.uniform(np.log(12), np.log(400.999))))
        missing = float(rng.uniform(0, 0.3) if rng.random() < 0.6 else 0.0)
        width = float(rig.volume.size.mean())
        off = {"errors stated": (2e-4, 3e-3), "errors untold": (5e-5, 1e-3)}.get(kind)
        off = width * float(np.exp(rng.uniform(*np.log(off)))) if off else 0.0
        stated = kind != "integer" and rng.random() < 0.7
        sized = bool(rng.random() < 0.75)
        case = Ordinary(kind, seed, rig, None, "", bool(stated), sized)
        data = simulate(rig, laid_out(kind, rig, points, rng), seed=seed, missing=missing, robot_noise=off)
        if (data.observations.seen.sum(axis=0) < FEWEST_VIEWS).any() or len(data) < 12:
            continue
        data = case.reported(data, rng)
        if kind == "errors untold":
            data = replace(data, known=replace(data.positions, sd=np.full_like(data.positions.sd, np.nan)))
        about = f"{len(rig.cameras)} cameras, {len(data)} points, noise {rig.cameras[0].noise_sd:.2g} px"
        about += f"{'' if stated else ' (not stated)'}, missing {missing:.2f}, positions off {off:.2g}"
        return replace(case, known=data, about=about)
    raise RuntimeError(f"no rig of kind {kind} was found for seed {seed}")


def fewer_cameras(rig, rng):
    """The first cameras of a rig: most people have few. Their number is even in its logarithm."""
    return replace(rig, cameras=rig.cameras[: int(np.exp(rng.uniform(np.log(2), np.log(len(rig.cameras) + 0.999))))])


def laid_out(kind, rig, n, rng):
    """Known points as they are shown."""
    if kind == "lattice":
        return positions(rig, max(n, 27), grid=True, rng=rng)
    if kind not in ("planes", "wand"):
        return positions(rig, n, grid=False, rng=rng)
    size, parts, shots = rig.volume.size, [], []
    if kind == "wand":
        each = int(rng.integers(2, 4))
        along = np.linspace(-0.5, 0.5, each)[:, None] * size.mean() / 3
        for _ in range(-(-n // each)):
            turn = rotation_from_vector(rng.normal(size=3))
            parts.append(rng.uniform(-0.5, 0.5, size=3) * (size - size.min() / 3) + along * turn[0])
    else:
        boards = int(rng.integers(2, 6))
        side = max(2, int(np.sqrt(n / boards)))
        steps = np.linspace(-0.35, 0.35, side)
        flat = np.stack([*np.meshgrid(steps, steps), np.zeros((side, side))], axis=-1).reshape(-1, 3) * size
        for depth in np.linspace(-0.4, 0.4, boards):
            turn = rotation_from_vector(np.radians(rng.normal(scale=12, size=3)))
            parts.append(flat @ turn.T + [0, 0, depth * size[2]])
    for i, part in enumerate(parts):
        shots += [f"s{i + 1:03d}"] * len(part)
    xyz = rig.volume.world_from_box.apply(np.concatenate(parts))
    return Target(kind, np.array([f"p{i + 1:04d}" for i in range(len(xyz))]), np.array(shots), xyz)


def with_ball_noise(data, rng):
    """Noise as a detector of balls has it: 0.5-2 times that of the camera, stated not quite so, with a tail."""
    o = data.observations
    true = np.stack([o.extra[k] for k in ("true_u", "true_v")], axis=-1)
    true = np.where(o.seen[..., None], np.where(true == "", "nan", true).astype(float), np.nan)
    wrong = (o.extra["outlier"] == "1")[..., None]
    own = np.exp(rng.normal(scale=0.4, size=(*o.seen.shape, 1)))
    told = o.sd * own * np.exp(rng.normal(scale=0.2, size=own.shape))
    tail = np.where(rng.random(own.shape) < 0.02, 5.0, 1.0)
    uv = np.where(wrong, o.uv, true + (o.uv - true) * own * tail)
    return replace(data, observations=Observations(o.points, o.cameras, uv, told, o.extra))


def new_tables(case, rng):
    """One table of each kind of TABLES, untouched."""
    rig = case.rig
    inside = {name: lambda n: positions(rig, n, grid=False, rng=rng) for name in TABLES}
    sizes = {"small": int(rng.integers(10, 41)), "large": int(rng.integers(100, 301)), "border": 40}
    how = {
        "partly missing": {"missing": float(rng.uniform(0.3, 0.6))},
        "bad detection": {"outliers": float(rng.uniform(0.02, 0.15))},
    }
    for name in TABLES:
        target = inside[name](sizes.get(name, 60))
        if name == "border":
            target = replace(target, xyz=rig.volume.world_from_box.apply(at_the_border(len(target.xyz), rig, rng)))
        yield name, case.table(target, rng, **how.get(name, {}))


def at_the_border(n, rig, rng):
    """(n, 3) places in the box between 5 % inside and 10 % outside of a face."""
    parts = rng.uniform(-0.5, 0.5, size=(n, 3))
    axis, side = rng.integers(0, 3, size=n), rng.choice([-1, 1], size=n)
    parts[np.arange(n), axis] = side * rng.uniform(0.45, 0.6, size=n)
    return parts * rig.volume.size


# --- damage ----------------------------------------------------------------------------------------------------------


def turned(rig, camera, degrees, mm, rng):
    """The rig with one camera turned about its centre by an axis across its view, and moved."""
    cameras = list(rig.cameras)
    one = cameras[camera]
    way = rng.uniform(0, 2 * np.pi)
    turn = rotation_from_vector(np.radians(degrees) * np.array([np.cos(way), np.sin(way), 0.0]))
    step = rng.normal(size=3)
    pose = Pose(turn, mm * step / np.linalg.norm(step)) @ one.camera_from_world
    cameras[camera] = replace(one, camera_from_world=pose)
    return replace(rig, cameras=tuple(cameras))


def damaged_table(case, kind, rng):
    """A table with this damage."""
    n, C = int(np.exp(rng.uniform(np.log(10), np.log(80)))), len(case.rig.cameras)
    c, other = (int(i) for i in rng.choice(C, 2, replace=False))
    rig, target = case.rig, positions(case.rig, n, grid=False, rng=rng)
    if kind.startswith("knocked"):
        rig = turned(rig, c, float(kind.split()[1]), 0.0, rng)
    elif kind == "moved 5 mm":
        rig = turned(rig, c, 0.0, 5.0, rng)
    elif kind == "another rig":
        for i in range(C):
            rig = turned(rig, i, 5.0, 50.0, rng)
    elif kind == "one instant late":
        target = replace(target, xyz=rig.volume.world_from_box.apply(on_a_path(n, rig, rng)))
    data = case.table(target, rng, rig)
    uv, sd = np.array(data.observations.uv), np.array(data.observations.sd)
    if kind == "two exchanged":
        uv[:, [c, other]], sd[:, [c, other]] = uv[:, [other, c]], sd[:, [other, c]]
    elif kind.startswith("u and v"):
        which = slice(None) if kind.endswith("all") else c
        uv[:, which] = uv[:, which, ..., ::-1]
    elif kind == "one resized":
        uv[:, c] = (uv[:, c] + 0.5) / 2 - 0.5
        sd[:, c] /= 2
    elif kind == "one cropped":
        uv[:, c] -= rng.uniform(0.03, 0.2) * np.array([rig.cameras[c].width, rig.cameras[c].height])
    elif kind == "one instant late":
        uv[1:, c], sd[1:, c] = uv[:-1, c], sd[:-1, c]
    return with_views(data, uv, sd)


def on_a_path(n, rig, rng):
    """(n, 3) places in the box of something that moves by some 3 % of the volume from one picture to the next."""
    t = 0.06 * np.arange(n)[:, None]
    return 0.45 * np.sin(t * rng.uniform(0.6, 1.4, size=3) + rng.uniform(0, 2 * np.pi, size=3)) * rig.volume.size


def with_views(data, uv, sd):
    """The data with other pixels; those outside of a stated image are an error, as they are when a file is read."""
    o = data.observations
    return replace(data, observations=Observations(o.points, o.cameras, uv, sd, o.extra))


def damaged_known(case, kind, rng):
    """The known points with this damage, and the rig as it is afterwards."""
    data, n = case.known, len(case.known)
    o, xyz = data.observations, np.array(data.xyz)
    uv, sd = np.array(o.uv), np.array(o.sd)
    c = int(rng.integers(len(o.cameras)))
    if kind == "labels one row on":
        return replace(data, known=replace(data.positions, xyz=np.roll(xyz, 1, axis=0))), case.rig
    if kind == "half in metres":
        xyz[: n // 2] /= 1000
        return replace(data, known=replace(data.positions, xyz=xyz)), case.rig
    if kind == "two labels exchanged":
        a, b = rng.choice(n, 2, replace=False)
        xyz[[a, b]] = xyz[[b, a]]
        return replace(data, known=replace(data.positions, xyz=xyz)), case.rig
    if kind == "rows duplicated":
        rows = np.concatenate([np.arange(n), np.arange(n // 2)])
        names = np.array([*data.points, *(f"{name}-again" for name in data.points[: n // 2])])
        extra = {key: value[rows] for key, value in o.extra.items()}
        k = data.positions
        known = KnownPositions(names, k.xyz[rows], k.sd[rows], {key: value[rows] for key, value in k.extra.items()})
        return replace(
            data, observations=Observations(names, o.cameras, uv[rows], sd[rows], extra), known=known
        ), case.rig
    if kind == "a camera copied":
        again = replace(o.cameras[c], name="again")
        extra = {key: np.concatenate([value, value[:, [c]]], axis=1) for key, value in o.extra.items()}
        uv, sd = (np.concatenate([x, x[:, [c]]], axis=1) for x in (uv, sd))
        return replace(data, observations=Observations(o.points, (*o.cameras, again), uv, sd, extra)), case.rig
    if kind == "one camera late":
        uv[1:, c], sd[1:, c] = uv[:-1, c], sd[:-1, c]
        return with_views(data, uv, sd), case.rig
    assert kind.startswith("knocked"), kind
    rig = turned(case.rig, c, float(kind.split()[1]), 0.0, rng)
    before, after = (camera.pixel_from_world(data.truth.xyz) for camera in (case.rig.cameras[c], rig.cameras[c]))
    uv[n // 2 :, c] += (after[0] - before[0])[n // 2 :]
    uv[~after[1], c] = np.nan
    return with_views(data, uv, sd), rig


# --- judging ---------------------------------------------------------------------------------------------------------


def cost_of(found, truth):
    """The median distance from the truth in error bars over an honest one, and of the rows that are far off how many
    are there and how many of them without a word."""
    there = found.measured
    if not there.any():
        return {"cost": float("inf"), "far": 0, "far_untold": 0, "rows": 0}
    error = (found.xyz - truth.xyz)[there]
    squares = np.einsum("ni,nij,nj->n", error, np.linalg.pinv(found.cov[there], hermitian=True), error)
    distance = np.sqrt(np.maximum(squares, 0))
    far = distance > FAR_OFF
    untold = far & (found.own_reason[there] == "")
    return {
        "cost": float(np.median(distance)) / HONEST,
        "far": int(far.sum()),
        "far_untold": int(untold.sum()),
        "rows": int(there.sum()),
        "nees": float(squares.mean()),
    }


def of_rig(kind, seed, damaged):
    """One rig: a row for its verdict, one for each table, one for each damage."""
    case = ordinary(kind, seed)
    base = {"kind": kind, "seed": seed, "about": case.about}
    rng = np.random.default_rng([*kind.encode(), seed, 99])
    row = base | {"what": "rig", "refused": "", "verdict": "", "reasons": []}
    start = time.process_time()
    try:
        calibration = ForwardGP().fit(case.known)
        verdict = judge(calibration)
        row |= {"verdict": verdict.word, "reasons": verdict.reasons, "seconds": time.process_time() - start}
        new = case.table(positions(case.rig, 200, grid=False, rng=rng), rng)
        row |= cost_of(calibration.measure(new.observations), new.truth)
    except ImplicamError as error:
        yield row | {"refused": " ".join(str(error).split())}
        return
    yield row
    right = row.get("nees", 0) <= WRONG_NEES
    for name, data in new_tables(case, rng):
        found = calibration.measure(data.observations)
        tested = int((data.observations.seen.sum(axis=1) >= 2).sum())
        row = {"what": "table", "name": name, "right": right, "tested": tested, "alarm": found.alarm}
        yield base | row | cost_of(found, data.truth)
    if not damaged or kind == "odd":
        return
    turn = seed * len(KINDS) + list(KINDS).index(kind)
    for name in in_turn(DAMAGED_TABLE, TABLE_DAMAGES, turn):
        row = base | {"what": "damaged table", "name": name, "refused": "", "alarm": ""}
        try:
            data = damaged_table(case, name, rng)
            found = calibration.measure(data.observations)
            row |= {"tested": int((data.observations.seen.sum(axis=1) >= 2).sum()), "alarm": found.alarm}
            row |= cost_of(found, data.truth)
        except ImplicamError as error:
            row["refused"] = " ".join(str(error).split())
        yield row | {"named": bool(re.search(DAMAGED_TABLE[name], row["alarm"] + row["refused"]))}
    for name in in_turn(DAMAGED_KNOWN, KNOWN_DAMAGES, turn):
        yield base | of_damaged_known(case, name, rng)


def in_turn(names, many, turn):
    """So many of the names, where the last turn stopped."""
    names = list(names)
    return [names[(many * turn + i) % len(names)] for i in range(many)]


def of_damaged_known(case, name, rng):
    row = {"what": "damaged known", "name": name, "refused": "", "alarm": "", "verdict": "", "reasons": []}
    notes = []
    try:
        data, rig = damaged_known(case, name, rng)
        calibration = ForwardGP().fit(data)
        notes = calibration.notes
        verdict = judge(calibration)
        row |= {"verdict": verdict.word, "reasons": verdict.reasons, "notes": notes}
        table = case.table(positions(case.rig, 100, grid=False, rng=rng), rng, rig)
        o = table.observations
        if name == "a camera copied":
            table = replace(case, known=table)
            table, _ = damaged_known(table, name, np.random.default_rng(0))
            o = table.observations
        found = calibration.measure(o)
        row |= {"alarm": found.alarm} | cost_of(found, table.truth)
    except ImplicamError as error:
        row["refused"] = " ".join(str(error).split())
    said = " ".join([row["refused"], *row["reasons"], *notes])
    return row | {"named": bool(re.search(DAMAGED_KNOWN[name], said))}


# --- tables ----------------------------------------------------------------------------------------------------------


def share(part, whole):
    return f"{len(part)} of {len(whole)} ({100 * len(part) / len(whole):.1f} %)" if whole else ""


def markdown(columns, lines):
    return ["| " + " | ".join(columns) + " |", "|---" * len(columns) + "|", *lines, ""]


def row_of(*cells):
    return "| " + " | ".join(map(str, cells)) + " |"


def false_alarms(rows):
    """Of untouched rigs, and of untouched tables."""
    rigs = [row for row in rows if row["what"] == "rig"]
    lines = []
    for kind in [*KINDS, "all but odd"]:
        some = [row for row in rigs if row["kind"] == kind or (kind == "all but odd" and row["kind"] != "odd")]
        fitted = [row for row in some if not row["refused"]]
        right = [row for row in fitted if row.get("nees", 0) <= WRONG_NEES]
        said = [row for row in right if row["verdict"] != USABLE]
        wrong = [row for row in fitted if row.get("nees", 0) > WRONG_NEES]
        silent = [row for row in wrong if row["verdict"] == USABLE]
        median = f"{np.median([row['seconds'] for row in fitted]):.2g}" if fitted else ""
        lines.append(
            row_of(kind, len(some), len(some) - len(fitted), share(said, right), len(wrong), len(silent), median)
        )
    columns = ("known points", "rigs", "refused", "false alarms of the verdict", "wrong", "of them usable", "CPU s")
    yield from markdown(columns, lines)
    tables, lines = [row for row in rows if row["what"] == "table" and row["right"]], []
    for name in [*TABLES, "all"]:
        some = [row for row in tables if name in (row["name"], "all")]
        ours = [row for row in some if row["kind"] != "odd"]
        odd = [row for row in some if row["kind"] == "odd"]
        alarms = [[row for row in part if row["alarm"]] for part in (ours, odd)]
        lines.append(row_of(name, share(alarms[0], ours), share(alarms[1], odd)))
    yield from markdown(("table of a right rig", "false alarms", "of odd rigs"), lines)


def found_by(row):
    """How damage was found, the gravest way; "" where it was not."""
    if row["refused"]:
        return "refused"
    if row.get("verdict", USABLE) not in ("", USABLE):
        return row["verdict"]
    if row["alarm"]:
        return "alarm"
    if row.get("rows") == 0 or row["far_untold"] <= 0.1 * row["far"]:
        return "reasons"
    return ""


def costs(row):
    return bool(row["refused"]) or row["cost"] >= COSTS


def missed_alarms(rows):
    for what, kinds in (("damaged table", DAMAGED_TABLE), ("damaged known", DAMAGED_KNOWN)):
        lines = []
        for name in kinds:
            some = [row for row in rows if row["what"] == what and row["name"] == name]
            costly = [row for row in some if costs(row)]
            ways = Counter(found_by(row) or "silent" for row in costly)
            cheap = [row for row in some if not costs(row)]
            told = sum(found_by(row) not in ("", "reasons") for row in cheap)
            numbers = [row["cost"] for row in some if not row["refused"]]
            named = sum(row["named"] for row in costly if found_by(row) not in ("", "reasons"))
            found = sum(ways[way] for way in ("refused", "not usable", "doubtful", "alarm"))
            cells = [ways[way] for way in ("refused", "not usable", "doubtful", "alarm", "reasons")]
            median = f"{np.median(numbers):.2g}" if numbers else ""
            silent = f"**{ways['silent']}**" if ways["silent"] else 0
            lines.append(
                row_of(
                    name,
                    len(some),
                    median,
                    len(costly),
                    *cells,
                    silent,
                    f"{named} of {found}",
                    f"{told} of {len(cheap)}",
                )
            )
        columns = (what, "done", "median cost", "cost 2 or more", "refused", "not usable", "doubtful", "alarm")
        yield from markdown((*columns, "reasons", "silent", "named", "told of the cheap"), lines)


def special(rows):
    """A line for each false alarm and each silent damage."""
    for row in rows:
        head = f"{row['kind']} {row['seed']} ({row['about']})"
        if row["what"] == "rig" and (row["refused"] or row["verdict"] != USABLE or row.get("nees", 0) > WRONG_NEES):
            reasons = " ".join(row["reasons"])[:400]
            yield f"- {head}: {row['verdict']} {row['refused'][:200]}; NEES {row.get('nees', np.nan):.3g}; {reasons}"
        elif row["what"] == "table" and row["right"] and row["alarm"]:
            yield f"- {head}: table {row['name']}, {row['tested']} tested, cost {row['cost']:.2g}: {row['alarm']}"
        elif row["what"].startswith("damaged") and costs(row) and not found_by(row):
            far = f"{row['far_untold']} of {row['far']} far-off rows without a word, of {row['rows']}"
            yield f"- {head}: {row['name']} silent, cost {row['cost']:.3g}; {far}"


def report(rows):
    yield from [f"- {kind}: {words}" for kind, words in KINDS.items()]
    yield from ["", *(f"- {kind}: {words}" for kind, words in TABLES.items()), ""]
    yield from false_alarms(rows)
    yield from missed_alarms(rows)
    yield from ["False alarms, wrong rigs, and silent damage:", "", *special(rows)]


def options_of():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", type=int, default=342, help="in all, of the kinds in turn")
    parser.add_argument("--seed0", type=int, default=0, help="the first seed of each kind")
    parser.add_argument("--every", type=int, default=4, help="one rig in so many is damaged too; 0: none")
    parser.add_argument("--kinds", default=",".join(KINDS), help="separated by commas")
    parser.add_argument("-v", "--verbose", action="store_true", help="a line for each alarm and each silence")
    parser.add_argument("--lines", type=Path, help="write the rows as lines of JSON")
    parser.add_argument("--from", dest="rows", type=Path, help="take the rows from such a file")
    parser.add_argument("-o", "--output", type=Path, help="write the tables")
    return parser.parse_args()


def main():
    options = options_of()
    kinds, rows, start = options.kinds.split(","), [], time.process_time()
    if options.rows:
        rows = [json.loads(text) for text in options.rows.read_text().splitlines()]
    for i in range(0 if options.rows else options.rigs):
        with warnings.catch_warnings(), blas_threads(1):
            warnings.simplefilter("ignore")
            for row in of_rig(
                kinds[i % len(kinds)],
                options.seed0 + i // len(kinds),
                options.every > 0 and (i + i // len(kinds)) % options.every == 0,
            ):
                rows.append(row)
                if options.lines:
                    with options.lines.open("w" if len(rows) == 1 else "a") as out:
                        out.write(json.dumps(row) + "\n")
                if options.verbose:
                    print(*special([row]), sep="\n", end="\n" * any(True for _ in special([row])), flush=True)
    command = f"python benchmarks/alarms.py --rigs {options.rigs} --seed0 {options.seed0} --every {options.every}"
    text = "\n".join([command, "", *report(rows)])
    print(text, f"\n\n{time.process_time() - start:.0f} s of CPU", flush=True)
    if options.output:
        write_text(options.output, text + "\n")


if __name__ == "__main__":
    main()
