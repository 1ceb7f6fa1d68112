"""What a calibration file carries of a fitted rig, and back: nothing is computed twice or trusted."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.forward_gp.settings import KINDS, ForwardGPSettings
from implicam.calibrators.protocol import Arrays, finite_column
from implicam.dataset import Dataset
from implicam.geometry import Floats
from implicam.gp.low_rank import LowRank
from implicam.lenses import KannalaBrandt
from implicam.rig_model.camera import CentralCamera, Image, Prior, ProjectiveCamera
from implicam.rig_model.camera_model import CameraModel
from implicam.rig_model.field import DepthScale, Hyperparameters, field_kernel
from implicam.rig_model.fit_result import FitResult
from implicam.rig_model.general_camera import GeneralCamera
from implicam.rig_model.heavy_tails import HeavyTails
from implicam.rig_model.position_errors import PositionErrors
from implicam.rig_model.posterior import Posterior
from implicam.rig_model.schur import Unknowns
from implicam.rig_model.shot_errors import ShotErrors, Shots


def state(fitted: FitResult, names: Sequence[str]) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """A readable table, and arrays: per camera lens, field, weights, root of the covariance, in the working frame.

    Args:
        fitted: The fit.
        names: Of all cameras of the dataset.

    Returns:
        Both, without the options and the frame.
    """
    posterior = fitted.posterior
    table = {
        "calibrated": [names[c] for c in fitted.cameras],
        "not_calibrated": {names[c]: why for c, why in fitted.uncalibrated},
        "cameras": [_described(fitted, number, names[c]) for number, c in enumerate(fitted.cameras)],
    }
    arrays: dict[str, NDArray[Any]] = {
        "lengthscale": np.asarray(fitted.hyperparameters.lengthscale),
        "sizes": np.array([[m.signal, m.noise, *m.image.centre, m.image.half, *m.depth] for m in posterior.models]),
    }
    for number, model in enumerate(posterior.models):
        arrays |= {
            f"{number}/camera": model.camera.as_array(),
            f"{number}/ruler": model.field_camera.as_array(),
            f"{number}/inducing": model.field.inducing,
            f"{number}/weights": model.weights,
            f"{number}/kept": fitted.inliers[number],
            f"{number}/root": posterior.alone[number],
        }
    if fitted.tails is not None:
        arrays["tails"] = np.array([fitted.tails.degrees])
        arrays |= {f"{number}/tail_weights": w for number, w in enumerate(fitted.tails.weights)}
    if posterior.joint is not None:
        arrays["joint"] = posterior.joint
    if posterior.displacement is not None:
        arrays["displacement"] = posterior.displacement
    if posterior.ties is not None and (found := fitted.position_errors) is not None and found.size is not None:
        arrays |= {
            "ties": posterior.ties,
            "labels/scale": found.scale,
            "labels/numbers": np.array([1 / found.freedom, found.noise, found.gain, len(posterior.ties)]),
            "labels/size": found.size,
        }
    if fitted.plane_sd is not None:
        arrays["untold_sd"] = fitted.plane_sd
    if posterior.unknowns is not None and fitted.errors is not None and fitted.label_sd is not None:
        arrays |= {f"shots/{key}": value for key, value in posterior.unknowns._asdict().items()}
        arrays |= {"shots/sd": fitted.errors.sd, "shots/label_sd": fitted.label_sd}
    return table, arrays


CAMERAS: dict[str, tuple[Callable[[Floats], CentralCamera | GeneralCamera | ProjectiveCamera], int, str]] = {
    CentralCamera.kind: (partial(CentralCamera.from_array, lens=KannalaBrandt), 20, KannalaBrandt.family),
    GeneralCamera.kind: (GeneralCamera.from_array, 24, KannalaBrandt.family),
    ProjectiveCamera.kind: (ProjectiveCamera.from_array, 12, "none"),
}
"""Name of a camera model in a file -> how it is read, from how many numbers, and the lens that the file must name."""


def _described(fitted: FitResult, number: int, name: str) -> dict[str, Any]:
    """The readable entry of one camera: its model, its lens by name, its kind, whether it is mirrored, and what an
    ordinary camera would have left."""
    model = fitted.posterior.models[number]
    mirrored = isinstance(model.camera, GeneralCamera) and model.camera.mirrored
    lens = CAMERAS[model.camera.kind][2]
    table = {"name": name, "model": model.camera.kind, "lens": lens, "kind": model.family, "mirrored": mirrored}
    left = fitted.left_by_ordinary(number)
    return table | ({"ordinary_would_leave_px": left} if np.isfinite(left) else {})


def restored(
    data: Dataset, points: Floats, table: Mapping[str, Any], arrays: Arrays, settings: ForwardGPSettings
) -> FitResult:
    """The inverse of `state`.

    Args:
        data: That it was fitted to, without what is there twice.
        points: (n, 3) the known positions in the working frame.
        table: Of `state`.
        arrays: Of `state`.
        settings: With which it was fitted.

    Returns:
        The fit.

    Raises:
        KeyError, ValueError, TypeError: Something is missing or does not fit.
    """
    names = data.observations.camera_names
    cameras = tuple(names.index(str(name)) for name in table["calibrated"])
    uncalibrated = tuple((names.index(str(name)), str(why)) for name, why in table["not_calibrated"].items())
    if sorted([*cameras, *(c for c, _ in uncalibrated)]) != list(range(len(names))) or len(cameras) < 2:
        raise ValueError("the cameras calibrated and not calibrated are not those of the data")
    lengthscales = finite_column(arrays, "lengthscale", (len(cameras), 2), positive=True)
    sizes = finite_column(arrays, "sizes", (len(cameras), 7))
    described = list(table["cameras"])
    if [str(one["name"]) for one in described] != [names[c] for c in cameras]:
        raise ValueError("the cameras described are not those calibrated")
    models, alone, inliers = [], [], []
    for number, c in enumerate(cameras):
        model, covariance = _model(described[number], arrays, number, sizes[number], lengthscales[number])
        models.append(model)
        alone.append(covariance)
        used = arrays[f"{number}/kept"]
        if used.dtype != np.bool_ or used.shape != (int(data.observations.seen[:, c].sum()),):
            raise ValueError(f"{number}/kept must say of each view whether it is used")
        inliers.append(used)
    posterior = _posterior(data, arrays, tuple(models), tuple(alone))
    errors, label_sd = _shot_errors(data, points, arrays, posterior, settings)
    hyper = Hyperparameters(lengthscales, sizes[:, 0], sizes[:, 1])
    ordinary = tuple(float(one.get("ordinary_would_leave_px", np.nan)) for one in described)
    position_errors, plane_sd = _position_errors(data, arrays, posterior, settings), None
    if "untold_sd" in arrays:
        plane_sd = finite_column(arrays, "untold_sd", (6,), positive=True)
    tails = _tails(arrays, inliers)
    return FitResult(
        posterior,
        cameras,
        uncalibrated,
        tuple(inliers),
        hyper,
        errors,
        label_sd,
        tails,
        position_errors,
        plane_sd,
        ordinary,
    )


def _tails(arrays: Arrays, inliers: Sequence[NDArray[np.bool_]]) -> HeavyTails | None:
    """None where the noise is normal, as in files from before there were tails."""
    if "tails" not in arrays:
        return None
    degrees = float(finite_column(arrays, "tails", (1,))[0])
    if degrees <= 2:
        raise ValueError("noise with two degrees of freedom or fewer has no variance")
    weights = (
        finite_column(arrays, f"{number}/tail_weights", used.shape, positive=True)
        for number, used in enumerate(inliers)
    )
    return HeavyTails(degrees, tuple(weights))


def _position_errors(
    data: Dataset, arrays: Arrays, posterior: Posterior, settings: ForwardGPSettings
) -> PositionErrors | None:
    if posterior.ties is None:
        if any(name.startswith("labels/") for name in arrays):
            raise ValueError("errors of known positions tie the cameras: ties is missing")
        return None
    thickness, noise, gain, rows = finite_column(arrays, "labels/numbers", (4,)).tolist()
    if not (0 <= thickness < 0.5 and 0 < noise <= 1 and rows == len(posterior.ties)):
        raise ValueError(
            "labels/numbers must be one over the degrees of freedom, the noise left, the gain, and the ties"
        )
    scale = finite_column(arrays, "labels/scale", (3, 3))
    if not np.allclose(scale, scale.T) or np.linalg.eigvalsh(scale)[0] <= 0:
        raise ValueError("labels/scale must be a covariance")
    size = finite_column(arrays, "labels/size", (len(data),), positive=True)
    freedom = 1 / thickness if thickness else np.inf
    return PositionErrors(scale, freedom, noise, gain, settings.error_bar_level, size)


def _shot_errors(
    data: Dataset, points: Floats, arrays: Arrays, posterior: Posterior, settings: ForwardGPSettings
) -> tuple[ShotErrors | None, Floats | None]:
    if posterior.unknowns is None:
        return None, None
    shots = Shots.of(points, data.shots, settings)
    if shots is None:
        raise ValueError("the data have no shots of which errors were estimated")
    errors = shots.errors(points)
    k = errors.sd.shape[1]
    if posterior.unknowns.mean.shape != (k,):
        raise ValueError("shots/mean does not fit the shots")
    sd = finite_column(arrays, "shots/sd", (1, k), positive=True)
    label_sd = finite_column(arrays, "shots/label_sd", (1, k), positive=True)
    return ShotErrors(errors.shot, errors.basis, sd, errors.group), label_sd


def _model(
    described: Mapping[str, Any], arrays: Arrays, number: int, sizes: Floats, lengthscale: Floats
) -> tuple[CameraModel, Floats]:
    family = str(described["kind"])
    if family not in (*KINDS, "none"):
        raise ValueError(f"{family!r} is no kind of camera")
    read, numbers, lens = CAMERAS[str(described["model"])]
    if described["lens"] != lens:
        raise ValueError(f"a camera of the model {described['model']!r} has the lens {lens}, not {described['lens']!r}")
    camera, field_camera = (read(finite_column(arrays, f"{number}/{what}", (numbers,))) for what in ("camera", "ruler"))
    m = len(arrays[f"{number}/inducing"])
    inducing = finite_column(arrays, f"{number}/inducing", (m, 3))
    weights = finite_column(arrays, f"{number}/weights", (m, 2))
    size = camera.size + 2 * m
    alone = finite_column(arrays, f"{number}/root", (size, size))
    signal, noise, *centre, half, depth, unit = sizes.tolist()
    if not (signal > 0 and noise > 0 and half > 0 and unit > 0):
        raise ValueError("signal, noise, image size and depth unit must be positive")
    none = Prior(np.zeros(camera.size), np.zeros((camera.size, camera.size)))  # only a fit needs it
    field = LowRank(field_kernel(lengthscale), inducing)
    image = Image(np.array(centre), half)
    model = CameraModel(
        camera, field_camera, none, image, field, signal, noise, weights, DepthScale(depth, unit), family=family
    )
    return model, alone


def _posterior(data: Dataset, arrays: Arrays, models: tuple[CameraModel, ...], alone: tuple[Floats, ...]) -> Posterior:
    total = sum(model.size for model in models)
    joint = finite_column(arrays, "joint", (total, total)) if "joint" in arrays else None
    ties = finite_column(arrays, "ties", (len(arrays["ties"]), total)) if "ties" in arrays else None
    displacement = finite_column(arrays, "displacement", (len(data), 3)) if "displacement" in arrays else None
    if (joint is None and ties is None) != (displacement is None) or (joint is not None and ties is not None):
        raise ValueError("joint or ties belongs to displacement, one of them")
    unknowns = None
    if any(name.startswith("shots/") for name in arrays):
        if joint is None and ties is None:
            raise ValueError("the errors of shots tie the cameras: joint is missing")
        k, rows = len(arrays["shots/mean"]), total + (0 if ties is None else len(ties))
        unknowns = Unknowns(
            finite_column(arrays, "shots/mean", (k,)),
            finite_column(arrays, "shots/covariance", (k, k)),
            finite_column(arrays, "shots/cross", (rows, k)),
        )
    return Posterior(models, alone, joint, (), 0.0, unknowns, displacement, ties)
