"""Cameras from boards, brought into the world by known points.

Boards join cameras that saw the same ones: such a group is brought into the world as a whole, by the known points that
it measures. A camera that saw its boards alone has a lens, and known points place it (place.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from implicam.calibrators.explicit.align import MATCHING, Alignment, Known, align, in_frame, in_world
from implicam.calibrators.explicit.camera_groups import CameraGroup, CameraGroups
from implicam.calibrators.explicit.fitted import (
    WORLD_FRAME,
    Fitted,
    by_cameras_of,
    group_notes,
    group_posterior,
    posterior_of,
    wrong_corners,
)
from implicam.calibrators.explicit.lenses import Choice
from implicam.calibrators.explicit.place import place
from implicam.dataset import Dataset, Names, Observations, remove_copies
from implicam.dataset.unused import Rejected, Unused, describe_point_copies, list_copied_points
from implicam.errors import FitError
from implicam.geometry import Bools, Floats
from implicam.progress import Progress
from implicam.rig_model import CameraModel, Diagnosis, FittedRig, Frame, TrainingData, locate


class Part(NamedTuple):
    """Cameras in the working frame, by number; root (q, P) of their covariance; errors and sds (m, 3) of known points
    left out in turn."""

    cameras: tuple[int, ...]
    models: tuple[CameraModel, ...]
    root: Floats
    choices: tuple[Choice, ...]
    errors: Floats
    sds: Floats
    rejected: tuple[Rejected, ...]
    unused: tuple[Unused, ...]
    notes: tuple[str, ...]


def fit_to_boards(data: Dataset, groups: CameraGroups, boards: Dataset, how: str, progress: Progress) -> Fitted:
    """Cameras that boards have calibrated, brought into the world by known points.

    Args:
        data: Known points and what the cameras saw of them.
        groups: Of cameras, from the boards.
        boards: The dataset that the boards are from.
        how: `points` or `icp`: how measured and known points are matched.
        progress: Is told how far the fit is.

    Returns:
        The cameras that got a place in the world.

    Raises:
        FitError: They are fewer than two.
    """
    copied, copies_told = list_copied_points(data), describe_point_copies(data)
    data = remove_copies(data)
    trained = by_cameras_of(data, boards)
    frame = _frame(data.positions.xyz)
    names = trained.camera_names
    uncalibrated = list(groups.uncalibrated)
    parts: list[Part] = []
    several = [group for group in groups.groups if len(group.cameras) > 1]
    lone = [group for group in groups.groups if len(group.cameras) == 1]
    failure: FitError | None = None
    for group in several:
        try:
            parts.append(_aligned(data, trained, group, boards, how, frame))
        except FitError as error:
            failure = error
            uncalibrated += [(c, error.what) for c in group.cameras]
    if lone and how != MATCHING[0]:
        uncalibrated += [
            (n.cameras[0], "it saw no board at the same time as the others, and icp places none") for n in lone
        ]
    elif lone:
        part, left = _placed(data, trained, lone, boards, frame, progress)
        parts += [part] if part.cameras else []
        uncalibrated += left
    if sum(len(part.cameras) for part in parts) < 2:
        if failure is not None and not lone:
            raise failure
        raise _too_few(parts, names, uncalibrated)
    told = [f"{names[c]} is not calibrated, and its views are not used: {why}" for c, why in sorted(uncalibrated)]
    fitted = _together(parts, trained, frame, [*copies_told, *_without_boards(data, trained), *told])
    return replace(fitted, unused=(*fitted.unused, *copied), reprojection=_reprojection(groups))


def _reprojection(groups: CameraGroups) -> float:
    """Rms distance in pixels of the corners that are used from where they are predicted."""
    bundles = [group.bundle for group in groups.groups]
    off = [np.linalg.norm(bundle.residuals(c), axis=1) for bundle in bundles for c in range(len(bundle.cameras))]
    return float(np.sqrt(np.nanmean(np.concatenate(off) ** 2)))


def _too_few(parts: Sequence[Part], names: tuple[str, ...], uncalibrated: Sequence[tuple[int, str]]) -> FitError:
    count = sum(len(part.cameras) for part in parts)
    return FitError(
        f"{count} of {len(names)} cameras can be calibrated together; a position takes two.",
        why="; ".join(f"{names[c]}: {why}" for c, why in sorted(uncalibrated)),
        fix="show every camera the board in ten places or more, and in half of them to two cameras at once, or four "
        "known points or more",
    )


def _together(parts: Sequence[Part], trained: Observations, frame: Frame, notes: Sequence[str]) -> Fitted:
    """One calibration of all parts, cameras in the order of the dataset. Errors that known points share between parts
    are taken as if each part had its own."""
    order = np.argsort([c for part in parts for c in part.cameras])
    models = [model for part in parts for model in part.models]
    ends = np.cumsum([0, *(model.camera.size for model in models)])
    columns = np.concatenate([np.arange(ends[i], ends[i + 1]) for i in order])
    root = np.asarray(block_diag(*(part.root for part in parts)), dtype=np.float64)[:, columns]
    choices = [choice for part in parts for choice in part.choices]
    nowhere = set.intersection(*({one.point for one in part.unused} for part in parts))
    rejected = {(view.point, view.camera): view for part in parts for view in part.rejected}
    return Fitted(
        trained,
        frame,
        tuple(sorted(c for part in parts for c in part.cameras)),
        posterior_of(tuple(models[i] for i in order), root),
        tuple(choices[i] for i in order),
        np.concatenate([part.errors for part in parts]),
        np.concatenate([part.sds for part in parts]),
        tuple(sorted(rejected.values(), key=lambda view: -np.nan_to_num(view.residual, nan=np.inf))),
        tuple(one for one in parts[0].unused if one.point in nowhere),
        (*notes, *(note for part in parts for note in part.notes)),
    )


def _aligned(data: Dataset, trained: Observations, group: CameraGroup, boards: Dataset, how: str, frame: Frame) -> Part:
    """A group of cameras that boards join, by the known points that it measures."""
    known, bundle = data.positions, group.bundle
    settings = bundle.settings
    points = Known(known.xyz, np.nan_to_num(known.sd), known.shots)

    def measuring(by: CameraGroup) -> FittedRig:
        return FittedRig(
            trained,
            data.length_unit,
            WORLD_FRAME,
            by.cameras,
            group_posterior(by, by.bundle.cameras, by.root),
            misfit_adds=True,
            settings=settings.rig_model,
        )

    in_rig = measuring(group)
    uv, noise = in_rig.views(data.observations)
    found = locate(in_rig.posterior, uv, noise, settings=settings.rig_model)
    uv[found.left_out] = np.nan
    first = align(in_rig.posterior.models, group.root, uv, noise, found.xyz, points, how, settings)
    truer = replace(
        group, bundle=replace(bundle, noise=first.error_ratio * bundle.noise), root=first.error_ratio * group.root
    )
    in_rig = measuring(truer)
    _, noise = in_rig.views(data.observations)
    alignment = align(in_rig.posterior.models, truer.root, uv, noise, found.xyz, points, how, settings)
    cameras, root = in_frame(*in_world(bundle.cameras, truer.root, alignment), frame.offset, frame.scale)
    return Part(
        group.cameras,
        group_posterior(truer, cameras, root).models,
        root,
        tuple(group.choices[c] for c in group.cameras),
        alignment.errors,
        alignment.sds,
        wrong_corners(group, boards),
        _not_used(data, in_rig.measure(data.observations).reason, alignment),
        (
            *_moved_notes(in_rig, found.left_out, np.asarray(np.isfinite(uv).all(axis=2))),
            *group_notes(group, trained, boards),
            *_alignment_notes(first, data.length_unit),
        ),
    )


def _placed(
    data: Dataset,
    trained: Observations,
    groups: Sequence[CameraGroup],
    boards: Dataset,
    frame: Frame,
    progress: Progress,
) -> tuple[Part, list[tuple[int, str]]]:
    """Cameras that saw their boards alone, by the known points; and why not the others."""
    mine = data.with_cameras(trained.camera_names)
    settings = groups[0].bundle.settings
    training = TrainingData.of("central", mine, frame, settings.rig_model, shots_off=False)
    fitted = place(training, {group.cameras[0]: group for group in groups}, settings, progress)
    uncalibrated = list(fitted.uncalibrated)
    by_camera = {group.cameras[0]: group for group in groups}
    if not fitted.cameras:
        none = np.zeros((0, 3))
        return Part((), (), np.zeros((0, 0)), (), none, none, (), (), ()), uncalibrated
    diagnosis = Diagnosis(mine, frame, replace(fitted, uncalibrated=()))
    posterior, names = fitted.posterior, trained.camera_names
    root = posterior.joint if posterior.joint is not None else np.asarray(block_diag(*posterior.alone))
    used = [by_camera[c] for c in fitted.cameras]
    notes = [note for group in used for note in group_notes(group, trained, boards)]
    told = (
        f"{', '.join(names[c] for c in fitted.cameras)}: the lens is from boards that no other camera saw, the "
        "place from known points."
    )
    return (
        Part(
            fitted.cameras,
            posterior.models,
            root,
            tuple(group.choices[c] for group, c in zip(used, fitted.cameras, strict=True)),
            *diagnosis.leave_one_out,
            (*(view for group in used for view in wrong_corners(group, boards)), *diagnosis.rejected),
            diagnosis.unused,
            (told, *diagnosis.notes(), *notes),
        ),
        uncalibrated,
    )


def _frame(xyz: Floats) -> Frame:
    offset = xyz.mean(axis=0)
    return Frame(offset, float(np.sqrt(np.mean((xyz - offset) ** 2))) or 1.0)


def _without_boards(data: Dataset, trained: Observations) -> list[str]:
    missing = [name for name in data.observations.camera_names if name not in trained.camera_names]
    return [
        f"{name} is not calibrated, and its views are not used: it is not among the boards' cameras" for name in missing
    ]


def _not_used(data: Dataset, reasons: Names, alignment: Alignment) -> tuple[Unused, ...]:
    return tuple(
        Unused(str(data.points[i]), str(reasons[i]) or "it is not where the others put the world")
        for i in np.flatnonzero(~alignment.used)
    )


def _moved_notes(in_rig: FittedRig, left_out: Bools, used: Bools) -> list[str]:
    """Cameras whose views of the known points are mostly left out: they may have moved since the boards."""
    notes = []
    for c, name in enumerate(in_rig.camera_names):
        away, seen = int(left_out[:, c].sum()), int(left_out[:, c].sum() + used[:, c].sum())
        if away > 0.3 * seen:
            notes.append(
                f"{name}: {away} of its {seen} views of the known points contradict the other cameras. Was it moved "
                "after the pictures of the boards?"
            )
    return notes


def _alignment_notes(alignment: Alignment, unit: str) -> list[str]:
    """Where the world and the rig from the boards differ by more than their error bars."""
    n = int(alignment.used.sum())
    # 3 n errors, each with the square of a normal variable: what chance leaves, and four standard errors of it
    if n < 4 or alignment.misfit**2 < 1 + 4 * np.sqrt(2 / (3 * n)):
        return []
    rms = float(np.sqrt(np.mean(np.sum(alignment.errors**2, axis=1))))
    return [
        f"The boards and the known points contradict each other: after alignment {rms:.2g} {unit} are left, "
        f"{alignment.misfit:.1f} times what the error bars say; the known points are {alignment.scale:.5g} times as "
        "far apart as the boards say. Check the board's square, that no camera moved in between, and the lens models."
    ]
