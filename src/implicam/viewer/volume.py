"""The uncertainty in the workspace as a field on a grid, from the places where it is judged: for the page's volume."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from implicam.active import Workspace
from implicam.dataset import Floats
from implicam.formatting import json_safe

STEPS = 9
"""Of the grid along each axis."""

MIN_PLACES = 20
"""At which something can be measured."""


def volume(workspace: Workspace, judged: Floats, fields: Mapping[str, Floats]) -> dict[str, Any] | None:
    """Fields on a grid over the workspace, between the places linear in their logarithm.

    Args:
        workspace: What it is about.
        judged: (n, 3) places in the world.
        fields: Name -> (n,) values above zero; NaN where nothing can be measured.

    Returns:
        `axes`: x, y and z; `maps`: name -> values, x slowest, None where the nearest place has none. None where the
        workspace is no box along the axes, or hardly anything can be measured.
    """
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
    from scipy.spatial import Delaunay

    low, high = workspace.vertices.min(axis=0), workspace.vertices.max(axis=0)
    axes = [np.linspace(a, b, STEPS) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    values = np.log(np.stack(list(fields.values()), axis=1))
    known = np.isfinite(values).all(axis=1)
    if not workspace.inside(grid).all() or known.sum() < MIN_PLACES:
        return None
    scale = high - low
    near = NearestNDInterpolator(judged / scale, known.astype(np.float64))(grid / scale) > 0.5
    between = LinearNDInterpolator(Delaunay(judged[known] / scale), values[known])(grid / scale)
    nearest = NearestNDInterpolator(judged[known] / scale, values[known])(grid / scale)
    found = np.exp(np.where(np.isfinite(between), between, nearest))  # the nearest one beside the outermost places
    found[~near] = np.nan
    maps = {name: json_safe(found[:, k].tolist()) for k, name in enumerate(fields)}
    return {"axes": [axis.tolist() for axis in axes], "maps": maps}
