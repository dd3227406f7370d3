#!/usr/bin/env python3
"""Measure the real-time loop on this machine: a simulated point robot driven to one goal after another.

    bench_loop.py                         60 s each at 50 and 100 Hz, then at 50 Hz beside two CPU hogs; 10 s at 500 Hz
    bench_loop.py --rate 50 --seconds 60 --hogs 2
    bench_loop.py --rate 100 --host       what the machine leaves of a loop that does nothing but 0.3 ms of sums

Planner and robot live in processes of their own, as when a robot is driven; each line is a control process of its own.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402
from bad_input import exit_code, number_from, whole  # noqa: E402

from hiernav.files import write_json  # noqa: E402

WORLD = "pillar(4,4,40)"
RUNS = ((50, 60.0, 0), (100, 60.0, 0), (50, 60.0, 2), (500, 10.0, 0))
"""Rate [Hz], time [s] and number of hogs of each run."""
HOST_WORK = 3e-4
"""What a tick of `measure_host` computes for, with nothing between the ticks [s]."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rate", type=int, choices=(50, 100, 500), help="only one run, at so many ticks a second")
    parser.add_argument("--seconds", type=number_from(1.0), default=60.0, help="of that run (60)")
    parser.add_argument("--hogs", type=whole(0), default=0, help="processes that compute beside that run (0)")
    parser.add_argument(
        "--host", action="store_true", help="that run without hiernav: what this machine leaves of a loop"
    )
    parser.add_argument("--bundle", type=Path, default=Path("deploy/bundles/point"), help="of the point robot")
    parser.add_argument(
        "--rehearsal", type=number_from(0.0), default=0.0025, help="before each tick [s]; 0 for none (0.0025)"
    )
    parser.add_argument("--normal", action="store_true", help="ask for no real-time scheduling")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    arguments = parser.parse_args()
    if arguments.rate is None:
        if arguments.host:
            parser.error("--host needs --rate")
        found = bench_loop(arguments.bundle, arguments.normal)
    elif arguments.host:
        found = [measure_host(arguments.rate, arguments.seconds, arguments.hogs, arguments.normal)]
        show_host(found[0])
    else:
        settings = (arguments.seconds, arguments.hogs, arguments.bundle, arguments.normal, arguments.rehearsal)
        found = [measure(arguments.rate, *settings)]
        show(found[0])
    if arguments.json:
        write_json(arguments.json, found)
    return 0


def bench_loop(bundle: Path, normal: bool = False) -> list[dict[str, Any]]:
    """All runs, each in a fresh process."""
    results = []
    for rate, seconds, hogs in RUNS:
        out = Path(f"/tmp/bench-loop-{os.getpid()}.json")
        command = [sys.executable, __file__, "--rate", str(rate), "--seconds", str(seconds), "--hogs", str(hogs)]
        command += ["--bundle", str(bundle), "--json", str(out), *(["--normal"] if normal else [])]
        subprocess.run(command, check=True)
        results += json.loads(out.read_text())
        out.unlink()
    return results


def measure(
    rate: int, seconds: float, hogs: int, bundle_path: Path, normal: bool, rehearsal: float = 0.0025
) -> dict[str, Any]:
    """Drive for some time; all figures in seconds, megabytes and shares."""
    from hiernav.nav.bundle import load_bundle
    from hiernav.runtime.clock import MonotonicClock, process_age
    from hiernav.runtime.driver import Driver
    from hiernav.runtime.driver_config import DriverConfig
    from hiernav.runtime.estimate import EstimatorConfig
    from hiernav.runtime.estimator import Estimator
    from hiernav.runtime.guard import Guard
    from hiernav.runtime.observe import Event, Observer, TickRecord
    from hiernav.runtime.pilot import Pilot
    from hiernav.runtime.policy import make_agent
    from hiernav.runtime.process_planner import ProcessPlanner
    from hiernav.runtime.process_robot import simulated
    from hiernav.runtime.realtime import RealtimeConfig, request_realtime
    from hiernav.runtime.settings import load_settings
    from hiernav.sim.layout import parse_world
    from hiernav.sim.worlds import sample_layout

    bundle = load_bundle(bundle_path)
    robot = simulated(robot="point", world=WORLD, seed=0, substeps=500 // rate)
    layout = sample_layout(parse_world(WORLD), 0)
    occupancy = layout.occupancy(0.0)
    link = ProcessPlanner(bundle, 0.1, occupancy.occupied.size)
    agent = make_agent(bundle, 0.1, planner=link)
    pilot = Pilot(replace(agent, control_period=robot.control_period), link)  # at other rates than it was trained for
    guard = Guard(2, load_settings([ROOT / "deploy" / "point.yaml"]).guard)
    estimator, config = Estimator(EstimatorConfig(tilts=False)), DriverConfig(max_steps=10**9)
    driver = Driver(
        robot, pilot, lambda stamp: occupancy, MonotonicClock(), estimator, guard, config, rehearsal=rehearsal
    )
    free = occupancy.pixel_centers()[occupancy.clearance > 0.3]
    rng = np.random.default_rng(0)
    facts: dict[str, Any] = {"goals": 0, "faults": 0}

    class Guide(Observer):
        """Sends the robot on and on, and notes what the loop itself does not."""

        def __init__(self) -> None:
            self.end = self.stop_asked = self.settled = None
            self.late: list[float] = []

        def event(self, event: Event) -> None:
            if event.values.get("mode") == "armed":
                facts.setdefault("armed_after", process_age())
            if event.values.get("mode") == "fault":
                facts["faults"] += 1
                driver.acknowledge()

        def tick(self, record: TickRecord) -> None:
            if self.end is None:
                self.end = record.time + seconds
            if self.settled is None and record.time > self.end - seconds + min(60.0, 0.2 * seconds):
                self.settled = record.time
                facts["resident"] = resident()
            if self.stop_asked is not None:
                if record.sent is None:
                    facts["ticks_to_brake"] = record.index - self.stop_asked
                    driver.quit()
            elif record.time > self.end:
                facts["grown_per_hour"] = (resident() - facts["resident"]) * 3600.0 / (record.time - self.settled)
                self.stop_asked = record.index
                driver.estop("measured")
            elif driver.goal is None:
                facts["goals"] += 1
                driver.set_goal(free[rng.integers(len(free))])

    driver.audience.observers = [Guide()]
    granted = request_realtime(RealtimeConfig(fifo_priority=None) if normal else RealtimeConfig())
    began = time.monotonic()
    try:
        with beside(hogs):
            driver.serve()
    finally:
        trips = robot.watchdog_trips
        robot.close()
        link.close()
    if "ticks_to_brake" not in facts:
        raise SystemExit("bench_loop: the run was interrupted")
    loop, timer = driver.loop, driver.timer
    return {
        "rate": rate,
        "seconds": time.monotonic() - began,
        "hogs": hogs,
        "realtime": granted,
        "ticks": loop.ticks,
        "missed": loop.overruns / max(loop.ticks + loop.overruns, 1),
        "lateness": loop.lateness.summary(),
        "phase_drift": loop.phase_error,
        "tick": timer.tick.summary(),
        "sections": {name: histogram.summary() for name, histogram in timer.sections.items()},
        "planner": link.plan_time.summary(),
        "planner_restarts": link.restart_count(),
        "watchdog_trips": trips,
        **facts,
    }


def measure_host(rate: int, seconds: float, hogs: int, normal: bool) -> dict[str, Any]:
    """The same loop and settings with a tick of fixed arithmetic, and no process beside it but the hogs.

    What it misses, no loop that computes as much can keep on this machine: `tick` is `warm` (`HOST_WORK` or a little
    more, measured without pauses) and what the machine adds to it.
    """
    from hiernav.runtime.clock import MonotonicClock
    from hiernav.runtime.loop import FixedRateLoop
    from hiernav.runtime.realtime import RealtimeConfig, request_realtime
    from hiernav.runtime.timing import Histogram

    factor, tick, warm = np.full((64, 64), 0.5), Histogram(), Histogram()
    sums, end = 0, 0.0

    def work() -> None:
        for _ in range(sums):
            factor @ factor

    def timed(spent: Histogram) -> None:
        began = time.perf_counter()
        work()
        spent.record(time.perf_counter() - began)

    def step(now: float) -> bool:
        timed(tick)
        return now > end

    granted = request_realtime(RealtimeConfig(fifo_priority=None) if normal else RealtimeConfig())
    while warm.summary()["p50"] is None or warm.summary()["p50"] < HOST_WORK:
        sums, warm = sums + max(1, sums // 8), Histogram()
        for _ in range(200):
            timed(warm)
    clock = MonotonicClock()
    loop = FixedRateLoop(clock, 1.0 / rate, step, lambda: None)
    with beside(hogs):
        end = clock.now() + seconds
        loop.run()
    return {
        "rate": rate,
        "seconds": seconds,
        "hogs": hogs,
        "realtime": granted,
        "ticks": loop.ticks,
        "missed": loop.overruns / max(loop.ticks + loop.overruns, 1),
        "lateness": loop.lateness.summary(),
        "warm": warm.summary(),
        "tick": tick.summary(),
    }


def show_host(found: dict[str, Any]) -> None:
    """One run of `measure_host` on a line."""
    print(
        f"host {found['rate']} Hz, {found['seconds']:.0f} s, {found['hogs']} hogs, "
        f"{found['realtime']['sched_fifo']}: missed {100 * found['missed']:.3f} % of {found['ticks']} ticks, "
        f"p50 p99 max [ms] of lateness {times(found['lateness'])}, "
        f"of a tick {times(found['tick'])}, which takes {times(found['warm'])} without pauses",
        flush=True,
    )


def times(entry: dict[str, Any]) -> str:
    return " ".join("-" if entry[key] is None else f"{1e3 * entry[key]:.3f}" for key in ("p50", "p99", "max"))


def show(found: dict[str, Any]) -> None:
    """One run on three lines."""
    print(
        f"loop {found['rate']} Hz, {found['seconds']:.0f} s, {found['hogs']} hogs, "
        f"{found['realtime']['sched_fifo']}: missed {100 * found['missed']:.3f} % of {found['ticks']} ticks, "
        f"lateness p50 p99 max [ms] {times(found['lateness'])}, phase drift {1e6 * found['phase_drift']:.0f} us"
    )
    sections = ", ".join(f"{name} {times(entry)}" for name, entry in found["sections"].items())
    print(f"  tick p50 p99 max [ms] {times(found['tick'])}: {sections}; planner's process {times(found['planner'])}")
    print(
        f"  armed {found.get('armed_after') or 0.0:.2f} s after the start of the process, resident "
        f"{found['resident']:.0f} MB, growing {found['grown_per_hour']:.2f} MB/h, brake {found['ticks_to_brake']} "
        f"ticks after the stop, {found['goals']} goals, {found['faults']} faults, {found['watchdog_trips']} trips "
        f"of the adapter's watchdog, {found['planner_restarts']} restarts of the planner",
        flush=True,
    )


@contextmanager
def beside(hogs: int) -> Iterator[None]:
    """So many processes that compute all the time, meanwhile."""
    processes = [multiprocessing.get_context("fork").Process(target=_hog, daemon=True) for _ in range(hogs)]
    for process in processes:
        process.start()
    try:
        yield
    finally:
        for process in processes:
            process.kill()


def _hog() -> None:
    while True:
        pass


def resident() -> float:
    """Of this process [MB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


if __name__ == "__main__":
    sys.exit(exit_code("bench_loop", main))
