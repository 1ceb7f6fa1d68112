"""Films of a moving ball from two cameras whose clocks differ by 37.4 ms: what `detect` says of it.

    python benchmarks/films.py --rigs 3

Each rig of two cameras is filmed at 30 and at 25 pictures a second, once with every picture by itself (Motion JPEG),
once as phones do (MPEG-4). The error of the offset is against the truth; pixels are compared with where the ball was
at the instant that the row of observations.csv states.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import cv2
import numpy as np

from implicam.detect import Ball, detect_films, films_of
from implicam.simulate import build_rig
from implicam.simulate.photographs import Optics, Studio
from implicam.simulate.targets import Target

OFFSET, SECONDS, RATES = 0.0374, 6.0, (30.0, 25.0)
CODECS = {"Motion JPEG": ("MJPG", "avi"), "MPEG-4": ("mp4v", "mp4")}


def path_of(rig, seed, most_hertz=0.8, terms=14):
    """A smooth random path in the rig's volume, as a function of time."""
    rng = np.random.default_rng(seed)
    f, phase = rng.uniform(0.1, most_hertz, (terms, 3)), rng.uniform(0, 2 * np.pi, (terms, 3))
    size = rng.normal(size=(terms, 3)) / np.sqrt(1 + (2 * f) ** 2)
    size *= 0.18 / np.sqrt(np.square(size).sum(axis=0))
    box = rig.volume.world_from_box

    def at(t):
        inside = (size * np.sin(2 * np.pi * f * t[:, None, None] + phase)).sum(axis=1) * rig.volume.size
        return inside @ box.rotation.T + box.translation

    return at


def shoot(folder, rig, where, seed):
    """Film with all codecs; the second camera begins OFFSET later."""
    for k, rate in enumerate(RATES):
        t = OFFSET * k + np.arange(int(SECONDS * rate)) / rate
        names = np.array([f"p{i:04d}" for i in range(len(t))])
        studio = Studio(rig, Target("ball", names, names, where(t)), Optics(clutter=False, noise=0.01), seed)
        size = rig.cameras[k].width, rig.cameras[k].height
        writers = []
        for codec, ending in CODECS.values():
            (folder / ending).mkdir(exist_ok=True)
            file, code = str(folder / ending / f"cam{k + 1}.{ending}"), cv2.VideoWriter_fourcc(*codec)
            writers.append(cv2.VideoWriter(file, cv2.CAP_FFMPEG, code, rate, size))
        for i in range(len(t)):
            picture = np.clip(np.rint(studio.picture(k, i) * 255), 0, 255).astype(np.uint8)
            for writer in writers:
                writer.write(cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR))
        for writer in writers:
            writer.release()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", type=int, default=3)
    args = parser.parse_args()
    print("| film | rig | offset found, ms | error, ms | rms px of interpolated views | rms px as filmed |")
    print("|---|---|---|---|---|---|")
    for seed in range(1, args.rigs + 1):
        rig = build_rig("stereo", seed=seed)
        where = path_of(rig, seed)
        with tempfile.TemporaryDirectory() as name:
            shoot(Path(name), rig, where, seed)
            for codec, (_, ending) in CODECS.items():
                folder = Path(name) / ending
                run = detect_films(folder, Ball(), films_of(folder), unit="mm", overlays=False)
                _, add, sd = (folder / "detections" / "clocks.csv").read_text().splitlines()[2].split(",")[:3]
                t = np.array(run.data.columns["time_s"], float) + OFFSET
                away = []
                for k in (0, 1):  # the middle of an outline is not that of the ball: a smooth difference is taken off
                    uv = run.data.observations.uv[:, k]
                    seen = np.isfinite(uv[:, 0])
                    true = rig.cameras[k].pixel_from_world(where(t))[0][seen]
                    basis = np.concatenate([np.ones((len(true), 1)), true / 1000, (true / 1000) ** 2], axis=1)
                    off = uv[seen] - true
                    off -= basis @ np.linalg.lstsq(basis, off, rcond=None)[0]
                    away.append(np.sqrt(np.square(off).mean()))
                found, sd = -1e3 * float(add), 1e3 * float(sd)
                print(
                    f"| {codec} | {seed} | {found:.3f} ± {sd:.3f} | {found - 1e3 * OFFSET:+.3f} | {away[0]:.3f} "
                    f"| {away[1]:.3f} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
