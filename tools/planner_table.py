#!/usr/bin/env python3
"""The waypoint generator's table: collisions per episode against the number of samples (paper, Table II).

Trains every combination of data set size, network and seed, and lets a disc walk along the plans, unrepaired, in worlds
it has never seen: five waypoints, a new plan, and so on; every waypoint that touches an obstacle counts 1.

    python tools/planner_table.py --out runs/planner_table                                  # all of it: hours
    python tools/planner_table.py --out runs/planner_table --samples 1000 --seeds 0         # a part of it
    python tools/planner_table.py --out runs/planner_table --only-print                     # what there is so far

Stop it at any time: the same command goes on. Results are in OUT/table.json, one entry per combination, all of one
world, robot, number of walks and settings; others need another OUT.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

from bad_input import exit_code, whole

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from hiernav.files import write_json
from hiernav.report.paper import TABLE2


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/planner_table"), help="folder of runs and results")
    parser.add_argument(
        "--samples", type=whole(), nargs="+", default=list(TABLE2), help="sizes (1000 10000 50000 100000)"
    )
    parser.add_argument("--presets", nargs="+", default=["paper", "default"], choices=("paper", "default"))
    parser.add_argument("--seeds", type=whole(0), nargs="+", default=[0, 1, 2], help="of training (0 1 2)")
    parser.add_argument("--world", default="pillar(2,2,10)", help="for training and walks (pillar(2,2,10))")
    parser.add_argument("--robot", default="point", help="whose radius (point: 0.1 m)")
    parser.add_argument("--episodes", type=whole(), default=1000, help="walks (1000)")
    parser.add_argument("--threads", type=whole(), default=2, help="of training (2)")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="further settings of every run")
    parser.add_argument("--only-print", action="store_true", help="train nothing")
    arguments = parser.parse_args()
    results = _read(arguments.out / "table.json")
    _require_same(arguments, results)
    queue = [
        (samples, preset, seed)
        for samples in sorted(arguments.samples)
        for preset in arguments.presets
        for seed in arguments.seeds
    ]
    wanted = {_name(*job): job for job in queue}
    if not arguments.only_print:
        missing = [job for name, job in wanted.items() if name not in results]
        for number, job in enumerate(missing):
            began = time.perf_counter()
            print(f"[{number + 1} of {len(missing)}] {_name(*job)}", flush=True)
            results[_name(*job)] = _run(arguments, *job)
            write_json(arguments.out / "table.json", results)
            print(f"    {_line(results[_name(*job)])}  {time.perf_counter() - began:.0f} s", flush=True)
    _print(results)
    return 0


def _run(arguments: argparse.Namespace, samples: int, preset: str, seed: int) -> dict[str, Any]:
    """Train one planner, or go on training it, and walk."""
    import torch

    from hiernav.planner.table import measure

    torch.set_num_threads(arguments.threads)
    began, shown = time.perf_counter(), _show()
    result = measure(
        arguments.out,
        samples,
        preset,
        seed,
        world=arguments.world,
        robot=arguments.robot,
        episodes=arguments.episodes,
        threads=arguments.threads,
        settings=arguments.set,
        on_progress=shown,
    )
    return {**result, "seconds": round(time.perf_counter() - began, 1), "settings": arguments.set}


def _show() -> Any:
    """Progress with a rate, one line every 20 s."""
    began: dict[str, float] = {}
    last = time.perf_counter()

    def show(what: str, done: int, total: int) -> None:
        nonlocal last
        now = time.perf_counter()
        began.setdefault(what, now)
        if now - last > 20.0:
            last = now
            rate = max(done, 1) / max(now - began[what], 1e-6)
            left = (total - done) / rate / 60
            print(f"    {what}: {done:,} of {total:,}  {rate:,.0f}/s  {left:.1f} min left", flush=True)

    return show


def _name(samples: int, preset: str, seed: int) -> str:
    return f"{preset}-{samples}-{seed}"


def _line(result: dict[str, Any]) -> str:
    return f"collisions {result['collisions_mean']:.3f}  reach {result['reach_rate']:.3f}"


def _print(results: dict[str, dict[str, Any]]) -> None:
    import numpy as np

    print(f"\n{'samples':>8}  {'paper says':>10}  " + "  ".join(f"{preset:>16}" for preset in ("paper", "default")))
    for samples in sorted({r["samples"] for r in results.values()}):
        cells = []
        for preset in ("paper", "default"):
            found = [r for r in results.values() if (r["samples"], r["preset"]) == (samples, preset)]
            values = [r["collisions_mean"] for r in found]
            spread = f" ± {np.std(values, ddof=1):.2f}" if len(values) > 1 else ""
            cells.append(f"{np.mean(values):.3f}{spread} ({len(values)})" if values else "-")
        print(f"{samples:8,}  {TABLE2.get(samples, float('nan')):10.2f}  " + "  ".join(f"{cell:>16}" for cell in cells))
    print("collisions per episode, mean over seeds ± standard deviation (seeds)")


def _read(file: Path) -> dict[str, Any]:
    return json.loads(file.read_text()) if file.exists() else {}


def _require_same(arguments: argparse.Namespace, results: dict[str, Any]) -> None:
    """Raise if there are results that would stand in the table beside others than their own kind."""
    wanted = {
        "world": arguments.world, "robot": arguments.robot, "episodes": arguments.episodes, "settings": arguments.set,
    }  # fmt: skip
    for name, result in results.items():
        if different := [key for key, value in wanted.items() if result.get(key) != value]:
            there = ", ".join(f"{key} {result.get(key)}" for key in different)
            raise ValueError(f"{arguments.out / 'table.json'}: {name} is of {there}; choose another --out")


if __name__ == "__main__":
    sys.exit(exit_code("planner_table", main))
