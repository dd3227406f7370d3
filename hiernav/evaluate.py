"""Evaluation of a pair of policies on any list of worlds, under the paper's protocol or the strict one; and of plans
alone, which a disc walks along without physics.

`paper`: 200 episodes; contacts with gremlins do not count as collisions.
`strict`: 1000 episodes; every contact counts.
Under both, leaving the field and reaching the cap are failures, and a failure counts the cap as its steps.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from hiernav.config import OptionConfig, TrainConfig, load_config
from hiernav.nav.agent import Skill
from hiernav.nav.bundle import MANIFEST, PLANNER, SKILL, file_sha256, load_bundle
from hiernav.nav.occupancy import RESOLUTION
from hiernav.nav.option import Planner
from hiernav.nav.planners import Network, VerifiedPlanner, verified_planner
from hiernav.nav.termination import TerminationReason
from hiernav.runtime.policy import load_networks
from hiernav.sim.factory import default_planner, expert_planner, make_task, skill_layout
from hiernav.sim.layout import WorldSpec
from hiernav.sim.robots import get_robot
from hiernav.sim.rollout import Episode, run_episodes
from hiernav.sim.walk import WalkResult, walk
from hiernav.sim.worlds import sample_layout

EPISODES = {"paper": 200, "strict": 1000}
_Z95 = 1.959963984540054
_WALKERS = 100
"""Walks side by side."""


@dataclass(frozen=True)
class Policies:
    """A planner network and a skill, and the configuration they were trained under."""

    config: TrainConfig
    skill: Skill
    network: Network | None
    channels: tuple[str, ...] = ()
    knows_reward: bool = True
    """Whether the configuration's reward is the one the skill was trained with: a bundle does not tell it."""

    @property
    def is_baseline(self) -> bool:
        """Whether the skill follows no plan."""
        return self.config.skill.preset == "baseline"


def open_policies(path: str | Path) -> Policies:
    """Policies of a bundle (ONNX Runtime) or of a run folder (torch, on one thread in this process from then on).

    Raises:
        ValueError: the folder is neither, or is incomplete (BundleError, RunError).
    """
    path = Path(path)
    if (path / "config.yaml").exists():
        return _from_run(path)
    if path.is_dir() and not (path / MANIFEST).exists():
        raise ValueError(f"{path} is neither a run folder (it has no config.yaml) nor a bundle (no {MANIFEST})")
    return _from_bundle(path)


def fingerprints(path: str | Path) -> dict[str, str]:
    """SHA-256 of each file that makes the policies of a bundle or of a run folder, by its name in there."""
    names = (PLANNER, SKILL, MANIFEST, "planner/checkpoint.pt", "skill/checkpoint.pt", "config.yaml")
    return {name: file_sha256(Path(path) / name) for name in names if (Path(path) / name).is_file()}


def make_planner(policies: Policies, kind: str, repair: bool = True) -> Planner:
    """A planner for evaluation.

    Args:
        kind: "cnn" (the trained network) or "astar" (the expert).
        repair: whether plans of the network that collide are replaced by the expert's.

    A baseline, which follows no plan, gets none, whatever the kind.
    """
    if policies.is_baseline:
        return default_planner(policies.config)
    expert = expert_planner(policies.config)
    if kind == "astar":
        return expert
    if kind != "cnn":
        raise ValueError(f"unknown planner {kind!r}; known: cnn, astar")
    if policies.network is None:
        raise ValueError("these policies hold no planner network: train the planner first, or use --planner astar")
    planner = verified_planner(policies.network, policies.channels, expert, get_robot(policies.config.robot).radius)
    return planner if repair else planner.planner


def evaluate(
    policies: Policies,
    worlds: Sequence[WorldSpec],
    protocol: str = "strict",
    planner: str = "cnn",
    episodes: int | None = None,
    seed: int = 0,
    repair: bool = True,
    rows: int = 64,
    on_episode: Callable[[str, int, Episode], None] | None = None,
    recover: bool = True,
    predict: bool = True,
) -> dict[str, dict[str, Any]]:
    """Metrics of every world, by its name; the same for the same seed, whatever `rows` is.

    Beside `summarize`, a row says what helped: `repair` (plans of the network were verified), `recover` (a robot that
    stands still got a way out; never one whose skill follows no waypoints), `predict` (plans were made on maps as they
    will be), and the rule of replanning (`period`, `invalid`). `return_mean` is null where the reward is not known, as
    that of a bundle.

    Args:
        protocol: "paper" or "strict".
        planner: "cnn" or "astar".
        episodes: per world; 200 (paper) or 1000 (strict) by default.
        repair: see `make_planner`.
        rows: simulations side by side.
        recover: see `run_episodes`.
        predict: see `WaypointOption`.
    """
    if protocol not in EPISODES:
        raise ValueError(f"unknown protocol {protocol!r}; known: {', '.join(EPISODES)}")
    count = EPISODES[protocol] if episodes is None else episodes
    if count < 1:
        raise ValueError(f"episodes must be at least 1, got {count}")
    results = {}
    for world in worlds:
        name = str(world)
        plan = make_planner(policies, planner, repair)
        radius = get_robot(policies.config.robot).radius
        layouts = [sample_layout(world, int(s), radius) for s in episode_seeds(seed, count)]
        task = make_task(policies.config, min(rows, count), plan, [world])
        task.option.predict &= predict
        began = time.perf_counter()
        report = None if on_episode is None else partial(on_episode, name)
        done = run_episodes(task, policies.skill, layouts, report, recover=recover)
        done = under_protocol(done, protocol, world)
        results[name] = {
            "world": name,
            "robot": policies.config.robot,
            "protocol": protocol,
            **_planned_by(policies, planner, plan),
            "recover": task.recovery is not None,
            "predict": task.option.predict,
            "period": policies.config.option.period,
            "invalid": policies.config.option.invalid,
            "seed": seed,
            **summarize(done, policies.knows_reward),
            **_plan_counts(plan),
            "redraws": sum(layout.redraws for layout in layouts),
            "seconds": round(time.perf_counter() - began, 2),
        }
    return results


def evaluate_plans(
    policies: Policies,
    world: WorldSpec,
    planner: str = "cnn",
    repair: bool = True,
    episodes: int = 1000,
    seed: int = 0,
    on_episodes: Callable[[int], None] | None = None,
) -> dict[str, Any]:
    """Metrics of a disc of planning radius that walks along plans (`walk`), moving obstacles at rest.

    `planner` and `repair` are told as by `evaluate`; there is neither recovery nor a rule of replanning.

    Args:
        planner: "cnn" or "astar".
        repair: see `make_planner`.
        on_episodes: called with how many are done.
    """
    plan, radius = make_planner(policies, planner, repair), expert_planner(policies.config).radius
    seeds = np.random.SeedSequence((seed, 0x3A1C)).generate_state(episodes)
    began, parts = time.perf_counter(), list[WalkResult]()
    for first in range(0, episodes, _WALKERS):
        layouts = [sample_layout(world, int(s), radius) for s in seeds[first : first + _WALKERS]]
        parts.append(walk(plan, layouts, radius, max_plans=max(60, world.max_steps // 10)))
        if on_episodes is not None:
            on_episodes(min(first + _WALKERS, episodes))
    walks = WalkResult(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(WalkResult)))
    return {
        "world": str(world),
        **_planned_by(policies, planner, plan),
        "episodes": episodes,
        "seed": seed,
        "radius_m": radius,
        **walks.summary(),
        "collisions_total": int(walks.collisions.sum()),
        **_plan_counts(plan),
        "seconds": round(time.perf_counter() - began, 2),
    }


def under_protocol(episodes: Sequence[Episode], protocol: str, world: WorldSpec) -> list[Episode]:
    """Episodes as a protocol counts them: under `paper`, contacts with gremlins are no collisions."""
    uncounted = protocol == "paper" and world.kind == "gremlin"
    return [replace(episode, collisions=0) if uncounted else episode for episode in episodes]


def episode_seeds(seed: int, count: int) -> np.ndarray:
    """World seeds of an evaluation: (count,), the first ones the same for every count."""
    return np.random.SeedSequence((seed, 0xE9A1)).generate_state(count)


def summarize(episodes: Sequence[Episode], knows_reward: bool = True) -> dict[str, Any]:
    """Metrics of finished episodes.

    `spl_mean` is over the episodes that have one, null if none does; `spl_unknown` counts the others: reached, though
    no shortest path was found.

    Args:
        knows_reward: whether returns are by the reward that is meant; else `return_mean` is null.
    """
    spl = np.array([e.spl for e in episodes])
    known = np.isfinite(spl)
    reached = np.array([e.reached for e in episodes])
    collisions = np.array([e.collisions for e in episodes])
    reasons = [r.name.lower() for r in TerminationReason if r != TerminationReason.NONE]
    return {
        "episodes": len(episodes),
        "reach_rate": float(reached.mean()),
        "reach_ci95": list(wilson_interval(int(reached.sum()), len(episodes))),
        "steps_mean": float(np.mean([e.steps_counted for e in episodes])),
        "collisions_mean": float(collisions.mean()),
        "collision_free_rate": float((reached & (collisions == 0)).mean()),
        "spl_mean": float(spl[known].mean()) if known.any() else None,
        "spl_unknown": int((~known).sum()),
        "return_mean": float(np.mean([e.return_ for e in episodes])) if knows_reward else None,
        "replans": {reason: sum(e.replans[reason] for e in episodes) for reason in reasons},
        "endings": {kind: sum(e.reason == kind for e in episodes) for kind in sorted({e.reason for e in episodes})},
        "refused": sum(e.refused for e in episodes),
        "recoveries": sum(e.recoveries for e in episodes),
    }


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % score interval of a rate."""
    if trials < 1:
        raise ValueError(f"trials must be at least 1, got {trials}")
    rate, z2 = successes / trials, _Z95 * _Z95 / trials
    middle = (rate + z2 / 2) / (1 + z2)
    half = _Z95 * np.sqrt(rate * (1 - rate) / trials + z2 / (4 * trials)) / (1 + z2)
    return float(max(0.0, middle - half)), float(min(1.0, middle + half))


def _planned_by(policies: Policies, kind: str, planner: Planner) -> dict[str, Any]:
    """What a row says of who planned, and whether plans were verified."""
    return {"planner": "none" if policies.is_baseline else kind, "repair": isinstance(planner, VerifiedPlanner)}


def _plan_counts(planner: Planner) -> dict[str, int]:
    return planner.counts() if isinstance(planner, VerifiedPlanner) else {}


def _from_bundle(path: Path) -> Policies:
    bundle = load_bundle(path)
    robot = get_robot(bundle.manifest.robot)
    bundle.require_robot(robot.name, file_sha256(robot.xml_path))
    bundle.require_period(robot.control_period)
    bundle.require_actions(robot.action_dim)
    bundle.require_resolution(RESOLUTION)
    loaded = load_networks(bundle)
    manifest, terms = bundle.manifest, bundle.layout.names
    skill = "baseline" if "goal" in terms else "default"
    presets = load_config(
        None, [f"robot={robot.name}", f"planner.preset={manifest.planner.preset}", f"skill.preset={skill}"]
    )
    config = msgspec.structs.replace(
        presets,
        planner=msgspec.structs.replace(
            presets.planner,
            hypotheses=manifest.planner.outputs[0].shape[1] or 1,
            planning_radius_m=manifest.plan.planning_radius_m,
            soft_margin_m=manifest.plan.soft_margin_m,
        ),
        option=OptionConfig(
            **msgspec.structs.asdict(manifest.replan),
            waypoints=manifest.plan.waypoints,
            spacing_m=manifest.plan.spacing_m,
        ),
        skill=msgspec.structs.replace(
            presets.skill, clock="clock" in terms, waypoint_frame="world" if "world_waypoints" in terms else "body"
        ),
    )
    bundle.require_layout(skill_layout(config))
    return Policies(config, loaded.skill, loaded.planner, manifest.goselo.channels, knows_reward=False)


def _from_run(path: Path) -> Policies:
    import torch

    from hiernav.planner.network import TorchNetwork
    from hiernav.planner.train import load_network
    from hiernav.run import Run, RunError
    from hiernav.skill.train import TorchSkill, load_actor

    torch.set_num_threads(1)  # for products this small, threads mostly wait for each other
    run = Run.open(path)
    skill, planner = run.load("skill"), run.load("planner")
    if skill is None:
        raise RunError(f"{path} has no trained skill yet: go on with `hiernav train --resume {path}`")
    network = None if planner is None else load_network(run.config, planner)
    return Policies(
        run.config,
        TorchSkill(load_actor(run.config, skill)),
        None if network is None else TorchNetwork(network),
        () if network is None else tuple(network.channels),
        knows_reward="replay" in skill,  # a skill that was taken over from a bundle has none, and no reward either
    )
