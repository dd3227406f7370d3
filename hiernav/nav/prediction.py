"""Maps as they will be: what moves is found by comparing maps, and drawn where it will be when the robot comes there.

A map tells where obstacles are, not where they go. A plan around the place where something is now may lead to where it
will be; here that is known before the robot is on its way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hiernav.nav.occupancy import OccupancyMap
from hiernav.nav.opencv import cv2

AHEAD_S = 0.9
"""How far ahead a map is predicted [s]: about what a robot takes for the half of a plan that it follows."""
WINDOW_S = 1.2
"""How long obstacles are watched [s]."""
LOOK_S = 0.1
"""How often maps are compared at most [s]."""
GAP_S = 0.35
"""Maps that come more rarely than this are not compared; one that has not changed for as long is taken as it is [s]."""
NEAR_M, NEAR_PIXELS = 4.0, 160
"""Obstacles that reach farther than the lesser of both from the robot in x or y are not predicted."""
LARGEST_M = 1.0
"""Obstacles longer than this in x or y are not predicted [m]: what a map shows of a wall is what was in sight."""
MOST = 128
"""With more obstacles than this near the robot none is predicted."""

_LEAST_SIGHTINGS, _LEAST_SPAN_S = 3, 0.2
"""An obstacle that was seen more rarely or for a shorter time is taken to stand."""
_RECENT_S, _ASTRAY = 0.25, 0.5
"""So is one that is not where it should have come to of late, by this share of that way: it has stopped, or turned."""
_LEAST_SPEED = 0.08
"""So is a slower one [m/s]."""
_FARTHEST_M = 0.3
"""What is farther from where an obstacle was on the last map is another one [m]."""
_SAME_SHAPE = 1.5
"""So is one with a side that is nearer to its centre, or farther, than at first by more than this, in pixels."""
_DRIFT = 0.5
"""An obstacle whose sides have not moved along with its centre, up to this share of its way, stands and is covered."""
_CENTER_ERROR = 0.1
"""Of an obstacle on a grid, in pixels."""
_ACCELERATION = 0.5
"""What is expected across the way before it is seen [m/s^2]."""


class MapPredictor:
    """Predicts the map of one robot; obstacles keep their speed and their rate of turn.

    An obstacle is a connected set of occupied pixels. It is known again by its place and its shape, and is taken to
    stand until it has been seen to move for a while. What moves is shifted by whole pixels; if it is on its way to the
    robot it is drawn at both ends, so that no plan leads through it. All else is left as it is, and a map on which
    nothing moves is its own prediction. What stops is shown where it stands again within 0.3 s, or after `GAP_S` if the
    map does not change any more.
    """

    def __init__(self, radius: float = 0.1) -> None:
        """`radius` is the robot's [m]."""
        self._radius = radius
        self.reset()

    def reset(self) -> None:
        """Forget what was seen."""
        self._map: OccupancyMap | None = None
        self._changed = -np.inf
        """When the map became what it is [s]."""
        self._forget()

    def _forget(self) -> None:
        self._predicted: OccupancyMap | None = None
        """The map ahead, if something moves."""
        self._times = np.zeros(0)
        """(T,) when was looked [s], the newest last."""
        self._centers = np.zeros((0, 0), np.complex128)
        """(B, T) x + iy of the obstacles of the newest map, world frame [m]; NaN before they were known."""
        self._sides = np.zeros((0, 2), np.complex128)
        """(B, 2) left + i lower and right + i upper side, from the centre, when each was seen first [m]."""
        self._drifts = np.zeros(0)
        """(B,) by how much one of these differs now [m]."""

    def __call__(self, occupancy: OccupancyMap, stamp: float, position: np.ndarray) -> OccupancyMap:
        """The map to plan on.

        Args:
            occupancy: as it is now; the same object while nothing has moved.
            stamp: now, on any clock [s].
            position: (2,) of the robot, world frame [m].

        Returns:
            The map as it will be, and the same object until there is a better one.
        """
        before, gap = self._map, stamp - self._changed
        if before is not occupancy:
            self._map, self._changed = occupancy, stamp
            if before is None or not (0.0 < gap <= GAP_S and np.isfinite(position).all() and _alike(before, occupancy)):
                self._forget()
            elif not len(self._times) or stamp - self._times[-1] >= LOOK_S - 1e-6:
                self._look(occupancy, stamp, position)
        elif len(self._times) and not 0.0 <= gap <= GAP_S:
            self._forget()
        return occupancy if self._predicted is None else self._predicted

    def _look(self, occupancy: OccupancyMap, stamp: float, position: np.ndarray) -> None:
        obstacles = _Obstacles.near(occupancy, position)
        self._watch(stamp, obstacles.centers, obstacles.sides, occupancy.resolution)
        velocity, turn = self._motions(occupancy.resolution)
        # at five points of its way, the first of which is where it is
        ways = velocity[:, None] * _arc(turn[:, None], np.linspace(0.0, AHEAD_S, 5))
        apart = np.abs(obstacles.centers[:, None] + ways - complex(*position)).min(axis=1)
        # the pixels of an obstacle reach up to one farther than it does itself
        size = obstacles.sides[:, 1] - obstacles.sides[:, 0]
        half = 0.5 * np.maximum(size.real, size.imag) - occupancy.resolution
        self._predicted = obstacles.shifted(ways[:, -1], apart < half + self._radius)

    def _watch(self, stamp: float, centers: np.ndarray, sides: np.ndarray, resolution: float) -> None:
        """Find the obstacles (B,) of a new map among those of the last one."""
        times, known = self._times, np.full((len(centers), len(self._times)), np.nan, np.complex128)
        drifts = np.zeros(len(centers))
        if len(centers) and len(self._sides):
            other = np.abs((sides[:, None] - self._sides).view(np.float64)).max(axis=-1)
            apart = np.abs(centers[:, None] - self._centers[:, -1])
            apart[other > _SAME_SHAPE * resolution] = np.inf
            each, nearest = np.arange(len(centers)), apart.argmin(axis=1)
            same = (apart.argmin(axis=0)[nearest] == each) & (apart[each, nearest] <= _FARTHEST_M)
            known[same] = self._centers[nearest[same]]
            sides = np.where(same[:, None], self._sides[nearest], sides)
            drifts[same] = other[each, nearest][same]
        first = int(np.searchsorted(times, stamp - WINDOW_S - 1e-6))
        self._times = np.append(times[first:], stamp)
        self._centers = np.concatenate([known[:, first:], centers[:, None]], axis=1)
        self._sides, self._drifts = sides, drifts

    def _motions(self, resolution: float) -> tuple[np.ndarray, np.ndarray]:
        """Velocity (B,) x + iy [m/s] and rate of turn (B,) [rad/s] of each obstacle; 0 of those that stand."""
        velocities, turns = np.zeros(len(self._centers), np.complex128), np.zeros(len(self._centers))
        times, seen = self._times - self._times[-1], np.isfinite(self._centers)
        span = -times[seen.argmax(axis=1)]
        watched = np.flatnonzero((seen.sum(axis=1) >= _LEAST_SIGHTINGS) & (span >= _LEAST_SPAN_S - 1e-6))
        if not len(watched):
            return velocities, turns
        weight, place = seen[watched].astype(np.float64), np.nan_to_num(self._centers[watched])

        def total(values: np.ndarray) -> np.ndarray:
            return (weight * values).sum(axis=1, keepdims=True)

        def from_mean(values: np.ndarray) -> np.ndarray:
            return values - total(values) / total(np.ones_like(times))

        # the rate of turn from a parabola, in whose middle the velocity is known best
        linear = from_mean(times)
        square = from_mean(0.5 * linear**2)
        square -= total(square * linear) / total(linear**2) * linear
        doubt = (_CENTER_ERROR * resolution / _ACCELERATION) ** 2
        velocity = total(linear * place) / total(linear**2)
        acceleration = total(square * place) / (total(square**2) + doubt)
        turn = (velocity.conj() * acceleration).imag / np.maximum(np.abs(velocity) ** 2, _LEAST_SPEED**2)
        # the present velocity from an arc with that rate
        arc = from_mean(_arc(turn, times))
        velocity = (total(arc.conj() * place) / total(np.abs(arc) ** 2))[:, 0]
        # what it has done of late
        since = np.maximum(seen[watched].argmax(axis=1), np.searchsorted(times, -_RECENT_S + 1e-6, side="right") - 1)
        recent = place[:, -1] - place[np.arange(len(watched)), since]
        should = -velocity * _arc(turn[:, 0], times[since])
        moves = (np.abs(velocity) >= _LEAST_SPEED) & (np.abs(recent - should) <= _ASTRAY * np.abs(should))
        way = place[:, -1] - place[np.arange(len(watched)), seen[watched].argmax(axis=1)]
        moves &= self._drifts[watched] <= _DRIFT * np.abs(way)
        velocities[watched[moves]], turns[watched[moves]] = velocity[moves], turn[moves, 0]
        return velocities, turns


def _alike(one: OccupancyMap, other: OccupancyMap) -> bool:
    """Whether two maps have the same size and resolution; the second may have come along with the robot."""
    return one.occupied.shape == other.occupied.shape and one.resolution == other.resolution


def _arc(turn: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Where a point is after a time [s] that sets out from 0 along x at 1 m/s and turns at a rate [rad/s]: x + iy."""
    half = 0.5 * turn * time
    return time * np.sinc(half / np.pi) * np.exp(1j * half)


@dataclass(frozen=True)
class _Obstacles:
    """The B obstacles near a robot that do not reach out of what was looked at."""

    occupancy: OccupancyMap
    corner: tuple[int, int]
    """Row and column where the part of the map begins that was looked at."""
    labels: np.ndarray
    """(rows, cols) int32 of that part; obstacle b's pixels have the label `numbers[b]`."""
    count: int
    """Of all labels."""
    numbers: np.ndarray
    centers: np.ndarray
    """(B,) x + iy, world frame [m]."""
    sides: np.ndarray
    """(B, 2) left + i lower and right + i upper side, from the centre [m]"""

    @classmethod
    def near(cls, occupancy: OccupancyMap, position: np.ndarray) -> _Obstacles:
        """Those near a position (2,) [m]."""
        reach = min(round(NEAR_M / occupancy.resolution), NEAR_PIXELS)
        row, col = (int(index) for index in occupancy.pixel_of(position))
        top, left = max(row - reach, 0), max(col - reach, 0)
        part = np.ascontiguousarray(occupancy.occupied[top : row + reach + 1, left : col + reach + 1])
        count, labels, boxes, centers = cv2.connectedComponentsWithStats(part.view(np.uint8), connectivity=4)
        x, y, width, height, _ = boxes.T
        whole = (x > 0) & (y > 0) & (x + width < part.shape[1]) & (y + height < part.shape[0])
        whole &= np.maximum(width, height) * occupancy.resolution <= LARGEST_M
        whole[0] = False  # what is free
        numbers = np.flatnonzero(whole)
        if len(numbers) > MOST:
            numbers = numbers[:0]
        x0, y0 = occupancy.origin
        at = occupancy.resolution * (centers[numbers] + (left + 0.5, top + 0.5))
        places = x0 + at[:, 0] + 1j * (y0 + at[:, 1])
        low, high = x + 1j * y, x + width + 1j * (y + height)
        middle = centers[numbers] @ (1, 1j) + 0.5 + 0.5j
        sides = occupancy.resolution * (np.stack([low, high], axis=1)[numbers] - middle[:, None])
        return cls(occupancy, (top, left), labels, count, numbers, places, sides)

    def shifted(self, way: np.ndarray, both: np.ndarray) -> OccupancyMap | None:
        """The map with the obstacles (B,) x + iy [m] farther on, by whole pixels; None if that changes nothing.

        Those for which `both` (B,) bool holds stay where they are as well. What comes to lie outside of it is gone.
        """
        pixels, stays = np.zeros(self.count, np.complex128), np.zeros(self.count, np.bool_)
        pixels[self.numbers], stays[self.numbers] = np.rint(way / self.occupancy.resolution), both
        moves = pixels != 0
        if not moves.any():
            return None
        occupied = self.occupancy.occupied.copy()
        row, col = np.nonzero(moves[self.labels])
        label = self.labels[row, col]
        row, col, shift = row + self.corner[0], col + self.corner[1], pixels[label]
        occupied[row, col] = stays[label]
        row, col = row + shift.imag.astype(np.intp), col + shift.real.astype(np.intp)
        on_map = (row >= 0) & (row < occupied.shape[0]) & (col >= 0) & (col < occupied.shape[1])
        occupied[row[on_map], col[on_map]] = True
        return OccupancyMap(occupied, self.occupancy.resolution, self.occupancy.origin)
