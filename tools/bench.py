#!/usr/bin/env python3
"""Benchmarks, each as a ratio within one run: ours beside what bounds it.

    --env     control steps/s of the batched task against bare `mj_step` of the same scenes, and with --safety-python
              against Safety-Gymnasium (see tools/env_peers.py)
    --update  SAC updates/s against the same update hand-written in plain torch, and the machine's matrix-product peak
    --peers   SAC updates/s beside torchrl's plain loop, Stable-Baselines3 and SBX (see tools/sac_peers.py); on request
    --tick    cost of one control step on the robot side, by section
    --loop    the real-time loop in its three processes, 3 minutes (see tools/bench_loop.py); on request
    --plan    cost of a plan and of a labelled sample, and of what they are made of
    --learn   samples/s that the planner network learns from, against plain float32

All but --peers and --loop by default. Close other programs first: ratios survive a busy machine, figures do not.
"""

from __future__ import annotations

import argparse
import platform
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from bad_input import exit_code, positive, whole
from bench_env import bench_env
from bench_loop import bench_loop
from bench_plan import bench_learn, bench_plan
from bench_updates import bench_peers, bench_update

from hiernav.files import write_json

PARTS = ("env", "update", "peers", "tick", "loop", "plan", "learn")
ON_REQUEST = ("peers", "loop")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in PARTS:
        parser.add_argument(f"--{name}", action="store_true", help=f"only the parts that are named: {name}")
    parser.add_argument("--seconds", type=positive, default=4.0, help="spent on each figure (4)")
    parser.add_argument("--threads", type=whole(), default=1, help="for physics and torch (1)")
    parser.add_argument("--hidden", type=whole(), default=256, help="of both layers, for --update and --peers (256)")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="of the updates, for --peers (cpu)")
    parser.add_argument("--peer-python", default=sys.executable, metavar="PATH", help="that the peers are installed in")
    parser.add_argument("--safety-python", metavar="PATH", help="that has Safety-Gymnasium, for --env")
    parser.add_argument("--bundle", type=Path, default=Path("deploy/bundles/point"), help="for --tick and --plan")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    arguments = parser.parse_args()
    parts = [name for name in PARTS if getattr(arguments, name)]
    results: dict[str, Any] = {"machine": platform.processor() or platform.machine(), "threads": arguments.threads}
    for name in parts or [name for name in PARTS if name not in ON_REQUEST]:
        results[name] = BENCHES[name](arguments)
    if arguments.json:
        write_json(arguments.json, results)
    return 0


def bench_tick(arguments: argparse.Namespace) -> dict[str, Any]:
    """A simulated robot driven through ten worlds as fast as the machine can."""
    from hiernav.nav.bundle import load_bundle
    from hiernav.runtime.clock import FakeClock
    from hiernav.runtime.driver import Driver
    from hiernav.runtime.estimate import EstimatorConfig
    from hiernav.runtime.estimator import Estimator
    from hiernav.runtime.pilot import Pilot
    from hiernav.runtime.policy import make_agent
    from hiernav.runtime.sim_robot import SimRobot
    from hiernav.sim.layout import parse_world
    from hiernav.sim.robots import get_robot
    from hiernav.sim.worlds import sample_layout

    bundle = load_bundle(arguments.bundle)
    spec = get_robot(bundle.manifest.robot)
    layouts = [sample_layout(parse_world("pillar(2,2,10)"), seed, spec.radius) for seed in range(10)]
    robot = SimRobot(spec, layouts[0])
    driver = Driver(
        robot,
        Pilot(make_agent(bundle, spec.radius)),
        robot.occupancy,
        FakeClock(),
        Estimator(EstimatorConfig(tilts=spec.free_base)),
    )
    for layout in layouts:
        robot.reset(layout, layout.seed)
        driver.run(layout.goal)
    sections = {"tick": driver.timer.tick.summary()}
    sections |= {name: histogram.summary() for name, histogram in driver.timer.sections.items()}
    for name, entry in sections.items():
        shown = ("-" if entry[key] is None else f"{1e3 * float(entry[key]):7.3f}" for key in ("p50", "p99", "max"))
        print(f"tick {name:10s} p50, p99, max [ms]: {' '.join(shown)}")
    return sections


BENCHES: dict[str, Callable[[argparse.Namespace], Any]] = {
    "env": bench_env,
    "update": bench_update,
    "peers": bench_peers,
    "tick": bench_tick,
    "loop": lambda arguments: bench_loop(arguments.bundle),
    "plan": bench_plan,
    "learn": bench_learn,
}


if __name__ == "__main__":
    sys.exit(exit_code("bench", main))
