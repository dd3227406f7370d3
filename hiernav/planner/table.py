"""One entry of the waypoint generator's table: a planner of some data set size, and a disc that walks along its plans.

Paper, Table II. The walks are in worlds that it has never seen, and unrepaired: five waypoints, a new plan, and so on;
every waypoint that touches an obstacle counts 1.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from hiernav.planner import passes
from hiernav.planner.dataset import data_seed, label_settings
from hiernav.planner.store import read_manifest, write_dataset
from hiernav.planner.train import PlannerTrainer, torch_planner
from hiernav.run import Run
from hiernav.sim.layout import parse_world
from hiernav.sim.walk import walk
from hiernav.sim.worlds import sample_layout


def measure(
    folder: Path,
    samples: int,
    preset: str,
    seed: int,
    *,
    world: str = "pillar(2,2,10)",
    robot: str = "point",
    episodes: int = 1000,
    threads: int = 2,
    settings: Sequence[str] = (),
    code: str | None = None,
    on_progress: Callable[[str, int, int], None] | None = None,
) -> dict[str, Any]:
    """Train one planner, or go on training it, and walk.

    Args:
        folder: for the run and for the data set, of which smaller sizes are the first samples; those of other settings
            have other names there.
        preset: "paper" or "default".
        robot: whose radius the disc has.
        settings: further ones of the training.
        code: see `Run.note_code`.
        on_progress: called with "data set" or "training", what is done and the total.
    """

    def show(what: str, done: int, total: int) -> None:
        if on_progress is not None:
            on_progress(what, done, total)

    config = passes.configuration(samples, preset, seed, world, robot, settings)
    made = label_settings(config)
    run_dir = folder / f"{preset}-{samples}-{seed}-{passes.digest(passes.what_decides(config))}"
    data = folder / f"data-{preset}-{seed}-{passes.digest(json.dumps(asdict(made)))}"
    planner = msgspec.structs.replace(config.planner, data=str(data))
    config = msgspec.structs.replace(config, threads=threads, run_dir=str(run_dir), planner=planner)
    run = Run.open(run_dir) if (run_dir / "config.yaml").exists() else Run.create(config)
    if not (data / "dataset.json").exists() or read_manifest(data).made < samples:
        write_dataset(data, made, samples, data_seed(config), threads, lambda done: show("data set", done, samples))
    trainer = PlannerTrainer(run.config, run)
    trainer.resume()
    run.start_clock("planner")
    if not trainer.finished:
        run.note_code(code)
    total = config.planner.epochs * samples
    trainer.train(lambda now: show("training", now.done, total) if now.stage == "training" else None)
    run.close()
    radius = trainer.labels.radius
    layouts = [
        sample_layout(parse_world(world), int(s), radius)
        for s in np.random.SeedSequence((0x7AB1E,)).generate_state(episodes)
    ]
    result = walk(torch_planner(trainer.network, trainer.labels), layouts, radius)
    return {
        "samples": samples,
        "preset": preset,
        "seed": seed,
        "world": world,
        "robot": robot,
        "episodes": episodes,
        "epochs": config.planner.epochs,
        **result.summary(),
        "collisions_std": float(result.collisions.std(ddof=1)) if episodes > 1 else float("nan"),
        "error_m": trainer.validation["error"],
    }
