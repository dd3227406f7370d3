"""The planner alone: a disc that moves along the waypoints, without physics (paper section V-A, Table II)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hiernav.nav.goal import GOAL_RADIUS
from hiernav.nav.occupancy import VisitMap
from hiernav.nav.option import Planner, PlanQuery
from hiernav.sim.layout import Layout

_STRIDE = 5
"""Waypoints that are walked along before the next plan."""


@dataclass
class WalkResult:
    """Outcome of walking every layout once; (E,) arrays."""

    collisions: np.ndarray
    """Waypoints at which the disc touched an obstacle."""
    reached: np.ndarray
    plans: np.ndarray
    """Plans that were asked for."""

    def summary(self) -> dict[str, float]:
        """Means over the episodes; `collision_free_rate` is that of reaching the goal without a collision."""
        return {
            "collisions_mean": float(self.collisions.mean()),
            "collision_free_rate": float((self.reached & (self.collisions == 0)).mean()),
            "reach_rate": float(self.reached.mean()),
            "plans_mean": float(self.plans.mean()),
        }


def walk(planner: Planner, layouts: Sequence[Layout], radius: float = 0.1, max_plans: int = 60) -> WalkResult:
    """Move a disc along the first five waypoints of a plan, plan anew, and so on until the goal.

    Every waypoint at which the disc touches an obstacle counts one collision; the disc moves on all the same.

    Args:
        radius: of the disc [m].
        max_plans: after which an episode counts as not reached.
    """
    count = len(layouts)
    maps = [layout.occupancy(0.0) for layout in layouts]
    visits = [VisitMap(occupancy) for occupancy in maps]
    position = np.array([layout.start[:2] for layout in layouts], dtype=np.float64)
    goal = np.array([layout.goal for layout in layouts], dtype=np.float64)
    previous: np.ndarray | None = None
    collisions, plans = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
    reached = np.linalg.norm(position - goal, axis=-1) <= GOAL_RADIUS
    for _ in range(max_plans):
        rows = np.flatnonzero(~reached)
        if not len(rows):
            break
        for row in rows:
            visits[row].add(position[row])
        old = np.full((len(rows), 1, 2), np.nan) if previous is None else previous[rows]
        query = PlanQuery(position[rows], goal[rows], [maps[r] for r in rows], [visits[r] for r in rows], old)
        proposed = planner.plan(query)
        if previous is None:
            previous = np.full((count, *proposed.shape[1:]), np.nan)
        previous[rows] = proposed
        plans[rows] += 1
        for row, plan in zip(rows, proposed, strict=True):
            if not np.isfinite(plan).all():
                continue
            touched = ~maps[row].is_free(plan[:_STRIDE], radius)
            for waypoint, hit in zip(plan[:_STRIDE], touched, strict=True):
                position[row] = waypoint
                visits[row].add(waypoint)
                collisions[row] += hit
                if np.linalg.norm(waypoint - goal[row]) <= GOAL_RADIUS:
                    reached[row] = True
                    break
    return WalkResult(collisions, reached, plans)
