"""Contenders of a race in processes, and if need be Pythons, of their own, that run when it is their turn.

The child says "ready", or "skip" and a reason; from then on it answers each line it reads, a number of seconds, with
"did", what it counted in that time and the seconds it took. Whatever else it prints is its libraries' talk.
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
        self._command = " ".join(command)
        try:
            self._child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        except OSError as error:
            raise Skipped(f"{command[0]}: {error.strerror}") from None
        answer = self._answer("ready", "skip")
        if answer != ["ready"]:
            self.close()
            raise Skipped(" ".join(answer[1:]) or "it ended")

    def __call__(self, seconds: float) -> tuple[int, float]:
        try:
            print(seconds, file=self._child.stdin, flush=True)
        except BrokenPipeError:
            pass
        answer = self._answer("did")
        if not answer:
            raise RuntimeError(f"{self._command} has ended with code {self._child.wait()}")
        return int(answer[1]), float(answer[2])

    def close(self) -> None:
        self._child.communicate()

    def _answer(self, *words: str) -> list[str]:
        """The next line that begins with one of those words, in words; empty if the child has ended."""
        lines = (line.split() for line in iter(self._child.stdout.readline, ""))  # type: ignore[union-attr]
        return next((line for line in lines if line and line[0] in words), [])


def take_turns(run: Callable[[], int]) -> None:
    """The child's side: call `run`, which counts what it does, for as long as is asked, until nobody asks any more."""
    print("ready", flush=True)
    for line in sys.stdin:
        print("did", *timed(run, float(line)), flush=True)
