"""Geometry of the live page: meshes and lines in the world frame [m], z up."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hiernav.nav.lidar import LIDAR_BINS, surface_distance
from hiernav.nav.occupancy import OccupancyMap

Array = NDArray[np.floating]
LIDAR_REACH = 3.0
"""Distances are drawn up to this [m]."""


def extruded(occupancy: OccupancyMap, height: float) -> tuple[Array, NDArray[np.int64]]:
    """Walls and roofs of what is occupied: vertices (V, 3) and triangles (F, 3).

    Pixels that touch in a row share a roof, and walls stand only where occupied meets free.
    """
    occupied = np.pad(occupancy.occupied, 1)
    quads = [_roofs(occupied, height), *_walls(occupied, height)]
    corners = np.concatenate(quads)
    (x, y), side = occupancy.origin, occupancy.resolution
    corners[..., :2] = corners[..., :2] * side + (x, y)
    first = 4 * np.arange(len(corners))[:, None]
    faces = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]])
    return corners.reshape(-1, 3), faces


def _runs(mask: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Row, first column and column after the last of every run of True in a padded mask."""
    steps = np.diff(mask.astype(np.int8), axis=1)
    row, begin = np.nonzero(steps == 1)
    _, end = np.nonzero(steps == -1)
    return row, begin + 1, end + 1


def _roofs(occupied: NDArray[np.bool_], height: float) -> Array:
    row, begin, end = _runs(occupied)
    x0, x1, y0, y1 = begin - 1.0, end - 1.0, row - 1.0, row + 0.0
    z = np.full(len(row), height)
    return np.stack([_points(x0, y0, z), _points(x1, y0, z), _points(x1, y1, z), _points(x0, y1, z)], axis=1)


def _walls(occupied: NDArray[np.bool_], height: float) -> list[Array]:
    walls = []
    for transposed in (False, True):
        grid = occupied.T if transposed else occupied
        for outside, offset in ((np.roll(grid, 1, axis=0), -1.0), (np.roll(grid, -1, axis=0), 0.0)):
            row, begin, end = _runs(grid & ~outside)
            a, b, line = begin - 1.0, end - 1.0, row + offset
            low, high = np.zeros(len(row)), np.full(len(row), height)
            corners = [(a, line, low), (b, line, low), (b, line, high), (a, line, high)]
            walls.append(
                np.stack([_points(v, u, z) if transposed else _points(u, v, z) for u, v, z in corners], axis=1)
            )
    return walls


def _points(x: Array, y: Array, z: Array) -> Array:
    return np.stack([x, y, z], axis=-1)


def segments(line: Array, z: float, closed: bool = False) -> Array:
    """A polyline (N, 2) as segments (N - 1, 2, 3), or (N, 2, 3) if closed."""
    points = np.column_stack([line, np.full(len(line), z)])
    if closed:
        points = np.vstack([points, points[:1]])
    return np.stack([points[:-1], points[1:]], axis=1)


def circle(center: Array, radius: float, corners: int = 40) -> Array:
    """(N, 2) corners of a circle."""
    angles = np.linspace(0.0, 2.0 * math.pi, corners, endpoint=False)
    return np.asarray(center) + radius * np.column_stack([np.cos(angles), np.sin(angles)])


def ellipse(center: Array, covariance: Array, sigmas: float = 3.0, corners: int = 40) -> Array:
    """(N, 2) corners of the ellipse at `sigmas` standard deviations of a `covariance` (2, 2) around a center (2,)."""
    values, vectors = np.linalg.eigh(covariance)
    axes = vectors * (sigmas * np.sqrt(np.maximum(values, 0.0)))
    return np.asarray(center) + circle(np.zeros(2), 1.0, corners) @ axes.T


def lidar_arcs(pose: Array, closeness: Array, z: float) -> Array:
    """An arc in each sector at the distance that its closeness stands for: (S, 2, 3) segments; none beyond reach."""
    sector = 2.0 * math.pi / LIDAR_BINS
    arcs = []
    for k, distance in enumerate(surface_distance(closeness).tolist()):
        if not distance < LIDAR_REACH:
            continue
        angles = pose[2] + sector * (k + np.linspace(0.0, 1.0, 7))
        arc = pose[:2] + distance * np.column_stack([np.cos(angles), np.sin(angles)])
        arcs.append(segments(arc, z))
    return np.concatenate(arcs) if arcs else np.zeros((0, 2, 3))


def arrow(radius: float, height: float) -> tuple[Array, NDArray[np.int64]]:
    """A wedge on top of a robot that points ahead (x): vertices and triangles."""
    top = height + 0.01
    tip, back = (radius * 0.95, 0.0), radius * 0.55
    corners = np.array([[*tip, top], [-back, back, top], [-0.2 * back, 0.0, top], [-back, -back, top]])
    return corners, np.array([[0, 1, 2], [0, 2, 3]])
