"""The numbers of the 3D scene: where things go, which way is up. No browser."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from implicam.active import Workspace
from implicam.dataset import Floats


@dataclass(frozen=True, eq=False)
class Placing:
    """From the world to the scene, where the workspace is two units across and z is up: scale * rotation @ (x - c)."""

    centre: Floats
    scale: float
    rotation: Floats

    @classmethod
    def of(cls, low: Floats, high: Floats, up: Floats) -> Placing:
        """So that a box is two units across.

        Args:
            low: (3,) its lowest corner.
            high: (3,) its highest.
            up: (3,) a unit vector of the world.
        """
        return cls((low + high) / 2, 2.0 / float(np.linalg.norm(high - low)), turned_up(up))

    @property
    def table(self) -> dict[str, Any]:
        """For a page."""
        return {"centre": self.centre.tolist(), "scale": self.scale, "rotation": self.rotation.tolist()}

    def place(self, xyz: Floats) -> Floats:
        """Positions (..., 3) in the scene."""
        return np.asarray((xyz - self.centre) @ self.rotation.T * self.scale, dtype=np.float64)


def turned_up(up: Floats) -> Floats:
    """(3, 3) the smallest rotation that turns `up` (3,) to z; of two halves of a turn, that about x."""
    z = np.array([0.0, 0.0, 1.0])
    axis, cosine = np.cross(up, z), float(up @ z)
    if cosine < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 + cosine))


def upwards(up: Floats, along: Floats) -> Floats:
    """(3,) which way is up in the world: z, unless the pictures say that it cannot be.

    It is z where most pictures show z upwards, or where the cameras look down or up along it. Else the axis that is
    nearest to the pictures' own up.

    Args:
        up: (n, 3) unit vectors, up in the picture of each camera.
        along: (n, 3) unit vectors, where each camera looks.
    """
    z = np.array([0.0, 0.0, 1.0])
    if not len(up):
        return z
    mean, forward = up.mean(axis=0), along.mean(axis=0)
    if mean @ z >= 0.4 or forward @ z <= -0.7 or np.linalg.norm(mean) < 0.3:
        return z
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    return np.asarray(axes[int(np.argmax(axes @ mean))])


def levels(places: Floats | None) -> list[list[float]] | None:
    """The values of x, y and z of places (n, 3) in a lattice, as of a block's holes; None where they are none."""
    if places is None:
        return None
    found = [np.unique(places[:, axis]) for axis in range(3)]
    whole = np.prod([len(values) for values in found]) == len(np.unique(places, axis=0))
    return [values.tolist() for values in found] if whole else None


def edges(workspace: Workspace) -> Floats:
    """(n, 2, 3) the edges of the workspace's hull: pairs of corners on two planes that are not the same."""
    size, corners = workspace.size, workspace.vertices
    planes = np.unique(np.round(np.column_stack([workspace.normals, workspace.offsets / size]), 6), axis=0)
    on = np.abs(corners @ planes[:, :3].T - planes[:, 3] * size) < 1e-5 * size
    shared = on.astype(int) @ on.T.astype(int)
    pairs = [
        (i, j)
        for i, j in zip(*np.nonzero(np.triu(shared, 1) >= 2), strict=True)
        if np.linalg.matrix_rank(planes[on[i] & on[j], :3], tol=1e-4) >= 2
    ]
    return np.asarray(corners[np.array(pairs, dtype=int).reshape(-1, 2)], dtype=np.float64)
