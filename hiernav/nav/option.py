"""The option: a plan, the rule that ends it, and the agent that follows it (paper section IV-C).

The waypoint generator is the option's policy over plans; the skill runs inside it. Training, evaluation and robot
all step the same `WaypointOption`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Protocol

import numpy as np

from hiernav.nav import path
from hiernav.nav.frames import world_to_body
from hiernav.nav.goal import GOAL_RADIUS
from hiernav.nav.observation import ObservationLayout, clock_phase
from hiernav.nav.occupancy import OccupancyMap, VisitMap
from hiernav.nav.prediction import MapPredictor
from hiernav.nav.recovery import Recovery
from hiernav.nav.sweep import meets_map, sweep

Skill = Callable[[np.ndarray], np.ndarray]
"""Observations (N, D) float32 -> actions (N, A) float32 in [-1, 1]."""


class TerminationReason(IntEnum):
    """Why a plan ended; NONE while it goes on."""

    NONE = 0
    START = 1
    D_UPDATE = 2
    HALF_INDEX = 3
    INVALID = 4
    GOAL = 5
    OUTDATED = 6


# Looking a member up takes longer than the comparison it is used in, and the robot does so at every tick.
_NONE, _START, _D_UPDATE, _HALF_INDEX, _INVALID, _GOAL, _OUTDATED = (int(reason) for reason in TerminationReason)

LONGEST_PLAN = 10.0
"""A plan with a waypoint farther than this from the robot in x or y is refused [m]."""
REFRESH_S = 0.2
"""How old a plan may get that was made on another map than the present one [s]."""


@dataclass(frozen=True)
class ReplanRule:
    """When an option ends: a rule without learned parts.

    If several conditions hold the first of `start`, `goal`, `invalid`, `d_update`, `half_index`, `outdated` is the
    reason.
    """

    d_update: float = 0.3
    """Distance to the closest waypoint above which the plan is given up [m]."""
    half_fraction: float = 0.5
    """Share of the waypoints behind the robot above which the plan is used up."""
    invalid: bool = True
    """Whether a plan is given up whose rest meets the map, or that is old and was made on another map (beyond
    the paper)."""
    period: int | None = None
    """Replan every so many steps instead of by distance and index (the paper's comparison)."""

    def __call__(
        self,
        distance: np.ndarray,
        index: np.ndarray,
        count: int,
        *,
        age: np.ndarray,
        blocked: np.ndarray,
        outdated: np.ndarray,
        at_goal: np.ndarray,
        started: np.ndarray,
    ) -> np.ndarray:
        """Termination reason of each row.

        Args:
            distance: (N,) to the closest waypoint [m]; NaN counts as too far.
            index: (N,) of the closest waypoint; 0 is the position the plan was made from.
            count: number of waypoints of a plan.
            age: (N,) control steps since the plan was made.
            blocked: (N,) bool, the remaining plan meets the map.
            outdated: (N,) bool, the plan is old and was made on another map; a fixed `period` is not cut short by it.
            at_goal: (N,) bool.
            started: (N,) bool, False before the first plan of an episode.

        Returns:
            (N,) int8 of `TerminationReason`.
        """
        if self.period is None:
            too_far = ~(distance <= self.d_update)
            used_up = index > self.half_fraction * count
        else:
            too_far, used_up = np.isnan(distance), age >= self.period
        reason = np.zeros(len(distance), dtype=np.int8)
        if not np.count_nonzero(used_up | too_far | blocked | outdated | at_goal | ~started):
            return reason
        # the last one that holds stays: from the least to the most important
        if self.invalid and self.period is None:
            reason[outdated] = _OUTDATED
        reason[used_up] = _HALF_INDEX
        reason[too_far] = _D_UPDATE
        if self.invalid:
            reason[blocked] = _INVALID
        reason[at_goal] = _GOAL
        reason[~started] = _START
        return reason


@dataclass(frozen=True)
class PlanQuery:
    """What a planner is asked for M robots at once; all arrays in the world frame [m]."""

    position: np.ndarray
    """(M, 2)"""
    goal: np.ndarray
    """(M, 2)"""
    occupancy: Sequence[OccupancyMap]
    visits: Sequence[VisitMap]
    previous: np.ndarray
    """(M, K, 2) plan that is being replaced, NaN where there is none."""


def kept(query: PlanQuery) -> PlanQuery:
    """The query as it is now, of which nothing is written again."""
    return PlanQuery(
        query.position.copy(),
        query.goal.copy(),
        list(query.occupancy),
        [visits.copy() for visits in query.visits],
        query.previous.copy(),
    )


class Planner(Protocol):
    """Proposes waypoints. A row of NaN says that no plan was found."""

    def plan(self, query: PlanQuery) -> np.ndarray:
        """(M, K, 2) waypoints in the world frame [m]."""
        ...


class DeferredPlanner(Protocol):
    """A planner that may work elsewhere, such as in a process of its own."""

    def plan(self, query: PlanQuery) -> np.ndarray | None:
        """As `Planner.plan`; None if the plans will be handed to `WaypointOption.adopt` at a later step."""
        ...


@dataclass
class OptionStep:
    """Outcome of one control step of `WaypointOption`."""

    reason: np.ndarray
    """(N,) int8 `TerminationReason`."""
    plan: np.ndarray
    """(N, K, 2) active plan, world frame [m]."""
    start: np.ndarray
    """(N, 2) position it was made from [m]."""
    replanned: np.ndarray
    """(N,) bool, whether the plan is another one than at the last step."""
    plan_seconds: float = 0.0
    """Time the planner took."""


@dataclass
class WaypointOption:
    """Plans of N robots: when each one ends, a new one is asked for.

    A row whose planner finds nothing (NaN) or nonsense keeps the plan it has, or holds its position if it has none, and
    asks with its newest state at every step until there is a plan; such refusals are counted, the end of the plan once.
    So does a row whose planner works elsewhere, until `adopt` brings the plan. One whose position is not finite is not
    asked for.
    """

    planner: Planner | DeferredPlanner
    num_rows: int
    rule: ReplanRule = field(default_factory=ReplanRule)
    num_waypoints: int = 10
    goal_radius: float = GOAL_RADIUS
    """A robot this close to its goal has reached it [m]."""
    sweep_radius: float = 0.1
    """Radius with which the way to the closest waypoint and the plan from there on are swept for `invalid` [m]."""
    refresh: int | None = None
    """Control steps after which a plan is outdated if it was made on another map than the present one: obstacles that
    move are avoided before they are in the way. None: never."""
    predict: bool = True
    """Whether plans are made and swept on maps as they will be (`MapPredictor`), if their stamps are told."""

    def __post_init__(self) -> None:
        shape = (self.num_rows, self.num_waypoints, 2)
        self._all_rows = np.arange(self.num_rows)
        self.plan = np.full(shape, np.nan)
        self.start = np.full((self.num_rows, 2), np.nan)
        self.goal = np.full((self.num_rows, 2), np.nan)
        """(N, 2) that the plan leads to, or the one that is waited for, world frame [m]; NaN where there is neither."""
        self.started = np.zeros(self.num_rows, dtype=bool)
        self.age = np.zeros(self.num_rows, dtype=np.int64)
        self.visits: list[VisitMap | None] = [None] * self.num_rows
        self.counts = np.zeros((self.num_rows, len(TerminationReason)), dtype=np.int64)
        self.refused = np.zeros(self.num_rows, dtype=np.int64)
        self.waiting = np.zeros(self.num_rows, dtype=bool)
        """Whether another plan is wanted, whatever the rule says: asked for at every step until one has come."""
        self._adopted = np.zeros(self.num_rows, dtype=bool)
        self._planned_on: list[OccupancyMap | None] = [None] * self.num_rows
        self._changed = np.zeros(self.num_rows, dtype=bool)  # whether the map is another one than that
        self._refresh = np.iinfo(np.int64).max if self.refresh is None else self.refresh
        self._predictors = [MapPredictor(self.sweep_radius) for _ in range(self.num_rows)]
        self._swept: list[OccupancyMap | None] = [None] * self.num_rows  # the map each plan was swept against
        self._hit = np.zeros(self.num_rows)  # where it meets it last, counted in vertices of the line; 0 if nowhere

    def reset(self, rows: np.ndarray | None = None) -> None:
        """Forget plans, visits and counts of some rows (all by default), as at the start of an episode."""
        rows = np.arange(self.num_rows) if rows is None else np.asarray(rows)
        self.plan[rows], self.start[rows], self.goal[rows] = np.nan, np.nan, np.nan
        self.started[rows], self.age[rows] = False, 0
        self.counts[rows], self.refused[rows] = 0, 0
        self.waiting[rows] = self._adopted[rows] = False
        for row in rows.tolist():
            self.visits[row] = self._swept[row] = self._planned_on[row] = None
            self._predictors[row].reset()

    def drop(self, rows: np.ndarray | slice | None = None) -> None:
        """Give up the plans of some rows without forgetting the episode, as when the goal has changed.

        They hold their position until another plan comes.
        """
        rows = slice(None) if rows is None else rows
        self.plan[rows], self.start[rows], self.goal[rows] = np.nan, np.nan, np.nan
        self.started[rows] = self.waiting[rows] = self._adopted[rows] = False

    def adopt(self, row: int, plan: np.ndarray, start: np.ndarray, occupancy: OccupancyMap) -> bool:
        """Follow a plan that was asked for at an earlier step, from the next step on.

        Args:
            row: whose plan it is.
            plan: (K, 2) world frame [m]; NaN says that none was found.
            start: (2,) position it was made from [m].
            occupancy: map it was made on.

        Returns:
            Whether the plan is accepted; if not the refusal is counted, and the row still waits.
        """
        if plan.shape != self.plan[row].shape:
            raise ValueError(f"planner returned shape {plan.shape}, expected {self.plan[row].shape}")
        if not (np.abs(plan - start) <= LONGEST_PLAN).all():
            self.refused[row] += 1
            return False
        self._follow(row, plan, start, occupancy)
        self.started[row] = self._adopted[row] = True
        self.waiting[row] = False
        return True

    def step(
        self,
        position: np.ndarray,
        goal: np.ndarray,
        occupancy: Sequence[OccupancyMap],
        rows: np.ndarray | None = None,
        stamps: np.ndarray | None = None,
    ) -> OptionStep:
        """One control step: end the options that are due and plan anew for them.

        Args:
            position: (M, 2) world frame [m].
            goal: (M, 2) world frame [m].
            occupancy: M maps as they are now.
            rows: (M,) the rows these belong to; all N by default.
            stamps: (M,) when the maps were made, on any clock [s]; without them no map is predicted.

        Returns:
            The step of those M rows.
        """
        # a slice of all rows is read and written in a fraction of the time that an array of their numbers takes
        pick: slice | np.ndarray = slice(None) if rows is None else np.asarray(rows)
        rows = self._all_rows[pick]
        position, goal = np.asarray(position, dtype=np.float64), np.asarray(goal, dtype=np.float64)
        if self.predict and stamps is not None:
            at_rows = zip(rows.tolist(), occupancy, stamps.tolist(), position, strict=True)
            occupancy = [self._predictors[row](now, stamp, where) for row, now, stamp, where in at_rows]
        for row, where, now in zip(rows.tolist(), position.tolist(), occupancy, strict=True):
            visits = self.visits[row]
            if visits is None or not visits.lies_on(now):
                visits = self.visits[row] = VisitMap(now) if visits is None else visits.moved_to(now)
            visits.enter(*where)
        self.age[pick] += 1
        reason = self._reasons(rows, pick, position, goal, occupancy)
        due = self._due(pick, reason)
        if np.count_nonzero(reason):
            self.counts[rows, reason] += 1
        else:
            self.counts[pick, _NONE] += 1
        replanned = self._adopted[pick].copy()
        self._adopted[pick] = False
        seconds = 0.0
        if len(due):
            began = time.perf_counter()
            replanned[due] |= self._replan(rows[due], position[due], goal[due], [occupancy[k] for k in due.tolist()])
            seconds = time.perf_counter() - began
        return OptionStep(reason, self.plan[pick].copy(), self.start[pick].copy(), replanned, seconds)

    def line(self) -> np.ndarray:
        """(N, K + 1, 2) active plans with the position they were made from in front."""
        return path.polyline(self.start, self.plan)

    def _due(self, pick: slice | np.ndarray, reason: np.ndarray) -> np.ndarray:
        """Which of the rows ask for a plan now; a plan that is waited for has ended once, however often it is asked."""
        waiting = self.waiting[pick]
        if not (np.count_nonzero(reason) or np.count_nonzero(waiting)):
            return self._all_rows[:0]
        ended = (reason != _NONE) & (reason != _GOAL)
        due = np.flatnonzero(ended | (waiting & (reason != _GOAL)))
        reason[waiting & ended] = _NONE
        return due

    def _reasons(
        self,
        rows: np.ndarray,
        pick: slice | np.ndarray,
        position: np.ndarray,
        goal: np.ndarray,
        occupancy: Sequence[OccupancyMap],
    ) -> np.ndarray:
        index, distance = path.nearest_vertex(position[:, None], path.polyline(self.start[pick], self.plan[pick]))
        blocked = self._blocked(rows, position, np.maximum(index[:, 0], 1), occupancy)
        if np.count_nonzero(blocked):
            # on the map it was made for and where it was made, a blocked plan would only be proposed again
            moved = path.distances(position, self.start[pick]) > 0.05
            blocked &= (self.age[pick] > 1) & (moved | self._changed[pick])
        age = self.age[pick]
        return self.rule(
            distance[:, 0],
            index[:, 0],
            self.num_waypoints,
            age=age,
            blocked=blocked,
            outdated=self._changed[pick] & (age >= self._refresh),
            at_goal=path.distances(position, goal) <= self.goal_radius,
            started=self.started[pick],
        )

    def _blocked(
        self, rows: np.ndarray, position: np.ndarray, index: np.ndarray, occupancy: Sequence[OccupancyMap]
    ) -> np.ndarray:
        """Whether the map meets the way to the closest waypoint, `index` (M,) from 1, or what comes behind it: (M,)."""
        blocked = np.zeros(len(rows), dtype=bool)
        if not self.rule.invalid:
            return blocked
        at_rows = zip(rows.tolist(), position.tolist(), index.tolist(), occupancy, strict=True)
        for k, (row, where, closest, now) in enumerate(at_rows):
            if not self.started[row]:
                continue
            if self._swept[row] is not now:
                self._sweep(row, now)
            waypoint = self.plan[row, closest - 1].tolist()
            blocked[k] = self._hit[row] >= closest or meets_map(now, where, waypoint, self.sweep_radius)
        return blocked

    def _sweep(self, row: int, now: OccupancyMap) -> None:
        """Find where a plan meets a map last, if one of them is new."""
        line = path.polyline(self.start[row : row + 1], self.plan[row : row + 1])
        index, _, meets = sweep(line, now, self.sweep_radius)
        self._hit[row] = (index * meets[0]).max()
        self._changed[row] = now is not self._planned_on[row]
        self._swept[row] = now

    def _replan(
        self, rows: np.ndarray, position: np.ndarray, goal: np.ndarray, occupancy: Sequence[OccupancyMap]
    ) -> np.ndarray:
        """Ask for plans of some rows; (M,) bool, which of them have a new one."""
        plan = np.full((len(rows), self.num_waypoints, 2), np.nan)
        known = np.flatnonzero(np.isfinite(position).all(axis=1) & np.isfinite(goal).all(axis=1))
        later, asked = np.zeros(len(rows), dtype=bool), np.zeros(len(rows), dtype=bool)
        asked[known] = True
        if len(known):
            visits = [self.visits[row] for row in rows[known].tolist()]
            query = PlanQuery(
                position=position[known],
                goal=goal[known],
                occupancy=[occupancy[k] for k in known.tolist()],
                visits=[v for v in visits if v is not None],
                previous=np.where(self.started[rows[known]][:, None, None], self.plan[rows[known]], np.nan),
            )
            answer = self.planner.plan(query)
            if answer is None:
                later[known] = True
            else:
                proposed = np.asarray(answer, dtype=np.float64)
                if proposed.shape != plan[known].shape:
                    raise ValueError(f"planner returned shape {proposed.shape}, expected {plan[known].shape}")
                plan[known] = proposed
        # not "> LONGEST_PLAN", so that NaN is refused too
        good = (np.abs(plan - position[:, None]) <= LONGEST_PLAN).all(axis=(1, 2))
        self.refused[rows[~good & ~later]] += 1
        hold = ~good & ~np.isfinite(self.plan[rows]).all(axis=(1, 2))
        plan[hold] = position[hold][:, None]
        for k in np.flatnonzero(good | hold).tolist():
            self._follow(int(rows[k]), plan[k], position[k], occupancy[k])
        # a plan that comes later may be any of those that were asked for since the first time
        new = good | (asked & ~self.waiting[rows])
        self.goal[rows[new]] = goal[new]
        self.started[rows[good]] = True
        self.waiting[rows[asked]] = ~good[asked]
        return good

    def _follow(self, row: int, plan: np.ndarray, start: np.ndarray, occupancy: OccupancyMap) -> None:
        self.plan[row], self.start[row], self.age[row] = plan, start, 0
        self._swept[row], self._planned_on[row], self._changed[row] = None, occupancy, False


@dataclass
class AgentStep:
    """What the agent decided in one control step."""

    action: np.ndarray
    """(N, A) float32 in [-1, 1]."""
    plan: np.ndarray
    """(N, K, 2) what the skill follows, world frame [m]: the option's plan, or a way out (`Recovery`)."""
    observation: np.ndarray
    """(N, D) float32."""
    option: OptionStep

    @property
    def reason(self) -> np.ndarray:
        return self.option.reason

    @property
    def start(self) -> np.ndarray:
        return self.option.start

    @property
    def replanned(self) -> np.ndarray:
        """(N,) bool, whether the plan is another one than at the last step."""
        return self.option.replanned

    @property
    def plan_seconds(self) -> float:
        return self.option.plan_seconds


@dataclass
class HierarchicalAgent:
    """Option and skill together: from sensors, goal and map to an action."""

    option: WaypointOption
    skill: Skill
    layout: ObservationLayout
    control_period: float
    """Time between two calls of `act` [s]."""

    def __post_init__(self) -> None:
        self.recovery = Recovery(self.option.num_rows, self.control_period, self.option.sweep_radius)
        self._steps = np.zeros(self.option.num_rows, dtype=np.int64)
        self._clocked = "clock" in self.layout.names

    def reset(self, rows: np.ndarray | None = None) -> None:
        """Start new episodes in some rows (all by default)."""
        self.option.reset(rows)
        self.recovery.reset(rows)
        self._steps[slice(None) if rows is None else rows] = 0

    def act(
        self,
        pose: np.ndarray,
        terms: Mapping[str, np.ndarray],
        goal: np.ndarray,
        occupancy: Sequence[OccupancyMap],
        stamps: np.ndarray | None = None,
    ) -> AgentStep:
        """One control step.

        Args:
            pose: (N, 3) world frame [m, m, rad].
            terms: the robot's sensors by name, (N, d) each; waypoints and goal are added here.
            goal: (N, 2) world frame [m]; see `turn_to`.
            occupancy: N maps as they are now.
            stamps: (N,) when the maps were made, on any clock [s]; the time of the steps by default.

        Raises:
            ValueError: not as many rows as the agent was made for.
        """
        pose, goal = np.asarray(pose, dtype=np.float64), np.asarray(goal, dtype=np.float64)
        shapes, rows = (pose.shape, goal.shape, len(occupancy)), self.option.num_rows
        if shapes != ((rows, 3), (rows, 2), rows):
            raise ValueError(
                f"HierarchicalAgent.act: poses {pose.shape}, goals {goal.shape} and {len(occupancy)} maps, "
                f"expected ({rows}, 3), ({rows}, 2) and {rows}"
            )
        self.turn_to(goal)
        since = self._steps * self.control_period
        step, plan, observation = observe(
            self.option,
            self.recovery,
            self.layout,
            pose,
            terms,
            goal,
            occupancy,
            since if self._clocked else None,
            since if stamps is None else stamps,
        )
        self._steps += 1
        return AgentStep(self.skill(observation), plan, observation, step)

    def turn_to(self, goal: np.ndarray) -> np.ndarray:
        """Give up plans and ways out that lead elsewhere than to these goals (N, 2), world frame [m].

        A goal is another one where it is farther than `option.goal_radius` from the one that was planned for.

        Returns:
            The rows (M,) in which it is.
        """
        moved = np.flatnonzero(path.distances(goal, self.option.goal) > self.option.goal_radius)
        if len(moved):
            self.option.drop(moved)
            self.recovery.reset(moved)
        return moved


def observe(
    option: WaypointOption,
    recovery: Recovery | None,
    layout: ObservationLayout,
    pose: np.ndarray,
    terms: Mapping[str, np.ndarray],
    goal: np.ndarray,
    occupancy: Sequence[OccupancyMap],
    time: np.ndarray | None,
    stamps: np.ndarray,
    rows: np.ndarray | None = None,
) -> tuple[OptionStep, np.ndarray, np.ndarray]:
    """What a robot does in a control step up to its skill, in training as on the robot.

    The option ends or goes on, whoever stands still gets a way out, and what guides the skill joins what is sensed.

    Args:
        option: plans of N robots.
        recovery: of the same robots; None: nobody gets a way out.
        layout: of the observation.
        pose: (M, 3) world frame [m, m, rad].
        terms: the robots' sensors by name, (M, d) each.
        goal: (M, 2) world frame [m].
        occupancy: M maps as they are now.
        time: (M,) since the start of each episode [s]; None for a skill without a clock.
        stamps: (M,) when the maps were made, on any clock [s].
        rows: (M,) the rows these belong to; all N by default.

    Returns:
        The option's step, the plans (M, K, 2) that are followed, world frame [m], and observations (M, D) float32.
    """
    step = option.step(pose[:, :2], goal, occupancy, rows, stamps)
    plan = step.plan
    if recovery is not None:
        plan = recovery(pose, plan, occupancy, rows)
        option.waiting |= recovery.ended
        terms = recovery.dim(terms, rows)
    return step, plan, layout.build(guided(terms, pose, plan, goal, time))


def guided(
    terms: Mapping[str, np.ndarray], pose: np.ndarray, plan: np.ndarray, goal: np.ndarray, time: np.ndarray | None
) -> dict[str, np.ndarray]:
    """Add what guides the skill to its sensors: waypoints and goal in the present body frame, and the gait clock.

    The waypoints are there in the world frame as well, for a skill that is made to observe them so.
    `time` (N,) is that since the start of each episode [s]; None for a skill without a clock.
    """
    guides = world_to_body(np.concatenate([plan, np.asarray(goal, dtype=np.float64)[:, None]], axis=1), pose)
    body, world = (points.reshape(len(pose), -1) for points in (guides[:, :-1], plan))
    values = {**terms, "waypoints": body, "world_waypoints": world, "goal": guides[:, -1]}
    if time is not None:
        values["clock"] = clock_phase(time)
    return values


def refresh_steps(control_period: float) -> int:
    """`WaypointOption.refresh` of a robot with that control period [s]."""
    return max(1, round(REFRESH_S / control_period))
