"""GOSELO images: what is where, seen from the robot with the goal straight above (paper section III-C).

Both maps are rotated and translated so that the goal G is straight above the position P and their midpoint M is the
centre, cropped to squares of side L + 0.4 m, 2 L and 4 L, L = |GP|, and resampled to 64 x 64. Resampling preserves
area: each crop is taken from the level of a mean pyramid that is at most twice as fine as its pixels, and the rest is
averaged. Beyond the paper, `local` is a crop of fixed metric size around the robot at map resolution, because the
others lose metric size to the normalisation by L, and `clearance` shows the distance to what is in the way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hiernav.nav.occupancy import OccupancyMap, VisitMap
from hiernav.nav.opencv import cv2

PIXELS = 64
CHANNELS = ("obstacles_1", "obstacles_2", "obstacles_4", "visits_1", "visits_2", "visits_4")
"""The paper's image: two maps, each in crops of side L + 0.4 m, 2 L and 4 L."""
METRIC_CHANNELS = ("obstacles_1", "obstacles_2", "obstacles_4", "clearance_local")
"""Obstacles as in the paper, and the clearance around the robot in a crop of fixed size."""
LOCAL_SIDE = 3.2
"""Side of the local crop [m]: 64 pixels of 0.05 m."""
MARGIN = 0.4
"""Added to L for the first crop [m]: 4 cells of 0.1 m."""
MIN_DISTANCE = 0.1
"""L is at least this [m], so that a robot at its goal still has a frame."""
VISIT_CLIP = 4
"""Entries into a pixel beyond this look the same."""
CLEARANCE_CLIP = 0.64
"""Clearance that a pixel value of 255 stands for [m]."""


def constants() -> dict[str, Any]:
    """What images are made by besides their channels, as a bundle's `GoseloSpec` names it."""
    return {
        "pixels": PIXELS,
        "local_side_m": LOCAL_SIDE,
        "margin_m": MARGIN,
        "min_distance_m": MIN_DISTANCE,
        "clearance_clip_m": CLEARANCE_CLIP,
        "visit_clip": VISIT_CLIP,
    }


@dataclass(frozen=True)
class GoseloFrame:
    """The frame of N images: origin at the robot, `up` towards the goal, `right` across; metres."""

    position: np.ndarray
    """(N, 2) world frame [m]."""
    up: np.ndarray
    """(N, 2) unit vector towards the goal."""
    distance: np.ndarray
    """(N,) L [m], at least `MIN_DISTANCE`."""

    @classmethod
    def of(cls, position: np.ndarray, goal: np.ndarray) -> GoseloFrame:
        """The frame of robots at position (N, 2) with goals (N, 2); a robot on its goal looks along +y."""
        delta = np.asarray(goal, dtype=np.float64) - position
        length = np.linalg.norm(delta, axis=-1)
        known = length > 1e-9
        up = np.where(known[:, None], delta / np.where(known, length, 1.0)[:, None], [0.0, 1.0])
        return cls(np.array(position, dtype=np.float64), up, np.maximum(length, MIN_DISTANCE))

    @property
    def right(self) -> np.ndarray:
        """(N, 2) unit vector, `up` turned clockwise."""
        return np.stack([self.up[:, 1], -self.up[:, 0]], axis=-1)

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """(N, ..., 2) right, up [m] -> world frame [m]."""
        extra = (1,) * (points.ndim - 2)
        right, up, origin = (v.reshape(len(v), *extra, 2) for v in (self.right, self.up, self.position))
        return origin + points[..., :1] * right + points[..., 1:] * up

    def from_world(self, points: np.ndarray) -> np.ndarray:
        """(N, ..., 2) world frame [m] -> right, up [m]; inverse of `to_world`."""
        extra = (1,) * (points.ndim - 2)
        right, up, origin = (v.reshape(len(v), *extra, 2) for v in (self.right, self.up, self.position))
        delta = points - origin
        return np.stack([(delta * right).sum(-1), (delta * up).sum(-1)], axis=-1)


def images(
    occupancy: Sequence[OccupancyMap],
    visits: Sequence[VisitMap],
    frame: GoseloFrame,
    channels: Sequence[str] = CHANNELS,
) -> np.ndarray:
    """GOSELO images of N robots: (N, C, 64, 64) uint8.

    A channel is named after what it shows and its crop. `obstacles`: 255 where occupied, as everything outside the
    map is. `visits`: brightest where the robot came `VISIT_CLIP` times. `clearance`: 255 at `CLEARANCE_CLIP` and
    beyond.
    Row 0 is the top (towards the goal), column 0 the left.

    Raises:
        ValueError: a channel has another name.
    """
    plan = [channel.rpartition("_")[::2] for channel in channels]
    check_channels(channels)
    out = np.empty((len(frame.position), len(channels), PIXELS, PIXELS), dtype=np.uint8)
    # plain floats: arrays of two numbers would take longer than the crops
    rows = zip(frame.position.tolist(), frame.up.tolist(), frame.distance.tolist(), strict=True)
    for row, ((x, y), up, length) in enumerate(rows):
        levels = {s: _pyramid(s, occupancy[row], visits[row]) for s in dict.fromkeys(source for source, _ in plan)}
        middle = (x + 0.5 * length * up[0], y + 0.5 * length * up[1])
        for channel, (source, crop) in enumerate(plan):
            out[row, channel] = _crop(
                levels[source],
                occupancy[row],
                (x, y) if crop == "local" else middle,
                up,
                _SIDES[crop](length),
                outside=255 if source == "obstacles" else 0,
            )
    return out


def check_channels(channels: Sequence[str]) -> None:
    """Raise ValueError for a channel that `images` does not know."""
    for name in channels:
        source, _, crop = name.rpartition("_")
        if source not in _SOURCES or crop not in _SIDES:
            raise ValueError(f"GOSELO channel {name!r}: expected one of {_SOURCES} with one of {tuple(_SIDES)}")


_LONGEST = 128
"""Pixels of the longer side of a pyramid's last level, at most."""
_MOST_SAMPLES = 16
"""Per pixel of an image and axis; more are called for only where L is many times the size of the map."""
_SOURCES = ("obstacles", "visits", "clearance")
_SIDES = {
    "1": lambda length: length + MARGIN,
    "2": lambda length: 2.0 * length,
    "4": lambda length: 4.0 * length,
    "local": lambda length: LOCAL_SIDE,
}


def _pyramid(source: str, occupancy: OccupancyMap, visits: VisitMap) -> list[np.ndarray]:
    """A map as an image (uint8), then its means over 2 x 2, 4 x 4, ... pixels.

    What does not change while an occupancy map lives is kept with it.
    """
    if source == "visits":
        return _halve(np.minimum(visits.counts, VISIT_CLIP) * np.uint8(255 // VISIT_CLIP), outside=0)
    kept = occupancy.__dict__.setdefault("_pyramids", {})
    if source not in kept:
        if source == "obstacles":
            kept[source] = _halve(occupancy.occupied.astype(np.uint8) * np.uint8(255), outside=255)
        else:
            scaled = np.minimum(occupancy.clearance * (255.0 / CLEARANCE_CLIP), 255.0)
            kept[source] = [np.rint(scaled).astype(np.uint8)]
    return kept[source]


def _halve(level: np.ndarray, outside: int) -> list[np.ndarray]:
    levels = [level]
    # a long and narrow map is seen from so far that it needs levels on which its width is a pixel or two
    while min(level.shape) >= 16 or max(level.shape) >= _LONGEST:
        rows, cols = level.shape
        if rows % 2 or cols % 2:
            level = cv2.copyMakeBorder(level, 0, rows % 2, 0, cols % 2, cv2.BORDER_CONSTANT, value=outside)
        level = cv2.resize(level, (level.shape[1] // 2, level.shape[0] // 2), interpolation=cv2.INTER_AREA)
        levels.append(level)
    return levels


def _crop(
    levels: list[np.ndarray],
    occupancy: OccupancyMap,
    center: Sequence[float],
    up: Sequence[float],
    side: float,
    outside: int,
) -> np.ndarray:
    """A square of `side` [m] around `center`, turned so that `up` points to the top: (64, 64) uint8."""
    pixel = side / PIXELS
    depth = min(max(int(math.log2(pixel / occupancy.resolution) + 1e-9), 0), len(levels) - 1)
    step = occupancy.resolution * 2**depth
    # per pixel and axis, so that none of the level is skipped
    samples = min(max(1, math.ceil(pixel / step - 1e-6)), _MOST_SAMPLES)
    count, fine = PIXELS * samples, pixel / samples
    (ux, uy), half = up, 0.5 * (side - fine)
    # right is (uy, -ux); the first sample is the upper left one
    x = (center[0] + half * (ux - uy) - occupancy.origin[0]) / step - 0.5
    y = (center[1] + half * (uy + ux) - occupancy.origin[1]) / step - 0.5
    scale = fine / step
    image = cv2.warpAffine(
        levels[depth],
        np.array([[uy * scale, -ux * scale, x], [-ux * scale, -uy * scale, y]]),
        (count, count),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=outside,
    )
    return image if samples == 1 else cv2.resize(image, (PIXELS, PIXELS), interpolation=cv2.INTER_AREA)
