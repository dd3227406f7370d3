"""Batches from many workers, each a torchrl collector of its own, so that what happens to one cannot touch the others.

A batch is the shares of all workers in their order, each collected with the same weights: a run depends on its seed
and its number of workers, not on their speed or on where they run. A worker that dies is replaced; its share of the
batch is collected anew, in worlds that nobody has seen, and those of the others are kept.
"""

from __future__ import annotations

import logging
import re
import threading
from collections.abc import Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.modules import ProbabilisticActor

from hiernav.config import TrainConfig
from hiernav.nav.option import Planner
from hiernav.run import WorkersLost
from hiernav.skill.collect import frames_of_batch, place_of, random_batches, segment_frames, whole_batches
from hiernav.skill.env import PhysicsDiverged
from hiernav.skill.machines import Machines, Weights, find_machines

log = logging.getLogger(__name__)
_ATTEMPTS = 3
"""Deaths in a row, without a share delivered in between, that end the training."""


class WorkerBatches:
    """Batches of `skill.workers` workers; arguments as those of `LocalBatches`."""

    def __init__(self, config: TrainConfig, policy: ProbabilisticActor, planner: Planner | None = None) -> None:
        self.config, self.policy, self.planner = config, policy, planner
        skill = config.skill
        self.share = frames_of_batch(skill.num_envs, segment_frames(skill, 0) // skill.workers)
        self.frames = self.share * skill.workers
        self.workers: list[Worker] = []
        self._machines: Machines | None = None
        self._threads = ThreadPoolExecutor(skill.workers, "worker")
        self._pending: list[Future[TensorDict]] = []
        self._stopping = threading.Event()

    def segment(self, steps: int, frames: int, again: int = 0) -> Generator[TensorDict]:
        if self._machines is None:
            self._machines = find_machines(self.config, self.share, self.planner)
            self.workers = [Worker(k, self.config, self._machines) for k in range(self.config.skill.workers)]
        begun, last = steps, steps + whole_batches(frames, self.frames) * self.frames
        self._order(begun, steps, again)
        while steps < last:
            data = torch.cat([share.result() for share in self._pending])
            steps += self.frames
            if self.config.skill.overlap and steps < last:
                self._order(begun, steps, again)
            yield data
            if not self.config.skill.overlap and steps < last:
                self._order(begun, steps, again)

    def close(self) -> None:
        self._stopping.set()
        wait(self._pending)
        list(self._threads.map(Worker.stop, self.workers))
        self._threads.shutdown()
        self.workers = []
        if self._machines is not None:
            self._machines.close()
            self._machines = None

    def _order(self, segment: int, steps: int, again: int) -> None:
        """Let all workers collect the batch that follows `steps`, by the weights of this moment."""
        random_frames = random_batches(self.config, steps, self.frames) * self.share
        weights = {key: value.numpy().copy() for key, value in self.policy.state_dict().items()}
        order = Order(segment, again, random_frames, weights, self._stopping)
        self._pending = [self._threads.submit(worker.collect, order) for worker in self.workers]


@dataclass(frozen=True)
class Order:
    """What every worker is to collect its share of a batch with."""

    segment: int
    """Steps of the run before the segment."""
    again: int
    """How often it failed before."""
    random_frames: int
    """Frames that a worker which starts now acts at random for."""
    weights: Weights
    stopping: threading.Event
    """Set once nobody waits for the batch any more."""


class Worker:
    """A worker and its successors; used by one thread at a time."""

    def __init__(self, index: int, config: TrainConfig, machines: Machines) -> None:
        self.index, self.config, self.machines = index, config, machines
        self.generation = 0
        self.collector: Any = None
        self._shares: Iterator[TensorDict] = iter(())
        self._segment = -1

    def collect(self, order: Order) -> TensorDict:
        """The worker's share (M,) of a batch.

        Raises:
            WorkersLost: it dies whenever it is started.
            PhysicsDiverged: as its simulations say.
        """
        deaths = 0
        while True:
            try:
                return self._collect(order)
            except PhysicsDiverged:
                raise
            except self.machines.deaths as error:
                self.stop()
                self.generation += 1
                deaths += 1
                if deaths == _ATTEMPTS or order.stopping.is_set():
                    raise WorkersLost(
                        f"worker {self.index} died {deaths} times without delivering anything, at last of: "
                        f"{self._told(error)}"
                    ) from error
                reason = self._told(error).partition("\n")[0] or type(error).__name__
                log.warning("worker %d died and is replaced: %s", self.index, reason)

    def stop(self) -> None:
        """End the worker; the next share is collected by a new one."""
        if self.collector is not None:
            self.collector.shutdown()
            self.collector = None

    def _told(self, error: Exception) -> str:
        """What a death is said to be of: torchrl counts the processes of each collector anew, and this one has one."""
        return re.sub(r"(?i)\bworker 0\b", f"worker {self.index}", str(error))

    def _collect(self, order: Order) -> TensorDict:
        if self.collector is None:
            self.collector = self.machines.start(order.random_frames)
            self._shares, self._segment = iter(self.collector), -1
        if self._segment != order.segment:
            place = place_of(order.again, order.segment, self.index, self.generation)
            self.collector.map_fn("begin", [(self.config, place)])
            self._segment = order.segment
        self.collector.map_fn("load", [(order.weights,)])
        share = next(self._shares).reshape(-1)
        self.collector.map_fn("check")
        return share
