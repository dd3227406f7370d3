"""Clocks: seconds that only go forward, and a sleep to an absolute time."""

from __future__ import annotations

import ctypes
import errno
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

CLOCK_MONOTONIC = 1
TIMER_ABSTIME = 1


class Clock(Protocol):
    """Time of a control loop [s]. The zero is arbitrary; setting the wall clock has no effect."""

    def now(self) -> float:
        """Seconds since an arbitrary moment, never decreasing."""
        ...

    def sleep_until(self, deadline: float) -> None:
        """Return at `deadline` [s] or as soon after it as the system allows; at once if it has passed."""
        ...


class MonotonicClock:
    """The machine's monotonic clock.

    Sleeps to an absolute time with `clock_nanosleep`, so that a pre-emption between reading the clock and
    sleeping cannot add to the lateness. Where that call does not exist, `time.sleep` of what remains.
    """

    def __init__(self) -> None:
        self._nanosleep = _find_nanosleep()

    @property
    def absolute(self) -> bool:
        """Whether sleeps are absolute (`clock_nanosleep`) and not the fallback."""
        return self._nanosleep is not None

    def now(self) -> float:
        return time.monotonic()

    def sleep_until(self, deadline: float) -> None:
        if self._nanosleep is not None:
            # Rounded up: a wake a nanosecond early would see its deadline still ahead.
            error = self._nanosleep(int(deadline * 1e9) + 1)
            if error == 0:
                return
            self._nanosleep = None
        while (remaining := deadline - time.monotonic()) > 0.0:
            time.sleep(remaining)


def process_age() -> float | None:
    """Seconds since this process was started, interpreter and imports included; None where /proc does not tell."""
    try:
        fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
        return time.clock_gettime(time.CLOCK_BOOTTIME) - int(fields[19]) / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError, ValueError, IndexError):
        return None


class FakeClock:
    """A clock that moves only when told to or slept on: for tests, and for simulation as fast as the machine can."""

    def __init__(self, start: float = 0.0) -> None:
        self._now = float(start)

    def now(self) -> float:
        return self._now

    def sleep_until(self, deadline: float) -> None:
        self._now = max(self._now, float(deadline))

    def advance(self, seconds: float) -> None:
        """Let `seconds` (not negative) pass, as work does."""
        if not seconds >= 0.0:
            raise ValueError(f"FakeClock.advance: {seconds} s, but a monotonic clock never goes back")
        self._now += float(seconds)


class _Timespec(ctypes.Structure):
    _fields_ = [("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long)]


def _find_nanosleep() -> Callable[[int], int] | None:
    """A function that sleeps until a time [ns] on CLOCK_MONOTONIC and returns 0 or an errno; None if there is none."""
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        function = libc.clock_nanosleep
    except (OSError, AttributeError, TypeError):
        return None
    function.argtypes = [ctypes.c_int, ctypes.c_int, ctypes.POINTER(_Timespec), ctypes.c_void_p]
    function.restype = ctypes.c_int

    def sleep_until_ns(deadline_ns: int) -> int:
        request = _Timespec(*divmod(max(deadline_ns, 0), 1_000_000_000))
        reference = ctypes.byref(request)
        # A signal ends the sleep early; its Python handler runs before the next call, and may raise.
        while (error := function(CLOCK_MONOTONIC, TIMER_ABSTIME, reference, None)) == errno.EINTR:
            pass
        return int(error)

    if sleep_until_ns(0) != 0:
        return None
    return sleep_until_ns
