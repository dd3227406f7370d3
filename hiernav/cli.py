"""The `hiernav` command.

Exit codes: 0 done; 1 training diverged, processes died, a replay differs, or a result is damaged; 2 bad input, with one
line that says what to do; 130 interrupted; 141 nobody reads the output any more; 143 interrupted by SIGTERM.
"""

from __future__ import annotations

import argparse
import os
import select
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

from hiernav.commands import config, dataset, evaluate, export, replay, report, train, watch, world
from hiernav.commands.exits import BAD_INPUT, FAILED, UNREAD, Terminated, interruption
from hiernav.run import TrainingDiverged, WorkersLost

COMMANDS = (train, evaluate, watch, export, replay, dataset, report, world, config)
"""In the order of `hiernav --help`."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line; returns the exit code."""
    parser = _parser()
    arguments, more = parser.parse_known_args(argv)
    if more:
        if "overrides" not in arguments or any(text.startswith("-") for text in more):
            arguments.parser.error(f"unrecognized arguments: {' '.join(more)}")
        arguments.overrides += more  # argparse itself takes one group of KEY=VALUE, but no second one after an option
    try:
        with _sigterm_as_ctrl_c():
            code = arguments.run(arguments) or 0
            sys.stdout.flush()  # here, where a pipe that nobody reads can still be told from all else
            return code
    except KeyboardInterrupt as error:
        print("interrupted", file=sys.stderr)
        return interruption(error)
    except (ValueError, OSError) as error:
        if isinstance(error, BrokenPipeError) and _reader_is_gone():
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes once more as it ends
            return UNREAD
        print(f"hiernav {arguments.command}: {_one_line(error)}", file=sys.stderr)
        return BAD_INPUT
    except (TrainingDiverged, WorkersLost) as error:
        print(f"hiernav {arguments.command}: {_one_line(error)}", file=sys.stderr)
        return FAILED
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("hiernav"):
            raise
        extra = "ray" if error.name == "ray" else "train"
        how = f"`pip install -e '.[{extra}]'` in the checkout installs it"
        print(f"hiernav {arguments.command}: needs {error.name}: {how}", file=sys.stderr)
        return BAD_INPUT


def _parser() -> argparse.ArgumentParser:
    from hiernav import __version__

    parser = argparse.ArgumentParser(
        prog="hiernav", description="Plan with a waypoint network, move with a learned skill, deploy without torch."
    )
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in COMMANDS:
        command.add(commands)
    return parser


@contextmanager
def _sigterm_as_ctrl_c() -> Iterator[None]:
    """Raise `Terminated` where SIGTERM arrives, so that nothing is left half done; in the main thread alone."""
    before = signal.getsignal(signal.SIGTERM)
    if threading.current_thread() is not threading.main_thread() or before not in (
        signal.SIG_DFL,
        signal.default_int_handler,
    ):
        yield  # whoever ignores or handles it already has a reason
        return
    owner = os.getpid()

    def stop(number: int, _frame: FrameType | None) -> None:
        if os.getpid() != owner:  # a fork of this process, such as a worker: it ends as if it had no handler
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
        raise Terminated

    signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _reader_is_gone() -> bool:
    """Whether the standard output is a pipe or socket that nobody reads any more."""
    poll = select.poll()
    try:
        poll.register(sys.stdout.fileno(), 0)
    except (OSError, ValueError):
        return False
    return any(state & (select.POLLERR | select.POLLHUP) for _, state in poll.poll(0))


def _one_line(error: Exception) -> str:
    text = str(error)
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        text = f"{error.filename}: {error.strerror}"
    return " ".join(text.split()) or type(error).__name__


if __name__ == "__main__":
    sys.exit(main())
