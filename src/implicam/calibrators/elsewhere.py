"""Fitting on a worker of a Dask cluster; what comes back is the calibration's file."""

from __future__ import annotations

import tempfile
from functools import lru_cache
from pathlib import Path

from implicam.calibrators.protocol import Calibration, Calibrator
from implicam.calibrators.registry import load_calibration
from implicam.dataset import Dataset
from implicam.workers import Task, compute_on_cluster


def fit_on_cluster(calibrator: Calibrator, data: Dataset, scheduler: str) -> Calibration:
    """Fit by a worker of a Dask cluster, whose cores are then busy and ours are not.

    Args:
        calibrator: The method.
        data: The known points.
        scheduler: The address of the scheduler, such as tcp://10.0.0.5:8786.

    Returns:
        The calibration, as it comes back from its file.

    Raises:
        ImplicamError: There is no such cluster, a worker has another version, or the fit failed there.
    """
    task = Task(f"{__name__}:file_of_fit", "calibrate", {"calibrator": calibrator, "data": data})
    ((_, content),) = compute_on_cluster(scheduler, [task])
    return calibration_of_bytes(content)


def file_of_fit(calibrator: Calibrator, data: Dataset) -> bytes:
    """What a worker does: the bytes of the calibration's file.

    Args:
        calibrator: The method.
        data: The known points.
    """
    return bytes_of_calibration(calibrator.fit(data))


def bytes_of_calibration(calibration: Calibration) -> bytes:
    """The bytes of the file of a calibration, to be sent to another process.

    Args:
        calibration: By any method.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "sent.implicam"
        calibration.save(path)
        return path.read_bytes()


@lru_cache(maxsize=2)
def calibration_of_bytes(content: bytes) -> Calibration:
    """The inverse of `bytes_of_calibration`; of the last two the same object, with the tables that it has made.

    Args:
        content: Of the file.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "sent.implicam"
        path.write_bytes(content)
        return load_calibration(path)
