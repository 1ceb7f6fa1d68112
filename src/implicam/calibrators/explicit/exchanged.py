"""Cameras of a calibration for other programs, and a calibration from cameras that another program calibrated."""

from __future__ import annotations

import numpy as np

from implicam.calibrators.explicit.calibration import Explicit, ExplicitCalibration
from implicam.calibrators.explicit.fitted import Fitted, posterior_of
from implicam.calibrators.explicit.lenses import Choice
from implicam.calibrators.protocol import Calibration, RigCalibration
from implicam.dataset import Camera, Dataset, KnownPositions, Observations
from implicam.errors import UsageError
from implicam.exchange import UNKNOWN_UNIT, ExplicitCamera, Rig
from implicam.geometry import Floats, Pose
from implicam.rig_model import (
    CameraModel,
    CentralCamera,
    Frame,
    GeneralCamera,
    Image,
    InitialCamera,
    Prior,
    lens_only_model,
    levenberg_marquardt,
)

DRAWN = 2000
"""Positions in the workspace at which a lens is fitted to what forward-gp predicts."""


def rig_of(calibration: Calibration) -> tuple[Rig, list[str]]:
    """The cameras of a calibration, and what is lost: forward-gp's lenses are fitted to all that it predicts, without
    its field. UsageError for a method that has no cameras."""
    if not isinstance(calibration, RigCalibration):
        raise UsageError(
            f"{calibration.method} has no cameras that could be exported.",
            why="it learns the map from pixels to positions as a whole",
            fix="calibrate the same data with --method explicit",
        )
    fitted_rig, notes, cameras = calibration.map, [], []
    for number, c in enumerate(fitted_rig.cameras):
        described = fitted_rig.trained.cameras[c]
        model = fitted_rig.posterior.models[number]
        camera = model.camera
        if isinstance(camera, GeneralCamera) and not camera.mirrored:
            camera = camera.as_central()
        if not isinstance(camera, CentralCamera):
            what = "sees a mirror image" if isinstance(camera, GeneralCamera) else "has no lens model"
            raise UsageError(
                f"{described.name} {what}, and no camera file can say so.",
                why="other programs know lenses that see the world as it is",
                fix="turn its pictures over, or calibrate the same data with --method explicit",
            )
        if len(model.field.inducing):  # forward-gp
            camera, note = _nearest(model, fitted_rig.frame.to_working(calibration.data.xyz), camera)
            notes += [f"{described.name}: {note}"] if note else []
        cameras.append(
            ExplicitCamera(
                described.name, described.width, described.height, camera.lens, _world(camera, fitted_rig.frame)
            )
        )
    return Rig(tuple(cameras), fitted_rig.length_unit), notes


def _world(camera: CentralCamera, frame: Frame) -> Pose:
    """camera_from_world of a camera of the working frame: the inverse of its offset and scale."""
    turned = camera.pose.rotation @ frame.offset
    return Pose(camera.pose.rotation, camera.pose.translation * frame.scale - turned)


def _nearest(model: CameraModel, points: Floats, camera: CentralCamera) -> tuple[CentralCamera, str]:
    """The lens and place that come nearest to what forward-gp predicts around points, and the cost in pixels."""
    low, high = points.min(axis=0), points.max(axis=0)
    drawn = np.random.default_rng(0).uniform(low, high, size=(DRAWN, 3))
    uv = model.predict(drawn)[0]
    seen = np.isfinite(uv).all(axis=1) & (np.abs(uv - model.image.centre) <= 1.2 * model.image.half).all(axis=1)
    drawn, uv = drawn[seen], uv[seen]
    nothing = Prior(camera.parameters, np.zeros((camera.size, camera.size)))
    fitted = levenberg_marquardt(camera, nothing, drawn, uv, 0.1)
    assert isinstance(fitted, CentralCamera)
    off = np.linalg.norm(fitted.pixel(drawn) - uv, axis=1)
    if np.nanmax(off) < 0.01:
        return fitted, ""
    return fitted, (
        f"a lens model cannot hold all that forward-gp has learned: {np.sqrt(np.nanmean(off**2)):.2g} px rms are lost, "
        f"at most {np.nanmax(off):.2g} px"
    )


def calibration_of(rig: Rig, name: str, noise: float) -> ExplicitCalibration:
    """A calibration that measures with the cameras of another program; noise: of views that do not state theirs, px.

    Nothing is known of how well they are calibrated: the error bars are those of the pixels alone, and a note says so.
    UsageError where there is one camera, or the length unit is not known.
    """
    if len(rig.cameras) < 2:
        raise UsageError("there is one camera; a position takes two.", fix="give the file of the whole rig")
    if rig.length_unit == UNKNOWN_UNIT:
        raise UsageError(
            "the file does not say what its lengths are in.", fix="state the unit of the cameras' places: --unit mm"
        )
    described = tuple(Camera(camera.name, camera.width, camera.height) for camera in rig.cameras)
    none = np.full((0, len(described), 2), np.nan)
    seen = Observations(np.zeros(0, dtype=np.str_), described, none, none)
    known = KnownPositions(np.zeros(0, dtype=np.str_), np.zeros((0, 3)), np.zeros((0, 3)))
    frame = _frame(rig)
    models = tuple(
        lens_only_model(InitialCamera(*_working(camera, frame), np.zeros(0, dtype=np.bool_)), _image(camera), noise)
        for camera in rig.cameras
    )
    fitted = Fitted(
        seen,
        frame,
        tuple(range(len(described))),
        posterior_of(models, np.zeros((1, sum(model.camera.size for model in models)))),
        tuple(Choice(model.camera.lens.family, {}) for model in models if isinstance(model.camera, CentralCamera)),
        np.zeros((0, 3)),
        np.zeros((0, 3)),
        (),
        (),
        (
            "The cameras were calibrated elsewhere, and nothing is known of how well: error bars hold the noise of the "
            f"pixels only ({noise:g} px where a view states none). Check them: implicam evaluate FILE DATASET.",
            *rig.notes,
        ),
        alone=True,
    )
    return ExplicitCalibration(Explicit(), Dataset(name, rig.length_unit, seen, known), fitted)


def _frame(rig: Rig) -> Frame:
    centres = np.array([camera.camera_from_world.centre for camera in rig.cameras])
    offset = centres.mean(axis=0)
    return Frame(offset, float(np.sqrt(np.mean((centres - offset) ** 2))) or 1.0)


def _working(camera: ExplicitCamera, frame: Frame) -> tuple[CentralCamera, Prior]:
    pose = camera.camera_from_world
    there = (pose.rotation @ frame.offset + pose.translation) / frame.scale
    central = CentralCamera(camera.lens, Pose(pose.rotation, there))
    return central, Prior(np.zeros(central.size), np.zeros((central.size, central.size)))


def _image(camera: ExplicitCamera) -> Image:
    if camera.width is None or camera.height is None:
        centre: Floats = np.array([camera.lens.cx, camera.lens.cy])
        return Image(centre, float(max(*centre, 1.0)))
    return Image(np.array([camera.width - 1, camera.height - 1]) / 2, max(camera.width, camera.height) / 2)
