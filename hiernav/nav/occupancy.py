"""Occupancy and visit maps on a regular grid (paper Sec. III-C, GOSELO's two inputs).

Arrays are indexed [row, col] with row 0 at the LOWEST y and col 0 at the lowest x, so that indices grow with the
world axes. A pixel's centre is at origin + (index + 0.5) * resolution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hiernav.nav.opencv import cv2

RESOLUTION = 0.05
MAX_SIDE = 16384
_EDGE_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class OccupancyMap:
    """A binary map of what is in the way. Whatever lies outside of it counts as occupied.

    occupied: (rows, cols) bool, True where an obstacle is. Treat it as read-only: `clearance` is computed once.
    resolution: side of a pixel [m].
    origin: (x, y) of the lower-left corner of pixel [0, 0], world frame [m].

    Raises ValueError for an array that is not 2-D bool, is empty or longer than 16384 pixels a side, for a resolution
    that is not finite and positive, and for an origin that is not two finite numbers.
    """

    occupied: NDArray[np.bool_]
    resolution: float = RESOLUTION
    origin: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        check_geometry(self.occupied.shape, self.resolution, self.origin)
        if self.occupied.dtype != np.bool_:
            raise ValueError(f"map: occupied has dtype {self.occupied.dtype}, it must be bool")

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """(xmin, xmax, ymin, ymax) of the map's outer edges [m]."""
        rows, cols = self.occupied.shape
        x, y = self.origin
        return x, x + cols * self.resolution, y, y + rows * self.resolution

    @cached_property
    def clearance(self) -> NDArray[np.float32]:
        """(rows, cols) float32 [m]: distance from a pixel's centre to the nearest occupied pixel or to outside the map.

        Measured to the near edge of that pixel (centre to centre less half a pixel; exact along the axes and at most
        0.21 pixels long on the diagonal), 0 in occupied pixels.
        """
        return self._padded_clearance[1:-1, 1:-1]

    def shows_the_same_as(self, other: OccupancyMap) -> bool:
        """Whether another map has the same pixels in the same places."""
        return (
            self.resolution == other.resolution
            and self.origin == other.origin
            and np.array_equal(self.occupied, other.occupied)
        )

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Points (..., 2) [m] inside the map's extent, edges included -> (...) bool; NaN is outside."""
        points = np.asarray(points, dtype=np.float64)
        xmin, xmax, ymin, ymax = self.extent
        x, y = points[..., 0], points[..., 1]
        return (x >= xmin) & (x <= xmax) & (y >= ymin) & (y <= ymax)

    def holds(self, x: float, y: float) -> bool:
        """`contains` for one point."""
        xmin, xmax, ymin, ymax = self.extent
        return xmin <= x <= xmax and ymin <= y <= ymax

    def occupied_at(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Points (..., 2) [m] -> (...) bool: True where the pixel holding the point is occupied, and outside."""
        points = np.asarray(points, dtype=np.float64)
        inside = self.contains(points)
        row, col = self.pixel_of(points)
        return np.where(inside, self.occupied[row, col], True)

    def pixel_of(self, points: ArrayLike) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Points (..., 2) [m] -> (row, col), each (...) int, of the nearest pixel of the map (outside is clamped)."""
        return nearest_pixel(points, self.occupied.shape, self.resolution, self.origin)

    def clearance_at(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points (..., 2) [m] -> (...) [m]: the clearance, bilinear between pixel centres, 0 outside the map."""
        points = np.asarray(points, dtype=np.float64)
        inside = self.contains(points)
        field = self._padded_clearance
        rows, cols = self.occupied.shape
        # + 0.5: the padding shifts indices by one, pixel centres by a half
        u = np.where(inside, (points[..., 0] - self.origin[0]) / self.resolution + 0.5, 0.0)
        v = np.where(inside, (points[..., 1] - self.origin[1]) / self.resolution + 0.5, 0.0)
        # u and v are not negative; np.clip takes longer to begin
        col = np.minimum(u.astype(np.intp), cols)
        row = np.minimum(v.astype(np.intp), rows)
        s, t = u - col, v - row
        low = (1.0 - s) * field[row, col] + s * field[row, col + 1]
        high = (1.0 - s) * field[row + 1, col] + s * field[row + 1, col + 1]
        return np.where(inside, (1.0 - t) * low + t * high, 0.0)

    def clearance_of(self, x: float, y: float) -> float:
        """`clearance_at` for one point."""
        if not self.holds(x, y):
            return 0.0
        field, (rows, cols) = self._padded_clearance.item, self.occupied.shape
        u, v = (x - self.origin[0]) / self.resolution + 0.5, (y - self.origin[1]) / self.resolution + 0.5
        col, row = min(int(u), cols), min(int(v), rows)
        s, t = u - col, v - row
        low = (1.0 - s) * field(row, col) + s * field(row, col + 1)
        high = (1.0 - s) * field(row + 1, col) + s * field(row + 1, col + 1)
        return (1.0 - t) * low + t * high

    def is_free(self, points: ArrayLike, radius: float) -> NDArray[np.bool_]:
        """Points (..., 2) [m] -> (...) bool: a disc of `radius` [m] there touches neither obstacle nor border."""
        clearance = self.clearance_at(points)
        return (clearance >= radius) & ~self.occupied_at(points)

    def pixel_centers(self) -> NDArray[np.float64]:
        """(rows, cols, 2) world frame [m]."""
        rows, cols = self.occupied.shape
        x = self.origin[0] + (np.arange(cols) + 0.5) * self.resolution
        y = self.origin[1] + (np.arange(rows) + 0.5) * self.resolution
        return np.stack(np.meshgrid(x, y), axis=-1)

    @cached_property
    def _padded_clearance(self) -> NDArray[np.float32]:
        free = np.pad(~self.occupied, 1).view(np.uint8)
        pixels = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        # squares of these are whole numbers, but for a rounding that differs from call to call
        np.multiply(pixels, pixels, out=pixels)
        np.sqrt(np.rint(pixels, out=pixels), out=pixels)
        return np.maximum(pixels - np.float32(0.5), np.float32(0.0)) * np.float32(self.resolution)


class VisitMap:
    """How often one robot has entered each pixel of an occupancy map (GOSELO's self-location history).

    counts: (rows, cols) uint8, the same grid as the occupancy map's; an entry beyond 255 is not counted.
    """

    def __init__(self, occupancy: OccupancyMap) -> None:
        self.resolution = occupancy.resolution
        self.origin = occupancy.origin
        self.counts: NDArray[np.uint8] = np.zeros(occupancy.occupied.shape, dtype=np.uint8)
        self._extent = occupancy.extent
        self._last_pixel: tuple[int, int] | None = None

    def lies_on(self, occupancy: OccupancyMap) -> bool:
        """Whether the grid is that of an occupancy map."""
        return (
            self.counts.shape == occupancy.occupied.shape
            and self.origin == occupancy.origin
            and self.resolution == occupancy.resolution
        )

    def moved_to(self, occupancy: OccupancyMap) -> VisitMap:
        """The same visits on the grid of another occupancy map, such as one that has grown; those outside are lost."""
        moved = VisitMap(occupancy)
        visited = np.argwhere(self.counts)
        centers = np.array(self.origin) + (visited[:, ::-1] + 0.5) * self.resolution
        inside = occupancy.contains(centers)
        counts = self.counts[tuple(visited.T)]
        np.maximum.at(moved.counts, occupancy.pixel_of(centers[inside]), counts[inside])
        if self._last_pixel is not None:
            row, col = self._last_pixel
            x, y = self.origin
            moved._last_pixel = moved._pixel(x + (col + 0.5) * self.resolution, y + (row + 0.5) * self.resolution)
        return moved

    def copy(self) -> VisitMap:
        """The visits so far."""
        copied = VisitMap.__new__(VisitMap)
        copied.__dict__.update(self.__dict__, counts=self.counts.copy())
        return copied

    def add(self, positions: ArrayLike) -> None:
        """Follow the robot along positions (2,) or (M, 2), in order of time, world frame [m].

        A pixel counts one when the robot comes into it; resting there adds nothing. Positions outside the map, or not
        finite, count nowhere.
        """
        for x, y in np.asarray(positions, dtype=np.float64).reshape(-1, 2).tolist():
            self.enter(x, y)

    def enter(self, x: float, y: float) -> None:
        """`add` for one position."""
        pixel = self._pixel(x, y)
        if pixel is not None and pixel != self._last_pixel and self.counts[pixel] < 255:
            self.counts[pixel] += 1
        self._last_pixel = pixel

    def count_in(self, counts: NDArray[np.uint8]) -> None:
        """Go on counting in another array of the same shape, such as memory that another process reads."""
        counts[:] = self.counts
        self.counts = counts

    def near(self, position: ArrayLike, radius: float) -> bool:
        """Whether the robot has been in a pixel that meets the square of half-side `radius` [m] around a position."""
        x, y = np.asarray(position, dtype=np.float64).tolist()
        if not (math.isfinite(x) and math.isfinite(y)):
            return False
        left, right = (math.floor((x + d - self.origin[0]) / self.resolution) for d in (-radius, radius))
        bottom, top = (math.floor((y + d - self.origin[1]) / self.resolution) for d in (-radius, radius))
        return bool(self.counts[max(bottom, 0) : max(top + 1, 0), max(left, 0) : max(right + 1, 0)].any())

    def _pixel(self, x: float, y: float) -> tuple[int, int] | None:
        xmin, xmax, ymin, ymax = self._extent
        if not (xmin <= x <= xmax and ymin <= y <= ymax):
            return None
        rows, cols = self.counts.shape
        return min(int((y - ymin) / self.resolution), rows - 1), min(int((x - xmin) / self.resolution), cols - 1)


def empty_map(half_size: tuple[float, float], resolution: float = RESOLUTION) -> OccupancyMap:
    """A free map that covers [-W, W] x [-H, H], half_size = (W, H) [m].

    Half-sizes that are no whole number of half pixels are covered by rounding the pixel count up; the map stays
    centred. Raises ValueError, before memory is taken, for sizes or a resolution that OccupancyMap refuses.
    """
    check_resolution(resolution)
    if not (np.isfinite(half_size).all() and min(half_size) > 0):
        raise ValueError(f"map: half size {half_size} m, both must be finite and positive")
    cols, rows = (int(np.ceil(2.0 * h / resolution - 1e-6)) for h in half_size)
    origin = (-0.5 * cols * resolution, -0.5 * rows * resolution)
    check_geometry((rows, cols), resolution, origin)
    return OccupancyMap(np.zeros((rows, cols), dtype=bool), resolution, origin)


def draw_discs(
    mask: NDArray[np.bool_], origin: tuple[float, float], resolution: float, centers: ArrayLike, radius: float
) -> None:
    """Mark in place the pixels whose centre lies in a disc: centers (K, 2) world frame [m], one radius [m]."""
    centers = np.asarray(centers, dtype=np.float64).reshape(-1, 2)
    corner = np.asarray(origin, dtype=np.float64)
    first = np.floor((centers - radius - corner) / resolution).astype(np.intp)
    index = first[:, None, :] + np.arange(int(np.ceil(2.0 * radius / resolution)) + 2)[None, :, None]
    offset = corner + (index + 0.5) * resolution - centers[:, None, :]
    inside = offset[:, :, None, 1] ** 2 + offset[:, None, :, 0] ** 2 <= (radius + _EDGE_TOLERANCE) ** 2
    valid = (index >= 0) & (index < (mask.shape[1], mask.shape[0]))
    inside &= valid[:, :, None, 1] & valid[:, None, :, 0]
    disc, row, col = np.nonzero(inside)
    mask[index[disc, row, 1], index[disc, col, 0]] = True


def draw_boxes(
    mask: NDArray[np.bool_],
    origin: tuple[float, float],
    resolution: float,
    centers: ArrayLike,
    half_extents: ArrayLike,
) -> None:
    """Mark in place the pixels whose centre lies in an upright box: centers (K, 2), half_extents (K, 2) [m]."""
    centers = np.asarray(centers, dtype=np.float64).reshape(-1, 2)
    halves = np.asarray(half_extents, dtype=np.float64).reshape(-1, 2) + _EDGE_TOLERANCE
    limit = (mask.shape[1], mask.shape[0])
    first = np.ceil((centers - halves - origin) / resolution - 0.5).astype(np.intp).clip(0, limit)
    stop = (np.floor((centers + halves - origin) / resolution - 0.5).astype(np.intp) + 1).clip(0, limit)
    for (col0, row0), (col1, row1) in zip(first, stop, strict=True):
        mask[row0:row1, col0:col1] = True


def nearest_pixel(
    points: ArrayLike, shape: tuple[int, ...], resolution: float, origin: tuple[float, float]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Points (..., 2) [m] -> (row, col), each (...) int, of the nearest pixel of a grid of that shape; NaN gives 0."""
    scaled = np.floor((np.asarray(points, dtype=np.float64) - origin) / resolution)
    # np.fmax takes the 0 where the other is NaN; np.clip and np.nan_to_num take longer to begin
    index = np.minimum(np.fmax(scaled, 0.0), (shape[1] - 1, shape[0] - 1)).astype(np.intp)
    return index[..., 1], index[..., 0]


def check_resolution(resolution: float) -> None:
    """Raise ValueError unless a resolution [m per pixel] is finite and positive."""
    if not (np.isfinite(resolution) and resolution > 0):
        raise ValueError(f"map: resolution {resolution} m per pixel, it must be finite and positive")


def check_geometry(shape: tuple[int, ...], resolution: float, origin: tuple[float, float]) -> None:
    """Raise ValueError, naming value and limit, unless an OccupancyMap of that geometry may exist."""
    if len(shape) != 2:
        raise ValueError(f"map: {len(shape)} dimensions (shape {tuple(shape)}), it must have 2")
    if min(shape) < 1 or max(shape) > MAX_SIDE:
        raise ValueError(f"map: {shape[1]} x {shape[0]} pixels, each side must be between 1 and {MAX_SIDE}")
    check_resolution(resolution)
    if len(origin) != 2 or not np.isfinite(origin).all():
        raise ValueError(f"map: origin {tuple(origin)}, it must be two finite numbers (x, y) [m]")
