"""One goal on its way: what is counted meanwhile, and how it ended."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from hiernav.runtime.watchdogs import BlockedWatch, SaturationWatch

Counts = tuple[Counter[str], Counter[str], Counter[str]]
"""What guard, estimator and planner have counted, each by kind."""


@dataclass
class Trip:
    """A goal that is being driven to."""

    goal: np.ndarray
    """(2,) world frame [m]."""
    max_steps: int
    before: Counts
    """When it began."""
    no_way: BlockedWatch
    saturation: SaturationWatch
    steps: int = 0
    """Control steps driven."""
    began: float | None = None
    """Stamp of the frame at which the robot first moved [s]."""
    last: float = 0.0
    """Stamp of the newest frame [s]."""
    reason: str | None = None
    """How it ended."""
    detail: str = ""
    """What there is to add to the reason."""
    distance: float = float("nan")
    """From the last estimated position to the goal [m]."""
    holds: Counter[str] = field(default_factory=Counter)
    """How often it had to wait, by cause."""
    recoveries: int = 0
    saturated: int = 0
    """How often it was helped with an action that stayed saturated."""
    replans: Counter[str] = field(default_factory=Counter)

    @property
    def seconds(self) -> float:
        """Time it has taken on the robot's clock [s]."""
        return 0.0 if self.began is None else self.last - self.began

    def result(self, stopped: bool, fault: str | None, counts: Counts) -> RunResult:
        """How it ended, with what has been counted by now."""
        guard, estimator, planner = (dict(now - before) for now, before in zip(counts, self.before, strict=True))
        return RunResult(
            reason=self.reason or "interrupted",
            steps=self.steps,
            seconds=self.seconds,
            distance=self.distance,
            stopped=stopped,
            fault=fault,
            detail=self.detail,
            replans=dict(self.replans),
            guard=guard,
            estimator=estimator,
            holds=dict(self.holds),
            recoveries=self.recoveries,
            planner=planner,
        )


@dataclass(frozen=True)
class RunResult:
    """How a run ended."""

    reason: str
    """goal, left_field, timeout, unreachable, goal_outside, goal_occupied, start_outside, start_occupied, cancelled,
    changed (another goal came), interrupted, estop or fault."""
    steps: int
    """Control steps driven."""
    seconds: float
    """Time they took on the robot's clock [s]."""
    distance: float
    """From the last estimated position to the goal [m]; NaN if there was no estimate."""
    stopped: bool
    """Whether the measured speed showed that the robot stands."""
    fault: str | None = None
    detail: str = ""
    """What there is to add to the reason."""
    replans: Mapping[str, int] = field(default_factory=dict)
    """Plans that ended and were asked for anew, by termination reason."""
    guard: Mapping[str, int] = field(default_factory=dict)
    """How often the guard acted, by kind."""
    estimator: Mapping[str, int] = field(default_factory=dict)
    """What the estimator dropped or rejected, by kind."""
    holds: Mapping[str, int] = field(default_factory=dict)
    """How often the robot had to wait, by cause."""
    recoveries: int = 0
    planner: Mapping[str, int] = field(default_factory=dict)
    """Of this run: plans rejected, plans too late, restarts of the planner; proposals, repairs, refusals and why."""

    @property
    def reached(self) -> bool:
        return self.reason == "goal"

    @property
    def refused(self) -> bool:
        """Whether the goal was one that cannot be driven to."""
        return self.reason in REFUSALS


REFUSALS = frozenset({"unreachable", "goal_outside", "goal_occupied", "start_outside", "start_occupied"})
