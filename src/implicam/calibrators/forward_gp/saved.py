"""What a calibration file carries of a fitted rig, and back: nothing is computed twice or trusted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.forward_gp.evidence import Hyperparameters, field_kernel
from implicam.calibrators.forward_gp.fit import FittedRig
from implicam.calibrators.forward_gp.label_errors import LabelErrors
from implicam.calibrators.forward_gp.lens import LENSES, CentralCamera, Image, Prior
from implicam.calibrators.forward_gp.posterior import CameraModel, Posterior, ShotErrors, Unknowns
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
    }
    arrays: dict[str, NDArray[Any]] = {
        "lengthscale": np.asarray(fitted.hyperparameters.lengthscale),
        "sizes": np.array([[m.signal, m.noise, *m.image.centre, m.image.half] for m in posterior.models]),
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
    if posterior.ties is not None and (found := fitted.label_errors) is not None and found.size is not None:
        arrays |= {
            "ties": posterior.ties,
            "labels/scale": found.scale,
            "labels/numbers": np.array([1 / found.freedom, found.noise, found.gain, len(posterior.ties)]),
            "labels/size": found.size,
        }
    if fitted.untold_sd is not None:
        arrays["untold_sd"] = fitted.untold_sd
    if posterior.unknowns is not None and fitted.errors is not None and fitted.label_sd is not None:
        arrays |= {f"shots/{key}": value for key, value in posterior.unknowns._asdict().items()}
        arrays |= {"shots/sd": fitted.errors.sd, "shots/label_sd": fitted.label_sd}
    return table, arrays


def restored(lens: str, data: Dataset, points: Floats, table: Mapping[str, Any], arrays: Arrays) -> FittedRig:
    """The inverse of `state`; points: (n, 3) the known positions in the working frame.

    KeyError, ValueError or TypeError for anything that does not fit.
    """
    names = data.observations.camera_names
    cameras = tuple(names.index(str(name)) for name in table["calibrated"])
    blind = tuple((names.index(str(name)), str(why)) for name, why in table["not_calibrated"].items())
    if sorted([*cameras, *(c for c, _ in blind)]) != list(range(len(names))) or len(cameras) < 2:
        raise ValueError("the cameras calibrated and not calibrated are not those of the data")
    lengthscale = finite_column(arrays, "lengthscale", (2,), positive=True)
    sizes = finite_column(arrays, "sizes", (len(cameras), 5))
    models, alone, kept = [], [], []
    for number, c in enumerate(cameras):
        model, covariance = _model(lens, arrays, number, sizes[number], lengthscale)
        models.append(model)
        alone.append(covariance)
        used = arrays[f"{number}/kept"]
        if used.dtype != np.bool_ or used.shape != (int(data.observations.seen[:, c].sum()),):
            raise ValueError(f"{number}/kept must say of each view whether it is used")
        kept.append(used)
    posterior = _posterior(data, arrays, tuple(models), tuple(alone))
    errors, label_sd = _shot_errors(data, points, arrays, posterior)
    hyper = Hyperparameters(lengthscale, sizes[:, 0], sizes[:, 1])
    label_errors, untold_sd = _label_errors(data, arrays, posterior), None
    if "untold_sd" in arrays:
        untold_sd = finite_column(arrays, "untold_sd", (6,), positive=True)
    return FittedRig(posterior, cameras, blind, tuple(kept), hyper, errors, label_sd, label_errors, untold_sd)


def _label_errors(data: Dataset, arrays: Arrays, posterior: Posterior) -> LabelErrors | None:
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
    return LabelErrors(scale, 1 / thickness if thickness else np.inf, noise, gain, size)


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


def _model(lens: str, arrays: Arrays, number: int, sizes: Floats, lengthscale: Floats) -> tuple[CameraModel, Floats]:
    kind = LENSES[lens]
    numbers = (20 if kind is CentralCamera else 12,)
    camera, ruler = (
        kind.from_array(finite_column(arrays, f"{number}/{what}", numbers)) for what in ("camera", "ruler")
    )
    m = len(arrays[f"{number}/inducing"])
    inducing = finite_column(arrays, f"{number}/inducing", (m, 3))
    weights = finite_column(arrays, f"{number}/weights", (m, 2))
    size = camera.size + 2 * m
    alone = finite_column(arrays, f"{number}/root", (size, size))
    signal, noise, *centre, half = sizes.tolist()
    if not (signal > 0 and noise > 0 and half > 0):
        raise ValueError("signal, noise and image size must be positive")
    none = Prior(np.zeros(camera.size), np.zeros((camera.size, camera.size)))  # only a fit needs it
    field = LowRank(field_kernel(lengthscale), inducing)
    return CameraModel(camera, ruler, none, Image(np.array(centre), half), field, signal, noise, weights), alone


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
