"""Rows of a task are episodes of their own, drawn from one seed, built as configured."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from small_tasks import WORLD

from hiernav.config import ConfigError, OptionConfig, TrainConfig, load_config
from hiernav.nav.bundle import PlanSpec, ReplanSpec
from hiernav.nav.termination import ReplanRule
from hiernav.sim.factory import RandomLayouts, expert_planner, make_task, replan_rule, replan_spec
from hiernav.sim.layout import parse_world
from hiernav.sim.task import NavigationTask

# rows


def snapshot(task: NavigationTask, row: int) -> dict[str, np.ndarray]:
    names = ("plan", "start", "started", "age", "counts", "refused")
    values = {name: getattr(task.option, name)[row].copy() for name in names}
    return values | {"pose": task.pose[row].copy(), "goal": task.goal[row].copy(), "steps": task.steps[row].copy()}


def test_resetting_some_rows_leaves_the_others_as_they_were() -> None:
    task = make_task(TrainConfig(), 3)
    task.reset()
    rng = np.random.default_rng(1)
    for _ in range(5):
        task.step(rng.uniform(-1, 1, (3, 2)))
    before, seen = snapshot(task, 1), task.observation.copy()
    observation = task.reset(np.array([0, 2]))
    assert_array_equal(observation[1], seen[1])
    assert (observation[[0, 2]] != seen[[0, 2]]).any(axis=1).all()
    for name, values in snapshot(task, 1).items():
        assert_array_equal(values, before[name], err_msg=name)
    assert task.steps.tolist() == [0, 5, 0]
    assert_allclose(task.pose[0], task.layouts[0].start, atol=1e-9)


def test_what_a_step_returned_is_not_changed_by_later_steps() -> None:
    task = make_task(TrainConfig(), 2)
    task.reset()
    step = task.step(np.ones((2, 2)))
    kept = {"observation": step.observation.copy(), "reward": step.reward.copy(), "plan": step.option.plan.copy()}
    for _ in range(30):
        task.step(np.ones((2, 2)))
    task.reset()
    assert_array_equal(step.observation, kept["observation"])
    assert_array_equal(step.reward, kept["reward"])
    assert_array_equal(step.option.plan, kept["plan"])


def drive(seed: int, num_rows: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Rewards and poses of 40 steps, in which row 0 is reset once."""
    task = make_task(load_config(None, [f"seed={seed}"]), num_rows)
    task.reset()
    rewards, poses, rng = [], [], np.random.default_rng(0)
    for tick in range(40):
        step = task.step(rng.uniform(-1, 1, (4, 2))[:num_rows])
        rewards.append(step.reward)
        poses.append(task.pose)
        if tick == 20:
            task.reset(np.array([0]))
    return np.array(rewards), np.array(poses)


def test_the_same_seed_gives_the_same_episodes_to_the_bit() -> None:
    first, again, other = drive(5), drive(5), drive(6)
    assert_array_equal(first[0], again[0])
    assert_array_equal(first[1], again[1])
    assert (first[1][0] != other[1][0]).any()


def test_a_row_s_episodes_do_not_depend_on_how_many_rows_there_are() -> None:
    few, many = drive(5, 1), drive(5, 4)
    assert_array_equal(few[0][:, 0], many[0][:, 0])
    assert_array_equal(few[1][:, 0], many[1][:, 0])


def test_random_layouts_are_the_same_whatever_the_order_of_the_rows() -> None:
    draws = {}
    for order in ((0, 1, 0, 1, 1), (1, 1, 0, 1, 0)):
        source = RandomLayouts([WORLD, parse_world("two-room")], (7,), 0.1)
        drawn: dict[int, list[tuple[str, int]]] = {0: [], 1: []}
        for row in order:
            layout = source(row)
            drawn[row].append((str(layout.spec), layout.seed))
        draws[order] = drawn
    first, second = draws.values()
    assert first == second
    assert len({seed for row in first.values() for _, seed in row}) == 5


def test_all_worlds_are_drawn() -> None:
    source = RandomLayouts([WORLD, parse_world("two-room"), parse_world("gremlin")], (0,), 0.1)
    assert {str(source(0).spec) for _ in range(20)} == {"pillar(2,2,10)", "two-room", "gremlin"}


# configuration


def test_the_task_is_built_as_configured() -> None:
    config = load_config(
        None,
        [
            "robot=car",
            "option.d_update_m=0.4",
            "option.period=8",
            "option.spacing_m=0.08",
            "planner.soft_margin_m=0.05",
        ],
    )
    task = make_task(config, 3)
    assert task.robot.name == "car" and task.num_rows == 3
    assert replan_rule(config).d_update == 0.4 and replan_rule(config).period == 8
    assert task.option.rule == replan_rule(config)
    assert (task.option.sweep_radius, task.option.goal_radius) == (0.2, 0.3)
    assert task.option.refresh == 5, "0.2 s of 25 Hz"
    planner = expert_planner(config)
    assert (planner.radius, planner.soft_margin, planner.spacing) == (0.2, 0.05, 0.08)
    assert expert_planner(load_config(None, ["planner.planning_radius_m=0.15"])).radius == 0.15
    with pytest.raises(ConfigError, match=r"planning_radius_m = 0.04, expected at least 0.1, the radius of the point"):
        expert_planner(load_config(None, ["planner.planning_radius_m=0.04"]))


THRESHOLDS = {"d_update_m": 0.41, "half_fraction": 0.7, "invalid": False, "period": 16}
"""Other values than the defaults for all of `ReplanSpec`."""


def test_a_bundle_takes_along_all_that_an_option_is_configured_with() -> None:
    of_plans = ("waypoints", "spacing_m")
    assert ReplanSpec.__struct_fields__ + of_plans == OptionConfig.__struct_fields__
    assert set(of_plans) <= set(PlanSpec.__struct_fields__) and tuple(THRESHOLDS) == ReplanSpec.__struct_fields__


@pytest.mark.parametrize("name", ReplanSpec.__struct_fields__)
def test_every_threshold_acts_on_the_rule(name: str) -> None:
    """Training, evaluation and robot make their rules of nothing else."""
    config = TrainConfig(option=OptionConfig(**{name: THRESHOLDS[name]}))
    assert getattr(replan_spec(config), name) == THRESHOLDS[name]
    assert replan_rule(config) == replan_spec(config).rule() != ReplanRule()
    assert sum(a != b for a, b in zip(astuple(replan_rule(config)), astuple(ReplanRule()), strict=True)) == 1


def test_a_random_world_is_reset_into_the_drawn_layout() -> None:
    task = make_task(TrainConfig(), 1, worlds=[parse_world("four-room")])
    task.reset()
    layout = task.layouts[0]
    assert layout.spec.kind == "four-room"
    assert_allclose(task.pose[0], layout.start, atol=1e-9)
    assert_array_equal(task.goal[0], layout.goal)
