"""What has come of a run so far: the goals that have ended, and the faults, be they acknowledged or not."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable
from contextlib import suppress
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
    """Control steps with contact; None where nothing measures it."""
    true_distance: float | None = None
    """From the true position to the goal [m]; None where it is not known."""

    @classmethod
    def of(
        cls, seed: int | None, result: RunResult, goal: np.ndarray, truth: Truth | None, collisions: int = 0
    ) -> Episode:
        """With what was true at its end, if that is known.

        Args:
            seed: of its world.
            result: of the drive.
            goal: (2,) world frame [m].
            truth: at the end.
            collisions: that there had been at the beginning.
        """
        if truth is None:
            return cls(seed, result)
        return cls(seed, result, truth.collisions - collisions, float(np.linalg.norm(truth.pose[:2] - goal)))


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
        """Of all faults."""
        self.ends: Counter[str] = Counter()
        """Of all episodes, by `RunResult.reason`."""
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
        self.open: Fault | None = None
        """The one that nobody has acknowledged, whatever came on top of it."""

    def event(self, event: Event) -> None:
        mode = event.values.get("mode")
        if mode == Mode.FAULT.value:
            self.open = self.account.add_fault(event.text, event.time)
        elif mode == Mode.INIT.value and self.open is not None:  # out of FAULT and ESTOP nothing else leads there
            self.open.acknowledged, self.open = True, None


class GoalWatch(Observer):
    """Notes each goal that ends while a loop serves, once the robot is seen to stand or drives to the next one."""

    def __init__(self, driver: Driver, account: Account, seed: int | None = None) -> None:
        """
        Args:
            driver: that serves.
            account: that takes the goals.
            seed: of the world it serves in.
        """
        self.driver, self.account, self.seed = driver, account, seed
        self._ended: Trip | None = None
        self._newest: RunResult | None = None
        self._truth: Truth | None = None
        self._collisions = 0

    def event(self, event: Event) -> None:
        if event.kind == "end":
            self._ended = self.driver.last_trip
        elif event.kind == "goal" and "x" in event.values:
            self._take_result()
            self._collisions = 0 if self._truth is None else self._truth.collisions

    def tick(self, record: TickRecord) -> None:
        self._truth = record.truth
        self._take_result()

    def close(self) -> None:
        """The loop has ended, and with it the last goal."""
        with suppress(RuntimeError):  # the robot may be gone
            self._truth = self.driver.truth()
        self._take_result()

    def _take_result(self) -> None:
        """Of the goal that ended last, if the driver has it by now."""
        result = self.driver.last_result
        if result is None or result is self._newest or self._ended is None:
            return
        self._newest = result
        self._add(self._ended, result)

    def _add(self, trip: Trip, result: RunResult) -> None:
        if result.fault is None and result.reason in ("fault", "estop"):
            result = replace(result, fault=result.detail)  # it was acknowledged before the robot was seen to stand
        self.account.add(Episode.of(self.seed, result, trip.goal, self._truth, self._collisions))
        self._ended = None
