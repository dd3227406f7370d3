"""Shortest paths on a grid, and the shortcuts that make them smooth (paper section IV-A, appendix).

One field per map and goal labels every start in it. The cost of a path is its length times a factor that grows
where the clearance falls below `radius + soft_margin`, so paths keep off obstacles where there is room and still
pass where there is not. With `soft_margin = 0` the cost is the length.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from hiernav.nav.goal import GOAL_RADIUS
from hiernav.nav.occupancy import OccupancyMap
from hiernav.nav.opencv import cv2

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

CELL = 0.1  # [m], planning grid of the paper
_SAMPLE = 0.05  # [m], at which straight lines are checked against the map
STANDING = 0.1  # [m], by which a robot may miss the end of its path, strayed or stopped short
GOAL_REACH = GOAL_RADIUS - STANDING  # [m], from the goal to the end of a path
LEAD = 4.0 * CELL  # [m], beyond its radius, as far as a robot is led to where its way begins
_FALL_OF_PIXELS = 0.005  # [m], fall of the clearance along a lead that is put down to the pixels of the map
_LOOK_AHEAD = np.array([1, 2, 3, 4, 6, 8, 10, 12, 15, 18, 24])  # vertices tried as the end of a straight line


REFUSALS = {
    "not_finite": "the position or the goal is no number",
    "no_room": "the robot fits nowhere on the map",
    "goal_blocked": "the robot fits nowhere so near to the goal that it counts as reached",
    "enclosed": "no way leads from the position to the goal",
    "tight": "the robot does not fit along the first waypoints of the way to the goal",
}
"""Why there may be no path."""


class PathField:
    """Cost to go from every cell of a 0.1 m grid to one goal; 8-connected, no corner cutting.

    Args:
        occupancy: the map.
        goal: (2,) world frame [m]; where the disc does not fit, paths end where it does, on the way to the goal from
            the nearest cell in which it fits. If that is farther than `goal_reach` from the goal, there is no path.
        radius: disc that must fit everywhere on a path [m].
        soft_margin: further clearance that is worth a detour [m].
        soft_weight: relative extra cost of a metre at clearance `radius`.
        goal_reach: farthest end of a path from the goal [m] (`goal_reach_for`).
    """

    def __init__(
        self,
        occupancy: OccupancyMap,
        goal: np.ndarray,
        radius: float,
        soft_margin: float = 0.0,
        soft_weight: float = 8.0,
        goal_reach: float = GOAL_REACH,
    ) -> None:
        self.occupancy, self.radius = occupancy, radius
        self.soft_margin, self.soft_weight = soft_margin, soft_weight
        self.goal = np.array(goal, dtype=np.float64)
        # by how much more must fit where a line is looked at, so that the disc fits in between
        self._slack = math.hypot(radius, 0.5 * _SAMPLE) - radius
        self._centers, self._shape = _cell_centers(occupancy)
        self._clearance = clearance = occupancy.clearance_at(self._centers)
        self._free = clearance >= radius
        self._cost, self._next = np.full(len(self._free), np.inf), np.full(len(self._free), -1)
        self.goal_cell = _nearest(self._centers, self._free, self.goal)
        self._end = self.goal
        # a goal far from all that is free is not looked for on the long way there
        if self.goal_cell is not None and not self._near_goal(goal_reach + 2.0 * CELL):
            self.goal_cell = None
        if self.goal_cell is not None:
            self._end = self._nearest_end(self._centers[self.goal_cell])
            if not np.linalg.norm(self._end - self.goal) <= goal_reach:
                self.goal_cell = None
        if self.goal_cell is not None:
            from scipy.sparse.csgraph import dijkstra  # takes longest to import, and a control loop searches nothing

            graph = _grid_graph(self._free.reshape(self._shape), self._factor(clearance).reshape(self._shape))
            self._cost, self._next = dijkstra(graph, indices=self.goal_cell, return_predecessors=True)

    @property
    def cells(self) -> int:
        """How many cells the grid has: what the field's memory grows with."""
        return len(self._cost)

    def distance_at(self, points: np.ndarray) -> np.ndarray:
        """Cost to go [m] of the cells that (M, 2) points lie in; inf where no path starts."""
        return self._cost[self._cells(points)]

    def way_from(self, start: np.ndarray) -> float:
        """Cost to go [m] of a path from a start (2,), its way to the cell where that begins included; inf for none."""
        start = np.asarray(start, dtype=np.float64)
        own = int(self._cells(start[None])[0])
        cell = self._entry_for(start, own)
        if cell is None or cell == own:
            return float(self._cost[own])
        return float(self._cost[cell] + np.linalg.norm(self._centers[cell] - start))

    def path_from(self, start: np.ndarray, max_vertices: int | None = None) -> np.ndarray | None:
        """Vertices (K, 2) from a start to the goal, both included; None if there is no path.

        A start from whose own cell no path leads is led straight to the nearest cell within `radius` + `LEAD` from
        which one does and to which the disc can move: the clearance may not fall on the way there until the disc fits,
        and the disc must fit from then on. A start with room is thus never led through a gap, and one too close to an
        obstacle is led out of it. With `max_vertices` the path ends early, at a cell on the way.
        """
        start = np.asarray(start, dtype=np.float64)
        own = int(self._cells(start[None])[0])
        cell = self._entry_for(start, own)
        if cell is None:
            return None
        cells = [cell]
        limit = max_vertices or len(self._cost)
        while cell != self.goal_cell and len(cells) < limit:
            cell = self._next[cell]
            cells.append(cell)
        vertices = self._centers[cells]
        if cell == self.goal_cell:
            # the end takes the place of its cell's centre
            beside = int(self._cells(self._end[None])[0]) != cell
            vertices = np.concatenate([vertices[: len(vertices) - (not beside)], self._end[None]])
        if len(cells) > 1 and cells[0] == own and not self._led_astray(start, own, vertices[1]):
            vertices = vertices[1:]  # the centre of the start's own cell may lie behind it
        return np.concatenate([start[None], vertices])

    def refusal(self, start: np.ndarray) -> str | None:
        """Why no path leads from a start (2,) to the goal: one of `REFUSALS`; None if one does."""
        if not np.isfinite([start, self.goal]).all():
            return "not_finite"
        if not self._free.any():
            return "no_room"
        if self.goal_cell is None:
            return "goal_blocked"
        return None if self.path_from(start, max_vertices=1) is not None else "enclosed"

    def line_cost(self, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Cost of straight lines: (M, 2), (M, 2) -> (M,) [m]; inf where the disc does not fit."""
        delta = end - begin
        length = np.sqrt((delta * delta).sum(-1))
        counts = np.ceil(length / _SAMPLE).astype(np.int64) + 2
        firsts = np.concatenate([[0], np.cumsum(counts)[:-1]])
        line = np.repeat(np.arange(len(length)), counts)
        t = (np.arange(len(line)) - firsts[line]) / (counts - 1)[line]
        clearance = self.occupancy.clearance_at(begin[line] + t[:, None] * delta[line])
        mean = np.add.reduceat(self._factor(clearance), firsts) / counts
        return np.where(np.minimum.reduceat(clearance, firsts) >= self.radius + self._slack, length * mean, np.inf)

    def waypoints(self, start: np.ndarray, count: int = 10, spacing: float = 0.1) -> np.ndarray | None:
        """The first `count` waypoints (count, 2) of the smoothed path, padded with the goal; None without a path.

        From a start where the disc fits it fits at every waypoint.
        """
        path = self.path_from(start, max_vertices=int(3 * count * spacing / CELL) + 4)
        if path is None:
            return None
        return self._given_room(resample(self.smooth(path, count * spacing), count, spacing))

    def smooth(self, path: np.ndarray, length: float = np.inf) -> np.ndarray:
        """Replace stretches of a path by the longest straight lines that cost no more, until `length` is covered."""
        here, covered = 0, 0.0
        kept, cost = [path[0]], self.distance_at(path)
        if np.isinf(cost[-1]):  # the end, in a cell in whose centre the disc does not fit
            cost[-1] = 0.0
        while here < len(path) - 1 and covered < length:
            ahead = here + _LOOK_AHEAD[_LOOK_AHEAD < len(path) - here]
            straight = self.line_cost(np.broadcast_to(path[here], (len(ahead), 2)), path[ahead])
            # a cell may be half a cell off the vertex in it at both ends
            good = ahead[np.isfinite(straight) & (straight <= cost[here] - cost[ahead] + CELL)]
            following = int(good[-1]) if len(good) else here + 1
            covered += float(np.linalg.norm(path[following] - path[here]))
            here = following
            kept.append(path[here])
        return np.array(kept)

    def _near_goal(self, reach: float) -> bool:
        """Whether the goal's cell has its centre within `reach` [m] of the goal; True where that is not finite."""
        apart = np.linalg.norm(self._centers[self.goal_cell] - self.goal)
        return not apart > reach or not np.isfinite(apart)

    def _nearest_end(self, center: np.ndarray) -> np.ndarray:
        """The goal, or where the disc cannot get to it from `center` (2,) the last point on the way where it can."""
        delta = center - self.goal
        t = np.linspace(0.0, 1.0, 2 + int(np.linalg.norm(delta) / 0.01)) if np.isfinite(delta).all() else np.ones(1)
        points = self.goal + t[:, None] * delta
        clearance = self.occupancy.clearance_at(points)
        short = np.flatnonzero(clearance < self.radius - (_FALL_OF_PIXELS if clearance[0] >= self.radius else 0.0))
        return points[min(short[-1] + 1, len(points) - 1)] if len(short) else self.goal

    def _given_room(self, points: np.ndarray) -> np.ndarray:
        """Points (K, 2), moved where they lack a hair of room: only the centres of cells are known to be free."""
        lack = self.radius - self.occupancy.clearance_at(points)
        for row in np.flatnonzero((lack > 0.0) & (lack < 0.25 * CELL)).tolist():
            around = points[row] + 0.1 * CELL * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
            room = self.occupancy.clearance_at(around)
            uphill = np.array([room[0] - room[1], room[2] - room[3]])
            moved = points[row] + np.arange(1, 6)[:, None] * 0.05 * CELL * uphill / max(float(np.hypot(*uphill)), 1e-9)
            fits = np.flatnonzero(self.occupancy.is_free(moved, self.radius))
            if len(fits):
                points[row] = moved[fits[0]]
        return points

    def _led_astray(self, start: np.ndarray, own: int, vertex: np.ndarray) -> bool:
        """Whether a straight line from a start in cell `own` to a vertex beside it takes room that a disc has there."""
        if self._clearance[own] >= self.radius + 2.0 * CELL:
            return False
        has_room = self.occupancy.clearance_at(start) >= self.radius
        return bool(has_room and not self._visible(start[None], vertex[None])[0])

    def _visible(self, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
        return np.isfinite(self.line_cost(begin, end))

    def _factor(self, clearance: np.ndarray) -> np.ndarray:
        if self.soft_margin <= 0:
            return np.ones_like(clearance, dtype=np.float64)
        lack = np.clip(1.0 - (clearance - self.radius) / self.soft_margin, 0.0, 1.0)
        return 1.0 + self.soft_weight * lack**2

    def _cells(self, points: np.ndarray) -> np.ndarray:
        index = np.floor((points - np.asarray(self.occupancy.origin)) / CELL).astype(np.int64)
        rows, cols = self._shape
        return np.clip(index[..., 1], 0, rows - 1) * cols + np.clip(index[..., 0], 0, cols - 1)

    def _entry_for(self, start: np.ndarray, own: int) -> int | None:
        """The cell at which a path from `start` (2,) in cell `own` begins, None if there is none."""
        if np.isfinite(self._cost[own]):
            return own
        reach = self.radius + LEAD
        (row, col), around = divmod(own, self._shape[1]), int(reach / CELL) + 1
        rows = np.arange(max(row - around, 0), min(row + around + 1, self._shape[0]))
        cols = np.arange(max(col - around, 0), min(col + around + 1, self._shape[1]))
        cells = (rows[:, None] * self._shape[1] + cols).ravel()
        cells = cells[np.isfinite(self._cost[cells])]
        apart = np.linalg.norm(self._centers[cells] - start, axis=-1)
        near = np.argsort(apart, kind="stable")[: np.count_nonzero(apart <= reach)]
        for first, last in ((0, 6), (6, len(near))):  # one of the nearest will do as a rule
            some = cells[near[first:last]]
            fit = np.flatnonzero(self._can_be_led(start, self._centers[some]))
            if len(fit):
                return int(some[fit[0]])
        return None

    def _can_be_led(self, start: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Whether the disc can move straight from a start (2,), where it need not fit, to ends (M, 2): (M,) bool."""
        t = np.linspace(0.0, 1.0, 2 + int(2.0 * (self.radius + LEAD) / _SAMPLE))[:, None]
        clearance = self.occupancy.clearance_at((1.0 - t) * start + t * ends[:, None])
        return keeps_room(clearance, self.radius, _FALL_OF_PIXELS)


def goal_reach_for(goal_radius: float) -> float:
    """How far from the goal a path may end [m], so that a robot at its end has reached a goal of that radius [m]."""
    return max(goal_radius - STANDING, 0.0)


def keeps_room(clearance: np.ndarray, radius: float, dip: float) -> np.ndarray:
    """Whether a disc can move where the clearance is (M, S) [m] in order of the way: (M,) bool.

    Where it does not fit from the start, the clearance may not fall until it fits; from then on it must fit, but for a
    `dip` [m]. It must fit at the end.
    """
    most = np.minimum(np.maximum.accumulate(clearance, axis=1), radius)
    return (clearance >= most - dip).all(axis=1) & (clearance[:, -1] >= radius - dip)


def is_solvable(occupancy: OccupancyMap, start: np.ndarray, goal: np.ndarray, radius: float) -> bool:
    """Whether a disc of `radius` [m] can move from start (2,) to goal (2,) through the map."""
    ends = np.stack([np.asarray(start)[:2], np.asarray(goal)[:2]])
    if not (occupancy.clearance_at(ends) >= radius).all():
        return False
    centers, shape = _cell_centers(occupancy)
    free = occupancy.clearance_at(centers) >= radius
    cells = [_nearest(centers, free, end) for end in ends]
    if cells[0] is None or cells[1] is None:
        return False
    # where no corner is cut, cells joined by a diagonal are joined by two edges as well
    _, labels = cv2.connectedComponents(free.reshape(shape).astype(np.uint8), connectivity=4)
    return bool(labels.flat[cells[0]] == labels.flat[cells[1]])


def resample(path: np.ndarray, count: int, spacing: float) -> np.ndarray:
    """Points every `spacing` along a path (K, 2), first one excluded, padded with its end: (count, 2)."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=-1)
    arc = np.concatenate([[0.0], np.cumsum(steps)])
    stations = np.minimum(np.arange(1, count + 1) * spacing, arc[-1])
    return np.stack([np.interp(stations, arc, path[:, 0]), np.interp(stations, arc, path[:, 1])], axis=-1)


def random_shortcuts(
    path: np.ndarray, field: PathField, rng: np.random.Generator, tries: int = 30, spacing: float = CELL
) -> np.ndarray:
    """The paper's smoothing: pick two vertices, replace what lies between by evenly spaced points if they are free."""
    for _ in range(tries):
        if len(path) < 3:
            break
        i, j = np.sort(rng.choice(len(path), size=2, replace=False))
        if j - i < 2 or not field._visible(path[i : i + 1], path[j : j + 1])[0]:
            continue
        pieces = max(1, int(np.ceil(np.linalg.norm(path[j] - path[i]) / spacing)))
        line = path[i] + np.linspace(0.0, 1.0, pieces + 1)[1:-1, None] * (path[j] - path[i])
        path = np.concatenate([path[: i + 1], line, path[j:]])
    return path


def grid_cells(occupancy: OccupancyMap) -> int:
    """How many planning cells a map has: what the time of a search grows with."""
    rows, cols = _grid_shape(occupancy)
    return rows * cols


def _grid_shape(occupancy: OccupancyMap) -> tuple[int, int]:
    height, width = (side * occupancy.resolution for side in occupancy.occupied.shape)
    return max(1, round(height / CELL)), max(1, round(width / CELL))


def _cell_centers(occupancy: OccupancyMap) -> tuple[np.ndarray, tuple[int, int]]:
    """Centres (rows * cols, 2) of the planning cells and the shape of their grid."""
    rows, cols = _grid_shape(occupancy)
    x = occupancy.origin[0] + (np.arange(cols) + 0.5) * CELL
    y = occupancy.origin[1] + (np.arange(rows) + 0.5) * CELL
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2), (rows, cols)


def _nearest(centers: np.ndarray, free: np.ndarray, point: np.ndarray) -> int | None:
    candidates = np.flatnonzero(free)
    if not len(candidates):
        return None
    return int(candidates[np.square(centers[candidates] - point).sum(-1).argmin()])


def _grid_graph(free: np.ndarray, factor: np.ndarray) -> csr_matrix:
    """Sparse graph of the free cells; an edge costs its length times the mean factor of its ends."""
    from scipy.sparse import csr_matrix

    rows, cols = free.shape
    index = np.arange(rows * cols).reshape(rows, cols)
    source, target, weight = [], [], []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = (slice(0, rows - down), slice(max(0, -right), cols - max(0, right)))
        b = (slice(down, rows), slice(max(0, right), cols - max(0, -right)))
        open_ = free[a] & free[b]
        if down and right:  # both cells beside a diagonal must be free: no corner is cut
            open_ &= free[a[0], b[1]] & free[b[0], a[1]]
        source.append(index[a][open_])
        target.append(index[b][open_])
        weight.append(CELL * np.hypot(down, right) * 0.5 * (factor[a][open_] + factor[b][open_]))
    s, t, w = np.concatenate(source), np.concatenate(target), np.concatenate(weight)
    size = rows * cols
    return csr_matrix((np.concatenate([w, w]), (np.concatenate([s, t]), np.concatenate([t, s]))), shape=(size, size))
