#!/usr/bin/env python3
"""Reach rate and collisions of a shipped robot against the quality of its sensors and the delay of its planner.

The whole runtime drives, with the settings of deploy/ROBOT.yaml: estimator, guard, supervisor, the learned planner
behind a link that answers late as a process does, and policies that see the estimate alone. Time is simulated, so that
the same command gives the same table. "filter off" gives the policies what the sensors say as it is: the last fix, the
magnetometer's heading.

    python tools/noise_table.py --bundle deploy/bundles/car                # one influence at a time, 200 worlds each
    python tools/noise_table.py --bundle deploy/bundles/car --factorial    # every combination: hours
    python tools/noise_table.py --bundle deploy/bundles/car --only-print   # what there is so far

Stop it at any time: the same command goes on. Beside the table stands the noise-free evaluation of the same worlds.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
import time
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from bad_input import exit_code, whole  # noqa: E402

from hiernav.drive.arguments import robot_settings  # noqa: E402
from hiernav.files import write_json  # noqa: E402
from hiernav.nav.bundle import Bundle, load_bundle  # noqa: E402
from hiernav.nav.goal import GOAL_RADIUS  # noqa: E402
from hiernav.runtime.clock import FakeClock  # noqa: E402
from hiernav.runtime.delayed_planner import DelayedPlanner  # noqa: E402
from hiernav.runtime.driver import Driver  # noqa: E402
from hiernav.runtime.estimate import Estimate, EstimatorConfig  # noqa: E402
from hiernav.runtime.estimator import Estimator  # noqa: E402
from hiernav.runtime.guard import Guard  # noqa: E402
from hiernav.runtime.noise import EXACT  # noqa: E402
from hiernav.runtime.pilot import Pilot  # noqa: E402
from hiernav.runtime.policy import load_networks, make_agent, make_planner  # noqa: E402
from hiernav.runtime.robot import SensorFrame  # noqa: E402
from hiernav.runtime.sim_robot import SimRobot  # noqa: E402
from hiernav.sim.layout import parse_world  # noqa: E402
from hiernav.sim.robots import get_robot  # noqa: E402
from hiernav.sim.worlds import sample_layout  # noqa: E402

DEPLOY = ROOT / "deploy"
"""Where the robots' settings are."""
CHUNK = 5
"""Worlds driven between two writes of the results."""


@dataclass(frozen=True)
class Case:
    """One row of the table."""

    noise: float = 1.0
    """Factor of the default noise of every sensor."""
    fix_hz: float = 10.0
    latency_ms: int = 0
    """Of the position fix."""
    planner_ms: int = 0
    """Delay of the planner's answer, besides the control period that any answer takes."""
    filter: bool = True

    @property
    def name(self) -> str:
        text = f"noise x{self.noise:g}, fix {self.fix_hz:g} Hz +{self.latency_ms} ms, planner +{self.planner_ms} ms"
        return f"{text}, filter {'on' if self.filter else 'off'}"


LEVELS = {"noise": (1.0, 2.0, 4.0), "fix_hz": (10.0, 5.0, 2.0), "latency_ms": (0, 50, 100), "planner_ms": (0, 100, 300)}
NOISE_FREE = Case(noise=0.0)


class RawEstimator:
    """What the sensors say, as an estimate: the last fix, the magnetometer's heading, the velocimeter's velocity."""

    lacks = ""

    def __init__(self, config: EstimatorConfig) -> None:
        self.config, self.counts = config, Counter[str]()
        self.skill_sensors: Mapping[str, int] | None = None
        self.driven = False
        self.reset()

    def reset(self) -> None:
        self._fix: np.ndarray | None = None

    def renew(self) -> None:
        pass

    def silence(self, sensor: str) -> float:
        """As of `Estimator`; here nothing is given where a sensor says nothing."""
        return 0.0

    def hears(self, sensor: str) -> bool:
        return True

    def update(self, frame: SensorFrame) -> Estimate | None:
        if frame.position_fix is not None:
            self._fix = frame.position_fix
        field, velocity, gyro = frame.magnetometer, frame.velocimeter, frame.gyro
        if self._fix is None or field is None or velocity is None or gyro is None:
            return None
        north = math.atan2(self.config.magnetic_field[1], self.config.magnetic_field[0])
        yaw = math.remainder(north - math.atan2(field[1], field[0]), 2.0 * math.pi)
        cos, sin = math.cos(yaw), math.sin(yaw)
        return Estimate(
            stamp=frame.stamp,
            pose=np.array([*self._fix, yaw]),
            velocity=np.array([cos * velocity[0] - sin * velocity[1], sin * velocity[0] + cos * velocity[1]]),
            covariance=np.eye(6) * 1e-3,
            upright=1.0,
            yaw_rate=float(gyro[2]),
        )


@cache
def _bundle(path: str) -> Bundle:
    return load_bundle(path)


def drive(case: Case, path: str, world: str, seeds: list[int], told: bool) -> dict[str, dict[str, Any]]:
    """Outcome by seed of one case in some worlds."""
    bundle = _bundle(path)
    spec = get_robot(bundle.manifest.robot)
    settings = robot_settings(spec, DEPLOY)
    layouts = [sample_layout(parse_world(world), seed, spec.radius) for seed in seeds]
    plain = EXACT if case == NOISE_FREE else settings.noise
    sigmas = ("accelerometer", "gyro", "magnetometer", "velocimeter", "lidar", "extra", "fix")
    noise = replace(
        plain,
        **{name: case.noise * getattr(plain, name) for name in sigmas},
        fix_period=1.0 / case.fix_hz,
        fix_latency=1e-3 * case.latency_ms,
    )
    config = settings.estimator
    if told and case.noise > 1.0:
        names = ("gyro_sigma", "magnetometer_sigma", "velocimeter_sigma", "fix_sigma")
        config = replace(config, **{name: case.noise * getattr(config, name) for name in names})
    clock = FakeClock()
    link = None
    if case != NOISE_FREE:
        network = load_networks(bundle).planner
        link = DelayedPlanner(make_planner(bundle, network, spec.radius), 1e-3 * case.planner_ms)
    robot = SimRobot(spec, layouts[0], noise, seeds[0])
    driver = Driver(
        robot,
        Pilot(make_agent(bundle, spec.radius, GOAL_RADIUS, link), link),
        robot.occupancy,
        clock,
        Estimator(config) if case.filter else RawEstimator(config),
        Guard(spec.action_dim, settings.guard.limited(bundle.manifest.guard.slew_limit)),
        replace(settings.driver, max_steps=layouts[0].spec.max_steps),
    )
    outcomes = {}
    for layout in layouts:
        robot.reset(layout, layout.seed)
        if driver.supervisor.latched:
            driver.supervisor.acknowledge(clock.now())
        result = driver.run(layout.goal)
        outcomes[str(layout.seed)] = {
            "reached": result.reached,
            "reason": result.reason,
            "fault": result.fault,
            "steps": result.steps,
            "collisions": robot.truth().collisions,
            "holds": sum(result.holds.values()),
            "recoveries": result.recoveries,
        }
    robot.close()
    return outcomes


def cases(factorial: bool) -> list[Case]:
    """Every row of the table."""
    if factorial:
        rows = [Case(*levels) for levels in itertools.product(*LEVELS.values(), (True, False))]
    else:
        base = {name: levels[0] for name, levels in LEVELS.items()}
        changed = [{**base, name: level} for name, levels in LEVELS.items() for level in levels[1:]]
        rows = [Case(**values, filter=on) for on in (True, False) for values in (base, *changed)]  # type: ignore[arg-type]
    return [NOISE_FREE, *rows]


def main() -> int:
    """Fill the table as far as it is missing, and print it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, metavar="FILE", help="results (runs/noise_table-ROBOT.json)")
    parser.add_argument("--bundle", type=Path, default=ROOT / "deploy/bundles/point", help="whose robot drives (point)")
    parser.add_argument("--world", default="pillar(2,2,10)", help="kind of world (%(default)s)")
    parser.add_argument("--episodes", type=whole(), default=200, help="worlds of each row (200)")
    parser.add_argument("--seed", type=whole(0), default=0, help="of the first world (0)")
    parser.add_argument("--factorial", action="store_true", help="every combination")
    parser.add_argument("--untold", action="store_true", help="do not tell the filter of sensors noisier than default")
    parser.add_argument("--workers", type=whole(), default=1, help="processes (1)")
    parser.add_argument("--only-print", action="store_true", help="drive nothing")
    arguments = parser.parse_args()
    bundle = load_bundle(arguments.bundle)
    robot = bundle.manifest.robot
    arguments.out = arguments.out or Path("runs") / f"noise_table-{robot}.json"
    settings = asdict(robot_settings(get_robot(robot), DEPLOY))
    about = {
        "robot": robot,
        "bundle": bundle.manifest.files,
        "world": arguments.world,
        "told": not arguments.untold,
        # as they are read back from a file
        "settings": json.loads(
            json.dumps({name: settings[name] for name in ("driver", "estimator", "guard", "noise")})
        ),
    }
    results = _read(arguments.out, about)
    rows = cases(arguments.factorial)
    if not arguments.only_print:
        try:
            _fill(arguments, results, rows)
        except KeyboardInterrupt:
            print("stopped; the same command goes on", file=sys.stderr)
    _print(results, rows)
    return 0


def _fill(arguments: argparse.Namespace, results: dict[str, Any], rows: list[Case]) -> None:
    jobs = []
    for case in rows:
        done = results["cases"].setdefault(case.name, {"case": asdict(case), "worlds": {}})["worlds"]
        seeds = [s for s in range(arguments.seed, arguments.seed + arguments.episodes) if str(s) not in done]
        jobs += [(case, seeds[k : k + CHUNK]) for k in range(0, len(seeds), CHUNK)]
    began, total = time.perf_counter(), sum(len(seeds) for _, seeds in jobs)
    driven = 0
    with ProcessPoolExecutor(arguments.workers, get_context("spawn")) as pool:
        path = str(arguments.bundle)
        futures = [
            (case, pool.submit(drive, case, path, arguments.world, seeds, not arguments.untold)) for case, seeds in jobs
        ]
        try:
            for case, future in futures:
                outcomes = future.result()
                results["cases"][case.name]["worlds"].update(outcomes)
                _write(arguments.out, results)
                driven += len(outcomes)
                rate = driven / (time.perf_counter() - began)
                print(f"{driven} of {total}  {rate:.2f} worlds/s  {(total - driven) / rate:.0f} s left  {case.name}")
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _read(path: Path, about: dict[str, Any]) -> dict[str, Any]:
    if not path.exists():
        return {"about": about, "cases": {}}
    results = json.loads(path.read_text())
    if results["about"] != about:
        different = [name for name in about if results["about"].get(name) != about[name]]
        raise SystemExit(f"{path}: results of another {' and '.join(different)}; choose another --out")
    return results


def _write(path: Path, results: dict[str, Any]) -> None:
    for entry in results["cases"].values():
        entry["summary"] = _summary(entry["worlds"])
    write_json(path, results)


def _summary(worlds: dict[str, dict[str, Any]]) -> dict[str, Any]:
    from hiernav.evaluate import wilson_interval

    outcomes = list(worlds.values())
    if not outcomes:
        return {"episodes": 0}
    reached = sum(each["reached"] for each in outcomes)
    return {
        "episodes": len(outcomes),
        "reach": reached / len(outcomes),
        "reach_95": wilson_interval(reached, len(outcomes)),
        "collisions": float(np.mean([each["collisions"] for each in outcomes])),
        "collision_free": float(np.mean([each["reached"] and each["collisions"] == 0 for each in outcomes])),
        "steps": float(np.mean([each["steps"] for each in outcomes if each["reached"]])) if reached else None,
        "ends": dict(Counter(each["reason"] for each in outcomes)),
    }


def _print(results: dict[str, Any], rows: list[Case]) -> None:
    from rich.console import Console
    from rich.table import Table

    about = results["about"]
    table = Table(title=f"{about['robot']} in {about['world']}", title_justify="left")
    for column in ("noise", "fix [Hz]", "latency [ms]", "planner [ms]", "filter", "worlds", "reach", "95 %",
                   "collisions", "collision-free", "steps"):  # fmt: skip
        table.add_column(column, justify="right")
    for case in rows:
        found = _summary(results["cases"].get(case.name, {"worlds": {}})["worlds"])
        if not found["episodes"]:
            continue
        settings = ["none"] if case == NOISE_FREE else [f"x {case.noise:g}"]
        settings += [f"{case.fix_hz:g}", str(case.latency_ms)]
        settings += ["in step" if case == NOISE_FREE else str(case.planner_ms), "on" if case.filter else "off"]
        low, high = found["reach_95"]
        steps = "-" if found["steps"] is None else f"{found['steps']:.1f}"
        table.add_row(*settings, str(found["episodes"]), f"{found['reach']:.3f}", f"{low:.3f} - {high:.3f}",
                      f"{found['collisions']:.2f}", f"{found['collision_free']:.3f}", steps)  # fmt: skip
    Console(width=120).print(table)


if __name__ == "__main__":
    sys.exit(exit_code("noise_table", main))
