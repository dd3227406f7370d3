"""How a command ends."""

from __future__ import annotations

FAILED, BAD_INPUT, INTERRUPTED, UNREAD, TERMINATED = 1, 2, 130, 141, 143


class Terminated(KeyboardInterrupt):
    """SIGTERM arrived, as from systemd, Slurm, Docker or `timeout`: all that Ctrl-C does is to happen."""


def interruption(error: KeyboardInterrupt) -> int:
    return TERMINATED if isinstance(error, Terminated) else INTERRUPTED
