"""What recorders and viewers are shown of a run: one record per tick, and events between them."""

from __future__ import annotations

import logging
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from hiernav.nav.occupancy import OccupancyMap
from hiernav.nav.termination import TerminationReason
from hiernav.runtime.estimate import Estimate
from hiernav.runtime.robot import SensorFrame, Truth
from hiernav.runtime.supervisor import Mode

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TickRecord:
    """Everything about one tick. Nothing in it is written again, so it may be kept and read from other threads.

    What a braked tick did not come to is None: without an estimate nothing is decided, without a goal nothing planned.
    A tick that failed is told of as far as it came, if the estimator took its frame.
    """

    index: int
    """Ticks of this run before this one; deadlines that were skipped are not counted."""
    time: float
    """When the tick began, on the loop's clock [s]."""
    lateness: float
    """How long after its deadline it began [s]."""
    mode: Mode
    """At the end of the tick."""
    frame: SensorFrame
    """As the robot gave it. Its `stamp` is on the robot's clock, which need not be the loop's."""
    goal: np.ndarray | None = None
    """(2,) world frame [m]."""
    occupancy: OccupancyMap | None = None
    """Known map; the same object while nothing in it has moved."""
    estimate: Estimate | None = None
    """Pose and velocity with covariance, at `estimate.stamp`."""
    truth: Truth | None = None
    """Of a simulated robot, taken when its frame was read. Nothing that drives sees it."""
    plan: np.ndarray | None = None
    """(K, 2) waypoints that are followed, world frame [m]."""
    plan_start: np.ndarray | None = None
    """(2,) position they were made from [m]."""
    plan_stamp: float | None = None
    """Stamp of the estimate they were made from [s]."""
    plan_age: float | None = None
    """Age of that estimate now [s]."""
    reason: TerminationReason = TerminationReason.NONE
    """Why the plan before this tick ended and a new one was asked for."""
    replanned: bool = False
    """Whether a new plan is followed from this tick on; with a planner in its own process that is later than asked."""
    recovering: bool = False
    """Whether those waypoints are a way out that the robot is shown where it is stuck, whatever its mode."""
    observation: np.ndarray | None = None
    """(D,) float32, what the skill saw."""
    proposed: np.ndarray | None = None
    """(A,) float32, what the skill said."""
    sent: np.ndarray | None = None
    """(A,) what the robot was really sent, after the guard; None if it was braked."""
    speed_scale: float = 1.0
    """Factor by which the guard slowed the robot down."""
    timings: Mapping[str, float] = field(default_factory=dict)
    """Duration of each section of this tick [s]."""


@dataclass(frozen=True)
class Event:
    """Something that happened once."""

    time: float
    """On the loop's clock [s]."""
    kind: str
    """mode, goal, plan, end, stop or fault."""
    text: str
    """For people."""
    values: Mapping[str, float | int | str | bool | None] = field(default_factory=dict)
    """For machines."""


class Observer:
    """Is told of a run by the loop, and must never make it wait: copy what is needed, and work elsewhere.

    An observer that raises is dropped, and the robot drives on.
    """

    def make_requests(self) -> None:
        """Once in every tick, also where the robot cannot be read; the loop does what it is asked for in that tick."""

    def tick(self, record: TickRecord) -> None:
        """The end of every tick, after the action was sent."""

    def event(self, event: Event) -> None:
        """Something happened; the tick in which it did is told of afterwards."""

    def flush(self, timeout: float) -> None:
        """The run is over and the robot braked: bring to safety what was collected, within `timeout` [s]."""


class Audience:
    """All observers of a loop."""

    def __init__(self, observers: Sequence[Observer] = ()) -> None:
        self.observers = list(observers)
        self.dropped: dict[str, str] = {}
        """What the first of each class was dropped for."""

    def __bool__(self) -> bool:
        return bool(self.observers)

    def tell(self, what: Callable[[Observer], None]) -> None:
        """Call `what` with each observer; one that raises is dropped."""
        for observer in self.observers[:]:
            try:
                what(observer)
            except Exception as error:
                self.observers.remove(observer)
                name = type(observer).__name__
                log.exception("%s failed and is dropped", name)
                self.dropped.setdefault(name, _said(error))

    def emit(self, kind: str, text: str, now: float, **values: float | int | str | bool | None) -> None:
        """Tell of an event."""
        if self.observers:
            event = Event(now, kind, text, values)
            self.tell(lambda observer: observer.event(event))


def _said(error: Exception) -> str:
    """What an error says of itself, which it may be unable to."""
    with suppress(Exception):
        return "".join(traceback.format_exception_only(error)).strip()
    return type(error).__name__
