"""Training of the waypoint generator on labels of the shortest-path planner."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import msgspec
import numpy as np
import torch
from torch import nn
from torch.nn import functional

from hiernav.config import TrainConfig
from hiernav.device import (
    choose_device,
    choose_precision,
    keep_freed_memory,
    random_state,
    restore_random_state,
)
from hiernav.nav import goselo
from hiernav.nav.planners import GoseloPlanner
from hiernav.planner.dataset import LabelSettings, Samples, data_seed, label_settings, make_samples
from hiernav.planner.mix import WorldMix
from hiernav.planner.network import (
    HypothesisNetwork,
    Output,
    PaperNetwork,
    TorchNetwork,
    make_network,
)
from hiernav.planner.store import DatasetError, read_dataset, read_manifest, require_samples
from hiernav.run import Run, RunError, TrainingDiverged
from hiernav.sim.walk import walk
from hiernav.sim.worlds import sample_layout

Batch = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]
"""Image as the network takes it, clearance, distance and label as in `Samples`."""
_VALIDATION = 2000
_VALIDATION_SEED = 0xE7A1
_WALKS = 200
_CHECKPOINTS = 25
"""Validations and checkpoints of a training are at least so many, as far as it has as many epochs."""
_OTHER_HYPOTHESES = 0.05
"""Share of the loss that hypotheses which are not the best one keep, so that none dies."""


@dataclass
class Progress:
    """What a progress display may want to show."""

    stage: str
    done: int
    total: int
    samples_per_second: float
    loss: float | None
    error: float | None
    """Mean distance of the chosen waypoints from the label on validation worlds [m]."""


class PlannerTrainer:
    """One training of the waypoint generator within a run folder; checkpointed after every epoch, or few of many."""

    def __init__(self, config: TrainConfig, run: Run) -> None:
        self.config, self.run = config, run
        planner = config.planner
        seed = np.random.SeedSequence((config.seed, 3)).generate_state(1)
        torch.manual_seed(int(seed[0]))
        self.device = choose_device(planner.device, "planner.device")
        self.network = make_network(
            planner.preset, config.option.waypoints, config.option.spacing_m, planner.hypotheses
        ).to(self.device, memory_format=torch.channels_last)
        self.precision = choose_precision(planner.precision, self.device)
        self.labels = label_settings(config)
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(), lr=planner.learning_rate, weight_decay=planner.weight_decay
        )
        batches = -(-planner.samples // planner.batch_size)
        self.schedule = one_cycle(self.optimizer, planner.learning_rate, planner.epochs * batches)
        self.epoch = 0
        self.validation: dict[str, float] = {}
        self._given = False  # whether training starts from weights that were trained elsewhere

    def resume(self) -> int | None:
        """Go back to the last checkpoint; its number of epochs, or None if there is none.

        Raises:
            RunError: this is a fine-tuning, and the weights that it started from are gone.
        """
        state = self.run.load("planner", rewind=True)
        if state is None:
            if (self.run.load("skill") or {}).get("imported"):
                raise RunError(
                    f"{self.run.path} fine-tunes a planner, and its planner/checkpoint.pt is missing: restore it, or "
                    "begin anew with --from"
                )
            return None
        self.network.load_state_dict(state["network"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.schedule.load_state_dict(state["schedule"])
        restore_random_state(state, self.device)
        self.epoch, self.validation = state["epoch"], state["validation"]
        self._given = self.epoch == 0
        return self.epoch

    @property
    def finished(self) -> bool:
        return self.epoch >= self.config.planner.epochs

    def train(self, on_progress: Callable[[Progress], None] | None = None) -> None:
        """Make the data set, train all epochs, and measure collisions of the waypoints.

        Raises:
            TrainingDiverged: the loss or the network is not finite.
            WorkersLost: a process that makes samples died.
            DatasetError: see `settings_of_data` and `read_dataset`.
            RunError: the run folder cannot be written to.
        """
        if self.finished:
            return
        planner, seed = self.config.planner, self.config.seed

        began = time.perf_counter()

        def report(stage: str, done: int, total: int, first: int = 0, loss: float | None = None) -> None:
            if on_progress is not None:
                rate = (done - first) / max(time.perf_counter() - began, 1e-6)
                on_progress(Progress(stage, done, total, rate, loss, self.validation.get("error")))

        def made(done: int) -> None:
            report("data set", done, planner.samples)

        if planner.data is not None:
            self.labels = settings_of_data(self.config)
            samples = read_dataset(planner.data, planner.samples, made)
        else:
            samples = make_samples(self.labels, planner.samples, data_seed(self.config), self.config.threads, made)
        held_out = make_samples(self.labels, min(_VALIDATION, planner.samples), (seed, _VALIDATION_SEED))
        keep_freed_memory()  # after the samples, which are freed for good
        began, first, total = time.perf_counter(), self.epoch * planner.samples, planner.epochs * planner.samples
        if self._given:
            self.validation = self._validate(held_out)
            self.run.log("planner", 0, self.validation)
        while not self.finished:
            started = time.perf_counter()
            loss = self._epoch(samples, lambda done, now: report("training", done, total, first, now))
            rate = len(samples) / (time.perf_counter() - started)
            self.epoch += 1
            if self.epoch % max(1, planner.epochs // _CHECKPOINTS) and not self.finished:
                continue  # small sets are seen so often that looking at each pass would take longer than the passes
            self.validation = {"loss": loss, **self._validate(held_out)}
            if self.finished:
                self.validation |= self._walk()
            self.run.log("planner", self.epoch, self.validation)
            self.run.log_rates("planner", self.epoch, {"samples_per_second": rate})
            self.save()

    def _epoch(self, samples: Samples, on_batch: Callable[[int, float], None]) -> float:
        self.network.train()
        planner, total, began = self.config.planner, 0.0, time.perf_counter()
        order = torch.randperm(len(samples)).numpy()
        for first in range(0, len(order), planner.batch_size):
            rows = np.sort(order[first : first + planner.batch_size])
            batch = self._batch(samples, rows, planner.mirror)
            with torch.autocast(self.device.type, self.precision, enabled=self.precision != torch.float32):
                output = self.network(batch[0], batch[2])
            loss = plan_loss(output, batch, self._weights)
            value = float(loss.detach())
            if not math.isfinite(value):  # never to be sent back: grid_sample crashes on waypoints that are NaN
                raise self._diverged(f"loss not finite in batch {first // planner.batch_size + 1}")
            self.optimizer.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
            self.optimizer.step()
            self.schedule.step()
            total += value * len(rows)
            done = first + len(rows)
            if done == len(order) or time.perf_counter() - began > 0.2:
                began = time.perf_counter()
                on_batch(self.epoch * len(order) + done, total / done)
        if not all(bool(weight.isfinite().all()) for weight in self.network.parameters()):
            raise self._diverged("weights not finite at the end")
        return total / len(order)

    def _diverged(self, what: str) -> TrainingDiverged:
        path = self.run.path
        kept = f"the last checkpoint is of epoch {self.epoch}" if self.epoch else "there is no checkpoint yet"
        if self.config.planner.data is None:
            advice = f", with another seed in {path / 'config.yaml'} other samples follow"
        else:
            advice = "; begin a new run with another planner.learning_rate or seed"
        return TrainingDiverged(
            f"{what} of epoch {self.epoch + 1}, and {kept}: `hiernav train --resume {path}` repeats it{advice}"
        )

    @property
    def _weights(self) -> LossWeights:
        planner = self.config.planner
        margin = self.labels.radius + 0.3 * self.labels.soft_margin
        return LossWeights(planner.clearance_weight, margin, planner.heading_weight, self.labels.spacing)

    def _batch(self, samples: Samples, rows: np.ndarray, mirror: bool = False) -> Batch:
        """Some samples on the device, half of them reflected left to right on request."""
        image, distance, label = (
            torch.from_numpy(values[rows]).to(self.device)
            for values in (samples.image, samples.distance, samples.label)
        )
        if mirror:
            image, label = reflect(image, label, (torch.rand(len(rows)) < 0.5).to(self.device))
        # channels last: convolutions of few channels take half the time, those of the paper's network a quarter
        shown = image[:, : len(self.network.channels)].contiguous(memory_format=torch.channels_last)
        return shown, image[:, -1], distance, label

    @torch.no_grad()
    def _validate(self, samples: Samples) -> dict[str, float]:
        self.network.eval()
        errors, hits = [], []
        for first in range(0, len(samples), 500):
            rows = np.arange(first, min(first + 500, len(samples)))
            image, clearance, distance, label = self._batch(samples, rows)
            waypoints, scores = self.network(image, distance)
            chosen = waypoints[torch.arange(len(label), device=self.device), scores.argmax(dim=1)]
            errors.append((chosen - label).norm(dim=-1).mean(dim=-1))
            hits.append((clearance_at(clearance, chosen[:, None])[:, 0] < self.labels.radius).float().mean(dim=-1))
        return {"error": float(torch.cat(errors).mean()), "blocked_waypoints": float(torch.cat(hits).mean())}

    def _walk(self) -> dict[str, float]:
        mix, seed = WorldMix(self.labels.worlds), (self.config.seed, _VALIDATION_SEED, 1)
        rng = np.random.default_rng(seed)
        layouts = [
            sample_layout(mix.draw(rng), int(s), self.labels.radius)
            for s in np.random.SeedSequence(seed).generate_state(min(_WALKS, self.config.planner.samples))
        ]
        result = walk(torch_planner(self.network, self.labels), layouts, self.labels.radius)
        return {
            "walk_collisions": float(result.collisions.mean()),
            "walk_reach_rate": float(result.reached.mean()),
        }

    def save(self) -> None:
        """Write the checkpoint; before the first epoch it holds the weights that training starts from."""
        self.run.save(
            "planner",
            {
                "network": self.network.state_dict(),
                "optimizer": self.optimizer.state_dict(),
                "schedule": self.schedule.state_dict(),
                **random_state(self.device),
                "epoch": self.epoch,
                "validation": self.validation,
            },
        )


def one_cycle(optimizer: torch.optim.Optimizer, peak: float, updates: int) -> torch.optim.lr_scheduler.OneCycleLR:
    """Learning rate over so many updates: up to `peak` in the first tenth, then down to next to nothing."""
    rise = 0.2 if updates == 10 else 0.1  # OneCycleLR divides by the updates of the rise less one
    return torch.optim.lr_scheduler.OneCycleLR(optimizer, peak, total_steps=updates, pct_start=rise)


@dataclass(frozen=True)
class LossWeights:
    """What else counts in the loss beside the distance from the label."""

    clearance: float = 0.0
    """Of a lack of clearance, relative to `margin` and squared."""
    margin: float = 0.1
    """Clearance that waypoints are pushed to [m]."""
    heading: float = 0.0
    """Of steps that are other than the label's, relative to `spacing` and squared: it straightens plans."""
    spacing: float = 0.1
    """Distance between waypoints [m]."""


def plan_loss(output: Output, batch: Batch, weights: LossWeights) -> torch.Tensor:
    """Loss of a network's output (B, H, K, 2), (B, H): squared distance of the best hypothesis, its score, and more.

    With one hypothesis and weights of 0 this is the paper's loss (Eq. 1), times ten.
    """
    (waypoints, scores), (_, clearance, _, label) = output, batch
    squared = (waypoints - label[:, None]).square().sum(-1).mean(-1)
    best = squared.detach().argmin(dim=1)
    fit = squared.gather(1, best[:, None])[:, 0].mean()
    loss = 10.0 * fit
    if waypoints.shape[1] > 1:
        loss = loss + 10.0 * _OTHER_HYPOTHESES * squared.mean() + 0.1 * functional.nll_loss(scores, best)
    if weights.heading > 0:
        apart = _steps(waypoints[torch.arange(len(best), device=best.device), best]) - _steps(label)
        loss = loss + weights.heading * (apart / weights.spacing).square().sum(-1).mean()
    if weights.clearance > 0:
        lack = (weights.margin - clearance_at(clearance, waypoints)).clamp(min=0.0) / weights.margin
        loss = loss + weights.clearance * lack.square().mean()
    return loss


def _steps(plan: torch.Tensor) -> torch.Tensor:
    """From the robot to the first waypoint, and from each to the next: (B, K, 2) -> (B, K, 2)."""
    return torch.diff(plan, dim=1, prepend=torch.zeros_like(plan[:, :1]))


def clearance_at(clearance: torch.Tensor, waypoints: torch.Tensor) -> torch.Tensor:
    """Clearance [m] at waypoints (B, H, K, 2) of the GOSELO frame from local crops (B, 64, 64) uint8: (B, H, K)."""
    grid = waypoints * waypoints.new_tensor([2.0, -2.0]) / goselo.LOCAL_SIDE
    field = clearance[:, None].float() * (goselo.CLEARANCE_CLIP / 255.0)
    return functional.grid_sample(field, grid, align_corners=False, padding_mode="border")[:, 0]


def torch_planner(network: PaperNetwork | HypothesisNetwork, labels: LabelSettings) -> GoseloPlanner:
    """A trained network as a planner that keeps the clearance of its labels where it can."""
    return GoseloPlanner(TorchNetwork(network), network.channels, labels.radius, labels.soft_margin)


def load_network(config: TrainConfig, state: dict) -> PaperNetwork | HypothesisNetwork:
    """The network of a planner checkpoint."""
    planner = config.planner
    network = make_network(planner.preset, config.option.waypoints, config.option.spacing_m, planner.hypotheses)
    network.load_state_dict(state["network"])
    return network.eval()


def settings_of_data(config: TrainConfig) -> LabelSettings:
    """Label settings of the data set that is named in a configuration.

    Raises:
        DatasetError: there is none, it has too few samples, or its labels are not those that this run's network has to
            learn.
    """
    folder, ours = config.planner.data, label_settings(config)
    if folder is None:
        raise DatasetError("planner.data names no data set")
    manifest = read_manifest(folder)
    theirs = manifest.settings
    for name in ("radius", "soft_margin", "waypoints", "spacing", "random_smoothing", "channels"):
        if getattr(theirs, name) != getattr(ours, name):
            raise DatasetError(
                f"planner.data = {folder!r} was made with {name} = {getattr(theirs, name)!r}, "
                f"this run plans with {getattr(ours, name)!r}: make another one with `hiernav dataset`"
            )
    require_samples(folder, manifest, config.planner.samples)
    return theirs


def with_worlds_of_data(config: TrainConfig) -> TrainConfig:
    """A configuration whose planner learns from a data set, with the worlds that this was made in.

    Raises:
        DatasetError: see `settings_of_data`.
    """
    worlds = settings_of_data(config).worlds
    return msgspec.structs.replace(config, planner=msgspec.structs.replace(config.planner, worlds=worlds))


def reflect(image: torch.Tensor, label: torch.Tensor, which: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Reflect some rows (B,) of images (B, C, 64, 64) and labels (B, K, 2) left to right."""
    image = torch.where(which[:, None, None, None], image.flip(-1), image)
    return image, torch.where(which[:, None, None], label * label.new_tensor([-1.0, 1.0]), label)
