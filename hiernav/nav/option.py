"""The option: plans, each followed until a rule ends it (paper section IV-C).

The waypoint generator is the option's policy over plans; the skill runs inside it. Training, evaluation and robot
all step the same `WaypointOption`.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from hiernav.nav import path
from hiernav.nav.goal import GOAL_RADIUS
from hiernav.nav.occupancy import OccupancyMap, VisitMap
from hiernav.nav.prediction import MapPredictor
from hiernav.nav.sweep import meets_map, sweep
from hiernav.nav.termination import ReplanRule, TerminationReason

# Looking a member up takes longer than the comparison it is used in, and the robot does so at every tick.
_NONE, _GOAL = int(TerminationReason.NONE), int(TerminationReason.GOAL)

LONGEST_PLAN = 10.0
"""A plan with a waypoint farther than this from the robot in x or y is refused [m]."""
REFRESH_S = 0.2
"""How old a plan may get that was made on another map than the present one [s]."""


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


def refresh_steps(control_period: float) -> int:
    """`WaypointOption.refresh` of a robot with that control period [s]."""
    return max(1, round(REFRESH_S / control_period))
