"""A planner that takes its time, in this process and on the loop's clock: late plans that are the same every time."""

from __future__ import annotations

import math

from hiernav.nav.option import Planner, PlanQuery
from hiernav.runtime.pilot import Answer


class DelayedPlanner:
    """A `PlannerLink` whose answers come `delay` after it took up the question.

    As by a planner in its own process, one question is worked on at a time, the newest is taken up when it is free, and
    an answer is found by the first tick after it is there. A delay of inf is a planner that hangs.
    """

    def __init__(self, planner: Planner, delay: float) -> None:
        """`delay` [s] may be changed at any time; it holds for questions that are taken up afterwards."""
        self.planner, self.delay = planner, delay
        self.stamp = 0.0
        self.failed: str | None = None
        self._now = 0.0
        self._working: tuple[float, Answer] | None = None
        self._question: tuple[float, PlanQuery] | None = None

    def plan(self, query: PlanQuery) -> None:
        self._question = self.stamp, query
        self._take_up()

    def answer(self, now: float) -> Answer | None:
        self._now = now
        if self._working is None or now < self._working[0] - 1e-9:
            return None
        answer, self._working = self._working[1], None
        self._question = None  # what was asked meanwhile was asked for the same plan
        return answer

    def forget(self) -> None:
        self._working = self._question = None

    def restart_count(self) -> int:
        return 0

    def renew(self) -> None:
        self.failed = None

    def _take_up(self) -> None:
        if self._working is not None or self._question is None or math.isinf(self.delay):
            return
        (stamp, query), self._question = self._question, None
        plan = self.planner.plan(query)[0].copy()
        self._working = self._now + self.delay, Answer(plan, query.position[0].copy(), stamp, query.occupancy[0])
