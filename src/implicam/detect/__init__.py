"""From photographs to observations: a ball, a board, dots, a wand.

run = detect_folder(Path("my-rig"), Ball())
run.data, run.cameras, run.reasons

The module can be called: `ic.detect("my-photos", "ball", radius=8)` (`call.detect`).
"""

from implicam.callable_module import make_callable
from implicam.detect import call
from implicam.detect.aprilgrid import AprilGrid
from implicam.detect.ball import Ball, Template
from implicam.detect.board import Board
from implicam.detect.charuco import Charuco
from implicam.detect.dotgrid import DotGrid
from implicam.detect.dots import Dots
from implicam.detect.film import detect_films, films_of
from implicam.detect.folder import Correct, DetectionRun, detect_folder
from implicam.detect.model import Detected, Detector, DetectorBase, View
from implicam.detect.registry import ALSO_CALLED, TARGETS, detector_from_options, options_of
from implicam.detect.silhouette import correct_outlines, predict_outline_shift
from implicam.detect.wand import WandMarkers
from implicam.registry import Option

__all__ = [
    "ALSO_CALLED",
    "TARGETS",
    "AprilGrid",
    "Ball",
    "Board",
    "Charuco",
    "Correct",
    "Detected",
    "DetectionRun",
    "Detector",
    "DetectorBase",
    "DotGrid",
    "Dots",
    "Option",
    "Template",
    "View",
    "WandMarkers",
    "correct_outlines",
    "detect_films",
    "detect_folder",
    "detector_from_options",
    "films_of",
    "options_of",
    "predict_outline_shift",
]

make_callable(__name__, call.detect)
