"""Printing that is not held up for good by a terminal that was stopped, or by a pipe that nobody reads."""

from __future__ import annotations

import io
import os
import select
import stat
import sys
import time
from contextlib import suppress
from typing import Any, TextIO

PATIENCE = 1.0
"""Time that a reader is given to take something [s]."""


class PatientWriter(io.RawIOBase):
    """Writes to a descriptor whose reader may have stopped.

    What it does not take within `PATIENCE` is lost, and what follows too, until it takes something again. With
    `faithful` it is waited for without end, up to `hurry`.
    """

    hurried = lost = False
    """Whether the end was asked for, and whether anything was lost that should have been faithful."""

    def __init__(self, descriptor: int, faithful: bool) -> None:
        self._descriptor, self._faithful = descriptor, faithful
        self._target = _without_blocking(descriptor)
        self._deaf = self._gone = False

    def fileno(self) -> int:
        return self._descriptor

    def isatty(self) -> bool:
        return os.isatty(self._descriptor)

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        """All of it, or what the reader takes of it; OSError, once, where there is no reader any more."""
        rest = memoryview(data).cast("B")
        size = len(rest)
        while rest and not self._gone and self._has_room():
            try:
                rest = rest[os.write(self._target, rest) :]
            except BlockingIOError:  # there is less room than it takes
                time.sleep(0.01)
            except OSError:
                self._gone = True
                raise
        PatientWriter.lost |= self._faithful and len(rest) > 0 and not self._gone
        return size

    def _has_room(self) -> bool:
        began = None
        while not select.select([], [self._target], [], 0.0 if self._deaf else 0.05)[1]:
            if self._deaf:
                return False
            if not self._faithful or PatientWriter.hurried:
                began = began or time.monotonic()
                self._deaf = time.monotonic() - began > PATIENCE
        self._deaf = False
        return True


def be_patient() -> None:
    """Have this process print so: what is reported waits for its reader, what is complained about does not."""
    sys.stdout, sys.stderr = _patient(sys.stdout, True), _patient(sys.stderr, False)


def hurry() -> None:
    """The end was asked for: wait for no reader any more."""
    PatientWriter.hurried = True


def _patient(stream: TextIO, faithful: bool) -> TextIO:
    if not isinstance(stream, io.TextIOWrapper):  # it was closed before this process began
        return stream
    stream.flush()
    raw = io.BufferedWriter(PatientWriter(stream.fileno(), faithful))
    return io.TextIOWrapper(raw, stream.encoding, stream.errors, line_buffering=stream.line_buffering)


def _without_blocking(descriptor: int) -> int:
    """The same terminal or pipe, opened once more so that a write to it returns: others share the flags of the first.

    The descriptor itself where that cannot be, and for files, which have a place to be written at.
    """
    kind = os.fstat(descriptor).st_mode
    if stat.S_ISFIFO(kind) or stat.S_ISCHR(kind):
        with suppress(OSError):
            return os.open(f"/proc/self/fd/{descriptor}", os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY)
    return descriptor
