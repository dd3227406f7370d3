"""The learner changes what it should, keeps exploring, resumes to the bit, and bootstraps through truncation only."""

from __future__ import annotations

from dataclasses import asdict

import pytest

pytestmark = pytest.mark.train
torch = pytest.importorskip("torch")
pytest.importorskip("torchrl")

from tensordict import TensorDict  # noqa: E402
from torch import nn  # noqa: E402
from torch.testing import assert_close  # noqa: E402
from torchrl.objectives import SACLoss  # noqa: E402

from hiernav.config import load_config  # noqa: E402
from hiernav.sim.robots import get_robot  # noqa: E402
from hiernav.skill.networks import Actor, Critic  # noqa: E402
from hiernav.skill.perceptrons import _rectify  # noqa: E402
from hiernav.skill.sac import Learner, SacSettings  # noqa: E402
from hiernav.skill.train import alpha_floor, make_learner  # noqa: E402

LAYOUT = get_robot("point").observation_layout()
SMALL = SacSettings(hidden=(16, 16))
norms = pytest.mark.parametrize("layer_norm", [False, True])


def learner(settings: SacSettings = SMALL, seed: int = 0) -> Learner:
    torch.manual_seed(seed)
    return Learner(LAYOUT, 2, settings)


def batch(seed: int = 0, size: int = 12, **flags: bool) -> TensorDict:
    """Transitions as the replay buffer gives them; `terminated` and `truncated` are False unless given."""
    rng = torch.Generator().manual_seed(seed)

    def flag(name: str) -> torch.Tensor:
        return torch.full((size, 1), flags.get(name, False))

    following = {
        "observation": torch.randn(size, LAYOUT.size, generator=rng),
        "reward": torch.randn(size, 1, generator=rng),
        "terminated": flag("terminated"),
        "truncated": flag("truncated"),
        "done": flag("terminated") | flag("truncated"),
    }
    now = {
        "observation": torch.randn(size, LAYOUT.size, generator=rng),
        "action": torch.rand(size, 2, generator=rng) * 2 - 1,
    }
    return TensorDict({**now, "next": TensorDict(following, [size])}, [size])


def snapshot(source: Learner) -> dict[str, torch.Tensor]:
    return {name: value.detach().clone() for name, value in source.loss.state_dict().items() if torch.is_tensor(value)}


@pytest.fixture
def without_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every draw from a standard normal is 0.3."""
    monkeypatch.setattr(torch, "randn_like", lambda like, **_: torch.full_like(like, 0.3))
    monkeypatch.setattr(
        "torch.distributions.normal._standard_normal",
        lambda shape, dtype, device: torch.full(shape, 0.3, dtype=dtype, device=device),
    )


def unstacked_targets(source: Learner) -> list[Critic]:
    """The two target critics as plain modules."""
    critics = []
    for which in range(2):
        critic = Critic(LAYOUT, 2, source.settings.hidden, source.settings.layer_norm)
        stacked = source.loss.target_qvalue_network_params["module"].flatten_keys(".")
        critic.load_state_dict({name: stacked[name][which] for name in critic.state_dict()})
        critics.append(critic)
    return critics


# one update


@norms
def test_an_update_changes_actor_critics_targets_and_temperature(layer_norm: bool) -> None:
    source = learner(SacSettings(hidden=(16, 16), layer_norm=layer_norm))
    before = snapshot(source)
    metrics = source.update(batch())
    after = snapshot(source)
    assert before.keys() == after.keys()
    changed = {name for name in after if not torch.equal(before[name], after[name])}
    for part in ("actor_network_params", "qvalue_network_params", "target_qvalue_network_params"):
        weights = {name for name in after if name.startswith(part) and name.endswith(("weight", "bias"))}
        assert weights and weights <= changed, part
    assert "log_alpha" in changed
    assert not any("scale" in name for name in changed), "the layout's scale is no parameter"
    assert source.updates == 1
    assert all(torch.isfinite(value).all() for value in metrics.values())
    assert not any(value.requires_grad for value in metrics.values())


def test_updates_are_counted_on_past_what_single_precision_holds() -> None:
    source = learner()
    source.load_state_dict(source.state_dict() | {"updates": 2**24})
    source.update(batch())
    assert source.updates == 2**24 + 1


def test_the_twin_critics_start_different_and_the_targets_equal_to_them() -> None:
    source = learner()
    online = source.loss.qvalue_network_params.flatten_keys(".")
    target = source.loss.target_qvalue_network_params.flatten_keys(".")
    for name in online.keys():
        if name.endswith("weight"):
            assert not torch.equal(online[name][0], online[name][1]), name
        assert torch.equal(online[name], target[name]), name


def test_the_targets_follow_by_tau() -> None:
    source = learner(SacSettings(hidden=(16, 16), tau=0.1))
    before = source.loss.target_qvalue_network_params.flatten_keys(".").clone()
    source.update(batch())
    online = source.loss.qvalue_network_params.flatten_keys(".")
    for name, value in source.loss.target_qvalue_network_params.flatten_keys(".").items():
        torch.testing.assert_close(value.data, torch.lerp(before[name], online[name].data, 0.1))


def test_critics_learn_the_reward_of_terminal_transitions() -> None:
    source, transitions = learner(SacSettings(hidden=(64, 64), learning_rate=3e-3)), batch(terminated=True)
    losses = [float(source.update(transitions)["loss_qvalue"]) for _ in range(200)]
    assert losses[-1] < 0.05 * losses[0]


# temperature


def test_the_temperature_does_not_fall_below_its_floor() -> None:
    """A target far below any entropy pulls the temperature down as fast as it can."""
    settings = {"hidden": (16, 16), "init_alpha": 0.02, "learning_rate": 0.05, "target_entropy": -50.0}
    alphas = {}
    for floor in (0.0, 0.01):
        source = learner(SacSettings(**settings, alpha_floor=floor))
        alphas[floor] = [float(source.update(batch(k))["alpha"]) for k in range(60)]
    assert min(alphas[0.0]) < 0.005
    assert min(alphas[0.01]) == pytest.approx(0.01, rel=1e-5)
    assert alphas[0.01][0] == pytest.approx(0.02)


def test_the_temperature_comes_off_its_floor_when_entropy_is_wanted() -> None:
    source = learner(
        SacSettings(hidden=(16, 16), init_alpha=0.01, alpha_floor=0.01, learning_rate=0.05, target_entropy=9.0)
    )
    assert [float(source.update(batch(k))["alpha"]) for k in range(40)][-1] > 0.02


def test_the_target_entropy_is_minus_the_number_of_actions() -> None:
    assert float(learner().loss.target_entropy) == -2.0


# the temporal-difference target


@norms
@pytest.mark.parametrize("flags", [{}, {"truncated": True}, {"terminated": True}], ids=["goes on", "cap", "goal"])
def test_the_target_bootstraps_through_truncation_and_not_through_termination(
    flags: dict[str, bool], layer_norm: bool, without_noise: None
) -> None:
    source = learner(SacSettings(hidden=(16, 16), layer_norm=layer_norm, init_alpha=0.2, discount=0.9))
    for k in range(3):
        source.update(batch(k))
    alpha = float(source.loss.log_alpha.detach().exp())
    transitions = batch(7, **flags)
    following = transitions["next"]
    with torch.no_grad():
        loc, scale = source.actor(following["observation"])
        before = loc + 0.3 * scale
        action = torch.tanh(before)
        gaussian = torch.distributions.Normal(loc, scale)
        log_prob = (gaussian.log_prob(before) - torch.log1p(-action.square())).sum(-1, keepdim=True)
        values = [critic(following["observation"], action) for critic in unstacked_targets(source)]
        bootstrap = 0.9 * (torch.minimum(*values) - alpha * log_prob)
        target = following["reward"] + (0.0 if flags.get("terminated") else bootstrap)
        online = source.loss.qvalue_network_params["module"].flatten_keys(".")
        estimates = []
        for which, critic in enumerate(unstacked_targets(source)):
            critic.load_state_dict({name: online[name][which] for name in critic.state_dict()})
            estimates.append(critic(transitions["observation"], transitions["action"]))
        errors = torch.stack(estimates) - target
    out = source.loss(transitions)
    expected = {
        "loss_qvalue": errors.square().mean((1, 2)).sum(),
        "q_value": torch.stack(estimates).mean(),
        "td_error": errors.abs().mean(),
    }
    for name, value in expected.items():
        torch.testing.assert_close(out[name].detach(), value, rtol=1e-4, atol=1e-5)


@norms
def test_the_losses_and_their_gradients_are_those_of_torchrl(layer_norm: bool, without_noise: None) -> None:
    source = learner(SacSettings(hidden=(16, 16), layer_norm=layer_norm, init_alpha=0.3, alpha_floor=0.01))
    source.update(batch(1))
    transitions = batch(2)
    transitions["next", "terminated"][::3] = True
    results = []
    for forward in (SACLoss.forward, type(source.loss).forward):
        source.loss.zero_grad(set_to_none=True)
        out = forward(source.loss, transitions)
        (out["loss_actor"] + out["loss_qvalue"] + out["loss_alpha"]).backward()
        gradients = [weight.grad.clone() for weight in source.loss.parameters()]
        results.append(([out[name].detach() for name in ("loss_actor", "loss_qvalue", "loss_alpha")], gradients))
    for theirs, ours in zip(*results, strict=True):
        for one, other in zip(theirs, ours, strict=True):
            torch.testing.assert_close(one.reshape(other.shape), other, rtol=1e-4, atol=1e-6)


@norms
def test_products_in_bfloat16_change_losses_and_gradients_by_no_more_than_their_rounding(
    layer_norm: bool, without_noise: None
) -> None:
    gradients, losses = [], []
    for precision in ("float32", "bfloat16"):
        source = learner(SacSettings(hidden=(64, 64), layer_norm=layer_norm, init_alpha=0.3, precision=precision))
        out = source.loss.differentiate(batch(2, size=256))
        losses.append(torch.stack([out[name].detach() for name in ("loss_actor", "loss_qvalue", "loss_alpha")]))
        gradients.append(source.loss.weights.grad.clone())
    torch.testing.assert_close(*losses, rtol=0.01, atol=0.01)
    assert (gradients[1] - gradients[0]).norm() < 0.02 * gradients[0].norm()
    assert not torch.equal(*gradients)


def test_an_update_takes_batches_of_any_size() -> None:
    mixed, fresh = learner(), learner()
    for size in (12, 5, 12):
        torch.manual_seed(1)
        mixed.loss.differentiate(batch(3, size=size))
    torch.manual_seed(1)
    fresh.loss.differentiate(batch(3, size=12))
    assert torch.equal(mixed.loss.weights.grad, fresh.loss.weights.grad)


def test_a_loss_whose_parameters_share_memory_refuses_to_be_moved() -> None:
    with pytest.raises(RuntimeError, match="device"):
        learner().loss.to(torch.float64)


def test_the_optimiser_steps_as_adam_of_torch_does() -> None:
    source = learner(SacSettings(hidden=(16, 16), learning_rate=0.01))
    weights = source.loss.weights.detach().clone().requires_grad_()
    adam = torch.optim.Adam([weights], 0.01, fused=True)
    for k in range(3):
        source.update(batch(k))
        weights.grad = source.loss.weights.grad.clone()
        adam.step()
    assert torch.equal(source.loss.weights, weights)


def test_rectifying_by_bits_is_rectifying() -> None:
    edges = [0.0, -0.0, 1e-40, -1e-40, 2.5, -2.5, torch.inf, -torch.inf, torch.nan]
    values = torch.cat([torch.tensor(edges), torch.randn(100)]).to(torch.bfloat16)
    assert_close(_rectify(values.clone()), values.relu(), rtol=0, atol=0, equal_nan=True)


# checkpoints


def test_a_restored_learner_continues_to_the_bit(tmp_path: object) -> None:
    source = learner(SacSettings(hidden=(16, 16), alpha_floor=0.01))
    for k in range(3):
        source.update(batch(k))
    path = tmp_path / "learner.pt"
    torch.save(source.state_dict(), path)
    restored = learner(source.settings, seed=99)
    restored.load_state_dict(torch.load(path, weights_only=True))
    assert restored.updates == 3
    for k in (3, 4):
        metrics = []
        for one in (source, restored):
            torch.manual_seed(k)
            metrics.append(one.update(batch(k)))
        for name, value in metrics[0].items():
            assert torch.equal(value, metrics[1][name]), name
        left, right = snapshot(source), snapshot(restored)
        assert all(torch.equal(left[name], right[name]) for name in left)
    observation = batch(5)["observation"]
    assert torch.equal(source.actor.mean_action(observation), restored.actor.mean_action(observation))


def test_the_actor_that_acts_is_the_one_that_learns() -> None:
    source = learner()
    observation = batch(5)["observation"]
    before = source.actor.mean_action(observation)
    source.update(batch())
    after = source.actor.mean_action(observation)
    assert not torch.equal(before, after)
    acting = source.policy(TensorDict({"observation": observation}, [12]))
    assert torch.equal(torch.tanh(acting["loc"]), after)


# networks


def test_actions_and_spreads_stay_in_their_bounds_for_any_observation() -> None:
    torch.manual_seed(0)
    actor = Actor(LAYOUT, 2, (16, 16), layer_norm=False)
    nn.init.normal_(actor.head.weight, std=50.0)
    wild = torch.randn(64, LAYOUT.size) * 1e6
    _, scale = actor(wild)
    assert torch.isfinite(scale).all()
    assert scale.min() >= 0.99 * torch.tensor(-5.0).exp() and scale.max() <= 1.01 * torch.tensor(2.0).exp()
    assert actor.mean_action(wild).abs().max() <= 1.0
    policy = learner().policy
    assert policy(TensorDict({"observation": wild}, [64]))["action"].abs().max() <= 1.0


def test_observations_are_scaled_inside_the_networks() -> None:
    torch.manual_seed(0)
    actor = Actor(LAYOUT, 2, (16, 16), layer_norm=False)
    raw = torch.zeros(1, LAYOUT.size)
    column = LAYOUT.slices["accelerometer"].start
    raw[0, column] = 9.81
    hidden = actor.trunk.layers(raw * torch.from_numpy(LAYOUT.scale))
    torch.testing.assert_close(actor.trunk(raw), hidden)
    raw[0, column] = 1e9
    clipped = torch.zeros(1, LAYOUT.size)
    clipped[0, column] = 10.0
    torch.testing.assert_close(actor.trunk(raw), actor.trunk.layers(clipped))


def test_the_floor_of_the_temperature_falls_over_the_second_half_of_training() -> None:
    overrides = ["skill.alpha_floor=0.02", "skill.alpha_floor_end=0.002", "skill.total_steps=10000"]
    skill = load_config(overrides=overrides).skill
    floors = [alpha_floor(skill, steps) for steps in (0, 5000, 7500, 10_000)]
    assert floors == pytest.approx([0.02, 0.02, 0.02 * 10**-0.5, 0.002])
    assert alpha_floor(load_config(overrides=overrides[:1]).skill, 10**6) == 0.02


def test_the_temperature_is_lifted_to_its_floor() -> None:
    learner = make_learner(load_config())
    learner.set_alpha_floor(3.0)
    assert float(learner.loss._alpha) == pytest.approx(3.0)


def test_every_setting_of_the_skill_s_training_reaches_its_learner() -> None:
    wanted = {
        "hidden": (24, 8), "discount": 0.9, "tau": 0.02, "learning_rate": 1e-3, "init_alpha": 0.3, "alpha_floor": 0.02,
        "target_entropy": -0.5, "actor_average": 7, "layer_norm": True, "precision": "float32",
    }  # fmt: skip
    texts = {**wanted, "hidden": "[24, 8]", "layer_norm": "true"}
    made = make_learner(load_config(None, ["skill.device=cpu", *(f"skill.{k}={text}" for k, text in texts.items())]))
    assert asdict(made.settings) == wanted
    assert float(made.loss.value_estimator.gamma) == pytest.approx(0.9)
    assert float(made.loss.target_entropy) == -0.5
    assert float(made.loss._alpha) == pytest.approx(0.3)
    assert made.average is not made.actor
    assert made.loss.qvalue_network_params["module", "trunk", "layers", "1", "weight"].shape == (2, 24), "a layer norm"


def test_the_exported_actor_is_the_mean_of_the_last_ones() -> None:
    one = learner(SacSettings(hidden=(16, 16), actor_average=4))
    assert one.average is not one.actor
    seen = []
    for seed in range(3):
        one.update(batch(seed))
        seen.append(one.actor.head.weight.detach().clone())
    one.publish()
    assert_close(one.average.head.weight, sum(seen) / 3)
    assert not torch.equal(seen[0], seen[1]), "the actors differ"
    other = learner(SacSettings(hidden=(16, 16), actor_average=4), seed=1)
    other.load_state_dict(one.state_dict())
    assert_close(other.average.head.weight, one.average.head.weight)


def test_the_average_forgets_what_lies_farther_back_than_it_is_long() -> None:
    one, seen = learner(SacSettings(hidden=(16, 16), actor_average=2)), []
    for seed in range(4):
        one.update(batch(seed))
        seen.append(one.actor.head.weight.detach().clone())
    one.publish()
    mean = (seen[0] + seen[1]) / 2
    for last in seen[2:]:
        mean = (mean + last) / 2
    assert_close(one.average.head.weight, mean)


def test_without_averaging_the_last_actor_is_exported() -> None:
    one = learner()
    assert one.average is one.actor
