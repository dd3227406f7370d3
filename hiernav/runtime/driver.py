"""Drives one robot to one goal at a time: read, estimate, plan, infer, guard, send."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from hiernav.nav.occupancy import OccupancyMap
from hiernav.nav.option import TerminationReason
from hiernav.runtime.clock import Clock
from hiernav.runtime.estimator import Estimate, Estimator, EstimatorConfig
from hiernav.runtime.guard import Guard
from hiernav.runtime.loop import FixedRateLoop, LoopExit
from hiernav.runtime.observe import Event, Observer, TickRecord
from hiernav.runtime.robot import Robot, SensorFrame, Truth
from hiernav.runtime.supervisor import Mode, Supervisor
from hiernav.runtime.terms import TermHold
from hiernav.runtime.timing import TickTimer

SECTIONS = ("read", "estimate", "plan", "infer", "guard", "send")

FLUSH_SECONDS = 1.0
"""What observers are given to bring their data to safety once the robot is braked [s]."""

log = logging.getLogger(__name__)


class Decision(Protocol):
    """What the driver needs of an agent's step; each array has one row."""

    @property
    def action(self) -> np.ndarray: ...
    @property
    def reason(self) -> np.ndarray: ...
    @property
    def plan(self) -> np.ndarray: ...
    @property
    def replanned(self) -> np.ndarray: ...
    @property
    def plan_seconds(self) -> float: ...
    @property
    def observation(self) -> np.ndarray: ...
    @property
    def proposed(self) -> np.ndarray: ...
    @property
    def start(self) -> np.ndarray: ...


class Agent(Protocol):
    """Planner and skill, such as `hiernav.nav.option.HierarchicalAgent` with one row."""

    def reset(self) -> None: ...

    def act(
        self, pose: np.ndarray, terms: Mapping[str, np.ndarray], goal: np.ndarray, occupancy: Sequence[OccupancyMap]
    ) -> Decision: ...


@dataclass(frozen=True)
class DriverConfig:
    """When a run ends."""

    goal_radius: float = 0.3
    """The goal is reached within this distance of the estimated position [m]."""
    max_steps: int = 300
    """Control steps after which a run ends by timeout."""
    blind_timeout: float = 2.0
    """Without a fresh estimate for this long, at the start or while running, the run ends in a fault [s]."""
    blind_ticks: int = 5
    """An estimate that has not changed for more control periods than this is not driven on."""
    stop_speed: float = 0.1
    """A robot slower than this, three readings in a row, has stopped [m/s]."""
    stop_timeout: float = 3.0
    """Time the robot is given to stop [s]."""

    def __post_init__(self) -> None:
        for name, value in self.__dict__.items():
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"DriverConfig.{name} = {value} must be finite and positive")


@dataclass(frozen=True)
class RunResult:
    """How a run ended."""

    reason: str
    """goal, left_field, timeout, fault or interrupted."""
    steps: int
    """Control steps driven."""
    seconds: float
    """Time they took on the robot's clock [s]."""
    distance: float
    """From the last estimated position to the goal [m]; NaN if there was no estimate."""
    stopped: bool
    """Whether the measured speed showed that the robot stands."""
    fault: str | None = None
    replans: Mapping[str, int] = field(default_factory=dict)
    """New plans by termination reason."""
    guard: Mapping[str, int] = field(default_factory=dict)
    """How often the guard acted, by kind."""
    estimator: Mapping[str, int] = field(default_factory=dict)
    """What the estimator dropped or rejected, by kind."""

    @property
    def reached(self) -> bool:
        return self.reason == "goal"


class Driver:
    """Ties robot, estimator, agent and guard together, one tick at a time.

    The robot is braked on every way out of `run`, and the stop is verified from its measured speed.
    """

    def __init__(
        self,
        robot: Robot,
        agent: Agent,
        occupancy: Callable[[float], OccupancyMap],
        clock: Clock,
        estimator: Estimator | None = None,
        guard: Guard | None = None,
        config: DriverConfig | None = None,
        timer: TickTimer | None = None,
        observers: Sequence[Observer] = (),
    ) -> None:
        """
        Args:
            robot: what is driven.
            agent: planner and skill.
            occupancy: the known map at a stamp of the robot's clock [s]; the same object while nothing has moved.
            clock: paces the loop.
            estimator, guard, config, timer: defaults if None.
            observers: told of every tick and event; one that raises is dropped.
        """
        self.robot, self.agent, self.occupancy, self.clock = robot, agent, occupancy, clock
        self.estimator = estimator or Estimator()
        self.guard = guard or Guard(robot.action_dim)
        self.config = config or DriverConfig()
        self.timer = timer or TickTimer(SECTIONS)
        self.supervisor = Supervisor(lambda now, mode, why: self._emit("mode", why, now, mode=mode.value))
        self.loop = FixedRateLoop(clock, robot.control_period, self._tick, robot.brake)
        self.observers = list(observers)
        self._truth: Callable[[], Truth] | None = getattr(robot, "truth", None)
        self.interrupted = False
        """Whether SIGINT or SIGTERM arrived during the last run, be it while the robot was stopping at its goal."""

    def run(self, goal: np.ndarray, max_steps: int | None = None) -> RunResult:
        """Drive to `goal` (2,), world frame [m], until it is reached or the run ends otherwise.

        Raises:
            ValueError: the goal is not two finite numbers.
            InvalidTransition: the last fault has not been acknowledged.
        """
        self.goal = np.array(goal, dtype=np.float64)
        if self.goal.shape != (2,) or not np.isfinite(self.goal).all():
            raise ValueError(f"Driver.run: goal {goal} must be two finite coordinates [m]")
        if self.supervisor.mode is not Mode.INIT:
            self.supervisor.change(Mode.INIT, "new run", self.clock.now())
        self._max_steps = max_steps or self.config.max_steps
        self._steps = 0
        self._reason: str | None = None
        self._estimate: Estimate | None = None
        self._began_at: float | None = None
        self._last_stamp = 0.0
        self._fresh_at: float | None = None
        self._fresh_stamp = -math.inf
        self._terms = TermHold()
        self._plan_stamp: float | None = None
        self._replans: Counter[str] = Counter()
        self._emit("goal", f"{self.goal[0]:g}, {self.goal[1]:g}", self.clock.now(), x=self.goal[0], y=self.goal[1])
        self.agent.reset()
        self.guard.reset()
        self.estimator.reset()
        _warm_up(self.estimator.config)
        guard_before, estimator_before = self.guard.counts.copy(), self.estimator.counts.copy()

        self.interrupted = self.loop.run() is LoopExit.INTERRUPTED
        if self.interrupted:
            self._reason = "interrupted"
        reason = self._reason or "interrupted"
        self._tell(lambda observer: observer.flush(FLUSH_SECONDS))
        stopped = self._stop()
        if self.supervisor.mode is not Mode.FAULT:
            self.supervisor.change(Mode.STOPPED, reason, self.clock.now())
        self._emit("end", reason, self.clock.now(), steps=self._steps, stopped=stopped)
        position = self._estimate.pose[:2] if self._estimate is not None else np.full(2, np.nan)
        return RunResult(
            reason=reason,
            steps=self._steps,
            seconds=0.0 if self._began_at is None else self._last_stamp - self._began_at,
            distance=float(np.linalg.norm(position - self.goal)),
            stopped=stopped,
            fault=self.supervisor.fault,
            replans=dict(self._replans),
            guard=dict(self.guard.counts - guard_before),
            estimator=dict(self.estimator.counts - estimator_before),
        )

    def _tick(self, now: float) -> bool:
        """One control step; True when the run is over. What goes wrong in it is a fault, not an exception."""
        try:
            return self._step(now)
        except Exception as error:
            log.exception("control step failed")
            self._fail(f"{type(error).__name__}: {error}", now)
            return True

    def _step(self, now: float) -> bool:
        timer = self.timer
        timer.begin()
        frame = self.robot.read()
        truth = self._truth() if self._truth is not None and self.observers else None
        self._last_stamp = frame.stamp
        timer.mark("read")
        self._estimate = estimate = self.estimator.update(frame)
        timer.mark("estimate")
        if self._is_blind(estimate, now) or estimate is None:
            self.robot.brake()
            timer.mark("send")
            self._finish_tick(now, frame, truth, estimate, None, None, None)
            return self._reason is not None
        if self.supervisor.mode is not Mode.RUNNING:
            self._start(frame.stamp, now)
        occupancy = self.occupancy(frame.stamp)
        if self._is_over(estimate, occupancy):
            self._finish_tick(now, frame, truth, estimate, occupancy, None, None)
            return True

        decision = self.agent.act(estimate.pose[None], self._terms.fill(frame), self.goal[None], [occupancy])
        if bool(decision.replanned[0]):
            self._replans[TerminationReason(int(decision.reason[0])).name.lower()] += 1
            self._plan_stamp = estimate.stamp
            timer.mark_split("infer", "plan", float(decision.plan_seconds))
        else:
            timer.mark("infer")
        guarded = self.guard.check(decision.action[0], estimate.upright)
        timer.mark("guard")
        sent = self.robot.send(guarded.action)
        timer.mark("send")
        self._steps += 1
        if guarded.fault is not None:
            self._fail(guarded.fault, now)
        self._finish_tick(now, frame, truth, estimate, occupancy, decision, sent)
        return self._reason is not None

    def _start(self, stamp: float, now: float) -> None:
        self.supervisor.change(Mode.READY, "position and heading known", now)
        self.supervisor.change(Mode.ARMED, f"goal {self.goal.tolist()}", now)
        self.supervisor.change(Mode.RUNNING, "first action", now)
        self._began_at = stamp

    def _is_over(self, estimate: Estimate, occupancy: OccupancyMap) -> bool:
        position = estimate.pose[:2]
        if math.dist(position, self.goal) <= self.config.goal_radius:
            self._reason = "goal"
        elif not occupancy.contains(position):
            self._reason = "left_field"
        elif self._steps >= self._max_steps:
            self._reason = "timeout"
        return self._reason is not None

    def _is_blind(self, estimate: Estimate | None, now: float) -> bool:
        """Whether there is no estimate, or one that sensors no longer renew; for too long, that is a fault."""
        if self._fresh_at is None:
            self._fresh_at = now
        if estimate is not None and estimate.stamp > self._fresh_stamp:
            self._fresh_at, self._fresh_stamp = now, estimate.stamp
            return False
        age = now - self._fresh_at
        if age > self.config.blind_timeout:
            self._fail(f"no fresh position and heading for {self.config.blind_timeout:g} s", now)
        return estimate is None or age > self.config.blind_ticks * self.robot.control_period

    def _fail(self, why: str, now: float) -> None:
        self._reason = "fault"
        self.supervisor.fail(why, now)

    def _finish_tick(
        self,
        now: float,
        frame: SensorFrame,
        truth: Truth | None,
        estimate: Estimate | None,
        occupancy: OccupancyMap | None,
        decision: Decision | None,
        sent: np.ndarray | None,
    ) -> None:
        self.timer.end()
        if not self.observers:
            return
        record = TickRecord(
            index=self.loop.ticks - 1,
            time=now,
            lateness=self.loop.late,
            mode=self.supervisor.mode,
            frame=frame,
            goal=self.goal,
            occupancy=occupancy,
            estimate=estimate,
            truth=truth,
            sent=sent,
            timings=self.timer.last,
        )
        if decision is not None and estimate is not None:
            record = replace(
                record,
                plan=decision.plan[0],
                plan_start=decision.start[0],
                plan_stamp=self._plan_stamp,
                plan_age=None if self._plan_stamp is None else estimate.stamp - self._plan_stamp,
                reason=TerminationReason(int(decision.reason[0])),
                replanned=bool(decision.replanned[0]),
                observation=decision.observation[0],
                proposed=decision.proposed[0],
            )
        self._tell(lambda observer: observer.tick(record))

    def _tell(self, what: Callable[[Observer], None]) -> None:
        for observer in self.observers[:]:
            try:
                what(observer)
            except Exception:
                log.exception("observer failed and is dropped")
                self.observers.remove(observer)

    def _emit(self, kind: str, text: str, now: float, **values: float | int | str | bool | None) -> None:
        if self.observers:
            event = Event(now, kind, text, values)
            self._tell(lambda observer: observer.event(event))

    def _stop(self) -> bool:
        """Brake until the measured speed shows that the robot stands; False if it could not be shown in time."""
        ticks = math.ceil(self.config.stop_timeout / self.robot.control_period)
        slow = 0

        def tick(now: float) -> bool:
            nonlocal ticks, slow
            estimate = self.estimator.update(self.robot.read())
            speed = math.hypot(*estimate.velocity) if estimate is not None else math.inf
            slow = slow + 1 if speed < self.config.stop_speed else 0
            ticks -= 1
            if slow >= 3 or ticks <= 0:
                return True
            self.robot.brake()
            return False

        try:
            loop = FixedRateLoop(self.clock, self.robot.control_period, tick, self.robot.brake)
            self.interrupted |= loop.run() is LoopExit.INTERRUPTED
        except Exception:
            log.exception("the stop could not be verified")
            return False
        return slow >= 3


def _warm_up(config: EstimatorConfig) -> None:
    """Have the linear algebra make its buffers now: with locked memory the first call takes up to 0.2 s."""
    scratch = Estimator(config)
    for stamp in (0.0, 0.01):
        field, still = np.array(config.magnetic_field), np.zeros(3)
        scratch.update(SensorFrame(stamp, still, still, field, still, position_fix=np.zeros(2)))
