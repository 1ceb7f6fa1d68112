"""Which views of a point are left out: as by trying all choices, at the cost of a few solutions."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from itertools import combinations

import numpy as np
import pytest

from exhaustive_views import by_trying_all
from implicam.calibrators import ForwardGP
from implicam.calibrators.forward_gp.calibration import ForwardGPCalibration
from implicam.dataset import Dataset, Observations
from implicam.rig_model.settings import DEFAULT_SETTINGS, RigModelSettings
from implicam.rig_model.triangulate import Located, _Seen, locate
from implicam.rig_model.wrong_views import (
    LinearisedViews,
    _Choices,
    exclude_wrong_views,
    max_wrong_views,
)
from implicam.simulate import build_rig, random_positions, simulate


@cache
def fitted(spec: str, robot_noise: float = 0.0) -> ForwardGPCalibration:
    rig = build_rig(spec, seed=3)
    target = random_positions(rig, 40, np.random.default_rng(1))
    return ForwardGP().fit(simulate(rig, target, seed=4, robot_noise=robot_noise))


@cache
def seen_by_all(spec: str, n: int = 30) -> Dataset:
    rig = build_rig(spec, seed=3)
    data = simulate(rig, random_positions(rig, 3 * n, np.random.default_rng(7)), seed=8)
    data = data.select(np.flatnonzero(data.observations.seen.all(axis=1))[:n])
    assert len(data) >= 20
    return data


def spoilt(uv: np.ndarray, count: int, size: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """With `count` wrong views of each point; and which."""
    draw = np.random.default_rng(seed)
    wrong = np.zeros(uv.shape[:2], dtype=bool)
    np.put_along_axis(wrong, np.argsort(draw.random(wrong.shape), axis=1)[:, :count], True, axis=1)
    angle = draw.uniform(0, 2 * np.pi, wrong.shape)
    return uv + np.where(wrong, size, 0)[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=2), wrong


CASES = [(spec, count, size) for spec, count in (("bar3", 1), ("bar4", 1), ("bar6", 2)) for size in (3, 10, 50, 300)]
CASES += [("bar6", 1, 10), ("bar6", 1, 300), ("dome8", 1, 10), ("dome8", 1, 300), ("dome8", 2, 3), ("dome8", 2, 300)]


@pytest.mark.slow
@pytest.mark.parametrize(("spec", "count", "size"), CASES)
def test_the_same_views_are_left_out_as_by_trying_all(spec: str, count: int, size: float) -> None:
    posterior = fitted(spec).posterior
    uv, noise = fitted(spec).map.views(seen_by_all(spec).observations)
    uv, wrong = spoilt(uv, count, size)
    found = locate(posterior, uv, noise)
    xyz, p, left_out = by_trying_all(posterior, uv, noise)
    np.testing.assert_array_equal(found.left_out, left_out)
    decided = left_out.any(axis=1)
    assert decided.mean() > (0.5 if spec == "bar3" else 0.9)
    np.testing.assert_allclose(found.xyz[decided], xyz[decided], rtol=1e-9)
    np.testing.assert_allclose(found.p[decided], p[decided], rtol=1e-5)
    assert (left_out[decided] == wrong[decided]).all(axis=1).mean() > 0.95


@pytest.mark.slow
@pytest.mark.parametrize("size", [3, 50])
def test_tied_cameras_too(size: float) -> None:
    calibration = fitted("bar6", 0.2)
    assert calibration.posterior.joint is not None
    uv, noise = calibration.map.views(seen_by_all("bar6").observations)
    uv, _ = spoilt(uv, 2, size)
    found = locate(calibration.posterior, uv, noise)
    _, _, left_out = by_trying_all(calibration.posterior, uv, noise)
    np.testing.assert_array_equal(found.left_out, left_out)
    assert left_out.any(axis=1).mean() > 0.9


@pytest.mark.slow
@pytest.mark.parametrize(("spec", "count"), [("dome8", 3), ("dome16", 4), ("dome16", 6)])
def test_more_than_two_wrong_views_among_many(spec: str, count: int) -> None:
    for size in (5, 300):
        uv, noise = fitted(spec).map.views(seen_by_all(spec, 20).observations)
        bad, wrong = spoilt(uv, count, size)
        found = locate(fitted(spec).posterior, bad, noise)
        right = (found.left_out == wrong).all(axis=1)
        assert right.mean() >= 0.9
        assert not (found.left_out & ~wrong)[right].any()
        clean = locate(fitted(spec).posterior, np.where(wrong[..., None], np.nan, uv), noise)
        np.testing.assert_allclose(found.xyz[right], clean.xyz[right], rtol=1e-9)


@dataclass
class Counted:
    """Points that count what is asked of them."""

    points: _Seen
    solved_rows: list[np.ndarray] = field(default_factory=list)
    linear_rows: list[np.ndarray] = field(default_factory=list)
    degrees: float | None = None
    settings: RigModelSettings = DEFAULT_SETTINGS

    def lines(self, rows):
        return self.points.lines(rows)

    def linearise(self, rows, x, seen, before=None):
        self.linear_rows.append(rows)
        return self.points.linearise(rows, x, seen, before)

    def solve(self, rows, seen):
        self.solved_rows.append(rows)
        return self.points.solve(rows, seen)


@pytest.mark.parametrize("spec", ["bar4", "dome8", "dome16"])
def test_a_wrong_view_costs_a_few_solutions_whatever_the_number_of_cameras(spec: str) -> None:
    uv, noise = fitted(spec).map.views(seen_by_all(spec, 20).observations)
    for count in (1, 2):
        if 2 * count + 1 > uv.shape[1]:
            continue
        for size in (3, 50, 300):
            bad, _ = spoilt(uv, count, size)
            points = Counted(_Seen(fitted(spec).posterior, bad, noise, None))
            n = len(bad)
            list(exclude_wrong_views(points, np.arange(n), np.isfinite(bad).all(axis=2)))
            assert sum(map(len, points.solved_rows)) <= 2.2 * n
            assert sum(map(len, points.linear_rows)) <= 3.2 * n


def dense(linear: LinearisedViews, i: int, kept: np.ndarray) -> float:
    """Chi-squared of the kept views of point i, by the normal equations."""
    C = linear.r.shape[1]
    if linear.joint is None:
        S = np.zeros((2 * C, 2 * C))
        for c in range(C):
            S[2 * c : 2 * c + 2, 2 * c : 2 * c + 2] = np.linalg.inv(linear.each[i, c])
    else:
        S = np.linalg.inv(linear.joint[i])
    rows = np.repeat(kept, 2)
    r, D, W = linear.r[i].ravel()[rows], linear.D[i].reshape(-1, 3)[rows], np.linalg.inv(S[np.ix_(rows, rows)])
    left = r - D @ np.linalg.solve(D.T @ W @ D, D.T @ W @ r)
    return float(left @ W @ left)


class Given:
    """Points that are linear."""

    degrees = None
    settings = DEFAULT_SETTINGS

    def __init__(self, linear: LinearisedViews) -> None:
        self.given = linear

    def lines(self, rows):
        return np.zeros((self.given.r.shape[1], 3)), np.full((*self.given.r.shape[:2], 3), np.nan)

    def linearise(self, rows, x, seen, before=None):
        r = np.where(seen[..., None], self.given.r[rows] - np.einsum("ncij,nj->nci", self.given.D[rows], x), 0)
        joint = None if self.given.joint is None else self.given.joint[rows]
        return LinearisedViews(r, self.given.D[rows].copy(), self.given.each[rows].copy(), joint)


@pytest.mark.parametrize("tied", [False, True])
def test_chi_squared_without_some_views_in_closed_form(tied: bool) -> None:
    draw = np.random.default_rng(5)
    n, C = 6, 7
    root = draw.normal(size=(n, 2 * C, 2 * C)) * 0.2
    S = root @ root.swapaxes(1, 2) + np.eye(2 * C)
    blocks = S.reshape(n, C, 2, C, 2)
    each = np.linalg.inv(np.stack([blocks[:, c, :, c] for c in range(C)], axis=1))
    linear = LinearisedViews(
        draw.normal(size=(n, C, 2)) * 2, draw.normal(size=(n, C, 2, 3)), each, np.linalg.inv(S) if tied else None
    )
    points = Given(linear)
    choices = _Choices.about(points, np.arange(n), np.ones((n, C), dtype=bool))
    for size in (1, 2):
        best, second = choices.two_best(np.arange(n), size)
        for i in range(n):
            groups = list(combinations(range(C), size))
            chi2 = [dense(linear, i, ~np.isin(np.arange(C), group)) for group in groups]
            order = np.argsort(chi2)
            for found, k in ((best, order[0]), (second, order[1])):
                assert tuple(found.group[i]) == groups[k]
                assert found.chi2[i] == pytest.approx(chi2[k], rel=1e-6)


def test_how_many_views_may_be_left_out() -> None:
    np.testing.assert_array_equal(max_wrong_views(np.arange(2, 13)), [0, 1, 1, 2, 2, 2, 3, 3, 4, 4, 5])


def test_two_against_two_stays_undecided() -> None:
    """Cameras 1 and 2 look at one thing, 3 and 4 at another."""
    data, calibration = seen_by_all("bar4"), fitted("bar4")
    o = data.observations
    uv = o.uv.copy()
    uv[:, 2:] = np.roll(uv, 1, axis=0)[:, 2:]
    far = np.linalg.norm(uv[:, 2:] - o.uv[:, 2:], axis=2).min(axis=1) > 20
    assert far.sum() > 15
    measured = calibration.measure(Observations(o.points, o.cameras, uv, o.sd))
    assert not measured.measured[far].any()
    assert all("contradict each other" in why or "no position" in why for why in measured.reason[far])


def test_three_against_two_are_believed() -> None:
    """Of five cameras, two look at another thing, the same."""
    data, calibration = seen_by_all("bar6"), fitted("bar6")
    o = data.observations
    uv = o.uv.copy()
    uv[:, 5] = np.nan
    uv[:, [1, 3]] = np.roll(uv, 1, axis=0)[:, [1, 3]]
    assert data.truth is not None
    far = np.linalg.norm(uv[:, [1, 3]] - o.uv[:, [1, 3]], axis=2).min(axis=1) > 20
    measured = calibration.measure(Observations(o.points, o.cameras, uv, o.sd))
    ok = far & measured.measured
    assert ok.sum() > 0.8 * far.sum()
    assert (np.abs(measured.xyz - data.truth.xyz)[ok] / measured.sd[ok]).max() < 5


def test_good_points_are_left_alone() -> None:
    uv, noise = fitted("dome8").map.views(seen_by_all("dome8").observations)
    found: Located = locate(fitted("dome8").posterior, uv, noise)
    assert (found.p > RigModelSettings.disagree_p_value).mean() > 0.95
    assert found.left_out.any(axis=1).mean() < 0.05
