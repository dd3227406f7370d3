"""The lidar reads what the original environment's lidar reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hiernav.nav.lidar import PILLAR_RADIUS, lidar_closeness, surface_distance

REFERENCE = Path(__file__).parents[1] / "data" / "reference" / "lidar.npz"


def pillars(centers: object) -> np.ndarray:
    """Centres (N, K, 2) -> discs (N, K, 3) of the reference's size."""
    centers = np.asarray(centers, dtype=float)
    return np.concatenate((centers, np.full((*centers.shape[:2], 1), PILLAR_RADIUS)), axis=-1)


def test_400_reference_cases_are_met() -> None:
    with np.load(REFERENCE) as cases:
        readings = lidar_closeness(cases["robot_xy_yaw"], pillars(cases["obstacle_xy"]))
        assert readings.shape == (400, 10)
        assert np.abs(readings - cases["closeness"]).max() < 1e-9


def test_an_obstacle_ahead_reads_in_the_first_sector_and_its_right_neighbour() -> None:
    reading = lidar_closeness([[1.0, 2.0, np.pi / 2]], pillars([[[1.0, 3.0]]]))[0]
    expected = np.zeros(10)
    expected[[0, 9]] = np.exp(-1.0)
    assert reading == pytest.approx(expected, abs=1e-12)


def test_an_obstacle_in_the_middle_of_a_sector_reads_half_in_both_neighbours() -> None:
    bearing = np.radians(36.0 * 3 + 18.0)
    reading = lidar_closeness([[0.0, 0.0, 0.0]], pillars([[[np.cos(bearing), np.sin(bearing)]]]))[0]
    assert reading[[2, 3, 4]] == pytest.approx(np.exp(-1.0) * np.array([0.5, 1.0, 0.5]))
    assert reading.sum() == pytest.approx(2.0 * np.exp(-1.0))


@given(st.integers(0, 2**32 - 1), st.floats(-10.0, 10.0), st.floats(-5.0, 5.0))
def test_the_reading_moves_with_the_robot(seed: int, turn: float, shift: float) -> None:
    rng = np.random.default_rng(seed)
    pose, points = rng.uniform(-2, 2, (3, 3)), rng.uniform(-3, 3, (3, 8, 2))
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    moved = np.concatenate((pose[:, :2] @ rotation.T + shift, pose[:, 2:] + turn), axis=1)
    # also at a sector's edge, where rounding decides the sector: the reading has no step there
    there = lidar_closeness(moved, pillars(points @ rotation.T + shift))
    assert there == pytest.approx(lidar_closeness(pose, pillars(points)), abs=1e-9)


def test_absent_obstacles_and_their_order_change_nothing() -> None:
    rng = np.random.default_rng(0)
    pose, points = rng.uniform(-2, 2, (5, 3)), rng.uniform(-3, 3, (5, 6, 3))
    padded = np.concatenate((np.full((5, 3, 3), np.nan), points[:, ::-1], np.full((5, 1, 3), np.nan)), axis=1)
    assert (lidar_closeness(pose, padded) == lidar_closeness(pose, points)).all()
    assert (lidar_closeness(pose, np.full((5, 4, 3), np.nan)) == 0.0).all()
    assert (lidar_closeness(pose, np.zeros((5, 0, 3))) == 0.0).all()


def test_an_obstacle_on_the_robot_reads_1() -> None:
    assert lidar_closeness([[0.3, 0.4, 0.0]], pillars([[[0.3, 0.4]]])).max() == 1.0
    assert lidar_closeness([[0.3, 0.4, 0.0]], [[[0.5, 0.4, 1.0]]]).max() == 1.0


@given(radius=st.floats(0.0, 1.0), gap=st.floats(0.01, 3.0))
def test_surfaces_as_near_read_the_same_whatever_they_are_of(radius: float, gap: float) -> None:
    reading = lidar_closeness(np.zeros((1, 3)), [[[gap + radius, 0.0, radius]]])[0]
    assert reading == pytest.approx(lidar_closeness(np.zeros((1, 3)), pillars([[[gap + PILLAR_RADIUS, 0.0]]]))[0])
    assert surface_distance(reading)[0] == pytest.approx(gap)
    assert surface_distance(0.0) == np.inf


def test_a_pose_that_is_not_finite_blinds_its_row_only() -> None:
    reading = lidar_closeness([[np.nan, 0.0, 0.0], [0.0, 0.0, np.nan], [0.0, 0.0, 0.0]], pillars(np.ones((3, 1, 2))))
    assert (reading[:2] == 0.0).all() and reading[2].max() == pytest.approx(np.exp(-np.sqrt(2.0)))


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ValueError, match=r"\(2, 2\)"):
        lidar_closeness(np.zeros((2, 2)), np.zeros((2, 3, 3)))
    with pytest.raises(ValueError, match=r"\(2, K, 3\)"):
        lidar_closeness(np.zeros((2, 3)), np.zeros((3, 3, 3)))
