from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scenery import layout_of

from hiernav.sim.batch import BatchSim
from hiernav.sim.layout import parse_world
from hiernav.sim.robots import ROBOTS, get_robot
from hiernav.sim.scene import SceneSpec, boxes_of, scene_for
from hiernav.sim.worlds import sample_layout

every_robot = pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS.keys())
OBSTACLES = ("pillar", "gremlin", "brick", "map")


def published(sim: BatchSim) -> dict[str, np.ndarray]:
    names = ("pose", "velocity", "upright", "collided", "time", "finite")
    return {name: getattr(sim, name) for name in names} | sim.sensors


def assert_same(left: dict[str, np.ndarray], right: dict[str, np.ndarray], rows: object = slice(None)) -> None:
    assert left.keys() == right.keys()
    for name in left:
        assert_array_equal(left[name][rows], right[name][rows], err_msg=name)


def actions_for(sim: BatchSim, steps: int, seed: int = 0) -> np.ndarray:
    """(steps, N, A) that change slowly enough to get somewhere."""
    rng = np.random.default_rng(seed)
    held = rng.uniform(-1, 1, (steps // 5 + 1, sim.num_envs, sim.robot.action_dim))
    return np.repeat(held, 5, axis=0)[:steps]


def ring_of_pillars(radius: float, count: int = 6) -> np.ndarray:
    angles = np.arange(count) * 2 * np.pi / count
    return radius * np.column_stack([np.cos(angles), np.sin(angles)])


def contacts_in_each_substep(sim: BatchSim, row: int, action: np.ndarray) -> tuple[list[bool], int]:
    """Step a copy of one row by single physics steps: whether it touched an obstacle in each, and its self contacts."""
    model, data = sim.model, mujoco.MjData(sim.model)
    mujoco.mj_copyData(data, model, sim.datas[row])
    data.ctrl[:] = np.clip(action, -1, 1)
    obstacle = np.array([model.geom(i).name.startswith(OBSTACLES) for i in range(model.ngeom)])
    floor = model.geom("floor").id
    touched, own = [], 0
    for _ in range(sim.robot.substeps):
        mujoco.mj_step(model, data)
        touched.append(bool(obstacle[data.contact.geom].any()))
        own += sum(not obstacle[contact.geom].any() and floor not in contact.geom for contact in data.contact)
    return touched, own


@every_robot
def test_collision_is_reported_if_any_substep_has_a_contact(robot):
    sim = BatchSim(robot, 2, SceneSpec(pillars=6))
    sim.reset(np.arange(2), [layout_of(start=(0, 0, yaw), pillars=ring_of_pillars(0.55)) for yaw in (0.0, 2.0)])
    seen = {True: 0, False: 0}
    for actions in actions_for(sim, 80):
        touched = [contacts_in_each_substep(sim, row, actions[row])[0] for row in range(2)]
        sim.step(actions)
        assert sim.collided.tolist() == [any(substeps) for substeps in touched]
        for collided in sim.collided.tolist():
            seen[collided] += 1
    assert min(seen.values()) > 0


def test_contact_in_a_middle_substep_alone_is_reported():
    """The point robot slides along a pillar that it touches for a few milliseconds."""
    sim = BatchSim(get_robot("point"), 1, SceneSpec(pillars=1))
    brief = 0
    for offset in np.linspace(0.28, 0.2999, 12):
        sim.reset([0], [layout_of(pillars=[[0.5, offset]])])
        for _ in range(60):
            touched, _ = contacts_in_each_substep(sim, 0, np.array([1.0, 0.0]))
            sim.step(np.array([[1.0, 0.0]]))
            assert sim.collided[0] == any(touched)
            brief += any(touched) and not touched[0] and not touched[-1]
    assert brief > 0


def test_touching_the_floor_or_oneself_is_no_collision():
    sim = BatchSim(get_robot("doggo"), 1, SceneSpec(pillars=3))
    sim.reset([0], [layout_of()])
    self_contacts = 0
    for actions in actions_for(sim, 60):
        self_contacts += contacts_in_each_substep(sim, 0, actions[0])[1]
        sim.step(actions)
        assert not sim.collided[0]
    assert self_contacts > 0


@every_robot
@pytest.mark.parametrize(
    "obstacle",
    [
        {"pillars": [[0.2, 0.0]]},
        {"gremlins": [[-0.2, 0.0]]},
        {"walls": [[0.1, -1.0, 0.1, 1.0]]},
    ],
    ids=["pillar", "gremlin", "wall"],
)
def test_robot_inside_an_obstacle_collides_and_beside_it_does_not(robot, obstacle):
    sim = BatchSim(robot, 2, SceneSpec(pillars=1, gremlins=1, bricks=7))
    sim.reset([0, 1], [layout_of(**obstacle), layout_of(start=(-1.5, 0.0, 0.0), **obstacle)])
    assert not sim.collided.any()
    sim.step(np.zeros((2, robot.action_dim)))
    assert sim.collided.tolist() == [True, False]


def test_robot_collides_with_the_walls_of_a_map():
    occupied = np.zeros((40, 40), bool)
    occupied[:, 26:] = True
    layout = layout_of()
    base_map = type(layout.occupancy(0.0))(occupied, 0.05, (-1.0, -1.0))
    sim = BatchSim(get_robot("point"), 1, SceneSpec(boxes=boxes_of(base_map)))
    sim.reset([0], [layout_of(base_map=base_map)])
    for _ in range(100):
        sim.step(np.array([[1.0, 0.0]]))
        assert sim.pose[0, 0] < 0.3
        if sim.collided[0]:
            break
    # the box that shows the heading ends 0.15 m ahead
    assert sim.collided[0] and sim.pose[0, 0] == pytest.approx(0.15, abs=0.02)


@every_robot
def test_number_of_threads_changes_no_bit(robot):
    spec = parse_world("gremlin(2,2,5)")
    layouts = [sample_layout(spec, seed) for seed in range(5)]
    sims = [BatchSim(robot, 5, scene_for([spec]), threads) for threads in (1, 2, 3, 8)]
    for sim in sims:
        sim.reset(np.arange(5), layouts)
    for step, actions in enumerate(actions_for(sims[0], 20)):
        for sim in sims:
            if step == 10:
                sim.reset([3, 1], layouts[:2])
            sim.step(actions)
            assert_same(published(sim), published(sims[0]))
    for sim in sims:
        sim.close()


@every_robot
def test_a_row_moves_as_it_would_alone(robot):
    layouts = [layout_of(start=(0, 0, yaw), pillars=ring_of_pillars(0.6)) for yaw in (0.0, 1.0, 2.0)]
    together = BatchSim(robot, 3, SceneSpec(pillars=6))
    together.reset(np.arange(3), layouts)
    alone = BatchSim(robot, 1, SceneSpec(pillars=6))
    alone.reset([0], layouts[2:])
    for actions in actions_for(together, 20):
        together.step(actions)
        alone.step(actions[2:])
        assert_array_equal(alone.pose[0], together.pose[2])


@every_robot
def test_reset_of_some_rows_leaves_the_others_alone(robot):
    layouts = [layout_of(start=(0, 0, yaw), pillars=ring_of_pillars(0.6)) for yaw in (0.0, 1.0, 2.0)]
    sim, undisturbed = (BatchSim(robot, 3, SceneSpec(pillars=6)) for _ in range(2))
    for each in (sim, undisturbed):
        each.reset(np.arange(3), layouts)
    for step, actions in enumerate(actions_for(sim, 30)):
        for each in (sim, undisturbed):
            each.step(actions)
        if step % 7 == 3:
            before = published(sim)
            sim.reset([1], [layouts[0]])
            assert_same(published(sim), before, rows=[0, 2])
        assert_same(published(sim), published(undisturbed), rows=[0, 2])


@every_robot
def test_nothing_of_an_episode_survives_a_reset(robot):
    layout = layout_of(start=(0.3, -0.2, 1.0), pillars=ring_of_pillars(0.6), gremlins=[[1.0, 1.0]])
    scene = SceneSpec(pillars=6, gremlins=1, bricks=7)
    used, fresh = BatchSim(robot, 1, scene), BatchSim(robot, 1, scene)
    used.reset([0], [layout_of(walls=[[-1.0, 0.1, 1.0, 0.1]], gremlins=[[0.0, 0.0]])])
    actions = actions_for(used, 25)
    for action in actions:
        used.step(action)
    for sim in (used, fresh):
        sim.reset([0], [layout])
    assert_same(published(used), published(fresh))
    for action in actions:
        for sim in (used, fresh):
            sim.step(action)
        assert_same(published(used), published(fresh))


def test_first_sensor_reading_is_that_of_a_robot_at_rest():
    """Full throttle before the reset must not show in the accelerometer after it."""
    sim = BatchSim(get_robot("point"), 1, SceneSpec())
    for _ in range(5):
        sim.step(np.ones((1, 2)))
    assert np.abs(sim.sensors["accelerometer"][0, :2]).max() > 0.1
    sim.reset([0], [layout_of()])
    assert_allclose(sim.sensors["accelerometer"], [[0.0, 0.0, 9.81]], atol=1e-9)
    assert_allclose(sim.sensors["velocimeter"], 0.0)
    assert_allclose(sim.velocity, 0.0)
    assert sim.time[0] == 0.0


@every_robot
def test_published_arrays_are_never_written_again(robot):
    sim = BatchSim(robot, 2, SceneSpec(pillars=6))
    layout = layout_of(pillars=ring_of_pillars(0.55))
    sim.reset([0, 1], [layout, layout])
    kept = []
    for step, actions in enumerate(actions_for(sim, 20)):
        now = published(sim)
        kept.append((now, {name: value.copy() for name, value in now.items()}))
        sim.step(actions)
        if step % 5 == 4:
            sim.reset([step % 2], [layout])
    for arrays, copies in kept:
        assert_same(arrays, copies)


@every_robot
def test_robot_starts_where_the_layout_says(robot):
    sim = BatchSim(robot, 2, SceneSpec())
    starts = np.array([[0.5, -1.0, 3.0], [-1.2, 0.3, -2.0]])
    sim.reset([1, 0], [layout_of(start=start) for start in starts])
    assert_allclose(sim.pose[[1, 0]], starts, atol=1e-12)
    assert_allclose(sim.upright, 1.0)


@every_robot
def test_velocity_is_the_rate_of_the_position_in_the_world_frame(robot):
    sim = BatchSim(robot, 1, SceneSpec())
    sim.reset([0], [layout_of(start=(0, 0, 2.0))])
    for actions in actions_for(sim, 10):
        sim.step(actions)
    data = mujoco.MjData(sim.model)
    mujoco.mj_copyData(data, sim.model, sim.datas[0])
    before = sim.pose[0, :2]
    mujoco.mj_step(sim.model, data)
    after = robot.pose(data.qpos[None])[0, :2]
    # semi-implicit: the position moves with the velocity at the end of the step
    assert_allclose((after - before) / robot.timestep, robot.velocity(data.qvel[None])[0], atol=1e-9)
    assert np.abs(sim.velocity).max() > 0.01


@every_robot
def test_time_counts_control_periods_since_the_reset(robot):
    sim = BatchSim(robot, 2, SceneSpec())
    for _ in range(4):
        sim.step(np.zeros((2, robot.action_dim)))
    sim.reset([1], [layout_of()])
    sim.step(np.zeros((2, robot.action_dim)))
    assert_allclose(sim.time, [5 * robot.control_period, robot.control_period])


def test_gremlins_circle_with_the_time_of_their_row():
    sim = BatchSim(get_robot("car"), 2, SceneSpec(gremlins=3))
    layout = layout_of(start=(-1.5, -1.5, 0), gremlins=[[1.0, 1.0], [-1.0, 1.0], [1.0, -1.0]])
    sim.reset([0, 1], [layout, layout])
    assert_allclose(sim.datas[0].mocap_pos[:, :2], layout.gremlin_positions(0.0))
    for step in range(12):
        if step == 7:
            sim.reset([1], [layout])
        begin = sim.time
        sim.step(np.zeros((2, 2)))
        for row in range(2):
            assert_allclose(sim.datas[row].mocap_pos[:, :2], layout.gremlin_positions(begin[row]))
    assert begin[0] != begin[1]


def test_actions_beyond_the_limits_are_clipped():
    sims = [BatchSim(get_robot("doggo"), 1, SceneSpec()) for _ in range(2)]
    actions = 3 * actions_for(sims[0], 10)
    for action in actions:
        sims[0].step(action)
        sims[1].step(np.clip(action, -1, 1))
    assert_same(published(sims[0]), published(sims[1]))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_action_that_is_not_finite_is_refused_before_anything_moves(value):
    sim = BatchSim(get_robot("car"), 3, SceneSpec())
    actions = np.ones((3, 2))
    actions[1, 0] = value
    before = published(sim)
    with pytest.raises(ValueError, match="action of row 1 is not finite"):
        sim.step(actions)
    assert_same(published(sim), before)
    assert sim.datas[0].time == 0.0


def test_actions_of_the_wrong_shape_are_refused():
    sim = BatchSim(get_robot("car"), 3, SceneSpec())
    with pytest.raises(ValueError, match=r"shape \(3, 12\), it must be \(3, 2\)"):
        sim.step(np.zeros((3, 12)))


@every_robot
def test_diverged_row_is_reported_and_harms_no_other(robot):
    sim, healthy = (BatchSim(robot, 3, SceneSpec(pillars=6)) for _ in range(2))
    layout = layout_of(pillars=ring_of_pillars(0.6))
    for each in (sim, healthy):
        each.reset(np.arange(3), [layout] * 3)
    actions = actions_for(sim, 10)
    sim.datas[1].qvel[0] = np.inf
    for action in actions:
        for each in (sim, healthy):
            each.step(action)
        assert sim.finite.tolist() == [True, False, True]
        assert np.isnan(sim.pose[1]).all() and not sim.collided[1]
        assert_same(published(sim), published(healthy), rows=[0, 2])
    for each in (sim, healthy):
        each.reset([1], [layout])
        each.step(actions[0])
    assert_same(published(sim), published(healthy))


@pytest.mark.parametrize(
    ("rows", "message"),
    [([0, 0], "no row twice"), ([0, 2], "must lie in 0 to 1"), ([-1, 0], "must lie in 0 to 1"), ([0], "one each")],
)
def test_reset_of_impossible_rows_is_refused(rows, message):
    sim = BatchSim(get_robot("point"), 2, SceneSpec())
    with pytest.raises(ValueError, match=message):
        sim.reset(rows, [layout_of(), layout_of()])


def test_reset_that_cannot_place_all_changes_no_row():
    sim = BatchSim(get_robot("point"), 2, SceneSpec(pillars=1))
    sim.step(np.ones((2, 2)))
    before = published(sim)
    with pytest.raises(ValueError, match="needs 2 pillars, the scene has 1"):
        sim.reset([0, 1], [layout_of(), layout_of(pillars=[[1, 1], [0, 1]])])
    assert_same(published(sim), before)


@pytest.mark.parametrize("arguments", [{"num_envs": 0}, {"num_envs": 1, "threads": 0}])
def test_batch_needs_a_row_and_a_thread(arguments):
    with pytest.raises(ValueError, match="must be at least 1"):
        BatchSim(get_robot("point"), scene=SceneSpec(), **arguments)


def mirrored_doggos(pillars: np.ndarray, steps: int) -> Iterator[tuple[BatchSim, np.ndarray]]:
    """Step a doggo and its reflection in the plane y = 0; yields the batch and the order of the swapped legs."""
    legs = np.array([3, 2, 1, 0])
    swapped = np.concatenate([legs, 4 + legs, 8 + legs])
    sim = BatchSim(get_robot("doggo"), 2, SceneSpec(pillars=len(pillars)))
    sim.reset([0, 1], [layout_of((0, 0.1, 0.4), pillars), layout_of((0, -0.1, -0.4), pillars * [1, -1])])
    for actions in actions_for(sim, steps):
        actions[1] = actions[0, swapped]
        sim.step(actions)
        yield sim, swapped


def test_mirrored_doggo_senses_and_moves_as_a_mirror_image():
    """Sign flips and leg swaps map one rollout onto the other to the last digits."""
    signs = {"accelerometer": [1, -1, 1], "velocimeter": [1, -1, 1], "gyro": [-1, 1, -1], "magnetometer": [-1, 1, -1]}
    for sim, swapped in mirrored_doggos(np.zeros((0, 2)), steps=15):
        assert_allclose(sim.pose[1], sim.pose[0] * [1, -1, -1], rtol=0, atol=1e-9)
        for name, sign in signs.items():
            assert_allclose(sim.sensors[name][1], sim.sensors[name][0] * sign, rtol=0, atol=1e-9)
        for name in ("joint_sin", "joint_cos", "joint_velocity"):
            assert_allclose(sim.sensors[name][1], sim.sensors[name][0, swapped], rtol=0, atol=1e-9)
    assert np.hypot(*(sim.pose[0, :2] - (0.0, 0.1))) > 0.05


def test_mirrored_doggo_meets_mirrored_pillars_alike():
    """Contacts of cylinders are found by iteration, to 1e-6 only."""
    collisions = 0
    for sim, _ in mirrored_doggos(np.array([[0.6, 0.2], [-0.3, 0.6], [0.1, -0.65]]), steps=10):
        assert_allclose(sim.pose[1], sim.pose[0] * [1, -1, -1], rtol=0, atol=1e-4)
        assert sim.collided[0] == sim.collided[1]
        collisions += sim.collided[0]
    assert collisions > 0
