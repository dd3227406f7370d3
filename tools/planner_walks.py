#!/usr/bin/env python3
"""Plans without physics: a disc walks along them in every kind of world, with the network, with repair, and with A*.

    python tools/planner_walks.py --bundle deploy/bundles/point --json runs/planner_walks.json

Five waypoints, a new plan, and so on to the goal; every waypoint that touches an obstacle counts 1. The disc has the
bundle's planning radius. With repair no waypoint may touch anything: the exit code is 1 if one does.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from bad_input import exit_code, whole

from hiernav.evaluate import evaluate_plans, open_policies
from hiernav.files import write_json
from hiernav.reproduce.experiments import WORLDS
from hiernav.reproduce.work import WALKERS
from hiernav.sim.factory import expert_planner
from hiernav.sim.layout import parse_world


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--bundle", default="deploy/bundles/point", help="(deploy/bundles/point)")
    source.add_argument("--run", help="a run folder instead")
    parser.add_argument("--world", action="append", metavar="WORLD", help="repeat for several (the six of the paper)")
    parser.add_argument("--episodes", type=whole(), default=1000, help="per world (1000)")
    parser.add_argument("--seed", type=whole(0), default=0, help="decides the worlds (0)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    arguments = parser.parse_args()
    worlds = [(world, parse_world(world)) for world in arguments.world or WORLDS]
    policies = open_policies(arguments.run or arguments.bundle)
    radius = expert_planner(policies.config).radius
    rows, touched = [], 0
    print(f"disc of radius {radius} m, {arguments.episodes} episodes a world, seed {arguments.seed}")
    print(f"{'world':>16} {'planner':>13} {'collisions':>10} {'clean':>7} {'reach':>7} {'plans':>6} {'repaired':>9}")
    for world, spec in worlds:
        for name, (kind, repair) in WALKERS.items():
            row = evaluate_plans(policies, spec, kind, repair, arguments.episodes, arguments.seed)
            rows.append(row)
            verified = name == "verified"
            touched += verified * row["collisions_total"]
            share = f"{row['repairs'] / row['proposals']:.4f}" if verified else "-"
            print(
                f"{world:>16} {name:>13} {row['collisions_mean']:10.3f} {row['collision_free_rate']:7.3f} "
                f"{row['reach_rate']:7.3f} {row['plans_mean']:6.2f} {share:>9}",
                flush=True,
            )
    if arguments.json:
        write_json(arguments.json, rows)
    if touched:
        print(f"{touched} waypoints of verified plans touch an obstacle", file=sys.stderr)
    return 1 if touched else 0


if __name__ == "__main__":
    sys.exit(exit_code("planner_walks", main))
