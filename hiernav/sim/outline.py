"""What a robot covers seen from above: the outline of each of its parts."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_CORNERS = 32


class Outlines:
    """Outlines of the geoms of a robot, whatever its joints are doing."""

    def __init__(self, model: mujoco.MjModel) -> None:
        """KeyError if `model` has no body "robot", the root of the robot's bodies."""
        root = model.body("robot").id
        self._model = model
        self._geoms = np.flatnonzero(model.body_rootid[model.geom_bodyid] == root).tolist()
        angles = np.linspace(0.0, 2.0 * np.pi, _CORNERS, endpoint=False)
        self._directions = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(_CORNERS)])

    def __call__(self, data: mujoco.MjData) -> list[Array]:
        """Convex polygons (32, 2), counter-clockwise, world frame [m]; one for each geom, the highest last."""
        order = sorted(self._geoms, key=lambda geom: data.geom_xpos[geom, 2])
        return [self._outline(geom, data) for geom in order]

    def _outline(self, geom: int, data: mujoco.MjData) -> Array:
        rotation = data.geom_xmat[geom].reshape(3, 3)
        # the farthest point of a convex body in each direction lies on its outline
        farthest = _FARTHEST.get(int(self._model.geom_type[geom]))
        local = self._directions @ rotation
        if farthest is None:
            center, half = self._model.geom_aabb[geom].reshape(2, 3)
            points = center + half * np.sign(local)
        else:
            points = farthest(local, self._model.geom_size[geom])
        return (data.geom_xpos[geom] + points @ rotation.T)[:, :2]


def _sphere(directions: Array, size: Array) -> Array:
    return size[0] * directions


def _capsule(directions: Array, size: Array) -> Array:
    points = size[0] * directions
    points[:, 2] += size[1] * np.sign(directions[:, 2])
    return points


def _ellipsoid(directions: Array, size: Array) -> Array:
    return size**2 * directions / np.linalg.norm(size * directions, axis=1, keepdims=True)


def _cylinder(directions: Array, size: Array) -> Array:
    across = np.linalg.norm(directions[:, :2], axis=1, keepdims=True)
    points = size[0] * directions / np.maximum(across, 1e-9)
    points[:, 2] = size[1] * np.sign(directions[:, 2])
    return points


_FARTHEST: dict[int, Callable[[Array, Array], Array]] = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): _sphere,
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): _capsule,
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): _ellipsoid,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): _cylinder,
}
"""Farthest points (K, 3) of a geom in unit directions (K, 3), both in its own frame; other geoms show their box."""
