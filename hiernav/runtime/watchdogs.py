"""What the loop watches besides the action itself. Each watchdog is a rule about time with one question to ask it."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from hiernav.runtime.estimate import Estimate, StateEstimator, Trust


class BlindWatch:
    """Notices that sensors no longer renew the estimate, whatever their stamps say."""

    def __init__(self, hold_after: float, lost_after: float, first_after: float) -> None:
        """
        Args:
            hold_after: age of an estimate that is not driven on [s].
            lost_after: age that is a fault [s].
            first_after: time the first estimate may take [s].
        """
        self.hold_after, self.lost_after, self.first_after = hold_after, lost_after, first_after
        self._since: float | None = None
        self._stamp = -math.inf

    def renew(self, now: float) -> None:
        """Give the first estimate its time once more; one that has grown old stays old until another comes."""
        if math.isinf(self._stamp):
            self._since = now

    def check(self, estimate: Estimate | None, now: float, lacks: str = "") -> tuple[Trust, str]:
        """What the newest estimate is good for at `now` [s], on the loop's clock, and what it suffers from.

        `lacks` says what the first one waits for.
        """
        if self._since is None:
            self._since = now
        if estimate is None:
            waited = now - self._since
            if math.isinf(self._stamp):
                why = f"no position and heading for {waited:.2f} s{f' ({lacks})' if lacks else ''}"
                return (Trust.LOST if waited > self.first_after else Trust.HOLD), why
        elif estimate.stamp != self._stamp:  # also an earlier one: the robot's clock has started again
            self._since, self._stamp = now, estimate.stamp
            return estimate.trust, estimate.why
        age = now - self._since
        if age > self.lost_after:
            return Trust.LOST, f"no new sensor frame for {age:.2f} s"
        if age > self.hold_after:
            return Trust.HOLD, f"no new sensor frame for {age:.2f} s"
        return (Trust.HOLD, "position and heading are unknown") if estimate is None else (estimate.trust, estimate.why)


OVERRUNS, GOOD_TICKS = 3, 10
"""Ticks in a row that missed a deadline after which the robot waits, and ticks in time after which it goes on."""


class OverrunWatch:
    """Notices a machine that does not keep up, and when it does again."""

    def __init__(self) -> None:
        self._good = GOOD_TICKS
        self._late = False

    def check(self, overruns_in_a_row: int) -> str | None:
        """Why to wait, or None; once per tick."""
        if overruns_in_a_row >= OVERRUNS:
            self._late, self._good = True, 0
        elif self._late:
            self._good = 0 if overruns_in_a_row else self._good + 1
            self._late = self._good < GOOD_TICKS
        return f"{OVERRUNS} overruns in a row" if self._late else None


class PlanWatch:
    """Notices a planner that does not answer: first the robot slows down, then it waits."""

    def __init__(self, slow_after: float, hold_after: float) -> None:
        """
        Args:
            slow_after: time for which a plan that has ended is followed at full speed [s].
            hold_after: time after which it is not followed any more [s].
        """
        self.slow_after, self.hold_after = slow_after, hold_after

    def check(self, overdue: float) -> tuple[float, str | None]:
        """Speed [0, 1] at which a plan may be followed that ended `overdue` [s] ago, and why to wait, if so."""
        if overdue <= self.slow_after:
            return 1.0, None
        if overdue <= self.hold_after:
            return 0.5, None
        return 0.0, f"no new plan {overdue:.2f} s after the last one ended"


class BlockedWatch:
    """Notices that no way leads on: planners have found none for some time."""

    def __init__(self, hold_after: float, give_up_after: float) -> None:
        """
        Args:
            hold_after: time without a way after which the robot waits [s].
            give_up_after: time after which the goal counts as unreachable [s].
        """
        self.hold_after, self.give_up_after = hold_after, give_up_after
        self._since: float | None = None

    def check(self, refused: bool | None, now: float) -> tuple[str | None, bool]:
        """Why to wait, and whether to give up; `refused` as in `Decision`."""
        if refused is False:
            self._since = None
        elif refused and self._since is None:
            self._since = now
        if self._since is None:
            return None, False
        waited = now - self._since
        return ("no way to the goal" if waited > self.hold_after else None), waited > self.give_up_after


SATURATED, WINDOW = 0.9, 2.0
"""Share of the commands that lie at an actuator's limit, of those in so much time [s], at which the robot is helped."""


class SaturationWatch:
    """Notices a skill that asks for all that the actuators can give, and goes on doing so."""

    def __init__(self, action_dim: int, period: float) -> None:
        """
        Args:
            action_dim: number of actuators.
            period: of the control loop [s].
        """
        self._counts: deque[int] = deque(maxlen=max(1, round(WINDOW / period)))
        self._limit = SATURATED * (self._counts.maxlen or 1) * action_dim
        self._sum = 0

    def reset(self) -> None:
        """Start with an empty window."""
        self._counts.clear()
        self._sum = 0

    def check(self, action: np.ndarray) -> bool:
        """Take in what the skill asks for (A,); whether the robot must be helped."""
        count = sum(not -0.98 < value < 0.98 for value in action.tolist())
        full = len(self._counts) == self._counts.maxlen
        self._sum += count - (self._counts[0] if full else 0)
        self._counts.append(count)
        return len(self._counts) == self._counts.maxlen and self._sum >= self._limit


SETTLED = 0.2
"""For how long a robot's speed must say the same before it is believed to stand, or to move again [s]."""


class StopWatch:
    """Decides from measured speeds whether a braked robot stands, and goes on watching that it does."""

    def __init__(self, speed: float, turn: float, timeout: float) -> None:
        """
        Args:
            speed, turn: a robot slower than both stands [m/s, rad/s].
            timeout: time it is given to stop, at first and whenever it moves again [s].
        """
        self.speed, self.turn, self.timeout = speed, turn, timeout
        self.stands = True
        """Whether it was seen to stand since the brake was first sent, and has not moved since."""
        self._watching = self._told = self._slow = False
        self._since, self._alike = 0.0, 0
        self._stamp = self._since_stamp = math.nan

    def begin(self, now: float) -> None:
        """The brake was first sent at `now` [s]."""
        self._watching, self.stands = True, False
        self._told, self._since = False, now
        self._alike, self._stamp = 0, math.nan

    def postpone(self, now: float) -> None:
        """Nothing could be seen until `now` [s]: the time it is given begins then."""
        self._since = max(self._since, now)

    def check(
        self,
        estimate: Estimate | None,
        now: float,
        measured: bool = True,
        turn_measured: bool = True,
        sure: bool = True,
    ) -> bool | None:
        """Whether the robot stands; None while that is open, and after it was told once.

        One reading of a speed that passes through zero, or an odd one of a robot that stands, says nothing: it takes
        three, over 0.2 s. It moves again once it is twice as fast.

        Args:
            estimate: newest; one that was seen before says nothing.
            now: on the loop's clock [s].
            measured: whether its speed is one that a sensor says, and not the last one that was known.
            turn_measured: the same of its turning rate, without which speed alone is judged.
            sure: whether the robot has sensors for both. The speed of one that has none is guessed from its positions:
                it is not watched any more once it was slow three times.
        """
        if not self._watching:
            return None
        if measured and estimate is not None and estimate.stamp != self._stamp:
            self._take(estimate, turn_measured)
            settled = self._alike >= 3 and (not sure or estimate.stamp - self._since_stamp >= SETTLED)
            if settled and self._slow is not self.stands and (sure or self._slow):
                self.stands = self._slow
                if self.stands:
                    return True
                self._since, self._told = now, False
        if not (self.stands or self._told) and now - self._since > self.timeout:
            self._told = True
            return False
        return None

    def _take(self, estimate: Estimate, turn_measured: bool) -> None:
        speed, turn = (2.0 * self.speed, 2.0 * self.turn) if self.stands else (self.speed, self.turn)
        turns = turn_measured and not abs(estimate.yaw_rate) < turn
        slow = math.hypot(*estimate.velocity.tolist()) < speed and not turns
        if slow is not self._slow or not estimate.stamp >= self._stamp:
            self._slow, self._alike, self._since_stamp = slow, 0, estimate.stamp
        self._alike, self._stamp = self._alike + 1, estimate.stamp


def measured(estimator: StateEstimator) -> tuple[bool, bool, bool]:
    """What `StopWatch.check` asks of the sensors behind an estimate: `measured`, `turn_measured` and `sure`."""
    patience = estimator.config.hold_after
    speed, turn = (estimator.silence(name) < patience for name in ("velocimeter", "gyro"))
    return speed, turn, estimator.hears("velocimeter") and estimator.hears("gyro")
