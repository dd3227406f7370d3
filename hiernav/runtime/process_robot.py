"""The control process's side of a robot whose adapter lives in a process of its own."""

from __future__ import annotations

import json
import os
import select
import socket
import subprocess
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from typing import Any

import numpy as np

from hiernav.runtime.child import Child
from hiernav.runtime.mailbox import Mailbox, mapped, shared_memory
from hiernav.runtime.realtime import RealtimeConfig
from hiernav.runtime.robot import RobotGone, SensorFrame, Truth
from hiernav.runtime.robot_process import END, SLOW, STATUS, TAKEN, TRIPS
from hiernav.runtime.wire import CAPACITY, decode_frame, encode_command

CLOSING = 5.0
"""Time that the robot's own `close`, and what it does just then, may take [s]."""


def simulated(realtime: RealtimeConfig | None = None, **arguments: Any) -> ProcessRobot:
    """A simulated robot in real time in a process of its own; arguments of `hiernav.runtime.sim_robot.make`."""
    # nothing is drawn there, and MuJoCo would take 0.1 s to find out with what
    environment = {"MUJOCO_GL": "off"}
    return ProcessRobot("hiernav.runtime.sim_robot:make", arguments, environment=environment, realtime=realtime)


class ProcessRobot:
    """A `Robot` behind two mailboxes: reading and sending never wait for the adapter.

    The adapter's watchdog brakes the robot if no command comes, whether this process is slow, stopped or dead.
    """

    def __init__(
        self,
        robot: str,
        arguments: Mapping[str, Any] | None = None,
        patience: float = 20.0,
        environment: Mapping[str, str] | None = None,
        realtime: RealtimeConfig | None = None,
    ) -> None:
        """
        Args:
            robot: what makes the robot over there: "package.module:function" or "file.py:function".
            arguments: of that function, as JSON can hold them.
            patience: time the robot may take to start, to show its first frame, and to answer a `call` [s].
            environment: variables of that process besides those of this one.
            realtime: what that process asks of the system; the defaults if None.

        What is wrong with the adapter shows where its first answer is waited for: by `control_period`, `action_dim`,
        `realtime`, `read` and `call`, as a `RobotGone` that says what in one line.
        """
        size = STATUS + 2 * Mailbox.size(CAPACITY)
        self._descriptor = shared_memory(size)
        memory = self._memory = mapped(self._descriptor)
        self._status = np.frombuffer(memory, np.float64, 3)
        self._commands = Mailbox(memory, STATUS, CAPACITY)
        self._frames = Mailbox(memory, STATUS + Mailbox.size(CAPACITY), CAPACITY)
        self._calls, theirs = socket.socketpair()
        self._patience = patience
        asked = asdict(realtime or RealtimeConfig())
        settings = json.dumps({"robot": robot, "arguments": dict(arguments or {}), "realtime": asked})
        with theirs:
            self.child = Child(
                "hiernav.runtime.robot_process",
                (theirs.fileno(), self._descriptor, settings),
                (theirs.fileno(), self._descriptor),
                environment,
            )
        self._facts: dict[str, Any] | None = None
        self._message: bytes | None = None
        self._newest: tuple[SensorFrame, Truth | None] | None = None
        self._driven = False
        self._last_words = b""
        self.killed = False
        """Whether the adapter did not end by itself, and was killed: nothing here has braked the robot since."""

    @property
    def control_period(self) -> float:
        return float(self._wait_for_start()["control_period"])

    @property
    def action_dim(self) -> int:
        return int(self._wait_for_start()["action_dim"])

    @property
    def realtime(self) -> Mapping[str, str]:
        """What the system granted the adapter (`request_realtime`)."""
        return self._wait_for_start()["realtime"]

    @property
    def watchdog_trips(self) -> int:
        """How often the adapter braked because no command came."""
        return int(self._status[TRIPS])

    def trouble(self) -> str | None:
        """Why the robot must not be driven now, as the adapter sees it; None if it may be."""
        slow = float(self._status[SLOW])
        return f"the adapter keeps commands waiting for {slow:.2f} s: its read or send is too slow" if slow else None

    def read(self) -> SensorFrame:
        """The newest frame; the first one is waited for.

        Raises:
            RobotGone: the adapter has ended.
            RuntimeError: it shows no first frame.
        """
        message = self._frames.get()
        if message is None and self._newest is None:
            message = self._wait_for_frame()
        if message is not None:
            self._message, self._newest = message, decode_frame(message)
            self._status[TAKEN] = self._frames.taken
        else:
            self._require_adapter()
        assert self._newest is not None
        return self._newest[0]

    def rehearse(self) -> None:
        """Read the newest frame once more, for the caches' sake."""
        if self._message is not None:
            decode_frame(self._message)

    def send(self, action: np.ndarray) -> np.ndarray:
        sent = np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0)
        if sent.shape != (self.action_dim,) or not np.isfinite(sent).all():
            raise ValueError(f"ProcessRobot.send: action {action} is not {self.action_dim} finite numbers")
        self._driven = True
        self._commands.put(encode_command(sent, time.monotonic()))
        self.child.nudge()
        return sent

    def brake(self) -> None:
        self._commands.put(encode_command(None, time.monotonic()))
        self.child.nudge()

    def stands(self) -> None:
        """Take note that the robot was seen to stand: `close` may release it at once."""
        self._driven = False

    def truth(self) -> Truth | None:
        """Of a simulated robot, at the frame that was read last; None of a real one."""
        if self._newest is None:
            self.read()
        return None if self._newest is None else self._newest[1]

    def call(self, method: str, **arguments: Any) -> Any:
        """Call a method of the robot over there, and wait for it. Not for use while it is driven.

        Raises:
            RobotGone: the adapter has ended.
            RuntimeError: the method raised, or the adapter does not answer.
        """
        self._wait_for_start()
        with suppress(ConnectionError):  # that the adapter has ended shows where its answer is waited for
            self._calls.sendall(json.dumps({"method": method, "arguments": arguments}).encode() + b"\n")
        answer = self._receive()
        if "error" in answer:
            raise RuntimeError(answer["error"])
        self._newest = None
        return answer["result"]

    def dismiss(self) -> None:
        """Have the adapter brake the robot, for a second where it may be rolling, release it, and end.

        Nothing is waited for here, but by `close`, which is to follow.
        """
        if not self._driven:
            self.child.nudge(END)
        self.child.dismiss()

    def close(self) -> None:
        """`dismiss`, and wait until the adapter has ended; kill it where that takes longer than `CLOSING`."""
        if self._descriptor >= 0:
            self.dismiss()
            self.killed = not self.child.close(CLOSING)
            self._calls.close()
            os.close(self._descriptor)
            self._descriptor = -1

    def _wait_for_start(self) -> dict[str, Any]:
        if self._facts is None:
            answer = self._receive()
            if "error" in answer:
                raise RobotGone(answer["error"])
            self._facts = answer
        return self._facts

    def _wait_for_frame(self) -> bytes:
        self._wait_for_start()
        end = time.monotonic() + self._patience
        while (message := self._frames.get()) is None:
            self._require_adapter()
            if time.monotonic() > end:
                raise RuntimeError(f"the robot's adapter shows no frame for {self._patience:g} s")
            time.sleep(0.001)
        return message

    def _require_adapter(self) -> None:
        ended = self.child.ended
        with suppress(OSError, ValueError):  # nothing is heard after `close`
            while select.select([self._calls], [], [], 0.0)[0] and (part := self._calls.recv(65536)):
                self._last_words += part
        why = _why(self._last_words)
        if ended is not None:
            raise RobotGone(f"the robot's adapter ended with status {ended}{why}")
        if why:  # and then it ends, or is kept from it
            raise RobotGone(f"the robot's adapter fails{why}")

    def _receive(self) -> dict[str, Any]:
        line, end = b"", time.monotonic() + self._patience
        while not line.endswith(b"\n"):
            ended = self.child.ended is not None  # asked first: what it said at last is still to be read
            if not select.select([self._calls], [], [], 0.05)[0]:
                if ended:  # a process that it left behind may hold its end of the socket
                    self._require_adapter()
                if time.monotonic() > end:
                    raise RuntimeError(f"the robot's adapter does not answer for {self._patience:g} s")
                continue
            part = b""
            with suppress(ConnectionError):
                part = self._calls.recv(65536)
            if not part:
                with suppress(subprocess.TimeoutExpired):
                    self.child.process.wait(5.0)
                self._require_adapter()
                raise RobotGone("the robot's adapter does not answer any more")
            line += part
        said, _, rest = line.partition(b"\n")
        self._last_words += rest
        answer = json.loads(said)
        if "gone" in answer:  # it fails while it is asked for something
            self._last_words = line
            with suppress(subprocess.TimeoutExpired):
                self.child.process.wait(5.0)
            self._require_adapter()
            raise RobotGone(f"the robot's adapter fails{_why(line)}")
        return answer


def _why(last_words: bytes) -> str:
    """What an adapter said before it ended, to be put behind that it did."""
    for line in reversed(last_words.split(b"\n")):
        with suppress(ValueError, KeyError, TypeError):
            return f": {json.loads(line)['gone']}"
    return ""
