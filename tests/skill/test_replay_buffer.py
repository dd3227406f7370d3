"""The replay buffer gives back what went into it, whole rows and no others, and reflects halves of batches truly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.train
torch = pytest.importorskip("torch")
pytest.importorskip("torchrl")

from tensordict import TensorDict  # noqa: E402

from hiernav.nav.mirror import mirror_of  # noqa: E402
from hiernav.sim.robots import get_robot  # noqa: E402
from hiernav.skill.replay import HalfMirror, Replay  # noqa: E402


def numbered(first: int, count: int) -> TensorDict:
    """Transitions that carry their number in every part; each third one terminates."""
    number = torch.arange(first, first + count, dtype=torch.float32)[:, None]
    ended = number % 3 == 0
    following = {"observation": number.repeat(1, 3) + 0.5, "reward": -number, "done": ended, "terminated": ended}
    now = {"observation": number.repeat(1, 3), "action": number.repeat(1, 2) / 1000}
    return TensorDict({**now, "next": TensorDict(following, [count])}, [count])


def held(replay: Replay) -> list[int]:
    """Numbers of the transitions that can be drawn, every part of which is checked to be of the same one."""
    batch = replay.batch(torch.arange(len(replay)))
    numbers = [int(number) for number in batch["observation"][:, 0]]
    for row, number in enumerate(numbers):
        expected = numbered(number, 1)
        for key in batch.keys(include_nested=True, leaves_only=True):
            assert torch.equal(batch[key][row], expected[key][0]), key
    return numbers


def test_the_oldest_transitions_make_room_for_the_newest(tmp_path: Path) -> None:
    replay = Replay(tmp_path, 10, 3, 2, 4)
    replay.extend(numbered(1, 7))
    assert held(replay) == [1, 2, 3, 4, 5, 6, 7]
    replay.extend(numbered(8, 5))
    assert sorted(held(replay)) == list(range(3, 13))


def test_only_what_is_there_is_drawn_and_all_of_it(tmp_path: Path) -> None:
    replay = Replay(tmp_path, 50, 3, 2, 8)
    replay.extend(numbered(1, 6))
    torch.manual_seed(0)
    rows = replay.draw(40)
    assert rows.shape == (40, 8)
    assert rows.unique().tolist() == [0, 1, 2, 3, 4, 5]


def test_a_buffer_that_has_wrapped_goes_on_where_it_was_in_another_process(tmp_path: Path) -> None:
    before = Replay(tmp_path, 10, 3, 2, 4)
    before.extend(numbered(1, 7))
    before.extend(numbered(8, 5))
    state = before.state_dict()
    after = Replay(tmp_path, 10, 3, 2, 4)
    assert len(after) == 0 and not after.fresh
    after.load_state_dict(state)
    assert held(after) == held(before)
    after.extend(numbered(13, 3))
    assert sorted(held(after)) == list(range(6, 16)), "the oldest have gone"


@pytest.mark.parametrize("robot", ["point", "car", "doggo"])
def test_the_first_half_of_a_batch_is_reflected_in_every_part_and_the_rest_is_left_alone(robot: str) -> None:
    layout = get_robot(robot).observation_layout()
    mirror = mirror_of(robot, layout)
    actions = len(mirror.action_index)
    rng = np.random.default_rng(0)
    seen, later = rng.normal(size=(2, 7, layout.size)).astype(np.float32)
    action, reward = rng.uniform(-1, 1, (7, actions)).astype(np.float32), torch.arange(7.0)[:, None]
    following = {"observation": torch.from_numpy(later.copy()), "reward": reward.clone()}
    now = {"observation": torch.from_numpy(seen.copy()), "action": torch.from_numpy(action.copy())}
    batch = TensorDict({**now, "next": TensorDict(following, [7])}, [7])
    HalfMirror(mirror)(batch)
    for values, before, turned in (
        (batch["observation"], seen, mirror.observation),
        (batch["next", "observation"], later, mirror.observation),
        (batch["action"], action, mirror.action),
    ):
        np.testing.assert_array_equal(values[:3].numpy(), turned(before[:3]))
        np.testing.assert_array_equal(values[3:].numpy(), before[3:])
    assert torch.equal(batch["next", "reward"], reward)
