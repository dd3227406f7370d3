from __future__ import annotations

import errno
import gc
import json
import math
import os
import threading
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from recorded_drive import Memory, drive, equal

from hiernav.runtime import messages, recorder
from hiernav.runtime.log_reader import LogError, RunLog
from hiernav.runtime.observe import Event, TickRecord
from hiernav.runtime.recorder import Recorder
from hiernav.runtime.robot import SensorFrame
from hiernav.runtime.supervisor import Mode


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A drive among moving obstacles: what was told, and the file."""
    memory, path = Memory(), tmp_path_factory.mktemp("log") / "run.mcap"
    writer = Recorder(path, {"robot": "point"})
    result = drive(memory, writer, world="gremlin", seed=1)
    writer.close()
    assert result.steps > 20 and writer.error is None and writer.dropped == 0
    return memory, path


@pytest.mark.parametrize("how", ["nothing there", "a device"])
def test_a_recording_that_cannot_begin_says_which_and_spends_no_name(tmp_path, monkeypatch, how):
    path = tmp_path / "run.mcap" if how == "nothing there" else Path("/dev/full")
    if how == "nothing there":

        def full(*_: object, **__: object) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr(recorder.Writer, "start", full)
    descriptors = os.listdir("/proc/self/fd")
    with pytest.raises(OSError, match=f"{path}: the recording cannot be written: No space left on device") as caught:
        Recorder(path)
    assert path.exists() == (how == "a device")
    assert os.listdir("/proc/self/fd") == descriptors, caught  # which holds the recorder: nobody else closes its files


def test_what_was_told_is_what_is_read_bit_for_bit(recorded):
    memory, path = recorded
    log = RunLog(path)
    items = list(log)
    assert log.complete and log.about == {"robot": "point"}
    records = [item for item in items if isinstance(item, TickRecord)]
    events = [item for item in items if isinstance(item, Event)]
    assert len(records) == len(memory.records)
    for told, read in zip(memory.records, records, strict=True):
        assert equal(replace(told, occupancy=None), replace(read, occupancy=None))
        assert (told.occupancy is None) == (read.occupancy is None)
        if told.occupancy is not None:
            assert equal(told.occupancy.occupied, read.occupancy.occupied)
            assert told.occupancy.origin == read.occupancy.origin
    assert [(event.kind, event.text) for event in events] == [(event.kind, event.text) for event in memory.events]


def test_the_libraries_own_reader_opens_it_and_finds_every_topic(recorded):
    memory, path = recorded
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        topics = {channel.topic for channel in summary.channels.values()}
        assert topics == set(messages.TOPICS)
        ticks = 0
        for schema, channel, message in reader.iter_messages():
            values = json.loads(message.data)
            assert set(values) == set(json.loads(schema.data)["properties"])
            ticks += channel.topic == "/tick"
        assert ticks == len(memory.records) == summary.statistics.channel_message_counts[
            next(number for number, channel in summary.channels.items() if channel.topic == "/tick")
        ]  # fmt: skip


def test_a_map_that_stands_still_is_written_once(tmp_path):
    memory, writer = Memory(), Recorder(tmp_path / "still.mcap")
    drive(memory, writer, max_steps=10)
    writer.close()
    with writer.path.open("rb") as file:
        maps = list(make_reader(file).iter_messages(topics=["/map"]))
    assert len(maps) == 1 and len(memory.records) > 10


numbers = np.array([math.nan, math.inf, -math.inf, 0.1, -0.0, 5e-324, 1.7e308])


def test_values_that_are_not_finite_survive(tmp_path):
    record = TickRecord(
        index=0,
        time=1.5,
        lateness=math.nan,
        mode=Mode.RUNNING,
        frame=SensorFrame(math.inf, gyro=numbers[:3], velocimeter=numbers[3:6], extra={"wheel": numbers}),
        sent=numbers,
        proposed=numbers[:5].astype(np.float32),
    )
    writer = Recorder(tmp_path / "odd.mcap")
    writer.tick(record)
    writer.close()
    (read,) = RunLog(writer.path).ticks()
    assert equal(record, read)


def test_an_existing_recording_is_left_alone(recorded):
    _, path = recorded
    before = path.read_bytes()
    with pytest.raises(FileExistsError, match="exists already"):
        Recorder(path)
    assert path.read_bytes() == before


def test_the_loop_never_waits_for_a_slow_disk_and_what_is_too_much_is_counted(tmp_path, monkeypatch):
    released = threading.Event()
    monkeypatch.setattr(recorder, "QUEUE_LENGTH", 8)
    writer = Recorder(tmp_path / "slow.mcap")
    add = writer._writer.add_message
    monkeypatch.setattr(writer._writer, "add_message", lambda *args: (released.wait(30), add(*args)))
    record = TickRecord(index=0, time=0.0, lateness=0.0, mode=Mode.RUNNING, frame=SensorFrame(0.0))
    for index in range(100):
        writer.tick(replace(record, index=index))
    assert 90 <= writer.dropped <= 92
    released.set()
    writer.close()
    assert writer.ticks + writer.dropped == 100
    assert len(list(RunLog(writer.path).ticks())) == writer.ticks


def test_flush_brings_everything_to_the_disk_while_the_file_goes_on(tmp_path):
    writer = Recorder(tmp_path / "flushed.mcap")
    drive(writer, max_steps=5)
    writer.flush(10.0)
    log = RunLog(writer.path)
    assert sum(isinstance(item, TickRecord) for item in log) == writer.ticks > 5
    assert not log.complete
    writer.close()
    assert list(log) and log.complete


def test_memory_does_not_grow_with_a_recording_which_ends_with_an_index_of_all_of_it(tmp_path):
    record = TickRecord(index=0, time=0.0, lateness=0.0, mode=Mode.RUNNING, frame=SensorFrame(0.0))
    writer, used = Recorder(tmp_path / "long.mcap"), {}
    tracemalloc.start()
    try:
        for index in range(1200):
            writer.tick(replace(record, index=index, time=float(index)))
            writer.flush(10.0)
            if index in (199, 1199):
                gc.collect()
                used[index] = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert used[1199] - used[199] < 100_000
    writer.close()
    assert writer.error is None and [path.name for path in tmp_path.iterdir()] == ["long.mcap"]
    with writer.path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert len(reader.get_summary().chunk_indexes) == 1200
        late = reader.iter_messages(topics=["/tick"], starting_at=int(1000e9))
        assert [json.loads(message.data)["index"] for _, _, message in late] == list(range(1000, 1200))


def test_several_runs_share_a_file(tmp_path):
    writer = Recorder(tmp_path / "two.mcap")
    first, second = Memory(), Memory()
    drive(first, writer, max_steps=5, seed=3)
    drive(second, writer, max_steps=4, seed=4)
    writer.close()
    read = list(RunLog(writer.path).ticks())
    assert [record.index for record in read] == [record.index for record in first.records + second.records]
    assert equal(read[-1].plan, second.records[-1].plan if second.records[-1].plan is not None else None)


@pytest.mark.parametrize("data", [b"", b"nonsense", b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" + b"\x01" * 40])
def test_something_that_is_no_recording_is_refused(tmp_path, data):
    path = tmp_path / "x.mcap"
    path.write_bytes(data)
    with pytest.raises(LogError, match="not a recording"):
        RunLog(path)


def test_a_record_that_cannot_be_encoded_is_left_out_and_the_others_are_kept(tmp_path):
    record = TickRecord(index=0, time=0.0, lateness=0.0, mode=Mode.RUNNING, frame=SensorFrame(0.0))
    writer = Recorder(tmp_path / "gap.mcap")
    writer.tick(record)
    writer.tick(replace(record, index=1, frame=SensorFrame(0.1, gyro=np.array([object()]))))
    writer.tick(replace(record, index=2))
    writer.close()
    assert [tick.index for tick in RunLog(writer.path).ticks()] == [0, 2]
    assert (writer.ticks, writer.dropped, writer.error) == (2, 1, None)


def test_a_system_without_room_for_a_thread_costs_no_recording_its_name(tmp_path, monkeypatch):
    def no_room(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", no_room)
    with pytest.raises(OSError, match="cannot be written: can't start new thread"):
        Recorder(tmp_path / "run.mcap")
    assert not list(tmp_path.iterdir())
