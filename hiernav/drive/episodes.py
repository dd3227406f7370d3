"""One loop, what watches it, and the worlds or goals it drives to."""

from __future__ import annotations

import argparse
import json
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hiernav.drive.exits import BAD_GOAL, FAULT, OK
from hiernav.drive.picture import Drive
from hiernav.drive.screen import complain, new_folder, require_writable, save, screen, show, warn
from hiernav.nav.bundle import Bundle
from hiernav.runtime.account import KEPT, Account, FaultWatch, GoalWatch
from hiernav.runtime.clock import Clock, FakeClock, MonotonicClock
from hiernav.runtime.control import ControlServer, default_socket
from hiernav.runtime.driver import Driver
from hiernav.runtime.estimator import Estimator
from hiernav.runtime.faulty import FAULTS, FaultyRobot
from hiernav.runtime.guard import Guard
from hiernav.runtime.loop import noting_signals
from hiernav.runtime.patient import hurry
from hiernav.runtime.pilot import Pilot
from hiernav.runtime.policy import make_agent, require_fit
from hiernav.runtime.process_planner import ProcessPlanner
from hiernav.runtime.process_robot import ProcessRobot
from hiernav.runtime.realtime import request_realtime
from hiernav.runtime.robot import Robot
from hiernav.runtime.settings import Settings, differing
from hiernav.runtime.summary import print_summary, summarise
from hiernav.runtime.supervisor import Mode
from hiernav.runtime.trip import RunResult
from hiernav.sim.layout import Layout
from hiernav.sim.robots import RobotSpec

if TYPE_CHECKING:
    from hiernav.runtime.recorder import Recorder
    from hiernav.view.link import ViewerLink


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
        self.settings = settings
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
        driver = settings.driver
        self.driver = Driver(
            faulty or robot,
            Pilot(make_agent(bundle, driver.robot_radius, driver.goal_radius, link, driver.predict), link),
            lambda stamp: self.layout.occupancy(stamp),
            clock,
            Estimator(settings.estimator),
            Guard(spec.action_dim, settings.guard.limited(bundle.manifest.guard.slew_limit)),
            driver,
            rehearsal=0.0 if arguments.fast else settings.realtime.rehearsal,
        )
        # before anything moves: after the drive it would be too late
        self.out = arguments.out or new_folder(Path("runs"), f"drive-{time.strftime('%Y%m%d-%H%M%S')}")
        self.files = [self.out / "summary.json"]
        require_writable(self.files[0], "--out")
        if arguments.json not in (None, "-"):
            self.files.append(Path(arguments.json))
            require_writable(self.files[1], "--json")
        with ExitStack() as opened:  # a start that fails leaves nothing behind, and spends no recording's name
            self.server = ControlServer(self.driver, arguments.control or default_socket()) if serves else None
            if self.server is not None:
                opened.callback(self.server.close)
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
            self.console = screen(arguments)
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
                    complain(" ".join(str(error).split()))
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
                    show(traceback.print_exc, sys.stderr)
                finally:
                    for process in (self.remote, self.link):
                        if process is not None:
                            process.dismiss()  # it ends while the run is accounted for
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
            complain("interrupted, pictures are missing")
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
            save(file, summary)
        show(lambda: print_summary(summary, self.console), self.console.file)
        if self.recorder is not None:
            self._print(f"recording: {self.recorder}")
        self._print(f"run folder: {self.out}")
        if self.arguments.json == "-":
            show(lambda: print(json.dumps(summary, indent=2), flush=True), sys.stdout)
        return code

    def _print(self, text: str) -> None:
        show(lambda: self.console.print(text, highlight=False, markup=False, soft_wrap=True), self.console.file)

    def _summary(self, drives: Sequence[Drive]) -> dict[str, Any]:
        summary = summarise(self.account, self.driver.timer, self.driver.loop, self.granted)
        summary["settings"] = differing(self.settings)
        summary["recording"] = None if self.recorder is None else self.recorder.summary()
        summary["dropped_observers"] = dict(self.driver.audience.dropped)
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
                except Exception as error:  # no memory, or no matplotlib: a picture can be spared
                    warn(file, error)
                finally:
                    with suppress(OSError):
                        unfinished.unlink()


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
        bundle=str((arguments.bundle or arguments.home / "bundles" / spec.name).resolve()),
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
