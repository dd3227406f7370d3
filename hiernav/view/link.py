"""The control loop's side of the live page: shows ticks to a process of its own, and takes commands from it.

Nothing here waits. A page that is stalled misses ticks, of one that floods a few commands a tick are obeyed, and one
that has died is forgotten; the robot drives on. An emergency stop does not wait for what the page said before it.
"""

from __future__ import annotations

import logging
import math
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from importlib.util import find_spec
from typing import Protocol

import msgspec
import numpy as np

from hiernav.nav.occupancy import OccupancyMap
from hiernav.runtime import messages
from hiernav.runtime.child import DYING
from hiernav.runtime.observe import Event, Observer, TickRecord
from hiernav.view.commands import COMMAND_BYTES, MAX_BYTES, Command, Settings

SHOW_HZ = 20.0
"""Ticks shown a second."""
COMMANDS_PER_TICK = 4
"""Commands that are obeyed in a tick, emergency stops aside; more are refused."""
PAGE_BUFFER, HEARD_PER_TICK = 65536, 256
"""What the page's end of the socket holds [bytes], and messages that are read in a tick at most: more than that."""
LARGEST_MAP = 1_000_000
"""Pixels of a map that is shown as it is; a larger one is shown coarser."""
START_SECONDS, CLOSING = 30.0, 1.0
"""What the page's process is given to come up, before the robot moves, and to end by itself [s]."""

PROGRAM = (sys.executable, "-P", "-m", "hiernav.view")
"""-P: no file of the present folder is taken for a module."""

_decode = msgspec.json.Decoder(Command).decode

log = logging.getLogger(__name__)


class Control(Protocol):
    """What the page may ask for: `hiernav.runtime.driver.Driver` has it all. Safe to call between ticks."""

    def set_goal(self, goal: np.ndarray) -> object: ...
    def cancel(self) -> object: ...
    def pause(self) -> object: ...
    def resume(self) -> object: ...
    def estop(self, why: str) -> object: ...
    def acknowledge(self) -> object: ...


class ViewerLink(Observer):
    """Shows a run on a page that `python -m hiernav.view` serves on 127.0.0.1."""

    def __init__(
        self,
        control: Control,
        robot_radius: float,
        goal_radius: float,
        title: str = "hiernav",
        port: int = 8080,
        faults: Mapping[str, Callable[[], None]] | None = None,
        program: Sequence[str] = PROGRAM,
    ) -> None:
        """Start the page's process and wait for it; the robot must not be moving yet.

        Args:
            control: takes the commands.
            robot_radius: [m].
            goal_radius: [m].
            title: of the page.
            port: to listen on; the next free one if it is taken, any if 0.
            faults: what can be injected, by name.
            program: that serves the page; it is given the number of its end of the socket.

        Raises:
            ValueError: the page does not come up.
        """
        if program is PROGRAM and find_spec("viser") is None:
            raise ValueError("the live page needs viser: `pip install -e '.[view]'` in the checkout installs it")
        self.control, self.faults = control, dict(faults or {})
        self.shown = self.dropped = self.refused = 0
        """Ticks shown, messages the page was too slow for, and commands that made no sense or were too many."""
        self.first_goal: np.ndarray | None = None
        """(2,) goal to set at the first tick [m]."""
        self._encoder = messages.TickEncoder()
        self._shown_at = -math.inf
        self._troubled = False
        self._large: OccupancyMap | None = None
        self._coarse: OccupancyMap | None = None
        self._coarsening = False
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket: socket.socket | None = ours
        with theirs:
            theirs.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, PAGE_BUFFER)
            # In a session of its own: Ctrl-C is for the loop, which then closes the socket.
            self._process = subprocess.Popen(
                [*program, str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                start_new_session=True,
            )
        self.url = self._start(Settings(title, robot_radius, goal_radius, port, tuple(self.faults)))
        """Address of the page."""

    def make_requests(self) -> None:
        """Ask the loop for what the page asks for, as far as that does not ask too often."""
        if self.first_goal is not None:
            self.control.set_goal(self.first_goal)
            self.first_goal = None
        left = COMMANDS_PER_TICK
        for _ in range(HEARD_PER_TICK):
            data = self._receive()
            if data is None:
                return
            try:
                command = _decode(data)
                if command.kind == "estop":
                    self.control.estop("stopped on the live page")
                elif left:
                    left -= 1
                    self._obey(command)
                else:
                    self.refused += 1
            except (msgspec.DecodeError, ValueError, KeyError):
                self.refused += 1

    def tick(self, record: TickRecord) -> None:
        try:
            self._show(record)
        except Exception:  # no memory, or no thread: were it raised, the page would be heard no more either
            self.dropped += 1
            self._encoder = messages.TickEncoder()
            if not self._troubled:
                log.exception("a tick could not be shown on the live page, which is heard as before")
            self._troubled = True

    def _show(self, record: TickRecord) -> None:
        if self._socket is None:
            return
        if abs(record.time - self._shown_at) < 1.0 / SHOW_HZ:
            return
        self._shown_at = record.time
        if record.occupancy is not None and record.occupancy.occupied.size > LARGEST_MAP:
            record = self._with_coarse_map(record, record.occupancy)
        for topic, data in self._encoder.encode(record):
            if not self._send(topic, data):
                # what is left out may be a map or a plan: show both again with the next tick
                self._encoder = messages.TickEncoder()
                return
        self.shown += 1

    def event(self, event: Event) -> None:
        self._send("/event", messages.encode_event(event))

    def close(self) -> None:
        """End the page's process."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        try:
            self._process.wait(CLOSING)
        except subprocess.TimeoutExpired:
            self._process.kill()
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(DYING)

    def _start(self, settings: Settings) -> str:
        assert self._socket is not None
        try:
            self._socket.send(msgspec.json.encode(settings))
            self._socket.settimeout(START_SECONDS)
            data = self._socket.recv(MAX_BYTES)
            answer = msgspec.json.decode(data, type=Command) if data else Command("failed", text="its process ended")
        except (OSError, msgspec.DecodeError) as error:
            self.close()
            raise ValueError(f"the live page does not come up: {error}") from None
        if answer.kind != "ready":
            self.close()
            raise ValueError(f"the live page does not come up: {answer.text}")
        self._socket.setblocking(False)
        return answer.text

    def _send(self, topic: str, data: bytes) -> bool:
        if self._socket is None:
            return False
        payload = topic.encode() + b"\n" + data
        if len(payload) > MAX_BYTES:
            self.dropped += 1
            return topic == "/map"
        try:
            self._socket.send(payload)
            return True
        except BlockingIOError:
            self.dropped += 1
        except OSError:
            self._forget()
        return False

    def _receive(self) -> bytes | None:
        """What the page says next; None if it says nothing."""
        if self._socket is None:
            return None
        try:
            data = self._socket.recv(COMMAND_BYTES)
        except BlockingIOError:
            return None
        except OSError:
            data = b""
        if not data:
            self._forget()
            return None
        return data

    def _obey(self, command: Command) -> None:
        match command.kind:
            case "goal":
                self.control.set_goal(np.array([command.x, command.y]))
            case "fault":
                self.faults[command.text]()
            case "cancel" | "pause" | "resume" | "acknowledge":
                getattr(self.control, command.kind)()
            case _:
                self.refused += 1

    def _forget(self) -> None:
        log.warning("the live page is gone; the robot drives on")
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _with_coarse_map(self, record: TickRecord, occupancy: OccupancyMap) -> TickRecord:
        """Large maps are made coarser in a thread, one at a time; the newest that is done is shown, at first none."""
        if occupancy is not self._large and not self._coarsening:
            self._large, self._coarsening = occupancy, True
            try:
                threading.Thread(target=self._make_coarse, args=(occupancy,), name="coarse map", daemon=True).start()
            except RuntimeError:  # the system has no room for another thread: tried again with the next tick
                self._large, self._coarsening = None, False
        return replace(record, occupancy=self._coarse)

    def _make_coarse(self, occupancy: OccupancyMap) -> None:
        try:
            self._coarse = coarser(occupancy, LARGEST_MAP)
        finally:
            self._coarsening = False


def coarser(occupancy: OccupancyMap, most: int) -> OccupancyMap:
    """A map of at most about `most` pixels; each is occupied if anything in it is."""
    rows, columns = occupancy.occupied.shape
    step = max(1, math.ceil(math.sqrt(rows * columns / most)))
    rows_from, columns_from = np.arange(0, rows, step), np.arange(0, columns, step)
    by_row = np.logical_or.reduceat(occupancy.occupied, rows_from, axis=0)
    pixels = np.logical_or.reduceat(by_row, columns_from, axis=1)
    return OccupancyMap(pixels, occupancy.resolution * step, occupancy.origin)
