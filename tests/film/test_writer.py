"""Films can be read back as they were written, and one that is not finished leaves nothing behind."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from hiernav.film import writer as writer_module
from hiernav.film.top_view import COLORS, rgb
from hiernav.film.writer import default_suffix, film_writer

GREYS = (40, 90, 140, 190, 240)


def frames() -> list[np.ndarray]:
    """Five pictures (120, 160, 3), each of all greys, and each with another one in its left half."""
    stripes = np.repeat(np.array(GREYS, dtype=np.uint8), 32)[None, :, None]
    pictures = [np.tile(stripes, (120, 1, 3)) for _ in GREYS]
    for picture, grey in zip(pictures, GREYS, strict=True):
        picture[:, :80] = grey
    return pictures


def write(path: Path, rate: float = 25.0) -> None:
    with film_writer(path, rate) as film:
        for frame in frames():
            film.write(frame, 2)


def read(path: Path) -> tuple[float, list[np.ndarray]]:
    """Frames per second, and the frames in RGB."""
    video = cv2.VideoCapture(str(path))
    found = []
    while (got := video.read())[0]:
        found.append(got[1][..., ::-1])
    return video.get(cv2.CAP_PROP_FPS), found


def test_an_mp4_holds_every_frame(tmp_path):
    write(tmp_path / "new folder" / "film.mp4", 20.0)
    rate, found = read(tmp_path / "new folder" / "film.mp4")
    assert rate == 20.0 and len(found) == 10
    for grey, frame in zip(np.repeat(GREYS, 2), found, strict=True):
        assert frame.shape == (120, 160, 3)
        assert abs(float(frame[:, :70].mean()) - grey) < 6.0
    assert [file.name for file in (tmp_path / "new folder").iterdir()] == ["film.mp4"]


def test_a_gif_holds_every_frame_for_its_time(tmp_path):
    write(tmp_path / "film.gif", 30.0)
    with Image.open(tmp_path / "film.gif") as film:
        assert film.n_frames == 5 and film.info["loop"] == 0
        durations = []
        for number, grey in enumerate(GREYS):
            film.seek(number)
            durations.append(film.info["duration"])
            assert abs(float(np.asarray(film.convert("RGB"))[:, :80].mean()) - grey) < 3.0
    assert set(durations) <= {60, 70} and abs(sum(durations) - 10 / 30 * 1000) <= 5.0


def test_a_gif_has_every_colour_that_later_frames_need(tmp_path):
    later = np.full((120, 160, 3), 250, dtype=np.uint8)
    for number, color in enumerate(COLORS):
        later[5:40, 10 * number : 10 * number + 8] = rgb(color)
    noise = np.random.default_rng(0).integers(0, 256, (120, 160, 3), dtype=np.uint8)
    with film_writer(tmp_path / "film.gif", 25.0) as film:
        film.write(noise // 4 + 180)
        film.write(later)
    with Image.open(tmp_path / "film.gif") as shown:
        shown.seek(1)
        picture = np.asarray(shown.convert("RGB")).astype(int)
    for number, color in enumerate(COLORS):
        assert np.abs(picture[20, 10 * number + 4] - rgb(color)).max() <= 16, color


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_film_that_is_interrupted_leaves_the_old_one(tmp_path, suffix):
    path = tmp_path / f"film{suffix}"
    path.write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt), film_writer(path, 25.0) as film:
        film.write(frames()[0])
        raise KeyboardInterrupt
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_another_ending_is_refused(tmp_path):
    with (
        pytest.raises(ValueError, match=r"film\.avi: its name must end in \.mp4 or \.gif"),
        film_writer(tmp_path / "film.avi", 25.0),
    ):
        pass
    assert list(tmp_path.iterdir()) == []


def test_where_no_encoder_is_a_gif_is_made_and_mp4_refused(tmp_path, monkeypatch):
    assert default_suffix() == ".mp4"
    monkeypatch.setattr(writer_module, "_CODECS", ("zzzz",))
    assert default_suffix() == ".gif"
    with pytest.raises(ValueError, match=r"no encoder for MP4 \(zzzz\); write a film that ends in \.gif"):
        write(tmp_path / "film.mp4")
    assert list(tmp_path.iterdir()) == []
    write(tmp_path / "film.gif")


def test_an_older_codec_takes_the_place_of_one_that_is_missing(tmp_path, monkeypatch):
    monkeypatch.setattr(writer_module, "_CODECS", ("zzzz", "mp4v"))
    write(tmp_path / "film.mp4")
    assert len(read(tmp_path / "film.mp4")[1]) == 10
