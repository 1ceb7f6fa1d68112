"""From photographs to observations: a ball, a board, dots.

run = detect_folder(Path("my-rig"), Ball())
run.data, run.cameras, run.reasons
"""

from implicam.detect.ball import Ball, Template
from implicam.detect.board import Board
from implicam.detect.charuco import Charuco
from implicam.detect.dots import Dots
from implicam.detect.folder import Correct, DetectionRun, detect_folder
from implicam.detect.model import Detected, Detector, View
from implicam.detect.silhouette import centred, outline_shift

TARGETS: dict[str, type[Ball] | type[Board] | type[Charuco] | type[Dots]] = {
    "ball": Ball,
    "board": Board,
    "charuco": Charuco,
    "dots": Dots,
}
"""Target -> its detector."""

__all__ = [
    "TARGETS",
    "Ball",
    "Board",
    "Charuco",
    "Correct",
    "Detected",
    "DetectionRun",
    "Detector",
    "Dots",
    "Template",
    "View",
    "centred",
    "detect_folder",
    "outline_shift",
]
