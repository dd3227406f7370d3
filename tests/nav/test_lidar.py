"""The lidar reads what the original environment's lidar reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hiernav.nav.lidar import lidar_closeness

REFERENCE = Path(__file__).parents[1] / "data" / "reference" / "lidar.npz"


def test_400_reference_cases_are_met() -> None:
    with np.load(REFERENCE) as cases:
        readings = lidar_closeness(cases["robot_xy_yaw"], cases["obstacle_xy"])
        assert readings.shape == (400, 10)
        assert np.abs(readings - cases["closeness"]).max() < 1e-9


def test_an_obstacle_ahead_reads_in_the_first_sector_and_its_right_neighbour() -> None:
    reading = lidar_closeness([[1.0, 2.0, np.pi / 2]], [[[1.0, 3.0]]])[0]
    expected = np.zeros(10)
    expected[[0, 9]] = np.exp(-1.0)
    assert reading == pytest.approx(expected, abs=1e-12)


def test_an_obstacle_in_the_middle_of_a_sector_reads_half_in_both_neighbours() -> None:
    bearing = np.radians(36.0 * 3 + 18.0)
    reading = lidar_closeness([[0.0, 0.0, 0.0]], [[[np.cos(bearing), np.sin(bearing)]]])[0]
    assert reading[[2, 3, 4]] == pytest.approx(np.exp(-1.0) * np.array([0.5, 1.0, 0.5]))
    assert reading.sum() == pytest.approx(2.0 * np.exp(-1.0))


@given(st.integers(0, 2**32 - 1), st.floats(-10.0, 10.0), st.floats(-5.0, 5.0))
def test_the_reading_moves_with_the_robot(seed: int, turn: float, shift: float) -> None:
    rng = np.random.default_rng(seed)
    pose, points = rng.uniform(-2, 2, (3, 3)), rng.uniform(-3, 3, (3, 8, 2))
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    moved = np.concatenate((pose[:, :2] @ rotation.T + shift, pose[:, 2:] + turn), axis=1)
    # also at a sector's edge, where rounding decides the sector: the reading has no step there
    assert lidar_closeness(moved, points @ rotation.T + shift) == pytest.approx(lidar_closeness(pose, points), abs=1e-9)


def test_absent_obstacles_and_their_order_change_nothing() -> None:
    rng = np.random.default_rng(0)
    pose, points = rng.uniform(-2, 2, (5, 3)), rng.uniform(-3, 3, (5, 6, 2))
    padded = np.concatenate((np.full((5, 3, 2), np.nan), points[:, ::-1], np.full((5, 1, 2), np.nan)), axis=1)
    assert (lidar_closeness(pose, padded) == lidar_closeness(pose, points)).all()
    assert (lidar_closeness(pose, np.full((5, 4, 2), np.nan)) == 0.0).all()
    assert (lidar_closeness(pose, np.zeros((5, 0, 2))) == 0.0).all()


def test_an_obstacle_on_the_robot_reads_1() -> None:
    assert lidar_closeness([[0.3, 0.4, 0.0]], [[[0.3, 0.4]]]).max() == 1.0


def test_a_pose_that_is_not_finite_blinds_its_row_only() -> None:
    reading = lidar_closeness([[np.nan, 0.0, 0.0], [0.0, 0.0, np.nan], [0.0, 0.0, 0.0]], np.ones((3, 1, 2)))
    assert (reading[:2] == 0.0).all() and reading[2].max() == pytest.approx(np.exp(-np.sqrt(2.0)))


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ValueError, match=r"\(2, 2\)"):
        lidar_closeness(np.zeros((2, 2)), np.zeros((2, 3, 2)))
    with pytest.raises(ValueError, match=r"\(2, K, 2\)"):
        lidar_closeness(np.zeros((2, 3)), np.zeros((3, 3, 2)))
