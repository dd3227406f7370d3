"""The Gymnasium environments keep Gymnasium's contract and are the navigation task."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scenery import layout_of

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env  # noqa: E402

from hiernav.config import TrainConfig, load_config  # noqa: E402
from hiernav.envs import ROBOTS, WORLDS  # noqa: E402
from hiernav.sim.factory import make_task  # noqa: E402
from hiernav.sim.gym import NavigationGymEnv  # noqa: E402
from hiernav.sim.layout import parse_world  # noqa: E402


def episode(env: gymnasium.Env, steps: int = 15) -> list[tuple]:
    rng = np.random.default_rng(0)
    return [env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)) for _ in range(steps)]


@pytest.mark.parametrize("name", ["hiernav/PointPillar-v0", "hiernav/CarGremlin-v0", "hiernav/DoggoFourRoom-v0"])
@pytest.mark.filterwarnings("ignore:.*Box observation space (minimum|maximum) value is.*infinity")
@pytest.mark.filterwarnings("error")
def test_the_environment_keeps_gymnasium_s_contract(name: str) -> None:
    check_env(gymnasium.make(name, render_mode="rgb_array").unwrapped)


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("robot", ROBOTS)
def test_every_name_is_its_robot_in_its_world(robot: str, world: str) -> None:
    env = gymnasium.make(f"hiernav/{robot}{world}-v0")
    observation, info = env.reset(seed=0)
    task = env.unwrapped.task
    assert task.robot.name == robot.lower()
    assert task.layouts[0].spec == parse_world(WORLDS[world])
    assert observation.shape == {"Point": (42,), "Car": (54,), "Doggo": (78,)}[robot]
    assert info["reason"] == "start"


def test_importing_hiernav_registers_the_environments_without_torch() -> None:
    code = (
        "import sys, gymnasium, hiernav\n"
        "env = gymnasium.make('hiernav/PointPillar-v0')\n"
        "print(env.reset(seed=1)[0].shape, 'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.strip() == "(42,) False"


def test_the_seed_of_a_reset_determines_this_world_and_those_that_follow() -> None:
    seen = []
    for seed in (3, 3, 4):
        env = gymnasium.make("hiernav/PointPillar-v0")
        seeds = [env.reset(seed=seed)[1]["layout_seed"], env.reset()[1]["layout_seed"]]
        seen.append((seeds, episode(env)))
    assert seen[0][0] == seen[1][0] != seen[2][0]
    assert seen[0][0][0] != seen[0][0][1]
    for one, other in zip(seen[0][1], seen[1][1], strict=True):
        assert_array_equal(one[0], other[0])
        assert one[1:4] == other[1:4]


def test_it_is_the_navigation_task_to_the_bit() -> None:
    env = NavigationGymEnv("car", "gremlin")
    env.reset(seed=2)
    task = make_task(load_config(None, ["robot=car"]), 1, worlds=[parse_world("gremlin")])
    task.reset(layouts=[env.task.layouts[0]])
    rng = np.random.default_rng(0)
    for observation, reward, terminated, truncated, info in episode(env):
        step = task.step(rng.uniform(-1, 1, (1, 2)).astype(np.float32))
        assert_array_equal(observation, step.observation[0])
        assert (reward, terminated, truncated) == (step.reward[0], step.terminated[0], step.truncated[0])
        assert info["terms"] == {name: values[0] for name, values in step.terms.items()}
        assert info["collided"] == step.collided[0]
        assert_array_equal(info["pose"], task.pose[0])


def test_leaving_the_field_terminates_and_the_cap_truncates() -> None:
    env = gymnasium.make("hiernav/PointPillar-v0", world="pillar(0.8,0.8,0)")
    env.reset(options={"layout": layout_of(start=(1.9, 0.0, 0.0))})
    while True:
        _, _, terminated, truncated, info = env.step(np.array([1.0, 0.0], np.float32))
        if terminated or truncated:
            break
    assert terminated and not truncated and info["left_field"] and not info["reached"]

    env.reset()
    ends = [env.step(np.zeros(2, np.float32))[2:4] for _ in range(120)]
    assert ends[:-1] == [(False, False)] * 119
    assert ends[-1] == (False, True)


def test_planner_configuration_and_world_are_taken_from_the_call() -> None:
    class Ahead:
        def plan(self, query: object) -> np.ndarray:
            return query.position[:, None] + 0.1 * np.arange(1, 11)[:, None] * [1.0, 0.0]

    env = gymnasium.make(
        "hiernav/PointPillar-v0",
        world="pillar(3,3,5)",
        planner=Ahead(),
        config=load_config(None, ["skill.preset=paper", "robot=doggo"]),
    ).unwrapped
    env.reset(seed=0)
    assert env.task.robot.name == "point"
    assert env.task.reward.preset == "paper" and not env.task.option.rule.invalid
    assert str(env.task.layouts[0].spec) == "pillar(3,3,5)"
    assert (np.diff(env.task.option.plan[0, :, 1]) == 0.0).all()
    baseline = NavigationGymEnv(config=load_config(None, ["skill.preset=baseline"]))
    assert baseline.observation_space.shape == (24,)
    assert NavigationGymEnv(config=TrainConfig()).observation_space.shape == (42,)


def test_the_picture_shows_robot_plan_and_goal_where_they_are() -> None:
    env = NavigationGymEnv(render_mode="rgb_array")
    env.reset(options={"layout": layout_of(start=(-1.0, 0.5, 0.0), pillars=[(1.0, -1.0)])})
    image = env.render()
    assert image.shape == (480, 480, 3) and image.dtype == np.uint8

    def at(x: float, y: float) -> list[int]:
        return image[round((2.0 - y) * 120), round((x + 2.0) * 120)].tolist()

    assert at(1.0, -1.0) == [90, 90, 90]
    assert at(-1.5, -1.5) == [245, 245, 245]
    assert at(1.5, 1.5) == [90, 180, 90]
    assert at(-1.05, 0.5) == [220, 60, 40]
    assert at(*env.task.option.plan[0, 5]) == [40, 90, 220]


def test_a_field_that_is_no_square_and_a_lost_robot_can_be_drawn() -> None:
    env = NavigationGymEnv(world="pillar(2,1,2)", render_mode="rgb_array")
    env.reset(seed=0)
    env.task.sim.datas[0].qpos[0] = 1e12
    assert env.step(np.zeros(2))[2]
    assert env.render().shape == (240, 480, 3)


@pytest.mark.parametrize(("robot", "rate"), [("point", 50), ("car", 25), ("doggo", 10)])
def test_pictures_of_every_control_step_are_shown_at_the_robot_s_rate(robot: str, rate: int) -> None:
    env = gymnasium.make(f"hiernav/{robot.capitalize()}Pillar-v0", render_mode="rgb_array")
    assert env.metadata["render_fps"] == rate
    assert NavigationGymEnv.metadata["render_modes"] == ["rgb_array"]


def test_there_is_no_picture_before_the_first_reset() -> None:
    env = gymnasium.make("hiernav/PointPillar-v0", render_mode="rgb_array", disable_env_checker=True).unwrapped
    with pytest.raises(gymnasium.error.ResetNeeded, match="no world yet"):
        env.render()
    env.close()


def test_without_a_render_mode_there_is_no_picture_and_an_unknown_one_is_refused() -> None:
    env = NavigationGymEnv()
    env.reset(seed=0)
    assert env.render() is None
    with pytest.raises(ValueError, match="render_mode 'human'; accepted: None, rgb_array"):
        NavigationGymEnv(render_mode="human")
