"""A recording that ends in the middle, as of a killed process, is readable to its last chunk."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from recorded_drive import Memory, drive, equal

from hiernav.runtime.log_reader import LogError, RunLog
from hiernav.runtime.recorder import Recorder

ENDLESS = """
import sys, time
from recorded_drive import drive
from hiernav.runtime.observe import Observer
from hiernav.runtime.recorder import Recorder

class Slowly(Observer):
    def tick(self, record):
        time.sleep(0.01)

recorder = Recorder(sys.argv[1])
for seed in range(1000):
    drive(recorder, Slowly(), seed=seed)
"""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A recording of several chunks, and where they end."""
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    memory, recorder = Memory(), Recorder(path)
    for seed in range(3):
        drive(memory, recorder, seed=seed)
        recorder.flush(10.0)
    recorder.close()
    ends = []
    with path.open("rb") as file:
        for record in StreamReader(file, emit_chunks=True).records:
            if isinstance(record, Chunk):
                ends.append(file.tell())
    assert len(ends) >= 3
    return path.read_bytes(), ends, memory.records


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7, 0.9, 0.999])
def test_everything_up_to_the_last_whole_chunk_is_read(whole, tmp_path, share):
    data, ends, records = whole
    cut = int(share * len(data))
    path = tmp_path / "cut.mcap"
    path.write_bytes(data[:cut])
    log = RunLog(path)
    read = list(log.ticks())
    assert not log.complete
    assert all(equal(a.sent, b.sent) and a.time == b.time for a, b in zip(records, read, strict=False))
    chunks = sum(end <= cut for end in ends)
    assert bool(read) == (chunks > 0)
    if chunks == len(ends):
        assert len(read) == len(records)


def test_a_chunk_damaged_on_the_disk_ends_the_reading_and_gives_nothing_wrong(whole, tmp_path):
    data, ends, records = whole
    damaged = bytearray(data)
    damaged[ends[1] - 50] ^= 0xFF
    path = tmp_path / "damaged.mcap"
    path.write_bytes(damaged)
    log = RunLog(path)
    read = list(log.ticks())
    assert not log.complete and 0 < len(read) < len(records)
    assert all(equal(a.estimate, b.estimate) for a, b in zip(records, read, strict=False))


def test_a_log_cut_before_its_first_tick_is_refused_in_words(whole, tmp_path):
    path = tmp_path / "stub.mcap"
    path.write_bytes(whole[0][:20])
    with pytest.raises(LogError, match="cut off before its first tick"):
        RunLog(path)


@pytest.mark.slow
def test_a_killed_process_leaves_all_but_its_last_seconds(tmp_path):
    path = tmp_path / "killed.mcap"
    tests = Path(__file__).parents[1]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tests), str(tests.parents[1])])}
    process = subprocess.Popen([sys.executable, "-c", ENDLESS, str(path)], env=environment)
    try:
        deadline = time.monotonic() + 60.0
        while not (path.exists() and path.stat().st_size > 60_000):
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.05)
        process.send_signal(signal.SIGKILL)
    finally:
        process.kill()
        process.wait()
    log = RunLog(path)
    read = list(log.ticks())
    assert not log.complete
    assert len(read) > 50 and [record.index for record in read][:50] == list(range(50))
