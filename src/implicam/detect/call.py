"""`implicam.detect(...)`: what `implicam detect` does, as one call."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from implicam.detect.film import detect_films, films_of
from implicam.detect.folder import DetectionRun, detect_folder
from implicam.detect.model import Detector
from implicam.detect.registry import detector_from_options
from implicam.errors import UsageError
from implicam.progress import Progress, silent


def detect(
    dataset: str | Path,
    target: str | Detector | None = None,
    *,
    unit: str | None = None,
    pictures: str | None = None,
    pattern: str | None = None,
    films: str | None = None,
    times: str | Path | None = None,
    offsets: str | None = None,
    every: int = 1,
    frames: int | None = None,
    overlays: bool = True,
    restart: bool = False,
    progress: Progress = silent,
    **options: Any,
) -> DetectionRun:
    """Find the target in the photographs, or the films, of a dataset folder, and write its observations.csv.

    ic.detect("my-photos", "ball", radius=8).data is the dataset with what was found.

    Args:
        dataset: The folder, with images/<camera>/<shot>.png or films <camera>.mp4.
        target: "ball", "board", ... or a detector; None for what dataset.toml says.
        unit: The length unit, where dataset.toml is missing.
        pictures: Where the pictures are in the folder.
        pattern: How their names tell camera and shot.
        films: Where the films are in the folder.
        times: Of films, a table camera, frame, time_s by one clock.
        offsets: Of films, seconds to add to times, as `given_clocks` reads them; None to find them from the movement.
        every: Of films, search every so many pictures.
        frames: Of films, keep so many instants that differ most.
        overlays: Whether to draw pictures to check by eye.
        restart: Forget what an earlier run found.
        progress: Told how far it is.
        **options: Of the target, as `implicam detect --target ... --help` lists them: `radius=8`.

    Raises:
        UsageError: Options do not go together.
        DatasetError: A file of the folder has a mistake.
        ImageError: There is nothing to look at, or nothing was found.
    """
    path = Path(dataset)
    must_be_dataset_folder(path)
    if target is None or isinstance(target, str):
        detector = detector_from_options(target, path, **options)
    elif options:
        raise UsageError(
            f"a detector has its options already, and {', '.join(options)} were given too.",
            fix="give them to the detector, or name the target",
        )
    else:
        detector = target
    found = films_of(path, films, pictures)
    if found:
        return detect_films(
            path, detector, found, unit=unit, times=None if times is None else Path(times), offsets=offsets,
            every=every, frames=frames, overlays=overlays, restart=restart, progress=progress,
        )  # fmt: skip
    if times or offsets is not None or every > 1 or frames:
        raise UsageError(
            f"there are no films in {path}, and --times, --offsets, --every and --frames are for films.",
            fix="put <camera>.mp4 into it, say where they are with --films, or leave these options out",
        )
    return detect_folder(
        path, detector, unit=unit, pictures=pictures, pattern=pattern, overlays=overlays, restart=restart,
        progress=progress,
    )  # fmt: skip


def must_be_dataset_folder(path: Path) -> None:
    """Refuse what is no folder.

    Args:
        path: What was given.

    Raises:
        UsageError: It is none.
    """
    if not path.is_dir():
        raise UsageError(
            f"{path} is not a folder.", fix="give the folder that holds images/<camera>/<shot>.png, or <camera>.mp4"
        )
