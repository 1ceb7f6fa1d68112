"""What a calibration file carries of a fitted rig, and back: nothing is computed twice or trusted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.forward_gp.evidence import Hyperparameters, field_kernel
from implicam.calibrators.forward_gp.families import FAMILIES
from implicam.calibrators.forward_gp.fit import FittedRig
from implicam.calibrators.forward_gp.general_camera import GeneralCamera
from implicam.calibrators.forward_gp.lens import CentralCamera, Image, Prior, ProjectiveCamera
from implicam.calibrators.forward_gp.posterior import CameraModel, DepthScale, Posterior, ShotErrors, Unknowns
from implicam.calibrators.forward_gp.shots import Shots
from implicam.calibrators.protocol import Arrays, finite_column
from implicam.dataset import Dataset, Floats
from implicam.gp.low_rank import LowRank


def state(fitted: FittedRig, names: Sequence[str]) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """A readable table, and arrays: per camera lens, field, weights, root of the covariance, in the working frame."""
    posterior = fitted.posterior
    table = {
        "calibrated": [names[c] for c in fitted.cameras],
        "not_calibrated": {names[c]: why for c, why in fitted.blind},
        "cameras": [_described(names[c], model) for c, model in zip(fitted.cameras, posterior.models, strict=True)],
    }
    arrays: dict[str, NDArray[Any]] = {
        "lengthscale": np.asarray(fitted.hyperparameters.lengthscale),
        "sizes": np.array([[m.signal, m.noise, *m.image.centre, m.image.half, *m.depth] for m in posterior.models]),
    }
    for number, model in enumerate(posterior.models):
        arrays |= {
            f"{number}/camera": model.camera.as_array(),
            f"{number}/ruler": model.ruler.as_array(),
            f"{number}/inducing": model.field.inducing,
            f"{number}/weights": model.weights,
            f"{number}/kept": fitted.kept[number],
            f"{number}/root": posterior.alone[number],
        }
    if posterior.joint is not None:
        arrays["joint"] = posterior.joint
    if posterior.displacement is not None:
        arrays["displacement"] = posterior.displacement
    if posterior.unknowns is not None and fitted.errors is not None and fitted.label_sd is not None:
        arrays |= {f"shots/{key}": value for key, value in posterior.unknowns._asdict().items()}
        arrays |= {"shots/sd": fitted.errors.sd, "shots/label_sd": fitted.label_sd}
    return table, arrays


CAMERAS: dict[str, type[CentralCamera] | type[GeneralCamera] | type[ProjectiveCamera]] = {
    kind.kind: kind for kind in (CentralCamera, GeneralCamera, ProjectiveCamera)
}
"""Name in a file -> camera model."""


def _described(name: str, model: CameraModel) -> dict[str, Any]:
    """The readable entry of one camera: its model, its lens by name, its kind, and whether it is mirrored."""
    mirrored = isinstance(model.camera, GeneralCamera) and model.camera.mirrored
    lens = "none" if isinstance(model.camera, ProjectiveCamera) else "kannala-brandt"
    return {"name": name, "model": model.camera.kind, "lens": lens, "kind": model.family, "mirrored": mirrored}


def restored(data: Dataset, points: Floats, table: Mapping[str, Any], arrays: Arrays) -> FittedRig:
    """The inverse of `state`; points: (n, 3) the known positions in the working frame.

    KeyError, ValueError or TypeError for anything that does not fit.
    """
    names = data.observations.camera_names
    cameras = tuple(names.index(str(name)) for name in table["calibrated"])
    blind = tuple((names.index(str(name)), str(why)) for name, why in table["not_calibrated"].items())
    if sorted([*cameras, *(c for c, _ in blind)]) != list(range(len(names))) or len(cameras) < 2:
        raise ValueError("the cameras calibrated and not calibrated are not those of the data")
    lengthscales = finite_column(arrays, "lengthscale", (len(cameras), 2), positive=True)
    sizes = finite_column(arrays, "sizes", (len(cameras), 7))
    described = list(table["cameras"])
    if [str(one["name"]) for one in described] != [names[c] for c in cameras]:
        raise ValueError("the cameras described are not those calibrated")
    models, alone, kept = [], [], []
    for number, c in enumerate(cameras):
        model, covariance = _model(described[number], arrays, number, sizes[number], lengthscales[number])
        models.append(model)
        alone.append(covariance)
        used = arrays[f"{number}/kept"]
        if used.dtype != np.bool_ or used.shape != (int(data.observations.seen[:, c].sum()),):
            raise ValueError(f"{number}/kept must say of each view whether it is used")
        kept.append(used)
    posterior = _posterior(data, arrays, tuple(models), tuple(alone))
    errors, label_sd = _shot_errors(data, points, arrays, posterior)
    hyper = Hyperparameters(lengthscales, sizes[:, 0], sizes[:, 1])
    return FittedRig(posterior, cameras, blind, tuple(kept), hyper, errors, label_sd)


def _shot_errors(
    data: Dataset, points: Floats, arrays: Arrays, posterior: Posterior
) -> tuple[ShotErrors | None, Floats | None]:
    if posterior.unknowns is None:
        return None, None
    shots = Shots.of(points, data.shots)
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
    kind, family = CAMERAS[str(described["model"])], str(described["kind"])
    if family not in (*FAMILIES, "none"):
        raise ValueError(f"{family!r} is no kind of camera")
    numbers = {"central": (20,), "general": (24,), "none": (12,)}[kind.kind]
    camera, ruler = (
        kind.from_array(finite_column(arrays, f"{number}/{what}", numbers)) for what in ("camera", "ruler")
    )
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
        camera, ruler, none, image, field, signal, noise, weights, DepthScale(depth, unit), family=family
    )
    return model, alone


def _posterior(data: Dataset, arrays: Arrays, models: tuple[CameraModel, ...], alone: tuple[Floats, ...]) -> Posterior:
    total = sum(model.size for model in models)
    joint = finite_column(arrays, "joint", (total, total)) if "joint" in arrays else None
    displacement = finite_column(arrays, "displacement", (len(data), 3)) if "displacement" in arrays else None
    if (joint is None) != (displacement is None):
        raise ValueError("joint and displacement belong together")
    unknowns = None
    if any(name.startswith("shots/") for name in arrays):
        if joint is None:
            raise ValueError("the errors of shots tie the cameras: joint is missing")
        k = len(arrays["shots/mean"])
        unknowns = Unknowns(
            finite_column(arrays, "shots/mean", (k,)),
            finite_column(arrays, "shots/covariance", (k, k)),
            finite_column(arrays, "shots/cross", (total, k)),
        )
    return Posterior(models, alone, joint, (), 0.0, unknowns, displacement)
