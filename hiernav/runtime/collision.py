"""How soon a robot would touch the known map if it kept its velocity."""

from __future__ import annotations

import math

from hiernav.nav.occupancy import OccupancyMap

STANDING = 0.05
"""A robot slower than this collides with nothing [m/s]."""
_LEAST_STEP = 0.025


def time_to_collision(
    occupancy: OccupancyMap, position: tuple[float, float], velocity: tuple[float, float], radius: float, horizon: float
) -> float:
    """Time until a disc that keeps its velocity meets an obstacle or the border.

    The line ahead is walked in steps as long as the clearance allows. An obstacle that the disc meets already counts
    only while the way leads nearer to it, so that a robot may always get away.

    Args:
        occupancy: the map.
        position: x, y [m].
        velocity: [m/s].
        radius: of the disc [m].
        horizon: time that is looked ahead [s].

    Returns:
        [s]; inf beyond the horizon and for a robot that stands.
    """
    speed = math.hypot(*velocity)
    if not STANDING < speed < math.inf:
        return math.inf
    (x, y), (dx, dy) = position, (velocity[0] / speed, velocity[1] / speed)
    field, resolution, (x0, y0) = occupancy.clearance, occupancy.resolution, occupancy.origin
    rows, cols = field.shape
    limit, travelled = speed * horizon, 0.0
    before = math.inf  # clearance at the step before, where that met an obstacle
    while travelled <= limit:
        # by whole pixels: along a wall, a clearance that falls by less is no obstacle that is approached
        row = math.floor((y + travelled * dy - y0) / resolution)
        col = math.floor((x + travelled * dx - x0) / resolution)
        clearance = float(field[row, col]) if 0 <= row < rows and 0 <= col < cols else 0.0
        room = clearance - radius
        if room <= 0.0 and travelled > 0.0 and (clearance < before or clearance == 0.0):
            return max(travelled + room, 0.0) / speed
        before = clearance if room <= 0.0 else math.inf
        travelled += max(room, _LEAST_STEP)
    return math.inf
