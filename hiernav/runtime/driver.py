"""Drives one robot to its goals: read, estimate, decide, guard, send; and waits, recovers or stops when it must."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from hiernav.nav.occupancy import OccupancyMap
from hiernav.nav.termination import TerminationReason
from hiernav.runtime.clock import Clock
from hiernav.runtime.collision import time_to_collision
from hiernav.runtime.driver_config import DriverConfig
from hiernav.runtime.estimate import Estimate, StateEstimator, Trust
from hiernav.runtime.estimator import Estimator
from hiernav.runtime.guard import Guard
from hiernav.runtime.loop import FixedRateLoop, LoopExit, noting_signals
from hiernav.runtime.mission import Mission
from hiernav.runtime.observe import Audience, Observer
from hiernav.runtime.pilot import Decision, Pilot
from hiernav.runtime.rehearsal import Rehearsal, warm_up
from hiernav.runtime.requests import Requests
from hiernav.runtime.robot import Robot, RobotGone, SensorFrame, Truth
from hiernav.runtime.terms import TermHold
from hiernav.runtime.tick import Tick
from hiernav.runtime.ticket import Ticket
from hiernav.runtime.timing import TickTimer
from hiernav.runtime.trip import RunResult, Trip
from hiernav.runtime.watchdogs import OverrunWatch, StopWatch, measured

SECTIONS = ("read", "estimate", "plan", "infer", "guard", "send")
FLUSH_SECONDS = 1.0
"""Time that observers are given to save their data once the robot is braked [s]."""

log = logging.getLogger(__name__)


@dataclass
class _Run:
    """One call of `run` or `serve`: what its next tick must know of the last ones."""

    first_tick: int
    """Ticks of the loop before this run: it counts them over all runs."""
    terms: TermHold
    overruns: OverrunWatch = field(default_factory=OverrunWatch)
    frame: SensorFrame | None = None
    """The newest that was read."""
    occupancy: OccupancyMap | None = None
    """The newest that was driven on."""
    unshown: Tick | None = None
    """The present tick, until observers were told of it."""
    told: tuple[str, str | None] = ("", None)
    """The failure that was logged last, and the fault that it led to."""


class Driver:
    """Ties robot, estimator, agent and guard together, one tick at a time.

    `run` drives to one goal, `serve` waits for goals. The robot is braked on every way out of either, and the stop is
    verified from its measured speed. Everything else that is public may be called from any thread while they run; it
    takes effect at the beginning of the next tick.
    """

    def __init__(
        self,
        robot: Robot,
        pilot: Pilot,
        occupancy: Callable[[float], OccupancyMap],
        clock: Clock,
        estimator: StateEstimator | None = None,
        guard: Guard | None = None,
        config: DriverConfig | None = None,
        observers: Sequence[Observer] = (),
        rehearsal: float = 0.0,
    ) -> None:
        """
        Args:
            robot: what is driven.
            pilot: planner and skill.
            occupancy: the known map at a stamp of the robot's clock [s].
            clock: paces the loop.
            estimator, guard, config: defaults if None.
            observers: told of every tick and event; one that raises is dropped.
            rehearsal: how long before each tick one is rehearsed to warm the caches [s]; 0, or a period of less than
                four times that, does without.

        Raises:
            ValueError: the policies are for another control rate than the robot's, or the guard for other actuators.
        """
        self.robot, self.pilot, self.occupancy, self.clock = robot, pilot, occupancy, clock
        self.estimator: StateEstimator = estimator or Estimator()
        self.guard = guard or Guard(robot.action_dim)
        self._require_fit()
        self.config = config or DriverConfig()
        self.timer = TickTimer(SECTIONS)
        self.audience = Audience(observers)
        period = robot.control_period
        self._mission = Mission(pilot, self.guard, self.estimator, self.config, self.audience, period)
        self.supervisor = self._mission.supervisor
        prepare = self._rehearse if 0.0 < 4.0 * rehearsal <= period else None
        self.loop = FixedRateLoop(clock, period, self._tick, robot.brake, prepare=prepare, lead=rehearsal)
        self._rehearsal: Rehearsal | None = None
        self.interrupted = False
        """Whether SIGINT, SIGTERM or SIGHUP arrived in the last run, be it while the robot was stopping at its goal."""
        self.gone: str | None = None
        """Why the last run ended though nobody asked for it: the robot cannot be read any more (`RobotGone`)."""
        self.stopped = True
        """Whether the robot was seen to stand at the end of the last run."""
        self._truth: Callable[[], Truth | None] | None = getattr(robot, "truth", None)
        self._stands: Callable[[], None] = getattr(robot, "stands", lambda: None)
        self._trouble: Callable[[], str | None] = getattr(robot, "trouble", lambda: None)
        self._requests = Requests()
        self._estimate: Estimate | None = None
        self._run = _Run(self.loop.ticks, TermHold(self.pilot.sensors))

    def _require_fit(self) -> None:
        trained, period = self.pilot.control_period, self.robot.control_period
        if not math.isclose(trained, period, rel_tol=1e-6):
            raise ValueError(f"Driver: the policies act every {trained:g} s, the robot every {period:g} s")
        if self.guard.action_dim != self.robot.action_dim:
            raise ValueError(
                f"Driver: the guard is for {self.guard.action_dim} actuators, the robot has {self.robot.action_dim}"
            )

    def run(self, goal: np.ndarray, max_steps: int | None = None) -> RunResult:
        """Drive to `goal` (2,), world frame [m], until it is reached or the run ends otherwise.

        Raises:
            ValueError: the goal is not two finite numbers.
            InvalidTransition: the last fault has not been acknowledged.
        """
        goal = _checked_goal(goal)
        self._begin()
        self._mission.start(goal, max_steps, self.clock.now())
        self._loop()
        assert self.last_result is not None
        return self.last_result

    def serve(self) -> None:
        """Stay ready for goals (`set_goal`), until `quit`, SIGINT, SIGTERM or SIGHUP, or until the robot is `gone`.

        Other faults are waited out, not raised.
        """
        self._begin()
        self._mission.serving = True
        self._loop()

    def set_goal(self, goal: np.ndarray) -> Ticket:
        """Drive to `goal` (2,), world frame [m], instead of to the present one if there is one.

        Raises:
            ValueError: the goal is not two finite numbers.
        """
        goal, ticket = _checked_goal(goal), Ticket()
        return self._requests.add(lambda now: self._mission.start(goal, None, now, ticket), ticket)

    def cancel(self) -> Ticket:
        """Give up the present goal, and stop."""
        return self._requests.add(lambda now: self._mission.end("cancelled", now))

    def pause(self) -> Ticket:
        """Wait, braked, until `resume`."""
        return self._requests.add(lambda now: setattr(self._mission, "paused", True))

    def resume(self) -> Ticket:
        """Go on after `pause`."""
        return self._requests.add(lambda now: setattr(self._mission, "paused", False))

    def estop(self, why: str = "emergency stop") -> Ticket:
        """Brake, and stay braked until `acknowledge`."""
        return self._requests.add_stop(why)

    def acknowledge(self) -> Ticket:
        """The cause of a fault or of an emergency stop is gone. The robot does not move before it gets a goal."""
        return self._requests.add(self._mission.acknowledge)

    def quit(self) -> None:
        """End `run` or `serve` after the present tick."""
        self.loop.stop()

    @property
    def goal(self) -> np.ndarray | None:
        """(2,) the present goal, world frame [m]."""
        trip = self._mission.trip
        return None if trip is None else trip.goal

    @property
    def paused(self) -> bool:
        """Whether it waits for `resume`, with a goal or without."""
        return self._mission.paused

    @property
    def last_trip(self) -> Trip | None:
        """The goal that ended last, whether the robot has been seen to stand since or not."""
        return self._mission.last_trip

    @property
    def last_result(self) -> RunResult | None:
        """What came of it, once the robot was seen to stand, or not to, or drives to another goal."""
        return self._mission.last_result

    @property
    def estimate(self) -> Estimate | None:
        """The newest; None until position and heading are known."""
        return self._estimate

    def _begin(self) -> None:
        self._mission.begin(self.stopped, self.clock.now())
        self._requests.drop_all("the loop had not begun")
        self.gone, self._estimate = None, None
        self._run = _Run(self.loop.ticks, TermHold(self.pilot.sensors))
        self.estimator.skill_sensors, self.estimator.driven = self.pilot.sensors, False
        self.estimator.reset()
        warm_up(self.estimator.config)

    def _loop(self) -> None:
        """Tick until done, brake, save what was observed, and make sure that the robot stands."""
        self.interrupted = False
        with noting_signals(lambda: setattr(self, "interrupted", True)):
            self.interrupted |= self.loop.run() is LoopExit.INTERRUPTED
            self._mission.end("interrupted", self.clock.now())
            self.audience.tell(lambda observer: observer.flush(FLUSH_SECONDS))
            stopped = self._stop()
            self.stopped = bool(stopped)
            if stopped:
                self._stands()
            self._mission.close(stopped, self.clock.now())

    def _stop(self) -> bool | None:
        """Brake until the measured speed shows that the robot stands.

        False if it does not in time, None if it cannot be read.
        """
        config = self.config
        watch = StopWatch(config.stop_speed, config.stop_turn, config.stop_timeout)
        watch.begin(self.clock.now())
        stopped: bool | None = None

        def tick(now: float) -> bool:
            nonlocal stopped
            self._estimate = self.estimator.update(self.robot.read())
            stopped = watch.check(self._estimate, now, *measured(self.estimator))
            if stopped is None:
                self.robot.brake()
            return stopped is not None

        try:
            # however often somebody asks for an end: `_loop` notes it, and the robot is braked until it stands
            FixedRateLoop(self.clock, self.robot.control_period, tick, self.robot.brake, handle_signals=False).run()
        except Exception:
            log.exception("the stop could not be verified")
            return None
        return bool(stopped)

    def _rehearse(self, again: bool) -> None:
        """Touch what the next tick will need. Whatever goes wrong here must not go wrong there.

        The first time a tick in which a plan ends, which has the memory at hand; `again` what most ticks are, which has
        the processor foresee the branches as well.
        """
        trip, estimate, frame, occupancy = self._mission.trip, self._estimate, self._run.frame, self._run.occupancy
        if trip is None or frame is None or estimate is None or occupancy is None:
            return
        try:
            if self._rehearsal is None:
                agent, radius = self.pilot.agent, self.config.robot_radius
                self._rehearsal = Rehearsal(agent, self.estimator.config, self.guard, radius)
            rehearse = getattr(self.robot, "rehearse", None)
            if rehearse is not None:
                rehearse()
            self._rehearsal(frame, estimate, trip.goal, occupancy, anew=not again)
        except Exception:
            log.exception("the rehearsal failed and is dropped")
            self.loop.drop_preparation("it failed")

    def _tick(self, now: float) -> bool:
        """One control step; True when the run is over. What goes wrong in it is a fault, not an exception."""
        try:
            self._step(now)
        except Exception as error:
            self._take_failure(error, now)
            self.estimator.driven = False
            self._mission.standing.postpone(now)  # what cannot be read cannot be seen to stand
            self.robot.brake()
            self._show()  # what the estimator has taken must not be missing in a recording
        return self.gone is not None or self._mission.over

    def _take_failure(self, error: Exception, now: float) -> None:
        """A fault, told of once as long as it is not acknowledged: a robot may fail alike at every tick."""
        why = f"{type(error).__name__}: {error}"
        kind = re.sub(r"[0-9]+", "", why)
        if (kind, self.supervisor.fault) != self._run.told:
            log.exception("control step failed")
        self._mission.fail(why, now)
        self._run.told = kind, self.supervisor.fault
        if isinstance(error, RobotGone):
            self.gone = why

    def _step(self, now: float) -> None:
        """Read, estimate, decide, guard, send; or brake, wherever one of them says that the robot must not move."""
        run, mission, timer = self._run, self._mission, self.timer
        run.unshown = None
        timer.begin()
        try:
            frame = run.frame = self.robot.read()
            truth = self._truth() if self._truth is not None and self.audience else None
            timer.mark("read")
            self._estimate = estimate = self.estimator.update(frame)
            tick = Tick(self.loop.ticks - run.first_tick - 1, now, self.loop.late, frame, truth, estimate)
            run.unshown = tick
            terms = run.terms.fill(frame)
            timer.mark("estimate")
        except Exception:
            self._take_requests(now)  # a robot that cannot be read can be stopped, and its fault acknowledged
            raise
        self._take_requests(now)
        trust, doubt = mission.blind.check(estimate, now, self.estimator.lacks)
        wait = run.overruns.check(self.loop.overruns_in_a_row) or self._trouble()
        if mission.trusts(trust, doubt, tick.stamp, now) and estimate is not None:
            tick.occupancy = run.occupancy = self._map_at(tick.stamp)
            trip = mission.advance(estimate, tick.occupancy, now)
            if trip is not None:
                lacks = self.pilot.lacks(terms)
                wait = wait or lacks
                if lacks is None:
                    tick.decision = self._decide(trip, terms, estimate, tick.occupancy, now)
        mission.choose_mode(tick, doubt if trust is Trust.HOLD else wait, now)
        guarded = False
        if mission.supervisor.driving and tick.decision is not None:
            tick.sent, tick.scale = self._send(tick, tick.decision, now)
            guarded = True
        self.estimator.driven = tick.sent is not None
        if tick.sent is None:
            self.robot.brake()
            fallen = None if guarded else self.guard.braked(None if estimate is None else estimate.upright)
            if fallen is not None and not mission.supervisor.latched:
                mission.fail(fallen, now)
            timer.mark("send")
            if not mission.supervisor.driving:  # else one tick was braked, not the robot
                mission.check_stop(estimate, now)
        timer.end()
        self._show()

    def _map_at(self, stamp: float) -> OccupancyMap:
        """The known map; where one is published again unchanged, the one that is known already."""
        occupancy, before = self.occupancy(stamp), self._run.occupancy
        if before is None or before is occupancy or not occupancy.shows_the_same_as(before):
            return occupancy
        return before

    def _take_requests(self, now: float) -> None:
        self.audience.tell(lambda observer: observer.make_requests())
        self._requests.take(now, self.loop.ticks, self._mission.estop)

    def _decide(
        self, trip: Trip, terms: dict[str, np.ndarray], estimate: Estimate, occupancy: OccupancyMap, now: float
    ) -> Decision:
        if not self.supervisor.driving:
            self.pilot.rest()
        decision = self.pilot.act(now, estimate, terms, trip.goal, occupancy)
        if decision.reason is not TerminationReason.NONE:
            trip.replans[decision.reason.name.lower()] += 1
        if decision.plan_seconds > 0.0:
            self.timer.mark_split("infer", "plan", decision.plan_seconds)
        else:
            self.timer.mark("infer")
        return decision

    def _send(self, tick: Tick, decision: Decision, now: float) -> tuple[np.ndarray | None, float]:
        """Past the guard to the robot; what was sent, None if the robot is to be braked, and how it was slowed."""
        estimate, occupancy = tick.estimate, tick.occupancy
        assert estimate is not None and occupancy is not None
        x, y, _ = estimate.pose.tolist()
        vx, vy = estimate.velocity.tolist()
        slow = self.guard.config.slow_ttc
        ttc = math.inf
        if slow is not None:
            ttc = time_to_collision(occupancy, (x, y), (vx, vy), self.config.robot_radius, slow)
        moving = estimate.body_velocity()
        guarded = self.guard.check(decision.action, estimate.upright, ttc, tick.plan_speed, moving)
        self.timer.mark("guard")
        if guarded.fault is not None:
            self._mission.fail(guarded.fault, now)
        if guarded.brake or guarded.fault is not None:
            return None, guarded.scale
        self._mission.watch_saturation(decision.action, now)
        if not self.supervisor.driving:
            return None, guarded.scale
        sent = self.robot.send(guarded.action)
        self._mission.count_step()
        self.timer.mark("send")
        return sent, guarded.scale

    def _show(self) -> None:
        """Tell of a tick, as far as it came, unless that was done."""
        tick, self._run.unshown = self._run.unshown, None
        if tick is None or not self.audience:
            return
        trip = self._mission.trip or self._mission.ended
        record = tick.record(self.supervisor.mode, None if trip is None else trip.goal, self.timer.last)
        self.audience.tell(lambda observer: observer.tick(record))


def _checked_goal(goal: np.ndarray) -> np.ndarray:
    checked = np.array(goal, dtype=np.float64)
    if checked.shape != (2,) or not np.isfinite(checked).all():
        raise ValueError(f"Driver: goal {goal} must be two finite coordinates [m]")
    return checked
