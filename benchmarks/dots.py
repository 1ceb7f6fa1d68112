"""Dots found in real photographs of known targets, against the pixels that others published.

    python benchmarks/dots.py ../shared/real [--seeds 10] [--overlays docs/images] [-o benchmarks/results/dots.md]
    python benchmarks/dots.py ../shared/real --clicks

Six dots per camera are labelled as a person would: the published pixel, rounded, and up to a pixel beside it. They are
spread over the target and its depths (the best of 30 random sextets); *any six* takes the first sextet, which may lie
at one depth. found: of the published dots, within 0.3 px. Everything is the worst over the seeds.

--clicks: as on the page of `implicam label`, which proposes the dots; a click is up to 7 px beside the one meant
(2 px where dots are dense). What the page finds after four and after six of them, and clicks that missed.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from implicam.dataset import read_dataset
from implicam.detect.dots import Dots
from implicam.detect.labelling import Guess, Labelling
from implicam.detect.model import View
from implicam.detect.overlay import Result, draw_overlay
from implicam.files import write_text
from implicam.images import eight_bit, opencv, read_picture

DATASETS = ("water-tank-target", "two-sided-tank", "image-splitter")
OVERLAYS = {
    "water-tank-target": ("cam1", "dots-water-tank.jpg"),
    "two-sided-tank": ("cam3", "dots-two-sided.jpg"),
    "image-splitter": ("cam4", "dots-image-splitter.jpg"),
}
FOUND = 0.3


def sextet(xyz, rng, tries):
    """Six rows: those that spread most in their narrowest direction, of so many random sextets."""
    best = (-1.0, None)
    for _ in range(tries):
        rows = rng.choice(len(xyz), 6, replace=False)
        spread = (xyz[rows] - xyz[rows].mean(axis=0)) / xyz.std(axis=0)
        narrow = np.linalg.svd(spread, compute_uv=False)[-1]
        if narrow > best[0]:
            best = (narrow, rows)
    return best[1]


def labels(data, camera, seed, tries):
    """{point: (u, v)} as clicked."""
    rng = np.random.default_rng(seed)
    uv = data.observations.uv[:, camera]
    seen = np.flatnonzero(np.isfinite(uv[:, 0]))
    rows = seen[sextet(data.xyz[seen], rng, tries)]
    clicked = np.rint(uv[rows]) + rng.integers(-1, 2, (6, 2))
    return {str(data.points[row]): tuple(map(float, pixel)) for row, pixel in zip(rows, clicked, strict=True)}


def detected(folder, data, camera, seed, tries):
    name = data.cameras[camera].name
    picture = read_picture(folder / "images" / name / "target.png")
    marks = {View(name, ""): labels(data, camera, seed, tries)}
    return picture, Dots(tuple(map(str, data.points)), data.positions, marks).detect(picture, View(name, "target"))


def compared(found, data, camera):
    """Share found within `FOUND`, rms and largest distance of those, dots farther off, wrong labels, unpublished."""
    uv = dict(zip(map(str, data.points), data.observations.uv[:, camera], strict=True))
    off = np.array([np.linalg.norm(at - uv[name]) for name, at in zip(found.points, found.uv, strict=True)])
    known = off[np.isfinite(off)]
    good = known[known <= FOUND]
    there = int(np.isfinite(data.observations.uv[:, camera, 0]).sum())
    rms = float(np.sqrt(np.mean(known**2))) if len(known) else np.nan
    most = float(known.max(initial=0))
    return len(good) / there, rms, most, int((known > FOUND).sum()), int((known > 2).sum()), int(np.isnan(off).sum())


def table(folder, seeds):
    yield "| dataset | camera | dots | found | rms, px | max, px | > 0.3 px | wrong | unpublished | found, any six |"
    yield "|---|---|---|---|---|---|---|---|---|---|"
    for name in DATASETS:
        data = read_dataset(folder / name)
        for c, camera in enumerate(data.cameras):
            rows = [compared(detected(folder / name, data, c, seed, 30)[1], data, c) for seed in range(seeds)]
            random = [compared(detected(folder / name, data, c, seed, 1)[1], data, c)[0] for seed in range(seeds)]
            there = int(np.isfinite(data.observations.uv[:, c, 0]).sum())
            found = min(row[0] for row in rows)
            rms, most, far, wrong, extra = (max(row[k] for row in rows) for k in range(1, 6))
            any_six = f"{np.median(random):.3f} median, {min(random):.3f} worst"
            worst = f"{found:.3f} | {rms:.3f} | {most:.2f} | {far} | {wrong} | {extra}"
            yield f"| {name} | {camera.name} | {there} | {worst} | {any_six} |"


def visit(folder, data, camera, seed, scratch):
    """What a visitor of the page sees after four clicks and after six: (found, wrong) each; clicks that missed."""
    view, uv = View(data.cameras[camera].name, ""), data.observations.uv[:, camera]
    at = {name: pixel for name, pixel in zip(map(str, data.points), uv, strict=True) if np.isfinite(pixel[0])}
    page, rng = (
        Labelling.open(folder, labels=scratch / f"{folder.name}-{view.camera}-{seed}.csv"),
        np.random.default_rng(seed),
    )
    within = float(np.clip(np.hypot(*page.picture(view).shape) / np.sqrt(len(data)) / 8, 4, 10))
    counts, missed, guess = [], 0, Guess()
    for clicks in range(1, 7):
        while (name := page.propose(view, guess)) not in at:
            page.skip(view, name)
        turn = rng.uniform(0, 2 * np.pi)
        beside = rng.uniform(0, 0.7) * within * np.array([np.cos(turn), np.sin(turn)])
        missed += not page.place(view, name, at[name] + beside, within)
        missed += np.linalg.norm(np.array(page.marks(view)[name]) - at[name]) > 2
        guess = page.guess(view)
        if clicks in (4, 6):
            off = [np.linalg.norm(np.array(guess.dots[one][:2]) - at[one]) for one in guess.found if one in at]
            counts.append((len(guess.found), int(np.sum(np.array(off) > 2))))
    return *counts, missed


def clicks_table(folder):
    yield "| dataset | camera | dots | found after 4 clicks | after 6 | wrong | clicks that missed |"
    yield "|---|---|---|---|---|---|---|"
    with tempfile.TemporaryDirectory() as scratch:
        for name in DATASETS:
            data = read_dataset(folder / name)
            for c, camera in enumerate(data.cameras):
                seen = [visit(folder / name, data, c, seed, Path(scratch)) for seed in range(3)]
                four, six = (" ".join(str(one[k][0]) for one in seen) for k in (0, 1))
                wrong, missed = sum(one[0][1] + one[1][1] for one in seen), sum(one[2] for one in seen)
                yield f"| {name} | {camera.name} | {len(data)} | {four} | {six} | {wrong} | {missed} of 18 |"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--overlays", type=Path)
    parser.add_argument("--clicks", action="store_true")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    if options.overlays:
        for name, (camera, file) in OVERLAYS.items():
            data = read_dataset(options.folder / name)
            c = [one.name for one in data.cameras].index(camera)
            picture, found = detected(options.folder / name, data, c, 0, 30)
            drawn = draw_overlay(eight_bit(picture), Result(View(camera, "target"), Path(), found, len(data)))
            quality = [opencv().IMWRITE_JPEG_QUALITY, 60]  # these are for the docs, and noise costs bytes
            (options.overlays / file).write_bytes(opencv().imencode(".jpg", drawn[..., ::-1], quality)[1].tobytes())
            print(f"{file}: {len(found)} dots. {found.reason}")
        return
    lines = []
    for line in clicks_table(options.folder) if options.clicks else table(options.folder, options.seeds):
        print(line, flush=True)
        lines.append(line)
    if options.output:
        write_text(options.output, "\n".join([*lines, ""]))


if __name__ == "__main__":
    main()
