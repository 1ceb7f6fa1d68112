"""A detector over all pictures of a dataset: observations.csv, and in detections/ all that it takes to check them.

    detections/journal.jsonl          what was found in each picture, kept as it comes (detect/journal.py)
    detections/summary.csv            a row per picture: how many points, and why not more
    detections/inferred.csv           where hidden points must be, if that was asked for; no observations
    detections/<camera>.jpg           all pictures of a camera on a sheet
    detections/overlays/<camera>/     each picture with what was found
    detections/written.toml           the SHA-256 of the observations.csv that detect wrote

What is wrong with one picture is a note, and the rest goes on. What a person wrote is never overwritten.
"""

from __future__ import annotations

import hashlib
import math
import os
import re
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from implicam.dataset import Camera, Dataset, KnownPositions, Observations, folder_files
from implicam.dataset.boards import check_size
from implicam.dataset.folder import DESCRIPTION, IMAGES, POINTS, VIEWS, csv_text, read_description, read_known
from implicam.dataset.model import check_name
from implicam.dataset.tables import parse_toml
from implicam.detect.journal import Entry, JournalResults, detect_all
from implicam.detect.model import Detector, LooksAgain, View, nothing
from implicam.detect.overlay import Result
from implicam.detect.sheets import draw_sheets
from implicam.errors import DatasetError, ImageError, UsageError, did_you_mean
from implicam.files import replacing, toml_text, write_text
from implicam.formatting import list_some
from implicam.images import Stored, one_thread_each, read_picture, stored_jpeg
from implicam.picture_names import find_pictures, in_order, sort_pictures
from implicam.progress import Progress, silent
from implicam.simulate.truth import limit_of_detection

DETECTIONS, JOURNAL_FILE, SUMMARY_FILE, WRITTEN_FILE = "detections", "journal.jsonl", "summary.csv", "written.toml"
INFERRED_FILE = "inferred.csv"
BACKUP_NAME = "observations.before-detect"

MAX_NAMES, MAX_NOTES = 5, 20
"""So many names in a sentence, then "and N more"; so many notes about pictures."""


Correct = Callable[[Dataset], tuple[Dataset, list[str]]]
"""Takes the observations, gives better ones and notes: the middle of a ball for that of its outline, say."""


class Count(NamedTuple):
    """How much was found in a camera's pictures: in how many of them anything, and how many points in all."""

    camera: str
    pictures: int
    found: int
    points: int


@dataclass(frozen=True, eq=False, repr=False)
class DetectionRun:
    """The result of `detect_folder`.

    data: the observations as written. cameras: a count each. reasons: why nothing, or not everything, was found, with
    the number of pictures, the commonest first; those that differ in numbers only count as one. notes: sentences for
    the person. resumed: pictures that an earlier run had searched. seconds_per_picture: how long one core took to read
    a picture and to search it, NaN where none was new. sheets: the pictures to check by eye.
    """

    observations: Path
    summary: Path
    data: Dataset
    results: tuple[Result, ...]
    cameras: tuple[Count, ...]
    reasons: tuple[tuple[str, int], ...]
    notes: tuple[str, ...]
    resumed: int
    seconds_per_picture: float
    sheets: tuple[Path, ...]

    def __repr__(self) -> str:
        """What was found, in a few lines; `notes` and `reasons` say more."""
        shown = [f"  {c.camera}: in {c.found} of {c.pictures} pictures" for c in self.cameras[:MAX_NAMES]]
        shown += [f"  ... and {len(self.cameras) - len(shown)} cameras more"] if len(self.cameras) > len(shown) else []
        views, notes = int(self.data.observations.seen.sum()), f"  {len(self.notes)} notes"
        return "\n".join([f"{views} views of {len(self.data)} points: {self.observations}", *shown, notes])


def detect_folder(
    dataset: Path,
    detector: Detector,
    *,
    unit: str | None = None,
    pictures: str | None = None,
    pattern: str | None = None,
    overlays: bool = True,
    restart: bool = False,
    correct: Correct | None = None,
    progress: Progress = silent,
) -> DetectionRun:
    """Look for a target in all pictures of a dataset folder, and write its observations.csv.

    A run that was stopped goes on where it was.

    Args:
        dataset: The folder. Without dataset.toml one is made.
        detector: What to look for.
        unit: The length unit of a dataset.toml that is made.
        pictures: The folder of the pictures, below `dataset`; None for `images`, or `dataset` where that is missing.
        pattern: How their names tell camera and shot, as `find_pictures` takes it; None for what `sort_pictures` reads.
        overlays: Whether to draw pictures to check by eye.
        restart: Forget what an earlier run found.
        correct: What is done to the observations before they are written, instead of `detector.correct`.
        progress: Told how far it is.

    Raises:
        UsageError: Options do not go together.
        DatasetError: Dataset.toml or points.csv is damaged.
        ImageError: There are no pictures, or nothing was found in any of them.
    """
    rig = _Rig.of(Path(dataset), unit, pictures, pattern).showing(detector.describe())
    with one_thread_each():
        journal = rig.path / DETECTIONS / JOURNAL_FILE
        looked = detect_all(rig.pictures, detector, journal, restart=restart, progress=progress)
        rig = rig.with_sizes(looked.sizes)
        results, notes = _settle(rig, detector, looked)
        data, more = _gather(rig, results)
        folder = rig.path / DETECTIONS
        write_text(folder / SUMMARY_FILE, summary_csv(results, rig.relative))
        more += _write_inferred(folder / INFERRED_FILE, results)
        if data is not None:
            data, said = (correct or detector.correct)(data)
            data, limit = limit_of_detection(rig.path, data)
            more += [*said, *write_observations(rig, data), *rig.explain_missing_size(), *filter(None, [limit])]
        sheets, undrawn = draw_sheets(folder, results, progress, redraw=restart) if overlays else ((), ())
    if data is None:
        raise _nothing_found_error(rig, results, sheets)
    return DetectionRun(
        rig.path / VIEWS,
        folder / SUMMARY_FILE,
        data,
        tuple(results),
        tuple(count_by_camera(results)),
        tuple(count_reasons(results)),
        (*rig.notes, *notes, *more, *undrawn),
        looked.resumed,
        looked.seconds,
        sheets,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class RigFolder:
    """A dataset folder before it has observations."""

    path: Path
    name: str
    unit: str
    cameras: tuple[Camera, ...]
    extra: Mapping[str, Any]
    known: tuple[list[str], KnownPositions] | None
    notes: tuple[str, ...]

    def with_sizes(self, sizes: Mapping[str, tuple[int, int]]) -> Self:
        """With the image sizes that dataset.toml does not state.

        Args:
            sizes: Camera -> width and height of most of its pictures.
        """
        cameras = []
        for camera in self.cameras:
            width, height = sizes.get(camera.name, (None, None))
            cameras.append(replace(camera, width=camera.width or width, height=camera.height or height))
        return replace(self, cameras=tuple(cameras))

    def showing(self, target: Mapping[str, Any]) -> Self:
        """With [target] of dataset.toml as the detector describes it; UsageError where a person wrote otherwise. What
        dataset.toml says of another kind of target stays.

        Args:
            target: Plain values; empty for nothing.
        """
        if not target:
            return self
        check_size(target, self.unit)
        said = self.extra.get("target", {})
        if not isinstance(said, Mapping) or said.get("kind", target["kind"]) != target["kind"]:
            note = f"[target] of {DESCRIPTION} is another one, so a calibration from boards does not know of this one."
            return replace(self, notes=(*self.notes, note))
        for key, value in target.items():
            if key in said and not _same(said[key], value):
                raise UsageError(
                    f"{self.path / DESCRIPTION} says of [target] {key} = {said[key]!r}, and detect was told {value!r}.",
                    why="a calibration from boards goes by dataset.toml",
                    fix="leave the option out, or correct the file",
                )
        return replace(self, extra={**self.extra, "target": {**target, **said}})

    def explain_missing_size(self) -> list[str]:
        """A note where dataset.toml has a board of unknown size."""
        target = self.extra.get("target")
        if not isinstance(target, Mapping) or target.get("kind") != "board" or "square" in target:
            return []
        return [
            "the edge of a square is not known, and a calibration from boards needs it: give --square, in "
            f"{self.unit}, or write square = ... below [target] in {DESCRIPTION}."
        ]

    def relative(self, path: Path) -> str:
        """A file's name as a note gives it.

        Args:
            path: The file.
        """
        return Path(os.path.relpath(path, self.path)).as_posix()

    def expected(self, view: View) -> int | None:
        """How many known points belong to the shot; None where that is not known.

        Args:
            view: A picture of the shot.
        """
        if self.known is None:
            return None
        return int(np.count_nonzero(self.known[1].shots == view.shot)) or None


@dataclass(frozen=True, eq=False, kw_only=True)
class _Rig(RigFolder):
    """With its pictures by camera and shot."""

    pictures: Mapping[View, Path]

    @classmethod
    def of(cls, path: Path, unit: str | None, pictures: str | None, pattern: str | None) -> Self:
        described = read_description(path) if (path / DESCRIPTION).exists() else None
        known = [camera.name for camera in described[2]] if described else []
        found, read = pictures_of(path, pictures, pattern, known)
        name, said, cameras, extra = describe_rig(path, unit, list(found))
        usable, notes = _choose_usable({camera.name for camera in cameras}, found, path)
        return cls(
            path=path, name=name, unit=said, cameras=cameras, extra=extra, known=read_known(path), pictures=usable,
            notes=(*read, *notes, *note_turned(usable)),
        )  # fmt: skip


def _same(said: Any, told: Any) -> bool:
    """Whether two entries of [target] mean the same; lengths may be rounded."""
    if isinstance(said, int | float) and isinstance(told, int | float):
        return math.isclose(said, told, rel_tol=1e-6)
    return bool(said == told)


def pictures_of(
    path: Path, pictures: str | None, pattern: str | None, cameras: Sequence[str]
) -> tuple[Mapping[str, Mapping[str, Path]], tuple[str, ...]]:
    """Find the pictures of a dataset.

    Args:
        path: The dataset's folder.
        pictures: The folder of the pictures, below it; None for `images`, or the dataset where that is missing.
        pattern: How their names tell camera and shot, as `find_pictures` takes it; None for what `sort_pictures` reads.
        cameras: Names of cameras that are known.

    Returns:
        {camera: {shot: file}}, and what there is to say about how they were found.

    Raises:
        UsageError: The pattern is none.
        ImageError: There are no pictures.
    """
    folder = path / (pictures or IMAGES)
    if pictures is None and not folder.is_dir() and path.is_dir():
        folder = path
    if pattern is not None:
        return find_pictures(folder, pattern, cameras), ()
    return sort_pictures(folder, cameras, ignored=(DETECTIONS, IMAGES))


def describe_rig(
    path: Path, unit: str | None, found: Sequence[str]
) -> tuple[str, str, tuple[Camera, ...], dict[str, Any]]:
    """What dataset.toml says, or would say where there is none.

    Args:
        path: The folder.
        unit: The length unit that was given.
        found: The cameras of which there are pictures.

    Returns:
        Name, length unit, cameras and further entries.

    Raises:
        UsageError: The unit is not known, or not that of the file.
        DatasetError: The file has a mistake.
    """
    if (path / DESCRIPTION).exists():
        described = read_description(path)
        if unit not in (None, described[1]):
            raise UsageError(
                f"{path / DESCRIPTION} is in {described[1]!r}, not in {unit!r}.",
                fix="leave out --unit, or correct the file",
            )
        return described
    if unit is None:
        raise UsageError(
            f"{path} has no {DESCRIPTION}, so the length unit is not known.",
            why=f"one is made from the cameras' pictures, {list_some(found)}, but no picture says the unit",
            fix="add --unit mm (or another), or write dataset.toml yourself; see docs/formats.md",
        )
    return path.resolve().name, unit, tuple(Camera(name) for name in found), {}


def _choose_usable(
    cameras: set[str], found: Mapping[str, Mapping[str, Path]], path: Path
) -> tuple[dict[View, Path], list[str]]:
    """The pictures of the rig's cameras with usable names, and what there is to say about the others."""
    notes = [
        f"the {len(shots)} pictures of {camera!r} are left out: {DESCRIPTION} has no such camera"
        f"{did_you_mean(camera, cameras)}."
        for camera, shots in found.items()
        if camera not in cameras
    ]
    usable = {}
    for camera in (camera for camera in found if camera in cameras):
        for shot, file in found[camera].items():
            try:
                check_name(shot, "shot")
                usable[View(camera, shot)] = file
            except DatasetError as error:
                notes.append(f"{str(file)!r} is left out: {error.what} {error.why[:1].upper()}{error.why[1:]}.")
    if not usable:
        raise ImageError(
            f"none of the pictures in {path} belongs to a camera of {DESCRIPTION}.",
            why=f"there are pictures of {list_some(list(found))}, and the cameras are {list_some(sorted(cameras))}",
            fix=f"give the folders the cameras' names, or correct {DESCRIPTION}",
        )
    return usable, notes + _note_missing(cameras, usable)


def note_turned(pictures: Mapping[View, Path]) -> list[str]:
    """What EXIF tags say that pictures are to be shown turned, which is not done here: a sentence for each camera.

    Args:
        pictures: The file of each view.
    """
    found: dict[str, Counter[Stored]] = {}
    for view, path in pictures.items():
        stored = stored_jpeg(path) if path.suffix.lower() in (".jpg", ".jpeg") else None
        if stored is not None:
            found.setdefault(view.camera, Counter())[stored] += 1
    notes = []
    for camera, kinds in found.items():
        if all(stored.orientation == 1 for stored in kinds):
            continue
        told = [
            f"{n} as {stored.orientation} ({' x '.join(map(str, stored.size))} stored, "
            f"{' x '.join(map(str, stored.shown))} shown)"
            for stored, n in kinds.items()
        ]
        several = len({stored.orientation for stored in kinds}) > 1
        notes.append(
            f"camera {camera!r}: EXIF says that pictures are to be shown turned: {list_some(told)}. They are read as "
            "they are stored, as the sensor saw them; pixels from viewers, or from cv2.imread, are of turned pictures"
            + ("; and the camera was turned between its pictures, or its tag slipped." if several else ".")
        )
    return notes


def _note_missing(cameras: Iterable[str], usable: Iterable[View]) -> list[str]:
    """Which cameras, and which shots of a camera, have no picture."""
    shots: dict[str, set[str]] = {camera: set() for camera in cameras}
    for view in usable:
        shots[view.camera].add(view.shot)
    every = set.union(*shots.values())
    notes = []
    for camera in in_order(shots):
        lacking = in_order(list(every - shots[camera]))
        if lacking == in_order(list(every)):
            notes.append(f"camera {camera!r} has no picture.")
        elif lacking:
            plural = "s" if len(lacking) > 1 else ""
            own = {shot.lstrip("0"): shot for shot in shots[camera] if shot.isdecimal()}
            alike = next(
                ((own[shot.lstrip("0")], shot) for shot in lacking if shot.isdecimal() and shot.lstrip("0") in own),
                None,
            )
            cure = f" It has {alike[0]!r}: rename that to {alike[1]!r} where the two are one instant." if alike else ""
            notes.append(
                f"camera {camera!r} has no picture of the shot{plural} {list_some(lacking)}, which others have.{cure}"
            )
    return notes


def _settle(rig: _Rig, detector: Detector, looked: JournalResults) -> tuple[list[Result], list[str]]:
    """The results in the order of the pictures, after the detector's second look; and a note per unusable picture."""
    problems = dict(looked.problems)
    cameras = {camera.name: camera for camera in rig.cameras}
    for view, entry in looked.entries.items():
        reason = _explain_wrong_size(cameras[view.camera], entry)
        if reason:
            problems[view] = reason
    found = {
        view: looked.entries[view].found for view in rig.pictures if view in looked.entries and view not in problems
    }
    settled = detector.settle(found)
    if isinstance(detector, LooksAgain):
        settled = detector.look_again(
            settled, lambda views: ((view, read_picture(rig.pictures[view])) for view in views)
        )
    results = [
        Result(view, path, nothing(problems[view]) if view in problems else settled[view], rig.expected(view))
        for view, path in rig.pictures.items()
    ]
    return results, _note_problems(rig, problems)


def _note_problems(rig: _Rig, problems: Mapping[View, str]) -> list[str]:
    """A note for every problem, with the files that have it."""
    files: dict[str, list[str]] = {}
    for view, path in rig.pictures.items():
        if view in problems:
            files.setdefault(problems[view], []).append(rig.relative(path))
    notes = [f"{list_some(names)}: {problem}." for problem, names in files.items()]
    if len(notes) <= MAX_NOTES:
        return notes
    more = len(notes) - MAX_NOTES
    return [*notes[:MAX_NOTES], f"{more} more such problems are named in {DETECTIONS}/{SUMMARY_FILE}."]


def _explain_wrong_size(camera: Camera, entry: Entry) -> str:
    if camera.width in (None, entry.width) and camera.height in (None, entry.height):
        return ""
    turned = (camera.height, camera.width) == (entry.width, entry.height)
    return (
        f"its size is {entry.width} x {entry.height}, but camera {camera.name!r} has {camera.width} x {camera.height}"
        f"{'; it may be rotated by a quarter turn' if turned else ''}"
    )


def _gather(rig: _Rig, results: Sequence[Result]) -> tuple[Dataset | None, list[str]]:
    """All that was found as a dataset, None where that is nothing; and notes about points that are left out."""
    names = rig.known[0] if rig.known else list(_order_names(results))
    rows = {name: i for i, name in enumerate(names)}
    columns = {camera.name: k for k, camera in enumerate(rig.cameras)}
    uv = np.full((len(rows), len(columns), 2), np.nan)
    sd = uv.copy()
    unknown: dict[str, None] = {}
    twice: dict[str, None] = {}
    for result in results:
        k = columns[result.view.camera]
        for j, name in enumerate(result.found.points):
            i = rows.get(name)
            if i is None:
                unknown[name] = None
            elif not np.isnan(uv[i, k, 0]):
                twice[f"{name!r} ({result.view.camera}, {result.view.shot})"] = None
            else:
                uv[i, k], sd[i, k] = result.found.uv[j], result.found.sd[j]
    notes = []
    if unknown:
        hints = [f"{name!r}{did_you_mean(name, rows)}" for name in list(unknown)[:MAX_NAMES]]
        named = list_some(hints, total=len(unknown))
        notes.append(f"points without a known position in points.csv are left out: {named}.")
    if twice:
        notes.append(
            f"found again by the same camera in another shot, where the first counts: {list_some(list(twice))}. "
            "A point that moves needs a name in each shot."
        )
    if np.isnan(uv).all():
        return None, notes
    observations = Observations(np.array(names, dtype=np.str_), rig.cameras, uv, sd)
    return Dataset(rig.name, rig.unit, observations, rig.known[1] if rig.known else None, rig.extra), notes


def _order_names(results: Iterable[Result]) -> dict[str, None]:
    """The points found, shot by shot, within a shot as people count."""
    shots: dict[str, dict[str, None]] = {}
    for result in results:
        shots.setdefault(result.view.shot, {}).update(dict.fromkeys(result.found.points))
    return dict.fromkeys(name for shot in in_order(shots) for name in in_order(shots[shot]))


def write_observations(rig: RigFolder, data: Dataset) -> list[str]:
    """Write observations.csv, and dataset.toml where there is none; what a person wrote is kept beside it.

    Args:
        rig: The folder of the dataset.
        data: What was found.

    Returns:
        Notes.

    Raises:
        ImplicamError: A file cannot be written.
    """
    files = folder_files(data)
    notes = _write_description(rig, files[DESCRIPTION])
    target, record = rig.path / VIEWS, rig.path / DETECTIONS / WRITTEN_FILE
    new, old = _sha256(files[VIEWS].encode()), _sha256(target.read_bytes()) if target.exists() else ""
    ours = [old] if old in (*_read_own_sums(record), new) else []
    if old and not ours:
        kept = _keep_copy(target)
        notes.append(f"the {VIEWS} that was there is kept as {kept.name}: detect had not written it.")
    # Both sums first: after a kill between the two, the next run still recognises its own file.
    write_text(record, toml_text({"observations_sha256": [*ours, new]}))
    write_text(target, files[VIEWS])
    if data.truth is not None:  # nobody but `simulate` writes this, and the limit is that of the views
        write_text(rig.path / POINTS, files[POINTS])
    return notes


def _write_description(rig: RigFolder, whole: str) -> list[str]:
    """Write dataset.toml where there is none; where there is one, add what it does not say of the target."""
    path = rig.path / DESCRIPTION
    if not path.exists():
        write_text(path, whole)
        return []
    text = path.read_text(encoding="utf-8")
    was, wanted = parse_toml(text).get("target"), rig.extra.get("target")
    if was == wanted or not isinstance(wanted, Mapping):
        return []
    lines = toml_text({key: value for key, value in wanted.items() if not isinstance(was, Mapping) or key not in was})
    if was is None:
        text = f"{text.rstrip()}\n\n[target]\n{lines}"
    else:
        text = re.sub(r"(?m)^\s*\[\s*target\s*\].*$\n?", lambda match: f"{match[0].rstrip()}\n{lines}", text, count=1)
    if _target_of(text) != wanted:
        return [f"{DESCRIPTION} does not say all of the target: write [target] with {lines.strip()!r}."]
    write_text(path, text)
    return [f"[target] in {DESCRIPTION} now says what was looked for."]


def _target_of(text: str) -> Any:
    try:
        return parse_toml(text).get("target")
    except ValueError:
        return None


def _read_own_sums(record: Path) -> list[str]:
    """The SHA-256 of what detect wrote before."""
    try:
        sums = parse_toml(record.read_text(encoding="utf-8")).get("observations_sha256", [])
    except (OSError, ValueError):
        return []
    return list(map(str, sums)) if isinstance(sums, list) else []


def _keep_copy(target: Path) -> Path:
    """A copy under the first name that is free."""
    free = (target.with_name(f"{BACKUP_NAME}{f'-{n}' if n > 1 else ''}.csv") for n in range(1, 1 << 31))
    kept = next(path for path in free if not path.exists())
    with replacing(kept) as temporary:
        shutil.copyfile(target, temporary)
    return kept


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def summary_csv(results: Iterable[Result], relative: Callable[[Path], str]) -> str:
    """A row per picture: how many points, and why not more.

    Args:
        results: One for each picture.
        relative: The name of a file as the table gives it.
    """
    rows = [
        (r.view.camera, r.view.shot, relative(r.path), str(len(r.found)), str(r.expected or ""), r.found.reason)
        for r in results
    ]
    return csv_text(("camera", "shot", "file", "found", "expected", "reason"), rows)


def _write_inferred(path: Path, results: Iterable[Result]) -> list[str]:
    """Write what was inferred, and say so; a file of an earlier run goes where nothing was."""
    rows = []
    for result in results:
        found = result.found.inferred
        for name, uv, covariance in zip(found.points, found.uv, found.covariance, strict=True):
            sd = np.sqrt(np.diag(covariance))
            numbers = [*uv, *sd, covariance[0, 1] / sd.prod()]
            rows.append((name, result.view.camera, *(f"{number:.6g}" for number in numbers)))
    if not rows:
        path.unlink(missing_ok=True)
        return []
    write_text(path, csv_text(("point", "camera", "u", "v", "sd_u", "sd_v", "correlation"), rows))
    return [
        f"{len(rows)} hidden points were inferred from those seen: {DETECTIONS}/{path.name}, not {VIEWS}, for they say "
        "nothing new to a calibration."
    ]


def count_by_camera(results: Sequence[Result]) -> Iterator[Count]:
    """How much was found, camera by camera.

    Args:
        results: One for each picture.
    """
    for camera in dict.fromkeys(result.view.camera for result in results):
        points = [len(result.found) for result in results if result.view.camera == camera]
        yield Count(camera, len(points), sum(n > 0 for n in points), sum(points))


def count_reasons(results: Iterable[Result]) -> list[tuple[str, int]]:
    """Reasons and how many pictures have them; those that differ in numbers only are one, told as the commonest.

    Args:
        results: One for each picture.
    """
    kinds: dict[str, Counter[str]] = {}
    for result in results:
        if result.found.reason:
            kinds.setdefault(re.sub(r"\d+", "0", result.found.reason), Counter())[result.found.reason] += 1
    told = [(texts.most_common(1)[0][0], texts.total()) for texts in kinds.values()]
    return sorted(told, key=lambda item: -item[1])


def _nothing_found_error(rig: _Rig, results: Sequence[Result], sheets: Sequence[Path]) -> ImageError:
    found = list(_order_names(results))
    look = f"look at {sheets[0]}, and check" if sheets else "check"
    if found:
        return ImageError(
            f"none of the {len(found)} points found in the pictures of {rig.path} has a known position.",
            why=f"points.csv names {list_some(rig.known[0] if rig.known else [])}, and found were {list_some(found)}",
            fix="give pictures and points the same names, or move points.csv away to measure unknown points",
        )
    reasons = "; ".join(f"{count} x {text}" for text, count in count_reasons(results)[:3])
    return ImageError(
        f"nothing was found in any of the {len(results)} pictures of {rig.path}, so {VIEWS} is not written.",
        why=reasons or "the detector gave no reason",
        fix=f"{look} the kind of target and its options",
    )
