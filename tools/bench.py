#!/usr/bin/env python3
"""Benchmarks, each as a ratio within one run: ours beside what bounds it.

    --env     control steps/s of the batched task against bare `mj_step` of the same scenes
    --update  SAC updates/s against the same update hand-written in plain torch, and the machine's matrix-product peak
    --tick    cost of one control step on the robot side, by section
    --plan    cost of a shortest-path field, a GOSELO image and the planner network

All of them by default. Close other programs first: ratios survive a busy machine, figures do not.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

ROBOTS = ("point", "car", "doggo")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("env", "update", "tick", "plan"):
        parser.add_argument(f"--{name}", action="store_true", help=f"only the parts that are named: {name}")
    parser.add_argument("--seconds", type=float, default=4.0, help="spent on each figure (4)")
    parser.add_argument("--threads", type=int, default=1, help="for physics and torch (1)")
    parser.add_argument("--bundle", type=Path, default=Path("deploy/bundles/point"), help="for --tick and --plan")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    arguments = parser.parse_args()
    parts = [name for name in ("env", "update", "tick", "plan") if getattr(arguments, name)]
    results: dict[str, Any] = {"machine": platform.processor() or platform.machine(), "threads": arguments.threads}
    for name in parts or ("env", "update", "tick", "plan"):
        results[name] = globals()[f"bench_{name}"](arguments)
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=2) + "\n")
    return 0


def bench_env(arguments: argparse.Namespace) -> dict[str, Any]:
    """The batched task, observation, reward and expert planning included."""
    return {robot: _bench_robot(robot, arguments) for robot in ROBOTS}


def _bench_robot(robot: str, arguments: argparse.Namespace) -> dict[str, float]:
    """Alternate short stretches of bare physics and of the whole task, so that both see the same machine."""
    import mujoco

    from hiernav.config import load_config
    from hiernav.sim.factory import make_task

    task = make_task(load_config(None, [f"robot={robot}", f"threads={arguments.threads}"]), 32)
    task.reset()
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (64, task.num_rows, task.robot.action_dim))
    model, bare = task.sim.model, [mujoco.MjData(task.sim.model) for _ in range(task.num_rows)]
    turn = 0

    def whole_task() -> int:
        nonlocal turn
        turn += 1
        step = task.step(actions[turn % 64])
        ended = np.flatnonzero(step.terminated | step.truncated)
        if len(ended):
            task.reset(ended)
        return task.num_rows

    def bare_physics() -> int:
        for row, data in enumerate(bare):
            data.ctrl[:] = actions[turn % 64, row]
            mujoco.mj_step(model, data, nstep=task.robot.substeps)
        return task.num_rows

    counts, seconds = np.zeros(2), np.zeros(2)
    while seconds[0] < arguments.seconds:
        for data, source in zip(bare, task.sim.datas, strict=True):
            mujoco.mj_copyData(data, model, source)
        for k, run in enumerate((whole_task, bare_physics)):
            count, spent = _timed(run, 0.1)
            counts[k] += count
            seconds[k] += spent
    rate, limit = counts / seconds
    print(f"env {robot:6s} {rate:8,.0f} steps/s   bare mj_step {limit:8,.0f}   ratio {rate / limit:.2f}")
    return {"steps_per_s": float(rate), "bare_steps_per_s": float(limit), "ratio": float(rate / limit)}


def bench_update(arguments: argparse.Namespace) -> dict[str, Any]:
    """Doggo sizes, batch 256, 256-256."""
    import torch
    from plain_sac import PlainSac
    from tensordict import TensorDict

    from hiernav.nav.observation import observation_layout
    from hiernav.skill.sac import Learner, SacSettings

    torch.set_num_threads(arguments.threads)
    layout, actions, size = observation_layout("doggo"), 12, 256
    rng = torch.Generator().manual_seed(0)
    batch = TensorDict(
        {
            "observation": torch.randn(size, layout.size, generator=rng),
            "action": torch.rand(size, actions, generator=rng) * 2 - 1,
            "next": {
                "observation": torch.randn(size, layout.size, generator=rng),
                "reward": torch.randn(size, 1, generator=rng),
                "done": torch.zeros(size, 1, dtype=torch.bool),
                "terminated": torch.zeros(size, 1, dtype=torch.bool),
            },
        },
        [size],
    )
    learner, plain = Learner(layout, actions, SacSettings()), PlainSac(layout, actions)
    left, right = torch.randn(size, 256), torch.randn(256, 256)
    contenders: dict[str, Callable[[], int]] = {
        "hiernav": lambda: 1 if learner.update(batch.clone(False)) else 1,
        "plain": lambda: plain.update(batch) or 1,
        "matmul": lambda: 1 if left.mm(right) is not None else 1,
    }
    counts, seconds = dict.fromkeys(contenders, 0), dict.fromkeys(contenders, 0.0)
    for warm in contenders.values():
        _timed(warm, 0.2)
    while seconds["hiernav"] < arguments.seconds:
        for name, run in contenders.items():
            count, spent = _timed(run, 0.25)
            counts[name] += count
            seconds[name] += spent
    rates = {name: counts[name] / seconds[name] for name in contenders}
    peak = rates["matmul"] * 2 * size * 256 * 256
    flops = update_flops(layout.size, actions, size, 256)
    print(
        f"update hiernav {rates['hiernav']:.0f}/s   plain torch {rates['plain']:.0f}/s   "
        f"ratio {rates['hiernav'] / rates['plain']:.2f}   peak {peak / 1e9:.0f} GFLOP/s   "
        f"share of peak {rates['hiernav'] * flops / peak:.2f} ({flops / 1e9:.2f} GFLOP an update)"
    )
    return {
        "updates_per_s": rates["hiernav"],
        "plain_updates_per_s": rates["plain"],
        "ratio": rates["hiernav"] / rates["plain"],
        "peak_gflops": peak / 1e9,
        "share_of_peak": rates["hiernav"] * flops / peak,
    }


def update_flops(observation: int, actions: int, batch: int, width: int) -> float:
    """Floating point operations of the matrix products of one update."""
    actor = observation * width + width * width + width * 2 * actions
    critic = (observation + actions) * width + width * width + width
    forward = actor + 2 * critic  # target: next action, twin targets
    forward += 3 * 2 * critic  # critic loss: forward, gradients of weights and inputs
    forward += 3 * actor + 2 * 2 * critic  # actor loss: twin critics forward and input gradients
    return 2.0 * batch * forward


def bench_tick(arguments: argparse.Namespace) -> dict[str, Any]:
    """A simulated robot driven through ten worlds as fast as the machine can."""
    from hiernav.nav.bundle import load_bundle
    from hiernav.runtime.clock import FakeClock
    from hiernav.runtime.driver import Driver
    from hiernav.runtime.estimator import Estimator, EstimatorConfig
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


def bench_plan(arguments: argparse.Namespace) -> dict[str, Any]:
    """One row at a time, as on the robot."""
    from hiernav.nav import goselo
    from hiernav.nav.bundle import load_bundle
    from hiernav.nav.occupancy import VisitMap
    from hiernav.nav.search import PathField
    from hiernav.runtime.policy import load_policies
    from hiernav.sim.layout import parse_world
    from hiernav.sim.worlds import sample_layout

    bundle = load_bundle(arguments.bundle)
    network, channels = load_policies(bundle).planner, bundle.manifest.goselo.channels
    layouts = [sample_layout(parse_world("pillar(2,2,10)"), seed) for seed in range(32)]
    maps = [layout.occupancy(0.0) for layout in layouts]
    visits = [VisitMap(occupancy) for occupancy in maps]
    frames = [goselo.GoseloFrame.of(layout.start[None, :2], layout.goal[None]) for layout in layouts]
    images = [goselo.images([m], [v], f, channels) for m, v, f in zip(maps, visits, frames, strict=True)]
    fields = [PathField(m, layout.goal, 0.1, 0.15) for m, layout in zip(maps, layouts, strict=True)]
    turn = iter(range(10**9))

    def each(call: Callable[[int], Any]) -> Callable[[], int]:
        def run() -> int:
            call(next(turn) % len(layouts))
            return 1

        return run

    parts = {
        "field": each(lambda k: PathField(maps[k], layouts[k].goal, 0.1, 0.15)),
        "waypoints": each(lambda k: fields[k].waypoints(layouts[k].start[:2])),
        "image_paper": each(lambda k: goselo.images([maps[k]], [visits[k]], frames[k])),
        "image": each(lambda k: goselo.images([maps[k]], [visits[k]], frames[k], channels)),
        "network": each(lambda k: network(images[k], frames[k].distance.astype(np.float32))),
    }
    results = {}
    for name, run in parts.items():
        _timed(run, 0.1)
        count, seconds = _timed(run, arguments.seconds / 4)
        results[name] = seconds / count
        print(f"plan {name:12s} {1e3 * seconds / count:7.3f} ms   {count / seconds:8,.0f}/s")
    return results


def _timed(run: Callable[[], int], seconds: float) -> tuple[int, float]:
    """Call `run` for some time; what it counted and the time it took."""
    count, began = 0, time.perf_counter()
    while (spent := time.perf_counter() - began) < seconds:
        count += run()
    return count, spent


if __name__ == "__main__":
    sys.exit(main())
