#!/usr/bin/env python3
"""Drive a robot with an exported bundle at a fixed rate, without torch.

The simulated robot has noisy sensors; the policies see the estimate alone. Every drive leaves a picture, the run a
summary on screen and as JSON. Ctrl-C brakes the robot, verifies that it stands, and still writes the summary.

Exit codes: 0 done or interrupted; 1 a fault; 2 bad input; 3 a bundle that must not be used.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console

from hiernav.nav.bundle import Bundle, BundleError, file_sha256, load_bundle
from hiernav.nav.observation import observation_layout
from hiernav.nav.search import is_solvable
from hiernav.runtime.clock import FakeClock, MonotonicClock
from hiernav.runtime.driver import Driver, DriverConfig
from hiernav.runtime.estimator import Estimator, EstimatorConfig
from hiernav.runtime.guard import Guard, GuardConfig
from hiernav.runtime.observe import Observer, TickRecord
from hiernav.runtime.pilot import Pilot
from hiernav.runtime.policy import make_agent
from hiernav.runtime.realtime import request_realtime
from hiernav.runtime.sim_robot import EXACT, SensorNoise, SimRobot
from hiernav.runtime.summary import Episode, print_summary, summarise
from hiernav.sim.layout import GOAL_RADIUS, Layout, WorldSpec, parse_world
from hiernav.sim.robots import RobotSpec, get_robot
from hiernav.sim.worlds import sample_layout

if TYPE_CHECKING:
    from hiernav.runtime.recorder import Recorder

BUNDLES = Path(__file__).resolve().parent / "bundles"
OK, FAULT, BAD_INPUT, BAD_BUNDLE = 0, 1, 2, 3
TILT_LIMIT = np.deg2rad(75.0)
"""Tilt at which a robot with a free base has fallen [rad]."""


class Drive(Observer):
    """What one drive looked like, collected tick by tick for its picture."""

    def __init__(self, robot: SimRobot) -> None:
        self.robot = robot
        self.path: list[np.ndarray] = []
        self.plans: list[np.ndarray] = []
        self.collisions: list[np.ndarray] = []
        self.first_tick_age: float | None = None

    def tick(self, record: TickRecord) -> None:
        if self.first_tick_age is None:
            self.first_tick_age = process_age()
        truth = self.robot.truth()
        self.path.append(truth.pose[:2])
        if record.replanned and record.plan is not None:
            self.plans.append(record.plan)
        if truth.collided:
            self.collisions.append(truth.pose[:2])

    def draw(self, layout: Layout, file: Path, title: str) -> None:
        from hiernav.draw import draw_layout  # matplotlib takes long to import, and the loop need not wait for it

        collisions = np.array(self.collisions).reshape(-1, 2)
        path = np.array(self.path).reshape(-1, 2)
        draw_layout(layout, file, {"path": path, "plans": self.plans, "collisions": collisions, "title": title})


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = _parser().parse_args(_join_goal(sys.argv[1:] if argv is None else argv))
    try:
        return _run(arguments)
    except KeyboardInterrupt:  # before the robot moves or after it stands: there is nothing to brake
        print("run_loop: interrupted", file=sys.stderr)
        return OK
    except BundleError as error:
        print(f"run_loop: bundle refused: {error}", file=sys.stderr)
        return BAD_BUNDLE
    except (ValueError, OSError) as error:
        print(f"run_loop: {' '.join(str(error).split())}", file=sys.stderr)
        return BAD_INPUT


def _join_goal(argv: Sequence[str]) -> list[str]:
    """Have `--goal -1,2` mean `--goal=-1,2`: argparse would take -1,2 for an option."""
    joined = list(argv)
    if "--goal" in joined[:-1]:
        at = joined.index("--goal")
        joined[at : at + 2] = [f"--goal={joined[at + 1]}"]
    return joined


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    pace = parser.add_mutually_exclusive_group()
    pace.add_argument("--realtime", action="store_true", help="at the robot's control rate (default)")
    pace.add_argument("--fast", action="store_true", help="as fast as the machine can; the same for the same seed")
    parser.add_argument("--robot", default="point", help="point, car or doggo (point)")
    parser.add_argument("--bundle", type=Path, metavar="DIR", help="exported policies (deploy/bundles/ROBOT)")
    parser.add_argument("--world", default="pillar(2,2,10)", help="kind of world, or a map's YAML (pillar(2,2,10))")
    parser.add_argument("--seed", type=int, default=0, help="of the first episode; the next ones count up (0)")
    parser.add_argument("--episodes", type=int, default=1, metavar="N", help="how many worlds to cross (1)")
    parser.add_argument("--goal", metavar="X,Y", help="goal in the world frame [m]; the world's own by default")
    parser.add_argument("--exact", action="store_true", help="sensors without noise")
    parser.add_argument("--out", type=Path, metavar="DIR", help="run folder (runs/drive-TIME)")
    parser.add_argument("--record", type=Path, metavar="FILE", help="MCAP file with every tick (hiernav replay FILE)")
    parser.add_argument("--no-pictures", action="store_true", help="draw nothing")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the summary here too")
    return parser


def _run(arguments: argparse.Namespace) -> int:
    if arguments.episodes < 1:
        raise ValueError(f"--episodes is {arguments.episodes}, it must be at least 1")
    spec, world = get_robot(arguments.robot), parse_world(arguments.world)
    goal = None if arguments.goal is None else _parse_goal(arguments.goal)
    bundle = _open_bundle(arguments.bundle or BUNDLES / spec.name, spec)
    layouts = [_layout(world, arguments.seed + k, spec, goal) for k in range(arguments.episodes)]
    noise = EXACT if arguments.exact else SensorNoise()
    clock = FakeClock() if arguments.fast else MonotonicClock()
    robot = SimRobot(spec, layouts[0], noise, layouts[0].seed, None if arguments.fast else clock)
    tilt_limit = TILT_LIMIT if spec.free_base else None
    guard = Guard(spec.action_dim, GuardConfig(slew_limit=bundle.manifest.guard.slew_limit, tilt_limit=tilt_limit))
    driver = Driver(
        robot,
        Pilot(make_agent(bundle, spec.radius, GOAL_RADIUS)),
        robot.occupancy,
        clock,
        Estimator(EstimatorConfig(tilts=spec.free_base)),
        guard,
        DriverConfig(goal_radius=GOAL_RADIUS, max_steps=world.max_steps),
    )
    recorder = _open_recorder(arguments, driver, bundle, spec)
    out = arguments.out or Path("runs") / f"drive-{time.strftime('%Y%m%d-%H%M%S')}"
    out.mkdir(parents=True, exist_ok=True)
    granted = {} if arguments.fast else request_realtime()

    console, episodes, drives = Console(), [], []
    for layout in layouts:
        robot.reset(layout, layout.seed)
        if driver.supervisor.latched:  # a simulated robot is as good as new; a real one is for people to look at
            driver.supervisor.acknowledge(clock.now())
        drive = Drive(robot)
        driver.audience.observers = [drive, *filter(None, [recorder])]
        result = driver.run(layout.goal)
        truth = robot.truth()
        distance = float(np.linalg.norm(truth.pose[:2] - layout.goal))
        episodes.append(Episode(layout.seed, result, truth.collisions, distance))
        drives.append(drive)
        console.print(
            f"seed {layout.seed}: {result.reason} after {result.steps} steps "
            f"({result.seconds:.1f} s), {truth.collisions} collisions",
            highlight=False,
        )
        if driver.interrupted:
            break
    robot.close()
    if recorder is not None:
        recorder.close()

    summary = summarise(episodes, driver.timer, driver.loop, granted)
    summary["recording"] = None if recorder is None else recorder.summary()
    summary["startup_seconds"] = drives[0].first_tick_age
    for file in filter(None, (out / "summary.json", arguments.json)):
        file.write_text(json.dumps(summary, indent=2) + "\n")
    if not arguments.no_pictures:
        for layout, drive, episode in zip(layouts, drives, episodes, strict=False):
            drive.draw(
                layout, out / f"drive-{layout.seed}.png", f"{world}, seed {layout.seed}: {episode.result.reason}"
            )
    print_summary(summary, console)
    if recorder is not None:
        console.print(f"recording: {recorder}", highlight=False)
    console.print(f"run folder: {out}", highlight=False)
    return FAULT if any(episode.result.fault for episode in episodes) else OK


def _open_bundle(path: Path, spec: RobotSpec) -> Bundle:
    """Load a bundle and refuse it unless it fits this robot."""
    bundle = load_bundle(path)
    bundle.require_robot(spec.name, file_sha256(spec.xml_path))
    bundle.require_layout(observation_layout(spec.name, clock="clock" in bundle.layout.names))
    return bundle


def _open_recorder(arguments: argparse.Namespace, driver: Driver, bundle: Bundle, spec: RobotSpec) -> Recorder | None:
    if arguments.record is None:
        return None
    from hiernav.runtime.about import About
    from hiernav.runtime.recorder import Recorder

    about = About(
        robot=spec.name,
        robot_radius=spec.radius,
        goal_radius=driver.config.goal_radius,
        control_period=spec.control_period,
        bundle=str((arguments.bundle or BUNDLES / spec.name).resolve()),
        hashes=dict(bundle.manifest.files),
        planner_process=driver.pilot.link is not None,
        estimator=driver.estimator.config,
        guard=driver.guard.config,
        world=f"{arguments.world}, seed {arguments.seed}, {arguments.episodes} episodes",
    )
    return Recorder(arguments.record, about.metadata())


def _layout(world: WorldSpec, seed: int, spec: RobotSpec, goal: np.ndarray | None) -> Layout:
    """The world of an episode, with the user's goal if there is one."""
    layout = sample_layout(world, seed, spec.radius)
    if goal is None:
        return layout
    occupancy = layout.occupancy(0.0)
    if not layout.in_field(goal[None])[0]:
        xmin, xmax, ymin, ymax = layout.extent
        raise ValueError(
            f"--goal {goal[0]:g},{goal[1]:g} lies outside the field: x from {xmin:g} to {xmax:g}, "
            f"y from {ymin:g} to {ymax:g} m"
        )
    if not occupancy.is_free(goal, spec.radius):
        raise ValueError(
            f"--goal {goal[0]:g},{goal[1]:g} is less than {spec.radius:g} m from an obstacle in seed {seed}: "
            "choose a free place (hiernav world --png draws the world)"
        )
    if not is_solvable(occupancy, layout.start[:2], goal, spec.radius):
        raise ValueError(f"--goal {goal[0]:g},{goal[1]:g} cannot be reached from the start in seed {seed}")
    return replace(layout, goal=goal)


def process_age() -> float | None:
    """Seconds since this process was started, interpreter and imports included; None where /proc does not tell."""
    try:
        fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
        return time.clock_gettime(time.CLOCK_BOOTTIME) - int(fields[19]) / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError, ValueError, IndexError):
        return None


def _parse_goal(text: str) -> np.ndarray:
    try:
        goal = np.array([float(part) for part in text.split(",")])
    except ValueError:
        goal = np.empty(0)
    if goal.shape != (2,) or not np.isfinite(goal).all():
        raise ValueError(f"--goal {text!r}: expected X,Y in metres, for example --goal 1.2,-0.5")
    return goal


if __name__ == "__main__":
    sys.exit(main())
