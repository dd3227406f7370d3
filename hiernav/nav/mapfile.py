"""Maps from disk: a ROS map_server YAML file with its PGM or PNG picture."""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from hiernav.nav.occupancy import MAX_SIDE, RESOLUTION, OccupancyMap, check_geometry
from hiernav.nav.opencv import cv2
from hiernav.nav.plain_yaml import PlainLoader

MAX_YAML_BYTES = 65536
MAX_PIXELS = 2**26
"""Of a picture: 410 m by 410 m at 0.05 m. A small file can stand for many more, and decoding takes gigabytes."""
_MAX_PIXEL_BYTES = 16  # an ASCII PGM value with generous white space
_HEADER_BYTES = 4096
_PGM_HEADER = re.compile(rb"(P[25])" + 3 * rb"(?:\s|#[^\n]*\n)+(\d{1,9})" + rb"\s")
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_KEYS = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")


class MapFileError(ValueError):
    """A map file that cannot be used; the message names the file, the key or value, and the limit."""


def load_map(path: str | Path) -> OccupancyMap:
    """Read a map_server YAML file and its picture as an OccupancyMap of 0.05 m per pixel.

    Only mode `trinary` is understood. A pixel is free if its occupancy, (255 - value) / 255 or with `negate`
    value / 255, is below free_thresh; occupied and unknown pixels both count as occupied, and so do transparent ones.
    A map of another resolution is resampled conservatively: a cell is occupied if any part of it is.

    Raises MapFileError, before the picture is decoded where its header allows, for a missing or malformed file, a
    side of 0 or more than 16384 pixels or 2^26 in all, a resolution that is not finite and positive, a rotated origin,
    and a picture outside the YAML file's folder.
    """
    path = Path(path)
    entries = _read_entries(path)
    resolution = _number(path, entries, "resolution")
    if not (math.isfinite(resolution) and resolution > 0):
        raise MapFileError(f"{path}: resolution {resolution}, it must be finite and positive [m per pixel]")
    origin = _origin(path, entries)
    negate = _number(path, entries, "negate")
    if negate not in (0, 1):
        raise MapFileError(f"{path}: negate {negate:g}, it must be 0 or 1")
    free_thresh = _number(path, entries, "free_thresh")
    occupied_thresh = _number(path, entries, "occupied_thresh")
    if not 0 <= free_thresh <= occupied_thresh <= 1:
        raise MapFileError(
            f"{path}: free_thresh {free_thresh} and occupied_thresh {occupied_thresh}, "
            "they must satisfy 0 <= free_thresh <= occupied_thresh <= 1"
        )
    if entries.get("mode", "trinary") != "trinary":
        raise MapFileError(f"{path}: mode {_shown(entries['mode'])}, only 'trinary' is accepted")
    image_path = _image_path(path, entries)

    def check_size(width: int, height: int) -> None:
        for side in (width, height):
            if not 1 <= side <= MAX_SIDE:
                raise MapFileError(
                    f"{image_path}: {width} x {height} pixels, each side must be between 1 and {MAX_SIDE}"
                )
        if width * height > MAX_PIXELS:
            raise MapFileError(f"{image_path}: {width} x {height} pixels, at most {MAX_PIXELS:,} are accepted")
        cells = tuple(max(1, math.ceil(side * resolution / RESOLUTION - 1e-6)) for side in (height, width))
        try:
            check_geometry(cells, RESOLUTION, origin)
        except ValueError as error:
            raise MapFileError(
                f"{path}: resolution {resolution} m gives a map too large at {RESOLUTION} m per pixel: {error}"
            ) from error

    brightness = _read_picture(image_path, check_size)
    free = (brightness if negate else 1.0 - brightness) < free_thresh
    return _resampled(~free[::-1], resolution, origin)


def _read_entries(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            text = file.read(MAX_YAML_BYTES + 1)
    except OSError as error:
        raise MapFileError(f"{path}: the map file cannot be read ({error.strerror})") from error
    except ValueError as error:  # a path with a null character
        raise MapFileError(f"map {str(path)!r} cannot be read ({error})") from error
    if len(text) > MAX_YAML_BYTES:
        raise MapFileError(f"{path}: longer than {MAX_YAML_BYTES} bytes, this is no map_server YAML file")
    try:
        entries = yaml.load(text, Loader=PlainLoader)
    except (yaml.YAMLError, ValueError, AttributeError, RecursionError) as error:
        # PyYAML lets through what the constructors of dates and numbers raise
        raise MapFileError(f"{path}: not a YAML file ({' '.join(str(error).split())})") from error
    if not isinstance(entries, dict):
        raise MapFileError(f"{path}: holds {type(entries).__name__}, it must be a mapping with the keys {_KEYS}")
    missing = [key for key in _KEYS if key not in entries]
    if missing:
        raise MapFileError(f"{path}: the keys {missing} are missing")
    return entries


def _number(path: Path, entries: dict[str, Any], key: str) -> float:
    try:
        # YAML 1.1 reads 5e-2 as text, which float() understands
        return float(entries[key])
    except (TypeError, ValueError, OverflowError) as error:
        raise MapFileError(f"{path}: {key} {_shown(entries[key])}, it must be a number") from error


def _shown(value: Any) -> str:
    """A value for a message: not all of a long one, and none of a number that Python refuses to write out."""
    try:
        text = repr(value)
    except ValueError:
        return f"{type(value).__name__} of too many digits"
    return text if len(text) <= 100 else f"{text[:97]}..."


def _origin(path: Path, entries: dict[str, Any]) -> tuple[float, float]:
    value = entries["origin"]
    try:
        x, y, yaw = (float(v) for v in value)
    except (TypeError, ValueError, OverflowError) as error:
        raise MapFileError(f"{path}: origin {_shown(value)}, it must be three numbers [x, y, yaw]") from error
    if not all(map(math.isfinite, (x, y, yaw))):
        raise MapFileError(f"{path}: origin {_shown(value)}, its numbers must be finite")
    if yaw != 0.0:
        raise MapFileError(f"{path}: origin yaw {yaw} rad, rotated maps are not accepted: rotate the picture instead")
    return x, y


def _image_path(path: Path, entries: dict[str, Any]) -> Path:
    name = entries["image"]
    if not isinstance(name, str) or not name or "\0" in name:
        raise MapFileError(f"{path}: image {_shown(name)}, it must be the name of a PGM or PNG file")
    folder = path.resolve().parent
    image_path = (folder / name).resolve()
    if not image_path.is_relative_to(folder):
        raise MapFileError(f"{path}: image {name!r} lies outside the folder of the map file")
    if not image_path.is_file():
        raise MapFileError(f"{path}: image {name!r}, there is no such file in {folder}")
    return image_path


def _read_picture(path: Path, check_size: Callable[[int, int], None]) -> NDArray[np.float32]:
    """(rows, cols) brightness in [0, 1], row 0 at the top; check_size(width, height) is called on the header."""
    try:
        with path.open("rb") as file:
            header = file.read(_HEADER_BYTES)
    except OSError as error:
        raise MapFileError(f"{path}: the picture cannot be read ({error.strerror})") from error
    if header.startswith(_PNG_SIGNATURE) and header[12:16] == b"IHDR" and len(header) >= 24:
        width, height = struct.unpack(">II", header[16:24])
        check_size(width, height)
        return _read_png(path, (height, width))
    match = _PGM_HEADER.match(header)
    if match is None:
        raise MapFileError(f"{path}: neither a PNG nor a PGM (P2, P5) picture")
    width, height, top = (int(match[k]) for k in (2, 3, 4))
    check_size(width, height)
    if not 1 <= top <= 65535:
        raise MapFileError(f"{path}: PGM maximum {top}, it must be between 1 and 65535")
    return _read_pgm(path, (height, width), top, match[1] == b"P2", match.end())


def _read_png(path: Path, shape: tuple[int, int]) -> NDArray[np.float32]:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None or image.shape[:2] != shape:
        raise MapFileError(f"{path}: damaged PNG picture, {shape[1]} x {shape[0]} pixels cannot be decoded")
    top = 65535 if image.dtype == np.uint16 else 255
    if image.ndim == 2:
        return image.astype(np.float32) / np.float32(top)
    shown = image[..., :3] if image.shape[2] >= 3 else image[..., :1]
    color = shown.mean(axis=2, dtype=np.float32) / np.float32(top)
    if image.shape[2] == 4:
        # NaN is never below or above a threshold: a transparent pixel stays unknown
        color[image[..., 3] < top] = np.nan
    return color


def _read_pgm(path: Path, shape: tuple[int, int], top: int, ascii_values: bool, start: int) -> NDArray[np.float32]:
    pixels = shape[0] * shape[1]
    with path.open("rb") as file:
        file.seek(start)
        if ascii_values:
            body = file.read(pixels * _MAX_PIXEL_BYTES)
            body = re.sub(rb"#[^\n]*", b"", body).strip()
            if re.search(rb"[^\d\s]", body):  # releases of numpy differ in what they make of anything else
                raise MapFileError(f"{path}: a pixel of the ASCII PGM is not a whole number")
            values = np.fromstring(body, dtype=np.int64, sep=" ")[:pixels] if body else np.zeros(0, dtype=np.int64)
        else:
            sample = np.dtype(">u2" if top > 255 else np.uint8)
            body = file.read(pixels * sample.itemsize)
            values = np.frombuffer(body, dtype=sample, count=len(body) // sample.itemsize)
    if len(values) < pixels:
        raise MapFileError(f"{path}: {len(values)} pixels, its header promises {shape[1]} x {shape[0]}")
    if values.min() < 0 or values.max() > top:
        raise MapFileError(f"{path}: pixel values {values.min()} to {values.max()}, the header's maximum is {top}")
    return (values.reshape(shape) / np.float32(top)).astype(np.float32)


def _resampled(occupied: NDArray[np.bool_], resolution: float, origin: tuple[float, float]) -> OccupancyMap:
    if abs(resolution / RESOLUTION - 1.0) < 1e-6:
        return OccupancyMap(np.ascontiguousarray(occupied), RESOLUTION, origin)
    for axis in (0, 1):
        occupied = _any_in_cells(occupied, axis, RESOLUTION / resolution)
    return OccupancyMap(np.ascontiguousarray(occupied), RESOLUTION, origin)


def _any_in_cells(occupied: NDArray[np.bool_], axis: int, pixels_per_cell: float) -> NDArray[np.bool_]:
    """Cells of `pixels_per_cell` pixels along one axis, each True if any pixel it overlaps is or it leaves the map."""
    side = occupied.shape[axis]
    cells = max(1, math.ceil(side / pixels_per_cell - 1e-6))
    edges = np.minimum(np.arange(cells + 1) * pixels_per_cell, side + 1.0)
    first = np.floor(edges[:-1] + 1e-6).astype(np.intp)
    stop = np.ceil(edges[1:] - 1e-6).astype(np.intp)
    shape = [1, 1]
    shape[axis] = cells
    result = np.zeros([cells if k == axis else n for k, n in enumerate(occupied.shape)], dtype=bool)
    result |= (stop > side).reshape(shape)
    for offset in range(int((stop - first).max())):
        pixel = np.minimum(first + offset, np.minimum(stop, side) - 1)
        result |= occupied.take(pixel, axis=axis)
    return result
