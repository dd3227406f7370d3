"""What would be driven, and what the host grants: everything is checked, and nothing moves."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from hiernav.nav.bundle import Bundle
from hiernav.runtime.clock import MonotonicClock
from hiernav.runtime.filter_check import TOLERANCE, filter_deviation
from hiernav.runtime.guard import Guard
from hiernav.runtime.policy import check_golden, load_networks, require_fit
from hiernav.runtime.process_robot import ProcessRobot
from hiernav.runtime.realtime import request_realtime
from hiernav.runtime.robot import READINGS, SIZES, SensorFrame
from hiernav.runtime.settings import Settings, differing
from hiernav.runtime.timing import Histogram

LOOK, PATIENCE = 2.5, 15.0
"""For how long a robot is listened to [s]: longer than its fixes may stay away, and until each sensor that it needs has
spoken, at most so long."""
ESTIMATOR_NEEDS = ("position_fix", "magnetometer")
WAKES = 200
SHOWN = 2000
"""Letters of a value."""
PERIOD = 0.005


def report(
    open_bundle: Callable[[], Bundle], make_robot: Callable[[], ProcessRobot], settings: Settings
) -> dict[str, Any]:
    """Findings on bundle, robot, estimator and host, and settings that are not the defaults, in JSON's own types; what
    failed has an "error"."""
    bundle: list[Bundle] = []

    def check_bundle() -> dict[str, Any]:
        bundle.append(open_bundle())
        return _check_bundle(bundle[0])

    found: dict[str, Any] = {"bundle": _attempt(check_bundle)}
    found["robot"] = _attempt(lambda: _check_robot(make_robot(), bundle[0] if bundle else None, settings))
    found["estimator"] = _attempt(_check_filter)
    found["host"] = _check_host(settings)
    found["settings"] = differing(settings) or {"all": "defaults"}
    return found


def print_report(found: Mapping[str, Any], console: Console) -> None:
    """Show a report made by `report`."""
    for part, entries in found.items():
        table = Table(title=part, title_justify="left", show_header=False)
        for key, value in entries.items():
            style = "red" if key == "error" or str(value).startswith(("refused", "missing")) else None
            table.add_row(_shown(key), _shown(value), style=style)
        console.print(table)


def _shown(value: object) -> Text:
    """As it is: texts of a bundle or an adapter are no markup, move no cursor, and may be long."""
    letters = (letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in str(value)[:SHOWN])
    return Text("".join(letters))


def _attempt(check: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    try:
        return check()
    except Exception as error:
        return {"error": f"{' '.join(str(error).split())}"}


def _check_bundle(bundle: Bundle) -> dict[str, Any]:
    networks = load_networks(bundle)
    manifest = bundle.manifest
    worst = max(check_golden(bundle, networks).values())
    return {
        "robot": manifest.robot,
        "control period": f"{1e3 * manifest.control_period_s:g} ms",
        "observation": f"{bundle.layout.size} values: {', '.join(bundle.layout.names)}",
        "golden values": f"off by {worst:.1g} at most",
        "trained": ", ".join(f"{name} {value}" for name, value in manifest.provenance.items()) or "not told",
    }


def _check_robot(robot: ProcessRobot, bundle: Bundle | None, settings: Settings) -> dict[str, Any]:
    if bundle is not None:
        require_fit(bundle, robot)
    needed = [*ESTIMATOR_NEEDS, *(() if bundle is None else bundle.layout.sensors)]
    frames, seconds = _look(robot, needed)
    given: dict[str, list[np.ndarray]] = {}
    for frame in frames:
        for name, value in _readings(frame).items():
            given.setdefault(name, []).append(np.asarray(value, dtype=np.float64))
    silent = [name for name in dict.fromkeys(needed) if name not in given]
    broken = [name for name, values in given.items() if not any(np.isfinite(value).all() for value in values)]
    stamps = np.array([frame.stamp for frame in frames])
    errors = [f"silent for {seconds:.1f} s: {', '.join(silent)}"] if silent else []
    errors += [f"never finite: {', '.join(broken)}"] if broken else []
    if not (np.isfinite(stamps).all() and (np.diff(stamps) > 0.0).any()):
        errors.append(f"stamps do not advance: {stamps[0]:g} to {stamps[-1]:g} s")
    lidar = np.concatenate([np.ravel(value) for value in given.get("lidar", [])] or [np.zeros(1)])
    if (lidar < 0.0).any() or (lidar > 1.0).any():
        errors.append(f"lidar reads {lidar.min():g} to {lidar.max():g}, closeness in [0, 1] is expected")
    trouble = robot.trouble()
    errors += [trouble] if trouble else []
    wrong = _wrong_sizes({name: values[-1] for name, values in given.items()}, bundle)
    errors += [f"sensors of another size: {', '.join(wrong)}"] if wrong else []
    try:
        Guard(robot.action_dim, settings.guard)
    except ValueError as error:
        errors.append(str(error))
    absent = [name for name in READINGS if name not in given]
    return {
        "control period": f"{1e3 * robot.control_period:g} ms",
        "actuators": robot.action_dim,
        "frames": f"{len(frames)} in {seconds:.1f} s",
        "sensors": ", ".join(given) or "missing",
        "silent": f"missing: {', '.join(absent)}" if absent else "none",
        "not finite": f"missing: {', '.join(broken)}" if broken else "none",
        **({"error": "; ".join(errors)} if errors else {}),
        **{f"adapter {name}": text for name, text in robot.realtime.items()},
    }


def _look(robot: ProcessRobot, needed: Sequence[str]) -> tuple[list[SensorFrame], float]:
    """The frames that a robot shows, and how long it was listened to [s]."""
    clock = MonotonicClock()
    robot.brake()  # a simulated one lives from its first command on
    began, frames = clock.now(), [robot.read()]
    missing = set(needed) - set(_readings(frames[0]))
    while (now := clock.now()) < began + (PATIENCE if missing else LOOK):
        clock.sleep_until(now + robot.control_period)
        frame = robot.read()
        if frame is not frames[-1]:
            frames.append(frame)
            missing -= set(_readings(frame))
    return frames, clock.now() - began


def _readings(frame: SensorFrame) -> dict[str, np.ndarray]:
    """What a frame has, by name."""
    present = {name: getattr(frame, name) for name in READINGS}
    return {name: value for name, value in (present | dict(frame.extra)).items() if value is not None}


def _wrong_sizes(given: Mapping[str, np.ndarray], bundle: Bundle | None) -> list[str]:
    """Each sensor that gives more or fewer values than estimator and skill take."""
    sizes = dict(SIZES)
    if bundle is not None:
        sizes |= {term.name: term.size for term in bundle.layout.terms}
    return [
        f"{name} has {np.size(value)} values, {sizes[name]} are expected"
        for name, value in given.items()
        if np.size(value) != sizes.get(name, np.size(value))
    ]


def _check_filter() -> dict[str, Any]:
    deviation = filter_deviation()
    if not deviation < TOLERANCE:
        raise RuntimeError(f"the filter deviates from filterpy's by {deviation:.2g}, the limit is {TOLERANCE:g}")
    return {"filter beside filterpy's": f"off by {deviation:.1g} at most"}


def _check_host(settings: Settings) -> dict[str, Any]:
    granted = request_realtime(settings.realtime)
    clock, lateness = MonotonicClock(), Histogram()
    start = clock.now()
    for k in range(1, WAKES + 1):
        clock.sleep_until(start + k * PERIOD)
        lateness.record(max(clock.now() - start - k * PERIOD, 0.0))
    timing = lateness.summary()
    shown = ", ".join(f"{key} {1e3 * float(timing[key] or 0.0):.2f} ms" for key in ("p50", "p99", "max"))
    governor = Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
    return {
        "machine": f"{platform.machine()}, {os.cpu_count()} CPUs, load {os.getloadavg()[0]:.1f}, {platform.release()}",
        "clock": "absolute sleeps" if clock.absolute else "missing: clock_nanosleep; time.sleep is used",
        f"lateness of {WAKES} wakes": shown,
        "CPU governor": governor.read_text().strip() if governor.exists() else "not told by this system",
        "shared memory": f"{os.statvfs('/dev/shm').f_bavail * os.statvfs('/dev/shm').f_frsize >> 20} MB free"
        if Path("/dev/shm").exists()
        else "not told by this system",
        "wall clock": time.strftime("%Y-%m-%d %H:%M:%S %Z"),
        **granted,
    }
