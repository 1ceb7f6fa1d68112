"""The paper's classical calibration, into the world and measuring: linear triangulation, closest points, no weights.

`opencv_pipeline` has the cameras. Each known point is triangulated in the frame of the reference camera, the cloud is
moved onto the known positions by iterative closest point (or by name), every point counting the same. The paper states
no error bars for it and says that such are "generally relying on a post-hoc analysis of residual errors". So are these:
the noise that the corners of the boards show, through the triangulation, times what makes it agree with what is left at
the known points after the alignment (`inflation`, never below one).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtrc

from implicam.calibrators.explicit.align import Alignment, check_alignment, extent_ratio, left_out, matched
from implicam.calibrators.explicit.fitted import WORLD_FRAME, Fitted, by_cameras_of, posterior_of
from implicam.calibrators.explicit.opencv_pipeline import OpenCVRig
from implicam.calibrators.explicit.settings import ExplicitSettings
from implicam.dataset import Dataset, Observations, remove_copies
from implicam.dataset.requirements import match_cameras
from implicam.dataset.unused import Unused, describe_point_copies, list_copied_points
from implicam.errors import FitError
from implicam.geometry import Bools, Floats, Pose
from implicam.measurement import Measurement
from implicam.rig_model import CameraModel, CentralCamera, FittedRig, Frame, InitialCamera, Posterior, lens_only_model

JOINT, PAPER, PAPER_BUNDLE = "joint", "paper", "paper-bundle"
PRESETS = (JOINT, PAPER, PAPER_BUNDLE)
"""Ours; the paper's pipeline without a joint adjustment at its end, and with one: the paper does not say which."""


def fit_like_the_paper(data: Dataset, rig: OpenCVRig, boards: Dataset, how: str, settings: ExplicitSettings) -> Fitted:
    """The cameras of OpenCV in the world of the known points.

    Args:
        data: the known points.
        rig: the cameras, in the unit of the known points.
        boards: what the rig was calibrated from.
        how: matched with known positions by name (`points`) or by closeness (`icp`).
        settings: when known points and boards contradict each other.

    Raises:
        FitError: the known points do not fix where the rig is, or contradict the boards.
    """
    copied, told = list_copied_points(data), describe_point_copies(data)
    data = remove_copies(data)
    trained = by_cameras_of(data, boards)
    in_rig = FittedRig(trained, data.length_unit, WORLD_FRAME, rig.cameras, _posterior(rig, rig.bundle.cameras))
    uv, _ = in_rig.views(data.observations)
    frame = _frame(data.positions.xyz)
    xyz, cov, _, _ = triangulated(in_rig.posterior.models, rig.reference, uv, frame.scale)
    there = np.asarray(np.isfinite(xyz).all(axis=1))
    if there.sum() < 3:
        raise FitError(
            f"{there.sum()} known points can be triangulated with the boards' calibration; it takes three to align it.",
            fix="add known points that two cameras see",
        )
    known = data.positions.xyz
    measured = np.where(there[:, None], xyz, 0)
    pose, pairs = matched(measured, known, there, how, settings)
    residual = measured - pose.apply(known[pairs])
    inflation = _inflation(residual[there], cov[there])
    errors, sds = _left_out(pose, known[pairs][there], residual[there], inflation**2 * cov[there])
    scale = extent_ratio(measured[there], known[pairs][there])
    found = Alignment(pose, there, np.zeros((6, 0)), np.zeros((6, 6)), errors, sds, scale)
    extent = float(np.sqrt(np.sum(known.var(axis=0))))
    check_alignment(found, residual[there], known[pairs][there], measured[there], extent, settings)
    cameras = [_in_frame(camera, pose, frame) for camera in rig.bundle.cameras]
    unused = tuple(
        Unused(str(data.points[i]), reason)
        for i, reason in enumerate(_reasons(in_rig, data.observations, uv, xyz))
        if not there[i]
    )
    return Fitted(
        trained,
        frame,
        rig.cameras,
        _posterior(rig, cameras),
        rig.choices,
        errors,
        sds,
        (),
        (*unused, *copied),
        (*told, *_notes(rig, data, trained)),
        reference=rig.reference,
        inflation=inflation,
        reprojection=rig.reprojection,
    )


def _frame(xyz: Floats) -> Frame:
    offset = xyz.mean(axis=0)
    return Frame(offset, float(np.sqrt(np.mean((xyz - offset) ** 2))) or 1.0)


def _posterior(rig: OpenCVRig, cameras: Sequence[CentralCamera]) -> Posterior:
    """Of cameras that are taken as exactly known, as OpenCV's users take them."""
    none = np.zeros(0, dtype=np.bool_)
    models = tuple(
        lens_only_model(InitialCamera(camera, prior, none), image, float(noise))
        for camera, prior, image, noise in zip(cameras, rig.bundle.priors, rig.images, rig.bundle.noise, strict=True)
    )
    return posterior_of(models, np.zeros((1, sum(camera.size for camera in cameras))))


def _in_frame(camera: CentralCamera, rig_from_world: Pose, frame: Frame) -> CentralCamera:
    pose = camera.pose @ rig_from_world
    return replace(camera, pose=Pose(pose.rotation, pose.apply(frame.offset) / frame.scale))


def _notes(rig: OpenCVRig, data: Dataset, trained: Observations) -> list[str]:
    names = trained.camera_names
    missing = [name for name in data.observations.camera_names if name not in names]
    return [
        *(
            f"{name} is not calibrated, and its views are not used: it is not among the boards' cameras"
            for name in missing
        ),
        *(f"{names[c]} is not calibrated, and its views are not used: {why}" for c, why in rig.uncalibrated),
        *rig.notes,
        f"The paper's pipeline, to compare with: corners are left {rig.reprojection:.2g} px off. Its error bars are "
        "the residuals of the calibration, not what is unknown of the cameras.",
    ]


def _inflation(residual: Floats, cov: Floats) -> float:
    """What standard deviations are multiplied by, so that the residuals (m, 3) of the alignment, which took six
    numbers from them, are as large as covariances (m, 3, 3) say; never below one."""
    squares = np.einsum("ni,ni->", residual, np.linalg.solve(cov, residual[..., None])[..., 0])
    return float(np.sqrt(max(1.0, squares / max(residual.size - 6, 1))))


def _left_out(pose: Pose, known: Floats, residual: Floats, cov: Floats) -> tuple[Floats, Floats]:
    """Errors and sds (m, 3) in the world of the known points, each as if the motion came from the others."""
    turned = known @ pose.rotation.T
    G = np.zeros((len(known), 3, 6))
    G[:, :, 3:] = np.eye(3)
    G[:, 0, 1], G[:, 0, 2], G[:, 1, 2] = turned[:, 2], -turned[:, 1], turned[:, 0]
    G[:, 1, 0], G[:, 2, 0], G[:, 2, 1] = -turned[:, 2], turned[:, 1], -turned[:, 0]
    Q = np.linalg.inv(np.einsum("nia,nib->ab", G, G))
    return left_out(pose, Q, G, np.broadcast_to(np.eye(3), (len(known), 3, 3)), residual, cov)


def triangulated(
    models: Sequence[CameraModel], reference: int, uv: Floats, unit: float = 1.0
) -> tuple[Floats, Floats, Floats, Bools]:
    """Points by the direct linear transformation in the frame of the reference camera, as cv2.triangulatePoints has it
    for two cameras (Hartley & Zisserman, section 12.2), in undistorted normalised coordinates.

    Args:
        models: the cameras.
        reference: the place in `models` of the one in whose frame the linear equations are written.
        uv: (n, C, 2) pixels, NaN where not seen.
        unit: the length that is one in the linear equations: what they weigh depends on it, slightly.

    Returns:
        xyz (n, 3) in the cameras' world, NaN where two cameras do not give a place in front of them; cov (n, 3, 3) from
        the noise of the pixels; p (n,) of the chi-squared test that the views agree; and (n, C) which views were used.
    """
    n, home = len(uv), models[reference].camera
    assert isinstance(home, CentralCamera)
    rows = np.zeros((n, 2 * len(models), 4))
    seen = np.zeros((n, len(models)), dtype=np.bool_)
    for c, model in enumerate(models):
        assert isinstance(model.camera, CentralCamera)
        rays, valid = model.camera.lens.ray_from_pixel(uv[:, c])
        seen[:, c] = valid & (rays[:, 2] > 0)
        plane = rays[seen[:, c], :2] / rays[seen[:, c], 2:]
        pose = model.camera.pose @ home.pose.inverse()
        P = np.column_stack([pose.rotation, pose.translation / unit])
        rows[seen[:, c], 2 * c : 2 * c + 2] = plane[:, :, None] * P[2] - P[:2]
    with np.errstate(divide="ignore", invalid="ignore"):
        null = np.linalg.svd(rows)[2][:, -1]
        local = unit * null[:, :3] / null[:, 3:]
    xyz = home.pose.inverse().apply(local)
    good = (seen.sum(axis=1) >= 2) & np.isfinite(xyz).all(axis=1)
    H, squares = np.zeros((n, 3, 3)), np.zeros(n)
    for c, model in enumerate(models):
        at = np.flatnonzero(good & seen[:, c])
        view = model.camera.view(xyz[at])
        H[at] += view.by_point.swapaxes(1, 2) @ view.by_point / model.noise**2
        squares[at] += np.sum((uv[at, c] - view.uv) ** 2, axis=1) / model.noise**2
        good[at[~np.isfinite(view.uv).all(axis=1)]] = False
    scaled = np.einsum("nii->n", H)
    good &= np.isfinite(H).all(axis=(1, 2)) & (scaled > 0)
    good[good] = np.linalg.cond(H[good]) < 1 / np.finfo(np.float64).eps
    cov = np.full((n, 3, 3), np.nan)
    cov[good] = np.linalg.inv(H[good])
    p = np.where(good, chdtrc(np.maximum(2 * seen.sum(axis=1) - 3, 1), squares), np.nan)
    return np.where(good[:, None], xyz, np.nan), cov, p, seen & good[:, None]


def measure_linearly(fitted: Fitted, rig: FittedRig, observations: Observations) -> Measurement:
    """Measure each point by linear triangulation, with all the views it has.

    Args:
        fitted: what the paper's pipeline has calibrated.
        rig: its cameras.
        observations: what they saw.

    Returns:
        The positions in the world, their covariances those of the pixels' noise times `inflation` squared.
    """
    known = [name for name in rig.trained.camera_names if name in observations.camera_names]
    observations = match_cameras(rig.trained.with_cameras(known) if known else rig.trained, observations)
    uv, _ = rig.views(observations)
    assert fitted.inflation is not None
    xyz, cov, p, used = triangulated(fitted.posterior.models, fitted.reference, uv)
    return Measurement(
        observations.points,
        fitted.frame.to_world(xyz),
        cov * (fitted.frame.scale * fitted.inflation) ** 2,
        used.sum(axis=1),
        p,
        np.array(_reasons(rig, observations, uv, xyz), dtype=np.str_),
        rig.length_unit,
    )


def _reasons(rig: FittedRig, observations: Observations, uv: Floats, xyz: Floats) -> list[str]:
    """(n,) why a point has no position; empty where it has one."""
    usable: Bools = np.asarray(np.isfinite(uv).all(axis=2))
    reasons = []
    for i in range(len(xyz)):
        if np.isfinite(xyz[i, 0]):
            reasons.append("")
        elif not observations.seen[i].any():
            reasons.append("no camera saw it")
        elif not usable[i].any():
            reasons.append("no calibrated camera saw it")
        elif usable[i].sum() == 1:
            reasons.append(f"only {rig.camera_names[int(np.argmax(usable[i]))]} saw it; a position takes two cameras")
        else:
            reasons.append("no position in front of the cameras explains its views")
    return reasons
