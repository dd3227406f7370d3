"""What the robot is allowed to do: modes and the transitions between them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from enum import Enum


class Mode(Enum):
    """What the runtime is doing."""

    INIT = "init"
    """Braked; sensors and estimator are not ready."""
    READY = "ready"
    """Braked; it knows where it is."""
    ARMED = "armed"
    """Braked; it has a goal and may go."""
    RUNNING = "running"
    """The policies drive."""
    STOPPED = "stopped"
    """Braked after a run that ended as it should."""
    FAULT = "fault"
    """Braked after something that must be looked at. Latches until it is acknowledged."""


TRANSITIONS: dict[Mode, frozenset[Mode]] = {
    Mode.INIT: frozenset({Mode.READY, Mode.STOPPED, Mode.FAULT}),
    Mode.READY: frozenset({Mode.ARMED, Mode.STOPPED, Mode.FAULT}),
    Mode.ARMED: frozenset({Mode.RUNNING, Mode.READY, Mode.STOPPED, Mode.FAULT}),
    Mode.RUNNING: frozenset({Mode.STOPPED, Mode.FAULT}),
    Mode.STOPPED: frozenset({Mode.INIT, Mode.FAULT}),
    Mode.FAULT: frozenset(),
}


class InvalidTransition(RuntimeError):
    """A change of mode that the table does not allow."""


class Supervisor:
    """Holds the mode and lets it change only along `TRANSITIONS`."""

    def __init__(self, changed: Callable[[float, Mode, str], None] | None = None) -> None:
        """`changed(now, mode, why)` is called after every change."""
        self._changed = changed
        self.mode = Mode.INIT
        self.fault: str | None = None
        """Why it is in FAULT."""
        self.history: deque[tuple[float, Mode, str]] = deque(maxlen=256)
        """Last changes: time [s], mode entered, why."""

    def change(self, mode: Mode, why: str, now: float) -> None:
        """Enter `mode`.

        Raises:
            InvalidTransition: not allowed from the present mode.
        """
        if mode not in TRANSITIONS[self.mode]:
            allowed = ", ".join(sorted(each.name for each in TRANSITIONS[self.mode])) or "none"
            raise InvalidTransition(f"{self.mode.name} -> {mode.name} ({why}); allowed: {allowed}")
        self._enter(mode, why, now)

    def fail(self, why: str, now: float) -> None:
        """Enter FAULT from anywhere; the first reason is kept."""
        if self.mode is not Mode.FAULT:
            self.fault = why
            self._enter(Mode.FAULT, why, now)

    def acknowledge(self, now: float) -> None:
        """Leave FAULT for INIT, on somebody's word that the cause is gone.

        Raises:
            InvalidTransition: there is no fault.
        """
        if self.mode is not Mode.FAULT:
            raise InvalidTransition(f"{self.mode.name}: there is no fault to acknowledge")
        self.fault = None
        self._enter(Mode.INIT, "acknowledged", now)

    def _enter(self, mode: Mode, why: str, now: float) -> None:
        self.mode = mode
        self.history.append((now, mode, why))
        if self._changed is not None:
            self._changed(now, mode, why)
