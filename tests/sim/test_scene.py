from __future__ import annotations

import cv2
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scenery import layout_of

from hiernav.nav.occupancy import OccupancyMap, draw_boxes, empty_map
from hiernav.sim.layout import GREMLIN_HALF_SIZE, Layout, parse_world
from hiernav.sim.robots import ROBOTS, get_robot
from hiernav.sim.scene import BRICK_LENGTH, ObstaclePool, SceneSpec, boxes_of, brick_poses, build_model, scene_for
from hiernav.sim.worlds import sample_layout

FIELD = (2.0, 2.0)


def arranged(layout: Layout, scene: SceneSpec) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = build_model(get_robot("point"), scene)
    data = mujoco.MjData(model)
    ObstaclePool(scene).arrange(layout, data.mocap_pos, data.mocap_quat)
    mujoco.mj_forward(model, data)
    return model, data


def covered(model: mujoco.MjModel, data: mujoco.MjData, points: np.ndarray) -> np.ndarray:
    """Which of the points (..., 2), 5 cm above the floor, lie inside an obstacle of the scene."""
    inside = np.zeros(points.shape[:-1], bool)
    points = np.concatenate([points, np.full((*points.shape[:-1], 1), 0.05)], axis=-1)
    for i in range(model.ngeom):
        if model.geom(i).name.split("_")[0] in ("pillar", "gremlin", "brick", "map"):
            local = (points - data.geom_xpos[i]) @ data.geom_xmat[i].reshape(3, 3)
            size = model.geom_size[i]
            if model.geom_type[i] == mujoco.mjtGeom.mjGEOM_CYLINDER:
                inside |= (np.hypot(local[..., 0], local[..., 1]) <= size[0]) & (np.abs(local[..., 2]) <= size[1])
            else:
                inside |= (np.abs(local) <= size).all(axis=-1)
    return inside


@pytest.mark.parametrize("world", ["pillar(2,2,10)", "pillar(2,3,7)", "two-room", "four-room", "four-room(3,2)"])
@pytest.mark.parametrize("seed", range(3))
def test_what_stands_in_the_scene_is_what_the_map_shows(world, seed):
    spec = parse_world(world)
    layout = sample_layout(spec, seed)
    occupancy = layout.occupancy(0.0)
    assert_array_equal(covered(*arranged(layout, scene_for([spec])), occupancy.pixel_centers()), occupancy.occupied)


def test_gremlins_lie_within_what_the_map_shows():
    spec = parse_world("gremlin")
    layout = sample_layout(spec, 0)
    occupancy = layout.occupancy(0.0)
    standing = covered(*arranged(layout, scene_for([spec])), occupancy.pixel_centers())
    assert not (standing & ~occupancy.occupied).any()
    assert standing.sum() * 0.05**2 == pytest.approx(10 * (2 * GREMLIN_HALF_SIZE) ** 2, rel=0.3)


@pytest.mark.parametrize("world", ["pillar(3,3,25)", "gremlin(2,2,4)", "two-room(3,3)", "four-room", "four-room(4,2)"])
def test_scene_of_a_world_has_room_for_all_its_layouts(world):
    spec = parse_world(world)
    pool = ObstaclePool(scene_for([parse_world("pillar(1,1,1)"), spec]))
    for seed in range(20):
        pool.check(sample_layout(spec, seed))


def test_scene_of_several_worlds_has_the_most_that_any_of_them_needs():
    scene = scene_for([parse_world(text) for text in ("pillar(2,2,10)", "pillar(7,6,3)", "gremlin(2,2,5)")])
    assert scene == SceneSpec(pillars=10, gremlins=5, floor_half_size=7.0)


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS.keys())
def test_obstacles_that_are_not_needed_change_nothing(robot):
    ends = []
    for scene in (SceneSpec(pillars=1), SceneSpec(pillars=8, gremlins=7, bricks=20)):
        model = build_model(robot, scene)
        data = mujoco.MjData(model)
        layout = layout_of(pillars=[[0.5, 0.1]])
        ObstaclePool(scene).arrange(layout, data.mocap_pos, data.mocap_quat)
        rng = np.random.default_rng(0)
        for _ in range(30):
            data.ctrl[:] = rng.uniform(-1, 1, model.nu)
            mujoco.mj_step(model, data, nstep=robot.substeps)
        ends.append(data.qpos.copy())
    assert_array_equal(*ends)


def test_obstacles_touch_neither_the_floor_nor_each_other():
    layout = layout_of(
        start=(-1.5, -1.5, 0.0),
        pillars=[[0.0, 0.0], [0.1, 0.0]],
        gremlins=[[0.0, 0.1]],
        walls=[[-1.0, 0.0, 1.0, 0.0]],
    )
    model, data = arranged(layout, SceneSpec(pillars=3, gremlins=2, bricks=8))
    robot = model.body("robot").id
    assert all(robot in model.geom_bodyid[contact.geom] for contact in data.contact)


def test_a_layout_replaces_all_that_stood_there_before():
    scene = SceneSpec(pillars=2, gremlins=2, bricks=7)
    model = build_model(get_robot("point"), scene)
    used, fresh = mujoco.MjData(model), mujoco.MjData(model)
    pool = ObstaclePool(scene)
    full = layout_of(pillars=[[0, 1], [1, 0]], gremlins=[[1, 1], [0.5, 1]], walls=[[0, -1, 0, 1]])
    small = layout_of(pillars=[[0, 1]], walls=[[-1, 0, 0, 0]])
    pool.arrange(full, used.mocap_pos, used.mocap_quat)
    for data in (used, fresh):
        pool.arrange(small, data.mocap_pos, data.mocap_quat)
    assert_array_equal(used.mocap_pos, fresh.mocap_pos)
    assert_array_equal(used.mocap_quat, fresh.mocap_quat)


@pytest.mark.parametrize(
    ("layout", "message"),
    [
        (layout_of(pillars=np.zeros((3, 2))), "needs 3 pillars, the scene has 2"),
        (layout_of(gremlins=np.zeros((2, 2))), "needs 2 gremlins, the scene has 1"),
        (layout_of(walls=[[-2, 0, 2, 0]]), "needs 14 bricks, the scene has 4"),
        (layout_of(base_map=OccupancyMap(np.ones((2, 2), bool))), "has a map, the scene was built without one"),
    ],
)
def test_layout_that_does_not_fit_is_refused(layout, message):
    with pytest.raises(ValueError, match=message):
        ObstaclePool(SceneSpec(pillars=2, gremlins=1, bricks=4)).check(layout)


@given(
    low=st.floats(-2, 1.7),
    length=st.floats(BRICK_LENGTH, 4.0),
    offset=st.floats(-2, 2),
    along_y=st.booleans(),
    reverse=st.booleans(),
)
def test_bricks_make_a_wall_of_exactly_its_length(low, length, offset, along_y, reverse):
    high = low + length
    ends = (high, low) if reverse else (low, high)
    wall = [offset, ends[0], offset, ends[1]] if along_y else [ends[0], offset, ends[1], offset]
    bricks = brick_poses(np.array([wall]), FIELD)
    along, across = bricks[:, int(along_y)], bricks[:, 1 - int(along_y)]
    assert_allclose(across, offset)
    assert_allclose(bricks[:, 2], np.pi / 2 if along_y else 0.0)
    assert_allclose([along.min() - BRICK_LENGTH / 2, along.max() + BRICK_LENGTH / 2], [low, high], atol=1e-9)
    assert (np.diff(along) <= BRICK_LENGTH + 1e-9).all()


@pytest.mark.parametrize(
    ("wall", "covers"),
    [
        ((1.9, 0.0, 2.0, 0.0), (1.9, 2.2)),
        ((-1.9, 0.0, -2.0, 0.0), (-2.2, -1.9)),
        ((0.0, 0.0, 0.2, 0.0), (-0.1, 0.2)),
        ((-0.2, 0.0, 0.0, 0.0), (-0.2, 0.1)),
    ],
)
def test_a_wall_shorter_than_a_brick_leaves_its_opening_open(wall, covers):
    ((center, _, _),) = brick_poses(np.array([wall]), FIELD)
    assert_allclose([center - BRICK_LENGTH / 2, center + BRICK_LENGTH / 2], covers)


def test_walls_that_continue_one_another_share_bricks():
    joined = brick_poses(np.array([[0.0, 0.0, 0.2, 0.0], [0.0, 0.0, -0.1, 0.0]]), FIELD)
    assert_allclose(joined, [[0.05, 0.0, 0.0]], atol=1e-12)


def test_a_slanted_wall_is_refused():
    with pytest.raises(ValueError, match="not parallel to an axis"):
        brick_poses(np.array([[0.0, 0.0, 1.0, 0.5]]), FIELD)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("density", [0.1, 0.6, 1.0])
def test_boxes_of_a_map_cover_its_occupied_pixels_once(seed, density):
    rng = np.random.default_rng(seed)
    occupied = rng.random((17, 23)) < density
    boxes = np.array(boxes_of(OccupancyMap(occupied, 0.1, (-1.0, 0.5)))).reshape(-1, 4)
    redrawn = np.zeros_like(occupied)
    draw_boxes(redrawn, (-1.0, 0.5), 0.1, boxes[:, :2], boxes[:, 2:])
    assert_array_equal(redrawn, occupied)
    assert 4 * boxes[:, 2:].prod(axis=1).sum() == pytest.approx(occupied.sum() * 0.01)


def test_a_rectangle_on_a_map_is_one_box():
    occupancy = empty_map(FIELD)
    occupancy.occupied[10:14, 20:50] = True
    assert_allclose(boxes_of(occupancy), [(-0.25, -1.4, 0.75, 0.1)], atol=1e-12)


@pytest.fixture
def map_world(tmp_path):
    """A 2 m by 1.5 m room off the origin with a wall in it, as a map_server file."""
    picture = np.full((30, 40), 254, np.uint8)
    picture[12:15, :25] = 0
    cv2.imwrite(str(tmp_path / "room.png"), picture)
    text = "image: room.png\nresolution: 0.05\norigin: [6, -1, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.2\n"
    (tmp_path / "room.yaml").write_text(text)
    return parse_world(str(tmp_path / "room.yaml"))


def test_walls_of_a_map_file_stand_in_its_scene(map_world):
    scene = scene_for([map_world, map_world])
    layout = sample_layout(map_world, 0)
    occupancy = layout.occupancy(0.0)
    assert occupancy.occupied.any() and scene.floor_half_size >= 8.0
    assert_array_equal(covered(*arranged(layout, scene), occupancy.pixel_centers()), occupancy.occupied)


def test_a_map_file_shares_its_scene_with_no_other_world(map_world):
    with pytest.raises(ValueError, match="must be the only world of its scene, got map.*, two-room"):
        scene_for([map_world, parse_world("two-room")])


def test_no_world_makes_no_scene():
    with pytest.raises(ValueError, match="no world given"):
        scene_for([])
