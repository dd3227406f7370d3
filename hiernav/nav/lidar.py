"""The pseudo-lidar of the observation: closeness of obstacle points in ten sectors around the robot."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

LIDAR_BINS = 10


def lidar_closeness(pose: ArrayLike, obstacle_xy: ArrayLike) -> NDArray[np.float64]:
    """What each robot's lidar reads.

    pose: (N, 3) [x, y, yaw], world frame [m, rad].
    obstacle_xy: (N, K, 2) world frame [m], NaN where there is no obstacle. Pillars and gremlins are seen as their
        centres, walls as points every 0.1 m along their centre line: no rays are cast.
    Returns (N, 10) in [0, 1], body frame; sector i covers bearings [36 i, 36 (i + 1)) degrees, counter-clockwise from
        the heading. An obstacle at distance d reads exp(-d) in its own sector; with a in [0, 1) its place within that
        sector, the next one reads at least a exp(-d) and the previous one at least (1 - a) exp(-d), which makes the
        reading change smoothly with the bearing. Each sector keeps its maximum, an empty one reads 0.

    Raises ValueError for shapes that do not fit. A robot whose pose is not finite reads 0.
    """
    pose = np.asarray(pose, dtype=np.float64)
    points = np.asarray(obstacle_xy, dtype=np.float64)
    if pose.ndim != 2 or pose.shape[1] != 3:
        raise ValueError(f"lidar: pose has shape {pose.shape}, it must be (N, 3)")
    if points.ndim != 3 or points.shape[0] != len(pose) or points.shape[2] != 2:
        raise ValueError(f"lidar: obstacle_xy has shape {points.shape}, it must be ({len(pose)}, K, 2)")
    dx = points[..., 0] - pose[:, 0:1]
    dy = points[..., 1] - pose[:, 1:2]
    sector_angle = 2.0 * np.pi / LIDAR_BINS
    row, column = np.nonzero(np.isfinite(dx) & np.isfinite(dy) & np.isfinite(pose[:, 2:3]))
    dx, dy = dx[row, column], dy[row, column]
    closeness = np.exp(-np.hypot(dx, dy))
    place = ((np.arctan2(dy, dx) - pose[row, 2]) % (2.0 * np.pi)) / sector_angle
    sector = np.floor(place).astype(np.intp)
    alias = place - sector

    reading = np.zeros((len(pose), LIDAR_BINS))
    # sector can be 10 when rounding brings the bearing to a full turn: % puts it back at 0
    np.maximum.at(reading, (row, sector % LIDAR_BINS), closeness)
    np.maximum.at(reading, (row, (sector + 1) % LIDAR_BINS), alias * closeness)
    np.maximum.at(reading, (row, (sector - 1) % LIDAR_BINS), (1.0 - alias) * closeness)
    return reading
