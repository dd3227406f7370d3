"""Configurations that train in seconds, and no good robot comes of them."""

from __future__ import annotations

from pathlib import Path

from hiernav.config import TrainConfig, load_config

WORLD = "pillar(1.2,1.2,2)"
SETTINGS = [
    "robot=point",
    "seed=3",
    "planner.preset=default",
    "planner.samples=48",
    "planner.samples_per_world=12",
    "planner.epochs=2",
    "planner.batch_size=16",
    "planner.hypotheses=2",
    f"planner.worlds=['{WORLD}']",
    "skill.preset=default",
    "skill.planner=astar",
    f"skill.worlds=['{WORLD}']",
    "skill.num_envs=1",
    "skill.total_steps=768",
    "skill.learning_starts=256",
    "skill.updates_per_step=0.1",
    "skill.batch_size=32",
    "skill.buffer_size=10_000",
    "skill.hidden=[32, 32]",
    "skill.eval_every_steps=384",
    "skill.eval_episodes=4",
    "skill.checkpoint_every_steps=256",
    "skill.stop_reach_rate=null",
]


def arguments(run_dir: Path, *overrides: str) -> list[str]:
    """`key.path=value` texts of a tiny run; later ones win."""
    return [*SETTINGS, f"run_dir={run_dir}", *overrides]


def config(run_dir: Path, *overrides: str) -> TrainConfig:
    return load_config(None, arguments(run_dir, *overrides))
