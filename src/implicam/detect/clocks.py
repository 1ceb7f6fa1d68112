"""The clocks of cameras: from a table of frame times, from offsets that are given, or from what the target did."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.special import chdtrc

from implicam.dataset import Floats
from implicam.dataset.dialect import read_brought_table
from implicam.dataset.tables import NumberColumn, read_columns
from implicam.detect.offsets import RICHER, Offset, OffsetError, find_offset
from implicam.detect.tracks import Track
from implicam.errors import DatasetError, UsageError, did_you_mean
from implicam.formatting import list_some
from implicam.progress import Progress
from implicam.threads import side_by_side

TIME_COLUMNS = ("camera", "frame", "time_s")

MANY_CAMERAS = 6
"""With more cameras not all pairs are compared: each with the first, and with the next."""

LOOP_P = 1e-3
"""A p-value below this says that the offsets between pairs contradict each other."""


@dataclass(frozen=True)
class Clock:
    """From a camera's own time to the common one: own + offset + drift (own - around).

    Attributes:
        camera: Its name.
        offset: Seconds.
        drift: Seconds per second.
        around: Its own time at which `sd` holds, seconds.
        sd: Standard uncertainty of the offset, seconds; zero where it was given.
        drift_sd: Standard uncertainty of the drift.
    """

    camera: str
    offset: float = 0.0
    drift: float = 0.0
    around: float = 0.0
    sd: float = 0.0
    drift_sd: float = 0.0

    def common(self, own: Floats) -> Floats:
        """Common times.

        Args:
            own: (n,) seconds by the camera's clock.
        """
        return np.asarray(own + self.offset + self.drift * (own - self.around), np.float64)

    def sd_at(self, common: Floats) -> Floats:
        """(n,) standard uncertainties of common times.

        Args:
            common: (n,) seconds.
        """
        away = common - self.offset - self.around
        return np.sqrt(self.sd**2 + np.square(self.drift_sd * away))

    @property
    def words(self) -> str:
        """What it is behind or ahead by."""
        if self.sd == 0:
            return f"{self.camera}: its clock is set by {self.offset * 1e3:+.6g} ms"
        digits = max(0, 1 - math.floor(math.log10(max(self.sd * 1e3, 1e-9))))
        text = f"{self.camera}: add {self.offset * 1e3:+.{digits}f} ± {self.sd * 1e3:.{digits}f} ms to its times"
        if abs(self.drift) > 3 * self.drift_sd:
            text += f", and {self.drift * 1e6:+.0f} ± {self.drift_sd * 1e6:.0f} µs a second"
        return text


def clocks_from_target(tracks: Sequence[Track], progress: Progress) -> tuple[dict[str, Clock], list[str]]:
    """The clocks of cameras that saw the same target move; the first camera's is the common one.

    Args:
        tracks: One for each camera.
        progress: Told how many pairs are compared.

    Returns:
        Camera -> clock; and notes.

    Raises:
        OffsetError: A camera's offset cannot be told.
    """
    n = len(tracks)
    pairs = list(combinations(range(n), 2))
    if n > MANY_CAMERAS:
        pairs = [(i, j) for i, j in pairs if i == 0 or j == i + 1]
    done = 0

    def compare(pair: tuple[int, int]) -> Offset | OffsetError:
        nonlocal done
        try:
            found: Offset | OffsetError = find_offset(tracks[pair[0]], tracks[pair[1]])
        except OffsetError as error:
            found = error
        done += 1
        progress("comparing movements", done, len(pairs))
        return found

    found = dict(zip(pairs, side_by_side(compare, pairs), strict=True))
    told = {pair: offset for pair, offset in found.items() if isinstance(offset, Offset)}
    errors = {pair: error for pair, error in found.items() if isinstance(error, OffsetError)}
    _refuse_unconnected(tracks, told, errors)
    return _adjust(tracks, told)


def _refuse_unconnected(
    tracks: Sequence[Track],
    told: Mapping[tuple[int, int], Offset],
    errors: Mapping[tuple[int, int], OffsetError],
) -> None:
    reached = {0}
    for _ in tracks:
        reached |= {k for pair in told for k in pair if reached & set(pair)}
    lost = [k for k in range(len(tracks)) if k not in reached]
    if not lost:
        return
    why = {error.why: error for pair, error in errors.items() if set(pair) & set(lost)}
    names = [repr(tracks[k].camera) for k in lost]
    raise OffsetError(
        f"the offset of the clock of {list_some(names)} to that of {tracks[0].camera!r} cannot be told from the films.",
        why="; ".join(list(why)[:3]),
        fix=next(iter(why.values())).fix if why else RICHER,
    )


def _adjust(tracks: Sequence[Track], told: Mapping[tuple[int, int], Offset]) -> tuple[dict[str, Clock], list[str]]:
    """All pairs together, by least squares: unknown are offset and drift of each camera but the first."""
    n = len(tracks)
    middle = [float(track.times.mean()) for track in tracks]
    rows, right, sds = [], [], []
    for (i, j), offset in told.items():
        row, slope = np.zeros((n, 2)), np.zeros((n, 2))
        row[j] = 1, offset.around - middle[j]
        row[i] = -1, -(offset.around + offset.seconds - middle[i])
        slope[j, 1], slope[i, 1] = 1, -1
        rows += [row[1:].ravel(), slope[1:].ravel()]
        right += [offset.seconds, offset.drift]
        sds += [offset.sd, offset.drift_sd]
    sd = np.array(sds)
    design, target = np.array(rows) / sd[:, None], np.array(right) / sd
    normal = design.T @ design
    values = np.linalg.solve(normal, design.T @ target)
    # pairs share the errors of their cameras: more of them check each other, and make nothing surer
    covariance = np.linalg.inv(normal) * len(told) / (n - 1)
    clocks = {tracks[0].camera: Clock(tracks[0].camera)}
    for k in range(1, n):
        o, d = values[2 * k - 2 : 2 * k]
        so, sdrift = np.sqrt(np.diag(covariance)[2 * k - 2 : 2 * k])
        name = tracks[k].camera
        clocks[name] = Clock(name, float(o), float(d), middle[k], float(so), float(sdrift))
    misfit = float(np.square(design @ values - target).sum())
    free = len(target) - len(values)
    if free and chdtrc(free, misfit) < LOOP_P:
        ratio = math.sqrt(misfit / free)
        clocks = {
            name: Clock(c.camera, c.offset, c.drift, c.around, c.sd * ratio, c.drift_sd * ratio)
            for name, c in clocks.items()
        }
        return clocks, [
            f"the offsets between pairs of cameras differ {ratio:.1f} times more than they should; their uncertainties "
            "are enlarged accordingly."
        ]
    return clocks, []


def read_times(path: Path, counts: Mapping[str, tuple[int, int]]) -> tuple[dict[str, Floats], list[str]]:
    """A table of frame times: camera, frame, time_s, all by one clock.

    Args:
        path: The table. Frames are numbered from 0, or all from 1.
        counts: Camera -> how many pictures its film gave, and how many it promised.

    Returns:
        Camera -> (n,) seconds of its pictures, NaN for one that the table has not; and notes.

    Raises:
        DatasetError: The table has a mistake, or another number of frames than a film; names the line.
    """
    header, rows, decimal = read_brought_table(path, TIME_COLUMNS, ("frame", "time_s"))
    number = NumberColumn("write the number, or remove the row", decimal=decimal)
    table = read_columns(path, header, rows, ("camera",), {"frame": number, "time_s": number})
    if not table.n:
        raise DatasetError(f"{path} has a header and no rows.", fix="add a row for each picture: camera,frame,time_s")
    frames, seconds = table.numbers["frame"], table.numbers["time_s"]
    first = 1 if frames.min() == 1 else 0
    times = {camera: np.full(max(count), np.nan) for camera, count in counts.items()}
    unknown: dict[str, None] = {}
    for i, camera in enumerate(table.texts["camera"]):
        if camera not in times:
            unknown[camera] = None
            continue
        k = frames[i] - first
        if k != round(k) or k < 0:
            raise DatasetError(
                f"{table.place(i)}: frame = {frames[i]:g} is no number of a picture.", fix="0, 1, 2, ..."
            )
        got, promised = counts[camera]
        if k >= max(got, promised):
            raise DatasetError(
                f"{table.place(i)}: frame {frames[i]:g} of camera {camera!r}, whose film has {got} pictures.",
                why="pictures were lost when the film was written, and nothing says which",
                fix="write the film again with all pictures, or a table of those that it has",
            )
        if not math.isnan(times[camera][int(k)]):
            raise DatasetError(
                f"{table.place(i)}: frame {frames[i]:g} of camera {camera!r} is there twice.", fix="keep one"
            )
        times[camera][int(k)] = seconds[i]
    notes = []
    for camera, own in times.items():
        known = np.flatnonzero(~np.isnan(own))
        if not len(known):
            hint = next((did_you_mean(camera, [other]) for other in unknown), "")
            raise DatasetError(
                f"{path} has no time of camera {camera!r}{hint}.", fix="add its rows: camera,frame,time_s"
            )
        back = np.flatnonzero(np.diff(own[known]) <= 0)
        if len(back):
            raise DatasetError(
                f"{path}: frame {known[back[0] + 1] + first} of camera {camera!r} is not later than the one before it.",
                why=f"{own[known[back[0] + 1]]:g} s after {own[known[back[0]]]:g} s",
                fix="correct the times; each picture of a film is later than the last",
            )
        times[camera] = own[: counts[camera][0]]
        lacking = counts[camera][0] - int(np.isfinite(times[camera]).sum())
        if lacking:
            notes.append(f"{lacking} pictures of {camera!r} have no time in {path.name}, and are left out.")
    if unknown:
        notes.append(f"{path.name} also has times of {list_some(list(unknown))}, of which there is no film.")
    return times, notes


def given_clocks(text: str, cameras: Sequence[str]) -> dict[str, Clock]:
    """The clocks that `--offsets` states.

    Args:
        text: "0" for films that all begin at the same instant, or "cam2=0.0374,cam3=-1.2": seconds to add to the times
            of a camera; the others are right.
        cameras: All names.

    Raises:
        UsageError: The text is of no such form, or names a camera that is not there.
    """
    offsets = dict.fromkeys(cameras, 0.0)
    wrong = UsageError(
        f"--offsets {text!r} are no offsets.",
        fix='--offsets 0 where all films begin at one instant; --offsets "cam2=0.0374,cam3=-1.2" for seconds to add',
    )
    for part in [] if text.strip() == "0" else text.split(","):
        name, sign, number = part.partition("=")
        if name.strip() not in offsets and sign:
            raise UsageError(
                f"--offsets names the camera {name.strip()!r}{did_you_mean(name.strip(), cameras)}.",
                fix=f"the cameras are {', '.join(cameras)}",
            )
        try:
            offsets[name.strip()] = float(number)
        except ValueError:
            raise wrong from None
        if not sign or not math.isfinite(offsets[name.strip()]):
            raise wrong
    return {name: Clock(name, seconds) for name, seconds in offsets.items()}
