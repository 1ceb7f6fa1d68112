"""Write a calibration as an ONNX file, for ONNX Runtime in C++, C#, Java, JavaScript, Rust, MATLAB, ..."""

from __future__ import annotations

import json
from pathlib import Path

from implicam import calibration_file
from implicam.calibrators import Calibration
from implicam.calibrators.protocol import RigCalibration
from implicam.deploy.onnx_cameras import forward_graph
from implicam.deploy.onnx_inverse import MapsPixels, inverse_graph
from implicam.errors import UsageError
from implicam.files import replacing

INVERSE = (
    "From the pixels of all cameras to a position: inputs uv_NAME (n, 2) in pixels, outputs xyz (n, 3), covariance "
    "(n, 3, 3) and sd (n, 3). NaN where a view is missing, or where the pixels are unlike those learned from."
)
FORWARD = (
    "From a position to the pixels of each camera: input xyz (n, 3), outputs uv_NAME (n, 2) and covariance_NAME "
    "(n, 2, 2) of a view with the camera's usual noise. NaN where a camera has no answer."
)


def write_onnx(calibration: Calibration, path: str | Path, checksum: str = "") -> list[str]:
    """Write an ONNX file in float64, whole or not at all: nothing in it is approximated.

    Args:
        calibration: By `inverse-gp`, for the map from pixels to positions; by `forward-gp` or `explicit`, for that from
            positions to pixels.
        path: The file; it is replaced.
        checksum: The SHA-256 of the calibration file; of a calibration that is not a file it is found out.

    Returns:
        Notes, each a sentence on what the graph does not have.

    Raises:
        UsageError: The method has no such map.
        MissingExtraError: The package onnx is not installed.
        ImplicamError: The file cannot be written.
    """
    notes = []
    if isinstance(calibration, MapsPixels):
        graph, what = inverse_graph(calibration), INVERSE
        cameras, noise = calibration.used.observations.cameras, {}
    elif isinstance(calibration, RigCalibration):
        rig = calibration.map
        graph, what = forward_graph(rig), FORWARD
        cameras = tuple(rig.trained.cameras[c] for c in rig.cameras)
        noise = {name: model.noise for name, model in zip(rig.camera_names, rig.posterior.models, strict=True)}
        if not rig.posterior.errors_known:
            notes.append("Nothing is known of the errors of these cameras: each covariance is zero.")
        elif rig.posterior.tied:
            notes.append("The errors of the cameras depend on each other: each covariance is that of one camera alone.")
    else:
        raise UsageError(
            f"{calibration.method} cannot be written as an ONNX graph.",
            why="only inverse-gp, forward-gp and explicit can",
            fix="calibrate the same data with one of these",
        )
    data = calibration.data
    metadata = {
        "implicam_version": calibration_file.package_version(),
        "calibration_sha256": checksum or calibration_file.checksum(calibration),
        "method": calibration.method,
        "dataset": data.name,
        "length_unit": data.length_unit,
        "pixel_convention": calibration_file.PIXEL_CONVENTION,
        "cameras": json.dumps([camera.as_table() for camera in cameras]),
        "approximation": "none: float64, and every operation of the method",
        **({"noise_px": json.dumps(noise)} if noise else {}),
    }
    content = graph.model("implicam", metadata, what)
    with replacing(Path(path)) as temporary:
        temporary.write_bytes(content)
    return notes
