"""Claims about skill training: an interrupted run loses nothing, a diverged one stops, an able one stops early."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny_run

torch = pytest.importorskip("torch", reason="needs the extra hiernav[train]")
pytest.importorskip("torchrl", reason="needs the extra hiernav[train]")

from tensordict import TensorDict  # noqa: E402

from hiernav.config import load_config  # noqa: E402
from hiernav.nav.mirror import mirror_of  # noqa: E402
from hiernav.nav.option import Planner  # noqa: E402
from hiernav.nav.planners import ShortestPathPlanner, StraightPlanner, VerifiedPlanner  # noqa: E402
from hiernav.run import Run, RunError  # noqa: E402
from hiernav.sim.factory import skill_layout  # noqa: E402
from hiernav.sim.robots import get_robot  # noqa: E402
from hiernav.sim.rollout import Episode  # noqa: E402
from hiernav.skill import train as skill_train  # noqa: E402
from hiernav.skill.sac import Learner, SacSettings  # noqa: E402
from hiernav.skill.train import Progress, SkillTrainer, TorchSkill, TrainingDiverged, kept, load_actor  # noqa: E402

pytestmark = pytest.mark.train

ROOT = Path(__file__).parents[2]


def trainer_in(folder: Path, *overrides: str, planner: Planner | None = None) -> SkillTrainer:
    run = Run.create(tiny_run.config(folder, *overrides))
    return SkillTrainer(run.config, run, planner)


def reopened(folder: Path, planner: Planner | None = None) -> SkillTrainer:
    """A trainer in another process that goes on with a run: nothing is left of the first one but its files."""
    torch.manual_seed(99)
    run = Run.open(folder)
    return SkillTrainer(run.config, run, planner)


def verified() -> VerifiedPlanner:
    """A planner that counts its proposals and repairs."""
    return VerifiedPlanner(StraightPlanner(), ShortestPathPlanner(), 0.1)


def at_step(steps: int, act: Callable[[], None]) -> Callable[[Progress], None]:
    """A progress display that acts once, when `steps` are done."""
    seen: list[int] = []

    def display(now: Progress) -> None:
        if now.steps >= steps and not seen:
            seen.append(now.steps)
            act()

    return display


def interrupt() -> None:
    raise KeyboardInterrupt


def flat(state: dict, prefix: str = "") -> dict[str, torch.Tensor]:
    found: dict[str, torch.Tensor] = {}
    for key, value in state.items():
        if isinstance(value, dict):
            found |= flat(value, f"{prefix}{key}.")
        elif isinstance(value, torch.Tensor):
            found[f"{prefix}{key}"] = value
    return found


def metrics_of(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


@pytest.fixture(scope="module")
def straight(tmp_path_factory: pytest.TempPathFactory) -> SkillTrainer:
    """A run that nothing has disturbed."""
    trainer = trainer_in(tmp_path_factory.mktemp("skill") / "straight")
    trainer.train()
    return trainer


SHORT = (
    "skill.num_envs=4", "skill.total_steps=1280", "skill.learning_starts=256", "skill.checkpoint_every_steps=256",
    "skill.updates_per_step=0.02", "skill.batch_size=32", "skill.hidden=[32, 32]", "skill.eval_episodes=2",
)  # fmt: skip
"""Of any robot: two segments, of 640 steps each."""


def test_with_two_threads_a_training_of_several_segments_is_the_same(tmp_path):
    runs = []
    for threads in (1, 2):
        trainer = trainer_in(tmp_path / str(threads), f"threads={threads}", *SHORT)
        trainer.train()
        runs.append(metrics_of(trainer.run.path))
    assert [line["step"] for line in runs[0] if line["stage"] == "skill"] == [640, 1280]
    assert runs[0] == runs[1]


@pytest.mark.parametrize("file", sorted((ROOT / "configs").glob("*.yaml")), ids=lambda file: file.stem)
def test_every_shipped_configuration_trains_for_more_than_a_segment(tmp_path, file):
    run = Run.create(load_config(file, [*SHORT, "skill.stop_reach_rate=null", f"run_dir={tmp_path / 'run'}"]))
    trainer = SkillTrainer(run.config, run)
    trainer.train()
    assert trainer.steps == 1280 and trainer.evaluations and trainer.best_actor is not None


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory: pytest.TempPathFactory) -> tuple[SkillTrainer, Path, dict[str, int]]:
    """The same run, stopped in the middle of its second segment and gone on with; what was on disk in between."""
    folder = tmp_path_factory.mktemp("skill") / "interrupted"
    broken = trainer_in(folder)
    with pytest.raises(KeyboardInterrupt):
        broken.train(at_step(384, interrupt))
    found = {str(file.relative_to(folder)): file.stat().st_size for file in folder.rglob("*") if file.is_file()}
    broken.run.log("skill", 384, {"reach_rate": 1.0})  # as if the process had died between a line and its checkpoint
    (folder / "skill" / "checkpoint.pt.part").write_bytes(b"half a checkpoint")
    trainer = reopened(folder)
    assert trainer.resume() == 256
    trainer.train()
    return trainer, folder, found


def test_a_run_does_all_its_steps_evaluates_and_logs(straight):
    assert straight.finished and straight.steps == 768
    stages = [(line["stage"], line["step"]) for line in metrics_of(straight.run.path)]
    assert [step for stage, step in stages if stage == "skill"] == [256, 512, 768]
    assert [step for stage, step in stages if stage == "evaluation"] == [e["step"] for e in straight.evaluations]
    assert straight.evaluations[-1]["step"] == 768 and len(straight.evaluations) == 2
    # 512 steps after the 256 random ones, at 0.1 updates a step
    assert straight.learner.updates == 51


def test_reasons_for_new_plans_are_logged_but_for_those_that_an_episode_begins_with(straight):
    logged = [key for key in metrics_of(straight.run.path)[0] if key.startswith("replans/")]
    assert logged == [f"replans/{reason}" for reason in ("d_update", "half_index", "invalid", "goal", "outdated")]
    shares = [[line[key] for key in logged] for line in metrics_of(straight.run.path) if logged[0] in line]
    assert all(0.0 <= share < 1.0 for line in shares for share in line) and any(sum(line) > 0.0 for line in shares)


def test_many_simulations_make_segments_longer_than_checkpoints_were_asked_for(tmp_path):
    few = ("skill.checkpoint_every_steps=8", "skill.updates_per_step=0.02")
    trainer = trainer_in(tmp_path / "run", "skill.num_envs=4", "skill.total_steps=1280", *few)
    trainer.train()
    # whole batches of 128 steps, at least 4 times 150 of them
    assert [line["step"] for line in metrics_of(tmp_path / "run") if line["stage"] == "skill"] == [640, 1280]


def test_a_resumed_run_equals_an_uninterrupted_one_to_the_bit(straight, interrupted):
    resumed, folder, _ = interrupted
    ours, theirs = flat(straight.learner.state_dict()), flat(resumed.learner.state_dict())
    assert ours.keys() == theirs.keys() and len(ours) > 20
    assert [key for key in ours if not torch.equal(ours[key], theirs[key])] == []
    assert resumed.evaluations == straight.evaluations
    assert (folder / "metrics.jsonl").read_bytes() == (straight.run.path / "metrics.jsonl").read_bytes()


def test_plans_are_counted_alike_whether_or_not_a_run_was_interrupted_and_without_those_of_evaluations(tmp_path):
    settings = ("skill.checkpoint_every_steps=384", "skill.updates_per_step=0.02")
    straight = trainer_in(tmp_path / "straight", *settings, planner=verified())
    straight.train()
    with pytest.raises(KeyboardInterrupt):
        trainer_in(tmp_path / "interrupted", *settings, planner=verified()).train(at_step(512, interrupt))
    resumed = reopened(tmp_path / "interrupted", verified())
    assert resumed.resume() == 384 and len(resumed.evaluations) == 1
    resumed.train()
    ours, theirs = (metrics_of(tmp_path / name) for name in ("straight", "interrupted"))
    assert ours == theirs and len(ours) == 4
    counted = sum(line["plans/proposals"] for line in ours if line["stage"] == "skill")
    assert 0 < counted < straight.planner.tally["proposals"]


def test_plans_that_workers_make_are_not_counted_here(tmp_path):
    trainer = trainer_in(tmp_path / "run", "skill.collector=multi", planner=verified())
    trainer.planner.tally["proposals"] += 1  # as an evaluation does
    assert trainer._new_plans() == {}
    trainer.batches.close()


def test_the_replay_is_on_disk_while_it_is_needed(straight, interrupted):
    _, folder, found = interrupted
    replay = {name: size for name, size in found.items() if name.startswith("skill/replay/")}
    # 768 transitions and a batch, two observations of 42 float32 each
    assert sum(replay.values()) >= (768 + 128) * 2 * 42 * 4
    assert not (folder / "skill" / "replay").exists() and not (straight.run.path / "skill" / "replay").exists()


def evaluations(*rates):
    return [{"step": k, "reach_rate": r, "collisions_mean": 0.0, "steps_mean": 50.0} for k, r in enumerate(rates)]


@pytest.mark.parametrize(
    ("rates", "step"),
    [
        ((0.5,), 0),
        ((0.5, 0.9), 1),
        ((0.9, 0.5), 0),
        ((0.99, 0.98), 1),  # as good as the best, and trained for longer
        ((0.99, 0.90, 0.97), 2),
        ((0.99, 0.97, 0.92), 1),  # no slow decline: the best is what counts
        ((0.0, 0.0), 1),
    ],
)
def test_the_last_actor_is_kept_unless_it_is_worse_by_more_than_chance(rates, step):
    assert kept(evaluations(*rates), 100)["step"] == step


def test_more_episodes_leave_less_to_chance():
    assert kept(evaluations(0.99, 0.97), 100)["step"] == 1
    assert kept(evaluations(0.99, 0.97), 1000)["step"] == 0


def measured(step, collisions, spread, rate=1.0):
    """An evaluation of robots that touch something in so many steps of an episode, give or take `spread`."""
    merit_std = ((rate * (1.0 - rate)) + (0.01 * spread) ** 2) ** 0.5
    return {
        "step": step, "reach_rate": rate, "collisions_mean": collisions, "merit_std": merit_std, "steps_mean": 50.0,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("first", "second", "step"),
    [
        (measured(20_000, 0.30, 0.5), measured(100_000, 0.31, 0.5), 100_000),  # all arrive: chance does not vanish
        (measured(20_000, 0.30, 0.5), measured(100_000, 5.0, 1.0), 20_000),
        (measured(20_000, 0.30, 0.5), measured(100_000, 5.0, 25.0), 100_000),  # a few that were stuck explain it
        (measured(20_000, 0.30, 0.5), measured(100_000, 0.30, 0.5, rate=0.9), 20_000),
    ],
)
def test_chance_covers_collisions_too_and_remains_where_all_arrive(first, second, step):
    assert kept([first, second], 100)["step"] == step


def test_an_evaluation_says_how_much_single_episodes_differ(straight):
    assert any(0.0 < evaluation["merit_std"] < 1.0 for evaluation in straight.evaluations)


def test_the_best_actor_is_what_a_run_leaves(straight):
    state = Run.open(straight.run.path).load("skill")
    best = load_actor(straight.config, state)
    observation = np.random.default_rng(0).standard_normal((5, 42)).astype(np.float32)
    action = TorchSkill(best)(observation)
    assert action.shape == (5, 2) and (np.abs(action) <= 1.0).all()
    assert all(torch.equal(value, straight.best_actor[key]) for key, value in best.state_dict().items())


def test_a_skill_that_was_never_evaluated_is_refused_with_a_hint(tmp_path):
    trainer = trainer_in(tmp_path / "run")
    with pytest.raises(KeyboardInterrupt):
        trainer.train(at_step(384, interrupt))
    state = trainer.run.load("skill")
    assert state["steps"] == 256 and state["best_actor"] is None
    with pytest.raises(RunError, match="train for longer"):
        load_actor(trainer.config, state)


def test_for_a_skill_from_elsewhere_no_replay_is_made(tmp_path):
    run = Run.create(tiny_run.config(tmp_path / "run"))
    run.save("skill", {"imported": True})
    with pytest.raises(RunError, match="comes from another run or a bundle: it drives, but cannot be trained on"):
        SkillTrainer(run.config, run)
    assert [file.name for file in (run.path / "skill").iterdir()] == ["checkpoint.pt"]


def test_a_loss_that_is_not_finite_stops_training_before_it_reaches_the_checkpoint(tmp_path):
    trainer = trainer_in(tmp_path / "run")

    def poison() -> None:
        with torch.no_grad():
            for name, weight in trainer.learner.loss.named_parameters():
                if "qvalue" in name:
                    weight.fill_(torch.nan)

    with pytest.raises(TrainingDiverged, match=r"loss_\w+.* not finite after \d+ updates.*last checkpoint"):
        trainer.train(at_step(640, poison))
    again = reopened(tmp_path / "run")
    assert again.resume() == 512
    assert all(value.isfinite().all() for value in flat(again.learner.state_dict()["loss"]).values())


@pytest.mark.parametrize(("rate", "steps"), [("0.9", 512), ("1.0", 768)])
def test_a_skill_that_reaches_the_wanted_rate_stops(tmp_path, monkeypatch, rate, steps):
    """The first evaluation finds a robot that always arrives but once."""
    drive, evaluated = skill_train.run_episodes, []

    def arriving(*arguments):
        evaluated.append(0)
        return [replace(episode, reached=k > 0) for k, episode in enumerate(drive(*arguments))]

    monkeypatch.setattr(skill_train, "run_episodes", arriving)
    trainer = trainer_in(
        tmp_path / "run", f"skill.stop_reach_rate={rate}", "skill.eval_episodes=10", "skill.updates_per_step=0.02"
    )
    trainer.train()
    assert trainer.evaluations[0]["reach_rate"] == 0.9
    assert trainer.steps == steps and trainer.finished
    assert len(evaluated) == (1 if steps == 512 else 2)
    again = reopened(tmp_path / "run")
    assert again.resume() == steps and again.finished


def test_the_critics_learn_from_scaled_rewards_and_the_log_shows_unscaled_ones(tmp_path):
    short = ("skill.total_steps=256", "skill.learning_starts=255", "skill.eval_episodes=1")
    rewards, logged = {}, {}
    for scale in (1.0, 8.0):
        trainer = trainer_in(tmp_path / str(scale), f"skill.reward_scale={scale}", *short)

        def keep(trainer=trainer, scale=scale) -> None:
            rewards[scale] = trainer.replay._data["next", "reward"][:256].clone()

        trainer.train(at_step(256, keep))
        logged[scale] = {k: v for k, v in metrics_of(tmp_path / str(scale))[0].items() if k.startswith("reward/")}
    assert rewards[1.0].abs().max() > 0.0
    torch.testing.assert_close(rewards[8.0], 8.0 * rewards[1.0], rtol=1e-6, atol=0)
    assert logged[1.0] == logged[8.0] != {}


def ready_to_learn(folder: Path, *overrides: str) -> SkillTrainer:
    """A trainer in the middle of its training, whose replay holds transitions that nobody has driven."""
    trainer = trainer_in(folder, "skill.device=cpu", *overrides)
    rng = torch.Generator().manual_seed(0)

    def drawn(size: int) -> torch.Tensor:
        return torch.rand(64, size, generator=rng) * 2.0 - 1.0

    ended = torch.zeros(64, 1, dtype=torch.bool)
    following = {"observation": drawn(42), "reward": drawn(1), "done": ended, "terminated": ended}
    transitions = {"observation": drawn(42), "action": drawn(2), "next": TensorDict(following, [64])}
    trainer.replay.extend(TensorDict(transitions, [64]))
    trainer.steps = 600
    return trainer


@pytest.mark.parametrize("mirror", [True, False])
def test_batches_are_reflected_by_half_if_that_is_asked_for(tmp_path, monkeypatch, mirror):
    trainer, learnt = ready_to_learn(tmp_path / "run", f"skill.mirror={str(mirror).lower()}"), []
    monkeypatch.setattr(trainer.learner, "update", lambda batch: learnt.append(batch) or {})
    rows = torch.arange(32)
    trainer._learn_from(rows)
    drawn, sides = trainer.replay.batch(rows), mirror_of("point", get_robot("point").observation_layout())
    for key, turned in (
        ("observation", sides.observation),
        (("next", "observation"), sides.observation),
        ("action", sides.action),
    ):
        first = turned(drawn[key][:16].numpy()) if mirror else drawn[key][:16].numpy()
        np.testing.assert_array_equal(learnt[0][key][:16].numpy(), first)
        assert torch.equal(learnt[0][key][16:], drawn[key][16:])


def test_the_floor_of_the_temperature_falls_as_training_goes_on(tmp_path):
    falling = ("skill.alpha_floor=0.05", "skill.alpha_floor_end=0.005", "skill.alpha_fall=[0.0, 1.0]")
    trainer, floors = ready_to_learn(tmp_path / "run", *falling, "skill.total_steps=1200"), []
    for trainer.steps in (600, 1200):
        assert trainer._update(20) != {}
        floors.append(float(trainer.learner.loss.min_log_alpha.exp()))
    assert floors == pytest.approx([0.05 * 10**-0.5, 0.005], rel=1e-4)


def test_every_evaluation_drives_the_averaged_actor_by_the_protocol_in_the_same_worlds(tmp_path, monkeypatch):
    """The second one finds robots that never arrive, so the actor of the first is kept, as it was then."""
    driven = []

    def drive(task, skill, layouts):
        driven.append((task, skill.actor, [layout.seed for layout in layouts]))
        arrives = len(driven) % 2 == 1
        return [Episode(k, arrives and k > 0, "goal", 20, 180, 0, 1.0, 1.0, 1.0, {}, 0, 0) for k in range(len(layouts))]

    monkeypatch.setattr(skill_train, "run_episodes", drive)
    for seed in (3, 4):
        trainer = ready_to_learn(
            tmp_path / f"{seed}", f"seed={seed}", "skill.episode_steps=10", "skill.eval_episodes=20"
        )
        trainer._update(200)
        trainer._evaluate()
        evaluated = {key: value.clone() for key, value in trainer.learner.average.state_dict().items()}
        trainer._update(200)
        trainer.steps = 700
        trainer._evaluate()
        assert not torch.equal(trainer.learner.average.head.bias, evaluated["head.bias"]), "it has gone on learning"
        assert all(torch.equal(trainer.best_actor[key], value) for key, value in evaluated.items())
        assert trainer.evaluations[0]["reach_rate"] == 0.95
        assert trainer.evaluations[0]["steps_mean"] == (180 + 19 * 20) / 20, "a failure counts the cap"
        for task, actor, _ in driven[-2:]:
            assert actor is trainer.learner.average is not trainer.learner.actor
            assert not task.end_on_fall and task._cap > 180, "what cuts training episodes short cuts no others"
    first, again, other, _ = (seeds for _, _, seeds in driven)
    assert first == again and len(set(first)) == 20 and not set(first) & set(other)


def test_another_seed_is_another_run(tmp_path, straight):
    other = trainer_in(tmp_path / "run", "seed=4", "skill.total_steps=256", "skill.learning_starts=128")
    other.train()
    first, second = (run.path / "metrics.jsonl" for run in (straight.run, other.run))
    assert first.read_text().splitlines()[0] != second.read_text().splitlines()[0]


def test_a_learner_of_one_s_own_is_what_is_trained_and_driven(tmp_path):
    class Still(Learner):
        """Learns nothing but not to move."""

        def update(self, batch):
            with torch.no_grad():
                self.actor.head.weight.zero_(), self.actor.head.bias.zero_()
            return {"loss": batch["next", "reward"].mean()}

    def make(config):
        return Still(skill_layout(config), get_robot(config.robot).action_dim, SacSettings(hidden=(16, 16)))

    short = ("skill.total_steps=256", "skill.learning_starts=128", "skill.hidden=[16, 16]")
    run = Run.create(tiny_run.config(tmp_path / "run", *short))
    trainer = SkillTrainer(run.config, run, make=make)
    trainer.train()
    assert type(trainer.learner) is Still and "loss" in metrics_of(tmp_path / "run")[-2]
    actor = load_actor(run.config, run.load("skill"))
    assert not TorchSkill(actor)(np.ones((1, 42), dtype=np.float32)).any()
