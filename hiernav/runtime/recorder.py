"""Records a run as an MCAP file, off the control loop.

The loop only puts records into a queue of limited length; a thread encodes and writes them. A full or failed disk ends
the recording and not the run. A file that was cut off, as by a killed process, is readable to its last chunk, and a
chunk is written every second.
"""

from __future__ import annotations

import logging
import queue
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex
from mcap.writer import Writer

from hiernav.runtime import messages
from hiernav.runtime.observe import Event, Observer, TickRecord

PROFILE = "hiernav"
QUEUE_LENGTH = 1024
"""Records that may wait; more are dropped and counted."""
CHUNK_SECONDS = 1.0
"""Longest time for which a record waits for its chunk to be written [s]."""
ABOUT = "hiernav"
"""Name of the metadata record that says what was run."""

_CHUNK_INDICES = "_Writer__chunk_indices"
"""Where the writer collects what it puts at the end of the file: 3 MB an hour, were they kept in memory."""

log = logging.getLogger(__name__)


class Recorder(Observer):
    """Writes every tick and event to an MCAP file, in memory that does not grow with it."""

    def __init__(self, path: str | Path, about: Mapping[str, str] | None = None) -> None:
        """
        Args:
            path: file to write; one that exists is left alone.
            about: what is run, kept as the file's metadata.

        Raises:
            OSError: the file exists or cannot be written; then none is left behind.
        """
        self.path = Path(path)
        if self.path.is_file():
            raise FileExistsError(f"{self.path}: the recording exists already; choose another name")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        new = not self.path.exists()
        self._file = self.path.open("wb")
        self.ticks = self.dropped = 0
        """Ticks in the file, and records that are not: the queue or the disk was full, or they could not be encoded."""
        self.error: str | None = None
        """Why the recording ended early."""
        self._queue: queue.SimpleQueue[TickRecord | Event | threading.Event | None] = queue.SimpleQueue()
        self._encoder = messages.TickEncoder()
        self._unreadable = False
        self._added = self._unwritten = 0
        """Ticks that the writer has been given, and records of those that are in no chunk of the file yet."""
        self._writer = Writer(self._file)
        try:
            self._indices = _ChunkIndices(self.path.parent, self._chunk_written)
            setattr(self._writer, _CHUNK_INDICES, self._indices)
            self._writer.start(profile=PROFILE, library="hiernav")
            self._writer.add_metadata(ABOUT, dict(about or {}))
            self._channels = {topic: self._open_channel(topic) for topic in messages.TOPICS}
            self._file.flush()
            self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
            self._thread.start()
        except (OSError, RuntimeError) as error:  # the latter where the system has no room for another thread
            with suppress(OSError):  # what was not written still is not
                self._file.close()
            if hasattr(self, "_indices"):
                self._indices.close()
            if new:
                self.path.unlink(missing_ok=True)
            why = getattr(error, "strerror", None) or error
            raise OSError(f"{self.path}: the recording cannot be written: {why}") from None

    def tick(self, record: TickRecord) -> None:
        self._put(record)

    def event(self, event: Event) -> None:
        self._put(event)

    def flush(self, timeout: float) -> None:
        written = threading.Event()
        self._queue.put(written)
        if self.error is None and not written.wait(timeout):
            log.warning("%s: not all of the recording could be written within %g s", self.path, timeout)

    def close(self, timeout: float = 3.0) -> None:
        """Write what waits, at most `timeout` [s] long, and finish the file. May be called again."""
        self._queue.put(None)
        self._thread.join(timeout)
        if self._thread.is_alive():
            self.error = self.error or f"not written within {timeout:g} s"

    def summary(self) -> dict[str, Any]:
        """For the account of the run, in JSON's own types."""
        return {"file": str(self.path), "ticks": self.ticks, "dropped": self.dropped, "error": self.error}

    def __str__(self) -> str:
        lost = f", {self.dropped} left out" if self.dropped else ""
        ended = f", ended early: {self.error}" if self.error else ""
        return f"{self.path}, {self.ticks} ticks{lost}{ended}"

    def _put(self, item: TickRecord | Event) -> None:
        if self.error is not None or self._queue.qsize() >= QUEUE_LENGTH:
            self.dropped += 1
        else:
            self._queue.put(item)

    def _open_channel(self, topic: str) -> int:
        kind = messages.TOPICS[topic]
        schema = self._writer.register_schema(f"hiernav.{kind.__name__}", "jsonschema", messages.schema(kind))
        return self._writer.register_channel(topic, "json", schema)

    def _work(self) -> None:
        """The thread: everything that takes time or may fail."""
        try:
            self._write_all()
        except Exception as error:
            self.error = getattr(error, "strerror", None) or str(error) or type(error).__name__
            log.error("%s: the recording ends here, the robot drives on: %s", self.path, self.error)
            self.dropped += self._unwritten
            # what the buffer still holds cannot be written either
            try:
                self._file.close()
            except OSError:
                pass
        self._indices.close()
        self._release_waiting()

    def _chunk_written(self) -> None:
        """The writer has finished a chunk: what it was given until now is in the file."""
        self._file.flush()
        self.ticks, self._unwritten = self._added, 0

    def _write_all(self) -> None:
        time_ns, chunk_begun = 0, time.monotonic()
        while True:
            try:
                item = self._queue.get(timeout=CHUNK_SECONDS)
            except queue.Empty:
                item = threading.Event()
            if item is None:
                break
            if not isinstance(item, threading.Event):
                time_ns = max(time_ns, self._time_ns(item))
                self._add(item, time_ns)
            if isinstance(item, threading.Event) or time.monotonic() - chunk_begun >= CHUNK_SECONDS:
                try:
                    self._writer.flush()
                finally:
                    if isinstance(item, threading.Event):
                        item.set()
                chunk_begun = time.monotonic()
        self._writer.finish()
        self._file.close()

    def _add(self, item: TickRecord | Event, time_ns: int) -> None:
        for topic, data in self._encoded(item):
            number = self._added
            self._added += topic == "/tick"
            self._unwritten += topic in ("/tick", "/event")  # the last message of a record
            self._writer.add_message(self._channels[topic], time_ns, data, time_ns, number)

    def _encoded(self, item: TickRecord | Event) -> list[tuple[str, bytes]]:
        """The item's messages; none if there is something in it that cannot be recorded."""
        try:
            if isinstance(item, Event):
                return [("/event", messages.encode_event(item))]
            return list(self._encoder.encode(item))
        except Exception as error:
            if not self._unreadable:
                log.error("%s: records that cannot be encoded are left out, such as this one: %s", self.path, error)
            self._unreadable = True
            self.dropped += 1
            return []

    @staticmethod
    def _time_ns(item: TickRecord | Event) -> int:
        return round(item.time * 1e9) if 0.0 <= item.time < 1e9 else 0

    def _release_waiting(self) -> None:
        while True:
            try:
                item = self._queue.get_nowait()
            except queue.Empty:
                return
            if isinstance(item, threading.Event):
                item.set()
            elif item is not None:
                self.dropped += 1


class _ChunkIndices:
    """In the place of a list of the file's chunks: keeps them in a file of its own, which has no name."""

    def __init__(self, folder: Path, chunk_written: Callable[[], None]) -> None:
        """`chunk_written` is called after each of them."""
        self._file = tempfile.TemporaryFile(buffering=0, dir=folder)
        self._chunk_written = chunk_written

    def append(self, index: ChunkIndex) -> None:
        self._chunk_written()
        record = RecordBuilder()
        index.write(record)
        self._file.write(record.end())

    def __iter__(self) -> Iterator[_ChunkIndices]:
        """All of them in one, which the writer has write itself."""
        yield self

    def write(self, summary: RecordBuilder) -> None:
        self._file.seek(0)
        summary.write(self._file.read())

    def close(self) -> None:
        self._file.close()
