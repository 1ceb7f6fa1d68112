"""A ball on a tool before its white plate: where it may be, its edge, and which of several it is.

As in the paper, template matching finds the plate and what is before it, and the blob inside is the ball. Here the
template is a dark disc on a light ground in many sizes, or a crop of a picture that a person pointed at; then the edge
of each blob is fitted (detect/edge.py), and a blob is a ball if its edge is a whole, nearly round step from dark to
light. A second look at all pictures of a camera drops what is at the same place in shot after shot: only the ball
moves.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators import PredictsPixels, load_calibration
from implicam.dataset import Dataset, Floats
from implicam.detect.edge import Edge, Rough, find_rough_edge, fit_edge
from implicam.detect.model import Detected, DetectorBase, View, nothing
from implicam.detect.silhouette import correct_outlines
from implicam.errors import ImageError, UsageError
from implicam.images import Grey, opencv, read_picture
from implicam.registry import Option

MIN_RADIUS_PX = 4.0
"""Least radius in pixels of a ball whose edge can be told from its inside."""

TEMPLATE_RADII_PX = (2.5, 3.5)
"""Radii of the drawn template, in pixels of a picture that is halved again and again."""

MIN_CORRELATION = 0.45
"""Least correlation with the template of a place where an edge is sought."""

MAX_PLACES, MAX_EDGES_FITTED = 10, 4
"""Places where an edge is sought in one picture, and edges that are fitted."""

MIN_RIVAL_QUALITY_RATIO = 0.6
"""An edge whose rough quality is less than this part of the best one's is no rival of a ball that was found."""

MIN_AXIS_RATIO, MIN_MIDDLE_AXIS_RATIO, OFF_AXIS_DIAGONALS = 0.65, 0.8, 0.35
"""A sphere far off the axis of a wide lens is an ellipse; its shorter axis is at least this part of the longer, in the
middle of the picture the second (a tilted sensor, a window seen aslant), as far from it as the third says the first."""

MIN_EDGE_SHARE, MAX_BROKEN_SHARE = 0.7, 0.17
"""Part of the edge that must be seen; and the part that may be broken, by a stem, a cable, a highlight: four sectors, a
stem of the ball's radius. What is broken farther is the end of a cable, or a disc that something covers."""

MAX_UNEVEN_STEPS = 0.4
"""How much the light of what is behind the ball may vary around it, in times the step at the edge: light and shadow."""

MIN_STEP_NOISES, MAX_RESIDUAL_STEPS = 8.0, 0.12
"""The step at the edge in times its noise; and what the fit may leave over, as a part of the step."""

MIN_PLATE_BRIGHTNESS, MIN_STEP_BRIGHTNESS, MAX_BALL_BRIGHTNESS = 0.5, 0.38, 0.5
"""The plate, and the step from ball to plate, as parts of the brightest in the picture; the ball, of the plate."""

MIN_USUAL_STEP_RATIO, MIN_BALLS_PER_CAMERA = 0.6, 5
"""A ball whose step is less than this part of the usual one in the camera's pictures, or, where they show fewer than so
many balls, in those of all cameras, is another thing."""

NEAR_RADII, NEAR_PX, ALIGNED_PX = 3.0, 64, 32
"""How far around its last place a ball that is followed is looked for: so many radii, and at least so many pixels; the
part of the picture begins at multiples of the third, so that it is halved as the whole picture is."""

ALIKE_CORRELATION, ALIKE_RADII = 0.6, 1.5
"""Two pictures that correlate so much around a ball, so many radii to each side, show the same thing there."""

FOLLOWED_RADIUS_RATIO, FOLLOWED_STEP_RATIO = 1.25, 1.35
"""A ball that is followed has about the radius, and the step at its edge, that it had: at most so many times as much,
or as little, from one picture to the next."""

MIN_RIVAL_SCORE_RATIO = 0.75
"""A second ball whose score is this part of the first's is one too many."""

SAME_PLACE_PX, SAME_SIZE_RADII, MIN_STILL_SHOTS, MIN_WITNESSED_SHOTS = 2.0, 0.03, 3, 2
"""Pixels within which a thing is at the same place, and the part of its radius within which it has the same size (a
ball that comes nearer along a line of sight grows); and it must be there in so many shots at least to be left out, the
second number where other cameras tell whether the ball rested."""


MAX_DOUBTFUL_SHARE, OTHER_PICTURES = 0.5, 3
"""Where a camera shows a ball in no more than this part of its pictures, each is looked for in so many others."""


@dataclass(frozen=True, eq=False)
class Template:
    """A crop of a picture with the ball in its middle, and the ball's radius in it, pixels."""

    picture: Grey
    radius: float

    @property
    def digest(self) -> str:
        """Another for every other template."""
        content = repr((self.picture.shape, self.radius)).encode() + self.picture.tobytes()
        return hashlib.sha256(content).hexdigest()[:16]

    @classmethod
    def from_click(cls, path: Path, u: float, v: float) -> Template:
        """Learn the template from one click on the ball.

        Args:
            path: A picture.
            u: Column of the click, in pixels.
            v: Row of the click, in pixels.

        Raises:
            ImageError: There is no ball, or the picture cannot be read.
        """
        picture = read_picture(path)
        rough = [find_rough_edge(picture, np.array([u, v]), radius) for radius in (5, 8, 12, 18, 27, 40, 60)]
        edges = [edge for one in rough if one and (edge := _fit_ball(picture, one))]
        near = [e for e in edges if np.linalg.norm(e.ellipse.centre - [u, v]) < 1.2 * e.ellipse.radius]
        if not near:
            raise ImageError(
                f"there is no ball at u = {u:g}, v = {v:g} in {path}.",
                why="no dark disc with a whole edge before something lighter is there",
                fix="click on the middle of the ball, in a picture that shows all of it before its plate",
            )
        best = max(near, key=lambda e: e.outer - e.inner)
        return cls._crop(picture, best)

    @classmethod
    def from_words(cls, text: str) -> Template:
        """Learn the template from one click as the command line has it.

        Args:
            text: The picture's path, a colon, u and v in pixels: "images/cam1/001.png:613,402".

        Raises:
            UsageError: The text is of no such form.
            ImageError: There is no ball, or the picture cannot be read.
        """
        try:
            name, _, place = text.rpartition(":")
            u, v = (float(part) for part in place.split(","))
        except ValueError:
            raise UsageError(
                f"--click {text!r} is not a place in a picture.", fix="for example images/cam1/001.png:613,402"
            ) from None
        return cls.from_click(Path(name), u, v)

    @classmethod
    def from_file(cls, path: Path) -> Template:
        """Learn the template from a cropped picture.

        Args:
            path: A picture of the ball before its plate, with the ball in the middle.

        Raises:
            ImageError: There is no ball, or the picture cannot be read.
        """
        picture = read_picture(path)
        return cls.from_click(path, (picture.shape[1] - 1) / 2, (picture.shape[0] - 1) / 2)

    @classmethod
    def _crop(cls, picture: Grey, edge: Edge) -> Template:
        radius = edge.ellipse.radius
        u, v = np.rint(edge.ellipse.centre).astype(int)
        height, width = picture.shape
        half = int(min(2.5 * radius + 2, u, v, width - 1 - u, height - 1 - v))
        return cls(picture[v - half : v + half + 1, u - half : u + half + 1].copy(), radius)


@dataclass(frozen=True, eq=False)
class Ball(DetectorBase):
    """Detector of one ball a picture. bright: a light ball on a dark ground. smallest, largest: its radius in pixels.

    template: what to look for first; a drawn disc where None. radius, in the dataset's unit, and calibration, of the
    rig, are for `correct`; without a radius nothing is corrected, without a calibration one is fitted.
    """

    bright: bool = False
    smallest: float = MIN_RADIUS_PX
    largest: float = 120.0
    template: Template | None = None
    radius: float | None = None
    calibration: PredictsPixels | None = None

    def __post_init__(self) -> None:
        if not 2 <= self.smallest < self.largest:
            raise UsageError(
                f"a ball from {self.smallest:g} to {self.largest:g} pixels in radius is not possible.",
                fix="give radii of 2 pixels or more, the smallest first",
            )

    @classmethod
    def from_options(
        cls,
        dataset: Path,
        described: Mapping[str, Any],
        *,
        radius: Annotated[float | None, Option("its radius, in the dataset's unit", "LENGTH", 0)] = None,
        bright: Annotated[bool, Option("it is lighter than what is behind it")] = False,
        template: Annotated[Path | None, Option("a picture of it before its plate, ball in the middle", "FILE")] = None,
        click: Annotated[str | None, Option("learn what it looks like at this pixel", "FILE:U,V")] = None,
        calibration: Annotated[
            Path | None, Option("correct its outline's middle with this calibration", "FILE")
        ] = None,
    ) -> Ball:
        """Make the detector from the options of the command line.

        Args:
            dataset: The dataset's folder.
            described: The table [target] of dataset.toml.
            radius: Of the ball, in the dataset's unit; None or 0 for no correction.
            bright: Whether the ball is lighter than what is behind it.
            template: A cropped picture of the ball before its plate.
            click: "FILE:U,V", see `Template.from_words`.
            calibration: The file of a calibration that predicts pixels.

        Raises:
            UsageError: Options exclude each other, or the calibration's method predicts no pixels.
            ImageError: There is no ball in the template's picture.
        """
        if template and click:
            raise UsageError("--template and --click exclude each other.", fix="give one of them")
        learned = Template.from_words(click) if click else Template.from_file(template) if template else None
        known = None if calibration is None else load_calibration(calibration)
        if known is not None and not isinstance(known, PredictsPixels):
            raise UsageError(
                f"{calibration} was made by {known.method}.",
                why="that method does not know what a camera sees of a place",
                fix="give a calibration by forward-gp or explicit",
            )
        return cls(bright, template=learned, radius=float(radius) if radius else None, calibration=known)

    def options(self) -> dict[str, Any]:
        """All that the results depend on."""
        return {
            "target": "ball", "bright": self.bright, "smallest": self.smallest, "largest": self.largest,
            "template": "drawn" if self.template is None else self.template.digest,
        }  # fmt: skip

    def detect(self, picture: Grey, view: View) -> Detected:
        """Find the likeliest ball in a picture; others that it might be are kept as `Detected.others`.

        Args:
            picture: (height, width) grey from 0 to 1.
            view: Which picture it is; the ball gets the name of the shot.

        Returns:
            One point or none, with the ball's edge as an outline.
        """
        looked = 1 - picture if self.bright else picture
        frame = _Frame.of(looked)
        found = self._find_balls(looked, frame)
        if not found:
            return nothing(
                "no ball: nowhere is there a dark disc with a whole edge before something light",
                notes={"white": frame.bright},
            )
        return _choose([_detection_of(edge, view, frame) for edge in found])

    def detect_near(self, picture: Grey, view: View, last: Detected) -> Detected | None:
        """Look for a ball only around where it was in the picture before, by the same tests as in the whole picture.

        Args:
            picture: (height, width) grey from 0 to 1: all of it, because the plate is judged by its brightest parts.
            view: Which picture it is.
            last: What was found in the picture before.

        Returns:
            The ball; None where it is not there, not alone, or not like it was: then the whole picture tells.
        """
        looked = 1 - picture if self.bright else picture
        radius = float(last.notes["radius_px"])
        reach = max(NEAR_RADII * radius, NEAR_PX) + 2.5 * radius
        sides = np.array([looked.shape[1], looked.shape[0]])
        low = np.clip(np.floor((last.uv[0] - reach) / ALIGNED_PX) * ALIGNED_PX, 0, sides).astype(int)
        high = np.clip(np.ceil(last.uv[0] + reach), 0, sides).astype(int)
        part = np.ascontiguousarray(looked[low[1] : high[1], low[0] : high[0]])
        if min(part.shape) < 4 * MIN_RADIUS_PX:
            return None
        sized = replace(
            self,
            smallest=max(self.smallest, radius / FOLLOWED_RADIUS_RATIO),
            largest=min(self.largest, radius * FOLLOWED_RADIUS_RATIO),
        )
        frame = _Frame.of(looked, low)
        found = sized._find_balls(part, frame, float(last.notes["blur_px"]))
        if len(found) != 1 or not _is_like(found[0], last):
            return None
        edge = found[0]
        moved = edge._replace(ellipse=edge.ellipse._replace(centre=edge.ellipse.centre + low))
        return _detection_of(moved, view, frame)

    def was_there(self, earlier: NDArray[Any], picture: Grey, found: Detected) -> bool:
        """Whether an earlier picture shows the same thing at the place where a ball was found, brighter or darker.

        Args:
            earlier: (height, width) grey of any unit, in which the ball was found elsewhere.
            picture: (height, width) grey, in which it was found now.
            found: The ball in `picture`.
        """
        part = _surroundings(found)
        return _are_alike(earlier[part], picture[part])

    def settle(self, found: Mapping[View, Detected]) -> dict[View, Detected]:
        """Drop what is before nothing white, stays at its place in shot after shot, or is far fainter than usual.

        Args:
            found: What `detect` gave of each picture.
        """
        views = _by_camera(found)
        white = {camera: _usual_white([found[view] for view in own]) for camera, own in views.items()}
        found = {view: _drop_if_dim(one, white[view.camera]) for view, one in found.items()}
        tracks = {camera: _Track.of(own, found) for camera, own in views.items()}
        moving: dict[View, Detected] = {}
        for camera, own in views.items():
            still = _find_still_objects(tracks[camera], [t for other, t in tracks.items() if other != camera])
            moving |= {view: _drop_still_objects(found[view], still) for view in own}
        steps = {camera: [moving[v].notes["step"] for v in own if len(moving[v])] for camera, own in views.items()}
        every = [step for own in steps.values() for step in own]
        usual = {
            camera: np.median(own if len(own) >= MIN_BALLS_PER_CAMERA else every)
            for camera, own in steps.items()
            if every
        }
        return {view: _drop_if_faint(moving[view], usual.get(view.camera, 0.0)) for view in found}

    def look_again(
        self, found: Mapping[View, Detected], read: Callable[[Collection[View]], Iterable[tuple[View, Grey]]]
    ) -> dict[View, Detected]:
        """Drop a ball that a camera shows now and then, where its other pictures show the same thing at that place.

        Args:
            found: What `settle` gave of each picture.
            read: Gives pictures, (height, width) grey, each once and in any order.
        """
        others = _doubtful(found)
        wanted: dict[View, list[View]] = {}
        for ball, views in others.items():
            for view in (ball, *views):
                wanted.setdefault(view, []).append(ball)
        parts: dict[View, dict[View, Grey]] = {ball: {} for ball in others}
        for view, picture in read(wanted) if wanted else ():
            for ball in wanted[view]:
                parts[ball][view] = picture[_surroundings(found[ball])].copy()  # not all of a film is kept
        kept = dict(found)
        for ball, views in others.items():
            shown = parts[ball]
            if all(view in shown and ball in shown and _are_alike(shown[view], shown[ball]) for view in views):
                u, v = found[ball].uv[0]
                kept[ball] = nothing(f"no ball: what looks like one at ({u:.0f}, {v:.0f}) is in other pictures, too")
        return kept

    def correct(self, data: Dataset) -> tuple[Dataset, list[str]]:
        """Move the pixels from the middle of the ball's outline to the ball's middle, where the radius is known.

        Args:
            data: Observations of the middles of outlines.

        Returns:
            The dataset, and notes for the user.
        """
        if self.radius is not None:
            return correct_outlines(data, self.radius, self.calibration)
        return data, [
            "the pixels are those of the ball's outline, whose middle is not quite that of the ball: "
            f"give its radius with --radius, in {data.length_unit}, and it is corrected"
        ]

    def _find_balls(self, picture: Grey, frame: _Frame, blur: float = 1.0) -> list[Edge]:
        """Different balls, the likeliest first; only where there is none, those that their shadow has displaced. blur:
        of their edges, pixels, where it is known: the fit begins there."""
        places = self._find_places(picture)
        for steep_first in (False, True):
            found = self._fit_balls(picture, places, frame, blur, steep_first=steep_first)
            if found:
                break
        return found

    def _fit_balls(
        self, picture: Grey, places: list[tuple[Floats, float]], frame: _Frame, blur: float, *, steep_first: bool
    ) -> list[Edge]:
        rough: list[Rough] = []
        for centre, radius in places:
            if not any(_overlaps(centre, one) for one in rough):
                step = MIN_STEP_BRIGHTNESS * frame.bright
                one = find_rough_edge(picture, centre, radius, step=step, steep_first=steep_first)
                if one is not None and not any(_overlaps(one.ellipse.centre, other) for other in rough):
                    rough.append(one)
        rough.sort(key=lambda one: -one.quality)
        good: list[Edge] = []
        for one in rough[:MAX_EDGES_FITTED]:
            if good and one.quality < MIN_RIVAL_QUALITY_RATIO * rough[0].quality:
                break
            edge = _fit_ball(picture, one, blur)
            if edge is not None and self._is_plausible(edge, frame):
                good.append(edge)
        return sorted(good, key=_score, reverse=True)

    def _is_plausible(self, edge: Edge, frame: _Frame) -> bool:
        """Whether a ball has a radius that was asked for, is as round as it must be there, and its plate is white."""
        long, short = edge.ellipse.axes
        return (
            self.smallest <= edge.ellipse.radius <= self.largest
            and short >= frame.least_axis_ratio(edge.ellipse.centre) * long
            and _is_before_white(edge.outer, edge.outer - edge.inner, frame.bright)
        )

    def _find_places(self, picture: Grey) -> list[tuple[Floats, float]]:
        """Where the picture is like the template: centres and rough radii, the likeliest first."""
        if self.template is not None:
            return _match_template(picture, self.template)
        cv2 = opencv()
        places: list[tuple[float, Floats, float]] = []
        small, scale = picture, 1.0
        while TEMPLATE_RADII_PX[0] * scale < self.largest and min(small.shape) > 24:
            for disc in TEMPLATE_RADII_PX:
                if self.smallest <= 1.1 * disc * scale and disc * scale <= 1.2 * self.largest:
                    places += _find_peaks(small, _draw_disc(disc), disc, scale)
            small, scale = cv2.resize(small, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), 2 * scale
        places.sort(key=lambda place: -place[0])
        return [(centre, radius) for _, centre, radius in _keep_apart(places)]


class _Frame(NamedTuple):
    """The whole picture: what counts as white in it, and its middle (2,) and diagonal, in pixels of the part that is
    searched."""

    bright: float
    middle: Floats
    diagonal: float

    @classmethod
    def of(cls, picture: Grey, low: NDArray[Any] | tuple[int, int] = (0, 0)) -> _Frame:
        """Of a picture, of which the part from pixel `low` on is searched."""
        sides = np.array(picture.shape[::-1])
        bright = float(np.quantile(picture[::4, ::4], 0.999))
        return cls(bright, (sides - 1) / 2 - np.asarray(low), float(np.linalg.norm(sides)))

    def least_axis_ratio(self, place: Floats) -> float:
        """Of the picture of a sphere there."""
        off = min(float(np.linalg.norm(place - self.middle)) / (OFF_AXIS_DIAGONALS * self.diagonal), 1.0)
        return MIN_MIDDLE_AXIS_RATIO + (MIN_AXIS_RATIO - MIN_MIDDLE_AXIS_RATIO) * off**2


def _is_like(edge: Edge, last: Detected) -> bool:
    """Whether a ball has about the step at its edge that it had; its radius was asked for."""
    ratio = (edge.outer - edge.inner) / float(last.notes["step"])
    return 1 / FOLLOWED_STEP_RATIO < ratio < FOLLOWED_STEP_RATIO


def _is_before_white(plate: float, step: float, white: float) -> bool:
    return plate > MIN_PLATE_BRIGHTNESS * white and step > MIN_STEP_BRIGHTNESS * white


def _overlaps(centre: Floats, other: Rough) -> bool:
    return float(np.linalg.norm(centre - other.ellipse.centre)) < other.ellipse.radius


def _fit_ball(picture: Grey, rough: Rough, blur: float = 1.0) -> Edge | None:
    """The edge of a ball, or None where it is not whole, round and clear."""
    edge = fit_edge(picture, rough.ellipse, blur)
    if edge is None:
        return None
    long, short = edge.ellipse.axes
    found = edge.outer - edge.inner
    good = (
        short >= MIN_AXIS_RATIO * long
        and edge.support >= MIN_EDGE_SHARE
        and edge.broken <= MAX_BROKEN_SHARE
        and edge.uneven < MAX_UNEVEN_STEPS
        and found > MIN_STEP_NOISES * edge.residual
        and edge.residual < MAX_RESIDUAL_STEPS * found
        and edge.inner < MAX_BALL_BRIGHTNESS * edge.outer
        and edge.blur < 0.45 * short
    )
    return edge if good else None


def _score(edge: Edge) -> float:
    """How much like a ball: the step at its edge, how much of the edge is there, how round."""
    long, short = edge.ellipse.axes
    return float((edge.outer - edge.inner) * edge.support**2 * np.sqrt(short / long))


def _detection_of(edge: Edge, view: View, frame: _Frame) -> Detected:
    notes = {
        "white": frame.bright,
        "plate": edge.outer,
        "score": _score(edge),
        "step": edge.outer - edge.inner,
        "radius_px": edge.ellipse.radius,
        "blur_px": edge.blur,
        "support": edge.support,
    }
    sd = np.sqrt(np.diagonal(edge.covariance))[None]
    return Detected((view.shot,), edge.ellipse.centre[None], sd, outlines=(edge.ellipse.points(),), notes=notes)


def _choose(made: list[Detected]) -> Detected:
    """The first of several, unless the second is as good."""
    best, rest = made[0], tuple(made[1:4])
    if rest and rest[0].notes["score"] > MIN_RIVAL_SCORE_RATIO * best.notes["score"]:
        (u, v), (s, t) = best.uv[0], rest[0].uv[0]
        reason = f"two balls, at ({u:.0f}, {v:.0f}) and ({s:.0f}, {t:.0f}): cover one, or take it away"
        return nothing(reason, others=(replace(best, others=()), *rest), notes={"white": best.notes["white"]})
    return replace(best, others=rest)


def _all_candidates(found: Detected) -> list[Detected]:
    return [*([replace(found, others=())] if len(found) else []), *found.others]


class _Track(NamedTuple):
    """All that may be the ball in the pictures of one camera: (k, 3) places and radii, the shot (k,) of each; and the
    shots that were taken."""

    uvr: Floats
    shot: NDArray[np.str_]
    taken: frozenset[str]

    @classmethod
    def of(cls, views: list[View], found: Mapping[View, Detected]) -> _Track:
        each = [(view.shot, ball) for view in views for ball in _all_candidates(found[view])]
        uvr = np.array([[*ball.uv[0], ball.notes["radius_px"]] for _, ball in each]).reshape(-1, 3)
        return cls(uvr, np.array([shot for shot, _ in each], dtype=np.str_), frozenset(view.shot for view in views))


def _by_camera(found: Mapping[View, Detected]) -> dict[str, list[View]]:
    cameras = dict.fromkeys(view.camera for view in found)
    return {camera: [view for view in found if view.camera == camera] for camera in cameras}


def _is_there(found: Detected, ball: Detected) -> bool:
    """Whether a ball is found within another ball's radius of that one."""
    return len(found) > 0 and float(np.linalg.norm(found.uv[0] - ball.uv[0])) < float(ball.notes["radius_px"])


def _doubtful(found: Mapping[View, Detected]) -> dict[View, list[View]]:
    """The pictures with a ball of cameras that show one now and then, and the pictures each is to be held against."""
    tracks = {camera: _Track.of(own, found) for camera, own in _by_camera(found).items()}
    others: dict[View, list[View]] = {}
    for camera, own in _by_camera(found).items():
        balls = [view for view in own if len(found[view])]
        if len(balls) > MAX_DOUBTFUL_SHARE * len(own):
            continue
        witnesses = [track for name, track in tracks.items() if name != camera]
        for ball in balls:
            against = _spread([view for view in own if not _is_there(found[view], found[ball])])
            shots = {ball.shot, *(view.shot for view in against)}
            rests = sum(_rests(track, shots) for track in witnesses) > 0.5 * len(witnesses)
            if len(against) == OTHER_PICTURES and not rests:
                others[ball] = against
    return others


def _surroundings(found: Detected) -> tuple[slice, slice]:
    """Rows and columns of a picture around a ball."""
    reach = int(np.ceil(ALIKE_RADII * float(found.notes["radius_px"])))
    u, v = np.rint(found.uv[0]).astype(int)
    return slice(max(v - reach, 0), v + reach + 1), slice(max(u - reach, 0), u + reach + 1)


def _are_alike(before: NDArray[Any], now: NDArray[Any]) -> bool:
    """Whether two parts of pictures show the same thing, brighter or darker."""
    before, now = before - before.mean(), now - now.mean()
    size = float(np.sqrt(np.mean(before**2) * np.mean(now**2)))
    return float(np.mean(before * now)) > ALIKE_CORRELATION * size


def _spread(views: list[View]) -> list[View]:
    """So many of a camera's pictures as are looked at again, far from each other."""
    at = np.linspace(0, len(views) - 1, min(OTHER_PICTURES, len(views))).round().astype(int)
    return [views[i] for i in at]


def _find_still_objects(track: _Track, others: list[_Track]) -> Floats:
    """(k, 3) places and radii where something is found in many shots of a camera that is not the ball.

    It is not where a ball is found elsewhere in most of those shots. And it is not where other cameras took those shots
    and most cameras see no ball at rest in them: a ball that rests, to test how well it is measured, rests for all.
    """
    uvr, shot, _ = track
    looked_at = len(set(shot.tolist()))
    places = []
    while len(uvr):
        near = _match_place(uvr, uvr[0])
        shots = set(shot[near].tolist())
        witnesses = [other for other in others if len(shots & other.taken) >= MIN_WITNESSED_SHOTS]
        least = MIN_WITNESSED_SHOTS if witnesses else max(MIN_STILL_SHOTS, 0.1 * looked_at)
        if len(shots) >= least:
            elsewhere = len(set(shot[~near].tolist()) & shots) > 0.5 * len(shots)
            if witnesses:
                resting = 1 + sum(_rests(other, shots) for other in witnesses)
                elsewhere |= resting <= 0.5 * (1 + len(witnesses))
            else:
                elsewhere |= len(shots) < 0.8 * looked_at
            if elsewhere:
                places.append(np.median(uvr[near], axis=0))
        uvr, shot = uvr[~near], shot[~near]
    return np.array(places).reshape(-1, 3)


def _rests(track: _Track, shots: set[str]) -> bool:
    """Whether a camera finds one thing at one place in most of some shots."""
    among = np.isin(track.shot, list(shots))
    uvr, shot = track.uvr[among], track.shot[among]
    while len(uvr):
        near = _match_place(uvr, uvr[0])
        if len(set(shot[near].tolist())) > 0.5 * len(shots & track.taken):
            return True
        uvr, shot = uvr[~near], shot[~near]
    return False


def _match_place(uvr: Floats, place: Floats) -> NDArray[np.bool_]:
    """Which of (k, 3) places and radii are this one."""
    near = np.linalg.norm(uvr[:, :2] - place[:2], axis=1) < SAME_PLACE_PX
    return np.asarray(near & (np.abs(uvr[:, 2] / place[2] - 1) < SAME_SIZE_RADII), dtype=np.bool_)


def _usual_white(found: list[Detected]) -> float:
    """The median over a camera's pictures, of those that could be read; 0 where none could."""
    each = [one.notes["white"] for one in found if "white" in one.notes]
    return float(np.median(each)) if each else 0.0


def _drop_if_dim(found: Detected, white: float) -> Detected:
    """Without what no ball's plate is behind, by what is usually white in the camera's pictures: one that does not show
    the plate may show nothing white."""
    return _keep_only(
        found,
        lambda ball: _is_before_white(ball.notes["plate"], ball.notes["step"], white),
        "is before nothing as white as the camera's other pictures show",
    )


def _drop_still_objects(found: Detected, still: Floats) -> Detected:
    return _keep_only(
        found,
        lambda ball: not _match_place(still, np.array([*ball.uv[0], ball.notes["radius_px"]])).any(),
        "is there in shot after shot",
    )


def _drop_if_faint(found: Detected, usual: float) -> Detected:
    if not len(found) or found.notes["step"] >= MIN_USUAL_STEP_RATIO * usual:
        return found
    u, v = found.uv[0]
    return nothing(f"no ball: the disc at ({u:.0f}, {v:.0f}) is much fainter than it is elsewhere")


def _keep_only(found: Detected, good: Callable[[Detected], bool], why: str) -> Detected:
    """The ball among those that are good; without any, that what looks like one is none, and why."""
    balls = _all_candidates(found)
    kept = [ball for ball in balls if good(ball)]
    if len(kept) == len(balls):
        return found
    if kept:
        return _choose(kept)
    u, v = balls[0].uv[0]
    return nothing(f"no ball: what looks like one at ({u:.0f}, {v:.0f}) {why}")


@lru_cache
def _draw_disc(radius: float) -> Grey:
    """A dark disc on a light ground, drawn with soft edges."""
    reach = int(np.ceil(1.75 * radius + 1))
    x = np.arange(-reach, reach + 1)
    distance = np.hypot(*np.meshgrid(x, x))
    return np.clip(distance - radius + 0.5, 0, 1).astype(np.float32)


def _find_peaks(picture: Grey, template: Grey, radius: float, scale: float) -> list[tuple[float, Floats, float]]:
    """Score, centre and radius, in full pixels, of the places most like a template in a picture made smaller."""
    cv2 = opencv()
    if min(picture.shape) <= max(template.shape):
        return []
    alike = cv2.matchTemplate(picture, template, cv2.TM_CCOEFF_NORMED)
    rows, columns = np.nonzero((alike > MIN_CORRELATION) & (alike == cv2.dilate(alike, np.ones((5, 5), np.uint8))))
    if len(rows) > 400:
        best = np.argsort(-alike[rows, columns])[:400]
        rows, columns = rows[best], columns[best]
    reach = template.shape[0] // 2
    ring = max(1, round(1.4 * radius))
    high = np.maximum.reduce([picture[rows + reach + dy, columns + reach + dx] for dx, dy in _COMPASS * ring])
    step = high - picture[rows + reach, columns + reach]
    centres = (np.column_stack([columns, rows]) + reach + 0.5) * scale - 0.5
    scores = alike[rows, columns] * np.maximum(step, 0)
    return [(float(s), c, radius * scale) for s, c in zip(scores, centres, strict=True)]


_COMPASS = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])


def _keep_apart(places: list[tuple[float, Floats, float]]) -> list[tuple[float, Floats, float]]:
    """The best of those that are about the same place and size."""
    kept: list[tuple[float, Floats, float]] = []
    for place in places:
        if len(kept) >= MAX_PLACES:
            break
        _, centre, radius = place
        if all(np.linalg.norm(centre - c) > 0.5 * r or not 0.6 < radius / r < 1.7 for _, c, r in kept):
            kept.append(place)
    return kept


def _match_template(picture: Grey, template: Template) -> list[tuple[Floats, float]]:
    """Where a picture is like a crop, from a third to three times its size, the likeliest first."""
    cv2 = opencv()
    size = max(template.picture.shape)
    places: list[tuple[float, Floats, float]] = []
    for zoom in np.geomspace(1 / 3, 3, 13):
        shrink = min(1.0, 24 / (size * zoom))  # enough pixels to tell one thing from another
        small = cv2.resize(picture, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
        drawn = cv2.resize(template.picture, None, fx=zoom * shrink, fy=zoom * shrink, interpolation=cv2.INTER_AREA)
        places += _find_peaks(small, drawn, template.radius * zoom * shrink, 1 / shrink)
    places.sort(key=lambda place: -place[0])
    return [(centre, radius) for _, centre, radius in _keep_apart(places)]
