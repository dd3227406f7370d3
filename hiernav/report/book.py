"""The results as tables and figures ask for them: groups of seeds, and means with 95 % intervals."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from hiernav.evaluate import wilson_interval
from hiernav.reproduce.cells import Cell, Places, bundle_hashes, cell_key
from hiernav.reproduce.experiments import catalogue
from hiernav.reproduce.results import Drive, Result, drive_of, read_results

_HALF_WIDTHS = {"steps_mean": "steps_half95", "collisions_mean": "collisions_half95", "spl_mean": "spl_half95"}

_RATES = ("reach_rate", "collision_free_rate")
"""Shares of episodes."""
_RANGES = {
    **dict.fromkeys(("reach_rate", "collision_free_rate", "spl_mean"), (0.0, 1.0)),
    **dict.fromkeys(("steps_mean", "collisions_mean", "steps_between_plans"), (0.0, math.inf)),
}
_ANY = (-math.inf, math.inf)


@dataclass(frozen=True)
class Estimate:
    """A mean and the ends of its 95 % interval, which are NaN where there is none."""

    mean: float
    low: float = math.nan
    high: float = math.nan
    count: int = 1
    """Trainings it was taken over."""


@dataclass(frozen=True)
class Group:
    """Results that differ in their seed alone."""

    done: tuple[Result, ...] = ()
    failed: tuple[Result, ...] = ()
    older: tuple[str, ...] = ()
    """What is no longer that of the repository (`Book.changed`), of each result of which something is."""

    @property
    def age(self) -> str:
        """ "older bundle", "1 of 3: older settings", or nothing where all results are of what the repository holds."""
        count, what = len(self.done) + len(self.failed), " and ".join(sorted(set(self.older)))
        return what if len(self.older) in (0, count) else f"{len(self.older)} of {count}: {what}"

    def estimate(self, name: str, protocol: str = "strict") -> Estimate | None:
        """Of a number of `Drive`: over seeds where there are several, over episodes where there is one; None: not run.

        Intervals: Student's t over seeds; over episodes Wilson for rates, normal for means; cut to what is possible.
        Those of rates over seeds hold Wilson's of all episodes together: seeds that agree do not prove a number.
        """
        drives = [drive for result in self.done if (drive := drive_of(result, protocol)) is not None]
        values = [float(value) for drive in drives if (value := getattr(drive, name)) is not None]
        if len(values) == 1:
            return _of_episodes(next(d for d in drives if getattr(d, name) is not None), name)
        found = of_seeds(values, *_RANGES.get(name, _ANY))
        if found is None or name not in _RATES:
            return found
        episodes = sum(drive.episodes for drive in drives)
        low, high = wilson_interval(round(sum(getattr(drive, name) * drive.episodes for drive in drives)), episodes)
        return replace(found, low=min(found.low, low), high=max(found.high, high))


def of_seeds(values: Sequence[float], least: float = -math.inf, most: float = math.inf) -> Estimate | None:
    """Mean over trainings with Student's 95 % interval, cut to what is possible; None of none."""
    if not values:
        return None
    mean = round(float(np.mean(values)), 12)  # three times 0.99 is 0.99
    if len(values) == 1:
        return Estimate(mean)
    from scipy.stats import t

    half = float(t.ppf(0.975, len(values) - 1)) * float(np.std(values, ddof=1)) / math.sqrt(len(values))
    return Estimate(mean, max(mean - half, least), min(mean + half, most), len(values))


@dataclass
class Book:
    """All results of a folder."""

    folder: Path
    results: list[Result]
    damaged: list[str]
    """A line for each file that cannot be used."""
    changed: dict[str, str] = field(default_factory=dict)
    """Results whose settings or bundle are no longer those of the repository: "older settings" or "older bundle"."""
    cells: list[Cell] = field(default_factory=list)
    """All that there is to run; empty away from the repository."""
    left_out: int = 0
    """Results that `current` has left out."""

    @classmethod
    def open(cls, folder: Path) -> Book:
        """Read a folder. Beside the repository's configurations, it also knows what is missing and what has changed."""
        if not folder.is_dir():
            raise ValueError(f"{folder} is no folder of results: make them with tools/reproduce.py")
        results, damaged = read_results(folder)
        book, root = cls(folder, results, damaged), folder.resolve().parent
        if (root / "configs").is_dir() and (root / "deploy").is_dir():
            places = Places(root, folder, root / "runs")
            # more seeds than usual, so that all that were trained are known
            most = max((result.seed + 1 for result in results if result.seed is not None), default=1)
            keys = {cell.id: cell_key(cell, places) for cell in catalogue(root, seeds=max(5, most))}
            book.changed = {r.id: _what_changed(r, root) for r in results if keys.get(r.id) != r.key}
            book.cells = catalogue(root)
        return book

    def current(self) -> Book:
        """The same without results of older settings or bundles, for whoever draws conclusions."""
        kept = [result for result in self.results if result.id not in self.changed]
        return replace(self, results=kept, changed={}, left_out=len(self.results) - len(kept))

    def group(
        self,
        experiment: str,
        variant: str,
        robot: str | None = None,
        world: str | None = None,
        samples: int | None = None,
    ) -> Group:
        """Results of a variant, by seed; of a size of Table II if there are `samples`."""
        found = [
            result
            for result in self.results
            if (result.experiment, result.variant) == (experiment, variant)
            and robot in (None, result.robot)
            and world in (None, result.world)
            and samples in (None, result.settings.get("samples"))
        ]
        found.sort(key=lambda result: -1 if result.seed is None else result.seed)
        return Group(
            tuple(result for result in found if result.state == "done"),
            tuple(result for result in found if result.state == "failed"),
            tuple(self.changed[result.id] for result in found if result.id in self.changed),
        )

    def seeds(
        self, experiment: str, variant: str, robot: str, world: str | None = None, samples: int | None = None
    ) -> list[int]:
        """Seeds that there are to run of a variant, and those that were run beyond them."""
        entries: list[Cell | Result] = [*self.cells, *self.results]
        return sorted(
            {
                entry.seed
                for entry in entries
                if (entry.experiment, entry.variant, entry.robot) == (experiment, variant, robot)
                and world in (None, entry.world)
                and samples in (None, entry.settings.get("samples"))
                and entry.seed is not None
            }
        )

    def training_worlds(self, robot: str) -> tuple[tuple[str, ...], tuple[str, ...]] | None:
        """Worlds that planner and skill of ours are trained in, weights left out; None if nothing tells."""
        for cell in self.cells:
            if (cell.experiment, cell.variant, cell.robot) == ("sample_efficiency", "ours", robot) and cell.config:
                config = json.loads(cell.config)
                planner, skill = (config[part]["worlds"] for part in ("planner", "skill"))
                plain = dict.fromkeys(re.sub(r"^[\d.]+\s*\*\s*", "", world) for world in planner)
                return tuple(plain), tuple(dict.fromkeys(skill))
        return None

    def knows(self, experiment: str, variant: str, robot: str) -> bool:
        """Whether there is such a thing to run, as far as is known: a departure may change nothing for a robot."""
        entries: list[Cell | Result] = [*self.cells, *self.results]
        return not self.cells or any(
            (entry.experiment, entry.variant, entry.robot) == (experiment, variant, robot) for entry in entries
        )


def _what_changed(result: Result, root: Path) -> str:
    bundle = result.source.get("bundle")
    same = bundle is None or result.source.get("sha256") == bundle_hashes(root / bundle)
    return "older settings" if same else "older bundle"


def curve(result: Result, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Steps (T,) of the evaluations during a training, and a value (T,) of each, NaN where it is not known."""
    points: list[dict[str, Any]] = list(result.curves.get("evaluation", []))
    values = [math.nan if point.get(name) is None else point[name] for point in points]
    return np.array([point["step"] for point in points], dtype=float), np.array(values, dtype=float)


def _of_episodes(drive: Drive, name: str) -> Estimate:
    value = float(getattr(drive, name))
    if name == "reach_rate":
        return Estimate(value, *drive.reach_ci95)
    if name == "collision_free_rate":
        return Estimate(value, *wilson_interval(round(value * drive.episodes), drive.episodes))
    half = getattr(drive, _HALF_WIDTHS[name]) if name in _HALF_WIDTHS else None
    least, most = _RANGES.get(name, _ANY)
    return Estimate(value) if half is None else Estimate(value, max(value - half, least), min(value + half, most))
