"""A cell: one training, evaluation or film, and the key that says whether a result is still that of the cell."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec

from hiernav.nav.bundle import MANIFEST, PLANNER, SKILL, file_sha256

Kind = Literal["evaluate", "train", "finetune", "table2", "walk", "film"]
TRAINING: frozenset[str] = frozenset({"train", "finetune", "table2"})
"""Kinds that train a network, and need the train extra."""


@dataclass(frozen=True)
class Places:
    """Where things are."""

    root: Path
    """Of the repository: `configs/`, `deploy/bundles/`."""
    results: Path
    """Small JSON files and films, for the repository."""
    runs: Path
    """Run folders, data sets, logs; large, and only of use to go on."""


class Cell(msgspec.Struct, frozen=True, kw_only=True):
    """One entry of the queue."""

    experiment: str
    name: str
    kind: Kind
    robot: str
    variant: str
    """Which policies, or which departure from them."""
    seconds: float
    """How long it takes on two idle cores, roughly."""
    seed: int | None = None
    """Of the training; None for a bundle that ships."""
    world: str | None = None
    settings: dict[str, Any] = {}
    """All else that decides the outcome."""
    config: str | None = None
    """Resolved configuration of a training (JSON, which is YAML); where a planner alone is trained, what of it decides.
    """
    bundle: str | None = None
    """Bundle that drives, relative to the root."""
    run: str | None = None
    """Run folder that is trained, or that drives, within `Places.runs`."""
    needs: tuple[str, ...] = ()
    """Cells that have to be done before, or that this one is compared with."""

    @property
    def id(self) -> str:
        """experiment/name, as on the command line."""
        return f"{self.experiment}/{self.name}"

    @property
    def claim(self) -> str:
        """What only one process at a time may work on: a run folder, a data set, or just this cell."""
        if self.kind == "table2":
            return f"{self.experiment}-{self.variant}-{self.seed}"
        return self.run if self.kind == "train" and self.run else f"{self.experiment}-{self.name}"

    @property
    def command(self) -> str:
        """What makes it, from the root of the repository."""
        more = f" --seeds {self.seed + 1}" if self.seed else ""  # of some there is one seed unless more are asked for
        return f"python tools/reproduce.py --only {self.id}{more}"


def cell_key(cell: Cell, places: Places) -> str:
    """Changes when a result of this cell would no longer be what the cell says: other settings, another bundle."""
    decides = [cell.kind, cell.robot, cell.seed, cell.world, cell.settings, cell.config, cell.run]
    decides.append(bundle_hashes(places.root / cell.bundle) if cell.bundle else None)
    return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:16]


def training_hash(cell: Cell, places: Places) -> str | None:
    """Hash of what a run folder says of its trainings, for a cell that drives one; None where the folder is not here.

    Another training of the same configuration is another robot: no two end after the same time.
    """
    if cell.run is None or cell.kind == "train":
        return None
    summary = places.runs / cell.run / "summary.json"
    return file_sha256(summary)[:16] if summary.is_file() else None


def bundle_hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of what decides how a bundle drives; empty where there is no bundle."""
    names = (MANIFEST, PLANNER, SKILL)
    return {name: file_sha256(folder / name) for name in names if (folder / name).is_file()}
