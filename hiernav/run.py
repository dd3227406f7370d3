"""Run folders: where a training leaves its configuration, metrics, curves and checkpoints.

    config.yaml       every value of the configuration
    metrics.jsonl     one JSON object per line: stage, step, values; the same for the same seed
    rates.jsonl       how fast the machine was, and how long each stage has taken, likewise
    tensorboard/      both as curves
    planner/, skill/  checkpoints of the two stages
    summary.json      outcome
    commits.txt       which code trained, a line each
    .lock             empty; locked by the process that writes to the folder

A checkpoint knows how long both logs were when it was written; resuming cuts off what came later, so that a resumed
run leaves the same files as an uninterrupted one. Checkpoints, and what they speak of, outlive a power failure.
"""

from __future__ import annotations

import functools
import json
import math
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

from hiernav.config import ConfigError, TrainConfig, dump_config, load_config
from hiernav.files import sync, write_atomically, write_json
from hiernav.git import code_name, package_state
from hiernav.lock import FolderLock


class RunError(ValueError):
    """A run folder that cannot be used."""


class TrainingDiverged(RuntimeError):
    """Losses, weights or physics are no longer finite; the last checkpoint is from before."""


class PhysicsBroke(TrainingDiverged):
    """It is the physics: a training that is resumed goes on in other worlds."""


COMMITS = "commits.txt"
UNKNOWN_CODE = "unknown"
"""Of what has trained without a note of it."""

_LOGS = {"metrics_length": "metrics.jsonl", "rates_length": "rates.jsonl"}
"""Key of a checkpoint -> log whose length it holds."""


class WorkersLost(RuntimeError):
    """Processes that simulate, or that make samples, have died for good; what was saved before is as it was."""


class Run:
    """One run folder; only one process at a time writes to it, from its first write on until `close`."""

    def __init__(self, path: Path, config: TrainConfig) -> None:
        self.path, self.config = path, config
        self._writer: Any = None
        self._began: dict[str, float] = {}
        self._rewound = False
        self._lock = FolderLock(path)

    @classmethod
    def create(cls, config: TrainConfig, begin: Callable[[Run], None] | None = None) -> Run:
        """Make a new run folder.

        Args:
            begin: saves the checkpoints that training starts from. The folder comes into being with all of them: what
                is killed or fails before leaves none that could be resumed.

        Raises:
            RunError: the folder holds a run already, or there is a `begin` and it holds anything; or it cannot be
                written to, or another process is about to make a run there.
        """
        name = f"{time.strftime('%Y%m%d-%H%M%S')}-{config.robot}-{config.seed}"
        run = cls(Path(config.run_dir) if config.run_dir else Path("runs") / name, config)
        run._require_none()
        if begin is not None:
            if run.path.exists() and next(run.path.iterdir(), None) is not None:
                raise RunError(f"{run.path} is not empty: choose another run_dir")
            _create_begun(run.path, config, begin)
            return run
        run.path.mkdir(parents=True, exist_ok=True)
        run._hold()
        run._require_none()
        write_atomically(run.path / "config.yaml", dump_config(config).encode())
        sync(run.path.parent)
        run.close()
        return run

    @classmethod
    def open(cls, path: str | Path) -> Run:
        """Open an existing run folder.

        Raises:
            RunError: it is not one.
        """
        path = Path(path)
        if not (path / "config.yaml").is_file():
            raise RunError(f"{path} is not a run folder: it has no config.yaml; `hiernav train` makes one")
        return cls(path, load_config(path / "config.yaml", begun=True))

    def log(self, stage: str, step: int, values: Mapping[str, float]) -> None:
        """Append values to `metrics.jsonl`, null where one is not known yet, and to the curves `stage/...`."""
        self._append("metrics.jsonl", stage, step, values, stage)

    def note_code(self, code: str | None = None) -> None:
        """Note which code trains in this process, as `hiernav.git.code_name` gives it; None: what git says now.

        Raises:
            RunError: it cannot be written.
        """
        code, known = code or code_name(package_state()), self.codes()
        if code in known:
            return
        begun = not known and any(self.path.glob("*/checkpoint.pt"))
        with self.writing(), (self.path / COMMITS).open("a") as file:
            file.write(f"{UNKNOWN_CODE}\n" * begun + f"{code}\n")

    def codes(self) -> list[str]:
        """Which code has trained, as far as it was noted; each once, in order."""
        file = self.path / COMMITS
        return list(dict.fromkeys(file.read_text().splitlines())) if file.exists() else []

    def start_clock(self, stage: str) -> None:
        """Count the seconds of a stage from here on, after those that other processes have spent on it."""
        self._began[stage] = time.perf_counter() - spent_seconds(self.path, stage)

    def seconds(self, stage: str) -> float:
        """What a stage whose clock was started has taken so far, whatever processes worked on it."""
        return time.perf_counter() - self._began[stage]

    def log_rates(self, stage: str, step: int, values: Mapping[str, float]) -> None:
        """Append what depends on the machine to `rates.jsonl` and to the curves `rates/stage/...`."""
        if stage in self._began:
            values = {**values, "seconds": round(self.seconds(stage), 3)}
        self._append("rates.jsonl", stage, step, values, f"rates/{stage}")

    def save(self, stage: str, state: Mapping[str, Any]) -> None:
        """Write a stage's checkpoint atomically: a killed process and a full disk leave the previous one.

        Raises:
            RunError: it cannot be written.
        """
        import io

        import torch

        logs = {key: self.path / name for key, name in _LOGS.items()}
        with self.writing():
            if self._writer is not None:
                self._writer.flush()
            lengths = {key: log.stat().st_size for key, log in logs.items() if log.exists()}
            for log in logs.values():
                if log.exists():
                    sync(log)
            buffer = io.BytesIO()
            torch.save({**state, **lengths}, buffer)
            folder = self.path / stage
            folder.mkdir(exist_ok=True)
            write_atomically(folder / "checkpoint.pt", buffer.getvalue())
            sync(self.path)

    def has(self, stage: str) -> bool:
        """Whether a stage has a checkpoint."""
        return (self.path / stage / "checkpoint.pt").exists()

    def load(self, stage: str, rewind: bool = False) -> dict[str, Any] | None:
        """A stage's checkpoint, or None; `rewind` cuts off logs that are newer than every stage's checkpoint.

        Raises:
            RunError: the checkpoint cannot be read, or the logs cannot be written to.
        """
        if rewind:
            with self.writing():
                self._rewound = True
                # every stage: the skill's metrics are newer than the planner's checkpoint and must stay
                known = [_read_checkpoint(file) for file in self.path.glob("*/checkpoint.pt")]
                for key, name in _LOGS.items():
                    if (log := self.path / name).exists():
                        length = max((state.get(key, 0) for state in known), default=0)
                        os.truncate(log, min(length, log.stat().st_size))
        file = self.path / stage / "checkpoint.pt"
        return _read_checkpoint(file) if file.exists() else None

    def saved_at(self, stage: str) -> datetime:
        """Local time at which a stage's checkpoint was written; OSError if there is none."""
        return datetime.fromtimestamp((self.path / stage / "checkpoint.pt").stat().st_mtime)

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Whatever goes wrong inside with writing to the run folder becomes one error that says how to go on.

        Raises:
            RunError: another process writes to the folder, or in the place of an OSError.
        """
        try:
            self._hold()
            yield
        except OSError as error:
            self._writer = None  # what it still holds cannot be written either
            raise RunError(
                f"{self.path} cannot be written to ({error.strerror or error}): checkpoints are as they were; "
                f"make room, then go on with: hiernav train --resume {self.path}"
            ) from error

    def summarize(self, values: Mapping[str, Any]) -> None:
        """Merge values into `summary.json`.

        Raises:
            RunError: what is there cannot be read, or it cannot be written.
        """
        file = self.path / "summary.json"
        with self.writing():
            try:
                known = _json_object(file.read_text()) if file.exists() else {}
            except _DAMAGED as error:
                raise _damaged(file, error) from None
            write_json(file, {**known, **values})

    def _append(self, log: str, stage: str, step: int, values: Mapping[str, float], curves: str) -> None:
        known = {key: value if math.isfinite(value) else None for key, value in values.items()}
        with self.writing():
            purge_step = self._purge_step(step) if self._writer is None else None
            with (self.path / log).open("a") as file:
                file.write(json.dumps({"stage": stage, "step": step, **known}) + "\n")
            if self._writer is None:
                from torch.utils.tensorboard import SummaryWriter

                _spare_writer_tracebacks()
                self._writer = SummaryWriter(str(self.path / "tensorboard"), purge_step=purge_step)
            for key, value in known.items():
                if value is not None:
                    self._writer.add_scalar(f"{curves}/{key}", value, step)

    def _purge_step(self, step: int) -> int | None:
        """Where curves that go on with `step` are to cut off what an earlier process has drawn after its checkpoint.

        None where there is nothing to cut off, or where more would go: TensorBoard cuts the curves of all stages alike.
        """
        rewound, self._rewound = self._rewound, False
        log = self.path / "metrics.jsonl"
        if not rewound or not log.exists():
            return None
        try:
            kept = max((line["step"] for line in map(_json_object, log.read_text().splitlines())), default=-1)
            return step if kept < step else None
        except _DAMAGED:
            return None  # a curve that doubles back is no reason not to train

    def close(self) -> None:
        """End the curves, and let other processes write to the folder."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None
        self._lock.release()

    def _require_none(self) -> None:
        if (self.path / "config.yaml").exists():
            raise RunError(
                f"{self.path} holds a run already: go on with --resume {self.path}, or choose another run_dir"
            )

    def _hold(self) -> None:
        if not self._lock.acquire():
            raise RunError(f"{self.path} is in use: another process trains in it; wait until it has ended, or stop it")


def check_stage(config: TrainConfig, stage: str, planned: bool = False) -> None:
    """Refuse to train a stage that a configuration does not have, or that has to wait for the planner.

    Args:
        stage: "planner", "skill" or "all".
        planned: whether the run has a trained planner.

    Raises:
        ConfigError: names the setting.
    """
    if stage == "planner" and config.skill.preset == "baseline":
        raise ConfigError("skill.preset = 'baseline' follows no plan: it has no planner stage")
    if stage == "skill" and config.skill.planner == "cnn" and not planned:
        raise ConfigError(
            "skill.planner = 'cnn' needs a trained planner: train it first, with --stage planner, or both, with all"
        )


def _create_begun(path: Path, config: TrainConfig, begin: Callable[[Run], None]) -> None:
    """Fill a folder beside `path`, and give it that name once it is whole."""
    beside = path.with_name(path.name + ".part")
    try:
        shutil.rmtree(beside, ignore_errors=True)  # of a process that was killed here
        beside.mkdir(parents=True)
        begin(Run(beside, config))
        write_atomically(beside / "config.yaml", dump_config(config).encode())
        beside.rename(path)
        sync(path.parent)
    except (OSError, RunError) as error:
        cause = error if isinstance(error, OSError) else error.__cause__
        if not isinstance(cause, OSError):
            raise
        raise RunError(f"{path} cannot be written to ({cause.strerror or cause}): there is no run yet") from cause
    finally:
        shutil.rmtree(beside, ignore_errors=True)


@functools.cache
def _spare_writer_tracebacks() -> None:
    """TensorBoard's thread keeps its OSError for whoever gives it the next value: once is enough to be told of it."""
    usual = threading.excepthook

    def tell(failure: threading.ExceptHookArgs) -> None:
        of_tensorboard = type(failure.thread).__module__.partition(".")[0] == "tensorboard"
        if not (of_tensorboard and issubclass(failure.exc_type, OSError)):
            usual(failure)

    threading.excepthook = tell


def spent_seconds(folder: Path, stage: str) -> float:
    """What a stage has taken in all processes that worked on it, as its run folder tells; 0 if there is none.

    Raises:
        RunError: `summary.json` or `rates.jsonl` is damaged.
    """
    summary, rates = folder / "summary.json", folder / "rates.jsonl"
    try:
        outcome = _json_object(summary.read_text()).get(stage, {}) if summary.exists() else {}
        total = float(outcome.get("seconds", 0.0))
    except _DAMAGED as error:
        raise _damaged(summary, error) from None
    seconds, step = 0.0, 0
    try:
        # the last may be half a line
        whole, _, _ = rates.read_text().rpartition("\n") if rates.exists() else ("", "", "")
        for line in map(_json_object, whole.splitlines()):
            if line["stage"] == stage:
                # older runs tell only how fast they were
                rate = line.get("steps_per_second")
                seconds = line.get("seconds") or seconds + ((line["step"] - step) / rate if rate else 0.0)
                step = line["step"]
        return max(seconds, total)
    except _DAMAGED as error:
        raise _damaged(rates, error) from None


_DAMAGED = (ValueError, KeyError, TypeError, AttributeError, RecursionError)
"""What reading a file of JSON that somebody else has written to, or a disk has lost part of, raises."""


def _json_object(text: str) -> dict[str, Any]:
    value = json.loads(text)
    if not isinstance(value, dict):
        raise ValueError(f"{type(value).__name__}, expected an object")
    return value


def _damaged(file: Path, error: Exception) -> RunError:
    reason = f"no {error}" if isinstance(error, KeyError) else error
    return RunError(f"{file} is damaged ({reason}): restore it, or remove it and go on with --resume")


def newest_run(folder: str | Path = "runs") -> Path:
    """The run in `folder` that was begun last.

    Raises:
        RunError: there is none.
    """
    runs = sorted(Path(folder).glob("*/config.yaml"), key=lambda file: file.stat().st_mtime_ns)
    if not runs:
        raise RunError(f"no run folder in {folder}/: name another one, or make one with `hiernav train`")
    return runs[-1].parent


def _read_checkpoint(file: Path) -> dict[str, Any]:
    import torch

    try:
        return torch.load(file, weights_only=True, map_location="cpu")
    except Exception as error:  # a damaged file fails in any of a dozen ways
        raise RunError(
            f"{file} cannot be read ({type(error).__name__}): restore it, or remove it and train with --resume"
        ) from error
