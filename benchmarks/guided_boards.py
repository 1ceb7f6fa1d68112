"""A board held by hand: guided poses against random ones, and whether the predicted millimetres are the real ones.

python benchmarks/guided_boards.py [--rigs stereo,2R2W] [--sessions 6] [--boards 24] [--lens-error 0.1]

A simulated hand follows the outlines (3 % of the distance and 3 degrees off); cameras report corners with their
noise, no pictures are made. `explicit` is fitted to the corners; positions are measured all over the rig's volume,
and compared with the truth after the rigid motion that fits best, since boards alone know no world. Random: anywhere in
the picture of a random camera, tilted up to 50 degrees, a quarter to four fifths of the width: from where the guided
ones choose.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from implicam import Explicit
from implicam.active import Places, Within, Workspace
from implicam.active.board_design import BoardShape
from implicam.active.board_loop import BoardLoop, BoardTarget
from implicam.active.stopping import Rule
from implicam.dataset import Camera, Dataset, Floats, Observations, join
from implicam.dataset.boards import corner_positions
from implicam.errors import ImplicamError
from implicam.geometry import Pose, register
from implicam.hardware.simulated_hand import SimulatedHand, board_target
from implicam.simulate import Rig, as_boards, build_rig, held_boards, random_positions, simulate

BOARD = {"kind": "charuco", "rows": 9, "columns": 12, "square": 13.29, "marker": 10.0, "dictionary": "DICT_5X5_100"}
TEST_POINTS = 300
CHI2_95 = 7.815


class Measured(NamedTuple):
    """After so many boards, of three axes, mm: rms error and predicted rms sd, with the noise of the measured views;
    the same of the calibration alone, views without noise, what the lens models leave included as in every error bar;
    and the share within the predicted 95 %, with noise."""

    boards: int
    error: float
    predicted: float
    calibration: float
    calibration_predicted: float
    inside: float
    stopped: bool


def session(
    rig: Rig, seed: int, boards: int, *, guided: bool, at: tuple[int, ...], rule: Rule, lens: str = "auto"
) -> Iterator[Measured]:
    """Boards one after the other, and what the rig measures then."""
    flat = corner_positions(BOARD)
    shape = BoardShape(np.column_stack([flat, np.zeros(len(flat))]), 13.29, False)
    hand = SimulatedHand(rig, BOARD, seed=seed)
    cameras = tuple(Camera(camera.name, camera.width, camera.height) for camera in rig.cameras)
    loop = BoardLoop(Explicit(lens=lens), shape, cameras, _volume(rig), rule, seed)
    rng = np.random.default_rng([seed, 41])
    data: Dataset | None = None
    fitted = 0
    for number in range(1, boards + 1):
        for _ in range(20):
            if guided:
                (target,) = loop.ask()
                assert isinstance(target, BoardTarget)
                hand.follow(shape.some(), target.corners)
                pose = hand.pose()
            else:
                pose = _random_pose(rig, rng)
            found = _seen(rig, pose, f"p{number:03d}", seed=1000 * seed + number)
            if found is not None:
                break
        assert found is not None
        data = found if data is None else join(data, found)
        stop = ""
        if guided and (loop.calibration is None or number >= 1.2 * fitted):
            loop.reset(data)
            fitted, stop = number, loop.stop
        elif guided:
            loop.tell(data)
        if number in at or stop:
            if not guided or fitted < number:
                loop.reset(data)
                fitted = number
            yield _judged(rig, loop, seed, number, bool(loop.stop))
        if stop and number >= max(at):
            return


def _volume(rig: Rig) -> Workspace:
    """The rig's volume in the frame of its first camera, as somebody would give it."""
    vertices = Workspace.from_box(rig.volume).vertices
    return Workspace.hull(rig.cameras[0].camera_from_world.apply(vertices))


def _random_pose(rig: Rig, rng: np.random.Generator) -> Pose:
    name = rig.cameras[int(rng.integers(len(rig.cameras)))].name
    rows, columns = BOARD["rows"] - 1, BOARD["columns"] - 1
    target = held_boards(rig, [[name]], rng, corners=(rows, columns), square=BOARD["square"])
    flat = corner_positions(BOARD)
    pose, _ = register(np.column_stack([flat, np.zeros(len(flat))]), target.xyz)
    return pose


def _seen(rig: Rig, pose: Pose, shot: str, seed: int) -> Dataset | None:
    """What the cameras see of a ChArUco board: those corners that are in the picture, 12 or more."""
    shown = board_target(BOARD, pose)
    data = as_boards(simulate(rig, shown, seed=seed), shown)
    o = data.observations
    enough = o.seen.sum(axis=0) >= 12
    uv = np.where(enough[None, :, None], o.uv, np.nan)
    if not np.isfinite(uv).any():
        return None
    names = np.array([point.replace("held", shot) for point in o.points.tolist()])
    kept = Observations(names, o.cameras, uv, np.where(np.isfinite(uv), o.sd, np.nan))
    return replace(data, observations=kept, extra={"target": BOARD}, name="boards")


def _judged(rig: Rig, loop: BoardLoop, seed: int, boards: int, stopped: bool) -> Measured:
    nothing = Measured(boards, *5 * [np.nan], stopped)
    names = {camera.name for camera in rig.cameras}
    if loop.calibration is None or loop.design is None or set(loop.calibration.camera_names) != names:
        return nothing
    target = random_positions(rig, TEST_POINTS, np.random.default_rng([seed, 42]))
    views = simulate(rig, target, seed=seed + 7).observations
    exact = np.stack([views.extra["true_u"], views.extra["true_v"]], axis=2)
    exact = np.where(views.seen[..., None], np.where(exact == "", "nan", exact).astype(float), np.nan)
    true = rig.cameras[0].camera_from_world.apply(target.xyz)
    try:
        noisy, clean = (loop.calibration.measure(one).xyz for one in (views, replace(views, uv=exact)))
        pose, _ = register(clean, true)
    except ImplicamError:
        return nothing
    design = replace(loop.design, judged=Places.predicted(loop.calibration, pose.inverse().apply(true)))
    judged = design.at_judged
    cov, floor = (pose.rotation @ one @ pose.rotation.T for one in (judged.total, judged.floor))
    off, alone = pose.apply(noisy) - true, pose.apply(clean) - true
    good = np.isfinite(off).all(axis=1) & np.isfinite(alone).all(axis=1) & np.isfinite(cov).all(axis=(1, 2))
    unit = rig.units_per_mm
    far = np.einsum("ni,nij,nj->n", off[good], np.linalg.inv(cov[good]), off[good])

    def rms(vectors: Floats) -> float:
        return float(np.sqrt(np.mean(np.sum(vectors[good] ** 2, axis=1)))) / unit

    def sd(covariances: Floats) -> float:
        return float(np.sqrt(np.mean(np.trace(covariances[good], axis1=1, axis2=2)))) / unit

    fitted = loop.calibration.map  # of views without noise, the lens models' part of the floor is left
    noise = np.array([model.noise for model in fitted.posterior.models])
    misfit = np.array([fitted.misfit(number) for number in range(len(noise))])
    clean_cov = cov - floor * (1 - np.mean(misfit**2) / np.mean(noise**2))
    return Measured(boards, rms(off), sd(cov), rms(alone), sd(clean_cov), float(np.mean(far < CHI2_95)), stopped)


def _spread(values: list[float], digits: int = 3) -> str:
    """Median and quartiles: the errors of few boards have long tails."""
    known = np.array([value for value in values if np.isfinite(value)])
    if not len(known):
        return "–"
    low, middle, high = np.quantile(known, (0.25, 0.5, 0.75))
    less = f" ({len(values) - len(known)} not calibrated)" if len(known) < len(values) else ""
    return f"{middle:.{digits}g} ({low:.{digits}g} to {high:.{digits}g}){less}"


def _mean(values: list[float]) -> str:
    known = np.array([value for value in values if np.isfinite(value)])
    if len(known) < 2:
        return "–"
    return f"{known.mean():.2f} ± {known.std(ddof=1) / np.sqrt(len(known)):.2f}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", default="stereo,2R2W,grid4")
    parser.add_argument("--sessions", type=int, default=6)
    parser.add_argument("--at", default="5,8,12,18")
    parser.add_argument("--lens-error", type=float, default=0.1)
    parser.add_argument("--lens", default="auto", help="of explicit: the family of all cameras")
    parser.add_argument("-o", "--output", type=Path)
    given = parser.parse_args()
    at = tuple(map(int, given.at.split(",")))
    lines = [
        "| rig | boards | random poses: calibration's error, mm | guided poses | predicted | over predicted "
        "| all of it, mm | over predicted | within 95 % |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name in given.rigs.split(","):
        found: dict[tuple[bool, int], list[Measured]] = {}
        stops: list[float] = []
        for s in range(given.sessions):
            rig = build_rig(name, seed=s, lens_error=given.lens_error)
            for guided in (False, True):
                stop = np.nan
                for one in session(rig, s, max(at), guided=guided, at=at, rule=Within(1.2), lens=given.lens):
                    if one.boards in at:
                        found.setdefault((guided, one.boards), []).append(one)
                    if guided and one.stopped and not np.isfinite(stop):
                        stop = one.boards
                if guided:
                    stops.append(stop)
            print(f"{name} session {s}: enough after {stops[-1]:g}", file=sys.stderr, flush=True)
        for n in at:
            free, led = found[False, n], found[True, n]
            whole = [one.error / one.predicted for one in led]
            part = [one.calibration / one.calibration_predicted for one in led]
            lines.append(
                f"| {name} | {n} | {_spread([one.calibration for one in free])} "
                f"| {_spread([one.calibration for one in led])} "
                f"| {_spread([one.calibration_predicted for one in led])} | "
                f"{_mean(part)} | {_spread([one.error for one in led])} | {_mean(whole)} | "
                f"{100 * np.nanmean([one.inside for one in led]):.0f} % |"
            )
        reached = [one for one in stops if np.isfinite(one)]
        told = f"{np.median(reached):.0f} (median of {len(reached)} of {len(stops)})" if reached else "not reached"
        lines.append(f"| {name} | enough after | | {told} | | | | | |")
        print("\n".join(lines[-len(at) - 1 :]), file=sys.stderr, flush=True)
    print("\n".join(lines))
    if given.output:
        given.output.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
