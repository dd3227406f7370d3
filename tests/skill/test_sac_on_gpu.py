"""A learner on a GPU computes what one on the processor does, its policy acts beside it, and checkpoints travel."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import pytest

torch = pytest.importorskip("torch", reason="needs the extra hiernav[train]")
pytest.importorskip("torchrl", reason="needs the extra hiernav[train]")

from tensordict import TensorDict  # noqa: E402

from hiernav.device import Recorded  # noqa: E402
from hiernav.sim.robots import get_robot  # noqa: E402
from hiernav.skill.replay import Replay  # noqa: E402
from hiernav.skill.sac import Learner, SacSettings  # noqa: E402

pytestmark = [pytest.mark.train, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")]
LAYOUT = get_robot("point").observation_layout()
SETTINGS = SacSettings(hidden=(16, 16), layer_norm=True)


def learner(device: str, seed: int = 0) -> Learner:
    torch.manual_seed(seed)
    return Learner(LAYOUT, 2, SETTINGS, device)


def moved(source: Learner, device: str) -> Learner:
    """The learner that a checkpoint of `source`, written and read back, makes on another device."""
    file = io.BytesIO()
    torch.save(source.state_dict(), file)
    file.seek(0)
    target = learner(device, seed=99)
    target.load_state_dict(torch.load(file, weights_only=True, map_location="cpu"))
    return target


def batch(seed: int = 0, size: int = 12) -> TensorDict:
    rng = torch.Generator().manual_seed(seed)
    following = {
        "observation": torch.randn(size, LAYOUT.size, generator=rng),
        "reward": torch.randn(size, 1, generator=rng),
        "terminated": torch.zeros(size, 1, dtype=torch.bool),
    }
    now = {"observation": torch.randn(size, LAYOUT.size, generator=rng), "action": torch.rand(size, 2, generator=rng)}
    return TensorDict({**now, "next": TensorDict(following, [size])}, [size])


@pytest.fixture
def without_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every draw from a standard normal is 0.3."""
    monkeypatch.setattr(torch, "randn_like", lambda like, **_: torch.full_like(like, 0.3))


@pytest.mark.parametrize(("first", "second"), [("cpu", "cuda"), ("cuda", "cpu")])
def test_both_devices_learn_the_same_from_the_same_checkpoint(first: str, second: str, without_noise: None) -> None:
    one = learner(first)
    other = moved(one, second)
    for k in range(3):
        ours, theirs = (source.update(batch(k).to(source.device)) for source in (one, other))
        for name, value in ours.items():
            torch.testing.assert_close(value.cpu(), theirs[name].cpu(), rtol=1e-3, atol=1e-4, msg=name)
    for source in (one, other):
        source.publish()
    observation = batch(7)["observation"]
    torch.testing.assert_close(
        one.actor.mean_action(observation), other.actor.mean_action(observation), rtol=1e-3, atol=1e-4
    )


def test_the_acting_policy_stays_on_the_processor_and_follows_when_weights_are_published() -> None:
    source, observation = learner("cuda"), batch(7)["observation"]
    before = source.actor.mean_action(observation)
    source.update(batch().to("cuda"))
    assert torch.equal(source.actor.mean_action(observation), before)
    source.publish()
    after = source.actor.mean_action(observation)
    assert after.device.type == "cpu" and not torch.equal(after, before)
    assert source.policy(TensorDict({"observation": observation}, [12]))["action"].device.type == "cpu"


def test_a_restored_learner_acts_with_the_weights_of_the_checkpoint() -> None:
    source, observation = learner("cuda"), batch(7)["observation"]
    source.update(batch().to("cuda"))
    source.publish()
    restored = moved(source, "cuda")
    assert torch.equal(restored.actor.mean_action(observation), source.actor.mean_action(observation))


def test_recorded_updates_are_those_made_one_by_one(without_noise: None) -> None:
    batches = [batch(k) for k in range(8)]
    stacked = torch.stack(batches).to("cuda")

    def update(source: Learner) -> Callable[[torch.Tensor], dict[str, torch.Tensor]]:
        return lambda which: source.update(
            stacked.apply(lambda values: values.index_select(0, which).squeeze(0), batch_size=[12])
        )

    one, other = learner("cuda"), learner("cuda")
    recorded = Recorded(update(one), torch.device("cuda"))
    for k in range(8):
        which = torch.tensor([k], device="cuda")
        ours, theirs = recorded(which), update(other)(which)
        for name, value in ours.items():
            torch.testing.assert_close(value, theirs[name], msg=f"{name} of update {k}")
    assert one.updates == other.updates == 8
    torch.testing.assert_close(one.loss.weights, other.loss.weights)
    torch.testing.assert_close(one.state_dict()["average"], other.state_dict()["average"])


def test_recorded_updates_draw_new_noise_each_time() -> None:
    recorded = Recorded(lambda like: torch.randn_like(like), torch.device("cuda"))
    drawn = [recorded(torch.zeros(4, device="cuda")).clone() for _ in range(6)]
    assert len({tuple(values.tolist()) for values in drawn}) == 6


def test_a_replay_buffer_on_a_gpu_draws_what_is_on_disk(tmp_path: Path) -> None:
    def transitions(first: int, count: int) -> TensorDict:
        column = torch.arange(first, first + count, dtype=torch.float32)[:, None]
        flags = torch.zeros(count, 1, dtype=torch.bool)
        following = {"observation": column + 0.5, "reward": column, "done": flags, "terminated": flags}
        return TensorDict({"observation": column.clone(), "action": -column, "next": following}, [count])

    replay = Replay(tmp_path / "replay", 6, 1, 1, 64, "cuda")
    replay.extend(transitions(0, 4))
    replay.extend(transitions(4, 4))  # the oldest two are overwritten
    restored = Replay(tmp_path / "replay", 6, 1, 1, 64, "cuda")
    restored.load_state_dict(replay.state_dict())
    for buffer in (replay, restored):
        (rows,) = buffer.draw(1)
        drawn = buffer.batch(rows)
        assert rows.device.type == drawn["observation"].device.type == "cuda"
        assert set(drawn["observation"].flatten().tolist()) == {2.0, 3.0, 4.0, 5.0, 6.0, 7.0}
        assert torch.equal(drawn["next", "observation"], drawn["observation"] + 0.5)
        assert torch.equal(drawn["action"], -drawn["next", "reward"])
