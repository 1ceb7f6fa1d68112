"""Rigs of all kinds that calibrations for other programs are tried with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

import implicam as ic
from forward_gp_cases import declared_fit, dots_fit, with_positions
from implicam.calibrators.protocol import RigCalibration
from implicam.lenses import KannalaBrandt
from implicam.simulate import Rig, Unusual, build_rig, moving_board, random_positions, simulate

REAL = Path(__file__).parent / "data" / "real"


def forward_gp(unusual: Unusual, lens: str = "auto") -> RigCalibration:
    rig = build_rig("stereo", seed=5, unusual=unusual)
    return ic.ForwardGP(lens=lens).fit(simulate(rig, random_positions(rig, 60, np.random.default_rng(5)), seed=5))


def fisheyes() -> Rig:
    """105 degrees off the axis at the left and right."""
    rig, wide = build_rig("stereo", seed=5), KannalaBrandt(350.0, 350.0, 640.0, 400.0)
    return replace(rig, cameras=tuple(replace(camera, lens=wide) for camera in rig.cameras))


def of_fisheyes(make: ic.ForwardGP | ic.Explicit) -> RigCalibration:
    rig = fisheyes()
    made: RigCalibration = make.fit(simulate(rig, random_positions(rig, 60, np.random.default_rng(5)), seed=5))
    return made


def boards() -> RigCalibration:
    """Boards on a slide, each of them off by some tenths of a mm, which nothing says: labels that are estimated."""
    rig = build_rig("bar6", seed=4, cameras="2R")
    data = simulate(rig, moving_board(rig, corners=(4, 5), positions=6, step=40.0), seed=4)
    _, shot = np.unique(data.shots, return_inverse=True)
    moved = data.xyz + 0.3 * rig.units_per_mm * np.random.default_rng(6).normal(size=(6, 3))[shot]
    return ic.ForwardGP().fit(with_positions(data, moved, np.nan))


RIGS: dict[str, Callable[[], RigCalibration]] = {
    "perspective": lambda: forward_gp(Unusual()),
    "fisheye": lambda: of_fisheyes(ic.ForwardGP()),
    "tilted": lambda: forward_gp(Unusual(tilt=12.0)),
    "mirror": lambda: forward_gp(Unusual(mirror="all")),
    "other pixels": lambda: forward_gp(Unusual(aspect=1.3)),
    "window": lambda: forward_gp(Unusual(window=25.0)),
    "no lens": lambda: forward_gp(Unusual(window=25.0), "none"),
    "central": lambda: forward_gp(Unusual(), "central"),
    "explicit brown-conrady": lambda: of_fisheyes(ic.Explicit(lens="brown-conrady")),
    "explicit kannala-brandt": lambda: of_fisheyes(ic.Explicit(lens="kannala-brandt")),
    "declared errors": declared_fit,
    "dots": dots_fit,
    "a real tank": lambda: ic.ForwardGP().fit(ic.read_dataset(REAL / "two-sided-tank")),
}


def covariances(made: RigCalibration, xyz: np.ndarray) -> list[np.ndarray]:
    """Per camera (n, 2, 2), eq. (19)."""
    found = []
    with np.errstate(invalid="ignore"):
        for of in made.sensitivities(xyz):
            every = of.half @ of.half.swapaxes(1, 2) + (of.rest + of.noise)[:, :, None] * np.eye(of.rest.shape[1])
            found += [every[:, 2 * i : 2 * i + 2, 2 * i : 2 * i + 2] for i in range(len(of.cameras))]
    return found
