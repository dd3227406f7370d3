"""From a command line to an exit code."""

from __future__ import annotations

import argparse
import json
import signal
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path

from hiernav.drive.arguments import join_goal, make_parser, require_place, settings_of
from hiernav.drive.episodes import Episodes
from hiernav.drive.exits import BAD_BUNDLE, BAD_GOAL, BAD_INPUT, FAULT, OK
from hiernav.drive.screen import complain, in_one_line, require_writable, save, screen
from hiernav.drive.world import GoalError, given_goal, layout_of
from hiernav.nav.bundle import Bundle, BundleError, file_sha256, load_bundle
from hiernav.nav.occupancy import RESOLUTION
from hiernav.runtime.control import default_socket, tell
from hiernav.runtime.dry_run import print_report, report
from hiernav.runtime.loop import hear_signals, noting_signals, stop_signals
from hiernav.runtime.patient import hurry
from hiernav.runtime.process_planner import ProcessPlanner
from hiernav.runtime.process_robot import ProcessRobot, simulated
from hiernav.runtime.settings import Settings
from hiernav.sim.layout import parse_world
from hiernav.sim.robots import RobotSpec, get_robot

KILLED = "the robot's adapter did not end, and was killed: nothing here has braked the robot since"


def main(argv: Sequence[str] | None, description: str, home: Path) -> int:
    """Run a command line.

    Args:
        argv: of this process if None.
        description: shown by `--help`.
        home: folder with the bundles and the settings of each robot.

    Returns:
        The exit code.
    """
    arguments = make_parser(description, home).parse_args(join_goal(sys.argv[1:] if argv is None else argv))
    for number in stop_signals():
        signal.signal(number, signal.default_int_handler)  # until the loop runs, each of them is a Ctrl-C
    try:
        hear_signals()
        if arguments.tell is not None:
            return _tell(arguments)
        if arguments.seed < 0:
            raise ValueError(f"--seed {arguments.seed}, it must not be negative")
        require_place(arguments)
        return _dry_run(arguments) if arguments.dry_run else _run(arguments)
    except KeyboardInterrupt:  # before the robot moves or after it stands: there is nothing to brake
        hurry()
        complain("interrupted")
        return OK
    except BundleError as error:
        complain(f"bundle refused: {error}")
        return BAD_BUNDLE
    except (ValueError, OSError, RuntimeError) as error:
        complain(in_one_line(error))
        return BAD_GOAL if isinstance(error, GoalError) else BAD_INPUT
    except MemoryError as error:
        complain(in_one_line(error))
        return FAULT


def _tell(arguments: argparse.Namespace) -> int:
    answer = tell(arguments.control or default_socket(), arguments.tell)
    print(json.dumps(answer, indent=2))
    if "taken" in answer:
        return FAULT
    if "refused" in answer:
        return BAD_GOAL
    return BAD_INPUT if "error" in answer else OK


def _dry_run(arguments: argparse.Namespace) -> int:
    spec = get_robot(arguments.robot)
    settings = settings_of(arguments, spec)
    bundle = arguments.bundle or arguments.home / "bundles" / spec.name
    if arguments.json not in (None, "-"):
        require_writable(Path(arguments.json), "--json")
    layout_of(parse_world(arguments.world), arguments.seed, spec, given_goal(arguments), not arguments.adapter)
    made: list[ProcessRobot] = []
    with ExitStack() as stack:

        def make() -> ProcessRobot:
            made.append(_process_robot(arguments, spec, settings, stack))
            return made[0]

        found = report(lambda: open_bundle(bundle, spec), make, settings)
    if made and made[0].killed:
        found["robot"] = {**found["robot"], "error": "; ".join(filter(None, (found["robot"].get("error"), KILLED)))}
    print_report(found, screen(arguments))
    if arguments.json == "-":
        print(json.dumps(found, indent=2))
    elif arguments.json:
        save(Path(arguments.json), found)
    if found["bundle"].get("error"):
        return BAD_BUNDLE
    return FAULT if any("error" in part for part in found.values()) else OK


def _run(arguments: argparse.Namespace) -> int:
    if arguments.episodes < 1:
        raise ValueError(f"--episodes is {arguments.episodes}, it must be at least 1")
    view = arguments.view is not None
    if arguments.fast and (arguments.serve or view or arguments.adapter or arguments.planner == "process"):
        raise ValueError("--fast has no real time: it goes with none of --serve, --view, --adapter, --planner process")
    spec, world = get_robot(arguments.robot), parse_world(arguments.world)
    goal = given_goal(arguments)
    settings = settings_of(arguments, spec)
    bundle = open_bundle(arguments.bundle or arguments.home / "bundles" / spec.name, spec)
    stack, remote, link = ExitStack(), None, None
    try:
        if not arguments.fast:  # it starts, and then the planner, while the rest is made ready
            remote = _process_robot(arguments, spec, settings, stack)
        start_known = not arguments.adapter
        layouts = [layout_of(world, arguments.seed + k, spec, goal, start_known) for k in range(arguments.episodes)]
        if not arguments.fast and arguments.planner != "sync":
            pixels, driver = layouts[0].occupancy(0.0).occupied.size, settings.driver
            link = ProcessPlanner(bundle, driver.robot_radius, pixels, goal_radius=driver.goal_radius)
            stack.callback(link.close)
        episodes = Episodes(arguments, layouts, spec, settings, bundle, remote, link)
        code = episodes.serve() if arguments.serve or view else episodes.drive()
    finally:
        with noting_signals(lambda: None):  # however often an end is asked for: no process is left behind
            stack.close()
        killed = remote is not None and remote.killed
        if killed:
            complain(KILLED)
    return code or (FAULT if killed else OK)


def _process_robot(
    arguments: argparse.Namespace, spec: RobotSpec, settings: Settings, stack: ExitStack
) -> ProcessRobot:
    """The robot behind an adapter in its own process, which is closed with `stack`."""
    if arguments.adapter:
        robot = ProcessRobot(arguments.adapter, realtime=settings.realtime)
    else:
        noise = asdict(settings.noise)
        robot = simulated(settings.realtime, robot=spec.name, world=arguments.world, seed=arguments.seed, noise=noise)
    stack.callback(robot.close)
    return robot


def open_bundle(path: Path, spec: RobotSpec) -> Bundle:
    """Load a bundle and refuse it unless it fits this robot."""
    bundle = load_bundle(path)
    bundle.require_robot(spec.name, file_sha256(spec.xml_path))
    bundle.require_layout(spec.observation_layout(clock="clock" in bundle.layout.names))
    bundle.require_resolution(RESOLUTION)
    return bundle
