"""Cameras that predict pixels from positions, with their covariance: how they measure, whatever fitted them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from implicam.dataset import Dataset, Observations
from implicam.dataset.requirements import match_cameras, observations_of
from implicam.errors import UsageError
from implicam.geometry import Bools, Floats
from implicam.measurement import Measurement, SharedErrors
from implicam.rig_model.alarm import Table, alarm_of
from implicam.rig_model.budget import Budget, uncertainty_budget
from implicam.rig_model.camera_model import apply_covariance_root
from implicam.rig_model.heavy_tails import information_loss
from implicam.rig_model.measured_pixels import MeasuredPixels
from implicam.rig_model.movement import Check, CheckedRig, check_movement
from implicam.rig_model.placement import WorldStep
from implicam.rig_model.posterior import Posterior
from implicam.rig_model.reasons import reason_codes, reasons_in_words
from implicam.rig_model.repair import Repair, all_repaired
from implicam.rig_model.settings import DEFAULT_SETTINGS, RigModelSettings
from implicam.rig_model.training_data import Frame, stated_noise, view_noise
from implicam.rig_model.triangulate import Labels, Located, locate, shared_errors
from implicam.threads import side_by_side

Locator = Callable[[Floats, Floats], Located]
"""Finds where points are from pixels (n, C, 2) and noise (n, C), in the working frame."""

LENS_KINDS = ("ordinary", "aspect")
MAX_PIXEL = 1e9
"""Of pixels given as arrays: what is farther out is as far, so that no square of it is too large for a number."""
"""Kinds of cameras that cannot follow anything that lenses do not do."""


class Sensitivity(NamedTuple):
    """How what some cameras see of n places depends on the place and on what is unknown of the cameras.

    pixels = mean + slope @ (step of the place) + half @ N(0, I) + N(0, rest + noise), r pixel coordinates together.
    cameras: their numbers in the dataset, two coordinates each; slope (n, r, 3) pixels per length unit; half (n, r, q)
    pixels; rest (n, r) variance of what is unknown besides, of every place its own; noise (n, r) variance of a view.
    """

    cameras: tuple[int, ...]
    slope: Floats
    half: Floats
    rest: Floats
    noise: Floats


@dataclass(frozen=True, eq=False)
class FittedRig:
    """Cameras that measure.

    Attributes:
        trained: What all cameras saw when they were fitted.
        length_unit: Of the world.
        frame: The working frame.
        cameras: Numbers of the cameras that could be fitted, in the order of `posterior.models`.
        posterior: What is known of them, in the working frame.
        labels: How known positions are off; None where they are not.
        misfit_adds: Residuals that are larger than the views state come from the lens models, and not from the views.
        degrees: Degrees of freedom of the noise; None where it is normal.
        settings: Which views disagree, and when that is an alarm.
        laid: Where the world was laid anew after the fit: what the fit knows of the cameras, and how uncertain the new
            world is against that of the fit. Positions are found as in that: the uncertainty of a far world would draw
            each of them elsewhere.
    """

    trained: Observations
    length_unit: str
    frame: Frame
    cameras: tuple[int, ...]
    posterior: Posterior
    labels: Labels | None = None
    misfit_adds: bool = False
    degrees: float | None = None
    settings: RigModelSettings = DEFAULT_SETTINGS
    laid: tuple[Posterior, WorldStep] | None = None

    @property
    def camera_names(self) -> tuple[str, ...]:
        """The cameras that are calibrated."""
        return tuple(self.trained.camera_names[c] for c in self.cameras)

    @property
    def follows_lenses_only(self) -> bool:
        """Whether every camera is of a kind that cannot follow anything that lenses do not do."""
        return all(model.family in LENS_KINDS for model in self.posterior.models)

    def measure(self, observations: Observations | Dataset, locator: Locator | None = None) -> Measurement:
        """Measure each point with the views it has, two or more.

        Args:
            observations: What the cameras saw, by their names; or a dataset that has it.
            locator: What finds the positions; None for `locate`, which is exact.

        Returns:
            Positions in the world with error bars, and of each point without one the reason; and the alarm, if there is
            one.

        Raises:
            DatasetError: None of the cameras is one of the calibration, or one has images of another size.
        """
        observations = self._matched(observations)
        uv, noise = self.views(observations)
        found = (locator or self.locate)(uv, noise)
        seen = np.asarray(np.isfinite(uv).all(axis=2))
        usable = seen.sum(axis=1)
        codes = reason_codes(np.isfinite(found.xyz[:, 0]), found.p, usable, observations.seen.sum(axis=1))
        measured = Measurement(
            observations.points,
            self.frame.to_world(found.xyz),
            found.cov * self.frame.scale**2,
            usable - found.left_out.sum(axis=1),
            found.p,
            reasons_in_words(codes, seen, found.left_out, self.camera_names),
            self.length_unit,
            share_calibration=found.share,
            shared=SharedErrors(partial(self._shared_errors, uv, noise, found), np.arange(len(uv)), np.eye(3)),
        )
        return measured.with_alarm(self._alarm(uv, noise, found))

    def measure_pixels(
        self, uv: ArrayLike, noise: ArrayLike | None = None, locator: Locator | None = None
    ) -> MeasuredPixels:
        """Measure points given as an array, each with the views it has, two or more.

        Args:
            uv: (n, C, 2) pixels of the calibrated cameras, in the order of `camera_names`; NaN where not seen.
            noise: Standard uncertainty of the views in pixels: a number, (C,) or (n, C); None for the usual one.
            locator: What finds the positions; None for `locate`, which is exact.

        Returns:
            Positions in the world with error bars, as arrays.

        Raises:
            UsageError: An array has another shape.
        """
        pixels = np.asarray(uv, dtype=np.float64)
        C = len(self.cameras)
        if pixels.ndim != 3 or pixels.shape[1:] != (C, 2):
            raise UsageError(
                f"pixels of the shape {pixels.shape} do not fit; (points, {C}, 2) is wanted.",
                why=f"the calibrated cameras are {', '.join(self.camera_names)}",
                fix="give u and v of each camera in this order, NaN where it did not see the point",
            )
        if (np.abs(pixels) > MAX_PIXEL).any():
            pixels = np.where(np.isinf(pixels), np.nan, np.clip(pixels, -MAX_PIXEL, MAX_PIXEL))
        sd = self.noise_of_pixels(noise, len(pixels))
        found = (locator or self.locate)(pixels, sd)
        measured = np.isfinite(found.xyz[:, 0])
        codes = np.zeros(len(pixels), dtype=np.int8)
        lost = np.flatnonzero(~measured)
        if len(lost):
            usable = np.isfinite(pixels[lost]).all(axis=2).sum(axis=1)
            codes[lost] = reason_codes(measured[lost], found.p[lost], usable, usable)
        return MeasuredPixels(
            self.frame.to_world(found.xyz), found.cov * self.frame.scale**2, found.p, codes, found.left_out,
            found.share, pixels, self.camera_names, self.length_unit, partial(self._alarm, pixels, sd, found),
        )  # fmt: skip

    def noise_of_pixels(self, noise: ArrayLike | None, n: int) -> Floats:
        """(n, C) the noise of views given as arrays, corrected; of all points alike it is not repeated in memory.

        Args:
            noise: As of `measure_pixels`.
            n: How many points.

        Raises:
            UsageError: It has another shape.
        """
        C = len(self.cameras)
        given = np.asarray(np.nan if noise is None else noise, dtype=np.float64)
        if given.shape not in ((), (C,), (n, C)):
            raise UsageError(
                f"the noise of pixels has the shape {given.shape}; a number, ({C},) or ({n}, {C}) is wanted."
            )
        rows = given if given.ndim == 2 else np.broadcast_to(given, (1, C))
        return np.broadcast_to(self.corrected_noise(rows), (n, C))

    def locate(self, uv: Floats, noise: Floats) -> Located:
        """Where points are, exactly.

        Args:
            uv: (n, C, 2) pixels of the calibrated cameras.
            noise: (n, C) of the views.

        Returns:
            In the working frame.
        """
        if self.laid is None:
            return locate(self.posterior, uv, noise, self.labels, self.degrees, self.settings)
        fitted, step = self.laid
        found = locate(fitted, uv, noise, self.labels, self.degrees, self.settings)
        E = shared_errors(fitted, uv, noise, found.xyz, found.left_out, self.labels, self.degrees, self.settings)
        if not E.shape[2]:  # nothing is measured
            return found
        cov = step.covariance(found.xyz, E, found.cov)
        left = np.trace(found.cov, axis1=1, axis2=2) / np.trace(cov, axis1=1, axis2=2)
        return found._replace(cov=cov, share=np.clip(1 - (1 - found.share) * left, 0, 1))

    def _alarm(self, uv: Floats, noise: Floats, found: Located) -> str:
        """What is wrong with a table as a whole."""
        return alarm_of(
            Table(
                tuple(self.trained.cameras[c] for c in self.cameras),
                uv,
                noise,
                found.p,
                found.left_out,
                self._agree,
                self._lines,
                self._pixels,
                checked=len(self.trained) > 0,
                settings=self.settings,
            )
        )

    def _shared_errors(self, uv: Floats, noise: Floats, found: Located, rows: NDArray[np.int64]) -> Floats:
        """(k, 3, q) of located points, in the world."""
        own = uv[rows], noise[rows], found.xyz[rows], found.left_out[rows]
        posterior = self.posterior if self.laid is None else self.laid[0]
        E = shared_errors(posterior, *own, self.labels, self.degrees, self.settings)
        if self.laid is not None and E.shape[2]:
            E = self.laid[1].shared(found.xyz[rows], E)
        return self.frame.scale * E

    def _matched(self, observations: Observations | Dataset) -> Observations:
        """What the cameras of the calibration saw."""
        observations = observations_of(observations)
        known = [name for name in self.trained.camera_names if name in observations.camera_names]
        return match_cameras(self.trained.with_cameras(known) if known else self.trained, observations)

    def _agree(self, uv: Floats) -> NDArray[np.bool_]:
        """(n,) whether all views (n, C, 2) of each point agree, with the usual noise."""
        noise = np.broadcast_to([model.noise for model in self.posterior.models], uv.shape[:2])
        found = locate(self.posterior, uv, noise, self.labels, settings=self.settings)
        return np.asarray((found.p >= self.settings.agree_p_value) & ~found.left_out.any(axis=1))

    def _lines(self, uv: Floats) -> Iterator[tuple[Floats, Floats]]:
        """Per calibrated camera the centre (3,) and directions (n, 3) of the lines of sight of pixels (n, C, 2)."""
        return (model.camera.lines(uv[:, c]) for c, model in enumerate(self.posterior.models))

    def _pixels(self, points: Floats) -> Floats:
        """(n, C, 2) where the calibrated cameras see points (n, 3) of the working frame."""
        return np.stack([model.pixel(points) for model in self.posterior.models], axis=1)

    def matched_views(self, observations: Observations | Dataset) -> tuple[Floats, Floats]:
        """`views` of observations that may have other cameras besides.

        Args:
            observations: What the cameras saw, by their names; or a dataset that has it.

        Returns:
            Pixels (n, C, 2) and noise (n, C).

        Raises:
            DatasetError: None of the cameras is one of the calibration, or one has images of another size.
        """
        return self.views(self._matched(observations))

    def views(self, observations: Observations) -> tuple[Floats, Floats]:
        """Pixels and noise of the C calibrated cameras.

        Args:
            observations: What the cameras saw, by their names; those it does not have saw nothing.

        Returns:
            Pixels (n, C, 2), NaN where not seen, and the noise (n, C) of each view, pixels.
        """
        names = observations.camera_names
        column = np.array([names.index(name) if name in names else -1 for name in self.camera_names])
        uv = observations.uv[:, column]
        uv[:, column < 0] = np.nan
        return uv, self.corrected_noise(np.where(column < 0, np.nan, view_noise(observations)[:, column]))

    def movement(self, observations: Observations | Dataset, *, level: float, seed: int = 0) -> Check | None:
        """Whether a camera moved since the calibration, from what the cameras saw of points that nobody knows.

        Args:
            observations: What the cameras saw, by their names.
            level: How often a rig that stands may raise an alarm.
            seed: Of random numbers.

        Returns:
            What was found, lengths in those of the working frame; None where no two cameras saw enough.

        Raises:
            DatasetError: None of the cameras is one of the calibration, or one has images of another size.
        """
        return self.movement_in_views(*self.matched_views(observations), level=level, seed=seed)

    def movement_in_views(self, uv: Floats, noise: Floats, *, level: float, seed: int = 0) -> Check | None:
        """The same from `views`.

        Args:
            uv: (n, C, 2) pixels of the calibrated cameras, NaN where not seen.
            noise: (n, C) sd of each view, pixels.
            level: How often a rig that stands may raise an alarm.
            seed: Of random numbers.

        Returns:
            What was found, lengths in those of the working frame; None where no two cameras saw enough.
        """
        if self.degrees is not None:  # the sd of normal noise as wide
            noise = noise * np.sqrt(self.degrees / (self.degrees - 2) if self.degrees > 2 else 3.0)
        return check_movement(CheckedRig(self.posterior, uv, noise, self.settings), level=level, seed=seed)

    def after(self, repairs: Sequence[Repair]) -> FittedRig:
        """The rig after movements of its cameras.

        Args:
            repairs: In the order of time.
        """
        posterior, labels = all_repaired(self.posterior, repairs), self.labels
        if labels is not None and labels.unknowns is not None:
            labels = labels._replace(unknowns=posterior.unknowns)
        return replace(self, posterior=posterior, labels=labels, laid=None)

    def predict(self, xyz: Floats) -> Floats:
        """Where all cameras see positions, in pixels without noise.

        Args:
            xyz: (n, 3) in the world.

        Returns:
            (n, cameras, 2); NaN where a camera does not see a position, or is not calibrated.
        """
        points = self.frame.to_working(np.asarray(xyz, dtype=np.float64))
        uv = np.full((len(points), len(self.trained.cameras), 2), np.nan)
        finite = np.isfinite(points).all(axis=1)
        where = points[finite]
        if self.labels is not None:
            where = where + self.labels.off(where)
        for number, c in enumerate(self.cameras):
            uv[finite, c] = self.posterior.models[number].pixel(where)
        return uv

    def sensitivities(self, xyz: Floats) -> list[Sensitivity]:
        """How what cameras see of positions depends on these, and on what is unknown of the cameras.

        Args:
            xyz: (n, 3) in the world.

        Returns:
            One for each calibrated camera; a single one of all cameras where errors of the known positions tie them
            together. NaN where a lens has no answer.
        """
        points = self.frame.to_working(np.asarray(xyz, dtype=np.float64))
        n, tied, loss = len(points), self.posterior.tied, information_loss(self.degrees)
        groups = [self.cameras] if tied else [(c,) for c in self.cameras]
        parts = []
        for number, group in enumerate(groups):
            r, q = 2 * len(group), len(self.posterior.root(number))
            parts.append(
                Sensitivity(group, np.empty((n, r, 3)), np.zeros((n, r, q)), np.empty((n, r)), np.empty((n, r)))
            )

        def fill(number: int) -> None:
            model, root = self.posterior.models[number], self.posterior.root(number)
            part, pair = (parts[0], slice(2 * number, 2 * number + 2)) if tied else (parts[number], slice(0, 2))
            first = int(root.any(axis=1).argmax())  # of tied cameras, the unknowns before are of others
            rows, slope = model.rows_and_slope(points)
            part.slope[:, pair] = slope / self.frame.scale
            part.half[:, pair, first:] = apply_covariance_root(rows, root[first:])
            part.rest[:, pair], part.noise[:, pair] = rows.rest[:, None], model.noise**2 * loss

        side_by_side(fill, range(len(self.cameras)))
        return parts

    def budget(self, xyz: Floats, seen: Bools) -> Budget:
        """Where the uncertainty of positions would come from, if they were measured.

        Args:
            xyz: (n, 3) in the world.
            seen: (n, calibrated cameras) which see them.

        Returns:
            In squared length units.
        """
        points = self.frame.to_working(np.asarray(xyz, dtype=np.float64))
        seen = seen & np.isfinite(self._pixels(points)).all(axis=2)
        loss = information_loss(self.degrees)
        noise = np.array([model.noise for model in self.posterior.models]) * np.sqrt(loss)
        misfit = np.array([self.misfit(number) for number in range(len(noise))])
        found = uncertainty_budget(self.posterior, points, noise, misfit, seen, self.labels)
        return Budget(found.cov * self.frame.scale**2)

    def slopes(self, xyz: Floats) -> Iterator[tuple[Floats, float, int]]:
        """How the pixels of each calibrated camera depend on positions.

        Args:
            xyz: (n, 3) in the world.

        Yields:
            The derivative of its pixels (n, 2, 3) per length unit, its noise in pixels, and its number in the dataset.
        """
        points = self.frame.to_working(np.asarray(xyz, dtype=np.float64))
        loss = float(np.sqrt(information_loss(self.degrees)))
        for c, model in zip(self.cameras, self.posterior.models, strict=True):
            yield model.predict(points)[1] / self.frame.scale, model.noise * loss, c

    def lines_of_sight(self, camera: str, uv: Floats) -> tuple[Floats, Floats]:
        """What a calibrated camera sees at pixels.

        Args:
            camera: Its name.
            uv: (n, 2) pixels.

        Returns:
            Centre (3,) and unit directions (n, 3), in the world; NaN for none.

        Raises:
            ValueError: The camera is not calibrated.
        """
        centre, rays = self.posterior.models[self.camera_names.index(camera)].camera.lines(uv)
        return self.frame.to_world(centre), rays

    def corrected_noise(self, given: Floats) -> Floats:
        """The noise of views, in pixels: as they state it, corrected as the calibration's own views were.

        Args:
            given: (n, C) of the calibrated cameras, as the views state it; NaN where they do not.

        Returns:
            (n, C), the usual noise of a camera where a view states none.
        """
        usual, stated = np.array([model.noise for model in self.posterior.models]), self.usual_stated_noise
        states = np.isfinite(given) & (given > 0)
        if not states.any():
            return np.broadcast_to(usual, given.shape)
        with np.errstate(invalid="ignore"):
            corrected = np.where(np.isfinite(stated), given * (usual / stated), given)
            if self.misfit_adds:
                added = np.sqrt(np.maximum(given**2 + usual**2 - stated**2, 0.0))
                corrected = np.where(usual > stated, added, corrected)
        return np.where(states, corrected, usual)

    def misfit(self, number: int) -> float:
        """What a camera's lens model leaves of its views, besides their noise.

        Args:
            number: Of the camera in `posterior.models`.

        Returns:
            Pixels, sd: zero where a field follows what the lens does not (`misfit_adds`). Where the views do not state
            their noise it cannot be told from a misfit, and this is the most: both together.
        """
        usual, stated = self.posterior.models[number].noise, float(np.nan_to_num(self._stated[self.cameras[number]]))
        return float(np.sqrt(max(usual**2 - stated**2, 0.0))) if self.misfit_adds else 0.0

    @property
    def usual_stated_noise(self) -> Floats:
        """(C,) of the calibrated cameras, what their own views stated for noise, in pixels; NaN where they did not."""
        return self._stated[list(self.cameras)]

    @cached_property
    def _stated(self) -> Floats:
        return stated_noise(self.trained)
