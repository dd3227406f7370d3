"""The pseudo-lidar of the observation: closeness of obstacles in ten sectors around the robot."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

LIDAR_BINS = 10
PILLAR_RADIUS = 0.2  # [m]


def lidar_closeness(pose: ArrayLike, discs: ArrayLike) -> NDArray[np.float64]:
    """What each robot's lidar reads.

    pose: (N, 3) [x, y, yaw], world frame [m, rad].
    discs: (N, K, 3) centre and radius, world frame [m], NaN where there is no obstacle. Walls are rows of small discs:
        no rays are cast.
    Returns (N, 10) in [0, 1], body frame; sector i covers bearings [36 i, 36 (i + 1)) degrees, counter-clockwise from
        the heading. A pillar whose centre is at distance d reads exp(-d) in its own sector, and whatever else has its
        surface as near as that pillar reads the same, so that a reading always says how much room there is. With a in
        [0, 1) the place of the centre within that sector, the next one reads at least a times that and the previous
        one at least 1 - a times, which makes the reading change smoothly with the bearing. Each sector keeps its
        maximum, an empty one reads 0.

    Raises ValueError for shapes that do not fit. A robot whose pose is not finite reads 0.
    """
    pose = np.asarray(pose, dtype=np.float64)
    discs = np.asarray(discs, dtype=np.float64)
    if pose.ndim != 2 or pose.shape[1] != 3:
        raise ValueError(f"lidar: pose has shape {pose.shape}, it must be (N, 3)")
    if discs.ndim != 3 or discs.shape[0] != len(pose) or discs.shape[2] != 3:
        raise ValueError(f"lidar: discs has shape {discs.shape}, it must be ({len(pose)}, K, 3)")
    dx = discs[..., 0] - pose[:, 0:1]
    dy = discs[..., 1] - pose[:, 1:2]
    sector_angle = 2.0 * np.pi / LIDAR_BINS
    row, column = np.nonzero(np.isfinite(dx) & np.isfinite(dy) & np.isfinite(pose[:, 2:3]))
    dx, dy = dx[row, column], dy[row, column]
    surface = np.hypot(dx, dy) - discs[row, column, 2]
    closeness = np.exp(-np.maximum(surface + PILLAR_RADIUS, 0.0))
    place = ((np.arctan2(dy, dx) - pose[row, 2]) % (2.0 * np.pi)) / sector_angle
    sector = np.floor(place).astype(np.intp)
    alias = place - sector

    reading = np.zeros((len(pose), LIDAR_BINS))
    # sector can be 10 when rounding brings the bearing to a full turn: % puts it back at 0
    np.maximum.at(reading, (row, sector % LIDAR_BINS), closeness)
    np.maximum.at(reading, (row, (sector + 1) % LIDAR_BINS), alias * closeness)
    np.maximum.at(reading, (row, (sector - 1) % LIDAR_BINS), (1.0 - alias) * closeness)
    return reading


def surface_distance(closeness: ArrayLike) -> NDArray[np.float64]:
    """How far the surfaces are that a lidar reads [m], infinite where it reads 0."""
    closeness = np.asarray(closeness, dtype=np.float64)
    with np.errstate(divide="ignore"):
        return np.maximum(-np.log(np.clip(closeness, 0.0, 1.0)) - PILLAR_RADIUS, 0.0)
