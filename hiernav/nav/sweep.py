"""Where a disc that moves along lines meets the map.

A robot that stands too close to an obstacle must be able to leave it: on its first 0.15 m a line meets nothing while
it leads no nearer to what the robot is already too close to.
"""

from __future__ import annotations

import math

import numpy as np

from hiernav.nav.occupancy import OccupancyMap

SPACING = 0.05
"""Farthest that two places may lie apart at which the disc is looked at near obstacles [m]."""
_ESCAPE = 0.15 - 1e-9
_TINY = 1e-6


def places(lines: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Where along lines a disc is looked at.

    Args:
        lines: (M, V, 2) vertices [m]; finite.

    Returns:
        points (M, P + 1, 2): from the first vertex to the last [m], at most `SPACING` apart.
        arc (M, P): lengths of the way to all but the first of them [m].
        pieces: that every segment is divided in.
    """
    steps = lines[:, 1:] - lines[:, :-1]
    lengths = np.hypot(steps[..., 0], steps[..., 1])
    # as many pieces of every segment as the longest one needs
    pieces = max(1, math.ceil(float(lengths.max(initial=0.0)) / SPACING - _TINY))
    t = np.arange(pieces) / pieces
    points = (lines[:, :-1, None] + t[:, None] * steps[:, :, None]).reshape(len(lines), -1, 2)
    arc = np.cumsum(np.repeat(lengths / pieces, pieces, axis=1), axis=1)
    return np.concatenate([points, lines[:, -1:]], axis=1), arc, pieces


def leads_out(clearance: np.ndarray, arc: np.ndarray) -> np.ndarray:
    """Whether a line leads away from what the robot at its first vertex is already too close to.

    Args:
        clearance: (M, P + 1) at the places of a line [m].
        arc: (M, P) lengths of the way to all but the first of them [m].

    Returns:
        (M, P) bool.
    """
    here, ahead = clearance[:, :1], clearance[:, 1:]
    return (arc < _ESCAPE) & (ahead >= clearance[:, :-1] - _TINY) & (ahead >= here - _TINY)


def sweep(lines: np.ndarray, occupancy: OccupancyMap, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Look at a disc at regular places of every segment of lines.

    Args:
        lines: (M, V, 2) vertices, the first of which is where a robot is, world frame [m]; finite.
        occupancy: the map.
        radius: of the disc [m].

    Returns:
        index (P,): of the places beyond the first vertex, counted in vertices (1.5 lies between the second and the
            third).
        clearance (M, P): there [m].
        meets (M, P): bool, whether the disc meets the map there.
    """
    points, arc, pieces = places(lines)
    clearance = occupancy.clearance_at(points)
    meets = (clearance[:, 1:] < radius) & ~leads_out(clearance, arc)
    return np.arange(1, arc.shape[1] + 1) / pieces, clearance[:, 1:], meets


def meets_map(occupancy: OccupancyMap, begin: tuple[float, float], end: tuple[float, float], radius: float) -> bool:
    """Whether a disc of `radius` [m] meets the map on the straight line between two points [m]; not if one is NaN.

    As `sweep` says, at a fraction of its cost for one segment: the clearance tells how far one need not look again.
    """
    (x, y), (dx, dy) = begin, (end[0] - begin[0], end[1] - begin[1])
    length = math.hypot(dx, dy)
    if not 0.0 < length < math.inf:
        return False
    dx, dy, at = dx / length, dy / length, 0.0
    here = clearance = occupancy.clearance_of(x, y)
    while clearance - radius < length - at:
        before, at = clearance, min(length, at + max(SPACING, clearance - radius))
        clearance = occupancy.clearance_of(x + at * dx, y + at * dy)
        if clearance < radius and (at >= _ESCAPE or clearance < before - _TINY or clearance < here - _TINY):
            return True
        if at >= length:
            break
    return False
