"""The task tells what happened: rewards where the answer is known, ends of episodes, rows that leave others alone."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from small_tasks import WORLD, Silent, Straight, facing_goal, still, task_of, teleport

from hiernav.config import TrainConfig, load_config
from hiernav.nav.frames import body_to_world
from hiernav.nav.lidar import PILLAR_RADIUS, lidar_closeness
from hiernav.nav.termination import TerminationReason
from hiernav.sim.factory import make_task
from hiernav.sim.rollout import run_episodes
from hiernav.sim.task import TaskStep
from hiernav.sim.worlds import sample_layout

# rewards by teleporting


def test_standing_still_earns_nothing() -> None:
    step = still(task_of(facing_goal()))
    assert step.reward[0] == pytest.approx(0.0, abs=1e-3)
    assert step.terms["goal_distance"][0] == pytest.approx(2.5, abs=1e-3)


@pytest.mark.parametrize(
    ("to", "progress", "distance"),
    [
        ((-0.7, 1.5), 3.0, 0.0),
        ((-1.2, 1.5), -2.0, 0.2),
        ((-0.7, 1.3), 2.615, 0.2),
        ((-0.45, 1.5), 5.5, 0.05),
    ],
)
def test_a_motion_earns_its_progress_along_the_plan_less_the_detour_it_is(
    to: tuple[float, float], progress: float, distance: float
) -> None:
    step = teleport(task_of(facing_goal()), (*to, 0.0))
    assert step.terms["progress"][0] == pytest.approx(progress, abs=0.02)
    assert step.terms["path_distance"][0] == pytest.approx(distance, abs=0.055), "the motion is seen between vertices"
    assert step.reward[0] == pytest.approx(0.5 * progress - 0.1 * step.terms["path_distance"][0], abs=0.02)


def test_position_before_the_step_is_not_overwritten_by_the_step() -> None:
    """Each step is measured from where the one before has ended."""
    task = task_of(facing_goal())
    for x in (-0.9, -0.8, -0.7):
        assert teleport(task, (x, 1.5, 0.0)).terms["progress"][0] == pytest.approx(1.0, abs=0.02)
    assert teleport(task, (-0.9, 1.5, 0.0)).terms["progress"][0] == pytest.approx(-2.0, abs=0.02)


def test_progress_is_that_on_the_plan_active_during_the_step() -> None:
    """A step that uses the plan up is paid along the old plan; the new one begins where it ended."""
    task = task_of(facing_goal())
    step = teleport(task, (-0.3, 1.5, 0.0))
    assert step.option.reason[0] == TerminationReason.HALF_INDEX
    assert step.terms["progress"][0] == pytest.approx(7.0, abs=0.02)
    assert_allclose(step.option.start[0], [-0.3, 1.5], atol=1e-3)
    assert teleport(task, (-0.2, 1.5, 0.0)).terms["progress"][0] == pytest.approx(1.0, abs=0.02)


def test_the_paper_s_preset_counts_waypoints() -> None:
    config = load_config(None, ["skill.preset=paper"])
    task = task_of(facing_goal(), config=config)
    assert teleport(task, (-0.76, 1.5, 0.0)).terms["progress"][0] == 2.0
    assert teleport(task, (-1.2, 1.5, 0.0)).terms["progress"][0] == -2.0
    assert teleport(task, (-1.0, 1.5, 0.0)).terms["progress"][0] == 0.0


def test_touching_a_pillar_costs_one_for_each_step_of_contact() -> None:
    task = task_of(facing_goal(pillars=[(1.0, -1.0)]))
    for _ in range(2):
        step = teleport(task, (0.75, -1.0, 0.0))
        assert step.collided[0] and step.terms["collision"][0] == 1.0
    step = teleport(task, (0.6, -1.0, 0.0))
    assert not step.collided[0] and step.terms["collision"][0] == 0.0


def test_the_goal_is_reached_at_0_3_m_and_pays_one() -> None:
    near = teleport(task_of(facing_goal()), (1.195, 1.5, 0.0))
    there = teleport(task_of(facing_goal()), (1.205, 1.5, 0.0))
    assert (near.reached[0], there.reached[0]) == (False, True)
    assert (near.terminated[0], there.terminated[0]) == (False, True)
    assert (near.terms["goal"][0], there.terms["goal"][0]) == (0.0, 1.0)
    for step, paid in ((near, 0.0), (there, 1.0)):
        others = 0.5 * step.terms["progress"][0] - 0.1 * step.terms["path_distance"][0]
        assert step.reward[0] == pytest.approx(others + paid)
    assert there.option.reason[0] == TerminationReason.GOAL


# ends of episodes


def test_leaving_the_field_ends_the_episode_without_the_goal() -> None:
    inside = teleport(task_of(facing_goal()), (-1.99, 0.0, 0.0))
    outside = teleport(task_of(facing_goal()), (-2.01, 0.0, 0.0))
    assert not inside.left[0] and not inside.terminated[0]
    assert outside.left[0] and outside.terminated[0] and not outside.truncated[0] and not outside.reached[0]
    assert outside.terms["leave_field"][0] == 1.0


def test_a_goal_at_the_border_is_not_reached_from_outside() -> None:
    layout = facing_goal()
    layout.goal[:] = (1.9, 0.0)
    step = teleport(task_of(layout), (2.05, 0.0, 0.0))
    assert step.left[0] and not step.reached[0] and step.terms["goal"][0] == 0.0


def test_the_cap_truncates_and_does_not_terminate() -> None:
    task = task_of(facing_goal(), facing_goal())
    assert task.layouts[0].spec.max_steps == 300
    task.steps[:] = (298, 0)
    assert not still(task).truncated.any()
    step = still(task)
    assert step.truncated.tolist() == [True, False]
    assert not step.terminated.any()


@pytest.mark.parametrize("training", [True, False])
def test_a_robot_on_its_back_ends_its_training_episode_and_no_evaluation(training: bool) -> None:
    task = make_task(load_config(None, ["robot=doggo"]), 1, Straight(), [WORLD], training=training)
    task.reset(layouts=[facing_goal()])
    for task.steps[0] in (10, 299):
        task.sim.datas[0].qpos[3:7] = (0.0, 1.0, 0.0, 0.0)
        step = still(task)
        assert step.terms["fall"][0] == 1.0
        assert (step.fallen[0], step.terminated[0]) == (training, training)
        assert step.truncated[0] == (task.steps[0] == 300 and not training)


def test_a_robot_that_reaches_the_goal_in_the_last_step_has_reached_it() -> None:
    task = task_of(facing_goal())
    task.steps[:] = 299
    step = teleport(task, (1.5, 1.5, 0.0))
    assert step.terminated[0] and step.reached[0] and not step.truncated[0]


def test_diverged_physics_ends_its_own_episode_and_passes_no_nan_on() -> None:
    task = task_of(facing_goal(), facing_goal())
    task.sim.datas[0].qpos[0] = 1e12
    for _ in range(2):
        step = still(task)
        assert step.broken.tolist() == [True, False]
        assert step.terminated.tolist() == [True, False]
        assert not (step.left | step.reached | step.truncated).any()
        assert np.isfinite(step.reward).all() and np.isfinite(step.observation).all()
        assert all(np.isfinite(values).all() for values in step.terms.values())
    task.reset(np.array([0]), [facing_goal()])
    assert not still(task).broken.any()


def test_a_step_before_the_first_reset_is_refused() -> None:
    task = make_task(TrainConfig(), 2)
    with pytest.raises(RuntimeError, match="reset every row"):
        still(task)
    task.reset(np.array([1]))
    with pytest.raises(RuntimeError, match="reset every row"):
        still(task)


def test_a_planner_that_finds_nothing_does_not_stop_the_task() -> None:
    task = task_of(facing_goal(), planner=Silent())
    step = still(task)
    assert step.option.reason[0] == TerminationReason.NONE and task.option.counts[0, TerminationReason.START] == 1
    assert task.option.refused[0] == 2
    assert np.isfinite(step.reward[0]) and np.isfinite(step.observation).all()


# observation


def test_the_plan_that_is_told_is_the_one_that_the_skill_sees_also_on_a_way_out() -> None:
    task, shown = task_of(facing_goal()), []
    part = task.layout.slices["waypoints"]

    def look(step: TaskStep) -> None:
        seen = step.observation[:, part].astype(float).reshape(1, -1, 2)
        assert_allclose(body_to_world(seen, task.pose), step.plan, atol=1e-5)
        assert step.plan is task.plan
        shown.append(np.allclose(step.plan, step.option.plan))

    run_episodes(task, lambda seen: np.zeros((1, 2)), [facing_goal()], on_step=look)
    assert True in shown and False in shown


@pytest.mark.parametrize("robot", ["point", "car", "doggo"])
def test_the_observation_holds_what_the_robot_senses_and_its_plan_in_its_own_frame(robot: str) -> None:
    config = load_config(None, [f"robot={robot}"])
    layouts = [sample_layout(WORLD, seed, 0.2) for seed in (3, 4)]
    task = make_task(config, 2)
    task.reset(layouts=layouts)
    rng = np.random.default_rng(0)
    for _ in range(3):
        step = task.step(rng.uniform(-1, 1, (2, task.robot.action_dim)))
        assert step.observation.shape == (2, {"point": 42, "car": 54, "doggo": 78}[robot])
        assert step.observation.dtype == np.float32
        parts = {name: step.observation[:, columns] for name, columns in task.layout.slices.items()}
        plan = body_to_world(parts["waypoints"].astype(float).reshape(2, 10, 2), task.pose)
        assert_allclose(plan, step.option.plan, atol=1e-5)
        for row, layout in enumerate(layouts):
            pillars = np.column_stack((layout.pillars, np.full(len(layout.pillars), PILLAR_RADIUS)))
            seen = lidar_closeness(task.pose[row : row + 1], pillars[None])
            assert_allclose(parts["lidar"][row], seen[0], atol=1e-6)
        for name in task.sim.sensors:
            assert_allclose(parts[name], task.sim.sensors[name], rtol=1e-5, atol=1e-5)


def test_the_baseline_sees_the_goal_instead_of_waypoints() -> None:
    task = task_of(facing_goal(start=(-1.0, 1.5, np.pi / 2)), config=load_config(None, ["skill.preset=baseline"]))
    assert task.observation.shape == (1, 24)
    assert_allclose(task.observation[0, task.layout.slices["goal"]], [0.0, -2.5], atol=1e-6)


def test_gremlins_move_in_the_map_and_in_the_lidar() -> None:
    task = task_of(facing_goal(start=(-1.5, -1.5, 0.0), gremlins=[(0.0, 0.0)]), facing_goal())
    maps, lidar = list(task._maps), task.observation[0, task.layout.slices["lidar"]].copy()
    for _ in range(20):
        step = still(task)
    assert task._maps[0] is not maps[0] and task._maps[1] is maps[1]
    position = 0.3 * np.array([np.cos(task.sim.time[0]), np.sin(task.sim.time[0])])
    assert task._maps[0].occupied_at(position)
    assert not np.allclose(step.observation[0, task.layout.slices["lidar"]], lidar)


def test_what_stood_in_the_last_world_is_not_seen_in_the_next() -> None:
    task = task_of(facing_goal(pillars=[(-1.0, 0.9), (-0.2, 1.5)]))
    lidar = task.layout.slices["lidar"]
    assert (task.observation[0, lidar] > 0.0).sum() > 2
    task.reset(layouts=[facing_goal(pillars=[(-0.2, 1.5)])])
    alone = task_of(facing_goal(pillars=[(-0.2, 1.5)]))
    assert_allclose(task.observation[0, lidar], alone.observation[0, lidar])
    task.reset(layouts=[facing_goal()])
    assert not task.observation[0, lidar].any() and not still(task).observation[0, lidar].any()


def test_training_may_cut_episodes_short_and_evaluation_does_not() -> None:
    config = load_config(None, ["skill.episode_steps=2"])
    for training, truncated in ((True, True), (False, False)):
        task = make_task(config, 1, Straight(), [WORLD], training=training)
        task.reset(layouts=[facing_goal()])
        assert not still(task).truncated[0]
        assert still(task).truncated[0] == truncated
