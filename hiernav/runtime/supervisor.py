"""What the robot is allowed to do: modes and the transitions between them."""

from __future__ import annotations

import re
from collections.abc import Callable
from enum import Enum


class Mode(Enum):
    """What the runtime is doing. The robot is braked in all of them but RUNNING and RECOVERING."""

    INIT = "init"
    """Sensors and estimator are not ready."""
    READY = "ready"
    """It knows where it is, and has no goal."""
    ARMED = "armed"
    """It has a goal, and waits for its first plan."""
    RUNNING = "running"
    """The policies drive."""
    HOLD = "hold"
    """It waits for something to pass, and goes on by itself."""
    RECOVERING = "recovering"
    """It gets away from where it did not come on, within bounds of time and distance."""
    FAULT = "fault"
    """Something must be looked at. Latches until it is acknowledged."""
    ESTOP = "estop"
    """Somebody pressed stop. Latches until it is acknowledged."""


LATCHED = frozenset({Mode.FAULT, Mode.ESTOP})
DRIVING = frozenset({Mode.RUNNING, Mode.RECOVERING})

TRANSITIONS: dict[Mode, frozenset[Mode]] = {
    Mode.INIT: frozenset({Mode.READY, Mode.FAULT, Mode.ESTOP}),
    Mode.READY: frozenset({Mode.INIT, Mode.ARMED, Mode.FAULT, Mode.ESTOP}),
    Mode.ARMED: frozenset({Mode.INIT, Mode.READY, Mode.RUNNING, Mode.FAULT, Mode.ESTOP}),
    Mode.RUNNING: frozenset({Mode.READY, Mode.HOLD, Mode.RECOVERING, Mode.FAULT, Mode.ESTOP}),
    Mode.HOLD: frozenset({Mode.READY, Mode.RUNNING, Mode.FAULT, Mode.ESTOP}),
    Mode.RECOVERING: frozenset({Mode.READY, Mode.RUNNING, Mode.HOLD, Mode.FAULT, Mode.ESTOP}),
    Mode.FAULT: frozenset({Mode.ESTOP}),
    Mode.ESTOP: frozenset(),
}
"""Out of FAULT and ESTOP leads only `Supervisor.acknowledge`, to INIT."""


REASONS = 5
"""That a latched mode tells at most; further ones are dropped."""


class InvalidTransition(RuntimeError):
    """A change of mode that the table does not allow."""


class Supervisor:
    """Holds the mode and lets it change only along `TRANSITIONS`."""

    def __init__(self, changed: Callable[[float, Mode, str], None] | None = None) -> None:
        """`changed(now, mode, why)` is called after every change."""
        self._changed = changed
        self.mode = Mode.INIT
        self.why = "started"
        """Why it is in this mode."""
        self.fault: str | None = None
        """Why it is in FAULT or ESTOP."""
        self._kinds: list[str] = []
        """Of the reasons in `fault`."""

    @property
    def driving(self) -> bool:
        """Whether the robot may be sent anything but the brake."""
        return self.mode in DRIVING

    @property
    def latched(self) -> bool:
        """Whether somebody must acknowledge before anything goes on."""
        return self.mode in LATCHED

    def change(self, mode: Mode, why: str, now: float) -> None:
        """Enter `mode`.

        Raises:
            InvalidTransition: not allowed from the present mode.
        """
        if mode not in TRANSITIONS[self.mode]:
            allowed = ", ".join(sorted(each.name for each in TRANSITIONS[self.mode])) or "none"
            raise InvalidTransition(f"{self.mode.name} -> {mode.name} ({why}); allowed: {allowed}")
        if mode in LATCHED:
            self.fault = why
            self._kinds = [_kind(why)]
        self._enter(mode, why, now)

    def fail(self, why: str, now: float) -> bool:
        """Enter FAULT from wherever that is possible; where one has latched already, another reason joins its own.

        Returns:
            Whether it has joined: reasons that differ in their numbers alone do so once, and REASONS of them at most.
        """
        if not self.latched:
            self.change(Mode.FAULT, why, now)
            return False
        kind = _kind(why)
        if kind in self._kinds or len(self._kinds) >= REASONS:
            return False
        self._kinds.append(kind)
        self.why = self.fault = f"{self.fault}; {why}"
        return True

    def stop(self, why: str, now: float) -> None:
        """Enter ESTOP from anywhere."""
        if self.mode is not Mode.ESTOP:
            self.change(Mode.ESTOP, why, now)

    def acknowledge(self, now: float) -> None:
        """Leave FAULT or ESTOP for INIT, on somebody's word that the cause is gone.

        Raises:
            InvalidTransition: nothing has latched.
        """
        if not self.latched:
            raise InvalidTransition(f"{self.mode.name}: there is no fault to acknowledge")
        self.fault = None
        self._enter(Mode.INIT, "acknowledged", now)

    def _enter(self, mode: Mode, why: str, now: float) -> None:
        self.mode, self.why = mode, why
        if self._changed is not None:
            self._changed(now, mode, why)


def _kind(why: str) -> str:
    return re.sub(r"[0-9.]+", "", why)
