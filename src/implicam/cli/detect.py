"""`implicam detect`: which detector, from the options and from what dataset.toml says of the target."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from implicam.calibrators import PredictsPixels, load_calibration
from implicam.cli import show
from implicam.dataset import Dataset
from implicam.dataset.folder import DESCRIPTION, POINTS, read_description
from implicam.detect import TARGETS, Ball, Board, Charuco, Correct, DetectionRun, Detector, Dots, Template, centred
from implicam.errors import UsageError, did_you_mean

LABELS = "labels.csv"


@dataclass(frozen=True)
class Wanted:
    """The options of `implicam detect` that choose and tune a detector, as far as they were given."""

    target: str | None = None
    radius: float | None = None
    bright: bool = False
    template: Path | None = None
    click: str | None = None
    board: str | None = None
    square: float | None = None
    marker: float | None = None
    dictionary: str | None = None
    layout: Path | None = None
    labels: Path | None = None
    calibration: Path | None = None

    def detector(self, dataset: Path) -> tuple[Detector, Correct | None]:
        """The detector, and what is done to its observations."""
        said = _said(dataset)
        target = self.target or str(said.get("kind", ""))
        if target not in TARGETS:
            raise UsageError(
                f"there is no target {target!r}{did_you_mean(target, TARGETS)}." if target else "which target is it?",
                why="" if target else f"neither --target nor {dataset / DESCRIPTION} says so",
                fix=f"--target {'|'.join(TARGETS)}",
            )
        return getattr(self, f"_{target}")(dataset, said if said.get("kind") == target else {})  # type: ignore[no-any-return]

    def _ball(self, dataset: Path, said: dict[str, Any]) -> tuple[Detector, Correct | None]:
        if self.template and self.click:
            raise UsageError("--template and --click exclude each other.", fix="give one of them")
        template = Template.from_file(self.template) if self.template else _clicked(self.click)
        radius = self.radius if self.radius is not None else said.get("radius")
        calibration = None
        if self.calibration is not None:
            loaded = load_calibration(self.calibration)
            if not isinstance(loaded, PredictsPixels):
                raise UsageError(
                    f"{self.calibration} was made by {loaded.method}.",
                    why="that method does not know what a camera sees of a place",
                    fix="give a calibration by forward-gp or explicit",
                )
            calibration = loaded
        correct = partial(centred, radius=float(radius), calibration=calibration) if radius else _no_radius
        return Ball(bright=self.bright, template=template), correct

    def _board(self, dataset: Path, said: dict[str, Any]) -> tuple[Detector, None]:
        rows, columns = _by(self.board, said, "--board 8x11 (inner corners, rows x columns)")
        return Board(rows, columns, self.square or float(said.get("square", 1.0))), None

    def _charuco(self, dataset: Path, said: dict[str, Any]) -> tuple[Detector, None]:
        rows, columns = _by(self.board, said, "--board 9x12 (squares, rows x columns)")
        square, marker = self.square or said.get("square"), self.marker or said.get("marker")
        if not square or not marker:
            raise UsageError(
                "a ChArUco board needs --square and --marker.", fix="measure both edges on the printed board, in mm"
            )
        dictionary = self.dictionary or str(said.get("dictionary", "DICT_5X5_100"))
        return Charuco(rows, columns, float(square), float(marker), dictionary), None

    def _dots(self, dataset: Path, said: dict[str, Any]) -> tuple[Detector, None]:
        layout, labels = self.layout or dataset / POINTS, self.labels or dataset / LABELS
        if not labels.exists():
            raise UsageError(
                f"{labels} does not exist.",
                why="six or more dots of each camera must be named by a person",
                fix=f"write {labels}: point,camera,u,v, a row for each labelled dot; a pixel or two off will do",
            )
        return Dots.from_files(layout, labels), None


def tell(run: DetectionRun, json: bool) -> None:
    """What was found, where, and why not."""
    if json:
        show.emit_json(
            {"observations": str(run.observations), "summary": str(run.summary),
             "cameras": [count._asdict() for count in run.cameras], "reasons": [list(pair) for pair in run.reasons],
             "notes": list(run.notes), "resumed": run.resumed, "seconds_per_picture": run.seconds_per_picture,
             "sheets": [str(path) for path in run.sheets]}
        )  # fmt: skip
        return
    points = sum(count.points for count in run.cameras)
    show.table(show.detection_table(run))
    show.line(f"{run.observations}: {points} views of {len(run.data)} points in {len(run.cameras)} cameras")
    if run.sheets:
        show.line(f"look at {run.sheets[0]}{f' and {len(run.sheets) - 1} more' if len(run.sheets) > 1 else ''}")
    named = "\n".join(run.notes)  # these name their files, and say the reason too
    show.notes([f"{times} picture{'s' * (times != 1)}: {why}" for why, times in run.reasons if why not in named])
    for text in run.notes:
        show.note(text)


def _said(dataset: Path) -> dict[str, Any]:
    """The table [target] of dataset.toml."""
    if not (dataset / DESCRIPTION).exists():
        return {}
    said = read_description(dataset)[3].get("target", {})
    return said if isinstance(said, dict) else {}


def _by(text: str | None, said: dict[str, Any], example: str) -> tuple[int, int]:
    if text is None:
        rows, columns = said.get("rows"), said.get("columns")
    else:
        rows, _, columns = text.lower().partition("x")
    try:
        return int(rows), int(columns)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise UsageError(
            "the size of the board is not known." if text is None else f"--board {text!r} is not a size.", fix=example
        ) from None


def _clicked(text: str | None) -> Template | None:
    if text is None:
        return None
    try:
        name, _, place = text.rpartition(":")
        u, v = (float(part) for part in place.split(","))
    except ValueError:
        raise UsageError(
            f"--click {text!r} is not a place in a picture.", fix="for example images/cam1/001.png:613,402"
        ) from None
    return Template.from_click(Path(name), u, v)


def _no_radius(data: Dataset) -> tuple[Dataset, list[str]]:
    return data, [
        "the pixels are those of the ball's outline, whose middle is not quite that of the ball: "
        f"give its radius with --radius, in {data.length_unit}, and it is corrected"
    ]
