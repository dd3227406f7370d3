"""A cell in a process of its own: one that crashes, or runs out of memory, is one failed cell and not the end."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import traceback
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType

from hiernav.git import Code
from hiernav.orphans import end_with_parent
from hiernav.reproduce.cells import Cell, Places
from hiernav.reproduce.work import Outcome, Report, run_cell

_PATIENCE = 20.0
"""For a process that was asked to stop [s]; after that it is killed, which a training survives."""


class CellFailed(RuntimeError):
    """The work of a cell did not succeed; the message is for its result file."""


def log_path(places: Places, cell: Cell) -> Path:
    """What a cell prints."""
    return places.runs / "logs" / f"{cell.experiment}-{cell.name}.log"


def run_in_process(cell: Cell, places: Places, report: Report, code: Code) -> Outcome:
    """Do a cell's work in another process, which is told what `code` it runs.

    Raises:
        CellFailed: the work raised an error, or its process died.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])  # loaded once, for all cells
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_main, args=(cell, places, code, theirs), name=cell.id)
    process.start()
    theirs.close()
    try:
        while True:
            try:
                message = ours.recv()
            except EOFError:
                process.join()
                raise CellFailed(_death(process.exitcode, log_path(places, cell))) from None
            if message[0] == "report":
                report(message[1], message[2])
            elif message[0] == "failed":
                raise CellFailed(message[1])
            else:
                return message[1]
    finally:
        ours.close()
        process.join(_PATIENCE if sys.exc_info()[0] is None else 0.0)
        if process.is_alive():
            process.terminate()
            process.join(_PATIENCE)
        if process.is_alive():
            process.kill()
            process.join()


def _main(cell: Cell, places: Places, code: Code, parent: Connection) -> None:
    signal.signal(signal.SIGTERM, _stop)
    end_with_parent()  # a queue that was killed leaves no process behind that writes to its folders
    log = log_path(places, cell)
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)

    def report(share: float, what: str) -> None:
        parent.send(("report", share, what))

    try:
        parent.send(("done", run_cell(cell, places, report, code)))
    except KeyboardInterrupt:
        pass
    except BrokenPipeError:
        pass  # nobody waits any more
    except Exception as error:
        traceback.print_exc()
        frame = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(frame.filename).name}:{frame.lineno}"
        parent.send(("failed", f"{type(error).__name__}: {' '.join(str(error).split())} ({where})"))


def _stop(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _death(code: int | None, log: Path) -> str:
    if code is not None and code < 0:
        hint = ", perhaps for want of memory" if -code == signal.SIGKILL else ""
        return f"its process was ended by {signal.Signals(-code).name}{hint}; what it printed is in {log}"
    return f"its process ended with code {code}; what it printed is in {log}"
