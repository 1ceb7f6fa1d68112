"""Dots found in real photographs of known targets, against the pixels that others published.

    python benchmarks/dots.py ../shared/real [--seeds 10] [--overlays docs/images] [-o benchmarks/results/dots.md]

Six dots per camera are labelled as a person would: the published pixel, rounded, and up to a pixel beside it. They are
spread over the target and its depths (the best of 30 random sextets); *any six* takes the first sextet, which may lie
at one depth. found: of the published dots, within 0.3 px. Everything is the worst over the seeds.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from implicam.dataset import read_dataset
from implicam.detect.dots import Dots
from implicam.detect.model import View
from implicam.files import write_text
from implicam.images import opencv, read_picture

DATASETS = ("water-tank-target", "two-sided-tank", "image-splitter")
OVERLAYS = {
    "water-tank-target": ("cam1", "dots-water-tank.jpg"),
    "two-sided-tank": ("cam3", "dots-two-sided.jpg"),
    "image-splitter": ("cam4", "dots-image-splitter.jpg"),
}
FOUND, SKY, ORANGE, RED = 0.3, (233, 180, 86), (0, 159, 230), (60, 60, 255)


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


def overlay(picture, found, path, zoom):
    """The photograph brightened, dots found, labelled and missing."""
    cv2 = opencv()
    low, high = np.quantile(picture, (0.01, 0.98))
    grey = (np.clip((picture - low) / (high - low), 0, 1) ** 0.6 * 210).astype(np.uint8)
    canvas = cv2.cvtColor(cv2.resize(grey, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2BGR)
    radius = max(5, round(2.6 * found.notes["scale"] * zoom))

    def at(uv):
        return tuple(round(float(x)) for x in (np.asarray(uv) + 0.5) * zoom - 0.5)

    apart = [np.sort(np.linalg.norm(found.uv - uv, axis=1))[1] * zoom for uv in found.uv]
    for name, uv, room in zip(found.points, found.uv, apart, strict=True):
        colour = ORANGE if name in found.notes["labelled"] else SKY
        cv2.circle(canvas, at(uv), radius, colour, 1 if colour == SKY else 2, cv2.LINE_AA)
        if room > 28:
            u, v = at(uv)
            cv2.putText(canvas, name, (u + radius, v - radius + 3), 0, 0.32, colour, 1, cv2.LINE_AA)
    for uv in found.notes["missing"].values():
        cv2.drawMarker(canvas, at(uv), RED, cv2.MARKER_TILTED_CROSS, 2 * radius, 2, cv2.LINE_AA)
    quality = [cv2.IMWRITE_JPEG_QUALITY, 60]  # these are for the docs, and noise costs bytes
    path.write_bytes(cv2.imencode(".jpg", canvas, quality)[1].tobytes())


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--overlays", type=Path)
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    if options.overlays:
        for name, (camera, file) in OVERLAYS.items():
            data = read_dataset(options.folder / name)
            c = [one.name for one in data.cameras].index(camera)
            picture, found = detected(options.folder / name, data, c, 0, 30)
            zoom = {512: 2.0, 1280: 1.0, 2304: 0.6}[picture.shape[1]]
            overlay(picture, found, options.overlays / file, zoom)
            print(f"{file}: {len(found)} dots. {found.reason}")
        return
    lines = []
    for line in table(options.folder, options.seeds):
        print(line, flush=True)
        lines.append(line)
    if options.output:
        write_text(options.output, "\n".join([*lines, ""]))


if __name__ == "__main__":
    main()
