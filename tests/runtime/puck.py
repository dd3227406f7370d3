"""A robot, a pilot and a driver for tests of what the loop does: no physics, no networks, no clock but the test's."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from hiernav.nav.agent import HierarchicalAgent
from hiernav.nav.observation import ObservationLayout, ObservationTerm
from hiernav.nav.occupancy import OccupancyMap, draw_boxes, empty_map
from hiernav.nav.option import Planner, WaypointOption
from hiernav.nav.termination import TerminationReason
from hiernav.runtime.clock import FakeClock
from hiernav.runtime.delayed_planner import DelayedPlanner
from hiernav.runtime.driver import Driver
from hiernav.runtime.estimate import Estimate, EstimatorConfig
from hiernav.runtime.estimator import Estimator
from hiernav.runtime.observe import Event, Observer, TickRecord
from hiernav.runtime.pilot import Decision, Pilot
from hiernav.runtime.robot import SensorFrame

GOAL = np.array([0.98, 0.0])
PERIOD = 0.1


@dataclass
class Puck:
    """A robot that slides where it is pushed: the action is its velocity in x and y."""

    control_period: float = PERIOD
    action_dim: int = 2
    position: np.ndarray = field(default_factory=lambda: np.zeros(2))
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(2))
    stamp: float = 0.0
    log: list[str] = field(default_factory=list)
    sees: Callable[[SensorFrame], SensorFrame] = lambda frame: frame
    stops: bool = True
    pinned: bool = False
    noise: float = 0.0
    """Of position and velocity [m, m/s]. A robot without any looks frozen while it stands."""
    sent: list[np.ndarray] = field(default_factory=list)
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))

    def read(self) -> SensorFrame:
        self.log.append("read")
        error = self.noise * self.rng.standard_normal(4) if self.noise else np.zeros(4)
        velocity = np.zeros(2) if self.pinned else self.velocity
        return self.sees(
            SensorFrame(
                stamp=self.stamp,
                accelerometer=np.array([0.0, 0.0, 9.81]),
                gyro=np.zeros(3),
                magnetometer=np.array([0.0, -0.5, 0.0]),
                velocimeter=np.array([*(velocity + error[2:]), 0.0]),
                lidar=np.zeros(10),
                position_fix=self.position + error[:2],
            )
        )

    def send(self, action: np.ndarray) -> np.ndarray:
        self.log.append("send")
        self.sent.append(action)
        self._move(action)
        return action

    def brake(self) -> None:
        self.log.append("brake")
        self._move(np.zeros(2) if self.stops else self.velocity)

    def close(self) -> None:
        self.log.append("close")

    def _move(self, velocity: np.ndarray) -> None:
        self.velocity = np.array(velocity)
        if not self.pinned:
            self.position = self.position + self.velocity * self.control_period
        self.stamp += self.control_period


@dataclass
class Scripted:
    """A pilot that goes straight at half speed, or does what `script` says at each step."""

    script: Callable[[int, np.ndarray], np.ndarray] = lambda step, straight: straight
    steps: int = 0
    resets: int = 0
    seen: list[Mapping[str, np.ndarray]] = field(default_factory=list)
    changes: Callable[[int], dict[str, object]] = lambda step: {}
    calls: list[str] = field(default_factory=list)
    failed: str | None = None
    rejected: int = 0
    late: int = 0
    restarts: int = 0
    plan_counts: Mapping[str, int] = field(default_factory=dict)
    sensors: Mapping[str, int] | None = None
    control_period: float | None = None
    """None: that of the robot it is given to (`driver_of`)."""

    def reset(self) -> None:
        self.steps = 0
        self.resets += 1

    def lacks(self, terms: Mapping[str, np.ndarray]) -> str | None:
        return None

    def rest(self) -> None: ...

    def drop(self) -> None:
        self.calls.append("drop")

    def replan(self) -> None:
        self.calls.append("replan")

    def recover(self) -> None:
        self.calls.append("recover")

    def renew(self) -> None:
        self.calls.append("renew")
        self.failed = None

    def act(
        self, now: float, estimate: Estimate, terms: Mapping[str, np.ndarray], goal: np.ndarray, occupancy: OccupancyMap
    ) -> Decision:
        assert estimate.pose.shape == (3,) and goal.shape == (2,) and isinstance(occupancy, OccupancyMap)
        self.seen.append(terms)
        towards = goal - estimate.pose[:2]
        action = self.script(self.steps, 0.5 * towards / np.linalg.norm(towards)).astype(np.float32)
        reason = TerminationReason.START if self.steps == 0 else TerminationReason.NONE
        if self.steps and self.steps % 5 == 0:
            reason = TerminationReason.HALF_INDEX
        replanned = reason is not TerminationReason.NONE
        if replanned:
            self.plan_stamp = estimate.stamp
        decision = Decision(
            action=action, observation=np.zeros(3, np.float32), reason=reason, plan=np.zeros((10, 2)),
            start=np.zeros(2), plan_stamp=self.plan_stamp, has_plan=True, replanned=replanned, overdue=0.0,
            refused=False, recovering=False, given_up=False, plan_seconds=0.001 if replanned else 0.0,
        )  # fmt: skip
        decision = replace(decision, **self.changes(self.steps))  # type: ignore[arg-type]
        self.steps += 1
        return decision


def driver_of(
    robot: Puck | None = None,
    pilot: Scripted | Pilot | None = None,
    occupancy: Callable[[float], OccupancyMap] | None = None,
    clock: FakeClock | None = None,
    **settings: object,
) -> Driver:
    field_map, robot, pilot = empty_map((2.0, 2.0)), robot or Puck(), pilot or Scripted()
    if isinstance(pilot, Scripted) and pilot.control_period is None:
        pilot.control_period = robot.control_period
    settings.setdefault("estimator", Estimator(EstimatorConfig(tilts=False, confirm=False)))
    known = occupancy or (lambda stamp: field_map)
    return Driver(robot, pilot, known, clock or FakeClock(), **settings)  # type: ignore[arg-type]


LAYOUT = ObservationLayout((ObservationTerm("waypoints", 20, "m, body frame", 1.0),))


def follow(observations: np.ndarray) -> np.ndarray:
    """A skill for the puck, whose heading is that of the world: towards the seventh waypoint, at up to 0.5 m/s."""
    ahead = observations[:, 12:14]
    length = np.linalg.norm(ahead, axis=1, keepdims=True)
    return (0.5 * ahead / np.maximum(length, 0.2)).astype(np.float32)


def pilot_for(planner: Planner, delay: float | None = None, skill: Callable = follow, period: float = PERIOD) -> Pilot:
    """The real agent and the real pilot around `follow`; with a delay, plans are late by it [s]."""
    link = None if delay is None else DelayedPlanner(planner, delay)
    option = WaypointOption(link or planner, num_rows=1)
    return Pilot(HierarchicalAgent(option, skill, LAYOUT, period), link)


def map_with(*boxes: tuple[float, float, float, float], half: float = 2.0) -> OccupancyMap:
    """A square field with boxes x, y, half_x, half_y [m]."""
    occupancy = empty_map((half, half))
    occupied = occupancy.occupied.copy()
    for x, y, half_x, half_y in boxes:
        draw_boxes(occupied, occupancy.origin, occupancy.resolution, [[x, y]], [[half_x, half_y]])
    return OccupancyMap(occupied, occupancy.resolution, occupancy.origin)


class Listener(Observer):
    def __init__(self) -> None:
        self.records: list[TickRecord] = []
        self.events: list[Event] = []
        self.flushed: list[int] = []

    def tick(self, record: TickRecord) -> None:
        self.records.append(record)

    def event(self, event: Event) -> None:
        self.events.append(event)

    def flush(self, timeout: float) -> None:
        self.flushed.append(len(self.records))
