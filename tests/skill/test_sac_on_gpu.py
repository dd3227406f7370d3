"""A learner on a GPU computes what one on the processor does, its policy acts beside it, and checkpoints travel."""

from __future__ import annotations

import io

import pytest

torch = pytest.importorskip("torch", reason="needs the extra hiernav[train]")
pytest.importorskip("torchrl", reason="needs the extra hiernav[train]")

from tensordict import TensorDict  # noqa: E402

from hiernav.nav.observation import observation_layout  # noqa: E402
from hiernav.skill.sac import Learner, SacSettings  # noqa: E402

pytestmark = [pytest.mark.train, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")]
LAYOUT = observation_layout("point")
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
        ours, theirs = one.update(batch(k)), other.update(batch(k))
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
    source.update(batch())
    assert torch.equal(source.actor.mean_action(observation), before)
    source.publish()
    after = source.actor.mean_action(observation)
    assert after.device.type == "cpu" and not torch.equal(after, before)
    assert source.policy(TensorDict({"observation": observation}, [12]))["action"].device.type == "cpu"


def test_a_restored_learner_acts_with_the_weights_of_the_checkpoint() -> None:
    source, observation = learner("cuda"), batch(7)["observation"]
    source.update(batch())
    source.publish()
    restored = moved(source, "cuda")
    assert torch.equal(restored.actor.mean_action(observation), source.actor.mean_action(observation))
