"""What a calibration file carries of a classical calibration, and back: nothing is computed twice or trusted."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.explicit.fitted import Fitted
from implicam.calibrators.explicit.lenses import USUAL_PIXELS, Choice
from implicam.calibrators.protocol import Arrays, finite_column
from implicam.dataset import Dataset, arrays_from_dataset, dataset_from_arrays
from implicam.dataset.unused import Rejected, Unused
from implicam.lenses import LENSES
from implicam.rig_model import (
    CameraModel,
    CentralCamera,
    Frame,
    Image,
    InitialCamera,
    Posterior,
    Prior,
    lens_only_model,
)

BOARDS = "boards/"


def state(fitted: Fitted, boards: Dataset | None) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """A readable table, and arrays: per camera lens and pose in the working frame, the roots of their covariance, and
    the boards they come from."""
    posterior, names = fitted.posterior, fitted.trained.camera_names
    table = {
        "calibrated": [names[c] for c in fitted.cameras],
        "lenses": [
            {"name": choice.lens, "held_out_px": dict(choice.held_out), "pixels": choice.pixels}
            for choice in fitted.choices
        ],
        "notes": list(fitted.notes),
        "alone": fitted.alone,
        **_of_the_paper(fitted),
        "rejected": [[view.point, view.camera, float(view.residual)] for view in fitted.rejected],
        "unused": [[one.point, one.reason] for one in fitted.unused],
    }
    arrays: dict[str, NDArray[Any]] = {
        "frame": fitted.frame.as_array(),
        "sizes": np.array([[m.noise, *m.image.centre, m.image.half] for m in posterior.models]),
        "errors": fitted.errors,
        "sds": fitted.sds,
    }
    for number, model in enumerate(posterior.models):
        assert isinstance(model.camera, CentralCamera)
        arrays[f"{number}/camera"] = model.camera.as_array()
        arrays[f"{number}/root"] = posterior.alone[number]
    if posterior.joint is not None:
        arrays["joint"] = posterior.joint
    if boards is not None:
        arrays |= {BOARDS + name: array for name, array in arrays_from_dataset(boards).items()}
    return table, arrays


def _of_the_paper(fitted: Fitted) -> dict[str, Any]:
    """What the paper's presets measure with, and how far off the corners are; what there is not is left out."""
    table: dict[str, Any] = {}
    if np.isfinite(fitted.reprojection):
        table["reprojection_px"] = fitted.reprojection
    if fitted.inflation is not None:
        table |= {"reference": fitted.reference, "inflation": fitted.inflation}
    return table


def _paper_from(table: Mapping[str, Any], cameras: int) -> tuple[int, float | None, float]:
    """The inverse of `_of_the_paper`."""
    reprojection = float(table.get("reprojection_px", "nan"))
    if "inflation" not in table:
        return 0, None, reprojection
    reference, inflation = int(table["reference"]), float(table["inflation"])
    if not 0 <= reference < cameras:
        raise ValueError(f"there is no camera number {reference} to triangulate with")
    if not 1 <= inflation < np.inf:
        raise ValueError("inflation must be one or more, and finite")
    return reference, inflation, reprojection


def restored(data: Dataset, table: Mapping[str, Any], arrays: Arrays) -> tuple[Fitted, Dataset | None]:
    """The inverse of `state`; KeyError, ValueError or TypeError for anything that does not fit."""
    own = {name.removeprefix(BOARDS): array for name, array in arrays.items() if name.startswith(BOARDS)}
    boards = dataset_from_arrays(own, Path("boards")) if own else None
    trained = _trained(data, boards)
    unknown = set(map(str, table["calibrated"])) - set(trained.camera_names)
    if unknown:
        raise ValueError(f"there is no camera {', '.join(sorted(unknown))}")
    cameras = tuple(trained.camera_names.index(str(name)) for name in table["calibrated"])
    if len(set(cameras)) != len(cameras) or len(cameras) < 2:
        raise ValueError("a rig has two calibrated cameras or more, each once")
    sizes = finite_column(arrays, "sizes", (len(cameras), 4))
    models, alone = [], []
    for number, choice in enumerate(table["lenses"]):
        model = _model(arrays, number, sizes[number], str(choice["name"]))
        models.append(model)
        q = len(arrays[f"{number}/root"])
        alone.append(finite_column(arrays, f"{number}/root", (q, model.size)))
    if len(models) != len(cameras):
        raise ValueError("lenses and calibrated cameras must be as many")
    joint = None
    if "joint" in arrays:
        joint = finite_column(arrays, "joint", (len(arrays["joint"]), sum(model.size for model in models)))
    m = len(arrays["errors"])
    fitted = Fitted(
        trained,
        Frame.from_array(finite_column(arrays, "frame", (4,))),
        cameras,
        Posterior(tuple(models), tuple(alone), joint, (), 0.0),
        tuple(
            Choice(
                str(one["name"]),
                {str(k): float(v) for k, v in one["held_out_px"].items()},
                str(one.get("pixels", USUAL_PIXELS)),
            )
            for one in table["lenses"]
        ),
        finite_column(arrays, "errors", (m, 3)),
        finite_column(arrays, "sds", (m, 3), positive=True),
        tuple(Rejected(str(point), str(camera), float(off)) for point, camera, off in table["rejected"]),
        tuple(Unused(str(point), str(reason)) for point, reason in table["unused"]),
        tuple(map(str, table["notes"])),
        bool(table["alone"]),
        *_paper_from(table, len(cameras)),
    )
    return fitted, boards


def _trained(data: Dataset, boards: Dataset | None) -> Any:
    if boards is None:
        return data.observations
    names = [name for name in data.observations.camera_names if name in boards.observations.camera_names]
    return boards.observations.with_cameras(names)


def _model(arrays: Arrays, number: int, sizes: NDArray[np.float64], lens: str) -> CameraModel:
    if lens not in LENSES:
        raise ValueError(f"camera {number} has a lens {lens!r}; this version knows {', '.join(LENSES)}")
    numbers = finite_column(arrays, f"{number}/camera", arrays[f"{number}/camera"].shape)
    camera = CentralCamera.from_array(numbers, LENSES[lens])
    if not camera.sane:
        raise ValueError(f"camera {number} is inside out")
    noise, *centre, half = sizes.tolist()
    if not (noise > 0 and half > 0):
        raise ValueError("noise and image size must be positive")
    prior = Prior(np.zeros(camera.size), np.zeros((camera.size, camera.size)))  # only a fit needs it
    started = InitialCamera(camera, prior, np.zeros(0, dtype=np.bool_))
    return lens_only_model(started, Image(np.array(centre), half), noise)
