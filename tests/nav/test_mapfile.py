"""Maps of map_server are read as they are meant, and malformed ones are refused with a reason."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hiernav.nav.mapfile import MapFileError, load_map

FREE, UNKNOWN, OCCUPIED = 254, 205, 0
pictures = hnp.arrays(np.uint8, st.tuples(st.integers(1, 12), st.integers(1, 12)), elements=st.integers(0, 255))


def write_map(folder: Path, picture: np.ndarray | bytes, name: str = "hall.pgm", **changes: object) -> Path:
    """A map_server map of `picture` (row 0 at the top); a change of None removes its key."""
    folder.mkdir(exist_ok=True)
    if isinstance(picture, np.ndarray):
        if name.endswith(".png"):
            cv2.imwrite(str(folder / name), picture)
        else:
            rows, cols = picture.shape
            (folder / name).write_bytes(b"P5\n# made by hand\n%d %d\n255\n" % (cols, rows) + picture.tobytes())
    else:
        (folder / name).write_bytes(picture)
    entries: dict[str, object] = {
        "image": name,
        "resolution": 0.05,
        "origin": "[-1.0, -2.0, 0.0]",
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }
    entries |= changes
    path = folder / "hall.yaml"
    path.write_text("".join(f"{key}: {value}\n" for key, value in entries.items() if value is not None))
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("maps")


PICTURE = np.array([[FREE, FREE, OCCUPIED], [UNKNOWN, FREE, FREE]], dtype=np.uint8)


@pytest.mark.parametrize("name", ["hall.pgm", "hall.png"])
def test_the_top_row_of_the_picture_is_the_highest_y(folder: Path, name: str) -> None:
    loaded = load_map(write_map(folder, PICTURE, name))
    assert loaded.occupied.tolist() == [[True, False, False], [False, False, True]]
    assert loaded.resolution == 0.05 and loaded.origin == (-1.0, -2.0)
    assert loaded.extent == pytest.approx((-1.0, -0.85, -2.0, -1.9))


@given(pictures)
def test_pgm_binary_pgm_ascii_and_png_are_the_same_map(folder: Path, picture: np.ndarray) -> None:
    expected = ((255 - picture.astype(float)) / 255 >= 0.196)[::-1]
    rows, cols = picture.shape
    ascii_picture = f"P2 {cols} {rows} # size\n255\n" + "\n".join(" ".join(map(str, row)) for row in picture)
    assert (load_map(write_map(folder, picture, "a.pgm")).occupied == expected).all()
    assert (load_map(write_map(folder, picture, "a.png")).occupied == expected).all()
    assert (load_map(write_map(folder, ascii_picture.encode(), "b.pgm")).occupied == expected).all()


def test_unknown_cells_count_as_occupied_and_so_do_transparent_ones(folder: Path) -> None:
    assert load_map(write_map(folder, np.full((3, 3), UNKNOWN, np.uint8))).occupied.all()
    see_through = np.full((2, 2, 4), FREE, np.uint8)
    see_through[..., 3] = [[255, 0], [255, 255]]
    assert load_map(write_map(folder, see_through, "c.png")).occupied.tolist() == [[False, False], [False, True]]


def test_negate_swaps_black_and_white(folder: Path) -> None:
    loaded = load_map(write_map(folder, PICTURE, negate=1))
    assert loaded.occupied.tolist() == [[True, True, True], [True, True, False]]


def test_16_bit_pictures_and_other_maxima_are_scaled(folder: Path) -> None:
    deep = np.array([[65535, 0], [40000, 60000]], dtype=np.uint16)
    assert load_map(write_map(folder, deep, "deep.png")).occupied.tolist() == [[True, False], [False, True]]
    deep_pgm = b"P5 2 2 65535\n" + deep.astype(">u2").tobytes()
    assert load_map(write_map(folder, deep_pgm)).occupied.tolist() == [[True, False], [False, True]]
    assert load_map(write_map(folder, b"P2 2 1 10\n10 1\n")).occupied.tolist() == [[False, True]]


def test_a_resolution_written_as_5e_2_is_a_number(folder: Path) -> None:
    assert load_map(write_map(folder, PICTURE, resolution="5e-2")).resolution == 0.05


@pytest.mark.parametrize("resolution", [0.01, 0.02, 0.03, 0.049, 0.07, 0.1, 0.25])
@pytest.mark.parametrize("seed", range(3))
def test_resampling_keeps_the_extent_and_loses_no_obstacle(folder: Path, resolution: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    picture = np.where(rng.random((17, 23)) < 0.1, OCCUPIED, FREE).astype(np.uint8)
    loaded = load_map(write_map(folder, picture, resolution=resolution))
    assert loaded.resolution == 0.05
    _, xmax, _, ymax = loaded.extent
    assert -1e-9 < xmax - (-1.0 + 23 * resolution) < 0.05 and -1e-9 < ymax - (-2.0 + 17 * resolution) < 0.05

    # each cell against every source pixel it overlaps, the outside included
    occupied = picture[::-1] == OCCUPIED
    for row, col in np.ndindex(loaded.occupied.shape):
        low = np.floor(np.array([row, col]) * 0.05 / resolution + 1e-6).astype(int)
        high = np.ceil(np.array([row + 1, col + 1]) * 0.05 / resolution - 1e-6).astype(int)
        beyond = (high > occupied.shape).any()
        assert loaded.occupied[row, col] == (beyond or occupied[low[0] : high[0], low[1] : high[1]].any())


def test_the_area_is_kept_where_pixels_divide_evenly(folder: Path) -> None:
    loaded = load_map(write_map(folder, PICTURE, resolution=0.1))
    assert (loaded.occupied == np.kron((PICTURE[::-1] != FREE), np.ones((2, 2))).astype(bool)).all()


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"resolution": 0}, "resolution 0.0, it must be finite and positive"),
        ({"resolution": ".nan"}, "resolution nan"),
        ({"resolution": -0.05}, "resolution -0.05"),
        ({"resolution": ".inf"}, "resolution inf"),
        ({"resolution": "wide"}, "resolution 'wide', it must be a number"),
        ({"resolution": 1e6}, "too large at 0.05 m per pixel"),
        ({"resolution": None}, "resolution.* missing"),
        ({"image": None}, "image.* missing"),
        ({"image": "other.pgm"}, "no such file"),
        ({"image": "../hall.pgm"}, "outside the folder"),
        ({"image": "/etc/passwd"}, "outside the folder"),
        ({"image": "."}, "no such file"),
        ({"image": "[1, 2]"}, "must be the name"),
        ({"origin": "[0.0, 0.0, 0.5]"}, "yaw 0.5 rad, rotated maps are not accepted"),
        ({"origin": "[0.0, 0.0]"}, "three numbers"),
        ({"origin": "[.nan, 0.0, 0.0]"}, "finite"),
        ({"origin": "here"}, "three numbers"),
        ({"negate": 2}, "negate 2"),
        ({"free_thresh": 0.7}, "free_thresh 0.7 and occupied_thresh 0.65"),
        ({"occupied_thresh": ".nan"}, "occupied_thresh nan"),
        ({"resolution": "0x" + "f" * 6000}, "hall.yaml: resolution int of too many digits, it must be a number"),
        ({"origin": f"[0x{'f' * 6000}, 0, 0]"}, "hall.yaml: origin list of too many digits, it must be three numbers"),
        ({"image": "0x" + "f" * 6000}, "hall.yaml: image int of too many digits, it must be the name"),
        ({"mode": "0x" + "f" * 6000}, "hall.yaml: mode int of too many digits, only 'trinary'"),
        ({"mode": "raw"}, "mode 'raw', only 'trinary'"),
    ],
)
def test_a_malformed_entry_is_named(folder: Path, changes: dict[str, object], reason: str) -> None:
    with pytest.raises(MapFileError, match=reason):
        load_map(write_map(folder, PICTURE, **changes))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("image: [", "not a YAML file"),
        ("- 1\n- 2\n", "holds list"),
        ("", "holds NoneType"),
        ("#" * 70000, "longer than"),
        ("image: 2001-99-99", "not a YAML file"),
        ("image: " + "1" * 5000, "not a YAML file"),
        ("image: !!timestamp x", "not a YAML file .tags are not accepted: '!!timestamp'.* line 1, column 8"),
        ("resolution: !!bool foo", "tags are not accepted: '!!bool'"),
        ('negate: !!int ""', "tags are not accepted: '!!int'"),
        ('negate: !!float ""', "tags are not accepted: '!!float'"),
        ("!!set {a, b}", "tags are not accepted: '!!set'"),
        ("origin: !!seq [0, 0, 0]", "tags are not accepted: '!!seq'"),
        ("mode: !local trinary", "tags are not accepted: '!local'"),
        ("[" * 5000, "not a YAML file"),
        ("a: &a [x, x]\nimage: *a", "aliases are not accepted"),
    ],
)
def test_a_file_that_is_no_mapping_is_refused(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "map.yaml"
    path.write_text(text)
    with pytest.raises(MapFileError, match=reason):
        load_map(path)


def test_a_map_whose_name_no_file_can_have_is_named() -> None:
    with pytest.raises(MapFileError, match=r"^map 'ha\\x00ll' cannot be read \(embedded null byte\)$"):
        load_map("ha\0ll")


def test_a_missing_map_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MapFileError, match=r"none\.yaml.*cannot be read"):
        load_map(tmp_path / "none.yaml")


def png_header(width: int, height: int) -> bytes:
    body = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + body + struct.pack(">I", zlib.crc32(body))


@pytest.mark.parametrize(
    ("picture", "reason"),
    [
        (b"P5 0 7 255\n", "0 x 7 pixels, each side must be between 1 and 16384"),
        (b"P5 7 0 255\n", "7 x 0 pixels"),
        (b"P5 65536 65536 255\n", "65536 x 65536 pixels"),
        (b"P2 16385 1 255\n", "16385 x 1 pixels"),
        (b"P5 2 2 0\n1234", "maximum 0"),
        (b"P5 2 2 70000\n1234", "maximum 70000"),
        (b"P5 3 3 255\n12345678", "8 pixels, its header promises 3 x 3"),
        (b"P2 2 2 255\n1 2 3", "3 pixels, its header promises 2 x 2"),
        (b"P2 2 2 255\n", "0 pixels"),
        (b"P2 2 2 255\n1 2 3 x", "not a whole number"),
        (b"P2 2 2 255\n1 2 3 256", "pixel values 1 to 256"),
        (b"P2 2 2 255\n1 2 3 -1", "not a whole number"),
        (b"P5 2", "neither a PNG nor a PGM"),
        (b"P6 1 1 255\nabc", "neither a PNG nor a PGM"),
        (b"", "neither a PNG nor a PGM"),
        (png_header(65536, 65536), "65536 x 65536 pixels"),
        (png_header(0, 3), "0 x 3 pixels"),
        (png_header(4, 4), "damaged PNG"),
        (png_header(4, 4)[:20], "neither a PNG nor a PGM"),
    ],
)
def test_a_malformed_picture_is_refused(folder: Path, picture: bytes, reason: str) -> None:
    with pytest.raises(MapFileError, match=reason):
        load_map(write_map(folder, picture))


def test_a_link_that_leaves_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "secret.pgm").write_bytes(b"P5 1 1 255\n\x00")
    path = write_map(tmp_path / "maps", PICTURE, image="link.pgm")
    (tmp_path / "maps" / "link.pgm").symlink_to(tmp_path / "secret.pgm")
    with pytest.raises(MapFileError, match="outside the folder"):
        load_map(path)


@given(st.binary(max_size=60))
def test_any_bytes_are_a_map_or_a_map_file_error(folder: Path, noise: bytes) -> None:
    for start in (b"P5 3 2 255\n", b"P2 3 2 255\n", png_header(3, 2), b""):
        path = write_map(folder, start + noise, "noise.pgm")
        try:
            assert load_map(path).occupied.shape == (2, 3) or not start
        except MapFileError as error:
            assert "noise.pgm" in str(error)


@given(st.text(alphabet=st.sampled_from("image: resoluton[]{}&*!|>'\"#%@`,.?~10-9e_\n\t"), max_size=80))
def test_any_text_is_a_map_file_error(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    path.write_text(text, newline="")
    with pytest.raises(MapFileError, match=r"any\.yaml"):
        load_map(path)


ENTRIES = ("resolution", "origin", "negate", "occupied_thresh", "free_thresh", "image", "mode")
VALUES = ("0", "1", "-1", "0.05", "1e-300", "1e300", ".nan", ".inf", "[]", "[1, 2, 3]", "[a, b, c]", "{}", "null",
          "text", "true", "2001-01-01", "'../x.pgm'", "'\\0'", "0x7fffffffffffffffffff", "9" * 400)  # fmt: skip


@given(st.dictionaries(st.sampled_from(ENTRIES), st.sampled_from(VALUES), min_size=1))
def test_any_entries_are_a_map_or_a_map_file_error(folder: Path, entries: dict[str, str]) -> None:
    try:
        assert load_map(write_map(folder, PICTURE, **entries)).occupied.size > 0
    except MapFileError as error:
        assert "hall." in str(error)


def test_a_resolution_far_below_any_sensor_costs_no_time(folder: Path) -> None:
    for resolution in (1e-9, 1e-300):
        assert load_map(write_map(folder, PICTURE, resolution=resolution)).occupied.tolist() == [[True]]
