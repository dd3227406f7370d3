"""What the commands share of the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress


@contextmanager
def progress_bars() -> Iterator[Progress]:
    """A bar for each task, on stderr, with its rate in the task's field `note`."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    progress = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(compact=True, elapsed_when_finished=False),
        TextColumn("{task.fields[note]}"),
        console=screen(stderr=True),
    )
    with progress:
        try:
            yield progress
        except (ValueError, OSError):
            # bad input: the error is all there is to see
            progress.live.transient = True
            progress.console.quiet = not progress.console.is_interactive
            raise


def screen(stderr: bool = False, piped_width: int = 120) -> Console:
    """As wide as the terminal, or as `piped_width` columns where there is none."""
    from rich.console import Console

    class Screen(Console):
        def on_broken_pipe(self) -> None:
            raise  # called while BrokenPipeError is handled: rich itself would exit with code 1

    console = Screen(stderr=stderr)
    if not console.is_terminal:
        console.width = piped_width
    return console
