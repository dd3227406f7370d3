"""Getting away from where the skill stands still: the same bounded manoeuvre in evaluation and on the robot.

A skill without memory can settle in a posture that its own mean action holds for ever, or push at an obstacle. It is
given other plans for a moment: straight ahead, straight back, to the sides, as far as the map is free, one after the
other until it moves. What it does there is up to the skill, like everything else. Until it is clear of that place,
obstacles look farther away to it: mostly it is what its lidar reads that holds it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.ma  # by np.median: now, and not in the control step in which a robot is stuck first

from hiernav.nav.occupancy import OccupancyMap
from hiernav.nav.path import distances, polyline
from hiernav.nav.sweep import sweep

LEAST_M, WINDOW_S = 0.05, 1.5
"""A robot is stuck that has moved less than so far [m] within so long [s]."""
PATIENCE_S = 4.0
"""The same, where the map has changed within `WINDOW_S`: the robot may wait for what is in its way to move on [s]."""
TRY_S, WAYS = 0.5, 6
"""How long a way out is tried [s], and how many of them are in one recovery."""
REACH_M = 0.5
"""A recovery ends this far from where it began [m]."""
LIMIT, CLEAR_M = 3, 0.5
"""Recoveries that are tried within so far [m] of where the first of them began."""
_LEAST_FREE = 2
"""Waypoints of a way out that must be free for it to be tried before those that are blocked at once."""
_DIMMED = 0.7
"""Share of the lidar's closeness that is left: obstacles look 0.36 m farther away."""


class Recovery:
    """Gives robots that should move and do not a way out.

    A robot is stuck if it has moved less than `LEAST_M` within `WINDOW_S` although its plan leads farther away; where
    the map has changed meanwhile, within `PATIENCE_S` too. It is then shown one way out after the other, each for
    `TRY_S`; the first on which it moves by `LEAST_M` it follows for as long again, or until it is `REACH_M` away, and
    plans anew. After `LIMIT` recoveries of at most `WAYS` ways each without coming `CLEAR_M` away from where the first
    of them began, it is given up and keeps its plan.

    Each way leads from where the robot is at its turn. It is swept on the newest map at every step and ends before what
    it meets; if that is near, the turn is the next free one's. A robot that is free to no side is asked to stay.

    Attributes:
        counts: (N,) int, recoveries since the reset.
        active: (N,) bool, whether the robot is on its way out.
        ended: (N,) bool, whether it was until this step: time for another plan.
        given_up: (N,) bool.
    """

    def __init__(self, num_rows: int, control_period: float, radius: float = 0.1) -> None:
        """`radius` is that of the disc that must fit on the way out [m]."""
        self.radius = radius
        self._try = max(1, round(TRY_S / control_period))
        self._window = max(1, round(WINDOW_S / control_period))
        self._trail = np.full((num_rows, max(self._window, round(PATIENCE_S / control_period)), 2), np.nan)
        self._all_rows = np.arange(num_rows)
        self._tick = np.zeros(num_rows, dtype=np.int64)
        self._map: list[OccupancyMap | None] = [None] * num_rows
        self._mapped = np.zeros(num_rows, dtype=np.int64)  # the tick of the newest map
        self._on_way = np.zeros(num_rows, dtype=np.int64)
        self._ways_left = np.zeros(num_rows, dtype=np.int64)
        self._tries = np.zeros(num_rows, dtype=np.int64)
        self._place = np.full((num_rows, 2), np.nan)
        self._began = np.full((num_rows, 2), np.nan)
        self._turned = np.full((num_rows, 2), np.nan)
        self._bearings: dict[int, np.ndarray] = {}
        """World frame [rad], of the ways out in the order of their turns."""
        self._spacing: dict[int, float] = {}
        self._way: dict[int, np.ndarray] = {}
        """The way out that is followed, (K, 2) world frame [m]."""
        self.counts = np.zeros(num_rows, dtype=np.int64)
        self._asked = np.zeros(num_rows, dtype=bool)
        self.active = np.zeros(num_rows, dtype=bool)
        self.ended = np.zeros(num_rows, dtype=bool)
        self.given_up = np.zeros(num_rows, dtype=bool)
        self._quiet = True
        """Whether nobody has been helped lately: of all this, only the trail is in use."""

    def reset(self, rows: np.ndarray | slice | None = None) -> None:
        """Start new episodes in some rows (all by default)."""
        rows = slice(None) if rows is None else rows
        self._trail[rows], self._place[rows] = np.nan, np.nan
        self._mapped[rows] = -self._window
        self._tick[rows] = self._ways_left[rows] = self._tries[rows] = self.counts[rows] = 0
        self._asked[rows] = self.active[rows] = self.ended[rows] = self.given_up[rows] = False

    def rest(self) -> None:
        """The robots were made to wait: forget that they have not moved, not how often they had to be helped."""
        self._trail[:] = np.nan
        self._ways_left[:] = 0

    def ask(self, row: int) -> None:
        """Help a robot at the next call, if its pose is known then, whether it has stood still or not.

        The same limits hold.
        """
        self._asked[row], self._quiet = True, False

    def __call__(
        self, pose: np.ndarray, plan: np.ndarray, occupancy: Sequence[OccupancyMap], rows: np.ndarray | None = None
    ) -> np.ndarray:
        """The plans to follow, once per control step.

        Args:
            pose: (M, 3) world frame [m, m, rad].
            plan: (M, K, 2) of the option, world frame [m]; one that ends where the robot is asks it to stay.
            occupancy: M maps as they are now.
            rows: (M,) the rows these belong to; all N by default.

        Returns:
            (M, K, 2) world frame [m]; `plan` itself where no robot is on its way out.
        """
        rows = self._all_rows if rows is None else rows
        position, tick, length = pose[:, :2], self._tick[rows], self._trail.shape[1]
        for row, now in zip(rows.tolist(), occupancy, strict=True):
            if self._map[row] is not now:
                self._map[row], self._mapped[row] = now, self._tick[row]
        # comparisons with NaN, where the window is not full or a position unknown, are False
        still = distances(position, self._trail[rows, (tick - self._window) % length]) < LEAST_M
        if np.count_nonzero(still):
            patient = self._mapped[rows] > tick - self._window
            oldest = self._trail[rows, tick % length]  # the slot that is written next
            still &= ~patient | (distances(position, oldest) < LEAST_M)
        self._trail[rows, tick % length] = position
        self._tick[rows] += 1
        if self._quiet and not np.count_nonzero(still):
            return plan
        self._forget(rows, position)
        ahead = distances(plan[:, -1], position)
        idle = self._ways_left[rows] == 0
        known = np.isfinite(pose).all(axis=1) & np.isfinite(plan).all(axis=(1, 2))
        stuck = (still & (ahead > LEAST_M) | self._asked[rows]) & idle & known
        self._asked[rows] = False
        self.given_up[rows] = stuck & (self._tries[rows] >= LIMIT)
        for k in np.flatnonzero(~idle).tolist():
            self._go_on(int(rows[k]), position[k], occupancy[k])
        for k in np.flatnonzero(stuck & ~self.given_up[rows]).tolist():
            self._begin(int(rows[k]), pose[k], plan[k], occupancy[k])
        active = self._ways_left[rows] > 0
        self.ended[:] = False
        self.ended[rows], self.active[rows] = self.active[rows] & ~active, active
        self._quiet = not (self._tries.any() or self._asked.any() or self.active.any() or self.ended.any())
        if not active.any():
            return plan
        followed = plan.copy()
        for k in np.flatnonzero(active).tolist():
            followed[k] = self._way[int(rows[k])]
        return followed

    def dim(self, terms: Mapping[str, np.ndarray], rows: np.ndarray | None = None) -> Mapping[str, np.ndarray]:
        """What the robots sense, the lidar dimmed for those that have stood still and are not clear of that place yet.

        Args:
            terms: sensors by name, (M, d) each.
            rows: (M,) the rows these belong to; all N by default.
        """
        if self._quiet or "lidar" not in terms:
            return terms
        dimmed = self._tries > 0 if rows is None else self._tries[rows] > 0
        return {**terms, "lidar": np.where(dimmed[:, None], _DIMMED * terms["lidar"], terms["lidar"])}

    def _forget(self, rows: np.ndarray, position: np.ndarray) -> None:
        """Recoveries count in one place alone."""
        self._tries[rows[distances(position, self._place[rows]) > CLEAR_M]] = 0

    def _remember(self, row: int, position: np.ndarray) -> None:
        """One more recovery; the first one makes the place."""
        if self._tries[row] == 0:
            self._place[row] = position
        self._tries[row] += 1

    def _begin(self, row: int, pose: np.ndarray, plan: np.ndarray, occupancy: OccupancyMap) -> None:
        first = int(self._tries[row]) * WAYS  # go on where the last recovery in this place ended
        self._bearings[row] = np.roll(ways_out(pose, plan, occupancy, self.radius)[0], -first)
        self._spacing[row], self._ways_left[row] = _spacing(pose, plan), WAYS
        self._turn(row, pose[:2], len(plan), occupancy)
        self._began[row], self._trail[row] = pose[:2], np.nan
        self._remember(row, pose[:2])
        self.counts[row] += 1

    def _go_on(self, row: int, position: np.ndarray, occupancy: OccupancyMap) -> None:
        """One more step of a recovery: the same way, the next one, or the end."""
        self._on_way[row] += 1
        if np.linalg.norm(position - self._began[row]) > REACH_M or self._on_way[row] >= 2 * self._try:
            self._ways_left[row] = 0
        else:
            tried = self._on_way[row] == self._try and np.linalg.norm(position - self._turned[row]) < LEAST_M
            if tried or not self._leads_on(row, position, occupancy):
                self._bearings[row] = np.roll(self._bearings[row], -1)
                self._ways_left[row] -= 1
                self._turn(row, position, len(self._way[row]), occupancy)
        if self._ways_left[row] == 0:
            self._trail[row] = np.nan  # the plan that follows gets its time

    def _turn(self, row: int, position: np.ndarray, count: int, occupancy: OccupancyMap) -> None:
        """Follow the first way out that is free, from here; those that are passed over come last."""
        bearings = self._bearings[row]
        ways, free = _straight_ways(position, bearings, self._spacing[row], count, occupancy, self.radius)
        best = int(np.minimum(free, _LEAST_FREE).argmax())
        self._bearings[row], self._way[row] = np.roll(bearings, -best), ways[best]
        self._turned[row], self._on_way[row] = position, 0

    def _leads_on(self, row: int, position: np.ndarray, occupancy: OccupancyMap) -> bool:
        """Whether what is left of the way is free, or asks to stay; it is made to end before what it meets."""
        way = self._way[row]
        # not so where the position is unknown
        if not distances(way[-1], position) > LEAST_M:
            return True
        left = way[int(distances(way, position).argmin()) :]
        free = int(_free_waypoints(position, left[None], occupancy, self.radius)[0])
        if free < len(left):
            left[free:] = left[free - 1] if free else position
        return free >= min(_LEAST_FREE, len(left))


_AHEAD_FIRST = np.pi / 4 * np.array([0, 4, 2, -2, 1, -1, 3, -3])
_BACK_FIRST = np.pi / 4 * np.array([4, 0, 2, -2, 3, -3, 1, -1])


def ways_out(
    pose: np.ndarray, plan: np.ndarray, occupancy: OccupancyMap, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Straight plans away from a robot, each up to the first waypoint that is not free to come to and padded there.

    Args:
        pose: (3,) world frame [m, m, rad].
        plan: (K, 2) to be left, world frame [m]; the ways out have as many waypoints, as far apart.
        occupancy: map as it is now.
        radius: of the disc that is swept along them [m].

    Returns:
        Bearings (8,) in the world frame [rad] and ways (8, K, 2), world frame [m], in the order to try them: ahead or
        back, whichever is nearer to the plan; the opposite; the sides and then the diagonals, the plan's first. Those
        that are blocked at once come last.
    """
    middle = plan[len(plan) // 2] - pose[:2]
    bearing = np.arctan2(middle[1], middle[0]) - pose[2]
    turns = _BACK_FIRST if np.cos(bearing) < 0.0 else _AHEAD_FIRST
    bearings = pose[2] + (turns if np.sin(bearing) >= 0.0 else -turns)
    ways, free = _straight_ways(pose[:2], bearings, _spacing(pose, plan), len(plan), occupancy, radius)
    order = np.argsort(free < _LEAST_FREE, kind="stable")
    return bearings[order], ways[order]


def _spacing(pose: np.ndarray, plan: np.ndarray) -> float:
    """Distance between the waypoints of a plan [m], whose last ones may all lie on the goal."""
    lengths = distances(plan[1:], plan[:-1])
    apart = lengths[lengths > 1e-3]
    return float(np.median(apart) if len(apart) else distances(plan[0], pose[:2]) / len(plan))


def _straight_ways(
    position: np.ndarray, bearings: np.ndarray, spacing: float, count: int, occupancy: OccupancyMap, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Ways (B, K, 2) [m] from a position (2,) [m], padded after the last of the (B,) waypoints that are free."""
    headings = np.stack([np.cos(bearings), np.sin(bearings)], axis=1)[:, None]
    whole = position + spacing * np.arange(1, count + 1)[:, None] * headings
    free = _free_waypoints(position, whole, occupancy, radius)
    number = np.minimum(np.arange(1, count + 1), free[:, None])
    return position + spacing * number[..., None] * headings, free


def _free_waypoints(position: np.ndarray, ways: np.ndarray, occupancy: OccupancyMap, radius: float) -> np.ndarray:
    """(B,) how many waypoints of ways (B, K, 2) [m] a disc that begins at a position (2,) [m] comes to."""
    lines = polyline(np.broadcast_to(position, (len(ways), 2)), ways)
    index, clearance, meets = sweep(lines, occupancy, radius)
    # where the map has an obstacle in the very place, it does not tell which way leads out of it
    meets |= clearance <= 0.0
    return np.where(meets.any(axis=1), np.ceil(index[meets.argmax(axis=1)]) - 1, ways.shape[1]).astype(np.intp)
