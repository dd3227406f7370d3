"""Recordings from strangers: whatever the bytes, the reader gives records or one LogError, in little memory."""

from __future__ import annotations

import tracemalloc
import zlib

import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk
from mcap.writer import CompressionType, Writer
from recorded_drive import drive

from hiernav.runtime import log_reader, messages
from hiernav.runtime.log_reader import MAX_RECORD_BYTES, LogError, RunLog
from hiernav.runtime.messages import MessageError
from hiernav.runtime.observe import Event, TickRecord
from hiernav.runtime.recorder import ABOUT, PROFILE, Recorder


@pytest.fixture(scope="module")
def sample(tmp_path_factory):
    folder = tmp_path_factory.mktemp("log")
    recorder = Recorder(folder / "run.mcap", {"robot": "point"})
    drive(recorder, max_steps=4)
    recorder.close()
    return folder / "run.mcap"


def read_all(path) -> int:
    """Number of items; LogError is an answer too."""
    try:
        items = list(RunLog(path))
    except LogError as error:
        assert "\n" not in str(error)
        return 0
    assert all(isinstance(item, (TickRecord, Event)) for item in items)
    return len(items)


@settings(max_examples=150, deadline=None)
@given(
    flips=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(1, 255)), min_size=1, max_size=8),
    cut=st.one_of(st.none(), st.floats(0, 1)),
)
def test_a_damaged_recording_is_read_or_refused(sample, flips, cut):
    data = bytearray(sample.read_bytes())
    for at, flip in flips:
        data[int(at * len(data))] ^= flip
    path = sample.with_name("damaged.mcap")
    path.write_bytes(data if cut is None else data[: int(cut * len(data))])
    read_all(path)


@settings(max_examples=50, deadline=None)
@given(st.binary(max_size=200))
def test_any_bytes_after_the_magic_are_read_or_refused(sample, data):
    path = sample.with_name("noise.mcap")
    path.write_bytes(b"\x89MCAP0\r\n" + data)
    read_all(path)


def forged(path, *sent: tuple[str, bytes]):
    """A well-formed file with any messages."""
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start(profile=PROFILE)
        writer.add_metadata(ABOUT, {})
        for topic, data in sent:
            writer.add_message(writer.register_channel(topic, "json", 0), 0, data, 0)
        writer.finish()
    return path


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=10,
)


@settings(max_examples=150, deadline=None)
@given(topic=st.sampled_from(sorted(messages.TOPICS)), data=st.data())
def test_messages_of_the_right_shape_with_wrong_contents_are_refused(tmp_path_factory, topic, data):
    kind = messages.TOPICS[topic]
    number = st.one_of(st.floats(allow_nan=False, allow_infinity=False), st.sampled_from(["nan", "inf"]))
    fields = st.fixed_dictionaries(
        {
            name: st.one_of(st.integers(-5, 10**12), number, st.lists(number, max_size=8), json_values)
            for name in kind.__struct_fields__
        }
    )
    encoded = messages.msgspec.json.encode(data.draw(fields))
    sensors = messages.msgspec.json.encode(
        {"stamp": 0.0, "accelerometer": None, "gyro": None, "magnetometer": None, "velocimeter": None, "lidar": None,
         "extra": {}, "position_fix": None, "fix_stamp": None}
    )  # fmt: skip
    path = tmp_path_factory.mktemp("forged") / "run.mcap"
    read_all(forged(path, ("/sensors", sensors), (topic, encoded)))


@pytest.mark.parametrize("size", [10**15, 2**63, MAX_RECORD_BYTES + 1])
def test_a_record_that_claims_to_be_huge_takes_no_memory(tmp_path, size):
    path = forged(tmp_path / "huge.mcap")
    builder = RecordBuilder()
    Chunk("zstd", b"", 0, 0, 0, 0).write(builder)
    record = bytearray(builder.end())
    record[1:9] = size.to_bytes(8, "little")
    instead_of_the_end(path, bytes(record))
    assert bounded(path) == 0


def test_a_chunk_that_inflates_without_end_takes_no_memory(tmp_path):
    path = forged(tmp_path / "bomb.mcap")
    bomb = zstandard.compress(b"\0" * 10**9)
    builder = RecordBuilder()
    for promised in (1000, 10**9):
        Chunk("zstd", bomb, 0, 0, 0, promised).write(builder)
    instead_of_the_end(path, builder.end())
    assert bounded(path) == 0


def test_a_chunk_that_promises_too_much_is_not_inflated(monkeypatch):
    monkeypatch.setattr(zstandard, "ZstdDecompressor", None)
    with pytest.raises(ValueError, match="chunk of 64000001 bytes"):
        log_reader._inflated(Chunk("zstd", zstandard.compress(b""), 0, 0, 0, MAX_RECORD_BYTES + 1))


@pytest.mark.parametrize(("rows", "columns"), [(65536, 65536), (0, 5), (-1, -1), (16384, 16384), (10, 10)])
def test_a_map_that_does_not_hold_what_it_says_is_refused_before_memory_is_taken(rows, columns):
    pixels = zlib.compress(b"\0" * 10**7)
    message = messages.Map(rows, columns, 0.05, (0.0, 0.0), pixels)
    tracemalloc.start()
    try:
        with pytest.raises(MessageError, match="map"):
            messages.TickDecoder().add(message)
        assert tracemalloc.get_traced_memory()[1] < 40_000_000
    finally:
        tracemalloc.stop()


def instead_of_the_end(path, data: bytes) -> None:
    """Put `data` where the file's data section ends."""
    whole = path.read_bytes()
    path.write_bytes(whole[: whole.index(b"\x0f\x04\0\0\0\0\0\0\0")] + data)


def bounded(path) -> int:
    """As `read_all`, in bounded memory."""
    tracemalloc.start()
    try:
        count = read_all(path)
        assert tracemalloc.get_traced_memory()[1] < 2 * MAX_RECORD_BYTES
        return count
    finally:
        tracemalloc.stop()
