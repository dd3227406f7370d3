"""Every experiment of the paper, and what it lacks, as a list of cells in the order in which they are worth running.

First what needs no training (the bundles that ship), then the paper's own trainings, then ablations of our departures.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import msgspec

from hiernav.config import PRESETS, RewardConfig, TrainConfig, deciding_settings, load_config
from hiernav.film.film import film_name
from hiernav.finetune import DEFAULTS
from hiernav.planner import passes
from hiernav.reproduce.cells import Cell, Kind
from hiernav.sim.layout import parse_world

EXPERIMENTS = {
    "table3": "Table III: reach rate and steps in six worlds; baseline, ours, fine-tuned planner",
    "astar": "A* in the place of the learned planner (not in the paper)",
    "walks": "plans alone, without physics, in the six worlds and in unseen ones (not in the paper)",
    "unseen": "worlds of other sizes and densities than those of training (not in the paper)",
    "replanning": "fixed periods of 4, 16 and 64 steps against the rule",
    "ablations": "each departure from the paper switched off, or tried (not in the paper)",
    "films": "each robot in each world, from above",
    "table2": "Table II: collisions of plans against the number of samples",
    "sample_efficiency": "training curves of three robots, ours against the baseline",
    "planners": "the planners of the trained seeds, which Table III drives with",
}
ROBOTS = ("point", "car", "doggo")
WORLDS = ("pillar(2,2,10)", "gremlin", "pillar(3,3,25)", "pillar(4,4,40)", "two-room", "four-room")
UNSEEN = (
    "pillar(2,2,5)", "pillar(2,2,15)", "gremlin(3,3,22)", "two-room(4,4)", "four-room(4,4)", "pillar(6,6,93)",
    "pillar(8,8,166)",
)  # fmt: skip
"""Worlds that no planner and no skill was trained in."""
DEPARTURE_WORLDS = ("pillar(2,2,10)", "gremlin", "four-room")
"""In which fixed periods and departures of driving are looked at."""
TABLE3_ROBOT = "doggo"
"""The one of the paper's Table III, whose trained seeds are driven in every world."""
ABLATED = "car"
"""Trained without our departures: the point learns whatever is left out, the quadruped takes three times as long."""
SEEDS = {"point": 5, "car": 5, "doggo": 3}
TABLE2_SEEDS = 3
ABLATION_SEEDS = {"paper-reward": 3, "one-world": 3, "no-phase-in": 3, "layer-norm": 3}
"""Of the departures in reward, curriculum and critics. All else is trained once without."""
PERIODS = (4, 16, 64)

FILM = {"episodes": 1, "size": 400, "speed": 3.0, "fps": 6.0}
"""Small enough for a page of eighteen."""

SKILL_SECONDS = {"point": 600.0, "car": 900.0, "doggo": 2400.0}
PLANNER_SECONDS = {"point": 420.0, "car": 480.0, "doggo": 420.0}
EVALUATION_SECONDS = {"point": 25.0, "car": 55.0, "doggo": 60.0}
FINE_TUNING_SECONDS = 120.0
WALK_SECONDS = 60.0
FILM_SECONDS = 15.0

DRIVING = {
    "no-repair": {"repair": False},
    "no-recovery": {"recover": False},
    "no-prediction": {"predict": False},
    "no-invalid-rule": {"invalid": False},
}
"""Departures that evaluation can switch off: settings that differ."""
TRAINING = {
    "paper-reward": ["reward.preset=paper", "reward.time=0"],
    "one-world": ["skill.worlds=['pillar(2,2,10)']", "skill.phase_in=0"],
    "no-phase-in": ["skill.phase_in=0"],
    "no-mirror": ["skill.mirror=false"],
    "no-average": ["skill.actor_average=0"],
    "no-alpha-floor": ["skill.alpha_floor=0"],
    "no-tilt-cost": ["reward.tilt=0"],
    "no-time-cost": ["reward.time=0"],
    "go-on-after-fall": ["skill.end_on_fall=false"],
    "no-clock": ["skill.clock=false"],
    "layer-norm": ["skill.layer_norm=true"],
    "learned-plans": ["skill.planner=cnn"],
    "world-frame": ["skill.waypoint_frame=world"],
}
"""Departures that have to be trained without (`layer-norm`, `learned-plans` and `world-frame`: with). One that changes
nothing for a robot is left out for it."""
OF_LEGS = ("no-tilt-cost", "go-on-after-fall", "no-clock", "no-time-cost")
"""Departures that are left out with the quadruped instead."""
_BASELINE_REWARD = msgspec.structs.asdict(RewardConfig()) | PRESETS["reward"]["baseline"]
BASELINE = [
    "skill.preset=baseline", "skill.reward_scale=1.0",
    *(f"reward.{name}={_BASELINE_REWARD[name]}" for name in ("time", "tilt", "leave_field", "fall")),
]  # fmt: skip
"""Its rewards are as large as ours after scaling: every step costs the distance to the goal, and an early end 60. What
a robot's file says of them is meant for ours."""


def table2_updates(samples: int) -> int:
    """Gradient updates that a planner of Table II gets."""
    return passes.updates(samples)


@dataclass(frozen=True)
class Size:
    """How large everything is."""

    episodes: int = 1000
    paper_episodes: int = 200
    worlds: tuple[str, ...] = WORLDS
    unseen: tuple[str, ...] = UNSEEN
    unseen_episodes: int = 200
    training: tuple[str, ...] = ()
    """Settings of every training, laid over all others."""
    fine_tuning: tuple[str, ...] = ()
    table2_samples: tuple[int, ...] = (1_000, 10_000, 50_000, 100_000)
    table2_settings: tuple[str, ...] = ()
    share: float = 1.0
    """Of the usual durations."""


FULL = Size()
_SMALL = ("planner.samples_per_world=12", "planner.epochs=1", "planner.batch_size=16")
SMOKE = Size(
    episodes=4,
    paper_episodes=2,
    worlds=("pillar(1.2,1.2,2)", "two-room(1.2,1.2)"),
    unseen=("pillar(1.5,1.5,3)",),
    unseen_episodes=4,
    training=(
        *_SMALL, "planner.samples=24", "planner.worlds=['pillar(1.2,1.2,2)']", "threads=1",
        "skill.worlds=['pillar(1.2,1.2,2)']", "skill.num_envs=4", "skill.total_steps=128", "skill.learning_starts=64",
        "skill.updates_per_step=0.1", "skill.batch_size=16", "skill.hidden=[16, 16]", "skill.eval_every_steps=64",
        "skill.eval_episodes=2", "skill.checkpoint_every_steps=64", "skill.buffer_size=1000",
    ),
    fine_tuning=(*_SMALL, "planner.samples=24"),
    table2_samples=(16, 32),
    table2_settings=_SMALL,
    share=0.01,
)  # fmt: skip
"""Everything once, too small to mean anything, to see the machinery work."""


def catalogue(root: Path, size: Size = FULL, seeds: int | None = None, robots: Sequence[str] = ROBOTS) -> list[Cell]:
    """Every cell of some robots, in the order in which the queue runs them.

    Args:
        root: of the repository.
        seeds: of every training, instead of five for point and car, three for the doggo, and `ABLATION_SEEDS`.
    """
    makers = [_Maker(root, size, seeds, robot) for robot in robots]
    cells = [cell for maker in makers for cell in maker.shipped()]
    if "point" in robots:
        cells += _table2(size, TABLE2_SEEDS if seeds is None else seeds)
    cells += [cell for maker in makers for cell in maker.trained()]
    cells += [cell for maker in makers for cell in maker.ablated()]
    return cells


def _table2(size: Size, seeds: int) -> list[Cell]:
    cells = []
    for samples in size.table2_samples:
        for preset in ("paper", "default"):
            for seed in range(seeds):
                settings: dict[str, Any] = {"samples": samples, "preset": preset, "episodes": size.episodes}
                if size.table2_settings:
                    settings["settings"] = list(size.table2_settings)
                cells.append(
                    Cell(
                        experiment="table2",
                        name=f"{preset}-{samples}-{seed}",
                        kind="table2",
                        robot="point",
                        variant=preset,
                        seed=seed,
                        world=size.worlds[0],
                        settings=settings,
                        config=passes.what_decides(
                            passes.configuration(samples, preset, seed, size.worlds[0], settings=size.table2_settings)
                        ),
                        seconds=size.share * (60 + samples / 1500 + passes.epochs(samples) * samples / 1700),
                    )  # fmt: skip
                )
    return cells


@dataclass(frozen=True)
class _Maker:
    """The cells of one robot."""

    root: Path
    size: Size
    given_seeds: int | None
    robot: str

    def shipped(self) -> list[Cell]:
        """What the bundle that ships can be asked without training."""
        bundle = f"deploy/bundles/{self.robot}"
        cells = [self._evaluate("table3", "shipped", world, bundle=bundle) for world in self.size.worlds]
        beside = {cell.world: (cell.id,) for cell in cells}
        for world in self.size.worlds:
            cells.append(
                self._evaluate("astar", "astar", world, {"planner": "astar"}, bundle=bundle, needs=beside[world])
            )
        for world in (*self.size.worlds, *self.size.unseen):
            count = self.size.episodes if world in self.size.worlds else self.size.unseen_episodes
            cells.append(self._show("walks", "walk", world, bundle, {"episodes": count}, WALK_SECONDS))
        for world in self.size.unseen:
            fewer = {"episodes": self.size.unseen_episodes, "paper_episodes": 0}
            cells.append(self._evaluate("unseen", "shipped", world, fewer, bundle=bundle))
        some = [world for world in self.size.worlds if world in (self.size.worlds[0], *DEPARTURE_WORLDS)]
        for world in some:
            for period in PERIODS:
                cells.append(
                    self._evaluate(
                        "replanning", f"period-{period}", world, _fixed(period), bundle=bundle, needs=beside[world]
                    )
                )
        for variant, settings in DRIVING.items():
            for world in some:
                cells.append(self._evaluate("ablations", variant, world, settings, bundle=bundle, needs=beside[world]))
        for world in self.size.worlds:
            cells.append(self._show("films", "film", world, bundle, FILM, FILM_SECONDS))
        for world in self.size.worlds:
            cells.append(
                self._evaluate(
                    "table3", "shipped-finetuned", world, bundle=bundle, fine_tuned=True, needs=beside[world]
                )
            )
        return cells

    def trained(self) -> list[Cell]:
        """The paper's trainings, and what is measured of them."""
        cells, driven = [], []
        for seed in range(self.given_seeds or SEEDS[self.robot]):
            ours = self._train("sample_efficiency", "ours", seed, [])
            baseline = self._train("sample_efficiency", "baseline", seed, BASELINE)
            cells += [ours, baseline]
            if self.robot != TABLE3_ROBOT:
                continue
            planner = msgspec.structs.replace(
                ours, experiment="planners", name=f"{self.robot}-{seed}", needs=(ours.id,),
                world=None, settings={"stage": "planner"}, seconds=self.size.share * PLANNER_SECONDS[self.robot],
            )  # fmt: skip
            cells.append(planner)
            for world in self.size.worlds:
                about: dict[str, Any] = {"seed": seed, "run": ours.run, "needs": (ours.id, planner.id)}
                driven.append(self._evaluate("table3", "ours", world, **about))
                driven.append(self._evaluate("table3", "finetuned", world, fine_tuned=True, **about))
                driven.append(
                    self._evaluate("table3", "baseline", world, seed=seed, run=baseline.run, needs=(baseline.id,))
                )
        return cells + driven

    def ablated(self) -> list[Cell]:
        """Trainings that differ from ours in one respect, and those of fixed periods; every one of them before the next
        seed of any."""
        variants: list[tuple[str, str, list[str]]] = []
        for name, overrides in TRAINING.items():
            if self.robot == (TABLE3_ROBOT if name in OF_LEGS else ABLATED):
                variants.append(("ablations", name, overrides))
        for period in PERIODS if self.robot == ABLATED else ():
            overrides = [f"option.{key}={json.dumps(value)}" for key, value in _fixed(period).items()]
            variants.append(("replanning", f"trained-period-{period}", overrides))
        ours = self._config(0, [])
        variants = [each for each in variants if self._config(0, each[2]) != ours]
        return [
            self._train(experiment, name, seed, overrides, (f"sample_efficiency/{self.robot}-ours-{seed}",))
            for seed in range(self.given_seeds or max(ABLATION_SEEDS.values()))
            for experiment, name, overrides in variants
            if seed < (self.given_seeds or ABLATION_SEEDS.get(name, 1))
        ]

    def _config(self, seed: int, overrides: list[str]) -> str:
        file = self.root / "configs" / f"{self.robot}.yaml"
        config = _load(file, file.stat().st_mtime_ns, (*overrides, *self.size.training, "run_dir=null"))
        return msgspec.json.encode(deciding_settings(msgspec.structs.replace(config, seed=seed))).decode()

    def _fine_tuning_config(self, world: str, trained: bool) -> str:
        """What decides a fine-tuning of a trained run, or of the bundle, whose own part its hashes tell."""
        overrides = [f"{key}={value}" for key, value in DEFAULTS.items()]
        overrides += [f"planner.worlds={json.dumps([world])}", *self.size.fine_tuning]
        if not trained:
            return passes.what_decides(load_config(None, [f"robot={self.robot}", *overrides]))
        file = self.root / "configs" / f"{self.robot}.yaml"
        return passes.what_decides(_load(file, file.stat().st_mtime_ns, (*self.size.training, *overrides)))

    def _train(
        self, experiment: str, variant: str, seed: int, overrides: list[str], needs: tuple[str, ...] = ()
    ) -> Cell:
        config = self._config(seed, overrides)
        name = f"{self.robot}-{variant}-{seed}"
        both = "skill.planner=cnn" in overrides
        seconds = SKILL_SECONDS[self.robot] + EVALUATION_SECONDS[self.robot]
        return Cell(
            experiment=experiment, name=name, kind="train", robot=self.robot, variant=variant, seed=seed, config=config,
            world=self.size.worlds[0], settings={"stage": "all" if both else "skill", "episodes": self.size.episodes},
            # another configuration is another folder: no training goes on in one of other settings
            run=f"{name}-{hashlib.sha256(config.encode()).hexdigest()[:8]}", needs=needs,
            seconds=self.size.share * (seconds + both * PLANNER_SECONDS[self.robot]),
        )  # fmt: skip

    def _show(
        self, experiment: str, kind: Kind, world: str, bundle: str, settings: dict[str, Any], seconds: float
    ) -> Cell:
        return Cell(
            experiment=experiment, name=f"{self.robot}-{_slug(world)}", kind=kind, robot=self.robot, variant="shipped",
            world=world, bundle=bundle, settings=settings, seconds=self.size.share * seconds,
        )  # fmt: skip

    def _evaluate(
        self,
        experiment: str,
        variant: str,
        world: str,
        settings: dict[str, Any] | None = None,
        *,
        fine_tuned: bool = False,
        seed: int | None = None,
        bundle: str | None = None,
        run: str | None = None,
        needs: tuple[str, ...] = (),
    ) -> Cell:
        settings = {"episodes": self.size.episodes, "paper_episodes": self.size.paper_episodes, **(settings or {})}
        config = None
        if fine_tuned:
            settings["fine_tuning"] = list(self.size.fine_tuning)
            config = self._fine_tuning_config(world, trained=run is not None)
        parts = [self.robot, variant, *([] if seed is None else [str(seed)]), _slug(world)]
        return Cell(
            experiment=experiment, name="-".join(parts), kind="finetune" if fine_tuned else "evaluate",
            robot=self.robot, variant=variant, seed=seed, world=world, settings=settings, config=config, bundle=bundle,
            run=run, needs=needs,
            seconds=self.size.share * (EVALUATION_SECONDS[self.robot] + fine_tuned * FINE_TUNING_SECONDS),
        )  # fmt: skip


@cache
def _load(file: Path, changed: int, overrides: tuple[str, ...]) -> TrainConfig:
    """A configuration as the file was at the time `changed`."""
    return load_config(file, list(overrides))


def _fixed(period: int) -> dict[str, Any]:
    """Settings with which plans are replaced every so many steps, whatever the map shows."""
    return {"period": period, "invalid": False}


def _slug(world: str) -> str:
    return film_name(parse_world(world))
