"""The agent on one robot: plans that may arrive late, with their stamps and ages, and one decision per tick."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from hiernav.nav.agent import HierarchicalAgent
from hiernav.nav.occupancy import OccupancyMap
from hiernav.nav.option import DeferredPlanner, PlanQuery
from hiernav.nav.termination import TerminationReason
from hiernav.runtime.estimate import Estimate

MAX_PLAN_AGE = 1.0
"""Of the state that a plan was made from, when the plan arrives [s]."""


@dataclass(frozen=True)
class Answer:
    """A plan that was asked for earlier."""

    plan: np.ndarray
    """(K, 2) world frame [m]; NaN if no way was found."""
    start: np.ndarray
    """(2,) position it was made from [m]."""
    stamp: float
    """Of the estimate it was made from [s]."""
    occupancy: OccupancyMap
    """Map it was made on."""


class PlannerLink(DeferredPlanner, Protocol):
    """A planner that answers later: `plan` returns None, and `answer` brings what was asked for."""

    stamp: float
    """Of the estimate that is asked with; written before every `plan` [s]."""

    @property
    def failed(self) -> str | None:
        """Why no answer is to be expected any more, or None."""
        ...

    def answer(self, now: float) -> Answer | None:
        """The newest answer not yet taken, at `now` on the loop's clock [s]. Called every tick."""
        ...

    def forget(self) -> None:
        """Answers to what was asked before are not wanted any more."""
        ...

    def restart_count(self) -> int:
        """How often the planner had to be started again."""
        ...

    def renew(self) -> None:
        """Somebody acknowledged the failure: try again, with all restarts."""
        ...


@dataclass(frozen=True)
class Decision:
    """What is to be done in one tick, and why."""

    action: np.ndarray
    """(A,) float32, what the skill said."""
    observation: np.ndarray
    """(D,) float32."""
    reason: TerminationReason
    """Why the plan ended in this tick."""
    plan: np.ndarray
    """(K, 2) that the skill follows, world frame [m]."""
    start: np.ndarray
    """(2,) position it was made from [m]."""
    plan_stamp: float | None
    """Of the estimate it was made from [s]."""
    has_plan: bool
    """Whether there is a plan to follow; without one the robot must not move."""
    replanned: bool
    """Whether the plan is another one than in the last tick."""
    overdue: float
    """For how long a plan has been waited for [s]."""
    refused: bool | None
    """Whether the planner found no way; None while its answer is awaited."""
    recovering: bool
    given_up: bool
    """Whether recoveries have not helped."""
    plan_seconds: float
    """Time that planning took in this process [s]."""


class SoundPlanner:
    """Refuses plans that are not finite or leave the map, whoever makes them."""

    def __init__(self, planner: DeferredPlanner) -> None:
        self.planner = planner
        self.rejected = 0

    def plan(self, query: PlanQuery) -> np.ndarray | None:
        plans = self.planner.plan(query)
        if plans is None:
            return None
        plans = np.array(plans, dtype=np.float64)
        for plan, occupancy in zip(plans, query.occupancy, strict=True):
            if not self.accepts(plan, occupancy):
                plan[:] = np.nan
        return plans

    def accepts(self, plan: np.ndarray, occupancy: OccupancyMap) -> bool:
        """Whether a plan (K, 2) [m] may be followed; one of nothing but NaN says "no way" and is no offence."""
        if occupancy.contains(plan).all():
            return True
        self.rejected += not np.isnan(plan).all()
        return False


class Pilot:
    """One agent for one robot.

    With a planner that answers later, every tick in which a plan is due asks with the newest state, and the plan that
    comes is followed from the state it was made for, unless that is older than `MAX_PLAN_AGE` or of another clock.
    """

    def __init__(self, agent: HierarchicalAgent, link: PlannerLink | None = None) -> None:
        """
        Args:
            agent: with one row; its option's planner is `link`, if there is one.
            link: brings the plans that were asked for earlier.
        """
        self.agent, self.link = agent, link
        self._sensed = list(agent.layout.sensors)
        self._sound = SoundPlanner(agent.option.planner)
        agent.option.planner = self._sound
        self.late = 0
        """Plans that were too old when they came, or from before the robot's clock started again."""
        self.reset()

    @property
    def sensors(self) -> dict[str, int]:
        """How many values each sensor gives that the skill observes, by name."""
        return self.agent.layout.sensors

    @property
    def control_period(self) -> float:
        """Time between two calls of `act` that the policies are for [s]."""
        return self.agent.control_period

    @property
    def rejected(self) -> int:
        """Plans that were not finite or left the map."""
        return self._sound.rejected

    @property
    def plan_counts(self) -> dict[str, int]:
        """Counts of a planner that verifies its plans (`VerifiedPlanner.counts`)."""
        counts = getattr(self._sound.planner, "counts", None)
        return {} if counts is None else counts()

    @property
    def failed(self) -> str | None:
        """Why no plan is to be expected any more, or None."""
        return None if self.link is None else self.link.failed

    @property
    def restarts(self) -> int:
        """How often the planner's process had to be started again."""
        return 0 if self.link is None else self.link.restart_count()

    def reset(self) -> None:
        """A new goal for a robot that stands."""
        self.agent.reset()
        self._plan_stamp: float | None = None
        self._asked_at: float | None = None
        if self.link is not None:
            self.link.forget()

    def drop(self) -> None:
        """The plan leads to another goal or from another place: do not follow it any further."""
        self.agent.option.drop()
        self._asked_at = None
        if self.link is not None:
            self.link.forget()

    def lacks(self, terms: Mapping[str, np.ndarray]) -> str | None:
        """Which sensor that the skill observes has never spoken, as a reason to wait; None if all have."""
        silent = [name for name in self._sensed if name not in terms]
        return f"nothing from {', '.join(silent)} yet" if silent else None

    def rest(self) -> None:
        """The robot was made to wait, and must not be thought stuck for it."""
        self.agent.recovery.rest()

    def replan(self) -> None:
        """Ask for another plan in the next tick, and follow this one until it comes."""
        self.agent.option.waiting[0] = True

    def renew(self) -> None:
        """Somebody acknowledged a fault: a planner that failed may try again."""
        if self.link is not None:
            self.link.renew()

    def recover(self) -> None:
        """Help the robot in the next tick."""
        self.agent.recovery.ask(0)

    def act(
        self,
        now: float,
        estimate: Estimate,
        terms: Mapping[str, np.ndarray],
        goal: np.ndarray,
        occupancy: OccupancyMap,
    ) -> Decision:
        """One control step.

        Args:
            now: on the loop's clock [s].
            estimate: newest pose.
            terms: the robot's sensors by name, (1, d) each.
            goal: (2,) world frame [m].
            occupancy: map as it is now.
        """
        option, refusals = self.agent.option, int(self.agent.option.refused[0])
        if len(self.agent.turn_to(goal[None])):
            self.drop()  # the plan that is on its way too
        answered = self._take_answer(now, estimate.stamp)
        pose = estimate.pose[None]
        step = self.agent.act(pose, terms, goal[None], (occupancy,), np.array([estimate.stamp]))
        replanned = bool(step.replanned[0])
        if replanned:
            self._plan_stamp = answered if answered is not None else estimate.stamp
        refused = int(option.refused[0]) > refusals
        if not option.waiting[0]:
            self._asked_at = None
        elif self._asked_at is None or refused:  # a planner that says "no way" is at work
            self._asked_at = now
        return Decision(
            action=step.action[0],
            observation=step.observation[0],
            reason=TerminationReason(int(step.reason[0])),
            plan=step.plan[0],
            start=step.start[0],
            plan_stamp=self._plan_stamp,
            has_plan=bool(option.started[0]),
            replanned=replanned,
            overdue=0.0 if self._asked_at is None else now - self._asked_at,
            refused=True if refused else None if option.waiting[0] else False,
            recovering=bool(self.agent.recovery.active[0]),
            given_up=bool(self.agent.recovery.given_up[0]),
            plan_seconds=step.plan_seconds,
        )

    def _take_answer(self, now: float, stamp: float) -> float | None:
        """Follow the plan that has come, if one has; the stamp of the state it was made from."""
        link, option = self.link, self.agent.option
        if link is None:
            return None
        link.stamp = stamp
        answer = link.answer(now)
        if answer is None or not option.waiting[0]:
            return None
        if not 0.0 <= stamp - answer.stamp <= MAX_PLAN_AGE:
            self.late += 1
            return None
        plan = answer.plan
        if not self._sound.accepts(plan, answer.occupancy):
            plan = np.full_like(plan, np.nan)
        return answer.stamp if option.adopt(0, plan, answer.start, answer.occupancy) else None
