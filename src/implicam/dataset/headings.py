"""What the headings of a table mean: those of docs/formats.md, and others as people write them.

A heading is read as a name, an axis and a unit: "Kamera 1 x [px]" is the axis x of "Kamera 1". Two axes of one name are
the pixels of a camera, where the name is that of a camera; three are a position. Where there are two ways to read the
headings, or one half of a pair is missing, they are refused: a camera that is left out, or a marker that is taken for
one, would spoil a calibration in silence.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from implicam.dataset.model import SD_POINT, VIEW_COLUMNS
from implicam.dataset.units import METRES_PER_UNIT
from implicam.errors import DatasetError, did_you_mean

_FAMILIES = (("u", "v"), ("x", "y"), ("px", "py"), ("col", "row"), ("column", "row"), ("spalte", "zeile"))
"""Words for the two axes of a picture; those of one camera are of one pair."""

_AXES = {word for family in _FAMILIES for word in family} | {"z"}
_PIXEL_UNITS = ("px", "pixel", "pixels", "pix")
_LENGTH_UNITS = {**{unit.lower(): unit for unit in METRES_PER_UNIT}, "meter": "m", "metre": "m", "meters": "m",
                 "metres": "m", "millimeter": "mm", "millimetre": "mm", "inch": "in", "inches": "in",
                 "μm": "µm"}  # fmt: skip

CAMERA_WORDS = frozenset((
    "cam", "camera", "kamera", "kam", "caméra", "camara", "cámara", "telecamera", "fotocamera", "webcam", "gopro",
    "view", "vue", "ansicht", "sensor", "imager", "left", "right", "top", "bottom", "front", "back", "rear",
    "center", "centre", "middle", "side", "upper", "lower", "links", "rechts", "oben", "unten", "vorne", "hinten",
    "vorn", "mitte", "gauche", "droite", "haut", "bas", "izquierda", "derecha",
))  # fmt: skip
"""Words of which the name of a camera is made, beside numbers and single letters."""

_WORLD_WORDS = frozenset((
    "world", "pos", "position", "coord", "coordinate", "ref", "reference", "known", "object", "global", "welt", "3d",
))  # fmt: skip
_POINT_WORDS = frozenset((
    "point", "points", "pt", "pointname", "pointid", "name", "id", "marker", "markername", "markerid", "label",
    "target", "punkt", "punktname", "punktnr", "pointno", "nr", "no", "number", "nummer", "nom", "nombre",
))  # fmt: skip
_TIME_WORDS = frozenset((
    "frame", "frames", "framenumber", "frameno", "frameid", "time", "t", "bild", "bildnr", "image", "imagenumber",
))  # fmt: skip
_CAMERA_COLUMNS = frozenset((
    "camera", "cam", "kamera", "cameraname", "cameraid", "camname", "camid", "caméra", "cámara",
))  # fmt: skip

_WORD = re.compile(r"[^\s_\-.:,;/()\[\]#]+")
_UNIT = re.compile(r"\s*[\[(]\s*([^\])]*?)\s*[\])]\s*$")
_GLUED = re.compile(r"(?P<axis>[uvxyz])(?P<label>\d+)|(?P<before>.*\d)(?P<last>[uvxyz])", re.IGNORECASE)
_NUMBERED_CAMERA = re.compile(r"\b(cam|camera|kamera|kam|caméra|cámara)[ _-]?(\d+)\b", re.IGNORECASE)

_RENAME = "name the pixels u_NAME and v_NAME (u_cam1,v_cam1,u_cam2,v_cam2, ...), and the known positions x,y,z"


@dataclass(frozen=True)
class Heading:
    """A heading taken apart: `axis` is a word of an axis, in small letters, or empty; `unit` a length unit or "px"."""

    text: str
    label: str = ""
    axis: str = ""
    unit: str = ""
    at: int = 0
    """Where the axis stands in the text."""

    def with_axis(self, axis: str) -> str:
        """The heading with another axis in place of its own.

        Args:
            axis: In small letters.
        """
        own = self.text[self.at : self.at + len(self.axis)]
        return self.text[: self.at] + (axis.upper() if own.isupper() else axis) + self.text[self.at + len(own) :]


@dataclass(frozen=True)
class Headings:
    """What the columns of a table hold; all are given by their headings.

    Attributes:
        point: The column that names the points; empty where there is none.
        time: The column of frames or times, which may belong to the name; empty where there is none.
        positions: Of x, y and z; empty where there are none.
        pixels: Camera -> the columns of u and v; of a long table, with a row for each view, the key is "".
        camera: Of a long table the column that names the camera; else empty.
        views: Further columns that belong to the views of a camera: name -> camera -> column.
        further: Other columns, kept as they are.
        unit: The length unit that the headings state, or empty.
    """

    point: str
    time: str
    positions: tuple[str, ...]
    pixels: dict[str, tuple[str, str]]
    camera: str
    views: dict[str, dict[str, str]]
    further: tuple[str, ...]
    unit: str

    @property
    def guessed(self) -> bool:
        """Whether a heading is not one of docs/formats.md, and was read as one."""
        return bool(self.camera) or any(column != name for column, name in self.renamed().items())

    def renamed(self) -> dict[str, str]:
        """Heading -> the name that docs/formats.md has for it; of the columns that have one."""
        names = dict(zip(self.positions, "xyz", strict=False))
        if self.point:
            names[self.point] = "point"
        for camera, pair in self.pixels.items():
            names |= {column: f"{axis}_{camera}" for column, axis in zip(pair, "uv", strict=True)}
        for name, columns in self.views.items():
            names |= {column: f"{name}_{camera}" for camera, column in columns.items()}
        return names

    def describe(self) -> list[str]:
        """How the headings were read, a phrase for each kind of column."""
        said = [f"{_quoted([self.point])} names the points"] if self.point else []
        if self.positions:
            said.append(f"{_quoted(self.positions)} are x, y, z{f' in {self.unit}' if self.unit else ''}")
        pairs = [f"{camera or 'the camera of the row'} ({_quoted(pair)})" for camera, pair in self.pixels.items()]
        more = f" and {len(pairs) - 4} more" if len(pairs) > 4 else ""
        said.append(f"u and v of {', '.join(pairs[:4])}{more}")
        return said


def read_headings(header: Sequence[str], place: str, cameras: Sequence[str] = ()) -> Headings:
    """Read the headings of a table.

    Args:
        header: The headings, each once, without spaces around them.
        place: File and line, for errors.
        cameras: Names that cameras are known to have.

    Raises:
        DatasetError: There are no pixels of cameras, half of a pair is missing, or there are two ways to read the
            headings; says what is paired with what.
    """
    parsed = [take_apart(text) for text in header]
    camera = _camera_column(parsed)
    positions = _find_positions(parsed, bool(camera), place)
    unit = _one_unit([heading for heading in parsed if heading.text in positions], place)
    rest = [heading for heading in parsed if heading.text not in (*positions, camera)]
    pixels = _find_view_pixels(rest, cameras) if camera else {}
    if not pixels:
        camera, pixels = "", _find_pixels(rest, bool(positions), place, cameras)
    taken = {*positions, camera, *(column for pair in pixels.values() for column in pair)}
    point = _find_point([text for text in header if text not in taken], place)
    known = ("shot", *SD_POINT) if positions else SD_POINT
    other = [text for text in header if text not in taken and text not in (point, *known)]
    times = [text for text in other if squeezed(text) in _TIME_WORDS]
    views, further = _find_view_columns(other, list(pixels), place)
    return Headings(
        point=point,
        time=times[0] if len(times) == 1 else "",
        positions=positions,
        pixels=pixels,
        camera=camera,
        views=views,
        further=further,
        unit=unit,
    )


def take_apart(text: str) -> Heading:
    """Take a heading apart into name, axis and unit.

    Args:
        text: As it stands in the table.
    """
    if text.startswith("sd_"):
        return Heading(text)
    found = _UNIT.search(text)
    unit = _unit_of(found[1]) if found else ""
    bare = text[: found.start()] if found and unit else text
    if bare[:2] in ("u_", "v_") and len(bare) > 2:
        return Heading(text, bare[2:], bare[0], unit)  # as in docs/formats.md: the name may be anything
    words = list(_WORD.finditer(bare))
    pixels = [word for word in words if word[0].lower() in _PIXEL_UNITS]
    others = [word for word in words if word not in pixels]
    if not unit and len(pixels) == 1 and others and (_is_axis(others[0]) or _is_axis(others[-1])):
        return _find_axis(text, bare, others, "px")  # px_x, pixel_x_cam1, cam1_x_px
    if not unit and len(words) > 1 and _is_axis(words[0]) and _unit_of(words[-1][0]):
        words, unit = words[:-1], _unit_of(words[-1][0])  # x_mm, "x in mm"
        words = words[:-1] if len(words) > 1 and words[-1][0].lower() == "in" else words
    return _find_axis(text, bare, words, unit)


def _find_axis(text: str, bare: str, words: list[re.Match[str]], unit: str) -> Heading:
    """The axis is the first word or the last, or one letter at a number: x1, cam1x."""
    if not words:
        return Heading(text, unit=unit)
    first, last = _is_axis(words[0]), _is_axis(words[-1])
    if len(words) == 1 and first:
        return Heading(text, "", words[0][0].lower(), unit, words[0].start())
    if first and last:
        return Heading(text, unit=unit)  # either may be the axis
    if first:
        return Heading(text, bare[words[1].start() : words[-1].end()], words[0][0].lower(), unit, words[0].start())
    if last:
        return Heading(text, bare[words[0].start() : words[-2].end()], words[-1][0].lower(), unit, words[-1].start())
    glued = _GLUED.fullmatch(words[-1][0])
    if glued and glued["last"]:
        end = words[-1].end() - 1
        return Heading(text, bare[words[0].start() : end], glued["last"].lower(), unit, end)
    if glued and len(words) == 1:
        return Heading(text, glued["label"], glued["axis"].lower(), unit, words[0].start())
    return Heading(text, unit=unit)


def _is_axis(word: re.Match[str]) -> bool:
    return word[0].lower() in _AXES


def _unit_of(text: str) -> str:
    text = text.lower()
    return "px" if text in _PIXEL_UNITS else _LENGTH_UNITS.get(text, "")


def squeezed(text: str) -> str:
    """In small letters, without spaces and marks.

    Args:
        text: A heading, or a name.
    """
    return "".join(_WORD.findall(text)).lower()


def _quoted(columns: Iterable[str]) -> str:
    return ", ".join(map(repr, columns))


def _find_positions(parsed: list[Heading], long: bool, place: str) -> tuple[str, ...]:
    """The columns of x, y and z; none where the points are to be measured."""
    groups: dict[str, dict[str, list[str]]] = {}
    for heading in parsed:
        label = heading.label.lower()
        if heading.axis in ("x", "y", "z") and heading.unit != "px" and set(_WORD.findall(label)) <= _WORLD_WORDS:
            groups.setdefault(label, {}).setdefault(heading.axis, []).append(heading.text)
    found = {label: axes for label, axes in groups.items() if "z" in axes or label or not long}
    if len(found) > 1:
        columns = [column for axes in found.values() for same in axes.values() for column in same]
        raise DatasetError(
            f"{place}: {_quoted(columns)} may all be known positions.",
            why="a point has one position",
            fix="call the known positions x, y and z, and the others by other names",
        )
    for axes in found.values():
        if set(axes) != set("xyz"):
            there = _quoted(column for columns in axes.values() for column in columns)
            wanted = next(axis for axis in "xyz" if axis not in axes)
            near = [h.text for h in parsed if not h.axis or h.axis == wanted]
            alike = next(h for h in parsed if h.text == next(iter(axes.values()))[0]).with_axis(wanted)
            raise DatasetError(
                f"{place}: x, y and z must all be there, or none.",
                why=f"found are {there}, and no {alike!r}{did_you_mean(alike, near)}",
                fix="add the missing column, or correct its heading",
            )
        for columns in axes.values():
            if len(columns) > 1:
                raise DatasetError(f"{place}: {_quoted(columns)} may all be the same coordinate.", fix=_RENAME)
        return tuple(axes[axis][0] for axis in "xyz")
    return ()


def find_positions(header: Sequence[str], place: str) -> tuple[str, tuple[str, ...]] | None:
    """The columns of a table of positions alone: that of names, and x, y and z.

    Args:
        header: The headings, without spaces around them.
        place: File and line, for errors.

    Returns:
        Their headings; None where it is no such table.

    Raises:
        DatasetError: There are two ways to read the headings.
    """
    positions = _find_positions([take_apart(text) for text in header], False, place)
    point = _find_point([text for text in header if text not in positions], place) if positions else ""
    return (point, positions) if positions and point else None


def _one_unit(positions: list[Heading], place: str) -> str:
    units = sorted({heading.unit for heading in positions if heading.unit})
    if len(units) > 1:
        raise DatasetError(
            f"{place}: the headings {_quoted(h.text for h in positions)} have several units.",
            why="a dataset has one length unit",
            fix="convert the columns to one unit",
        )
    return units[0] if units else ""


def _camera_column(parsed: list[Heading]) -> str:
    """The column of a long table that names the camera of each row; empty where there is none."""
    found = [heading.text for heading in parsed if not heading.axis and squeezed(heading.text) in _CAMERA_COLUMNS]
    return found[0] if len(found) == 1 else ""


def _find_view_pixels(rest: list[Heading], cameras: Sequence[str]) -> dict[str, tuple[str, str]]:
    """The two columns of pixels of a long table; empty where a camera has columns of its own. Others may have an axis:
    simulate writes true_u and true_v beside u and v."""
    bare = {heading.axis: heading.text for heading in rest if heading.axis and not heading.label}
    pairs = [(bare[u], bare[v]) for u, v in _FAMILIES if u in bare and v in bare]
    labels = {heading.label for heading in rest if heading.axis in ("u", "v")} - {""}
    labelled = any(label in cameras or is_camera_name(label, True) for label in labels)
    return {"": pairs[0]} if len(pairs) == 1 and "z" not in bare and not labelled else {}


Axes = dict[str, list[Heading]]
"""Axis -> the headings that have it; of one name."""


def _find_pixels(rest: list[Heading], known: bool, place: str, cameras: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Camera -> its columns of u and v."""
    by_label: dict[str, Axes] = {}
    for heading in rest:
        if heading.axis and heading.label and heading.unit in ("", "px"):
            by_label.setdefault(heading.label, {}).setdefault(heading.axis, []).append(heading)
    named = {label: axes for label, axes in by_label.items() if "u" in axes or "v" in axes}
    if not named:
        named = _of_cameras({label: axes for label, axes in by_label.items() if "z" not in axes}, known, place, cameras)
    pairs, lonely = dict[str, tuple[str, str]](), list[tuple[Heading, str]]()
    for label, axes in named.items():
        pair = _find_pair(label, axes, place)
        if pair:
            pairs[label] = pair
        else:
            lonely += [(axes[word][0], other) for word, other in _PARTNERS if word in axes][:1]
    if lonely:
        raise _unpaired_error(pairs, lonely, rest, place)
    if not pairs:
        raise _no_cameras_error(rest, place)
    return pairs


_PARTNERS = [pair for u, v in _FAMILIES for pair in ((u, v), (v, u))]
"""Each word of an axis with the other one of its pair."""


def _find_pair(label: str, axes: Axes, place: str) -> tuple[str, str] | None:
    """The columns of u and v of a camera; None where one is missing."""
    for headings in (headings for headings in axes.values() if len(headings) > 1):
        columns = _quoted(heading.text for heading in headings)
        raise DatasetError(f"{place}: {columns} may all be the same column of pixels.", fix=_RENAME)
    pairs = [(axes[u][0].text, axes[v][0].text) for u, v in _FAMILIES if u in axes and v in axes]
    if len(pairs) > 1:
        raise DatasetError(
            f"{place}: camera {label!r} has two pairs of columns: {' and '.join(map(_quoted, pairs))}.", fix=_RENAME
        )
    return pairs[0] if pairs else None


def _of_cameras(found: dict[str, Axes], known: bool, place: str, names: Sequence[str]) -> dict[str, Axes]:
    """Those whose names are cameras'; refused where others are pairs, too."""
    cameras = {label: axes for label, axes in found.items() if label in names or is_camera_name(label, known)}
    others = [label for label, axes in found.items() if label not in cameras and len(axes) > 1]
    if others:
        columns = [heading.text for headings in found[others[0]].values() for heading in headings]
        also = f", as {_quoted(list(cameras)[:3])} {'are' if len(cameras) > 1 else 'is'}" if cameras else ""
        more = f"; there are {len(others)} such pairs" if len(others) > 1 else ""
        raise DatasetError(
            f"{place}: {_quoted(columns)} are a pair, and it cannot be told whether {others[0]!r} is a camera{also}.",
            why=f"a pair of columns may be the pixels of a camera, or a marker in the picture of one{more}",
            fix=f"name the pixels u_{names[0]} and v_{names[0]}, as the calibration has them: {', '.join(names)}"
            if names
            else f"{_RENAME}; or, of a table of DLTdv, Argus and others, implicam convert --from PROGRAM",
        )
    return cameras


def is_camera_name(label: str, numbers_too: bool) -> bool:
    """Whether a name can only be that of a camera: cam1, "Kamera 1", left.

    Args:
        label: The name.
        numbers_too: Whether a number or a letter alone is a camera: where each row is one known point.
    """
    words = re.findall(r"[^\W\d_]+|\d+", label.lower())
    long = [word for word in words if not word.isdigit() and len(word) > 1]
    if long:
        return all(word in CAMERA_WORDS for word in long)
    return numbers_too and 0 < len(words) <= 2


def _unpaired_error(
    pairs: dict[str, tuple[str, str]], lonely: list[tuple[Heading, str]], rest: list[Heading], place: str
) -> DatasetError:
    """The first heading without a partner, what its partner would be called, and what is paired with what."""
    alone, other = lonely[0]
    wanted = alone.with_axis(other)
    used = {column for pair in pairs.values() for column in pair}
    likely = [heading.text for heading, _ in lonely if heading.axis != alone.axis]
    likely = likely or [h.text for h in rest if h.text not in used and h.axis != alone.axis]
    paired = f"; paired are {', '.join(map(' with '.join, list(pairs.values())[:4]))}" if pairs else ""
    return DatasetError(
        f"{place}: there is a column {alone.text!r} but no {wanted!r}{did_you_mean(wanted, likely)}.",
        why=f"the pixels of a camera are a pair of columns, u_NAME and v_NAME{paired}",
        fix="correct the heading, add the other column, or give a column that is no pixel another name",
    )


def _no_cameras_error(rest: list[Heading], place: str) -> DatasetError:
    unnamed = [heading.text for heading in rest if heading.axis and not heading.label]
    return DatasetError(
        f"{place}: there are no camera columns.",
        why=f"{_quoted(unnamed[:4])} do not say of which camera they are" if unnamed else "",
        fix="name them u_cam1,v_cam1,u_cam2,v_cam2, ...",
    )


def _find_point(free: list[str], place: str) -> str:
    if "point" in free:
        return "point"
    found = [text for text in free if squeezed(text) in _POINT_WORDS or text == "#"]
    if len(found) > 1:
        raise DatasetError(f"{place}: {_quoted(found)} may all name the points.", fix="call the one that does 'point'")
    return found[0] if found else ""


def _find_view_columns(
    other: list[str], cameras: list[str], place: str
) -> tuple[dict[str, dict[str, str]], tuple[str, ...]]:
    """Further columns: those whose name has a camera in it, and the rest; sd_u and sd_v are as in docs/formats.md."""
    views: dict[str, dict[str, str]] = {}
    further = list[str]()
    camera_of = {camera.lower(): camera for camera in cameras if camera}
    known = {squeezed(camera) for camera in cameras}
    for text in other:
        name, camera = _split_camera(text, camera_of)
        numbered = _NUMBERED_CAMERA.search(text.replace("_", " "))
        if camera and name and name not in VIEW_COLUMNS:
            views.setdefault(name, {})[camera] = text
        elif numbered and squeezed(numbered[0]) not in known and any(map(_NUMBERED_CAMERA.search, cameras)):
            raise DatasetError(
                f"{place}: the column {text!r} names {numbered[0].replace(' ', '_')!r}, which has no columns of "
                f"pixels{did_you_mean(numbered[0], cameras)}.",
                why=f"the cameras are {', '.join(cameras[:8])}",
                fix="correct the heading, or give a column that belongs to no camera another name",
            )
        else:
            further.append(text)
    return views, tuple(further)


def _split_camera(text: str, camera_of: dict[str, str]) -> tuple[str, str]:
    """The name of a column and the camera at one of its ends; "" where there is none."""
    lowered = text.lower()
    cuts = [at.start() for at in re.finditer(r"[\s_.:-]", text)]
    for cut in cuts:
        if lowered[cut + 1 :] in camera_of:
            return text[:cut], camera_of[lowered[cut + 1 :]]
        if lowered[:cut] in camera_of:
            return text[cut + 1 :], camera_of[lowered[:cut]]
    return text, ""
