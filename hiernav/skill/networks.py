"""Actor and critics: two hidden layers on scaled raw observations."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn

from hiernav.nav.observation import ObservationLayout

LOG_STD_RANGE = (-5.0, 2.0)
OBSERVATION_CLIP = 10.0


class Trunk(nn.Module):
    """Scale, clip and a ReLU network. The scale is the layout's, so that exported graphs take raw SI units."""

    def __init__(self, scale: torch.Tensor, extra: int, hidden: Sequence[int], layer_norm: bool) -> None:
        super().__init__()
        self.register_buffer("scale", scale)
        layers: list[nn.Module] = []
        size = len(scale) + extra
        for width in hidden:
            layers.append(nn.Linear(size, width))
            if layer_norm:
                layers.append(nn.LayerNorm(width))
            layers.append(nn.ReLU())
            size = width
        self.layers = nn.Sequential(*layers)

    def forward(self, observation: torch.Tensor, *extra: torch.Tensor) -> torch.Tensor:
        scaled = (observation * self.scale).clamp(-OBSERVATION_CLIP, OBSERVATION_CLIP)
        return self.layers(torch.cat([scaled, *extra], dim=-1))


class Actor(nn.Module):
    """Observation (N, D) -> location and scale (N, A) of a tanh-Gaussian."""

    def __init__(self, layout: ObservationLayout, action_dim: int, hidden: Sequence[int], layer_norm: bool) -> None:
        super().__init__()
        self.trunk = Trunk(torch.from_numpy(layout.scale), 0, hidden, layer_norm)
        self.head = nn.Linear(hidden[-1], 2 * action_dim)

    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        loc, raw = self.head(self.trunk(observation)).chunk(2, dim=-1)
        low, high = LOG_STD_RANGE
        return loc, (low + 0.5 * (high - low) * (torch.tanh(raw) + 1.0)).exp()

    def mean_action(self, observation: torch.Tensor) -> torch.Tensor:
        """Deterministic action (N, A) in [-1, 1]."""
        return torch.tanh(self(observation)[0])


class Critic(nn.Module):
    """Observation (N, D) and action (N, A) -> value (N, 1)."""

    def __init__(self, layout: ObservationLayout, action_dim: int, hidden: Sequence[int], layer_norm: bool) -> None:
        super().__init__()
        self.trunk = Trunk(torch.from_numpy(layout.scale), action_dim, hidden, layer_norm)
        self.head = nn.Linear(hidden[-1], 1)

    def forward(self, observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return self.head(self.trunk(observation, action))
