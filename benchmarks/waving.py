"""Waving a wand where the page says, against waving at random: frames until it is enough, and are the numbers true?

    python benchmarks/waving.py [--rigs stereo,bar4,bar6] [--seeds 4] [--frames 240] [--lens-error 0.5]

The rig's volume is the volume that has to be good; no camera is known at first. *guided*: a simulated hand goes where
`WandLoop` says, as well as hands do, and waves there in all directions. *all over*: any place of the volume and any
direction, as nobody without a grid in mind does. *as people do*: any direction, places normal about the middle of the
volume, with a fifth of its edges as sd. 10 % of the views are missing and 3 % are wrong. Fits come with every quarter
more frames; *enough* is 1.2 times what pixel noise alone leaves, in 95 % of the volume. Then 300 random positions are
measured: the rms error over that which the covariances state, and the share in the 95 % ellipsoids.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

import implicam as ic
from implicam.active import Workspace
from implicam.active.stopping import Within
from implicam.active.wand_loop import WandLoop
from implicam.dataset import Camera, Dataset, Floats, join
from implicam.dataset.wand import Wand
from implicam.errors import ImplicamError
from implicam.geometry import Pose, register
from implicam.hardware.simulated_wave import SimulatedWave
from implicam.simulate import Rig, Target, as_wand, build_rig, random_positions, simulate, waved_wand
from implicam.simulate.targets import WAND_ENDS, WAND_SHARE

GROWTH = 1.25
"""From one fit to the next there are so many times as many frames."""

MODES = ("guided", "all over", "as people do")


class Judged(NamedTuple):
    """After so many frames: excess in 95 % of the volume, 95 % uncertainty there (mm), rms error over what is stated,
    share in the 95 % ellipsoids."""

    frames: int
    excess: float
    usual: float
    over: float
    inside: float


def ends_of_frame(rig: Rig, mode: str, hand: SimulatedWave, rng: np.random.Generator) -> Floats:
    """(2, 3) where the ends are in the next frame."""
    if mode == "guided":
        hand._begin_set()
        return hand.shown(hand.pose()).xyz
    if mode == "all over":
        return waved_wand(rig, 1, rng, length=hand.length).xyz
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    off = np.clip(0.2 * rng.normal(size=3), -0.5, 0.5) * rig.volume.size
    return hand.shown(Pose(turn, rig.volume.world_from_box.apply(off[None])[0])).xyz


def seen(rig: Rig, ends: Floats, number: int, seed: int, length: float) -> Dataset:
    """What the cameras see of one frame; the names of its points count on."""
    names = np.array([f"{number} {end}" for end in WAND_ENDS])
    target = Target("wand", names, np.array([f"{number}"] * 2), ends, wand=length)
    return as_wand(simulate(rig, target, seed=10_000 * seed + number, missing=0.1, outliers=0.03), target)


def session(rig: Rig, seed: int, mode: str, frames: int) -> list[Judged]:
    """Frame after frame, until it is enough or all frames are waved; judged after each fit."""
    length = WAND_SHARE * float(rig.volume.size.min())
    hand = SimulatedWave(rig, length, seed=seed)
    rng = np.random.default_rng([seed, 51])
    cameras = tuple(Camera(camera.name, camera.width, camera.height) for camera in rig.cameras)
    box = Workspace.hull(rig.cameras[0].camera_from_world.apply(Workspace.from_box(rig.volume).vertices))
    loop = WandLoop(ic.ForwardGP(wand=length), Wand(WAND_ENDS, length), cameras, box, Within(1.2), seed)
    (target,) = loop.ask()
    hand.wave_at(target.uv)
    data, true, found, number = None, dict[str, Floats](), list[Judged](), 0
    while loop.points < frames and number < 4 * frames and not loop.stop:
        number += 1
        ends = ends_of_frame(rig, mode, hand, rng)
        one = seen(rig, ends, number, seed, length)
        whole = np.isfinite(one.observations.uv[..., 0]).all(axis=0).sum() >= 2 if len(one) == 2 else False
        if not whole:
            continue  # as a session does
        one = replace(one, observations=replace(one.observations, cameras=cameras, extra={}))
        true |= {f"{number} {end}": xyz for end, xyz in zip(WAND_ENDS, ends, strict=True)}
        data = one if data is None else join(data, one)
        loop.tell(data)
        if loop.points >= GROWTH * loop._fitted and loop.wants_fit(data):
            loop.reset(data)
            found += judged(rig, loop, true, seed)
        if loop.waved_here or loop._asked == 0:
            (target,) = loop.ask()
            hand.wave_at(target.uv)
    return found


def judged(rig: Rig, loop: WandLoop, true: dict[str, Floats], seed: int) -> list[Judged]:
    """The numbers of the last fit; none where there is no calibration of all cameras."""
    calibration = loop.calibration
    if calibration is None or loop.design is None or len(calibration.camera_names) < len(rig.cameras):
        return []
    held = simulate(rig, random_positions(rig, 300, np.random.default_rng([seed, 2])), seed=seed + 1_000_003)
    to_truth, _ = register(calibration.data.xyz, np.array([true[str(name)] for name in calibration.data.points]))
    measured = calibration.measure(replace(held.observations, cameras=loop.cameras, extra={}))
    good = measured.measured
    error = to_truth.apply(measured.xyz[good]) - held.truth.xyz[good]
    cov = to_truth.rotation @ measured.cov[good] @ to_truth.rotation.T
    far = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error)
    over = np.sqrt(np.mean(np.sum(error**2, axis=1)) / np.mean(np.trace(cov, axis1=1, axis2=2)))
    step = loop.history[-1]
    return [Judged(loop.points, step.excess, step.usual, float(over), float(np.mean(far < chi2.ppf(0.95, 3))))]


def told(values: list[float], digits: int) -> str:
    """Mean and standard error."""
    known = np.array([value for value in values if np.isfinite(value)])
    if len(known) < 2:
        return "-"
    return f"{known.mean():.{digits}f} ± {known.std(ddof=1) / np.sqrt(len(known)):.{digits}f}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", default="stereo,bar4,bar6")
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--seed0", type=int, default=40)
    parser.add_argument("--frames", type=int, default=240)
    parser.add_argument("--lens-error", type=float, default=0.5)
    parser.add_argument("-o", "--output", type=Path)
    given = parser.parse_args()
    lines = [
        "| rig | rigs | waved | enough after frames (median; all) | reached | at the end: times the noise "
        "| error / stated | in 95 % |",
        "|---|---|---|---|---|---|---|---|",
    ]
    print("\n".join(lines), flush=True)
    for name in given.rigs.split(","):
        for mode in MODES:
            ends: list[Judged] = []
            for seed in range(given.seed0, given.seed0 + given.seeds):
                try:
                    found = session(build_rig(name, seed=seed, lens_error=given.lens_error), seed, mode, given.frames)
                except ImplicamError as error:
                    print(name, mode, seed, error.what, file=sys.stderr, flush=True)
                    found = []
                ends += found[-1:]
                print(f"{name} {mode} {seed}: {found[-1:]}", file=sys.stderr, flush=True)
            counts = [one.frames if one.excess <= 1.2 else np.inf for one in ends]
            each = ", ".join(f"{count:g}" if np.isfinite(count) else f"> {given.frames}" for count in counts)
            middle = np.median(counts)
            said = f"{middle:g}" if np.isfinite(middle) else f"> {given.frames}"
            lines.append(
                f"| {name} | {given.seeds} | {mode} | **{said}** ({each}) | {int(np.isfinite(counts).sum())} "
                f"| {told([one.excess for one in ends], 2)} | {told([one.over for one in ends], 2)} "
                f"| {told([one.inside for one in ends], 3)} |"
            )
            print(lines[-1], flush=True)
    if given.output:
        given.output.write_text(
            "\n".join(["# Waving where the page says", "", __doc__, "", *lines]) + "\n", encoding="utf-8"
        )


if __name__ == "__main__":
    main()
