"""A folder of results that nobody has measured, for every cell of the catalogue."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from hiernav.evaluate import wilson_interval
from hiernav.reproduce.cells import Cell
from hiernav.reproduce.experiments import catalogue
from hiernav.reproduce.results import Machine, Result, write_result

ROOT = Path(__file__).parents[2]


CELLS = {cell.id: cell for cell in catalogue(ROOT)}
_MACHINE = Machine(cpu="abacus", cores=2, system="Linux x86_64", versions={"hiernav": "0.1.0"})


def result_of(cell: Cell, **changes: Any) -> Result:
    """A result with numbers that depend on the cell's name alone."""
    rng = np.random.default_rng(zlib.crc32(cell.id.encode()))
    metrics: dict[str, Any] = {}
    curves = {}
    if cell.kind == "table2":
        metrics = {"samples": cell.settings["samples"], "collisions_mean": round(float(rng.uniform(0.2, 3.0)), 3)}
    elif cell.kind == "film":
        metrics = {"file": f"{cell.name}.gif", "bytes": 43, "reached": 2}
    elif cell.kind == "walk":
        metrics = {name: walk(rng, repairs=name == "verified") for name in ("network", "verified", "astar")}
    elif cell.experiment == "planners":
        metrics = {"last": {"error": 0.06}}
    else:
        metrics = {"strict": drive(rng, 1000)} | (
            {"paper": drive(rng, 200)} if cell.settings.get("paper_episodes") else {}
        )
    if cell.kind == "train" and cell.experiment != "planners":
        steps = np.linspace(0, 400_000, 9)[1:]
        names = ("reach_rate", "steps_mean", "collisions_mean", "return_mean")
        rise = 1 - np.exp(-steps / rng.uniform(5e4, 2e5))
        values = {"reach_rate": rise, "steps_mean": 300 - 240 * rise, "collisions_mean": 5 - 4 * rise}
        values["return_mean"] = 8 * rise
        curves = {
            "evaluation": [
                {"step": float(step), **{name: float(values[name][k]) for name in names}}
                for k, step in enumerate(steps)
            ]
        }
    made = Result(
        experiment=cell.experiment, cell=cell.name, state="done", key="0123456789abcdef",
        robot=cell.robot, variant=cell.variant, seed=cell.seed, world=cell.world, command=cell.command,
        settings=cell.settings, source={}, commit="0123456789abcdef", dirty=False, started="2020-01-01T00:00:00+0000",
        seconds=36.0, machine=_MACHINE, metrics=metrics, curves=curves,
    )  # fmt: skip
    return msgspec.structs.replace(made, **changes)


def walk(rng: np.random.Generator, repairs: bool) -> dict[str, Any]:
    found = {"collisions_mean": 0.0 if repairs else float(rng.uniform(0, 2)), "reach_rate": float(rng.uniform(0.9, 1))}
    return found | ({"proposals": 4000, "repairs": int(rng.integers(400))} if repairs else {})


def drive(rng: np.random.Generator, episodes: int) -> dict[str, Any]:
    reached = int(rng.uniform(0.85, 1.0) * episodes)
    return {
        "episodes": episodes, "reach_rate": reached / episodes, "reach_ci95": list(wilson_interval(reached, episodes)),
        "steps_mean": float(rng.uniform(40, 200)), "steps_half95": 3.0, "collisions_mean": float(rng.uniform(0, 5)),
        "collisions_half95": 0.2, "collision_free_rate": 0.8 * reached / episodes, "spl_mean": 0.9, "spl_half95": 0.01,
        "return_mean": float(rng.uniform(-80, -20)), "steps_between_plans": float(rng.uniform(6, 60)),
        "endings": {"goal": reached, "timeout": episodes - reached}, "proposals": 100, "repairs": 5,
    }  # fmt: skip


def write_all(folder: Path, change: Callable[[Cell], Result | None] = result_of) -> None:
    """Results of all cells, or what `change` makes of them."""
    for cell in CELLS.values():
        result = change(cell)
        if result is not None:
            write_result(folder, result)
