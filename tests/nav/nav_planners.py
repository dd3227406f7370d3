"""Planners with known answers, for tests of what is done with a plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from hiernav.nav.occupancy import OccupancyMap, VisitMap, draw_discs, empty_map
from hiernav.nav.option import PlanQuery
from hiernav.nav.planners import StraightPlanner


@dataclass
class WatchedPlanner:
    """Goes straight at the goal and keeps what it was asked; while it is `silent` it finds nothing."""

    silent: bool = False
    queries: list[PlanQuery] = field(default_factory=list)

    def plan(self, query: PlanQuery) -> np.ndarray:
        self.queries.append(query)
        plans = StraightPlanner().plan(query)
        return np.full_like(plans, np.nan) if self.silent else plans


def map_with_pillars(
    centers: Sequence[Sequence[float]] = (), half_size: tuple[float, float] = (3.0, 3.0), radius: float = 0.2
) -> OccupancyMap:
    """A free map with discs drawn into it [m]."""
    field_ = empty_map(half_size)
    draw_discs(
        field_.occupied, field_.origin, field_.resolution, np.reshape(np.asarray(centers, float), (-1, 2)), radius
    )
    return field_


def query_of(
    position: Sequence[Sequence[float]],
    goal: Sequence[Sequence[float]],
    occupancy: OccupancyMap,
    previous: np.ndarray | None = None,
) -> PlanQuery:
    """A query for M robots on one map."""
    where = np.asarray(position, float)
    previous = np.full((len(where), 10, 2), np.nan) if previous is None else previous
    visits = [VisitMap(occupancy) for _ in where]
    return PlanQuery(where, np.asarray(goal, float), [occupancy] * len(where), visits, previous)


def pillar_world(seed: int) -> tuple[np.ndarray, OccupancyMap, np.ndarray, np.ndarray]:
    """Ten pillars in a field of 4 x 4 m, their map, and a start and a goal at which a disc of 0.1 m fits well."""
    rng = np.random.default_rng(seed)
    pillars = rng.uniform(-2.0, 2.0, (10, 2))
    occupancy = map_with_pillars(pillars, (2.0, 2.0))
    points = rng.uniform(-1.85, 1.85, (60, 2))
    fit = points[np.linalg.norm(points[:, None] - pillars, axis=-1).min(axis=1) >= 0.33]
    return pillars, occupancy, fit[0], fit[1]
