"""What the control loop and the page's process say to each other, over a local socket that keeps messages apart."""

from __future__ import annotations

import socket
import threading
from typing import Annotated, Literal

import msgspec

MAX_BYTES = 160_000
"""Longest message; longer ones do not fit into the socket's buffer."""


COMMAND_BYTES = 4096
"""Longest command."""


class Settings(msgspec.Struct, frozen=True):
    """What the page's process is told first."""

    title: str
    robot_radius: float
    """[m]"""
    goal_radius: float
    """[m]"""
    port: int
    """0 lets the system choose one."""
    faults: tuple[str, ...]
    """Names of the faults that can be injected."""


class Command(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What somebody did on the page."""

    kind: Literal["ready", "failed", "goal", "cancel", "pause", "resume", "estop", "acknowledge", "fault"]
    x: float = 0.0
    """Of the goal, world frame [m]."""
    y: float = 0.0
    text: Annotated[str, msgspec.Meta(max_length=200)] = ""
    """Address of the page, why it does not come up, or name of the fault."""


class Asker:
    """The page's way to say something to the loop, from any thread.

    Where the loop is too busy to listen, a command is lost. An emergency stop waits until it is taken, and whatever is
    asked for meanwhile is lost instead.
    """

    def __init__(self, link: socket.socket) -> None:
        self._link = link
        self._stopping = threading.Lock()

    def __call__(self, command: Command) -> None:
        data = msgspec.json.encode(command)
        try:
            if command.kind == "estop":
                with self._stopping:
                    self._link.send(data)
            elif not self._stopping.locked():
                self._link.send(data, socket.MSG_DONTWAIT)
        except OSError:
            pass  # the loop is too busy, or gone; either will show
