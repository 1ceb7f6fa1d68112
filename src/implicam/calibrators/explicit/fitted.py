"""What a classical calibration is; and two ways to it, from known points, and from boards alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from implicam.calibrators.explicit.agreement import Agreement
from implicam.calibrators.explicit.boards import boards_of
from implicam.calibrators.explicit.camera_groups import CameraGroup, calibrate_largest_group
from implicam.calibrators.explicit.from_points import fit_points
from implicam.calibrators.explicit.lenses import Choice
from implicam.calibrators.explicit.pixels import told
from implicam.calibrators.explicit.settings import ExplicitSettings
from implicam.dataset import Dataset, KnownPositions, Observations, remove_copies
from implicam.dataset.requirements import match_cameras
from implicam.dataset.unused import Rejected, Unused, describe_point_copies, explain_copied_cameras, list_copied_points
from implicam.errors import FitError
from implicam.geometry import Floats
from implicam.progress import Progress
from implicam.rig_model import (
    MAX_NAMED_IN_NOTE,
    CameraModel,
    CentralCamera,
    Diagnosis,
    FitResult,
    FittedRig,
    Frame,
    InitialCamera,
    Posterior,
    TrainingData,
    lens_only_model,
    stated_noise,
)

METHOD = "explicit"

CONTRADICT = "contradict each other on"
"""In the note of two cameras that fit alone and not together."""

MAX_ALONE_NOISES = 3.0
"""Residual of cameras alone, in the stated noise of their corners, above which it is the lenses that do not fit."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """Cameras in the working frame. trained: the observations that cameras, sizes and stated noise are known from;
    cameras: numbers of those calibrated; choices: their lens models; errors, sds (m, 3): of known points, each left
    out in turn. alone: from boards alone, so that nothing is known and errors are those of corners as adjusted.

    Of the paper's presets: reference, the place in `cameras` of the one in whose frame points are triangulated;
    inflation, what standard deviations are multiplied by (None, of every other preset: measured by maximum likelihood).
    From boards and known points, reprojection: rms distance of the corners from where they are predicted, pixels."""

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
    alone: bool = False
    reference: int = 0
    inflation: float | None = None
    reprojection: float = float("nan")


def fit_to_points(data: Dataset, family: str, settings: ExplicitSettings, progress: Progress) -> Fitted:
    """Every camera from the known points.

    Args:
        data: Known points and what the cameras saw of them.
        family: Name of the lens of all cameras, or `auto`.
        settings: Priors and thresholds.
        progress: Is told how far the fit is.

    Returns:
        The cameras that could be calibrated.

    Raises:
        FitError: The points do not fill a volume, or fewer than two cameras can be calibrated.
    """
    used = remove_copies(data)
    frame = Frame.of(used, METHOD)
    training = TrainingData.of("central", used, frame, settings.rig_model, shots_off=False)
    fitted, choices = fit_points(training, family, settings, progress)
    fitted = replace(fitted, uncalibrated=explain_copied_cameras(data, fitted.uncalibrated))
    diagnosis = Diagnosis(used, frame, fitted)
    return Fitted(
        data.observations,
        frame,
        fitted.cameras,
        fitted.posterior,
        tuple(choices[c] for c in fitted.cameras),
        *diagnosis.leave_one_out,
        diagnosis.rejected,
        (*diagnosis.unused, *list_copied_points(data)),
        (
            *describe_point_copies(data),
            *diagnosis.notes(),
            *_pixel_notes(used, fitted, choices),
            *diagnosis.noise_notes(),
        ),
    )


def _pixel_notes(data: Dataset, fitted: FitResult, choices: Mapping[int, Choice]) -> list[str]:
    notes = []
    for c, model in zip(fitted.cameras, fitted.posterior.models, strict=True):
        assert isinstance(model.camera, CentralCamera)
        notes += told(data.observations.camera_names[c], model.camera, model.image, choices[c].pixels)
    return notes


def fit_to_boards_alone(
    data: Dataset, family: str, settings: ExplicitSettings, progress: Progress
) -> tuple[Dataset, Fitted]:
    """Cameras in the frame of the first, from boards at places nobody knows.

    Args:
        data: Corners of boards, and what the cameras saw of them.
        family: Name of the lens of all cameras, or `auto`.
        settings: Priors and thresholds.
        progress: Is told how far the fit is.

    Returns:
        The data of the corners placed, with the positions that they have there; and the cameras.

    Raises:
        FitError: Fewer than two cameras can be calibrated together, or nothing says where corners are on the board.
    """
    group = calibrate_largest_group(boards_of(data, settings=settings), family, progress)
    placed = _placed(data, group)
    posterior = group_posterior(group, group.bundle.cameras, group.root)
    rig = FittedRig(
        data.observations,
        data.length_unit,
        WORLD_FRAME,
        group.cameras,
        posterior,
        misfit_adds=True,
        settings=settings.rig_model,
    )
    measured = rig.measure(placed.observations)
    first = data.observations.camera_names[group.cameras[0]]
    fitted = Fitted(
        data.observations,
        WORLD_FRAME,
        group.cameras,
        posterior,
        tuple(group.choices[c] for c in group.cameras),
        (measured.xyz - placed.xyz)[measured.measured],
        measured.sd[measured.measured],
        wrong_corners(group, data),
        (),
        (
            f"Positions are in the frame of {first}: x right, y down, z forward. Known points bring them into a world "
            "of your own: implicam calibrate POINTS --method explicit --boards BOARDS.",
            *group_notes(group, data.observations, data),
        ),
        alone=True,
    )
    return placed, fitted


WORLD_FRAME = Frame(np.zeros(3), 1.0)


def by_cameras_of(data: Dataset, boards: Dataset) -> Observations:
    """What the cameras of some data saw of the boards.

    Args:
        data: Known points.
        boards: Corners of boards.

    Returns:
        The boards' observations by the cameras that both have.

    Raises:
        FitError: They share fewer than two cameras.
        DatasetError: A camera has images of another size in the one than in the other.
    """
    names = [name for name in data.observations.camera_names if name in boards.observations.camera_names]
    if len(names) < 2:
        raise FitError(
            f"boards and known points share {len(names)} camera{'s' * (len(names) != 1)}; a position takes two.",
            why=f"the boards were seen by {', '.join(boards.observations.camera_names)}, "
            f"the known points by {', '.join(data.observations.camera_names)}",
            fix="give boards that the same cameras saw, with the same names in dataset.toml",
        )
    trained = boards.observations.with_cameras(names)
    match_cameras(trained, data.observations.with_cameras(names))
    return trained


def _placed(data: Dataset, group: CameraGroup) -> Dataset:
    """The corners that a calibrated camera saw, where the adjustment puts them."""
    xyz = np.full((len(data), 3), np.nan)
    for view in group.bundle.views.each:
        xyz[view.rows] = group.bundle.boards.pose(view.board).apply(view.xyz)
    there = np.isfinite(xyz).all(axis=1)
    known = KnownPositions(group.shots[there], xyz[there], np.full((int(there.sum()), 3), np.nan))
    return replace(data.select(there), known=known)


def group_posterior(group: CameraGroup, cameras: Sequence[CentralCamera], root: Floats) -> Posterior:
    """Cameras of a group as a posterior.

    Args:
        group: The group, for priors, images and noise.
        cameras: Its cameras, wherever they have been moved to.
        root: (q, P) of their covariance there.

    Returns:
        The posterior, in the frame of these cameras.
    """
    none = [np.ones(camera.size, dtype=np.bool_) for camera in cameras]  # only a fit asks which views started it
    models = tuple(
        lens_only_model(InitialCamera(camera, prior, inliers), image, float(noise))
        for camera, prior, inliers, image, noise in zip(
            cameras, group.bundle.priors, none, group.images, group.bundle.noise, strict=True
        )
    )
    return posterior_of(models, root)


def posterior_of(models: tuple[CameraModel, ...], root: Floats) -> Posterior:
    """The posterior of cameras whose fields, which are none, have no spread.

    Args:
        models: The cameras.
        root: (q, P) of the covariance of their lenses and poses.

    Returns:
        The posterior, with all cameras tied.
    """
    parts, start = [], 0
    for model in models:
        own = root[:, start : start + model.camera.size]
        parts.append(np.hstack([own, np.zeros((len(root), model.size - model.camera.size))]))
        start += model.camera.size
    return Posterior(models, tuple(parts), np.hstack(parts), (), 0.0)


def wrong_corners(group: CameraGroup, boards: Dataset) -> tuple[Rejected, ...]:
    """The corners of boards that are not used, the farthest first.

    Args:
        group: The group.
        boards: The dataset that its boards are from.

    Returns:
        Names of the corner and camera, and how far off it is, pixels.
    """
    names, points = boards.observations.camera_names, boards.points
    found = [Rejected(str(points[row]), names[c], off) for row, c, off in group.wrong]
    return tuple(sorted(found, key=lambda view: -np.nan_to_num(view.residual, nan=np.inf)))


def group_notes(group: CameraGroup, trained: Observations, boards: Dataset) -> list[str]:
    """What is to be said of the boards: cameras that contradict each other, wrong corners, lenses hardly fixed.

    Args:
        group: The group.
        trained: What its cameras saw of the boards.
        boards: The dataset that its boards are from.

    Returns:
        The notes.
    """
    names = trained.camera_names
    notes = [f"{names[c]} is not calibrated, and its views are not used: {why}" for c, why in group.uncalibrated]
    notes += [_doubt_note(one, group, trained, boards) for one in group.doubts]
    if group.wrong:
        worst = wrong_corners(group, boards)[:MAX_NAMED_IN_NOTE]
        named = ", ".join(f"{view.point} in {view.camera} ({view.residual:.3g} px off)" for view in worst)
        more = f" and {len(group.wrong) - MAX_NAMED_IN_NOTE} more" if len(group.wrong) > MAX_NAMED_IN_NOTE else ""
        count = f"{len(group.wrong)} corner{'s' * (len(group.wrong) != 1)}"
        notes.append(f"{count} not used, far from where the others predict them: {named}{more}.")
    return [*notes, *_lens_notes(group, trained)]


def _doubt_note(one: Agreement, group: CameraGroup, trained: Observations, boards: Dataset) -> str:
    """Of two cameras that do not fit together: that something moved, or that their lenses are not held.

    Pictures of other instants leave each camera alone as good as its corners are. A lens that no model holds leaves
    more than that in each, and most of it hides in the poses of the boards until two cameras must share these.
    """
    names, stated = trained.camera_names, stated_noise(trained)
    pair = f"{names[one.pair[0]]} and {names[one.pair[1]]}"
    which = f"the {one.boards} boards that both saw: alone {one.alone:.2g} px, together {one.together:.2g} px"
    corners = float(np.sqrt(np.mean(stated[list(one.pair)] ** 2)))
    if one.alone > MAX_ALONE_NOISES * corners:
        return (
            f"{pair} do not fit together on {which}, and alone already {one.alone / corners:.2g} times what their "
            "corners are good to: no lens model here holds these lenses, or the board is not flat. The error bars "
            "allow for it. Known points and forward-gp learn such a lens; more boards do not."
        )
    moved = np.sqrt(6) * group.bundle.slack  # along three axes, in either picture
    return (
        f"{pair} {CONTRADICT} {which}, as if boards had moved by about {moved:.1g} {boards.length_unit} from one "
        "picture to the other. The pictures are not of the same instants, or a camera or the rig moved between them. "
        "The error bars allow for it; what moves while it is measured is off by more."
    )


def _lens_notes(group: CameraGroup, trained: Observations) -> list[str]:
    """Lenses that the boards hardly fix, noise that is not what the views state, an adjustment that did not settle."""
    notes, bundle = [], group.bundle
    sd = np.sqrt(np.sum(group.root**2, axis=0))
    stated = stated_noise(trained)
    for number, c in enumerate(group.cameras):
        name, lens = trained.camera_names[c], bundle.cameras[number].lens
        notes += told(name, bundle.cameras[number], group.images[number], group.choices[c].pixels)
        loose = float(sd[bundle.starts[number]] / lens.fx)
        if loose > bundle.settings.max_unknown_focal_share:
            notes.append(
                f"{name}: the boards fix its focal length to {100 * loose:.1g} % only. Show them tilted, near and far."
            )
        if np.isfinite(stated[c]) and not 0.5 < bundle.noise[number] / stated[c] < 2:
            notes.append(
                f"{name}: corners are off by {bundle.noise[number]:.2g} px, and they state {stated[c]:.2g} px: "
                "their sd is wrong, or no lens model holds this lens."
            )
    if not group.converged:
        notes.append("The bundle adjustment had not settled when it was stopped: look for wrong pictures.")
    return notes
