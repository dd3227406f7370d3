"""How long a segment of training is, and which worlds it draws its episodes from."""

from __future__ import annotations

from pathlib import Path

import pytest

from hiernav.config import load_config
from hiernav.sim.layout import parse_world
from hiernav.skill.collect import place_of, random_batches, segment_frames, training_layouts, training_worlds

pytestmark = pytest.mark.train

CONFIGS = Path(__file__).parents[2] / "configs"
WORLDS = ["pillar(2,2,5)", "gremlin", "two-room"]
CONFIG = load_config(None, [f"skill.worlds={WORLDS}", "skill.total_steps=1000", "skill.learning_starts=0"])
PHASED = load_config(None, [*(f"skill.{k}" for k in (f"worlds={WORLDS}", "phase_in=0.4", "total_steps=4000"))])


@pytest.mark.parametrize(("steps", "count"), [(0, 1), (799, 1), (800, 2), (1599, 2), (1600, 3), (4000, 3)])
def test_worlds_are_added_one_at_a_time(steps: int, count: int) -> None:
    assert [world.kind for world in training_worlds(PHASED.skill, steps)] == ["pillar", "gremlin", "two-room"][:count]


def test_without_phasing_in_all_worlds_are_there_from_the_start() -> None:
    assert len(training_worlds(CONFIG.skill, 0)) == 3


@pytest.mark.parametrize("robot", ["point", "car", "doggo", "baseline-point"])
def test_an_episode_can_time_out_before_its_segment_ends(robot: str) -> None:
    skill = load_config(CONFIGS / f"{robot}.yaml").skill
    cap = skill.episode_steps or max(parse_world(world).max_steps for world in skill.worlds)
    assert segment_frames(skill, 0) / skill.num_envs >= cap


@pytest.mark.parametrize(
    ("robot", "settings", "frames"),
    [
        *[(robot, [], 20_000) for robot in ("point", "car", "baseline-point")],
        ("doggo", [], 24_000),
        ("doggo", ["skill.workers=32"], 24_000),  # whom nobody asks
        ("doggo", ["skill.collector=multi", "skill.workers=32"], 150 * 32 * 32),
        ("point", ["skill.num_envs=512", "skill.total_steps=200_000"], 150 * 512),
        ("point", ["skill.num_envs=512", "skill.total_steps=200_000", "skill.checkpoint_every_steps=90_000"], 90_000),
    ],
)
def test_a_segment_leaves_every_simulation_the_steps_of_an_episode(
    robot: str, settings: list[str], frames: int
) -> None:
    skill = load_config(CONFIGS / f"{robot}.yaml", settings).skill
    assert segment_frames(skill, 0) == frames
    assert segment_frames(skill, skill.total_steps - 32) == 32
    assert segment_frames(skill, skill.total_steps - frames - 32) == frames + 32, "no segment of a step or two"


def test_as_many_batches_are_random_as_learning_waits_for() -> None:
    config = load_config(None, ["skill.learning_starts=100"])
    assert [random_batches(config, steps, 64) for steps in (0, 36, 64, 99, 100, 128)] == [2, 1, 1, 1, 0, 0]


def test_until_learning_starts_actions_are_drawn_at_random_and_then_by_the_policy() -> None:
    torch = pytest.importorskip("torch")
    from hiernav.skill.collect import LocalBatches
    from hiernav.skill.train import make_learner

    torch.manual_seed(0)
    small = ["device=cpu", "num_envs=2", "total_steps=32", "batch_size=8", "hidden=[8, 8]", "learning_starts=16"]
    learner = make_learner(config := load_config(None, [f"skill.{text}" for text in small]))
    with torch.no_grad():  # a policy that stands still
        learner.actor.head.weight.zero_()
        learner.actor.head.bias.copy_(torch.tensor([0.0, 0.0, -9.0, -9.0]))
    batches = LocalBatches(config, learner.policy)
    sizes = [float(torch.cat(list(batches.segment(steps, 16)))["action"].abs().mean()) for steps in (0, 16)]
    batches.close()
    assert sizes[1] < 0.05 < 0.3 < sizes[0]


def test_training_episodes_end_as_the_skill_s_settings_say() -> None:
    pytest.importorskip("torch")
    from hiernav.skill.collect import LocalBatches
    from hiernav.skill.train import make_learner

    for robot, ends in (("point", "true"), ("doggo", "false"), ("doggo", "true")):
        config = load_config(
            None,
            [
                f"robot={robot}",
                "skill.num_envs=1",
                f"skill.end_on_fall={ends}",
                "skill.episode_steps=7",
                "skill.device=cpu",
            ],
        )
        batches = LocalBatches(config, make_learner(config).policy)
        assert batches.task.end_on_fall == (ends == "true") and batches.task._cap == 7
        batches.close()


def test_every_segment_and_every_worker_has_episodes_of_its_own() -> None:
    def seeds(*place: int) -> list[int]:
        draw = training_layouts(CONFIG, *place)
        return [draw(row).seed for row in range(3)]

    named = [(0,), (256,), (256, 0, 0), (256, 1, 0)]
    places = [seeds(*place_of(again, *place)) for place in named for again in (0, 1, 2)]
    assert len({seed for place in places for seed in place}) == 36
    assert seeds(256, 1, 0) == places[-3]
