"""One control step while it is made, and what observers are told of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hiernav.nav.occupancy import OccupancyMap
from hiernav.runtime.estimate import Estimate
from hiernav.runtime.observe import TickRecord
from hiernav.runtime.pilot import Decision
from hiernav.runtime.robot import SensorFrame, Truth
from hiernav.runtime.supervisor import Mode


@dataclass
class Tick:
    """How far a control step has come: what it did not come to is None."""

    index: int
    """As in `TickRecord`, like the following."""
    time: float
    lateness: float
    frame: SensorFrame
    truth: Truth | None
    estimate: Estimate | None
    occupancy: OccupancyMap | None = None
    decision: Decision | None = None
    sent: np.ndarray | None = None
    plan_speed: float = 1.0
    """What the plan's age allows of the speed."""
    scale: float = 1.0
    """What was left of the command's size."""

    @property
    def stamp(self) -> float:
        """Of its estimate, or of its frame where there is none [s]."""
        return self.frame.stamp if self.estimate is None else self.estimate.stamp

    def record(self, mode: Mode, goal: np.ndarray | None, timings: Mapping[str, float]) -> TickRecord:
        """What observers are told, with `mode` and `timings` as they are at the end."""
        decision = self.decision
        plan: dict[str, object] = {}
        if decision is not None:
            stamp = decision.plan_stamp
            plan = {
                "plan": decision.plan,
                "plan_start": decision.start,
                "plan_stamp": stamp,
                "plan_age": None if stamp is None else self.stamp - stamp,
                "reason": decision.reason,
                "replanned": decision.replanned,
                "recovering": decision.recovering,
                "observation": decision.observation,
                "proposed": decision.action,
            }
        return TickRecord(
            index=self.index,
            time=self.time,
            lateness=self.lateness,
            mode=mode,
            frame=self.frame,
            goal=goal,
            occupancy=self.occupancy,
            estimate=self.estimate,
            truth=self.truth,
            sent=self.sent,
            speed_scale=self.scale,
            timings=timings,
            **plan,  # type: ignore[arg-type]
        )
