"""Which camera took a picture in which shot: by the folder it is in, by a pattern, or by the names in one folder.

The same shot is the same instant. Names are read where that can be done in one way only; else they are refused.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from implicam.errors import ImageError, UsageError
from implicam.formatting import list_some
from implicam.images import ENDINGS

PATTERN = "{camera}/{shot}"
"""Where the picture of a camera and a shot is, below the folder of images and without its ending."""

CAMERA_WORDS = frozenset({
    "cam", "camera", "kamera", "caméra", "c", "view", "camid", "device", "dev", "sensor", "port", "video",
})  # fmt: skip
"""Words after which a number is that of a camera."""

SIDE_WORDS = frozenset({
    "left", "right", "l", "r", "center", "centre", "middle", "mid", "top", "bottom", "front", "back", "rear",
    "side", "upper", "lower",
})  # fmt: skip
"""Words that are cameras."""

SHOT_WORDS = frozenset({
    "img", "image", "im", "frame", "fr", "f", "shot", "pic", "picture", "photo", "snap", "calib", "board", "pose",
    "t", "s", "n", "no", "nr", "seq",
})  # fmt: skip
"""Words after which a number is that of a shot."""

MIN_SHARED_PART = 0.5
"""The part of the pictures whose shot another camera has too, from which names count as read rightly where no word
says which is the camera. Where one does, pictures of one camera alone, for its lens, may be the most."""

MIN_ALIKE_PART = 2 / 3
"""The part of the names that must be made alike; the others are left out."""

FEWER_TIMES, MAX_CAMERAS_BY_COUNT = 3, 16
"""Of two numbers, that with so many times fewer values is the camera's, if these are not too many."""

Pictures = dict[str, dict[str, Path]]

_FIELD = re.compile(r"[^\W\d_]+|\d+")


SAID = 3
"""Evidence of a reading where a word says which field is the camera."""


class SortedPictures(NamedTuple):
    """{camera: {shot: path}}, both in natural order, and what there is to say about how names were read."""

    pictures: Pictures
    notes: tuple[str, ...] = ()


class _Named(NamedTuple):
    """What the name of one picture says."""

    camera: str
    shot: str
    path: Path


def find_pictures(folder: Path, pattern: str = PATTERN, cameras: Sequence[str] = ()) -> Pictures:
    """The files by camera and shot, both in natural order (2 before 10), as a pattern says.

    Hidden files and folders are left out.

    Args:
        folder: Where to look.
        pattern: The path below `folder` with {camera} and {shot}, without the ending: "{camera}/{shot}" (a folder per
            camera), "{shot}_{camera}", ... Where one follows the other directly, the shot is a number: "{camera}{shot}"
            splits left12 into left and 12.
        cameras: Names to look for first, because in "cam_1_003" it is not clear where the camera ends.

    Returns:
        {camera: {shot: path}}.

    Raises:
        UsageError: The pattern lacks {camera} or {shot}.
        ImageError: There are no pictures, or two files are the same camera and shot.
    """
    expression = _compile_pattern(pattern, cameras)
    _require_folder(folder)
    found = _match_pattern(folder, expression, pattern.count("/"))
    if not found:
        raise _no_picture_error(folder, f"that fits the pattern {pattern!r}")
    return _by_camera(found)


def sort_pictures(folder: Path, cameras: Sequence[str] = (), ignored: Sequence[str] = ()) -> SortedPictures:
    """The files by camera and shot: from a folder per camera, or from the usual names of pictures in one folder.

    Usual names are left1 and right1, cam0_001, 001_L, img12-cam3.

    Args:
        folder: Where to look.
        cameras: Names that are known.
        ignored: Names of folders in it that hold no pictures of cameras.

    Raises:
        ImageError: There are no pictures, or it is not clear which camera and shot they are of.
    """
    _require_folder(folder)
    by_folder = _match_pattern(folder, _compile_pattern(PATTERN, cameras), 1)
    by_folder = [one for one in by_folder if one.camera not in ignored]
    if by_folder:
        return _join_folders(_by_camera(by_folder))
    loose = sorted(_walk_pictures(folder, 0))
    if not loose:
        raise _no_picture_error(folder, "")
    return _read_names(folder, loose, cameras)


def in_order(names: Sequence[str] | dict[str, Any]) -> list[str]:
    """Names in natural order: img2 before img10.

    Args:
        names: In any order.
    """

    def key(name: str) -> tuple[list[str | int], str]:
        parts = re.split(r"(\d+)", name)  # text, digits, text, digits, ..., text
        return [int(part) if i % 2 else part for i, part in enumerate(parts)], name

    return sorted(names, key=key)


def _require_folder(folder: Path) -> None:
    if not folder.is_dir():
        raise ImageError(f"there is no folder {folder}.", fix="put the pictures of each camera into images/<camera>/")


def _no_picture_error(folder: Path, fitting: str) -> ImageError:
    return ImageError(
        f"{folder} holds no picture{f' {fitting}' if fitting else ''}.",
        why=f"looked for {', '.join(ENDINGS)}",
        fix="put the pictures of each camera into images/<camera>/, or give --pattern, "
        'for example --pattern "{shot}_{camera}"',
    )


def _match_pattern(folder: Path, expression: re.Pattern[str], depth: int) -> list[_Named]:
    found = []
    for path in sorted(_walk_pictures(folder, depth)):
        match = expression.fullmatch(path.relative_to(folder).with_suffix("").as_posix())
        if match is not None:
            found.append(_Named(match["camera"], match["shot"], path))
    return found


def _by_camera(named: Iterable[_Named]) -> Pictures:
    found: Pictures = {}
    for camera, shot, path in named:
        shots = found.setdefault(camera, {})
        if shot in shots:
            raise ImageError(
                f"{shots[shot]} and {path} are both the picture of shot {shot!r}.",
                why="the same name is the same instant",
                fix="remove one of them",
            )
        shots[shot] = path
    return {camera: {shot: found[camera][shot] for shot in in_order(found[camera])} for camera in in_order(found)}


def has_pictures(folder: Path, deepest: int) -> bool:
    """Whether a folder holds a file named like a picture.

    Args:
        folder: Where to look.
        deepest: How many folders down.
    """
    depths = range(deepest + 1)
    return folder.is_dir() and any(next(_walk_pictures(folder, depth), None) is not None for depth in depths)


def _walk_pictures(folder: Path, depth: int) -> Iterator[Path]:
    """The pictures so many folders down, behind links to folders on other disks too."""
    for place, folders, names in os.walk(folder, followlinks=True):
        here = Path(place)
        if len(here.relative_to(folder).parts) < depth:
            folders[:] = [name for name in folders if not name.startswith(".")]
            continue
        folders.clear()
        for name in names:
            path = here / name
            if path.suffix.lower() in ENDINGS and not name.startswith(".") and path.is_file():
                yield path


def _compile_pattern(pattern: str, cameras: Sequence[str]) -> re.Pattern[str]:
    for word in ("{camera}", "{shot}"):
        if pattern.count(word) != 1:
            raise UsageError(
                f"the pattern {pattern!r} must contain {word} once.",
                why="a picture belongs to one camera and one shot",
                fix='write for example "{camera}/{shot}" or "{shot}_{camera}"',
            )
    pattern = next((pattern.removesuffix(ending) for ending in ENDINGS if pattern.endswith(ending)), pattern)
    known, other, shot = [*map(re.escape, sorted(cameras, key=len, reverse=True))], "[^/]+?", "[^/]+"
    if "{camera}{shot}" in pattern:  # nothing stands between: the shot is the number at the end
        other, shot = r"[^/]*?[^/\d]", r"\d+"
    elif "{shot}{camera}" in pattern:
        other, shot = r"[^/\d][^/]*?", r"\d+"
    camera = "|".join([*known, other])
    text = re.escape(pattern).replace(r"\{camera\}", f"(?P<camera>{camera})").replace(r"\{shot\}", f"(?P<shot>{shot})")
    return re.compile(text)


def _join_folders(found: Pictures) -> SortedPictures:
    """Pictures in a folder per camera; where the files of all folders have names of their own, those that differ by the
    camera's name only, or have the same number, are one shot."""
    every = [_Named(camera, shot, path) for camera, shots in found.items() for shot, path in shots.items()]
    if len(found) < 2 or _shared_part(every) > 0:
        return SortedPictures(found)

    def without_camera(one: _Named) -> str:
        return _cut_name(one.shot, one.camera) or one.shot

    def last_number(one: _Named) -> str:
        numbers = re.findall(r"\d+", one.shot)
        return numbers[-1] if numbers else one.shot

    def its_value(one: _Named) -> str:
        return last_number(one).lstrip("0") or "0"

    for shorten in (without_camera, last_number, its_value):
        named = [one._replace(shot=shorten(one)) for one in every]
        if len({one[:2] for one in named}) == len(named) and _shared_part(named) >= MIN_SHARED_PART:
            shot = next(shot for shot, n in Counter(one.shot for one in named).items() if n > 1)
            files = [f"{one.camera}/{one.path.name}" for one in named if one.shot == shot]
            note = f"no file name is in two folders: {list_some(files)} were taken for one shot, {shot!r}, and so on."
            return SortedPictures(_by_camera(named), (note,))
    note = "no file name is in two folders, so no two cameras share a shot. The same name means the same instant."
    return SortedPictures(found, (note,))


def _read_names(folder: Path, loose: Sequence[Path], cameras: Sequence[str]) -> SortedPictures:
    """Pictures in one folder, by what their names say."""
    named = _by_known_cameras(loose, cameras) or _by_fields(loose) or _by_ends(loose)
    if not named:
        examples = list_some([path.name for path in loose])
        raise ImageError(
            f"it is not clear which camera took which picture in {folder}.",
            why=f"{examples}: no folders of cameras, and the names do not say in one way only what is the camera and "
            "what the shot that several cameras share",
            fix="put the pictures of each camera into images/<camera>/, or give --pattern, for example "
            '"{camera}_{shot}"',
        )
    found = _by_camera(named)
    first = named[0]
    notes = [
        f"the pictures are in one folder, and their names were read: {first.path.name} is shot {first.shot!r} of "
        f"camera {first.camera!r}; the cameras are {list_some(list(found))}. If that is wrong, give --pattern."
    ]
    other = sorted({path.name for path in loose} - {one.path.name for one in named})
    if other:
        notes.append(f"left out, because their names are made otherwise: {list_some(other)}.")
    return SortedPictures(found, tuple(notes))


def _by_known_cameras(loose: Sequence[Path], cameras: Sequence[str]) -> list[_Named]:
    """By the camera whose name is in that of the picture; the rest is the shot."""
    named = []
    for path in loose:
        for camera in sorted(cameras, key=len, reverse=True):
            shot = _cut_name(path.stem, camera)
            if shot:
                named.append(_Named(camera, shot, path))
                break
    return named if len(named) >= MIN_ALIKE_PART * len(loose) else []


def _cut_name(stem: str, camera: str) -> str:
    """A picture's name without its camera's, where that is a part of it by itself; empty where it is not."""
    for match in re.finditer(re.escape(camera), stem, re.IGNORECASE):
        ends = ((match.start() - 1, match.start()), (match.end() - 1, match.end()))
        if all(_is_boundary(stem, a, b) for a, b in ends):
            parts = [part.strip(" _-.") for part in (stem[: match.start()], stem[match.end() :])]
            return "-".join(part for part in parts if part)
    return ""


def _is_boundary(text: str, a: int, b: int) -> bool:
    """Whether a word or a number ends between the neighbouring characters a and b."""
    if a < 0 or b >= len(text):
        return True
    return not ((text[a].isdigit() and text[b].isdigit()) or (text[a].isalpha() and text[b].isalpha()))


class _Reading(NamedTuple):
    """One way to read all names; the larger the evidence, the likelier."""

    named: list[_Named]
    evidence: int


def _by_fields(loose: Sequence[Path]) -> list[_Named]:
    """By the words and numbers that names of the same make consist of: one of them is the camera, the others that
    change are the shot."""
    makes: dict[str, list[Path]] = {}
    for path in loose:
        makes.setdefault(_FIELD.sub(lambda m: "0" if m[0].isdigit() else "a", path.stem), []).append(path)
    alike = max(makes.values(), key=len)
    if len(alike) < MIN_ALIKE_PART * len(loose):
        return []
    rows = [_FIELD.findall(path.stem) for path in alike]
    touching = [_touch(alike[0].stem, k) for k in range(len(rows[0]))]
    changing = [k for k in range(len(rows[0])) if len({row[k] for row in rows}) > 1]
    groups: list[tuple[int, ...]] = [(k,) for k in changing]
    groups += [(k, k + 1) for k in changing if k + 1 in changing and touching[k] and not rows[0][k].isdigit()]
    readings = []
    for group in groups:
        rest = [k for k in changing if k not in group]
        if rest:
            named = [
                _Named(_name_camera(path.stem, group), "-".join(row[k] for k in rest), path)
                for row, path in zip(rows, alike, strict=True)
            ]
            readings.append(_Reading(named, _weigh(rows, group)))
    return _choose(readings)


def _touch(stem: str, k: int) -> bool:
    """Whether field k and the next have nothing between them."""
    fields = list(_FIELD.finditer(stem))
    return k + 1 < len(fields) and fields[k].end() == fields[k + 1].start()


def _name_camera(stem: str, group: Sequence[int]) -> str:
    """The camera's field; a number with the word that it belongs to."""
    fields = list(_FIELD.finditer(stem))
    first, last = fields[group[0]], fields[group[-1]]
    text = stem[first.start() : last.end()]
    if not text.isdigit():
        return text
    before = fields[group[0] - 1] if group[0] else None
    if before is None or before[0].casefold() in SHOT_WORDS:
        return f"cam{text}"
    if before[0].casefold() in CAMERA_WORDS or _touch(stem, group[0] - 1):
        return stem[before.start() : last.end()]
    return f"cam{text}"


def _weigh(rows: Sequence[Sequence[str]], group: Sequence[int]) -> int:
    """How much speaks for fields being the camera: a word that says so, 3; a word, 2; a number, 1; a number after a
    word of shots, 0."""
    k = group[0]
    values = {row[k].casefold() for row in rows}
    before = {row[k - 1].casefold() for row in rows} if k else set()
    if values <= SIDE_WORDS or (rows[0][k].isdigit() and before and before <= CAMERA_WORDS):
        return SAID
    if not rows[0][k].isdigit():
        return 2
    return 0 if before and before <= SHOT_WORDS else 1


def _by_ends(loose: Sequence[Path]) -> list[_Named]:
    """By the number at the end of a name, or at its beginning, and the camera before or after it."""
    ways: tuple[tuple[str, Callable[[re.Match[str]], tuple[str, str]]], ...] = (
        (r"(.*?\D)[\W_]*?(\d+)", lambda match: (match[1], match[2])),
        (r"(\d+)[\W_]*(\D.*)", lambda match: (match[2], match[1])),
    )
    readings = []
    for expression, pick in ways:
        matches = [(re.fullmatch(expression, path.stem), path) for path in loose]
        named = [_Named(*pick(match), path) for match, path in matches if match]
        named = [one._replace(camera=one.camera.strip(" _-.")) for one in named]
        named = [one for one in named if one.camera]
        if len(named) >= MIN_ALIKE_PART * len(loose):
            readings.append(_Reading(named, 1))
    return _choose(readings)


def _choose(readings: Sequence[_Reading]) -> list[_Named]:
    """The one way in which cameras share shots; empty where there is none, or more than one."""
    good = [one for one in readings if len({n.camera for n in one.named}) > 1]
    good = [one for one in good if _shared_part(one.named) >= (MIN_SHARED_PART if one.evidence < SAID else 1e-9)]
    best = max((one.evidence for one in good), default=0)
    good = [one for one in good if one.evidence == best]
    if len(good) == 2 and best == 1:
        few, many = sorted(good, key=lambda one: len({n.camera for n in one.named}))
        counts = [len({n.camera for n in one.named}) for one in (few, many)]
        if counts[0] * FEWER_TIMES <= counts[1] and counts[0] <= MAX_CAMERAS_BY_COUNT:
            good = [few]
    return good[0].named if len(good) == 1 else []


def _shared_part(named: Sequence[_Named]) -> float:
    """The part of the pictures whose shot more than one camera has."""
    times = Counter(one.shot for one in named)
    return sum(times[one.shot] > 1 for one in named) / len(named)
