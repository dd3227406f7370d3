"""Claims about planner training: it learns, its reflections are true ones, and an interrupted run loses nothing."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny_run

torch = pytest.importorskip("torch", reason="needs the extra hiernav[train]")

from hiernav.nav import goselo  # noqa: E402
from hiernav.nav.occupancy import OccupancyMap, VisitMap  # noqa: E402
from hiernav.planner import passes, table  # noqa: E402
from hiernav.planner import train as planner_train  # noqa: E402
from hiernav.planner.dataset import Samples, data_seed, make_samples  # noqa: E402
from hiernav.planner.store import DatasetError, write_dataset  # noqa: E402
from hiernav.planner.train import (  # noqa: E402
    LossWeights,
    PlannerTrainer,
    clearance_at,
    load_network,
    one_cycle,
    plan_loss,
    reflect,
    torch_planner,
)
from hiernav.run import Run, TrainingDiverged  # noqa: E402
from hiernav.sim.layout import parse_world  # noqa: E402
from hiernav.sim.worlds import sample_layout  # noqa: E402

pytestmark = pytest.mark.train


@pytest.fixture(autouse=True)
def few_walks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planner_train, "_WALKS", 3)


def trainer_in(folder: Path, *overrides: str) -> PlannerTrainer:
    run = Run.create(tiny_run.config(folder, *overrides))
    return PlannerTrainer(run.config, run)


def metrics_of(run: Run) -> list[dict]:
    return [json.loads(line) for line in (run.path / "metrics.jsonl").read_text().splitlines()]


@pytest.mark.parametrize(("preset", "left"), [("default", 0.75), ("paper", 0.2)])
def test_the_loss_falls_on_a_small_set(tmp_path, preset, left):
    trainer = trainer_in(
        tmp_path / "run",
        f"planner.preset={preset}",
        f"planner.hypotheses={1 if preset == 'paper' else 2}",
        "planner.epochs=12",
        "planner.learning_rate=3e-3",
        "planner.clearance_weight=0",
    )
    trainer.train()
    metrics = metrics_of(trainer.run)
    assert [line["step"] for line in metrics] == list(range(1, 13))
    assert metrics[-1]["loss"] < left * metrics[0]["loss"]
    if preset == "paper":  # the default's plans point at the goal before it has learnt anything
        assert metrics[-1]["error"] < 0.5 * metrics[0]["error"]
    assert set(metrics[-1]) >= {"walk_collisions", "walk_reach_rate", "blocked_waypoints"}
    assert trainer.finished


@pytest.mark.parametrize("updates", range(1, 31))
def test_the_learning_rate_rises_and_falls_over_any_number_of_updates(updates):
    optimizer = torch.optim.AdamW([torch.nn.Parameter(torch.zeros(1))])
    schedule, rates = one_cycle(optimizer, 1e-3, updates), []
    for _ in range(updates):
        rates.append(schedule.get_last_lr()[0])
        optimizer.step()
        schedule.step()
    assert all(0.0 < rate <= 1e-3 for rate in rates) and rates[-1] == pytest.approx(4e-9)
    top = rates.index(max(rates))
    assert top <= max(1, updates // 10) and rates == sorted(rates[:top]) + sorted(rates[top:], reverse=True)


def test_a_training_of_ten_updates_is_one(tmp_path):
    trainer = trainer_in(tmp_path / "run", "planner.samples=10", "planner.epochs=10")
    trainer.train()
    assert trainer.schedule.total_steps == trainer.schedule.last_epoch == 10


def test_a_trained_network_is_read_back_from_the_run(tmp_path):
    trainer = trainer_in(tmp_path / "run", "planner.epochs=1")
    trainer.train()
    loaded = load_network(trainer.config, Run.open(tmp_path / "run").load("planner"))
    trainer.network.eval()
    image = torch.randint(0, 256, (3, 4, 64, 64), dtype=torch.uint8)
    with torch.no_grad():
        for ours, theirs in zip(trainer.network(image, torch.ones(3)), loaded(image, torch.ones(3)), strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)  # the layout in memory differs


def test_a_resumed_run_equals_an_uninterrupted_one_to_the_bit(tmp_path, monkeypatch):
    straight = trainer_in(tmp_path / "straight", "planner.epochs=3", "planner.mirror=true")
    straight.train()

    broken = trainer_in(tmp_path / "broken", "planner.epochs=3", "planner.mirror=true")
    updates = 0

    def interrupted(*arguments):
        nonlocal updates
        updates += 1
        if updates == 5:  # three per epoch: in the middle of the second
            raise KeyboardInterrupt
        return plan_loss(*arguments)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(planner_train, "plan_loss", interrupted)
        broken.train()
    broken.run.log("planner", 2, {"loss": 0.0})  # written after the checkpoint, lost with the process
    torch.manual_seed(99)

    run = Run.open(tmp_path / "broken")
    resumed = PlannerTrainer(run.config, run)
    assert resumed.resume() == 1
    resumed.train()
    weights, again = straight.network.state_dict(), resumed.network.state_dict()
    assert weights.keys() == again.keys()
    assert all(torch.equal(weights[key], again[key]) for key in weights)
    assert (run.path / "metrics.jsonl").read_bytes() == (straight.run.path / "metrics.jsonl").read_bytes()


@pytest.mark.parametrize(
    ("part", "named"), [("loss", "loss not finite in batch 2"), ("weights", "weights not finite at the end")]
)
def test_what_is_not_finite_stops_training_before_it_reaches_the_checkpoint(tmp_path, monkeypatch, part, named):
    trainer, batches = trainer_in(tmp_path / "run", "planner.epochs=3"), []

    def broken(*arguments):
        batches.append(0)
        loss = plan_loss(*arguments)
        if len(batches) == 6 and part == "weights":  # the last of the second epoch: no loss comes after it
            trainer.optimizer.register_step_post_hook(lambda *_: next(trainer.network.parameters()).data.fill_(np.nan))
        return loss * np.nan if len(batches) == 5 and part == "loss" else loss

    monkeypatch.setattr(planner_train, "plan_loss", broken)
    with pytest.raises(TrainingDiverged, match=f"^{named} of epoch 2, .* checkpoint is of epoch 1: .* --resume"):
        trainer.train()
    state = trainer.run.load("planner")
    assert state["epoch"] == 1
    assert all(value.isfinite().all() for value in state["network"].values() if value.is_floating_point())


def test_a_finished_planner_is_not_trained_again(tmp_path, monkeypatch):
    trainer = trainer_in(tmp_path / "run", "planner.epochs=1")
    trainer.train()
    before = (tmp_path / "run" / "metrics.jsonl").read_bytes()
    run = Run.open(tmp_path / "run")
    again = PlannerTrainer(run.config, run)
    assert again.resume() == 1 and again.finished
    monkeypatch.setattr(planner_train, "make_samples", None)  # would fail if it were called
    again.train()
    assert (tmp_path / "run" / "metrics.jsonl").read_bytes() == before


def batch_of(label: torch.Tensor, clearance: int = 255) -> planner_train.Batch:
    rows = len(label)
    crop = torch.full((rows, 64, 64), clearance, dtype=torch.uint8)
    return torch.zeros((rows, 4, 64, 64), dtype=torch.uint8), crop, torch.ones(rows), label


def loss_of(plans: torch.Tensor, scores: torch.Tensor, batch: planner_train.Batch, **weights: float) -> float:
    return float(plan_loss((plans, scores), batch, LossWeights(**weights)))


def test_with_one_hypothesis_and_no_weights_the_loss_is_the_papers():
    generator = torch.Generator().manual_seed(0)
    label, plans = (torch.randn((5, 10, 2), generator=generator) for _ in range(2))
    loss = loss_of(plans[:, None], torch.zeros(5, 1), batch_of(label, clearance=0))
    assert loss == pytest.approx(10.0 * float((plans - label).square().sum(-1).mean()))


def test_the_best_hypothesis_decides_and_its_score_is_what_learns():
    label = torch.zeros((1, 10, 2))
    label[..., 1] = 0.1 * torch.arange(1, 11)
    sideways = label.flip(-1)
    plans = torch.stack([sideways, label], dim=1)
    sure_of = {
        which: loss_of(plans, torch.log_softmax(torch.tensor([score]), -1), batch_of(label))
        for which, score in (("best", [0.0, 5.0]), ("other", [5.0, 0.0]))
    }
    assert sure_of["best"] < sure_of["other"] < loss_of(plans[:, :1], torch.zeros(1, 1), batch_of(label))


def test_a_hypothesis_that_is_not_the_best_learns_a_twentieth():
    label = torch.zeros((1, 10, 2))
    scores = torch.log_softmax(torch.tensor([[0.0, 0.0, 0.0]]), -1)
    plans = torch.zeros((1, 3, 10, 2), requires_grad=True)
    apart = plans + torch.tensor([0.3, 0.1, 0.2])[None, :, None, None] * torch.tensor([1.0, 0.0])
    loss = plan_loss((apart, scores), batch_of(label), LossWeights())
    squared = [0.09, 0.01, 0.04]
    assert float(loss.detach()) == pytest.approx(10.0 * 0.01 + 0.5 * sum(squared) / 3 + 0.1 * np.log(3.0))
    loss.backward()
    pulls = plans.grad.norm(dim=(2, 3))[0]
    assert (pulls > 0.0).all() and pulls[1] > 2.0 * pulls[[0, 2]].max()


def test_the_headings_of_the_best_hypothesis_are_what_is_compared():
    label = torch.zeros((2, 10, 2))
    label[..., 1] = 0.1 * torch.arange(1, 11)
    scores = torch.zeros((2, 2))
    plans = torch.stack([torch.stack([label[0].flip(-1), label[0]]), torch.stack([label[1], label[1].flip(-1)])])
    losses = [loss_of(plans, scores, batch_of(label), heading=weight) for weight in (0.0, 1.0)]
    assert losses[0] == pytest.approx(losses[1])


def test_every_weight_of_the_loss_and_of_the_optimiser_is_the_configured_one(tmp_path):
    wanted = ("clearance_weight=0.7", "heading_weight=0.4", "soft_margin_m=0.2", "weight_decay=0.03", "mirror=false")
    trainer = trainer_in(tmp_path / "run", *(f"planner.{text}" for text in wanted), "option.spacing_m=0.2")
    assert trainer._weights == LossWeights(0.7, pytest.approx(0.1 + 0.3 * 0.2), 0.4, 0.2)
    assert trainer.optimizer.param_groups[0]["weight_decay"] == 0.03
    assert (trainer.labels.soft_margin, trainer.labels.spacing, trainer.labels.random_smoothing) == (0.2, 0.2, False)
    planner = torch_planner(trainer.network, trainer.labels)
    assert (planner.radius, planner.margin, planner.channels) == (0.1, 0.2, goselo.METRIC_CHANNELS)
    paper = trainer_in(tmp_path / "paper", "planner.preset=paper", "planner.hypotheses=1")
    assert paper.labels.random_smoothing and paper.labels.channels == goselo.CHANNELS


def random_samples(trainer: PlannerTrainer, count: int) -> Samples:
    rng, samples = np.random.default_rng(0), Samples.empty(trainer.labels, count)
    samples.image[:] = rng.integers(0, 256, samples.image.shape)
    samples.distance[:] = rng.uniform(0.5, 2.0, count)
    samples.label[:] = rng.uniform(-1.0, 1.0, samples.label.shape)
    return samples


@pytest.mark.parametrize("mirror", [True, False])
def test_samples_are_reflected_in_training_if_that_is_asked_for_and_never_where_it_is_measured(
    tmp_path, monkeypatch, mirror
):
    trainer = trainer_in(tmp_path / "run", "planner.device=cpu", f"planner.mirror={str(mirror).lower()}")
    reflected, samples = [], random_samples(trainer, 40)

    def noting(image, label, which):
        reflected.extend(which.tolist())
        return reflect(image, label, which)

    monkeypatch.setattr(planner_train, "reflect", noting)
    trainer._epoch(samples, lambda *_: None)
    assert len(reflected) == (40 if mirror else 0)
    assert not mirror or 5 < sum(reflected) < 35
    reflected.clear()
    trainer._validate(samples)
    assert reflected == []


def test_an_epoch_takes_the_steps_of_its_schedule_and_tells_the_mean_over_samples(tmp_path, monkeypatch):
    trainer = trainer_in(tmp_path / "run", "planner.epochs=1")  # 48 samples, 16 of them to a batch
    losses = iter((1.0, 2.0, 6.0))

    def loss(output, batch, weights):
        return plan_loss(output, batch, weights) * 0.0 + next(losses)

    monkeypatch.setattr(planner_train, "plan_loss", loss)
    # batches of 16, 16 and 8
    assert trainer._epoch(random_samples(trainer, 40), lambda *_: None) == pytest.approx((16 * 1 + 16 * 2 + 8 * 6) / 40)
    assert trainer.schedule.last_epoch == 3


def test_what_is_measured_is_the_chosen_hypothesis_all_along(tmp_path):
    trainer = trainer_in(tmp_path / "run", "planner.device=cpu")
    samples = random_samples(trainer, 6)
    samples.label[:] = 0.0
    samples.image[:, -1] = 255  # room everywhere
    plans = torch.zeros((6, 2, 10, 2))
    plans[:, 0, :, 0] = 0.5
    plans[:, 1, 5:, 1] = 0.2  # at the label first, then 0.2 m off

    class Sure(torch.nn.Module):
        channels = trainer.network.channels

        def forward(self, image, distance):
            return plans[: len(image)], torch.tensor([[-2.0, -0.1]]).repeat(len(image), 1)

    trainer.network = Sure()
    assert trainer._validate(samples) == {"error": pytest.approx(0.1), "blocked_waypoints": 0.0}
    samples.image[:, -1] = 0
    assert trainer._validate(samples)["blocked_waypoints"] == 1.0


def test_a_planner_is_measured_on_worlds_that_it_was_not_trained_in(tmp_path, monkeypatch):
    seen = []

    def noting(*arguments):
        seen.append(make_samples(*arguments))
        return seen[-1]

    monkeypatch.setattr(planner_train, "make_samples", noting)
    trainer_in(tmp_path / "run", "planner.epochs=1").train()
    trained, measured = ({bytes(image) for image in samples.image} for samples in seen)
    assert len(trained) > 40 and len(measured) > 40 and not trained & measured


def test_waypoints_near_obstacles_cost_and_those_with_room_do_not():
    plans = torch.zeros((1, 1, 10, 2))

    def penalty(clearance: int) -> float:
        return loss_of(plans, torch.zeros(1, 1), batch_of(plans[:, 0], clearance), clearance=1.0, margin=0.2)

    assert penalty(255) == 0.0
    assert penalty(0) == pytest.approx(1.0)
    half = round(0.1 / goselo.CLEARANCE_CLIP * 255)
    assert penalty(half) == pytest.approx(0.25, abs=0.02)


def test_a_zigzag_costs_more_than_a_straight_plan_as_far_from_the_label():
    label = torch.zeros((1, 10, 2))
    label[..., 1] = 0.1 * torch.arange(1, 11)
    aside, zigzag = label.clone(), label.clone()
    aside[..., 0] += 0.03
    zigzag[..., 0] += 0.03 * (-1.0) ** torch.arange(10)
    losses = [
        [loss_of(plan[:, None], torch.zeros(1, 1), batch_of(label), heading=weight) for plan in (aside, zigzag)]
        for weight in (0.0, 1.0)
    ]
    assert losses[0][0] == pytest.approx(losses[0][1])
    # aside: one step of ten is off by 0.3 spacings; zigzag: the other nine by 0.6
    assert losses[1][0] - losses[0][0] == pytest.approx(0.009)
    assert losses[1][1] - losses[0][1] == pytest.approx(0.009 + 9 * 0.036)


@pytest.mark.parametrize("seed", range(4))
def test_clearance_in_the_crop_is_the_clearance_in_the_world(seed):
    layout = sample_layout(parse_world("pillar(2,2,10)"), seed, 0.1)
    occupancy, rng = layout.occupancy(0.0), np.random.default_rng(seed)
    position = rng.uniform(-1.0, 1.0, (6, 2))
    frame = goselo.GoseloFrame.of(position, np.broadcast_to(layout.goal, (6, 2)))
    crop = goselo.images([occupancy] * 6, [VisitMap(occupancy)] * 6, frame, ("clearance_local",))[:, 0]
    waypoints = rng.uniform(-1.0, 1.0, (6, 2, 10, 2))
    seen = clearance_at(torch.from_numpy(crop), torch.from_numpy(waypoints).float()).numpy()
    there = np.minimum(occupancy.clearance_at(frame.to_world(waypoints)), goselo.CLEARANCE_CLIP)
    inside = occupancy.contains(frame.to_world(waypoints))
    # the crop is a turned copy at the map's resolution, so the field's ridges are cut by up to half a pixel
    np.testing.assert_allclose(seen[inside], there[inside], atol=0.04)
    assert np.abs(seen - there)[inside].mean() < 0.006
    assert seen[~inside].max(initial=0.0) < 0.06


def test_a_reflected_sample_is_the_sample_of_the_reflected_world():
    layout = sample_layout(parse_world("pillar(2,2,10)"), 1, 0.1)
    flip = np.array([-1.0, 1.0])
    other = replace(layout, pillars=layout.pillars * flip, goal=layout.goal * flip)
    position = np.array([[-1.2, -1.3], [0.9, 0.2]])
    label = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 10, 2))

    def batch(world, where, plan) -> tuple[torch.Tensor, torch.Tensor]:
        maps: list[OccupancyMap] = [world.occupancy(0.0)] * 2
        visits = [VisitMap(m) for m in maps]
        for each, start in zip(visits, where, strict=True):
            each.add(start + np.linspace([0.0, 0.0], [0.4 * np.sign(world.goal[0]), 0.3], 20))
        frame = goselo.GoseloFrame.of(where, np.broadcast_to(world.goal, (2, 2)))
        image = goselo.images(maps, visits, frame, (*goselo.METRIC_CHANNELS, "visits_2"))
        in_frame = frame.from_world(plan).astype(np.float32)
        return torch.from_numpy(image), torch.from_numpy(in_frame)

    ours = batch(layout, position, position[:, None] + label)
    theirs = batch(other, position * flip, position[:, None] * flip + label * flip)
    turned = reflect(*ours, torch.tensor([True, True]))
    for index, (name, limit) in enumerate((("image", 8.0), ("label", 1e-5))):
        assert ((turned[index].float() - theirs[index].float()).abs() > limit).float().mean() < 0.01, name
        assert ((ours[index].float() - theirs[index].float()).abs() > limit).float().mean() > 0.05, name


def test_reflection_keeps_label_and_clearance_together_and_leaves_other_rows_alone():
    generator = torch.Generator().manual_seed(0)
    image = torch.randint(0, 256, (4, 4, 64, 64), dtype=torch.uint8, generator=generator)
    label = torch.rand((4, 10, 2), generator=generator) * 2.0 - 1.0
    which = torch.tensor([True, False, True, False])
    turned = reflect(image, label, which)
    before, after = (clearance_at(i[:, -1], plan[:, None]) for i, plan in ((image, label), turned))
    torch.testing.assert_close(before, after, rtol=0, atol=1e-4)
    for mine, theirs in zip((image, label), turned, strict=True):
        assert torch.equal(mine[~which], theirs[~which]) and not torch.equal(mine[which], theirs[which])
    again = reflect(*turned, which)
    assert all(torch.equal(mine, theirs) for mine, theirs in zip((image, label), again, strict=True))


def test_training_on_a_data_set_from_disk_is_training_on_samples_of_the_run_s_own(tmp_path):
    own = trainer_in(tmp_path / "own")
    own.train()
    write_dataset(tmp_path / "data", own.labels, 60, data_seed(own.config))
    from_disk = trainer_in(tmp_path / "disk", f"planner.data={tmp_path / 'data'}")
    from_disk.train()
    weights, again = own.network.state_dict(), from_disk.network.state_dict()
    assert all(torch.equal(weights[key], again[key]) for key in weights)
    shutil.rmtree(tmp_path / "data")
    run = Run.open(tmp_path / "disk")
    later = PlannerTrainer(run.config, run)
    assert later.resume() == 2 and later.finished, "what it has learnt needs no data"
    with pytest.raises(DatasetError, match="is no data set"):
        trainer_in(tmp_path / "new", f"planner.data={tmp_path / 'data'}").train()


@pytest.mark.parametrize(
    ("settings", "advice"),
    [
        ((), r"repeats it, with another seed in \S+config\.yaml other samples follow$"),
        (("planner.data=given",), r"repeats it; begin a new run with another planner\.learning_rate or seed$"),
    ],
)
def test_the_advice_after_a_divergence_is_one_that_changes_something(tmp_path, settings, advice):
    diverged = trainer_in(tmp_path / "run", *settings)._diverged("loss not finite")
    assert re.search(advice, str(diverged))


def test_a_data_set_for_another_robot_or_network_is_refused(tmp_path):
    write_dataset(tmp_path / "data", replace(trainer_in(tmp_path / "run").labels, radius=0.2), 12, (0,))
    with pytest.raises(DatasetError, match=r"made with radius = 0.2, this run plans with 0.1"):
        trainer_in(tmp_path / "other", f"planner.data={tmp_path / 'data'}").train()


def test_a_planner_of_table_2_gets_the_updates_that_are_told_of_it(tmp_path, monkeypatch):
    planned = []

    def train(trainer, on_progress):
        planned.append(trainer.schedule.total_steps)
        trainer.validation = {"error": 0.0}

    monkeypatch.setattr(PlannerTrainer, "train", train)
    table.measure(tmp_path, 300, "paper", 0, world=tiny_run.WORLD, episodes=1, threads=1)
    assert planned == [passes.updates(300)] == [1_708]
