"""Getting away from where the skill stands still: the same bounded manoeuvre in evaluation and on the robot.

A skill without memory can settle in a posture that its own mean action holds for ever, or push at an obstacle. What
led there is undone for a moment: the action is reversed and shaken, by a pattern that differs from one try to the
next, and the skill starts again from another posture.
"""

from __future__ import annotations

import numpy as np


class Recovery:
    """Reverses and shakes the actions of robots that should move and do not.

    A robot is stuck if it has moved less than `least_m` within `window_s` although its plan leads farther away. Its
    actions are then negated for `duration_s`, or until it is `reach_m` away, plus a dither of `shake` in standard
    deviation that depends on the number of the recovery alone, so that a drive can be repeated to the bit. After
    `limit` recoveries without coming `clear_m` away from where the first of them began, it is given up and its actions
    are left alone.

    Attributes:
        counts: (N,) int, recoveries since the reset.
        active: (N,) bool, whose actions were negated at the last call.
        given_up: (N,) bool.
    """

    def __init__(
        self,
        num_rows: int,
        control_period: float,
        window_s: float = 1.5,
        least_m: float = 0.05,
        duration_s: float = 0.6,
        shake: float = 0.5,
        reach_m: float = 0.5,
        limit: int = 3,
        clear_m: float = 0.5,
    ) -> None:
        self.least_m, self.reach_m, self.limit, self.clear_m = least_m, reach_m, limit, clear_m
        self.shake = shake
        self._duration = max(1, round(duration_s / control_period))
        self._trail = np.full((max(1, round(window_s / control_period)), num_rows, 2), np.nan)
        self._tick = 0
        self._left = np.zeros(num_rows, dtype=np.int64)
        self._tries = np.zeros(num_rows, dtype=np.int64)
        self._place = np.full((num_rows, 2), np.nan)
        self._began = np.full((num_rows, 2), np.nan)
        self.counts = np.zeros(num_rows, dtype=np.int64)
        self._asked = np.zeros(num_rows, dtype=bool)
        self.active = np.zeros(num_rows, dtype=bool)
        self.given_up = np.zeros(num_rows, dtype=bool)

    def reset(self, rows: np.ndarray | slice | None = None) -> None:
        """Start new episodes in some rows (all by default)."""
        rows = slice(None) if rows is None else rows
        self._trail[:, rows], self._place[rows] = np.nan, np.nan
        self._left[rows] = self._tries[rows] = self.counts[rows] = 0
        self._asked[rows] = self.active[rows] = self.given_up[rows] = False

    def rest(self) -> None:
        """The robots were made to wait: forget that they have not moved, not how often they had to be helped."""
        self._trail[:] = np.nan
        self._left[:] = 0

    def ask(self, row: int) -> None:
        """Help a robot at the next call, whether it has stood still or not; within the same limits."""
        self._asked[row] = True

    def __call__(self, position: np.ndarray, plan: np.ndarray, action: np.ndarray) -> np.ndarray:
        """The action to take, once per control step.

        Args:
            position: (N, 2) world frame [m].
            plan: (N, K, 2) world frame [m]; a plan that ends where the robot is asks it to stay.
            action: (N, A) of the skill.

        Returns:
            (N, A), a new array.
        """
        slot = self._tick % len(self._trail)
        self._tick += 1
        # comparisons with NaN, where the window is not full or a position unknown, are False
        moved = np.linalg.norm(position - self._trail[slot], axis=-1)
        self._trail[slot] = position
        self._tries[np.linalg.norm(position - self._place, axis=-1) > self.clear_m] = 0
        ahead = np.linalg.norm(plan[:, -1] - position, axis=-1)
        stuck = ((moved < self.least_m) & (ahead > self.least_m) | self._asked) & (self._left == 0)
        self._asked[:] = False
        self.given_up = stuck & (self._tries >= self.limit)
        begins = stuck & ~self.given_up
        first = begins & (self._tries == 0)
        self._place[first] = position[first]
        self._began[begins] = position[begins]
        self._trail[:, begins] = np.nan
        self._left[begins] = self._duration
        self._tries += begins
        self.counts += begins
        self._left[np.linalg.norm(position - self._began, axis=-1) > self.reach_m] = 0
        self.active = self._left > 0
        shaken = action.copy()
        for row in np.flatnonzero(self.active).tolist():
            dither = _dither(int(self.counts[row]), int(self._left[row]), action.shape[1])
            shaken[row] = np.clip(self.shake * dither - action[row], -1.0, 1.0)
        self._left -= self.active
        return shaken


def _dither(number: int, tick: int, size: int) -> np.ndarray:
    """Standard normal values (size,) for a tick of a recovery: the same ones always."""
    return np.random.default_rng((number, tick)).standard_normal(size)
