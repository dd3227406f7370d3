"""Printing that is not held up for good by a terminal that was stopped, or by a pipe that nobody reads."""

from __future__ import annotations

import errno
import io
import os
import select
import stat
import sys
import time
from contextlib import suppress
from typing import Any, TextIO

PATIENCE, BRIEFLY = 1.0, 0.2
"""Time that a reader is given to take something: of a report, once the end was asked for, and of a complaint [s]."""
NOBODY = (errno.EPIPE, errno.EIO, errno.ENXIO, errno.ECONNRESET)
"""What writing to a pipe, a terminal or a socket says once nobody reads there any more."""


class PatientWriter(io.RawIOBase):
    """Writes to a descriptor whose reader may have stopped.

    Where nothing is taken for `BRIEFLY`, the rest is lost, and what follows too, until something is taken again. With
    `faithful` it is waited for without end, up to `hurry`, and from then on for `PATIENCE`.
    """

    hurried = lost = False
    """Whether the end was asked for, and whether anything was lost that should have been faithful."""
    why = ""
    """What the system said when it was, if anything: a full disk."""

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
        size, since = len(rest), None
        while rest and not self._gone:
            taken = self._offer(rest)
            rest = rest[taken:]
            if taken:
                self._deaf, since = False, None
            elif self._deaf:
                break
            elif not self._faithful or PatientWriter.hurried:
                since = since or time.monotonic()
                self._deaf = time.monotonic() - since > (PATIENCE if self._faithful else BRIEFLY)
        PatientWriter.lost |= self._faithful and len(rest) > 0 and not self._gone
        return size

    def _offer(self, data: memoryview) -> int:
        """How much of it is taken within a moment.

        No more is offered than what can be written without waiting to any pipe or socket that has room, whether it
        could be opened anew or not.
        """
        moment = 0.0 if self._deaf else 0.02
        if not select.select([], [self._target], [], moment)[1]:
            return 0
        try:
            return os.write(self._target, data[: select.PIPE_BUF])
        except BlockingIOError:  # there is room, but less than it takes
            time.sleep(moment)
            return 0
        except OSError as error:
            self._gone = True
            if self._faithful and error.errno not in NOBODY:
                PatientWriter.lost, PatientWriter.why = True, error.strerror or str(error)
            raise


def be_patient(reports: bool = True) -> None:
    """Have this process print so: what is reported waits for its reader, what is complained about does not.

    Args:
        reports: whether the standard output is for reports; else it is for complaints as well.
    """
    _occupy_standard_descriptors()
    sys.stdout, sys.stderr = _patient(sys.stdout, reports), _patient(sys.stderr, False)


def _occupy_standard_descriptors() -> None:
    """Where standard input, output or error were closed before this process began, put nowhere in their places.

    Else the next file or pipe that is opened gets that number, and is what a library's complaint is written into, and
    what a child is given as its own.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # which takes the lowest number that is free: this one


def hurry() -> None:
    """The end was asked for: wait for no reader any more."""
    PatientWriter.hurried = True


def _patient(stream: TextIO, faithful: bool) -> TextIO:
    if not isinstance(stream, io.TextIOWrapper):  # it was closed before this process began
        return stream
    stream.flush()
    raw = io.BufferedWriter(PatientWriter(stream.fileno(), faithful))
    at_once = stream.line_buffering or stream.write_through  # the latter alone under PYTHONUNBUFFERED
    # what a terminal of few characters cannot show is no reason to end a run
    errors = "backslashreplace" if stream.errors == "strict" else stream.errors
    return io.TextIOWrapper(raw, stream.encoding, errors, line_buffering=at_once)


def _without_blocking(descriptor: int) -> int:
    """The same terminal or pipe, opened once more so that a write to it returns: others share the flags of the first.

    The descriptor itself where that cannot be, and for files, which have a place to be written at.
    """
    kind = os.fstat(descriptor).st_mode
    if stat.S_ISFIFO(kind) or stat.S_ISCHR(kind):
        with suppress(OSError):
            return os.open(f"/proc/self/fd/{descriptor}", os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY)
    return descriptor
