#!/usr/bin/env python3
"""Drive a robot with an exported bundle at a fixed rate, without torch.

The robot is a simulated one with noisy sensors, or yours (--adapter); the policies see the estimate alone. In real time
the planner and the robot's adapter live in processes of their own. Every drive in simulation leaves a picture, the run
a summary on screen and as JSON. Ctrl-C, SIGTERM and SIGHUP brake the robot, have it verified that it stands, and still
write the summary.

  run_loop.py --episodes 10                       ten simulated worlds
  run_loop.py --serve                             be ready for goals, until Ctrl-C
  run_loop.py --tell "goal 1.2,-0.5"              command the loop that runs: goal X,Y, cancel, pause, resume, stop,
                                                  acknowledge, status, quit
  run_loop.py --view                              drive in a simulated world, and watch and click in the browser
  run_loop.py --dry-run                           check bundle, robot and host; nothing moves

Settings (--set guard.slow_ttc=0.5, or a YAML file with sections) are those of driver, estimator, guard, realtime and
noise.
Exit codes: 0 done or interrupted; 1 a fault (with --serve and --view one that nobody has acknowledged); 2 bad input;
3 a bundle that must not be used; 4 a goal that cannot be driven to.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import time
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from rich.console import Console

from hiernav import __version__
from hiernav.decode import ConfigError
from hiernav.nav.bundle import Bundle, BundleError, file_sha256, load_bundle
from hiernav.nav.goal import GOAL_RADIUS
from hiernav.nav.occupancy import RESOLUTION
from hiernav.runtime.account import KEPT, Account, FaultWatch, GoalWatch
from hiernav.runtime.clock import Clock, FakeClock, MonotonicClock, process_age
from hiernav.runtime.control import ControlServer, default_socket, parse_point, tell
from hiernav.runtime.driver import Driver
from hiernav.runtime.dry_run import print_report, report
from hiernav.runtime.estimator import Estimator
from hiernav.runtime.faulty import FAULTS, FaultyRobot
from hiernav.runtime.guard import Guard
from hiernav.runtime.loop import noting_signals, stop_signals
from hiernav.runtime.noise import EXACT
from hiernav.runtime.observe import Event, Observer, TickRecord
from hiernav.runtime.patient import be_patient, hurry
from hiernav.runtime.pilot import Pilot
from hiernav.runtime.policy import make_agent, require_fit
from hiernav.runtime.process_planner import ProcessPlanner
from hiernav.runtime.process_robot import ProcessRobot, simulated
from hiernav.runtime.realtime import request_realtime
from hiernav.runtime.robot import Robot
from hiernav.runtime.settings import Settings, load_settings
from hiernav.runtime.summary import print_summary, summarise
from hiernav.runtime.supervisor import Mode
from hiernav.runtime.trip import RunResult
from hiernav.sim.layout import Layout, WorldSpec, parse_world
from hiernav.sim.robots import RobotSpec, get_robot
from hiernav.sim.worlds import sample_layout

if TYPE_CHECKING:
    from hiernav.runtime.recorder import Recorder
    from hiernav.view.link import ViewerLink

WORLD = "pillar(2,2,10)"
BUNDLES = Path(__file__).resolve().parent / "bundles"
OK, FAULT, BAD_INPUT, BAD_BUNDLE, BAD_GOAL = 0, 1, 2, 3, 4
PICTURED = 20_000
"""Ticks of a drive that its picture shows at most."""
TILT_LIMIT = 1.31
"""Of a robot that can fall, where no file sets another one [rad]: 75 degrees."""


class GoalError(ValueError):
    """A goal that cannot be driven to."""


class Drive(Observer):
    """What one drive looked like, collected tick by tick for its picture: its end, where it is a long one."""

    def __init__(self) -> None:
        self.path: deque[np.ndarray] = deque(maxlen=PICTURED)
        self.plans: deque[np.ndarray] = deque(maxlen=PICTURED)
        self.collisions: deque[np.ndarray] = deque(maxlen=PICTURED)
        self.armed_age: float | None = None

    def event(self, event: Event) -> None:
        if self.armed_age is None and event.values.get("mode") == "armed":
            self.armed_age = process_age()

    def tick(self, record: TickRecord) -> None:
        if record.truth is None:
            return
        self.path.append(record.truth.pose[:2])
        if record.replanned and record.plan is not None:
            self.plans.append(record.plan)
        if record.truth.collided:
            self.collisions.append(record.truth.pose[:2])

    def draw(self, layout: Layout, file: Path, title: str) -> None:
        from hiernav.draw import draw_layout  # matplotlib takes long to import, and the loop need not wait for it

        collisions = np.array(self.collisions).reshape(-1, 2)
        path = np.array(self.path).reshape(-1, 2)
        draw_layout(layout, file, {"path": path, "plans": list(self.plans), "collisions": collisions, "title": title})


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = _parser().parse_args(_join_goal(sys.argv[1:] if argv is None else argv))
    for number in stop_signals():
        signal.signal(number, signal.default_int_handler)  # until the loop runs, each of them is a Ctrl-C
    try:
        if arguments.tell is not None:
            return _tell(arguments)
        if arguments.seed < 0:
            raise ValueError(f"--seed {arguments.seed}, it must not be negative")
        _require_place(arguments)
        return _dry_run(arguments) if arguments.dry_run else _run(arguments)
    except KeyboardInterrupt:  # before the robot moves or after it stands: there is nothing to brake
        hurry()
        _complain("interrupted")
        return OK
    except BundleError as error:
        _complain(f"bundle refused: {error}")
        return BAD_BUNDLE
    except (ValueError, OSError, RuntimeError) as error:
        _complain(" ".join(str(error).split()))
        return BAD_GOAL if isinstance(error, GoalError) else BAD_INPUT


def _require_place(arguments: argparse.Namespace) -> None:
    """Fill in the world of a simulated robot. Where a real one is, and where it is to go, must be said.

    Raises:
        ValueError: it was not.
    """
    if arguments.adapter and not arguments.dry_run:
        if arguments.world is None:
            raise ValueError("--adapter moves a real robot: name the map it is on (--world office.yaml)")
        if arguments.goal is None and not arguments.serve and arguments.view is None:
            raise ValueError(
                "--adapter moves a real robot: name its --goal X,Y, or --serve or --view and give it later"
            )
    arguments.world = arguments.world or WORLD


def _join_goal(argv: Sequence[str]) -> list[str]:
    """Have `--goal -1,2` mean `--goal=-1,2`: argparse would take -1,2 for an option."""
    joined = list(argv)
    if "--goal" in joined[:-1]:
        at = joined.index("--goal")
        joined[at : at + 2] = [f"--goal={joined[at + 1]}"]
    return joined


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--version", action="version", version=__version__)
    pace = parser.add_mutually_exclusive_group()
    pace.add_argument("--realtime", action="store_true", help="at the robot's control rate (default)")
    pace.add_argument("--fast", action="store_true", help="as fast as the machine can; the same for the same seed")
    parser.add_argument("--robot", default="point", help="point, car or doggo (point)")
    parser.add_argument("--bundle", type=Path, metavar="DIR", help="exported policies (deploy/bundles/ROBOT)")
    parser.add_argument("--world", help=f"kind of world, or a map's YAML ({WORLD}; with --adapter there is no default)")
    parser.add_argument("--seed", type=int, default=0, help="of the first episode; the next ones count up (0)")
    parser.add_argument("--episodes", type=int, default=1, metavar="N", help="how many worlds to cross (1)")
    parser.add_argument("--goal", metavar="X,Y", help="goal in the world frame [m]; a simulated world has its own")
    parser.add_argument("--exact", action="store_true", help="sensors without noise")
    parser.add_argument("--adapter", metavar="FILE.py:FUNCTION", help="makes your robot (deploy/README.md)")
    parser.add_argument("--planner", choices=("process", "sync"), help="where plans are made (process; sync if --fast)")
    parser.add_argument("--settings", type=Path, metavar="YAML", help="sections of settings (deploy/ROBOT.yaml)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="one setting, several times")
    parser.add_argument("--serve", action="store_true", help="stay ready for goals instead of driving episodes")
    parser.add_argument("--control", type=Path, metavar="SOCKET", help=f"for --tell and --serve ({default_socket()})")
    parser.add_argument("--tell", metavar="COMMAND", help="command the loop that runs")
    parser.add_argument("--dry-run", action="store_true", help="check everything, and move nothing")
    parser.add_argument("--out", type=Path, metavar="DIR", help="run folder (runs/drive-TIME)")
    parser.add_argument("--record", type=Path, metavar="FILE", help="MCAP file with every tick (hiernav replay FILE)")
    parser.add_argument(
        "--view", nargs="?", type=_port, const=8080, metavar="PORT",
        help="live page in the browser, for this machine alone (8080); stays ready for goals, until Ctrl-C",
    )  # fmt: skip
    parser.add_argument("--no-pictures", action="store_true", help="draw nothing")
    parser.add_argument("--json", metavar="FILE", help="write the summary here too; - for the screen, alone on it")
    return parser


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"{text!r} is no port, expected 0 to 65535")
    return int(text)


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
    settings = _settings(arguments, spec)
    bundle = arguments.bundle or BUNDLES / spec.name
    if arguments.json not in (None, "-"):
        _require_writable(Path(arguments.json), "--json")
    _layout(parse_world(arguments.world), arguments.seed, spec, _given_goal(arguments), not arguments.adapter)
    with ExitStack() as stack:
        make = lambda: _process_robot(arguments, spec, settings, stack)  # noqa: E731
        found = report(lambda: _open_bundle(bundle, spec), make, settings)
    print_report(found, _screen(arguments))
    if arguments.json == "-":
        print(json.dumps(found, indent=2))
    elif arguments.json:
        _save(Path(arguments.json), found)
    if found["bundle"].get("error"):
        return BAD_BUNDLE
    return FAULT if any("error" in part for part in found.values()) else OK


def _settings(arguments: argparse.Namespace, spec: RobotSpec) -> Settings:
    """Those of the robot's file beside this one, with what a file that is named says over them.

    Raises:
        ConfigError: they are wrong, or leave a robot that can fall without a limit of its tilt.
    """
    own = Path(__file__).resolve().parent / f"{spec.name}.yaml"
    paths = [path for path in (own if own.exists() else None, arguments.settings) if path is not None]
    asked = {
        "estimator": {"tilts": spec.free_base},
        "driver": {
            "robot_radius": spec.radius,
            "goal_radius": GOAL_RADIUS,
            "max_steps": parse_world(arguments.world).max_steps,
        },
        "guard": {"tilt_limit": TILT_LIMIT} if spec.free_base else {},
    }
    settings = load_settings(paths, arguments.set, asked)
    if spec.free_base and settings.guard.tilt_limit is None:
        raise ConfigError(f"guard.tilt_limit is null: a {spec.name} can fall, which must be a fault; set it in rad")
    return replace(settings, noise=EXACT) if arguments.exact else settings


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


def _run(arguments: argparse.Namespace) -> int:
    if arguments.episodes < 1:
        raise ValueError(f"--episodes is {arguments.episodes}, it must be at least 1")
    view = arguments.view is not None
    if arguments.fast and (arguments.serve or view or arguments.adapter or arguments.planner == "process"):
        raise ValueError("--fast has no real time: it goes with none of --serve, --view, --adapter, --planner process")
    spec, world = get_robot(arguments.robot), parse_world(arguments.world)
    goal = _given_goal(arguments)
    settings = _settings(arguments, spec)
    bundle = _open_bundle(arguments.bundle or BUNDLES / spec.name, spec)
    stack, remote, link = ExitStack(), None, None
    try:
        if not arguments.fast:  # it starts, and then the planner, while the rest is made ready
            remote = _process_robot(arguments, spec, settings, stack)
        start_known = not arguments.adapter
        layouts = [_layout(world, arguments.seed + k, spec, goal, start_known) for k in range(arguments.episodes)]
        if not arguments.fast and arguments.planner != "sync":
            pixels, driver = layouts[0].occupancy(0.0).occupied.size, settings.driver
            link = ProcessPlanner(bundle, driver.robot_radius, pixels, goal_radius=driver.goal_radius)
            stack.callback(link.close)
        episodes = Episodes(arguments, layouts, spec, settings, bundle, remote, link)
        code = episodes.serve() if arguments.serve or view else episodes.drive()
    finally:
        with noting_signals(lambda: None):  # however often an end is asked for: no process is left behind
            stack.close()
    if remote is not None and remote.killed:
        _complain("the robot's adapter did not end, and was killed: nothing here has braked the robot since")
        return code or FAULT
    return code


class Episodes:
    """One loop and the worlds it drives through."""

    def __init__(
        self,
        arguments: argparse.Namespace,
        layouts: Sequence[Layout],
        spec: RobotSpec,
        settings: Settings,
        bundle: Bundle,
        remote: ProcessRobot | None,
        link: ProcessPlanner | None,
    ) -> None:
        self.arguments, self.layouts, self.remote, self.link = arguments, layouts, remote, link
        self.layout = layouts[0]
        self.interrupted = self.failed = False
        self.serves = serves = arguments.serve or arguments.view is not None
        clock: Clock
        robot: Robot
        if remote is not None:
            clock, robot = MonotonicClock(), remote
            self._reset: Callable[[Layout], object] = lambda layout: remote.call("restart", seed=layout.seed)
        else:
            from hiernav.runtime.sim_robot import SimRobot

            simulated = SimRobot(spec, self.layout, settings.noise, self.layout.seed)
            clock, robot = FakeClock(), simulated
            self._reset = lambda layout: simulated.reset(layout, layout.seed)
        require_fit(bundle, robot)
        faulty = None if arguments.view is None else FaultyRobot(robot, arguments.seed)
        limits = [limit for limit in (settings.guard.slew_limit, bundle.manifest.guard.slew_limit) if limit is not None]
        guard = replace(settings.guard, slew_limit=min(limits, default=None))
        driver = settings.driver
        self.driver = Driver(
            faulty or robot,
            Pilot(make_agent(bundle, driver.robot_radius, driver.goal_radius, link, driver.predict), link),
            lambda stamp: self.layout.occupancy(stamp),
            clock,
            Estimator(settings.estimator),
            Guard(spec.action_dim, guard),
            driver,
            rehearsal=0.0 if arguments.fast else settings.realtime.rehearsal,
        )
        # before anything moves: after the drive it would be too late
        self.out = arguments.out or _new_folder(Path("runs"), f"drive-{time.strftime('%Y%m%d-%H%M%S')}")
        self.files = [self.out / "summary.json"]
        _require_writable(self.files[0], "--out")
        if arguments.json not in (None, "-"):
            self.files.append(Path(arguments.json))
            _require_writable(self.files[1], "--json")
        with ExitStack() as opened:  # a start that fails leaves nothing behind, and spends no recording's name
            self.server = ControlServer(self.driver, arguments.control or default_socket()) if serves else None
            if self.server is not None:
                opened.callback(_hang_up, self.server)
            self.page = None if faulty is None else _open_page(arguments, self.driver, faulty, spec)
            if self.page is not None:
                opened.callback(self.page.close)
            self.recorder = _open_recorder(arguments, self.driver, bundle, spec)
            if self.recorder is not None:
                opened.callback(self.recorder.close)
            self.account = Account(kept=KEPT if serves else None, began=clock.now())
            self.faults = FaultWatch(self.account)
            self.goals = GoalWatch(self.driver, self.account, self.layout.seed)
            self.granted = {} if arguments.fast else request_realtime(settings.realtime)
            self.console = _screen(arguments)
            opened.pop_all()

    def drive(self) -> int:
        """From start to goal in every world."""
        return self._account_for(self._drive)

    def serve(self) -> int:
        """Ready for goals until interrupted, or until the robot's adapter has ended, which is a fault."""
        return self._account_for(self._serve)

    def _drive(self, drives: list[Drive]) -> None:
        for layout in self.layouts:
            self.layout = layout
            drives.append(Drive())
            self._watch(drives[-1])
            if not self.arguments.adapter:
                try:
                    self._reset(layout)
                except RuntimeError as error:  # a world that is not entered costs nothing of those that were driven
                    self.failed = True
                    _complain(" ".join(str(error).split()))
                    break
                if self.driver.supervisor.latched:  # a simulated robot is as good as new; a real one is for people
                    self.faults.open.clear()  # by nobody
                    self.driver.supervisor.acknowledge(self.driver.clock.now())
            if self.interrupted:
                break
            self.goals.seed = layout.seed
            self._say_ended(layout, self.driver.run(layout.goal))
            if self.driver.interrupted or self.driver.gone or self.driver.supervisor.latched and self.arguments.adapter:
                break

    def _serve(self, drives: list[Drive]) -> None:
        assert self.server is not None
        drives.append(Drive())
        self._watch(drives[-1])
        if self.page is not None and not (self.arguments.serve or self.arguments.adapter):
            self.page.first_goal = self.layout.goal
        try:
            with self.server:
                self._print(f"ready for goals: run_loop.py --tell 'goal X,Y'  (socket {self.server.path})")
                self.driver.serve()
        finally:
            self.goals.take_result()
        if not (self.driver.stopped or self._at_fault()):
            self.faults.open.append(self.account.add_fault("the robot was not seen to stand", self.driver.clock.now()))

    def _account_for(self, go: Callable[[list[Drive]], None]) -> int:
        """Drive, and show and save the account of it, wherever a signal arrives; pictures alone can be spared."""
        drives: list[Drive] = []
        code = OK
        try:
            with noting_signals(self._interrupt):
                try:
                    go(drives)
                except Exception as error:  # the loop has braked; what was driven until then is accounted for
                    self.failed = True
                    self.account.add_fault(f"{type(error).__name__}: {error}", self.driver.clock.now())
                    _show(traceback.print_exc, sys.stderr)
                finally:
                    if self.recorder is not None:
                        self.recorder.close()
                try:
                    code = self._finish(drives)
                finally:
                    if self.page is not None:
                        self.page.close()
            if not (self.arguments.no_pictures or self.interrupted):
                self._draw(drives)
        except KeyboardInterrupt:
            _complain("interrupted, pictures are missing")
        return code

    def _interrupt(self) -> None:
        hurry()
        self.interrupted = True
        self.driver.quit()

    def _watch(self, drive: Drive) -> None:
        others = (self.goals, self.recorder, self.page)
        self.driver.audience.observers = [drive, self.faults, *filter(None, others)]

    def _say_ended(self, layout: Layout, result: RunResult) -> None:
        """Account for a drive, and say how it ended."""
        self.goals.take_result()
        text = f"seed {layout.seed}: {result.reason} after {result.steps} steps ({result.seconds:.1f} s)"
        collisions = self.account.episodes[-1].collisions
        if collisions is not None:
            text += f", {collisions} collisions"
        self._print(f"{text}{': ' + result.detail if result.detail else ''}")

    def _at_fault(self) -> bool:
        """Whether the run is to end with the exit code of a fault: who serves had those acknowledged that were."""
        if self.failed or self.driver.gone:
            return True
        if not self.serves:
            return any(episode.result.fault for episode in self.account.episodes)
        return bool(self.faults.open) or self.driver.supervisor.mode is Mode.FAULT

    def _finish(self, drives: Sequence[Drive]) -> int:
        """Save and show the account of the run; what cannot be saved is a warning, and changes no exit code."""
        code = OK
        if not self.serves and any(episode.result.refused for episode in self.account.episodes):
            code = BAD_GOAL  # who serves was asked for many goals, and told of each
        if self._at_fault():
            code = FAULT
        if self.driver.interrupted:
            hurry()
        summary = self._summary(drives)
        for file in self.files:  # before it is shown, where a terminal may be stalled
            _save(file, summary)
        _show(lambda: print_summary(summary, self.console), self.console.file)
        if self.recorder is not None:
            self._print(f"recording: {self.recorder}")
        self._print(f"run folder: {self.out}")
        if self.arguments.json == "-":
            _show(lambda: print(json.dumps(summary, indent=2), flush=True), sys.stdout)
        return code

    def _print(self, text: str) -> None:
        _show(lambda: self.console.print(text, highlight=False, markup=False), self.console.file)

    def _summary(self, drives: Sequence[Drive]) -> dict[str, Any]:
        summary = summarise(self.account, self.driver.timer, self.driver.loop, self.granted)
        summary["recording"] = None if self.recorder is None else self.recorder.summary()
        summary["startup_seconds"] = drives[0].armed_age if drives else None
        if self.remote is not None:
            summary["adapter"] = {"watchdog_trips": self.remote.watchdog_trips, "realtime": dict(self.remote.realtime)}
        if self.link is not None:
            summary["planner"] = {"restarts": self.link.restart_count(), "seconds": self.link.plan_time.summary()}
        return summary

    def _draw(self, drives: Sequence[Drive]) -> None:
        ends = [episode.result.reason for episode in self.account.episodes]
        if self.serves:  # one drive to all of them
            ends = [", ".join(f"{reason} {count}" for reason, count in self.account.ends.items())] if ends else []
        for layout, drive, end in zip(self.layouts, drives, ends, strict=False):
            if drive.path:
                title = f"{layout.spec}, seed {layout.seed}: {end}"
                file = self.out / f"drive-{layout.seed}.png"
                unfinished = file.with_name(file.name + ".part")
                try:
                    drive.draw(layout, unfinished, title)
                    unfinished.replace(file)
                except OSError as error:
                    _warn(file, error)
                finally:
                    with suppress(OSError):
                        unfinished.unlink()


def _hang_up(server: ControlServer) -> None:
    """Close and remove a socket at which nobody has listened yet."""
    with server:
        pass


def _screen(arguments: argparse.Namespace) -> Console:
    """Where people read; the standard output is for JSON alone where --json - asks for it."""
    return Console(stderr=arguments.json == "-")


def _show(show: Callable[[], object], stream: IO[str]) -> None:
    """Show something on `stream`. A terminal or a pipe that is closed must not cost what comes after it."""
    try:
        show()
    except (OSError, SystemExit):  # the latter is what rich makes of a broken pipe
        with suppress(OSError), open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), stream.fileno())  # for what is still in its buffer


def _complain(text: str) -> None:
    _show(lambda: print(f"run_loop: {text}", file=sys.stderr, flush=True), sys.stderr)


def _new_folder(parent: Path, name: str) -> Path:
    """Make a folder that no other run has: two may begin in the same second."""
    parent.mkdir(parents=True, exist_ok=True)
    number = 1
    while True:
        folder = parent / (name if number == 1 else f"{name}-{number}")
        with suppress(FileExistsError):
            folder.mkdir()
            return folder
        number += 1


def _require_writable(file: Path, option: str) -> None:
    """Make the folder of a file that is to be written later, and see that it can be written to.

    Raises:
        ValueError: it cannot.
    """
    try:
        if file.is_dir():
            raise IsADirectoryError(f"{file} is a folder")
        file.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=file.parent):
            pass
    except OSError as error:
        raise ValueError(f"{option}: {file} cannot be written: {error.strerror or error}") from None


def _save(file: Path, values: Any) -> None:
    """Write JSON so that nobody ever sees half of it; where that fails, say so and go on."""
    from hiernav.files import write_json  # not needed before, and the robot need not wait for it

    try:
        write_json(file, values)
    except OSError as error:
        _warn(file, error)


def _warn(file: Path, error: OSError) -> None:
    _complain(f"{file} is not written: {error.strerror or error}")


def _open_bundle(path: Path, spec: RobotSpec) -> Bundle:
    """Load a bundle and refuse it unless it fits this robot."""
    bundle = load_bundle(path)
    bundle.require_robot(spec.name, file_sha256(spec.xml_path))
    bundle.require_layout(spec.observation_layout(clock="clock" in bundle.layout.names))
    bundle.require_resolution(RESOLUTION)
    return bundle


def _open_recorder(arguments: argparse.Namespace, driver: Driver, bundle: Bundle, spec: RobotSpec) -> Recorder | None:
    if arguments.record is None:
        return None
    from hiernav.runtime.about import About
    from hiernav.runtime.recorder import Recorder

    about = About(
        robot=spec.name,
        robot_radius=driver.config.robot_radius,
        goal_radius=driver.config.goal_radius,
        control_period=spec.control_period,
        bundle=str((arguments.bundle or BUNDLES / spec.name).resolve()),
        hashes=dict(bundle.manifest.files),
        planner_process=driver.pilot.link is not None,
        estimator=driver.estimator.config,
        guard=driver.guard.config,
        predict=driver.config.predict,
        world=f"{arguments.world}, seed {arguments.seed}, {arguments.episodes} episodes",
    )
    return Recorder(arguments.record, about.metadata())


def _open_page(arguments: argparse.Namespace, driver: Driver, faulty: FaultyRobot, spec: RobotSpec) -> ViewerLink:
    from hiernav.view.link import ViewerLink

    # nobody rehearses faults with a robot that can hurt someone
    faults = {} if arguments.adapter else {name: partial(faulty.inject, name) for name in FAULTS}
    title = f"hiernav: {spec.name} in {arguments.world}"
    page = ViewerLink(driver, driver.config.robot_radius, driver.config.goal_radius, title, arguments.view, faults)
    print(f"live page: {page.url}", file=sys.stderr if arguments.json == "-" else sys.stdout, flush=True)
    return page


def _layout(world: WorldSpec, seed: int, spec: RobotSpec, goal: np.ndarray | None, start_known: bool) -> Layout:
    """The world of an episode, with the user's goal if there is one.

    Raises:
        GoalError: that cannot be driven to; from where a real robot stands is for the driver to find out.
    """
    layout = sample_layout(world, seed, spec.radius)
    if goal is None:
        return layout
    from hiernav.nav.search import is_solvable

    occupancy = layout.occupancy(0.0)
    if not layout.in_field(goal[None])[0]:
        xmin, xmax, ymin, ymax = layout.extent
        raise GoalError(
            f"--goal {goal[0]:g},{goal[1]:g} lies outside the field: x from {xmin:g} to {xmax:g}, "
            f"y from {ymin:g} to {ymax:g} m"
        )
    if not occupancy.is_free(goal, spec.radius):
        raise GoalError(
            f"--goal {goal[0]:g},{goal[1]:g} is less than {spec.radius:g} m from an obstacle in seed {seed}: "
            "choose a free place (hiernav world --png draws the world)"
        )
    if start_known and not is_solvable(occupancy, layout.start[:2], goal, spec.radius):
        raise GoalError(f"--goal {goal[0]:g},{goal[1]:g} cannot be reached from the start in seed {seed}")
    return replace(layout, goal=goal)


def _given_goal(arguments: argparse.Namespace) -> np.ndarray | None:
    try:
        return None if arguments.goal is None else parse_point(arguments.goal)
    except ValueError as error:
        raise ValueError(f"--goal {error}") from None


if __name__ == "__main__":
    be_patient()
    status = main()
    for number in stop_signals():  # all that was to be done is done
        signal.signal(number, signal.SIG_IGN)
    sys.exit(status)
