"""The search for wrong views by trying every choice: the reference that the fast one is held against."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from implicam.rig_model.posterior import Posterior
from implicam.rig_model.settings import DEFAULT_SETTINGS
from implicam.rig_model.triangulate import _Seen


def by_trying_all(posterior: Posterior, uv: np.ndarray, noise: np.ndarray, most: int = 2) -> tuple[np.ndarray, ...]:
    """Positions (n, 3), p-values (n,) and views left out (n, C) of points, up to `most` views each."""
    points = _Seen(posterior, uv, noise, None)
    seen = np.isfinite(uv).all(axis=2)
    xyz, _, p = points.solve(np.arange(len(uv)), seen)
    left_out = np.zeros_like(seen)
    for count in range(1, most + 1):
        rows = np.flatnonzero((seen.sum(axis=1) >= 2 * count + 1) & ~(p >= DEFAULT_SETTINGS.disagree_p_value))
        groups = list(combinations(range(seen.shape[1]), count))
        if not len(rows):
            continue
        tried, ps = [], np.zeros((len(rows), len(groups)))
        for k, group in enumerate(groups):
            there = seen[rows][:, group].all(axis=1)
            without = seen[rows] & there[:, None]
            without[:, group] = False
            x, _, found = points.solve(rows, without)
            ps[:, k] = np.where(there & np.isfinite(found), found, 0.0)
            tried.append(x)
        best, ordered = np.argmax(ps, axis=1), np.sort(ps, axis=1)
        for i in np.flatnonzero(
            (ordered[:, -1] > DEFAULT_SETTINGS.agree_p_value)
            & (ordered[:, -1] > DEFAULT_SETTINGS.clearly_better_ratio * ordered[:, -2])
        ):
            xyz[rows[i]], p[rows[i]] = tried[best[i]][i], ps[i, best[i]]
            left_out[rows[i], groups[best[i]]] = True
    return xyz, p, left_out
