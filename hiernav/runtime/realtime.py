"""Asks the operating system for punctuality: best effort, reported item by item, never required."""

from __future__ import annotations

import ctypes
import gc
import math
import os
import resource
import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

PR_SET_TIMERSLACK = 29
MCL_CURRENT = 1
MCL_FUTURE = 2
MCL_ONFAULT = 4
CAP_IPC_LOCK = 14
WAKE_LATENCY = "/dev/cpu_dma_latency"
"""Takes the longest time in which a processor may wake, an int32 [us], for as long as it is held open."""


@dataclass(frozen=True)
class RealtimeConfig:
    """What to ask for. Whatever the system refuses is reported and done without."""

    timer_slack_ns: int = 1
    """Timers of this thread fire at most this late [ns]; the system's default is 50000. 0 leaves it alone."""
    fifo_priority: int | None = 50
    """SCHED_FIFO priority of the loop, 1 to 98; None stays with the normal scheduler. The robot's adapter has one more:
    its watchdog must get the processor also where the loop does not let go of it."""
    lock_memory: bool = True
    """Keep all pages in memory (mlockall)."""
    cpus: tuple[int, ...] | None = None
    """CPUs that the control process and the robot's adapter may run on; None leaves the choice to the system."""
    wake_latency_us: int | None = 10
    """Processors must be able to wake within this time [us], which keeps them from their deepest sleep and costs power
    while the process lives; None lets them sleep."""
    rehearsal: float = 0.0025
    """Time before each tick from which on one is rehearsed, so that the caches are warm [s]; 0 for none."""
    freeze_gc: bool = True
    """Move everything allocated so far out of the garbage collector's sight."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.rehearsal < math.inf:
            raise ValueError(f"RealtimeConfig.rehearsal = {self.rehearsal} s must be finite and not negative")
        if self.timer_slack_ns < 0:
            raise ValueError(f"RealtimeConfig.timer_slack_ns = {self.timer_slack_ns} ns must not be negative")
        if self.wake_latency_us is not None and not 0 <= self.wake_latency_us < 2**31:
            raise ValueError(
                f"RealtimeConfig.wake_latency_us = {self.wake_latency_us} us must not be negative nor beyond 2147483647"
            )
        if self.fifo_priority is not None and not 1 <= self.fifo_priority <= 98:
            raise ValueError(f"RealtimeConfig.fifo_priority = {self.fifo_priority} must be 1 to 98, or null")
        if self.cpus is not None and (not self.cpus or min(self.cpus) < 0):
            raise ValueError(f"RealtimeConfig.cpus = {list(self.cpus)} must be numbers of CPUs from 0, at least one")


def request_realtime(config: RealtimeConfig | None = None, before_the_loop: bool = False) -> dict[str, str]:
    """Apply the settings to this process and thread.

    Args:
        config: the defaults if None.
        before_the_loop: whether this process comes before the loop where both want the same processor.

    Returns:
        One entry per setting: "granted", "granted: ...", "not asked" or "refused: why". Never raises.
    """
    config = config or RealtimeConfig()
    return {
        "timer_slack": _attempt(config.timer_slack_ns > 0, lambda: _set_timer_slack(config.timer_slack_ns)),
        "sched_fifo": _attempt(
            config.fifo_priority is not None, lambda: _set_fifo(config.fifo_priority or 1, before_the_loop)
        ),
        "mlockall": _attempt(config.lock_memory, _lock_memory),
        "wake_latency": _attempt(
            config.wake_latency_us is not None, lambda: _set_wake_latency(config.wake_latency_us or 0)
        ),
        "cpu_affinity": _attempt(config.cpus is not None, lambda: _set_affinity(config.cpus or ())),
        "gc_freeze": _attempt(config.freeze_gc, _freeze_gc),
    }


def _attempt(asked: bool, action: Callable[[], str]) -> str:
    if not asked:
        return "not asked"
    try:
        detail = action()
    except Exception as error:  # an unknown platform may lack any of these calls
        return f"refused: {error}"
    return f"granted: {detail}" if detail else "granted"


def _set_timer_slack(nanoseconds: int) -> str:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(PR_SET_TIMERSLACK, ctypes.c_ulong(nanoseconds), 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return f"{nanoseconds} ns"


def _set_fifo(priority: int, above: bool) -> str:
    # Children (the planner's process) start with the normal scheduler again.
    policy = os.SCHED_FIFO | getattr(os, "SCHED_RESET_ON_FORK", 0)
    if above:
        with suppress(PermissionError):  # it lies above this user's limit
            os.sched_setscheduler(0, policy, os.sched_param(priority + 1))
            return f"priority {priority + 1}"
    os.sched_setscheduler(0, policy, os.sched_param(priority))
    return f"priority {priority}{', no more than the loop: this user may not have one above it' if above else ''}"


def _lock_memory() -> str:
    limit, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    unlimited = limit == resource.RLIM_INFINITY or _has_capability(CAP_IPC_LOCK)
    libc = ctypes.CDLL(None, use_errno=True)
    # Only pages that are in use: otherwise all of every library and thread's stack would be read in, 600 MB of them.
    # Under a finite limit, MCL_FUTURE would make a later allocation fail instead of this call.
    attempts = [(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT, "pages in use, present and future")] if unlimited else []
    for flags, what in [*attempts, (MCL_CURRENT | MCL_ONFAULT, "pages in use"), (MCL_CURRENT, "present pages")]:
        if libc.mlockall(flags) == 0:
            return what
    raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def _set_wake_latency(microseconds: int) -> str:
    device = os.open(WAKE_LATENCY, os.O_WRONLY)
    try:
        os.write(device, struct.pack("=i", microseconds))
    except OSError:
        os.close(device)
        raise
    return f"{microseconds} us"  # the device stays open until this process ends


def _has_capability(bit: int) -> bool:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("CapEff:"):
            return bool(int(line.split()[1], 16) >> bit & 1)
    return False


def _set_affinity(cpus: tuple[int, ...]) -> str:
    os.sched_setaffinity(0, set(cpus))
    return "CPU " + ", ".join(str(cpu) for cpu in sorted(os.sched_getaffinity(0)))


def _freeze_gc() -> str:
    gc.collect()
    gc.freeze()
    return f"{gc.get_freeze_count()} objects"
