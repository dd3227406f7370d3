"""The TorchRL environment keeps TorchRL's contract: specs, batches, resets of the rows that are done."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

pytestmark = pytest.mark.train
torch = pytest.importorskip("torch")
pytest.importorskip("torchrl")

from torchrl.envs import SerialEnv  # noqa: E402
from torchrl.envs.utils import check_env_specs  # noqa: E402

from hiernav.config import load_config  # noqa: E402
from hiernav.nav.termination import TerminationReason  # noqa: E402
from hiernav.sim.factory import make_task  # noqa: E402
from hiernav.sim.layout import Layout, parse_world  # noqa: E402
from hiernav.sim.reward import TERMS, weighted_sum  # noqa: E402
from hiernav.sim.worlds import sample_layout  # noqa: E402
from hiernav.skill.env import NavigationEnv  # noqa: E402

WORLD = parse_world("pillar(2,2,10)")


def env_of(num_rows: int = 3, caps: tuple[int, ...] = (300,), robot: str = "point") -> NavigationEnv:
    """Rows take the caps on steps in turn; every episode of a row is a new world."""
    drawn = [0] * num_rows

    def draw(row: int) -> Layout:
        drawn[row] += 1
        layout = sample_layout(WORLD, 1000 * row + drawn[row], 0.2)
        return replace(layout, spec=replace(layout.spec, max_steps=caps[row % len(caps)]))

    return NavigationEnv(make_task(load_config(None, [f"robot={robot}"]), num_rows, worlds=[WORLD], layouts=draw))


def still(env: NavigationEnv, steps: int) -> torch.Tensor:
    """A rollout without action, resetting rows that are done."""

    def policy(td: torch.Tensor) -> torch.Tensor:
        return td.set("action", torch.zeros(env.action_spec.shape))

    return env.rollout(steps, policy, break_when_any_done=False)


@pytest.mark.parametrize("robot", ["point", "car", "doggo"])
def test_the_environment_fits_its_specs(robot: str) -> None:
    check_env_specs(env_of(robot=robot))


def test_every_array_has_a_row_for_each_robot() -> None:
    env = env_of(4)
    assert env.batch_size == torch.Size([4])
    rollout = env.rollout(6)
    assert rollout.batch_size == torch.Size([4, 6])
    assert rollout["observation"].shape == (4, 6, 42) and rollout["observation"].dtype == torch.float32
    assert rollout["action"].shape == (4, 6, 2)
    assert rollout["next", "reward"].shape == (4, 6, 1)
    assert rollout["next", "terms"].shape == (4, 6, len(TERMS))
    assert rollout["next", "episode_steps"][:, :, 0].tolist() == [list(range(1, 7))] * 4


def test_the_reward_is_the_weighted_sum_of_the_logged_terms() -> None:
    env = env_of()
    rollout = env.rollout(10)["next"]
    terms = {name: rollout["terms"][..., k].double().numpy() for k, name in enumerate(TERMS)}
    terms = {name: values.reshape(-1) for name, values in terms.items()}
    expected = weighted_sum(env.task.reward, terms)
    np.testing.assert_allclose(rollout["reward"].reshape(-1).numpy(), expected, atol=1e-5)


def test_rows_that_are_done_are_reset_and_the_others_go_on() -> None:
    rollout = still(env_of(3, caps=(4, 300, 6)), 12)
    steps = rollout["next", "episode_steps"][..., 0].tolist()
    assert steps == [[1, 2, 3, 4] * 3, list(range(1, 13)), [1, 2, 3, 4, 5, 6] * 2]
    done = rollout["next", "done"][..., 0]
    assert (done == torch.tensor([[0, 0, 0, 1] * 3, [0] * 12, [0, 0, 0, 0, 0, 1] * 2], dtype=torch.bool)).all()
    assert (rollout["next", "truncated"][..., 0] == done).all()
    assert not rollout["next", "terminated"].any()


def test_after_the_end_the_next_row_begins_in_the_new_world_and_the_end_keeps_the_old_one() -> None:
    rollout = still(env_of(2, caps=(4, 300)), 8)
    shown, following = rollout["observation"], rollout["next", "observation"]
    same = (shown[:, 1:] == following[:, :-1]).all(-1)
    assert same.tolist() == [[True, True, True, False, True, True, True], [True] * 7]
    reason = rollout["reason"][..., 0]
    assert (reason[0, [0, 4]] == int(TerminationReason.START)).all()
    assert rollout["episode_steps"][0, 4, 0] == 0
    assert rollout["episode_steps"][1, 4, 0] == 4, "a row that is not reset keeps what it showed"
    assert (rollout["reason"][1, 1:] == rollout["next", "reason"][1, :-1]).all()


def test_reaching_the_goal_terminates() -> None:
    env = env_of(2)
    td = env.reset()
    env.task.robot.place(env.task.sim.datas[1].qpos, np.array([*env.task.goal[1], 0.0]))
    after = env.step(td.set("action", torch.zeros(2, 2)))["next"]
    assert after["terminated"][:, 0].tolist() == [False, True]
    assert after["reached"][:, 0].tolist() == [False, True]
    assert not after["truncated"].any()
    assert after["done"][:, 0].tolist() == [False, True]


def test_a_rollout_is_not_written_into_by_the_next_one() -> None:
    env = env_of()
    first = env.rollout(5)
    kept = first.clone()
    env.rollout(20)
    assert (first == kept).all()


def worlds_of(env: NavigationEnv) -> list[int]:
    env.reset()
    return [layout.seed for layout in env.task.layouts]


def test_a_seed_decides_the_worlds_as_that_of_the_configuration_does() -> None:
    first, second, third = (NavigationEnv(make_task(load_config(None, [f"seed={seed}"]), 3)) for seed in (0, 0, 2))
    assert worlds_of(first) == worlds_of(second)
    first.set_seed(1), second.set_seed(2)
    begun = worlds_of(first)
    assert not set(begun) & set(worlds_of(second))
    first.set_seed(1)
    assert worlds_of(first) == begun, "from its first episode on"
    first.set_seed(2)
    assert worlds_of(first) == worlds_of(third)


def test_environments_side_by_side_get_worlds_of_their_own_from_one_seed() -> None:
    def make() -> NavigationEnv:
        return NavigationEnv(make_task(load_config(), 2))

    both = SerialEnv(2, make)
    both.set_seed(0)
    shown = both.reset()["observation"]
    assert (shown[0] != shown[1]).any(-1).all()
    both.close()


def test_layouts_of_one_s_own_are_not_replaced_by_a_seed() -> None:
    env, other = env_of(2), env_of(2)
    env.set_seed(5)
    assert worlds_of(env) == worlds_of(other)


def test_a_closed_environment_leaves_no_thread_behind() -> None:
    before = threading.active_count()
    env = NavigationEnv(make_task(load_config(None, ["threads=2"]), 4))
    env.rollout(2)
    assert threading.active_count() > before
    env.close()
    assert threading.active_count() == before
