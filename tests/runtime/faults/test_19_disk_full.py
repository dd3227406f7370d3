"""A full disk ends the recording and not the run."""

from __future__ import annotations

import errno
import resource
from pathlib import Path

import pytest
from recorded_drive import Memory, drive, equal

from hiernav.runtime.log_reader import RunLog
from hiernav.runtime.recorder import Recorder


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's /dev/full")
def test_a_disk_that_is_full_from_the_start_is_refused_before_the_robot_moves():
    with pytest.raises(OSError, match="No space left"):
        Recorder("/dev/full")


@pytest.fixture
def limit_file_size():
    """Lets the kernel refuse what would make a file longer than so many bytes, as a full disk does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_disk_that_fills_up_ends_the_recording_and_the_robot_arrives(tmp_path, limit_file_size):
    undisturbed, memory = Memory(), Memory()
    expected = drive(undisturbed, seed=1)
    recorder = Recorder(tmp_path / "run.mcap")
    drive(memory, recorder, seed=1)
    recorder.flush(10.0)
    whole = len(memory.records)
    limit_file_size(recorder.path.stat().st_size + 5000)
    for seed in (2, 3):
        drive(memory, recorder, seed=seed)
    full = Memory()
    result = drive(full, recorder, seed=1)
    recorder.close()
    assert (result.reached, result.steps, result.seconds) == (True, expected.steps, expected.seconds)
    assert all(equal(a.sent, b.sent) for a, b in zip(undisturbed.records, full.records, strict=True))
    assert "too large" in recorder.error and recorder.dropped > 0
    assert recorder.summary()["error"] == recorder.error
    log = RunLog(recorder.path)
    assert len(list(log.ticks())) == whole and not log.complete
    assert recorder.summary()["ticks"] == whole, "those that are in the file, and no others"
    told = [*memory.records, *memory.events, *full.records, *full.events]
    assert len(list(log)) + recorder.dropped == len(told)


def test_nobody_waits_for_a_disk_that_has_failed(tmp_path, monkeypatch, caplog):
    recorder, full = Recorder(tmp_path / "run.mcap"), OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr(recorder._writer, "flush", lambda: (_ for _ in ()).throw(full))
    recorder.flush(10.0)
    recorder.close()
    assert recorder.error == "No space left on device"
    assert not [each for each in caplog.messages if "could be written within" in each]
