"""The contracts of parts that people add, to be checked in the tests of any package; pytest is not needed.

```python
from implicam.testing import check_lens

def test_my_lens() -> None:
    check_lens(MyLens(400.0, 400.0, 639.5, 511.5, 0.1))
```

`check_robot` does the same for a robot, with a stand-in for its hardware.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import FrozenInstanceError, astuple, fields, is_dataclass
from typing import Any

import numpy as np

from implicam.errors import FitError
from implicam.hardware.contract import StandIn, check_robot
from implicam.lenses import FIRST_FIELDS, LENSES, Bools, Floats, Lens, focal_lengths

__all__ = ["StandIn", "check_lens", "check_robot", "edge_of"]

PART_OF_EDGE = 0.97
"""What a lens sees up to there must hold to the last digit; the rest is the last hair before it ends."""

MAX_ANGLE_RAD = 3.0
"""Off the axis: straight behind the camera, where directions about the axis are one, is left out."""

NARROW_RAD = 0.2
"""Up to there any family is near any lens."""

NARROW_PX = 1.0

WIDE_FOCAL_LENGTHS = 3e-3
"""How far off, rms, the nearest lens of a family may be to a lens of that same family."""

FOUND_SHARE = 0.98
"""Of pixels that are seen: the last hair before the edge may have no ray, but never a wrong one."""

PAST_USUAL_SDS = 4.0
"""How far from the mean of their prior the parameters of distortion are tried: a fit steps there."""

PAST_USUAL_LENSES = 20


def check_lens(lens: Lens, widest: float | None = None) -> None:
    """Check all that `implicam.lenses.Lens` asks of a lens. Give it two or three of a family: an ordinary one, a wide
    one, one that folds.

    Args:
        lens: with an image of some 1000 pixels: focal lengths of 200 to 2000 and a principal point about (640, 400).
        widest: the angle off the axis up to which `nearest` must find it, radians; None for 0.97 of all it sees.

    Raises:
        AssertionError: something does not hold; it says what, and gives the numbers.
    """
    with _no_warnings():
        _check_fields(lens)
        _check_middle(lens)
        _check_round_trip(lens)
        _check_direction_only(lens)
        _check_jacobian(lens)
        _check_parameter_jacobian(lens)
        _check_invalid(lens)
        _check_one_to_one(lens, _everywhere(5, 3000), FOUND_SHARE)
        _check_pixels_anywhere(lens)
        _check_prior(lens)
        _check_past_usual(lens)
        _check_nearest_narrow(lens)
        _check_nearest_wide(lens, widest)


def edge_of(lens: Lens) -> float:
    """The angle off its axis up to which a lens has pixels whatever the direction about the axis, radians.

    Args:
        lens: of any family.
    """
    theta = np.linspace(1e-3, np.pi - 1e-3, 3000)
    phi = np.linspace(0, 2 * np.pi, 24)
    rays = _rays(*(a.ravel() for a in np.meshgrid(theta, phi, indexing="ij")))
    valid = lens.pixel_from_camera_point(rays)[1].reshape(len(theta), -1).all(axis=1)
    return float(theta[valid.argmin() - 1]) if not valid.all() else float(theta[-1])


def _must(holds: Any, what: str) -> None:
    """As `assert`, which `python -O` leaves out."""
    if not holds:
        raise AssertionError(what)


@contextmanager
def _no_warnings() -> Iterator[None]:
    with warnings.catch_warnings(), np.errstate(all="warn"):
        warnings.simplefilter("error")
        try:
            yield
        except Warning as warned:
            raise AssertionError(f"nothing may warn: {warned}") from warned


def _rays(theta: Floats, phi: Floats) -> Floats:
    """(n, 3) unit vectors theta off the axis and phi about it, radians."""
    return np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


def _everywhere(seed: int, n: int) -> Floats:
    """(n, 3) directions all round, at distances over three decades."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(n, 3))
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True) * rng.uniform(0, 3, (n, 1)) ** 10)


def _inside(lens: Lens, seed: int, part: float = PART_OF_EDGE, widest: float = MAX_ANGLE_RAD) -> Floats:
    """(300, 3) points well inside what a lens sees, the axis itself included."""
    rng = np.random.default_rng(seed)
    theta, phi = rng.uniform(0, min(part * edge_of(lens), widest), 300), rng.uniform(0, 2 * np.pi, 300)
    theta[0] = 0.0
    return np.asarray(_rays(theta, phi) * rng.uniform(0.5, 500, (300, 1)))


def _unit(points: Floats) -> Floats:
    return np.asarray(points / np.linalg.norm(points, axis=1, keepdims=True))


def _close(found: Any, wanted: Any, what: str, rtol: float = 0.0, atol: float = 0.0) -> None:
    np.testing.assert_allclose(found, wanted, rtol=rtol, atol=atol, err_msg=what)


def _check_fields(lens: Lens) -> None:
    kind = type(lens)
    _must(is_dataclass(lens), f"{kind.__name__} is no dataclass")
    names = [field.name for field in fields(lens)]
    _must(tuple(names[:4]) == FIRST_FIELDS, f"the first fields must be {', '.join(FIRST_FIELDS)}; they are {names}")
    _must(isinstance(kind.family, str), "family must be a class variable, the name of the family")
    _must(kind.family and ":" not in kind.family, f"{kind.family!r} cannot name a family")
    try:
        lens.fx = lens.fx  # type: ignore[misc]
    except FrozenInstanceError:
        pass
    else:
        raise AssertionError(f"{kind.__name__} must be frozen: @dataclass(frozen=True)")
    plain = kind(*astuple(lens)[:4])
    _must(not any(astuple(plain)[4:]), "the parameters of the distortion must default to zero, which is none")


def _check_middle(lens: Lens) -> None:
    axis = np.array([[0.0, 0.0, 2.0]])
    pixel, valid = lens.pixel_from_camera_point(axis)
    _must(valid.all(), "the axis must have a pixel")
    _close(pixel[0], [lens.cx, lens.cy], "the pixel of the axis is cx, cy", atol=1e-9)
    _close(
        focal_lengths(lens),
        [lens.fx, lens.fy],
        "fx and fy are the focal lengths at the middle of the image: the jacobian at (0, 0, 1)",
        rtol=1e-9,
    )


def _check_round_trip(lens: Lens) -> None:
    points = _inside(lens, 1)
    uv, valid = lens.pixel_from_camera_point(points)
    rays, found = lens.ray_from_pixel(uv)
    _must(uv.shape == (len(points), 2), "pixels are (n, 2)")
    _must(rays.shape == (len(points), 3), "rays are (n, 3)")
    _must(valid.all(), "within 0.97 of its edge a lens has pixels")
    _must(found.all(), f"{np.sum(~found)} of {len(found)} pixels within 0.97 of the edge have no ray")
    _close(rays, _unit(points), "the ray of a point's pixel goes to the point", atol=1e-9)
    _close(lens.pixel_from_camera_point(rays)[0], uv, "the pixel of a pixel's ray is itself", rtol=1e-11, atol=1e-6)


def _check_direction_only(lens: Lens) -> None:
    points = _inside(lens, 2)
    near, far = (lens.pixel_from_camera_point(s * points)[0] for s in (1.0, 7.3))
    _close(far, near, "the pixel depends on the direction only", rtol=1e-12, atol=1e-8)
    jacobian = lens.jacobian(points)
    along = np.abs(np.einsum("nij,nj->ni", jacobian, points)).max()  # Euler: homogeneous of degree zero
    _must(along < 1e-9 * np.abs(jacobian).max() * np.abs(points).max(), "the jacobian along the ray must be zero")


def _check_jacobian(lens: Lens) -> None:
    points, h = _unit(_inside(lens, 3, part=0.9)), 1e-6
    ends = [[lens.pixel_from_camera_point(points + s * h * e)[0] for s in (1, -1)] for e in np.eye(3)]
    numeric = np.stack([(up - down) / (2 * h) for up, down in ends], axis=2)
    _close(lens.jacobian(points), numeric, "jacobian is the derivative by the point", rtol=1e-6, atol=1e-4)


def _check_parameter_jacobian(lens: Lens) -> None:
    points, at = _inside(lens, 7, part=0.9), np.array(astuple(lens))
    exact = lens.parameter_jacobian(points)
    _must(exact.shape == (len(points), 2, len(at)), f"parameter_jacobian is (n, 2, {len(at)})")
    for column, field in enumerate(fields(lens)):
        h = 1e-6 * max(abs(at[column]), 1e-2) * np.eye(len(at))[column]
        up, down = (type(lens)(*(at + s * h).tolist()).pixel_from_camera_point(points)[0] for s in (1, -1))
        both = np.isfinite(up) & np.isfinite(down)
        _close(
            exact[:, :, column][both],
            ((up - down) / (2 * h[column]))[both],
            f"parameter_jacobian is the derivative by {field.name}",
            rtol=1e-5,
            atol=1e-4,
        )


def _check_invalid(lens: Lens) -> None:
    corners = [[0, 0, 0], [0, 0, -1.0], [1.0, 0, 0], [1e-99, 0, 1e-99]]
    points = np.concatenate([_everywhere(4, 400), corners])
    valid = _check_nan(lens, points)
    _must(not valid[-len(corners)], "the camera's centre itself has no direction, and no pixel")
    nan = np.full((2, 3), np.nan)
    _must(not lens.pixel_from_camera_point(nan)[1].any(), "NaN in, NaN out")
    _must(not lens.ray_from_pixel(nan[:, :2])[1].any(), "NaN in, NaN out")
    _must(np.isnan(lens.jacobian(nan)).all(), "NaN in, NaN out")


def _check_nan(lens: Lens, points: Floats) -> Bools:
    """(n,) valid: all that is computed is finite where a point has a pixel, and NaN where it has none."""
    uv, valid = lens.pixel_from_camera_point(points)
    _must((np.isfinite(uv).all(axis=1) == valid).all(), f"pixels are NaN where valid is false, only there: {lens}")
    for name in ("jacobian", "parameter_jacobian"):
        slope = getattr(lens, name)(points)
        _must(np.isfinite(slope[valid]).all(), f"{name} must be finite where there is a pixel: {lens}")
        _must(np.isnan(slope[~valid]).any(axis=(1, 2)).all(), f"{name} must be NaN where there is no pixel: {lens}")
    return valid


def _check_one_to_one(lens: Lens, points: Floats, least: float) -> None:
    """Beyond a fold a point would land on another point's pixel: then at most one of them may be valid."""
    uv, valid = lens.pixel_from_camera_point(points)
    area = np.linalg.det(np.concatenate([lens.jacobian(points), _unit(points)[:, None]], axis=1)[valid])
    _must((area > 0).all(), f"the image turns back on itself: {lens}")
    near = valid & (np.abs(uv - [lens.cx, lens.cy]) < 2e3).all(axis=1)
    rays, found = lens.ray_from_pixel(uv[near])
    share = float(np.mean(found)) if len(found) else 1.0
    _must(share >= least, f"only {share:.0%} of the pixels seen have a ray: {lens}")
    _close(rays[found], _unit(points[near])[found], f"two points must not share a pixel: {lens}", atol=1e-4)


def _check_pixels_anywhere(lens: Lens) -> None:
    uv = np.random.default_rng(6).uniform(-1, 1, (400, 2)) * np.geomspace(1, 1e4, 400)[:, None] + [lens.cx, lens.cy]
    rays, found = lens.ray_from_pixel(uv)
    _must(np.isnan(rays[~found]).all(), "a pixel without a ray has NaN")
    _close(np.linalg.norm(rays[found], axis=1), 1.0, "rays are unit vectors", atol=1e-12)
    back = lens.pixel_from_camera_point(rays[found])[0]
    _close(back, uv[found], "any pixel has a true ray, or none", atol=2e-6)


def _check_prior(lens: Lens) -> None:
    n = len(fields(lens)) - 4
    for widest in (0.1, 0.7, 1.8):
        mean, precision = lens.distortion_prior(widest)
        _must(mean.shape == (n,), f"the mean of the prior is ({n},)")
        _must(precision.shape == (n, n), f"the precision of the prior is ({n}, {n})")
        _close(precision, precision.T, "the precision of the prior is symmetric", rtol=1e-9)
        _must(not n or np.linalg.eigvalsh(precision).min() > 0, "the precision of the prior is positive definite")


def _check_past_usual(lens: Lens) -> None:
    rng, points = np.random.default_rng(9), _unit(_everywhere(9, 400))
    mean, precision = lens.distortion_prior(0.7)
    sd = np.sqrt(np.diag(np.linalg.inv(precision)))
    for _ in range(PAST_USUAL_LENSES):
        distortion = mean + rng.uniform(-PAST_USUAL_SDS, PAST_USUAL_SDS, len(mean)) * sd
        strange = type(lens)(*astuple(lens)[:4], *distortion.tolist())
        _check_nan(strange, points)
        _check_one_to_one(strange, points, 0.0)


def _check_nearest_narrow(lens: Lens) -> None:
    """From and to a lens of every family that is registered, without distortion."""
    kind = type(lens)
    families = {**LENSES.importable(), kind.family: kind}
    for family, other in families.items():
        for start, to in ((lens, other), (other(*astuple(lens)[:4]), kind)):
            points = _inside(start, 8, widest=NARROW_RAD)
            found = to.nearest(start, points)
            _must(isinstance(found, to), f"nearest of {family} must return a {to.__name__}")
            off = found.pixel_from_camera_point(points)[0] - start.pixel_from_camera_point(points)[0]
            _must(
                np.abs(off).max() < NARROW_PX,
                f"nearest of {to.family} is off by {np.abs(off).max():.3g} px within {NARROW_RAD} radians of {start}",
            )


class _Disguised:
    """A lens whose family cannot be told."""

    family = "in disguise"

    def __init__(self, lens: Lens) -> None:
        self._lens = lens

    def __getattr__(self, name: str) -> Any:
        if name in (*FIRST_FIELDS, "pixel_from_camera_point", "jacobian", "ray_from_pixel"):
            return getattr(self._lens, name)
        raise AttributeError(f"nearest may ask a lens of another family for what `Lens` has, and not for {name!r}")


def _check_nearest_wide(lens: Lens, widest: float | None) -> None:
    points = _inside(lens, 10, widest=MAX_ANGLE_RAD if widest is None else widest)
    disguised: Any = _Disguised(lens)
    try:
        found = type(lens).nearest(disguised, points)
    except FitError as error:
        raise AssertionError(f"nearest does not find {lens} itself again: {error}") from error
    off = found.pixel_from_camera_point(points)[0] - lens.pixel_from_camera_point(points)[0]
    rms = float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    _must(rms < WIDE_FOCAL_LENGTHS * lens.fx, f"nearest is off by {rms:.3g} px (rms) from {lens} itself")
