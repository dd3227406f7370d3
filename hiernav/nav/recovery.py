"""Getting away from where the skill stands still: the same bounded manoeuvre in evaluation and on the robot.

A skill without memory can settle in a posture that its own mean action holds for ever, or push at an obstacle. It is
given another plan for a moment: straight ahead or straight back, as far as the map is free, whichever is nearer to
where it was to go; the other way at the next try. What it does there is up to the skill, like everything else.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hiernav.nav.occupancy import OccupancyMap

_LEAST_FREE = 2
"""Waypoints of a way out that must be free for it to be chosen for the sake of its direction."""


class Recovery:
    """Gives robots that should move and do not a way out.

    A robot is stuck if it has moved less than `least_m` within `window_s` although its plan leads farther away. It
    then follows its way out for `duration_s`, or until it is `reach_m` away. After `limit` recoveries without coming
    `clear_m` away from where the first of them began, it is given up and keeps its plan.

    Attributes:
        counts: (N,) int, recoveries since the reset.
        active: (N,) bool, whether the robot is on its way out.
        ended: (N,) bool, whether it was until this step: time for another plan.
        given_up: (N,) bool.
    """

    def __init__(
        self,
        num_rows: int,
        control_period: float,
        radius: float = 0.1,
        window_s: float = 1.5,
        least_m: float = 0.05,
        duration_s: float = 1.0,
        reach_m: float = 0.5,
        limit: int = 3,
        clear_m: float = 0.5,
    ) -> None:
        """`radius` is that of the disc that must fit on the way out [m]."""
        self.radius, self.least_m, self.reach_m, self.limit, self.clear_m = radius, least_m, reach_m, limit, clear_m
        self._duration = max(1, round(duration_s / control_period))
        self._trail = np.full((num_rows, max(1, round(window_s / control_period)), 2), np.nan)
        self._tick = np.zeros(num_rows, dtype=np.int64)
        self._left = np.zeros(num_rows, dtype=np.int64)
        self._tries = np.zeros(num_rows, dtype=np.int64)
        self._place = np.full((num_rows, 2), np.nan)
        self._began = np.full((num_rows, 2), np.nan)
        self._out: dict[int, np.ndarray] = {}
        self.counts = np.zeros(num_rows, dtype=np.int64)
        self._asked = np.zeros(num_rows, dtype=bool)
        self.active = np.zeros(num_rows, dtype=bool)
        self.ended = np.zeros(num_rows, dtype=bool)
        self.given_up = np.zeros(num_rows, dtype=bool)

    def reset(self, rows: np.ndarray | slice | None = None) -> None:
        """Start new episodes in some rows (all by default)."""
        rows = slice(None) if rows is None else rows
        self._trail[rows], self._place[rows] = np.nan, np.nan
        self._tick[rows] = self._left[rows] = self._tries[rows] = self.counts[rows] = 0
        self._asked[rows] = self.active[rows] = self.ended[rows] = self.given_up[rows] = False

    def rest(self) -> None:
        """The robots were made to wait: forget that they have not moved, not how often they had to be helped."""
        self._trail[:] = np.nan
        self._left[:] = 0

    def ask(self, row: int) -> None:
        """Help a robot at the next call, whether it has stood still or not; within the same limits."""
        self._asked[row] = True

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
        rows = np.arange(len(self.counts)) if rows is None else rows
        position, slot = pose[:, :2], self._tick[rows] % self._trail.shape[1]
        self._tick[rows] += 1
        # comparisons with NaN, where the window is not full or a position unknown, are False
        moved = np.linalg.norm(position - self._trail[rows, slot], axis=-1)
        self._trail[rows, slot] = position
        self._tries[rows[np.linalg.norm(position - self._place[rows], axis=-1) > self.clear_m]] = 0
        ahead = np.linalg.norm(plan[:, -1] - position, axis=-1)
        stuck = ((moved < self.least_m) & (ahead > self.least_m) | self._asked[rows]) & (self._left[rows] == 0)
        self._asked[rows] = False
        self.given_up[rows] = stuck & (self._tries[rows] >= self.limit)
        for k in np.flatnonzero(stuck & ~self.given_up[rows]).tolist():
            self._begin(int(rows[k]), pose[k], plan[k], occupancy[k])
        self._left[rows[np.linalg.norm(position - self._began[rows], axis=-1) > self.reach_m]] = 0
        active = self._left[rows] > 0
        self.ended[:] = False
        self.ended[rows], self.active[rows] = self.active[rows] & ~active, active
        self._left[rows] -= active
        if not active.any():
            return plan
        followed = plan.copy()
        for k in np.flatnonzero(active).tolist():
            followed[k] = self._out[int(rows[k])]
        return followed

    def _begin(self, row: int, pose: np.ndarray, plan: np.ndarray, occupancy: OccupancyMap) -> None:
        if self._tries[row] == 0:
            self._place[row] = pose[:2]
        self._out[row] = way_out(pose, plan, occupancy, self.radius, other=self._tries[row] % 2 == 1)
        self._began[row], self._trail[row], self._left[row] = pose[:2], np.nan, self._duration
        self._tries[row] += 1
        self.counts[row] += 1


def way_out(pose: np.ndarray, plan: np.ndarray, occupancy: OccupancyMap, radius: float, other: bool) -> np.ndarray:
    """A plan straight ahead or straight back, up to the first waypoint that is not free and padded there.

    Args:
        pose: (3,) world frame [m, m, rad].
        plan: (K, 2) to be left, world frame [m]; the way out has as many waypoints, as far apart.
        occupancy: map as it is now.
        radius: of the disc that must fit [m].
        other: take the way that is farther from the plan, unless it is blocked at once.

    Returns:
        (K, 2) world frame [m].
    """
    heading = np.array([np.cos(pose[2]), np.sin(pose[2])])
    spacing = max(float(np.linalg.norm(plan[0] - pose[:2])), float(np.linalg.norm(np.diff(plan, axis=0), axis=1).max()))
    along = spacing * np.arange(len(plan) + 1)[:, None] * heading
    ways = [pose[:2] + along, pose[:2] - along]
    free = [int(np.argmin([*occupancy.is_free(way[1:], radius), False])) for way in ways]
    middle = plan[len(plan) // 2] - pose[:2]
    chosen = int(bool(middle @ heading < 0.0) != bool(other))
    if free[chosen] < min(_LEAST_FREE, free[1 - chosen]):
        chosen = 1 - chosen
    return ways[chosen][np.minimum(np.arange(1, len(plan) + 1), free[chosen])]
