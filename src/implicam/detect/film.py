"""A detector over the films of a dataset: observations at common times, whatever the cameras' clocks and rates.

Every picture is searched; what was found is a track of each point in each camera. Clocks come from a table of times,
from offsets that are given, or from the movement of the target. Then each picture of the slowest camera (or each time
of points.csv) is an instant, and the other cameras say by interpolation what they would have seen then.

    detections/frames/<camera>/<number>.png    some of the pictures, those that the overlays show
    detections/clocks.csv                      each camera's clock, with its uncertainty
    detections/stills/<camera>/<shot>.png      of a target that does not move, the sharpest picture of each film

The rest is as in detect/folder.py.
"""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Dataset, Floats, KnownPositions, Observations
from implicam.dataset.folder import DESCRIPTION, IMAGES, POINTS, csv_text, read_description, read_known
from implicam.detect.clocks import Clock, clocks_from_target, given_clocks, read_times
from implicam.detect.folder import (
    DETECTIONS,
    JOURNAL_FILE,
    SUMMARY_FILE,
    Correct,
    DetectionRun,
    RigFolder,
    count_by_camera,
    count_reasons,
    describe_rig,
    detect_folder,
    summary_csv,
    write_observations,
)
from implicam.detect.journal import Entry, Journal, Key, digest, find_entry, join_lines, look_at
from implicam.detect.model import Detected, Detector, LooksAgain, View, nothing
from implicam.detect.overlay import Result
from implicam.detect.sheets import draw_sheets
from implicam.detect.tracks import Track
from implicam.errors import DatasetError, ImageError, UsageError
from implicam.files import write_text
from implicam.films import FILM_ENDINGS, Film, FilmPicture, find_films
from implicam.formatting import list_some
from implicam.images import Grey, one_thread_each, opencv, write_picture
from implicam.picture_names import has_pictures
from implicam.progress import Progress, silent
from implicam.threads import cores, side_by_side

FILMS, FRAMES, CLOCKS_FILE = "films", "frames", "clocks.csv"
STILLS = "stills"
TIME_COLUMN = "time_s"
"""Of points.csv: when each known point was shown; of observations.csv: when each point was seen."""

STILL_PX = 2.0
"""A target that stays within so many pixels from picture to picture rests."""

REPEATED_SDS = 8.0
"""A target that moves by so many standard deviations from a picture to the next cannot be seen at the same place."""

MAX_DRAWN = 36
"""Pictures of a camera that are drawn."""

BOARD_INSTANTS, WANTED_POINTS = 60, 800
"""Instants that are kept of a target with several points, unless another number is asked for: the first, or, of a wand
with its few, as many as give so many points."""

MIN_DIFFERENCE_PX = 5.0
"""Instants that differ by less, on average over the points, are nearly equal."""

MAX_SD_RATIO = 3.0
"""Instants whose pixels are so many times less certain than usual are not chosen where there are others."""


class _Searched(NamedTuple):
    """What was found in the pictures of a camera's film. numbers: (n,) of those searched. times: of all pictures."""

    film: Film
    numbers: NDArray[np.int_]
    times: Floats
    found: dict[View, Detected]
    notes: list[str]
    resumed: int
    seconds: list[float]


def detect_films(
    dataset: Path,
    detector: Detector,
    films: Mapping[str, Path],
    *,
    unit: str | None = None,
    times: Path | None = None,
    offsets: str | None = None,
    every: int = 1,
    frames: int | None = None,
    overlays: bool = True,
    restart: bool = False,
    correct: Correct | None = None,
    progress: Progress = silent,
) -> DetectionRun:
    """Look for a target in films, one a camera, and write the dataset's observations.csv.

    A run that was stopped goes on where it was.

    Args:
        dataset: The folder. Without dataset.toml one is made.
        detector: What to look for.
        films: Camera -> its film.
        unit: The length unit of a dataset.toml that is made.
        times: A table camera, frame, time_s, by one clock; None for the times in the films.
        offsets: Seconds to add to the times in the films, as `given_clocks` reads them; None to find them from the
            movement of the target.
        every: Search every so many pictures.
        frames: Keep so many instants, those that differ most; None for all of a single point, and of a target with
            several for `BOARD_INSTANTS`, or more where they are few.
        overlays: Whether to draw pictures to check by eye.
        restart: Forget what an earlier run found.
        correct: What is done to the observations before they are written, instead of `detector.correct`.
        progress: Told how far it is.

    Raises:
        UsageError: Options do not go together.
        DatasetError: Dataset.toml, points.csv or the table of times is damaged.
        OffsetError: The cameras' clocks cannot be told.
        ImageError: A film cannot be read, or nothing was found in any of them.
    """
    if times is not None and offsets is not None:
        raise UsageError("--times and --offsets exclude each other.", fix="give one of them")
    path = Path(dataset)
    if not detector.moves:
        shown = _sharpest(path / DETECTIONS / STILLS, films, read_known(path), progress)
        return detect_folder(
            path, detector, unit=unit, pictures=str(shown.relative_to(path)), overlays=overlays, restart=restart,
            correct=correct, progress=progress,
        )  # fmt: skip
    rig = _FilmRig.of(path, unit, films).showing(detector.describe())
    folder = path / DETECTIONS
    with one_thread_each(), Journal(folder / JOURNAL_FILE, restart=restart) as journal:
        searched = _search_all(rig, detector, journal, every, times, progress)
        rig = rig.with_film_sizes()
        found, notes = _settle(rig, detector, searched)
        write_text(folder / SUMMARY_FILE, summary_csv(found, rig.relative))
        tracks, said = _tracks(rig, searched, found)
        if not tracks:
            sheets = _draw(rig, folder, searched, found, {}, overlays, restart, progress)[0]
            raise _nothing_found(path, found, sheets)
        clocks, more = _clocks(tracks, rig, times, offsets, progress)
        write_text(folder / CLOCKS_FILE, _clocks_csv(clocks))
        instants = _instants(rig, tracks, clocks)
        data, chosen = _observe(rig, tracks, clocks, instants, frames)
        data, corrected = (correct or detector.correct)(data)
        written = [*write_observations(rig, data), *rig.explain_missing_size()]
        sheets, undrawn = _draw(rig, folder, searched, found, chosen, overlays, restart, progress)
    spent = [second for one in searched.values() for second in one.seconds]
    return DetectionRun(
        path / "observations.csv", folder / SUMMARY_FILE, data, tuple(found), tuple(count_by_camera(found)),
        tuple(count_reasons(found)), (*rig.notes, *notes, *said, *more, *corrected, *written, *undrawn),
        sum(one.resumed for one in searched.values()), float(np.mean(spent)) if spent else math.nan, sheets,
    )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class _FilmRig(RigFolder):
    """A dataset folder before it has observations, and its films."""

    films: Mapping[str, Film]

    @classmethod
    def of(cls, path: Path, unit: str | None, films: Mapping[str, Path]) -> Self:
        name, said, cameras, extra = describe_rig(path, unit, list(films))
        own = {camera.name for camera in cameras}
        notes = [
            f"the film of {name!r} is left out: {DESCRIPTION} has no such camera." for name in films if name not in own
        ]
        notes += [f"camera {name!r} has no film." for name in (c.name for c in cameras) if name not in films]
        used = {name: Film.of(file) for name, file in films.items() if name in own}
        if not used:
            raise ImageError(
                f"none of the films in {path} belongs to a camera of {DESCRIPTION}.",
                why=f"there are films of {list_some(list(films))}, and the cameras are {list_some(sorted(own))}",
                fix=f"give the films the cameras' names, or correct {DESCRIPTION}",
            )
        return cls(
            path=path, name=name, unit=said, cameras=cameras, extra=extra, known=read_known(path), films=used,
            notes=tuple(notes),
        )  # fmt: skip

    def with_film_sizes(self) -> Self:
        """With the size of the films; ImageError where dataset.toml states another."""
        cameras = []
        for camera in self.cameras:
            film = self.films.get(camera.name)
            if film is not None and (
                camera.width not in (None, film.width) or camera.height not in (None, film.height)
            ):
                raise ImageError(
                    f"{film.path} is {film.width} x {film.height}, but camera {camera.name!r} has {camera.width} x "
                    f"{camera.height}.",
                    why="a recorder may have reduced, cut or turned the pictures: these pixels are not the camera's",
                    fix=f"film with the full size, or correct {DESCRIPTION}",
                )
            cameras.append(camera if film is None else replace(camera, width=film.width, height=film.height))
        return replace(self, cameras=tuple(cameras))


# ---- the pictures


def _sharpest(
    folder: Path, films: Mapping[str, Path], known: tuple[list[str], KnownPositions] | None, progress: Progress
) -> Path:
    """Of the film of a target that does not move the sharpest picture, as folder/<camera>/<shot>.png."""
    shots = set(known[1].shots.tolist()) if known else set()
    shot = shots.pop() if len(shots) == 1 else STILLS
    for done, (camera, file) in enumerate(films.items()):
        progress("looking for the sharpest pictures", done, len(films))
        best: tuple[float, Grey] | None = None
        for picture in Film.of(file).pictures():
            sharpness = float(opencv().Laplacian(picture.grey, -1).var())
            if best is None or sharpness > best[0]:
                best = sharpness, picture.grey
        assert best is not None  # `Film.of` has read one
        write_picture(folder / camera / f"{shot}.png", best[1])
    return folder


def _search_all(
    rig: _FilmRig, detector: Detector, journal: Journal, every: int, times: Path | None, progress: Progress
) -> dict[str, _Searched]:
    total = sum(-(-film.promised // every) for film in rig.films.values())
    done = 0

    def step() -> None:
        nonlocal done
        done += 1
        progress("looking at films", done, max(total, done))

    searched = {camera: _search(camera, film, detector, journal, every, step) for camera, film in rig.films.items()}
    if times is None:
        return searched
    counts = {camera: (len(one.times), one.film.promised) for camera, one in searched.items()}
    table, notes = read_times(times, counts)
    first = next(iter(searched))
    return {
        camera: one._replace(times=table[camera], notes=one.notes + (notes if camera == first else []))
        for camera, one in searched.items()
    }


def _search(camera: str, film: Film, detector: Detector, journal: Journal, every: int, step: Any) -> _Searched:
    """Look at every so many pictures of a film that the journal does not know yet."""
    options = digest(detector)
    all_times = film.times()
    numbers = np.arange(0, len(all_times), every)
    found: dict[View, Detected] = {}
    seconds: list[float] = []
    known: dict[View, Entry] = {}
    for number in numbers:
        view = View(camera, shot_name(int(number)))
        entry = find_entry(journal, view, film.path, options)
        if entry is not None:
            known[view] = entry
    new = {int(n) for n in numbers if View(camera, shot_name(int(n))) not in known}

    def work(picture: FilmPicture) -> tuple[View, Detected, float]:
        view = View(camera, shot_name(picture.number))
        start = time.perf_counter()
        try:
            found = look_at(picture.grey, film.path, Key.of(view, film.path, options), detector, journal).found
        except ImageError as error:
            found = nothing(join_lines(error).replace(str(film.path), "the picture"))
        return view, found, time.perf_counter() - start

    batch: list[FilmPicture] = []

    def look() -> None:
        for view, what, spent in side_by_side(work, batch):
            found[view] = what
            seconds.append(spent)
            step()
        batch.clear()

    if new:
        for picture in film.pictures(new):
            batch.append(picture)
            if len(batch) >= 2 * cores():
                look()
        look()
    for view, entry in known.items():
        found[view] = entry.found
        step()
    notes = []
    if film.promised > len(all_times):
        notes.append(
            f"{film.path.name}: {len(all_times)} of the {film.promised} pictures that it promises can be read: "
            "it is cut off, or damaged. If the damage is midway, what comes after it may be dated too early by what is "
            "missing: record it again, or leave these pictures out."
        )
    ordered = {v: found[v] for n in numbers if (v := View(camera, shot_name(int(n)))) in found}
    return _Searched(film, numbers, all_times, ordered, notes, len(known), seconds)


def films_of(dataset: Path, folder: str | None = None, pictures: str | None = None) -> dict[str, Path]:
    """The films of a dataset, if it is to be read from films: where there are no pictures, or a folder is given.

    Args:
        dataset: The folder of the dataset.
        folder: Where they are in it; None for its folder `films`, that of the pictures, or itself.
        pictures: The folder of the pictures; None for `images`.

    Returns:
        Camera -> film; empty where there are none.

    Raises:
        UsageError: The folder that was given has no films.
        ImageError: A camera has two films.
    """
    described = dataset / DESCRIPTION
    cameras = [camera.name for camera in read_description(dataset)[2]] if described.exists() else []
    if folder is not None:
        found = find_films(dataset / folder, cameras)
        if not found:
            raise UsageError(f"there is no film in {dataset / folder}.", fix=f"one of {', '.join(FILM_ENDINGS)}")
        return found
    images = dataset / (pictures or IMAGES)
    if has_pictures(images, 2) or has_pictures(dataset, 0):
        return {}
    places = (dataset / FILMS, images, dataset)
    return next((found for place in places if (found := find_films(place, cameras))), {})


def shot_name(number: int) -> str:
    """The name of a picture of a film.

    Args:
        number: From 0.
    """
    return f"{number:06d}"


# ---- the second look


def _settle(rig: _FilmRig, detector: Detector, searched: Mapping[str, _Searched]) -> tuple[list[Result], list[str]]:
    """The detector's second look, in which pictures in a row that show the target at one place count as one."""
    heads: dict[View, Detected] = {}
    runs: dict[View, list[View]] = {}
    for one in searched.values():
        head: View | None = None
        for view, found in one.found.items():
            if head is not None and _rests(one.found[head], found):
                runs[head].append(view)
            else:
                head, heads[view], runs[view] = view, found, []
    settled = detector.settle(heads)
    kept: dict[View, Detected] = {}
    for head, first in heads.items():
        kept[head] = settled[head]
        same = settled[head] is first or _rests(settled[head], first)
        for view in runs[head]:
            own = searched[view.camera].found[view]
            kept[view] = own if same else nothing(settled[head].reason or "another thing was taken for the target")
    if isinstance(detector, LooksAgain):
        kept = detector.look_again(kept, lambda views: _read_again(rig, views))
    results = [
        Result(view, rig.films[camera].path, kept[view]) for camera, one in searched.items() for view in one.found
    ]
    return results, [note for one in searched.values() for note in one.notes]


def _read_again(rig: _FilmRig, views: Collection[View]) -> Iterator[tuple[View, Grey]]:
    """Some pictures of the films, each film read once as far as the last of them."""
    for camera, film in rig.films.items():
        wanted = {int(view.shot) for view in views if view.camera == camera}
        for picture in film.pictures(wanted) if wanted else ():
            yield View(camera, shot_name(picture.number)), picture.grey
            if picture.number == max(wanted):
                break


def _rests(before: Detected, after: Detected) -> bool:
    """Whether two pictures show the same points at the same places."""
    if not len(before) or len(before) != len(after):
        return False
    return bool(np.abs(before.uv - after.uv).max() < STILL_PX)


# ---- tracks and clocks


def _tracks(
    rig: _FilmRig, searched: Mapping[str, _Searched], results: Sequence[Result]
) -> tuple[list[Track], list[str]]:
    """Where each camera saw each point, by its own clock; cleaned."""
    by_camera: dict[str, list[Result]] = {}
    for result in results:
        by_camera.setdefault(result.view.camera, []).append(result)
    tracks, notes = [], []
    for camera, own in by_camera.items():
        names = sorted({_point_of(result.view, name) for result in own for name in result.found.points})
        if not names:
            notes.append(f"nothing was found in the film of {camera!r}.")
            continue
        column = {name: i for i, name in enumerate(names)}
        uv = np.full((len(own), len(names), 2), np.nan)
        sd = np.full_like(uv, np.nan)
        for i, result in enumerate(own):
            rows = [column[_point_of(result.view, name)] for name in result.found.points]
            uv[i, rows], sd[i, rows] = result.found.uv, result.found.sd
        one = searched[camera]
        numbers = np.array([int(result.view.shot) for result in own])
        times = one.times[numbers]
        keep = np.isfinite(times) & ~_repeated(uv, sd)
        film = one.film
        track = Track(camera, times[keep], uv[keep], sd[keep], tuple(names), (film.width, film.height), numbers[keep])
        repeats = int(np.isfinite(times).sum() - keep.sum())
        if repeats:
            notes.append(
                f"{repeats} pictures of {camera!r} repeat the one before while the target moves: the recorder filled "
                "gaps with them. They are left out."
            )
        track, wrong = track.without_wrong()
        if wrong:
            notes.append(f"{wrong} detections in the film of {camera!r} are far from those before and after: left out.")
        tracks.append(track)
    return tracks, notes


def _point_of(view: View, name: str) -> str:
    """The name of a point without that of its shot: the same in all pictures."""
    return "" if name == view.shot else name.removeprefix(f"{view.shot}-")


def _repeated(uv: Floats, sd: Floats) -> NDArray[np.bool_]:
    """Pictures in which exactly the same was found as in the one before, while the target was moving."""
    n = len(uv)
    repeated = np.zeros(n, dtype=np.bool_)
    for i in range(1, n):
        if np.isfinite(uv[i]).any() and np.array_equal(uv[i], uv[i - 1], equal_nan=True):
            around = [(i - 2, i - 1), (i, i + 1)]
            steps = [np.abs(uv[k] - uv[j]) / sd[j] for j, k in around if j >= 0 and k < n]
            repeated[i] = any((step > REPEATED_SDS).any() for step in steps)
    return repeated


def _clocks(
    tracks: list[Track], rig: _FilmRig, times: Path | None, offsets: str | None, progress: Progress
) -> tuple[dict[str, Clock], list[str]]:
    """The clock of each camera. The slowest camera's is the common one; the tracks are put in that order."""
    tracks.sort(key=lambda track: (len(track) < 2, -_rounded_period(track)))
    names = [track.camera for track in tracks]
    if times is not None:
        return {name: Clock(name) for name in names}, []
    if offsets is not None:
        return {name: clock for name, clock in given_clocks(offsets, list(rig.films)).items() if name in names}, []
    if len(tracks) == 1:
        return {names[0]: Clock(names[0])}, []
    clocks, notes = clocks_from_target(tracks, progress)
    told = [
        f"offsets found from the movement of the target, to the clock of {names[0]!r} "
        f"(standard uncertainties): {'; '.join(clock.words for clock in clocks.values() if clock.sd)}."
    ]
    return clocks, told + notes


def _rounded_period(track: Track) -> float:
    return float(f"{track.period:.3g}") if math.isfinite(track.period) else math.inf


def _clocks_csv(clocks: Mapping[str, Clock]) -> str:
    rows = [(c.camera, *(repr(v) for v in (c.offset, c.sd, c.drift, c.drift_sd, c.around))) for c in clocks.values()]
    return csv_text(("camera", "add_s", "sd_s", "drift", "sd_drift", "around_s"), rows)


# ---- instants


class _Instants(NamedTuple):
    """Names and common times, (m,) each; and whether points.csv said so."""

    names: list[str]
    times: Floats
    known: bool


def _instants(rig: _FilmRig, tracks: Sequence[Track], clocks: Mapping[str, Clock]) -> _Instants:
    base = tracks[0]
    if rig.known is None:
        common = clocks[base.camera].common(base.times)
        return _Instants([], common, False)
    names, known = rig.known
    if TIME_COLUMN not in known.extra:
        raise DatasetError(
            f"{rig.path / POINTS} has no column {TIME_COLUMN}, so nothing says when in the film the target was where.",
            why="pictures of a film have no names of shots",
            fix=f"add {TIME_COLUMN}, seconds by the clock of {base.camera!r} (or by that of --times); or move "
            f"{POINTS} away to measure unknown positions",
        )
    times: dict[str, float] = {}
    for name, shot, text in zip(names, known.shots.tolist(), known.extra[TIME_COLUMN].tolist(), strict=True):
        try:
            seconds = float(text)
        except ValueError:
            seconds = math.nan
        if not math.isfinite(seconds) or times.setdefault(shot, seconds) != seconds:
            raise DatasetError(
                f"{rig.path / POINTS}: {TIME_COLUMN} = {text[:40]!r} of point {name!r} is no time, or not that of the "
                f"other points of shot {shot!r}.",
                fix="write seconds, the same for all points of a shot",
            )
    return _Instants(list(times), np.array(list(times.values())), True)


def _observe(
    rig: _FilmRig, tracks: Sequence[Track], clocks: Mapping[str, Clock], instants: _Instants, frames: int | None
) -> tuple[Dataset, dict[str, set[int]]]:
    """Observations at the instants; and which pictures of each camera are nearest to some of them."""
    points = sorted({name for track in tracks for name in track.points})
    columns = {name: i for i, name in enumerate(points)}
    m, cameras = len(instants.times), [camera.name for camera in rig.cameras]
    uv = np.full((m, len(points), len(cameras), 2), np.nan)
    sd = np.full_like(uv, np.nan)
    for track in tracks:
        clock, k = clocks[track.camera], cameras.index(track.camera)
        common = replace(track, times=clock.common(track.times))
        places = common.at(instants.times)
        own = [columns[name] for name in track.points]
        uv[:, own, k] = places.uv
        late = places.velocity * clock.sd_at(instants.times)[:, None, None]
        sd[:, own, k] = np.hypot(places.sd, np.where(np.isfinite(late), late, 0.0))
    size = np.array([(c.width or math.inf, c.height or math.inf) for c in rig.cameras])
    outside = ~((uv >= -0.5) & (uv <= size - 0.5)).all(axis=-1)
    uv[outside], sd[outside] = np.nan, np.nan
    enough = min(2, len(tracks))
    seen = np.isfinite(uv[..., 0])
    if instants.known:
        kept = np.arange(m)
        shots = instants.names
    else:
        usable = np.flatnonzero((seen.sum(axis=2) >= enough).any(axis=1))
        if not len(usable):
            raise ImageError(
                "no instant was seen by two cameras.",
                why="their films show the target at different times",
                fix="film the target with all cameras at the same time; or correct --times or --offsets",
            )
        usual = max(BOARD_INSTANTS, WANTED_POINTS // len(points)) if len(points) > 1 else None
        number = frames if frames is not None else usual
        kept = usable if number is None else usable[choose_different(uv[usable], sd[usable], number)]
        shots = [shot_name(int(tracks[0].numbers[row])) for row in kept]  # an instant is a picture of the first track
    data = _dataset(rig, points, shots, instants.times[kept], uv[kept], sd[kept], instants.known)
    nearest = {}
    drawn = instants.times[kept][:: -(-len(kept) // MAX_DRAWN)]
    for track in tracks:
        common_times = clocks[track.camera].common(track.times)
        nearest[track.camera] = {int(track.numbers[np.abs(common_times - t).argmin()]) for t in drawn}
    return data, nearest


def _dataset(
    rig: _FilmRig, points: Sequence[str], shots: Sequence[str], times: Floats, uv: Floats, sd: Floats, known: bool
) -> Dataset:
    """The dataset of (m, points, cameras, 2) pixels at m shots."""
    m, p, c = uv.shape[:3]
    if known:
        assert rig.known is not None
        names = rig.known[0]
        shot_of = {shot: i for i, shot in enumerate(shots)}
        single = points == [""]
        rows = []
        for name, shot in zip(names, rig.known[1].shots.tolist(), strict=True):
            point = "" if single else name.removeprefix(f"{shot}-")
            rows.append(shot_of[shot] * p + (points.index(point) if point in points else 0))
            if point not in points:
                raise DatasetError(
                    f"{rig.path / POINTS} has the point {name!r}, which no camera saw.",
                    why=f"the points of shot {shot!r} would be named {list_some([f'{shot}-{q}' for q in points])}",
                    fix="remove it, or give it the name that the detector gives",
                )
        index = np.array(rows)
        observations = Observations(
            np.array(names, dtype=np.str_), rig.cameras, uv.reshape(m * p, c, 2)[index], sd.reshape(m * p, c, 2)[index]
        )
        if not observations.seen.any():
            raise ImageError(
                f"at none of the {m} times in {POINTS} the films show the target.",
                why=f"the times are from {times.min():g} to {times.max():g} s",
                fix=f"{TIME_COLUMN} must be by the clock of the films",
            )
        return Dataset(rig.name, rig.unit, observations, rig.known[1], rig.extra)
    names = [shot if point == "" else f"{shot}-{point}" for shot in shots for point in points]
    stamps = np.repeat([f"{t:.6f}" for t in times], p)
    flat, flat_sd = uv.reshape(m * p, c, 2), sd.reshape(m * p, c, 2)
    seen = np.isfinite(flat[..., 0]).any(axis=1)
    observations = Observations(np.array(names, dtype=np.str_), rig.cameras, flat, flat_sd).select(seen)
    return Dataset(rig.name, rig.unit, observations, None, rig.extra, columns={TIME_COLUMN: stamps[seen]})


def choose_different(uv: Floats, sd: Floats, number: int) -> NDArray[np.int_]:
    """Instants that differ from each other as much as possible, by the farthest-first rule (Gonzalez 1985).

    The first one is the most certain. Instants that differ by less than `MIN_DIFFERENCE_PX` from one that is chosen are
    left out, and so are those whose pixels are much less certain than usual (blurred, or between two pictures while the
    target was quick), as long as there are others.

    Args:
        uv: (m, points, cameras, 2) pixels, NaN where not seen.
        sd: Their standard uncertainties.
        number: The most that are wanted.

    Returns:
        At most so many rows, ascending.
    """
    m = len(uv)
    flat = uv.reshape(m, -1, 2)
    seen = np.isfinite(flat[..., 0])
    spread = np.sqrt(np.array([np.nanmean(np.square(one)) if np.isfinite(one).any() else np.inf for one in sd]))
    good = spread <= MAX_SD_RATIO * np.median(spread)
    if good.sum() < number:
        good = np.ones(m, dtype=np.bool_)
    # an instant with more views is worth more: one that shows few points is chosen last
    share = seen.sum(axis=1) / max(1, seen.sum(axis=1).max())
    filled = np.where(np.isfinite(flat), flat, 0.0)
    nearest = np.full(m, np.inf)
    chosen: list[int] = []
    following = int(np.argmin(np.where(good, spread / share, np.inf)))
    while len(chosen) < number:
        chosen.append(following)
        both = seen & seen[following]
        away = np.linalg.norm(filled - filled[following], axis=-1)
        mean = np.where(both, away, 0).sum(axis=1) / np.maximum(both.sum(axis=1), 1)
        nearest = np.minimum(nearest, np.where(both.any(axis=1), mean, np.inf))
        nearest[chosen] = -np.inf
        worth = np.where(good, np.minimum(nearest, 1e6) * share, -np.inf)
        following = int(np.argmax(worth))
        if not nearest[following] >= MIN_DIFFERENCE_PX:
            break
    return np.sort(np.array(chosen))


# ---- pictures to look at


def _draw(
    rig: _FilmRig, folder: Path, searched: Mapping[str, _Searched], results: Sequence[Result],
    chosen: Mapping[str, set[int]], overlays: bool, restart: bool, progress: Progress,
) -> tuple[tuple[Path, ...], tuple[str, ...]]:  # fmt: skip
    """Sheets and overlays of pictures nearest to instants that were kept, and of some where nothing was found."""
    if not overlays:
        return (), ()
    shown = []
    for camera, one in searched.items():
        own = {int(result.view.shot): result for result in results if result.view.camera == camera}
        empty = [number for number, result in own.items() if not len(result.found)]
        wanted = set(chosen.get(camera, ()))
        room = max(MAX_DRAWN // 4, MAX_DRAWN - len(wanted))
        wanted |= set(empty[:: max(1, -(-len(empty) // room))])
        place = folder / FRAMES / camera
        files = {number: place / f"{shot_name(number)}.png" for number in sorted(wanted & own.keys())}
        missing = {number for number, file in files.items() if restart or not file.exists()}
        if missing:
            for picture in one.film.pictures(missing):
                write_picture(files[picture.number], picture.grey)
        shown += [replace(own[number], path=file) for number, file in files.items()]
    return draw_sheets(folder, shown, progress, redraw=restart)


def _nothing_found(path: Path, results: Sequence[Result], sheets: Sequence[Path]) -> ImageError:
    reasons = "; ".join(f"{count} x {text}" for text, count in list(count_reasons(results))[:3])
    look = f"look at {sheets[0]}, and check" if sheets else "check"
    return ImageError(
        f"nothing was found in any of the {len(results)} pictures of the films in {path}, so observations.csv is not "
        "written.",
        why=reasons or "the detector gave no reason",
        fix=f"{look} the kind of target and its options",
    )
