"""The three ways to a classical calibration: from known points, from boards and known points, from boards alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from implicam.calibrators.explicit.align import Alignment, align, in_frame, in_world
from implicam.calibrators.explicit.boards import boards_of
from implicam.calibrators.explicit.from_points import fit_points
from implicam.calibrators.explicit.lenses import Choice
from implicam.calibrators.explicit.network import Network, calibrate_network
from implicam.calibrators.forward_gp.diagnosis import NAMED, Diagnosis
from implicam.calibrators.forward_gp.fit import without_field
from implicam.calibrators.forward_gp.lens import CentralCamera
from implicam.calibrators.forward_gp.posterior import CameraModel, Posterior
from implicam.calibrators.forward_gp.problem import Frame, problem_of
from implicam.calibrators.forward_gp.rig_map import RigMap
from implicam.calibrators.forward_gp.start import Started
from implicam.calibrators.protocol import Rejected, Unused, same_cameras
from implicam.dataset import Dataset, Floats, KnownPositions, Names, Observations
from implicam.progress import Progress

METHOD = "explicit"


@dataclass(frozen=True, eq=False)
class Fitted:
    """Cameras in the working frame. trained: the observations that cameras, sizes and stated noise are known from;
    cameras: numbers of those calibrated; choices: their lens models; errors, sds (m, 3): of known points, each left
    out in turn."""

    trained: Observations
    frame: Frame
    cameras: tuple[int, ...]
    posterior: Posterior
    choices: tuple[Choice, ...]
    errors: Floats
    sds: Floats
    rejected: tuple[Rejected, ...]
    unused: tuple[Unused, ...]
    notes: tuple[str, ...]


def fit_to_points(data: Dataset, family: str, progress: Progress) -> Fitted:
    """Every camera from the known points; FitError where fewer than two can be calibrated."""
    frame = Frame.of(data, METHOD)
    fitted, choices = fit_points(problem_of("central", data, frame, shots_off=False), family, progress)
    diagnosis = Diagnosis(data, frame, fitted)
    return Fitted(
        data.observations,
        frame,
        fitted.cameras,
        fitted.posterior,
        tuple(choices[c] for c in fitted.cameras),
        *diagnosis.leave_one_out,
        diagnosis.rejected,
        diagnosis.unused,
        (*diagnosis.notes(), *diagnosis.noise_notes()),
    )


def fit_to_boards(data: Dataset, network: Network, boards: Dataset, how: str) -> Fitted:
    """Cameras from boards, brought into the world by the known points."""
    trained = by_cameras_of(data, boards)
    known, bundle = data.positions, network.bundle
    in_rig = RigMap(
        trained, data.length_unit, _UNIT, network.cameras, _posterior(network, bundle.cameras, network.root)
    )
    measured = in_rig.measure(data.observations)
    alignment = align(in_rig.posterior.models, *in_rig.views(data.observations), measured, known.xyz, known.sd, how)
    frame = _frame(known.xyz)
    cameras, root = in_frame(*in_world(bundle.cameras, network.root, alignment), frame.offset, frame.scale)
    return Fitted(
        trained,
        frame,
        network.cameras,
        _posterior(network, cameras, root),
        tuple(network.choices[c] for c in network.cameras),
        alignment.errors,
        alignment.sds,
        _rejected(network, boards),
        _not_used(data, measured.reason, alignment),
        (*_notes(network, trained, boards), *_alignment_notes(alignment, data.length_unit)),
    )


def fit_to_boards_alone(data: Dataset, family: str, progress: Progress) -> tuple[Dataset, Fitted]:
    """Cameras in the frame of the first; and the data with the positions that the boards have there."""
    network = calibrate_network(boards_of(data), family, progress)
    placed = _placed(data, network)
    posterior = _posterior(network, network.bundle.cameras, network.root)
    measured = RigMap(data.observations, data.length_unit, _UNIT, network.cameras, posterior, misfit_adds=True).measure(
        placed.observations
    )
    first = data.observations.camera_names[network.cameras[0]]
    fitted = Fitted(
        data.observations,
        _UNIT,
        network.cameras,
        posterior,
        tuple(network.choices[c] for c in network.cameras),
        (measured.xyz - placed.xyz)[measured.measured],
        measured.sd[measured.measured],
        _rejected(network, data),
        (),
        (
            f"Positions are in the frame of {first}: x right, y down, z forward. Known points bring them into a world "
            "of your own: implicam calibrate POINTS --method explicit --boards BOARDS.",
            *_notes(network, data.observations, data),
        ),
    )
    return placed, fitted


_UNIT = Frame(np.zeros(3), 1.0)


def _frame(xyz: Floats) -> Frame:
    offset = xyz.mean(axis=0)
    return Frame(offset, float(np.sqrt(np.mean((xyz - offset) ** 2))) or 1.0)


def by_cameras_of(data: Dataset, boards: Dataset) -> Observations:
    """The boards' observations by the cameras of the data; an error where sizes differ, or no two are the same."""
    names = [name for name in data.observations.camera_names if name in boards.observations.camera_names]
    trained = boards.observations.with_cameras(names) if len(names) > 1 else boards.observations
    same_cameras(trained, data.observations)
    return trained


def _placed(data: Dataset, network: Network) -> Dataset:
    """The corners that a calibrated camera saw, where the adjustment puts them."""
    xyz = np.full((len(data), 3), np.nan)
    for view in network.bundle.views.each:
        xyz[view.rows] = network.bundle.boards.pose(view.board).apply(view.xyz)
    there = np.isfinite(xyz).all(axis=1)
    known = KnownPositions(network.shots[there], xyz[there], np.full((int(there.sum()), 3), np.nan))
    return replace(data.select(there), known=known)


def _posterior(network: Network, cameras: Sequence[CentralCamera], root: Floats) -> Posterior:
    none = [np.ones(camera.size, dtype=np.bool_) for camera in cameras]  # only a fit asks which views started it
    models = tuple(
        without_field(Started(camera, prior, kept), image, float(noise))
        for camera, prior, kept, image, noise in zip(
            cameras, network.bundle.priors, none, network.images, network.bundle.noise, strict=True
        )
    )
    return posterior_of(models, root)


def posterior_of(models: tuple[CameraModel, ...], root: Floats) -> Posterior:
    """From the root (q, P) of the covariance of the cameras' unknowns; their fields, which are none, have no spread."""
    parts, start = [], 0
    for model in models:
        own = root[:, start : start + model.camera.size]
        parts.append(np.hstack([own, np.zeros((len(root), model.size - model.camera.size))]))
        start += model.camera.size
    return Posterior(models, tuple(parts), np.hstack(parts), (), 0.0)


def _rejected(network: Network, boards: Dataset) -> tuple[Rejected, ...]:
    names, points = boards.observations.camera_names, boards.points
    found = [Rejected(str(points[row]), names[c], off) for row, c, off in network.wrong]
    return tuple(sorted(found, key=lambda view: -np.nan_to_num(view.residual, nan=np.inf)))


def _not_used(data: Dataset, reasons: Names, alignment: Alignment) -> tuple[Unused, ...]:
    return tuple(
        Unused(str(data.points[i]), str(reasons[i]) or "it is not where the others put the world")
        for i in np.flatnonzero(~alignment.used)
    )


def _notes(network: Network, trained: Observations, boards: Dataset) -> list[str]:
    names = trained.camera_names
    notes = [f"{names[c]} is not calibrated, and its views are not used: {why}" for c, why in network.blind]
    if network.wrong:
        worst = _rejected(network, boards)[:NAMED]
        named = ", ".join(f"{view.point} in {view.camera} ({view.residual:.3g} px off)" for view in worst)
        more = f" and {len(network.wrong) - NAMED} more" if len(network.wrong) > NAMED else ""
        count = f"{len(network.wrong)} corner{'s' * (len(network.wrong) != 1)}"
        notes.append(f"{count} not used, far from where the others predict them: {named}{more}.")
    return notes


def _alignment_notes(alignment: Alignment, unit: str) -> list[str]:
    """Where the world and the rig from the boards differ by more than their error bars."""
    off = alignment.errors / alignment.sds
    size = float(np.sqrt(np.mean(off**2)))
    if size < DISAGREE:
        return []
    rms = float(np.sqrt(np.mean(np.sum(alignment.errors**2, axis=1))))
    return [
        f"The boards and the known points contradict each other: after alignment {rms:.2g} {unit} are left, "
        f"{size:.1f} times what the error bars say. Check the board's square, and that no camera moved in between."
    ]


DISAGREE = 2.0
"""Times its sd that known points are off in the mean, beyond which boards and known points disagree."""
