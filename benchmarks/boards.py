"""Checkerboards and ChArUco boards in rendered photographs: found, numbered, how exactly, how fast.

    OPENBLAS_NUM_THREADS=1 python benchmarks/boards.py [--seeds 3] [--pixels] [-o benchmarks/results/boards.md]

Simulated bar6 rigs, six cameras of 1280 x 800 pixels, the 20 positions of moving_board, 8 bits, blur 0.7 px. A wrong
number is a corner more than 1 px from where the true corner of its name is; the smallest squares are 7 px wide.
Pictures per second of one core's own time: of `detect` in one thread.
--pixels: instead, the same pictures saved as JPEG, or as a colour sensor records them and OpenCV interpolates.
Last the corners that were not found but inferred: how many, how far off, and their NEES (2 is right).
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from implicam.detect.board import Board
from implicam.detect.model import View
from implicam.files import write_text
from implicam.images import opencv
from implicam.simulate import build_rig, moving_board
from implicam.simulate.photographs import Optics, Studio

HEAD = (
    "| pictures | corners found | pictures numbered | wrong numbers | rms px | largest px | NEES | pictures/s |"
    " inferred | their rms px | their NEES |\n"
    "|---|---|---|---|---|---|---|---|---|---|---|\n"
)


def studio(seed, covered=0.0, **optics):
    rig = build_rig("bar6", seed=seed)
    return Studio(rig, moving_board(rig), Optics(**optics), seed=seed + 100, covered=covered)


def outside(picture, uv, part):
    """The picture cut so that `part` of the corners' width is left of it, and how far it was cut."""
    cut = int(np.quantile(uv[:, 0], part))
    return np.ascontiguousarray(picture[:, cut:]), cut


def as_jpeg(quality):
    def save(picture):
        image = np.rint(255 * picture).astype(np.uint8)
        _, packed = opencv().imencode(".jpg", image, [opencv().IMWRITE_JPEG_QUALITY, quality])
        return opencv().imdecode(packed, opencv().IMREAD_GRAYSCALE).astype(np.float32) / np.float32(255)

    return save


def as_mosaic(method, gains=(0.6, 1.0, 0.7)):
    """As a colour sensor without white balance records a grey scene; interpolated by OpenCV, or left as it is."""

    def interpolate(picture):
        raw = picture.copy()
        raw[0::2, 0::2] *= gains[0]
        raw[0::2, 1::2] *= gains[1]
        raw[1::2, 0::2] *= gains[1]
        raw[1::2, 1::2] *= gains[2]
        raw = np.rint(255 * raw).astype(np.uint8)
        if method is not None:
            code = getattr(opencv(), f"COLOR_BayerRG2BGR{method}")
            raw = opencv().cvtColor(opencv().cvtColor(raw, code), opencv().COLOR_BGR2GRAY)
        return raw.astype(np.float32) / np.float32(255)

    return interpolate


PIXELS = {
    "plain": lambda picture: picture,
    "JPEG, quality 95": as_jpeg(95),
    "JPEG, quality 85": as_jpeg(85),
    "JPEG, quality 75": as_jpeg(75),
    "colour sensor, bilinear": as_mosaic(""),
    "colour sensor, edge-aware": as_mosaic("_EA"),
    "colour sensor, variable gradients": as_mosaic("_VNG"),
    "colour sensor, not interpolated": as_mosaic(None),
}


def measured(studios, shots, cut=0.0, became=PIXELS["plain"]):
    board, seen, found, numbered, wrong, pictures, seconds = Board(infer=True), 0, 0, 0, 0, 0, 0.0
    off, nees, hidden, hidden_nees = [], [], [np.zeros((0, 2))], [np.zeros(0)]
    for taken in studios:
        uv, visible = taken.true_pixels
        index = {name: k for k, name in enumerate(taken.target.points)}
        for c, camera in enumerate(taken.rig.cameras):
            for s in shots:
                rows = taken.target.shots == taken.shots[s]
                picture, left = became(taken.picture(c, s)), 0
                if cut:
                    picture, left = outside(picture, uv[rows, c], cut)
                seen += int((visible[rows, c] & (uv[rows, c, 0] >= left)).sum())
                start = time.process_time()
                got = board.detect(picture, View(camera.name, taken.shots[s]))
                seconds += time.process_time() - start
                pictures += 1
                if len(got):
                    e = got.uv + np.array([left, 0]) - uv[[index[point] for point in got.points], c]
                    good = np.linalg.norm(e, axis=1) < 1
                    numbered += 1
                    found += len(got)
                    wrong += int((~good).sum())
                    off.append(e[good])
                    nees.append(np.sum((e / got.sd) ** 2, axis=1)[good])
                    there = got.inferred
                    e = there.uv + np.array([left, 0]) - uv[[index[point] for point in there.points], c].reshape(-1, 2)
                    hidden.append(e)
                    hidden_nees.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(there.covariance), e))
    off, nees, hidden = np.concatenate(off), np.concatenate(nees), np.concatenate(hidden)
    told = f"{np.sqrt(np.mean(hidden**2)):.4f} | {np.concatenate(hidden_nees).mean():.2f}" if len(hidden) else " | "
    return (
        f"{found / seen:.1%} | {numbered} of {pictures} | {wrong} | {np.sqrt(np.mean(off**2)):.4f} | "
        f"{np.linalg.norm(off, axis=1).max():.3f} | {nees.mean():.2f} | {pictures / seconds:.1f} | "
        f"{len(hidden)} | {told}"
    )


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--pixels", action="store_true")
    parser.add_argument("-o", type=Path)
    options = parser.parse_args()
    opencv().setNumThreads(1)
    seeds = range(21, 21 + options.seeds)
    text = HEAD
    cases = [
        ("1 % noise", {"noise": 0.01}, range(20), 0.0),
        ("2 % noise", {"noise": 0.02}, range(0, 20, 2), 0.0),
        ("5 % noise, blur 1.5 px", {"noise": 0.05, "blur": 1.5}, range(0, 20, 4), 0.0),
        ("2 % noise, a bar before every board", {"noise": 0.02, "covered": 1.0}, range(0, 20, 2), 0.0),
        ("2 % noise, a third of the board outside", {"noise": 0.02}, range(0, 20, 4), 0.33),
        ("2 % noise, half of the board outside", {"noise": 0.02}, range(0, 20, 4), 0.5),
    ]
    rows = [(name, how, shots, cut, PIXELS["plain"]) for name, how, shots, cut in cases]
    if options.pixels:
        rows = [(name, {"noise": 0.01}, range(0, 20, 6), 0.0, became) for name, became in PIXELS.items()]
    print(text, end="", flush=True)
    for name, how, shots, cut, became in rows:
        line = f"| {name} | {measured([studio(seed, **how) for seed in seeds], shots, cut, became)} |\n"
        print(line, end="", flush=True)
        text += line
    if options.o:
        write_text(options.o, text)


if __name__ == "__main__":
    main()
