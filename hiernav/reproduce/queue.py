"""The queue: what is done, what is left, how long it will take, and running it."""

from __future__ import annotations

import fnmatch
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal

import msgspec

from hiernav.git import Code, code_differs, git_state
from hiernav.lock import try_lock
from hiernav.reproduce.cells import TRAINING, Cell, Places, cell_key, training_hash
from hiernav.reproduce.child import CellFailed
from hiernav.reproduce.experiments import EXPERIMENTS
from hiernav.reproduce.results import (
    Machine,
    Result,
    ResultError,
    read_result,
    this_machine,
    write_result,
)
from hiernav.reproduce.work import Outcome, Report, is_trained_here, trained_seconds
from hiernav.run import RunError

State = Literal["open", "done", "failed", "changed", "damaged"]
"""`changed`: there is a result, of other settings, another bundle or another training, and the cell is run again."""
Execute = Callable[[Cell, Places, Report, Code], Outcome]


@dataclass(frozen=True)
class Entry:
    """A cell as it stands."""

    cell: Cell
    state: State
    result: Result | None = None
    error: str | None = None

    @property
    def settled(self) -> bool:
        """Whether there is nothing to do, unless failed cells are tried again."""
        return self.state in ("done", "failed", "damaged")


@dataclass
class Tally:
    """What a run of the queue came to, by cell id."""

    done: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    """Cells that were not started, and why."""
    stopped: bool = False


class Watcher:
    """Sees a queue run; this one looks away."""

    def began(self, cell: Cell, seconds: float) -> None: ...

    def progress(self, cell: Cell, share: float, what: str) -> None: ...

    def ended(self, cell: Cell, result: Result | None, why: str | None) -> None: ...


def select(cells: Sequence[Cell], only: Sequence[str] = (), training: bool = True) -> list[Cell]:
    """Cells of some experiments, and all that they need, in order.

    Args:
        only: experiments, cells as experiment/name, or patterns of either; everything by default.
        training: whether cells that train, or need a training, are among them.

    Raises:
        ValueError: a name fits no cell.
    """
    known = {cell.id: cell for cell in cells}
    wanted = set() if only else set(known)
    for pattern in only:
        full = pattern if "/" in pattern else f"{pattern}/*"
        found = set(fnmatch.filter(known, full))
        if not found:
            raise ValueError(f"no cell fits {pattern!r}; experiments: {', '.join(EXPERIMENTS)}; --list has all cells")
        wanted |= found
    needed = set[str]()
    while wanted - needed:
        needed |= wanted
        wanted = {need for name in needed for need in known[name].needs if need in known} | needed
    trained = set[str]()
    for cell in cells:  # what is needed comes first
        if cell.kind in TRAINING or trained.intersection(cell.needs):
            trained.add(cell.id)
    return [cell for cell in cells if cell.id in needed and (training or cell.id not in trained)]


def look_up(cell: Cell, places: Places) -> Entry:
    """How a cell stands."""
    try:
        result = read_result(places.results, cell.id)
    except ResultError as error:
        return Entry(cell, "damaged", error=str(error))
    if result is None:
        return Entry(cell, "open")
    if result.key != cell_key(cell, places):
        return Entry(cell, "changed", result)
    drove, trained = result.source.get("trained"), training_hash(cell, places)
    if drove is not None and trained is not None and drove != trained:
        return Entry(cell, "changed", result)
    film = result.metrics.get("file")
    if film and not (places.results / "films" / film).exists():
        return Entry(cell, "open")
    return Entry(cell, result.state, result, result.error)


class Estimates:
    """Durations of cells, corrected by how long others of their kind took on this machine."""

    def __init__(self, entries: Sequence[Entry], machine: Machine, places: Places) -> None:
        self._expected, self._taken = defaultdict[str, float](float), defaultdict[str, float](float)
        for entry in entries:
            result = entry.result
            if result is None or entry.state != "done":
                continue
            spent = _spent(entry.cell, places)
            here = (result.machine.cpu, result.machine.cores) == (machine.cpu, machine.cores)
            # one that took less than its training did counts the last process of several alone
            if here and spent is not None and result.seconds >= spent:
                self.learn(entry.cell, result.seconds)

    def learn(self, cell: Cell, seconds: float) -> None:
        self._expected[cell.kind] += cell.seconds
        self._taken[cell.kind] += seconds

    def __call__(self, cell: Cell) -> float:
        """Seconds that a cell will take."""
        expected = self._expected[cell.kind]
        return cell.seconds * (self._taken[cell.kind] / expected if expected else 1.0)


class Queue:
    """Cells in order; `run` does those that are left.

    Args:
        execute: does a cell's work; see `hiernav.reproduce.child.run_in_process`.
    """

    def __init__(self, cells: Sequence[Cell], places: Places, execute: Execute) -> None:
        self.cells, self.places = list(cells), places
        self._execute = execute
        self._machine = this_machine()
        self._commit, self._dirty = self._git_state()
        self.estimate = Estimates(self.entries(), self._machine, places)

    def entries(self) -> list[Entry]:
        """Every cell as it stands."""
        return [look_up(cell, self.places) for cell in self.cells]

    def left(self, retry: bool = False) -> list[Cell]:
        """Cells that a run would start, those included that wait for others."""
        return [entry.cell for entry in self._unsettled(retry)]

    def _unsettled(self, retry: bool) -> list[Entry]:
        return [entry for entry in self.entries() if not entry.settled or (retry and entry.state != "done")]

    def run(self, budget: float | None = None, retry: bool = False, watcher: Watcher | None = None) -> Tally:
        """Run what is left. Stopping it at any time, with Ctrl-C or SIGTERM, loses an evaluation at most.

        Args:
            budget: seconds; no cell is started whose estimate, less what its training has taken before, does not fit
                into what is left of them.
            retry: whether to run failed cells again, and those whose result file is damaged.
        """
        watcher, tally = watcher or Watcher(), Tally()
        began = time.monotonic()
        if not retry:
            for entry in self.entries():
                if entry.state in ("failed", "damaged"):
                    tally.failed[entry.cell.id] = f"{entry.error} (before; --retry-failed runs it again)"
        try:
            for before in self._unsettled(retry):
                cell = before.cell
                why = self._why_not(cell, None if budget is None else budget - (time.monotonic() - began))
                if why is None:
                    with _claimed(cell, self.places) as mine:
                        if not mine:
                            why = "another queue runs it"
                        elif (now := look_up(cell, self.places)).settled and now != before:
                            why = f"another queue has run it: {now.state}"
                        else:
                            self._run(cell, watcher, tally)
                if why is not None:
                    tally.skipped[cell.id] = why
                    watcher.ended(cell, None, why)
        except KeyboardInterrupt:
            tally.stopped = True
        return tally

    def _run(self, cell: Cell, watcher: Watcher, tally: Tally) -> None:
        key, started, began = cell_key(cell, self.places), time.strftime("%Y-%m-%dT%H:%M:%S%z"), time.monotonic()
        trained_before, code = _spent(cell, self.places) or 0.0, self._code()
        watcher.began(cell, self.estimate(cell))
        outcome, error = Outcome({}, {}, dict(cell.settings)), None
        try:
            outcome = self._execute(cell, self.places, lambda share, what: watcher.progress(cell, share, what), code)
        except CellFailed as failure:
            error = str(failure)
        seconds = trained_before + time.monotonic() - began
        if cell_key(cell, self.places) != key:
            tally.skipped[cell.id] = why = "its bundle was replaced meanwhile: run it again"
            watcher.ended(cell, None, why)
            return
        result = Result(
            experiment=cell.experiment,
            cell=cell.name,
            state="done" if error is None else "failed",
            key=key,
            robot=cell.robot,
            variant=cell.variant,
            seed=cell.seed,
            world=cell.world,
            command=cell.command,
            settings=outcome.settings,
            source=outcome.source,
            commit=code[0],
            dirty=code[1],
            started=started,
            seconds=round(seconds, 1),
            machine=msgspec.structs.replace(self._machine, gpu=outcome.gpu),
            metrics=outcome.metrics,
            curves=outcome.curves,
            error=error,
        )
        write_result(self.places.results, result)
        if error is None:
            self.estimate.learn(cell, seconds)
            tally.done.append(cell.id)
        else:
            tally.failed[cell.id] = error
        watcher.ended(cell, result, None)

    def _code(self) -> Code:
        """Commit of a cell that starts now, and whether it runs other code: what drives was loaded with the queue, what
        trains is read when a cell starts."""
        commit, dirty = self._git_state()
        if commit is None or self._commit is None:
            return commit, dirty
        return commit, dirty or self._dirty or code_differs(self.places.root, self._commit, commit)

    def _git_state(self) -> Code:
        """Of the repository, results apart: they change while the queue runs."""
        return git_state(self.places.root, (self.places.root / "results", self.places.results))

    def _why_not(self, cell: Cell, left: float | None) -> str | None:
        """Why a cell cannot be started, if so."""
        known = {each.id: each for each in self.cells}
        for need in cell.needs:
            if need not in known:
                continue
            if (state := look_up(known[need], self.places).state) != "done":
                return f"needs {need}, which is {state}"
            if cell.run is not None and known[need].run == cell.run and not is_trained_here(known[need], self.places):
                return (
                    f"needs {need}, which was trained elsewhere: copy its run folder to {self.places.runs / cell.run}, "
                    "or remove its result, so that it is trained here"
                )
        if left is None:
            return None
        ahead = max(self.estimate(cell) - (_spent(cell, self.places) or 0.0), 0.0)
        return f"takes about {duration(ahead)}, and {duration(max(left, 0.0))} are left" if ahead > left else None


def _spent(cell: Cell, places: Places) -> float | None:
    """Seconds that a cell's training has taken so far; None where its run folder is damaged."""
    try:
        return trained_seconds(cell, places)
    except RunError:
        return None


def duration(seconds: float) -> str:
    """ "45 s", "12 min", "3 h 20 min"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60:02d} min"


@contextmanager
def _claimed(cell: Cell, places: Places) -> Iterator[bool]:
    """Whether a cell is ours to run: several queues may share their folders, and a process that dies lets go."""
    path = places.runs / "locks" / f"{cell.claim}.lock"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as file:
        yield try_lock(file.fileno())
