"""What became of a command to a running loop: the loop writes it, whoever gave the command reads it."""

from __future__ import annotations

from dataclasses import dataclass

from hiernav.runtime.trip import Trip


@dataclass
class Ticket:
    """What became of one command: it waits until it is taken, at the beginning of a tick, or dropped."""

    taken: int | None = None
    """The tick (`FixedRateLoop.ticks`) that took it; what it does is done when that tick ends."""
    refused: str | None = None
    """Why a goal is not driven to, in one word: one of `trip.REFUSALS`, or how else it ended within its tick."""
    why: str = ""
    """What there is to add to that; or why the command was dropped."""
    dropped: bool = False
    """Whether it will never be taken."""
    trip: Trip | None = None
    """The drive to a goal that was taken."""

    def drop(self, why: str) -> None:
        self.why, self.dropped = why, True

    def refuse(self, reason: str, why: str) -> None:
        self.refused, self.why = reason, why

    def settled(self, ticks: int) -> bool:
        """Whether it was taken and all is known of it, at a number of ticks that have begun."""
        if self.taken is None or ticks <= self.taken:
            return False
        trip = self.trip
        if trip is not None and trip.reason not in (None, "goal"):
            self.refuse(str(trip.reason), trip.detail)
        return True
