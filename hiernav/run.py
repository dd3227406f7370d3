"""Run folders: where a training leaves its configuration, metrics, curves and checkpoints.

    config.yaml       every value of the configuration
    metrics.jsonl     one JSON object per line: stage, step, values; the same for the same seed
    rates.jsonl       how fast the machine was, likewise
    tensorboard/      both as curves
    planner/, skill/  checkpoints of the two stages
    summary.json      outcome

A checkpoint knows how long `metrics.jsonl` was when it was written; resuming cuts off what came later, so that a
resumed run leaves the same files as an uninterrupted one.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hiernav.config import TrainConfig, dump_config, load_config


class RunError(ValueError):
    """A run folder that cannot be used."""


class TrainingDiverged(RuntimeError):
    """Losses are no longer finite; the last checkpoint is from before."""


class Run:
    """One run folder, open for training."""

    def __init__(self, path: Path, config: TrainConfig) -> None:
        self.path, self.config = path, config
        self._writer: Any = None
        self._metrics = path / "metrics.jsonl"

    @classmethod
    def create(cls, config: TrainConfig) -> Run:
        """Make a new run folder.

        Raises:
            RunError: the folder holds a run already.
        """
        name = f"{time.strftime('%Y%m%d-%H%M%S')}-{config.robot}-{config.seed}"
        path = Path(config.run_dir) if config.run_dir else Path("runs") / name
        if (path / "config.yaml").exists():
            raise RunError(f"{path} holds a run already: go on with --resume {path}, or choose another run_dir")
        path.mkdir(parents=True, exist_ok=True)
        write_atomically(path / "config.yaml", dump_config(config).encode())
        return cls(path, config)

    @classmethod
    def open(cls, path: str | Path) -> Run:
        """Open an existing run folder.

        Raises:
            RunError: it is not one.
        """
        path = Path(path)
        if not (path / "config.yaml").is_file():
            raise RunError(f"{path} is not a run folder: it has no config.yaml; `hiernav train` makes one")
        return cls(path, load_config(path / "config.yaml"))

    def log(self, stage: str, step: int, values: Mapping[str, float]) -> None:
        """Append values to `metrics.jsonl`, null where one is not known yet, and to the curves `stage/...`."""
        self._append(self._metrics, stage, step, values, stage)

    def log_rates(self, stage: str, step: int, values: Mapping[str, float]) -> None:
        """Append what depends on the machine to `rates.jsonl` and to the curves `rates/stage/...`."""
        self._append(self.path / "rates.jsonl", stage, step, values, f"rates/{stage}")

    def save(self, stage: str, state: Mapping[str, Any]) -> None:
        """Write a stage's checkpoint atomically: a killed process leaves the previous one."""
        import io

        import torch

        if self._writer is not None:
            self._writer.flush()
        length = self._metrics.stat().st_size if self._metrics.exists() else 0
        buffer = io.BytesIO()
        torch.save({**state, "metrics_length": length}, buffer)
        folder = self.path / stage
        folder.mkdir(exist_ok=True)
        write_atomically(folder / "checkpoint.pt", buffer.getvalue())

    def load(self, stage: str, rewind: bool = False) -> dict[str, Any] | None:
        """A stage's checkpoint, or None; `rewind` cuts off metrics that are newer than every stage's checkpoint.

        Raises:
            RunError: the checkpoint cannot be read.
        """
        if rewind and self._metrics.exists():
            # every stage: the skill's metrics are newer than the planner's checkpoint and must stay
            known = [_read_checkpoint(file)["metrics_length"] for file in self.path.glob("*/checkpoint.pt")]
            os.truncate(self._metrics, min(max(known, default=0), self._metrics.stat().st_size))
        file = self.path / stage / "checkpoint.pt"
        return _read_checkpoint(file) if file.exists() else None

    def summarize(self, values: Mapping[str, Any]) -> None:
        """Merge values into `summary.json`."""
        file = self.path / "summary.json"
        known = json.loads(file.read_text()) if file.exists() else {}
        write_atomically(file, (json.dumps({**known, **values}, indent=2) + "\n").encode())

    def _append(self, file: Path, stage: str, step: int, values: Mapping[str, float], curves: str) -> None:
        with file.open("a") as lines:
            known = {key: value if math.isfinite(value) else None for key, value in values.items()}
            lines.write(json.dumps({"stage": stage, "step": step, **known}) + "\n")
        if self._writer is None:
            from torch.utils.tensorboard import SummaryWriter

            self._writer = SummaryWriter(str(self.path / "tensorboard"))
        for key, value in values.items():
            if math.isfinite(value):
                self._writer.add_scalar(f"{curves}/{key}", value, step)

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None


def newest_run(folder: str | Path = "runs") -> Path:
    """The run in `folder` that was begun last.

    Raises:
        RunError: there is none.
    """
    runs = sorted(Path(folder).glob("*/config.yaml"), key=lambda file: file.stat().st_mtime_ns)
    if not runs:
        raise RunError(f"no run folder in {folder}/: name one with --run, or make one with `hiernav train`")
    return runs[-1].parent


def _read_checkpoint(file: Path) -> dict[str, Any]:
    import torch

    try:
        return torch.load(file, weights_only=True, map_location="cpu")
    except Exception as error:  # a damaged file fails in any of a dozen ways
        raise RunError(
            f"{file} cannot be read ({type(error).__name__}): restore it, or remove it and train with --resume"
        ) from error


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file so that readers and crashes see the old or the new one, never half of it."""
    temporary = path.with_name(path.name + ".part")
    with temporary.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)
