"""The same SAC update as `hiernav.skill.sac`, hand-written in plain torch: the yardstick of `tools/bench.py`."""

from __future__ import annotations

import copy
import math

import torch
from tensordict import TensorDict
from torch.nn import functional

from hiernav.nav.observation import ObservationLayout
from hiernav.skill.networks import Actor, Critic


class PlainSac:
    """Twin critics as two modules, one Adam, no tensordict inside the update."""

    def __init__(
        self, layout: ObservationLayout, actions: int, hidden: tuple[int, ...] = (256, 256), device: str = "cpu"
    ) -> None:
        self.actor = Actor(layout, actions, hidden, layer_norm=False).to(device)
        self.critics = [Critic(layout, actions, hidden, layer_norm=False).to(device) for _ in range(2)]
        self.targets = copy.deepcopy(self.critics)
        self.log_alpha = torch.zeros((), requires_grad=True, device=device)
        self.target_entropy = -float(actions)
        critics = [p for critic in self.critics for p in critic.parameters()]
        self.optimizer = torch.optim.Adam([*self.actor.parameters(), *critics, self.log_alpha], lr=3e-4, fused=True)
        self._online, self._frozen = critics, [p for target in self.targets for p in target.parameters()]

    def update(self, batch: TensorDict) -> None:
        """One gradient step."""
        observation, action, following = batch["observation"], batch["action"], batch["next"]
        alpha = self.log_alpha.exp().detach()
        with torch.no_grad():
            next_action, next_log_prob = self._sample(following["observation"])
            value = torch.min(*(target(following["observation"], next_action) for target in self.targets))
            value = value - alpha * next_log_prob
            goal = following["reward"] + 0.99 * (~following["terminated"]).float() * value
        critic_loss = sum(functional.mse_loss(critic(observation, action), goal) for critic in self.critics)
        sampled, log_prob = self._sample(observation)
        for parameter in self._online:
            parameter.requires_grad_(False)
        merit = torch.min(*(critic(observation, sampled) for critic in self.critics))
        for parameter in self._online:
            parameter.requires_grad_(True)
        actor_loss = (alpha * log_prob - merit).mean()
        alpha_loss = -(self.log_alpha * (log_prob.detach() + self.target_entropy)).mean()
        self.optimizer.zero_grad(set_to_none=True)
        (critic_loss + actor_loss + alpha_loss).backward()
        self.optimizer.step()
        with torch.no_grad():
            torch._foreach_lerp_(self._frozen, self._online, 0.005)

    def _sample(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        loc, scale = self.actor(observation)
        noise = torch.randn_like(loc)
        raw = loc + scale * noise
        log_prob = -0.5 * noise.square() - scale.log() - 0.5 * math.log(2 * math.pi)
        log_prob = log_prob - 2.0 * (math.log(2.0) - raw - functional.softplus(-2.0 * raw))
        return torch.tanh(raw), log_prob.sum(-1, keepdim=True)
