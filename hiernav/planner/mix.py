"""Mixes of worlds that samples are drawn from: kinds with weights, and ranges of size and density.

An entry is a world as `parse_world` reads it, but every number in it may be a range, the number of obstacles may be
one per square metre, and the whole may have a weight: `2*pillar(2..8,2..8,0.4..0.7/m2)`, `two-room(2..4,2..4)`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hiernav.sim.layout import WorldSpec, parse_world

_ENTRY = re.compile(r"(?:(\d+(?:\.\d+)?)\s*\*\s*)?(.+)", re.DOTALL)
_RANGED = re.compile(r"([a-z-]+)\s*\((.*)\)", re.DOTALL)
_NUMBER = re.compile(r"(\d+(?:\.\d+)?)(?:\s*\.\.\s*(\d+(?:\.\d+)?))?\s*(/m2)?")
_SIZE_STEP = 0.1
"""Half extents are drawn in whole steps of this [m]."""


@dataclass(frozen=True)
class _Range:
    low: float
    high: float
    per_area: bool

    def draw(self, rng: np.random.Generator) -> float:
        return self.low + (self.high - self.low) * rng.random()


class WorldRange:
    """One entry of a mix.

    Raises:
        ValueError: the text is no world, a range is empty, or a world at an end of its ranges does not exist.
    """

    def __init__(self, text: str) -> None:
        weight, world = _ENTRY.fullmatch(text.strip()).groups()  # type: ignore[union-attr]  # matches all but nothing
        self.text, self.weight = text.strip(), float(weight or 1.0)
        if not self.weight > 0:
            raise ValueError(f"worlds entry {text!r}: weight {self.weight:g}, it must be positive")
        self._kind = ""
        self._ranges: tuple[_Range, ...] = ()
        self._fixed: WorldSpec | None = None
        match = _RANGED.fullmatch(world)
        if match is None or match[1] == "map" or not (".." in match[2] or "/m2" in match[2]):
            self._fixed = parse_world(world)
            return
        self._kind = match[1]
        self._ranges = tuple(_parse_range(number.strip(), text) for number in match[2].split(","))
        if any(side.per_area for side in self._ranges[:2]):
            raise ValueError(f"worlds entry {text!r}: a side is no density; only the number of obstacles has /m2")
        self.extremes()

    def __str__(self) -> str:
        return self.text

    def draw(self, rng: np.random.Generator) -> WorldSpec:
        """A world, every number uniform in its range."""
        return self._fixed or self._world([each.draw(rng) for each in self._ranges])

    def extremes(self) -> tuple[WorldSpec, ...]:
        """The smallest world, the largest, and the smallest with most in it; one alone where nothing is a range."""
        if self._fixed is not None:
            return (self._fixed,)
        low, high = [each.low for each in self._ranges], [each.high for each in self._ranges]
        return self._world(low), self._world(high), self._world([*low[:2], *high[2:]])

    def _world(self, values: list[float]) -> WorldSpec:
        sides = [round(value / _SIZE_STEP) * _SIZE_STEP for value in values[:2]]
        numbers = [f"{side:.1f}" for side in sides]
        for value, spread in zip(values[2:], self._ranges[2:], strict=True):
            numbers.append(str(round(value * 4.0 * sides[0] * sides[1] if spread.per_area else value)))
        return parse_world(f"{self._kind}({','.join(numbers)})")


class WorldMix:
    """Worlds to draw from, each entry as often as its weight says."""

    def __init__(self, texts: Sequence[str]) -> None:
        self.entries = tuple(map(WorldRange, texts))
        weights = np.array([entry.weight for entry in self.entries])
        self._upto = np.cumsum(weights / weights.sum())

    def draw(self, rng: np.random.Generator) -> WorldSpec:
        which = int(np.searchsorted(self._upto, rng.random(), side="right"))
        return self.entries[min(which, len(self.entries) - 1)].draw(rng)


def _parse_range(text: str, entry: str) -> _Range:
    match = _NUMBER.fullmatch(text)
    if match is None:
        raise ValueError(f"worlds entry {entry!r}: {text!r}, expected a number, a range 2..8, or a density 0.4..0.7/m2")
    low, high = float(match[1]), float(match[2] or match[1])
    if low > high:
        raise ValueError(f"worlds entry {entry!r}: the range {text} is empty; write {match[2]}..{match[1]}")
    return _Range(low, high, match[3] is not None)
