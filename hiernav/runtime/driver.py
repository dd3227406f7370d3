"""Drives one robot to its goals: read, estimate, decide, guard, send; and waits, recovers or stops when it must."""

from __future__ import annotations

import logging
import math
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hiernav.nav.goal import GoalRefused, place_goal
from hiernav.nav.occupancy import OccupancyMap
from hiernav.nav.termination import TerminationReason
from hiernav.runtime.clock import Clock
from hiernav.runtime.collision import time_to_collision
from hiernav.runtime.driver_config import DriverConfig
from hiernav.runtime.estimate import Estimate, EstimatorConfig, Trust
from hiernav.runtime.estimator import Estimator
from hiernav.runtime.guard import Guard
from hiernav.runtime.loop import FixedRateLoop, LoopExit, noting_signals
from hiernav.runtime.observe import Audience, Observer, TickRecord
from hiernav.runtime.pilot import Decision, Pilot
from hiernav.runtime.rehearsal import Rehearsal
from hiernav.runtime.requests import Requests
from hiernav.runtime.robot import Robot, RobotGone, SensorFrame, Truth
from hiernav.runtime.supervisor import Mode, Supervisor
from hiernav.runtime.terms import TermHold
from hiernav.runtime.ticket import Ticket
from hiernav.runtime.timing import TickTimer
from hiernav.runtime.trip import RunResult, Trip
from hiernav.runtime.watchdogs import BlindWatch, BlockedWatch, OverrunWatch, PlanWatch, SaturationWatch, StopWatch

SECTIONS = ("read", "estimate", "plan", "infer", "guard", "send")
FLUSH_SECONDS = 1.0
"""Time that observers are given to save their data once the robot is braked [s]."""
MAX_SATURATED = 3
"""Recoveries from a saturated action on the way to one goal."""

log = logging.getLogger(__name__)


@dataclass
class _Seen:
    """How far a tick has come."""

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


@dataclass
class _Run:
    """One call of `run` or `serve`: its watches, and what the next tick must know of the last ones."""

    first_tick: int
    """Ticks of the loop before this run: it counts them over all runs."""
    terms: TermHold
    blind: BlindWatch
    overruns: OverrunWatch
    plans: PlanWatch
    no_way: BlockedWatch
    saturation: SaturationWatch
    standing: StopWatch
    must_stand: bool
    """Whether the robot must be seen to stand before any goal is driven to."""
    driven: bool = False
    """Whether any action was sent."""
    saturated: int = 0
    """Recoveries from a saturated action on the way to the present goal."""
    frame: SensorFrame | None = None
    """The newest that was read."""
    occupancy: OccupancyMap | None = None
    """The newest that was driven on."""
    restarts: int | None = None
    """`Estimate.restarts` for which plans have been dropped; None before the first estimate."""
    unshown: _Seen | None = None
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
        estimator: Estimator | None = None,
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
        self.estimator = estimator or Estimator()
        self.guard = guard or Guard(robot.action_dim)
        self._require_fit()
        self.config = config or DriverConfig()
        self.timer = TickTimer(SECTIONS)
        self.audience = Audience(observers)
        self.supervisor = Supervisor(lambda now, mode, why: self.audience.emit("mode", why, now, mode=mode.value))
        prepare = self._rehearse if 0.0 < 4.0 * rehearsal <= robot.control_period else None
        self.loop = FixedRateLoop(clock, robot.control_period, self._tick, robot.brake, prepare=prepare, lead=rehearsal)
        self._rehearsal: Rehearsal | None = None
        self.interrupted = False
        """Whether SIGINT, SIGTERM or SIGHUP arrived in the last run, be it while the robot was stopping at its goal."""
        self.gone: str | None = None
        """Why the last run ended though nobody asked for it: the robot cannot be read any more (`RobotGone`)."""
        self.last_trip: Trip | None = None
        """The goal that ended last, whether the robot has been seen to stand since or not."""
        self.last_result: RunResult | None = None
        """What came of it, once the robot was seen to stand, or not to, or drives to another goal."""
        self.stopped = True
        """Whether the robot was seen to stand at the end of the last run."""
        self._truth: Callable[[], Truth | None] | None = getattr(robot, "truth", None)
        self._stands: Callable[[], None] = getattr(robot, "stands", lambda: None)
        self._trouble: Callable[[], str | None] = getattr(robot, "trouble", lambda: None)
        self._requests = Requests()
        self._trip: Trip | None = None
        self._ended: Trip | None = None
        self._estimate: Estimate | None = None
        self._paused = self._serving = False
        self._held_since = 0.0
        self._run = self._new_run()

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
        self._start_trip(goal, max_steps, self.clock.now())
        self._serving = False
        self._loop()
        assert self.last_result is not None
        return self.last_result

    def serve(self) -> None:
        """Stay ready for goals (`set_goal`), until `quit`, SIGINT, SIGTERM or SIGHUP, or until the robot is `gone`.

        Other faults are waited out, not raised.
        """
        self._begin()
        self._serving = True
        self._loop()

    def set_goal(self, goal: np.ndarray) -> Ticket:
        """Drive to `goal` (2,), world frame [m], instead of to the present one if there is one.

        Raises:
            ValueError: the goal is not two finite numbers.
        """
        goal, ticket = _checked_goal(goal), Ticket()
        return self._requests.add(lambda now: self._start_trip(goal, None, now, ticket), ticket)

    def cancel(self) -> Ticket:
        """Give up the present goal, and stop."""
        return self._requests.add(lambda now: self._end_trip("cancelled", now))

    def pause(self) -> Ticket:
        """Wait, braked, until `resume`."""
        return self._requests.add(lambda now: setattr(self, "_paused", True))

    def resume(self) -> Ticket:
        """Go on after `pause`."""
        return self._requests.add(lambda now: setattr(self, "_paused", False))

    def estop(self, why: str = "emergency stop") -> Ticket:
        """Brake, and stay braked until `acknowledge`."""
        return self._requests.add_stop(why)

    def acknowledge(self) -> Ticket:
        """The cause of a fault or of an emergency stop is gone. The robot does not move before it gets a goal."""
        return self._requests.add(self._acknowledge)

    def quit(self) -> None:
        """End `run` or `serve` after the present tick."""
        self.loop.stop()

    @property
    def goal(self) -> np.ndarray | None:
        """(2,) the present goal, world frame [m]."""
        return None if self._trip is None else self._trip.goal

    @property
    def paused(self) -> bool:
        """Whether it waits for `resume`, with a goal or without."""
        return self._paused

    @property
    def estimate(self) -> Estimate | None:
        """The newest; None until position and heading are known."""
        return self._estimate

    def _begin(self) -> None:
        now = self.clock.now()
        if self.supervisor.mode is not Mode.INIT:
            self.supervisor.change(Mode.INIT, "new run", now)
        self._requests.drop_all("the loop had not begun")
        self._trip, self._ended, self.last_trip, self._paused = None, None, None, False
        self.gone = None
        self._estimate = None
        self._run = self._new_run()
        if self._run.must_stand:
            self._run.standing.begin(now)
        self.estimator.skill_sensors, self.estimator.driven = self.pilot.sensors, False
        self.estimator.reset()
        self.last_result = None
        _warm_up(self.estimator.config)

    def _new_run(self) -> _Run:
        config, trust = self.config, self.estimator.config
        return _Run(
            first_tick=self.loop.ticks,
            terms=TermHold(self.pilot.sensors),
            blind=BlindWatch(trust.hold_after, trust.lost_after, config.first_estimate),
            overruns=OverrunWatch(),
            plans=PlanWatch(config.plan_slow, config.plan_hold),
            no_way=BlockedWatch(0.0, config.no_way_at_start),
            saturation=SaturationWatch(self.robot.action_dim, self.robot.control_period),
            standing=StopWatch(config.stop_speed, config.stop_turn, config.stop_timeout),
            must_stand=not self.stopped,
        )

    def _loop(self) -> None:
        """Tick until done, brake, save what was observed, and make sure that the robot stands."""
        self.interrupted = False
        with noting_signals(lambda: setattr(self, "interrupted", True)):
            self.interrupted |= self.loop.run() is LoopExit.INTERRUPTED
            if self._trip is not None:
                self._end_trip("interrupted", self.clock.now())
            self.audience.tell(lambda observer: observer.flush(FLUSH_SECONDS))
            stopped = self._stop()
            self.stopped = bool(stopped)
            if stopped:
                self._stands()
            if self._ended is not None:
                if stopped is None:
                    self._fail("nobody can see whether the robot stands", self.clock.now())
                elif not stopped:
                    self._does_not_stop(self.clock.now())
                self.last_result = self._result(self._ended, self.stopped)
            if not self.supervisor.latched and self.supervisor.mode is not Mode.INIT:
                self.supervisor.change(Mode.INIT, "the loop has ended", self.clock.now())

    def _rehearse(self, again: bool) -> None:
        """Touch what the next tick will need. Whatever goes wrong here must not go wrong there.

        The first time a tick in which a plan ends, which has the memory at hand; `again` what most ticks are, which has
        the processor foresee the branches as well.
        """
        trip, frame, estimate, occupancy = self._trip, self._run.frame, self._estimate, self._run.occupancy
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
            self._run.standing.postpone(now)  # what cannot be read cannot be seen to stand
            self.robot.brake()
            self._show(now)  # what the estimator has taken must not be missing in a recording
        return self.gone is not None or (not self._serving and self._trip is None)

    def _take_failure(self, error: Exception, now: float) -> None:
        """A fault, told of once as long as it is not acknowledged: a robot may fail alike at every tick."""
        why = f"{type(error).__name__}: {error}"
        kind = re.sub(r"[0-9]+", "", why)
        if (kind, self.supervisor.fault) != self._run.told:
            log.exception("control step failed")
        self._fail(why, now)
        self._run.told = kind, self.supervisor.fault
        if isinstance(error, RobotGone):
            self.gone = why

    def _step(self, now: float) -> None:
        timer, supervisor = self.timer, self.supervisor
        self._run.unshown = None
        timer.begin()
        try:
            frame = self._run.frame = self.robot.read()
            truth = self._truth() if self._truth is not None and self.audience else None
            timer.mark("read")
            self._estimate = estimate = self.estimator.update(frame)
            self._run.unshown = seen = _Seen(frame, truth, estimate)
            terms = self._run.terms.fill(frame)
            timer.mark("estimate")
        except Exception:
            self._take_requests(now)  # a robot that cannot be read can be stopped, and its fault acknowledged
            raise
        self._take_requests(now)
        trust, doubt = self._run.blind.check(estimate, now, self.estimator.lacks)
        wait = self._run.overruns.check(self.loop.overruns_in_a_row) or self._trouble()
        stamp = frame.stamp if estimate is None else estimate.stamp
        if self._trip is not None:
            self._trip.last = stamp
        if trust is Trust.LOST and self._trip is not None:
            self._fail(doubt, now)
        if estimate is not None and trust is Trust.GOOD and not supervisor.latched:
            seen.occupancy = occupancy = self._run.occupancy = self._map_at(stamp)
            self._get_ready(estimate, occupancy, now)
            if self._trip is not None and not self._is_over(self._trip, estimate, occupancy, now):
                lacks = self.pilot.lacks(terms)
                wait = wait or lacks
                if lacks is None:
                    seen.decision = self._decide(self._trip, terms, estimate, occupancy, now)
        elif supervisor.mode in (Mode.READY, Mode.ARMED):
            supervisor.change(Mode.INIT, doubt, now)
        if self._trip is not None and not supervisor.latched:
            self._choose_mode(self._trip, seen, doubt if trust is Trust.HOLD else wait, stamp, now)
        guarded = False
        if supervisor.driving and seen.decision is not None and estimate is not None and seen.occupancy is not None:
            seen.sent, seen.scale = self._send(seen.decision, estimate, seen.occupancy, seen.plan_speed, now)
            guarded = True
        self.estimator.driven = seen.sent is not None
        if seen.sent is None:
            self.robot.brake()
            fallen = None if guarded else self.guard.braked(None if estimate is None else estimate.upright)
            if fallen is not None and not supervisor.latched:
                self._fail(fallen, now)
            timer.mark("send")
            if not supervisor.driving:  # else one tick was braked, not the robot
                self._check_stop(estimate, now)
        timer.end()
        self._show(now)

    def _map_at(self, stamp: float) -> OccupancyMap:
        """The known map; where one is published again unchanged, the one that is known already."""
        occupancy, before = self.occupancy(stamp), self._run.occupancy
        if before is None or before is occupancy or not occupancy.shows_the_same_as(before):
            return occupancy
        return before

    def _take_requests(self, now: float) -> None:
        self.audience.tell(lambda observer: observer.make_requests())
        self._requests.take(now, self.loop.ticks, self._estop)

    def _get_ready(self, estimate: Estimate, occupancy: OccupancyMap, now: float) -> None:
        """INIT -> READY -> ARMED, as far as there is a goal that can be driven to."""
        supervisor, trip = self.supervisor, self._trip
        if supervisor.mode is Mode.INIT:
            supervisor.change(Mode.READY, "position and heading known", now)
            if self._run.restarts is None:
                self._run.restarts = estimate.restarts
        if supervisor.mode is Mode.READY and trip is not None and not self._paused:
            try:
                config = self.config
                trip.goal = place_goal(
                    occupancy, estimate.pose[:2], trip.goal, config.goal_tolerance, config.robot_radius
                )
            except GoalRefused as refusal:
                self._end_trip(refusal.code, now, str(refusal))
                return
            supervisor.change(Mode.ARMED, f"goal {trip.goal[0]:g}, {trip.goal[1]:g}", now)
            self._held_since = now
        if estimate.restarts != self._run.restarts:
            self._run.restarts = estimate.restarts
            self.audience.emit("plan", "the position was found anew: the plan is void", now)
            self.pilot.drop()

    def _is_over(self, trip: Trip, estimate: Estimate, occupancy: OccupancyMap, now: float) -> bool:
        x, y, _ = estimate.pose.tolist()
        goal_x, goal_y = trip.goal.tolist()
        trip.distance = math.dist((x, y), (goal_x, goal_y))
        if trip.distance <= self.config.goal_radius:
            self._end_trip("goal", now)
        elif not occupancy.holds(x, y):
            self._end_trip("left_field", now)
        elif trip.steps >= trip.max_steps:
            self._end_trip("timeout", now)
        return self._trip is None

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

    def _choose_mode(self, trip: Trip, seen: _Seen, wait: str | None, stamp: float, now: float) -> None:
        """What the robot may do in this tick, `wait` being why it must not move, if so."""
        supervisor, decision = self.supervisor, seen.decision
        if self._run.must_stand:
            wait = "the robot has not been seen to stand since the fault"
        if self._paused:
            wait, self._held_since = "paused", now
        if decision is not None:
            failed = self.pilot.failed
            if failed is not None:
                self._fail(failed, now)
                return
            seen.plan_speed, overdue = self._run.plans.check(decision.overdue)
            no_way, give_up = self._run.no_way.check(decision.refused, now)
            wait = wait or overdue or no_way or (None if decision.has_plan else "no plan yet")
            if give_up:
                self._end_trip("unreachable", now, "the planner finds no way to the goal")
                return
            if decision.given_up and supervisor.driving:
                self._fail("stuck: recoveries in this place did not help", now)
                return
        if supervisor.mode in (Mode.INIT, Mode.READY, Mode.ARMED):
            if supervisor.mode is Mode.ARMED and decision is not None and wait is None:
                supervisor.change(Mode.RUNNING, "first plan", now)
                trip.began = stamp
                self._run.no_way = BlockedWatch(self.config.no_way_hold, self.config.no_way)
            elif supervisor.mode is Mode.ARMED and now - self._held_since > self.config.hold_timeout:
                self._fail(f"armed for {self.config.hold_timeout:g} s: {wait}", now)
            return
        if wait is not None:
            self._hold(trip, wait, now)
        elif decision is not None:
            self._drive(trip, decision, now)

    def _hold(self, trip: Trip, why: str, now: float) -> None:
        if self.supervisor.mode is not Mode.HOLD:
            self.supervisor.change(Mode.HOLD, why, now)
            trip.holds[re.sub(r" (for )?[0-9].*", "", why)] += 1
            self._held_since = now
            self._run.standing.begin(now)
        elif now - self._held_since > self.config.hold_timeout:
            self._fail(f"held for {self.config.hold_timeout:g} s: {why}", now)

    def _drive(self, trip: Trip, decision: Decision, now: float) -> None:
        supervisor = self.supervisor
        if supervisor.mode is Mode.HOLD:
            supervisor.change(Mode.RUNNING, "nothing to wait for any more", now)
            self._run.saturation.reset()
        if decision.recovering and supervisor.mode is Mode.RUNNING:
            if trip.recoveries >= self.config.max_recoveries:
                self._fail(f"stuck: {trip.recoveries} recoveries on the way to this goal", now)
                return
            trip.recoveries += 1
            supervisor.change(Mode.RECOVERING, f"recovery {trip.recoveries}", now)
        elif not decision.recovering and supervisor.mode is Mode.RECOVERING:
            supervisor.change(Mode.RUNNING, "recovery done", now)
            self.pilot.replan()
            self._run.saturation.reset()

    def _send(
        self, decision: Decision, estimate: Estimate, occupancy: OccupancyMap, plan_speed: float, now: float
    ) -> tuple[np.ndarray | None, float]:
        """Past the guard to the robot; what was sent, None if the robot is to be braked, and how it was slowed."""
        x, y, _ = estimate.pose.tolist()
        vx, vy = estimate.velocity.tolist()
        slow = self.guard.config.slow_ttc
        ttc = math.inf
        if slow is not None:
            ttc = time_to_collision(occupancy, (x, y), (vx, vy), self.config.robot_radius, slow)
        moving = estimate.body_velocity()
        guarded = self.guard.check(decision.action, estimate.upright, ttc, plan_speed, moving)
        self.timer.mark("guard")
        if guarded.fault is not None:
            self._fail(guarded.fault, now)
        if guarded.brake or guarded.fault is not None:
            return None, guarded.scale
        if self.supervisor.mode is Mode.RUNNING and self._run.saturation.check(decision.action):
            self._run.saturation.reset()
            self._run.saturated += 1
            if self._run.saturated > MAX_SATURATED:
                self._fail(f"the action stays saturated, {MAX_SATURATED} recoveries did not help", now)
                return None, guarded.scale
            self.pilot.recover()
        sent = self.robot.send(guarded.action)
        self._run.driven = True
        self.timer.mark("send")
        if self._trip is not None:
            self._trip.steps += 1
        return sent, guarded.scale

    def _start_trip(self, goal: np.ndarray, max_steps: int | None, now: float, ticket: Ticket | None = None) -> None:
        """Take on a goal in the place of the present one; the robot keeps moving if the planner answers at once."""
        if self.supervisor.latched:
            mode, fault = self.supervisor.mode.value, self.supervisor.fault
            self.audience.emit("goal", f"refused in {mode}: {fault}", now)
            if ticket is not None:
                ticket.refuse(mode, f"no goal is taken before {mode} is acknowledged: {fault}")
            return
        self._end_trip("changed", now)
        if self._ended is not None:
            self.last_result = self._result(self._ended, stopped=False)
        self.audience.emit("goal", f"{goal[0]:g}, {goal[1]:g}", now, x=float(goal[0]), y=float(goal[1]))
        self._run.blind.renew(now)
        before = self.guard.counts.copy(), self.estimator.counts.copy(), self._planner_counts()
        self._run.no_way = BlockedWatch(0.0, self.config.no_way_at_start)
        self.guard.reset()
        self.pilot.reset()
        self._run.saturation.reset()
        self._run.saturated = 0
        # last, and in `_end_trip` after the mode: a signal that comes between must not leave half of it
        self._trip, self._ended = Trip(goal, max_steps or self.config.max_steps, before), None
        if ticket is not None:
            ticket.trip = self._trip

    def _end_trip(self, reason: str, now: float, detail: str = "") -> None:
        trip, supervisor = self._trip, self.supervisor
        if trip is None:  # the robot was braked before
            return
        if supervisor.driving or self._run.standing.stands:  # else it is being looked at already
            self._run.standing.begin(now)
        trip.reason, trip.detail = reason, detail
        if supervisor.mode in (Mode.ARMED, Mode.RUNNING, Mode.HOLD, Mode.RECOVERING):
            supervisor.change(Mode.READY, reason, now)
        self._trip, self._ended = None, trip
        self.last_trip = trip
        self.audience.emit("end", detail or reason, now, reason=reason, steps=trip.steps, seconds=trip.seconds)

    def _check_stop(self, estimate: Estimate | None, now: float) -> None:
        """Follow a robot that was braked until it stands; one that does not stop is a fault."""
        if estimate is None and not self._run.driven:
            self._run.standing.postpone(now)  # it has not been driven, and nothing of it is known yet
        stands = self._run.standing.check(estimate, now, *self._measured())
        if stands is None:
            return
        self.audience.emit("stop", "the robot stands" if stands else "the robot does not stop", now, stands=stands)
        if stands:
            self._run.must_stand = False
        else:
            self._does_not_stop(now)
        if self._ended is not None and self._serving:
            self.last_result, self._ended = self._result(self._ended, stands), None

    def _measured(self) -> tuple[bool, bool, bool]:
        """Whether speed and turning rate are those that sensors say, if the robot has them, and whether it has both."""
        estimator = self.estimator
        patience = estimator.config.hold_after
        speed, turn = (estimator.silence(name) < patience for name in ("velocimeter", "gyro"))
        return speed, turn, estimator.hears("velocimeter") and estimator.hears("gyro")

    def _does_not_stop(self, now: float) -> None:
        self._fail(f"the robot does not stop within {self.config.stop_timeout:g} s", now)

    def _fail(self, why: str, now: float) -> None:
        if self.supervisor.fail(why, now):
            self.audience.emit("fault", why, now)
        self._end_trip("fault", now, why)

    def _estop(self, why: str, now: float) -> None:
        self.supervisor.stop(why, now)
        self._run.standing.begin(now)
        self._end_trip("estop", now, why)

    def _acknowledge(self, now: float) -> None:
        if not self.supervisor.latched:
            return
        self.supervisor.acknowledge(now)
        self.guard.reset()
        self.pilot.renew()
        self._run.blind.renew(now)
        self.estimator.renew()
        self._run.standing.begin(now)
        self._run.must_stand = True

    def _show(self, now: float) -> None:
        """Tell of a tick, as far as it came, unless that was done."""
        seen, self._run.unshown = self._run.unshown, None
        if seen is None or not self.audience:
            return
        decision, estimate = seen.decision, seen.estimate
        trip = self._trip or self._ended
        plan: dict[str, object] = {}
        if decision is not None and estimate is not None:
            stamp = decision.plan_stamp
            plan = {
                "plan": decision.plan,
                "plan_start": decision.start,
                "plan_stamp": stamp,
                "plan_age": None if stamp is None else estimate.stamp - stamp,
                "reason": decision.reason,
                "replanned": decision.replanned,
                "recovering": decision.recovering,
                "observation": decision.observation,
                "proposed": decision.action,
            }
        record = TickRecord(
            index=self.loop.ticks - self._run.first_tick - 1,
            time=now,
            lateness=self.loop.late,
            mode=self.supervisor.mode,
            frame=seen.frame,
            goal=None if trip is None else trip.goal,
            occupancy=seen.occupancy,
            estimate=estimate,
            truth=seen.truth,
            sent=seen.sent,
            speed_scale=seen.scale,
            timings=self.timer.last,
            **plan,  # type: ignore[arg-type]
        )
        self.audience.tell(lambda observer: observer.tick(record))

    def _planner_counts(self) -> Counter[str]:
        pilot = self.pilot
        return Counter({"rejected": pilot.rejected, "late": pilot.late, "restarts": pilot.restarts} | pilot.plan_counts)

    def _result(self, trip: Trip, stopped: bool) -> RunResult:
        guard, estimator, planner = trip.before
        return RunResult(
            reason=trip.reason or "interrupted",
            steps=trip.steps,
            seconds=trip.seconds,
            distance=trip.distance,
            stopped=stopped,
            fault=self.supervisor.fault,
            detail=trip.detail,
            replans=dict(trip.replans),
            guard=dict(self.guard.counts - guard),
            estimator=dict(self.estimator.counts - estimator),
            holds=dict(trip.holds),
            recoveries=trip.recoveries,
            planner=dict(self._planner_counts() - planner),
        )

    def _stop(self) -> bool | None:
        """Brake until the measured speed shows that the robot stands.

        False if it does not in time, None if it cannot be read.
        """
        watch = StopWatch(self.config.stop_speed, self.config.stop_turn, self.config.stop_timeout)
        watch.begin(self.clock.now())
        stopped: bool | None = None

        def tick(now: float) -> bool:
            nonlocal stopped
            self._estimate = self.estimator.update(self.robot.read())
            stopped = watch.check(self._estimate, now, *self._measured())
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


def _checked_goal(goal: np.ndarray) -> np.ndarray:
    checked = np.array(goal, dtype=np.float64)
    if checked.shape != (2,) or not np.isfinite(checked).all():
        raise ValueError(f"Driver: goal {goal} must be two finite coordinates [m]")
    return checked


def _warm_up(config: EstimatorConfig) -> None:
    """Have the linear algebra make its buffers now: with locked memory the first call takes up to 0.2 s."""
    scratch = Estimator(config)
    for stamp in (0.0, 0.01):
        field, still = np.array(config.magnetic_field), np.zeros(3)
        scratch.update(SensorFrame(stamp, still, still, field, still, position_fix=np.zeros(2)))
