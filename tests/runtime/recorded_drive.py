"""Drives of the shipped point robot on a fake clock, watched and recorded."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from hiernav.nav.bundle import load_bundle
from hiernav.nav.goal import GOAL_RADIUS
from hiernav.runtime.about import About
from hiernav.runtime.clock import FakeClock
from hiernav.runtime.delayed_planner import DelayedPlanner
from hiernav.runtime.driver import Driver
from hiernav.runtime.driver_config import DriverConfig
from hiernav.runtime.estimate import EstimatorConfig
from hiernav.runtime.estimator import Estimator
from hiernav.runtime.guard import GuardConfig
from hiernav.runtime.noise import SensorNoise
from hiernav.runtime.observe import Event, Observer, TickRecord
from hiernav.runtime.pilot import Pilot
from hiernav.runtime.policy import load_networks, make_agent, make_planner
from hiernav.runtime.robot import SensorFrame
from hiernav.runtime.sim_robot import SimRobot
from hiernav.runtime.trip import RunResult
from hiernav.sim.layout import Layout, parse_world
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


def about(late: bool = False) -> About:
    """What a recording of `drive` says of itself; `late`: plans came later than they were asked for."""
    spec, bundle = get_robot("point"), load_bundle(BUNDLE)
    return About(
        robot="point",
        robot_radius=spec.radius,
        goal_radius=GOAL_RADIUS,
        control_period=spec.control_period,
        bundle=str(BUNDLE),
        hashes=dict(bundle.manifest.files),
        planner_process=late,
        estimator=ESTIMATOR,
        guard=GuardConfig(),
        predict=True,
    )


def drive(
    *observers: Observer,
    seed: int = 0,
    world: str = "pillar(2,2,10)",
    max_steps: int | None = None,
    noise: SensorNoise | None = None,
    damage: Callable[[SensorFrame], SensorFrame] = lambda frame: frame,
    pinned_from: float = math.inf,
    delay: float | None = None,
) -> RunResult:
    """Drive the point robot through one world, told to `observers`.

    `damage` is done to every frame; from the time `pinned_from` [s] on no command reaches the robot; with a `delay`,
    plans come so much later than they are asked for [s], as from a process of its own.
    """
    layout = sample_layout(parse_world(world), seed, get_robot("point").radius)
    with _driver(layout, noise, damage, pinned_from, delay=delay) as driver:
        driver.audience.observers = list(observers)
        return driver.run(layout.goal, max_steps)


class Operator(Observer):
    """Commands a loop that serves: `at(tick, record)` is called after each of its ticks, up to the last."""

    driver: Driver
    goal: np.ndarray

    def __init__(self, last: int, at: Callable[[Operator, int, TickRecord], None]) -> None:
        self._last, self._at, self.ticks = last, at, 0

    def tick(self, record: TickRecord) -> None:
        self._at(self, self.ticks, record)
        self.ticks += 1
        if self.ticks > self._last:
            self.driver.quit()


def serve(
    operator: Operator,
    *observers: Observer,
    pinned_from: float = math.inf,
    pinned_until: float = math.inf,
    fails_at: int = -1,
) -> None:
    """Have the point robot wait for what an operator commands; `send` fails once, the `fails_at`-th time."""
    layout = sample_layout(parse_world("pillar(2,2,10)"), 0, get_robot("point").radius)
    with _driver(layout, None, lambda frame: frame, pinned_from, pinned_until, fails_at) as driver:
        operator.driver, operator.goal = driver, layout.goal
        driver.audience.observers = [operator, *observers]
        driver.serve()


@contextmanager
def _driver(
    layout: Layout, noise: SensorNoise | None, *hindrances: Any, delay: float | None = None
) -> Iterator[Driver]:
    spec, bundle = get_robot("point"), load_bundle(BUNDLE)
    robot = SimRobot(spec, layout, noise, layout.seed)
    link = None
    if delay is not None:
        network = load_networks(bundle).planner
        link = DelayedPlanner(make_planner(bundle, network, spec.radius, GOAL_RADIUS), delay)
    try:
        yield Driver(
            _Hindered(robot, *hindrances),
            Pilot(make_agent(bundle, spec.radius, GOAL_RADIUS, link), link),
            robot.occupancy,
            FakeClock(),
            Estimator(ESTIMATOR),
            config=DriverConfig(goal_radius=GOAL_RADIUS, max_steps=layout.spec.max_steps),
        )
    finally:
        robot.close()


class _Hindered:
    def __init__(
        self,
        robot: SimRobot,
        damage: Callable[[SensorFrame], SensorFrame],
        pinned_from: float,
        pinned_until: float = math.inf,
        fails_at: int = -1,
    ) -> None:
        self._robot, self._damage, self._fails_at = robot, damage, fails_at
        self._pinned_from, self._pinned_until, self._sent = pinned_from, pinned_until, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._robot, name)

    def read(self) -> SensorFrame:
        return self._damage(self._robot.read())

    def send(self, action: np.ndarray) -> np.ndarray:
        self._sent += 1
        if self._sent == self._fails_at:
            raise OSError("bus error")
        pinned = self._pinned_from <= self._robot.truth().time < self._pinned_until
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
