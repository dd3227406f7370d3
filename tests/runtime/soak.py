"""A loop under random faults on a fake clock, and the rules that must hold in every tick of it."""

from __future__ import annotations

import hashlib
import math
import struct
from dataclasses import replace

import numpy as np
from puck import Puck, driver_of, follow, map_with, pilot_for

from hiernav.nav.option import PlanQuery
from hiernav.nav.planners import ShortestPathPlanner, StraightPlanner, VerifiedPlanner
from hiernav.runtime.clock import FakeClock
from hiernav.runtime.guard import Guard, GuardConfig
from hiernav.runtime.observe import Event, Observer, TickRecord
from hiernav.runtime.robot import SensorFrame
from hiernav.runtime.supervisor import TRANSITIONS, Mode

PERIOD = 0.02
SLEW = 0.5
MAPS = (map_with(), map_with((0.5, 0.3, 0.2, 0.2)), map_with((-0.6, -0.4, 0.2, 0.4)), map_with((0.0, 0.0, 0.1, 2.0)))
FAULTS = ("none",) * 6 + (
    "silence", "silent_sensor", "frozen", "nan", "spike", "kidnap", "old_stamp", "stall", "overload", "skill_nan",
    "skill_saturated", "planner_hangs", "planner_late", "plan_nan", "plan_outside", "map", "pinned", "goal", "cancel",
    "pause", "estop", "exception",
)  # fmt: skip


class Rules(Observer):
    """Fails at the first tick that breaks a rule, and digests all of them: the same seed gives the same digest."""

    def __init__(self) -> None:
        self.digest = hashlib.sha256()
        self.ticks = 0
        self.mode = Mode.INIT
        self.modes: dict[Mode, int] = dict.fromkeys(Mode, 0)
        self.broken: str | None = None

    def event(self, event: Event) -> None:
        self.digest.update(f"{event.time:.6f} {event.kind} {event.text}".encode())
        if event.kind == "mode":
            mode = Mode(event.values["mode"])
            if mode not in TRANSITIONS[self.mode] and not (
                self.mode in (Mode.FAULT, Mode.ESTOP) and mode is Mode.INIT and event.text == "acknowledged"
            ):
                self._fail(f"{self.mode} -> {mode}")
            self.mode = mode

    def tick(self, record: TickRecord) -> None:
        self.ticks += 1
        self.modes[record.mode] += 1
        if record.sent is not None:
            if not (np.isfinite(record.sent).all() and (np.abs(record.sent) <= 1.0).all()):
                self._fail(f"tick {record.index}: sent {record.sent}")
            if record.mode not in (Mode.RUNNING, Mode.RECOVERING):
                self._fail(f"tick {record.index}: sent {record.sent} in {record.mode}")
            self.digest.update(record.sent.tobytes())
        if record.estimate is not None and not np.isfinite(record.estimate.pose).all():
            self._fail(f"tick {record.index}: pose {record.estimate.pose}")
        self.digest.update(struct.pack("<dB", record.time, list(Mode).index(record.mode)))

    def _fail(self, why: str) -> None:
        self.broken = self.broken or why


class Spoiler:
    """A planner that can be made to say nonsense."""

    def __init__(self) -> None:
        self.planner = VerifiedPlanner(StraightPlanner(), ShortestPathPlanner(cache_size=4), 0.1)
        self.fault = "none"

    def plan(self, query: PlanQuery) -> np.ndarray:
        plans = self.planner.plan(query).copy()
        if self.fault == "plan_nan":
            plans[:, 5] = math.nan
        if self.fault == "plan_outside":
            plans[:, 5] += 7.0
        return plans


def soak(ticks: int, seed: int) -> Rules:
    """Serve goals for so many ticks, with a new fault every half a second or so."""
    rng = np.random.default_rng(seed)
    clock, rules, planner = FakeClock(), Rules(), Spoiler()
    fault, until, held = "none", 0.0, SensorFrame(0.0)
    occupancy = MAPS[0]

    def sees(frame: SensorFrame) -> SensorFrame:
        nonlocal held
        frame = replace(frame, stamp=clock.now())
        if fault == "silence":
            return held
        held, name = frame, ("velocimeter", "gyro", "magnetometer", "accelerometer", "position_fix")[seed % 5]
        if fault == "silent_sensor":
            return replace(frame, **{name: None})
        if fault == "frozen":
            return replace(frame, velocimeter=np.array([0.1, 0.2, 0.0]))
        if fault == "nan":
            return replace(frame, gyro=np.full(3, math.nan), position_fix=np.array([math.inf, 0.0]))
        if fault == "spike" and rng.random() < 0.2:
            return replace(frame, position_fix=rng.normal(0.0, 50.0, 2), velocimeter=rng.normal(0.0, 50.0, 3))
        if fault == "old_stamp":
            return replace(frame, stamp=frame.stamp - 0.3)
        return frame

    def skill(observations: np.ndarray) -> np.ndarray:
        if fault == "exception":
            raise RuntimeError("exploded")
        if fault == "stall":
            clock.advance(0.2)
        if fault == "overload":
            clock.advance(0.03)
        if fault == "skill_nan":
            return np.full((1, 2), math.nan, np.float32)
        if fault == "skill_saturated":
            return np.full((1, 2), 9.0, np.float32)
        return follow(observations)

    robot = Puck(control_period=PERIOD, noise=2e-3, sees=sees)
    robot.log = Forgetful()
    robot.sent = Forgetful()
    pilot = pilot_for(planner, 0.02, skill, PERIOD)
    guard = Guard(2, GuardConfig(slow_ttc=0.3, slew_limit=SLEW))
    driver = driver_of(robot, pilot, lambda stamp: occupancy, clock, guard=guard, observers=[rules])
    inner = driver._step

    def step(now: float) -> None:
        nonlocal fault, until, occupancy
        if now >= until:
            fault = FAULTS[rng.integers(len(FAULTS))]
            until = now + rng.exponential(0.6)
            planner.fault = fault
            pilot.link.delay = {"planner_hangs": math.inf, "planner_late": 0.3}.get(fault, 0.02)
            robot.pinned = fault == "pinned"
            if fault == "kidnap":
                robot.position = rng.uniform(-1.5, 1.5, 2)
            if fault == "map":
                occupancy = MAPS[rng.integers(len(MAPS))]
            if fault in ("cancel", "pause", "estop"):
                getattr(driver, fault)()
            if fault != "pause":
                driver.resume()
            if driver.supervisor.latched:
                driver.acknowledge()
                robot.position = np.zeros(2)
            if driver.goal is None or fault == "goal":
                driver.set_goal(rng.uniform(-2.2, 2.2, 2))
        if (np.abs(robot.position) > 2.0).any():
            robot.position = np.zeros(2)
        inner(now)
        if rules.ticks >= ticks or rules.broken:
            driver.quit()

    driver._step = step
    driver.serve()
    return rules


class Forgetful(list):
    """A list that keeps its last entry, so that a long run takes no memory."""

    def append(self, item: object) -> None:
        self[:] = [item]
