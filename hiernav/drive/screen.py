"""What a run shows and saves, whatever becomes of terminal and disk."""

from __future__ import annotations

import argparse
import errno
import os
import resource
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

from rich.console import Console

from hiernav.files import write_json

ROOM = 1 << 16
"""Bytes that a file may need at least: an empty one fits onto a full disk."""
PACKAGE = str(Path(__file__).parents[1])
LIMITS = {errno.EMFILE: "RLIMIT_NOFILE", errno.EAGAIN: "RLIMIT_NPROC", errno.EFBIG: "RLIMIT_FSIZE"}
"""Of this process, by what the system says where they are met."""


def screen(arguments: argparse.Namespace) -> Console:
    """Where people read; the standard output is for JSON alone where --json - asks for it."""
    return Console(stderr=arguments.json == "-")


def show(what: Callable[[], object], stream: IO[str]) -> None:
    """Show something on `stream`. A terminal or a pipe that is closed must not cost what comes after it."""
    try:
        what()
    except (OSError, SystemExit):  # the latter is what rich makes of a broken pipe
        with suppress(OSError), open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), stream.fileno())  # for what is still in its buffer


def complain(text: str) -> None:
    show(lambda: print(f"run_loop: {text}", file=sys.stderr, flush=True), sys.stderr)


def in_one_line(error: BaseException) -> str:
    """What is wrong; where the system has refused something without a name, also the limit that was met, and where."""
    text = " ".join(str(error).split())
    number = error.errno if isinstance(error, OSError) else None
    limit = LIMITS.get(number or 0)
    if isinstance(error, MemoryError):
        text, limit = f"no memory is left{': ' if text else ''}{text}", "RLIMIT_AS"
    elif isinstance(error, RuntimeError) and "start new thread" in text:
        limit = "RLIMIT_NPROC"
    if limit is None:
        return text
    value = resource.getrlimit(getattr(resource, limit))[0]
    text += f" ({limit} is {'unlimited' if value == resource.RLIM_INFINITY else value})"
    frames = [each for each in traceback.extract_tb(error.__traceback__) if each.filename.startswith(PACKAGE)]
    return f"{text}, at {Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else text


def new_folder(parent: Path, name: str) -> Path:
    """Make a folder that no other run has: two may begin in the same second."""
    parent.mkdir(parents=True, exist_ok=True)
    number = 1
    while True:
        folder = parent / (name if number == 1 else f"{name}-{number}")
        with suppress(FileExistsError):
            folder.mkdir()
            return folder
        number += 1


def require_writable(file: Path, option: str) -> None:
    """Make the folder of a file that is to be written later, and see that it, and its disk, can be written to.

    Raises:
        ValueError: it cannot.
    """
    try:
        if file.is_dir():
            raise IsADirectoryError(f"{file} is a folder")
        file.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=file.parent) as trial:
            trial.write(bytes(ROOM))
            trial.flush()
    except OSError as error:
        raise ValueError(f"{option}: {file} cannot be written: {error.strerror or error}") from None


def save(file: Path, values: Any) -> None:
    """Write JSON so that nobody ever sees half of it; where that fails, say so and go on."""
    try:
        write_json(file, values)
    except OSError as error:
        warn(file, error)


def warn(file: Path, error: Exception) -> None:
    complain(f"{file} is not written: {getattr(error, 'strerror', None) or in_one_line(error)}")
