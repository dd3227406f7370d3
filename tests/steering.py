"""A skill for the point robot that needs no training: it turns towards the fifth waypoint and drives when facing it."""

from __future__ import annotations

import torch
from torch import nn

from hiernav.config import TrainConfig
from hiernav.sim.robots import get_robot
from hiernav.skill.networks import Actor
from hiernav.skill.train import skill_layout

FORWARD, TURN = 0, 1
_WAYPOINT = 4


@torch.no_grad()
def steering_actor(config: TrainConfig) -> Actor:
    """An actor of the configured size whose weights were set by hand; reaches goals among few pillars."""
    layout = skill_layout(config)
    actor = Actor(layout, get_robot(config.robot).action_dim, config.skill.hidden, layer_norm=False)
    for weight in actor.parameters():
        weight.zero_()
    ahead = layout.slices["waypoints"].start + 2 * _WAYPOINT
    left = ahead + 1
    first, *others = [layer for layer in actor.trunk.layers if isinstance(layer, nn.Linear)]
    for unit, (sensor, sign) in enumerate(((left, 1.0), (left, -1.0), (ahead, 1.0))):  # ReLU keeps one side each
        first.weight[unit, sensor] = 2.0 * sign / float(layout.scale[sensor])
    for layer in others:
        layer.weight[:3, :3] = torch.eye(3)
    actor.head.weight[FORWARD, :3] = torch.tensor([-2.0, -2.0, 10.0])
    actor.head.weight[TURN, :3] = torch.tensor([4.0, -4.0, 0.0])
    return actor.eval()
