"""What a world is made of: its specification, and one sampled layout with its map and what the lidar sees."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hiernav.nav.lidar import PILLAR_RADIUS
from hiernav.nav.mapfile import load_map
from hiernav.nav.occupancy import OccupancyMap, draw_boxes, draw_discs, empty_map

PILLAR_HALF_HEIGHT = 0.5
GREMLIN_HALF_SIZE = 0.1
GREMLIN_ORBIT = 0.3
WALL_THICKNESS = 0.1
GREMLIN_DISC_RADIUS = GREMLIN_HALF_SIZE * math.sqrt(2.0)  # a gremlin's box in any orientation

LIDAR_SPACING = 0.1  # [m] between the points that stand for a wall
MAX_HALF_SIZE = 400.0  # [m], the largest field whose map OccupancyMap accepts, rounded
MAX_OBSTACLES = 2000
MAP_STEPS_PER_METRE = 300.0


@dataclass(frozen=True)
class Kind:
    """What a kind of generated worlds has in common; `hiernav.sim.worlds` draws them.

    steps_per_metre: control steps of an episode per metre of the longer half extent.
    least: smallest half extents W, H [m].
    arguments: of its text, "W,H,N" where it has as many obstacles as one says.
    default: W, H, N where its text has no arguments; None if it must have some.
    """

    steps_per_metre: float
    least: tuple[float, float]
    arguments: str
    default: tuple[float, float, int] | None = None


KINDS = {
    "pillar": Kind(150.0, (0.5, 0.5), "W,H,N"),
    "gremlin": Kind(150.0, (0.5, 0.5), "W,H,N", (2.0, 2.0, 10)),
    "two-room": Kind(300.0, (0.8, 0.9), "W,H", (2.0, 2.0, 0)),
    "four-room": Kind(300.0, (1.4, 1.4), "W,H", (2.0, 2.0, 0)),
}
_TEXTS = [([name] if kind.default else []) + [f"{name}({kind.arguments})"] for name, kind in KINDS.items()]
_ACCEPTED = f"accepted are {', '.join(sum(_TEXTS, []))}, map(FILE.yaml) and FILE.yaml"


@dataclass(frozen=True)
class WorldSpec:
    """One kind of world (paper Sec. V-A). str() gives the text that parse_world reads.

    kind: "pillar", "gremlin", "two-room", "four-room" or "map".
    half_width, half_height: half extents W, H of the field [m].
    num_obstacles: pillars or gremlins; 0 for rooms and maps.
    max_steps: control steps after which an episode is truncated.
    map_path: the map_server YAML file, for kind "map" only.
    """

    kind: str
    half_width: float
    half_height: float
    num_obstacles: int
    max_steps: int
    map_path: str | None = None

    def __str__(self) -> str:
        if self.kind == "map":
            return f"map({self.map_path})"
        kind, sizes = KINDS[self.kind], (self.half_width, self.half_height, self.num_obstacles)
        if sizes == kind.default:
            return self.kind
        given = sizes[: len(kind.arguments.split(","))]
        numbers = (repr(float(size)).removesuffix(".0") for size in given)
        return f"{self.kind}({','.join(numbers)})"


@dataclass(frozen=True, eq=False)
class Layout:
    """One world as sampled from one seed, world frame, SI units.

    pillars (P, 2) centres; gremlins (G, 2) centres of their circles; walls (S, 4) x0, y0, x1, y1 of the centre lines of
    0.1 m thick walls; start (3,) pose [x, y, yaw]; goal (2,); base_map for kind "map"; redraws: how many layouts of
    this seed were drawn before and had no path from start to goal.
    """

    spec: WorldSpec
    seed: int
    pillars: NDArray[np.float64]
    gremlins: NDArray[np.float64]
    walls: NDArray[np.float64]
    start: NDArray[np.float64]
    goal: NDArray[np.float64]
    base_map: OccupancyMap | None = None
    redraws: int = 0

    @property
    def half_size(self) -> tuple[float, float]:
        """(W, H) [m]."""
        return self.spec.half_width, self.spec.half_height

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """(xmin, xmax, ymin, ymax) of the field [m]: centred on the origin, for kind "map" the map's."""
        if self.base_map is not None:
            return self.base_map.extent
        width, height = self.half_size
        return -width, width, -height, height

    def in_field(self, positions: ArrayLike) -> NDArray[np.bool_]:
        """Positions (N, 2) [m] -> (N,) bool; the border belongs to the field, NaN does not."""
        return inside(np.asarray(positions, dtype=np.float64), np.array(self.extent))

    def gremlin_positions(self, time: float) -> NDArray[np.float64]:
        """(G, 2) [m] at `time` [s]: all gremlins run on their circles at 1 rad/s and in phase."""
        return self.gremlins + GREMLIN_ORBIT * np.array([math.cos(time), math.sin(time)])

    def obstacle_discs(self, time: float) -> NDArray[np.float64]:
        """(K, 3) centre and radius [m], what the lidar sees at `time` [s]; K does not change with time.

        Pillars and gremlins: one each. Walls: points at most 0.1 m apart along the centre line, both ends included, as
        thick as the wall. Map files: occupied pixels with a free neighbour, one in each 0.1 m square.
        """
        if len(self.gremlins) == 0:
            return self._static_discs
        return np.concatenate((self._static_discs, _discs(self.gremlin_positions(time), GREMLIN_HALF_SIZE)))

    def occupancy(self, time: float) -> OccupancyMap:
        """The map at `time` [s]: pillars as discs, gremlins as discs around their boxes, walls as boxes.

        Worlds in which nothing moves give the same object each time, so that its clearance is computed once.
        """
        if len(self.gremlins) == 0:
            return self._static_map
        static = self._static_map
        occupied = static.occupied.copy()
        positions = self.gremlin_positions(time)
        draw_discs(occupied, static.origin, static.resolution, positions, GREMLIN_DISC_RADIUS)
        return OccupancyMap(occupied, static.resolution, static.origin)

    @cached_property
    def _static_discs(self) -> NDArray[np.float64]:
        parts = [_discs(self.pillars, PILLAR_RADIUS)]
        parts += [_discs(_points_along(wall), 0.5 * WALL_THICKNESS) for wall in self.walls]
        if self.base_map is not None:
            parts.append(_discs(_surface_points(self.base_map), 0.5 * self.base_map.resolution))
        return np.concatenate(parts)

    @cached_property
    def _static_map(self) -> OccupancyMap:
        if self.base_map is not None:
            return self.base_map
        field = empty_map(self.half_size)
        draw_discs(field.occupied, field.origin, field.resolution, self.pillars, PILLAR_RADIUS)
        centers, halves = wall_boxes(self.walls)
        draw_boxes(field.occupied, field.origin, field.resolution, centers, halves)
        return field


def inside(positions: NDArray[np.float64], extent: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether positions (..., 2) [m] lie in extents (..., 4), edges included, NaN does not: (...) bool."""
    x, y = positions[..., 0], positions[..., 1]
    return (x >= extent[..., 0]) & (x <= extent[..., 1]) & (y >= extent[..., 2]) & (y <= extent[..., 3])


def parse_world(text: str) -> WorldSpec:
    """The world that a text names: "pillar(2,2,10)", "gremlin", "two-room(3,3)", "map(hall.yaml)" or "hall.yaml".

    A map file is read here, for its size. Raises ValueError in one line that names what is wrong and what is accepted.
    """
    text = text.strip()
    match = re.fullmatch(r"([a-z-]+)\s*(?:\((.*)\))?", text)
    if match and match[1] == "map" and match[2]:
        return _map_spec(match[2].strip())
    if text.endswith((".yaml", ".yml")):
        return _map_spec(text)
    if match is None or match[1] not in KINDS:
        raise ValueError(f"world {text!r}: unknown; {_ACCEPTED}")
    kind = KINDS[match[1]]
    sizes = kind.default
    if match[2] is not None:
        sizes = _parse_sizes(text, match[1], match[2])
    if sizes is None:
        raise ValueError(f"world {text!r}: the sizes are missing; {_ACCEPTED}")
    width, height, count = sizes
    for name, value, least in zip(("W", "H"), (width, height), kind.least, strict=True):
        if not least <= value <= MAX_HALF_SIZE:
            raise ValueError(
                f"world {text!r}: half extent {name} = {value:g} m, it must be between {least} and {MAX_HALF_SIZE} m"
            )
    if not 0 <= count <= MAX_OBSTACLES:
        raise ValueError(f"world {text!r}: N = {count} obstacles, it must be between 0 and {MAX_OBSTACLES}")
    return WorldSpec(match[1], width, height, count, _max_steps(kind.steps_per_metre, width, height))


def wall_boxes(walls: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Walls (S, 4) along x or y -> centres (S, 2) and half extents (S, 2) [m] of their boxes, as long as the lines."""
    centers = 0.5 * (walls[:, :2] + walls[:, 2:])
    halves = np.maximum(0.5 * np.abs(walls[:, 2:] - walls[:, :2]), 0.5 * WALL_THICKNESS)
    return centers, halves


def _parse_sizes(text: str, kind: str, arguments: str) -> tuple[float, float, int]:
    fields, names = arguments.split(","), KINDS[kind].arguments
    wanted = len(names.split(","))
    if len(fields) != wanted:
        raise ValueError(f"world {text!r}: {len(fields)} arguments, {kind}({names}) takes {wanted}; {_ACCEPTED}")
    try:
        width, height = float(fields[0]), float(fields[1])
        count = int(fields[2]) if wanted == 3 else 0
    except ValueError as error:
        raise ValueError(f"world {text!r}: W and H must be numbers [m] and N a whole number; {_ACCEPTED}") from error
    return width, height, count


def _map_spec(path: str) -> WorldSpec:
    xmin, xmax, ymin, ymax = cached_map(path).extent
    width, height = 0.5 * (xmax - xmin), 0.5 * (ymax - ymin)
    return WorldSpec("map", width, height, 0, _max_steps(MAP_STEPS_PER_METRE, width, height), path)


def _max_steps(per_metre: float, width: float, height: float) -> int:
    return max(1, round(per_metre * max(width, height)))


def cached_map(path: str) -> OccupancyMap:
    """load_map, kept until the YAML file changes. Raises ValueError as load_map does."""
    try:
        status = Path(path).stat()
    except OSError as error:
        raise ValueError(f"world map({path}): the map file cannot be read ({error.strerror})") from error
    except ValueError as error:  # a path with a null character
        raise ValueError(f"world map({path!r}): the map file cannot be read ({error})") from error
    return _load_version(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=8)
def _load_version(path: str, mtime_ns: int, size: int) -> OccupancyMap:
    return load_map(path)


def _discs(centers: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    return np.column_stack((centers, np.full(len(centers), radius)))


def _points_along(wall: NDArray[np.float64]) -> NDArray[np.float64]:
    length = float(np.abs(wall[2:] - wall[:2]).max())
    count = math.ceil(length / LIDAR_SPACING - 1e-9) + 1
    return np.linspace(wall[:2], wall[2:], count)


@lru_cache(maxsize=8)
def _surface_points(occupancy: OccupancyMap) -> NDArray[np.float64]:
    """(K, 2) [m]: centres of the occupied pixels beside a free one, the first of each 0.1 m square."""
    free = np.pad(~occupancy.occupied, 1)
    beside_free = free[:-2, 1:-1] | free[2:, 1:-1] | free[1:-1, :-2] | free[1:-1, 2:]
    row, col = np.nonzero(occupancy.occupied & beside_free)
    pixels = max(1, round(LIDAR_SPACING / occupancy.resolution))
    square = (row // pixels) * (occupancy.occupied.shape[1] // pixels + 1) + col // pixels
    first = np.unique(square, return_index=True)[1]
    x = occupancy.origin[0] + (col[first] + 0.5) * occupancy.resolution
    y = occupancy.origin[1] + (row[first] + 0.5) * occupancy.resolution
    return np.stack((x, y), axis=-1)
