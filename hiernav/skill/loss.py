"""torchrl's SACLoss with its gradients written out.

SACLoss swaps parameters into modules and maps over the twin critics with functorch at every call, and leaves the
gradients to autograd; at these sizes that takes longer than the matrix products. This subclass keeps its interface,
parameters, target networks and temperature, and computes the same losses and gradients on `Perceptrons`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch.nn import functional
from torchrl.objectives import SACLoss

from hiernav.skill.networks import LOG_STD_RANGE, OBSERVATION_CLIP
from hiernav.skill.perceptrons import Perceptrons, count, parameters


class _Memory(NamedTuple):
    """What the parameters are views of."""

    weights: torch.Tensor
    """(n,) float32: the actor, the critics, log_alpha; its `grad` is where `differentiate` leaves their gradients."""
    critics: torch.Tensor
    """(m,) the critics' part of it."""
    targets: torch.Tensor
    """(m,) of the target critics."""
    by_log_alpha: torch.Tensor
    """Scalar, the last of the gradients."""


class DirectSACLoss(SACLoss):
    """SACLoss for `hiernav.skill.networks`: same values and gradients for the same noise.

    The temporal-difference target is that of TD(0): bootstrap through truncation, not through termination.

    Args:
        precision: of the products. Weights, outputs, distributions and losses stay in float32.
    """

    def __init__(self, *args: Any, precision: torch.dtype = torch.float32, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        actor = self.actor_network_params["module", "0", "module"]
        critics, targets = self.qvalue_network_params["module"], self.target_qvalue_network_params["module"]
        self._sizes = [count(actor), count(critics), 1]
        weights = torch.zeros(sum(self._sizes), device=self.log_alpha.device, requires_grad=True)
        weights.grad = torch.zeros_like(weights)
        places, gradients = weights.detach().split(self._sizes), weights.grad.split(self._sizes)
        self.log_alpha.data = places[2].copy_(self.log_alpha.data)[0]
        # in tuples, because a bare tensor would be registered as one more parameter
        self._memory = _Memory(weights, places[1], torch.zeros_like(places[1]), gradients[2][0])
        self._actor = Perceptrons(actor, places[0], gradients[0], precision)
        self._critics = Perceptrons(critics, places[1], gradients[1], precision)
        self._targets = Perceptrons(targets, self._memory.targets, precision=precision)
        self._scale = (actor["trunk", "scale"],)
        self._learning = (*parameters(actor), *parameters(critics))

    @property
    def weights(self) -> torch.Tensor:
        """(n,) all parameters in one piece, for an optimiser."""
        return self._memory.weights

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The losses of SACLoss, to be differentiated by autograd."""
        out = {name: value.clone() for name, value in self.differentiate(tensordict).items()}
        gradients, actor = self.weights.grad.clone(), self._sizes[0]
        zeros, start = {"loss_actor": 0.0, "loss_qvalue": 0.0}, 0
        for parameter in self._learning:
            gradient = gradients[start : start + parameter.numel()].view(parameter.shape)
            name = "loss_actor" if start < actor else "loss_qvalue"
            zeros[name] += (gradient * (parameter - parameter.detach())).sum()
            start += parameter.numel()
        out |= {name: out[name] + zero for name, zero in zeros.items()}
        out["loss_alpha"] = -self.log_alpha * (self.target_entropy - out["entropy"])
        return TensorDict(out, [])

    @torch.inference_mode()
    def differentiate(self, batch: TensorDictBase) -> dict[str, torch.Tensor]:
        """Losses and what else SACLoss reports for a batch (B,) of transitions, without autograd.

        The gradients of the losses' sum are left in `weights.grad`.
        """
        alpha, following, size = self._alpha, batch["next"], len(batch)
        for networks in (self._actor, self._critics, self._targets):
            networks.read_weights()

        # actions for the states, then for those that follow
        scaled = torch.cat([batch["observation"], following["observation"]]).mul_(self._scale[0])
        scaled.clamp_(-OBSERVATION_CLIP, OBSERVATION_CLIP)
        actions = _Actions(*self._actor.forward(scaled)[0].chunk(2, dim=-1))

        # the critics judge the actions of the policy and, behind them, those of the batch
        pairs = torch.cat([scaled, actions.action], dim=-1)
        pairs, later = pairs[:size], pairs[size:]
        judged = self._critics.forward(torch.cat([pairs, torch.cat([scaled[:size], batch["action"]], dim=-1)]))
        merits, values = judged[:, :size], judged[:, size:]

        # critics: mean squared distance to reward and discounted soft value
        value = self._targets.forward(later).amin(0)
        value -= alpha * actions.log_prob[size:]
        errors = values - (following["reward"] + self.value_estimator.gamma * ~following["terminated"] * value)
        self._critics.backward(errors * (2.0 / size), slice(size, None))

        # actor: mean of alpha log pi less the smaller value; the gradient passes through the critic it is of
        merit, which = merits.min(0, keepdim=True)
        chosen = torch.zeros_like(merits).scatter_(0, which, -1.0 / size)
        by_action = self._critics.backward_to_inputs(chosen, slice(size), slice(scaled.shape[-1], None))
        self._actor.backward(actions.slope(by_action, alpha / size)[None], slice(size))
        log_prob = actions.log_prob[:size]

        # temperature: until the entropy is the target
        surprise = log_prob.mean()
        excess = surprise + self.target_entropy
        torch.neg(excess, out=self._memory.by_log_alpha)
        return {
            "loss_actor": alpha * surprise - merit.mean(),
            "loss_qvalue": errors.square().mean() * len(errors),
            "loss_alpha": -self.log_alpha * excess,
            "alpha": alpha,
            "entropy": -surprise,
            "q_value": values.mean(),
            "td_error": errors.abs().mean(),
        }

    def _apply(self, *args: Any, **kwargs: Any) -> DirectSACLoss:
        raise RuntimeError("the parameters share one piece of memory: build the loss on the device that it is for")

    @torch.no_grad()
    def move_targets(self, tau: float) -> None:
        """Let the target critics follow the critics by a share of what is between them."""
        self._memory.targets.lerp_(self._memory.critics, tau)


class _Actions:
    """Draws from tanh-Gaussians, reparameterised: for `loc` and `raw` spread (N, A), an action and how it came about.

    Attributes:
        action: (N, A) in [-1, 1].
        log_prob: (N, 1) of its density.
    """

    def __init__(self, loc: torch.Tensor, raw: torch.Tensor) -> None:
        low, high = LOG_STD_RANGE
        self._squashed = torch.tanh(raw)
        log_std = low + 0.5 * (high - low) * (self._squashed + 1.0)
        noise = torch.randn_like(loc)
        self._stretched = log_std.exp() * noise
        before = loc + self._stretched
        self.action = torch.tanh(before)
        # log N(before) minus log |d tanh| = 2 (log 2 - before - softplus(-2 before))
        log_prob = -0.5 * noise.square() - log_std + 2.0 * (before + functional.softplus(-2.0 * before))
        constant = -0.5 * math.log(2.0 * math.pi) - 2.0 * math.log(2.0)
        self.log_prob = log_prob.sum(-1, keepdim=True) + constant * loc.shape[-1]

    def slope(self, by_action: torch.Tensor, by_log_prob: torch.Tensor) -> torch.Tensor:
        """Derivative (R, 2A) of a loss by `loc` and `raw` of the first R draws.

        `by_action` (R, A) and `by_log_prob` (scalar) are its derivatives by an action and by every log-probability.
        """
        low, high = LOG_STD_RANGE
        rows = len(by_action)
        action, squashed = self.action[:rows], self._squashed[:rows]
        # d log_prob / d before = 2 tanh(before)
        by_loc = by_action * (1.0 - action.square()) + 2.0 * by_log_prob * action
        by_log_std = by_loc * self._stretched[:rows] - by_log_prob
        return torch.cat([by_loc, by_log_std * (1.0 - squashed.square()) * (0.5 * (high - low))], dim=-1)
