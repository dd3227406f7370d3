"""Contenders of a race in processes, and if need be Pythons, of their own, that run when it is their turn.

The child says "ready", or "skip" and a reason; from then on it answers each line it reads, a number of seconds, with
what it counted in that time and the seconds it took.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Sequence

from race import timed


class Skipped(Exception):
    """A contender that cannot run here; the message says why."""


class Turns:
    """The parent's side: a contender for `race.race`.

    Raises:
        Skipped: the child cannot run.
    """

    def __init__(self, command: Sequence[str]) -> None:
        self._child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        # libraries print to the same stream
        lines = iter(self._child.stdout.readline, "")  # type: ignore[union-attr]
        answer = next((line.strip() for line in lines if line.startswith(("ready", "skip"))), "skip it ended")
        if answer != "ready":
            self.close()
            raise Skipped(answer.removeprefix("skip "))

    def __call__(self, seconds: float) -> tuple[int, float]:
        print(seconds, file=self._child.stdin, flush=True)
        count, spent = self._child.stdout.readline().split()  # type: ignore[union-attr]
        return int(count), float(spent)

    def close(self) -> None:
        self._child.stdin.close()  # type: ignore[union-attr]
        self._child.wait()


def take_turns(run: Callable[[], int]) -> None:
    """The child's side: call `run`, which counts what it does, for as long as is asked, until nobody asks any more."""
    print("ready", flush=True)
    for line in sys.stdin:
        print(*timed(run, float(line)), flush=True)
