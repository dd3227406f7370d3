"""Maps that cannot be: refused with one line, before memory is taken."""

from __future__ import annotations

import math
import struct
import tracemalloc
import zlib

import pytest
from run_loop_script import load_script

from hiernav.nav.mapfile import MapFileError, load_map
from hiernav.nav.occupancy import OccupancyMap, empty_map


def pgm(width: int, height: int, pixels: bytes = b"") -> bytes:
    return f"P5\n{width} {height}\n255\n".encode() + pixels


def png(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0" * 100)) + chunk(b"IEND", b"")
    )


def write(folder, picture: bytes, name: str = "map.pgm", **changes: object):
    entries = {"image": name, "resolution": 0.05, "origin": [0.0, 0.0, 0.0], "negate": 0}
    entries |= {"occupied_thresh": 0.65, "free_thresh": 0.196} | changes
    (folder / name).write_bytes(picture)
    path = folder / "map.yaml"
    path.write_text("".join(f"{key}: {value}\n" for key, value in entries.items()))
    return path


CASES = [
    ("0 x 40 pixels", lambda d: write(d, pgm(0, 40)), "0 x 40 pixels"),
    ("40 x 0 pixels", lambda d: write(d, png(40, 0), "map.png"), "40 x 0 pixels"),
    ("65536 x 65536 PGM", lambda d: write(d, pgm(65536, 65536)), "65536 x 65536 pixels"),
    ("65536 x 65536 PNG", lambda d: write(d, png(65536, 65536), "map.png"), "65536 x 65536 pixels"),
    ("10000 x 10000 PNG", lambda d: write(d, png(10000, 10000), "map.png"), "at most 67,108,864"),
    ("resolution 0", lambda d: write(d, pgm(2, 2, b"\xff" * 4), resolution=0), "resolution 0"),
    ("resolution NaN", lambda d: write(d, pgm(2, 2, b"\xff" * 4), resolution=".nan"), "resolution nan"),
    ("resolution inf", lambda d: write(d, pgm(2, 2, b"\xff" * 4), resolution=".inf"), "resolution inf"),
    ("resolution that multiplies", lambda d: write(d, pgm(9, 9, b"\xff" * 81), resolution=500), "too large"),
    ("truncated picture", lambda d: write(d, pgm(200, 200, b"\xff" * 99)), "99 pixels"),
]


@pytest.mark.parametrize(("make", "reason"), [case[1:] for case in CASES], ids=[case[0] for case in CASES])
def test_an_impossible_map_is_refused_without_taking_memory(tmp_path, capsys, make, reason):
    path = make(tmp_path)
    tracemalloc.start()
    try:
        with pytest.raises(MapFileError, match=reason):
            load_map(path)
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()
    assert load_script().main(["--fast", "--world", str(path), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert reason in error and len(error.splitlines()) == 1


@pytest.mark.parametrize("half_size", [(0.0, 1.0), (math.nan, 1.0), (1e6, 1e6)])
def test_no_such_map_is_made_in_memory_either(half_size):
    with pytest.raises(ValueError, match="map"):
        empty_map(half_size)


def test_a_map_of_no_pixels_is_no_map():
    import numpy as np

    with pytest.raises(ValueError, match="0 x 5 pixels"):
        OccupancyMap(np.zeros((5, 0), dtype=bool))
