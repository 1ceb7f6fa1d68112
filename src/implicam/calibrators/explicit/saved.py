"""What a calibration file carries of a classical calibration, and back: nothing is computed twice or trusted."""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.explicit.fitted import Fitted
from implicam.calibrators.explicit.lenses import USUAL_PIXELS, Choice
from implicam.calibrators.protocol import Arrays, finite_column
from implicam.dataset import Dataset, arrays_from_dataset, dataset_from_arrays
from implicam.dataset.unused import Rejected, Unused
from implicam.errors import PartError
from implicam.lenses import LENSES, Lens
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

OWN_PACKAGE = "implicam"

PACKAGE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,99}")
"""Of a package or its version; anything else in a file is not shown as one."""


def state(fitted: Fitted, boards: Dataset | None) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """A readable table, and arrays: per camera lens and pose in the working frame, the roots of their covariance, and
    the boards they come from.

    Args:
        fitted: The fit.
        boards: That it comes from; None for a fit to known points alone.

    Returns:
        Both, without the options.
    """
    posterior, names = fitted.posterior, fitted.trained.camera_names
    table = {
        "calibrated": [names[c] for c in fitted.cameras],
        "lenses": [
            {**_lens_table(model), "held_out_px": dict(choice.held_out), "pixels": choice.pixels}
            for choice, model in zip(fitted.choices, posterior.models, strict=True)
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
    """The inverse of `state`.

    Args:
        data: That the calibration was fitted to.
        table: Of `state`.
        arrays: Of `state`.

    Returns:
        The fit, and the boards it comes from, if any.

    Raises:
        KeyError, ValueError, TypeError: Something is missing or does not fit.
        PartError: A lens of another package is not installed, or cannot be used.
    """
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
    if len(table["lenses"]) != len(cameras):
        raise ValueError("lenses and calibrated cameras must be as many")
    for number, (c, choice) in enumerate(zip(cameras, table["lenses"], strict=True)):
        model = _model(arrays, number, sizes[number], _lens(choice, trained.camera_names[c]))
        models.append(model)
        q = len(arrays[f"{number}/root"])
        alone.append(finite_column(arrays, f"{number}/root", (q, model.size)))
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


def _lens_table(model: CameraModel) -> dict[str, Any]:
    """Of a camera's lens: its family, its parameters in their order, and the package that brings it."""
    assert isinstance(model.camera, CentralCamera)
    kind = type(model.camera.lens)
    package = LENSES.package_of(kind.family) if kind.family in LENSES else kind.__module__.partition(".")[0]
    table: dict[str, Any] = {"name": kind.family, "parameters": [field.name for field in fields(kind)]}
    table["package"] = package
    if package != OWN_PACKAGE:
        with suppress(PackageNotFoundError):
            table["package_version"] = version(package)
    return table


def _lens(table: Mapping[str, Any], camera: str) -> type[Lens]:
    """The family of a camera's lens, by what `_lens_table` wrote; files of earlier versions have the name alone.

    Raises:
        PartError: it is not installed, cannot be imported, or has other parameters now.
    """
    family, maker = str(table["name"]), ""
    package = table.get("package", "")
    if isinstance(package, str) and PACKAGE_NAME.fullmatch(package) and package != OWN_PACKAGE:
        maker = package
        if PACKAGE_NAME.fullmatch(str(table.get("package_version", "?"))):
            maker = f"{package} {table['package_version']}"
    whose = f"camera {camera!r} has a lens of the family {family!r}"
    if family not in LENSES:
        raise PartError(
            f"{whose}, which is not installed.",
            why=f"it was made with that of the package {maker}" if maker else f"there are {', '.join(LENSES)}",
            fix=f"install the package {maker}, as where the file was made"
            if maker
            else "install the package that brings it, as where the file was made; or pip install --upgrade implicam",
        )
    try:
        lens = LENSES[family]
    except PartError as error:
        raise PartError(f"{whose}, which cannot be used: {error.what}", why=error.why, fix=error.fix) from error
    now = [field.name for field in fields(lens)]
    if table.get("parameters", now) != now:
        raise PartError(
            f"{whose}, which has other parameters now: {', '.join(now)}.",
            why=f"the file has its numbers in the order {', '.join(map(str, table['parameters']))}",
            fix=f"install the package {maker or package or 'implicam'}, as where the file was made, or calibrate again",
        )
    return lens


def _model(arrays: Arrays, number: int, sizes: NDArray[np.float64], lens: type[Lens]) -> CameraModel:
    numbers = finite_column(arrays, f"{number}/camera", arrays[f"{number}/camera"].shape)
    camera = CentralCamera.from_array(numbers, lens)
    if not camera.sane:
        raise ValueError(f"camera {number} is inside out")
    noise, *centre, half = sizes.tolist()
    if not (noise > 0 and half > 0):
        raise ValueError("noise and image size must be positive")
    prior = Prior(np.zeros(camera.size), np.zeros((camera.size, camera.size)))  # only a fit needs it
    started = InitialCamera(camera, prior, np.zeros(0, dtype=np.bool_))
    return lens_only_model(started, Image(np.array(centre), half), noise)
