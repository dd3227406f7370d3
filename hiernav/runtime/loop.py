"""A loop at a fixed rate that keeps its phase, skips what it missed, and brakes on every way out."""

from __future__ import annotations

import logging
import math
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import Enum
from types import FrameType

from hiernav.runtime.clock import Clock
from hiernav.runtime.timing import Histogram

BRAKE_ATTEMPTS = 3
SPOILT, FORGIVEN = 4, 500
"""Ticks that may be late for having been prepared, one of them forgotten after every so many preparations; with one
more nothing is prepared any more. Preparing doubles what is computed: on a machine that takes the processor away from
whoever computes, that is worse than cold caches."""
LATE = 0.05
"""Share of a period by which such a tick is late."""
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""What asks for an end. A SIGHUP that is ignored, as under nohup, asks for none."""

log = logging.getLogger(__name__)


class LoopExit(Enum):
    """Why a loop returned."""

    DONE = "done"
    INTERRUPTED = "interrupted"


class Interrupted(KeyboardInterrupt):
    """One of `STOP_SIGNALS` arrived while the loop ran."""


class FixedRateLoop:
    """Calls `tick(now)` at the absolute deadlines start + k * period of the injected clock.

    A deadline that has passed when the previous tick ends is skipped and counted, never caught up in a burst, and
    the deadlines after it stay where they were. `brake` is called once the loop is left, whether by return,
    exception, KeyboardInterrupt or signal (`STOP_SIGNALS`), and again (three times at most) if it raises.
    """

    def __init__(
        self,
        clock: Clock,
        period: float,
        tick: Callable[[float], bool],
        brake: Callable[[], None],
        handle_signals: bool = True,
        prepare: Callable[[bool], None] | None = None,
        lead: float = 0.0,
    ) -> None:
        """
        Args:
            clock: where deadlines are measured.
            period: [s].
            tick: called with the time [s]; returns True when the loop is done.
            brake: stops the robot.
            handle_signals: turn `STOP_SIGNALS` into an interruption while the loop runs in the main thread.
            prepare: called before a deadline, where there is time for it, as late as it can be and be done by then:
                with False, and once more with True if there is time for that as well.
            lead: time before the deadline at which it is begun at most [s].

        Raises:
            ValueError: `period` is not a finite positive number.
        """
        if not (math.isfinite(period) and period > 0.0):
            raise ValueError(f"FixedRateLoop: period {period} s must be finite and positive")
        self.clock = clock
        self.period = period
        self.lateness = Histogram()
        self.late = 0.0
        """How long after its deadline the present tick began [s]."""
        self.ticks = 0
        self.phase_error = 0.0
        """How far the newest deadline lies from a whole number of periods after the first [s]; 0 but for rounding."""
        self.overruns = 0
        """Deadlines that were skipped, in all."""
        self.overruns_in_a_row = 0
        """Ticks in a row that each missed at least one deadline."""
        self._tick = tick
        self._brake = brake
        self._handle_signals = handle_signals
        self._prepare, self._lead, self._ahead, self._again = prepare, lead, lead, 0.5 * lead
        self._spoilt = 0.0
        self.unprepared = ""
        """Why nothing is prepared any more, if something was."""
        self._leaving = True
        self._signalled = False
        self._stopped = False

    def stop(self) -> None:
        """Leave the loop after the present tick; if it does not run, the next `run` ends before its first tick.

        May be called from any thread.
        """
        self._stopped = True

    def drop_preparation(self, why: str) -> None:
        """Do without `prepare` from now on."""
        self._prepare, self.unprepared = None, why

    def run(self) -> LoopExit:
        """Run until `tick` returns True, `stop` is called, or a signal or exception arrives.

        Raises:
            Exception: whatever `tick` raises, after the brake; or what `brake` raised at its last attempt.
        """
        self._leaving, self._signalled = True, False
        exit_reason = LoopExit.DONE
        with self._signals():
            # Two levels: a signal in the few instructions before `_leaving` is set still finds an `except` around it.
            try:
                try:
                    self._run()
                finally:
                    self._leaving = True
            except KeyboardInterrupt:
                exit_reason = LoopExit.INTERRUPTED
            finally:
                self._stopped = False  # not at the beginning: a stop that comes just before it must not be lost
                self._brake_for_sure()
        return LoopExit.INTERRUPTED if self._signalled else exit_reason

    def _run(self) -> None:
        self._leaving = False
        if self._signalled:
            raise Interrupted("before the first tick")
        start = self.clock.now()
        index = 0
        # what `interrupt` raises may be swallowed, as in a `__del__`: the signal counts all the same
        while not (self._stopped or self._signalled):
            deadline = start + index * self.period
            if self._prepare is not None and self.clock.now() < deadline - self._ahead:
                self.clock.sleep_until(deadline - self._ahead)
                self._prepare_for(deadline)
            self.clock.sleep_until(deadline)
            now = self.clock.now()
            self.phase_error = math.remainder(deadline - start, self.period)
            self.late = max(now - deadline, 0.0)
            self.lateness.record(self.late)
            self.ticks += 1
            if self._tick(now):
                return
            index = self._next_index(start, index)

    def _prepare_for(self, deadline: float) -> None:
        assert self._prepare is not None
        began = self.clock.now()
        if began > deadline:  # woken too late, by no fault of the preparation
            return
        self._prepare(False)
        ready = first = self.clock.now()
        again = max(0.95 * self._again, 0.5 * (first - began))  # the first has warmed the caches for it
        if self._prepare is not None and first + again <= deadline:
            self._prepare(True)
            ready = self.clock.now()
            again = max(again, ready - first)
        self._spoilt = max(self._spoilt - 1.0 / FORGIVEN, 0.0) + (ready > deadline + LATE * self.period)
        if self._spoilt > SPOILT:
            log.warning("preparing makes too many ticks late, this one by %.1f ms: dropped", 1e3 * (ready - deadline))
            self.drop_preparation("it made ticks late")
        self._again = again
        # as late as it may be begun: what lies between would only get cold again
        self._ahead = min(max(first - began + again + 1e-4, 0.95 * self._ahead), self._lead)

    def _next_index(self, start: float, index: int) -> int:
        """Number of the first deadline that has not passed."""
        now = self.clock.now()
        following = index + 1
        if now <= start + following * self.period:
            self.overruns_in_a_row = 0
            return following
        following = max(following + 1, math.ceil((now - start) / self.period))
        self.overruns += following - index - 1
        self.overruns_in_a_row += 1
        return following

    def _brake_for_sure(self) -> None:
        for attempt in range(BRAKE_ATTEMPTS):
            try:
                self._brake()
                return
            except BaseException:
                if attempt == BRAKE_ATTEMPTS - 1:
                    raise

    @contextmanager
    def _signals(self) -> Iterator[None]:
        if not self._handle_signals or threading.current_thread() is not threading.main_thread():
            yield
            return

        def interrupt(number: int, _frame: FrameType | None) -> None:
            # Outside of the ticks a signal is only noted: it must not cut the braking short.
            self._signalled = True
            if not self._leaving:
                self._leaving = True
                raise Interrupted(signal.Signals(number).name)

        with _handling(interrupt):
            yield


@contextmanager
def noting_signals(note: Callable[[], None]) -> Iterator[None]:
    """Have `STOP_SIGNALS` call `note` and nothing else, where this is the main thread.

    For what must be brought to its end around a loop: between its last tick and the program's end nothing is to be
    cut short. A loop that runs inside handles signals in its own way.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    with _handling(lambda _number, _frame: note()):
        yield


def stop_signals() -> tuple[signal.Signals, ...]:
    """Those of `STOP_SIGNALS` that are to be obeyed by this process."""
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return tuple(number for number in STOP_SIGNALS if number is not signal.SIGHUP or not ignored)


def hear_signals() -> None:
    """Have signals arrive, whatever whoever started this process has left it with.

    A signal that is blocked never comes, and with SIGCHLD ignored nobody learns how a child has ended.
    """
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (*STOP_SIGNALS, signal.SIGCHLD))


@contextmanager
def _handling(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    before = {number: signal.signal(number, handler) for number in stop_signals()}
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)
