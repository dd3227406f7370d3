"""The queue on screen: a table of its cells, and bars for the whole and for the cell that runs."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table

from hiernav.reproduce.cells import Cell
from hiernav.reproduce.experiments import EXPERIMENTS
from hiernav.reproduce.queue import Entry, Estimates, Tally, Watcher, duration
from hiernav.reproduce.results import Result

_LINE_SECONDS = 60.0
"""Between two lines where there is no terminal for bars."""
_COLORS = {"done": "green", "failed": "red", "damaged": "red", "changed": "yellow", "open": "default"}


def cells_as_json(entries: Sequence[Entry], estimate: Estimates) -> list[dict[str, Any]]:
    """One object a cell."""
    return [
        {
            "cell": entry.cell.id,
            "state": entry.state,
            "estimate_s": round(estimate(entry.cell), 1),
            "took_s": entry.result.seconds if entry.result is not None else None,
            "needs": list(entry.cell.needs),
            "command": entry.cell.command,
            "error": entry.error,
        }
        for entry in entries
    ]


def print_cells(console: Console, entries: Sequence[Entry], estimate: Estimates) -> None:
    """Every cell with its state, and what is left in all."""
    table = Table(box=None, pad_edge=False)
    for column in ("cell", "state", "takes", "note"):
        table.add_column(column, justify="right" if column == "takes" else "left", no_wrap=column != "note")
    for entry in entries:
        took = entry.result.seconds if entry.state in ("done", "failed") and entry.result else estimate(entry.cell)
        note = entry.error or ("of other settings, another bundle or training" if entry.state == "changed" else "")
        color = _COLORS[entry.state]
        table.add_row(entry.cell.id, f"[{color}]{entry.state}[/]", duration(took), escape(note))
    console.print(table)
    for name, what in EXPERIMENTS.items():
        mine = [entry for entry in entries if entry.cell.experiment == name]
        if mine:
            done = sum(entry.state == "done" for entry in mine)
            left = sum(estimate(entry.cell) for entry in mine if not entry.settled)
            console.print(
                f"{name}: {done} of {len(mine)} done, {duration(left)} left   [dim]{what}[/]", highlight=False
            )


class Bars(Watcher):
    """Bars on a terminal; a line when a cell begins and ends."""

    def __init__(self, console: Console, cells: Sequence[Cell], estimate: Estimates) -> None:
        self._estimate, self._waiting = estimate, list(cells)
        self._count, self._number = len(cells), 0
        self._share = 0.0
        self.bars = Progress(
            TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:>3.0f} %"),
            TextColumn("{task.fields[note]}"), console=console,
        )  # fmt: skip
        self._whole = self.bars.add_task("queue", total=1.0, note="")
        self._one = self.bars.add_task("", total=1.0, note="", visible=False)
        self._spent = 0.0
        self._printed = time.monotonic()

    def began(self, cell: Cell, seconds: float) -> None:
        self._number += 1
        self._share = 0.0
        self._print(f"[{self._number} of {self._count}] {cell.id}, about {duration(seconds)}")
        self.bars.update(self._one, description=cell.name, completed=0.0, note="", visible=True)
        self._show(cell)

    def progress(self, cell: Cell, share: float, what: str) -> None:
        self._share = min(max(share, 0.0), 1.0)
        self.bars.update(self._one, completed=self._share, note=what)
        self._show(cell)
        if not self.bars.console.is_terminal and time.monotonic() - self._printed > _LINE_SECONDS:
            whole = self.bars.tasks[self._whole].fields["note"]
            self._print(f"    {100 * self._share:.0f} % of {cell.id}: {what}; {whole}")

    def ended(self, cell: Cell, result: Result | None, why: str | None) -> None:
        if cell in self._waiting:
            self._waiting.remove(cell)
        if result is None:
            self._number += why is not None and self._share == 0.0
            self._print(f"    {cell.id}: not run: {why}")
        elif result.error is not None:
            self._print(f"    failed after {duration(result.seconds)}: {result.error}")
        else:
            self._spent += self._estimate(cell)
            self._print(f"    {_line(result)}{duration(result.seconds)}")
        self._share = 0.0
        self._show(None)

    def _show(self, cell: Cell | None) -> None:
        """The whole queue in seconds of the estimate, and how much of it is left."""
        total = sum(self._estimate(each) for each in self._waiting)
        now = self._share * self._estimate(cell) if cell is not None else 0.0
        self.bars.update(
            self._whole, total=self._spent + total or 1.0, completed=self._spent + now,
            note=f"{len(self._waiting)} cells, {duration(total - now)} left",
        )  # fmt: skip

    def _print(self, text: str) -> None:
        self._printed = time.monotonic()
        self.bars.console.print(escape(text), highlight=False, soft_wrap=True)


def print_tally(console: Console, tally: Tally) -> None:
    """How a run of the queue ended."""
    for cell, error in tally.failed.items():
        console.print(f"failed: {cell}: {escape(error)}", style="red", highlight=False, soft_wrap=True)
    console.print(f"{len(tally.done)} done, {len(tally.failed)} failed, {len(tally.skipped)} not run", highlight=False)
    if tally.stopped:
        console.print("stopped; the same command goes on")


def _line(result: Result) -> str:
    metrics = result.metrics.get("strict") or result.metrics
    parts = [("reach", "reach_rate", ".3f"), ("steps", "steps_mean", ".1f"), ("collisions", "collisions_mean", ".2f")]
    return "".join(f"{name} {metrics[key]:{form}}  " for name, key, form in parts if metrics.get(key) is not None)
