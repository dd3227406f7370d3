#!/usr/bin/env python3
"""Plans without physics: a disc walks along them in every kind of world, with the network, with repair, and with A*.

    python tools/planner_walks.py --bundle deploy/bundles/point --json runs/planner_walks.json

Five waypoints, a new plan, and so on to the goal; every waypoint that touches an obstacle counts 1. The disc has the
bundle's planning radius. With repair no waypoint may touch anything: the exit code is 1 if one does.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from hiernav.evaluate import make_planner, open_policies
from hiernav.nav.planners import VerifiedPlanner
from hiernav.sim.factory import expert_planner
from hiernav.sim.layout import parse_world
from hiernav.sim.walk import walk
from hiernav.sim.worlds import sample_layout

WORLDS = ("pillar(2,2,10)", "gremlin", "pillar(3,3,25)", "pillar(4,4,40)", "two-room", "four-room")
PLANNERS = {"cnn": ("cnn", False), "cnn + repair": ("cnn", True), "astar": ("astar", False)}
CHUNK = 100  # episodes side by side


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--bundle", default="deploy/bundles/point", help="(deploy/bundles/point)")
    source.add_argument("--run", help="a run folder instead")
    parser.add_argument("--world", action="append", metavar="WORLD", help="repeat for several (the six of the paper)")
    parser.add_argument("--episodes", type=int, default=1000, help="per world (1000)")
    parser.add_argument("--seed", type=int, default=0, help="decides the worlds (0)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    arguments = parser.parse_args()
    policies = open_policies(arguments.run or arguments.bundle)
    radius = expert_planner(policies.config).radius
    rows, touched = [], 0
    print(f"disc of radius {radius} m, {arguments.episodes} episodes a world, seed {arguments.seed}")
    print(f"{'world':>16} {'planner':>13} {'collisions':>10} {'clean':>7} {'reach':>7} {'plans':>6} {'repaired':>9}")
    for world in arguments.world or WORLDS:
        seeds = np.random.SeedSequence((arguments.seed, 0x3A1C)).generate_state(arguments.episodes)
        layouts = [sample_layout(parse_world(world), int(seed), radius) for seed in seeds]
        for name, (kind, repair) in PLANNERS.items():
            planner, began = make_planner(policies, kind, repair), time.perf_counter()
            parts = [walk(planner, layouts[k : k + CHUNK], radius) for k in range(0, len(layouts), CHUNK)]
            collisions = np.concatenate([part.collisions for part in parts])
            reached = np.concatenate([part.reached for part in parts])
            row: dict[str, Any] = {
                "world": world,
                "planner": name,
                "episodes": len(layouts),
                "radius_m": radius,
                "collisions_mean": float(collisions.mean()),
                "collision_free_rate": float((collisions == 0).mean()),
                "reach_rate": float(reached.mean()),
                "plans_mean": float(np.concatenate([part.plans for part in parts]).mean()),
                "seconds": round(time.perf_counter() - began, 1),
            }
            share = "-"
            if isinstance(planner, VerifiedPlanner):
                row |= planner.counts()
                share = f"{planner.repairs / planner.proposals:.4f}"
                touched += int(collisions.sum())
            rows.append(row)
            print(
                f"{world:>16} {name:>13} {row['collisions_mean']:10.3f} {row['collision_free_rate']:7.3f} "
                f"{row['reach_rate']:7.3f} {row['plans_mean']:6.2f} {share:>9}",
                flush=True,
            )
    if arguments.json:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n")
    if touched:
        print(f"{touched} waypoints of verified plans touch an obstacle", file=sys.stderr)
    return 1 if touched else 0


if __name__ == "__main__":
    sys.exit(main())
