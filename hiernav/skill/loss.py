"""torchrl's SACLoss, computed without the detours.

SACLoss swaps parameters into modules and maps over the twin critics with functorch at every call, which costs as much
time as the matrix products at these sizes. This subclass keeps its interface, parameters, target networks and
temperature, and evaluates the same three losses directly on the stacked parameters of our own networks.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch.nn import functional
from torchrl.objectives import SACLoss

from hiernav.skill.networks import LOG_STD_RANGE, OBSERVATION_CLIP

Layer = tuple[torch.Tensor, torch.Tensor, bool]
"""Weight, bias, and whether a ReLU follows. A weight with one axis less than a product's is a layer norm's."""


class DirectSACLoss(SACLoss):
    """SACLoss for `hiernav.skill.networks`: same values and gradients for the same noise.

    The temporal-difference target is that of TD(0): bootstrap through truncation, not through termination.

    Args:
        precision: of the products in hidden layers. Weights, heads, distributions and losses stay in float32.
    """

    def __init__(self, *args: Any, precision: torch.dtype = torch.float32, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._reduced = precision != torch.float32
        self._precision = precision
        actor = self.actor_network_params["module", "0", "module"]
        self._scales = [actor["trunk", "scale"]]  # a bare tensor would be registered as one more buffer
        self._actor = _layers(actor)
        self._critics = _layers(self.qvalue_network_params["module"])
        self._targets = _layers(self.target_qvalue_network_params["module"])
        self._frozen = [(weight.detach(), bias.detach(), relu) for weight, bias, relu in self._critics]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        with torch.autocast(self._scales[0].device.type, self._precision, enabled=self._reduced):
            return self._losses(tensordict)

    def _losses(self, tensordict: TensorDictBase) -> TensorDictBase:
        alpha, following = self._alpha, tensordict["next"]
        now = self._scaled(tensordict["observation"])
        with torch.no_grad():
            later = self._scaled(following["observation"])
            next_action, next_log_prob = _sample(self._actor, later)
            value = _values(self._targets, later, next_action).amin(0) - alpha * next_log_prob
            target = following["reward"] + self.value_estimator.gamma * ~following["terminated"] * value
        values = _values(self._critics, now, tensordict["action"])
        errors = values - target
        sampled, log_prob = _sample(self._actor, now)
        merit = _values(self._frozen, now, sampled).amin(0)
        surprise = log_prob.detach().mean()
        return TensorDict(
            {
                "loss_actor": (alpha * log_prob - merit).mean(),
                "loss_qvalue": errors.square().sum(0).mean(),
                "loss_alpha": -self.log_alpha * (surprise + self.target_entropy),
                "alpha": alpha,
                "entropy": -surprise,
                "q_value": values.detach().mean(),
                "td_error": errors.detach().abs().mean(),
            },
            [],
        )

    def _scaled(self, observation: torch.Tensor) -> torch.Tensor:
        return (observation * self._scales[0]).clamp(-OBSERVATION_CLIP, OBSERVATION_CLIP)


def _layers(tree: TensorDictBase) -> list[Layer]:
    """Layers of a network of ours in order, its head last."""
    trunk = tree["trunk", "layers"]
    keys = sorted(trunk.keys(), key=int)
    layers = [(trunk[k, "weight"], trunk[k, "bias"], str(int(k) + 1) not in keys) for k in keys]
    return [*layers, (tree["head", "weight"], tree["head", "bias"], False)]


def _sample(layers: list[Layer], scaled: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Actions (B, A) of the tanh-Gaussian, reparameterised, and their log-probability (B, 1)."""
    hidden = scaled
    for weight, bias, relu in layers[:-1]:
        hidden = functional.linear(hidden, weight, bias)
        hidden = hidden.relu() if relu else hidden
    weight, bias, _ = layers[-1]
    with torch.autocast(hidden.device.type, enabled=False):
        loc, raw = functional.linear(hidden.float(), weight, bias).chunk(2, dim=-1)
    low, high = LOG_STD_RANGE
    log_std = low + 0.5 * (high - low) * (torch.tanh(raw) + 1.0)
    noise = torch.randn_like(loc)
    before = loc + log_std.exp() * noise
    # log N(before) minus log |d tanh| = 2 (log 2 - before - softplus(-2 before))
    log_prob = -0.5 * noise.square() - log_std + 2.0 * (before + functional.softplus(-2.0 * before))
    constant = -0.5 * math.log(2.0 * math.pi) - 2.0 * math.log(2.0)
    return torch.tanh(before), log_prob.sum(-1, keepdim=True) + constant * loc.shape[-1]


def _values(layers: list[Layer], scaled: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    """Values (2, B, 1) of both critics."""
    hidden = torch.cat([scaled, action], dim=-1).expand(2, -1, -1)
    for weight, bias, relu in layers[:-1]:
        if weight.ndim == 3:
            hidden = torch.baddbmm(bias[:, None], hidden, weight.mT)
        else:
            hidden = functional.layer_norm(hidden, hidden.shape[-1:]) * weight[:, None] + bias[:, None]
        hidden = hidden.relu() if relu else hidden
    weight, bias, _ = layers[-1]
    with torch.autocast(hidden.device.type, enabled=False):
        return torch.baddbmm(bias[:, None], hidden.float(), weight.mT)
