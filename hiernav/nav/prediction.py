"""Maps as they will be: what moves is found by comparing maps, and drawn where it will be when the robot comes there.

A map tells where obstacles are, not where they go. A plan around the place where something is now may lead to where it
will be; here that is known before the robot is on its way.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from hiernav.nav.occupancy import OccupancyMap

AHEAD_S = 0.9
"""How far ahead a map is predicted [s]: about what a robot takes for the half of a plan that it follows."""
WINDOW_S = 1.2
"""How long obstacles are watched [s]; a map that has not changed for as long is taken as it is."""
LOOK_S = 0.1
"""How often maps are compared at most [s]."""
NEAR_M = 4.0
"""Obstacles that reach farther than this from the robot in x or y are not predicted [m]."""
MOST = 128
"""With more obstacles than this near the robot none is predicted."""

_LEAST_SPAN_S = 0.2
"""An obstacle that was watched for less is taken to stand."""
_LEAST_SPEED, _MOST_SPEED = 0.08, 3.0
"""A slower obstacle stands [m/s]; what seems to be faster is another one."""
_CENTER_ERROR = 0.1
"""Of an obstacle on a grid, in pixels."""
_ACCELERATION = 0.5
"""What is expected across the way before it is seen [m/s^2]."""
_ALIKE = 0.4
"""Share of its area by which an obstacle may differ from one map to the next."""


class MapPredictor:
    """Predicts the map of one robot; obstacles keep their speed and their rate of turn.

    An obstacle is a connected set of occupied pixels. It is known again by its place and its area; where two touch or
    one changes its shape, they are taken to stand until they have been watched anew. What moves is shifted by whole
    pixels, all else is left as it is, and a map on which nothing moves is its own prediction.
    """

    def __init__(self, ahead_s: float = AHEAD_S) -> None:
        self._ahead = ahead_s
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
        self._areas = np.zeros(0)

    def __call__(self, occupancy: OccupancyMap, time: float, position: np.ndarray) -> OccupancyMap:
        """The map to plan on.

        Args:
            occupancy: as it is now; the same object while nothing has moved.
            time: now, on any clock [s].
            position: (2,) of the robot, world frame [m].

        Returns:
            The map as it will be, and the same object until there is a better one.
        """
        if time < self._changed:
            self.reset()  # another clock
        before = self._map
        if before is not occupancy:
            self._map, self._changed = occupancy, time
            # most maps never change: nothing is looked for on the first one
            if before is not None and np.isfinite(position).all() and self._is_due(time):
                self._look(occupancy, time, position)
        elif self._predicted is not None and time - self._changed >= WINDOW_S:
            self._forget()
        return occupancy if self._predicted is None else self._predicted

    def _is_due(self, time: float) -> bool:
        return not len(self._times) or time - float(self._times[-1]) >= LOOK_S - 1e-6

    def _look(self, occupancy: OccupancyMap, time: float, position: np.ndarray) -> None:
        obstacles = _Obstacles.near(occupancy, position)
        self._watch(time, obstacles.centers, obstacles.areas * occupancy.resolution**2)
        self._predicted = obstacles.shifted(self._ways(occupancy.resolution))

    def _watch(self, time: float, centers: np.ndarray, areas: np.ndarray) -> None:
        """Find the obstacles (B,) of a new map among those of the last one."""
        times, known = self._times, np.full((len(centers), len(self._times)), np.nan, np.complex128)
        if len(centers) and len(self._areas):
            apart = np.abs(centers[:, None] - self._centers[:, -1])
            apart[np.abs(areas[:, None] - self._areas) > _ALIKE * areas[:, None]] = np.inf
            each, nearest = np.arange(len(centers)), apart.argmin(axis=1)
            same = (apart.argmin(axis=0)[nearest] == each) & (apart[each, nearest] <= _MOST_SPEED * (time - times[-1]))
            known[same] = self._centers[nearest[same]]
        first = int(np.searchsorted(times, time - WINDOW_S - 1e-6))
        self._times = np.append(times[first:], time)
        self._centers = np.concatenate([known[:, first:], centers[:, None]], axis=1)
        self._areas = areas

    def _ways(self, resolution: float) -> np.ndarray:
        """(B,) x + iy how far each obstacle will have come [m]."""
        ways = np.zeros(len(self._centers), np.complex128)
        times, seen = self._times - self._times[-1], np.isfinite(self._centers)
        each, first = np.arange(len(seen)), seen.argmax(axis=1)
        span, apart = -times[first], np.abs(self._centers[:, -1] - self._centers[each, first])
        moving = np.flatnonzero((span >= _LEAST_SPAN_S - 1e-6) & (apart >= _LEAST_SPEED * span))
        if not len(moving):
            return ways
        weight, place = seen[moving].astype(np.float64), np.nan_to_num(self._centers[moving])

        def total(values: np.ndarray) -> np.ndarray:
            return (weight * values).sum(axis=1, keepdims=True)

        def from_mean(values: np.ndarray) -> np.ndarray:
            return values - total(values) / total(np.ones_like(times))

        # the rate of turn from a parabola, in whose middle the velocity is known best
        linear = from_mean(times)
        square = from_mean(0.5 * linear**2)
        square -= total(square * linear) / total(linear**2) * linear
        doubt = (_CENTER_ERROR * resolution / _ACCELERATION) ** 2
        velocity, acceleration = (
            total(linear * place) / total(linear**2),
            total(square * place) / (total(square**2) + doubt),
        )
        turn = (velocity.conj() * acceleration).imag / np.maximum(np.abs(velocity) ** 2, _LEAST_SPEED**2)
        # the present velocity from an arc with that rate
        arc = from_mean(_arc(turn, times))
        velocity = total(arc.conj() * place) / total(np.abs(arc) ** 2)
        ways[moving] = (velocity * _arc(turn, self._ahead))[:, 0]
        return ways


def _arc(turn: np.ndarray, time: np.ndarray | float) -> np.ndarray:
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
    areas: np.ndarray
    """(B,) [pixels]"""

    @classmethod
    def near(cls, occupancy: OccupancyMap, position: np.ndarray) -> _Obstacles:
        """Those near a position (2,) [m]."""
        reach = round(NEAR_M / occupancy.resolution)
        row, col = (int(index) for index in occupancy.pixel_of(position))
        top, left = max(row - reach, 0), max(col - reach, 0)
        part = np.ascontiguousarray(occupancy.occupied[top : row + reach + 1, left : col + reach + 1])
        count, labels, boxes, centers = cv2.connectedComponentsWithStats(part.view(np.uint8), connectivity=4)
        x, y, width, height, area = boxes.T
        whole = (x > 0) & (y > 0) & (x + width < part.shape[1]) & (y + height < part.shape[0])
        whole[0] = False  # what is free
        numbers = np.flatnonzero(whole)
        if len(numbers) > MOST:
            numbers = numbers[:0]
        x0, y0 = occupancy.origin
        at = occupancy.resolution * (centers[numbers] + (left + 0.5, top + 0.5))
        return cls(occupancy, (top, left), labels, count, numbers, x0 + at[:, 0] + 1j * (y0 + at[:, 1]), area[numbers])

    def shifted(self, way: np.ndarray) -> OccupancyMap | None:
        """The map with the obstacles (B,) x + iy [m] farther on, by whole pixels; None if that changes nothing.

        What comes to lie outside of the map is gone.
        """
        pixels = np.zeros(self.count, np.complex128)
        pixels[self.numbers] = np.rint(way / self.occupancy.resolution)
        moves = pixels != 0
        if not moves.any():
            return None
        occupied = self.occupancy.occupied.copy()
        row, col = np.nonzero(moves[self.labels])
        shift = pixels[self.labels[row, col]]
        row, col = row + self.corner[0], col + self.corner[1]
        occupied[row, col] = False
        row, col = row + shift.imag.astype(np.intp), col + shift.real.astype(np.intp)
        on_map = (row >= 0) & (row < occupied.shape[0]) & (col >= 0) & (col < occupied.shape[1])
        occupied[row[on_map], col[on_map]] = True
        return OccupancyMap(occupied, self.occupancy.resolution, self.occupancy.origin)
