"""Whether the sd of undistortion maps is right: their errors on many simulated rigs, whose lenses are known.

    python benchmarks/undistortion_maps.py                 12 rigs
    python benchmarks/undistortion_maps.py --window 10     10 mm of acrylic glass with water behind it
    python benchmarks/undistortion_maps.py --rigs 2        does it run?

Each rig is bar6 with 157 random known points. At 6000 pixels of each pinhole among the known points, and 6000 beyond,
a place on the pixel's ray at the depth of a known point goes through the true camera; the map says another pixel.
Errors within a rig are few smooth curves, so the intervals are standard errors over rigs.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np

from implicam.calibrators import Calibrator, Explicit, ForwardGP
from implicam.calibrators.undistortion import pinhole_maps
from implicam.exchange.pixel_maps import PinholeMaps
from implicam.geometry import Floats
from implicam.simulate import SimulatedCamera, Unusual, build_rig, random_positions, simulate

PIXELS, POINTS = 6000, 157
WHERE = ("among the known points", "beyond them")


def main() -> None:
    """Print a line for each method and region."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--rigs", type=int, default=12)
    parser.add_argument("--window", type=float, default=0.0)
    asked = parser.parse_args()
    methods: Sequence[Calibrator] = [ForwardGP()] if asked.window else [ForwardGP(), Explicit()]
    rows: dict[tuple[str, str], list[Floats]] = {}
    for seed in range(asked.rigs):
        rig, rng = build_rig("bar6", seed=seed, unusual=Unusual(window=asked.window)), np.random.default_rng(seed)
        data = simulate(rig, random_positions(rig, POINTS, rng), seed=seed)
        for method in methods:
            maps, _ = pinhole_maps(method.fit(data))
            pairs = list(zip(maps, rig.cameras, strict=True))
            found = np.array([[judge(*pair, where, data.xyz, rng) for where in WHERE] for pair in pairs])
            for where, row in zip(WHERE, found.mean(axis=0), strict=True):
                rows.setdefault((method.method, where), []).append(row)
    for (name, where), found in rows.items():
        values = np.array(found)
        mean, error = values.mean(axis=0), values.std(axis=0, ddof=1) / np.sqrt(len(values))
        off, stated = np.sqrt(mean[2:])
        print(
            f"{name:<11} {where:<23} in the 95 % intervals {100 * mean[0]:.1f} +- {100 * error[0]:.1f} %, "
            f"(error / sd)^2 {mean[1]:.2f} +- {error[1]:.2f}, rms error {off:.3f} px, stated {stated:.3f}"
        )


def judge(maps: PinholeMaps, camera: SimulatedCamera, where: str, known: Floats, rng: np.random.Generator) -> Floats:
    """Share of errors within 1.96 sd, their mean square in sds, and both mean squares in px."""
    v, u = np.nonzero(maps.filled & (maps.extrapolated == (where == WHERE[1])))
    drawn = rng.choice(len(v), min(PIXELS, len(v)), replace=False)
    v, u = v[drawn], u[drawn]
    pose = maps.pinhole.camera_from_world
    depths = rng.choice(pose.apply(known)[:, 2], len(v))
    rays = np.linalg.solve(maps.K, np.stack([u, v, np.ones(len(u))])).T
    true, seen = camera.pixel_from_world(pose.inverse().apply(rays * depths[:, None]))
    error = (np.column_stack([maps.map_x[v, u], maps.map_y[v, u]]) - true)[seen]
    sd = np.column_stack([maps.sd_x[v, u], maps.sd_y[v, u]])[seen]
    return np.array([np.mean(np.abs(error) < 1.96 * sd), np.mean((error / sd) ** 2), np.mean(error**2), np.mean(sd**2)])


if __name__ == "__main__":
    main()
