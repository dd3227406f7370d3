"""The control process's side of a planner in a process of its own: never waits, watches its age, restarts it."""

from __future__ import annotations

import os
from collections import Counter, OrderedDict
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

import msgspec
import numpy as np

from hiernav.nav.bundle import Bundle
from hiernav.nav.goal import GOAL_RADIUS
from hiernav.nav.occupancy import OccupancyMap, VisitMap
from hiernav.nav.option import PlanQuery
from hiernav.nav.search import grid_cells
from hiernav.runtime.child import Child
from hiernav.runtime.mailbox import mapped, shared_memory
from hiernav.runtime.pilot import Answer
from hiernav.runtime.planner_memory import PlannerMemory, Question, Status
from hiernav.runtime.policy import planner_settings
from hiernav.runtime.timing import Histogram

LOADING = 5.0
"""Time that a planner which has just been started is given to load its network [s]."""
SECONDS_PER_CELL = 6e-6
"""Time for a planning cell of 0.1 m that the first plan on a map may take [s], three times what it takes at 4 GHz:
0.24 s for 20 x 20 m, 1.5 s for 50 x 50 m, beside what a planner is given on any map."""
_REMEMBERED = 256


@dataclass(frozen=True)
class _Asked:
    stamp: float
    position: np.ndarray
    occupancy: OccupancyMap


class ProcessPlanner:
    """A `PlannerLink` to a process that is started here.

    A question is put into a mailbox that holds one: the planner, when it is free, finds the newest. A planner that
    does not answer for as long as `patience` is killed and started again, as is one that has died; three restarts are
    granted.
    """

    def __init__(
        self,
        bundle: Bundle,
        robot_radius: float,
        map_pixels: int,
        hang_after: float = 0.5,
        goal_radius: float = GOAL_RADIUS,
        seconds_per_cell: float = SECONDS_PER_CELL,
    ) -> None:
        """
        Args:
            bundle: verified policies; the planner gets the bytes that were verified.
            robot_radius: disc with which plans are swept against the map [m].
            map_pixels: of the largest map that will be asked with.
            hang_after: time without an answer after which the planner is started again [s], on a map of no size.
            goal_radius: distance at which the goal counts as reached [m].
            seconds_per_cell: further time for every planning cell of the largest map asked with [s].
        """
        settings = msgspec.json.encode(planner_settings(bundle, robot_radius, goal_radius))
        waypoints = bundle.manifest.plan.waypoints
        self.stamp = 0.0
        self.hang_after, self.seconds_per_cell = hang_after, seconds_per_cell
        self.patience = hang_after
        """Time without an answer after which the planner is started again [s]: `hang_after`, and for a search of the
        largest map asked with so far."""
        self.plan_time = Histogram()
        """How long the planner took, as it says itself."""
        self._descriptor = shared_memory(PlannerMemory.size(map_pixels, waypoints, settings, bundle.planner))
        self._memory = PlannerMemory.create(mapped(self._descriptor), map_pixels, waypoints, settings, bundle.planner)
        self._read_end, self._questions = os.pipe()
        os.set_blocking(self._questions, False)
        self._child = self._start_keeper()
        self._asked: OrderedDict[int, _Asked] = OrderedDict()
        self._number = self._wanted_from = 0
        self._map: OccupancyMap | None = None
        self._map_version = 0
        self._visits: VisitMap | None = None
        self._silent_since: float | None = None
        self._newest_start = self._renewed_after = 0
        self._ended_counts: Counter[str] = Counter()
        self._newest_counts: Counter[str] = Counter()

    @property
    def status(self) -> Status:
        """Of the planner's process."""
        return self._memory.status

    @property
    def ready(self) -> bool:
        """Whether the planner has loaded its network and waits for questions."""
        status = self.status
        return status.ready == status.starts > 0

    @property
    def failed(self) -> str | None:
        status = self.status
        if status.exhausted and status.starts > self._renewed_after:  # else the keeper is about to start another one
            return f"the planner's process failed again after {status.restarts} restarts"
        code = self._child.ended
        if code is None:
            return None
        self._child.close(family=True)  # a planner that cannot see the end of its keeper
        return f"the planner's keeper ended with status {code}"

    def restart_count(self) -> int:
        return self.status.restarts

    def counts(self) -> dict[str, int]:
        """Proposals, repairs, loops, detours, refusals and why (`VerifiedPlanner.counts`), as far as answers came."""
        return dict(self._ended_counts + self._newest_counts)

    def renew(self) -> None:
        self._renewed_after = self.status.starts
        self._silent_since = None
        if self._child.ended is None:
            self._child.nudge(b"f")
            return
        self._child.close(family=True)
        for field in ("restarts", "ready", "exhausted"):  # nobody else writes them now
            self._memory.set_status(field, 0)
        with suppress(OSError):  # the system has no room for another process: it stays failed
            self._child = self._start_keeper()

    def plan(self, query: PlanQuery) -> None:
        """Ask with the newest state; the answer comes by `answer`."""
        occupancy, visits = query.occupancy[0], query.visits[0]
        if occupancy is not self._map:
            self._map, self._map_version = occupancy, self._map_version + 1
            searching = self.seconds_per_cell * grid_cells(occupancy)
            self.patience = max(self.patience, self.hang_after + searching)
            self._memory.write_map(self._map_version, occupancy)
        if visits is not self._visits:
            visits.count_in(self._memory.visits_of(visits))
            self._visits = visits
        self._number += 1
        self._asked[self._number] = _Asked(self.stamp, query.position[0].copy(), occupancy)
        if len(self._asked) > _REMEMBERED:
            self._asked.popitem(last=False)
        self._memory.ask(Question(self._number, query.position[0], query.goal[0], query.previous[0], self._map_version))
        try:
            os.write(self._questions, b"q")
        except (BlockingIOError, BrokenPipeError):  # it has not looked for long, or is gone: noticed by its silence
            pass

    def answer(self, now: float) -> Answer | None:
        reply = self._memory.answer()
        asked = None
        if reply is not None:
            self._silent_since = None
            self.plan_time.record(reply.seconds)
            self._count(reply.start, reply.counts)
            asked = self._asked.get(reply.number)
            wanted = reply.number >= self._wanted_from
            while self._asked and next(iter(self._asked)) <= reply.number:
                self._asked.popitem(last=False)
            if not wanted:
                asked = None
        self._watch(now)
        if asked is None or reply is None:
            return None
        self._wanted_from = self._number + 1  # what was asked meanwhile was asked for the same plan
        self._asked.clear()
        return Answer(reply.plan, asked.position, asked.stamp, asked.occupancy)

    def forget(self) -> None:
        self._wanted_from = self._number + 1
        self._asked.clear()
        self._silent_since = None

    def dismiss(self) -> None:
        """Have the planner's process end, and do not wait for it: `close` does, and is to follow."""
        self._child.dismiss()

    def close(self) -> None:
        """End the planner's process."""
        if self._questions >= 0:
            os.close(self._questions)
            self._questions = -1
            os.close(self._read_end)
            self._child.close(family=True)
            os.close(self._descriptor)

    def _start_keeper(self) -> Child:
        self._starts_before = self.status.starts
        descriptors = (self._read_end, self._descriptor)
        return Child("hiernav.runtime.planner_process", descriptors, descriptors)

    def _count(self, start: int, counts: Mapping[str, int]) -> None:
        if start != self._newest_start:
            self._ended_counts += self._newest_counts
        self._newest_start, self._newest_counts = start, Counter(counts)

    def _watch(self, now: float) -> None:
        """Have a planner that hangs started again."""
        if not self._asked or self.status.starts == self._starts_before:  # the keeper itself is still being loaded
            self._silent_since = None
        elif self._silent_since is None:
            self._silent_since = now
        elif now - self._silent_since > (self.patience if self.ready else LOADING):
            self._silent_since = now
            self._child.nudge(b"r")
