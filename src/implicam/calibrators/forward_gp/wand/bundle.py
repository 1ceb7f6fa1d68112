"""The adjustment: cameras and both ends of the wand in every frame, from all views and the wand's length, eqs. (V1),
(V2) and (V4).

A view joins one camera and one place, a length the two places of a frame: so each frame has a block (6, 6) of its own,
and is eliminated by the Schur complement; what is left has the size of the cameras. No loop runs over frames. Triggs et
al. 2000, "Bundle Adjustment: A Modern Synthesis", sections 4.3 and 6.1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from implicam.geometry import Bools, Floats
from implicam.rig_model import CameraViews, CentralCamera, GeneralCamera, Prior
from implicam.rig_model.normal_equations import stable_cholesky

DEGREES = 3.0
"""Of the Student t that views and lengths are weighed by, where wrong ones are among them."""

LOST = 1e4
"""Squared residual, in noises, of a place that a camera does not see."""

MAX_STEPS = 40
RELATIVE_TOLERANCE = 1e-4
"""Part of the cost that a step must gain for another one to follow."""

UNSEEN_INFORMATION = 1e-9
"""Keeps a place that no view tells of solvable, over the largest information there is."""


class WhiteRows(NamedTuple):
    """Views of one camera in units of their noise, and their slopes: residual (n, 2), by its unknowns J (n, 2, P), by
    the place (n, 2, 3); rows (n,) numbers of the places."""

    rows: np.ndarray
    residual: Floats
    J: Floats
    by_place: Floats


class Lengths(NamedTuple):
    """Of the frames where it is used, (k,) numbers: length (k,), of a wand the same in all; sd (k,) about it."""

    frames: np.ndarray
    length: Floats
    sd: Floats

    def linear(self, places: Floats) -> tuple[Floats, Floats]:
        """Residuals (k,) in sds, and their slopes (k, 6) by both places.

        Args:
            places: (F, 2, 3).
        """
        across = places[self.frames, 1] - places[self.frames, 0]
        size = np.linalg.norm(across, axis=1)
        unit = across / np.maximum(size, 1e-12)[:, None]
        return (self.length - size) / self.sd, np.concatenate([-unit, unit], axis=1) / self.sd[:, None]


class FrameEquations(NamedTuple):
    """Normal equations of cameras and frames: A (P, P), b (P,) of the cameras; H (F, 6, 6), g (F, 6) of the frames; G
    (F, 6, P) of both; squares, what they are the second derivatives of."""

    A: Floats
    b: Floats
    H: Floats
    g: Floats
    G: Floats
    squares: float

    @classmethod
    def of(cls, white: Sequence[WhiteRows], frames: int, lengths: tuple[np.ndarray, Floats, Floats]) -> FrameEquations:
        """From views and lengths, without priors.

        Args:
            white: Per camera.
            frames: Their number F.
            lengths: Frames (k,), residuals (k,) and slopes (k, 6) of lengths.
        """
        sizes = [one.J.shape[2] for one in white]
        starts = np.concatenate([[0], np.cumsum(sizes)])
        P = int(starts[-1])
        A, b, squares = np.zeros((P, P)), np.zeros(P), 0.0
        own, pull, G = np.zeros((2 * frames, 3, 3)), np.zeros((2 * frames, 3)), np.zeros((2 * frames, 3, P))
        for c, one in enumerate(white):
            part = slice(starts[c], starts[c + 1])
            flat, y = one.J.reshape(-1, sizes[c]), one.residual.ravel()
            A[part, part] = flat.T @ flat
            b[part] = flat.T @ y
            squares += float(y @ y)
            across = one.by_place.swapaxes(1, 2)
            own[one.rows] += across @ one.by_place  # a camera sees a place once
            pull[one.rows] += (across @ one.residual[..., None])[..., 0]
            G[one.rows, :, part] = across @ one.J
        H, g = np.zeros((frames, 6, 6)), pull.reshape(frames, 6)
        H[:, :3, :3], H[:, 3:, 3:] = own[0::2], own[1::2]
        where, off, slope = lengths
        H[where] += slope[:, :, None] * slope[:, None, :]
        g[where] += slope * off[:, None]
        squares += float(off @ off)
        H[:, range(6), range(6)] += UNSEEN_INFORMATION * float(np.max(H, initial=1e-300))
        return cls(A, b, H, g, G.reshape(frames, 6, P), squares)

    def halved(self, damping: float = 0.0) -> tuple[Floats, Floats, Floats]:
        """Frames eliminated: L (F, 6, 6) of H = L L^T, L^-1 G (6 F, P), and L^-1 g (6 F,).

        Args:
            damping: Part of its diagonal that is added to H.
        """
        H = self.H
        scale = 1 / np.sqrt(np.einsum("fii->fi", H) * (1 + damping))
        unit = H * scale[:, :, None] * scale[:, None, :]
        unit[:, range(6), range(6)] = 1.0
        L = stable_cholesky(unit) / scale[:, :, None]
        both = np.concatenate([self.G, self.g[..., None]], axis=2)
        half = np.linalg.solve(L, both).reshape(-1, both.shape[2])
        return L, half[:, :-1], half[:, -1]


@dataclass(frozen=True, eq=False)
class Bundle:
    """Cameras, places (F, 2, 3) of the markers, priors of the cameras; nothing but lenses."""

    cameras: tuple[CentralCamera | GeneralCamera, ...]
    places: Floats
    priors: tuple[Prior, ...]

    def adjusted(
        self,
        seen: Sequence[CameraViews],
        noise: Floats,
        lengths: Lengths,
        *,
        robust: bool,
        max_steps: int = MAX_STEPS,
        tolerance: float = RELATIVE_TOLERANCE,
    ) -> Bundle:
        """Levenberg-Marquardt from here.

        Args:
            seen: Per camera the views to use.
            noise: (C,) px, of a view with the camera's usual noise.
            lengths: Those to use.
            robust: Views and lengths have a Student t, and not normal errors.
            max_steps: At most.
            tolerance: Part of the cost that a step must gain for another one to follow.
        """
        cost, damping, bundle = self.cost(seen, noise, lengths, robust=robust), 1e-3, self
        for _ in range(max_steps):
            equations = bundle._equations(seen, noise, lengths, robust=robust)
            before = cost
            while damping < 1e6:
                trial = bundle._stepped(equations, damping)
                now = np.inf if trial is None else trial.cost(seen, noise, lengths, robust=robust)
                if trial is not None and now < cost:
                    bundle, cost, damping = trial, now, max(damping / 6, 1e-9)
                    break
                damping *= 5
            if not cost < before * (1 - tolerance):
                break
        return bundle

    def cost(self, seen: Sequence[CameraViews], noise: Floats, lengths: Lengths, *, robust: bool) -> float:
        """Minus twice the log posterior, up to a constant.

        Args:
            seen: Per camera the views to use.
            noise: (C,) px.
            lengths: Those to use.
            robust: As of `adjusted`.
        """
        flat, total = self.places.reshape(-1, 3), 0.0
        for camera, views, sd, prior in zip(self.cameras, seen, noise, self.priors, strict=True):
            if not camera.sane:
                return np.inf
            r = (views.uv - camera.pixel(flat[views.rows])) / (sd * views.relative)[:, None]
            squared = np.nan_to_num(np.sum(r**2, axis=1), nan=LOST)
            total += float(np.sum((DEGREES + 2) * np.log1p(squared / DEGREES) if robust else squared))
            off = prior.mean - camera.parameters
            total += float(off @ prior.precision @ off)
        squared = lengths.linear(self.places)[0] ** 2
        total += float(np.sum((DEGREES + 1) * np.log1p(squared / DEGREES) if robust else squared))
        return total if np.isfinite(total) else np.inf

    def white(self, seen: Sequence[CameraViews], noise: Floats) -> list[WhiteRows]:
        """The views in units of their noise; those of a place that a camera does not see are zero.

        Args:
            seen: Per camera.
            noise: (C,) px.
        """
        flat = self.places.reshape(-1, 3)
        found = []
        for camera, views, sd in zip(self.cameras, seen, noise, strict=True):
            view = camera.view(flat[views.rows])
            unit = (sd * views.relative)[:, None]
            r, J, D = (views.uv - view.uv) / unit, view.by_parameters / unit[..., None], view.by_point / unit[..., None]
            found.append(WhiteRows(views.rows, np.nan_to_num(r), np.nan_to_num(J), np.nan_to_num(D)))
        return found

    def _equations(
        self, seen: Sequence[CameraViews], noise: Floats, lengths: Lengths, *, robust: bool
    ) -> FrameEquations:
        white, (off, slope) = self.white(seen, noise), lengths.linear(self.places)
        if robust:
            for i, one in enumerate(white):
                w = np.sqrt((DEGREES + 2) / (DEGREES + np.sum(one.residual**2, axis=1)))
                white[i] = WhiteRows(
                    one.rows, one.residual * w[:, None], one.J * w[:, None, None], one.by_place * w[:, None, None]
                )
            w = np.sqrt((DEGREES + 1) / (DEGREES + off**2))
            off, slope = off * w, slope * w[:, None]
        found = FrameEquations.of(white, len(self.places), (lengths.frames, off, slope))
        start = 0
        for camera, prior in zip(self.cameras, self.priors, strict=True):
            part = slice(start, start + camera.size)
            found.A[part, part] += prior.precision
            found.b[part] += prior.precision @ (prior.mean - camera.parameters)
            start += camera.size
        return found

    def _stepped(self, equations: FrameEquations, damping: float) -> Bundle | None:
        try:
            L, G, g = equations.halved(damping)
            A = equations.A - G.T @ G
            A[np.diag_indices_from(A)] += damping * np.diag(equations.A)
            scale = 1 / np.sqrt(np.maximum(np.diag(A), np.finfo(float).tiny))
            unit = A * scale[:, None] * scale
            step = scale * np.linalg.solve(unit + 1e-12 * np.eye(len(unit)), scale * (equations.b - G.T @ g))
        except np.linalg.LinAlgError:
            return None
        back = (g - G @ step).reshape(-1, 6, 1)
        places = self.places + np.linalg.solve(L.swapaxes(1, 2), back)[..., 0].reshape(-1, 2, 3)
        if not (np.isfinite(step).all() and np.isfinite(places).all()):
            return None
        ends = np.cumsum([camera.size for camera in self.cameras])[:-1]
        cameras = tuple(camera.moved(part) for camera, part in zip(self.cameras, np.split(step, ends), strict=True))
        return replace(self, cameras=cameras, places=places)

    def errors(self, seen: Sequence[CameraViews]) -> list[Floats]:
        """Per camera (n,) px, how far each of its views is off; infinite where it sees nothing.

        Args:
            seen: Per camera.
        """
        flat = self.places.reshape(-1, 3)
        away = (
            np.linalg.norm(camera.pixel(flat[views.rows]) - views.uv, axis=1)
            for camera, views in zip(self.cameras, seen, strict=True)
        )
        return [np.where(np.isfinite(one), one, np.inf) for one in away]


def rows_of(mask: Bools, seen: CameraViews) -> CameraViews:
    """The views of places that are used.

    Args:
        mask: (2 F,) which places.
        seen: Of one camera.
    """
    return seen.select(mask[seen.rows])
