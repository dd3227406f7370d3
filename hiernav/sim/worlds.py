"""Sampling of worlds: the same specification and seed give the same layout on every machine (paper Sec. V-A)."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from hiernav.nav.occupancy import OccupancyMap
from hiernav.nav.opencv import cv2
from hiernav.nav.search import is_solvable
from hiernav.sim.layout import (
    GREMLIN_DISC_RADIUS,
    GREMLIN_ORBIT,
    WALL_THICKNESS,
    Layout,
    WorldSpec,
    cached_map,
)

START_KEEP_OUT = 0.4
GOAL_KEEP_OUT = 0.4
PILLAR_KEEP_OUT = 0.3
# The whole of a gremlin's circle. With 0.4 for start and goal it leaves 0.4 m between either and any point a box ever
# covers: more than the widest robot (0.2) needs at the start, and the goal's 0.3 m can be entered at any time. Two
# gremlins never meet, and none leaves the field.
GREMLIN_KEEP_OUT = GREMLIN_ORBIT + GREMLIN_DISC_RADIUS
KEEP_OUT = {"pillar": PILLAR_KEEP_OUT, "gremlin": GREMLIN_KEEP_OUT}
TWO_ROOM_OPENING = 1.0
FOUR_ROOM_OPENING = 0.8
MIN_WALL_PIECE = 0.3

MAX_REDRAWS = 100
MAX_PLACEMENTS = 10_000  # of things in one layout, over all its restarts
_FEW, _MANY = 8, 512  # points tried for one thing, one by one and then at once, before the layout is started again


class WorldError(ValueError):
    """No solvable layout was found; the message names the world, the tries and what to change."""


def sample_layout(spec: WorldSpec, seed: int, robot_radius: float = 0.1) -> Layout:
    """One layout of a world, with a path from start to goal for a disc of `robot_radius` [m].

    Things are placed by rejection: two of them are at least the sum of their keep-outs apart (pillar 0.3, gremlin
    0.441, start 0.4, goal 0.4 m) and each is at least its own inside the border; in rooms, start and goal are that far
    from the walls' faces and never share a room; in maps they have 0.4 m of clearance where the map has such places,
    else robot_radius. The heading is uniform in [-pi, pi). A gremlin world is checked at time 0.

    Raises WorldError if no such layout is found in a bounded number of tries, ValueError for a negative seed or a
    radius that is not finite and positive.
    """
    if not (math.isfinite(robot_radius) and robot_radius > 0):
        raise ValueError(f"robot_radius {robot_radius} m, it must be finite and positive")
    if seed < 0:
        raise ValueError(f"seed {seed}, it must not be negative")
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
    for redraws in range(MAX_REDRAWS):
        layout = _draw(spec, seed, robot_radius, rng, redraws)
        if layout is not None and is_solvable(layout.occupancy(0.0), layout.start[:2], layout.goal, robot_radius):
            return layout
    raise WorldError(
        f"world {spec}, seed {seed}: none of {MAX_REDRAWS} layouts has a path from start to goal for a robot of radius "
        f"{robot_radius} m; use fewer obstacles, a larger field or a smaller robot"
    )


def _draw(spec: WorldSpec, seed: int, robot_radius: float, rng: np.random.Generator, redraws: int = 0) -> Layout | None:
    """One layout, solvable or not; None if a map gave a start that no goal can be reached from."""
    nothing = np.zeros((0, 2))
    pillars, gremlins, walls, base_map = nothing, nothing, np.zeros((0, 4)), None
    if spec.kind == "map":
        base_map = cached_map(str(spec.map_path))
        points = _draw_map_points(spec, base_map, robot_radius, rng)
        if points is None:
            return None
        start, goal = points
    elif spec.kind in ("two-room", "four-room"):
        walls = _draw_walls(spec, rng)
        start, goal = _draw_room_points(spec, rng)
    else:
        start, goal, obstacles = _draw_things(spec, KEEP_OUT[spec.kind], rng)
        pillars, gremlins = (obstacles, nothing) if spec.kind == "pillar" else (nothing, obstacles)
    heading = math.pi * (2.0 * rng.random() - 1.0)
    pose = np.array([start[0], start[1], heading])
    return Layout(spec, seed, pillars, gremlins, walls, pose, np.array(goal), base_map, redraws)


def _draw_things(
    spec: WorldSpec, keep_out: float, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Start (2,), goal (2,) and obstacles (N, 2), each at the first free one of some uniform points in its turn."""
    half_size = np.array([spec.half_width, spec.half_height])
    keep_outs = np.full(spec.num_obstacles + 2, keep_out)
    keep_outs[:2] = START_KEEP_OUT, GOAL_KEEP_OUT
    what_to_do = "use fewer obstacles or a larger field"
    area, field_area = float(math.pi * (keep_outs**2).sum()), float(4.0 * half_size.prod())
    if area > field_area:
        raise WorldError(
            f"world {spec}: start, goal and {spec.num_obstacles} obstacles keep {area:.1f} m2 to themselves, "
            f"the field has {field_area:.1f} m2 (0 tries); {what_to_do}"
        )
    tries = placements = 0
    while placements < MAX_PLACEMENTS:
        tries += 1
        placed = _Placed(2.0 * float(keep_outs.max()))
        for own in keep_outs.tolist():
            placements += 1
            point = placed.find_free(half_size - own, own, rng)
            if point is None:
                break
            placed.add(*point, own)
        else:
            points = placed.things[:, :2]
            return points[0], points[1], points[2:]
    raise WorldError(f"world {spec}: its things found no room in {tries} tries; {what_to_do}")


class _Placed:
    """Things [x, y, keep_out], in square buckets no smaller than the largest separation: neighbours are compared."""

    def __init__(self, bucket_side: float) -> None:
        self._things: list[tuple[float, float, float]] = []
        self._side = bucket_side
        self._buckets: dict[tuple[int, int], list[tuple[float, float, float]]] = {}

    @property
    def things(self) -> NDArray[np.float64]:
        """(K, 3), in the order in which they were added."""
        return np.array(self._things).reshape(-1, 3)

    def add(self, x: float, y: float, keep_out: float) -> None:
        self._things.append((x, y, keep_out))
        self._buckets.setdefault(self._bucket(x, y), []).append((x, y, keep_out))

    def find_free(
        self, half_size: NDArray[np.float64], keep_out: float, rng: np.random.Generator
    ) -> tuple[float, float] | None:
        """The first of some uniform points that is at least the sum of the keep-outs from everything, if any is."""
        # comparing many points with all things at once is quick only while the things are few
        one_by_one = max(_FEW, len(self._things) // 4)
        for x, y in (half_size * (2.0 * rng.random((one_by_one, 2)) - 1.0)).tolist():
            if self._is_free(x, y, keep_out):
                return x, y
        points = half_size * (2.0 * rng.random((_MANY, 2)) - 1.0)
        others = self.things
        dx, dy = points[:, 0:1] - others[:, 0], points[:, 1:2] - others[:, 1]
        separation = keep_out + others[:, 2]
        free = np.all(dx * dx + dy * dy >= separation * separation, axis=1)
        choice = int(free.argmax())
        return (float(points[choice, 0]), float(points[choice, 1])) if free[choice] else None

    def _is_free(self, x: float, y: float, keep_out: float) -> bool:
        column, row = self._bucket(x, y)
        for i in (column, column - 1, column + 1):
            for j in (row, row - 1, row + 1):
                for other_x, other_y, other in self._buckets.get((i, j), ()):
                    dx, dy, separation = x - other_x, y - other_y, keep_out + other
                    if dx * dx + dy * dy < separation * separation:
                        return False
        return True

    def _bucket(self, x: float, y: float) -> tuple[int, int]:
        return math.floor(x / self._side), math.floor(y / self._side)


def _draw_walls(spec: WorldSpec, rng: np.random.Generator) -> NDArray[np.float64]:
    """(S, 4) centre lines; every opening is uniform among the places that leave 0.3 m of wall on both sides."""
    width, height = spec.half_width, spec.half_height
    if spec.kind == "two-room":
        return np.array([(x0, 0.0, x1, 0.0) for x0, x1 in _pieces(-width, width, TWO_ROOM_OPENING, rng)])
    walls = [(x0, 0.0, x1, 0.0) for end in (-width, width) for x0, x1 in _pieces(0.0, end, FOUR_ROOM_OPENING, rng)]
    walls += [(0.0, y0, 0.0, y1) for end in (-height, height) for y0, y1 in _pieces(0.0, end, FOUR_ROOM_OPENING, rng)]
    return np.array(walls)


def _pieces(begin: float, end: float, opening: float, rng: np.random.Generator) -> list[tuple[float, float]]:
    length, direction = abs(end - begin), math.copysign(1.0, end - begin)
    first = MIN_WALL_PIECE + (length - opening - 2.0 * MIN_WALL_PIECE) * rng.random()
    return [(begin, begin + direction * first), (begin + direction * (first + opening), end)]


def _draw_room_points(spec: WorldSpec, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Start (2,) and goal (2,), each uniform in its room less the keep-outs; the rooms are never the same."""
    rooms = 2 if spec.kind == "two-room" else 4
    start_room = _random_index(rng, rooms)
    goal_room = (start_room + 1 + _random_index(rng, rooms - 1)) % rooms
    from_wall = 0.5 * WALL_THICKNESS + START_KEEP_OUT
    points = []
    for room, keep_out in ((start_room, START_KEEP_OUT), (goal_room, GOAL_KEEP_OUT)):
        u, v = rng.random(2)
        inner_x, inner_y = spec.half_width - keep_out, spec.half_height - keep_out
        y = math.copysign(from_wall + v * (inner_y - from_wall), 1 if room % 2 else -1)
        if rooms == 2:
            x = inner_x * (2.0 * u - 1.0)
        else:
            x = math.copysign(from_wall + u * (inner_x - from_wall), 1 if room // 2 else -1)
        points.append(np.array([x, y]))
    return points[0], points[1]


def _random_index(rng: np.random.Generator, count: int) -> int:
    # Generator.random keeps its stream over numpy versions better than integers and choice do
    return int(rng.random() * count)


def _draw_map_points(
    spec: WorldSpec, base_map: OccupancyMap, robot_radius: float, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Start (2,) and goal (2,) in one connected region of a map, at least their keep-outs apart."""
    region, roomy, narrow = _map_regions(base_map, robot_radius)
    if len(narrow) == 0:
        raise WorldError(
            f"world {spec}: no place is free for a robot of radius {robot_radius} m (0 tries); use another map or robot"
        )
    columns = base_map.occupied.shape[1]
    starts = roomy if len(roomy) else narrow
    start_pixel = int(starts[_random_index(rng, len(starts))])
    separation = START_KEEP_OUT + GOAL_KEEP_OUT

    def suits(pixels: NDArray[np.intp]) -> NDArray[np.bool_]:
        dx = (pixels % columns - start_pixel % columns) * base_map.resolution
        dy = (pixels // columns - start_pixel // columns) * base_map.resolution
        far = dx * dx + dy * dy >= (separation + 2.0 * base_map.resolution) ** 2
        return far & (region.reshape(-1)[pixels] == region.reshape(-1)[start_pixel])

    for pool in (roomy, narrow):
        if len(pool) == 0:
            continue
        goals = pool[(rng.random(_MANY) * len(pool)).astype(np.intp)]
        goals = goals[suits(goals)]
        if len(goals) == 0:
            goals = pool[suits(pool)]
        if len(goals):
            goal_pixel = int(goals[_random_index(rng, len(goals))])
            return _point_in(base_map, start_pixel, rng), _point_in(base_map, goal_pixel, rng)
    return None


def _point_in(base_map: OccupancyMap, pixel: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """A random point of a pixel where it has no less clearance (up to 0.4 m) than the centre has; else the centre."""
    row, col = divmod(pixel, base_map.occupied.shape[1])
    center = np.array(base_map.origin) + (np.array([col, row]) + 0.5) * base_map.resolution
    point = center + base_map.resolution * (rng.random(2) - 0.5)
    needed = min(float(base_map.clearance[row, col]), START_KEEP_OUT)
    return point if base_map.clearance_at(point) >= needed else center


@lru_cache(maxsize=8)
def _map_regions(
    base_map: OccupancyMap, robot_radius: float
) -> tuple[NDArray[np.int32], NDArray[np.intp], NDArray[np.intp]]:
    """Connected regions (rows, cols) of a map, 0 = too narrow, and flat pixels with 0.4 m and with robot_radius."""
    free = ~base_map.occupied & (base_map.clearance >= robot_radius)
    region = cv2.connectedComponents(free.view(np.uint8), connectivity=4, ltype=cv2.CV_32S)[1]
    roomy = np.flatnonzero(free & (base_map.clearance >= max(robot_radius, START_KEEP_OUT)))
    return region.astype(np.int32), roomy, np.flatnonzero(free)
