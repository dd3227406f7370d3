"""Starting a process that shares memory with this one, and telling it that there is news."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from hiernav.runtime.loop import STOP_SIGNALS, hear_signals

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
DYING = 0.5
"""Time for which a process that was killed is waited for [s]: while a call into the kernel lasts it does not end."""


class Child:
    """A Python process that runs a module of this package, of this process's kin and in a session of its own.

    A terminal's Ctrl-C does not reach it, and it leaves signals to this process (`leave_signals_to_parent`): it ends
    when its `news` pipe is closed, be it by `close` or because this process is gone. What it prints goes to stderr.
    """

    def __init__(
        self,
        module: str,
        arguments: Sequence[object] = (),
        descriptors: Sequence[int] = (),
        environment: Mapping[str, str] | None = None,
    ) -> None:
        """Run `python -P -m module NEWS ARGUMENT ...`; NEWS is the descriptor on which `nudge` arrives.

        -P: a file of the present folder that has the name of a module is not taken for it.
        """
        news, self._news = os.pipe()
        os.set_blocking(self._news, False)
        package = str(Path(__file__).resolve().parents[2])
        path = os.pathsep.join(filter(None, (package, os.environ.get("PYTHONPATH"))))
        try:
            self.process = subprocess.Popen(
                [sys.executable, "-P", "-m", module, str(news), *map(str, arguments)],
                stdin=subprocess.DEVNULL,
                pass_fds=(news, *descriptors),
                stdout=_stderr(),
                start_new_session=True,
                env={**os.environ, **ONE_THREAD, **(environment or {}), "PYTHONPATH": path},
            )
        except OSError:
            os.close(self._news)
            raise
        finally:
            os.close(news)
        self._dismissed = 0.0
        self._closed = False

    @property
    def ended(self) -> int | None:
        """Its exit status, negative for a signal; None while it lives."""
        return self.process.poll()

    def nudge(self, news: bytes = b"n") -> None:
        """Wake it. Never waits: where nobody has looked for long, one wake more or less is no matter."""
        if self._news >= 0:
            with suppress(BlockingIOError, BrokenPipeError):
                os.write(self._news, news)

    def dismiss(self) -> None:
        """Have it end by itself, and do not wait for it: `close` does, and is to follow."""
        if self._news >= 0:
            os.close(self._news)
            self._news, self._dismissed = -1, time.monotonic()

    def close(self, patience: float = 2.0, family: bool = False) -> bool:
        """Have it end by itself, or kill it `patience` [s] after that was asked for first.

        Args:
            patience: of `dismiss`, or of this call where there was none before.
            family: end what it has started and left behind as well.

        Returns:
            Whether it has ended by itself.
        """
        if self._closed:
            return True
        self.dismiss()
        self._closed = ended = True
        try:
            self.process.wait(max(self._dismissed + patience - time.monotonic(), 0.0))
        except subprocess.TimeoutExpired:
            ended = False
            self.process.kill()
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(DYING)
        if family:
            with suppress(ProcessLookupError, PermissionError):  # nobody of its session is left
                os.killpg(self.process.pid, signal.SIGKILL)
        return ended


def _stderr() -> int:
    """Where a child prints, as this process's own output may be read by a program; nowhere where there is no stderr."""
    return subprocess.DEVNULL if sys.__stderr__ is None else 2  # whose number another file may have by now


def leave_signals_to_parent() -> None:
    """In the child: `STOP_SIGNALS`, which may be sent to all processes at once, are for the parent to act upon."""
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    hear_signals()  # of its own children's ends


def wait_for_news(news: int, timeout: float | None) -> bytes | None:
    """In the child: what `nudge` wrote since the last call; b"" after `timeout` [s], None when the parent is gone."""
    if not select.select([news], [], [], timeout)[0]:
        return b""
    return os.read(news, 4096) or None
