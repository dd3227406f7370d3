"""Where workers run, and what a worker is: a torchrl collector of one process, here or on a node of a Ray cluster."""

from __future__ import annotations

import logging
import os
import signal
import threading
import warnings
from functools import partial
from typing import Any, Protocol

import numpy as np
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.modules import ProbabilisticActor

from hiernav.config import ConfigError, TrainConfig
from hiernav.nav.option import Planner
from hiernav.sim.factory import make_task, skill_layout
from hiernav.sim.robots import get_robot
from hiernav.skill.collect import training_layouts
from hiernav.skill.env import NavigationEnv
from hiernav.skill.networks import Actor
from hiernav.skill.sac import make_policy

Weights = dict[str, np.ndarray]

# Weights go with each order instead of through torchrl's schemes, which wait for a dead worker without end.
for message in ("The policy is not an nn.Module", "RayCollector iteration started before weight synchronization"):
    warnings.filterwarnings("ignore", message, UserWarning)


class WorkerCollector(Collector):
    """torchrl's Collector as it runs in a worker, with what the trainer asks of it."""

    _failure: Exception | None = None

    def begin(self, config: TrainConfig, place: tuple[int, ...]) -> None:
        """Start fresh episodes in the worlds, and with the noise, of a place in the run."""
        torch.manual_seed(int(np.random.SeedSequence((config.seed, 4, *place)).generate_state(1, np.uint64)[0]))
        self.env.task.draw_from(training_layouts(config, *place))
        self.reset()

    def load(self, weights: Weights) -> None:
        """Act with these weights from now on."""
        self.policy.load_state_dict({key: torch.tensor(value) for key, value in weights.items()})

    def rollout(self) -> TensorDict:
        """Steps of all simulations. An error waits for `check`: torchrl would let the process die of it, untold."""
        try:
            return super().rollout()
        except Exception as error:
            self._failure = error
            return self._final_rollout

    def check(self) -> None:
        """Raise what went wrong in the last rollout."""
        if self._failure is not None:
            raise self._failure

    def __repr__(self) -> str:
        """Short: Ray puts it before every line that the worker prints."""
        return type(self).__name__


class Machines(Protocol):
    """Where workers run."""

    deaths: tuple[type[Exception], ...]
    """What a collector raises when its worker is gone."""

    def start(self, random_frames: int) -> Any:
        """A new worker as a torchrl collector, which acts at random for so many frames before it asks its policy."""
        ...

    def close(self) -> None:
        """Leave them; after all workers are shut down."""
        ...


def find_machines(config: TrainConfig, share: int, planner: Planner | None) -> Machines:
    """The machines that `skill.collector` names, for workers that deliver `share` steps at a time.

    Raises:
        ConfigError: they cannot be joined, or have too few processors.
    """
    return (Cluster if config.skill.collector == "ray" else Processes)(config, share, planner)


class Processes:
    """Workers as processes of this machine."""

    deaths: tuple[type[Exception], ...] = (RuntimeError, OSError, EOFError)

    def __init__(self, config: TrainConfig, share: int, planner: Planner | None = None) -> None:
        self.config, self.share, self.planner = config, share, planner

    def start(self, random_frames: int) -> MultiSyncCollector:
        return MultiSyncCollector(
            [partial(make_env, self.config, self.planner)],
            policy_factory=partial(make_acting_policy, self.config),
            collector_class=WorkerCollector,
            frames_per_batch=self.share,
            total_frames=-1,
            init_random_frames=random_frames,
            num_threads=self.config.threads,
            num_sub_threads=self.config.threads,
            auto_register_policy_transforms=False,
            init_fn=_leave_interrupts_to_the_trainer,
        )

    def close(self) -> None:
        # torchrl hands the threads of its workers to this process
        torch.set_num_threads(self.config.threads)


class Cluster:
    """Workers as actors of a Ray cluster; joins it, or starts one on this machine."""

    def __init__(self, config: TrainConfig, share: int, planner: Planner | None = None) -> None:
        import ray

        self.config, self.share, self.planner = config, share, planner
        self.deaths: tuple[type[Exception], ...] = (
            ray.exceptions.RayActorError,
            ray.exceptions.ObjectLostError,
            ray.exceptions.WorkerCrashedError,
        )
        self._joined = not ray.is_initialized()
        if self._joined:
            # Ray ranks workers behind all else on a machine; here the trainer waits for them
            os.environ.setdefault("RAY_worker_niceness", "0")
            # a cluster that is started here would send usage statistics, and its notice of that is not shown
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
            address = config.skill.ray_address
            sigterm = signal.getsignal(signal.SIGTERM)
            try:
                ray.init(address, include_dashboard=False, logging_level=logging.WARNING)
            except (ConnectionError, ray.exceptions.AuthenticationError) as error:
                raise ConfigError(
                    f"skill.ray_address = {address!r}: {str(error).strip()}; is `ray start --head` running there, and "
                    "are its token and RAY_AUTH_MODE set here? (see docs/cluster.md)"
                ) from error
            finally:
                # Ray would have SIGTERM end this process with a code of its own, and no word on how to go on
                if threading.current_thread() is threading.main_thread():
                    signal.signal(signal.SIGTERM, sigterm)
        there, needed = int(ray.cluster_resources().get("CPU", 0)), config.skill.workers * config.threads
        if there < needed:
            self.close()
            raise ConfigError(
                f"skill.workers = {config.skill.workers} with threads = {config.threads} need {needed} processors; "
                f"the Ray cluster has {there}: join more nodes or ask for fewer workers"
            )

    def start(self, random_frames: int) -> Any:
        from torchrl.collectors.distributed import RayCollector

        return RayCollector(
            [partial(make_env, self.config, self.planner)],
            policy_factory=partial(make_acting_policy, self.config),
            collector_class=WorkerCollector,
            collector_kwargs={"auto_register_policy_transforms": False},
            frames_per_batch=self.share,
            total_frames=2**62,
            init_random_frames=random_frames,
            sync=True,
            remote_configs={"num_cpus": self.config.threads, "num_gpus": 0},
            weight_sync_schemes={},
        )

    def close(self) -> None:
        import ray

        if self._joined:
            ray.shutdown()


def make_env(config: TrainConfig, planner: Planner | None = None) -> NavigationEnv:
    """The simulations of one worker, made where it runs."""
    torch.set_num_threads(config.threads)
    return NavigationEnv(make_task(config, config.skill.num_envs, planner, training=True))


def make_acting_policy(config: TrainConfig) -> ProbabilisticActor:
    """The policy of one worker, which waits for its weights."""
    action_dim = get_robot(config.robot).action_dim
    actor = Actor(skill_layout(config), action_dim, config.skill.hidden, layer_norm=False)
    return make_policy(actor, action_dim)


def _leave_interrupts_to_the_trainer() -> None:
    """Ctrl-C reaches every process of the terminal; the trainer alone decides what becomes of its workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
