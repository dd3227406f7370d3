from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hiernav.runtime.clock import FakeClock, MonotonicClock
from hiernav.runtime.loop import FORGIVEN, SPOILT, FixedRateLoop, LoopExit

PERIOD = 0.25


def run_with_work(work: list[float], start: float = 100.0) -> tuple[list[float], FixedRateLoop]:
    """Run one tick per entry of `work` [s], each taking that long; returns the times of the ticks since the start."""
    clock = FakeClock(start)
    times: list[float] = []

    def tick(now: float) -> bool:
        times.append(now - start)
        clock.advance(work[len(times) - 1])
        return len(times) == len(work)

    loop = FixedRateLoop(clock, PERIOD, tick, brake=lambda: None)
    assert loop.run() is LoopExit.DONE
    return times, loop


def test_work_does_not_delay_the_next_tick():
    times, loop = run_with_work([0.0, 0.1, 0.2, 0.24, 0.0])
    assert times == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert loop.overruns == 0


def test_a_tick_that_takes_exactly_its_period_misses_nothing():
    times, loop = run_with_work([0.25, 0.25, 0.0])
    assert times == [0.0, 0.25, 0.5]
    assert loop.overruns == 0


def test_a_missed_deadline_is_skipped_and_counted():
    times, loop = run_with_work([0.3, 0.0, 0.0])
    assert times == [0.0, 0.5, 0.75]
    assert loop.overruns == 1


def test_a_long_stall_is_not_caught_up_in_a_burst():
    times, loop = run_with_work([0.0, 10.1, 0.0, 0.0])
    assert times == [0.0, 0.25, 10.5, 10.75]
    assert loop.overruns == 40


def test_overruns_in_a_row_are_counted_and_forgiven_after_a_good_tick():
    clock = FakeClock()
    seen: list[int] = []
    work = [0.3, 0.3, 0.3, 0.0, 0.0]

    def tick(now: float) -> bool:
        seen.append(loop.overruns_in_a_row)
        clock.advance(work[len(seen) - 1])
        return len(seen) == len(work)

    loop = FixedRateLoop(clock, PERIOD, tick, brake=lambda: None)
    loop.run()
    assert seen == [0, 1, 2, 3, 0]


@given(st.lists(st.floats(0.0, 3.0), min_size=2, max_size=60))
def test_the_phase_never_drifts_and_every_deadline_is_either_kept_or_counted(work):
    times, loop = run_with_work(work, start=0.0)
    indices = [time / PERIOD for time in times]
    assert all(index == round(index) for index in indices)
    assert all(later > earlier for earlier, later in zip(indices, indices[1:], strict=False))
    assert loop.overruns == indices[-1] - (len(times) - 1)
    for earlier, later, took in zip(times, times[1:], work, strict=False):
        assert later >= earlier + took - 1e-9
        assert later - (earlier + took) <= PERIOD + 1e-9


def test_a_late_wake_is_recorded_and_does_not_shift_the_deadlines():
    class LateClock(FakeClock):
        def sleep_until(self, deadline: float) -> None:
            super().sleep_until(deadline + 0.01)

    clock = LateClock()
    times: list[float] = []

    def tick(now: float) -> bool:
        times.append(now)
        return len(times) == 100

    loop = FixedRateLoop(clock, PERIOD, tick, brake=lambda: None)
    loop.run()
    assert times[-1] == pytest.approx(99 * PERIOD + 0.01)
    assert loop.lateness.max == pytest.approx(0.01)
    assert loop.overruns == 0


class Brakes:
    def __init__(self, failures: int = 0) -> None:
        self.calls = 0
        self.failures = failures

    def __call__(self) -> None:
        self.calls += 1
        if self.calls <= self.failures:
            raise OSError("bus error")


def test_a_finished_loop_brakes():
    brakes = Brakes()
    assert FixedRateLoop(FakeClock(), PERIOD, lambda now: True, brakes).run() is LoopExit.DONE
    assert brakes.calls == 1


def test_an_exception_in_a_tick_brakes_and_is_raised():
    brakes = Brakes()

    def tick(now: float) -> bool:
        raise RuntimeError("sensor gone")

    with pytest.raises(RuntimeError, match="sensor gone"):
        FixedRateLoop(FakeClock(), PERIOD, tick, brakes).run()
    assert brakes.calls == 1


def test_a_keyboard_interrupt_brakes_and_returns():
    brakes = Brakes()

    def tick(now: float) -> bool:
        raise KeyboardInterrupt

    assert FixedRateLoop(FakeClock(), PERIOD, tick, brakes, handle_signals=False).run() is LoopExit.INTERRUPTED
    assert brakes.calls == 1


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_brakes_and_returns(number):
    brakes = Brakes()
    before = signal.getsignal(number)

    def tick(now: float) -> bool:
        os.kill(os.getpid(), number)
        return False

    assert FixedRateLoop(FakeClock(), PERIOD, tick, brakes).run() is LoopExit.INTERRUPTED
    assert brakes.calls == 1
    assert signal.getsignal(number) is before


def test_a_hangup_that_is_ignored_as_under_nohup_stays_ignored():
    ticks: list[float] = []

    def tick(now: float) -> bool:
        signal.raise_signal(signal.SIGHUP)
        ticks.append(now)
        return len(ticks) == 3

    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert FixedRateLoop(FakeClock(), PERIOD, tick, Brakes()).run() is LoopExit.DONE
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_signal_that_code_of_a_tick_swallows_ends_the_loop_after_that_tick():
    brakes, ticks = Brakes(), []

    def tick(now: float) -> bool:
        ticks.append(now)
        if len(ticks) == 2:
            with suppress(BaseException):  # as Python does with what a `__del__` raises
                signal.raise_signal(signal.SIGTERM)
        return len(ticks) == 9

    assert FixedRateLoop(FakeClock(), PERIOD, tick, brakes).run() is LoopExit.INTERRUPTED
    assert (len(ticks), brakes.calls) == (2, 1)


def test_a_signal_brakes_and_returns_wherever_in_the_loop_it_arrives():
    codes = (FixedRateLoop.run.__code__, FixedRateLoop._run.__code__)
    places = {(code.co_name, line) for code in codes for _, _, line in code.co_lines() if line}
    arrived = []

    def run_with_signal_at(place: tuple[str, int]) -> None:
        brakes, before = Brakes(), signal.getsignal(signal.SIGINT)

        def trace(frame, event, argument):
            handler = signal.getsignal(signal.SIGINT)
            here = (frame.f_code.co_name, frame.f_lineno)
            if event == "line" and here == place and place not in arrived and handler is not before:
                arrived.append(place)
                handler(signal.SIGINT, frame)
            return trace if frame.f_code in codes else None

        sys.settrace(trace)
        try:
            FixedRateLoop(FakeClock(), PERIOD, lambda now: True, brakes).run()
        except KeyboardInterrupt:
            pytest.fail(f"line {place[1]} of loop.py raises what is an interruption")
        finally:
            sys.settrace(None)
        assert brakes.calls == 1

    for place in sorted(places):
        run_with_signal_at(place)
    assert len(arrived) > 15


def test_a_second_signal_does_not_cut_the_braking_short():
    finished = []

    def brake() -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGINT)
        finished.append(True)

    def tick(now: float) -> bool:
        os.kill(os.getpid(), signal.SIGINT)
        return False

    assert FixedRateLoop(FakeClock(), PERIOD, tick, brake).run() is LoopExit.INTERRUPTED
    assert finished == [True]


def test_a_brake_that_fails_is_tried_again():
    brakes = Brakes(failures=2)
    FixedRateLoop(FakeClock(), PERIOD, lambda now: True, brakes).run()
    assert brakes.calls == 3


def test_a_brake_that_keeps_failing_is_reported():
    brakes = Brakes(failures=99)
    with pytest.raises(OSError, match="bus error"):
        FixedRateLoop(FakeClock(), PERIOD, lambda now: True, brakes).run()
    assert brakes.calls == 3


def test_a_failing_clock_brakes_too():
    class BrokenClock(FakeClock):
        def sleep_until(self, deadline: float) -> None:
            raise OSError("no timer")

    brakes = Brakes()
    with pytest.raises(OSError, match="no timer"):
        FixedRateLoop(BrokenClock(), PERIOD, lambda now: False, brakes).run()
    assert brakes.calls == 1


def test_a_stop_that_comes_before_the_loop_runs_is_not_lost_and_stops_one_run_alone():
    ticks, brakes = [], []
    loop = FixedRateLoop(
        FakeClock(), PERIOD, lambda now: ticks.append(now) or len(ticks) == 3, lambda: brakes.append(1)
    )
    loop.stop()
    assert loop.run() is LoopExit.DONE
    assert ticks == [] and len(brakes) == 1
    loop.run()
    assert len(ticks) == 3


def test_stop_leaves_after_the_present_tick():
    ticks = []

    def tick(now: float) -> bool:
        ticks.append(now)
        loop.stop()
        return False

    brakes = Brakes()
    loop = FixedRateLoop(FakeClock(), PERIOD, tick, brakes)
    assert loop.run() is LoopExit.DONE
    assert (len(ticks), brakes.calls) == (1, 1)


@pytest.mark.parametrize("period", [0.0, -1.0, float("nan"), float("inf")])
def test_a_period_must_be_a_length_of_time(period):
    with pytest.raises(ValueError, match="period"):
        FixedRateLoop(FakeClock(), period, lambda now: True, lambda: None)


def test_sigterm_wakes_a_real_sleep_and_brakes():
    program = textwrap.dedent(
        """
        from hiernav.runtime.clock import MonotonicClock
        from hiernav.runtime.loop import FixedRateLoop
        def tick(now):
            print("ticking", flush=True)
            return False
        print(FixedRateLoop(MonotonicClock(), 3600.0, tick, lambda: print("braked", flush=True)).run())
        """
    )
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "ticking\n"
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=60)
    assert output == "braked\nLoopExit.INTERRUPTED\n"
    assert process.returncode == 0


@pytest.mark.realtime
def test_five_milliseconds_are_kept_on_a_real_clock():
    ticks = 0

    def tick(now: float) -> bool:
        nonlocal ticks
        ticks += 1
        return ticks == 300

    clock = MonotonicClock()
    start = clock.now()
    loop = FixedRateLoop(clock, 0.005, tick, lambda: None)
    loop.run()
    elapsed = clock.now() - start
    assert elapsed == pytest.approx((299 + loop.overruns) * 0.005, abs=0.005)
    assert loop.lateness.percentile(50) < 0.001


@pytest.mark.parametrize(("lead", "rounds"), [(0.05, 2), (0.0104, 1)])
def test_a_preparation_comes_before_its_deadline_and_never_delays_a_tick_that_has_no_time_for_it(lead, rounds):
    clock = FakeClock()
    prepared: list[float] = []
    ticks: list[float] = []

    def prepare(again: bool) -> None:
        assert again == (rounds == 2 and len(prepared) % 2 == 1)
        prepared.append(clock.now())
        clock.advance(0.01)

    def tick(now: float) -> bool:
        ticks.append(now)
        clock.advance(0.24 if len(ticks) == 4 else 0.01)
        return len(ticks) == 200

    loop = FixedRateLoop(clock, PERIOD, tick, lambda: None, prepare=prepare, lead=lead)
    loop.run()
    assert ticks == [k * PERIOD for k in range(200)] and loop.overruns == 0
    assert len(prepared) == rounds * 198  # before the first tick and after the long one there was no time
    assert prepared[0] == pytest.approx(PERIOD - lead)
    assert prepared[-rounds] == pytest.approx(199 * PERIOD - min(0.0201, lead), abs=1e-3)


@pytest.mark.parametrize(("again", "every"), [(False, 1), (False, 100), (True, 100)])
def test_a_preparation_that_keeps_making_ticks_late_is_dropped(caplog, again, every):
    clock, prepared, late = FakeClock(), [0], []

    def prepare(second: bool) -> None:
        prepared[0] += second is again
        clock.advance(0.05 if second is again and prepared[0] % every == 0 else 0.001)

    def tick(now: float) -> bool:
        late.append(loop.late)
        return len(late) == 7 * every

    loop = FixedRateLoop(clock, PERIOD, tick, lambda: None, prepare=prepare, lead=0.02)
    loop.run()
    assert prepared[0] == (SPOILT + 1) * every and sum(by > 0.02 for by in late) == SPOILT + 1
    assert "preparing makes too many ticks late" in caplog.text and loop.unprepared == "it made ticks late"


def test_a_preparation_that_seldom_makes_a_tick_late_goes_on():
    clock, prepared, ticks = FakeClock(), [0], [0]

    def prepare(again: bool) -> None:
        prepared[0] += not again
        clock.advance(0.05 if not again and prepared[0] % (2 * FORGIVEN) == 0 else 0.001)

    def tick(now: float) -> bool:
        ticks[0] += 1
        return ticks[0] == 20 * FORGIVEN

    loop = FixedRateLoop(clock, PERIOD, tick, lambda: None, prepare=prepare, lead=0.02)
    loop.run()
    assert prepared[0] == 20 * FORGIVEN - 1 and not loop.unprepared


def test_a_loop_that_is_woken_too_late_to_prepare_blames_itself(caplog):
    class Sleepy(FakeClock):
        def sleep_until(self, when: float) -> None:
            super().sleep_until(when)
            self.advance(0.03)

    clock, ticks = Sleepy(), [0]

    def tick(now: float) -> bool:
        ticks[0] += 1
        return ticks[0] == 50

    loop = FixedRateLoop(clock, PERIOD, tick, lambda: None, prepare=lambda again: None, lead=0.02)
    loop.run()
    assert "dropped" not in caplog.text
