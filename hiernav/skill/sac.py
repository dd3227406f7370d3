"""Soft actor-critic on torchrl's SACLoss: networks, one update, and what a checkpoint holds."""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDict
from tensordict.nn import InteractionType, TensorDictModule
from torch.nn.utils import parameters_to_vector, vector_to_parameters
from torch.optim.adam import adam
from torchrl.data import Bounded
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ValueEstimators

from hiernav.device import choose_precision
from hiernav.nav.observation import ObservationLayout
from hiernav.skill.loss import DirectSACLoss
from hiernav.skill.networks import Actor, Critic


@dataclass(frozen=True)
class SacSettings:
    """Hyper-parameters of the learner (paper appendix, after Haarnoja et al. 2018)."""

    hidden: Sequence[int] = (256, 256)
    discount: float = 0.99
    tau: float = 0.005
    learning_rate: float = 3e-4
    init_alpha: float = 1.0
    alpha_floor: float = 0.0
    """The temperature is kept at or above this."""
    target_entropy: float | None = None
    """None: minus the number of actions."""
    actor_average: int = 0
    """Updates that the exported actor is averaged over (Polyak and Juditsky 1992); 0: it is the last one."""
    layer_norm: bool = False
    """Layer normalisation in the critics (beyond the paper)."""
    precision: str = "float32"
    """Of the products in hidden layers: "float32", "bfloat16", or "auto" for what the processor is faster at."""


# Learner moves the targets itself: one fused operation instead of torchrl's updater, which takes ten times as long.
warnings.filterwarnings("ignore", "No target network updater", UserWarning)


_LEAST_ALPHA = 1e-8


class Learner:
    """Actor, twin critics, temperature and their optimiser.

    The three losses touch disjoint parameters, so one backward pass and one optimiser step serve all. `actor` and
    `policy` act on the processor, beside the simulations, and `average` is the actor to export; what learns on a GPU is
    a copy of them, see `publish`.

    Args:
        layout: of the observation.
        action_dim: number of actions.
        settings: hyper-parameters.
        device: that updates are computed on.
    """

    def __init__(
        self,
        layout: ObservationLayout,
        action_dim: int,
        settings: SacSettings,
        device: torch.device | str = "cpu",
    ) -> None:
        self.settings, self.device = settings, torch.device(device)
        self.actor = self._learning = Actor(layout, action_dim, settings.hidden, layer_norm=False)
        self.policy = learning = make_policy(self.actor, action_dim)
        self.average = self._averaging = copy.deepcopy(self.actor) if settings.actor_average else self.actor
        critic = Critic(layout, action_dim, settings.hidden, settings.layer_norm)
        if self.device.type != "cpu":
            self._learning = copy.deepcopy(self.actor).to(self.device)
            self._averaging = copy.deepcopy(self.average).to(self.device) if settings.actor_average else self._learning
            learning = make_policy(self._learning, action_dim)
        self.loss = DirectSACLoss(
            learning,
            ValueOperator(critic.to(self.device), in_keys=["observation", "action"]),
            precision=choose_precision(settings.precision, self.device),
            loss_function="l2",
            alpha_init=settings.init_alpha,
            min_alpha=max(settings.alpha_floor, _LEAST_ALPHA),
            target_entropy=-float(action_dim) if settings.target_entropy is None else settings.target_entropy,
            action_spec=Bounded(-1.0, 1.0, (action_dim,)),
        )
        self.loss.make_value_estimator(ValueEstimators.TD0, gamma=settings.discount)
        self._optimizer = _Adam(self.loss.weights, settings.learning_rate)
        # on the device, where recorded updates count it; Adam's own, in float32, ends at 16,777,216
        self._updates = torch.zeros((), dtype=torch.int64, device=self.device)
        # of the averaged actor, in one piece and in the order in which the loss has the actor's
        self._mean = parameters_to_vector(self._averaging.parameters()).detach().clone()
        self._last = self.loss.weights.detach()[: len(self._mean)]
        if self._averaging is not self._learning:
            vector_to_parameters(self._mean, self._averaging.parameters())

    def update(self, batch: TensorDict) -> dict[str, torch.Tensor]:
        """One gradient step on a batch (B,) of transitions; returns detached scalars, both on the learner's device."""
        metrics = self.loss.differentiate(batch)
        self._optimizer.step()
        self.loss.move_targets(self.settings.tau)
        self._updates += 1
        if self._averaging is not self._learning:
            # the mean of all actors at first, so that the untrained one leaves no trace
            share = self._updates.clamp(max=self.settings.actor_average).reciprocal()
            self._mean.lerp_(self._last, share)
        return metrics

    @property
    def updates(self) -> int:
        """Gradient steps so far."""
        return int(self._updates)

    @property
    def finite(self) -> bool:
        """Whether all weights and the temperature are."""
        return bool(self.loss.weights.isfinite().all())

    def publish(self) -> None:
        """Let `policy` and `average` have the weights learnt so far; where they are what learns, they have them."""
        for shown, learning in ((self.actor, self._learning), (self.average, self._averaging)):
            if learning is not shown:
                shown.load_state_dict(learning.state_dict())

    def set_alpha_floor(self, floor: float) -> None:
        """Keep the temperature at or above `floor`; 0 lets it fall freely."""
        self.loss.min_log_alpha.fill_(math.log(max(floor, _LEAST_ALPHA)))

    def state_dict(self) -> dict:
        """Everything a resumed run needs of the learner."""
        return {
            "loss": self.loss.state_dict(),
            "average": self._averaging.state_dict(),
            "optimizer": self._optimizer.state,
            "updates": self.updates,
        }

    def load_state_dict(self, state: dict) -> None:
        self.loss.load_state_dict(state["loss"])
        self._averaging.load_state_dict(state["average"])
        for name, value in self._optimizer.state.items():
            value.copy_(state["optimizer"][name])
        self._updates.fill_(state["updates"])
        self.publish()


class _Adam:
    """torch's fused Adam on one tensor; what `torch.optim.Adam` does around it takes two thirds of its time again."""

    def __init__(self, weights: torch.Tensor, learning_rate: float) -> None:
        self._weights, self._learning_rate = weights, learning_rate
        self.state = {
            "step": torch.zeros((), device=weights.device),
            "mean": torch.zeros_like(weights, requires_grad=False),
            "mean_square": torch.zeros_like(weights, requires_grad=False),
        }

    @torch.no_grad()
    def step(self) -> None:
        adam(
            [self._weights],
            [self._weights.grad],
            [self.state["mean"]],
            [self.state["mean_square"]],
            [],
            [self.state["step"]],
            fused=True,
            amsgrad=False,
            beta1=0.9,
            beta2=0.999,
            lr=self._learning_rate,
            weight_decay=0.0,
            eps=1e-8,
            maximize=False,
        )


def make_policy(actor: Actor, action_dim: int) -> ProbabilisticActor:
    """The exploring policy of an actor: "observation" (N, D) -> "action" (N, A), drawn anew each time."""
    return ProbabilisticActor(
        TensorDictModule(actor, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -1.0, "high": 1.0, "tanh_loc": False, "safe_tanh": False},
        default_interaction_type=InteractionType.RANDOM,
        spec=Bounded(-1.0, 1.0, (action_dim,)),
    )
