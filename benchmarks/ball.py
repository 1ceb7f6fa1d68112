"""Balls in rendered pictures: how well they are found, what is found where there is none, and what that is worth.

    python benchmarks/ball.py [--rigs 3] [--shots 20] [--empty 1000] [--ends 4] [--others 60] [-o ball.md]

First: `bar6` rigs (seeds 0, 1, ...), a random position a shot, 15 % of the pictures with something before the ball;
errors are against the middle of the ball's true outline, and rms is per axis. NEES should be 2. *pictures / s*: one
core, reading a PNG from disk and `Ball().detect`. A false ball is one more than 3 px off, or where none can be seen.

Second: false balls in pictures without one. Each camera's background holds 14 look-alikes that never change. Where no
picture of a camera shows the ball, a look-alike cannot be told from a ball that never moves, and `settle` keeps it.

Third, end to end: pictures of 35 known positions -> detections -> corrected to the balls' middles -> forward-gp, which
measures others from their pictures. *limit* is the Cramer-Rao bound of the detections' stated sd. ± is the standard
error over rigs.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from implicam.calibrators import ForwardGP
from implicam.dataset import Observations
from implicam.detect.ball import Ball
from implicam.detect.edge import Ellipse, fit_ellipse
from implicam.detect.model import View
from implicam.detect.silhouette import correct_outlines
from implicam.files import write_text
from implicam.images import one_thread_each, read_picture, write_picture
from implicam.simulate import Optics, Studio, build_rig, random_positions, record
from implicam.simulate.photographs import PADDING_PX

LEVELS = ((0.01, 0.7), (0.02, 1.0), (0.05, 1.5))
COVERED, FALSE, KNOWN = 0.15, 3.0, 35
EMPTY = {"covered in every picture": 1.0, "no target at all": 0.0, "covered in half of the pictures": 0.5}
"""Share of the pictures in which the ball is covered."""


def true_middle(camera, ball, n=90):
    """The middle of the ellipse through where lines of sight touch the ball."""
    towards = ball.centre - camera.camera_from_world.centre
    distance = np.linalg.norm(towards)
    axis = towards / distance
    a = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    a /= np.linalg.norm(a)
    sine = ball.radius / distance
    t = np.linspace(0, 2 * np.pi, n, endpoint=False)[:, None]
    around = ball.radius * np.sqrt(1 - sine**2) * (np.cos(t) * a + np.sin(t) * np.cross(axis, a))
    pixels = camera.pixel_from_world(ball.centre - ball.radius * sine * axis + around)[0]
    middle = pixels.mean(axis=0)
    return fit_ellipse(pixels, Ellipse(middle, np.eye(2) / np.linalg.norm(pixels - middle, axis=1).mean())).centre


def looked_at(studio, detector, take=None):
    """{view: detected}, settled, and the seconds that reading and detecting took."""
    found, seconds = {}, 0.0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        for c, camera in enumerate(studio.rig.cameras):
            for s, shot in enumerate(studio.shots):
                write_picture(path, (take or studio.picture)(c, s), bits=studio.optics.bits)
                begin = time.process_time()
                found[View(camera.name, shot)] = detector.detect(read_picture(path), View(camera.name, shot))
                seconds += time.process_time() - begin
    names, shots = [camera.name for camera in studio.rig.cameras], list(studio.shots)

    def read(views):
        for view in views:
            yield view, (take or studio.picture)(names.index(view.camera), shots.index(view.shot))

    return detector.look_again(detector.settle(found), read), seconds


def judged(studio, found):
    """Errors (k, 2) and sd (k, 2) of the balls found, how many can be seen, and how many are false."""
    errors, sd, false = [], [], 0
    visible = studio.true_pixels[1]
    for c, camera in enumerate(studio.rig.cameras):
        for s, shot in enumerate(studio.shots):
            one = found[View(camera.name, shot)]
            if not len(one):
                continue
            error = one.uv[0] - true_middle(camera, studio.shown_object(s))
            if not visible[s, c] or np.linalg.norm(error) > FALSE:
                false += 1
                continue
            errors.append(error)
            sd.append(one.sd[0])
    return np.reshape(errors, (-1, 2)), np.reshape(sd, (-1, 2)), int(visible.sum()), false


def accuracy(noise, blur, rigs, shots):
    errors, sd, pictures, visible, false, seconds = [], [], 0, 0, 0, 0.0
    for seed in range(rigs):
        rig = build_rig("bar6", seed=seed)
        target = random_positions(rig, shots, np.random.default_rng([seed, 1]))
        studio = Studio(rig, target, Optics(noise=noise, blur=blur), seed, COVERED)
        found, took = looked_at(studio, Ball())
        e, s, v, f = judged(studio, found)
        errors.append(e)
        sd.append(s)
        pictures, visible, false, seconds = pictures + len(found), visible + v, false + f, seconds + took
    e, s = np.concatenate(errors), np.concatenate(sd)
    bias = " / ".join(f"{b:+.4f} ± {x:.4f}" for b, x in zip(e.mean(0), e.std(0) / np.sqrt(len(e)), strict=True))
    nees = np.sum((e / s) ** 2, axis=1)
    return (
        f"| {noise:.0%}, {blur} px | {pictures} | {len(e)} of {visible} ({len(e) / visible:.1%}) | {false} | {bias} "
        f"| {np.sqrt(np.mean(e**2)):.4f} | {nees.mean():.2f} ± {nees.std() / np.sqrt(len(e)):.2f} "
        f"| {pictures / seconds:.0f} |"
    )


def empty(kind, count, shots):
    """False balls in `count` pictures in which none can be seen, at first and after settling."""
    first = settled = pictures = seed = 0
    while pictures < count:
        rig = build_rig("bar6", seed=100 + seed)
        target = random_positions(rig, shots, np.random.default_rng([seed, 2]))
        noise, blur = LEVELS[seed % len(LEVELS)]
        studio = Studio(rig, target, Optics(noise=noise, blur=blur), seed, EMPTY[kind])
        absent = kind == "no target at all"
        hidden = ~studio.true_pixels[1] | absent
        raw = _Counting()
        found, _ = looked_at(studio, raw, background_of(studio) if absent else None)
        views = [View(c.name, s) for k, c in enumerate(rig.cameras) for i, s in enumerate(studio.shots) if hidden[i, k]]
        first += sum(raw.found[view] for view in views)
        settled += sum(len(found[view]) > 0 for view in views)
        pictures, seed = pictures + len(views), seed + 1
    return f"| {kind} | {seed} | {pictures} | {first} | {settled} |"


def background_of(studio):
    """A function that takes the picture of a camera and a shot without the target."""

    def take(camera, shot):
        rng = np.random.default_rng([studio.seed, 9, camera, shot])
        inner = slice(PADDING_PX, -PADDING_PX)
        return studio._expose(studio._looks[camera].blurred[inner, inner].copy(), camera, rng)

    return take


class _Counting:
    """Ball(), and in which pictures `detect` found one before `settle`."""

    def __init__(self):
        self.found = {}

    def detect(self, picture, view):
        found = Ball().detect(picture, view)
        self.found[view] = len(found) > 0
        return found

    def settle(self, found):
        return Ball().settle(found)

    def look_again(self, found, read):
        return Ball().look_again(found, read)


def photographed(rig, target, seed, optics):
    """The dataset with what was found in its pictures."""
    recorded = record(rig, target, seed=seed, optics=optics)
    found, _ = looked_at(recorded.studio, Ball())
    old = recorded.data.observations
    uv = np.full((len(target.xyz), len(rig.cameras), 2), np.nan)
    sd = uv.copy()
    for c, camera in enumerate(rig.cameras):
        for s, shot in enumerate(recorded.studio.shots):
            one = found[View(camera.name, shot)]
            if len(one):
                uv[s, c], sd[s, c] = one.uv[0], one.sd[0]
    return replace(recorded.data, observations=Observations(old.points, old.cameras, uv, sd))


def limit(rig, xyz, sd):
    """(n, 3, 3) Cramer-Rao bound with known cameras and sd (n, cameras, 2); NaN for fewer than two views."""
    information, used = np.zeros((len(xyz), 3, 3)), np.isfinite(sd).all(axis=2)
    for c, camera in enumerate(rig.cameras):
        rows = used[:, c]
        scaled = camera.jacobian(xyz)[rows] / sd[rows, c][:, :, None]
        information[rows] += scaled.transpose(0, 2, 1) @ scaled
    out = np.full_like(information, np.nan)
    enough = used.sum(axis=1) >= 2
    out[enough] = np.linalg.inv(information[enough])
    return out


def end_to_end(noise, blur, rigs, count):
    ratios, nees, covered, millimetres, measured = [], [], [], [], 0
    for seed in range(rigs):
        rig, optics = build_rig("bar6", seed=seed), Optics(noise=noise, blur=blur)
        known, _ = correct_outlines(
            photographed(rig, random_positions(rig, KNOWN, np.random.default_rng([seed, 3])), seed, optics), 8.0
        )
        others = photographed(rig, random_positions(rig, count, np.random.default_rng([seed, 4])), seed + 100, optics)
        calibration = ForwardGP().fit(known)
        moved, _ = correct_outlines(replace(others, known=None), 8.0, calibration)
        m = calibration.measure(moved.observations)
        bound = limit(rig, others.xyz, moved.observations.sd)
        good = np.isfinite(m.xyz).all(axis=1) & np.isfinite(bound).all(axis=(1, 2))
        error = (m.xyz - others.xyz)[good]
        squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(m.cov[good]), error)
        rmse = np.sqrt(np.mean(np.sum(error**2, axis=1)))
        ratios.append(rmse / np.sqrt(np.mean(np.trace(bound[good], axis1=1, axis2=2))))
        millimetres.append(rmse)
        nees.append(squared.mean())
        covered.append(np.mean(squared < 7.815))
        measured += int(good.sum())
    return (
        f"| {noise:.0%}, {blur} px | {rigs} | {measured} of {rigs * count} | {_pm(ratios)} | {_pm(millimetres)} "
        f"| {_pm(covered)} | {_pm(nees)} |"
    )


def _pm(values):
    if len(values) < 2:
        return f"{np.mean(values):.3f}" if values else ""
    return f"{np.mean(values):.3f} ± {np.std(values, ddof=1) / np.sqrt(len(values)):.3f}"


def table(args):
    yield f"Balls in rendered pictures: `{' '.join(['python benchmarks/ball.py', *sys.argv[1:]])}`"
    yield ""
    yield "| noise, blur | pictures | found where visible | false | bias u / v, px | rms, px | NEES | pictures / s |"
    yield "|---|---|---|---|---|---|---|---|"
    for noise, blur in LEVELS:
        yield accuracy(noise, blur, args.rigs, args.shots)
    yield ""
    yield "Where no ball can be seen (the three levels of noise and blur in turn, a rig each)."
    yield ""
    yield "| the ball | rigs | pictures without | false, each alone | false, after `settle` |"
    yield "|---|---|---|---|---|"
    for kind in EMPTY:
        yield empty(kind, args.empty, args.shots)
    yield ""
    yield f"End to end: {KNOWN} known positions, forward-gp, {args.others} others measured."
    yield ""
    yield "| noise, blur | rigs | measured | rmse / limit | rmse, mm | 95 % ellipsoid | NEES (3) |"
    yield "|---|---|---|---|---|---|---|"
    for noise, blur in LEVELS:
        yield end_to_end(noise, blur, args.ends, args.others)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", type=int, default=3)
    parser.add_argument("--shots", type=int, default=20)
    parser.add_argument("--empty", type=int, default=1000)
    parser.add_argument("--ends", type=int, default=4)
    parser.add_argument("--others", type=int, default=60)
    parser.add_argument("-o", "--output", type=Path)
    args = parser.parse_args()
    lines = []
    with one_thread_each():
        for line in table(args):
            print(line, flush=True)
            lines.append(line)
    if args.output:
        write_text(args.output, "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
