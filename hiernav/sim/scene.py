"""Scenes: one robot, a floor and a pool of obstacle bodies, compiled once and rearranged at every reset.

Every obstacle that a layout places is a mocap body with one geom. A reset moves bodies and recompiles nothing; bodies
that a layout does not need are parked far below the floor. Obstacles collide with the robot alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil

import mujoco
import numpy as np

from hiernav.nav.lidar import PILLAR_RADIUS
from hiernav.nav.occupancy import OccupancyMap
from hiernav.sim.layout import GREMLIN_HALF_SIZE, PILLAR_HALF_HEIGHT, WALL_THICKNESS, Layout, WorldSpec, cached_map
from hiernav.sim.robots import RobotSpec
from hiernav.sim.worlds import FOUR_ROOM_OPENING, TWO_ROOM_OPENING

FLOOR_HALF_SIZE = 5.0
WALL_HALF_HEIGHT = 0.5
BRICK_LENGTH = 0.3
CONTACT_SENSORS = ("contacts_all", "contacts_floor", "contacts_self")


@dataclass(frozen=True)
class SceneSpec:
    """How many obstacles of each kind a scene can show at once."""

    pillars: int = 0
    gremlins: int = 0
    bricks: int = 0
    """Pieces of wall, 0.3 m long and 0.1 m thick."""
    boxes: tuple[tuple[float, float, float, float], ...] = ()
    """Fixed boxes of a map file: x, y, half_x, half_y [m]."""
    floor_half_size: float = FLOOR_HALF_SIZE
    """Half side of the floor as it is drawn [m]; the robot never falls off its edge."""


def scene_for(specs: Sequence[WorldSpec]) -> SceneSpec:
    """The smallest scene that can show any layout of any of those worlds.

    Raises ValueError for map files beside other worlds, or two different ones: a map's boxes cannot be moved away.
    """
    if not specs:
        raise ValueError("scene_for: no world given, at least one is needed")
    maps = {spec.map_path for spec in specs if spec.kind == "map"}
    if len(maps) > 1 or (maps and any(spec.kind != "map" for spec in specs)):
        raise ValueError(
            f"scene_for: a map file must be the only world of its scene, got {', '.join(str(spec) for spec in specs)}"
        )
    reach = [max(spec.half_width, spec.half_height) for spec in specs]
    boxes: tuple[tuple[float, float, float, float], ...] = ()
    if maps:
        occupancy = cached_map(str(maps.pop()))
        boxes = boxes_of(occupancy)
        reach = [abs(edge) for edge in occupancy.extent]
    return SceneSpec(
        pillars=max(spec.num_obstacles if spec.kind == "pillar" else 0 for spec in specs),
        gremlins=max(spec.num_obstacles if spec.kind == "gremlin" else 0 for spec in specs),
        bricks=max(_most_bricks(spec) for spec in specs),
        boxes=boxes,
        floor_half_size=max(FLOOR_HALF_SIZE, *reach),
    )


def build_model(robot: RobotSpec, scene: SceneSpec) -> mujoco.MjModel:
    """Compile a robot, the floor, the obstacle pool and the sensors that count the robot's contacts.

    The mocap bodies come in the order pillars, gremlins, bricks, all parked. Each of `CONTACT_SENSORS` keeps its last
    `robot.substeps` readings, one control step, in `MjData.history`. A robot whose state diverges is left as it is
    rather than put back to its start, so that it can be reported.
    """
    spec = mujoco.MjSpec.from_file(str(robot.xml_path))
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    plane, cylinder, box = mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_BOX
    # contype 0 and conaffinity 1: met by the robot (1 and 1), ignored by each other
    static = {"condim": 6, "contype": 0, "conaffinity": 1}
    side = scene.floor_half_size
    spec.worldbody.add_geom(name="floor", type=plane, size=[side, side, 0.1], **static)
    for i, (x, y, half_x, half_y) in enumerate(scene.boxes):
        spec.worldbody.add_geom(
            name=f"map_{i}",
            type=box,
            pos=[x, y, WALL_HALF_HEIGHT],
            size=[half_x, half_y, WALL_HALF_HEIGHT],
            **static,
        )
    pool = (
        ("pillar", scene.pillars, cylinder, [PILLAR_RADIUS, PILLAR_HALF_HEIGHT, 0.0]),
        ("gremlin", scene.gremlins, box, [GREMLIN_HALF_SIZE] * 3),
        ("brick", scene.bricks, box, [BRICK_LENGTH / 2, WALL_THICKNESS / 2, WALL_HALF_HEIGHT]),
    )
    for kind, count, shape, size in pool:
        for i in range(count):
            body = spec.worldbody.add_body(name=f"{kind}_{i}", mocap=True)
            body.add_geom(name=f"{kind}_{i}", type=shape, size=size, **static)
    for i, body in enumerate(body for body in spec.worldbody.bodies if body.mocap):
        body.pos = parking_place(i)
    _add_contact_sensors(spec, robot.substeps)
    return spec.compile()


class ObstaclePool:
    """Puts the obstacles of layouts into the mocap bodies of one scene."""

    def __init__(self, scene: SceneSpec) -> None:
        self._scene = scene
        total = scene.pillars + scene.gremlins + scene.bricks
        self._parked = np.array([parking_place(i) for i in range(total)]).reshape(total, 3)
        self._gremlins = scene.pillars
        self._bricks = scene.pillars + scene.gremlins

    def check(self, layout: Layout) -> None:
        """ValueError if the scene has too few slots of a kind, or was built without the layout's map."""
        scene = self._scene
        for kind, needed, slots in (
            ("pillars", len(layout.pillars), scene.pillars),
            ("gremlins", len(layout.gremlins), scene.gremlins),
            ("bricks", len(brick_poses(layout.walls, layout.half_size)), scene.bricks),
        ):
            if needed > slots:
                raise ValueError(f"layout of {layout.spec} needs {needed} {kind}, the scene has {slots}")
        if layout.base_map is not None and layout.base_map.occupied.any() and not scene.boxes:
            raise ValueError(f"layout of {layout.spec} has a map, the scene was built without one")

    def arrange(self, layout: Layout, mocap_pos: np.ndarray, mocap_quat: np.ndarray) -> None:
        """Write the poses of all bodies at time 0 into `mocap_pos` (B, 3) and `mocap_quat` (B, 4) in place."""
        mocap_pos[:] = self._parked
        mocap_quat[:] = (1.0, 0.0, 0.0, 0.0)
        mocap_pos[: len(layout.pillars), :2] = layout.pillars
        mocap_pos[: len(layout.pillars), 2] = PILLAR_HALF_HEIGHT
        gremlins = slice(self._gremlins, self._gremlins + len(layout.gremlins))
        mocap_pos[gremlins, 2] = GREMLIN_HALF_SIZE
        self.move_gremlins(layout, 0.0, mocap_pos)
        bricks = brick_poses(layout.walls, layout.half_size)
        slots = slice(self._bricks, self._bricks + len(bricks))
        mocap_pos[slots, :2] = bricks[:, :2]
        mocap_pos[slots, 2] = WALL_HALF_HEIGHT
        mocap_quat[slots, 0] = np.cos(bricks[:, 2] / 2)
        mocap_quat[slots, 3] = np.sin(bricks[:, 2] / 2)

    def move_gremlins(self, layout: Layout, time: float, mocap_pos: np.ndarray) -> None:
        """Write where the gremlins are at `time` [s] into `mocap_pos` (B, 3) in place."""
        mocap_pos[self._gremlins : self._gremlins + len(layout.gremlins), :2] = layout.gremlin_positions(time)


def parking_place(slot: int) -> list[float]:
    """Where the body of a slot waits, world frame [m].

    Deep below the floor, and spread along x: bodies stacked in one place would all be candidates for contact with each
    other in MuJoCo's sweep along one axis.
    """
    return [100.0 + 2.0 * slot, 0.0, -10.0]


def brick_poses(walls: np.ndarray, half_size: tuple[float, float]) -> np.ndarray:
    """Cover walls with bricks that overlap so that both ends of each wall are exact.

    Walls that continue one another are joined first. A wall shorter than a brick cannot have two exact ends: the brick
    sticks out past the end at the border, where no robot goes, or else past the end nearer to the centre, into the wall
    that crosses there, so that the side of the opening is exact.

    Args:
        walls: (S, 4) axis-aligned centre lines x0, y0, x1, y1, world frame [m].
        half_size: (W, H) half extents of the field [m].

    Returns:
        (B, 3) centre x, y [m] and angle, 0 or pi/2 [rad], of each brick.

    Raises:
        ValueError: a wall is not parallel to an axis.
    """
    poses = []
    for axis, offset, low, high in _joined(np.asarray(walls, float).reshape(-1, 4)):
        count = ceil((high - low) / BRICK_LENGTH - 1e-9)
        if count > 1:
            centers = np.linspace(low + BRICK_LENGTH / 2, high - BRICK_LENGTH / 2, count)
        else:
            border = half_size[axis] - 1e-6
            keeps_low = high >= border or (low > -border and low + high <= 0.0)
            centers = np.array([low + BRICK_LENGTH / 2 if keeps_low else high - BRICK_LENGTH / 2])
        for center in centers:
            poses.append((offset, center, np.pi / 2) if axis else (center, offset, 0.0))
    return np.array(poses).reshape(-1, 3)


def boxes_of(occupancy: OccupancyMap) -> tuple[tuple[float, float, float, float], ...]:
    """Boxes x, y, half_x, half_y [m] that cover exactly the occupied pixels: runs of a row, joined over equal rows."""
    res, (x0, y0) = occupancy.resolution, occupancy.origin
    padded = np.pad(occupancy.occupied, ((0, 1), (1, 1))).astype(np.int8)
    open_runs: dict[tuple[int, int], int] = {}
    boxes = []
    for row, steps in enumerate(np.diff(padded, axis=1)):
        runs = set(zip(np.flatnonzero(steps == 1).tolist(), np.flatnonzero(steps == -1).tolist(), strict=True))
        for run in [run for run in open_runs if run not in runs]:
            first = open_runs.pop(run)
            center = (x0 + res * (run[0] + run[1]) / 2, y0 + res * (first + row) / 2)
            boxes.append((*center, res * (run[1] - run[0]) / 2, res * (row - first) / 2))
        for run in sorted(runs):
            open_runs.setdefault(run, row)
    return tuple(boxes)


def _most_bricks(spec: WorldSpec) -> int:
    """Bricks that any layout of a world needs at most, wherever its openings are."""

    def line(length: float, pieces: int) -> int:
        return ceil(length / BRICK_LENGTH - 1e-9) + pieces - 1

    if spec.kind == "two-room":
        return line(2 * spec.half_width - TWO_ROOM_OPENING, 2)
    if spec.kind == "four-room":
        return sum(line(2 * (half - FOUR_ROOM_OPENING), 3) for half in (spec.half_width, spec.half_height))
    return 0


def _joined(walls: np.ndarray) -> list[tuple[int, float, float, float]]:
    """(S, 4) centre lines -> runs (axis, offset on the other axis, low, high) that touch no other run of their line."""
    runs = []
    for x0, y0, x1, y1 in walls:
        if y0 == y1:
            runs.append((0, float(y0), float(min(x0, x1)), float(max(x0, x1))))
        elif x0 == x1:
            runs.append((1, float(x0), float(min(y0, y1)), float(max(y0, y1))))
        else:
            raise ValueError(f"wall ({x0}, {y0}) to ({x1}, {y1}) is not parallel to an axis")
    joined: list[tuple[int, float, float, float]] = []
    for axis, offset, low, high in sorted(runs):
        if joined and joined[-1][:2] == (axis, offset) and low <= joined[-1][3] + 1e-9:
            high = max(high, joined[-1][3])
            low = joined.pop()[2]
        joined.append((axis, offset, low, high))
    return joined


def _add_contact_sensors(spec: mujoco.MjSpec, samples: int) -> None:
    """Count the contacts of the robot's bodies with anything, with the floor, and among themselves."""
    body, geom, anything = mujoco.mjtObj.mjOBJ_XBODY, mujoco.mjtObj.mjOBJ_GEOM, mujoco.mjtObj.mjOBJ_UNKNOWN
    others = ((anything, ""), (geom, "floor"), (body, "robot"))
    for name, (kind, other) in zip(CONTACT_SENSORS, others, strict=True):
        spec.add_sensor(
            name=name,
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=body,
            objname="robot",
            reftype=kind,
            refname=other,
            intprm=[1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND), 0, 1],
            nsample=samples,
        )
