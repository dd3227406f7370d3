"""What has come of a run so far: the goals that have ended, and the faults, be they acknowledged or not."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from hiernav.runtime.driver import Driver
from hiernav.runtime.observe import Event, Observer, TickRecord
from hiernav.runtime.robot import Truth
from hiernav.runtime.supervisor import Mode
from hiernav.runtime.trip import RunResult, Trip

KEPT = 1000
"""Faults that are named, and goals of a loop that serves: the newest. All are counted."""


@dataclass(frozen=True)
class Episode:
    """One goal, with what only its surroundings know."""

    seed: int | None
    result: RunResult
    collisions: int | None = None
    """Control steps with contact until it ended; None where nothing measures it."""
    true_distance: float | None = None
    """From the true position to the goal in the tick that ended it [m]; None where it is not known."""


@dataclass
class Fault:
    """Something that had to be looked at."""

    seconds: float
    """When it came, since the account was opened, on the loop's clock [s]."""
    why: str
    acknowledged: bool = False


class Account:
    """Episodes and faults, and totals that go on where the oldest of them are dropped."""

    def __init__(self, episodes: Iterable[Episode] = (), kept: int | None = None, began: float = 0.0) -> None:
        """
        Args:
            episodes: those there are already.
            kept: episodes that are kept, the newest; all if None.
            began: when it was opened, on the loop's clock [s].
        """
        self.began = began
        self.episodes: deque[Episode] = deque(maxlen=kept)
        self.faults: deque[Fault] = deque(maxlen=KEPT)
        self.fault_count = 0
        """All there were, also those that are no longer named in `faults`."""
        self.ends: Counter[str] = Counter()
        """How many episodes ended, by `RunResult.reason`, also those that are no longer kept."""
        self.replans: Counter[str] = Counter()
        self.plans: Counter[str] = Counter()
        self.guard: Counter[str] = Counter()
        for episode in episodes:
            self.add(episode)

    def add(self, episode: Episode) -> None:
        """A goal has ended."""
        result = episode.result
        self.episodes.append(episode)
        self.ends[result.reason] += 1
        self.replans.update(result.replans)
        self.plans.update(result.planner)
        self.guard.update(result.guard)

    def add_fault(self, why: str, now: float) -> Fault:
        """Something went wrong at `now` [s], on the loop's clock."""
        fault = Fault(now - self.began, why)
        self.faults.append(fault)
        self.fault_count += 1
        return fault


class FaultWatch(Observer):
    """Notes each fault, whether there is a goal or not."""

    def __init__(self, account: Account) -> None:
        self.account = account
        self.open: list[Fault] = []
        """Those that nobody has acknowledged."""

    def event(self, event: Event) -> None:
        mode = event.values.get("mode")
        if event.kind == "fault" or mode == Mode.FAULT.value:
            self.open.append(self.account.add_fault(event.text, event.time))
        elif mode == Mode.INIT.value:  # out of FAULT and ESTOP nothing but an acknowledgement leads there
            for fault in self.open:
                fault.acknowledged = True
            self.open.clear()


class GoalWatch(Observer):
    """Notes each goal that ends, once the robot is seen to stand or drives to the next one."""

    def __init__(self, driver: Driver, account: Account, seed: int | None = None) -> None:
        """
        Args:
            driver: that drives.
            account: that takes the goals.
            seed: of the world it drives in.
        """
        self.driver, self.account, self.seed = driver, account, seed
        self._ended: Trip | None = None
        self._newest: RunResult | None = None
        self._truth: Truth | None = None
        """Of the newest tick, or of the one in which a goal ended that is not noted yet."""
        self._settled = False
        """Whether `_truth` is of the tick in which a goal ended."""
        self._before: int | None = None
        """Collisions that there had been when the goal was set; None if that was in this tick."""

    def event(self, event: Event) -> None:
        if event.kind == "end":
            self._ended, self._settled = self.driver.last_trip, False
        elif event.kind == "goal" and "x" in event.values:
            self.take_result()
            self._ended, self._before = None, None

    def tick(self, record: TickRecord) -> None:
        if not self._settled:  # a tick is told of after what happened in it
            self._truth, self._settled = record.truth, self._ended is not None
        if self._before is None and record.truth is not None:
            self._before = record.truth.collisions
        self.take_result()

    def take_result(self) -> None:
        """Note the goal that ended last, if the driver has its result by now; to be called when a loop has ended."""
        trip, result = self._ended, self.driver.last_result
        if trip is None or result is None or result is self._newest:
            return
        self._newest, self._ended, self._settled = result, None, False
        if result.fault is None and result.reason in ("fault", "estop"):
            result = replace(result, fault=result.detail)  # it was acknowledged before the robot was seen to stand
        collisions, distance = None, None
        if self._truth is not None:
            collisions = 0 if self._before is None else self._truth.collisions - self._before
            distance = float(np.linalg.norm(self._truth.pose[:2] - trip.goal))
        self.account.add(Episode(self.seed, result, collisions, distance))
