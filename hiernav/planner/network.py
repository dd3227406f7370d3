"""Waypoint networks: the paper's, and a default that knows where obstacles are.

Both take GOSELO images (N, C, 64, 64) uint8 and distances L (N,) [m] and return waypoints (N, H, K, 2) in the GOSELO
frame (right, up of the robot; metres) with scores (N, H) of the H hypotheses.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from hiernav.nav import goselo

Output = tuple[torch.Tensor, torch.Tensor]


class PaperNetwork(nn.Module):
    """The published network (paper appendix, Table IV): 78,964 parameters for six channels and ten waypoints."""

    channels = goselo.CHANNELS

    def __init__(self, waypoints: int = 10) -> None:
        super().__init__()
        self.waypoints = waypoints
        self.features = nn.Sequential(_down(len(self.channels), 32), _down(32, 64), _down(64, 64))
        self.head = nn.Sequential(nn.Linear(64, 256), nn.ReLU(), nn.Linear(256, 2 * waypoints))

    def forward(self, image: torch.Tensor, distance: torch.Tensor) -> Output:
        pooled = self.features(image.float() / 255.0).mean(dim=(2, 3))
        waypoints = self.head(pooled).float().view(-1, 1, self.waypoints, 2)
        return waypoints, torch.zeros_like(waypoints[:, :, 0, 0])


class HypothesisNetwork(nn.Module):
    """Several plans, each a chain of unit headings.

    Departs from the paper where it has no chance to know better: features keep their position (no pooling), the
    metric surroundings of the robot and L are inputs, steps have the length of the spacing, and several hypotheses
    stand side by side because the mean of a way left and a way right of a pillar leads into it. Patches of 4 x 4 pixels
    come first: half the arithmetic of two strided convolutions, and no plan is worse for it.
    """

    channels = goselo.METRIC_CHANNELS

    def __init__(self, waypoints: int = 10, spacing: float = 0.1, hypotheses: int = 6) -> None:
        super().__init__()
        self.waypoints, self.spacing, self.hypotheses = waypoints, spacing, hypotheses
        self.overview = nn.Sequential(_patches(3, 32), _down(32, 48), _squeeze(48, 8))
        self.local = nn.Sequential(_patches(1, 32), _down(32, 48), _squeeze(48, 16))
        self.trunk = nn.Sequential(nn.Linear(64 * (8 + 16) + 2, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU())
        self.head = nn.Linear(128, hypotheses * (2 * waypoints + 1))

    def forward(self, image: torch.Tensor, distance: torch.Tensor) -> Output:
        scaled = image.float() / 255.0
        near = torch.stack([distance.clamp(max=2.0), distance * 0.25], dim=-1)
        features = torch.cat([self.overview(scaled[:, :3]), self.local(scaled[:, 3:]), near], dim=-1)
        # float: in training the layers may compute in bfloat16, which is too coarse to add steps up
        out = self.head(self.trunk(features)).float().view(-1, self.hypotheses, 2 * self.waypoints + 1)
        heading = out[..., :-1].unflatten(-1, (self.waypoints, 2)) + out.new_tensor([0.0, 0.3])
        heading = heading / (heading.square().sum(-1, keepdim=True) + 1e-6).sqrt()
        chain = torch.cumsum(heading * self.spacing, dim=2)
        return self._stop_at_goal(chain, distance), functional.log_softmax(out[..., -1], dim=-1)

    def _stop_at_goal(self, chain: torch.Tensor, distance: torch.Tensor) -> torch.Tensor:
        """From the first waypoint within one spacing of the goal on, all waypoints are the goal."""
        goal = torch.stack([torch.zeros_like(distance), distance], dim=-1)[:, None, None]
        apart = (chain - goal).square().sum(-1).sqrt()
        arrived = torch.cumsum((apart < self.spacing).to(chain.dtype), dim=2) > 0
        return torch.where(arrived[..., None], goal, chain)


class TorchNetwork:
    """A waypoint network as `hiernav.nav.planners.Network`: numpy in and out, computed where the weights are."""

    def __init__(self, network: nn.Module) -> None:
        self.network = network.eval()

    @torch.no_grad()
    def __call__(self, image: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        device = next(self.network.parameters()).device
        waypoints, scores = self.network(torch.from_numpy(image).to(device), torch.from_numpy(distance).to(device))
        return waypoints.cpu().numpy(), scores.cpu().numpy()


def make_network(preset: str, waypoints: int, spacing: float, hypotheses: int) -> PaperNetwork | HypothesisNetwork:
    """A new network of a preset, "paper" or "default"."""
    if preset == "paper":
        return PaperNetwork(waypoints)
    return HypothesisNetwork(waypoints, spacing, hypotheses)


def _down(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, stride=2, padding=1), nn.ReLU())


def _patches(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 4, stride=4), nn.ReLU())


def _squeeze(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 1), nn.ReLU(), nn.Flatten())
