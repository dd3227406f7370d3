#!/usr/bin/env python3
"""How long a plan takes against the size of the field, for the network, for A*, and for the network with verification.

    python tools/planner_scale.py --png docs/planner_scale.png --json runs/planner_scale.json

Fields of half-size 2 to 32 m with pillars as dense as in pillar(2,2,10); medians over worlds, one row at a time as on
the robot, one thread. Each planner in two cases:

    new map    the map has just changed, as with moving obstacles: A* searches, distances and pyramids are computed
    same map   the map and the goal are those of the last plan
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from bad_input import exit_code, positive, whole

from hiernav.files import write_json
from hiernav.nav.bundle import load_bundle
from hiernav.nav.occupancy import OccupancyMap, VisitMap
from hiernav.nav.option import Planner, PlanQuery
from hiernav.nav.planners import GoseloPlanner, ShortestPathPlanner, VerifiedPlanner
from hiernav.runtime.policy import load_networks
from hiernav.sim.layout import Layout, parse_world
from hiernav.sim.worlds import sample_layout

DENSITY = 10 / 16  # pillars per square metre, as in pillar(2,2,10)
COLORS = {"cnn": "#2b6cb0", "cnn + verification": "#2f855a", "astar": "#dd6b20"}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bundle", type=Path, default=Path("deploy/bundles/point"), help="(deploy/bundles/point)")
    parser.add_argument(
        "--half-sizes", type=positive, nargs="+", default=[2, 4, 8, 16, 32], metavar="M", help="of fields"
    )
    parser.add_argument("--worlds", type=whole(), default=8, help="of each size (8)")
    parser.add_argument("--repeats", type=whole(), default=3, help="of every plan, the fastest counts (3)")
    parser.add_argument("--png", type=Path, metavar="FILE", help="write a plot")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    arguments = parser.parse_args()
    bundle = load_bundle(arguments.bundle)
    network, plan = load_networks(bundle).planner, bundle.manifest.plan
    radius = plan.planning_radius_m

    def planner_of(name: str) -> Planner:
        """A new one, which knows no map."""
        expert = ShortestPathPlanner(radius, plan.soft_margin_m)
        proposer = GoseloPlanner(network, bundle.manifest.goselo.channels, radius, plan.soft_margin_m)
        return {"cnn": proposer, "cnn + verification": VerifiedPlanner(proposer, expert, radius), "astar": expert}[name]

    rows = []
    print(f"{'half-size':>9} {'case':>9} " + " ".join(f"{name:>20}" for name in COLORS) + "   median, worst [ms]")
    for half in arguments.half_sizes:
        spec = parse_world(f"pillar({half:g},{half:g},{min(2000, round(DENSITY * 4 * half * half))})")
        layouts = [sample_layout(spec, seed, radius) for seed in range(arguments.worlds)]
        for case in ("new map", "same map"):
            row: dict[str, Any] = {"half_size_m": half, "obstacles": spec.num_obstacles, "case": case}
            for name in COLORS:
                times = [_time_plan(planner_of(name), layout, case, arguments.repeats) for layout in layouts]
                row[name] = {"median_ms": 1e3 * float(np.median(times)), "max_ms": 1e3 * float(np.max(times))}
            rows.append(row)
            cells = (f"{row[name]['median_ms']:10.2f} {row[name]['max_ms']:9.2f}" for name in COLORS)
            print(f"{half:7g} m {case:>9} " + " ".join(f"{cell:>20}" for cell in cells), flush=True)
    if arguments.json:
        write_json(arguments.json, rows)
    if arguments.png:
        _plot(rows, arguments.png)
        print(f"wrote {arguments.png}")
    return 0


def _time_plan(planner: Planner, layout: Layout, case: str, repeats: int) -> float:
    """Seconds of one plan from the start of a world: the fastest of some."""
    known, best = layout.occupancy(0.0), np.inf
    start, goal = layout.start[None, :2], layout.goal[None]
    for repeat in range(repeats + (case == "same map")):
        occupancy = known if case == "same map" else OccupancyMap(known.occupied, known.resolution, known.origin)
        query = PlanQuery(start, goal, [occupancy], [VisitMap(occupancy)], np.full((1, 10, 2), np.nan))
        began = time.perf_counter()
        planner.plan(query)
        spent = time.perf_counter() - began
        if case == "new map" or repeat > 0:  # the first one on a map makes what the others find
            best = min(best, spent)
    return best


def _plot(rows: list[dict[str, Any]], path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0, 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for case, style in (("new map", "-"), ("same map", "--")):
        chosen = [row for row in rows if row["case"] == case]
        for name, color in COLORS.items():
            axes.plot(
                [row["half_size_m"] for row in chosen],
                [row[name]["median_ms"] for row in chosen],
                style,
                color=color,
                marker="o",
                label=f"{name}, {case}",
            )
    axes.set(xscale="log", yscale="log", xlabel="half-size of the field [m]", ylabel="time of a plan, median [ms]")
    axes.set_xticks([row["half_size_m"] for row in rows], [f"{row['half_size_m']:g}" for row in rows])
    axes.minorticks_off()
    axes.grid(color="#e2e0da")
    axes.legend(fontsize=7)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    sys.exit(exit_code("planner_scale", main))
