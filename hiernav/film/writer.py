"""Film files: MP4 by OpenCV's encoders, GIF by Pillow. A film that is not finished leaves nothing behind."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import numpy as np
from PIL import Image

from hiernav.film.top_view import COLORS, Frame, rgb
from hiernav.nav.opencv import cv2

SUFFIXES = (".mp4", ".gif")
_CODECS = ("vp09", "mp4v")
"""Browsers play the first one; every OpenCV has the second."""


class Writer(Protocol):
    """Takes the frames of a film in order; the first one decides the size."""

    def write(self, frame: Frame, times: int = 1) -> None: ...


@contextmanager
def film_writer(path: Path, frames_per_second: float) -> Iterator[Writer]:
    """A writer whose film is at `path` once the block has ended; the folder is made if needed.

    Raises:
        ValueError: the ending of `path` is none of `SUFFIXES`, or OpenCV has no encoder for it.
    """
    if path.suffix not in SUFFIXES:
        raise ValueError(f"film {path}: its name must end in {' or '.join(SUFFIXES)}")
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.stem}.part{path.suffix}")
    writer = _Gif(partial, frames_per_second) if path.suffix == ".gif" else _Mp4(partial, frames_per_second)
    try:
        yield writer
        writer.close()
        partial.replace(path)
    finally:
        writer.release()
        partial.unlink(missing_ok=True)


def default_suffix() -> str:
    """ ".mp4" where OpenCV can encode it, ".gif" elsewhere."""
    with tempfile.TemporaryDirectory() as folder:
        probe = _open_video(Path(folder) / "probe.mp4", 25.0, (64, 64))
    if probe is None:
        return ".gif"
    probe.release()
    return ".mp4"


class _Mp4:
    def __init__(self, path: Path, frames_per_second: float) -> None:
        self._path, self._rate = path, frames_per_second
        self._video: cv2.VideoWriter | None = None

    def write(self, frame: Frame, times: int = 1) -> None:
        if self._video is None:
            self._video = _open_video(self._path, self._rate, (frame.shape[1], frame.shape[0]))
            if self._video is None:
                raise ValueError(
                    f"film {self._path.parent}: OpenCV has no encoder for MP4 ({', '.join(_CODECS)}); "
                    "write a film that ends in .gif"
                )
        for _ in range(times):
            self._video.write(np.ascontiguousarray(frame[..., ::-1]))

    def close(self) -> None:
        self.release()

    def release(self) -> None:
        if self._video is not None:
            self._video.release()


class _Gif:
    """All frames share one palette; they are kept until the end, a byte per pixel."""

    def __init__(self, path: Path, frames_per_second: float) -> None:
        self._path, self._rate = path, frames_per_second
        self._frames: list[Image.Image] = []
        self._durations: list[float] = []

    def write(self, frame: Frame, times: int = 1) -> None:
        image = Image.fromarray(frame)
        if not self._frames:
            self._palette = Image.fromarray(_with_swatches(frame)).quantize(256)
        self._frames.append(image.quantize(palette=self._palette, dither=Image.Dither.NONE))
        self._durations.append(1000.0 * times / self._rate)

    def close(self) -> None:
        if self._frames:
            first, *others = self._frames
            durations = _whole_centiseconds(self._durations)
            first.save(self._path, save_all=True, append_images=others, duration=durations, loop=0)

    def release(self) -> None:
        self._frames.clear()


def _open_video(path: Path, frames_per_second: float, size: tuple[int, int]) -> cv2.VideoWriter | None:
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # a missing encoder is no news
    try:
        for codec in _CODECS:
            video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), frames_per_second, size)
            if video.isOpened():
                return video
    finally:
        cv2.utils.logging.setLogLevel(level)
    return None


def _with_swatches(frame: Frame) -> Frame:
    """The first frame beside stripes of every colour that later ones may need."""
    colors = np.array([rgb(color) for color in COLORS], dtype=np.uint8)
    width = -(-frame.shape[1] // (4 * len(COLORS)))
    stripes = np.tile(np.repeat(colors, width, axis=0), (frame.shape[0], 1, 1))
    return np.concatenate([frame, stripes], axis=1)


def _whole_centiseconds(durations: list[float]) -> list[int]:
    """Durations [ms] in the steps of 10 ms that GIF knows, so that the error does not add up."""
    ends = np.round(np.cumsum(durations) / 10.0).astype(int) * 10
    return np.diff(ends, prepend=0).tolist()
