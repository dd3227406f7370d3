"""What a running loop was asked for, from any thread: it is done at the beginning of the loop's next tick."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from hiernav.runtime.ticket import Ticket

LIMIT = 16
"""Requests that wait for one tick; of more, the oldest are dropped. An emergency stop is not among them."""


class Requests:
    """Waiting requests, and emergency stops, which no other request can push out."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[Ticket, Callable[[float], None]]] = deque()
        self._stops: deque[Ticket] = deque()
        self._why_stop: str | None = None

    def __len__(self) -> int:
        """How many wait, emergency stops aside."""
        return len(self._waiting)

    def add(self, request: Callable[[float], None], ticket: Ticket | None = None) -> Ticket:
        """Have `request(now)` called at the beginning of the next tick."""
        ticket = ticket or Ticket()
        while len(self._waiting) >= LIMIT:
            self._drop_oldest(f"more than {LIMIT} commands came within one tick")
        self._waiting.append((ticket, request))
        return ticket

    def add_stop(self, why: str) -> Ticket:
        """Ask for an emergency stop; of several, the newest reason counts."""
        ticket = Ticket()
        self._stops.append(ticket)
        self._why_stop = why
        return ticket

    def take(self, now: float, tick: int, stop: Callable[[str, float], None]) -> None:
        """Do all that was asked for, and then `stop(why, now)` if that was.

        Args:
            now: on the loop's clock [s].
            tick: number of the present tick, for the tickets.
            stop: makes an emergency stop.
        """
        for _ in range(len(self._waiting)):
            try:
                ticket, request = self._waiting.popleft()
            except IndexError:  # somebody else has just dropped it for a newer one
                break
            request(now)
            ticket.taken = tick
        if self._why_stop is not None:
            stop(self._why_stop, now)
            self._why_stop = None
            while self._stops:
                self._stops.popleft().taken = tick

    def drop_all(self, why: str) -> None:
        """Do nothing of what waits; an emergency stop is kept."""
        while self._waiting:
            self._drop_oldest(why)

    def _drop_oldest(self, why: str) -> None:
        try:
            self._waiting.popleft()[0].drop(why)
        except IndexError:  # the loop has just taken them
            pass
