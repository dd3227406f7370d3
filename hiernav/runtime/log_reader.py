"""Reads recordings, whole or cut off, without trusting them: sizes are checked before memory is taken."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Chunk, Header, Message, Metadata
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk

from hiernav.runtime import messages
from hiernav.runtime.observe import Event, TickRecord
from hiernav.runtime.recorder import ABOUT, PROFILE

MAX_RECORD_BYTES = 64_000_000
"""Largest record, and largest chunk once inflated."""
_BROKEN = (McapError, CRCValidationError, zstandard.ZstdError, struct.error, ValueError, MemoryError, OverflowError)


class LogError(ValueError):
    """A file that is no recording, or one that holds what no recorder writes."""


class RunLog:
    """A recording.

    Iterating gives `TickRecord`s and `Event`s in the order in which they were recorded, as far as the file is whole.
    """

    def __init__(self, path: str | Path) -> None:
        """
        Raises:
            LogError: not a recording of this program.
            OSError: the file cannot be read.
        """
        self.path = Path(path)
        self.complete = False
        """Whether the last iteration came to the end of a finished file."""
        self.about: dict[str, str] = {}
        """What was run."""
        with self.path.open("rb") as file:
            self._read_head(file)

    def __iter__(self) -> Iterator[TickRecord | Event]:
        """
        Raises:
            LogError: a message that no recorder writes; what was read before it is good.
        """
        self.complete = False
        decoder = messages.TickDecoder()
        topics: dict[int, str] = {}
        with self.path.open("rb") as file:
            for record in self._records(file):
                if isinstance(record, Channel):
                    if record.topic in messages.TOPICS:
                        topics[record.id] = record.topic
                elif isinstance(record, Message) and record.channel_id in topics:
                    try:
                        item = decoder.add(messages.decode(topics[record.channel_id], record.data))
                    except messages.MessageError as error:
                        raise LogError(f"{self.path}: {error}") from None
                    if item is not None:
                        yield item

    def ticks(self) -> Iterator[TickRecord]:
        """The records alone."""
        return (item for item in self if isinstance(item, TickRecord))

    def _read_head(self, file: BinaryIO) -> None:
        reader = StreamReader(file, emit_chunks=True, record_size_limit=MAX_RECORD_BYTES)
        try:
            records = reader.records
            header = next(records)
            if not isinstance(header, Header) or header.profile != PROFILE:
                raise LogError(f"{self.path}: not a recording of hiernav")
            about = next(records)
        except LogError:
            raise
        except (StopIteration, *_BROKEN) as error:
            raise LogError(f"{self.path}: not a recording, or cut off before its first tick ({_text(error)})") from None
        if not isinstance(about, Metadata) or about.name != ABOUT:
            raise LogError(f"{self.path}: it does not say what was run")
        self.about = about.metadata

    def _records(self, file: BinaryIO) -> Iterator[object]:
        """Every record up to the first one that is damaged."""
        reader = StreamReader(file, emit_chunks=True, record_size_limit=MAX_RECORD_BYTES)
        try:
            for record in reader.records:
                if isinstance(record, Chunk):
                    yield from breakup_chunk(_inflated(record), validate_crc=True)
                else:
                    yield record
        except (EndOfFile, *_BROKEN):
            return
        self.complete = True


def _inflated(chunk: Chunk) -> Chunk:
    """The chunk, not compressed. Its size is that which it promises, and within the limit."""
    size = chunk.uncompressed_size
    if size > MAX_RECORD_BYTES or chunk.compression not in ("", "zstd"):
        raise ValueError(f"chunk of {size} bytes, compression {chunk.compression!r}")
    data = chunk.data
    if chunk.compression == "zstd":
        with zstandard.ZstdDecompressor(max_window_size=2**27).stream_reader(data) as stream:
            data = stream.read(size + 1)
    if len(data) != size:
        raise ValueError(f"chunk of {len(data)} bytes promises {size}")
    return Chunk(
        compression="",
        data=data,
        message_start_time=chunk.message_start_time,
        message_end_time=chunk.message_end_time,
        uncompressed_crc=chunk.uncompressed_crc,
        uncompressed_size=size,
    )


def _text(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
