"""What the control loop and the page's process say to each other, over a local socket that keeps messages apart."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

MAX_BYTES = 160_000
"""Longest message; longer ones do not fit into the socket's buffer."""


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

    kind: Literal["ready", "goal", "cancel", "pause", "resume", "estop", "acknowledge", "fault"]
    x: float = 0.0
    """Of the goal, world frame [m]."""
    y: float = 0.0
    text: Annotated[str, msgspec.Meta(max_length=200)] = ""
    """Address of the page, or name of the fault."""
