from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hiernav.nav.lidar import lidar_closeness
from hiernav.nav.occupancy import OccupancyMap
from hiernav.view import shapes

masks = hnp.arrays(bool, st.tuples(st.integers(1, 8), st.integers(1, 8)))


def area(vertices: np.ndarray, faces: np.ndarray, keep) -> float:
    """Of the triangles that `keep` picks by their normal (F, 3) [m^2]."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = 0.5 * np.cross(b - a, c - a)
    return float(np.linalg.norm(normal[keep(normal)], axis=1).sum())


@given(masks)
def test_roofs_cover_what_is_occupied_and_walls_its_border(mask):
    occupancy = OccupancyMap(mask, 0.1, (-1.0, 2.0))
    vertices, faces = shapes.extruded(occupancy, 0.3)
    padded = np.pad(mask, 1).astype(int)
    border = np.abs(np.diff(padded, axis=0)).sum() + np.abs(np.diff(padded, axis=1)).sum()
    assert area(vertices, faces, lambda n: np.abs(n[:, 2]) > 1e-9) == pytest.approx(mask.sum() * 0.01)
    assert area(vertices, faces, lambda n: np.abs(n[:, 2]) <= 1e-9) == pytest.approx(border * 0.1 * 0.3)
    if mask.any():
        rows, columns = np.nonzero(mask)
        assert vertices[:, 0].min() == pytest.approx(-1.0 + 0.1 * columns.min())
        assert vertices[:, 1].max() == pytest.approx(2.0 + 0.1 * (rows.max() + 1))


def test_the_ellipse_is_as_long_and_as_turned_as_the_covariance():
    turn = math.radians(30.0)
    axes = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    covariance = axes @ np.diag([0.04, 0.01]) @ axes.T
    corners = shapes.ellipse(np.array([1.0, 2.0]), covariance, sigmas=3.0, corners=360) - (1.0, 2.0)
    along = corners @ axes
    assert np.abs(along[:, 0]).max() == pytest.approx(0.6, rel=1e-3)
    assert np.abs(along[:, 1]).max() == pytest.approx(0.3, rel=1e-3)


def test_lidar_arcs_lie_where_the_obstacles_are():
    pose = np.array([1.0, -1.0, 0.7])
    bearing = pose[2] + math.radians(36.0 * 2.5)
    obstacle = pose[:2] + 1.2 * np.array([math.cos(bearing), math.sin(bearing)])
    closeness = lidar_closeness(pose[None], np.array([[[*obstacle, 0.3]]]))[0]
    arcs = shapes.lidar_arcs(pose, closeness, 0.0).reshape(-1, 3)[:, :2]
    nearest = pose[:2] + 0.9 * (obstacle - pose[:2]) / 1.2
    assert np.linalg.norm(arcs - nearest, axis=1).min() < 0.15
    assert shapes.lidar_arcs(pose, np.zeros(10), 0.0).shape == (0, 2, 3)
