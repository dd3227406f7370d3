"""Planners behind one protocol: shortest paths, a waypoint network on GOSELO images, and verification of either."""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from hiernav.nav import goselo
from hiernav.nav.goal import GOAL_RADIUS
from hiernav.nav.occupancy import OccupancyMap, VisitMap
from hiernav.nav.option import Planner, PlanQuery
from hiernav.nav.path import arc_lengths, polyline
from hiernav.nav.search import CELL, GOAL_REACH, PathField, goal_reach_for, keeps_room
from hiernav.nav.sweep import leads_out, places

CACHED_CELLS = 500_000
"""Of all shortest-path fields that a planner keeps: about 80 MB, and 64 maps of up to 8.8 x 8.8 m."""

Network = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Images (M, C, 64, 64) uint8 and distances L (M,) float32 [m] -> waypoints (M, H, K, 2) in the GOSELO frame [m] and
scores (M, H) of H hypotheses."""

_FARTHEST = 100.0
_FALL_BETWEEN_CELLS = 0.15 * CELL
"""What a shortest path may lack of its radius [m]: the disc is known to fit at the centres of cells, and between two of
them the clearance may be lower."""
_LEAST_GAIN = 0.5
"""Share of its length by which a plan must shorten the way to the goal."""
_TIGHTNESS = 4.0
"""Score that a hypothesis loses which leaves nothing beyond the radius."""


@dataclass
class ShortestPathPlanner:
    """The expert: first waypoints of the smoothed shortest path ("astar" on the command line).

    One field per map and goal answers every query on that map, so only the first query of an episode searches. The
    fields used last are kept, as many as `cache_size` and `cached_cells` allow, but always the newest.
    """

    radius: float = 0.1
    """Disc that must fit on the path [m]."""
    soft_margin: float = 0.15
    """Further clearance worth a detour [m]."""
    num_waypoints: int = 10
    spacing: float = 0.1
    """Distance between waypoints along the path [m]."""
    goal_reach: float = GOAL_REACH
    """Farthest end of a path from a goal beside which the disc does not fit [m]."""
    cache_size: int = 256
    cached_cells: int = CACHED_CELLS
    """Planning cells of all kept fields together."""
    _fields: OrderedDict[tuple[int, float, float], PathField] = field(default_factory=OrderedDict, repr=False)

    def __post_init__(self) -> None:
        import scipy.sparse.csgraph  # noqa: F401  now, and not in the control step that searches first

    def plan(self, query: PlanQuery) -> np.ndarray:
        plans = np.full((len(query.position), self.num_waypoints, 2), np.nan)
        for row, (position, goal, occupancy) in enumerate(
            zip(query.position, query.goal, query.occupancy, strict=True)
        ):
            if not np.isfinite([position, goal]).all():
                continue
            waypoints = self.field(occupancy, goal).waypoints(position, self.num_waypoints, self.spacing)
            if waypoints is not None:
                plans[row] = waypoints
        return plans

    def refusal(self, query: PlanQuery, row: int) -> str | None:
        """Why a row of a query has no plan: one of `hiernav.nav.search.REFUSALS`; None if it has one."""
        return self.field(query.occupancy[row], query.goal[row]).refusal(query.position[row])

    def field(self, occupancy: OccupancyMap, goal: np.ndarray) -> PathField:
        """The shortest-path field of a map and a goal (2,) [m]."""
        # the field holds its map, so the identity cannot be taken over by another one while the entry lives
        key = (id(occupancy), float(goal[0]), float(goal[1]))
        if key not in self._fields:
            self._fields[key] = PathField(occupancy, goal, self.radius, self.soft_margin, goal_reach=self.goal_reach)
            cells = sum(kept.cells for kept in self._fields.values())
            while len(self._fields) > 1 and (len(self._fields) > self.cache_size or cells > self.cached_cells):
                cells -= self._fields.popitem(last=False)[1].cells
        self._fields.move_to_end(key)
        return self._fields[key]


@dataclass(frozen=True)
class StraightPlanner:
    """Waypoints on the straight line to the goal, whatever stands there: for skills that follow no plan."""

    num_waypoints: int = 10
    spacing: float = 0.1
    """Distance between waypoints along the line [m]."""

    def plan(self, query: PlanQuery) -> np.ndarray:
        delta = query.goal - query.position
        length = np.maximum(np.linalg.norm(delta, axis=-1), 1e-9)[:, None, None]
        along = np.minimum(self.spacing * np.arange(1, self.num_waypoints + 1)[None, :, None], length)
        return query.position[:, None] + along * delta[:, None] / length


@dataclass
class GoseloPlanner:
    """A waypoint network: GOSELO image in, the best of its hypotheses out."""

    network: Network
    channels: tuple[str, ...] = goselo.CHANNELS
    radius: float = 0.1
    """Clearance a hypothesis must keep where any does [m]."""
    margin: float = 0.15
    """Further clearance worth a lower score: what a robot that strays from its plan needs [m]."""
    hysteresis: float = 1.0
    """Score a hypothesis gains by lying on the plan it replaces; keeps plans from flipping sides."""

    def plan(self, query: PlanQuery) -> np.ndarray:
        frame = goselo.GoseloFrame.of(query.position, query.goal)
        image = goselo.images(query.occupancy, query.visits, frame, self.channels)
        waypoints, scores = self.network(image, frame.distance.astype(np.float32))
        return self.select(frame.to_world(waypoints.astype(np.float64)), scores.astype(np.float64), query)

    def select(self, candidates: np.ndarray, scores: np.ndarray, query: PlanQuery) -> np.ndarray:
        """Pick one hypothesis per row: free of collision first, then score and agreement with the previous plan.

        Those that keep `radius` clear come before all that do not, and these before those that are no numbers. Among
        equals score, agreement and room are weighed.

        Args:
            candidates: (M, H, K, 2) world frame [m].
            scores: (M, H), log-probabilities or the like.
        """
        if candidates.shape[1] == 1:
            return candidates[:, 0]
        clearance = np.stack(
            [
                swept_clearance(np.broadcast_to(position, (len(plans), 2)), plans, occupancy)
                for position, plans, occupancy in zip(query.position, candidates, query.occupancy, strict=True)
            ]
        )
        agreement = np.exp(-np.nan_to_num(apart_from(query.previous, query.position, candidates), nan=np.inf) / 0.1)
        shortfall = np.clip(self.radius - clearance, 0.0, None) / self.radius
        tight = np.clip(1.0 - (clearance - self.radius) / max(self.margin, 1e-6), 0.0, 1.0)
        merit = scores + self.hysteresis * agreement - 100.0 * shortfall - _TIGHTNESS * tight**2
        free, known = clearance >= self.radius, np.isfinite(merit)
        eligible = np.where((free & known).any(axis=1, keepdims=True), free & known, known)
        best = np.where(eligible, merit, -np.inf).argmax(axis=1)
        return candidates[np.arange(len(candidates)), best]


COUNTS = ("proposals", "repairs", "loops", "detours", "refusals")
"""What a `VerifiedPlanner` counts."""


@dataclass
class VerifiedPlanner:
    """Checks every proposal and replaces the bad ones by the shortest path.

    A proposal is bad if its sweep meets the map, if its second half leads where the robot has been, or if it does not
    bring the robot nearer to the goal along the shortest path: a network without memory can lead to and fro between two
    ways, a shortest path never does. A shortest path is swept as well, and is no repair where the disc does not fit
    along it; only on the way out of where it does not fit from the start, it may lack room. Counts proposals, repairs,
    loops and detours among them (of the second and third kind) and refusals (there is no repair and the proposal is not
    free: the row is NaN then; a free proposal stands).
    """

    planner: Planner
    repair: ShortestPathPlanner
    radius: float = 0.1
    """Disc that must fit along the plan [m]."""
    goal_radius: float = GOAL_RADIUS
    """Plans are judged up to where they come this close to the goal [m]."""
    tally: Counter[str] = field(default_factory=Counter, init=False)
    """See `counts`."""

    def plan(self, query: PlanQuery) -> np.ndarray:
        plans = self.planner.plan(query)
        self.tally["proposals"] += len(plans)
        clearance = np.array(
            [
                swept_clearance(position[None], plan[None], occupancy)[0]
                for position, plan, occupancy in zip(query.position, plans, query.occupancy, strict=True)
            ]
        )
        free = clearance >= self.radius
        back = np.array([ok and self._leads_back(*row) for ok, *row in zip(free, plans, query.visits, strict=True)])
        away = np.array([ok and self._leads_away(query, plans[row], row) for row, ok in enumerate(free & ~back)])
        bad = np.flatnonzero(~free | back | away).tolist()
        if not bad:
            return plans
        part = PlanQuery(
            query.position[bad],
            query.goal[bad],
            [query.occupancy[row] for row in bad],
            [query.visits[row] for row in bad],
            query.previous[bad],
        )
        repaired = self.repair.plan(part)
        found = self._fits(repaired, part)
        repaired[~found] = np.nan
        refused = np.flatnonzero(~found & ~free[bad]).tolist()
        plans = plans.copy()
        plans[bad] = np.where((found | ~free[bad])[:, None, None], repaired, plans[bad])
        self.tally["repairs"] += int(found.sum())
        self.tally["loops"] += int((found & back[bad]).sum())
        self.tally["detours"] += int((found & away[bad]).sum())
        self.tally["refusals"] += len(refused)
        self.tally.update(f"refusals/{self.repair.refusal(part, row) or 'tight'}" for row in refused)
        return plans

    def counts(self) -> dict[str, int]:
        """Proposals, repairs, loops and detours among them, refusals and why there is no path, since the start.

        The latter are named `refusals/...` (`hiernav.nav.search.REFUSALS`).
        """
        return {name: self.tally[name] for name in COUNTS} | dict(sorted(self.tally.items()))

    def _fits(self, repaired: np.ndarray, query: PlanQuery) -> np.ndarray:
        """Whether shortest paths (M, K, 2), NaN where there is none, leave the disc room: (M,) bool."""
        radius = min(self.radius, self.repair.radius)
        fits = np.isfinite(repaired).all(axis=(1, 2))
        for row in np.flatnonzero(fits).tolist():
            points = places(polyline(query.position[row][None], repaired[row][None]))[0]
            fits[row] = keeps_room(query.occupancy[row].clearance_at(points), radius, _FALL_BETWEEN_CELLS)[0]
        return fits

    def _leads_away(self, query: PlanQuery, plan: np.ndarray, row: int) -> bool:
        # behind the goal every way leads away from it
        reached = np.flatnonzero(np.linalg.norm(plan - query.goal[row], axis=-1) <= self.goal_radius)
        driven = plan[: reached[0] + 1] if len(reached) else plan
        field = self.repair.field(query.occupancy[row], query.goal[row])
        here, there = field.way_from(query.position[row]), field.way_from(driven[-1])
        length = arc_lengths(polyline(query.position[row][None], driven[None]))[0, -1]
        # less a cell, which is how exactly the way is known; where there is none, inf - inf speaks for no plan
        return here - there < _LEAST_GAIN * float(length) - CELL

    def _leads_back(self, plan: np.ndarray, visits: VisitMap) -> bool:
        return any(visits.near(point, self.radius) for point in plan[len(plan) // 2 :])


def apart_from(previous: np.ndarray, position: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    """How far plans lie from what is left of the ones they would replace.

    Args:
        previous: (M, P, 2) [m], NaN where there is none.
        position: (M, 2) of the robots [m]; what is left begins at the waypoint closest to it.
        candidates: (M, H, K, 2) [m].

    Returns:
        (M, H) mean distance [m] of those waypoints, as far as a candidate reaches, from the candidate's nearest one.
    """
    index = np.arange(previous.shape[1])
    first = np.nan_to_num(np.linalg.norm(previous - position[:, None], axis=-1), nan=np.inf).argmin(axis=1)
    apart = np.linalg.norm(previous[:, None, :, None] - candidates[:, :, None, :], axis=-1).min(axis=-1)
    left = (index >= first[:, None])[:, None]
    return (apart * left).sum(axis=-1) / left.sum(axis=-1)


def swept_clearance(start: np.ndarray, plans: np.ndarray, occupancy: OccupancyMap) -> np.ndarray:
    """Smallest clearance on the way along plans, beyond what the start itself lacks.

    The first 0.15 m do not count where they lead away from an obstacle that the robot already stands too close to.

    Args:
        start: (M, 2) [m].
        plans: (M, K, 2) [m]; NaN, and what is farther than 100 m from the start in x or y, gives NaN.

    Returns:
        (M,) [m].
    """
    finite = (np.abs(plans - start[:, None]) <= _FARTHEST).all(axis=(1, 2))
    points, arc, _ = places(polyline(start, np.where(finite[:, None, None], plans, start[:, None])))
    clearance = occupancy.clearance_at(points)
    # the start itself is where the robot is, whatever the plan
    ahead = np.where(leads_out(clearance, arc), np.inf, clearance[:, 1:])
    return np.where(finite, ahead.min(axis=1, initial=np.inf), np.nan)


def verified_planner(
    network: Network,
    channels: tuple[str, ...],
    expert: ShortestPathPlanner,
    robot_radius: float,
    goal_radius: float = GOAL_RADIUS,
) -> VerifiedPlanner:
    """A network's plans as robots drive them: checked for a disc of `robot_radius` [m], repaired by the expert.

    Plans of the expert end within `goal_radius` [m] of the goal, with 0.1 m to spare.
    """
    expert = replace(expert, goal_reach=goal_reach_for(goal_radius), _fields=OrderedDict())
    proposer = GoseloPlanner(network, channels, expert.radius, expert.soft_margin)
    return VerifiedPlanner(proposer, expert, robot_radius, goal_radius=goal_radius)
