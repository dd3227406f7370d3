"""A robot's adapter in a process of its own, which brakes by itself when commands stop coming.

Run as `python -P -m hiernav.runtime.robot_process NEWS CALLS MEMORY SETTINGS` by `ProcessRobot`. Whatever happens to
the control process, be it killed or stopped, this process goes on, and its watchdog brakes the robot. Where the robot's
own code fails, this process brakes the robot before it ends, and tells the control process why in one line.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import select
import sys
import time
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import msgspec
import numpy as np

from hiernav.runtime.child import leave_signals_to_parent, wait_for_news
from hiernav.runtime.gathering import Gathering
from hiernav.runtime.mailbox import Mailbox, mapped
from hiernav.runtime.patient import be_patient
from hiernav.runtime.realtime import RealtimeConfig, request_realtime
from hiernav.runtime.robot import CommandWatchdog, Robot, SensorFrame
from hiernav.runtime.wire import CAPACITY, decode_command, encode_frame

END = b"e"
"""News that this process is not needed any more, and that the robot stands."""
STATUS = 64
"""Bytes at the front of the memory, of which the following places are in use."""
TRIPS, TAKEN, SLOW = 0, 1, 2
"""How often the watchdog braked; the number of the newest frame that the loop has taken, which the control process
writes; how long the robot's code keeps commands waiting, 0 where it is quick enough [s]."""
LATE_LOOKS, LATE_WITHIN = 5, 2.0
"""A robot is too slow to be driven that has kept commands waiting, longer than it may drive on without one, so often
within so long [s]. Once may be the machine."""
PARTS = ("control_period", "action_dim", "read", "send", "brake", "close")
"""What a robot has to have."""
LONGEST = 1000
"""Characters of an error that the control process is told."""
LAST_BRAKES = 1.0
"""Time for which a robot is braked that failed, or of which nobody says that it stands, before it is released [s]."""


def main() -> None:
    news, calls, descriptor = map(int, sys.argv[1:4])
    leave_signals_to_parent()
    be_patient(reports=False)  # what the robot's code prints must not keep it from braking
    settings = json.loads(sys.argv[4])
    sys.path.append("")  # the present folder may have the robot's modules; behind all others
    try:
        robot = make_robot(settings["robot"], settings["arguments"])
        leave_signals_to_parent()  # once more: the robot's driver may have seen to them
        adapter = Adapter(robot, news, calls, descriptor, msgspec.convert(settings["realtime"], RealtimeConfig))
    except BaseException as error:
        if _frames(error):
            _tell([error])
        _say(calls, {"error": f"adapter {settings['robot']!r}: {_one_line(error)}"})
        _leave(1)
    _leave(adapter.run())


def _leave(status: int) -> NoReturn:
    """End at once: threads that the robot's code has started, and never ended, must not keep this process."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(Exception):
            stream.flush()
    os._exit(status)


class AdapterError(ValueError):
    """A name of an adapter that leads to no robot."""


def make_robot(name: str, arguments: dict[str, Any]) -> Robot:
    """Call what `name` says, "package.module:function" or "path/to/file.py:function", with `arguments`.

    Raises:
        AdapterError: there is no such function, or what it makes is no robot.
        Exception: whatever that function, or the import of its file or module, raises.
    """
    place, _, function = name.partition(":")
    if not function:
        raise AdapterError("expected file.py:function or package.module:function")
    if place.endswith(".py"):
        spec = importlib.util.spec_from_file_location(Path(place).stem, place)
        if spec is None or spec.loader is None or not Path(place).is_file():
            raise AdapterError("there is no such file")
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
    else:
        module = importlib.import_module(place)
    make: Callable[..., Robot] | None = getattr(module, function, None)
    if make is None:
        raise AdapterError(f"{place} has no {function!r}")
    robot = make(**arguments)
    missing = [part for part in PARTS if not hasattr(robot, part)]
    if missing:
        raise AdapterError(f"{function} makes {type(robot).__name__}, which has no {', '.join(missing)}")
    return robot


class Adapter:
    """Hands commands to the robot as they come, and frames back; brakes if none came in time."""

    def __init__(
        self, robot: Robot, news: int, calls: int, descriptor: int, realtime: RealtimeConfig | None = None
    ) -> None:
        self.robot, self._realtime = robot, realtime
        self._period = robot.control_period
        self.watchdog = CommandWatchdog(self._period)
        self._news, self._calls = news, calls
        memory = self._memory = mapped(descriptor)
        self._status = np.frombuffer(memory, np.float64, 3)
        self._commands = Mailbox(memory, STATUS, CAPACITY)
        self._frames = Mailbox(memory, STATUS + Mailbox.size(CAPACITY), CAPACITY)
        self._truth = getattr(robot, "truth", None)
        self._shown: object = None
        self._fix: tuple[np.ndarray, float] | None = None
        self._gathering = Gathering(self._period)
        self._braked = 0.0
        self._kept = 0.0
        """Time that `read` and `send` have taken since commands were looked for last [s]."""
        self._late: deque[tuple[float, float]] = deque(maxlen=LATE_LOOKS)
        self._introduced = False

    def run(self) -> int:
        """Follow the control process until it says so, is gone, or something fails; then brake and release the robot.

        Returns:
            The exit status: 1 where something failed, which is told on stderr, else 0.
        """
        failures: list[BaseException] = []
        last_brakes = LAST_BRAKES
        try:
            if self._follow():
                last_brakes = 0.0
        except BaseException as error:
            failures.append(error)
        failures += self._brake_for(last_brakes)  # before anything else
        if failures:  # one that was never introduced still owes its first answer
            why = _one_line(failures[0])
            answer = {"gone": why} if self._introduced else {"error": f"the robot's adapter cannot start: {why}"}
            _say(self._calls, answer)
        try:
            self.robot.close()
        except BaseException as error:
            failures.append(error)
        _tell(failures)  # not before: there may be nobody who reads it
        return 1 if failures else 0

    def _follow(self) -> bool:
        """Hand commands over and frames back. True once this process is not needed any more, False if it is alone."""
        robot, idle = self.robot, 0.25 * self._period
        granted = request_realtime(self._realtime, before_the_loop=True)
        period, action_dim = float(robot.control_period), int(robot.action_dim)
        facts = {"control_period": period, "action_dim": action_dim, "realtime": granted}
        self._publish()
        if not _say(self._calls, facts):
            return False
        self._introduced = True
        while True:
            ready = select.select([self._news, self._calls], [], [], idle)[0]
            if self._calls in ready and not self._take_call():
                return False
            news = wait_for_news(self._news, 0.0) if self._news in ready else b""
            if news is None:
                return False
            if END in news:
                return True
            self._obey(time.monotonic())
            self._publish()

    def _brake_for(self, seconds: float) -> list[BaseException]:
        """Brake once, then at the control rate for `seconds`, or `LAST_BRAKES` if a brake raises; what it raised."""
        failures: list[BaseException] = []
        began = time.monotonic()
        while True:
            try:
                self.robot.brake()
            except BaseException as error:
                seconds = LAST_BRAKES
                failures = failures or [error]
            if time.monotonic() - began >= seconds:
                return failures
            time.sleep(self._period)

    def _obey(self, now: float) -> None:
        """Follow a new command; brake if it was given too long ago, or if there is none and the last one is too old."""
        self._watch_pace(now)
        message = self._commands.get()
        if message is not None:
            command, given = decode_command(message)
            # this process may have been kept from looking, by the robot's driver or by the machine
            fresh = now - given <= self.watchdog.timeout
            if fresh:
                self.watchdog.feed(min(given, now))
            if command is None or not fresh:
                self.robot.brake()
            else:
                began = time.monotonic()
                self.robot.send(command)
                self._kept += time.monotonic() - began
        elif self.watchdog.expired(now):
            # once, then at the control rate: a bus may need the brake repeated, but not hundreds of times a second
            trips = self.watchdog.trips
            if trips > self._status[TRIPS]:
                self._status[TRIPS] = trips
                self.robot.brake()
                self._braked = now
            elif trips and now - self._braked >= self._period:
                self.robot.brake()
                self._braked = now

    def _watch_pace(self, now: float) -> None:
        """Tell the control process of a robot whose `read` or `send` keeps its commands waiting again and again."""
        if self._kept > self.watchdog.timeout:
            self._late.append((now, self._kept))
        self._kept = 0.0
        often = len(self._late) == LATE_LOOKS and now - self._late[0][0] <= LATE_WITHIN
        self._status[SLOW] = max(gap for _, gap in self._late) if often else 0.0

    def _publish(self) -> None:
        began = time.monotonic()
        frame = self.robot.read()
        self._kept += time.monotonic() - began
        if not isinstance(frame, SensorFrame):
            raise TypeError(
                f"read() returned {type(frame).__name__}, expected a SensorFrame; what is missing is None in it"
            )
        if frame is self._shown:
            return
        self._shown = frame
        whole = self._gathering.add(self._with_newest_fix(frame), self._frames.written + 1, int(self._status[TAKEN]))
        self._frames.put(encode_frame(whole, None if self._truth is None else self._truth()))

    def _with_newest_fix(self, frame: SensorFrame) -> SensorFrame:
        """The frame with the newest fix, which its stamp tells from a newer one: the loop sees but the newest frame."""
        if frame.position_fix is not None:
            stamp = frame.stamp if frame.fix_stamp is None else frame.fix_stamp
            if self._fix is None or not stamp < self._fix[1] <= frame.stamp:
                self._fix = frame.position_fix, stamp
        if self._fix is None:
            return frame
        return replace(frame, position_fix=self._fix[0], fix_stamp=self._fix[1])

    def _take_call(self) -> bool:
        """Call one of the robot's own methods, such as `restart` of a simulated one; False if nobody asks any more."""
        line = b""
        while not line.endswith(b"\n"):
            part = os.read(self._calls, 65536)
            if not part:
                return False
            line += part
        request = json.loads(line)
        try:
            answer = {"result": getattr(self.robot, request["method"])(**request["arguments"])}
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        self._shown = self._fix = None
        self._gathering.forget()
        self._publish()
        return _say(self._calls, answer)


def _say(calls: int, answer: dict[str, Any]) -> bool:
    """Tell the control process in a line of JSON; False if nobody is there any more who could take it."""
    try:
        os.write(calls, json.dumps(answer).encode() + b"\n")
    except OSError:
        return False
    return True


def _one_line(error: BaseException) -> str:
    """What is wrong, and the file and line that raised it where that is the robot's own code."""
    try:
        text = " ".join(str(error).split())[:LONGEST]
    except Exception:
        text = "it cannot even say what is wrong"
    if isinstance(error, AdapterError):
        return text
    frames = _frames(error)
    where = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {text}{where}"


def _frames(error: BaseException) -> list[traceback.FrameSummary]:
    """The way to the error through the robot's own code and what that calls; empty where it lies in neither."""
    ours = (__file__, importlib.__file__)
    frames = traceback.extract_tb(error.__traceback__)
    return [each for each in frames if each.filename not in ours and not each.filename.startswith("<frozen importlib")]


def _tell(failures: Sequence[BaseException]) -> None:
    with suppress(OSError):
        for failure in failures:
            traceback.print_exception(failure)


if __name__ == "__main__":
    main()
