"""What a run shows and saves, whatever becomes of terminal and disk."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

from rich.console import Console


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
    """Make the folder of a file that is to be written later, and see that it can be written to.

    Raises:
        ValueError: it cannot.
    """
    try:
        if file.is_dir():
            raise IsADirectoryError(f"{file} is a folder")
        file.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=file.parent):
            pass
    except OSError as error:
        raise ValueError(f"{option}: {file} cannot be written: {error.strerror or error}") from None


def save(file: Path, values: Any) -> None:
    """Write JSON so that nobody ever sees half of it; where that fails, say so and go on."""
    from hiernav.files import write_json  # not needed before, and the robot need not wait for it

    try:
        write_json(file, values)
    except OSError as error:
        warn(file, error)


def warn(file: Path, error: OSError) -> None:
    complain(f"{file} is not written: {error.strerror or error}")
