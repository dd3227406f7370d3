"""What the robot is about: the goal it drives to, the mode it is in, and what leads from one mode to the next."""

from __future__ import annotations

import math
import re
from collections import Counter

import numpy as np

from hiernav.nav.goal import GoalRefused, place_goal
from hiernav.nav.occupancy import OccupancyMap
from hiernav.runtime.driver_config import DriverConfig
from hiernav.runtime.estimate import Estimate, StateEstimator, Trust
from hiernav.runtime.guard import Guard
from hiernav.runtime.observe import Audience
from hiernav.runtime.pilot import Decision, Pilot
from hiernav.runtime.supervisor import Mode, Supervisor
from hiernav.runtime.tick import Tick
from hiernav.runtime.ticket import Ticket
from hiernav.runtime.trip import Counts, RunResult, Trip
from hiernav.runtime.watchdogs import BlindWatch, BlockedWatch, PlanWatch, SaturationWatch, StopWatch, measured

MAX_SATURATED = 3
"""Recoveries from a saturated action on the way to one goal."""


class Mission:
    """Goal and mode of a robot. Nothing else changes them, and nothing here reads, sends or waits.

    `now` is the time on the loop's clock [s].
    """

    def __init__(
        self,
        pilot: Pilot,
        guard: Guard,
        estimator: StateEstimator,
        config: DriverConfig,
        audience: Audience,
        period: float,
    ) -> None:
        """
        Args:
            pilot, guard, estimator: of the robot; they are set back with a new goal, or where somebody acknowledges.
            config: when to wait, and when to give up.
            audience: is told of every change.
            period: of the control loop [s].
        """
        self._pilot, self._guard, self._estimator, self.config = pilot, guard, estimator, config
        self._audience, self._period = audience, period
        self.supervisor = Supervisor(lambda now, mode, why: audience.emit("mode", why, now, mode=mode.value))
        self.begin(stands=True, now=0.0)

    def begin(self, stands: bool, now: float) -> None:
        """A run begins, without a goal; `stands`: whether the robot is known to stand.

        Raises:
            InvalidTransition: the last fault has not been acknowledged.
        """
        if self.supervisor.mode is not Mode.INIT:
            self.supervisor.change(Mode.INIT, "new run", now)
        config, trust = self.config, self._estimator.config
        self.trip: Trip | None = None
        """The goal that is driven to."""
        self.ended: Trip | None = None
        """The goal that ended and whose result is open: the robot has not been seen to stand yet."""
        self.last_trip: Trip | None = None
        """The goal that ended last."""
        self.last_result: RunResult | None = None
        """What came of it; of the one before while that is open."""
        self.paused = False
        """Whether it waits for `resume`."""
        self.serving = False
        """Whether the run goes on when a goal has ended."""
        self.driven = False
        """Whether any action was sent in this run."""
        self.must_stand = not stands
        """Whether the robot must be seen to stand before any goal is driven to."""
        self.blind = BlindWatch(trust.hold_after, trust.lost_after, config.first_estimate)
        self.standing = StopWatch(config.stop_speed, config.stop_turn, config.stop_timeout)
        self._plans = PlanWatch(config.plan_slow, config.plan_hold)
        self._held_since = 0.0
        self._restarts: int | None = None
        """`Estimate.restarts` for which plans have been dropped; None before the first estimate."""
        if self.must_stand:
            self.standing.begin(now)

    def close(self, stands: bool | None, now: float) -> None:
        """The run is over; whether the robot was seen to stand, None if nobody could see it."""
        if self.ended is not None:
            if stands is None:
                self.fail("nobody can see whether the robot stands", now)
            elif not stands:
                self._fail_to_stop(now)
            self._settle(bool(stands))
        if not self.supervisor.latched and self.supervisor.mode is not Mode.INIT:
            self.supervisor.change(Mode.INIT, "the loop has ended", now)

    @property
    def over(self) -> bool:
        """Whether there is nothing left to be done in this run."""
        return not self.serving and self.trip is None

    def start(self, goal: np.ndarray, max_steps: int | None, now: float, ticket: Ticket | None = None) -> None:
        """Take on a goal in the place of the present one; the robot keeps moving if the planner answers at once."""
        if self.supervisor.latched:
            mode, fault = self.supervisor.mode.value, self.supervisor.fault
            self._audience.emit("goal", f"refused in {mode}: {fault}", now)
            if ticket is not None:
                ticket.refuse(mode, f"no goal is taken before {mode} is acknowledged: {fault}")
            return
        self.end("changed", now)
        if self.ended is not None:
            self._settle(stands=False)
        self._audience.emit("goal", f"{goal[0]:g}, {goal[1]:g}", now, x=float(goal[0]), y=float(goal[1]))
        self.blind.renew(now)
        before = self._counts()
        self._guard.reset()
        self._pilot.reset()
        no_way = BlockedWatch(0.0, self.config.no_way_at_start)
        saturation = SaturationWatch(self._guard.action_dim, self._period)
        # last, and in `end` after the mode: a signal that comes between must not leave half of it
        self.trip, self.ended = Trip(goal, max_steps or self.config.max_steps, before, no_way, saturation), None
        if ticket is not None:
            ticket.trip = self.trip

    def end(self, reason: str, now: float, detail: str = "") -> None:
        """End the way to the present goal, if there is one; `RunResult` has the reasons."""
        trip, supervisor = self.trip, self.supervisor
        if trip is None:  # the robot was braked before
            return
        if supervisor.driving or self.standing.stands:  # else it is being looked at already
            self.standing.begin(now)
        trip.reason, trip.detail = reason, detail
        if supervisor.mode in (Mode.ARMED, Mode.RUNNING, Mode.HOLD, Mode.RECOVERING):
            supervisor.change(Mode.READY, reason, now)
        self.trip, self.ended = None, trip
        self.last_trip = trip
        self._audience.emit("end", detail or reason, now, reason=reason, steps=trip.steps, seconds=trip.seconds)

    def fail(self, why: str, now: float) -> None:
        """A fault: brake until somebody acknowledges it."""
        if self.supervisor.fail(why, now):
            self._audience.emit("fault", why, now)
        self.end("fault", now, why)

    def estop(self, why: str, now: float) -> None:
        """An emergency stop: brake until somebody acknowledges it."""
        self.supervisor.stop(why, now)
        self.standing.begin(now)
        self.end("estop", now, why)

    def acknowledge(self, now: float) -> None:
        """Somebody says that the cause of a fault or of an emergency stop is gone."""
        if not self.supervisor.latched:
            return
        self.supervisor.acknowledge(now)
        self._guard.reset()
        self._pilot.renew()
        self.blind.renew(now)
        self._estimator.renew()
        self.standing.begin(now)
        self.must_stand = True

    def trusts(self, trust: Trust, doubt: str, stamp: float, now: float) -> bool:
        """Whether the newest estimate, at `stamp`, may be acted on: by its trust, and by the mode."""
        supervisor = self.supervisor
        if self.trip is not None:
            self.trip.last = stamp
            if trust is Trust.LOST:
                self.fail(doubt, now)
        if trust is Trust.GOOD and not supervisor.latched:
            return True
        if supervisor.mode in (Mode.READY, Mode.ARMED):
            supervisor.change(Mode.INIT, doubt, now)
        return False

    def advance(self, estimate: Estimate, occupancy: OccupancyMap, now: float) -> Trip | None:
        """INIT -> READY -> ARMED, as far as there is a goal that can be driven to; the trip, unless it ends here."""
        self._get_ready(estimate, occupancy, now)
        trip = self.trip
        if trip is None:
            return None
        x, y, _ = estimate.pose.tolist()
        goal_x, goal_y = trip.goal.tolist()
        trip.distance = math.dist((x, y), (goal_x, goal_y))
        if trip.distance <= self.config.goal_radius:
            self.end("goal", now)
        elif not occupancy.holds(x, y):
            self.end("left_field", now)
        elif trip.steps >= trip.max_steps:
            self.end("timeout", now)
        return self.trip

    def _get_ready(self, estimate: Estimate, occupancy: OccupancyMap, now: float) -> None:
        supervisor, trip, config = self.supervisor, self.trip, self.config
        if supervisor.mode is Mode.INIT:
            supervisor.change(Mode.READY, "position and heading known", now)
            if self._restarts is None:
                self._restarts = estimate.restarts
        if supervisor.mode is Mode.READY and trip is not None and not self.paused:
            try:
                where = estimate.pose[:2]
                trip.goal = place_goal(occupancy, where, trip.goal, config.goal_tolerance, config.robot_radius)
            except GoalRefused as refusal:
                self.end(refusal.code, now, str(refusal))
                return
            supervisor.change(Mode.ARMED, f"goal {trip.goal[0]:g}, {trip.goal[1]:g}", now)
            self._held_since = now
        if estimate.restarts != self._restarts:
            self._restarts = estimate.restarts
            self._audience.emit("plan", "the position was found anew: the plan is void", now)
            self._pilot.drop()

    def choose_mode(self, tick: Tick, wait: str | None, now: float) -> None:
        """What the robot may do in this tick, `wait` being why it must not move, if so."""
        supervisor, trip, decision = self.supervisor, self.trip, tick.decision
        if trip is None or supervisor.latched:
            return
        if self.must_stand:
            wait = "the robot has not been seen to stand since the fault"
        if self.paused:
            wait, self._held_since = "paused", now
        if decision is not None:
            failed = self._pilot.failed
            if failed is not None:
                self.fail(failed, now)
                return
            tick.plan_speed, overdue = self._plans.check(decision.overdue)
            no_way, give_up = trip.no_way.check(decision.refused, now)
            wait = wait or overdue or no_way or (None if decision.has_plan else "no plan yet")
            if give_up:
                self.end("unreachable", now, "the planner finds no way to the goal")
                return
            if decision.given_up and supervisor.driving:
                self.fail("stuck: recoveries in this place did not help", now)
                return
        if supervisor.mode in (Mode.INIT, Mode.READY, Mode.ARMED):
            if supervisor.mode is Mode.ARMED and decision is not None and wait is None:
                supervisor.change(Mode.RUNNING, "first plan", now)
                trip.began = tick.stamp
                trip.no_way = BlockedWatch(self.config.no_way_hold, self.config.no_way)
            elif supervisor.mode is Mode.ARMED and now - self._held_since > self.config.hold_timeout:
                self.fail(f"armed for {self.config.hold_timeout:g} s: {wait}", now)
        elif wait is not None:
            self._hold(trip, wait, now)
        elif decision is not None:
            self._drive(trip, decision, now)

    def _hold(self, trip: Trip, why: str, now: float) -> None:
        if self.supervisor.mode is not Mode.HOLD:
            self.supervisor.change(Mode.HOLD, why, now)
            trip.holds[re.sub(r" (for )?[0-9].*", "", why)] += 1
            self._held_since = now
            self.standing.begin(now)
        elif now - self._held_since > self.config.hold_timeout:
            self.fail(f"held for {self.config.hold_timeout:g} s: {why}", now)

    def _drive(self, trip: Trip, decision: Decision, now: float) -> None:
        supervisor = self.supervisor
        if supervisor.mode is Mode.HOLD:
            supervisor.change(Mode.RUNNING, "nothing to wait for any more", now)
            trip.saturation.reset()
        if decision.recovering and supervisor.mode is Mode.RUNNING:
            if trip.recoveries >= self.config.max_recoveries:
                self.fail(f"stuck: {trip.recoveries} recoveries on the way to this goal", now)
                return
            trip.recoveries += 1
            supervisor.change(Mode.RECOVERING, f"recovery {trip.recoveries}", now)
        elif not decision.recovering and supervisor.mode is Mode.RECOVERING:
            supervisor.change(Mode.RUNNING, "recovery done", now)
            self._pilot.replan()
            trip.saturation.reset()

    def watch_saturation(self, action: np.ndarray, now: float) -> None:
        """Help a robot whose skill goes on asking, as in `action` (A,), for all that the actuators can give."""
        trip = self.trip
        if trip is None or self.supervisor.mode is not Mode.RUNNING or not trip.saturation.check(action):
            return
        trip.saturation.reset()
        trip.saturated += 1
        if trip.saturated > MAX_SATURATED:
            self.fail(f"the action stays saturated, {MAX_SATURATED} recoveries did not help", now)
        else:
            self._pilot.recover()

    def count_step(self) -> None:
        """An action was sent."""
        self.driven = True
        if self.trip is not None:
            self.trip.steps += 1

    def check_stop(self, estimate: Estimate | None, now: float) -> None:
        """Follow a robot that was braked until it stands; one that does not stop is a fault."""
        if estimate is None and not self.driven:
            self.standing.postpone(now)  # it has not been driven, and nothing of it is known yet
        stands = self.standing.check(estimate, now, *measured(self._estimator))
        if stands is None:
            return
        self._audience.emit("stop", "the robot stands" if stands else "the robot does not stop", now, stands=stands)
        if stands:
            self.must_stand = False
        else:
            self._fail_to_stop(now)
        if self.ended is not None and self.serving:
            self._settle(stands)
            self.ended = None

    def _fail_to_stop(self, now: float) -> None:
        self.fail(f"the robot does not stop within {self.config.stop_timeout:g} s", now)

    def _settle(self, stands: bool) -> None:
        """Say what came of the goal that ended, `stands` being whether the robot was seen to."""
        assert self.ended is not None
        self.last_result = self.ended.result(stands, self.supervisor.fault, self._counts())

    def _counts(self) -> Counts:
        pilot = self._pilot
        planner = {"rejected": pilot.rejected, "late": pilot.late, "restarts": pilot.restarts} | pilot.plan_counts
        return self._guard.counts.copy(), self._estimator.counts.copy(), Counter(planner)
