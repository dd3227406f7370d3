"""Drives of the shipped point robot on a fake clock, watched and recorded."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from hiernav.nav.bundle import load_bundle
from hiernav.runtime.about import About
from hiernav.runtime.clock import FakeClock
from hiernav.runtime.driver import Driver, DriverConfig, RunResult
from hiernav.runtime.estimator import Estimator, EstimatorConfig
from hiernav.runtime.guard import GuardConfig
from hiernav.runtime.observe import Event, Observer, TickRecord
from hiernav.runtime.pilot import Pilot
from hiernav.runtime.policy import make_agent
from hiernav.runtime.robot import SensorFrame
from hiernav.runtime.sim_robot import SensorNoise, SimRobot
from hiernav.sim.layout import GOAL_RADIUS, parse_world
from hiernav.sim.robots import get_robot
from hiernav.sim.worlds import sample_layout

BUNDLE = Path(__file__).parents[2] / "deploy" / "bundles" / "point"


class Memory(Observer):
    """Keeps everything it is told."""

    def __init__(self) -> None:
        self.records: list[TickRecord] = []
        self.events: list[Event] = []

    def tick(self, record: TickRecord) -> None:
        self.records.append(record)

    def event(self, event: Event) -> None:
        self.events.append(event)


ESTIMATOR = EstimatorConfig(tilts=False)


def about() -> About:
    """What a recording of `drive` says of itself."""
    spec, bundle = get_robot("point"), load_bundle(BUNDLE)
    return About(
        robot="point",
        robot_radius=spec.radius,
        goal_radius=GOAL_RADIUS,
        control_period=spec.control_period,
        bundle=str(BUNDLE),
        hashes=dict(bundle.manifest.files),
        planner_process=False,
        estimator=ESTIMATOR,
        guard=GuardConfig(),
    )


def drive(
    *observers: Observer,
    seed: int = 0,
    world: str = "pillar(2,2,10)",
    max_steps: int | None = None,
    noise: SensorNoise | None = None,
    damage: Callable[[SensorFrame], SensorFrame] = lambda frame: frame,
    pinned_from: float = math.inf,
) -> RunResult:
    """Drive the point robot through one world, told to `observers`.

    `damage` is done to every frame; from the time `pinned_from` [s] on no command reaches the robot.
    """
    spec, layout = get_robot("point"), sample_layout(parse_world(world), seed, get_robot("point").radius)
    robot = SimRobot(spec, layout, noise, seed)
    driver = Driver(
        _Hindered(robot, damage, pinned_from),
        Pilot(make_agent(load_bundle(BUNDLE), spec.radius, GOAL_RADIUS)),
        robot.occupancy,
        FakeClock(),
        Estimator(ESTIMATOR),
        config=DriverConfig(goal_radius=GOAL_RADIUS, max_steps=layout.spec.max_steps),
        observers=observers,
    )
    try:
        return driver.run(layout.goal, max_steps)
    finally:
        robot.close()


class _Hindered:
    def __init__(self, robot: SimRobot, damage: Callable[[SensorFrame], SensorFrame], pinned_from: float) -> None:
        self._robot, self._damage, self._pinned_from = robot, damage, pinned_from

    def __getattr__(self, name: str) -> Any:
        return getattr(self._robot, name)

    def read(self) -> SensorFrame:
        return self._damage(self._robot.read())

    def send(self, action: np.ndarray) -> np.ndarray:
        pinned = self._robot.truth().time >= self._pinned_from
        sent = self._robot.send(np.zeros_like(action) if pinned else action)
        return action if pinned else sent


def equal(a: object, b: object) -> bool:
    """Whether two values are the same bit for bit, arrays and NaN included."""
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        same = np.asarray(a).dtype == np.asarray(b).dtype and np.asarray(a).shape == np.asarray(b).shape
        return same and np.asarray(a).tobytes() == np.asarray(b).tobytes()
    if hasattr(a, "__dataclass_fields__") and type(a) is type(b):
        return all(equal(getattr(a, name), getattr(b, name)) for name in a.__dataclass_fields__)
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(equal(a[key], b[key]) for key in a)
    return a == b or (a != a and b != b)
