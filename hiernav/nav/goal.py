"""Whether a robot can be sent from here to there, and why not."""

from __future__ import annotations

import math

import numpy as np

from hiernav.nav.occupancy import OccupancyMap

GOAL_RADIUS = 0.3
"""A goal within this distance is reached [m]."""


class GoalRefused(ValueError):
    """A goal that cannot be driven to, with a code for machines."""

    def __init__(self, code: str, why: str) -> None:
        """`code`: goal_outside, goal_occupied, start_outside or start_occupied."""
        super().__init__(why)
        self.code = code


def place_goal(
    occupancy: OccupancyMap, start: np.ndarray, goal: np.ndarray, tolerance: float, radius: float = 0.0
) -> np.ndarray:
    """The goal itself, or where it lies in an obstacle the nearest point with room, or if there is none a free one.

    Args:
        occupancy: the map.
        start: (2,) where the robot is, world frame [m].
        goal: (2,) world frame [m].
        tolerance: how far the goal may be moved [m].
        radius: disc of the robot, for which there should be room [m].

    Returns:
        (2,) world frame [m].

    Raises:
        GoalRefused: start or goal lies outside the map or in an obstacle, and no free point is near enough.
    """
    if not occupancy.contains(start):
        raise GoalRefused("start_outside", f"the robot is at {_text(start)}, outside the map ({_extent(occupancy)})")
    if occupancy.occupied_at(start):
        raise GoalRefused("start_occupied", f"the robot is at {_text(start)}, where the map has an obstacle")
    if not occupancy.contains(goal):
        raise GoalRefused("goal_outside", f"goal {_text(goal)} lies outside the map ({_extent(occupancy)})")
    if not occupancy.occupied_at(goal):
        return np.array(goal, dtype=np.float64)
    free = _nearest_free(occupancy, goal, tolerance, radius)
    if free is None:
        raise GoalRefused(
            "goal_occupied", f"goal {_text(goal)} lies in an obstacle, and no point within {tolerance:g} m is free"
        )
    return free


def _nearest_free(occupancy: OccupancyMap, point: np.ndarray, reach: float, radius: float) -> np.ndarray | None:
    resolution, (x0, y0) = occupancy.resolution, occupancy.origin
    rows, cols = occupancy.occupied.shape
    col0, row0 = (max(math.floor((p - reach - o) / resolution), 0) for p, o in zip(point, (x0, y0), strict=True))
    col1 = min(math.ceil((point[0] + reach - x0) / resolution), cols)
    row1 = min(math.ceil((point[1] + reach - y0) / resolution), rows)
    row, col = np.nonzero(~occupancy.occupied[row0:row1, col0:col1])
    centers = np.stack([x0 + (col + col0 + 0.5) * resolution, y0 + (row + row0 + 0.5) * resolution], axis=-1)
    apart = np.linalg.norm(centers - point, axis=-1)
    centers, apart = centers[apart <= reach], apart[apart <= reach]
    if not len(apart):
        return None
    roomy = occupancy.clearance_at(centers) >= radius
    return centers[np.where(roomy | ~roomy.any(), apart, np.inf).argmin()]


def _text(point: np.ndarray) -> str:
    return f"({point[0]:g}, {point[1]:g})"


def _extent(occupancy: OccupancyMap) -> str:
    xmin, xmax, ymin, ymax = occupancy.extent
    return f"x from {xmin:g} to {xmax:g}, y from {ymin:g} to {ymax:g} m"
